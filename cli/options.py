"""The options that make delays vary, for the commands that simulate."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

import msgspec
from rich.console import Console
from rich.errors import MarkupError
from rich.progress import Progress
from rich.table import Table
from rich.text import Text
from threadpoolctl import threadpool_limits

from controller.delay import LOST, Jitter
from controller.lti import SingularLoop
from design.result import DesignFailed
from models.device import MOST_DAMPING
from sim.files import check_file, folder, nobody_reads
from sim.scenario import CASES, DEFAULT, InputError, Scenario, built_in, load

# ----------------------------------------------------------------------------------------------------
# The terminal that reports are printed on: no number of a table is ever cut, no name is taken for a colour.


CUT = "…"  # what stands in a table for the end of a word that did not fit
WIDEST = 400  # characters
STEP = 2
OTHER_BRACKET = re.compile(r"\[(?!(?:red|green|yellow|dim|/)\])")  # what opens no tag of our reports: a unit, a name


class Screen(Console):
    """A console whose tables lose nothing: words may break, numbers do not; what is too wide runs over the edge."""

    def print(self, *objects: Any, **how: Any) -> None:
        """As rich's, at the least width from the terminal's at which no table loses a character."""
        own = self._width
        self._width = max([self.width, *(self._needed(one) for one in objects if isinstance(one, Table))])
        try:
            super().print(*objects, **how)
        finally:
            self._width = own

    def render_str(self, text: str, **how: Any) -> Text:
        """As rich's, but a file `[/b].npz` or a device that calls itself `:x:` is printed as it is."""
        how |= {"emoji": False}
        if how.get("markup") is not False:
            try:
                return super().render_str(OTHER_BRACKET.sub(r"\\[", text), **how)
            except MarkupError:  # one of our own tags, closed too often
                how |= {"markup": False}
        return super().render_str(text, **how)

    def on_broken_pipe(self) -> None:  # rich itself would leave with 1, our "it does not hold"
        """A reader that has seen enough (`| head -1`) changes neither the work nor its exit code."""
        self.quiet = True
        nobody_reads()

    def _needed(self, table: Table) -> int:
        least = 4 * len(table.columns) + 1  # frames and padding, and one character for each column
        for width in range(max(self.width, least), WIDEST, STEP):
            lines = self.render_lines(table, self.options.update(width=width), pad=False)
            if not any(CUT in part.text for line in lines for part in line):
                return width
        return WIDEST


# ----------------------------------------------------------------------------------------------------
# What every command shares: its options, its exit codes, one line for bad input.


DONE, DOES_NOT_HOLD, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

Number = TypeVar("Number", int, float)


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors and the example at the end of --help."""

    def __init__(self, prog: str, description: str, example: str) -> None:
        super().__init__(
            prog=f"python -m {prog}",
            description=description,
            epilog=f"example:\n  {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} (--help lists the options)")


def add_loop_options(parser: argparse.ArgumentParser) -> None:
    """The options that describe a loop, which every command takes."""
    loop = parser.add_argument_group("the loop")
    loop.add_argument("--case", choices=CASES, default="I", help="none, I (Lambda = Theta Psi) or II (Lambda = I)")
    names = ", ".join(built_in())
    loop.add_argument("--scenario", default=DEFAULT, metavar="FILE.toml", help=f"or one of: {names}")
    for name, what in (("theta", "transmission"), ("psi", "environment"), ("lam", "reference")):
        loop.add_argument(f"--{name}", metavar="N,N,..", help=f"{what} delay per channel [samples]; one is for all")
    loop.add_argument("--delta", metavar="D,D,..", help="damping of each device [N s/m]; one is for all")
    loop.add_argument("--T", metavar="SECONDS", help="sampling period [s]")


def add_output_options(
    parser: argparse.ArgumentParser,
    out: str = "DIR",
    what: str = "folder for files, made if it is not there (default out/<command>-<case>)",
) -> None:
    """Where results go, and the seed."""
    output = parser.add_argument_group("output", "the folder of a FILE that you name must exist")
    output.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    output.add_argument("--out", metavar=out, help=what)
    output.add_argument("--seed", metavar="N", default="0", help="for random draws; recorded (default 0)")


def add_rigid_option(parser: argparse.ArgumentParser) -> None:
    """A rigid wall in place of the environment."""
    wall = "a rigid wall in place of the environment; one channel, the scenario's first"
    parser.add_argument("--rigid", action="store_true", help=wall)


def rigid_loop(args: argparse.Namespace, scenario: Scenario) -> dict[str, tuple[int, ...]]:
    """theta and psi of the one channel that --rigid is about. Raises InputError where options name more of them."""
    for name in ("theta", "psi", "delta"):
        numbers(f"--rigid is one channel: --{name}", getattr(args, name) or "0", float, 1)
    return {"theta": scenario.theta[:1], "psi": scenario.psi[:1] if args.psi else (0,)}


def scenario_from(args: argparse.Namespace) -> Scenario:
    """The scenario that the loop options describe. Raises InputError."""
    scenario = load(args.scenario)
    changes = {}
    for name in ("theta", "psi", "lam"):
        if getattr(args, name) is not None:
            changes[name] = numbers(f"--{name}", getattr(args, name), int, scenario.channels)
    if args.T is not None:
        changes["T"] = numbers("--T", args.T, float, 1)[0]
    delta = None if args.delta is None else numbers("--delta", args.delta, float, scenario.channels)
    for value in delta or ():
        if not 0 <= value <= MOST_DAMPING:
            raise InputError(f"--delta is {value:g}, allowed are 0 to {MOST_DAMPING:g} N s/m")
    return scenario.replace(delta, **changes) if changes or delta else scenario


def require_linear(scenario: Scenario, what: str) -> None:
    """Raises InputError where a loop has walls or Coulomb friction, for a command whose verdicts are of linear ones."""
    for i, device in enumerate(scenario.device):
        if device.friction:
            instead = "sim.run and sim.zwidth simulate it"
            raise InputError(f"device[{i}].friction is {device.friction:g} N: {what} decides linear loops; {instead}")
    if scenario.environment.walls:
        raise InputError(f"environment.walls: {what} decides linear loops; sim.run closes the loop with walls")


def require_constant_delay(scenario: Scenario, what: str) -> None:
    """Raises InputError where a scenario's delays vary, for a command that would not make them vary."""
    if scenario.jitter is not None:
        instead = "sim.run simulates it"
        raise InputError(f"jitter: {what} takes the delays that its link has; take the table out, {instead}")


def numbers(option: str, text: str, kind: Callable[[str], Number], count: int) -> tuple[Number, ...]:
    """'1,2' as `count` numbers; a single one serves all channels. Raises InputError."""
    try:
        values = tuple(kind(part) for part in text.split(","))
    except ValueError:
        what = "whole number" if kind is int else "number"
        what = f"a {what}" if count == 1 else f"{what}s separated by commas"
        raise InputError(f"{option} is {text!r}, expected {what}") from None
    if len(values) == 1:
        values *= count
    if len(values) != count:
        expected = "one" if count == 1 else f"{count} (one per channel) or 1"
        raise InputError(f"{option} has {len(values)} entries, expected {expected}")
    return values


def ranges(option: str, text: str, count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """'1,2' as the range of all channels, '1-2,0-3' as one per channel: (lows, highs). Raises InputError."""
    parts = [part.split("-") for part in text.split(",")]
    if len(parts) == 2 and all(len(part) == 1 for part in parts):
        parts = [[parts[0][0], parts[1][0]]]
    try:
        pairs = [(int(lo), int(hi)) for lo, hi in parts]
    except ValueError:
        raise InputError(f"{option} is {text!r}, expected LO,HI or LO-HI,LO-HI,.. in whole samples") from None
    if len(pairs) not in (1, count):
        raise InputError(f"{option} has {len(pairs)} ranges, expected {count} (one per channel) or 1")
    lows, highs = zip(*(pairs * count if len(pairs) == 1 else pairs), strict=True)
    return lows, highs


def as_option(error: ValueError, args: argparse.Namespace) -> str:
    """The error's text; where the field that it begins with was given as an option, by the option's name."""
    text = str(error)
    name = text.split(" ", 1)[0].split("[", 1)[0]
    given = name in vars(args) and getattr(args, name) is not None
    return f"--{name.replace('_', '-')}{text[len(name) :]}" if given else text


def seed_from(args: argparse.Namespace) -> int:
    """The seed, checked. Raises InputError."""
    (seed,) = numbers("--seed", args.seed, int, 1)
    if seed < 0:
        raise InputError(f"--seed is {seed}, allowed are whole numbers from 0")
    return seed


def check_json(args: argparse.Namespace) -> None:
    """Whether the file of --json can be written, before any work is done. Raises InputError."""
    if args.json and args.json != "-":
        check_file("--json", Path(args.json), "a file or -")


def out_folder(args: argparse.Namespace, command: str) -> Path:
    """The folder for the files of a command, made before any work is done. Raises InputError."""
    check_json(args)
    return folder(Path(args.out or f"out/{command}-{args.case}"))


def console(args: argparse.Namespace) -> Screen:
    """Where tables go: standard error when standard output is taken by --json -."""
    return Screen(stderr=args.json == "-", highlight=False)


class Move(Protocol):
    """Moves a progress bar to `done` of `total`, and may say what is being done."""

    def __call__(self, done: int, total: int, what: str = ...) -> None: ...


def progress_bar(description: str) -> tuple[Progress, Move]:
    """A bar on standard error that shows only on a terminal, and the function that moves it."""
    terminal = Console(stderr=True)
    bar = Progress(transient=True, console=terminal, disable=not terminal.is_terminal)
    task = bar.add_task(description, total=None)

    def move(done: int, total: int, what: str = description) -> None:
        bar.update(task, completed=done, total=total, description=what)

    return bar, move


def execute(main: Callable[[list[str]], int]) -> NoReturn:
    """Run a command and leave with its exit code; bad input is one line on standard error.

    Whoever reads standard output may stop at any line (`| head -1`): the command's own exit code stays what it is,
    also under `set -o pipefail`.
    """
    code: str | int | None
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of processes that this one starts
    try:
        # the matrices here are small: more BLAS threads only wait for each other, and the last digits depend on them
        with threadpool_limits(1, user_api="blas"):
            code = main(sys.argv[1:])
    except (InputError, SingularLoop) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        code = BAD_INPUT
    except DesignFailed as error:
        print(f"not possible: {' '.join(str(error).split())}", file=sys.stderr)
        code = DOES_NOT_HOLD
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        code = INTERRUPTED
    except SystemExit as end:  # argparse, after --help
        code = end.code
    except OSError as error:  # a full disk behind standard output, mostly
        code = _cannot(error)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        nobody_reads()
    except OSError as error:
        code = _cannot(error)
    sys.exit(code)


def _cannot(error: OSError) -> int:
    """One line for what the system refused; what is still to be printed goes nowhere."""
    place = error.filename or "standard output"
    print(f"error: {place}: {error.strerror or error}", file=sys.stderr)
    nobody_reads()
    return BAD_INPUT


DRAWN = ("constant", "random", "bursty", "adversarial")


def add_jitter_options(parser: argparse.ArgumentParser) -> None:
    """--jitter, --pattern, --loss and --playout."""
    group = parser.add_argument_group("delays that vary")
    group.add_argument(
        "--jitter", metavar="LO,HI", help="range of the forces' delays [samples]; or LO-HI,LO-HI,.. per channel"
    )
    names = ", ".join(DRAWN)
    group.add_argument(
        "--pattern", metavar="NAME|FILE", help=f"{names} (default random), or a file of recorded delays, a row per tick"
    )
    group.add_argument("--loss", metavar="P", help="probability that a force is lost and the last one held")
    group.add_argument("--playout", action="store_true", help="a buffer that makes every delay the largest one")


def with_jitter(args: argparse.Namespace, scenario: Scenario) -> Scenario:
    """The scenario with the delays that the options describe, over those of its file. Raises InputError."""
    changes: dict[str, Any] = {}
    if args.pattern is not None:
        changes |= _pattern(args.pattern, scenario.channels)
    if args.jitter is not None:
        changes["lo"], changes["hi"] = ranges("--jitter", args.jitter, scenario.channels)
    if args.loss is not None:
        (changes["loss"],) = numbers("--loss", args.loss, float, 1)
    if args.playout:
        changes["playout"] = True
    if not changes:
        return scenario
    if scenario.jitter is None and "lo" not in changes:
        if "loss" not in changes or len(changes) > 1:
            option = "--playout" if args.playout else "--pattern"
            raise InputError(f"{option} without a range of delays: give --jitter LO,HI")
        changes |= {"lo": scenario.theta, "hi": scenario.theta}
    return _changed(args, scenario, changes)


def _changed(args: argparse.Namespace, scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    try:
        old = scenario.jitter
        jitter = msgspec.structs.replace(old, **changes) if old else Jitter(**changes)
    except ValueError as error:
        raise InputError(str(error)) from None
    theta = jitter.hi if jitter.playout and args.theta is None else scenario.theta
    return scenario.replace(theta=theta, jitter=jitter)


def _pattern(name: str, channels: int) -> dict[str, Any]:
    if name in DRAWN:
        return {"pattern": name, "recorded": ()}
    rows = _recorded(name, channels)
    arrived = [[n for n in column if n != LOST] or [0] for column in zip(*rows, strict=True)]
    lo, hi = (tuple(side(column) for column in arrived) for side in (min, max))
    return {"pattern": "recorded", "recorded": rows, "lo": lo, "hi": hi}


def _recorded(name: str, channels: int) -> tuple[tuple[int, ...], ...]:
    """Rows of delays, separated by commas or blanks; one column serves all channels; # begins a comment."""
    try:
        text = Path(name).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"--pattern {name}: {error.strerror}; give a file or one of: {', '.join(DRAWN)}") from None
    except UnicodeDecodeError:
        raise InputError(f"--pattern {name}: not a text file in UTF-8") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            rows.append(numbers(f"--pattern {name}, line {number}:", ",".join(words), int, channels))
    if not rows:
        raise InputError(f"--pattern {name}: holds no delays")
    return tuple(rows)
