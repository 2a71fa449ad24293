"""Fixed-order couplings by cone complementarity, as Remark 5 of the paper prints it (with the remedied inequalities).

For a given mu the inversions Y = Q^-1 and X = U^-1 are relaxed to [[Y, I], [I, Q]] >= 0 and [[X, I], [I, U]] >= 0,
and tr(QY) + tr(UX), which reaches its least value only where they hold, is linearised and minimised again and again;
mu is found by bisection. The sequence stalls far from the optimum, which is why `inner_convex` exists.
"""

from __future__ import annotations

from collections.abc import Callable

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.failure import DesignFailed
from design.fixed_order.inner_convex import FIRST_ROOM, in_coordinates
from design.fixed_order.realisation import FixedOrder
from design.fixed_order.storage import gain_storage, passivity_storage
from design.lmi import lemma2, lemma3, symmetric
from design.semidefinite.affine import affine, packed, symmetric_from
from design.solve import solve

#: Linearised problems per value of mu, and the relative width at which bisection ends.
PATIENCE = 20
WIDTH = 5e-3


def bisect(
    family: FixedOrder, p: Array, norm: float, holds: Callable[[Array, float], bool], budget: int
) -> tuple[Array, int]:
    """(the best coupling, SDPs spent). `holds(p, mu)` judges a coupling from itself alone; p holds for its norm."""
    relaxed = _Relaxed(family, p, norm)
    low, high, best, sdps = 0.5 * norm, norm, p, 0
    while high - low > WIDTH * high and sdps < budget:
        mu = (low + high) / 2
        found, spent = relaxed.search(mu, holds, min(PATIENCE, budget - sdps))
        sdps += spent
        if found is None:
            low = mu
        else:
            best, high = found, mu
    return best, sdps


class _Relaxed:
    """The relaxed problem in coordinates where the start's Q and U are the identity."""

    def __init__(self, family: FixedOrder, p: Array, norm: float) -> None:
        self.family, self.at, self.norm = family, p, norm
        self.LQ = np.linalg.cholesky(np.linalg.inv(passivity_storage(family, p)))
        self.LU = np.linalg.cholesky(gain_storage(family, p, norm * (1 + FIRST_ROOM)))
        self.sizes = (self.LQ.shape[0],) * 2 + (self.LU.shape[0],) * 2
        self.ends = np.cumsum([family.unknowns, *map(packed, self.sizes)])[:-1]

    def split(self, v: Array) -> tuple[Array, list[Array]]:
        """p and [Q, Y, U, X] from the vector of unknowns."""
        p, *vectors = np.split(v, self.ends)
        return self.at + p, [symmetric_from(u, n) for u, n in zip(vectors, self.sizes, strict=True)]

    def search(self, mu: float, holds: Callable[[Array, float], bool], patience: int) -> tuple[Array | None, int]:
        """(a coupling that holds for mu or None, SDPs spent)."""
        x = cp.Variable(self.family.unknowns + sum(map(packed, self.sizes)))
        constraints = self._constraints(x, mu)
        matrices = [np.eye(n) for n in self.sizes]
        for spent in range(1, patience + 1):
            Q0, Y0, U0, X0 = matrices
            trace = affine(lambda v, at=(Y0, Q0, X0, U0): self._inner(v, at), x)
            try:
                solve(cp.Problem(cp.Minimize(cp.sum(trace)), constraints), "a step of cone complementarity")
            except DesignFailed:
                return None, spent
            p, matrices = self.split(np.asarray(x.value))
            if holds(p, mu):
                return p, spent
        return None, patience

    def _inner(self, v: Array, at: tuple[Array, ...]) -> Array:
        """tr(Y0 Q) + tr(Q0 Y) + tr(X0 U) + tr(U0 X), (1, 1)."""
        return np.array([[sum(float(np.sum(M * M0)) for M, M0 in zip(self.split(v)[1], at, strict=True))]])

    def _constraints(self, x: cp.Variable, mu: float) -> list[cp.Constraint]:
        def passivity(v: Array) -> Array:
            p, (Q, Y, _, _) = self.split(v)
            G = in_coordinates(self.family.ports(p), self.LQ)
            sigma = np.eye(G.C1.shape[0]) if G.C1.size else None
            return lemma2(G, Q, Y, sigma, np.zeros_like(G.D2))

        def gain(v: Array) -> Array:
            p, (_, _, U, X) = self.split(v)
            A, B, C, D = self.family.loop(p)
            A, B, C = np.linalg.solve(self.LU, A @ self.LU), np.linalg.solve(self.LU, B), C @ self.LU / self.norm
            return lemma3(A, B, C, D / self.norm, X, U, (mu / self.norm) ** 2)

        def pair(first: int) -> Callable[[Array], Array]:
            one = np.eye(self.sizes[first])
            return lambda v: symmetric([[self.split(v)[1][first + 1], one], [one, self.split(v)[1][first]]])

        return [affine(f, x) >> 0 for f in (passivity, gain, pair(0), pair(2))]
