"""Linear matrix inequalities: minimise c'x where every block constant + sum_a x_a slope_a is positive semidefinite.

A solver's status is a claim. A result is used only if it is finite, the blocks are semidefinite when they are evaluated
again, and the caller's own `accept` agrees; otherwise the next settings of the ladder are tried. Settings change what
the solver does to the data, so one that breaks down seldom takes the others with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # its parts load when they are used

from controller.lti import Array, Complex
from design.result import DesignFailed, Infeasible

#: Largest negative eigenvalue that is taken for rounding; problems are posed in units where 1 is large.
_TOLERANCE = 1e-4


@dataclass(frozen=True)
class _Settings:
    """Options of Clarabel that differ from its own."""

    name: str
    options: Mapping[str, Any] = field(default_factory=dict)


_TIGHT = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
_LOOSE = {"tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-6}

LADDER = (
    _Settings("default"),
    _Settings("tight", {**_TIGHT, "max_step_fraction": 0.95}),
    _Settings("as given", {"equilibrate_enable": False, "chordal_decomposition_enable": False}),
    _Settings("loose", {**_LOOSE, "static_regularization_constant": 1e-7}),
)


@dataclass(frozen=True)
class Attempt:
    """What one rung of the ladder gave."""

    settings: str
    status: str
    value: float | None  # the objective, None where the attempt was refused
    wall_s: float
    reason: str | None = None  # why it was refused


@dataclass(frozen=True, eq=False)
class Block:
    """constant + sum_a x[unknowns[a]] slopes[a] >= 0, k Hermitian matrices."""

    constant: Array | Complex  # (k, n, n)
    slopes: Array | Complex  # (q, k, n, n)
    unknowns: Sequence[int]  # (q,) those of the problem that take part

    @classmethod
    def of(cls, function: Callable[[Array], Array], unknowns: Sequence[int]) -> Block:
        """function(x[unknowns]) >= 0, affine to a symmetric matrix, from its values at 0 and the unit vectors."""
        constant = function(np.zeros(len(unknowns)))
        return cls(constant[None], np.stack([function(e) - constant for e in np.eye(len(unknowns))])[:, None], unknowns)

    def at(self, x: Array) -> Array | Complex:
        return self.constant + np.tensordot(x[list(self.unknowns)], self.slopes, axes=1)

    def rows(self) -> tuple[Array, Array]:
        """(k, r) and (q, k, r) real: the lower triangles row by row, such that inner products stay the same."""
        constant, slopes = (_real(part) for part in (self.constant, self.slopes))
        i, j = np.tril_indices(constant.shape[-1])
        weight = np.where(i == j, 1.0, np.sqrt(2))
        return constant[..., i, j] * weight, slopes[..., i, j] * weight


def _real(H: Array | Complex) -> Array:
    """[[X, -Y], [Y, X]] of H = X + jY, (..., n, n) -> (..., 2n, 2n): Hermitian >= 0 iff symmetric >= 0."""
    if not np.iscomplexobj(H):
        return np.asarray(H, dtype=float)
    top, low = np.concatenate([H.real, -H.imag], axis=-1), np.concatenate([H.imag, H.real], axis=-1)
    return np.concatenate([top, low], axis=-2)


@dataclass(frozen=True, eq=False)
class Problem:
    """minimise cost'x under the blocks."""

    cost: Array  # (p,)
    blocks: Sequence[Block]

    def solve(
        self, what: str, accept: Callable[[Array], bool] | None = None, ladder: Sequence[_Settings] = LADDER
    ) -> Array:
        """The optimal x (p,), verified. `what` names the problem in the message of an error.

        Raises Infeasible when two settings agree that there is no solution and none found one, DesignFailed otherwise.
        """
        attempts: list[Attempt] = []
        for settings in ladder:
            x, attempt = self._attempt(settings, accept)
            if attempt.reason is None:
                return x
            attempts.append(attempt)
            if sum(a.status == "PrimalInfeasible" for a in attempts) >= 2:
                break
        statuses = ", ".join(f"{a.settings}: {a.status}" for a in attempts)
        if sum(a.status == "PrimalInfeasible" for a in attempts) >= 2:
            raise Infeasible(self, attempts, f"{what} has no solution ({statuses})")
        advice = "try fewer delays, a larger damping or a lower order; the error carries the problem"
        raise DesignFailed(self, attempts, f"{what} could not be solved ({statuses}); {advice}")

    def violation(self, x: Array) -> float:
        """How negative the least eigenvalue of a block is."""
        least = (np.linalg.eigvalsh(block.at(x)).min(initial=np.inf) for block in self.blocks)
        return float(-min(least, default=np.inf))

    def _attempt(self, settings: _Settings, accept: Callable[[Array], bool] | None) -> tuple[Array, Attempt]:
        started = time.perf_counter()
        x, status, reason = np.full(len(self.cost), np.nan), "panic", None
        try:
            x, status = _clarabel(self, settings.options)
        except BaseException as error:  # Clarabel's Rust panics are not Exceptions
            if type(error).__name__ != "PanicException":
                raise
            reason = str(error)
        reason = reason or self._doubt(x, status, accept)
        value = None if reason else float(self.cost @ x)
        return x, Attempt(settings.name, status, value, time.perf_counter() - started, reason)

    def _doubt(self, x: Array, status: str, accept: Callable[[Array], bool] | None) -> str | None:
        """Why x may not be used, or None."""
        if status not in ("Solved", "AlmostSolved"):
            return f"the solver reports {status}"
        if not np.isfinite(x).all():
            return "an unknown has no finite value"
        if not (worst := self.violation(x)) <= _TOLERANCE:
            return f"a constraint is violated by {worst:.1e}"
        return None if accept is None or accept(x) else "the result does not pass the caller's verification"


def _clarabel(problem: Problem, options: Mapping[str, Any]) -> tuple[Array, str]:
    """(x, the status that Clarabel reports): minimise cost'x with constant - s = -slopes x and every s in its cone."""
    import clarabel

    constants, slopes, cones = [], [], []
    for block in problem.blocks:
        constant, by_x = block.rows()
        constants.append(constant.ravel())
        every = scipy.sparse.coo_matrix(by_x.reshape(len(by_x), -1).T)
        columns = np.asarray(block.unknowns)[every.col]
        slopes.append(scipy.sparse.csc_matrix((every.data, (every.row, columns)), (constant.size, len(problem.cost))))
        size = round((np.sqrt(8 * constant.shape[1] + 1) - 1) / 2)
        if size == 1:
            cones.append(clarabel.NonnegativeConeT(len(constant)))
        else:
            cones += [clarabel.PSDTriangleConeT(size)] * len(constant)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name, value in options.items():
        setattr(settings, name, value)
    p = len(problem.cost)
    nothing, rows = scipy.sparse.csc_matrix((p, p)), scipy.sparse.vstack(slopes, format="csc")
    found = clarabel.DefaultSolver(nothing, problem.cost, -rows, np.concatenate(constants), cones, settings).solve()
    return np.array(found.x), str(found.status)
