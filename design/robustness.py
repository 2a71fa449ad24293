"""What an optimal or any other coupling is worth where the environment is not quite the one it was designed for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import msgspec

from controller.coupling import Coupling, ForceFilter
from controller.environment import Network, Ranges, UncertainSpring
from controller.loop import Loop
from design.environments import in_each, ratio_in
from design.optimal import at, compromise, design
from design.program import DEFAULT, Options
from design.result import DesignFailed, finite
from design.transparency import decibels

_MINIMISED = {"rms": "rms_mismatch", "sup": "relative_mismatch"}


@dataclass(frozen=True)
class _Robustness:
    """What a coupling needs where the environment is not quite the one that it was designed for."""

    percent: float
    worst: float  # times the damping that there is
    where: str  # which parameter, and which way
    kept: bool  # whether it is certified there

    def part(self) -> dict[str, Any]:
        """As plain data."""
        worst = finite(self.worst)
        return {
            "percent": self.percent,
            "required_over_available": worst,
            "where": self.where,
            "certified": self.kept,
        }


def vertices(network: Network, percent: float = 10.0) -> dict[str, Network]:
    """Every spring, all springs at once, and every mass, this much more or less; by name."""
    found = {}
    stiff = [i for i, spring in enumerate(network.springs) if spring.stiffness > 0]
    for sign, factor in (("+", 1 + percent / 100), ("-", 1 - percent / 100)):

        def stiffer(which: Sequence[int], factor: float = factor) -> Network:
            springs = [
                msgspec.structs.replace(spring, stiffness=spring.stiffness * factor) if i in which else spring
                for i, spring in enumerate(network.springs)
            ]
            return msgspec.structs.replace(network, springs=tuple(springs))

        for i in stiff:
            found[f"{sign}{percent:g} % stiffness between {' and '.join(network.springs[i].between)}"] = stiffer([i])
        if len(stiff) > 1:
            found[f"{sign}{percent:g} % stiffness of all springs"] = stiffer(stiff)
        for node, mass in network.masses.items():
            if mass > 0:
                masses = {**network.masses, node: mass * factor}
                found[f"{sign}{percent:g} % mass of {node}"] = msgspec.structs.replace(network, masses=masses)
    return found


def robustness(loop: Loop, coupling: Coupling, percent: float = 10.0) -> _Robustness:
    """The worst need of a coupling over `vertices`, by the refined sweep."""
    worst, where = 0.0, "nominal"
    for name, network in {"nominal": loop.environment, **vertices(loop.network, percent)}.items():
        ratio = ratio_in(at(loop, network), coupling)
        if ratio > worst:
            worst, where = ratio, name
    return _Robustness(percent, worst, where, worst < 1)


@dataclass(frozen=True)
class _Spread:
    """What it costs to keep the condition over `vertices`, too: two designs over one small basis."""

    mismatch_db: float  # of the design for the vertices, in the nominal environment
    price_db: float  # beside the design for the nominal environment alone
    g: float
    worst: float  # times the damping that there is, over the vertices


def spread(loop: Loop, options: Options = DEFAULT, percent: float = 10.0) -> _Spread | None:
    """The design for `vertices` beside the nominal one, by sweeps: a price, not a coupling to run. None without one."""
    try:
        alone, wide = compromise(loop, list(vertices(loop.network, percent).values()), options)
    except DesignFailed:
        return None
    mismatch, before = (decibels(getattr(one.figures, _MINIMISED[options.objective])) for one in (wide, alone))
    return _Spread(mismatch, mismatch - before, wide.g, robustness(loop, wide.coupling, percent).worst)


def robustness_parts(loop: Loop, coupling: Coupling, options: Options = DEFAULT) -> dict[str, Any]:
    """A report's `robustness` of a coupling for this environment, and what a design for that range would cost.

    The latter is null with walls, with ranges, and for a coupling that is no force filter.
    """
    alone = isinstance(coupling, ForceFilter) and not (loop.ranges or loop.environment.walls)
    price = spread(loop, options) if alone else None
    parts = price and {name: finite(value) for name, value in asdict(price).items()}
    return {"robustness": robustness_part(loop, coupling), "designed_for_it": parts}


def robustness_part(loop: Loop, coupling: Coupling) -> dict[str, Any] | None:
    """The worst need within ten percent as plain data; None with walls, and for an environment that is no network."""
    if loop.environment.walls or not isinstance(loop.environment, Network):
        return None
    return robustness(loop, coupling).part()


_MOST_RANGES = 7  # whose 128 vertices can all be proved


def widest_ranges(loop: Loop, percent: float) -> tuple[Ranges, str | None]:
    """Every stiffness and every mass this much more or less, and a note.

    Of more than MOST_RANGES those stay for which a small nominal design needs the most damping at their ends: the note
    names the others, which are taken as known.
    """
    whole = ranges_around(loop.network, percent)
    single = [Ranges(springs=(spring,)) for spring in whole.springs]
    single += [Ranges(masses={node: span}) for node, span in whole.masses.items()]
    if len(single) <= _MOST_RANGES:
        return whole, None
    small = design(loop.at(loop.network), replace(DEFAULT, ladder=DEFAULT.ladder[:1])).coupling

    def most(box: Ranges) -> float:
        there = msgspec.structs.replace(loop, ranges=box)
        return max(found.ratio for found in in_each(there, small, there.members()))

    ranked = sorted(single, key=most, reverse=True)
    kept, known = ranked[:_MOST_RANGES], ranked[_MOST_RANGES:]
    names = [f"stiffness {' and '.join(spring.between)}" for box in known for spring in box.springs]
    names += [f"mass {node}" for box in known for node in box.masses]
    note = (
        f"{len(single)} ranges have {2 ** len(single)} vertices, {2**_MOST_RANGES} can be proved: those that matter "
        f"most are kept; nothing is proved of the others, which are taken as known: {', '.join(names)}"
    )
    springs = tuple(spring for box in kept for spring in box.springs)
    return Ranges(springs, {node: span for box in kept for node, span in box.masses.items()}), note


def ranges_around(network: Network, percent: float) -> Ranges:
    """Every stiffness and every mass this much more or less, each independent of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
