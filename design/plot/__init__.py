"""python -m design.plot: couplings side by side over frequency."""
