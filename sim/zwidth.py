"""Z-width maps: which stiffness K and damping B are safe, by certificates, with random humans, and in simulations.

With `CouplingSweep` K and B are the gains of a spring-damper coupling on every channel, in one environment or against a
rigid wall. With `EnvironmentSweep` the coupling is fixed, and K and B are those of every spring at a contact. A cell is
one pair (K, B). For each cell a map has the required damping of each condition, and the eigenvalues of the exact loop
with humans of a population. For a few cells it also has runs in MuJoCo with the encoder steps, friction and walls of
the scenario.
"""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("zwidth")

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller import environment
from haptic_loop.controller.coupling import Compliance, Coupling, SpringDamper
from haptic_loop.controller.law import Law
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Process
from haptic_loop.design.audit import check_loop, edge
from haptic_loop.design.certificate import named
from haptic_loop.design.conditions import Condition
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.result import ANY, CONDITIONS, PLAIN_CONDITIONS, Requirement, refusal, suffices
from haptic_loop.models.device import Device
from haptic_loop.models.human import Population
from haptic_loop.sim import limit_cycles
from haptic_loop.sim.run import Progress
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.stability import MARGINAL


@dataclass(frozen=True, eq=False)
class _Sweep(ABC):
    """A sweep over K and B for these devices, delays and environment. Arrays K and B (n,) are those of n cells."""

    devices: tuple[Device, ...]  # (m,)
    population: Population
    loop: Loop  # without ranges and with constant delays
    own: Condition | None = field(kw_only=True, default=None)  # a user's own condition

    @abstractmethod
    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """Return the requirement of a condition at one point, computed apart from the map, to check the map."""

    @cached_property
    def judges(self) -> dict[str, Condition]:
        """The conditions by name."""
        names = CONDITIONS if self.loop.known_devices else PLAIN_CONDITIONS
        return {each.name: each for each in (*map(named, names), *([self.own] if self.own else []))}

    @property
    def walls(self) -> bool:
        """Whether the environment has walls, which make and break contact."""
        return bool(self.loop.environment.walls)

    @property
    def decisive(self) -> str:
        """The name of the condition that must certify every point of --mark."""
        return (self.own or THIS_ENVIRONMENT).name

    def _one_by_one(self, condition: str, K: Array, B: Array) -> Array:
        return np.array([self.requirement(condition, k, b).ratio for k, b in zip(K.tolist(), B.tolist(), strict=True)])

    def _actuators(self) -> tuple[Array, Array]:
        """Return force limits [N] that no force reaches, and the encoder steps [m], (m,) each."""
        devices = limit_cycles.unlimited(self.devices)
        return np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])


@dataclass(frozen=True, eq=False)
class CouplingSweep(_Sweep):
    """A sweep over K and B of a spring-damper, equal on all channels. Raises ValueError for a wrong field of `loop`."""

    def __post_init__(self) -> None:
        check_loop(self.loop)

    @property
    def usual_scale(self) -> str:
        """Return "linear" for a rigid wall, else "log": in an environment K far above `stiffness_scale` can be safe."""
        return "linear" if self.loop.environment is environment.RIGID_WALL else "log"

    @property
    def stiffness_scale(self) -> float:
        """The largest of the channels' bounds 2 delta/((theta + 1) T) [N/m] on K for any passive environment."""
        return max(2 * d / ((n + 1) * self.loop.T) for d, n in zip(self.loop.delta, self.loop.theta, strict=True))

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that do not apply to this map, with the reason."""
        return {name: reason for name, (_, reason) in self._multipliers.items() if reason}

    @cached_property
    def _multipliers(self) -> dict[str, tuple[Array | None, str | None]]:
        """For each condition its multiplier (m,) or None, and None or the reason why the condition does not apply."""
        return {name: each.least_multiplier(self.loop) for name, each in self.judges.items()}

    def force_maps(self, K: Array, B: Array) -> tuple[Lti, ...]:
        """Return for each set of touched walls a stack of F of every coupling; the set of all walls comes first.

        A rigid wall is always touched here, because a device without contact is safe.
        """
        return tuple(state.F(self._couplings(K, B)) for state in self.loop.frozen()[::-1])

    def processes(self, K: Array, B: Array) -> list[Process]:
        """Return one process per coupling, with motors that never clip."""
        limits, steps = self._actuators()
        V = self._couplings(K, B).compliance(self.loop.T)
        return [Process(self.loop.law(Compliance(V[i])), limits, steps) for i in range(K.size)]

    def ratios(self, condition: str, K: Array, B: Array) -> Array:
        """Return required over available damping (n,); with walls, for contact that makes and breaks.

        The ratio is inf if the condition does not apply, or if no damping is enough.
        """
        judge, (multiplier_of, reason) = self.judges[condition], self._multipliers[condition]
        if reason:
            return np.full(K.size, np.inf)
        couplings, loops = self._couplings(K, B), [(self.loop, None)]
        if judge.separable(self.loop):
            each = [None] * self.loop.channels if multiplier_of is None else [(p,) for p in multiplier_of.tolist()]
            loops = [*set(zip(map(self.loop.channel, range(self.loop.channels)), each, strict=True))]
            couplings = self._couplings(K, B, 1)
        elif self.walls and judge.guarantee(self.loop) != ANY:  # Each coupling needs its own multipliers here.
            return self._one_by_one(condition, K, B)
        shares = [judge.ratios(loop, couplings, multiplier) for loop, multiplier in loops]
        known = [ratios for ratios in shares if ratios is not None]
        return np.max(known, axis=0) if known else self._one_by_one(condition, K, B)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        judge, coupling = self.judges[condition], self._coupling(K, B)
        multipliers, reason = self._multipliers[condition]
        if reason:
            return refusal(condition, self.loop.delta, reason)
        return judge.judge(self.loop, coupling, multipliers)

    def _coupling(self, K: float, B: float) -> SpringDamper:
        return SpringDamper([K] * self.loop.channels, [B] * self.loop.channels)

    def _couplings(self, K: Array, B: Array, channels: int | None = None) -> SpringDamper:
        m = channels or self.loop.channels
        each = np.ones(m)
        return SpringDamper(np.multiply.outer(K, each), np.multiply.outer(B, each))


@dataclass(frozen=True, eq=False)
class EnvironmentSweep(_Sweep):
    """A sweep over K and B of every spring at a contact, for a fixed coupling.

    An optimal coupling is a fixed filter R with a model of the cell's environment E: F = Theta R Psi E.

    Raises ValueError if the network has walls or a block, or no spring at a contact.
    """

    coupling: Coupling

    usual_scale = "log"

    def __post_init__(self) -> None:
        if self.loop.environment.walls:
            raise ValueError("environment.walls: with --coupling the map is over linear environments; remove the walls")
        if self.loop.network.block:
            raise ValueError(
                "environment.block: with --coupling the map varies springs at contacts; leave --coupling out"
            )
        if not contact_springs(self.loop.network):
            raise ValueError("environment: no spring or damper ends at a contact, so there is no K and B to vary")

    @property
    def stiffness_scale(self) -> float:
        """The middle of the map [N/m]: the geometric mean of the stiffnesses at contacts, or 1000 if all are 0."""
        stiff = [s.stiffness for s in contact_springs(self.loop.network) if s.stiffness > 0]
        return float(np.exp(np.mean(np.log(stiff)))) if stiff else 1000.0

    @property
    def refusals(self) -> dict[str, str]:
        return {name: needs.reason for name, needs in self._everywhere.items() if needs.reason}

    def force_maps(self, K: Array, B: Array) -> tuple[Lti, ...]:
        """Return a stack with F of every environment. An optimal coupling holds a model of the cell's environment."""
        return (self._at(K, B).F(self.coupling),)

    def processes(self, K: Array, B: Array) -> list[Process]:
        """Return one process per environment, with motors that never clip."""
        (limits, steps), sent = self._actuators(), self._at(K, B).sent(self.coupling)
        return [Process(Law(sent[i], self.loop.theta), limits, steps) for i in range(K.size)]

    def ratios(self, condition: str, K: Array, B: Array) -> Array:
        """Return required over available damping (n,); inf if the condition does not apply, or no damping is enough."""
        if condition in self._everywhere:
            return np.full(K.size, self._everywhere[condition].ratio)
        shares = self.judges[condition].ratios(self._at(K, B), self.coupling)
        return self._one_by_one(condition, K, B) if shares is None else shares

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        if condition in self._everywhere:
            return self._everywhere[condition]
        network, varied = self.loop.network, contact_springs(self.loop.network)
        springs = [msgspec.structs.replace(s, stiffness=K, damping=B) if s in varied else s for s in network.springs]
        cell = self.loop.at(msgspec.structs.replace(network, springs=tuple(springs)))
        return self.judges[condition].judge(cell, self.coupling)

    @cached_property
    def _everywhere(self) -> dict[str, Requirement]:
        """The requirements, by condition, that are equal in all cells or whose condition does not apply."""
        requirements: dict[str, Requirement] = {}
        for name, each in self.judges.items():
            reason = each.not_varied(self.loop) or each.beyond(self.loop)
            if reason or each.guarantee(self.loop) == ANY:
                loop = self.loop
                requirements[name] = refusal(name, loop.delta, reason) if reason else each.judge(loop, self.coupling)
        return requirements

    def _at(self, K: Array, B: Array) -> Loop:
        """Return the loop with a stack of environments, for K and B (n,)."""
        network = self.loop.network
        M, D, S = network.matrices()
        varied = contact_springs(network)
        pattern = np.zeros_like(M)
        for spring, across in zip(varied, network.across(varied), strict=True):
            one = np.outer(across, across)
            pattern, D, S = pattern + one, D - spring.damping * one, S - spring.stiffness * one
        M = np.broadcast_to(M, (K.size, *M.shape))
        D, S = D + B[:, None, None] * pattern, S + K[:, None, None] * pattern
        return self.loop.at(environment.Networks(network.contacts, (M, D, S)))


Sweep = CouplingSweep | EnvironmentSweep


def contact_springs(network: environment.Network) -> tuple[environment.Spring, ...]:
    return tuple(s for s in network.springs if set(s.between) & set(network.contacts))


def _press_directions(loop: Loop) -> Array:
    """Return the signs (m,) of the hands' steady forces: into the wall of a contact, otherwise +1 and -1 in turn."""
    directions = (-1.0) ** np.arange(loop.channels)
    for i, name in enumerate(loop.environment.contacts):
        for wall in loop.environment.walls:
            if name in wall.between:
                directions[i] = 1.0 if wall.between[0] == name else -1.0
    return directions


#: allowed K [N/m] and B [N s/m], as in design.audit; within these bounds all arithmetic is far from overflow
_STIFFNESSES, _DAMPINGS = (1e-3, 1e9), (0.0, 1e6)
_Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Grid:
    """The cells of a map: every K with every B."""

    K: Array  # (n,) [N/m]
    B: Array  # (n,) [N s/m]
    scale: str  # linear | log

    @property
    def shape(self) -> tuple[int, int]:
        return self.K.size, self.B.size

    @property
    def flat(self) -> tuple[Array, Array]:
        """K and B of every cell, (n * n,) each; B runs fastest."""
        K, B = np.meshgrid(self.K, self.B, indexing="ij")
        return K.ravel(), B.ravel()

    def subset(self, count: int) -> limit_cycles.Cells:
        """Return flat indices (k,) of the cells in at most `count` rows and columns, from border to border."""
        rows, columns = (np.unique(np.round(np.linspace(0, n - 1, min(count, n))).astype(int)) for n in self.shape)
        return (rows[:, None] * self.shape[1] + columns).ravel()


def make_grid(sweep: Sweep, n: int, K: _Range | None, B: _Range | None, marks: tuple[_Range, ...] = ()) -> Grid:
    """Return a grid of n x n cells. Default ranges follow from the loop and include all marks above 0.

    The unit of K is here the sweep's stiffness_scale, and that of B the largest delta. A linear map goes up to 2.5
    units. In a logarithmic map K goes from 1/30 to 30 units, and B from 1/100 to 10 units. Raises InputError for an
    impossible range, or if a mark is outside of a given range.
    """
    scale, stiff, most = sweep.usual_scale, sweep.stiffness_scale, max(sweep.loop.delta)
    if scale == "linear":
        wide = (2.5 * stiff / n, 2.5 * stiff), (0.0, 2.5 * most)
    else:
        wide = (stiff / 30, stiff * 30), (most / 100, most * 10)
    of_marks = tuple(zip(*marks, strict=True)) if marks else ((), ())
    ends = []
    of_axes = zip("KB", (K, B), wide, (_STIFFNESSES, _DAMPINGS), of_marks, strict=True)
    for name, bounds, usual, allowed, marked in of_axes:
        low, high = bounds or _with_room(usual, marked)
        _check(name, low, high, allowed, scale)
        for mark in marked:
            if bounds and not low <= mark <= high:
                raise InputError(f"--mark has {name} = {mark:g}, outside --{name}-range {low:g},{high:g}")
        ends.append((low, high))
    spread = np.linspace if scale == "linear" else np.geomspace
    along_K, along_B = (spread(low, high, n) for low, high in ends)
    return Grid(along_K, along_B, scale)


def _with_room(usual: _Range, marked: Sequence[float]) -> _Range:
    """Return a range that is wide enough for all positive marks."""
    low, high = usual
    return min([low, *(mark / 1.1 for mark in marked if mark > 0)]), max([high, *(1.1 * mark for mark in marked)])


def _check(name: str, low: float, high: float, allowed: _Range, scale: str) -> None:
    option, unit = f"--{name}-range", "N/m" if name == "K" else "N s/m"
    if not (allowed[0] <= low and high <= allowed[1]):
        raise InputError(f"{option} is {low:g},{high:g}, allowed are {allowed[0]:g} to {allowed[1]:g} {unit}")
    if not low < high:
        raise InputError(f"{option} is {low:g},{high:g}, expected the lower end first")
    if scale == "log" and low == 0:
        raise InputError(f"{option} begins at 0, which a logarithmic map cannot show: choose a lower end above 0")


_SLICE = 60  # number of cells whose ratios are computed together; 1 with walls
_SAMPLE = 25  # number of cells that decide which humans are tried first (`HeldDevices.leading`)


@dataclass(frozen=True, eq=False)
class Map:
    """Results over the cells of the grid, (cells,) each, in the order of `Grid.flat`; nan: not done before Ctrl-C."""

    grid: Grid
    ratio: dict[str, Array]  # condition -> required over available damping
    growth: Array  # [1/s] worst over the tried humans (`_population`) and the sets of touched walls
    unstable: Array  # number of tried humans that make the cell unstable
    points: limit_cycles.Points  # results of MuJoCo in a few cells
    seconds: dict[str, float]  # wall time of each stage
    interrupted: bool


def draw_map(
    sweep: Sweep,
    grid: Grid,
    held: limit_cycles.HeldDevices,
    plan: limit_cycles.Plan,
    progress: Callable[[str, int, int], None],
) -> Map:
    """Return the map. After Ctrl-C it has only the finished cells. `progress` is called with (stage, done, total)."""
    K, B = grid.flat
    seconds, n = {}, K.size
    ratio: dict[str, Array] = {name: np.full(n, np.nan) for name in sweep.judges}
    growth, unstable = np.full((2, n), np.nan)
    points, stopped = limit_cycles.Points.joined([]), False

    def ratios(part: slice) -> tuple[Array, ...]:
        return tuple(sweep.ratios(name, K[part], B[part]) for name in sweep.judges)

    def population(part: slice) -> tuple[float, int]:
        return _population(held, [F[part.start] for F in maps], leading)

    def loops(some: limit_cycles.Cells) -> tuple[Lti, list[Process]]:
        return sweep.force_maps(K[some], B[some])[0], sweep.processes(K[some], B[some])

    begin = time.perf_counter()
    _ = sweep.refusals  # This fills the cache before threads read it.
    parts, stopped = _in_slices(ratios, n, 1 if sweep.walls else _SLICE, lambda k, of: progress("certificates", k, of))
    for part, values in parts:
        for name, value in zip(sweep.judges, values, strict=True):
            ratio[name][part] = value
    seconds["certificates"] = time.perf_counter() - begin
    if not stopped:
        begin = time.perf_counter()
        maps = sweep.force_maps(K, B)
        sample = np.unique(np.linspace(0, n - 1, min(_SAMPLE, n)).astype(int))
        leading = held.leading([maps[0][i] for i in sample])
        parts, stopped = _in_slices(population, n, 1, lambda k, of: progress("population", k, of))
        for part, values in parts:
            growth[part], unstable[part] = values
        seconds["population"] = time.perf_counter() - begin
    if not stopped and plan.points:
        begin = time.perf_counter()
        cells = grid.subset(plan.points)
        press = plan.press * _press_directions(sweep.loop)
        points, stopped = limit_cycles.simulate_cells(
            cells, loops, held, plan, press, lambda k, of: progress("MuJoCo", k, of)
        )
        seconds["simulation"] = time.perf_counter() - begin
    return Map(grid, ratio, growth, unstable, points, seconds, stopped)


def _population(held: limit_cycles.HeldDevices, states: Sequence[Lti], leading: NDArray[np.bool_]) -> tuple[float, int]:
    """Return the worst growth [1/s] in a cell with the force maps `states`, and the number of unstable humans.

    The humans of the mask `leading` are tried first. The others are tried only if no leading human is unstable.
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
    """Return (slice, task(slice)) for slices of `size` that cover range(count), and whether the keyboard interrupted.

    After an interruption only finished slices are returned.
    """
    parts: list[tuple[slice, _Part]] = []
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    slices = [slice(first, min(first + size, count)) for first in range(0, count, size)]
    pool = ThreadPoolExecutor(cores)
    try:  # Ctrl-C may also come while tasks are submitted. Then the program must not wait until all have run.
        for part, values in zip(slices, pool.map(task, slices), strict=True):
            parts.append((part, values))
            progress(part.stop, count)
    except KeyboardInterrupt:
        return parts, True
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return parts, False


_COLUMNS = 4  # number of columns at which `map_error` compares the map's edge
_STEPS = 48  # number of stiffnesses that are tried to find an edge, before the bisection
_HALVINGS = 20  # bisections, which give an edge of the population with a relative error below 1e-6


@dataclass(frozen=True)
class Mark:
    """One point, and the largest safe K at this B: None if no tried K is safe, inf if the largest tried K is safe."""

    K: float  # [N/m]
    B: float  # [N s/m]
    requirement: dict[str, Requirement]
    growth: float  # [1/s] worst over the population and the sets of touched walls
    unstable: int  # number of humans that make the loop unstable
    stiffest: dict[str, float | None]  # condition, or "population" -> largest safe K [N/m]


@dataclass(frozen=True)
class MapError:
    """Largest errors of the map, compared with single evaluations of a condition."""

    figure_relative: float  # relative error of required over available damping, in cells beside the edge
    edge_relative_in_K: float  # relative error of the K of the edge, which the map interpolates between two rows
    columns_compared: int


def evaluate_point(sweep: Sweep, held: limit_cycles.HeldDevices, K: float, B: float, grid_K: Array) -> Mark:
    """Return the results of each condition and of the population at (K, B), and the largest K that each allows at B."""

    def calm(k: float) -> bool:
        return bool((_growth(sweep, held, k, B) <= MARGINAL).all())

    growth = _growth(sweep, held, K, B)
    tried = np.geomspace(min(grid_K[0], K), max(grid_K[-1], K), _STEPS)
    stiffest: dict[str, float | None] = {}
    for name in sweep.judges:
        safe = suffices(sweep.ratios(name, tried, np.full(_STEPS, float(B))))
        stiffest[name] = _last(tried, safe, lambda low, high, name=name: _edge(sweep, name, low, high, B))
    settled = np.array([calm(k) for k in tried])
    stiffest["population"] = _last(tried, settled, lambda low, high: _bisected(calm, low, high))
    requirement = {name: sweep.requirement(name, K, B) for name in sweep.judges}
    return Mark(K, B, requirement, float(growth.max()), int((growth > MARGINAL).sum()), stiffest)


def map_error(sweep: Sweep, drawn: Map, condition: str) -> MapError | None:
    """Return the errors of the map in up to _COLUMNS columns that have an edge; None if no column has one."""
    grid, ratio = drawn.grid, drawn.ratio[condition].reshape(drawn.grid.shape)
    inside = suffices(ratio)
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


def _growth(sweep: Sweep, held: limit_cycles.HeldDevices, K: float, B: float) -> Array:
    """Return the growth [1/s] with every human, which is the largest for any set of touched walls."""
    states = sweep.force_maps(np.array([K]), np.array([B]))
    return np.max([held.growth(F[0])[0] for F in states], axis=0)


def _bisected(calm: Callable[[float], bool], low: float, high: float) -> float:
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if calm(middle) else (low, middle)
    return low


def _last(tried: Array, safe: NDArray[np.bool_], between: Callable[[float, float], float]) -> float | None:
    """Return the largest safe value, refined by `between`; inf if the last tried value is safe, None if none is."""
    if not safe.any():
        return None
    last = int(np.flatnonzero(safe)[-1])
    return np.inf if last == tried.size - 1 else between(float(tried[last]), float(tried[last + 1]))
