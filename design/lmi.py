"""The matrices of the paper's lemmas, the paper's loop-shaping objective, and scalings for solvers.

`lemma1`, `lemma2` and `lemma3` return a symmetric matrix that must be positive (semi)definite. The strict inequalities
(2), (15), (17) and (18) of the paper have no solution; docs/theory.md says how the program avoids them.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Complex, Lti
from haptic_loop.design.facts import even_damping
from haptic_loop.design.frequency import frequencies, on_circle, supremum

RESERVE = 1e-4  # share of the damping that designs do not use, so that the rounded coupling is certified


def usable(loop: Loop) -> Array:
    """Return (1 - RESERVE) delta T/T_max (m,) [N s/m], which a design may use. Raises ValueError if a delta is 0."""
    if min(loop.delta) <= 0:
        raise ValueError(f"delta, the damping of devices, is {list(loop.delta)}, expected positive numbers [N s/m]")
    return (1 - RESERVE) * even_damping(loop)


def _low_pass(channels: int, T: float) -> Lti:
    """Return w(z) I, the backward Euler discretisation of 1/(1 + s/(2 pi 80 Hz)) (section 6 of the paper)."""
    a = 2 * np.pi * 80.0 * T
    gain, pole = a / (1 + a), 1 / (1 + a)
    one = np.eye(channels)
    return Lti(pole * one, one, gain * pole * one, gain * one, T)


# ----------------------------------------------------------------------------------------------------
# The loop-shaping objective of section 5 of the paper: ||L W2||_inf with L = I + Psi E V - Psi Lambda^-1 Theta. The
# paper's further weight W1 is the identity.


class Shaping:
    """The weighted function L W2 of a loop, with L (22) and W2 = `_low_pass`, for fast evaluation with many couplings.

    Raises ValueError for an active environment.
    """

    def __init__(self, loop: Loop) -> None:
        N, T, E = loop.channels, loop.T, loop.E()
        self.loop, self.usable, self.W2 = loop, usable(loop), _low_pass(N, T)
        if reason := loop.environment.active(T):
            raise ValueError(reason)
        advance = [t + p - n for t, p, n in zip(loop.theta, loop.psi, loop.lam, strict=True)]
        self.late = Lti.constant(np.eye(N), T) - delay(advance, T)  # I - Psi Lambda^-1 Theta
        self.environment = delay(loop.psi, T) @ E  # Psi E

    def parts(self, w: Array) -> tuple[Complex, Complex, Complex]:
        """Return Psi E, W2 and I - Psi Lambda^-1 Theta at z = exp(jw) for w (k,) [rad/sample], (k, m, m) each."""
        z = on_circle(w)
        return self.environment.at(z), self.W2.at(z), self.late.at(z)

    def grid(self, *systems: Lti) -> Array:
        """Return frequencies [rad/sample] from 0 to pi that resolve every pole of E, W2 and `systems`."""
        return np.concatenate([[0.0], frequencies(self.environment, self.W2, *systems)])

    def gain(self, V: Lti, w: Array) -> Array:
        """Return the largest singular value of L W2 at each frequency w [rad/sample]; w and result have shape (k,)."""
        environment, weight, late = self.parts(w)
        return np.linalg.norm((environment @ V.at(on_circle(w)) + late) @ weight, 2, axis=(1, 2))

    def norm(self, V: Lti) -> tuple[float, float]:
        """Return (||L W2||_inf, its frequency [rad/sample])."""
        return supremum(lambda w: self.gain(V, w), self.grid(V))


def packed(n: int) -> int:
    """Return the number of free entries of a symmetric matrix (n, n)."""
    return n * (n + 1) // 2


_upper = cache(np.triu_indices)


def symmetric_from(vector: Array, n: int) -> Array:
    """Return the symmetric (n, n) matrix whose upper triangle, row by row, is `vector`."""
    M, (rows, columns) = np.empty((n, n)), _upper(n)
    M[rows, columns] = M[columns, rows] = vector
    return M


# ----------------------------------------------------------------------------------------------------
# State coordinates and units in which matrix inequalities are well scaled.


def unit_environment(E: Lti, delta: Sequence[float] | Array) -> Lti:
    """Return E in units where T = 1 and Delta_D = I: T Delta_D^-1/2 E Delta_D^-1/2."""
    root = 1 / np.sqrt(np.asarray(delta))
    return Lti(E.A, E.B * root, E.T * root[:, None] * E.C, E.T * root[:, None] * E.D * root, 1.0)


def reachability_scaled(G: Lti) -> Array:
    """Return S (n, n). In the states S^-1 x of G the regularised reachability Gramian is the identity."""
    import scipy

    A, W = G.A, G.B @ G.B.T
    with warnings.catch_warnings():
        warnings.simplefilter("error", scipy.linalg.LinAlgWarning)
        try:
            W = scipy.linalg.solve_discrete_lyapunov(A, W)
        except scipy.linalg.LinAlgWarning:  # ill-conditioned: each step doubles the summed terms of the series
            while np.abs(step := A @ W @ A.T).max(initial=0.0) > 1e-16 * np.abs(W).max(initial=0.0):
                W, A = W + step, A @ A
    size = max(np.trace(W) / max(G.order, 1), 1e-300)
    return scipy.linalg.cholesky((W + W.T) / 2 + 1e-9 * size * np.eye(G.order), lower=True)


class Ports(NamedTuple):
    """The system x+ = A x + B u with two outputs, y2 = C2 x + D2 u at the port and y1 = C1 x + D1 u.

    The supply is y2'u - y1' Delta y1 - u' Phi u. Output strict passivity has y1 = y2.
    """

    A: Array
    B: Array
    C2: Array
    D2: Array
    C1: Array
    D1: Array

    @classmethod
    def same(cls, G: Lti) -> Ports:
        return cls(G.A, G.B, G.C, G.D, G.C, G.D)


def lemma1(G: Ports, P: Array, Delta: Array, Phi: Array) -> Array:
    """Return the matrix of x'Px - x+'Px+ + supply in (x, u), the negative of (2). This matrix and P must be > 0."""
    A, B, C2, D2, C1, D1 = G
    corner = C2.T / 2 - A.T @ P @ B - C1.T @ Delta @ D1
    state = P - A.T @ P @ A - C1.T @ Delta @ C1
    port = (D2 + D2.T) / 2 - B.T @ P @ B - D1.T @ Delta @ D1 - Phi
    return _symmetric([[state, corner], [corner.T, port]])


def lemma2(G: Ports, Q: Array, Y: Array, Sigma: Array | None, Phi: Array) -> Array:
    """Return [[Y, R'], [R, S]] of Lemma 2. It is affine in A, B, C and D, so that these may be unknowns.

    With Q > 0, Y = Q^-1 and Sigma = Delta^-1 the inequality is equivalent to (2). Sigma = None means Delta = 0.
    """
    A, B, C2, D2, C1, D1 = G
    n = Q.shape[0]
    rows = [
        [Y, C2.T / 2, A.T],
        [C2 / 2, (D2 + D2.T) / 2 - Phi, B.T],
        [A, B, Q],
    ]
    if Sigma is not None:
        for row, block in zip(rows, (C1.T, D1.T, np.zeros((n, C1.shape[0]))), strict=True):
            row.append(block)
        rows.append([C1, D1, np.zeros((C1.shape[0], n)), Sigma])
    return _symmetric(rows)


def lemma3(A: Array, B: Array, C: Array, D: Array, X: Array, U: Array, mu2: float) -> Array:
    """Return the matrix of Lemma 3 and (24) with mu2 = mu^2.

    It is positive definite for some U > 0 and X = U^-1 if and only if ||G||_inf < mu.
    """
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    rows = [
        [X, np.zeros((n, m)), A.T, C.T],
        [np.zeros((m, n)), mu2 * np.eye(m), B.T, D.T],
        [A, B, U, np.zeros((n, p))],
        [C, D, np.zeros((p, n)), np.eye(p)],
    ]
    return _symmetric(rows)


def _symmetric(rows: list[list[Array]]) -> Array:
    """Return the block matrix, made exactly symmetric."""
    M = np.block(rows)
    return (M + M.T) / 2
