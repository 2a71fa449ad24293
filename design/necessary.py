"""Compute the necessary damping of devices with known motor and transmission (Theorem A), by a sweep, for design.audit.

A motor with linear dynamics (mass m, damping delta) is connected to the hand by a transmission: a spring k and a damper
b in parallel. The loop is stable for every passive hand under two conditions. First, it is stable if the hand's end of
the transmission is held. Second, no sampled response of motor and hand to a held force makes the loop singular. At each
frequency, the responses with all passive hands fill a disk. With one channel, or channels with equal devices, every
point of the disk's circle belongs to a lossless hand. The sweep uses the least mass, the least damping, the stiffest
spring and the least damper within the bounds. docs/theory.md has the proof; compare Fardad and Bamieh, IEEE
Transactions on Automatic Control 54 (2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Complex, Lti
from haptic_loop.design.frequency import frequencies, largest_eigenvalue, on_circle, supremum
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.design.result import Requirement, listed


def _alias_sums(w: Array, T: float, mass: float, damping: Array, k: float, b: float) -> tuple[Array, Complex]:
    """Return sig0 and sig2 (n,) [m/(N s)] at w (n,) [rad/sample] for motors of `damping` (n,) [N s/m].

    sig_i = |z - 1|^2 S_i/T^2 with S0 = sum 1/(w_n^2 c_n) and S2 = sum g_n conj(a_n)/(w_n^2 c_n), summed over the
    aliases w_n = (w + 2 pi n)/T. Here a_n = delta + j m w_n, g_n = b w_n^2/(k^2 + b^2 w_n^2) and c_n = delta + g_n
    |a_n|^2. The terms are rational in w_n. With W = w_n^2 the denominator of the terms of S2 is d = b m^2 W^2 + (delta
    b^2 + b delta^2) W + delta k^2, and that of the terms of S0 is W d. The sums of their partial fractions are
    cotangents.
    """
    high, middle, low = b * mass**2, damping * b * (b + damping), damping * k**2
    root: Complex = np.sqrt((middle**2 - 4 * high * low).astype(np.complex128))
    W1, W2 = (-middle - root) / (2 * high), (-middle + root) / (2 * high)
    W2 = np.where(np.abs(W2) < np.abs(W1), low / (high * W1), W2)  # This form of the smaller root avoids cancellation.

    def sums(W: Any) -> tuple[Any, Any]:
        """Return the sums of 1/(w_n^2 - W) and of w_n/(w_n^2 - W) over all aliases n."""
        y = np.sqrt(W) * T
        less, more = 1 / np.tan((w - y) / 2), 1 / np.tan((w + y) / 2)
        return T**2 / (4 * y) * (less - more), T / 4 * (less + more)

    (even1, odd1), (even2, odd2) = sums(W1), sums(W2)
    apart = high * (W1 - W2)
    numerator = [(k**2 + b**2 * W) / W for W in (W1, W2)]
    S0 = k**2 / low * T**2 / (4 * np.sin(w / 2) ** 2) + (numerator[0] * even1 - numerator[1] * even2) / apart
    S2 = b / apart * (damping * (even1 - even2) - 1j * mass * (odd1 - odd2))
    turn = 4 * np.sin(w / 2) ** 2 / T**2
    return turn * S0.real, turn * S2


class _Necessary(NamedTuple):
    """The least share of the damping for which Theorem A holds."""

    share: float
    w: float  # binding frequency [rad/sample]
    held: bool  # whether the loop is stable at this share if the hands' ends of the transmissions are held


_LOWEST = 1e-4  # [rad/sample] lowest frequency; at frequency 0 the disk touches the point that it must not contain
_SMALL, _LARGE = 1e-6, 1e3  # bounds of the search for the least share of the damping


def _necessary_share(F: Lti, loop: Loop) -> _Necessary:
    """Return the least share of the damping at which no passive hand makes the loop unstable, by a refined sweep.

    The motors' dynamics are assumed to be linear. For one channel or equal devices no condition for these devices
    requires less than this share. For other devices the share is sufficient, and close to the least sufficient share.
    """
    assert loop.known_devices
    known, T, m = loop.known_devices, loop.T, loop.channels

    def holds(w: Array, response: Complex, share: Array) -> Any:
        sums = [
            _alias_sums(w, T, d.motor_mass_min, share * delta, d.transmission_stiffness_max, d.transmission_damping_min)
            for d, delta in zip(known, loop.delta, strict=True)
        ]
        radius = np.stack([np.maximum(sig0, 1e-300) / 2 for sig0, _ in sums], axis=1)
        centre = radius + np.stack([sig2 for _, sig2 in sums], axis=1)
        root = np.sqrt(radius)
        z = on_circle(w)
        closed = (z - 1)[:, None, None] * np.eye(m) + T * centre[..., None] * response
        left, right = closed / root[..., None], T * root[..., None] * response
        adjoint = [np.conj(np.swapaxes(part, 1, 2)) for part in (left, right)]
        return -largest_eigenvalue(adjoint[1] @ right - adjoint[0] @ left) > 0

    def shares(w: Array) -> Array:
        response = F.at(on_circle(w))
        least, most = np.full(w.size, _SMALL), np.full(w.size, _LARGE)
        plenty = holds(w, response, most)
        for _ in range(52):  # bisections to 2e-16 of the interval's length
            middle = (least + most) / 2
            enough = holds(w, response, middle)
            least, most = np.where(enough, least, middle), np.where(enough, middle, most)
        return np.where(plenty, most, np.inf)

    share, w = supremum(shares, frequencies(F, low=_LOWEST))
    return _Necessary(share, w, bool(np.isfinite(share)) and _stable_with_held_ends(F, loop, share * (1 + 1e-6)))


@dataclass(frozen=True)
class LeftOver:
    """The damping at which Theorem A holds, and the damping that known-device requires.

    Attributes:
        required_damping: (m,) [N s/m] at which Theorem A holds, by a sweep. If `attained`, no condition for these
            devices requires less, so that no proof can improve on `known_device_damping` by more than the difference.
            If not `attained`, less damping may be enough.
        frequency_hz: The binding frequency.
        attained: Whether some lossless hand destabilises the loop at any smaller damping. This holds for one channel,
            and for channels with equal devices.
        known_device_damping: (m,) [N s/m] that known-device requires, by a sweep; None if it is infinite.
    """

    required_damping: tuple[float, ...]
    frequency_hz: float
    attained: bool
    known_device_damping: tuple[float, ...] | None

    @property
    def words(self) -> str:
        """The comparison as a sentence without its full stop."""
        devices, damping = "known devices with linear motors", listed(self.required_damping, 5)
        words = f"{devices} need {damping} N s/m (Theorem A): no proof for every passive hand can require less"
        if not self.attained:
            words = f"{devices} satisfy Theorem A at {damping} N s/m, by a sweep, and perhaps at less"
        if self.known_device_damping is None:
            return words
        return f"{words}; known-device requires {listed(self.known_device_damping, 5)} N s/m"


def left_over(loop: Loop, coupling: Coupling, proved: Requirement | None = None) -> LeftOver | None:
    """Return the damping at which Theorem A holds, or None if the theorem does not apply or holds at no damping.

    `proved` is the requirement of known-device, if the caller has it.
    """
    if KNOWN_DEVICE.beyond(loop) or loop.ranges or loop.levels or loop.T_max not in (None, loop.T):
        return None
    equal, walls = len(set(zip(loop.known_devices or (), loop.delta, strict=True))) == 1, bool(loop.environment.walls)
    if walls and not equal:
        # With walls Theorem A is necessary but not sufficient. For unequal devices it is sufficient but not necessary.
        # For unequal devices with walls it is neither necessary nor sufficient.
        return None
    try:
        maps = loop.law(coupling).frozen().values() if walls else [loop.F(coupling)]
    except SingularLoop:
        return None
    if not all(F.is_stable() for F in maps):
        return None
    each, proved = [_necessary_share(F, loop) for F in maps], proved or KNOWN_DEVICE.judge(loop, coupling)
    largest = max(each, key=lambda one: one.share)
    if not (all(one.held for one in each) and np.isfinite(largest.share)):
        return None
    needed = tuple(largest.share * d for d in loop.delta)
    required = proved.required if np.isfinite(proved.ratio) else None
    return LeftOver(needed, largest.w / (2 * np.pi * loop.T), equal, required)


def _stable_with_held_ends(F: Lti, loop: Loop, share: float) -> bool:
    """Return whether the loop is stable at `share` of the damping if the hand's end of every transmission is held."""
    import scipy

    m, known = loop.channels, loop.known_devices or ()
    generator = np.zeros((3 * m, 3 * m))
    for i, (device, delta) in enumerate(zip(known, loop.delta, strict=True)):
        mass, k, b = device.motor_mass_min, device.transmission_stiffness_max, device.transmission_damping_min
        generator[i, m + i] = 1
        generator[m + i, [i, m + i, 2 * m + i]] = -k / mass, -(share * delta + b) / mass, -1 / mass
    step = scipy.linalg.expm(generator * loop.T)[: 2 * m]
    A, B = step[:, : 2 * m], step[:, 2 * m :]
    C = np.eye(m, 2 * m)
    closed = np.block([[A + B @ F.D @ C, B @ F.C], [F.B @ C, F.A]])
    return bool(np.abs(np.linalg.eigvals(closed)).max() < 1)
