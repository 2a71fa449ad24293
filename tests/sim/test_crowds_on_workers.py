"""A validation keeps finished batches if a worker dies or memory runs out; workers end with their parent."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.cli.validate import main
from haptic_loop.controller.coupling import PUBLISHED
from haptic_loop.models.scene import MIXED
from haptic_loop.sim import crowds
from haptic_loop.sim.crowds import Validation, validate
from haptic_loop.sim.scenario import load

ROOT = Path(__file__).parents[2]
_BATCH = 125
QUESTION = Validation(load(), PUBLISHED["I"], 0, 3 * _BATCH + 10, MIXED, "exact", 0.0)
OPTIONS = ["--humans", str(3 * _BATCH), "--engine", "exact", "--duration", "0", "--no-plot"]


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(crowds, "_BATCH", _BATCH)


def kill_the_next_child() -> threading.Thread:
    """Start a thread that kills the first child process that begins after this call."""
    before = set(multiprocessing.active_children())

    def work() -> None:
        while not (children := set(multiprocessing.active_children()) - before):
            time.sleep(0.05)
        children.pop().kill()

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def test_a_killed_worker_ends_the_validation():
    """The finished batches have the findings of an undisturbed validation."""
    killer = kill_the_next_child()
    findings = validate(QUESTION, shards=2)
    killer.join()
    assert findings.lost == "a worker process died"
    undisturbed = validate(QUESTION)
    np.testing.assert_array_equal(findings.exact, undisturbed.exact[findings.index])


def test_reports_count_humans_finished_before_memory_ran_out(tmp_path, monkeypatch, capsys):
    real, calls = crowds._examine, []

    def fails(*arguments):
        calls.append(arguments)
        if len(calls) > 1:
            raise MemoryError
        return real(*arguments)

    monkeypatch.setattr(crowds, "_examine", fails)
    assert main([*OPTIONS, "--out", str(tmp_path)]) == 3
    assert f"memory ran out; {_BATCH} humans were finished by then" in " ".join(
        capsys.readouterr().out.replace("│", " ").split()
    )
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["humans"], report["unfinished"], report["interrupted"]) == (_BATCH, "memory ran out", False)


def children(pid: int) -> list[int]:
    """Return the ids of a process's children, from the kernel's list."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the kernel lists no children here")
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_the_process_that_started_them(tmp_path, end):
    words = ["sim.validate", "--case", "none", "--humans", "100000", "--shards", "2"]
    command = [sys.executable, "-m", *words, "--out", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while len(workers := children(process.pid)) < 3:  # two workers, and Python's resource tracker
        assert time.monotonic() < deadline
        time.sleep(0.1)
    time.sleep(0.2)
    process.send_signal(end)
    process.wait()
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < deadline, "a worker outlives its parent"
        time.sleep(0.1)
