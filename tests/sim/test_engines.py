"""The two engines simulate the same plant; MuJoCo converges to the exact engine at each integrator's order.

Tolerances without a comment cover rounding.
"""

import ctypes
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from driven import alike, driven
from msgspec.structs import replace as change

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.models.scene import plant
from haptic_loop.sim import engines as mujoco_engine
from haptic_loop.sim import run as loop
from haptic_loop.sim.accuracy import simulated_growth
from haptic_loop.sim.engines import INTEGRATORS, MujocoBatchEngine, MujocoEngine, evaluations, profiler_off
from haptic_loop.sim.run import assemble, make_engine, outside_forces, run
from haptic_loop.sim.scenario import InputError, load
from haptic_loop.sim.stability import close, dominant_mode

SHORT = load().replace(duration=0.6)


@pytest.fixture(scope="module")
def simulation():
    return assemble(SHORT, PUBLISHED["I"])


@pytest.fixture(scope="module")
def exact(simulation):
    return run(simulation, "exact")


def test_traces_hold_encoder_positions_and_handle_speeds(exact):
    """Central differences underestimate speeds at 84 Hz by (2 pi 84 Hz T)^2/6 = 7 %, slower motions by less."""
    slope = np.gradient(exact.x_handle, SHORT.T, axis=0)
    assert np.linalg.norm(slope - exact.v_handle) < 0.07 * np.linalg.norm(exact.v_handle)
    step = 1e-5
    coarse = SHORT.replace(device=[change(device, encoder_step=step) for device in SHORT.device], duration=0.2)
    trace = run(assemble(coarse, PUBLISHED["I"]), "exact")
    np.testing.assert_allclose(trace.x, step * np.round(trace.s[:, :2] / step), rtol=0, atol=1e-15)
    assert np.abs(trace.x - trace.s[:, :2]).max() > 0.4 * step


def error(record, exact) -> float:
    """Return the relative rms error of the device positions."""
    m = record.f.shape[1]
    return np.sqrt(np.mean((record.s[:, :m] - exact.s[:, :m]) ** 2) / np.mean(exact.s[:, :m] ** 2))


@pytest.mark.parametrize(("integrator", "substeps", "order"), [("RK4", 1, 4), ("Euler", 8, 1), ("implicitfast", 8, 1)])
def test_errors_shrink_at_the_order_of_the_integrator(simulation, exact, integrator, substeps, order):
    """Halving the step divides the error by 2^order; terms of higher order may change the measured order by 0.2."""
    errors = [
        error(run(simulation, make_engine(simulation, "mujoco", integrator, n)), exact)
        for n in (substeps, 2 * substeps)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)


@pytest.mark.slow
def test_the_exact_engine_equals_a_fine_integration(simulation):
    """One step of the exact engine from a random state equals 20000 steps of classical Runge-Kutta."""
    held, continuous = simulation.plant, plant(simulation.scene.model)
    rng = np.random.default_rng(0)
    s, u = rng.normal(size=held.A.shape[0]), rng.normal(size=held.B.shape[1])
    expected, h = s.copy(), held.T / 20000

    def rate(state):
        return continuous.A @ state + continuous.B @ u

    for _ in range(20000):
        k1 = rate(expected)
        k2 = rate(expected + h / 2 * k1)
        k3 = rate(expected + h / 2 * k2)
        expected = expected + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(expected + h * k3))
    # The rounding of 20000 steps adds up; when measured, the largest difference was 1e-12.
    np.testing.assert_allclose(held.A @ s + held.B @ u, expected, rtol=1e-10, atol=1e-10)


def test_discrete_integrator_loses_the_unstable_mode():
    """MuJoCo's `discrete` integrator damps the 84 Hz mode away, so an unstable loop looks stable."""
    loop = assemble(load().replace(duration=6.0), NoCoupling())
    late = slice(-400, None)
    truth = np.diff(run(loop, "exact").f[late], axis=0).std()
    fooled = np.diff(run(loop, make_engine(loop, "mujoco", "discrete", 12)).f[late], axis=0).std()
    assert dominant_mode(close(loop.plant, loop.F)).growth > 1.4
    # The remaining motion is that of the hands.
    assert fooled < 0.05 * truth


def test_batches_equal_single_engines_up_to_rounding(simulation):
    """A batch of one run equals a single engine bit for bit. A batch of three runs equals three engines to rounding."""
    scenario, scene = simulation.scenario, simulation.scene
    rng = np.random.default_rng(0)
    start = 1e-3 * rng.normal(size=(simulation.plant.A.shape[0], 3))

    def outside(first, ticks):
        return outside_forces(scenario, scene, first, ticks)

    def follow(engine, state):
        return driven(simulation.process, engine, outside, 200, state)

    alone = [follow(MujocoEngine(scene, scenario.T), start[:, [i]]) for i in range(3)]
    # A buffer of three simulations would sum a tick's product in another order, so each has its own buffer.
    batched = [follow(MujocoBatchEngine(alike(scene, 1), scenario.T, nthread=1), start[:, [i]]) for i in range(3)]
    together = follow(MujocoBatchEngine(alike(scene, 3), scenario.T, nthread=2), start)
    for i in range(3):
        np.testing.assert_array_equal(alone[i].s, batched[i].s)
        np.testing.assert_allclose(together.s[:, :, i], alone[i].s[:, :, 0], rtol=1e-9, atol=1e-12)


def test_uncoupled_limit_cycle_stays_within_the_force_limit():
    """The oscillation of Figure 5 is bounded by 12 N, with 83.85 Hz and 9.635 N rms in channel 2."""
    record = run(assemble(load(), NoCoupling()), "exact")
    force = record.f[-4000:, 1]
    spectrum = np.abs(np.fft.rfft((force - force.mean()) * np.hanning(force.size)))
    assert np.abs(record.f).max() == 12.0
    # The spectrum of 4000 ticks, 4.8 s, has lines 0.2 Hz apart.
    assert np.fft.rfftfreq(force.size, 1.2e-3)[spectrum.argmax()] == pytest.approx(83.85, abs=0.2)
    assert force.std() == pytest.approx(9.635, abs=1e-3)  # docs/reproducibility.md rounds it


@pytest.mark.parametrize("engine", ["mujoco", "exact"])
def test_a_diverging_run_is_reported_not_reset(engine, capfd, tmp_path, monkeypatch):
    """Without limits a badly delayed loop grows beyond what MuJoCo accepts (1e10) and beyond floating-point numbers."""
    monkeypatch.chdir(tmp_path)
    devices = tuple(d.__class__(force_limit=1e6) for d in SHORT.device)
    scenario = load().replace(device=devices, theta=(40, 40), duration=200.0)
    loop = assemble(scenario, NoCoupling())
    unlimited = replace(loop, process=replace(loop.process, force_limit=np.full(2, np.inf)))
    unlimited.scene.model.actuator_ctrllimited[:] = 0
    record = run(unlimited, engine)
    assert record.diverged
    assert record.s.shape[0] < scenario.samples
    assert np.isfinite(record.s).all()
    assert np.abs(record.s).max() > 1e8
    assert capfd.readouterr() == ("", "")
    assert not Path("MUJOCO_LOG.TXT").exists()


def test_the_profiler_clock_is_restored(simulation, monkeypatch):
    pointer = mujoco_engine._profiler_clock()
    assert isinstance(pointer, ctypes.c_void_p)
    before = pointer.value
    with profiler_off() as off:
        assert off
        assert pointer.value is None
    assert pointer.value == before
    monkeypatch.setattr("haptic_loop.sim.run.profiler_off", nullcontext)
    with_clock = run(simulation)
    monkeypatch.undo()
    np.testing.assert_array_equal(with_clock.s, run(simulation).s)


def test_runs_work_without_mujocos_profiler_clock(monkeypatch, simulation):
    monkeypatch.setattr(mujoco_engine, "_profiler_clock", lambda: None)
    with profiler_off() as off:
        assert not off
    assert run(simulation).s.shape[0] == SHORT.samples


def test_a_long_trace_lies_on_the_disk(simulation, monkeypatch, tmp_path):
    """A trace on disk has the same numbers as in memory; without room, the error gives the longest duration.

    The run's report needs 400 bytes of memory per tick, so that half of this memory allows half of the duration.
    """
    expected, ticks = run(simulation, "exact"), simulation.scenario.samples
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(loop, "_SMALL", 0)
    monkeypatch.setattr(loop, "_free_memory", lambda: 400 * ticks)
    stored = run(simulation, "exact")
    for name in ("t", "x", "f", "x_handle", "w", "z", "s"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(expected, name))
    assert not any(tmp_path.iterdir())  # the trace's file has no name
    monkeypatch.setattr(loop, "_free_memory", lambda: 200 * ticks)
    with pytest.raises(InputError, match=r"duration: 0.6 s need .* GiB of memory, .*0.3 s"):
        run(simulation, "exact")
    monkeypatch.setattr(loop, "_free_memory", lambda: 400 * ticks)
    monkeypatch.setattr(loop.shutil, "disk_usage", lambda place: SimpleNamespace(free=1000))
    with pytest.raises(InputError, match=r"duration: .* GiB of .* are free:"):
        run(simulation, "exact")


class Lost:
    """An engine whose tick ends with numbers that are not finite."""

    def __init__(self, simulation):
        pass

    def start(self, buffer):
        self.states = buffer.plant_state

    def advance(self, k):
        self.states[k + 1][...] = np.nan

    def troubled(self):
        return False


def test_diverging_engines_are_named(simulation):
    with pytest.raises(InputError, match=r"engine .*:Lost: a tick from rest gives numbers that are not finite"):
        simulated_growth(simulation, None, None, Lost)


@pytest.mark.parametrize("integrator", sorted(set(INTEGRATORS) - {mujoco_engine.EXPONENTIAL}))
def test_evaluations_are_mujocos_forward_passes(integrator):
    """MuJoCo calls the control callback once in every evaluation of the dynamics."""
    model, calls = assemble(load(), NoCoupling()).scene.model, []
    model.opt.integrator = getattr(mujoco.mjtIntegrator, INTEGRATORS[integrator])
    data = mujoco.MjData(model)
    mujoco.set_mjcb_control(lambda *state: calls.append(state))
    try:
        mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_control(None)
    assert len(calls) == evaluations(integrator)
