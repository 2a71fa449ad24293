"""The methods in examples/classics.py obey their published laws, and docs/energy-budget.md has their figures."""

import numpy as np
import pytest

from examples.classics import ROWS, Classic, EnergyBounding, PassivityControl, row
from haptic_loop import load
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.sim.passivity_layer import netted
from haptic_loop.sim.run import assemble, run

T = 1e-3


def test_energy_bounding_clips_to_the_published_interval():
    rng = np.random.default_rng(15)
    bounding, c1, before = EnergyBounding(1, T, 1.2), 2 * 1.2 / T, 0.0
    for k in range(500):
        dx, wanted = (0.0 if k % 7 == 0 else 1e-4 * rng.normal()), 3 * rng.normal()
        force = bounding.limit(np.array([[wanted]]), np.array([[dx]])).item()
        if dx == 0:
            assert force == before
        else:
            b = np.sort([c1, -c1 - 2 * before / dx])
            assert force == pytest.approx(before + np.clip((wanted - before) / dx, *b) * dx, abs=1e-12)
        # T f^2/(4 delta) rises by at most the last force's work, which flows in, plus the device's dissipation.
        assert T * force**2 / 4.8 <= T * before**2 / 4.8 + before * dx + 1.2 * dx**2 / T + 1e-15
        before = force


@pytest.mark.parametrize("delta", [0.0, 1.2])
def test_the_passivity_controller_returns_what_its_observer_misses(delta):
    """With a credit for the devices' damping, the observed energy and delta dx^2/T add up to at least 0."""
    rng, acted = np.random.default_rng(16), 0
    control, observed = PassivityControl(2, T, delta, nsim=5), np.zeros((2, 5))
    for _ in range(300):
        dx, wanted = 1e-4 * rng.normal(size=(2, 5)), rng.normal(size=(2, 5))
        force = control.limit(wanted, dx)
        observed += force * dx + delta * dx**2 / T
        changed = force != wanted
        acted += changed.sum()
        assert observed.min() > -1e-12
        assert np.abs(observed[changed]).max(initial=0.0) < 1e-12  # no more is taken than is missing
    assert acted > 50


def test_the_passivity_controller_is_the_published_one():
    """For a wanted force f at the speed v the controller sends f + alpha v, with alpha = max(0, -W/v^2).

    W is the sum of f v + alpha_- v_-^2 over the ticks; alpha_- and v_- are those of the tick before.
    """
    rng, control = np.random.default_rng(17), PassivityControl(1, T)
    W = alpha = before = acted = 0.0
    for _ in range(500):
        v = rng.normal()
        wanted = rng.normal() - 0.5 * v
        W += wanted * v + alpha * before**2
        alpha, before = (-W / v**2 if W < 0 else 0.0), v
        acted += alpha > 0
        force = control.limit(np.array([[wanted]]), np.array([[T * v]]))
        assert force == pytest.approx(wanted + alpha * v, rel=1e-9, abs=1e-9)
    assert acted > 100


def test_energy_bounding_keeps_its_bound_in_a_run():
    scenario = load().replace(duration=1.5)
    trace = run(netted(assemble(scenario, NoCoupling()), Classic(EnergyBounding)), "exact")
    # Theta delays the forces by 1 and 2 samples.
    sent = np.stack([trace.f[n : len(trace.f) - 2 + n, i] for i, n in enumerate((1, 2))], axis=1)
    dx = np.diff(trace.x, axis=0)
    c1 = 2 * np.array(scenario.delta) / scenario.T
    k = np.arange(1, len(sent))
    most = np.abs(sent[k - 1] + c1 * dx[k - 1])
    assert (np.abs(sent[k]) <= np.where(dx[k - 1] == 0, np.abs(sent[k - 1]), most) + 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "figures"),
    [
        ("PO/PC", (66.59, 0.310, 2.3, 90, 6, 0.118)),
        ("energy bounding", (18.74, 5.675, 12.0, 96, 100, 8.915)),
        pytest.param("energy budget", (14.40, 0.216, 1.6, 35, 7, 0.131), marks=pytest.mark.validate),
    ],
)
def test_classics_have_the_figures_of_the_page(name, figures):
    """The figures have the digits that docs/energy-budget.md prints."""
    digits = (2, 3, 1, 0, 0, 3)
    assert tuple(round(value, n) for value, n in zip(row(ROWS[name]), digits, strict=True)) == pytest.approx(figures)
