"""Loops whose delays vary: delays drawn and found worst, the switched system, what a run with them says."""
