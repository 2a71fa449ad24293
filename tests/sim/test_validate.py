"""Validating many humans at once gives the results of each human alone, in both engines, however the work is split.

A crowd is a stack of sets of hands; a person holds several devices. Tolerances without a comment cover rounding.
"""

import json
import multiprocessing
import os
import signal
import threading
from dataclasses import fields, replace
from math import factorial

import numpy as np
import pytest
from driven import driven
from evaluate import reported
from msgspec.structs import replace as replace_fields

from haptic_loop.cli import run as run_command
from haptic_loop.cli.validate import main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.controller.delay import VaryingDelay
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Person
from haptic_loop.models.scene import MIXED, Crowd, build, crowds, draw, plant, variants
from haptic_loop.sim import crowds as examine_module
from haptic_loop.sim.adversary import Worst
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.crowds import Findings, Validation, validate
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, held_by, load
from haptic_loop.sim.stability import (
    close,
    disagree,
    dominant_mode,
    exact_loops,
    impulse_forces,
    mujoco_plants,
    unstable,
)
from haptic_loop.sim.verdicts import Attacked, EnergyAudit, Growing, Traces, WorstDrawn, disagreement_words
from tests.checks.random_loops import slow

SCENARIO = load()
TWO = "[[human]]\nlinks = [{mass = 1.0, damping = 0, stiffness = 0}]\n" * 2
DEVICES = {
    "compliant": SCENARIO.device,
    "rigid": (RigidDevice(), RigidDevice(mass=0.05)),
    "one of each": (SCENARIO.device[0], RigidDevice()),
}


def crowd(n: int, links: int = 1) -> Crowd:
    return Crowd(np.stack([draw(SCENARIO.population, 2, 3, i, links) for i in range(n)]))


@pytest.mark.parametrize("links", [1, 2, 3])
@pytest.mark.parametrize("devices", DEVICES.values(), ids=DEVICES)
def test_stacked_plants_are_those_of_each_model(devices, links):
    people = crowd(5, links)
    held_by = variants(devices, people)
    stacked = held_by.plants()
    for i in range(len(people)):
        scene = build(devices, people.humans(i))
        alone = plant(scene.model)
        for name, rows in held_by.fields.items():
            np.testing.assert_array_equal(rows[i], getattr(scene.model, name), err_msg=name)
        # the inverse of a diagonal matrix and a division by its diagonal round differently
        np.testing.assert_allclose(stacked.A[i], alone.A, rtol=1e-13, atol=0)
        np.testing.assert_allclose(stacked.B[i], alone.B, rtol=1e-13, atol=0)
        np.testing.assert_array_equal(stacked.C, alone.C)


KNOWN = load("omega-pair-known")


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_drawn_devices_are_within_their_bounds(engine):
    """The growth rate of each drawn pair of devices equals that of a scene built with this pair."""
    question = Validation(KNOWN, NoCoupling(), 5, 40, MIXED, engine, 0.0)
    findings, F = validate(question), assemble(KNOWN, NoCoupling()).F
    for index, people in question.crowds(range(8)):
        for i, own in enumerate(people.mechanics):
            devices = [drawn.of(device) for drawn, device in zip(own, KNOWN.device, strict=True)]  # checks the bounds
            alone = dominant_mode(close(hold(plant(build(devices, people.humans(i)).model), KNOWN.T), F))
            growth = findings.exact if engine == "exact" else findings.mujoco
            # When measured, RK4 erred by 6e-5 1/s.
            assert growth[index[i]] == pytest.approx(alone.growth, abs=1e-9 if engine == "exact" else 1e-3)
    masses = np.array([one.motor_mass for i in range(40) for one in question.crowd(i).mechanics[0]])
    assert masses.min() == 0.06 < np.median(masses[masses > 0.06]) < masses.max() < 0.6
    assert 0.3 < (masses == 0.06).mean() < 0.7  # often at the bound, where the worst device is


@pytest.mark.slow
@pytest.mark.parametrize("humans", [60, pytest.param(400, marks=pytest.mark.validate)])
def test_no_hand_makes_known_devices_unstable(tmp_path, humans):
    """With 1.001 times the damping that known-device requires, all drawn sets are stable, and the worst one replays."""
    file, out = tmp_path / "r.json", tmp_path / "out"
    base = ["--scenario", "omega-pair-known", "--delta", "1.3134", "--case", "none", "--condition", "known-device"]
    base += ["--duration", "0", "--engine", "exact", "--humans", str(humans), "--links", "mixed", "--no-limiter"]
    assert main([*base, "--no-plot", "--out", str(out), "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    assert report["certified"]
    assert report["unstable"]["exact"] == 0
    assert report["worst"]["device"][0]["transmission_damping"] == 0.5
    again = assemble(held_by(KNOWN.replace(delta=(1.3134,) * 2), str(out / "worst-human.toml")), NoCoupling())
    radius = dominant_mode(close(again.plant, again.F)).spectral_radius
    assert radius == pytest.approx(report["worst"]["spectral_radius"], abs=1e-12)


def question_of(scenario):
    return Validation(scenario, PUBLISHED["I"], 7, 20, 2, "exact", 0.0)


HELD = SCENARIO.replace(person=(Person((2, 1), 20.0, 1.0, 100.0),))


@pytest.mark.parametrize("devices", DEVICES.values(), ids=DEVICES)
def test_stacked_people_equal_single_ones(devices):
    """Each person of a crowd has the plant of the person's own scene, and MuJoCo's map agrees with the exact one."""
    scenario = HELD.replace(device=devices)
    ((_, people),) = question_of(scenario).crowds(range(20))
    held_by = variants(devices, people)
    stacked = held_by.plants()
    for i in range(5):
        alone = plant(build(devices, people.humans(i), people.persons(i)).model)
        np.testing.assert_allclose(stacked.A[i], alone.A, rtol=1e-12, atol=1e-12 * np.abs(alone.A).max())
        np.testing.assert_allclose(stacked.B[i], alone.B, rtol=1e-13, atol=0)
    simulation = assemble(scenario, PUBLISHED["I"])
    exact = dominant_mode(exact_loops(held_by, simulation.F)).growth
    plants = mujoco_plants(held_by, simulation.process)
    # When measured, RK4 erred by 2e-4 1/s.
    np.testing.assert_allclose(dominant_mode(close(plants, simulation.F)).growth, exact, rtol=0, atol=1e-3)
    # The arms equal those of people who hold one device each.
    np.testing.assert_array_equal(people.links, next(question_of(SCENARIO).crowds(range(20)))[1].links)


def test_both_engines_agree_on_a_person():
    """MuJoCo equals the exact engine, including voluntary motion and its reaction on the body."""
    scenario = HELD.replace(duration=1.5)
    simulation = assemble(scenario, PUBLISHED["I"])
    mujoco, exact = run(simulation), run(simulation, "exact")
    assert np.abs(exact.s[:, :2]).max() > 1e-3
    positions, n = slice(simulation.scene.model.nq), simulation.scene.model.nq
    np.testing.assert_allclose(mujoco.s[:, positions], exact.s[:, positions], rtol=0, atol=1e-12)
    np.testing.assert_allclose(mujoco.s[:, n:], exact.s[:, n:], rtol=0, atol=1e-10 * np.abs(exact.s).max())


def test_the_worst_person_and_hands_replay(tmp_path):
    text = (load.__globals__["SCENARIOS"] / "omega-pair.toml").read_text()
    text += (
        "\n[[person]]\nholds = [1, 2]\nmass = 30.0\ndamping = 80.0\nstiffness = 900.0\ncross = { stiffness = 40.0 }\n"
    )
    (tmp_path / "s.toml").write_text(text)
    base = ["--scenario", str(tmp_path / "s.toml"), "--engine", "exact", "--duration", "0.5", "--no-plot"]
    options = [*base, "--out", str(tmp_path)]
    worst = reported(main, tmp_path, *options, "--humans", "30")[1]["worst"]
    assert worst["person"][0]["holds"] == [1, 2]
    _, report = reported(run_command.main, tmp_path, *options, "--human", str(tmp_path / "worst-human.toml"))
    stability = report["stability"]
    assert stability["spectral_radius"] == pytest.approx(worst["spectral_radius"], abs=1e-12)


@pytest.mark.parametrize("links", [1, 2])
@pytest.mark.parametrize("coupling", [PUBLISHED["I"], NoCoupling()], ids=["published", "none"])
def test_batched_eigenvalues_are_those_of_each_loop(coupling, links):
    people = crowd(20, links)
    F = assemble(SCENARIO, coupling).F
    modes = dominant_mode(exact_loops(variants(SCENARIO.device, people), F))
    for i in range(len(people)):
        scene = build(SCENARIO.device, people.humans(i))
        mode = dominant_mode(close(hold(plant(scene.model), SCENARIO.T), F))
        # the eigenvalues of a nearly defective pair lose half the digits, others none
        assert modes.spectral_radius[i] == pytest.approx(mode.spectral_radius, abs=1e-10)
        assert modes.growth[i] == pytest.approx(mode.growth, abs=1e-7)


@pytest.mark.parametrize("devices", DEVICES.values(), ids=DEVICES)
def test_mujoco_maps_have_the_exact_growth(devices):
    """RK4 x 4 is within 1e-3 1/s of the exact growth for every human, so a verdict can change only near zero."""
    scenario = SCENARIO.replace(device=devices)
    simulation = assemble(scenario, PUBLISHED["I"])
    held_by = variants(devices, crowd(40, 2))
    exact = dominant_mode(exact_loops(held_by, simulation.F)).growth
    mujoco = dominant_mode(close(mujoco_plants(held_by, simulation.process), simulation.F)).growth
    np.testing.assert_allclose(mujoco, exact, rtol=0, atol=1e-3)


@pytest.mark.parametrize("devices", DEVICES.values(), ids=DEVICES)
def test_mujoco_maps_are_runge_kutta_polynomials(devices):
    """MuJoCo's map of a period is the fourth power of the polynomial of RK4 in the plant's matrix, with step T/4."""
    held_by, process = (
        variants(devices, crowd(5, 2)),
        assemble(SCENARIO.replace(device=devices), PUBLISHED["I"]).process,
    )
    held, plants = mujoco_plants(held_by, process), held_by.plants()
    h, m = process.F.T / 4, process.channels
    for A, B, own_A, own_B in zip(plants.A, plants.B[:, :, -m:], held.A, held.B, strict=True):
        powers = [np.linalg.matrix_power(h * A, i) / factorial(i + 1) for i in range(5)]
        step, by = sum((i + 1) * power for i, power in enumerate(powers)), h * sum(powers[:4]) @ B
        period = np.linalg.matrix_power(step, 4)
        forced = sum(np.linalg.matrix_power(step, i) for i in range(4)) @ by
        # the sixteen accelerations of a period are sums of a few terms, rounded to 1e-16 of the largest
        np.testing.assert_allclose(own_A, period, rtol=0, atol=1e-13 * np.abs(period).max())
        np.testing.assert_allclose(own_B, forced, rtol=0, atol=1e-13 * np.abs(forced).max())


@pytest.mark.parametrize("devices", DEVICES.values(), ids=DEVICES)
def test_batched_exact_engines_equal_single_ones(devices):
    people = crowd(4, 2)
    held_by = variants(devices, people)
    plants = hold(held_by.plants(), SCENARIO.T)
    process = replace(assemble(SCENARIO, NoCoupling()).process, force_limit=np.array([0.3, 0.2]))
    rest = np.zeros((plants.A.shape[1], len(people)))

    def outside(first, ticks):
        return impulse_forces(held_by.scene, SCENARIO.T, first, ticks)

    together = driven(process, ExactEngine(plants), outside, 400, rest)
    assert (np.abs(together.f) == 0.2).any()
    for i in range(len(people)):
        one = hold(plant(build(devices, people.humans(i)).model), SCENARIO.T)
        alone = driven(process, ExactEngine(one), outside, 400, rest[:, :1])
        # Sums are in another order, and a clipped unstable loop multiplies rounding errors.
        np.testing.assert_allclose(together.s[:, :, i], alone.s[:, :, 0], rtol=1e-6, atol=1e-11)


def test_a_human_depends_on_seed_and_index_only():
    few = dict(zip([7, 3], next(crowds(SCENARIO.population, 2, 5, [7, 3], 1))[1].links, strict=True))
    many = next(crowds(SCENARIO.population, 2, 5, range(20), 1))[1].links
    np.testing.assert_array_equal(few[7], many[7])
    np.testing.assert_array_equal(few[3], many[3])
    assert not np.array_equal(many[3], draw(SCENARIO.population, 2, 6, 3, 1))
    assert {c.links.shape[2]: len(i) for i, c in crowds(SCENARIO.population, 2, 5, range(20), MIXED)}.keys() == {1, 2}


@pytest.mark.slow
def test_shards_repeat_the_single_run_bit_for_bit(monkeypatch):
    """Verdicts and MuJoCo's traces do not depend on the shards; most traces are long enough for a growth rate."""
    monkeypatch.setattr(examine_module, "_BATCH", 10)
    question = Validation(SCENARIO, PUBLISHED["I"], 0, 25, MIXED, "both", 0.3)
    assert len(question.batches()) > 2
    alone, shared = validate(question), validate(question, shards=2)
    for field in fields(Findings):
        np.testing.assert_array_equal(getattr(alone, field.name), getattr(shared, field.name), err_msg=field.name)
    np.testing.assert_array_equal(alone.index, np.arange(question.humans))
    assert np.isfinite(alone.mujoco).all()
    assert np.isfinite(alone.trace).mean() > 0.9
    # the trace is MuJoCo's own, not the exact engine's again
    assert not np.array_equal(alone.trace[:10], validate(replace(question, humans=10, engine="exact")).trace)


class EveryThirdLossless:
    """The packaged population; on average, one set of hands in three has no dampers."""

    def draw(self, rng, channels):
        hands = SCENARIO.population.draw(rng, channels)
        if rng.random() > 1 / 3:
            return hands
        return [Human(tuple(replace_fields(link, damping=0.0) for link in hand.links)) for hand in hands]


@pytest.mark.slow
def test_sampled_traces_are_those_of_all_hands():
    """MuJoCo traces lossless hands, those nearest to instability and random ones; the exact engine traces the rest."""
    people = SCENARIO.replace(population=EveryThirdLossless())
    question = Validation(people, PUBLISHED["I"], 3, 200, 1, "both", 0.3)
    some, every = validate(question), validate(replace(question, all_traces=True))
    exact = validate(replace(question, engine="exact"))
    chosen = some.witnessed
    assert every.witnessed.all()
    assert not exact.witnessed.any()
    for name in ("trace", "trace_error", "clipped"):
        # The order of sums depends on the number of hands in a batch: rates differ by about 1e-13 of their size.
        values = getattr(some, name)
        np.testing.assert_allclose(values[chosen], getattr(every, name)[chosen], rtol=1e-9)
        np.testing.assert_allclose(values[~chosen], getattr(exact, name)[~chosen], rtol=1e-9)
    np.testing.assert_array_equal(some.mujoco, every.mujoco)  # both engines give a rate for every hand
    assert np.isfinite(some.mujoco).all()
    lossless = some.damping == 0
    assert 40 < lossless.sum() < 100
    assert chosen[lossless].all()
    for batch in question.batches():
        assert chosen[batch[int(np.abs(some.exact[list(batch)]).argmin())]]
    assert 64 <= chosen.sum() < 160  # the random sample has 64 hands
    more = Traces.of(question, some)
    assert (more.witnessed, more.humans) == (chosen.sum(), 200)


def test_no_random_human_destabilises_the_designed_coupling():
    coupling = choose(SCENARIO, "I").coupling
    findings = validate(Validation(SCENARIO, coupling, 0, 200, 1, "both", 0.0))
    assert not unstable(findings.exact).any()
    assert not unstable(findings.mujoco).any()
    assert not findings.disagreements.any()
    traced = validate(Validation(SCENARIO, coupling, 0, 12, MIXED, "both", 2.0))
    # nearly equal eigenvalues lose half the digits
    np.testing.assert_allclose(traced.trace, traced.exact, rtol=0, atol=1e-7)
    assert not traced.clipped.any()
    assert (traced.energy >= 0).all()
    # Definition 3 of the paper: damped humans come to rest, so the last quarter is calmer than the second.
    assert (traced.settling < 1).all()


def test_uncoupled_loops_are_mostly_unstable():
    findings = validate(Validation(SCENARIO, NoCoupling(), 0, 200, 1, "exact", 2.0))
    assert unstable(findings.exact).mean() > 0.6
    assert findings.energy.min() < 0
    # nearly equal eigenvalues lose half the digits
    np.testing.assert_allclose(findings.trace, findings.exact, rtol=0, atol=1e-7)


def test_opposite_growth_is_a_disagreement():
    exact, other = np.array([1.0, -1.0, 5e-4, 1.0]), np.array([-1.0, 1.0, -1.0, np.nan])
    assert disagree(exact, other).tolist() == [True, True, False, False]


@pytest.mark.slow
def test_the_worst_human_replays(tmp_path):
    out, file = tmp_path / "out", tmp_path / "r.json"
    options = ["--case", "none", "--humans", "30", "--engine", "exact", "--duration", "0.5"]
    assert main([*options, "--out", str(out), "--json", str(file)]) == 0
    report = json.loads(file.read_text())
    assert report["humans"] == 30
    assert report["unstable"]["exact"] > 15
    assert report["unstable"]["mujoco"] is None
    assert report["disagreements"] == 0
    assert not report["certified"]
    assert (out / "population.png").is_file()
    replay = ["--case", "none", "--engine", "exact", "--duration", "0.5", "--no-plot", "--out", str(out)]
    assert run_command.main([*replay, "--human", str(out / "worst-human.toml"), "--json", str(file)]) == 0
    stability = json.loads(file.read_text())["stability"]
    assert stability["spectral_radius"] == pytest.approx(report["worst"]["spectral_radius"], abs=1e-12)
    assert stability["exact_verdict"] == "unstable"
    # Besides the drawn hands the command judges the scenario's hands, or those of a file instead.
    own = report["own_humans"]
    assert (own["from"], own["exact_verdict"], own["holds"]) == ("omega-pair", "unstable", True), (
        "nothing was certified"
    )
    assert own["exact_growth_rate_per_s"] == pytest.approx(1.4812, abs=1e-4)
    others = ["--human", str(out / "worst-human.toml"), "--humans", "1", "--engine", "exact", "--duration", "0"]
    assert main(["--case", "none", *others, "--no-plot", "--out", str(out), "--json", str(file)]) == 0
    own = json.loads(file.read_text())["own_humans"]
    assert own["spectral_radius"] == pytest.approx(report["worst"]["spectral_radius"], abs=1e-12)


def test_a_wrong_engine_fails_the_command(tmp_path, monkeypatch):
    """MuJoCo's Euler calls unstable loops stable; the command must fail and store the humans."""
    monkeypatch.setattr(
        examine_module,
        "mujoco_plants",
        lambda held_by, process, nthread, late: mujoco_plants(held_by, process, "Euler", 1),
    )
    file = tmp_path / "r.json"
    options = ["--case", "none", "--humans", "20", "--duration", "0", "--no-plot"]
    assert main([*options, "--out", str(tmp_path), "--json", str(file)]) == 1
    report = json.loads(file.read_text())
    assert not report["holds"]
    assert report["disagreements"] == len(report["disagreeing"]) > 0
    assert (tmp_path / f"disagreement-{report['disagreeing'][0]['index']}.toml").is_file()


def test_ctrl_c_keeps_the_batches_that_are_done(tmp_path, monkeypatch):
    calls, real = [], examine_module._examine

    def interrupted(question, batch, ticked):
        calls.append(batch)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(question, batch, ticked)

    monkeypatch.setattr(examine_module, "_examine", interrupted)
    monkeypatch.setattr(examine_module, "_BATCH", 125)
    options = ["--humans", "300", "--engine", "exact", "--duration", "0", "--no-plot"]
    code, report = reported(main, tmp_path, *options, "--out", str(tmp_path))
    assert (code, report["interrupted"], report["humans"]) == (130, True, 125)


@pytest.mark.slow
def test_ctrl_c_ends_other_processes_batches():
    """Ctrl-C does not wait for a batch of 50,000 simulated seconds."""
    scenario = load("omega-pair")
    question = Validation(scenario, SpringDamper([500, 500], [0.4, 0.4]), 0, 250, 1, "mujoco", 50_000.0)
    before = set(multiprocessing.active_children())
    timer = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    findings = validate(question, shards=2)
    timer.join()
    assert findings.interrupted
    assert findings.index.size == 0
    assert set(multiprocessing.active_children()) <= before


def test_restless_short_traces_give_no_verdict():
    """Settling decides only on traces that are long compared with the slowest decay of the same humans."""
    question = Validation(load("omega-pair"), SpringDamper([500, 500], [0.4, 0.4]), 0, 6, 1, "exact", 0.5)
    findings = validate(question)
    for duration in (0.5, 40.0):
        traces = Traces.of(replace(question, duration=duration), findings)
        assert traces.slowest_decay_s == pytest.approx(-1 / findings.exact.max())
        assert traces.settling_decides == (traces.reason is None) == (duration > 30)


@pytest.fixture(scope="module")
def four():
    """Return a question and findings with made-up figures of four hands, of which the second clips its forces."""
    question = Validation(SCENARIO, NoCoupling(), 0, 4, 1, "both", 2.0)
    columns = {
        "exact": [-1.0, -0.5, 2.0, -3.0],
        "radius": [0.9, 0.95, 1.1, 0.8],
        "clipped": [0, 7, 0, 0],
        "energy": [-1.0, -4.0, 5.0, 0.0],
        "audited": [9.0] * 4,
        "settling": [0.5, 1.5, 0.4, 0.2],
        "switching": [-1.0, 3.0, 2.0, np.nan],
        "switching_mujoco": [np.nan, 1.0, -1.0, np.nan],
    }
    findings = validate(replace(question, engine="exact", duration=0.0))
    return question, replace(findings, **{name: np.array(values) for name, values in columns.items()})


def test_energy_audits_leave_out_clipped_traces(four):
    question, findings = four
    audit = EnergyAudit.of(question, findings)
    assert (audit.audited, audit.clipped, audit.violated, audit.least_J, audit.holds) == (3, 1, 1, -1.0, False)
    limited = EnergyAudit.of(replace(question, lag=(0.0, 0.0)), findings)  # the account covers a limiter
    assert (limited.audited, limited.violated, limited.least_J) == (4, 2, -4.0)


def test_verdicts_name_the_worst_hands(four):
    question, findings = four
    worst, traces = WorstDrawn.of(question, findings), Traces.of(question, findings)
    assert (worst.growth_rate_per_s, worst.who.index) == (2.0, 2)
    assert (traces.stable, traces.stable_and_settling, traces.slowest_settling) == (3, 2, 1.5)
    assert (traces.clipped_runs, traces.slowest_decay_s) == (1, 2.0)
    covered, not_covered = (Growing.of(question, findings, None, covered) for covered in (True, False))
    assert (covered.unstable.exact, covered.unstable.mujoco, covered.humans, covered.mujoco_unclipped) == (2, 1, 3, 2)
    assert (covered.largest_growth_per_s, covered.worst_index) == (3.0, 1)
    assert (covered.holds, not_covered.holds) == (False, True)


def test_adversaries_contradict_certificates_only():
    growing, decaying = (Worst((), (), 1.0, growth, 80.0, 7) for growth in (1e-3, -1e-3))
    holds = [Attacked.of(worst, 0.9, certified).holds for worst in (growing, decaying) for certified in (True, False)]
    assert holds == [False, True, True, True]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--humans", "0"], "--humans is 0.*1 to 1000000"),
        (["--humans", "many"], "--humans is 'many'"),
        (["--engine", "drake"], "--engine is 'drake'.*exact, mujoco, both"),
        (["--links", "9"], "--links is '9'"),
        (["--shards", "0"], "--shards is 0.*1 to 256"),
        (["--generations", "0"], "--generations is 0.*1 to 10000"),
        (["--duration", "-1"], "--duration is -1.*0 and 0.0048 to 100000 s"),
        (["--seed", "-1"], "--seed is -1"),
        (["--case", "none", "--coupling", "published"], "with --case none"),
    ],
)
def test_bad_options_are_refused(options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        main([*options, "--out", str(tmp_path)])


def test_a_negative_range_is_refused(tmp_path):
    text = (load.__globals__["SCENARIOS"] / "omega-pair.toml").read_text() + "\n[population]\nmass = [-1.0, 3.0]\n"
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(InputError, match=r"mass #1 is -1"):
        main(["--scenario", str(tmp_path / "s.toml")])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[human]]\nlinks = [{mass = -1.0, damping = 0, stiffness = 0}]\n", "mass is -1"),
        ("[[human]]\nlinks = [{mass = 1.0, damping = 0, stiffness = 0}]\n", "has 1 .* tables, expected 2"),
        ("[[human]]\nlinks = []\n", "length >= 1"),
        (
            TWO + "[[person]]\nholds = [1, 3]\nmass = 1.0\ndamping = 0\nstiffness = 0\n",
            "has device 3.*1 to 2",
        ),
        (TWO + "[[person]]\nholds = [1]\nmass = 1.0\ndamping = 0\nstiffness = 0\n", "two or more different devices"),
        (TWO + "[[person]]\nholds = [1, 2]\nmass = 0\ndamping = 0\nstiffness = 0\n", "mass is 0"),
        ("[[people]]\n", "unknown field `people`"),
        ("[[human", "not valid TOML"),
    ],
)
def test_bad_human_files_are_refused(text, message, tmp_path):
    (tmp_path / "h.toml").write_text(text)
    with pytest.raises(InputError, match=message):
        run_command.main(["--human", str(tmp_path / "h.toml"), "--out", str(tmp_path)])


class OwnEngine(ExactEngine):
    """The exact engine of one simulation, as a user would write it."""

    def __init__(self, simulation):
        super().__init__(simulation.plant)


@pytest.mark.parametrize("delays", [None, VaryingDelay((1, 2), (2, 3), "random")])
def test_own_engines_judge_every_hand(delays):
    """A user's engine, built for each set of humans, gives the growth rates of the stacked exact engine."""
    scenario = load().replace(varying_delay=delays)
    findings = examine_module._examine(Validation(scenario, PUBLISHED["I"], 0, 3, MIXED, OwnEngine, 0.5), range(3))
    np.testing.assert_allclose(findings.mujoco, findings.exact, rtol=1e-6)
    np.testing.assert_allclose(findings.trace, findings.exact, rtol=1e-5)
    np.testing.assert_allclose(findings.switching_mujoco, findings.switching, rtol=1e-6)
    assert not findings.disagreements.any()


def test_own_engines_refuse_latency():
    question = Validation(load().replace(latency=((0.0, 1e-4),) * 2), PUBLISHED["I"], 0, 2, 1, OwnEngine, 0.5)
    with pytest.raises(InputError, match=r"OwnEngine: only these engines simulate period and latency: mujoco"):
        examine_module._examine(question, range(2))


def slow_question(humans: int, seed: int, duration: float) -> Validation:
    """Return a validation of three delayed devices, joined to 0.3 kg by soft springs; motions take seconds to decay."""
    rng = np.random.default_rng(seed)
    springs = tuple(Spring((end, "m"), float(rng.uniform(20, 400)), float(rng.uniform(0, 0.5))) for end in "abc")
    scenario = load("three-rigid").replace(environment=Network(("a", "b", "c"), springs, {"m": 0.3}), theta=(2, 3, 1))
    return Validation(scenario, NoCoupling(), seed, humans, 1, "both", duration)


def slow_loops(humans: int, seed: int, duration: float) -> Findings:
    return validate(slow_question(humans, seed, duration))


def test_no_trace_contradicts_the_eigenvalues_of_slow_loops():
    findings = slow_loops(30, 3, 1.5)
    assert not findings.disagreements.any()
    decided = findings.trace_decides
    assert 0 < decided.sum() < decided.size
    np.testing.assert_array_equal(findings.trace[decided] > 0, findings.exact[decided] > 0)
    assert (np.abs(findings.trace[decided] - findings.exact[decided]) < findings.trace_error[decided]).all()
    assert (np.abs(findings.trace[decided]) * 1.5 >= 4 - 1e-9).all()  # at least four time constants


def test_traces_decide_only_what_eigenvalues_say():
    """These are 75 of the 2,000 slow loops of `make validate`."""
    rows = list(slow(0, 75))
    assert all(row.holds for row in rows)
    assert 0 < sum(row.decided for row in rows) < 75


def test_inaccurate_traces_are_no_disagreement():
    """A trace that grows while all maps decay is no disagreement if its error exceeds its rate."""
    findings = slow_loops(4, 0, 0.3)
    rates = {name: np.full(4, value) for name, value in (("exact", -0.331), ("mujoco", -0.331), ("trace", 0.168))}
    slow = replace(findings, **rates, trace_error=np.full(4, 2.0))
    assert not slow.disagreements.any()
    question = slow_question(4, 0, 0.3)
    assert disagreement_words(question, slow) == "0"
    assert replace(slow, trace_error=np.full(4, 0.1)).disagreements.all()
    grows = replace(slow, mujoco=np.array([-0.331, 0.2, -0.331, -0.331]))
    assert grows.disagreements.tolist() == [False, True, False, False]
    words = disagreement_words(question, grows)
    for part in ("index 1", "exact -0.331 1/s", "MuJoCo +0.2 on its map", "--human disagreement-1.toml"):
        assert part in words
    assert "trace" not in words
    assert "vary" not in words
    varying = replace(slow, switching=np.full(4, -0.3), switching_mujoco=np.array([-0.3, -0.3, 0.1, -0.3]))
    assert "; exact -0.3, MuJoCo +0.1 while delays or ticks vary" in disagreement_words(question, varying)
