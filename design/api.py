"""Functions for scripts that design, certify, evaluate and store a coupling, as `python -m design` does (SI units)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypedDict, Unpack

from haptic_loop.controller.arguments import known, of_kind, one_of, shown
from haptic_loop.controller.arithmetic import one_blas_thread
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.environment import Network
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design.assessment import Assessment, check_ranges
from haptic_loop.design.certificate import judged, limiter_rho, named, prove, requirements_of
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coupling_file import Certificate, Stored, save
from haptic_loop.design.designs import KINDS, design_by_kind, name_and_own, usual_condition
from haptic_loop.design.environments import LIMITER, SWITCHING, THIS_ENVIRONMENT
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.design.result import (
    ANY,
    RANGES,
    ConditionName,
    Design,
    NotProved,
    Requirement,
    switching_guarantee,
)
from haptic_loop.design.transparency import BAND_HZ, Transparency, decibels, transparency

_Kind = Literal["spring-damper", "moving-average", "ccl", "optimal"]
_LOOP = 'a Loop, as scenario.loop("I") gives it'


class DesignOptions(TypedDict, total=False):
    """Options of the kinds in design.designs.KINDS."""

    order: int  # ccl: states per channel
    switching: tuple[Sequence[int], Sequence[int]]  # spring-damper, optimal: (lo, hi) [samples] of varying delays
    limiter: bool  # cover limited forces, too; by default tried only for a spring-damper with this-environment
    objective: Literal["rms", "sup"]  # optimal: norm of the mismatch relative to the environment
    band_hz: tuple[float, float]  # [Hz] optimal, spring-damper of least mismatch: band of the mismatch
    high_gain: float | None  # optimal: limit of |F|/|E| above 100 Hz; None for a soft penalty
    seconds: float  # optimal: time [s] after which no larger basis is tried


@one_blas_thread
def design_coupling(
    loop: Loop,
    kind: _Kind = "spring-damper",
    condition: ConditionName | Condition | None = None,
    **options: Unpack[DesignOptions],
) -> Design:
    """Design a coupling for a loop.

    Args:
        loop: The loop, for example `scenario.loop("I")`.
        kind: "spring-damper", "moving-average" (the stiffest for any environment), "ccl" or "optimal".
        condition: The name of a condition, or your own Condition (design.conditions). Your own Condition judges a
            coupling that is designed by the usual condition of its kind. None selects the usual condition
            (design.designs.usual_condition), as the commands do.
        options: Options of the kind (DesignOptions). `switching` replaces loop.varying_delay.

    Returns:
        A Design. Its `coupling` has K (m,) [N/m] and B (m,) [N s/m] if it is a spring-damper. `requirement` is the
        required damping, from a sweep. `figure` is the name of the optimised figure, and `objective` is its value.

    Raises:
        TypeError: An argument has the wrong type, or the kind has no option of this name.
        ValueError: The kind or the condition does not exist, or does not suit the loop.
        DesignFailed: No such coupling was found.
    """
    of_kind("loop", loop, Loop, _LOOP)
    one_of("kind", kind, KINDS)
    named(condition or usual_condition(loop, kind))  # raises ValueError for an unknown or reserved name
    known(options, KINDS[kind].options, f"kind {kind!r}")
    design = design_by_kind(loop, kind, condition, **options)
    return replace(design, certified_for=certified_for(loop, design.requirement.certified))


def certified_for(loop: Loop, certified: bool) -> Network | None:
    """Return the loop's environment if `certified` and if it is the linear network of a MuJoCo scene, else None."""
    network = loop.environment
    return network if certified and isinstance(network, Network) and network.linear_model_of else None


#: The quick designs that `instead` tries. With 0 seconds an optimal coupling has only its smallest basis.
_QUICK: tuple[tuple[_Kind, ConditionName, DesignOptions], ...] = (
    ("optimal", "this-environment", {"seconds": 0.0}),
    ("spring-damper", "this-environment", {}),
    ("spring-damper", "any-environment", {}),
    ("moving-average", "any-environment", {}),
)


def instead(
    loop: Loop,
    kind: str,
    condition: str | Condition | None = None,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> str:
    """Return certified alternatives to a failed design in words, least rms mismatch first, or "" if there are none."""
    failed, designs = (kind, condition or usual_condition(loop, kind)), []
    for i, (other, target, options) in enumerate(_QUICK):
        if (other, target) == failed or loop.varying_delay:
            continue
        progress(i, len(_QUICK), f"{failed[0]} was refused, trying --coupling {other} --condition {target}")
        try:
            design = design_coupling(loop, other, target, **options)
            needs = certify(loop, design)
        except (ValueError, ArithmeticError):
            continue
        if needs[target].certified:
            error = decibels(transparency_of(loop, design).rms_mismatch)
            felt = f"{error:z.2f} dB rms" if math.isfinite(error) else "no mismatch"
            designs.append((error, f"--coupling {other} --condition {target} ({felt})"))
    return "certified instead: " + ", ".join(words for _, words in sorted(designs)) if designs else ""


@one_blas_thread
def certify(loop: Loop, coupling: Coupling | Design, condition: Condition | None = None) -> dict[str, Requirement]:
    """Judge a coupling in its loop by "any-environment" and "this-environment".

    Loops with known devices are judged by "known-device" and "known-device-any", too. Your own `condition`, or your own
    condition for which a Design was made, is judged with the loop's ranges and switching delays. With a varying_delay
    of the loop, the entry "switching" is for delays that switch in any way within it.

    With ranges around the loop's environment, "this-environment" and "known-device" cover the environment and the
    vertices of the ranges, at most 128. Between the vertices there is no proof, only a search (design.worst_member). If
    all of these environments are proved and the search finds no violation, the largest of their requirements is
    returned. Otherwise the worst environment of the search counts, too, and the result is not proved.

    Returns:
        A Requirement for each condition: `required` and `available` (m,) [N s/m], `certified` (required < available),
        the binding frequency [Hz], and `proof`: "rational" for exact arithmetic, "sampled" for a refined sweep. A
        condition that no damping satisfies has an infinite `required` and a `reason`.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: Coupling and loop have different numbers of channels.
        SingularLoop: A coupling of your own class makes an algebraic loop without solution.
    """
    of_kind("loop", loop, Loop, _LOOP)
    if condition is not None:
        of_kind("condition", condition, Condition, "your own Condition; the result has all conditions that have a name")
    alone, (_, own) = fitting(loop, coupling), name_and_own(condition)
    own = own or (coupling.own if isinstance(coupling, Design) else None)
    requirements = requirements_of(loop, alone, own=own)
    over = (THIS_ENVIRONMENT, KNOWN_DEVICE) if loop.known_devices else (THIS_ENVIRONMENT,)
    for each in over if loop.ranges else ():
        requirements[each.name] = _over_ranges(loop.switching(None), alone, each, requirements[each.name])
    if loop.varying_delay:
        switched = judged(loop.at(loop.environment), alone, SWITCHING)
        needs = _over_ranges(loop, alone, THIS_ENVIRONMENT, switched) if loop.ranges else switched
        requirements["switching"] = replace(needs, condition=SWITCHING.name)
    if own and (loop.ranges or loop.varying_delay):
        needs = judged(loop, alone, own)
        over_ranges = loop.ranges and needs.applies and needs.guarantee == RANGES
        requirements[own.name] = _over_ranges(loop, alone, own, needs) if over_ranges else needs
    return requirements


def _over_ranges(loop: Loop, coupling: Coupling, condition: Condition, here: Requirement) -> Requirement:
    """Return the largest requirement over the ranges; `here` is the requirement in the nominal environment."""
    ranges = check_ranges(loop, coupling, samples=0, condition=condition)
    assert ranges  # The caller passes only loops with ranges.
    _, worst = ranges.worst if ranges.proved else ranges.worst_found
    proof, held = ("rational", RANGES) if ranges.proved else ("sampled", here.guarantee)
    return replace(worst, proof=proof, guarantee=held)


def transparency_of(loop: Loop, coupling: Coupling | Design, band_hz: tuple[float, float] = BAND_HZ) -> Transparency:
    """Return figures of the mismatch (8), M = F - Lambda E, in the loop's environment with all walls touching.

    `mismatch_db` is the largest ratio of M to the environment over `band_hz`, and `rms_mismatch_db` is the rms ratio.
    A coupling without any force has 0 dB. `dc_ratio` is the rendered share of the static stiffness.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: Coupling and loop have different numbers of channels, the environment never exerts a force, or
            `band_hz` is no band.
    """
    of_kind("loop", loop, Loop, _LOOP)
    return transparency(loop.F(fitting(loop, coupling)), loop.E(), loop.lam, band_hz)


@dataclass(frozen=True)
class _SwitchingFiled:
    """The guarantee for varying delays, and the kind of its proof or the reason why there is no proof."""

    guarantee: str | None  # None where the loop that runs has no guarantee, as with lost packets
    proof: str | None
    reason: str | None


@dataclass(frozen=True)
class Filed:
    """A summary of a stored design: its file, and the kind of its proof or the `reason` why there is no proof."""

    file: Path
    proof: str | None
    reason: str | None
    switching: _SwitchingFiled | None  # None for constant delays
    limited_forces: bool  # whether the certificate covers limited forces


def proved(loop: Loop, design: Design) -> Design:
    """Return the design with an exact certificate; with ranges, varying delays or no proof, return it unchanged."""
    if design.certificate or loop.ranges or loop.varying_delay:
        return design
    try:
        return replace(design, certificate=_certificate(loop, design))
    except NotProved:
        return design


def store(loop: Loop, design: Design, path: Path, assessment: Assessment | None = None) -> Filed:
    """Save the coupling with its proof, and return a summary of the file.

    `assessment` may contain proofs for ranges and for limited forces. If the ranges are not proved by the design's
    condition, the stored loop has the nominal environment only, unless the condition holds in any environment. If
    switching delays are not proved, the stored loop has constant delays. Raises InputError if the file cannot be
    written.
    """
    condition, ranges = named(design.required_condition), assessment and assessment.ranges
    limiter = assessment and assessment.force_limits.certificate
    if ranges and ranges.proved and ranges.certificate and ranges.certificate.condition == design.condition:
        certificate, reason = ranges.certificate, None
    else:
        loop = loop if condition.guarantee(loop) == ANY else loop.at(loop.environment)
        certificate, reason = _proved(loop, design, limiter)
    switching = None
    if loop.varying_delay:
        proof = certificate.proof if certificate else None
        words = f"{switching_guarantee(loop.varying_delay)}, in {condition.guarantee(loop)}"
        stated = words if assessment is None or assessment.guarantee else None
        switching = _SwitchingFiled(stated, proof, reason)
        if certificate is None:
            loop = loop.switching(None)
            certificate, reason = _proved(loop, design, limiter)
    save(Stored.of(loop, design.coupling, certificate), path)
    limited = certificate is not None and limiter_rho(loop, certificate) is not None
    return Filed(path, certificate and certificate.proof, reason, switching, limited)


def _proved(loop: Loop, design: Design, limiter: Certificate | None) -> tuple[Certificate | None, str | None]:
    """Return (the certificate of the design in this loop or None, the reason why there is none).

    The certificate `limiter`, which covers limited forces, is preferred if it belongs to this loop.
    """
    limited = limiter if named(design.required_condition).extensible else None
    for certificate in (limited, design.certificate):
        if certificate and certificate.is_for(loop, design.coupling):
            return certificate, None
    try:
        return _certificate(loop, design), None
    except NotProved as error:
        return None, str(error)


def _certificate(loop: Loop, design: Design) -> Certificate:
    """Return the certificate of a design, for limited forces if its multipliers c prove them. Raises NotProved."""
    if design.c:
        with suppress(NotProved):
            return prove(loop, design.coupling, LIMITER, [v for row in design.c for v in row])
    return prove(loop, design.coupling, design.required_condition, None if design.phi is None else design.phi.tolist())


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
    """Return the coupling without its Design. Raises ValueError if its number of channels is not that of the loop."""
    alone = bare(coupling)
    Stored.of(loop, alone)
    return alone
