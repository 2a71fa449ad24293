"""Validate a loop with many random passive humans, by two engines, in batches that can run in several processes.

A set has one human for each device. The humans of set i depend on the scenario, the seed and the number of links, and
not on other sets. The batches, and therefore the findings, do not depend on the number of processes.

The first engine is the exact one, which simulates all sets. The second engine is MuJoCo or a user's own, and simulates
all sets or a sample (`_witnessed`). MuJoCo's verdict comes from the map of its RK4 integrator over one period, the
period map. Both engines share the model, but the period map uses nothing that the exact engine computes.
MuJoCo's traces use the exponential integrator, at a fifth of RK4's cost; under varying delays or ticks they use RK4.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from multiprocessing.connection import wait as wait_for
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import Timing
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.ranges import Member
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.human import Human, Population
from haptic_loop.models.scene import Crowd, HumanSets, Variants, crowds, draw_mechanics, variants
from haptic_loop.sim.accuracy import simulated_growth
from haptic_loop.sim.engines import EXPONENTIAL, Engine, ExactEngine, MujocoBatchEngine, OneByOne, least_substeps
from haptic_loop.sim.run import Progress, Simulation, assemble, make_engine
from haptic_loop.sim.scenario import Scenario, require_scaled_hands
from haptic_loop.sim.stability import (
    Balance,
    ClosedLoop,
    ImpulseTest,
    Mode,
    close,
    disagree,
    dominant_mode,
    impulse_test,
    mujoco_plants,
)
from haptic_loop.sim.switching import Switched, switched_crowd

ENGINES = ("exact", "mujoco", "both")
_BATCH = 500  # largest number of sets of humans in a batch
_NEAREST = 8  # number of sets nearest to the stability limit that are sampled in each group of a batch
_AT_RANDOM = 64  # number of sets in the random sample of all sets


# ---- random passive humans


def _own_crowds(scenario: Scenario, seed: int, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], HumanSets]]:
    """Draw humans of a user's population; yield (indices, sets of hands) for each group with ports of equal shape."""
    drawn, layouts = {}, {}
    for i in indices:
        rng = np.random.default_rng(np.random.SeedSequence((seed, i)))
        drawn[i] = tuple(scenario.population.draw(rng, len(scenario.device)))
        layouts[i] = tuple(human.port().layout for human in drawn[i])
    for layout in dict.fromkeys(layouts.values()):
        group = [i for i in drawn if layouts[i] == layout]
        mechanics = draw_mechanics(scenario.device, seed, group)
        yield np.array(group), HumanSets(tuple(drawn[i] for i in group), scenario.person, mechanics)


# ---- the question and the result


@dataclass(frozen=True)
class Validation:
    """A loop, and the settings of its validation."""

    scenario: Scenario
    coupling: Coupling
    seed: int
    humans: int  # number of sets of random humans
    links: int  # number of links of each hand
    engine: str | Callable[[Simulation], Engine]  # exact | mujoco | both, or a factory of a user's engine
    duration: float  # [s] length of the traces; 0 for no traces
    threads: int = 0  # number of MuJoCo's threads; 0: one, or one per core for large batches
    environments: tuple[Member, ...] = ()  # environments that the sets touch in turn; (): all touch the scenario's
    lag: tuple[float, ...] | None = None  # rho (m,) [N/m] of the limiter; None: forces are clipped
    all_traces: bool = False  # MuJoCo, or a user's own engine, simulates all humans in place of a sample

    def __post_init__(self) -> None:
        require_scaled_hands(self.scenario)

    @property
    def ticks(self) -> int:
        return round(self.duration / self.scenario.T)

    @cached_property
    def simulation(self) -> Simulation:
        """The loop with the scenario's own humans and environment."""
        return assemble(self.scenario, self.coupling, self.lag)

    def batches(self) -> list[range]:
        """Return the indices of all sets in batches of at most _BATCH. The sets of a batch touch one environment."""
        spread = max(1, len(self.environments))
        each = [range(i, self.humans, spread) for i in range(min(spread, self.humans))]
        return [indices[i : i + _BATCH] for indices in each for i in range(0, len(indices), _BATCH)]

    def environment(self, index: int) -> Member | None:
        """Return the environment that the set of this index touches; None for the scenario's own."""
        return self.environments[index % len(self.environments)] if self.environments else None

    def crowds(self, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], Crowd | HumanSets]]:
        """Draw the humans of these indices, and yield them in groups (indices, humans).

        Persons who hold several devices are drawn for the same devices as the scenario's persons. A user's own
        population draws no persons, so that the scenario's persons stay unchanged.
        """
        scenario = self.scenario
        if not isinstance(scenario.population, Population):
            return _own_crowds(scenario, self.seed, indices)
        holds = tuple(person.holds for person in scenario.person)
        counts = tuple(len(device.free) for device in scenario.device)
        axes = counts if max(counts) > 1 else ()
        return crowds(scenario.population, len(counts), self.seed, indices, self.links, holds, axes, scenario.device)

    def crowd(self, index: int) -> Crowd | HumanSets:
        ((_, crowd),) = self.crowds([index])
        return crowd

    def can_store(self, index: int) -> bool:
        """Return whether a file can store the humans with this index: all must be of the class Human."""
        return all(isinstance(human, Human) for human in self.crowd(index).humans(0))


@dataclass(frozen=True, eq=False)
class Findings:
    """The results for every set of humans, sorted by index.

    Figures are nan and counts 0 without the engine or the trace that they need. W(N) [J] is the energy that the devices
    give to the controller up to tick N (sum of f'dx), plus their least dissipation. With walls, `radius`, `exact`,
    `frequency` and `mujoco` are those for the set of touched walls with the fastest growth.

    Attributes:
        index: (n,) number of each set. With the seed, it determines the humans of the set.
        radius: (n,) spectral radius of the exact loop, no unit.
        exact: (n,) growth rate of the exact loop [1/s]; a set with a positive rate makes the loop unstable.
        frequency: (n,) frequency of the exact loop's dominant mode [Hz].
        mujoco: (n,) growth rate [1/s] of the period map of MuJoCo, or of a user's own engine.
        trace: (n,) growth rate [1/s] on a trace: of the second engine if it simulated the set, otherwise of the exact
            engine; nan with walls.
        witnessed: (n,) whether the second engine, MuJoCo or a user's own, made the trace of `trace`.
        trace_error: (n,) error of `trace` [1/s]; a rate that is smaller than its error gives no verdict.
        clipped: (n,) number of ticks of the same trace in which a force is at its limit or a limiter acts.
        energy: (n,) least energy W(N) [J] on the exact trace; without a limiter, before the first clipped force.
        audited: (n,) sum of the magnitudes of the terms of W [J].
        settling: (n,) ratio of the handles' rms speeds in the last and the second quarter of the exact trace.
        contacts: (n,) number of times that a wall was touched on the exact trace.
        mass: (n,) geometric mean over devices of a hand's total mass [kg].
        damping: (n,) geometric mean over devices of a hand's least damping [N s/m].
        switching: (n,) growth rate [1/s] of the linear loop under varying delays or ticks; nan for constant ones.
        switching_mujoco: (n,) growth rate [1/s] of the second engine under the same delays or ticks; nan also if a
            force of its trace is clipped.
        simulated: Simulated time of all impulse tests [s], without the traces under varying delays or ticks.
        interrupted: Whether the keyboard interrupted the validation.
        lost: The reason for missing batches, other than Ctrl-C, or "".
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
        """(n,) whether `exact` contradicts `mujoco` or a decisive `trace`, or the two switching rates disagree."""
        switching = disagree(self.switching, self.switching_mujoco)
        trace = np.where(self.trace_decides, self.trace, np.nan)
        return disagree(self.exact, self.mujoco) | disagree(self.exact, trace) | switching

    @property
    def trace_decides(self) -> NDArray[np.bool_]:
        """(n,) whether the size of the trace's growth rate is larger than its error."""
        return np.abs(self.trace) > self.trace_error


#: fields of Findings with one entry for every set of humans
_COLUMNS = tuple(f.name for f in fields(Findings) if f.name not in ("simulated", "interrupted", "lost"))


def _merge(parts: Sequence[Findings]) -> Findings:
    if not parts:
        kinds: dict[str, type] = {"index": int, "witnessed": bool, "clipped": int, "contacts": int}
        empty: dict[str, Any] = {name: np.zeros(0, dtype=kinds.get(name, float)) for name in _COLUMNS}
        return Findings(**empty, simulated=0.0)
    order = np.argsort(np.concatenate([p.index for p in parts]), kind="stable")
    joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts])[order] for name in _COLUMNS}
    return Findings(**joined, simulated=math.fsum(p.simulated for p in parts))


# ---- one batch


@threadpool_limits.wrap(limits=1, user_api="blas")  # One thread gives the same bits in every process.
def _examine(
    validation: Validation, indices: Sequence[int], ticked: Callable[[int], None] = lambda ticks: None
) -> Findings:
    """Return the findings of one batch; `ticked` is called with the ticks of each block of the second engine."""
    simulation = validation.simulation
    if member := validation.environment(indices[0]):
        scenario = validation.scenario.replace(environment=member.network, ranges=None)
        simulation = assemble(scenario, validation.coupling, validation.lag)
    return _merge([_group(validation, simulation, *group, ticked) for group in validation.crowds(indices)])


def _group(
    validation: Validation,
    simulation: Simulation,
    index: NDArray[np.intp],
    crowd: Crowd | HumanSets,
    ticked: Callable[[int], None],
) -> Findings:
    """Return the findings for humans whose ports have equal shapes."""
    scenario, missing = validation.scenario, np.full(len(crowd), np.nan)
    held_by = variants(scenario.device, crowd)
    late = scenario.usual_latency
    plants = hold(held_by.plants(), scenario.T, late)
    loops, frozen = close(plants, simulation.F), simulation.process.law.frozen().values()
    mode = _dominant(plants, frozen) if simulation.process.walls else dominant_mode(loops)
    damping = np.stack([port.damping.min(axis=1) for port in crowd.ports], axis=1)
    lossless = np.stack([port.damping.max(axis=1) for port in crowd.ports], axis=1).min(axis=1) == 0
    other, growth = _other_engine(validation, simulation, held_by, crowd, frozen)
    mujoco = missing if growth is None else growth
    exact: ImpulseTest | None = None
    witnesses = np.zeros(0, dtype=np.intp)
    if validation.ticks:
        if other:
            witnesses = _witnessed(validation, index, mode.growth, lossless)
        exact = _traced(validation, simulation, held_by, loops, plants, other, witnesses, ticked)
    switched = Switched(missing, missing)
    if scenario.switches or scenario.uneven:
        also = other if validation.ticks else None
        switched = switched_crowd(simulation, held_by, index, validation.seed, validation.duration, also)
    return Findings(
        index=index,
        radius=mode.spectral_radius,
        exact=mode.growth,
        frequency=mode.frequency_hz,
        mujoco=mujoco,
        trace=exact.growth if exact else missing,
        witnessed=np.isin(np.arange(len(crowd)), witnesses),
        trace_error=exact.error if exact else missing,
        clipped=exact.clipped if exact else np.zeros(len(crowd), dtype=int),
        energy=exact.least_energy if exact else missing,
        audited=exact.audited if exact else missing,
        settling=exact.settling if exact else missing,
        contacts=exact.contacts if exact else np.zeros(len(crowd), dtype=int),
        mass=_geometric_mean(np.stack([port.mass.sum(axis=1) for port in crowd.ports], axis=1)),
        damping=_geometric_mean(damping),
        switching=switched.exact,
        switching_mujoco=switched.mujoco,
        simulated=exact.simulated if exact else 0.0,
    )


#: (positions in their group of the sets to simulate, integrator, timing) -> the second engine
_Other = Callable[[NDArray[np.intp], str, Timing | None], Engine]


def _other_engine(
    validation: Validation,
    simulation: Simulation,
    held_by: Variants,
    crowd: Crowd | HumanSets,
    frozen: Collection[Lti],
) -> tuple[_Other | None, Array | None]:
    """Return a factory of the second engine and the growth rates of its period maps; (None, None) without one.

    `frozen` has the force map for each set of touched walls. The map of a user's own engine is measured by one step
    from each basis state.
    """
    if not isinstance(validation.engine, str):
        drawn = crowd.mechanics or ((),) * len(crowd)
        each = [simulation.held_by(crowd.humans(i), crowd.persons(i), own) for i, own in enumerate(drawn)]
        make = validation.engine

        def one_by_one(sets: NDArray[np.intp], integrator: str, timing: Timing | None) -> Engine:
            """Make the user's engines, which take the timing from the simulations."""
            return OneByOne([make_engine(each[i], make) for i in sets])

        return one_by_one, np.array([simulated_growth(one, None, None, make) for one in each])
    if validation.engine == "exact":
        return None, None
    late = validation.scenario.usual_latency
    plants = mujoco_plants(held_by, simulation.process, nthread=validation.threads, late=late)
    growth = _dominant(plants, frozen).growth
    return partial(_batch, held_by, validation.scenario.T, validation.threads), growth


def _dominant(plants: HeldPlant, frozen: Iterable[Lti]) -> Mode:
    """Return each plant's dominant mode in the loop with the force map of `frozen` that gives the fastest growth."""
    return Mode.worst([dominant_mode(close(plants, F)) for F in frozen])


def _batch(
    held_by: Variants, T: float, threads: int, sets: NDArray[np.intp], integrator: str, timing: Timing | None
) -> Engine:
    return MujocoBatchEngine(held_by.taken(sets), T, integrator, least_substeps(integrator), threads, timing)


def _geometric_mean(values: Array) -> Array:
    """Return the geometric mean over the devices, (n, devices) -> (n,); 0 where a device has 0."""
    with np.errstate(divide="ignore"):
        return np.exp(np.log(values).mean(axis=1))


def _witnessed(
    validation: Validation, index: NDArray[np.intp], growth: Array, lossless: NDArray[np.bool_]
) -> NDArray[np.intp]:
    """Return the positions in a group of the sets that the second engine also simulates.

    These are all sets with a lossless hand, the _NEAREST sets whose `growth` [1/s] is nearest to zero, and the sets of
    the random sample. With `all_traces` these are all sets.
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
    plants: HeldPlant,
    other: _Other | None,
    witnesses: NDArray[np.intp],
    ticked: Callable[[int], None],
) -> ImpulseTest:
    """Return the exact engine's impulse test; growth, error and clipped ticks of `witnesses` are the second engine's.

    Here periods are constant, and each force latches at the middle of its range; `switched_crowd` varies these times.
    """
    process, T = simulation.process, validation.scenario.T
    late, ticks = validation.scenario.usual_latency, validation.ticks
    balance = Balance.of(held_by, simulation.loop, late)
    lever = validation.scenario.lever
    exact = impulse_test(process, ExactEngine(plants), held_by.scene, loops, balance, ticks, lever)
    if not other:
        return exact
    timing = Timing(np.array([T]), np.array([late])) if late else None
    few = held_by.taken(witnesses)
    own = ClosedLoop(loops.A[witnesses], loops.B[witnesses], T)
    settings = few.scene, own, Balance.of(few, simulation.loop, late), ticks, lever
    last = impulse_test(process, other(witnesses, EXPONENTIAL, timing), *settings, ticked)
    growth, error, clipped = (getattr(exact, name).copy() for name in ("growth", "error", "clipped"))
    growth[witnesses], error[witnesses], clipped[witnesses] = last.growth, last.error, last.clipped
    simulated = exact.simulated + last.simulated
    return replace(exact, growth=growth, error=error, clipped=clipped, simulated=simulated)


# ---- all batches, in this process or in several


def validate(question: Validation, shards: int = 1, progress: Progress = lambda done, total: None) -> Findings:
    """Return the findings of all batches; after Ctrl-C, a worker's death or lack of memory, of the finished ones."""
    parts, interrupted, lost = dict[int, Findings](), False, ""
    try:
        if shards == 1:
            _here(question, parts, progress)
        else:
            _in_processes(question, shards, parts, progress)
    except KeyboardInterrupt:
        interrupted = True
    except BrokenProcessPool:
        lost = "a worker process died"
    except MemoryError:
        lost = "memory ran out"
    return replace(_merge(list(parts.values())), interrupted=interrupted, lost=lost)


def _here(question: Validation, parts: dict[int, Findings], progress: Progress) -> None:
    batches, ticks, ticks_done = question.batches(), max(1, question.ticks), 0

    def ticked(count: int) -> None:
        nonlocal ticks_done
        ticks_done += count
        progress(ticks_done, ticks * len(batches))

    for number, batch in enumerate(batches):
        parts[number] = _examine(question, batch, ticked)
        ticks_done = (number + 1) * ticks
        progress(ticks_done, ticks * len(batches))


def _in_processes(question: Validation, shards: int, parts: dict[int, Findings], progress: Progress) -> None:
    batches, alone = question.batches(), replace(question, threads=1)
    # A forked child would inherit locks of MuJoCo's threads and of the progress bar.
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(shards, mp_context=context, initializer=_as_worker)
    futures = dict[Future[Findings], int]()
    try:
        for number, batch in enumerate(batches):
            futures[pool.submit(_examine, alone, batch)] = number
        for future in as_completed(futures):
            parts[futures[future]] = future.result()
            progress(len(parts), len(batches))
    except BaseException:
        for future, number in futures.items():
            if future.done() and not future.cancelled() and not future.exception():
                parts[number] = future.result()
        for worker in set(multiprocessing.active_children()) - others:
            worker.terminate()  # Waiting for a batch could take half a minute.
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _as_worker() -> None:
    """Ignore Ctrl-C, which the parent process handles, and end this process when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        wait_for([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
