"""The scenario that sessions are held with, and couplings for its links."""

import pytest

from hw.control import certified_couplings
from sim.scenario import load as scenario_of


@pytest.fixture(scope="module")
def scenario():
    return scenario_of()


@pytest.fixture(scope="module")
def rungs(scenario):
    """Couplings for links of one and two ticks."""
    return certified_couplings(scenario, "I", None, None, 1, spare=1)
