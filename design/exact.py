"""Find and check the matrices of proofs over the rationals: definiteness and positive realness in exact arithmetic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import fractions, spend
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design import budgets
from haptic_loop.design.frequency import frequencies, hermitian, on_circle, supremum

# ----------------------------------------------------------------------------------------------------
# Matrices over the rationals: integers over one common denominator, and an exact test for negative minors. A
# floating-point number stands for its shortest decimal, the one that a person wrote in the file: 0.0012 is 12/10000.


_Integers = NDArray[np.object_]


@dataclass(frozen=True, eq=False)
class _Matrix:
    """The rational matrix `num / den`, with integer entries and one positive denominator."""

    num: _Integers  # (p, m), Python integers
    den: int = 1

    @classmethod
    def of(cls, rows: Any, shape: Any = None) -> _Matrix:
        """Convert rows of floats (read as decimals), integers, fractions or strings "p/q" to a matrix of this shape."""
        entries = fractions(rows)
        den = math.lcm(*(v.denominator for v in entries.ravel()))
        num = np.vectorize(lambda v: v.numerator * (den // v.denominator), otypes=[object])(entries)
        return cls(num.reshape(shape or num.shape), den)

    @property
    def shape(self) -> tuple[int, int]:
        return self.num.shape

    def fractions(self) -> NDArray[np.object_]:
        """Return a (p, m) array of Fraction."""
        return np.vectorize(lambda v: Fraction(v, self.den), otypes=[object])(self.num)

    def floats(self) -> NDArray[np.float64]:
        """Return (p, m) floats, every entry correctly rounded."""
        return np.vectorize(lambda v: v / self.den, otypes=[np.float64])(self.num)


#: work [units of `spend`] of a product of two integers, and what each bit of the two integers adds
_LIMBS, _BIT = 5e-9, 3e-11


#: Matrix products with at most this many multiplications of integers (about 21 states) are computed without FLINT,
#: because FLINT is no faster for them, and its import takes 0.05 s.
_FEW = 20_000


def _congruence(X: _Integers, M: _Integers) -> _Integers:
    """Return the exact product X' M X (m, m) of integers X (n, m) and M (n, n). Raises TooLong as `spend` does."""
    (n, m) = X.shape
    products = n * m * (n + m)
    spend(products * (_LIMBS + _BIT * (_longest(X) + _longest(M))))
    if products <= _FEW:
        return X.T @ (M @ X)
    import flint

    right = flint.fmpz_mat(n, m, X.ravel().tolist())
    result = right.transpose() * (flint.fmpz_mat(n, n, M.ravel().tolist()) * right)
    product = np.empty(m * m, dtype=object)
    product[:] = [int(v) for v in result.entries()]
    return product.reshape(m, m)


def negative_minor(S: Any) -> str | None:
    """Return a negative principal minor of the symmetric rational S (m, m) in words, or None if S is semidefinite.

    The elimination S = LDL' is exact. A pivot has the sign of the principal minor of its row and of the rows before it
    that were not skipped. If a pivot is zero, S is semidefinite only if the pivot's entire row in the Schur complement
    is zero; the row is then skipped. Otherwise each nonzero entry of this row makes a principal minor negative.
    """
    work, used = fractions(S).copy(), list[int]()  # `used` are the rows of positive pivots, counted from 1.
    for k in range(len(work)):
        pivot, column = work[k, k], work[k + 1 :, k]
        coupled = np.flatnonzero(column).tolist()
        if pivot > 0:
            used.append(k + 1)
            work[k + 1 :, k + 1 :] -= np.outer(column, column) / pivot
        elif pivot < 0 or coupled:
            rows = [*used, k + 1] if pivot < 0 else [*used, k + 1, k + 2 + coupled[0]]
            if rows == list(range(1, len(rows) + 1)):
                return f"the leading minor of order {len(rows)} is negative"
            return f"the principal minor of rows {', '.join(map(str, rows))} is negative"
    return None


# ----------------------------------------------------------------------------------------------------
# These functions prove that a symmetric rational matrix S is positive definite, by a few matrix products. R'SR > 0
# implies S > 0 for any square R. R is the inverse of the Cholesky factor of S in floating point, rounded to binary
# fractions. R'SR is then nearly the identity, and an exact product shows that its diagonal dominates its rows
# (Gershgorin). Elimination would be exact, too, but its numbers grow with every pivot.


_FACTOR_BITS = 46  # bits of the largest entry of R before its rows are scaled; all entries are multiples of one unit
_GROWTH = 2.0**-40  # multiple of the identity that is added if rounding makes the factorisation fail


def _halves(S: _Matrix) -> list[int]:
    """Return an exponent of two per row. Rows and columns divided by these powers give S a diagonal near one."""
    return [(int(v).bit_length() - S.den.bit_length()) // 2 for v in np.diag(S.num)]


def _rounded(S: _Matrix, half: Sequence[int], bits: int) -> _Integers:
    """Return S with row and column i divided by 2^half[i], rounded to integers in units of 2^-bits."""
    n = S.shape[0]
    rounded = np.empty((n, n), dtype=object)
    for i, row in enumerate(S.num.tolist()):
        for j in range(i + 1):
            rounded[i, j] = rounded[j, i] = _nearest(row[j], S.den, bits - half[i] - half[j])
    return rounded


def _nearest(num: int, den: int, shift: int) -> int:
    """Return 2^shift num/den, rounded to the nearest integer."""
    num, den = (num << shift, den) if shift >= 0 else (num, den << -shift)
    return (2 * num + den) // (2 * den)


def _less(W: _Integers, units: int) -> _Integers:
    """Return W with `units` subtracted from its diagonal."""
    W = W.copy()
    W[np.diag_indices(len(W))] -= units
    return W


def _definite(W: _Integers, bits: int) -> bool:
    """Return whether the symmetric integer matrix W (n, n), in units of 2^-bits, is proved to be positive definite.

    Between two passes all entries lose the same number of low bits, so that the largest entry keeps `bits` + 32 bits.
    Each entry then changes by less than one unit, and the norm of the matrix by less than n units. These n units are
    subtracted from the diagonal.
    """
    for _ in range(budgets.DEFINITE_PASSES):
        floats = _floats(W)
        if _dominates(floats):
            return True
        if (R := _whitening(floats)) is None:
            return False
        W = _congruence(R, W)
        if (dropped := _longest(W) - bits - 32) > 0:
            W = _less(W >> dropped, len(W))
    return _dominates(_floats(W))


def _longest(W: _Integers) -> int:
    return max(map(int.bit_length, W.ravel().tolist()), default=0)


def _dominates(W: Array) -> bool:
    """Return whether every diagonal entry exceeds the sum of the absolute values of the other entries in its row.

    The answer holds for the integers from which `_floats` made W. Rounding changed each integer by at most 2^-53 of
    itself plus 2^-900 of the largest. Rounding changes a sum of n < 2^11 terms by at most the share n 2^-53. The test
    allows for larger changes.
    """
    diagonal = np.diag(W)
    others = np.abs(W).sum(axis=1) - np.abs(diagonal)
    return bool((diagonal > (1 + 2.0**-40) * (others + 2.0**-40 * np.abs(diagonal) + 2.0**-800)).all())


def _floats(W: _Integers) -> Array:
    """Return W in double precision, times a power of two that brings its largest entry near one."""
    longest = _longest(W)
    shift = max(longest - 950, 0)
    return np.ldexp((W >> shift).astype(np.float64), shift - longest)


def _whitening(W: Array) -> _Integers | None:
    """Return R for which R'WR is nearly a multiple of the identity, or None if W is far from definite."""
    diagonal = np.diag(W)
    if not (diagonal > 0).all():
        return None
    # Row i and column i are multiplied by 2^half[i], so that all entries of the diagonal have about the same size.
    half = (np.frexp(diagonal.max())[1] - np.frexp(diagonal)[1]) // 2
    with np.errstate(over="ignore"):
        W = np.ldexp(W, np.add.outer(half, half)) / diagonal.max()
    if not np.isfinite(W).all():  # An entry is far too large for the diagonal.
        return None
    for added in (0.0, _GROWTH):
        try:
            L = np.linalg.cholesky(W + added * np.eye(len(W)))
        except np.linalg.LinAlgError:
            continue
        inverse = np.tril(np.linalg.inv(L)).T
        size = _FACTOR_BITS - np.ceil(np.log2(np.abs(inverse).max()))
        R = np.rint(np.ldexp(inverse, int(size))).astype(np.int64)
        return R.astype(object) << half.astype(object)[:, None]
    return None


# ----------------------------------------------------------------------------------------------------
# Strict positive realness of a block G = (A, B, C, D): a Riccati equation gives P, and exact arithmetic tests P. By the
# Kalman-Yakubovich-Popov lemma (docs/theory.md) G is strictly positive real if P > 0 and
#     [[P - A'PA, C' - A'PB], [C - B'PA, D + D' - B'PB]] > 0                                      (KYP)
# P may be rounded, because any P that satisfies both inequalities is a proof. The errors of all other roundings are
# bounded, and the bounds are subtracted from the diagonal.


_MOST_BITS = 4000  # largest number of bits of a stored P's common denominator; the package stores a few hundred
_STORED_BITS = 48  # bits of each entry of P, relative to its diagonal
_EXTENDED_BITS = 96  # bits of the largest entry of a factor of exact products; x86's extended precision has 64 bits
_LEAST_MOVED = 1e-10  # least eigenvalue of a normalised covariance, relative to the largest; smaller ones are raised
_LEFT = 0.02  # Newton's steps end if the residual of the Riccati equation is below this share of e (`find_storage`)
_UNIT = 2.0**-53  # unit roundoff of double precision
_ACCURACIES = (48, 112), (192, 192)  # for each attempt of a proof: binary digits of P, and of A, B, C and D
_MOST_UNITS = 2.0**50  # A proof is tried only if the error bound of `_kyp_matrix` is below this many units u.
_SAMPLES = 400  # approximate number of frequencies for the sizes of states


def _kyp_matrix(G: Lti, P: _Matrix, bits: int, finer: int) -> tuple[_Integers, float]:
    """Return the matrix of (KYP) in units of u = 2^-finer, and a bound on the norm of its error in these units.

    States and channels are scaled by powers of two, so that P and D + D' have diagonals near one. P is rounded to
    multiples of 2^-bits. The rounded P is known exactly and may itself be a proof. The other matrices are rounded to
    multiples of u, which changes entries of C by u/2, of D + D' by u, and J = [A B] by E with |E_ij| <= u/2. The sum is
    rounded down to multiples of u. Without E the error is therefore less than 2 u per entry and 2 (n + m) u in norm.
    E adds |E'PJ + J'PE + E'PE| <= (2 |J| + |E|) |E| |P| in the Frobenius norm. The factor 1.02 covers the rounding of
    this bound in floating point.
    """
    n, m = G.B.shape
    state, channel = _halves(P), _halves(_Matrix.of(G.D + G.D.T))

    def rounded(part: Any, rows: Sequence[int], columns: Sequence[int]) -> _Integers:
        numbers = np.zeros(part.shape, dtype=object)
        for i, j in zip(*np.nonzero(part), strict=True):
            v = part[i, j]
            numbers[i, j] = _nearest(v.numerator, v.denominator, finer + rows[i] - columns[j])
        return numbers

    storage = _rounded(P, state, bits)
    J = rounded(np.hstack([G.A, G.B]), state, [*state, *channel])
    C = rounded(G.C, minus := [-h for h in channel], state)
    D = rounded(G.D, minus, channel)
    W = -_congruence(J, storage)  # in units of 2^-bits u^2, like the following terms
    W[:n, :n] += storage << 2 * finer
    W[n:, :n] += C << bits + finer
    W[:n, n:] += C.T << bits + finer
    W[n:, n:] += (D + D.T) << bits + finer
    p, j = (
        float(np.linalg.norm(_floats(part)) * 2.0 ** (_longest(part) - unit))
        for part, unit in ((storage, bits), (J, finer))
    )
    e = 0.5 * math.sqrt(n * (n + m))
    return W >> bits + finer, 2.0 * (n + m) + 1.02 * e * p * (2 * j + e * 2.0**-finer)


def _prove_positive_real(G: Lti, P: _Matrix) -> str | None:
    """Return None if P proves that G is strictly positive real, else the reason. Floating point can only refuse."""
    n = G.order
    if P.shape != (n, n):
        return f"P has shape {P.shape}, the block has {n} states"
    if not (P.num == P.num.T).all():
        return "P is not symmetric"
    if _refuted_in_floating_point(G, P):
        return "the KYP matrix has a negative direction, beyond the error bound of floating point"
    if any(v <= 0 for v in np.diag(G.D)):
        return "D + D' is not positive definite"
    at_fault = "P"
    for bits, finer in _ACCURACIES if all(v > 0 for v in np.diag(P.num)) else ():
        if _definite(_rounded(P, _halves(P), bits), bits):
            at_fault = "the KYP matrix"
            W, units = _kyp_matrix(G, P, bits, finer)
            if units < _MOST_UNITS and _definite(_less(W, math.ceil(units)), finer):
                return None
    return f"{at_fault} is not positive definite, or too close to singular for a proof"


def _refuted_in_floating_point(G: Lti, P: _Matrix) -> bool:
    """Return whether a direction makes the KYP matrix negative by more than every rounding error.

    The matrix is S - J'PJ with S = [[P, C'], [C, D + D']] and J = [A B]. Its entries are sums of products of three
    correctly rounded numbers. The error of each entry is at most gamma (|S| + |J|'|P||J|),
    gamma = (2n + 8) u / (1 - (2n + 8) u).
    """
    F, p = G.floats(), P.floats()
    A, B, C, D = F.A, F.B, F.C, F.D
    J = np.hstack([A, B])
    with np.errstate(all="ignore"):
        direct = np.block([[p, C.T], [C, D + D.T]])
        M = direct - J.T @ p @ J
    if not np.isfinite(M).all():
        return False
    k = (2 * G.order + 8) * _UNIT
    error = k / (1 - k) * (np.abs(direct) + np.abs(J.T) @ np.abs(p) @ np.abs(J))
    scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(M)), np.diag(error)) + np.finfo(float).tiny)
    _, basis = np.linalg.eigh(scale[:, None] * M * scale)
    x = scale * basis[:, 0]
    # The computation of x'Mx has at most 2(n + m) + 2 roundings per term.
    k = 2 * (x.size + 1) * _UNIT
    bound = np.abs(x) @ error @ np.abs(x) + 2 * k * (np.abs(x) @ np.abs(M) @ np.abs(x))
    return bool(x @ M @ x < -2 * bound)


def _reached(G: Lti) -> Lti:
    """Return the same map without the states that stay zero because, by the pattern of A and B, no input moves them."""
    reached_states = np.array([any(row) for row in G.B != 0], dtype=bool)
    pattern = (G.A != 0).astype(bool)
    while (more := reached_states | (pattern & reached_states).any(axis=1)).sum() > reached_states.sum():
        reached_states = more
    if reached_states.all():
        return G
    return Lti(G.A[np.ix_(reached_states, reached_states)], G.B[reached_states], G.C[:, reached_states], G.D, G.T)


class Violated(str):
    """The reason why a block cannot have a proof: it is negative beyond rounding at some frequency."""


_CLEARLY = 1e-6  # A margin below -1e-6 is no rounding error, because the scaled block has ones on the diagonal of D.


def find_storage(G: Lti) -> tuple[_Matrix | None, str | None]:
    """Return (P, None) with a P that proves G strictly positive real, or (None, reason).

    P is over the states that an input reaches (`_reached`). It solves the discrete algebraic Riccati equation of G with
    D reduced by a share of the margin mu, the minimum over |z| = 1 of the least eigenvalue of He G. The equation has an
    added term e I, where e |(zI - A)^-1 B|^2 is at most the rest of mu. Up to three attempts solve the equation:
     1. in coordinates in which white noise at the inputs moves all states equally and independently, because P is
        better conditioned there,
     2. in the original states,
     3. in the coordinates of the first attempt, with a larger share of mu.
    The result is transformed back exactly, and rounded to _STORED_BITS if the rounded P is still a proof.
    """
    if not G.floats().is_stable():
        return None, "the block has a pole on or outside the unit circle"
    G = _reached(G)
    parts, half = _scaled(G)
    block = _double(parts)
    margin, w = _least_eigenvalue(block)
    if margin <= 0:
        kind = Violated if margin < -_CLEARLY else str
        return None, kind(f"the condition is violated at {w:.6g} rad/sample")
    if G.order == 0:
        empty = _Matrix(np.zeros((0, 0), dtype=object))
        reason = _prove_positive_real(G, empty)
        return None if reason else empty, reason
    reason = None
    for share, white in ((0.5, True), (0.5, False), (0.9, True)):
        try:
            out, riccati = _solved(parts, margin, share, white)
        except np.linalg.LinAlgError as error:
            reason = f"the Riccati equation has no solution: {error}"
            continue
        P = _congruent(out, riccati, half)
        for stored in (_shortened(P), P):
            reason = _prove_positive_real(G, stored)
            if reason is None:
                return stored, None
    return None, reason


def _solved(parts: _Parts, margin: float, share: float, white: bool) -> tuple[Array, Array]:
    """Return (a change of coordinates, P in the new coordinates). Raises LinAlgError.

    If `white`, white noise at the inputs moves the new states equally and independently. Otherwise the states stay.
    """
    (A, B, C, D), G = parts, _double(parts)
    with np.errstate(all="ignore"):
        out, into = _independent(_doubled(G.A, G.B @ G.B.T)) if white else (np.eye(G.order),) * 2
        into = into @ (2 * np.eye(G.order) - out.astype(np.longdouble) @ into)  # out^-1, to more than double precision
        return out, _riccati((out @ A @ into, out @ B, C @ into, D), margin, share)


_Parts = tuple[Array, Array, Array, Array]  # A, B, C, D in extended precision


def _double(parts: _Parts) -> Lti:
    A, B, C, D = (part.astype(np.float64) for part in parts)
    return Lti(A, B, C, D, 1.0)


def _extended(M: Any) -> Array:
    """Return Fractions or floats in extended precision, which has 64 binary digits on some machines."""
    extended = np.asarray(M, dtype=np.float64).astype(np.longdouble)
    if M.dtype == object:
        for place in zip(*np.nonzero(M), strict=True):
            extended[place] += float(M[place] - Fraction(float(extended[place])))
    return extended


def _scaled(G: Lti) -> tuple[_Parts, NDArray[np.int64]]:
    """Return G with states and channels of about size one, and the exponents of the powers of two for its states."""
    A, B, C, D = map(_extended, (G.A, G.B, G.C, G.D))
    channel = 1 / np.sqrt(np.maximum(np.abs(np.diag(D)), np.longdouble(1e-300)))
    B, C, D = B * channel, channel[:, None] * C, channel[:, None] * D * channel
    size = np.linalg.norm(_states(_double((A, B, C, D))), axis=2).max(axis=0)
    half = np.frexp(np.where(size > 0, size, 1.0))[1].astype(np.int64)
    size = np.exp2(half)
    return (A * size / size[:, None], B / size[:, None], C * size, D), half


def _states(G: Lti) -> NDArray[np.complex128]:
    """Return (zI - A)^-1 B (k, n, m) on a grid of the circle that is dense near the poles, to estimate sizes."""
    n, m = G.B.shape
    w = frequencies(G, points=100)
    return Lti(G.A, G.B, np.eye(n), np.zeros((n, m)), G.T).at(on_circle(w[:: 1 + w.size // _SAMPLES]))


def _least_eigenvalue(G: Lti) -> tuple[float, float]:
    """Return the least eigenvalue of He G over the circle, and its frequency [rad/sample]."""
    # `supremum` refines peaks within a fifth of the largest. A small eigenvalue lambda is such a peak of 1 - lambda.
    value, w = supremum(
        lambda w: 1 - np.linalg.eigvalsh(hermitian(G.at(on_circle(w))))[:, 0], np.concatenate([[0.0], frequencies(G)])
    )
    return 1 - value, w


def _independent(covariance: Array) -> tuple[Array, Array]:
    """Return the matrix that changes to coordinates with the covariance I, and the inverse of this matrix."""
    variance = np.diag(covariance)
    deviation = np.sqrt(np.maximum(variance, variance.max() * _UNIT))  # Small variances may be rounding errors.
    size, V = np.linalg.eigh(covariance / np.outer(deviation, deviation))
    root = np.sqrt(np.maximum(size, size[-1] * _LEAST_MOVED))
    return (V / root).T / deviation, deviation[:, None] * V * root


def _riccati(parts: _Parts, margin: float, share: float) -> Array:
    """Return the solution P (n, n) of the Riccati equation of `find_storage`, by doubling and Newton's method.

    Newton's steps in extended precision reduce the residual that rounding leaves. They end when it is below _LEFT times
    e, or after RICCATI_STEPS steps. Raises LinAlgError if there is no solution.
    """
    G, (A, B, C, _) = _double(parts), parts
    one = np.eye(G.order)
    gain = np.linalg.norm(_states(G), 2, axis=(1, 2)).max() ** 2
    drive = (1 - share) * margin / max(gain, 1.0)
    R = G.D + G.D.T - 2 * share * margin * np.eye(G.inputs)
    BR = np.linalg.solve(R, G.B.T).T
    P = -_doubled(G.A - BR @ G.C, -drive * one - G.C.T @ np.linalg.solve(R, G.C), BR @ G.B.T)
    P = P.astype(np.longdouble)
    for _ in range(budgets.RICCATI_STEPS):
        PA = P @ A
        cross, gap = C - B.T @ PA, R - B.T @ P @ B
        feedback = np.linalg.solve(gap.astype(float), cross.astype(float))  # The residual is second order in its error.
        half = cross.T @ feedback
        left = A.T @ PA - P + half + half.T - feedback.T @ gap @ feedback + drive * one
        if np.abs(left).max() < _LEFT * drive:
            break
        P = P + _doubled((G.A - G.B @ feedback).T, ((left + left.T) / 2).astype(float))
    return P


def _doubled(A: Array, H: Array, S: Array | None = None) -> Array:
    """Return the limit of X <- H + A'X (I + S X)^-1 A, or without S of X <- H + A X A', from 0. Raises LinAlgError."""
    one = np.eye(len(A))
    for _ in range(budgets.DOUBLINGS):
        if S is None:
            step, A = A @ H @ A.T, A @ A
        else:
            both = np.linalg.solve(one + S @ H, np.hstack([A, S]))
            after, through = both[:, : len(A)], both[:, len(A) :]
            step, S, A = A.T @ H @ after, S + A @ through @ A.T, A @ after
            S = (S + S.T) / 2
        H = H + (step + step.T) / 2
        if not np.isfinite(H).all():
            break
        if np.abs(step).max() <= _UNIT * np.abs(H).max():
            return H
    raise np.linalg.LinAlgError("doubling did not converge")


def _congruent(out: Array, P: Array, half: NDArray[np.int64]) -> _Matrix:
    """Return out' P out with row i and column i divided by 2^half[i]. Only `out` and P are rounded."""

    def integers(a: Array) -> tuple[_Integers, int]:
        power = _EXTENDED_BITS - int(np.frexp(np.abs(a).max())[1])
        return np.vectorize(int, otypes=[object])(np.rint(np.ldexp(a, power))), power

    (left, one), (middle, other) = integers(out), integers((P + P.T) / 2)
    return _divided(_congruence(left, middle), half, 2 * one + other)


def _divided(numbers: _Integers, half: Sequence[int] | NDArray[np.int64], power: int) -> _Matrix:
    """Return numbers/2^power in lowest terms, with row i and column i divided by 2^half[i] for all i."""
    most = int(max(half))
    for i, row in enumerate(numbers):
        for j in range(len(row)):
            row[j] <<= 2 * most - int(half[i]) - int(half[j])
    power += 2 * most
    if power < 0:
        return _Matrix(numbers << -power)
    common = math.gcd(1 << power, *numbers.ravel())
    return _Matrix(numbers // common, (1 << power) // common)


def _shortened(P: _Matrix) -> _Matrix:
    """Return P rounded to _STORED_BITS relative to its diagonal; unchanged if the diagonal is not positive."""
    if any(v <= 0 for v in np.diag(P.num)):
        return P
    half = _halves(P)
    return _divided(_rounded(P, half, _STORED_BITS), [-h for h in half], _STORED_BITS)


_Rows = tuple[tuple[str, ...], ...]


def rows_of(M: _Matrix) -> _Rows:
    """Return every entry as a text "p/q" in lowest terms, or "p" for an integer."""
    return tuple(tuple(str(value) for value in row) for row in M.fractions())


def refuted_rows(name: str, block: Lti, rows: Sequence[Sequence[str]]) -> str | None:
    """Return the reason why the named matrix does not prove that the block is strictly positive real, or None."""
    block = _reached(block)
    n = block.order
    if len(rows) != n:
        return f"{name} has {len(rows)} rows, the block has {n} states"
    if ragged := [len(row) for row in rows if len(row) != n]:
        return f"{name} has a row of {ragged[0]} entries, the block has {n} states"
    try:
        common = 1
        for value in (value for row in rows for value in row):
            common = math.lcm(common, int(value.partition("/")[2] or 1))
            if common.bit_length() > _MOST_BITS:
                return f"{name} has a common denominator of more than {_MOST_BITS} bits: testing it would take minutes"
        P = _Matrix.of(rows, (n, n))
    except (ValueError, ZeroDivisionError) as error:
        return f"{name} has an entry that is not a rational number: {error}"
    try:
        return _prove_positive_real(block, P)
    except OverflowError:
        return f"{name} has an entry beyond the range of floating point"
