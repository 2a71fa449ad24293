"""python -m design: design a coupling, prove it, and store it with its certificate."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    Parser,
    add_loop_options,
    add_output_options,
    as_option,
    check_json,
    console,
    numbers,
    progress_bar,
    ranges,
    scenario_from,
    seed_from,
)
from cli.run import coupling_part, transparency_part
from controller.coupling import Coupling
from controller.loop import DelayRange, Loop
from design.audit import LONGEST_DELAY
from design.certificate import (
    ANY,
    CONDITIONS,
    HERE,
    Certificate,
    NotProved,
    Stored,
    assess,
    certificate_part,
    promise_of,
    prove,
    save,
    switching_part,
    switching_promise,
    switching_requirement,
)
from design.designs import KINDS, compare_methods, design_by_kind
from design.optimal import FILTERS, OBJECTIVES
from design.ranges import SAMPLES, SetCheck, check_set, cost_part, price, set_part, set_rows
from design.result import METHODS, Design, DesignFailed, listed
from design.spring_damper import STIFFEST
from design.transparency import transparency
from sim.files import out_file, write_json
from sim.scenario import InputError, Scenario

# ----------------------------------------------------------------------------------------------------
# What a design came to, as tables; python -m design prints them.


def tables(outcome: dict[str, Any]) -> list[Table]:
    """The design itself, the price of a set where it has one, the methods where they were compared."""
    shown = [_table(outcome)]
    if outcome["price"]:
        shown.append(_costs(outcome["price"]))
    if "comparison" in outcome:
        shown.append(_comparison(outcome["comparison"]))
    return shown


def _table(outcome: dict[str, Any]) -> Table:
    coupling, certificate, transparent = outcome["coupling"], outcome["certificate"], outcome["transparency"]
    table = Table(title=f"{coupling['kind']}, case {outcome['case']}, {certificate['condition']}", show_header=False)
    if coupling["K"]:
        table.add_row("K [N/m]", listed(coupling["K"]))
        if max(coupling["K"]) > 0.999 * STIFFEST:
            table.add_row("", f"{STIFFEST:g} N/m is where the search ends, no optimum of its own")
        table.add_row("B [N s/m]", listed(coupling["B"]))
    for part in outcome["certificates"].values():
        word = "certified" if part["certified"] else "not certified"
        required = listed(part["required_damping"])
        available = listed(part["available_damping"])
        table.add_row(f"damping, {part['condition']}", f"needs {required} of {available} N s/m: {word}")
    if part := outcome["jitter_proof"]:
        word = "certified" if part["certified"] else "not certified"
        span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(part["lo"], part["hi"], strict=True))
        needs = f"needs {listed(part['required_damping'])}: {word} (proof: {part['proof']})"
        table.add_row("damping, any switching", f"{span} samples: {needs}")
    for row in set_rows(outcome["set"]) if outcome["set"] else []:
        table.add_row(*row)
    stored = outcome["stored"]
    table.add_row("promise", outcome["promise"] or "none")
    if stored["switching"] and stored["switching"]["proof"]:
        table.add_row("promise, delays", stored["switching"]["promise"])
    table.add_row(outcome["objective_name"], f"{outcome['objective']:.5g}")
    sup, rms = transparent["relative_mismatch_db"], transparent["rms_mismatch_db"]
    table.add_row("mismatch", "none" if sup is None or rms is None else f"{sup:.2f} dB (rms {rms:.2f} dB)")
    table.add_row("convex problems", f"{outcome['sdps']} in {outcome['wall_s']:.2f} s")
    table.add_row("stored", f"{stored['file']} (proof: {stored['proof'] or stored['reason']})")
    if stored["switching"] and not stored["switching"]["proof"]:
        table.add_row("", f"for constant delays only: {stored['switching']['reason']}")
    return table


def _comparison(rows: list[dict[str, Any]]) -> Table:
    table = Table("method", "||W1 L W2||", "SDPs", "seconds", title="one state per channel, diagonal")
    for row in rows:
        norm = "-" if row["norm"] is None else f"{row['norm']:.4g}"
        table.add_row(row["method"], norm, str(row["sdps"]), f"{row['wall_s']:.1f}")
    return table


def _costs(rows: list[dict[str, Any]]) -> Table:
    """Each figure in the nominal environment, and the worst of the set."""
    title = "in the nominal environment / at the worst vertex"
    table = Table(
        "coupling", "needs of its damping", "vertices violated", "rms mismatch", "relative mismatch", title=title
    )
    for row in rows:
        pairs = [row[name] for name in ("required_over_available", "rms_mismatch_db", "relative_mismatch_db")]
        needs, rms, sup = (
            ["-" if v is None else f"{v:.{4 - 2 * (n > 0)}f}" for v in p.values()] for n, p in enumerate(pairs)
        )
        table.add_row(
            row["coupling"], " / ".join(needs), str(row["violated"]), f"{' / '.join(rms)} dB", f"{' / '.join(sup)} dB"
        )
    return table


def main(argv: list[str]) -> int:
    """Design, prove and store. 0: certified, 1: not."""
    args = _parser().parse_args(argv)
    if args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")
    check_json(args)
    out = out_file(args.out, f"out/design-{args.case}.json", "the file of the coupling")
    loop = _loop(args, scenario_from(args))
    options = _options(args) | _switching(args, loop)
    if args.coupling == "optimal" and loop.environment.walls:
        raise InputError("environment.walls: an optimal coupling holds a linear model, so it cannot face walls")
    seed, samples = seed_from(args), _samples(args)
    try:
        with (bar := progress_bar("designing"))[0]:
            design = design_by_kind(
                loop, args.coupling, args.condition, lambda what, done, total: bar[1](done, total, what), **options
            )
    except DesignFailed:
        raise
    except ValueError as error:
        raise InputError(as_option(error, args)) from None
    F = loop.F(design.coupling)
    requirements = assess(loop, design.coupling, design.phi)
    with (bar := progress_bar("searching the box"))[0]:
        whole = check_set(loop, design.coupling, seed, samples, bar[1])
    outcome = {
        "case": args.case,
        "seed": seed,
        "coupling": coupling_part(args.coupling, design.coupling, loop.T),
        "certificate": certificate_part(requirements[design.condition]),
        "certificates": {name: certificate_part(r) for name, r in requirements.items()},
        "promise": promise_of(requirements, loop, bool(whole and whole.proved)),
        "set": whole and set_part(whole),
        "price": _price(args, loop, design, options) if whole else None,
        "transparency": transparency_part(transparency(F, loop.E(), loop.lam)),
        "objective": design.objective,
        "objective_name": design.figure,
        "sdps": design.sdps,
        "wall_s": design.wall_s,
        "stored": _store(loop, design, whole, out),
        "jitter_proof": _switching_figures(loop, design.coupling),
    }
    if args.compare:
        outcome["comparison"] = [asdict(row) for row in compare_methods(loop)]
    for table in tables(outcome):
        console(args).print(table)
    if args.json:
        write_json(args.json, outcome)
    holds = outcome["certificate"]["certified"] and (outcome["promise"] == ANY or not whole or whole.proved)
    proof = outcome["jitter_proof"]
    return DONE if holds and (proof is None or proof["certified"]) else DOES_NOT_HOLD


def _parser() -> Parser:
    example = "python -m design --case I --coupling spring-damper --out coupling.json"
    parser = Parser("design", "Design a coupling, prove its certificate and store both.", example)
    add_loop_options(parser)
    parser.add_argument("--coupling", choices=tuple(KINDS), default="spring-damper", help="(default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="what to certify (default: the coupling's own)")
    jitter = "safe under any switching of the forces' delays in this range too [samples]; for closed-loop designs"
    parser.add_argument("--jitter", metavar="LO,HI", help=jitter)
    ccl = parser.add_argument_group("ccl: a state-space coupling of fixed order, by the procedure of Remark 5")
    ccl.add_argument("--order", metavar="N", help="states per channel (default 1)")
    ccl.add_argument("--method", choices=METHODS, help="complementarity is as printed (default inner)")
    ccl.add_argument("--compare", action="store_true", help="run every method, one state per channel (a minute)")
    optimal = parser.add_argument_group("optimal: the best Q in the pair with a model of the environment")
    optimal.add_argument("--functions", metavar="N", help="basis functions of each entry of Q (default 8)")
    optimal.add_argument("--filter", choices=FILTERS, help="poles of the basis (default auto: by delays and functions)")
    optimal.add_argument("--objective", choices=OBJECTIVES, help="which mismatch is minimised (default rms)")
    optimal.add_argument("--high-gain", metavar="G", help="limit of |F|/|E| above 100 Hz, or none (default 1.5)")
    optimal.add_argument("--margin", metavar="SHARE", help="of the damping that stays unused (default 0.005)")
    parser.add_argument("--samples", metavar="N", help=f"random points in a box, beside the search (default {SAMPLES})")
    both = parser.add_argument_group("ccl and optimal")
    both.add_argument("--full", action="store_true", help="across channels (default: diagonal)")
    add_output_options(parser, "FILE.json", "the stored coupling (default out/design-<case>.json)")
    return parser


#: options of a design -> the couplings that take them
OPTIONS = {
    "order": ("ccl",),
    "method": ("ccl",),
    "compare": ("ccl",),
    "full": ("ccl", "optimal"),
    "functions": ("optimal",),
    "filter": ("optimal",),
    "objective": ("optimal",),
    "high_gain": ("optimal",),
    "margin": ("optimal",),
}


def _options(args: argparse.Namespace) -> dict[str, Any]:
    """The options of the design's own function. Raises InputError where they are for another coupling."""
    given = {name: getattr(args, name) for name in OPTIONS if getattr(args, name) not in (None, False)}
    for name in given:
        if args.coupling not in OPTIONS[name]:
            allowed = " or ".join(OPTIONS[name])
            raise InputError(f"--{name.replace('_', '-')} is for --coupling {allowed}, not {args.coupling}")
    given.pop("compare", None)
    for name in ("order", "functions"):
        if name in given:
            (given[name],) = numbers(f"--{name}", given[name], int, 1)
    if not 1 <= given.get("order", 1) <= 10:
        raise InputError(f"--order is {given['order']}, allowed are 1 to 10")
    if given.get("high_gain") == "none":
        given["high_gain"] = None
    elif "high_gain" in given:
        (given["high_gain"],) = numbers("--high-gain", given["high_gain"], float, 1)
    if "margin" in given:
        (given["margin"],) = numbers("--margin", given["margin"], float, 1)
    if given.pop("full", False):
        given["diagonal"] = False
    return given


def _loop(args: argparse.Namespace, scenario: Scenario) -> Loop:
    """The scenario's loop with the range of delays that --jitter gives. Raises InputError."""
    loop = scenario.loop(args.case)
    if args.jitter is None:
        return loop
    if not _for_switching(args):
        raise InputError("--jitter is for --coupling optimal, or spring-damper with --condition closed-loop")
    if loop.box:
        raise InputError("--jitter and [box]: switching delays are judged in one environment; give one of them")
    lo, hi = ranges("--jitter", args.jitter, len(loop.theta))
    if any(not 0 <= a <= b <= LONGEST_DELAY for a, b in zip(lo, hi, strict=True)):
        raise InputError(f"--jitter is {args.jitter!r}, expected 0 <= LO <= HI <= {LONGEST_DELAY} samples")
    try:
        return loop.switching(DelayRange(lo, hi))
    except ValueError as error:
        raise InputError(f"--jitter is {args.jitter!r}: {error}") from None


def _for_switching(args: argparse.Namespace) -> bool:
    """Whether this design can be made for delays that vary; any other is only judged under them."""
    condition = args.condition or KINDS[args.coupling][0]
    return args.coupling in ("spring-damper", "optimal") and condition == "closed-loop"


def _switching(args: argparse.Namespace, loop: Loop) -> dict[str, Any]:
    """The range of delays that a design must bear, as an option of the design's own function."""
    return {"switching": (loop.jitter.lo, loop.jitter.hi)} if loop.jitter and _for_switching(args) else {}


def _switching_figures(loop: Loop, coupling: Coupling) -> dict[str, Any] | None:
    """What any switching asks of the designed coupling, from the coupling alone."""
    if loop.jitter is None:
        return None
    return switching_part(switching_requirement(loop, coupling), loop.sent(coupling), loop.jitter)


def _samples(args: argparse.Namespace) -> int:
    (samples,) = numbers("--samples", args.samples or str(SAMPLES), int, 1)
    if not 0 <= samples <= 10_000:
        raise InputError(f"--samples is {samples}, allowed are 0 to 10000")
    return samples


def _price(args: argparse.Namespace, loop: Loop, design: Design, options: dict[str, Any]) -> list[dict[str, Any]]:
    """The coupling over the box; an optimal one beside the one for the nominal environment alone."""
    couplings = {args.coupling: design.coupling}
    if args.coupling == "optimal":
        couplings = {"whole set": design.coupling}
        try:
            alone = design_by_kind(loop.at(loop.environment), "optimal", None, **options)
            couplings = {"nominal only": alone.coupling, **couplings}
        except DesignFailed:  # the set is given another basis by default
            pass
    return [cost_part(row) for row in price(loop, couplings)]


def _store(loop: Loop, design: Design, whole: SetCheck | None, out: Path) -> dict[str, Any]:
    """Save the coupling with the proof of its condition, or without where there is none yet.

    What is not proved for a whole set, or for switching delays, is kept as what it is: a coupling for the nominal
    environment, or for constant delays.
    """
    if whole and whole.proved and design.condition == "closed-loop":
        certificate, reason = whole.certificate, None
    else:
        loop = loop if design.condition == "theorem4" else loop.at(loop.environment)
        certificate, reason = _proved(loop, design)
    switching = None
    if loop.jitter:
        proof = certificate.proof if certificate else None
        switching = {"promise": f"{switching_promise(loop.jitter)}, in {HERE}", "proof": proof, "reason": reason}
        if certificate is None:
            loop = loop.switching(None)
            certificate, reason = _proved(loop, design)
    try:
        save(Stored.of(loop, design.coupling, certificate), out)
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror}") from None
    proof = certificate.proof if certificate else None
    return {"file": str(out), "proof": proof, "reason": reason, "switching": switching}


def _proved(loop: Loop, design: Design) -> tuple[Certificate | None, str | None]:
    """The certificate of all that the loop claims, or why there is none."""
    try:
        phi = None if design.phi is None else design.phi.tolist()
        return prove(loop, design.coupling, design.condition, phi), None
    except NotProved as error:
        return None, str(error)
