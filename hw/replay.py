"""python -m hw.replay: feed a recorded session through the controller again; the command is cli/replay.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("replay")
