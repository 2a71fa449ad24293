"""One batch of a validation: everything that is found out about a range of human indices."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from controller.box import Member
from controller.coupling import Coupling
from controller.lti import Array
from models.crowd import Crowd, Variants, variants
from sim.batch_engine import ExactBatchEngine
from sim.exact_engine import hold
from sim.knock import Trace, knock
from sim.mujoco_engine import MujocoBatchEngine
from sim.population import crowds_of
from sim.scenario import Scenario
from sim.simulate import Assembly, assemble
from sim.stability import ClosedLoop
from sim.switching.crowd import Switched, switched_crowd
from sim.verdicts import disagree, dominant_modes, exact_loops, mujoco_loops

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
    question: Question, assembly: Assembly, index: NDArray[np.intp], crowd: Crowd, ticked: Callable[[int], None]
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
        mass=np.exp(np.log(crowd.links[..., 0].sum(axis=2)).mean(axis=1)),
        damping=np.exp(np.log(crowd.links[..., 1].min(axis=2)).mean(axis=1)),
        switching=switched.exact,
        switching_mujoco=switched.mujoco,
        simulated=sum(t.simulated for _, t in traces),
    )


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
