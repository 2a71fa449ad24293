"""Solve least-squares problems under linear matrix inequalities at many frequencies (design.program, design.bound).

minimise |A x - b|^2 + c'x  subject to  S_k(x) = constant_k + sum_a x_a slope_ka > 0 (Hermitian, one per frequency)

The log-det barrier method follows x(t), the minimiser of t (|A x - b|^2 + c'x) - sum_k log det S_k(x). This point is
strictly feasible, and its objective is at most degree/t above the minimum, where degree is the total size of the S_k. A
Newton step is a least-squares problem in the directions S^-1/2 dS S^-1/2, where dS is the change of S.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import compiled, spend
from haptic_loop.controller.lti import Array, Complex
from haptic_loop.design import budgets
from haptic_loop.design.frequency import hermitian

_CENTRED = 0.5  # largest squared Newton decrement of a point that counts as the minimiser x(t)
_STEP, _PRODUCT = 3e-4, 1e-10  # units of counted work of a Newton step, and of each of its products
_KEPT = 0.3  # least share of every eigenvalue of S that remains after a step
_LONGEST = 1e3  # largest step, in Newton steps, if no eigenvalue of S falls
_RIDGE = 1e-9  # relative ridge, for directions on which neither objective nor inequalities depend
_upper = cache(np.triu_indices)


@dataclass(frozen=True, eq=False)
class MatrixInequality:
    """constant + sum_a x_a slope_a > 0 at k frequencies; the matrices are stored as real vectors (`packed`)."""

    constant: Array  # (k, r^2)
    slope: Array  # (k, r^2, n)

    @classmethod
    def of(cls, constant: Complex, slope: Complex) -> MatrixInequality:
        """Return the inequality with the Hermitian matrices constant (k, r, r) and slope (k, n, r, r)."""
        return cls(packed(constant), np.ascontiguousarray(np.swapaxes(packed(slope), 1, 2)))

    @property
    def degree(self) -> int:
        return len(self.constant) * math.isqrt(self.constant.shape[1])

    @property
    def products(self) -> int:
        """The approximate number of products in a Newton step."""
        k, square, n = self.slope.shape
        return k * square * n * (square + n)

    def at(self, x: Array) -> Complex:
        """Return S(x), shape (k, r, r)."""
        return _unpacked(self.constant + self.slope @ x)

    def moved(self, step: Array) -> Complex:
        """Return the change of S if x changes by `step`, (k, r, r)."""
        return _unpacked(self.slope @ step)

    def directions(self, x: Array) -> Array:
        """Return the matrices S^-1/2 slope_a S^-1/2, `packed`, as columns (k r^2, n)."""
        rows = _turned(_inverse_root(self.at(x))) @ self.slope
        return rows.reshape(-1, rows.shape[2])

    def add_newton(self, x: Array, gradient: Array, hessian: Array) -> None:
        """Add the gradient (n,) of -log det S and its Hessian (n, n) to the arguments."""
        rows = self.directions(x)
        one = packed(np.eye(math.isqrt(self.constant.shape[1]), dtype=complex))
        gradient -= np.tile(one, len(self.constant)) @ rows
        used = rows.any(axis=0)
        own = rows[:, used]
        hessian[... if used.all() else np.ix_(used, used)] += own.T @ own

    def changed(self, U: Array) -> MatrixInequality:
        """Return the inequality in the unknowns y = U x."""
        slope = solve_triangular(U, self.slope.reshape(-1, len(U)).T, transposed=True).T
        return MatrixInequality(self.constant, np.ascontiguousarray(slope).reshape(self.slope.shape))


@dataclass(frozen=True, eq=False)
class EntryInequality:
    """constant + He[sum_n t_n(w) left X_n right] + sum_a x_a slope_a > 0 at k frequencies, with real matrices X_n.

    The methods are those of MatrixInequality, but `add_newton` adds the upper triangle of the Hessian only.
    The unknowns are the entries of the X_n, sorted by entry and then by n, followed by the x_a. At each frequency the
    second derivative in an entry of X_n and one of X_l is a sum of products t_n t_l and t_n t_l*. Their weights from
    S^-1 do not depend on n and l. The Hessian is therefore a matrix product over the frequencies: (pairs of functions)
    times (pairs of entries).
    """

    constant: Array  # (k, r^2): `packed`
    functions: Complex  # (k, n)
    left: Complex  # (k, r, r)
    right: Complex  # (k, r, r)
    slope: Array  # (k, r^2, a): `packed`

    @property
    def degree(self) -> int:
        return len(self.functions) * self.left.shape[-1]

    @property
    def products(self) -> int:
        (k, n), square, own = self.functions.shape, self.left.shape[-1] ** 2, self.slope.shape[2]
        return k * (n**2 * square**2 + square * own * (square + n * square + own))

    def at(self, x: Array) -> Complex:
        """Return S(x), shape (k, r, r)."""
        return _unpacked(self.constant) + self.moved(x)

    def moved(self, step: Array) -> Complex:
        """Return the change of S if x changes by `step`, (k, r, r)."""
        r = self.left.shape[-1]
        X, own = np.split(step, [r * r * self.functions.shape[1]])
        filtered = (self.functions @ X.reshape(r * r, -1).T).reshape(-1, r, r)
        return hermitian(self.left @ filtered @ self.right) + _unpacked(self.slope @ own)

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """All pairs of functions t, u: two indices, [Re tu, Im tu, Re tu*] (n (n + 1)/2, 3 k), and Im tu* (.., k)."""
        first, second = _upper(self.functions.shape[1])
        t, u = self.functions.T[first], self.functions.T[second]
        along, against = t * u, t * np.conj(u)
        return first, second, np.hstack([along.real, along.imag, against.real]), np.ascontiguousarray(against.imag)

    @cached_property
    def _own(self) -> Complex:
        """The matrices slope_a, (k, a, r, r)."""
        return _unpacked(np.swapaxes(self.slope, 1, 2))

    def add_newton(self, x: Array, gradient: Array, hessian: Array) -> None:
        (k, n), r = self.functions.shape, self.left.shape[-1]
        L, V, adjoint = self.left, self.right, lambda X: np.conj(np.swapaxes(X, 1, 2))
        P = hermitian(np.linalg.inv(self.at(x)).astype(np.complex128, copy=False))
        row, column = (v.ravel() for v in np.indices((r, r)))
        one, two = _upper(r * r)
        (i, j), (g, h) = (row[one], column[one]), (row[two], column[two])
        across, of_left, of_right = V @ P @ L, adjoint(L) @ P @ L, V @ P @ adjoint(V)
        along, against = across[:, h, i] * across[:, j, g] / 2, of_left[:, g, i] * of_right[:, j, h] / 2
        first, second, even, odd = self._pairs
        even = even @ np.concatenate([along.real, -along.imag, against.real])
        odd = odd @ against.imag
        between = np.empty((one.size, n, n))
        between[:, first, second], between[:, second, first] = (even - odd).T, (even + odd).T
        size = r * r * n
        hessian[:size, :size].reshape(r * r, n, r * r, n)[one, :, two] += between
        # `turned` holds S^-1 and S^-1 slope_a S^-1, whose inner products with the derivatives of S follow.
        P = P[:, None]
        turned = np.concatenate([P, P @ self._own @ P], axis=1)
        through = V[:, None] @ turned @ L[:, None]
        entry = through[:, :, column, row].reshape(k, -1)
        beside = self.functions.real.T @ entry.real - self.functions.imag.T @ entry.imag
        beside = beside.reshape(n, -1, r * r).transpose(2, 0, 1).reshape(r * r * n, -1)
        own = np.einsum("ksa,kbs->ab", self.slope, packed(turned))
        gradient -= np.concatenate([beside[:, 0], own[:, 0]])
        hessian[:size, size:] += beside[:, 1:]
        hessian[size:, size:] += own[:, 1:]


def joined(blocks: Sequence[MatrixInequality]) -> tuple[MatrixInequality, ...]:
    """Join the inequalities into one block for each matrix size."""
    sizes = dict.fromkeys(block.constant.shape[1] for block in blocks)
    alike = [[block for block in blocks if block.constant.shape[1] == size] for size in sizes]
    return tuple(
        MatrixInequality(np.concatenate([b.constant for b in s]), np.concatenate([b.slope for b in s])) for s in alike
    )


@dataclass(frozen=True, eq=False)
class Program:
    """Minimise |A x - b|^2 + c'x subject to the blocks."""

    A: Array  # (rows, n)
    b: Array  # (rows,)
    c: Array  # (n,)
    blocks: tuple[MatrixInequality | EntryInequality, ...]

    @cached_property
    def square(self) -> Array:
        return self.A.T @ self.A

    @property
    def degree(self) -> int:
        return sum(block.degree for block in self.blocks)

    @property
    def step_cost(self) -> float:
        """The counted work of a Newton step."""
        products = self.b.size * self.c.size + self.c.size**3 // 3 + sum(block.products for block in self.blocks)
        return _STEP + _PRODUCT * products

    def value(self, x: Array) -> float:
        residual = self.A @ x - self.b
        return float(residual @ residual + self.c @ x)

    def feasible(self, x: Array) -> bool:
        """Return whether every inequality holds strictly."""
        return all(_definite(block.at(x)) for block in self.blocks)

    def conditioned(self, x: Array) -> tuple[Program, Array]:
        """Return the program in y = U x, and the upper triangular U that balances objective and barrier at x.

        U is the factor R of a QR decomposition of the stacked rows of objective and barrier. A Cholesky factor of the
        inner products would lose digits, because the coordinates x of a basis of filters are ill-conditioned.
        """
        dense = [block for block in self.blocks if isinstance(block, MatrixInequality)]
        assert len(dense) == len(self.blocks)
        rows = [block.directions(x) for block in dense]
        scale = np.linalg.norm(np.vstack([self.A, *rows]), axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        stacked = np.vstack([self.A, *rows, _RIDGE * np.diag(scale)])
        U = triangular_factor(stacked)
        A = solve_triangular(U, self.A.T, transposed=True).T
        blocks = tuple(block.changed(U) for block in dense)
        return Program(A, self.b, solve_triangular(U, self.c, transposed=True), blocks), U


# ----------------------------------------------------------------------------------------------------
# LAPACK's routines as scipy.linalg calls them, bit for bit, without the import of its Python code (`compiled`).


def _lapack(name: str) -> Any:
    return getattr(compiled("scipy.linalg._flapack"), name)


def triangular_factor(rows: Array) -> Array:
    """Return the factor R (n, n) of the QR decomposition of rows (k, n), k >= n; its diagonal may be negative."""
    rows, geqrf = np.asarray_chkfinite(rows), _lapack("dgeqrf")
    size = int(geqrf(rows, lwork=-1)[-2][0])
    return np.triu(geqrf(rows, lwork=size)[0])[: rows.shape[1]]


def solve_triangular(U: Array, b: Array | Complex, transposed: bool = False) -> Any:
    """Return x (n, ..) with U x = b, or U' x = b, for an upper triangular U (n, n). Raises LinAlgError if singular."""
    b = np.asarray_chkfinite(b)
    by_columns = U.flags.f_contiguous
    trtrs, trans = _lapack("ztrtrs" if np.iscomplexobj(b) else "dtrtrs"), transposed is by_columns
    x, fault = trtrs(U if by_columns else U.T, b, lower=not by_columns, trans=trans)
    if fault:
        raise np.linalg.LinAlgError(f"the triangular matrix has a zero in row {fault}")
    return x


def _solve_positive(H: Array, b: Array) -> Array:
    """Return H^-1 b for a symmetric H > 0, by its Cholesky factor. Raises LinAlgError if H is not positive definite."""
    # The transpose is in LAPACK's order of entries, so that H is not transposed in memory.
    factor, fault = _lapack("dpotrf")(np.asarray_chkfinite(H).T, lower=True, clean=False)
    if fault:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return _lapack("dpotrs")(factor, np.asarray_chkfinite(b), lower=True)[0]


def centre(program: Program, x: Array, t: float) -> Array:
    """Return an approximate minimiser of t (|A x - b|^2 + c'x) - sum log det S; the start x is strictly feasible."""
    cost = program.step_cost
    for _ in range(budgets.CENTRING_STEPS):
        spend(cost)
        gradient = t * (2 * program.A.T @ (program.A @ x - program.b) + program.c)
        hessian = 2 * t * program.square
        for block in program.blocks:
            block.add_newton(x, gradient, hessian)
        step = _solved(hessian, -gradient)
        decrement = float(-gradient @ step)
        if not decrement > _CENTRED:
            break
        x = x + _length(program, step, x, t) * step
    return x


def towards(start: Array, x: Array, program: Program) -> Array:
    """Return x if it is feasible, else the point at 0.9 of the way from the feasible `start` to the boundary."""
    if program.feasible(x):
        return x
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if program.feasible(start + middle * (x - start)) else (low, middle)
    return start + 0.9 * low * (x - start)


def _solved(hessian: Array, right: Array) -> Array:
    """Return hessian^-1 right, with a ridge that grows until the Hessian, which is scaled in place, has a factor."""
    scale = 1 / np.sqrt(np.diag(hessian))
    hessian *= scale[:, None]
    hessian *= scale
    diagonal, ridge = hessian.diagonal().copy(), 0.0
    while True:
        try:
            return scale * _solve_positive(hessian, scale * right)
        except np.linalg.LinAlgError:
            ridge = max(10 * ridge, 1e-14)
            np.fill_diagonal(hessian, diagonal + ridge)


def _length(program: Program, step: Array, x: Array, t: float) -> float:
    """Return the step length that minimises the barrier function and leaves at least _KEPT of every eigenvalue of S."""
    along = np.concatenate([_eigenvalues(block, x, step) for block in program.blocks])
    residual, slope = program.A @ x - program.b, program.A @ step
    linear, square = 2 * t * residual @ slope + t * program.c @ step, 2 * t * slope @ slope

    def rises(s: float) -> bool:
        return linear + square * s > (along / (1 + s * along)).sum()

    low, high = 0.0, (1 - _KEPT) / -along.min() if along.min() < 0 else _LONGEST
    if not rises(high):
        return high
    while high - low > 0.01 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if rises(middle) else (middle, high)
    return (low + high) / 2


def _eigenvalues(block: MatrixInequality | EntryInequality, x: Array, step: Array) -> Array:
    """Return the eigenvalues of S^-1/2 dS S^-1/2 at every frequency, where dS is the change of S by the step."""
    inverse = _inverse_root(block.at(x))
    return np.linalg.eigvalsh(inverse @ block.moved(step) @ np.conj(np.swapaxes(inverse, 1, 2))).ravel()


def _turned(W: Complex) -> Array:
    """Return the map H -> W H W* on `packed` matrices, (k, r^2, r^2), from (W H W*)_ab = sum W_ac conj(W_bd) H_cd."""
    r = W.shape[-1]
    c, d = _upper(r, 1)
    a, b = np.append(np.arange(r), c), np.append(np.arange(r), d)
    left, right = W[:, a, :], np.conj(W[:, b, :])
    one, other = left[..., c] * right[..., d], left[..., d] * right[..., c]
    through = np.concatenate([left * right, (one + other) / np.sqrt(2), 1j * (one - other) / np.sqrt(2)], axis=-1)
    off = np.sqrt(2) * through[:, r:]
    return np.concatenate([through[:, :r].real, off.real, off.imag], axis=1)


def packed(H: Complex) -> Array:
    """Return Hermitian matrices (.., r, r) as real vectors (.., r^2) with the same inner product."""
    upper = _upper(H.shape[-1], 1)
    off = np.sqrt(2) * H[..., upper[0], upper[1]]
    return np.concatenate([np.real(np.diagonal(H, axis1=-2, axis2=-1)), np.real(off), np.imag(off)], axis=-1)


def _unpacked(v: Array) -> Complex:
    """Return the Hermitian matrices of `packed` vectors."""
    r = math.isqrt(v.shape[-1])
    upper, count = _upper(r, 1), r * (r - 1) // 2
    H = np.zeros((*v.shape[:-1], r, r), dtype=complex)
    H[..., upper[0], upper[1]] = (v[..., r : r + count] + 1j * v[..., r + count :]) / np.sqrt(2)
    H = H + np.conj(np.swapaxes(H, -2, -1))
    H[..., np.arange(r), np.arange(r)] = v[..., :r]
    return H


def _inverse_root(S: Complex) -> Complex:
    """Return W with W S W* = I."""
    return np.linalg.inv(np.linalg.cholesky(S)).astype(np.complex128, copy=False)


def _definite(S: Complex) -> bool:
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(S).all())
