"""Many different plants at once by the matrix exponential: one product of small matrices with slabs of simulations.

The simulation index is last and contiguous. What devices and humans do not share splits the plant into
separate blocks (one device with its human each), found from the zeros of the matrices; only they are multiplied.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from controller.lti import Array
from controller.process import Tape
from sim.exact_engine import HeldPlant

Which = NDArray[np.intp]


class ExactBatchEngine:
    """Simulation j of the tape moves by A[j], B[j] of the plants, after the actuators' limits."""

    def __init__(self, plants: HeldPlant, force_limit: Array) -> None:
        product = np.concatenate([plants.A, plants.B], axis=2)  # (nsim, 2n, 2n + inputs)
        self._rows, self._columns = _blocks(np.any(product != 0, axis=0))
        valid = (self._rows >= 0)[:, :, None] & (self._columns >= 0)[:, None, :]
        parts = product[:, self._rows[:, :, None], self._columns[:, None, :]] * valid
        self._matrices = np.ascontiguousarray(np.moveaxis(parts, 0, -1))  # (blocks, rows, columns, nsim)
        self._moved = np.empty((*self._rows.shape, product.shape[0]))
        self._kept = self._rows >= 0
        self._whole = bool(self._kept.all())
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, tape: Tape) -> None:
        self._slabs, self._states, self._forces = tape.plant_row, tape.plant_state, tape.force

    def advance(self, k: int) -> None:
        force = self._forces[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        np.einsum("crkn,ckn->crn", self._matrices, self._slabs[k].take(self._columns, axis=0), out=self._moved)
        if self._whole:
            self._states[k + 1][self._rows] = self._moved
        else:
            self._states[k + 1][self._rows[self._kept]] = self._moved[self._kept]

    def troubled(self) -> bool:
        return False


def _blocks(pattern: NDArray[np.bool_]) -> tuple[Which, Which]:
    """Rows and columns of the independent blocks of a (2n, 2n + inputs) pattern of nonzeros.

    Shapes (blocks, rows) and (blocks, columns); smaller blocks are filled up with -1.
    """
    n, width = pattern.shape
    graph = np.zeros((width, width), dtype=bool)
    graph[:n] = pattern
    count, label = connected_components(graph, directed=False)
    rows = [np.flatnonzero(label[:n] == c) for c in range(count)]
    columns = [np.flatnonzero(label == c) for c in range(count)]
    # an input that moves nothing is a block without rows
    pairs = [(r, c) for r, c in zip(rows, columns, strict=True) if r.size]
    return _filled([r for r, _ in pairs]), _filled([c for _, c in pairs])


def _filled(lists: list[Which]) -> Which:
    table = np.full((len(lists), max(part.size for part in lists)), -1)
    for row, part in zip(table, lists, strict=True):
        row[: part.size] = part
    return table
