"""Single points of a K-B map, looked at closely: the couplings that were asked about, and how true the map is."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.coupling import Compliance, Coupling, InternalModel, SpringDamper
from controller.delay import delay
from controller.environment import GROUND, Network, Wall, environment, frozen_states
from controller.gains import Gains, Stack, force_maps
from controller.loop import Loop, force_map
from controller.lti import Array, Lti, SingularLoop
from controller.process import Contact, Process, StepBuffer, contact
from design.audit import Subject, edge
from design.certificate import CONDITIONS, theorem4_of
from design.conditions import (
    Condition,
    Requirement,
    any_environment,
    any_environment_delayed,
    refusal,
    this_environment,
)
from design.lmi import Specification, shortage
from design.maps import (
    Environments,
    closed_loop_in_each,
    closed_loop_ratios,
    contact_springs,
    response,
    theorem4_ratios,
)
from design.result import DesignFailed
from models.device import Device, passivity_level
from models.human import Population
from models.scene import Crowd, Scene, variants
from sim.crowds import crowds
from sim.engines import HeldPlant, MujocoBatchEngine, hold, profiler_off, quiet_warnings
from sim.run import run_block
from sim.scenario import InputError
from sim.stability import MARGINAL, close
from sim.stepping import pace
from sim.trace import RUNAWAY, Oscillation, oscillation, slowest_seen

# ----------------------------------------------------------------------------------------------------
# What a K-B map asks of the loop it is about, whatever K and B are gains of.


class MapLoop(Protocol):
    """ground.Ground: K and B of the coupling; surroundings.Surroundings: K and B of the environment."""

    @property
    def devices(self) -> tuple[Device, ...]: ...
    @property
    def population(self) -> Population: ...
    @property
    def network(self) -> Network | None: ...  # None is a rigid wall behind the coupling
    @property
    def walled(self) -> Network | None: ...  # the network whose contact is made and broken, if there is one
    @property
    def T(self) -> float: ...  # [s]
    @property
    def theta(self) -> tuple[int, ...]: ...  # (m,) [samples]
    @property
    def psi(self) -> tuple[int, ...]: ...  # (m,) [samples]
    @property
    def cutoff(self) -> float | None: ...  # [Hz] of the velocity filter
    @property
    def channels(self) -> int: ...
    @property
    def delta(self) -> tuple[float, ...]: ...  # (m,) [N s/m]
    @property
    def usual_scale(self) -> str: ...  # linear | log
    @property
    def stiffness_scale(self) -> float: ...  # [N/m] that the axis is chosen around
    @property
    def conditions(self) -> tuple[str, ...]: ...  # what is asked of every cell
    @property
    def refusals(self) -> dict[str, str]: ...  # conditions that say nothing of any cell, and why

    def gains(self, K: Array, B: Array) -> Gains:
        """n points of the map, (n,) each."""
        ...

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F at every point, for each frozen contact state."""
        ...

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T at point i."""
        ...

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        ...

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The same at one point, by design.margin."""
        ...


# ----------------------------------------------------------------------------------------------------
# The gains that a K-B map is drawn at.


#: what gains may be, as in design.audit: within these, all arithmetic is far from overflow
STIFFNESSES, DAMPINGS = (1e-3, 1e9), (0.0, 1e6)
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Grid:
    """Every K with every B."""

    K: Array  # (n,) [N/m]
    B: Array  # (n,) [N s/m]
    scale: str  # linear | log

    @property
    def shape(self) -> tuple[int, int]:
        return self.K.size, self.B.size

    @property
    def flat(self) -> tuple[Array, Array]:
        """K and B of every point, (n n,): B runs fastest."""
        K, B = np.meshgrid(self.K, self.B, indexing="ij")
        return K.ravel(), B.ravel()

    def subset(self, count: int) -> NDArray[np.intp]:
        """(k,) flat indices of `count` rows and columns at most, evenly spread, with the corners."""
        rows, columns = (np.unique(np.round(np.linspace(0, n - 1, min(count, n))).astype(int)) for n in self.shape)
        return (rows[:, None] * self.shape[1] + columns).ravel()


def make_grid(
    ground: MapLoop, n: int, K: Range | None, B: Range | None, scale: str | None, marks: tuple[Range, ...] = ()
) -> Grid:
    """n x n gains. Ranges that are not given come from the loop, and make room for the marks.

    K is about the loop's stiffness_scale, B about delta, the most that a linear law may damp. A linear map goes up to
    2.5 times these, a logarithmic one from far below to far above. Raises InputError.
    """
    scale = scale or ground.usual_scale
    stiff, most = ground.stiffness_scale, max(ground.delta)
    if scale == "linear":
        wide = (2.5 * stiff / n, 2.5 * stiff), (0.0, 2.5 * most)
    else:
        wide = (stiff / 30, stiff * 30), (most / 100, most * 10)
    of_marks = tuple(zip(*marks, strict=True)) if marks else ((), ())
    ends = []
    for name, given, usual, allowed, marked in zip("KB", (K, B), wide, (STIFFNESSES, DAMPINGS), of_marks, strict=True):
        low, high = given or _with_room(usual, marked)
        _check(name, low, high, allowed, scale)
        for mark in marked:
            if given and not low <= mark <= high:
                raise InputError(f"--mark has {name} = {mark:g}, outside --{name}-range {low:g},{high:g}")
        ends.append((low, high))
    spread = np.linspace if scale == "linear" else np.geomspace
    along_K, along_B = (spread(low, high, n) for low, high in ends)
    return Grid(along_K, along_B, scale)


def _with_room(usual: Range, marked: Sequence[float]) -> Range:
    """The range, widened so that marks lie well inside; a mark at 0 stays on the edge of a logarithmic map."""
    low, high = usual
    return min([low, *(mark / 1.1 for mark in marked if mark > 0)]), max([high, *(1.1 * mark for mark in marked)])


def _check(name: str, low: float, high: float, allowed: Range, scale: str) -> None:
    option, unit = f"--{name}-range", "N/m" if name == "K" else "N s/m"
    if not (allowed[0] <= low and high <= allowed[1]):
        raise InputError(f"{option} is {low:g},{high:g}, allowed are {allowed[0]:g} to {allowed[1]:g} {unit}")
    if not low < high:
        raise InputError(f"{option} is {low:g},{high:g}, expected the lower end first")
    if scale == "log" and low == 0:
        raise InputError(f"{option} begins at 0, which a logarithmic map cannot show; use --scale linear")


# ----------------------------------------------------------------------------------------------------
# Many independent cells of a map, a slice at a time on all cores: NumPy's kernels leave Python to other threads.


Part = TypeVar("Part")
Progress = Callable[[int, int], None]


def in_slices(
    task: Callable[[slice], Part], count: int, size: int, progress: Progress = lambda done, total: None
) -> tuple[list[tuple[slice, Part]], bool]:
    """task(slice) for slices of `size` that cover range(count), and whether the keyboard ended it before the last.

    What was finished by then is returned.
    """
    done: list[tuple[slice, Part]] = []
    pool = ThreadPoolExecutor(_cores())
    futures = {pool.submit(task, part): part for part in _slices(count, size)}
    waiting, finished = set(futures), 0
    try:
        while waiting:
            ready, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in ready:
                done.append((futures[future], future.result()))
                finished += min(size, count - futures[future].start)
            progress(finished, count)
    except KeyboardInterrupt:
        return done, True
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return done, False


def _slices(count: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# ----------------------------------------------------------------------------------------------------
# Which gains are stable with every human of a population: the exact loop's eigenvalues over humans x gains.


#: slower modes [Hz] decay so little that they would hide an oscillation that is about to grow
AUDIBLE = 2.0
LEADING = 0.1  # share of the humans that meet every coupling; the rest meet those that are stable with them


@dataclass(frozen=True, eq=False)
class Holders:
    """The devices in the hands of every human, sampled; in groups of humans with the same number of links."""

    #: (index of each human, who, plant, positions of motors and handles in its state)
    groups: tuple[tuple[NDArray[np.intp], Crowd, HeldPlant, tuple[int, ...]], ...]

    def __len__(self) -> int:
        return sum(index.size for index, *_ in self.groups)

    def links(self, human: int) -> Array:
        """(m, links, 3) of one human, as in Crowd."""
        for index, crowd, *_ in self.groups:
            if human in index:
                return crowd.links[int(np.flatnonzero(index == human)[0])]
        raise IndexError(f"human {human} of {len(self)}")

    def growth(self, F: Lti, humans: NDArray[np.bool_] | None = None, audible: float = AUDIBLE) -> tuple[Array, Array]:
        """Growth [1/s] of the dominant mode and of the dominant one above `audible` [Hz], with every human (n,).

        Where `humans` (n,) is false nothing is computed, and the answer is -inf.
        """
        n = len(self)
        everything, heard = np.full((2, n), -np.inf)
        for index, _, plants, _ in self.groups:
            chosen = np.ones(index.size, dtype=bool) if humans is None else humans[index]
            if not chosen.any():
                continue
            some = HeldPlant(plants.A[chosen], plants.B[chosen], plants.C, plants.T)
            values = np.linalg.eigvals(close(some, F).A)
            size = np.abs(values)
            turning = np.abs(np.angle(values)) >= 2 * np.pi * audible * plants.T
            with np.errstate(divide="ignore"):
                everything[index[chosen]] = np.log(size.max(axis=1)) / plants.T
                heard[index[chosen]] = np.log(np.where(turning, size, 0.0).max(axis=1)) / plants.T
        return everything, heard

    def mode(self, F: Lti, human: int, audible: float) -> Array:
        """The dominant mode above `audible` [Hz] with one human, as a state [s; z]: the motor or handle that moves most
        moves by 1 m."""
        index, _, plants, seen = next(group for group in self.groups if human in group[0])
        i = int(np.flatnonzero(index == human)[0])
        values, vectors = np.linalg.eig(close(HeldPlant(plants.A[i], plants.B[i], plants.C, plants.T), F).A)
        turning = np.abs(np.angle(values)) >= 2 * np.pi * audible * plants.T
        vector = vectors[:, np.argmax(np.where(turning, np.abs(values), 0.0))]
        positions = vector[list(seen)]
        return (vector / positions[np.argmax(np.abs(positions))]).real

    def leading(self, some: Sequence[Lti]) -> NDArray[np.bool_]:
        """The tenth (8 at least) of the humans that are unstable with most of these couplings, then nearest to it."""
        growths = np.array([self.growth(F)[1] for F in some])
        score = (growths > 0).sum(axis=0) + np.clip(growths, -100, 100).mean(axis=0) / 1000
        first = np.zeros(len(self), dtype=bool)
        first[np.argsort(-score, kind="stable")[: max(8, round(LEADING * len(self)))]] = True
        return first


def holders(devices: Sequence[Device], population: Population, seed: int, humans: int, links: int, T: float) -> Holders:
    """Random humans with the devices in their hands."""
    groups = []
    for index, crowd in crowds(population, len(devices), seed, range(humans), links):
        held_by = variants(devices, crowd)
        groups.append((index, crowd, hold(held_by.plants(), T), motors_and_handles(held_by.scene)))
    return Holders(tuple(groups))


def motors_and_handles(scene: Scene) -> tuple[int, ...]:
    """Their positions in a plant state; of a rigid device they are one."""
    return tuple(dict.fromkeys((*range(scene.channels), *scene.handles)))


# ----------------------------------------------------------------------------------------------------
# A tape whose simulations have a process each: points of a map, stepped in one batch of an engine.


Transition = Callable[[Array, Array], object]  # [z; x] (order + m, nsim) -> writes [f; z+] (m + order, nsim)


class ManyProcesses(StepBuffer):
    """All processes have the same order, number of walls, force limits and encoder steps."""

    def __init__(self, processes: Sequence[Process], ticks: int, plant_states: int, outside: int) -> None:
        super().__init__(processes[0], ticks, plant_states, outside, len(processes))
        walls = len(processes[0].contact.walls) if processes[0].contact else 0
        self._together = _linear(processes) if walls == 0 else _one_wall(processes) if walls == 1 else _each(processes)

    def tick(self, k: int) -> None:
        self._together(self.seen(k), self._output[k])


def _linear(processes: Sequence[Process]) -> Transition:
    blocks = _last_axis([np.block([[p.F.C, p.F.D], [p.F.A, p.F.B]]) for p in processes])
    return lambda before, after: np.einsum("oin,in->on", blocks, before, out=after)


def _one_wall(processes: Sequence[Process]) -> Transition:
    """Contact.transition for one wall each, whose complementarity problem is p = max(0, q)/M."""
    contacts = [p.contact for p in processes if p.contact]
    m, order = contacts[0].channels, contacts[0].block.order
    linear = _linear(processes)
    reach = _last_axis([np.concatenate([c.block.C[m], [0.0], c.block.D[m, :m]]) for c in contacts])
    kick = _last_axis([np.concatenate([c.block.D[:m, m], c.block.B[:, m], [0.0]]) for c in contacts])
    give, M = np.array([c.block.D[m, m] for c in contacts]), np.array([c.problem.M[0, 0] for c in contacts])
    gap, damping = (np.array([getattr(c.walls[0], name) for c in contacts]) for name in ("gap", "damping"))
    memory = damping / contacts[0].block.T / np.array([c.steepness[0] for c in contacts])

    def together(before: Array, after: Array) -> None:
        way = np.einsum("in,in->n", reach, before) - gap
        force = np.maximum(way - memory * before[order], 0.0) / M
        linear(before, after)
        after += kick * force
        after[-1] = np.maximum(way + give * force, 0.0)

    return together


def _each(processes: Sequence[Process]) -> Transition:
    transitions = [process.transition() for process in processes]

    def together(before: Array, after: Array) -> None:
        column = np.empty((after.shape[0], 1))
        for i, transition in enumerate(transitions):
            transition(np.ascontiguousarray(before[:, i : i + 1]), column)
            after[:, i : i + 1] = column

    return together


def _last_axis(parts: Sequence[Array]) -> Array:
    return np.ascontiguousarray(np.moveaxis(np.array(parts), 0, -1))


# ----------------------------------------------------------------------------------------------------
# Points of a K-B map simulated in MuJoCo, with the effects that no theory covers switched on.
#
# The human that is nearest to oscillating at a point, by the exact linear loop, holds the devices. The loop starts on
# that mode, so far out that Coulomb friction does not hold it; the hand presses with a constant force, eased in; and
# what still oscillates at the end decides: see oscillation.py. Many points, each with its process, are one MuJoCo
# batch.


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
            run_block(tape, engine, count)
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


# ----------------------------------------------------------------------------------------------------
# The loop that a K-B map is about: everything but the gains, and what is asked of it at many gains or at one.


#: a one-sided wall behind the coupling is this stiff [N/m], which makes K too soft by K / 1e10
HARD_WALL = Network(("tip",), walls=(Wall(("tip", GROUND), stiffness=1e10),))


@dataclass(frozen=True, eq=False)
class Ground:
    """Devices, environment and delays. Raises ValueError naming the field that is wrong."""

    devices: tuple[Device, ...]  # (m,)
    population: Population
    network: Network | None  # None is a rigid wall behind the coupling, one channel
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]
    cutoff: float | None = None  # [Hz] of a filter on the velocity that the coupling damps
    one_sided: bool = False  # whether a rigid wall only pushes; the walls of a network do in any case

    def __post_init__(self) -> None:
        _ = self._subject  # its checks are ours

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    @property
    def walled(self) -> Network | None:
        """The network whose contact is made and broken in the simulated loop, if there is one."""
        if self.network is None:
            return HARD_WALL if self.one_sided else None
        return self.network if self.network.walls else None

    @property
    def usual_scale(self) -> str:
        """Against a rigid wall couplings are all of one size; against an environment far stiffer ones can be safe."""
        return "linear" if self.network is None else "log"

    @property
    def stiffness_scale(self) -> float:
        """[N/m] 2 delta/((theta + 1) T): the stiffest that a linear law may be against every passive environment."""
        return max(2 * d / ((n + 1) * self.T) for d, n in zip(self.delta, self.theta, strict=True))

    @property
    def conditions(self) -> tuple[str, ...]:
        return CONDITIONS

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        reason = self.multiplier[1]
        return {"theorem4": reason} if reason else {}

    @cached_property
    def environments(self) -> tuple[Lti | None, ...]:
        """The linear environments of every frozen contact state, all walls touching first; None is a rigid wall.

        Off a rigid wall the device is free, which is safe by itself.
        """
        if self.network is None:
            return (None,)
        return tuple(environment(state, self.T) for state in reversed(list(frozen_states(self.network).values())))

    def gains(self, K: Array, B: Array) -> Gains:
        """Couplings with these gains on every channel, (n,) each."""
        return Gains(K, B, self.T, self.cutoff)

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F of every coupling, for each of `environments`."""
        return tuple(force_maps(gains, E, self.theta, self.psi) for E in self.environments)

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T with coupling i; limits and encoder steps are those of `devices`."""
        limits = np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])
        if self.walled is None:
            return Process(self.force_maps(gains.take([i]))[0][0], *limits)
        walls: Contact = contact(self.walled, gains.compliance(i, self.channels), self.theta, self.psi, self.T)
        return Process(walls.open, *limits, walls)

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough. Of walls, in the worst state."""
        if condition == "closed-loop":
            states = [closed_loop_ratios(gains, E, self.theta, self.psi, self.delta) for E in self.environments]
            return np.max(states, axis=0)
        phi, reason = self.multiplier
        if reason:
            return np.full(len(gains), np.inf)
        return theorem4_ratios(gains, self.theta, self.delta, phi)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The same for one coupling by design.margin, which a map is checked against."""
        if self.cutoff is None and (condition == "closed-loop" or not any(self.psi)):
            asked: Condition = "closed-loop" if condition == "closed-loop" else "theorem4"
            return self._subject.with_gains([K] * self.channels, [B] * self.channels).requirement(asked)
        gains = self.gains(np.array([K]), np.array([B]))
        if condition == "closed-loop":
            states = [this_environment(stack[0], self.delta) for stack in self.force_maps(gains)]
            return max(states, key=lambda requirement: requirement.ratio)
        phi, reason = self.multiplier
        if reason:
            return refusal("theorem4", self.delta, reason)
        V = gains.compliance(0, self.channels).V
        if phi is None:
            return any_environment(V, self.theta, self.delta)
        E = self.environments[0]
        assert E is not None
        return any_environment_delayed(V, E, self.theta, self.psi, self.delta, phi)

    @cached_property
    def multiplier(self) -> tuple[Array | None, str | None]:
        """Phi of Theorem 4 [N s/m], (m,), which only delay in the environment needs; or why there is none."""
        if not any(self.psi) or self.network is None:
            return None, None
        if self.network.walls:
            return None, "with delay in the environment its multiplier is of a linear one: no walls"
        E = environment(self.network, self.T)
        try:
            return shortage(Specification(E, self.theta, self.psi, self.theta, self.delta)), None
        except (ValueError, DesignFailed) as error:
            return None, " ".join(str(error).split())

    @property
    def _subject(self) -> Subject:
        coupling = SpringDamper([1.0] * self.channels, [0.0] * self.channels)
        return Subject(coupling, self.network, self.T, self.theta, self.psi, self.delta)


def one_sided(network: Network) -> Network:
    """The network whose contacts only push: every spring at a contact becomes a wall, in the direction it is given in.

    Raises ValueError where the contacts have no springs.
    """
    at_contact = [s for s in network.springs if set(s.between) & set(network.contacts) and s.stiffness > 0]
    if not at_contact:
        raise ValueError("no spring ends at a contact, so there is nothing to make one-sided")
    kept = tuple(spring for spring in network.springs if spring not in at_contact)
    walls = tuple(Wall(s.between, s.stiffness, s.damping) for s in at_contact)
    return Network(network.contacts, kept, network.masses, (*network.walls, *walls))


def press_directions(network: Network | None, channels: int) -> Array:
    """(m,) +1 or -1: into the walls where contacts have some, else alternately."""
    directions = (-1.0) ** np.arange(channels)
    for i, name in enumerate(network.contacts if network else ()):
        for wall in network.walls if network else ():
            if name in wall.between:
                directions[i] = 1.0 if wall.between[0] == name else -1.0
    return directions


# ----------------------------------------------------------------------------------------------------
# A K-B map whose axes are the environment's: one coupling, fixed, and every contact spring with the same K and B.
#
# A spring-damper coupling has K and B of its own, and sim.zwidth.ground draws the map over them. Every other coupling
# is designed once, for the scenario's environment (or its box), and the map asks in which environments it stays safe.
# An optimal coupling is the pair of a fixed Q and a model of the environment, and two things may happen when that
# changes:
#
#     closed-loop   the model is the environment of the cell: F = Theta (Psi E - Psi E Q Psi E), as with a box
#     model kept    nobody tells the coupling: V = Q (I - Psi E0 Q)^-1 of the scenario's E0 faces E
#
# A coupling of each cell's own would be certified everywhere, since Q near E^-1 turns the force off: such a map would
# be of mismatch, which design.limits draws.


MODEL_KEPT = "model kept"


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Devices, delays and a coupling; the environment is `network` with other springs at its contacts.

    Raises ValueError where the network has no spring at a contact, or walls.
    """

    devices: tuple[Device, ...]  # (m,)
    population: Population
    network: Network  # the scenario's, which the coupling was designed for
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]
    coupling: Coupling
    cutoff: None = None  # the velocity filter belongs to the spring-damper of the other map
    walled: None = None

    def __post_init__(self) -> None:
        if self.network.walls:
            raise ValueError("environment.walls: with --coupling the map is over linear environments; take them out")
        if not contact_springs(self.network):
            raise ValueError("environment: no spring or damper ends at a contact, so there is no K and B to vary")

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    @property
    def stiffness_scale(self) -> float:
        """What the middle of the map is about [N/m]: the geometric mean of these springs."""
        stiff = [s.stiffness for s in contact_springs(self.network) if s.stiffness > 0]
        return float(np.exp(np.mean(np.log(stiff)))) if stiff else 1000.0

    @property
    def usual_scale(self) -> str:
        return "log"

    @property
    def conditions(self) -> tuple[str, ...]:
        """What is asked of every cell."""
        kept = (MODEL_KEPT,) if isinstance(self.coupling, InternalModel) else ()
        return ("theorem4", "closed-loop", *kept)

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        if any(self.psi):
            why = "with delay in the environment it takes a multiplier for each: ask design.audit about single ones"
            return {"theorem4": why}
        reason = self._any_environment.reason
        return {"theorem4": reason} if reason else {}

    def gains(self, K: Array, B: Array) -> Gains:
        """Environments with these springs at every contact, (n,) each."""
        return Gains(K, B, self.T)

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F in every environment, the coupling's model following it."""
        around = self._environments(gains)
        maps = [self._force_map(self.coupling, around[i]) for i in range(len(around))]
        order = max(F.order for F in maps)  # without damping or stiffness an environment may have fewer states
        A, B, C, D = zip(*(_padded(F, order) for F in maps), strict=True)
        return (Stack(np.stack(A), np.stack(B), np.stack(C), np.stack(D), self.T),)

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T in environment i; limits and encoder steps are those of `devices`."""
        limits = np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])
        return Process(self.force_maps(gains.take([i]))[0][0], *limits)

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        if condition == "theorem4":
            return np.full(len(gains), self._any_environment.ratio)
        around, coupling = self._environments(gains), self._kept if condition == MODEL_KEPT else self.coupling
        each = [self._force_map(coupling, around[i]).poles() for i in range(len(around))]
        most = max(poles.size for poles in each)
        poles = np.stack([np.pad(p, (0, most - p.size)) for p in each])
        return closed_loop_in_each(around, response(coupling, self.T), poles, self.theta, self.psi, self.delta)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The damping that the condition asks of the devices in one environment, by design.margin."""
        if condition == "theorem4":
            return self._any_environment
        coupling = self._kept if condition == MODEL_KEPT else self.coupling
        try:
            E = self._environments(self.gains(np.array([K]), np.array([B])))[0]
            return this_environment(self._force_map(coupling, E), self.delta)
        except SingularLoop as error:
            return refusal("closed-loop", self.delta, str(error))

    @cached_property
    def _any_environment(self) -> Requirement:
        """theorem4's requirement, which no spring of the environment changes."""
        if any(self.psi):
            return refusal("theorem4", self.delta, "not asked")
        return theorem4_of(Loop(self.T, self.theta, self.psi, self.theta, self.delta, self.network), self.coupling)

    @cached_property
    def _kept(self) -> Coupling:
        """V of an optimal coupling whose model stays that of the scenario's environment."""
        assert isinstance(self.coupling, InternalModel)
        model = delay(self.psi, self.T) @ environment(self.network, self.T)
        return Compliance(self.coupling.parameter(self.T).feedback(-model))

    def _environments(self, gains: Gains) -> Environments:
        return Environments(self.network, gains.K, gains.B, self.T)

    def _force_map(self, coupling: Coupling, E: Lti) -> Lti:
        return force_map(E, coupling, self.theta, self.psi)


def _padded(F: Lti, order: int) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D with states that are always zero."""
    more = order - F.order
    A = np.pad(F.A, ((0, more), (0, more)))
    return A, np.pad(F.B, ((0, more), (0, 0))), np.pad(F.C, ((0, 0), (0, more))), F.D


# ----------------------------------------------------------------------------------------------------
# Points of a K-B map in MuJoCo, each with the humans whose linear loop is the worst: do they go on oscillating?


UNLIMITED = 1e6  # [N] force limit of a motor that does not saturate: the largest that a device may have
BATCH = 20  # simulations in one MuJoCo batch
DECIDED = 0.2  # [1/s] linear growth nearer to zero than this does not show within a trace
UNDECIDED = "too slow to say"  # verdict where the trace goes on oscillating as the linear loop would, decaying or not


@dataclass(frozen=True)
class Effects:
    """What the simulated points have beside the linear loop. None leaves what the devices of the scenario have."""

    quantisation: float | None = None  # [m] encoder step
    friction: float | None = None  # [N] Coulomb friction at each motor
    saturation: bool = False  # whether motors have their force limits

    def on(self, devices: Sequence[Device]) -> tuple[Device, ...]:
        changes: dict[str, float] = {} if self.saturation else {"force_limit": UNLIMITED}
        if self.quantisation is not None:
            changes["encoder_step"] = self.quantisation
        if self.friction is not None:
            changes["friction"] = self.friction
        return tuple(msgspec.structs.replace(device, **changes) for device in devices)

    def nonlinear(self, devices: Sequence[Device]) -> bool:
        """Whether the devices make the simulated loop another one than the linear one."""
        return self.saturation or any(device.encoder_step or device.friction for device in self.on(devices))


@dataclass(frozen=True)
class Plan:
    """How points are simulated."""

    effects: Effects
    points: int  # rows and columns of the grid that are simulated; 0 for none
    trials: int  # humans at each point
    start: float  # [m] displacement of the motor or handle that moves most, at the start
    press: float  # [N]
    duration: float  # [s]
    threshold: float  # [m] amplitude above which a handle oscillates

    @property
    def runaway_growth(self) -> float:
        """[1/s] A mode that grows faster has diverged by the end of the trace, whether it swings or not."""
        return 1.2 * np.log(RUNAWAY / self.start) / self.duration


@dataclass(frozen=True, eq=False)
class Points:
    """The simulated points, (k,) each."""

    cell: NDArray[np.intp]  # flat index in the grid
    oscillates: NDArray[np.bool_]  # to the end of the trace, with any of the humans that were tried
    amplitude: Array  # [m] the largest among them that decided; inf: diverged
    frequency_hz: Array  # [Hz] of it; nan: diverged
    growth: Array  # [1/s] of the exact loop's dominant mode, audible or running away, with the worst of these humans

    @property
    def near(self) -> NDArray[np.bool_]:
        """Whether the linear loop neither grows nor decays enough to be told from a limit cycle."""
        return np.abs(self.growth) <= DECIDED

    @property
    def differ(self) -> NDArray[np.bool_]:
        """Whether MuJoCo does what the linear loop clearly does not."""
        return ~self.near & ((self.growth > 0) != self.oscillates)

    @property
    def verdicts(self) -> list[str]:
        """Each one "rests", "oscillates" or UNDECIDED."""
        words = np.where(self.oscillates, np.where(self.near, UNDECIDED, "oscillates"), "rests")
        return [str(word) for word in words]


def simulated(
    ground: MapLoop,
    grid: Grid,
    holders: Holders,
    plan: Plan,
    cells: NDArray[np.intp],
    progress: Callable[[int, int], None],
) -> tuple[Points, bool]:
    """The points of these cells, simulated in batches of whole points, and whether the keyboard ended it."""
    parts: list[Points] = []
    size, ticks = max(1, BATCH // plan.trials), round(plan.duration / ground.T)
    try:
        for first in range(0, cells.size, size):
            some = cells[first : first + size]
            trials, growth = _trials(ground, ground.gains(*(axis[some] for axis in grid.flat)), holders, plan)
            seen = 0

            def ticked(count: int, first: int = first) -> None:
                nonlocal seen
                seen += count
                progress(first * ticks + min(seen, ticks) * min(size, cells.size - first), cells.size * ticks)

            parts.append(_points(some, growth, trials, ground, plan, ticked))
    except KeyboardInterrupt:
        return _joined(parts), True
    return _joined(parts), False


def _trials(ground: MapLoop, gains: Gains, holders: Holders, plan: Plan) -> tuple[list[Trial], Array]:
    """The trials of these gains, plan.trials of each in succession, and the growth of the worst of each."""
    audible, stack = slowest_seen(plan.duration), ground.force_maps(gains)[0]
    devices = plan.effects.on(ground.devices)
    trials, growth = [], []
    for i in range(len(gains)):
        whole, audibly = holders.growth(stack[i], audible=audible)
        runs_away = whole > plan.runaway_growth  # without a sound: what pushes outwards at rest
        shown = np.where(runs_away, whole, audibly)
        worst = np.argsort(-shown, kind="stable")[: plan.trials]
        process = ground.process(gains, i, devices)
        for human in worst.tolist():
            mode = holders.mode(stack[i], human, 0.0 if runs_away[human] else audible)
            trials.append(Trial(process, holders.links(human), plan.start * mode))
        growth.append(shown[worst[0]])
    return trials, np.array(growth)


def _points(
    cells: NDArray[np.intp],
    growth: Array,
    trials: list[Trial],
    ground: MapLoop,
    plan: Plan,
    ticked: Callable[[int], None],
) -> Points:
    """Simulate the trials of these cells, plan.trials of each in succession."""
    devices = plan.effects.on(ground.devices)
    press = plan.press * press_directions(ground.walled, ground.channels)
    lasting, amplitude, frequency = np.zeros(len(trials), dtype=bool), np.zeros(len(trials)), np.zeros(len(trials))
    links = np.array([trial.links.shape[1] for trial in trials])
    for count in np.unique(links):
        which = np.flatnonzero(links == count)
        found = simulate_trials([trials[i] for i in which], devices, press, plan.duration, plan.threshold, ticked)
        lasting[which], amplitude[which], frequency[which] = found.sustained, found.amplitude, found.frequency_hz
    shape = (cells.size, -1)
    shown = np.where(lasting, amplitude + 1e9, amplitude).reshape(shape).argmax(axis=1)[:, None]
    pick = lambda values: np.take_along_axis(values.reshape(shape), shown, axis=1)[:, 0]  # noqa: E731
    return Points(cells, np.any(lasting.reshape(shape), axis=1), pick(amplitude), pick(frequency), growth)


def _joined(parts: Sequence[Points]) -> Points:
    if not parts:
        return no_points()
    names = Points.__dataclass_fields__
    return Points(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def no_points() -> Points:
    """Where none is simulated."""
    return Points(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), *np.zeros((3, 0)))


# ----------------------------------------------------------------------------------------------------
# A K-B map: both certificates and the population over the whole grid, MuJoCo at a sparse part of it.


SLICE, SAMPLE = 60, 25  # cells in one pass of a condition; cells that tell which humans are the leading ones

Progress_map = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True, eq=False)
class Map:
    """Over the grid, (cells,) each, B running fastest; nan where the keyboard came first."""

    grid: Grid
    ratio: dict[str, Array]  # condition -> required over available damping
    growth: Array  # [1/s] worst over the humans that were tried: all of them where none is unstable
    unstable: Array  # humans that make the cell unstable, at least
    points: Points
    seconds: dict[str, float]  # of each stage
    interrupted: bool


def draw_map(ground: MapLoop, grid: Grid, holders: Holders, plan: Plan, progress: Progress_map) -> Map:
    """All stages; Ctrl-C keeps what is done."""
    gains = ground.gains(*grid.flat)
    seconds, n = {}, len(gains)
    ratio: dict[str, Array] = {name: np.full(n, np.nan) for name in ground.conditions}
    growth, unstable = np.full((2, n), np.nan)
    points, stopped = no_points(), False

    def ratios(part: slice) -> tuple[Array, ...]:
        return tuple(ground.ratios(name, gains.take(part)) for name in ground.conditions)

    def population(part: slice) -> tuple[float, int]:
        return _population(holders, [stack[part.start] for stack in stacks], leading)

    begin = time.perf_counter()
    _ = ground.refusals  # once, before threads ask for it
    done, stopped = in_slices(ratios, n, SLICE, lambda k, of: progress("certificates", k, of))
    for part, values in done:
        for name, value in zip(ground.conditions, values, strict=True):
            ratio[name][part] = value
    seconds["certificates"] = time.perf_counter() - begin
    if not stopped:
        begin = time.perf_counter()
        stacks = ground.force_maps(gains)
        sample = np.unique(np.linspace(0, n - 1, min(SAMPLE, n)).astype(int))
        leading = holders.leading([stacks[0][i] for i in sample])
        done, stopped = in_slices(population, n, 1, lambda k, of: progress("population", k, of))
        for part, values in done:
            growth[part], unstable[part] = values
        seconds["population"] = time.perf_counter() - begin
    if not stopped and plan.points:
        begin = time.perf_counter()
        cells = grid.subset(plan.points)
        points, stopped = simulated(ground, grid, holders, plan, cells, lambda k, of: progress("MuJoCo", k, of))
        seconds["simulation"] = time.perf_counter() - begin
    return Map(grid, ratio, growth, unstable, points, seconds, stopped)


def _population(holders: Holders, states: Sequence[Lti], leading: NDArray[np.bool_]) -> tuple[float, int]:
    """Worst growth and number of unstable humans among the leading ones, or, if none of these, among all.

    `states` are the force maps of one cell; a human is unstable if it is with any of them.
    """
    growth = np.max([holders.growth(F, leading)[0] for F in states], axis=0)
    if not (growth > MARGINAL).any() and not leading.all():
        rest = np.max([holders.growth(F, ~leading)[0] for F in states], axis=0)
        growth = np.maximum(growth, rest)
    return float(growth.max()), int((growth > MARGINAL).sum())


COLUMNS = 4  # of the map, at which its edge is compared with a bisection on design.margin
STEPS = 48  # stiffnesses tried between the softest of the map and the stiffest, to find where safety ends
HALVINGS = 20  # an edge of the population is found to a relative 1e-6


@dataclass(frozen=True)
class Mark:
    """One coupling, and the stiffest at the same B; None where none is safe, inf where all that were tried are."""

    K: float
    B: float
    requirement: dict[str, Requirement]
    growth: float  # [1/s] worst over the population
    unstable: int  # humans
    stiffest: dict[str, float | None]  # by condition, and "population"


@dataclass(frozen=True)
class Truth:
    """How far the map is from design.margin, over the columns that were compared."""

    ratio: float  # largest relative error of the figure beside the edge
    edge: float  # largest relative error in K of the edge, interpolated between two rows
    columns: int


def look(ground: MapLoop, holders: Holders, K: float, B: float, grid_K: Array) -> Mark:
    """The coupling (K, B) on every channel."""
    gains = ground.gains(np.array([K]), np.array([B]))
    growth = _growth(ground, holders, K, B)
    tried = np.geomspace(min(grid_K[0], K), max(grid_K[-1], K), STEPS)
    row = ground.gains(tried, np.full(STEPS, gains.B[0]))
    stiffest: dict[str, float | None] = {}
    for name in ground.conditions:
        safe = ground.ratios(name, row) < 1
        stiffest[name] = _last(tried, safe, lambda low, high, name=name: _edge(ground, name, low, high, B))
    calm = np.array([(_growth(ground, holders, k, B) <= MARGINAL).all() for k in tried])
    stiffest["population"] = _last(tried, calm, lambda low, high: _bisected(ground, holders, low, high, B))
    requirement = {name: ground.requirement(name, K, B) for name in ground.conditions}
    return Mark(K, B, requirement, float(growth.max()), int((growth > MARGINAL).sum()), stiffest)


def truth(ground: MapLoop, drawn: Map, condition: str) -> Truth | None:
    """Columns of the map that cross the edge, evenly chosen; None where there is none."""
    grid, ratio = drawn.grid, drawn.ratio[condition].reshape(drawn.grid.shape)
    inside = ratio < 1
    crossing = inside[:-1] & ~inside[1:] & np.isfinite(ratio[1:])
    columns = np.flatnonzero(crossing.any(axis=0))
    if not columns.size:
        return None
    chosen = np.unique(columns[np.round(np.linspace(0, columns.size - 1, COLUMNS)).astype(int)])
    ratio_errors, edge_errors = [], []
    for column in chosen:
        B, k = float(grid.B[column]), int(np.flatnonzero(crossing[:, column])[-1])
        for row in (k, k + 1):
            true = ground.requirement(condition, float(grid.K[row]), B).ratio
            ratio_errors.append(abs(ratio[row, column] / true - 1))
        true_edge = _edge(ground, condition, float(grid.K[k]), float(grid.K[k + 1]), B)
        edge_errors.append(abs(_interpolated(grid.K, ratio[:, column], k, grid.scale) / true_edge - 1))
    return Truth(max(ratio_errors), max(edge_errors), chosen.size)


def _interpolated(K: Array, ratio: Array, k: int, scale: str) -> float:
    share = (1 - ratio[k]) / (ratio[k + 1] - ratio[k])
    if scale == "log":
        return float(K[k] * (K[k + 1] / K[k]) ** share)
    return float(K[k] + share * (K[k + 1] - K[k]))


def _edge(ground: MapLoop, condition: str, low: float, high: float, B: float) -> float:
    return edge(lambda K: ground.requirement(condition, K, B).ratio, low, high)


def _growth(ground: MapLoop, holders: Holders, K: float, B: float) -> Array:
    """Of every human, in the worst contact state."""
    states = ground.force_maps(ground.gains(np.array([K]), np.array([B])))
    return np.max([holders.growth(stack[0])[0] for stack in states], axis=0)


def _bisected(ground: MapLoop, holders: Holders, low: float, high: float, B: float) -> float:
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if (_growth(ground, holders, middle, B) <= MARGINAL).all():
            low = middle
        else:
            high = middle
    return low


def _last(tried: Array, safe: NDArray[np.bool_], between: Callable[[float, float], float]) -> float | None:
    """Where safety ends for the last time; inf where it does not, None where nothing is safe."""
    if not safe.any():
        return None
    last = int(np.flatnonzero(safe)[-1])
    return np.inf if last == tried.size - 1 else between(float(tried[last]), float(tried[last + 1]))


if __name__ == "__main__":
    from cli.main import door

    door("zwidth")
