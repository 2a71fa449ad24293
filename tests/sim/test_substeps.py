"""Check by the one-period maps of engines that `default_substeps` picks enough substeps."""

import numpy as np
import pytest
from evaluate import reported

from haptic_loop.cli.run import main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.models.device import CompliantDevice
from haptic_loop.models.human import Human, Link, Person
from haptic_loop.models.scene import plant
from haptic_loop.sim.accuracy import (
    _check_substeps,
    _measured_hold,
    _step_radius,
    default_substeps,
    pace,
    simulated_growth,
)
from haptic_loop.sim.engines import INTEGRATORS, _PlantSpeed
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import SCENARIOS, InputError, load
from haptic_loop.sim.stability import exact_growth

SCENARIO = load()
STIFF = SCENARIO.replace(device=(CompliantDevice(transmission_stiffness=1e6),) * 2)


@pytest.fixture(scope="module")
def simulation():
    return assemble(SCENARIO, PUBLISHED["I"])


def test_pace_finds_the_fastest_mode_and_decay():
    """The plant is an oscillator of 3 rad/s with 10 % damping, a decay of 50 1/s and a free mass."""
    A = np.zeros((5, 5))
    A[:2, :2] = [[0, 1], [-9, -0.6]]
    A[2, 2] = -50
    A[3, 4] = 1
    assert pace(A).mode == pytest.approx(3.0)
    assert pace(A).rate == pytest.approx(50.0)
    assert pace(np.zeros((2, 2))) == _PlantSpeed(0.0, 0.0)


def test_the_default_scenario_needs_four_rk4_substeps(simulation):
    assert pace(plant(simulation.scene.model).A).mode == pytest.approx(520.8, abs=0.1)
    assert default_substeps(simulation) == 4


def test_the_exact_engines_map_is_the_plant(simulation):
    held = _measured_hold(simulation, "exact")
    np.testing.assert_allclose(held.A, simulation.plant.A, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(held.B, simulation.plant.B, rtol=1e-9, atol=1e-12)


# `discrete` has more state than position and velocity, so a map of these two does not describe it.
@pytest.mark.parametrize("integrator", sorted(set(INTEGRATORS) - {"discrete"}))
def test_one_period_maps_repeat_a_run(simulation, integrator):
    """The map takes each recorded state and its forces to the next recorded state."""
    record = run(simulation, make_engine(simulation, "mujoco", integrator, 4), ticks=300)
    held = _measured_hold(simulation, "mujoco", integrator, 4)
    for k in range(299):
        follows = held.A @ record.s[k] + held.B @ np.concatenate([record.w[k], record.f[k]])
        np.testing.assert_allclose(follows, record.s[k + 1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("substeps", "wrong"), [(1, True), (4, False)])
def test_euler_once_per_period_hides_the_instability(substeps, wrong):
    loop = assemble(SCENARIO, NoCoupling())
    assert (simulated_growth(loop, "Euler", substeps) < 0 < exact_growth(loop)) == wrong
    assert any("WRONG VERDICT" in remark for remark in _check_substeps(loop, "Euler", substeps)) == wrong


def test_wrong_default_steps_are_doubled_or_refused():
    loop = assemble(SCENARIO, NoCoupling())
    assert default_substeps(loop, "Euler") == 4
    with pytest.raises(InputError, match="discrete gives no reliable verdict"):
        default_substeps(loop, "discrete")
    # The loop is barely unstable. With 4 substeps the numerical damping of Euler's method makes it look stable.
    near = assemble(SCENARIO.replace(delta=(1.55, 1.55)), NoCoupling())
    assert 0 < exact_growth(near) < 0.4
    assert default_substeps(near, "Euler") > 4
    assert simulated_growth(near, "Euler", default_substeps(near, "Euler")) > 0


def test_unstable_steps_are_refused_with_advice():
    loop = assemble(STIFF, PUBLISHED["I"])
    with pytest.raises(InputError, match=r"the mode at 688.* outside the stable region of RK4; use --substeps 26"):
        _check_substeps(loop, "RK4", 1)
    (remark,) = _check_substeps(loop, "RK4", 4)
    assert "stable but coarse; use --substeps 26" in remark
    assert _check_substeps(loop, "RK4", 26) == []


@pytest.mark.parametrize(("integrator", "edge"), [("RK4", 2.828), ("Euler", 2.0), ("implicitfast", 2.0)])
def test_stable_regions_end_at_the_textbooks_edge(integrator, edge):
    """The textbook limits the product of mode and step; two masses on a spring meet the limit within 1 %."""
    device = CompliantDevice(transmission_stiffness=1e4, motor_mass=1.0, handle_mass=1.0, damping=0.0, delta=None)
    human = Human((Link(0.0, 0.0, 0.0),))
    loop = assemble(SCENARIO.replace(device=(device,) * 2, human=(human,) * 2, T=0.02), PUBLISHED["I"])
    mode = np.sqrt(2e4)
    for factor, stable in ((0.99, True), (1.01, False)):
        h = factor * edge / mode
        shorter = assemble(loop.scenario.replace(T=h), PUBLISHED["I"])
        assert (_step_radius(shorter, integrator, 1) <= 1 + 1e-6) == stable


def test_substeps_with_friction_include_the_person():
    """The number of substeps follows from the scene without friction, but with the person who holds both devices."""
    person, device = Person((1, 2), 20.0, 1.0, 100.0), CompliantDevice(friction=0.5)
    loop = assemble(SCENARIO.replace(person=(person,), device=(device,) * 2), PUBLISHED["I"])
    assert loop.smooth.scene.model.nv == loop.scene.model.nv == 5  # two motors, two handles and the body
    assert default_substeps(loop, "RK4") == 4


def test_runs_use_and_report_default_substeps(tmp_path):
    path = tmp_path / "stiff.toml"
    text = (SCENARIOS / "omega-pair.toml").read_text()
    path.write_text(text.replace("transmission_stiffness = 14500", "transmission_stiffness = 1e6"))
    options = ["--scenario", str(path), "--coupling", "published", "--duration", "0.1", "--no-plot"]
    options += ["--out", str(tmp_path / "o")]
    stepped = [*options, "--integrator", "RK4"]
    assert reported(main, tmp_path, *stepped)[1]["run"]["substeps"] == 26
    assert "coarse" in reported(main, tmp_path, *stepped, "--substeps", "8")[1]["remarks"][0]
    with pytest.raises(InputError, match="--substeps 1: RK4 x 1: the mode at"):
        main([*stepped, "--substeps", "1"])
    assert reported(main, tmp_path, *options, "--engine", "exact")[1]["run"]["substeps"] is None
