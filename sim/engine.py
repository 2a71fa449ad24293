"""What the loop asks of a plant, and where the outside forces come from."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from controller.lti import Array
from controller.process import Tape
from models.scene import Scene
from sim.scenario import Scenario


class Engine(Protocol):
    """Advances the plant by one period at a time, reading and writing a tape."""

    def start(self, tape: Tape) -> None:
        """Take the plant state of row 0 as the state at the first tick."""
        ...

    def advance(self, k: int) -> None:
        """Hold the plant input of row k for T, then write the plant state of row k + 1."""
        ...

    def troubled(self) -> bool:
        """Whether the engine itself has reported numbers that it cannot go on with."""
        ...


def outside_forces(scenario: Scenario, scene: Scene, first: int, ticks: int, voluntary: bool = True) -> Array:
    """Outside forces [N] at ticks first .. first + ticks - 1, sampled at kT, shape (ticks, outside).

    The voluntary motion reaches the end of each human, the tap reaches one handle.
    """
    t = np.arange(first, first + ticks) * scenario.T
    w = np.zeros((ticks, scene.outside))
    if voluntary:
        for human, column in zip(scenario.human, scene.pushed, strict=True):
            w[:, column] += human.voluntary_force(t)
    if scenario.tap:
        tap = scenario.tap
        begin, end = (round(t / scenario.T, 9) for t in (tap.start, tap.start + tap.duration))
        k = np.arange(first, first + ticks)
        w[(k >= begin) & (k < end), scene.tapped[tap.channel - 1]] += tap.force
    return w
