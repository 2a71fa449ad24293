"""What the loop asks of a plant, and where the outside forces come from."""

from __future__ import annotations

import ctypes
import glob
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from mujoco import mj_step
from mujoco.batch import Batch
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.sparse.csgraph import connected_components

from controller.lti import Array
from controller.process import Tape
from models.scene import Plant, Scene, impeded
from sim.scenario import InputError, Scenario

# ----------------------------------------------------------------------------------------------------
# The matrix exponential of many small matrices at once.
#
# scipy.linalg.expm does the same, but hands every matrix to a BLAS that wakes all its threads for it: on busy cores
# that made the batched verdicts several times slower than their arithmetic. Each result depends on its own matrix
# only.


ORDER = 13  # of the diagonal Padé approximant, Higham (2005), table 2.3
LARGEST = 5.37  # 1-norm up to which that order has the accuracy of double precision
_PADE = [math.comb(ORDER, k) * math.factorial(2 * ORDER - k) / math.factorial(2 * ORDER) for k in range(ORDER + 1)]


def expm_each(matrices: Array) -> Array:
    """exp of each of (nsim, n, n) matrices, by scaling and squaring."""
    norm = np.abs(matrices).sum(axis=1).max(axis=1)
    halvings = np.maximum(0, np.ceil(np.log2(np.maximum(norm, LARGEST) / LARGEST))).astype(int)
    a, b = matrices * (0.5**halvings)[:, None, None], _PADE
    one = np.eye(matrices.shape[1])
    a2 = a @ a
    a4 = a2 @ a2
    a6 = a4 @ a2
    odd = a @ (a6 @ (b[13] * a6 + b[11] * a4 + b[9] * a2) + b[7] * a6 + b[5] * a4 + b[3] * a2 + b[1] * one)
    even = a6 @ (b[12] * a6 + b[10] * a4 + b[8] * a2) + b[6] * a6 + b[4] * a4 + b[2] * a2 + b[0] * one
    result = np.linalg.solve(even - odd, even + odd)
    for done in range(halvings.max(initial=0)):
        unfinished = halvings > done
        result[unfinished] = result[unfinished] @ result[unfinished]
    return result


# ----------------------------------------------------------------------------------------------------
# The plant between samples by the matrix exponential: exact for a held input.


@dataclass(frozen=True, eq=False)
class HeldPlant:
    """s[k+1] = A s[k] + B [w; f][k], x[k] = C s[k]: the plant under a zero-order hold of T seconds.

    Many plants at once have a leading axis in A and B.
    """

    A: Array  # (..., 2n, 2n)
    B: Array  # (..., 2n, outside + m)
    C: Array  # (m, 2n)
    T: float  # [s]


def hold(plant: Plant, T: float) -> HeldPlant:
    """Sample a continuous plant, or many of them, with the input held for T."""
    *many, n, inputs = plant.B.shape
    generator = np.zeros((*many, n + inputs, n + inputs))
    generator[..., :n, :n], generator[..., :n, n:] = plant.A, plant.B
    step = expm_each(generator * T) if many else expm(generator * T)
    return HeldPlant(step[..., :n, :n], step[..., :n, n:], plant.C, T)


class ExactEngine:
    """One matrix product per period, after the actuators' limits."""

    def __init__(self, plant: HeldPlant, force_limit: Array) -> None:
        self._product = np.ascontiguousarray(np.hstack([plant.A, plant.B])).dot
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, tape: Tape) -> None:
        self._rows, self._states, self._forces = tape.plant_row, tape.plant_state, tape.force

    def advance(self, k: int) -> None:
        force = self._forces[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        self._product(self._rows[k], self._states[k + 1])

    def troubled(self) -> bool:
        return False


# ----------------------------------------------------------------------------------------------------
# Many different plants at once by the matrix exponential: one product of small matrices with slabs of simulations.
#
# The simulation index is last and contiguous. What devices and humans do not share splits the plant into separate
# blocks (one device with its human each), found from the zeros of the matrices; only they are multiplied.


Which = NDArray[np.intp]


class ExactBatchEngine:
    """Simulation j of the tape moves by A[j], B[j] of the plants, after the actuators' limits."""

    def __init__(self, plants: HeldPlant, force_limit: Array) -> None:
        product = np.concatenate([plants.A, plants.B], axis=2)  # (nsim, 2n, 2n + inputs)
        self._rows, self._columns = _blocks(np.any(product != 0, axis=0))
        valid = (self._rows >= 0)[:, :, None] & (self._columns >= 0)[:, None, :]
        parts = product[:, self._rows[:, :, None], self._columns[:, None, :]] * valid
        self._matrices = np.ascontiguousarray(np.moveaxis(parts, 0, -1))  # (blocks, rows, columns, nsim)
        self._moved = np.empty((*self._rows.shape, product.shape[0]))
        self._kept = self._rows >= 0
        self._whole = bool(self._kept.all())
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, tape: Tape) -> None:
        self._slabs, self._states, self._forces = tape.plant_row, tape.plant_state, tape.force

    def advance(self, k: int) -> None:
        force = self._forces[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        np.einsum("crkn,ckn->crn", self._matrices, self._slabs[k].take(self._columns, axis=0), out=self._moved)
        if self._whole:
            self._states[k + 1][self._rows] = self._moved
        else:
            self._states[k + 1][self._rows[self._kept]] = self._moved[self._kept]

    def troubled(self) -> bool:
        return False


def _blocks(pattern: NDArray[np.bool_]) -> tuple[Which, Which]:
    """Rows and columns of the independent blocks of a (2n, 2n + inputs) pattern of nonzeros.

    Shapes (blocks, rows) and (blocks, columns); smaller blocks are filled up with -1.
    """
    n, width = pattern.shape
    graph = np.zeros((width, width), dtype=bool)
    graph[:n] = pattern
    count, label = connected_components(graph, directed=False)
    rows = [np.flatnonzero(label[:n] == c) for c in range(count)]
    columns = [np.flatnonzero(label == c) for c in range(count)]
    # an input that moves nothing is a block without rows
    pairs = [(r, c) for r, c in zip(rows, columns, strict=True) if r.size]
    return _filled([r for r, _ in pairs]), _filled([c for _, c in pairs])


def _filled(lists: list[Which]) -> Which:
    table = np.full((len(lists), max(part.size for part in lists)), -1)
    for row, part in zip(table, lists, strict=True):
        row[: part.size] = part
    return table


# ----------------------------------------------------------------------------------------------------
# The plant between samples by MuJoCo: `substeps` steps of one of its integrators per period.


#: name -> (MuJoCo's integrator, its order for the sampled position)
INTEGRATORS = {
    "RK4": (mujoco.mjtIntegrator.mjINT_RK4, 4),
    "Euler": (mujoco.mjtIntegrator.mjINT_EULER, 1),
    "implicit": (mujoco.mjtIntegrator.mjINT_IMPLICIT, 1),
    "implicitfast": (mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 1),
    "discrete": (mujoco.mjtIntegrator.mjINT_DISCRETE, 1),
}

#: an integrator of ours: MuJoCo's Euler, read and started half a step apart, which makes it second order
LEAPFROG = "Euler2"


class MujocoEngine:
    """One simulation in one MjData, which a viewer can show; inputs are held by MuJoCo's ctrl."""

    def __init__(self, scene: Scene, T: float, integrator: str = "RK4", substeps: int = 4) -> None:
        self.model = discretised(scene, T, integrator, substeps)
        self.data = mujoco.MjData(self.model)
        self.substeps = substeps

    def start(self, tape: Tape) -> None:
        n, nv = self.model.nq, self.model.nq + self.model.nv
        self._q, self._v = ([row[part, 0] for row in tape.plant_state] for part in (slice(n), slice(n, nv)))
        self._inputs = [row[:, 0] for row in tape.plant_input]
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._qpos[...], self._qvel[...] = self._q[0], self._v[0]

    def advance(self, k: int) -> None:
        self._ctrl[...] = self._inputs[k]
        mj_step(self.model, self.data, self.substeps)
        self._q[k + 1][...] = self._qpos
        self._v[k + 1][...] = self._qvel

    def troubled(self) -> bool:
        return any(warning.number for warning in self.data.warning)


class LeapfrogEngine:
    """Euler2: MuJoCo's Euler steps read as a leapfrog, second order at Euler's cost.

    Its positions are those of half a step later, q + h v/2: they start there and are read as q - h v/2. Where
    damping D acts on mass M, the mass D h/expm1(D h/M) makes MuJoCo's implicit damping decay by exactly
    exp(-D h/M) in a step. Raises ValueError for damping across a spring, which MuJoCo's Euler takes explicitly.
    """

    def __init__(self, scene: Scene, T: float, integrator: str = LEAPFROG, substeps: int = 4) -> None:
        if scene.model.tendon_damping.any():
            raise ValueError(f"{integrator} needs all damping to act against ground, here some acts across a spring")
        self.model = discretised(scene, T, "Euler", substeps)
        h, bodies = self.model.opt.timestep, self.model.dof_bodyid  # one body per joint
        rate = np.ravel(self.model.dof_damping) * h / self.model.body_mass[bodies]
        self.model.body_mass[bodies] *= np.where(rate > 0, rate / np.expm1(np.where(rate > 0, rate, 1.0)), 1.0)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)  # MuJoCo keeps a second copy of the masses of simple bodies
        self.substeps = substeps
        self._lead = h / 2

    def start(self, tape: Tape) -> None:
        n, nv = self.model.nq, self.model.nq + self.model.nv
        self._q, self._v = ([row[part, 0] for row in tape.plant_state] for part in (slice(n), slice(n, nv)))
        self._inputs = [row[:, 0] for row in tape.plant_input]
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._qpos[...], self._qvel[...] = self._q[0] + self._lead * self._v[0], self._v[0]

    def advance(self, k: int) -> None:
        self._ctrl[...] = self._inputs[k]
        mj_step(self.model, self.data, self.substeps)
        np.multiply(self._qvel, -self._lead, out=self._q[k + 1])
        self._q[k + 1] += self._qpos
        self._v[k + 1][...] = self._qvel

    def troubled(self) -> bool:
        return any(warning.number for warning in self.data.warning)


class MujocoBatchEngine:
    """All simulations of a tape in one mujoco.batch.Batch, bit for bit as MujocoEngine steps each one."""

    def __init__(
        self,
        scene: Scene,
        T: float,
        integrator: str = "RK4",
        substeps: int = 4,
        nsim: int = 1,
        nthread: int = 0,
        fields: Mapping[str, Array] | None = None,
    ) -> None:
        """`fields` gives fields of the model a row per simulation, such as masses: (nsim, ...)."""
        model = discretised(scene, T, integrator, substeps)
        self.batch = Batch(model, nsim, nthread)
        for name, rows in (fields or {}).items():
            self.batch.expand(name)[...] = rows
        if fields:
            self.batch.set_const()
        self.substeps = substeps
        time, motion = (mujoco.mj_stateSize(model, part) for part in (_TIME, _TIME | _MOTION))
        # position and velocity lie side by side in a state row, so one copy reads both
        self._state = self.batch.state[:, time:motion].T
        self._ctrl = self.batch.bind("ctrl").T

    def start(self, tape: Tape) -> None:
        self._state[...] = tape.s[0]
        self._inputs, self._states = tape.plant_input, tape.plant_state

    def advance(self, k: int) -> None:
        self._ctrl[...] = self._inputs[k]
        self.batch.step(nstep=self.substeps)
        self._states[k + 1][...] = self._state

    def troubled(self) -> bool:
        return bool(np.any(self.batch.warning))


def discretised(scene: Scene, T: float, integrator: str, substeps: int) -> mujoco.MjModel:
    """A copy of the scene's model that makes `substeps` steps of `integrator` in a period T."""
    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator is {integrator!r}, allowed are {', '.join(INTEGRATORS)}")
    if substeps < 1:
        raise ValueError(f"substeps is {substeps}, allowed are whole numbers from 1")
    if impeded(scene.model):
        raise InputError("a human has an impedance (A, B, C, D), which MuJoCo does not simulate: use the exact engine")
    model = copy(scene.model)
    model.opt.timestep = T / substeps
    model.opt.integrator = INTEGRATORS[integrator][0]
    return model


_TIME = int(mujoco.mjtState.mjSTATE_TIME)
_MOTION = int(mujoco.mjtState.mjSTATE_QPOS) | int(mujoco.mjtState.mjSTATE_QVEL)


@contextmanager
def profiler_off() -> Iterator[bool]:
    """Run without the clock that MuJoCo's Python binding reads several times per step.

    The clock is the function pointer `mjcb_time` of the library; clearing it changes no result. Yields whether
    the pointer was found; where it is not, everything just runs with the clock. It is put back at the end.
    """
    pointer = _profiler_clock()
    if pointer is None:
        yield False
        return
    saved = pointer.value
    pointer.value = None
    try:
        yield True
    finally:
        pointer.value = saved


@contextmanager
def quiet_warnings() -> Iterator[None]:
    """Keep MuJoCo from printing and logging its warnings: the engine counts and reports them."""
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


def _profiler_clock() -> ctypes.c_void_p | None:
    folder = os.path.dirname(mujoco.__file__)
    for library in glob.glob(os.path.join(folder, "libmujoco*")):
        try:
            return ctypes.c_void_p.in_dll(ctypes.CDLL(library), "mjcb_time")
        except (OSError, ValueError):
            continue
    return None


class Engine(Protocol):
    """Advances the plant by one period at a time, reading and writing a tape."""

    def start(self, tape: Tape) -> None:
        """Take the plant state of row 0 as the state at the first tick."""
        ...

    def advance(self, k: int) -> None:
        """Hold the plant input of row k for T, then write the plant state of row k + 1."""
        ...

    def troubled(self) -> bool:
        """Whether the engine itself has reported numbers that it cannot go on with."""
        ...


def outside_forces(scenario: Scenario, scene: Scene, first: int, ticks: int, voluntary: bool = True) -> Array:
    """Outside forces [N] at ticks first .. first + ticks - 1, sampled at kT, shape (ticks, outside).

    The voluntary motion reaches the end of each human, the tap reaches one handle.
    """
    t = np.arange(first, first + ticks) * scenario.T
    w = np.zeros((ticks, scene.outside))
    if voluntary:
        for human, column in zip(scenario.human, scene.pushed, strict=True):
            w[:, column] += human.voluntary_force(t)
    if scenario.tap:
        tap = scenario.tap
        begin, end = (round(t / scenario.T, 9) for t in (tap.start, tap.start + tap.duration))
        k = np.arange(first, first + ticks)
        w[(k >= begin) & (k < end), scene.tapped[tap.channel - 1]] += tap.force
    return w
