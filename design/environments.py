"""What the conditions that have names ask of a coupling: in this environment, its walls and ranges, and in any other.

And the environment of ranges in which a coupling asks the most: a search, no proof.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

from controller.arithmetic import SingularLoop, TooLong, numbers
from controller.coupling import Coupling
from controller.delay import delay
from controller.loop import Loop
from controller.lti import Array, Block, Lti, Sampled, constant_like, vstack
from controller.ranges import Member, Region, regions
from design.conditions import (
    BEYOND,
    Condition,
    Demand,
    dampings,
    even_damping,
    least_multiple,
    least_scale,
    this_environment,
    this_environment_demand,
    this_environment_ratios,
)
from design.exact import require_size
from design.frequency import MOST_SECONDS, frequencies, hermitian, on_circle, supremum, sweeping, too_long
from design.result import MAKING, NotProved, Requirement, from_ratio, refusal


class ThisEnvironment(Condition):
    """Safe in the environment of the loop: around its walls, whether they touch or not, and at all of its members."""

    name, covers, extensible = "this-environment", BEYOND, True

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Demand[Lti]:
        F = loop.F(coupling, exact)
        if exact:
            require_size(F.order)
        return this_environment_demand(F, loop)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """The most that any member asks."""
        if loop.environment.walls:
            try:
                return walls_of(loop, coupling, multiplier).requirement
            except NotProved as error:
                return refusal(self.name, loop.delta, str(error))
        if loop.ranges is None:
            return this_environment(loop.F(coupling), loop)
        requirements = in_each(loop, coupling, loop.members())
        return requirements[worst(requirements)]

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        if loop.environment.walls:
            return {"P": self._walls(loop, coupling, multiplier)}
        return super().exact_demands(loop, coupling)

    def _walls(self, loop: Loop, coupling: Coupling, g: Sequence[Fraction]) -> Demand[Lti]:
        G = loop.walled(coupling, exact=True)
        require_size(G.order)
        return walls_demand(G, loop, g)

    def multiplier(self, loop: Loop, coupling: Coupling, given: Sequence[float] | None) -> Sequence[float] | None:
        return walls_of(loop, coupling).g if loop.environment.walls else None

    def multiplier_name(self, loop: Loop) -> str | None:
        return _WALL_MULTIPLIER if loop.environment.walls else None

    def ratio(self, loop: Loop, coupling: Coupling, thin: int = 1) -> float:
        return ratio_in(loop, coupling, thin)

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        poles = loop.F(coupling).poles()
        return this_environment_ratios(lambda z: loop.late(loop.sent_at(coupling, z)), poles, loop)

    def words(self, loop: Loop) -> str:
        return MAKING if loop.environment.walls else super().words(loop)


THIS_ENVIRONMENT = ThisEnvironment()


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """The this-environment condition of this coupling around each of the members, every one frozen."""
    return [_required(loop, coupling, member) for member in members]


def worst(requirements: Sequence[Requirement]) -> int:
    """The member that requires the most damping."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


def _required(loop: Loop, coupling: Coupling, member: Member) -> Requirement:
    try:
        F = loop.at(member.network).F(coupling)
    except SingularLoop as error:
        return refusal("this-environment", loop.delta, str(error))
    return this_environment(F, loop)


# ----------------------------------------------------------------------------------------------------
# Walls that make and break contact: this-environment with a multiplier for each.


def walls_demand(G: Block, loop: Loop, g: Any, lam: Sequence[Any] | None = None) -> Demand[Block]:
    """this-environment for walls of any stiffness and damping with k + 2 b/T up to that of the loop's, and any gap.

    G takes [x; p] to [f; y], displacements (m,) and wall forces to the forces of the devices and the ways into the
    walls, [[F, J], [H, Y]]. With a multiplier g >= 0 and a weight lam > 0 for each wall (1 if not given) and
    M = g (z-1) - 1 the block is, on (dx, dp),
        [[F, J], [-lam M H, -lam M Y]]/(z-1) + diag(s Delta_D/T, lam g/slopes),
    whose static part must be symmetric, J(1) = H(1)' lam and lam Y(1) = Y(1)' lam, with F(1) >= 0 >= lam Y(1).
    """
    T, m, w = G.T, loop.channels, len(loop.environment.walls)
    slopes: Any = [wall.slope(T) for wall in loop.environment.walls]
    gains, one = numbers(g, T), numbers(np.eye(m + w), T)
    weights = numbers([1] * w if lam is None else lam, T)
    weigh = np.diag(np.concatenate([numbers([1] * m, T), weights]))
    S1, R = (weigh @ G).split_at_one()
    steep = np.diag(np.concatenate([numbers([0] * m, T), weights * gains]))
    limits = np.concatenate([numbers([0] * m, T), weights * gains / numbers(slopes, T)])
    free = np.hstack([one, -steep]) @ vstack(R, G) - S1 / 2 + np.diag(limits)
    damping = np.concatenate([even_damping(loop, T) / T, numbers([0] * w, T)])
    F1, Y1 = S1[..., :m, :m], S1[..., m:, m:]
    static = {"F(1)": F1, "-Y(1)": -Y1, "the static map of devices and walls": S1}
    return Demand(free, constant_like(G, np.diag(damping)), static, ("F(1)", "-Y(1)"))


# this-environment with walls: the best multiplier. The least s is convex in g, because the block is affine in both.


#: Where the multiplier of a wall is looked for [samples], and the digits that are kept of it.
_LEAST_G, _MOST_G, _G_DIGITS = 1e-3, 1e3, 4


@dataclass(frozen=True)
class _WallsProof:
    """What walls that make and break contact ask of the devices."""

    requirement: Requirement  # condition "this-environment"
    g: tuple[float, ...]  # (w,) the multiplier that shows it


def walls_proof(G: Lti, loop: Loop, g: Sequence[float] | None = None) -> _WallsProof:
    """The damping that `walls_demand` asks with the best multiplier found, or with g (w,) where it is given.

    G takes [x; p] to [f; y] while no wall touches.
    """
    m, w = loop.channels, len(loop.environment.walls)
    available = dampings(loop.delta, m)

    def refused(reason: str) -> _WallsProof:
        return _WallsProof(refusal("this-environment", available, reason), tuple(g or (1.0,) * w))

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if reason := too_long(G):
        return refused(reason)
    radius = float(np.abs(G.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    S1 = G.dc()
    # rounding, relative to what each channel and wall is elsewhere
    own = np.abs([np.diag(S1), np.diag(G.D), np.diag(G.at(-1.0))]).max(axis=0)
    if (np.abs(S1 - S1.T) > 1e-9 * np.sqrt(np.outer(own, own))).any():
        return refused("the static map of devices and walls is not symmetric: a slow closed path could extract energy")
    for name, part, size in (("F(1)", S1[:m, :m], own[:m]), ("-Y(1)", -S1[m:, m:], own[m:])):
        if np.linalg.eigvalsh((part + part.T) / 2).min() < -1e-9 * size.max():
            return refused(f"{name} has a negative direction: it pushes outwards")
    grid = np.concatenate([[0.0], frequencies(G)])
    z = on_circle(frequencies(G, points=100))
    sampled = Sampled(z[None], G.at(z)[None], G.T)

    def needed(values: Array) -> float:
        demand = walls_demand(sampled, loop, values)
        return float(least_multiple(hermitian(demand.free.G), hermitian(demand.gain.G)).max())

    found = _best_g(needed, w) if g is None else np.asarray(g, dtype=float)
    demand = walls_demand(G, loop, found)
    ratio, at = supremum(lambda w: least_scale(demand, w), grid)
    if np.isinf(ratio):
        return refused("no multiplier was found with which the walls are covered, whatever the damping")
    return _WallsProof(
        from_ratio("this-environment", max(ratio, 0.0), available, at / (2 * np.pi * G.T)), tuple(found.tolist())
    )


def _best_g(needed: Callable[[Array], float], walls: int) -> Array:
    """g (walls,) with about the least `needed`: one for all of them, then one by one, each by a search in log g."""
    from scipy.optimize import minimize_scalar  # slow to load, and seldom needed

    g = np.ones(walls)
    turns = [np.ones(walls, dtype=bool), *(np.eye(walls, dtype=bool) if walls > 1 else ())]

    def moved(which: Array, value: float) -> Array:
        return np.where(which, value, g)

    for which in turns:
        grid = np.geomspace(_LEAST_G, _MOST_G, 13)
        values = [needed(moved(which, value)) for value in grid]
        best = int(np.argmin(values))
        ends = np.log(grid[max(best - 1, 0)]), np.log(grid[min(best + 1, grid.size - 1)])
        finer = minimize_scalar(
            lambda x, which=which: min(needed(moved(which, np.exp(x))), 1e300),
            bounds=ends,
            method="bounded",
            options={"xatol": 1e-2},
        )
        g = moved(which, float(np.exp(finer.x)) if finer.fun < values[best] else float(grid[best]))
    return np.array([float(f"{value:.{_G_DIGITS}g}") for value in g])


#: What a certificate calls the multipliers of walls that make and break contact, one each.
_WALL_MULTIPLIER = "g"


def walls_of(loop: Loop, coupling: Coupling, g: Sequence[Fraction] | None = None) -> _WallsProof:
    """What this-environment asks where walls make and break contact, with the multipliers g (w,) or the best found.

    Raises NotProved for walls that nothing is proved of.
    """
    walls = loop.environment.walls
    if loop.ranges:
        raise NotProved("walls and ranges: walls are proved in one environment")
    try:
        G = loop.walled(coupling)
    except (SingularLoop, ValueError) as error:
        raise NotProved(str(error)) from None
    values = None if g is None else [float(value) for value in g]
    if values is not None and (len(values) != len(walls) or min(values) < 0):
        raise NotProved(f"{_WALL_MULTIPLIER} is {values}, expected a number >= 0 for each of {len(walls)} walls")
    try:
        with sweeping():
            return walls_proof(G, loop, values)
    except TooLong as error:
        raise NotProved(str(error)) from None


# ----------------------------------------------------------------------------------------------------
# The environment within ranges in which a coupling needs the most damping: a search, the same every time, and no proof.
#
# Between the vertices the need is no convex function of stiffness and mass, and what asks the most often lies on an
# edge or a face, where points drawn evenly from the ranges never fall: the resonance moves from one vertex to the next.
# So every way in which the contacts may be there or absent is searched along all its edges, on its faces and inside,
# and from the worst points that were found a compass search goes on within the ranges until its steps are small.


_Ratio = Callable[[Member], float]  # required over available damping


Progress = Callable[[int, int], None]  # points tried, of about how many


_ON_EDGES, _ALONG = 240, (3, 9)  # points on the edges of a region, and on each of them: least, most


_DRAWN, _SEED = 48, 0xFACE  # points on faces and inside of each region


_MANY = 7  # parameters from which on vertices and edges are drawn, too


_STARTS, _APART, _SAME = 4, 0.2, 0.05  # of the compass search in a region; least distance of starts, and of tops


_LOWEST = 1e-6  # [rad/sample]: below it nothing changes


_FIRST, _LAST = 1 / 16, 1 / 128  # its steps, in widths of the ranges


SEARCH = "along all edges, or many of them, on faces and inside, then uphill from the worst points"


@dataclass(frozen=True)
class _Found:
    """An environment of the ranges, and the share of the damping that is needed there."""

    member: Member
    ratio: float


@dataclass(frozen=True)
class Searched:
    """The worst environments, each the top of its neighbourhood, the worst of all first; and how many were tried."""

    worst: tuple[_Found, ...]
    tried: int
    ended: bool = False  # by its clock, before it was done


def search(
    regions: Sequence[Region],
    ratio: _Ratio,
    progress: Progress = lambda done, total: None,
    seconds: float = MOST_SECONDS,
) -> Searched:
    """Where the coupling behind `ratio` needs the most in the ranges that consist of these regions.

    When its time is over it returns the worst of what it has tried.
    """
    until = time.perf_counter() + seconds
    points = [list(_points(region)) for region in regions]
    refinements = [min(_STARTS, len(some)) * 8 * region.low.size for region, some in zip(regions, points, strict=True)]
    tried, total = 0, sum(map(len, points)) + sum(refinements)
    tops: list[_Found] = []

    for region, some in zip(regions, points, strict=True):
        known: dict[bytes, float] = {}

        def need(point: Array, region: Region = region, known: dict[bytes, float] = known) -> float:
            nonlocal tried
            if point.tobytes() not in known:
                if tried and time.perf_counter() > until:
                    return -np.inf
                tried += 1
                progress(min(tried, total), total)
                known[point.tobytes()] = ratio(_member(region, point))
            return known[point.tobytes()]

        starts = _apart(some, [need(point) for point in some], _APART)[:_STARTS]
        climbed = [_climbed(need, *start) for start in starts]
        distinct = _apart([point for point, _ in climbed], [value for _, value in climbed], _SAME)
        tops += [_Found(_member(region, point), value) for point, value in distinct if value > -np.inf]
    progress(total, total)
    return Searched(tuple(sorted(tops, key=lambda found: -found.ratio)), tried, time.perf_counter() > until)


def _member(region: Region, point: Array) -> Member:
    """The environment at a point of the unit cube that stands for the region."""
    return region.at("point", region.low + point * (region.high - region.low))


def _points(region: Region) -> Iterator[Array]:
    """Of the unit cube: its vertices, points along every edge, and points on faces and inside."""
    n = region.low.size
    rng = np.random.default_rng(_SEED)
    if n > _MANY:
        yield from rng.integers(0, 2, (_ON_EDGES, n)).astype(float)
        for corner in rng.integers(0, 2, (_ON_EDGES, n)).astype(float):
            corner[rng.integers(n)] = rng.random()
            yield corner
        yield from rng.random((_DRAWN, n))
        return
    yield from (np.array(corner, dtype=float) for corner in product((0.0, 1.0), repeat=n))
    if n == 0:
        return
    least, most = _ALONG
    count = int(np.clip(_ON_EDGES // (n * 2 ** (n - 1)), least, most))
    for i in range(n):
        for others in product((0.0, 1.0), repeat=n - 1):
            for x in np.arange(1, count + 1) / (count + 1):
                yield np.insert(np.array(others), i, x)
    if n == 1:
        return
    for _ in range(_DRAWN):  # every number in between, or at one of its ends, as often as not
        between, end, coin = rng.random(n), rng.integers(0, 2, n), rng.random(n) < 0.5
        yield np.where(coin, between, end)


def _apart(points: Sequence[Array], values: Sequence[float], distance: float) -> list[tuple[Array, float]]:
    """The points by falling value, without those that are close to a worse one."""
    chosen: list[tuple[Array, float]] = []
    for i in np.argsort(-np.array(values), kind="stable"):
        if all(np.abs(points[i] - other).max(initial=0.0) >= distance for other, _ in chosen):
            chosen.append((points[i], values[i]))
    return chosen


def _climbed(need: Callable[[Array], float], point: Array, value: float) -> tuple[Array, float]:
    """Uphill along the axes of the unit cube, with steps that are halved where none leads up; the ends are exact."""
    step = 1.0 if point.size > _MANY else _FIRST  # from end to end first, where not all ends were tried
    while point.size and step >= _LAST and np.isfinite(value):
        moves = [np.clip(point + sign * step * axis, 0, 1) for axis in np.eye(point.size) for sign in (1, -1)]
        values = [need(move) if (move != point).any() else -np.inf for move in moves]
        best = int(np.argmax(values))
        if values[best] > value:
            point, value = moves[best], values[best]
        else:
            step /= 2
    return point, value


def search_ranges(
    loop: Loop,
    coupling: Coupling,
    progress: Progress = lambda done, total: None,
    seconds: float = MOST_SECONDS,
) -> Searched:
    """The worst environments of the loop's ranges that the search of design.environments finds."""
    assert loop.ranges
    parts = regions(loop.network, loop.ranges)
    return search(parts, lambda member: ratio_in(loop.at(member.network), coupling), progress, seconds)


def ratio_in(loop: Loop, coupling: Coupling, thin: int = 1) -> float:
    """The damping that this-environment requires over the available damping, by a refined sweep of a stable coupling.

    With `thin` by every `thin`-th frequency of its grid alone. Of one in series, a force filter, the responses of
    environment and filter are multiplied: the poles of their series are defective and cost digits, and time.
    """
    if (chain := coupling.in_series(loop.T)) is None:
        nominal = Member("", loop.environment)
        return _thinly(loop, coupling, thin) if thin > 1 else _required(loop, coupling, nominal).ratio
    E = loop.E()
    delayed = delay(loop.psi, loop.T) @ E

    def needed(w: Array) -> Array:
        F = loop.late(coupling.around(Sampled.of(delayed, on_circle(w)[None])))
        demand = this_environment_demand(F, loop)
        return least_multiple(hermitian(demand.free.G[0]), hermitian(demand.gain.G[0]))

    grid = frequencies(E, chain, low=_LOWEST)
    return float(needed(grid[::thin]).max()) if thin > 1 else supremum(needed, grid)[0]


def _thinly(loop: Loop, coupling: Coupling, thin: int) -> float:
    """`ratio_in` at every `thin`-th frequency."""
    try:
        F = loop.F(coupling)
        demand = this_environment_demand(F, loop)
    except SingularLoop:
        return np.inf
    return float(least_scale(demand, frequencies(F)[::thin]).max()) if F.is_stable() else np.inf
