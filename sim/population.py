"""Random passive humans, each from its own seed: human i is the same whoever draws it, and with whom."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from models.crowd import Crowd
from models.human import Population
from sim.scenario import Scenario

MIXED = 0  # as a number of links: half the humans are simple, half are networks of two links


def draw(population: Population, channels: int, seed: int, index: int, links: int) -> Array:
    """Links of the humans with this index, one per channel: (channels, links, 3) as in Crowd.

    They depend on (seed, index) and the population only. `links` = MIXED tosses a coin between 1 and 2.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    count = int(rng.integers(1, 3)) if links == MIXED else links
    low, high = np.log([population.mass, population.damping, population.stiffness]).T
    return np.exp(rng.uniform(low, high, size=(channels, count, 3)))


def draw_bodies(population: Population, persons: int, seed: int, index: int) -> Array:
    """Bodies of the persons with this index who hold several devices: (persons, 5) as in Crowd, from the same ranges.

    Drawn apart from the links, which are the same whether or not somebody holds several devices.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    ranges = (population.mass, population.damping, population.stiffness, population.damping, population.stiffness)
    low, high = np.log(ranges).T
    return np.exp(rng.uniform(low, high, size=(persons, 5)))


def crowds(
    population: Population,
    channels: int,
    seed: int,
    indices: Iterable[int],
    links: int,
    holds: tuple[tuple[int, ...], ...] = (),
) -> Iterator[tuple[NDArray[np.intp], Crowd]]:
    """The humans of these indices, grouped by their number of links: (indices of the group, crowd).

    `holds` says which channels one person holds, as in Crowd.
    """
    drawn = {i: draw(population, channels, seed, i, links) for i in indices}
    for count in sorted({values.shape[1] for values in drawn.values()}):
        group = [i for i, values in drawn.items() if values.shape[1] == count]
        bodies = np.stack([draw_bodies(population, len(holds), seed, i) for i in group])
        yield np.array(group), Crowd(np.stack([drawn[i] for i in group]), holds, bodies)


def crowds_of(
    scenario: Scenario, seed: int, indices: Iterable[int], links: int
) -> Iterator[tuple[NDArray[np.intp], Crowd]]:
    """`crowds` for a scenario: of its population, and held together as its persons hold its devices."""
    holds = tuple(person.holds for person in scenario.person)
    return crowds(scenario.population, scenario.channels, seed, indices, links, holds)


def crowd_of(scenario: Scenario, seed: int, index: int, links: int) -> Crowd:
    """The one set of humans with this index."""
    ((_, crowd),) = crowds_of(scenario, seed, [index], links)
    return crowd
