"""Counted work depends on the computation, not on the machine's speed, and ends when its budget is spent."""

import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.controller.arithmetic import TooLong, solve, spend, spent, times, within
from haptic_loop.controller.lti import Lti

ROOT = Path(__file__).parents[2]
Z = np.exp(1j * np.linspace(0.01, 3, 50))


def exact(rows: int) -> np.ndarray:
    return np.array([[Fraction(1, 1 + i + j) for j in range(rows)] for i in range(rows)])


def response(states: int) -> None:
    one = np.ones((states, 1))
    Lti(np.diag(np.linspace(0.1, 0.9, states)), one, one.T, np.eye(1), 1e-3).at(Z)


def counted(work) -> int:
    before = spent()
    work()
    return spent() - before


@pytest.mark.parametrize(
    "work", [lambda n: times(exact(n), exact(n)), lambda n: solve(exact(n), exact(n)), lambda n: response(n)]
)
def test_work_repeats_and_grows_with_size(work):
    first, again, larger = (counted(lambda n=n: work(n)) for n in (8, 8, 12))
    assert first == again
    assert 0 < 1.1 * first < larger


def test_a_spent_budget_raises_and_is_restored():
    with within(0.5, "a search", "too many"):
        spend(0.4)
        with pytest.raises(TooLong, match=r"a search .*0\.5 s: too many"):
            spend(0.2)
    spend(1.0)


def test_an_inner_budget_never_exceeds_the_outer_one():
    with pytest.raises(TooLong, match="outer"), within(1.0, "outer"), within(5.0, "inner"):
        spend(2.0)
    with within(5.0, "outer"):
        with pytest.raises(TooLong, match="inner"), within(1.0, "inner"):
            spend(2.0)
        spend(2.0)


def test_a_clock_ends_work_without_a_budget():
    with pytest.raises(TooLong), within(np.inf, clock=lambda: True):
        spend(0.0)
    spend(0.0)


LOAD = """
import sys, threading, time
from importlib.machinery import ExtensionFileLoader
from haptic_loop.controller.arithmetic import compiled

run = ExtensionFileLoader.exec_module
ExtensionFileLoader.exec_module = lambda loader, module: (time.sleep(0.2), run(loader, module))
complete = []
use = lambda: complete.append(hasattr(compiled("scipy.linalg.cython_blas"), "__pyx_capi__"))
threads = [threading.Thread(target=use) for _ in range(3)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert "scipy.linalg" not in sys.modules
sys.exit(complete != [True] * 3)
"""


def test_threads_wait_for_a_compiled_module():
    """Loading is slowed down, so that other threads ask for the module before it is complete."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    assert subprocess.run([sys.executable, "-c", LOAD], env=environment, check=False).returncode == 0
