"""How far a coupling is from the edge of its certificate: the stiffest K, and what may be wrong before it is lost.

Everything is found by varying a Subject and asking the conditions of design.margin again: no solver. A search goes
outwards in steps and locates the edge between the last two, so a gap narrower than a step can be missed; what is
returned is itself certified, and the other side of the edge is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import cast

import numpy as np
from scipy.optimize import brentq

from controller.coupling import SpringDamper
from design.audit.subject import Subject
from design.margin import Requirement, theorem4
from design.store import Condition

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
    """theorem4: channel by channel; closed-loop: the largest common scale of all K, by steps of 3 down from 1e6 N/m."""
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
    stiffest, reasons = [], []
    for B, theta, delta in zip(coupling.B.tolist(), subject.theta, subject.delta, strict=True):
        if delta <= B:
            stiffest.append(None)
            reasons.append(f"B = {B:g} N s/m alone uses up delta = {delta:g} N s/m")
            continue

        @cache
        def ratio(K: float, B: float = B, theta: int = theta, delta: float = delta) -> float:
            return theorem4(SpringDamper([K], [B]).compliance(subject.T), [theta], [delta]).ratio

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
