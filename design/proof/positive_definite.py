"""A proof that a symmetric rational matrix S is positive definite, whose cost is that of a few products.

Floating point proposes, integers decide: for any matrix R, R'SR > 0 implies S > 0 (x = R y; R'SR could not be
definite if R lost a direction). R is the inverse of the Cholesky factor of S in floating point, rounded to binary
fractions; then R'SR is nearly the identity, and an exact product shows that its diagonal dominates its rows
(Gershgorin). Elimination would be exact too, but its numbers grow with every pivot.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from design.proof.rational import Integers, Matrix

BITS = 192  # of the rounded matrix whose definiteness is tested
FACTOR_BITS = 56  # of the entries of each factor of R, relative to the largest of their column
PASSES = 4  # one is enough for a condition number below 1e14; each further one takes as much off what is left
GROWTH = 2.0**-40  # part of the identity that is added where rounding has made the factorisation fail

Floats = NDArray[np.float64]


def strictly_positive(S: Matrix) -> bool:
    """Whether S > 0 is proved, for an exactly symmetric S (n, n).

    S is scaled by powers of two to a diagonal near one and every entry rounded to a multiple of 2^-BITS. The error is
    at most 2^-BITS / 2 per entry, hence n 2^-BITS in norm, which is taken off the diagonal. The numbers in the products
    stay short however long those of S are. Raises ValueError if S is not exactly symmetric.
    """
    if not (S.num == S.num.T).all():
        raise ValueError(f"a {S.shape[0]} x {S.shape[1]} matrix is not exactly symmetric")
    n = S.shape[0]
    if any(S.num[i, i] <= 0 for i in range(n)):
        return False
    W = _rounded(S) - n * np.eye(n, dtype=object)
    for _ in range(PASSES):
        if _dominates(W):
            return True
        R = _whitening(_floats(W))
        if R is None:
            return False
        W = R.T @ W @ R
    return _dominates(W)


def _rounded(S: Matrix) -> Integers:
    """S with a diagonal near one, in units of 2^-BITS."""
    n = S.shape[0]
    half = [(int(S.num[i, i]).bit_length() - S.den.bit_length()) // 2 for i in range(n)]
    rounded = np.empty((n, n), dtype=object)
    for i in range(n):
        for j in range(i + 1):
            shift = BITS - half[i] - half[j]
            num, den = int(S.num[i, j]) << max(shift, 0), S.den << max(-shift, 0)
            rounded[i, j] = rounded[j, i] = (2 * num + den) // (2 * den)
    return rounded


def _dominates(W: Integers) -> bool:
    """Whether every diagonal entry is larger than the sum of the absolute values of the others in its row."""
    return all(2 * W[i, i] > sum(abs(v) for v in row) for i, row in enumerate(W))


def _floats(W: Integers) -> Floats:
    """W to double precision, times the power of two that brings its largest entry near one."""
    length = max((int(v).bit_length() for v in W.flat), default=0)
    return np.array([[int(v) / (1 << length) for v in row] for row in W], dtype=np.float64).reshape(W.shape)


def _whitening(W: Floats) -> Integers | None:
    """R in integers such that R'WR is nearly a multiple of the identity, or None where W is far from definite."""
    with np.errstate(all="ignore"):
        scale = 1 / np.sqrt(np.diag(W)) if (np.diag(W) > 0).all() else np.ones(W.shape[0])
        unit = scale[:, None] * W * scale
    if not np.isfinite(unit).all():  # entries beyond all proportion to the diagonal
        return None
    for added in (0.0, GROWTH):
        try:
            L = cholesky(unit + added * np.eye(W.shape[0]), lower=True)
        except LinAlgError:
            continue
        inverse = scale[:, None] * solve_triangular(L, np.eye(W.shape[0]), lower=True).T
        size = FACTOR_BITS - np.ceil(np.log2(np.abs(inverse).max()))
        return np.vectorize(int, otypes=[object])(np.round(np.ldexp(inverse, int(size))))
    return None
