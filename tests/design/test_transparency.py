"""Tests of the mismatch figures: they equal recorded figures, dense sweeps and closed forms."""

import numpy as np
import pytest
from scipy.integrate import quad
from shared import FIGURE_4, SOFT, STIFF, force_map

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.design.frequency import integral
from haptic_loop.design.transparency import decibels, transparency

T, THETA = 1.2e-3, (1, 2)
E = environment(FIGURE_4, T)


@pytest.mark.parametrize(
    ("coupling", "lam", "sup", "rms"),
    [
        (PUBLISHED["I"], (1, 2), 7.70, -7.24),
        (PUBLISHED["I"], (0, 0), 7.91, -5.97),
        (NoCoupling(), (0, 0), 0.34, -10.98),
        (SpringDamper([878.86, 551.94], [0.3865, 0.5220]), (1, 2), 18.55, -0.08),
        (SpringDamper([878.86, 551.94], [0.3865, 0.5220]), (0, 0), 18.60, 0.15),
    ],
)
def test_mismatches_equal_recorded_figures(coupling, lam, sup, rms):
    figures = transparency(force_map(E, coupling, THETA, (0, 0)), E, lam)
    assert decibels(figures.relative_mismatch) == pytest.approx(sup, abs=0.006)
    assert decibels(figures.rms_mismatch) == pytest.approx(rms, abs=0.006)


@pytest.mark.slow
def test_figures_match_a_dense_sweep():
    F = force_map(E, PUBLISHED["I"], THETA, (0, 0))
    hz = np.geomspace(0.5, 80, 100_001)
    z = np.exp(2j * np.pi * hz * T)
    target = z[:, None, None] ** -np.array([1.0, 2.0])[None, :, None] * E.at(z)
    M = F.at(z) - target
    figures = transparency(F, E, THETA)
    ratio = np.linalg.norm(M, 2, axis=(1, 2)) / np.linalg.norm(E.at(z), 2, axis=(1, 2))
    assert figures.relative_mismatch == pytest.approx(ratio.max(), rel=1e-6)
    square = np.sum(np.abs(M) ** 2, axis=(1, 2)) / np.sum(np.abs(E.at(z)) ** 2, axis=(1, 2))
    mean = np.trapezoid(square, np.log(hz)) / np.log(80 / 0.5)
    assert figures.rms_mismatch == pytest.approx(np.sqrt(mean), rel=1e-6)


@pytest.mark.parametrize("lam", [(1, 2), (0, 0)])
@pytest.mark.parametrize("coupling", [SOFT, STIFF, NoCoupling()])
def test_rms_matches_a_dense_grid(coupling, lam):
    """The trapezoidal rule on 100 001 points errs by under 1e-9 of its value, as twice the points show."""
    F = force_map(E, coupling, THETA, (0, 0))
    hz = np.geomspace(0.5, 80, 100_001)
    z = np.exp(2j * np.pi * hz * T)
    felt = E.at(z)
    M = F.at(z) - z[:, None, None] ** -np.array(lam, dtype=float)[None, :, None] * felt
    square = np.sum(np.abs(M) ** 2, axis=(1, 2)) / np.sum(np.abs(felt) ** 2, axis=(1, 2))
    expected = np.sqrt(np.trapezoid(square, np.log(hz)) / np.log(80 / 0.5))
    assert transparency(F, E, lam).rms_mismatch == pytest.approx(expected, rel=1e-6, abs=1e-12)


def test_the_integral_resolves_a_sharp_peak():
    """The integral over a peak of width 1e-4 between grid points equals its closed form and scipy's adaptive rule."""
    width = 1e-4

    def peak(x):
        return 1 / ((x - 0.3) ** 2 + width**2) + np.exp(x)

    closed = (np.arctan(0.7 / width) + np.arctan(0.3 / width)) / width + np.e - 1
    value = integral(peak, np.linspace(0, 1, 60))
    assert value == pytest.approx(closed, rel=1e-6)
    assert value == pytest.approx(quad(peak, 0, 1, points=[0.3], epsrel=1e-10)[0], rel=1e-6)


def test_the_integral_of_zero_is_zero():
    assert integral(np.zeros_like, np.linspace(0, 1, 5)) == 0


def test_integrals_of_rounding_noise_end():
    """Halving intervals gains nothing in noise: the work stays bounded, and the integral is near the noise's mean."""
    noise, points = np.random.default_rng(1), []

    def rounding(x):
        points.append(x.size)
        return size * noise.random(x.size)

    for size in (1e-32, 1e-6, 1.0):
        assert integral(rounding, np.linspace(0, 1, 60)) == pytest.approx(size / 2, rel=0.3)
    assert sum(points) < 500_000


def test_the_environment_itself_has_no_mismatch():
    """In other state coordinates F - Lambda E is only rounding, which halving intervals does not reduce."""
    assert transparency(E, E, (0, 0)).rms_mismatch < 1e-10
    state = np.eye(E.order) + np.triu(np.ones((E.order, E.order)), 1)
    same = Lti(state @ E.A @ np.linalg.inv(state), state @ E.B, E.C @ np.linalg.inv(state), E.D, E.T)
    assert transparency(same, E, (0, 0)).rms_mismatch < 1e-9


def test_a_singular_static_stiffness_makes_tau_infinite():
    """E(1) of Figure 4 has rank one, so (25) divides by zero."""
    assert transparency(force_map(E, PUBLISHED["I"], THETA, (0, 0)), E, THETA).tau == np.inf


def test_tau_of_a_spring_is_its_relative_error():
    """A wall of 1000 N/m behind a coupling of 4000 N/m: F = 800, so tau = 200/1000 and the dc ratio 0.8."""
    wall = environment(Network(("a",), (Spring(("a", GROUND), 1000.0),)), T)
    figures = transparency(force_map(wall, SpringDamper([4000.0], [0.0]), [0], [0]), wall, [0])
    assert figures.tau == pytest.approx(0.2)
    assert figures.relative_mismatch == pytest.approx(0.2)
    assert figures.dc_ratio == pytest.approx(0.8)
    assert figures.high_frequency_gain == pytest.approx(0.8)


def test_an_exact_match_has_minus_infinity_decibels():
    figures = transparency(force_map(E, NoCoupling(), THETA, (0, 0)), E, THETA)
    assert figures.relative_mismatch == 0
    assert decibels(figures.relative_mismatch) == -np.inf
