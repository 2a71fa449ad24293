"""Check every packaged MuJoCo world with 100 pairs of hands, and the lemma of docs/theory.md with 120,000 contacts."""

import numpy as np
import pytest
from hands import Hands

from haptic_loop.sim.scenario import load
from haptic_loop.sim.world import START_J
from tests.models.test_world import SCENES, count_of_the_lemma
from tests.sim.test_world import NAMES, Touch

pytestmark = pytest.mark.validate
PAIRS, TICKS = 50, 500


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_hands_gain_only_budget_and_released_energy(name, lossless):
    """Hands gain at most the energy budget W0 plus what the scene released, at delays of 0 to 3 samples."""
    rng, acted, worst = np.random.default_rng(7), 0, -np.inf
    for run in range(PAIRS):
        loop = load(f"world-{name}").replace(theta=(run % 4, (run // 4) % 4))
        touch = Touch(loop, Hands(rng, 1, lossless, 0.3, T=loop.T, delta=loop.delta))
        for _ in range(TICKS):
            worst = max(worst, touch.tick() - touch.port.released)
        acted += int(touch.shell.limited[0])
    kind = "lossless" if lossless else "random"
    print(
        f"\n{name}, {kind}: shell acted in {acted} of {PAIRS * TICKS} ticks, "
        f"hands gained {1e3 * worst:.3f} mJ beyond the released energy"
    )
    assert worst <= START_J + 1e-12
    assert not acted


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_without_gravity_energy_stays_within_budget_and_release(name, lossless):
    """Hands, devices and bodies of the scene gain at most the budget W0 plus what springs released."""
    rng = np.random.default_rng(8)
    for run in range(PAIRS):
        loop = load(f"world-{name}").replace(theta=(run % 4, (run // 4) % 4))
        touch = Touch(loop, Hands(rng, 1, lossless, 0.3, T=loop.T, delta=loop.delta), gravity=False)
        # M is constant and diagonal, as bodies here translate or turn about one fixed hinge.
        data, mass = touch.port.data, np.diag(touch.port.world.model.dof_M0)
        for _ in range(TICKS):
            risen = touch.tick()
            kinetic = data.qvel @ mass @ data.qvel / 2
            assert risen + kinetic <= START_J + touch.port.released + 1e-9


def test_120_000_contacts_stay_within_the_lemma(tmp_path):
    assert sum(count_of_the_lemma(tmp_path, scene, 6000) for scene in SCENES) > 120_000
