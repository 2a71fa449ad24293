"""Cone programs handed to Clarabel as matrices: modelling hundreds of inequalities takes longer than solving them.

As in design.solve, a status is a claim: the answer is used only if it is finite and every inequality holds when it is
evaluated again; otherwise the next settings are tried.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from controller.lti import Array
from design.failure import Attempt, DesignFailed, Infeasible
from design.parameter.cone_program import Block, ConeProgram

#: Largest violation taken for rounding; programs are posed in units where 1 is large.
TOLERANCE = 1e-6

LADDER: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "as given": {"equilibrate_enable": False},
    "loose": {"tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-7, "static_regularization_constant": 1e-7},
}
SOLVED = ("Solved", "AlmostSolved", "InsufficientProgress")
NO_SOLUTION = ("PrimalInfeasible", "AlmostPrimalInfeasible")


def solve_cones(program: ConeProgram, what: str) -> tuple[Array, Array]:
    """(a verified minimiser x, the multipliers). `what` names the program in the message of an error.

    The multipliers are those of the equalities, then of the rows of each block, frequency by frequency: what x gains
    when these move, so they only matter to someone who wants to move them, and are not verified.

    Raises Infeasible when the solver proves that there is none, DesignFailed otherwise.
    """
    P, q, A, b, cones = _standard_form(program)
    attempts: list[Attempt] = []
    for name, options in LADDER.items():
        started = time.perf_counter()
        solution: Any = clarabel.DefaultSolver(P, q, A, b, cones, _settings(options)).solve()
        status, x = str(solution.status), np.array(solution.x)
        reason = _doubt(program, status, x)
        value = None if reason else program.objective(x)
        attempts.append(Attempt(name, status, value, time.perf_counter() - started, reason))
        if reason is None:
            return x, np.array(solution.z)
        if status in NO_SOLUTION:
            raise Infeasible(program, attempts, f"{what} has no solution ({name}: {status})")
    statuses = ", ".join(f"{a.settings}: {a.status}" for a in attempts)
    fewer = f"ask for fewer functions or a diagonal Q: {program.A.shape[1]} unknowns"
    raise DesignFailed(program, attempts, f"{what} could not be solved ({statuses}); {fewer} are too many here")


def _doubt(program: ConeProgram, status: str, x: Array) -> str | None:
    if status not in SOLVED:
        return f"the solver reports {status}"
    if not np.isfinite(x).all():
        return "a variable has no finite value"
    worst = program.violation(x)
    return None if worst <= TOLERANCE else f"a constraint is violated by {worst:.1e}"


def _settings(options: Mapping[str, Any]) -> clarabel.DefaultSettings:
    settings = clarabel.DefaultSettings()
    for name, value in {"verbose": False, **options}.items():
        setattr(settings, name, value)
    return settings


def _standard_form(program: ConeProgram) -> tuple[sparse.csc_matrix, Array, sparse.csc_matrix, Array, list]:
    """P, q, A, b and cones of: minimise x'Px/2 + q'x with b - A x in the cones."""
    rows, offsets, cones = [program.E], [program.e], []
    if program.e.size:
        cones.append(clarabel.ZeroConeT(program.e.size))
    for block in program.blocks:
        constant, slope = block.rows()
        k, d, n = slope.shape
        rows.append(-slope.reshape(k * d, n))
        offsets.append(constant.ravel())
        cones.extend(_cones(block, k, d))
    P = sparse.csc_matrix(np.triu(program.A.T @ program.A))
    return P, program.c - program.A.T @ program.b, sparse.csc_matrix(np.vstack(rows)), np.concatenate(offsets), cones


def _cones(block: Block, k: int, d: int) -> Sequence[Any]:
    if block.size == 1:
        return [clarabel.NonnegativeConeT(k)]
    if block.size == 2:
        return [clarabel.SecondOrderConeT(d)] * k
    return [clarabel.PSDTriangleConeT(2 * block.size)] * k
