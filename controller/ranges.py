"""Uncertain environments: ranges of a network's parameters, their vertices, and random points within them.

At a vertex every uncertain parameter is at an end of its range, and every spring that may be absent is present or
absent. An absent spring remains in its network with neither stiffness nor damping.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from random import Random
from typing import Any

import msgspec
import numpy as np

from haptic_loop.controller.environment import GROUND, MOST_AMOUNT, Network, Spring
from haptic_loop.controller.lti import Array

_Range = tuple[float, float]

_MOST_VERTICES = 128  # each vertex is an environment of the design and needs a proof


class UncertainSpring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ranges of one spring's parameters; a parameter without a range has the environment's value."""

    between: tuple[str, str]
    stiffness: _Range | None = None  # [N/m]
    damping: _Range | None = None  # [N s/m]
    absent: bool = False  # whether the spring may also be absent, as before or after a contact

    def __post_init__(self) -> None:
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_range(f"{name} between {' and '.join(self.between)}", getattr(self, name), unit)


class Ranges(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ranges of a network's parameters, each independent of the others."""

    springs: tuple[UncertainSpring, ...] = ()
    masses: dict[str, _Range] = {}  # [kg], by node or point

    def __post_init__(self) -> None:
        for node, limits in self.masses.items():
            _check_range(f"mass of {node!r}", limits, "kg")


@dataclass(frozen=True)
class Member:
    """One environment within ranges."""

    name: str
    network: Any  # a Network if there are ranges, otherwise any Environment


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the ranges with a fixed set of present springs, in which only numbers vary."""

    low: Array  # (n,) the lower ends of the ranges
    high: Array  # (n,) the upper ends
    at: Callable[[str, Array], Member]  # (name, point between low and high) -> the member at this point


def members(network: Network, ranges: Ranges) -> tuple[Member, ...]:
    """Return the nominal environment, then the other vertices: all of them, or those among 128 selected vertices.

    If the nominal environment is one of these 128, the other 127 follow it. Raises ValueError with the field's name if
    the ranges do not fit the network or have too many parameters.
    """
    parts = _parts(network, ranges)
    corners = dict.fromkeys(tuple(p.corners[i] for p, i in zip(parts, at, strict=True)) for at in _vertices(parts))
    corners.pop(tuple(part.own for part in parts), None)
    vertices = (_member(f"vertex {i}", network, parts, corner) for i, corner in enumerate(corners, start=1))
    return (Member("the nominal environment", network), *vertices)


def number_of_vertices(network: Network, ranges: Ranges) -> int:
    """Return the number of vertices; an absent spring counts once, whatever the ends of its ranges."""
    return prod(len(part.corners) for part in _parts(network, ranges))


def _vertices(parts: Sequence[_Part]) -> Iterable[tuple[int, ...]]:
    """Return each vertex as the numbers of the parts' corners: all, or 128 vertices.

    The 128 vertices are the words of a linear code, numbered from 0. Each bit of a corner's number has a
    mask, and equals the parity of the bitwise AND of the word's number and this mask. All masks have the highest bit,
    so that the sum of two masks is never a mask. Any three masks are therefore independent, and any three pairs of
    ends meet in every combination.
    A spring with ranges that may also be absent is an exception. It usually has 3 or 5 corners, so that several words
    give the same vertex, and some combinations may be missing. Random vertices then replace these words.
    """
    sizes = [len(part.corners) for part in parts]
    if prod(sizes) <= _MOST_VERTICES:
        return product(*map(range, sizes))
    bits, half = [(size - 1).bit_length() for size in sizes], _MOST_VERTICES // 2
    if sum(bits) > half:
        raise ValueError(f"ranges have {sum(bits)} pairs of ends, allowed are {half}: leave out some")
    single = [0, *(1 << i for i in range(half.bit_length() - 1)), half - 1]
    masks = iter([half + low for low in dict.fromkeys([*single, *range(half)])])
    own = [[next(masks) for _ in range(count)] for count in bits]
    vertices = dict.fromkeys(
        tuple(
            sum(((word & mask).bit_count() & 1) << i for i, mask in enumerate(bit_masks)) % size
            for bit_masks, size in zip(own, sizes, strict=True)
        )
        for word in range(_MOST_VERTICES)
    )
    rng = Random(0)  # The numbers of `random()` are the same in every version of Python.
    while len(vertices) < _MOST_VERTICES:
        vertices.setdefault(tuple(int(rng.random() * size) for size in sizes))
    return vertices


def where_proved(network: Network, ranges: Ranges) -> str:
    """Return in words which vertices are members: "every vertex", or "128 of 625 vertices"."""
    count = number_of_vertices(network, ranges)
    return "every vertex" if count <= _MOST_VERTICES else f"{_MOST_VERTICES} of {count} vertices"


def regions(network: Network, ranges: Ranges) -> tuple[Region, ...]:
    """Return the ranges as one region for every combination of present and absent springs."""
    parts = _parts(network, ranges)
    choices = product(*((True, False) if part.absent else (True,) for part in parts))
    return tuple(_region(network, parts, present) for present in choices)


def inside(network: Network, ranges: Ranges, count: int, seed: int) -> tuple[Member, ...]:
    """Draw `count` environments uniformly from the ranges.

    A spring that may be absent is absent with probability 1/2. A larger `count` only adds environments at the end.
    """
    parts, rng = _parts(network, ranges), np.random.default_rng(seed)
    return tuple(_member(f"sample {i}", network, parts, [p.draw(rng) for p in parts]) for i in range(1, count + 1))


@dataclass(frozen=True)
class _Part:
    """One uncertain part: a spring with ranges of stiffness and damping, or a mass with one range."""

    place: str  # a spring's ends, or a node
    own: Spring | float  # the part as it is in the environment
    ranges: tuple[_Range, ...]  # of stiffness [N/m] and damping [N s/m], or of the mass [kg]; the width may be 0
    absent: Spring | None = None  # the spring without stiffness and damping, if the spring may be absent

    def at(self, *values: float) -> Spring | float:
        """Return the present part with one value for each range."""
        if isinstance(self.own, Spring):
            return Spring(self.own.between, *values, along=self.own.along)
        return values[0]

    @cached_property
    def corners(self) -> list[Spring | float]:
        """The part at every combination of the ends of its ranges, and the absent spring if it may be absent."""
        corners = [self.at(*values) for values in dict.fromkeys(product(*self.ranges))]
        return corners if self.absent is None or self.absent in corners else [*corners, self.absent]

    def draw(self, rng: np.random.Generator) -> Spring | float:
        """Draw the part; a spring that may be absent is absent with probability 1/2."""
        present = self.at(*(rng.uniform(low, high) for low, high in self.ranges))
        coin = rng.random() if isinstance(self.own, Spring) else 1.0
        return self.absent if self.absent and coin < 0.5 else present

    def label(self, value: Spring | float) -> str:
        if not isinstance(value, Spring):
            return f"{self.place} {value:.4g} kg"
        if not (value.stiffness or value.damping):
            return f"{self.place} absent"
        return f"{self.place} {value.stiffness:.4g} N/m, {value.damping:.4g} N s/m"


def _parts(network: Network, ranges: Ranges) -> list[_Part]:
    if network.block:
        raise ValueError("ranges with environment.block are not possible: only springs, dampers and masses have ranges")
    if not (ranges.springs or ranges.masses):
        raise ValueError("ranges are empty: give springs or masses whose parameters have ranges")
    named = [frozenset(one.between) for one in ranges.springs]
    for one, ends in zip(ranges.springs, named, strict=True):
        if named.count(ends) > 1:
            raise ValueError(f"ranges.springs lists {' and '.join(one.between)} twice")
    return [
        *(_spring_part(network, one) for one in ranges.springs),
        *(_mass_part(network, *m) for m in ranges.masses.items()),
    ]


def _spring_part(network: Network, uncertain: UncertainSpring) -> _Part:
    a, b = uncertain.between
    field = f"ranges.springs between {a} and {b}"
    for node in (a, b):
        if node not in (*network.points, *network.nodes(), GROUND):
            names = network.points or network.nodes()
            raise ValueError(f"{field}: there is no node {node!r}; nodes: {', '.join(names)}, ground")
    springs = [spring for spring in network.springs if set(spring.between) == {a, b}]
    if any(spring.inertance for spring in springs):
        raise ValueError(f"{field}: the spring there has an inertance; give ranges to springs without inertance")
    if len(springs) > 1:
        raise ValueError(f"{field}: the environment has {len(springs)} springs there, expected one")
    if springs:
        own = springs[0]
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            if limits := getattr(uncertain, name):
                _require_inside(f"{field}: {name}", limits, getattr(own, name), unit)
    elif uncertain.absent and uncertain.stiffness:
        own = Spring((a, b), 0.0, 0.0)
    else:
        raise ValueError(f"{field}: no spring is there; for a contact that may arise give stiffness and absent = true")
    stiffness = uncertain.stiffness or (own.stiffness, own.stiffness)
    damping = uncertain.damping or (own.damping, own.damping)
    if not uncertain.absent and stiffness[0] == stiffness[1] and damping[0] == damping[1]:
        raise ValueError(f"{field}: nothing is uncertain; give stiffness or damping a range, or absent = true")
    absent = Spring(own.between, 0.0, 0.0, along=own.along) if uncertain.absent else None
    return _Part(f"{a}-{b}", own, (stiffness, damping), absent)


def _mass_part(network: Network, node: str, limits: _Range) -> _Part:
    if node not in (*network.points, *network.nodes()):
        names = network.points or network.nodes()
        raise ValueError(f"ranges.masses lists {node!r}, which no spring or wall reaches; nodes: {', '.join(names)}")
    own = network.masses.get(node, 0.0)
    _require_inside(f"ranges.masses.{node}", limits, own, "kg")
    if limits[0] == limits[1]:
        raise ValueError(f"ranges.masses.{node} is {limits[0]:g} to {limits[1]:g} kg: nothing is uncertain")
    return _Part(node, own, (limits,))


def _region(network: Network, parts: Sequence[_Part], present: Sequence[bool]) -> Region:
    """Return the region in which these parts are present. A range of width 0 is no coordinate of the region."""
    free = [r for part, here in zip(parts, present, strict=True) if here for r in part.ranges if r[0] < r[1]]
    low, high = np.array(free, dtype=float).reshape(-1, 2).T

    def at(name: str, point: Array) -> Member:
        coordinates, values = iter(point.tolist()), []
        for part, here in zip(parts, present, strict=True):
            amounts = (next(coordinates) if least < most else least for least, most in part.ranges)
            values.append(part.at(*amounts) if here else part.absent)
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
    return Member(f"{name} ({labels})", msgspec.structs.replace(network, springs=tuple(springs), masses=masses))


def _require_inside(field: str, limits: _Range, own: float, unit: str) -> None:
    if not limits[0] <= own <= limits[1]:
        raise ValueError(
            f"{field} is {limits[0]:g} to {limits[1]:g} {unit}, expected a range with the environment's value {own:g}"
        )


def _check_range(field: str, limits: _Range | None, unit: str) -> None:
    if limits is not None and not 0 <= limits[0] <= limits[1] <= MOST_AMOUNT[unit]:
        expected = f"[least, most] in {unit}, 0 <= least <= most <= {MOST_AMOUNT[unit]:g}"
        raise ValueError(f"{field} is {list(limits)}, expected {expected}")
