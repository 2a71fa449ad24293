"""The scenario that sessions are held with, and couplings for its links: made once."""

import pytest

from haptic_loop.hw.control import certified_couplings
from haptic_loop.sim.scenario import load as scenario_of
from tests.checks.faults import _lively


@pytest.fixture(scope="session")
def scenario():
    """People who move soon after arming, at full amplitude."""
    return _lively(scenario_of())


@pytest.fixture(scope="session")
def rungs(scenario):
    """Couplings for links of one and two ticks."""
    return certified_couplings(scenario, "I", None, None, 1, spare=1)
