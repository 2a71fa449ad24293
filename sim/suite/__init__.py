"""python -m sim.suite: every check that a verdict rests on, in one report."""
