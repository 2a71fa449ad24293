"""The loop that a K-B map is about: everything but the gains, and what is asked of it at many gains or at one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.contact import Contact, contact, frozen_states
from controller.coupling import SpringDamper
from controller.environment import GROUND, Network, Wall, environment
from controller.gains import Gains, Stack, force_maps
from controller.lti import Array, Lti
from controller.process import Process
from design.assess import CONDITIONS, theorem4_requirement
from design.audit.subject import Subject
from design.failure import DesignFailed
from design.gains.gain_map import closed_loop_ratios, theorem4_ratios
from design.margin import Requirement, closed_loop, refusal
from design.semidefinite.multiplier import shortage
from design.specification import Specification
from design.store import Condition
from models.device import Device, passivity_level
from models.human import Population

#: a one-sided wall behind the coupling is this stiff [N/m], which makes K too soft by K / 1e10
HARD_WALL = Network(("tip",), walls=(Wall(("tip", GROUND), stiffness=1e10),))


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
    one_sided: bool = False  # whether a rigid wall only pushes; the walls of a network do in any case

    def __post_init__(self) -> None:
        _ = self._subject  # its checks are ours

    @property
    def channels(self) -> int:
        return len(self.devices)

    @property
    def delta(self) -> tuple[float, ...]:
        """(m,) guaranteed dampings [N s/m]"""
        return tuple(passivity_level(device) for device in self.devices)

    @property
    def walled(self) -> Network | None:
        """The network whose contact is made and broken in the simulated loop, if there is one."""
        if self.network is None:
            return HARD_WALL if self.one_sided else None
        return self.network if self.network.walls else None

    @property
    def usual_scale(self) -> str:
        """Against a rigid wall couplings are all of one size; against an environment far stiffer ones can be safe."""
        return "linear" if self.network is None else "log"

    @property
    def stiffness_scale(self) -> float:
        """[N/m] 2 delta/((theta + 1) T): the stiffest that a linear law may be against every passive environment."""
        return max(2 * d / ((n + 1) * self.T) for d, n in zip(self.delta, self.theta, strict=True))

    @property
    def conditions(self) -> tuple[str, ...]:
        return CONDITIONS

    @property
    def refusals(self) -> dict[str, str]:
        """Conditions that say nothing of any cell, and why."""
        reason = self.multiplier[1]
        return {"theorem4": reason} if reason else {}

    @cached_property
    def environments(self) -> tuple[Lti | None, ...]:
        """The linear environments of every frozen contact state, all walls touching first; None is a rigid wall.

        Off a rigid wall the device is free, which is safe by itself.
        """
        if self.network is None:
            return (None,)
        return tuple(environment(state, self.T) for state in reversed(list(frozen_states(self.network).values())))

    def gains(self, K: Array, B: Array) -> Gains:
        """Couplings with these gains on every channel, (n,) each."""
        return Gains(K, B, self.T, self.cutoff)

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F of every coupling, for each of `environments`."""
        return tuple(force_maps(gains, E, self.theta, self.psi) for E in self.environments)

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T with coupling i; limits and encoder steps are those of `devices`."""
        limits = np.array([d.force_limit for d in devices]), np.array([d.encoder_step for d in devices])
        if self.walled is None:
            return Process(self.force_maps(gains.take([i]))[0][0], *limits)
        walls: Contact = contact(self.walled, gains.compliance(i, self.channels), self.theta, self.psi, self.T)
        return Process(walls.open, *limits, walls)

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough. Of walls, in the worst state."""
        if condition == "closed-loop":
            states = [closed_loop_ratios(gains, E, self.theta, self.psi, self.delta) for E in self.environments]
            return np.max(states, axis=0)
        phi, reason = self.multiplier
        if reason:
            return np.full(len(gains), np.inf)
        return theorem4_ratios(gains, self.theta, self.delta, phi)

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The same for one coupling by design.margin, which a map is checked against."""
        if self.cutoff is None and (condition == "closed-loop" or not any(self.psi)):
            asked: Condition = "closed-loop" if condition == "closed-loop" else "theorem4"
            return self._subject.with_gains([K] * self.channels, [B] * self.channels).requirement(asked)
        gains = self.gains(np.array([K]), np.array([B]))
        if condition == "closed-loop":
            states = [closed_loop(stack[0], self.delta) for stack in self.force_maps(gains)]
            return max(states, key=lambda requirement: requirement.ratio)
        phi, reason = self.multiplier
        if reason:
            return refusal("theorem4", self.delta, reason)
        E = self.environments[0] or Lti.constant(np.eye(1), self.T)
        coupling = gains.compliance(0, self.channels)
        return theorem4_requirement(coupling, E, self.theta, self.psi, self.delta, phi)

    @cached_property
    def multiplier(self) -> tuple[Array | None, str | None]:
        """Phi of Theorem 4 [N s/m], (m,), which only delay in the environment needs; or why there is none."""
        if not any(self.psi) or self.network is None:
            return None, None
        if self.network.walls:
            return None, "with delay in the environment its multiplier is of a linear one: no walls"
        E = environment(self.network, self.T)
        try:
            return shortage(Specification(E, self.theta, self.psi, self.theta, self.delta)), None
        except (ValueError, DesignFailed) as error:
            return None, " ".join(str(error).split())

    @property
    def _subject(self) -> Subject:
        coupling = SpringDamper([1.0] * self.channels, [0.0] * self.channels)
        return Subject(coupling, self.network, self.T, self.theta, self.psi, self.delta)


def one_sided(network: Network) -> Network:
    """The network whose contacts only push: every spring at a contact becomes a wall, in the direction it is given in.

    Raises ValueError where the contacts have no springs.
    """
    at_contact = [s for s in network.springs if set(s.between) & set(network.contacts) and s.stiffness > 0]
    if not at_contact:
        raise ValueError("no spring ends at a contact, so there is nothing to make one-sided")
    kept = tuple(spring for spring in network.springs if spring not in at_contact)
    walls = tuple(Wall(s.between, s.stiffness, s.damping) for s in at_contact)
    return Network(network.contacts, kept, network.masses, (*network.walls, *walls))


def press_directions(network: Network | None, channels: int) -> Array:
    """(m,) +1 or -1: into the walls where contacts have some, else alternately."""
    directions = (-1.0) ** np.arange(channels)
    for i, name in enumerate(network.contacts if network else ()):
        for wall in network.walls if network else ():
            if name in wall.between:
                directions[i] = 1.0 if wall.between[0] == name else -1.0
    return directions
