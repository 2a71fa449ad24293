"""The solver is never believed: what it breaks, what it leaves behind, and what the caller is told."""

import subprocess
import sys
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

from design import lmi as module
from design.lmi import CROSS_CHECK, LADDER, solve
from design.result import DesignFailed, Infeasible


@pytest.fixture
def problem():
    x = cp.Variable((2, 2), symmetric=True)
    return cp.Problem(cp.Minimize(cp.trace(x)), [x >> np.array([[2.0, 1.0], [1.0, 2.0]])])


def failing(error, times, monkeypatch):
    """Let the first `times` calls of Problem.solve raise `error`."""
    original, calls = cp.Problem.solve, []

    def wrapped(self, **options):
        calls.append(options)
        if len(calls) <= times:
            raise error
        return original(self, **options)

    monkeypatch.setattr(cp.Problem, "solve", wrapped)
    return calls


class PanicException(BaseException):
    """What pyo3 raises when Rust panics."""


def test_the_first_rung_is_enough_for_an_easy_problem(problem):
    (attempt,) = solve(problem, "it")
    assert attempt.value == pytest.approx(4.0, abs=1e-6)
    assert attempt.reason is None


def test_two_solvers_agree(problem):
    clarabel = solve(problem, "it")[-1].value
    assert solve(problem, "it", ladder=(CROSS_CHECK,))[-1].value == pytest.approx(clarabel, abs=1e-5)


@pytest.mark.parametrize("error", [PanicException("index out of bounds"), cp.SolverError("numerical")])
def test_a_broken_rung_is_skipped(problem, monkeypatch, error):
    failing(error, 2, monkeypatch)
    attempts = solve(problem, "it")
    assert [a.status for a in attempts][2] == "optimal"
    assert attempts[0].reason == str(error)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(), TypeError("a bug of ours")])
def test_what_is_not_the_solvers_fault_passes_through(problem, monkeypatch, error):
    failing(error, 1, monkeypatch)
    with pytest.raises(type(error)):
        solve(problem, "it")


def test_every_rung_starts_from_nothing(problem, monkeypatch):
    calls = failing(cp.SolverError("numerical"), len(LADDER) - 1, monkeypatch)
    solve(problem, "it")
    assert all(options["warm_start"] is False for options in calls)
    assert len({tuple(sorted(options)) for options in calls}) > 1


def test_values_of_the_solve_before_do_not_survive_a_failure(problem, monkeypatch):
    solve(problem, "it")
    failing(cp.SolverError("numerical"), 99, monkeypatch)
    with pytest.raises(DesignFailed, match="the thing could not be solved") as caught:
        solve(problem, "the thing")
    assert problem.variables()[0].value is None
    assert caught.value.problem is problem
    assert len(caught.value.results) == len(LADDER)
    assert "\n" not in str(caught.value)


def test_infeasible_is_told_apart():
    x = cp.Variable()
    with pytest.raises(Infeasible, match="the request has no solution"):
        solve(cp.Problem(cp.Minimize(x), [x >= 1, x <= 0]), "the request")


def test_unbounded_is_a_failure():
    x = cp.Variable()
    with pytest.raises(DesignFailed, match="unbounded"):
        solve(cp.Problem(cp.Minimize(x), [x <= 0]), "the request")


def test_an_optimum_that_the_caller_refuses_is_not_used(problem):
    answers = iter([False, True])
    attempts = solve(problem, "it", accept=lambda: next(answers))
    assert len(attempts) == 2
    with pytest.raises(DesignFailed, match="could not be solved"):
        solve(problem, "it", accept=lambda: False)


def test_a_status_that_lies_is_found_out(problem, monkeypatch):
    original = cp.Problem.solve

    def lying(self, **options):
        original(self, **options)
        for v in self.variables():
            v.value = v.value - 1.0

    monkeypatch.setattr(cp.Problem, "solve", lying)
    with pytest.raises(DesignFailed) as caught:
        solve(problem, "it")
    assert "violated by" in caught.value.results[0].reason


def test_nobody_else_calls_the_solver():
    root = Path(module.__file__).parent
    files = [
        path
        for world in ("models", "controller", "design", "sim", "hw", "cli")
        for path in root.parent.glob(f"{world}/**/*.py")
    ]
    assert len(files) > 50
    assert [path.name for path in files if ".solve(solver" in path.read_text()] == ["lmi.py"]


def test_the_judges_do_not_load_cvxpy():
    judges = "design.conditions, design.transparency, design.certificate, design.coverage"
    code = f"import sys, {judges}; print('cvxpy' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
