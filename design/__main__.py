"""python -m design: design a coupling, prove it, store it."""

if __name__ == "__main__":
    from cli.design import main
    from cli.options import execute

    execute(main)
