"""python -m sim.view: the live window."""

if __name__ == "__main__":
    from haptic_loop.cli.main import door

    door("view")
