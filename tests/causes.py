"""Recognise what stopped a session from its message, also after a word of the message has changed.

Tests name a cause by a key of CAUSES and by the numbers of the message, as in "wrong scale: 1 2.5 0.25".
"""

import re
from contextlib import contextmanager

import pytest

from haptic_loop.hw.protocol import SafetyStop

#: Messages without their numbers. A text has the cause whose message shares most words with it.
CAUSES = {
    # encoders and motors
    "dead encoder": "encoder of axis does not follow: it moved by counts at a test force of up to N. Is its motor on?",
    "still encoder": "encoder of axis does not follow: it stands still while the force changes by N",
    "still handle": "encoder or motor of axis is dead: nothing moves for s under a force",
    "held at arming": "axis does not follow a test force of up to N as a free handle does: let go of it while arming",
    "held at the end": "axis did not move as a free handle at the end: let go of all handles before a session ends. "
    "If nobody held it, motor or encoder is wrong",
    "no answer at the end": "motor or encoder of axis did not answer a test force of up to N at the end of the session",
    "little energy": "the energy left allows of N: motor and encoder of axis are not tested. Raise --energy-budget",
    "faint test": "a test force of up to N moves axis by mm, less than counts of mm: its encoder is not tested.",
    "wrong sign": "axis has the wrong sign: a positive force moves it to negative counts. Reverse its motor or encoder",
    "swapped axes": "a force on axis moves encoder: axes are swapped",
    "connected axes": "a force on axis moves encoder, too: two axes are connected to each other",
    "one-sided motor": "axis moves much farther in one direction than in the other: its motor is weak in one direction",
    "one-sided encoder": "axis moves much farther in one direction than in the other: its encoder loses counts in one "
    "direction",
    "wrong scale": "axis moves times as far as expected of kg: its encoder step, force step or mass is wrong, or dry "
    "friction brakes it",
    "weaker motor": "axis moves times as far as at arming: its motor has become weak, or saturates at this force",
    "dead zone": "axis moves times as far as expected of its motion under twice the force, and not because of dry "
    "friction: its motor has a dead zone",
    "late axis": "axis answers ticks later than agreed: an encoder or motor has a hidden delay",
    # motion and heat
    "jump": "encoder jumped by mm, allowed are mm in ticks",
    "jolt": "encoder jumped by mm: no force can move it by mm in ticks and stop it in the next",
    "speed": "axis moves at m/s, allowed are m/s while forces act",
    "range": "encoder is at mm, its range is mm",
    "heat": "motor gets hot: N rms, N are allowed for long",
    # the device
    "watchdog": "the device is in ramp, cause watchdog",
    "device fault": "the device is in ramp, cause device",
    "silent device": "the device is in silent, cause none",
    "force above the cap": "the device applies steps, the cap is",
    "force without arming": "the device is disarmed and applies steps",
    "force unlike the command": "the device applies steps, it was told; ticks or more were wrong",
    "long hold": "the device holds a force for ticks, are agreed",
    "tick leap": "the tick number leapt by, the watchdog allows",
    "device clock": "a tick of the device lasts us by its time stamps over ticks, T is us",
    "host clock": "a tick of the device lasts us by the host's clock over ticks, T is us",
    "noisy encoder": "encoder is noisy at rest: its positions vary by mm within s, at most mm is allowed",
    "clock goes back": "the time by its time stamps goes back over ticks, T is us",
    "armed itself": "the device is armed without a command",
    "disarmed itself": "the device has disarmed itself",
    "deaf device": "the device still drives ms after STOP: cut its power",
    "device deadman": "the deadman at the device was let go",
    # the link
    "silence": "no new STATE for ms: the device hangs, or a brown-out reset it",
    "missed answers": "% of the last ticks had no answer in time",
    "no answer": "no answer to HELLO within s",
    "late answers": "% of the last answers were late",
    "answers that never reached": "% of the answers never reached the device, STATEs came",
    "answers that never arrived": "% of the answers never arrived: no delay covers % (--quantile)",
    "missing STATEs": "no STATE in % of ticks: the device's forces are unknown",
    "missing margins": "more than % of the last STATEs lack a margin: their lateness is unknown",
    "answers beyond a tick": "answers come up to us after their tick, guard included; the shortest tick is us, which "
    "must be longer: use a longer T",
    # the person
    "deadman": "the deadman was let go for s",
    "time": "the time is over",
    "nobody to arm": "nobody is there to arm the softer coupling",
    "asked to move": "move axis by mm or more and hold it",
    "asked again": "axis moved by mm, not in + direction. Go back, then move axis by mm or more and hold it",
    "moved backwards": "axis moved by mm, not in + direction, twice: reverse both its motor and its encoder, unless "
    "the person moved it the other way",
    "moved another axis": "axis moved by mm instead of axis, twice: the axes are exchanged, with motors and encoders, "
    "or the person moved another axis",
    # the controller
    "no force": "the controller asked for N, which is no force",
    "cut forces": "% of the forces were cut in a second: raise --force-cap, request smaller forces, or look for a "
    "reversed sign",
    "cut by the budget": "% of the forces were cut in a second: the energy account allowed no more. Raise "
    "--energy-budget, or look for a part that gives energy",
}


def _words(text: str) -> set[str]:
    return set(re.findall(r"[a-z][a-z'-]*", text.lower()))


def cause_of(text: str) -> str:
    """Return the key of the cause that a message states and the message's numbers, or the message if none is alike."""
    said, alike = _words(text), {}
    for name, message in CAUSES.items():
        words = _words(message)
        alike[name] = len(words & said) - len(words - said)
    name = max(alike, key=alike.__getitem__)
    if 2 * alike[name] < len(_words(CAUSES[name])):
        return text
    numbers = re.findall(r"(?<![\w.])[-+]?(?:\d+(?:\.\d+)?(?:e[-+]?\d+)?|nan\b|inf\b)", text)
    return f"{name}: {' '.join(numbers)}".rstrip()


@contextmanager
def expect_stop(cause: str):
    """Expect a SafetyStop whose cause and numbers begin with the regular expression `cause`."""
    with pytest.raises(SafetyStop) as stop:
        yield
    assert re.match(cause, cause_of(str(stop.value))), stop.value
