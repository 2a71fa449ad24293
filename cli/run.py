"""python -m sim.run: close the loop once, and report stability, transparency and error with a picture."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from haptic_loop.cli import options, render
from haptic_loop.cli import verdict as verdicts
from haptic_loop.cli.painter import Painter
from haptic_loop.cli.verdict import assessment_of, chosen_by
from haptic_loop.controller.environment import GROUND
from haptic_loop.controller.loop import Loop
from haptic_loop.design.certificate import named
from haptic_loop.design.forked import Forked
from haptic_loop.design.result import CAVEATS, Chosen, finite
from haptic_loop.sim import accuracy
from haptic_loop.sim.accuracy import MOST
from haptic_loop.sim.couplings import NAMES
from haptic_loop.sim.engines import INTEGRATORS
from haptic_loop.sim.run import ENGINES, EngineSettings
from haptic_loop.sim.scenario import InputError, Scenario, is_world, require_latch_at_ticks
from haptic_loop.sim.shown import Contacts, Onset

if TYPE_CHECKING:
    from haptic_loop.controller.budget import BudgetFigures
    from haptic_loop.design.assessment import Assessment
    from haptic_loop.design.coverage import Robustness
    from haptic_loop.sim.api import ScenarioRun
    from haptic_loop.sim.report import Ran, RunReport
    from haptic_loop.sim.stability import ExactVerdict


def main(argv: list[str]) -> int:
    """Simulate and report. Return 0 for a completed run, stable or not, and 130 for an interrupted run."""
    args = _parser().parse_args(argv)
    if args.error is not None and (args.engine != "mujoco" or args.integrator or args.substeps):
        raise InputError(
            "--error chooses MuJoCo's integrator and substeps: leave out --engine exact, --integrator and --substeps"
        )
    scenario, out, painter = _scenario(args), options.out_folder(args, "run"), Painter(not args.no_plot)
    if is_world(scenario):
        from haptic_loop.cli import world

        return world.run(args, scenario, out, painter)
    environment, simulated = _environment(args, scenario)
    if args.paper:
        _require_papers(args, simulated)
    chosen = chosen_by(args, scenario)  # the coupling with its proofs
    budget = args.energy_budget[0] if args.energy_budget else None
    assessment = assessment_of(args, scenario, chosen, environment=simulated.environment, energy_budget=budget)
    render.announce(args, verdicts.verdict(assessment))
    nearby = _nearby(scenario.loop(args.case).at(simulated.environment), chosen, assessment)
    from haptic_loop.sim.report import beside_the_paper, run_report
    from haptic_loop.sim.view.drawn_object import scene_xml

    run = _run(args, simulated, assessment)  # each tick: sample, compute, limit, hold, advance
    report = run_report(scenario, args.case, chosen, assessment, run, environment, args.cross_check)
    drawn = bool(run.trace.t.size) and not args.no_plot
    if drawn:
        painter.ask("draw_run", *_shown(args, run, report))
    with render.progress("working out robustness"):
        report = replace(report, robustness=nearby and nearby.result())
    if lost := verdicts.lost(assessment, report.robustness):
        render.announce(args, lost)
    if args.paper:
        report = replace(report, paper=beside_the_paper(simulated, args.case, report.stability, assessment.coupling))
    tables, left_out = _tables(scenario, report)
    render.show(args, tables, [*report.remarks, *left_out], _details(report))
    with render.progress("storing the trace and drawing the picture"):
        files = render.save_run(out, run.trace, report, {"scene.xml": scene_xml(run.simulation)})
        if drawn:
            files.append(painter.save(out / "figure.png"))
    render.publish(args, report, (), folder=out, files=files)
    return options.exit_code(True, run.trace.interrupted)


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.run",
        "Close the loop once and report stability, transparency and error.",
        "python -m sim.run --coupling none",
        "python -m sim.run --scenario three-rigid --condition any-environment --duration 5",
        first="scenario coupling condition reference duration json",
    )
    add = parser.add_argument
    parser.add_loop()
    parser.add_varying_delays()
    parser.add_coupling(", ".join(NAMES))
    parser.add_energy_budget()
    add("--engine", choices=ENGINES, default="mujoco", help="engine of the simulation (default mujoco)")
    steppers = "integrator of MuJoCo (default exponential, RK4 with friction)"
    add("--integrator", choices=tuple(INTEGRATORS), help=steppers)
    steps = "MuJoCo steps per period (default: 1 with exponential without friction, else enough for the fastest motion)"
    add("--substeps", type=options.whole(1, MOST), metavar="N", help=steps)
    add("--duration", type=options.number(), metavar="SECONDS", help="simulated time (default: the scenario's)")
    error = "try integrators and steps, and run with the cheapest whose positions have a relative rms error up to E"
    add("--error", type=options.number(1e-18, 1.0), metavar="E", help=error)
    check = "repeat the run with RK4, which uses other formulas (with exponential, if RK4 ran), and compare"
    add("--cross-check", action="store_true", help=check)
    parser.add_human()
    parser.add_band()
    parser.add_limiter()
    vertex = "simulate at this vertex of the scenario's ranges (default 0: nominal)"
    add("--vertex", type=options.whole(), default=0, metavar="N", help=vertex)
    parser.add_details()
    parser.add_output(picture=True)
    parser.only("with MuJoCo: leave out --engine exact", lambda args: args.engine != "exact", "integrator", "substeps")
    add("--paper", action="store_true", help="also print the figures of the paper beside those of this run")
    return parser


def _scenario(args: argparse.Namespace) -> Scenario:
    """Return the scenario with the delays, duration and humans of the options. Raises InputError."""
    scenario = options.with_varying_delays(args, options.scenario_from(args))
    if args.duration is not None:
        scenario = scenario.replace(duration=args.duration)
    if args.energy_budget or is_world(scenario):
        require_latch_at_ticks(scenario)
    return options.with_humans(args, scenario)


def _environment(args: argparse.Namespace, scenario: Scenario) -> tuple[str, Scenario]:
    """Return the name of the environment at --vertex, and the scenario with it. Raises InputError."""
    members = scenario.loop(args.case).members()
    if not 0 <= args.vertex < len(members):
        why = f"allowed are 0 to {len(members) - 1}" if scenario.ranges else "but the scenario has no ranges ([ranges])"
        raise InputError(f"--vertex is {args.vertex}, {why}")
    return members[args.vertex].name, scenario.replace(environment=members[args.vertex].network, ranges=None)


# ---- the run and its figures


def _require_papers(args: argparse.Namespace, scenario: Scenario) -> None:
    from haptic_loop.sim.report import is_papers

    if not is_papers(scenario, args.case):
        raise InputError("--paper: the paper prints figures of its own loop only; leave out options that change it")


def _run(args: argparse.Namespace, scenario: Scenario, assessment: Assessment) -> ScenarioRun:
    from haptic_loop.sim.api import run_scenario
    from haptic_loop.sim.passivity_layer import EnergyNet, claim

    net = EnergyNet(*args.energy_budget, guarantee=claim(assessment)) if args.energy_budget else None
    settings = EngineSettings(args.engine, args.integrator, args.substeps, args.error)
    coupling, rho = assessment.coupling, assessment.force_limits.rho
    with render.progress("simulating") as move:
        return run_scenario(scenario, coupling, rho, settings, args.seed, net, move)


def _nearby(loop: Loop, chosen: Chosen, assessment: Assessment) -> Forked[Robustness | None] | None:
    """Begin to compute the damping needed in environments near the model, and return this computation.

    Return None if no guarantee depends on the model.
    """
    from haptic_loop.design.coverage import robustness_nearby

    guarantee = assessment.guarantee
    if guarantee is None or guarantee.energy_J is not None or guarantee.any_environment:
        return None
    return Forked(robustness_nearby, loop, chosen.coupling, named(chosen.required_condition))


def _shown(args: argparse.Namespace, run: ScenarioRun, report: RunReport) -> tuple[Any, ...]:
    """Return the arguments of `sim.plots.draw_run`."""
    stability, apart = report.stability, report.ideal_force.error_percent
    ideal = None if apart is None else (report.ideal_force.ideal, apart)
    grows = stability.exact_verdict == "unstable" and run.exact is not None and not report.switched
    growth = stability.exact_growth_rate_per_s if grows else None
    onset = Onset(growth, report.run.steady_ticks[0][1], report.credible.until_s)
    around = Contacts(run.simulation.scenario.environment.contacts, *_walls(run))
    title = _title(run.simulation.scenario.title(args.case), report)
    return run.trace.signals, title, stability.exact_frequency_hz, ideal, onset, around


def _walls(run: ScenarioRun) -> tuple[list[tuple[int, float, str]], Any]:
    """Return (channel, place [m], name) of each wall from a contact to ground, and a mask (N,) of ticks in contact."""
    law, network = run.simulation.process.law, run.simulation.scenario.environment
    if not network.walls:
        return [], None
    walls = []
    for number, wall in enumerate(network.walls, start=1):
        (first, second), sign = wall.between, 1.0
        if first == GROUND:
            (first, second), sign = (second, first), -1.0
        if second == GROUND and first in network.contacts:
            name = f"wall {number}, {1e3 * wall.gap:g} mm from {first} at rest"
            walls.append((network.contacts.index(first), sign * wall.gap, name))
    return walls, (law.depths(run.trace.z) > 0).any(axis=1)


def _title(what: str, report: RunReport) -> str:
    stability, kind = report.stability, report.kind
    coupling = "no virtual coupling" if kind == "none" else f"{kind} coupling"
    guarantee = report.assessment.guarantee
    if kind != "none" and guarantee and guarantee.energy_J is None:
        coupling += f" for {report.assessment.guarantee_words}"
    rate, hertz = stability.exact_growth_rate_per_s, stability.exact_frequency_hz
    growth = f"grows by {rate:.3f} 1/s at {hertz:.1f} Hz" if rate > 0 else f"slowest motion decays by {-rate:.3f} 1/s"
    if report.varying_delay and report.switched:
        growth = f"{report.varying_delay.span.pattern} delays, {stability.verdict}"
    return f"{what.removesuffix(', no coupling').removesuffix(', case none')}, {coupling}: {growth}"


# ---- the report as tables


#: rows that are left out of long tables, the least important first
_LESS = (
    "damping, any switching",
    "slowest mode",
    "ranges, inside",
    "age of the forces",
    "simulated in",
    "ranges, worst vertex",
    "rendered stiffness",
    "ticks",
    "worst switching found",
    "ranges, between",
    "varying delay",
)


def _tables(scenario: Scenario, report: RunReport) -> tuple[list[Any], list[str]]:
    """Return the tables, and lines on the rows that are left out of the first table."""
    title = f"{scenario.title(report.case)}: coupling {report.kind}"
    rows, left_out = render.shortened([render.channel_row(scenario.environment.contacts), *_rows(report)], _LESS)
    shown = [render.facts(title, rows)]
    if report.run.engines:
        shown.append(_speed_against_error(report.run, report.run.engines))
    if report.paper:
        cells = {"": "{r.what}", "paper": "{r.paper}", "here": "{r.here}", "why": "{r.why}"}
        shown.append(render.columns("beside the paper", cells, report.paper, range(4)))
    return shown, left_out


def _rows(report: RunReport) -> render.Rows:
    stability, run, assessment = report.stability, report.run, report.assessment
    felt = assessment.transparency
    ratio = felt and finite(felt.dc_ratio)
    how = "switching" if report.switched else "simulated trace"
    if run.timing and "impulse" in (stability.reason or ""):
        how = "uneven ticks"
    measured = render.optional(stability.growth_rate_per_s, "{:+.4f} 1/s")
    yield from verdicts.gain_rows(assessment)
    yield from verdicts.rows(assessment)
    yield "transparency error", felt and render.transparency_error(felt)
    yield from render.robustness_rows(report.robustness)
    apart = render.optional(report.ideal_force.error_percent, "{:.3g} % rms of the ideal force", "")
    before = ", before clipping" if stability.clipped_ticks and not report.compares_sent_forces else ""
    yield "force error", f"{apart}{before}" if apart else f"- ({report.ideal_force.reason})"
    yield "rendered stiffness", f"{100 * ratio:.1f} %" if ratio else "-"
    yield from _net_rows(report.energy_budget)
    yield "growth, eigenvalues", _growth(stability)
    yield f"growth, {how}", f"{measured}: {render.verdict(stability.verdict)}"
    yield "slowest mode", report.ringing and report.ringing.words
    yield render.timing_row(run.timing)
    yield from render.delay_rows(report.varying_delay) if report.varying_delay else ()
    if contact := stability.contact:
        yield "contact", f"made {contact.made} times, lasting {contact.ticks} of {run.samples} ticks"
        for state in contact.frozen:
            name = f"wall{'s' * (len(state.touching) > 1)} {', '.join(map(str, state.touching))}"
            yield f"growth, {name if state.touching else 'no wall'} touching", _growth(state)
    yield "simulated in", run.environment if assessment.ranges else None
    yield "limited ticks", f"{stability.clipped_ticks} of {run.samples}"
    lost = f"[red]{run.unsolved} forces were set to 0[/], which no proof covers: the limiter found no solution"
    yield "unsolved limits", lost if run.unsolved else None
    yield "cross-check", run.cross_check and _crossed(run.cross_check)


def _details(report: RunReport) -> list[str]:
    """Return the lines of --details."""
    size = render.optional(report.error.position_max_m, "{:.1e} m at most")
    error = render.optional(report.error.position_relative_rms, "{:.1e} relative rms, " + size)
    return [f"speed: {_speed(report.run)}", f"position error: {error}", CAVEATS]


def _speed(run: Ran) -> str:
    engine = run.engine + (f" {run.integrator} x {run.substeps}" if run.integrator else "")
    pace = float(f"{run.real_time_factor:.2g}")
    return f"{run.wall_s:.2f} s for {run.duration_s:g} s: {pace:g} x real time ({engine})"


def _speed_against_error(run: Ran, engines: Sequence[accuracy.EngineChoice]) -> Any:
    cells: dict[str, Any] = {
        "engine x steps": lambda r: r.name + " *" * ((r.integrator, r.substeps) == (run.integrator, run.substeps)),
        "position error": lambda r: render.optional(finite(r.position_relative_rms), "{:.1e}"),
        "verdict": lambda r: "right" if r.verdict_correct else "[red]WRONG[/]",
        "CPU s": "{r.cpu_s:.3f}",
        "x real time": lambda r: f"{run.duration_s / r.cpu_s:.0f}" if r.cpu_s else "-",  # below the clock's resolution
    }
    title = "speed against error on this scene (*: this run, the cheapest within --error)"
    return render.columns(title, cells, engines)


def _crossed(other: accuracy.CrossCheck) -> str:
    apart = render.optional(finite(other.position_relative_rms), "{:.1e} relative rms apart")
    growth = f"its growth rate differs by {other.growth_rate_difference_per_s:+.1e} 1/s"
    verdict = "[green]same verdict[/]" if other.agrees else "[red]ANOTHER VERDICT[/]"
    return f"{other.integrator} x {other.substeps}: {apart}, {growth}: {verdict}"


def _net_rows(budget: BudgetFigures | None) -> render.Rows:
    if budget:
        why = f" ({budget.idle})" if budget.idle else ""
        yield "energy budget", f"limited {budget.limited_ticks} of {budget.ticks} ticks{why}"
        yield "", budget.guarantee


def _growth(loop: ExactVerdict) -> str:
    exact = f"{loop.exact_growth_rate_per_s:+.4f} 1/s at {loop.exact_frequency_hz:.2f} Hz"
    return f"{exact}: {render.verdict(loop.exact_verdict)}"
