"""Matrices of floats or Fractions for controller and design, budgets of counted work, and one BLAS thread."""

from __future__ import annotations

import itertools
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from functools import cache, wraps
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

Array = NDArray[np.floating[Any]]
Number = float | Fraction


class SingularLoop(ValueError):
    """An algebraic loop without a unique solution, or a system without G(1), because it has a pole at z = 1."""


class TooLong(ValueError):
    """A computation was refused for its size, or ended because its budget of work or the user's time is spent."""


# ----------------------------------------------------------------------------------------------------
# Counted work. Searches and exact arithmetic count their operations from the sizes of their matrices and numbers, and
# end when a budget is spent. Without a user's time limit they read no clock, so that a busy or slow machine gets the
# same result as a fast one. One unit is one second of a core at 2.4 GHz, within a factor of two.


_PARTS = 10**12


class _Counter(threading.local):
    """The work of this thread since it began, the total at which the budget is spent, and a user's time limit."""

    done = 0  # in 1/_PARTS of a unit; an integer, so that earlier work causes no rounding
    most: float = math.inf  # `done` at which the budget is spent
    message = ""  # text of the TooLong that `spend` raises
    over: Callable[[], bool] | None = None  # returns whether the user's time limit is over


_counter = _Counter()


def spend(units: float) -> None:
    """Count work of `units`. Raises TooLong if the budget of `within` is spent, or the user's time limit is over."""
    _counter.done += round(_PARTS * units)
    if _counter.done > _counter.most or (_counter.over is not None and _counter.over()):
        raise TooLong(_counter.message)


def spent() -> int:
    """Return the work that this thread has counted so far, in 1/_PARTS of a unit."""
    return _counter.done


def spent_after(units: float) -> int:
    """Return the value of `spent` after `units` more work."""
    return _counter.done + round(_PARTS * units)


def units_since(before: int) -> float:
    """Return the work [units] that was counted since `spent` returned `before`."""
    return (_counter.done - before) / _PARTS


@contextmanager
def within(
    units: float,
    what: str = "exact arithmetic",
    why: str = "too many digits or states",
    clock: Callable[[], bool] | None = None,
) -> Iterator[None]:
    """Limit the counted work in this context to `units`, and to the rest of a surrounding budget.

    Work beyond this limit raises TooLong. Its message contains `what` and `why` of the budget that is spent first. Any
    work raises TooLong once `clock` returns True, which says that the user's time limit is over.
    """
    before = _counter.most, _counter.message, _counter.over
    if units < math.inf and spent_after(units) < _counter.most:
        message = f"{what} was given up after the work of {units:g} s: {why}"
        _counter.most, _counter.message = spent_after(units), message
    _counter.over = clock or _counter.over
    try:
        yield
    finally:
        _counter.most, _counter.message, _counter.over = before


_PRODUCT = 5e-8  # [units] a product and a sum of short integers; the growth with `bits` was measured up to 5000 bits
_DIFFERENCE = 2e-6  # [units] a product and a difference of short fractions


def _spend_on_differences(count: int, factor: Fraction) -> None:
    """Count the work of `count` differences of fractions that have about as many digits as `factor`."""
    spend(_DIFFERENCE * count * (1 + factor.denominator.bit_length() / 80))


_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")


def one_blas_thread(function: Callable[_Args, _Result]) -> Callable[_Args, _Result]:
    """Let a function compute with one BLAS thread: more threads change the last digits, and wait for each other."""

    @wraps(function)
    def limited(*args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        with _blas().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


@cache
def _blas() -> ThreadpoolController:
    """Return a controller of the BLAS libraries of NumPy and SciPy. It can control only libraries that are loaded.

    With OPENBLAS_NUM_THREADS=1 SciPy's library uses one thread anyway and need not be loaded.
    """
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        compiled("scipy.linalg._flapack")
    return ThreadpoolController()


def compiled(name: str) -> Any:
    """Return a compiled module of SciPy, such as "scipy.linalg._flapack", without the Python code of its package.

    The module's import takes 0.01 s, that of scipy.linalg 0.1 s, and that of scipy.optimize 0.2 s more. A second thread
    waits until the first has loaded the module. Raises ImportError if SciPy has no such module.
    """
    with _loading:
        if name in sys.modules:
            return import_module(name)  # waits if Python itself is importing the module
        import scipy

        folder = Path(scipy.__path__[0], *name.split(".")[1:-1])
        spec = PathFinder.find_spec(name, [str(folder)])
        if spec is None or spec.loader is None:
            return import_module(name)  # This release of SciPy has its modules in other folders.
        sys.modules[name] = module = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
        return module


_loading = threading.RLock()


_ZERO, _ONE = Fraction(0), Fraction(1)


def rational(value: Any) -> Fraction:
    """Return the exact value of a number; a float stands for its shortest decimal."""
    if type(value) is Fraction:
        return value
    if not value:
        return _ZERO
    return Fraction(repr(float(value))) if isinstance(value, float) else Fraction(value)


def numbers(values: ArrayLike, T: Number) -> Any:
    """Return values as an array in the arithmetic of T: float64, or Fractions. A scalar stays a scalar."""
    if isinstance(T, Fraction):
        exact = np.frompyfunc(rational, 1, 1)(np.asarray(values, dtype=object))
        return exact if isinstance(exact, np.ndarray) else Fraction(exact)
    return np.asarray(values, dtype=np.float64) if np.ndim(values) else float(values)  # type: ignore[arg-type]


def fractions(value: Any) -> Any:
    """Return `value` as a read-only array of Fractions; if `value` is such an array, return it without a copy."""
    array = np.asarray(value, dtype=object)
    known = isinstance(value, np.ndarray) and value.dtype == object and not value.flags.writeable
    if known and all(type(v) is Fraction for v in value.ravel()):
        return value
    out = np.empty(array.shape, dtype=object)
    out.ravel()[:] = [v if type(v) is Fraction else _ZERO if v == 0 else rational(v) for v in array.ravel()]
    out.setflags(write=False)
    return out


def eye(n: int, T: Number) -> Array:
    """Return the identity matrix (n, n) in the arithmetic of T."""
    if not isinstance(T, Fraction):
        return np.eye(n)
    one = np.full((n, n), _ZERO, dtype=object)
    np.fill_diagonal(one, _ONE)
    return one


def inverse(M: Array) -> Array:
    """Return M^-1 in the arithmetic of M. Raises SingularLoop if M is singular or too ill-conditioned."""
    if M.dtype == object:
        return solve(M, fractions(np.eye(M.shape[-1])))
    try:
        result = np.linalg.inv(M)
    except np.linalg.LinAlgError:
        raise SingularLoop(_TOO_STIFF) from None
    with np.errstate(over="ignore", invalid="ignore"):  # An overflow gives inf or nan, which is not <= 1e24.
        # The product of the Frobenius norms is at least the condition number, and takes far less time.
        below = _square_norm(M) * _square_norm(result) <= 1e24
    if M.size and not below.all() and np.max(np.linalg.cond(M)) > 1e12:
        raise SingularLoop(_TOO_STIFF)
    return result


_TOO_STIFF = (
    "the algebraic loop within a tick is singular, or too stiff for floating point (condition above 1e12): "
    "soften the environment or the coupling, or add a sample to psi"
)


def _square_norm(M: Array) -> Array:
    """Return the sum of the squares of each matrix, over the last two axes."""
    return np.einsum("...ij,...ij->...", M, M)


def positive_definite(M: Any) -> bool:
    """Return whether a symmetric matrix of Fractions is positive definite, from the pivots of its elimination."""
    left = M.copy()
    for i in range(len(left)):
        if left[i, i] <= 0:
            return False
        left[i + 1 :] -= np.outer(left[i + 1 :, i] / left[i, i], left[i])
    return True


def times(left: Array, right: Array) -> Array:
    """Return left @ right. Raises ValueError if the shapes do not fit.

    Fractions are multiplied only where they are not zero. Each row of `left` and each column of `right` becomes
    integers over a common denominator, so that a sum of products needs one greatest common divisor only.
    """
    if left.ndim != 2 or right.ndim != 2 or object not in (left.dtype, right.dtype):
        return left @ right
    if left.shape[1] != right.shape[0]:
        raise ValueError(f"shapes {left.shape} and {right.shape} do not fit")
    (lines, own), (columns, below) = _cleared(left), _cleared(right.T)
    rows = [[(j, column[k]) for j, column in enumerate(columns) if column[k]] for k in range(right.shape[0])]
    result = np.full((left.shape[0], right.shape[1]), _ZERO, dtype=object)
    bits = max((den.bit_length() for den in own), default=0) + max((den.bit_length() for den in below), default=0)
    for i, line in enumerate(lines):
        products = sum(len(entries) for factor, entries in zip(line, rows, strict=True) if factor)
        spend(_PRODUCT * products * (1 + bits / 64))
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
    """Return the rows of M multiplied by their common denominators, as integers, and these denominators."""
    common = [math.lcm(*(v.denominator for v in row if v)) for row in M.tolist()]
    integers = [
        [v.numerator * (den // v.denominator) if v else 0 for v in row]
        for row, den in zip(M.tolist(), common, strict=True)
    ]
    return integers, common


def solve(M: Array, right: Array) -> Array:
    """Return M^-1 right in the arithmetic of M. Raises SingularLoop if M is singular."""
    if M.dtype != object:
        try:
            return np.linalg.solve(M, right)
        except np.linalg.LinAlgError:
            raise SingularLoop(f"a {M.shape[-2]} x {M.shape[-1]} matrix is singular: a pole at z = 1") from None
    return _solve_exactly(M, right)


def _solve_exactly(M: Any, right: Any) -> Any:
    """Return X with M X = right over the Fractions, by sparse elimination. Raises SingularLoop if M is singular.

    The next pivot is in the row with the fewest entries. In this row it is in the column with the fewest entries
    (Markowitz). This keeps most zeros.
    """
    n = M.shape[0]
    rows = [{j: v for j, v in enumerate(row) if v} for row in M]
    values = [{j: v for j, v in enumerate(row) if v} for row in right]
    columns: list[set[int]] = [{i for i in range(n) if j in rows[i]} for j in range(n)]
    active, order = set(range(n)), []
    while active:
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
            _spend_on_differences(len(rows[i]) + len(values[i]), factor)
            _subtract(rows[r], {c: v for c, v in rows[i].items() if c != j}, factor, columns, r)
            _subtract(values[r], values[i], factor)
        columns[j].clear()
    solution: list[dict[int, Fraction]] = [{} for _ in range(n)]
    for i, j in reversed(order):
        total = values[i]
        for c, v in rows[i].items():
            if c != j:
                for entry in itertools.islice(solution[c].values(), 1):
                    _spend_on_differences(len(solution[c]), entry)
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
    """Subtract factor times `other` from the sparse row r; columns[c] is the set of rows with an entry in column c."""
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
