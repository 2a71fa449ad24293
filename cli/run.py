"""python -m sim.run: close the loop once and say what happened, with figures and a picture."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cli import options, render
from cli.judged import Judged, judge
from controller.environment import GROUND
from controller.loop import Loop
from design.files import write
from design.guarantees import ANY
from design.optimal import robustness_parts
from design.result import listed
from design.transparency import BAND_HZ, transparency
from sim import accuracy, report
from sim import passivity_layer as layer
from sim.alternatives import Alternative, alternatives
from sim.api import ScenarioRun, run_scenario
from sim.couplings import NAMES, Chosen, choose
from sim.engines import INTEGRATORS
from sim.run import ENGINES, beginnings
from sim.scenario import InputError, Scenario
from sim.stability import MARGINAL, stability_part
from sim.stepping import MOST


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    if args.error is not None and (args.engine == "exact" or args.integrator or args.substeps):
        raise InputError("--error chooses integrator and substeps of MuJoCo: give no --engine exact, --integrator, ..")
    scenario, out = _scenario(args), options.out_folder(args, "run")
    environment, simulated = _environment(args, scenario)
    chosen = _chosen(args, scenario)  # V, Q or R
    judged = judge(args, scenario, chosen, simulated)  # what each condition asks of the devices, and what is proved
    done = _run(args, simulated, chosen, judged.limits.rho)  # sample, compute, limit, hold, advance
    same = args.limiter is None and not scenario.ranges and args.case != "none"
    others = _alternatives(args, scenario, done, (chosen, judged.requirements, judged.limits) if same else None)
    report = _reported(args, scenario, chosen, judged, done, environment, others)
    files = _save(args, out, done, report)
    if args.side_by_side:
        files.append(_side_by_side(others, out / "couplings.png", scenario.environment.contacts))
    render.publish(args, report, _tables(scenario, report, others), report.remarks, out, files)
    return options.INTERRUPTED if done.trace.interrupted else options.DONE


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    options.add_loop_options(parser)
    options.add_varying_delay_options(parser)
    options.add_coupling_options(parser, f"{', '.join(NAMES)}, as baselines {', '.join(layer.BASELINES)}")
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
    if args.coupling not in layer.BASELINES:
        with render.designing(scenario.loop(args.case), args.coupling, args.condition) as heard:
            return choose(scenario, args.case, args.coupling, args.condition, args.limiter, heard)
    if args.energy_budget:
        raise InputError(f"--energy-budget with --coupling {args.coupling}: give one of them")
    note = f"baseline, without a guarantee here: {layer.BASELINES[args.coupling]}; no coupling besides."
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


def _run(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, lag: tuple[float, ...] | None) -> ScenarioRun:
    """Close the loop as the options say. Raises InputError for settings that cannot be."""
    net: layer.Wanted | None = None
    if args.coupling in layer.BASELINES:
        net = layer.Classic(args.coupling)
    elif args.energy_budget:
        net = layer.EnergyNet(*args.energy_budget)
    asked = {name: getattr(args, name) for name in ("engine", "integrator", "substeps", "error", "seed")}
    with render.progress("simulating") as move:
        return run_scenario(scenario, chosen.coupling, lag, **asked, net=net, progress=move)


def _alternatives(args: argparse.Namespace, scenario: Scenario, run: ScenarioRun, own: Any) -> list[Alternative]:
    """What other couplings come to in the scenario's own environment. Raises InputError for a picture of nothing."""
    skipped = args.no_alternatives or run.trace.interrupted or args.vertex > 0
    with render.progress("other couplings") as move:
        made = [] if skipped else alternatives(scenario, args.case, move, own)
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


@dataclass(frozen=True, eq=False)
class _Report:
    """The result of a run; parts that it does not have are null."""

    case: str
    scenario: str
    certificate: dict[str, Any]
    judged: Judged = render.unseen("beside")
    encoder: dict[str, Any] | None = render.unseen()
    transparency: dict[str, Any] = render.unseen()
    stability: dict[str, Any] = render.unseen()
    varying_delay: dict[str, Any] | None = render.unseen()
    run: dict[str, Any] = render.unseen()
    error: dict[str, Any] = render.unseen()
    credible: dict[str, Any] = render.unseen()
    alike: accuracy.ForceError = render.unseen("table")
    ideal_force: dict[str, Any] = render.unseen()
    energy_budget: dict[str, Any] | None = render.unseen()
    baseline: dict[str, Any] | None = render.unseen()
    robustness: dict[str, Any] = render.unseen("beside")
    alternatives: list[dict[str, Any]] = render.unseen()
    reproducibility: list[dict[str, str]] = render.unseen(default=())
    remarks: tuple[str, ...] = render.unseen(default=())

    @property
    def unstable(self) -> bool | None:
        """Whether switching makes the loop grow; None where the eigenvalues say whether it does."""
        return _switched(self.varying_delay) and self.stability["verdict"] == "unstable"

    def rows(self) -> render.Rows:
        """Of its table."""
        coupling, stability, run, transparent = self.judged.coupling, self.stability, self.run, self.transparency
        contact, apart = stability.get("contact"), self.error["position_relative_rms"]
        gains = coupling["K"] and f"{listed(coupling['K'], 5)} N/m / {listed(coupling['B'], 5)} N s/m"
        how = "growth, switching" if self.unstable is not None else "growth, simulated trace"
        if run["timing"] and "impulse" in stability.get("reason", ""):
            how = "growth, uneven ticks"
        measured = render.optional(stability["growth_rate_per_s"], "{:+.4f} 1/s")
        position = "-" if apart is None else f"{apart:.1e} relative rms, {self.error['position_max_m']:.1e} m at most"
        return [
            ("coupling K / B", gains or None),
            ("coupling, static", coupling.get("stiffness") and f"{listed(coupling['stiffness'], 5)} N/m"),
            *self.judged.rows(),
            ("transparency error", render.transparency_error(transparent)),
            *render.robustness_rows(self.robustness),
            ("force error", _force_error(self.ideal_force)),
            ("rendered stiffness", f"{100 * transparent['dc_ratio']:.1f} %" if transparent["dc_ratio"] else "-"),
            *_net_rows(self.energy_budget, self.baseline),
            ("growth, eigenvalues", _growth(stability)),
            (how, f"{measured}: {render.verdict(stability['verdict'])}"),
            render.timing_row(run["timing"]),
            *(render.delay_rows(self.varying_delay) if self.varying_delay else []),
            *(_contact_rows(contact, run["samples"]) if contact else []),
            ("simulated in", run["environment"] if self.judged.ranges else None),
            ("force limits", self.judged.limiter["words"]),
            ("limited ticks", f"{stability['clipped_ticks']} of {run['samples']}"),
            ("speed", _speed(run)),
            ("position error", position),
            ("cross-check", _crossed(run["cross_check"]) if run["cross_check"] else None),
        ]


def _switched(delays: dict[str, Any] | None) -> bool | None:
    return True if "verdict" in (delays or {}) else None


def _reported(
    args: argparse.Namespace,
    scenario: Scenario,
    chosen: Chosen,
    judged: Judged,
    run: ScenarioRun,
    environment: str,
    others: list[Alternative],
) -> _Report:
    """The report of a run."""
    simulation, lam = run.simulation, scenario.loop(args.case).lam
    covered = any(requirement.certified for requirement in judged.requirements.values())
    delays = report.delays_part(simulation, chosen, run.period, run.trace.t.size, covered)
    if delays and simulation.scenario.switches:
        stability = report.switched_stability_part(simulation, run.trace, delays)
    else:
        stability = stability_part(simulation, run.trace)
    alike, net = accuracy.force_error(run.ran, run.trace, lam), run.trace.net.part() if run.trace.net else None
    budget = net if net and net["guarantee"] is not None else None
    unstable = _switched(delays) and stability["verdict"] == "unstable"
    found = _Report(
        args.case,
        scenario.name,
        judged.certificates[chosen.condition],
        judged,
        report.encoder_steps(scenario, args.case, chosen.coupling),
        report.transparency_part(transparency(simulation.felt, simulation.E, lam, args.band_hz or BAND_HZ)),
        stability,
        delays,
        _settings(args, run, lam) | {"environment": environment},
        accuracy.position_error(run.trace, run.exact, simulation, unstable),
        accuracy.credible_part(simulation, run.trace),
        alike,
        alike.part(),
        budget and budget | {"idle": layer.idle(simulation, judged.requirements["any-environment"], budget)},
        None if budget else net,
        _robustness(chosen, scenario.loop(args.case), judged),
        [other.part() for other in others],
    )
    paper = report.beside_the_paper(simulation.scenario, args.case, stability, judged.coupling)
    remarks = (*run.remarks, *chosen.notes, *report.remarks(render.plain(found)))
    return replace(found, reproducibility=paper, remarks=remarks)


def _robustness(chosen: Chosen, loop: Loop, judged: Judged) -> dict[str, Any]:
    """What a wrong model of the environment costs a guarantee for this environment alone."""
    alone = chosen.condition == "this-environment" and judged.certificates[chosen.condition]["certified"]
    if not alone or judged.promise == ANY:
        return {"robustness": None, "designed_for_it": None}
    with render.progress("working out robustness and its price"):
        return robustness_parts(loop, chosen.coupling)


def _settings(args: argparse.Namespace, run: ScenarioRun, lam: tuple[int, ...]) -> dict[str, Any]:
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
        "theta": scenario.theta,
        "psi": scenario.psi,
        "lam": lam,
        "T_s": scenario.T,
        "timing": report.timing_part(run.simulation.timing, scenario),
        "seed": args.seed,
        "engines": [choice.part() for choice in run.choices] or None,
        "cross_check": accuracy.cross_check(run.ran, run.trace, run.integrator, run.substeps)
        if args.cross_check
        else None,
        "interrupted": run.trace.interrupted,
        "scenario_digest": scenario.digest,
        "encoder_step_m": process.encoder_step,
        "steady_ticks": [[0, run.trace.ticks_before_clipping(process.force_limit)]],
    }


def _save(args: argparse.Namespace, out: Path, run: ScenarioRun, report: _Report) -> list[Path]:
    result, stability = replace(run.trace, meta=render.plain(report)), report.stability
    files = [result.save_npz(out / "trace.npz"), result.save_csv(out / "trace.csv")]
    files.append(write(out / "scene.xml", run.simulation.scene.xml))
    if not args.no_plot and result.t.size:
        from sim.plots import Contacts, Onset, plot_run

        apart, hertz = report.ideal_force["error_percent"], stability["exact_frequency_hz"]
        ideal = None if apart is None else (report.alike.ideal, apart)
        grows = stability["exact_verdict"] == "unstable" and run.exact is not None
        growth = stability["exact_growth_rate_per_s"] if grows and report.unstable is None else None
        onset = Onset(growth, report.run["steady_ticks"][0][1], report.credible["until_s"])
        around = Contacts(run.simulation.scenario.environment.contacts, *_walls(run))
        title = _title(run.simulation.scenario.title(args.case), report)
        files.append(plot_run(result, out / "figure.png", title, hertz, ideal, onset, around))
    return files


def _walls(run: ScenarioRun) -> tuple[list[tuple[int, float, str]], Any]:
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


def _title(what: str, report: _Report) -> str:
    """Of the picture."""
    stability, kind = report.stability, report.judged.coupling["kind"]
    coupling = "no virtual coupling" if kind == "none" else f"{kind} coupling"
    if kind != "none" and report.judged.promise:
        coupling += f" for {report.judged.promise}"
    rate, hertz = stability["exact_growth_rate_per_s"], stability["exact_frequency_hz"]
    grows, decays = f"grows by {rate:.3f} 1/s at {hertz:.1f} Hz", f"slowest motion decays by {-rate:.3f} 1/s"
    growth = grows if rate > 0 else decays
    if report.varying_delay and report.unstable is not None:
        growth = f"{report.varying_delay['pattern']} delays, {stability['verdict']}"
    return f"{what.removesuffix(', no coupling').removesuffix(', case none')}, {coupling}: {growth}"


# ----------------------------------------------------------------------------------------------------
# The report as tables.


def _tables(scenario: Scenario, report: _Report, others: list[Alternative]) -> list[Any]:
    title = f"{scenario.title(report.case)}: coupling {report.judged.coupling['kind']}"
    shown = [render.facts(title, [render.channel_row(scenario.environment.contacts), *report.rows()], ("", ""))]
    if report.run["engines"]:
        shown.append(_speed_against_error(report.run))
    if others:
        shown.append(_beside(others, report))
    if report.reproducibility:
        columns = ("what", "paper", "here", "why")
        cells = [[row[column] for column in columns] for row in report.reproducibility]
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


def _beside(others: list[Alternative], report: _Report) -> Any:
    """The price of each guarantee; the run's own coupling is marked where it is one of them."""
    own = report.judged.coupling["kind"], report.certificate["condition"]
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


def _speed(run: dict[str, Any]) -> str:
    engine = run["engine"] + (f" {run['integrator']} x {run['substeps']}" if run["integrator"] else "")
    return f"{run['wall_s']:.2f} s for {run['duration_s']:g} s: {run['real_time_factor']:.2g} x real time ({engine})"


def _crossed(part: dict[str, Any]) -> str:
    apart = render.optional(part["position_relative_rms"], "{:.1e} relative rms apart")
    growth = f"its loop grows {part['growth_rate_difference_per_s']:+.1e} 1/s otherwise"
    verdict = "[green]same verdict[/]" if part["agrees"] else "[red]ANOTHER VERDICT[/]"
    return f"{part['integrator']} x {part['substeps']}: {apart}, {growth}: {verdict}"


def _net_rows(budget: dict[str, Any] | None, baseline: dict[str, Any] | None) -> render.Rows:
    if baseline:
        acted = f"acted in {baseline['limited_ticks']} of {baseline['ticks']} ticks"
        yield "baseline", f"{baseline['name']}, {acted}; no guarantee"
    if budget:
        why = f" ({budget['idle']})" if budget["idle"] else ""
        yield "energy budget", f"limited {budget['limited_ticks']} of {budget['ticks']} ticks{why}"
        yield "", budget["guarantee"]


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
