"""python -m sim.tightness: how much damping too little is it before somebody makes the loop oscillate?

The devices of each loop get a share less damping than the closed-loop condition requires, and the adversary searches
for a passive human who destabilises it. Where it succeeds close to the required damping, the condition is tight;
with the damping that is required it must never succeed.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from controller.coupling import Coupling, NoCoupling
from design.assess import CONDITIONS
from design.margin import closed_loop
from design.promises import finite
from sim.adversary import Attempt, attempts
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    numbers,
    out_folder,
    progress_bar,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES, choose
from sim.files import write_json
from sim.scenario import InputError, Scenario
from sim.simulate import assemble

SHORT = "0,1,2,5,10,20"  # [%]
Row = dict[str, Any]
Loops = dict[str, tuple[Scenario, Coupling]]


def main(argv: list[str]) -> int:
    """Attack loops that lack damping. 0: nobody destabilises one that lacks none, 1: somebody, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario, seed, shortages = scenario_from(args), seed_from(args), _shortages(args)
    (generations,) = numbers("--generations", args.generations, int, 1)
    if not 1 <= generations <= 10_000:
        raise InputError(f"--generations is {generations}, allowed are 1 to 10000")
    out = out_folder(args, "tightness")
    loops = _loops(args, scenario)
    rows, interrupted = _attack(loops, shortages, seed, generations)
    outcome: dict[str, Any] = {"scenario": scenario.name, "case": args.case, "seed": seed, "generations": generations}
    outcome |= {"rows": rows, "rates": _rates(rows), "interrupted": interrupted}
    outcome["holds"] = not any(row["found"] for row in rows if row["short"] <= 0)
    outcome["files"] = _save(args, out, outcome)
    _print(outcome, args)
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser(
        "sim.tightness",
        "Search destabilising humans for loops that lack a share of their required damping.",
        "python -m sim.tightness --short 0,5,10 --generations 30",
    )
    add_loop_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json, beside the loop without one")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition of the design")
    parser.add_argument("--short", default=SHORT, metavar="P,P,..", help=f"[%%] of damping missing (default {SHORT})")
    parser.add_argument("--generations", default="40", metavar="N", help="of each search (default 40)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _shortages(args: argparse.Namespace) -> list[float]:
    """Shares of the required damping that are missing. Raises InputError."""
    shares = numbers("--short", args.short, float, args.short.count(",") + 1)
    for share in shares:
        if not 0 <= share < 100:
            raise InputError(f"--short is {share:g}, allowed are 0 to below 100 (per cent)")
    return [share / 100 for share in shares]


def _loops(args: argparse.Namespace, scenario: Scenario) -> Loops:
    """The loop without coupling, and the one that was asked for. Raises InputError where no damping helps one."""
    loops: Loops = {"no coupling": (scenario, NoCoupling())}
    if args.case != "none":
        chosen = choose(scenario, args.case, args.coupling, args.condition)
        loops[f"{chosen.kind}, case {args.case}"] = (scenario, chosen.coupling)
    for name, (_, coupling) in loops.items():
        requirement = closed_loop(assemble(scenario, coupling).F, scenario.delta)
        if not np.isfinite(requirement.ratio):
            raise InputError(f"{name}: no damping is enough ({requirement.reason}), so none can be short of it")
    return loops


def _attack(loops: Loops, shortages: list[float], seed: int, generations: int) -> tuple[list[Row], bool]:
    rows: list[Row] = []
    with (bar := progress_bar("attacking"))[0]:

        def attempted(attempt: Attempt) -> None:
            rows.append(_row(attempt))
            bar[1](len(rows), len(loops) * len(shortages))

        try:
            attempts(loops, np.array(shortages), seed, generations, attempted)
        except KeyboardInterrupt:
            return rows, True
    return rows, False


def by_whom(row: Row) -> str:
    """Who destabilises a loop."""
    if not row["found"]:
        return "nobody"
    return "one person" if row["held_together"] else "one hand each"


def _row(attempt: Attempt) -> Row:
    worst = attempt.worst
    return {
        "loop": attempt.name,
        "short": attempt.short,
        "found": worst.destabilises,
        "growth_rate_per_s": finite(worst.growth),
        "frequency_hz": worst.frequency_hz,
        "held_together": bool(worst.persons),
        "evaluated": worst.evaluated,
    }


def _rates(rows: list[Row]) -> list[Row]:
    """Share of the loops that somebody destabilises, by shortage."""
    parts = {short: [row["found"] for row in rows if row["short"] == short] for short in {r["short"] for r in rows}}
    return [{"short": s, "attempts": len(found), "rate": sum(found) / len(found)} for s, found in sorted(parts.items())]


def _save(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[str]:
    files = [out / "report.json"]
    if not args.no_plot and outcome["rows"]:
        from sim.plot import plot_tightness

        files.append(plot_tightness(outcome["rows"], out / "tightness.png"))
    write_json(files[0], outcome | {"files": [str(path) for path in files]})
    return [str(path) for path in files]


def _print(outcome: dict[str, Any], args: argparse.Namespace) -> None:
    table = Table(title=f"damping missing, and who notices · {outcome['scenario']}")
    for name in ("loop", "short of required", "destabilised by", "growth [1/s]", "at [Hz]"):
        table.add_column(name, justify="left" if name == "loop" else "right")
    for row in outcome["rows"]:
        found = f"{row['growth_rate_per_s']:+.3g}" if row["found"] else "-"
        at = f"{row['frequency_hz']:.1f}" if row["found"] else "-"
        table.add_row(row["loop"], f"{row['short']:.1%}", by_whom(row), found, at)
    console(args).print(table)


if __name__ == "__main__":
    execute(main)
