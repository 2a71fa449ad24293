"""Limits of forces and encoders, and what a device must declare in INFO before it is driven.

Pure functions, no clock, no port. Order matters: a number that is not finite is found before any clamping, because
max(-12, min(12, nan)) is +12.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from haptic_loop.hw.protocol import (
    MAX_RELEASE_NS,
    MAX_THETA,
    PROTOCOL,
    Config,
    Force,
    Info,
    SafetyStop,
    State,
    wire_bytes,
)
from haptic_loop.models.device import require
from haptic_loop.sim.scenario import Scenario

_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_FEWEST_STEPS = 16  # of force up to the cap: coarser, and the certificate's linear loop is another one
_COARSEST = 0.1  # of the largest displacement in a tick that is taken for a hand's: one count of an encoder
_LARGEST_MARGIN_US = 30_000  # an age is read from a margin, which is an i16 in microseconds
_HOLD, _RAMP_US = 4, 5000  # what the device does without answers: ticks held, then microseconds to zero


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


class _Shaped(NamedTuple):
    """A force that may be sent, and what had to be done to it."""

    force: tuple[float, ...]  # (m,) [N]
    clipped: bool  # at the cap, by the limiter or by being cut here
    slowed: bool  # at the slew limit


def _require_finite(force: Sequence[float]) -> None:
    """Raise SafetyStop where a force is not a number or infinite."""
    if not all(map(math.isfinite, force)):
        raise SafetyStop(f"the controller asked for {', '.join(f'{f:g}' for f in force)} N, which is no force")


@dataclass(frozen=True)
class SafetyLimits:
    """The host's own limits; the device has the same ones in its firmware."""

    cap: tuple[float, ...]  # (m,) [N] largest force
    slew: float = 2000.0  # [N/s] fastest change of a force
    jump: float = 3e-3  # [m] largest displacement from tick to tick: 2.5 m/s at T = 1.2 ms
    watchdog_us: int = 6000  # [us] longest silence of a device that is streaming; see watchdog_for
    ramp_in: float = 0.25  # [s] in which the gain rises from 0 to 1
    ramp_out: float = 0.1  # [s] in which it falls
    speed: float = 1.0  # [m/s] fastest motion while forces act
    continuous: tuple[float, ...] = ()  # (m,) [N] that every motor stands for ever; none: heating is not looked at
    thermal: float = 10.0  # [s] time constant of the motors

    def __post_init__(self) -> None:
        for i, cap in enumerate(self.cap, start=1):
            require(f"cap #{i}", cap, 1e-3, 12.0, "N")
        require("slew", self.slew, 1.0, 2000.0, "N/s")
        require("jump", self.jump, 1e-6, 3e-3, "m")
        require("watchdog_us", self.watchdog_us, 1000, 20000, "us")
        require("ramp_in", self.ramp_in, 0.1, 0.25, "s")
        require("ramp_out", self.ramp_out, 0.1, 0.25, "s")
        require("speed", self.speed, 1e-3, 2.5, "m/s")
        require("thermal", self.thermal, 0.1, 1000.0, "s")
        if self.continuous and len(self.continuous) != len(self.cap):
            raise ValueError(f"continuous has {len(self.continuous)} entries, cap {len(self.cap)}")
        for i, (most, cap) in enumerate(zip(self.continuous, self.cap, strict=False), start=1):
            require(f"continuous #{i}", most, 1e-3, cap, "N")

    def shape(
        self,
        asked: Sequence[float],
        previous: Sequence[float],
        gain: float,
        T: float,
        test: Sequence[float] | None = None,
    ) -> _Shaped:
        """The force to send in place of `asked` (m,) [N], after `previous` (m,) [N], at a gain within [0, 1].

        `test` (m,) [N] is added behind the gain: what an encoder is tested with.

        Raises SafetyStop where `asked` is not finite; that is looked at first, and the result is looked at again.
        """
        _require_finite(asked)
        if not 0.0 <= gain <= 1.0:
            raise SafetyStop(f"the gain is {gain}, expected a number within [0, 1]")
        wishes = [gain * one for one in asked]
        if test:
            wishes = [one + more for one, more in zip(wishes, test, strict=True)]
            _require_finite(wishes)
        step, clipped, slowed, force = self.slew * T, False, False, []
        for wanted, last, cap in zip(wishes, previous, self.cap, strict=True):
            sent = wanted
            if not -cap < sent < cap:
                clipped, sent = True, math.copysign(cap, sent)
            if not last - step <= sent <= last + step:
                slowed, sent = True, last + math.copysign(step, sent - last)
            force.append(sent)
        _require_finite(force)
        return _Shaped(tuple(force), clipped, slowed)

    def check_jump(self, x: Sequence[float], previous: Sequence[float], ticks: int) -> None:
        """Raise SafetyStop where an encoder moved further in `ticks` ticks than a hand can: x, previous (m,) [m]."""
        most = self.jump * ticks
        for i, (now, before) in enumerate(zip(x, previous, strict=True), start=1):
            if not abs(now - before) <= most:
                allowed = f"{1e3 * most:g} mm in {ticks} tick{'s' if ticks > 1 else ''}"
                raise SafetyStop(f"encoder {i} jumped by {1e3 * abs(now - before):.3g} mm, allowed are {allowed}")

    def check_jolt(self, x: Sequence[float], previous: Sequence[float], before: Sequence[float]) -> None:
        """Raise SafetyStop where a speed changed within a tick by more than `jump` per tick, as no mass can.

        x, previous, before: (m,) [m], of three ticks in a row.
        """
        for i, (now, last, first) in enumerate(zip(x, previous, before, strict=True), start=1):
            if not (change := abs(now - 2 * last + first)) <= self.jump:
                most = f"{1e3 * self.jump:g} mm in a tick"
                raise SafetyStop(
                    f"encoder {i} shakes: its speed changed by {1e3 * change:.3g} mm in a tick, allowed are {most}"
                )

    def check_speed(self, x: Sequence[float], before: Sequence[float], seconds: float) -> None:
        """Raise SafetyStop where an axis moved faster than allowed: x now, `before` so many `seconds` ago, (m,) [m]."""
        most = self.speed * seconds
        for i, (now, then) in enumerate(zip(x, before, strict=True), start=1):
            if not abs(now - then) <= most:
                speed = abs(now - then) / seconds
                raise SafetyStop(f"axis {i} moves at {speed:.3g} m/s, allowed are {self.speed:g} m/s while forces act")

    def objections(self, info: Info, scenario: Scenario, baud: int | None) -> list[str]:
        """Why this device may not run this scenario over this line; empty where all is right. baud None: no UART."""
        if info.version != PROTOCOL:
            spoken = f"the device speaks version {info.version} of the protocol, this host version {PROTOCOL}"
            return [f"{spoken}: give it the firmware of this version (hw/firmware)"]
        m = scenario.channels
        if info.axes != m:
            return [f"the device has {info.axes} ax{'i' if info.axes == 1 else 'e'}s, the scenario {m} channels"]
        reasons = []
        period_ns = round(1e9 * scenario.T)
        if info.period_ns != period_ns:
            reasons.append(f"the device ticks every {info.period_ns} ns, the scenario's T is {period_ns} ns")
        if baud is not None:
            seconds, arithmetic = _wire_time(baud, m)
            if seconds > scenario.T:
                more = f"more than T = {1e6 * scenario.T:g} us (of a link without UART say --baud none)"
                reasons.append(f"one STATE and one FORCE take {arithmetic}, {more}")
        for i in range(m):
            if wrong := _impossible(i, info):
                return [wrong]
            damping, strongest = 1e-6 * info.osp_damping[i], 1e-6 * info.hard_limit[i] * info.force_step[i]
            if damping < scenario.delta[i] * (1 - 1e-6):
                reasons.append(
                    f"axis {i + 1} guarantees {damping:g} N s/m, the certificate needs delta = {scenario.delta[i]:g}"
                )
            reasons += _coarse(i, info, self, scenario.T)
            if strongest < self.cap[i] * (1 - 1e-3):
                reasons.append(f"axis {i + 1} can do {strongest:g} N, the force limit is {self.cap[i]:g} N")
        return reasons

    def configuration(self, info: Info, theta: int) -> Config:
        """The CONFIG for the device: never more than the host allows itself, nor than the device can do."""
        T_ns = info.period_ns
        ramp = max(1, min(0xFF, math.ceil(1000 * _RAMP_US / T_ns)))
        steps = [1e-6 * step for step in info.force_step]
        most = [int(cap / step + 1e-9) for cap, step in zip(self.cap, steps, strict=True)]
        slew = [min(0xFFFF, math.ceil(self.slew * 1e-9 * T_ns / step - 1e-6)) for step in steps]
        return Config(
            theta=theta,
            hold=max(0, min(_HOLD, MAX_RELEASE_NS // T_ns - ramp)),
            ramp=ramp,
            ramp_in=min(0xFFFF, math.ceil(1e9 * self.ramp_in / T_ns)),
            cap=tuple(map(min, info.hard_limit, most)),
            slew=tuple(slew),
        )


@dataclass
class Gain:
    """The factor in front of every force. It moves linearly in time, never jumps, and starts at 0.

    Any constant gain within [0, 1] keeps a certificate: this-environment holds for g F if it does for F.
    """

    limits: SafetyLimits
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


class Heat:
    """The heating of every motor by the square of its force, I2t: a first-order lag that tends to the square.

    At a constant force F it reaches the continuous force's square after -tau ln(1 - (F_continuous / F)^2).
    """

    def __init__(self, limits: SafetyLimits, T: float) -> None:
        self._limits, self._T = limits, T
        self._squares = [0.0] * len(limits.continuous)  # [N^2]

    def check(self, force: Sequence[float], ticks: int) -> None:
        """Take in the force (m,) [N] that acts for so many ticks. Raise SafetyStop where a motor gets too hot."""
        part = -math.expm1(-ticks * self._T / self._limits.thermal)
        for i, most in enumerate(self._limits.continuous):
            self._squares[i] += (force[i] ** 2 - self._squares[i]) * part
            if self._squares[i] > most**2:
                raise SafetyStop(
                    f"motor {i + 1} gets hot: {self._squares[i] ** 0.5:.3g} N rms, {most:g} N are allowed for long"
                )


# before anything moves: is this the device that the scenario is about, and can the line carry it?


@dataclass(frozen=True)
class Units:
    """Integers of the wire to SI units and back. The wire carries what the motor does, -f."""

    encoder_step: tuple[float, ...]  # (m,) [m]
    force_step: tuple[float, ...]  # (m,) [N]
    range: tuple[int, ...]  # (m,) [counts] the workspace is +-range

    @classmethod
    def of(cls, info: Info) -> Units:
        encoder = tuple(1e-12 * step for step in info.encoder_step)
        return cls(encoder, tuple(1e-6 * step for step in info.force_step), info.range)

    def positions(self, counts: Iterable[int]) -> tuple[float, ...]:
        """Displacements (m,) [m]."""
        return tuple([n * step for n, step in zip(counts, self.encoder_step, strict=True)])

    def forces(self, steps: tuple[int, ...]) -> tuple[float, ...]:
        """Forces fed back f (m,) [N], from what the motors do."""
        return tuple(-n * step for n, step in zip(steps, self.force_step, strict=True))

    def steps(self, f: Sequence[float], cap: tuple[int, ...]) -> tuple[int, ...]:
        """What the motors are to do for the forces fed back f (m,) [N]: whole steps, at most `cap`."""
        each = zip(f, self.force_step, cap, strict=True)
        return tuple([max(-most, min(most, round(-force / step))) for force, step, most in each])

    def check_range(self, counts: Sequence[int]) -> None:
        """Raise SafetyStop where an encoder (m,) [counts] is outside of what the device can reach."""
        for i, (now, most) in enumerate(zip(counts, self.range, strict=True)):
            if not -most <= now <= most:
                mm = 1e3 * self.encoder_step[i]
                raise SafetyStop(f"encoder {i + 1} is at {mm * now:.4g} mm, its range is +-{mm * most:.4g} mm")


def _wire_time(baud: int, axes: int) -> tuple[float, str]:
    """Seconds for one STATE and one FORCE, and the arithmetic as text."""
    up, down = wire_bytes(State, axes), wire_bytes(Force, axes)
    seconds = (up + down) * _BITS_PER_BYTE / baud
    return seconds, f"({up} + {down}) bytes x {_BITS_PER_BYTE} bits / {baud} baud = {1e6 * seconds:.0f} us"


def _impossible(i: int, info: Info) -> str | None:
    """Values of axis i that docs/protocol.md does not allow."""
    allowed = {"encoder_step": 0xFFFFFFFF, "force_step": 0xFFFFFFFF, "hard_limit": 0x7FFF, "range": 0x7FFFFFFF}
    for name, most in allowed.items():
        if not 1 <= (value := getattr(info, name)[i]) <= most:
            return f"{name.replace('_', ' ')} of axis {i + 1} is {value}, allowed are 1 to {most}"
    return None


def _coarse(i: int, info: Info, limits: SafetyLimits, T: float) -> list[str]:
    """Steps of axis i that are too coarse for limits on forces and displacements."""
    force, count = 1e-6 * info.force_step[i], 1e-12 * info.encoder_step[i]
    most, widest = min(limits.cap[i] / _FEWEST_STEPS, limits.slew * T), _COARSEST * limits.jump
    wide = f"one encoder count of axis {i + 1} is {1e3 * count:g} mm, at most {1e3 * widest:g} mm is allowed"
    strong = f"one force step of axis {i + 1} is {force:g} N, at most {most:g} N is allowed"
    return [strong] * (force > most) + [wide] * (count > widest)


def probe_delay(T: float) -> int:
    """The theta to measure with: the longest whose margin can be told. Raises ValueError where there is none."""
    theta = min(MAX_THETA, int(_LARGEST_MARGIN_US / (1e6 * T)))
    if theta < 1:
        raise ValueError(f"T is {T:g} s, a serial link is for at most {1e-6 * _LARGEST_MARGIN_US:g} s")
    return theta


def watchdog_for(T: float) -> int:
    """The longest silence [us] of a device that ticks every T [s]: five ticks, and at least the 6 ms of a busy host.

    Raises ValueError where that is longer than a free handle may be pushed without being asked.
    """
    silence = max(6000, math.ceil(round(5e6 * T, 3)))
    if silence > MAX_RELEASE_NS // 1000:
        most = MAX_RELEASE_NS / 5e9
        raise ValueError(f"T is {T:g} s, a serial link is for at most {most:g} s: the host's watchdog is five ticks")
    return silence
