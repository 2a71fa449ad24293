"""The search for the worst passive human destabilises loops with too little damping, and none with enough.

Tolerances without a comment cover rounding.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from evaluate import reported
from msgspec.structs import replace as change

from haptic_loop.cli import run as run_command
from haptic_loop.cli.validate import main
from haptic_loop.controller.coupling import PUBLISHED, NoCoupling, SpringDamper
from haptic_loop.design.environments import ThisEnvironment
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.hold import hold
from haptic_loop.models.scene import HumanSets, build, plant, variants
from haptic_loop.sim import adversary
from haptic_loop.sim.adversary import _DESTABILISED, search
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import InputError, held_by, load, save_humans
from haptic_loop.sim.stability import close, dominant_mode
from tests.checks.tightness import attempts, shortages

SCENARIO = load()
DESIGNED = SpringDamper([878.7, 551.8], [0.3864, 0.5219])  # for any environment, rounded
LOOPS = {"none": (SCENARIO, NoCoupling()), "published": (SCENARIO, PUBLISHED["I"]), "designed": (SCENARIO, DESIGNED)}


@pytest.fixture(autouse=True)
def _few(monkeypatch):
    """Search with half as many sets of humans in a generation as the command."""
    monkeypatch.setattr(adversary, "_CANDIDATES", 60)


def test_the_search_destabilises_loops_below_the_requirement():
    """With 5 % less damping than required, the search destabilises each loop."""
    rows = attempts(LOOPS, np.array([0.05]), generations=60)
    assert all(row.worst.destabilises for row in rows)


@pytest.mark.slow
def test_the_search_fails_against_sufficient_damping():
    """With 0.1 % more damping than required, the search destabilises no loop."""
    rows = attempts(LOOPS, np.array([-1e-3]), generations=3)
    assert not any(row.worst.destabilises for row in rows)
    # The growth with lossless hands approaches 0 from below, up to the rounding of eigenvalues.
    assert all(abs(row.worst.growth) < _DESTABILISED for row in rows)


def test_the_search_assumes_longest_periods_and_latest_forces():
    """The searched loops have the longest period and the largest latencies."""
    scenario = SCENARIO.replace(T_max=2e-3, latency=((1e-4, 3e-4), (0.0, 5e-4)))
    F, hands = assemble(scenario, NoCoupling()).F, HumanSets((SCENARIO.human,))
    held = hold(variants(SCENARIO.device, hands).plants(), 2e-3, [3e-4, 5e-4])
    np.testing.assert_allclose(adversary._loops(scenario, F, hands).A, close(held, F).A, rtol=1e-12)


@pytest.mark.slow
def test_the_condition_is_tight_with_long_delays():
    """With delays of 4 and 9 samples the condition binds at 8 Hz; with 0.5 % less damping the loop is destabilised."""
    delayed = {"none": (SCENARIO.replace(theta=(4, 9)), NoCoupling())}
    rows = attempts(delayed, np.array([-1e-3, 0.005]), generations=6)
    assert [row.worst.destabilises for row in rows] == [False, True]
    assert 6 < rows[1].worst.frequency_hz < 10


@pytest.mark.slow
def test_known_devices_are_searched_within_their_bounds(tmp_path):
    """The nominal motors are heavy; the search finds the lightest motor within the bounds, 0.06 kg.

    The found devices are saved and loaded again; a lighter motor in the file is refused.
    """
    heavy = {"motor_mass": 1.0, "transmission_stiffness": 3000.0}
    known = load("omega-pair-known")
    devices = tuple(change(device, **heavy) for device in known.device)
    rows = attempts({"known": (known.replace(device=devices), NoCoupling())}, np.array([-1e-3, 0.002]), 0, 8)
    assert [row.worst.destabilises for row in rows] == [False, True]
    drawn = rows[-1].worst.mechanics
    assert min(one.motor_mass for one in drawn) == 0.06
    file = save_humans(tmp_path / "worst.toml", rows[-1].worst.humans, "", rows[-1].worst.persons, drawn)
    again = held_by(known, str(file))
    assert [one.motor_mass for one in again.device] == [one.motor_mass for one in drawn]
    file.write_text(file.read_text().replace(f"motor_mass = {drawn[0].motor_mass!r}", "motor_mass = 0.01", 1))
    with pytest.raises(InputError, match=r"motor_mass is 0\.01"):
        held_by(known, str(file))


def both_hands(monkeypatch):
    """Let the search try only persons who hold both devices."""
    monkeypatch.setattr(adversary, "_PASSES", tuple(kind for kind in adversary._PASSES if kind.held))
    assert adversary._PASSES


def test_one_person_holding_both_devices_is_found(monkeypatch):
    """The scene of one lossless person who holds both devices has the growth that the search found."""
    both_hands(monkeypatch)
    worst = search(SCENARIO, assemble(SCENARIO, NoCoupling()).F, generations=15)
    assert worst.destabilises
    (person,) = worst.persons
    assert person.holds == (1, 2)
    assert person.damping == person.cross.damping == 0
    assert all(link.damping == 0 for human in worst.humans for link in human.links)
    F = assemble(SCENARIO, NoCoupling()).F
    mode = dominant_mode(close(hold(plant(build(SCENARIO.device, worst.humans, worst.persons).model), SCENARIO.T), F))
    assert mode.growth == pytest.approx(worst.growth, rel=1e-9)


def test_one_person_destabilises_only_with_too_little_damping(monkeypatch):
    """One person with both devices destabilises the loop with 5 % too little damping, but not with enough."""
    both_hands(monkeypatch)
    light = SCENARIO.replace(device=(RigidDevice(mass=0.02),) * 2)
    rows = attempts({"designed": (light, DESIGNED)}, np.array([-1e-3, 0.05]), generations=30)
    assert [row.worst.destabilises for row in rows] == [False, True]


def test_a_found_person_replays_with_equal_spectral_radius(tmp_path, monkeypatch):
    both_hands(monkeypatch)
    file, out = tmp_path / "r.json", tmp_path / "out"
    base = ["--case", "none", "--engine", "exact", "--no-plot", "--out", str(out), "--json", str(file)]
    assert main([*base, "--humans", "5", "--duration", "0", "--adversary", "--generations", "8"]) == 0
    worst = json.loads(file.read_text())["adversary"]
    assert worst["person"][0]["holds"] == [1, 2]
    assert run_command.main([*base, "--human", str(out / "adversary.toml"), "--duration", "0.5"]) == 0
    stability = json.loads(file.read_text())["stability"]
    assert stability["spectral_radius"] == pytest.approx(worst["spectral_radius"], abs=1e-12)


@pytest.mark.slow
def test_the_adversarys_search_is_repeatable():
    """The hands of the search are lossless, and their scene has the growth that the search found."""
    F = assemble(SCENARIO, NoCoupling()).F
    worst, again = (search(SCENARIO, F, seed=4, generations=5) for _ in range(2))
    assert worst == again
    assert worst.destabilises
    assert all(link.damping == 0 for human in worst.humans for link in human.links)
    scene = build(SCENARIO.device, worst.humans)
    mode = dominant_mode(close(hold(plant(scene.model), SCENARIO.T), F))
    assert mode.growth == pytest.approx(worst.growth, rel=1e-9)


@pytest.mark.slow
def test_found_humans_replay_with_equal_spectral_radius(tmp_path):
    file, out = tmp_path / "r.json", tmp_path / "out"
    options = ["--case", "none", "--humans", "5", "--engine", "exact", "--duration", "0", "--no-plot", "--adversary"]
    options += ["--generations", "8"]
    assert main([*options, "--out", str(out), "--json", str(file)]) == 0
    adversary = json.loads(file.read_text())["adversary"]
    assert adversary["found"]
    # The loop requires 1.7229 N s/m (rounded) on each channel, and 1.37 N s/m are available.
    assert adversary["required_over_available_damping"] == pytest.approx(1.7229 / 1.37, rel=1e-4)
    replay = ["--case", "none", "--human", str(out / "adversary.toml"), "--duration", "0.5", "--engine", "exact"]
    assert run_command.main([*replay, "--no-plot", "--out", str(out), "--json", str(file)]) == 0
    stability = json.loads(file.read_text())["stability"]
    assert stability["spectral_radius"] == pytest.approx(adversary["spectral_radius"], abs=1e-12)


def test_validation_fails_if_an_adversary_contradicts_a_certificate(tmp_path, monkeypatch):
    """A search that attacks the uncoupled loop instead seems to contradict the certificate, so the exit code is 1."""
    F = assemble(SCENARIO, NoCoupling()).F
    monkeypatch.setattr(
        adversary, "search", lambda scenario, certified, seed, generations, progress: search(scenario, F, seed, 4)
    )
    options = ["--humans", "5", "--engine", "exact", "--duration", "0", "--no-plot", "--adversary"]
    code, report = reported(main, tmp_path, *options, "--out", str(tmp_path))
    assert (code, report["certified"]) == (1, True)
    assert not report["holds"]


@pytest.mark.slow
def test_attacks_succeed_only_below_the_required_damping():
    rows = list(shortages(1, ("none", "spring-damper"), (0, 0.2), 4))
    succeeded = {short: [row.found for row in rows if row.short == short] for short in (0, 0.2)}
    assert succeeded == {0: [False, False], 0.2: [True, True]}
    assert {row.loop for row in rows} == {"no coupling", "spring-damper, case I"}
    assert all(row.holds for row in rows)


def test_a_wrong_condition_fails_the_check(monkeypatch):
    """The search refutes a condition that requires 0.5 N s/m of each device, where 1.72 N s/m are needed."""

    class TooWeak(ThisEnvironment):
        def required(self, loop, coupling, multiplier=None):
            return replace(super().required(loop, coupling), required=(0.5, 0.5))

    monkeypatch.setattr("tests.checks.tightness.THIS_ENVIRONMENT", TooWeak())
    (row,) = shortages(1, ("none",), (0,), 5)
    assert row.found
    assert not row.holds
