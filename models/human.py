"""Human hands as passive one-ports, people who hold several devices as multi-ports, and their voluntary motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from models.device import require

Array = NDArray[np.floating[Any]]
Range = tuple[float, float]


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mass and the spring-damper behind it, which ends at the next mass or at the moving equilibrium."""

    mass: float  # [kg]
    damping: float  # [N s/m]
    stiffness: float  # [N/m]

    def __post_init__(self) -> None:
        require("mass", self.mass, 0.0, 1e3, "kg")
        require("damping", self.damping, 0.0, 1e6, "N s/m")
        require("stiffness", self.stiffness, 0.0, 1e9, "N/m")


class Voluntary(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The equilibrium moves as amplitude sin(2 pi frequency t + phase), eased in by a raised cosine."""

    amplitude: float  # [m]
    frequency: float  # [Hz]
    phase: float = 0.0  # [rad]
    ease: float = 1.0  # [s]

    def __post_init__(self) -> None:
        require("amplitude", self.amplitude, 0.0, 1.0, "m")
        require("frequency", self.frequency, 0.0, 100.0, "Hz")
        require("phase", self.phase, -100.0, 100.0, "rad")
        require("ease", self.ease, 0.0, 1e4, "s")

    def motion(self, t: Array) -> tuple[Array, Array]:
        """Equilibrium position [m] and velocity [m/s] at times t [s]."""
        w = 2 * np.pi * self.frequency
        wave = self.amplitude * np.sin(w * t + self.phase)
        wave_rate = self.amplitude * w * np.cos(w * t + self.phase)
        if self.ease == 0:
            return wave, wave_rate
        rising = t < self.ease
        gain = np.where(rising, (1 - np.cos(np.pi * t / self.ease)) / 2, 1.0)
        gain_rate = np.where(rising, np.pi / (2 * self.ease) * np.sin(np.pi * t / self.ease), 0.0)
        return gain * wave, gain_rate * wave + gain * wave_rate


class Human(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A chain of masses and spring-dampers, from the handle to the equilibrium.

    Passive by construction: no parameter can be negative. One link is the usual mass-damper-spring hand; two
    are a hand on a grip on an arm; without damping it is a lossless ladder.
    """

    links: Annotated[tuple[Link, ...], msgspec.Meta(min_length=1)]
    voluntary: Voluntary | None = None

    def __post_init__(self) -> None:
        for i, link in enumerate(self.links[1:], start=1):
            if link.mass == 0:
                raise ValueError(f"links[{i}].mass is 0: only the mass at the handle may be missing")

    def voluntary_force(self, t: Array) -> Array:
        """k x_eq + b x_eq' [N] on the last mass, at times t [s]."""
        if self.voluntary is None:
            return np.zeros_like(t)
        position, velocity = self.voluntary.motion(t)
        return self.links[-1].stiffness * position + self.links[-1].damping * velocity


class Cross(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spring-damper from hand to hand of one person."""

    damping: float = 0.0  # [N s/m]
    stiffness: float = 0.0  # [N/m]

    def __post_init__(self) -> None:
        require("damping", self.damping, 0.0, 1e6, "N s/m")
        require("stiffness", self.stiffness, 0.0, 1e9, "N/m")


class Person(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Somebody who holds several devices: a passive mechanical multi-port.

    The arms of these channels' humans end on this person's body instead of on ground: a mass with a spring-damper
    to ground. `cross` joins each hand to the next, in the order of `holds`.
    """

    holds: tuple[int, ...]  # channels, counted from 1
    mass: float  # [kg] of the body
    damping: float  # [N s/m] between body and ground
    stiffness: float  # [N/m]
    cross: Cross = Cross()

    def __post_init__(self) -> None:
        if len(self.holds) < 2 or len(set(self.holds)) < len(self.holds) or min(self.holds) < 1:
            raise ValueError(f"holds is {list(self.holds)}, expected two or more different channels, counted from 1")
        require("mass", self.mass, 1e-6, 1e3, "kg")
        require("damping", self.damping, 0.0, 1e6, "N s/m")
        require("stiffness", self.stiffness, 0.0, 1e9, "N/m")


def check_holds(persons: Sequence[Person], channels: int) -> None:
    """Raise ValueError where somebody holds what is not there or what another one holds."""
    held: set[int] = set()
    for i, person in enumerate(persons):
        for channel in person.holds:
            if channel > channels:
                raise ValueError(f"person[{i}].holds has channel {channel}, allowed are 1 to {channels}")
            if channel in held:
                raise ValueError(f"person[{i}].holds has channel {channel}, which somebody else holds already")
        held.update(person.holds)


class Population(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Random humans: every parameter log-uniform in its range, one link (a hand) or two (hand, grip and arm)."""

    mass: Range = (0.01, 3.0)  # [kg]
    damping: Range = (0.1, 30.0)  # [N s/m]
    stiffness: Range = (1.0, 2000.0)  # [N/m]
    links: int = 1

    def __post_init__(self) -> None:
        for name, unit in (("mass", "kg"), ("damping", "N s/m"), ("stiffness", "N/m")):
            low, high = getattr(self, name)
            require(f"{name}[0]", low, 1e-9, 1e9, unit)
            require(f"{name}[1]", high, low, 1e9, unit)
        require("links", self.links, 1, 8, "links")

    def draw(self, rng: np.random.Generator, n: int) -> list[Human]:
        """n humans without voluntary motion."""
        ranges = np.log([self.mass, self.damping, self.stiffness])
        values = np.exp(rng.uniform(ranges[:, 0], ranges[:, 1], size=(n, self.links, 3)))
        return [Human(tuple(Link(*link) for link in human)) for human in values.tolist()]
