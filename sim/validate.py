"""python -m sim.validate: thousands of random hands on the loop (sim.crowds); the command is cli/validate.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("validate")
