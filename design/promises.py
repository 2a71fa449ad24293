"""What may be said of a coupling: required against available damping, for which environments, and what is left out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from design.margin import Requirement
from design.store import DelayRange, Loop

ANY, SET, HERE, WALL = "any passive environment", "a set", "this environment", "a rigid wall only"
FROZEN = "each frozen contact state of this environment (contact that makes and breaks is not covered)"

#: What no certificate covers.
CAVEATS = (
    "The proofs are for the linear loop: they hold while forces stay below their limits (clipped ticks are counted), "
    "not for contacts that make and break (except walls under theorem4, without delay in the environment), "
    "jitter of T, quantisation, velocity filters or friction compensation."
)


def finite(value: float) -> float | None:
    """JSON knows neither infinity nor not-a-number."""
    return float(value) if math.isfinite(value) else None


def certificate_part(requirement: Requirement) -> dict[str, Any]:
    """Required against available damping."""
    part = {
        "condition": requirement.condition,
        "required_damping": [finite(b) for b in requirement.required],
        "available_damping": list(requirement.available),
        "margin": finite(1 / requirement.ratio) if requirement.ratio > 0 else None,
        "binding_frequency_hz": requirement.frequency_hz,
        "certified": requirement.certified,
        "proof": requirement.proof,
    }
    return part | ({"reason": requirement.reason} if requirement.reason else {})


def promise(
    theorem4: bool, closed_loop: bool, *, rigid: bool = False, walls: bool = False, whole_set: bool = False
) -> str | None:
    """For which environments a coupling is certified, given which conditions hold.

    `rigid` if E is a rigid wall that is never left, `walls` if contact is made and broken, `whole_set` if closed-loop
    is proved at every vertex of a box around E and a search has found no violation between them.
    """
    if theorem4:
        return ANY
    if whole_set:
        return SET
    return (WALL if rigid else FROZEN if walls else HERE) if closed_loop else None


def switching_promise(span: DelayRange) -> str:
    """Which delays of the forces a coupling is certified for that bears switching, in the environment of its loop."""
    return f"delays switching within {span}"


def promise_of(requirements: Mapping[str, Requirement], loop: Loop, whole_set: bool = False) -> str | None:
    """The promise of a coupling by its requirements; the multiplier that psi >= 1 takes is of one environment."""
    held = {name: requirement.certified for name, requirement in requirements.items()}
    walls = bool(loop.environment.walls)
    return promise(held["theorem4"] and not any(loop.psi), any(held.values()), walls=walls, whole_set=whole_set)
