"""Designed couplings in MuJoCo, with random humans: none unstable."""

import numpy as np
import pytest

from controller.coupling import NoCoupling
from models.human import Population
from sim.couplings import choose
from sim.scenario import load
from sim.simulate import assemble
from sim.stability import close, dominant_mode


def unstable(scenario, coupling, humans: int) -> int:
    """How many of so many random pairs of hands (one or two links) make the exact loop unstable."""
    rng = np.random.default_rng(1)
    count = 0
    for k in range(humans):
        hands = Population(links=1 + k % 2).draw(rng, scenario.channels)
        assembly = assemble(scenario.replace(human=tuple(hands)), coupling)
        count += dominant_mode(close(assembly.plant, assembly.F)).verdict == "unstable"
    return count


@pytest.mark.parametrize("name", ["omega-pair", "three-rigid"])
def test_no_human_of_200_destabilises_a_designed_coupling(name):
    scenario = load(name)
    assert unstable(scenario, choose(scenario, "I").coupling, 200) == 0


def test_most_humans_destabilise_the_uncoupled_loop():
    """The same humans can tell an unsafe loop from a safe one."""
    assert unstable(load(), NoCoupling(), 200) > 100
