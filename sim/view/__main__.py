"""python -m sim.view: the live window."""

if __name__ == "__main__":
    from haptic_loop.cli.main import run_command

    run_command("view")
