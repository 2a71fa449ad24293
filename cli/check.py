"""python -m design.check coupling.json: prove a stored coupling again, from the file alone.

No solver runs for the stored certificate. For another --condition, multipliers may be searched.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from haptic_loop.cli import options, render
from haptic_loop.cli import verdict as verdicts
from haptic_loop.controller.ranges import where_proved
from haptic_loop.controller.units import set_unit
from haptic_loop.design.assessment import Assessment, assess, violated_between
from haptic_loop.design.certificate import (
    NotProved,
    Verdict,
    condition_of,
    covered,
    limiter_rho,
    named,
    on_file,
    prove,
    required_damping,
    verify,
)
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.files import off_table
from haptic_loop.design.result import CONDITIONS, RANGES, Chosen, listed, suffices, switching_guarantee
from haptic_loop.design.worst_member import Searched, search_ranges
from haptic_loop.sim.couplings import read_coupling


@dataclass(frozen=True)
class _Switching:
    """The claim for delays that vary; guarantee and proof are null if the file is not proved."""

    lo: Sequence[int]
    hi: Sequence[int]
    guarantee: str | None = render.figure("switching, guarantee")
    proof: str | None = render.figure("switching, proof")
    required_damping: Sequence[float] | None = render.figure("switching, required damping [N s/m]", listed)
    margin: float | None = render.figure("switching, margin", "{:.6g}")


@dataclass(frozen=True)
class _Checked:
    """The report; figures of the certificate are null if the file has no certificate."""

    proved: bool
    reason: str | None = render.figure("reason")
    condition: str | None = render.figure("condition")
    guarantee: str | None = render.figure("guarantee")
    loop: str = render.figure("loop")
    proof: str | None = render.figure("proof")
    vertices: int | None = render.figure("vertices")
    between: Searched | None = render.figure("between vertices")
    required_damping: Sequence[float] | None = render.figure("required damping [N s/m]", listed)
    available_damping: Sequence[float] = render.figure("available damping [N s/m]", listed)
    margin: float | None = render.figure("margin", "{:.6g}")
    limited_forces: str | None = render.figure("forces")
    wall_s: float = render.figure("seconds", "{:.6g}")
    switching: _Switching | None = field(default=None)
    claim: str | None = render.figure("claim", default=None, json="if given")  # claim of the user's own condition
    assessment: Assessment | None = off_table(default=None)  # in the loop of the file, if the file is proved
    anew: bool = off_table(default=False)  # whether --condition differs from the file's condition


def main(argv: list[str]) -> int:
    """Prove a stored coupling again. Return 0 if it is proved, 1 if not."""
    args = _parser().parse_args(argv)
    begin = time.perf_counter()
    stored = read_coupling(args.coupling)
    set_unit(stored.loop.unit)
    with options.refused(f"{args.coupling}: "), render.progress("proving the coupling again"):
        own = named(args.condition) if args.condition else None
        anew = own is not None and not (stored.certificate and stored.certificate.condition == own.name)
        stored, verdict = _anew(stored, own) if own and anew else (stored, verify(stored, own))
    searched = _searched(stored, own) if verdict.proved else None
    ranges = stored.loop.ranges
    if ranges and searched and not suffices(searched.worst[0].ratio):
        where = where_proved(stored.loop.network, ranges)
        verdict = Verdict(False, violated_between(where, searched.worst[0].member, searched.worst[0].ratio))
    checked = _checked(stored, own, verdict, searched, time.perf_counter() - begin)
    if own and verdict.proved and own.name not in CONDITIONS:
        checked = replace(checked, claim=own.claim)
    with render.progress("assessing the coupling"):
        assessment = _assessed(stored, own, searched) if verdict.proved else None
    checked = replace(checked, anew=anew, assessment=assessment)
    shown = verdicts.verdict(assessment) if assessment else f"[red]Not proved[/]: {verdict.reason}"
    render.publish(args, checked, [_table(checked)], verdict=shown)
    return options.exit_code(verdict.proved)


def _parser() -> options.Parser:
    examples = (
        "python -m design.check coupling.json",
        "python -m design.check coupling.json --condition this-environment",
    )
    parser = options.Parser("design.check", "Prove a stored coupling again, in exact arithmetic.", *examples)
    parser.add_argument("coupling", metavar="FILE.json", help="the stored coupling")
    parser.add_condition("the condition of the file's certificate (default), or another condition to prove anew")
    parser.add_json()
    return parser


def _anew(stored: Stored, condition: Condition) -> tuple[Stored, Verdict]:
    """Prove another condition. Return the coupling, with a certificate if a proof was found, and the verdict."""
    coupling = stored.built()
    try:
        proved = Stored.of(stored.loop, coupling, prove(stored.loop, coupling, condition))
    except NotProved as error:
        return Stored.of(stored.loop, coupling), Verdict(False, f"{condition.name}: {error}")
    return proved, verify(proved, condition)


def _assessed(stored: Stored, own: Condition | None, searched: Searched | None) -> Assessment | None:
    claim = stored.certificate
    assert claim
    proved = Chosen(stored.built(), claim.condition, own=own, certificate=claim, searched=searched)
    return assess(stored.loop, proved, ranges_samples=0)


def _searched(stored: Stored, condition: Condition | None) -> Searched | None:
    """Repeat the search between the vertices of the ranges; return None if the file has no guarantee for ranges."""
    if not (stored.certificate and stored.certificate.guarantee == RANGES):
        return None
    loop, coupling = stored.loop, stored.built()
    with render.progress("searching the parameter ranges between their vertices") as move:
        proved_by = condition_of(stored.certificate, condition)
        if proved_by.extensible and not proved_by.multiplier_sizes(loop):
            return search_ranges(loop, coupling, move)
        values = on_file(proved_by, loop, stored.certificate.multipliers)
        return search_ranges(
            loop, coupling, move, ratio=lambda there: required_damping(there, coupling, proved_by, values).ratio
        )


def _checked(
    stored: Stored, condition: Condition | None, verdict: Verdict, searched: Searched | None, seconds: float
) -> _Checked:
    loop, claim, proved = stored.loop, stored.certificate, verdict.proved
    span, switching = loop.varying_delay, None
    delays = f"theta = {listed(loop.theta)}" + (f", psi = {listed(loop.psi)}" if any(loop.psi) else "")
    if span and claim and "switching" in claim.facts:
        guarantee = f"{switching_guarantee(span)}, in {claim.guarantee}" if proved else None
        shown = span.lo, span.hi, guarantee, "rational" if proved else None
        switching = _Switching(*shown, claim.required, claim.margin)
    return _Checked(
        proved,
        verdict.reason,
        claim and claim.condition,
        (condition or named(claim.condition)).words(loop) if claim and proved else None,
        "; ".join([f"T = {1e3 * loop.T:.6g} ms, {delays}, exact positions", *(covered(loop, claim) if claim else ())]),
        claim.proof if claim and proved else None,
        len(loop.members()) - 1 if loop.ranges else None,
        searched,
        claim and claim.required,
        loop.delta,
        claim and claim.margin,
        "proved, also while forces are limited" if proved and limiter_rho(loop, claim) is not None else None,
        seconds,
        switching,
    )


def _table(checked: _Checked) -> render.Table:
    title = "not proved"
    if checked.proved:
        ranges = checked.assessment and checked.assessment.ranges
        between = f", at {ranges.where}; only searched between vertices" if ranges and checked.between else ""
        anew = "proved anew, not from the file" if checked.anew else "proved"
        title = f"{anew}, in exact arithmetic{between}"
    rows = [*render.rows_of(checked), *(render.rows_of(checked.switching) if checked.switching else [])]
    if checked.assessment:
        rows.append(("held torques", checked.assessment.held_torques))
    if not checked.proved:  # The figures are claims of a file that is refused.
        claims = ("required", "margin", "switching, required", "switching, margin")
        rows = [(f"{name}, claimed" if name.startswith(claims) else name, text) for name, text in rows]
    return render.facts(title, rows, left=True)
