"""Spring-damper gains under the closed-loop condition, for one environment: a local search from several starts.

The set is not convex in (K, B), so nothing here is proved best. The rms mismatch is minimised by sequential
quadratic programming with the condition at sampled frequencies; where the refined sweep of design.margin finds it
violated in between, that frequency is added and the search resumed. What is returned passes that sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from controller.coupling import SpringDamper
from controller.delay import delay
from controller.lti import Array
from controller.process import force_map
from design.frequency.sweep import frequencies, hermitian, on_circle
from design.margin import closed_loop
from design.semidefinite.sampled import Complex
from design.specification import RESERVE, Specification
from design.transparency import BAND_HZ, transparency

#: The sampled condition keeps half as much again as the promised reserve, for what lies between the samples.
SAMPLED_RESERVE = 1.5 * RESERVE
SOFTEST, STIFFEST = 1.0, 1e6  # [N/m], bounds of the search
CLOSEST_POLE = 1e-5  # from the unit circle
STUCK = 1e-3  # a search that leaves the sampled condition violated by this has no feasible point nearby
MOST_ROUNDS = 8


class Sampled:
    """Mismatch and condition at fixed frequencies, as smooth functions of x = (log K, B/delta), shape (2N,)."""

    def __init__(self, spec: Specification) -> None:
        self.spec = spec
        per_hz = 2 * np.pi * spec.T
        low, high = (per_hz * f for f in BAND_HZ)
        self.band = frequencies(spec.environment, low=low, high=min(high, np.pi), points=80)
        self.conditions = frequencies(spec.environment, low=1e-3, points=80)
        self.loop_in_band, self.loop_at_conditions = self._loop(self.band), self._loop(self.conditions)
        E = spec.environment.at(on_circle(self.band))
        self.size2 = (np.abs(E) ** 2).sum(axis=(1, 2))
        self.target = delay(spec.lam, spec.T).at(on_circle(self.band)) @ E
        self.root = np.sqrt(spec.T / np.asarray(spec.delta))

    def coupling(self, x: Array) -> SpringDamper:
        log_k, b = np.split(x, 2)
        return SpringDamper(np.exp(log_k), np.maximum(b, 0.0) * self.spec.delta)

    def point(self, coupling: SpringDamper) -> Array:
        return np.concatenate([np.log(coupling.K), coupling.B / self.spec.delta])

    def add(self, w: float) -> None:
        """Impose the condition at the frequency w [rad/sample] too."""
        self.conditions = np.append(self.conditions, w)
        self.loop_at_conditions = self._loop(self.conditions)

    def _loop(self, w: Array) -> tuple[Complex, Complex, Complex]:
        """(z-1)/(Tz), Psi E and Theta at exp(jw)."""
        spec, z = self.spec, on_circle(w)
        return (z - 1) / (spec.T * z), spec.delayed_environment.at(z), delay(spec.theta, spec.T).at(z)

    def force(self, x: Array, loop: tuple[Complex, Complex, Complex]) -> Complex:
        """F = Theta G (G + Psi E)^-1 Psi E with G = V^-1, (k, N, N)."""
        D, E, theta = loop
        log_k, b = np.split(x, 2)
        G = (np.exp(log_k) + D[:, None] * (b * self.spec.delta))[:, :, None] * np.eye(self.spec.channels)
        return theta @ G @ np.linalg.solve(G + E, E)

    def square_mismatch(self, x: Array) -> float:
        """Logarithm of the mean over log frequency of ||M||_F^2 / ||E||_F^2."""
        M = self.force(x, self.loop_in_band) - self.target
        ratio = (np.abs(M) ** 2).sum(axis=(1, 2)) / self.size2
        log_w = np.log(self.band)
        return float(np.log(np.trapezoid(ratio, log_w) / (log_w[-1] - log_w[0])))

    def room(self, x: Array) -> Array:
        """1 - SAMPLED_RESERVE less the damping ratio that each sampled frequency asks for; (k,), or (k + 1,).

        Delay in the environment can make the loop unstable where the sampled condition still holds, so there the
        distance of its poles from the circle is the last entry.
        """
        ratio = self.force(x, self.loop_at_conditions) / (on_circle(self.conditions) - 1)[:, None, None]
        need = -hermitian(self.root[:, None] * ratio * self.root)
        room = 1 - SAMPLED_RESERVE - np.linalg.eigvalsh(need)[:, -1]
        return np.append(room, self.stability(x)) if any(self.spec.psi) else room

    def stability(self, x: Array) -> float:
        """By how much more than CLOSEST_POLE the poles keep away from the circle."""
        F = force_map(self.spec.environment, self.coupling(x), self.spec.theta, self.spec.psi)
        return float(1 - CLOSEST_POLE - np.abs(F.poles()).max(initial=0.0))

    def search(self, x: Array) -> OptimizeResult:
        return self.minimised(x, [])

    def minimised(self, x: Array, more: list[tuple[float, float]]) -> OptimizeResult:
        """The local optimum from x; `more` bounds the unknowns behind the gains."""
        N = self.spec.channels
        bounds = [(np.log(SOFTEST), np.log(STIFFEST))] * N + [(0.0, 20.0)] * N + more
        condition = {"type": "ineq", "fun": self.room}
        options = {"maxiter": 100, "ftol": 1e-7}
        return minimize(self.square_mismatch, x, method="SLSQP", bounds=bounds, constraints=condition, options=options)


Optimum = Callable[[SpringDamper], tuple[SpringDamper | None, int]]  # start -> (gains or None, searches)


def least_rms(
    spec: Specification, starts: Iterable[SpringDamper], optimum: Optimum | None = None
) -> tuple[SpringDamper | None, float, int]:
    """(gains, rms mismatch as a ratio, searches) of the best local optimum; gains None if none was found.

    `optimum` searches from one start; the default finds what closed-loop certifies.
    """
    optimum = optimum or partial(_certified_optimum, spec)
    best, least, searches = None, np.inf, 0
    for start in starts:
        coupling, runs = optimum(start)
        searches += runs
        if coupling is None:
            continue
        F = force_map(spec.environment, coupling, spec.theta, spec.psi)
        rms = transparency(F, spec.environment, spec.lam).rms_mismatch
        if rms < least:
            best, least = coupling, rms
    return best, least, searches


def _certified_optimum(spec: Specification, start: SpringDamper) -> tuple[SpringDamper | None, int]:
    """(a local optimum that passes the refined sweep or None, searches), adding the frequencies where one fails."""
    sampled = Sampled(spec)
    x = sampled.point(start)
    for searches in range(1, MOST_ROUNDS + 1):
        x = sampled.search(x).x
        coupling = sampled.coupling(x)
        requirement = closed_loop(force_map(spec.environment, coupling, spec.theta, spec.psi), spec.delta)
        if requirement.ratio <= 1 - RESERVE:
            return coupling, searches
        stuck = sampled.room(x).min() < -STUCK
        if stuck or requirement.frequency_hz is None:  # None: unstable, so there is no frequency to add
            return None, searches
        binding = 2 * np.pi * spec.T * requirement.frequency_hz
        sampled.add(max(binding, 1e-6))
    return None, MOST_ROUNDS
