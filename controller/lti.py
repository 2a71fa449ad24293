"""Discrete-time linear systems: x+ = A x + B u, y = C x + D u, sampled every T seconds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag, schur

Array = NDArray[np.floating[Any]]


class SingularLoop(ValueError):
    """A feedback interconnection whose algebraic loop has no solution."""


def frozen(value: ArrayLike, ndim: int, name: str = "") -> Array:
    """A read-only float64 copy of `value`, which must have `ndim` axes. Raises ValueError beginning with `name`."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _unlike(name, value, ndim) from None
    if array.ndim != ndim:
        raise _unlike(name, value, ndim, f", got shape {array.shape}")
    array.setflags(write=False)
    return array


def _unlike(name: str, value: ArrayLike, ndim: int, got: str = "") -> ValueError:
    """The error of `frozen`, apart: to write a matrix as text costs far more than to copy it."""
    expected = "a list of numbers" if ndim == 1 else f"an array of numbers with {ndim} axes"
    return ValueError(f"{name} is {value!r}, expected {expected}{got}" if name else f"expected {expected}{got}")


@dataclass(frozen=True, eq=False)
class Lti:
    """A state-space block with n states, m inputs and p outputs. `G @ H` is the series G(z) H(z)."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    C: Array  # (p, n)
    D: Array  # (p, m)
    T: float  # [s]

    if TYPE_CHECKING:  # what __post_init__ accepts is more than what the fields then hold

        def __init__(self, A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, T: float) -> None: ...

    def __post_init__(self) -> None:
        for name in "ABCD":
            object.__setattr__(self, name, frozen(getattr(self, name), 2, name))
        (n, m), p = self.B.shape, self.C.shape[0]
        shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}
        for name, shape in shapes.items():
            matrix = getattr(self, name)
            if matrix.shape != shape:
                raise ValueError(f"{name} has shape {matrix.shape}, expected {shape}")
            if not np.isfinite(matrix).all():
                raise ValueError(f"{name} has entries that are not finite")
        if not 0 < self.T < np.inf:
            raise ValueError(f"T must be positive and finite, got {self.T}")

    @classmethod
    def constant(cls, D: ArrayLike, T: float) -> Self:
        """The memoryless block y = D u."""
        D = frozen(D, 2)
        p, m = D.shape
        return cls(np.zeros((0, 0)), np.zeros((0, m)), np.zeros((p, 0)), D, T)

    @classmethod
    def diag(cls, *blocks: Lti) -> Self:
        """The blocks side by side, each with its own inputs and outputs."""
        A, B, C, D = (np.asarray(block_diag(*(getattr(g, name) for g in blocks))) for name in "ABCD")
        return cls(A, B, C, D, _common_period(*blocks))

    @property
    def order(self) -> int:
        return self.A.shape[0]

    @property
    def inputs(self) -> int:
        return self.B.shape[1]

    @property
    def outputs(self) -> int:
        return self.C.shape[0]

    def at(self, z: ArrayLike) -> NDArray[np.complex128]:
        """G(z), shape z.shape + (p, m).

        By back substitution in the complex Schur form of A, which stays accurate for the defective
        matrices of delay lines where an eigenvector basis does not exist.
        """
        z = np.asarray(z, dtype=np.complex128)
        points = z.ravel()
        S, U = self._schur
        rhs = U.conj().T @ self.B
        X = np.empty((self.order, self.inputs * points.size), dtype=np.complex128)
        for i in reversed(range(self.order)):
            later = (S[i, i + 1 :] @ X[i + 1 :]).reshape(self.inputs, points.size)
            X[i] = ((rhs[i][:, None] + later) / (points - S[i, i])).ravel()
        G = (self.C @ U @ X).reshape(self.outputs, self.inputs, points.size) + self.D[:, :, None]
        return np.moveaxis(G, -1, 0).reshape(*z.shape, self.outputs, self.inputs)

    @cached_property
    def _schur(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """S, U with A = U S U* and S upper triangular: once per block, however often it is evaluated."""
        if not self.order:
            return np.zeros((0, 0), dtype=np.complex128), np.zeros((0, 0), dtype=np.complex128)
        S, U, *_ = schur(self.A, output="complex")
        return S, U

    def dc(self) -> Array:
        """G(1), shape (p, m)."""
        return self.C @ np.linalg.solve(np.eye(self.order) - self.A, self.B) + self.D

    def poles(self) -> NDArray[np.complex128]:
        """Eigenvalues of A, shape (n,)."""
        return np.linalg.eigvals(self.A).astype(np.complex128)

    def is_stable(self) -> bool:
        """Whether every pole lies strictly inside the unit circle."""
        return bool(np.all(np.abs(self.poles()) < 1))

    def quotient_at_one(self) -> Lti:
        """(G(z) - G(1)) / (z - 1): stable where G is, so G/(z - 1) without its pole at z = 1."""
        C = -np.linalg.solve((np.eye(self.order) - self.A).T, self.C.T).T
        return Lti(self.A, self.B, C, np.zeros_like(self.D), self.T)

    def __matmul__(self, other: Lti) -> Lti:
        T = _common_period(self, other)
        A = np.block(
            [
                [other.A, np.zeros((other.order, self.order))],
                [self.B @ other.C, self.A],
            ]
        )
        B = np.vstack([other.B, self.B @ other.D])
        C = np.hstack([self.D @ other.C, self.C])
        return Lti(A, B, C, self.D @ other.D, T)

    def __add__(self, other: Lti) -> Lti:
        T = _common_period(self, other)
        A = np.asarray(block_diag(self.A, other.A))
        B = np.vstack([self.B, other.B])
        return Lti(A, B, np.hstack([self.C, other.C]), self.D + other.D, T)

    def __neg__(self) -> Lti:
        return Lti(self.A, self.B, -self.C, -self.D, self.T)

    def __sub__(self, other: Lti) -> Lti:
        return self + (-other)

    def feedback(self, other: Lti) -> Lti:
        """(I + G H)^-1 G: this block with H = `other` in negative feedback around it.

        Raises SingularLoop where I + D_G D_H cannot be inverted.
        """
        T = _common_period(self, other)
        loop = np.eye(self.outputs) + self.D @ other.D
        if np.linalg.cond(loop) > 1e12:
            raise SingularLoop(f"the algebraic loop I + D_G D_H is singular: {loop.tolist()}")
        S = np.linalg.inv(loop)
        # y = S (C x - D_G C_H h + D_G u), and the feedback block is driven by y
        y_x = np.hstack([S @ self.C, -S @ self.D @ other.C])
        y_u = S @ self.D
        u_x = np.hstack([np.zeros((self.inputs, self.order)), -other.C]) - other.D @ y_x
        u_u = np.eye(self.inputs) - other.D @ y_u
        A = np.asarray(block_diag(self.A, other.A)) + np.vstack([self.B @ u_x, other.B @ y_x])
        return Lti(A, np.vstack([self.B @ u_u, other.B @ y_u]), y_x, y_u, T)


def _common_period(*blocks: Lti) -> float:
    periods = {g.T for g in blocks}
    if len(periods) != 1:
        raise ValueError(f"blocks with different sampling periods: {sorted(periods)}")
    return periods.pop()
