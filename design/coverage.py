"""Compute figures of reports: the damping required for switching delays, over ranges, and in similar environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import msgspec

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.environment import Network
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.ranges import Member, Ranges, UncertainSpring
from haptic_loop.design.certificate import judged
from haptic_loop.design.conditions import Condition, this_environment
from haptic_loop.design.environments import SWITCHING, THIS_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.result import ANY, Design, DesignFailed, Requirement, suffices
from haptic_loop.design.transparency import decibels, transparency

_NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: varying delays "
    "of the measured positions, periods longer than T_max, or forces older than the range, as after lost packets."
)


@dataclass(frozen=True)
class _Playout:
    """Requirement of this-environment for the constant delay hi, which a playout buffer would cause."""

    theta: tuple[int, ...]
    required_damping: tuple[float, ...]
    certified: bool


@dataclass(frozen=True)
class SwitchingFigures:
    """Requirement for delays that switch at every tick within a loop's range, from lo to hi (m,) [samples].

    If the requirement is infinite, the fields after `hi` are None.
    """

    requirement: Requirement = off_table("inlined")
    lo: tuple[int, ...] = off_table()
    hi: tuple[int, ...] = off_table()
    alpha: tuple[float, ...] | None = off_table("if given", None)  # all multipliers; the last are alpha [N/m]
    playout: _Playout | None = off_table("if given", None)
    not_covered: str | None = off_table("if given", None)

    @classmethod
    def of(cls, loop: Loop, coupling: Coupling, known: Requirement | None = None) -> SwitchingFigures:
        """Evaluate a coupling in the nominal environment. `known` is its requirement of SWITCHING, or None."""
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
    """A figure in the nominal environment, and its worst value in all environments of `Loop.members`."""

    nominal: float
    worst: float


@dataclass(frozen=True)
class OverRanges:
    """Requirement of this-environment and mismatch in all environments of `Loop.members`.

    In JSON a mismatch of minus infinity dB is null.
    """

    coupling: str
    violated: int  # number of environments in which this-environment is violated
    required_over_available: NominalWorst
    rms_mismatch_db: NominalWorst
    relative_mismatch_db: NominalWorst
    worst: str  # name of the environment with the largest rms mismatch

    @classmethod
    def of(cls, name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> OverRanges:
        """Evaluate a coupling in all `members`; a member that exerts no force has no mismatch."""
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
    """Return figures over the ranges: first of the design that `nominal` makes without ranges, then of `design`.

    The first are left out if `nominal` is None or its design fails.
    """
    couplings = {kind: design.coupling}
    if nominal:
        couplings = {"whole ranges": design.coupling}
        with suppress(DesignFailed):
            couplings = {"nominal only": nominal(loop.at(loop.environment)).coupling, **couplings}
    members = loop.members()
    return [OverRanges.of(name, loop, coupling, members) for name, coupling in couplings.items()]


# ----------------------------------------------------------------------------------------------------
# Robustness: the damping that a coupling requires in environments near the environment of its design.


_PERCENT = 10.0  # change of a parameter in reports


@dataclass(frozen=True)
class Robustness:
    """The worst requirement of a coupling in the nominal environment and the similar environments of `_nearby`."""

    percent: float
    required_over_available: float  # required over available damping in the worst environment
    where: str  # the parameter that differs in the worst environment, with its sign, or "nominal"
    certified: bool  # whether the condition holds in the worst environment


def _nearby(network: Network) -> dict[str, Network]:
    """Return networks by name. In each, one spring, all springs or one mass is changed by plus or minus _PERCENT.

    Raises ValueError if a changed stiffness or mass exceeds the largest that a network may have.
    """
    changed = {}
    stiff = [i for i, spring in enumerate(network.springs) if spring.stiffness > 0]
    for sign, factor in (("+", 1 + _PERCENT / 100), ("-", 1 - _PERCENT / 100)):

        def stiffer(which: Sequence[int], factor: float = factor) -> Network:
            springs = [
                msgspec.structs.replace(spring, stiffness=spring.stiffness * factor) if i in which else spring
                for i, spring in enumerate(network.springs)
            ]
            return msgspec.structs.replace(network, springs=tuple(springs))

        for i in stiff:
            ends = network.springs[i].between
            alike = [j for j in stiff if network.springs[j].between == ends]
            which = f", spring {alike.index(i) + 1} of {len(alike)}" if len(alike) > 1 else ""
            changed[f"{sign}{_PERCENT:g} % stiffness between {' and '.join(ends)}{which}"] = stiffer([i])
        if len(stiff) > 1:
            changed[f"{sign}{_PERCENT:g} % stiffness of all springs"] = stiffer(stiff)
        for node, mass in network.masses.items():
            if mass > 0:
                masses = {**network.masses, node: mass * factor}
                changed[f"{sign}{_PERCENT:g} % mass of {node}"] = msgspec.structs.replace(network, masses=masses)
    return changed


def robustness_nearby(loop: Loop, coupling: Coupling, condition: Condition = THIS_ENVIRONMENT) -> Robustness | None:
    """Return the worst requirement of `condition` in the environment and near it, or None if this does not apply.

    The environment must be a network without walls and without a block E(z), and allow an increase of each value by
    _PERCENT. The condition must cover the loop. It must neither hold in every environment nor have a reason
    `not_varied`.
    """
    if condition.guarantee(loop) == ANY or condition.not_varied(loop) or condition.beyond(loop.at(loop.environment)):
        return None
    if loop.environment.walls or not isinstance(loop.environment, Network) or loop.environment.block:
        return None
    try:
        networks = {"nominal": loop.environment, **_nearby(loop.network)}
    except ValueError:
        return None
    ratios = {name: condition.ratio(loop.at(network), coupling) for name, network in networks.items()}
    where = max(ratios, key=lambda name: ratios[name])
    return Robustness(_PERCENT, ratios[where], where, suffices(ratios[where]))


def ranges_around(network: Network, percent: float) -> Ranges:
    """Return ranges in which every stiffness and every mass varies by `percent`, independently of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
