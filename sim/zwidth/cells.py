"""Many independent cells of a map, a slice at a time on all cores: NumPy's kernels leave Python to other threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from typing import TypeVar

Part = TypeVar("Part")
Progress = Callable[[int, int], None]


def in_slices(
    task: Callable[[slice], Part], count: int, size: int, progress: Progress = lambda done, total: None
) -> tuple[list[tuple[slice, Part]], bool]:
    """task(slice) for slices of `size` that cover range(count), and whether the keyboard ended it before the last.

    What was finished by then is returned.
    """
    done: list[tuple[slice, Part]] = []
    pool = ThreadPoolExecutor(_cores())
    futures = {pool.submit(task, part): part for part in _slices(count, size)}
    waiting, finished = set(futures), 0
    try:
        while waiting:
            ready, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in ready:
                done.append((futures[future], future.result()))
                finished += min(size, count - futures[future].start)
            progress(finished, count)
    except KeyboardInterrupt:
        return done, True
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return done, False


def _slices(count: int, size: int) -> list[slice]:
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
