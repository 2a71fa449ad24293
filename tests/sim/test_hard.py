"""In numerically hard loops some settings of integrators fail, but those that `default_substeps` picks hold."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.models.device import CompliantDevice
from haptic_loop.sim.accuracy import _limit_cycle, default_substeps, simulated_growth
from haptic_loop.sim.engines import EXPONENTIAL
from haptic_loop.sim.run import assemble, make_engine, outside_forces, run, run_blocks
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.stability import exact_growth
from tests.checks.hard import cases, devices, measure, nominal


@pytest.mark.parametrize("hard", cases(), ids=lambda hard: hard.name)
def test_default_substeps_hold_where_another_setting_fails(hard):
    """tests/checks/hard.py defines when a setting holds; with `default_substeps` growth errs by at most 1e-2 1/s."""
    row = measure(hard)
    assert row.holds, row


@pytest.mark.parametrize(("side", "wrong"), [(-0.1, None), (0.1, ("Euler", 12)), (0.1, ("RK4", 1))])
def test_verdicts_are_right_near_the_boundary(side, wrong):
    """The default RK4 gives the right verdict for loops whose exact growth is -0.1 or 0.1 1/s.

    At 0.1 1/s cheaper settings call the loop stable. MuJoCo's integrators err towards stable, so none is wrong at -0.1.
    """

    def damped(delta):
        return assemble(nominal().replace(delta=(delta, delta)), NoCoupling())

    loop = damped(brentq(lambda delta: exact_growth(damped(delta)) - side, 1.0, 2.0, xtol=1e-9))
    assert exact_growth(loop) == pytest.approx(side, abs=1e-6)
    own = simulated_growth(loop, "RK4", default_substeps(loop, "RK4"))
    assert own == pytest.approx(side, abs=1e-3)  # RK4 erred by 2e-4 when measured
    assert simulated_growth(loop, EXPONENTIAL, 1) == pytest.approx(side, abs=1e-6)
    if wrong:
        other = simulated_growth(loop, *wrong)
        assert (other > 0) != (side > 0)


@pytest.mark.slow
def test_rk4_keeps_the_limit_cycle_that_euler_loses():
    """Without coupling, force 2 oscillates with 9.635 N rms at 83.85 Hz; Euler x 1 gives less than a tenth of this."""
    loop = assemble(load(), NoCoupling())
    cycles = [
        _limit_cycle(run(loop, make_engine(loop, *setting)), 1)
        for setting in (("exact",), ("mujoco", "RK4", 4), ("mujoco", "Euler", 1))
    ]
    exact, own, wrong = cycles
    assert exact == pytest.approx((9.635, 83.848), abs=1e-3)
    assert own == pytest.approx(exact, rel=1e-4)  # RK4 erred by 2e-5 when measured
    assert wrong[0] < 0.1 * exact[0]


def quiet(loop):
    """Return the outside forces of a run in which nobody pushes."""
    return lambda first, ticks: np.zeros((ticks, loop.scene.outside))


def test_encoder_steps_move_traces_less_than_a_step():
    """With encoder steps, motion is within a step of that with ideal encoders, and idle devices within a step of 0."""
    scenario = load().replace(duration=5.0)
    coarse = scenario.replace(device=tuple(CompliantDevice(encoder_step=1e-5) for _ in range(2)))
    ideal, stepped = (run(assemble(s, PUBLISHED["I"]), "exact") for s in (scenario, coarse))
    distance = np.abs(ideal.s[:, :2] - stepped.s[:, :2]).max()
    assert 0 < distance < 1e-5
    # Rounding is discontinuous: a difference of 1e-9 m between engines can become one step, not more.
    assert np.abs(run(assemble(coarse, PUBLISHED["I"])).s[:, :2] - stepped.s[:, :2]).max() < 1e-5
    alone = assemble(coarse, PUBLISHED["I"])
    free = run(alone, "exact", partial(outside_forces, coarse, alone.scene, voluntary=False)).s[-1000:]
    assert np.abs(free[:, :2]).max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("minutes", [3, pytest.param(60, marks=pytest.mark.validate)])
def test_long_runs_do_not_drift(minutes):
    """Motions of 0.6 Hz repeat every 12500 ticks of 1.2 ms, so the last period equals one after the first minute."""
    loop = assemble(load().replace(tap=None), PUBLISHED["I"])
    period, ticks, periods = 12_500, minutes * 50_000, {}
    outside, rest = partial(outside_forces, loop.scenario, loop.scene), np.zeros((loop.plant.A.shape[0], 1))

    def look(buffer, first, count):
        if first in (4 * period, ticks - period):
            periods[first] = buffer.x[:count].copy()

    run_blocks(loop.process, make_engine(loop, "exact"), outside, ticks, rest, look, period)
    early, late = periods.values()
    drift = np.abs(late - early).max()
    assert drift < 1e-12  # [m] rounding


def test_more_than_10000_default_substeps_are_refused():
    extreme = devices(motor_mass=1e-6, transmission_stiffness=1e9)
    with pytest.raises(InputError, match="even with 10000 substeps: use --engine exact"):
        default_substeps(assemble(extreme, PUBLISHED["I"]))
    assert math.isfinite(exact_growth(assemble(extreme, PUBLISHED["I"])))


def test_engines_agree_from_a_random_state():
    """A random start excites the stiff transmission; the exponential integrator is exact, and RK4 of fourth order."""
    loop = assemble(devices(transmission_stiffness=1e6), PUBLISHED["I"])
    start = 1e-3 * np.random.default_rng(0).normal(size=(loop.plant.A.shape[0], 1))
    exact = run(loop, make_engine(loop, "exact"), quiet(loop), 300, start).s[:, :2]
    substeps = default_substeps(loop, "RK4")
    errors = [
        np.abs(run(loop, make_engine(loop, "mujoco", *setting), quiet(loop), 300, start).s[:, :2] - exact).max()
        for setting in ((EXPONENTIAL, 1), ("RK4", substeps), ("RK4", 2 * substeps))
    ]
    assert errors[0] < 1e-11 * np.abs(exact).max()  # rounding: 2e-13 when measured
    assert 8 < errors[1] / errors[2] < 32  # fourth order gives 16
