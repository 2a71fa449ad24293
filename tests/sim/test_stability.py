"""Growth rates equal independent ones; a trace that cannot give a rate gives a reason.

Tolerances without a comment cover rounding.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace as change
from scipy.linalg import expm

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.models.human import Human, Link
from haptic_loop.sim.crowds import Validation, _examine
from haptic_loop.sim.run import assemble, make_engine, run
from haptic_loop.sim.scenario import load, parse
from haptic_loop.sim.stability import (
    _NOT_EXCITED,
    Mode,
    _left_eigenvector,
    _measured_growth,
    close,
    dominant_mode,
    impulse_forces,
    impulse_growth,
    ringing,
    stability_of,
    verdict,
)


@pytest.mark.parametrize(
    ("coupling", "growth", "frequency"),
    [(NoCoupling(), 1.481, 83.98), (PUBLISHED["I"], -0.939, 83.83), (PUBLISHED["II"], -1.718, 1.93)],
)
def test_measured_growth_equals_that_of_eigenvalues(coupling, growth, frequency):
    """Traces and eigenvalues agree; the listed growth [1/s] and frequency [Hz] are rounded."""
    simulation = assemble(load(), coupling)
    loop = close(simulation.plant, simulation.F)
    mode = dominant_mode(loop)
    assert mode.growth == pytest.approx(growth, abs=1e-3)
    assert mode.frequency_hz == pytest.approx(frequency, abs=1e-2)
    measured, reason = _measured_growth(loop, run(simulation), simulation.process.force_limit)
    assert reason is None
    assert measured == pytest.approx(mode.growth, abs=1e-3)


def test_the_closed_loop_matrix_repeats_the_run():
    """Steps of the closed loop's matrix give the states of the run."""
    simulation = assemble(load().replace(theta=(3, 0), psi=(1, 2), duration=0.5), PUBLISHED["I"])
    record = run(simulation, "exact")
    loop = close(simulation.plant, simulation.F)
    xi = np.zeros(loop.A.shape[0])
    for k in range(len(record.s)):
        np.testing.assert_allclose(xi[: simulation.plant.A.shape[0]], record.s[k], rtol=0, atol=1e-12)
        xi = loop.A @ xi + loop.B @ record.w[k]


def test_the_left_eigenvector_satisfies_its_equation():
    simulation = assemble(load(), NoCoupling())
    loop = close(simulation.plant, simulation.F)
    left = _left_eigenvector(loop).conj()
    np.testing.assert_allclose(left @ loop.A, dominant_mode(loop).eigenvalue * left, rtol=0, atol=1e-12)


def test_traces_without_a_growth_rate_give_a_reason():
    simulation = assemble(load().replace(duration=0.1), PUBLISHED["I"])
    loop = close(simulation.plant, simulation.F)
    limit = simulation.process.force_limit
    growth, reason = _measured_growth(loop, run(simulation), limit)
    assert growth is None
    assert "only 82 ticks" in reason
    still = run(simulation, "exact", lambda first, ticks: np.zeros((ticks, simulation.scene.outside)), 300)
    assert _measured_growth(loop, still, limit) == (None, _NOT_EXCITED)


def test_fits_end_before_a_limiter_acts():
    """The fit ends `ahead` (here 3) ticks before the first force at its limit: the limiter acts that much earlier."""
    simulation = assemble(load().replace(duration=0.2), PUBLISHED["I"])
    trace, loop = run(simulation), close(simulation.plant, simulation.F)
    first = int(np.argmax(np.abs(trace.f[:, 0])))
    limit = np.array([np.abs(trace.f[first, 0]), np.inf])
    assert _measured_growth(loop, trace, limit, 3)[1].startswith(f"only {first - 3} ticks before the first clipped one")


def test_short_traces_do_not_contradict_eigenvalues():
    """A growth of 1 1/s in a trace of 0.5 s decides nothing about a mode that decays by 0.94 1/s."""
    simulation = assemble(load().replace(duration=0.5), PUBLISHED["I"])
    trace, loop = run(simulation, "exact"), close(simulation.plant, simulation.F)
    values, vectors = np.linalg.eig(loop.A)
    lead = np.argmax(np.abs(values))
    grown = (values[lead] / np.abs(values[lead])) ** np.arange(len(trace.t)) * np.exp(trace.t)
    s, z = np.split((grown[:, None] * vectors[:, lead]).real, [trace.s.shape[1]], axis=1)
    stability = stability_of(simulation, replace(trace, s=s, z=z, w=0 * trace.w))
    assert stability.growth_rate_per_s == pytest.approx(1.0, abs=1e-6)
    assert stability.verdict == stability.exact_verdict == "stable"
    assert stability.reason.startswith("not decidable in 0.5")


def test_free_hands_settle_by_their_speed():
    """Without a spring the position keeps an offset, a mode of growth 0; the measured growth is the next mode's."""
    hand, damper = Human((Link(0.3, 3.0, 0.0),)), Network(("a",), (Spring(("a", GROUND), 0.0, 0.5),))
    scenario = load("one-wall").replace(environment=damper, human=(hand,), tap=None)
    simulation = assemble(scenario, NoCoupling())
    states, loop = simulation.plant.A.shape[0], close(simulation.plant, simulation.F)
    ((growth,), _) = impulse_growth(simulation.process, make_engine(simulation, "exact"), simulation.scene, states, 600)
    rates = np.sort(np.log(np.abs(loop.eigenvalues) + 1e-300) / loop.T)
    assert rates[-1] == pytest.approx(0, abs=1e-9)
    assert growth == pytest.approx(rates[-2], rel=1e-3)  # other modes disturb the rate: by 7e-6 when measured


def test_figures_of_an_impulse_follow_from_its_trace():
    """Energy is the least sum of f'dx + dx' delta dx/T; settling is the last quarter's speed over the second's."""
    late = Network(("a",), (Spring(("a", GROUND), 2000.0),))
    scenario = load("one-wall").replace(environment=late, theta=(2,), tap=None)
    question = Validation(scenario, NoCoupling(), 0, 3, 1, "exact", 0.25)
    findings = _examine(question, range(3))
    assert (findings.energy < 0).any()
    assert (findings.trace_error > 3.99 / 0.25).all()  # a trace decides a sign after four time constants
    for i in range(3):
        simulation = assemble(scenario.replace(human=question.crowd(i).humans(0)), NoCoupling())
        knock = partial(impulse_forces, simulation.scene, simulation.scenario.T)
        trace = run(simulation, "exact", knock, question.ticks + 1)
        dx = np.diff(trace.x, axis=0)
        terms = trace.f[:-1] * dx + np.array(simulation.scenario.delta) / simulation.scenario.T * dx**2
        least = terms.sum(axis=1).cumsum().min(initial=0.0)
        assert findings.energy[i] == pytest.approx(least, abs=1e-12 * findings.audited[i])
        n, speed = question.ticks, trace.v_handle
        early, last = np.linalg.norm(speed[n // 4 : n // 2]), np.linalg.norm(speed[n - n // 4 : n])
        assert findings.settling[i] == pytest.approx(last / early, rel=1e-9)


def test_diverged_runs_are_unstable():
    simulation = assemble(load().replace(duration=0.3), PUBLISHED["I"])
    trace = run(simulation, "exact")
    assert stability_of(simulation, trace).verdict == "stable"
    stability = stability_of(simulation, replace(trace, diverged=True))
    assert stability.verdict == "unstable"
    assert "left the range of finite numbers" in stability.reason


def test_contact_at_the_beginning_is_counted():
    scenario = load("one-wall").replace(duration=0.05)
    wall = change(scenario.environment.walls[0], gap=-0.02)
    inside = scenario.replace(environment=change(scenario.environment, walls=(wall,)))
    simulation = assemble(inside, NoCoupling())
    contact = stability_of(simulation, run(simulation, "exact")).contact
    assert (contact.made, contact.ticks) == (1, inside.samples - 1)


def test_growth_above_zero_is_unstable():
    assert verdict(Mode(np.array(1.0), 1e-3).growth) == "stable"
    assert verdict(Mode(np.array(1.001), 1e-3).growth) == "unstable"
    assert Mode(np.array(0.0), 1e-3).growth == -np.inf


KNOCK = """
name = "knock"
T = 2e-3
theta = [1]
device = [{ kind = "rigid", mass = 0.2, damping = 1.5 }]
human = [{ links = [{ mass = 0.3, damping = 2.0, stiffness = 150.0 }] }]
[environment]
contacts = ["a"]
"""
SPRING = ' = [{ between = ["a", "ground"], stiffness = 900.0 }]'


def knocked(K):
    """Return the slowest pole [1/s] of the loop of KNOCK around a spring of K [N/m]."""
    T, mass, damping, stiffness = 2e-3, 0.2 + 0.3, 1.5 + 2.0, 150.0
    plant = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, -1 / mass], [0, 0, 0]])
    held = expm(plant * T)
    loop = np.array([[*held[0, :2], held[0, 2]], [*held[1, :2], held[1, 2]], [K, 0, 0]])  # the force is a tick late
    values = np.linalg.eigvals(loop).astype(complex)
    poles = np.log(values[np.abs(values) > 1e-9]) / T
    return poles[np.argmax(poles.real)]


def test_ringing_equals_poles_of_the_held_plant():
    """Device and hand are one body on a spring; the poles come from matrices that are written out here."""
    pair = knocked(900.0)
    decay = ringing(assemble(parse(KNOCK + "springs" + SPRING), NoCoupling()))
    assert decay.decay_per_s == pytest.approx(-pair.real, rel=1e-9)
    assert decay.frequency_hz == pytest.approx(abs(pair.imag) / (2 * np.pi), rel=1e-9)
    assert decay.words.startswith("decays ")
    assert replace(decay, decay_per_s=-1.5).words.startswith("grows 1.5 1/s at ")
    assert decay.damping_ratio == decay.least_damping_ratio == pytest.approx(-pair.real / abs(pair), rel=1e-9)


def test_ringing_is_that_of_the_slowest_contact():
    """A wall is a spring or nothing; here the touching loop decays more slowly and has the least damping ratio."""
    away, held = knocked(0.0), knocked(900.0)
    assert away.real < held.real
    decay = ringing(assemble(parse(KNOCK + "walls" + SPRING), NoCoupling()))
    assert decay.decay_per_s == pytest.approx(-held.real, rel=1e-9)
    assert decay.least_damping_ratio == pytest.approx(-held.real / abs(held), rel=1e-9)


def test_free_drifts_have_no_ringing():
    """A free hand, device and mass, and a spring of 0 N/m, have only the eigenvalues 1, and 0 for the delay."""
    free = KNOCK.replace("1.5", "0.0").replace("2.0, stiffness = 150.0", "0.0, stiffness = 0.0")
    free += 'masses = { m = 1.0 }\nsprings = [{ between = ["a", "m"], stiffness = 0.0 }]'
    assert ringing(assemble(parse(free), NoCoupling())) is None
