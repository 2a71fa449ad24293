"""python -m hw.replay: a recorded session through the controller again, and the forces compared bit by bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cli import render
from cli.options import DOES_NOT_HOLD, DONE, Parser, check_json
from hw.recording import load, replay


@dataclass(frozen=True)
class _Compared:
    """The machine-readable result."""

    trace: str = render.figure("trace")
    ticks: int = render.figure("ticks")
    filled_in: int = render.figure("without an answer")
    asked_differ: int = render.figure("other forces asked for")
    sent_differ: int = render.figure("other forces sent")
    largest_difference_n: float = render.figure("largest difference [N]")
    first_difference_s: float | None = render.figure("first difference [s]")
    identical: bool = render.figure("identical", lambda same: "yes, bit by bit" if same else "no")


def main(argv: list[str]) -> int:
    """Replay a trace. 0: every force is the recorded one bit by bit, 1: not."""
    parser = Parser(
        "hw.replay",
        "Feed a recorded session through the controller again and compare the forces bit by bit.",
        "python -m hw.replay out/bridge-I/trace.npz",
    )
    parser.add_argument("trace", metavar="TRACE.npz", help="written by hw.bridge")
    parser.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    args = parser.parse_args(argv)
    check_json(args)
    result, link = load(Path(args.trace))
    compared = replay(result, link)
    ticks, received = result.t.size, int(link["received"].sum())
    different = compared.asked | compared.sent
    compared_ticks = _Compared(
        args.trace,
        ticks,
        ticks - received,
        int(compared.asked.sum()),
        int(compared.sent.sum()),
        compared.largest,
        float(result.t[np.argmax(different)]) if different.any() else None,
        compared.identical,
    )
    render.publish(args, render.plain(compared_ticks), [render.facts(args.trace, render.rows_of(compared_ticks))])
    return DONE if compared.identical else DOES_NOT_HOLD
