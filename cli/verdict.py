"""The verdict on a coupling in a few sentences, and the rows of its assessment."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import Any

from haptic_loop.cli import render
from haptic_loop.controller.environment import RIGID_WALL
from haptic_loop.controller.loop import Loop
from haptic_loop.design.assessment import BELOW_LIMITS, Assessment, Guarantee, RangesResult, assess
from haptic_loop.design.coverage import Robustness
from haptic_loop.design.gain_search import softest
from haptic_loop.design.result import ANY, HERE, MAKING, RANGES, Chosen, finite, listed
from haptic_loop.design.transparency import BAND_HZ
from haptic_loop.sim.couplings import choose, qualified
from haptic_loop.sim.scenario import Scenario


def chosen_by(args: argparse.Namespace, scenario: Scenario) -> Chosen:
    """Return the coupling of --coupling, --condition and --no-limiter, designed or read from a file."""
    with render.designing(scenario.loop(args.case), args.coupling, args.condition) as progress:
        return choose(scenario, args.case, args.coupling, args.condition, args.limiter, progress)


def assessment_of(
    args: argparse.Namespace, scenario: Scenario, chosen: Chosen, loop: Loop | None = None, **runs: Any
) -> Assessment:
    """Return the assessment of a coupling in `loop`, by default the scenario's loop.

    `runs` are `environment` and `energy_budget` of `assess`, if they differ from those of the loop.
    """
    loop = loop or scenario.loop(args.case)
    with render.progress("searching the ranges" if loop.ranges else "proving the conditions") as move:
        band_hz = getattr(args, "band_hz", None) or BAND_HZ
        more = {"ranges_seed": args.seed, "limiter": args.limiter, "band_hz": band_hz, "progress": move}
        assessment = assess(loop, chosen, **more, **runs)
    return qualified(scenario, args.case, assessment)


# ---- the verdict


#: environments of a guarantee -> the touched objects in words
_OBJECTS = {
    ANY: "any passive object",
    HERE: "this object",
    RIGID_WALL.here: "a rigid wall",
    MAKING: "this object, whose walls may be touched and left",
}


def verdict(assessment: Assessment, nearby: Robustness | None = None) -> str:
    """Return the verdict in a few sentences: hands and objects of the guarantee, felt stiffness, restrictions.

    `nearby` is the required damping after changes of the environment by ten percent, or None.
    """
    guarantee, encoder = assessment.guarantee, assessment.encoder
    if guarantee is None:
        return f"[red]Not certified[/]: {_sentence(assessment.reason or assessment.decisive.shortfall)}"
    if guarantee.energy_J is not None:
        swept = " A refined sweep shows this, without an exact proof." if guarantee.proof == "sampled" else ""
        return f"[green]Safe by an energy account[/]: {_sentence(guarantee.words)}{swept}"
    figures = assessment.transparency
    share = figures and finite(figures.dc_ratio)
    felt = f": {_percent(share)} of the stiffness is rendered" if share else ""
    by = f" by the condition {guarantee.own}, which is your own," if guarantee.own else ""
    words = [f"[green]Stable[/]{by} for {_who(guarantee)}{felt}."]
    if not assessment.holds:
        words.append(f"[red]Not certified[/] {_missing(assessment)}")
    if guarantee.forces == BELOW_LIMITS and assessment.force_limits.force_limit:
        words.append("Only while forces stay below their limits.")
    if guarantee.proof != "rational":
        words.append("A refined sweep shows this, without an exact proof.")
    if encoder:
        words.append(encoder.sentence)
    return " ".join([*words, *filter(None, [lost(assessment, nearby), _useless(assessment)])])


_NOTHING_DB = -1.0  # [dB] rms mismatch above which a coupling to an object without stiffness counts as useless


def soft_end(loop: Loop) -> float:
    """Return the stiffness [N/m] below which a spring is at the soft end of the search."""
    return 1.001 * softest(loop)


def _useless(assessment: Assessment) -> str:
    """Name the contacts at which the coupling renders next to nothing, or return ""."""
    contacts, felt = assessment.loop.environment.contacts, assessment.transparency
    end = soft_end(assessment.loop)
    soft = [end > K for K in assessment.gains.get("K", ())]
    where = ", ".join(name for name, is_soft in zip(contacts, soft, strict=False) if is_soft)
    if soft and all(soft):
        where = "all contacts"
    if not where and felt and felt.rms_mismatch_db > _NOTHING_DB and not felt.dc_ratio > 0:
        return "[red]Useless[/]: its force is about as wrong as no force."
    return f"[red]Useless[/] on {where}: it renders next to nothing there." if where else ""


def lost(assessment: Assessment, nearby: Robustness | None) -> str:
    """Name the change of the environment by ten percent that ends the guarantee, or return ""."""
    guarantee = assessment.guarantee
    if nearby is None or nearby.certified or guarantee is None or guarantee.any_environment:
        return ""
    return f"The guarantee is lost with {nearby.where}."


def _who(guarantee: Guarantee) -> str:
    """Return the hands and objects of a guarantee, such as "every passive hand with this object"."""
    place = _OBJECTS.get(guarantee.environments, guarantee.environments)
    if guarantee.environments == RANGES:
        place = f"the object at {guarantee.vertices} of the ranges (only searched between vertices)"
    delays, facts = guarantee.delays, guarantee.facts
    late = f", with delays that switch within {delays}" if "switching" in facts else ""
    return f"{guarantee.hands} with {place}{late}"


def _percent(ratio: float) -> str:
    value = 100 * ratio
    return f"{value:.0f} %" if value >= 1 or value == 0 else f"{value:.1g} %"


def _missing(assessment: Assessment) -> str:
    """Return the words after "Not certified": the failed condition with its shortfall, or the ranges' failure."""
    if not assessment.decisive.certified:
        return f"by {_sentence(f'{assessment.condition}: {assessment.decisive.shortfall}')}"
    reason = assessment.ranges and assessment.ranges.reason
    return f"for the ranges: {_sentence(reason or 'a vertex is not certified')}"


def _sentence(words: str) -> str:
    return words if words.endswith(".") else f"{words}."


# ---- the rows


def rows(assessment: Assessment) -> render.Rows:
    """Yield the rows of an assessment."""
    yield from render.certificate_rows(assessment.requirements, 5)
    yield from range_rows(assessment.ranges) if assessment.ranges else ()
    yield "guarantee", assessment.guarantee_words or f"none ({assessment.reason})"
    yield "force limits", assessment.force_limits.words
    yield "held torques", assessment.held_torques


def gain_rows(assessment: Assessment) -> render.Rows:
    """Yield the rows of a coupling's gains and static stiffness, if it has them."""
    gains = assessment.gains
    if "K" in gains:
        K, B = (listed(gains[name], 5) for name in ("K", "B"))
        yield "coupling K / B", f"{K} N/m / {B} N s/m"
    if "stiffness" in gains:
        yield "coupling, static", f"{listed(gains['stiffness'], 5)} N/m"


_NEVER = "no damping is enough"


def range_rows(ranges: RangesResult) -> Iterator[tuple[str, str]]:
    """Yield the rows of a check over ranges."""
    part, count = ranges.part(), len(ranges.members) - 1
    member, requirement = ranges.worst
    exact = ranges.certificate is not None
    ratio = f"needs {requirement.ratio:.4f} times the damping" if math.isfinite(requirement.ratio) else _NEVER
    proof = "[green]all proved exactly[/]" if exact else f"[red]not proved[/]: {ranges.reason}"
    of = "" if ranges.where == "every vertex" else f"; {ranges.where}"
    yield "ranges, vertices", f"{part['vertices_certified']} of {count} certified, {proof}{of}"
    yield "ranges, worst vertex", f"{ratio}, at {member.name}"
    yield "ranges, between", str(part["search"])
    inside = part["inside"]
    if inside["worst_ratio"] is not None:
        worst = inside["worst_ratio"]
        most = f"the worst needs {worst:.4f} times the damping" if math.isfinite(worst) else _NEVER
        yield "ranges, inside", f"{inside['certified']} of {inside['samples']} random samples certified, {most}"
    if exact and not ranges.proved:
        yield "ranges", f"[red]not guaranteed[/]: {ranges.reason}"
