"""A K-B map whose axes are the environment's: one coupling, fixed, and every contact spring with the same K and B.

A spring-damper coupling has K and B of its own, and sim.zwidth.ground draws the map over them. Every other coupling is
designed once, for the scenario's environment (or its box), and the map asks in which environments it stays safe. An
optimal coupling is the pair of a fixed Q and a model of the environment, and two things may happen when that changes:

    closed-loop   the model is the environment of the cell: F = Theta (Psi E - Psi E Q Psi E), as with a box
    model kept    nobody tells the coupling: V = Q (I - Psi E0 Q)^-1 of the scenario's E0 faces E

A coupling of each cell's own would be certified everywhere, since Q near E^-1 turns the force off: such a map would be
of mismatch, which design.limits draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.coupling import Compliance, Coupling, InternalModel
from controller.delay import delay
from controller.environment import Network, environment
from controller.gains import Gains, Stack
from controller.lti import Array, Lti, SingularLoop
from controller.process import Process, force_map
from design.assess import theorem4_requirement
from design.condition.environment_map import Environments, closed_loop_in_each, contact_springs, response
from design.margin import Requirement, closed_loop, refusal
from models.device import Device, passivity_level
from models.human import Population

MODEL_KEPT = "model kept"


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Devices, delays and a coupling; the environment is `network` with other springs at its contacts.

    Raises ValueError where the network has no spring at a contact, or walls.
    """

    devices: tuple[Device, ...]  # (m,)
    population: Population
    network: Network  # the scenario's, which the coupling was designed for
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]
    coupling: Coupling
    cutoff: None = None  # the velocity filter belongs to the spring-damper of the other map
    walled: None = None

    def __post_init__(self) -> None:
        if self.network.walls:
            raise ValueError("environment.walls: with --coupling the map is over linear environments; take them out")
        if not contact_springs(self.network):
            raise ValueError("environment: no spring or damper ends at a contact, so there is no K and B to vary")

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    @property
    def stiffness_scale(self) -> float:
        """What the middle of the map is about [N/m]: the geometric mean of these springs."""
        stiff = [s.stiffness for s in contact_springs(self.network) if s.stiffness > 0]
        return float(np.exp(np.mean(np.log(stiff)))) if stiff else 1000.0

    @property
    def usual_scale(self) -> str:
        return "log"

    @property
    def conditions(self) -> tuple[str, ...]:
        """What is asked of every cell."""
        kept = (MODEL_KEPT,) if isinstance(self.coupling, InternalModel) else ()
        return ("theorem4", "closed-loop", *kept)

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        if any(self.psi):
            why = "with delay in the environment it takes a multiplier for each: ask design.audit about single ones"
            return {"theorem4": why}
        reason = self._any_environment.reason
        return {"theorem4": reason} if reason else {}

    def gains(self, K: Array, B: Array) -> Gains:
        """Environments with these springs at every contact, (n,) each."""
        return Gains(K, B, self.T)

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F in every environment, the coupling's model following it."""
        around = self._environments(gains)
        maps = [self._force_map(self.coupling, around[i]) for i in range(len(around))]
        order = max(F.order for F in maps)  # without damping or stiffness an environment may have fewer states
        A, B, C, D = zip(*(_padded(F, order) for F in maps), strict=True)
        return (Stack(np.stack(A), np.stack(B), np.stack(C), np.stack(D), self.T),)

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T in environment i; limits and encoder steps are those of `devices`."""
        limits = np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])
        return Process(self.force_maps(gains.take([i]))[0][0], *limits)

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        if condition == "theorem4":
            return np.full(len(gains), self._any_environment.ratio)
        around, coupling = self._environments(gains), self._kept if condition == MODEL_KEPT else self.coupling
        each = [self._force_map(coupling, around[i]).poles() for i in range(len(around))]
        most = max(poles.size for poles in each)
        poles = np.stack([np.pad(p, (0, most - p.size)) for p in each])
        return closed_loop_in_each(around, response(coupling, self.T), poles, self.theta, self.psi, self.delta)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The damping that the condition asks of the devices in one environment, by design.margin."""
        if condition == "theorem4":
            return self._any_environment
        coupling = self._kept if condition == MODEL_KEPT else self.coupling
        try:
            E = self._environments(self.gains(np.array([K]), np.array([B])))[0]
            return closed_loop(self._force_map(coupling, E), self.delta)
        except SingularLoop as error:
            return refusal("closed-loop", self.delta, str(error))

    @cached_property
    def _any_environment(self) -> Requirement:
        """theorem4's requirement, which no spring of the environment changes."""
        if any(self.psi):
            return refusal("theorem4", self.delta, "not asked")
        E = environment(self.network, self.T)
        return theorem4_requirement(self.coupling, E, self.theta, self.psi, self.delta)

    @cached_property
    def _kept(self) -> Coupling:
        """V of an optimal coupling whose model stays that of the scenario's environment."""
        assert isinstance(self.coupling, InternalModel)
        model = delay(self.psi, self.T) @ environment(self.network, self.T)
        return Compliance(self.coupling.parameter(self.T).feedback(-model))

    def _environments(self, gains: Gains) -> Environments:
        return Environments(self.network, gains.K, gains.B, self.T)

    def _force_map(self, coupling: Coupling, E: Lti) -> Lti:
        return force_map(E, coupling, self.theta, self.psi)


def _padded(F: Lti, order: int) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D with states that are always zero."""
    more = order - F.order
    A = np.pad(F.A, ((0, more), (0, more)))
    return A, np.pad(F.B, ((0, more), (0, 0))), np.pad(F.C, ((0, 0), (0, more))), F.D
