"""What every command shares: its options, its exit codes, one line for bad input."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, Protocol, TypeVar

from rich.console import Console
from rich.progress import Progress
from threadpoolctl import threadpool_limits

from controller.lti import SingularLoop
from design.failure import DesignFailed
from models.device import MOST_DAMPING
from sim.files import check_file, folder, nobody_reads
from sim.interrupt import INTERRUPTED, begun
from sim.scenario import CASES, DEFAULT, InputError, Scenario, built_in, load
from sim.screen import Screen

DONE, DOES_NOT_HOLD, BAD_INPUT = 0, 1, 2  # and INTERRUPTED, which sim.interrupt has

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
        begun()
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
