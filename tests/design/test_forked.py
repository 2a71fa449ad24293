"""A second process computes at the same time and changes no result."""

import os
import signal

import pytest

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design import forked
from haptic_loop.design.audit import audit
from haptic_loop.design.forked import Forked
from haptic_loop.sim.scenario import load

pytestmark = pytest.mark.skipif(
    not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2, reason="needs Linux and two processors"
)


@pytest.fixture(autouse=True)
def allowed(monkeypatch):
    monkeypatch.setattr(forked, "allowed", True)


def place():
    """Return the number of the process, and more bytes than a pipe holds."""
    return os.getpid(), bytes(10**6)


def end_second(first):
    """End the process without a result unless it is the first one."""
    if os.getpid() != first:
        os.kill(os.getpid(), signal.SIGKILL)
    return "computed"


def test_a_second_process_computes_at_the_same_time():
    there, sent = Forked(place).result()
    assert there != os.getpid()
    assert sent == bytes(10**6)


def test_without_permission_no_second_process_computes(monkeypatch):
    monkeypatch.setattr(forked, "allowed", False)
    assert Forked(place).result()[0] == os.getpid()


def test_this_process_repeats_the_work_of_killed_ones():
    assert Forked(end_second, os.getpid()).result() == "computed"


def test_errors_of_the_second_process_are_raised():
    with pytest.raises(ZeroDivisionError):
        Forked(divmod, 1, 0).result()


def test_an_audit_is_the_same_with_one_process(monkeypatch):
    loop, coupling = load("omega-pair").loop("I"), SpringDamper([800.0] * 2, [0.5] * 2)
    both = audit(loop, coupling)
    monkeypatch.setattr(forked, "allowed", False)
    alone = audit(loop, coupling)
    for part in ("margins", "helps", "constant"):
        assert getattr(both, part) == getattr(alone, part)
