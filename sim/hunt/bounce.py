"""Many loops left alone from given states: how often their walls are hit, and whether the motion dies out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from controller.process import Process, Tape
from sim.engine import Engine
from sim.loop import stretch
from sim.mujoco_engine import profiler_off, quiet_warnings

STRETCH = 64  # ticks between two looks at a tape


@dataclass(frozen=True, eq=False)
class Bounces:
    """One row per window of equal length, one column per simulation."""

    made: Array  # (windows, nsim) contacts made, all walls together
    speed: Array  # (windows, nsim) [m/s] rms over all of the plant's coordinates
    clipped: Array  # (windows, nsim) ticks with a force at its limit


def bounce(
    process: Process,
    engine: Engine,
    start: Array,
    ticks: int,
    windows: int = 4,
    outside: int = 0,
    ticked: Callable[[int], None] = lambda ticks: None,
) -> Bounces:
    """Simulate from the plant states `start`, (2n, nsim), with `outside` outside forces, all zero.

    `ticks` is rounded down to whole windows of whole stretches. Raises ValueError where there is no wall, or no
    tick.
    """
    if process.contact is None:
        raise ValueError("process has no walls, so nothing can bounce")
    per_window = ticks // (windows * STRETCH)
    if per_window < 1:
        raise ValueError(f"ticks is {ticks}, expected at least {windows * STRETCH}: {windows} windows of {STRETCH}")
    n, nsim = start.shape
    tape = Tape(process, STRETCH, n, outside, nsim)
    tape.s[0] = start
    limit = process.force_limit[:, None]
    made, square, clipped = (np.zeros((windows, nsim)) for _ in range(3))
    before = np.zeros((1, len(process.contact.walls), nsim), dtype=bool)
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine.start(tape)
        for i in np.repeat(np.arange(windows), per_window):
            stretch(tape, engine, STRETCH)
            touching = process.contact.depths(tape.z) > 0
            made[i] += (touching & ~np.concatenate([before, touching[:-1]])).sum(axis=(0, 1))
            square[i] += (tape.s[:STRETCH, n // 2 :] ** 2).mean(axis=1).sum(axis=0)
            clipped[i] += (np.abs(tape.f[:STRETCH]) >= limit).any(axis=1).sum(axis=0)
            before = touching[-1:]
            tape.rewind(STRETCH)
            ticked(STRETCH)
    return Bounces(made, np.sqrt(square / (per_window * STRETCH)), clipped)
