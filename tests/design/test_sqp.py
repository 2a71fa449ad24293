"""Sequential quadratic programming against published optima and SciPy's solver."""

import numpy as np
import pytest
import scipy

from haptic_loop.design.sqp import minimise, quadratic


@pytest.mark.parametrize("seed", range(20))
def test_a_quadratic_program_satisfies_its_optimality_conditions(seed):
    rng = np.random.default_rng(seed)
    n, k = rng.integers(2, 9), rng.integers(1, 30)
    root, g = rng.normal(size=(n, n)), 3 * rng.normal(size=n)
    H, rows = root @ root.T + 0.01 * np.eye(n), rng.normal(size=(k, n))
    least = rows @ rng.normal(size=n) - rng.uniform(0, 1, size=k)  # has a point inside
    for active in ([], sorted(rng.permutation(k)[: n - 1].tolist())):
        found = quadratic(H, g, rows, least, active)
        assert found is not None
        d, u, _ = found
        slack = rows @ d - least
        size = max(np.abs(u).max(), 1.0) * np.linalg.cond(H)
        assert slack.min() >= -1e-12 * size
        assert u.min() >= 0
        assert np.abs(H @ d + g - u @ rows).max() <= 1e-12 * size  # rounding times the condition number
        assert np.abs(u * slack).max() <= 1e-12 * size


def _hock_schittkowski_71(x):
    return x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2]


def _differences(f, x):
    return np.array([(f(x + h) - f(x - h)) / 2e-6 for h in 1e-6 * np.eye(x.size)])


def test_a_published_problem_has_its_published_optimum():
    # W. Hock and K. Schittkowski, Test Examples for Nonlinear Programming Codes (1981), problem 71; the equality as two
    # inequalities. The start violates it.
    def room(x):
        return np.array([np.prod(x) - 25, x @ x - 40, 40 - x @ x])

    found = minimise(
        _hock_schittkowski_71,
        lambda x: _differences(_hock_schittkowski_71, x),
        room,
        lambda x: _differences(room, x).T,
        np.array([1.0, 5.0, 5.0, 1.0]),
        (np.ones(4), np.full(4, 5.0)),
        100,
        1e-10,
    )
    np.testing.assert_allclose(found.x, [1.0, 4.742999, 3.821150, 1.379408], atol=1e-6)
    assert abs(_hock_schittkowski_71(found.x) - 17.0140173) < 1e-6


@pytest.mark.parametrize("start", [(-1.2, 1.0), (2.0, 2.0), (0.5, -1.0)])
def test_a_curved_valley_ends_where_scipy_ends(start):
    def objective(x):
        return 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2

    def room(x):
        return np.array([1.5 - x @ x, x[0] + x[1] - 0.2])

    slope, room_slope = (lambda x: _differences(objective, x)), (lambda x: _differences(room, x).T)
    bounds = (np.full(2, -5.0), np.full(2, 5.0))
    found = minimise(objective, slope, room, room_slope, np.array(start), bounds, 200, 1e-12)
    condition = {"type": "ineq", "fun": room, "jac": room_slope}
    expected = scipy.optimize.minimize(
        objective, start, jac=slope, method="SLSQP", constraints=condition, options={"ftol": 1e-14, "maxiter": 500}
    )
    np.testing.assert_allclose(found.x, expected.x, atol=1e-5)


def test_inequalities_without_common_point_have_no_optimum():
    rows = np.array([[1.0, 1.0], [-1.0, -1.0]])
    assert quadratic(np.eye(2), np.zeros(2), rows, np.array([1.0, 0.0]), []) is None
