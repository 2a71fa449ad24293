"""python -m sim.suite (make validate): all checks of this project, in one report.

A check is another command with its options, run as a user would run it, or rows that are measured here; the report
shows the command that repeats it beside its numbers. A further check is one more line in CHECKS.
"""

from __future__ import annotations

import argparse
import json
import shlex
import time
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

from cli import options, render
from cli import suite_report as reports
from cli.checks.endurance import endurance
from cli.checks.faults import rehearse_faults
from controller.arithmetic import SingularLoop
from design.files import folder, write, write_json
from design.own import named
from design.result import DesignFailed
from sim.scenario import InputError

# ----------------------------------------------------------------------------------------------------
# The checks, and how one is run.


@dataclass(frozen=True)
class Check:
    """A question, what answers it, and how the answer's JSON report reads."""

    name: str  # of its folder, too
    asks: str
    answer: str | Callable[[int], Iterable[Any]]  # a command ({humans}, {seed} are filled in), or rows by the seed
    figures: reports.Figures
    picture: Callable[[Iterable[Any], Path], object] | None = None  # draws the rows

    def command(self, humans: int, seed: int) -> str:
        """The command that repeats this check."""
        own = f"sim.suite --only {self.name} --seed {{seed}}"
        return (self.answer if isinstance(self.answer, str) else own).format(humans=humans, seed=seed)


def _of_ours(name: str) -> Callable[..., Any]:
    """A function of tests/checks, which measures this project itself and comes with the repository alone."""
    return lambda *given: named("sim.suite", f"tests.checks.{name}")(*given)


_MEET = "--humans {humans} --links mixed --duration 1 --adversary --generations 60 --seed {seed}"
_MAP = "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8 --seed {seed}"
_SHORT, _DELAYED, _DRAWN = map(_of_ours, ("tightness:usual", "tightness:delayed", "tightness:plot_tightness"))


def _meets(name: str, asks: str, loop: str) -> Check:
    return Check(name, asks, f"sim.validate {loop} {_MEET}", reports.verdicts)


CHECKS = (
    _meets("none", "Two devices without a coupling", "--case none"),
    _meets("I", "A coupling for any passive environment", "--case I --condition any-environment"),
    _meets("II", "The same, against an undelayed reference", "--case II --condition any-environment"),
    _meets("stiff", "The usual coupling: for this environment, also while forces are limited", "--case I"),
    _meets("optimal", "The best linear coupling for this environment", "--case I --coupling optimal"),
    _meets("published", "The gains that the paper prints", "--case I --coupling published"),
    _meets("three", "Three people, rigid devices, unequal delays", "--scenario three-rigid --case I"),
    Check("tightness", "How tight is the condition?", _SHORT, reports.tightness, _DRAWN),
    Check("delayed", "How tight is it with long delays?", _DELAYED, reports.tightness, _DRAWN),
    Check("map", "Which springs and dampers may a device render against a wall?", _MAP, reports.gain_map),
    Check("accuracy", "Is MuJoCo right, and at what cost?", "sim.accuracy --duration 6", reports.accuracy),
    Check("hard", "Numerically hard loops", _of_ours("hard:hard_loops"), reports.hard),
    Check(
        "proofs", "Are random networks proved where the sweep says so?", _of_ours("random_loops:proofs"), reports.proved
    ),
    Check(
        "traces",
        "Does a trace ever say the opposite of the eigenvalues?",
        _of_ours("random_loops:traces"),
        reports.traced,
    ),
    Check(
        "uneven",
        "Do uneven periods and late forces keep the guarantee?",
        _of_ours("uneven:uneven_ticks"),
        reports.uneven,
    ),
    Check(
        "guarantees",
        "Do limits, budgets, walls and friction hold at what they ask?",
        _of_ours("challenges:challenges"),
        reports.edges,
    ),
    Check("faults", "Does every fault of a link end as it must?", lambda seed: rehearse_faults(), reports.faults),
    Check("endurance", "Does memory stay flat over an hour and 100,000 hands?", endurance, reports.memory_table),
)


def ask(check: Check, out: Path, humans: int, seed: int) -> reports.Answer:
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
    return reports.Answer(
        check.name, check.asks, f"python -m {command}", code, holds, trouble, wall, parts, text, pictures, report
    )


def _called(command: str, place: Path, printed: StringIO) -> int:
    """Another command, as `python -m` runs it."""
    module, *words = shlex.split(command)
    with redirect_stdout(printed):
        return import_module(f"cli.{module.rpartition('.')[2]}").main([*words, "--out", str(place)])


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
    options.check_json(args)
    checks = [check for check in CHECKS if args.only is None or check.name in args.only]
    out, screen = folder(Path(args.out or "out/validate")), render.console(args)
    answers: list[reports.Answer] = []
    begin, interrupted = time.perf_counter(), False
    for number, check in enumerate(checks, start=1):
        screen.print(f"[dim]{number}/{len(checks)}[/] {check.asks} ...", end="\n" if screen.is_terminal else " ")
        try:
            answers.append(ask(check, out, args.humans, args.seed))
        except KeyboardInterrupt:
            interrupted = True
            break
        screen.print(f"{_verdict(answers[-1])} ({answers[-1].wall_s:.1f} s)")
        if interrupted := answers[-1].exit_code == options.INTERRUPTED:
            break
    report = reports.Suite(
        len(answers) == len(checks) and all(answer.holds for answer in answers),
        answers,
        [check.name for check in checks[len(answers) :]],
        args.humans,
        args.seed,
        interrupted,
        time.perf_counter() - begin,
        reports.machine(),
    )
    screen.print(report.headline)
    if len(checks) == 1 and answers:
        _show(answers[0], screen)
    render.publish(args, report, (), (), out, [write(out / "report.md", reports.markdown(report))])
    return options.exit_code(report.holds, interrupted)


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.suite",
        "Run every check that a verdict rests on and write one report: about ten minutes on two cores, half of them for"
        " endurance (an hour of a session in virtual time, 100,000 hands).",
        "python -m sim.suite --only I,hard --humans 200",
    )
    names = ",".join(check.name for check in CHECKS)
    parser.add_argument("--only", type=_names, metavar="NAME,..", help=f"of {names} (default all)")
    humans, count = "random humans per loop (default 300)", options.whole(1, 1_000_000)
    parser.add_argument("--humans", type=count, default=300, metavar="N", help=humans)
    options.add_output_options(parser, what="folder for the report (default out/validate)")
    return parser


def _names(text: str) -> list[str]:
    known, names = [check.name for check in CHECKS], text.split(",")
    for name in names:
        if name not in known:
            raise argparse.ArgumentTypeError(f"has {name!r}, allowed are {', '.join(known)}")
    return names


def _verdict(answer: reports.Answer) -> str:
    if answer.exit_code == options.INTERRUPTED:
        return "[yellow]interrupted[/]"
    return "[green]holds[/]" if answer.holds else f"[red]{answer.trouble or 'does not hold'}[/]"


def _show(answer: reports.Answer, screen: render.Screen) -> None:
    """The figures of a check that was asked for alone."""
    if answer.printed:
        screen.print(answer.printed, markup=False, soft_wrap=True)
    for part in answer.parts if not answer.printed else ():
        screen.print(render.grid(part.title, part.columns, part.rows, left=range(len(part.columns))))
