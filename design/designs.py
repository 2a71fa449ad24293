"""The designs by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from design.result import Design, Row
from design.specification import Specification

#: name -> the conditions that it can be made for, its own first
KINDS = {"spring-damper": ("theorem4", "closed-loop"), "ccl": ("theorem4",), "optimal": ("closed-loop",)}

#: kind -> what else can be asked of it, in words of design.api.Options
OPTIONS = {
    "spring-damper": ("switching",),
    "ccl": ("order", "method", "diagonal"),
    "optimal": ("functions", "filter", "diagonal", "objective", "high_gain", "margin", "switching"),
}

#: how a state-space coupling of fixed order may be sought
METHODS = ("complementarity", "inner", "fixed-poles")


def design_coupling(
    spec: Specification,
    kind: str = "spring-damper",
    condition: str | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
    **options: Any,
) -> Design:
    """Design and verify a coupling; `options` are those of the design's own function: order, method, diagonal for ccl,
    the fields of design.parameter.wish.Wish for optimal. `progress` hears what takes long: (what, steps done, of how
    many).

    Raises ValueError for a kind or condition that does not exist, Infeasible or DesignFailed (design.failure) where
    there is nothing to return.
    """
    if kind not in KINDS:
        raise ValueError(f"coupling is {kind!r}, allowed are {', '.join(KINDS)}")
    condition = condition or KINDS[kind][0]
    if condition not in KINDS[kind]:
        raise ValueError(f"condition is {condition!r}, for {kind} allowed are {', '.join(KINDS[kind])}")
    from design import ccl, optimal, spring_damper  # cvxpy takes a second to import
    from design.parameter.wish import Wish

    if kind == "ccl":
        return ccl.design(spec, **options)
    if kind == "optimal":
        return optimal.design(spec, Wish(**options), progress)
    return spring_damper.design(spec, condition, **options)


def compare_methods(spec: Specification) -> tuple[Row, ...]:
    """Every method on the same specification: norm, convex problems, seconds."""
    from design import ccl

    return ccl.compare(spec)
