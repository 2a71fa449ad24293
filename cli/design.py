"""python -m design: design a coupling, prove it, and store it with its certificate."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from haptic_loop.cli import options, render
from haptic_loop.cli import verdict as verdicts
from haptic_loop.controller.loop import Loop
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import named
from haptic_loop.design.coverage import Robustness, ranges_around, robustness_nearby
from haptic_loop.design.designs import KINDS, design_by_kind, kind_of, usual_condition
from haptic_loop.design.environments import ANY_ENVIRONMENT
from haptic_loop.design.files import off_table, out_file
from haptic_loop.design.forked import Forked
from haptic_loop.design.gain_search import STIFFEST, softest
from haptic_loop.design.program import OBJECTIVES, Options
from haptic_loop.design.result import Design, finite, listed
from haptic_loop.design.transparency import BAND_HZ
from haptic_loop.sim.scenario import InputError, Scenario, is_world

if TYPE_CHECKING:
    from haptic_loop.design import coverage
    from haptic_loop.design.api import Filed
    from haptic_loop.design.bound import Bound, BoundBeside


def main(argv: list[str]) -> int:
    """Design, prove and store a coupling. Return 0 if it is certified, 1 if not, 130 if interrupted."""
    args = _parser().parse_args(argv)
    from haptic_loop.design.api import store

    if args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")
    out = out_file(args.out, f"out/design-{options.place(args)}.json", "the file of the coupling")
    scenario = options.scenario_from(args)
    args.coupling = args.coupling or ("moving-average" if is_world(scenario) else "spring-damper")
    if is_world(scenario):
        from haptic_loop.cli import world

        world.check_design(args)
        args.condition = args.condition or ANY_ENVIRONMENT.name
        return world.design(args, scenario, out, _design(args, scenario.loop(args.case)))
    loop = _loop(args, scenario)
    begun = _begun_bound(args, loop)
    design = _design(args, loop)
    assessment = verdicts.assessment_of(args, scenario, design, loop)
    stored = store(loop, design, out, assessment)
    slow = args.coupling == "optimal"  # Its bound takes seconds, so the verdict is printed before the bound.
    if slow:
        render.announce(args, verdicts.verdict(assessment))
    report = _reported(args, loop, design, assessment, stored, begun)
    nearby = report.robustness
    verdict = verdicts.lost(assessment, nearby) if slow else verdicts.verdict(assessment, nearby)
    tables, lines = _tables(scenario, report)
    if report.interrupted:
        lines = ["Interrupted: the robustness is missing, and perhaps the bound.", *lines]
    render.publish(args, report, tables, lines, verdict=verdict)
    return options.exit_code(assessment.holds, report.interrupted)


def _parser() -> options.Parser:
    parser = options.Parser(
        "design",
        "Design a coupling, prove its certificate and store both.",
        "python -m design --coupling optimal --out coupling.json",
        "python -m design --scenario lab.toml --ranges 10%",
        first="scenario coupling condition reference ranges out",
    )
    parser.add_loop()
    default = "default spring-damper; moving-average in a world"
    kinds = f"{', '.join(KINDS)}, or FILE.py:NAME of your own ({default})"
    parser.add_argument("--coupling", metavar="NAME", help=kinds)
    around = "vary stiffnesses and masses by PERCENT like a scenario's [ranges]: certify vertices, search between them"
    parser.add_argument("--ranges", type=_percent, metavar="PERCENT", help=around)
    parser.add_condition("condition to certify (default: that of the coupling)")
    varying = "also certify any switching of the forces' delays in this range [samples]"
    parser.add_varying_delay(varying)
    limiter = (
        "fail unless the proof also covers limited forces; for known-device only with an optimal coupling (default: "
        "only a spring-damper tries this proof)"
    )
    one_of = parser.add_mutually_exclusive_group()
    one_of.add_argument("--limiter", action="store_const", const=True, help=limiter)
    parser.add_limiter("design and prove as if forces were never at their limits", to=one_of)
    ccl = parser.add_argument_group("ccl: a state-space coupling of fixed order (Remark 5)")
    ccl.add_argument("--order", type=options.whole(1, 10), metavar="N", help="states per channel (default 1)")
    _add_optimal_options(
        parser, "optimal: the force filter of least transparency error (--band also for spring-damper)"
    )
    parser.add_output(
        "FILE.json", "the stored coupling (default out/design-<case or scenario>[-<coupling>][-<condition>].json)"
    )
    return parser


def _add_optimal_options(parser: options.Parser, title: str) -> None:
    group = parser.add_argument_group(title)
    group.add_argument("--objective", choices=OBJECTIVES, help="which transparency error is minimised (default rms)")
    parser.add_band(to=group)
    gain = "limit of |F|/|E| above 100 Hz (default: no limit; the design only penalises the force there)"
    group.add_argument("--high-gain", type=options.number(), metavar="G", help=gain)
    limit = "stop enlarging the basis and searching the ranges after about S seconds (default: no time limit)"
    group.add_argument("--seconds", type=options.number(0), metavar="S", help=limit)


def _percent(text: str) -> float:
    return options.number(0.1, 90.0, "%")(text.removesuffix("%"))


def _loop(args: argparse.Namespace, scenario: Scenario) -> Loop:
    """Return the loop with --ranges and --varying-delay, and set args.condition. Raises InputError."""
    from haptic_loop.design.audit import LONGEST_DELAY

    loop = scenario.loop(args.case)
    if args.ranges is not None:
        if loop.ranges or loop.environment.walls:
            raise InputError(f"--ranges with {'[ranges]' if loop.ranges else 'environment.walls'}: leave out --ranges")
        with options.refused(f"--ranges {args.ranges:g}: "):
            loop = msgspec.structs.replace(loop, ranges=ranges_around(loop.network, args.ranges))
            loop.members()
    if args.coupling in KINDS:
        args.condition = args.condition or usual_condition(loop, args.coupling)
    if args.varying_delay is not None:
        if "switching" not in kind_of(args.coupling).options:
            able = " and ".join(kind for kind, design in KINDS.items() if "switching" in design.options)
            raise InputError(f"--varying-delay with --coupling {args.coupling}: allowed are {able}")
        span = options.delay_range(args.varying_delay, loop, LONGEST_DELAY)
        with options.refused("--varying-delay: "):
            loop = loop.switching(span)
    return loop


def _options_of(args: argparse.Namespace, kind: str) -> dict[str, Any]:
    """Return the options of a design. Raises InputError for options of another coupling."""
    known = dict.fromkeys(name for design in KINDS.values() for name in design.options)
    values = {name: value for name in known if options.given(value := getattr(args, name, None))}
    if kind_of(kind).limited and args.limiter is not None:
        values["limiter"] = args.limiter
    for name in values:
        taking = [other for other, design in KINDS.items() if name in design.options]
        if kind not in taking:
            shown = name.removesuffix("_hz").replace("_", "-")
            raise InputError(f"--{shown} is for --coupling {' or '.join(taking)}, not {kind}")
    return values


def _design(args: argparse.Namespace, loop: Loop) -> Design:
    """Return a design, with a proof if one was found.

    Raises InputError for contradictory options, DesignFailed if no coupling was found.
    """
    from haptic_loop.design.api import proved

    further = _options_of(args, args.coupling)
    with options.refused(args=args), render.designing(loop, args.coupling, args.condition) as progress:
        return proved(loop, design_by_kind(loop, args.coupling, args.condition, progress, **further))


def _begun_bound(args: argparse.Namespace, loop: Loop) -> Forked[Bound] | None:
    """Begin to compute the bound on optimal couplings, and return this computation; None if there is no bound.

    The bound depends on the loop and the band alone.
    """
    if args.coupling != "optimal" or args.condition == "known-device":
        return None
    from haptic_loop.design.bound import MOST, bound

    return Forked(bound, loop, args.band_hz or BAND_HZ, niceness=10) if loop.channels <= MOST else None


def _bound_and_robustness(
    args: argparse.Namespace, loop: Loop, design: Design, file: str, begun: Forked[Bound] | None
) -> tuple[BoundBeside | None, Robustness | None, bool]:
    """Return a bound on the error of optimal couplings, the robustness, and whether Ctrl-C skipped one of them."""
    from haptic_loop.design.bound import BoundBeside
    from haptic_loop.design.optimal import Optimal

    limit, note = None, f"{file} is stored (Ctrl-C skips the rest)"
    try:
        if isinstance(design, Optimal):
            with render.progress(f"{note}: computing the bound"):
                band, chosen = args.band_hz or BAND_HZ, Options(**_options_of(args, "optimal"))
                limit = BoundBeside.of(loop, design, design.figures.rms_mismatch_db, band, chosen, begun)
        with render.progress(f"{note}: computing robustness"):
            return limit, robustness_nearby(loop, design.coupling, named(design.required_condition)), False
    except KeyboardInterrupt:
        return limit, None, True


def _reported(
    args: argparse.Namespace,
    loop: Loop,
    design: Design,
    assessment: Assessment,
    stored: Filed,
    begun: Forked[Bound] | None,
) -> _Report:
    from haptic_loop.design import coverage
    from haptic_loop.design.optimal import Optimal

    best = design if isinstance(design, Optimal) else None
    known = assessment.requirements.get("switching")
    switching = coverage.SwitchingFigures.of(loop, design.coupling, known) if loop.varying_delay else None
    limit, nearby, interrupted = _bound_and_robustness(args, loop, design, str(stored.file), begun)
    nominal = None
    if kind_of(args.coupling).model:
        nominal = partial(design_by_kind, kind=args.coupling, **_options_of(args, args.coupling))
    return _Report(
        case=args.case,
        seed=args.seed,
        objective=design.objective,
        objective_name=design.figure,
        wall_s=design.wall_s,
        price=coverage.price(loop, design, args.coupling, nominal) if assessment.ranges else None,
        kind=args.coupling,
        assessment=assessment,
        switching=switching,
        delays=stored.switching.guarantee if stored.switching and stored.switching.proof else None,
        robustness=nearby,
        best=best and _Best(limit, best.g, best.bases, best.hurried),
        sdps=design.sdps,
        stored=stored,
        interrupted=interrupted,
        compared="; ".join(design.notes) or None,
        claim=design.own and design.own.remark(assessment.requirements[design.condition]),
    )


# ---- the report as tables


def _assessment_rows(assessment: Assessment) -> render.Rows:
    gains, end = assessment.gains, f"the search ends at {STIFFEST:g} N/m, which is a limit and no optimum"
    if "K" in gains:
        yield "K [N/m]", listed(gains["K"])
        yield "", end if max(gains["K"]) > 0.999 * STIFFEST else None
        least, soft = softest(assessment.loop), verdicts.soft_end(assessment.loop)
        searched = 0.999 * least < min(gains["K"]) < soft  # softer springs are not from this search
        yield "", f"{least:g} N/m is the softest spring that the search tries" if searched else None
        yield "B [N s/m]", listed(gains["B"])
    yield "stiffness, static [N/m]", listed(gains["stiffness"]) if "stiffness" in gains else None
    yield from render.certificate_rows(assessment.requirements, proof=False)
    yield from verdicts.range_rows(assessment.ranges) if assessment.ranges else ()
    felt = assessment.transparency
    yield "guarantee", assessment.guarantee_words or f"none ({assessment.reason})"
    yield "guarantee, forces", assessment.force_limits.words
    yield "held torques", assessment.held_torques
    yield "transparency error", felt and render.transparency_error(felt)


#: objectives of designs in words
_OBJECTIVE_WORDS = {
    "loop-norm": "the least norm of W1 L W2, (23) of the paper",
    "rms": "the least rms transparency error, a ratio",
    "sup": "the least peak transparency error, a ratio",
    "stiffness": "the largest sum of the channels' stiffnesses [N/m]",
}


@dataclass(frozen=True)
class _Best:
    """The part of a report that only optimal couplings have."""

    bound: BoundBeside | None
    rendered_stiffness: float
    bases: Sequence[Any]
    ended_by_seconds: bool

    def rows(self) -> render.Rows:
        yield "bound", self.bound and self.bound.words
        share = finite(self.rendered_stiffness)  # a free mass has no static stiffness to render
        yield "rendered stiffness", None if share is None else f"{share:.3f} of the environment's"
        tried = (f"{basis.mismatch_db:z.2f}{_why_rejected(basis)}" for basis in self.bases)
        yield "bases [dB]", ", ".join(tried) or None
        yield "ended by --seconds", "a larger basis may be better" if self.ended_by_seconds else None
        yield "last basis not taken", next((basis.rejected for basis in reversed(self.bases) if basis.rejected), None)
        if missed := [basis.reason for basis in self.bases if not (basis.certified or basis.rejected)]:
            yield "last basis not proved", missed[-1]


def _why_rejected(basis: Any) -> str:
    return "" if basis.taken else " (not taken)" if basis.rejected else " (not proved)"


def _switching_words(proof: coverage.SwitchingFigures) -> str:
    span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(proof.lo, proof.hi, strict=True))
    needs = f"{proof.requirement.words()}: {render.certified(proof.requirement, proof=False)}"
    return f"{span} samples: {needs} (proof: {proof.requirement.proof})"


def _stored_rows(stored: Filed) -> render.Rows:
    delays = stored.switching
    yield "stored", f"{stored.file} (proof: {stored.proof or stored.reason})"
    yield "", f"for constant delays only: {delays.reason}" if delays and not delays.proof else None


@dataclass(frozen=True, eq=False, kw_only=True)
class _Report:
    """The report of a design; missing parts are null or left out."""

    case: str
    seed: int
    objective: float
    wall_s: float
    price: list[coverage.OverRanges] | None
    kind: str  # kind of the coupling
    assessment: Assessment = render.several(_assessment_rows)
    switching: coverage.SwitchingFigures | None = render.figure("damping, any switching", _switching_words)
    delays: str | None = render.figure("guarantee, delays", json="left out")
    objective_name: str = render.figure("designed for", "{r.aim}: {r.objective:.5g}")
    robustness: Robustness | None = render.several(render.robustness_rows)
    best: _Best | None = render.several(_Best.rows, "inlined")
    sdps: int = render.figure("problems solved", "{} in {r.wall_s:.2f} s")
    stored: Filed = render.several(_stored_rows)
    interrupted: bool = off_table()
    claim: str | None = render.figure("claim", default=None, json="if given")  # for the user's own condition
    compared: str | None = render.figure("compared", default=None, json="if given")  # figures for another condition

    @property
    def aim(self) -> str:
        return _OBJECTIVE_WORDS[self.objective_name]


#: rows that are left out of long tables, the least important first
_LESS = (
    "problems solved",
    "damping, any switching",
    "ranges, inside",
    "bases [dB]",
    "ranges, worst vertex",
)


def _tables(scenario: Scenario, report: _Report) -> tuple[list[render.Table], list[str]]:
    """Return the tables, and lines on the rows that are left out of the first table."""
    title = f"{scenario.title(report.case)}: {report.kind} for {report.assessment.condition}"
    rows = [render.channel_row(scenario.environment.contacts), *render.rows_of(report)]
    rows, left_out = render.shortened(rows, _LESS, len(report.price or ()))
    shown = [render.facts(title, rows)]
    if report.price:
        title = "required damping (this-environment) and errors, in the nominal environment / at the worst vertex"
        shown.append(render.columns(title, _OVER_RANGES, report.price, left=range(5)))
    return shown, left_out


def _both(name: str, form: str) -> Callable[[coverage.OverRanges], str]:
    """Return a function from a row to the text: figure in the nominal environment / at the worst vertex."""

    def cell(row: coverage.OverRanges) -> str:
        figures: coverage.NominalWorst = getattr(row, name)
        return " / ".join(render.optional(finite(value), form) for value in (figures.nominal, figures.worst))

    return cell


_OVER_RANGES: dict[str, str | Callable[[coverage.OverRanges], str]] = {
    "coupling": "{r.coupling}",
    "share of the damping": _both("required_over_available", "{:.4f}"),
    "vertices violated": "{r.violated}",
    "rms error": lambda row: _both("rms_mismatch_db", "{:z.2f}")(row) + " dB",
    "largest error": lambda row: _both("relative_mismatch_db", "{:z.2f}")(row) + " dB",
}
