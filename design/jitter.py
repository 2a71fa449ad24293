"""Delays that vary: the damping with which no switching of the forces' delays within [lo, hi] is dangerous.

Let G = (I + Psi E V)^-1 Psi E be the forces as they leave, g = G x, and let the device hold of channel i the force
g_i[k - n] with an age n in [lo_i, hi_i] that may change at every tick. Beside the nominal
Theta_nom = (z^-lo + z^-hi)/2 the error w[k] = g[k-n] - (g[k-lo] + g[k-hi])/2 is half of a sum of hi - lo steps
g[j] - g[j-1], each with a sign, so by Cauchy's inequality, for every number of ticks,
    sum |w_i|^2 <= h_i^2 sum |g_i[k] - g_i[k-1]|^2,   h_i = (hi_i - lo_i)/2.
The steps of g are G dx, one tick later. With -w_i dx_i <= alpha_i |dx_i|^2 / 2 + |w_i|^2 / (2 alpha_i) the energy
argument of the closed-loop condition (design.margin) goes through if on |z| = 1, for one alpha > 0,
    [ He(Theta_nom G/(z-1)) + Delta_D/T - diag(alpha)/2    (h G)*        ]
    [ h G                                                   2 diag(alpha) ]  >  0,
G stable, G(1) symmetric positive semidefinite. It is jointly affine in (G, alpha), and alpha may not depend on the
frequency, since w is not a filtered g. For hi - lo = 1 nothing is lost in w: |w| = h |step| exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from controller.delay import delay
from controller.lti import Array, Lti
from design.margin import Requirement, closed_loop, dampings, from_ratio, refusal
from design.sweep import frequencies, hermitian, on_circle, supremum

Complex = NDArray[np.complex128]

SETTLED = 1e-7  # relative gap between the sweep of a multiplier and the bound that no multiplier beats
MOST_ROUNDS = 60
SMALLEST, LARGEST = 1e-8, 1e6  # multipliers alpha T / delta that are searched


@dataclass(frozen=True)
class JitterProof:
    """What switching within a range asks of the devices."""

    requirement: Requirement  # condition "jitter-proof"
    alpha: tuple[float, ...]  # (m,) [N s/m] the multiplier that shows it, at the available damping; 0 where lo = hi
    bound: float  # no multiplier shows less than this times the available damping (on the frequencies looked at)


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def nominal(lo: Sequence[int], hi: Sequence[int], T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    half = Lti.constant(np.eye(len(lo)) / 2, T)
    return half @ (delay(lo, T) + delay(hi, T))


def blocks(
    z: Complex, G: Complex, alpha: Array, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float] | Array, T: float
) -> Complex:
    """The condition's matrix at each z (not 1), to be positive: (k, 2m, 2m) from z (k,), G(z) (k, m, m), alpha (m,).

    Affine in (G, alpha) together: for fixed z the upper left block is
    He(c G) + diag(delta/T - alpha/2) with c = diag(`nominal_over_step`), the lower left h G, the lower right 2 alpha.
    design.jitter_lmi writes the same for cvxpy. The required damping is s delta with the least s for which some alpha,
    one for all z, makes every block positive.
    """
    m, step = G.shape[-1], nominal_over_step(z, lo, hi)
    error = half_widths(lo, hi)[:, None] * G
    rows = np.zeros((len(z), 2 * m, 2 * m), dtype=np.complex128)
    rows[:, :m, :m] = hermitian(step[:, :, None] * G) + np.diag(np.asarray(delta) / T - alpha / 2)
    rows[:, m:, :m], rows[:, :m, m:] = error, np.conj(np.swapaxes(error, 1, 2))
    rows[:, m:, m:] = np.diag(2 * alpha)
    return rows


def nominal_over_step(z: Complex, lo: Sequence[int], hi: Sequence[int]) -> Complex:
    """The diagonal of Theta_nom/(z - 1), shape (k, m)."""
    z = np.asarray(z)[:, None]
    return (z ** -np.asarray(lo, dtype=float) + z ** -np.asarray(hi, dtype=float)) / 2 / (z - 1)


def jitter_proof(G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float]) -> JitterProof:
    """The least common factor on `delta` [N s/m] with which some alpha satisfies the condition, and that alpha.

    G is the force map without Theta. The factor is convex in alpha: at every frequency and direction u it is at least
    u*(..)u, a sum of terms p_i alpha_i + q_i/alpha_i, which bounds it for all alpha. The worst of them are collected
    until the least alpha of the bound attains it; the result is the refined sweep of design.sweep at that alpha.
    """
    available, h = dampings(delta, G.inputs), half_widths(lo, hi)
    if len(h) != G.inputs:
        raise ValueError(f"delays are given for {len(h)} channels, expected {G.inputs}")
    constant = closed_loop(nominal(lo, hi, G.T) @ G, delta)
    if not np.isfinite(constant.ratio):
        return jitter_refusal(available, constant.reason or "no constant delay is safe")
    problem = _Ratio(G, lo, hi, np.asarray(available))
    a, ratio, w, bound = problem.least()
    alpha = tuple((a * np.asarray(available) / G.T).tolist())
    return JitterProof(from_ratio("jitter-proof", max(ratio, 0.0), available, w / (2 * np.pi * G.T)), alpha, bound)


def jitter_refusal(available: tuple[float, ...], reason: str) -> JitterProof:
    """That no damping is enough, and why."""
    return JitterProof(refusal("jitter-proof", available, reason), (np.inf,) * len(available), np.inf)


class _Ratio:
    """s(a) = sup over w of the largest eigenvalue of N + diag(a)/2 + Y* diag(1/2a) Y, a = alpha T/delta.

    N = W (F(1)/2 - He[(F - F(1))/(z-1)]) W with F = Theta_nom G, Y = h W G W, W = diag(sqrt(T/delta)).
    """

    def __init__(self, G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Array) -> None:
        F = nominal(lo, hi, G.T) @ G
        self._G, self._F1, self._regular = G, F.dc(), F.quotient_at_one()
        self._weight, self._h = np.sqrt(G.T / delta), half_widths(lo, hi)
        self.active = np.flatnonzero(self._h)
        self.grid = np.concatenate([[0.0], frequencies(G)])
        self._p, self._q, self._n = np.zeros((0, self.active.size)), np.zeros((0, self.active.size)), np.zeros(0)

    def parts(self, w: Array) -> tuple[Complex, Complex]:
        """N and the rows of Y with h > 0, at the frequencies w [rad/sample]."""
        z, W = on_circle(w), self._weight
        N = W[:, None] * (self._F1 / 2 - hermitian(self._regular.at(z))) * W
        Y = (self._h * W)[:, None] * self._G.at(z) * W
        return N, Y[:, self.active]

    def matrices(self, a: Array, N: Complex, Y: Complex) -> Complex:
        """N + diag(a)/2 + Y* diag(1/2a) Y, (k, m, m)."""
        diagonal = np.zeros(self._h.size)
        diagonal[self.active] = a / 2
        return N + np.diag(diagonal) + np.conj(np.swapaxes(Y, 1, 2)) @ (Y / (2 * a[:, None]))

    def least(self) -> tuple[Array, float, float, float]:
        """(a, s(a), w where it binds, lower bound on s over all a)."""
        N, Y = self.parts(self.grid)
        a, bound, ratio, best = np.full(self.active.size, 0.1), -np.inf, np.inf, (np.inf, 0.0, np.zeros(0))
        for _ in range(MOST_ROUNDS):
            ratio = self._cut(a, N, Y)
            if ratio <= bound + SETTLED * abs(bound) or not a.size:
                ratio, w = supremum(lambda w, a=a: self._largest(a, *self.parts(w)), self.grid)
                best = min(best, (ratio, w, a), key=lambda found: found[0])
                if best[0] <= bound + 10 * SETTLED * abs(bound) or not a.size:
                    break
                extra = self.parts(np.array([w]))
                N, Y = np.concatenate([N, extra[0]]), np.concatenate([Y, extra[1]])
                self._cut(a, *extra)
            a, bound = self._bound(a)
        else:
            ratio, w = supremum(lambda w, a=a: self._largest(a, *self.parts(w)), self.grid)
            best = min(best, (ratio, w, a), key=lambda found: found[0])
        full = np.zeros(self._h.size)
        full[self.active] = best[2]
        return full, best[0], best[1], bound if a.size else best[0]

    def _largest(self, a: Array, N: Complex, Y: Complex) -> Array:
        return np.linalg.eigvalsh(self.matrices(a, N, Y))[:, -1].astype(float)

    def _cut(self, a: Array, N: Complex, Y: Complex) -> float:
        """Collect the bounds at the local peaks near the worst sampled frequency; the worst value."""
        values = self._largest(a, N, Y)
        top, padded = float(values.max()), np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= top - 0.3 * abs(top)))
        peaks = peaks[np.argsort(values[peaks])[-8:]]
        u = np.linalg.eigh(self.matrices(a, N[peaks], Y[peaks]))[1][:, :, -1]
        self._n = np.append(self._n, np.einsum("ki,kij,kj->k", u.conj(), N[peaks], u).real)
        self._p = np.concatenate([self._p, np.abs(u[:, self.active]) ** 2 / 2])
        self._q = np.concatenate([self._q, np.abs(np.einsum("kij,kj->ki", Y[peaks], u)) ** 2 / 2])
        return top

    def _bound(self, a: Array) -> tuple[Array, float]:
        """(a, value): the least maximum over a of the collected n + p.a + q.(1/a), convex in log a."""

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
