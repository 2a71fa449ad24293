"""The best linear coupling under the closed-loop condition: one convex problem in Q.

F = Theta (Psi E - Psi E Q Psi E) is affine in Q, so the mismatch and He[F/(z-1)] > -Delta_D/T are convex in its
coefficients, and cutting planes (design.cutting_planes) find the global optimum over a basis. What is returned passes
the refined sweep of design.margin, whatever a solver said.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from controller.process import force_map
from design.cutting_planes import SLACK, cut, sketch
from design.failure import DesignFailed, Infeasible
from design.free_parameter import FreeParameter
from design.inequalities import World
from design.margin import closed_loop
from design.result import Design
from design.specification import Specification
from design.transparency import transparency
from design.wish import Wish

USUAL = Wish()
EASIER = (1.5, 2, 3, 5, 10, 20, 50)  # times the damping, tried to say how far a request is from having a solution


def design(spec: Specification, wish: Wish = USUAL) -> Design:
    """The coupling of the least mismatch, verified by the refined sweep of the condition.

    Raises Infeasible where no Q of this kind meets the condition, DesignFailed where none could be verified.
    """
    started = time.perf_counter()
    try:
        coupling, rounds = cut(parameter(spec, wish), wish, [world(spec)], np.asarray(spec.delta))
    except Infeasible as error:
        raise Infeasible(error.problem, error.results, advice(spec, wish)) from error
    F = force_map(spec.environment, coupling, spec.theta, spec.psi)
    requirement = closed_loop(F, spec.delta)
    if requirement.ratio > 1 - wish.margin + 2 * SLACK:
        raise DesignFailed(None, (), f"the optimum needs {requirement.ratio:.6f} of the damping when it is swept again")
    figures = transparency(F, spec.environment, spec.lam)
    value = figures.rms_mismatch if wish.objective == "rms" else figures.relative_mismatch
    wall = time.perf_counter() - started
    return Design(coupling, "closed-loop", wish.objective, value, requirement, rounds, wall)


def parameter(spec: Specification, wish: Wish) -> FreeParameter:
    """The unknown Q."""
    return FreeParameter(wish.poles(spec), spec.channels, wish.diagonal)


def world(spec: Specification) -> World:
    """The environment with the delays around it."""
    return World(spec.environment, spec.theta, spec.psi, spec.lam)


def advice(spec: Specification, wish: Wish) -> str:
    """Why nothing was found, and which change of the request, one at a time, leaves a solution."""
    more = min(max(2 * wish.functions, 16), 24)
    changes = {
        f"{more} functions": replace(wish, functions=more),
        "a mixed basis": replace(wish, filter="mixed"),
        "a full Q": replace(wish, diagonal=False),
        f"a full Q of {more} functions in a mixed basis": replace(wish, functions=more, diagonal=False, filter="mixed"),
        "no limit above 100 Hz": replace(wish, high_gain=None),
    }
    helpful = [words for words, other in changes.items() if other != wish and feasible(spec, other)]
    kind = "diagonal" if wish.diagonal else "full"
    delays = f"theta = {list(spec.theta)}, psi = {list(spec.psi)}"
    request = f"no {kind} Q of {wish.functions} functions is certified with {delays}, delta = {list(spec.delta)}"
    if helpful:
        return f"{request}; there seem to be some with {', or '.join(helpful)}"
    damped = ((f, replace(spec, delta=tuple(f * d for d in spec.delta))) for f in EASIER)
    factor = next((f for f, easier in damped if feasible(easier, wish)), None)
    remedy = f"{factor:g} times the damping, or less delay, would do" if factor else "only less delay can help"
    return f"{request}: the closed-loop condition binds; {remedy}"


def feasible(spec: Specification, wish: Wish) -> bool:
    """Whether some Q meets what is asked at the frequencies where it is imposed first: a necessary condition."""
    try:
        sketch(parameter(spec, wish), wish, [world(spec)], np.asarray(spec.delta))
    except DesignFailed:
        return False
    return True
