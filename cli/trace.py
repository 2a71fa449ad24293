"""python -m sim.trace: draw a stored trace of sim.run or hw.bridge, and measure the growth of its oscillations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from haptic_loop.cli import options, render
from haptic_loop.controller.units import set_unit_of
from haptic_loop.design.files import check_file
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.trace import Growth, Trace, growths

_ZOOM_HZ = 10.0  # frequency of the picture's zoom if nothing oscillates


@dataclass(frozen=True)
class _Traced:
    trace: str
    ticks: int
    duration_s: float
    growth: list[Growth]


def main(argv: list[str]) -> int:
    """Analyse a trace. Return 0, whatever the result."""
    args = _parser().parse_args(argv)
    if args.plot is not None:
        check_file("--plot", Path(args.plot))
    result = Trace.load_npz(Path(args.trace))
    set_unit_of(result.meta)
    rates = growths(result)
    if not result.t.size:
        raise InputError(f"{args.trace}: it has no ticks")
    if args.plot:
        from haptic_loop.sim.plots import draw_run, save

        shown = next((one.frequency_hz for one in rates if one.frequency_hz), _ZOOM_HZ)
        save(draw_run(result.signals, args.trace, shown), Path(args.plot))
    traced = _Traced(args.trace, result.t.size, float(result.t[-1]), rates)
    T = traced.duration_s / max(1, traced.ticks - 1)
    lines = [f"growth, {one.words(T)}" for one in rates]
    none = "The trace has no part with a linear loop and full gain: there is no growth to report."
    render.publish(args, traced, (), lines, verdict=_verdict(rates) if rates else none)
    return options.DONE


def _verdict(growths: list[Growth]) -> str:
    rates = [one for one in growths if one.trend]
    if not rates:
        return "No growth rate can be given."
    words = {
        "decays": "All oscillations decay",
        "neither": "An oscillation neither grows nor decays",
        "grows": "An oscillation grows",
    }
    order = [*words]
    worst = max(rates, key=lambda one: (order.index(one.trend or ""), one.growth_rate_per_s or 0.0))
    return f"{words[worst.trend or '']}: {worst.growth_rate_per_s:+.4g} 1/s."


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.trace",
        "Measure how oscillations grow in a stored trace, from its displacements alone; with --plot draw it, too.",
        "python -m sim.trace out/bridge-I/trace.npz",
        "python -m sim.trace out/bridge-I/trace.npz --plot figure.png",
    )
    parser.add_argument("trace", metavar="TRACE.npz", help="written by sim.run or hw.bridge")
    parser.add_argument("--plot", metavar="FILE.png", help="draw the trace")
    parser.add_json()
    return parser
