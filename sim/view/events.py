"""What may happen to a running loop: by a key in the window, or by a script at given times."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sim.scenario import InputError

#: what a user calls a coupling -> what sim.couplings calls it
COUPLINGS = {"none": "none", "published": "published", "designed": "spring-damper", "optimal": "optimal", "ccl": "ccl"}
#: the other way round: a user may say it as the other commands do
LABELS = {kind: label for label, kind in COUPLINGS.items()}
GIVEN = "given"  # the coupling of --coupling FILE.json
DELAYS = ("theta", "psi")
STRONGEST = 100.0  # [N] a push


@dataclass(frozen=True)
class Couple:
    """Another coupling, made for the delays as they are now."""

    name: str  # one of COUPLINGS, or GIVEN


@dataclass(frozen=True)
class Delay:
    """More or fewer samples of delay on every channel; the coupling stays as it is."""

    which: str  # one of DELAYS
    samples: int


@dataclass(frozen=True)
class Push:
    """A force on a handle, until the next one."""

    channel: int  # counted from 1
    force: float  # [N]


@dataclass(frozen=True)
class Restart:
    """The plant and the process from rest."""


Event = Couple | Delay | Push | Restart

#: GLFW's key codes, left free by the viewer itself: 0 to 5 and the letters show and hide parts of the scene
KEYS: dict[int, tuple[str, Event]] = {
    ord("6"): ("6", Couple("none")),
    ord("7"): ("7", Couple("published")),
    ord("8"): ("8", Couple("designed")),
    ord("9"): ("9", Couple("optimal")),
    260: ("Insert", Couple(GIVEN)),
    265: ("Up", Delay("theta", 1)),
    264: ("Down", Delay("theta", -1)),
    268: ("Home", Delay("psi", 1)),
    269: ("End", Delay("psi", -1)),
    259: ("Backspace", Restart()),
}

Script = tuple[tuple[float, Event], ...]  # (time [s], event), in order of time


def parse_script(text: str, channels: int) -> Script:
    """'0:none 5:designed 7:theta+1 8:push1=3' as events in order of time. Raises InputError."""
    script = []
    for entry in text.split():
        when, colon, what = entry.partition(":")
        try:
            time = float(when)
        except ValueError:
            time = math.nan
        if not colon or not 0 <= time <= 3600:
            raise InputError(f"--script: {entry!r}, expected SECONDS:EVENT with 0 to 3600 s")
        script.append((time, _event(entry, what, channels)))
    if not script:
        raise InputError("--script is empty, expected entries like 0:none 5:designed")
    return tuple(sorted(script, key=lambda item: item[0]))


def words(event: Event) -> str:
    """The event as a script spells it."""
    match event:
        case Couple(name):
            return name
        case Delay(which, samples):
            return f"{which}{samples:+d}"
        case Push(channel, force):
            return f"push{channel}={force:g}"
        case Restart():
            return "restart"


def _event(entry: str, what: str, channels: int) -> Event:
    if (label := LABELS.get(what, what)) in (*COUPLINGS, GIVEN):
        return Couple(label)
    if what == "restart":
        return Restart()
    if delay := re.fullmatch(r"(theta|psi)([+-]\d{1,4})", what):
        return Delay(delay[1], int(delay[2]))
    if push := re.fullmatch(r"push(\d{1,3})=([+-]?[\d.]+)", what):
        channel, force = int(push[1]), _number(push[2])
        if 1 <= channel <= channels and abs(force) <= STRONGEST:
            return Push(channel, force)
        raise InputError(f"--script: {entry!r}, allowed are push1 to push{channels} with up to {STRONGEST:g} N")
    allowed = ", ".join((*COUPLINGS, GIVEN, "theta+1", "theta-1", "psi+1", "psi-1", "push1=3", "restart"))
    raise InputError(f"--script: {entry!r} is no event, allowed are {allowed}")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.inf
