"""python -m design.check coupling.json: prove a stored coupling again, from the file alone and without a solver."""

from __future__ import annotations

import time
from typing import Any

from rich.table import Table

from cli.options import DOES_NOT_HOLD, DONE, Parser, check_json, console, progress_bar
from design.certificate import HERE, SET, Stored, SwitchingProof, Verdict, switching_promise, verify
from design.ranges import Searched, search_box, search_part, search_words, violated_between
from sim.couplings import read_coupling
from sim.files import write_json
from sim.scenario import InputError


def main(argv: list[str]) -> int:
    """Prove a stored coupling again. 0: proved, 1: not."""
    args = _parser().parse_args(argv)
    check_json(args)
    begin = time.perf_counter()
    stored = read_coupling(args.coupling)
    try:
        verdict = verify(stored)
    except (ValueError, ArithmeticError) as error:
        raise InputError(f"{args.coupling}: {error}") from None
    searched = _searched(stored) if verdict.proved else None
    if searched and not searched.worst[0].ratio < 1:
        verdict = Verdict(False, violated_between(searched.worst[0].member, searched.worst[0].ratio))
    result = _result(stored, verdict, searched, time.perf_counter() - begin)
    console(args).print(_table(result))
    if args.json:
        write_json(args.json, result)
    return DONE if verdict.proved else DOES_NOT_HOLD


def _searched(stored: Stored) -> Searched | None:
    """The search between the vertices, again, where the file promises a set."""
    if not (stored.certificate and stored.certificate.promise == SET):
        return None
    with (bar := progress_bar("searching the box between its vertices"))[0]:
        return search_box(stored.loop, stored.coupling.build(stored.loop.T), bar[1])


def _parser() -> Parser:
    parser = Parser(
        "design.check", "Prove a stored coupling again, in exact arithmetic.", "python -m design.check coupling.json"
    )
    parser.add_argument("coupling", metavar="FILE.json", help="the stored coupling")
    parser.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    return parser


def _result(stored: Stored, verdict: Verdict, searched: Searched | None, seconds: float) -> dict[str, Any]:
    """The machine-readable result; figures are null where the file carries no certificate."""
    claim = stored.certificate
    return {
        "proved": verdict.proved,
        "reason": verdict.reason,
        "condition": claim and claim.condition,
        "promise": claim.promise if claim and verdict.proved else None,
        "proof": claim.proof if claim and verdict.proved else None,
        "vertices": len(stored.loop.members()) - 1 if stored.loop.box else None,
        "between": searched and search_part(searched),
        "required_damping": claim and claim.required,
        "available_damping": stored.loop.delta,
        "margin": claim and claim.margin,
        "switching": _switching(stored, verdict),
        "wall_s": seconds,
    }


def _switching(stored: Stored, verdict: Verdict) -> dict[str, Any] | None:
    """The claim for delays that vary, None where the file makes none; promise and proof are null where it fails."""
    span, claim = stored.loop.jitter, stored.certificate and stored.certificate.switching
    if span is None or not isinstance(claim, SwitchingProof):
        return None
    return {
        "lo": span.lo,
        "hi": span.hi,
        "promise": f"{switching_promise(span)}, in {HERE}" if verdict.proved else None,
        "proof": "rational" if verdict.proved else None,
        "required_damping": claim.required,
        "margin": claim.margin,
    }


def _table(result: dict[str, Any]) -> Table:
    title = "not proved"
    if result["proved"]:
        title = "proved, in exact arithmetic"
        if result["between"]:
            title += ", at every vertex; between them searched, not proved"
    table = Table(title=title, show_header=False, title_justify="left")
    switching = result["switching"] or {}
    rows = {key: value for key, value in result.items() if key not in ("proved", "switching")}
    rows["between"] = result["between"] and search_words(result["between"])
    rows |= {f"switching, {key}": value for key, value in switching.items() if key not in ("lo", "hi")}
    claims = () if result["proved"] else ("required_damping", "margin")  # what a file says that was refused
    rows = {f"{key}, claimed" if key in claims else key: value for key, value in rows.items()}
    for key, value in rows.items():
        if value is not None:
            shown = ", ".join(f"{v:.6g}" for v in value) if isinstance(value, tuple) else value
            table.add_row(key.replace("_", " "), f"{shown:.6g}" if isinstance(shown, float) else str(shown))
    return table
