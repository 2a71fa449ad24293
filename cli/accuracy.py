"""python -m sim.accuracy: what each engine costs and how wrong it is, every row's error and cost from the same run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cli import options, render
from controller.coupling import NoCoupling
from sim.accuracy import SETTINGS, Row, mark_front, measure, reference
from sim.couplings import NAMES, choose, limits_of
from sim.mujoco_engines import EXPONENTIAL
from sim.run import Simulation, assemble
from sim.scenario import InputError, require_even_ticks, require_linear
from sim.step_choice import NEUTRAL, default_substeps, step_radius

_MOST_STEPS = 3_000_000  # of a row: a minute or two
_HEADS = ("setting", "position", "growth", "verdict", "cycle N", "Hz", "real")
_LEGEND = (
    "position: relative rms error; growth: error [1/s], the larger of the loop with and without the coupling",
    "cycle: standard deviation [N] and frequency of the limit cycle without coupling, once it is sustained",
    "real: simulated seconds per second; * nothing of the same kind is both faster and nearer",
)


def main(argv: list[str]) -> int:
    """Measure every engine and step. 0: the default has the right verdict, 1: not, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = options.scenario_from(args)
    require_linear(scenario, "sim.accuracy")
    require_even_ticks(scenario, "sim.accuracy")
    if args.duration is not None:
        scenario = scenario.replace(duration=args.duration)
    out = options.out_folder(args, "accuracy")
    with render.designing(scenario.loop(args.case), args.coupling, args.condition) as heard:
        chosen = choose(scenario, args.case, args.coupling, args.condition, args.limiter, heard)
    lag = limits_of(scenario, chosen, limiter=args.limiter).rho
    coupled, uncoupled = assemble(scenario, chosen.coupling, lag), assemble(scenario, NoCoupling())
    default = max(default_substeps(loop, "RK4") for loop in (coupled, uncoupled))

    if scenario.samples * default > _MOST_STEPS:
        longest = _MOST_STEPS // default * scenario.T
        raise InputError(f"--duration: RK4 needs {default} steps a tick here; allowed are up to {longest:.3g} s")
    rows, skipped, interrupted = _rows(coupled, uncoupled, default)
    mark_front(rows)
    outcome: dict[str, Any] = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": chosen.kind,
        "seed": args.seed,
        "default_substeps": default,
        "rows": rows,
        "skipped": skipped,
        "interrupted": interrupted,
    }
    title = f"speed against error · {scenario.title(args.case)}, {chosen.kind}"
    table = render.grid(title, _HEADS, map(_cells, rows))
    lines = [*(f"not measured: {reason}" for reason in skipped), *_LEGEND]
    render.publish(args, outcome, [table], lines, out, _picture(args, rows, out))
    if interrupted:
        return options.INTERRUPTED
    defaults = ((EXPONENTIAL, 1), ("RK4", default))
    right = all(r["verdict_correct"] for r in rows if (r["integrator"], r["substeps"]) in defaults)
    return options.DONE if right else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    example = "python -m sim.accuracy --duration 5"
    parser = options.Parser("sim.accuracy", "Speed against error, engine by engine.", example)
    options.add_loop_options(parser)
    options.add_coupling_options(parser, ", ".join(NAMES))
    options.add_limiter_option(parser)
    duration = "of each run (default: the scenario's)"
    parser.add_argument("--duration", type=options.number(), metavar="SECONDS", help=duration)
    options.add_output_options(parser, picture=True)
    return parser


def _rows(coupled: Simulation, uncoupled: Simulation, default: int) -> tuple[list[Row], list[str], bool]:
    """Rows of every setting that is stable on this plant and the reasons of those that are not."""
    rows: list[Row] = []
    skipped: list[str] = []
    settings = list(dict.fromkeys((*SETTINGS, ("mujoco", "RK4", default))))
    with render.progress("measuring") as move:
        try:
            truth = reference(coupled, uncoupled)
            for done, (engine, integrator, substeps) in enumerate(settings):
                move(done, len(settings))
                try:
                    if integrator and substeps and step_radius(coupled, integrator, substeps) > 1 + NEUTRAL:
                        raise InputError("outside the stable region")
                    rows.append(measure(truth, engine, integrator, substeps))
                except ValueError as error:
                    skipped.append(f"{integrator} x {substeps}: {error}")
        except KeyboardInterrupt:
            return rows, skipped, True
    return rows, skipped, False


def _picture(args: argparse.Namespace, rows: list[Row], out: Path) -> list[Path]:
    if args.no_plot or not rows:
        return []
    from sim.plots import plot_accuracy

    return [plot_accuracy(rows, out / "accuracy.png")]


def _cells(row: Row) -> tuple[str, ...]:
    name = f"{row['integrator']} x {row['substeps']}" if row["integrator"] else row["engine"]
    return (
        name + (" *" if row["pareto"] else ""),
        render.optional(row["position_relative_rms"], "{:.1e}"),
        render.optional(row["growth_rate_error"], "{:+.1e}"),
        "right" if row["verdict_correct"] else "[red]WRONG[/]",
        render.optional(row["cycle_amplitude_n"], "{:.4f}"),
        render.optional(row["cycle_frequency_hz"], "{:.3f}"),
        f"{1 / row['wall_s_per_simulated_s']:.0f}",
    )
