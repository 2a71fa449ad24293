"""Checks of ourselves, behind a verdict of ours: `python -m sim.suite` runs them. No command of a user needs them."""
