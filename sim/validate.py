"""python -m sim.validate: thousands of random hands on the loop."""

if __name__ == "__main__":
    from cli.options import execute
    from cli.validate import main

    execute(main)
