"""What a report says of delays that vary: the jitter-proof requirement beside that of the playout buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import Network, environment
from controller.lti import Lti, SingularLoop
from controller.process import force_map
from design import jitter_exact
from design.jitter import JitterProof, jitter_proof
from design.margin import closed_loop, refusal
from design.promises import certificate_part, finite

NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: jitter on the "
    "measured positions, jitter of T, forces older than the range (bursts of lost packets), or later than it."
)


def switching_requirement(
    coupling: Coupling,
    network: Network,
    T: float,
    psi: Sequence[int],
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Sequence[float],
) -> JitterProof:
    """The jitter-proof requirement of a coupling, proved exactly where it can be."""
    try:
        G = force_map(environment(network, T), coupling, (0,) * len(lo), psi)
    except SingularLoop as error:
        return JitterProof(refusal("jitter-proof", tuple(delta), str(error)), (float("inf"),) * len(lo), float("inf"))
    found = jitter_proof(G, lo, hi, delta)
    if not found.requirement.certified:
        return found
    if jitter_exact.prove(coupling, network, T, psi, lo, hi, delta, found.alpha) is not None:
        return found
    return replace(found, requirement=replace(found.requirement, proof="rational"))


def switching_part(found: JitterProof, G: Lti, hi: Sequence[int]) -> dict[str, Any]:
    """The requirement with its multiplier, and what a playout buffer to the constant delay hi would need."""
    buffered = closed_loop(delay(hi, G.T) @ G, found.requirement.available)
    return certificate_part(found.requirement) | {
        "alpha": [finite(a) for a in found.alpha],
        "playout": {
            "theta": list(hi),
            "required_damping": [finite(d) for d in buffered.required],
            "certified": buffered.certified,
        },
        "not_covered": NOT_COVERED,
    }
