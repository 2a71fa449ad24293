"""The serial link: protocol, device state machine, bridge and emulator."""
