"""Tests of the required damping: known figures, closed forms, and a pencil that needs no frequency grid."""

import numpy as np
import pytest
from evaluate import any_environment, any_environment_demand, any_environment_per_channel, loop, this_environment
from scipy.linalg import eig, eigh
from shared import FIGURE_4, STIFF, force_map

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, environment
from haptic_loop.controller.lti import Lti
from haptic_loop.design.conditions import _least_multiple, _regular_part, least_scale
from haptic_loop.design.frequency import frequencies, hermitian, on_circle, supremum

T, THETA, DELTA = 1.2e-3, (1, 2), (1.37, 1.37)
E = environment(FIGURE_4, T)
RNG = np.random.default_rng(5)


def default(coupling) -> Lti:
    return force_map(E, coupling, THETA, (0, 0))


@pytest.mark.parametrize(
    ("coupling", "required"),
    [
        (NoCoupling(), 1.7229),
        (PUBLISHED["I"], 1.39871),
        (PUBLISHED["II"], 1.29778),
        (SpringDamper([879.0, 552.0], [0.39, 0.52]), 0.714344),
        (STIFF, 1.36326),
    ],
)
def test_this_environment_needs_the_known_damping(coupling, required):
    result = this_environment(default(coupling), DELTA)
    assert result.required == pytest.approx((required, required), rel=3e-5)
    assert result.certified == (required < 1.37)


def test_any_environment_needs_the_known_damping():
    assert any_environment_per_channel(PUBLISHED["I"].channels(T), THETA, DELTA).required == pytest.approx(
        (7.63, 7.84), abs=0.005
    )
    assert any_environment_per_channel(PUBLISHED["II"].channels(T), THETA, DELTA).required == pytest.approx(
        (7.04, 3.89), abs=0.005
    )
    best = SpringDamper([878.86, 551.94], [0.3865, 0.5220])
    assert any_environment_per_channel(best.channels(T), THETA, DELTA).required == pytest.approx((1.37, 1.37), rel=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_any_environment_needs_the_trigonometric_maximum(seed):
    """The need is max |K T vt + B (1 - z^-n)|^2 / (4 (K T/2 + B)), n = theta + 1, vt = 1 + .. + z^-theta."""
    rng = np.random.default_rng(seed)
    theta, K, B = int(rng.integers(0, 6)), np.exp(rng.uniform(4, 9)), np.exp(rng.uniform(-3, 2))
    z = np.exp(1j * np.linspace(0, np.pi, 1_000_001))
    window = sum(z**-n for n in range(theta + 1))
    expected = np.max(np.abs(K * T * window + B * (1 - z ** -(theta + 1))) ** 2) / (4 * (K * T / 2 + B))
    V = SpringDamper([K], [B]).compliance(T)
    assert any_environment(V, [theta], [1.0]).required[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("K", "B", "theta", "factor"), [(5000, 0, 0, 0.5), (5000, 30, 0, 0.5), (2000, 0, 1, 1.5)])
def test_a_rigid_wall_needs_its_closed_form(K, B, theta, factor):
    """The requirement is Colgate's K T/2 + B without delay, and 3 K T/2 for a spring with one sample of delay."""
    wall = environment(Network(("a",), (Spring(("a", GROUND), float(K), float(B)),)), 1e-3)
    F = force_map(wall, NoCoupling(), [theta], [0])
    assert this_environment(F, [1.0]).required[0] == pytest.approx(factor * K * 1e-3 + B, rel=1e-9)


def crossings(F: Lti, level: float) -> np.ndarray:
    """Return the angles of the points on the circle at which level/T I - F(1)/2 + He R is singular.

    R is (F - F(1))/(z - 1). The points are eigenvalues of an extended symplectic pencil.
    """
    R, n, m = F.split_at_one()[1], F.order, F.inputs
    direct = 2 * (level / F.T * np.eye(m) - F.dc() / 2)
    zero = np.zeros
    right = np.block(
        [[R.A, zero((n, n)), R.B], [zero((n, n)), np.eye(n), zero((n, m))], [R.C, R.B.T, direct]],
    )
    left = np.block(
        [[np.eye(n), zero((n, n + m))], [zero((n, n)), R.A.T, R.C.T], [zero((m, 2 * n + m))]],
    )
    z = eig(right, left, right=False)
    z = z[np.isfinite(z)]
    return np.angle(z[np.abs(np.abs(z) - 1) < 1e-7])


def random_loop(seed) -> Lti:
    rng = np.random.default_rng(seed)
    theta, psi = rng.integers(0, 4, size=(2, 2)) // [[1], [3]]
    coupling = SpringDamper(np.exp(rng.uniform(5, 9, 2)), np.exp(rng.uniform(-2, 2, 2)))
    return force_map(E, coupling, theta.tolist(), psi.tolist())


@pytest.mark.parametrize("seed", range(20))
def test_the_sweep_misses_no_peak(seed):
    """1e-4 above the required damping no frequency violates the condition, and 1e-4 below some frequency does."""
    F = random_loop(seed)
    if not F.is_stable():
        assert this_environment(F, (1.0, 1.0)).required == (np.inf, np.inf)
        return
    required = this_environment(F, (1.0, 1.0)).required[0]
    assert crossings(F, required * (1 + 1e-4)).size == 0
    assert crossings(F, required * (1 - 1e-4)).size > 0


def test_unequal_devices_need_a_common_factor():
    """Required damping is the available damping times a common ratio, so doubling delta only halves the ratio."""
    F = default(PUBLISHED["I"])
    one, two = this_environment(F, (1.0, 2.0)), this_environment(F, (2.0, 4.0))
    assert one.required == pytest.approx(two.required, rel=1e-9)
    assert one.ratio == pytest.approx(2 * two.ratio, rel=1e-9)


def test_the_channel_with_the_largest_ratio_decides():
    """With B = 0 any-environment needs K T (theta + 1)^2/2 per channel: 1.08 of 2 N s/m and 0.96 of 0.9 N s/m."""
    coupling = SpringDamper([1800.0, 400.0], [0.0, 0.0])
    for order in (slice(None), slice(None, None, -1)):
        channels, theta, delta = coupling.channels(T)[order], (0, 1)[order], (2.0, 0.9)[order]
        requirement = any_environment_per_channel(channels, theta, delta)
        assert requirement.required == pytest.approx((1.08, 0.96)[order], rel=1e-9)
        assert requirement.ratio == pytest.approx(0.96 / 0.9, rel=1e-9)
        assert not requirement.certified
    lossy, lossless = SpringDamper([400.0], [3.0]).channels(T) + SpringDamper([400.0], [0.0]).channels(T)
    alone = any_environment(lossy, (1,), (0.9,))
    for channels, delta in (([lossy, lossless], (0.9, 2.0)), ([lossless, lossy], (2.0, 0.9))):
        assert any_environment_per_channel(channels, (1, 1), delta).frequency_hz == alone.frequency_hz > 100


@pytest.mark.parametrize("mass", [0.3, 1.0, 3.0, 30.0, 300.0, 1000.0])
def test_a_free_mass_is_not_refused_by_rounding(mass):
    """F(1) of a free mass is exactly 0. From 0.3 kg on, a mass needs the damping of a rigid wall, within 0.3 %."""
    free = environment(Network(("a",), masses={"a": mass}), T)
    F = force_map(free, SpringDamper([610.0], [0.545]), [2], [0])
    assert this_environment(F, [1.37]).required[0] == pytest.approx(1.3659, rel=3e-3)


def test_force_and_measurement_delays_are_interchangeable():
    """Remark 3 of the paper, for stability: only the sum of the two delays of a channel matters."""
    from haptic_loop.controller.delay import delay

    inner = PUBLISHED["I"].around(E)
    split = delay((1, 0), T) @ inner @ delay((0, 2), T)
    assert this_environment(split, DELTA).ratio == pytest.approx(
        this_environment(default(PUBLISHED["I"]), DELTA).ratio, rel=1e-9
    )


def test_refusals_say_why():
    unstable = Lti([[1.01]], [[1.0]], [[1.0]], [[0.0]], T)
    assert "outside the unit circle" in this_environment(unstable, [1.0]).reason
    twisted = Lti.constant([[1.0, 0.5], [0.0, 1.0]], T)
    assert "not symmetric" in this_environment(twisted, (1.0, 1.0)).reason
    assert "pushes outwards" in this_environment(Lti.constant([[-1.0]], T), [1.0]).reason
    assert "no damping" in this_environment(default(PUBLISHED["I"]), (0.0, 1.0)).reason
    assert "no damping" in any_environment(Lti.constant([[1.0, 0.0], [0.0, 1.0]], T), [0, 0], (1.0, 0.0)).reason
    assert "V(1) is not symmetric" in any_environment(twisted, [0, 0], (1.0, 1.0)).reason
    assert "not passive enough" in any_environment(Lti.constant([[0.0]], T), [0], [1.0]).reason


@pytest.mark.parametrize("wrong", [-1.0, np.inf, np.nan])
def test_loops_need_finite_periods_and_dampings(wrong):
    with pytest.raises(ValueError, match=r"delta is .*, expected 0 or a finite damping"):
        loop(T, (wrong, 1.0))
    with pytest.raises(ValueError, match=r"T is .* s, expected a positive, finite period"):
        loop(wrong, DELTA)


def test_the_binding_frequency_matches_a_dense_grid():
    """Ratio and frequency equal those of the definition, -He[F/(z-1)] T/delta, on a dense grid."""
    F, w = default(PUBLISHED["I"]), np.linspace(1e-3, np.pi, 200_001)
    z = np.exp(1j * w)
    G = F.at(z) / (z - 1)[:, None, None]
    needed = np.linalg.eigvalsh(-(G + np.conj(np.swapaxes(G, -1, -2))) / 2)[:, -1] * T
    requirement = this_environment(F, (1.0, 1.0))
    assert requirement.ratio == pytest.approx(needed.max(), rel=1e-6)
    assert requirement.frequency_hz == pytest.approx(w[needed.argmax()] / (2 * np.pi * T), rel=1e-3)


@pytest.mark.parametrize("n", [2, 3])
def test_the_least_multiple_is_a_generalised_eigenvalue(n):
    free, half = (RNG.normal(size=(9, n, n)) + 1j * RNG.normal(size=(9, n, n)) for _ in range(2))
    free, gain = hermitian(free), half @ np.conj(np.swapaxes(half, 1, 2)) + 0.1 * np.eye(n)
    expected = [eigh(-one, other, eigvals_only=True)[-1] for one, other in zip(free, gain, strict=True)]
    np.testing.assert_allclose(_least_multiple(free, gain), expected, rtol=1e-9)


def test_the_regular_part_keeps_the_hermitian_part():
    """E z/(z-1) without its pole at 1 has the same Hermitian part on the circle."""
    z = np.exp(1j * np.array([0.1, 0.7, 2.9]))
    whole = E.at(z) * (z / (z - 1))[:, None, None]
    np.testing.assert_allclose(hermitian(_regular_part(E).at(z)), hermitian(whole), rtol=1e-9, atol=1e-6)


def test_supremum_finds_a_narrow_peak():
    """An even grid would miss a peak of width 1e-7. The grid of `frequencies` contains the frequency of the pole."""
    pole = (1 - 1e-7) * np.exp(1j * 1.2345)
    A = np.array([[pole.real, pole.imag], [-pole.imag, pole.real]])
    needle = Lti(A, [[1.0], [0.0]], [[1.0, 0.0]], [[0.0]], T)
    height, w = supremum(lambda w: np.abs(needle.at(np.exp(1j * w))[:, 0, 0]), frequencies(needle))
    assert height == pytest.approx(0.5e7, rel=1e-4)
    assert w == pytest.approx(1.2345, abs=1e-6)


def test_rounding_elsewhere_hides_no_peak():
    """Fifty ripples of 1e-9, as rounding makes them, exceed all grid values beside the peak, which is still found."""

    def response(w):
        return np.where(w < 0.5, 1 + 1e-9 * np.cos(200 * np.pi * w), 1.001 - 200 * (w - 0.7525) ** 2)

    grid = np.linspace(0, 1, 201)
    assert (response(grid[grid > 0.5]) < 1 - 1e-9).all()
    assert supremum(response, grid) == pytest.approx((1.001, 0.7525), rel=1e-9)


def test_the_factor_with_multiplier_is_least():
    """The inequality of (11) to (14) is tight at the factor s of the damping, true above it and false below it.

    It is He[H/(1-z)] >= H* Delta_V H with H = V - Theta-hat/s.
    """
    V, theta, delta, phi = SpringDamper([300.0, 200.0], [0.2, 0.3]).compliance(T), (1, 2), np.array(DELTA), (0.37, 0.1)
    w = np.linspace(0.05, 3.1, 23)
    z, star = on_circle(w), lambda M: np.conj(np.swapaxes(M, 1, 2))
    vt = np.stack([sum(z**-k for k in range(n + 1)) for n in theta], axis=1)

    def least(s):
        covered = 1 / (1 / np.array(phi) - 1 / (s[:, None] * delta))  # Delta_V
        H = V.at(z) / T - (vt / (2 * s[:, None] * delta))[:, :, None] * np.eye(2)
        return np.linalg.eigvalsh(hermitian(H / (1 - z)[:, None, None]) - star(H) @ (covered[:, :, None] * H))[:, 0]

    s = least_scale(any_environment_demand(V, theta, delta, phi=phi), w)
    scale = np.abs(least(2 * s))
    assert (np.abs(least(s)) < 1e-9 * scale).all()
    assert (least(1.001 * s) > 0).all()
    assert (least(0.999 * s) < 0).all()


def test_weights_gain_nothing_in_reciprocal_loops():
    """A weight d > 0 on each human's energy turns F into sqrt(d) F sqrt(d)^-1, which never needs less damping."""
    F = force_map(environment(FIGURE_4, 1.2e-3), SpringDamper([900.0, 600.0], [0.4, 0.6]), (1, 2), (0, 0))
    rng, z = np.random.default_rng(8), np.exp(1j * np.geomspace(1e-2, 3.1, 60))
    X = -F.at(z) / (z - 1)[:, None, None]
    need = np.linalg.eigvalsh((X + np.conj(np.swapaxes(X, 1, 2))) / 2)[:, -1]
    for d in np.exp(rng.normal(size=(30, 2))):
        weighed = np.sqrt(d)[:, None] * X / np.sqrt(d)
        assert (np.linalg.eigvalsh((weighed + np.conj(np.swapaxes(weighed, 1, 2))) / 2)[:, -1] >= need - 1e-9).all()


def test_a_map_that_cancels_needs_no_damping():
    """Two states cancel, so F = 0. In other coordinates rounding leaves F(1) slightly asymmetric."""
    turn = np.random.default_rng(3).normal(size=(2, 2))
    B, back = np.array([[1e3, 70.0], [-1e3, -70.0]]), np.linalg.inv(turn)
    F = Lti(turn @ (0.5 * np.eye(2)) @ back, turn @ B, np.ones((2, 2)) @ back, np.zeros((2, 2)), 1e-3)
    F1 = F.dc()
    assert np.abs(F1 - F1.T).max() > 1e-9 * 1e-12  # over 1e-9 of F(1), whose size counts as 1e-12 N/m at least
    requirement = this_environment(F, [1.37, 1.37])
    assert requirement.reason is None
    assert requirement.ratio < 1e-9


def test_an_indefinite_gain_is_never_enough():
    assert _least_multiple(np.eye(2)[None], np.diag([-1.0, 1.0])[None]) == np.inf


def test_blocks_without_damping_need_none_or_fail():
    """With gain 0 no multiple changes the block, so 0 suffices for a positive block, and no s for another."""
    for free, least in ((np.eye(2), 0.0), (np.diag([1.0, -1.0]), np.inf)):
        assert _least_multiple(free[None] + 0j, np.zeros((1, 2, 2)) + 0j) == least
