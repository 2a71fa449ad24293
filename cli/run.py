"""python -m sim.run: close the loop once and say what happened, with figures and a picture."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cli import options, render
from controller.loop import Loop
from design.certificate import assess, promise_of
from design.ranges import SetCheck, check_set, set_part, set_rows
from design.result import listed
from design.transparency import transparency
from sim import report
from sim.accuracy import ForceError, force_error, position_error
from sim.couplings import NAMES, Chosen, choose
from sim.engines import INTEGRATORS, default_integrator
from sim.files import write
from sim.run import ENGINES, Simulation, assemble, make_engine, run
from sim.scenario import InputError, Scenario, load_humans
from sim.stability import stability_part
from sim.stepping import MOST, check_substeps, default_substeps
from sim.switching import Period, switching
from sim.trace import Trace


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario, out = _scenario(args), options.out_folder(args, "run")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    loop = scenario.loop(args.case)
    environment, simulated = _environment(args, scenario)
    with render.progress("searching the ranges") as move:
        whole = check_set(loop, chosen.coupling, args.seed, progress=move)

    done = _run(args, simulated, chosen)
    requirements = assess(done.loop(args.case), chosen.coupling, chosen.phi)
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": report.coupling_part(chosen.kind, chosen.coupling, scenario.T),
        **_certified(chosen, requirements, done.loop(args.case), whole),
        "transparency": report.transparency_part(transparency(done.simulation.felt, done.simulation.E, loop.lam)),
        **_stability(chosen, done, any(requirement.certified for requirement in requirements.values())),
        "run": _settings(args, done, loop.lam) | {"environment": environment},
    }
    outcome["error"] = position_error(done.trace, done.exact, done.simulation, _unstable(outcome))
    outcome["reproducibility"] = report.beside_the_paper(done.simulation.scenario, args.case, outcome)
    alike = force_error(done.simulation, done.trace, loop.lam)
    outcome["ideal_force"] = alike.part()
    outcome["remarks"] = [*done.warnings, *chosen.notes, *report.remarks(outcome)]
    files = _save(args, out, done, alike, outcome)
    render.publish(args, outcome, _tables(outcome), outcome["remarks"], out, files)
    return options.INTERRUPTED if done.trace.interrupted else options.DONE


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    options.add_loop_options(parser)
    options.add_varying_delay_options(parser)
    options.add_coupling_options(parser, ", ".join(NAMES))
    parser.add_argument("--engine", choices=ENGINES, default="mujoco", help="MuJoCo, or the exact solution")
    steppers = "of MuJoCo (default exponential, RK4 where devices rub)"
    parser.add_argument("--integrator", choices=tuple(INTEGRATORS), help=steppers)
    steps = "MuJoCo steps per period (default: what the plant asks)"
    parser.add_argument("--substeps", type=options.whole(1, MOST), metavar="N", help=steps)
    parser.add_argument("--duration", type=options.number(), metavar="SECONDS", help="default: the scenario's")
    who = "other humans: [[human]] per channel in a .toml, or `humans` in a .py"
    parser.add_argument("--human", metavar="FILE", help=who)
    vertex = "simulate at this vertex of the scenario's ranges (default 0: nominal)"
    parser.add_argument("--vertex", type=options.whole(), default=0, metavar="N", help=vertex)
    options.add_output_options(parser, picture=True)
    return parser


def _scenario(args: argparse.Namespace) -> Scenario:
    """The scenario with the delays, the duration and the humans that the options give. Raises InputError."""
    scenario = options.with_varying_delays(args, options.scenario_from(args))
    if args.duration is not None:
        scenario = scenario.replace(duration=args.duration)
    if args.human is not None:
        people = load_humans(args.human, scenario.channels)
        scenario = scenario.replace(human=people.human, person=people.person)
    return scenario


def _environment(args: argparse.Namespace, scenario: Scenario) -> tuple[str, Scenario]:
    """Which environment is simulated, and the scenario with that one, known exactly. Raises InputError."""
    members = scenario.loop(args.case).members()
    if not 0 <= args.vertex < len(members):
        why = f"allowed are 0 to {len(members) - 1}" if scenario.box else "but the scenario has no ranges ([box])"
        raise InputError(f"--vertex is {args.vertex}, {why}")
    return members[args.vertex].name, scenario.replace(environment=members[args.vertex].network, box=None)


# ----------------------------------------------------------------------------------------------------
# The run and what it came to.


@dataclass(frozen=True, eq=False)
class _Run:
    """One run of a scenario, and the exact engine's beside it."""

    simulation: Simulation
    period: Period | None  # of the worst switching found, where the delays switch
    integrator: str | None  # None for the exact engine, and so are the substeps
    substeps: int | None
    warnings: list[str]
    trace: Trace
    exact: Trace | None  # None where friction makes the loop another one than the linear
    wall_s: float

    def loop(self, case: str) -> Loop:
        """What was simulated, as a design knows it."""
        return self.simulation.scenario.loop(case)


def _run(args: argparse.Namespace, scenario: Scenario, chosen: Chosen) -> _Run:
    """Close the loop. Raises InputError for settings that cannot be."""
    simulation, period = assemble(scenario, chosen.coupling), None
    if args.engine == "exact" and simulation.friction:
        raise InputError("--engine exact is linear and has no Coulomb friction, the devices have; use --engine mujoco")
    if scenario.switches:
        simulation, period = switching(simulation, chosen.coupling, args.seed, scenario.samples)
    integrator, substeps, warnings = _steps(args, simulation)
    engine = make_engine(simulation, args.engine, integrator, substeps)
    with render.progress("simulating") as move:
        begin = time.perf_counter()
        trace = run(simulation, engine, progress=move)
        wall = time.perf_counter() - begin
    exact = trace
    if args.engine != "exact":
        exact = None if simulation.friction else run(simulation, "exact", ticks=trace.t.size)
    return _Run(simulation, period, integrator, substeps, warnings, trace, exact, wall)


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


def _certified(chosen: Chosen, requirements: dict[str, Any], loop: Loop, whole: SetCheck | None) -> dict[str, Any]:
    certificates = report.certificates_part(requirements)
    return {
        "certificate": certificates[chosen.condition],
        "certificates": certificates,
        "promise": promise_of(requirements, loop, bool(whole and whole.proved)),
        "set": whole and set_part(whole),
    }


def _stability(chosen: Chosen, run: _Run, certified: bool) -> dict[str, Any]:
    jitter = report.delays_part(run.simulation, chosen, run.period, run.trace.t.size, certified)
    if jitter and run.simulation.scenario.switches:
        return {"stability": report.switched_stability_part(run.simulation, run.trace, jitter), "jitter": jitter}
    return {"stability": stability_part(run.simulation, run.trace), "jitter": jitter}


def _unstable(outcome: dict[str, Any]) -> bool | None:
    """Whether switching makes the loop grow; None where the eigenvalues say whether it does."""
    switched = "verdict" in (outcome["jitter"] or {})
    return outcome["stability"]["verdict"] == "unstable" if switched else None


def _settings(args: argparse.Namespace, run: _Run, lam: tuple[int, ...]) -> dict[str, Any]:
    scenario, process, samples = run.simulation.scenario, run.simulation.process, run.trace.t.size
    return {
        "engine": args.engine,
        "integrator": run.integrator,
        "substeps": run.substeps,
        "duration_s": samples * scenario.T,
        "samples": samples,
        "wall_s": run.wall_s,
        "real_time_factor": samples * scenario.T / run.wall_s,
        "theta": list(scenario.theta),
        "psi": list(scenario.psi),
        "lam": list(lam),
        "T_s": scenario.T,
        "seed": args.seed,
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
        from sim.plots import plot_run

        apart, hertz = outcome["ideal_force"]["error_percent"], outcome["stability"]["exact_frequency_hz"]
        ideal = None if apart is None else (alike.ideal, apart)
        files.append(plot_run(result, out / "figure.png", _title(args, outcome), hertz, ideal))
    return files


def _title(args: argparse.Namespace, outcome: dict[str, Any]) -> str:
    """Of the picture."""
    stability = outcome["stability"]
    coupling = "no virtual coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
    growth = f"growth {stability['exact_growth_rate_per_s']:+.3f} 1/s at {stability['exact_frequency_hz']:.1f} Hz"
    if _unstable(outcome) is not None:
        growth = f"{outcome['jitter']['pattern']} delays, {stability['verdict']}"
    return f"{outcome['scenario']}, case {args.case}, {coupling}: {growth}"


# ----------------------------------------------------------------------------------------------------
# The report as tables.


def _tables(outcome: dict[str, Any]) -> list[Any]:
    title = f"case {outcome['case']} · {outcome['scenario']} · coupling {outcome['coupling']['kind']}"
    shown = [render.facts(title, _rows(outcome), ("", ""))]
    if rows := outcome["reproducibility"]:
        columns = ("what", "paper", "here", "why")
        cells = [[row[column] for column in columns] for row in rows]
        shown.append(render.grid("beside the paper", ("", *columns[1:]), cells, range(4)))
    return shown


def _rows(outcome: dict[str, Any]) -> list[tuple[str, str | None]]:
    coupling, stability, run, jitter = (outcome[name] for name in ("coupling", "stability", "run", "jitter"))
    transparent, error, contact = outcome["transparency"], outcome["error"], stability.get("contact")
    gains = coupling["K"] and f"{listed(coupling['K'], 5)} N/m / {listed(coupling['B'], 5)} N s/m"
    rendered = transparent["dc_ratio"] and f"{100 * transparent['dc_ratio']:.1f} %"
    how = "growth, switching" if _unstable(outcome) is not None else "growth, simulated trace"
    measured = render.optional(stability["growth_rate_per_s"], "{:+.4f} 1/s")
    engine = run["engine"] + (f" {run['integrator']} x {run['substeps']}" if run["integrator"] else "")
    speed = f"{run['wall_s']:.2f} s for {run['duration_s']:g} s: {run['real_time_factor']:.2g} x real time ({engine})"
    apart = error["position_relative_rms"]
    position = "-" if apart is None else f"{apart:.1e} relative rms, {error['position_max_m']:.1e} m at most"
    return [
        ("coupling K / B", gains or None),
        *render.certificate_rows(outcome["certificates"], 5),
        *(set_rows(outcome["set"]) if outcome["set"] else []),
        ("guarantee", f"holds for {outcome['promise']}" if outcome["promise"] else "none"),
        ("transparency error", render.transparency_error(transparent)),
        ("force error", _force_error(outcome["ideal_force"])),
        ("rendered stiffness", rendered or "-"),
        ("growth, eigenvalues", _growth(stability)),
        (how, f"{measured}: {render.verdict(stability['verdict'])}"),
        *(render.delay_rows(jitter) if jitter else []),
        *(_contact_rows(contact, run["samples"]) if contact else []),
        ("simulated in", run["environment"] if outcome["set"] else None),
        ("clipped ticks", f"{stability['clipped_ticks']} of {run['samples']}"),
        ("speed", speed),
        ("position error", position),
    ]


def _force_error(part: dict[str, Any]) -> str:
    if part["error_percent"] is None:
        return f"- ({part['reason']})"
    return f"{part['error_percent']:.3g} % rms of Lambda E's, before the force limits"


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
