"""python -m sim.suite (make validate): every check that a verdict rests on, in one report for a stranger.

A check is another command with its options, run as a user would run it, or rows that are measured here; the report
shows the command that repeats it beside its numbers. A further check is one more line in CHECKS.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from io import StringIO
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from cli import options, render, suite_report
from controller.coupling import NoCoupling
from controller.lti import SingularLoop
from design.files import folder, write, write_json
from design.result import CONDITIONS, DesignFailed, finite
from hw.control import certified_couplings
from hw.emulator import Emulator
from hw.faults import person, rehearse_faults
from hw.limits import Stage
from hw.monitor import LinkSettings
from hw.rehearsal import Rehearsal
from hw.session import session_for
from sim.adversary import Attack, attempts
from sim.checks.challenges import challenges
from sim.checks.hard import cases, measure
from sim.checks.random_loops import proofs, traces
from sim.checks.uneven import HANDS, uneven_ticks
from sim.couplings import choose
from sim.crowds import Validation
from sim.scenario import InputError, load
from sim.shards import as_worker, validate
from sim.stability import unstable

# ----------------------------------------------------------------------------------------------------
# Checks of our own: what they measure, row by row.


_Row = dict[str, Any]


def shortages(couplings: Sequence[str], short: Sequence[float], generations: int, **changes: Any) -> Callable[..., Any]:
    """Loops whose devices lack these shares of the damping that the this-environment condition requires.

    The adversary searches for a passive human who destabilises each. Where it succeeds close to the required damping,
    the condition is tight; with the damping that is required it must never succeed.
    """

    def rows(seed: int) -> Iterator[_Row]:
        scenario = load().replace(**changes)
        for name in couplings:
            coupling = NoCoupling() if name == "none" else choose(scenario, "I", name).coupling
            loop = {"no coupling" if name == "none" else f"{name}, case I": (scenario, coupling)}
            for share in short:
                (attempt,) = attempts(loop, np.array([share]), seed, generations)
                yield _shortage(attempt)

    return rows


def _shortage(attempt: Attack) -> _Row:
    worst = attempt.worst
    return {
        "loop": attempt.name,
        "short": attempt.short,
        "found": worst.destabilises,
        "growth_rate_per_s": finite(worst.growth),
        "frequency_hz": worst.frequency_hz,
        "held_together": bool(worst.persons),
        "evaluated": worst.evaluated,
        "holds": attempt.short > 0 or not worst.destabilises,
    }


def rates(rows: Sequence[_Row]) -> list[_Row]:
    """Share of the loops that the adversary destabilises, by shortage."""
    parts = {short: [row["found"] for row in rows if row["short"] == short] for short in {r["short"] for r in rows}}
    return [{"short": s, "attempts": len(found), "rate": sum(found) / len(found)} for s, found in sorted(parts.items())]


_Mark = Callable[[float], None]  # is told what share of the work is done


def long_session(mark: _Mark, seconds: float = 3600.0) -> tuple[bool, str]:
    """A session of the default loop in virtual time, armed for `seconds`; whether it ended as planned, and how."""
    scenario = load()
    made = certified_couplings(scenario, "I", None, None, 1, spare=0)
    session, emulator = session_for(scenario, LinkSettings()), Emulator(scenario)
    actions = [(seconds, person("stop"))]
    rehearsal = Rehearsal(session, emulator, lambda ages: made, actions=actions, keep=False)
    rehearsal.run(0.1 * seconds)
    mark(0.1)
    rehearsal.run_to_the_end(seconds + 5.0)
    ends = session.stage == Stage.FINISHED and not np.any(emulator.applied)
    return ends, f"{session.stage} ({session.cause}) after {session.counters.states} ticks"


def many_hands(mark: _Mark, count: int = 100_000) -> tuple[bool, str]:
    """Random hands on the default loop with its usual coupling, by eigenvalues; whether all are stable."""
    scenario = load()
    question = Validation(scenario, choose(scenario, "I", "spring-damper").coupling, 0, count, 1, "exact", 0.0)
    found = validate(question, progress=lambda done, total: mark(done / total))
    bad = int(unstable(found.exact).sum())
    return bad == 0 and found.index.size == count, f"{bad} of {found.index.size} unstable"


_Work = Callable[[_Mark], tuple[bool, str]]

#: what is done, and by how much its peak of memory may rise after a tenth of it [MiB]: a session keeps nothing of a
#: tick, a crowd 128 bytes of a hand, twice while its batches are joined
_LONG: tuple[tuple[str, _Work, float], ...] = (
    ("an hour of a session", long_session, 8.0),
    ("100,000 hands", many_hands, 32.0),
)


def endurance(seed: int) -> Iterator[_Row]:
    """Whether memory stays flat over an hour of a session and 100,000 hands, each in a process of its own."""
    context = multiprocessing.get_context("spawn")  # a fork would begin with the memory of all checks before
    for what, work, allowed in _LONG:
        here, there = context.Pipe(duplex=False)
        worker = context.Process(target=_alone, args=(work, allowed, there), daemon=True)
        worker.start()
        there.close()
        try:
            yield {"what": what, **here.recv()}
        except EOFError:
            yield {"what": what, "result": "broke off", "tenth_mib": None, "end_mib": None, "holds": False}
        finally:
            worker.terminate()
            worker.join()


def _alone(work: _Work, allowed: float, there: Connection) -> None:
    """Of the process that does it, which ends with the one that waits."""
    as_worker()
    there.send(endure(work, allowed))


def endure(work: _Work, allowed: float) -> _Row:
    """Do it, and look at this process's peak of memory after a tenth and at the end [MiB]."""
    peaks: list[float] = []

    def mark(share: float) -> None:
        if share >= 0.1 and not peaks:
            peaks.append(_peak())

    good, result = work(mark)
    tenth, end = peaks[0], _peak()
    flat = end - tenth <= allowed
    return {"result": result, "tenth_mib": tenth, "end_mib": end, "allowed_mib": allowed, "holds": good and flat}


def _peak() -> float:
    """Most memory that this process had [MiB]. Linux's getrusage counts that of the parent before exec, too."""
    if (status := Path("/proc/self/status")).exists():
        return float(status.read_text().partition("VmHWM:")[2].split()[0]) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


# ----------------------------------------------------------------------------------------------------
# How each answer reads: the gist of what a command prints, the table of rows of our own.


@dataclass(frozen=True)
class _Part:
    """A table of a check; `answer` is its gist, shown in the table of verdicts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    answer: str = ""


_Figures = Callable[[dict[str, Any]], list[_Part]]


def verdicts(report: dict[str, Any]) -> list[_Part]:
    """Of sim.validate."""
    gist = f"{'certified' if report['certified'] else 'not certified'}; "
    gist += f"{report['unstable']['exact']} of {report['humans']} hands unstable"
    if adversary := report.get("adversary"):
        gist += f", adversary {'succeeds' if adversary['found'] else 'fails'}"
    return [_Part("", (), (), f"{gist}, {report['disagreements']} disagreements")]


def accuracy(report: dict[str, Any]) -> list[_Part]:
    """Of sim.accuracy."""
    default = report["default_substeps"]
    ours = next((r for r in report["rows"] if (r["integrator"], r["substeps"]) == ("RK4", default)), None)
    gist = f"default RK4 x {default}: growth off by {ours['growth_rate_error']:+.0e} 1/s" if ours else ""
    return [_Part("", (), (), gist)]


def _gain_map(report: dict[str, Any]) -> list[_Part]:
    """Of sim.zwidth."""
    contradicted = sum(report[name]["contradicted_cells"] for name in CONDITIONS)
    return [_Part("", (), (), f"{contradicted} certified cells that a hand destabilises")]


def _table(gist: str, columns: dict[str, str | Callable[[_Row], str]]) -> _Figures:
    """A row for each row: its cells as formats of its figures."""

    def figures(report: dict[str, Any]) -> list[_Part]:
        rows, cells = report["rows"], columns.values()
        good = sum(row["holds"] for row in rows)
        shown = tuple(tuple(c(row) if callable(c) else c.format(**row) for c in cells) for row in rows)
        return [_Part("", tuple(columns), shown, gist.format(good=good, count=len(rows)))]

    return figures


def _optional(name: str, form: str) -> Callable[[_Row], str]:
    return lambda row: render.optional(row[name], form)


def _failing(row: _Row) -> str:
    """The setting that fails, how and by how much."""
    if not row["fails"]:
        return "none tried"
    off = "" if row["off"] is None else f" {row['off']:+.1e}"
    return f"{' x '.join(map(str, row['fails']))}: {row['fault'] or '-'}{off}"


hard = _table(
    "{good} of {count} verdicts right under the substep rule",
    {
        "loop": "{name}",
        "exact growth [1/s]": "{exact:+.4f}",
        "fails": _failing,
        "holds": "RK4 x {substeps}",
        "growth error [1/s]": "{error:+.1e}",
    },
)
_faults = _table(
    "{good} of {count} faults end as they must",
    {
        "fault": "{fault}",
        "ends in": "{stage}",
        "cause": lambda row: "; ".join(row["wrong"]) or row["cause"],
        "zero force after": _optional("zero_force_ms", "{:.1f} ms"),
        "allowed": _optional("allowed_ms", "{:.1f} ms"),
    },
)
memory_table = _table(
    "{good} of {count} end as they must, with flat memory",
    {
        "work": "{what}",
        "result": "{result}",
        "peak after a tenth": _optional("tenth_mib", "{:.0f} MiB"),
        "peak at the end": _optional("end_mib", "{:.0f} MiB"),
    },
)
_uneven_rows = _table(
    "no hand gains energy in {good} of {count} runs at 1.02 times the requirement",
    {
        "loop": "{loop}",
        "ticks": lambda row: f"{row['ticks']}, {'drawn' if row['drawn'] else 'the worst'}",
        "needs": "{required:.4g} N s/m",
        "most energy, of the start's": "{energy:.6g}",
        "balance below 0": lambda row: "never" if row["balance"] >= 0 else f"to {row['balance']:.1e} of what it sums",
        "grow with half": f"{{grow}} of {HANDS}",
    },
)


def _uneven(report: dict[str, Any]) -> list[_Part]:
    """Of uneven ticks."""
    (part,) = _uneven_rows(report)
    found = sum(row["grow"] > 0 for row in report["rows"])
    below = f"hands grow in {found} of them" if found else "no hand was found that grows"
    return [replace(part, answer=f"{part.answer}; at half of it {below}")]


def tightness(report: dict[str, Any]) -> list[_Part]:
    """Of loops that lack damping."""
    found = rates(report["rows"])
    rows = tuple((f"{r['short']:.1%}", str(r["attempts"]), f"{r['rate']:.0%}") for r in found)
    first = next((r["short"] for r in found if r["rate"] == 1), None)
    gist = "at no shortage that was tried does a human destabilise every loop"
    if first is not None:
        gist = f"a human destabilises every loop whose devices lack {first:.1%} of the damping required"
    whole = _Part("Success rate of the adversary", ("damping missing", "loops", "destabilised"), rows, gist)
    return [whole, *(replace(part, title="Each loop") for part in _each_loop(report))]


def _by_whom(row: _Row) -> str:
    if not row["found"]:
        return "no human"
    return "one person" if row["held_together"] else "one hand each"


_each_loop = _table(
    "",
    {
        "loop": "{loop}",
        "damping missing": "{short:.1%}",
        "destabilised by": _by_whom,
        "growth [1/s], first found": lambda row: f"{row['growth_rate_per_s']:+.3g}" if row["found"] else "-",
    },
)


def _edges(report: dict[str, Any]) -> list[_Part]:
    """Of guarantees at their edge: a row for each and each share of what it asks."""
    rows, taken = [], []
    for name, factor in dict.fromkeys((row["guarantee"], row["factor"]) for row in report["rows"]):
        some = [row for row in report["rows"] if (row["guarantee"], row["factor"]) == (name, factor)]
        motions, took, grew = (sum(row[of] for row in some) for of in ("motions", "took", "grew"))
        limited, least = max(row["limited"] for row in some), min(row["least_J"] for row in some)
        met = f"{took} of {motions}", f"{grew}"
        rows.append((name, f"{factor:g}", *met, f"{limited:.0%}", f"{least:.2g}"))
        if factor >= 1:
            taken.append(took + grew)
    columns = ("guarantee", "times what it asks", "motions that took energy", "hands that grew", "limited", "least J")
    return [_Part("", columns, tuple(rows), f"{sum(taken)} violations at 1.02 times what {len(taken)} guarantees ask")]


def _proved(report: dict[str, Any]) -> list[_Part]:
    """Of proofs of random networks: by what the sweep says."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, enough in (("there is enough damping", True), ("there is too little", False)):
        some = [row for row in report["rows"] if (row["required"] is not None and row["required"] < 1) == enough]
        rows.append((says, str(len(some)), str(sum(row["proved"] for row in some))))
    gist = f"proof and sweep agree about {good} of {len(report['rows'])} networks"
    return [_Part("", ("the sweep says that", "networks", "proved"), tuple(rows), gist)]


def _told(report: dict[str, Any]) -> list[_Part]:
    """Of traces of random scenarios: by what their eigenvalues say."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, grows in (("stable", False), ("unstable", True)):
        some = [row for row in report["rows"] if bool(unstable(row["exact_per_s"])) == grows]
        read = [row for row in some if row["trace_per_s"] is not None]
        same = sum(bool(unstable(row["trace_per_s"])) == grows for row in read)
        quiet = sum(row["not_excited"] for row in some)
        rows.append((says, *map(str, (len(some), same, len(read) - same, quiet, len(some) - len(read) - quiet))))
    answers = ("the trace agrees", "says the opposite", "not excited", "no rate, for another reason")
    gist = f"{good} of {len(report['rows'])} traces tell no other than the eigenvalues"
    return [_Part("", ("by the eigenvalues", "runs", *answers), tuple(rows), gist)]


# ----------------------------------------------------------------------------------------------------
# The checks, and how one is run.


@dataclass(frozen=True)
class Check:
    """A question, what answers it, and how the answer's JSON report reads."""

    name: str  # of its folder, too
    asks: str
    answer: str | Callable[[int], Iterable[Any]]  # a command ({humans}, {seed} are filled in), or rows by the seed
    figures: _Figures
    picture: str | None = None  # of rows: the function of sim.plots that draws them

    def command(self, humans: int, seed: int) -> str:
        """What repeats this check."""
        own = f"sim.suite --only {self.name} --seed {{seed}}"
        return (self.answer if isinstance(self.answer, str) else own).format(humans=humans, seed=seed)


_MEET = "--humans {humans} --links mixed --duration 1 --adversary --generations 60 --seed {seed}"
_MAP = "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8 --seed {seed}"
_SHORT = shortages(("none", "spring-damper"), (0, 0.01, 0.02, 0.05, 0.1, 0.2), 25)
_DELAYED = shortages(("none",), (0, 0.002, 0.005, 0.01, 0.02), 40, theta=(4, 9))


def _meets(name: str, asks: str, loop: str) -> Check:
    return Check(name, asks, f"sim.validate {loop} {_MEET}", verdicts)


CHECKS = (
    _meets("none", "Two devices without a coupling", "--case none"),
    _meets("I", "A coupling for any passive environment", "--case I --condition any-environment"),
    _meets("II", "The same, against an undelayed reference", "--case II --condition any-environment"),
    _meets("stiff", "The usual coupling: for this environment, also while forces are limited", "--case I"),
    _meets("optimal", "The best linear coupling for this environment", "--case I --coupling optimal"),
    _meets("published", "The gains that the paper prints", "--case I --coupling published"),
    _meets("three", "Three people, rigid devices, unequal delays", "--scenario three-rigid --case I"),
    Check("tightness", "How tight is the condition?", _SHORT, tightness, "plot_tightness"),
    Check("delayed", "How tight is it with long delays?", _DELAYED, tightness, "plot_tightness"),
    Check("map", "Which springs and dampers may a device render against a wall?", _MAP, _gain_map),
    Check("accuracy", "Is MuJoCo right, and at what cost?", "sim.accuracy --duration 6", accuracy),
    Check("hard", "Numerically hard loops", lambda seed: (measure(case) for case in cases()), hard),
    Check("proofs", "Are random networks proved where the sweep says so?", proofs, _proved),
    Check("traces", "Does a trace ever say the opposite of the eigenvalues?", traces, _told),
    Check("uneven", "Do uneven periods and late forces keep the guarantee?", uneven_ticks, _uneven),
    Check("guarantees", "Do limits, budgets, walls and friction hold at what they ask?", challenges, _edges),
    Check("faults", "Does every fault of a link end as it must?", lambda seed: rehearse_faults(), _faults),
    Check("endurance", "Does memory stay flat over an hour and 100,000 hands?", endurance, memory_table),
)


@dataclass(frozen=True)
class _Answer:
    """What a check found, as the report has it. Its files are in the folder of its name."""

    name: str
    asks: str
    command: str
    exit_code: int | None  # the command's; None where it broke off with `trouble`
    holds: bool
    trouble: str | None
    wall_s: float
    parts: tuple[_Part, ...]
    printed: str  # by a command
    pictures: tuple[str, ...]  # paths from the report's folder
    report: dict[str, Any]


def ask(check: Check, out: Path, humans: int, seed: int) -> _Answer:
    """Run one check with its files in `out`/name; bad input and impossible designs are its trouble."""
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
        return import_module(f"cli.{module.rpartition('.')[2]}").main([*words, "--out", str(place)])


def _measured(check: Check, place: Path, seed: int) -> int:
    """Rows of our own; what is done when the keyboard interrupts is kept."""
    rows, interrupted = [], False
    assert callable(check.answer)
    try:
        for row in check.answer(seed):
            rows.append(row if isinstance(row, dict) else render.plain(row) | {"holds": row.holds})
    except KeyboardInterrupt:
        interrupted = True
    if check.picture and rows:
        from sim import plots

        getattr(plots, check.picture)(rows, place / f"{check.name}.png")
    holds = all(row["holds"] for row in rows)
    write_json(place / "report.json", {"rows": rows, "holds": holds, "seed": seed, "interrupted": interrupted})
    if interrupted:
        return options.INTERRUPTED
    return options.DONE if holds else options.DOES_NOT_HOLD


# ----------------------------------------------------------------------------------------------------
# The command.


def main(argv: list[str]) -> int:
    """Run the checks. 0: all hold, 1: one does not, 130: interrupted; what was done is in the report."""
    args = _parser().parse_args(argv)
    options.check_json(args)
    checks, out, screen = _chosen(args), folder(Path(args.out or "out/validate")), render.console(args)
    answers: list[_Answer] = []
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
    outcome = {
        "holds": len(answers) == len(checks) and all(answer.holds for answer in answers),
        "checks": [asdict(answer) for answer in answers],
        "left_out": [check.name for check in checks[len(answers) :]],
        "humans": args.humans,
        "seed": args.seed,
        "interrupted": interrupted,
        "wall_s": time.perf_counter() - begin,
        "machine": suite_report.machine(),
    }
    screen.print(suite_report.headline(outcome))
    if len(checks) == 1 and answers:
        _show(answers[0], screen)
    render.publish(args, outcome, (), (), out, [write(out / "report.md", suite_report.markdown(outcome))])
    if interrupted:
        return options.INTERRUPTED
    return options.DONE if outcome["holds"] else options.DOES_NOT_HOLD


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


def _chosen(args: argparse.Namespace) -> list[Check]:
    """The checks asked for, in the order of CHECKS."""
    return [check for check in CHECKS if args.only is None or check.name in args.only]


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
