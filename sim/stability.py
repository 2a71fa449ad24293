"""Is the loop stable? From the eigenvalues of the exact linear loop, and from a simulated trace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig

from controller.lti import Array, Lti
from sim.exact_engine import HeldPlant
from sim.loop import Record

Complex = NDArray[np.complex128]

#: growth rates up to this [1/s] count as stable: eigenvalues at 1 (a free loop that drifts) come out at 1e-12
MARGINAL = 1e-9
SHORTEST_TRACE = 200  # ticks below which a growth rate is not read from a trace


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """xi+ = A xi + B w with xi = [plant state s; process state z] and w the outside forces.

    Many loops at once have a leading axis in A and B.
    """

    A: Array  # (..., n, n)
    B: Array  # (..., n, outside)
    T: float


@dataclass(frozen=True, eq=False)
class Mode:
    """One eigenvalue of a closed loop, with its left eigenvector."""

    eigenvalue: complex
    left: NDArray[np.complex128]  # (n,), left* A = eigenvalue left*
    T: float

    @property
    def spectral_radius(self) -> float:
        return abs(self.eigenvalue)

    @property
    def growth(self) -> float:
        """[1/s]"""
        return growth_rate(self.eigenvalue, self.T)

    @property
    def frequency_hz(self) -> float:
        return abs(float(np.angle(self.eigenvalue))) / (2 * np.pi * self.T)

    @property
    def verdict(self) -> str:
        return verdict(self.growth)


def close(plant: HeldPlant, F: Lti) -> ClosedLoop:
    """The plant's held input f and the force map F joined: f = C z + D x, z+ = A z + B x, x = C s."""
    *many, states, inputs = plant.B.shape
    outside, n = inputs - F.outputs, states + F.order
    force = plant.B[..., outside:]
    A, B = np.zeros((*many, n, n)), np.zeros((*many, n, outside))
    A[..., :states, :states], A[..., :states, states:] = plant.A + force @ F.D @ plant.C, force @ F.C
    A[..., states:, :states], A[..., states:, states:] = F.B @ plant.C, F.A
    B[..., :states, :] = plant.B[..., :outside]
    return ClosedLoop(A, B, plant.T)


def dominant_mode(loop: ClosedLoop) -> Mode:
    """The mode of the largest modulus: its growth decides."""
    values, left = cast("tuple[Complex, Complex]", eig(loop.A, left=True)[:2])  # how many it returns is an option of it
    k = int(np.argmax(np.abs(values)))
    return Mode(complex(values[k]), left[:, k], loop.T)


def measured_growth(
    loop: ClosedLoop, mode: Mode, record: Record, force_limit: Array
) -> tuple[float | None, str | None]:
    """The growth rate [1/s] of `mode` in a trace, or None with the reason.

    The trace is projected on the left eigenvector, y = left* xi, which no other mode of the exact loop touches.
    With the known outside force subtracted, y[k+1] - left* B w[k] = lambda y[k]; lambda is the least-squares
    fit over the ticks before the first clipped one.
    """
    clipped = clipped_ticks(record, force_limit)
    usable = int(np.argmax(clipped)) if clipped.any() else clipped.size - 1
    if usable < SHORTEST_TRACE:
        which = "ticks before the first clipped one" if clipped.any() else "ticks"
        return None, f"only {max(usable, 0)} {which}; a growth rate needs {SHORTEST_TRACE}"
    xi = np.concatenate([record.s[: usable + 1, :, 0], record.z[: usable + 1, :, 0]], axis=1)
    y = xi @ mode.left.conj()
    pushed = record.w[:usable, :, 0] @ (loop.B.T @ mode.left.conj())
    weight = float(np.vdot(y[:-1], y[:-1]).real)
    if weight == 0:
        return None, "nothing excites the mode"
    return growth_rate(complex(np.vdot(y[:-1], y[1:] - pushed)) / weight, loop.T), None


def clipped_ticks(record: Record, force_limit: Array) -> NDArray[np.bool_]:
    """(N,) whether any force was at its limit at a tick."""
    return np.any(np.abs(record.f) >= force_limit[:, None], axis=(1, 2))


def before_clipping(record: Record, force_limit: Array) -> int:
    """Ticks before the first clipped one; all of them where there is none."""
    clipped = clipped_ticks(record, force_limit)
    return int(np.argmax(clipped)) if clipped.any() else clipped.size


def growth_rate(eigenvalue: complex, T: float) -> float:
    """log|lambda| / T [1/s]."""
    modulus = abs(eigenvalue)
    return float(np.log(modulus) / T) if modulus > 0 else -np.inf


def verdict(growth: float) -> str:
    return "stable" if growth <= MARGINAL else "unstable"
