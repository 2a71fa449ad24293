"""The serial link: protocol, device state machine, bridge and emulator."""

import sim  # noqa: F401 - first, for Ctrl-C while a command of this package starts
