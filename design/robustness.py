"""What an optimal or any other coupling is worth where the environment is not quite the one it was designed for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from controller.coupling import Coupling
from controller.environment import Network
from controller.loop import Loop
from controller.ranges import Ranges, UncertainSpring
from design.environments import ratio_in


@dataclass(frozen=True)
class Robustness:
    """What a coupling needs where the environment is not quite the one that it was designed for."""

    percent: float
    required_over_available: float  # of the damping, at the worst
    where: str  # which parameter, and which way
    certified: bool  # there


def at(loop: Loop, network: Network) -> Loop:
    """The loop around this environment, its delays constant."""
    return loop.at(network).switching(None)


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


def robustness(loop: Loop, coupling: Coupling, percent: float = 10.0) -> Robustness:
    """The worst need of a coupling over `vertices`, by the refined sweep."""
    worst, where = 0.0, "nominal"
    for name, network in {"nominal": loop.environment, **vertices(loop.network, percent)}.items():
        ratio = ratio_in(at(loop, network), coupling)
        if ratio > worst:
            worst, where = ratio, name
    return Robustness(percent, worst, where, worst < 1)


def robustness_nearby(loop: Loop, coupling: Coupling) -> Robustness | None:
    """The worst need within ten percent; None with walls, and for what is not all springs and masses."""
    if loop.environment.walls or not isinstance(loop.environment, Network) or loop.environment.block:
        return None
    return robustness(loop, coupling)


def ranges_around(network: Network, percent: float) -> Ranges:
    """Every stiffness and every mass this much more or less, each independent of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
