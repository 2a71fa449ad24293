"""Tests of the condition for varying delays: closed forms, a convex solver, the energy over time, exact proofs."""

import json

import cvxpy as cp
import numpy as np
import pytest
from analysis import solve
from evaluate import summed, switching_demand, switching_sweep, this_environment
from shared import DELTA, FIGURE_4, SOFT, STIFF, T, force_map, undelayed_map

from haptic_loop.cli.audit import main
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, environment
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Lti, Sampled
from haptic_loop.design import budgets
from haptic_loop.design.certificate import judged, prove, required_damping
from haptic_loop.design.coverage import SwitchingFigures
from haptic_loop.design.environments import SWITCHING
from haptic_loop.design.exact import find_storage
from haptic_loop.design.frequency import hermitian
from haptic_loop.design.result import NotProved
from haptic_loop.sim.scenario import InputError


def loop_of(lo, hi, delta=DELTA, network=FIGURE_4) -> Loop:
    return Loop(T, lo, (0,) * len(lo), lo, delta, network, varying_delay=DelayRange(lo, hi))


def condition(z, G, alpha, lo, hi, damping, T=T):
    """Return the condition's matrix, which must be positive, at each z (k,); a delay that varies has a second row."""
    demand = switching_demand(Sampled(z[None], G[None], T), lo, hi, damping, alpha)
    return hermitian(summed(demand).G[0])


def block(z, G, alpha, lo, hi, damping):
    """Return the condition's matrix for cvxpy at one z, affine in G (m, m), alpha (m,) and damping (m,) [N s/m]."""
    c, h = (z ** -np.array(lo) + z ** -np.array(hi)) / 2 / (z - 1), np.subtract(hi, lo) / 2
    passing, error = cp.diag(cp.Constant(c)) @ G, cp.diag(cp.Constant(h)) @ G
    upper = (passing + cp.conj(passing).T) / 2 + cp.diag(damping / T - alpha / 2)
    return cp.bmat([[upper, cp.conj(error).T], [error, cp.diag(2 * alpha)]])


@pytest.mark.parametrize(("lo", "hi"), [(0, 0), (0, 1), (1, 2), (0, 3), (2, 5)])
def test_springs_need_the_damping_of_their_longest_delay(lo, hi):
    """The mean delay needs KT (lo + hi + 1)/2, and deviations by h = (hi - lo)/2 need T (alpha/2 + (hK)^2/(2 alpha)).

    The least sum is KT (hi + 1/2), as for the constant delay hi: for a spring, varying delays cost nothing more.
    """
    K = 800.0
    requirement = switching_sweep(Lti.constant([[K]], T), [lo], [hi], [1.37])
    assert requirement.required[0] == pytest.approx(K * T * (hi + 0.5), rel=1e-6)  # 2 _SETTLED, where the search ends
    assert requirement.multiplier[0] == pytest.approx(
        K * (hi - lo) / 2, rel=1e-2, abs=1e-9
    )  # the need is flat in alpha


@pytest.mark.parametrize("theta", [(1, 2), (0, 3)])
def test_one_delay_gives_the_this_environment_condition(theta):
    F = force_map(environment(FIGURE_4, T), STIFF, theta, (0, 0))
    requirement = switching_sweep(undelayed_map(STIFF), theta, theta, DELTA)
    assert requirement.required == pytest.approx(this_environment(F, DELTA).required, rel=1e-12)
    assert requirement.frequency_hz == pytest.approx(this_environment(F, DELTA).frequency_hz, rel=1e-4)


def test_the_least_factor_matches_a_convex_solver():
    """An SDP in (s, alpha) at 13 frequencies, which shares no code with the sweep, has the same least factor."""
    lo, hi = (0, 1), (3, 2)
    G, delta = undelayed_map(STIFF), np.array([1.37, 0.9])
    requirement = switching_sweep(G, lo, hi, delta)
    per_hz = 2 * np.pi * T
    near = requirement.frequency_hz * per_hz * np.linspace(0.98, 1.02, 5)
    w = np.concatenate([near, np.geomspace(3e-2, 3, 8)])
    z = np.exp(1j * w)
    s, a = cp.Variable(), cp.Variable(2, nonneg=True)  # alpha and G are in units of 1000 N/m
    scale = 1000.0
    conditions = [
        block(complex(v), cp.Constant(g / scale), a, lo, hi, s * delta * (1 / scale))
        for v, g in zip(z, G.at(z), strict=True)
    ]
    problem = cp.Problem(cp.Minimize(s), [c + 0j >> 0 for c in conditions])
    solve(problem)
    assert s.value == pytest.approx(requirement.ratio, rel=2e-4)  # the binding frequency is among the samples
    np.testing.assert_allclose(
        conditions[0].value,
        condition(z[:1], G.at(z[:1]) / scale, a.value, lo, hi, s.value * delta / scale)[0],
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize(("lo", "hi"), [((1, 1), (2, 2)), ((0, 2), (3, 2))])
def test_a_dense_sweep_gives_the_same_requirement(lo, hi):
    """At 20000 frequencies the condition holds 1e-5 above the requirement, and fails 0.1 % below it."""
    G, requirement = undelayed_map(STIFF), switching_sweep(undelayed_map(STIFF), lo, hi, DELTA)
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 20_000))
    alpha, needed, response = np.array(requirement.multiplier), np.array(requirement.required), G.at(z)

    def least(share):
        return np.linalg.eigvalsh(condition(z, response, alpha, lo, hi, share * needed)).min()

    assert least(1 + 1e-5) > 0
    assert least(1 - 1e-3) < 0
    assert requirement.bound == pytest.approx(requirement.ratio, rel=1e-5)


def test_the_energy_bound_holds_for_worst_ages():
    """Over time sum f'dx + sum dx'(Delta/T)dx > 0 from rest, with the worst age at every tick."""
    G, lo, hi = undelayed_map(STIFF), 1, 3
    needed = np.array(switching_sweep(G, (lo, lo), (hi, hi), DELTA).required)
    rng, ticks = np.random.default_rng(0), 3000
    w = 2 * np.pi * T * switching_sweep(G, (lo, lo), (hi, hi), DELTA).frequency_hz
    motions = []
    for trial in range(12):
        x = np.sin(w * rng.uniform(0.6, 1.4) * np.arange(ticks)[:, None] + rng.uniform(0, 6, 2)) * rng.normal(size=2)
        if trial % 3 == 0:
            x = np.cumsum(rng.normal(size=(ticks, 2)), axis=0)
        motions.append(x)
    x = np.stack(motions, axis=2)  # (ticks, channels, motions)
    x[0] = 0.0
    g, state = np.zeros((ticks + hi, 2, 12)), np.zeros((G.order, 12))
    for k in range(ticks):  # g[k + hi] leaves at tick k; before tick 0 no force has left
        g[k + hi] = G.C @ state + G.D @ x[k]
        state = G.A @ state + G.B @ x[k]
    dx = np.diff(x, axis=0)
    choices = np.stack([g[hi - n :][: ticks - 1] * dx for n in range(lo, hi + 1)])
    stored = choices.min(axis=0).sum(axis=1)
    spent = (dx**2 * (needed / T)[:, None]).sum(axis=1)
    spare = (np.cumsum(stored + spent, axis=0) / np.cumsum(spent, axis=0))[10:]
    assert spare.min() > 0
    assert spare.min() < 0.6  # One motion uses over two fifths of the damping: 0.85 of it when measured.


def test_unsafe_or_malformed_switching_is_refused():
    floating = switching_sweep(undelayed_map(NoCoupling()), (1, 1), (2, 2), DELTA)
    assert (
        floating.ratio
        > this_environment(force_map(environment(FIGURE_4, T), NoCoupling(), (2, 2), (0, 0)), DELTA).ratio
    )
    unstable = Lti([[1.1]], [[1.0]], [[1.0]], [[1.0]], T)
    requirement = switching_sweep(unstable, [1], [2], [1.0])
    assert not requirement.certified
    assert "pole" in requirement.reason
    with pytest.raises(ValueError, match="lo <= hi"):
        switching_sweep(undelayed_map(STIFF), (2, 2), (1, 1), DELTA)
    with pytest.raises(ValueError, match="has 1 entries"):
        switching_sweep(undelayed_map(STIFF), (1,), (2,), DELTA)


@pytest.mark.parametrize(("lo", "hi"), [((1, 1), (2, 2)), ((1, 1), (1, 3)), ((1, 2), (1, 2))])
def test_certified_switching_is_proved_exactly(lo, hi):
    requirement = judged(loop_of(lo, hi), SOFT, SWITCHING)
    assert requirement.certified
    assert requirement.proof == "rational"
    part = SwitchingFigures.of(loop_of(lo, hi), SOFT)
    # The two are equal where no delay varies.
    assert part.playout.required_damping[0] <= part.requirement.required[0] * (1 + 1e-9)
    assert part.requirement.certified


def test_uncertified_switching_has_no_exact_proof():
    loop = loop_of((1, 1), (2, 2))
    requirement = judged(loop, STIFF, SWITCHING)
    assert not requirement.certified
    assert requirement.proof == "sampled"
    with pytest.raises(NotProved, match=r"needs 2\.041"):
        prove(loop, STIFF, "this-environment")

    def storage(loop: Loop):
        return find_storage(summed(SWITCHING.exact_demands(loop, STIFF, requirement.multiplier)["P"]))

    assert "violated" in storage(loop)[1]
    required = np.array(requirement.required)
    more, less = (loop_of((1, 1), (2, 2), tuple((required * f).tolist())) for f in (1 + 1e-4, 1 - 1e-4))
    assert storage(more)[0] is not None
    assert storage(less)[0] is None


def test_a_damped_wall_needs_each_constant_delays_damping():
    """A wall with delays of 0 to 1 samples needs at least the damping of each constant delay."""
    wall = Network(("a",), (Spring(("a", GROUND), 2000.0, 1.0),))
    G = environment(wall, T)
    needs = switching_sweep(G, [0], [1], [1.37]).required[0]
    constant = [this_environment(force_map(G, NoCoupling(), [n], [0]), [1.37]).required[0] for n in (0, 1)]
    assert constant[0] == pytest.approx(2000 * T / 2 + 1)
    assert needs >= max(constant) * (1 - 1e-6)


def audit(tmp_path, *options):
    code = main([*options, "--out", str(tmp_path), "--json", str(tmp_path / "a.json")])
    return code, json.loads((tmp_path / "a.json").read_text())


@pytest.mark.validate
def test_audit_reports_switching_beside_constant_delays(tmp_path):
    code, report = audit(tmp_path, "--K", "7806,3137", "--B", "0.105,1.68", "--varying-delay", "1,2")
    assert code == 1  # certified for the constant (1, 2), not for switching
    assert report["assessment"]["requirements"]["this-environment"]["certified"]
    assert report["switching"]["required_damping"] == pytest.approx([2.0413] * 2, rel=1e-4)
    assert report["switching"]["playout"]["required_damping"] == pytest.approx([1.7022] * 2, rel=1e-4)
    code, report = audit(tmp_path, "--K", "879,552", "--B", "0.39,0.52", "--varying-delay", "1-2,1-2")
    assert code == 0
    assert report["switching"]["proof"] == "rational"


def test_audits_of_springs_need_the_closed_form(tmp_path):
    """A spring of 800 N/m at 1 ms with delays of 0 to 1 samples needs KT (hi + 1/2)."""
    options = ["--rigid", "--K", "800", "--B", "0", "--T", "1e-3", "--theta", "1", "--delta", "1.37"]
    code, report = audit(tmp_path, *options, "--varying-delay", "0,1")
    assert code == 0
    assert report["switching"]["required_damping"] == pytest.approx([1.2], rel=1e-6)  # 2 _SETTLED, the search's error


@pytest.mark.parametrize(
    ("varying_delay", "message"), [("2,3", "expected a range around theta = 1, 2"), ("1", "expected LO,HI")]
)
def test_audit_refuses_a_range_without_the_constant(tmp_path, varying_delay, message):
    with pytest.raises(InputError, match=message):
        main(["--K", "879,552", "--B", "0.39,0.52", "--varying-delay", varying_delay, "--out", str(tmp_path)])


@pytest.mark.slow
def test_the_multiplier_is_best_in_random_loops():
    """In stars of random springs with one to five channels the bound over all multipliers meets the requirement."""
    rng = np.random.default_rng(5)
    for channels in (1, 2, 5, 3):
        contacts = tuple(f"c{k}" for k in range(channels))
        arms = tuple(Spring((c, "b"), float(np.exp(rng.uniform(3, 9))), float(rng.uniform(0, 2))) for c in contacts)
        star = Network(contacts, (*arms, Spring(("b", GROUND), 100.0, 0.5)), {"b": float(rng.uniform(0.1, 3))})
        gains = SpringDamper(np.exp(rng.uniform(4, 9, channels)), rng.uniform(0, 5, channels))
        G = force_map(environment(star, 1e-3), gains, (0,) * channels, (0,) * channels)
        lo = rng.integers(0, 4, channels)
        requirement = switching_sweep(
            G, lo.tolist(), (lo + rng.integers(0, 4, channels)).tolist(), rng.uniform(0.1, 5, channels)
        )
        # The search ends within 2 environments._SETTLED = 1e-6 of the bound.
        assert requirement.bound <= requirement.ratio * (1 + 1e-9)
        assert requirement.ratio == pytest.approx(requirement.bound, rel=2e-6)


def test_many_devices_use_the_springs_multiplier(monkeypatch):
    """Many devices get the multiplier that is best for springs. For SOFT it needs up to 10 % more than the best."""
    best, spring = required_damping(loop_of((1, 1), (2, 2)), SOFT, SWITCHING), Lti.constant([[800.0]], T)
    monkeypatch.setattr(budgets, "MULTIPLIER_ROWS", 1)
    simple = required_damping(loop_of((1, 1), (2, 2)), SOFT, SWITCHING)
    assert best.ratio <= simple.ratio < 1.1 * best.ratio
    assert simple.bound is None
    assert switching_sweep(spring, [0], [3], [1.37]).required[0] == pytest.approx(800.0 * T * 3.5, rel=1e-9)
