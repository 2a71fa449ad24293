"""What both conditions ask of a coupling in its loop, proved exactly wherever that is possible."""

from __future__ import annotations

from dataclasses import replace

from controller.box import inside, members, shrunk
from controller.coupling import Compliance, Coupling, SpringDamper
from controller.environment import environment
from controller.lti import Array, Lti
from controller.process import force_map
from design.certificate import NotProved, no_compliance, prove
from design.delayed import theorem4_delayed
from design.margin import Requirement, closed_loop, refusal, theorem4, theorem4_per_channel
from design.specification import Specification
from design.store import Condition, Loop, data_of

TRIED, TRIAL_SEED = 64, 0xB0C5  # points of a box where a design is tried; a seed that no check is likely to draw from

CONDITIONS: tuple[Condition, ...] = ("theorem4", "closed-loop")


def specification(loop: Loop) -> Specification:
    """The loop as a request for a design. Raises ValueError naming the field that is wrong."""
    E = environment(loop.environment, loop.T)
    if loop.box is None:
        return Specification(E, loop.theta, loop.psi, loop.lam, loop.delta)
    box = loop.box

    def others(factor: float = 1.0) -> dict[str, Lti]:
        _, *vertices = members(loop.environment, box if factor == 1 else shrunk(loop.environment, box, factor))
        return {vertex.name: environment(vertex.network, loop.T) for vertex in vertices}

    drawn = {m.name: environment(m.network, loop.T) for m in inside(loop.environment, box, TRIED, TRIAL_SEED)}
    delays = (loop.theta, loop.psi, loop.lam)
    return Specification(E, *delays, loop.delta, others=others(), inside=drawn, shrunk=others)


def assess(loop: Loop, coupling: Coupling, phi: Array | None = None) -> dict[str, Requirement]:
    """Required damping by each condition; `phi` is the multiplier that the coupling was designed with, if any.

    closed-loop is about the nominal environment alone: design.set_check asks for the rest of its box.
    """
    loop = loop.at(loop.environment)
    E = environment(loop.environment, loop.T)
    any_environment = theorem4_requirement(coupling, E, loop.theta, loop.psi, loop.delta, phi)
    this_environment = closed_loop(force_map(E, coupling, loop.theta, loop.psi), loop.delta)
    return {
        "theorem4": _proved(loop, coupling, any_environment, phi),
        "closed-loop": _proved(loop, coupling, this_environment),
    }


def theorem4_requirement(
    coupling: Coupling,
    E: Lti,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
    phi: Array | None = None,
) -> Requirement:
    """Theorem 4 for any coupling; E matters only with delay inside it, which takes a multiplier phi."""
    match coupling:
        case SpringDamper() if not any(psi):
            return theorem4_per_channel(coupling.channels(E.T), theta, delta)
        case SpringDamper():
            V = coupling.compliance(E.T)
        case Compliance(V=V):
            pass
        case _:
            return refusal("theorem4", delta, no_compliance(coupling))
    if not any(psi):
        return theorem4(V, theta, delta)
    if phi is None:
        from design.multiplier import shortage  # only an environment with delay inside needs the solver

        try:
            phi = shortage(Specification(E, theta, psi, theta, delta))
        except ValueError as error:
            return refusal("theorem4", delta, str(error))
    assert phi is not None  # psi >= 1 has a multiplier or none is possible
    return theorem4_delayed(V, E, theta, psi, delta, phi)


def _proved(loop: Loop, coupling: Coupling, requirement: Requirement, phi: Array | None = None) -> Requirement:
    """The requirement with `proof` = 'rational' where an exact proof was found, as it is where not."""
    if not requirement.certified:
        return requirement
    try:
        prove(loop, data_of(coupling), requirement.condition, phi)
    except NotProved:
        return requirement
    return replace(requirement, proof="rational")
