"""Minimise c'x under linear matrix inequalities: each block constant + sum_a x_a slope_a is positive semidefinite.

The status "solved" of a solver is not enough. A result is used only if it is also finite, if its blocks are
semidefinite to rounding when they are evaluated again, and if the caller's `accept` returns True for it. Otherwise the
next of the solver settings is tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from haptic_loop.controller.arithmetic import compiled
from haptic_loop.controller.lti import Array, Complex
from haptic_loop.design import budgets
from haptic_loop.design.frequency import hermitian
from haptic_loop.design.result import DesignFailed, Infeasible

#: Largest violation that counts as rounding. Problems are scaled so that a violation of 1 would be large.
_TOLERANCE = 1e-4
#: Clarabel is slower than `_interior` if the triangle of a block has more than _LARGE entries, and more than _MANY
#: entries for each unknown.
_LARGE, _MANY = 300, 4


#: The blocks are dense. Without this option Clarabel spends a third of its time on a chordal decomposition.
_DENSE = {"chordal_decomposition_enable": False}
_TIGHT = {**_DENSE, "tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
_LOOSE = {**_DENSE, "tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-6}

#: Settings of Clarabel, by name: the options that differ from its defaults.
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    "default": _DENSE,
    "tight": {**_TIGHT, "max_step_fraction": 0.95},
    "as given": {**_DENSE, "equilibrate_enable": False},
    "loose": {**_LOOSE, "static_regularization_constant": 1e-7},
}
INTERIOR = "interior"  # the setting that solves the problem by `_interior`, for large blocks with few unknowns


@dataclass(frozen=True)
class _Attempt:
    settings: str
    status: str
    reason: str | None  # reason why the result may not be used, or None


@dataclass(frozen=True, eq=False)
class Inequality:
    """The inequalities constant + sum_a x[unknowns[a]] slopes[a] >= 0 for k Hermitian matrices."""

    constant: Array | Complex  # (k, n, n)
    slopes: Array | Complex  # (q, k, n, n)
    unknowns: Sequence[int]  # (q,) indices of the problem's unknowns in this block

    @classmethod
    def of(cls, function: Callable[[Array], Array], unknowns: Sequence[int]) -> Inequality:
        """Return function(x[unknowns]) >= 0 for an affine function with values (n, n) or (k, n, n)."""
        constant, *values = (function(x) for x in np.eye(len(unknowns) + 1, len(unknowns), k=-1))
        slopes = np.stack(values) - constant
        one = constant.ndim == 2
        return cls(constant[None] if one else constant, slopes[:, None] if one else slopes, unknowns)

    @classmethod
    def least(cls, unknowns: Sequence[int], value: float) -> Inequality:
        """Return x >= value for each of the unknowns."""
        return cls(np.full((len(unknowns), 1, 1), -value), np.eye(len(unknowns))[:, :, None, None], unknowns)

    @classmethod
    def most(cls, unknowns: Sequence[int], value: float) -> Inequality:
        """Return x <= value for each of the unknowns."""
        return cls(np.full((len(unknowns), 1, 1), value), -np.eye(len(unknowns))[:, :, None, None], unknowns)

    def at(self, x: Array) -> Array | Complex:
        return self.constant + np.tensordot(x[list(self.unknowns)], self.slopes, axes=1)

    @property
    def large(self) -> bool:
        """Whether Clarabel is slower than `_interior`. Its work grows with the square of the triangle's entries."""
        rows = self.constant.shape[-1] * (2 if np.iscomplexobj(self.constant) else 1)
        return rows * (rows + 1) // 2 > max(_LARGE, _MANY * len(self.unknowns))

    def rows(self) -> tuple[Array, Array]:
        """Return constant (k, r) and slopes (q, k, r) as real lower triangles with the same inner products."""
        constant, slopes = (_real(part) for part in (self.constant, self.slopes))
        i, j = np.tril_indices(constant.shape[-1])
        weight = np.where(i == j, 1.0, np.sqrt(2))
        return constant[..., i, j] * weight, slopes[..., i, j] * weight


def _real(H: Array | Complex) -> Array:
    """Return [[X, -Y], [Y, X]] of H = X + jY, (..., n, n) -> (..., 2n, 2n), which is >= 0 if and only if H is."""
    if not np.iscomplexobj(H):
        return np.asarray(H, dtype=float)
    top, low = np.concatenate([H.real, -H.imag], axis=-1), np.concatenate([H.imag, H.real], axis=-1)
    return np.concatenate([top, low], axis=-2)


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """The problem to minimise cost'x subject to the blocks."""

    cost: Array  # (p,)
    blocks: Sequence[Inequality]

    def solve(
        self, problem: str, accept: Callable[[Array], bool] = lambda x: True, settings: Iterable[str] = ()
    ) -> Array:
        """Return the optimal x (p,), verified.

        Args:
            problem: The name of the problem in error messages.
            accept: A further verification of x.
            settings: Names of settings in the order in which they are tried. The default is INTERIOR for a problem with
                a large block, and SETTINGS for all others.

        Raises:
            Infeasible: Two settings report that there is no solution.
            DesignFailed: No setting gives a result that can be verified.
        """
        attempts, infeasible = list[_Attempt](), False
        for name in settings or ((INTERIOR,) if any(block.large for block in self.blocks) else SETTINGS):
            x, attempt = self._attempt(name, accept)
            if attempt.reason is None:
                return x
            attempts.append(attempt)
            infeasible = sum(each.status == "PrimalInfeasible" for each in attempts) >= 2
            if infeasible:
                break
        statuses = ", ".join(f"{each.settings}: {each.status}" for each in attempts)
        if infeasible:
            raise Infeasible(self, attempts, f"{problem} has no solution ({statuses})")
        advice = "try shorter delays, a larger damping or a lower order; the error's `problem` is the convex problem"
        raise DesignFailed(self, attempts, f"{problem} could not be solved ({statuses}); {advice}")

    def violation(self, x: Array) -> float:
        """Return minus the least eigenvalue of all blocks. If the result is positive, x violates an inequality."""
        least = (np.linalg.eigvalsh(block.at(x)).min(initial=np.inf) for block in self.blocks)
        return float(-min(least, default=np.inf))

    def _attempt(self, settings: str, accept: Callable[[Array], bool]) -> tuple[Array, _Attempt]:
        reason = None
        try:
            x, status = _interior(self) if settings == INTERIOR else _clarabel(self, SETTINGS[settings])
        except BaseException as error:  # Clarabel's Rust panics are not Exceptions
            if type(error).__name__ != "PanicException":
                raise
            return np.full(len(self.cost), np.nan), _Attempt(settings, "panic", str(error))
        if status not in ("Solved", "AlmostSolved"):
            reason = f"the solver reports {status}"
        elif not np.isfinite(x).all():
            reason = "an unknown has no finite value"
        elif not (worst := self.violation(x)) <= _TOLERANCE:
            reason = f"a constraint is violated by {worst:.1e}"
        elif not accept(x):
            reason = "the result does not pass the caller's verification"
        return x, _Attempt(settings, status, reason)


def _clarabel(problem: ConeProgram, options: Mapping[str, Any]) -> tuple[Array, str]:
    """Solve the problem by Clarabel; return x and Clarabel's status."""
    import clarabel

    for name in ("cython_blas", "cython_lapack"):  # Clarabel calls functions of these modules.
        compiled(f"scipy.linalg.{name}")
    constants, entries, cones, p, height = [], [], [], len(problem.cost), 0
    for block in problem.blocks:
        constant, by_x = block.rows()
        constants.append(constant.ravel())
        by_x = by_x.reshape(len(by_x), -1)
        a, row = np.nonzero(by_x)
        entries.append((np.asarray(block.unknowns)[a], height + row, -by_x[a, row]))
        height += constant.size
        size = round((np.sqrt(8 * constant.shape[1] + 1) - 1) / 2)
        if size == 1:
            cones.append(clarabel.NonnegativeConeT(len(constant)))
        else:
            cones += [clarabel.PSDTriangleConeT(size)] * len(constant)
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    for name, value in options.items():
        setattr(settings, name, value)
    column, row, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    order = np.lexsort((row, column))
    starts = np.searchsorted(column[order], np.arange(p + 1))
    rows = _columns((height, p), starts, row[order], value[order])
    nothing = _columns((p, p), 0 * starts, row[:0], value[:0])
    solution = clarabel.DefaultSolver(nothing, problem.cost, rows, np.concatenate(constants), cones, settings).solve()
    return np.array(solution.x), str(solution.status)


def _columns(shape: tuple[int, int], starts: Any, rows: Any, values: Array) -> Any:
    """Return a sparse matrix by columns, with the attributes of scipy.sparse.csc_matrix that Clarabel reads.

    The import of scipy.sparse would take 0.1 s.
    """
    return SimpleNamespace(shape=shape, indptr=starts, indices=rows, data=values, has_canonical_format=True)


# ----------------------------------------------------------------------------------------------------
# A primal-dual interior-point method for large blocks in few unknowns.
#
# The slacks S = constant + slopes x >= 0 have multipliers Z >= 0 with <slope_a, Z> = cost_a. At the optimum S Z = 0.
# The equation S Z = mu I is linearised to dZ = mu S^-1 - Z - Z dS S^-1, made Hermitian (Helmberg, Kojima, Monteiro).
# Then <slope_a, Z + dZ> = cost_a is one equation for each unknown. A first step with mu = 0 determines the next mu and
# the second-order term dZ dS (Mehrotra). The start may be infeasible.

_GAP = 1e-8  # The iteration ends if the relative gap and the violation are below this.
_ENOUGH = 1e-6  # The best point counts as solved below this error. An error above the least/_ENOUGH ends the iteration.
_KEPT = 0.98  # length of a step, relative to the distance to the boundary
_SHORT, _CENTRING = 0.2, 0.8  # A step shorter than _SHORT is replaced by a step towards S Z = _CENTRING mu I.


_Parts = list[Any]  # for each block a stack of Hermitian matrices (k, n, n)


def _stacked(problem: ConeProgram) -> ConeProgram:
    """Return the problem with one block for all 1 x 1 matrices, and one for each further size and set of unknowns."""
    stacks: dict[tuple[int, tuple[int, ...]], list[Inequality]] = {}
    for block in problem.blocks:
        unknowns, by = tuple(block.unknowns), block.slopes
        if (n := block.constant.shape[-1]) == 1:
            unknowns, by = tuple(range(len(problem.cost))), np.zeros((len(problem.cost), *block.constant.shape))
            by[list(block.unknowns)] = block.slopes
        stacks.setdefault((n, unknowns), []).append(Inequality(block.constant, by, unknowns))
    blocks = list[Inequality]()
    for (_, unknowns), alike in stacks.items():
        constant: Any = np.concatenate([block.constant for block in alike])
        slopes: Any = np.concatenate([block.slopes for block in alike], axis=1)
        blocks.append(Inequality(constant, slopes, unknowns))
    return ConeProgram(problem.cost, blocks)


def _interior(problem: ConeProgram) -> tuple[Array, str]:
    """Solve the problem by a primal-dual method; return x and one of Clarabel's status names."""
    problem = _stacked(problem)
    blocks, cost = problem.blocks, problem.cost
    x: Array = np.zeros(len(cost))
    parts = [cost, *(part for block in blocks for part in (block.constant, block.slopes))]
    size: float = max(np.abs(part).max(initial=1.0) for part in parts)
    S: _Parts = [10 * size * (np.zeros_like(block.constant) + np.eye(block.constant.shape[-1])) for block in blocks]
    Z: _Parts = S
    best = x
    error: float
    least: float = np.inf
    for _ in range(budgets.CONE_STEPS):
        primal: _Parts = [block.at(x) - s for block, s in zip(blocks, S, strict=True)]  # residuals
        dual = cost - _inner(problem, Z)
        gap = abs(float(cost @ x) + sum(_product(block.constant, z) for block, z in zip(blocks, Z, strict=True)))
        far = max(np.abs(part).max() / size for part in (dual, *primal))
        if (error := max(far, gap / (1 + abs(float(cost @ x))))) < least:
            best, least = x, error
        if not _GAP < error < least / _ENOUGH:
            break
        try:
            newton = _Newton(problem, S, Z, primal, dual)
        except np.linalg.LinAlgError:  # The equations are singular to rounding.
            break
        mu: float = sum(map(_product, S, Z)) / sum(s.shape[0] * s.shape[1] for s in S)
        _, dS, dZ, of_S, of_Z = newton.direction(0.0, [0.0] * len(S))
        gains = map(_product, _moved(S, of_S, dS), _moved(Z, of_Z, dZ))
        left = min(1.0, max(0.0, sum(gains) / sum(map(_product, S, Z))))
        dx, dS, dZ, of_S, of_Z = newton.direction(left**3 * mu, [dz @ ds for dz, ds in zip(dZ, dS, strict=True)])
        if min(of_S, of_Z) < _SHORT:  # The point is too near the boundary, so the step goes towards the central path.
            dx, dS, dZ, of_S, of_Z = newton.direction(_CENTRING * mu, [0.0] * len(S))
        x = x + of_S * dx
        S, Z = _moved(S, of_S, dS), _moved(Z, of_Z, dZ)
    return best, "Solved" if least < _ENOUGH else "NumericalError"


def _moved(parts: _Parts, step: float, change: _Parts) -> _Parts:
    return [hermitian(part + step * by) for part, by in zip(parts, change, strict=True)]


class _Newton:
    """The linearised equations at (S, Z). Raises LinAlgError if they are singular to rounding.

    `primal` and `dual` are the residuals constant + slopes x - S and cost - <slopes, Z>.
    """

    def __init__(self, problem: ConeProgram, S: _Parts, Z: _Parts, primal: _Parts, dual: Array) -> None:
        self._problem, self._Z, self._primal, self._dual = problem, Z, primal, dual
        self._roots = [[np.linalg.inv(np.linalg.cholesky(part)) for part in parts] for parts in (S, Z)]
        self._inverse = [_adjoint(root) @ root for root in self._roots[0]]
        normal = np.zeros((dual.size, dual.size))
        for block, z, inverse in zip(problem.blocks, Z, self._inverse, strict=True):
            slopes = block.slopes.reshape(len(block.slopes), -1)
            turned = (z @ block.slopes @ inverse).reshape(slopes.shape)
            normal[np.ix_(block.unknowns, block.unknowns)] += np.real(slopes.conj() @ turned.T)
        self._scale = 1 / np.sqrt(np.where(np.diag(normal) > 0, np.diag(normal), 1.0))
        unit = self._scale[:, None] * (normal + normal.T) / 2 * self._scale
        self._lapack = compiled("scipy.linalg._flapack")  # The import of scipy.linalg takes 0.1 s.
        self._factor, fault = self._lapack.dpotrf(unit + 1e-14 * np.eye(dual.size), clean=False)
        if fault:
            raise np.linalg.LinAlgError("the equations of a step are singular to rounding")

    def direction(self, mu: float, left: _Parts) -> tuple[Array, _Parts, _Parts, float, float]:
        """Return (dx, dS, dZ, longest step in S, longest step in Z) towards S Z = mu I. `left` is the term dZ dS."""
        right = _inner(self._problem, self._change(self._primal, mu, left)) - self._dual
        dx = self._scale * self._lapack.dpotrs(self._factor, self._scale * right)[0]
        blocks = zip(self._problem.blocks, self._primal, strict=True)
        dS = [residual + np.tensordot(dx[list(block.unknowns)], block.slopes, axes=1) for block, residual in blocks]
        dZ = self._change(dS, mu, left)
        return dx, dS, dZ, _longest(self._roots[0], dS), _longest(self._roots[1], dZ)

    def _change(self, dS: _Parts, mu: float, left: _Parts) -> _Parts:
        """Return dZ for dS from the linearised equation S Z = mu I with the second-order term `left`."""
        parts = zip(self._Z, dS, left, self._inverse, strict=True)
        return [hermitian(mu * inverse - z - (z @ ds + more) @ inverse) for z, ds, more, inverse in parts]


def _inner(problem: ConeProgram, Z: _Parts) -> Array:
    """Return <slope_a, Z> for every unknown a."""
    total = np.zeros(len(problem.cost))
    for block, z in zip(problem.blocks, Z, strict=True):
        total[list(block.unknowns)] += np.real(block.slopes.reshape(len(block.slopes), -1).conj() @ z.ravel())
    return total


def _longest(roots: _Parts, steps: _Parts) -> float:
    """Return the length of a step, at most 1: _KEPT times the distance to the boundary.

    `roots` are the inverse Cholesky factors of the matrices at the start of the step.
    """
    pairs = zip(roots, steps, strict=True)
    least = min(np.linalg.eigvalsh(root @ step @ _adjoint(root)).min() for root, step in pairs)
    return min(1.0, _KEPT / max(-least, 1e-300))


def _adjoint(X: Any) -> Any:
    return np.conj(np.swapaxes(X, -1, -2))


def _product(X: Any, Y: Any) -> float:
    return float(np.real(np.vdot(X, Y)))
