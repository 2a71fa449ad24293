"""python -m hw.bridge: run a session with a device; the command is cli/bridge.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("bridge")
