"""Products of mode matrices equal the simulated loop with switching delays; the search finds delays with growth.

Tolerances without a comment cover rounding.
"""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from evaluate import reported
from scipy.linalg import expm
from shared import SOFT, STIFF

from haptic_loop.cli.run import main
from haptic_loop.cli.validate import main as validate
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.controller.delay import VaryingDelay, ages, realising
from haptic_loop.controller.tick import StepBuffer
from haptic_loop.design import coupling_file
from haptic_loop.design.assessment import assess
from haptic_loop.models.hold import HeldPlant
from haptic_loop.models.scene import Crowd, plant, variants
from haptic_loop.sim.couplings import assessed, given
from haptic_loop.sim.crowds import _batch
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.report import DelaySpan, VaryingDelays, _DelaysMet, _PeriodGrowth, _switched_stability
from haptic_loop.sim.run import assemble
from haptic_loop.sim.run import run as close_loop
from haptic_loop.sim.scenario import SCENARIOS, InputError, load, parse
from haptic_loop.sim.stability import impulse_growth
from haptic_loop.sim.switching import (
    DelaysCovered,
    _greedy_ages,
    _mode_matrix,
    _worst_switching,
    switched_crowd,
    switching,
)
from tests.evaluate import decisive

ASSEMBLY = assemble(load(), STIFF)


def with_delays(simulation, delays):
    """Return the loop with packets that take these delays instead of the constant theta."""
    return replace(simulation, process=replace(simulation.process, delays=delays))


def one(held: HeldPlant) -> HeldPlant:
    """Return the plant as a stack of one."""
    return HeldPlant(held.A[None], held.B[None], held.C, held.T)


def own_hold() -> HeldPlant:
    """Return the plant under a zero-order hold by SciPy's expm, independent of the code under test."""
    continuous, T = plant(ASSEMBLY.scene.model), ASSEMBLY.scenario.T
    n, inputs = continuous.B.shape
    step = expm(np.block([[continuous.A, continuous.B], [np.zeros((inputs, n + inputs))]]) * T)
    return HeldPlant(step[:n, :n], step[:n, n:], continuous.C, T)


def test_mode_products_equal_the_simulated_map():
    """60 ticks with forces of random ages, from a random state, equal the product of their mode matrices."""
    rng, ticks, depth = np.random.default_rng(0), 60, (3, 2)
    wanted = np.tile(depth, (ticks, 1))
    for k in range(4, ticks):
        wanted[k] = rng.integers([1, 0], np.minimum(wanted[k - 1] + 1, depth), endpoint=True)
    G = ASSEMBLY.process.law.sent
    moved = with_delays(ASSEMBLY, realising(wanted)[:, :, None])
    states = moved.plant.A.shape[0]
    buffer = StepBuffer(moved.process.unlimited, ticks, states, moved.scene.outside)
    buffer.s[0, :, 0] = rng.normal(size=states)
    engine = ExactEngine(moved.plant)
    engine.start(buffer)
    for k in range(ticks):
        buffer.tick(k)
        engine.advance(k)

    xi = np.zeros(states + G.order + sum(depth))
    xi[:states] = buffer.s[0, :, 0]
    held = own_hold()
    for row in wanted:
        xi = _mode_matrix(held, G, depth, row) @ xi
    size = np.abs(buffer.s[:, :, 0]).max()
    # Both results are products of the same 60 matrices; each product rounds numbers of up to `size` by 1e-16.
    np.testing.assert_allclose(xi[:states], buffer.s[ticks, :, 0], rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(xi[states:][: G.order], buffer.z[ticks, :, 0], rtol=0, atol=1e-11 * size)


def test_constant_delay_lines_equal_constant_loops():
    delays = np.tile(np.array([1, 2])[None, :, None], (300, 1, 1))
    varying = close_loop(with_delays(ASSEMBLY, delays), "exact", ticks=300)
    constant = close_loop(ASSEMBLY, "exact", ticks=300)
    np.testing.assert_allclose(varying.s, constant.s, rtol=0, atol=1e-12 * np.abs(constant.s).max())


def test_switching_can_grow_beyond_constant_delays():
    """The loop is stable with delays (1, 2), but with the same hands it grows if delays switch between 1 and 2."""
    worst = _worst_switching(ASSEMBLY, VaryingDelay((1, 1), (2, 2), "adversarial"))
    assert worst.growth > 1.5  # the search found 2.05 1/s
    assert set(np.unique(worst.ages)) <= {1, 2}
    period, held = len(worst.ages), own_hold()
    G, product = ASSEMBLY.process.law.sent, None
    for row in worst.ages:
        A = _mode_matrix(held, G, (2, 2), row)
        product = A if product is None else A @ product
    radius = np.abs(np.linalg.eigvals(product)).max()
    # The rounding of a product of many matrices adds up.
    assert radius == pytest.approx(worst.spectral_radius, rel=1e-8)
    met = ages(np.tile(worst.delays, (3, 1))[:, :, None])[2 * period :, :, 0]
    np.testing.assert_array_equal(met, worst.ages)
    growth = {
        ages: np.log(np.abs(np.linalg.eigvals(_mode_matrix(held, G, (2, 2), ages))).max()) / G.T
        for ages in ((1, 1), (1, 2), (2, 1), (2, 2))
    }
    assert growth[1, 2] < 0
    assert worst.growth > max(growth.values())  # a constant delay of 2 on channel 1 gives +1.68 1/s


def test_loops_grow_under_greedy_not_under_random_ages():
    """The loop grows under packet delays that realise greedily chosen ages, and decays under random delays."""
    varying_delay, ticks = VaryingDelay((1, 1), (2, 2)), 1600
    process, held = ASSEMBLY.process, one(ASSEMBLY.plant)
    delays = realising(_greedy_ages(process, held, ASSEMBLY.scene, varying_delay, ticks))
    drawn = varying_delay.draw(np.random.default_rng(0), ticks)[:, :, None]
    rates = []
    for each in (delays, drawn):
        free = replace(process.unlimited, delays=each)
        engine = ExactEngine(held)
        rates.append(impulse_growth(free, engine, ASSEMBLY.scene, held.A.shape[1], ticks)[0][0])
    assert rates[0] > 0 > rates[1]


def test_switching_depends_on_the_seed_only():
    scenario = load().replace(varying_delay=VaryingDelay((1, 1), (2, 2)))
    loop = assemble(scenario, STIFF)
    first, again, other = (switching(loop, seed, 50)[0].process.delays for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def run(tmp_path, *options):
    code, report = reported(main, tmp_path, *options, "--no-plot", "--out", str(tmp_path / "out"))
    assert code == 0
    return report


@pytest.mark.slow
def test_both_engines_meet_the_same_delays(tmp_path):
    report = run(tmp_path, "--varying-delay", "1,2", "--pattern", "bursty", "--loss", "0.05", "--duration", "1")
    # Both engines are exact here: when measured, their positions differed by 2e-14 of their rms, which is rounding.
    assert report["error"]["position_relative_rms"] < 1e-7
    varying_delay = report["varying_delay"]
    assert not varying_delay["covered"]
    assert varying_delay["age"]["least"] == [1, 1]
    assert max(varying_delay["age"]["largest"]) > 2  # lost packets make the held force older
    assert min(varying_delay["lost_packets"]) > 0


@pytest.mark.slow
def test_the_adversarial_pattern_shows_growth(tmp_path):
    coupling_file.save(coupling_file.Stored(load().loop("I"), STIFF.form()), tmp_path / "stiff.json")
    options = ["--coupling", str(tmp_path / "stiff.json"), "--varying-delay", "1,2", "--pattern", "adversarial"]
    report = run(tmp_path, *options, "--duration", "1", "--engine", "exact")
    assert report["stability"]["verdict"] == "unstable"
    assert report["stability"]["exact_verdict"] == "stable"
    assert report["varying_delay"]["period"]["growth_rate_per_s"] > 1.5
    assert any("not covered" in remark for remark in report["remarks"])


@pytest.mark.slow
def test_a_playout_buffer_is_the_constant_largest_delay(tmp_path):
    report = run(tmp_path, "--varying-delay", "1-2,2-3", "--playout", "--duration", "1", "--engine", "exact")
    assert report["run"]["theta"] == [2, 3]
    assert report["varying_delay"]["constant"]
    assert report["varying_delay"]["covered"]
    assert decisive(report)["certified"]


def test_reports_give_recorded_delays_and_lost_packets(tmp_path):
    (tmp_path / "delays.csv").write_text("# of one afternoon\n1, 2\n2 2\n1,-1\n")
    quick = ["--coupling", "published", "--engine", "exact", "--duration", "0.3"]
    report = run(tmp_path, "--pattern", str(tmp_path / "delays.csv"), *quick)
    assert (report["varying_delay"]["lo"], report["varying_delay"]["hi"]) == ([1, 2], [2, 2])
    assert report["varying_delay"]["lost_packets"] == [0, 83]  # every third of 250 packets
    report = run(tmp_path, "--loss", "1", *quick)
    assert report["varying_delay"]["age"] is None
    assert np.load(tmp_path / "out" / "trace.npz")["f"].any() == np.False_  # no force ever arrives


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--varying-delay", "2,1"], "--varying-delay is '2,1', expected 0 <= LO <= HI"),
        (["--varying-delay", "1-2,3-2"], "--varying-delay is '1-2,3-2', expected 0 <= LO <= HI in range 2"),
        (["--varying-delay", "1-2,1-2,1-2"], "--varying-delay has 3 ranges, expected 2"),
        (["--varying-delay", "a"], "--varying-delay is 'a', expected LO,HI"),
        (["--varying-delay", "3,4"], "theta #1 is 1, outside of its varying_delay, 3 to 4"),
        (["--playout"], "--playout without a range of delays"),
        (["--pattern", "random"], "--pattern without a range of delays"),
        (["--varying-delay", "1,2", "--loss", "2"], "varying_delay.loss is 2"),
        (["--varying-delay", "1,2", "--pattern", "wild"], "No such file"),
        (["--varying-delay", "1,2", "--playout", "--theta", "1"], "varying_delay.playout makes it the largest delay"),
    ],
)
def test_bad_ranges_are_refused(options, message):
    with pytest.raises(InputError) as error:
        main(options)
    assert message in str(error.value)


def test_a_scenario_file_may_have_varying_delays():
    text = (SCENARIOS / "omega-pair.toml").read_text()
    scenario = parse(text + '\n[varying_delay]\nlo = [1, 1]\nhi = [2, 3]\npattern = "bursty"\nloss = 0.01\n')
    assert scenario.varying_delay == VaryingDelay((1, 1), (2, 3), "bursty", 0.01)
    assert scenario.switches
    with pytest.raises(InputError, match=r"varying_delay.*`loss`"):
        parse(text + "\n[varying_delay]\nlo = [1, 1]\nhi = [2, 3]\nlos = 0.01\n")
    with pytest.raises(InputError, match="theta"):
        parse(text + "\n[varying_delay]\nlo = [2, 2]\nhi = [3, 3]\n")


def validated(tmp_path, *options):
    out = tmp_path / "v"
    fixed = ["--engine", "exact", "--humans", "20", "--no-plot", "--varying-delay", "1,2", "--duration", "1"]
    code = validate([*fixed, *options, "--out", str(out), "--json", str(tmp_path / "v.json")])
    return code, json.loads((tmp_path / "v.json").read_text())["switching"]


def test_axes_of_a_device_share_the_worst_delays():
    """A packet holds the forces of all axes: the run's ages repeat those of the period whose growth is reported."""
    scenario = load("omega-space").replace(varying_delay={"lo": [0, 1], "hi": [3, 4], "pattern": "adversarial"})
    switched, period = switching(assemble(scenario, NoCoupling()), 0, 400)
    met, length = ages(switched.process.delays)[..., 0], len(period.ages)
    assert (period.ages == period.ages[:, scenario.lead]).all()
    assert met[2 * length : 3 * length].tolist() == period.ages.tolist()
    both = np.concatenate([switched.plant.A[None]] * 2), np.concatenate([switched.plant.B[None]] * 2)
    held = HeldPlant(*both, switched.plant.C, switched.plant.T)
    greedy = _greedy_ages(switched.process, held, switched.scene, scenario.varying_delay, 200)
    assert (greedy == greedy[:, scenario.lead]).all()
    assert (greedy[:, 0] != greedy[:, 3]).any()


@pytest.mark.validate
def test_only_designs_for_switching_withstand_the_worst_switching(tmp_path):
    """The design for constant delays is unstable with 10 or more of 20 humans, that for switching delays with none."""
    coupling_file.save(coupling_file.Stored(load().loop("I"), STIFF.form()), tmp_path / "stiff.json")
    code, stiff = validated(tmp_path, "--pattern", "adversarial", "--coupling", str(tmp_path / "stiff.json"))
    assert stiff["unstable"]["exact"] >= 10
    assert not stiff["covered"]
    assert code == 0  # nothing that was certified is contradicted
    code, soft = validated(tmp_path, "--pattern", "adversarial")
    assert soft["unstable"]["exact"] == 0
    assert soft["covered"]
    assert soft["switching"]["proof"] == "rational"
    assert code == 0


@pytest.mark.slow
def test_validations_with_lost_packets_are_not_covered(tmp_path, capsys):
    code, part = validated(tmp_path, "--pattern", "bursty", "--loss", "0.1", "--humans", "8")
    assert code == 0
    assert "nothing is certified" in capsys.readouterr().out
    assert not part["covered"]
    assert "lost packet" in part["covers"]
    assert part["humans"] == 8
    assert part["unstable"] == {"exact": 0, "mujoco": None}
    code, part = validated(tmp_path, "--playout", "--humans", "2")
    assert part["constant"]
    assert part["covered"]
    assert part["humans"] == 0


@pytest.mark.slow
def test_both_engines_agree_on_growth_under_adversarial_delays():
    """MuJoCo's growth rates under adversarial delays are within 0.01 1/s of the exact rates."""
    scenario = load().replace(varying_delay=VaryingDelay((1, 1), (2, 2), "adversarial"))
    held_by = variants(scenario.device, held_alike((1.0, 20.0, 500.0), (0.3, 6.0, 300.0)))
    other = partial(_batch, held_by, scenario.T, 1)
    seen = switched_crowd(assemble(scenario, STIFF), held_by, np.arange(2), 0, 2.0, other)
    assert (seen.exact > 1).all()
    np.testing.assert_allclose(seen.mujoco, seen.exact, rtol=0, atol=1e-2)


def held_alike(*links):
    """Return sets of two equal hands, one set for each (mass, damping, stiffness) of `links`."""
    return Crowd(np.array([[[link]] * 2 for link in links]))


def test_delays_depend_on_the_index_of_hands():
    """Equal hands with the same index have the same growth, at any place of a batch."""
    scenario = load().replace(varying_delay=VaryingDelay((1, 1), (2, 2)))
    held_by = variants(scenario.device, held_alike(*[(1.0, 20.0, 500.0)] * 3))
    growth = switched_crowd(assemble(scenario, STIFF), held_by, np.array([8, 3, 8]), 0, 2.0, None).exact
    assert growth[0] == pytest.approx(growth[2], rel=1e-9)
    assert growth[0] != pytest.approx(growth[1], rel=1e-3)  # they differed by 1.8e-2 when measured


def test_lost_packets_leave_only_a_budgets_guarantee():
    lossy = load().replace(varying_delay=VaryingDelay((1, 2), (1, 2), loss=0.1))
    alone, budgeted = (assessed(lossy, "I", given(SOFT), energy_budget=W0) for W0 in (None, 0.0))
    assert alone.guarantee is None
    assert "a lost packet makes a force older" in alone.reason
    assert budgeted.guarantee.energy_J == 0.0
    covered = [DelaysCovered.of(lossy, assessment) for assessment in (alone, budgeted)]
    assert [each.covered for each in covered] == [False, True]
    assert not any(each.covers.startswith("certified") for each in covered)


def test_a_lost_packet_holds_the_last_force():
    """Ages count from the first tick in which every channel has a force."""
    delays = np.tile(np.array([1, 2])[None, :, None], (30, 1, 1))
    delays[9, 0] = -1
    met = _DelaysMet.of(with_delays(ASSEMBLY, delays), None, 30)
    assert (met.lost_packets, met.held_ticks) == ([1, 0], [1, 0])
    assert (met.age.least, met.age.largest) == ([1, 2], [2, 2])
    assert met.age.mean == pytest.approx([1 + 1 / 28, 2])


@pytest.mark.parametrize(("own", "worst"), [("unstable", "stable"), ("stable", "unstable"), ("stable", "stable")])
def test_own_or_worst_delays_decide_instability(own, worst):
    met = _DelaysMet(None, [0, 0], [0, 0], 0.5, own, 4.0, _PeriodGrowth(3, -0.5, 0.9, worst))
    trace = close_loop(ASSEMBLY, "exact", ticks=20)
    delays = VaryingDelays(DelaySpan((1,), (2,), "", 0, False, False), met, None)
    verdict = _switched_stability(ASSEMBLY, trace, delays).verdict
    assert verdict == ("unstable" if "unstable" in (own, worst) else "stable")


def test_constant_delays_of_uncertified_loops_are_uncovered():
    scenario = load().replace(varying_delay=VaryingDelay((1, 2), (1, 2)))
    delays = DelaysCovered.of(scenario, assess(scenario.loop("I"), NoCoupling()))
    assert not delays.covered
    assert "nothing is certified" in delays.covers


def test_the_felt_force_includes_constant_delays():
    """The law of a switching loop sends G without Theta; `felt`, from which reports are made, is F = Theta G."""
    moved = with_delays(ASSEMBLY, np.ones((5, 2, 1), dtype=int))
    z = np.exp(1j * np.linspace(0.001, 3, 50))
    theta = z[:, None, None] ** -np.array(ASSEMBLY.scenario.theta, dtype=float)[:, None]
    np.testing.assert_allclose(moved.felt.at(z), theta * ASSEMBLY.process.law.sent.at(z), rtol=1e-9)
