"""Exact arithmetic: definiteness and positive realness over the rationals, and a proof's matrix as a file holds it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from controller.arithmetic import on_time, rational
from controller.lti import Array, Lti
from design.frequency import frequencies, hermitian, on_circle, supremum
from design.result import NotProved, Requirement

# ----------------------------------------------------------------------------------------------------
# Matrices over the rationals: integers over one common denominator, and exact tests of definiteness.
#
# A stored floating-point number stands for its shortest decimal, the one that a person wrote in the file: 0.0012 is
# 12/10000 here, not the nearest binary fraction. Everything after that is exact.


_Integers = NDArray[np.object_]
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Matrix:
    """`num / den` with integer entries and one positive denominator."""

    num: _Integers  # (p, m), Python integers
    den: int = 1

    @classmethod
    def of(cls, rows: Any, shape: Any = None) -> Matrix:
        """From rows of floats (read as decimals), integers, fractions or strings "p/q"."""
        entries = [[rational(v) for v in row] for row in rows]
        shape = shape or getattr(rows, "shape", None) or (len(entries), len(entries[0]) if entries else 0)
        den = math.lcm(*(v.denominator for row in entries for v in row))
        num = np.empty(shape, dtype=object)
        for i, row in enumerate(entries):
            for j, v in enumerate(row):
                num[i, j] = v.numerator * (den // v.denominator)
        return cls(num, den)

    @classmethod
    def eye(cls, n: int) -> Matrix:
        return cls(np.eye(n, dtype=object))

    @classmethod
    def zeros(cls, rows: int, columns: int) -> Matrix:
        return cls(np.zeros((rows, columns), dtype=object))

    @classmethod
    def diag(cls, values: Iterable) -> Matrix:
        return block_diag(*(cls.of([[v]]) for v in values))

    @property
    def shape(self) -> tuple[int, int]:
        return self.num.shape

    @property
    def T(self) -> Matrix:
        return Matrix(self.num.T, self.den)

    def reduced(self) -> Matrix:
        """The same matrix in lowest terms."""
        common = math.gcd(self.den, *self.num.ravel())
        return self if common == 1 else Matrix(self.num // common, self.den // common)

    def __matmul__(self, other: Matrix) -> Matrix:
        return Matrix(_product(self.num, other.num), self.den * other.den).reduced()

    def __add__(self, other: Matrix) -> Matrix:
        den = math.lcm(self.den, other.den)
        return Matrix(self.num * (den // self.den) + other.num * (den // other.den), den)

    def __neg__(self) -> Matrix:
        return Matrix(-self.num, self.den)

    def __sub__(self, other: Matrix) -> Matrix:
        return self + (-other)

    def scaled(self, factor: float | int | Fraction) -> Matrix:
        """This matrix times a number."""
        f = rational(factor)
        return Matrix(self.num * f.numerator, self.den * f.denominator).reduced()

    def fractions(self) -> NDArray[np.object_]:
        """(p, m) array of Fraction."""
        return np.array([[Fraction(int(v), self.den) for v in row] for row in self.num], dtype=object).reshape(
            self.shape
        )

    def floats(self) -> NDArray[np.float64]:
        """(p, m), every entry correctly rounded."""
        return np.array([[int(v) / self.den for v in row] for row in self.num], dtype=np.float64).reshape(self.shape)

    def equals(self, other: Matrix) -> bool:
        return self.shape == other.shape and bool((self.num * other.den == other.num * self.den).all())


_FEW = 4000  # products of numbers: below that they are made one by one
_DIGIT = 16  # bits


def _product(a: _Integers, b: _Integers) -> _Integers:
    """a @ b, exactly, by an eighth of the time that Python's integers take of a hundred rows.

    Their digits are multiplied as floating point numbers: every sum of such products is a whole number below 2^53,
    and so is exact in any order.
    """
    on_time()
    (n, inner), m = a.shape, b.shape[1]
    if a.size * m < _FEW or inner >= 1 << 20:
        return a @ b
    left, right = _digits(a), _digits(b)  # (digits, rows, columns)
    beside = right.transpose(1, 0, 2).reshape(inner, -1)
    sums = np.zeros((len(left) + len(right) + 2, n, m), dtype=np.int64)
    for i, digit in enumerate(left):
        sums[i : i + len(right)] += (digit @ beside).astype(np.int64).reshape(n, len(right), m).transpose(1, 0, 2)
    for low, high in itertools.pairwise(sums):  # carries; the last digit keeps the sign
        high += low >> _DIGIT
        low &= (1 << _DIGIT) - 1
    numbers = np.ascontiguousarray(sums.transpose(1, 2, 0)).astype("<u2").tobytes()
    size = 2 * len(sums)
    found = [int.from_bytes(numbers[i : i + size], "little", signed=True) for i in range(0, len(numbers), size)]
    return np.array(found, dtype=object).reshape(n, m)


def _digits(a: _Integers) -> Floats:
    """Of every entry, (digits, ..): in base 2^16 from the lowest on, all but the last one positive."""
    size = 2 * (max(int(v).bit_length() for v in a.flat) // _DIGIT + 1)
    numbers = b"".join(int(v).to_bytes(size, "little", signed=True) for v in a.flat)
    digits = np.frombuffer(numbers, dtype="<u2").reshape(*a.shape, -1).astype(np.float64)
    digits[..., -1] -= (digits[..., -1] >= 1 << (_DIGIT - 1)) * float(1 << _DIGIT)
    return np.ascontiguousarray(np.moveaxis(digits, -1, 0))


def block(rows: Sequence[Sequence[Matrix]]) -> Matrix:
    """A matrix made of blocks, like numpy.block."""
    den = math.lcm(*(b.den for row in rows for b in row))
    return Matrix(np.block([[b.num * (den // b.den) for b in row] for row in rows]), den)


def block_diag(*parts: Matrix) -> Matrix:
    """The parts along the diagonal."""
    return block([[p if i == j else Matrix.zeros(p.shape[0], q.shape[1]) for j, q in enumerate(parts)]
                  for i, p in enumerate(parts)])  # fmt: skip


@dataclass(frozen=True)
class _Definiteness:
    """What the exact elimination of a symmetric matrix found."""

    definite: bool
    semidefinite: bool
    minor: int | None = None  # order of the first leading minor that is not positive, 1-based
    sign: int | None = None  # its sign: -1, or 0

    def __str__(self) -> str:
        if self.definite:
            return "positive definite"
        sign = "negative" if self.sign == -1 else "zero"
        return f"the leading minor of order {self.minor} is {sign}"


_MANY_ROWS = 8


def definiteness(S: Matrix) -> _Definiteness:
    """Whether the symmetric matrix S is positive (semi)definite, by fraction-free LDL' (Bareiss).

    The pivots of the elimination are the leading minors themselves. A zero pivot leaves a semidefinite
    matrix only if its whole row of the Schur complement is zero; that row is then passed over. A large matrix is tried
    by `strictly_positive` first. Raises ValueError if S is not exactly symmetric.
    """
    if S.shape[0] > _MANY_ROWS and strictly_positive(S):
        return _Definiteness(True, True)
    work = S.reduced().num.copy()
    if not (work == work.T).all():
        raise ValueError(f"a {S.shape[0]} x {S.shape[1]} matrix is not exactly symmetric")
    previous, singular = 1, None
    for k in range(work.shape[0]):
        pivot, column = work[k, k], work[k + 1 :, k].copy()
        if pivot < 0:
            return _Definiteness(False, False, k + 1, -1)
        if pivot == 0:
            if (column != 0).any():
                return _Definiteness(False, False, k + 1, 0)
            singular = singular or k + 1
            continue
        work[k + 1 :, k + 1 :] = (pivot * work[k + 1 :, k + 1 :] - np.outer(column, column)) // previous
        previous = pivot
    return _Definiteness(singular is None, True, singular, None if singular is None else 0)


# ----------------------------------------------------------------------------------------------------
# A proof that a symmetric rational matrix S is positive definite, whose cost is that of a few products.
#
# Floating point proposes, integers decide: for any matrix R, R'SR > 0 implies S > 0 (x = R y; R'SR could not be
# definite if R lost a direction). R is the inverse of the Cholesky factor of S in floating point, rounded to binary
# fractions; then R'SR is nearly the identity, and an exact product shows that its diagonal dominates its rows
# (Gershgorin). Elimination would be exact too, but its numbers grow with every pivot.


BITS = 192  # of the rounded matrix whose definiteness is tested
_FACTOR_BITS = 56  # of the entries of each factor of R, relative to the largest of their column
_PASSES = 4  # one is enough for a condition number below 1e14; each further one takes as much off what is left
GROWTH = 2.0**-40  # part of the identity that is added where rounding has made the factorisation fail


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
    for _ in range(_PASSES):
        if _dominates(W):
            return True
        R = _whitening(_floats(W))
        if R is None:
            return False
        W = _product(_product(R.T, W), R)
    return _dominates(W)


def _rounded(S: Matrix) -> _Integers:
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


def _dominates(W: _Integers) -> bool:
    """Whether every diagonal entry is larger than the sum of the absolute values of the others in its row."""
    return all(2 * W[i, i] > sum(abs(v) for v in row) for i, row in enumerate(W))


def _floats(W: _Integers) -> Floats:
    """W to double precision, times the power of two that brings its largest entry near one."""
    length = max((int(v).bit_length() for v in W.flat), default=0)
    return np.array([[int(v) / (1 << length) for v in row] for row in W], dtype=np.float64).reshape(W.shape)


def _whitening(W: Floats) -> _Integers | None:
    """R in integers such that R'WR is nearly a multiple of the identity, or None where W is far from definite."""
    with np.errstate(all="ignore"):
        scale = 1 / np.sqrt(np.diag(W)) if (np.diag(W) > 0).all() else np.ones(W.shape[0])
        unit = scale[:, None] * W * scale
    if not np.isfinite(unit).all():  # entries beyond all proportion to the diagonal
        return None
    for added in (0.0, GROWTH):
        try:
            L = scipy.linalg.cholesky(unit + added * np.eye(W.shape[0]), lower=True)
        except np.linalg.LinAlgError:
            continue
        inverse = scale[:, None] * scipy.linalg.solve_triangular(L, np.eye(W.shape[0]), lower=True).T
        size = _FACTOR_BITS - np.ceil(np.log2(np.abs(inverse).max()))
        return np.vectorize(int, otypes=[object])(np.round(np.ldexp(inverse, int(size))))
    return None


# ----------------------------------------------------------------------------------------------------
# Strict positive realness of a block G = (A, B, C, D): found by a Riccati equation, proved in exact arithmetic.
#
# Kalman-Yakubovich-Popov: if P > 0 and
#     [[P - A'PA, C' - A'PB], [C - B'PA, D + D' - B'PB]] > 0                                      (KYP)
# then A is stable (x'Px falls along x+ = Ax, by the first block) and He G > 0 on the whole unit circle,
# because [(zI - A)^-1 B; I] maps the matrix of (KYP) to G + G* there. Both inequalities are tested exactly.


LARGEST = 300  # states of a model that a proof is tried for: 0.1 s at 50, 0.5 s at 100, 3 s at 200
_MOST_BITS = 4000  # of the common denominator of a stored P, a power of two of some hundred bits when we made it
_STORED_BITS = 44  # of each entry of P, relative to its diagonal
_UNIT = 2.0**-53  # of double precision
_BINARY = 120  # binary digits behind the point of a matrix that is multiplied without rounding
_SAMPLES = 400  # frequencies at which states are looked at, about
_LONG = 80  # states from which on one solution of the Riccati equation has not been enough


def _kyp_matrix(G: Lti, P: Matrix) -> Matrix:
    """The matrix of (KYP), exactly, shape (n + m, n + m)."""
    A, B, C, D = (Matrix.of(getattr(G, name)) for name in "ABCD")
    PA, PB = P @ A, P @ B
    cross = C - B.T @ PA
    return block([[P - A.T @ PA, cross.T], [cross, D + D.T - B.T @ PB]])


def too_large(states: int) -> str | None:
    """Why no proof is tried for a model of so many states, or None."""
    if states <= LARGEST:
        return None
    return f"a proof over {states} states takes long: up to {LARGEST} are tried"


def require_size(states: int, requirement: Requirement | None = None) -> None:
    """Raises NotProved where exact arithmetic over so many states would take minutes."""
    if reason := too_large(states):
        raise NotProved(reason, requirement)


def prove_positive_real(G: Lti, P: Matrix) -> str | None:
    """None if P proves that G is strictly positive real, otherwise why it does not.

    Floating point with an a-priori error bound may refuse early; only exact arithmetic accepts.
    """
    n = G.order
    if P.shape != (n, n):
        return f"P has shape {P.shape}, the model has {n} states"
    if not P.equals(P.T):
        return "P is not symmetric"
    if _refuted_in_floating_point(G, P):
        return "the KYP matrix has a negative direction, beyond the error bound of floating point"
    for name, matrix in (("P", P), ("the KYP matrix", _kyp_matrix(G, P))):
        if not strictly_positive(matrix):
            return f"{name} is not positive definite, or by so little that it is not proved"
    return None


def _refuted_in_floating_point(G: Lti, P: Matrix) -> bool:
    """Whether some direction makes the KYP matrix negative by more than every rounding error.

    The matrix is S - J'PJ with S = [[P, C'], [C, D + D']] and J = [A B], sums of products of three correctly
    rounded numbers: entry by entry the computed one is within gamma (|S| + |J|'|P||J|),
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
    # x'Mx is itself computed with at most 2(n + m) + 2 roundings per term
    k = 2 * (x.size + 1) * _UNIT
    bound = np.abs(x) @ error @ np.abs(x) + 2 * k * (np.abs(x) @ np.abs(M) @ np.abs(x))
    return bool(x @ M @ x < -2 * bound)


def reached(G: Lti) -> Lti:
    """The same map over the states that an input reaches, by the pattern of A and B; from rest the others stay zero.

    Behind a contact that is lost a filter's states are such. No equation of Riccati is in need of them.
    """
    found = np.array([any(row) for row in G.B != 0], dtype=bool)
    pattern = (G.A != 0).astype(bool)
    while (more := found | (pattern & found).any(axis=1)).sum() > found.sum():
        found = more
    if found.all():
        return G
    return Lti(G.A[np.ix_(found, found)], G.B[found], G.C[:, found], G.D, G.T)


def find_storage(G: Lti) -> tuple[Matrix | None, str | None]:
    """(P, None) with a P that proves G strictly positive real, or (None, why there is none).

    P is over the states that an input reaches (`reached`).
    P solves the discrete algebraic Riccati equation of G pushed half-way into its margin: D is reduced by
    a part of mu = min over |z| = 1 of the least eigenvalue of He G, and the equation is driven by e I,
    small enough that e |(zI - A)^-1 B|^2 leaves the rest of it. Where P is so ill-conditioned that rounding its
    entries loses the proof (delays of sixteen samples beside slow poles), it is kept as the exact product of the
    solution in good coordinates and these coordinates, in entries of some 250 binary digits.
    """
    if not G.floats().is_stable():
        return None, "the block has a pole on or outside the unit circle"
    G = reached(G)
    block, back = _scaled(G)
    margin, w = _least_eigenvalue(block)
    if margin <= 0:
        return None, f"the condition is violated at {w:.6g} rad/sample"
    if G.order == 0:
        return Matrix.zeros(0, 0), prove_positive_real(G, Matrix.zeros(0, 0))
    reason: str | None = None
    rounded = ((0.5, False, False), (0.5, True, False), (0.9, True, False), (0.1, True, False))[G.order > _LONG :]
    for share, again, whole in (*rounded, (0.5, True, True)):
        try:
            P, out = _riccati(block, margin, share, again)
        except (np.linalg.LinAlgError, ValueError) as error:
            reason = f"the Riccati equation has no solution: {error}"
            continue
        out = out * back
        stored = _congruent(out, P) if whole else _rounded_positive_real(out.T @ P @ out)
        reason = prove_positive_real(G, stored)
        if reason is None:
            return stored, None
    return None, reason


def _scaled(G: Lti) -> tuple[Lti, Array]:
    """G in floating point with states and channels of size one, and the factor that undoes the state scaling.

    The size of a state is the largest gain from the scaled inputs to it, over frequency.
    """
    F = G.floats()
    A, B, C, D = F.A, F.B, F.C, F.D
    channel = 1 / np.sqrt(np.maximum(np.abs(np.diag(D)), 1e-300))
    B, C, D = B * channel, channel[:, None] * C, channel[:, None] * D * channel
    size = np.linalg.norm(_states(Lti(A, B, C, D, 1.0)), axis=2).max(axis=0)
    size[size == 0] = 1.0
    return Lti(A * size / size[:, None], B / size[:, None], C * size, D, 1.0), 1 / size


def _states(G: Lti) -> NDArray[np.complex128]:
    """(zI - A)^-1 B on a grid of the circle that knows the poles, shape (k, n, m): for the size of things."""
    n, m = G.B.shape
    w = frequencies(G, points=100)
    return Lti(G.A, G.B, np.eye(n), np.zeros((n, m)), G.T).at(on_circle(w[:: 1 + w.size // _SAMPLES]))


def _least_eigenvalue(G: Lti) -> tuple[float, float]:
    """(min over the circle of the least eigenvalue of He G, where [rad/sample])."""
    value, w = supremum(  # of 1 - lambda: `supremum` refines what is within a fifth of the largest, little near zero
        lambda w: 1 - np.linalg.eigvalsh(hermitian(G.at(on_circle(w))))[:, 0], np.concatenate([[0.0], frequencies(G)])
    )
    return 1 - value, w


def _riccati(G: Lti, margin: float, share: float, again: bool) -> tuple[Array, Array]:
    """(P of the equation in coordinates x' = out x, out): `again` in those where it is nearly I, which takes off what
    rounding has left.
    """
    n, m = G.B.shape
    gain = np.linalg.norm(_states(G), 2, axis=(1, 2)).max() ** 2
    drive = (1 - share) * margin / max(gain, 1.0)  # the gain is at least one unless no input reaches any state
    R = G.D + G.D.T - 2 * share * margin * np.eye(m)
    P = -scipy.linalg.solve_discrete_are(G.A, G.B, -drive * np.eye(n), R, s=G.C.T)
    if not again:
        return P, np.eye(n)
    size, V = np.linalg.eigh(P)
    root = np.sqrt(np.maximum(size, size[-1] * 1e-16))
    into, out = V / root, (V * root).T
    better = -scipy.linalg.solve_discrete_are(out @ G.A @ into, out @ G.B, -drive * into.T @ into, R, s=(G.C @ into).T)
    return better, out


def _congruent(out: Array, P: Array) -> Matrix:
    """out' P out without rounding, P made symmetric."""
    exact = Matrix(_binary(out), 1 << _BINARY)
    return (exact.T @ Matrix(_binary((P + P.T) / 2), 1 << _BINARY) @ exact).reduced()


def _binary(A: Array) -> _Integers:
    """Floating-point numbers times 2^BINARY, which is whole unless they are less than 1e-20 or so."""
    return np.vectorize(lambda v: int(Fraction(v) * (1 << _BINARY)), otypes=[object])(A)


def _rounded_positive_real(P: Array) -> Matrix:
    """P to STORED_BITS binary digits, relative to its diagonal."""
    exponent = np.ceil(np.log2(np.abs(np.diag(P))) / 2)
    scale = np.exp2(-exponent)
    integers = np.round((P + P.T) / 2 * scale[:, None] * scale * 2.0**_STORED_BITS)
    n = P.shape[0]
    common = 2 * int(exponent.min())  # every exponent is at least half of this
    num = np.empty((n, n), dtype=object)
    for i in range(n):
        for j in range(n):
            num[i, j] = int(integers[i, j]) << (int(exponent[i] + exponent[j]) - common)
    power = _STORED_BITS - common
    return Matrix(num, 1 << power).reduced() if power >= 0 else Matrix(num * (1 << -power))


_Rows = tuple[tuple[str, ...], ...]


def rows_of(M: Matrix) -> _Rows:
    """Every entry in lowest terms."""
    return tuple(tuple(str(value) for value in row) for row in M.fractions())


def refuted_rows(name: str, block: Lti, rows: Sequence[Sequence[str]]) -> str | None:
    """Why the matrix of this name does not prove that the block is strictly positive real, or None if it does."""
    if len(rows) != block.order:  # files made before kept the states that no input reaches
        block = reached(block)
    n = block.order
    if len(rows) != n:
        return f"{name} has {len(rows)} rows, the model has {n} states"
    if ragged := [len(row) for row in rows if len(row) != n]:
        return f"{name} has a row of {ragged[0]} entries, the model has {n} states"
    try:
        common = 1
        for value in (value for row in rows for value in row):
            common = math.lcm(common, int(value.partition("/")[2] or 1))
            if common.bit_length() > _MOST_BITS:
                return f"{name} has a common denominator of more than {_MOST_BITS} bits: testing it would take minutes"
        P = Matrix.of(rows, (n, n))
    except (ValueError, ZeroDivisionError) as error:
        return f"{name} has an entry that is not a rational number: {error}"
    try:
        return prove_positive_real(block, P)
    except OverflowError:
        return f"{name} has an entry beyond the range of floating point"
