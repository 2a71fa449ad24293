"""Strict positive realness of a block G = (A, B, C, D): found by a Riccati equation, proved in exact arithmetic.

Kalman-Yakubovich-Popov: if P > 0 and
    [[P - A'PA, C' - A'PB], [C - B'PA, D + D' - B'PB]] > 0                                      (KYP)
then A is stable (x'Px falls along x+ = Ax, by the first block) and He G > 0 on the whole unit circle,
because [(zI - A)^-1 B; I] maps the matrix of (KYP) to G + G* there. Both inequalities are tested exactly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, solve_discrete_are

from controller.lti import Array, Lti
from design.frequency.sweep import frequencies, hermitian, on_circle, supremum
from design.proof.exact import Exact
from design.proof.positive_definite import strictly_positive
from design.proof.rational import Matrix, block

LARGEST = 200  # states of a model that a proof is tried for: 0.1 s at 50, 0.5 s at 100, up to 10 s at 200
STORED_BITS = 44  # of each entry of P, relative to its diagonal
UNIT = 2.0**-53  # of double precision


def kyp_matrix(G: Exact, P: Matrix) -> Matrix:
    """The matrix of (KYP), exactly, shape (n + m, n + m)."""
    PA, PB = P @ G.A, P @ G.B
    cross = G.C - G.B.T @ PA
    return block([[P - G.A.T @ PA, cross.T], [cross, G.D + G.D.T - G.B.T @ PB]])


def too_large(G: Exact) -> str | None:
    """Why no proof is tried for a model of so many states, or None."""
    if G.order <= LARGEST:
        return None
    return f"a proof over {G.order} states takes long: up to {LARGEST} are tried"


def prove_positive_real(G: Exact, P: Matrix) -> str | None:
    """None if P proves that G is strictly positive real, otherwise why it does not.

    Floating point with an a-priori error bound may refuse early; only exact arithmetic accepts.
    """
    n = G.order
    if P.shape != (n, n):
        return f"P has shape {P.shape}, the model has {n} states"
    if not P.equals(P.T):
        return "P is not symmetric"
    if refuted_in_floating_point(G, P):
        return "the KYP matrix has a negative direction, beyond the error bound of floating point"
    for name, matrix in (("P", P), ("the KYP matrix", kyp_matrix(G, P))):
        if not strictly_positive(matrix):
            return f"{name} is not positive definite, or by so little that it is not proved"
    return None


def refuted_in_floating_point(G: Exact, P: Matrix) -> bool:
    """Whether some direction makes the KYP matrix negative by more than every rounding error.

    The matrix is S - J'PJ with S = [[P, C'], [C, D + D']] and J = [A B], sums of products of three correctly
    rounded numbers: entry by entry the computed one is within gamma (|S| + |J|'|P||J|),
    gamma = (2n + 8) u / (1 - (2n + 8) u).
    """
    A, B, C, D, p = (m.floats() for m in (G.A, G.B, G.C, G.D, P))
    J = np.hstack([A, B])
    direct = np.block([[p, C.T], [C, D + D.T]])
    with np.errstate(all="ignore"):
        M = direct.copy() - J.T @ p @ J
    if not np.isfinite(M).all():
        return False
    k = (2 * G.order + 8) * UNIT
    error = k / (1 - k) * (np.abs(direct) + np.abs(J.T) @ np.abs(p) @ np.abs(J))
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(M)), np.diag(error)) + np.finfo(float).tiny)
    _, basis = np.linalg.eigh(scale[:, None] * M * scale)
    x = scale * basis[:, 0]
    # x'Mx is itself computed with at most 2(n + m) + 2 roundings per term
    k = 2 * (x.size + 1) * UNIT
    bound = np.abs(x) @ error @ np.abs(x) + 2 * k * (np.abs(x) @ np.abs(M) @ np.abs(x))
    return bool(x @ M @ x < -2 * bound)


def find_storage(G: Exact) -> tuple[Matrix | None, str | None]:
    """(P, None) with a P that proves G strictly positive real, or (None, why there is none).

    P solves the discrete algebraic Riccati equation of G pushed half-way into its margin: D is reduced by
    a part of mu = min over |z| = 1 of the least eigenvalue of He G, and the equation is driven by e I,
    small enough that e |(zI - A)^-1 B|^2 leaves the rest of it.
    """
    block, back = _scaled(G)
    if not block.is_stable():
        return None, "the block has a pole on or outside the unit circle"
    margin, w = _least_eigenvalue(block)
    if margin <= 0:
        return None, f"the condition is violated at {w:.6g} rad/sample"
    if G.order == 0:
        return Matrix.zeros(0, 0), prove_positive_real(G, Matrix.zeros(0, 0))
    reason: str | None = None
    for share in (0.5, 0.9, 0.1):
        try:
            P = _riccati(block, margin, share)
        except (LinAlgError, ValueError) as error:
            reason = f"the Riccati equation has no solution: {error}"
            continue
        stored = _rounded(back[:, None] * P * back)
        reason = prove_positive_real(G, stored)
        if reason is None:
            return stored, None
    return None, reason


def _scaled(G: Exact) -> tuple[Lti, Array]:
    """G in floating point with states and channels of size one, and the factor that undoes the state scaling.

    The size of a state is the largest gain from the scaled inputs to it, over frequency.
    """
    A, B, C, D = (m.floats() for m in (G.A, G.B, G.C, G.D))
    channel = 1 / np.sqrt(np.maximum(np.abs(np.diag(D)), 1e-300))
    B, C, D = B * channel, channel[:, None] * C, channel[:, None] * D * channel
    size = np.linalg.norm(_states(Lti(A, B, C, D, 1.0)), axis=2).max(axis=0)
    size[size == 0] = 1.0
    return Lti(A * size / size[:, None], B / size[:, None], C * size, D, 1.0), 1 / size


def _states(G: Lti) -> NDArray[np.complex128]:
    """(zI - A)^-1 B on a pole-dense grid of the circle, shape (k, n, m)."""
    n, m = G.B.shape
    return Lti(G.A, G.B, np.eye(n), np.zeros((n, m)), G.T).at(on_circle(frequencies(G)))


def _least_eigenvalue(G: Lti) -> tuple[float, float]:
    """(min over the circle of the least eigenvalue of He G, where [rad/sample])."""
    value, w = supremum(
        lambda w: -np.linalg.eigvalsh(hermitian(G.at(on_circle(w))))[:, 0], np.concatenate([[0.0], frequencies(G)])
    )
    return -value, w


def _riccati(G: Lti, margin: float, share: float) -> Array:
    n, m = G.B.shape
    gain = np.linalg.norm(_states(G), 2, axis=(1, 2)).max() ** 2
    drive = (1 - share) * margin / max(gain, 1.0)  # the gain is at least one unless no input reaches any state
    return -solve_discrete_are(G.A, G.B, -drive * np.eye(n), G.D + G.D.T - 2 * share * margin * np.eye(m), s=G.C.T)


def _rounded(P: Array) -> Matrix:
    """P to STORED_BITS binary digits, relative to its diagonal."""
    exponent = np.ceil(np.log2(np.abs(np.diag(P))) / 2)
    scale = np.exp2(-exponent)
    integers = np.round((P + P.T) / 2 * scale[:, None] * scale * 2.0**STORED_BITS)
    n = P.shape[0]
    common = 2 * int(exponent.min())  # every exponent is at least half of this
    num = np.empty((n, n), dtype=object)
    for i in range(n):
        for j in range(n):
            num[i, j] = int(integers[i, j]) << (int(exponent[i] + exponent[j]) - common)
    power = STORED_BITS - common
    return Matrix(num, 1 << power).reduced() if power >= 0 else Matrix(num * (1 << -power))
