"""python -m sim.view: the live window."""

if __name__ == "__main__":
    from cli.main import door

    door("view")
