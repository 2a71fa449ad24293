"""Z-width maps: which K and B of a plane are safe - certified, with random humans, and simulated.

What K and B are is decided by the sweep. With `CouplingSweep` they are the gains of a spring-damper coupling, the same
on every channel, in one environment or against a rigid wall. With `EnvironmentSweep` the coupling is fixed, and they
are those of every spring at a contact of the environment. A map asks of each cell both conditions (design.conditions,
for a whole row of cells at once), the eigenvalues of the exact loop with every human of a population, and, at a sparse
part of the cells, MuJoCo with the effects that no theory covers.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.coupling import Compliance, Coupling, InternalModel, SpringDamper
from controller.delay import delay
from controller.environment import (
    GROUND,
    Matrices,
    Network,
    Spring,
    Wall,
    environment,
    environment_of,
    frozen_states,
    sampled_environment,
)
from controller.loop import Loop, force_map
from controller.lti import Array, Complex, Lti, Sampled, SingularLoop, as_like
from controller.process import Process, Tape, contact
from design.audit import LONGEST_DELAY, edge
from design.certificate import CONDITIONS, theorem4_of
from design.conditions import (
    Requirement,
    any_environment_delayed,
    any_environment_per_channel,
    any_environment_ratios,
    refusal,
    this_environment,
    this_environment_ratios,
)
from design.lmi import least_phi
from design.result import DesignFailed, listed
from models.device import Device, passivity_level
from models.human import Population
from models.scene import Crowd, Scene, variants
from sim.crowds import crowds
from sim.engines import HeldPlant, MujocoBatchEngine, hold, profiler_off, quiet_warnings
from sim.run import stretch
from sim.scenario import InputError
from sim.stability import MARGINAL, RUNAWAY, Oscillation, close, oscillation, pace, slowest_seen

# ----------------------------------------------------------------------------------------------------
# What K and B are, and what is asked of the loop with them.


Cells = NDArray[np.intp]
Progress = Callable[[int, int], None]  # done, total

MODEL_KEPT = "model kept"
#: a one-sided wall behind the coupling is this stiff [N/m], which makes K too soft by K / 1e10
_HARD_WALL = Network(("tip",), walls=(Wall(("tip", GROUND), stiffness=1e10),))


@dataclass(frozen=True, eq=False)
class _Sweep:
    """What both kinds share: devices, delays and an environment; K and B are (n,) arrays of as many cells."""

    devices: tuple[Device, ...]  # (m,)
    population: Population
    network: Network | None  # None is a rigid wall behind the coupling, one channel
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    def _loop(self, network: Network) -> Loop:
        return Loop(self.T, self.theta, self.psi, self.theta, self.delta, network)

    def _ratios(self, F: Lti, sent: Callable[[Complex], Sampled]) -> Array:
        """this-environment's ratios, (n,), of the force maps F, whose responses without Theta are `sent`."""
        theta = delay(self.theta, self.T)

        def at(z: Complex) -> Sampled:
            G = sent(z)
            return as_like(G, theta) @ G

        longest = max(n + p for n, p in zip(self.theta, self.psi, strict=True))
        return this_environment_ratios(at, F.poles(), self.delta, longest)

    def _limits(self, devices: Sequence[Device]) -> tuple[Array, Array]:
        """Force limits [N] and encoder steps [m], (m,) each."""
        return np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])


@dataclass(frozen=True, eq=False)
class CouplingSweep(_Sweep):
    """K and B are those of the coupling, on every channel. Raises ValueError naming the field that is wrong."""

    cutoff: float | None = None  # [Hz] of a filter on the velocity that the coupling damps
    one_sided: bool = False  # whether a rigid wall only pushes; the walls of a network do in any case

    def __post_init__(self) -> None:
        for name in ("theta", "psi"):
            if not all(0 <= n <= LONGEST_DELAY for n in getattr(self, name)):
                raise ValueError(f"{name} is {listed(getattr(self, name))}, allowed are 0 to {LONGEST_DELAY} samples")
        if not all(d > 0 for d in self.delta):
            raise ValueError(f"delta is {listed(self.delta)}, expected positive dampings in N s/m")
        if self.network is None and any(self.psi):
            loop = "behind a rigid wall no loop with a delayed environment is stable"
            raise ValueError(f"psi is {listed(self.psi)}: {loop}")

    @property
    def walled(self) -> Network | None:
        """The network whose contact is made and broken in the simulated loop, if there is one."""
        if self.network is None:
            return _HARD_WALL if self.one_sided else None
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
        """What is asked of every cell."""
        return CONDITIONS

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        reason = self.multiplier[1]
        return {"theorem4": reason} if reason else {}

    @cached_property
    def multiplier(self) -> tuple[Array | None, str | None]:
        """Phi of Theorem 4 [N s/m], (m,), which only delay in the environment needs; or why there is none."""
        if not any(self.psi) or self.network is None:
            return None, None
        if self.network.walls:
            return None, "with delay in the environment its multiplier is of a linear one: no walls"
        try:
            return least_phi(self._loop(self.network)), None
        except (ValueError, DesignFailed) as error:
            return None, " ".join(str(error).split())

    def force_maps(self, K: Array, B: Array) -> tuple[Lti, ...]:
        """F of every coupling, a stack for each frozen contact state of the environment, all walls touching first.

        Off a rigid wall the device is free, which is safe by itself.
        """
        return tuple(self._force_map(E, self._couplings(K, B)) for E in self._environments)

    def processes(self, K: Array, B: Array, devices: Sequence[Device]) -> list[Process]:
        """What the computer does every T with each coupling; limits and encoder steps are those of `devices`."""
        limits = self._limits(devices)
        if self.walled is None:
            F = self.force_maps(K, B)[0]
            return [Process(F[i], *limits) for i in range(K.size)]
        V = self._couplings(K, B).compliance(self.T)
        walls = [contact(self.walled, Compliance(V[i]), self.theta, self.psi, self.T) for i in range(K.size)]
        return [Process(each.open, *limits, each) for each in walls]

    def ratios(self, condition: str, K: Array, B: Array) -> Array:
        """Required over available damping, (n,); inf where no damping is enough. Of walls, in the worst state."""
        if condition == "closed-loop":
            couplings = self._couplings(K, B)
            return np.max([self._closed_loop_ratios(E, couplings) for E in self._environments], axis=0)
        phi, reason = self.multiplier
        if reason:
            return np.full(K.size, np.inf)
        one, none = self._couplings(K, B, 1), [None] * self.channels
        channels = set(zip(self.theta, self.delta, none if phi is None else phi.tolist(), strict=True))
        each = [
            any_environment_ratios(lambda z: one.sampled(z, self.T), K.size, [n], [d], None if p is None else [p])
            for n, d, p in channels
        ]
        return np.max(each, axis=0)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The same of one coupling by a sweep of its own, which a map is checked against."""
        coupling = SpringDamper([K] * self.channels, [B] * self.channels, self.cutoff)
        if condition == "closed-loop":
            states = [this_environment(self._force_map(E, coupling), self.delta) for E in self._environments]
            return max(states, key=lambda requirement: requirement.ratio)
        phi, reason = self.multiplier
        if reason:
            return refusal("theorem4", self.delta, reason)
        E = self._environments[0]
        if phi is None or E is None:
            return any_environment_per_channel(coupling.channels(self.T), self.theta, self.delta)
        return any_environment_delayed(coupling.compliance(self.T), E, self.theta, self.psi, self.delta, phi)

    def _couplings(self, K: Array, B: Array, channels: int | None = None) -> SpringDamper:
        m = channels or self.channels
        each = np.ones(m)
        return SpringDamper(np.multiply.outer(K, each), np.multiply.outer(B, each), self.cutoff)

    @cached_property
    def _environments(self) -> tuple[Lti | None, ...]:
        """One for each frozen contact state; None is a rigid wall."""
        if self.network is None:
            return (None,)
        return tuple(environment(state, self.T) for state in reversed(list(frozen_states(self.network).values())))

    def _force_map(self, E: Lti | None, coupling: SpringDamper) -> Lti:
        """F, against a rigid wall Theta V^-1."""
        if E is None:
            return delay(self.theta, self.T) @ coupling.compliance(self.T).inverse()
        return force_map(E, coupling, self.theta, self.psi)

    def _closed_loop_ratios(self, E: Lti | None, couplings: SpringDamper) -> Array:
        delayed = E and delay(self.psi, self.T) @ E

        def sent(z: Complex) -> Sampled:
            return couplings.around(Sampled.of(delayed, z)) if delayed else couplings.sampled(z, self.T).inverse()

        return self._ratios(self._force_map(E, couplings), sent)


@dataclass(frozen=True, eq=False)
class EnvironmentSweep(_Sweep):
    """K and B are those of every spring at a contact; `network` is what the coupling, which is fixed, was designed for.

    An optimal coupling is the pair of a fixed Q and a model of the environment, and where that is another one than the
    model was of, two things may happen:

        closed-loop   the model is the environment of the cell: F = Theta (Psi E - Psi E Q Psi E), as with ranges
        model kept    nobody tells the coupling: V = Q (I - Psi E0 Q)^-1 of the scenario's E0 faces E

    A coupling of each cell's own would be certified everywhere, since Q near E^-1 turns the force off. Raises
    ValueError where the network has no spring at a contact, or walls.
    """

    network: Network
    coupling: Coupling

    cutoff = walled = None  # a velocity filter and contact made and broken belong to the other sweep
    usual_scale = "log"

    def __post_init__(self) -> None:
        if self.network.walls:
            raise ValueError("environment.walls: with --coupling the map is over linear environments; take them out")
        if not contact_springs(self.network):
            raise ValueError("environment: no spring or damper ends at a contact, so there is no K and B to vary")

    @property
    def stiffness_scale(self) -> float:
        """What the middle of the map is about [N/m]: the geometric mean of these springs."""
        stiff = [s.stiffness for s in contact_springs(self.network) if s.stiffness > 0]
        return float(np.exp(np.mean(np.log(stiff)))) if stiff else 1000.0

    @property
    def conditions(self) -> tuple[str, ...]:
        """What is asked of every cell."""
        return (*CONDITIONS, MODEL_KEPT) if isinstance(self.coupling, InternalModel) else CONDITIONS

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        if any(self.psi):
            why = "with delay in the environment it takes a multiplier for each: ask design.audit about single ones"
            return {"theorem4": why}
        reason = self._any_environment.reason
        return {"theorem4": reason} if reason else {}

    def force_maps(self, K: Array, B: Array) -> tuple[Lti, ...]:
        """F in every environment, the coupling's model following it; one stack, since there is no contact to freeze."""
        return (self._force_map(self._matrices(K, B), self.coupling),)

    def processes(self, K: Array, B: Array, devices: Sequence[Device]) -> list[Process]:
        """What the computer does every T in each environment; limits and encoder steps are those of `devices`."""
        F, limits = self.force_maps(K, B)[0], self._limits(devices)
        return [Process(F[i], *limits) for i in range(K.size)]

    def ratios(self, condition: str, K: Array, B: Array) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        if condition == "theorem4":
            return np.full(K.size, self._any_environment.ratio)
        matrices, coupling, psi = self._matrices(K, B), self._facing(condition), delay(self.psi, self.T)

        def sent(z: Complex) -> Sampled:
            E = sampled_environment(matrices, self.channels, z, self.T)
            return coupling.around(as_like(E, psi) @ E)

        return self._ratios(self._force_map(matrices, coupling), sent)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The damping that the condition asks of the devices in one environment, by a sweep of its own."""
        if condition == "theorem4":
            return self._any_environment
        try:
            F = self._force_map(self._matrices(np.array([K]), np.array([B])), self._facing(condition))[0]
            return this_environment(F, self.delta)
        except SingularLoop as error:
            return refusal("closed-loop", self.delta, str(error))

    @cached_property
    def _any_environment(self) -> Requirement:
        """theorem4's requirement, which no spring of the environment changes."""
        if any(self.psi):
            return refusal("theorem4", self.delta, "not asked")
        return theorem4_of(self._loop(self.network), self.coupling)

    def _facing(self, condition: str) -> Coupling:
        """The coupling; for MODEL_KEPT as the V whose model stays that of the scenario's environment."""
        return self._kept if condition == MODEL_KEPT else self.coupling

    @cached_property
    def _kept(self) -> Coupling:
        assert isinstance(self.coupling, InternalModel)
        model = delay(self.psi, self.T) @ environment(self.network, self.T)
        return Compliance(self.coupling.parameter(self.T).feedback(-model))

    def _force_map(self, matrices: Matrices, coupling: Coupling) -> Lti:
        return force_map(environment_of(matrices, self.channels, self.T), coupling, self.theta, self.psi)

    def _matrices(self, K: Array, B: Array) -> Matrices:
        """Mass, damping and stiffness of every network, (n, nodes, nodes)."""
        M, D, S = self.network.matrices()
        varied = contact_springs(self.network)
        pattern = np.zeros_like(M)
        for spring, across in zip(varied, self.network.across(varied), strict=True):
            one = np.outer(across, across)
            pattern, D, S = pattern + one, D - spring.damping * one, S - spring.stiffness * one
        vary = lambda fixed, value: fixed + np.asarray(value)[:, None, None] * pattern  # noqa: E731
        return np.broadcast_to(M, (np.size(K), *M.shape)), vary(D, B), vary(S, K)


Sweep = CouplingSweep | EnvironmentSweep


def contact_springs(network: Network) -> tuple[Spring, ...]:
    """Those that end at a contact."""
    return tuple(s for s in network.springs if set(s.between) & set(network.contacts))


def one_sided(network: Network) -> Network:
    """The network whose contacts only push: every spring at a contact becomes a wall, in the direction it is given in.

    Raises ValueError where the contacts have no springs.
    """
    at_contact = [s for s in contact_springs(network) if s.stiffness > 0]
    if not at_contact:
        raise ValueError("no spring ends at a contact, so there is nothing to make one-sided")
    kept = tuple(spring for spring in network.springs if spring not in at_contact)
    walls = tuple(Wall(s.between, s.stiffness, s.damping) for s in at_contact)
    return Network(network.contacts, kept, network.masses, (*network.walls, *walls))


# ----------------------------------------------------------------------------------------------------
# The plane of a map.


#: what K and B may be, as in design.audit: within these, all arithmetic is far from overflow
_STIFFNESSES, _DAMPINGS = (1e-3, 1e9), (0.0, 1e6)
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
        """K and B of every cell, (n n,): B runs fastest."""
        K, B = np.meshgrid(self.K, self.B, indexing="ij")
        return K.ravel(), B.ravel()

    def subset(self, count: int) -> Cells:
        """(k,) flat indices of `count` rows and columns at most, evenly spread, with the corners."""
        rows, columns = (np.unique(np.round(np.linspace(0, n - 1, min(count, n))).astype(int)) for n in self.shape)
        return (rows[:, None] * self.shape[1] + columns).ravel()


def make_grid(
    sweep: Sweep, n: int, K: Range | None, B: Range | None, scale: str | None, marks: tuple[Range, ...] = ()
) -> Grid:
    """n x n cells. Ranges that are not given come from the loop, and make room for the marks.

    K is about the loop's stiffness_scale, B about delta, the most that a linear law may damp. A linear map goes up to
    2.5 times these, a logarithmic one from far below to far above. Raises InputError.
    """
    scale = scale or sweep.usual_scale
    stiff, most = sweep.stiffness_scale, max(sweep.delta)
    if scale == "linear":
        wide = (2.5 * stiff / n, 2.5 * stiff), (0.0, 2.5 * most)
    else:
        wide = (stiff / 30, stiff * 30), (most / 100, most * 10)
    of_marks = tuple(zip(*marks, strict=True)) if marks else ((), ())
    ends = []
    of_axes = zip("KB", (K, B), wide, (_STIFFNESSES, _DAMPINGS), of_marks, strict=True)
    for name, given, usual, allowed, marked in of_axes:
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
# Which cells are stable with every human of a population: the exact loop's eigenvalues over humans x cells.


#: slower modes [Hz] decay so little that they would hide an oscillation that is about to grow
_MIN_FREQUENCY_HZ = 2.0
_LEADING = 0.1  # share of the humans that meet every cell; the rest meet those that are stable with them


@dataclass(frozen=True, eq=False)
class HeldDevices:
    """The devices in the hands of every human, sampled; in groups of humans with the same number of links."""

    #: (index of each human, who, plant, positions of motors and handles in its state)
    groups: tuple[tuple[Cells, Crowd, HeldPlant, tuple[int, ...]], ...]

    @classmethod
    def drawn(cls, sweep: Sweep, seed: int, humans: int, links: int | None = None) -> HeldDevices:
        """Random humans with the devices of the loop; of so many links each, by default as their population says."""
        population, groups = sweep.population, []
        links = population.links if links is None else links
        for index, crowd in crowds(population, sweep.channels, seed, range(humans), links):
            held_by = variants(sweep.devices, crowd)
            groups.append((index, crowd, hold(held_by.plants(), sweep.T), _motors_and_handles(held_by.scene)))
        return cls(tuple(groups))

    def __len__(self) -> int:
        return sum(index.size for index, *_ in self.groups)

    def links(self, human: int) -> Array:
        """(m, links, 3) of one human, as in Crowd."""
        (_, crowd, *_), i = self._place(human)
        return crowd.links[i]

    def growth(
        self, F: Lti, humans: NDArray[np.bool_] | None = None, min_frequency_hz: float = _MIN_FREQUENCY_HZ
    ) -> tuple[Array, Array]:
        """Growth [1/s] of the dominant mode, and of the dominant one above `min_frequency_hz`, with every human (n,).

        Where `humans` (n,) is false nothing is computed, and the answer is -inf.
        """
        n = len(self)
        everything, turning = np.full((2, n), -np.inf)
        for index, _, plants, _ in self.groups:
            chosen = np.ones(index.size, dtype=bool) if humans is None else humans[index]
            if not chosen.any():
                continue
            some = HeldPlant(plants.A[chosen], plants.B[chosen], plants.C, plants.T)
            values = np.linalg.eigvals(close(some, F).A)
            size = np.abs(values)
            fast = np.abs(np.angle(values)) >= 2 * np.pi * min_frequency_hz * plants.T
            with np.errstate(divide="ignore"):
                everything[index[chosen]] = np.log(size.max(axis=1)) / plants.T
                turning[index[chosen]] = np.log(np.where(fast, size, 0.0).max(axis=1)) / plants.T
        return everything, turning

    def mode(self, F: Lti, human: int, min_frequency_hz: float) -> Array:
        """The dominant mode above that frequency with one human, as a state [s; z]: the motor or handle that moves most
        moves by 1 m."""
        (_, _, plants, seen), i = self._place(human)
        values, vectors = np.linalg.eig(close(HeldPlant(plants.A[i], plants.B[i], plants.C, plants.T), F).A)
        fast = np.abs(np.angle(values)) >= 2 * np.pi * min_frequency_hz * plants.T
        vector = vectors[:, np.argmax(np.where(fast, np.abs(values), 0.0))]
        positions = vector[list(seen)]
        return (vector / positions[np.argmax(np.abs(positions))]).real

    def leading(self, some: Sequence[Lti]) -> NDArray[np.bool_]:
        """The tenth (8 at least) of the humans that are unstable with most of these maps, then nearest to it."""
        growths = np.array([self.growth(F)[1] for F in some])
        score = (growths > 0).sum(axis=0) + np.clip(growths, -100, 100).mean(axis=0) / 1000
        first = np.zeros(len(self), dtype=bool)
        first[np.argsort(-score, kind="stable")[: max(8, round(_LEADING * len(self)))]] = True
        return first

    def _place(self, human: int) -> tuple[tuple[Cells, Crowd, HeldPlant, tuple[int, ...]], int]:
        """The group of a human, and the position in it."""
        for group in self.groups:
            at = np.flatnonzero(group[0] == human)
            if at.size:
                return group, int(at[0])
        raise IndexError(f"human {human} of {len(self)}")


def _motors_and_handles(scene: Scene) -> tuple[int, ...]:
    """Their positions in a plant state; of a rigid device they are one."""
    return tuple(dict.fromkeys((*range(scene.channels), *scene.handles)))


# ----------------------------------------------------------------------------------------------------
# Cells in MuJoCo, with the effects that no theory covers switched on. The human that is nearest to oscillating, by the
# exact linear loop, holds the devices. The loop starts on that mode, so far out that Coulomb friction does not hold it;
# the hand presses with a constant force, eased in; and what still oscillates at the end decides (sim.stability).


_UNLIMITED = 1e6  # [N] force limit of a motor that does not saturate: the largest that a device may have
_BATCH = 20  # simulations in one MuJoCo batch
_EASE = 0.5  # [s] in which the press grows
_STRETCH = 64  # ticks between two looks at the keyboard
DECIDED = 0.2  # [1/s] linear growth nearer to zero than this does not show within a trace
UNDECIDED = "too slow to say"  # verdict where the trace goes on oscillating as the linear loop would, decaying or not


@dataclass(frozen=True)
class Effects:
    """What the simulated cells have beside the linear loop. None leaves what the devices of the scenario have."""

    quantisation: float | None = None  # [m] encoder step
    friction: float | None = None  # [N] Coulomb friction at each motor
    saturation: bool = False  # whether motors have their force limits

    def on(self, devices: Sequence[Device]) -> tuple[Device, ...]:
        changes: dict[str, float] = {} if self.saturation else {"force_limit": _UNLIMITED}
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
    """How cells are simulated."""

    effects: Effects
    points: int  # rows and columns of the grid that are simulated; 0 for none
    trials: int  # humans at each cell
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
    """The simulated cells, (k,) each."""

    cell: Cells  # flat index in the grid
    oscillates: NDArray[np.bool_]  # to the end of the trace, with any of the humans that were tried
    amplitude: Array  # [m] the largest among them that decided; inf: diverged
    frequency_hz: Array  # [Hz] of it; nan: diverged
    growth: Array  # [1/s] of the exact loop's dominant mode, swinging or running away, with the worst of these humans

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        """The cells of all parts; of none, no cell."""
        if not parts:
            return cls(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), *np.zeros((3, 0)))
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

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


def _simulated(
    sweep: Sweep, grid: Grid, held: HeldDevices, plan: Plan, cells: Cells, progress: Progress
) -> tuple[Points, bool]:
    """These cells, simulated in batches of whole cells, and whether the keyboard ended it."""
    (K, B), parts = grid.flat, []
    size, ticks = max(1, _BATCH // plan.trials), round(plan.duration / sweep.T)
    try:
        for first in range(0, cells.size, size):
            some, seen = cells[first : first + size], 0
            trials, growth = _trials(sweep, K[some], B[some], held, plan)

            def ticked(count: int, first: int = first) -> None:
                nonlocal seen
                seen += count
                progress(first * ticks + min(seen, ticks) * min(size, cells.size - first), cells.size * ticks)

            parts.append(_points(some, growth, trials, sweep, plan, ticked))
    except KeyboardInterrupt:
        return Points.joined(parts), True
    return Points.joined(parts), False


@dataclass(frozen=True, eq=False)
class _Trial:
    """One simulation: a process, who holds the devices, and where it starts."""

    process: Process
    links: Array  # (m, links, 3) as in Crowd
    start: Array  # (2n + order,) plant state, then the state of the linear process


def _trials(sweep: Sweep, K: Array, B: Array, held: HeldDevices, plan: Plan) -> tuple[list[_Trial], Array]:
    """The trials of these cells, plan.trials of each in succession, and the growth of the worst of each."""
    slowest, F = slowest_seen(plan.duration), sweep.force_maps(K, B)[0]
    trials, growth = [], []
    for i, process in enumerate(sweep.processes(K, B, plan.effects.on(sweep.devices))):
        whole, swinging = held.growth(F[i], min_frequency_hz=slowest)
        runs_away = whole > plan.runaway_growth  # without an oscillation: what pushes outwards at rest
        shown = np.where(runs_away, whole, swinging)
        worst = np.argsort(-shown, kind="stable")[: plan.trials]
        for human in worst.tolist():
            mode = held.mode(F[i], human, 0.0 if runs_away[human] else slowest)
            trials.append(_Trial(process, held.links(human), plan.start * mode))
        growth.append(shown[worst[0]])
    return trials, np.array(growth)


def _points(
    cells: Cells, growth: Array, trials: list[_Trial], sweep: Sweep, plan: Plan, ticked: Callable[[int], None]
) -> Points:
    """Simulate the trials of these cells, plan.trials of each in succession."""
    devices = plan.effects.on(sweep.devices)
    press = plan.press * _press_directions(sweep.walled, sweep.channels)
    lasting, amplitude, frequency = np.zeros(len(trials), dtype=bool), np.zeros(len(trials)), np.zeros(len(trials))
    links = np.array([trial.links.shape[1] for trial in trials])
    for count in np.unique(links):
        which = np.flatnonzero(links == count)
        found = _simulate([trials[i] for i in which], devices, press, plan, ticked)
        lasting[which], amplitude[which], frequency[which] = found.sustained, found.amplitude, found.frequency_hz
    shape = (cells.size, -1)
    shown = np.where(lasting, amplitude + 1e9, amplitude).reshape(shape).argmax(axis=1)[:, None]
    pick = lambda values: np.take_along_axis(values.reshape(shape), shown, axis=1)[:, 0]  # noqa: E731
    return Points(cells, np.any(lasting.reshape(shape), axis=1), pick(amplitude), pick(frequency), growth)


def _simulate(
    trials: Sequence[_Trial], devices: Sequence[Device], press: Array, plan: Plan, ticked: Callable[[int], None]
) -> Oscillation:
    """All trials at once; their humans must have the same number of links. `press` (m,) [N]."""
    T = trials[0].process.F.T
    held_by = variants(devices, Crowd(np.stack([trial.links for trial in trials])))
    scene, ticks = held_by.scene, round(plan.duration / T)
    substeps = pace(held_by.plants().A).substeps(T)
    n, processes = 2 * scene.model.nv, [trial.process for trial in trials]
    tape = _ManyProcesses(processes, min(_STRETCH, ticks), n, scene.outside)
    starts = np.stack([trial.start for trial in trials], axis=1)
    tape.s[0] = starts[:n]
    if processes[0].contact is None:  # the states of a process with walls are others: it begins at rest
        tape.z[0] = starts[n:]
    seen, kept, done = list(_motors_and_handles(scene)), [], 0
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine = MujocoBatchEngine(scene, T, substeps=substeps, nsim=len(trials), fields=held_by.fields)
        engine.start(tape)
        while done < ticks:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = _press_forces(scene, T, press, done, count)[:, :, None]
            stretch(tape, engine, count)
            kept.append(tape.s[:count, seen].copy())
            tape.rewind(count)
            done += count
            ticked(count)
    return oscillation(np.concatenate(kept)[ticks // 2 :], T, plan.threshold)


def _press_forces(scene: Scene, T: float, press: Array, first: int, ticks: int) -> Array:
    """Outside forces [N], (ticks, outside): `press` (m,) on the ends of the humans."""
    t = (first + np.arange(ticks)) * T
    eased = np.where(t < _EASE, (1 - np.cos(np.pi * t / _EASE)) / 2, 1.0)
    w = np.zeros((ticks, scene.outside))
    for force, column in zip(press, scene.pushed, strict=True):
        w[:, column] += force * eased
    return w


def _press_directions(network: Network | None, channels: int) -> Array:
    """(m,) +1 or -1: into the walls where contacts have some, else alternately."""
    directions = (-1.0) ** np.arange(channels)
    for i, name in enumerate(network.contacts if network else ()):
        for wall in network.walls if network else ():
            if name in wall.between:
                directions[i] = 1.0 if wall.between[0] == name else -1.0
    return directions


_Transition = Callable[[Array, Array], object]  # [z; x] (order + m, nsim) -> writes [f; z+] (m + order, nsim)


class _ManyProcesses(Tape):
    """A process for each simulation, all of the same order, number of walls, force limits and encoder steps."""

    def __init__(self, processes: Sequence[Process], ticks: int, plant_states: int, outside: int) -> None:
        super().__init__(processes[0], ticks, plant_states, outside, len(processes))
        walls = len(processes[0].contact.walls) if processes[0].contact else 0
        self._together = _linear(processes) if walls == 0 else _one_wall(processes) if walls == 1 else _each(processes)

    def tick(self, k: int) -> None:
        self._together(self.seen(k), self._output[k])


def _linear(processes: Sequence[Process]) -> _Transition:
    blocks = _last_axis([np.block([[p.F.C, p.F.D], [p.F.A, p.F.B]]) for p in processes])
    return lambda before, after: np.einsum("oin,in->on", blocks, before, out=after)


def _one_wall(processes: Sequence[Process]) -> _Transition:
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


def _each(processes: Sequence[Process]) -> _Transition:
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
# The map: both certificates and the population over the whole grid, MuJoCo at a sparse part of it.


_SLICE, _SAMPLE = 60, 25  # cells in one pass of a condition; cells that tell which humans are the leading ones


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


def draw_map(sweep: Sweep, grid: Grid, held: HeldDevices, plan: Plan, progress: Callable[[str, int, int], None]) -> Map:
    """All stages, each with its name in `progress` (stage, done, total); Ctrl-C keeps what is done."""
    K, B = grid.flat
    seconds, n = {}, K.size
    ratio: dict[str, Array] = {name: np.full(n, np.nan) for name in sweep.conditions}
    growth, unstable = np.full((2, n), np.nan)
    points, stopped = Points.joined([]), False

    def ratios(part: slice) -> tuple[Array, ...]:
        return tuple(sweep.ratios(name, K[part], B[part]) for name in sweep.conditions)

    def population(part: slice) -> tuple[float, int]:
        return _population(held, [F[part.start] for F in maps], leading)

    begin = time.perf_counter()
    _ = sweep.refusals  # once, before threads ask for it
    done, stopped = _in_slices(ratios, n, _SLICE, lambda k, of: progress("certificates", k, of))
    for part, values in done:
        for name, value in zip(sweep.conditions, values, strict=True):
            ratio[name][part] = value
    seconds["certificates"] = time.perf_counter() - begin
    if not stopped:
        begin = time.perf_counter()
        maps = sweep.force_maps(K, B)
        sample = np.unique(np.linspace(0, n - 1, min(_SAMPLE, n)).astype(int))
        leading = held.leading([maps[0][i] for i in sample])
        done, stopped = _in_slices(population, n, 1, lambda k, of: progress("population", k, of))
        for part, values in done:
            growth[part], unstable[part] = values
        seconds["population"] = time.perf_counter() - begin
    if not stopped and plan.points:
        begin = time.perf_counter()
        cells = grid.subset(plan.points)
        points, stopped = _simulated(sweep, grid, held, plan, cells, lambda k, of: progress("MuJoCo", k, of))
        seconds["simulation"] = time.perf_counter() - begin
    return Map(grid, ratio, growth, unstable, points, seconds, stopped)


def _population(held: HeldDevices, states: Sequence[Lti], leading: NDArray[np.bool_]) -> tuple[float, int]:
    """Worst growth and number of unstable humans among the leading ones, or, if none of these, among all.

    `states` are the force maps of one cell; a human is unstable if it is with any of them.
    """
    growth = np.max([held.growth(F, leading)[0] for F in states], axis=0)
    if not (growth > MARGINAL).any() and not leading.all():
        rest = np.max([held.growth(F, ~leading)[0] for F in states], axis=0)
        growth = np.maximum(growth, rest)
    return float(growth.max()), int((growth > MARGINAL).sum())


_Part = TypeVar("_Part")


def _in_slices(
    task: Callable[[slice], _Part], count: int, size: int, progress: Progress
) -> tuple[list[tuple[slice, _Part]], bool]:
    """task(slice) for slices of `size` that cover range(count), and whether the keyboard ended it before the last.

    On all cores, since NumPy's kernels leave Python to other threads; what was finished is returned.
    """
    done: list[tuple[slice, _Part]] = []
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    pool = ThreadPoolExecutor(cores)
    slices = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    futures = {pool.submit(task, part): part for part in slices}
    waiting, finished = set(futures), 0
    try:
        while waiting:
            ready, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in ready:
                done.append((futures[future], future.result()))
                finished += futures[future].stop - futures[future].start
            progress(finished, count)
    except KeyboardInterrupt:
        return done, True
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return done, False


# ----------------------------------------------------------------------------------------------------
# Single points of the plane, looked at closely: those that were asked about, and how true the map is.


_COLUMNS = 4  # of the map, at which its edge is compared with a bisection on single sweeps
_STEPS = 48  # stiffnesses tried between the softest of the map and the stiffest, to find where safety ends
_HALVINGS = 20  # an edge of the population is found to a relative 1e-6


@dataclass(frozen=True)
class Mark:
    """One point, and the stiffest at the same B; None where none is safe, inf where all that were tried are."""

    K: float
    B: float
    requirement: dict[str, Requirement]
    growth: float  # [1/s] worst over the population
    unstable: int  # humans
    stiffest: dict[str, float | None]  # by condition, and "population"


@dataclass(frozen=True)
class MapError:
    """How far the map is from single sweeps, over the columns that were compared."""

    ratio: float  # largest relative error of the figure beside the edge
    edge: float  # largest relative error in K of the edge, interpolated between two rows
    columns: int


def evaluate_point(sweep: Sweep, held: HeldDevices, K: float, B: float, grid_K: Array) -> Mark:
    """What each condition and the population say at (K, B), and up to which K they are content at this B."""

    def calm(k: float) -> bool:
        return bool((_growth(sweep, held, k, B) <= MARGINAL).all())

    growth = _growth(sweep, held, K, B)
    tried = np.geomspace(min(grid_K[0], K), max(grid_K[-1], K), _STEPS)
    stiffest: dict[str, float | None] = {}
    for name in sweep.conditions:
        safe = sweep.ratios(name, tried, np.full(_STEPS, float(B))) < 1
        stiffest[name] = _last(tried, safe, lambda low, high, name=name: _edge(sweep, name, low, high, B))
    settled = np.array([calm(k) for k in tried])
    stiffest["population"] = _last(tried, settled, lambda low, high: _bisected(calm, low, high))
    requirement = {name: sweep.requirement(name, K, B) for name in sweep.conditions}
    return Mark(K, B, requirement, float(growth.max()), int((growth > MARGINAL).sum()), stiffest)


def map_error(sweep: Sweep, drawn: Map, condition: str) -> MapError | None:
    """Columns of the map that cross the edge, evenly chosen; None where there is none."""
    grid, ratio = drawn.grid, drawn.ratio[condition].reshape(drawn.grid.shape)
    inside = ratio < 1
    crossing = inside[:-1] & ~inside[1:] & np.isfinite(ratio[1:])
    columns = np.flatnonzero(crossing.any(axis=0))
    if not columns.size:
        return None
    chosen = np.unique(columns[np.round(np.linspace(0, columns.size - 1, _COLUMNS)).astype(int)])
    ratio_errors, edge_errors = [], []
    for column in chosen:
        B, k = float(grid.B[column]), int(np.flatnonzero(crossing[:, column])[-1])
        for row in (k, k + 1):
            true = sweep.requirement(condition, float(grid.K[row]), B).ratio
            ratio_errors.append(abs(ratio[row, column] / true - 1))
        true_edge = _edge(sweep, condition, float(grid.K[k]), float(grid.K[k + 1]), B)
        edge_errors.append(abs(_interpolated(grid.K, ratio[:, column], k, grid.scale) / true_edge - 1))
    return MapError(max(ratio_errors), max(edge_errors), chosen.size)


def _interpolated(K: Array, ratio: Array, k: int, scale: str) -> float:
    share = (1 - ratio[k]) / (ratio[k + 1] - ratio[k])
    if scale == "log":
        return float(K[k] * (K[k + 1] / K[k]) ** share)
    return float(K[k] + share * (K[k + 1] - K[k]))


def _edge(sweep: Sweep, condition: str, low: float, high: float, B: float) -> float:
    return edge(lambda K: sweep.requirement(condition, K, B).ratio, low, high)


def _growth(sweep: Sweep, held: HeldDevices, K: float, B: float) -> Array:
    """Of every human, in the worst contact state."""
    states = sweep.force_maps(np.array([K]), np.array([B]))
    return np.max([held.growth(F[0])[0] for F in states], axis=0)


def _bisected(calm: Callable[[float], bool], low: float, high: float) -> float:
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if calm(middle) else (low, middle)
    return low


def _last(tried: Array, safe: NDArray[np.bool_], between: Callable[[float, float], float]) -> float | None:
    """Where safety ends for the last time; inf where it does not, None where nothing is safe."""
    if not safe.any():
        return None
    last = int(np.flatnonzero(safe)[-1])
    return np.inf if last == tried.size - 1 else between(float(tried[last]), float(tried[last + 1]))


if __name__ == "__main__":
    from cli.options import execute
    from cli.zwidth import main

    execute(main)
