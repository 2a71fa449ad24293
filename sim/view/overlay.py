"""What stands beside the picture: the coupling, its growth rate, its certificates, and how real the time is."""

from __future__ import annotations

import textwrap

import numpy as np

from design.conditions import Requirement
from sim.view.events import GIVEN, KEYS, Couple, words
from sim.view.session import HISTORY, Frame

Lines = list[tuple[str, str]]

WIDTH = 60  # characters of a line


def overlay(frame: Frame, live: bool) -> Lines:
    """Labels and values; `live` adds the clock, which a video has none of."""
    setting, scenario = frame.setting, frame.setting.scenario
    delays = f"theta {_list(scenario.theta)}, psi {_list(scenario.psi)} samples of {1e3 * scenario.T:g} ms"
    mode, here = setting.mode, setting.requirements["closed-loop"]
    lines = [
        ("coupling", setting.label),
        ("delays", delays),
        ("growth", f"{mode.growth:+.3g} 1/s at {mode.frequency_hz:.1f} Hz: {mode.verdict}"),
        ("this environment", needs(here)),
        ("any environment", needs(setting.requirements["theorem4"])),
        ("largest force", f"{np.abs(frame.history).max():.2f} N in {HISTORY:g} s, {frame.clipped} ticks at the limit"),
    ]
    if np.any(frame.push):
        lines.append(("push", f"{', '.join(f'{p:+.2f}' for p in frame.push)} N"))
    clock = f"{frame.t:.1f} s"
    lines.append(("time", clock if not live else f"{clock}, real time x {frame.factor:.2f}"))
    if live:
        lines.append(("clock", f"{frame.overruns} overruns, {frame.lost:.2f} s lost"))
    if frame.note:
        first, *rest = textwrap.wrap(frame.note, WIDTH)
        lines += [("last", first), *(("", line) for line in rest)]
    return lines


def needs(requirement: Requirement) -> str:
    """Required against available damping of the worst channel, and the verdict."""
    if not np.isfinite(requirement.ratio):
        return "no certificate"
    worst = int(np.argmax(np.divide(requirement.required, requirement.available)))
    need, have = requirement.required[worst], requirement.available[worst]
    return f"needs {need:.3f} of {have:g} N s/m: {'certified' if requirement.certified else 'NOT certified'}"


def keys_help(given: bool) -> Lines:
    """The keys and what they ask for; `given` where there is a coupling from a file. The mouse comes last."""
    keys = [(name, words(event)) for name, event in KEYS.values() if given or event != Couple(GIVEN)]
    return [*keys, ("double click", "take a body"), ("Ctrl+right", "draw it")]


def apart(lines: Lines) -> tuple[Lines, Lines]:
    """The lines, and what was last refused, where that takes several lines."""
    at = next((i for i, (label, _) in enumerate(lines) if label == "last"), len(lines))
    return (lines[:at], lines[at:]) if len(lines) - at > 1 else (lines, [])


def columns(lines: Lines) -> tuple[str, str]:
    """Labels and values as MuJoCo's overlays take them."""
    return "\n".join(label for label, _ in lines), "\n".join(value for _, value in lines)


def _list(values: tuple[int, ...]) -> str:
    return ", ".join(map(str, values))
