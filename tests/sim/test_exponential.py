"""The batched matrix exponential against extended precision, closed forms, and itself in other company."""

import numpy as np
from scipy.linalg import expm

from sim.engines import expm_each


def longer(matrix):
    """exp by a Taylor series in extended precision: exp(A) - 1 of A / 2^20, doubled twenty times."""
    part = matrix.astype(np.longdouble) / 2**20
    term, less_one = np.eye(len(matrix), dtype=np.longdouble), 0
    for k in range(1, 12):
        term = term @ part / k
        less_one = less_one + term
    for _ in range(20):
        less_one = 2 * less_one + less_one @ less_one
    return (less_one + np.eye(len(matrix))).astype(float)


def test_it_is_the_exponential_over_many_sizes_and_norms():
    rng = np.random.default_rng(0)
    for n in (1, 4, 14):
        matrices = rng.normal(size=(40, n, n)) * np.geomspace(1e-8, 30, 40)[:, None, None]
        exact = np.array([longer(matrix) for matrix in matrices])
        # the exponential's own sensitivity: rounding A by 1e-16 of its norm moves exp(A) by that norm times as much
        allowed = 1e-14 * (1 + np.abs(matrices).sum(axis=1).max(axis=1)) * np.abs(exact).max(axis=(1, 2))
        assert (np.abs(expm_each(matrices) - exact).max(axis=(1, 2)) <= allowed).all()
        # scipy's, of the same method, is no nearer: by up to 3e-13 of the largest entry
        np.testing.assert_array_less(np.abs(expm(matrices) - exact).max(axis=(1, 2)), 50 * allowed)


def test_an_undamped_oscillator_turns():
    """exp([[0, w], [-w, 0]]) is a rotation by w, also by many turns."""
    w = np.geomspace(1e-3, 1e3, 13)
    turned = expm_each(w[:, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    exact = np.stack([np.stack([np.cos(w), np.sin(w)], -1), np.stack([-np.sin(w), np.cos(w)], -1)], axis=1)
    np.testing.assert_allclose(turned, exact, atol=1e-12)


def test_a_nilpotent_matrix_ends_its_series():
    shift = np.diag([1.0, 1.0], 1)
    np.testing.assert_allclose(expm_each(shift[None])[0], [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]], rtol=1e-15)


def test_a_result_does_not_depend_on_its_neighbours():
    matrices = np.random.default_rng(1).normal(size=(9, 6, 6)) * np.geomspace(0.01, 100, 9)[:, None, None]
    together = expm_each(matrices)
    for i in range(9):
        np.testing.assert_array_equal(expm_each(matrices[i : i + 1])[0], together[i])
