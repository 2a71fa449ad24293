"""What both conditions ask of a coupling in its loop, proved exactly wherever that is possible."""

from __future__ import annotations

from dataclasses import replace

from controller.coupling import Compliance, Coupling, NoCoupling, SpringDamper
from controller.environment import environment
from controller.lti import Array, Lti
from controller.process import force_map
from design.certificate import NotProved, prove
from design.delayed import theorem4_delayed
from design.failure import DesignFailed
from design.margin import Requirement, closed_loop, refusal, theorem4, theorem4_per_channel
from design.specification import Specification
from design.store import Condition, Loop, data_of

CONDITIONS: tuple[Condition, ...] = ("theorem4", "closed-loop")


def specification(loop: Loop) -> Specification:
    """The loop as a request for a design. Raises ValueError naming the field that is wrong."""
    return Specification(environment(loop.environment, loop.T), loop.theta, loop.psi, loop.lam, loop.delta)


def assess(loop: Loop, coupling: Coupling, phi: Array | None = None) -> dict[str, Requirement]:
    """Required damping by each condition; `phi` is the multiplier that the coupling was designed with, if any."""
    E = environment(loop.environment, loop.T)
    return {
        "theorem4": _proved(loop, coupling, _theorem4(loop, coupling, E, phi)),
        "closed-loop": _proved(loop, coupling, closed_loop(force_map(E, coupling, loop.theta, loop.psi), loop.delta)),
    }


def _theorem4(loop: Loop, coupling: Coupling, E: Lti, phi: Array | None) -> Requirement:
    match coupling:
        case SpringDamper() if not any(loop.psi):
            return theorem4_per_channel(coupling.channels(loop.T), loop.theta, loop.delta)
        case SpringDamper():
            V = coupling.compliance(loop.T)
        case Compliance(V=V):
            pass
        case NoCoupling():
            return refusal("theorem4", loop.delta, "without a coupling there is nothing that Theorem 4 could use")
        case _:
            return refusal("theorem4", loop.delta, "this coupling has no fixed V for Theorem 4 to speak of")
    if not any(loop.psi):
        return theorem4(V, loop.theta, loop.delta)
    if phi is None:
        from design.multiplier import shortage  # only an environment with delay inside needs the solver

        try:
            phi = shortage(specification(loop))
        except (DesignFailed, ValueError) as error:
            return refusal("theorem4", loop.delta, str(error))
    assert phi is not None
    return theorem4_delayed(V, E, loop.theta, loop.psi, loop.delta, phi)


def _proved(loop: Loop, coupling: Coupling, requirement: Requirement) -> Requirement:
    """The requirement with `proof` = 'rational' where an exact proof was found, as it is where not."""
    if not requirement.certified:
        return requirement
    try:
        prove(loop, data_of(coupling), requirement.condition)
    except NotProved:
        return requirement
    return replace(requirement, proof="rational")
