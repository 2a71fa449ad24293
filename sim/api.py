"""`from sim import simulate, validate`: what the commands sim.run and sim.validate do, for scripts. SI units."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.lti import Array
from haptic_loop.design.arguments import number, of_kind, one_of, shown, whole
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
from haptic_loop.sim.scenario import InputError, Scenario, is_world, require_linear, require_no_world
from haptic_loop.sim.stability import stability_of
from haptic_loop.sim.switching import Period, switching
from haptic_loop.sim.trace import Trace
from haptic_loop.sim.world import START_J, Claim, InWorld, SceneRecord, Touched, WorldRecord

if TYPE_CHECKING:
    from haptic_loop.sim import crowds

_MOST_HUMANS = 1_000_000
_USUAL = EngineSettings()
_SCENARIO = 'a Scenario, as load("omega-pair") gives it'


@dataclass(frozen=True, eq=False)
class ScenarioRun:
    """A scenario's run, with what it was run by."""

    simulation: Simulation
    ran: Simulation  # the same, with the net that was asked for
    period: Period | None  # of the worst switching found, where the delays switch
    choices: tuple[EngineChoice, ...]  # what was compared for the error that was asked, the cheapest first
    settings: EngineSettings  # as they were settled
    remarks: list[str]  # on a number of substeps that was asked for
    trace: Trace
    wall_s: float
    seed: int
    unsolved: int  # vectors of forces for which a tick's limiter found no solution

    @cached_property
    def exact(self) -> Trace | None:
        """The exact engine's trace of the same loop; None where friction makes it another one than the linear."""
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
    """Close the loop for the scenario's duration: what `sim.run` and `simulate` have in common.

    With `lag`, rho (m,) [N/m], forces leave through a limiter; `net` stands between the forces and the devices. Raises
    InputError for settings that cannot be.
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
    trace = run(ran, stepped, progress=progress)
    wall, unsolved = time.perf_counter() - begin, ran.process.law.unsolved - unsolved
    return ScenarioRun(simulation, ran, period, choices, settled, remarks, trace, wall, seed, unsolved)


def _chosen(scenario: Scenario, coupling: Coupling | Design | str | Path | None) -> Chosen:
    """Return the coupling of a script's argument, with its proofs. Raises InputError for a file that does not fit."""
    if isinstance(coupling, str | Path) and Path(coupling).suffix == ".json":
        return choose(scenario, "I", str(coupling))
    return given(coupling)


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

    `coupling` None is the loop without one, "design.json" the file of a design; `engine` is "mujoco", "exact" (the
    linear loop, no Coulomb friction) or of your own (sim.engines.Engine), as it is or as what makes it of a
    sim.run.Simulation; `integrator` of MuJoCo, None for "exponential", or "RK4" where a device has Coulomb friction;
    `substeps` steps per period, None for what the plant asks; `seed` draws delays, periods and latencies that vary.
    Forces leave through the limiter that the coupling's guarantee covers, where there is one; elsewhere, and with
    `limiter` False, they are clipped (`meta["assessment"]["force_limits"]`).

    `environment` takes the place of the scenario's: anything that answers, once a tick, where its port would be if it
    gave no force, (m,) [m], with a force fed back (m,) [N]. A shell makes it passive, which may give `energy_budget`
    [J] (default 0) in all; the loop is safe then behind a coupling that is certified for any environment, with
    psi = 0. Without `environment`, `energy_budget` is that of the devices. `meta["energy_budget"]` says how often
    forces were limited, and `meta["assessment"]` what is guaranteed of this run, or why nothing is.

    Returns a Trace of N samples and m channels: t (N,) [s], x (N, m) and x_handle (N, m) [m], v_handle (N, m) [m/s],
    f (N, m) [N] (the devices feel -f) and `meta`, with the scenario's digest and `meta["stability"]`: growth rates
    [1/s] of the trace and of the exact loop, the verdict, ticks at the force limit (None under delays that vary).

    Raises ValueError (InputError where the scenario is at fault) for an engine, integrator or number of substeps that
    is not possible, TypeError for an argument of another type, SingularLoop where the algebraic loop of environment and
    coupling has no solution.
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
        raise InputError("environment= with a scenario that has environment.world: give one of them")
    if world and energy_budget is None:
        energy_budget = START_J
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario  # only the nominal environment runs
    clipped = None if limiter else False
    assessment = assessed(
        alone, "I", chosen, environment=environment, energy_budget=energy_budget, limiter=clipped, seed=seed
    )
    net: Wanted | None = None
    if world:
        net = Touched(energy_budget or 0.0)
    elif environment is not None:
        net = Plugged(environment, energy_budget or 0.0, claim(assessment))
    elif energy_budget is not None:
        net = EnergyNet(energy_budget, guarantee=claim(assessment))
    settings, rho = EngineSettings(engine, integrator, substeps), assessment.force_limits.rho
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
        "remarks": outcome.remarks,
        "energy_budget": plain(trace.net.figures()) if trace.net else None,
    }
    if isinstance(trace.net, InWorld):
        said, scene = Claim.of(assessment, chosen.certified_for), SceneRecord.of(trace.net.ports[0].world)
        meta |= {"world": plain(WorldRecord.of(trace.net.figures())), "scene": plain(scene)}
        meta |= {"guarantee": said.words, "guaranteed": said.guaranteed}
    return replace(trace, meta=meta)


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
    """Let `humans` random passive humans (one per device each time) hold the devices, without voluntary motion.

    They are drawn from `scenario.population`; number i depends on `seed` and i alone. `engine` is "exact", "mujoco" or
    "both", or a class of your own (sim.engines.Engine), of which one is made for each set of humans and compared with
    the exact one; `duration` [s] of the traces, 0 for none (then growth rates are those of the period maps alone);
    `shards` local processes (a script that asks for more than 1 needs `if __name__ == "__main__"`); `progress` is
    called with the parts done and all of them; `limiter` as of `simulate`; `traces` of the other engine than the exact
    one: "sampled" (the hands nearest to the limit, the lossless ones and 64 at random), or "all".

    Returns Findings, n = humans: `exact` and `mujoco` (n,) growth rates [1/s], positive where a human makes the loop
    unstable, `radius` (n,) of the exact loop, `frequency` (n,) [Hz], `disagreements` (n,) of the engines, and more.

    Walls: a verdict is that of the worst frozen contact state, and the traces make and break contact.

    Raises InputError for Coulomb friction (verdicts are of linear loops), ValueError for numbers out of range,
    TypeError for an argument of another type.
    """
    from haptic_loop.sim import crowds  # its workers are loaded where they are used
    from haptic_loop.sim.crowds import validate as validate_all

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
    links = getattr(scenario.population, "links", 1)  # of a user's own population there are none
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario
    lag = assessed(alone, "I", chosen, limiter=None if limiter else False).force_limits.rho
    work = (humans, links, engine, duration)
    question = crowds.Validation(scenario, chosen.coupling, seed, *work, lag=lag, all_traces=traces == "all")
    return validate_all(question, shards, progress)
