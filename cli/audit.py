"""python -m design.audit: are these gains safe, with what margin, and where does it bind?"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table

from cli import options, render
from controller.coupling import Coupling, NoCoupling, SpringDamper
from controller.loop import DelayRange, Loop
from controller.older import AUDITS, with_older
from design.audit import LONGEST_DELAY, report
from design.certificate import check_ranges
from design.coverage import ranges_rows
from design.designs import KINDS
from design.result import CONDITIONS, listed
from models.device import CATALOGUE, Listed, listed_device
from sim.couplings import check_stored, fitted, read_coupling
from sim.report import encoder_steps
from sim.scenario import InputError, Scenario

_EXAMPLE = """python -m design.audit --case I --K 2870,2320 --B 5.47,5.55
  python -m design.audit --rigid --K 5000 --B 0 --T 1e-3 --theta 0 --delta 1.37
  python -m design.audit --case I --K 879,552 --B 0.39,0.52 --varying-delay 1,2
  python -m design.audit --device falcon --delta 0.5
  python -m design.audit --devices"""


def main(argv: list[str]) -> int:
    """Audit a coupling. 0: safe in this environment and at every vertex of its ranges, 1: not."""
    args = _parser().parse_args(argv)
    if args.devices:
        beside = [name for name in ("K", "B", "coupling", "device", "rigid") if getattr(args, name)]
        if beside:
            raise InputError(f"--devices with --{beside[0]}: the list is of the whole catalogue, give one of them")
        return _list_devices(args)
    args = _with_device(args)
    scenario = options.scenario_from(args)
    loop = options.rigid_loop(args, scenario) if args.rigid else scenario.loop(args.case)
    coupling = _coupling(args, loop.channels, scenario)
    switching = _switching(args, loop)
    out = options.out_folder(args, "audit")

    begin = time.perf_counter()
    with render.progress("searching the ranges" if loop.ranges else "judging the coupling") as move:
        whole = check_ranges(loop, coupling, args.seed, progress=move)
    try:
        judged = report(loop, coupling, switching, whole)
    except ValueError as error:
        raise InputError(str(error)) from None
    outcome = {
        "case": args.case,
        "scenario": None if args.rigid else scenario.name,
        "device": args.device and {"name": args.device, **_device_part(CATALOGUE[args.device])},
        "gains": args.source if args.device else None,
        **judged,
        "encoder": None if args.rigid else encoder_steps(scenario, args.case, coupling),
        "notes": _notes(args, scenario, switching),
        "wall_s": time.perf_counter() - begin,
    }
    outcome = with_older(outcome, AUDITS)
    render.publish(args, outcome, _tables(outcome), _remarks(outcome), out)
    proof = outcome["switching"]
    holds = outcome["certified"] and (proof is None or proof["certified"])
    return options.DONE if holds else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    what = "Say whether a coupling is safe for every passive human, and how far."
    parser = options.Parser("design.audit", what, _EXAMPLE)
    coupling = parser.add_argument_group("the coupling")
    stiffness = options.several(float, 1e-3, 1e9, "N/m")  # far from overflow, and so is the damping
    coupling.add_argument("--K", type=stiffness, metavar="K,K,..", help="stiffness per channel [N/m]; one is for all")
    damping = options.several(float, 0, 1e6, "N s/m")
    coupling.add_argument("--B", type=damping, metavar="B,B,..", help="damping per channel [N s/m]; one is for all")
    coupling.add_argument("--coupling", metavar="FILE.json", help="a stored coupling, in place of --K and --B")
    device = "its damping and, where no gains are given, the largest that CHAI3D allows it, on a rigid wall at 1 kHz"
    coupling.add_argument("--device", metavar="NAME", help=f"of the catalogue: {device}; other options go first")
    coupling.add_argument("--devices", action="store_true", help="list the catalogue, with a source for every number")
    options.add_loop_options(parser)
    options.add_rigid_option(parser)
    switching = "also any switching of the forces' delays in this range [samples]; or LO-HI,LO-HI,.. per channel"
    options.add_varying_delay_option(parser, switching)
    options.add_output_options(parser)
    return parser


def _with_device(args: argparse.Namespace) -> argparse.Namespace:
    """The options, with the catalogue's numbers where none are given; `source` allows its gains. Raises InputError."""
    if not args.device:
        return args
    try:
        name, device = listed_device(args.device)
    except ValueError as error:
        raise InputError(f"--{error}") from None
    found: dict[str, Any] = {"device": name, "source": None}
    if args.delta is None:
        if device.damping is None:
            raise InputError(f"--device {name}: nobody publishes its damping: give --delta, as measured by hw.identify")
        found["delta"] = (device.damping[0].value,)
    gained = args.coupling or args.case == "none" or (args.K and args.B)
    if device.stiffness and device.framework_damping and not gained:
        found["source"] = f"K and B: {device.stiffness.source}; T: the 1 kHz that haptic loops customarily run at"
        largest = {"K": (device.stiffness.value,), "B": (device.framework_damping.value,)}
        given = {key: value for key, value in vars(args).items() if value is not None and value is not False}
        found |= {key: value for key, value in (largest | _FRAMEWORK_LOOP).items() if key not in given}
    return argparse.Namespace(**(vars(args) | found))


_FRAMEWORK_LOOP: dict[str, Any] = {"T": 1e-3, "theta": (0,), "rigid": True}

_UNITS = {"damping": 1.0, "mass": 1e3, "force_limit": 1.0, "encoder_step": 1e6, "friction": 1.0, "stiffness": 1.0}


def _device_part(device: Listed) -> dict[str, Any]:
    """The published numbers of a device with their sources; null where none is published."""
    part: dict[str, Any] = {"title": device.title}
    for name in (*_UNITS, "framework_damping"):
        fact = getattr(device, name)
        if name == "damping" and fact:
            part[name] = {"least": fact[0].value, "most": fact[1].value, "source": fact[0].source}
        else:
            part[name] = fact and asdict(fact)
    return part


def _list_devices(args: argparse.Namespace) -> int:
    """Print the catalogue."""
    parts = {name: _device_part(device) for name, device in CATALOGUE.items()}
    sources = [part[field]["source"] for part in parts.values() for field in part if field != "title" and part[field]]
    numbered = {source: i for i, source in enumerate(dict.fromkeys(sources), start=1)}

    def cell(part: dict[str, Any], field: str) -> str:
        fact = part[field]
        if fact is None:
            return "unknown"
        value = fact["least"] if field == "damping" else fact["value"]
        return f"{value * _UNITS[field]:g}[{numbered[fact['source']]}]"

    heads = ("device", "damping N s/m", "mass g", "force N", "encoder um", "friction N", "CHAI3D N/m")
    rows = [(name, *(cell(part, field) for field in _UNITS)) for name, part in parts.items()]
    title = "what is published: the last column is the stiffness that CHAI3D allows"
    lines = [f"[{i}] {source}" for source, i in numbered.items()]
    lines.append("What is unknown is given beside `device` in a scenario, or with --delta: hw.identify measures it.")
    render.publish(args, {"devices": parts}, [render.grid(title, heads, rows)], lines)
    return options.DONE


def _coupling(args: argparse.Namespace, channels: int, scenario: Scenario) -> Coupling:
    gains = [name for name in ("K", "B") if getattr(args, name) is not None]
    given = [f"--{name}" for name in (*gains, *(["coupling"] if args.coupling else []))]
    if args.case == "none":
        if given or args.rigid:
            raise InputError(f"{(given or ['--rigid'])[0]} with --case none: that case is the loop without coupling")
        return NoCoupling()
    if args.coupling:
        if gains:
            raise InputError(f"{given[0]} with --coupling: give one of them")
        if args.coupling in KINDS and not Path(args.coupling).exists():
            design = f"`python -m design --coupling {args.coupling} --out {args.coupling}.json`"
            raise InputError(
                f"--coupling {args.coupling}: an audit takes the file of a coupling; make it with {design}"
            )
        return fitted(read_coupling(args.coupling), args.coupling, channels, scenario.T)
    if len(gains) == 1:
        missing = "B" if gains == ["K"] else "K"
        raise InputError(f"--{gains[0]} without --{missing}: a spring-damper has both (--B 0 is a spring alone)")
    if not gains:
        raise InputError("nothing to audit: give --K and --B, --coupling FILE.json, --device NAME or --case none")
    K, B = (options.per_channel(f"--{name}", getattr(args, name), channels) for name in "KB")
    return SpringDamper(K, B)


def _switching(args: argparse.Namespace, loop: Loop) -> DelayRange | None:
    """The range of --varying-delay, or of the scenario, around the constant theta that the other conditions are about.

    Raises InputError.
    """
    if args.varying_delay is None:
        return loop.varying_delay
    lo, hi = options.ranges_per_channel("--varying-delay", args.varying_delay, loop.channels)
    for i, (least, n, largest) in enumerate(zip(lo, loop.theta, hi, strict=True)):
        if not 0 <= least <= n <= largest <= LONGEST_DELAY:
            allowed = f"0 <= LO <= theta = {n} <= HI <= {LONGEST_DELAY} samples (--theta gives another)"
            raise InputError(f"--varying-delay on channel {i + 1} is {least} to {largest}, expected {allowed}")
    return DelayRange(lo, hi)


def _notes(args: argparse.Namespace, scenario: Scenario, switching: DelayRange | None) -> list[str]:
    """What the coupling's file is worth in the loop that is audited."""
    if args.coupling is None:
        return []
    loop = scenario.loop(args.case)
    return list(check_stored(read_coupling(args.coupling), loop.switching(switching)).notes)


# ----------------------------------------------------------------------------------------------------
# The report as a table, and what it does not cover.


def _tables(outcome: dict[str, Any]) -> list[Table]:
    parts = [outcome[condition] for condition in CONDITIONS]
    table = Table("", *CONDITIONS, title=_verdict(outcome), title_justify="left")
    for name, cell in _ROWS.items():
        table.add_row(name, *(cell(part) for part in parts))
    if not outcome["ranges"]:
        return [table]
    return [table, render.facts("the ranges around the environment", ranges_rows(outcome["ranges"]), left=True)]


def _verdict(outcome: dict[str, Any]) -> str:
    coupling = outcome["coupling"]
    gains = f" K {listed(coupling['K'])} N/m, B {listed(coupling['B'])} N s/m" if coupling["K"] else ""
    verdict = f"[green]certified[/] for {outcome['promise']}" if outcome["certified"] else "[red]not certified[/]"
    if outcome["promise"] and not outcome["certified"]:
        verdict += f" for the ranges, only for {outcome['promise']}"
    return f"{coupling['kind']}{gains}: {verdict}"


def _needs(part: dict[str, Any]) -> str:
    word = "[green]certified[/]" if part["certified"] else "[red]not certified[/]"
    return f"{render.needs(part)}: {word}"


def _error(key: str, sign: str) -> Callable[[dict[str, Any]], str]:
    """A relative error in percent, rounded down so that what is printed is tolerated."""

    def cell(part: dict[str, Any]) -> str:
        error = part["sensitivity"][key]
        return "-" if error is None else f"{sign}{math.floor(1e4 * error) / 100:.2f} %"

    return cell


def _stiffest(K: Sequence[float | None]) -> str:
    """To five digits, rounded down so that what is printed is certified."""
    if None in K:
        return "-"
    units = ((k, 10.0 ** (math.floor(math.log10(k)) - 4)) for k in K if k is not None)
    return ", ".join(f"{math.floor(k / unit) * unit:.5g}" for k, unit in units) + " N/m"


#: name of a row -> what stands in it, given the part of a condition
_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "needs damping": _needs,
    "margin": lambda part: render.optional(part["margin"], "{:.5g}"),
    "binds at": lambda part: render.optional(part["binding_frequency_hz"], "{:.5g} Hz"),
    "stiffest K here": lambda part: _stiffest(part["stiffest"]["K"]),
    "delta error": _error("delta_error", "-"),
    "T error": _error("T_error", "+"),
    "spare samples": lambda part: render.optional(part["sensitivity"]["extra_samples"], "{:.5g}"),
}


def _remarks(outcome: dict[str, Any]) -> list[str]:
    lines = [f"{note}." for note in outcome["notes"]]
    for condition in CONDITIONS:
        part = outcome[condition]
        sensitivity = part["sensitivity"].get("reason") if part["certified"] else None
        reasons = {"": part.get("reason"), ", stiffest K": part["stiffest"].get("reason"), ", sensitivity": sensitivity}
        lines += [f"{condition}{of}: {reason}." for of, reason in reasons.items() if reason]
    if not outcome["certified"]:
        lines += _proposed(outcome["helps"])
    if (part := outcome["switching"]) is not None:
        lines += _switching_remarks(part)
    if part := outcome["encoder"]:
        lines.append(f"{part['words'][0].upper()}{part['words'][1:]}.")
    return [*lines, outcome["not_covered"]]


def _proposed(helps: Sequence[dict[str, Any]]) -> list[str]:
    """Changes that were certified, the one that leaves most damping over first."""
    enough = sorted((each for each in helps if each["certified"]), key=lambda each: max(each["required_damping"]))
    if not enough:
        return ["What helps: no single change of delay, damper or period was found to; a design finds other gains."]
    return [
        f"What helps: {each['change']} ({each['condition']} then needs "
        f"{listed(each['required_damping'])} N s/m, certified)."
        for each in enough
    ]


def _switching_remarks(part: dict[str, Any]) -> list[str]:
    span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(part["lo"], part["hi"], strict=True))
    needs = f"needs {render.needs(part)}: {render.certified(part)}"
    lines = [f"Any switching of the delays ({span} samples) {needs}."]
    if "playout" not in part:
        return [*lines, f"any switching: {part['reason']}."]
    buffered = part["playout"]
    enough = "certified" if buffered["certified"] else "not certified"
    played = f"{listed(buffered['required_damping'])} N s/m: {enough}"
    return [*lines, f"A playout buffer to the constant {listed(part['hi'])} needs {played}.", part["not_covered"]]
