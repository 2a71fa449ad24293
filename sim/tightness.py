"""python -m sim.tightness: how tight the condition is."""

if __name__ == "__main__":
    from cli.options import execute
    from cli.suite import run_tightness

    execute(run_tightness)
