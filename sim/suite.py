"""python -m sim.suite: every check that a verdict rests on; the command is cli/suite.py."""

if __name__ == "__main__":
    from haptic_loop.cli.main import door

    door("suite")
