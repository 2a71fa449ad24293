"""`from design import design_coupling, certify, ..`: what python -m design does, for scripts. SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict, Unpack

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design.arguments import known, of_kind, one_of, shown
from haptic_loop.design.assessment import Assessment, check_ranges
from haptic_loop.design.certificate import judged, lag, named, prove, requirements_of
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import Certificate, Stored, digest, save
from haptic_loop.design.designs import KINDS, design_by_kind, name_and_own, usual_condition
from haptic_loop.design.environments import SWITCHING, THIS_ENVIRONMENT, LimitedForces
from haptic_loop.design.files import off_table
from haptic_loop.design.guarantees import ANY, HERE, RANGES
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.design.result import ConditionName, Design, NotProved, Requirement, switching_guarantee
from haptic_loop.design.transparency import BAND_HZ, Transparency, decibels, transparency

_Kind = Literal["spring-damper", "moving-average", "ccl", "optimal"]


_LOOP = 'a Loop, as scenario.loop("I") gives it'


class DesignOptions(TypedDict, total=False):
    """Options of the kinds in design.designs.KINDS."""

    order: int  # ccl: states per channel
    method: str  # ccl: complementarity, inner or fixed-poles
    diagonal: bool  # ccl: no gain across channels
    switching: tuple[Sequence[int], Sequence[int]]  # spring-damper, optimal: (lo, hi) [samples] of delays that vary
    limiter: bool  # spring-damper and optimal for this-environment: whether limited forces are covered (the default)
    objective: Literal["rms", "sup"]  # optimal: norm of the mismatch relative to the environment
    band_hz: tuple[float, float]  # optimal, spring-damper for this environment: band of the mismatch
    high_gain: float | None  # optimal: limit of |F|/|E| above 100 Hz; None: no limit, but a small gain
    seconds: float  # optimal: no larger basis is tried later than this


def design_coupling(
    loop: Loop,
    kind: _Kind = "spring-damper",
    condition: ConditionName | Condition | None = None,
    **options: Unpack[DesignOptions],
) -> Design:
    """Design a coupling for a loop: `scenario.loop("I")`, which is all that a design knows of a scenario.

    `kind` is "spring-damper", "moving-average" (the stiffest for any environment), "ccl" or "optimal"; `condition` is
    "any-environment" or "this-environment", None for what the commands design: a spring-damper for this environment,
    also while forces are limited; for any environment before walls, ranges or delays that vary. A Condition of your own
    (design.conditions) must hold beside the kind's usual one. `options` are those of the kind, see DesignOptions;
    switching is not taken from loop.varying_delay.

    Returns a Design: `coupling` (for a spring-damper with K (m,) [N/m] and B (m,) [N s/m]), `requirement` (the damping
    that it needs, from a sweep of the coupling alone), `figure` and `objective` (what was minimised, and its value).

    Raises TypeError for an argument of another type or an option that the kind does not have, ValueError for a kind,
    condition or loop that makes no sense, DesignFailed where no such coupling exists.
    """
    of_kind("loop", loop, Loop, _LOOP)
    one_of("kind", kind, KINDS)
    named(condition or usual_condition(loop, kind))  # refuses a taken name
    known(options, KINDS[kind].options, f"kind {kind!r}")
    design = design_by_kind(loop, kind, condition, **options)
    return replace(design, certified_for=certified_for(loop, design.requirement.certified))


def certified_for(loop: Loop, certified: bool) -> str:
    """Name the linear network of a MuJoCo scene for which a coupling of this loop is certified, or "" for none."""
    scene = getattr(loop.environment, "linear_model_of", "")
    return f"the linear network of {scene}" if scene and certified else ""


#: alternatives that are designed quickly; of the optimal coupling the smallest basis
_QUICK: tuple[tuple[_Kind, ConditionName, DesignOptions], ...] = (
    ("optimal", "this-environment", {"seconds": 0.0}),
    ("spring-damper", "this-environment", {}),
    ("spring-damper", "any-environment", {}),
    ("moving-average", "any-environment", {}),
)


def instead(loop: Loop, kind: str, condition: str | Condition | None = None) -> str:
    """Return the alternatives to a design that failed, in words, least rms mismatch first, or "".

    Every other kind and condition is designed and certified here. For delays that vary nothing is tried.
    """
    failed, designs = (kind, condition or usual_condition(loop, kind)), []
    for other, target, options in _QUICK:
        if (other, target) == failed or loop.varying_delay:
            continue
        try:
            design = design_coupling(loop, other, target, **options)
            needs = certify(loop, design)
        except (ValueError, ArithmeticError):
            continue
        if needs[target].certified:
            error = decibels(transparency_of(loop, design).rms_mismatch)
            designs.append((error, f"--coupling {other} --condition {target} ({error:.2f} dB rms)"))
    return "certified instead: " + ", ".join(words for _, words in sorted(designs)) if designs else ""


def certify(loop: Loop, coupling: Coupling | Design, condition: Condition | None = None) -> dict[str, Requirement[str]]:
    """Judge a coupling in its loop by both conditions, "any-environment" and "this-environment".

    Beside them that of the design, or a `condition` of your own, under its name.

    With ranges around the loop's environment this-environment is about the environment and every vertex: the figure is
    that of the one that asks the most, proved only if all are. Between the vertices nothing is proved, but searched: a
    violation found there (design.worst_member) is the figure then, and not certified. With a range of delays,
    loop.varying_delay, there is a third, "switching": what any switching within the range asks.

    Each Requirement has `required` and `available` (m,) [N s/m], `certified` (required < available), the frequency [Hz]
    where it binds, and `proof`: "rational" where exact arithmetic confirms it, "sampled" where a refined sweep says so.
    A condition that no damping satisfies has infinite `required` and a `reason`.

    Raises TypeError for an argument of another type, ValueError where coupling and loop do not fit each other,
    SingularLoop where their algebraic loop has no solution.
    """
    of_kind("loop", loop, Loop, _LOOP)
    own = coupling.own if isinstance(coupling, Design) else None
    alone = fitting(loop, coupling)
    _, own_condition = name_and_own(condition)
    requirements: dict[str, Requirement[str]] = dict(requirements_of(loop, alone, own=own_condition or own))
    over = (THIS_ENVIRONMENT, KNOWN_DEVICE) if loop.known_devices else (THIS_ENVIRONMENT,)
    for each in over if loop.ranges else ():
        ranges = check_ranges(loop, alone, samples=0, condition=each)
        assert ranges  # the loop has ranges
        _, worst = ranges.worst if ranges.proved else ranges.worst_found
        here = requirements[worst.condition].guarantee
        proof, held = ("rational", RANGES) if ranges.proved else ("sampled", here)
        requirements[worst.condition] = replace(worst, proof=proof, guarantee=held)
    if loop.varying_delay:
        requirements["switching"] = judged(loop, alone, SWITCHING)
    return requirements


def transparency_of(loop: Loop, coupling: Coupling | Design, band_hz: tuple[float, float] = BAND_HZ) -> Transparency:
    """Return figures of the mismatch (8), M = F - Lambda E, in the loop's environment with all walls touching.

    `mismatch_db` is the largest share of M in the environment over `band_hz`, `rms_mismatch_db` the mean one; 0 dB is
    as wrong as no force. `dc_ratio` is the rendered share of the static stiffness.

    Raises TypeError and ValueError as `certify` does.
    """
    of_kind("loop", loop, Loop, _LOOP)
    return transparency(loop.F(fitting(loop, coupling)), loop.E(), loop.lam, band_hz)


@dataclass(frozen=True)
class _SwitchingFiled:
    """The guarantee for delays that vary, with its proof or the reason why there is none."""

    guarantee: str = off_table()
    proof: str | None = off_table()
    reason: str | None = off_table()


@dataclass(frozen=True)
class Filed:
    """The file of a design and its proof; `reason` says why a proof is missing."""

    file: Path
    proof: str | None
    reason: str | None
    switching: _SwitchingFiled | None
    limited_forces: bool


def proved(loop: Loop, design: Design) -> Design:
    """Return the design with its certificate; over ranges unchanged, because they have to be searched first."""
    if design.certificate or loop.ranges or loop.varying_delay:
        return design
    try:
        return replace(design, certificate=_certificate(loop, design))
    except NotProved:
        return design


def store(
    loop: Loop,
    design: Design,
    path: Path,
    assessment: Assessment | None = None,
) -> Filed:
    """Save the coupling with the proof of its condition and of limited forces in `assessment`, if they are proved.

    Without a proof for the ranges or for switching delays the file is for the nominal environment or for constant
    delays. Raises InputError if the file cannot be written.
    """
    ranges = assessment and assessment.ranges
    limiter = assessment and assessment.force_limits.certificate
    if ranges and ranges.proved and ranges.certificate and ranges.certificate.condition == design.condition:
        certificate, reason = ranges.certificate, None
    else:
        loop = loop if named(design.asked).guarantee(loop) == ANY else loop.at(loop.environment)
        certificate, reason = _proved(loop, design, limiter)
    switching = None
    if loop.varying_delay:
        proof = certificate.proof if certificate else None
        words = f"{switching_guarantee(loop.varying_delay)}, in {HERE}"
        switching = _SwitchingFiled(words, proof, reason)
        if certificate is None:
            loop = loop.switching(None)
            certificate, reason = _proved(loop, design, limiter)
    save(Stored.of(loop, design.coupling, certificate), path)
    limited = certificate is not None and lag(loop, certificate) is not None
    return Filed(path, certificate and certificate.proof, reason, switching, limited)


def _proved(loop: Loop, design: Design, limiter: Certificate | None) -> tuple[Certificate | None, str | None]:
    """Return (the certificate of the design in this loop or None, the reason why there is none)."""
    held = design.certificate
    limited = limiter if named(design.asked).extensible else None
    for certificate in (limited, held):
        if certificate and certificate.scenario == digest(loop, design.coupling.form()):
            return certificate, None
    try:
        return _certificate(loop, design), None
    except NotProved as error:
        return None, str(error)


def _certificate(loop: Loop, design: Design) -> Certificate:
    """Return the proof of a design, for limited forces if the design has their multiplier. Raises NotProved."""
    if design.c:
        limiter = LimitedForces(lags=len(design.c[0]))
        return prove(loop, design.coupling, limiter, [v for row in design.c for v in row])
    return prove(loop, design.coupling, design.asked, _multiplier(design))


def _multiplier(design: Design) -> list[float] | None:
    return None if design.phi is None else design.phi.tolist()


COUPLING = "a coupling (controller.coupling), or a Design"


def bare(coupling: Coupling | Design, expected: str = COUPLING) -> Coupling:
    """Return the coupling of a design, or the coupling itself. Raises TypeError for anything else."""
    bare = coupling.coupling if isinstance(coupling, Design) else coupling
    if isinstance(bare, Lti):
        raise TypeError("coupling is an Lti, expected a coupling: wrap it in Compliance(...) (controller.coupling)")
    if not isinstance(bare, Coupling):
        if hasattr(bare, "compliance") and not isinstance(bare, type):
            raise TypeError(
                f"coupling is a {type(bare).__name__}, which is not derived from controller.coupling.Coupling"
            )
        raise TypeError(f"coupling is {shown(coupling)}, expected {expected}")
    return bare


def fitting(loop: Loop, coupling: Coupling | Design) -> Coupling:
    """Return the coupling of a design, or the coupling itself. Raises ValueError for a wrong number of channels."""
    alone = bare(coupling)
    Stored.of(loop, alone)
    return alone
