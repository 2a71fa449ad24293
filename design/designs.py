"""The designs by name."""

from __future__ import annotations

from design.result import Design
from design.specification import Specification

#: name -> the conditions that it can be made for, its own first
KINDS = {"spring-damper": ("theorem4", "closed-loop")}


def design_coupling(spec: Specification, kind: str = "spring-damper", condition: str | None = None) -> Design:
    """Design and verify a coupling.

    Raises ValueError for a kind or condition that does not exist, Infeasible or DesignFailed (design.failure) where
    there is nothing to return.
    """
    if kind not in KINDS:
        raise ValueError(f"coupling is {kind!r}, allowed are {', '.join(KINDS)}")
    condition = condition or KINDS[kind][0]
    if condition not in KINDS[kind]:
        raise ValueError(f"condition is {condition!r}, for {kind} allowed are {', '.join(KINDS[kind])}")
    from design import spring_damper  # cvxpy takes a second to import

    return spring_damper.design(spec, condition)
