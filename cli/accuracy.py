"""python -m sim.accuracy: measure cost and error of each engine on the same run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from haptic_loop.cli import options, render
from haptic_loop.cli.verdict import chosen_by
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.sim.accuracy import Row, default_substeps, measure_all
from haptic_loop.sim.couplings import NAMES, assessed
from haptic_loop.sim.engines import EXPONENTIAL
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import InputError, require_even_ticks, require_linear, require_no_world

_MOST_STEPS = 3_000_000  # most steps of a run with RK4 at its default substeps; all runs then take ten minutes
_LEGEND = (
    "position: relative rms error; growth: the larger error [1/s] of two growth rates, with and without coupling",
    "cycle: standard deviation [N] and frequency [Hz] of the limit cycle without coupling, if there is one",
    "real: simulated seconds per second; *: right, and no setting of its engine is better in speed and both errors",
)


@dataclass(frozen=True)
class _Report:
    """Speed and errors of each setting of every engine, on one loop."""

    case: str
    scenario: str
    coupling: str
    default_substeps: int
    rows: list[Row]
    skipped: list[str]
    interrupted: bool


def main(argv: list[str]) -> int:
    """Measure every engine. Return 0 if the default settings have the right verdicts, 1 if not, 130 if interrupted."""
    args = _parser().parse_args(argv)
    scenario = options.scenario_from(args)
    require_no_world(scenario, "sim.accuracy")
    require_linear(scenario, "sim.accuracy")
    require_even_ticks(scenario, "sim.accuracy")
    if args.duration is not None:
        scenario = scenario.replace(duration=args.duration)
    out = options.out_folder(args, "accuracy")
    chosen = chosen_by(args, scenario)
    rho = assessed(scenario, args.case, chosen, limiter=args.limiter).force_limits.rho
    coupled, uncoupled = assemble(scenario, chosen.coupling, rho), assemble(scenario, NoCoupling())
    default = max(default_substeps(loop, "RK4") for loop in (coupled, uncoupled))
    if scenario.samples * default > _MOST_STEPS:
        longest = _MOST_STEPS // default * scenario.T
        raise InputError(f"--duration is too long for RK4 with {default} substeps a tick: give at most {longest:.3g} s")
    with render.progress("measuring") as move:
        measured = measure_all(coupled, uncoupled, default, move)
    report = _Report(args.case, scenario.name, chosen.kind, default, *measured)
    files = render.pictures(args, report.rows, out, {"accuracy.png": "plot_accuracy"}, bool(report.rows))
    table = render.columns(f"speed against error · {scenario.title(args.case)}, {chosen.kind}", _CELLS, report.rows)
    lines = [*(f"not measured: {reason}" for reason in report.skipped), *_LEGEND]
    defaults = ((EXPONENTIAL, 1), ("RK4", default))
    judged = [row.verdict_correct for row in report.rows if (row.integrator, row.substeps) in defaults]
    right = all(judged)
    verdict = None if report.interrupted else _verdict(judged, report.rows)
    render.publish(args, report, [table], lines, out, files, verdict)
    return options.exit_code(right, report.interrupted)


def _verdict(judged: Sequence[bool], rows: Sequence[Row]) -> str:
    """State whether the default settings have the right verdicts.

    `judged` has an entry for each default setting that was measured: whether its verdicts are right.
    """
    which = ("No default was measured", "The default that was measured judges", "The defaults judge")[len(judged)]
    words = f"{which} stability as the exact engine does" if judged else which
    words = words if all(judged) else "A DEFAULT JUDGES STABILITY WRONGLY"
    for row in rows:
        if (row.integrator, row.substeps) == (EXPONENTIAL, 1):
            position = render.optional(row.position_relative_rms, "{:.1e}", "unknown")
            words += f"; errors of exponential x 1: position {position}, growth {row.growth_rate_error:+.1e} 1/s"
    return f"{words}."


def _parser() -> options.Parser:
    two = "python -m sim.accuracy --scenario three-rigid --coupling none"
    parser = options.Parser(
        "sim.accuracy",
        "Compare speed and error of the engines.",
        "python -m sim.accuracy --duration 5",
        two,
        first="scenario coupling condition reference duration json",
    )
    parser.add_loop()
    parser.add_coupling(", ".join(NAMES))
    parser.add_limiter()
    duration = "length of each run (default: the scenario's)"
    parser.add_argument("--duration", type=options.number(), metavar="SECONDS", help=duration)
    parser.add_output(picture=True, seed=False)
    return parser


def _name(row: Row) -> str:
    setting = f"{row.integrator} x {row.substeps}" if row.integrator else row.engine
    return setting + (" *" if row.pareto else "")


_CELLS: dict[str, str | Callable[[Row], str]] = {
    "setting": _name,
    "position": lambda r: render.optional(r.position_relative_rms, "{:.1e}"),
    "growth": "{r.growth_rate_error:+.1e}",
    "verdict": lambda r: "right" if r.verdict_correct else "[red]WRONG[/]",
    "cycle N": lambda r: render.optional(r.cycle_deviation_n, "{:.4f}"),
    "Hz": lambda r: render.optional(r.cycle_frequency_hz, "{:.3f}"),
    "real": lambda r: f"{1 / r.wall_s_per_simulated_s:.0f}",
}
