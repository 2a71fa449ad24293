"""python -m design.audit: assess a coupling, and report its margins and the frequency that limits each of them."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from haptic_loop.cli import options, render
from haptic_loop.cli import verdict as verdicts
from haptic_loop.controller.coupling import Coupling, NoCoupling, SpringDamper
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.design.files import off_table
from haptic_loop.design.result import Requirement, listed
from haptic_loop.models.device import CATALOGUE, listed_device
from haptic_loop.sim.scenario import InputError, Scenario, is_world

if TYPE_CHECKING:
    from haptic_loop.design.audit import Audit, Help, Margins
    from haptic_loop.design.coverage import SwitchingFigures

_EXAMPLES = (
    "python -m design.audit --K 2870,2320 --B 5.47,5.55",
    "python -m design.audit --rigid --K 5000 --B 0 --T 1e-3 --theta 0 --delta 1.37",
)


@dataclass(frozen=True, eq=False)
class _Report:
    """An audit and the sources of its numbers, in SI units; a missing figure is null, with a "reason"."""

    case: str
    scenario: str | None
    device: dict[str, Any] | None  # name and figures of the listed device
    gains: str | None  # source of the listed device's gains; None if they are not used
    audit: Audit = off_table("inlined")
    notes: tuple[str, ...] = off_table()
    wall_s: float = off_table()


def main(argv: list[str]) -> int:
    """Audit a coupling. Return 0 if the required condition is certified, including the loop's ranges, 1 if not."""
    args = _parser().parse_args(argv)
    from haptic_loop.design.audit import audit
    from haptic_loop.design.certificate import named
    from haptic_loop.design.designs import name_and_own
    from haptic_loop.sim.couplings import from_file, qualified, read_coupling

    if args.devices:
        return _list_devices(args)
    args = _with_device(args)
    if replaced := [name for name in ("world", "environment") if args.rigid and getattr(args, name)]:
        wall = "CHAI3D's gains are judged on a rigid wall; give --K and --B"
        raise InputError(f"--{replaced[0]} with --device {args.device}: {wall}")
    scenario = options.scenario_from(args)
    if args.world:
        scenario = options.in_world(scenario, args.world)
    if is_world(scenario) and not args.rigid:
        return _audited_world(args, scenario)
    loop = options.rigid_loop(args, scenario) if args.rigid else scenario.loop(args.case)
    coupling = _coupling(args, loop, scenario)
    condition = named(args.condition) if args.condition else None
    with options.refused("--varying-delay: "):
        loop = loop.switching(_switching(args, loop))
    out = options.out_folder(args, "audit")

    begin = time.perf_counter()
    what = "searching the ranges" if loop.ranges else "proving the conditions"
    with render.progress(what) as move, options.refused():
        audited = audit(loop, coupling, condition, args.seed, move)
    if not args.rigid:  # The loop before a rigid wall is judged without the scenario's encoder steps and lost packets.
        audited = replace(audited, assessment=qualified(scenario, args.case, audited.assessment))
    notes = ()
    if args.coupling and not _is_own(args):
        notes = from_file(read_coupling(args.coupling), loop, own=condition).notes
    _, own = name_and_own(condition)
    notes = (*notes, own.remark(audited.assessment.requirements[own.name])) if own else notes
    report = _Report(
        args.case,
        None if args.rigid else scenario.name,
        {"name": args.device} | render.plain(CATALOGUE[args.device]) if args.device else None,
        args.source if args.device else None,
        audited,
        notes,
        time.perf_counter() - begin,
    )
    verdict = verdicts.verdict(audited.assessment)
    if args.rigid and isinstance(coupling, SpringDamper):
        verdict = f"{verdict} {_stiffest_wall(audited, coupling)}"
    caveats = [audited.not_covered, *([audited.switching.not_covered or ""] if audited.switching else [])]
    render.publish(args, report, _tables(audited), _remarks(report), out, verdict=verdict, details=caveats)
    return options.exit_code(audited.assessment.holds)


def _parser() -> options.Parser:
    what = "Say whether a coupling is safe for every passive human, and with what margin."
    parser = options.Parser("design.audit", what, *_EXAMPLES, first="K B rigid device scenario json")
    coupling = parser.add_argument_group("the coupling")
    stiffness = options.several(float, 1e-3, 1e9, "N/m")  # These limits prevent overflow, as the limits of B do.
    coupling.add_argument("--K", type=stiffness, metavar="K,K,..", help="stiffness per channel [N/m], or one for all")
    damping = options.several(float, 0, 1e6, "N s/m")
    coupling.add_argument("--B", type=damping, metavar="B,B,..", help="damping per channel [N s/m], or one for all")
    stored = "a stored coupling, or a function of your own, in place of --K and --B"
    coupling.add_argument("--coupling", metavar="FILE.json|FILE.py:NAME", help=stored)
    parser.add_condition(
        "condition that must hold for exit code 0 (default this-environment, or known-device for known devices); the "
        "report judges this-environment and any-environment in any case",
        to=coupling,
    )
    device = "its damping and, unless gains are given, CHAI3D's largest gains on a rigid wall at 1 kHz"
    coupling.add_argument("--device", metavar="NAME", help=f"use a listed device: {device}; other options override it")
    coupling.add_argument("--devices", action="store_true", help="list the catalogue, with a source for every number")
    parser.add_loop()
    parser.add_rigid()
    scene = "a MuJoCo scene as the environment; devices touch its named bodies that have no joint, along x"
    parser.add_argument("--world", metavar="FILE.xml", help=scene)
    switching = "also judge any switching of the forces' delays in this range [samples]; or LO-HI,LO-HI,.. per channel"
    parser.add_varying_delay(switching)
    parser.add_details()
    parser.add_output()
    parser.only("without --rigid, whose wall replaces the scene", lambda args: not args.rigid, "world")
    others = "K B coupling device rigid reference scenario environment theta psi lam delta T T_max known_device "
    others += "latency condition world varying_delay details out seed"
    whole = "without --devices: the list is always the whole catalogue"
    parser.only(whole, lambda args: not args.devices, *others.split())
    return parser


def _with_device(args: argparse.Namespace) -> argparse.Namespace:
    """Return the options with the catalogue's numbers for --device, and their `source`. Raises InputError."""
    if not args.device:
        return args
    with options.refused("--"):
        name, device = listed_device(args.device)
    fields: dict[str, Any] = {"device": name, "source": None}
    if args.delta is None:
        if device.damping is None:
            raise InputError(f"--device {name}: nobody publishes its damping: give --delta, as measured by hw.identify")
        fields["delta"] = (device.damping.value,)
    gained = args.coupling or args.case == "none" or (args.K and args.B)
    if device.stiffness and device.framework_damping and not gained:
        fields["source"] = f"K and B: {device.stiffness.source}; T: the 1 kHz that haptic loops customarily run at"
        largest = {"K": (device.stiffness.value,), "B": (device.framework_damping.value,)}
        options_given = {key: value for key, value in vars(args).items() if value is not None and value is not False}
        fields |= {key: value for key, value in (largest | _FRAMEWORK_LOOP).items() if key not in options_given}
    return argparse.Namespace(**(vars(args) | fields))


_FRAMEWORK_LOOP: dict[str, Any] = {"T": 1e-3, "theta": (0,), "rigid": True}

_UNITS = {"damping": 1.0, "mass": 1e3, "force_limit": 1.0, "encoder_step": 1e6, "friction": 1.0, "stiffness": 1.0}


def _list_devices(args: argparse.Namespace) -> int:
    parts: dict[str, dict[str, Any]] = render.plain(CATALOGUE)
    facts = [fact for part in parts.values() for fact in part.values() if isinstance(fact, dict)]
    numbered = {source: i for i, source in enumerate(dict.fromkeys(fact["source"] for fact in facts), start=1)}

    def cell(fact: dict[str, Any] | None, scale: float) -> str:
        if fact is None:
            return "unknown"
        return f"{fact['value'] * scale:g}[{numbered[fact['source']]}]"

    heads = ("device", "damping N s/m", "mass g", "force N", "encoder um", "friction N", "CHAI3D N/m")
    rows = [(name, *(cell(part[field], scale) for field, scale in _UNITS.items())) for name, part in parts.items()]
    title = "published figures; the last column is the stiffness that CHAI3D allows"
    lines = [f"[{i}] {source}" for source, i in numbered.items()]
    lines.append("Give unknown figures beside `device` in a scenario, or --delta, whose value hw.identify measures.")
    render.publish(args, {"devices": parts}, [render.grid(title, heads, rows)], lines)
    return options.DONE


def _audited_world(args: argparse.Namespace, scenario: Scenario) -> int:
    """Audit a coupling in a MuJoCo world, by default a moving average that is designed here."""
    from haptic_loop.cli import world
    from haptic_loop.design.environments import ANY_ENVIRONMENT
    from haptic_loop.design.result import Chosen
    from haptic_loop.sim.couplings import choose

    world.check_audit(args)
    if args.coupling and Path(args.coupling).exists():
        chosen = choose(scenario, args.case, args.coupling)
    elif args.K or args.B or args.coupling or args.case == "none":
        coupling = _coupling(args, scenario.loop(args.case), scenario)
        chosen = Chosen(coupling, ANY_ENVIRONMENT.name, kind=args.coupling or "spring-damper")
    else:
        chosen = choose(scenario, args.case)
    return world.audit(args, scenario, chosen, options.out_folder(args, "audit"))


def _is_own(args: argparse.Namespace) -> bool:
    """Return whether --coupling names a user's own function instead of a file."""
    return ":" in (args.coupling or "") and not Path(args.coupling).exists()


def _coupling(args: argparse.Namespace, loop: Loop, scenario: Scenario) -> Coupling:
    from haptic_loop.design.designs import KINDS
    from haptic_loop.sim.couplings import fitted, own_of, read_coupling

    gains = [name for name in ("K", "B") if getattr(args, name) is not None]
    names = [f"--{name}" for name in (*gains, *(["coupling"] if args.coupling else []))]
    if args.case == "none":
        if names or args.rigid:
            raise InputError(f"{(names or ['--rigid'])[0]} with --case none: that case is the loop without coupling")
        return NoCoupling()
    if args.coupling:
        if gains:
            raise InputError(f"{names[0]} with --coupling: give one of them")
        if _is_own(args):
            return own_of(args.coupling, loop).coupling
        if args.coupling in KINDS and not Path(args.coupling).exists():
            design = f"`python -m design --coupling {args.coupling} --out {args.coupling}.json`"
            raise InputError(
                f"--coupling {args.coupling}: an audit takes the file of a coupling; make it with {design}"
            )
        return fitted(read_coupling(args.coupling), args.coupling, loop.channels, scenario.T)
    if len(gains) == 1:
        missing = "B" if gains == ["K"] else "K"
        why = "a spring-damper has both (--B 0 is a spring alone)"
        if args.rigid and missing == "K":
            why = "give any K; the first line then names the stiffest wall with this B"
        raise InputError(f"--{gains[0]} without --{missing}: {why}")
    if not gains:
        raise InputError(
            "nothing to audit: give --K and --B, --coupling FILE.json or FILE.py:NAME, --device NAME or --case none"
        )
    K, B = (options.per_channel(f"--{name}", getattr(args, name), loop.channels) for name in "KB")
    return SpringDamper(K, B)


def _switching(args: argparse.Namespace, loop: Loop) -> DelayRange | None:
    """Return the range of delays of --varying-delay or of the loop; None for constant delays.

    Raises InputError if theta lies outside of the range.
    """
    from haptic_loop.design.audit import LONGEST_DELAY

    if args.varying_delay is None:
        return loop.varying_delay
    span = options.delay_range(args.varying_delay, loop, LONGEST_DELAY)
    if not span.contains(DelayRange(loop.theta, loop.theta)):
        raise InputError(f"--varying-delay is {span}, expected a range around theta = {listed(loop.theta)} (--theta)")
    return span


# ---- the report as tables and remarks


def _tables(result: Audit) -> list[render.Table]:
    from rich.table import Table

    assessment, needs = result.assessment, result.constant
    gains = assessment.gains
    title = f" K {listed(gains['K'])} N/m, B {listed(gains['B'])} N s/m" if "K" in gains else ""
    title += ", in the nominal environment" if assessment.ranges else ""
    title += ", for constant delays" if result.switching else ""
    table = Table("", *result.margins, title=f"{assessment.coupling.kind}{title}", title_justify="left")
    for name, cell in _ROWS.items():
        table.add_row(name, *(cell(needs[condition], part) for condition, part in result.margins.items()))
    if not assessment.ranges:
        return [table]
    rows = verdicts.range_rows(assessment.ranges)
    return [table, render.facts("the ranges around the environment", rows, left=True)]


def _stiffest_wall(result: Audit, coupling: SpringDamper) -> str:
    """Return a sentence that names the stiffest certified wall with the coupling's damper, or says why it cannot."""
    condition, damper = result.assessment.condition, f"B = {listed(coupling.B)} N s/m"
    margin = result.margins[condition].stiffest
    if None in margin.K:
        return f"No stiffest wall with {damper} is given: {margin.reason}."
    return f"The stiffest wall with {damper}: {_stiffest(margin.K)} ({condition})."


def _percent(error: float | None) -> str:
    """Return a tolerated relative error in percent, rounded down."""
    return render.optional(error and math.floor(1e4 * error) / 100, "{:.2f} %")


def _stiffest(K: Sequence[float | None]) -> str:
    """Return certified stiffnesses with five digits, rounded down."""
    if None in K:
        return "-"
    units = ((k, 10.0 ** (math.floor(math.log10(k)) - 4)) for k in K if k is not None)
    return ", ".join(f"{math.floor(k / unit) * unit:.5g}" for k, unit in units) + " N/m"


#: row name -> function from the requirement and the margins of a condition to the cell
_ROWS: dict[str, Callable[[Requirement, Margins], str]] = {
    "needs damping": lambda r, _: f"{r.amounts()}: {render.certified(r, proof=False)}",
    "margin": lambda r, _: render.optional(r.margin, "{:.5g}"),
    "binds at": lambda r, _: render.optional(r.frequency_hz, "{:.5g} Hz"),
    "stiffest K here": lambda _, m: _stiffest(m.stiffest.K),
    "delta may be less by": lambda _, m: _percent(m.sensitivity.delta_error),
    "T may be longer by": lambda _, m: _percent(m.sensitivity.T_error),
    "delay may be longer by": lambda _, m: render.optional(m.sensitivity.extra_samples, "{:.5g} samples"),
}


def _remarks(report: _Report) -> Iterator[str]:
    audited = report.audit
    yield from (f"{note}." for note in report.notes)
    for condition, part in audited.margins.items():
        needs = audited.constant[condition]
        sensitivity = part.sensitivity.reason if needs.certified else None
        reasons = {
            "": needs.reason,
            ", stiffest K": part.stiffest.reason,
            ", sensitivity": sensitivity,
        }
        yield from (f"{condition}{of}: {reason}." for of, reason in reasons.items() if reason)
    if not (audited.assessment.holds or audited.switching):
        yield from _proposed(audited.helps)
    if audited.switching:
        yield from _switching_remarks(audited.switching)
    if torques := audited.assessment.held_torques:
        yield f"Held torques: {torques}."
    if left := audited.left_over:
        yield f"{left.words[0].upper()}{left.words[1:]}."
    if part := audited.assessment.encoder:
        yield f"{part.words[0].upper()}{part.words[1:]}."


def _proposed(helps: Sequence[Help]) -> Iterator[str]:
    """Yield a line for each change that certifies the coupling, by required damping, or a line that none was found."""
    enough = [each for each in helps if each.requirement.certified]
    if not enough:
        yield "What helps: no change of delay, damper or period alone was found to suffice; a design finds other gains."
    for each in sorted(enough, key=lambda each: max(each.requirement.required)):
        needs = f"{each.requirement.condition} then needs {listed(each.requirement.required)} N s/m, certified"
        yield f"What helps: {each.change} ({needs})."


def _switching_remarks(switching: SwitchingFigures) -> Iterator[str]:
    needs, buffered = switching.requirement, switching.playout
    span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(switching.lo, switching.hi, strict=True))
    any_switching = f"Any switching of the delays ({span} samples)"
    if buffered is None:
        yield f"{any_switching} is not certified: {needs.reason}."
        return
    yield f"{any_switching} {needs.words()}: {render.certified(needs)}."
    enough = "certified" if buffered.certified else "not certified"
    needed = f"needs {listed(buffered.required_damping)} N s/m"
    if math.inf in buffered.required_damping:
        needed = "fails with any damping"
    yield f"A playout buffer with the constant delay {listed(switching.hi)} samples {needed}: {enough}."
