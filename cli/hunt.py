"""python -m sim.hunt: does switching contact destabilise a loop whose every frozen contact state is certified?

The loops, the hands and the criterion are those of sim/hunt.py.
"""

from __future__ import annotations

import time
from typing import Any

import msgspec

from cli import options, render
from sim.hunt import LENGTHS, Found, attack, draw


def main(argv: list[str]) -> int:
    """Search. 0: no counterexample among the draws, 1: at least one, 130: interrupted."""
    args = _parser().parse_args(argv)
    out = options.out_folder(args, "hunt")
    results, drawn, interrupted, begin = [], 0, False, time.perf_counter()
    with render.progress("hunting") as move:
        try:
            for index in range(args.draws):
                move(index, args.draws)
                case = draw(args.seed, index)
                if case:
                    results.append(attack(case, index, args.seed, args.hands, args.duration))
                drawn += 1
        except KeyboardInterrupt:
            interrupted = True
    outcome = _outcome(results, drawn, args.hands, args.duration, args.seed) | {"interrupted": interrupted}
    outcome["wall_s"] = time.perf_counter() - begin
    table = render.facts("contact that makes and breaks, every frozen state certified", _rows(outcome))
    lines = [f"{outcome['wall_s']:.0f} s. None found is no proof; the any-environment condition is one."]
    render.publish(args, outcome, [table], lines, out)
    if interrupted:
        return options.INTERRUPTED
    return options.DONE if not outcome["counterexamples"] else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.hunt",
        "Search loops whose frozen contact states are all certified for one that contact keeps in motion.",
        "python -m sim.hunt --draws 200 --hands 100",
    )
    count, hands = options.whole(1, 1_000_000), "lossless hands and starts for each (default 50)"
    parser.add_argument("--draws", type=count, default=20, metavar="N", help="random loops (default 20)")
    parser.add_argument("--hands", type=count, default=50, metavar="N", help=hands)
    seconds = options.number(0.5, 1000, "s")
    parser.add_argument("--duration", type=seconds, default=4.0, metavar="SECONDS", help="of the first run (default 4)")
    options.add_output_options(parser, what="folder for report.json (default out/hunt)")
    return parser


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
        "theorem4_required_over_available": found.case.any_environment,
        "coupling": {"K": coupling.K.tolist(), "B": coupling.B.tolist()},
        "theta": list(scenario.theta),
        "device": msgspec.to_builtins(scenario.device[0]),
        "environment": msgspec.to_builtins(scenario.environment),
        "hand": {"mass": float(found.hand[0]), "damping": 0.0, "stiffness": float(found.hand[1])},
        "start": {"position_m": float(found.start[0]), "velocity_m_per_s": float(found.start[1])},
    }


def _rows(outcome: dict[str, Any]) -> list[tuple[str, str]]:
    lengths = ", ".join(f"{outcome['duration_s'] * n:g}" for n in LENGTHS)
    found = outcome["counterexamples"]
    drawn = f"{outcome['draws']}, of which {outcome['searched']} are not certified for any environment"
    return [
        ("loops drawn", drawn),
        ("hands for each", f"{outcome['hands']}, lossless, seed {outcome['seed']}"),
        (f"loops run for {lengths} s", ", ".join(map(str, outcome["runs"]))),
        ("counterexamples", f"[red]{found}[/]" if found else "[green]none found[/]"),
        *(
            (f"loop {part['index']}, last over second speed", ", ".join(f"{r:.4g}" for r in part["speed_ratio"]))
            for part in outcome["strongest"][:3]
        ),
    ]
