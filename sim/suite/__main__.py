"""python -m sim.suite (make validate): every check that a verdict rests on, in one report for a stranger.

A check is a command with its options, run as a user would run it; the report shows that command beside its numbers.
A further check is one more line in CHECKS.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shlex
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console

from controller.lti import SingularLoop
from design.failure import DesignFailed
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    check_json,
    console,
    execute,
    numbers,
    seed_from,
)
from sim.files import folder, write, write_json
from sim.scenario import InputError
from sim.suite import report as suite_report
from sim.suite.report import Part


@dataclass(frozen=True)
class Check:
    """A question, the command that answers it, and how its JSON report reads as figures."""

    name: str  # of its folder, too
    asks: str
    command: str  # module and options; {humans} and {seed} are filled in
    figures: Callable[[dict[str, Any]], list[Part]]


_MEET = "--humans {humans} --links mixed --duration 1 --adversary --generations 60 --seed {seed}"

CHECKS = (
    Check("none", "Two devices without a coupling", f"sim.validate --case none {_MEET}", suite_report.verdicts),
    Check("I", "A coupling for any passive environment", f"sim.validate --case I {_MEET}", suite_report.verdicts),
    Check(
        "II",
        "The same, designed against an undelayed reference",
        f"sim.validate --case II {_MEET}",
        suite_report.verdicts,
    ),
    Check(
        "stiff",
        "The stiffest coupling for this environment alone",
        f"sim.validate --case I --condition closed-loop {_MEET}",
        suite_report.verdicts,
    ),
    Check(
        "optimal",
        "The best linear coupling for this environment",
        f"sim.validate --case I --coupling optimal {_MEET}",
        suite_report.verdicts,
    ),
    Check(
        "published",
        "The gains that the paper prints",
        f"sim.validate --case I --coupling published {_MEET}",
        suite_report.verdicts,
    ),
    Check(
        "three",
        "Three people, rigid devices, unequal delays",
        f"sim.validate --scenario three-rigid --case I {_MEET}",
        suite_report.verdicts,
    ),
    Check(
        "tightness",
        "How tight is the condition?",
        "sim.tightness --case I --generations 25 --seed {seed}",
        suite_report.tightness,
    ),
    Check(
        "delayed",
        "How tight is it with long delays?",
        "sim.tightness --case none --theta 4,9 --short 0,0.2,0.5,1,2 --seed {seed}",
        suite_report.tightness,
    ),
    Check(
        "map",
        "Which springs and dampers may a device render against a wall?",
        "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8 --seed {seed}",
        suite_report.gain_map,
    ),
    Check("accuracy", "Is MuJoCo right, and at what cost?", "sim.accuracy --duration 6", suite_report.accuracy),
    Check("hard", "Numerically hard loops", "sim.hard", suite_report.hard),
)


@dataclass(frozen=True)
class Answer:
    """What a check found. Its files are in the folder of its name."""

    check: Check
    command: str
    code: int | None  # the command's exit code; None where it broke off with `trouble`
    wall_s: float
    parts: tuple[Part, ...] = ()
    pictures: tuple[str, ...] = ()  # paths from the report's folder
    trouble: str | None = None
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        return self.code == DONE


def main(argv: list[str]) -> int:
    """Run the checks. 0: all hold, 1: one does not, 130: interrupted; what was done is in the report."""
    args = _parser().parse_args(argv)
    checks, humans, seed = _chosen(args), _humans(args), seed_from(args)
    check_json(args)
    out, screen = folder(Path(args.out or "out/validate")), console(args)
    answers: list[Answer] = []
    begin, interrupted = time.perf_counter(), False
    for number, check in enumerate(checks, start=1):
        screen.print(f"[dim]{number}/{len(checks)}[/] {check.asks} ...", end="\n" if screen.is_terminal else " ")
        try:
            answers.append(ask(check, out, humans, seed))
        except KeyboardInterrupt:
            interrupted = True
            break
        _tell(answers[-1], screen)
        if interrupted := answers[-1].code == INTERRUPTED:
            break
    outcome = _outcome(answers, checks, humans, seed, interrupted, time.perf_counter() - begin)
    outcome["files"] = [str(write(out / "report.md", suite_report.markdown(outcome)))]
    outcome["files"].append(str(out / "report.json"))
    write_json(out / "report.json", outcome)
    screen.print(f"{suite_report.headline(outcome)} Report: {out / 'report.md'}")
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def ask(check: Check, out: Path, humans: int, seed: int) -> Answer:
    """Run one check's command with its files in `out`/name; bad input and impossible designs are its trouble."""
    command = check.command.format(humans=humans, seed=seed)
    module, *options = shlex.split(command)
    place = out / check.name
    begin = time.perf_counter()
    trouble, code = None, None
    for old in (place / "report.json", *place.glob("*.png")):  # of an earlier run: never shown as this one's
        old.unlink(missing_ok=True)
    try:
        with redirect_stdout(StringIO()):
            code = entry(module).main([*options, "--out", str(place)])
    except (InputError, SingularLoop, DesignFailed) as error:
        trouble = " ".join(str(error).split())
    wall = time.perf_counter() - begin
    written = place / "report.json"
    report = json.loads(written.read_text()) if written.exists() else {}
    parts = tuple(check.figures(report)) if report else ()
    pictures = tuple(path.relative_to(out).as_posix() for path in sorted(place.glob("*.png")))
    return Answer(check, f"python -m {command}", code, wall, parts, pictures, trouble, report)


def entry(module: str) -> ModuleType:
    """What `python -m module` runs: the module, or the __main__ of a package."""
    found = importlib.import_module(module)
    return importlib.import_module(f"{module}.__main__") if hasattr(found, "__path__") else found


def _parser() -> Parser:
    parser = Parser(
        "sim.suite",
        "Run every check that a verdict rests on and write one report.",
        "python -m sim.suite --only I,hard --humans 200",
    )
    names = ",".join(check.name for check in CHECKS)
    parser.add_argument("--only", metavar="NAME,..", help=f"of {names} (default all)")
    parser.add_argument("--humans", default="300", metavar="N", help="random humans per loop (default 300)")
    output = parser.add_argument_group("output")
    output.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    output.add_argument("--out", metavar="DIR", help="folder for the report (default out/validate)")
    output.add_argument("--seed", metavar="N", default="0", help="for random draws; recorded (default 0)")
    return parser


def _chosen(args: argparse.Namespace) -> list[Check]:
    """The checks asked for, in the order of CHECKS. Raises InputError."""
    if args.only is None:
        return list(CHECKS)
    known, names = {check.name: check for check in CHECKS}, args.only.split(",")
    for name in names:
        if name not in known:
            raise InputError(f"--only has {name!r}, allowed are {', '.join(known)}")
    return [check for check in CHECKS if check.name in names]


def _humans(args: argparse.Namespace) -> int:
    (humans,) = numbers("--humans", args.humans, int, 1)
    if not 1 <= humans <= 1_000_000:
        raise InputError(f"--humans is {humans}, allowed are 1 to 1000000")
    return humans


def _outcome(
    answers: Sequence[Answer], checks: Sequence[Check], humans: int, seed: int, interrupted: bool, wall: float
) -> dict[str, Any]:
    return {
        "holds": len(answers) == len(checks) and all(answer.holds for answer in answers),
        "checks": [
            {
                "name": answer.check.name,
                "asks": answer.check.asks,
                "command": answer.command,
                "exit_code": answer.code,
                "holds": answer.holds,
                "trouble": answer.trouble,
                "wall_s": answer.wall_s,
                "parts": [asdict(part) for part in answer.parts],
                "pictures": list(answer.pictures),
                "report": answer.report,
            }
            for answer in answers
        ],
        "left_out": [check.name for check in checks[len(answers) :]],
        "humans": humans,
        "seed": seed,
        "interrupted": interrupted,
        "wall_s": wall,
        "machine": suite_report.machine(),
    }


def _tell(answer: Answer, screen: Console) -> None:
    verdict = "[green]holds[/]" if answer.holds else f"[red]{answer.trouble or 'does not hold'}[/]"
    if answer.code == INTERRUPTED:
        verdict = "[yellow]interrupted[/]"
    screen.print(f"{verdict} ({answer.wall_s:.1f} s)")


if __name__ == "__main__":
    execute(main)
