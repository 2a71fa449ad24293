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
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
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
from design.result import DesignFailed, finite
from hw.control import certified_couplings
from hw.emulator import Emulator
from hw.faults import person, rehearse_faults
from hw.limits import Stage
from hw.monitor import LinkSettings
from hw.rehearsal import Rehearsal
from hw.session import session_for
from sim.adversary import Attempt, attempts
from sim.challenges import challenges
from sim.couplings import choose
from sim.crowds import Validation
from sim.hard import cases, measure
from sim.random_loops import proofs, traces
from sim.scenario import InputError, load
from sim.shards import as_worker, validate
from sim.stability import unstable
from sim.uneven import HANDS, uneven_ticks

# ----------------------------------------------------------------------------------------------------
# Checks of our own: what they measure, row by row.


_Row = dict[str, Any]


def hard_loops(seed: int) -> Iterator[_Row]:
    """Numerically hard loops, each with a setting that fails and the one that holds."""
    for case in cases():
        yield asdict(measure(case))


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


def _shortage(attempt: Attempt) -> _Row:
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


def edges(seed: int) -> Iterator[_Row]:
    """Guarantees beyond the linear loop, at 1.02 times what they ask for and at far too little."""
    for row in challenges(seed):
        yield asdict(row)


def faults(seed: int) -> Iterator[_Row]:
    """Faults of a link, a device, a controller or a person, in virtual time."""
    for outcome in rehearse_faults():
        yield asdict(outcome) | {"holds": outcome.holds}


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


def proved(seed: int) -> Iterator[_Row]:
    """Whether random networks are proved where the sweep says so, and only there."""
    for row in proofs(seed):
        yield asdict(row) | {"required": finite(row.required), "holds": row.holds}


def told(seed: int) -> Iterator[_Row]:
    """What traces of random scenarios tell of their stability."""
    for row in traces(seed):
        yield asdict(row)


def uneven(seed: int) -> Iterator[_Row]:
    """Periods that vary and forces that latch late, drawn and chosen by an enemy."""
    for row in uneven_ticks(seed):
        yield asdict(row) | {"holds": row.holds}


# ----------------------------------------------------------------------------------------------------
# How each report reads as figures.


@dataclass(frozen=True)
class _Part:
    """A table of a check; `answer` is its gist, shown in the table of verdicts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    answer: str = ""


def verdicts(report: dict[str, Any]) -> list[_Part]:
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
        found = _growing(adversary) if adversary["found"] else "no human makes the loop grow"
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
    return [_Part("", ("figure", "value"), tuple(rows), gist)]


def tightness(report: dict[str, Any]) -> list[_Part]:
    """Of loops that lack damping."""
    found = rates(report["rows"])
    rows = tuple((f"{r['short']:.1%}", str(r["attempts"]), f"{r['rate']:.0%}") for r in found)
    first = next((r["short"] for r in found if r["rate"] == 1), None)
    gist = "at no shortage that was tried does a human destabilise every loop"
    if first is not None:
        gist = f"a human destabilises every loop whose devices lack {first:.1%} of the damping required"
    single = tuple(
        (r["loop"], f"{r['short']:.1%}", _by_whom(r), f"{r['growth_rate_per_s']:+.3g}" if r["found"] else "-")
        for r in report["rows"]
    )
    return [
        _Part("Success rate of the adversary", ("damping missing", "loops", "destabilised"), rows, gist),
        _Part("Each loop", ("loop", "damping missing", "destabilised by", "growth [1/s], first found"), single),
    ]


def accuracy(report: dict[str, Any]) -> list[_Part]:
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
    return [_Part("", columns, tuple(rows), gist)]


def _gain_map(report: dict[str, Any]) -> list[_Part]:
    """Of sim.zwidth."""
    cells = len(report["grid"]["K"]) * len(report["grid"]["B"])
    population, simulation = report["population"], report["simulation"]
    rows = [
        (
            f"certified, {name}",
            f"{report[name]['certified_cells']} of {cells} cells, {report[name]['contradicted_cells']} contradicted",
        )
        for name in render.ORDER
    ]
    stable = f"{population['stable_cells']} of {population['decided_cells']} cells"
    rows.append((f"stable with all of {population['humans']} random hands", stable))
    odd = f"{simulation['oscillate']} oscillate, {simulation['differ_from_linear']} unlike the linear loop"
    rows.append((f"{len(simulation['points'])} points simulated in MuJoCo", odd))
    edge = max(report["error"][name]["edge_relative_in_K"] for name in render.ORDER)
    rows.append(("edge of the map, error in K", f"{edge:.0e}"))
    contradicted = sum(report[name]["contradicted_cells"] for name in render.ORDER)
    return [_Part("", ("figure", "value"), tuple(rows), f"{contradicted} certified cells that a hand destabilises")]


def hard(report: dict[str, Any]) -> list[_Part]:
    """Of hard loops."""
    rows = tuple(
        (
            row["name"],
            f"{row['exact']:+.4f}",
            _failing(row),
            f"RK4 x {row['substeps']}",
            f"{row['error']:+.1e}",
        )
        for row in report["rows"]
    )
    good = sum(row["holds"] for row in report["rows"])
    columns = ("loop", "exact growth [1/s]", "fails", "holds", "growth error [1/s]")
    return [_Part("", columns, rows, f"{good} of {len(rows)} verdicts right under the substep rule")]


def _failing(row: _Row) -> str:
    """The setting that fails, how and by how much."""
    if not row["fails"]:
        return "none tried"
    off = "" if row["off"] is None else f" {row['off']:+.1e}"
    return f"{' x '.join(map(str, row['fails']))}: {row['fault'] or '-'}{off}"


def guarantees(report: dict[str, Any]) -> list[_Part]:
    """Of guarantees at their edge: a row for each and each share of what it asks."""
    rows, taken = [], []
    for name, factor in dict.fromkeys((row["guarantee"], row["factor"]) for row in report["rows"]):
        some = [row for row in report["rows"] if (row["guarantee"], row["factor"]) == (name, factor)]
        motions, took, hands, grew = (sum(row[of] for row in some) for of in ("motions", "took", "hands", "grew"))
        limited = max(row["limited"] for row in some)
        least = min(row["least_J"] for row in some)
        rows.append(
            (name, f"{factor:g}", f"{took} of {motions}", f"{grew}" if hands else "-", f"{limited:.0%}", f"{least:.2g}")
        )
        if factor >= 1:
            taken.append(took + grew)
    columns = ("guarantee", "times what it asks", "motions that took energy", "hands that grew", "limited", "least J")
    return [_Part("", columns, tuple(rows), f"{sum(taken)} violations at 1.02 times what {len(taken)} guarantees ask")]


def _fault_table(report: dict[str, Any]) -> list[_Part]:
    """Of faults."""
    rows = []
    for row in report["rows"]:
        zero, allowed = (render.optional(row[name], "{:.1f} ms") for name in ("zero_force_ms", "allowed_ms"))
        rows.append((row["fault"], row["stage"], "; ".join(row["wrong"]) or row["cause"], zero, allowed))
    good = sum(row["holds"] for row in report["rows"])
    columns = ("fault", "ends in", "cause", "zero force after", "allowed")
    return [_Part("", columns, tuple(rows), f"{good} of {len(rows)} faults end as they must")]


def _proof_table(report: dict[str, Any]) -> list[_Part]:
    """Of proofs of random networks: by what the sweep says."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, enough in (("there is enough damping", True), ("there is too little", False)):
        some = [row for row in report["rows"] if (row["required"] is not None and row["required"] < 1) == enough]
        rows.append((says, str(len(some)), str(sum(row["proved"] for row in some))))
    columns = ("the sweep says that", "networks", "proved")
    return [_Part("", columns, tuple(rows), f"proof and sweep agree about {good} of {len(report['rows'])} networks")]


def _told_table(report: dict[str, Any]) -> list[_Part]:
    """Of traces of random scenarios: by what their eigenvalues say."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, grows in (("stable", False), ("unstable", True)):
        some = [row for row in report["rows"] if bool(unstable(row["exact_per_s"])) == grows]
        read = [row for row in some if row["trace_per_s"] is not None]
        same = sum(bool(unstable(row["trace_per_s"])) == grows for row in read)
        quiet = sum(row["not_excited"] for row in some)
        rows.append((says, *map(str, (len(some), same, len(read) - same, quiet, len(some) - len(read) - quiet))))
    columns = (
        "by the eigenvalues",
        "runs",
        "the trace agrees",
        "says the opposite",
        "not excited",
        "no rate, for another reason",
    )
    return [
        _Part("", columns, tuple(rows), f"{good} of {len(report['rows'])} traces tell no other than the eigenvalues")
    ]


def memory_table(report: dict[str, Any]) -> list[_Part]:
    """Of work that goes on for long."""
    rows = [
        (row["what"], row["result"], *(render.optional(row[n], "{:.0f} MiB") for n in ("tenth_mib", "end_mib")))
        for row in report["rows"]
    ]
    good = sum(row["holds"] for row in report["rows"])
    columns = ("work", "result", "peak after a tenth", "peak at the end")
    return [_Part("", columns, tuple(rows), f"{good} of {len(rows)} end as they must, with flat memory")]


def _uneven_table(report: dict[str, Any]) -> list[_Part]:
    """Of uneven ticks."""
    rows = tuple(
        (
            row["loop"],
            f"{row['ticks']}, {'drawn' if row['drawn'] else 'the worst'}",
            f"{row['required']:.4g} N s/m",
            f"{row['energy']:.6g}",
            "never" if row["balance"] >= 0 else f"to {row['balance']:.1e} of what it sums",
            f"{row['grow']} of {HANDS}",
        )
        for row in report["rows"]
    )
    good, found = sum(row["holds"] for row in report["rows"]), sum(row["grow"] > 0 for row in report["rows"])
    below = f"hands grow in {found} of them" if found else "no hand was found that grows"
    gist = f"no hand gains energy in {good} of {len(rows)} runs at 1.02 times the requirement; at half of it {below}"
    columns = ("loop", "ticks", "needs", "most energy, of the start's", "balance below 0", "grow with half")
    return [_Part("", columns, rows, gist)]


def _by_whom(row: _Row) -> str:
    if not row["found"]:
        return "no human"
    return "one person" if row["held_together"] else "one hand each"


def _damping(certificates: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    for name in render.ORDER:
        part = certificates[name]
        needed = [f"{value:.4g}" if value is not None else "infinite" for value in part["required_damping"]]
        available = [f"{value:.4g}" for value in part["available_damping"]]
        rows.append((f"damping needed, {name}", f"{', '.join(needed)} of {', '.join(available)} N s/m"))
    return rows


def _growing(part: dict[str, Any]) -> str:
    growth = part["growth_rate_per_s"]
    return "none" if growth is None else f"{growth:+.4g} 1/s at {part['frequency_hz']:.1f} Hz"


# ----------------------------------------------------------------------------------------------------
# The checks, and how one is run.


@dataclass(frozen=True)
class Check:
    """A question, what answers it, and how its JSON report reads as figures."""

    name: str  # of its folder, too
    asks: str
    answer: str | Callable[[int], Iterator[_Row]]  # a command ({humans}, {seed} are filled in), or rows by the seed
    figures: Callable[[dict[str, Any]], list[_Part]]
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
    Check("hard", "Numerically hard loops", hard_loops, hard),
    Check("proofs", "Are random networks proved where the sweep says so?", proved, _proof_table),
    Check("traces", "Does a trace ever say the opposite of the eigenvalues?", told, _told_table),
    Check("uneven", "Do uneven periods and late forces keep the guarantee?", uneven, _uneven_table),
    Check("guarantees", "Do limits, budgets, walls and friction hold at what they ask?", edges, guarantees),
    Check("faults", "Does every fault of a link end as it must?", faults, _fault_table),
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
    pictures: tuple[str, ...]  # paths from the report's folder
    report: dict[str, Any]


def ask(check: Check, out: Path, humans: int, seed: int) -> _Answer:
    """Run one check with its files in `out`/name; bad input and impossible designs are its trouble."""
    command, place = check.command(humans, seed), folder(out / check.name)
    begin, trouble, code = time.perf_counter(), None, None
    for old in (place / "report.json", *place.glob("*.png")):  # of an earlier run: never shown as this one's
        old.unlink(missing_ok=True)
    try:
        code = _measured(check, place, seed) if callable(check.answer) else _called(command, place)
    except (InputError, SingularLoop, DesignFailed) as error:
        trouble = " ".join(str(error).split())
    wall = time.perf_counter() - begin
    written = place / "report.json"
    report = json.loads(written.read_text()) if written.exists() else {}
    parts = tuple(check.figures(report)) if report else ()
    pictures = tuple(path.relative_to(out).as_posix() for path in sorted(place.glob("*.png")))
    holds = code == options.DONE
    return _Answer(check.name, check.asks, f"python -m {command}", code, holds, trouble, wall, parts, pictures, report)


def _called(command: str, place: Path) -> int:
    """Another command, as `python -m` runs it."""
    module, *words = shlex.split(command)
    with redirect_stdout(StringIO()):
        return import_module(f"cli.{module.rpartition('.')[2]}").main([*words, "--out", str(place)])


def _measured(check: Check, place: Path, seed: int) -> int:
    """Rows of our own; what is done when the keyboard interrupts is kept."""
    rows, interrupted = [], False
    assert callable(check.answer)
    try:
        for row in check.answer(seed):
            rows.append(row)
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
    for part in answer.parts:
        screen.print(render.grid(part.title, part.columns, part.rows, left=range(len(part.columns))))
