"""python -m sim.suite (make validate): all checks of this project, in one report, verdicts first.

A check is another command with its options, run as a user would run it, or rows that tests/checks measures; the report
shows the command that repeats it beside its numbers. A further check is one more line in CHECKS, here or in
tests/checks/ours.py, which is in the repository and not in an installed package.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from typing import Any

from haptic_loop.cli import options, render
from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.design.files import folder, write, write_json
from haptic_loop.design.result import CONDITIONS, DesignFailed
from haptic_loop.sim.scenario import InputError

# ----------------------------------------------------------------------------------------------------
# The checks, and how their answers read: the gist of what a command prints, a table of rows of our own.


@dataclass(frozen=True)
class Part:
    """A table of a check; `answer` sums it up for the table of verdicts."""

    answer: str
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    title: str = ""


Row = dict[str, Any]
Figures = Callable[[dict[str, Any]], list[Part]]


@dataclass(frozen=True)
class Check:
    """A question, what answers it, and how the answer's JSON report reads."""

    name: str  # of its folder, too
    asks: str
    answer: str | Callable[[int], Iterable[Any]]  # a command ({humans}, {seed} are filled in), or rows by the seed
    figures: Figures
    picture: Callable[[Iterable[Any], Path], object] | None = None  # draws the rows

    def command(self, humans: int, seed: int) -> str:
        """The command that repeats this check."""
        own = f"sim.suite --only {self.name} --seed {{seed}}"
        return (self.answer if isinstance(self.answer, str) else own).format(humans=humans, seed=seed)


def _verdicts(report: dict[str, Any]) -> list[Part]:
    """Of sim.validate."""
    gist = f"{'certified' if report['certified'] else 'not certified'}; "
    gist += f"{report['unstable']['exact']} of {report['humans']} hands unstable"
    if adversary := report.get("adversary"):
        gist += f", adversary {'succeeds' if adversary['found'] else 'fails'}"
    return [Part(f"{gist}, {report['disagreements']} disagreements")]


def _accuracy(report: dict[str, Any]) -> list[Part]:
    """Of sim.accuracy."""
    default = report["default_substeps"]
    ours = next((r for r in report["rows"] if (r["integrator"], r["substeps"]) == ("RK4", default)), None)
    gist = f"default RK4 x {default}: growth off by {ours['growth_rate_error']:+.0e} 1/s" if ours else ""
    return [Part(gist)]


def _gain_map(report: dict[str, Any]) -> list[Part]:
    """Of sim.zwidth."""
    contradicted = sum(report[name]["contradicted_cells"] for name in CONDITIONS)
    return [Part(f"{contradicted} certified cells that a hand destabilises")]


def table(gist: str, columns: dict[str, str | Callable[[Row], str]]) -> Figures:
    """A table of rows, each cell a format, or a function, of the row's figures."""

    def figures(report: dict[str, Any]) -> list[Part]:
        rows, cells = report["rows"], columns.values()
        good = sum(row["holds"] for row in rows)
        shown = tuple(tuple(c(row) if callable(c) else c.format(**row) for c in cells) for row in rows)
        return [Part(gist.format(good=good, count=len(rows)), tuple(columns), shown)]

    return figures


_MEET = "--humans {humans} --links mixed --duration 1 --adversary --generations 60 --seed {seed}"
_MAP = "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8 --seed {seed}"


def _meets(name: str, asks: str, loop: str) -> Check:
    return Check(name, asks, f"sim.validate {loop} {_MEET}", _verdicts)


CHECKS = (
    _meets("none", "Two devices without a coupling", "--case none"),
    _meets("I", "A coupling for any passive environment", "--case I --condition any-environment"),
    _meets("II", "The same, against an undelayed reference", "--case II --condition any-environment"),
    _meets("stiff", "The usual coupling: for this environment, also while forces are limited", "--case I"),
    _meets("optimal", "The best linear coupling for this environment", "--case I --coupling optimal"),
    _meets("published", "The gains that the paper prints", "--case I --coupling published"),
    _meets("three", "Three people, rigid devices, unequal delays", "--scenario three-rigid --case I"),
    Check("map", "Which springs and dampers may a device render against a wall?", _MAP, _gain_map),
    Check("accuracy", "Is MuJoCo right, and at what cost?", "sim.accuracy --duration 6", _accuracy),
)


@cache
def _measuring() -> tuple[Check, ...]:
    """The checks of tests/checks beside this package, wherever it is run; none where it was installed without them."""
    repository = Path(__file__).parents[1]
    if not (repository / "tests" / "checks" / "ours.py").is_file():
        return ()
    sys.path.insert(0, str(repository))  # for processes of their own, too
    checks: tuple[Check, ...] = import_module("tests.checks.ours").CHECKS
    return checks


def _checks() -> dict[str, Check]:
    """All that there are, by name, in the order of the report."""
    return {check.name: check for check in (*CHECKS, *_measuring())}


# ----------------------------------------------------------------------------------------------------
# How a check is run, and what it found.


@dataclass(frozen=True)
class _Answer:
    """What a check found. Its files are in the folder of its name."""

    name: str
    asks: str
    command: str
    exit_code: int | None  # the command's; None where it broke off with `trouble`
    holds: bool
    trouble: str | None
    wall_s: float
    parts: tuple[Part, ...]
    printed: str  # by a command
    pictures: tuple[str, ...]  # paths from the report's folder
    report: dict[str, Any]


@dataclass(frozen=True)
class _Suite:
    """What all checks found."""

    holds: bool
    checks: Sequence[_Answer]
    left_out: Sequence[str]
    humans: int
    seed: int
    interrupted: bool
    wall_s: float
    machine: dict[str, str]

    @property
    def headline(self) -> str:
        """One sentence."""
        good = sum(check.holds for check in self.checks)
        if self.holds:
            text = f"All {good} checks hold."
        else:
            failed = ", ".join(check.name for check in self.checks if not check.holds)
            text = f"{good} of {len(self.checks) + len(self.left_out)} checks hold"
            text += f"; not: {failed}." if failed else "."
        return text + (" Interrupted." if self.interrupted else "")


def _ask(check: Check, out: Path, humans: int, seed: int) -> _Answer:
    """Run one check with its files in `out`/name; where it cannot run, `trouble` of its answer says why."""
    command, place = check.command(humans, seed), folder(out / check.name)
    begin, trouble, code, printed = time.perf_counter(), None, None, StringIO()
    for old in (place / "report.json", *place.glob("*.png")):  # of an earlier run: never shown as this one's
        old.unlink(missing_ok=True)
    try:
        code = _measured(check, place, seed) if callable(check.answer) else _called(command, place, printed)
    except (InputError, SingularLoop, DesignFailed) as error:
        trouble = " ".join(str(error).split())
    wall = time.perf_counter() - begin
    written = place / "report.json"
    report = json.loads(written.read_text()) if written.exists() else {}
    parts = tuple(check.figures(report)) if report else ()
    pictures = tuple(path.relative_to(out).as_posix() for path in sorted(place.glob("*.png")))
    text, holds = printed.getvalue(), code == options.DONE
    return _Answer(
        check.name, check.asks, f"python -m {command}", code, holds, trouble, wall, parts, text, pictures, report
    )


def _called(command: str, place: Path, printed: StringIO) -> int:
    """Another command, as `python -m` runs it."""
    module, *words = shlex.split(command)
    with redirect_stdout(printed):
        return import_module(f"haptic_loop.cli.{module.rpartition('.')[2]}").main([*words, "--out", str(place)])


def _measured(check: Check, place: Path, seed: int) -> int:
    """Measure the rows of a check that is no command; after Ctrl-C those that are finished are kept."""
    assert callable(check.answer)
    found, interrupted = options.until_interrupted(check.answer(seed))
    rows = [row if isinstance(row, dict) else render.plain(row) | {"holds": row.holds} for row in found]
    if check.picture and rows:
        check.picture(found, place / f"{check.name}.png")
    holds = all(row["holds"] for row in rows)
    write_json(place / "report.json", {"rows": rows, "holds": holds, "seed": seed, "interrupted": interrupted})
    return options.exit_code(holds, interrupted)


# ----------------------------------------------------------------------------------------------------
# The command.


def main(argv: list[str]) -> int:
    """Run the checks. 0: all hold, 1: one does not, 130: interrupted; what was done is in the report."""
    args = _parser().parse_args(argv)
    known = _checks()
    checks = [known[name] for name in args.only or known]
    out, screen = folder(Path(args.out or "out/validate")), render.console(args)
    answers: list[_Answer] = []
    begin, interrupted = time.perf_counter(), False
    for number, check in enumerate(checks, start=1):
        screen.print(f"[dim]{number}/{len(checks)}[/] {check.asks} ...", end="\n" if screen.is_terminal else " ")
        try:
            answers.append(_ask(check, out, args.humans, args.seed))
        except KeyboardInterrupt:
            interrupted = True
            break
        screen.print(f"{_verdict(answers[-1])} ({answers[-1].wall_s:.1f} s)")
        if interrupted := answers[-1].exit_code == options.INTERRUPTED:
            break
    report = _Suite(
        len(answers) == len(checks) and all(answer.holds for answer in answers),
        answers,
        [check.name for check in checks[len(answers) :]],
        args.humans,
        args.seed,
        interrupted,
        time.perf_counter() - begin,
        _machine(),
    )
    screen.print(report.headline)
    if not _measuring():
        screen.print(_LESS)
    if len(checks) == 1 and answers:
        _show(answers[0], screen)
    render.publish(args, report, (), (), out, [write(out / "report.md", _markdown(report))])
    return options.exit_code(report.holds, interrupted)


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.suite",
        "Run every check that a verdict rests on and write one report: about ten minutes on two cores, half of them for"
        " endurance (an hour of a session in virtual time, 100,000 hands).",
        "python -m sim.suite --only I,hard --humans 200",
    )
    parser.add_argument("--only", type=_picked, metavar="NAME,..", help=f"of {','.join(_checks())} (default all)")
    humans, count = "random humans per loop (default 300)", options.whole(1, 1_000_000)
    parser.add_argument("--humans", type=count, default=300, metavar="N", help=humans)
    parser.add_output(what="folder for the report (default out/validate)")
    return parser


_LESS = "The checks that measure this project itself come with its repository."


def _picked(text: str) -> list[str]:
    """Names of checks, in the order of the report."""
    for name in (asked := text.split(",")):
        if name not in _checks():
            less = "" if _measuring() else f". {_LESS}"
            raise argparse.ArgumentTypeError(f"has {name!r}, allowed are {', '.join(_checks())}{less}")
    return [name for name in _checks() if name in asked]


def _verdict(answer: _Answer) -> str:
    if answer.exit_code == options.INTERRUPTED:
        return "[yellow]interrupted[/]"
    return "[green]holds[/]" if answer.holds else f"[red]{answer.trouble or 'does not hold'}[/]"


def _show(answer: _Answer, screen: render.Screen) -> None:
    """The figures of a check that was asked for alone."""
    if answer.printed:
        screen.print(answer.printed, markup=False, soft_wrap=True)
    for part in answer.parts if not answer.printed else ():
        screen.print(render.grid(part.title, part.columns, part.rows, left=range(len(part.columns))))


def _machine() -> dict[str, str]:
    """The versions and the machine, on which speeds and the last digits of other figures depend."""
    packages = {name: version(name) for name in ("mujoco", "numpy", "scipy", "clarabel")}
    return {
        "Python": platform.python_version(),
        **packages,
        "on": f"{platform.platform()}, {os.cpu_count()} processors",
    }


# ----------------------------------------------------------------------------------------------------
# The whole report in Markdown.


_INTRODUCTION = """\
Several force-feedback devices share one simulated object; the loop of hands, devices, delays and computer must not
start to oscillate by itself, whoever holds the devices. A *coupling* is the filter between devices and object that
ensures this; it is *certified* when the devices have more damping than a proved condition requires. This report puts
every such verdict to the test. *Growth* is the rate at which the loop's strongest oscillation grows: below zero it
dies out. It is computed from the exact solution of the loop and, independently, from what MuJoCo simulates; both must
tell the same of every hand. The *adversary* searches for the worst passive hand instead of drawing hands at random.

"Holds" means: both engines agree about everyone, nobody destabilises a certified loop, and its energy balance is
never negative. An uncertified loop may be unstable; it holds as long as the engines agree.
"""


def _markdown(suite: _Suite) -> str:
    """The whole report."""
    lines = ["# Validation report", "", f"**{suite.headline}** {suite.wall_s:.0f} s, seed {suite.seed}."]
    lines += ["", "## Verdicts", "", *_verdict_table(suite), "", _INTRODUCTION]
    for check in suite.checks:
        lines += _section(check)
    place = ", ".join(f"{name} {value}" for name, value in suite.machine.items())
    return "\n".join([*lines, "## Where this was run", "", f"{place}.", ""])


def _verdict_table(suite: _Suite) -> list[str]:
    rows = [
        (
            "holds" if check.holds else "**does not hold**",
            f"[{check.asks}](#{_anchor(check.asks)})",
            check.trouble or next((part.answer for part in check.parts), ""),
            f"`{check.command}`",
        )
        for check in suite.checks
    ]
    rows += [("not run", name, "", "") for name in suite.left_out]
    return _cells(("verdict", "check", "answer", "reproduce with"), rows)


def _section(check: _Answer) -> Iterator[str]:
    verdict = "Holds" if check.holds else "Does not hold"
    ended = f"{verdict} (exit code {check.exit_code}, {check.wall_s:.1f} s). {check.trouble or ''}".rstrip()
    yield from (f"## {check.asks}", "", "```sh", check.command, "```", "", ended, "")
    if check.printed:
        yield from ("```text", check.printed.rstrip(), "```", "")
    for part in check.parts if not check.printed else ():
        yield from (f"### {part.title}", "") if part.title else ()
        yield from (*_cells(part.columns, part.rows), "")
    for picture in check.pictures:
        yield from (f"![{check.asks}]({picture})", "")


def _cells(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = "|" + "---|" * len(columns)
    return [f"| {' | '.join(columns)} |", rule, *(f"| {' | '.join(cells)} |" for cells in rows)]


def _anchor(title: str) -> str:
    """As GitHub makes it from a heading."""
    return "".join(c for c in title.lower() if c.isalnum() or c in " -").replace(" ", "-")
