"""python -m sim.hard: numerically hard loops."""

if __name__ == "__main__":
    from cli.hard import main
    from cli.options import execute

    execute(main)
