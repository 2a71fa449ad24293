"""Points of a K-B map simulated in MuJoCo, with the effects that no theory covers switched on.

At every point the humans that are nearest to oscillating there, by the exact linear loop, hold the devices. They press
them with a constant force, eased in, every handle is knocked once, and what still oscillates at the end decides:
see oscillation.py. Many points are stepped in one MuJoCo batch, each with its own process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from controller.process import Process, Tape
from models.crowd import Crowd, variants
from models.device import Device
from models.scene import Scene
from sim.knock import knock_forces
from sim.loop import stretch
from sim.mujoco_engine import MujocoBatchEngine, profiler_off, quiet_warnings
from sim.oscillation import Oscillation, oscillation
from sim.substeps import pace

EASE = 0.1  # [s] in which the press grows
STRETCH = 64  # ticks between two looks at the keyboard


@dataclass(frozen=True, eq=False)
class Trial:
    """One simulation: a process and who holds the devices."""

    process: Process
    links: Array  # (m, links, 3) as in Crowd


class ManyProcesses(Tape):
    """A tape whose simulations have a process each, all with the same channels, limits and encoder steps."""

    def __init__(self, processes: Sequence[Process], ticks: int, plant_states: int, outside: int) -> None:
        order = max(process.F.order for process in processes)
        blocks = np.array([_transition(process, order) for process in processes])
        super().__init__(_widest(processes), ticks, plant_states, outside, len(processes))
        self._blocks = np.ascontiguousarray(np.moveaxis(blocks, 0, -1))  # (outputs, inputs, nsim)

    def tick(self, k: int) -> None:
        if self._quantised:
            self._quantise(self._measured[k])
        np.einsum("oin,in->on", self._blocks, self._input[k], out=self._output[k])


def simulate_trials(
    trials: Sequence[Trial],
    devices: Sequence[Device],
    press: float,
    duration: float,
    threshold: float,
    ticked: Callable[[int], None] = lambda ticks: None,
) -> Oscillation:
    """All trials at once; their humans must have the same number of links. `press` [N], `threshold` [m]."""
    T = trials[0].process.F.T
    held_by = variants(devices, Crowd(np.stack([trial.links for trial in trials])))
    scene, ticks = held_by.scene, round(duration / T)
    substeps = pace(held_by.plants().A).substeps(T)
    tape = ManyProcesses([trial.process for trial in trials], min(STRETCH, ticks), 2 * scene.model.nv, scene.outside)
    kept, done = [], 0
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine = MujocoBatchEngine(scene, T, substeps=substeps, nsim=len(trials), fields=held_by.fields)
        engine.start(tape)
        while done < ticks:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = forces(scene, T, press, done, count)[:, :, None]
            stretch(tape, engine, count)
            kept.append(tape.s[:count, list(scene.handles)].copy())
            tape.rewind(count)
            done += count
            ticked(count)
    return oscillation(np.concatenate(kept)[ticks // 2 :], T, threshold)


def forces(scene: Scene, T: float, press: float, first: int, ticks: int) -> Array:
    """Outside forces [N], (ticks, outside): the knock, and `press` on the ends of the humans, alternately signed."""
    t = (first + np.arange(ticks)) * T
    eased = press * np.where(t < EASE, (1 - np.cos(np.pi * t / EASE)) / 2, 1.0)
    w = knock_forces(scene, T, first, ticks)
    for i, column in enumerate(scene.pushed):
        w[:, column] += (-1) ** i * eased
    return w


def _transition(process: Process, order: int) -> Array:
    """[C D; A B] of the process, with idle states up to `order`."""
    F = process.F
    idle = order - F.order
    A, B, C = np.pad(F.A, (0, idle)), np.pad(F.B, ((0, idle), (0, 0))), np.pad(F.C, ((0, 0), (0, idle)))
    return np.block([[C, F.D], [A, B]])


def _widest(processes: Sequence[Process]) -> Process:
    return max(processes, key=lambda process: process.F.order)
