"""python -m design.limits: how good any linear coupling could be."""

if __name__ == "__main__":
    from cli.compare import main
    from cli.options import execute

    execute(main)
