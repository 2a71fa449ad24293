"""The closed loop: a process and a plant, tick by tick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from controller.process import Process, Tape
from sim.engine import Engine

STRETCH = 1024  # ticks between two looks at the clock, the keyboard and the numbers

Outside = Callable[[int, int], Array]  # (first tick, ticks) -> forces (ticks, outside)
Progress = Callable[[int, int], None]  # (ticks done, ticks in all)


@dataclass(frozen=True, eq=False)
class Record:
    """What every tick saw. Axes: tick, entry, simulation."""

    z: Array  # (N, order, nsim) process state
    s: Array  # (N, 2n, nsim) plant state: positions [m], velocities [m/s]
    w: Array  # (N, outside, nsim) outside forces [N]
    f: Array  # (N, m, nsim) forces fed back [N], within the limits
    diverged: bool  # the engine gave up, or a number stopped being finite, within the last stretch
    interrupted: bool  # stopped from the keyboard


def run(
    process: Process,
    engine: Engine,
    outside: Outside,
    ticks: int,
    start: Array,
    progress: Progress = lambda done, ticks: None,
) -> Record:
    """Close the loop for `ticks` periods from the plant state `start`, shape (2n, nsim)."""
    width = outside(0, 0).shape[1]
    tape = Tape(process, min(STRETCH, ticks), start.shape[0], width, start.shape[1])
    tape.s[0] = start
    engine.start(tape)
    parts: list[tuple[Array, ...]] = []
    done, diverged, interrupted = 0, False, False
    try:
        while done < ticks and not diverged:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = outside(done, count)[:, :, None]
            with np.errstate(over="ignore", invalid="ignore"):  # a diverging run is reported, not warned about
                stretch(tape, engine, count)
            finite = np.isfinite(tape.s[:count]).all(axis=(1, 2)) & np.isfinite(tape.f[:count]).all(axis=(1, 2))
            diverged = engine.troubled() or not finite.all()
            count = count if finite.all() else int(np.argmin(finite))
            tape.saturate(count)
            parts.append(tuple(part[:count].copy() for part in (tape.z, tape.s, tape.w, tape.f)))
            tape.rewind(count)
            done += count
            progress(done, ticks)
    except KeyboardInterrupt:  # what was finished is kept
        interrupted = True
    z, s, w, f = (np.concatenate(column) for column in zip(*parts, strict=True)) if parts else _nothing(tape)
    return Record(z, s, w, f, diverged, interrupted)


def stretch(tape: Tape, engine: Engine, ticks: int) -> None:
    """Close the loop for the first `ticks` rows of the tape."""
    tick, advance = tape.tick, engine.advance
    for k in range(ticks):
        tick(k)
        advance(k)


def _nothing(tape: Tape) -> tuple[Array, ...]:
    return tuple(part[:0] for part in (tape.z, tape.s, tape.w, tape.f))
