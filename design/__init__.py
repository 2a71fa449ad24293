"""Conditions, figures of merit and designs of couplings. Most conditions use only the damping of a device."""
