"""Sessions with real and emulated devices: protocol, safety limits, measurements and reports."""
