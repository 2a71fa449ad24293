"""python -m sim.view: the live window."""

if __name__ == "__main__":
    from cli.options import execute
    from cli.view import main

    execute(main)
