"""What an optimal or any other coupling is worth where the environment is not quite the one it was designed for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from controller.coupling import Coupling, ForceFilter
from controller.environment import Box, Network, UncertainSpring
from controller.loop import Loop
from design.conditions import this_environment
from design.optimal import at, compromise
from design.program import DEFAULT, Case, Options
from design.result import DesignFailed

_MINIMISED = {"rms": "rms_mismatch_db", "sup": "relative_mismatch_db"}


@dataclass(frozen=True)
class _Robustness:
    """What a coupling needs where the environment is not quite the one that it was designed for."""

    percent: float
    worst: float  # times the damping that there is
    where: str  # which parameter, and which way
    kept: bool  # whether it is certified there


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
        there = at(loop, network)
        if isinstance(coupling, ForceFilter):
            ratio = Case(there, there.E()).need(coupling)
        else:
            ratio = this_environment(there.F(coupling), loop.delta, loop.T_max, loop.latency).ratio
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
    mismatch, before = (getattr(one.figures, _MINIMISED[options.objective]) for one in (wide, alone))
    return _Spread(mismatch, mismatch - before, wide.g, robustness(loop, wide.coupling, percent).worst)


def box_around(network: Network, percent: float) -> Box:
    """Every stiffness and every mass this much more or less, each independent of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Box(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
