"""Optimal couplings of each form run wherever a coupling can run.

The forms are a filter that covers limited forces, a filter behind a delayed environment (psi = 1) with a free mass, and
a pair: Q and a model of the environment."""

import shutil
import subprocess
from concurrent.futures import Executor, Future
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from evaluate import reported
from shared import VERTICES_ONLY

from haptic_loop.cli import export, run, validate
from haptic_loop.controller.coupling import ForceFilter
from haptic_loop.controller.delay import delay
from haptic_loop.controller.lti import Sampled
from haptic_loop.design.certificate import prove, verify
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.design.coupling_file import load as load_file
from haptic_loop.design.optimal import design
from haptic_loop.design.program import Options
from haptic_loop.design.result import HERE
from haptic_loop.hw.control import CouplingRequest, certified_couplings
from haptic_loop.hw.emulator import Emulator
from haptic_loop.hw.limits import SafetyLimits, Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import assemble
from haptic_loop.sim.run import run as close_loop
from haptic_loop.sim.scenario import load
from haptic_loop.sim.view import session as live
from haptic_loop.sim.view.session import GIVEN, Menu, first_loop

FREE_MASS = next((Path(__file__).parents[2] / "benchmarks" / "loops").glob("n4*.toml"))
SMALL = ((4, 3),)
FORMS = ("filter", "delayed", "pair")
#: `make test` leaves out the forms that are designed here, in three seconds
SOME = (*(pytest.param(form, marks=pytest.mark.slow) for form in FORMS[:2]), "pair")
CC = shutil.which("gcc") or shutil.which("cc")


@pytest.fixture(scope="module")
def file_of(tmp_path_factory):
    """Return a function from a form to (scenario, its name in commands, file of the coupling)."""
    folder = tmp_path_factory.mktemp("optimal")

    @cache
    def stored(form):
        name = str(FREE_MASS) if form == "delayed" else "omega-pair"
        scenario, path = load(name), folder / f"{form}.json"
        loop = scenario.loop("I")
        if form == "pair":
            save(Stored.of(loop, VERTICES_ONLY, prove(loop, VERTICES_ONLY, "this-environment")), path)
        else:
            optimum = design(loop, Options(bases=SMALL, limiter=form == "filter"))
            save(Stored.of(loop, optimum.coupling, optimum.certificate), path)
        return scenario, name, path

    return stored


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_coupling_files_prove_and_drive_the_process(file_of, form):
    """Forces are displacements convolved with the impulse response that samples of F on the circle |z| = 1.05 give."""
    scenario, _, path = file_of(form)
    stored, loop = load_file(path), scenario.loop("I")
    assert verify(stored).proved
    assert isinstance(stored.built(), ForceFilter)
    strong = tuple(msgspec.structs.replace(device, force_limit=1e4) for device in scenario.device)
    simulation = assemble(scenario.replace(device=strong, duration=0.2), stored.built(), None)
    exact, own = (close_loop(simulation, engine) for engine in ("exact", "mujoco"))
    np.testing.assert_allclose(own.f, exact.f, rtol=0, atol=1e-11)
    r, n = 1.05, 512
    z = r * np.exp(2j * np.pi * np.arange(n) / n)
    around = stored.built().around(Sampled.of(delay(loop.psi, loop.T) @ loop.E(), z[None]))
    F = delay(loop.theta, loop.T).at(z) @ around.G[0]
    response = np.fft.ifft(F, axis=0).real * r ** np.arange(n)[:, None, None]
    x, ticks = exact.x, min(len(exact.x), 150)
    by_hand = [sum(response[j] @ x[k - j] for j in range(k + 1)) for k in range(ticks)]
    # The response sampled at n points on the circle of radius r repeats after n ticks, with a factor r^-n = 1e-11.
    np.testing.assert_allclose(exact.f[:ticks], by_hand, rtol=0, atol=1e-9 * np.abs(exact.f).max())


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_run_and_validate_take_couplings_of_each_form(file_of, form, tmp_path):
    _, name, path = file_of(form)
    common = ["--scenario", name, "--coupling", str(path), "--no-plot", "--out", str(tmp_path)]
    _, report = reported(run.main, tmp_path, *common, "--duration", "0.2")
    assert report["assessment"]["guarantee"]["environments"] == HERE
    assert report["robustness"]["percent"] == 10
    assert (report["assessment"]["force_limits"]["rho"] is not None) == (form == "filter")
    _, batch = reported(validate.main, tmp_path, *common, "--humans", "6", "--duration", "0.1")
    assert (batch["unstable"], batch["holds"]) == ({"exact": 0, "mujoco": 0}, True)


@pytest.mark.slow
def test_forces_are_limited_as_the_file_proves(file_of):
    scenario, _, path = file_of("filter")
    weak = tuple(msgspec.structs.replace(device, force_limit=0.3) for device in scenario.device)
    scenario = scenario.replace(device=weak, duration=0.6)
    coupling = load_file(path).built()
    rho = assessed(scenario, "I", choose(scenario, "I", str(path))).force_limits.rho
    assert rho is not None
    exact, own = (close_loop(assemble(scenario, coupling, rho), engine) for engine in ("exact", "mujoco"))
    np.testing.assert_allclose(own.f, exact.f, rtol=0, atol=1e-11)
    assert np.abs(exact.f).max() <= 0.3
    assert exact.clipped(np.array([0.3, 0.3])).mean() > 0.1


@pytest.mark.skipif(CC is None, reason="neither gcc nor cc is here: exported C files are not compiled")
@pytest.mark.parametrize("form", SOME)
def test_exports_repeat_to_the_last_bit(file_of, form, tmp_path):
    out, limit = tmp_path / "p.c", ["--force-limit", "3"] if form == "filter" else []
    assert export.main([str(file_of(form)[2]), "--process", *limit, "--out", str(out)]) == 0
    built = [str(CC), "-std=c99", "-ffp-contract=off", "-DHAPTIC_LOOP_TEST", str(out), "-o", str(tmp_path / "p"), "-lm"]
    subprocess.run(built, check=True)
    process = subprocess.run([tmp_path / "p"], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout
    assert "64 ticks" in process.stdout


class _Never(Executor):
    """An executor that never runs a task, so that no other coupling is designed."""

    def submit(self, fn, /, *args, **kwargs) -> Future:
        return Future()


@pytest.mark.parametrize("form", SOME)
def test_the_live_window_equals_the_simulator(file_of, form):
    scenario, _, path = file_of(form)
    shown = first_loop(Menu("I", given=str(path)), scenario, GIVEN)
    running = live.LiveLoop(shown, _Never(), (), np.inf)
    frame = running.frame(0.25)
    ticks = round(frame.t / scenario.T)
    record = close_loop(shown.simulation, "exact", ticks=ticks + 1)
    # Each force is a sum over at most 29 states, which window and simulator add in different orders.
    np.testing.assert_allclose(frame.history, record.f[:ticks], rtol=0, atol=1e-13)


@pytest.mark.parametrize("form", [pytest.param("filter", marks=pytest.mark.slow), "pair"])
def test_the_bridge_rehearses_optimal_couplings(file_of, form):
    scenario, _, path = file_of(form)
    couplings = certified_couplings(CouplingRequest(scenario, name=str(path)), 1, spare=0)
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=60))
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: couplings)
    assert rehearsal.run_until_armed(0.6).stage == Stage.ARMED
    assert any(np.any(moment.applied) for moment in rehearsal.moments[-100:])
    assert choose(scenario, "I", str(path)).notes == ()
