"""The best linear coupling under the closed-loop condition: one convex problem in Q, in one environment or in a set.

F = Theta (Psi E - Psi E Q Psi E) is affine in Q, so the mismatch and He[F/(z-1)] > -Delta_D/T are convex in its
coefficients, and cutting planes (design.parameter) find the global optimum over a basis. What is returned passes
the refined sweep of design.margin, whatever a solver said.

Q stays and E is the current environment, so F is affine in Q at every vertex of a box, too: the same problem, with each
vertex as a further world. The rms mismatch is then the mean square over the environment and the vertices (that of the
environment alone would gain it 0.2 dB and cost the worst vertex 0.3 to 0.5), the sup mismatch the worst of them.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from controller.box import Member
from controller.coupling import InternalModel
from controller.environment import environment
from controller.lti import Lti
from controller.process import force_map
from design.box.advice import Progress, set_advice
from design.box.worst_member import Found, search
from design.failure import DesignFailed, Infeasible
from design.jitter.multiplier import jitter_proof
from design.margin import closed_loop
from design.parameter.cutting_planes import SLACK, asked, cut, sketch
from design.parameter.free_parameter import FreeParameter
from design.parameter.inequalities import CLOSED_LOOP, SWITCHING, World
from design.parameter.pole_descent import descend
from design.parameter.wish import MARGIN, Wish
from design.result import Design
from design.specification import Specification
from design.transparency import transparency

USUAL = Wish()
ADDED, MOST_ADDITIONS = 3, 8  # points of a box that become environments at a time, and how often at most
NO_LIMIT = "no limit above 100 Hz"
MOST = 24  # functions that are tried to say whether more of them would help
EASIER = (1.5, 2, 3, 5, 10, 20, 50)  # times the damping, tried to say how far a request is from having a solution


def design(spec: Specification, wish: Wish = USUAL, progress: Progress = lambda what, done, total: None) -> Design:
    """The coupling of the least mismatch, verified by the refined sweep of the condition.

    `progress` hears of the search for a reason where there is none, which takes longer than most designs.
    Raises Infeasible where no Q of this kind meets the condition, DesignFailed where none could be verified.
    """
    started = time.perf_counter()
    try:
        coupling, spec, rounds = searched(spec, wish, progress)
    except Infeasible as error:
        raise Infeasible(error.problem, error.results, advice(spec, wish, progress)) from error
    maps = [force_map(E, coupling, spec.theta, spec.psi) for E in environments(spec)]
    requirement = max((closed_loop(F, spec.delta) for F in maps), key=lambda r: r.ratio)
    if wish.switching:
        free = [force_map(E, coupling, (0,) * spec.channels, spec.psi) for E in environments(spec)]
        requirement = max(
            (jitter_proof(G, *wish.switching, spec.delta).requirement for G in free), key=lambda r: r.ratio
        )
    if requirement.ratio > 1 - wish.margin + 2 * SLACK:
        raise DesignFailed(None, (), _missed(requirement.ratio, wish))
    figures = [transparency(F, E, spec.lam) for F, E in zip(maps, environments(spec), strict=True) if E.D.any()]
    squares = [f.rms_mismatch**2 for f in figures]
    value = np.sqrt(np.mean(squares)) if wish.objective == "rms" else max(f.relative_mismatch for f in figures)
    wall = time.perf_counter() - started
    return Design(coupling, "closed-loop", wish.objective, float(value), requirement, rounds, wall)


def _missed(ratio: float, wish: Wish) -> str:
    more = wish.margin + 2 * (ratio - (1 - wish.margin))
    advice = f"leave more of it unused: --margin {more:.2g}" if more < 1 else "ask for fewer functions"
    return f"the optimum needs {ratio:.6f} of the damping when it is swept again; {advice}"


def searched(
    spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None
) -> tuple[InternalModel, Specification, int]:
    """(coupling, the specification with the points of the box that had to be added, rounds).

    Between the vertices of a box nothing is convex: what a search finds to violate the condition there becomes further
    environments, until it finds nothing. Raises DesignFailed where it still does after MOST_ADDITIONS times.
    """
    total, added, Q = 0, 0, parameter(spec, wish)
    if wish.filter == "adapted":
        Q, total = descend(Q, wish, worlds(spec), np.asarray(spec.delta))
    while True:
        coupling, rounds = cut(Q, wish, worlds(spec), np.asarray(spec.delta))
        total += rounds
        worst = violators(spec, coupling, 1 - wish.margin / 2, progress)
        if not worst:
            return coupling, spec, total
        if added == MOST_ADDITIONS:
            raise DesignFailed(None, (), _still_violated(worst[0]))
        added += 1
        more = {found.member.name: environment(found.member.network, spec.T) for found in worst[:ADDED]}
        spec = replace(spec, others={**spec.others, **more})


def violators(
    spec: Specification, coupling: InternalModel, most: float, progress: Progress = lambda what, done, total: None
) -> list[Found]:
    """Where in the box more than this share of the damping is needed, the worst first; a search finds them."""

    def ratio(member: Member) -> float:
        F = force_map(environment(member.network, spec.T), coupling, spec.theta, spec.psi)
        return closed_loop(F, spec.delta).ratio

    found = search(spec.regions, ratio, lambda done, total: progress("searching the box", done, total))
    return [one for one in found.worst if one.ratio > most]


def _still_violated(found: Found) -> str:
    return (
        f"after {MOST_ADDITIONS} rounds of adding the worst environments of the box to the design it is still violated "
        f"between the vertices: {found.ratio:.4f} of the damping is needed at {found.member.name}; "
        "give narrower ranges, or ask for more functions"
    )


def parameter(spec: Specification, wish: Wish) -> FreeParameter:
    """The unknown Q."""
    return FreeParameter(wish.poles(spec), spec.channels, wish.diagonal)


def environments(spec: Specification) -> list[Lti]:
    """The environment, and what else it may be."""
    return [spec.environment, *spec.others.values()]


def worlds(spec: Specification) -> list[World]:
    """The environments with the delays around them; one that no device feels asks nothing and is left out."""
    return [world(spec, E) for E in environments(spec) if E.D.any()]


def world(spec: Specification, E: Lti | None = None) -> World:
    """An environment, by default the specified one, with the delays around it."""
    return World(E or spec.environment, spec.theta, spec.psi, spec.lam)


def advice(spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None) -> str:
    """Why nothing was found, and which change of the request, one at a time, leaves a solution."""
    alone = replace(spec, others={}, shrunk=None)
    if spec.others and feasible(alone, wish):
        return set_advice(spec, wish, changes(wish), feasible, solvable, binding, progress)
    spec = alone
    helpful = _helpful(spec, changes(wish), progress) or _helpful(spec, last_resorts(wish), progress)
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
    remedy = f"{factor:g} times the damping, or less delay, would do" if factor else "only less delay can help"
    return f"{request}; {remedy}"


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


def changes(wish: Wish) -> dict[str, Wish]:
    """What else could be asked, in words."""
    more = min(max(2 * wish.functions, 16), MOST)
    other = {
        f"{more} functions": replace(wish, functions=more),
        "a mixed basis": replace(wish, filter="mixed"),
        "a full Q": replace(wish, diagonal=False),
        f"a full Q of {more} functions in a mixed basis": replace(wish, functions=more, diagonal=False, filter="mixed"),
        NO_LIMIT: replace(wish, high_gain=None),
        f"--margin {MARGIN:g}": replace(wish, margin=min(wish.margin, MARGIN)),
    }
    return {words: changed for words, changed in other.items() if changed != wish}


def last_resorts(wish: Wish) -> dict[str, Wish]:
    """What could be asked where none of `changes` helps."""
    richest, words = replace(wish, functions=MOST, diagonal=False, filter="mixed"), f"a full Q of {MOST} functions"
    return {
        f"{words} in a mixed basis": richest,
        f"{words} in a mixed basis and {NO_LIMIT}": replace(richest, high_gain=None),
    }


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
