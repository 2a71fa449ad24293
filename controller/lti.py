"""Discrete-time linear systems x+ = A x + B u, y = C x + D u, in any arithmetic, and their sampled responses.

A stability condition is written once as an expression over blocks, and is evaluated in several ways. `Lti` holds one
system or a stack of systems (leading axes) in floats, or one system in Fractions. `Sampled` holds G(z) at points of
the unit circle. Both have the operators

    G @ H   series G(z) H(z)        G + H, G - H, -G, c * G        M @ G, G @ M, G + M   with a constant matrix M
    G.feedback(H)           (I + G H)^-1 G
    G.over_z_minus_one()    G(1) (0 for Sampled), and a block whose Hermitian part on the circle is that of G/(z - 1)

The type of the period decides the arithmetic. A block with a float T has floating-point matrices. A block with a
Fraction T is exact, and a float then stands for its shortest decimal: 0.0012 is 12/10000.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import pairwise
from math import isfinite
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.arithmetic import (
    Array,
    Number,
    SingularLoop,
    compiled,
    eye,
    fractions,
    inverse,
    numbers,
    solve,
    spend,
    times,
)

Complex = NDArray[np.complex128]


def frozen(value: ArrayLike, ndim: int, name: str = "") -> Array:
    """Return a read-only float64 copy of `value`. Raises ValueError about `name` unless `value` has `ndim` axes."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _unlike(name, value, ndim) from None
    if array.ndim != ndim:
        raise _unlike(name, value, ndim, f", got shape {array.shape}")
    array.setflags(write=False)
    return array


def _unlike(name: str, value: ArrayLike, ndim: int, got: str = "") -> ValueError:
    """Return the error for an unsuitable array. It is created only if needed, as formatting a matrix takes long."""
    expected = "a list of numbers" if ndim == 1 else f"an array of numbers with {ndim} axes"
    return ValueError(f"{name} is {value!r}, expected {expected}{got}" if name else f"expected {expected}{got}")


class ReadOnly:
    """A record whose arrays remain read-only when it is pickled or copied, unlike ordinary NumPy arrays."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__.update(state)


_ROWS, _POINTS, _CELLS = 32, 1024, 2**18  # rows of the Schur form, points and entries that fit into the cache
_SHORT, _DOUBLINGS = 0.3, 5  # the powers of poles up to 0.3 decay to 2e-17 within 2^5 samples
_ERROR = 1e-9  # largest error of a sum over poles and taps, relative to the largest response of an output
_UNIT = 1e-15  # bound on the rounding of a product of a few matrices, relative to its terms
_UNSEEN = 1e-18  # trailing weights below this size, relative to the response, are omitted
_ANYWHERE = np.linspace(0.05, 3.0, 6)  # [rad/sample] a response's size is evaluated here and at the angles of its poles
_OFF_CIRCLE = 1e-9  # largest | |z|^2 - 1 | of a point on the unit circle


def _response_cost(states: int, inputs: int, points: int) -> float:
    """Return an estimate of the work of a response, in the units that `spend` counts."""
    return 4e-5 + 2e-6 * states + points * inputs * (4e-8 + 6e-9 * states + 2e-10 * states**2)


@dataclass(frozen=True, eq=False)
class Lti(ReadOnly):
    """A state-space block with n states, m inputs and p outputs. The axes `...` index the systems of a stack."""

    A: Array  # (..., n, n)
    B: Array  # (..., n, m)
    C: Array  # (..., p, n)
    D: Array  # (..., p, m)
    T: Any  # [s] float or Fraction

    __array_ufunc__ = None  # lets `matrix @ G` call __rmatmul__

    if TYPE_CHECKING:  # __post_init__ accepts more types than the fields have afterwards

        def __init__(self, A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike, T: Number) -> None: ...

    def __post_init__(self) -> None:
        own, exact = self.__dict__, isinstance(self.T, Fraction)
        for name in "ABCD":
            own[name] = fractions(own[name]) if exact else _floats(own[name], name)
        (n, m), p = self.B.shape[-2:], self.C.shape[-2]
        for name, shape in (("A", (n, n)), ("B", (n, m)), ("C", (p, n)), ("D", (p, m))):
            matrix = own[name]
            if matrix.shape[-2:] != shape:
                raise ValueError(f"{name} has shape {matrix.shape}, expected {shape}")
            # If the sum of squares is finite, so are all entries. Testing the sum is faster than np.isfinite.
            if not exact and not isfinite(np.vdot(matrix, matrix)) and not np.isfinite(matrix).all():
                raise ValueError(f"{name} has entries that are not finite")
        if not 0 < self.T < np.inf:
            raise ValueError(f"T must be positive and finite, got {self.T}")

    @classmethod
    def constant(cls, D: ArrayLike, T: Number) -> Self:
        """Return the memoryless block y = D u. Raises ValueError unless D has at least 2 axes."""
        gain: Any = numbers(D, T) if isinstance(T, Fraction) else np.asarray(D, dtype=np.float64)
        if gain.ndim < 2:
            raise ValueError(f"expected an array of numbers with 2 axes, got shape {gain.shape}")
        *lead, p, m = gain.shape
        return cls(np.zeros((*lead, 0, 0)), np.zeros((*lead, 0, m)), np.zeros((*lead, p, 0)), gain, T)

    @classmethod
    def with_rest(cls, A: Array, B: Array, R: Array, static: Array, T: Number) -> Self:
        """Return G = static + (R - R z)(z I - A)^-1 B, for which G(1) = static and C (I - A)^-1 = R are known."""
        block = cls(A, B, R - R @ A, static - R @ B, T)
        block.__dict__["_rest"] = static, R
        return block

    @classmethod
    def diag(cls, *blocks: Lti) -> Self:
        """Return the block-diagonal system: each block keeps its own inputs and outputs."""
        A, B, C, D = (block_diagonal([getattr(g, name) for g in blocks]) for name in "ABCD")
        joined = cls(A, B, C, D, _common_period(*blocks))
        return _with_parts(joined, lambda: tuple(map(block_diagonal, zip(*(g._rest for g in blocks), strict=True))))

    @property
    def order(self) -> int:
        return self.A.shape[-1]

    @property
    def inner_order(self) -> int:
        """The number of states, not counting delay lines at outputs, which cost little time in a response."""
        return self._lines[0].size

    @property
    def inputs(self) -> int:
        return self.B.shape[-1]

    @property
    def outputs(self) -> int:
        return self.C.shape[-2]

    @property
    def is_exact(self) -> bool:
        return isinstance(self.T, Fraction)

    @property
    def count(self) -> int:
        """The number of systems in the stack."""
        return np.broadcast_shapes(*(getattr(self, name).shape[:-2] for name in "ABCD"))[0]

    def __getitem__(self, i: int) -> Lti:
        A, B, C, D = (part[i] if part.ndim > 2 else part for part in (self.A, self.B, self.C, self.D))
        return Lti(A, B, C, D, self.T)

    def floats(self) -> Lti:
        """Return the system in floating point, with every coefficient correctly rounded."""
        A, B, C, D = (np.asarray(getattr(self, name), dtype=np.float64) for name in "ABCD")
        return Lti(A, B, C, D, float(self.T))

    def at(self, z: ArrayLike) -> Complex:
        """Return G(z), shape z.shape + (p, m). A stack takes z (n, k) or (1, k) and returns (n, k, p, m).

        On the unit circle a single system is evaluated as a sum over poles and taps (`_terms`). At other points, for a
        lower triangular A, or if the sum is inaccurate, a single system is evaluated by back substitution in the
        complex Schur form of A.
        """
        z = np.asarray(z, dtype=np.complex128)
        if response := self.__dict__.get("_response"):
            return response(z.ravel()).reshape(*z.shape, self.outputs, self.inputs)
        if self.A.ndim > 2 or self.B.ndim > 2 or self.C.ndim > 2 or self.D.ndim > 2:
            one = np.eye(self.order)
            A, B, C, D = (getattr(self, name)[..., None, :, :] for name in "ABCD")
            spend(self.count * z.shape[-1] * (1e-6 + 1e-10 * self.order**3))
            return C @ np.linalg.solve(z[..., None, None] * one - A, B + 0j) + D
        points = z.ravel()
        step = min(_POINTS, max(_CELLS // max(self.inner_order * self.inputs, 1), 64))
        parts = [self._resolved(points[i : i + step]) for i in range(0, max(points.size, 1), step)]
        G = (parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)) + self.D[:, :, None]
        return G.transpose(2, 0, 1).reshape(*z.shape, self.outputs, self.inputs)

    def _resolved(self, points: Complex) -> Complex:
        """Return C (z I - A)^-1 B, shape (p, m, points).

        Each delay line adds the delayed response of its head, the core state that it copies (`_lines`).
        """
        core, lines = self._lines
        p, m = self.outputs, self.inputs
        spend(_response_cost(core.size, m, points.size))
        if not core.size:
            return np.zeros((p, m, points.size), dtype=np.complex128)
        terms = self._terms
        if terms is None or (np.abs(points.real**2 + points.imag**2 - 1) > _OFF_CIRCLE).any():
            rows = self._substituted(points)
        else:
            rows = _summed(*terms, points).reshape(p + len(lines), m, points.size)
        G = rows[:p]
        for (_, states, late), head in zip(lines, rows[p:], strict=True):
            read = np.flatnonzero(self.C[:, states].any(axis=1))
            powers = _powers(1 / points, late.max())[late - 1]
            G[read] += (self.C[np.ix_(read, states)] @ powers)[:, None] * head
        return G

    def _substituted(self, points: Complex) -> Complex:
        """Return the responses (p + lines, m, points) of the outputs and the heads of delay lines by substitution."""
        S, U = self._schur
        core, lines = self._lines
        at, X = np.tile(points, self.inputs), np.repeat(U.conj().T @ self.B[core], points.size, axis=1)
        for end in range(core.size, 0, -_ROWS):
            first = max(end - _ROWS, 0)
            for i in reversed(range(first, end)):
                X[i] = (X[i] + S[i, i + 1 : end] @ X[i + 1 : end]) / (at - S[i, i])
            rows: Any = np.flatnonzero(S[:first, first:end].any(axis=1))
            if rows.size > first // 2:
                rows = slice(first)
            X[rows] += S[rows, first:end] @ X[first:end]
        read = np.concatenate([self.C[:, core], np.eye(core.size)[[head for head, *_ in lines]]])
        return (read @ U @ X).reshape(len(read), self.inputs, points.size)

    @cached_property
    def _terms(self) -> tuple[Complex, Complex, Array] | None:
        """Split the response of outputs and heads (`_lines`) into poles, residues, and weights of z^-1, z^-2, ..

        Poles with |z| > _SHORT have right and left eigenvectors V and W, and P = V W projects onto their eigenspace.
        The other part of A, N = (I - P) A, has the many poles at or near 0 that belong to delays. Its powers vanish
        within 2^_DOUBLINGS samples, so that its response is a finite sum.

        The error follows from the residual of (z I - A) X = B. The states
        X(z) = V (z - poles)^-1 W B + sum_j Y_j z^-(j+1), with Y_j = N^j (I - P) B, leave the residual
        (V poles - A V) (z - poles)^-1 W B + sum_j (Y_(j+1) - A Y_j) z^-(j+1) - A Y_last z^-(last+1). Its entries, and
        the response of the outputs to it, are bounded over the unit circle. The bound does not depend on the units of
        the states. It is compared with the response at a few points, because terms may cancel.

        Returns:
            (poles (k,), residues ((p + lines) m, k), weights ((p + lines) m, j)), or None if A is lower
            triangular, the eigenvectors do not give P, or the error may exceed _ERROR.
        """
        core, lines = self._lines
        A, B = self.A[core[:, None], core], self.B[core]
        if not np.triu(A, 1).any():
            return None
        C = np.concatenate([self.C[:, core], np.eye(core.size)[[head for head, *_ in lines]]])
        if (modes := _long_modes(A)) is None:
            return None
        poles, V, W = modes
        rest = np.eye(core.size) - (V @ W).real
        # Y holds N^j (I - P) B side by side, and `rows` holds C N^j (I - P) one below the other
        Y, rows, power = rest @ B, C @ rest, rest @ A
        for _ in range(_DOUBLINGS):
            Y, rows = np.hstack([Y, power @ Y]), np.vstack([rows, rows @ power])
            power = power @ power
        n, m, p, taps = core.size, self.inputs, len(C), 2**_DOUBLINGS
        out, into, missed = C @ V, W @ B, A @ Y
        missed[:, :-m] -= Y[:, m:]
        weights = (C @ Y).reshape(p, taps, m).swapaxes(1, 2).reshape(p * m, taps)
        residues = (out[:, None] * into.T).reshape(p * m, poles.size).astype(np.complex128)
        points = np.exp(1j * np.concatenate([_ANYWHERE, np.angle(poles)]))
        with np.errstate(all="ignore"):  # an error that is not finite exceeds the bound
            peak = 1 / np.abs(1 - np.abs(poles))
            driven = peak[:, None] * np.abs(into)
            wrong = np.abs(A @ V - V * poles) @ driven + np.abs(missed).reshape(n, taps, m).sum(axis=1)
            error = ((np.abs(out) * peak) @ np.abs(W) + np.abs(rows).reshape(taps, p, n).sum(axis=0)) @ wrong
            error += _UNIT * np.abs(C) @ (np.abs(V) @ driven + np.abs(Y).reshape(n, taps, m).sum(axis=1))
            size = np.abs(_summed(poles, residues, weights, points)).reshape(p, -1).max(axis=1)[:, None]
            if not (error <= _ERROR * size).all():
                return None
        seen = (np.abs(weights).reshape(p, m, taps) > _UNSEEN * size[:, None]).any(axis=(0, 1))
        return poles, residues, weights[:, : np.append(0, 1 + np.flatnonzero(seen))[-1]].copy()

    def with_response(self, response: Callable[[Complex], Complex]) -> Lti:
        """Return the system with a faster `at` for points (k,). G @ H uses the faster `at` of H."""
        system = Lti(self.A, self.B, self.C, self.D, self.T)
        system.__dict__["_response"] = response
        return system

    def at_rest(self, x: Array) -> Array:
        """Return the state s = A s + B x for constant inputs x; of several solutions, the one of least norm."""
        s: Array = np.linalg.lstsq(np.eye(self.order) - self.A, self.B @ x, rcond=None)[0]
        return s

    @cached_property
    def _lines(self) -> tuple[NDArray[np.intp], list[tuple[int, NDArray[np.intp], NDArray[np.intp]]]]:
        """Split the states into core states and delay lines, each (index of its head in the core, states, delays).

        The states of a delay line are delayed copies of a core state, its head. No core state reads these copies.
        """
        reads = self.A != 0
        repeats = (reads.sum(axis=1) == 1) & (self.A.sum(axis=1) == 1) & ~self.B.any(axis=1)
        if not repeats.any():
            return np.arange(self.order), []
        while (elsewhere := repeats & reads[~repeats].any(axis=0)).any():
            repeats &= ~elsewhere
        followers: dict[int, list[int]] = {}
        for i in np.flatnonzero(repeats):
            followers.setdefault(int(reads[i].argmax()), []).append(int(i))
        lines = {head: [(head, 0)] for head in followers if not repeats[head]}
        for line in lines.values():
            for i, late in line:  # the list grows while it is read
                line += [(follower, late + 1) for follower in followers.get(i, ())]
        inner = np.ones(self.order, dtype=bool)
        inner[[i for line in lines.values() for i, _ in line[1:]]] = False
        core = np.flatnonzero(inner)
        places = np.searchsorted(core, list(lines))
        parts = [np.array(line[1:], dtype=np.intp).T for line in lines.values()]
        return core, [(int(head), states, late) for head, (states, late) in zip(places, parts, strict=True)]

    @cached_property
    def _schur(self) -> tuple[Complex, Complex]:
        """The Schur form A = U S U* of the core states, with S upper triangular.

        If A is block lower triangular, as for delay lines and chains of sections, each diagonal block gets its own
        Schur form, and S keeps the zeros of A. The blocks of S are in reverse order.
        """
        core = self._lines[0]
        return _schur_blocks(self.A[core[:, None], core])

    def dc(self) -> Array:
        """Return G(1), shape (..., p, m). Raises SingularLoop if A has the eigenvalue one."""
        return self._rest[0] if self.is_exact else self.C @ solve(eye(self.order, self.T) - self.A, self.B) + self.D

    @cached_property
    def _rest(self) -> tuple[Array, Array]:
        """G(1), shape (..., p, m), and R = C (I - A)^-1, shape (..., p, n).

        An exact block from G @ H, G @ M, `feedback`, `diag`, `rows` or `hstack` computes both from its parts, because
        this takes far less work than eliminating all states. Raises SingularLoop if A has the eigenvalue one.
        """
        if from_parts := self.__dict__.get("_parts"):
            try:
                return from_parts()
            except SingularLoop:  # a part is singular at z = 1; the composed block may be regular
                pass
        transposed = np.swapaxes(eye(self.order, self.T) - self.A, -1, -2)
        R = np.swapaxes(solve(transposed, np.swapaxes(self.C, -1, -2)), -1, -2)
        return self.D + times(R, self.B), R

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("A", "B", "C", "D", "T")}

    def poles(self) -> Complex:
        """Return the eigenvalues of A, (..., n). For a single system, delay lines at outputs give exactly 0."""
        if self.A.ndim > 2:
            return np.linalg.eigvals(self.A).astype(np.complex128)
        core = self._lines[0]
        eigenvalues = _eigenvalues(self.A[core[:, None], core])
        return np.append(eigenvalues, np.zeros(self.order - core.size)).astype(np.complex128)

    def is_stable(self) -> bool:
        """Return whether every pole lies strictly inside the unit circle."""
        return bool(np.all(np.abs(self.poles()) < 1))

    def split_at_one(self) -> tuple[Array, Lti]:
        """Return G(1) and (G(z) - G(1))/(z - 1), stable if G is. Raises SingularLoop if A has the eigenvalue one."""
        static, R = self._rest
        return static, Lti(self.A, self.B, -R, np.zeros_like(self.D), self.T)

    def over_z_minus_one(self) -> tuple[Array, Lti]:
        """Return G(1) and a stable block whose Hermitian part on the circle is that of G/(z - 1), except at z = 1.

        The block is (G - G(1))/(z - 1) - G(1)/2, since the real part of 1/(z - 1) is -1/2 on the circle. G must be
        stable and G(1) symmetric.
        """
        static, quotient = self.split_at_one()
        return static, quotient - static / 2

    def __matmul__(self, other: Lti | Array) -> Lti:
        B, D = self.B, self.D
        if not isinstance(other, Lti):
            product = Lti(self.A, times(B, other), self.C, times(D, other), self.T)
            return _with_parts(product, lambda: (times(self._rest[0], other), self._rest[1]))
        T = _common_period(self, other)
        zero = np.zeros((other.order, self.order), dtype=int)
        A = _block([[other.A, zero], [times(B, other.C), self.A]])
        C = _block([[times(D, other.C), self.C]])
        series = Lti(A, _block([[other.B], [times(B, other.D)]]), C, times(D, other.D), T)
        if "_response" in other.__dict__:
            return series.with_response(lambda z: self.at(z) @ other.at(z))

        def rest() -> tuple[Array, Array]:
            (own, R), (static, S) = self._rest, other._rest
            return times(own, static), _block([[times(own, S), R]])

        return _with_parts(series, rest)

    def __rmatmul__(self, matrix: Array) -> Lti:
        return Lti(self.A, self.B, times(matrix, self.C), times(matrix, self.D), self.T)

    def __add__(self, other: Lti | Array) -> Lti:
        if not isinstance(other, Lti):
            return Lti(self.A, self.B, self.C, self.D + other, self.T)
        T = _common_period(self, other)
        A = block_diagonal([self.A, other.A])
        return Lti(A, _block([[self.B], [other.B]]), _block([[self.C, other.C]]), self.D + other.D, T)

    __radd__ = __add__

    def __neg__(self) -> Lti:
        return Lti(self.A, self.B, -self.C, -self.D, self.T)

    def __sub__(self, other: Lti | Array) -> Lti:
        return self + (-other)

    def __rsub__(self, other: Array) -> Lti:
        return -self + other

    def __mul__(self, factor: Any) -> Lti:
        return Lti(self.A, self.B, self.C * factor, self.D * factor, self.T)

    __rmul__ = __mul__

    def rows(self, which: Any) -> Lti:
        """Return the system with the outputs `which` only."""
        some = Lti(self.A, self.B, self.C[..., which, :], self.D[..., which, :], self.T)
        return _with_parts(some, lambda: tuple(part[..., which, :] for part in self._rest))

    def feedback(self, other: Lti) -> Lti:
        """Return (I + G H)^-1 G with H = `other`. Raises SingularLoop if I + D_G D_H cannot be inverted."""
        T = _common_period(self, other)
        S = inverse(eye(self.outputs, T) + times(self.D, other.D))
        # y = S (C x - D_G C_H h + D_G u) is the input of the feedback block, whose state is h
        y_u = times(S, self.D)
        y_x = _block([[times(S, self.C), -times(y_u, other.C)]])
        u_x = _block([[np.zeros((self.inputs, self.order), dtype=int), -other.C]]) - times(other.D, y_x)
        u_u = eye(self.inputs, T) - times(other.D, y_u)
        A = block_diagonal([self.A, other.A]) + _block([[times(self.B, u_x)], [times(other.B, y_x)]])
        loop = Lti(A, _block([[times(self.B, u_u)], [times(other.B, y_u)]]), y_x, y_u, T)

        def rest() -> tuple[Array, Array]:
            (own, R), (static, Q) = self._rest, other._rest
            closed = inverse(eye(self.outputs, T) + times(own, static))
            return times(closed, own), times(closed, _block([[R, -times(own, Q)]]))

        return _with_parts(loop, rest)

    def inverse(self) -> Lti:
        """Return G^-1. Raises SingularLoop if D cannot be inverted."""
        D = inverse(self.D)
        B, C = times(self.B, D), times(D, self.C)
        return Lti(self.A - times(B, self.C), B, -C, D, self.T)


_Result = TypeVar("_Result")


def _remembered(function: Callable[[Array], _Result]) -> Callable[[Array], _Result]:
    """Remember the results of a function for the last two matrices (n, n), because many blocks share their A."""

    @lru_cache(maxsize=2)
    def of(entries: bytes, n: int) -> _Result:
        return function(np.frombuffer(entries).reshape(n, n))

    return lambda A: of(np.asarray(A, np.float64).tobytes(), len(A))


@_remembered
def _eigenvalues(A: Array) -> Complex:
    return np.linalg.eigvals(A).astype(np.complex128)


@_remembered
def _long_modes(A: Array) -> tuple[Complex, Complex, Complex] | None:
    """Return the poles of A with |z| > _SHORT, and their right and left eigenvectors V and W with W V = I, or None."""
    try:
        (poles, others), (V, U) = np.linalg.eig(np.stack([A, A.T]))
        long, same = np.abs(poles) > _SHORT, np.abs(others) > _SHORT
        if long.sum() != same.sum():
            return None
        poles, V, W = poles[long], V[:, long], U[:, same].T
        return poles, V, np.linalg.solve(W @ V, W)
    except np.linalg.LinAlgError:
        return None


@_remembered
def _schur_blocks(A: Array) -> tuple[Complex, Complex]:
    """Return S and U of `Lti._schur` for the core matrix A."""
    n = len(A)
    last = np.maximum.accumulate(np.where((A != 0) | np.eye(n, dtype=bool), np.arange(n), 0).max(axis=1))
    ends = 1 + np.flatnonzero(last == np.arange(n))
    if ends.size == 1 < n:
        return _schur_form(A)
    U = np.zeros((n, n), dtype=np.complex128)
    for first, end in pairwise([0, *ends.tolist()]):
        own = A[first:end, first:end]
        U[first:end, n - end : n - first] = 1 if end - first == 1 else _schur_form(own)[1]
    return np.triu(U.conj().T @ A @ U), U


def _schur_form(A: Array) -> tuple[Complex, Complex]:
    """Return S, U with A = U S U^H, as scipy.linalg.schur(A, "complex") does. Raises LinAlgError."""
    gees, entries = compiled("scipy.linalg._flapack").zgees, np.asarray_chkfinite(A, np.complex128)
    size = int(gees(lambda pole: None, entries, lwork=-1)[-2][0].real)
    S, *_, U, _, fault = gees(lambda pole: None, entries, lwork=size, sort_t=0)
    if fault:
        raise np.linalg.LinAlgError("the Schur form did not converge")
    return S, U


def _summed(poles: Complex, residues: Complex, weights: Array, points: Complex) -> Complex:
    """Return sum residues/(z - poles) + sum_j weights_j z^-(j+1) at points z, (entries, points)."""
    total = residues @ (1 / (points - poles[:, None]))
    if weights.size:
        late = _powers(1 / points, weights.shape[1])
        total.real += weights @ late.real.copy()  # OpenBLAS may be far slower with complex matrices of few rows
        total.imag += weights @ late.imag.copy()
    return total


def _powers(z: Complex, count: int) -> Complex:
    """Return z, z^2, .. of points z, (count, points)."""
    powers = np.empty((count, z.size), dtype=np.complex128)
    powers[:1], known = z, 1
    while known < count:
        more = min(known, count - known)
        np.multiply(powers[:more], powers[known - 1], out=powers[known : known + more])
        known += more
    return powers


@dataclass(frozen=True, eq=False)
class Sampled:
    """Responses G(z) of n systems at points z of the unit circle other than 1."""

    z: Complex  # (n, k) or (1, k)
    G: Complex  # (n, k, p, m), or a shape that broadcasts to it
    T: float  # [s]

    __array_ufunc__ = None

    @classmethod
    def of(cls, system: Lti, z: Complex) -> Sampled:
        return cls(z, system.at(z), system.T)

    def __matmul__(self, other: Sampled | Array) -> Sampled:
        return self._with(_product(self.G, other.G if isinstance(other, Sampled) else other))

    def __rmatmul__(self, matrix: Array) -> Sampled:
        return self._with(_product(matrix, self.G))

    def __add__(self, other: Sampled | Array) -> Sampled:
        return self._with(self.G + (other.G if isinstance(other, Sampled) else other))

    __radd__ = __add__

    def __neg__(self) -> Sampled:
        return self._with(-self.G)

    def __sub__(self, other: Sampled | Array) -> Sampled:
        return self + (-other)

    def __rsub__(self, other: Array) -> Sampled:
        return -self + other

    def __mul__(self, factor: Number) -> Sampled:
        return self._with(self.G * float(factor))

    __rmul__ = __mul__

    def rows(self, which: Any) -> Sampled:
        return self._with(self.G[..., which, :])

    def feedback(self, other: Sampled) -> Sampled:
        m = self.G.shape[-1]
        if m == 2:  # (I + G H)^-1 G = (G + det(G) adj(H))/det(I + G H) is far faster than a solve for each matrix
            (a, b), (c, d) = _entries(self.G)
            (e, f), (g, h) = _entries(other.G)
            det = a * d - b * c
            closed = 1 + a * e + b * g + c * f + d * h + det * (e * h - f * g)
            return self._with(_matrix((a + det * h, b - det * f), (c - det * g, d + det * e)) / closed[..., None, None])
        loop = np.eye(m) + self.G @ other.G
        return self._with(self.G / loop if m == 1 else np.linalg.solve(loop, self.G))

    def inverse(self) -> Sampled:
        return self._with(1 / self.G if self.G.shape[-1] == 1 else np.linalg.inv(self.G))

    def over_z_minus_one(self) -> tuple[Array, Sampled]:
        """Return zero and G/(z - 1). The zero stands for G(1), which sampled responses do not contain."""
        step = -0.5 - 0.5j / np.tan(np.angle(self.z) / 2)  # 1/(z - 1), without the cancellation of z - 1 near z = 1
        return np.zeros(self.G.shape[-2:]), self._with(self.G * step[..., None, None])

    def _with(self, G: Any) -> Sampled:
        return Sampled(self.z, G, self.T)


def _entries(G: Complex) -> tuple[tuple[Complex, Complex], tuple[Complex, Complex]]:
    """Return the four entries of 2 x 2 matrices over the last two axes."""
    return (G[..., 0, 0], G[..., 0, 1]), (G[..., 1, 0], G[..., 1, 1])


def _matrix(*rows: Sequence[Complex]) -> Complex:
    out = np.empty((*np.broadcast_shapes(*(entry.shape for row in rows for entry in row)), 2, 2), dtype=np.complex128)
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            out[..., i, j] = entry
    return out


def _product(G: Any, H: Any) -> Any:
    """Return G @ H. Small matrices are multiplied entry by entry, which is much faster than NumPy's product."""
    if G.shape[-1] == 1:
        return G * H
    if G.shape[-2:] == H.shape[-2:] == (2, 2):
        (a, b), (c, d) = _entries(G)
        (e, f), (g, h) = _entries(H)
        return _matrix((a * e + b * g, a * f + b * h), (c * e + d * g, c * f + d * h))
    return G @ H


Block = TypeVar("Block", Lti, Sampled)  # the two types over which conditions are written


def vstack(*blocks: Any) -> Any:
    """Stack the outputs of several blocks with one common input. Blocks with the same A and B share their states."""
    first = blocks[0]
    if isinstance(first, Sampled):
        return first._with(_block([[b.G] for b in blocks]))
    T = _common_period(*blocks)
    C, D = [[b.C] for b in blocks], _block([[b.D] for b in blocks])
    if all(b.A is first.A and b.B is first.B for b in blocks):
        return Lti(first.A, first.B, _block(C), D, T)
    A, B = block_diagonal([b.A for b in blocks]), _block([[b.B] for b in blocks])
    return Lti(A, B, block_diagonal([b.C for b in blocks]), D, T)


def hstack(*blocks: Any) -> Any:
    """Add the outputs of several blocks, each with its own inputs."""
    first = blocks[0]
    if isinstance(first, Sampled):
        return first._with(_block([[b.G for b in blocks]]))
    T = _common_period(*blocks)
    A, B = block_diagonal([b.A for b in blocks]), block_diagonal([b.B for b in blocks])
    joined = Lti(A, B, _block([[b.C for b in blocks]]), _block([[b.D for b in blocks]]), T)
    return _with_parts(joined, lambda: tuple(_block([parts]) for parts in zip(*(b._rest for b in blocks), strict=True)))


def _with_parts(block: Any, rest: Callable[[], tuple[Array, ...]]) -> Any:
    """Return the block; if it is exact, it remembers `rest`, which computes `_rest` from its parts."""
    if block.is_exact:
        object.__setattr__(block, "_parts", rest)
    return block


def as_like(block: Lti | Sampled, system: Lti) -> Any:
    """Return the system, sampled at the points of `block` if `block` is sampled."""
    return Sampled(block.z, system.at(block.z), block.T) if isinstance(block, Sampled) else system


def constant_like(block: Block, D: Any) -> Block:
    """Return the memoryless block y = D u, of the same type as `block`."""
    if isinstance(block, Sampled):
        return block._with(np.asarray(D, dtype=np.complex128)[None, None])
    return Lti.constant(D, block.T)


def taps(weights: Sequence[Any], T: Number) -> Lti:
    """Return the filter w_0 + w_1/z + ... + w_n z^-n of one channel. Raises ValueError without any weight."""
    n = len(weights) - 1
    row = numbers(list(weights), T)
    if n < 0:
        raise ValueError("taps need at least one weight")
    first = np.zeros((n, 1), dtype=int)
    first[:1] = 1
    return Lti(np.eye(n, k=-1, dtype=int), first, row[1:].reshape(1, n), row[:1].reshape(1, 1), T)


def block_diagonal(parts: Sequence[Array]) -> Array:
    """Return the block-diagonal matrix of the parts, in any arithmetic and for any stack."""
    lead = np.broadcast_shapes(*(p.shape[:-2] for p in parts)) if any(p.ndim > 2 for p in parts) else ()
    shape = sum(p.shape[-2] for p in parts), sum(p.shape[-1] for p in parts)
    matrix = np.zeros((*lead, *shape), dtype=np.result_type(*parts))
    top = left = 0
    for part in parts:
        low, right = top + part.shape[-2], left + part.shape[-1]
        matrix[..., top:low, left:right] = part
        top, left = low, right
    return matrix


def _block(rows: Sequence[Sequence[Array]]) -> Array:
    """Return numpy.block over the last two axes; the leading axes are broadcast."""
    if any(b.ndim > 2 for row in rows for b in row):
        lead = np.broadcast_shapes(*(b.shape[:-2] for row in rows for b in row))
        rows = [[np.broadcast_to(b, (*lead, *b.shape[-2:])) for b in row] for row in rows]
    return np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)


def _floats(value: ArrayLike, name: str) -> Array:
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.ndim > 1 and not value.flags.writeable:
        return value  # not copied, so that vstack can detect blocks that share their states
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise _unlike(name, value, 2) from None
    if array.ndim < 2:
        raise _unlike(name, value, 2, f", got shape {array.shape}")
    array.setflags(write=False)
    return array


def _common_period(*blocks: Lti) -> Any:
    periods = {g.T for g in blocks}
    if len(periods) != 1:
        raise ValueError(f"blocks with different sampling periods: {sorted(periods)}")
    return periods.pop()
