"""All batches of a validation: in this process, in several, or on a Dask cluster.

A batch whose worker died is done again by another. Every batch that is done stands in a table, on disk if a folder is
given for it, so that nothing is lost with a process, and memory does not grow with the number of humans. Workers end
with the process that started them, however that ends.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from controller.lti import Array
from design.files import InputError
from sim.crowds import COLUMNS, Findings, Validation, examine
from sim.run import Progress

if TYPE_CHECKING:
    from distributed import Client

_PATIENCE = 3.0  # [s] for a scheduler to answer, and again for its first worker
_AGAIN = 3  # times in a row that workers may die without finishing a batch
_LOOK, _DESERTED = 5.0, 60.0  # [s] between looks for workers of a cluster, and without any until it is given up
_AHEAD = 4  # batches in hand for every worker: results are put away before others are begun


class Table:
    """The findings, a column for each figure: in memory, or in a file that is mapped only while it is used."""

    def __init__(self, question: Validation, folder: Path | None = None, resume: bool = False) -> None:
        """With `resume` the unfinished file of the same question goes on. Raises InputError where there is none."""
        self._batches = question.batches()
        self._path = folder / f"unfinished-{question.digest}.npy" if folder else None
        shape = len(COLUMNS) + 2, question.humans  # the last two: simulated seconds, and whether it is done
        self._memory = None if self._path else np.zeros(shape)
        if self._path and resume and not self._path.is_file():
            raise InputError(f"--resume: {self._path.parent} holds nothing unfinished of these humans and this loop")
        if self._path and not resume:
            try:
                np.lib.format.open_memmap(self._path, "w+", shape=shape)
            except OSError as error:
                raise InputError(f"cannot write {self._path}: {error.strerror}") from None

    def _open(self, mode: Any) -> Array:
        if self._memory is not None:
            return self._memory
        assert self._path is not None
        return np.load(self._path, mmap_mode=mode)

    def missing(self) -> list[int]:
        """Numbers of the batches that are not done."""
        done = self._open("r")[-1]
        return [number for number, batch in enumerate(self._batches) if not done[batch[0]]]

    def put(self, number: int, part: Findings) -> None:
        """The findings of a batch; that it is done is written last."""
        batch, table = self._batches[number], self._open("r+")
        where = slice(batch.start, batch.stop, batch.step)
        for row, name in zip(table, COLUMNS, strict=False):
            row[where] = getattr(part, name)
        table[-2, where] = part.simulated / len(batch)
        table[-1, where] = 1

    def findings(self, interrupted: bool = False, lost: str = "") -> Findings:
        """Of all batches that are done; the file goes where that is all of them."""
        table = self._open("r")
        done, rows = table[-1] != 0, dict(zip(COLUMNS, table, strict=False))
        if not done.all():
            rows = {name: row[done] for name, row in rows.items()}
        elif self._path:
            self._path.unlink()  # what is mapped stays readable
        for name in ("index", "clipped"):
            rows[name] = rows[name].astype(int)
        return Findings(**rows, simulated=float(table[-2].sum()), interrupted=interrupted, lost=lost)


def validate(
    question: Validation,
    shards: int = 1,
    progress: Progress = lambda done, total: None,
    table: Table | None = None,
) -> Findings:
    """Examine every batch that is missing in the table, all of them without one.

    From the keyboard it stops with the batches that are done, and so it does where workers die again and again.
    """
    table = table or Table(question)
    lost = ""
    try:
        if shards == 1:
            _here(question, table, progress)
        else:
            lost = _in_processes(question, table, shards, progress)
    except KeyboardInterrupt:
        return table.findings(interrupted=True)
    except MemoryError:
        lost = "memory ran out"
    return table.findings(lost=lost)


def _here(question: Validation, table: Table, progress: Progress) -> None:
    batches, missing, ticks = question.batches(), table.missing(), max(1, question.ticks)
    done = (len(batches) - len(missing)) * ticks

    def ticked(count: int) -> None:
        nonlocal done
        done += count
        progress(done, ticks * len(batches))

    for n, number in enumerate(missing, start=len(batches) - len(missing) + 1):
        table.put(number, examine(question, batches[number], ticked))
        done = n * ticks
        progress(done, ticks * len(batches))


def _in_processes(question: Validation, table: Table, shards: int, progress: Progress) -> str:
    """Why batches are missing at the end, or nothing."""
    tries = _AGAIN
    while missing := table.missing():
        done = _pool(question, table, missing, shards, progress)
        if done < len(missing):
            tries = tries - 1 if not done else _AGAIN
            if not tries:
                return f"worker processes died {_AGAIN} times in a row"
    return ""


def _pool(question: Validation, table: Table, missing: list[int], shards: int, progress: Progress) -> int:
    """How many of the missing batches were done before a worker died, or all of them."""
    batches, alone, done = question.batches(), replace(question, threads=1), 0
    # a forked child would inherit locks of MuJoCo's threads and of the progress bar
    context = multiprocessing.get_context("spawn")
    strangers = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(shards, mp_context=context, initializer=as_worker)
    left, running = iter(missing), dict[Future[Findings], int]()
    try:
        while True:
            for number in left:
                running[pool.submit(examine, alone, batches[number])] = number
                if len(running) >= _AHEAD * shards:
                    break
            if not running:
                return done
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                table.put(running[future], future.result())
                del running[future]
                done += 1
                progress(len(batches) - len(missing) + done, len(batches))
    except BrokenProcessPool:
        return done + _finished(running, table)
    except BaseException:
        _finished(running, table)
        for worker in set(multiprocessing.active_children()) - strangers:
            worker.terminate()  # a batch may take half a minute, and keeps nothing before its end
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _finished(running: dict[Future[Findings], int], table: Table) -> int:
    """Store the other batches that are finished, and return their number."""
    ready = [future for future in running if future.done() and not future.cancelled() and not future.exception()]
    for future in ready:
        table.put(running[future], future.result())
    return len(ready)


def as_worker() -> None:
    """Ignore Ctrl-C, which reaches every process of a terminal and is the parent's; end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def validate_on_cluster(
    question: Validation,
    address: str,
    progress: Progress = lambda done, total: None,
    table: Table | None = None,
    patience: float = _PATIENCE,
) -> Findings:
    """The same on the Dask cluster whose scheduler is at `address`.

    A lost worker's batches are done again by another, until Dask gives them up; then, and where the scheduler is lost,
    the rest is kept. Raises InputError where there is no cluster, no worker, or no package on the workers. Dask is an
    optional extra, imported only here.
    """
    table = table or Table(question)
    with _client(address, patience) as client:
        try:
            lost = _on_workers(question, table, client, address, progress)
        except KeyboardInterrupt:
            return table.findings(interrupted=True)
    return table.findings(lost=lost)


def _on_workers(question: Validation, table: Table, client: Client, address: str, progress: Progress) -> str:
    """Why batches are missing at the end, or nothing."""
    from distributed import CancelledError as Cancelled
    from distributed import KilledWorker
    from distributed import wait as wait_on_cluster

    batches, missing, alone, lost = question.batches(), table.missing(), replace(question, threads=1), ""
    left, done, running, deserted = iter(missing), len(batches) - len(missing), dict[Any, int](), 0.0
    try:
        while True:
            ahead = _AHEAD * max(1, len(client.scheduler_info()["workers"]))
            for number in left:
                running[client.submit(_examine_alone, alone, batches[number], pure=False)] = number
                if len(running) >= ahead:
                    break
            if not running:
                return lost
            try:
                with client.as_current():
                    found: Any = wait_on_cluster(list(running), timeout=_LOOK, return_when=FIRST_COMPLETED)
            except TimeoutError:
                deserted = 0.0 if client.nthreads() else deserted + _LOOK
                if deserted >= _DESERTED:
                    return f"--dask {address}: the cluster has had no workers for {deserted:g} s"
                continue
            for task in found.done:
                number = running.pop(task)
                try:
                    part = task.result()
                except ImportError as error:
                    raise InputError(f"--dask {address}: the workers cannot import this package: {error}") from None
                except KilledWorker as error:
                    lost = f"--dask {address}: a batch killed every worker that tried it: {error}"
                    continue
                table.put(number, part)
                done += 1
                progress(done, len(batches))
    except (CancelledError, Cancelled, OSError):
        return f"--dask {address}: the cluster was lost before all batches were done"
    except KeyboardInterrupt:
        with suppress(Exception):
            client.cancel(list(running))
        raise


_one_at_a_time = threading.Lock()  # MuJoCo's clock and warning handler are global to a process


def _examine_alone(question: Validation, indices: Sequence[int]) -> Findings:
    """`examine`, one at a time in every worker process, however many threads that has."""
    with _one_at_a_time:
        return examine(question, indices)


@contextmanager
def _client(address: str, patience: float) -> Iterator[Client]:
    """A client of the cluster, checked to be there. Raises InputError."""
    try:
        from distributed import Client
        from distributed.comm.core import connect
        from distributed.core import coerce_to_address
        from distributed.security import Security
    except ImportError:
        raise InputError("--dask needs Dask: pip install 'distributed>=2024.8'") from None
    for name in ("distributed", "distributed.client"):  # what goes wrong is said once, in our words
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)

    async def reach() -> None:
        comm = await connect(coerce_to_address(address), timeout=patience, **Security().get_connection_args("client"))
        await comm.close()

    try:
        asyncio.run(reach())  # a Client that finds nobody complains once more when it is collected
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--dask {address}: no cluster there: {error}; expected HOST:PORT of a scheduler") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            raise InputError(f"--dask {address}: that cluster has no workers") from None
        yield client
