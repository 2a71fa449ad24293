"""Records of the damping that conditions require, of couplings and of designs, and the errors of designs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args, overload

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.environment import Network
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Array

#: names of the package's conditions, in the order of tables and messages
ConditionName = Literal["any-environment", "this-environment", "known-device", "known-device-any"]
#: the environments that a certificate covers
Environments = Literal["any passive environment", "these ranges", "this environment"]

CONDITIONS: tuple[ConditionName, ...] = get_args(ConditionName)
#: the conditions that need guaranteed bounds of the devices' motors and transmissions
KNOWN_CONDITIONS = tuple(name for name in CONDITIONS if name.startswith("known-device"))
#: the conditions that use only the devices' damping
PLAIN_CONDITIONS = tuple(name for name in CONDITIONS if name not in KNOWN_CONDITIONS)


#: the environments for which this-environment holds in a loop with walls, in words
MAKING = (
    "this environment; its walls may have any gap, make and break contact, and be softer in stiffness and damping alike"
)

ANY: Environments = "any passive environment"
RANGES: Environments = "these ranges"
HERE: Environments = "this environment"
#: titles of two conditions in pictures; every other condition has its name as its title
TITLES = {"this-environment": HERE, "any-environment": ANY}
#: what every certificate assumes and does not cover, in words
CAVEATS = (
    "The proofs are for the linear loop: they hold while forces stay below their limits (clipped ticks are counted) "
    "or pass the limiter that a report names. "
    "They do not cover periods longer than T_max (T without one) or shorter than the latency, encoder steps that do "
    "more work than Coulomb friction dissipates, velocity filters or friction compensation."
)

#: Share of the available damping that must be left over. Figures of a sweep differ by up to 1e-10 between
#: linear-algebra kernels, and by up to 2e-8 with a solver's multiplier.
GUARD = 1e-7


@overload
def suffices(ratio: float) -> bool: ...
@overload
def suffices(ratio: Array) -> NDArray[np.bool_]: ...
def suffices(ratio: float | Array) -> bool | NDArray[np.bool_]:
    """Return whether devices have enough damping; `ratio` is required over available damping."""
    return ratio < 1 - GUARD


@dataclass(frozen=True)
class Requirement:
    """The damping that a condition requires of the devices' m channels, and the damping that they guarantee.

    Attributes:
        condition: A ConditionName, "switching", "limiter" or the name of a user's own condition.
        required: (m,) required damping [N s/m]; inf if no damping is enough.
        available: (m,) damping that the devices guarantee [N s/m].
        frequency_hz: The frequency [Hz] at which the condition binds, or None.
        reason: Why `required` is infinite.
        proof: "rational" for exact arithmetic, "sampled" for a refined sweep.
        multiplier: The multiplier with which `required` was computed, or None.
        bound: A lower bound of `ratio` for every allowed multiplier, from the frequencies of the search, or None. For a
            limiter, `Demand.spare` is first subtracted from the block, and `bound` is at most `ratio`.
        guarantee: The environments for which the condition holds, in words.
        limiter_rho: (m,) stiffnesses rho [N/m] of a limiter that the condition covers without further proof, or None.
        applies: False if the condition does not cover the loop or the coupling, whatever the damping.
    """

    condition: str
    required: tuple[float, ...]
    available: tuple[float, ...]
    frequency_hz: float | None
    reason: str | None = None
    proof: str = "sampled"
    multiplier: tuple[Any, ...] | None = None
    bound: float | None = None
    guarantee: str | None = None
    limiter_rho: tuple[float, ...] | None = None
    applies: bool = True

    def __repr__(self) -> str:
        verdict = f"certified, {self.proof}" if self.certified else "not certified"
        return f"Requirement({self.condition}: {self.words()}, {verdict})"

    def amounts(self, digits: int = 6) -> str:
        """Return the required and the available damping; for an infinite requirement the reason in a few words."""
        if math.isfinite(self.ratio):
            required, available = (listed(values, digits, once=True) for values in (self.required, self.available))
            return f"{required} of {available} N s/m"
        return "no damping is enough" if self.applies else "does not apply"

    def words(self, digits: int = 6) -> str:
        """Return the requirement as a predicate: "needs 1.2 of 1.37 N s/m"."""
        return f"needs {self.amounts(digits)}" if math.isfinite(self.ratio) else self.amounts(digits)

    @property
    def ratio(self) -> float:
        """Required over available damping on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return suffices(self.ratio)

    def part(self) -> dict[str, Any]:
        """Return the requirement for JSON, with `reason` only if there is one."""
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
        """Available over required damping; None if no damping is required, 0 if no damping is enough."""
        return finite(1 / self.ratio) if self.ratio > 0 else None

    @property
    def shortfall(self) -> str:
        """The reason why the condition is not certified."""
        have = listed(self.available)
        return self.reason or f"needs {listed(self.required)} N s/m of damping, has {have}"


def from_ratio(condition: str, ratio: float, available: tuple[float, ...], frequency_hz: float) -> Requirement:
    """Return the requirement of `ratio` times the available damping on every channel."""
    return Requirement(condition, tuple(ratio * delta for delta in available), available, frequency_hz)


def refusal(condition: str, available: tuple[float, ...], reason: str, applies: bool = True) -> Requirement:
    """Return an infinite requirement with its reason."""
    return Requirement(condition, (np.inf,) * len(available), available, None, reason, applies=applies)


def finite(value: float) -> float | None:
    """Return the value, or None for infinity and nan, which JSON cannot express."""
    return float(value) if math.isfinite(value) else None


def switching_guarantee(span: DelayRange) -> str:
    """Return the words for the delays within which any switching is certified."""
    return f"delays switching within {span}"


class NotProved(ValueError):
    """No proof of the condition was found. `requirement` is the requirement by the sweep, or None.

    `refuted` is True if the block of the exact coefficients is clearly negative, so that no proof can exist.
    """

    def __init__(self, reason: str, requirement: Requirement | None = None, refuted: bool = False) -> None:
        super().__init__(reason)
        self.requirement, self.refuted = requirement, refuted


class DesignFailed(ValueError):
    """No design was verified. `problem` is the convex problem or None, `results` are the attempts."""

    def __init__(self, problem: Any, results: Sequence[Any], advice: str) -> None:
        self.problem, self.results, self.advice = problem, tuple(results), advice
        super().__init__(advice)


class Infeasible(DesignFailed):
    """The design problem has no solution."""


def listed(values: Iterable[float | None], digits: int = 6, once: bool = False) -> str:
    """Return values as "1.37, 0.5" with `digits` digits, and None as "inf".

    With `once`, three or more equal values are printed as one.
    """
    texts = ["inf" if v is None else f"{v + 0.0:.{digits}g}" for v in values]
    return texts[0] if once and len(texts) > 2 and len(set(texts)) == 1 else ", ".join(texts)


@dataclass(frozen=True, eq=False)
class Chosen:
    """A coupling, the condition that it was designed for or is judged by, and its origin.

    Attributes:
        coupling: The coupling; a SpringDamper has K (m,) [N/m] and B (m,) [N s/m].
        condition: The name of the condition.
        kind: The kind of the coupling in reports.
        certificate: The Certificate, if this process has proved it or verified it in a file, or None.
        limiter: The Certificate of the file, verified or not, if it covers limited forces, or None.
        c: The multipliers of the limiter that the design found, one row per device, or None.
        searched: The search between the vertices of ranges (design.worst_member.Searched), or None.
        own: The user's own condition (design.conditions.Condition), or None.
        switching: The range of delays [samples] in which the coupling's file proves any switching, or None.
        notes: Remarks on the origin of the coupling, for reports.
        certified_for: The linear network of a MuJoCo scene for which the coupling is certified, or None.
    """

    coupling: Coupling
    condition: str
    kind: str = field(kw_only=True, default="given")
    certificate: Any = field(kw_only=True, default=None)
    limiter: Any = field(kw_only=True, default=None)
    c: Sequence[Sequence[float]] | None = field(kw_only=True, default=None)
    searched: Any = field(kw_only=True, default=None)
    own: Any = field(kw_only=True, default=None)
    switching: DelayRange | None = field(kw_only=True, default=None)
    notes: tuple[str, ...] = field(kw_only=True, default=())
    certified_for: Network | None = field(kw_only=True, default=None)

    @property
    def required_condition(self) -> Any:
        """The user's own condition, or the name of the condition."""
        return self.own or self.condition

    def remarks(self, requirements: Mapping[str, Requirement]) -> tuple[str, ...]:
        """Return the notes, and whether the user's own condition holds."""
        return (*self.notes, self.own.remark(requirements[self.own.name])) if self.own else self.notes

    def fails(self, requirements: Mapping[str, Requirement]) -> bool:
        """Return whether there is a user's own condition that does not hold."""
        return bool(self.own) and not requirements[self.own.name].certified


@dataclass(frozen=True, eq=False)
class Design(Chosen):
    """A coupling with the value of its objective and the damping that it requires.

    Attributes, beside those of Chosen:
        figure: The objective: "loop-norm" (23), "rms" and "sup" (mismatch) are minimised, "stiffness" is maximised.
        objective: The value of the objective for the returned coupling; a ratio, or [N/m] for "stiffness".
        requirement: The requirement of `condition`, from a refined sweep or, if its `proof` says so, a proof.
        sdps: The number of convex problems, of runs of a local search, or of bases of an optimal coupling.
        wall_s: The duration of the design [s].
        hurried: Whether the time limit ended the search, so that more time may find a better coupling.
        phi: (m,) multiplier Phi of Theorem 4 [N s/m], or None.
    """

    figure: str
    objective: float
    requirement: Requirement
    sdps: int = 0
    wall_s: float = 0.0
    hurried: bool = field(kw_only=True, default=False)
    phi: Array | None = field(kw_only=True, default=None)

    def __repr__(self) -> str:
        return f"Design({self.coupling!r} for {self.requirement!r})"


def held_torques(loop: Loop) -> str | None:
    """Return the remark that proofs neglect the change of pose while motors hold torques; None without `axes`."""
    return "while motors hold torques, the force changes with the pose: not covered" if loop.axes else None
