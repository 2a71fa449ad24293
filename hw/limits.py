"""Limit forces and displacements, and check what a device declares in INFO before it is driven.

The functions use no clock and no port. They reject numbers that are not finite before they clamp anything, because
max(-12, min(12, nan)) is +12.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_loop.hw import protocol as wire
from haptic_loop.hw.protocol import MAX_RELEASE_NS, MAX_THETA, PROTOCOL, Config, Info, SafetyStop
from haptic_loop.models.device import require
from haptic_loop.sim.scenario import Scenario

_BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
_FEWEST_STEPS = 16  # least number of force steps up to the cap; fewer steps make the loop nonlinear
COARSEST = 0.1  # An encoder step is at most this share of `jump`, the largest displacement in a tick.
_LARGEST_MARGIN_US = 30_000  # longest time from a FORCE to its latch in a measurement; an i16 carries 32767 us
_ROUNDED = 1e-12  # largest relative rounding error of the length of a limited vector
_RAMP_IN, _RAMP_OUT = 0.25, 0.1  # [s] times in which the gain rises from 0 to 1, and falls back
_HOLD, _RAMP_US = 4, 5000  # ticks for which a device without new forces holds the last force; then a ramp [us]


class Stage(StrEnum):
    """The stage of a session. In the last five stages the session has ended, and only a new session can be armed."""

    CONNECTING = "connecting"  # HELLO sent, no INFO yet
    CONFIGURING = "configuring"  # CONFIG sent, no ACK yet
    MEASURING = "measuring"  # zero force: the ages of answers are measured
    MEASURED = "measured"  # zero force: the session waits for a coupling that is certified for the measured delay
    DISARMED = "disarmed"  # zero force: the session waits for a person
    ARMING = "arming"  # the gain rises
    ARMED = "armed"
    DISARMING = "disarming"  # the gain falls
    FINISHED = "finished"  # the session ended as planned
    REFUSED = "refused"  # this device, link or coupling may not be armed
    STOPPED = "stopped"  # a fault ended the session
    LOST = "lost"  # the device does not answer, or is gone
    ESTOP = "e-stop"


ENDED = frozenset({Stage.FINISHED, Stage.REFUSED, Stage.STOPPED, Stage.LOST, Stage.ESTOP})
DRIVING = frozenset({Stage.ARMING, Stage.ARMED, Stage.DISARMING})


class _Shaped(NamedTuple):
    """A force that may be sent, and the limits that it has reached."""

    force: tuple[float, ...]  # (m,) [N]
    clipped: bool  # whether an entry or a vector is at its cap, by the limiter or by clipping here
    slowed: bool  # whether the slew rate limits an entry


def _require_finite(force: Sequence[float]) -> None:
    """Raise SafetyStop where a force (m,) [N] is infinite or not a number."""
    if not all(map(math.isfinite, force)):
        raise SafetyStop(f"the controller asked for {', '.join(f'{f:g}' for f in force)} N, which is no force")


@dataclass(frozen=True)
class SafetyLimits:
    """The host's limits on forces and motion. The device has its own force limits in its firmware."""

    cap: tuple[float, ...]  # (m,) [N] largest force, or largest length of a vector
    slew: float = 2000.0  # [N/s] fastest change of a force
    jump: float = 3e-3  # [m] largest displacement from tick to tick: 2.5 m/s at T = 1.2 ms
    watchdog_us: int = 6000  # [us] longest silence of a device that is streaming; see watchdog_for
    #: [m/s] fastest motion while forces act; under 2 N and with a drifting encoder, a handle then stays below 1 m/s
    speed: float = 0.7
    continuous: tuple[float, ...] = ()  # (m,) [N] forces that the motors can hold indefinitely; empty: no heat check
    thermal: float = 10.0  # [s] time constant of the motors
    vectors: tuple[tuple[int, int], ...] = ()  # first channel and end of each vector whose length is limited
    lever: float = 1.0  # [m] radius of the hand on a rotary device, which scales the limits; else 1
    raisable: tuple[bool, ...] = ()  # (m,) axes with a default cap below 1.3 N that --force-cap can raise; empty: none
    motors: tuple[float, ...] = ()  # (m,) [N] force limits of the scenario, up to which --force-cap can raise caps

    def __post_init__(self) -> None:
        r = self.lever
        for i, cap in enumerate(self.cap, start=1):
            require(f"cap #{i}", cap, 1e-3 * r, 12.0 * r, "N")
        require("slew", self.slew, 1.0 * r, 2000.0 * r, "N/s")
        require("jump", self.jump, 1e-6 / r, 3e-3 / r, "m")
        require("watchdog_us", self.watchdog_us, 1000, 20000, "us")
        require("speed", self.speed, 1e-3 / r, 2.5 / r, "m/s")
        require("thermal", self.thermal, 0.1, 1000.0, "s")
        if self.continuous and len(self.continuous) != len(self.cap):
            raise ValueError(f"continuous has {len(self.continuous)} entries, cap {len(self.cap)}")
        for i, most in enumerate(self.continuous, start=1):
            require(f"continuous #{i} (--continuous-force)", most, 1e-3 * r, 12.0 * r, "N")

    def raise_cap(self, axis: int, why: str) -> str:
        """Return `why` and the advice to raise the cap of `axis` if it is a small default cap, else ""."""
        return f"{why}: raise --force-cap" if any(self.raisable[axis : axis + 1]) else ""

    def shape(
        self,
        asked: Sequence[float],
        previous: Sequence[float],
        gain: float,
        T: float,
        test: Sequence[float] | None = None,
    ) -> _Shaped:
        """Shape `asked` (m,) [N], at a gain within [0, 1], into a force that may be sent after `previous` (m,) [N].

        A capped vector keeps its direction. A vector with an axis above the slew rate moves straight towards its goal,
        with its fastest axis at the slew rate.

        `test` (m,) [N] is the force of the encoder test. It is added after the gain. Raises SafetyStop where
        `asked`, its sum with `test`, or the result is not finite, or the gain is outside of [0, 1].
        """
        _require_finite(asked)
        if not 0.0 <= gain <= 1.0:
            raise SafetyStop(f"the gain is {gain}, expected a number within [0, 1]")
        wishes = [gain * one for one in asked]
        if test:
            wishes = [one + more for one, more in zip(wishes, test, strict=True)]
            _require_finite(wishes)
        step, clipped, slowed, force = self.slew * T, False, False, []
        for first, end in self.vectors:
            length, cap = math.hypot(*wishes[first:end]), self.cap[first]
            if not length < cap:
                clipped, wishes[first:end] = True, [one * (cap / length) for one in wishes[first:end]]
            change = max(abs(one - last) for one, last in zip(wishes[first:end], previous[first:end], strict=True))
            if change > step:
                slowed, share = True, step / change
                ends = zip(wishes[first:end], previous[first:end], strict=True)
                wishes[first:end] = [last + share * (one - last) for one, last in ends]
        for wanted, last, cap in zip(wishes, previous, self.cap, strict=True):
            sent = wanted
            if not -cap < sent < cap:
                clipped, sent = True, math.copysign(cap, sent)
            if not last - step <= sent <= last + step:
                slowed, sent = True, last + math.copysign(step, sent - last)
            force.append(sent)
        _require_finite(force)
        return _Shaped(tuple(force), clipped, slowed)

    @property
    def widest(self) -> float:
        """The largest encoder step, and the largest noise of an encoder at rest, that a session allows [m]."""
        return COARSEST * self.jump

    def capped(self, forces: NDArray[np.float64], at: float = 1.0) -> NDArray[np.bool_]:
        """Return where forces (ticks, m) [N] reach the share `at` of their caps; a vector counts by its length."""
        size = np.abs(forces)
        for first, end in self.vectors:
            size[:, first:end] = (1 + _ROUNDED) * np.linalg.norm(forces[:, first:end], axis=1, keepdims=True)
        return size >= at * np.array(self.cap)

    def check_jump(self, x: Sequence[float], previous: Sequence[float], ticks: int) -> None:
        """Raise SafetyStop where no hand can have moved an axis from `previous` to x (m,) [m] in `ticks` ticks."""
        most = self.jump * ticks
        for i, (now, before) in enumerate(zip(x, previous, strict=True), start=1):
            if not abs(now - before) <= most:
                allowed = f"{1e3 * most:g} mm in {ticks} tick{'s' if ticks > 1 else ''}"
                raise SafetyStop(f"encoder {i} jumped by {1e3 * abs(now - before):.3g} mm, allowed are {allowed}")

    def check_jolt(self, path: Sequence[tuple[float, ...]], gaps: tuple[int, int, int], most: Sequence[float]) -> None:
        """Raise SafetyStop where an axis jumped by more than `most` (m,) [m] between the second and third position.

        `path` has four displacements (m,) [m], with `gaps` [ticks] between them. A counting error is a pulse: the mean
        speed in the middle gap is above both of its neighbours, or below both. The pulse's size is the smaller
        difference times the middle gap. A handle that reaches a stop only loses speed. `largest_pulse` bounds the
        pulses of real motions.
        """
        p, q, r = gaps
        for i, (a, b, c, d, allowed) in enumerate(zip(*path, most, strict=True), start=1):
            gained, lost = (c - b) / q - (b - a) / p, (d - c) / r - (c - b) / q
            if gained * lost < 0 and not (jump := q * min(abs(gained), abs(lost))) <= allowed:
                limit = f"no force can move it by {1e3 * allowed:.3g} mm in {'one tick' if q == 1 else f'{q} ticks'}"
                raise SafetyStop(f"encoder {i} jumped by {1e3 * jump:.3g} mm: {limit} and stop it in the next")

    def check_speed(self, x: Sequence[float], before: Sequence[float], seconds: float) -> None:
        """Raise SafetyStop where an axis moved from `before` to x (m,) [m] within `seconds` faster than `speed`."""
        most = self.speed * seconds
        for i, (now, then) in enumerate(zip(x, before, strict=True), start=1):
            if not abs(now - then) <= most:
                speed = abs(now - then) / seconds
                raise SafetyStop(f"axis {i} moves at {speed:.3g} m/s, allowed are {self.speed:g} m/s while forces act")

    def objections(self, info: Info, scenario: Scenario, baud: int | None) -> list[str]:
        """Return the reasons why this device may not run this scenario over this line (baud None: no UART)."""
        if info.version != PROTOCOL:
            spoken = f"the device speaks version {info.version} of the protocol, this host version {PROTOCOL}"
            return [f"{spoken}: give it the firmware of this version (hw/firmware)"]
        m = scenario.channels
        if info.axes != m:
            return [f"the device has {info.axes} ax{'i' if info.axes == 1 else 'e'}s, the scenario {m} channels"]
        try:
            wire.encode(info._replace(firmware=""))
        except ValueError as error:
            return [f"the device reports an impossible value, {error}"]
        reasons, period_ns = [], round(1e9 * scenario.T)
        if info.period_ns != period_ns:
            reasons.append(f"the device ticks every {info.period_ns} ns, the scenario's T is {period_ns} ns")
        if baud is not None:
            seconds, arithmetic = _wire_time(baud, m)
            if seconds > scenario.T:
                more = f"more than T = {1e6 * scenario.T:g} us (for a link without UART, give --baud none)"
                reasons.append(f"one STATE and one FORCE take {arithmetic}, {more}")
        units, widest = Units.of(info), self.widest
        device = info.osp_damping, units.encoder_step, units.force_step, info.hard_limit
        axes = zip(*device, scenario.delta, self.cap, strict=True)
        for i, (damping, count, step, hard, delta, cap) in enumerate(axes, start=1):
            finest, strongest = min(cap / _FEWEST_STEPS, self.slew * scenario.T), hard * step
            if 1e-6 * damping < delta * (1 - 1e-6):
                reasons.append(f"axis {i} guarantees {1e-6 * damping:g} N s/m, the certificate needs delta = {delta:g}")
            if step > finest:
                more = self.raise_cap(i - 1, " at this small force cap")
                reasons.append(f"one force step of axis {i} is {step:g} N, at most {finest:g} N is allowed{more}")
            if count > widest:
                mm = f"{1e3 * count:g} mm, at most {1e3 * widest:g} mm is allowed"
                reasons.append(f"one encoder count of axis {i} is {mm}")
            if strongest < cap * (1 - 1e-3):
                reasons.append(f"axis {i} can apply {strongest:g} N, the force limit is {cap:g} N")
        return reasons

    def configuration(self, info: Info, theta: int) -> Config:
        """Return the CONFIG for the device, within the limits of the host and of the device."""
        T_ns = info.period_ns
        ramp = max(1, min(0xFF, math.ceil(1000 * _RAMP_US / T_ns)))
        steps = [1e-6 * step for step in info.force_step]
        most = [int(cap / step + 1e-9) for cap, step in zip(self.cap, steps, strict=True)]
        slew = [min(0xFFFF, math.ceil(self.slew * 1e-9 * T_ns / step - 1e-6)) for step in steps]
        return Config(
            theta=theta,
            hold=max(0, min(_HOLD, MAX_RELEASE_NS // T_ns - ramp)),
            ramp=ramp,
            ramp_in=min(0xFFFF, math.ceil(1e9 * _RAMP_IN / T_ns)),
            cap=tuple(map(min, info.hard_limit, most)),
            slew=tuple(slew),
        )


def next_gain(gain: float, seconds: float) -> float:
    """Return the gain after `seconds` of its linear rise to 1, or, if negative, of its fall to 0.

    Any constant gain g within [0, 1] preserves a certificate: if this-environment holds for F, it holds for g F.
    """
    return min(1.0, gain + seconds / _RAMP_IN) if seconds > 0 else max(0.0, gain + seconds / _RAMP_OUT)


@lru_cache(maxsize=4096)
def largest_pulse(gaps: tuple[int, int, int], T: float, push: float, mode: float, speed: float) -> float:
    """Return the largest pulse [m] (`SafetyLimits.check_jolt`) of a real motion over `gaps` [ticks] of T [s] each.

    Mean speeds over p and q ticks differ by at most A (p + q)/2 under an acceleration up to A, here `push` [m/tick^2].
    A motor may also swing on its transmission with the amplitude `speed` v [m/s] at frequencies w [rad/s] up to `mode`.
    The mean speed over n ticks then is v sinc(n w T/2) times the phase of their middle. For a rigid device (its `mode`
    is infinite) A bounds all pulses: a swing of 0.25 kg with 0.5 m/s at 84 Hz would need 66 N.
    """
    p, q, r = gaps
    forced, swing = q * (min(p, r) + q) / 2 * push, 0.0
    if mode < math.inf:
        angle = np.linspace(0.0, min(mode * T, math.pi), 65)[1:] / 2  # w T/2
        first, middle, last = (np.sin(n * angle) / (n * angle) for n in gaps)
        turned = first * np.exp(-1j * (p + q) * angle) + last * np.exp(1j * (q + r) * angle)
        swing = float(q * T * speed * np.abs(middle - turned / 2).max())
    return max(forced, swing)


class Heat:
    """A thermal model (I2t) of every motor: a first-order lag with time constant tau of the squared force.

    Under a constant force F, the lag's output reaches F_continuous^2 after -tau ln(1 - (F_continuous / F)^2).
    """

    def __init__(self, limits: SafetyLimits, T: float) -> None:
        self._limits, self._T = limits, T
        self._squares = [0.0] * len(limits.continuous)  # [N^2]

    def check(self, force: Sequence[float], ticks: int) -> None:
        """Advance the model by `ticks` ticks of the force (m,) [N]. Raises SafetyStop where a motor gets too hot."""
        part = -math.expm1(-ticks * self._T / self._limits.thermal)
        for i, most in enumerate(self._limits.continuous):
            self._squares[i] += (force[i] ** 2 - self._squares[i]) * part
            if self._squares[i] > most**2:
                raise SafetyStop(
                    f"motor {i + 1} gets hot: {self._squares[i] ** 0.5:.3g} N rms, {most:g} N are allowed for long"
                )


# Units, and checks of the device and the line before anything moves


@dataclass(frozen=True)
class Units:
    """The conversion between integers on the wire and SI units. The wire carries the motors' force, -f."""

    encoder_step: tuple[float, ...]  # (m,) [m]
    force_step: tuple[float, ...]  # (m,) [N]
    range: tuple[int, ...]  # (m,) [counts] half the workspace, which is +-range

    @classmethod
    def of(cls, info: Info) -> Units:
        encoder = tuple(1e-12 * step for step in info.encoder_step)
        return cls(encoder, tuple(1e-6 * step for step in info.force_step), info.range)

    def positions(self, counts: Iterable[int]) -> tuple[float, ...]:
        """Return the displacements (m,) [m] for encoder counts (m,)."""
        return tuple([n * step for n, step in zip(counts, self.encoder_step, strict=True)])

    def forces(self, steps: tuple[int, ...]) -> tuple[float, ...]:
        """Return the forces fed back f (m,) [N] for the motors' forces (m,) [steps]."""
        return tuple(-n * step for n, step in zip(steps, self.force_step, strict=True))

    def steps(
        self, f: Sequence[float], cap: tuple[int, ...], vectors: Sequence[tuple[int, int]] = ()
    ) -> tuple[int, ...]:
        """Return the motors' forces (m,) [steps], at most `cap` (m,), for the forces fed back f (m,) [N].

        A vector that rounding would lengthen beyond its cap is rounded towards zero.
        """
        each = zip(f, self.force_step, cap, strict=True)
        steps = [max(-most, min(most, round(-force / step))) for force, step, most in each]
        for first, end in vectors:
            own = range(first, end)
            if math.hypot(*(steps[i] * self.force_step[i] for i in own)) > cap[first] * self.force_step[first]:
                steps[first:end] = [int(-f[i] / self.force_step[i]) for i in own]
        return tuple(steps)

    def check_range(self, counts: Sequence[int]) -> None:
        """Raise SafetyStop where encoder counts (m,) are outside of the device's workspace."""
        for i, (now, most) in enumerate(zip(counts, self.range, strict=True)):
            if not -most <= now <= most:
                mm = 1e3 * self.encoder_step[i]
                raise SafetyStop(f"encoder {i + 1} is at {mm * now:.4g} mm, its range is +-{mm * most:.4g} mm")


def _wire_time(baud: int, axes: int) -> tuple[float, str]:
    """Return the time [s] that one STATE and one FORCE take on the line, and its computation as text."""
    up, down = wire.wire_bytes(wire.State, axes), wire.wire_bytes(wire.Force, axes)
    seconds = (up + down) * _BITS_PER_BYTE / baud
    return seconds, f"({up} + {down}) bytes x {_BITS_PER_BYTE} bits / {baud} baud = {1e6 * seconds:.0f} us"


def probe_delay(T: float) -> int:
    """Return the delay theta [ticks] during the measurement.

    It is the largest delay, up to MAX_THETA, with which the margin of every answer fits into its field in STATE.

    Raises ValueError where T [s] is too long for theta = 1.
    """
    theta = min(MAX_THETA, int(_LARGEST_MARGIN_US / (1e6 * T)))
    if theta < 1:
        raise ValueError(f"T is {T:g} s, a serial link allows at most {1e-6 * _LARGEST_MARGIN_US:g} s")
    return theta


def watchdog_for(T: float) -> int:
    """Return the allowed silence [us] of a device that ticks every T [s]: five ticks, but at least 6 ms for busy hosts.

    Raises ValueError if that is more than MAX_RELEASE_NS, in which a device without new forces must release its force.
    """
    silence = max(6000, math.ceil(round(5e6 * T, 3)))
    if silence > MAX_RELEASE_NS // 1000:
        most = MAX_RELEASE_NS / 5e9
        raise ValueError(f"T is {T:g} s, a serial link allows at most {most:g} s: the host's watchdog is five ticks")
    return silence
