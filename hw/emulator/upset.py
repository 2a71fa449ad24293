"""Faults to order: what a cable, a process or a device can do wrong, on the emulator and in tests alike.

Written KIND[=VALUE][@START[+DURATION]], with `up:` (device to host) or `down:` in front for one direction of the line:

    drop=0.1          a tenth of all frames never arrives
    up:flip=0.02@1+2  from 1 s after arming, for 2 s, one bit of every fiftieth STATE is wrong
    stall=0.03@1      the device freezes for 30 ms, 1 s after arming
    unplug@1          the cable is pulled, 1 s after arming

Without @ a fault is there from the start. Every draw comes from a seeded generator.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Self

import numpy as np

from models.device import require
from sim.scenario import InputError

FOREVER = 1e9  # [s]

#: kind -> (what VALUE is, least, most, default), for the line
LINE = {
    "flip": ("probability per frame that one bit is wrong", 0.0, 1.0, 0.01),
    "drop": ("probability per frame that it is lost", 0.0, 1.0, 0.1),
    "truncate": ("probability per frame that its end is lost", 0.0, 1.0, 0.1),
    "garbage": ("mean number of random bytes before a frame", 0.0, 1000.0, 4.0),
    "duplicate": ("probability per frame that it comes twice", 0.0, 1.0, 0.1),
    "reorder": ("probability per frame that the one after it overtakes it", 0.0, 1.0, 0.1),
    "delay": ("seconds by which every frame is late", 0.0, 10.0, 1e-3),
    "jitter": ("mean of an exponential extra delay in seconds", 0.0, 10.0, 1e-4),
}
#: kind -> the same, for the device
DEVICE = {
    "stall": ("seconds for which the device freezes", 0.0, 10.0, 0.01),
    "unplug": ("no value", 0.0, 0.0, 0.0),
    "reset": ("no value", 0.0, 0.0, 0.0),
    "jump": ("millimetres by which encoder 1 jumps", -1000.0, 1000.0, 5.0),
    "leap": ("ticks by which its tick number leaps", 1.0, 32000.0, 300.0),
    "own": ("newtons that its motors have while armed, whatever they are told", -12.0, 12.0, 2.0),
    "stuck": ("no value: it holds its force, without a watchdog and whatever STOP says", 0.0, 0.0, 0.0),
    "period": ("length of a tick in T", 0.5, 4.0, 2.0),
    "estop": ("no value: the emergency stop at the device", 0.0, 0.0, 0.0),
    "trip": ("no value: a fault that the firmware found", 0.0, 0.0, 0.0),
}
KINDS = LINE | DEVICE
_FORM = re.compile(r"(?:(up|down):)?([a-z]+)(?:=([^@+]+))?(?:@([^+]+)(?:\+(.+))?)?")


@dataclass(frozen=True)
class Upset:
    """One thing that goes wrong."""

    kind: str
    value: float
    where: str = "both"  # up | down | both: direction of the line
    start: float | None = None  # [s] after arming; None: always
    duration: float = FOREVER  # [s]

    @classmethod
    def parse(cls, text: str) -> Self:
        """The fault that `text` describes. Raises InputError naming what is wrong with it."""
        match = _FORM.fullmatch(text)
        if not match or match[2] not in KINDS:
            raise InputError(f"--fault is {text!r}, expected KIND[=VALUE][@START[+DURATION]], KIND one of {_names()}")
        where, kind, value, start, duration = match.groups()
        if where and kind not in LINE:
            raise InputError(f"--fault {text}: {kind} happens to the device, not to one direction of the line")
        what, low, high, default = KINDS[kind]
        try:
            given = default if value is None else float(value)
            begins = None if start is None else float(start)
            lasts = FOREVER if duration is None else float(duration)
            require(f"{kind} ({what})", given, low, high, "")
            require("START", begins or 0.0, 0.0, FOREVER, "s")
            require("DURATION", lasts, 1e-6, FOREVER, "s")
            if kind == "leap" and given != int(given):
                raise ValueError(f"VALUE is {given:g}, expected a whole number of ticks")
        except ValueError as error:
            raise InputError(f"--fault {text}: {str(error).strip()}") from None
        return cls(kind, given, where or "both", begins, lasts)

    def active(self, since_armed: float | None) -> bool:
        """Whether it happens now, `since_armed` seconds after arming (None: not armed yet)."""
        if self.start is None:
            return True
        return since_armed is not None and self.start <= since_armed < self.start + self.duration


class Line:
    """One direction of the link: frames go in, bytes come out later, some of them wrong."""

    def __init__(self, direction: str, upsets: tuple[Upset, ...], seed: int, latency_us: float = 0.0) -> None:
        self._upsets = [u for u in upsets if u.kind in LINE and u.where in (direction, "both")]
        self._rng = np.random.default_rng([seed, direction == "up"])
        self._latency = latency_us
        self._held: bytes | None = None  # a frame that lets the next one pass

    def send(self, frame: bytes, now_us: float, since_armed: float | None) -> list[tuple[float, bytes]]:
        """When which bytes arrive [us]: the frame with what happens to it."""
        frames, due = [frame], now_us + self._latency
        for upset in self._upsets:
            if upset.active(since_armed):
                if upset.kind == "delay":
                    due += 1e6 * upset.value
                elif upset.kind == "jitter":
                    due += 1e6 * float(self._rng.exponential(upset.value))
                else:
                    frames = [out for one in frames for out in self._upset(upset, one)]
        return [(due, out) for out in frames]

    def _upset(self, upset: Upset, frame: bytes) -> list[bytes]:
        rng = self._rng
        if upset.kind == "garbage":
            return [rng.bytes(int(rng.poisson(upset.value))) + frame]
        struck = rng.random() < upset.value
        if upset.kind == "reorder":
            held, self._held = self._held, None
            if held is not None:
                return [frame, held]
            if struck:
                self._held = frame
                return []
            return [frame]
        if not struck:
            return [frame]
        if upset.kind == "flip":
            i, bit = int(rng.integers(len(frame))), int(rng.integers(8))
            return [frame[:i] + bytes([frame[i] ^ (1 << bit)]) + frame[i + 1 :]]
        if upset.kind == "truncate":
            return [frame[: int(rng.integers(len(frame)))]]
        return [] if upset.kind == "drop" else [frame, frame]


def _names() -> str:
    return ", ".join(KINDS)
