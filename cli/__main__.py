"""python -m cli: the same as haptic-loop."""

from haptic_loop.cli.main import main

if __name__ == "__main__":
    main()
