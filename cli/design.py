"""python -m design: design a coupling, prove it, and store it with its certificate."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from rich.table import Table

from cli import options, render
from cli.judged import Judged
from controller.loop import DelayRange, Loop
from design import coverage
from design.audit import LONGEST_DELAY
from design.bound import MOST, NO_BOUND, bound
from design.certificate import SAMPLES, RangesCheck, assess, check_ranges, lag, prove, switching_requirement
from design.coupling_file import Certificate, LimiterCertificate, Stored, digest, save
from design.designs import KINDS, design_by_kind, usual_condition
from design.files import out_file
from design.gain_search import STIFFEST
from design.guarantees import ANY, HERE, switching_guarantee
from design.optimal import Optimal, robustness_parts
from design.program import DEFAULT, OBJECTIVES, Options
from design.result import Design, DesignFailed, NotProved, listed
from design.robustness import ranges_around
from design.transparency import BAND_HZ, transparency
from sim import report as parts
from sim.scenario import InputError, Scenario


def main(argv: list[str]) -> int:
    """Design, prove and store. 0: certified, 1: not."""
    args = _parser().parse_args(argv)
    if args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")
    options.check_json(args)
    out = out_file(args.out, f"out/design-{options.place(args)}.json", "the file of the coupling")
    scenario = options.scenario_from(args)
    loop = _loop(args, scenario)
    if args.samples is not None and loop.ranges is None:
        raise InputError("--samples without ranges: give --ranges, or a scenario with [ranges]")
    design = _design(args, loop)
    judged = _judged(args, scenario, loop, design)
    stored = _store(loop, design, judged.whole, out, judged.limits.certificate)
    report = _reported(args, loop, design, judged, stored)
    render.publish(args, report, _tables(scenario, report))
    holds = report.certificate["certified"] and (judged.promise == ANY or not judged.whole or judged.proved)
    return options.DONE if holds and (report.switching or report.certificate)["certified"] else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    example = "python -m design --case I --coupling spring-damper --out coupling.json"
    parser = options.Parser("design", "Design a coupling, prove its certificate and store both.", example)
    options.add_loop_options(parser)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--coupling", choices=tuple(KINDS), default="spring-damper", help="(default spring-damper)")
    best = "the coupling of the least transparency error: --coupling optimal"
    kind.add_argument("--best", dest="coupling", action="store_const", const="optimal", help=best)
    around = "certify for every stiffness and mass this much more or less, as [ranges] of a scenario does"
    parser.add_argument("--ranges", type=_percent, metavar="PERCENT", help=around)
    options.add_condition_option(parser, "what to certify")
    varying = "safe under any switching of the forces' delays in this range too [samples]; for this-environment designs"
    options.add_varying_delay_option(parser, varying)
    limiter = "for this-environment: proved also while forces are limited, or not made (spring-damper: if it can)"
    one_of = parser.add_mutually_exclusive_group()
    one_of.add_argument("--limiter", action="store_const", const=True, help=limiter)
    options.add_limiter_option(one_of, "design and prove as if forces were never at their limits")
    ccl = parser.add_argument_group("ccl: a state-space coupling of fixed order, by the procedure of Remark 5")
    ccl.add_argument("--order", type=options.whole(1, 10), metavar="N", help="states per channel (default 1)")
    ways = "complementarity (as printed), inner or fixed-poles (default inner)"
    ccl.add_argument("--method", metavar="NAME", help=ways)
    optimal = parser.add_argument_group("optimal: the best filter of the environment's forces")
    add_optimal_options(optimal)
    samples = f"random points in the ranges, beside the search (default {SAMPLES})"
    parser.add_argument("--samples", type=options.whole(0, 10_000), metavar="N", help=samples)
    ccl.add_argument("--full", action="store_true", help="across channels (default: diagonal)")
    options.add_output_options(parser, "FILE.json", "the stored coupling (default out/design-<case or scenario>.json)")
    return parser


def add_optimal_options(group: argparse._ActionsContainer) -> None:
    """The options of an optimal coupling; None where not given."""
    error = "which transparency error is minimised (default rms)"
    group.add_argument("--objective", choices=OBJECTIVES, help=error)
    options.add_band_option(group)
    gain = "limit of |F|/|E| above 100 Hz (default none: the force there is kept low, not limited)"
    group.add_argument("--high-gain", type=_number_or_none, metavar="G", help=gain)
    limit = "begin no larger basis after this time [s] (default 60)"
    group.add_argument("--seconds", type=options.number(0), metavar="S", help=limit)


def optimal_options(args: argparse.Namespace) -> dict[str, Any]:
    """The options of an optimal coupling, checked."""
    given = {name: getattr(args, name) for name in ("objective", "band_hz", "high_gain", "seconds")}
    given = {name: value for name, value in given.items() if value is not None}
    if getattr(args, "limiter", False):
        given["limiter"] = True
    if given.get("high_gain") == "none":
        given.pop("high_gain")
    return given


def _percent(text: str) -> float:
    return options.number(0.1, 90.0, "%")(text.removesuffix("%"))


def _number_or_none(text: str) -> float | str:
    return text if text == "none" else options.number()(text)


# ----------------------------------------------------------------------------------------------------
# The request.


#: options of a design; --full says of the ccl's `diagonal` that it is not
_OPTIONS = {"full": "diagonal"} | {
    name: name for name in ("limiter", "order", "method", "objective", "band_hz", "high_gain", "seconds")
}


def _loop(args: argparse.Namespace, scenario: Scenario) -> Loop:
    """The scenario's loop with the range of delays that --varying-delay gives. Raises InputError."""
    loop = scenario.loop(args.case)
    if args.ranges is not None:
        if loop.ranges or loop.environment.walls:
            raise InputError(f"--ranges and {'[ranges]' if loop.ranges else 'environment.walls'}: give one of them")
        try:
            loop = msgspec.structs.replace(loop, ranges=ranges_around(loop.network, args.ranges))
            loop.members()
        except ValueError as error:
            raise InputError(f"--ranges {args.ranges:g}: {error}") from None
    args.condition = args.condition or usual_condition(loop, args.coupling)
    if args.varying_delay is not None:
        if not _for_switching(args):
            raise InputError("--varying-delay is for --coupling optimal or --condition this-environment")
        if loop.ranges:
            raise InputError("--varying-delay and [ranges]: switching delays are judged in one environment; give one")
        lo, hi = options.ranges_per_channel("--varying-delay", args.varying_delay, len(loop.theta))
        asked = ",".join(f"{a}-{b}" for a, b in args.varying_delay)
        if any(not 0 <= a <= b <= LONGEST_DELAY for a, b in zip(lo, hi, strict=True)):
            raise InputError(f"--varying-delay is {asked}, expected 0 <= LO <= HI <= {LONGEST_DELAY} samples")
        try:
            loop = loop.switching(DelayRange(lo, hi))
        except ValueError as error:
            raise InputError(f"--varying-delay is {asked}: {error}") from None
    if args.coupling == "optimal" and loop.environment.walls:
        raise InputError("environment.walls: an optimal coupling holds a linear model, so it cannot face walls")
    return loop


def _for_switching(args: argparse.Namespace) -> bool:
    """Whether this design can be made for delays that vary; any other is only judged under them."""
    condition = args.condition or KINDS[args.coupling].conditions[0]
    return args.coupling in ("spring-damper", "optimal") and condition == "this-environment"


def _asked(args: argparse.Namespace, loop: Loop) -> dict[str, Any]:
    """The arguments of the design's own function. Raises InputError for options of another coupling."""
    given = {name: getattr(args, name) for name in _OPTIONS}
    given = {name: value for name, value in given.items() if value is not None and value is not False}
    if args.coupling == "spring-damper" and args.limiter is not None:
        given["limiter"] = args.limiter
    for name in given:
        taking = [kind for kind, design in KINDS.items() if _OPTIONS[name] in design.options]
        if args.coupling not in taking:
            allowed = " or ".join(taking)
            shown = name.removesuffix("_hz").replace("_", "-")
            raise InputError(f"--{shown} is for --coupling {allowed}, not {args.coupling}")
    if args.coupling == "optimal":
        return optimal_options(args)
    if given.pop("full", False):
        given["diagonal"] = False
    return given


def _design(args: argparse.Namespace, loop: Loop) -> Design:
    """Raises InputError for a request that contradicts itself, DesignFailed where there is no such coupling."""
    asked = _asked(args, loop)
    if loop.varying_delay and _for_switching(args):
        asked["switching"] = (loop.varying_delay.lo, loop.varying_delay.hi)
    try:
        with render.designing(loop, args.coupling, args.condition) as heard:
            return design_by_kind(loop, args.coupling, args.condition, heard, **asked)
    except DesignFailed:
        raise
    except ValueError as error:
        raise InputError(options.as_option(error, args)) from None


# ----------------------------------------------------------------------------------------------------
# What was designed: its figures, its file.


def _judged(args: argparse.Namespace, scenario: Scenario, loop: Loop, design: Design) -> Judged:
    """What each condition asks of the coupling, by a sweep and an exact proof, and the limiter that it may have."""
    held, searched = design.certificate, design.searched if isinstance(design, Optimal) else None
    requirements = assess(loop, design.coupling, design.phi, held)
    samples = SAMPLES if args.samples is None else args.samples
    with render.progress("searching the ranges" if loop.ranges else "judging the coupling") as move:
        whole = check_ranges(loop, design.coupling, args.seed, samples, move, searched, held)
    limits = coverage.Limits(None, "as asked")
    if args.limiter is not False:
        limits = coverage.covered_limits(loop, design.coupling, requirements, (held and held.limiter) or None)
    return Judged.of(args.coupling, design.coupling, loop, requirements, whole, limits, scenario)


def _reported(args: argparse.Namespace, loop: Loop, design: Design, judged: Judged, stored: dict[str, Any]) -> _Report:
    figures = transparency(loop.F(design.coupling), loop.E(), loop.lam, args.band_hz or BAND_HZ)
    delays = stored["switching"]
    return _Report(
        args.case,
        args.seed,
        design.objective,
        design.wall_s,
        judged.certificates[design.condition],
        _robustness_loss(args, loop, design) if judged.whole else None,
        judged.coupling,
        judged.certificates,
        _switching_figures(loop, design),
        judged.ranges,
        judged.promise,
        judged.limiter,
        delays["promise"] if delays and delays["proof"] else None,
        design.figure,
        parts.transparency_part(figures),
        *_worth(args, loop, design),
        design.sdps,
        stored,
    )


def _worth(args: argparse.Namespace, loop: Loop, design: Design) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """What a wrong model of the environment costs, and what only an optimal coupling is reported with."""
    robust, best = {"robustness": None}, design if isinstance(design, Optimal) else None
    with render.progress("working out robustness and its price, and the bound"):
        if design.condition == "this-environment":
            asked = Options(**optimal_options(args)) if best else DEFAULT
            robust = robustness_parts(loop, design.coupling, asked)
        return robust, best and _best_figures(args, loop, best)


def _best_figures(args: argparse.Namespace, loop: Loop, best: Optimal) -> dict[str, Any]:
    """What an optimal coupling is reported with: how it was found, and how it stands to what is possible."""
    limit: dict[str, Any] = {"rms_mismatch_db": None}
    if loop.channels > MOST:
        limit["reason"] = NO_BOUND
    elif best.objective == 0:
        limit["reason"] = "the mismatch is zero: there is nothing to bound"
    else:
        least = bound(loop, args.band_hz or BAND_HZ)
        gap = best.figures.rms_mismatch_db - least.rms_db
        found = {"rms_mismatch_db": least.rms_db, "gap_db": gap}
        limit |= found if least.rms else {"reason": "the bound is zero: nothing is known to be lost"}
    return {
        "bound": limit,
        "rendered_stiffness": best.g,
        "ladder": [asdict(rung) for rung in best.ladder],
    }


def _switching_figures(loop: Loop, design: Design) -> dict[str, Any] | None:
    """What any switching asks of the designed coupling, from the coupling alone."""
    if loop.varying_delay is None:
        return None
    found, sent = switching_requirement(loop, design.coupling), loop.sent(design.coupling)
    return coverage.switching_part(found, sent, loop.varying_delay, loop.T_max)


def _robustness_loss(args: argparse.Namespace, loop: Loop, design: Design) -> list[dict[str, Any]]:
    """The coupling over the ranges; an optimal one beside the one for the nominal environment alone."""
    couplings = {args.coupling: design.coupling}
    if args.coupling == "optimal":
        couplings = {"whole ranges": design.coupling}
        try:
            alone = design_by_kind(loop.at(loop.environment), "optimal", None, **_asked(args, loop))
            couplings = {"nominal only": alone.coupling, **couplings}
        except DesignFailed:  # ranges are given another basis by default
            pass
    return [coverage.cost_part(row) for row in coverage.price(loop, couplings)]


def _store(
    loop: Loop, design: Design, whole: RangesCheck | None, out: Path, limiter: LimiterCertificate | None = None
) -> dict[str, Any]:
    """Save the coupling with the proof of its condition, and that of limited forces, or without a proof.

    What is not proved for whole ranges, or for switching delays, is kept as what it is: a coupling for the nominal
    environment, or for constant delays.
    """
    if whole and whole.proved and design.condition == "this-environment":
        certificate, reason = whole.certificate, None
    else:
        loop = loop if design.condition == "any-environment" else loop.at(loop.environment)
        certificate, reason = _proved(loop, design, limiter)
    switching = None
    if loop.varying_delay:
        proof = certificate.proof if certificate else None
        words = f"{switching_guarantee(loop.varying_delay)}, in {HERE}"
        switching = {"promise": words, "proof": proof, "reason": reason}
        if certificate is None:
            loop = loop.switching(None)
            certificate, reason = _proved(loop, design, limiter)
    try:
        save(Stored.of(loop, design.coupling, certificate), out)
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror}") from None
    proof = certificate.proof if certificate else None
    limited = proof is not None and lag(loop, certificate) is not None
    return {"file": str(out), "proof": proof, "reason": reason, "switching": switching, "limited_forces": limited}


def _proved(loop: Loop, design: Design, limiter: LimiterCertificate | None) -> tuple[Certificate | None, str | None]:
    """The certificate of all that the loop claims, or why there is none."""
    held = design.certificate
    if held and held.scenario == digest(loop, design.coupling.form()):
        return held, None
    try:
        phi = None if design.phi is None else design.phi.tolist()
        return prove(loop, design.coupling, design.condition, phi, limiter), None
    except NotProved as error:
        return None, str(error)


# ----------------------------------------------------------------------------------------------------
# The report as tables.


def _coupling_rows(coupling: dict[str, Any]) -> render.Rows:
    end = f"{STIFFEST:g} N/m is where the search ends, no optimum of its own"
    yield "K [N/m]", coupling["K"] and listed(coupling["K"])
    yield "", end if max(coupling["K"] or [0]) > 0.999 * STIFFEST else None
    yield "B [N s/m]", coupling["K"] and listed(coupling["B"])
    yield "stiffness, static [N/m]", coupling.get("stiffness") and listed(coupling["stiffness"])


#: what a design minimised or maximised -> in words
_OBJECTIVE_WORDS = {
    "loop-norm": "the least norm of W1 L W2, (23) of the paper",
    "rms": "the least rms transparency error, a ratio",
    "sup": "the least largest transparency error, a ratio",
    "stiffness": "the most stiffness, of all channels together [N/m]",
}


def _best_rows(part: dict[str, Any]) -> render.Rows:
    """Rows that only an optimal coupling has."""
    limit = part["bound"]
    climbed = ", ".join(f"{rung['mismatch_db']:.2f}" for rung in part["ladder"])
    bounded = "no linear coupling can be better than {rms_mismatch_db:.2f} dB rms, {gap_db:.2f} dB less than this one"
    yield "bound", limit.get("reason") or bounded.format(**limit)
    yield "rendered stiffness", render.optional(part["rendered_stiffness"], "{:.3f} of the environment's")
    yield "ladder [dB]", climbed or None


def _switching_words(proof: dict[str, Any]) -> str:
    span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(proof["lo"], proof["hi"], strict=True))
    word = "certified" if proof["certified"] else "not certified"
    return f"{span} samples: needs {listed(proof['required_damping'])}: {word} (proof: {proof['proof']})"


def _stored_rows(part: dict[str, Any]) -> render.Rows:
    switching = part["switching"] or {"proof": True}
    yield "stored", f"{part['file']} (proof: {part['proof'] or part['reason']})"
    yield "", None if switching["proof"] else f"for constant delays only: {switching['reason']}"


@dataclass(frozen=True, eq=False)
class _Report:
    """The design; parts that it does not have are null."""

    case: str
    seed: int
    objective: float
    wall_s: float
    certificate: dict[str, Any]
    price: list[dict[str, Any]] | None
    coupling: dict[str, Any] = render.several(_coupling_rows)
    certificates: dict[str, Any] = render.several(partial(render.certificate_rows, proof=False))
    switching: dict[str, Any] | None = render.figure("damping, any switching", _switching_words)
    ranges: dict[str, Any] | None = render.several(coverage.ranges_rows)
    promise: str | None = render.figure("guarantee", absent="none")
    limiter: dict[str, Any] = render.figure("guarantee, forces", "{[words]}")
    delays: str | None = render.figure("guarantee, delays", json="table")
    objective_name: str = render.figure("designed for", "{r.aim}: {r.objective:.5g}")
    transparency: dict[str, Any] = render.figure("transparency error", render.transparency_error)
    robust: dict[str, Any] = render.several(render.robustness_rows, "beside")
    best: dict[str, Any] | None = render.several(_best_rows, "beside")
    sdps: int = render.figure("convex problems", "{} in {r.wall_s:.2f} s")
    stored: dict[str, Any] = render.several(_stored_rows)

    @property
    def aim(self) -> str:
        return _OBJECTIVE_WORDS[self.objective_name]


def _tables(scenario: Scenario, report: _Report) -> list[Table]:
    title = f"{scenario.title(report.case)}: {report.coupling['kind']} for {report.certificate['condition']}"
    rows = [render.channel_row(scenario.environment.contacts), *render.rows_of(report)]
    shown = [render.facts(title, rows)]
    if report.price:
        shown.append(_over_the_ranges(report.price))
    return shown


def _over_the_ranges(rows: list[dict[str, Any]]) -> Table:
    """Each figure in the nominal environment, and the worst of the ranges."""
    names = ("required_over_available", "rms_mismatch_db", "relative_mismatch_db")
    cells = []
    for row in rows:
        forms = zip(names, ("{:.4f}", "{:.2f}", "{:.2f}"), strict=True)
        needs, rms, sup = (" / ".join(render.optional(v, form) for v in row[name].values()) for name, form in forms)
        cells.append((row["coupling"], needs, str(row["violated"]), f"{rms} dB", f"{sup} dB"))
    heads = ("coupling", "needs of its damping", "vertices violated", "rms error", "largest error")
    return render.grid("in the nominal environment / at the worst vertex", heads, cells, left=range(5))
