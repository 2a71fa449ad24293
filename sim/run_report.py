"""What a run came to: the figures of its report, and what a reader must know to read them rightly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from controller.lti import Array
from design.files import unseen
from design.guarantees import ANY, CAVEATS, MAKING
from design.result import listed
from design.transparency import transparency
from sim import accuracy
from sim.alternatives import Alternative
from sim.api import ScenarioRun
from sim.couplings import Chosen
from sim.judged import Judged
from sim.passivity_layer import idle
from sim.report import (
    PaperRow,
    beside_the_paper,
    delays_part,
    encoder_steps,
    switched_stability,
    timing_part,
    transparency_part,
)
from sim.run import beginnings, engine_name
from sim.scenario import Scenario
from sim.stability import Stability, stability_of


@dataclass(frozen=True, kw_only=True)
class Ran:
    """How the loop was run."""

    engine: str
    integrator: str | None
    substeps: int | None
    duration_s: float
    samples: int
    wall_s: float
    real_time_factor: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    lam: tuple[int, ...]
    T_s: float
    timing: dict[str, Any] | None
    seed: int
    engines: tuple[accuracy.EngineChoice, ...] | None  # compared for --error
    cross_check: accuracy.CrossCheck | None
    interrupted: bool
    scenario_digest: str
    encoder_step_m: Array
    steady_ticks: list[list[int]]
    environment: str


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """The result of a run; parts that it does not have are null."""

    case: str
    scenario: str
    certificate: dict[str, Any]
    judged: Judged = unseen("beside")
    encoder: dict[str, Any] | None
    transparency: dict[str, Any]
    stability: Stability
    varying_delay: dict[str, Any] | None
    run: Ran
    error: accuracy.PositionError
    credible: accuracy.Credible
    ideal_force: accuracy.ForceError
    energy_budget: dict[str, Any] | None
    baseline: dict[str, Any] | None
    robustness: dict[str, Any] = unseen("beside")
    alternatives: list[Alternative]
    reproducibility: tuple[PaperRow, ...]
    remarks: tuple[str, ...]

    @property
    def switched(self) -> bool:
        """Whether the delays switch, so that no eigenvalue says whether the loop grows."""
        return "verdict" in (self.varying_delay or {})

    def notes(self) -> list[str]:
        """What a reader must know to read the figures rightly."""
        lines, promise = [], self.judged.promise
        certificates = {name: self.judged.certificates[name] for name in ("any-environment", "this-environment")}
        name = "any-environment" if self.certificate["condition"] == "any-environment" else "this-environment"
        part = certificates[name]
        if not part["certified"] and "reason" not in part:
            worst = max(n / a for n, a in zip(part["required_damping"], part["available_damping"], strict=True))
            condition = f"the {name} condition" + (" (the paper's Theorem 4)" if name == "any-environment" else "")
            what = "The loop without" if self.judged.coupling["kind"] == "none" else "This"
            needs = f"it needs {worst:.3g} times the damping that the devices guarantee"
            lines.append(f"{what} coupling fails {condition}: {needs}.")
        if contact := self.stability.contact:
            covered = {ANY: "any-environment", MAKING: "this-environment"}.get(promise or "", "no certificate")
            softer = f", and any walls with K + 2 B/T up to {listed(contact.slopes_n_per_m)} N/m"
            softer = softer if promise == MAKING else ""
            lines.append(f"Contact that makes and breaks: {covered} covers it in this loop{softer}.")
        reasons = {
            "stability": self.stability.reason,
            "error": self.error.reason,
            "transparency": self.transparency.get("reason"),
            "credible": self.credible.reason,
            **{name: part.get("reason") for name, part in certificates.items()},
        }
        lines += [f"{name}: {reason}." for name, reason in reasons.items() if reason]
        if self.varying_delay:
            lines.append(f"Delays that vary: {self.varying_delay['covers']}.")
        if self.encoder:
            lines.append(f"{self.encoder['words'][0].upper()}{self.encoder['words'][1:]}.")
        return [*lines, CAVEATS]


def run_report(
    scenario: Scenario,
    case: str,
    chosen: Chosen,
    judged: Judged,
    run: ScenarioRun,
    environment: str,
    others: list[Alternative],
    robustness: dict[str, Any],
    *,
    seed: int,
    band_hz: tuple[float, float],
    check: bool,
) -> RunReport:
    """The report of a run; `check` runs another integrator beside it."""
    simulation, trace, loop = run.simulation, run.trace, scenario.loop(case)
    covered = any(requirement.certified for requirement in judged.requirements.values())
    delays, grows = delays_part(simulation, chosen, run.period, trace.t.size, covered), None
    if delays and simulation.scenario.switches:
        stability = switched_stability(simulation, trace, delays)
        grows = stability.verdict == "unstable"
    else:
        stability = stability_of(simulation, trace)
    net = trace.net.part() if trace.net else None
    budget, any_environment = net if net and net["guarantee"] else None, judged.requirements["any-environment"]
    felt = transparency(simulation.felt, simulation.E, loop.lam, band_hz)
    found = RunReport(
        case=case,
        scenario=scenario.name,
        certificate=judged.certificates[chosen.condition],
        judged=judged,
        encoder=encoder_steps(scenario, case, chosen.coupling),
        transparency=transparency_part(felt),
        stability=stability,
        varying_delay=delays,
        run=_ran(run, loop.lam, environment, seed, check),
        error=accuracy.position_error(trace, run.exact, simulation, grows),
        credible=accuracy.credible(simulation, trace),
        ideal_force=accuracy.force_error(run.ran, trace, loop.lam),
        energy_budget=budget and budget | {"idle": idle(simulation, any_environment, budget)},
        baseline=None if budget else net,
        robustness=robustness,
        alternatives=others,
        reproducibility=beside_the_paper(simulation.scenario, case, stability, judged.coupling),
        remarks=(*run.remarks, *chosen.notes),
    )
    return replace(found, remarks=(*found.remarks, *found.notes()))


def _ran(run: ScenarioRun, lam: tuple[int, ...], environment: str, seed: int, check: bool) -> Ran:
    simulation, trace, steps = run.simulation, run.trace, (run.engine, run.integrator, run.substeps)
    scenario, process, samples = simulation.scenario, simulation.process, trace.t.size
    duration = float(beginnings(scenario.T, simulation.timing, samples, 1)[0])
    return Ran(
        engine=engine_name(run.engine),
        integrator=run.integrator,
        substeps=run.substeps,
        duration_s=duration,
        samples=samples,
        wall_s=run.wall_s,
        real_time_factor=duration / run.wall_s,
        theta=scenario.theta,
        psi=scenario.psi,
        lam=lam,
        T_s=scenario.T,
        timing=timing_part(simulation.timing, scenario),
        seed=seed,
        engines=run.choices or None,
        cross_check=accuracy.cross_check(run.ran, trace, *steps) if check else None,
        interrupted=trace.interrupted,
        scenario_digest=scenario.digest,
        encoder_step_m=process.encoder_step,
        steady_ticks=[[0, trace.ticks_before_clipping(process.force_limit)]],
        environment=environment,
    )
