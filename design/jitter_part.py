"""What a report says of delays that vary: the jitter-proof requirement beside that of the playout buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import Network
from controller.lti import Lti
from design import jitter_exact
from design.jitter import JitterProof, jitter_proof
from design.margin import closed_loop
from design.promises import certificate_part, finite

Range = tuple[tuple[int, ...], tuple[int, ...]]  # (lo, hi), each (m,) [samples]

NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: jitter on the "
    "measured positions, jitter of T, or forces older than the range, which lost packets make."
)


def switching_requirement(
    coupling: Coupling,
    network: Network,
    G: Lti,
    psi: Sequence[int],
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Sequence[float],
) -> JitterProof:
    """The jitter-proof requirement of a coupling with force map G (without Theta), proved exactly where possible."""
    found = jitter_proof(G, lo, hi, delta)
    if not found.requirement.certified:
        return found
    if jitter_exact.prove(coupling, network, G.T, psi, lo, hi, delta, found.alpha) is not None:
        return found
    return replace(found, requirement=replace(found.requirement, proof="rational"))


def switching_part(found: JitterProof, G: Lti, lo: Sequence[int], hi: Sequence[int]) -> dict[str, Any]:
    """The requirement with its multiplier, and what a playout buffer to the constant delay hi would need."""
    buffered = closed_loop(delay(hi, G.T) @ G, found.requirement.available)
    return certificate_part(found.requirement) | {
        "lo": list(lo),
        "hi": list(hi),
        "alpha": [finite(a) for a in found.alpha],
        "playout": {
            "theta": list(hi),
            "required_damping": [finite(d) for d in buffered.required],
            "certified": buffered.certified,
        },
        "not_covered": NOT_COVERED,
    }
