"""Matrices over the rationals: integers over one common denominator, and exact tests of definiteness.

A stored floating-point number stands for its shortest decimal, the one that a person wrote in the file:
0.0012 is 12/10000 here, not the nearest binary fraction. Everything after that is exact.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.object_]


class SingularMatrix(ValueError):
    """An exact inverse was asked of a matrix that has none."""


def rational(value: float | int | str | Fraction) -> Fraction:
    """The exact value of a number; a float stands for its shortest decimal."""
    return Fraction(repr(float(value))) if isinstance(value, float) else Fraction(value)


@dataclass(frozen=True, eq=False)
class Matrix:
    """`num / den` with integer entries and one positive denominator."""

    num: Integers  # (p, m), Python integers
    den: int = 1

    @classmethod
    def of(cls, rows: Iterable[Sequence], shape: tuple[int, int] | None = None) -> Matrix:
        """From rows of floats (read as decimals), integers, fractions or strings "p/q"."""
        entries = [[rational(v) for v in row] for row in rows]
        shape = shape or (len(entries), len(entries[0]) if entries else 0)
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
        return Matrix(self.num @ other.num, self.den * other.den).reduced()

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

    def inverse(self) -> Matrix:
        """The exact inverse. Raises SingularMatrix."""
        return self.solve(Matrix.eye(self.shape[0]))

    def solve(self, right: Matrix) -> Matrix:
        """X with `self @ X` = right, by elimination over the fractions. Raises SingularMatrix.

        The models here are series of small blocks, triangular when read in the right order: the next pivot is in the
        row with the fewest entries, and there in the column with the fewest (Markowitz), so next to nothing fills in.
        """
        n = self.shape[0]
        rows = [{j: Fraction(int(v), self.den) for j, v in enumerate(row) if v} for row in self.num]
        values = [list(row) for row in right.fractions()]
        columns = [{i for i in range(n) if j in rows[i]} for j in range(n)]
        active, order = set(range(n)), []
        while active:
            i = min(active, key=lambda r: len(rows[r]))
            if not rows[i]:
                raise SingularMatrix(f"a {n} x {n} matrix is singular")
            j = min(rows[i], key=lambda c: len(columns[c]))
            active.remove(i)
            order.append((i, j))
            for c in rows[i]:
                columns[c].discard(i)
            for r in list(columns[j]):
                factor = rows[r].pop(j) / rows[i][j]
                for c, v in rows[i].items():
                    if c != j:
                        _subtract(rows[r], columns[c], r, c, factor * v)
                values[r] = [x - factor * y for x, y in zip(values[r], values[i], strict=True)]
            columns[j].clear()
        solution: list[list[Fraction]] = [[] for _ in range(n)]
        for i, j in reversed(order):
            total = values[i]
            for c, v in rows[i].items():
                if c != j:
                    total = [x - v * y for x, y in zip(total, solution[c], strict=True)]
            solution[j] = [x / rows[i][j] for x in total]
        return Matrix.of(solution, right.shape)


def _subtract(row: dict[int, Fraction], column: set[int], r: int, c: int, value: Fraction) -> None:
    """Take `value` off the entry (r, c) of a sparse matrix that is kept by rows, with the rows of each column."""
    entry = row.get(c, Fraction(0)) - value
    if entry:
        row[c] = entry
        column.add(r)
    else:
        row.pop(c, None)
        column.discard(r)


def block(rows: Sequence[Sequence[Matrix]]) -> Matrix:
    """A matrix made of blocks, like numpy.block."""
    den = math.lcm(*(b.den for row in rows for b in row))
    return Matrix(np.block([[b.num * (den // b.den) for b in row] for row in rows]), den)


def block_diag(*parts: Matrix) -> Matrix:
    """The parts along the diagonal."""
    return block([[p if i == j else Matrix.zeros(p.shape[0], q.shape[1]) for j, q in enumerate(parts)]
                  for i, p in enumerate(parts)])  # fmt: skip


@dataclass(frozen=True)
class Definiteness:
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


def definiteness(S: Matrix) -> Definiteness:
    """Whether the symmetric matrix S is positive (semi)definite, by fraction-free LDL' (Bareiss).

    The pivots of the elimination are the leading minors themselves. A zero pivot leaves a semidefinite
    matrix only if its whole row of the Schur complement is zero; that row is then passed over.
    Raises ValueError if S is not exactly symmetric.
    """
    work = S.reduced().num.copy()
    if not (work == work.T).all():
        raise ValueError(f"a {S.shape[0]} x {S.shape[1]} matrix is not exactly symmetric")
    previous, singular = 1, None
    for k in range(work.shape[0]):
        pivot, column = work[k, k], work[k + 1 :, k].copy()
        if pivot < 0:
            return Definiteness(False, False, k + 1, -1)
        if pivot == 0:
            if (column != 0).any():
                return Definiteness(False, False, k + 1, 0)
            singular = singular or k + 1
            continue
        work[k + 1 :, k + 1 :] = (pivot * work[k + 1 :, k + 1 :] - np.outer(column, column)) // previous
        previous = pivot
    return Definiteness(singular is None, True, singular, None if singular is None else 0)
