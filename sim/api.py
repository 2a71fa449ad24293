"""The functions `simulate` and `validate`, which give scripts what the commands sim.run and sim.validate compute."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from haptic_loop.controller.arguments import number, of_kind, one_of, shown, whole
from haptic_loop.controller.arithmetic import one_blas_thread
from haptic_loop.controller.budget import START_J
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.lti import Array
from haptic_loop.design.files import plain
from haptic_loop.design.result import Chosen, Design
from haptic_loop.sim.accuracy import MOST, EngineChoice, compare_engines, pick, settle
from haptic_loop.sim.couplings import assessed, choose, given
from haptic_loop.sim.engines import INTEGRATORS, Engine
from haptic_loop.sim.passivity_layer import EnergyNet, Plugged, Wanted, claim, netted
from haptic_loop.sim.run import (
    ENGINES,
    AnyEngine,
    EngineSettings,
    Progress,
    Simulation,
    assemble,
    engine_name,
    make_engine,
    run,
)
from haptic_loop.sim.scenario import (
    InputError,
    Scenario,
    is_world,
    require_latch_at_ticks,
    require_linear,
    require_no_world,
)
from haptic_loop.sim.stability import stability_of
from haptic_loop.sim.switching import Period, switching
from haptic_loop.sim.trace import Trace

if TYPE_CHECKING:
    from haptic_loop.design.assessment import Assessment
    from haptic_loop.sim import crowds

_MOST_HUMANS = 1_000_000
_USUAL = EngineSettings()
_SCENARIO = 'a Scenario, as load("omega-pair") gives it'


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """The run of a scenario, with its settings."""

    simulation: Simulation  # the loop without a passivity layer
    ran: Simulation  # the loop that ran: `simulation` with its passivity layer, if there is one
    period: Period | None  # the worst switching of the delays; None unless the pattern of the delays is adversarial
    choices: tuple[EngineChoice, ...]  # the settings that `settings.error` compared, the cheapest first; otherwise ()
    settings: EngineSettings  # engine, integrator and steps, with defaults filled in
    remarks: list[str]  # remarks on integrator and substeps
    trace: Trace
    wall_s: float
    seed: int
    unsolved: int  # number of times that limited forces were set to 0 because no solution was found

    @cached_property
    def exact(self) -> Trace | None:
        """The exact engine's trace of the same loop; None for a loop with friction, which is not linear."""
        if self.settings.engine == "exact":
            return self.trace
        return None if self.simulation.friction else run(self.ran, "exact", ticks=self.trace.t.size)


def run_scenario(
    scenario: Scenario,
    coupling: Coupling,
    lag: tuple[float, ...] | None = None,
    settings: EngineSettings = _USUAL,
    seed: int = 0,
    net: Wanted | None = None,
    progress: Progress = lambda done, ticks: None,
) -> ScenarioRun:
    """Run the closed loop for the scenario's duration, as `sim.run` and `simulate` do.

    `lag` is rho (m,) [N/m] of the limiter of the forces, or None to clip them. `net` is the passivity layer between
    controller and devices, or None. Raises InputError for impossible settings.
    """
    simulation = assemble(scenario, coupling, lag, seed)
    period, choices, remarks = None, (), []
    if scenario.switches:
        simulation, period = switching(simulation, seed, scenario.samples)
    ran = simulation if net is None else netted(simulation, net)
    if settings.error is not None:
        choices = compare_engines(ran, settings.error, progress=progress)
        choice = pick(choices, settings.error)
        integrator, substeps = choice.integrator, choice.substeps
    else:
        integrator, substeps, remarks = settle(simulation, settings.engine, settings.integrator, settings.substeps)
    settled = EngineSettings(settings.engine, integrator, substeps)
    stepped = make_engine(simulation, settings.engine, integrator, substeps)
    begin, unsolved = time.perf_counter(), ran.process.law.unsolved
    trace = run(ran, stepped, progress=progress, may_end_early=True)
    wall, unsolved = time.perf_counter() - begin, ran.process.law.unsolved - unsolved
    return ScenarioRun(simulation, ran, period, choices, settled, remarks, trace, wall, seed, unsolved)


def _chosen(scenario: Scenario, coupling: Coupling | Design | str | Path | None) -> Chosen:
    """Return the coupling of a script's argument, with its proofs. Raises InputError for a file that does not fit."""
    if isinstance(coupling, str | Path) and Path(coupling).suffix == ".json":
        return choose(scenario, "I", str(coupling))
    return given(coupling)


@one_blas_thread
def simulate(
    scenario: Scenario,
    coupling: Coupling | Design | str | Path | None = None,
    engine: AnyEngine = "mujoco",
    integrator: str | None = None,
    substeps: int | None = None,
    seed: int = 0,
    environment: Callable[[Array], Array] | None = None,
    energy_budget: float | None = None,
    limiter: bool = True,
) -> Trace:
    """Run the scenario from rest for `scenario.duration` seconds.

    Args:
        scenario: The loop.
        coupling: None for the loop without a coupling, or a coupling, a design or the file "design.json" of a design.
        engine: "mujoco", "exact" (the linear loop, without Coulomb friction), your own engine (sim.engines.Engine), or
            a function that makes one from a sim.run.Simulation.
        integrator: An integrator of MuJoCo. None means "exponential", or "RK4" if a device has Coulomb friction.
        substeps: Steps per period. None means the default (sim.accuracy.default_substeps).
        seed: Seed of varying delays, periods and latencies.
        environment: A function that replaces the scenario's environment. Once a tick it receives the positions (m,)
            [m] that its port would have without a force, and returns the forces to feed back, (m,) [N]. An energy shell
            makes the function passive up to the energy `energy_budget`.
        energy_budget: W0 [J]. With `environment` or a MuJoCo scene it is the energy that the shell may give, in a scene
            beyond the energy that the scene releases (default 0, in a scene START_J). Otherwise it is the energy budget
            of the devices; None means that they have no budget.
        limiter: False to clip forces. If True, a limiter acts where the coupling's guarantee covers a limiter, and
            forces are clipped otherwise (`meta["assessment"]["force_limits"]`).

    Returns:
        A Trace of N samples and m channels: t (N,) [s], x (N, m) and x_handle (N, m) [m], v_handle (N, m) [m/s],
        f (N, m) [N] (the devices feel -f), and `meta`. `meta["stability"]` has the growth rates [1/s] of the trace and
        of the exact loop, the verdict, and the ticks at the force limit. It is None if delays switch, with
        `environment` and in a MuJoCo scene. `meta["assessment"]` states the guarantee of this run, or why there is
        none, and `meta["energy_budget"]` how often forces were limited (None without budget and shell).

    Raises:
        ValueError: The engine, the integrator or the number of substeps is impossible, or the scenario does not permit
            a setting (InputError).
        TypeError: An argument has the wrong type.
        SingularLoop: The algebraic loop of environment and coupling has no solution.
    """
    of_kind("scenario", scenario, Scenario, _SCENARIO)
    chosen, seed = _chosen(scenario, coupling), whole("seed", seed, 0)
    if isinstance(engine, str) or not (callable(engine) or hasattr(engine, "start")):
        one_of("engine", engine, ENGINES)
    if integrator is not None:
        one_of("integrator", integrator, tuple(INTEGRATORS))
    if substeps is not None:
        substeps = whole("substeps", substeps, 1, MOST)
    world = is_world(scenario)
    if environment is not None and not callable(environment):
        expected = "a function of one array: from positions (m,) [m] to forces (m,) [N]"
        raise TypeError(f"environment is {shown(environment)}, expected {expected}")
    if environment is not None and world:
        raise InputError("environment= with a scenario that has environment.world: remove one of them")
    if world and energy_budget is None:
        energy_budget = START_J
    if environment is not None or energy_budget is not None:
        require_latch_at_ticks(scenario)
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario  # only the nominal environment runs
    clipped = None if limiter else False
    assessment = assessed(
        alone, "I", chosen, environment=environment, energy_budget=energy_budget, limiter=clipped, seed=seed
    )
    settings, rho = EngineSettings(engine, integrator, substeps), assessment.force_limits.rho
    net = _net(environment, energy_budget, assessment, world)
    outcome = run_scenario(scenario, chosen.coupling, rho, settings, seed, net)
    trace = outcome.trace
    linear = not (scenario.switches or environment or is_world(scenario))
    meta = {
        "scenario": scenario.name,
        **({"unit": "rad"} if scenario.unit == "rad" else {}),
        "scenario_digest": scenario.digest,
        "engine": engine_name(engine),
        "integrator": outcome.settings.integrator,
        "substeps": outcome.settings.substeps,
        "seed": seed,
        "assessment": plain(assessment),
        "stability": plain(stability_of(outcome.simulation, trace)) if linear else None,
        "remarks": [*outcome.remarks, *([assessment.encoder.words] if assessment.encoder else [])],
        "energy_budget": plain(trace.net.figures()) if trace.net else None,
    }
    if world and trace.net:
        from haptic_loop.sim.world import Claim, InWorld, SceneRecord, WorldRecord

        assert isinstance(trace.net, InWorld)
        record, scene = WorldRecord.of(trace.net.figures()), SceneRecord.of(trace.net.ports[0].world)
        stated = Claim.of(assessment, chosen.certified_for, record)
        meta |= {"world": plain(record), "scene": plain(scene)}
        meta |= {"guarantee": stated.words, "guaranteed": stated.guaranteed}
    return replace(trace, meta=meta)


def _net(
    environment: Callable[[Array], Array] | None, energy_budget: float | None, assessment: Assessment, world: bool
) -> Wanted | None:
    """Return the passivity layer: the shell of a MuJoCo scene or of a function, the devices' budget, or None."""
    if world:
        from haptic_loop.sim.world import Touched  # Other scenarios start without these modules.

        return Touched(energy_budget or 0.0)
    if environment is not None:
        return Plugged(environment, energy_budget or 0.0, claim(assessment))
    return None if energy_budget is None else EnergyNet(energy_budget, guarantee=claim(assessment))


@one_blas_thread
def validate(
    scenario: Scenario,
    coupling: Coupling | Design | str | Path | None = None,
    humans: int = 1000,
    seed: int = 0,
    engine: str | Callable[[Simulation], Engine] = "both",
    duration: float = 2.0,
    shards: int = 1,
    progress: Progress = lambda done, total: None,
    limiter: bool = True,
    traces: str = "sampled",
) -> crowds.Findings:
    """Judge the loop with random passive humans who hold the devices without voluntary motion, one per device.

    Args:
        scenario: The loop. With walls, the verdict is for the set of touched walls with which the loop grows fastest.
        coupling: None for the loop without a coupling, or a coupling, a design or the file "design.json" of a design.
        humans: Number of sets of humans, drawn from `scenario.population`. Set i depends on the scenario, `seed` and i.
        seed: Seed of the draws.
        engine: "exact", "mujoco" or "both", or your own class (sim.engines.Engine). Your class makes one engine for
            each set of humans, and its results are compared with those of the exact engine.
        duration: Length [s] of the traces. With 0 there are no traces, but eigenvalues over one period and, under
            varying delays or ticks, `Findings.switching`.
        shards: Number of processes. A script with more than 1 needs `if __name__ == "__main__"`.
        progress: Called with (parts done, number of parts).
        limiter: False to clip forces.
        traces: The hands that MuJoCo, or your own engine, also simulates: "sampled" (those nearest to the stability
            limit, the lossless ones and 64 at random), or "all".

    Returns:
        Findings with n = humans, or fewer if batches are missing (`interrupted`, `lost`). `exact` and `mujoco` (n,) are
        growth rates [1/s], positive where a human makes the loop unstable; `disagreements` (n,) says whether the
        engines disagree. crowds.Findings lists the other fields.

    Raises:
        InputError: A device has Coulomb friction, or the environment is a MuJoCo scene. Verdicts need linear loops.
        ValueError: A number is out of range.
        TypeError: An argument has the wrong type.
    """
    from haptic_loop.sim import crowds  # loads multiprocessing

    of_kind("scenario", scenario, Scenario, _SCENARIO)
    chosen = _chosen(scenario, coupling)
    require_no_world(scenario, "validate")
    require_linear(scenario, "validate", walls=True)
    humans, seed = whole("humans", humans, 1, _MOST_HUMANS), whole("seed", seed, 0)
    shards = whole("shards", shards, 1)
    one_of("traces", traces, ("sampled", "all"))
    if not callable(engine):
        one_of("engine", engine, crowds.ENGINES)
    duration = number("duration", duration, "a number of seconds")
    if not (duration == 0 or duration >= 4 * scenario.T):
        raise InputError(f"duration is {duration:g}, allowed are 0 and {4 * scenario.T:g} s or more")
    links = getattr(scenario.population, "links", 1)  # A user's own population has no `links`.
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario
    lag = assessed(alone, "I", chosen, limiter=None if limiter else False).force_limits.rho
    work = (humans, links, engine, duration)
    question = crowds.Validation(scenario, chosen.coupling, seed, *work, lag=lag, all_traces=traces == "all")
    return crowds.validate(question, shards, progress)
