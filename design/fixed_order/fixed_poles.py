"""Diagonal couplings with given poles: one convex problem, globally optimal for those poles.

V_i = v_i + sum_j f_ij (1 - z)/(z - a_ij). With the poles fixed, the remedied (2) is linear in the storage P and in
(v, f), and W1 L W2 is affine in (v, f): its norm is bounded at sampled frequencies, with cutting planes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cvxpy as cp
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

from controller.lti import Array, Lti
from design.failure import DesignFailed
from design.frequency.sweep import on_circle
from design.lmi import Ports, lemma1, symmetric, theta_hat
from design.semidefinite.affine import affine, packed, symmetric_from
from design.semidefinite.sampled import affine_lmis, gain_lmi
from design.shaping import Shaping
from design.solve import solve, solved
from design.specification import Specification

#: Relative gap between the norm on a refined sweep and the bound at the sampled frequencies.
GAP = 1e-5
MOST_CUTS = 20


class FixedPoles:
    """The problem for one specification; frequencies that were binding are kept from one set of poles to the next."""

    def __init__(self, spec: Specification, sigma: Array) -> None:
        self.spec, self.sigma, self.shaping = spec, sigma, Shaping(spec)
        self.frequencies = [0.0]
        self.sdps = 0

    def best(self, poles: Sequence[Sequence[float]]) -> tuple[Lti, float]:
        """(V in SI units, ||W1 L W2||_inf) for `poles`, one real sequence per channel, each in (-1, 1)."""
        cuts = 0
        while True:
            V, bound = self._solve(poles)
            norm, peak = self.shaping.norm(V)
            if norm <= bound * (1 + GAP):
                return V, norm
            self.frequencies.append(peak)
            cuts += 1
            if cuts == MOST_CUTS:
                return V, norm

    def search(self, start: Sequence[float], holds: Callable[[Lti], bool], evaluations: int = 60) -> tuple[Lti, float]:
        """`best` over one pole per channel, by a simplex search from `start`; only poles whose V `holds` count.

        The search would otherwise be drawn to poles at which a solver's tolerance passes for passivity.
        """

        def norm(x: Array) -> float:
            try:
                V, value = self.best([[a] for a in np.tanh(x)])
            except DesignFailed:
                return np.inf
            return value if holds(V) else np.inf

        options = {"maxfev": evaluations, "xatol": 1e-3, "fatol": 1e-4}
        found = minimize(norm, np.arctanh(start), method="Nelder-Mead", options=options)
        return self.best([[a] for a in np.tanh(found.x)])

    def _solve(self, poles: Sequence[Sequence[float]]) -> tuple[Lti, float]:
        spec, N = self.spec, self.spec.channels
        states = sum(map(len, poles)) + sum(spec.theta)
        gains, storage, t = cp.Variable(N + sum(map(len, poles))), cp.Variable(packed(states)), cp.Variable()
        x = cp.hstack([gains, storage])

        def passive(v: Array) -> Array:
            g, p = np.split(v, [gains.size])
            return self._passivity(poles, g, symmetric_from(p, states))

        P = affine(lambda v: symmetric_from(v, states), storage)
        cuts = self._cuts(poles, gains, t)
        problem = cp.Problem(cp.Minimize(t), [affine(passive, x) >> 0, P >> 0, *cuts])
        solve(problem, "the coupling with fixed poles")
        self.sdps += 1
        return self._coupling(poles, solved(gains)), float(np.sqrt(solved(t)))

    def _unit(self, poles: Sequence[Sequence[float]], gains: Array) -> tuple[Lti, Array, Array]:
        """V in units T = 1 and usable damping = I, with F and V1 of design.fixed_order.realisation's realisation."""
        N = len(poles)
        V1, f = np.diag(gains[:N]), np.split(gains[N:], np.cumsum([len(a) for a in poles])[:-1])
        A = np.diag(np.concatenate(poles))
        B = np.asarray(block_diag(*(np.sqrt(1 - np.square(a))[:, None] for a in poles)))
        F = np.asarray(block_diag(*(row[None, :] for row in f)))
        return Lti(A, B, F - F @ A, V1 - F @ B, 1.0), F, V1

    def _coupling(self, poles: Sequence[Sequence[float]], gains: Array) -> Lti:
        V, root, T = self._unit(poles, gains)[0], 1 / np.sqrt(self.spec.usable), self.spec.T
        return Lti(V.A, V.B * root, T * root[:, None] * V.C, T * root[:, None] * V.D * root, T)

    def _passivity(self, poles: Sequence[Sequence[float]], gains: Array, P: Array) -> Array:
        """The remedied (2) with the excess term by a Schur complement, so that it is linear in (gains, P)."""
        V, F, V1 = self._unit(poles, gains)
        G = theta_hat(self.spec.theta)
        C2 = np.hstack([F, G.quotient_at_one().C])
        C1, D1 = np.hstack([V.C, -G.C]), V.D - G.D
        ports = Ports(block_diag(V.A, G.A), np.vstack([V.B, G.B]), C2, (V1 - G.dc()) / 2, C1, D1)
        zero = np.zeros_like(D1)
        plain = lemma1(ports, P, zero, zero)
        paid = np.isfinite(self.sigma)
        excess = np.hstack([C1, D1])[paid] / np.sqrt(self.sigma[paid])[:, None]
        return symmetric([[plain, excess.T], [excess, np.eye(excess.shape[0])]])

    def _cuts(self, poles: Sequence[Sequence[float]], gains: cp.Variable, t: cp.Variable) -> list[cp.Constraint]:
        """[[I, L*], [L, t I]] >= 0 for W1 L W2 at the binding frequencies."""
        w = np.array(self.frequencies)
        left, right, late = self.shaping.parts(w)
        at_zero = late @ right
        units = np.eye(gains.size)
        slopes = np.stack([left @ self._coupling(poles, e).at(on_circle(w)) @ right for e in units])
        m = right.shape[-1]
        base = np.broadcast_to(np.eye(m), (w.size, m, m)).astype(np.complex128)
        constant, slopes = gain_lmi(at_zero, slopes, base, np.zeros((gains.size, w.size, m, m)))
        return affine_lmis(constant, slopes, cp.hstack([gains, t]))
