"""The kinds of couplings with their conditions and options, and `design_by_kind`, which designs a coupling."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import msgspec
import numpy as np

from haptic_loop.controller.arithmetic import Number, SingularLoop, numbers
from haptic_loop.controller.environment import RIGID_WALL, Environment, with_frozen_walls
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design import budgets
from haptic_loop.design.conditions import Condition
from haptic_loop.design.environments import ANY_ENVIRONMENT, LIMITER, THIS_ENVIRONMENT
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, KnownDevice
from haptic_loop.design.own import called, named
from haptic_loop.design.result import ANY, Design, DesignFailed
from haptic_loop.design.transparency import NO_FORCE, silent

_Progress = Callable[[str, int, int], None]  # called with (task, steps done, number of steps)


class _Kind(NamedTuple):
    conditions: tuple[Condition, ...]  # allowed conditions; `usual_condition` chooses the default
    module: str  # name of the module in design/; it is imported when the first coupling of this kind is designed
    function: str  # name of the module's function, which takes a loop and returns a Design
    takes: tuple[str, ...] = ()  # further arguments of the function: "condition", "progress"
    options: tuple[str, ...] = ()  # names of the kind's options (design.api.DesignOptions)
    model: bool = False  # whether the coupling contains a model of the environment, so that walls are impossible
    limited: bool = False  # whether a design tries to cover limited forces if the user does not request it
    for_less_damping: bool = False  # whether a coupling may be designed for a user's own condition


KINDS = {
    "spring-damper": _Kind(
        (THIS_ENVIRONMENT, KNOWN_DEVICE, KNOWN_DEVICE_ANY, ANY_ENVIRONMENT),
        "spring_damper",
        "design",
        ("condition",),
        ("switching", "limiter", "band_hz"),
        limited=True,
        for_less_damping=True,
    ),
    "moving-average": _Kind(
        (ANY_ENVIRONMENT, KNOWN_DEVICE_ANY), "spring_damper", "moving_average", ("condition",), for_less_damping=True
    ),
    "ccl": _Kind((ANY_ENVIRONMENT,), "fixed_order", "design", options=("order",)),
    "optimal": _Kind(
        (THIS_ENVIRONMENT, KNOWN_DEVICE),
        "optimal",
        "design_with",
        ("condition", "progress"),
        ("objective", "band_hz", "high_gain", "limiter", "seconds", "switching"),
        model=True,
    ),
}


_OWN = _Kind((THIS_ENVIRONMENT, ANY_ENVIRONMENT), "", "")  # for a user's own function


def kind_of(name: str) -> _Kind:
    return KINDS.get(name, _OWN)


def usual_condition(loop: Loop, kind: str = "spring-damper") -> str:
    """Return the name of the default condition of a design.

    The default of a spring-damper or a user's own function is this-environment, which gives the least transparency
    error. In loops with walls, worlds, ranges or varying delays, but without a latency, the default is any-environment.
    Each of the other kinds has one condition besides known-device and known-device-any.

    These two conditions need bounds of the devices, and never require more damping than the conditions without bounds.
    With known bounds they take precedence where KINDS allows them: known-device replaces this-environment in loops
    without a latency, and known-device-any is chosen for loops with walls that it covers.
    """
    conditions, walls, world = kind_of(kind).conditions, loop.environment.walls, loop.environment.world
    varied = walls or world or loop.ranges or loop.varying_delay
    plain = [each for each in conditions if not isinstance(each, KnownDevice)]
    only = len(plain) == 1 and not (walls or world)
    if loop.known_devices and KNOWN_DEVICE in conditions and not loop.latency and (only or not varied):
        return KNOWN_DEVICE.name
    if walls and not world and KNOWN_DEVICE_ANY in conditions and not KNOWN_DEVICE_ANY.beyond(loop):
        return KNOWN_DEVICE_ANY.name
    return (plain[-1] if varied and not loop.latency else plain[0]).name  # The last one covers the most environments.


def name_and_own(condition: str | Condition | None) -> tuple[str | None, Condition | None]:
    """Return the condition's name, and the condition itself if it is the user's own, else None."""
    if condition is None or isinstance(condition, str):
        return condition, None
    ours = (*_OWN.conditions, KNOWN_DEVICE, KNOWN_DEVICE_ANY)
    return condition.name, None if condition in ours else condition


def design_by_kind(
    loop: Loop,
    kind: str = "spring-damper",
    condition: str | Condition | None = None,
    progress: _Progress = lambda what, done, total: None,
    **options: Any,
) -> Design:
    """Design and verify a coupling.

    Args:
        kind: A name of KINDS, or FILE.py:NAME of a user's own function.
        condition: The condition, or None for `usual_condition`. For a user's own condition the coupling is designed by
            the kind's usual condition for a share of the damping, such that it satisfies the user's condition with
            the full damping.
        progress: Called during long searches with (task, steps done, number of steps).
        **options: Options of the kind (design.api.DesignOptions). A spring-damper by this-environment covers limited
            forces if LIMITER has designs for the loop and a search finds one. Otherwise a design with `limiter` True
            fails. `switching` replaces loop.varying_delay.

    Raises:
        ValueError: The kind or condition does not exist, or it is not suitable for the loop.
        Infeasible, DesignFailed: No coupling was found (design.result).
    """
    name, own = name_and_own(condition)
    if kind not in KINDS and ":" in kind:
        return _by_own_function(loop, kind, condition)
    if kind not in KINDS:
        raise ValueError(f"coupling is {kind!r}, allowed are {', '.join(KINDS)} and FILE.py:NAME of your own")
    chosen = KINDS[kind]
    if own and not chosen.for_less_damping:
        able = ", ".join(other for other in KINDS if KINDS[other].for_less_damping)
        why = f"{kind} couplings are not designed for a condition of your own, allowed are {able} and FILE.py:NAME"
        raise ValueError(f"condition is {own.name}: {why}; your condition can judge a stored coupling FILE.json")
    condition_name = usual_condition(loop, kind) if own or not name else name
    able = {c.name: c for c in chosen.conditions}
    if condition_name not in able:
        raise ValueError(f"condition is {condition_name!r}, for {kind} allowed are {', '.join(able)}")
    started = time.perf_counter()
    if span := options.pop("switching", None):
        loop = loop.switching(DelayRange(*(tuple(map(int, end)) for end in span)))
    design = _designed(loop, kind, able[condition_name], own, progress, options)
    return replace(design, wall_s=time.perf_counter() - started)


def _designed(
    loop: Loop, kind: str, condition: Condition, own: Condition | None, progress: _Progress, options: dict[str, Any]
) -> Design:
    """Return the coupling that is designed by `condition`. It also satisfies the user's condition `own`, if any.

    Raises the errors of `design_by_kind`.
    """
    chosen, beyond, walls = KINDS[kind], condition.beyond(loop), loop.environment.walls
    if loop.levels and beyond:
        raise ValueError(beyond)
    if loop.levels and (kind != "moving-average" or condition is KNOWN_DEVICE_ANY):
        return _in_principal_axes(loop, kind, own or condition, progress, options)
    if chosen.model and walls:
        reason = f"environment.walls: an {kind} coupling holds a linear model, so it cannot face walls"
        raise ValueError(f"{reason}{_before_walls(loop)}")
    if chosen.model and options.get("limiter") and (reason := LIMITER.not_designed(loop)):
        with_less = {**options, "limiter": False, "bases": ((4, 3),)}
        raise ValueError(f"{reason}{_instead(loop, 'leaving out --limiter', kind, **with_less)}")
    if loop.latency and beyond:
        raise ValueError(f"latency: {beyond.removeprefix('latency: ')}")
    if kind != "moving-average" and loop.environment is RIGID_WALL and condition is not KNOWN_DEVICE_ANY:
        other = (
            "use moving-average, spring-damper with known-device-any, or design.audit --rigid for the stiffest spring"
        )
        raise ValueError(f"environment: a rigid wall has no E(z) with which {kind} is designed; {other}")
    if kind != "moving-average" and _without_force(loop):
        raise ValueError(f"{NO_FORCE}, or take moving-average")
    further = {"condition": condition.name, "progress": progress}
    further = {name: value for name, value in further.items() if name in chosen.takes}
    make = partial(getattr(import_module(f"haptic_loop.design.{chosen.module}"), chosen.function), **further, **options)
    if own:
        return _of_own(_with_less_damping(loop, make, own, condition), own)
    if condition.guarantee(loop) == ANY:
        uncovered = (loop.latency or loop.varying_delay) and kind != "moving-average"
    else:  # The search for gains by known-device allows constant delays only.
        switched = loop.varying_delay and condition is KNOWN_DEVICE
        uncovered = not chosen.model and (loop.latency or walls or loop.ranges or switched)
    return _with_less_damping(loop, make, condition) if uncovered else make(loop)


def _of_own(design: Design, own: Condition) -> Design:
    """Return the design with the user's own condition, without proofs and multipliers of its first condition."""
    without = dict.fromkeys(("phi", "c", "certificate", "limiter", "switching", "searched"))
    return replace(design, condition=own.name, own=own, **without)


def _by_own_function(loop: Loop, kind: str, condition: str | Condition | None) -> Design:
    """Return the design of the user's own function, judged by the user's own condition if there is one."""
    name, own = name_and_own(condition)
    design = own_coupling(kind, loop)
    if not isinstance(design, Design):
        raise ValueError(f"coupling {kind} is {design!r} for this loop, expected a design.result.Design")
    if own:
        needs = own.judge(loop.at(loop.environment), design.coupling)
        return _of_own(replace(design, requirement=needs), own)
    if name not in (None, design.condition):
        raise ValueError(f"condition is {condition!r}, but {kind} is designed for {design.condition}")
    return design


def _without_force(loop: Loop) -> bool:
    """Return whether the environment has an E(z) and never exerts a force."""
    if loop.environment is RIGID_WALL:
        return False
    with suppress(SingularLoop):  # A world has no E(z).
        return silent(loop.E())
    return False


class _Turned(Environment):
    """An environment in turned coordinates of the contacts: Q'E Q in place of E, with an orthogonal Q (m, m)."""

    def __init__(self, of: Environment, Q: Array) -> None:
        self.contacts, self.of, self.Q, self.world = of.contacts, of, Q, of.world

    def E(self, T: Number) -> Lti:
        Q = numbers(self.Q, T)
        return Q.T @ self.of.E(T) @ Q

    def active(self, T: float) -> str | None:
        return self.of.active(T)  # The power does not depend on the coordinates.


_ROUNDED = 1e-9  # share of the damping that covers the rounding of the eigenvalues of damping matrices


def _in_principal_axes(
    loop: Loop, kind: str, condition: Condition, progress: _Progress, options: dict[str, Any]
) -> Design:
    """Return a coupling for damping matrices that are not diagonal.

    Each device's damping matrix is Delta_i = Q_i diag(d) Q_i'. In the coordinates turned by Q = blockdiag(Q_i), the
    damping is diagonal, E is Q'E Q, and the conditions and the mismatch are the same (docs/theory.md). The coupling is
    designed in these coordinates, turned back, and judged with the full matrices. Raises ValueError if no such design
    exists for the loop or the kind, and DesignFailed if the coupling is not certified.
    """
    if loop.ranges and kind == "optimal":
        why = "an optimal coupling is designed in the principal axes of the damping, where ranges are not supported"
        raise ValueError(f"levels: {why}; use a spring-damper or a moving-average")
    if loop.environment.walls and kind == "spring-damper":
        if options.get("limiter") and (reason := LIMITER.not_designed(loop)):
            raise ValueError(reason)
        options = {**options, "limiter": False}
    Delta, Q = loop.Delta(), np.zeros((loop.channels,) * 2)
    for own in loop.devices:
        Q[own, own] = np.linalg.eigh(Delta[own, own])[1]
    values = (1 - _ROUNDED) * np.diag(Q.T @ Delta @ Q)

    def straight_design(part: Loop) -> Design:
        """Return the design for `part`, which is the loop with a share of its damping and with all walls in contact."""
        delta = tuple((part.delta[0] / loop.delta[0] * values).tolist())
        straight = {"environment": _Turned(loop.environment, Q), "delta": delta, "levels": None, "ranges": None}
        design = design_by_kind(msgspec.structs.replace(part, **straight), kind, condition, progress, **options)
        coupling = design.coupling.turned(Q)
        requirement = condition.judge(loop.at(loop.environment), coupling)
        return replace(design, coupling=coupling, requirement=requirement, certificate=None)

    if loop.environment.walls and condition.guarantee(loop) != ANY:
        return _with_less_damping(loop, straight_design, condition)
    design = straight_design(loop)
    if not design.requirement.certified:
        why = f"the designed coupling is not certified by {condition.name}: {design.requirement.shortfall}"
        raise DesignFailed(None, (), why)
    return design


def _instead(loop: Loop, words: str, kind: str, **options: Any) -> str:
    """Return the end of an error message, which proposes this kind of design, or "" if the design fails."""
    with suppress(ValueError, DesignFailed):
        design = design_by_kind(loop, kind, **options)
        if design.requirement.certified:
            return f"; {words} gives a coupling that needs {design.requirement.ratio:.4g} of the available damping"
    return ""


def _before_walls(loop: Loop) -> str:
    """Return the end of an error message: the first certified design for this loop with walls, or all that failed."""
    tried = []
    others = (
        ("spring-damper", ANY_ENVIRONMENT),
        ("moving-average", ANY_ENVIRONMENT),
        ("spring-damper", THIS_ENVIRONMENT),
    )
    for kind, condition in others:
        tried.append(f"--coupling {kind} --condition {condition.name}")
        if proposal := _instead(loop, tried[-1], kind, condition=condition.name):
            return proposal
    return f"; tried and not certified either: {', '.join(tried)}"


def own_coupling(name: str, loop: Loop) -> Any:
    """Return the result of the user's own function FILE.py:NAME for a loop. Raises InputError."""
    return called(f"--coupling {name}", named("--coupling", name), loop)


_UNUSED = (
    0.005  # `_with_less_damping` ends when a certified coupling leaves less than this share of the damping unused.
)


def _with_less_damping(
    loop: Loop, make: Callable[[Loop], Design], condition: Condition, made_for: Condition | None = None
) -> Design:
    """Return a design for a share of the damping, with a coupling that satisfies `condition` with the full damping.

    `make` designs each coupling for the condition `made_for` (by default `condition`), in the nominal environment, with
    all walls in contact and without the latency. If `make` cannot consider switching delays, the loop has its longest
    delays. Up to LESS_DAMPING_ROUNDS shares are tried, until the coupling needs almost all of the damping.
    """
    share, best, shortfall = 1.0, None, ""
    walls = loop.environment.walls
    constant = not (made_for or condition).extensible or loop.latency or walls
    where = loop.delayed(loop.delays.hi) if constant else loop
    if condition is KNOWN_DEVICE and walls:
        where = where.at(with_frozen_walls(loop.network))  # The search for gains has no multipliers of walls.
    all_members = condition.extensible or condition is KNOWN_DEVICE or (made_for and not condition.beyond(loop))
    judged = loop if all_members else loop.at(loop.environment)
    for _ in range(budgets.LESS_DAMPING_ROUNDS):
        design = make(msgspec.structs.replace(where, latency=None, ranges=None, **_scaled(loop, share)))
        needs = condition.judge(judged, design.coupling)
        shortfall = needs.shortfall
        if needs.certified:
            # The notes are dropped, because their figures are those for a share of the damping.
            best = replace(design, requirement=needs, notes=())
            if needs.ratio > 1 - _UNUSED:
                return best
        if np.isinf(needs.ratio):
            break
        share = min(1.0, share * (1 - _UNUSED / 2) / needs.ratio)
        if best and share == 1.0:
            return best
    if best is None:
        raise DesignFailed(None, (), f"no coupling was found for {condition.name}: {shortfall}")
    return best


def _scaled(loop: Loop, share: float) -> dict[str, Any]:
    levels = loop.levels and tuple(tuple(tuple(share * v for v in row) for row in level) for level in loop.levels)
    return {"delta": tuple(share * d for d in loop.delta), "levels": levels}
