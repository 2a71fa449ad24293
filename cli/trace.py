"""python -m sim.trace: what a stored trace of sim.run or hw.bridge shows: its picture, and what grows in it."""

from __future__ import annotations

from pathlib import Path

from cli import options, render
from design.files import check_file
from sim.scenario import InputError
from sim.trace import Trace, format_growth, growths

_ZOOM_HZ = 10.0  # the picture shows six periods of it where nothing oscillates


def main(argv: list[str]) -> int:
    """Look at a trace. 0: done, whatever it shows."""
    args = _parser().parse_args(argv)
    if args.plot is not None:
        check_file("--plot", Path(args.plot))
    options.check_json(args)
    result = Trace.load_npz(Path(args.trace))
    found = growths(result)
    if not result.t.size:
        raise InputError(f"{args.trace}: it has no ticks")
    outcome = {
        "trace": args.trace,
        "ticks": result.t.size,
        "duration_s": float(result.t[-1]),
        "growth": [one.part() for one in found],
    }
    if args.plot:
        from sim.plots import plot_run

        strongest = next((one.frequency_hz for one in found if one.frequency_hz), _ZOOM_HZ)
        plot_run(result, Path(args.plot), args.trace, strongest)
    T = float(result.t[-1]) / max(1, result.t.size - 1)
    lines = [f"growth, {format_growth(part, T)}" for part in outcome["growth"]]
    render.publish(args, outcome, (), lines or ["no loop was closed at full gain: there is no growth to report"])
    return options.DONE


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.trace",
        "Growth of the oscillations in a stored trace, from its displacements alone, and its picture.",
        "python -m sim.trace out/bridge-I/trace.npz --plot figure.png",
    )
    parser.add_argument("trace", metavar="TRACE.npz", help="written by sim.run or hw.bridge")
    parser.add_argument("--plot", metavar="FILE.png", help="draw the trace")
    options.add_json_option(parser)
    return parser
