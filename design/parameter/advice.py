"""Why there is no optimal coupling of the kind that was asked for, and what would have to be another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from design.box.advice import Progress, set_advice
from design.failure import DesignFailed
from design.parameter.cutting_planes import asked, cut, sketch
from design.parameter.inequalities import CLOSED_LOOP, SWITCHING
from design.parameter.wish import MARGIN, Wish
from design.parameter.worlds import parameter, world, worlds
from design.specification import Specification

MOST = 24  # functions that are tried to say whether more of them would help
EASIER = (1.5, 2, 3, 5, 10, 20, 50)  # times the damping, tried to say how far a request is from having a solution


def advice(spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None) -> str:
    """Why nothing was found, and which change of the request, one at a time, leaves a solution."""
    alone = replace(spec, others={}, shrunk=None)
    if spec.others and feasible(alone, wish):
        return set_advice(spec, wish, changes(spec, wish), feasible, solvable, binding, progress)
    spec = alone
    helpful = _helpful(spec, changes(spec, wish), progress) or _helpful(spec, last_resorts(wish), progress)[:1]
    kind = "diagonal" if wish.diagonal else "full"
    delays = f"theta = {list(spec.theta)}, psi = {list(spec.psi)}"
    if wish.switching:
        lo, hi = wish.switching
        delays += f", delays switching from {list(lo)} to {list(hi)}"
    request = f"no {kind} Q of {wish.functions} functions is certified with {delays}, delta = {list(spec.delta)}"
    request += f": {binding(spec, wish)}"
    if helpful:
        return f"{request} in this basis; there is one with {', or with '.join(helpful)}"
    damped = ((f, replace(spec, delta=tuple(f * d for d in spec.delta))) for f in EASIER)
    factor = next((f for f, easier in damped if feasible(easier, wish) and solvable(easier, wish)), None)
    would_do = [f"{factor:g} times the damping"] if factor else []
    if any((*spec.theta, *spec.psi)):
        none = (0,) * spec.channels
        at_once = replace(spec, theta=none, psi=none, lam=none)
        would_do += ["no delay at all"] if solvable(at_once, replace(wish, switching=None)) else []
    if would_do:
        return f"{request}; {' or '.join(would_do)} would do"
    return f"{request}; not even {EASIER[-1]} times the damping would do"


def binding(spec: Specification, wish: Wish) -> str:
    """Which inequality is in the way: one without which the others have a solution.

    The condition for switching delays contains the closed-loop one, so it is left out with it.
    """
    names = list(dict.fromkeys(one.name for one in asked(wish, world(spec), np.asarray(spec.delta))))
    sets = {name: (name,) for name in names}
    if wish.switching:
        sets = {name: (name,) if name != SWITCHING else (name, CLOSED_LOOP) for name in names if name != CLOSED_LOOP}
    free = [name for name, left_out in sets.items() if feasible(spec, wish, left_out)]
    if not free:
        return "more than one condition binds: none of them alone is in the way"
    return f"{free[0]} binds" if len(free) == 1 else f"{' and '.join(free)} contradict each other"


def changes(spec: Specification, wish: Wish) -> dict[str, Wish]:
    """What else could be asked, in options of python -m design."""
    more = min(max(2 * wish.functions, 16), MOST)
    other = {
        f"--functions {more}": replace(wish, functions=more),
        "--filter mixed": replace(wish, filter="mixed"),
        "--full": replace(wish, diagonal=False),
        f"--full --functions {more} --filter mixed": replace(wish, functions=more, diagonal=False, filter="mixed"),
        "--high-gain none": replace(wish, high_gain=None),
        f"--margin {MARGIN:g}": replace(wish, margin=min(wish.margin, MARGIN)),
    }
    known, distinct = {_meaning(spec, wish)}, {}
    for words, changed in other.items():
        if (meaning := _meaning(spec, changed)) not in known:
            known.add(meaning)
            distinct[words] = changed
    return distinct


def _meaning(spec: Specification, wish: Wish) -> tuple:
    """The same for two wishes that ask the same, such as a filter by its name and by auto."""
    return (*wish.poles(spec), wish.diagonal, wish.high_gain, wish.margin)


def last_resorts(wish: Wish) -> dict[str, Wish]:
    """What could be asked where none of `changes` helps."""
    richest, words = (
        replace(wish, functions=MOST, diagonal=False, filter="mixed"),
        f"--full --functions {MOST} --filter mixed",
    )
    return {words: richest, f"{words} --high-gain none": replace(richest, high_gain=None)}


def _helpful(spec: Specification, others: Mapping[str, Wish], progress: Progress) -> list[str]:
    found = []
    for k, (words, other) in enumerate(others.items()):
        progress("no coupling: looking for the reason", k, len(others))
        found += [words] if feasible(spec, other) and solvable(spec, other) else []
    return found


def solvable(spec: Specification, wish: Wish) -> bool:
    """Whether there is a Q: the whole search."""
    try:
        cut(parameter(spec, wish), wish, worlds(spec), np.asarray(spec.delta))
    except DesignFailed:
        return False
    return True


def feasible(spec: Specification, wish: Wish, without: Sequence[str] = ()) -> bool:
    """Whether some Q meets what is asked at the frequencies where it is imposed first: a necessary condition.

    `without` names inequalities that are not asked.
    """
    try:
        sketch(parameter(spec, wish), wish, worlds(spec), np.asarray(spec.delta), without)
    except DesignFailed:
        return False
    return True
