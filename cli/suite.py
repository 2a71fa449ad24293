"""python -m sim.suite (make validate): every check that a verdict rests on, in one report for a stranger.

A check is a command with its options, run as a user would run it; the report shows that command beside its numbers.
A further check is one more line in CHECKS.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import shlex
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    check_json,
    console,
    numbers,
    out_folder,
    progress_bar,
    scenario_from,
    seed_from,
)
from controller.coupling import Coupling, NoCoupling
from controller.lti import SingularLoop
from design.certificate import CONDITIONS, finite
from design.conditions import this_environment
from design.result import DesignFailed
from sim.adversary import Attempt, attempts
from sim.couplings import NAMES, choose
from sim.files import folder, write, write_json
from sim.run import assemble
from sim.scenario import InputError, Scenario

# ----------------------------------------------------------------------------------------------------
# python -m sim.tightness: how much damping too little is it before somebody makes the loop oscillate?
#
# The devices of each loop get a share less damping than the closed-loop condition requires, and the adversary
# searches for a passive human who destabilises it. Where it succeeds close to the required damping, the condition is
# tight; with the damping that is required it must never succeed.


SHORT = "0,1,2,5,10,20"  # [%]
Row = dict[str, Any]
Loops = dict[str, tuple[Scenario, Coupling]]


def run_tightness(argv: list[str]) -> int:
    """Attack loops that lack damping. 0: nobody destabilises one that lacks none, 1: somebody, 130: interrupted."""
    args = _tightness_parser().parse_args(argv)
    scenario, seed, shortages = scenario_from(args), seed_from(args), _shortages(args)
    (generations,) = numbers("--generations", args.generations, int, 1)
    if not 1 <= generations <= 10_000:
        raise InputError(f"--generations is {generations}, allowed are 1 to 10000")
    out = out_folder(args, "tightness")
    loops = _loops(args, scenario)
    rows, interrupted = _attack(loops, shortages, seed, generations)
    outcome: dict[str, Any] = {"scenario": scenario.name, "case": args.case, "seed": seed, "generations": generations}
    outcome |= {"rows": rows, "rates": _rates(rows), "interrupted": interrupted}
    outcome["holds"] = not any(row["found"] for row in rows if row["short"] <= 0)
    outcome["files"] = _save(args, out, outcome)
    _print(outcome, args)
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def _tightness_parser() -> Parser:
    parser = Parser(
        "sim.tightness",
        "Search destabilising humans for loops that lack a share of their required damping.",
        "python -m sim.tightness --short 0,5,10 --generations 30",
    )
    add_loop_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json, beside the loop without one")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition of the design")
    parser.add_argument("--short", default=SHORT, metavar="P,P,..", help=f"[%%] of damping missing (default {SHORT})")
    parser.add_argument("--generations", default="40", metavar="N", help="of each search (default 40)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _shortages(args: argparse.Namespace) -> list[float]:
    """Shares of the required damping that are missing. Raises InputError."""
    shares = numbers("--short", args.short, float, args.short.count(",") + 1)
    for share in shares:
        if not 0 <= share < 100:
            raise InputError(f"--short is {share:g}, allowed are 0 to below 100 (per cent)")
    return [share / 100 for share in shares]


def _loops(args: argparse.Namespace, scenario: Scenario) -> Loops:
    """The loop without coupling, and the one that was asked for. Raises InputError where no damping helps one."""
    loops: Loops = {"no coupling": (scenario, NoCoupling())}
    if args.case != "none":
        chosen = choose(scenario, args.case, args.coupling, args.condition)
        loops[f"{chosen.kind}, case {args.case}"] = (scenario, chosen.coupling)
    for name, (_, coupling) in loops.items():
        requirement = this_environment(assemble(scenario, coupling).F, scenario.delta)
        if not np.isfinite(requirement.ratio):
            raise InputError(f"{name}: no damping is enough ({requirement.reason}), so none can be short of it")
    return loops


def _attack(loops: Loops, shortages: list[float], seed: int, generations: int) -> tuple[list[Row], bool]:
    rows: list[Row] = []
    with (bar := progress_bar("attacking"))[0]:

        def attempted(attempt: Attempt) -> None:
            rows.append(_row(attempt))
            bar[1](len(rows), len(loops) * len(shortages))

        try:
            attempts(loops, np.array(shortages), seed, generations, attempted)
        except KeyboardInterrupt:
            return rows, True
    return rows, False


def by_whom(row: Row) -> str:
    """Who destabilises a loop."""
    if not row["found"]:
        return "nobody"
    return "one person" if row["held_together"] else "one hand each"


def _row(attempt: Attempt) -> Row:
    worst = attempt.worst
    return {
        "loop": attempt.name,
        "short": attempt.short,
        "found": worst.destabilises,
        "growth_rate_per_s": finite(worst.growth),
        "frequency_hz": worst.frequency_hz,
        "held_together": bool(worst.persons),
        "evaluated": worst.evaluated,
    }


def _rates(rows: list[Row]) -> list[Row]:
    """Share of the loops that somebody destabilises, by shortage."""
    parts = {short: [row["found"] for row in rows if row["short"] == short] for short in {r["short"] for r in rows}}
    return [{"short": s, "attempts": len(found), "rate": sum(found) / len(found)} for s, found in sorted(parts.items())]


def _save(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[str]:
    files = [out / "report.json"]
    if not args.no_plot and outcome["rows"]:
        from sim.plots import plot_tightness

        files.append(plot_tightness(outcome["rows"], out / "tightness.png"))
    write_json(files[0], outcome | {"files": [str(path) for path in files]})
    return [str(path) for path in files]


def _print(outcome: dict[str, Any], args: argparse.Namespace) -> None:
    table = Table(title=f"damping missing, and who notices · {outcome['scenario']}")
    for name in ("loop", "short of required", "destabilised by", "growth [1/s]", "at [Hz]"):
        table.add_column(name, justify="left" if name == "loop" else "right")
    for row in outcome["rows"]:
        found = f"{row['growth_rate_per_s']:+.3g}" if row["found"] else "-"
        at = f"{row['frequency_hz']:.1f}" if row["found"] else "-"
        table.add_row(row["loop"], f"{row['short']:.1%}", by_whom(row), found, at)
    console(args).print(table)


# ----------------------------------------------------------------------------------------------------
# The suite's report: verdicts first, then the figures of each check under the command that reproduces them.


INTRODUCTION = """\
Several force-feedback devices share one simulated object; the loop of hands, devices, delays and computer must not
start to oscillate by itself, whoever holds the devices. A *coupling* is the filter between devices and object that
ensures this; it is *certified* when the devices have more damping than a proved condition requires. This report puts
every such verdict to the test. *Growth* is the rate at which the loop's strongest oscillation grows: below zero it
dies out. It is computed from the exact solution of the loop and, independently, from what MuJoCo simulates; both must
tell the same of every hand. The *adversary* searches for the worst passive hand instead of drawing hands at random.

"Holds" means: both engines agree about everyone, nobody destabilises a certified loop, and its energy balance is
never negative. An uncertified loop may be unstable; it holds as long as the engines agree.
"""


@dataclass(frozen=True)
class Part:
    """A table of a check; `answer` is its gist, shown in the table of verdicts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    answer: str = ""


def verdicts(report: dict[str, Any]) -> list[Part]:
    """Of sim.validate."""
    bad, worst, energy = report["unstable"], report["worst"], report.get("energy_audit")
    humans, adversary, traces = report["humans"], report.get("adversary"), report["traces"]
    rows = [
        ("certified", "yes" if report["certified"] else "no"),
        *_damping(report["certificates"]),
        ("random hands", f"{humans}, half of them with an arm"),
        ("unstable with", f"{bad['exact']} (exact), {'-' if bad['mujoco'] is None else bad['mujoco']} (MuJoCo)"),
        ("the engines disagree about", str(report["disagreements"])),
    ]
    if report["largest_difference_per_s"] is not None:
        rows.append(("largest difference in growth", f"{report['largest_difference_per_s']:.1e} 1/s"))
    if worst:
        rows.append(("worst random hand", _growing(worst)))
    if adversary:
        found = _growing(adversary) if adversary["found"] else "nobody makes the loop grow"
        rows.append(("the adversary's worst", f"{found}, of {adversary['evaluated']} tried"))
    if traces:
        settled = f"{traces['stable_and_settling']} of {traces['stable']} stable loops"
        rows.append((f"slower at the end of {traces['duration_s']:g} s than before", settled))
        rows.append(("runs that reached a force limit", str(traces["clipped_runs"])))
    if energy:
        rows.append(
            ("energy balance never negative", f"{energy['audited'] - energy['violated']} of {energy['audited']}")
        )
    gist = f"{'certified' if report['certified'] else 'not certified'}; {bad['exact']} of {humans} hands unstable"
    if adversary:
        gist += f", adversary {'succeeds' if adversary['found'] else 'fails'}"
    gist += f", {report['disagreements']} disagreements"
    return [Part("", ("figure", "value"), tuple(rows), gist)]


def tightness(report: dict[str, Any]) -> list[Part]:
    """Of sim.tightness."""
    rates = report["rates"]
    rows = tuple((f"{r['short']:.1%}", str(r["attempts"]), f"{r['rate']:.0%}") for r in rates)
    first = next((r["short"] for r in rates if r["rate"] == 1), None)
    gist = "no shortage tried lets somebody destabilise every loop"
    if first is not None:
        gist = f"somebody destabilises every loop whose devices lack {first:.1%} of the damping required"
    single = tuple(
        (r["loop"], f"{r['short']:.1%}", by_whom(r), f"{r['growth_rate_per_s']:+.3g}" if r["found"] else "-")
        for r in report["rows"]
    )
    return [
        Part("Success rate of the adversary", ("damping missing", "loops", "destabilised"), rows, gist),
        Part("Each loop", ("loop", "damping missing", "destabilised by", "growth [1/s], first found"), single),
    ]


def accuracy(report: dict[str, Any]) -> list[Part]:
    """Of sim.accuracy."""
    default = report["default_substeps"]
    rows = []
    for row in report["rows"]:
        name = f"{row['integrator']} x {row['substeps']}" if row["integrator"] else "exact"
        mark = " (default)" if (row["integrator"], row["substeps"]) == ("RK4", default) else ""
        growth, speed = f"{row['growth_rate_error']:+.1e}", f"{1 / row['wall_s_per_simulated_s']:.0f}"
        position = row["position_relative_rms"]
        right = "right" if row["verdict_correct"] else "wrong"
        rows.append((name + mark, "-" if position is None else f"{position:.1e}", growth, right, speed))
    ours = next((r for r in report["rows"] if (r["integrator"], r["substeps"]) == ("RK4", default)), None)
    gist = f"default RK4 x {default}: growth off by {ours['growth_rate_error']:+.0e} 1/s" if ours else ""
    columns = ("setting", "position error, relative rms", "growth error [1/s]", "verdict", "times real time")
    return [Part("", columns, tuple(rows), gist)]


def gain_map(report: dict[str, Any]) -> list[Part]:
    """Of sim.zwidth."""
    cells = len(report["grid"]["K"]) * len(report["grid"]["B"])
    population, simulation = report["population"], report["simulation"]
    rows = [
        (
            f"certified by {name}",
            f"{report[name]['certified_cells']} of {cells} cells, {report[name]['contradicted_cells']} contradicted",
        )
        for name in ("theorem4", "closed-loop")
    ]
    stable = f"{population['stable_cells']} of {population['decided_cells']} cells"
    rows.append((f"stable with all of {population['humans']} random hands", stable))
    odd = f"{simulation['oscillate']} oscillate, {simulation['differ_from_linear']} unlike the linear loop"
    rows.append((f"{len(simulation['points'])} points simulated in MuJoCo", odd))
    edge = max(report["error"][name]["edge_relative_in_K"] for name in ("theorem4", "closed-loop"))
    rows.append(("edge of the map, error in K", f"{edge:.0e}"))
    contradicted = sum(report[name]["contradicted_cells"] for name in ("theorem4", "closed-loop"))
    return [Part("", ("figure", "value"), tuple(rows), f"{contradicted} certified cells that any hand upsets")]


def hard(report: dict[str, Any]) -> list[Part]:
    """Of sim.hard."""
    rows = tuple(
        (
            row["name"],
            f"{row['exact']:+.4f}",
            f"{' x '.join(map(str, row['fails']))}: {row['fault']}" if row["fails"] else "none tried",
            f"RK4 x {row['substeps']}",
            f"{row['error']:+.1e}",
        )
        for row in report["rows"]
    )
    good = sum(row["holds"] for row in report["rows"])
    columns = ("loop", "exact growth [1/s]", "fails", "holds", "growth error [1/s]")
    return [Part("", columns, rows, f"{good} of {len(rows)} verdicts right under the substep rule")]


def headline(outcome: dict[str, Any]) -> str:
    """One sentence."""
    checks = outcome["checks"]
    good = sum(check["holds"] for check in checks)
    if outcome["holds"]:
        text = f"All {good} checks hold."
    else:
        failed = ", ".join(check["name"] for check in checks if not check["holds"])
        text = f"{good} of {len(checks) + len(outcome['left_out'])} checks hold"
        text += f"; not: {failed}." if failed else "."
    return text + (" Interrupted." if outcome["interrupted"] else "")


def markdown(outcome: dict[str, Any]) -> str:
    """The whole report."""
    machine = outcome["machine"]
    lines = ["# Validation report", "", f"**{headline(outcome)}** {outcome['wall_s']:.0f} s, seed {outcome['seed']}."]
    lines += ["", "## Verdicts", "", *_verdict_table(outcome), "", INTRODUCTION]
    for check in outcome["checks"]:
        lines += _section(check)
    lines += ["## Where this was run", "", ", ".join(f"{name} {value}" for name, value in machine.items()) + ".", ""]
    return "\n".join(lines)


def machine() -> dict[str, str]:
    """What figures of speed, and the last digits of all others, depend on."""
    packages = {name: version(name) for name in ("mujoco", "numpy", "scipy", "cvxpy", "clarabel")}
    return {
        "Python": platform.python_version(),
        **packages,
        "on": f"{platform.platform()}, {os.cpu_count()} processors",
    }


def _verdict_table(outcome: dict[str, Any]) -> list[str]:
    rows = [
        (
            "holds" if check["holds"] else "**does not hold**",
            f"[{check['asks']}](#{_anchor(check['asks'])})",
            check["trouble"] or next((part["answer"] for part in check["parts"]), ""),
            f"`{check['command']}`",
        )
        for check in outcome["checks"]
    ]
    rows += [("not run", name, "", "") for name in outcome["left_out"]]
    return _table(("verdict", "check", "answer", "reproduce with"), rows)


def _section(check: dict[str, Any]) -> list[str]:
    lines = [f"## {check['asks']}", "", "```sh", check["command"], "```", ""]
    verdict = "Holds" if check["holds"] else "Does not hold"
    lines += [
        f"{verdict} (exit code {check['exit_code']}, {check['wall_s']:.1f} s). {check['trouble'] or ''}".rstrip(),
        "",
    ]
    for part in check["parts"]:
        lines += [f"### {part['title']}", ""] if part["title"] else []
        lines += [*_table(part["columns"], part["rows"]), ""]
    for picture in check["pictures"]:
        lines += [f"![{check['asks']}]({picture})", ""]
    return lines


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = "|" + "---|" * len(columns)
    return [f"| {' | '.join(columns)} |", rule, *(f"| {' | '.join(cells)} |" for cells in rows)]


def _anchor(title: str) -> str:
    """As GitHub makes it from a heading."""
    return "".join(c for c in title.lower() if c.isalnum() or c in " -").replace(" ", "-")


def _damping(certificates: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    for name, part in certificates.items():
        needed = [f"{value:.4g}" if value is not None else "infinite" for value in part["required_damping"]]
        available = [f"{value:.4g}" for value in part["available_damping"]]
        rows.append((f"damping needed, {name}", f"{', '.join(needed)} of {', '.join(available)} N s/m"))
    return rows


def _growing(part: dict[str, Any]) -> str:
    growth = part["growth_rate_per_s"]
    return "none" if growth is None else f"{growth:+.4g} 1/s at {part['frequency_hz']:.1f} Hz"


@dataclass(frozen=True)
class Check:
    """A question, the command that answers it, and how its JSON report reads as figures."""

    name: str  # of its folder, too
    asks: str
    command: str  # module and options; {humans} and {seed} are filled in
    figures: Callable[[dict[str, Any]], list[Part]]


_MEET = "--humans {humans} --links mixed --duration 1 --adversary --generations 60 --seed {seed}"

CHECKS = (
    Check("none", "Two devices without a coupling", f"sim.validate --case none {_MEET}", verdicts),
    Check("I", "A coupling for any passive environment", f"sim.validate --case I {_MEET}", verdicts),
    Check(
        "II",
        "The same, designed against an undelayed reference",
        f"sim.validate --case II {_MEET}",
        verdicts,
    ),
    Check(
        "stiff",
        "The stiffest coupling for this environment alone",
        f"sim.validate --case I --condition closed-loop {_MEET}",
        verdicts,
    ),
    Check(
        "optimal",
        "The best linear coupling for this environment",
        f"sim.validate --case I --coupling optimal {_MEET}",
        verdicts,
    ),
    Check(
        "published",
        "The gains that the paper prints",
        f"sim.validate --case I --coupling published {_MEET}",
        verdicts,
    ),
    Check(
        "three",
        "Three people, rigid devices, unequal delays",
        f"sim.validate --scenario three-rigid --case I {_MEET}",
        verdicts,
    ),
    Check(
        "tightness",
        "How tight is the condition?",
        "sim.tightness --case I --generations 25 --seed {seed}",
        tightness,
    ),
    Check(
        "delayed",
        "How tight is it with long delays?",
        "sim.tightness --case none --theta 4,9 --short 0,0.2,0.5,1,2 --seed {seed}",
        tightness,
    ),
    Check(
        "map",
        "Which springs and dampers may a device render against a wall?",
        "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8 --seed {seed}",
        gain_map,
    ),
    Check("accuracy", "Is MuJoCo right, and at what cost?", "sim.accuracy --duration 6", accuracy),
    Check("hard", "Numerically hard loops", "sim.hard", hard),
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
    outcome["files"] = [str(write(out / "report.md", markdown(outcome)))]
    outcome["files"].append(str(out / "report.json"))
    write_json(out / "report.json", outcome)
    screen.print(f"{headline(outcome)} Report: {out / 'report.md'}")
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
            code = entry(module)([*options, "--out", str(place)])
    except (InputError, SingularLoop, DesignFailed) as error:
        trouble = " ".join(str(error).split())
    wall = time.perf_counter() - begin
    written = place / "report.json"
    report = json.loads(written.read_text()) if written.exists() else {}
    parts = tuple(check.figures(report)) if report else ()
    pictures = tuple(path.relative_to(out).as_posix() for path in sorted(place.glob("*.png")))
    return Answer(check, f"python -m {command}", code, wall, parts, pictures, trouble, report)


def entry(module: str) -> Callable[[list[str]], int]:
    """What `python -m module` runs."""
    if module == "sim.tightness":
        return run_tightness
    return importlib.import_module(f"cli.{module.rpartition('.')[2]}").main


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
        "machine": machine(),
    }


def _tell(answer: Answer, screen: Console) -> None:
    verdict = "[green]holds[/]" if answer.holds else f"[red]{answer.trouble or 'does not hold'}[/]"
    if answer.code == INTERRUPTED:
        verdict = "[yellow]interrupted[/]"
    screen.print(f"{verdict} ({answer.wall_s:.1f} s)")
