"""python -m design.plot: couplings over frequency."""

if __name__ == "__main__":
    from cli.compare import main_plot
    from cli.options import execute

    execute(main_plot)
