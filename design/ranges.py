"""Whether a coupling keeps its guarantee for ranges of environments: proved at the vertices, searched between."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from controller.coupling import Coupling
from controller.environment import Member, Region, environment, inside, regions
from controller.loop import Loop, force_map
from controller.lti import Array
from design.certificate import Certificate, NotProved, finite, in_each, prove, worst
from design.conditions import Requirement, this_environment
from design.transparency import decibels, transparency

# ----------------------------------------------------------------------------------------------------
# The environment of a box in which a coupling needs the most damping: a search, the same every time, and no proof.
#
# Between the vertices the need is no convex function of stiffness and mass, and what asks the most often lies on an
# edge or a face, where points drawn evenly from the box never fall: the resonance moves from one vertex to the next.
# So every way in which the contacts may be there or absent is searched along all its edges, on its faces and inside,
# and from the worst points that were found a compass search goes on within the ranges until its steps are small.


Ratio = Callable[[Member], float]  # required over available damping
Progress = Callable[[int, int], None]  # points tried, of about how many

ON_EDGES, ALONG = 240, (3, 9)  # points on the edges of a region, and on each of them: least, most
DRAWN, SEED = 48, 0xFACE  # points on faces and inside of each region
STARTS, APART, SAME = 4, 0.2, 0.05  # of the compass search in a region; least distance of starts, and of tops
FIRST, LAST = 1 / 16, 1 / 128  # its steps, in widths of the ranges

SEARCH = "along all edges, on faces and inside, then uphill from the worst points"


@dataclass(frozen=True)
class Found:
    """An environment of the box, and the share of the damping that is needed there."""

    member: Member
    ratio: float


@dataclass(frozen=True)
class Searched:
    """The worst environments, each the top of its neighbourhood, the worst of all first; and how many were tried."""

    worst: tuple[Found, ...]
    tried: int


def search(regions: Sequence[Region], ratio: Ratio, progress: Progress = lambda done, total: None) -> Searched:
    """Where the coupling behind `ratio` needs the most in the box that consists of these regions."""
    points = [list(_points(region)) for region in regions]
    refinements = [min(STARTS, len(some)) * 8 * region.low.size for region, some in zip(regions, points, strict=True)]
    tried, total = 0, sum(map(len, points)) + sum(refinements)
    tops: list[Found] = []

    for region, some in zip(regions, points, strict=True):
        known: dict[bytes, float] = {}

        def need(point: Array, region: Region = region, known: dict[bytes, float] = known) -> float:
            nonlocal tried
            if point.tobytes() not in known:
                tried += 1
                progress(min(tried, total), total)
                known[point.tobytes()] = ratio(_member(region, point))
            return known[point.tobytes()]

        starts = _apart(some, [need(point) for point in some], APART)[:STARTS]
        climbed = [_climbed(need, *start) for start in starts]
        distinct = _apart([point for point, _ in climbed], [value for _, value in climbed], SAME)
        tops += [Found(_member(region, point), value) for point, value in distinct]
    progress(total, total)
    return Searched(tuple(sorted(tops, key=lambda found: -found.ratio)), tried)


def _member(region: Region, point: Array) -> Member:
    """The environment at a point of the unit cube that stands for the region."""
    return region.at("point", region.low + point * (region.high - region.low))


def _points(region: Region) -> Iterator[Array]:
    """Of the unit cube: its vertices, points along every edge, and points on faces and inside."""
    n = region.low.size
    yield from (np.array(corner, dtype=float) for corner in product((0.0, 1.0), repeat=n))
    if n == 0:
        return
    least, most = ALONG
    count = int(np.clip(ON_EDGES // (n * 2 ** (n - 1)), least, most))
    for i in range(n):
        for others in product((0.0, 1.0), repeat=n - 1):
            for x in np.arange(1, count + 1) / (count + 1):
                yield np.insert(np.array(others), i, x)
    if n == 1:
        return
    rng = np.random.default_rng(SEED)
    for _ in range(DRAWN):  # every number in between, or at one of its ends, as often as not
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
    step = FIRST
    while point.size and step >= LAST and np.isfinite(value):
        moves = [np.clip(point + sign * step * axis, 0, 1) for axis in np.eye(point.size) for sign in (1, -1)]
        values = [need(move) if (move != point).any() else -np.inf for move in moves]
        best = int(np.argmax(values))
        if values[best] > value:
            point, value = moves[best], values[best]
        else:
            step /= 2
    return point, value


# ----------------------------------------------------------------------------------------------------
# What a guarantee for a set of environments costs: the robust coupling beside the one made for the nominal one.


@dataclass(frozen=True)
class Cost:
    """One coupling over the members of a set, in which it runs on the current environment."""

    name: str
    ratio: tuple[float, float]  # required over available damping: in the nominal environment, and the most
    violated: int  # members at which the this-environment condition fails
    rms_db: tuple[float, float]  # mismatch: in the nominal environment, and at its worst vertex
    sup_db: tuple[float, float]
    worst: str  # the vertex with the largest rms mismatch


def cost(name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> Cost:
    """Required damping and mismatch at every member; those that no device feels have no mismatch."""
    ratios, figures = [], {}
    for member in members:
        E = environment(member.network, loop.T)
        F = force_map(E, coupling, loop.theta, loop.psi)
        ratios.append(this_environment(F, loop.delta, loop.T_max, loop.latency).ratio)
        if E.D.any():
            figures[member.name] = transparency(F, E, loop.lam)
    nominal = figures[members[0].name]
    worst = max(figures, key=lambda member: figures[member].rms_mismatch)
    return Cost(
        name,
        (ratios[0], max(ratios)),
        sum(ratio >= 1 for ratio in ratios),
        (decibels(nominal.rms_mismatch), decibels(figures[worst].rms_mismatch)),
        (decibels(nominal.relative_mismatch), decibels(max(f.relative_mismatch for f in figures.values()))),
        worst,
    )


def price(loop: Loop, couplings: Mapping[str, Coupling]) -> tuple[Cost, ...]:
    """The cost of each coupling over the box of the loop."""
    members = loop.members()
    return tuple(cost(name, loop, coupling, members) for name, coupling in couplings.items())


def cost_part(row: Cost) -> dict[str, Any]:
    """The row as plain data; null for a mismatch of zero, or where no damping is enough."""
    pairs = {"required_over_available": row.ratio, "rms_mismatch_db": row.rms_db, "relative_mismatch_db": row.sup_db}
    figures = {name: dict(zip(("nominal", "worst"), map(finite, pair), strict=True)) for name, pair in pairs.items()}
    return {"coupling": row.name, "violated": row.violated, **figures, "worst": row.worst}


SAMPLES = 64  # environments drawn evenly from inside the box, beside what the search looks at

WHAT_IS_PROVED = (
    f"proved at the vertices; between them searched, not proved ({SEARCH}); every environment is frozen: nothing is "
    "proved of one that changes while it is touched"
)


@dataclass(frozen=True, eq=False)
class SetCheck:
    """The this-environment condition over a box. `members` and `at_members` are the environment and the vertices."""

    members: tuple[Member, ...]
    at_members: tuple[Requirement, ...]
    samples: tuple[Member, ...]
    at_samples: tuple[Requirement, ...]
    searched: Searched
    at_found: Requirement  # at the worst environment that the search has found
    seed: int
    certificate: Certificate | None  # of the whole set, with the guarantee "a set"
    reason: str | None  # why the set is not guaranteed

    @property
    def proved(self) -> bool:
        """At the environment and every vertex, in exact arithmetic, and no violation was found between them."""
        return self.certificate is not None and self.worst_found[1].certified

    @property
    def worst(self) -> tuple[Member, Requirement]:
        """Where among the members the most damping is asked."""
        i = worst(self.at_members)
        return self.members[i], self.at_members[i]

    @property
    def worst_found(self) -> tuple[Member, Requirement]:
        """Where of all that was looked at, members, search and samples, the most damping is asked."""
        places = (*self.members, self.searched.worst[0].member, *self.samples)
        requirements = (*self.at_members, self.at_found, *self.at_samples)
        i = worst(requirements)
        return places[i], requirements[i]


def check_set(
    loop: Loop,
    coupling: Coupling,
    seed: int = 0,
    samples: int = SAMPLES,
    progress: Progress = lambda done, total: None,
    searched: Searched | None = None,
    certificate: Certificate | None = None,
) -> SetCheck | None:
    """The coupling over the box of its loop, None where it has none.

    The search is the same every time; `samples` more points are drawn from inside, from the seed. `searched` and
    `certificate` are those of a design that has made them.
    """
    if loop.box is None:
        return None
    searched = searched or search_box(loop, coupling, progress)
    members, drawn = loop.members(), inside(loop.network, loop.box, samples, seed)
    try:
        certificate, reason = certificate or prove(loop, coupling, "this-environment"), None
    except NotProved as error:
        certificate, reason = None, str(error)
    at_members, at_samples = in_each(loop, coupling, members), in_each(loop, coupling, drawn)
    (at_found,) = in_each(loop, coupling, [searched.worst[0].member])
    check = SetCheck(
        members, tuple(at_members), drawn, tuple(at_samples), searched, at_found, seed, certificate, reason
    )
    if certificate and not check.proved:
        place, requirement = check.worst_found
        check = replace(check, reason=violated_between(place, requirement.ratio))
    return check


def search_box(loop: Loop, coupling: Coupling, progress: Progress = lambda done, total: None) -> Searched:
    """The worst environments of the loop's box that the search of design.box.worst_member finds."""
    assert loop.box
    parts = regions(loop.network, loop.box)
    return search(parts, lambda member: in_each(loop, coupling, [member])[0].ratio, progress)


def violated_between(place: Member, ratio: float) -> str:
    """Why a coupling that is proved at every vertex has no guarantee for the set."""
    needs = f"{ratio:.4f} of the damping is needed" if np.isfinite(ratio) else "no damping is enough"
    return f"proved at the vertices, but violated between them: {needs} at {place.name}"


def set_part(check: SetCheck) -> dict[str, Any]:
    """The check as plain data; SI units, null where no damping is enough."""
    member, requirement = check.worst
    part: dict[str, Any] = {
        "vertices": len(check.members) - 1,
        "vertices_certified": sum(r.certified for r in check.at_members[1:]),
        "required_damping": [finite(d) for d in requirement.required],
        "available_damping": list(requirement.available),
        "worst": member.name,
        "proof": "rational" if check.certificate else "sampled",
        "certified": check.proved,
        "search": search_part(check.searched),
        "inside": _inside_part(check),
        "what": WHAT_IS_PROVED,
    }
    return part | ({"reason": check.reason} if check.reason else {})


def search_part(searched: Searched) -> dict[str, Any]:
    """What the search between the vertices has found: evidence, no proof."""
    worst = searched.worst[0]
    return {
        "how": SEARCH,
        "environments": searched.tried,
        "worst_ratio": finite(worst.ratio),
        "worst": worst.member.name,
        "violated": not worst.ratio < 1,
    }


def search_words(part: dict[str, Any]) -> str:
    """What was found between the vertices, in a line."""
    found = "[red]violated[/]" if part["violated"] else "no violation found"
    ratio = "no damping is enough" if part["worst_ratio"] is None else f"worst ratio {part['worst_ratio']:.4f}"
    return f"searched, not proved: {found}, {ratio} in {part['environments']} points, at {part['worst']}"


def _inside_part(check: SetCheck) -> dict[str, Any]:
    """What was found in the environments drawn from inside: evidence, no proof."""
    if not check.samples:
        return {"samples": 0, "certified": 0, "seed": check.seed, "worst_ratio": None, "worst": None}
    i = worst(check.at_samples)
    return {
        "samples": len(check.samples),
        "certified": sum(r.certified for r in check.at_samples),
        "seed": check.seed,
        "worst_ratio": finite(check.at_samples[i].ratio),
        "worst": check.samples[i].name,
    }


def set_rows(part: dict[str, Any]) -> list[tuple[str, str]]:
    """The part of a report as rows of a table."""
    ratios = [d / a for d, a in zip(part["required_damping"], part["available_damping"], strict=True) if d is not None]
    most = f"{max(ratios):.4f} of the damping" if ratios else "no damping is enough"
    exact = part["proof"] == "rational"
    proof = "[green]proved exactly[/] at all" if exact else f"[red]not proved[/]: {part['reason']}"
    found, count = part["inside"], part["vertices"]
    rows = [
        ("set, vertices", f"{part['vertices_certified']} of {count} certified, {proof}"),
        ("set, worst vertex", f"{most}, at {part['worst']}"),
        ("set, between", search_words(part["search"])),
    ]
    if found["samples"]:
        ratio = "no damping is enough" if found["worst_ratio"] is None else f"at most {found['worst_ratio']:.4f}"
        inside = f"{found['certified']} of {found['samples']} random samples certified, {ratio} of the damping"
        rows.append(("set, inside", inside))
    if exact and not part["certified"]:
        rows.append(("set", f"[red]not guaranteed[/]: {part['reason']}"))
    return rows
