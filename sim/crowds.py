"""A validation over local processes: batches go to whoever is free; the merged result is that of a single run."""

from __future__ import annotations

import asyncio
import logging
import math
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from controller.coupling import Coupling
from controller.environment import Member
from controller.lti import Array
from models.human import Population
from models.scene import Crowd, HumanSets, Variants, variants
from sim.engines import ExactBatchEngine, MujocoBatchEngine, hold
from sim.run import Assembly, Progress, assemble
from sim.scenario import InputError, Scenario
from sim.stability import ClosedLoop, Trace, disagree, dominant_modes, exact_loops, knock, mujoco_loops
from sim.switching import Switched, switched_crowd

if TYPE_CHECKING:
    from distributed import Client, Future


# ----------------------------------------------------------------------------------------------------
# Random passive humans, each from its own seed: human i is the same whoever draws it, and with whom.


MIXED = 0  # as a number of links: half the humans are simple, half are networks of two links


def draw(population: Population, channels: int, seed: int, index: int, links: int) -> Array:
    """Links of the humans with this index, one per channel: (channels, links, 3) as in Crowd.

    They depend on (seed, index) and the population only. `links` = MIXED tosses a coin between 1 and 2.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    count = int(rng.integers(1, 3)) if links == MIXED else links
    low, high = np.log([population.mass, population.damping, population.stiffness]).T
    return np.exp(rng.uniform(low, high, size=(channels, count, 3)))


def draw_bodies(population: Population, persons: int, seed: int, index: int) -> Array:
    """Bodies of the persons with this index who hold several devices: (persons, 5) as in Crowd, from the same ranges.

    Drawn apart from the links, which are the same whether or not somebody holds several devices.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    ranges = (population.mass, population.damping, population.stiffness, population.damping, population.stiffness)
    low, high = np.log(ranges).T
    return np.exp(rng.uniform(low, high, size=(persons, 5)))


def crowds(
    population: Population,
    channels: int,
    seed: int,
    indices: Iterable[int],
    links: int,
    holds: tuple[tuple[int, ...], ...] = (),
) -> Iterator[tuple[NDArray[np.intp], Crowd]]:
    """The humans of these indices, grouped by their number of links: (indices of the group, crowd).

    `holds` says which channels one person holds, as in Crowd.
    """
    drawn = {i: draw(population, channels, seed, i, links) for i in indices}
    for count in sorted({values.shape[1] for values in drawn.values()}):
        group = [i for i, values in drawn.items() if values.shape[1] == count]
        bodies = np.stack([draw_bodies(population, len(holds), seed, i) for i in group])
        yield np.array(group), Crowd(np.stack([drawn[i] for i in group]), holds, bodies)


def crowds_of(
    scenario: Scenario, seed: int, indices: Iterable[int], links: int
) -> Iterator[tuple[NDArray[np.intp], Crowd | HumanSets]]:
    """`crowds` for a scenario: of its population, and held together as its persons hold its devices.

    A user's own population draws from the same seeds, with the persons as they stand in the scenario.
    """
    if not isinstance(scenario.population, Population):
        yield from _own_crowds(scenario, seed, indices)
        return
    holds = tuple(person.holds for person in scenario.person)
    yield from crowds(scenario.population, scenario.channels, seed, indices, links, holds)


def _own_crowds(scenario: Scenario, seed: int, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], HumanSets]]:
    """Humans of a user's own population, grouped by how they are built: (indices of the group, sets)."""
    drawn, layouts = {}, {}
    for i in indices:
        rng = np.random.default_rng(np.random.SeedSequence((seed, i)))
        drawn[i] = tuple(scenario.population.draw(rng, scenario.channels))
        layouts[i] = tuple(human.port().layout for human in drawn[i])
    for layout in dict.fromkeys(layouts.values()):
        group = [i for i in drawn if layouts[i] == layout]
        yield np.array(group), HumanSets(tuple(drawn[i] for i in group), scenario.person)


def crowd_of(scenario: Scenario, seed: int, index: int, links: int) -> Crowd | HumanSets:
    """The one set of humans with this index."""
    ((_, crowd),) = crowds_of(scenario, seed, [index], links)
    return crowd


# ----------------------------------------------------------------------------------------------------
# One batch of a validation: everything that is found out about a range of human indices.


BATCH = 125  # humans that are decided together; always the same ones, so that shards repeat the single run exactly
ENGINES = ("exact", "mujoco", "both")


@dataclass(frozen=True)
class Question:
    """What is asked about every human."""

    scenario: Scenario
    coupling: Coupling
    seed: int
    humans: int
    links: int
    engine: str  # exact | mujoco | both
    duration: float  # [s] of the traces; 0 for none
    threads: int = 0  # of MuJoCo; 0 for all
    environments: tuple[Member, ...] = ()  # that the humans are spread over; empty: all meet the scenario's own

    @property
    def ticks(self) -> int:
        return round(self.duration / self.scenario.T)

    def batches(self) -> list[range]:
        """All indices, BATCH of them at a time, all in one environment."""
        spread = max(1, len(self.environments))
        each = [range(i, self.humans, spread) for i in range(min(spread, self.humans))]
        return [indices[i : i + BATCH] for indices in each for i in range(0, len(indices), BATCH)]

    def environment(self, index: int) -> Member | None:
        """What the humans of this index meet, None for the scenario's own environment: each in turn."""
        return self.environments[index % len(self.environments)] if self.environments else None

    def scenario_of(self, index: int) -> Scenario:
        """The scenario with the environment that the humans of this index meet."""
        member = self.environment(index)
        return self.scenario.replace(environment=member.network, box=None) if member else self.scenario


@dataclass(frozen=True, eq=False)
class Findings:
    """One entry per set of humans, sorted by index; nan where an engine or a trace was not asked for."""

    index: NDArray[np.intp]  # (n,)
    radius: Array  # (n,) spectral radius of the exact loop
    exact: Array  # (n,) [1/s] growth, exact loop
    frequency: Array  # (n,) [Hz] of that mode
    mujoco: Array  # (n,) [1/s] growth, MuJoCo's period map
    trace: Array  # (n,) [1/s] growth on MuJoCo's trace, or on the exact one where MuJoCo is not asked
    clipped: NDArray[np.int64]  # (n,) ticks with a force at its limit, on that trace
    energy: Array  # (n,) [J] least W(N) on the exact trace
    audited: Array  # (n,) [J] magnitudes that W adds up
    settling: Array  # (n,) rms speed of the handles, last quarter over second quarter, exact trace
    mass: Array  # (n,) [kg] per set: geometric mean over channels of all mass
    damping: Array  # (n,) [N s/m] likewise of the least damping
    switching: Array  # (n,) [1/s] growth of the linear loop under delays that vary; nan where they do not
    switching_mujoco: Array  # (n,) [1/s] the same on MuJoCo's trace; nan also where that was clipped
    simulated: float  # [s] in all traces
    interrupted: bool = False

    @property
    def disagreements(self) -> NDArray[np.bool_]:
        """(n,) whether MuJoCo, on its map or on a trace, contradicts the exact loop."""
        switching = disagree(self.switching, self.switching_mujoco)
        return disagree(self.exact, self.mujoco) | disagree(self.exact, self.trace) | switching


@threadpool_limits.wrap(limits=1, user_api="blas")  # the same bits in every process, wherever it runs
def examine(question: Question, indices: Sequence[int], ticked: Callable[[int], None] = lambda ticks: None) -> Findings:
    """Decide and simulate the humans of `indices`, who all meet the same environment.

    `ticked` hears of every tick simulated for all of them.
    """
    scenario = question.scenario_of(indices[0])
    assembly = assemble(scenario, question.coupling)
    parts = [
        _group(question, assembly, index, crowd, ticked)
        for index, crowd in crowds_of(scenario, question.seed, indices, question.links)
    ]
    return merge(parts)


def merge(parts: Sequence[Findings], interrupted: bool = False) -> Findings:
    """The findings of several batches as one, whatever their order."""
    arrays = [f.name for f in fields(Findings) if f.name not in ("simulated", "interrupted")]
    order = np.argsort(np.concatenate([p.index for p in parts]) if parts else np.zeros(0), kind="stable")
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(p, name) for p in parts])[order] if parts else order for name in arrays
    }
    return Findings(**joined, simulated=math.fsum(p.simulated for p in parts), interrupted=interrupted)


def _group(
    question: Question,
    assembly: Assembly,
    index: NDArray[np.intp],
    crowd: Crowd | HumanSets,
    ticked: Callable[[int], None],
) -> Findings:
    scenario, nowhere = question.scenario, np.full(len(crowd), np.nan)
    held_by = variants(scenario.device, crowd)
    loops = exact_loops(held_by, assembly.F)
    modes, mujoco = dominant_modes(loops), nowhere
    if question.engine != "exact":
        mujoco = dominant_modes(mujoco_loops(held_by, assembly.process, nthread=question.threads)).growth
    traces = _traces(question, assembly, held_by, loops, ticked) if question.ticks else []
    exact = next((t for name, t in traces if name == "exact"), None)
    last = traces[-1][1] if traces else None
    switched = Switched(nowhere, nowhere)
    if scenario.switches:
        with_mujoco = question.engine != "exact" and question.ticks > 0
        arguments = (held_by, index, question.seed, question.duration, with_mujoco, question.threads)
        switched = switched_crowd(assembly, question.coupling, *arguments)
    ports = crowd.ports
    mass = np.stack([port.mass.sum(axis=1) for port in ports], axis=1)  # (n, channels)
    damping = np.stack([port.damping.min(axis=1) for port in ports], axis=1)
    return Findings(
        index=index,
        radius=modes.spectral_radius,
        exact=modes.growth,
        frequency=modes.frequency_hz,
        mujoco=mujoco,
        trace=last.growth if last else nowhere,
        clipped=last.clipped if last else np.zeros(len(crowd), dtype=int),
        energy=exact.least_energy if exact else nowhere,
        audited=exact.audited if exact else nowhere,
        settling=exact.settling if exact else nowhere,
        mass=_geometric_mean(mass),
        damping=_geometric_mean(damping),
        switching=switched.exact,
        switching_mujoco=switched.mujoco,
        simulated=sum(t.simulated for _, t in traces),
    )


def _geometric_mean(values: Array) -> Array:
    """Over the channels, (n, channels) -> (n,); 0 where one of them is."""
    with np.errstate(divide="ignore"):
        return np.exp(np.log(values).mean(axis=1))


def _traces(
    question: Question, assembly: Assembly, held_by: Variants, loops: ClosedLoop, ticked: Callable[[int], None]
) -> list[tuple[str, Trace]]:
    """The exact engine's trace always, since it costs next to nothing; MuJoCo's after it, where that is asked."""
    process, delta, T = assembly.process, np.array(question.scenario.delta), question.scenario.T
    exact = ExactBatchEngine(hold(held_by.plants(), T), process.force_limit)
    traces = [("exact", knock(process, exact, held_by.scene, loops, delta, question.ticks))]
    if question.engine != "exact":
        batch = MujocoBatchEngine(held_by.scene, T, nsim=len(held_by), nthread=question.threads, fields=held_by.fields)
        traces.append(("mujoco", knock(process, batch, held_by.scene, loops, delta, question.ticks, ticked)))
    return traces


# ----------------------------------------------------------------------------------------------------
# A validation on an existing Dask cluster: each batch is a task, a lost worker's tasks are done again by another.
#
# The workers need this package and the same versions of NumPy, SciPy and MuJoCo; with those the merged result is that
# of a single run, bit for bit. Dask is an optional extra, imported only when a cluster is asked for.


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
    futures: list[Any] = []
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
