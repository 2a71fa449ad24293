"""The environment within ranges in which a coupling needs the most damping: a search, always the same, and no proof.

Between the vertices the need is no convex function of stiffness and mass, and what asks the most often lies on an
edge or a face, where points drawn evenly from the ranges never fall: the resonance moves from one vertex to the next.
So every way in which the contacts may be there or absent is searched along all its edges, on its faces and inside,
and from the worst points that were found a compass search goes on within the ranges until its steps are small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from haptic_loop.controller.arithmetic import spent, spent_after
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.ranges import Member, Region, regions
from haptic_loop.design import budgets
from haptic_loop.design.conditions import ratio_in

_Ratio = Callable[[Member], float]  # required over available damping


Progress = Callable[[int, int], None]  # points tried, of about how many


_ON_EDGES, _ALONG = 240, (3, 9)  # points on the edges of a region, and on each of them: least, most


_DRAWN, _SEED = 48, 0xFACE  # points on faces and inside of each region


_MANY = 7  # parameters from which on vertices and edges are drawn, too


_STARTS, _APART, _SAME = 4, 0.2, 0.05  # of the compass search in a region; least distance of starts, and of tops


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
    ended: bool = False  # by its budget, before it was done


def search(
    regions: Sequence[Region],
    ratio: _Ratio,
    progress: Progress = lambda done, total: None,
    work: float = budgets.RANGES,
    over: Callable[[], bool] = lambda: False,
) -> Searched:
    """Find where the coupling behind `ratio` needs the most in the ranges that consist of these regions.

    When this much counted work is done, or `over` says that the time that a user allowed is over, it returns the worst
    of the points that it has tried.
    """
    ended, until = False, spent_after(work)
    points = [list(_points(region)) for region in regions]
    refinements = [min(_STARTS, len(some)) * 8 * region.low.size for region, some in zip(regions, points, strict=True)]
    tried, total = 0, sum(map(len, points)) + sum(refinements)
    tops: list[_Found] = []

    for region, some in zip(regions, points, strict=True):
        known: dict[bytes, float] = {}

        def need(point: Array, region: Region = region, known: dict[bytes, float] = known) -> float:
            nonlocal tried, ended
            if point.tobytes() not in known:
                if ended := ended or (tried > 0 and (spent() > until or over())):
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
    return Searched(tuple(sorted(tops, key=lambda found: -found.ratio)), tried, ended)


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
    over: Callable[[], bool] = lambda: False,
) -> Searched:
    """Find the worst environments of the loop's ranges."""
    assert loop.ranges
    parts = regions(loop.network, loop.ranges)
    return search(parts, lambda member: ratio_in(loop.at(member.network), coupling), progress, over=over)
