"""Robustness: the damping that a coupling requires in environments near the environment of its design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.environment import Network
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.ranges import Ranges, UncertainSpring
from haptic_loop.design.conditions import Condition
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.files import InputError
from haptic_loop.design.result import ANY, suffices

#: More than _FEW environments are first compared at every _THIN-th frequency. Only environments within _NEAR (relative)
#: of the worst ratio are then swept at all frequencies.
_FEW, _THIN, _NEAR = 12, 12, 0.03
_PERCENT = 10.0  # change of a parameter in reports


@dataclass(frozen=True)
class Robustness:
    """The worst requirement of a coupling in the nominal environment and in `vertices`, which differ by `percent`."""

    percent: float
    required_over_available: float  # required over available damping in the worst environment
    where: str  # the parameter that differs in the worst environment, with its sign, or "nominal"
    certified: bool  # whether the condition holds in the worst environment


def vertices(network: Network, percent: float = _PERCENT) -> dict[str, Network]:
    """Return networks by name, each with one spring, all springs or one mass changed by plus or minus `percent`.

    Raises InputError if a changed stiffness or mass would exceed the largest that a network may have.
    """
    try:
        return _vertices(network, percent)
    except ValueError as error:
        raise InputError(f"environment: no robustness to {percent:g} % can be computed: {error}") from None


def _vertices(network: Network, percent: float) -> dict[str, Network]:
    vertices = {}
    stiff = [i for i, spring in enumerate(network.springs) if spring.stiffness > 0]
    for sign, factor in (("+", 1 + percent / 100), ("-", 1 - percent / 100)):

        def stiffer(which: Sequence[int], factor: float = factor) -> Network:
            springs = [
                msgspec.structs.replace(spring, stiffness=spring.stiffness * factor) if i in which else spring
                for i, spring in enumerate(network.springs)
            ]
            return msgspec.structs.replace(network, springs=tuple(springs))

        for i in stiff:
            ends = network.springs[i].between
            alike = [j for j in stiff if network.springs[j].between == ends]
            which = f", spring {alike.index(i) + 1} of {len(alike)}" if len(alike) > 1 else ""
            vertices[f"{sign}{percent:g} % stiffness between {' and '.join(ends)}{which}"] = stiffer([i])
        if len(stiff) > 1:
            vertices[f"{sign}{percent:g} % stiffness of all springs"] = stiffer(stiff)
        for node, mass in network.masses.items():
            if mass > 0:
                masses = {**network.masses, node: mass * factor}
                vertices[f"{sign}{percent:g} % mass of {node}"] = msgspec.structs.replace(network, masses=masses)
    return vertices


def robustness(loop: Loop, coupling: Coupling, condition: Condition = THIS_ENVIRONMENT) -> Robustness:
    """Return the worst requirement in the environment and in `vertices`, by the refined sweep of the condition.

    If there are many vertices and delays are constant, a coarse sweep first selects the vertices near the worst one.
    """
    networks = {"nominal": loop.environment, **vertices(loop.network)}
    loops = {name: loop.at(one) for name, one in networks.items()}
    order, rough = list(loops), dict.fromkeys(loops, np.inf)
    if len(loops) > _FEW and not loop.varying_delay:  # There is no coarse sweep for delays that switch.
        rough = {name: condition.ratio(each, coupling, _THIN) for name, each in loops.items()}
        order.sort(key=lambda name: -rough[name])
    worst, where = 0.0, "nominal"
    for name in order:
        if rough[name] < (1 - _NEAR) * worst:
            break
        ratio = condition.ratio(loops[name], coupling)
        if ratio > worst:
            worst, where = ratio, name
    return Robustness(_PERCENT, worst, where, suffices(worst))


def robustness_nearby(loop: Loop, coupling: Coupling, condition: Condition = THIS_ENVIRONMENT) -> Robustness | None:
    """Return `robustness`, or None if it does not apply.

    It applies to networks without walls and blocks E(z), whose values may be increased by ten percent. The condition
    must cover the loop, be evaluated for varied loops (`not_varied`), and not hold in any environment.
    """
    if condition.guarantee(loop) == ANY or condition.not_varied(loop) or condition.beyond(loop.at(loop.environment)):
        return None
    if loop.environment.walls or not isinstance(loop.environment, Network) or loop.environment.block:
        return None
    try:
        vertices(loop.network)
    except InputError:
        return None
    return robustness(loop, coupling, condition=condition)


def ranges_around(network: Network, percent: float) -> Ranges:
    """Return ranges in which every stiffness and every mass varies by `percent`, independently of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
