"""What is covered beyond one linear environment, as figures of a report: ranges, delays that switch, limited forces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.ranges import Member
from haptic_loop.design.certificate import RangesCheck, check_limiter, judged, prove_limiter, required_damping
from haptic_loop.design.conditions import this_environment
from haptic_loop.design.coupling_file import Certificate, LimiterCertificate
from haptic_loop.design.environments import BETA, LIMITER, SWITCHING, THIS_ENVIRONMENT, LimitedForces, worst
from haptic_loop.design.files import off_table
from haptic_loop.design.guarantees import ANY
from haptic_loop.design.result import Design, DesignFailed, NotProved, Requirement
from haptic_loop.design.transparency import decibels, transparency
from haptic_loop.design.worst_member import SEARCH, Searched

_OWN_PROOF = "by a proof of its own, for this environment"


@dataclass(frozen=True)
class Limits:
    """Whether a guarantee holds while forces are at their limits, and the limiter that it is about."""

    rho: tuple[float, ...] | None  # (m,) [N/m] of the limiter; None: no guarantee, so the tick clips
    reason: str  # why it holds, or why it does not
    requirement: Requirement | None = None  # by the condition `limiter`, where it was asked
    c: tuple[tuple[float, ...], ...] = ()  # its multiplier
    certificate: LimiterCertificate | None = None  # its proof
    force_limit: tuple[float, ...] = ()  # (m,) [N]
    less: bool = False  # it is proved for this environment, while a guarantee holds for any

    def within(self, force_limit: Sequence[float]) -> Limits:
        """The same, of forces limited to so many N."""
        return replace(self, force_limit=tuple(force_limit))

    @property
    def words(self) -> str:
        """In one line."""
        amounts = [f"{f:.4g}" for f in self.force_limit]
        limit = f"{', '.join(amounts if len(set(amounts)) > 1 else amounts[:1])} N"
        if self.rho is None:
            why = self.reason.removeprefix("limiter: ")
            return f"clipped at {limit}: a guarantee holds while forces stay below ({why})"
        if not self.proved:
            return f"certified, also while forces are limited to {limit} ({self.reason})"
        return f"proved, also while forces are limited to {limit}{', in this environment' if self.less else ''}"

    @property
    def proved(self) -> bool:
        """In exact arithmetic."""
        return self.rho is not None and (self.requirement is None or self.requirement.proof == "rational")

    def part(self) -> dict[str, Any]:
        """As JSON has it."""
        shown = {"rho": self.rho, "force_limit": self.force_limit, "reason": self.reason, "words": self.words}
        return shown | {"certificate": self.requirement, "c": self.c}


def covered_limits(
    loop: Loop,
    coupling: Coupling,
    requirements: Mapping[str, Requirement],
    proof: LimiterCertificate | None = None,
    known: Certificate | None = None,
) -> Limits:
    """The limiter that a coupling may have: of no lag under any-environment, else that of its own condition.

    With `proof`, which the coupling comes with, it is the limiter of that proof; in a loop for which it is none, the
    one of the same beta. What `known` contains is not proved again (design.certificate.check_limiter).
    """
    if loop.varying_delay:
        return Limits(None, str(LIMITER.beyond(loop)))
    for each in requirements.values():
        if each.certified and each.lag is not None:
            return Limits(each.lag, f"{each.condition} covers limited forces")
    if not requirements[THIS_ENVIRONMENT.name].certified:
        return Limits(None, "no guarantee that it could extend")
    less = any(each.certified and each.guarantee == ANY for each in requirements.values())
    return replace(_by_its_own_block(loop, coupling, proof, known), less=less)


def _by_its_own_block(
    loop: Loop, coupling: Coupling, proof: LimiterCertificate | None, known: Certificate | None
) -> Limits:
    """The limiter of this-environment."""
    if proof:
        try:
            requirement = check_limiter(loop, coupling, proof, known)
            return Limits(proof.rho, _OWN_PROOF, requirement, proof.c, proof)
        except NotProved:  # made for another loop
            pass
    limiter = LimitedForces(proof.beta if proof and 0 < proof.beta <= 1 else BETA)
    requirement = required_damping(loop, coupling, limiter)
    c = limiter.rows(loop, requirement.multiplier or ())
    if not requirement.certified:
        needs = f"limiter: needs {', '.join(f'{d:.5g}' for d in requirement.required)} N s/m of damping"
        return Limits(None, requirement.reason or needs, requirement, c)
    try:
        proved = prove_limiter(loop, coupling, limiter.beta, swept=requirement)
    except NotProved as refused:
        return Limits(limiter.rho(loop), f"swept, not proved: {refused}", requirement, c)
    return Limits(proved.rho, _OWN_PROOF, replace(requirement, proof="rational"), c, proved)


# ----------------------------------------------------------------------------------------------------
# What a report says of delays that vary: what switching asks beside that of the playout buffer.


_NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: varying delays "
    "of the measured positions, periods longer than T_max, or forces older than the range, which lost packets make."
)


@dataclass(frozen=True)
class _Playout:
    """What the constant delay hi asks, which a playout buffer makes."""

    theta: tuple[int, ...]
    required_damping: tuple[float, ...]
    certified: bool


@dataclass(frozen=True)
class Switching:
    """What any switching within a loop's range of delays asks; only the requirement where its reason says why."""

    requirement: Requirement = off_table("inlined")
    lo: tuple[int, ...] = off_table()
    hi: tuple[int, ...] = off_table()
    alpha: tuple[float, ...] | None = off_table("if given", None)
    playout: _Playout | None = off_table("if given", None)
    not_covered: str | None = off_table("if given", None)

    @classmethod
    def of(cls, loop: Loop, coupling: Coupling) -> Switching:
        found, span = judged(loop, coupling, SWITCHING), loop.delays
        if found.reason:
            return cls(found, span.lo, span.hi)
        latest = loop.delayed(span.hi)
        buffered = this_environment(latest.F(coupling), latest)
        playout = _Playout(span.hi, buffered.required, buffered.certified)
        return cls(found, span.lo, span.hi, found.multiplier, playout, _NOT_COVERED)


# ----------------------------------------------------------------------------------------------------
# What a guarantee for ranges of parameters costs: the robust coupling beside the one made for the nominal one.


@dataclass(frozen=True)
class NominalWorst:
    """A figure in the nominal environment, and the worst of the ranges."""

    nominal: float
    worst: float


@dataclass(frozen=True)
class OverRanges:
    """What a coupling asks and costs over ranges; the mismatch is null in JSON where it is zero."""

    coupling: str
    violated: int  # vertices
    required_over_available: NominalWorst
    rms_mismatch_db: NominalWorst
    relative_mismatch_db: NominalWorst
    worst: str  # where the rms mismatch is largest

    @classmethod
    def of(cls, name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> OverRanges:
        """Members that no device feels have no mismatch."""
        ratios, figures = [], {}
        for member in members:
            here = loop.at(member.network)
            E, F = here.E(), here.F(coupling)
            ratios.append(this_environment(F, loop).ratio)
            if E.D.any():
                figures[member.name] = transparency(F, E, loop.lam)
        nominal, worst = figures[members[0].name], max(figures, key=lambda member: figures[member].rms_mismatch)
        largest = max(f.relative_mismatch for f in figures.values())
        return cls(
            name,
            sum(ratio >= 1 for ratio in ratios),
            NominalWorst(ratios[0], max(ratios)),
            NominalWorst(nominal.rms_mismatch_db, figures[worst].rms_mismatch_db),
            NominalWorst(nominal.mismatch_db, decibels(largest)),
            worst,
        )


def price(loop: Loop, design: Design, kind: str, nominal: Callable[[Loop], Design] | None) -> list[OverRanges]:
    """A design over the ranges; one made for all of them beside what `nominal` makes for one environment alone."""
    couplings = {kind: design.coupling}
    if nominal:
        couplings = {"whole ranges": design.coupling}
        with suppress(DesignFailed):  # ranges are given another basis by default
            couplings = {"nominal only": nominal(loop.at(loop.environment)).coupling, **couplings}
    members = loop.members()
    return [OverRanges.of(name, loop, coupling, members) for name, coupling in couplings.items()]


_WHAT_IS_PROVED = (
    f"proved at the vertices, of more than 128 at so many; between them searched, not proved ({SEARCH}); "
    "every environment is frozen: nothing is proved of one that changes while it is touched"
)


@dataclass(frozen=True)
class SearchFigures:
    """What the search between the vertices has found: evidence, no proof."""

    environments: int
    worst_ratio: float
    worst: str
    violated: bool
    ended_by_clock: bool
    how: str = SEARCH

    @classmethod
    def of(cls, searched: Searched) -> SearchFigures:
        worst = searched.worst[0]
        return cls(searched.tried, worst.ratio, worst.member.name, not worst.ratio < 1, searched.ended)

    def __str__(self) -> str:
        found = "[red]violated[/]" if self.violated else "no violation found"
        ratio = f"worst ratio {self.worst_ratio:.4f}" if math.isfinite(self.worst_ratio) else _NEVER
        ended = ", until its budget was spent" if self.ended_by_clock else ""
        return f"searched, not proved: {found}, {ratio} in {self.environments} points{ended}, at {self.worst}"


@dataclass(frozen=True)
class _Inside:
    """What was found in environments drawn from inside: evidence, no proof."""

    samples: int
    certified: int
    seed: int
    worst_ratio: float | None
    worst: str | None

    @classmethod
    def of(cls, check: RangesCheck) -> _Inside:
        if not check.samples:
            return cls(0, 0, check.seed, None, None)
        i, good = worst(check.at_samples), sum(r.certified for r in check.at_samples)
        return cls(len(check.samples), good, check.seed, check.at_samples[i].ratio, check.samples[i].name)


_NEVER = "no damping is enough"


@dataclass(frozen=True)
class RangesFigures:
    """A check over ranges, as a report shows it."""

    vertices: int
    all_vertices: int
    vertices_certified: int
    required_damping: tuple[float, ...]  # (m,) [N s/m] at the worst vertex
    available_damping: tuple[float, ...]
    worst: str
    proof: str
    certified: bool
    search: SearchFigures
    inside: _Inside
    reason: str | None = off_table("if given")
    what: str = _WHAT_IS_PROVED

    @classmethod
    def of(cls, check: RangesCheck) -> RangesFigures:
        member, requirement = check.worst
        return cls(
            len(check.members) - 1,
            check.vertices,
            sum(r.certified for r in check.at_members[1:]),
            requirement.required,
            requirement.available,
            member.name,
            "rational" if check.certificate else "sampled",
            check.proved,
            SearchFigures.of(check.searched),
            _Inside.of(check),
            check.reason or None,
        )

    def rows(self) -> Iterator[tuple[str, str]]:
        """Of a table."""
        ratio = max(d / a for d, a in zip(self.required_damping, self.available_damping, strict=True))
        most = f"{ratio:.4f} of the damping" if math.isfinite(ratio) else _NEVER
        exact, found, count, every = self.proof == "rational", self.inside, self.vertices, self.all_vertices
        proof = "[green]all proved exactly[/]" if exact else f"[red]not proved[/]: {self.reason}"
        of = f", of all {every}: any three parameters have all their ends among them" if every > count + 1 else ""
        yield "ranges, vertices", f"{self.vertices_certified} of {count} certified, {proof}{of}"
        yield "ranges, worst vertex", f"{most}, at {self.worst}"
        yield "ranges, between", str(self.search)
        if found.worst_ratio is not None:
            most = f"at most {found.worst_ratio:.4f}" if math.isfinite(found.worst_ratio) else _NEVER
            inside = f"{found.certified} of {found.samples} random samples certified, {most} of the damping"
            yield "ranges, inside", inside
        if exact and not self.certified:
            yield "ranges", f"[red]not guaranteed[/]: {self.reason}"
