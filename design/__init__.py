"""Conditions, figures of merit and designs of couplings. Most conditions describe a device by its damping alone."""
