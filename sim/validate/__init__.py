"""python -m sim.validate: does a verdict hold for everyone?"""
