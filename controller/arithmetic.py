"""Numbers and matrices in either arithmetic, floats or Fractions, and the time that the exact one may take."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]
Number = float | Fraction


class SingularLoop(ValueError):
    """A feedback interconnection whose algebraic loop has no solution, or an exact system with a pole at z = 1."""


class TooLong(ValueError):
    """Exact arithmetic, or a search by sweeps, that has used up the time it was given."""


_until: ContextVar[tuple[float, str]] = ContextVar("until", default=(float("inf"), ""))


@contextmanager
def within(
    seconds: float, what: str = "exact arithmetic", why: str = "too many digits over many states"
) -> Iterator[None]:
    """What is done here may take so many seconds of this thread's processor, or what is left of a time around it.

    Else it raises TooLong, at the next row of an exact product or elimination, or at the next response.
    """
    words = f"{what} was given up after {seconds:g} s: these are {why}"
    token = _until.set(min(_until.get(), (time.thread_time() + seconds, words)))
    try:
        yield
    finally:
        _until.reset(token)


def on_time() -> None:
    """Raises TooLong where the time of `within` is over."""
    until, words = _until.get()
    if time.thread_time() > until:
        raise TooLong(words)


def rational(value: Any) -> Fraction:
    """The exact value of a number; a float stands for its shortest decimal."""
    return Fraction(repr(float(value))) if isinstance(value, float) else Fraction(value)


def numbers(values: ArrayLike, T: Number) -> Any:
    """The values as an array in the arithmetic of T: float64, or Fractions. A scalar stays a scalar."""
    if isinstance(T, Fraction):
        exact = np.frompyfunc(rational, 1, 1)(np.asarray(values, dtype=object))
        return exact if isinstance(exact, np.ndarray) else Fraction(exact)
    return np.asarray(values, dtype=np.float64) if np.ndim(values) else float(values)  # type: ignore[arg-type]


_ZERO = Fraction(0)


def fractions(value: Any) -> Any:
    """A copy as Fractions."""
    array = np.asarray(value, dtype=object)
    known = isinstance(value, np.ndarray) and value.dtype == object and not value.flags.writeable
    if known and all(type(v) is Fraction for v in value.ravel()):
        return value
    out = np.empty(array.shape, dtype=object)
    out.ravel()[:] = [v if type(v) is Fraction else _ZERO if v == 0 else rational(v) for v in array.ravel()]
    out.setflags(write=False)
    return out


def eye(n: int, T: Number) -> Array:
    return numbers(np.eye(n), T) if n else np.zeros((0, 0), dtype=object if isinstance(T, Fraction) else float)


def inverse(M: Array) -> Array:
    """M^-1 in its own arithmetic. Raises SingularLoop."""
    if M.dtype == object:
        return solve(M, fractions(np.eye(M.shape[-1])))
    if M.size and np.max(np.linalg.cond(M)) > 1e12:
        raise SingularLoop(f"the algebraic loop I + D_G D_H is singular: {M.tolist()}")
    return np.linalg.inv(M)


def times(left: Array, right: Array) -> Array:
    """left @ right; of Fractions only the entries that are not zero are multiplied, since next to all are.

    Rows of the left one and columns of the right one become integers over a common denominator each, so that a sum
    needs no common divisors but one at its end.
    """
    if left.ndim != 2 or right.ndim != 2 or object not in (left.dtype, right.dtype):
        return left @ right
    if left.shape[1] != right.shape[0]:
        raise ValueError(f"shapes {left.shape} and {right.shape} do not fit")
    (lines, own), (columns, below) = _cleared(left), _cleared(right.T)
    rows = [[(j, column[k]) for j, column in enumerate(columns) if column[k]] for k in range(right.shape[0])]
    result = np.full((left.shape[0], right.shape[1]), _ZERO, dtype=object)
    for i, line in enumerate(lines):
        on_time()
        total = [0] * right.shape[1]
        for factor, entries in zip(line, rows, strict=True):
            if factor:
                for j, v in entries:
                    total[j] += factor * v
        for j, v in enumerate(total):
            if v:
                result[i, j] = Fraction(v, own[i] * below[j])
    return result


def _cleared(M: Array) -> tuple[list[list[int]], list[int]]:
    """Every row as integers, and the common denominator of each."""
    common = [math.lcm(*(v.denominator for v in row if v)) for row in M.tolist()]
    whole = [
        [v.numerator * (den // v.denominator) if v else 0 for v in row]
        for row, den in zip(M.tolist(), common, strict=True)
    ]
    return whole, common


def solve(M: Array, right: Array) -> Array:
    """M^-1 right in their own arithmetic. Raises SingularLoop."""
    if M.dtype != object:
        try:
            return np.linalg.solve(M, right)
        except np.linalg.LinAlgError:
            raise SingularLoop(f"a {M.shape[-2]} x {M.shape[-1]} matrix is singular: a pole at z = 1") from None
    return _solve_exactly(M, right)


def _solve_exactly(M: Any, right: Any) -> Any:
    """X with M X = right over the Fractions, by sparse elimination. Raises SingularLoop.

    The models here are series of small blocks, triangular when read in the right order: the next pivot is in the row
    with the fewest entries, and there in the column with the fewest (Markowitz), so next to nothing fills in.
    """
    n = M.shape[0]
    rows = [{j: v for j, v in enumerate(row) if v} for row in M]
    values = [{j: v for j, v in enumerate(row) if v} for row in right]
    columns: list[set[int]] = [{i for i in range(n) if j in rows[i]} for j in range(n)]
    active, order = set(range(n)), []
    while active:
        on_time()
        i = min(active, key=lambda r: len(rows[r]))
        if not rows[i]:
            raise SingularLoop(f"a {n} x {n} matrix is singular: a pole at z = 1 or an algebraic loop without solution")
        j = min(rows[i], key=lambda c: len(columns[c]))
        active.remove(i)
        order.append((i, j))
        for c in rows[i]:
            columns[c].discard(i)
        for r in list(columns[j]):
            factor = rows[r].pop(j) / rows[i][j]
            _subtract(rows[r], {c: v for c, v in rows[i].items() if c != j}, factor, columns, r)
            _subtract(values[r], values[i], factor)
        columns[j].clear()
    solution: list[dict[int, Fraction]] = [{} for _ in range(n)]
    for i, j in reversed(order):
        on_time()
        total = values[i]
        for c, v in rows[i].items():
            if c != j:
                _subtract(total, solution[c], v)
        solution[j] = {k: x / rows[i][j] for k, x in total.items()}
    result = np.full((n, right.shape[1]), _ZERO, dtype=object)
    for i, row in enumerate(solution):
        for k, v in row.items():
            result[i, k] = v
    return result


def _subtract(
    row: dict[int, Fraction], other: dict[int, Fraction], factor: Fraction, columns: Any = None, r: int = 0
) -> None:
    """Take factor times `other` off a sparse row; `columns` are the rows of each column, kept up to date."""
    for c, v in other.items():
        entry = row.get(c, _ZERO) - factor * v
        if entry:
            row[c] = entry
            if columns is not None:
                columns[c].add(r)
        else:
            row.pop(c, None)
            if columns is not None:
                columns[c].discard(r)
