"""Which gains are stable with every human of a population: the exact loop's eigenvalues over humans x gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti
from models.crowd import Crowd, variants
from models.device import Device
from models.human import Population
from models.scene import Scene
from sim.exact_engine import HeldPlant, hold
from sim.population import crowds
from sim.stability import close

#: slower modes [Hz] decay so little that they would hide an oscillation that is about to grow
AUDIBLE = 2.0
LEADING = 0.1  # share of the humans that meet every coupling; the rest meet those that are stable with them


@dataclass(frozen=True, eq=False)
class Holders:
    """The devices in the hands of every human, sampled; in groups of humans with the same number of links."""

    #: (index of each human, who, plant, positions of motors and handles in its state)
    groups: tuple[tuple[NDArray[np.intp], Crowd, HeldPlant, tuple[int, ...]], ...]

    def __len__(self) -> int:
        return sum(index.size for index, *_ in self.groups)

    def links(self, human: int) -> Array:
        """(m, links, 3) of one human, as in Crowd."""
        for index, crowd, *_ in self.groups:
            if human in index:
                return crowd.links[int(np.flatnonzero(index == human)[0])]
        raise IndexError(f"human {human} of {len(self)}")

    def growth(self, F: Lti, humans: NDArray[np.bool_] | None = None, audible: float = AUDIBLE) -> tuple[Array, Array]:
        """Growth [1/s] of the dominant mode and of the dominant one above `audible` [Hz], with every human (n,).

        Where `humans` (n,) is false nothing is computed, and the answer is -inf.
        """
        n = len(self)
        everything, heard = np.full((2, n), -np.inf)
        for index, _, plants, _ in self.groups:
            chosen = np.ones(index.size, dtype=bool) if humans is None else humans[index]
            if not chosen.any():
                continue
            some = HeldPlant(plants.A[chosen], plants.B[chosen], plants.C, plants.T)
            values = np.linalg.eigvals(close(some, F).A)
            size = np.abs(values)
            turning = np.abs(np.angle(values)) >= 2 * np.pi * audible * plants.T
            with np.errstate(divide="ignore"):
                everything[index[chosen]] = np.log(size.max(axis=1)) / plants.T
                heard[index[chosen]] = np.log(np.where(turning, size, 0.0).max(axis=1)) / plants.T
        return everything, heard

    def mode(self, F: Lti, human: int, audible: float) -> Array:
        """The dominant mode above `audible` [Hz] with one human, as a state [s; z]: the motor or handle that moves most
        moves by 1 m."""
        index, _, plants, seen = next(group for group in self.groups if human in group[0])
        i = int(np.flatnonzero(index == human)[0])
        values, vectors = np.linalg.eig(close(HeldPlant(plants.A[i], plants.B[i], plants.C, plants.T), F).A)
        turning = np.abs(np.angle(values)) >= 2 * np.pi * audible * plants.T
        vector = vectors[:, np.argmax(np.where(turning, np.abs(values), 0.0))]
        positions = vector[list(seen)]
        return (vector / positions[np.argmax(np.abs(positions))]).real

    def leading(self, some: Sequence[Lti]) -> NDArray[np.bool_]:
        """The tenth (8 at least) of the humans that are unstable with most of these couplings, then nearest to it."""
        growths = np.array([self.growth(F)[1] for F in some])
        score = (growths > 0).sum(axis=0) + np.clip(growths, -100, 100).mean(axis=0) / 1000
        first = np.zeros(len(self), dtype=bool)
        first[np.argsort(-score, kind="stable")[: max(8, round(LEADING * len(self)))]] = True
        return first


def holders(devices: Sequence[Device], population: Population, seed: int, humans: int, links: int, T: float) -> Holders:
    """Random humans with the devices in their hands."""
    groups = []
    for index, crowd in crowds(population, len(devices), seed, range(humans), links):
        held_by = variants(devices, crowd)
        groups.append((index, crowd, hold(held_by.plants(), T), motors_and_handles(held_by.scene)))
    return Holders(tuple(groups))


def motors_and_handles(scene: Scene) -> tuple[int, ...]:
    """Their positions in a plant state; of a rigid device they are one."""
    return tuple(dict.fromkeys((*range(scene.channels), *scene.handles)))
