"""python -m design.check: prove a stored coupling again."""

if __name__ == "__main__":
    from cli.check import main
    from cli.options import execute

    execute(main)
