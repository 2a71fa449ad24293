"""python -m hw.replay: a recorded session through the controller again, and the forces compared bit by bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.table import Table

from cli.options import DOES_NOT_HOLD, DONE, Parser, check_json
from cli.render import console
from design.files import write_json
from hw.recording import Comparison, load, replay
from sim.trace import Trace


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
    outcome = {
        "trace": args.trace,
        "ticks": ticks,
        "filled_in": ticks - received,
        "asked_differ": int(compared.asked.sum()),
        "sent_differ": int(compared.sent.sum()),
        "largest_difference_n": compared.largest,
        "first_difference_s": _first(compared, result),
        "identical": compared.identical,
    }
    table = Table(title=args.trace, show_header=False)
    for name, value in outcome.items():
        table.add_row(name.replace("_", " "), "-" if value is None else str(value))
    console(args).print(table)
    if args.json:
        write_json(args.json, outcome)
    return DONE if compared.identical else DOES_NOT_HOLD


def _first(compared: Comparison, result: Trace) -> float | None:
    different = compared.asked | compared.sent
    return float(result.t[np.argmax(different)]) if different.any() else None
