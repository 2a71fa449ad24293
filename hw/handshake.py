"""Is this the device that the scenario is about, and can the line carry it? Asked before anything moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from hw.frame import Config, Force, Info, State, wire_bytes
from hw.message import MAX_RELEASE_NS, MAX_THETA, PROTOCOL
from hw.safety import Limits
from sim.scenario import Scenario

BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit
LARGEST_MARGIN_US = 30_000  # an age is read from a margin, which is an i16 in microseconds
HOLD, RAMP_US = 4, 5000  # what the device does without answers: ticks held, then microseconds to zero


@dataclass(frozen=True, eq=False)
class Units:
    """Integers of the wire to SI units and back. The wire carries what the motor does, -f."""

    encoder_step: Array  # (m,) [m]
    force_step: Array  # (m,) [N]
    reach: Array  # (m,) [m]

    @classmethod
    def of(cls, info: Info) -> Units:
        encoder = 1e-12 * np.array(info.encoder_step, dtype=float)
        return cls(encoder, 1e-6 * np.array(info.force_step, dtype=float), encoder * np.array(info.range))

    def positions(self, counts: tuple[int, ...]) -> Array:
        """Displacements (m,) [m]."""
        return np.array(counts) * self.encoder_step

    def forces(self, steps: tuple[int, ...]) -> Array:
        """Forces fed back f (m,) [N], from what the motors do."""
        return -np.array(steps) * self.force_step

    def steps(self, f: Array, cap: tuple[int, ...]) -> tuple[int, ...]:
        """What the motors are to do for the forces fed back f (m,) [N]: whole steps, at most `cap`."""
        return tuple(max(-c, min(c, round(n))) for n, c in zip((-f / self.force_step).tolist(), cap, strict=True))


def wire_time(baud: int, axes: int) -> tuple[float, str]:
    """Seconds for one STATE and one FORCE, and the arithmetic as text."""
    up, down = wire_bytes(State, axes), wire_bytes(Force, axes)
    seconds = (up + down) * BITS_PER_BYTE / baud
    return seconds, f"({up} + {down}) bytes x {BITS_PER_BYTE} bits / {baud} baud = {1e6 * seconds:.0f} us"


def objections(info: Info, scenario: Scenario, limits: Limits, baud: int | None) -> list[str]:
    """Why this device may not run this scenario over this line; empty where nothing is wrong. baud None: no UART."""
    if info.version != PROTOCOL:
        return [f"the device speaks version {info.version} of the protocol, this host version {PROTOCOL}"]
    m = scenario.channels
    if info.axes != m:
        return [f"the device has {info.axes} ax{'i' if info.axes == 1 else 'e'}s, the scenario {m} channels"]
    reasons = []
    period_ns = round(1e9 * scenario.T)
    if info.period_ns != period_ns:
        reasons.append(f"the device ticks every {info.period_ns} ns, the scenario's T is {period_ns} ns")
    if baud is not None:
        seconds, arithmetic = wire_time(baud, m)
        if seconds > scenario.T:
            reasons.append(f"one STATE and one FORCE take {arithmetic}, more than T = {1e6 * scenario.T:g} us")
    for i in range(m):
        damping, strongest = 1e-6 * info.osp_damping[i], 1e-6 * info.hard_limit[i] * info.force_step[i]
        if damping < scenario.delta[i] * (1 - 1e-6):
            reasons.append(
                f"axis {i + 1} guarantees {damping:g} N s/m, the certificate needs delta = {scenario.delta[i]:g}"
            )
        if strongest < limits.cap[i] * (1 - 1e-3):
            reasons.append(f"axis {i + 1} can do {strongest:g} N, the force limit is {limits.cap[i]:g} N")
    return reasons


def probe_delay(T: float) -> int:
    """The theta to measure with: the longest whose margin can be told. Raises ValueError where T is too long."""
    theta = min(MAX_THETA, int(LARGEST_MARGIN_US / (1e6 * T)))
    if theta < 1:
        raise ValueError(f"T is {T:g} s, a serial link is for at most {1e-6 * LARGEST_MARGIN_US:g} s")
    return theta


def configuration(info: Info, limits: Limits, theta: int) -> Config:
    """What the device is told: never more than the host allows itself, nor than the device can do."""
    T_ns = info.period_ns
    hold = min(HOLD, (MAX_RELEASE_NS - 1000 * RAMP_US) // T_ns)
    step = 1e-6 * np.array(info.force_step, dtype=float)
    cap = np.minimum(np.floor(np.array(limits.cap) / step + 1e-9), info.hard_limit).astype(int)
    slew = np.clip(np.ceil(limits.slew * 1e-9 * T_ns / step), 1, 0xFFFF).astype(int)
    return Config(
        theta=theta,
        hold=max(0, hold),
        ramp=max(1, min(0xFF, math.ceil(1000 * RAMP_US / T_ns))),
        ramp_in=min(0xFFFF, math.ceil(1e9 * limits.ramp_in / T_ns)),
        cap=tuple(int(n) for n in cap),
        slew=tuple(int(n) for n in slew),
    )
