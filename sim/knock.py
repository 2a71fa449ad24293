"""What short traces say of many humans at once: growth, clipping, the energy audit, and whether handles come to rest.

From rest at x = 0, without voluntary motion, every handle is knocked once and then left alone. The measures are
summed up while the simulation runs, so that no trace is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from controller.process import Process, Tape
from models.scene import Scene
from sim.engine import Engine
from sim.loop import stretch
from sim.mujoco_engine import profiler_off, quiet_warnings
from sim.stability import SHORTEST_TRACE, ClosedLoop

KNOCK = 10e-3  # [s]
STRETCH = 32  # ticks between two looks at a tape: few, so that it stays in the processor's cache
HEARD = 1e-8  # a mode weaker than this beside the whole state is noise of the engine


@dataclass(frozen=True, eq=False)
class Trace:
    """One entry per simulation."""

    growth: Array  # (nsim,) [1/s] of the exact loop's dominant mode, up to the first clipped tick; nan where unheard
    clipped: NDArray[np.int64]  # (nsim,) ticks with a force at its limit
    least_energy: Array  # (nsim,) [J] least W(N) up to the first clipped tick
    audited: Array  # (nsim,) [J] sum of the magnitudes of what W adds up: the scale of its rounding
    settling: Array  # (nsim,) rms of the handles' speeds in the last quarter over that in the second
    simulated: float  # [s] of all simulations together


def knock(
    process: Process,
    engine: Engine,
    scene: Scene,
    loops: ClosedLoop,
    delta: Array,
    ticks: int,
    tick_done: Callable[[int], None] = lambda ticks: None,
) -> Trace:
    """Simulate `ticks` periods with every set of humans and measure them. `loops` are the exact ones."""
    nsim, states = loops.A.shape[0], loops.A.shape[1] - process.F.order
    tape = Tape(process, min(STRETCH, ticks), states, scene.outside, nsim)
    audit = _Audit(process, scene, loops, delta, ticks)
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine.start(tape)
        done = 0
        while done < ticks:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = knock_forces(scene, loops.T, done, count)[:, :, None]
            stretch(tape, engine, count)
            audit.see(tape, done, count)
            tape.rewind(count)
            done += count
            tick_done(count)
    return audit.trace(ticks * loops.T * nsim)


def knock_forces(scene: Scene, T: float, first: int, ticks: int) -> Array:
    """Forces [N] of the knock, (ticks, outside): 1 N on handle 1, -1/2 N on handle 2, 1/3 N on handle 3, ..."""
    w = np.zeros((ticks, scene.outside))
    until = max(1, round(KNOCK / T)) - first
    for i, column in enumerate(scene.tapped):
        w[: max(until, 0), column] = (-1) ** i / (i + 1)
    return w


class _Audit:
    """Sums over the ticks seen so far."""

    def __init__(self, process: Process, scene: Scene, loops: ClosedLoop, delta: Array, ticks: int) -> None:
        nsim = loops.A.shape[0]
        self._limit = process.force_limit[:, None]
        self._B, self._T, self._damping = loops.B, loops.T, delta[:, None] / loops.T
        self._left = _left_eigenvectors(loops)  # (nsim, n)
        self._speeds = [scene.model.nv + handle for handle in scene.handles]
        self._second, self._last = (ticks // 4, ticks // 2), (ticks - ticks // 4, ticks)
        self._linear = np.ones(nsim, dtype=bool)
        self._usable, self._clipped = np.zeros(nsim, dtype=int), np.zeros(nsim, dtype=int)
        self._energy, self._least, self._size = np.zeros(nsim), np.zeros(nsim), np.zeros(nsim)
        self._across, self._weight, self._whole = np.zeros(nsim, dtype=complex), np.zeros(nsim), np.zeros(nsim)
        self._early, self._late = np.zeros(nsim), np.zeros(nsim)

    def see(self, tape: Tape, first: int, ticks: int) -> None:
        """Take in the first `ticks` rows of the tape; row 0 is tick `first`."""
        z, s, w, f = (part[: ticks + 1] for part in (tape.z, tape.s, tape.w, tape.f))
        clipped = (np.abs(f[:ticks]) >= self._limit).any(axis=1)  # (ticks, nsim)
        linear = self._linear & ~np.logical_or.accumulate(clipped, axis=0)
        self._clipped += clipped.sum(axis=0)
        self._usable += linear.sum(axis=0)
        self._linear = linear[-1]

        moved = np.diff(tape.x[: ticks + 1], axis=0)
        work = np.where(linear[:, None], f[:ticks] * moved, 0.0).sum(axis=1)
        spent = np.where(linear[:, None], self._damping * moved**2, 0.0).sum(axis=1)
        energy = self._energy + np.cumsum(work + spent, axis=0)
        self._least = np.minimum(self._least, energy.min(axis=0))
        self._energy = energy[-1]
        self._size += (np.abs(work) + spent).sum(axis=0)

        xi = np.concatenate([s, z], axis=1)
        y = np.einsum("ns,ksn->kn", self._left.conj(), xi)
        pushed = np.einsum("ns,nsw,kwn->kn", self._left.conj(), self._B, w[:ticks], optimize=True)
        y, after = np.where(linear, y[:-1], 0), y[1:] - pushed
        self._across += (y.conj() * after).sum(axis=0)
        self._weight += (np.abs(y) ** 2).sum(axis=0)
        self._whole += np.where(linear[:, None], xi[:-1] ** 2, 0.0).sum(axis=(0, 1))

        speed = (s[:ticks, self._speeds] ** 2).sum(axis=1)
        k = np.arange(first, first + ticks)
        self._early += speed[(k >= self._second[0]) & (k < self._second[1])].sum(axis=0)
        self._late += speed[(k >= self._last[0]) & (k < self._last[1])].sum(axis=0)

    def trace(self, simulated: float) -> Trace:
        heard = (self._usable >= SHORTEST_TRACE) & (self._weight > HEARD**2 * self._whole)
        with np.errstate(divide="ignore", invalid="ignore"):
            growth = np.log(np.abs(self._across / self._weight)) / self._T
            settling = np.sqrt(self._late / self._early)
        growth = np.where(heard, growth, np.nan)
        return Trace(growth, self._clipped, self._least, self._size, settling, simulated)


def _left_eigenvectors(loops: ClosedLoop) -> NDArray[np.complex128]:
    """Of the dominant mode of each loop, (nsim, n), of unit length: left* A = lambda left*."""
    values, vectors = np.linalg.eig(np.swapaxes(loops.A, 1, 2))
    largest = np.argmax(np.abs(values), axis=1)
    return vectors[np.arange(values.shape[0]), :, largest].conj()
