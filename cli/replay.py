"""python -m hw.replay: feed a recorded session through the controller and compare the forces bit by bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.controller.units import set_unit_of
from haptic_loop.hw.recording import load, replay


@dataclass(frozen=True)
class _Compared:
    trace: str = render.figure("trace")
    ticks: int = render.figure("ticks")
    filled_in: int = render.figure("ticks without a STATE")
    asked_differ: int = render.figure("requested forces that differ")
    sent_differ: int = render.figure("sent forces that differ")
    largest_difference_n: float = render.figure("largest difference of requested forces [N]")
    first_difference_s: float | None = render.figure("first difference [s]")
    identical: bool = render.figure("identical", lambda same: "yes, bit by bit" if same else "no")


def main(argv: list[str]) -> int:
    """Replay a trace. Return 0 if every force equals the recorded one bit by bit, 1 if not."""
    parser = options.Parser(
        "hw.replay",
        "Feed a recorded session through the controller again and compare the forces bit by bit.",
        "python -m hw.replay out/bridge-I/trace.npz",
        "python -m hw.replay out/bridge-I/trace.npz --json -",
    )
    parser.add_argument("trace", metavar="TRACE.npz", help="written by hw.bridge")
    parser.add_json()
    args = parser.parse_args(argv)
    result, link = load(Path(args.trace))
    set_unit_of(result.meta)
    compared = replay(result, link)
    different = compared.asked | compared.sent
    report = _Compared(
        trace=args.trace,
        ticks=result.t.size,
        filled_in=result.t.size - int(link["received"].sum()),
        asked_differ=int(compared.asked.sum()),
        sent_differ=int(compared.sent.sum()),
        largest_difference_n=compared.largest,
        first_difference_s=float(result.t[np.argmax(different)]) if different.any() else None,
        identical=compared.identical,
    )
    verdict = f"All {report.ticks} ticks give the recorded forces, bit by bit."
    if not compared.identical:
        verdict = (
            f"Not identical: forces of {int(different.sum())} of {report.ticks} ticks differ from the recorded forces."
        )
    render.publish(args, report, [render.facts(args.trace, render.rows_of(report))], verdict=verdict)
    return options.exit_code(compared.identical)
