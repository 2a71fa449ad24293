"""The only caller of cvxpy's solve.

A solver's status is a claim. A result is used only if every variable is finite, the constraints hold when they
are evaluated again, and the caller's own `accept` agrees; otherwise the next settings of the ladder are tried.
Settings change what the solver does to the data, so one that breaks down seldom takes the others with it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.failure import Attempt, DesignFailed, Infeasible

#: Largest violation of a constraint that is taken for rounding; problems are posed in units where 1 is large.
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Settings:
    """A solver and its options."""

    name: str
    solver: str
    options: Mapping[str, Any] = field(default_factory=dict)


_TIGHT = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
_LOOSE = {"tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-6}

LADDER = (
    Settings("default", cp.CLARABEL),
    Settings("tight", cp.CLARABEL, {**_TIGHT, "max_step_fraction": 0.95}),
    Settings("as given", cp.CLARABEL, {"equilibrate_enable": False, "chordal_decomposition_enable": False}),
    Settings("loose", cp.CLARABEL, {**_LOOSE, "static_regularization_constant": 1e-7}),
)
CROSS_CHECK = Settings("splitting", cp.SCS, {"eps_abs": 1e-7, "eps_rel": 1e-7, "max_iters": 200_000})


def solve(
    problem: cp.Problem,
    what: str,
    accept: Callable[[], bool] | None = None,
    ladder: Sequence[Settings] = LADDER,
) -> tuple[Attempt, ...]:
    """Leave a verified optimum in the problem's variables; return the attempts, the last of which succeeded.

    `what` names the problem in the message of an error. Raises Infeasible when two settings agree that there is no
    solution and none found one, DesignFailed otherwise. After either, no variable holds a value.
    """
    attempts: list[Attempt] = []
    for settings in ladder:
        attempts.append(_attempt(problem, settings, accept))
        if attempts[-1].reason is None:
            return tuple(attempts)
        if sum(a.status == cp.INFEASIBLE for a in attempts) >= 2:
            break
    _forget(problem)
    statuses = ", ".join(f"{a.settings}: {a.status}" for a in attempts)
    if sum(a.status == cp.INFEASIBLE for a in attempts) >= 2:
        raise Infeasible(problem, attempts, f"{what} has no solution ({statuses})")
    advice = "try fewer delays, a larger damping or a lower order; the error carries the problem"
    raise DesignFailed(problem, attempts, f"{what} could not be solved ({statuses}); {advice}")


def solved(x: cp.Expression) -> Array:
    """The value that `solve` has left in x."""
    assert x.value is not None, "read before it was solved for"
    return np.asarray(x.value)


def _attempt(problem: cp.Problem, settings: Settings, accept: Callable[[], bool] | None) -> Attempt:
    started = time.perf_counter()
    status, reason = _call(problem, settings)
    if reason is None:
        reason = _doubt(problem, accept)
    value = None if reason else float(cast(float, problem.value))
    return Attempt(settings.name, status, value, time.perf_counter() - started, reason)


def _call(problem: cp.Problem, settings: Settings) -> tuple[str, str | None]:
    """(status, reason for refusing it or None). A cached solver would keep the options of the rung before."""
    _forget(problem)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # cvxpy's "may be inaccurate": we measure that
            problem.solve(solver=settings.solver, warm_start=False, **settings.options)
    except BaseException as error:  # Clarabel's Rust panics are not Exceptions
        panicked = type(error).__name__ == "PanicException"
        if not panicked and not isinstance(error, cp.SolverError):
            raise
        return ("panic" if panicked else cp.SOLVER_ERROR), str(error)
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        return problem.status, f"the solver reports {problem.status}"
    return problem.status, None


def _doubt(problem: cp.Problem, accept: Callable[[], bool] | None) -> str | None:
    """Why the values in the variables may not be used, or None."""
    if any(v.value is None or not np.isfinite(v.value).all() for v in problem.variables()):
        return "a variable has no finite value"
    worst = max((float(np.max(c.violation(), initial=0.0)) for c in problem.constraints), default=0.0)
    if not worst <= TOLERANCE:
        return f"a constraint is violated by {worst:.1e}"
    return None if accept is None or accept() else "the result does not pass the caller's verification"


def _forget(problem: cp.Problem) -> None:
    """A failed solve leaves the values of the one before in place."""
    for variable in problem.variables():
        variable.value = None
