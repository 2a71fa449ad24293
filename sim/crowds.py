"""Many random passive humans on one loop: drawn, decided by both engines, in batches over processes or a cluster.

Human i depends on the seed and i alone, whoever draws it and with whom. Batches are always the same ones, so that the
merged result of shards and of a cluster is that of a single run, bit for bit (a cluster's workers need this package
and the same versions of NumPy, SciPy and MuJoCo): see sim.shards. MuJoCo decides by the map of its Runge-Kutta
integrator, which shares nothing with the exact engine but the model; its traces take the exponential one, at a fifth
of the cost.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from controller.coupling import Coupling
from controller.delay import Timing
from controller.law import Law
from controller.lti import Array
from controller.ranges import Member
from models.hold import hold
from models.human import Population
from models.scene import Crowd, HumanSets, Variants, variants
from sim.engines import EXPONENTIAL, LEAST, Engine, ExactEngine, MujocoBatchEngine, OneByOne
from sim.run import Simulation, assemble, engine_name, make_engine
from sim.scenario import Scenario
from sim.stability import (
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
from sim.step_choice import simulated_growth
from sim.switching import Switched, switched_crowd

ENGINES = ("exact", "mujoco", "both")
MIXED = 0  # as a number of links: half the humans are simple, half are networks of two links
_BATCH = 125  # humans that are decided together


# ---- random passive humans, each from its own seed


def draw(population: Population, channels: int, seed: int, index: int, links: int) -> Array:
    """Links of the humans with this index, one per channel: (channels, links, 3) as in Crowd.

    They depend on (seed, index) and the population only. `links` = MIXED tosses a coin between 1 and 2.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
    count = int(rng.integers(1, 3)) if links == MIXED else links
    low, high = np.log([population.mass, population.damping, population.stiffness]).T
    return np.exp(rng.uniform(low, high, size=(channels, count, 3)))


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
        bodies = np.stack([_draw_bodies(population, len(holds), seed, i) for i in group])
        yield np.array(group), Crowd(np.stack([drawn[i] for i in group]), holds, bodies)


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


def _draw_bodies(population: Population, persons: int, seed: int, index: int) -> Array:
    """Bodies of the persons with this index who hold several devices: (persons, 5) as in Crowd, from the same ranges.

    Drawn apart from the links, which are the same whether or not a person holds several devices.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    ranges = (population.mass, population.damping, population.stiffness, population.damping, population.stiffness)
    low, high = np.log(ranges).T
    return np.exp(rng.uniform(low, high, size=(persons, 5)))


# ---- what is asked, and what is found


@dataclass(frozen=True)
class Validation:
    """A loop, the humans that are to hold it, and how they are decided."""

    scenario: Scenario
    coupling: Coupling
    seed: int
    humans: int
    links: int
    engine: str | Callable[[Simulation], Engine]  # exact | mujoco | both, or what makes one of a user's own
    duration: float  # [s] of the traces; 0 for none
    threads: int = 0  # of MuJoCo; 0 for all
    environments: tuple[Member, ...] = ()  # that the humans are spread over; empty: all meet the scenario's own
    lag: tuple[float, ...] | None = None  # rho (m,) [N/m] of the limiter; None: forces are clipped

    @property
    def ticks(self) -> int:
        return round(self.duration / self.scenario.T)

    def batches(self) -> list[range]:
        """All indices, _BATCH of them at a time, all in one environment."""
        spread = max(1, len(self.environments))
        each = [range(i, self.humans, spread) for i in range(min(spread, self.humans))]
        return [indices[i : i + _BATCH] for indices in each for i in range(0, len(indices), _BATCH)]

    def environment(self, index: int) -> Member | None:
        """What the humans of this index meet, None for the scenario's own environment: each in turn."""
        return self.environments[index % len(self.environments)] if self.environments else None

    @property
    def digest(self) -> str:
        """A digest of everything that the findings depend on."""
        how = (
            self.coupling.form(),
            self.seed,
            self.humans,
            self.links,
            self.engine if isinstance(self.engine, str) else engine_name(self.engine),
            self.ticks,
            self.environments,
            self.lag,
        )
        return hashlib.sha256(f"{self.scenario.digest} {how!r}".encode()).hexdigest()[:16]

    def crowds(self, indices: Iterable[int]) -> Iterator[tuple[NDArray[np.intp], Crowd | HumanSets]]:
        """The humans of these indices, held together as the scenario's persons hold its devices.

        A user's own population draws from the same seeds, with the persons as they stand in the scenario.
        """
        scenario = self.scenario
        if not isinstance(scenario.population, Population):
            return _own_crowds(scenario, self.seed, indices)
        holds = tuple(person.holds for person in scenario.person)
        return crowds(scenario.population, scenario.channels, self.seed, indices, self.links, holds)

    def crowd(self, index: int) -> Crowd | HumanSets:
        """The one set of humans with this index."""
        ((_, crowd),) = self.crowds([index])
        return crowd


@dataclass(frozen=True, eq=False)
class Findings:
    """One entry per set of humans, sorted by index; nan where an engine or a trace was not asked for."""

    index: NDArray[np.intp]  # (n,)
    radius: Array  # (n,) spectral radius of the exact loop
    exact: Array  # (n,) [1/s] growth, exact loop
    frequency: Array  # (n,) [Hz] of that mode
    mujoco: Array  # (n,) [1/s] growth, the period map of MuJoCo, or of a user's own engine
    trace: Array  # (n,) [1/s] growth on its trace, or on the exact one where no other is asked
    clipped: NDArray[np.int64]  # (n,) ticks with a force at its limit, on that trace
    energy: Array  # (n,) [J] least W(N) on the exact trace
    audited: Array  # (n,) [J] magnitudes that W adds up
    settling: Array  # (n,) rms speed of the handles, last quarter over second quarter, exact trace
    contacts: NDArray[np.int64]  # (n,) how often a wall was touched on the exact trace
    mass: Array  # (n,) [kg] per set: geometric mean over channels of all mass
    damping: Array  # (n,) [N s/m] likewise of the least damping
    switching: Array  # (n,) [1/s] growth of the linear loop under delays or ticks that vary; nan where they do not
    switching_mujoco: Array  # (n,) [1/s] the same on MuJoCo's trace; nan also where that was clipped
    simulated: float  # [s] in all traces
    interrupted: bool = False
    lost: str = ""  # why batches are missing that nobody interrupted

    @property
    def disagreements(self) -> NDArray[np.bool_]:
        """(n,) whether MuJoCo, on its map or on a trace, contradicts the exact loop."""
        switching = disagree(self.switching, self.switching_mujoco)
        return disagree(self.exact, self.mujoco) | disagree(self.exact, self.trace) | switching


#: what Findings have one entry of for every set of humans
COLUMNS = tuple(f.name for f in fields(Findings) if f.name not in ("simulated", "interrupted", "lost"))


def _merge(parts: Sequence[Findings]) -> Findings:
    """The findings of the groups of a batch as one."""
    order = np.argsort(np.concatenate([p.index for p in parts]), kind="stable")
    joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts])[order] for name in COLUMNS}
    return Findings(**joined, simulated=math.fsum(p.simulated for p in parts))


# ---- one batch


@threadpool_limits.wrap(limits=1, user_api="blas")  # the same bits in every process, wherever it runs
def examine(
    validation: Validation, indices: Sequence[int], ticked: Callable[[int], None] = lambda ticks: None
) -> Findings:
    """Decide and simulate the humans of `indices`, who all meet the same environment.

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
    other: _Other | None = None
    if not isinstance(validation.engine, str):
        each = [simulation.held_by(crowd.humans(i), crowd.persons(i)) for i in range(len(crowd))]
        make = validation.engine
        mujoco = np.array([simulated_growth(one, None, None, make) for one in each])
        other = lambda integrator, timing: OneByOne([make_engine(one, make) for one in each])  # noqa: E731
    elif validation.engine != "exact":
        maps = (mujoco_loops(held_by, process, nthread=validation.threads, late=late) for process in frozen)
        mujoco = Mode.worst([dominant_mode(loop) for loop in maps]).growth
        other = partial(_batch, held_by, scenario.T, validation.threads)
    exact, last = _tests(validation, simulation, held_by, loops, other, ticked) if validation.ticks else (None, None)
    switched = Switched(nowhere, nowhere)
    if scenario.switches or scenario.uneven:
        also = partial(other, "RK4") if other and validation.ticks else None
        switched = switched_crowd(simulation, held_by, index, validation.seed, validation.duration, also)
    return Findings(
        index=index,
        radius=mode.spectral_radius,
        exact=mode.growth,
        frequency=mode.frequency_hz,
        mujoco=mujoco,
        trace=last.growth if last else nowhere,
        clipped=last.clipped if last else np.zeros(len(crowd), dtype=int),
        energy=exact.least_energy if exact else nowhere,
        audited=exact.audited if exact else nowhere,
        settling=exact.settling if exact else nowhere,
        contacts=exact.contacts if exact else np.zeros(len(crowd), dtype=int),
        mass=_geometric_mean(np.stack([port.mass.sum(axis=1) for port in crowd.ports], axis=1)),
        damping=_geometric_mean(np.stack([port.damping.min(axis=1) for port in crowd.ports], axis=1)),
        switching=switched.exact,
        switching_mujoco=switched.mujoco,
        simulated=sum(test.simulated for test in dict.fromkeys((exact, last)) if test),
    )


_Other = Callable[[str, Timing | None], Engine]  # MuJoCo's integrator, timing -> what is compared with the exact engine


def _batch(held_by: Variants, T: float, threads: int, integrator: str, timing: Timing | None) -> Engine:
    return MujocoBatchEngine(held_by, T, integrator, 1 if integrator == EXPONENTIAL else LEAST, threads, timing)


def _geometric_mean(values: Array) -> Array:
    """Over the channels, (n, channels) -> (n,); 0 where one of them is."""
    with np.errstate(divide="ignore"):
        return np.exp(np.log(values).mean(axis=1))


def _tests(
    validation: Validation,
    simulation: Simulation,
    held_by: Variants,
    loops: ClosedLoop,
    other: _Other | None,
    ticked: Callable[[int], None],
) -> tuple[ImpulseTest, ImpulseTest]:
    """The exact engine's impulse test, which costs next to nothing, and the other's, or again the first.

    In even periods, with forces that latch in the middle of their range: what their spread does is `switched_crowd`'s.
    """
    process, T = simulation.process, validation.scenario.T
    late = validation.scenario.usual_latency
    settings = held_by.scene, loops, Balance.of(held_by, simulation.loop, late), validation.ticks
    engine = ExactEngine(hold(held_by.plants(), T, late))
    exact = impulse_test(process, engine, *settings)
    if not other:
        return exact, exact
    timing = Timing(np.array([T]), np.array([late])) if late else None
    return exact, impulse_test(process, other(EXPONENTIAL, timing), *settings, ticked)
