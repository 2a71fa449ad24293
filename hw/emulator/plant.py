"""The plant of a scenario as a device sees it: encoders in counts, motors in steps, a person at every handle."""

from __future__ import annotations

import numpy as np

from controller.lti import Array
from models.human import Human, Link
from models.scene import build, plant
from sim.engines import hold, outside_forces
from sim.scenario import Scenario

STRETCH = 1000  # ticks of outside forces that are computed at once
SUBSTEPS = 8  # per tick where there is Coulomb friction
SLIP = 0.002  # [m/s] speed at which Coulomb friction is at 3/4


class EmulatedPlant:
    """The devices and their passive humans between ticks, by the matrix exponential.

    The person starts to move at the first tick after `begin`, so that a session can be armed at rest. With `coulomb`
    [N] every motor has dry friction too, which is held for an eighth of a tick.
    """

    def __init__(self, scenario: Scenario, encoder_step: Array, coulomb: float = 0.0) -> None:
        self.coulomb, self._substeps = coulomb, SUBSTEPS if coulomb else 1
        self.scenario, self.encoder_step = scenario, encoder_step
        self.scene = build(scenario.device, scenario.human, scenario.person)
        held = hold(plant(self.scene.model), scenario.T / self._substeps)
        self._product = np.hstack([held.A, held.B])
        self.s = np.zeros(held.A.shape[0])
        self._limit = np.array([device.force_limit for device in scenario.device])
        self._outside, self._first, self.tick = np.zeros((0, self.scene.outside)), 0, None

    @property
    def channels(self) -> int:
        return self.scenario.channels

    def begin(self) -> None:
        """From the next tick on the scenario's outside forces act, voluntary motion and tap."""
        self.tick = 0 if self.tick is None else self.tick

    def counts(self) -> tuple[int, ...]:
        """What the encoders show [counts]."""
        return tuple(int(n) for n in np.round(self.s[: self.channels] / self.encoder_step))

    def advance(self, f: Array) -> None:
        """Hold the forces f (m,) [N] for one period; the device feels -f."""
        w = np.zeros(self.scene.outside) if self.tick is None else self._next_outside()
        f, m, n = np.clip(f, -self._limit, self._limit), self.channels, self.scene.model.nq
        for _ in range(self._substeps):
            friction = self.coulomb * np.tanh(self.s[n : n + m] / SLIP) if self.coulomb else 0.0
            self.s = self._product @ np.concatenate([self.s, w, f + friction])

    def _next_outside(self) -> Array:
        assert self.tick is not None
        row = self.tick - self._first
        if not row < len(self._outside):
            self._first, row = self.tick, 0
            self._outside = outside_forces(self.scenario, self.scene, self._first, STRETCH)
        self.tick += 1
        return self._outside[row]


def nobody(scenario: Scenario) -> Scenario:
    """The scenario's devices with nobody at their handles, and no tap."""
    return scenario.replace(human=(Human((Link(0.0, 0.0, 0.0),)),) * scenario.channels, tap=None)
