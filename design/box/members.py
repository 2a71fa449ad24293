"""A coupling in every environment of a set: what the closed-loop condition asks at each vertex of a box."""

from __future__ import annotations

from collections.abc import Sequence

from controller.box import Member
from controller.coupling import Coupling
from controller.environment import environment
from controller.lti import SingularLoop
from controller.process import force_map
from design.margin import Requirement, closed_loop, refusal
from design.store import Loop


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """The closed-loop condition of this coupling around each of the members, every one frozen."""
    return [_required(loop, coupling, member) for member in members]


def worst(requirements: Sequence[Requirement]) -> int:
    """Which of them asks the most."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


def _required(loop: Loop, coupling: Coupling, member: Member) -> Requirement:
    try:
        F = force_map(environment(member.network, loop.T), coupling, loop.theta, loop.psi)
    except SingularLoop as error:
        return refusal("closed-loop", loop.delta, str(error))
    return closed_loop(F, loop.delta)
