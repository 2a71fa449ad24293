"""Environments that are not known exactly: a box around a network's parameters, its vertices, and points inside.

The vertices are the environments in which every uncertain parameter is at an end of its range, and every contact that
may be absent is there or not. An absent spring stays in its network with neither stiffness nor damping.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod

import msgspec
import numpy as np

from controller.environment import Network, Spring
from controller.lti import Array

Range = tuple[float, float]

MOST_VERTICES = 64  # each is a world of the design and a proof


class UncertainSpring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What may be of one spring; a range that is not given leaves the environment's own value."""

    between: tuple[str, str]
    stiffness: Range | None = None  # [N/m]
    damping: Range | None = None  # [N s/m]
    absent: bool = False  # the spring may also be missing altogether: a contact lost, or not made yet

    def __post_init__(self) -> None:
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_range(f"{name} between {' and '.join(self.between)}", getattr(self, name), unit)


class Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ranges of a network's parameters, each independent of the others."""

    springs: tuple[UncertainSpring, ...] = ()
    masses: dict[str, Range] = {}  # [kg], by node

    def __post_init__(self) -> None:
        for node, limits in self.masses.items():
            _check_range(f"mass of {node!r}", limits, "kg")


@dataclass(frozen=True)
class Member:
    """One environment of a set."""

    name: str
    network: Network


@dataclass(frozen=True)
class _State:
    """An uncertain thing that is there, or one that is absent: the ranges that it then has, and what it is in them."""

    ranges: tuple[Range, ...]  # those of some width
    value: Callable[[Sequence[float]], Spring | float]


@dataclass(frozen=True)
class _Part:
    """One uncertain thing: what it is at each of its vertices, and somewhere in between."""

    place: str  # a spring's ends, or a node
    corners: tuple[Spring | float, ...]
    own: Spring | float  # as it is in the environment
    draw: Callable[[np.random.Generator], Spring | float]
    states: tuple[_State, ...]  # there, or absent

    def label(self, value: Spring | float) -> str:
        if not isinstance(value, Spring):
            return f"{self.place} {value:.4g} kg"
        if not (value.stiffness or value.damping):
            return f"{self.place} absent"
        return f"{self.place} {value.stiffness:.4g} N/m, {value.damping:.4g} N s/m"


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a box in which nothing but numbers varies: which contacts are there and which absent is decided."""

    low: Array  # (n,) the ends of the ranges
    high: Array  # (n,)
    at: Callable[[str, Array], Member]  # a name, and a point between low and high


def members(network: Network, box: Box | None) -> tuple[Member, ...]:
    """The environment itself, then the vertices of its box that differ from it.

    Raises ValueError naming the field where the box does not fit the network, or has more than MOST_VERTICES vertices.
    """
    nominal = Member("the nominal environment", network)
    if box is None:
        return (nominal,)
    parts = _parts(network, box)
    count = prod(len(part.corners) for part in parts)
    if count > MOST_VERTICES:
        raise ValueError(
            f"box has {count} vertices, allowed are {MOST_VERTICES}: leave out the ranges that matter least, "
            "each halves the number"
        )
    corners = (c for c in product(*(part.corners for part in parts)) if c != tuple(part.own for part in parts))
    vertices = (_member(f"vertex {i}", network, parts, corner) for i, corner in enumerate(corners, start=1))
    return (nominal, *vertices)


def regions(network: Network, box: Box) -> tuple[Region, ...]:
    """The box as one region for every way in which its contacts can be there or absent."""
    parts = _parts(network, box)
    return tuple(_region(network, parts, states) for states in product(*(part.states for part in parts)))


def inside(network: Network, box: Box, count: int, seed: int) -> tuple[Member, ...]:
    """`count` environments drawn from the box: every range evenly, a contact that may be absent as often as not.

    The first are the same whatever the count.
    """
    parts, rng = _parts(network, box), np.random.default_rng(seed)
    return tuple(_member(f"sample {i}", network, parts, [p.draw(rng) for p in parts]) for i in range(1, count + 1))


def shrunk(network: Network, box: Box, factor: float) -> Box:
    """The box with every range drawn in towards the environment's own value; what may be absent still may."""

    def closer(limits: Range, own: float) -> Range:
        return own + factor * (limits[0] - own), own + factor * (limits[1] - own)

    springs = []
    for one in box.springs:
        own = next((s for s in network.springs if set(s.between) == set(one.between)), None)
        stiffness, damping = one.stiffness, one.damping
        if own:
            stiffness = stiffness and closer(stiffness, own.stiffness)
            damping = damping and closer(damping, own.damping)
        springs.append(UncertainSpring(one.between, stiffness, damping, one.absent))
    return Box(tuple(springs), {n: closer(r, network.masses.get(n, 0.0)) for n, r in box.masses.items()})


def _parts(network: Network, box: Box) -> list[_Part]:
    if not (box.springs or box.masses):
        raise ValueError("box is empty: give springs or masses whose parameters have ranges")
    named = [frozenset(one.between) for one in box.springs]
    for one, ends in zip(box.springs, named, strict=True):
        if named.count(ends) > 1:
            raise ValueError(f"box.springs names {' and '.join(one.between)} twice")
    return [
        *(_spring_part(network, one) for one in box.springs),
        *(_mass_part(network, *m) for m in box.masses.items()),
    ]


def _spring_part(network: Network, uncertain: UncertainSpring) -> _Part:
    a, b = uncertain.between
    field = f"box.springs between {a} and {b}"
    for node in (a, b):
        if node not in (*network.nodes(), "ground"):
            raise ValueError(f"{field}: there is no node {node!r}; nodes: {', '.join(network.nodes())}, ground")
    found = [spring for spring in network.springs if set(spring.between) == {a, b}]
    if len(found) > 1:
        raise ValueError(f"{field}: the environment has {len(found)} springs there, expected one")
    nothing = Spring((a, b), 0.0, 0.0)
    if found:
        own, present = found[0], found[0]
        _check_inside(field, uncertain, own)
    elif uncertain.absent and uncertain.stiffness:
        own, present = nothing, nothing
    else:
        raise ValueError(f"{field}: no spring is there; one that may come to be needs a stiffness and absent = true")
    stiffness = uncertain.stiffness or (present.stiffness, present.stiffness)
    damping = uncertain.damping or (present.damping, present.damping)
    if not uncertain.absent and stiffness[0] == stiffness[1] and damping[0] == damping[1]:
        raise ValueError(f"{field}: nothing is uncertain; give stiffness or damping a range, or absent = true")
    pairs = dict.fromkeys(product(stiffness, damping))
    corners = [Spring(own.between, k, d) for k, d in pairs]
    absent = Spring(own.between, 0.0, 0.0)
    if uncertain.absent and absent not in corners:
        corners.append(absent)

    def draw(rng: np.random.Generator) -> Spring:
        k, d, coin = rng.uniform(stiffness[0], stiffness[1]), rng.uniform(damping[0], damping[1]), rng.random()
        return absent if uncertain.absent and coin < 0.5 else Spring(own.between, k, d)

    states = [_spring_state(own.between, stiffness, damping)]
    if uncertain.absent:
        states.append(_State((), lambda _: absent))
    return _Part(f"{a}-{b}", tuple(corners), own, draw, tuple(states))


def _spring_state(between: tuple[str, str], stiffness: Range, damping: Range) -> _State:
    """A spring that is there; of its two ranges those without width are no coordinates."""
    free = [low < high for low, high in (stiffness, damping)]

    def value(point: Sequence[float]) -> Spring:
        given = iter(point)
        k, d = (next(given) if f else limits[0] for f, limits in zip(free, (stiffness, damping), strict=True))
        return Spring(between, float(k), float(d))

    return _State(tuple(r for f, r in zip(free, (stiffness, damping), strict=True) if f), value)


def _mass_part(network: Network, node: str, limits: Range) -> _Part:
    if node not in network.nodes():
        raise ValueError(f"box.masses names {node!r}, which no spring reaches; nodes: {', '.join(network.nodes())}")
    own = network.masses.get(node, 0.0)
    _require_inside(f"box.masses.{node}", limits, own, "kg")
    if limits[0] == limits[1]:
        raise ValueError(f"box.masses.{node} is {limits[0]:g} to {limits[1]:g} kg: nothing is uncertain")
    state = _State((limits,), lambda point: float(point[0]))
    return _Part(node, limits, own, lambda rng: rng.uniform(limits[0], limits[1]), (state,))


def _region(network: Network, parts: Sequence[_Part], states: Sequence[_State]) -> Region:
    low, high = np.array([r for state in states for r in state.ranges], dtype=float).reshape(-1, 2).T
    ends = np.cumsum([len(state.ranges) for state in states])[:-1]

    def at(name: str, point: Array) -> Member:
        values = [s.value(x.tolist()) for s, x in zip(states, np.split(point, ends), strict=True)]
        return _member(name, network, parts, values)

    return Region(low, high, at)


def _member(name: str, network: Network, parts: Sequence[_Part], values: Sequence[Spring | float]) -> Member:
    springs, masses = list(network.springs), dict(network.masses)
    for part, value in zip(parts, values, strict=True):
        if not isinstance(value, Spring):
            masses[part.place] = value
        elif part.own in springs:
            springs[springs.index(part.own)] = value
        else:
            springs.append(value)
    labels = "; ".join(part.label(value) for part, value in zip(parts, values, strict=True))
    return Member(f"{name} ({labels})", Network(network.contacts, tuple(springs), masses))


def _check_inside(field: str, uncertain: UncertainSpring, own: Spring) -> None:
    for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
        limits = getattr(uncertain, name)
        if limits:
            _require_inside(f"{field}: {name}", limits, getattr(own, name), unit)


def _require_inside(field: str, limits: Range, own: float, unit: str) -> None:
    if not limits[0] <= own <= limits[1]:
        raise ValueError(
            f"{field} is {limits[0]:g} to {limits[1]:g} {unit}, which leaves out the environment's own {own:g}"
        )


def _check_range(field: str, limits: Range | None, unit: str) -> None:
    if limits is not None and not 0 <= limits[0] <= limits[1] < np.inf:
        raise ValueError(f"{field} is {list(limits)}, expected [least, most] in {unit}, 0 <= least <= most")
