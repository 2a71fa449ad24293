"""python -m design.export: couplings for use elsewhere."""
