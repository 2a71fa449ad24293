"""python -m sim.accuracy: what each engine costs and how wrong it is, every row's error and cost from the same run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.table import Table

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    numbers,
    out_folder,
    progress_bar,
    require_linear,
    scenario_from,
    seed_from,
)
from controller.coupling import NoCoupling
from design.certificate import CONDITIONS
from sim.accuracy import SETTINGS, Row, mark_front, measure, reference
from sim.couplings import NAMES, choose
from sim.files import write_json
from sim.run import Assembly, assemble
from sim.scenario import InputError
from sim.stability import NEUTRAL, default_substeps, step_radius


def main(argv: list[str]) -> int:
    """Measure every engine and step. 0: the default has the right verdict, 1: not, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = scenario_from(args)
    require_linear(scenario, "sim.accuracy")
    if args.duration is not None:
        scenario = scenario.replace(duration=numbers("--duration", args.duration, float, 1)[0])
    seed, out = seed_from(args), out_folder(args, "accuracy")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    coupled, uncoupled = assemble(scenario, chosen.coupling), assemble(scenario, NoCoupling())
    default = max(default_substeps(coupled), default_substeps(uncoupled))

    rows, skipped, interrupted = _rows(coupled, uncoupled, default)
    mark_front(rows)
    outcome: dict[str, Any] = {"case": args.case, "scenario": scenario.name, "coupling": chosen.kind, "seed": seed}
    outcome |= {"default_substeps": default, "rows": rows, "skipped": skipped, "interrupted": interrupted}
    outcome["files"] = _save(args, out, outcome)
    _print(outcome, args)
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    right = all(r["verdict_correct"] for r in rows if r["integrator"] == "RK4" and r["substeps"] == default)
    return DONE if right else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser("sim.accuracy", "Speed against error, engine by engine.", "python -m sim.accuracy --duration 5")
    add_loop_options(parser)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{', '.join(NAMES)} or FILE.json")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition of the design")
    parser.add_argument("--duration", metavar="SECONDS", help="of each run (default: the scenario's)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _rows(coupled: Assembly, uncoupled: Assembly, default: int) -> tuple[list[Row], list[str], bool]:
    """Rows of every setting that is stable on this plant and the reasons of those that are not."""
    rows: list[Row] = []
    skipped: list[str] = []
    settings = list(dict.fromkeys((*SETTINGS, ("mujoco", "RK4", default))))
    bar, move = progress_bar("measuring")
    with bar:
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


def _save(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[str]:
    files = [out / "report.json"]
    if not args.no_plot and outcome["rows"]:
        from sim.plots import plot_accuracy

        files.append(plot_accuracy(outcome["rows"], out / "accuracy.png"))
    write_json(files[0], outcome | {"files": [str(p) for p in files]})
    return [str(p) for p in files]


def _print(outcome: dict[str, Any], args: argparse.Namespace) -> None:
    table = Table(title=f"speed against error · {outcome['scenario']}, case {outcome['case']}, {outcome['coupling']}")
    for i, name in enumerate(("setting", "position", "growth", "verdict", "cycle N", "Hz", "real")):
        table.add_column(name, justify="left" if i == 0 else "right", no_wrap=True)
    for row in outcome["rows"]:
        name = f"{row['integrator']} x {row['substeps']}" if row["integrator"] else row["engine"]
        table.add_row(
            name + (" *" if row["pareto"] else ""),
            _figure(row["position_relative_rms"], ".1e"),
            _figure(row["growth_rate_error"], "+.1e"),
            "right" if row["verdict_correct"] else "[red]WRONG[/]",
            _figure(row["cycle_amplitude_n"], ".4f"),
            _figure(row["cycle_frequency_hz"], ".3f"),
            f"{1 / row['wall_s_per_simulated_s']:.0f}",
        )
    screen = console(args)
    screen.print(table)
    for reason in outcome["skipped"]:
        screen.print(f"[dim]·[/] not measured: {reason}")
    for line in (
        "position: relative rms error; growth: error [1/s], the larger of the loop with and without the coupling",
        "cycle: standard deviation [N] and frequency of the limit cycle without coupling, once it is sustained",
        "real: simulated seconds per second; * nothing of the same kind is both faster and nearer",
    ):
        screen.print(f"[dim]·[/] {line}")


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
