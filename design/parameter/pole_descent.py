"""The poles of a basis moved to where they help: descent on the optimum of the convex problem.

The optimum over a basis is a function of its poles. Its gradient costs no further problem: with x and the multipliers y
of the solution held, it is that of the Lagrangian, objective - <y, inequalities> (the envelope theorem). Poles at one
place have the same gradient, so they stay together: what moves are places, each with its number of poles.

In the poles nothing is convex. The descent ends in a local optimum near its start, where each set of poles is still
solved globally; a result that is not better than the start is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from controller.coupling import InternalModel
from controller.lti import Array
from design.failure import DesignFailed
from design.parameter.cone_program import vectors
from design.parameter.cutting_planes import Optimum, Problem, cut_problem, mean_square_mismatch
from design.parameter.free_parameter import UNIT, FreeParameter, GivenParameter
from design.parameter.inequalities import BOUND, World
from design.parameter.wish import Wish

DESCENTS = 2  # with the frequencies imposed that the one before has shown to matter
MOST_TRIALS = 12  # convex problems of a descent
STEP = 1e-5  # of the central differences
FARTHEST = 0.9985  # from zero that a place may go
DIGITS = 4  # of a pole after the point: short rationals make short proofs
HOPELESS = 10.0  # logarithm of the mismatch where the problem has no solution


@dataclass(frozen=True)
class Places:
    """Poles by where they are."""

    at: Array  # (places,)
    number: tuple[int, ...]  # poles at each

    @classmethod
    def of(cls, poles: Array) -> Places:
        at, number = np.unique(poles, return_counts=True)
        return cls(at, tuple(number.tolist()))

    def poles(self) -> Array:
        return np.repeat(self.at, self.number)


def descend(
    Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array, descents: int = DESCENTS
) -> tuple[FreeParameter, int]:
    """(Q with its poles moved, convex problems solved), from the poles of Q.

    Raises Infeasible and DesignFailed as design.parameter.cutting_planes.cut does for the poles of Q.
    """
    problem = Problem.of(Q, wish, worlds, delta)
    optimum, solved = cut_problem(problem)
    best = problem, log_mismatch(problem, optimum)
    for _ in range(descents if Q.poles.size else 0):
        poles, trials = moved(problem, optimum)
        problem = replace(problem, Q=replace(Q, poles=poles))
        solved += trials
        try:
            optimum, rounds = cut_problem(problem, optimum.imposed)
        except DesignFailed:
            break
        solved += rounds
        if log_mismatch(problem, optimum) < best[1]:
            best = problem, log_mismatch(problem, optimum)
    return best[0].Q, solved


def moved(problem: Problem, optimum: Optimum) -> tuple[Array, int]:
    """(better poles, trials) with the inequalities where the optimum has them imposed."""
    places, trials = Places.of(problem.Q.poles), 0

    def trial(u: Array) -> tuple[float, Array]:
        nonlocal trials
        trials += 1
        now = replace(places, at=np.tanh(u))
        here = replace(problem, Q=replace(problem.Q, poles=now.poles()))
        try:
            found = here.optimum(optimum.imposed)
        except DesignFailed:
            return HOPELESS, np.zeros(u.size)
        return log_mismatch(here, found), gradient(here, found, now) / np.cosh(u) ** 2

    bound = np.arctanh(FARTHEST)
    start = np.arctanh(np.clip(places.at, -FARTHEST, FARTHEST))
    options = {"maxfun": MOST_TRIALS}
    result = minimize(trial, start, jac=True, method="L-BFGS-B", bounds=[(-bound, bound)] * start.size, options=options)
    return np.round(replace(places, at=np.tanh(result.x)).poles(), DIGITS), trials


def gradient(problem: Problem, optimum: Optimum, places: Places) -> Array:
    """d log_mismatch / d place, (places,), by central differences of the Lagrangian; `places` are the problem's."""
    slopes = []
    for unit in np.eye(places.at.size):
        ahead, behind = (
            lagrangian(problem, optimum, replace(places, at=places.at + side * STEP * unit).poles()) for side in (1, -1)
        )
        slopes.append((ahead - behind) / (2 * STEP))
    value = np.exp(log_mismatch(problem, optimum))
    return np.array(slopes) / (value**2 if problem.squares else value)


def log_mismatch(problem: Problem, optimum: Optimum) -> float:
    """Logarithm of what is minimised, as a ratio to the environment."""
    if not problem.squares:
        return float(np.log(optimum.shared[BOUND]))
    A, b = mean_square_mismatch(problem.worlds, problem.Q)
    return float(np.log(np.linalg.norm(A @ optimum.x - b)))


def lagrangian(problem: Problem, optimum: Optimum, poles: Array) -> float:
    """Objective - <multipliers, inequalities> for the optimum's coefficients over other poles.

    What does not move with the poles is left out: the bound of a sup objective, and all that is asked at z = 1.
    """
    given = _given(problem.Q, poles, optimum.x)
    names, values = problem.shared, np.array(list(optimum.shared.values()))
    total = 0.0
    if problem.squares:
        _, b = mean_square_mismatch(problem.worlds, given)
        total += float(b @ b) / 2
    for one, w, multipliers in zip(problem.inequalities, optimum.imposed, optimum.multipliers, strict=True):
        total -= float(multipliers @ vectors(one.unknowns(w, given, names).at(values)).ravel())
    return total


def _given(Q: FreeParameter, poles: Array, x: Array) -> GivenParameter:
    """The coefficients x, not rounded, over other poles."""
    coefficients = np.zeros((poles.size + 1, Q.channels, Q.channels))
    coefficients[tuple(np.array(Q.entries).T)] = UNIT * x
    return GivenParameter(InternalModel(poles, coefficients))
