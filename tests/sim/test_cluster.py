"""A validation on a Dask cluster gives the single run's result, also when a worker is killed in the middle."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

distributed = pytest.importorskip("distributed", reason="Dask is not installed (extra `dask`)")

from haptic_loop.controller.coupling import PUBLISHED  # noqa: E402
from haptic_loop.models.scene import MIXED  # noqa: E402
from haptic_loop.sim import crowds as shards  # noqa: E402
from haptic_loop.sim.crowds import _BATCH, Findings, Table, Validation, validate, validate_on_cluster  # noqa: E402
from haptic_loop.sim.scenario import (  # noqa: E402
    InputError,
    load,
)

ROOT = Path(__file__).parents[2]
QUESTION = Validation(
    load(), PUBLISHED["I"], 0, 4 * _BATCH, MIXED, "both", 0.25
)  # 0.25 s: just enough for growth rates


class Cluster:
    """A scheduler and workers, each a process of its own without anybody who would start it again."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / "scheduler.json"
        self._environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        self.scheduler = self._start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-show")
        self.workers: dict[str, subprocess.Popen] = {}
        self.address = self._wait_for_address()

    def add_worker(self, name: str) -> None:
        self.workers[name] = self._start("dask_worker", "--no-nanny", "--nthreads", "1", "--name", name)

    def stop(self) -> None:
        for process in (*self.workers.values(), self.scheduler):
            process.kill()
            process.wait()

    def _start(self, program: str, *options: str) -> subprocess.Popen:
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--scheduler-file", str(self._file)]
        with (self._folder / "log.txt").open("a") as log:
            return subprocess.Popen(
                [*command, "--no-dashboard", *options],
                cwd=self._folder,
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def _wait_for_address(self) -> str:
        """From the scheduler's file, which is there before all of it is written."""
        while True:
            with suppress(FileNotFoundError, json.JSONDecodeError):
                return json.loads(self._file.read_text())["address"]
            assert self.scheduler.poll() is None, (self._folder / "log.txt").read_text()
            time.sleep(0.05)


@pytest.fixture
def cluster(tmp_path):
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.stop()


def test_a_killed_worker_changes_nothing(cluster):
    """One worker is frozen with its share of the batches and killed once the other has finished one of its own."""
    for name in ("lives", "dies"):
        cluster.add_worker(name)
    lost: list[int] = []
    with distributed.Client(cluster.address, set_as_default=False) as observer:
        observer.wait_for_workers(2)
        named = {worker["name"]: address for address, worker in observer.scheduler_info()["workers"].items()}
        cluster.workers["dies"].send_signal(signal.SIGSTOP)  # however slow this machine is, it has work left then

        def kill(done: int, total: int) -> None:
            assert total == 4
            if not lost:
                lost.append(len(observer.processing()[named["dies"]]))
                cluster.workers["dies"].kill()

        shared = validate_on_cluster(QUESTION, cluster.address, kill, patience=60)
    assert lost[0] > 0
    assert cluster.workers["lives"].poll() is None
    assert cluster.workers["dies"].wait() == -signal.SIGKILL
    alone = validate(QUESTION)
    for field in fields(Findings):
        np.testing.assert_array_equal(getattr(alone, field.name), getattr(shared, field.name), err_msg=field.name)
    np.testing.assert_array_equal(shared.index, np.arange(4 * _BATCH))
    assert np.isfinite(shared.trace).any()


def test_a_cluster_without_workers_says_so(cluster, monkeypatch):
    """The scheduler may take its time to answer; only the wait for workers that nobody starts is cut short."""
    wait = distributed.Client.wait_for_workers
    monkeypatch.setattr(distributed.Client, "wait_for_workers", lambda self, n, timeout: wait(self, n, timeout=0.1))
    with pytest.raises(InputError, match=f"--dask {cluster.address}: that cluster has no workers"):
        validate_on_cluster(QUESTION, cluster.address, patience=60)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:9", "no cluster there: .*127.0.0.1:9.*; expected HOST:PORT of a scheduler"),
        ("nowhere", "no cluster there: missing port number in address 'nowhere'"),
        ("http://127.0.0.1:9", "no cluster there: unknown address scheme 'http'"),
    ],
)
def test_wrong_addresses(address, message):
    with pytest.raises(InputError, match=f"--dask {address}: {message}"):
        validate_on_cluster(QUESTION, address, patience=0.5)


def test_a_lost_scheduler_leaves_what_is_done(cluster, tmp_path):
    """The rest is done by the same question without a cluster, which ends with the single run's result."""
    cluster.add_worker("alone")
    question, table = replace(QUESTION, humans=12 * _BATCH), Table(replace(QUESTION, humans=12 * _BATCH), tmp_path)

    def kill(done: int, total: int) -> None:
        if done == 2:
            cluster.scheduler.kill()

    found = validate_on_cluster(question, cluster.address, kill, table, patience=60)
    assert "the cluster was lost before all batches were done" in found.lost
    assert 2 * _BATCH <= found.index.size < 12 * _BATCH
    whole = validate(question, table=Table(question, tmp_path, resume=True))
    assert whole.index.size == 12 * _BATCH
    assert not whole.lost


def test_clusters_without_workers_are_given_up(cluster, tmp_path, monkeypatch):
    """Dask itself waits for ever; what is done is kept, and nothing of it is done again."""
    monkeypatch.setattr(shards, "_LOOK", 0.1)
    monkeypatch.setattr(shards, "_DESERTED", 0.3)
    cluster.add_worker("alone")
    question = replace(QUESTION, humans=12 * _BATCH)

    def kill(done: int, total: int) -> None:
        cluster.workers["alone"].kill()

    found = validate_on_cluster(question, cluster.address, kill, Table(question, tmp_path), patience=60)
    assert found.lost == f"--dask {cluster.address}: the cluster has had no workers for 0.3 s"
    assert _BATCH <= found.index.size < 12 * _BATCH
    assert len(Table(question, tmp_path, resume=True).missing()) == 12 - found.index.size // _BATCH
