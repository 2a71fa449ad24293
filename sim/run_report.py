"""The report of a run: its figures, and remarks that explain them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from haptic_loop.controller.budget import BudgetFigures
from haptic_loop.controller.lti import Array
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import named
from haptic_loop.design.coverage import Robustness
from haptic_loop.design.files import off_table
from haptic_loop.design.result import ANY, MAKING, Chosen
from haptic_loop.sim import accuracy
from haptic_loop.sim.api import ScenarioRun
from haptic_loop.sim.passivity_layer import idle
from haptic_loop.sim.report import (
    PaperRow,
    UnevenTicks,
    VaryingDelays,
    friction_left_out,
    switched_stability,
)
from haptic_loop.sim.run import beginnings, engine_name
from haptic_loop.sim.scenario import Scenario
from haptic_loop.sim.stability import Ringing, Stability, ringing, stability_of


@dataclass(frozen=True, kw_only=True)
class Ran:
    """The settings of a run, and its cost."""

    engine: str
    integrator: str | None
    substeps: int | None
    duration_s: float
    samples: int
    wall_s: float
    real_time_factor: float  # simulated time over wall time
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    lam: tuple[int, ...]
    T_s: float
    timing: UnevenTicks | None
    seed: int
    engines: tuple[accuracy.EngineChoice, ...] | None  # the settings that --error compared
    cross_check: accuracy.CrossCheck | None
    interrupted: bool
    scenario_digest: str
    encoder_step_m: Array
    steady_ticks: list[list[int]]  # [first, stop] of the ticks before the first clipped one
    environment: str  # name of the environment that ran
    unsolved: int  # number of times that limited forces were set to 0 because no solution was found


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """The result of a run; missing parts are null."""

    case: str
    scenario: str
    kind: str  # kind of the coupling
    chosen: Chosen = off_table("left out")
    assessment: Assessment
    stability: Stability
    ringing: Ringing | None
    varying_delay: VaryingDelays | None = off_table()
    run: Ran
    error: accuracy.PositionError
    credible: accuracy.Credible
    ideal_force: accuracy.ForceError
    energy_budget: BudgetFigures | None
    robustness: Robustness | None = off_table(default=None)
    paper: tuple[PaperRow, ...] | None = off_table("if given", None)  # the paper's numbers, and those computed here
    remarks: tuple[str, ...]

    @property
    def switched(self) -> bool:
        """Whether the delays switch, so that no eigenvalue decides stability."""
        return bool(self.varying_delay and self.varying_delay.met)

    @property
    def compares_sent_forces(self) -> bool:
        """Whether `ideal_force` compares forces as the devices received them, not forces before clipping."""
        return self.switched or self.energy_budget is not None or self.assessment.force_limits.rho is not None

    def notes(self) -> list[str]:
        """Return remarks that explain the figures."""
        lines, guarantee = [], self.assessment.guarantee
        certificates, part = self.assessment.requirements, self.assessment.decisive
        transparency, where = self.assessment.transparency, guarantee and guarantee.environments
        if not part.certified and not part.reason:
            source = named(self.chosen.required_condition).source
            condition = f"the {part.condition} condition" + (f" ({source})" if source else "")
            subject = "The loop without" if self.kind == "none" else "This"
            needs = f"it needs {part.ratio:.3g} times the damping that the devices guarantee"
            lines.append(f"{subject} coupling fails {condition}: {needs}.")
        if self.stability.contact:
            covered = guarantee.condition if guarantee and where in (ANY, MAKING) else "no certificate"
            softer = ", at any gap, and every wall that is softer in stiffness and damping alike"
            softer = softer if where == MAKING else ""
            lines.append(f"Contact that makes and breaks: {covered} covers it in this loop{softer}.")
        reasons = {
            "stability": self.stability.reason,
            "error": self.error.reason,
            # Any other reason explains tau, which only the JSON shows.
            "transparency": transparency and transparency.relative_mismatch == 0 and transparency.reason,
            "credible": self.credible.reason,
            **{name: part.reason for name, part in certificates.items()},
        }
        lines += [f"{name}: {reason}." for name, reason in reasons.items() if reason]
        if self.varying_delay:
            lines.append(f"Delays that vary: {self.varying_delay.certified.covers}.")
        if encoder := self.assessment.encoder:
            lines.append(f"{encoder.words[0].upper()}{encoder.words[1:]}.")
        return lines


def run_report(
    scenario: Scenario,
    case: str,
    chosen: Chosen,
    assessment: Assessment,
    run: ScenarioRun,
    environment: str,
    check: bool,
) -> RunReport:
    """Return the report of a run in the named environment; `check` repeats the run with another integrator."""
    simulation, trace, loop, requirements = run.simulation, run.trace, scenario.loop(case), assessment.requirements
    delays, grows = None, None
    if simulation.scenario.varying_delay:
        delays = VaryingDelays.of(simulation, assessment, chosen.switching, run.period, trace.t.size)
    if delays and delays.met:
        stability = switched_stability(simulation, trace, delays)
        grows = stability.verdict == "unstable"
    else:
        stability = stability_of(simulation, trace)
    net = trace.net.figures() if trace.net else None
    budget = net if isinstance(net, BudgetFigures) else None
    report = RunReport(
        case=case,
        scenario=scenario.name,
        kind=chosen.kind,
        chosen=chosen,
        assessment=assessment,
        stability=stability,
        ringing=None if grows is not None else ringing(simulation),
        varying_delay=delays,
        run=_ran(run, loop.lam, environment, check),
        error=accuracy.position_error(trace, run.exact, simulation, grows),
        credible=accuracy.credible(simulation, trace),
        ideal_force=accuracy.force_error(run.ran, trace, loop.lam),
        energy_budget=budget and replace(budget, idle=idle(simulation, requirements, budget)),
        remarks=(*run.remarks, *chosen.remarks(requirements), *friction_left_out(scenario.device)),
    )
    return replace(report, remarks=(*report.remarks, *report.notes()))


def _ran(run: ScenarioRun, lam: tuple[int, ...], environment: str, check: bool) -> Ran:
    simulation, trace, settings = run.simulation, run.trace, run.settings
    scenario, process, samples = simulation.scenario, simulation.process, trace.t.size
    duration = float(beginnings(scenario.T, simulation.timing, samples, 1)[0])
    return Ran(
        engine=engine_name(settings.engine),
        integrator=settings.integrator,
        substeps=settings.substeps,
        duration_s=duration,
        samples=samples,
        wall_s=run.wall_s,
        real_time_factor=duration / run.wall_s,
        theta=scenario.theta,
        psi=scenario.psi,
        lam=lam,
        T_s=scenario.T,
        timing=simulation.timing and UnevenTicks.of(simulation.timing, scenario),
        seed=run.seed,
        engines=run.choices or None,
        cross_check=accuracy.cross_check(run.ran, trace, settings) if check else None,
        interrupted=trace.interrupted,
        scenario_digest=scenario.digest,
        encoder_step_m=process.encoder_step,
        steady_ticks=[[0, trace.ticks_before_clipping(process.force_limit, process.balls)]],
        environment=environment,
        unsolved=run.unsolved,
    )
