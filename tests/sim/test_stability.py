"""Growth rates: the agreed figures, and what a trace may be asked."""

import numpy as np
import pytest

from haptic_loop.controller.coupling import PUBLISHED, NoCoupling
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import (
    _NOT_EXCITED,
    Mode,
    _left_eigenvector,
    _measured_growth,
    close,
    dominant_mode,
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
    """Stepping the matrix by hand gives the loop's own record."""
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
