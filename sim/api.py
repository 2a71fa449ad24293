"""`from sim import simulate, validate`: what the commands sim.run and sim.validate do, for scripts. SI units."""

from __future__ import annotations

from controller.coupling import Coupling, NoCoupling
from design.result import COUPLING, Design, bare, number, of_kind, one_of, whole
from sim.crowds import ENGINES, Findings, Question
from sim.crowds import validate as examine_all
from sim.engines import INTEGRATORS, LEAPFROG
from sim.report import stability_part
from sim.run import ENGINES as ALONE
from sim.run import Progress, assemble
from sim.run import simulate as close_loop
from sim.scenario import InputError, Scenario, require_linear
from sim.stability import LEAST, MOST, check_substeps, default_substeps
from sim.switching import switching
from sim.trace import Result

MOST_HUMANS = 1_000_000
SCENARIO = 'a Scenario, as load("omega-pair") gives it'


def simulate(
    scenario: Scenario,
    coupling: Coupling | Design | None = None,
    engine: str = "mujoco",
    integrator: str = "RK4",
    substeps: int | None = None,
    seed: int = 0,
) -> Result:
    """The scenario's run, from rest, for `scenario.duration` seconds.

    `coupling` None is the loop without one; `engine` is "mujoco" or "exact" (the linear loop, no Coulomb friction);
    `substeps` MuJoCo steps per period, None for what the plant asks (4 or more); `seed` draws delays that vary.

    Returns a Result of N samples and m channels: t (N,) [s], x (N, m) and x_handle (N, m) [m], v_handle (N, m) [m/s],
    f (N, m) [N] (the devices feel -f) and `meta`, with the scenario's digest and `meta["stability"]`: growth rates
    [1/s] of the trace and of the exact loop, the verdict, ticks at the force limit (None under delays that vary).

    Raises ValueError (InputError where the scenario is at fault) for an engine, integrator or number of substeps that
    is not possible, TypeError for an argument of another type, SingularLoop where the algebraic loop of environment and
    coupling has no solution.
    """
    of_kind("scenario", scenario, Scenario, SCENARIO)
    alone, seed = _bare(coupling), whole("seed", seed, 0)
    one_of("engine", engine, ALONE)
    one_of("integrator", integrator, (*INTEGRATORS, LEAPFROG))
    if substeps is not None:
        substeps = whole("substeps", substeps, 1, MOST)
    assembly = assemble(scenario, alone)
    if scenario.switches:
        assembly, _ = switching(assembly, alone, seed, scenario.samples)
    warnings: list[str] = []
    if engine == "mujoco" and substeps is None:
        substeps = default_substeps(assembly, integrator)
    elif engine == "mujoco" and substeps is not None:
        warnings = check_substeps(assembly, integrator, substeps)
    record = close_loop(assembly, engine, integrator, substeps or LEAST)
    mujoco = engine == "mujoco"
    meta = {
        "scenario": scenario.name,
        "scenario_digest": scenario.digest,
        "engine": engine,
        "integrator": integrator if mujoco else None,
        "substeps": substeps if mujoco else None,
        "seed": seed,
        "stability": None if scenario.switches else stability_part(assembly, record),
        "remarks": warnings,
    }
    return Result.from_record(assembly, record, meta)


def validate(
    scenario: Scenario,
    coupling: Coupling | Design | None = None,
    humans: int = 1000,
    seed: int = 0,
    engine: str = "both",
    duration: float = 2.0,
    shards: int = 1,
    progress: Progress = lambda done, total: None,
) -> Findings:
    """Let `humans` random passive humans (one per device each time) hold the devices, without voluntary motion.

    They are drawn from `scenario.population`; number i depends on `seed` and i alone. `engine` is "exact", "mujoco" or
    "both"; `duration` [s] of the traces, 0 for none (then growth rates are those of the period maps alone); `shards`
    local processes (a script that asks for more than 1 needs `if __name__ == "__main__"`).

    Returns Findings, n = humans: `exact` and `mujoco` (n,) growth rates [1/s], positive where a human makes the loop
    unstable, `radius` (n,) of the exact loop, `frequency` (n,) [Hz], `disagreements` (n,) of the engines, and more.

    Raises InputError for walls or Coulomb friction (verdicts are of linear loops), ValueError for numbers out of range,
    TypeError for an argument of another type.
    """
    of_kind("scenario", scenario, Scenario, SCENARIO)
    alone = _bare(coupling)
    require_linear(scenario, "validate")
    humans, seed = whole("humans", humans, 1, MOST_HUMANS), whole("seed", seed, 0)
    shards = whole("shards", shards, 1)
    one_of("engine", engine, ENGINES)
    duration = number("duration", duration, "a number of seconds")
    if not (duration == 0 or duration >= 4 * scenario.T):
        raise InputError(f"duration is {duration:g}, allowed are 0 and {4 * scenario.T:g} s or more")
    links = getattr(scenario.population, "links", 1)  # of a user's own population there are none
    return examine_all(Question(scenario, alone, seed, humans, links, engine, duration), shards, progress)


def _bare(coupling: Coupling | Design | None) -> Coupling:
    return NoCoupling() if coupling is None else bare(coupling, f"{COUPLING}, or None for the loop without one")
