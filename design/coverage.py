"""Compute the figures of reports: requirements under switching delays, requirements and mismatches over ranges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.ranges import Member
from haptic_loop.design.certificate import judged
from haptic_loop.design.conditions import this_environment
from haptic_loop.design.environments import SWITCHING, THIS_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.result import Design, DesignFailed, Requirement, suffices
from haptic_loop.design.transparency import decibels, transparency

_NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: varying delays "
    "of the measured positions, periods longer than T_max, or forces older than the range, as after lost packets."
)


@dataclass(frozen=True)
class _Playout:
    """Requirement of this-environment for the constant delay hi, as behind a playout buffer."""

    theta: tuple[int, ...]
    required_damping: tuple[float, ...]
    certified: bool


@dataclass(frozen=True)
class SwitchingFigures:
    """Requirement for any switching of the delays within a loop's range, lo to hi (m,) [samples].

    If the requirement is infinite, the figures after lo and hi are None.
    """

    requirement: Requirement = off_table("inlined")
    lo: tuple[int, ...] = off_table()
    hi: tuple[int, ...] = off_table()
    alpha: tuple[float, ...] | None = off_table("if given", None)  # all multipliers, alpha [N/m] last (facts.Switching)
    playout: _Playout | None = off_table("if given", None)
    not_covered: str | None = off_table("if given", None)

    @classmethod
    def of(cls, loop: Loop, coupling: Coupling, known: Requirement | None = None) -> SwitchingFigures:
        """Evaluate a coupling in the nominal environment; `known` is the requirement of SWITCHING there, if known."""
        loop = loop.at(loop.environment)
        requirement, span = known or judged(loop, coupling, SWITCHING), loop.delays
        if requirement.reason:
            return cls(requirement, span.lo, span.hi)
        latest = loop.delayed(span.hi)
        buffered = THIS_ENVIRONMENT.judge(latest, coupling)
        playout = _Playout(span.hi, buffered.required, buffered.certified)
        return cls(requirement, span.lo, span.hi, requirement.multiplier, playout, _NOT_COVERED)


@dataclass(frozen=True)
class NominalWorst:
    """A figure in the nominal environment, and its worst value in the members of ranges (Loop.members)."""

    nominal: float
    worst: float


@dataclass(frozen=True)
class OverRanges:
    """Requirement of this-environment and mismatch in the members of ranges; minus infinity dB is null in JSON."""

    coupling: str
    violated: int  # number of members in which this-environment is violated
    required_over_available: NominalWorst
    rms_mismatch_db: NominalWorst
    relative_mismatch_db: NominalWorst
    worst: str  # name of the member with the largest rms mismatch

    @classmethod
    def of(cls, name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> OverRanges:
        """Evaluate a coupling over the members; members that exert no force have no mismatch."""
        ratios, figures = [], {}
        # One set of multipliers for delays that switch serves all members, as in a proof.
        multiplier = THIS_ENVIRONMENT.judge(loop, coupling).multiplier if loop.varying_delay else None
        for member in members:
            here = loop.at(member.network)
            E, F = here.E(), here.F(coupling)
            needs = THIS_ENVIRONMENT.judge(here, coupling, multiplier) if multiplier else this_environment(F, loop)
            ratios.append(needs.ratio)
            if E.D.any():
                figures[member.name] = transparency(F, E, loop.lam)
        nominal, worst = figures[members[0].name], max(figures, key=lambda member: figures[member].rms_mismatch)
        largest = max(f.relative_mismatch for f in figures.values())
        return cls(
            name,
            sum(not suffices(ratio) for ratio in ratios),
            NominalWorst(ratios[0], max(ratios)),
            NominalWorst(nominal.rms_mismatch_db, figures[worst].rms_mismatch_db),
            NominalWorst(nominal.mismatch_db, decibels(largest)),
            worst,
        )


def price(loop: Loop, design: Design, kind: str, nominal: Callable[[Loop], Design] | None) -> list[OverRanges]:
    """Return the figures over the ranges of `nominal`'s design without ranges, if it makes one, and of `design`."""
    couplings = {kind: design.coupling}
    if nominal:
        couplings = {"whole ranges": design.coupling}
        with suppress(DesignFailed):  # The design without ranges may fail.
            couplings = {"nominal only": nominal(loop.at(loop.environment)).coupling, **couplings}
    members = loop.members()
    return [OverRanges.of(name, loop, coupling, members) for name, coupling in couplings.items()]
