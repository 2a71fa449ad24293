"""The loop with delays that vary: a linear system that switches, one matrix per set of ages of the forces in use.

State xi = [s; z; g_1[k-1] .. g_1[k-d_1]; g_2[k-1] ..]: plant, process block G (without Theta), forces on their way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from controller.coupling import Coupling
from controller.delay import Ticks
from controller.lti import Array, Lti
from controller.process import Process, Tape, force_map
from models.scene import Scene
from sim.engine import Engine
from sim.exact_engine import HeldPlant
from sim.knock import knock_forces
from sim.loop import stretch
from sim.mujoco_engine import profiler_off, quiet_warnings
from sim.simulate import Assembly

STRETCH = 32  # ticks of a tape: few, so that it stays in the processor's cache


def without_theta(assembly: Assembly, coupling: Coupling) -> Lti:
    """G = (I + Psi E V)^-1 Psi E: the forces as they leave for the devices."""
    return force_map(assembly.E, coupling, (0,) * assembly.process.channels, assembly.scenario.psi)


def with_delays(assembly: Assembly, coupling: Coupling, delays: Ticks) -> Assembly:
    """The same loop with packets that take `delays` (ticks, m, nsim or 1) in place of the constant theta.

    `assembly.F` stays that of the constant theta: certificates and transparency are about it.
    """
    return replace(assembly, process=replace(assembly.process, F=without_theta(assembly, coupling), delays=delays))


def mode_matrix(plant: HeldPlant, G: Lti, depth: Sequence[int], ages: Sequence[int]) -> Array:
    """A of xi[k+1] = A xi[k] while the forces in use have these ages [samples], age_i <= depth_i."""
    states, m = plant.A.shape[0], G.outputs
    n, first = states + G.order + sum(depth), states + G.order
    sent = np.zeros((m, n))
    sent[:, :states], sent[:, states:first] = G.D @ plant.C, G.C
    A, applied = np.zeros((n, n)), np.zeros((m, n))
    A[states:first, :states], A[states:first, states:first] = G.B @ plant.C, G.A
    row = first
    for i, (d, age) in enumerate(zip(depth, ages, strict=True)):
        if d:
            A[row] = sent[i]
            A[row + 1 : row + d, row : row + d - 1] = np.eye(d - 1)
        if age:
            applied[i, row + age - 1] = 1.0
        else:
            applied[i] = sent[i]
        row += d
    A[:states] = plant.B[:, -m:] @ applied
    A[:states, :states] += plant.A
    return A


@dataclass(frozen=True, eq=False)
class Growth:
    """What a knock becomes under given delays; one entry per simulation."""

    # (nsim,) [1/s] of the handles' speeds, last quarter over second; inf where numbers overflow, -inf at exact rest
    rate: Array
    clipped: NDArray[np.bool_]  # (nsim,) whether any force reached its limit


def knocked(process: Process, engine: Engine, scene: Scene, states: int, ticks: int, nsim: int) -> Growth:
    """Knock every handle, leave them alone, and compare their speeds early and late.

    With force limits of infinity this is the linear loop, whose growth does not depend on the size of the knock.
    """
    T, speeds = process.F.T, [scene.model.nv + handle for handle in scene.handles]
    limit = process.force_limit[:, None]
    tape = Tape(process, min(STRETCH, ticks), states, scene.outside, nsim)
    quarter, early, late, clipped = ticks // 4, np.zeros(nsim), np.zeros(nsim), np.zeros(nsim, dtype=bool)
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        engine.start(tape)
        for first in range(0, ticks, tape.ticks):
            count = min(tape.ticks, ticks - first)
            tape.w[:count] = knock_forces(scene, T, first, count)[:, :, None]
            stretch(tape, engine, count)
            clipped |= (np.abs(tape.f[:count]) >= limit).any(axis=(0, 1))
            square, k = (tape.s[:count, speeds] ** 2).sum(axis=1), np.arange(first, first + count)
            early += square[(k >= quarter) & (k < 2 * quarter)].sum(axis=0)
            late += square[k >= ticks - quarter].sum(axis=0)
            tape.rewind(count)
        rate = np.log(late / early) / 2 / ((ticks - 2 * quarter) * T)
    rate = np.where(late == 0, -np.inf, np.where(np.isnan(rate), np.inf, rate))
    return Growth(rate, clipped)


def unlimited(process: Process) -> Process:
    """The linear process: no force limits, no encoder steps."""
    return replace(process, force_limit=np.full(process.channels, np.inf), encoder_step=np.zeros(process.channels))
