"""The report of the suite: verdicts first, then the figures of each check with the command that repeats it."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

from cli import render
from design.result import CONDITIONS
from sim.stability import unstable


@dataclass(frozen=True)
class _Part:
    """A table of a check; `answer` sums it up for the table of verdicts."""

    answer: str
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    title: str = ""


@dataclass(frozen=True)
class Answer:
    """What a check found. Its files are in the folder of its name."""

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


@dataclass(frozen=True)
class Suite:
    """What all checks found."""

    holds: bool
    checks: Sequence[Answer]
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


def machine() -> dict[str, str]:
    """The versions and the machine, on which speeds and the last digits of other figures depend."""
    packages = {name: version(name) for name in ("mujoco", "numpy", "scipy", "clarabel")}
    return {
        "Python": platform.python_version(),
        **packages,
        "on": f"{platform.platform()}, {os.cpu_count()} processors",
    }


# ----------------------------------------------------------------------------------------------------
# How each answer reads: the gist of what a command prints, the table of rows of our own.


_Row = dict[str, Any]
Figures = Callable[[dict[str, Any]], list[_Part]]


def verdicts(report: dict[str, Any]) -> list[_Part]:
    """Of sim.validate."""
    gist = f"{'certified' if report['certified'] else 'not certified'}; "
    gist += f"{report['unstable']['exact']} of {report['humans']} hands unstable"
    if adversary := report.get("adversary"):
        gist += f", adversary {'succeeds' if adversary['found'] else 'fails'}"
    return [_Part(f"{gist}, {report['disagreements']} disagreements")]


def accuracy(report: dict[str, Any]) -> list[_Part]:
    """Of sim.accuracy."""
    default = report["default_substeps"]
    ours = next((r for r in report["rows"] if (r["integrator"], r["substeps"]) == ("RK4", default)), None)
    gist = f"default RK4 x {default}: growth off by {ours['growth_rate_error']:+.0e} 1/s" if ours else ""
    return [_Part(gist)]


def gain_map(report: dict[str, Any]) -> list[_Part]:
    """Of sim.zwidth."""
    contradicted = sum(report[name]["contradicted_cells"] for name in CONDITIONS)
    return [_Part(f"{contradicted} certified cells that a hand destabilises")]


def _table(gist: str, columns: dict[str, str | Callable[[_Row], str]]) -> Figures:
    """A table of rows, each cell a format, or a function, of the row's figures."""

    def figures(report: dict[str, Any]) -> list[_Part]:
        rows, cells = report["rows"], columns.values()
        good = sum(row["holds"] for row in rows)
        shown = tuple(tuple(c(row) if callable(c) else c.format(**row) for c in cells) for row in rows)
        return [_Part(gist.format(good=good, count=len(rows)), tuple(columns), shown)]

    return figures


def _optional(name: str, form: str) -> Callable[[_Row], str]:
    return lambda row: render.optional(row[name], form)


def _failing(row: _Row) -> str:
    """The coarsest setting that fails, what is wrong with it, and by how much."""
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
faults = _table(
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
        "grow with half": "{grow} of {hands}",
    },
)


def uneven(report: dict[str, Any]) -> list[_Part]:
    """Of uneven ticks."""
    (part,) = _uneven_rows(report)
    found = sum(row["grow"] > 0 for row in report["rows"])
    below = f"hands grow in {found} of them" if found else "no hand was found that grows"
    return [replace(part, answer=f"{part.answer}; at half of it {below}")]


def tightness(report: dict[str, Any]) -> list[_Part]:
    """How often the adversary succeeds, by the share of the damping that is missing."""
    found = {short: [row["found"] for row in rows] for short, rows in sorted(_by(report["rows"], "short").items())}
    rows = tuple((f"{short:.1%}", str(len(f)), f"{sum(f) / len(f):.0%}") for short, f in found.items())
    first = next((short for short, f in found.items() if all(f)), None)
    gist = "at no shortage that was tried does a human destabilise every loop"
    if first is not None:
        gist = f"a human destabilises every loop whose devices lack {first:.1%} of the damping required"
    whole = _Part(gist, ("damping missing", "loops", "destabilised"), rows, "Success rate of the adversary")
    return [whole, *(replace(part, title="Each loop") for part in _each_loop(report))]


def _by(rows: Sequence[_Row], *names: str) -> dict[Any, list[_Row]]:
    """The rows, grouped by these figures."""
    groups: dict[Any, list[_Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names) if names[1:] else row[names[0]], []).append(row)
    return groups


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


def edges(report: dict[str, Any]) -> list[_Part]:
    """Guarantees at their limit: one row for each guarantee and each multiple of the damping that it asks."""
    rows, taken = [], []
    for (name, factor), some in _by(report["rows"], "guarantee", "factor").items():
        motions, took, grew = (sum(row[of] for row in some) for of in ("motions", "took", "grew"))
        limited, least = max(row["limited"] for row in some), min(row["least_J"] for row in some)
        met = f"{took} of {motions}", f"{grew}"
        rows.append((name, f"{factor:g}", *met, f"{limited:.0%}", f"{least:.2g}"))
        if factor >= 1:
            taken.append(took + grew)
    columns = ("guarantee", "times what it asks", "motions that took energy", "hands that grew", "limited", "least J")
    return [_Part(f"{sum(taken)} violations at 1.02 times what {len(taken)} guarantees ask", columns, tuple(rows))]


def proved(report: dict[str, Any]) -> list[_Part]:
    """How many random networks are proved, by what the sweep says of them."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, enough in (("there is enough damping", True), ("there is too little", False)):
        some = [row for row in report["rows"] if (row["required"] is not None and row["required"] < 1) == enough]
        rows.append((says, str(len(some)), str(sum(row["proved"] for row in some))))
    gist = f"proof and sweep agree about {good} of {len(report['rows'])} networks"
    return [_Part(gist, ("the sweep says that", "networks", "proved"), tuple(rows))]


def traced(report: dict[str, Any]) -> list[_Part]:
    """What the traces of random scenarios show, by what their eigenvalues say."""
    rows, good = [], sum(row["holds"] for row in report["rows"])
    for says, grows in (("stable", False), ("unstable", True)):
        some = [row for row in report["rows"] if bool(unstable(row["exact_per_s"])) == grows]
        read = [row for row in some if row["trace_per_s"] is not None]
        same = sum(bool(unstable(row["trace_per_s"])) == grows for row in read)
        quiet = sum(row["not_excited"] for row in some)
        rows.append((says, *map(str, (len(some), same, len(read) - same, quiet, len(some) - len(read) - quiet))))
    answers = ("the trace agrees", "says the opposite", "not excited", "no rate, for another reason")
    gist = f"{good} of {len(report['rows'])} traces agree with the eigenvalues"
    return [_Part(gist, ("by the eigenvalues", "runs", *answers), tuple(rows))]


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


def markdown(suite: Suite) -> str:
    """The whole report."""
    lines = ["# Validation report", "", f"**{suite.headline}** {suite.wall_s:.0f} s, seed {suite.seed}."]
    lines += ["", "## Verdicts", "", *_verdict_table(suite), "", _INTRODUCTION]
    for check in suite.checks:
        lines += _section(check)
    place = ", ".join(f"{name} {value}" for name, value in suite.machine.items())
    return "\n".join([*lines, "## Where this was run", "", f"{place}.", ""])


def _verdict_table(suite: Suite) -> list[str]:
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


def _section(check: Answer) -> Iterator[str]:
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
