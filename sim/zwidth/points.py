"""Points of a K-B map simulated in MuJoCo, with the effects that no theory covers switched on.

The human that is nearest to oscillating at a point, by the exact linear loop, holds the devices. The loop starts on
that mode, so far out that Coulomb friction does not hold it; the hand presses with a constant force, eased in; and what
still oscillates at the end decides: see oscillation.py. Many points, each with its process, are one MuJoCo batch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from controller.process import Process
from models.crowd import Crowd, variants
from models.device import Device
from models.scene import Scene
from sim.loop import stretch
from sim.mujoco_engine import MujocoBatchEngine, profiler_off, quiet_warnings
from sim.oscillation import Oscillation, oscillation
from sim.substeps import pace
from sim.zwidth.many_processes import ManyProcesses
from sim.zwidth.population import motors_and_handles

EASE = 0.5  # [s] in which the press grows
STRETCH = 64  # ticks between two looks at the keyboard


@dataclass(frozen=True, eq=False)
class Trial:
    """One simulation: a process, who holds the devices, and where it starts."""

    process: Process
    links: Array  # (m, links, 3) as in Crowd
    start: Array  # (2n + order,) plant state, then the state of the linear process


def simulate_trials(
    trials: Sequence[Trial],
    devices: Sequence[Device],
    press: Array,
    duration: float,
    threshold: float,
    ticked: Callable[[int], None] = lambda ticks: None,
) -> Oscillation:
    """All trials at once; their humans must have the same number of links. `press` (m,) [N], `threshold` [m]."""
    T = trials[0].process.F.T
    held_by = variants(devices, Crowd(np.stack([trial.links for trial in trials])))
    scene, ticks = held_by.scene, round(duration / T)
    substeps = pace(held_by.plants().A).substeps(T)
    n, processes = 2 * scene.model.nv, [trial.process for trial in trials]
    tape = ManyProcesses(processes, min(STRETCH, ticks), n, scene.outside)
    starts = np.stack([trial.start for trial in trials], axis=1)
    tape.s[0] = starts[:n]
    if processes[0].contact is None:  # the states of a process with walls are others: it begins at rest
        tape.z[0] = starts[n:]
    seen, kept, done = list(motors_and_handles(scene)), [], 0
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine = MujocoBatchEngine(scene, T, substeps=substeps, nsim=len(trials), fields=held_by.fields)
        engine.start(tape)
        while done < ticks:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = press_forces(scene, T, press, done, count)[:, :, None]
            stretch(tape, engine, count)
            kept.append(tape.s[:count, seen].copy())
            tape.rewind(count)
            done += count
            ticked(count)
    return oscillation(np.concatenate(kept)[ticks // 2 :], T, threshold)


def press_forces(scene: Scene, T: float, press: Array, first: int, ticks: int) -> Array:
    """Outside forces [N], (ticks, outside): `press` (m,) on the ends of the humans."""
    t = (first + np.arange(ticks)) * T
    eased = np.where(t < EASE, (1 - np.cos(np.pi * t / EASE)) / 2, 1.0)
    w = np.zeros((ticks, scene.outside))
    for force, column in zip(press, scene.pushed, strict=True):
        w[:, column] += force * eased
    return w
