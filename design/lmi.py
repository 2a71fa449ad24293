"""The paper's matrix inequalities, one function per equation, with a remedy where the printed strict form is empty.

Units: T = 1 and Delta_D = I (design.semidefinite.coordinates). Every function returns a symmetric matrix that must be
positive (semi)definite; its arguments are numbers or cvxpy expressions.

Two transfer matrices of the paper can never satisfy the strict inequalities printed for them:
  E-hat = z/(z-1) Psi E has a pole at z = 1 wherever E has static stiffness, and A'PA - P < 0 excludes it (15), (17).
      Remedy: the Hermitian part of E(1) z/(z-1) on |z| = 1 is the constant E(1)/2, so what is left, E-hat less
      its pole plus E(1)/2, carries the same condition and is stable (`e_hat_regular`).
  V-hat = (1 - 1/z)(V - Theta-hat) vanishes at z = 1, where (2) asks 0 > 0.
      Remedy: divide by |1 - 1/z|^2 (`v_hat_regular`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

from controller.delay import delay
from controller.lti import Lti
from design.specification import regular_part

Matrix = Any  # Array or cvxpy expression, (rows, columns)


class Ports(NamedTuple):
    """x+ = A x + B u with a port output y2 = C2 x + D2 u and a dissipated output y1 = C1 x + D1 u.

    The supply is y2'u - y1' Delta y1 - u' Phi u. Plain passivity has y1 = y2.
    """

    A: Matrix
    B: Matrix
    C2: Matrix
    D2: Matrix
    C1: Matrix
    D1: Matrix

    @classmethod
    def same(cls, G: Lti) -> Ports:
        return cls(G.A, G.B, G.C, G.D, G.C, G.D)


def lemma1(G: Ports, P: Matrix, Delta: Matrix, Phi: Matrix) -> Matrix:
    """(2), with its sign turned: x'Px - x+'Px+ + supply as a quadratic form of (x, u); it and P must be > 0."""
    A, B, C2, D2, C1, D1 = G
    corner = C2.T / 2 - A.T @ P @ B - C1.T @ Delta @ D1
    state = P - A.T @ P @ A - C1.T @ Delta @ C1
    port = (D2 + D2.T) / 2 - B.T @ P @ B - D1.T @ Delta @ D1 - Phi
    return symmetric([[state, corner], [corner.T, port]])


def lemma2(G: Ports, Q: Matrix, Y: Matrix, Sigma: Matrix | None, Phi: Matrix) -> Matrix:
    """[[Y, R'], [R, S]] of (3); with Q > 0, Y = Q^-1 and Sigma = Delta^-1 it is Lemma 1 (Sigma None: Delta = 0).

    Affine in A, B, C, D, which may therefore be unknowns.
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
    return symmetric(rows)


def lemma3(A: Matrix, B: Matrix, C: Matrix, D: Matrix, X: Matrix, U: Matrix, mu2: Matrix) -> Matrix:
    """The matrix of Lemma 3 and (24): with X = U^-1 it is positive iff ||G||_inf < mu; mu2 = mu^2 is scalar."""
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    rows = [
        [X, np.zeros((n, m)), A.T, C.T],
        [np.zeros((m, n)), mu2 * np.eye(m), B.T, D.T],
        [A, B, U, np.zeros((n, p))],
        [C, D, np.zeros((p, n)), np.eye(p)],
    ]
    return symmetric(rows)


def lemma4(Delta_V: Matrix, Phi: Matrix) -> Matrix:
    """(14): the excess of passivity of devices (I) and V-hat covers the shortage Phi of E-hat; also Delta_V > 0."""
    one = np.eye(Phi.shape[0])
    return symmetric([[one - Phi, -Phi], [-Phi, Delta_V - Phi]])


def e_hat_regular(E: Lti, psi: Sequence[int]) -> Lti:
    """E-hat less its pole at z = 1, plus E(1)/2; E(1) must be symmetric and >= 0."""
    return regular_part(delay(psi, E.T) @ E)


def theta_hat(theta: Sequence[int], T: float = 1.0) -> Lti:
    """(12) in these units: blockdiag(1 + 1/z + ... + z^-theta_i) / 2."""
    return Lti.diag(*(_window(n, T) for n in theta))


def v_hat_regular(V: Lti, theta: Sequence[int]) -> Ports:
    """V-hat divided by |1 - 1/z|^2: with H = V - Theta-hat, y1 = H u and y2 = (H(1)/2 - (H - H(1))/(z-1)) u.

    He[(1 - 1/z) H]/|1 - 1/z|^2 = He[H/(1 - z)], and 1/(1-z) has the Hermitian part 1/2 on the circle: V-hat is
    Delta-OSP iff He y2/u >= (y1/u)* Delta (y1/u). V(1) must be symmetric. One state per channel fewer than (16).
    """
    return shifted_ports(V - theta_hat(theta, V.T))


def shifted_ports(H: Lti) -> Ports:
    """The two outputs of `v_hat_regular` for a given stable H."""
    quotient = H.quotient_at_one()
    static = H.dc()
    return Ports(H.A, H.B, -quotient.C, (static + static.T) / 4, H.C, H.D)


def symmetric(rows: list[list[Matrix]]) -> Matrix:
    """The block matrix, made exactly symmetric; an array if every block is one. Empty blocks are left out."""
    kept = [[block for block in row if 0 not in block.shape] for row in rows]
    kept = [row for row in kept if row]
    numbers = all(isinstance(block, np.ndarray) for row in kept for block in row)
    M = np.block(kept) if numbers else cp.bmat(kept)
    return (M + M.T) / 2


def _window(n: int, T: float) -> Lti:
    chain = delay([n], T)
    ones = np.ones((1, chain.order))
    return Lti(chain.A, chain.B, ones / 2, np.array([[0.5]]), T)
