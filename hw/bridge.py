"""python -m hw.bridge: a session with a device over a serial port; the command is cli/bridge.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import door

    door("bridge")
