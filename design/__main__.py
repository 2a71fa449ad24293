"""python -m design: design a coupling, prove it, store it."""

if __name__ == "__main__":
    from cli.main import door

    door("design")
