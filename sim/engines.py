"""Engines: what moves the plant between two samples, for one simulation or for many at once.

    exact         s+ = A s + B [w; f], the matrix exponential of the plant under held inputs (no Coulomb friction)
    exponential   s+ = s + h phi1(h J) [v; qacc], exponential Rosenbrock-Euler: accelerations by one mj_forward a step,
                  J from the compiled model's matrices; exact on a linear scene, whatever its stiffness and the step
    RK4, ..       steps of MuJoCo's own integrators, whose number per period sim.stepping decides

All of them read their inputs from the rows of a step buffer and write the next row, with no copy in between. With a
timing (controller.timing) every tick has a length of its own, and forces that latch late act from within it; then the
forces that the actuators hold are the last entries of the plant's state. The exponential engine shares J with the exact
one, so it checks forces and assembly, not the stepping in time: for that there is RK4.
"""

from __future__ import annotations

import ctypes
import glob
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np
import scipy  # its parts load when they are used
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from controller.lti import Array
from controller.tick import StepBuffer
from controller.timing import Timing
from design.files import InputError
from models.scene import Plant, Scene, Variants, impeded, plant

if TYPE_CHECKING:
    import mujoco

#: the integrator of ours, which reads MuJoCo's accelerations
EXPONENTIAL = "exponential"

#: name -> what MuJoCo's model is set to, for the exponential one, where it decides nothing, to RK4
INTEGRATORS = {
    EXPONENTIAL: "mjINT_RK4",
    "RK4": "mjINT_RK4",
    "Euler": "mjINT_EULER",
    "implicit": "mjINT_IMPLICIT",
    "implicitfast": "mjINT_IMPLICITFAST",
    "discrete": "mjINT_DISCRETE",
}

_MOST_MAPS = 256  # of ticks that differ, kept by an engine
_WHOLE = 1e-9  # of a step: rounding, where a number of steps is counted

LEAST = 4  # steps per period of MuJoCo's own integrators


_Stretch = Callable[[int], None]


class Engine(Protocol):
    """Advances the plant by one period at a time, reading and writing a buffer."""

    def start(self, buffer: StepBuffer) -> None:
        """Take the plant state of row 0 as the state at the first tick."""
        ...

    def advance(self, k: int, /) -> None:
        """Hold the plant input of row k for T, then write the plant state of row k + 1."""
        ...

    def troubled(self) -> bool:
        """Whether the engine itself has reported numbers that it cannot go on with."""
        ...

    # One that can may also have, from `start` on:
    #   stretch(ticks)   the linear law and `advance` for so many ticks from row 0 on, in fewer calls; or None
    #   back(k)          after a stretch the plant goes back to the state of row k


class _NeverTroubled:
    stretch: _Stretch | None = None

    def back(self, k: int) -> None:
        """The exact engines have no state of their own."""

    def troubled(self) -> bool:
        return False


def default_integrator(scene: Scene) -> str:
    """exponential where the scene is smooth; RK4 where something rubs, which is nearer there at equal cost."""
    rubs = scene.model.dof_frictionloss.any() or scene.model.tendon_frictionloss.any()
    return "RK4" if rubs else EXPONENTIAL


# ---- the exact engine


@dataclass(frozen=True, eq=False)
class HeldPlant:
    """s[k+1] = A s[k] + B [w; f][k], x[k] = C s[k]: the plant under a zero-order hold of T seconds.

    Many plants at once have a leading axis in A and B.
    """

    A: Array  # (..., 2n, 2n)
    B: Array  # (..., 2n, outside + m)
    C: Array  # (m, 2n)
    T: float  # [s]


def hold(plant: Plant, T: float, late: Sequence[float] | None = None) -> HeldPlant:
    """Sample a continuous plant, or many of them, with the input held for T.

    Where forces latch `late` (m,) [s] after the tick, the state is [s; forces that the actuators hold]: until then
    the last ones act, s+ = A(T) s + B(T) [w; held] + B(T - late) (f - held).
    """
    if late is not None:
        return _latched(partial(hold, plant), T, late)
    *many, n, inputs = plant.B.shape
    generator = np.zeros((*many, n + inputs, n + inputs))
    generator[..., :n, :n], generator[..., :n, n:] = plant.A, plant.B
    if many:
        step = _expm_in_units(generator * T, np.concatenate([_units(plant.A, T), np.ones((*many, inputs))], axis=1))
    else:
        step = scipy.linalg.expm(generator * T)
    return HeldPlant(step[..., :n, :n], step[..., :n, n:], plant.C, T)


def _latched(held: Callable[[float], HeldPlant], T: float, late: Sequence[float]) -> HeldPlant:
    """As hold with `late`, from the plant held for the times that are asked for."""
    whole, m = held(T), len(late)
    *many, n, inputs = whole.B.shape
    w = inputs - m
    A, B = np.zeros((*many, n + m, n + m)), np.zeros((*many, n + m, inputs))
    A[..., :n, :n], B[..., :n, :w], B[..., n:, w:] = whole.A, whole.B[..., :w], np.eye(m)
    for i, tau in enumerate(late):
        if tau < T:
            B[..., :n, w + i] = held(T - tau).B[..., w + i]
    A[..., :n, n:] = whole.B[..., w:] - B[..., :n, w:]
    return HeldPlant(A, B, np.pad(whole.C, ((0, 0), (0, m))), T)


def at_the_latch(plant: Plant, late: Sequence[float]) -> Array:
    """[s; forces held; w; f] of a tick to where each device is when its own force latches, (..., m, entries)."""
    *many, n, inputs = plant.B.shape
    m = len(late)
    rows = np.zeros((*many, m, n + m + inputs))
    for i, tau in enumerate(late):
        if tau == 0:
            rows[..., i, :n] = plant.C[i]
            continue
        held = hold(plant, tau, [min(other, tau) for other in late])  # the forces that latch before act by then
        rows[..., i, :] = held.C[i] @ np.concatenate([held.A, held.B], axis=-1)
    return rows


class _Fused:
    """The plant's step and the law at its end in one product a tick: [f; s; z+] of the next one.

    A row of the memory is [w, f, s, z+, a] of a tick, where `further` entries a are the engine's own.
    """

    def __init__(self, buffer: StepBuffer, step: Array, further: int = 0) -> None:
        """`step` makes the next s of the last entries of a row, (states, entries)."""
        law, outside, states = buffer.process.linear, buffer.w.shape[1], len(step)
        m, nz = buffer.process.channels, buffer.process.F.order
        self._places = places = np.cumsum([outside, m, states, nz, further])
        self.memory = memory = np.zeros((buffer.ticks + 1, places[-1]))
        start, z = places[-1] - step.shape[1], slice(places[2] - places[-1], step.shape[1] - further)
        seen = np.zeros((nz + m, step.shape[1]))
        seen[:nz, z], seen[nz:] = np.eye(nz), step[:m]
        after = law @ seen
        self.product = np.vstack([after[:m], step, after[m:]]).dot
        self.held, self.before = list(memory[:, : places[1]]), list(memory[:, start:])
        self.next, self.states = list(memory[1:, places[0] : places[3]]), memory[1:, places[1] : places[2]]
        self.further = list(memory[:, places[3] :])
        self._buffer, self._law = buffer, law.dot

    def begin(self, ticks: int) -> None:
        """Take the first row of the buffer, with the law there, and the outside forces."""
        buffer, memory, (outside, to_f, to_s, to_z, _) = self._buffer, self.memory, self._places
        m = to_f - outside
        self._law(buffer.rows[0, : to_z - to_s + m], buffer.after[0])
        memory[:ticks, :outside] = buffer.w[:ticks, :, 0]
        memory[0, outside:to_f], memory[0, to_s:to_z] = np.split(buffer.after[0, :, 0], [m])
        memory[0, to_f:to_s] = buffer.s[0, :, 0]

    def end(self, ticks: int) -> None:
        """Write what the ticks came to, and the plant's state after them."""
        buffer, (outside, to_f, to_s, to_z, _) = self._buffer, self._places
        rows, m = self.memory[1 : ticks + 1], to_f - outside
        buffer.s[1 : ticks + 1, :, 0] = rows[:, to_f:to_s]
        buffer.after[1:ticks, :m, 0] = rows[:-1, outside:to_f]
        buffer.after[1:ticks, m:, 0] = rows[:-1, to_s:to_z]


def _exactly(buffer: StepBuffer, plant: Array) -> _Stretch:
    """Stretches of the plant [A, B] that acts on [s; w; f]."""
    states = len(plant)
    step = np.hstack([plant[:, states:], plant[:, :states], np.zeros((states, buffer.process.F.order))])
    fused = _Fused(buffer, step)
    product, before, after = fused.product, fused.before, fused.next

    def stretch(ticks: int) -> None:
        fused.begin(ticks)
        for k in range(ticks):
            product(before[k], after[k])
        fused.end(ticks)

    return stretch


class ExactEngine(_NeverTroubled):
    """One matrix product per period, after the actuators' limits."""

    def __init__(self, plant: HeldPlant, force_limit: Array) -> None:
        self._plant = np.hstack([plant.A, plant.B])
        self._high = force_limit[:, None]
        self.advance: Callable[[int], None]  # from `start` on

    def start(self, buffer: StepBuffer) -> None:
        product, rows, states = np.ascontiguousarray(self._plant).dot, buffer.plant_row, buffer.plant_state

        def free(k: int) -> None:
            product(rows[k], states[k + 1])

        self.advance, self.stretch = free, None
        limiter = buffer.process.limiter
        within = limiter and not buffer.process.net and (limiter.limit[:, None] <= self._high).all()
        if within or np.isinf(self._high).all():  # forces have left within the limits
            if buffer.calm:
                self.stretch = _exactly(buffer, self._plant)
            return
        forces, low, high = buffer.force, -self._high, self._high

        def limited(k: int) -> None:
            force = forces[k]
            np.minimum(force, high, out=force)
            np.maximum(force, low, out=force)
            product(rows[k], states[k + 1])

        self.advance = limited


class ExactTimedEngine(_NeverTroubled):
    """A tick of a timing moves the plant, or simulation j plant j of many, exactly, after the actuators' limits."""

    def __init__(self, plant: Plant, timing: Timing, force_limit: Array) -> None:
        held, kinds = lru_cache(_MOST_MAPS)(partial(hold, plant)), timing.kinds

        @lru_cache(_MOST_MAPS)
        def product(kind: int) -> _Product:
            T, late = kinds[kind]
            step = held(T) if late is None else _latched(held, T, late)
            both = np.concatenate([step.A, step.B], axis=-1)
            return _each_by_its_own(both) if both.ndim == 3 else np.ascontiguousarray(both).dot

        self._product, self._which = product, timing.which
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, buffer: StepBuffer) -> None:
        self._buffer = buffer

    def advance(self, k: int, /) -> None:
        buffer, which = self._buffer, self._which
        force = buffer.force[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        self._product(which[(buffer.first + k) % len(which)])(buffer.plant_row[k], buffer.plant_state[k + 1])


class ExactBatchEngine(_NeverTroubled):
    """Simulation j of the buffer moves by A[j], B[j] of the plants, after the actuators' limits."""

    def __init__(self, plants: HeldPlant, force_limit: Array) -> None:
        self._product = _each_by_its_own(np.concatenate([plants.A, plants.B], axis=2))
        self._high = force_limit[:, None]
        self._low = -self._high

    def start(self, buffer: StepBuffer) -> None:
        self._slabs, self._states, self._forces = buffer.plant_row, buffer.plant_state, buffer.force

    def advance(self, k: int, /) -> None:
        force = self._forces[k]
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)
        self._product(self._slabs[k], self._states[k + 1])


def expm_each(matrices: Array) -> Array:
    """exp of each of (nsim, n, n) matrices, by scaling and squaring; a result depends on its own matrix only.

    scipy.linalg.expm hands every matrix to a BLAS that wakes all its threads for it: on busy cores that made verdicts
    about many humans several times slower than their arithmetic.
    """
    norm = np.abs(matrices).sum(axis=1).max(axis=1)
    halvings = np.maximum(0, np.ceil(np.log2(np.maximum(norm, _LARGEST) / _LARGEST))).astype(int)
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


def _units(A: Array, h: float) -> Array:
    """What to measure the states of s' = A s in, (nsim, 2n), where exp(h A) is asked for.

    Velocities in units of a rate near the fastest mode's: then a stiff plant has no larger norm than that mode times h,
    and its exponential is rounded by 1e-16 instead of 1e-11. Powers of two, which round nothing themselves.
    """
    n = A.shape[2] // 2
    fastest = np.sqrt(np.abs(A[:, n:, :n]).max(axis=(1, 2)))
    unit = np.ones(A.shape[:2])
    unit[:, n:] = 2.0 ** np.ceil(np.log2(np.maximum(fastest, 1 / h)))[:, None]
    return unit


def _expm_in_units(matrices: Array, unit: Array) -> Array:
    """exp of (nsim, n, n) matrices, computed with entry i of what they act on measured in unit[:, i]."""
    return expm_each(matrices * unit[:, None, :] / unit[:, :, None]) * unit[:, :, None] / unit[:, None, :]


_ORDER = 13  # of the diagonal Padé approximant, Higham (2005), table 2.3
_LARGEST = 5.37  # 1-norm up to which that order has the accuracy of double precision
_PADE = [math.comb(_ORDER, k) * math.factorial(2 * _ORDER - k) / math.factorial(2 * _ORDER) for k in range(_ORDER + 1)]

_Product = Callable[[Array, Array], object]  # (columns, nsim), (rows, nsim): writes the second
_Which = NDArray[np.intp]


def _each_by_its_own(matrices: Array) -> _Product:
    """The product of (nsim, rows, columns) matrices with a slab, the simulation last and contiguous in it.

    What devices and humans do not share splits a plant into separate blocks (one device with its human each), found
    from the zeros of the matrices; only they are multiplied.
    """
    rows, columns = _blocks(np.any(matrices != 0, axis=0))
    valid = (rows >= 0)[:, :, None] & (columns >= 0)[:, None, :]
    parts = matrices[:, rows[:, :, None], columns[:, None, :]] * valid
    blocks = np.ascontiguousarray(np.moveaxis(parts, 0, -1))  # (blocks, rows, columns, nsim)
    moved = np.empty((*rows.shape, matrices.shape[0]))
    kept, index = rows >= 0, ...
    if not kept.all():
        index, rows = kept, rows[kept]

    def multiply(slab: Array, out: Array) -> None:
        np.einsum("crkn,ckn->crn", blocks, slab.take(columns, axis=0), out=moved)
        out[rows] = moved[index]

    return multiply


def _blocks(pattern: NDArray[np.bool_]) -> tuple[_Which, _Which]:
    """Rows and columns of the independent blocks of a (2n, 2n + inputs) pattern of nonzeros.

    Shapes (blocks, rows) and (blocks, columns); smaller blocks are filled up with -1.
    """
    n, width = pattern.shape
    graph = np.zeros((width, width), dtype=bool)
    graph[:n] = pattern
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    rows = [np.flatnonzero(label[:n] == c) for c in range(count)]
    columns = [np.flatnonzero(label == c) for c in range(count)]
    # an input that moves nothing is a block without rows
    pairs = [(r, c) for r, c in zip(rows, columns, strict=True) if r.size]
    return _filled([r for r, _ in pairs]), _filled([c for _, c in pairs])


def _filled(lists: list[_Which]) -> _Which:
    table = np.full((len(lists), max(part.size for part in lists)), -1)
    for row, part in zip(table, lists, strict=True):
        row[: part.size] = part
    return table


# ---- MuJoCo's engines

#: fields of a model that its mass, damping and stiffness matrices are made of
_MECHANICAL = ("body_mass", "jnt_stiffness", "dof_damping", "tendon_stiffness", "tendon_damping")


def _segments(late: tuple[float, ...] | None, T: float) -> list[tuple[float, NDArray[np.bool_]]]:
    """(seconds, channels whose last force still acts) between the latch times of a tick, (m,) or (0,) each."""
    taus = np.array(late or ())
    ends = np.unique(np.concatenate([[0.0], taus, [T]]))
    return [(float(b - a), taus > a) for a, b in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class _Access:
    """What is written to MuJoCo and read from it: of one simulation arrays (n,), of many (n, nsim).

    Its ticks are closures: looking things up would take longer than moving them, and a bound method would be a cycle
    that keeps a batch's memory.
    """

    T: float  # [s]
    substeps: int
    ctrl: Array
    state: Array  # [q; v], (2, n) of one simulation
    qacc: Array
    forward: Callable[[], object]
    step: Callable[[int], object]  # so many steps
    pace: Callable[[float], object]  # sets their length [s]
    move: Callable[[float], _Product] | None  # seconds -> [q; v; qacc] to [q; v] then, where steps are exponential

    def put(self, buffer: StepBuffer, k: int) -> None:
        """Put the plant into the state of row k."""
        self.state[...] = buffer.s[k, : 2 * len(self.qacc)].reshape(self.state.shape)

    def ticks(self, buffer: StepBuffer, timing: Timing | None) -> Callable[[int], None]:
        """What moves tick k of the buffer, from where the plant is."""
        one = (..., 0) if self.ctrl.ndim == 1 else ...
        states = buffer.s[:, : 2 * len(self.qacc)][one]
        rows, inputs = list(states), list(buffer.rows[:, -len(self.ctrl) :][one])
        if timing:
            return self._timed(buffer, timing, rows, inputs)
        shaped = list(states.reshape(-1, *self.state.shape))
        return self._by_exponentials(rows, inputs, shaped) if self.move else self._by_steps(inputs, shaped)

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
        """From latch to latch; of the next row also the forces that are held, behind the state."""
        kinds, which = [_segments(late, T) for T, late in timing.kinds], timing.which
        m, states = 0 if timing.late is None else timing.late.shape[1], len(rows[0])
        forces = self.ctrl[len(self.ctrl) - m :]
        limit = buffer.process.force_limit[:m].reshape(m, *[1] * (forces.ndim - 1))

        def advance(k: int) -> None:
            self.ctrl[...] = inputs[k]
            asked, held = inputs[k][len(self.ctrl) - m :], buffer.plant_state[k][states:].reshape(forces.shape)
            for seconds, waiting in kinds[which[(buffer.first + k) % len(which)]]:
                forces[...] = asked
                forces[waiting] = held[waiting]
                self._move_by(seconds)
            rows[k + 1][...] = self.state.reshape(rows[k + 1].shape)
            if m:
                buffer.plant_state[k + 1][states:] = np.clip(asked, -limit, limit).reshape(m, -1)

        return advance

    def _move_by(self, seconds: float) -> None:
        if self.move is None:
            count = math.ceil(self.substeps * seconds / self.T - _WHOLE)
            self.pace(seconds / count)
            self.step(count)
            return
        seen = np.empty((2 * len(self.qacc), *self.qacc.shape[1:]))
        for _ in range(self.substeps):
            self.forward()
            sight = np.concatenate([self.state.reshape(seen.shape), self.qacc])
            self.move(seconds / self.substeps)(sight, seen)
            self.state[...] = seen.reshape(self.state.shape)


class MujocoEngine:
    """One simulation in one MjData, which a viewer can show; inputs are held by MuJoCo's ctrl."""

    def __init__(
        self, scene: Scene, T: float, integrator: str = "RK4", substeps: int = 4, timing: Timing | None = None
    ) -> None:
        import mujoco

        self.model = discretised(scene, T, integrator, substeps)
        self.data = mujoco.MjData(self.model)
        self._warnings = self.data.warning.number
        self.advance: Callable[[int], None]  # from `start` on
        self.stretch: _Stretch | None = None
        moves = cache(lambda h: _rosenbrock(_rates(scene, None), h)[0])
        self._whole = moves if integrator == EXPONENTIAL and substeps == 1 else None
        self._timing, both, q, v = timing, (self.model, self.data), self.data.qpos, self.data.qvel
        self._access = _Access(
            T,
            substeps,
            self.data.ctrl,
            # one view of both, wherever MuJoCo has put them: one copy reads them
            as_strided(q, (2, q.size), (v.ctypes.data - q.ctypes.data, q.itemsize)),
            self.data.qacc,
            partial(mujoco.mj_forward, *both),
            partial(mujoco.mj_step, *both),
            partial(setattr, self.model.opt, "timestep"),
            (lambda h: moves(h).dot) if integrator == EXPONENTIAL else None,
        )
        # what rubs is solved from the solution before, which nothing takes back
        self._rubs = default_integrator(scene) != EXPONENTIAL

    def start(self, buffer: StepBuffer) -> None:
        self._buffer, self.stretch, access = buffer, None, self._access
        access.put(buffer, 0)
        self.advance = access.ticks(buffer, self._timing)
        if buffer.calm and not self._timing and not (self._rubs and buffer.process.limiter):
            if self._whole:
                self.stretch = self._fused(buffer, self._whole(access.T))
            elif not access.move:
                self.stretch = self._stepped(buffer)

    def _fused(self, buffer: StepBuffer, move: Array) -> _Stretch:
        access, further = self._access, len(self._access.qacc)
        none = np.zeros((len(move), buffer.process.F.order))
        fused = _Fused(buffer, np.hstack([move[:, :-further], none, move[:, -further:]]), further)
        ctrl, state, qacc, forward = access.ctrl, access.state, access.qacc, access.forward
        product, held, before, after, rates = fused.product, fused.held, fused.before, fused.next, fused.further
        shaped = list(fused.states.reshape(-1, *state.shape))

        def stretch(ticks: int) -> None:
            fused.begin(ticks)
            for inputs, rate, now, then, moved in zip(held[:ticks], rates, before, after, shaped, strict=False):
                ctrl[...] = inputs
                forward()
                rate[...] = qacc
                product(now, then)
                state[...] = moved
            fused.end(ticks)

        return stretch

    def _stepped(self, buffer: StepBuffer) -> _Stretch:
        access = self._access
        ctrl, state, step, count = access.ctrl, access.state, access.step, access.substeps
        rows, law, m = buffer.rows[:, :, 0], buffer.process.linear.dot, buffer.process.channels
        states = list(buffer.s[1:, :, 0].reshape(-1, *state.shape))
        before, after = list(rows[:, : buffer.z.shape[1] + m]), list(buffer.after[:, :, 0])
        inputs = list(rows[:, -len(ctrl) :])

        def stretch(ticks: int) -> None:
            for now, then, held, moved in zip(before, after[:ticks], inputs, states, strict=False):
                law(now, then)
                ctrl[...] = held
                step(count)
                moved[...] = state

        return stretch

    def back(self, k: int) -> None:
        """Put the plant into the state of row k; what was warned of since does not count."""
        self._access.put(self._buffer, k)
        self._warnings[:] = 0

    def troubled(self) -> bool:
        return bool(self._warnings.any())


class MujocoBatchEngine:
    """All simulations of a buffer in one mujoco.batch.Batch.

    Steps are those of MujocoEngine for each one, bit for bit; the exponential integrator's products are summed in
    another order, so they differ by rounding.
    """

    def __init__(
        self,
        scene: Scene,
        T: float,
        integrator: str = "RK4",
        substeps: int = 4,
        nsim: int = 1,
        nthread: int = 0,
        fields: Mapping[str, Array] | None = None,
        timing: Timing | None = None,
    ) -> None:
        """`fields` gives fields of the model a row per simulation, such as masses: (nsim, ...)."""
        import mujoco
        from mujoco.batch import Batch

        model = discretised(scene, T, integrator, substeps)
        self.batch = batch = Batch(model, nsim, nthread)
        for name, rows in (fields or {}).items():
            batch.expand(name)[...] = rows
        if fields:
            batch.set_const()
        parts, before = mujoco.mjtState, int(mujoco.mjtState.mjSTATE_TIME)
        moved = before | int(parts.mjSTATE_QPOS) | int(parts.mjSTATE_QVEL)
        time, motion = (mujoco.mj_stateSize(model, part) for part in (before, moved))

        def move(h: float) -> _Product:
            moves = _rosenbrock(_rates(scene, fields), h)
            return _each_by_its_own(moves) if fields else moves[0].dot

        self.advance: Callable[[int], None]  # from `start` on
        self._timing = timing
        self._access = _Access(
            T,
            substeps,
            batch.bind("ctrl").T,
            batch.state[:, time:motion].T,  # position and velocity lie side by side in a state row
            batch.bind("qacc").T,
            batch.forward,
            lambda count: batch.step(nstep=count),
            batch.expand("opt.timestep").fill if timing else float,
            cache(move) if integrator == EXPONENTIAL else None,
        )

    def start(self, buffer: StepBuffer) -> None:
        self._access.put(buffer, 0)
        self.advance = self._access.ticks(buffer, self._timing)

    def troubled(self) -> bool:
        return bool(np.any(self.batch.warning))


def _rates(scene: Scene, fields: Mapping[str, Array] | None) -> Array:
    """J of s' = J s + .., (nsim or 1, 2n, 2n), from the matrices of the compiled model, or of every variant of it."""
    if not fields:
        return plant(scene.model).A[None]
    nsim = len(next(iter(fields.values())))
    same = {name: np.tile(getattr(scene.model, name).astype(float), (nsim, 1)) for name in _MECHANICAL}
    return Variants(scene, {**same, **fields}).plants().A


def _rosenbrock(J: Array, h: float) -> Array:
    """What makes s + h phi1(h J) [v; a] of [q; v; a], (nsim, 2n, 3n), for J (nsim, 2n, 2n) and a step of h seconds.

    phi1(X) = X^-1 (e^X - I) is the upper right block of exp [[X, I], [0, 0]].
    """
    nsim, states, _ = J.shape
    n, unit = states // 2, np.tile(_units(J, h), 2)
    generator = np.zeros((nsim, 2 * states, 2 * states))
    generator[:, :states, :states], generator[:, :states, states:] = h * J, np.eye(states)
    phi = h * _expm_in_units(generator, unit)[:, :states, states:]
    return np.concatenate([np.broadcast_to(np.eye(states, n), (nsim, states, n)), phi + np.eye(states, k=-n)], axis=2)


def discretised(scene: Scene, T: float, integrator: str, substeps: int) -> mujoco.MjModel:
    """A copy of the scene's model that makes `substeps` steps of `integrator` in a period T."""
    import mujoco

    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator is {integrator!r}, allowed are {', '.join(INTEGRATORS)}")
    if substeps < 1:
        raise ValueError(f"substeps is {substeps}, allowed are whole numbers from 1")
    if impeded(scene.model):
        raise InputError("a human has an impedance (A, B, C, D), which MuJoCo does not simulate: use the exact engine")
    model = copy(scene.model)
    model.opt.timestep = T / substeps
    model.opt.integrator = getattr(mujoco.mjtIntegrator, INTEGRATORS[integrator])
    return model


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
    import mujoco

    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


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
