"""Storage matrices of a given coupling: what makes the inequalities of a fixed-order design hold at a start."""

from __future__ import annotations

from collections.abc import Callable

import cvxpy as cp
import numpy as np

from controller.lti import Array, Lti
from design.fixed_order.realisation import FixedOrder
from design.lmi import Ports, lemma1
from design.semidefinite.affine import affine, packed, symmetric_from
from design.semidefinite.coordinates import reachability_scaled
from design.solve import solve


def passivity_storage(family: FixedOrder, p: Array) -> Array:
    """P > 0 of the remedied (2) for the coupling p, with the most room; the coupling must satisfy it strictly."""
    G = family.ports(p)
    m, paid = G.D2.shape[0], G.D1.shape[0]
    return _roomiest(lambda P: lemma1(G, P, np.eye(paid), np.zeros((m, m))), G.A.shape[0], "the storage of V-hat")


def gain_storage(family: FixedOrder, p: Array, mu: float) -> Array:
    """U = X^-1 > 0 of Lemma 3, ||W1 L W2||_inf < mu, with the most room in coordinates of unit reachability."""
    A, B, C, D = family.loop(p)
    S = reachability_scaled(Lti(A, B, C, D, 1.0))
    A, B, C, D = np.linalg.solve(S, A @ S), np.linalg.solve(S, B), C @ S / mu, D / mu
    m = B.shape[1]
    bounded = Ports(A, B, np.zeros((m, A.shape[0])), np.eye(m), C, D)
    zero = np.zeros((m, m))
    X = _roomiest(lambda X: lemma1(bounded, X, np.eye(C.shape[0]), zero), A.shape[0], "the storage of L")
    return S @ np.linalg.inv(X) @ S.T


def _roomiest(inequality: Callable[[Array], Array], n: int, what: str) -> Array:
    """The P that maximises s <= 1 with inequality(P) >= s I and P >= s I."""
    size = inequality(np.zeros((n, n))).shape[0]
    x, s = cp.Variable(packed(n)), cp.Variable()
    matrix = affine(lambda v: inequality(symmetric_from(v, n)), x)
    P = affine(lambda v: symmetric_from(v, n), x)
    constraints = [matrix >> s * np.eye(size), P >> s * np.eye(n), s <= 1]
    solve(cp.Problem(cp.Maximize(s), constraints), what)
    return symmetric_from(np.asarray(x.value), n)
