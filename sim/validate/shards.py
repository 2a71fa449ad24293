"""A validation over local processes: batches go to whoever is free; the merged result is that of a single run."""

from __future__ import annotations

import multiprocessing
import signal
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import replace

from sim.loop import Progress
from sim.validate.examine import Findings, Question, examine, merge


def validate(question: Question, shards: int = 1, progress: Progress = lambda done, total: None) -> Findings:
    """Examine every batch; from the keyboard it stops with the batches that are done."""
    return _here(question, progress) if shards == 1 else _in_processes(question, shards, progress)


def _here(question: Question, progress: Progress) -> Findings:
    batches, parts = question.batches(), []
    ticks = max(1, question.ticks)
    done = 0

    def ticked(count: int) -> None:
        nonlocal done
        done += count
        progress(done, ticks * len(batches))

    try:
        for n, batch in enumerate(batches, start=1):
            parts.append(examine(question, batch, ticked))
            done = n * ticks
            progress(done, ticks * len(batches))
    except KeyboardInterrupt:
        return merge(parts, interrupted=True)
    return merge(parts)


def _in_processes(question: Question, shards: int, progress: Progress) -> Findings:
    parts: list[Findings] = []
    batches, alone = question.batches(), replace(question, threads=1)
    # a forked child would inherit locks of MuJoCo's threads and of the progress bar
    context = multiprocessing.get_context("spawn")
    strangers = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(shards, mp_context=context, initializer=_deaf_to_the_keyboard)
    futures: list[Future[Findings]] = []
    try:
        futures += [pool.submit(examine, alone, batch) for batch in batches]
        for future in as_completed(futures):
            parts.append(future.result())
            progress(len(parts), len(batches))
    except KeyboardInterrupt:
        finished = [f.result() for f in futures if f.done() and not f.cancelled() and not f.exception()]
        for worker in set(multiprocessing.active_children()) - strangers:
            worker.terminate()  # a batch takes half a minute, and keeps nothing before its end
        return merge(finished, interrupted=True)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return merge(parts)


def _deaf_to_the_keyboard() -> None:
    """Ctrl-C reaches every process of a terminal; only the one that merges may act on it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
