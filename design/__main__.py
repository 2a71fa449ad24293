"""python -m design: design a coupling, prove it, store it; the command is cli/design.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("design")
