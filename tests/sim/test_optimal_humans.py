"""With the optimal coupling no random or lossless hand destabilises compliant or rigid devices, in either engine."""

from functools import cache

import numpy as np
import pytest
from shared import checkered

from haptic_loop.controller.coupling import Coupling, NoCoupling
from haptic_loop.models.scene import Crowd, Variants, draw, variants
from haptic_loop.sim import adversary
from haptic_loop.sim.adversary import _DESTABILISED
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.run import assemble
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import close, disagree, dominant_mode, exact_loops, mujoco_plants, unstable

DEVICES = ("omega-pair", "omega-pair-rigid")
HUMANS = 100


@cache
def optimal() -> Coupling:
    """Return the coupling of both scenarios: a design depends on the devices' damping only, which is equal in both."""
    return choose(load(), "I", "optimal").coupling


@cache
def hands(lossless: bool) -> Crowd:
    population = load().population
    links = np.stack([draw(population, 2, 11, i, 2) for i in range(HUMANS)])
    if lossless:
        links[..., 1] = 0.0
        # Modes are below 800 rad/s: far above that, MuJoCo's step would decide the verdict, not the hand.
        rng = np.random.default_rng(12)
        links[..., 0] = np.exp(rng.uniform(np.log(0.01), np.log(3.0), links.shape[:-1]))
        links[..., 2] = np.exp(rng.uniform(np.log(0.1), np.log(1e4), links.shape[:-1]))
    return Crowd(links)


@cache
def held(scenario: str, lossless: bool) -> Variants:
    return variants(load(scenario).device, hands(lossless))


@cache
def exact_growth(scenario: str, lossless: bool) -> np.ndarray:
    """Return the growth (HUMANS,) [1/s] with the optimal coupling."""
    return dominant_mode(exact_loops(held(scenario, lossless), assemble(load(scenario), optimal()).F)).growth


def test_rigid_and_compliant_scenarios_have_equal_loops():
    one, other = (load(name).loop("I") for name in DEVICES)
    assert one == other


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "lossless"), checkered(DEVICES, [False, True]))
def test_random_and_lossless_hands_are_stable(scenario, lossless):
    """Slow modes of lossless hands are on the unit circle, so rounding may give them a growth above 0."""
    growth = exact_growth(scenario, lossless)
    assert growth.size == HUMANS
    assert growth.max() < _DESTABILISED
    if not lossless:
        assert growth.max() < 0
        assert not unstable(growth).any()


@pytest.mark.parametrize("scenario", DEVICES)
def test_the_same_hands_destabilise_the_loop_without_coupling(scenario):
    """Without coupling most of these hands destabilise the loop; on rigid devices only some lossless hands do."""
    F = assemble(load(scenario), NoCoupling()).F
    upset = {}
    for lossless in (False, True):
        growth = dominant_mode(exact_loops(held(scenario, lossless), F)).growth
        upset[lossless] = int((growth > _DESTABILISED).sum())
    compliant = scenario == "omega-pair"
    assert upset[False] > 0.8 * HUMANS if compliant else upset[False] == 0
    assert upset[True] > (0.9 if compliant else 0.02) * HUMANS


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "lossless"), checkered(DEVICES, [False, True]))
def test_mujoco_gives_the_exact_verdicts(scenario, lossless):
    """The eigenvalues of MuJoCo's one-period map give the exact verdict for every hand."""
    simulation = assemble(load(scenario), optimal())
    loops = close(mujoco_plants(held(scenario, lossless), simulation.process), simulation.F)
    mujoco = dominant_mode(loops).growth
    assert mujoco.max() < _DESTABILISED
    assert not disagree(exact_growth(scenario, lossless), mujoco).any()


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [pytest.param(DEVICES[0], marks=pytest.mark.validate), DEVICES[1]])
def test_adversaries_succeed_only_with_too_little_damping(scenario, monkeypatch):
    """With 12 % less damping, hands of a short search destabilise the loop; with full damping none do.

    `python -m sim.validate --coupling optimal --adversary` runs a long search.
    """
    monkeypatch.setattr(adversary, "_CANDIDATES", 24)
    place = load(scenario)
    for delta, succeeds in ((1.37, False), (1.2, True)):
        weaker = place.replace(delta=(delta, delta))
        worst = adversary.search(weaker, assemble(weaker, optimal()).F, seed=3, generations=1)
        assert worst.destabilises == succeeds
