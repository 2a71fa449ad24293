"""The options that make delays vary, for the commands that simulate."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import msgspec

from controller.delay import LOST
from controller.jitter import Jitter
from sim.command import numbers, ranges
from sim.scenario import InputError, Scenario

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
