"""Growth rates equal the agreed figures; a trace that cannot give one gives a reason."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from haptic_loop.cli.design import main as design_command
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.design.result import DesignFailed
from haptic_loop.models.scene import HumanSets, variants
from haptic_loop.sim.couplings import read_coupling
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, load, parse
from haptic_loop.sim.stability import (
    _NOT_EXCITED,
    Mode,
    _left_eigenvector,
    _measured_growth,
    close,
    dominant_mode,
    mujoco_plants,
    ringing,
    verdict,
)


@pytest.mark.parametrize(
    ("coupling", "growth", "frequency"),
    [(NoCoupling(), 1.481, 83.98), (PUBLISHED["I"], -0.939, 83.83), (PUBLISHED["II"], -1.718, 1.93)],
)
def test_exact_and_measured_growth(coupling, growth, frequency):
    simulation = assemble(load(), coupling)
    loop = close(simulation.plant, simulation.F)
    mode = dominant_mode(loop)
    assert mode.growth == pytest.approx(growth, abs=1e-3)
    assert mode.frequency_hz == pytest.approx(frequency, abs=1e-2)
    measured, reason = _measured_growth(loop, run(simulation), simulation.process.force_limit)
    assert reason is None
    assert measured == pytest.approx(mode.growth, abs=1e-3)


def test_the_this_environment_matrix_is_the_loop():
    """Steps of the closed loop's matrix give the states of the run."""
    simulation = assemble(load().replace(theta=(3, 0), psi=(1, 2), duration=0.5), PUBLISHED["I"])
    record = run(simulation, "exact")
    loop = close(simulation.plant, simulation.F)
    xi = np.zeros(loop.A.shape[0])
    for k in range(len(record.s)):
        np.testing.assert_allclose(xi[: simulation.plant.A.shape[0]], record.s[k], atol=1e-12)
        xi = loop.A @ xi + loop.B @ record.w[k]


def test_left_eigenvector():
    simulation = assemble(load(), NoCoupling())
    loop = close(simulation.plant, simulation.F)
    left = _left_eigenvector(loop).conj()
    np.testing.assert_allclose(left @ loop.A, dominant_mode(loop).eigenvalue * left, atol=1e-9)


def test_a_trace_that_says_nothing_gives_a_reason():
    simulation = assemble(load().replace(duration=0.1), PUBLISHED["I"])
    loop = close(simulation.plant, simulation.F)
    limit = simulation.process.force_limit
    growth, reason = _measured_growth(loop, run(simulation), limit)
    assert growth is None
    assert "only 82 ticks" in reason
    still = run(simulation, "exact", lambda first, ticks: np.zeros((ticks, simulation.scene.outside)), 300)
    assert _measured_growth(loop, still, limit) == (None, _NOT_EXCITED)


def test_verdicts():
    assert verdict(Mode(np.array(1.0), 1e-3).growth) == "stable"
    assert verdict(Mode(np.array(1.001), 1e-3).growth) == "unstable"
    assert Mode(np.array(0.0), 1e-3).growth == -np.inf


def test_knocks_die_away_as_the_held_plant():
    """Device and hand are one body before a spring; the poles come from matrices that are written out here."""
    T, K = 2e-3, 900.0
    text = """
name = "knock"
T = 2e-3
theta = [1]
device = [{ kind = "rigid", mass = 0.2, damping = 1.5 }]
human = [{ links = [{ mass = 0.3, damping = 2.0, stiffness = 150.0 }] }]
[environment]
contacts = ["a"]
springs = [{ between = ["a", "ground"], stiffness = 900.0 }]
"""
    mass, damping, stiffness = 0.2 + 0.3, 1.5 + 2.0, 150.0
    plant = np.array([[0, 1, 0], [-stiffness / mass, -damping / mass, -1 / mass], [0, 0, 0]])
    held = expm(plant * T)
    loop = np.array([[*held[0, :2], held[0, 2]], [*held[1, :2], held[1, 2]], [K, 0, 0]])  # the force is a tick late
    poles = np.log(np.linalg.eigvals(loop).astype(complex)) / T
    pair = poles[np.argmax(poles.real)]
    said = ringing(assemble(parse(text), NoCoupling()))
    assert said.decay_per_s == pytest.approx(-pair.real, rel=1e-9)
    assert said.frequency_hz == pytest.approx(abs(pair.imag) / (2 * np.pi), rel=1e-9)
    assert said.words.startswith("decays ")
    assert replace(said, decay_per_s=-1.5).words.startswith("grows 1.5 1/s at ")
    assert said.damping_ratio == said.least_damping_ratio == pytest.approx(-pair.real / abs(pair), rel=1e-9)


@pytest.mark.slow
def test_designs_reach_the_damping_ratio_in_both_engines(tmp_path, capsys, monkeypatch):
    path = tmp_path / "soft.json"
    monkeypatch.setattr("haptic_loop.cli.design._BISECTIONS", 1)  # enough for the ratio, not for the stiffest coupling
    assert design_command(["--decay", "0.01", "--out", str(path), "--json", str(tmp_path / "r.json")]) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["assessment"]["guarantee"]["proof"] == "rational"
    scenario = load()
    simulation = assemble(scenario, read_coupling(path).built())
    crowd = HumanSets((scenario.human,), scenario.person)
    plants = mujoco_plants(variants(scenario.device, crowd), simulation.process, "exponential", 1)
    loops = close(plants, simulation.F)
    values = np.linalg.eigvals(loops.A[0]).astype(complex)
    poles = np.log(values[np.abs(values) > 1e-6]) / scenario.T
    ratio = (-poles.real / np.abs(poles)).min()
    assert 0.01 <= report["ringing"]["least_damping_ratio"] == pytest.approx(ratio, rel=1e-4)
    capsys.readouterr()
    with pytest.raises(DesignFailed, match=r"^--decay 0.05: none of .* of 6 couplings has 0\.018\d at 83\.\d Hz$"):
        design_command(["--coupling", "moving-average", "--decay", "0.05", "--out", str(path)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--coupling", "optimal"], "--decay is for --coupling spring-damper or moving-average, not optimal"),
        (["--scenario", "world-cube"], "--decay: a world, or a loop with varying delays"),
    ],
)
def test_unreachable_damping_ratios_are_refused(options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        design_command([*options, "--decay", "0.01", "--out", str(tmp_path / "c.json")])
