"""The loop that a K-B map is about: everything but the gains, and what is asked of it at many gains or at one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from controller.coupling import SpringDamper
from controller.environment import Network, environment
from controller.gains import Gains, Stack, force_maps
from controller.lti import Array, Lti
from design.assess import theorem4_requirement
from design.failure import DesignFailed
from design.gain_map import closed_loop_ratios, theorem4_ratios
from design.margin import Requirement, closed_loop, refusal
from design.multiplier import shortage
from design.specification import Specification
from design.store import Condition
from design.subject import Subject
from models.device import Device, passivity_level
from models.human import Population


@dataclass(frozen=True, eq=False)
class Ground:
    """Devices, environment and delays. Raises ValueError naming the field that is wrong."""

    devices: tuple[Device, ...]  # (m,)
    population: Population
    network: Network | None  # None is a rigid wall behind the coupling, one channel
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]
    cutoff: float | None = None  # [Hz] of a filter on the velocity that the coupling damps

    def __post_init__(self) -> None:
        _ = self._subject  # its checks are ours
        if self.network is not None and self.network.contacts and len(self.network.contacts) != len(self.devices):
            raise ValueError(f"{len(self.devices)} devices for {len(self.network.contacts)} contacts")

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    @cached_property
    def environment(self) -> Lti | None:
        return None if self.network is None else environment(self.network, self.T)

    def gains(self, K: Array, B: Array) -> Gains:
        """Couplings with these gains on every channel, (n,) each."""
        return Gains(K, B, self.T, self.cutoff)

    def force_maps(self, gains: Gains) -> Stack:
        return force_maps(gains, self.environment, self.theta, self.psi)

    def ratios(self, condition: Condition, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        if condition == "closed-loop":
            return closed_loop_ratios(gains, self.environment, self.theta, self.psi, self.delta)
        phi, reason = self.multiplier
        if reason:
            return np.full(len(gains), np.inf)
        return theorem4_ratios(gains, self.theta, self.delta, phi)

    def requirement(self, condition: Condition, K: float, B: float) -> Requirement:
        """The same for one coupling by design.margin, which a map is checked against."""
        gains = self.gains(np.array([K]), np.array([B]))
        if condition == "closed-loop":
            if self.cutoff is None:
                return self._subject.with_gains([K] * self.channels, [B] * self.channels).requirement(condition)
            return closed_loop(self.force_maps(gains)[0], self.delta)
        phi, reason = self.multiplier
        if reason:
            return refusal("theorem4", self.delta, reason)
        coupling = gains.compliance(0, self.channels) if self.cutoff else SpringDamper([K] * self.channels, [B] * self.channels)
        E = self.environment or Lti.constant(np.eye(1), self.T)
        return theorem4_requirement(coupling, E, self.theta, self.psi, self.delta, phi)

    @cached_property
    def multiplier(self) -> tuple[Array | None, str | None]:
        """Phi of Theorem 4 [N s/m], (m,), which only delay in the environment needs; or why there is none."""
        if self.environment is None:
            return None, None
        try:
            return shortage(Specification(self.environment, self.theta, self.psi, self.theta, self.delta)), None
        except (ValueError, DesignFailed) as error:
            return None, str(error)

    @property
    def _subject(self) -> Subject:
        coupling = SpringDamper([1.0] * self.channels, [0.0] * self.channels)
        return Subject(coupling, self.network, self.T, self.theta, self.psi, self.delta)

    def with_devices(self, devices: tuple[Device, ...]) -> Ground:
        return replace(self, devices=devices)
