"""Tests of the spring-damper designs: known optima, independence of the start, the exact gain set, and refusals."""

import re
from functools import cache

import cvxpy as cp
import msgspec
import numpy as np
import pytest
import scipy
from analysis import analysis, solve
from evaluate import any_environment, this_environment
from scipy.optimize import brentq, minimize, rosen, rosen_der
from shared import DELTA, SOFT_NETWORK, T, force_map, pair

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Environment, Network, Spring
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti
from haptic_loop.design import conditions, gain_search, spring_damper
from haptic_loop.design.api import instead, transparency_of
from haptic_loop.design.designs import design_by_kind
from haptic_loop.design.frequency import hermitian, least_eigenpair
from haptic_loop.design.gain_search import LimiterLoop, SampledLoop, SwitchingLoop
from haptic_loop.design.lmi import RESERVE, Shaping
from haptic_loop.design.result import DesignFailed, Infeasible
from haptic_loop.design.spring_damper import _GainSet, design
from haptic_loop.design.transparency import decibels
from haptic_loop.sim.scenario import load

CASES = {"I": (1, 2), "II": (0, 0)}
WALL = Network(("c",), (Spring(("c", "ground"), 100.0),))


def random_starts(count, seed=0):
    rng = np.random.default_rng(seed)
    return [SpringDamper(np.exp(rng.uniform(3, 9, 2)), np.exp(rng.uniform(-4, 3, 2))) for _ in range(count)]


@pytest.mark.parametrize(("case", "norm"), [("I", 11.248), ("II", 11.318)])
def test_the_known_optimum_is_reached(case, norm):
    optimum = design(pair(CASES[case]))
    # Without the reserve K would be (878.86, 551.94) N/m; the reserve costs 0.01 %.
    np.testing.assert_allclose(optimum.coupling.K, np.array([878.86, 551.94]) * (1 - RESERVE), rtol=2e-5)
    np.testing.assert_allclose(optimum.coupling.B, [0.3865, 0.5220], rtol=1e-3)
    assert optimum.objective == pytest.approx(norm, rel=2e-4)
    assert optimum.requirement.ratio == pytest.approx(1 - RESERVE, abs=1e-6)
    assert optimum.requirement.certified


@pytest.mark.parametrize("condition", ["any-environment", "this-environment"])
def test_dampers_that_cost_stiffness_are_zero(condition):
    """Without delay Colgate's KT/2 + B <= delta makes every damper cost stiffness, so B = 0 is best at a stiff wall."""
    wall = Network(("c",), (Spring(("c", "ground"), 1e4),))
    optimum = design(pair((0,), wall, (0,), (0,), (0.5,)), condition, limiter=False)
    assert optimum.coupling.B[0] == 0.0
    assert optimum.requirement.certified


def test_the_objective_is_the_returned_norm():
    loop = pair()
    optimum = design(loop)
    V = optimum.coupling.compliance(T)
    z = np.exp(1j * np.linspace(0.0455, 0.0475, 4001))  # the resonance at 6.17 Hz
    E = loop.E().at(z)
    L = np.eye(2) + E @ V.at(z) - (delay((1, 2), T).at(z) @ np.linalg.inv(delay((1, 2), T).at(z)))
    a = 2 * np.pi * 80 * T
    w = a / (a + 1 - 1 / z)
    by_hand = (np.abs(w) * np.linalg.norm(L, 2, axis=(1, 2))).max()
    assert optimum.objective == pytest.approx(by_hand, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("draws", [60, pytest.param(200, marks=pytest.mark.validate)])
@pytest.mark.parametrize("case", [pytest.param("I", marks=pytest.mark.validate), "II"])
def test_no_certified_gains_do_better(case, draws):
    loop = pair(CASES[case])
    best = design(loop)
    shaping = Shaping(loop)
    rng = np.random.default_rng(5)
    tried = 0
    for _ in range(draws):
        gains = SpringDamper(rng.uniform(300, [1000, 700]), rng.uniform(0, 1, 2))
        V = gains.compliance(T)
        if any_environment(V, loop.theta, DELTA).certified:
            tried += 1
            assert shaping.norm(V)[0] > best.objective
    assert tried > 10


def test_designs_solve_at_most_four_convex_problems():
    """tests/benchmarks/test_design_cost.py measures the seconds."""
    assert design(pair()).sdps <= 4


def stiffest(loop):
    """Return the gains of largest total stiffness, and so of the largest stiffness in each channel."""
    gains = _GainSet(loop).solve(np.repeat([-1.0, 0.0], loop.channels), "a test")
    return spring_damper._coupling(loop, gains)


def stiffest_at(B, theta, delta, T):
    """Return the largest K that the sweep of any_environment accepts for B and delta less the reserve of a design."""
    usable = (1 - RESERVE) * delta
    return brentq(
        lambda K: any_environment(SpringDamper([K], [B]).compliance(T), [theta], [usable]).ratio - 1, 1.0, 1e5
    )


@pytest.mark.parametrize(("theta", "K"), list(enumerate([2283.0, 878.86, 551.94, 405.1, 320.8])))
def test_each_delay_allows_its_known_stiffness(theta, K):
    gains = stiffest(pair((0,), WALL, (theta,), (0,), (1.37,)))
    assert pytest.approx(K * (1 - RESERVE), rel=2e-4) == gains.K
    # A root search on the condition gives the same K for this B.
    assert stiffest_at(float(gains.B[0]), theta, 1.37, T) == pytest.approx(gains.K[0], rel=1e-5)


def test_the_stiffness_scales_with_damping_and_rate():
    one = stiffest_at(0.1, 2, 1.0, 1e-3)
    assert stiffest_at(0.2, 2, 2.0, 5e-4) == pytest.approx(4 * one, rel=1e-5)


@cache
def gains_of_least(cost, theta, sigma):
    """Return the least cost of (k, b) in the set (e) of docs/theory.md, by cvxpy with cones at 2001 frequencies.

    With a multiplier phi, sigma = 1/phi - 1 is finite and adds a second square.
    """
    k, b = cp.Variable(), cp.Variable()
    w = np.linspace(0, np.pi, 2001)
    of_k = sum(np.exp(-1j * w * j) for j in range(theta + 1))
    of_b = 1 - np.exp(-1j * w * (theta + 1))
    rows = [part * k + other * b for part, other in ((of_k.real, of_b.real), (of_k.imag, of_b.imag))]
    if np.isfinite(sigma):
        rows += [(2 * (i == 0) - row) / np.sqrt(sigma) for i, row in enumerate(rows)]
    room = (k / 2 + b) * np.ones(w.size)
    cones = cp.SOC(room + 1, cp.vstack([*rows, room - 1]), axis=0)  # |(2c, r - 1)| <= r + 1 is |c|^2 <= r
    return solve(cp.Problem(cp.Minimize(cost[0] * k + cost[1] * b), [cones, k >= 0, b >= 0]))


@pytest.mark.parametrize(
    ("theta", "sigma", "most_stored"),
    [
        *((0, np.inf, 1000), (7, 3.0, 1000), (7, 3.0, 0)),
        *(pytest.param(12, np.inf, stored, marks=pytest.mark.validate) for stored in (1000, 0)),
    ],
)
def test_the_gain_set_is_exact(theta, sigma, most_stored):
    """The least costs are those of cvxpy, from one matrix inequality or, if most_stored = 0, from many frequencies.

    Between these frequencies the condition may fail by `_MISSED`.
    """
    loop = pair((0,), WALL, (theta,), (0,), (1 / (1 - RESERVE),), 1.0)
    certified = _GainSet(loop, None if np.isinf(sigma) else np.array([1 / (1 + sigma)]), most_stored)
    for cost in ((-1.0, -0.2), (-0.2, -1.0), (-1.0, 1.0)):
        gains = certified.solve(np.array(cost), "a test")
        assert np.dot(cost, gains) == pytest.approx(gains_of_least(cost, theta, sigma), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("phi", [0.0, 0.3])
@pytest.mark.parametrize("theta", [0, 1, 4])
def test_the_gain_set_equals_its_block(theta, phi):
    """The search keeps k/2 + b - |c|^2 positive, where `rows` gives c. For V = 1/W it is |W|^2 times the block's value.

    The block is that of any-environment. With phi > 0 its value is the Schur complement of the row of the multiplier.
    """
    loop = Loop(1.0, (theta,), (0,), (0,), (1 / (1 - RESERVE),), WALL)
    unit, z = loop.channel(0).at(WALL), np.exp(1j * np.linspace(1e-3, np.pi, 50))[None]
    unit = msgspec.structs.replace(unit, delta=(1.0,))
    for k, b in np.random.default_rng(theta).uniform(0.05, 2, (5, 2)):
        (channel,) = _GainSet(loop, np.array([phi]) if phi else None).channels
        V = SpringDamper([k], [b]).sampled(z, 1.0)
        demand = conditions.any_environment_demand(V, unit, [phi])
        block = hermitian((demand.free + demand.gain).G[0])
        block_value = block[:, 0, 0].real - (np.abs(block[:, 1, 0]) ** 2 / block[:, 1, 1].real if phi else 0)
        room = k / 2 + b - (np.abs(channel.rows(np.array([k, b])).at(z[0])) ** 2).sum(axis=(1, 2))
        np.testing.assert_allclose(room, block_value / np.abs(V.G[0, :, 0, 0]) ** 2, rtol=1e-8, atol=1e-9)


def test_unlike_channels_are_as_stiff_as_alone():
    springs = tuple(Spring((name, "m"), k, 1.0) for name, k in (("a", 800.0), ("b", 700.0), ("c", 300.0)))
    network = Network(("a", "b", "c"), (*springs, Spring(("m", "ground"), 100.0, 0.1)), {"m": 1.0})
    loop = pair((0, 3, 1), network, (0, 3, 1), (0, 0, 0), (2.0, 0.8, 1.37), 1e-3)
    optimum = design(loop)
    alone = [
        stiffest_at(float(b), n, d, 1e-3) for b, n, d in zip(optimum.coupling.B, loop.theta, loop.delta, strict=True)
    ]
    np.testing.assert_allclose(optimum.coupling.K, alone, rtol=1e-4)


@pytest.mark.parametrize("psi", [(1, 1), (1, 0), (0, 2)])
def test_designs_for_delayed_environments_are_certified(psi):
    loop = pair((0, 0), SOFT_NETWORK, psi=psi)
    optimum = design(loop)
    V = optimum.coupling.compliance(T)
    assert optimum.requirement.certified
    assert optimum.phi.max() < 1.37
    # Two checks that the design does not use: the LMI over every multiplier, and this-environment.
    assert analysis(V, loop.E(), loop.theta, psi, DELTA).feasible
    assert this_environment(force_map(loop.E(), optimum.coupling, loop.theta, psi), DELTA).certified


def test_zero_multiplier_gives_the_plain_condition():
    for gains in random_starts(4, seed=4):
        V = gains.compliance(T)
        plain = any_environment(V, (1, 2), DELTA)
        same = conditions.any_environment(V, pair(), np.zeros(2))
        assert same.ratio == pytest.approx(plain.ratio, rel=1e-6)


@pytest.mark.parametrize(("case", "rms_db"), [("I", -10.98), ("II", -7.99)])
def test_this_environment_designs_exceed_any_environments_stiffness(case, rms_db):
    loop = pair(CASES[case])
    optimum = design(loop, "this-environment", limiter=False)
    assert 20 * np.log10(optimum.objective) <= rms_db
    assert optimum.requirement.condition == "this-environment"
    assert optimum.requirement.ratio <= 1 - RESERVE
    assert optimum.coupling.K.min() > 2500
    assert not any_environment(optimum.coupling.compliance(T), loop.theta, DELTA).certified


def test_this_environment_designs_stabilise_delayed_environments():
    """An almost rigid coupling would need more than the available damping."""
    held = Network(("c",), (Spring(("c", "m"), 800.0, 1.0), Spring(("m", "ground"), 700.0, 1.0)), {"m": 1.0})
    loop = pair((0,), held, (2,), (1,), (2.0,))
    optimum = design(loop, "this-environment", limiter=False)
    assert optimum.requirement.ratio <= 1 - RESERVE
    rigid = force_map(loop.E(), SpringDamper([1e6], [0.0]), loop.theta, loop.psi)
    assert this_environment(rigid, loop.delta).ratio > 1
    assert force_map(loop.E(), optimum.coupling, loop.theta, loop.psi).is_stable()


@pytest.mark.slow
def test_failed_searches_claim_no_impossibility():
    with pytest.raises(DesignFailed, match="no spring-damper was found") as caught:
        design(pair((0, 0), psi=(1, 1), delta=(0.5, 0.5)), "this-environment", limiter=False)
    assert not isinstance(caught.value, Infeasible)


@pytest.mark.validate
def test_proposed_changes_are_certified():
    """Each proposed design is certified by a sweep. The least error comes first, and none is the failed request."""
    loop = pair((0, 0), psi=(1, 1))
    words = instead(loop, "spring-damper", "any-environment")
    proposed = re.findall(r"--coupling (\S+) --condition (\S+) \((\S+) dB rms\)", words)
    assert ("optimal", "this-environment") in [(kind, condition) for kind, condition, _ in proposed]
    assert ("spring-damper", "any-environment") not in [(kind, condition) for kind, condition, _ in proposed]
    errors = [float(error) for _, _, error in proposed]
    assert errors == sorted(errors)
    for kind, condition, error in proposed:
        proposal = design_by_kind(loop, kind, condition, **({"bases": ((4, 3), (8, 6))} if kind == "optimal" else {}))
        assert proposal.requirement.certified
        assert decibels(transparency_of(loop, proposal).rms_mismatch) < float(error) + 0.01


REFUSALS = [
    ({"psi": (1, 1), "lam": (0, 0)}, r"admits no coupling: with psi = \(1, 1\).*uses up 1.479"),
    ({"lam": (2, 2)}, r"lam is \[2, 2\], expected at most theta \+ psi"),
    ({"delta": (1.37, 0.0)}, "delta, the damping of devices, is .*expected positive"),
    ({"delta": (1.37,)}, "delta has 1 entries, the environment has 2 contacts"),
    ({"theta": (1,)}, "theta has 1 entries, the environment has 2 contacts"),
    ({"theta": (1.5, 2)}, "theta is .*whole numbers"),
    ({"psi": (0, -1)}, "psi is .*whole numbers"),
]


@pytest.mark.parametrize(("change", "message"), REFUSALS)
def test_a_bad_request_gets_one_line(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        design(pair(**change))
    assert "\n" not in str(caught.value)


class Late(Environment):
    contacts = ("tip",)

    def E(self, T):
        return Lti.constant([[100.0]], T) @ delay([1], T)


def test_an_active_environment_is_refused():
    with pytest.raises(ValueError, match=r"environment Late: not passive.*at .* Hz"):
        Shaping(Loop(T, (0,), (0,), (0,), (1.0,), Late()))


def test_an_unknown_condition_is_refused():
    with pytest.raises(ValueError, match=r"condition is 'both'.*any-environment, this-environment"):
        design(pair(), "both")


def test_long_delay_designs_pass_a_dense_sweep():
    """With 50 samples of delay (e) of docs/theory.md holds at 40001 frequencies, 1560 per ripple of its left side."""
    gains = stiffest(pair((0,), WALL, (50,), (0,), (1.37,)))
    z, n = np.exp(1j * np.linspace(0, np.pi, 40_001)), 51
    (K,), (B,) = gains.K, gains.B
    y = K * T * np.polyval(np.ones(n), 1 / z) + B * (1 - z**-n)
    needed = (np.abs(y) ** 2).max() / (4 * (K * T / 2 + B))
    assert 0.9997 * 1.37 < needed < 1.37
    # No linear law is stiffer than 2 delta/(n T), and this design exceeds half of that.
    assert 1.37 / (n * T) < K < 2 * 1.37 / (n * T)


def switching_loop(loop):
    return SwitchingLoop(loop.switching(DelayRange((0, 2), (1, 2))))


@pytest.mark.parametrize("sampled", [SampledLoop, LimiterLoop, switching_loop])
@pytest.mark.parametrize("psi", [(0, 0), (1, 0)])
def test_slopes_match_finite_differences(sampled, psi):
    """Slopes by hand differ from central differences by 1e-8 at most, one-sided differences of the poles by 3e-7."""
    at = sampled(load().replace(psi=psi).loop("I"))
    x = np.array([6.5, 6.1, 0.3, 0.45, *(-0.7, 0.6)[: at.active.size]])
    x[4:] = np.abs(x[4:]) if sampled is LimiterLoop else x[4:]
    steps = 1e-6 * np.eye(x.size)
    differenced = np.stack([(at.room(x + h) - at.room(x - h)) / 2e-6 for h in steps], axis=1)
    np.testing.assert_allclose(at.room_slope(x), differenced, rtol=0, atol=1e-6)


def test_designs_that_take_minutes_are_refused_early():
    names = tuple(f"c{i}" for i in range(49))
    springs = tuple(Spring((name, "ground"), 300.0) for name in names)
    many = Loop(T, *[(0,) * 49] * 3, (1.0,) * 49, Network(names, springs))
    with pytest.raises(DesignFailed, match=r"49 channels.*48"):
        design(many, "any-environment")
    with pytest.raises(DesignFailed, match=r"49 channels.*32 for a spring-damper by the limiter"):
        design(many, "this-environment", limiter=True)
    four = Network(names[:4], springs[:4])
    late = Loop(T, (0,) * 4, (100,) * 4, (0,) * 4, (1.0,) * 4, four)
    with pytest.raises(DesignFailed, match="some 150 sweeps over 404 states and 4 channels would take about"):
        design(late, "this-environment")


@pytest.mark.slow
def test_one_start_comes_close_to_all_starts(monkeypatch):
    """Above FEW channels the search has one start. Rounding gains to five digits changes the objective by 4e-6."""
    usual = design(pair(CASES["I"]), "this-environment", limiter=True).objective
    monkeypatch.setattr(spring_damper, "FEW", 1)
    monkeypatch.setattr(gain_search, "FEW", 1)
    optimum = design(pair(CASES["I"]), "this-environment", limiter=True)
    assert optimum.requirement.certified
    assert optimum.objective == pytest.approx(usual, rel=1e-4)
    assert all(float(f"{gain:.5g}") == gain for gain in (*optimum.coupling.K, *optimum.coupling.B))


def test_no_limiter_search_follows_a_failed_linear_search() -> None:
    """Where no coupling is certified for unlimited forces, no search is spent on limited forces."""
    loop, limited = pair((0,), WALL, (1,), (1,), (1e-3,)), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(spring_damper, "LimiterLoop", lambda *args: limited.append(args))
        with pytest.raises(DesignFailed, match="this-environment condition certifies for theta"):
            design(loop, "this-environment")
    assert not limited


@pytest.mark.parametrize("steps", [7, 100])
@pytest.mark.parametrize("release", [scipy.__version__, "1.15.0"])
def test_slsqp_equals_that_of_scipy(monkeypatch, release, steps):
    """`_slsqp` and SciPy minimise Rosenbrock's function in a disc to the same bits, also when 7 steps are too few."""
    disc = {"type": "ineq", "fun": lambda x: [2 - x @ x], "jac": lambda x: [-2 * x]}
    bounds, options = [(-1.5, 0.9)] * 2, {"maxiter": steps, "ftol": 1e-7}
    start = [-1.6, 1.0]  # outside the bounds
    public = minimize(rosen, start, jac=rosen_der, method="SLSQP", bounds=bounds, constraints=disc, options=options)
    assert public.success is (steps > 7)
    monkeypatch.setattr(scipy, "__version__", release)
    own = gain_search._slsqp(rosen, rosen_der, disc["fun"], disc["jac"], start, bounds, steps)
    assert own.tolist() == public.x.tolist()


@pytest.mark.parametrize("rows", [1, 2, 3, 15])
def test_the_least_eigenpair_solves_its_equation(rows):
    """Each pair solves H v = lambda v, and lambda is the least eigenvalue, also for a multiple of the identity."""
    rng = np.random.default_rng(rows)
    parts = rng.normal(size=(40, rows, rows)) + 1j * rng.normal(size=(40, rows, rows))
    H = hermitian(parts)
    H[:2] = 3 * np.eye(rows), np.diag(np.arange(rows, 0, -1.0))
    values, vectors = least_eigenpair(H)
    # LAPACK and the closed form round to a few units of 1e-16 of the largest entry, which is below 16 here.
    np.testing.assert_allclose(values, np.linalg.eigvalsh(H)[:, 0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=0, atol=1e-13)
    residual = np.einsum("kij,kj->ki", H, vectors) - values[:, None] * vectors
    # For 15 rows a step of inverse iteration leaves 1e-13 of the largest entry, divided by the start's component
    # along the vector.
    assert np.abs(residual).max() < (1e-12 if rows < 15 else 1e-10)
