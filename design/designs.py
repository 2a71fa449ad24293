"""The designs by name: which there are, what each can be asked, and one call for all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import msgspec

from controller.loop import Loop
from design.environments import THIS_ENVIRONMENT
from design.lmi import LATE
from design.own import called, named
from design.result import Design, DesignFailed


class Kind(NamedTuple):
    """One design: what it promises, where it is made, and what can be asked of it."""

    conditions: tuple[str, ...]  # that it can be made for, its own first
    module: str  # loaded when it is asked for
    function: str  # from a loop to a Design
    takes: tuple[str, ...] = ()  # besides the loop and its options: condition, progress
    options: tuple[str, ...] = ()  # in words of design.api.DesignOptions
    model: bool = False  # of the environment, in the coupling: made for late forces and whole ranges, not for walls
    limited: bool = False  # made for limited forces, too, unless it is asked not to be


KINDS = {
    "spring-damper": Kind(
        ("this-environment", "any-environment"),
        "design.spring_damper",
        "design_with",
        ("condition",),
        ("switching", "limiter", "band_hz"),
        limited=True,
    ),
    "moving-average": Kind(("any-environment",), "design.spring_damper", "moving_average"),
    "ccl": Kind(("any-environment",), "design.fixed_order", "design", options=("order", "method", "diagonal")),
    "optimal": Kind(
        ("this-environment",),
        "design.optimal",
        "design_with",
        ("progress",),
        ("objective", "band_hz", "high_gain", "limiter", "seconds", "switching"),
        model=True,
    ),
}


_OWN = Kind(("this-environment", "any-environment"), "", "")  # a function of a user's own, which takes a loop alone


def kind_of(name: str) -> Kind:
    """The kind of that name, or that of a user's own functions."""
    return KINDS.get(name, _OWN)


def usual_condition(loop: Loop, kind: str = "spring-damper") -> str:
    """The default condition of a design: a spring-damper is designed for this environment, which feels best.

    For any environment where this-environment covers less than the loop: limited forces before walls, ranges, delays
    that vary. Other kinds for their own condition.
    """
    less = loop.environment.walls or loop.ranges or loop.varying_delay
    conditions = kind_of(kind).conditions
    return "any-environment" if less and "any-environment" in conditions else conditions[0]


def design_by_kind(
    loop: Loop,
    kind: str = "spring-damper",
    condition: str | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
    **options: Any,
) -> Design:
    """Design and verify a coupling; `options` are those of the design's own function: order, method, diagonal for ccl,
    those of design.program.Options for optimal. `progress` hears what takes long: (what, steps done, of how many).
    Without a condition it is the usual one. A spring-damper for this environment is covered also while forces are
    limited, unless `limiter` is False or no such one is found; with `limiter` True it is that or none.

    Raises ValueError for a kind or condition that does not exist, Infeasible or DesignFailed (design.result) where
    there is nothing to return.
    """
    if kind not in KINDS and ":" in kind:
        found = own_coupling(kind, loop)
        if not isinstance(found, Design):
            raise ValueError(f"coupling {kind} is {found!r} for this loop, expected a design.result.Design")
        if condition not in (None, found.condition):
            raise ValueError(f"condition is {condition!r}, but {kind} is designed for {found.condition}")
        return found
    if kind not in KINDS:
        raise ValueError(f"coupling is {kind!r}, allowed are {', '.join(KINDS)} and package.module:function")
    condition = condition or usual_condition(loop, kind)
    chosen = KINDS[kind]
    if condition not in chosen.conditions:
        raise ValueError(f"condition is {condition!r}, for {kind} allowed are {', '.join(chosen.conditions)}")
    if chosen.model and loop.environment.walls:
        raise ValueError(f"environment.walls: an {kind} coupling holds a linear model, so it cannot face walls")
    own = (("condition", condition), ("progress", progress))
    further = {name: value for name, value in own if name in chosen.takes}
    made = partial(getattr(import_module(chosen.module), chosen.function), **further, **options)

    if condition == "any-environment" and loop.latency:
        raise ValueError(f"latency: {LATE}, or design for this-environment")
    if chosen.model or condition == "any-environment" or not (loop.latency or loop.environment.walls):
        return made(loop)
    return _with_less_damping(loop, made)


def own_coupling(name: str, loop: Loop) -> Any:
    """What a user's own function, named as `package.module:function`, makes of a loop. Raises InputError."""
    return called(f"--coupling {name}", named("--coupling", name), loop)


#: A design for forces that latch late, or for walls, leaves at most this share of the damping, and is sought so often.
_UNUSED, _MOST_ROUNDS = 0.005, 6


def _with_less_damping(loop: Loop, made: Callable[[Loop], Design]) -> Design:
    """The design for less damping, so that late forces, or walls that make and break, need no more than is available.

    It is made for forces that latch at the tick, and walls that all touch.
    """
    share, best = 1.0, None
    for _ in range(_MOST_ROUNDS):
        part = msgspec.structs.replace(loop, latency=None, delta=tuple(share * d for d in loop.delta))
        found = made(part)
        needs = THIS_ENVIRONMENT.required(loop.at(loop.environment), found.coupling)
        if needs.certified:
            best = replace(found, requirement=needs)
            if needs.ratio > 1 - _UNUSED:
                return best
        share = min(1.0, share * (1 - _UNUSED / 2) / needs.ratio)
        if best and share == 1.0:
            return best
    if best is None:
        what = f"a latency of {loop.latency} s" if loop.latency else "walls that make and break contact"
        raise DesignFailed(None, (), f"no coupling was found for {what}")
    return best
