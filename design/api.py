"""`from design import design_coupling, certify`: what python -m design does, for scripts. SI units."""

from __future__ import annotations

from typing import Any

from controller.coupling import Coupling
from design import designs
from design.assess import assess, specification
from design.margin import Requirement
from design.result import Design
from design.store import Loop, Stored, data_of


def design_coupling(loop: Loop, kind: str = "spring-damper", condition: str | None = None, **options: Any) -> Design:
    """Design a coupling for a loop: `scenario.loop("I")`, which is all that a design knows of a scenario.

    `kind` is "spring-damper", "ccl" or "optimal"; `condition` is "theorem4" (any passive environment) or "closed-loop"
    (this environment), None for the kind's own. `options` are those of the kind: order, method, diagonal for ccl, the
    fields of design.wish.Wish for optimal.

    Returns a Design: `coupling` (for a spring-damper with K (m,) [N/m] and B (m,) [N s/m]), `requirement` (the damping
    that it needs, from a sweep of the coupling alone), `figure` and `objective` (what was minimised, and its value).

    Raises ValueError for a kind, condition or loop that makes no sense, DesignFailed (design.failure) where no such
    coupling exists.
    """
    return designs.design_coupling(specification(loop), kind, condition, **options)


def certify(loop: Loop, coupling: Coupling | Design) -> dict[str, Requirement]:
    """What both conditions, "theorem4" and "closed-loop", ask of a coupling in its loop.

    Each Requirement has `required` and `available` (m,) [N s/m], `certified` (required < available), the frequency [Hz]
    where it binds, and `proof`: "rational" where exact arithmetic confirms it, "sampled" where a refined sweep says so.
    A condition that no damping satisfies has infinite `required` and a `reason`.

    Raises ValueError where coupling and loop do not fit each other, SingularLoop where their algebraic loop has no
    solution.
    """
    phi = coupling.phi if isinstance(coupling, Design) else None
    bare = coupling.coupling if isinstance(coupling, Design) else coupling
    Stored(loop, data_of(bare))  # refuses a coupling of another number of channels
    return assess(loop, bare, phi)
