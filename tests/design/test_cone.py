"""Tests of design/cone.py: its solvers find known optima, agree with cvxpy, and have their answers checked."""

import subprocess
import sys

import clarabel
import cvxpy as cp
import numpy as np
import pytest
from analysis import solve
from scipy.sparse import csc_matrix

from haptic_loop.design import cone
from haptic_loop.design.cone import INTERIOR, SETTINGS, ConeProgram, Inequality
from haptic_loop.design.lmi import symmetric_from
from haptic_loop.design.result import DesignFailed, Infeasible

#: The least trace of an X >= M is the trace of M.
M = np.array([[2.0, 1.0], [1.0, 2.0]])
LEAST_TRACE = ConeProgram(np.array([1.0, 0.0, 1.0]), [Inequality.of(lambda v: symmetric_from(v, 2) - M, range(3))])


def hermitian(rng, *shape):
    H = rng.normal(size=(*shape, shape[-1])) + 1j * rng.normal(size=(*shape, shape[-1]))
    return (H + np.conj(np.swapaxes(H, -1, -2))) / 2


def with_known_optimum(rng, p, shapes):
    """Return a problem of p unknowns and its optimum x. Shapes are (number of matrices, their size, whether complex).

    Each block's matrices S(x) and multipliers Z have complementary ranges, and cost_a = <slope_a, Z>. Slopes add up to
    I and every x_a is bounded, so that the primal and the dual set have an interior.
    """
    x, cost, blocks = rng.normal(size=p), np.zeros(p), []
    for count, n, complex_ in shapes:
        taking = np.sort(rng.choice(p, max(1, 2 * p // 3), replace=False))
        slopes = hermitian(rng, taking.size, count, n)
        slopes = slopes if complex_ else slopes.real
        slopes[0] += np.eye(n) - slopes.sum(axis=0)
        basis = np.linalg.qr(hermitian(rng, count, n) if complex_ else hermitian(rng, count, n).real)[0]
        of_S = np.arange(n) < rng.integers(0, n, (count, 1))
        sizes = rng.uniform(0.5, 2, (count, n))
        S, Z = ((basis * (sizes * part)[:, None]) @ np.conj(np.swapaxes(basis, 1, 2)) for part in (of_S, ~of_S))
        cost[taking] += np.einsum("akij,kji->a", slopes, Z).real
        blocks.append(Inequality(S - np.tensordot(x[taking], slopes, axes=1), slopes, taking.tolist()))
    blocks.append(Inequality.of(lambda v: np.diag([*(9 - v), *(9 + v)]), range(p)))
    return ConeProgram(cost, blocks), x


def test_stacks_hold_every_matrix_of_a_problem():
    rng = np.random.default_rng(5)
    problem, x = with_known_optimum(rng, 7, [(3, 4, True), (4, 1, False), (2, 2, True), (2, 1, False)])
    problem = ConeProgram(problem.cost, [*problem.blocks, problem.blocks[0]])
    stacks = cone._stacked(problem)
    assert len(stacks.blocks) == 4  # one stack for each size of matrices: 4, 1, 2 and 14
    values = [
        np.sort(np.concatenate([np.linalg.eigvalsh(b.at(x)).ravel() for b in p.blocks])) for p in (problem, stacks)
    ]
    np.testing.assert_allclose(*values, rtol=0, atol=1e-13)  # rounding of sums of seven terms of size ten


@pytest.mark.parametrize("settings", [SETTINGS, (INTERIOR,)], ids=["Clarabel", "interior"])
@pytest.mark.parametrize("seed", range(2))
def test_a_known_optimum_is_found(seed, settings):
    """Complementary S(x) and Z, with Z in the dual's set, prove x optimal; cvxpy finds the same value."""
    rng = np.random.default_rng(seed)
    problem, x = with_known_optimum(rng, 7, [(3, 4, True), (1, 5, False), (4, 1, False), (2, 2, True)])
    optimum = problem.solve("it", settings=settings)
    assert problem.cost @ optimum == pytest.approx(problem.cost @ x, rel=1e-6, abs=1e-6)
    assert problem.violation(optimum) < 1e-7
    v = cp.Variable(7)
    constraints = []
    for block in problem.blocks:
        for k, constant in enumerate(block.constant):
            matrix = constant + sum(v[a] * slope[k] for a, slope in zip(block.unknowns, block.slopes, strict=True))
            constraints.append((matrix if len(constant) == 1 else (matrix + matrix.H) / 2) >> 0)
    other = solve(cp.Problem(cp.Minimize(problem.cost @ v), constraints))
    assert problem.cost @ optimum == pytest.approx(other, rel=1e-5, abs=1e-5)


def test_a_large_block_is_solved_without_clarabel(monkeypatch):
    """60 complex rows have 7260 real entries in their triangle; Clarabel's equations have the square of that."""
    calls = answering(monkeypatch)
    problem, x = with_known_optimum(np.random.default_rng(0), 5, [(1, 60, True)])
    assert problem.cost @ problem.solve("it") == pytest.approx(problem.cost @ x, rel=1e-6)
    assert not calls


def answering(monkeypatch, *answers):
    """Replace Clarabel's first answers by errors or by functions of (x, status); return the list of calls."""
    original, calls = cone._clarabel, []

    def wrapped(problem, options):
        calls.append(options)
        if len(calls) > len(answers):
            return original(problem, options)
        answer = answers[len(calls) - 1]
        if isinstance(answer, BaseException):
            raise answer
        return answer(*original(problem, options))

    monkeypatch.setattr(cone, "_clarabel", wrapped)
    return calls


class PanicException(BaseException):
    """A stand-in for the exception that pyo3 raises when Rust panics."""


def test_an_easy_problem_takes_one_setting(monkeypatch):
    calls = answering(monkeypatch)
    assert LEAST_TRACE.solve("it") == pytest.approx([2.0, 1.0, 2.0], abs=1e-6)
    assert len(calls) == 1


WRONG = {
    "panic": PanicException("index out of bounds"),
    "status": lambda x, status: (x, "NumericalError"),
    "values": lambda x, status: (x * np.nan, status),
    "lie": lambda x, status: (x - 1.0, status),
}


@pytest.mark.parametrize("answer", WRONG.values(), ids=WRONG)
def test_a_broken_setting_is_skipped(answer, monkeypatch):
    calls = answering(monkeypatch, answer, answer)
    assert LEAST_TRACE.solve("it") == pytest.approx([2.0, 1.0, 2.0], abs=1e-6)
    assert len({tuple(sorted(options)) for options in calls}) == 3


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(), TypeError("a bug of ours")])
def test_interrupts_and_bugs_pass_through(error, monkeypatch):
    answering(monkeypatch, error)
    with pytest.raises(type(error)):
        LEAST_TRACE.solve("it")


def test_a_failure_carries_problem_and_attempts(monkeypatch):
    answering(monkeypatch, *[WRONG["lie"]] * len(SETTINGS))
    with pytest.raises(DesignFailed, match="the thing could not be solved") as caught:
        LEAST_TRACE.solve("the thing")
    assert caught.value.problem is LEAST_TRACE
    assert len(caught.value.results) == len(SETTINGS)
    assert "violated by" in caught.value.results[0].reason
    assert "\n" not in str(caught.value)


def bounds(*of):
    """Return the problem of the least x with f(x) >= 0 for every function f of `of`."""
    return ConeProgram(np.array([1.0]), [Inequality.of(lambda v, f=f: np.array([[f(v[0])]]), [0]) for f in of])


def test_an_infeasible_problem_is_no_solver_failure():
    with pytest.raises(Infeasible, match="the request has no solution"):
        bounds(lambda x: x - 1, lambda x: -x).solve("the request")


def test_an_unbounded_problem_is_a_failure():
    with pytest.raises(DesignFailed, match="DualInfeasible"):
        bounds(lambda x: -x).solve("the request")


def test_a_refused_optimum_is_not_used():
    answers = iter([False, True])
    LEAST_TRACE.solve("it", accept=lambda x: next(answers))
    assert next(answers, None) is None
    with pytest.raises(DesignFailed, match="could not be solved"):
        LEAST_TRACE.solve("it", accept=lambda x: False)


def test_clarabel_reads_bare_columns_like_scipys_matrix():
    """Clarabel takes a csc_matrix of SciPy. With `cone._columns` instead it gives the same solution to the last bit."""
    rng = np.random.default_rng(2)
    A = np.where(rng.random((9, 4)) < 0.6, rng.normal(size=(9, 4)), 0.0)
    A[:, 2] = 0.0  # a column without entries
    real, (row, column) = csc_matrix(A), np.nonzero(A)
    order = np.lexsort((row, column))
    starts = np.searchsorted(column[order], np.arange(5))
    light = cone._columns(A.shape, starts, row[order], A[row, column][order])
    for name in ("indptr", "indices", "data"):
        assert getattr(light, name).tolist() == getattr(real, name).tolist()
    solutions = []
    for matrix in (real, light):
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        cones, nothing = [clarabel.NonnegativeConeT(9)], csc_matrix(np.eye(4))
        solver = clarabel.DefaultSolver(nothing, np.ones(4), matrix, np.ones(9), cones, settings)
        solutions.append(np.array(solver.solve().x).tolist())
    assert solutions[0] == solutions[1]


@pytest.mark.slow
def test_a_design_loads_no_modelling_language(tmp_path):
    """A proved design and the imports of runs and other designs load neither cvxpy nor these SciPy modules."""
    words = ["--condition", "any-environment", "--out", str(tmp_path / "coupling.json")]
    code = f"""if True:
        import sys, cli.design, sim.run, design.coverage, design.fixed_order
        cli.design.main({words})
        sys.exit(bool({{"cvxpy", "scipy.linalg", "scipy.sparse", "scipy.optimize"}} & set(sys.modules)))
    """
    assert subprocess.run([sys.executable, "-c", code], check=False, stdout=subprocess.DEVNULL).returncode == 0
