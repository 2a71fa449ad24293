"""python -m design.check: prove a stored coupling again."""

if __name__ == "__main__":
    from cli.main import door

    door("check")
