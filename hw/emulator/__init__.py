"""python -m hw.emulator: a device that is not there."""
