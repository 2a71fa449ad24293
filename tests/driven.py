"""Many simulations closed at once from given plant states: what the laws about engines are stated on."""

from dataclasses import dataclass

import numpy as np

from controller.tick import Process, StepBuffer
from sim.engines import Engine
from sim.run import Outside, run_blocks


@dataclass(frozen=True, eq=False)
class Driven:
    """What every tick saw, (ticks, entries, nsim)."""

    z: np.ndarray
    s: np.ndarray
    f: np.ndarray


def driven(
    process: Process, engine: Engine, outside: Outside, ticks: int, start: np.ndarray, last: int | None = None
) -> Driven:
    """Close the loop from the plant states `start`, (2n, nsim); only the blocks of the last ticks are kept."""
    kept = []

    def look(buffer: StepBuffer, first: int, count: int) -> None:
        if last is None or first + count > ticks - last:
            kept.append([rows[:count].copy() for rows in (buffer.z, buffer.s, buffer.f)])

    run_blocks(process, engine, outside, ticks, start, look, 1000)
    return Driven(*(np.concatenate(rows) for rows in zip(*kept, strict=True)))


def tick_by_tick(engine):
    """The engine without stretches: every tick is looked at before the next."""
    start = engine.start

    def begin(buffer: StepBuffer) -> None:
        start(buffer)
        engine.stretch = None

    engine.start = begin
    return engine
