"""The report of a run, and parts that it shares with other reports. Figures are in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np

from haptic_loop.controller.budget import BudgetFigures
from haptic_loop.controller.coupling import PUBLISHED, Coupling
from haptic_loop.controller.delay import LOST, Timing, VaryingDelay, ages
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Array
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import named, requirements_of
from haptic_loop.design.coverage import Robustness
from haptic_loop.design.files import off_table
from haptic_loop.design.result import ANY, MAKING, Chosen, finite, listed
from haptic_loop.models.device import Device
from haptic_loop.sim import accuracy
from haptic_loop.sim.passivity_layer import idle
from haptic_loop.sim.run import Simulation, beginnings, engine_name
from haptic_loop.sim.scenario import Scenario, load
from haptic_loop.sim.stability import (
    UNDECIDED,
    Ringing,
    Stability,
    close,
    dominant_mode,
    eigenvalues,
    linear_growth,
    ringing,
    stability_of,
    verdict,
    verdict_within,
)
from haptic_loop.sim.switching import DelaysCovered, Period
from haptic_loop.sim.trace import Trace

if TYPE_CHECKING:
    from haptic_loop.sim.api import ScenarioRun


def friction_left_out(devices: Sequence[Device]) -> list[str]:
    """Return a remark for each device whose friction has a published upper bound only."""
    return [
        f"Friction of device #{i}: at most {device.friction_max:g} N (published); no simulation or proof uses it."
        for i, device in enumerate(devices, start=1)
        if device.friction_max is not None and not np.any(device.friction)
    ]


#: Transparency indices (equation 25) [dB] that the paper prints. None of our readings of its Figure 4 gives them.
_PRINTED_TAU_DB = {"I": -4.15, "II": -3.09}


@dataclass(frozen=True)
class PaperRow:
    """A number of the paper, its value computed here, and the reason why they differ."""

    what: str
    paper: str
    here: str
    why: str


def is_papers(scenario: Scenario, case: str) -> bool:
    """Return whether the loop is one of the paper's."""
    return not scenario.varying_delay and scenario.loop(case) == load().loop(case)


def beside_the_paper(scenario: Scenario, case: str, stability: Stability, coupling: Coupling) -> tuple[PaperRow, ...]:
    """Return a row for each number that the paper prints for this case of its loop (`is_papers`)."""
    figure = _figure(case, stability)
    return (figure,) if case == "none" else (*_printed_gains(scenario, case, coupling), _tau(case), figure)


def _printed_gains(scenario: Scenario, case: str, coupling: Coupling) -> tuple[PaperRow, ...]:
    printed, gains_here = PUBLISHED[case], coupling.figures(scenario.T)
    need = requirements_of(scenario.loop(case), printed)
    any_environment, this_environment = (need[name].required for name in ("any-environment", "this-environment"))
    gains = PaperRow(
        "gains [N/m], [N s/m]",
        f"K = {listed(printed.K, 5)}, B = {listed(printed.B, 5)}",
        f"K = {listed(gains_here['K'], 5)}, B = {listed(gains_here['B'], 5)}" if "K" in gains_here else "none",
        "the printed gains are no solution of the paper's own problem (next row)",
    )
    damping = PaperRow(
        "damping that the printed gains need [N s/m]",
        f"at most {listed(scenario.delta, 5)}",
        f"{listed(any_environment, 5)} by Theorem 4; {listed(this_environment, 5)} in this environment",
        "Theorem 4 as printed is strictly infeasible (E-hat has a pole at z = 1); corrected, it refuses these gains",
    )
    return gains, damping


def _tau(case: str) -> PaperRow:
    why = "inf sigma_min(E) = 0: moving both contacts together takes no static force"
    return PaperRow("transparency index tau (25)", f"{_PRINTED_TAU_DB[case]} dB", "infinite", why)


def _figure(case: str, stability: Stability) -> PaperRow:
    agrees = "agrees" if stability.exact_verdict == ("unstable" if case == "none" else "stable") else "does not agree"
    growth = f"{stability.exact_growth_rate_per_s:+.2f} 1/s at {stability.exact_frequency_hz:.1f} Hz"
    here = f"{stability.exact_verdict}: {growth}"
    if case != "none":
        why = f"{agrees}; masses and stiffness of the devices are assumed"
        return PaperRow("Figure 6: with a coupling", "no oscillation", here, why)
    why = f"{agrees}; masses and transmission of the devices are assumed: the paper's own first-order device is "
    why += "stable with each of 200 pairs of hands"
    return PaperRow("Figure 5: no coupling", "self-sustained oscillation", here, why)


@dataclass(frozen=True)
class DelaySpan:
    """The range of delays [samples] and the pattern within it."""

    lo: tuple[int, ...]
    hi: tuple[int, ...]
    pattern: str
    loss: float  # probability that a packet is lost
    playout: bool  # whether a buffer in the device keeps the delay constant at hi
    constant: bool  # whether the delay is theta at every tick

    @classmethod
    def of(cls, varying: VaryingDelay) -> DelaySpan:
        return cls(varying.lo, varying.hi, varying.pattern, varying.loss, varying.playout, varying.steady)


@dataclass(frozen=True)
class _Age:
    """Ages [samples] of the forces that each device applies, from the tick at which every channel has a force."""

    least: list[int]
    largest: list[int]
    mean: list[float]


@dataclass(frozen=True)
class _PeriodGrowth:
    """Growth of the linear loop over one period of the worst switching of delays that the search found."""

    ticks: int
    growth_rate_per_s: float
    spectral_radius: float
    verdict: str


@dataclass(frozen=True)
class _DelaysMet:
    """The delays that occurred in a run, and the growth of its linear loop under them."""

    age: _Age | None  # None if some channel receives no force
    lost_packets: list[int]  # (m,) number of lost packets
    held_ticks: list[int]  # (m,) number of ticks in which no newer force arrived
    growth_rate_per_s: float
    verdict: str | None  # None if the rate is too small for the trace's duration
    judged_s: float  # duration of the trace that gave the growth
    period: _PeriodGrowth | None

    @classmethod
    def of(cls, switched: Simulation, period: Period | None, ticks: int) -> _DelaysMet:
        delays = switched.process.delays
        assert delays is not None
        met = ages(delays[:ticks])[..., 0]
        used = met[(met >= 0).all(axis=1)]
        growth, window = linear_growth(switched, max(4, ticks))
        ends = (used.min(axis=0), used.max(axis=0), used.mean(axis=0)) if used.size else ()
        worst = period and (len(period.ages), period.growth, period.spectral_radius, verdict(period.growth))
        return cls(
            _Age(*(values.tolist() for values in ends)) if ends else None,
            (delays[:ticks] == LOST).sum(axis=(0, 2)).tolist(),
            (np.diff(used, axis=0) == 1).sum(axis=0).tolist(),
            growth,
            verdict_within(growth, window),
            window,
            _PeriodGrowth(*worst) if worst else None,
        )

    @property
    def worst(self) -> _DelaysMet | _PeriodGrowth:
        """The record whose growth decides: that of the worst switching if a search was made, else that of the run."""
        return self.period or self

    @property
    def how(self) -> str:
        """The method that gave the growth of `worst`, in words."""
        if self.period:
            return f"growth by the eigenvalues of the map over one period of {self.period.ticks} ticks"
        return f"growth of the linear loop after an impulse, over {self.judged_s:.3g} s under the run's delays"


@dataclass(frozen=True)
class VaryingDelays:
    """Figures of varying delays; `met` is None unless the delays switch."""

    span: DelaySpan = off_table("inlined")
    met: _DelaysMet | None = off_table("inlined")
    certified: DelaysCovered = off_table("inlined")

    @classmethod
    def of(
        cls,
        simulation: Simulation,
        assessment: Assessment,
        on_file: DelayRange | None,
        period: Period | None,
        ticks: int,
    ) -> Self:
        scenario = simulation.scenario
        assert scenario.varying_delay is not None
        met = _DelaysMet.of(simulation, period, ticks) if scenario.switches else None
        return cls(DelaySpan.of(scenario.varying_delay), met, DelaysCovered.of(scenario, assessment, on_file))


@dataclass(frozen=True)
class _Periods:
    """Lengths of ticks [s]."""

    least: float
    mean: float
    largest: float


@dataclass(frozen=True)
class UnevenTicks:
    """The periods of a run, and the latencies of its forces."""

    period_s: _Periods
    recorded: bool  # whether the periods repeat a recorded list; otherwise they are random or constant
    T_max_s: float | None  # the longest period that certificates must cover; None if every period is T
    latency_s: tuple[tuple[float, float], ...] | None  # (least, most) of each channel; None: forces latch at ticks

    @classmethod
    def of(cls, timing: Timing, scenario: Scenario) -> UnevenTicks:
        period, recorded = timing.period, bool(scenario.period and scenario.period.recorded)
        lengths = _Periods(float(period.min()), float(period.mean()), float(period.max()))
        return cls(lengths, recorded, scenario.longest_period, scenario.latency)


def _switched_stability(simulation: Simulation, trace: Trace, delays: VaryingDelays) -> Stability:
    """Return the verdict on a run whose delays switch, so that eigenvalues of a single tick decide nothing."""
    met = delays.met
    assert met is not None
    constant = eigenvalues(dominant_mode(close(simulation.plant, simulation.F)))
    grows = trace.diverged or "unstable" in (met.worst.verdict, met.verdict)
    decided = "unstable" if grows else met.worst.verdict
    theta = listed(simulation.scenario.theta)
    return Stability(
        **vars(constant),
        verdict=decided,
        clipped_ticks=int(trace.clipped(simulation.process.force_limit, simulation.process.balls).sum()),
        growth_rate_per_s=finite(met.worst.growth_rate_per_s),
        frequency_hz=trace.dominant_frequency_hz(),
        reason=f"{met.how}; the eigenvalues are those of the constant delay theta = {theta}"
        + ("" if decided else f"; {UNDECIDED}"),
    )


# ---- the whole report of a run


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
    steady_ticks: list[list[int]]  # one pair [first, stop]: the ticks before the first clipped force
    environment: str  # name of the environment that ran
    unsolved: int  # number of times that limited forces were set to 0 because no solution was found


@dataclass(frozen=True, eq=False, kw_only=True)
class RunReport:
    """The result of a run. In JSON a missing part is null."""

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
        """Whether `ideal_force` compares the forces that the devices received instead of forces before clipping."""
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
            # With a nonzero mismatch the reason is about the index tau, which only the JSON has.
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
        stability = _switched_stability(simulation, trace, delays)
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
