"""What is covered beyond one linear environment, as figures of a report: ranges, delays that switch, limited forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import environment
from controller.loop import Loop, force_map
from controller.ranges import Member
from design.certificate import RangesCheck, check_limiter, prove_limiter, switching_requirement
from design.conditions import this_environment
from design.coupling_file import Certificate, LimiterCertificate
from design.designs import design_by_kind
from design.environments import SEARCH, Searched, worst
from design.multipliers import BETA, limiter_refusal, limiter_requirement
from design.result import Design, DesignFailed, NotProved, Requirement, certificate_part, finite
from design.transparency import decibels, transparency

_OWN_PROOF = "by a proof of its own, for this environment"


@dataclass(frozen=True)
class Limits:
    """Whether a guarantee holds while forces are at their limits, and the limiter that it is about."""

    rho: tuple[float, ...] | None  # (m,) [N/m] of the limiter; None: no guarantee, so the tick clips
    reason: str  # why it holds, or why it does not
    requirement: Requirement | None = None  # by the condition `limiter`, where it was asked
    c: tuple[tuple[float, ...], ...] = ()  # its multiplier
    certificate: LimiterCertificate | None = None  # its proof

    def words(self, force_limit: Sequence[float]) -> str:
        """In one line, for forces limited to so many N."""
        amounts = [f"{f:.4g}" for f in force_limit]
        limit = f"{', '.join(amounts if len(set(amounts)) > 1 else amounts[:1])} N"
        if self.rho is None:
            return f"clipped at {limit}: a guarantee holds while forces stay below ({self.reason})"
        if not self.proved:
            return f"certified, also while forces are limited to {limit} ({self.reason})"
        return f"proved, also while forces are limited to {limit}"

    @property
    def proved(self) -> bool:
        """In exact arithmetic."""
        return self.rho is not None and (self.requirement is None or self.requirement.proof == "rational")

    def part(self, force_limit: Sequence[float]) -> dict[str, Any]:
        """As plain data."""
        return {
            "rho": None if self.rho is None else list(self.rho),
            "force_limit": [finite(f) for f in force_limit],
            "reason": self.reason,
            "words": self.words(force_limit),
            "certificate": self.requirement and certificate_part(self.requirement),
            "c": self.c,
        }


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
        return Limits(None, str(limiter_refusal(loop)))
    if requirements["any-environment"].certified and not any(loop.psi):
        return Limits((0.0,) * loop.channels, "any-environment covers limited forces")
    if not requirements["this-environment"].certified:
        return Limits(None, "no guarantee that it could extend")
    if proof:
        try:
            requirement = check_limiter(loop, coupling, proof, known)
            return Limits(proof.rho, _OWN_PROOF, requirement, proof.c, proof)
        except NotProved:  # made for another loop
            pass
    beta = proof.beta if proof and 0 < proof.beta <= 1 else BETA
    found = limiter_requirement(loop, coupling, beta)
    requirement = found.requirement
    if not requirement.certified:
        needs = f"limiter: needs {', '.join(f'{d:.5g}' for d in requirement.required)} N s/m of damping"
        return Limits(None, requirement.reason or needs, requirement, found.c)
    try:
        proved = prove_limiter(loop, coupling, beta, found.c)
    except NotProved as refused:
        return Limits(found.rho, f"swept, not proved: {refused}", requirement, found.c)
    return Limits(found.rho, _OWN_PROOF, replace(requirement, proof="rational"), found.c, proved)


# ----------------------------------------------------------------------------------------------------
# What a report says of delays that vary: what switching asks beside that of the playout buffer.


_NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: varying delays "
    "of the measured positions, periods longer than T_max, or forces older than the range, which lost packets make."
)


def switching_part(loop: Loop, coupling: Coupling) -> dict[str, Any]:
    """What any switching within the loop's range asks, and what a playout buffer to the constant delay hi would need.

    Only the requirement where there is none: its reason says why.
    """
    found, span = switching_requirement(loop, coupling), loop.delays
    part = certificate_part(found.requirement) | {"lo": list(span.lo), "hi": list(span.hi)}
    if found.requirement.reason:
        return part
    G = loop.sent(coupling)
    buffered = this_environment(delay(span.hi, G.T) @ G, found.requirement.available, loop.T_max)
    return part | {
        "alpha": [finite(a) for a in found.alpha],
        "playout": {
            "theta": list(span.hi),
            "required_damping": [finite(d) for d in buffered.required],
            "certified": buffered.certified,
        },
        "not_covered": _NOT_COVERED,
    }


# ----------------------------------------------------------------------------------------------------
# What a guarantee for ranges of parameters costs: the robust coupling beside the one made for the nominal one.


def price(loop: Loop, design: Design, kind: str, asked: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A design over the ranges; an optimal one beside the one for the nominal environment alone, `asked` the same.

    SI units; null for a mismatch of zero, or where no damping is enough.
    """
    couplings = {kind: design.coupling}
    if kind == "optimal":
        couplings = {"whole ranges": design.coupling}
        try:
            alone = design_by_kind(loop.at(loop.environment), kind, None, **asked)
            couplings = {"nominal only": alone.coupling, **couplings}
        except DesignFailed:  # ranges are given another basis by default
            pass
    members = loop.members()
    return [_cost(name, loop, coupling, members) for name, coupling in couplings.items()]


def _cost(name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> dict[str, Any]:
    """Required damping and mismatch in the nominal environment and at the worst member.

    Members that no device feels have no mismatch.
    """
    ratios, figures = [], {}
    for member in members:
        E = environment(member.network, loop.T)
        F = force_map(E, coupling, loop.theta, loop.psi)
        ratios.append(this_environment(F, loop.delta, loop.T_max, loop.latency).ratio)
        if E.D.any():
            figures[member.name] = transparency(F, E, loop.lam)
    nominal, worst = figures[members[0].name], max(figures, key=lambda member: figures[member].rms_mismatch)
    largest = max(f.relative_mismatch for f in figures.values())

    def pair(first: float, second: float) -> dict[str, float | None]:
        return {"nominal": finite(first), "worst": finite(second)}

    return {
        "coupling": name,
        "violated": sum(ratio >= 1 for ratio in ratios),
        "required_over_available": pair(ratios[0], max(ratios)),
        "rms_mismatch_db": pair(decibels(nominal.rms_mismatch), decibels(figures[worst].rms_mismatch)),
        "relative_mismatch_db": pair(decibels(nominal.relative_mismatch), decibels(largest)),
        "worst": worst,
    }


_WHAT_IS_PROVED = (
    f"proved at the vertices, of more than 128 at so many; between them searched, not proved ({SEARCH}); "
    "every environment is frozen: nothing is proved of one that changes while it is touched"
)


def ranges_part(check: RangesCheck) -> dict[str, Any]:
    """The check as plain data; SI units, null where no damping is enough."""
    member, requirement = check.worst
    part: dict[str, Any] = {
        "vertices": len(check.members) - 1,
        "all_vertices": check.vertices,
        "vertices_certified": sum(r.certified for r in check.at_members[1:]),
        "required_damping": [finite(d) for d in requirement.required],
        "available_damping": list(requirement.available),
        "worst": member.name,
        "proof": "rational" if check.certificate else "sampled",
        "certified": check.proved,
        "search": search_part(check.searched),
        "inside": _inside_part(check),
        "what": _WHAT_IS_PROVED,
    }
    return part | ({"reason": check.reason} if check.reason else {})


def search_part(searched: Searched) -> dict[str, Any]:
    """What the search between the vertices has found: evidence, no proof."""
    worst = searched.worst[0]
    return {
        "how": SEARCH,
        "environments": searched.tried,
        "worst_ratio": finite(worst.ratio),
        "worst": worst.member.name,
        "violated": not worst.ratio < 1,
        "ended_by_clock": searched.ended,
    }


def search_words(part: dict[str, Any]) -> str:
    """The result of the search between the vertices, in one line."""
    found = "[red]violated[/]" if part["violated"] else "no violation found"
    ratio = "no damping is enough" if part["worst_ratio"] is None else f"worst ratio {part['worst_ratio']:.4f}"
    ended = ", until its time was over" if part["ended_by_clock"] else ""
    return f"searched, not proved: {found}, {ratio} in {part['environments']} points{ended}, at {part['worst']}"


def _inside_part(check: RangesCheck) -> dict[str, Any]:
    """What was found in the environments drawn from inside: evidence, no proof."""
    if not check.samples:
        return {"samples": 0, "certified": 0, "seed": check.seed, "worst_ratio": None, "worst": None}
    i = worst(check.at_samples)
    return {
        "samples": len(check.samples),
        "certified": sum(r.certified for r in check.at_samples),
        "seed": check.seed,
        "worst_ratio": finite(check.at_samples[i].ratio),
        "worst": check.samples[i].name,
    }


def ranges_rows(part: dict[str, Any]) -> list[tuple[str, str]]:
    """The part of a report as rows of a table."""
    ratios = [d / a for d, a in zip(part["required_damping"], part["available_damping"], strict=True) if d is not None]
    most = f"{max(ratios):.4f} of the damping" if ratios else "no damping is enough"
    exact = part["proof"] == "rational"
    proof = "[green]proved exactly[/] at all" if exact else f"[red]not proved[/]: {part['reason']}"
    found, count, every = part["inside"], part["vertices"], part["all_vertices"]
    of = f", of all {every}: any three parameters have all their ends among them" if every > count + 1 else ""
    rows = [
        ("ranges, vertices", f"{part['vertices_certified']} of {count} certified, {proof}{of}"),
        ("ranges, worst vertex", f"{most}, at {part['worst']}"),
        ("ranges, between", search_words(part["search"])),
    ]
    if found["samples"]:
        ratio = "no damping is enough" if found["worst_ratio"] is None else f"at most {found['worst_ratio']:.4f}"
        inside = f"{found['certified']} of {found['samples']} random samples certified, {ratio} of the damping"
        rows.append(("ranges, inside", inside))
    if exact and not part["certified"]:
        rows.append(("ranges", f"[red]not guaranteed[/]: {part['reason']}"))
    return rows
