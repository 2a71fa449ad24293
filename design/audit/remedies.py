"""What would help a coupling that a condition does not certify, found by trying each change alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

from controller.coupling import SpringDamper
from design.audit.figures import edge
from design.audit.subject import Subject
from design.listed import listed
from design.margin import Requirement
from design.store import Condition

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
