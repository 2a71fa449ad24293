"""Tests that robustness is that of the loop that runs. For a constant theta a spring K needs (theta + 1/2) K T."""

import json

import pytest
from msgspec.structs import replace

from haptic_loop.cli.run import main as run_command
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.ranges import Ranges, UncertainSpring
from haptic_loop.design.compare import judge
from haptic_loop.design.coverage import OverRanges, robustness_nearby

K, T, DELTA = 400.0, 1e-3, 1.0
SPRING = Network(("tip",), (Spring(("tip", "ground"), K),))
CONSTANT = Loop(T, (1,), (0,), (0,), (DELTA,), SPRING)
SWITCHING = CONSTANT.switching(DelayRange((1,), (2,)))


def test_robustness_counts_delays_that_switch():
    """Switching within [1, 2] includes the constant 2, for which a spring that is 10 % stiffer needs 2.5 (1.1 K) T."""
    constant, switching = (robustness_nearby(loop, NoCoupling()) for loop in (CONSTANT, SWITCHING))
    assert constant.required_over_available == pytest.approx(1.5 * 1.1 * K * T / DELTA, rel=1e-6)
    assert switching.required_over_available >= 2.5 * 1.1 * K * T / DELTA * (1 - 1e-6)
    assert constant.certified
    assert not switching.certified


def test_comparisons_judge_delays_that_switch():
    """Switching within [1, 2] needs at least the 2.5 K T of the constant 2; the constant 1 needs 1.5 K T."""
    needs, *_ = judge(SWITCHING, NoCoupling()).requirements.values()
    assert needs.ratio >= 2.5 * K * T / DELTA * (1 - 1e-6)
    needs, *_ = judge(CONSTANT, NoCoupling()).requirements.values()
    assert needs.ratio == pytest.approx(1.5 * K * T / DELTA, rel=1e-6)


def test_tables_over_ranges_count_switching():
    """The vertex of 500 N/m needs 0.75 N s/m at the constant 1. Switching in [1, 2] needs 1.25, and 1 for 400 N/m."""
    ranges = Ranges((UncertainSpring(("tip", "ground"), (K, 500.0)),))
    for loop, samples, violated in ((CONSTANT, 1.5, 0), (SWITCHING, 2.5, 2)):
        ranged = replace(loop, ranges=ranges)
        row = OverRanges.of("spring", ranged, NoCoupling(), ranged.members())
        assert row.required_over_available.worst >= samples * 500.0 * T / DELTA * (1 - 1e-6)
        assert row.violated == violated


@pytest.mark.slow
def test_robustness_is_that_of_the_simulated_vertex(tmp_path):
    """At the vertex of 500 N/m a spring that is 10 % stiffer needs 1.5 (1.1 500) T, not 1.5 (1.1 400) T."""
    (tmp_path / "spring.toml").write_text(
        f"""name = "spring"
T = {T}
theta = [1]
duration = 0.05
device = [{{ kind = "rigid", mass = 0.2, damping = {DELTA} }}]
environment = {{ contacts = ["tip"], springs = [{{ between = ["tip", "ground"], stiffness = {K} }}] }}
ranges = {{ springs = [{{ between = ["tip", "ground"], stiffness = [{K}, 500.0] }}] }}
"""
    )
    options = ["--scenario", str(tmp_path / "spring.toml"), "--vertex", "1", "--coupling", "none", "--no-plot"]
    run_command([*options, "--out", str(tmp_path / "run"), "--json", str(tmp_path / "run.json")])
    report = json.loads((tmp_path / "run.json").read_text())
    needed = report["robustness"]["required_over_available"]
    assert needed == pytest.approx(1.5 * 1.1 * 500.0 * T / DELTA, rel=1e-6)
