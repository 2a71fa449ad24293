"""What a design returns."""

from __future__ import annotations

from dataclasses import dataclass

from controller.coupling import Coupling
from controller.lti import Array
from design.margin import Requirement
from design.store import Condition


@dataclass(frozen=True, eq=False)
class Design:
    """A coupling, what it was designed for and what was verified from the coupling alone."""

    coupling: Coupling
    condition: Condition
    figure: str  # what was minimised: "loop-norm" (23), "rms" (mismatch), "stiffness" (maximised)
    objective: float  # its value, of the coupling as returned
    requirement: Requirement  # by `condition`, on a refined sweep
    sdps: int  # convex problems solved (local searches count their runs)
    wall_s: float
    phi: Array | None = None  # (N,) multiplier Phi_E [N s/m] of Theorem 4, None where the environment has none


@dataclass(frozen=True)
class Row:
    """One line of a comparison."""

    method: str
    norm: float | None  # ||W1 L W2||_inf, None where the method gave nothing that could be verified
    sdps: int
    wall_s: float
    reason: str | None = None
