"""Provide, once per test run, the scenario of the sessions and couplings that are certified for its links."""

import pytest

from haptic_loop.hw.control import certified_couplings
from haptic_loop.sim.scenario import load as scenario_of
from tests.checks.faults import _lively


@pytest.fixture(scope="session")
def scenario():
    """Return the default scenario with people who move at full amplitude soon after arming."""
    return _lively(scenario_of())


@pytest.fixture(scope="session")
def rungs(scenario):
    """Return certified couplings for links of one and two ticks."""
    return certified_couplings(scenario, "I", None, None, 1, spare=1)
