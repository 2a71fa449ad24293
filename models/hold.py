"""The plant under a zero-order hold: matrix exponentials of one plant, or of many plants at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.models.scene import Plant

_Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class HeldPlant:
    """The plant with inputs that are held for T [s]: s[k+1] = A s[k] + B [w; f][k], x[k] = C s[k].

    Arrays with leading axes hold many plants.
    """

    A: _Array  # (..., states, states)
    B: _Array  # (..., states, external forces + m)
    C: _Array  # (m, states)
    T: float  # [s]


def hold(plant: Plant, T: float, late: Sequence[float] | None = None) -> HeldPlant:
    """Sample a continuous plant, or many plants, with its input held for T [s].

    If forces latch `late` (m,) [s] after the tick, the state is [s; forces that the actuators hold]. The held forces
    act until the latch: s+ = A(T) s + B(T) [w; held] + B_f(T - late) (f - held), where B_f are the columns of f.
    """
    if late is not None:
        return latched(partial(hold, plant), T, late)
    *many, n, inputs = plant.B.shape
    generator = np.zeros((*many, n + inputs, n + inputs))
    generator[..., :n, :n], generator[..., :n, n:] = plant.A, plant.B
    units = np.concatenate([_units(plant.A.reshape(-1, n, n), T), np.ones((math.prod(many), inputs))], axis=1)
    step = _expm_in_units(generator.reshape(-1, *generator.shape[-2:]) * T, units).reshape(generator.shape)
    return HeldPlant(step[..., :n, :n], step[..., :n, n:], plant.C, T)


def latched(held: Callable[[float], HeldPlant], T: float, late: Sequence[float]) -> HeldPlant:
    """Return the plant whose forces latch `late` (m,) [s] after the tick; `held(t)` is the plant held for t [s]."""
    period, m = held(T), len(late)
    *many, n, inputs = period.B.shape
    w = inputs - m
    A, B = np.zeros((*many, n + m, n + m)), np.zeros((*many, n + m, inputs))
    A[..., :n, :n], B[..., :n, :w], B[..., n:, w:] = period.A, period.B[..., :w], np.eye(m)
    for i, tau in enumerate(late):
        if tau < T:
            B[..., :n, w + i] = held(T - tau).B[..., w + i]
    A[..., :n, n:] = period.B[..., w:] - B[..., :n, w:]
    return HeldPlant(A, B, np.pad(period.C, ((0, 0), (0, m))), T)


def at_the_latch(plant: Plant, late: Sequence[float]) -> _Array:
    """Return the rows (..., m, entries) from [s; held forces; w; f] to each channel's position when its force latches.

    s is the plant's state, w are the external forces, and f the new forces of the tick.
    """
    *many, n, inputs = plant.B.shape
    m = len(late)
    rows = np.zeros((*many, m, n + m + inputs))
    for i, tau in enumerate(late):
        if tau == 0:
            rows[..., i, :n] = plant.C[i]
            continue
        held = hold(plant, tau, [min(other, tau) for other in late])  # forces with an earlier latch act already
        rows[..., i, :] = held.C[i] @ np.concatenate([held.A, held.B], axis=-1)
    return rows


def exponential_step(J: _Array, h: float, n: int, felt: _Array | None = None) -> _Array:
    """Return the matrix (nsim, states, states + n) that maps [s; a] to s + h phi1(h J) s', for a step of h seconds.

    J (nsim, states, states) is the Jacobian of s' = [v; a; 0] + felt s with the state s = [q; v; states of impedances]
    of n joints. The accelerations a (n,) [m/s^2] are those without impedances, and `felt` (nsim, states, states) is
    the contribution of the impedances. phi1(X) = X^-1 (e^X - I) is the upper right block of exp [[X, I], [0, 0]].
    """
    nsim, states, _ = J.shape
    unit = np.tile(_units(J, h), 2)
    generator = np.zeros((nsim, 2 * states, 2 * states))
    generator[:, :states, :states], generator[:, :states, states:] = h * J, np.eye(states)
    phi = h * _expm_in_units(generator, unit)[:, :states, states:]
    rates = np.zeros((nsim, states, states + n))
    rates[:, :n, n : 2 * n] = rates[:, n : 2 * n, states:] = np.eye(n)
    if felt is not None:
        rates[:, :, :states] += felt
    return phi @ rates + np.eye(states, states + n)


def expm_each(matrices: _Array) -> _Array:
    """Return the exponential of each of (nsim, n, n) matrices, by scaling and squaring.

    Each result depends on its own matrix only. scipy.linalg.expm calls a threaded BLAS for every matrix, which made
    verdicts about many humans several times slower than this function does.
    """
    norm = np.abs(matrices).sum(axis=1).max(axis=1)
    halvings = np.maximum(0, np.ceil(np.log2(np.maximum(norm, _LARGEST) / _LARGEST))).astype(int)
    a, b = matrices * (0.5**halvings)[:, None, None], _PADE
    one = np.eye(matrices.shape[1])
    a2 = a @ a
    a4 = a2 @ a2
    a6 = a4 @ a2
    odd = a @ (a6 @ (b[13] * a6 + b[11] * a4 + b[9] * a2) + b[7] * a6 + b[5] * a4 + b[3] * a2 + b[1] * one)
    even = a6 @ (b[12] * a6 + b[10] * a4 + b[8] * a2) + b[6] * a6 + b[4] * a4 + b[2] * a2 + b[0] * one
    result = np.linalg.solve(even - odd, even + odd)
    for count in range(halvings.max(initial=0)):
        unfinished = halvings > count
        result[unfinished] = result[unfinished] @ result[unfinished]
    return result


def _units(A: _Array, h: float) -> _Array:
    """Return units (nsim, states) for the states of s' = A s in which exp(h A) is computed accurately.

    Without impedances the second half of the states are velocities, whose unit is close to the frequency of the fastest
    mode. The norm of h A for a stiff plant is then about this frequency times h, and the exponential has a rounding
    error of 1e-16 instead of 1e-11. The units are powers of two, so that scaling is exact, also with impedances.
    """
    n = A.shape[2] // 2
    fastest = np.sqrt(np.abs(A[:, n:, :n]).max(axis=(1, 2)))
    unit = np.ones(A.shape[:2])
    unit[:, n:] = 2.0 ** np.ceil(np.log2(np.maximum(fastest, 1 / h)))[:, None]
    return unit


def _expm_in_units(matrices: _Array, unit: _Array) -> _Array:
    """Return the exponentials of (nsim, n, n) matrices, computed with entry i of the state in units of unit[:, i]."""
    return expm_each(matrices * unit[:, None, :] / unit[:, :, None]) * unit[:, :, None] / unit[:, None, :]


_ORDER = 13  # order of the diagonal Padé approximant, Higham (2005), table 2.3
_LARGEST = 5.37  # largest 1-norm for which this order has the accuracy of double precision
_PADE = [math.comb(_ORDER, k) * math.factorial(2 * _ORDER - k) / math.factorial(2 * _ORDER) for k in range(_ORDER + 1)]

Product = Callable[[_Array, _Array], object]  # reads an array (columns, nsim) and writes the product (rows, nsim)
_Which = NDArray[np.intp]


def product_of(matrices: _Array) -> Product:
    """Return a function that multiplies a matrix, or (nsim, rows, columns) matrices, with an array (columns, nsim).

    A stack of matrices is split into independent blocks, such as a device with its human. All entries outside the
    blocks are 0.
    """
    if matrices.ndim == 2:
        return np.ascontiguousarray(matrices).dot
    rows, columns = _blocks(np.any(matrices != 0, axis=0))
    valid = (rows >= 0)[:, :, None] & (columns >= 0)[:, None, :]
    parts = matrices[:, rows[:, :, None], columns[:, None, :]] * valid
    blocks = np.ascontiguousarray(np.moveaxis(parts, 0, -1))  # (blocks, rows, columns, nsim)
    moved = np.empty((*rows.shape, matrices.shape[0]))
    inside, index = rows >= 0, ...
    if not inside.all():
        index, rows = inside, rows[inside]

    def multiply(slab: _Array, out: _Array) -> None:
        np.einsum("crkn,ckn->crn", blocks, slab.take(columns, axis=0), out=moved)
        out[rows] = moved[index]

    return multiply


def _blocks(pattern: NDArray[np.bool_]) -> tuple[_Which, _Which]:
    """Return rows (blocks, rows) and columns (blocks, columns) of the pattern's independent blocks, padded with -1."""
    import scipy

    n, width = pattern.shape
    graph = np.zeros((width, width), dtype=bool)
    graph[:n] = pattern
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    rows = [np.flatnonzero(label[:n] == c) for c in range(count)]
    columns = [np.flatnonzero(label == c) for c in range(count)]
    # An input that acts on no state is a block without rows; it is dropped.
    pairs = [(r, c) for r, c in zip(rows, columns, strict=True) if r.size]
    return _filled([r for r, _ in pairs]), _filled([c for _, c in pairs])


def _filled(lists: list[_Which]) -> _Which:
    table = np.full((len(lists), max(part.size for part in lists)), -1)
    for row, part in zip(table, lists, strict=True):
        row[: part.size] = part
    return table
