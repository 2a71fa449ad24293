"""python -m sim.hunt: does switching contact destabilise a loop whose every frozen contact state is certified?

The loops, the hands and the criterion are those of sim/hunt/search.py.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_output_options,
    check_json,
    console,
    numbers,
    progress_bar,
    seed_from,
)
from sim.files import folder, write_json
from sim.hunt import LENGTHS, Found, attack, draw
from sim.scenario import InputError


def main(argv: list[str]) -> int:
    """Search. 0: no counterexample among the draws, 1: at least one, 130: interrupted."""
    args = _parser().parse_args(argv)
    draws, hands = (_whole(args, name) for name in ("draws", "hands"))
    (seconds,) = numbers("--duration", args.duration, float, 1)
    if not 0.5 <= seconds <= 1000:
        raise InputError(f"--duration is {seconds:g}, allowed are 0.5 to 1000 s")
    seed = seed_from(args)
    check_json(args)
    out = folder(Path(args.out or "out/hunt"))
    results, drawn, interrupted, begin = [], 0, False, time.perf_counter()
    bar, move = progress_bar("hunting")
    with bar:
        try:
            for index in range(draws):
                move(index, draws)
                case = draw(seed, index)
                if case:
                    results.append(attack(case, index, seed, hands, seconds))
                drawn += 1
        except KeyboardInterrupt:
            interrupted = True
    outcome = _outcome(results, drawn, hands, seconds, seed) | {"interrupted": interrupted}
    outcome["wall_s"] = time.perf_counter() - begin
    outcome["files"] = [str(out / "report.json")]
    write_json(out / "report.json", outcome)
    _print(outcome, args)
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    return DONE if not outcome["counterexamples"] else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser(
        "sim.hunt",
        "Search loops whose frozen contact states are all certified for one that contact keeps in motion.",
        "python -m sim.hunt --draws 200 --hands 100",
    )
    parser.add_argument("--draws", default="20", metavar="N", help="random loops (default 20)")
    parser.add_argument("--hands", default="50", metavar="N", help="lossless hands and starts for each (default 50)")
    parser.add_argument("--duration", default="4", metavar="SECONDS", help="of the first run (default 4)")
    add_output_options(parser, what="folder for report.json (default out/hunt)")
    return parser


def _whole(args: argparse.Namespace, name: str) -> int:
    (value,) = numbers(f"--{name}", getattr(args, name), int, 1)
    if not 1 <= value <= 1_000_000:
        raise InputError(f"--{name} is {value}, allowed are 1 to 1000000")
    return value


def _outcome(results: list[Found], draws: int, hands: int, seconds: float, seed: int) -> dict[str, Any]:
    ordered = sorted(results, key=lambda found: (len(found.ratio), found.ratio[-1]), reverse=True)
    return {
        "seed": seed,
        "draws": draws,
        "hands": hands,
        "duration_s": seconds,
        "searched": len(results),
        "counterexamples": sum(found.counterexample for found in results),
        "runs": [sum(len(found.ratio) > i for found in results) for i in range(len(LENGTHS))],
        "strongest": [_part(found) for found in ordered[:5]],
    }


def _part(found: Found) -> dict[str, Any]:
    scenario, coupling = found.case.scenario, found.case.coupling
    return {
        "index": found.index,
        "counterexample": found.counterexample,
        "speed_ratio": list(found.ratio),
        "contacts_last_quarter": list(found.made),
        "theorem4_required_over_available": found.case.theorem4,
        "coupling": {"K": coupling.K.tolist(), "B": coupling.B.tolist()},
        "theta": list(scenario.theta),
        "device": msgspec.to_builtins(scenario.device[0]),
        "environment": msgspec.to_builtins(scenario.environment),
        "hand": {"mass": float(found.hand[0]), "damping": 0.0, "stiffness": float(found.hand[1])},
        "start": {"position_m": float(found.start[0]), "velocity_m_per_s": float(found.start[1])},
    }


def _print(outcome: dict[str, Any], args: argparse.Namespace) -> None:
    table = Table(title="contact that makes and breaks, every frozen state certified", show_header=False)
    table.add_row("loops drawn", f"{outcome['draws']}, of which {outcome['searched']} are not certified by theorem4")
    table.add_row("hands for each", f"{outcome['hands']}, lossless, seed {outcome['seed']}")
    seconds = outcome["duration_s"]
    lengths = ", ".join(f"{seconds * n:g}" for n in LENGTHS)
    table.add_row(f"loops run for {lengths} s", ", ".join(map(str, outcome["runs"])))
    found = outcome["counterexamples"]
    table.add_row("counterexamples", f"[red]{found}[/]" if found else "[green]none found[/]")
    for part in outcome["strongest"][:3]:
        ratios = ", ".join(f"{ratio:.4g}" for ratio in part["speed_ratio"])
        table.add_row(f"loop {part['index']}, last over second speed", ratios)
    screen = console(args)
    screen.print(table)
    screen.print(f"[dim]·[/] {outcome['wall_s']:.0f} s. None found is no proof; theorem4 is one.")
