"""With varying periods, and forces that latch within them, both engines equal a solution by expm.

Tolerances without a comment cover rounding.
"""

import gc
import json
import weakref

import numpy as np
import pytest
from driven import alike
from scipy.linalg import expm

from haptic_loop import load
from haptic_loop.cli.run import main
from haptic_loop.cli.validate import main as validate
from haptic_loop.controller.coupling import NoCoupling, SpringDamper
from haptic_loop.controller.delay import Periods, VaryingDelay
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.design.certificate import required_damping
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.design.files import InputError
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.hold import at_the_latch, hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import HumanSets, Plant, plant, variants
from haptic_loop.sim.crowds import Validation, _examine
from haptic_loop.sim.engines import EXPONENTIAL, MujocoBatchEngine, MujocoEngine
from haptic_loop.sim.run import assemble, make_engine, outside_forces, run
from haptic_loop.sim.stability import Balance, close, dominant_mode, stability_of, verdict_within
from haptic_loop.sim.switching import switching
from tests.checks import uneven
from tests.evaluate import needs

SOFT = SpringDamper([879.0, 552.0], [0.39, 0.52])  # the design for any environment, rounded
PAIR = load("omega-pair").replace(duration=0.3)
DRAWN, LATE = Periods(0.6e-3, 1.5e-3), ((1e-4, 1.3e-4), (0.0, 5e-4))


def by_hand(simulation, ticks):
    """Return the plant states (ticks, states) of a run, with one matrix exponential from latch to latch.

    If delays vary, a tick uses the newest packet that has arrived, and zero before the first one.
    """
    P, m, timing = plant(simulation.scene.model), simulation.process.channels, simulation.timing
    delays = simulation.process.delays
    n, w, F = len(P.A), P.B.shape[1] - m, simulation.F if delays is None else simulation.process.law.sent
    s, z, held, states, sent = np.zeros(n), np.zeros(F.order), np.zeros(m), [], []
    pushed = run(simulation, "exact", ticks=ticks).w
    for k in range(ticks):
        states.append(s)
        x = P.C @ s
        force, z = F.C @ z + F.D @ x, F.A @ z + F.B @ x
        if delays is not None:
            sent.append(force)
            arrived = [[j for j in range(k + 1) if j + delays[j, i, 0] <= k] for i in range(m)]
            force = np.array([sent[js[-1]][i] if js else 0.0 for i, js in enumerate(arrived)])
        T, late = timing.period[k], np.zeros(m) if timing.late is None else timing.late[k]
        now = 0.0
        for until in sorted({*late.tolist(), T} - {0.0}):
            acts = np.where(late <= now, force, held)
            generator = np.zeros((n + w + m, n + w + m))
            generator[:n, :n], generator[:n, n:] = P.A, P.B
            s = (expm(generator * (until - now)) @ np.concatenate([s, pushed[k], acts]))[:n]
            now = until
        held = force
    return np.array(states)


@pytest.mark.parametrize("ticks", [{"period": DRAWN}, {"latency": LATE}, {"period": DRAWN, "latency": LATE}])
def test_both_engines_move_from_latch_to_latch(ticks):
    simulation = assemble(PAIR.replace(**ticks), SOFT, seed=3)
    exact = run(simulation, "exact")
    scale, states = abs(exact.s).max(), plant(simulation.scene.model).A.shape[0]
    assert abs(exact.s[:60, :states] - by_hand(simulation, 60)).max() < 1e-12 * scale
    assert abs(run(simulation, "mujoco").s - exact.s).max() < 1e-11 * scale
    rk4 = [run(simulation, make_engine(simulation, "mujoco", "RK4", n)).s for n in (8, 16)]
    assert abs(rk4[1] - exact.s).max() < 2e-7 * scale  # 5e-8 when measured
    assert abs(rk4[1] - exact.s).max() < abs(rk4[0] - exact.s).max() / 8  # fourth order gives 16


def test_block_sizes_do_not_change_runs():
    simulation = assemble(PAIR.replace(period=Periods(recorded=(1e-3, 2e-3, 0.5e-3)), duration=3.0), SOFT)
    trace = run(simulation, "exact")
    assert trace.t[:5] == pytest.approx([0, 1e-3, 3e-3, 3.5e-3, 4.5e-3])
    assert len(trace.t) == pytest.approx(3.0 / (3.5e-3 / 3), abs=1)
    assert trace.t[-1] == pytest.approx(3.0, abs=3e-3)  # a tick lasts up to 2 ms
    again = run(simulation, "exact", ticks=1500)  # these ticks fill other blocks
    np.testing.assert_array_equal(again.s, trace.s[:1500])


def test_taps_begin_at_their_time_in_uneven_ticks():
    simulation = assemble(PAIR.replace(period=Periods(recorded=(1e-3, 2e-3, 0.5e-3))), SOFT)
    scene, tap, t = simulation.scene, PAIR.tap, simulation.timing.times(0, 200)
    w = outside_forces(PAIR, scene, 0, 200, voluntary=False, timing=simulation.timing)
    expected = tap.force * ((t > tap.start - 1e-9) & (t < tap.start + tap.duration - 1e-9))
    assert 0 < expected.sum() < 20
    np.testing.assert_array_equal(w[:, scene.tapped[tap.channel - 1]], expected)


def test_even_ticks_without_latency_equal_plain_ones():
    plain = run(assemble(PAIR, SOFT), "exact")
    same = run(assemble(PAIR.replace(latency=((0.0, 0.0),) * 2, period=Periods(PAIR.T, PAIR.T)), SOFT), "exact")
    assert abs(same.x - plain.x).max() < 1e-13 * abs(plain.x).max()


def test_late_loops_match_their_map():
    """With constant latency the growth is that of a linear loop that has the held forces as states."""
    tau = 3e-4
    simulation = assemble(PAIR.replace(latency=((tau, tau),) * 2), SOFT)
    P, m, F = plant(simulation.scene.model), 2, simulation.F
    n, T = len(P.A), PAIR.T
    generator = np.zeros((n + m, n + m))
    generator[:n, :n], generator[:n, n:] = P.A, P.B[:, -m:]
    early, later = expm(generator * tau)[:n], expm(generator * (T - tau))[:n]
    A = np.zeros((n + m + F.order,) * 2)
    force = np.hstack([F.D @ P.C, np.zeros((m, m)), F.C])
    A[:n, :n], A[:n, n : n + m] = later[:, :n] @ early[:, :n], later[:, :n] @ early[:, n:]
    A[:n] += later[:, n:] @ force
    A[n : n + m], A[n + m :, :n], A[n + m :, n + m :] = force, F.B @ P.C, F.A
    growth = np.log(abs(np.linalg.eigvals(A)).max()) / T
    assert float(dominant_mode(close(simulation.plant, F)).growth) == pytest.approx(growth, abs=1e-9)


def test_drawn_tick_times_are_in_range_and_seeded():
    scenario = PAIR.replace(period=DRAWN, latency=LATE)
    one, same, other = (scenario.timing(seed, 4000) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.period, same.period)
    assert (one.period != other.period).any()
    assert (one.period.min(), one.period.max()) == (0.6e-3, 1.5e-3)
    assert one.late.min(axis=0).tolist() == [1e-4, 0.0]
    assert one.late.max(axis=0).tolist() == [1.3e-4, 5e-4]
    assert scenario.loop("I").T_max == 1.5e-3
    assert PAIR.replace(period=Periods(recorded=(0.5e-3,))).loop("I").T_max == PAIR.T  # certificates cover T, too
    assert scenario.usual_latency == pytest.approx([1.15e-4, 2.5e-4])
    assert scenario.replace(duration=2.1).samples == 2000  # the periods' mean is 1.05 ms
    assert scenario.digest != PAIR.digest == PAIR.replace(period=None).digest


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"period": {"min": 1e-3}}, r"period\.min, period\.max are 0\.001 s, none"),
        ({"period": {"min": 1e-3, "max": 2e-3, "recorded": [1e-3]}}, "either min and max, or recorded"),
        ({"period": {"recorded": [1e-3, 1.0]}}, r"period\.recorded has 1 s"),
        ({"period": {"min": 1e-3, "max": 2e-3}, "T_max": 1.5e-3}, r"period is up to 0\.002 s, above T_max"),
        ({"period": {"min": 2e-4, "max": 2e-3}, "latency": [[0, 3e-4]] * 2}, "expected less than every period, 0.0002"),
        ({"T_min": 2e-4, "T_max": 2e-3, "latency": [[0, 3e-4]] * 2}, "expected less than every period, 0.0002"),
    ],
)
def test_impossible_tick_times_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        PAIR.replace(**changes)


@pytest.mark.slow
def test_a_run_reports_the_times_of_ticks(tmp_path, capsys):
    file = tmp_path / "r.json"
    recorded = tmp_path / "ticks.txt"
    recorded.write_text("# s\n1.1e-3\n0.8e-3\n\n1.4e-3\n")
    save(Stored(PAIR.loop("I"), SOFT.form()), tmp_path / "soft.json")
    options = ["--coupling", str(tmp_path / "soft.json"), "--no-plot", "--duration", "0.33", "--out", str(tmp_path)]
    assert main([*options, "--period", str(recorded), "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    assert report["run"]["timing"]["period_s"] == pytest.approx({"least": 0.8e-3, "mean": 1.1e-3, "largest": 1.4e-3})
    assert needs(report, "this-environment")["certified"]
    assert report["stability"]["verdict"] == "stable"
    assert "constant periods" in report["stability"]["reason"]
    assert report["error"]["position_relative_rms"] < 1e-11
    assert "0.8 to 1.4 ms long, recorded" in capsys.readouterr().out


@pytest.mark.validate
def test_engines_agree_on_hands_at_uneven_ticks(tmp_path):
    """With a coupling no hand makes the loop unstable. Without one some do, and both engines agree which."""
    file = tmp_path / "r.json"
    ticks = ["--period", "0.8e-3,1.6e-3", "--latency", "1e-4:2e-4", "--humans", "3", "--duration", "0.3"]
    options = [*ticks, "--no-plot", "--out", str(tmp_path), "--json", str(file)]
    assert validate(["--case", "I", "--condition", "this-environment", *options]) == 0
    part = json.loads(file.read_text())["timing"]
    assert part["covered"]
    assert part["unstable"] == {"exact": 0, "mujoco": 0}
    assert validate(["--case", "none", *options]) == 0
    report = json.loads(file.read_text())
    assert report["timing"]["unstable"]["exact"] > 0
    assert report["disagreements"] == 0


@pytest.mark.slow
def test_growth_of_uneven_ticks_agrees_with_the_eigenvalues():
    """Fast decays must not hide the slow growth of this loop, with drawn hands or with the scenario's own."""
    springs = (Spring(("a", "m"), 397.7, 0.0), Spring(("b", "m"), 23.85, 0.2625), Spring(("c", "m"), 911.5, 0.2725))
    nearly_even = {"period": Periods(0.99e-3, 1.01e-3), "theta": (1, 1, 4), "T_max": 1.1e-3}
    scenario = load("three-rigid").replace(environment=Network(tuple("abc"), springs, {"m": 1.227}), **nearly_even)
    findings = _examine(Validation(scenario, NoCoupling(), 0, 60, 1, "exact", 2.0), range(60))
    clear = np.abs(findings.exact) > 0.05
    assert {True, False} == set((findings.exact[clear] > 0).tolist())
    np.testing.assert_array_equal(findings.switching[clear] > 0, findings.exact[clear] > 0)

    simulation = assemble(scenario.replace(duration=0.3), NoCoupling())
    stability = stability_of(simulation, run(simulation, "exact"))
    assert stability.verdict == stability.exact_verdict == "unstable"
    # Periods that vary by 1 % change the growth a little.
    assert stability.growth_rate_per_s == pytest.approx(stability.exact_growth_rate_per_s, abs=0.05)


def test_slow_rates_have_no_verdict():
    """A trace of 20 s gives a verdict if it lasts at least four time constants."""
    assert [verdict_within(rate, 20.0) for rate in (-0.19, 0.19, -0.21, 0.21)] == [None, None, "stable", "unstable"]


def test_slow_creep_is_undecided():
    """A hand and a spring, 0.011 N/m together, creep against 4.37 N s/m; the mass changes their rate by 0.03 %."""
    human, spring = Human((Link(0.3, 3.0, 0.01),)), Network(("a",), (Spring(("a", GROUND), 1e-3),))
    changes = {"device": (RigidDevice(damping=1.37),), "human": (human,), "tap": None, "environment": spring}
    scenario = load("one-wall").replace(T=0.02, theta=(1,), period=Periods(0.018, 0.02), duration=1.0, **changes)
    simulation = assemble(scenario, NoCoupling())
    stability = stability_of(simulation, run(simulation, "exact"))
    assert stability.verdict is None
    assert "not decidable" in stability.reason
    assert stability.growth_rate_per_s == pytest.approx(-0.011 / 4.37, rel=1e-3)


def test_periods_and_delays_may_vary_together():
    scenario = PAIR.replace(period=DRAWN, varying_delay=VaryingDelay((1, 2), (2, 3)), theta=(1, 2))
    moved, _ = switching(assemble(scenario, SOFT, seed=3), 3, scenario.samples)
    exact = run(moved, "exact").s
    assert len(exact) == scenario.samples
    assert {tuple(row) for row in moved.process.delays[:60, :, 0].tolist()} == {(1, 2), (1, 3), (2, 2), (2, 3)}
    expected = by_hand(moved, 60)
    assert abs(exact[:60, : expected.shape[1]] - expected).max() < 1e-12 * abs(exact).max()


@pytest.mark.slow
def test_hands_gain_energy_only_below_the_requirement(monkeypatch):
    """A short form of the check in `make validate` holds, and fails with half the required damping."""
    rows = list(uneven.uneven_ticks(0, 3, 500))
    assert [(row.ticks, row.drawn) for row in rows[:3]] == [("periods", True), ("periods", False), ("latency", True)]
    assert all(row.holds for row in rows)
    assert sum(row.grow > 0 for row in rows) >= 4
    monkeypatch.setattr(uneven, "ENOUGH", 0.5)
    assert not all(row.holds for row in uneven.uneven_ticks(0, 2, 300))


def test_latch_positions_follow_the_plants_motion():
    """Positions at the latches equal those by expm; the device that latches first then moves the other one."""
    rng = np.random.default_rng(4)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-300 * np.array([[2, -1], [-1, 2]]), -2 * np.eye(2)]])
    B = np.vstack([np.zeros((2, 3)), rng.normal(size=(2, 3))])
    seen = at_the_latch(Plant(A[None], B[None], np.eye(2, 4)), (3e-4, 1e-4))[0]
    s, held, w, f = (rng.normal(size=size) for size in (4, 2, 1, 2))

    def moved(s, force, t):
        generator = np.zeros((7, 7))
        generator[:4, :4], generator[:4, 4:] = A, B
        return (expm(generator * t) @ np.concatenate([s, w, force]))[:4]

    first = moved(s, held, 1e-4)
    second = moved(first, [held[0], f[1]], 2e-4)
    np.testing.assert_allclose(seen @ np.concatenate([s, held, w, f]), [second[0], first[1]], rtol=1e-12)


def test_counted_dissipation_is_a_lower_bound():
    """Two joined devices dissipate in a tick at least what conditions count, and less than 1 % more in most ticks.

    The dissipation is the lost mechanical energy less the work of the forces before and after the latch."""
    late, delta, F, T = np.array([1e-4, 4e-4]), np.array([1.37, 1.1]), PAIR.loop("I").F(SOFT), PAIR.T
    M, K = np.diag([0.5, 0.3]), np.array([[900.0, -300.0], [-300.0, 500.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, np.diag(delta))]])
    P = Plant(A, np.vstack([np.zeros((2, 2)), -np.linalg.inv(M)]), np.eye(2, 4))
    rows, step = at_the_latch(P, late.tolist()), close(hold(P, T, late.tolist()), F).A
    xi, lost, counted = (
        np.random.default_rng(1).normal(size=len(step)) * ([0] * 2 + [1] * 2 + [0] * (len(step) - 4)),
        [],
        [],
    )
    for _ in range(240):
        x, held, force, after = xi[:2], xi[4:6], F.C @ xi[6:] + F.D @ xi[:2], step @ xi
        middle = rows @ np.concatenate([xi[:6], force])
        a, b = middle - x, after[:2] - middle
        stored = [(s[2:4] @ M @ s[2:4] + s[:2] @ K @ s[:2]) / 2 for s in (xi, after)]
        lost.append(stored[0] - stored[1] - held @ a - force @ b)
        counted.append((delta * (a**2 / late + b**2 / (T - late))).sum())
        xi = after
    assert (np.array(lost) >= np.array(counted) * (1 - 1e-9) - 1e-13).all()
    assert np.median(np.array(lost) / counted) < 1.01


def test_late_balances_count_the_simulated_spans():
    """A span of `length` [s] dissipates at least delta |dx|^2/length, so its factor times its length is delta."""
    loop = PAIR.replace(latency=LATE, T_max=2e-3).loop("I")
    balance = Balance.of(variants(PAIR.device, HumanSets((PAIR.human,))), loop, [1.1e-4, 2e-4])
    np.testing.assert_allclose(balance.before[:, 0] * [1.1e-4, 2e-4], loop.delta, rtol=1e-12)
    np.testing.assert_allclose(balance.damping[:, 0] * (loop.T - np.array([1.1e-4, 2e-4])), loop.delta, rtol=1e-12)


def test_both_engines_trace_late_forces():
    wall = Network(("a",), (Spring(("a", GROUND), 900.0),))
    late = load("one-wall").replace(environment=wall, latency=((3e-4, 3e-4),), tap=None)
    findings = _examine(Validation(late, NoCoupling(), 0, 2, 1, "both", 0.25), range(2))
    assert findings.witnessed.all()
    np.testing.assert_allclose(findings.trace, findings.exact, rtol=0, atol=1e-9)
    np.testing.assert_allclose(findings.mujoco, findings.exact, rtol=0, atol=1e-3)  # MuJoCo steps by RK4 here


@pytest.mark.slow
def test_the_energy_audit_sees_late_forces():
    """With a certified coupling no loop gives energy. Without one some loops do, and all of these are unstable."""
    late = PAIR.replace(latency=LATE)
    for coupling, gives in ((SOFT, False), (NoCoupling(), True)):
        findings = _examine(Validation(late, coupling, 0, 24, 1, "exact", 1.0), range(24))
        gave = findings.energy < -1e-9 * findings.audited
        assert gave.any() == gives
        assert (findings.exact[gave] > 0).all()


def test_the_energy_audit_agrees_with_ranges_of_latency():
    """A spring of 1000 N/m a sample late needs 2.3173 N s/m for latencies to 0.4 T; with 2.32 no hand gains energy."""
    spring, device = Network(("tip",), (Spring(("tip", GROUND), 1000.0),)), RigidDevice(mass=0.1, damping=2.32)
    fields = {"theta": (1,), "psi": (0,), "device": (device,), "human": PAIR.human[:1], "environment": spring}
    late = PAIR.replace(T=1.2e-3, latency=((0.0, 0.48e-3),), tap=None, **fields)
    assert required_damping(late.loop("I"), NoCoupling(), "this-environment").certified
    findings = _examine(Validation(late, NoCoupling(), 0, 12, 1, "exact", 1.0), range(12))
    assert (findings.energy >= -1e-9 * findings.audited).all()


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("integrator", [EXPONENTIAL, "RK4"])
def test_no_reference_cycle_keeps_an_engine(integrator, timed):
    """An engine holds a MiB for every 125 hands; it is freed with its last reference, without garbage collection."""
    simulation = assemble(PAIR.replace(period=DRAWN, latency=LATE) if timed else PAIR, SOFT)
    gc.disable()
    try:
        for make, scene in ((MujocoEngine, simulation.scene), (MujocoBatchEngine, alike(simulation.scene, 1))):
            engine = make(scene, simulation.scenario.T, integrator, timing=simulation.timing)
            run(simulation, engine, ticks=3)
            memory = weakref.ref(engine._access)  # this object holds MuJoCo's memory
            del engine
            assert memory() is None
    finally:
        gc.enable()
