"""make mutate: test whether the tests notice small mistakes in the code on which verdicts rest.

The command makes small mistakes, one at a time, in the functions of the modules of TABLE: it reverses a comparison or a
sign, changes a number, leaves out a refusal, or writes `max` for `min`. Then it runs the tests that call the changed
function, the fastest first, until one fails: the mutant is killed. mutate.survivors.md explains mutants that may
survive; any other survivor, or a score below GOAL, fails the run.

    python tests/tools/mutate.py [--only design/exact.py] [--count 40] [--seed 0] [--jobs 2]
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import os
import pickle
import resource
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from mutants import ROOT, Mutant, install, mistakes

JUDGED = Path(__file__).with_name("mutate.survivors.md")
GOAL = 0.95
#: module -> its test files
TABLE = {
    "design/exact.py": "design/test_exact design/test_exact_blocks",
    "design/certificate.py": "design/test_certificate design/test_exact_blocks design/test_switching_file "
    "design/test_limiter design/test_walls_making",
    "design/conditions.py": "design/test_exact_blocks design/test_margin design/test_latency design/test_encoder_steps "
    "design/test_moving_average",
    "controller/tick.py": "controller/test_tick controller/test_walls controller/test_varying_delay "
    "controller/test_limiter controller/test_budget sim/test_switched sim/test_passivity_layer sim/test_engines "
    "sim/test_limited",
    "controller/complementarity.py": "controller/test_tick controller/test_walls controller/test_limiter",
    "controller/law.py": "controller/test_limiter controller/test_tick controller/test_walls",
    "hw/limits.py": "hw/test_limits",
    "hw/device_state.py": "hw/test_device hw/test_latch_on_arrival",
}
_ENOUGH = 6.0  # CPU seconds that the tests of one mutant may take without the mistake; the fastest tests are chosen
_TIMEOUT = 3.0  # a mutant is ended after 15 s of CPU time plus this many times the usual CPU time of its tests


# ---- running the tests in forks of a process that has collected them


class _Runner:
    """A pytest plugin that replaces pytest's loop over the tests."""

    def __init__(self, module: str, drawn: Sequence[Mutant], jobs: int) -> None:
        self.module, self.drawn, self.jobs = module, drawn, jobs
        self.ends: list[tuple[Mutant, str]] = []  # "killed", "timeout" or "survived"
        self.trouble, self.calling = "its tests did not run", False

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        seconds, calls, failed = _forked(lambda: self._learn(session))()
        self.trouble = f"fails without any mutant: {failed}" if failed else ""
        waiting: list[tuple[Mutant, Callable[[], Any]]] = []
        for mutant in () if failed else self.drawn:
            chosen, total = [], 0.0
            for item in sorted(session.items, key=lambda item: seconds[item.nodeid]):
                if mutant.function in calls[item.nodeid] and total + seconds[item.nodeid] < _ENOUGH:
                    chosen.append(item)
                    total += seconds[item.nodeid]
            if len(waiting) >= self.jobs:
                self._take(*waiting.pop(0))
            waiting.append((mutant, _forked(partial(self._try, mutant, chosen, total))))
        for each in waiting:
            self._take(*each)
        return True

    def _take(self, mutant: Mutant, result: Callable[[], Any]) -> None:
        end, by = result() or ("timeout", "")
        self.ends.append((mutant, end))
        print(f"{end:9} {mutant.key}  [{mutant.line}] {by}", flush=True)

    def _learn(self, session: pytest.Session) -> tuple[dict[str, float], dict[str, set[str]], str]:
        """Return each test's CPU seconds, the functions of the module that it calls, and the first test that fails."""
        calls: dict[str, set[str]] = defaultdict(set)
        seconds: dict[str, float] = {}
        place, item = str(ROOT / self.module), None

        def called(frame: FrameType, event: str, argument: Any) -> None:
            if event == "call" and frame.f_code.co_filename == place and item is not None:
                node = item.nodeid if self.calling else item.nodeid.partition("::")[0]
                calls[node].add(frame.f_code.co_qualname.partition(".<locals>")[0])

        sys.setprofile(called)
        for item, after in itertools.pairwise([*session.items, None]):
            begin = time.process_time()
            if failed := _fails(item, after):
                return {}, {}, failed
            seconds[item.nodeid] = time.process_time() - begin
        # The first test of a file makes the fixtures for all tests of the file.
        return seconds, {node: calls[node] | calls[node.partition("::")[0]] for node in seconds}, ""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self.calling = True
        try:
            return (yield)
        finally:
            self.calling = False

    def _try(self, mutant: Mutant, chosen: list[Any], seconds: float) -> tuple[str, str]:
        resource.setrlimit(resource.RLIMIT_CPU, (int(_TIMEOUT * seconds + 15), resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, resource.RLIM_INFINITY))
        install(mutant)
        for item, after in itertools.pairwise([*chosen, None]):
            if name := _fails(item, after):
                return "killed", name
        return "survived", f"{len(chosen)} tests"


def _fails(item: pytest.Item, after: pytest.Item | None) -> str:
    """Return the name of a test that fails, and '' for one that passes or is skipped."""
    from _pytest.runner import runtestprotocol

    reports = runtestprotocol(item, nextitem=after, log=False)
    return item.nodeid.removeprefix("tests/") if any(report.failed for report in reports) else ""


def _forked(work: Callable[[], Any]) -> Callable[[], Any]:
    """Begin the work in a fork. Return a function that waits for the result, which is None if the fork was killed."""
    read, write = os.pipe()
    if not (pid := os.fork()):
        os.close(read)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        try:
            result = work()
        except BaseException as error:  # a mutant may do anything
            result = ("killed", f"{type(error).__name__}: {error}")
        with os.fdopen(write, "wb") as out:
            pickle.dump(result, out)
        os._exit(0)
    os.close(write)

    def wait() -> Any:
        with os.fdopen(read, "rb") as source:
            data = source.read()
        os.waitpid(pid, 0)
        return pickle.loads(data) if data else None

    return wait


def ends_of(module: str, count: int, seed: int, jobs: int) -> list[tuple[Mutant, str]]:
    """Return `count` mutants of a module, each with its end."""
    every = [mutant for mutant, *_ in mistakes(module)]
    # The draw depends on the mutants' keys, so that a change of one line leaves the other mutants drawn.
    drawn = sorted(every, key=lambda m: hashlib.sha256(f"{seed} {m.key}".encode()).digest())[:count]
    runner = _Runner(module, sorted(drawn, key=lambda m: (m.place, m.kind)), jobs)
    files = [str(ROOT / "tests" / f"{name}.py") for name in TABLE[module].split()]
    pytest.main([*files, "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header", "--no-summary"], [runner])
    if runner.trouble:
        sys.exit(f"{module}: {runner.trouble}")
    return runner.ends


def main() -> int:
    parser = argparse.ArgumentParser(description="Do the tests notice small mistakes in what verdicts rest on?")
    parser.add_argument("--only", default=",".join(TABLE), help="modules, separated by commas")
    parser.add_argument("--count", type=int, default=40, help="mutants of each module (default 40)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    lines = (line[2:] for line in JUDGED.read_text().splitlines() if line.startswith("- "))
    known, unexplained, scored, killed = {line.partition("  ")[0].strip() for line in lines}, [], 0, 0
    for module in args.only.split(","):
        ends = ends_of(module, args.count, args.seed, args.jobs)
        unexplained += [m for m, end in ends if end == "survived" and m.key not in known]
        counted = [end for m, end in ends if not (end == "survived" and m.key in known)]
        scored, killed = scored + len(counted), killed + len(counted) - counted.count("survived")
        print(f"{module}: {len(ends)} mutants, {len(counted) - counted.count('survived')} of {len(counted)} killed")
    for mutant in unexplained:
        print(f"survived without an explanation: {mutant.key}  [line {mutant.line}]")
    print(f"score {killed / max(scored, 1):.1%}, seed {args.seed}")
    return 0 if not unexplained and killed >= GOAL * scored else 1


if __name__ == "__main__":
    sys.exit(main())
