"""sim.accuracy measures known errors, marks the Pareto front, and says when runs stop being credible."""

import json

import msgspec
import numpy as np
import pytest

from haptic_loop.cli.accuracy import main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.models.device import RigidDevice
from haptic_loop.sim import accuracy as accuracy_module
from haptic_loop.sim.accuracy import Row, _with_front, credible, measure, position_error, reference
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.trace import Trace


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Return the exit code and the report of the command. Each setting runs once, because no test needs exact times."""
    place = tmp_path_factory.mktemp("accuracy")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy_module, "_REPEATS", 1)
        code = main(["--duration", "2", "--out", str(place / "o"), "--json", str(place / "r.json")])
    assert (place / "o" / "accuracy.png").stat().st_size > 10_000
    return code, json.loads((place / "r.json").read_text())


@pytest.mark.slow
def test_integrators_have_known_errors_and_verdicts(report):
    """When measured, RK4 x 4 had a relative position error of 5e-8 and a growth error of 2e-4 1/s."""
    code, outcome = report
    assert code == 0
    rows = {(row["integrator"], row["substeps"]): row for row in outcome["rows"]}
    assert rows[None, None]["position_relative_rms"] == 0
    assert rows["exponential", 1]["position_relative_rms"] < 1e-10
    assert abs(rows["exponential", 1]["growth_rate_error"]) < 1e-9
    assert rows["exponential", 1]["verdict_correct"]
    assert rows["RK4", 4]["position_relative_rms"] < 1e-7
    assert abs(rows["RK4", 4]["growth_rate_error"]) < 1e-3
    assert rows["RK4", 4]["verdict_correct"]
    # Euler's growth is 1.70 1/s too small, because its sampled position leads the true one.
    assert rows["Euler", 1]["growth_rate_error"] == pytest.approx(-1.70, abs=0.01)
    assert not rows["Euler", 1]["verdict_correct"]
    assert not rows["discrete", 12]["verdict_correct"]
    assert all(row["wall_s_per_simulated_s"] > 0 for row in outcome["rows"])


def test_cycle_deviation_is_that_of_the_last_forces():
    """The deviation is the largest standard deviation of a channel's force in the last 4000 ticks without coupling."""
    scenario = load().replace(duration=5.0)
    loops = (assemble(scenario, PUBLISHED["I"]), assemble(scenario, NoCoupling()))
    row = measure(reference(*loops), "exact", None, None)
    assert row.cycle_deviation_n == pytest.approx(run(loops[1], "exact").f[-4000:].std(axis=0).max(), rel=1e-12)
    assert row.cycle_deviation_error == 0


def test_each_engines_front_has_undominated_correct_rows():
    # engine, wall time, position error, growth error, whether the verdict is right
    values = [("a", 1, 1, 1, True), ("a", 2, 0.5, -0.5, True), ("a", 3, 0.5, -0.6, True), ("b", 9, 9, 9, True)]
    cycle, values = (None,) * 4, (*values, ("a", 0.5, 2, 2, False))
    rows = [Row(kind, None, None, p, g, right, *cycle, wall) for kind, wall, p, g, right in values]
    assert [row.pareto for row in _with_front(rows)] == [True, True, False, True, False]


def test_a_duration_that_is_no_number_is_refused():
    with pytest.raises(InputError, match="--duration is 'x'"):
        main(["--duration", "x"])


def test_runs_say_when_they_stop_being_credible():
    """In Figure 5's run a transmission, a spring of 14500 N/m, exceeds the credible 36 N at 7.35 s."""
    scenario = load()
    simulation = assemble(scenario, NoCoupling())
    trace = run(simulation, "exact")
    part = credible(simulation, trace)
    force = 14500 * np.abs(trace.x - trace.x_handle)
    speed = np.abs(np.gradient(trace.x, scenario.T, axis=0))
    assert part.transmission_force_n == pytest.approx(force.max(axis=0))
    assert part.motor_speed_m_per_s == pytest.approx(speed.max(axis=0), rel=0.1)  # np.gradient errs by 7 % at 84 Hz
    assert part.until_s == trace.t[np.argmax((force > 36).any(axis=1))] == pytest.approx(7.35)
    assert "transmission carries up to 253 N (credible: 36)" in part.reason
    stiff = tuple(msgspec.structs.replace(d, credible_force=300.0, credible_speed=10.0) for d in scenario.device)
    assert credible(assemble(scenario.replace(device=stiff), NoCoupling()), trace).until_s is None
    rigid = assemble(scenario.replace(device=(RigidDevice(), RigidDevice())), NoCoupling())
    part = credible(rigid, run(rigid, "exact", ticks=100))
    assert (part.transmission_force_n, part.until_s) == ([None] * 2, None)


def test_a_run_clipping_at_once_has_no_error():
    """The tip begins 20 mm inside a stiff wall, so the first force is clipped already."""
    scenario = load("one-wall")
    wall = msgspec.structs.replace(scenario.environment.walls[0], gap=-0.02, stiffness=3e4)
    walls = msgspec.structs.replace(scenario.environment, walls=(wall,))
    scenario = scenario.replace(environment=walls, theta=(0,), duration=0.1)
    simulation = assemble(scenario, NoCoupling())
    trace = run(simulation)
    error = position_error(trace, trace, simulation, grows=True)
    assert error.position_relative_rms is None
    assert error.reason.startswith("the unstable run clips from t = 0.000 s on, and growth")


def test_dominant_frequency_is_independent_of_the_start_time():
    t = 1e-3 * np.arange(1000)
    f, none = np.sin(2 * np.pi * 50 * t)[:, None], np.zeros((1000, 1))
    rates = [Trace(t + begin, none, f, none, none, none, {}).dominant_frequency_hz() for begin in (0.0, 5.0)]
    # The spectrum is that of the last quarter of the run, 0.25 s, so its lines are 4 Hz apart.
    assert rates == pytest.approx([50.0, 50.0], abs=4.0)
