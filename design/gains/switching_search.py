"""Spring-damper gains that are safe under any switching of their delays: a local search as in frozen_environment.py.

Its sampled condition is that of design.jitter.condition: the multiplier is searched together with the gains. What is
returned passes that module's own sweep, which knows nothing of the multiplier found here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.optimize import OptimizeResult

from controller.coupling import SpringDamper
from controller.lti import Array
from controller.process import force_map
from design.frequency.sweep import hermitian, on_circle
from design.gains.frozen_environment import MOST_ROUNDS, SAMPLED_RESERVE, STUCK, Sampled, least_rms
from design.jitter.condition import half_widths, nominal_over_step
from design.jitter.multiplier import jitter_proof
from design.semidefinite.sampled import Complex
from design.specification import RESERVE, Specification

FIRST = 0.5  # the multiplier alpha T/delta that a search begins with where the start has none
MULTIPLIERS = (1e-4, 10.0)  # ... and its bounds


class SwitchingSampled(Sampled):
    """As Sampled, with x = (log K, B/delta, log alpha T/delta of the channels whose delay varies)."""

    def __init__(self, spec: Specification, lo: Sequence[int], hi: Sequence[int]) -> None:
        self.range, self.h = (lo, hi), half_widths(lo, hi)
        self.active = np.flatnonzero(self.h)
        super().__init__(spec)

    def coupling(self, x: Array) -> SpringDamper:
        return super().coupling(self._gains(x))

    def point(self, coupling: SpringDamper) -> Array:
        """The gains with their best multiplier."""
        spec = self.spec
        found = jitter_proof(
            force_map(spec.environment, coupling, (0,) * spec.channels, spec.psi), *self.range, spec.delta
        )
        a = np.array(found.alpha)[self.active] * spec.T / np.array(spec.delta)[self.active]
        a = np.clip(np.where(np.isfinite(a), a, FIRST), *MULTIPLIERS)
        return np.concatenate([super().point(coupling), np.log(a)])

    def force(self, x: Array, loop: tuple[Complex, Complex, Complex]) -> Complex:
        return super().force(self._gains(x), loop)

    def room(self, x: Array) -> Array:
        """1 - SAMPLED_RESERVE less the damping ratio at each sampled frequency, with the multiplier in x."""
        a = np.exp(x[2 * self.spec.channels :])
        D, E, _ = self.loop_at_conditions
        now = np.broadcast_to(np.eye(self.spec.channels, dtype=complex), E.shape)
        G = self.root[:, None] * self.force(x, (D, E, now)) * self.root
        nominal = nominal_over_step(on_circle(self.conditions), *self.range)[:, :, None] * G
        error = (self.h[:, None] * G)[:, self.active]
        diagonal = np.zeros(self.h.size)
        diagonal[self.active] = a / 2
        need = np.diag(diagonal) - hermitian(nominal) + np.conj(np.swapaxes(error, 1, 2)) @ (error / (2 * a[:, None]))
        room = (1 - SAMPLED_RESERVE - np.linalg.eigvalsh(need)[:, -1]).astype(float)
        return np.append(room, self.stability(x)) if any(self.spec.psi) else room

    def search(self, x: Array) -> OptimizeResult:
        return self.minimised(x, [(np.log(MULTIPLIERS[0]), np.log(MULTIPLIERS[1]))] * self.active.size)

    def _gains(self, x: Array) -> Array:
        return x[: 2 * self.spec.channels]


def least_rms_switching(
    spec: Specification, lo: Sequence[int], hi: Sequence[int], starts: Iterable[SpringDamper]
) -> tuple[SpringDamper | None, float, int]:
    """(gains, rms mismatch as a ratio, searches) of the best local optimum that is safe under any switching."""
    return least_rms(spec, starts, lambda start: _safe_optimum(SwitchingSampled(spec, lo, hi), start))


def _safe_optimum(sampled: SwitchingSampled, start: SpringDamper) -> tuple[SpringDamper | None, int]:
    """(a local optimum that passes the refined sweep or None, searches)."""
    spec, x = sampled.spec, sampled.point(start)
    for searches in range(1, MOST_ROUNDS + 1):
        x = sampled.search(x).x
        coupling = sampled.coupling(x)
        G = force_map(spec.environment, coupling, (0,) * spec.channels, spec.psi)
        requirement = jitter_proof(G, *sampled.range, spec.delta).requirement
        if requirement.ratio <= 1 - RESERVE:
            return coupling, searches
        if sampled.room(x).min() < -STUCK or requirement.frequency_hz is None:
            return None, searches
        sampled.add(max(2 * np.pi * spec.T * requirement.frequency_hz, 1e-6))
    return None, MOST_ROUNDS
