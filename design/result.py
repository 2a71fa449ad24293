"""What a condition asks, what a design is, and the checks of the arguments of functions for scripts."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from controller.coupling import Coupling, SpringDamper
from controller.lti import Array, Lti

Condition = Literal["this-environment", "any-environment"]


C = TypeVar("C", bound=str)  # a Condition, "switching" or "limiter"


# How much damping a condition asks: sweeps, without a solver.


@dataclass(frozen=True)
class Requirement(Generic[C]):
    """The damping that a condition asks of the devices, against what they have."""

    condition: C
    required: tuple[float, ...]  # (m,) [N s/m]; inf when no damping helps
    available: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: float | None  # where it binds
    reason: str | None = None  # why the figure is infinite
    proof: str = "sampled"

    @property
    def ratio(self) -> float:
        """s: required / available on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return self.ratio < 1

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


class NotProved(ValueError):
    """No proof of the condition was found; carries the requirement that the sweep found, if there is one."""

    def __init__(self, reason: str, requirement: Requirement | None = None) -> None:
        super().__init__(reason)
        self.requirement = requirement


# ----------------------------------------------------------------------------------------------------
# What a design raises when it has nothing to return.


@dataclass(frozen=True)
class Attempt:
    """What one rung of the ladder gave."""

    settings: str
    status: str
    value: float | None  # the objective, None where the attempt was refused
    wall_s: float
    reason: str | None = None  # why it was refused


class DesignFailed(ValueError):
    """No result could be verified. `problem` is the convex problem, if there is one, `results` what was tried."""

    def __init__(self, problem: Any, results: Sequence[Any], advice: str) -> None:
        self.problem, self.results, self.advice = problem, tuple(results), advice
        super().__init__(advice)


class Infeasible(DesignFailed):
    """What was asked for does not exist."""


# ----------------------------------------------------------------------------------------------------
# Figures and conditions as text.


#: what files, options and reports called the conditions before
OLDER_NAMES = {"closed-loop": "this-environment", "theorem4": "any-environment"}  # older name


def listed(values: Iterable[float | None], digits: int = 6) -> str:
    """1.37, 0.5 with so many significant digits; None stands for infinity in plain data."""
    return ", ".join("inf" if v is None else f"{v:.{digits}g}" for v in values)


# ----------------------------------------------------------------------------------------------------
# The paper's printed gains, as data. Neither pair satisfies the paper's own condition: nothing here is certified.


#: (27), case I: Lambda = Theta Psi
CASE_I = SpringDamper(K=[2870.0, 2320.0], B=[5.47, 5.55])
#: (28), case II: Lambda = I
CASE_II = SpringDamper(K=[1810.0, 120.0], B=[5.78, 3.81])

#: The transparency indices (25) printed beside them [dB]; no reading of Figure 4 that we tried gives them.
PRINTED_TAU_DB = {"I": -4.15, "II": -3.09}

PUBLISHED = {"I": CASE_I, "II": CASE_II}


# ----------------------------------------------------------------------------------------------------
# What a design returns.


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
    certificate: Any = field(kw_only=True, default=None)  # design.stored.Certificate, where the design has proved it
    hurried: bool = field(kw_only=True, default=False)  # its clock ended it: more time may find a better


COUPLING = "a coupling (controller.coupling), or a Design"


def of_kind(name: str, value: Any, kind: type, expected: str) -> None:
    """Raises TypeError where `value` is no `kind`."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} is {shown(value)}, expected {expected}")


def bare(coupling: Coupling | Design, expected: str = COUPLING) -> Coupling:
    """The coupling of a design, or the one given. Raises TypeError for anything else."""
    found = coupling.coupling if isinstance(coupling, Design) else coupling
    if isinstance(found, Lti):
        raise TypeError("coupling is an Lti, expected a coupling: wrap it in Compliance(...) (controller.coupling)")
    if isinstance(found, type) or not callable(getattr(found, "around", None)):
        raise TypeError(f"coupling is {shown(coupling)}, expected {expected}")
    return found


def whole(name: str, value: Any, low: int, high: float = math.inf) -> int:
    """A whole number from `low` to `high`, numpy's too. Raises TypeError, ValueError."""
    span = f"{low} to {high}" if high < math.inf else f"{low} or more"
    allowed = f"whole numbers, {span}"
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {shown(value)}, allowed are {allowed}") from None
    if isinstance(value, bool):
        raise TypeError(f"{name} is {shown(value)}, allowed are {allowed}")
    if not low <= number <= high:
        raise ValueError(f"{name} is {number}, allowed are {span}")
    return number


def number(name: str, value: Any, expected: str = "a number") -> float:
    """A float, numpy's too. Raises TypeError."""
    if isinstance(value, bool | str | bytes) or not hasattr(value, "__float__") or getattr(value, "ndim", 0):
        raise TypeError(f"{name} is {shown(value)}, expected {expected}")
    return float(value)


def one_of(name: str, value: Any, allowed: Collection[str]) -> None:
    """Raises ValueError."""
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{name} is {value!r}, allowed are {', '.join(allowed)}")


def known(options: Iterable[str], allowed: Collection[str], what: str) -> None:
    """Raises TypeError for an option that `what` does not have."""
    for option in options:
        if option not in allowed:
            close = difflib.get_close_matches(option, allowed, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise TypeError(f"{option} is no option of {what}{hint}, allowed are {', '.join(allowed)}")


def shown(value: Any) -> str:
    """The value, shortened, with its type."""
    text = repr(value)
    if len(text) > 60 or "\n" in text:
        return f"a {type(value).__name__}"
    return text if value is None else f"{text} ({type(value).__name__})"


#: how a state-space coupling of fixed order may be sought
METHODS = ("complementarity", "inner", "fixed-poles")
