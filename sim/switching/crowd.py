"""Many humans under delays that vary: each meets delays of its own, drawn or found worst, in one batch."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.coupling import Coupling
from controller.delay import Ticks, realising
from controller.lti import Array
from controller.process import Process
from models.crowd import Variants
from sim.batch_engine import ExactBatchEngine
from sim.exact_engine import HeldPlant, hold
from sim.mujoco_engine import MujocoBatchEngine
from sim.simulate import Assembly
from sim.switching.drawn import draw_delays
from sim.switching.switched import knocked, unlimited, without_theta
from sim.switching.worst import greedy_ages

SHORTEST = 2.0  # [s] of every trace: a growth of 1 1/s stands out from how a knock spreads
DOUBTFUL = 1.0  # [1/s]: a slower growth may be two modes that beat, and is judged again ..
LONGER = 5  # .. on traces so many times as long


@dataclass(frozen=True, eq=False)
class Switched:
    """Growth [1/s] of the handles' speeds after a knock, (nsim,) each."""

    exact: Array  # of the linear loop
    mujoco: Array  # of MuJoCo's; nan where it was not asked for, or a force reached its limit


def switched_crowd(
    assembly: Assembly,
    coupling: Coupling,
    held_by: Variants,
    index: NDArray[np.intp],
    seed: int,
    duration: float,
    mujoco: bool,
    threads: int = 0,
) -> Switched:
    """Knock every set of humans under the delays of its index, which depend on (seed, index) and the loop only."""
    ticks = round(max(duration, SHORTEST) / assembly.scenario.T)
    found = _knocked(assembly, coupling, held_by, index, seed, ticks, mujoco, threads)
    doubtful = (found.exact > 0) & (found.exact < DOUBTFUL)
    if not doubtful.any():
        return found
    longer = _knocked(assembly, coupling, held_by, index, seed, LONGER * ticks, mujoco, threads)
    return Switched(np.where(doubtful, longer.exact, found.exact), np.where(doubtful, longer.mujoco, found.mujoco))


def _knocked(
    assembly: Assembly,
    coupling: Coupling,
    held_by: Variants,
    index: NDArray[np.intp],
    seed: int,
    ticks: int,
    mujoco: bool,
    threads: int,
) -> Switched:
    T, nsim, scene = assembly.scenario.T, len(held_by), held_by.scene
    plants = hold(held_by.plants(), T)
    process = replace(assembly.process, F=without_theta(assembly, coupling))
    process = replace(process, delays=_delays(assembly, process, held_by, plants, index, seed, ticks))
    linear, states = unlimited(process), plants.A.shape[1]
    exact = knocked(linear, ExactBatchEngine(plants, linear.force_limit), scene, states, ticks, nsim).rate
    if not mujoco:
        return Switched(exact, np.full(nsim, np.nan))
    engine = MujocoBatchEngine(scene, T, nsim=nsim, nthread=threads, fields=held_by.fields)
    seen = knocked(process, engine, scene, states, ticks, nsim)
    return Switched(exact, np.where(seen.clipped, np.nan, seen.rate))


def _delays(
    assembly: Assembly,
    process: Process,
    held_by: Variants,
    plants: HeldPlant,
    index: NDArray[np.intp],
    seed: int,
    ticks: int,
) -> Ticks:
    jitter = assembly.scenario.jitter
    assert jitter is not None
    given = [None] * len(index)
    if jitter.pattern == "adversarial":
        worst = realising(greedy_ages(process, plants, held_by.scene, jitter, ticks))
        given = [worst[:, :, j] for j in range(len(index))]
    rows = [
        draw_delays(assembly.scenario, seed, int(i), ticks, own) for i, own in zip(index.tolist(), given, strict=True)
    ]
    return np.stack(rows, axis=2)
