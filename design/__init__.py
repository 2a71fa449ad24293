"""Conditions, figures of merit and designs of couplings. A device appears here only as its damping."""
