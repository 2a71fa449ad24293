"""python -m sim.run: close the loop once and say what happened, with figures and a picture."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cli import options, render
from controller.environment import GROUND
from controller.loop import Loop
from design.certificate import RangesCheck, assess, check_ranges
from design.coverage import ranges_part, ranges_rows
from design.files import write
from design.guarantees import ANY, guarantee_of
from design.result import listed
from design.robustness import robustness_parts
from design.transparency import BAND_HZ, transparency
from sim import report
from sim.accuracy import ForceError, credible_part, force_error, position_error
from sim.alternatives import Alternative, alternatives
from sim.couplings import NAMES, Chosen, choose, limits_of
from sim.engine_choice import EngineChoice, compare_engines, cross_check, pick
from sim.engines import INTEGRATORS, default_integrator
from sim.nets import BASELINES, Classic, EnergyNet, idle, netted
from sim.run import ENGINES, Simulation, assemble, beginnings, make_engine, run
from sim.scenario import InputError, Scenario
from sim.stability import MARGINAL, stability_part
from sim.stepping import MOST, check_substeps, default_substeps
from sim.switching import Period, switching
from sim.trace import Trace


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    if args.error is not None and (args.engine == "exact" or args.integrator or args.substeps):
        raise InputError("--error chooses integrator and substeps of MuJoCo: give no --engine exact, --integrator, ..")
    scenario, out = _scenario(args), options.out_folder(args, "run")
    loop = scenario.loop(args.case)
    environment, simulated = _environment(args, scenario)
    chosen = _chosen(args, scenario)
    with render.progress("searching the ranges" if loop.ranges else "judging the coupling") as move:
        whole = check_ranges(loop, chosen.coupling, args.seed, progress=move)
        requirements = assess(simulated.loop(args.case), chosen.coupling, chosen.phi)
        limits = limits_of(simulated, chosen, requirements, args.limiter)
    done = _run(args, simulated, chosen, limits.rho)
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": report.coupling_part(chosen.kind, chosen.coupling, scenario.T),
        **_certified(chosen, requirements, done.loop(args.case), whole),
        "encoder": report.encoder_steps(scenario, args.case, chosen.coupling),
        "transparency": report.transparency_part(
            transparency(done.simulation.felt, done.simulation.E, loop.lam, args.band_hz or BAND_HZ)
        ),
        **_stability(chosen, done, any(requirement.certified for requirement in requirements.values())),
        "run": _settings(args, done, loop.lam) | {"environment": environment},
        "limiter": limits.part([device.force_limit for device in simulated.device]),
    }
    outcome["error"] = position_error(done.trace, done.exact, done.simulation, _unstable(outcome))
    outcome["reproducibility"] = report.beside_the_paper(done.simulation.scenario, args.case, outcome)
    outcome["credible"] = credible_part(done.simulation, done.trace)
    alike = force_error(done.ran, done.trace, loop.lam)
    outcome["ideal_force"] = alike.part()
    outcome |= _net(done, requirements)
    outcome |= _robustness(chosen, loop, outcome)
    others = _alternatives(args, scenario, done)
    outcome["alternatives"] = [other.part() for other in others]
    outcome["remarks"] = [*done.warnings, *chosen.notes, *report.remarks(outcome)]
    files = _save(args, out, done, alike, outcome)
    if args.side_by_side:
        files.append(_side_by_side(others, out / "couplings.png", scenario.environment.contacts))
    render.publish(args, outcome, _tables(scenario, outcome, others), outcome["remarks"], out, files)
    return options.INTERRUPTED if done.trace.interrupted else options.DONE


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    options.add_loop_options(parser)
    options.add_varying_delay_options(parser)
    options.add_coupling_options(parser, f"{', '.join(NAMES)}, as baselines {', '.join(BASELINES)}")
    options.add_energy_budget_option(parser)
    parser.add_argument("--engine", choices=ENGINES, default="mujoco", help="MuJoCo, or the exact solution")
    steppers = "of MuJoCo (default exponential, RK4 where devices rub)"
    parser.add_argument("--integrator", choices=tuple(INTEGRATORS), help=steppers)
    steps = "MuJoCo steps per period (default: what the plant asks)"
    parser.add_argument("--substeps", type=options.whole(1, MOST), metavar="N", help=steps)
    parser.add_argument("--duration", type=options.number(), metavar="SECONDS", help="default: the scenario's")
    asked = (
        "relative rms of the positions: compare engines and steps on this scene, run with the cheapest that keeps it"
    )
    parser.add_argument("--error", type=options.number(1e-18, 1.0), metavar="E", help=asked)
    check = "run RK4 beside the exponential engine, with which it shares no matrix"
    parser.add_argument("--cross-check", action="store_true", help=check)
    options.add_human_option(parser)
    options.add_band_option(parser)
    options.add_limiter_option(parser)
    vertex = "simulate at this vertex of the scenario's ranges (default 0: nominal)"
    parser.add_argument("--vertex", type=options.whole(), default=0, metavar="N", help=vertex)
    options.add_output_options(parser, picture=True)
    beside = parser.add_argument_group("the same devices and hands with other couplings")
    beside.add_argument("--no-alternatives", action="store_true", help="no table of them, which takes a second or two")
    beside.add_argument("--side-by-side", action="store_true", help="draw their forces, too, as couplings.png")
    return parser


def _chosen(args: argparse.Namespace, scenario: Scenario) -> Chosen:
    """The coupling; with a baseline there is none, and the note says whose that is. Raises InputError."""
    if args.coupling not in BASELINES:
        with render.designing(scenario.loop(args.case), args.coupling, args.condition) as heard:
            return choose(scenario, args.case, args.coupling, args.condition, args.limiter, heard)
    if args.energy_budget:
        raise InputError(f"--energy-budget with --coupling {args.coupling}: give one of them")
    note = f"baseline, without a guarantee here: {BASELINES[args.coupling]}; no coupling besides."
    return replace(choose(scenario, args.case, "none", args.condition), kind=args.coupling, notes=(note,))


def _scenario(args: argparse.Namespace) -> Scenario:
    """The scenario with the delays, the duration and the humans that the options give. Raises InputError."""
    scenario = options.with_varying_delays(args, options.scenario_from(args))
    if args.duration is not None:
        scenario = scenario.replace(duration=args.duration)
    return options.with_humans(args, scenario)


def _environment(args: argparse.Namespace, scenario: Scenario) -> tuple[str, Scenario]:
    """Which environment is simulated, and the scenario with that one, known exactly. Raises InputError."""
    members = scenario.loop(args.case).members()
    if not 0 <= args.vertex < len(members):
        why = f"allowed are 0 to {len(members) - 1}" if scenario.ranges else "but the scenario has no ranges ([ranges])"
        raise InputError(f"--vertex is {args.vertex}, {why}")
    return members[args.vertex].name, scenario.replace(environment=members[args.vertex].network, ranges=None)


# ----------------------------------------------------------------------------------------------------
# The run and what it came to.


@dataclass(frozen=True, eq=False)
class _Run:
    """One run of a scenario, and the exact engine's beside it."""

    simulation: Simulation
    ran: Simulation  # the same, with the net that was asked for
    period: Period | None  # of the worst switching found, where the delays switch
    integrator: str | None  # None for the exact engine, and so are the substeps
    substeps: int | None
    choices: tuple[EngineChoice, ...]  # what --error compared, the cheapest first
    warnings: list[str]
    trace: Trace
    exact: Trace | None  # None where friction makes the loop another one than the linear
    wall_s: float

    def loop(self, case: str) -> Loop:
        """What was simulated, as a design knows it."""
        return self.simulation.scenario.loop(case)


def _run(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, lag: tuple[float, ...] | None) -> _Run:
    """Close the loop. Raises InputError for settings that cannot be."""
    simulation, period = assemble(scenario, chosen.coupling, lag, args.seed), None
    for name in ("integrator", "substeps"):
        if args.engine == "exact" and getattr(args, name) is not None:
            raise InputError(f"--{name} with --engine exact: it takes no steps; leave it out")
    if args.engine == "exact" and simulation.friction:
        raise InputError("--engine exact is linear and has no Coulomb friction, the devices have; use --engine mujoco")
    if scenario.switches:
        simulation, period = switching(simulation, chosen.coupling, args.seed, scenario.samples)
    choices = _compared(args, simulation)
    integrator, substeps, warnings = _steps(args, simulation)
    if choices:
        kept = pick(choices, args.error)
        integrator, substeps = kept.integrator, kept.substeps
    engine, ran = make_engine(simulation, args.engine, integrator, substeps), simulation
    if args.coupling in BASELINES:
        ran = netted(simulation, chosen.coupling, Classic(args.coupling))
    elif args.energy_budget:
        ran = _budgeted(simulation, chosen, *args.energy_budget)
    with render.progress("simulating") as move:
        begin = time.perf_counter()
        trace = run(ran, engine, progress=move)
        wall = time.perf_counter() - begin
    exact = trace
    if args.engine != "exact":
        exact = None if simulation.friction else run(ran, "exact", ticks=trace.t.size)
    return _Run(simulation, ran, period, integrator, substeps, choices, warnings, trace, exact, wall)


def _budgeted(simulation: Simulation, chosen: Chosen, start: float, cap: float) -> Simulation:
    try:
        return netted(simulation, chosen.coupling, EnergyNet(start, cap))
    except ValueError as error:
        raise InputError(f"--energy-budget: {error}") from None


def _net(run: _Run, requirements: dict[str, Any]) -> dict[str, Any]:
    """What the net under the controller did; the part is null where there is none."""
    part = run.trace.net.part() if run.trace.net else None
    if part is None or part["guarantee"] is None:
        return {"energy_budget": None, "baseline": part}
    return {
        "energy_budget": part | {"idle": idle(run.simulation, requirements["any-environment"], part)},
        "baseline": None,
    }


def _steps(args: argparse.Namespace, simulation: Simulation) -> tuple[str | None, int | None, list[str]]:
    """Integrator and substeps of this run, with remarks on a number that was asked for."""
    if args.engine == "exact":
        return None, None, []
    integrator = args.integrator or default_integrator(simulation.scene)
    try:
        if args.substeps is None:
            return integrator, default_substeps(simulation, integrator), []
        return integrator, args.substeps, check_substeps(simulation, integrator, args.substeps)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"--integrator {integrator}: {error}") from None


def _compared(args: argparse.Namespace, simulation: Simulation) -> tuple[EngineChoice, ...]:
    """Every engine and step on this scene, where an error is asked for. Raises InputError."""
    if args.error is None:
        return ()
    with render.progress("comparing engines"):
        return compare_engines(simulation, args.error)


def _alternatives(args: argparse.Namespace, scenario: Scenario, run: _Run) -> list[Alternative]:
    """What other couplings come to in the scenario's own environment. Raises InputError for a picture of nothing."""
    skipped = args.no_alternatives or run.trace.interrupted or args.vertex > 0
    with render.progress("other couplings") as move:
        made = [] if skipped else alternatives(scenario, args.case, move)
    if args.side_by_side and not any(other.trace is not None for other in made):
        raise InputError("--side-by-side is for runs without walls, friction, varying delays and --no-alternatives")
    return made


def _side_by_side(others: list[Alternative], path: Path, names: tuple[str, ...]) -> Path:
    from sim.plots import Panel, plot_side_by_side

    shown = [other for other in others if other.trace is not None and other.kind != "published"]
    panels = []
    for other in shown:
        assert other.trace is not None
        assert other.ideal is not None
        panels.append(Panel(_panel_title(other), other.trace, other.ideal, other.until_s))
    return plot_side_by_side(panels, path, names)


def _panel_title(other: Alternative) -> str:
    kind = ", spring-damper" if other.kind == "spring-damper" else ""
    guarantee = f"guarantee: {other.guarantee}" if other.guarantee else "no guarantee"
    felt = f"grows: {render.optional(other.growth, '{:+.2f} 1/s')}"
    if other.error_percent is not None:
        felt = f"force error {other.error_percent:.2g} %"
    return f"{'no coupling' if other.kind == 'none' else other.name + kind}\n{felt}; {guarantee}"


def _certified(chosen: Chosen, requirements: dict[str, Any], loop: Loop, whole: RangesCheck | None) -> dict[str, Any]:
    certificates = report.certificates_part(requirements)
    return {
        "certificate": certificates[chosen.condition],
        "certificates": certificates,
        "promise": guarantee_of(requirements, loop, bool(whole and whole.proved)),
        "ranges": whole and ranges_part(whole),
    }


def _robustness(chosen: Chosen, loop: Loop, outcome: dict[str, Any]) -> dict[str, Any]:
    """What a wrong model of the environment costs a guarantee for this environment alone."""
    alone = chosen.condition == "this-environment" and outcome["certificate"]["certified"]
    if not alone or outcome["promise"] == ANY:
        return {"robustness": None, "designed_for_it": None}
    with render.progress("working out robustness and its price"):
        return robustness_parts(loop, chosen.coupling)


def _stability(chosen: Chosen, run: _Run, certified: bool) -> dict[str, Any]:
    delays = report.delays_part(run.simulation, chosen, run.period, run.trace.t.size, certified)
    if delays and run.simulation.scenario.switches:
        stability = report.switched_stability_part(run.simulation, run.trace, delays)
    else:
        stability = stability_part(run.simulation, run.trace)
    return {"stability": stability, "varying_delay": delays}


def _unstable(outcome: dict[str, Any]) -> bool | None:
    """Whether switching makes the loop grow; None where the eigenvalues say whether it does."""
    switched = "verdict" in (outcome["varying_delay"] or {})
    return outcome["stability"]["verdict"] == "unstable" if switched else None


def _settings(args: argparse.Namespace, run: _Run, lam: tuple[int, ...]) -> dict[str, Any]:
    scenario, process, samples = run.simulation.scenario, run.simulation.process, run.trace.t.size
    duration = float(beginnings(scenario.T, run.simulation.timing, samples, 1)[0])
    return {
        "engine": args.engine,
        "integrator": run.integrator,
        "substeps": run.substeps,
        "duration_s": duration,
        "samples": samples,
        "wall_s": run.wall_s,
        "real_time_factor": duration / run.wall_s,
        "theta": list(scenario.theta),
        "psi": list(scenario.psi),
        "lam": list(lam),
        "T_s": scenario.T,
        "timing": report.timing_part(run.simulation.timing, scenario),
        "seed": args.seed,
        "engines": [choice.part() for choice in run.choices] or None,
        "cross_check": cross_check(run.ran, run.trace, run.integrator, run.substeps) if args.cross_check else None,
        "interrupted": run.trace.interrupted,
        "scenario_digest": scenario.digest,
        "encoder_step_m": process.encoder_step.tolist(),
        "steady_ticks": [[0, run.trace.ticks_before_clipping(process.force_limit)]],
    }


def _save(args: argparse.Namespace, out: Path, run: _Run, alike: ForceError, outcome: dict[str, Any]) -> list[Path]:
    result = replace(run.trace, meta=outcome)
    files = [result.save_npz(out / "trace.npz"), result.save_csv(out / "trace.csv")]
    files.append(write(out / "scene.xml", run.simulation.scene.xml))
    if not args.no_plot and result.t.size:
        from sim.plots import Onset, Surroundings, plot_run

        apart, hertz = outcome["ideal_force"]["error_percent"], outcome["stability"]["exact_frequency_hz"]
        ideal = None if apart is None else (alike.ideal, apart)
        grows = outcome["stability"]["exact_verdict"] == "unstable" and run.exact is not None
        growth = outcome["stability"]["exact_growth_rate_per_s"] if grows and _unstable(outcome) is None else None
        onset = Onset(growth, outcome["run"]["steady_ticks"][0][1], outcome["credible"]["until_s"])
        around = Surroundings(run.simulation.scenario.environment.contacts, *_walls(run))
        title = _title(run.simulation.scenario.title(args.case), outcome)
        files.append(plot_run(result, out / "figure.png", title, hertz, ideal, onset, around))
    return files


def _walls(run: _Run) -> tuple[list[tuple[int, float, str]], Any]:
    """Walls between a contact and ground, (channel, place, name), and in which ticks any wall was touched, (N,)."""
    contact, network = run.simulation.process.contact, run.simulation.scenario.environment
    if not network.walls or contact is None:
        return [], None
    found = []
    for number, wall in enumerate(network.walls, start=1):
        (first, second), sign = wall.between, 1.0
        if first == GROUND:
            (first, second), sign = (second, first), -1.0
        if second == GROUND and first in network.contacts:
            name = f"wall {number}, {1e3 * wall.gap:g} mm from {first} at rest"
            found.append((network.contacts.index(first), sign * wall.gap, name))
    return found, (contact.depths(run.trace.z)[:, : len(network.walls)] > 0).any(axis=1)


def _title(what: str, outcome: dict[str, Any]) -> str:
    """Of the picture."""
    stability, kind = outcome["stability"], outcome["coupling"]["kind"]
    coupling = "no virtual coupling" if kind == "none" else f"{kind} coupling"
    if kind != "none" and outcome["promise"]:
        coupling += f" for {outcome['promise']}"
    rate, hertz = stability["exact_growth_rate_per_s"], stability["exact_frequency_hz"]
    grows, decays = f"grows by {rate:.3f} 1/s at {hertz:.1f} Hz", f"slowest motion decays by {-rate:.3f} 1/s"
    growth = grows if rate > 0 else decays
    if _unstable(outcome) is not None:
        growth = f"{outcome['varying_delay']['pattern']} delays, {stability['verdict']}"
    return f"{what.removesuffix(', no coupling').removesuffix(', case none')}, {coupling}: {growth}"


# ----------------------------------------------------------------------------------------------------
# The report as tables.


def _tables(scenario: Scenario, outcome: dict[str, Any], others: list[Alternative]) -> list[Any]:
    title = f"{scenario.title(outcome['case'])}: coupling {outcome['coupling']['kind']}"
    rows = [render.channel_row(scenario.environment.contacts), *_rows(outcome)]
    shown = [render.facts(title, rows, ("", ""))]
    if outcome["run"]["engines"]:
        shown.append(_speed_against_error(outcome["run"]))
    if others:
        shown.append(_beside(others, outcome))
    if rows := outcome["reproducibility"]:
        columns = ("what", "paper", "here", "why")
        cells = [[row[column] for column in columns] for row in rows]
        shown.append(render.grid("beside the paper", ("", *columns[1:]), cells, range(4)))
    return shown


def _speed_against_error(run: dict[str, Any]) -> Any:
    """Every engine and step on this scene; the one that ran is marked."""
    cells = []
    for row in run["engines"]:
        mark = " *" if (row["integrator"], row["substeps"]) == (run["integrator"], run["substeps"]) else ""
        error = render.optional(row["position_relative_rms"], "{:.1e}")
        right = "right" if row["verdict_correct"] else "[red]WRONG[/]"
        speed = f"{run['duration_s'] / row['cpu_s']:.0f}" if row["cpu_s"] else "-"  # too short for the clock
        cells.append((f"{row['integrator']} x {row['substeps']}{mark}", error, right, f"{row['cpu_s']:.3f}", speed))
    heads = ("engine x steps", "position error", "verdict", "CPU s", "x real time")
    return render.grid("speed against error on this scene (*: the cheapest that keeps --error, this run)", heads, cells)


def _beside(others: list[Alternative], outcome: dict[str, Any]) -> Any:
    """The price of each guarantee; the run's own coupling is marked where it is one of them."""
    own = outcome["coupling"]["kind"], outcome["certificate"]["condition"]
    cells = []
    for other in others:
        mark = "*" if own == (other.kind, other.condition) or own[0] == other.kind != "spring-damper" else ""
        if other.reason:
            cells.append((other.name, "", "", f"not possible: {other.reason}", "", ""))
            continue
        needs = (_share(other.needs(condition), "never") for condition in render.ORDER)
        grows = other.growth is None or other.growth > MARGINAL
        error = "grows" if grows else render.optional(other.error_percent, "{:.3g} %")
        cells.append((other.name + mark, *needs, other.guarantee or "none", _share(other.rendered, "-"), error))
    heads = ("coupling", "this-env.", "any-env.", "guarantee", "stiffness", "error")
    marked = " (*: this run)" if any(cell[0].endswith("*") for cell in cells) else ""
    title = f"the same devices with other couplings{marked}: required damping\nin % of theirs"
    return render.grid(f"{title}, guarantee, rendered stiffness and force error", heads, cells, left=(0, 3))


def _share(value: float | None, absent: str) -> str:
    return absent if value is None else f"{100 * value:.3g} %" if value < 10 else f"{100 * value:.0f} %"


def _rows(outcome: dict[str, Any]) -> list[tuple[str, str | None]]:
    names = ("coupling", "stability", "run", "varying_delay")
    coupling, stability, run, delays = (outcome[name] for name in names)
    transparent, error, contact = outcome["transparency"], outcome["error"], stability.get("contact")
    gains = coupling["K"] and f"{listed(coupling['K'], 5)} N/m / {listed(coupling['B'], 5)} N s/m"
    rendered = transparent["dc_ratio"] and f"{100 * transparent['dc_ratio']:.1f} %"
    how = "growth, switching" if _unstable(outcome) is not None else "growth, simulated trace"
    if run["timing"] and "impulse" in stability.get("reason", ""):
        how = "growth, uneven ticks"
    measured = render.optional(stability["growth_rate_per_s"], "{:+.4f} 1/s")
    engine = run["engine"] + (f" {run['integrator']} x {run['substeps']}" if run["integrator"] else "")
    speed = f"{run['wall_s']:.2f} s for {run['duration_s']:g} s: {run['real_time_factor']:.2g} x real time ({engine})"
    apart = error["position_relative_rms"]
    position = "-" if apart is None else f"{apart:.1e} relative rms, {error['position_max_m']:.1e} m at most"
    return [
        ("coupling K / B", gains or None),
        ("coupling, static", coupling.get("stiffness") and f"{listed(coupling['stiffness'], 5)} N/m"),
        *render.certificate_rows(outcome["certificates"], 5),
        *(ranges_rows(outcome["ranges"]) if outcome["ranges"] else []),
        ("guarantee", f"holds for {outcome['promise']}" if outcome["promise"] else "none"),
        ("transparency error", render.transparency_error(transparent)),
        *render.robustness_rows(outcome),
        ("force error", _force_error(outcome["ideal_force"])),
        ("rendered stiffness", rendered or "-"),
        *_net_rows(outcome),
        ("growth, eigenvalues", _growth(stability)),
        (how, f"{measured}: {render.verdict(stability['verdict'])}"),
        render.timing_row(run["timing"]),
        *(render.delay_rows(delays) if delays else []),
        *(_contact_rows(contact, run["samples"]) if contact else []),
        ("simulated in", run["environment"] if outcome["ranges"] else None),
        ("force limits", outcome["limiter"]["words"]),
        ("limited ticks", f"{stability['clipped_ticks']} of {run['samples']}"),
        ("speed", speed),
        ("position error", position),
        ("cross-check", run["cross_check"] and _crossed(run["cross_check"])),
    ]


def _crossed(part: dict[str, Any]) -> str:
    apart = render.optional(part["position_relative_rms"], "{:.1e} relative rms apart")
    growth = f"its loop grows {part['growth_rate_difference_per_s']:+.1e} 1/s otherwise"
    verdict = "[green]same verdict[/]" if part["agrees"] else "[red]ANOTHER VERDICT[/]"
    return f"{part['integrator']} x {part['substeps']}: {apart}, {growth}: {verdict}"


def _net_rows(outcome: dict[str, Any]) -> list[tuple[str, str]]:
    part = outcome["energy_budget"] or outcome["baseline"]
    if not part:
        return []
    acted = f"limited {part['limited_ticks']} of {part['ticks']} ticks"
    if outcome["baseline"]:
        return [("baseline", f"{part['name']}, {acted.replace('limited', 'acted in')}; no guarantee")]
    why = f" ({part['idle']})" if part["idle"] else ""
    return [("energy budget", f"{acted}{why}"), ("", part["guarantee"])]


def _force_error(part: dict[str, Any]) -> str:
    if part["error_percent"] is None:
        return f"- ({part['reason']})"
    return f"{part['error_percent']:.3g} % rms of the ideal force, before the force limits"


def _growth(part: dict[str, Any]) -> str:
    exact = f"{part['exact_growth_rate_per_s']:+.4f} 1/s at {part['exact_frequency_hz']:.2f} Hz"
    return f"{exact}: {render.verdict(part['exact_verdict'])}"


def _contact_rows(contact: dict[str, Any], samples: int) -> list[tuple[str, str]]:
    rows = [("contact", f"made {contact['made']} times, lasting {contact['ticks']} of {samples} ticks")]
    for state in contact["frozen"]:
        walls = [str(wall) for wall in state["touching"]]
        name = f"wall{'s' if len(walls) > 1 else ''} {', '.join(walls)}" if walls else "no wall"
        rows.append((f"growth, {name} touching", _growth(state)))
    return rows
