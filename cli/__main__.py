"""python -m cli: the command haptic-loop."""

from haptic_loop.cli.main import main

if __name__ == "__main__":
    main()
