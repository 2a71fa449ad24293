"""A least-squares problem under linear matrix inequalities at many frequencies, by a log-det barrier.

minimise |A x - b|^2 + c'x  subject to  S_k(x) = constant_k + sum_a x_a slope_ka > 0 (Hermitian, one per frequency)

The barrier follows x(t), the minimiser of t (|A x - b|^2 + c'x) - sum_k log det S_k(x): a strictly feasible point at
most degree/t above the minimum, degree the total size of the S_k. A Newton step is a least-squares problem in the
directions S^-1/2 dS S^-1/2, and the best length of a step follows from their eigenvalues without further evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when they are used

from controller.lti import Array, Complex

_CENTRED = 0.5  # Newton decrement squared at which a point counts as central: 0.05/t above the best value
_MOST_STEPS = 60
_KEPT = 0.3  # of an eigenvalue, at least, after a step
_LONGEST = 1e3  # times the Newton step
_RIDGE = 1e-9  # of its column: what a direction that neither objective nor inequalities see is charged


@dataclass(frozen=True, eq=False)
class MatrixInequality:
    """constant + sum_a x_a slope_a > 0 at k frequencies, as real vectors (`packed`)."""

    constant: Array  # (k, r^2)
    slope: Array  # (k, r^2, n)

    @classmethod
    def of(cls, constant: Complex, slope: Complex) -> MatrixInequality:
        """Of Hermitian matrices: constant (k, r, r), slope (k, n, r, r)."""
        return cls(packed(constant), np.ascontiguousarray(np.swapaxes(packed(slope), 1, 2)))

    @property
    def degree(self) -> int:
        return len(self.constant) * math.isqrt(self.constant.shape[1])

    def at(self, x: Array) -> Complex:
        """S(x), shape (k, r, r)."""
        return _unpacked(self.constant + self.slope @ x)

    def changed(self, U: Array) -> MatrixInequality:
        """The same of y where x = U^-1 y."""
        slope = scipy.linalg.solve_triangular(U, self.slope.reshape(-1, len(U)).T, trans=1).T
        return MatrixInequality(self.constant, np.ascontiguousarray(slope).reshape(self.slope.shape))


def joined(blocks: Sequence[MatrixInequality]) -> tuple[MatrixInequality, ...]:
    """The same inequalities as one block for each size of matrices."""
    sizes = dict.fromkeys(block.constant.shape[1] for block in blocks)
    alike = [[block for block in blocks if block.constant.shape[1] == size] for size in sizes]
    return tuple(
        MatrixInequality(np.concatenate([b.constant for b in s]), np.concatenate([b.slope for b in s])) for s in alike
    )


@dataclass(frozen=True, eq=False)
class Program:
    """The problem in coordinates y, x = change y, in which its directions are of similar size at the start."""

    A: Array  # (rows, n)
    b: Array  # (rows,)
    c: Array  # (n,)
    blocks: tuple[MatrixInequality, ...]

    @property
    def degree(self) -> int:
        return sum(block.degree for block in self.blocks)

    def value(self, x: Array) -> float:
        """|A x - b|^2 + c'x."""
        residual = self.A @ x - self.b
        return float(residual @ residual + self.c @ x)

    def feasible(self, x: Array) -> bool:
        """Whether every inequality holds strictly."""
        return all(_definite(block.at(x)) for block in self.blocks)

    def conditioned(self, x: Array) -> tuple[Program, Array]:
        """(the program in y, the upper triangle U with x = U^-1 y), for which objective and barrier at x are balanced.

        U is the triangle of the stacked rows of both, so that no inner product is ever formed in the ill-conditioned
        coordinates of a basis of filters.
        """
        rows = [_directions(block, x)[0] for block in self.blocks]
        scale = np.linalg.norm(np.vstack([self.A, *rows]), axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        stacked = np.vstack([self.A, *rows, _RIDGE * np.diag(scale)])
        U = np.asarray(scipy.linalg.qr(stacked, mode="r")[0])[: x.size]
        A = scipy.linalg.solve_triangular(U, self.A.T, trans=1).T
        blocks = tuple(block.changed(U) for block in self.blocks)
        return Program(A, self.b, scipy.linalg.solve_triangular(U, self.c, trans=1), blocks), U


def centre(program: Program, x: Array, t: float) -> Array:
    """The minimiser of t (|A x - b|^2 + c'x) - sum log det S, from a strictly feasible x."""
    for _ in range(_MOST_STEPS):
        parts = [_directions(block, x) for block in program.blocks]
        gradient = 2 * t * program.A.T @ (program.A @ x - program.b) + t * program.c
        hessian = 2 * t * program.A.T @ program.A
        for rows, ones in parts:
            gradient -= rows.T @ ones
            hessian += rows.T @ rows
        step = _solved(hessian, -gradient)
        decrement = float(-gradient @ step)
        if not decrement > _CENTRED:
            break
        x = x + _length(program, step, x, t) * step
    return x


def towards(start: Array, x: Array, program: Program, reserve: float = 0.9) -> Array:
    """The point between `start`, strictly feasible, and x that is strictly feasible: x itself where it is one."""
    if program.feasible(x):
        return x
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if program.feasible(start + middle * (x - start)) else (low, middle)
    return start + reserve * low * (x - start)


def _solved(hessian: Array, right: Array) -> Array:
    scale = 1 / np.sqrt(np.diag(hessian))
    unit = scale[:, None] * hessian * scale
    ridge = 0.0
    while True:
        try:
            return scale * scipy.linalg.cho_solve(
                scipy.linalg.cho_factor(unit + ridge * np.eye(len(unit))), scale * right
            )
        except np.linalg.LinAlgError:
            ridge = max(10 * ridge, 1e-14)


def _length(program: Program, step: Array, x: Array, t: float) -> float:
    """The minimiser of the barrier function along the step, where no inequality loses more than it may at once.

    A point that an exact search has taken close to the boundary leaves it in tiny steps only, along a curve.
    """
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


def _eigenvalues(block: MatrixInequality, x: Array, step: Array) -> Array:
    """Those of S^-1/2 dS S^-1/2 for the step, at every frequency."""
    inverse = _inverse_root(block.at(x))
    moved = _unpacked(block.slope @ step)
    return np.linalg.eigvalsh(inverse @ moved @ np.conj(np.swapaxes(inverse, 1, 2))).ravel()


def _directions(block: MatrixInequality, x: Array) -> tuple[Array, Array]:
    """(rows, ones): the vectors of S^-1/2 slope_a S^-1/2 as columns, (k r^2, n), and that of the identity."""
    rows = _turned(_inverse_root(block.at(x))) @ block.slope
    r = math.isqrt(rows.shape[1])
    return rows.reshape(-1, rows.shape[2]), np.tile(packed(np.eye(r, dtype=complex)), len(rows))


def _turned(W: Complex) -> Array:
    """H -> W H W* of `packed` matrices, (k, r^2, r^2): its entry a, b is the sum of W_ac conj(W_bd) H_cd."""
    r = W.shape[-1]
    c, d = np.triu_indices(r, 1)
    a, b = np.append(np.arange(r), c), np.append(np.arange(r), d)
    left, right = W[:, a, :], np.conj(W[:, b, :])
    one, other = left[..., c] * right[..., d], left[..., d] * right[..., c]
    through = np.concatenate([left * right, (one + other) / np.sqrt(2), 1j * (one - other) / np.sqrt(2)], axis=-1)
    off = np.sqrt(2) * through[:, r:]
    return np.concatenate([through[:, :r].real, off.real, off.imag], axis=1)


def packed(H: Complex) -> Array:
    """Hermitian matrices (.., r, r) as real vectors (.., r^2) of the same inner product."""
    upper = np.triu_indices(H.shape[-1], 1)
    off = np.sqrt(2) * H[..., upper[0], upper[1]]
    return np.concatenate([np.real(np.diagonal(H, axis1=-2, axis2=-1)), np.real(off), np.imag(off)], axis=-1)


def _unpacked(v: Array) -> Complex:
    """The Hermitian matrices of `packed`."""
    r = math.isqrt(v.shape[-1])
    upper, count = np.triu_indices(r, 1), r * (r - 1) // 2
    H = np.zeros((*v.shape[:-1], r, r), dtype=complex)
    H[..., upper[0], upper[1]] = (v[..., r : r + count] + 1j * v[..., r + count :]) / np.sqrt(2)
    H = H + np.conj(np.swapaxes(H, -2, -1))
    H[..., np.arange(r), np.arange(r)] = v[..., :r]
    return H


def _inverse_root(S: Complex) -> Complex:
    """W with W S W* = I."""
    return np.linalg.inv(np.linalg.cholesky(S)).astype(np.complex128, copy=False)


def _definite(S: Complex) -> bool:
    try:
        np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return False
    return bool(np.isfinite(S).all())
