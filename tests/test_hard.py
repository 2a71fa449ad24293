"""Numerically hard loops: each with the setting that fails, where there is one, and the one that holds."""

import math

import numpy as np
import pytest

from controller.coupling import NoCoupling, SpringDamper
from controller.process import Tape
from design.assess import assess
from design.published import CASE_I
from models.device import CompliantDevice
from models.human import Human, Link
from sim.engine import outside_forces
from sim.exact_engine import ExactEngine
from sim.hard import cases, devices, measure, nominal
from sim.loop import run
from sim.one_period import exact_growth, simulated_growth
from sim.scenario import InputError, load
from sim.simulate import assemble, make_engine, simulate
from sim.substeps import check_substeps, default_substeps

CLOSED_LOOP = SpringDamper(np.array([7806.0, 3137.0]), np.array([0.105, 1.68]))


@pytest.mark.parametrize("hard", cases(), ids=lambda hard: hard.name)
def test_the_rule_gives_the_exact_verdict(hard):
    """Growth within 1e-2 1/s of the exact one; fewer substeps are refused where they are unstable."""
    row = measure(hard)
    print(row.markdown())
    assert row.holds
    assert (row.simulated > 0) == (row.exact > 0)
    assert row.simulated == pytest.approx(row.exact, abs=1e-2)
    if hard.fails:
        with pytest.raises(InputError, match="outside the stable region of RK4"):
            check_substeps(assemble(hard.scenario, hard.coupling), "RK4", hard.fails)


@pytest.mark.parametrize("side", [-0.1, 0.1])
def test_within_a_tenth_of_the_boundary(side):
    """Damping tuned by bisection until the exact growth is +-0.1 1/s: the default sees it, Euler x 4 does not."""
    low, high = 1.0, 2.0
    while high - low > 1e-9:
        middle = (low + high) / 2
        growth = exact_growth(assemble(nominal().replace(delta=(middle, middle)), NoCoupling()))
        low, high = (middle, high) if growth > side else (low, middle)
    loop = assemble(nominal().replace(delta=(low, low)), NoCoupling())
    assert exact_growth(loop) == pytest.approx(side, abs=1e-6)
    assert simulated_growth(loop, "RK4", default_substeps(loop)) == pytest.approx(side, abs=1e-3)
    assert simulated_growth(loop, "Euler", 4) < 0
    assert (simulated_growth(loop, "Euler2", 4) > 0) == (side > 0)


def sustained(damping: float) -> tuple[float, float]:
    """Of 200 starts: the share whose motion lasts after 48 s, and the frequency [Hz] of the strongest."""
    humans = (Human((Link(1.2326, damping, 34.923),)), Human((Link(0.01999, damping, 266.28),)))
    limits = (CompliantDevice(), CompliantDevice(force_limit=5.657))
    scenario = load().replace(human=humans, device=limits, tap=None)
    loop = assemble(scenario, CLOSED_LOOP)
    assert exact_growth(loop) < 0
    n = loop.plant.A.shape[0]
    rng = np.random.default_rng(0)
    start = np.concatenate([rng.uniform(-0.5, 0.5, (n // 2, 200)), rng.uniform(-10, 10, (n // 2, 200))])
    start[2:4], start[6:8] = start[:2], start[4:6]  # the transmissions start unstretched
    tape = Tape(loop.process, 1000, n, loop.scene.outside, 200)
    engine = ExactEngine(loop.plant, loop.process.force_limit)
    tape.s[0] = start
    engine.start(tape)
    for _ in range(40):
        for k in range(1000):
            tape.tick(k)
            engine.advance(k)
        tape.saturate(1000)
        last = tape.x[:1000, 1].copy()
        clipped = (np.abs(tape.f[:1000]) >= loop.process.force_limit[:, None]).any(axis=(0, 1))
        tape.rewind(1000)
    strongest = last[:, last.std(axis=0).argmax()]
    spectrum = np.abs(np.fft.rfft((strongest - strongest.mean()) * np.hanning(1000), 2**15))
    return float(clipped.mean()), float(np.fft.rfftfreq(2**15, scenario.T)[spectrum.argmax()])


def test_saturation_breaks_a_certificate_and_damped_hands_mend_it():
    """Section 7's counterexample: certified for the linear loop, yet with lossless hands clipping goes on for ever."""
    assert assess(load().loop("I"), CLOSED_LOOP)["closed-loop"].certified
    share, frequency = sustained(0.0)
    print(f"lossless hands: {share:.1%} of starts still clip after 48 s, at {frequency:.2f} Hz")
    assert share > 0.2
    assert frequency == pytest.approx(1.17, abs=0.05)
    assert sustained(0.1)[0] == 0


def test_encoder_steps_do_not_destabilise_a_certified_loop():
    """Steps of 1e-5 m: the trace stays within a few steps of the ideal one."""
    scenario = load().replace(duration=5.0)
    coarse = scenario.replace(device=tuple(CompliantDevice(encoder_step=1e-5) for _ in range(2)))
    ideal, stepped = (simulate(assemble(s, CASE_I), "exact") for s in (scenario, coarse))
    distance = np.abs(ideal.s[:, :2] - stepped.s[:, :2]).max()
    print(f"encoder steps of 1e-5 m: at most {distance:.1e} m from the ideal encoder")
    assert distance < 3e-4
    assert np.abs(simulate(assemble(coarse, CASE_I)).s[:, :2] - stepped.s[:, :2]).max() < 3e-4


def test_one_simulated_hour_does_not_drift():
    """0.6 Hz at 1.2 ms repeats every 12500 ticks exactly: the last period is the one of the first minute."""
    loop = assemble(load().replace(tap=None), CASE_I)
    period, ticks = 12_500, 3_000_000
    tape = Tape(loop.process, period, loop.plant.A.shape[0], loop.scene.outside)
    engine = ExactEngine(loop.plant, loop.process.force_limit)
    engine.start(tape)
    early = None
    for first in range(0, ticks, period):
        tape.w[:period] = outside_forces(loop.scenario, loop.scene, first, period)[:, :, None]
        for k in range(period):
            tape.tick(k)
            engine.advance(k)
        if first == 4 * period:
            early = tape.x[:period].copy()
        late = tape.x[:period].copy()
        tape.rewind(period)
    drift = np.abs(late - early).max()
    print(f"one hour: {drift:.1e} m between the first minute and the last")
    assert drift < 1e-12
    # an accumulated clock would have missed ticks, a counter cannot
    accumulated = np.cumsum(np.full(ticks, loop.scenario.T))
    assert (np.floor(accumulated / loop.scenario.T) != np.arange(1, ticks + 1)).any()


def test_a_rule_that_cannot_be_met_says_so():
    extreme = devices(motor_mass=1e-6, transmission_stiffness=1e9)
    with pytest.raises(InputError, match="even with 10000 substeps: use --engine exact"):
        default_substeps(assemble(extreme, CASE_I))
    assert math.isfinite(exact_growth(assemble(extreme, CASE_I)))


def test_the_loop_runs_from_any_state():
    """Both engines agree from a random start under the rule's setting, for the stiffest transmission."""
    hard = cases()[6]
    loop = assemble(hard.scenario, hard.coupling)
    start = 1e-3 * np.random.default_rng(0).normal(size=(loop.plant.A.shape[0], 1))

    def quiet(first, ticks):
        return np.zeros((ticks, loop.scene.outside))

    engines = (make_engine(loop, "mujoco", "RK4", default_substeps(loop)), make_engine(loop, "exact"))
    a, b = (run(loop.process, engine, quiet, 300, start) for engine in engines)
    assert np.abs(a.s[:, :2] - b.s[:, :2]).max() < 1e-3 * np.abs(b.s[:, :2]).max()
