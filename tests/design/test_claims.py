"""Tests of the claims of docs/theory.md and docs/reproducibility.md.

The tests use dense sweeps, closed forms and simulated energies instead of the code that relies on the claims.
"""

import itertools
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from driven import driven
from evaluate import any_environment, this_environment
from shared import FIGURE_4, SOFT, STIFF, force_map

from haptic_loop.controller.arithmetic import numbers
from haptic_loop.controller.coupling import PUBLISHED, SpringDamper
from haptic_loop.controller.environment import GROUND, Environment, Network, Spring, environment
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design.assessment import Guarantee, assess
from haptic_loop.design.conditions import covers
from haptic_loop.design.environments import ANY_ENVIRONMENT, LimitedForces, least_multiplier
from haptic_loop.design.lmi import Shaping
from haptic_loop.design.result import RANGES, Infeasible
from haptic_loop.design.spring_damper import _GainSet, _step
from haptic_loop.models.human import Human, Link
from haptic_loop.sim.report import _PRINTED_TAU_DB
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import close, dominant_mode

T, THETA, DELTA = 1.2e-3, (1, 2), 1.37
W = np.unique(np.concatenate([np.geomspace(1e-5, np.pi, 40_001), np.linspace(1e-4, np.pi, 40_001)]))
Z = np.exp(1j * W)
RATE = 2j * np.sin(W / 2) * np.exp(-0.5j * W) / T  # (z-1)/(Tz), without cancellation at low frequency
LOOPS = {"I": (PUBLISHED["I"], (1, 2)), "II": (PUBLISHED["II"], (0, 0))}  # the paper's gains and lam of each case


def window(theta):
    """Return 1 + 1/z + .. + z^-theta at Z."""
    return sum(Z**-j for j in range(theta + 1))


def theorem_4(K, B, theta):
    """Return the damping that Theorem 4 needs at each w: (1 - cos (theta+1) w) / (2 Re V (z-1)/(T z))."""
    passivity = (K * T / 2 + B) / np.abs(K / RATE + B) ** 2  # Re V (z-1)/(T z)
    return np.sin((theta + 1) * W / 2) ** 2 / passivity


def needed(e_hat_inverse, K, B, theta):
    """Return the damping that E needs: sup of -T Re[F/(z-1)], F = z^-theta (1/E + V)^-1; e_hat_inverse is D/E at Z."""
    return (-(Z ** -(theta + 1) / (e_hat_inverse + 1 / (K / RATE + B))).real).max()


def test_theorem_1_telescopes():
    """g y - delta y^2 is g[k-n] dx/T - delta (dx/T)^2 + (g[k]^2 - g[k-n]^2)/(4 delta) and has no negative sum.

    Here y = dx/T + (g[k] - g[k-n])/(2 delta), n = theta + 1, and the held force g[k-n] moves the device by dx.
    """
    rng = np.random.default_rng(0)
    for theta in range(4):
        n, N, mass = theta + 1, 400, 0.3
        g = rng.normal(size=N)
        late = np.concatenate([np.zeros(n), g])[:N]  # g[k - n], held over the period before kT
        v = dx = 0.0
        balance = np.empty(N)
        passed = np.empty(N)
        for k in range(N):
            decay = np.exp(-DELTA / mass * T)  # exact for a mass on a damper under a held force
            steady = late[k] / DELTA
            dx = steady * T + (v - steady) * (1 - decay) * mass / DELTA
            v = steady + (v - steady) * decay
            y = dx / T + (g[k] - late[k]) / (2 * DELTA)
            balance[k] = g[k] * y - DELTA * y**2
            passed[k] = late[k] * dx / T - DELTA * (dx / T) ** 2 + (g[k] ** 2 - late[k] ** 2) / (4 * DELTA)
        np.testing.assert_allclose(balance, passed, rtol=0, atol=1e-12)
        assert np.cumsum(balance).min() >= -1e-12


def test_devices_and_hands_keep_the_sampled_energy_balance():
    """In the default scenario the stored energy rises by no more than the ports supply less the sampled dissipation.

    E_N <= E_0 + sum -f'dx + sum w'dh - sum (1/T) dx' Delta dx. External forces w act on the handles, whose steps are
    dh; w = 0 gives (a) of docs/theory.md.
    """
    rng = np.random.default_rng(1)
    simulation = assemble(load(), PUBLISHED["I"])
    masses = np.array([0.06, 0.06, 0.19 + 0.3, 0.19 + 0.3])  # motors, then handles with the hands
    for pushing in (0.0, 3.0):
        w = pushing * rng.normal(size=(3000, 2))
        start = rng.normal(size=(8, 1)) * np.repeat([1e-3, 0.2], 4)[:, None]
        record = run(simulation, "exact", lambda first, n, w=w: w[first : first + n], len(w), start)
        assert not record.clipped(simulation.process.force_limit).any()
        q, v = np.split(record.s, 2, axis=1)
        stored = (v**2 @ masses) / 2 + (14500 * (q[:, :2] - q[:, 2:]) ** 2 + 200 * q[:, 2:] ** 2).sum(axis=1) / 2
        dq = np.diff(q, axis=0)
        f, dx, dh = record.f[:-1], dq[:, :2], dq[:, 2:]
        supply = np.cumsum((-f * dx + w[:-1] * dh - DELTA / T * dx**2).sum(axis=1))
        assert (stored[1:] <= stored[0] + supply + 1e-12).all()
        if not pushing:
            assert (np.cumsum((-f * dx).sum(axis=1)) >= np.cumsum((DELTA / T * dx**2).sum(axis=1)) - stored[0]).all()


def supplied(F, dx):
    """Return the sum over k < N of f'dx + (1/T) dx' Delta dx for every N, from rest; dx is (ticks, 2, runs)."""
    x, f, state = np.cumsum(dx, axis=0) - dx, np.empty_like(dx), np.zeros((F.order, dx.shape[2]))
    for k, now in enumerate(x):
        f[k] = F.C @ state + F.D @ now
        state = F.A @ state + F.B @ now
    return np.cumsum((f * dx + DELTA / T * dx**2).sum(axis=1), axis=0)


def test_certified_forces_give_less_than_devices_dissipate():
    E = environment(FIGURE_4, T)
    rng = np.random.default_rng(2)
    for coupling in (STIFF, SOFT):
        F = force_map(E, coupling, THETA, (0, 0))
        colour, slow = rng.uniform(0, 0.99, 20), rng.normal(size=(1500, 1, 20))
        for k in range(1, 1500):
            slow[k] += colour * slow[k - 1]
        dx = 1e-4 * (slow * rng.normal(size=(2, 20)) + rng.normal(size=(1500, 2, 20)))
        assert supplied(F, dx).min() >= -1e-12
    # An uncertified map gives energy to motion in the worst direction at the frequency where the condition binds.
    F = force_map(E, PUBLISHED["I"], THETA, (0, 0))
    hz = this_environment(F, (DELTA, DELTA)).frequency_hz
    z = np.exp(2j * np.pi * hz * T)
    H = F.at(z) / (z - 1) + DELTA / T * np.eye(2)
    worst = np.linalg.eigh((H + H.conj().T) / 2)[1][:, 0]
    wave = (worst * z ** np.arange(20_000)[:, None]).real
    assert supplied(F, wave[:, :, None])[-1, 0] < 0


def test_figure_6_is_quiet_with_the_printed_gains():
    for coupling in (PUBLISHED["I"], PUBLISHED["II"]):
        record = run(assemble(load(), coupling), "exact")
        assert np.abs(record.f).max() < 0.7  # [N]
        assert 0.0155 < np.abs(record.s[:, :2]).max() < 0.016  # [m], motion of the devices
        fast = np.diff(record.f[-4000:], axis=0)
        assert np.abs(fast).max() < 0.01  # [N] per tick: in the last 4.8 s the tap has died out


@pytest.mark.parametrize(("coupling", "expected"), [(PUBLISHED["I"], (7.63, 7.84)), (PUBLISHED["II"], (7.04, 3.89))])
def test_the_printed_gains_fail_the_papers_condition(coupling, expected):
    needs = [theorem_4(K, B, n).max() for K, B, n in zip(coupling.K, coupling.B, THETA, strict=True)]
    assert needs == pytest.approx(expected, abs=0.005)
    assert min(needs) > 2.8 * DELTA
    # The equivalent |K T window + B (1 - z^-n)|^2 <= 4 delta (K T/2 + B) gives the same figures.
    for K, B, n in zip(coupling.K, coupling.B, THETA, strict=True):
        size = np.abs(K * T * window(n) + B * (1 - Z ** -(n + 1))) ** 2
        assert (size / (4 * (K * T / 2 + B))).max() == pytest.approx(theorem_4(K, B, n).max(), rel=1e-6)


def figure_4_at(z):
    """Return E (k, 2, 2) of Figure 4 at k points z, from its formula."""
    s = (z - 1) / (T * z)
    spring = np.array([800 + s, 700 + s])
    shared = spring[:, None] * spring[None, :] / (s**2 + spring.sum(axis=0))
    return np.moveaxis(np.eye(2)[:, :, None] * spring - shared, -1, 0)


def mismatch_at(z, E, coupling, lam):
    """Return the mismatch M = F - Lambda E (8) at k points z, (k, 2, 2)."""
    s = (z - 1) / (T * z)
    V = np.stack([1 / (K + B * s) for K, B in zip(coupling.K, coupling.B, strict=True)], axis=1)[:, :, None] * np.eye(2)
    late = z[:, None, None] ** -np.array(THETA, float)[:, None]
    target = z[:, None, None] ** -np.array(lam, float)[:, None]
    return late * np.linalg.solve(np.eye(2) + E @ V, E) - target * E


@pytest.mark.parametrize("case", ["I", "II"])
def test_tau_of_the_default_environment_is_infinite(case):
    """The least singular value of E falls as the square of the frequency, but the mismatch stays above 50 N/m."""
    z = np.exp(2j * np.pi * np.array([1e-1, 1e-2, 1e-3]) * T)
    E = figure_4_at(z)
    least = np.linalg.svd(E, compute_uv=False)[:, -1]
    np.testing.assert_allclose(least[:-1] / least[1:], 100, rtol=0.05)  # 100 as f -> 0; 3e-4 more at 0.1 Hz
    assert np.linalg.norm(mismatch_at(z, E, *LOOPS[case]), 2, axis=(1, 2)).min() > 50


def test_no_reading_of_figure_4_reproduces_tau():
    """In 66 readings each spring joins two of {contacts, mass, ground}, and the mass is free or at a contact.

    A grid makes (25) too small, never too large, but its value is still more than 60 dB above the printed figures.
    """
    hz = np.unique(np.concatenate([np.geomspace(1e-4, 80, 120), np.linspace(0.1, 80, 120)]))
    z = np.exp(2j * np.pi * hz * T)
    nodes, least, readings = ("a", "b", "m", GROUND), np.inf, 0
    for first, second, held in itertools.product(*[list(itertools.combinations(nodes, 2))] * 2, ("a", "b", "m")):
        used = set(first) | set(second)
        if not {"a", "b"} <= used | {held} or (held == "m" and "m" not in used):
            continue  # A contact or the mass is not connected.
        readings += 1
        E = environment(Network(("a", "b"), (Spring(first, 800.0, 1.0), Spring(second, 700.0, 1.0)), {held: 1.0}), T)
        response = E.at(z)
        singular = np.linalg.svd(response, compute_uv=False)[:, -1].min()
        for case, loop in LOOPS.items():
            peak = np.linalg.norm(mismatch_at(z, response, *loop), 2, axis=(1, 2)).max()
            tau_db = 20 * np.log10(peak / max(singular, 1e-12))
            assert tau_db > _PRINTED_TAU_DB[case] + 60
            least = min(least, tau_db)
    assert readings == 66
    assert 60 < least < 73


@pytest.mark.slow
def test_a_rigid_wall_is_not_the_worst_environment():
    """A wall needs 1.3659 N s/m, a mass of 36 g 1.3769, and any passive environment 1.5160."""
    K, B, theta = 610.0, 0.545, 2
    assert needed(0 * RATE, K, B, theta) == pytest.approx(1.3659, abs=5e-5)
    masses = [needed(1 / (M * RATE), K, B, theta) for M in np.geomspace(0.01, 1, 200)]
    assert max(masses) == pytest.approx(1.3769, abs=5e-5)
    assert np.geomspace(0.01, 1, 200)[np.argmax(masses)] == pytest.approx(0.0357, rel=0.03)  # masses are 2.3 % apart
    assert theorem_4(K, B, theta).max() == pytest.approx(1.5160, abs=5e-5)
    # this-environment gives the same for the mass. Before the wall a coupling without a damper needs (theta + 1/2) K T.
    E = environment(Network(("a",), masses={"a": 0.0357}), T)
    required = this_environment(force_map(E, SpringDamper([K], [B]), [theta], [0]), [1.0]).required[0]
    assert required == pytest.approx(1.3769, abs=5e-5)
    assert needed(0 * RATE, K, 0.0, theta) == pytest.approx((theta + 0.5) * K * T, rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_lossless_environment_attains_theorem_4(seed):
    """A lossless environment q = 1/E-hat attains the damping of Theorem 4 at one frequency and exceeds it at none."""
    rng = np.random.default_rng(seed)
    K, B, theta = np.exp(rng.uniform(4, 9)), np.exp(rng.uniform(-3, 2)), int(rng.integers(0, 4))
    required = theorem_4(K, B, theta)
    k = int(rng.integers(W.size // 10, 9 * W.size // 10))
    inner, angle = 1 / (K / RATE[k] + B), (theta + 1) * W[k]
    reactance = inner.real / np.tan(angle / 2) - inner.imag
    # q is a mass or a spring under the trapezoidal rule, which is lossless at every frequency.
    tangent = (Z - 1) / (Z + 1)
    q = reactance * tangent / tangent[k].imag if reactance > 0 else -reactance * tangent[k].imag / tangent
    assert q[k] == pytest.approx(1j * reactance, rel=1e-6)
    attained = -(Z ** -(theta + 1) / (q + 1 / (K / RATE + B))).real
    assert attained[k] == pytest.approx(required[k], rel=1e-6)
    middle = (W > 1e-2) & (W < 3.1)  # (z-1)/(z+1) loses digits at both ends
    assert (attained <= required * (1 + 1e-6) + 1e-9)[middle].all()


@pytest.mark.parametrize("theta", range(5))
def test_the_moving_average_attains_the_stiffness_limit(theta):
    """V = (T/2 delta)(1 + ... + z^-theta) has the stiffness 2 delta/((theta+1) T) and needs exactly delta."""
    V = moving_average(theta, DELTA)
    assert 1 / V.dc()[0, 0] == pytest.approx(2 * DELTA / ((theta + 1) * T))
    # V needs exactly delta at every frequency: Re[(z-1) V/(Tz)] = (1 - cos n w)/(2 delta)
    spent = (RATE * V.at(Z)[:, 0, 0]).real
    np.testing.assert_allclose(spent, np.sin((theta + 1) * W / 2) ** 2 / DELTA, rtol=0, atol=1e-12)
    softer = V + Lti.constant([[1e-4 * V.dc()[0, 0]]], T)  # strictly within the condition
    assert any_environment(softer, [theta], [DELTA]).certified


def moving_average(theta, delta):
    taps = T / (2 * delta) * np.ones((1, theta))
    first = np.eye(max(theta, 1))[:theta, :1]
    return Lti(np.eye(theta, k=-1), first, taps, [[T / (2 * delta)]], T)


@pytest.mark.slow
def test_no_linear_coupling_exceeds_the_stiffness_limit():
    """A random stable V of one channel needs a damping of at least (theta+1) T / (2 V(1))."""
    rng = np.random.default_rng(4)
    w = np.linspace(0, np.pi, 2001)[1:]
    z = np.exp(1j * w)
    finite, ratios = 0, []
    for _ in range(300):
        theta, order = int(rng.integers(0, 4)), int(rng.integers(0, 5))
        A = rng.normal(size=(order, order))
        if order:
            A *= rng.uniform(0.1, 0.9) / np.abs(np.linalg.eigvals(A)).max()
        near = moving_average(theta, 1.0)
        C = rng.normal(size=(1, order)) * 10 ** rng.uniform(-6, -3)
        V = near + Lti(A, rng.normal(size=(order, 1)), C, [[10 ** rng.uniform(-6, -3)]], T)
        response = V.at(z)[:, 0, 0]
        passivity = ((1 - 1 / z) / T * response).real
        if V.dc()[0, 0] <= 0 or passivity.min() <= 0:
            continue
        required = ((1 - np.cos((theta + 1) * w)) / (2 * passivity)).max()
        finite += 1
        ratios.append(required * V.dc()[0, 0] * 2 / ((theta + 1) * T))
    assert finite > 50
    assert min(ratios) >= 1 - 1e-6


def test_theorem_4_excludes_the_loop_shaping_premise():
    """The premise is sigma_max(E V) << 1. Theorem 4 only admits V with sigma_max(E(1) V(1)) >= 0.8175.

    SOFT has sigma_max(E V) >= 1.13 up to 80 Hz.
    """
    E1 = 800 * 700 / 1500 * np.array([[1, -1], [-1, 1]])
    floor = np.array(THETA) + 1.0
    rng = np.random.default_rng(5)
    least = np.linalg.norm(E1 @ np.diag(floor * T / (2 * DELTA)), 2)
    assert 800 * 700 / 1500 * (floor * T / (2 * DELTA)).sum() == pytest.approx(0.8175, abs=5e-5)
    assert least >= 0.8175
    for _ in range(200):
        root = rng.normal(size=(2, 2)) * 10 ** rng.uniform(-4, -1)
        assert np.linalg.norm(E1 @ (np.diag(floor * T / (2 * DELTA)) + root @ root.T), 2) >= 0.8175 - 1e-9
    hz = np.unique(np.concatenate([np.geomspace(0.01, 80, 4000), np.linspace(6.1, 6.3, 4001)]))  # resonance at 6.2 Hz
    z = np.exp(2j * np.pi * hz * T)
    for coupling, low, high in ((SOFT, 1.130, 11.30), (STIFF, 0.181, 1.782), (PUBLISHED["I"], 0.238, 2.959)):
        V = np.stack([1 / (K + B * (z - 1) / (T * z)) for K, B in zip(coupling.K, coupling.B, strict=True)], axis=1)
        size = np.linalg.norm(figure_4_at(z) * V[:, None, :], 2, axis=(1, 2))
        assert (size.min(), size.max()) == (pytest.approx(low, abs=1e-3), pytest.approx(high, abs=5e-3))


def test_no_storage_excludes_the_static_pole():
    """The eigenvector v of the pole at z = 1 has v'(A'PA - P)v = 0 for every P."""
    E = environment(FIGURE_4, T)
    one = np.eye(2)
    hat = Lti(one, T * one, one, T * one, T) @ E
    values, vectors = np.linalg.eig(hat.A)
    k = int(np.argmin(np.abs(values - 1)))
    assert abs(values[k] - 1) < 1e-9
    v = vectors[:, k]
    for seed in range(20):
        root = np.random.default_rng(seed).normal(size=hat.A.shape)
        P = root @ root.T
        assert abs(v.conj() @ (hat.A.T @ P @ hat.A - P) @ v) < 1e-8 * abs(v.conj() @ P @ v)
    # The Hermitian part of T E(1) z/(z-1) on the circle is the constant T E(1)/2
    np.testing.assert_allclose((1 / (T * RATE)).real, 0.5, rtol=0, atol=1e-12)


def test_unilateral_springs_are_passive_under_backward_euler():
    """f[k] (x[k] - x[k-1]) is at least the increase in potential, also where contact begins or ends."""
    rng, touching = np.random.default_rng(6), 0
    for _ in range(50):
        stiffness, power, wall = np.exp(rng.uniform(0, 8)), rng.uniform(1, 3), rng.normal() * 1e-3
        x = np.cumsum(rng.normal(size=500)) * 1e-3
        depth = np.maximum(x - wall, 0)
        force, potential = stiffness * depth**power, stiffness * depth ** (power + 1) / (power + 1)
        assert (force[1:] * np.diff(x) >= np.diff(potential) - 1e-12 * stiffness).all()
        touching += 0 < (depth > 0).mean() < 1
    assert touching > 25


def test_a_this_environment_guarantee_ends_with_stiffer_springs():
    """Springs 20 % stiffer need 1.516 N s/m instead of 1.363. With a tenfold or tenth mass, DELTA still suffices."""

    def required(factor, mass):
        springs = tuple(Spring(s.between, factor * s.stiffness, s.damping) for s in FIGURE_4.springs)
        E = environment(Network(FIGURE_4.contacts, springs, {"mass": mass}), T)
        return max(this_environment(force_map(E, STIFF, THETA, (0, 0)), (DELTA, DELTA)).required)

    assert required(1.0, 1.0) == pytest.approx(1.3633, abs=5e-5)
    assert required(1.2, 1.0) == pytest.approx(1.5156, abs=5e-5)
    assert required(1.0, 0.1) < DELTA
    assert required(1.0, 10.0) < DELTA


@pytest.mark.validate
def test_clipping_lets_a_certified_loop_swing_forever():
    """A certified loop with lossless hands rests, but may swing at 1.2 Hz for ever if forces are clipped.

    It rests with a damping of 0.1 N s/m in the hands, without limits, or with the limiter.
    """
    hands = (Human((Link(1.2326, 0.0, 34.923),)), Human((Link(0.01999, 0.0, 266.28),)))
    base = load()
    devices = tuple(
        msgspec.structs.replace(d, force_limit=limit) for d, limit in zip(base.device, (12.0, 5.657), strict=True)
    )
    simulation = assemble(base.replace(human=hands, device=devices, tap=None), STIFF)
    starts = np.random.default_rng(0).normal(size=(8, 20)) * np.repeat([0.2, 4.0], 4)[:, None]
    assert dominant_mode(close(simulation.plant, simulation.F)).spectral_radius < 1

    def late(simulation):
        engine = make_engine(simulation, "exact")
        record = driven(
            simulation.process, engine, lambda first, n: np.zeros((n, simulation.scene.outside)), 20_000, starts
        )
        return record.s[-8000:, :2]

    tail = late(simulation)
    caught = np.abs(tail).max(axis=(0, 1)) > 0.1
    assert 0 < caught.sum() < 20
    motion = tail[:, 0, caught][:, 0]
    assert np.abs(motion[:2000]).max() == pytest.approx(np.abs(motion[-2000:]).max(), rel=0.01)
    spectrum = np.abs(np.fft.rfft(motion * np.hanning(motion.size)))
    assert np.fft.rfftfreq(motion.size, T)[spectrum.argmax()] == pytest.approx(1.2, abs=0.1)
    soothed = tuple(Human((msgspec.structs.replace(h.links[0], damping=0.1),)) for h in hands)
    calmer = assemble(base.replace(human=soothed, device=devices, tap=None), STIFF)
    assert np.abs(late(calmer)).max() < 0.01
    unlimited = replace(simulation, process=replace(simulation.process, force_limit=np.full(2, np.inf)))
    assert np.abs(late(unlimited)).max() < 0.01
    # With the limiter instead of clipping, every start comes to rest.
    law = base.loop("I").law(STIFF, (12.0, 5.657), LimitedForces().rho(base.loop("I")))
    limiting = replace(simulation, process=replace(simulation.process, law=law))
    assert np.abs(late(limiting)).max() < 0.01


def test_the_multiplier_block_has_a_schur_complement():
    """The matrix of (14) is positive if and only if Phi < Delta_D and Delta_V > (Phi^-1 - Delta_D^-1)^-1."""
    rng = np.random.default_rng(7)
    outcomes = set()
    for _ in range(300):
        D = np.diag(rng.uniform(0.5, 2, 2))
        root = rng.normal(size=(2, 2)) * 0.6
        Phi = root @ root.T + 1e-3 * np.eye(2)
        extra = rng.normal(size=(2, 2)) * 0.3
        Delta_V = Phi + (extra + extra.T) / 2 + rng.uniform(0, 2) * np.eye(2)
        positive = np.linalg.eigvalsh(np.block([[D - Phi, -Phi], [-Phi, Delta_V - Phi]])).min() > 0
        covered = np.linalg.eigvalsh(D - Phi).min() > 0
        if covered:
            price = np.linalg.inv(np.linalg.inv(Phi) - np.linalg.inv(D))
            covered = np.linalg.eigvalsh(Delta_V - price).min() > 0
        assert positive == covered
        outcomes.add(positive)
    assert outcomes == {True, False}


def test_one_sample_of_psi_exceeds_the_damping():
    """With psi = 1 the largest eigenvalue of -He E-hat reaches 1.479 N s/m, so no Phi below DELTA exists."""
    hat = figure_4_at(Z) * (Z**-1 / RATE)[:, None, None]
    least = -np.linalg.eigvalsh((hat + np.conj(np.swapaxes(hat, 1, 2))) / 2)[:, 0]
    assert least.max() == pytest.approx(1.479, abs=5e-4)
    with pytest.raises(Infeasible, match=r"1\.479"):
        least_multiplier(Loop(T, (0, 0), (1, 1), (0, 0), (DELTA, DELTA), FIGURE_4))


@pytest.mark.parametrize("unused", [5e-7, 1e-8])
def test_delayed_spring_that_uses_all_damping_is_refused(unused):
    """A spring of K N/m behind a delay of one sample uses K T/2 N s/m of the damping; Phi needs a margin above it."""
    spring = Network(("a",), (Spring(("a", "ground"), 2000 * (1 - unused)),))
    needs = ANY_ENVIRONMENT.judge(Loop(1e-3, (0,), (1,), (0,), (1.0,), spring), SpringDamper((50.0,), (0.1,)))
    assert not needs.certified
    assert "not below the damping" in needs.shortfall


def test_no_convex_step_increases_the_norm():
    """The tangent lies below the convex term that it replaces, so at fixed frequencies no step increases the norm."""
    shaping = Shaping(Loop(T, THETA, (0, 0), (1, 2), (DELTA, DELTA), FIGURE_4))
    w = np.concatenate([np.geomspace(1e-3, 3, 20), [0.0465]])  # 0.0465: the resonance at 6.17 Hz
    gains = np.array([0.1, 0.1, 0.4, 0.4])
    norms = []
    for _ in range(5):
        k, b = np.split(np.maximum(gains, 0) * np.tile(shaping.usable, 2), 2)
        norms.append(shaping.gain(SpringDamper(k / T, b).compliance(T), w).max())
        gains, bound = _step(shaping, _GainSet(shaping.loop), gains, norms[-1], w)
        assert bound <= norms[-1] * (1 + 1e-6)
    assert all(after <= before * (1 + 1e-6) for before, after in itertools.pairwise(norms))
    assert norms[-1] < 0.8 * norms[0]


class Resonant(Environment):
    """E = H (1 - 1/z), where H is 500 plus a pair of poles. E may supply power in a band of some 1e-6 rad/sample."""

    contacts = ("tip",)

    def __init__(self, size: float, angle: float) -> None:
        self.size, self.angle = size, angle

    def E(self, T):
        p, r = (1 - 1e-6) * np.exp(1.2j), self.size * np.exp(1j * self.angle)
        A = np.array([[p.real, -p.imag], [p.imag, p.real]])
        C = 2 * np.array([[r.real, -r.imag]])
        A, B, C, D = (numbers(part, T) for part in (A, A[:, :1], C, np.array([[500.0 + 2 * r.real]])))
        step = Lti(*(numbers(np.array([[n]]), T) for n in (0.0, 1.0, -1.0, 1.0)), T)
        return Lti(A, B, C, D, T) @ step


def test_active_environments_get_no_any_environment_guarantee():
    """A narrow active resonance is not certified for every environment; a passive resonance of the same width is."""
    coupling = SpringDamper([900.0], [0.6])
    for size, angle, passive in ((1.5, 1.536, False), (-0.2, 0.0, False), (1e-4, 0.0, True)):
        loop = Loop(1e-3, (0,), (0,), (0,), (1.37,), Resonant(size, angle))
        assessment = assess(loop, coupling)
        needs = assessment.requirements["any-environment"]
        if passive:
            assert needs.certified
        else:
            assert not needs.certified
            assert "Resonant: not passive" in needs.reason
            assert assessment.guarantee is None or not assessment.guarantee.any_environment


def test_a_multiplier_covers_narrow_resonances():
    """A sufficient Phi exceeds the narrow peak that a dense sweep finds around the pole of a mass between springs."""
    network = Network(("tip",), (Spring(("tip", "m"), 300.0, 0.0), Spring(("m", GROUND), 50.0, 1e-4)), {"m": 0.2})
    E = environment(network, 1e-3)
    pole = max(E.poles(), key=lambda p: abs(p.imag))
    w = abs(np.angle(pole)) + (1 - abs(pole)) * np.linspace(-30, 30, 20_001)
    w = np.concatenate([w, W])
    z = np.exp(1j * w)
    least = float(np.max(-(1e-3 * z / (z - 1) / z * E.at(z)[:, 0, 0]).real))
    loop = Loop(1e-3, (0,), (1,), (0,), (2 * least,), network)
    assert covers(loop, (1.001 * least,))
    assert not covers(loop, (0.999 * least,))


def test_a_guarantee_over_ranges_names_its_vertices():
    """Between the vertices a search supports the guarantee, not a proof."""
    scenario = load("omega-pair-ranges")
    delays = scenario.loop("I").delays
    guarantee = Guarantee("this-environment", "rational", (), "every passive hand", RANGES, "", delays, 1e-3)
    assert "proved at every vertex, searched between them" in guarantee.words
    half = replace(guarantee, vertices="128 of 256 vertices").words
    assert half == "these ranges: proved at 128 of 256 vertices, searched between them"
