"""Tests that a request gives the same coupling file, byte for byte, whatever the machine's clock and cores are."""

import os
import subprocess
import sys
import time

import msgspec
import pytest
from tools.same_designs import LOOPS, ROOT

from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.optimal import design
from haptic_loop.design.program import Options
from haptic_loop.sim.scenario import load

#: Run `design` on one core with clocks ten thousand times as fast: a search with a time limit would end at once.
HURRIED = """
import os, sys, time
for name in ("monotonic", "perf_counter", "process_time", "thread_time", "time"):
    setattr(time, name, lambda clock=getattr(time, name): 1e4 * clock())
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from haptic_loop.cli.main import run_command
run_command("design")
"""


def hurried(clock):
    return lambda: 1e4 * clock()


@pytest.mark.slow
def test_a_racing_clock_changes_no_byte(monkeypatch):
    """A design over two bases is the same with the real clocks and with clocks ten thousand times as fast."""
    loop = load(LOOPS / "o01-wall-light-device.toml").loop("I")

    def stored():
        optimum = design(loop, Options(bases=((2, 1), (4, 3))))
        return len(optimum.bases), msgspec.json.encode(Stored.of(loop, optimum.coupling, optimum.certificate))

    plain = stored()
    with monkeypatch.context() as racing:
        for name in ("monotonic", "perf_counter", "process_time", "thread_time", "time"):
            racing.setattr(time, name, hurried(getattr(time, name)))
        assert stored() == plain
    assert plain[0] == 2


@pytest.mark.validate
def test_clock_and_cores_change_no_byte(tmp_path):
    """A design on one core with fast clocks equals a plain one. `make kernels` compares six designs under load."""
    words = ["--scenario", str(LOOPS / "o01-wall-light-device.toml"), "--coupling", "optimal"]
    begun = {}
    for name, start in (("plain", ["-m", "design"]), ("hurried", ["-c", HURRIED])):
        command = [sys.executable, *start, *words, "--out", str(tmp_path / f"{name}.json")]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        begun[name] = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
    assert [process.wait() in (0, 1) for process in begun.values()] == [True, True]
    plain, hurried = ((tmp_path / f"{name}.json").read_bytes() for name in begun)
    assert plain == hurried
