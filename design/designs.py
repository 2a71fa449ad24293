"""`from design import design_coupling, certify, ..`: what python -m design does, for scripts. SI units."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, TypedDict, Unpack

import msgspec

from controller.coupling import Coupling
from controller.loop import DelayRange, Loop
from design import certificate as guarantees
from design.certificate import LATE, Stored, assess, limiter_refusal, switching_requirement
from design.conditions import Condition, Requirement, this_environment
from design.ranges import check_set
from design.result import Design, DesignFailed, Row, bare, known, of_kind, one_of
from design.transparency import Transparency, transparency

# ----------------------------------------------------------------------------------------------------
# The designs by name.


#: name -> the conditions that it can be made for, its own first
KINDS = {
    "spring-damper": ("this-environment", "any-environment"),
    "moving-average": ("any-environment",),
    "ccl": ("any-environment",),
    "optimal": ("this-environment",),
}


def usual_condition(loop: Loop, kind: str = "spring-damper") -> str:
    """What a coupling is designed for where nobody says it: a spring-damper for this environment, which feels best.

    For any environment where this-environment covers less than the loop: walls that make and break contact, ranges,
    delays that vary. Other kinds for their own condition.
    """
    less = loop.environment.walls or loop.box or loop.jitter
    return "any-environment" if less and "any-environment" in KINDS[kind] else KINDS[kind][0]


#: kind -> what else can be asked of it, in words of design.api.Options
OPTIONS = {
    "spring-damper": ("switching", "limiter"),
    "moving-average": (),
    "ccl": ("order", "method", "diagonal"),
    "optimal": (
        "objective",
        "band_hz",
        "high_gain",
        "limiter",
        "seconds",
        "switching",
        "functions",
        "filter",
        "diagonal",
        "margin",
    ),
}

#: options of the optimal coupling before 0.2: accepted and without effect
RETIRED = ("functions", "filter", "diagonal", "margin")
NO_LONGER = "the optimal coupling chooses its own basis and margin; without effect: {}"


def design_by_kind(
    loop: Loop,
    kind: str = "spring-damper",
    condition: str | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
    **options: Any,
) -> Design:
    """Design and verify a coupling; `options` are those of the design's own function: order, method, diagonal for ccl,
    those of design.optimal.Options for optimal. `progress` hears what takes long: (what, steps done, of how many).
    Without a condition it is the usual one. A spring-damper for this environment is covered also while forces are
    limited, unless `limiter` is False or no such one is found; with `limiter` True it is that or none.

    Raises ValueError for a kind or condition that does not exist, Infeasible or DesignFailed (design.failure) where
    there is nothing to return.
    """
    if kind not in KINDS:
        raise ValueError(f"coupling is {kind!r}, allowed are {', '.join(KINDS)}")
    condition = condition or usual_condition(loop, kind)
    if condition not in KINDS[kind]:
        raise ValueError(f"condition is {condition!r}, for {kind} allowed are {', '.join(KINDS[kind])}")
    from design import fixed_order as ccl  # cvxpy takes a second to import
    from design import spring_damper

    def made(loop: Loop) -> Design:
        if kind == "optimal":
            return _optimal(loop, progress, **options)
        if kind == "ccl":
            return ccl.design(loop, **options)
        if kind == "moving-average":
            return spring_damper.moving_average(loop)
        return _spring_damper(loop, condition, **options)

    if loop.latency is None or kind == "optimal":
        return made(loop)
    if condition == "any-environment":
        raise ValueError(f"latency: {LATE}, or design for this-environment")
    return _with_latency(loop, made)


def _spring_damper(loop: Loop, condition: str, limiter: bool | None = None, **options: Any) -> Design:
    """A spring-damper, with the limiter's block in the place of the linear one where that is asked for or usual."""
    from design.spring_damper import design

    if limiter is False or condition == "any-environment":  # with rho = 0 any-environment covers limited forces anyway
        return design(loop, condition, **options)
    refusal = limiter_refusal(loop)
    if limiter and refusal:
        raise ValueError(refusal)
    if refusal or options.get("switching"):
        return design(loop, condition, **options)
    try:
        return design(loop, condition, limiter=True, **options)
    except DesignFailed:
        if limiter:
            raise
        return design(loop, condition, **options)


#: A design for forces that latch late leaves at most this share of the damping, and is sought so often.
_UNUSED, _MOST_ROUNDS = 0.005, 6


def _with_latency(loop: Loop, made: Callable[[Loop], Design]) -> Design:
    """The design for forces that latch at the tick and so much less damping that the late ones need what there is."""
    share, best = 1.0, None
    for _ in range(_MOST_ROUNDS):
        part = msgspec.structs.replace(loop, latency=None, delta=tuple(share * d for d in loop.delta))
        found = made(part)
        needs = this_environment(loop.F(found.coupling), loop.delta, loop.T_max, loop.latency)
        if needs.certified:
            best = replace(found, requirement=needs)
            if needs.ratio > 1 - _UNUSED:
                return best
        share = min(1.0, share * (1 - _UNUSED / 2) / needs.ratio)
        if best and share == 1.0:
            return best
    if best is None:
        raise DesignFailed(None, (), f"no coupling was found for a latency of {loop.latency} s")
    return best


def _optimal(
    loop: Loop,
    progress: Callable[[str, int, int], None],
    switching: tuple[Sequence[int], Sequence[int]] | None = None,
    **options: Any,
) -> Design:
    """The optimal coupling; the rungs of its ladder are the steps."""
    from design import optimal

    asked = optimal.Options(**options)
    done = 0

    def heard(rung: optimal.Rung) -> None:
        nonlocal done
        done += 1
        progress(f"{rung.mismatch_db:.2f} dB after {rung.seconds:.1f} s", done, len(asked.ladder))

    span = None if switching is None else DelayRange(*(tuple(map(int, end)) for end in switching))
    return optimal.design(loop.switching(span), asked, progress=heard)


def compare_methods(loop: Loop) -> tuple[Row, ...]:
    """Every method for the same loop: norm, convex problems, seconds."""
    from design import fixed_order as ccl

    return ccl.compare(loop)


Kind = Literal["spring-damper", "moving-average", "ccl", "optimal"]
LOOP = 'a Loop, as scenario.loop("I") gives it'


class Options(TypedDict, total=False):
    """What else can be asked of a kind, see design.designs.OPTIONS; functions, filter and margin have no effect."""

    order: int  # ccl: states per channel
    method: str  # ccl: complementarity, inner or fixed-poles
    diagonal: bool  # ccl: no gain across channels
    switching: tuple[Sequence[int], Sequence[int]]  # spring-damper, optimal: (lo, hi) [samples] of delays that vary
    limiter: (
        bool  # spring-damper and optimal for this-environment: covered also while forces are limited (usual) or not
    )
    objective: Literal["rms", "sup"]  # optimal: of the mismatch relative to the environment
    band_hz: tuple[float, float]  # optimal: where the mismatch counts
    high_gain: float | None  # optimal: limit of |F|/|E| above 100 Hz; None: kept low, not limited
    seconds: float  # optimal: no further rung of the ladder is begun later than this
    functions: int
    filter: str
    margin: float


def design_coupling(
    loop: Loop, kind: Kind = "spring-damper", condition: Condition | None = None, **options: Unpack[Options]
) -> Design:
    """Design a coupling for a loop: `scenario.loop("I")`, which is all that a design knows of a scenario.

    `kind` is "spring-damper", "moving-average" (the stiffest for any environment), "ccl" or "optimal"; `condition` is
    "any-environment" or "this-environment", None for what the commands design: a spring-damper for this environment,
    also while forces are limited; for any environment before walls, ranges or delays that vary. `options` are those of
    the kind, see Options; switching is not taken from loop.jitter.

    Returns a Design: `coupling` (for a spring-damper with K (m,) [N/m] and B (m,) [N s/m]), `requirement` (the damping
    that it needs, from a sweep of the coupling alone), `figure` and `objective` (what was minimised, and its value).

    Raises TypeError for an argument of another type or an option that the kind does not have, ValueError for a kind,
    condition or loop that makes no sense, DesignFailed where no such coupling exists.
    """
    of_kind("loop", loop, Loop, LOOP)
    one_of("kind", kind, KINDS)
    known(options, OPTIONS[kind], f"kind {kind!r}")
    asked: dict[str, Any] = dict(options)
    if kind == "optimal" and (retired := [name for name in RETIRED if asked.pop(name, None) is not None]):
        warnings.warn(NO_LONGER.format(", ".join(retired)), DeprecationWarning, stacklevel=2)
    return design_by_kind(loop, kind, condition, **asked)


def certify(loop: Loop, coupling: Coupling | Design) -> dict[str, Requirement[str]]:
    """What both conditions, "any-environment" and "this-environment", ask of a coupling in its loop.

    With ranges around the loop's environment this-environment is about the environment and every vertex: the figure is
    that of the one that asks the most, proved only if all are. Between the vertices nothing is proved, but searched: a
    violation found there (design.box.worst_member) is the figure then, and not certified. With a range of delays,
    loop.jitter, there is a third, "jitter-proof": what any switching within the range asks.

    Each Requirement has `required` and `available` (m,) [N s/m], `certified` (required < available), the frequency [Hz]
    where it binds, and `proof`: "rational" where exact arithmetic confirms it, "sampled" where a refined sweep says so.
    A condition that no damping satisfies has infinite `required` and a `reason`.

    Raises TypeError for an argument of another type, ValueError where coupling and loop do not fit each other,
    SingularLoop where their algebraic loop has no solution.
    """
    of_kind("loop", loop, Loop, LOOP)
    phi = coupling.phi if isinstance(coupling, Design) else None
    alone = _fitting(loop, coupling)
    requirements: dict[str, Requirement[str]] = dict(assess(loop, alone, phi))
    if whole := check_set(loop, alone, samples=0):
        _, worst = whole.worst if whole.proved else whole.worst_found
        requirements["this-environment"] = replace(worst, proof="rational" if whole.proved else "sampled")
    if loop.jitter:
        requirements["jitter-proof"] = switching_requirement(loop, alone).requirement
    return requirements


def guarantee(loop: Loop, requirements: Mapping[str, Requirement[str]]) -> str | None:
    """For which environments `certify(loop, coupling)` says that a coupling is safe, in words; None where for none.

    "any passive environment", "a set" (the loop's environment and its box), "this environment", or each contact state
    of an environment with walls. Raises TypeError for an argument of another type, ValueError for other requirements.
    """
    of_kind("loop", loop, Loop, LOOP)
    of_kind("requirements", requirements, Mapping, "what certify returned")
    if "this-environment" not in requirements:
        raise ValueError(f"requirements has {', '.join(requirements) or 'nothing'}, expected what certify returned")
    held = requirements["this-environment"]
    whole_set = loop.box is not None and held.certified and held.proof == "rational"
    return guarantees.guarantee_of(requirements, loop, whole_set)


def transparency_of(loop: Loop, coupling: Coupling | Design) -> Transparency:
    """How close what the devices feel comes to the environment: figures of the mismatch (8), M = F - Lambda E.

    `mismatch_db` is its largest share of the environment between 0.5 and 80 Hz, `rms_mismatch_db` the mean one: 0 dB
    is as wrong as feeling nothing. `dc_ratio` is the share of the static stiffness that is felt. In the loop's own
    environment; of one with walls, touching them all.

    Raises TypeError and ValueError as `certify` does.
    """
    of_kind("loop", loop, Loop, LOOP)
    return transparency(loop.F(_fitting(loop, coupling)), loop.E(), loop.lam)


def _fitting(loop: Loop, coupling: Coupling | Design) -> Coupling:
    """The coupling alone. Raises ValueError where it is one of another number of channels."""
    alone = bare(coupling)
    Stored.of(loop, alone)
    return alone
