"""Fixed-order couplings by inner convex approximation: descent on ||W1 L W2||_inf in which every step is feasible.

Lemmas 2 and 3 are affine in the coupling except for the inversions Y = Q^-1, X = U^-1 (20), (24b). The inverse of a
positive matrix is convex: Q^-1 >= 2 Q0^-1 - Q0^-1 Q Q0^-1, with equality at Q0. With that tangent for Y the set
shrinks to a convex part of itself that still holds the current coupling, so each SDP improves on the last, mu^2
enters linearly, and there is no bisection. In state coordinates where Q0 = I the tangent is 2I - Q.
"""

from __future__ import annotations

from collections.abc import Iterator

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.fixed_order.realisation import FixedOrder
from design.fixed_order.storage import gain_storage, passivity_storage
from design.lmi import Ports, lemma2, lemma3
from design.semidefinite.affine import affine, packed, symmetric_from
from design.solve import solve, solved

#: Room above the start's norm for its first certificate, relatively.
FIRST_ROOM = 0.05
#: Bounds on Q and U in coordinates where they were I: a state that little reaches leaves them free to degenerate.
LEAST, MOST = 0.1, 1.99


def descend(family: FixedOrder, p: Array, norm: float) -> Iterator[Array]:
    """The couplings p of successive steps from one that is strictly feasible and has the given norm.

    Ends where a certificate is singular to rounding: the coupling then stands on the boundary.
    """
    Q = np.linalg.inv(passivity_storage(family, p))
    U = gain_storage(family, p, norm * (1 + FIRST_ROOM))
    while min(np.linalg.eigvalsh(Q)[0], np.linalg.eigvalsh(U)[0]) > 0:
        p, Q, U = _step(family, p, Q, U, norm)
        yield p


def _step(family: FixedOrder, at: Array, Q0: Array, U0: Array, norm: float) -> tuple[Array, Array, Array]:
    """One SDP in x = (p - at, Q, U, mu^2/norm^2), Q and U in coordinates where Q0 = U0 = I."""
    LQ, LU = np.linalg.cholesky(Q0), np.linalg.cholesky(U0)
    nq, nu = Q0.shape[0], U0.shape[0]
    ends = np.cumsum([family.unknowns, packed(nq), packed(nu)])
    x = cp.Variable(int(ends[-1]) + 1)

    def split(v: Array) -> tuple[Array, Array, Array, float]:
        p, q, u, t = np.split(v, ends)
        return at + p, symmetric_from(q, nq), symmetric_from(u, nu), t[0]

    def passivity(v: Array) -> Array:
        p, Q, _, _ = split(v)
        G = in_coordinates(family.ports(p), LQ)
        sigma = np.eye(G.C1.shape[0]) if G.C1.size else None
        return lemma2(G, Q, 2 * np.eye(nq) - Q, sigma, np.zeros_like(G.D2))

    def gain(v: Array) -> Array:
        p, _, U, t = split(v)
        A, B, C, D = family.loop(p)
        A, B, C = np.linalg.solve(LU, A @ LU), np.linalg.solve(LU, B), C @ LU / norm
        return lemma3(A, B, C, D / norm, 2 * np.eye(nu) - U, U, t)

    storages = [affine(lambda v: split(v)[1], x), affine(lambda v: split(v)[2], x)]
    least = [Z >> LEAST * np.eye(Z.shape[0]) for Z in storages]
    most = [Z << MOST * np.eye(Z.shape[0]) for Z in storages]
    cuts: list[cp.Constraint] = [affine(passivity, x) >> 0, affine(gain, x) >> 0, *least, *most]
    solve(cp.Problem(cp.Minimize(x[-1]), cuts), "a step of the inner convex approximation")
    p, Q, U, _ = split(solved(x))
    return p, LQ @ Q @ LQ.T, LU @ U @ LU.T


def in_coordinates(G: Ports, L: Array) -> Ports:
    """G with the states L^-1 x."""
    return Ports(np.linalg.solve(L, G.A @ L), np.linalg.solve(L, G.B), G.C2 @ L, G.D2, G.C1 @ L, G.D1)
