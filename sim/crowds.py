"""Validate a loop with many random passive humans, by both engines, in batches over processes or a cluster.

Human i depends on the seed and on i alone. Batches do not depend on the number of processes, so the merged result is
that of a single run, bit for bit (the workers of a cluster need this package and the same versions of NumPy, SciPy and
MuJoCo). MuJoCo decides by the map of its Runge-Kutta integrator, which shares only the model with the exact engine. Its
traces use the exponential integrator, at a fifth of the cost. The exact step simulates all humans, MuJoCo those whose
traces say most (`_witnessed`).

A batch whose worker died is repeated by another worker. A table, on disk if a folder is given for it, keeps every
finished batch, so memory does not grow with the number of humans. Workers end with the process that started them.
"""

from __future__ import annotations

import hashlib
import logging
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import Timing
from haptic_loop.controller.law import Law
from haptic_loop.controller.lti import Array
from haptic_loop.controller.ranges import Member
from haptic_loop.design.files import InputError
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Population
from haptic_loop.models.scene import Crowd, HumanSets, Variants, crowds, draw_mechanics, variants
from haptic_loop.sim.accuracy import simulated_growth
from haptic_loop.sim.engines import EXPONENTIAL, LEAST, Engine, ExactEngine, MujocoBatchEngine, OneByOne
from haptic_loop.sim.run import Progress, Simulation, assemble, engine_name, make_engine
from haptic_loop.sim.scenario import Scenario
from haptic_loop.sim.stability import (
    Balance,
    ClosedLoop,
    ImpulseTest,
    Mode,
    disagree,
    dominant_mode,
    exact_loops,
    impulse_test,
    mujoco_loops,
)
from haptic_loop.sim.switching import Switched, switched_crowd

if TYPE_CHECKING:
    from distributed import Client


ENGINES = ("exact", "mujoco", "both")
_BATCH = 125  # humans that are decided together
_NEAREST = 4  # of each group of alike humans in a batch, which are nearest to the limit
_AT_RANDOM = 64  # of all humans


# ---- random passive humans, each from its own seed


def _own_crowds(scenario: Scenario, seed: int, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], HumanSets]]:
    """Draw humans of a user's population, grouped by their structure: (indices of the group, sets)."""
    drawn, layouts = {}, {}
    for i in indices:
        rng = np.random.default_rng(np.random.SeedSequence((seed, i)))
        drawn[i] = tuple(scenario.population.draw(rng, len(scenario.device)))
        layouts[i] = tuple(human.port().layout for human in drawn[i])
    for layout in dict.fromkeys(layouts.values()):
        group = [i for i in drawn if layouts[i] == layout]
        mechanics = draw_mechanics(scenario.device, seed, group)
        yield np.array(group), HumanSets(tuple(drawn[i] for i in group), scenario.person, mechanics)


# ---- what is asked, and what is found


@dataclass(frozen=True)
class Validation:
    """A loop, the humans that hold it, and how they are judged."""

    scenario: Scenario
    coupling: Coupling
    seed: int
    humans: int
    links: int
    engine: str | Callable[[Simulation], Engine]  # exact | mujoco | both, or a factory of a user's engine
    duration: float  # [s] of the traces; 0 for none
    threads: int = 0  # of MuJoCo; 0 for all
    environments: tuple[Member, ...] = ()  # humans meet these in turn; empty: all meet the scenario's
    lag: tuple[float, ...] | None = None  # rho (m,) [N/m] of the limiter; None: forces are clipped
    all_traces: bool = False  # of MuJoCo, or of a user's own engine: not only of the humans that say most

    @property
    def ticks(self) -> int:
        return round(self.duration / self.scenario.T)

    def batches(self) -> list[range]:
        """Yield all indices in batches of _BATCH; each batch meets one environment."""
        spread = max(1, len(self.environments))
        each = [range(i, self.humans, spread) for i in range(min(spread, self.humans))]
        return [indices[i : i + _BATCH] for indices in each for i in range(0, len(indices), _BATCH)]

    def environment(self, index: int) -> Member | None:
        """Return the environment that the humans of this index meet; None is the scenario's own."""
        return self.environments[index % len(self.environments)] if self.environments else None

    @property
    def digest(self) -> str:
        """The digest of everything that the findings depend on."""
        how = (
            self.coupling.form(),
            self.seed,
            self.humans,
            self.links,
            self.engine if isinstance(self.engine, str) else engine_name(self.engine),
            self.ticks,
            self.environments,
            self.lag,
            *(["all traces"] if self.all_traces else []),
        )
        return hashlib.sha256(f"{self.scenario.digest} {how!r}".encode()).hexdigest()[:16]

    def crowds(self, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], Crowd | HumanSets]]:
        """Draw the humans of these indices, joined as the scenario's persons join its devices.

        A user's own population draws from the same seeds, with the persons as they stand in the scenario.
        """
        scenario = self.scenario
        if not isinstance(scenario.population, Population):
            return _own_crowds(scenario, self.seed, indices)
        holds = tuple(person.holds for person in scenario.person)
        counts = tuple(len(device.free) for device in scenario.device)
        axes = counts if max(counts) > 1 else ()
        return crowds(scenario.population, len(counts), self.seed, indices, self.links, holds, axes, scenario.device)

    def crowd(self, index: int) -> Crowd | HumanSets:
        """Draw the set of humans with this index."""
        ((_, crowd),) = self.crowds([index])
        return crowd


@dataclass(frozen=True, eq=False)
class Findings:
    """The results for every set of humans, sorted by index; nan where an engine or a trace was not requested.

    Attributes:
        index: (n,) number of each set, which together with the seed draws it.
        radius: (n,) spectral radius of the exact loop, no unit.
        exact: (n,) growth rate of the exact loop [1/s]; above zero the set makes the loop unstable.
        frequency: (n,) frequency of that mode [Hz].
        mujoco: (n,) growth rate [1/s] of the period map of MuJoCo, or of a user's own engine.
        trace: (n,) growth rate [1/s] on its trace, or on the exact one where no other was made.
        witnessed: (n,) whether MuJoCo, or a user's own engine, made that trace.
        trace_error: (n,) error of that rate [1/s]; a rate within it does not vote.
        clipped: (n,) number of ticks with a force at its limit, on that trace.
        energy: (n,) least energy W(N) on the exact trace [J].
        audited: (n,) sum of the magnitudes that W adds up [J].
        settling: (n,) rms speed of the handles, last quarter over second quarter of the exact trace, no unit.
        contacts: (n,) how often a wall was touched on the exact trace.
        mass: (n,) geometric mean over channels of all mass of a hand [kg].
        damping: (n,) geometric mean over channels of the least damping of a hand [N s/m].
        switching: (n,) growth rate [1/s] of the linear loop under delays or ticks that vary; nan where they do not.
        switching_mujoco: (n,) the same on MuJoCo's trace [1/s]; nan also where that was clipped.
        simulated: The duration of all traces together [s].
        interrupted: Whether the keyboard interrupted the validation.
        lost: Why batches are missing that nobody interrupted.
    """

    index: NDArray[np.intp]
    radius: Array
    exact: Array
    frequency: Array
    mujoco: Array
    trace: Array
    witnessed: NDArray[np.bool_]
    trace_error: Array
    clipped: NDArray[np.int64]
    energy: Array
    audited: Array
    settling: Array
    contacts: NDArray[np.int64]
    mass: Array
    damping: Array
    switching: Array
    switching_mujoco: Array
    simulated: float
    interrupted: bool = False
    lost: str = ""

    def __repr__(self) -> str:
        worst = f", worst {np.nanmax(self.exact):+.3g} 1/s" if np.isfinite(self.exact).any() else ""
        return f"Findings({self.index.size} sets of hands: {int((self.exact > 0).sum())} unstable{worst})"

    @property
    def disagreements(self) -> NDArray[np.bool_]:
        """(n,) whether MuJoCo, on its map or on a trace that decides, contradicts the exact loop."""
        switching = disagree(self.switching, self.switching_mujoco)
        trace = np.where(self.trace_decides, self.trace, np.nan)
        return disagree(self.exact, self.mujoco) | disagree(self.exact, trace) | switching

    @property
    def trace_decides(self) -> NDArray[np.bool_]:
        """(n,) whether the growth rate of the trace is larger than its error: only then its sign is a verdict."""
        return np.abs(self.trace) > self.trace_error


#: fields of Findings with one entry for every set of humans
_COLUMNS = tuple(f.name for f in fields(Findings) if f.name not in ("simulated", "interrupted", "lost"))


def _merge(parts: Sequence[Findings]) -> Findings:
    """Merge the findings of the groups of a batch."""
    order = np.argsort(np.concatenate([p.index for p in parts]), kind="stable")
    joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts])[order] for name in _COLUMNS}
    return Findings(**joined, simulated=math.fsum(p.simulated for p in parts))


# ---- one batch


@threadpool_limits.wrap(limits=1, user_api="blas")  # the same bits in every process, wherever it runs
def _examine(
    validation: Validation, indices: Sequence[int], ticked: Callable[[int], None] = lambda ticks: None
) -> Findings:
    """Judge and simulate the humans of `indices`, who all meet the same environment.

    `ticked` is called with the number of ticks that were simulated for all of them.
    """
    scenario, member = validation.scenario, validation.environment(indices[0])
    if member:
        scenario = scenario.replace(environment=member.network, ranges=None)
    simulation = assemble(scenario, validation.coupling, validation.lag)
    return _merge([_group(validation, simulation, *group, ticked) for group in validation.crowds(indices)])


def _group(
    validation: Validation,
    simulation: Simulation,
    index: NDArray[np.intp],
    crowd: Crowd | HumanSets,
    ticked: Callable[[int], None],
) -> Findings:
    scenario, nowhere = validation.scenario, np.full(len(crowd), np.nan)
    held_by = variants(scenario.device, crowd)
    late, mujoco = scenario.usual_latency, nowhere
    loops = exact_loops(held_by, simulation.F, late=late)
    frozen = [replace(simulation.process, law=Law(F)) for F in simulation.process.law.frozen().values()]
    mode = Mode.worst([dominant_mode(exact_loops(held_by, process.F, late=late)) for process in frozen])
    damping = np.stack([port.damping.min(axis=1) for port in crowd.ports], axis=1)
    lossless = np.stack([port.damping.max(axis=1) for port in crowd.ports], axis=1).min(axis=1) == 0
    other: _Other | None = None
    if not isinstance(validation.engine, str):
        drawn = crowd.mechanics or ((),) * len(crowd)
        each = [simulation.held_by(crowd.humans(i), crowd.persons(i), own) for i, own in enumerate(drawn)]
        make = validation.engine
        mujoco = np.array([simulated_growth(one, None, None, make) for one in each])

        def one_by_one(sets: NDArray[np.intp], integrator: str, timing: Timing | None) -> Engine:
            """Make the user's engine, which takes its timing from the simulation."""
            return OneByOne([make_engine(each[i], make) for i in sets])

        other = one_by_one
    elif validation.engine != "exact":
        maps = (mujoco_loops(held_by, process, nthread=validation.threads, late=late) for process in frozen)
        mujoco = Mode.worst([dominant_mode(loop) for loop in maps]).growth
        other = partial(_batch, held_by, scenario.T, validation.threads)
    exact: ImpulseTest | None = None
    witnesses = np.zeros(0, dtype=np.intp)
    if validation.ticks:
        if other:
            witnesses = _witnessed(validation, index, mode.growth, lossless)
        exact = _traced(validation, simulation, held_by, loops, other, witnesses, ticked)
    switched = Switched(nowhere, nowhere)
    if scenario.switches or scenario.uneven:
        also = other if validation.ticks else None
        switched = switched_crowd(simulation, held_by, index, validation.seed, validation.duration, also)
    return Findings(
        index=index,
        radius=mode.spectral_radius,
        exact=mode.growth,
        frequency=mode.frequency_hz,
        mujoco=mujoco,
        trace=exact.growth if exact else nowhere,
        witnessed=np.isin(np.arange(len(crowd)), witnesses),
        trace_error=exact.error if exact else nowhere,
        clipped=exact.clipped if exact else np.zeros(len(crowd), dtype=int),
        energy=exact.least_energy if exact else nowhere,
        audited=exact.audited if exact else nowhere,
        settling=exact.settling if exact else nowhere,
        contacts=exact.contacts if exact else np.zeros(len(crowd), dtype=int),
        mass=_geometric_mean(np.stack([port.mass.sum(axis=1) for port in crowd.ports], axis=1)),
        damping=_geometric_mean(damping),
        switching=switched.exact,
        switching_mujoco=switched.mujoco,
        simulated=exact.simulated if exact else 0.0,
    )


#: (numbers of the sets of humans, integrator, timing) -> the other engine
_Other = Callable[[NDArray[np.intp], str, Timing | None], Engine]


def _batch(
    held_by: Variants, T: float, threads: int, sets: NDArray[np.intp], integrator: str, timing: Timing | None
) -> Engine:
    return MujocoBatchEngine(
        held_by.taken(sets), T, integrator, 1 if integrator == EXPONENTIAL else LEAST, threads, timing
    )


def _geometric_mean(values: Array) -> Array:
    """Return the geometric mean over the channels, (n, channels) -> (n,); 0 where a channel is 0."""
    with np.errstate(divide="ignore"):
        return np.exp(np.log(values).mean(axis=1))


def _witnessed(
    validation: Validation, index: NDArray[np.intp], growth: Array, lossless: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Numbers of the humans of one group that the other engine simulates, too.

    These are all lossless ones, the _NEAREST whose `growth` [1/s] is nearest to zero, and whoever is among the
    _AT_RANDOM of all humans. They follow from the question and the group alone, whoever works on it.
    """
    if validation.all_traces:
        return np.arange(len(index))
    rng = np.random.default_rng(np.random.SeedSequence((validation.seed, validation.humans)))
    drawn = rng.choice(validation.humans, min(_AT_RANDOM, validation.humans), replace=False)
    chosen = lossless | np.isin(index, drawn)
    chosen[np.argsort(np.abs(growth), kind="stable")[:_NEAREST]] = True
    return np.flatnonzero(chosen)


def _traced(
    validation: Validation,
    simulation: Simulation,
    held_by: Variants,
    loops: ClosedLoop,
    other: _Other | None,
    witnesses: NDArray[np.intp],
    ticked: Callable[[int], None],
) -> ImpulseTest:
    """Return the exact engine's impulse test, with growth and clipped ticks of the other engine's for `witnesses`.

    In even periods, with forces that latch in the middle of their range: what their spread does is `switched_crowd`'s.
    """
    process, T = simulation.process, validation.scenario.T
    late, ticks = validation.scenario.usual_latency, validation.ticks
    balance, engine = Balance.of(held_by, simulation.loop, late), ExactEngine(hold(held_by.plants(), T, late))
    exact = impulse_test(process, engine, held_by.scene, loops, balance, ticks)
    if not other:
        return exact
    timing = Timing(np.array([T]), np.array([late])) if late else None
    few = held_by.taken(witnesses)
    settings = few.scene, exact_loops(few, simulation.F, late=late), Balance.of(few, simulation.loop, late), ticks
    last = impulse_test(process, other(witnesses, EXPONENTIAL, timing), *settings, ticked)
    growth, error, clipped = (getattr(exact, name).copy() for name in ("growth", "error", "clipped"))
    growth[witnesses], error[witnesses], clipped[witnesses] = last.growth, last.error, last.clipped
    simulated = exact.simulated + last.simulated
    return replace(exact, growth=growth, error=error, clipped=clipped, simulated=simulated)


# ----------------------------------------------------------------------------------------------------
# All batches: in this process, in several, or on a Dask cluster.

_PATIENCE = 3.0  # [s] that a scheduler has to answer, and again its first worker
_AGAIN = 3  # consecutive deaths of workers without a finished batch
_LOOK, _DESERTED = 5.0, 60.0  # [s] between checks for workers, and without any worker until the cluster is given up
_AHEAD = 4  # batches in flight for every worker, so that results do not pile up


class Table:
    """The findings by column, in memory or in a file that is mapped only while it is used."""

    def __init__(self, question: Validation, folder: Path | None = None, resume: bool = False) -> None:
        """Open the table; `resume` continues an unfinished file. Raises InputError if none exists."""
        self._batches = question.batches()
        self._path = folder / f"unfinished-{question.digest}.npy" if folder else None
        shape = (
            len(_COLUMNS) + 2,
            question.humans,
        )  # the last two columns: simulated seconds, and whether the set is done
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
        """The numbers of the unfinished batches."""
        done = self._open("r")[-1]
        return [number for number, batch in enumerate(self._batches) if not done[batch[0]]]

    def put(self, number: int, part: Findings) -> None:
        """Store the findings of a batch; the mark "done" is written last."""
        batch, table = self._batches[number], self._open("r+")
        where = slice(batch.start, batch.stop, batch.step)
        for row, name in zip(table, _COLUMNS, strict=False):
            row[where] = getattr(part, name)
        table[-2, where] = part.simulated / len(batch)
        table[-1, where] = 1

    def findings(self, interrupted: bool = False, lost: str = "") -> Findings:
        """Return the findings of all finished batches, and remove the file once all are finished."""
        table = self._open("r")
        done, rows = table[-1] != 0, dict(zip(_COLUMNS, table, strict=False))
        if not done.all():
            rows = {name: row[done] for name, row in rows.items()}
        elif self._path:
            self._path.unlink()  # the mapped pages stay readable
        for name in ("index", "clipped"):
            rows[name] = rows[name].astype(int)
        rows["witnessed"] = rows["witnessed"].astype(bool)
        return Findings(**rows, simulated=float(table[-2].sum()), interrupted=interrupted, lost=lost)


def validate(
    question: Validation,
    shards: int = 1,
    progress: Progress = lambda done, total: None,
    table: Table | None = None,
) -> Findings:
    """Examine every batch that is missing in the table, or all batches without a table.

    An interruption and repeated deaths of workers end the validation with the batches that are finished.
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
        table.put(number, _examine(question, batches[number], ticked))
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
    """Return how many of the missing batches were finished before a worker died."""
    batches, alone, done = question.batches(), replace(question, threads=1), 0
    # a forked child would inherit locks of MuJoCo's threads and of the progress bar
    context = multiprocessing.get_context("spawn")
    strangers = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(shards, mp_context=context, initializer=_as_worker)
    left, running = iter(missing), dict[Future[Findings], int]()
    try:
        while True:
            for number in left:
                running[pool.submit(_examine, alone, batches[number])] = number
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
            worker.terminate()  # a batch may take half a minute and stores nothing before its end
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _finished(running: dict[Future[Findings], int], table: Table) -> int:
    """Store the other batches that are finished, and return their number."""
    ready = [future for future in running if future.done() and not future.cancelled() and not future.exception()]
    for future in ready:
        table.put(running[future], future.result())
    return len(ready)


def _as_worker() -> None:
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
    """`_examine`, one at a time in every worker process, however many threads that has."""
    with _one_at_a_time:
        return _examine(question, indices)


@contextmanager
def _client(address: str, patience: float) -> Iterator[Client]:
    """Return a client of the cluster. Raises InputError where none answers."""
    import asyncio  # slow to load

    try:
        from distributed import Client
        from distributed.comm.core import connect
        from distributed.core import coerce_to_address
        from distributed.security import Security
    except ImportError:
        raise InputError("--dask needs Dask: pip install 'distributed>=2024.8'") from None
    for name in ("distributed", "distributed.client"):  # errors are reported once, by us
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)

    async def reach() -> None:
        comm = await connect(coerce_to_address(address), timeout=patience, **Security().get_connection_args("client"))
        await comm.close()

    try:
        asyncio.run(reach())  # a Client without a scheduler would complain again when it is collected
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"--dask {address}: no cluster there: {error}; expected HOST:PORT of a scheduler") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            raise InputError(f"--dask {address}: that cluster has no workers") from None
        yield client
