"""python -m sim.hunt: does switching contact destabilise a loop whose every frozen contact state is certified?"""
