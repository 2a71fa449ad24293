"""Check that memory stays flat over an hour of a session (virtual time), and over 100,000 hands: `make validate`."""

from __future__ import annotations

import multiprocessing
import resource
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from haptic_loop.hw.control import CouplingRequest, certified_couplings
from haptic_loop.hw.emulator import Emulator
from haptic_loop.hw.limits import Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import session_for
from haptic_loop.sim.couplings import choose
from haptic_loop.sim.crowds import Validation, _as_worker, validate
from haptic_loop.sim.scenario import load
from haptic_loop.sim.stability import unstable
from tests.checks.faults import person


@dataclass(frozen=True)
class _Endured:
    """The result of long work, and the peak memory of its process [MiB]."""

    what: str
    result: str
    tenth_mib: float | None  # after a tenth of the work
    end_mib: float | None
    allowed_mib: float  # largest rise of the peak that is allowed after a tenth of the work
    holds: bool


_Mark = Callable[[float], None]  # called with the share of the work that is done


def _long_session(mark: _Mark, seconds: float = 3600.0) -> tuple[bool, str]:
    """Run a session in virtual time, armed for `seconds`; return whether it ended as planned, and how."""
    scenario = load()
    made = certified_couplings(CouplingRequest(scenario), 1, spare=0)
    session, emulator = session_for(scenario, LinkSettings()), Emulator(scenario)
    actions = [(seconds, person("stop"))]
    rehearsal = Rehearsal(session, emulator, lambda ages: made, actions=actions, keep=False)
    rehearsal.run(0.1 * seconds)
    mark(0.1)
    rehearsal.run_to_the_end(seconds + 5.0)
    ends = session.stage == Stage.FINISHED and not np.any(emulator.applied)
    return ends, f"{session.stage} ({session.cause}) after {session.counters.states} ticks"


def _many_hands(mark: _Mark, count: int = 100_000) -> tuple[bool, str]:
    """Validate random hands by eigenvalues; return whether all are stable, and the number of unstable ones in words."""
    scenario = load()
    question = Validation(scenario, choose(scenario, "I", "spring-damper").coupling, 0, count, 1, "exact", 0.0)
    findings = validate(question, progress=lambda done, total: mark(done / total))
    bad = int(unstable(findings.exact).sum())
    return bad == 0 and findings.index.size == count, f"{bad} of {findings.index.size} unstable"


_Work = Callable[[_Mark], tuple[bool, str]]

#: (name, work, allowed rise of peak memory after a tenth of the work [MiB]); a crowd stores 150 bytes per hand, twice
#: while its batches are joined
_LONG: tuple[tuple[str, _Work, float], ...] = (
    ("an hour of a session", _long_session, 8.0),
    ("100,000 hands", _many_hands, 32.0),
)


def endurance(_seed: int) -> Iterator[_Endured]:
    """Yield for each work, in a separate process, whether memory stays flat; the seed has no effect."""
    context = multiprocessing.get_context("spawn")  # A fork would begin with the memory of all earlier checks.
    for what, work, allowed in _LONG:
        here, there = context.Pipe(duplex=False)
        worker = context.Process(target=_alone, args=(work, allowed, there), daemon=True)
        worker.start()
        there.close()
        try:
            yield replace(here.recv(), what=what)
        except EOFError:
            yield _Endured(what, "broke off", None, None, allowed, False)
        finally:
            worker.terminate()
            worker.join()


def _alone(work: _Work, allowed: float, there: Connection) -> None:
    _as_worker()
    there.send(_endure(work, allowed))


def _endure(work: _Work, allowed: float) -> _Endured:
    peaks: list[float] = []

    def mark(share: float) -> None:
        if share >= 0.1 and not peaks:
            peaks.append(_peak())

    good, result = work(mark)
    tenth, end = peaks[0], _peak()
    flat = end - tenth <= allowed
    return _Endured("", result, tenth, end, allowed, good and flat)


def _peak() -> float:
    """Return the peak memory of this process [MiB]; Linux's getrusage would include the parent's before exec."""
    if (status := Path("/proc/self/status")).exists():
        return float(status.read_text().partition("VmHWM:")[2].split()[0]) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
