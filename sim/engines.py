"""Engines: what moves the plant between two samples, for one simulation or for many at once.

    exact         s+ = A s + B [w; f], the matrix exponential of the plant under held inputs (no Coulomb friction)
    exponential   and MuJoCo's own integrators: sim.mujoco_engines

All of them read their inputs from the rows of a step buffer and write the next row, with no copy in between. With a
timing (controller.timing) every tick has a length of its own, and forces that latch late act from within it; then the
forces that the actuators hold are the last entries of the plant's state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Protocol

import numpy as np

from controller.tick import FusedTicks, StepBuffer, Stretch
from controller.timing import Timing
from models.hold import HeldPlant, Product, hold, latched, product_of
from models.scene import Plant

_MOST_MAPS = 256  # of ticks that differ, kept by an engine


class Engine(Protocol):
    """Advances the plant by one period at a time, reading and writing a buffer."""

    def start(self, buffer: StepBuffer) -> None:
        """Take the plant state of row 0 as the state at the first tick."""
        ...

    @property
    def advance(self) -> Callable[[int], None]:
        """k: hold the plant input of row k, forces within their limits, for T; write the plant state of row k + 1."""
        ...

    def troubled(self) -> bool:
        """Whether the engine itself has reported numbers that it cannot go on with."""
        ...

    # One that can may also have, from `start` on:
    #   stretch(ticks)   the linear law and `advance` for so many ticks from row 0 on, in fewer calls; or None
    #   back(k)          after a stretch the plant goes back to the state of row k


class _Exact:
    stretch: Stretch | None = None

    def back(self, k: int) -> None:
        """The exact engines have no state of their own."""

    def troubled(self) -> bool:
        return False


class ExactEngine(_Exact):
    """One matrix product per period: of one plant, or simulation j of the buffer moves as plant j of many."""

    def __init__(self, plant: HeldPlant) -> None:
        self._plant = np.concatenate([plant.A, plant.B], axis=-1)
        self._product = product_of(self._plant)
        self.advance: Callable[[int], None]  # from `start` on

    def start(self, buffer: StepBuffer) -> None:
        product, rows, states = self._product, buffer.plant_row, buffer.plant_state

        def advance(k: int) -> None:
            product(rows[k], states[k + 1])

        # what clips does so in long runs, and then bit for bit as tick by tick
        straight = buffer.calm and not buffer.clips and self._plant.ndim == 2
        self.advance, self.stretch = advance, self._fused(buffer) if straight else None

    def _fused(self, buffer: StepBuffer) -> Stretch:
        fused = FusedTicks(buffer, *np.split(self._plant, [len(self._plant)], axis=1))
        product, before, after = fused.product, fused.before, fused.next

        def stretch(ticks: int) -> None:
            for count in fused.parts(ticks):
                for now, then in zip(before[:count], after, strict=False):
                    product(now, then)

        return stretch


class OneByOne:
    """An engine for each simulation of a buffer, as one engine of all."""

    def __init__(self, engines: Sequence[Engine]) -> None:
        self._engines = engines

    def start(self, buffer: StepBuffer) -> None:
        process = replace(buffer.process, delays=None, net=None)  # which stand before the forces of a row
        shape = buffer.ticks, buffer.s.shape[1], buffer.w.shape[1]
        self._all, self._each = buffer, [StepBuffer(process, *shape) for _ in self._engines]
        for j, (engine, own) in enumerate(zip(self._engines, self._each, strict=True)):
            own.calm = False
            own.s[0] = buffer.s[0, :, j : j + 1]
            engine.start(own)
        self._moves = [engine.advance for engine in self._engines]

    def advance(self, k: int, /) -> None:
        row, state = self._all.plant_row[k], self._all.plant_state[k + 1]
        for j, (own, move) in enumerate(zip(self._each, self._moves, strict=True)):
            own.plant_row[k][:, 0] = row[:, j]
            move(k)
            state[:, j] = own.plant_state[k + 1][:, 0]

    def troubled(self) -> bool:
        return any(engine.troubled() for engine in self._engines)


class ExactTimedEngine(_Exact):
    """A tick of a timing moves the plant, or simulation j plant j of many, exactly."""

    def __init__(self, plant: Plant, timing: Timing) -> None:
        held, kinds = lru_cache(_MOST_MAPS)(partial(hold, plant)), timing.kinds

        @lru_cache(_MOST_MAPS)
        def product(kind: int) -> Product:
            T, late = kinds[kind]
            step = held(T) if late is None else latched(held, T, late)
            return product_of(np.concatenate([step.A, step.B], axis=-1))

        self._product, self._which = product, timing.which

    def start(self, buffer: StepBuffer) -> None:
        self._buffer = buffer

    def advance(self, k: int, /) -> None:
        buffer, which = self._buffer, self._which
        self._product(which[(buffer.first + k) % len(which)])(buffer.plant_row[k], buffer.plant_state[k + 1])
