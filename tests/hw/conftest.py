"""Provide both implementations of a device, the scenario of the sessions, and couplings certified for its links."""

from dataclasses import replace

import pytest

from haptic_loop.hw.control import CouplingRequest, certified_couplings
from haptic_loop.hw.device_state import Device
from haptic_loop.sim.scenario import load as scenario_of
from tests.checks.faults import CASES, LATE, _lively, _prepared
from tests.compiled_device import Firmware, compiled, needs_gcc


@pytest.fixture(scope="session")
def library(tmp_path_factory):
    """Return the compiled firmware."""
    return compiled(tmp_path_factory.mktemp("firmware"))


@pytest.fixture(params=["python", pytest.param("c", marks=needs_gcc)])
def machine(request):
    """Return a function that makes a device of an Info, in Python or in C."""
    if request.param == "python":
        return Device
    library = request.getfixturevalue("library")
    return lambda about: Firmware(library, about)


@pytest.fixture(scope="session")
def scenario():
    """Return the default scenario with people who move at full amplitude soon after arming."""
    return _lively(scenario_of())


@pytest.fixture(scope="session")
def link_couplings(scenario):
    """Return certified couplings for links of one and two ticks."""
    return certified_couplings(CouplingRequest(scenario), 1, spare=1)


@pytest.fixture(scope="session")
def harmless(scenario, link_couplings):
    """Return a rehearsal without a fault, shortly before most faults begin. Tests continue it in a fork."""
    rehearsal = _prepared(CASES[0], scenario, link_couplings)
    rehearsal.run_until_armed(LATE)
    return rehearsal


@pytest.fixture(scope="session")
def free_handles(scenario, link_couplings):
    """Return a rehearsal as `harmless`, but nobody holds the handles."""
    rehearsal = _prepared(replace(CASES[0], free=True), scenario, link_couplings)
    rehearsal.run_until_armed(LATE)
    return rehearsal
