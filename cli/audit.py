"""python -m design.audit: are these gains safe, with what margin, and where does it bind?

options -> Subject (coupling, loop, environment or rigid wall) -> both conditions -> report
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    Parser,
    add_loop_options,
    add_output_options,
    add_rigid_option,
    console,
    numbers,
    out_folder,
    progress_bar,
    ranges,
    rigid_loop,
    scenario_from,
    seed_from,
)
from controller.coupling import Coupling, NoCoupling, SpringDamper
from controller.loop import DelayRange
from design.audit import LONGEST_DELAY, PRESETS, Subject, print_report, report
from design.designs import KINDS
from design.ranges import check_set
from sim.couplings import fitted, read_coupling, standing
from sim.files import write_json
from sim.scenario import InputError, Scenario

EXAMPLE = """python -m design.audit --case I --K 2870,2320 --B 5.47,5.55
  python -m design.audit --rigid --K 5000 --B 0 --T 1e-3 --theta 0 --delta 1.37
  python -m design.audit --case I --K 879,552 --B 0.39,0.52 --jitter 1,2
  python -m design.audit --preset chai3d-omega3"""

#: what a gain may be: within these, all arithmetic is far from overflow
STIFFNESSES, DAMPINGS = (1e-3, 1e9, "N/m"), (0.0, 1e6, "N s/m")


def main(argv: list[str]) -> int:
    """Audit a coupling. 0: safe in this environment and at every vertex of its box, 1: not."""
    args = _with_preset(_parser().parse_args(argv))
    seed = seed_from(args)
    scenario = scenario_from(args)
    subject = _subject(args, scenario)
    switching = _range(args, scenario, subject)
    out = out_folder(args, "audit")

    begin = time.perf_counter()
    with (bar := progress_bar("searching the box"))[0]:
        loop = None if args.rigid else scenario.loop(args.case)
        whole = loop and check_set(loop, subject.coupling, seed, progress=bar[1])
    outcome = {
        "case": args.case,
        "scenario": None if args.rigid else scenario.name,
        "preset": args.preset and {"name": args.preset, "source": PRESETS[args.preset].source},
        **report(subject, switching, whole),
        "notes": _notes(args, scenario, switching),
        "wall_s": time.perf_counter() - begin,
    }
    write_json(out / "report.json", outcome)
    print_report(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    proof = outcome["jitter-proof"]
    return DONE if outcome["certified"] and (proof is None or proof["certified"]) else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser("design.audit", "Say whether a coupling is safe for every passive human, and how far.", EXAMPLE)
    what = parser.add_argument_group("the coupling")
    what.add_argument("--K", metavar="K,K,..", help="stiffness per channel [N/m]; one is for all")
    what.add_argument("--B", metavar="B,B,..", help="damping per channel [N s/m]; one is for all")
    what.add_argument("--coupling", metavar="FILE.json", help="a stored coupling, in place of --K and --B")
    what.add_argument("--preset", choices=tuple(PRESETS), help="limits that a framework ships; other options go first")
    add_loop_options(parser)
    add_rigid_option(parser)
    switching = "also any switching of the forces' delays in this range [samples]; or LO-HI,LO-HI,.. per channel"
    parser.add_argument("--jitter", metavar="LO,HI", help=switching)
    add_output_options(parser)
    return parser


def _with_preset(args: argparse.Namespace) -> argparse.Namespace:
    """The options, with a preset's numbers where none are given."""
    if not args.preset:
        return args
    if args.coupling:
        raise InputError("--preset with --coupling: give one of them")
    preset = PRESETS[args.preset]
    fixed = {"K": str(preset.K), "B": str(preset.B), "T": str(preset.T), "theta": "0", "rigid": True}
    given = {name: value for name, value in vars(args).items() if value not in (None, False)}
    return argparse.Namespace(**(vars(args) | fixed | given))


def _subject(args: argparse.Namespace, scenario: Scenario) -> Subject:
    if args.rigid:
        loop = {"network": None, "delta": scenario.delta[:1], **rigid_loop(args, scenario)}
    else:
        delays = {"theta": scenario.theta, "psi": scenario.psi}
        loop = {"network": scenario.environment, "delta": scenario.delta, **delays}
    coupling = _coupling(args, len(loop["delta"]), scenario)
    try:
        return Subject(coupling, T=scenario.T, **loop)
    except ValueError as error:
        raise InputError(str(error)) from None


def _notes(args: argparse.Namespace, scenario: Scenario, switching: DelayRange | None) -> list[str]:
    """What the coupling's file is worth in the loop that is audited."""
    if args.coupling is None:
        return []
    loop = scenario.loop(args.case)
    return list(standing(read_coupling(args.coupling), loop.switching(switching)).notes)


def _range(args: argparse.Namespace, scenario: Scenario, subject: Subject) -> DelayRange | None:
    """The range of --jitter, or of the scenario, around the constant theta that the other conditions are about.

    Raises InputError.
    """
    if args.jitter is None:
        return None if args.rigid else scenario.loop(args.case).jitter
    lo, hi = ranges("--jitter", args.jitter, subject.channels)
    for i, (least, n, largest) in enumerate(zip(lo, subject.theta, hi, strict=True)):
        if not 0 <= least <= n <= largest <= LONGEST_DELAY:
            allowed = f"0 <= LO <= theta = {n} <= HI <= {LONGEST_DELAY} samples (--theta gives another)"
            raise InputError(f"--jitter on channel {i + 1} is {least} to {largest}, expected {allowed}")
    return DelayRange(lo, hi)


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
            raise InputError(
                f"--coupling {args.coupling}: an audit takes the file of a coupling; make it with "
                f"`python -m design --coupling {args.coupling} --out {args.coupling}.json`"
            )
        return fitted(read_coupling(args.coupling), args.coupling, channels, scenario.T)
    if len(gains) == 1:
        missing = "B" if gains == ["K"] else "K"
        raise InputError(f"--{gains[0]} without --{missing}: a spring-damper has both (--B 0 is a spring alone)")
    if not gains:
        raise InputError("nothing to audit: give --K and --B, --coupling FILE.json, --preset NAME or --case none")
    return SpringDamper(_gains("--K", args.K, channels, STIFFNESSES), _gains("--B", args.B, channels, DAMPINGS))


def _gains(option: str, text: str, channels: int, allowed: tuple[float, float, str]) -> tuple[float, ...]:
    low, high, unit = allowed
    values = numbers(option, text, float, channels)
    for value in values:
        if not low <= value <= high:
            raise InputError(f"{option} is {value:g}, allowed are {low:g} to {high:g} {unit}")
    return values
