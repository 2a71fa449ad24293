"""The damping that delays switching within [lo, hi] ask: the condition of design.jitter.condition with the best alpha.

With a = alpha T/delta the least factor s on delta is the supremum over frequency of an eigenvalue that is convex in a:
at every frequency and direction u it is at least u*(..)u, a sum n + p.a + q.(1/a), and that bounds s from below for
all a. The worst of these bounds are collected until their least a attains them. No convex solver is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from controller.lti import Array, Lti
from design.frequency.sweep import frequencies, hermitian, on_circle, supremum
from design.jitter.condition import Complex, half_widths, nominal
from design.margin import Requirement, closed_loop, dampings, from_ratio, refusal

SETTLED = 1e-7  # relative gap between the sweep of a multiplier and the bound that no multiplier beats
MOST_ROUNDS = 60
FIRST = 0.1  # the a that a search begins with
SMALLEST, LARGEST = 1e-8, 1e6  # .. and what it may become
NEAR, MOST_PEAKS = 0.3, 8  # of the peaks within 30 % of the highest, so many give a bound


@dataclass(frozen=True)
class JitterProof:
    """What switching within a range asks of the devices."""

    requirement: Requirement  # condition "jitter-proof"
    alpha: tuple[float, ...]  # (m,) [N/m] the multiplier that shows it, at the available damping; 0 where lo = hi
    bound: float  # no multiplier shows less than this times the available damping (on the frequencies looked at)


def jitter_proof(
    G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float], alpha: Sequence[float] | None = None
) -> JitterProof:
    """The least common factor on `delta` [N s/m] with which some multiplier satisfies the condition, and which does.

    G is the force map without Theta. The factor is that of the refined sweep (design.frequency.sweep) at the multiplier
    found, or at `alpha` (m,) [N/m] where it is given, positive where lo < hi; `bound` is then that factor.
    """
    available, h = dampings(delta, G.inputs), half_widths(lo, hi)
    if len(h) != G.inputs:
        raise ValueError(f"delays are given for {len(h)} channels, expected {G.inputs}")
    constant = closed_loop(nominal(lo, hi, G.T) @ G, delta)
    if not np.isfinite(constant.ratio):
        return jitter_refusal(available, constant.reason or "no constant delay is safe")
    search, unit = _Search(G, lo, hi, np.asarray(available)), np.asarray(available) / G.T
    given = None if alpha is None else (np.asarray(alpha) / unit)[search.active]
    a, ratio, w, bound = search.least() if given is None else search.only(given)
    multiplier = np.zeros(h.size)
    multiplier[search.active] = a
    requirement = from_ratio("jitter-proof", max(ratio, 0.0), available, w / (2 * np.pi * G.T))
    return JitterProof(requirement, tuple((multiplier * unit).tolist()), bound)


def jitter_refusal(available: tuple[float, ...], reason: str) -> JitterProof:
    """That no damping is enough, and why."""
    return JitterProof(refusal("jitter-proof", available, reason), (np.inf,) * len(available), np.inf)


Found = tuple[Array, float, float, float]  # a, s(a), where it binds [rad/sample], a lower bound on s over all a


class _Search:
    """s(a) = sup over w of the largest eigenvalue of N + diag(a)/2 + Y* diag(1/2a) Y, over the channels that vary.

    N = W (F(1)/2 - He[(F - F(1))/(z-1)]) W with F = Theta_nom G, Y = h W G W, W = diag(sqrt(T/delta)).
    """

    def __init__(self, G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Array) -> None:
        F = nominal(lo, hi, G.T) @ G
        self._G, self._F1, self._regular = G, F.dc(), F.quotient_at_one()
        self._weight, self._h = np.sqrt(G.T / delta), half_widths(lo, hi)
        self.active = np.flatnonzero(self._h)
        self._grid = np.concatenate([[0.0], frequencies(G)])
        none = np.zeros((0, self.active.size))
        self._n, self._p, self._q = np.zeros(0), none, none  # the bounds collected

    def only(self, a: Array) -> Found:
        """s at this a."""
        ratio, w = self._swept(a)
        return a, ratio, w, ratio

    def least(self) -> Found:
        """The least s over all a."""
        a, bound = np.full(self.active.size, FIRST), -np.inf
        if not a.size:
            return self.only(a)
        N, Y = self._parts(self._grid)
        best: tuple[Array, float, float] = (a, np.inf, 0.0)
        for _ in range(MOST_ROUNDS):
            if self._cut(a, N, Y) <= bound + SETTLED * abs(bound):  # settled on the samples: look between them
                ratio, w = self._swept(a)
                best = min(best, (a, ratio, w), key=lambda found: found[1])
                if best[1] <= bound + 10 * SETTLED * abs(bound):
                    return *best, bound
                between = self._parts(np.array([w]))
                N, Y = np.concatenate([N, between[0]]), np.concatenate([Y, between[1]])
                self._cut(a, *between)
            a, bound = self._bound(a)
        return *min(best, (a, *self._swept(a)), key=lambda found: found[1]), bound

    def _swept(self, a: Array) -> tuple[float, float]:
        """(s(a), w) by a sweep that is refined between its samples."""
        return supremum(lambda w: self._largest(a, *self._parts(w)), self._grid)

    def _parts(self, w: Array) -> tuple[Complex, Complex]:
        """N (k, m, m) and the rows of Y with h > 0, at the frequencies w (k,) [rad/sample]."""
        z, W = on_circle(w), self._weight
        N = W[:, None] * (self._F1 / 2 - hermitian(self._regular.at(z))) * W
        Y = (self._h * W)[:, None] * self._G.at(z) * W
        return N, Y[:, self.active]

    def _matrices(self, a: Array, N: Complex, Y: Complex) -> Complex:
        """N + diag(a)/2 + Y* diag(1/2a) Y, (k, m, m)."""
        diagonal = np.zeros(self._h.size)
        diagonal[self.active] = a / 2
        return N + np.diag(diagonal) + np.conj(np.swapaxes(Y, 1, 2)) @ (Y / (2 * a[:, None]))

    def _largest(self, a: Array, N: Complex, Y: Complex) -> Array:
        return np.linalg.eigvalsh(self._matrices(a, N, Y))[:, -1].astype(float)

    def _cut(self, a: Array, N: Complex, Y: Complex) -> float:
        """Collect the bounds at the local peaks near the worst sampled frequency; the worst value."""
        values = self._largest(a, N, Y)
        top, padded = float(values.max()), np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= top - NEAR * abs(top)))
        peaks = peaks[np.argsort(values[peaks])[-MOST_PEAKS:]]
        u = np.linalg.eigh(self._matrices(a, N[peaks], Y[peaks]))[1][:, :, -1]
        self._n = np.append(self._n, np.einsum("ki,kij,kj->k", u.conj(), N[peaks], u).real)
        self._p = np.concatenate([self._p, np.abs(u[:, self.active]) ** 2 / 2])
        self._q = np.concatenate([self._q, np.abs(np.einsum("kij,kj->ki", Y[peaks], u)) ** 2 / 2])
        return top

    def _bound(self, a: Array) -> tuple[Array, float]:
        """(a, value): the least maximum over a of the bounds n + p.a + q.(1/a), convex in log a."""

        def below(x: Array) -> Array:
            return x[0] - self._n - self._p @ np.exp(x[1:]) - self._q @ np.exp(-x[1:])

        def slope(x: Array) -> Array:
            return np.column_stack([np.ones(self._n.size), -self._p * np.exp(x[1:]) + self._q * np.exp(-x[1:])])

        start = np.concatenate([[0.0], np.log(a)])
        start[0] = -below(start).min()
        limits = [(None, None)] + [(np.log(SMALLEST), np.log(LARGEST))] * a.size
        gradient = np.eye(1 + a.size)[0]
        found = minimize(
            lambda x: x[0],
            start,
            jac=lambda x: gradient,
            bounds=limits,
            method="SLSQP",
            constraints={"type": "ineq", "fun": below, "jac": slope},
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.exp(found.x[1:]), float(found.x[0])
