"""Quadratic programs over Hermitian inequalities: minimise |A x - b|^2/2 + c'x with H_0 + sum_j x_j H_j >= 0.

An inequality at k frequencies is one `Block`. A Hermitian matrix of size one is a half-line, of size two a second-order
cone (a + b >= |(a - b, 2 Re c, 2 Im c)|), of size r the real symmetric matrix [[Re, -Im], [Im, Re]] of size 2r.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Block:
    """constant + sum_j x_j slope_j >= 0, at k frequencies."""

    constant: Complex  # (k, r, r), Hermitian
    slope: Complex  # (k, n, r, r), Hermitian

    @property
    def size(self) -> int:
        return self.constant.shape[-1]

    def at(self, x: Array) -> Complex:
        """The matrices at x, shape (k, r, r)."""
        return self.constant + np.einsum("j,kjab->kab", x, self.slope)

    def least(self, x: Array) -> Array:
        """Their least eigenvalues, shape (k,)."""
        return np.linalg.eigvalsh(self.at(x))[:, 0]

    def padded(self, more: int) -> Block:
        """The same inequalities with `more` unknowns at the end, which do not enter."""
        k, _, r, _ = self.slope.shape
        return Block(self.constant, np.concatenate([self.slope, np.zeros((k, more, r, r), dtype=complex)], axis=1))

    def changed(self, basis: Array) -> Block:
        """The same inequalities in y, where x = basis y."""
        return Block(self.constant, np.einsum("kjab,jl->klab", self.slope, basis))

    def rows(self) -> tuple[Array, Array]:
        """(s_0, S) with s_0 + S x in the cone, shapes (k, d) and (k, d, n), d entries per frequency."""
        return vectors(self.constant), np.moveaxis(vectors(self.slope), 1, 2)


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """minimise |A x - b|^2/2 + c'x subject to every block, and equalities E x = e."""

    A: Array  # (rows, n)
    b: Array  # (rows,)
    c: Array  # (n,)
    blocks: tuple[Block, ...]
    E: Array  # (equalities, n)
    e: Array  # (equalities,)

    def objective(self, x: Array) -> float:
        residual = self.A @ x - self.b
        return float(residual @ residual / 2 + self.c @ x)

    def violation(self, x: Array) -> float:
        """By how much the worst inequality or equality fails."""
        worst = max((-float(block.least(x).min(initial=0.0)) for block in self.blocks), default=0.0)
        return max(worst, float(np.abs(self.E @ x - self.e).max(initial=0.0)))


def vectors(H: Complex) -> Array:
    """The Hermitian matrices H, shape (.., r, r), as vectors of their cone, shape (.., d)."""
    r = H.shape[-1]
    if r == 1:
        return H[..., 0, 0].real[..., None]
    if r == 2:
        a, b, c = H[..., 0, 0].real, H[..., 1, 1].real, H[..., 0, 1]
        return np.stack([a + b, a - b, 2 * c.real, 2 * c.imag], axis=-1)
    real = np.block([[H.real, -H.imag], [H.imag, H.real]])
    column, row = np.tril_indices(2 * r)  # the upper triangle, column by column
    return real[..., row, column] * np.where(row == column, 1.0, np.sqrt(2.0))
