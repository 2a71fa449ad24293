"""What an audit says of a coupling: both conditions, how far it is from their edges, and what would help."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Any, Self, cast, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from controller.coupling import (
    Compliance,
    Coupling,
    ForceFilter,
    InternalModel,
    MovingAverage,
    NoCoupling,
    SpringDamper,
)
from controller.environment import GROUND, Network, Spring, environment, held
from controller.loop import DelayRange, Loop, force_map
from controller.lti import Lti, SingularLoop
from design.certificate import (
    ANY,
    CAVEATS,
    LATE,
    certificate_part,
    closed_loop_of,
    making_covered,
    promise,
    switching_part,
    switching_requirement,
    theorem4_of,
)
from design.conditions import (
    Condition,
    JitterProof,
    Requirement,
    any_environment,
    jitter_proof,
    jitter_refusal,
    refusal,
    this_environment,
)
from design.ranges import SetCheck, set_part
from design.result import listed

# ----------------------------------------------------------------------------------------------------
# What an audit is about: a coupling in its loop, judged by either condition and ready to be varied.


#: Beyond this many samples a sweep takes seconds, and no device's damping is enough.
LONGEST_DELAY = 100


@dataclass(frozen=True, eq=False)
class Subject:
    """A coupling between devices and an environment. Raises ValueError naming the field that is wrong."""

    coupling: Coupling
    network: Network | None  # None is a rigid wall behind the coupling, one channel
    T: float  # [s]
    theta: tuple[int, ...]  # (m,) transmission delays [samples]
    psi: tuple[int, ...]  # (m,) environment delays [samples]
    delta: tuple[float, ...]  # (m,) damping that the devices guarantee [N s/m]
    T_max: float | None = None  # [s] the longest period, where it varies
    latency: tuple[tuple[float, float], ...] | None = None  # (m,) [s] by which forces latch after a tick

    def __post_init__(self) -> None:
        for name in ("theta", "psi"):
            if not all(0 <= n <= LONGEST_DELAY for n in getattr(self, name)):
                raise ValueError(f"{name} is {listed(getattr(self, name))}, allowed are 0 to {LONGEST_DELAY} samples")
        if not all(0 < d < np.inf for d in self.delta):
            raise ValueError(f"delta is {listed(self.delta)}, expected positive dampings in N s/m")
        if self.network is None and not isinstance(self.coupling, SpringDamper):
            raise ValueError("a rigid wall needs a spring-damper in front of it")
        if self.network is None and any(self.psi):
            raise ValueError(
                f"psi is {listed(self.psi)}: behind a rigid wall no loop with a delayed environment is stable"
            )

    @property
    def channels(self) -> int:
        return len(self.delta)

    @property
    def walls(self) -> bool:
        """Whether contact is made and broken."""
        return self.network is not None and bool(self.network.walls)

    @property
    def F(self) -> Lti:
        """What the devices see (6), walls touching; against a rigid wall (E -> infinity) that is Theta V^-1.

        Raises SingularLoop.
        """
        if self.network is not None:
            return force_map(environment(held(self.network), self.T), self.coupling, self.theta, self.psi)
        assert isinstance(self.coupling, SpringDamper)
        (K,), (B,) = self.coupling.K.tolist(), self.coupling.B.tolist()
        clamped = Network(("contact",), (Spring(("contact", GROUND), K, B),))
        return force_map(environment(clamped, self.T), NoCoupling(), self.theta, self.psi)

    @property
    def G(self) -> Lti:
        """The forces as they leave for the devices: F without Theta. Raises SingularLoop."""
        return replace(self, theta=(0,) * self.channels).F

    def switching(self, span: DelayRange) -> JitterProof:
        """The damping that any switching of the forces' delays within this range asks of the devices."""
        if self.network is not None and not self.walls:
            return switching_requirement(replace(self, latency=None)._loop(self.network).switching(span), self.coupling)
        try:
            return jitter_proof(self.G, span.lo, span.hi, self.delta, T_max=self.T_max)
        except SingularLoop as error:
            return jitter_refusal(self.delta, str(error))

    def requirement(self, condition: Condition) -> Requirement:
        """The damping that the condition asks of the devices."""
        return self._closed_loop() if condition == "closed-loop" else self._theorem4()

    def with_period(self, T: float) -> Self:
        """The same gains (of a state-space coupling: the same coefficients) and delays in samples at another T [s]."""
        coupling = self.coupling
        if isinstance(coupling, Compliance):
            coupling = Compliance(replace(coupling.V, T=T))
        longest = self.T_max and self.T_max * (T / self.T)  # periods vary in proportion
        return replace(self, coupling=coupling, T=T, T_max=longest)

    def with_gains(self, K: ArrayLike, B: ArrayLike) -> Self:
        """The same loop with another spring-damper [N/m, N s/m]."""
        return replace(self, coupling=SpringDamper(K, B))

    def _closed_loop(self) -> Requirement:
        try:
            if self.network is None:
                return this_environment(self.F, self.delta, self.T_max, self.latency)
            return closed_loop_of(self._loop(self.network), self.coupling)
        except ValueError as error:  # no solution of the algebraic loop, or a latency that is longer than a period
            return refusal("closed-loop", self.delta, str(error))

    def _theorem4(self) -> Requirement:
        # what is behind a wall's coupling does not matter to Theorem 4
        network = self.network or Network(("contact",), masses={"contact": 1.0})
        try:
            return theorem4_of(self._loop(network), self.coupling)
        except ValueError as error:
            return refusal("theorem4", self.delta, str(error))

    def _loop(self, network: Network) -> Loop:
        timing = {"T_max": self.T_max, "latency": self.latency}
        return Loop(self.T, self.theta, self.psi, self.theta, self.delta, network, **timing)


# ----------------------------------------------------------------------------------------------------
# How far a coupling is from the edge of its certificate: the stiffest K, and what may be wrong before it is lost.
#
# Everything is found by varying a Subject and asking the conditions of design.margin again: no solver. A search goes
# outwards in steps and locates the edge between the last two, so a gap narrower than a step can be missed; what is
# returned is itself certified, and the other side of the edge is not.


Ratio = Callable[[float], float]  # required over available damping, of a varied loop

#: Searches of the stiffest K and the largest T end here; each is far outside what any device is used with.
STIFFEST, LONGEST_PERIOD, MOST_EXTRA_SAMPLES = 1e6, 0.1, 16
SOFTEST, STEP = 1.0, 3.0  # [N/m]; between two stiffnesses tried
EDGE = 1e-7  # relative accuracy of an edge
NOT_CERTIFIED = "not certified: there is nothing to lose"


@dataclass(frozen=True)
class Stiffest:
    """The largest certified stiffness of each channel beside its B [N/m]; None where the reason says why."""

    K: tuple[float | None, ...]
    reason: str | None = None


@dataclass(frozen=True)
class Tolerance:
    """What may be wrong, one thing at a time, before the certificate is lost; None where the reason says why."""

    least_delta: tuple[float, ...] | None  # [N s/m]: the required damping
    largest_T: float | None  # [s], gains and delays in samples kept
    extra_samples: int | None  # of delay, on all channels at once
    reason: str | None = None


def stiffest(subject: Subject, condition: Condition) -> Stiffest:
    """any-environment: channel by channel; this-environment: the largest common scale of all K."""
    unknown = (None,) * subject.channels
    if not isinstance(subject.coupling, SpringDamper):
        return Stiffest(unknown, "only a spring-damper has a K")
    if condition == "theorem4":
        return _stiffest_for_any_environment(subject, subject.coupling)
    K, B = subject.coupling.K, subject.coupling.B

    @cache
    def ratio(scale: float) -> float:
        return subject.with_gains(scale * K, B).requirement(condition).ratio

    scale = STIFFEST / K.max()
    if ratio(scale) < 1:
        return Stiffest(unknown, f"certified up to the stiffest K tried, {STIFFEST:g} N/m")
    while scale * K.max() > SOFTEST:
        softer = scale / STEP
        if ratio(softer) < 1:
            return Stiffest(tuple((edge(ratio, softer, scale) * K).tolist()))
        scale = softer
    return Stiffest(unknown, "no scale of K is certified beside this B")


def _stiffest_for_any_environment(subject: Subject, coupling: SpringDamper) -> Stiffest:
    """Between 0 and 2 (delta - B)/T, the bound where z^-n = -1; the set of gains is convex and contains K -> 0."""
    if any(subject.psi):
        return Stiffest((None,) * subject.channels, "with psi >= 1 each K needs a multiplier of its own: not searched")
    if subject.latency:
        return Stiffest((None,) * subject.channels, LATE)
    stiffest, reasons = [], []
    for B, theta, delta in zip(coupling.B.tolist(), subject.theta, subject.delta, strict=True):
        if delta <= B:
            stiffest.append(None)
            reasons.append(f"B = {B:g} N s/m alone uses up delta = {delta:g} N s/m")
            continue

        @cache
        def ratio(K: float, B: float = B, theta: int = theta, delta: float = delta) -> float:
            V = SpringDamper([K], [B]).compliance(subject.T)
            return any_environment(V, [theta], [delta], subject.T_max).ratio

        bound = 2 * (delta - B) / subject.T
        stiffest.append(edge(ratio, 1e-9 * bound, bound))
    return Stiffest(tuple(stiffest), "; ".join(reasons) or None)


def tolerance(subject: Subject, requirement: Requirement) -> Tolerance:
    """How much error in delta, T and delay the certificate by `requirement.condition` tolerates."""
    condition = requirement.condition
    if not requirement.certified:
        return Tolerance(None, None, None, NOT_CERTIFIED)
    if condition == "theorem4" and any(subject.psi):
        reason = "with psi >= 1 every T and delay needs a multiplier of its own: not searched"
        return Tolerance(requirement.required, None, None, reason)
    largest = _largest_period(subject, condition)
    extra = _extra_samples(subject, condition)
    reasons = [
        f"certified up to the largest T tried, {LONGEST_PERIOD:g} s" if largest is None else "",
        f"certified with {MOST_EXTRA_SAMPLES} samples more, the most that were tried" if extra is None else "",
    ]
    return Tolerance(requirement.required, largest, extra, "; ".join(filter(None, reasons)) or None)


def _largest_period(subject: Subject, condition: Condition) -> float | None:
    @cache
    def ratio(T: float) -> float:
        return subject.with_period(T).requirement(condition).ratio

    inside, step = subject.T, 0.1
    while inside < LONGEST_PERIOD:
        outside = min(inside * (1 + step), LONGEST_PERIOD)
        if ratio(outside) >= 1:
            return edge(ratio, inside, outside)
        inside, step = outside, 2 * step
    return None


def _extra_samples(subject: Subject, condition: Condition) -> int | None:
    for extra in range(1, MOST_EXTRA_SAMPLES + 1):
        later = replace(subject, theta=tuple(n + extra for n in subject.theta))
        if not later.requirement(condition).certified:
            return extra - 1
    return None


def edge(ratio: Ratio, inside: float, outside: float) -> float:
    """The argument nearest `outside` at which the ratio is still below 1, to a relative EDGE."""
    if ratio(outside) < 1:
        return outside

    def above(x: float) -> float:
        return float(np.clip(math.log(max(ratio(x), 1e-9)), -3, 3))

    root = cast(float, brentq(above, inside, outside, rtol=np.float64(EDGE), xtol=EDGE * inside))
    for back in EDGE * 4.0 ** np.arange(12):
        x = root + back * (inside - root)
        if ratio(x) < 1:
            return float(x)
    return inside


# ----------------------------------------------------------------------------------------------------
# What would help a coupling that a condition does not certify, found by trying each change alone.


FACTORS = (0.75, 0.5, 0.25, 0.1)  # of B and T that are tried


@dataclass(frozen=True, eq=False)
class Remedy:
    """One change, as mild as certifies; or, where none does, the one that lowers the required damping most."""

    change: str
    requirement: Requirement


def remedies(subject: Subject, requirement: Requirement) -> list[Remedy]:
    """What certifies, or lowers the required damping by 10 % or more, each change alone; [] where it is certified."""
    condition = requirement.condition
    if requirement.certified or (condition == "theorem4" and any(subject.psi)):
        return []
    found = [_fewer_samples(subject, condition, name) for name in ("theta", "psi")]
    coupling = subject.coupling
    if isinstance(coupling, SpringDamper) and coupling.B.any():
        found.append(
            _smaller(
                lambda x: subject.with_gains(coupling.K, x * coupling.B),
                lambda x: f"smaller B: {listed((x * coupling.B).tolist(), 5)} N s/m",
                condition,
            )
        )
    found.append(
        _smaller(
            lambda x: subject.with_period(x * subject.T),
            lambda x: f"faster: T = {1e3 * x * subject.T:.5g} ms",
            condition,
        )
    )
    least = 0.9 * requirement.ratio
    return [r for r in found if r and (r.requirement.certified or r.requirement.ratio < least)]


def _fewer_samples(subject: Subject, condition: Condition, name: str) -> Remedy | None:
    """One sample less at a time, on every channel that has one."""
    steps, tried = getattr(subject, name), []
    for fewer in range(1, max(steps) + 1):
        less = tuple(max(n - fewer, 0) for n in steps)
        tried.append(
            Remedy(f"less delay: {name} = {listed(less, 5)}", replace(subject, **{name: less}).requirement(condition))
        )
        if tried[-1].requirement.certified:
            return tried[-1]
    return min(tried, key=lambda remedy: remedy.requirement.ratio, default=None)


def _smaller(vary: Callable[[float], Subject], describe: Callable[[float], str], condition: Condition) -> Remedy:
    """The largest factor that certifies, in steps of 0.001; where none does, the one that needs the least damping."""

    @cache
    def requirement(factor: float) -> Requirement:
        return vary(factor).requirement(condition)

    for larger, factor in pairwise((1.0, *FACTORS)):
        if requirement(factor).certified:
            mildest = edge(lambda x: requirement(x).ratio, factor, larger)
            printable = max(math.floor(1e3 * mildest - 1e-2) / 1e3, factor)  # certified as rounded for the report
            mildest = printable if requirement(printable).certified else factor
            return Remedy(describe(mildest), requirement(mildest))
    best = min(FACTORS, key=lambda x: requirement(x).ratio)
    return Remedy(describe(best), requirement(best))


KINDS = {
    NoCoupling: "none",
    SpringDamper: "spring-damper",
    MovingAverage: "moving-average",
    Compliance: "compliance",
    InternalModel: "internal-model",
    ForceFilter: "force-filter",
}


def report(
    subject: Subject,
    switching: DelayRange | None = None,
    whole: SetCheck | None = None,
) -> dict[str, Any]:
    """Both conditions with what surrounds them; SI units, null with a "reason" where a figure does not exist.

    With a range of delays also the damping that any switching within it asks; `whole` is the same coupling over the
    box around the environment, if there is one.
    """
    requirements = {condition: subject.requirement(condition) for condition in reversed(get_args(Condition))}
    here, anywhere = requirements["closed-loop"].certified, requirements["theorem4"].certified
    proved = bool(whole and whole.proved)
    rigid = subject.network is None
    making = subject.network is not None and making_covered(subject._loop(subject.network))
    promised = promise(anywhere, here, rigid=rigid, walls=subject.walls, making=making, whole_set=proved)
    gains = subject.coupling if isinstance(subject.coupling, SpringDamper) else None
    return {
        "coupling": {
            "kind": KINDS[type(subject.coupling)],
            "K": gains.K.tolist() if gains else None,
            "B": gains.B.tolist() if gains else None,
        },
        "loop": {
            "T_s": subject.T,
            "T_max_s": subject.T_max,
            "latency_s": subject.latency,
            "theta": list(subject.theta),
            "psi": list(subject.psi),
            "delta": list(subject.delta),
            "rigid": subject.network is None,
        },
        **{condition: _condition_part(subject, requirement) for condition, requirement in requirements.items()},
        "jitter-proof": _switching_part(subject, switching) if switching else None,
        "set": whole and set_part(whole),
        "certified": here and (whole is None or proved or promised == ANY),
        "promise": promised,
        "helps": _helps(subject, requirements["theorem4" if here else "closed-loop"]),
        "not_covered": CAVEATS,
    }


def _condition_part(subject: Subject, requirement: Requirement) -> dict[str, Any]:
    return certificate_part(requirement) | {
        "stiffest": _stiffest_part(stiffest(subject, requirement.condition)),
        "sensitivity": _sensitivity_part(subject, requirement, tolerance(subject, requirement)),
    }


def _switching_part(subject: Subject, span: DelayRange) -> dict[str, Any]:
    found = subject.switching(span)
    if found.requirement.reason:
        return certificate_part(found.requirement) | {"lo": list(span.lo), "hi": list(span.hi)}
    return switching_part(found, subject.G, span, subject.T_max)


def _stiffest_part(found: Stiffest) -> dict[str, Any]:
    return {"K": list(found.K)} | _because(found.reason)


def _sensitivity_part(subject: Subject, requirement: Requirement, found: Tolerance) -> dict[str, Any]:
    """Errors are relative: delta may be 1 - delta_error times and T 1 + T_error times what was given."""
    return {
        "least_delta": None if found.least_delta is None else list(found.least_delta),
        "delta_error": None if found.least_delta is None else 1 - requirement.ratio,
        "largest_T_s": found.largest_T,
        "T_error": None if found.largest_T is None else found.largest_T / subject.T - 1,
        "extra_samples": found.extra_samples,
    } | _because(found.reason)


def _because(reason: str | None) -> dict[str, str]:
    return {"reason": reason} if reason else {}


def _helps(subject: Subject, requirement: Requirement) -> list[dict[str, Any]]:
    """Changes that help the condition that fails first: closed-loop, else any_environment."""
    return [
        {
            "change": remedy.change,
            "condition": requirement.condition,
            "required_damping": list(remedy.requirement.required),
            "certified": remedy.requirement.certified,
        }
        for remedy in remedies(subject, requirement)
    ]


if __name__ == "__main__":
    from cli.main import door

    door("audit")
