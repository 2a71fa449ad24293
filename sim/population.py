"""Random passive humans, each from its own seed: human i is the same whoever draws it, and with whom."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from models.crowd import Crowd
from models.human import Population

MIXED = 0  # as a number of links: half the humans are simple, half are networks of two links


def draw(population: Population, channels: int, seed: int, index: int, links: int) -> Array:
    """Links of the humans with this index, one per channel: (channels, links, 3) as in Crowd.

    They depend on (seed, index) and the population only. `links` = MIXED tosses a coin between 1 and 2.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    count = int(rng.integers(1, 3)) if links == MIXED else links
    low, high = np.log([population.mass, population.damping, population.stiffness]).T
    return np.exp(rng.uniform(low, high, size=(channels, count, 3)))


def crowds(
    population: Population, channels: int, seed: int, indices: Iterable[int], links: int
) -> Iterator[tuple[NDArray[np.intp], Crowd]]:
    """The humans of these indices, grouped by their number of links: (indices of the group, crowd)."""
    drawn = {i: draw(population, channels, seed, i, links) for i in indices}
    for count in sorted({values.shape[1] for values in drawn.values()}):
        group = [i for i, values in drawn.items() if values.shape[1] == count]
        yield np.array(group), Crowd(np.stack([drawn[i] for i in group]))
