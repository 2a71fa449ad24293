"""The hunt for hands that switching contact keeps in motion: it finds what is there, and repeats itself."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cli.hunt import main
from controller.coupling import NoCoupling
from controller.environment import environment, frozen_states
from controller.loop import force_map
from design.conditions import any_environment_per_channel, this_environment
from sim.engines import ExactEngine
from sim.hunt import attack, bounce, draw
from sim.run import assemble
from sim.scenario import InputError, load


@pytest.fixture(scope="module")
def cases():
    return {i: case for i in range(8) if (case := draw(0, i))}


def test_every_frozen_state_of_a_draw_is_certified_and_any_environment_is_not(cases):
    assert len(cases) > 4
    for case in cases.values():
        s, channels = case.scenario, case.coupling.channels(case.scenario.T)
        for network in frozen_states(s.environment).values():
            F = force_map(environment(network, s.T), case.coupling, s.theta, s.psi)
            assert this_environment(F, s.delta).certified
        assert not any_environment_per_channel(channels, s.theta, s.delta).certified


@pytest.mark.parametrize("index", range(6))
def test_what_is_proved_of_walls_without_dampers_holds_in_the_hunt(index):
    """At the requirement of walls that make and break contact nothing goes on bouncing: the condition's own test."""
    case = draw(1, index, dampers=False)
    if case is not None:
        assert not any(wall.damping for wall in case.scenario.environment.walls)
        assert not attack(case, index, seed=1, hands=30, seconds=0.5).counterexample


def test_too_little_damping_is_found_out(cases):
    """With a third of the damping that the frozen states require, the same search finds hands that go on for ever."""
    thirds = ((i, replace(c, scenario=c.scenario.replace(delta=(c.scenario.delta[0] / 3,)))) for i, c in cases.items())
    assert any(attack(case, i, seed=0, hands=20, seconds=0.5).counterexample for i, case in thirds)


def test_the_command_repeats_itself_and_says_what_it_did(tmp_path):
    outcomes = []
    for name in "ab":
        path = tmp_path / f"{name}.json"
        code = main(["--draws", "4", "--hands", "10", "--duration", "0.5", "--json", str(path), "--out", str(tmp_path)])
        outcomes.append(json.loads(path.read_text()))
        assert code == (1 if outcomes[-1]["counterexamples"] else 0)
        del outcomes[-1]["wall_s"]
    assert outcomes[0] == outcomes[1]
    assert json.loads((tmp_path / "report.json").read_text())["strongest"] == outcomes[0]["strongest"]
    first = outcomes[0]
    assert 0 < first["searched"] <= 4
    assert first["runs"][0] == first["searched"]
    assert first["strongest"][0]["environment"]["walls"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--draws", "0"], "--draws is 0, allowed are 1"),
        (["--hands", "x"], "--hands is 'x', expected a whole number"),
        (["--duration", "0.1"], "--duration is 0.1, allowed are 0.5 to 1000 s"),
        (["--json", "nowhere/x.json"], "the folder nowhere does not exist"),
    ],
)
def test_bad_input(options, message):
    with pytest.raises(InputError, match=message):
        main(options)


def test_nothing_bounces_without_walls():
    loop = assemble(load(), NoCoupling())
    engine = ExactEngine(loop.plant, loop.process.force_limit)
    with pytest.raises(ValueError, match="has no walls"):
        bounce(loop.process, engine, np.zeros((loop.plant.A.shape[0], 1)), 1000)
