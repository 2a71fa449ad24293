"""Measure how tight this-environment and known-device are: find the worst hand for loops with too little damping."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from haptic_loop.controller.coupling import Coupling, NoCoupling
from haptic_loop.controller.lti import Array
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.sim.adversary import Worst, search
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.scenario import DEFAULT, Scenario, load


@dataclass(frozen=True)
class _Attack:
    """A search against a loop whose devices lack a share of the required damping."""

    name: str
    short: float  # share of the required damping that is missing
    worst: Worst


def attempts(
    loops: dict[str, tuple[Scenario, Coupling]],
    shortages: Array,
    seed: int = 0,
    generations: int = 150,
) -> list[_Attack]:
    """Attack every loop at every shortage: devices get (1 - short) times the damping that their condition requires.

    The condition is known-device if the devices have guaranteed bounds, otherwise this-environment.
    """
    rows = []
    for name, (scenario, coupling) in loops.items():
        loop = scenario.loop("I")
        condition = KNOWN_DEVICE if loop.known_devices else THIS_ENVIRONMENT
        F, required = loop.F(coupling), np.array(condition.required(loop, coupling).required)
        for short in shortages:
            placed = scenario.replace(delta=tuple((required * (1 - short)).tolist()))
            rows.append(_Attack(name, float(short), search(placed, F, seed, generations=generations, first=True)))
    return rows


@dataclass(frozen=True)
class Shortage:
    """Whether a passive human destabilises a loop whose devices lack a share of the required damping."""

    loop: str
    short: float
    found: bool
    growth_rate_per_s: float
    frequency_hz: float
    held_together: bool  # whether one person holds all devices
    evaluated: int

    @property
    def holds(self) -> bool:
        """Whether the theory holds: with the required damping no human makes the loop unstable."""
        return self.short > 0 or not self.found


def shortages(
    seed: int,
    couplings: Sequence[str],
    short: Sequence[float],
    generations: int,
    theta: tuple[int, int] | None = None,
    name: str = DEFAULT,
) -> Iterator[Shortage]:
    """Attack the loop of a scenario with each of the named couplings at each shortage."""
    scenario = load(name).replace(theta=theta) if theta else load(name)
    for kind in couplings:
        coupling = NoCoupling() if kind == "none" else choose(scenario, "I", kind).coupling
        loop = {"no coupling" if kind == "none" else f"{kind}, case I": (scenario, coupling)}
        for share in short:
            (attempt,) = attempts(loop, np.array([share]), seed, generations)
            worst, found = attempt.worst, (attempt.worst.destabilises, attempt.worst.growth)
            about = worst.frequency_hz, bool(worst.persons), worst.evaluated
            yield Shortage(attempt.name, attempt.short, *found, *about)


#: functions of a seed: short delays, known devices, and long delays
usual = partial(shortages, couplings=("none", "spring-damper"), short=(0, 0.01, 0.02, 0.05, 0.1, 0.2), generations=25)
known = partial(
    shortages,
    couplings=("none", "published"),
    short=(0, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02),
    generations=40,
    name="omega-pair-known",
)
delayed = partial(shortages, couplings=("none",), short=(0, 0.002, 0.005, 0.01, 0.02), generations=40, theta=(4, 9))
