"""python -m sim.accuracy: what each engine costs and how wrong it is."""
