"""The exponential engine is exact on linear scenes and of first order on others; MuJoCo's forces drive it.

Growth is in 1/s. Tolerances without a comment cover rounding.
"""

import mujoco
import numpy as np
import pytest
import scipy
from driven import Driven, alike, driven, tick_by_tick
from scipy.linalg import expm, expm_cond

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.models.device import CompliantDevice
from haptic_loop.models.hold import expm_each, exponential_step, hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import Crowd, Plant, plant, variants
from haptic_loop.sim import engines
from haptic_loop.sim.accuracy import (
    _check_substeps,
    _measured_hold,
    _missed,
    compare_engines,
    cross_check,
    default_substeps,
    pace,
    pick,
    simulated_growth,
)
from haptic_loop.sim.api import run_scenario
from haptic_loop.sim.engines import (
    EXPONENTIAL,
    INTEGRATORS,
    Engine,
    ExactEngine,
    MujocoBatchEngine,
    MujocoEngine,
    _PlantSpeed,
    default_integrator,
)
from haptic_loop.sim.passivity_layer import EnergyNet
from haptic_loop.sim.run import EngineSettings, assemble, make_engine, run
from haptic_loop.sim.scenario import InputError, VaryingDelay, load
from haptic_loop.sim.stability import exact_growth

SCENARIO = load()
RUBBING = SCENARIO.replace(device=(CompliantDevice(friction=0.5),) * 2)
RESTING = SCENARIO.replace(human=(Human((Link(0.3, 3.0, 200.0),)),) * 2, tap=None)


def stiff(transmission: float):
    return assemble(
        SCENARIO.replace(device=(CompliantDevice(transmission_stiffness=transmission),) * 2), PUBLISHED["I"]
    )


def knocked(simulation, engine: Engine, ticks: int, start=None) -> Driven:
    """Run without voluntary motion, with 5 N on both handles for the first 20 ticks."""

    def outside(first, count):
        w = np.zeros((count, simulation.scene.outside))
        w[: max(0, 20 - first), list(simulation.scene.tapped)] = 5.0
        return w

    begin = np.zeros((simulation.plant.A.shape[0], 1)) if start is None else start
    return driven(simulation.process, engine, outside, ticks, begin)


@pytest.fixture(scope="module")
def simulation():
    return assemble(SCENARIO, PUBLISHED["I"])


# ---- exactness


def longer(matrix):
    """Compute exp(matrix) in extended precision: by a series of exp(matrix / 2^40) - 1 and 40 squarings."""
    part = matrix.astype(np.longdouble) / np.longdouble(2) ** 40
    term, less_one = np.eye(len(matrix), dtype=np.longdouble), 0
    for k in range(1, 12):
        term = term @ part / k
        less_one = less_one + term
    for _ in range(40):
        less_one = 2 * less_one + less_one @ less_one
    return (less_one + np.eye(len(matrix))).astype(float)


@pytest.mark.parametrize("T", [1e-5, 1.2e-3, 1e-2, 0.1])
@pytest.mark.parametrize("stiffness", [14500.0, 1.45e6, 1e9])
def test_one_step_is_exact_whatever_the_stiffness(stiffness, T):
    """The measured map equals exponentials by SciPy and in extended precision.

    Velocities are divided by `fastest`, about the fastest mode [rad/s], so that they are of the size of positions.
    Rounding of the generator by `eps`, relative to its norm, moves its exponential by `eps` times the condition number.
    Rounding of the result adds one `eps` for each term of its sums.
    """
    loop = stiff(stiffness)
    continuous, fastest = plant(loop.scene.model), np.sqrt(stiffness / 0.06)
    states, inputs = continuous.B.shape
    generator = np.zeros((states + inputs, states + inputs))
    generator[:states, :states], generator[:states, states:] = continuous.A, continuous.B
    unit = np.r_[np.ones(states // 2), np.full(states // 2, fastest), np.ones(inputs)]
    step = _measured_hold(loop, "mujoco", EXPONENTIAL, 1, T)
    own = np.hstack([step.A, step.B]) * unit / unit[:states, None]
    scaled = generator * T * unit / unit[:, None]
    exact, scipys = longer(scaled), expm(generator * T) * unit / unit[:, None]
    allowed = np.finfo(float).eps * (states + inputs + expm_cond(scaled)) * np.linalg.norm(exact)
    assert np.linalg.norm(own - exact[:states]) <= allowed
    assert np.linalg.norm(own - scipys[:states]) <= 2 * allowed  # SciPy's result is rounded, too


@pytest.mark.parametrize("coupling", [NoCoupling(), PUBLISHED["I"]], ids=["no coupling", "published"])
@pytest.mark.parametrize("stiffness", [14500.0, 1.45e6])
def test_growth_equals_that_of_the_exact_loop(stiffness, coupling):
    loop = assemble(SCENARIO.replace(device=(CompliantDevice(transmission_stiffness=stiffness),) * 2), coupling)
    assert simulated_growth(loop, EXPONENTIAL, 1) == pytest.approx(exact_growth(loop), abs=1e-9)
    # Four Runge-Kutta steps, too few for the stiffer transmission, err more than one exponential step.
    if stiffness == 14500.0 and coupling is PUBLISHED["I"]:
        assert abs(simulated_growth(loop, "RK4", 4) - exact_growth(loop)) > 1e-5


def test_runs_equal_the_exact_engine_at_saturation():
    """MuJoCo and the exact engine clip forces in the same way."""
    devices = tuple(device.__class__(force_limit=0.05) for device in SCENARIO.device)
    loop = assemble(SCENARIO.replace(device=devices), PUBLISHED["I"])
    own, exact = (knocked(loop, make_engine(loop, name), 500) for name in ("mujoco", "exact"))
    assert (np.abs(exact.f) >= 0.05).any()
    np.testing.assert_allclose(own.s, exact.s, rtol=1e-9, atol=1e-13)


def test_more_substeps_change_nothing(simulation):
    one, three = (knocked(simulation, make_engine(simulation, "mujoco", EXPONENTIAL, n), 500).s for n in (1, 3))
    np.testing.assert_allclose(one, three, rtol=1e-9, atol=1e-13)


# ---- limits of exactness


def test_the_engine_takes_mujocos_forces(simulation):
    """If springs change after the engine was built, its Jacobian J is old, but accelerations follow the new springs.

    With a wrong J the method is of first order: halving the step halves the error."""
    wrong = 1.5
    errors = []
    for substeps in (8, 16):
        engine = MujocoEngine(simulation.scene, SCENARIO.T, EXPONENTIAL, substeps)
        engine.model.tendon_stiffness[...] *= wrong  # the engine has a copy of the model
        errors.append(_one_period(simulation.process, engine, simulation.scene.outside))
    truth = hold(plant(engine.model), SCENARIO.T).A
    old = hold(plant(simulation.scene.model), SCENARIO.T).A
    first, second = (np.abs(step - truth).max() for step in errors)
    assert np.abs(old - truth).max() > 5 * first
    assert np.log2(first / second) == pytest.approx(1, abs=0.2)


def _one_period(process: Process, engine: Engine, outside: int):
    """Return an engine's map (8, 8) of plant states over one period, from every basis state."""
    columns = []
    buffer = StepBuffer(process, 1, 8, outside)
    for unit in 1e-6 * np.eye(8):
        buffer.s[0, :, 0] = unit
        engine.start(buffer)
        engine.advance(0)
        columns.append(buffer.s[1, :, 0] / 1e-6)
    return np.stack(columns, axis=1)


@pytest.mark.slow
def test_friction_makes_the_engine_first_order():
    """Coulomb friction switches within a step, so the error against RK4 x 32 only halves with the step."""
    loop = assemble(RUBBING, PUBLISHED["I"])

    def positions(integrator, substeps):
        return knocked(loop, make_engine(loop, "mujoco", integrator, substeps), 800).s[:, :2]

    truth = positions("RK4", 32)
    errors = [np.sqrt(np.mean((positions(EXPONENTIAL, n) - truth) ** 2)) for n in (8, 16)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1, abs=0.3)
    assert np.sqrt(np.mean((positions("RK4", 4) - truth) ** 2)) < errors[1] / 30


def test_springs_need_mujocos_position_stage(simulation):
    """The position stage computes a tendon's length: mj_forwardSkip without it leaves the old spring forces."""
    data = mujoco.MjData(simulation.scene.model)
    mujoco.mj_forward(simulation.scene.model, data)
    data.qpos[0] = 1e-3
    mujoco.mj_forwardSkip(simulation.scene.model, data, mujoco.mjtStage.mjSTAGE_POS, 1)
    skipped = data.qacc.copy()
    mujoco.mj_forward(simulation.scene.model, data)
    # A spring of 14500 N/m, stretched by 1 mm, acts on a motor of 0.06 kg.
    assert data.qacc[0] == pytest.approx(-14.5 / 0.06, rel=1e-9)
    assert skipped[0] == 0.0


# ---- batches


def hands(count: int) -> Crowd:
    rng = np.random.default_rng(0)
    return Crowd(np.exp(rng.uniform(np.log([0.01, 0.1, 1.0]), np.log([3.0, 30.0, 2000.0]), (count, 2, 1, 3))))


def test_a_batch_is_a_loop_over_single_engines(simulation):
    """A batch of one equals a single engine bit for bit; a batch of several sums products in another order."""
    start = 1e-3 * np.random.default_rng(0).normal(size=(8, 3))

    def batch(nsim, nthread=1):
        return MujocoBatchEngine(alike(simulation.scene, nsim), SCENARIO.T, EXPONENTIAL, 1, nthread)

    single = [tick_by_tick(make_engine(simulation, "mujoco")) for _ in range(3)]
    alone = [knocked(simulation, engine, 300, start[:, [i]]).s for i, engine in enumerate(single)]
    for i in range(3):
        np.testing.assert_array_equal(knocked(simulation, batch(1), 300, start[:, [i]]).s, alone[i])
    together = knocked(simulation, batch(3), 300, start).s
    np.testing.assert_allclose(together, np.concatenate(alone, axis=2), rtol=1e-10, atol=1e-15)
    np.testing.assert_array_equal(together, knocked(simulation, batch(3, nthread=2), 300, start).s)


@pytest.mark.parametrize("substeps", [1, 2])
def test_batched_simulations_equal_those_of_their_scenes(substeps):
    """Each simulation of a batch equals that of its own compiled scene, and that of the exact batch."""
    crowd = hands(5)
    held_by = variants(SCENARIO.device, crowd)
    loop = assemble(SCENARIO, PUBLISHED["I"])
    start = 1e-3 * np.random.default_rng(1).normal(size=(8, 5))
    batch = MujocoBatchEngine(held_by, SCENARIO.T, EXPONENTIAL, substeps)
    together = knocked(loop, batch, 300, start).s
    for i in range(5):
        own = assemble(SCENARIO.replace(human=crowd.humans(i)), PUBLISHED["I"])
        alone = knocked(own, make_engine(own, "mujoco", EXPONENTIAL, substeps), 300, start[:, [i]]).s
        np.testing.assert_allclose(together[:, :, [i]], alone, rtol=1e-9, atol=1e-13)
    exact = ExactEngine(hold(held_by.plants(), SCENARIO.T))
    np.testing.assert_allclose(together, knocked(loop, exact, 300, start).s, rtol=1e-9, atol=1e-13)


def test_many_sampled_plants_are_as_exact_as_one():
    """Exponentials of a stack and of one plant equal SciPy's to 1e-12 of an entry plus 1e-14 of the largest entry."""
    plants = variants(SCENARIO.device, hands(20)).plants()
    together = hold(plants, SCENARIO.T)
    n, inputs = plants.B.shape[1:]
    for i in range(20):
        alone = hold(Plant(plants.A[i], plants.B[i], plants.C), SCENARIO.T)
        generator = np.zeros((n + inputs, n + inputs))
        generator[:n] = np.hstack([plants.A[i], plants.B[i]])
        step = scipy.linalg.expm(generator * SCENARIO.T)[:n]
        for own in (together.A[i], together.B[i]), (alone.A, alone.B):
            np.testing.assert_allclose(np.hstack(own), step, rtol=1e-12, atol=1e-14 * np.abs(step).max())


# ---- the default integrator and number of substeps


def test_default_integrator_and_substeps_follow_from_the_scene(simulation):
    rubbing = assemble(RUBBING, PUBLISHED["I"])
    assert (default_integrator(simulation.scene), default_substeps(simulation, EXPONENTIAL)) == (EXPONENTIAL, 1)
    assert (default_integrator(rubbing.scene), default_substeps(rubbing, "RK4")) == ("RK4", 4)
    # A stiff linear scene needs one exponential step, but 32 Runge-Kutta steps.
    assert default_substeps(stiff(1.45e6), EXPONENTIAL) == 1
    assert default_substeps(stiff(1.45e6), "RK4") == 32
    assert _check_substeps(stiff(1.45e6), EXPONENTIAL, 1) == []
    assert _check_substeps(rubbing, EXPONENTIAL, 8) == [
        "exponential x 8: with friction its error is of first order; RK4 is more accurate at equal cost "
        "(see --cross-check)."
    ]
    assert default_substeps(rubbing, EXPONENTIAL) == 4


@pytest.mark.parametrize(("mode", "rate"), [(0.0, 6.0), (0.0, 6.5), (1.3, 2.0), (0.1, 0.1)])
def test_substeps_are_the_fewest_within_the_limits(mode, rate):
    """A step is at most 0.2 rad of the fastest mode and below the least time constant; a period has 4 steps or more."""
    count = _PlantSpeed(mode, rate).substeps(1.0)
    fits = [n for n in range(4, 20) if mode / n <= 0.2 and rate / n < 1]
    assert count == fits[0]
    assert [_PlantSpeed(mode, rate).within(1 / n) for n in range(4, 20)] == [n in fits for n in range(4, 20)]


def test_engines_default_to_the_scenes_integrator_and_substeps(simulation):
    rubbing = assemble(RUBBING, PUBLISHED["I"])
    for loop, integrator, substeps in ((simulation, EXPONENTIAL, 1), (rubbing, "RK4", 4)):
        named = knocked(loop, make_engine(loop, "mujoco", integrator, substeps), 100).s
        np.testing.assert_array_equal(knocked(loop, make_engine(loop, "mujoco"), 100).s, named)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda a: make_engine(a, "drake"), "engine is 'drake'.*mujoco, exact"),
        (lambda a: make_engine(a, "mujoco", "Euler2"), f"integrator is 'Euler2'.*{', '.join(INTEGRATORS)}"),
        (lambda a: make_engine(a, "mujoco", EXPONENTIAL, 0), "substeps is 0.*whole numbers from 1"),
        (
            lambda a: make_engine(assemble(RUBBING, PUBLISHED["I"]), "exact"),
            "have Coulomb friction, which the exact engine",
        ),
    ],
)
def test_refusals_name_the_wrong_setting(simulation, call, message):
    with pytest.raises(ValueError, match=message):
        call(simulation)


def test_light_handles_need_one_exponential_step():
    """A 1 g handle in an undamped hand needs at least 24 Runge-Kutta steps, but one exponential step."""
    device = CompliantDevice(handle_mass=1e-3)
    human = Human((Link(0.0, 0.0, 300.0),))
    loop = assemble(SCENARIO.replace(device=(device,) * 2, human=(human,) * 2), PUBLISHED["I"])
    assert pace(plant(loop.scene.model).A).substeps(SCENARIO.T) >= 24
    assert simulated_growth(loop, EXPONENTIAL, 1) == pytest.approx(exact_growth(loop), abs=1e-9)


# ---- the cheapest setting within an error


def cheapest(loop, error, ticks):
    return pick(compare_engines(loop, error, ticks), error)


def test_one_exponential_step_is_cheapest_for_smooth_scenes(simulation):
    setting = cheapest(simulation, 1e-9, 500)
    assert (setting.integrator, setting.substeps) == (EXPONENTIAL, 1)
    assert setting.position_relative_rms < 1e-11
    assert setting.cpu_s > 0


@pytest.mark.slow
def test_with_friction_the_cheapest_setting_keeps_the_error():
    """RK4 x 64 is the reference; RK4 with half the chosen number of substeps exceeds a quarter of the allowed error."""
    loop, ticks = assemble(RUBBING, PUBLISHED["I"]), 500

    def positions(integrator, substeps):
        return run(loop, make_engine(loop, "mujoco", integrator, substeps), ticks=ticks).s[:, :2]

    def missed(*setting):
        return np.sqrt(np.mean((positions(*setting) - truth) ** 2) / np.mean(truth**2))

    truth = positions("RK4", 64)
    for allowed, expected in ((1e-2, (EXPONENTIAL, "Euler")), (1e-6, ("RK4",))):
        choices = compare_engines(loop, allowed, ticks)
        assert all(choice.position_relative_rms > 0 for choice in choices)  # the reference has an error, too
        chosen = pick(choices, allowed)
        assert chosen.integrator in expected  # exponential and Euler steps need one evaluation each
        assert missed(chosen.integrator, chosen.substeps) <= chosen.position_relative_rms <= allowed
        if chosen.substeps > 1:
            assert missed("RK4", chosen.substeps // 2) > allowed / 4


def test_gaps_between_runs_bound_the_finest_error():
    """Gaps are distances between runs with n and 2 n substeps.

    For runs x + c/n the bound is 1.5 c/n of the largest n. If gaps shrink by a factor q from 0.6 to 0.7, it is the last
    gap times q/(1 - q).
    """
    assert _missed([1 / n - 1 / (2 * n) for n in (1, 2, 4)]) == pytest.approx(1.5 / 8)
    assert _missed([1.0, 0.65, 0.65**2]) == pytest.approx(sum(0.65**k for k in range(3, 99)))
    assert _missed([1.0, 0.1]) == _missed([np.inf, 0.1, 0.01]) == np.inf
    assert _missed([1e-12, 2e-12, 1e-12]) < 1e-11  # gaps that are rounding errors need not shrink
    assert _missed([0.0, 0.0, 0.0]) == 0
    # Measured on two uncoupled omegas with 0.02 N of friction for 6 s; `apart` is the error against 512 substeps.
    gaps = [1.05, 0.167, 0.0794, 0.0849, 0.0183, 0.0117]
    for count, apart in ((3, 9.76e-2), (4, 1.29e-2), (5, 3.11e-2), (6, 1.97e-2)):
        assert _missed(gaps[:count]) > apart


@pytest.mark.parametrize(
    ("scenario", "error", "message"),
    [
        (RESTING, 1e-3, "nothing moves: add a tap or a voluntary motion"),
        (RESTING.replace(device=RUBBING.device), 1e-3, "nothing moves: add"),
        (SCENARIO, 0.0, "--error is 0, expected a positive relative error"),
        (
            SCENARIO,
            1e-18,
            "--error 1e-18: the most accurate setting with the right verdict, exponential x 1, has error",
        ),
        (RUBBING, 1e-18, "--error 1e-18: RK4 has an error of .* with up to 128 substeps"),
    ],
)
def test_unreachable_errors_are_refused(scenario, error, message):
    with pytest.raises(InputError, match=message):
        cheapest(assemble(scenario, PUBLISHED["I"]), error, 50)


def test_too_many_evaluations_are_refused_after_two_runs(monkeypatch):
    """After two runs the estimate for all is 512 steps of 4 evaluations in 100 ticks, over 2e5, so no third begins."""
    monkeypatch.setattr("haptic_loop.sim.accuracy._MOST_EVALUATIONS", 2e5)
    moved = []
    words = r"requires RK4 with about 256 substeps, 0 million evaluations;.*0\.2 million"
    with pytest.raises(InputError, match=words):
        compare_engines(assemble(RUBBING, PUBLISHED["I"]), 1e-12, 100, lambda done, ticks: moved.append((done, ticks)))
    assert moved.count((100, 100)) == 2


def test_a_wrong_verdict_is_shown_and_never_chosen():
    """Euler calls the uncoupled loop stable, so it is not chosen, however large an error is allowed."""
    choices = {c.name: c for c in compare_engines(assemble(SCENARIO, NoCoupling()), 1.0, 200)}
    assert not choices["Euler x 1"].verdict_correct
    assert choices["RK4 x 1"].verdict_correct
    assert pick(list(choices.values()), 1.0).verdict_correct


@pytest.mark.slow
def test_engines_are_compared_on_the_actual_run():
    scenario, errors = SCENARIO.replace(duration=0.5, varying_delay=VaryingDelay((1, 1), (3, 2))), []
    for net in (None, EnergyNet(0.0)):
        outcome = run_scenario(scenario, NoCoupling(), settings=EngineSettings(error=1e-9), net=net)
        assert (outcome.settings.integrator, outcome.settings.substeps) == (EXPONENTIAL, 1)
        truth, own = (run(outcome.ran, make_engine(outcome.ran, *how)).x for how in (("exact",), ("mujoco", "RK4", 2)))
        apart = np.sqrt(np.mean((own - truth) ** 2) / np.mean(truth**2))
        errors += [c.position_relative_rms for c in outcome.choices if c.name == "RK4 x 2"]
        assert errors[-1] == pytest.approx(apart)
    assert errors[0] != errors[1]  # the energy budget changes the motion


def test_the_cross_check_finds_wrong_matrices(monkeypatch):
    """RK4 needs no Jacobian J, so it reveals an exponential engine whose J is wrong by one part in a thousand."""
    loop = assemble(SCENARIO.replace(duration=0.5), PUBLISHED["I"])
    sound = cross_check(
        loop, run(loop, make_engine(loop, "mujoco", EXPONENTIAL, 1)), EngineSettings("mujoco", EXPONENTIAL, 1)
    )
    assert (sound.integrator, sound.substeps, sound.agrees) == ("RK4", 4, True)
    assert sound.position_relative_rms < 1e-6  # RK4 x 4 errs by less
    difference = sound.growth_rate_per_s - exact_growth(loop)
    assert 1e-7 < abs(difference) < 1e-3  # [1/s] the error of RK4 x 4: 2e-4 when measured
    assert sound.growth_rate_difference_per_s == pytest.approx(difference, abs=1e-8)
    wrong_step = exponential_step(1.001 * loop.scene.plant.A[None], SCENARIO.T, loop.scene.model.nv)[0]
    monkeypatch.setattr(engines, "_step_of", lambda *_: wrong_step)
    wrong = cross_check(
        loop, run(loop, make_engine(loop, "mujoco", EXPONENTIAL, 1)), EngineSettings("mujoco", EXPONENTIAL, 1)
    )
    assert wrong.position_relative_rms > 30 * sound.position_relative_rms
    assert abs(wrong.growth_rate_difference_per_s) > 1e-3


# ---- the exponential of many small matrices


def test_exponentials_match_extended_precision_for_many_sizes():
    rng = np.random.default_rng(0)
    for n in (1, 4, 14):
        matrices = rng.normal(size=(40, n, n)) * np.geomspace(1e-8, 30, 40)[:, None, None]
        exact = np.array([longer(matrix) for matrix in matrices])
        # Rounding A by 1e-16 of its norm moves exp(A), relative to its size, by 1e-16 times the norm.
        allowed = 1e-14 * (1 + np.abs(matrices).sum(axis=1).max(axis=1)) * np.abs(exact).max(axis=(1, 2))
        assert (np.abs(expm_each(matrices) - exact).max(axis=(1, 2)) <= allowed).all()
        # SciPy's expm uses the same method; it errs by up to 3e-13 of the largest entry.
        np.testing.assert_array_less(np.abs(expm(matrices) - exact).max(axis=(1, 2)), 50 * allowed)


def test_an_undamped_oscillators_exponential_is_a_rotation():
    """exp([[0, w], [-w, 0]]) is a rotation by w, also for an angle w of many turns."""
    w = np.geomspace(1e-3, 1e3, 13)
    turned = expm_each(w[:, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]]))
    exact = np.stack([np.stack([np.cos(w), np.sin(w)], -1), np.stack([-np.sin(w), np.cos(w)], -1)], axis=1)
    np.testing.assert_allclose(turned, exact, rtol=0, atol=1e-12)  # an angle of 1e3 is rounded by 1e-13


def test_a_nilpotent_matrix_has_a_finite_series():
    shift = np.diag([1.0, 1.0], 1)
    np.testing.assert_allclose(expm_each(shift[None])[0], [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]], rtol=1e-15)


def test_an_exponential_does_not_depend_on_stacked_neighbours():
    matrices = np.random.default_rng(1).normal(size=(9, 6, 6)) * np.geomspace(0.01, 100, 9)[:, None, None]
    together = expm_each(matrices)
    for i in range(9):
        np.testing.assert_array_equal(expm_each(matrices[i : i + 1])[0], together[i])
