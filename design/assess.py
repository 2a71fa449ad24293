"""What both conditions ask of a coupling in its loop, proved exactly wherever that is possible."""

from __future__ import annotations

from dataclasses import replace

from controller.box import members, regions, shrunk
from controller.contact import frozen_states, held
from controller.coupling import Compliance, Coupling, SpringDamper
from controller.environment import Network, environment
from controller.lti import Array, Lti
from controller.process import force_map
from design.certificate import NotProved, no_compliance, prove
from design.condition.delayed import theorem4_delayed
from design.margin import Requirement, closed_loop, refusal, theorem4, theorem4_per_channel
from design.specification import Specification
from design.store import Condition, Loop, data_of

CONDITIONS: tuple[Condition, ...] = ("theorem4", "closed-loop")


def specification(loop: Loop) -> Specification:
    """The loop as a request for a design, every wall touching. Raises ValueError naming the field that is wrong."""
    E = environment(held(loop.environment), loop.T)
    if loop.box is None:
        return Specification(E, loop.theta, loop.psi, loop.lam, loop.delta)
    box = loop.box

    def others(factor: float = 1.0) -> dict[str, Lti]:
        _, *vertices = members(loop.environment, box if factor == 1 else shrunk(loop.environment, box, factor))
        return {vertex.name: environment(vertex.network, loop.T) for vertex in vertices}

    delays, parts = (loop.theta, loop.psi, loop.lam), regions(loop.environment, box)
    return Specification(E, *delays, loop.delta, others=others(), regions=parts, shrunk=others)


def assess(loop: Loop, coupling: Coupling, phi: Array | None = None) -> dict[str, Requirement]:
    """Required damping by each condition; `phi` is the multiplier that the coupling was designed with, if any.

    closed-loop is about the nominal environment alone (design.box.check asks for the rest of its box) and the constant
    theta (design.jitter.part asks for the rest of its range); where there are walls it is about the frozen contact
    state that asks for most.
    """
    loop = loop.at(loop.environment).switching(None)
    any_environment = theorem4_of(loop.environment, loop.T, coupling, loop.theta, loop.psi, loop.delta, phi)
    this_environment = closed_loop_of(loop.environment, loop.T, coupling, loop.theta, loop.psi, loop.delta)
    return {
        "theorem4": _proved(loop, coupling, any_environment, phi),
        "closed-loop": _proved(loop, coupling, this_environment),
    }


def closed_loop_of(
    network: Network,
    T: float,
    coupling: Coupling,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
) -> Requirement:
    """The closed-loop requirement; of an environment with walls, that of its most demanding contact state."""
    states = (environment(state, T) for state in frozen_states(network).values())
    requirements = [closed_loop(force_map(E, coupling, theta, psi), delta) for E in states]
    return max(requirements, key=lambda requirement: requirement.ratio)


def theorem4_of(
    network: Network,
    T: float,
    coupling: Coupling,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
    phi: Array | None = None,
) -> Requirement:
    """Theorem 4's requirement; walls are covered without delay in the environment, and refused with it."""
    if network.walls and any(psi):
        return refusal("theorem4", delta, "with delay in the environment its multiplier is of a linear one: no walls")
    return theorem4_requirement(coupling, environment(held(network), T), theta, psi, delta, phi)


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
        from design.semidefinite.multiplier import shortage  # only an environment with delay inside needs the solver

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
        prove(loop, data_of(coupling), requirement.condition, None if phi is None else phi.tolist())
    except NotProved:
        return requirement
    return replace(requirement, proof="rational")
