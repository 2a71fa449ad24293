"""Audit a coupling: its requirements, its margins to the edge of each condition, and changes that would help."""

from __future__ import annotations

if __name__ == "__main__":  # This comes before the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("audit")

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec
import numpy as np

from haptic_loop.controller.arithmetic import TooLong
from haptic_loop.controller.coupling import Coupling, SpringDamper
from haptic_loop.controller.loop import Loop
from haptic_loop.design import budgets
from haptic_loop.design.assessment import Assessment, assess
from haptic_loop.design.certificate import conditions_of, named
from haptic_loop.design.conditions import Condition
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.forked import Forked
from haptic_loop.design.gain_search import softest
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.design.necessary import LeftOver, left_over
from haptic_loop.design.result import CAVEATS, GUARD, Requirement, listed, refusal, suffices
from haptic_loop.design.worst_member import Progress

if TYPE_CHECKING:
    from haptic_loop.design.coverage import SwitchingFigures

LONGEST_DELAY = 100  # samples; with longer delays a sweep takes seconds, and no device has enough damping


def _varied(loop: Loop, coupling: Coupling, condition: Condition, **changes: Any) -> Requirement:
    """Return the requirement of a condition after changes of the loop's fields; infinite for an impossible loop."""
    try:
        varied = msgspec.structs.replace(loop, **changes)
    except ValueError as error:  # The latency may exceed a shorter period.
        return refusal(condition.name, loop.delta, str(error))
    return condition.judge(varied, coupling)


def _at_period(loop: Loop, coupling: Coupling, condition: Condition, T: float) -> Requirement:
    """Return the requirement at T [s] with the same coefficients and delays in samples; T_max, T_min scale with T."""
    longest, shortest = (bound and bound * (T / loop.T) for bound in (loop.T_max, loop.T_min))
    return _varied(loop, coupling.at_period(T), condition, T=T, T_max=longest, T_min=shortest)


def check_loop(loop: Loop) -> None:
    """Raise ValueError with the name of the field if the loop cannot be audited."""
    for name in ("theta", "psi"):
        steps = getattr(loop, name)
        if max(steps) > LONGEST_DELAY:
            raise ValueError(f"{name} is {listed(steps)}, allowed are 0 to {LONGEST_DELAY} samples")
    if not all(0 < d < np.inf for d in loop.delta):
        raise ValueError(f"delta, the damping of devices, is {listed(loop.delta)}, expected positive numbers [N s/m]")


# ----------------------------------------------------------------------------------------------------
# Margins: the stiffest K, and the errors of the loop's data that the certificate tolerates.
#
# The loop is varied and the conditions are evaluated again. A search varies one value in steps until the loop becomes
# certified or uncertified, and narrows the last step down to this edge. A search can miss an uncertified interval that
# is narrower than a step. The value that it returns is certified.


_Ratio = Callable[[float], float]  # value that is varied -> required over available damping

#: Ends of the searches for the stiffest K [N/m], the largest T [s] and extra samples, far beyond any device's values.
_STIFFEST, _LONGEST_PERIOD, _MOST_EXTRA_SAMPLES = 1e6, 0.1, 16
_STEP = 3.0  # ratio between successive values of a search
_EDGE = 1e-7  # relative accuracy of the edge between certified and uncertified values
_SMOOTH = 0.1  # A secant estimates the edge only if log(ratio) just outside is below this; else ratio may jump there.


@dataclass(frozen=True)
class _Stiffest:
    """The largest stiffness [N/m] of each channel, all certified together. If one is not known, `reason` says why."""

    K: tuple[float | None, ...]
    reason: str | None = off_table("if given", None)


@dataclass(frozen=True)
class _Sensitivity:
    """The tolerated error of each value if only this value changes; None, with the reason, if it is not known.

    Errors are relative: the certificate holds for every delta above (1 - delta_error) delta, and for (1 + T_error) T.
    """

    least_delta: tuple[float, ...] | None = None  # [N s/m]: the required damping
    delta_error: float | None = None
    largest_T_s: float | None = None  # with the same gains and delays in samples
    T_error: float | None = None
    extra_samples: int | None = None  # largest increase of theta, on all channels at once
    reason: str | None = off_table("if given", None)


def _stiffest(loop: Loop, coupling: Coupling, condition: Condition) -> _Stiffest:
    """Return the largest certified K: channel by channel if the condition is separable, else a common multiple of K."""
    unknown = (None,) * loop.channels
    gains = coupling.figures(loop.T)
    if "K" not in gains:
        return _Stiffest(unknown, "only a spring-damper has a K")
    reason = condition.not_varied(loop)
    if condition.separable(loop):
        reason = reason or condition.beyond(loop)
        return _Stiffest(unknown, reason) if reason else _stiffest_of_each(loop, gains["B"], condition)
    if reason:
        return _Stiffest(unknown, reason)
    K = np.array(gains["K"])

    @cache
    def ratio(scale: float) -> float:
        return condition.judge(loop, coupling.scaled(stiffness=scale)).ratio

    scale = _STIFFEST / K.max()
    if suffices(ratio(scale)):
        return _Stiffest(unknown, f"certified at the stiffest K tried, {_STIFFEST:g} N/m")
    largest = _largest(ratio, scale, softest(loop) / K.max())
    if largest is None:
        return _Stiffest(unknown, f"with this B, no multiple of K tried, down to {softest(loop):g} N/m, is certified")
    return _Stiffest(tuple((largest * K).tolist()))


def _stiffest_of_each(loop: Loop, dampers: Sequence[float], condition: Condition) -> _Stiffest:
    """Return the largest certified K of each channel, at most 2 (delta - B)/T.

    This bound follows from (e) of docs/theory.md at z^(theta + 1) = -1. Without a latency the set of certified gains is
    convex and contains K -> 0, so there is only one edge.
    """
    stiffest, reasons = [], []
    for i, (B, delta) in enumerate(zip(dampers, loop.delta, strict=True)):
        if delta <= B:
            stiffest.append(None)
            reasons.append(f"B = {B:g} N s/m alone uses up delta = {delta:g} N s/m")
            continue
        one = loop.channel(i)

        @cache
        def ratio(K: float, B: float = B, alone: Loop = one) -> float:
            return condition.judge(alone, SpringDamper([K], [B])).ratio

        bound = 2 * (delta - B) / loop.T
        faint = 1e-9 * bound
        largest = edge(ratio, faint, bound) if suffices(ratio(faint)) else _largest(ratio, bound, softest(loop))
        stiffest.append(largest)
        if largest is None:
            reasons.append(f"with B = {B:g} N s/m, no K tried, down to {softest(loop):g} N/m, is certified")
    return _Stiffest(tuple(stiffest), "; ".join(reasons) or None)


def _largest(ratio: _Ratio, most: float, least: float) -> float | None:
    """Return the largest certified value, searched in steps from `most` down to `least`, or None."""
    outside = most
    while outside > least:
        inside = outside / _STEP
        if suffices(ratio(inside)):
            return edge(ratio, inside, outside)
        outside = inside
    return None


def _sensitivity(loop: Loop, coupling: Coupling, condition: Condition, needs: Requirement) -> _Sensitivity:
    """Return the errors in delta, T and delay that the certificate tolerates; `needs` is the requirement."""
    if not needs.certified:
        return _Sensitivity(reason="not certified, so there are no margins")
    if reason := condition.not_varied(loop):
        return _of_delta(needs, reason)
    fixed = loop.environment.one_period
    largest = None if fixed else _largest_period(loop, coupling, condition)
    extra = _extra_samples(loop, coupling, condition)
    tried = (
        "the environment is given for one T only"
        if fixed
        else f"certified up to the largest T tried, {_LONGEST_PERIOD:g} s"
    )
    reasons = [
        tried if largest is None else "",
        f"certified with {_MOST_EXTRA_SAMPLES} samples more, the most that were tried" if extra is None else "",
    ]
    error = None if largest is None else largest / loop.T - 1
    of_delta = _of_delta(needs, "; ".join(filter(None, reasons)) or None)
    return replace(of_delta, largest_T_s=largest, T_error=error, extra_samples=extra)


def _of_delta(needs: Requirement, reason: str | None) -> _Sensitivity:
    """Return the tolerated error of delta, which follows from the requirement."""
    if not needs.certified:
        return _Sensitivity(reason=reason)
    return _Sensitivity(needs.required, 1 - needs.ratio, reason=reason)


def _largest_period(loop: Loop, coupling: Coupling, condition: Condition) -> float | None:
    """Return the largest certified T [s] up to the first edge, or None if every T that was tried is certified."""

    @cache
    def ratio(T: float) -> float:
        return _at_period(loop, coupling, condition, T).ratio

    inside, step = loop.T, 0.1
    while inside < _LONGEST_PERIOD:
        outside = min(inside * (1 + step), _LONGEST_PERIOD)
        if not suffices(ratio(outside)):
            return edge(ratio, inside, outside)
        inside, step = outside, 2 * step
    return None


def _extra_samples(loop: Loop, coupling: Coupling, condition: Condition) -> int | None:
    """Return the largest certified increase of theta, or None if _MOST_EXTRA_SAMPLES more are still certified."""
    for extra in range(1, _MOST_EXTRA_SAMPLES + 1):
        later = tuple(n + extra for n in loop.theta)
        if not _varied(loop, coupling, condition, theta=later).certified:
            return extra - 1
    return None


def edge(ratio: _Ratio, inside: float, outside: float) -> float:
    """Return an argument at which the damping suffices, within a relative _EDGE of the edge between the two arguments.

    The damping must suffice at `inside`. If it also suffices at `outside`, the result is `outside`. The distance to the
    edge is at most the width of the bracket; a secant estimates it. The steps are bisection, or inverse quadratic
    interpolation where it is safe (T. R. Chandrupatla, Adv. Eng. Software 28, 1997). They aim half of _EDGE inside the
    edge, so that the last argument is usually the result.
    """
    if suffices(ratio(outside)):
        return outside

    def above(x: float) -> float:
        return float(np.clip(math.log(max(ratio(x), 1e-9) / (1 - GUARD)), -3, 3))

    a, b = outside, inside
    fa, fb = above(a), above(b)
    share = min(0.9, max(0.1, fa / (fa - fb)))
    while True:
        x = a + share * (b - a)
        fx = above(x)
        if (fx < 0) == (fa < 0):
            c, fc = a, fa
        else:
            c, fc, b, fb = b, fb, a, fa
        a, fa = x, fx
        least = _EDGE * abs(a if fa < 0 else b) / abs(b - a)
        distance = min(fa, fb) / (min(fa, fb) - max(fa, fb)) if max(fa, fb) < _SMOOTH else 1.0
        if distance <= least:
            return a if fa < 0 else b
        place, level, share = (a - b) / (c - b), (fa - fb) / (fc - fb), 0.5
        if 1 - math.sqrt(1 - place) < level < math.sqrt(place):
            share = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        share += math.copysign(least / 2, fa)
        share = min(1 - least / 2, max(least / 2, share))


_FACTORS = (0.75, 0.5, 0.25, 0.1)  # factors on B and T that are tried


@dataclass(frozen=True)
class Help:
    """The mildest change of one kind that certifies the coupling, or else the change with the least requirement."""

    change: str
    requirement: Requirement  # after the change

    def part(self) -> dict[str, Any]:
        needs = self.requirement
        part: dict[str, Any] = {"change": self.change, "condition": needs.condition}
        return part | {"required_damping": needs.required, "certified": needs.certified}


def _helps(loop: Loop, coupling: Coupling, condition: Condition, needs: Requirement) -> list[Help]:
    """Return single changes that certify the coupling or lower its requirement `needs` by more than 10 %."""
    if needs.certified or condition.not_varied(loop):
        return []
    candidates = [_fewer_samples(loop, coupling, condition, name) for name in ("theta", "psi")]
    if any(B := coupling.figures(loop.T).get("B", ())):
        candidates.append(
            _smaller(
                lambda x: condition.judge(loop, coupling.scaled(damping=x)),
                lambda x: f"damper B = {listed([x * b for b in B], 5)} N s/m",
            )
        )
    candidates.append(
        _smaller(
            lambda x: _at_period(loop, coupling, condition, x * loop.T),
            lambda x: f"period T = {1e3 * x * loop.T:.5g} ms",
        )
    )
    least = 0.9 * needs.ratio
    return [r for r in candidates if r and (r.requirement.certified or r.requirement.ratio < least)]


def _fewer_samples(loop: Loop, coupling: Coupling, condition: Condition, name: str) -> Help | None:
    """Return the least reduction, the same for all channels, of the delays `name` that certifies, or else the best."""
    steps, tried = getattr(loop, name), []
    for fewer in range(1, max(steps) + 1):
        less = tuple(max(n - fewer, 0) for n in steps)
        needs = _varied(loop, coupling, condition, lam=(0,) * loop.channels, **{name: less})
        tried.append(Help(f"delay {name} = {listed(less, 5)}", needs))
        if tried[-1].requirement.certified:
            return tried[-1]
    return min(tried, key=lambda each: each.requirement.ratio, default=None)


def _smaller(vary: Callable[[float], Requirement], describe: Callable[[float], str]) -> Help:
    """Return the change by the largest factor that certifies, rounded down to 0.001.

    If no factor certifies, return the change with the least requirement.
    """
    needs = cache(vary)
    for larger, factor in pairwise((1.0, *_FACTORS)):
        if needs(factor).certified:
            mildest = edge(lambda x: needs(x).ratio, factor, larger)
            printable = max(math.floor(1e3 * mildest - 1e-2) / 1e3, factor)  # The printed factor must certify.
            mildest = printable if needs(printable).certified else factor
            return Help(describe(mildest), needs(mildest))
    best = min(_FACTORS, key=lambda x: needs(x).ratio)
    return Help(describe(best), needs(best))


@dataclass(frozen=True)
class Margins:
    """Margins of a coupling to the edge of one condition."""

    stiffest: _Stiffest
    sensitivity: _Sensitivity


@dataclass(frozen=True)
class Audit:
    """The assessment of a coupling with its margins, and changes that help to satisfy a condition that fails."""

    assessment: Assessment
    margins: dict[str, Margins]  # by condition, in the nominal environment with constant delays
    switching: SwitchingFigures | None  # None for constant delays
    helps: list[Help]  # empty for delays that switch, for which no change is searched
    constant: dict[str, Requirement] = off_table("left out")  # by condition, in the loop to which `margins` belong
    not_covered: str = CAVEATS
    left_over: LeftOver | None = off_table("if given", None)  # the damping of Theorem A for known devices


def audit(
    loop: Loop,
    coupling: Coupling,
    condition: Condition | None = None,
    seed: int = 0,
    progress: Progress = lambda done, total: None,
) -> Audit:
    """Audit a coupling: assess it, compute how far each condition is from failing, and search changes that help.

    Args:
        loop: The loop, with the range of switching delays, if any.
        coupling: The coupling to audit.
        condition: The condition that must hold; None for this-environment, or known-device for known devices.
        seed: Seed of the environments that are drawn from inside the loop's ranges.
        progress: Called with (points done, number of points) of the search over ranges.

    Raises:
        ValueError: A field of the loop is wrong; the message names it.
    """
    check_loop(loop)
    wanted = named(condition or (KNOWN_DEVICE if loop.known_devices else THIS_ENVIRONMENT))
    constant = loop.at(loop.environment).switching(None)
    conditions = {each.name: each for each in (*conditions_of(loop), wanted)}
    searched = Forked(_searched, constant, coupling, conditions, wanted.name, not loop.varying_delay)
    assessment = assess(loop, coupling, condition=wanted, ranges_seed=seed, progress=progress)
    needs, switching = assessment.requirements, None
    if loop.varying_delay:
        from haptic_loop.design.coverage import SwitchingFigures  # Audits with constant delays start faster without it.

        switching = SwitchingFigures.of(loop, coupling, needs["switching"])
        needs = {name: each.judge(constant, coupling) for name, each in conditions.items()}
    others = [each for each in conditions.values() if each is not wanted]
    margins = {each.name: _margins(constant, coupling, each, needs[each.name]) for each in others}
    margins[wanted.name], helps = searched.result()
    return Audit(
        assessment,
        {name: margins[name] for name in conditions},
        switching,
        helps,
        {name: needs[name] for name in conditions},
        left_over=left_over(constant, coupling, needs.get(KNOWN_DEVICE.name)),
    )


def _searched(
    loop: Loop, coupling: Coupling, conditions: dict[str, Condition], wanted: str, helping: bool
) -> tuple[Margins, list[Help]]:
    """Return the margins to the edge of the condition `wanted`, and changes that help (none without `helping`).

    Changes are searched for the condition `wanted` or, if it is certified, for the first that is not certified.
    """
    needs = {name: each.judge(loop, coupling) for name, each in conditions.items()}
    fails = next((name for name in conditions if needs[wanted].certified and not needs[name].certified), wanted)
    margins, failing = _margins(loop, coupling, conditions[wanted], needs[wanted]), (conditions[fails], needs[fails])
    if not helping:
        return margins, []
    return margins, _in_time(loop, coupling, lambda: _helps(loop, coupling, *failing), lambda why: [])


_SWEEPS = 60  # typical number of sweeps of a search

_Result = TypeVar("_Result")


def _in_time(
    loop: Loop, coupling: Coupling, search: Callable[[], _Result], without: Callable[[str], _Result]
) -> _Result:
    """Return the result of a search by many sweeps, or `without(reason)` if it takes too long."""
    try:
        reason = budgets.too_long(loop.F(coupling), _SWEEPS)
    except ValueError:  # The loop has no force map; its requirement has the reason.
        reason = None
    if reason:
        return without(f"not searched: {reason}")
    try:
        with budgets.sweeping():
            return search()
    except TooLong as error:
        return without(str(error))


def _margins(loop: Loop, coupling: Coupling, condition: Condition, needs: Requirement) -> Margins:
    unknown, subject = (None,) * loop.channels, (loop, coupling, condition)
    return Margins(
        _in_time(loop, coupling, lambda: _stiffest(*subject), lambda why: _Stiffest(unknown, why)),
        _in_time(loop, coupling, lambda: _sensitivity(*subject, needs), lambda why: _of_delta(needs, why)),
    )
