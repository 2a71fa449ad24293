"""The least multiplier Phi of Theorem 4 for an environment with delay inside (psi >= 1), by (17)."""

from __future__ import annotations

from typing import cast

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.condition.delayed import uncovered
from design.failure import DesignFailed, Infeasible
from design.lmi import Ports, e_hat_regular, lemma1
from design.semidefinite.coordinates import balanced, unit_environment
from design.solve import solve, solved
from design.specification import Specification

#: Phi is enlarged by this, relatively, so that a sweep confirms what a solver found to its own tolerance.
ROOM = 1e-6


def shortage(spec: Specification) -> Array | None:
    """`least_multiplier`, verified on a refined sweep; None where psi = 0, since a passive environment needs none."""
    if not any(spec.psi):
        return None
    phi = least_multiplier(spec) + ROOM * np.asarray(spec.delta)
    short = uncovered(spec.environment, spec.psi, np.diag(phi))
    if short > 0:
        raise DesignFailed(None, (), f"the multiplier Phi = {phi.tolist()} leaves {short:.2e} N s/m uncovered")
    return phi


def least_multiplier(spec: Specification) -> Array:
    """Diagonal Phi of least trace [N s/m], shape (N,), with E-hat + Phi passive and Phi < Delta_D.

    Raises Infeasible, with the damping that would be needed, where even a full Phi is not below Delta_D.
    """
    regular = balanced(e_hat_regular(unit_environment(spec.environment, spec.delta), spec.psi))
    N = spec.channels
    full, s = cp.Variable((N, N), symmetric=True), cp.Variable()
    _minimise(s, full, regular, [full << s * np.eye(N)])
    least = float(solved(s))
    if least >= 1:
        raise Infeasible(None, (), _needs(spec, least))
    phi = cp.Variable(N)
    _minimise(s, cp.diag(phi), regular, [phi <= s])
    least = float(solved(s))
    if least >= 1:
        raise Infeasible(None, (), _needs(spec, least))
    # halfway between the least largest entry and Delta_D: least trace alone may touch Delta_D
    _minimise(cast(cp.Expression, cp.sum(phi)), cp.diag(phi), regular, [phi <= (1 + least) / 2])
    return np.maximum(solved(phi), 0.0) * np.asarray(spec.delta)


def _minimise(objective: cp.Expression, Phi: cp.Expression, regular, constraints: list[cp.Constraint]) -> None:
    P = cp.Variable((regular.order,) * 2, symmetric=True)
    passive = lemma1(Ports.same(regular), P, np.zeros(Phi.shape), -Phi)
    problem = cp.Problem(cp.Minimize(objective), [passive >> 0, P >> 0, *constraints])
    solve(problem, "the multiplier Phi of the environment")


def _needs(spec: Specification, least: float) -> str:
    required = ", ".join(f"{least * d:.4g}" for d in spec.delta)
    return (
        f"Theorem 4 admits no coupling: with psi = {spec.psi} the environment alone uses up {required} N s/m of device "
        f"damping and delta is {spec.delta}; use less psi, a softer environment or more device damping"
    )
