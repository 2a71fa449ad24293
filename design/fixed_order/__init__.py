"""State-space couplings of fixed order, by several searches. design.ccl is their front."""
