"""The plant between samples by MuJoCo: `substeps` steps of one of its integrators per period."""

from __future__ import annotations

import ctypes
import glob
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy

import mujoco
import numpy as np
from mujoco import mj_step
from mujoco.batch import Batch

from controller.lti import Array
from controller.process import Tape
from models.scene import Scene

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
