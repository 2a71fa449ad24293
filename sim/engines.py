"""Engines advance the plant from one sample to the next, for one simulation or for many at once.

The plant consists of devices and hands. Its state is s = [positions q; velocities v; states of the hands' impedances].
Its inputs are the external forces w and the forces f that the controller feeds back. A step lasts h seconds.

    exact         s+ = A s + B [w; f], the matrix exponential of the plant under held inputs (no Coulomb friction)
    exponential   s+ = s + h phi1(h J) [v; qacc], exponential Rosenbrock-Euler: MuJoCo computes the accelerations qacc
                  (one mj_forward per step), J is the plant's matrix, and models.hold defines phi1. This step is exact
                  for linear scenes at any stiffness and h.
    RK4, ..       MuJoCo's own integrators; sim.accuracy compares numbers of steps per period

The exponential and the exact engine use the same J, which is read from the compiled model. A comparison of both engines
checks the plant's matrices against MuJoCo's forces, but checks neither the model's parameters nor the time stepping. A
comparison with RK4 checks the time stepping.

MuJoCo has no body for a hand's impedance (A, B, C, D). The exponential step includes the impedance and stays exact.
MuJoCo's own integrators step between two exact half steps, in which impedance and masses interact while the positions
are fixed (Strang splitting). The splitting is of second order in the step and generates no energy.

All engines read their inputs from a row of a step buffer and write the next row. With a timing (controller.delay)
every tick has its own length and latch times. A force latches when the actuator begins to apply it. If forces latch
later than the tick begins, the plant's state ends with the forces that the actuators still hold.
"""

from __future__ import annotations

import ctypes
import glob
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from haptic_loop.controller.delay import Timing
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import FusedTicks, RunBlock, StepBuffer
from haptic_loop.design.files import InputError
from haptic_loop.models.hold import HeldPlant, Product, expm_each, exponential_step, hold, latched, product_of
from haptic_loop.models.scene import Plant, Scene, Variants

if TYPE_CHECKING:
    import mujoco


_MOST_MAPS = 256  # size of two caches of an engine: plants held over a period, and products by period and latch times
_CALLS_FOR_THREADS = 128  # A batch with fewer calls of mj_forward in a tick is faster in one thread.


class Engine(Protocol):
    """Advances the plant by one period at a time."""

    def start(self, buffer: StepBuffer) -> None:
        """Take the plant state in row 0 of the buffer as the state at the first tick."""
        ...

    @property
    def advance(self) -> Callable[[int], None]:
        """A function of k. It holds the inputs in row k of the buffer for tick k, and writes the state to row k + 1."""
        ...

    def troubled(self) -> bool:
        """Return whether numerical trouble prevents the engine from going on."""
        ...


@runtime_checkable
class RunsBlocks(Protocol):
    """Optional members of an engine that runs many ticks of a linear law in one call."""

    run_block: RunBlock | None  # set by `start`; closes the loop for a number of ticks from row 0 on

    def back(self, k: int) -> None:
        """Restore the plant state of row k after a `run_block`."""
        ...


class _Exact:
    run_block: RunBlock | None = None

    def back(self, k: int) -> None:
        """Do nothing: the exact engines store no state."""

    def troubled(self) -> bool:
        return False


class ExactEngine(_Exact):
    """An engine with one matrix product per period, for one plant or a stack of plants, one for each simulation."""

    def __init__(self, plant: HeldPlant) -> None:
        self._plant = np.concatenate([plant.A, plant.B], axis=-1)
        self._product = product_of(self._plant)
        self.advance: Callable[[int], None]  # set by `start`

    def start(self, buffer: StepBuffer) -> None:
        product, rows, states = self._product, buffer.plant_row, buffer.plant_state

        def advance(k: int) -> None:
            product(rows[k], states[k + 1])

        self.advance = advance
        self.run_block = self._fused(buffer) if buffer.calm and self._plant.ndim == 2 else None

    def _fused(self, buffer: StepBuffer) -> RunBlock:
        fused = FusedTicks(buffer, *np.split(self._plant, [len(self._plant)], axis=1))
        product, before, after = fused.product, fused.before, fused.next

        def run_block(ticks: int) -> None:
            for count in fused.parts(ticks):
                for now, then in zip(before[:count], after, strict=False):
                    product(now, then)

        return run_block


class OneByOne:
    """An engine that moves each simulation of a buffer by a separate engine."""

    def __init__(self, engines: Sequence[Engine]) -> None:
        self._engines = engines

    def start(self, buffer: StepBuffer) -> None:
        process = replace(buffer.process, delays=None, net=None)  # The forces of a row are already delayed and limited.
        shape = buffer.ticks, buffer.s.shape[1], buffer.w.shape[1]
        self._all, self._each = buffer, [StepBuffer(process, *shape) for _ in self._engines]
        for j, (engine, own) in enumerate(zip(self._engines, self._each, strict=True)):
            own.calm = False
            own.s[0] = buffer.s[0, :, j : j + 1]
            engine.start(own)
        self._moves = [engine.advance for engine in self._engines]

    def advance(self, k: int, /) -> None:
        row, state = self._all.plant_row[k], self._all.plant_state[k + 1]
        for j, (own, move) in enumerate(zip(self._each, self._moves, strict=True)):
            own.plant_row[k][:, 0] = row[:, j]
            move(k)
            state[:, j] = own.plant_state[k + 1][:, 0]

    def troubled(self) -> bool:
        return any(engine.troubled() for engine in self._engines)


class ExactTimedEngine(_Exact):
    """The exact engine with the tick lengths and latch times of a timing, for one plant or a stack of plants."""

    def __init__(self, plant: Plant, timing: Timing) -> None:
        held, kinds = lru_cache(_MOST_MAPS)(partial(hold, plant)), timing.kinds

        @lru_cache(_MOST_MAPS)
        def product(kind: int) -> Product:
            T, late = kinds[kind]
            step = held(T) if late is None else latched(held, T, late)
            return product_of(np.concatenate([step.A, step.B], axis=-1))

        self._product, self._which = product, timing.which

    def start(self, buffer: StepBuffer) -> None:
        self._buffer = buffer

    def advance(self, k: int, /) -> None:
        buffer, which = self._buffer, self._which
        self._product(which[(buffer.first + k) % len(which)])(buffer.plant_row[k], buffer.plant_state[k + 1])


# ---- MuJoCo's engines

EXPONENTIAL = "exponential"  # this program's integrator, which reads MuJoCo's accelerations

#: name -> integrator that is set in MuJoCo's model, although "exponential" never calls it
INTEGRATORS = {
    EXPONENTIAL: "mjINT_RK4",
    "RK4": "mjINT_RK4",
    "Euler": "mjINT_EULER",
    "implicit": "mjINT_IMPLICIT",
    "implicitfast": "mjINT_IMPLICITFAST",
    "discrete": "mjINT_DISCRETE",
}

_RESOLVED, _FOLLOWED = 0.2, 1.0  # largest phase [rad], and largest decay (rate times step), in a step


def least_substeps(integrator: str) -> int:
    """Return the default number of steps per period if the plant needs no smaller steps."""
    return 1 if integrator == EXPONENTIAL else 4


def evaluations(integrator: str) -> int:
    """Return how often a step of the integrator evaluates the dynamics (mj_forward)."""
    return 4 if integrator == "RK4" else 1


def default_integrator(scene: Scene) -> str:
    """Return "exponential" for a scene without friction, otherwise "RK4", whose error is then smaller at equal cost."""
    rubs = scene.model.dof_frictionloss.any() or scene.model.tendon_frictionloss.any()
    return "RK4" if rubs else EXPONENTIAL


def _segments(late: tuple[float, ...] | None, T: float) -> list[tuple[float, NDArray[np.bool_]]]:
    """Return the parts of a tick between latches: (seconds, mask (m,) or (0,) of channels with the previous force)."""
    taus = np.array(late or ())
    ends = np.unique(np.concatenate([[0.0], taus, [T]]))
    return [(float(b - a), taus > a) for a, b in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class _Access:
    """Arrays and functions of MuJoCo that a tick reads, writes and calls.

    Arrays are (n,) for one simulation and (n, nsim) for many. `ticks` returns closures, because attribute lookups would
    take longer than the step. The closures must not refer to the engine: this cycle would keep its memory allocated.
    """

    T: float  # [s]
    substeps: int
    ctrl: Array
    state: Array  # [q; v], (2, n) for one simulation and (2 n, nsim) for many
    size: int  # length of a plant state: q, v and the states of the hands' impedances
    qacc: Array
    forward: Callable[[], object]
    step: Callable[[int], object]  # makes a number of steps
    pace: Callable[[float], object]  # sets the length of a step [s]
    move: Callable[[float], Product] | None  # seconds -> exponential step from [s; qacc] to s+; None: MuJoCo's own
    kick: Callable[[float], Product] | None  # seconds -> step of s in which positions are fixed; None: no impedances

    def put(self, buffer: StepBuffer, k: int) -> None:
        self.state[...] = buffer.s[k, : 2 * len(self.qacc)].reshape(self.state.shape)

    def ticks(self, buffer: StepBuffer, timing: Timing | None) -> Callable[[int], None]:
        """Return a function of k that advances the plant from row k of the buffer to row k + 1."""
        one = (..., 0) if self.ctrl.ndim == 1 else ...
        states = buffer.s[:, : self.size][one]
        rows, inputs = list(states), list(buffer.rows[:, -len(self.ctrl) :][one])
        if timing or (self.kick and not self.move):
            return self._timed(buffer, timing or Timing(np.array([self.T]), None), rows, inputs)
        shaped = list(self._shaped(states))
        return self._by_exponentials(rows, inputs, shaped) if self.move else self._by_steps(inputs, shaped)

    def _shaped(self, states: Array) -> Array:
        """Return a view of q and v in states (ticks, size, ..). The view of each tick has the shape of `state`."""
        return states[:, : 2 * len(self.qacc)].reshape(-1, *self.state.shape)

    def _by_steps(self, inputs: list[Array], written: list[Array]) -> Callable[[int], None]:
        ctrl, state, step, count = self.ctrl, self.state, self.step, self.substeps

        def advance(k: int) -> None:
            ctrl[...] = inputs[k]
            step(count)
            written[k + 1][...] = state

        return advance

    def _by_exponentials(self, rows: list[Array], inputs: list[Array], shaped: list[Array]) -> Callable[[int], None]:
        assert self.move
        ctrl, state, qacc, forward, move = self.ctrl, self.state, self.qacc, self.forward, self.move
        sight = np.concatenate([rows[0], np.zeros_like(qacc)])  # [q; v; qacc]
        seen, qacc_seen = np.split(sight, [len(rows[0])])
        product, each = move(self.T / self.substeps), range(self.substeps)

        def advance(k: int) -> None:
            ctrl[...] = inputs[k]
            before, after = rows[k], rows[k + 1]
            for _ in each:
                forward()
                seen[...] = before
                qacc_seen[...] = qacc
                product(sight, after)
                state[...] = shaped[k + 1]
                before = after

        return advance

    def _timed(
        self, buffer: StepBuffer, timing: Timing, rows: list[Array], inputs: list[Array]
    ) -> Callable[[int], None]:
        """Return a function that advances from latch to latch. The plant state ends with the forces that are held."""
        kinds, which = [_segments(late, T) for T, late in timing.kinds], timing.which
        m, states = 0 if timing.late is None else timing.late.shape[1], len(rows[0])
        forces = self.ctrl[len(self.ctrl) - m :]

        def advance(k: int) -> None:
            self.ctrl[...] = inputs[k]
            wanted, held = inputs[k][len(self.ctrl) - m :], buffer.plant_state[k][states:].reshape(forces.shape)
            rows[k + 1][...] = rows[k]
            for seconds, waiting in kinds[which[(buffer.first + k) % len(which)]]:
                forces[...] = wanted
                forces[waiting] = held[waiting]
                self._move_by(seconds, rows[k + 1])
            if m:
                buffer.plant_state[k + 1][states:] = wanted.reshape(m, -1)

        return advance

    def _move_by(self, seconds: float, row: Array) -> None:
        """Advance MuJoCo by some seconds; `row` holds MuJoCo's state before and afterwards."""
        (view,) = self._shaped(row[None])
        if self.move:
            for _ in range(self.substeps):
                self.forward()
                self.move(seconds / self.substeps)(np.concatenate([row, self.qacc]), row)
                self.state[...] = view
            return
        count = max(1, math.ceil(self.substeps * seconds / self.T - 1e-9))  # Rounding must not add a step.
        self.pace(seconds / count)
        if not self.kick:
            self.step(count)
            view[...] = self.state
            return
        half = self.kick(seconds / count / 2)
        for _ in range(count):
            half(row.copy(), row)
            self.state[...] = view
            self.step(1)
            view[...] = self.state
            half(row.copy(), row)
        self.state[...] = view


class MujocoEngine:
    """An engine for one simulation in one MjData, which a viewer can show."""

    def __init__(
        self, scene: Scene, T: float, integrator: str = "RK4", substeps: int | None = None, timing: Timing | None = None
    ) -> None:
        import mujoco

        substeps = least_substeps(integrator) if substeps is None else substeps
        self.model = _discretised(scene, T, integrator, substeps)
        self.data = mujoco.MjData(self.model)
        self._warnings = self.data.warning.number
        self.run_block: RunBlock | None = None
        stacked, moves = _stacked(scene.plant), partial(_step_of, scene.plant, scene.model.nv)
        # With friction MuJoCo starts its solver from the last solution, which `back` cannot restore.
        self._smooth = default_integrator(scene) == EXPONENTIAL
        self._one_step = moves if integrator == EXPONENTIAL and substeps == 1 else None
        self._timing, both, q, v = timing, (self.model, self.data), self.data.qpos, self.data.qvel
        self._access = _Access(
            T,
            substeps,
            ctrl=self.data.ctrl,
            # The view spans q and v wherever MuJoCo has stored them, so that one copy reads both.
            state=as_strided(q, (2, q.size), (v.ctypes.data - q.ctypes.data, q.itemsize)),
            size=len(scene.plant.A),
            qacc=self.data.qacc,
            forward=partial(mujoco.mj_forward, *both),
            step=partial(mujoco.mj_step, *both),
            pace=partial(setattr, self.model.opt, "timestep"),
            move=(lambda h: moves(h).dot) if integrator == EXPONENTIAL else None,
            kick=_kicks(stacked),
        )

    def start(self, buffer: StepBuffer) -> None:
        self._buffer, self.run_block, access = buffer, None, self._access
        access.put(buffer, 0)
        self._warnings[:] = 0
        self._advance: Callable[[int], None] | None = None
        if buffer.calm and self._smooth and not self._timing:
            if self._one_step:
                self.run_block = self._fused(buffer, self._one_step(access.T))
            elif not (access.move or access.kick):
                self.run_block = self._stepped(buffer)

    @property
    def advance(self) -> Callable[[int], None]:
        self._advance = self._advance or self._access.ticks(self._buffer, self._timing)
        return self._advance

    def _fused(self, buffer: StepBuffer, move: Array) -> RunBlock:
        access, states = self._access, len(move)
        fused = FusedTicks(buffer, move[:, :states], G=move[:, states:])
        ctrl, qacc, forward, (q, v) = access.ctrl.data, access.qacc.data, access.forward, access.state
        q, v = q.data, v.data
        rows, product = list(zip(*fused.copied(len(q)), fused.before, fused.next, strict=False)), fused.product

        def run_block(ticks: int) -> None:
            for count in fused.parts(ticks):
                for inputs, rate, q_then, v_then, now, then in rows[:count]:
                    ctrl[:] = inputs
                    forward()
                    rate[:] = qacc
                    product(now, then)
                    q[:] = q_then
                    v[:] = v_then

        return run_block

    def _stepped(self, buffer: StepBuffer) -> RunBlock:
        access = self._access
        ctrl, state, step, count = access.ctrl, access.state, access.step, access.substeps
        rows, law, m = buffer.rows[:, :, 0], buffer.process.linear.dot, buffer.process.channels
        states = list(buffer.s[1:, :, 0].reshape(-1, *state.shape))
        before, after = list(rows[:, : buffer.z.shape[1] + m]), list(buffer.after[:, :, 0])
        inputs = list(rows[:, -len(ctrl) :])

        def run_block(ticks: int) -> None:
            for now, then, held, moved in zip(before, after[:ticks], inputs, states, strict=False):
                law(now, then)
                ctrl[...] = held
                step(count)
                moved[...] = state

        return run_block

    def back(self, k: int) -> None:
        self._access.put(self._buffer, k)
        self._warnings[:] = 0

    def troubled(self) -> bool:
        return bool(self._warnings.any())


class MujocoBatchEngine:
    """An engine for all simulations of a buffer, one per set of humans, in one mujoco.batch.Batch.

    Each simulation has the same bits as in MujocoEngine. Exceptions are the exponential integrator and impedances,
    whose matrix products are summed in another order and differ by rounding.
    """

    def __init__(
        self,
        held_by: Variants,
        T: float,
        integrator: str = "RK4",
        substeps: int | None = None,
        nthread: int = 0,
        timing: Timing | None = None,
    ) -> None:
        import mujoco
        from mujoco.batch import Batch

        substeps = least_substeps(integrator) if substeps is None else substeps
        model = _discretised(held_by.scene, T, integrator, substeps)
        calls = len(held_by) * substeps * evaluations(integrator)
        self.batch = batch = Batch(model, len(held_by), nthread or int(calls < _CALLS_FOR_THREADS))
        for name, rows in held_by.fields.items():
            batch.expand(name)[...] = rows
        batch.set_const()
        parts, before = mujoco.mjtState, int(mujoco.mjtState.mjSTATE_TIME)
        moved = before | int(parts.mjSTATE_QPOS) | int(parts.mjSTATE_QVEL)
        time, motion = (mujoco.mj_stateSize(model, part) for part in (before, moved))

        # With MuJoCo's own integrators, only steps of impedances need the matrices of the plants.
        exact_step = integrator == EXPONENTIAL or held_by.impedances
        plants = held_by.plants() if exact_step else _stacked(held_by.scene.plant)

        def move(h: float) -> Product:
            return _product_of_each(exponential_step(plants.A, h, model.nv, plants.felt))

        self.advance: Callable[[int], None]  # set by `start`
        self._timing = timing
        self._access = _Access(
            T,
            substeps,
            ctrl=batch.bind("ctrl").T,
            state=batch.state[:, time:motion].T,  # position and velocity lie side by side in a state row
            size=plants.A.shape[-1],
            qacc=batch.bind("qacc").T,
            forward=batch.forward,
            step=lambda count: batch.step(nstep=count),
            pace=batch.expand("opt.timestep").fill if timing else float,
            move=cache(move) if integrator == EXPONENTIAL else None,
            kick=_kicks(plants),
        )

    def start(self, buffer: StepBuffer) -> None:
        self._access.put(buffer, 0)
        self.advance = self._access.ticks(buffer, self._timing)

    def troubled(self) -> bool:
        return bool(np.any(self.batch.warning))


@lru_cache(64)  # Successive runs often have the same plant.
def _step_of(plant: Plant, n: int, h: float) -> Array:
    """Return the matrix that takes [s; qacc] to s after h seconds, for one plant with n joints."""
    stacked = _stacked(plant)
    return exponential_step(stacked.A, h, n, stacked.felt)[0]


def _stacked(plant: Plant) -> Plant:
    if plant.A.ndim > 2:
        return plant
    return Plant(plant.A[None], plant.B[None], plant.C, None if plant.felt is None else plant.felt[None])


def _kicks(plants: Plant) -> Callable[[float], Product] | None:
    """Return a function from seconds to the step of the impedances alone; None without impedances."""
    felt = plants.felt
    if felt is None:
        return None

    @cache
    def kick(h: float) -> Product:
        return _product_of_each(expm_each(h * felt))

    return kick


def _product_of_each(steps: Array) -> Product:
    """Return a function that multiplies column j by matrix j, or all columns by a single matrix."""
    return product_of(steps if len(steps) > 1 else steps[0])


def _discretised(scene: Scene, T: float, integrator: str, substeps: int) -> mujoco.MjModel:
    """Return a copy of the scene's model for `substeps` steps of `integrator` in a period T.

    Raises ValueError for impossible settings, and InputError if the scene does not permit the integrator.
    """
    import mujoco

    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator is {integrator!r}, allowed are {', '.join(INTEGRATORS)}")
    if substeps < 1:
        raise ValueError(f"substeps is {substeps}, allowed are whole numbers from 1")
    if integrator == EXPONENTIAL != default_integrator(scene) and scene.plant.felt is not None:
        raise InputError("a human has an impedance (A, B, C, D) and a device has friction: use integrator RK4")
    model = copy(scene.model)
    model.opt.timestep = T / substeps
    model.opt.integrator = getattr(mujoco.mjtIntegrator, INTEGRATORS[integrator])
    return model


@contextmanager
def profiler_off() -> Iterator[bool]:
    """Run without the clock that MuJoCo's Python binding reads several times per step.

    The clock is the function pointer `mjcb_time` of the library; clearing it changes no result. Yields whether the
    pointer was found; if not, the clock stays on.
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


@cache
def _profiler_clock() -> ctypes.c_void_p | None:
    import mujoco

    folder = os.path.dirname(mujoco.__file__)
    for library in glob.glob(os.path.join(folder, "libmujoco*")):
        try:
            return ctypes.c_void_p.in_dll(ctypes.CDLL(library), "mjcb_time")
        except (OSError, ValueError):
            continue
    return None


@dataclass(frozen=True)
class _PlantSpeed:
    """The fastest motions of a plant, which bound the step of an integrator."""

    mode: float  # [rad/s] frequency of the fastest weakly damped mode; 0 if there is none
    rate: float  # [1/s] decay rate of the mode that decays fastest

    def within(self, h: float) -> bool:
        return self.mode * h <= _RESOLVED and self.rate * h < _FOLLOWED

    def substeps(self, T: float) -> int:
        """Return the least number of steps of MuJoCo's integrators in T seconds that resolves these motions."""
        return max(
            least_substeps("RK4"), math.ceil(self.mode * T / _RESOLVED), math.floor(self.rate * T / _FOLLOWED) + 1
        )

    def hardest(self, h: float) -> str:
        """Return in words the motion that steps of h seconds resolve worst."""
        if self.mode / _RESOLVED >= self.rate / _FOLLOWED:
            return f"the mode at {self.mode / (2 * math.pi):.4g} Hz advances {self.mode * h:.3g} rad in a step"
        return f"the damping of {self.rate:.4g} 1/s times the step is {self.rate * h:.3g}"


def pace(A: Array) -> _PlantSpeed:
    """Return the fastest motions of x' = A x, or of a stack. An eigenvalue with |Im| > |Re| counts as weakly damped."""
    values = np.linalg.eigvals(A)
    weak = np.abs(values.imag) > np.abs(values.real)
    return _PlantSpeed(float(np.abs(values[weak]).max(initial=0.0)), float(-values.real.min(initial=0.0)))
