"""Test the verdict of sim.trace about several parts of a trace."""

import pytest

from haptic_loop.cli.trace import _verdict
from haptic_loop.sim.trace import Growth


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([(0.5, "neither"), (0.3, "grows")], "An oscillation grows: +0.3 1/s."),
        ([(-0.5, "neither"), (-0.3, "decays")], "An oscillation neither grows nor decays: -0.5 1/s."),
        ([(-0.5, "decays"), (-0.3, "decays")], "All oscillations decay: -0.3 1/s."),
    ],
)
def test_verdicts_state_the_worst_trend(parts, words):
    growths = [Growth(0, 100, rate, 0.1, 80.0, 1e-3, None, trend) for rate, trend in parts]
    assert _verdict(growths) == words
