"""How much device damping a coupling needs, by both conditions, without a solver.

closed-loop: with F what the devices see and every human passive, the loop is stable if
    He[F(z)/(z-1)] > -Delta_D / T   on |z| = 1,   F stable, F(1) symmetric positive semidefinite.
theorem4: Lemma 4 of the paper for Psi = I and any passive environment under backward Euler:
    He[(z-1) V/(Tz)] >= diag((1 - cos n_i w) / (2 delta_i)),   n_i = theta_i + 1.

The required damping is s Delta_D with the least s for which s Delta_D satisfies the condition: the supremum
of design.condition.demand over frequency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from controller.lti import Lti
from design.condition.demand import closed_loop_demand, theorem4_demand
from design.frequency.sweep import frequencies, supremum

C = TypeVar("C", bound=str)  # the name of a condition: design.store.Condition, or that of design.jitter.condition


@dataclass(frozen=True)
class Requirement(Generic[C]):
    """The damping that a condition asks of the devices, against what they have."""

    condition: C
    required: tuple[float, ...]  # (m,) [N s/m]; inf when no damping helps
    available: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: float | None  # where it binds
    reason: str | None = None  # why the figure is infinite
    proof: str = "sampled"

    @property
    def ratio(self) -> float:
        """s: required / available on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return self.ratio < 1


def closed_loop(F: Lti, delta: Sequence[float]) -> Requirement:
    """The closed-loop condition for the force map F and device dampings `delta` [N s/m]."""
    available = dampings(delta, F.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("closed-loop", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    F1 = F.dc()
    # rounding in F(1) is relative to what F is elsewhere: a free mass has F(1) = 0 out of large numbers
    scale = max(float(np.abs(F1).max()), float(np.abs(F.D).max()), float(np.abs(F.at(-1.0)).max()), 1e-12)
    if np.abs(F1 - F1.T).max() > 1e-9 * scale:
        return refused("the static stiffness F(1) is not symmetric: a slow closed path could extract energy")
    if np.linalg.eigvalsh((F1 + F1.T) / 2).min() < -1e-9 * scale:
        return refused("the static stiffness F(1) has a negative direction: it pushes outwards")

    grid = np.concatenate([[0.0], frequencies(F)])
    ratio, w = supremum(closed_loop_demand(F, available), grid)
    return from_ratio("closed-loop", max(ratio, 0.0), available, w / (2 * np.pi * F.T))


def theorem4(V: Lti, theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """Theorem 4 for psi = 0 and the coupling V, whatever passive environment stands behind it.

    Divided by |1 - 1/z|^2 it is regular, and s is a generalised eigenvalue per frequency.
    """
    available = dampings(delta, V.inputs)
    if len(theta) != V.inputs:
        raise ValueError(f"theta has {len(theta)} entries for {V.inputs} channels")

    def refused(reason: str) -> Requirement:
        return refusal("theorem4", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    V1 = V.dc()
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    demand = theorem4_demand(V, theta, available)
    ratio, w = supremum(demand, np.concatenate([[0.0], frequencies(V)]))
    if np.isinf(ratio):
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz: its damping vanishes there")
    return from_ratio("theorem4", ratio, available, w / (2 * np.pi * V.T))


def theorem4_per_channel(V: Sequence[Lti], theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """Theorem 4 for a diagonal coupling, given its channels: each device's own figure."""
    each = [theorem4(v, [n], [d]) for v, n, d in zip(V, theta, delta, strict=True)]
    worst = max(each, key=lambda r: r.ratio)
    required = tuple(r.required[0] for r in each)
    available = tuple(r.available[0] for r in each)
    return Requirement("theorem4", required, available, worst.frequency_hz, worst.reason)


def from_ratio(condition: C, ratio: float, available: tuple[float, ...], frequency_hz: float) -> Requirement[C]:
    """The requirement of `ratio` times what is available, on every channel."""
    return Requirement(condition, tuple(ratio * delta for delta in available), available, frequency_hz)


def refusal(condition: C, available: tuple[float, ...], reason: str) -> Requirement[C]:
    """The requirement that no damping satisfies."""
    return Requirement(condition, (np.inf,) * len(available), available, None, reason)


def dampings(delta: Sequence[float], channels: int) -> tuple[float, ...]:
    """`delta` as floats, one positive damping per channel [N s/m]."""
    values = tuple(float(d) for d in delta)
    if len(values) != channels:
        raise ValueError(f"delta has {len(values)} entries for {channels} channels")
    if not all(0 <= d < np.inf for d in values):
        raise ValueError(f"delta is {list(values)}, expected dampings >= 0 in N s/m")
    return values
