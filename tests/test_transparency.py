"""The figures of the mismatch, against the agreed table and dense sweeps."""

import numpy as np
import pytest

from controller.coupling import NoCoupling, SpringDamper
from controller.environment import FIGURE_4, GROUND, Network, Spring, environment
from controller.process import force_map
from design.published import CASE_I
from design.transparency import decibels, transparency

T, THETA = 1.2e-3, (1, 2)
E = environment(FIGURE_4, T)


@pytest.mark.parametrize(
    ("coupling", "lam", "sup", "rms"),
    [
        (CASE_I, (1, 2), 7.70, -7.24),
        (CASE_I, (0, 0), 7.91, -5.97),
        (NoCoupling(), (0, 0), 0.34, -10.98),
        (SpringDamper([878.86, 551.94], [0.3865, 0.5220]), (1, 2), 18.55, -0.08),
        (SpringDamper([878.86, 551.94], [0.3865, 0.5220]), (0, 0), 18.60, 0.15),
    ],
)
def test_agreed_figures(coupling, lam, sup, rms):
    figures = transparency(force_map(E, coupling, THETA, (0, 0)), E, lam)
    assert decibels(figures.relative_mismatch) == pytest.approx(sup, abs=0.006)
    assert decibels(figures.rms_mismatch) == pytest.approx(rms, abs=0.006)


def test_against_a_dense_sweep():
    F = force_map(E, CASE_I, THETA, (0, 0))
    hz = np.geomspace(0.5, 80, 400_001)
    z = np.exp(2j * np.pi * hz * T)
    target = z[:, None, None] ** -np.array([1.0, 2.0])[None, :, None] * E.at(z)
    M = F.at(z) - target
    figures = transparency(F, E, THETA)
    ratio = np.linalg.norm(M, 2, axis=(1, 2)) / np.linalg.norm(E.at(z), 2, axis=(1, 2))
    assert figures.relative_mismatch == pytest.approx(ratio.max(), rel=1e-6)
    square = np.sum(np.abs(M) ** 2, axis=(1, 2)) / np.sum(np.abs(E.at(z)) ** 2, axis=(1, 2))
    assert figures.rms_mismatch == pytest.approx(np.sqrt(square.mean()), rel=2e-3)


def test_what_needs_no_force_makes_tau_infinite():
    """E(1) of Figure 4 has rank one, so (25) divides by zero."""
    assert transparency(force_map(E, CASE_I, THETA, (0, 0)), E, THETA).tau == np.inf


def test_tau_of_a_spring_is_its_relative_error():
    """A wall of 1000 N/m behind a coupling of 4000 N/m: F = 800, so tau = 200/1000 and the dc ratio 0.8."""
    wall = environment(Network(("a",), (Spring(("a", GROUND), 1000.0),)), T)
    figures = transparency(force_map(wall, SpringDamper([4000.0], [0.0]), [0], [0]), wall, [0])
    assert figures.tau == pytest.approx(0.2)
    assert figures.relative_mismatch == pytest.approx(0.2)
    assert figures.dc_ratio == pytest.approx(0.8)
    assert figures.high_frequency_gain == pytest.approx(0.8)


def test_an_exact_match_is_minus_infinity():
    figures = transparency(force_map(E, NoCoupling(), THETA, (0, 0)), E, THETA)
    assert figures.relative_mismatch == 0
    assert decibels(figures.relative_mismatch) == -np.inf
