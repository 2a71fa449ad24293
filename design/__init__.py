"""Conditions, figures of merit and designs for virtual couplings. It sees a device only through its damping."""
