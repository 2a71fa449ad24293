"""What a report says of delays that vary: the jitter-proof requirement beside that of the playout buffer."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from controller.coupling import Coupling
from controller.delay import delay
from controller.lti import Lti
from design.jitter.multiplier import JitterProof
from design.jitter.proof import storage, swept
from design.margin import closed_loop
from design.promises import certificate_part, finite
from design.proof.rational import Matrix
from design.store import DelayRange, Loop

NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: jitter on the "
    "measured positions, jitter of T, or forces older than the range, which lost packets make."
)


def switching_requirement(loop: Loop, coupling: Coupling) -> JitterProof:
    """The damping that switching within loop.jitter asks; `proof` is "rational" where exact arithmetic confirms it."""
    found = swept(loop, coupling)
    if not found.requirement.certified or not isinstance(storage(loop, coupling, found.alpha), Matrix):
        return found
    return replace(found, requirement=replace(found.requirement, proof="rational"))


def switching_part(found: JitterProof, G: Lti, span: DelayRange) -> dict[str, Any]:
    """The requirement with its multiplier, and what a playout buffer to the constant delay hi would need.

    G is the force map without Theta.
    """
    buffered = closed_loop(delay(span.hi, G.T) @ G, found.requirement.available)
    return certificate_part(found.requirement) | {
        "lo": list(span.lo),
        "hi": list(span.hi),
        "alpha": [finite(a) for a in found.alpha],
        "playout": {
            "theta": list(span.hi),
            "required_damping": [finite(d) for d in buffered.required],
            "certified": buffered.certified,
        },
        "not_covered": NOT_COVERED,
    }
