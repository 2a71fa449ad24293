"""Print reports as tables on the terminal, and write them as JSON.

A report is a dataclass of figures in SI units. Its fields are the keys of its JSON. A field made by `figure` has a name
and a format, and becomes a row (name, text) of the table. A row whose text is None is left out.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, field, fields, replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from haptic_loop.cli.painter import skip_docstrings
from haptic_loop.controller.loop import Loop
from haptic_loop.design.files import InJson, plain, remove, write, write_json
from haptic_loop.design.result import DesignFailed, Requirement

if TYPE_CHECKING:  # loaded only by commands that need them
    from rich.table import Table

    from haptic_loop.cli.screen import Screen
    from haptic_loop.design.coverage import Robustness
    from haptic_loop.design.transparency import Transparency
    from haptic_loop.sim.report import UnevenTicks, VaryingDelays
    from haptic_loop.sim.trace import Trace

# ---- the terminal and progress bars; rich is imported in functions, because --help does not need it


_SHORT_NAME = 24  # [characters] the first column is not broken if all its names are this short


def console(args: argparse.Namespace) -> Screen:
    """Return the screen for tables: standard error with --json -, else standard output."""
    from haptic_loop.cli.screen import Screen

    return Screen(stderr=args.json == "-", highlight=False)


_Progress = Callable[[str, int, int], None]  # (task, steps done, number of steps)


class Move(Protocol):
    """A function that moves a progress bar to `done` of `total`; `what` names the task."""

    def __call__(self, done: int, total: int, what: str = ...) -> None: ...


_SILENCE = 2.0  # [s] time after which a command that prints nothing says what it does


@contextmanager
def progress(description: str) -> Iterator[Move]:
    """Show a progress bar on standard error, or without a terminal one line after _SILENCE; yields a Move."""
    from rich.console import Console

    terminal = Console(stderr=True)
    if not terminal.is_terminal:
        now = [description]
        line = threading.Timer(_SILENCE, lambda: print(f"{now[0]} ..", file=sys.stderr, flush=True))
        line.daemon = True
        line.start()
        try:
            yield lambda done, total, what=description: now.__setitem__(0, what)
        finally:
            line.cancel()
        return
    from rich.progress import Progress

    with Progress(transient=True, console=terminal) as bar:
        task = bar.add_task(description, total=None)

        def move(done: int, total: int, what: str = description) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield move


@contextmanager
def designing(loop: Loop | None = None, kind: str | None = None, condition: str | None = None) -> Iterator[_Progress]:
    """Show the progress bar of a design, and yield its `progress`; if it fails for `loop`, suggest alternatives."""
    with progress("designing the coupling") as move:
        try:
            yield lambda what, done, total: move(done, total, what)
        except DesignFailed as error:
            from haptic_loop.design.api import instead

            if loop is None or not (others := instead(loop, kind or "spring-damper", condition, move)):
                raise
            raise type(error)(error.problem, error.results, f"{error.advice}; {others}") from error


# ---- reports: files, tables, lines below them, and JSON


def publish(
    args: argparse.Namespace,
    report: Any,
    shown: Iterable[Table],
    lines: Iterable[str] = (),
    folder: Path | None = None,
    files: Iterable[Path] = (),
    verdict: str | None = None,
    details: Iterable[str] = (),
) -> None:
    """Save the report as report.json in the folder, print verdict, tables and lines, and write the file of --json.

    The report lists `files`, which exist already. `details` are printed with --details.
    """
    outcome = plain(report)
    if folder:
        file = folder / "report.json"
        outcome["files"] = [*map(str, files), str(file)]
        write_json(file, outcome)
    if verdict:
        announce(args, verdict)
    show(args, shown, lines, details)
    if folder:
        console(args).print("files: " + ", ".join(outcome["files"]), soft_wrap=True)
    if args.json:
        write_json(args.json, outcome)


def show(
    args: argparse.Namespace, tables: Iterable[Table], lines: Iterable[str] = (), details: Iterable[str] = ()
) -> None:
    """Print tables and lines, and with --details the details."""
    screen = console(args)
    for table in tables:
        screen.print(table)
    for line in (*lines, *(details if getattr(args, "details", False) else ())):
        screen.print(f"[dim]·[/] {line}")


def announce(args: argparse.Namespace, verdict: str) -> None:
    """Print a verdict without breaking its line."""
    console(args).print(verdict, soft_wrap=True)


def remove_earlier(folder: Path, *files: str) -> None:
    """Remove the report and these files of an earlier run, before the first new file is written.

    Raises InputError if a file cannot be removed, and keeps all files if the command has read one of them.
    """
    remove(*(folder / file for file in ("report.json", *files)))


def save_run(folder: Path, trace: Trace, report: Any, models: Mapping[str, str]) -> list[Path]:
    """Replace the files of an earlier run by a trace with its report, and by models (file name -> XML)."""
    labelled = replace(trace, meta=plain(report))
    remove_earlier(folder, "trace.npz", "trace.csv", *models, "figure.png")
    files = [labelled.save_npz(folder / "trace.npz"), labelled.save_csv(folder / "trace.csv")]
    return [*files, *(write(folder / name, xml) for name, xml in models.items())]


def pictures(
    args: argparse.Namespace, report: Any, folder: Path, drawn: Mapping[str, str], content: bool = True
) -> list[Path]:
    """Draw the pictures of a report: `drawn` maps file names to functions of sim.plots."""
    remove_earlier(folder, *drawn)
    if args.no_plot or not content:
        return []
    skip_docstrings()
    from haptic_loop.sim import plots

    return [getattr(plots, name)(report, folder / file) for file, name in drawn.items()]


# ---- tables


Rows = Iterable[tuple[str, str | None]]
_Form = str | Callable[[Any], str | None]


def facts(title: str, rows: Rows, left: bool = False) -> Table:
    """Return a table of names and texts; a row whose text is None is left out."""
    from rich.table import Table

    table = Table(title=title, title_justify="left" if left else "center", show_header=False)
    for name, text in rows:
        if text is not None:
            table.add_row(name, text)
    return table


def shortened(rows: Rows, less: Sequence[str], others: int = 0) -> tuple[list[tuple[str, str | None]], list[str]]:
    """Return the rows of a table, and a line that names those left out, if any.

    While there are more than _MOST_ROWS rows, counting `others` of further tables, rows named in `less` are left out,
    in this order. A row without a name belongs to the row before it.
    """
    remaining, out = [row for row in rows if row[1] is not None], []
    names = list(accumulate((name for name, _ in remaining), lambda before, name: name or before))
    for name in less:
        if len(remaining) + others > _MOST_ROWS and name in names:
            remaining = [row for row, of in zip(remaining, names, strict=True) if of != name]
            names = [of for of in names if of != name]
            out.append(name)
    return remaining, [f"Rows left out, whose figures --json has: {'; '.join(out)}."] if out else []


_MOST_ROWS = 15  # number of rows that `shortened` allows


def grid(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[int] = (0,)) -> Table:
    """Return a table of figures; columns are aligned to the right, except those in `left`."""
    from rich.table import Table

    table, rows = Table(title=title), list(rows)
    short = all(len(row[0]) <= _SHORT_NAME for row in rows)
    for i, head in enumerate(heads):
        how: Any = {"no_wrap": short, "overflow": "ellipsis" if short else "fold"} if i == 0 else {}
        table.add_column(head, justify="left" if i in left else "right", **how)
    for row in rows:
        table.add_row(*row)
    return table


def columns(title: str, cells: Mapping[str, _Form], records: Iterable[Any], left: Sequence[int] = (0,)) -> Table:
    """Return a table of records; `cells` maps column heads to functions of a record, or to format strings with `r`.

    A blank at the end of a key is not shown; it makes equal heads possible.
    """
    rows = [[str(form(r)) if callable(form) else form.format(r=r) for form in cells.values()] for r in records]
    return grid(title, [head.strip() for head in cells], rows, left)


def figure(
    name: str,
    form: _Form = "{}",
    default: Any = MISSING,
    json: InJson = "always",
    absent: str | None = None,
) -> Any:
    """Return a dataclass field that the table shows under `name`; the format may use the value and the report `r`.

    None is shown as `absent`, or not at all. `json` is as in `design.files.off_table`.
    """
    return field(default=default, metadata={"name": name, "form": form, "json": json, "absent": absent})


def several(rows: Callable[[Any], Rows], json: InJson = "always") -> Any:
    """Return a dataclass field that the table shows as the rows `rows(value)`."""
    return field(metadata={"rows": rows, "json": json})


def rows_of(report: Any) -> Rows:
    """Yield a row (name, text) for each figure of a report; the text is None for a figure without a value."""
    for one in fields(report):
        value, form = getattr(report, one.name), one.metadata.get("form")
        if form is not None:
            text: Any = (
                one.metadata["absent"]
                if value is None
                else form(value)
                if callable(form)
                else form.format(value, r=report)
            )
            yield one.metadata["name"], text
        elif "rows" in one.metadata and value is not None:
            yield from one.metadata["rows"](value)


# ---- phrases that several reports share


def certified(need: Requirement, proof: bool = True) -> str:
    """Say whether a condition holds and, with `proof`, whether exact arithmetic proves it."""
    if not need.certified:
        return "[red]not certified[/]"
    return "[green]certified[/]" + (", proved exactly" if proof and need.proof == "rational" else "")


def short(condition: str) -> str:
    """Return the condition's name for a narrow column: this-env., any-env."""
    return condition.replace("environment", "env.")


def certificate_rows(requirements: Mapping[str, Requirement], digits: int = 6, proof: bool = True) -> Rows:
    """Yield a row for each condition: its required damping, and `certified`."""
    for name, need in requirements.items():
        yield f"damping, {name}", f"{need.words(digits)}: {certified(need, proof)}"


def channel_row(contacts: Sequence[str]) -> tuple[str, str | None]:
    """Return the row of the contacts' names; its text is None for a single contact."""
    return "channels", ", ".join(contacts) if len(contacts) > 1 else None


def optional(value: float | None, form: str, absent: str = "-") -> str:
    return absent if value is None else form.format(value)


def transparency_error(figures: Transparency) -> str:
    """Describe the mismatch M relative to the reference, in decibels."""
    shown = (f"{db:z.2f} dB" if math.isfinite(db) else "zero" for db in (figures.mismatch_db, figures.rms_mismatch_db))
    return "{} at most, {} rms (0 dB: as wrong as no force)".format(*shown)


_MUCH = 2.0  # ratio of required to available damping in nearby environments, above which a report proposes --ranges


def robustness_rows(there: Robustness | None) -> Rows:
    """Yield rows on the damping that is required if the environment's model is wrong."""
    if there:
        words = f"needs {there.required_over_available:.3f} times the damping at {there.where}"
        yield "robustness", f"{words}, the worst of the tried changes by {there.percent:g} %"
        if there.required_over_available > _MUCH:
            yield "", f"python -m design --ranges {there.percent:g}% designs for all of these environments"


def verdict(word: str | None) -> str:
    return {"stable": "[green]stable[/]", "unstable": "[red]unstable[/]"}.get(word or "", "not decided")


def timing_row(part: UnevenTicks | None) -> tuple[str, str | None]:
    """Return the row on uneven periods and latencies."""
    if part is None:
        return "ticks", None
    period, words = part.period_s, []
    if period.least < period.largest:
        how = "recorded" if part.recorded else "drawn"
        words.append(f"{1e3 * period.least:.4g} to {1e3 * period.largest:.4g} ms long, {how}")
    if part.latency_s:
        spans = (f"{1e3 * a:.4g} to {1e3 * b:.4g}" if a < b else f"{1e3 * a:.4g}" for a, b in part.latency_s)
        words.append(f"forces latch {', '.join(dict.fromkeys(spans))} ms later")
    return "ticks", "; ".join(words)


def delay_rows(part: VaryingDelays) -> Rows:
    """Yield the rows on delays that vary."""
    span, met, proof = part.span, part.met, part.certified.switching
    ranges = ", ".join(f"{lo} to {hi}" for lo, hi in zip(span.lo, span.hi, strict=True))
    played = ", played out at the largest" if span.playout else ""
    lost = f", {100 * span.loss:g} % lost" if span.loss else ""
    yield "varying delay", f"{ranges} samples, {span.pattern}{played}{lost}"
    if met and (age := met.age):
        each = zip(age.least, age.largest, age.mean, strict=True)
        yield "age of the forces", "; ".join(f"{a} to {b}, mean {c:.2f}" for a, b, c in each) + " samples"
    if met and (period := met.period):
        growth = f"{period.growth_rate_per_s:+.4f} 1/s with a period of {period.ticks} ticks"
        yield "worst switching found", f"{growth}: {verdict(period.verdict)}"
    if proof:
        yield "damping, any switching", f"{proof.requirement.words(5)}: {certified(proof.requirement)}"
    yield "these delays covered", "[green]yes[/]" if part.certified.covered else "[yellow]no[/]"
