"""The coefficients of Q as unknowns, and what the loop is at each frequency as an affine function of them.

G(z) = Psi E - Psi E Q Psi E with Q = sum_k Q_k b_k(z). A response is a pair (constant, slope) of shapes (k, m, m) and
(k, n, m, m): its value at the unknowns x is constant + sum_j x_j slope_j. A given Q is the case n = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.coupling import InternalModel, basis
from controller.lti import Array
from design.frequency.sweep import hermitian
from design.parameter.cone_program import Block, Complex

Response = tuple[Complex, Complex]

#: Coefficients are sought in this unit, which makes them numbers near one [m/N].
UNIT = 1e-3
#: ... and kept to this many digits after the point in m/N, so that their sum is symmetric to the last digit.
DIGITS = 15


@dataclass(frozen=True, eq=False)
class FreeParameter:
    """Q with every entry free, or every diagonal one; in UNIT, function by function."""

    poles: Array  # (functions - 1,)
    channels: int
    diagonal: bool

    @cached_property
    def entries(self) -> tuple[tuple[int, int, int], ...]:
        """(function, row, column) of each unknown."""
        m = self.channels
        pairs = [(i, j) for i in range(m) for j in range(m) if i == j or not self.diagonal]
        return tuple((k, i, j) for k in range(self.poles.size + 1) for i, j in pairs)

    @property
    def size(self) -> int:
        return len(self.entries)

    def at(self, z: Complex) -> Response:
        """Q(z) [m/N]."""
        b, m = basis(self.poles, z), self.channels
        slope = np.zeros((z.size, self.size, m, m), dtype=complex)
        for j, (function, row, column) in enumerate(self.entries):
            slope[:, j, row, column] = UNIT * b[:, function]
        return np.zeros((z.size, m, m), dtype=complex), slope

    def asymmetry(self) -> Array:
        """One row per pair of channels, zero on x where Q(1) is symmetric; (pairs, n)."""
        m = self.channels
        pairs = [] if self.diagonal else [(i, j) for i in range(m) for j in range(i)]
        rows = np.zeros((len(pairs), self.size))
        for row, (i, j) in zip(rows, pairs, strict=True):
            row[:] = [float((a, b) == (i, j)) - float((a, b) == (j, i)) for _, a, b in self.entries]
        return rows

    def coupling(self, x: Array) -> InternalModel:
        """The coupling with these coefficients, rounded to DIGITS; Q(1) is exactly symmetric in the decimals."""
        shape = (self.poles.size + 1, self.channels, self.channels)
        whole = np.zeros(shape, dtype=object)
        for value, entry in zip(x, self.entries, strict=True):
            whole[entry] = round(float(value) * UNIT * 10**DIGITS)
        static = whole.sum(axis=0)
        whole[0] -= np.tril(static - static.T, -1)
        return InternalModel(self.poles, np.array([float(f"{v}e-{DIGITS}") for v in whole.ravel()]).reshape(shape))


@dataclass(frozen=True, eq=False)
class GivenParameter:
    """The Q of a coupling, without unknowns."""

    given: InternalModel

    @property
    def size(self) -> int:
        return 0

    def at(self, z: Complex) -> Response:
        """Q(z) [m/N]."""
        Q = np.einsum("zk,kij->zij", basis(self.given.poles, z), self.given.Q)
        return Q, np.zeros((z.size, 0, *Q.shape[1:]), dtype=complex)


def loop_force(E: Complex, Q: Response) -> Response:
    """G = E - E Q E at each frequency, E standing for Psi E (k, m, m)."""
    constant, slope = Q
    return E - E @ constant @ E, -E[:, None] @ slope @ E[:, None]


def affine(response: Response, constant: Array | Complex, linear: Callable[[Complex], Complex]) -> Block:
    """constant + He[linear(response)] >= 0, for a linear map that accepts further leading axes."""
    value, slope = response
    return Block(constant + hermitian(linear(value)), np.moveaxis(hermitian(linear(np.moveaxis(slope, 1, 0))), 0, 1))


def bordered(diagonal: Array, corner: Complex) -> Complex:
    """[[diagonal, corner], [corner*, diagonal]]."""
    whole = np.broadcast_to(diagonal, corner.shape).astype(complex)
    return np.block([[whole, corner], [np.conj(np.swapaxes(corner, -1, -2)), whole]])
