"""Solve least-squares problems under linear matrix inequalities at many frequencies (design.program, design.bound).

minimise |A x - b|^2 + c'x  subject to  S_k(x) = constant_k + sum_a x_a slope_ka > 0 (Hermitian, one per frequency)

The log-det barrier method follows x(t), the minimiser of t (|A x - b|^2 + c'x) - sum_k log det S_k(x). This point is
strictly feasible, and its objective is at most degree/t above the minimum, where degree is the sum of the numbers of
rows of the S_k. `follow` steps along the path x(t) by power series. The terms of a series cost much less than the
Cholesky factor of a Hessian.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
_STEP, _PRODUCT = 3e-4, 1e-10  # counted work of a step, and of each of its products
_ORDER = 6  # terms of the series; with 4 terms, n6 and n7 of benchmarks/loops take 5 to 10 % more steps
_KEPT = 0.05  # least share of every eigenvalue of S that remains after a step to a larger t
_DESCENT = 0.1  # least decrease of the barrier function in a step to the same t, relative to its slope at the start
_FAR = 10.0  # If the squared Newton decrement is larger than this times the degree, t is reduced before the next step.
_SHORTER, _SHORTEST = 0.8, 1e-4  # factor by which a refused step is shortened, and length at which it is given up
_RIDGE = 1e-9  # relative ridge for directions that change neither the objective nor the inequalities
_upper = cache(np.triu_indices)


@dataclass(frozen=True, eq=False)
class MatrixInequality:
    """constant + sum_a x_a slope_a > 0 at k frequencies. The matrices are stored as real vectors (`packed`)."""

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
        """The approximate number of products of numbers in a Newton step."""
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

    def along(self, W: Complex) -> Array:
        """Return sum_k <W_k, slope_ka> for Hermitian matrices W (k, r, r), as (n,)."""
        return packed(W).ravel() @ self.slope.reshape(-1, self.slope.shape[2])

    def add_hessian(self, x: Array, hessian: Array) -> None:
        """Add the Hessian (n, n) of -log det S to the argument."""
        rows = self.directions(x)
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

    The methods are those of MatrixInequality, but `add_hessian` adds only the upper triangle of the Hessian.
    The unknowns are the entries of the X_n, sorted by entry and then by n, followed by the x_a. At each frequency the
    second derivative by an entry of X_n and an entry of X_l is a sum of the products t_n t_l and t_n t_l*. The weights
    of these products depend on S^-1 and the two entries, but not on n and l. So the Hessian is a product of two
    matrices whose common dimension is the frequency. One matrix has a row for each pair of functions, and the other has
    a column for each pair of entries.
    """

    constant: Array  # (k, r^2) `packed`
    functions: Complex  # (k, n) t_n at each frequency
    left: Complex  # (k, r, r)
    right: Complex  # (k, r, r)
    slope: Array  # (k, r^2, a) `packed`

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
        """All pairs of functions t and u.

        The parts are the two indices of each pair, [Re tu, Im tu, Re tu*] as (n (n + 1)/2, 3 k), and Im tu* as
        (n (n + 1)/2, k).
        """
        first, second = _upper(self.functions.shape[1])
        t, u = self.functions.T[first], self.functions.T[second]
        along, against = t * u, t * np.conj(u)
        return first, second, np.hstack([along.real, along.imag, against.real]), np.ascontiguousarray(against.imag)

    @cached_property
    def _own(self) -> Complex:
        """The matrices slope_a, (k, a, r, r)."""
        return _unpacked(np.swapaxes(self.slope, 1, 2))

    def along(self, W: Complex) -> Array:
        """Return sum_k <W_k, derivatives of S_k> for Hermitian matrices W (k, r, r), as (unknowns,)."""
        return self._along(W[:, None])[:, 0]

    def _along(self, W: Complex) -> Array:
        """Return `along` for each of the matrices W (k, a, r, r), as (unknowns, a)."""
        (k, n), r = self.functions.shape, self.left.shape[-1]
        through = (self.right[:, None] @ W @ self.left[:, None]).swapaxes(2, 3).reshape(k, -1)
        entry = self.functions.real.T @ through.real - self.functions.imag.T @ through.imag
        entry = entry.reshape(n, -1, r * r).transpose(2, 0, 1).reshape(r * r * n, -1)
        return np.concatenate([entry, np.einsum("ksa,kbs->ab", self.slope, packed(W))])

    def add_hessian(self, x: Array, hessian: Array) -> None:
        n, r = self.functions.shape[1], self.left.shape[-1]
        L, V, adjoint = self.left, self.right, lambda X: np.conj(np.swapaxes(X, 1, 2))
        P = inverse(self.at(x))
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
        # Mixed derivatives: the inner products of S^-1 slope_a S^-1 with the derivatives of S by all unknowns.
        hessian[:, size:] += self._along(P[:, None] @ self._own @ P[:, None])


def joined(blocks: Sequence[MatrixInequality]) -> tuple[MatrixInequality, ...]:
    """Return the inequalities as one block for each matrix size."""
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
        """Return the program in the unknowns y = U x, in which it is well-conditioned at x, and U (upper triangular).

        U is the factor R of a QR decomposition of the stacked rows of objective and barrier. A Cholesky factor of their
        inner products would lose digits, because the unknowns x of a basis of filters are ill-conditioned.
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
# LAPACK's routines. They give the same bits as scipy.linalg, whose import takes 0.1 s (`compiled`).


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


# The central path ---------------------------------------------------------------------------------------------------


def follow(
    program: Program, x: Array, t: float, onward: Callable[[Array, float], float]
) -> Iterator[tuple[Array, float]]:
    """Yield points (x(t), t) of the central path, from a strictly feasible x and a first t.

    `onward` returns the next t for a point of the path, or the same t to end the path there. If rounding prevents a
    smaller Newton decrement, the last point counts as x(t).
    """
    aim, steps = t, 0
    while True:
        point = _Expanded(program, x, t)
        stuck = steps == budgets.CENTRING_STEPS
        centred = stuck or point.decrement <= _CENTRED
        if stuck or (centred and t == aim):
            yield x, t
            aim, steps = onward(x, t), 0
            if aim <= t:
                return
        before = x, t
        if point.decrement > _FAR * program.degree and not stuck:
            t *= 0.5 * math.sqrt(program.degree / point.decrement)
        else:
            x, t = point.moved(aim if centred else t)
        steps = budgets.CENTRING_STEPS if (x is before[0] and t == before[1]) else steps + 1


class _Expanded:
    """The equation of the path, grad |A x - b|^2 + c - (1/t) grad log det S = 0, expanded at (x, t)."""

    def __init__(self, program: Program, x: Array, t: float) -> None:
        spend(program.step_cost)
        self._program, self._x, self._t = program, x, t
        self._S = [block.at(x) for block in program.blocks]
        self._P = [inverse(S) for S in self._S]
        residual = t * (2 * program.A.T @ (program.A @ x - program.b) + program.c)
        self._residual = residual - sum(block.along(P) for block, P in zip(program.blocks, self._P, strict=True))
        hessian = 2 * t * program.square
        for block in program.blocks:
            block.add_hessian(x, hessian)
        self._scale, self._factor = _scaled_factor(hessian)
        self.decrement = float(self._residual @ self._solved(self._residual))

    def _solved(self, right: Array) -> Array:
        return self._scale * _lapack("dpotrs")(self._factor, self._scale * right, lower=True)[0]

    def moved(self, to: float) -> tuple[Array, float]:
        """Return the point that a step towards x(to) reaches, and its t.

        The step is along a curve x(s), 0 <= s <= 1. On it the residual of the path's equation is (1 - s) times that at
        the start, and 1/t is linear in s, so that x(1) = x(to). `_terms` returns its power series. Lengths s are tried
        from 1 downwards, until the barrier function decreases, or, for a larger t, until S is well inside the cone.
        """
        change, s = self._t / to - 1, 1.0
        terms, moves = self._terms(change)
        value = self._barrier(self._x, self._S)
        while s > _SHORTEST:
            powers = s ** np.arange(_ORDER + 1)
            x, S = powers @ terms, [np.tensordot(powers, move, axes=1) for move in moves]
            if to == self._t:
                allowed = self._barrier(x, S) < value - _DESCENT * s * self.decrement
            else:
                allowed = all(_definite(new - _KEPT * old) for new, old in zip(S, self._S, strict=True))
            if allowed:
                return x, to if s == 1 else self._t / (1 + s * change)
            s *= _SHORTER
        return self._x, to

    def _terms(self, change: float) -> tuple[Array, list[Complex]]:
        """Return the terms of x(s), (_ORDER + 1, n), and those of S(x(s)) in each block, (_ORDER + 1, k, r, r).

        `change` is the change of 1/t along the whole curve, relative to 1/t. With S = sum S_j s^j, the series of
        P = S^-1 has the terms P_j = -P_0 sum_i>0 S_i P_j-i. The equation for x_j has the Hessian as its matrix. Its
        right side contains the part of P_j without x_j, and `change` times P_j-1.
        """
        blocks, right = self._program.blocks, -self._residual
        terms, S, P = [self._x], [[S] for S in self._S], [[P] for P in self._P]
        for j in range(1, _ORDER + 1):
            for block, s, p in zip(blocks, S, P, strict=True):
                p.append(-p[0] @ sum((s[i] @ p[j - i] for i in range(1, j)), np.zeros_like(p[0])))
                right = right + block.along(p[j] + change * p[j - 1])
            terms.append(self._solved(right))
            right = np.zeros_like(right)
            for block, s, p in zip(blocks, S, P, strict=True):
                s.append(block.moved(terms[j]))
                p[j] -= p[0] @ s[j] @ p[0]
        return np.array(terms), [np.array(s) for s in S]

    def _barrier(self, x: Array, S: Sequence[Complex]) -> float:
        """Return t (|A x - b|^2 + c'x) - sum log det S, infinite if S is not positive definite."""
        try:
            factors = [np.linalg.cholesky(part) for part in S]
        except np.linalg.LinAlgError:
            return np.inf
        logarithms = sum(np.log(np.diagonal(F, axis1=1, axis2=2).real).sum() for F in factors)
        return self._t * self._program.value(x) - 2 * float(logarithms)


def _scaled_factor(hessian: Array) -> tuple[Array, Array]:
    """Return (scale, Cholesky factor of the Hessian times the scale from both sides).

    The scale (n,) makes the diagonal 1. If rounding prevents the factor, a growing ridge is added to the diagonal.
    """
    scale = 1 / np.sqrt(np.diag(hessian))
    hessian *= scale[:, None]
    hessian *= scale
    diagonal, ridge = hessian.diagonal().copy(), 0.0
    while True:
        # The transpose is in LAPACK's order of entries, so that the Hessian is not transposed in memory.
        factor, fault = _lapack("dpotrf")(np.asarray_chkfinite(hessian).T, lower=True, clean=False)
        if not fault:
            return scale, factor
        ridge = max(10 * ridge, 1e-14)
        np.fill_diagonal(hessian, diagonal + ridge)


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


def inverse(S: Complex) -> Complex:
    """Return the inverses of Hermitian matrices (k, r, r)."""
    return hermitian(np.linalg.inv(S).astype(np.complex128, copy=False))


def _inverse_root(S: Complex) -> Complex:
    """Return W with W S W* = I."""
    return np.linalg.inv(np.linalg.cholesky(S)).astype(np.complex128, copy=False)


def _definite(S: Complex) -> bool:
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(S).all())
