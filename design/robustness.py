"""What an optimal or any other coupling is worth where the environment is not quite the one it was designed for."""

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
from haptic_loop.design.result import suffices

#: Of more environments than _FEW every _THIN-th frequency is looked at; only those that ask for the most there, or for
#: next to it, are swept whole.
_FEW, _THIN, _NEAR = 12, 12, 0.03


@dataclass(frozen=True)
class Robustness:
    """What a coupling needs where the environment is not quite the one that it was designed for."""

    percent: float
    required_over_available: float  # of the damping, at the worst
    where: str  # which parameter, and which way
    certified: bool  # there


@dataclass(frozen=True)
class Spread:
    """A design that keeps the condition over `vertices`, too: what it costs at most, for it is made in a short time."""

    mismatch_db: float  # of this design in the nominal environment
    price_db: float  # beside the nominal design
    g: float
    worst: float  # times the damping that there is, over the vertices
    states: int  # of the loop
    environments: int  # with the nominal one
    proved: int  # of these, in exact arithmetic; the others by the refined sweep, when the time for proofs was over
    reason: str | None = None  # or why the next one is not proved


@dataclass(frozen=True)
class Nearby:
    """What a coupling for this environment needs in one that is 10 % off, and what a design for that would cost."""

    robustness: Robustness | None = None
    designed_for_it: Spread | None = None


def at(loop: Loop, network: Network) -> Loop:
    """The loop around this environment, its delays constant."""
    return loop.at(network).switching(None)


def vertices(network: Network, percent: float = 10.0) -> dict[str, Network]:
    """Return networks with every spring, all springs at once, and every mass this much more or less, by name.

    Raises InputError where a stiffness or a mass would then be above the largest that a network may have.
    """
    try:
        return _vertices(network, percent)
    except ValueError as error:
        raise InputError(f"environment: no robustness to {percent:g} % can be computed: {error}") from None


def _vertices(network: Network, percent: float) -> dict[str, Network]:
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


def robustness(
    loop: Loop, coupling: Coupling, percent: float = 10.0, condition: Condition = THIS_ENVIRONMENT
) -> Robustness:
    """The worst need of a coupling over `vertices`, by the refined sweep of the condition.

    Of many a thinned sweep comes first, and only those that come near the worst are refined.
    """
    networks = {"nominal": loop.environment, **vertices(loop.network, percent)}
    loops = {name: at(loop, one) for name, one in networks.items()}
    order, rough = list(loops), dict.fromkeys(loops, np.inf)
    if len(loops) > _FEW:
        rough = {name: condition.ratio(each, coupling, _THIN) for name, each in loops.items()}
        order.sort(key=lambda name: -rough[name])
    worst, where = 0.0, "nominal"
    for name in order:
        if rough[name] < (1 - _NEAR) * worst:
            break
        ratio = condition.ratio(loops[name], coupling)
        if ratio > worst:
            worst, where = ratio, name
    return Robustness(percent, worst, where, suffices(worst))


def robustness_nearby(loop: Loop, coupling: Coupling, condition: Condition = THIS_ENVIRONMENT) -> Robustness | None:
    """The worst need within ten percent; None with walls, and for what is not all springs and masses."""
    if loop.environment.walls or not isinstance(loop.environment, Network) or loop.environment.block:
        return None
    return robustness(loop, coupling, condition=condition)


def ranges_around(network: Network, percent: float) -> Ranges:
    """Every stiffness and every mass this much more or less, each independent of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
