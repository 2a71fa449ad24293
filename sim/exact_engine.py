"""The plant between samples by the matrix exponential: exact for a held input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from controller.lti import Array
from controller.process import Tape
from models.scene import Plant
from sim.exponential import expm_each


@dataclass(frozen=True, eq=False)
class HeldPlant:
    """s[k+1] = A s[k] + B [w; f][k], x[k] = C s[k]: the plant under a zero-order hold of T seconds.

    Many plants at once have a leading axis in A and B.
    """

    A: Array  # (..., 2n, 2n)
    B: Array  # (..., 2n, outside + m)
    C: Array  # (m, 2n)
    T: float  # [s]


def hold(plant: Plant, T: float) -> HeldPlant:
    """Sample a continuous plant, or many of them, with the input held for T."""
    *many, n, inputs = plant.B.shape
    generator = np.zeros((*many, n + inputs, n + inputs))
    generator[..., :n, :n], generator[..., :n, n:] = plant.A, plant.B
    step = expm_each(generator * T) if many else expm(generator * T)
    return HeldPlant(step[..., :n, :n], step[..., :n, n:], plant.C, T)


class ExactEngine:
    """One matrix product per period, after the actuators' limits."""

    def __init__(self, plant: HeldPlant, force_limit: Array) -> None:
        self._product = np.ascontiguousarray(np.hstack([plant.A, plant.B])).dot
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, tape: Tape) -> None:
        self._rows, self._states, self._forces = tape.plant_row, tape.plant_state, tape.force

    def advance(self, k: int) -> None:
        force = self._forces[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        self._product(self._rows[k], self._states[k + 1])

    def troubled(self) -> bool:
        return False
