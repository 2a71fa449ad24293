"""What the host never does to a device, whatever the controller says: pure functions, no clock, no port.

Order matters. A number that is not finite is found before any clamping, because max(-12, min(12, nan)) is +12.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from models.device import require


class Stage(StrEnum):
    """Where a session stands. From the last five there is no way back but a new session."""

    CONNECTING = "connecting"  # HELLO sent, no INFO yet
    CONFIGURING = "configuring"  # CONFIG sent, no ACK yet
    MEASURING = "measuring"  # zero force: the age of every answer is collected
    MEASURED = "measured"  # zero force: waiting for a coupling that is certified for what was measured
    DISARMED = "disarmed"  # zero force: waiting for a person
    ARMING = "arming"  # the gain rises
    ARMED = "armed"
    DISARMING = "disarming"  # the gain falls
    FINISHED = "finished"  # ended as planned
    REFUSED = "refused"  # this device, link or coupling may not be armed
    STOPPED = "stopped"  # a fault
    LOST = "lost"  # the device does not answer, or is gone
    ESTOP = "e-stop"


ENDED = frozenset({Stage.FINISHED, Stage.REFUSED, Stage.STOPPED, Stage.LOST, Stage.ESTOP})
DRIVING = frozenset({Stage.ARMING, Stage.ARMED, Stage.DISARMING})


class Fault(Exception):
    """A reason to stop, in the words of the log."""


@dataclass(frozen=True)
class Limits:
    """The host's own limits; the device has the same ones in its firmware."""

    cap: tuple[float, ...]  # (m,) [N] largest force
    slew: float = 2000.0  # [N/s] fastest change of a force
    jump: float = 3e-3  # [m] largest displacement from tick to tick: 2.5 m/s at T = 1.2 ms
    watchdog_us: int = 6000  # [us] longest silence of a device that is streaming
    ramp_in: float = 0.25  # [s] in which the gain rises from 0 to 1
    ramp_out: float = 0.1  # [s] in which it falls

    def __post_init__(self) -> None:
        for i, cap in enumerate(self.cap):
            require(f"cap[{i}]", cap, 1e-3, 12.0, "N")
        require("slew", self.slew, 1.0, 2000.0, "N/s")
        require("jump", self.jump, 1e-6, 3e-3, "m")
        require("watchdog_us", self.watchdog_us, 1000, 20000, "us")
        require("ramp_in", self.ramp_in, 0.1, 0.25, "s")
        require("ramp_out", self.ramp_out, 0.1, 0.25, "s")


@dataclass(frozen=True)
class Shaped:
    """A force that may be sent, and what had to be done to it."""

    force: tuple[float, ...]  # (m,) [N]
    clipped: bool  # at the cap
    slowed: bool  # at the slew limit


def require_finite(force: Sequence[float]) -> None:
    """Raise Fault where a force is not a number or infinite."""
    if not all(map(math.isfinite, force)):
        raise Fault(f"the controller asked for {', '.join(f'{f:g}' for f in force)} N, which is no force")


def shape(asked: Sequence[float], previous: Sequence[float], gain: float, limits: Limits, T: float) -> Shaped:
    """The force to send in place of `asked` (m,) [N], after `previous` (m,) [N], at a gain within [0, 1].

    Raises Fault where `asked` is not finite; that is looked at first, and the result is looked at again.
    """
    require_finite(asked)
    if not 0.0 <= gain <= 1.0:
        raise Fault(f"the gain is {gain}, expected a number within [0, 1]")
    step, clipped, slowed, force = limits.slew * T, False, False, []
    for wanted, last, cap in zip(asked, previous, limits.cap, strict=True):
        capped = max(-cap, min(cap, gain * wanted))
        sent = max(last - step, min(last + step, capped))
        clipped |= capped != gain * wanted
        slowed |= sent != capped
        force.append(sent)
    require_finite(force)
    return Shaped(tuple(force), clipped, slowed)


def check_jump(x: Sequence[float], previous: Sequence[float], ticks: int, limits: Limits) -> None:
    """Raise Fault where an encoder moved further in `ticks` ticks than a hand can: x, previous (m,) [m]."""
    for i, (now, before) in enumerate(zip(x, previous, strict=True), start=1):
        if not abs(now - before) <= limits.jump * ticks:
            allowed = f"{1e3 * limits.jump * ticks:g} mm in {ticks} tick{'s' if ticks > 1 else ''}"
            raise Fault(f"encoder {i} jumped by {1e3 * abs(now - before):.3g} mm, allowed are {allowed}")


def check_jolt(x: Sequence[float], previous: Sequence[float], before: Sequence[float], limits: Limits) -> None:
    """Raise Fault where an encoder's speed changed within a tick by more than `limits.jump` per tick, as no mass can.

    x, previous, before: (m,) [m], of three ticks in a row.
    """
    for i, (now, last, first) in enumerate(zip(x, previous, before, strict=True), start=1):
        if not (change := abs(now - 2 * last + first)) <= limits.jump:
            most = f"{1e3 * limits.jump:g} mm in a tick"
            raise Fault(f"encoder {i} shakes: its speed changed by {1e3 * change:.3g} mm in a tick, allowed are {most}")


def check_range(x: Sequence[float], reach: Sequence[float]) -> None:
    """Raise Fault where a displacement x (m,) [m] is outside of what the device can reach: +-reach (m,) [m]."""
    for i, (now, most) in enumerate(zip(x, reach, strict=True), start=1):
        if not abs(now) <= most:
            raise Fault(f"encoder {i} is at {1e3 * now:.4g} mm, its range is +-{1e3 * most:.4g} mm")


@dataclass
class Gain:
    """The factor in front of every force. It moves linearly in time, never jumps, and starts at 0.

    Any constant gain within [0, 1] keeps a certificate: He[g F/(z-1)] > -Delta_D/T holds for g F if it does for F.
    """

    limits: Limits
    T: float  # [s]
    value: float = 0.0

    def rise(self, ticks: int = 1) -> float:
        """The gain `ticks` ticks later, on its way to 1."""
        self.value = min(1.0, self.value + ticks * self.T / self.limits.ramp_in)
        return self.value

    def fall(self, ticks: int = 1) -> float:
        """The gain `ticks` ticks later, on its way to 0."""
        self.value = max(0.0, self.value - ticks * self.T / self.limits.ramp_out)
        return self.value
