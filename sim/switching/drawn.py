"""The delays of a run: drawn from a scenario's jitter and a seed, or found worst for its loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from controller.coupling import Coupling
from controller.delay import Ticks
from controller.jitter import Jitter
from sim.exact_engine import HeldPlant
from sim.scenario import Scenario
from sim.simulate import Assembly
from sim.switching.switched import with_delays, without_theta
from sim.switching.worst import Period, greedy_ages, worst_period

SEARCHED = 1600  # ticks of greedy switching in which the worst period is sought
SHORTEST = 4  # ticks that are drawn at least: a growth compares quarters
STREAM = 5  # keeps these draws apart from those of the humans with the same seed and index


def draw_delays(scenario: Scenario, seed: int, index: int, ticks: int, given: Ticks | None = None) -> Ticks:
    """Delays (ticks, m) of run number `index`; they depend on (seed, index) and the scenario only."""
    assert scenario.jitter is not None
    rows = np.array([scenario.theta]) if scenario.jitter.pattern == "constant" else given
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, STREAM)))
    return scenario.jitter.draw(rng, ticks, rows)


def switching(
    assembly: Assembly, coupling: Coupling, seed: int, ticks: int, index: int = 0
) -> tuple[Assembly, Period | None]:
    """The loop with the scenario's varying delays, and their period where they are adversarial."""
    jitter = assembly.scenario.jitter
    assert jitter is not None
    period = adversary(assembly, coupling, jitter) if jitter.pattern == "adversarial" else None
    delays = draw_delays(assembly.scenario, seed, index, max(ticks, SHORTEST), period.delays if period else None)
    return with_delays(assembly, coupling, delays[:, :, None]), period


def adversary(assembly: Assembly, coupling: Coupling, jitter: Jitter) -> Period:
    """The periodic switching within the range that was found to grow fastest in this loop."""
    G = without_theta(assembly, coupling)
    process, plant = replace(assembly.process, F=G), assembly.plant
    one = HeldPlant(plant.A[None], plant.B[None], plant.C, plant.T)
    ages = greedy_ages(process, one, assembly.scene, jitter, SEARCHED)
    return worst_period(ages[:, :, 0], plant, G, jitter)
