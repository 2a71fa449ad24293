"""The force map as it runs on the host: one matrix product per tick, the same in a session and in a replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self

import numpy as np

from controller.lti import Array, Lti


class Controller(Protocol):
    """What answers a displacement with a force, tick by tick."""

    T: float  # [s]

    def step(self, x: Sequence[float]) -> Array:
        """Forces fed back (m,) [N] for the displacements x (m,) [m]."""
        ...


class Law:
    """[f; z+] = [C D; A B] [z; x], from rest. Allocates nothing per tick but the force that it returns."""

    def __init__(self, F: Lti) -> None:
        self.F, self.T = F, F.T
        n, m = F.order, F.inputs
        self._product = np.ascontiguousarray(np.block([[F.A, F.B], [F.C, F.D]]))
        self._input, self._output = np.zeros(n + m), np.zeros(n + F.outputs)
        self._order = n

    def step(self, x: Sequence[float]) -> Array:
        """Forces (m,) [N] for the displacements x (m,) [m]; the state moves on by one tick."""
        n = self._order
        self._input[n:] = x
        np.dot(self._product, self._input, out=self._output)
        self._input[:n] = self._output[:n]
        return self._output[n:].copy()

    def fresh(self) -> Self:
        """The same law at rest."""
        return type(self)(self.F)


def fill(previous: Sequence[float], x: Sequence[float], ticks: int) -> list[tuple[float, ...]]:
    """Displacements for `ticks` ticks of which only the last was received: a straight line from `previous` to x.

    A step would look to a damper like a blow of (dx/T) times its B.
    """
    line = [tuple(a + (b - a) * (i / ticks) for a, b in zip(previous, x, strict=True)) for i in range(1, ticks)]
    return [*line, tuple(x)]
