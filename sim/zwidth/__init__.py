"""python -m sim.zwidth: the K-B map."""
