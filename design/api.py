"""`from design import design_coupling, certify`: what python -m design does, for scripts. SI units."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from controller.coupling import Coupling
from design import designs
from design.assess import assess, specification
from design.jitter_part import switching_requirement
from design.margin import Requirement
from design.result import Design
from design.set_check import check_set
from design.store import Loop, Stored, data_of


def design_coupling(loop: Loop, kind: str = "spring-damper", condition: str | None = None, **options: Any) -> Design:
    """Design a coupling for a loop: `scenario.loop("I")`, which is all that a design knows of a scenario.

    `kind` is "spring-damper", "ccl" or "optimal"; `condition` is "theorem4" (any passive environment) or "closed-loop"
    (this environment), None for the kind's own. `options` are those of the kind: order, method, diagonal for ccl, the
    fields of design.wish.Wish for optimal, and switching = (lo, hi) for delays that vary (it is not taken from
    loop.jitter).

    Returns a Design: `coupling` (for a spring-damper with K (m,) [N/m] and B (m,) [N s/m]), `requirement` (the damping
    that it needs, from a sweep of the coupling alone), `figure` and `objective` (what was minimised, and its value).

    Raises ValueError for a kind, condition or loop that makes no sense, DesignFailed (design.failure) where no such
    coupling exists.
    """
    return designs.design_coupling(specification(loop), kind, condition, **options)


def certify(loop: Loop, coupling: Coupling | Design) -> dict[str, Requirement]:
    """What both conditions, "theorem4" and "closed-loop", ask of a coupling in its loop.

    With a box around the loop's environment closed-loop is about the environment and every vertex: the figure is that
    of the one that asks the most, proved only if all are. Between the vertices nothing is proved, but searched: a
    violation found there (design.worst_member) is the figure then, and not certified. With a range of delays,
    loop.jitter, there is a third, "jitter-proof": what any switching within the range asks.

    Each Requirement has `required` and `available` (m,) [N s/m], `certified` (required < available), the frequency [Hz]
    where it binds, and `proof`: "rational" where exact arithmetic confirms it, "sampled" where a refined sweep says so.
    A condition that no damping satisfies has infinite `required` and a `reason`.

    Raises ValueError where coupling and loop do not fit each other, SingularLoop where their algebraic loop has no
    solution.
    """
    phi = coupling.phi if isinstance(coupling, Design) else None
    bare = coupling.coupling if isinstance(coupling, Design) else coupling
    Stored(loop, data_of(bare))  # refuses a coupling of another number of channels
    requirements: dict[str, Requirement] = dict(assess(loop, bare, phi))
    if whole := check_set(loop, bare, samples=0):
        _, worst = whole.worst if whole.proved else whole.worst_found
        requirements["closed-loop"] = replace(worst, proof="rational" if whole.proved else "sampled")
    if loop.jitter:
        requirements["jitter-proof"] = switching_requirement(loop, bare).requirement
    return requirements
