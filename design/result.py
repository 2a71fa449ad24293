"""What a condition asks of the devices, and what a design returns or raises."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Array

ConditionName = Literal["this-environment", "any-environment", "known-device", "known-device-any"]
#: for which environments a certificate holds
Environments = Literal["any passive environment", "these ranges", "this environment"]

#: the conditions in the order of tables, each with the environments for which it holds
CONDITIONS: dict[str, str] = {
    "this-environment": "this environment",
    "any-environment": "any passive environment",
}
#: the conditions that also need guaranteed bounds of the devices' motors and transmissions
KNOWN_CONDITIONS: dict[str, str] = {
    "known-device": "this environment",
    "known-device-any": "any passive environment",
}


#: what this-environment holds for before walls
MAKING = "this environment, with its walls, at any gap, or softer ones in proportion, that make and break contact"

C = TypeVar("C", bound=str)  # a ConditionName, "switching" or "limiter"


# How much damping a condition asks: sweeps, without a solver.


#: Share of the available damping that no verdict counts on. Figures of a sweep differ by up to 1e-10 between kernels of
#: linear algebra, with a multiplier that a solver finds by up to 2e-8: within the band the answer is "not certified".
GUARD = 1e-7


@overload
def suffices(ratio: float) -> bool: ...
@overload
def suffices(ratio: Array) -> NDArray[np.bool_]: ...
def suffices(ratio: float | Array) -> bool | NDArray[np.bool_]:
    """Return whether devices have enough damping, which required over available damping tells."""
    return ratio < 1 - GUARD


@dataclass(frozen=True)
class Requirement(Generic[C]):
    """The damping that a condition asks of the devices, against what they have."""

    condition: C
    required: tuple[float, ...]  # (m,) [N s/m]; inf when no damping helps
    available: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: float | None  # where it binds
    reason: str | None = None  # why the figure is infinite
    proof: str = "sampled"
    multiplier: tuple[Any, ...] | None = None  # at which it asks so much, of a condition that has one
    bound: float | None = None  # no multiplier asks a smaller ratio, on the frequencies that its search has looked at
    guarantee: str | None = None  # for which environments it is, in words, where a condition has judged a loop
    lag: tuple[float, ...] | None = None  # rho (m,) [N/m] of a limiter that it covers without further proof

    @property
    def ratio(self) -> float:
        """s: required / available on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return suffices(self.ratio)

    def part(self) -> dict[str, Any]:
        """As JSON has it; `reason` only where there is one."""
        part = {
            "condition": self.condition,
            "required_damping": self.required,
            "available_damping": self.available,
            "required_share": self.ratio,
            "binding_frequency_hz": self.frequency_hz,
            "certified": self.certified,
            "proof": self.proof if self.certified else None,
        }
        return part | ({"reason": self.reason} if self.reason else {})

    @property
    def margin(self) -> float | None:
        """Available over required damping; None where none or infinitely much is required."""
        return finite(1 / self.ratio) if self.ratio > 0 else None

    @property
    def shortfall(self) -> str:
        """Why it is not certified."""
        have = listed(self.available)
        return self.reason or f"needs {listed(self.required)} N s/m of damping, has {have}"


def from_ratio(condition: C, ratio: float, available: tuple[float, ...], frequency_hz: float) -> Requirement[C]:
    """The requirement of `ratio` times what is available, on every channel."""
    return Requirement(condition, tuple(ratio * delta for delta in available), available, frequency_hz)


def refusal(condition: C, available: tuple[float, ...], reason: str) -> Requirement[C]:
    """The requirement that no damping satisfies."""
    return Requirement(condition, (np.inf,) * len(available), available, None, reason)


def finite(value: float) -> float | None:
    """JSON knows neither infinity nor not-a-number."""
    return float(value) if math.isfinite(value) else None


def switching_guarantee(span: DelayRange) -> str:
    """Which delays of the forces a coupling is certified for that bears switching, in the environment of its loop."""
    return f"delays switching within {span}"


class NotProved(ValueError):
    """No proof of the condition was found; carries the requirement that the sweep found, if there is one.

    `refuted` where there is none: exact arithmetic contradicts the sweep.
    """

    def __init__(self, reason: str, requirement: Requirement | None = None, refuted: bool = False) -> None:
        super().__init__(reason)
        self.requirement, self.refuted = requirement, refuted


# ----------------------------------------------------------------------------------------------------
# What a design raises when it has nothing to return.


class DesignFailed(ValueError):
    """No result could be verified. `problem` is the convex problem, if there is one, `results` what was tried."""

    def __init__(self, problem: Any, results: Sequence[Any], advice: str) -> None:
        self.problem, self.results, self.advice = problem, tuple(results), advice
        super().__init__(advice)


class Infeasible(DesignFailed):
    """What was asked for does not exist."""


# ----------------------------------------------------------------------------------------------------
# Figures as text.


def listed(values: Iterable[float | None], digits: int = 6) -> str:
    """1.37, 0.5 with so many significant digits; None, as JSON has infinity, is inf."""
    return ", ".join("inf" if v is None else f"{v:.{digits}g}" for v in values)


# ----------------------------------------------------------------------------------------------------
# What a design returns.


@dataclass(frozen=True, eq=False)
class Chosen:
    """A coupling, the condition that it was made for or is judged by, and how it came about."""

    coupling: Coupling
    condition: str
    kind: str = field(kw_only=True, default="given")
    phi: Array | None = field(kw_only=True, default=None)  # (m,) multiplier Phi_E [N s/m] of Theorem 4, if it needs one
    certificate: Any = field(kw_only=True, default=None)  # the file's Certificate, where it was proved in this process
    limiter: Any = field(kw_only=True, default=None)  # Certificate with which it comes for limited forces
    own: Any = field(kw_only=True, default=None)  # the design.conditions.Condition, where that is one of the user's own
    switching: DelayRange | None = field(kw_only=True, default=None)  # its file proves any switching within it
    notes: tuple[str, ...] = field(kw_only=True, default=())  # what a reader should know of its origin

    @property
    def asked(self) -> Any:
        """The condition as design.certificate takes it: the user's own, or a name."""
        return self.own or self.condition

    def remarks(self, requirements: Mapping[str, Requirement]) -> tuple[str, ...]:
        """Its notes, and whether the user's own condition holds."""
        return (*self.notes, self.own.said(requirements[self.own.name])) if self.own else self.notes

    def fails(self, requirements: Mapping[str, Requirement]) -> bool:
        """Whether the user's own condition does not hold."""
        return bool(self.own) and not requirements[self.own.name].certified


@dataclass(frozen=True, eq=False)
class Design(Chosen):
    """A coupling, what it was designed for and what was verified from the coupling alone."""

    figure: str  # what was minimised: "loop-norm" (23), "rms" (mismatch), "stiffness" (maximised)
    objective: float  # its value, of the coupling as returned
    requirement: Requirement  # by `condition`, on a refined sweep
    sdps: int = 0  # convex problems solved (local searches count their runs)
    wall_s: float = 0.0
    c: Sequence[Sequence[float]] | None = field(kw_only=True, default=None)  # of the limiter, where its search is long
    searched: Any = field(kw_only=True, default=None)  # design.worst_member.Searched, between the vertices of ranges
    hurried: bool = field(kw_only=True, default=False)  # --seconds ended the search: more time may find a better one
