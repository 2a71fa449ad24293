"""python -m sim.suite: every check that a verdict rests on."""

if __name__ == "__main__":
    from cli.options import execute
    from cli.suite import main

    execute(main)
