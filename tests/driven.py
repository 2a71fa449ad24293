"""Simulate many closed loops at once from given plant states, for tests of the engines."""

from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.models.scene import Scene, Variants
from haptic_loop.sim.engines import Engine
from haptic_loop.sim.run import _Outside, run_blocks


@dataclass(frozen=True, eq=False)
class Driven:
    """The process states z, plant states s and forces f of the ticks, (ticks, entries, nsim)."""

    z: np.ndarray
    s: np.ndarray
    f: np.ndarray


def driven(
    process: Process, engine: Engine, outside: _Outside, ticks: int, start: np.ndarray, last: int | None = None
) -> Driven:
    """Close the loop from plant states `start`, (2n, nsim). With `last`, store only the blocks of the final ticks."""
    blocks = []

    def look(buffer: StepBuffer, first: int, count: int) -> None:
        if last is None or first + count > ticks - last:
            blocks.append([rows[:count].copy() for rows in (buffer.z, buffer.s, buffer.f)])

    run_blocks(process, engine, outside, ticks, start, look, 1000)
    return Driven(*(np.concatenate(rows) for rows in zip(*blocks, strict=True)))


def tick_by_tick(engine):
    """Make the engine run tick by tick instead of in blocks, and return it."""
    start = engine.start

    def begin(buffer: StepBuffer) -> None:
        start(buffer)
        engine.run_block = None

    engine.start = begin
    return engine


def drive(process: Process, x: np.ndarray) -> StepBuffer:
    """Return the buffer after a tick for each row of the displacements x (ticks, m, nsim)."""
    buffer = StepBuffer(process, len(x), x.shape[1], nsim=x.shape[2])
    for k, row in enumerate(x):
        buffer.x[k] = row
        buffer.tick(k)
    return buffer


def random_walks(ticks: int, channels: int, nsim: int, step: float = 1e-3, seed: int = 0) -> np.ndarray:
    """Return random walks of displacements (ticks, channels, nsim)."""
    return np.cumsum(np.random.default_rng(seed).normal(size=(ticks, channels, nsim)), axis=0) * step


def growing(steps: np.ndarray, energy: np.ndarray, mean: int | None, rng: np.random.Generator, ticks: int) -> int:
    """Return for how many hands the motion grows a hundredfold after the first tenth of the ticks.

    Each tick multiplies the state by one of `steps` (kinds, hands, n, n), drawn anew after `mean` ticks on average.
    Without `mean`, each hand takes the step after which `energy` (hands, 2) times [x^2, v^2] is largest.
    """
    hands = len(energy)
    z = 1e-3 * rng.standard_normal((hands, steps.shape[2], 1))
    log, early, which = np.zeros(hands), np.zeros(hands), 0
    for k in range(ticks):
        if mean is None:
            each = steps @ z
            z = each[(energy * each[:, :, :2, 0] ** 2).sum(axis=2).argmax(axis=0), np.arange(hands)]
        else:
            which = rng.integers(len(steps)) if rng.random() < 1 / mean else which
            z = steps[which] @ z
        if k % 20 == 19:
            size = np.abs(z[:, :2, 0] * (1, 0.01)).max(axis=1)
            log, z = log + np.log(size), z / size[:, None, None]
        if k == ticks // 10:
            early = log.copy()
    return int((log > early + np.log(100)).sum())


def alike(scene: Scene, count: int) -> Variants:
    """Return `count` copies of a scene as the variants of a batch."""
    names = ("body_mass", "jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")
    return Variants(scene, {name: np.tile(getattr(scene.model, name), (count, 1)) for name in names})
