"""Search the ranges of an environment for the member in which a coupling needs the most damping.

The search is deterministic and proves nothing. Between the vertices the required damping is not a convex function of
stiffness and mass, because the resonance moves from one vertex to the next. The worst member often lies on an edge or a
face, which uniformly drawn points never hit. Therefore the search tries vertices, points on edges, points on faces
(only for up to _MANY parameters) and points inside. It does so for every combination of present and absent springs. A
compass search then continues from the worst points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from haptic_loop.controller.arithmetic import spent, spent_after
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.ranges import Member, Region, regions
from haptic_loop.design import budgets
from haptic_loop.design.conditions import ratio_in
from haptic_loop.design.result import suffices

_Ratio = Callable[[Member], float]  # required over available damping
Progress = Callable[[int, int], None]  # points tried, points expected

_SEED = 0xFACE
_MANY = 7  # For more parameters the vertices, points on edges and points inside are random, and no face has a point.
_APART, _SAME = 0.2, 0.05  # least distances of two starts of the compass search and of two maxima, in range widths
_FIRST, _LAST = 1 / 16, 1 / 128  # first step (for up to _MANY parameters) and last step, in range widths


@dataclass(frozen=True)
class _Worst:
    """A member of the ranges, and the share of the available damping that the coupling needs there."""

    member: Member
    ratio: float


@dataclass(frozen=True)
class Searched:
    """The local maxima that a search found, with the largest first. They are evidence and no proof."""

    worst: tuple[_Worst, ...]
    tried: int  # number of members tried
    ended: Literal["work", "clock"] | None = None  # what ended the search early: its budget, or the user's time limit

    def part(self) -> dict[str, Any]:
        """Return the search as fields for JSON; `violated` says whether the worst member violates the condition."""
        worst = self.worst[0]
        return {
            "environments": self.tried,
            "worst_ratio": worst.ratio,
            "worst": worst.member.name,
            "violated": not suffices(worst.ratio),
            "ended_early": self.ended is not None,
            "ended_by_clock": self.ended == "clock",
            "how": "along edges, on faces (up to 7 parameters) and inside, then uphill from the worst points",
        }

    def __str__(self) -> str:
        worst = self.worst[0]
        verdict = "no violation found" if suffices(worst.ratio) else "[red]violated[/]"
        ratio = f"worst ratio {worst.ratio:.4f}" if np.isfinite(worst.ratio) else "no damping is enough"
        limit = "--seconds" if self.ended == "clock" else "its budget of counted work"
        ended = f", until {limit} ended the search" if self.ended else ""
        return f"searched, not proved: {verdict}, {ratio} in {self.tried} points{ended}; worst: {worst.member.name}"


def search(
    regions: Sequence[Region],
    ratio: _Ratio,
    progress: Progress = lambda done, total: None,
    over: Callable[[], bool] = lambda: False,
) -> Searched:
    """Return the members at which `ratio` is largest. A region consists of all members with the same present springs.

    The search ends early when its budget of counted work is spent, or when `over` returns True because the user's time
    limit has passed. The result then contains the maxima among the members that were tried.
    """
    ended: Literal["work", "clock"] | None = None
    until = spent_after(budgets.RANGES)
    points = [list(_points(region)) for region in regions]
    refinements = [
        min(budgets.RANGE_STARTS, len(some)) * 8 * region.low.size for region, some in zip(regions, points, strict=True)
    ]
    tried, total = 0, sum(map(len, points)) + sum(refinements)
    maxima: list[_Worst] = []

    for region, some in zip(regions, points, strict=True):
        known: dict[bytes, float] = {}

        def need(point: Array, region: Region = region, known: dict[bytes, float] = known) -> float:
            nonlocal tried, ended
            if point.tobytes() not in known:
                if tried > 0 and not ended:
                    ended = "clock" if over() else "work" if spent() > until else None
                if ended:
                    return -np.inf
                tried += 1
                progress(min(tried, total), total)
                known[point.tobytes()] = ratio(_member(region, point))
            return known[point.tobytes()]

        starts = _apart(some, [need(point) for point in some], _APART)[: budgets.RANGE_STARTS]
        climbed = [_climbed(need, *start) for start in starts]
        distinct = _apart([point for point, _ in climbed], [value for _, value in climbed], _SAME)
        maxima += [_Worst(_member(region, point), value) for point, value in distinct if value > -np.inf]
    progress(total, total)
    return Searched(tuple(sorted(maxima, key=lambda one: -one.ratio)), tried, ended)


def _member(region: Region, point: Array) -> Member:
    """Map a point of the unit cube to the member of the region."""
    return region.at("point", region.low + point * (region.high - region.low))


def _points(region: Region) -> Iterator[Array]:
    """Yield points of the unit cube: at vertices, on edges, on faces and inside; _MANY says which are random."""
    n = region.low.size
    rng = np.random.default_rng(_SEED)
    if n > _MANY:
        yield from rng.integers(0, 2, (budgets.RANGE_EDGES, n)).astype(float)
        for corner in rng.integers(0, 2, (budgets.RANGE_EDGES, n)).astype(float):
            corner[rng.integers(n)] = rng.random()
            yield corner
        yield from rng.random((budgets.RANGE_DRAWN, n))
        return
    yield from (np.array(corner, dtype=float) for corner in product((0.0, 1.0), repeat=n))
    if n == 0:
        return
    least, most = budgets.RANGE_ALONG
    count = int(np.clip(budgets.RANGE_EDGES // (n * 2 ** (n - 1)), least, most))
    for i in range(n):
        for others in product((0.0, 1.0), repeat=n - 1):
            for x in np.arange(1, count + 1) / (count + 1):
                yield np.insert(np.array(others), i, x)
    if n == 1:
        return
    for _ in range(budgets.RANGE_DRAWN):  # With probability 1/2 a coordinate is an end of its range.
        between, end, coin = rng.random(n), rng.integers(0, 2, n), rng.random(n) < 0.5
        yield np.where(coin, between, end)


def _apart(points: Sequence[Array], values: Sequence[float], distance: float) -> list[tuple[Array, float]]:
    """Return points with their values, the largest value first. Points near a point of larger value are left out."""
    chosen: list[tuple[Array, float]] = []
    for i in np.argsort(-np.array(values), kind="stable"):
        if all(np.abs(points[i] - other).max(initial=0.0) >= distance for other, _ in chosen):
            chosen.append((points[i], values[i]))
    return chosen


def _climbed(need: Callable[[Array], float], point: Array, value: float) -> tuple[Array, float]:
    """Return a local maximum and its value, by compass search from `point`.

    Each move is along the best axis. If no move gives a larger value, the step length is halved.
    """
    # With many parameters only some vertices were tried. So the first steps move one parameter to an end of its range.
    step = 1.0 if point.size > _MANY else _FIRST
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
    ratio: Callable[[Loop], float] | None = None,
) -> Searched:
    """Return the members of the ranges with the largest `ratio`; None stands for `ratio_in` of the coupling."""
    assert loop.ranges
    parts, ratio = regions(loop.network, loop.ranges), ratio or (lambda there: ratio_in(there, coupling))
    return search(parts, lambda member: ratio(loop.at(member.network)), progress, over=over)
