"""State coordinates and units in which matrix inequalities are well scaled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cholesky, solve_discrete_lyapunov, svd

from controller.lti import Array, Lti


def unit_environment(E: Lti, delta: Sequence[float]) -> Lti:
    """E in units where T = 1 and Delta_D = I: T Delta_D^-1/2 E Delta_D^-1/2."""
    root = 1 / np.sqrt(np.asarray(delta))
    return _scaled(E, E.T * root, root)


def unit_coupling(V: Lti, delta: Sequence[float]) -> Lti:
    """V in the same units: Delta_D^1/2 V Delta_D^1/2 / T, so that E V keeps its eigenvalues."""
    root = np.sqrt(np.asarray(delta))
    return _scaled(V, root / V.T, root)


def balanced(G: Lti, negligible: float = 1e-11) -> Lti:
    """G, stable, with equal diagonal Gramians; states of Hankel value below `negligible` of the largest are left out.

    Square-root method. Only states that no input reaches or no output shows to rounding are left out, so the
    response is unchanged: this is not a model reduction.
    """
    if G.order == 0:
        return G
    reach, show = _root(G.A, G.B), _root(G.A.T, G.C.T)
    U, hankel, Vt = svd(show.T @ reach)
    keep = hankel > negligible * max(hankel[0], 1e-300)
    scale = 1 / np.sqrt(hankel[keep])
    left = (show @ U[:, keep] * scale).T
    right = reach @ Vt[keep].T * scale
    return Lti(left @ G.A @ right, left @ G.B, G.C @ right, G.D, G.T)


def reachability_scaled(G: Lti) -> Array:
    """S (n, n) such that the states S^-1 x of G have the identity as reachability Gramian (regularised)."""
    W = solve_discrete_lyapunov(G.A, G.B @ G.B.T)
    size = max(np.trace(W) / max(G.order, 1), 1e-300)
    return cholesky((W + W.T) / 2 + 1e-9 * size * np.eye(G.order), lower=True)


def _root(A: Array, B: Array) -> Array:
    """R with R R' = the Gramian of (A, B), defined for singular ones too."""
    W = solve_discrete_lyapunov(A, B @ B.T)
    values, basis = np.linalg.eigh((W + W.T) / 2)
    return basis * np.sqrt(np.maximum(values, 0.0))


def _scaled(G: Lti, left: Array, right: Array) -> Lti:
    return Lti(G.A, G.B * right, left[:, None] * G.C, left[:, None] * G.D * right, 1.0)
