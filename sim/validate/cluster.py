"""A validation on an existing Dask cluster: each batch is a task, a lost worker's tasks are done again by another.

The workers need this package and the same versions of NumPy, SciPy and MuJoCo; with those the merged result is
that of a single run, bit for bit. Dask is an optional extra, imported only when a cluster is asked for.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from sim.loop import Progress
from sim.scenario import InputError
from sim.validate.examine import Findings, Question, examine, merge

if TYPE_CHECKING:
    from distributed import Client, Future

PATIENCE = 3.0  # [s] for a scheduler to answer, and again for its first worker

_one_at_a_time = threading.Lock()  # MuJoCo's clock and warning handler are global to a process


def validate_on_cluster(
    question: Question, address: str, progress: Progress = lambda done, total: None, patience: float = PATIENCE
) -> Findings:
    """Examine every batch on the cluster whose scheduler is at `address`; Ctrl-C stops with the batches that are done.

    Raises InputError where there is no cluster, no worker, or no package on the workers.
    """
    parts: list[Findings] = []
    batches, alone = question.batches(), replace(question, threads=1)
    with _client(address, patience) as client:
        from distributed import as_completed

        tasks = client.map(examine_batch, [alone] * len(batches), batches, pure=False)
        try:
            for task in as_completed(tasks, loop=client.loop):
                parts.append(_result(task, address))
                progress(len(parts), len(batches))
        except KeyboardInterrupt:
            client.cancel(tasks)
            return merge(parts, interrupted=True)
    return merge(parts)


def examine_batch(question: Question, indices: Sequence[int]) -> Findings:
    """`examine`, one at a time in every worker process, however many threads that has."""
    with _one_at_a_time:
        return examine(question, indices)


def _result(task: Future, address: str) -> Findings:
    from distributed import KilledWorker

    try:
        return task.result()
    except ImportError as error:
        raise InputError(f"--dask {address}: the workers cannot import this package: {error}") from None
    except KilledWorker as error:
        raise InputError(f"--dask {address}: a batch killed every worker that tried it: {error}") from None
    except CancelledError:
        raise InputError(f"--dask {address}: the cluster was lost before all batches were done") from None


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

    async def knock() -> None:
        comm = await connect(coerce_to_address(address), timeout=patience, **Security().get_connection_args("client"))
        await comm.close()

    try:
        asyncio.run(knock())  # a Client that finds nobody complains once more when it is collected
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--dask {address}: no cluster there: {error}; expected HOST:PORT of a scheduler") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            raise InputError(f"--dask {address}: that cluster has no workers") from None
        yield client
