"""Tests of the bound on the mismatch of linear couplings: its dual matrix is nonnegative, also between samples.

A value of the bound is charged if the error of the dual matrix between samples was subtracted from it.
"""

from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
import scipy

import haptic_loop
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.design import bound as module
from haptic_loop.design.bound import BoundBeside, bound
from haptic_loop.design.certificate import required_damping
from haptic_loop.design.dual_matrix import DualMatrix, dilogarithm
from haptic_loop.design.frequency import hermitian
from haptic_loop.sim.scenario import load

LOOPS = Path(__file__).parents[2] / "benchmarks" / "loops"
POINTS = 2**20  # points of the Fourier transform


def loop_of(name):
    return haptic_loop.load().loop(name) if name in ("I", "II") else load(next(LOOPS.glob(f"{name}*"))).loop("I")


@cache
def judged(name):
    """Return the bound, and (dual, its unknowns x, uncharged value, charged value) for the largest charged value."""
    calls, charged = [], module._Dual.charged

    def recorded(self, x, value, swept):
        limitt = charged(self, x, value, swept)
        calls.append((self, x, value, limitt[0]))
        return limitt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module._Dual, "charged", recorded)
        limit = bound(loop_of(name), knots=16 if name[0] in "no" else None)
    return limit, max(calls, key=lambda call: call[3])


def transformed(dual, x):
    """Return the dual matrix D on the upper half of the circle, from a Fourier transform of H and the matrices C_k."""
    m, root = dual.loop.channels, np.sqrt(dual.loop.delta)
    w = np.linspace(0, np.pi, POINTS // 2 + 1)
    inner = dual.heights.shape[1]
    parts = x[: 2 * m * m * inner].reshape(m, m, 2, inner)
    D = np.zeros((w.size, m, m), dtype=complex)
    for i in range(m):
        for j in range(m):
            heights = dual.heights @ (parts[i, j, 0] + 1j * parts[i, j, 1])
            H = np.fft.irfft(np.interp(w, dual.grid, heights, left=0, right=0))[: POINTS // 2]
            steps = -np.diff(H, prepend=0)
            steps[0] = 0
            D[:, i, j] = 4 / dual.loop.T * root[i] * root[j] * np.fft.rfft(steps, POINTS)
    own = x[2 * m * m * inner :]
    upper = np.triu_indices(m)
    constant = np.zeros((m, m))
    constant[upper] = own[: len(upper[0])]
    D += constant + constant.T - np.diag(np.diag(constant))
    for value, (row, weights) in zip(own[len(upper[0]) :], dual.forbidden, strict=True):
        for k in np.flatnonzero(weights.any(axis=1)):
            D[:, row] += value * np.exp(-1j * k * w)[:, None] * weights[k]
    return hermitian(D)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [*(pytest.param(name, marks=pytest.mark.validate) for name in ("I", "II", "n2")), "n3"],
)
def test_the_charged_matrix_is_nowhere_negative(name):
    """A Fourier transform of 2^20 points finds D plus the charge nonnegative, to 2 % of the charge."""
    limit, (dual, x, value, charged) = judged(name)
    m = dual.loop.channels
    charge = (value - charged) / m
    least = np.linalg.eigvalsh(transformed(dual, x))[:, 0].min()
    assert limit.proved
    assert charge > 0
    assert least + charge > -0.02 * charge
    assert charge < 2 * max(-least, 0) + 3e-3 * value / m  # at most twice the need, plus 0.3 % of value/m


@pytest.mark.validate
@pytest.mark.parametrize(("name", "rms_db"), [("I", -35.137), ("II", -13.839)])
def test_bounds_equal_those_of_separate_code(name, rms_db):
    limit, _ = judged(name)
    assert limit.rms_db == pytest.approx(rms_db, abs=0.006)
    assert limit.sampled_rms > limit.rms


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("n3", "n4"),
        *(pytest.param(name, marks=pytest.mark.validate) for name in ("I", "II", "n2", "o01")),
    ],
)
def test_a_charged_bound_is_never_above_the_estimate(name):
    limit, (_, _, value, charged) = judged(name)
    assert charged <= value
    assert 0 < limit.rms <= limit.sampled_rms


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "high"), [("n1-omega-II", 1e4), pytest.param("o12-free-mass-late", 100.0, marks=pytest.mark.validate)]
)
def test_the_integral_errs_by_less_than_its_bound(name, high):
    """Simpson's rule with 400 steps per interval and `objective_again` agree on -tr C_0 - 2 <H, Lambda E> - <H, H/rho>.

    The weight rho contains the logarithmic width of the band, which ends at the Nyquist frequency at the latest.
    """
    loop = loop_of(name)
    dual = module._Dual.of(loop, (1.0, high), 16)
    x = dual.start + 0.1 * np.random.default_rng(0).normal(size=dual.start.size)
    objective, error = dual.objective_again(x)
    E, H, span = loop.E(), dual.H(x), np.log(min(high, 0.5 / loop.T))
    total, wrong = 0.0, 0.0
    for a, b, left, right in zip(dual.grid[:-1], dual.grid[1:], H[:-1], H[1:], strict=True):
        share = np.linspace(0, 1, 401)[:, None, None]
        z = np.exp(1j * (a + (b - a) * share))
        late = z ** -np.array(loop.lam)[:, None] * (E.C @ np.linalg.solve(z * np.eye(E.order) - E.A, E.B) + E.D)
        between = left + (right - left) * share
        g = 2 / np.pi * (np.conj(between) * late).real.sum(axis=(1, 2))
        size = np.linalg.norm(between, axis=(1, 2)) * np.linalg.norm(late, axis=(1, 2))
        g += span / np.pi**2 * (a + (b - a) * share[:, 0, 0]) * size**2
        fine, coarse = (scipy.integrate.simpson(g[::step], dx=step * (b - a) / 400) for step in (1, 2))
        total, wrong = total + fine, wrong + abs(fine - coarse)
    assert wrong < 1e-7 * abs(total)
    assert abs(-total - float(dual.cost @ x) - objective) <= error + wrong
    assert error < 1e-8 * abs(total)


def test_negative_values_between_samples_are_found():
    sums = np.zeros((9, 1, 1))
    sums[0], sums[8] = 0.999, 1.0  # D = .999 + cos 8 w: -.001 at odd multiples of pi/8
    grid = np.linspace(0.1, 0.3, 4)
    D = DualMatrix.of(grid, np.zeros((4, 1, 1), dtype=complex), np.ones((1, 1)), sums)
    swept = np.linspace(0, np.pi, 201)
    swept = swept[np.abs(np.cos(8 * swept) + 1) > 0.002]
    assert D._parts(np.concatenate([swept, grid]))[1].real.min() > 0
    lower, _, _ = D.lower(swept, 1e-5)
    assert -0.00115 < lower <= -0.001  # the search leaves an error of at most an eighth of the value


def test_a_bound_holds_between_sharp_bends():
    """D turns sharply between bends of H that are 1e-5 apart, where no sample lies."""
    random = np.random.default_rng(0)
    grid = np.sort(np.concatenate([np.linspace(0.2, 1.0, 12), 0.6 + 1e-5 * np.arange(1, 5)]))
    heights = random.normal(size=(grid.size, 2, 2)) + 1j * random.normal(size=(grid.size, 2, 2))
    heights[[0, -1]] = 0
    heights[np.abs(grid - 0.6) < 1e-4] *= 1e-3
    D = DualMatrix.of(grid, heights, np.ones((2, 2)), np.zeros((1, 2, 2)))
    dense = np.concatenate([np.linspace(0, np.pi, 20001), 0.6 + np.linspace(-1e-4, 1e-4, 4001)])
    least = np.linalg.eigvalsh(D._parts(dense)[1])[:, 0].min()
    lower, _, _ = D.lower(np.array([0.0, np.pi]), 1e-3)
    assert 1.3 * least < lower <= least < 0


def test_only_proved_bounds_are_stated_as_limits():
    """Every bound names this-environment, because known-device may certify couplings that are better."""
    proved, estimate = (BoundBeside(-3.0, proved=proved).words for proved in (True, False))
    assert "no linear coupling that this-environment certifies" in proved
    assert "no linear coupling" not in estimate
    assert estimate.startswith("estimate")
    assert "that this-environment certifies" in estimate


@pytest.mark.slow
def test_negative_or_unequally_delayed_bounds_are_estimates(monkeypatch):
    unequal, _ = judged("n4")  # psi = 1, 0: the forbidden directions are known only up to rounding
    assert not unequal.proved
    monkeypatch.setattr(DualMatrix, "lower", lambda self, swept, wanted: (-10.0, swept, np.ones(swept.size)))
    nothing = bound(loop_of("n3"), knots=8)
    assert not nothing.proved
    assert nothing.rms == nothing.sampled_rms > 0


SPRINGS = Spring(("x", GROUND), 900.0, 0.5), Spring(("x", "y"), 300.0, 0.3)
LEVEL = ((1.2, 0.9), (0.9, 1.0))  # [N s/m]
PLANE = Loop(1e-3, (1, 1), (0, 0), (0, 0), (1.2, 1.0), Network(("x", "y"), SPRINGS), axes=(2,), levels=(LEVEL,))


def test_a_full_level_enters_the_dual_value():
    """At every dual point tr C_0 Delta + 2 <H, F> is <D, S>, the mean of Re tr D*S for S = He[Delta + T F/(z-1)].

    At z = 1 the measure S has the mass T F(1)/2. The trapezoidal rule errs by 1e-5 of the value.
    """
    dual = module._Dual.of(PLANE, (1.0, 100.0), 8)
    x = np.random.default_rng(0).normal(size=dual.start.size)
    F, root, low = PLANE.F(SpringDamper([700.0, 500.0], [0.4, 0.3])), np.sqrt(PLANE.delta), dual.band[0]
    w = np.union1d(np.geomspace(low / 1e3, np.pi, 2000), np.linspace(low / 1e3, np.pi, 3000))
    z = np.exp(1j * w)
    S = hermitian(np.array(LEVEL) + PLANE.T * F.at(z) / (z - 1)[:, None, None])
    D = dual.matrix(x)._parts(np.append(0.0, w))[1] / np.outer(root, root)
    H = np.stack([np.interp(w, dual.grid, each, left=0, right=0) for each in dual.H(x).reshape(-1, 4).T], axis=-1)
    mass = np.trace(D[0].real @ F.dc()) * PLANE.T / 2
    product = np.trapezoid((np.conj(D[1:]) * S).real.sum(axis=(1, 2)), w) / np.pi + mass
    forces = 2 / np.pi * np.trapezoid((np.conj(H.reshape(-1, 2, 2)) * F.at(z)).real.sum(axis=(1, 2)), w)
    assert dual.objective()[2] @ x == pytest.approx(product - forces, rel=1e-4)


@pytest.mark.parametrize(("latency", "factor"), [(None, 1 / 2), (((5e-4, 8e-4),) * 2, 1 / 1.5)])
def test_timing_scales_the_level_of_a_bound(monkeypatch, latency, factor):
    """The dual problem's level is Delta T/(T_max - t1), where t1 is the least latency."""
    loops = []
    monkeypatch.setattr(module._Dual, "best", lambda dual: (loops.append(dual.loop), 1.0, 1.0)[1:])
    bound(msgspec.structs.replace(PLANE, T_max=2 * PLANE.T, latency=latency), knots=8)
    np.testing.assert_allclose(loops[0].Delta(), factor * np.array(LEVEL), rtol=1e-15)
    assert loops[0].T_max is None


@pytest.mark.slow
def test_no_bound_exceeds_a_late_loops_mismatch():
    """Without coupling a damper has no mismatch. A latency of 0.5 ms lowers its need from 1.2005 to 0.926 N s/m."""
    damper = Network(("tip",), (Spring(("tip", GROUND), 1.0, 1.2),))
    loop = Loop(1e-3, (0,), (0,), (0,), (1.0,), damper, latency=((5e-4, 5e-4),))
    assert required_damping(loop, NoCoupling(), "this-environment").certified
    assert bound(loop, (1.0, 500.0), knots=8).rms == 0


def test_splines_and_dilogarithm_equal_those_of_scipy():
    """The tolerances are 1e-14 for sums of products below 1, and 300 roundings for the dilogarithm."""
    knots, x = np.array([0.0, 0.3, 1.0, 1.1, 2.0]), np.linspace(0, 2, 41)
    every = np.concatenate([[0.0] * 3, knots, [2.0] * 3])
    expected = scipy.interpolate.BSpline.design_matrix(x, every, 3).toarray()
    np.testing.assert_allclose(module._splines(x, knots, 3), expected, rtol=0, atol=1e-14)
    angles = np.linspace(-2 * np.pi, 2 * np.pi, 81)
    expected = scipy.special.spence(1 - np.exp(1j * angles))
    np.testing.assert_allclose(dilogarithm(angles), expected, rtol=0, atol=300 * 2.0**-53)
