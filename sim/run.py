"""python -m sim.run: close the loop once and say what happened, with figures and a picture.

scenario -> environment -> coupling -> certificates -> loop -> result -> report
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from design.assess import CONDITIONS, assess
from design.box.check import SetCheck, check_set, set_part
from design.promises import certificate_part, promise_of
from design.summary import coupling_part, transparency_part
from design.transparency import transparency
from sim import report, reproducibility
from sim.command import (
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    numbers,
    out_folder,
    progress_bar,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES, Chosen, choose
from sim.files import write, write_json
from sim.human_file import load_humans
from sim.ideal import Likeness, likeness
from sim.loop import Record
from sim.mujoco_engine import INTEGRATORS, LEAPFROG
from sim.result import Result
from sim.scenario import InputError, Scenario
from sim.simulate import ENGINES, Assembly, assemble, simulate
from sim.stability import before_clipping
from sim.substeps import LEAST, MOST, check_substeps, default_substeps
from sim.switching import report as jitter_report
from sim.switching.drawn import switching
from sim.switching.options import add_jitter_options, with_jitter
from sim.switching.worst import Period


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = with_jitter(args, scenario_from(args))
    if args.duration is not None:
        scenario = scenario.replace(duration=numbers("--duration", args.duration, float, 1)[0])
    if args.human is not None:
        people = load_humans(args.human, scenario.channels)
        scenario = scenario.replace(human=people.human, person=people.person)
    asked, seed, out = _substeps(args), seed_from(args), out_folder(args, "run")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    where, simulated = _environment(args, scenario)
    assembly, period = assemble(simulated, chosen.coupling), None
    if args.engine == "exact" and assembly.friction:
        raise InputError("--engine exact is linear and has no Coulomb friction, the devices have; use --engine mujoco")
    if scenario.switches:
        assembly, period = switching(assembly, chosen.coupling, seed, scenario.samples)
    with (bar := progress_bar("searching the box"))[0]:
        whole = check_set(scenario.loop(args.case), chosen.coupling, seed, progress=bar[1])
    substeps, warnings = _settled(args, assembly, asked)

    with (bar := progress_bar("simulating"))[0]:
        begin = time.perf_counter()
        record = simulate(assembly, args.engine, args.integrator, substeps or LEAST, progress=bar[1])
        wall = time.perf_counter() - begin
    exact = record if args.engine == "exact" else _exact(assembly, record)

    alike = likeness(assembly, record, scenario.loop(args.case).lam)
    outcome = _outcome(args, chosen, assembly, period, record, exact, wall, whole)
    outcome["ideal_force"] = alike.part()
    outcome["run"] |= {"substeps": substeps, "seed": seed, "environment": where}
    outcome["remarks"] = [*warnings, *outcome["remarks"]]
    outcome["files"] = [str(p) for p in _save(args, out, assembly, record, alike, outcome)]
    report.print_report(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    return INTERRUPTED if record.interrupted else DONE


def _exact(assembly: Assembly, record: Record) -> Record | None:
    """The exact engine's run; None where friction makes the loop another one than the linear."""
    return None if assembly.friction else simulate(assembly, "exact", samples=record.s.shape[0])


def _parser() -> Parser:
    parser = Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    add_loop_options(parser)
    add_jitter_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--engine", choices=ENGINES, default="mujoco", help="MuJoCo, or the exact solution")
    parser.add_argument("--integrator", choices=(*INTEGRATORS, LEAPFROG), default="RK4", help="of MuJoCo (default RK4)")
    parser.add_argument("--substeps", metavar="N", help="MuJoCo steps per period (default 4, more where needed)")
    parser.add_argument("--duration", metavar="SECONDS", help="default: the scenario's")
    parser.add_argument("--human", metavar="FILE.toml", help="other humans: [[human]] per channel, [[person]]")
    parser.add_argument(
        "--vertex", metavar="N", help="simulate at this vertex of the scenario's box (default 0: nominal)"
    )
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _substeps(args: argparse.Namespace) -> int | None:
    """The number that was asked for, or None. Raises InputError."""
    if args.substeps is None:
        return None
    (substeps,) = numbers("--substeps", args.substeps, int, 1)
    if not 1 <= substeps <= MOST:
        raise InputError(f"--substeps is {substeps}, allowed are 1 to {MOST}")
    return substeps


def _environment(args: argparse.Namespace, scenario: Scenario) -> tuple[str, Scenario]:
    """Which environment is simulated, and the scenario with that one, known exactly. Raises InputError."""
    members = scenario.loop(args.case).members()
    (vertex,) = numbers("--vertex", args.vertex or "0", int, 1)
    if not 0 <= vertex < len(members):
        why = f"allowed are 0 to {len(members) - 1}" if scenario.box else "but the scenario has no box"
        raise InputError(f"--vertex is {vertex}, {why}")
    return members[vertex].name, scenario.replace(environment=members[vertex].network, box=None)


def _settled(args: argparse.Namespace, assembly: Assembly, asked: int | None) -> tuple[int | None, list[str]]:
    """Substeps of this run (None for the exact engine), with remarks on a number that was asked for."""
    if args.engine == "exact":
        return None, []
    try:
        if asked is None:
            return default_substeps(assembly, args.integrator), []
        return asked, check_substeps(assembly, args.integrator, asked)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"--integrator {args.integrator}: {error}") from None


def _outcome(
    args: argparse.Namespace,
    chosen: Chosen,
    assembly: Assembly,
    period: Period | None,
    record: Record,
    exact: Record | None,
    wall: float,
    whole: SetCheck | None,
) -> dict[str, Any]:
    scenario, samples = assembly.scenario, record.s.shape[0]
    loop = scenario.loop(args.case)
    requirements = assess(loop, chosen.coupling, chosen.phi)
    certificates = {name: certificate_part(requirement) for name, requirement in requirements.items()}
    simulated = samples * scenario.T
    certified = any(requirement.certified for requirement in requirements.values())
    jitter, stability, unstable = jitter_report.part(assembly, chosen, period, samples, certified), None, None
    if jitter and scenario.switches:
        stability = jitter_report.stability_part(assembly, record, jitter)
        unstable = stability["verdict"] == "unstable"
    mujoco = args.engine == "mujoco"
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": coupling_part(chosen.kind, chosen.coupling, scenario.T),
        "certificate": certificates[chosen.condition],
        "certificates": certificates,
        "promise": promise_of(requirements, loop, bool(whole and whole.proved)),
        "set": whole and set_part(whole),
        "transparency": transparency_part(transparency(assembly.felt, assembly.E, loop.lam)),
        "stability": stability or report.stability_part(assembly, record),
        "jitter": jitter,
        "run": {
            "engine": args.engine,
            "integrator": args.integrator if mujoco else None,
            "duration_s": simulated,
            "samples": samples,
            "wall_s": wall,
            "real_time_factor": simulated / wall,
            "theta": list(scenario.theta),
            "psi": list(scenario.psi),
            "lam": list(loop.lam),
            "T_s": scenario.T,
            "interrupted": record.interrupted,
            "scenario_digest": scenario.digest,
            "encoder_step_m": assembly.process.encoder_step.tolist(),
            "steady_ticks": [[0, before_clipping(record, assembly.process.force_limit)]],
        },
        "error": report.error_part(record, exact, assembly, unstable),
    }
    outcome["reproducibility"] = reproducibility.table(scenario, args.case, outcome)
    return outcome | {"remarks": [*chosen.notes, *report.remarks(outcome)]}


def _save(
    args: argparse.Namespace,
    out: Path,
    assembly: Assembly,
    record: Record,
    alike: Likeness,
    outcome: dict[str, Any],
) -> list[Path]:
    result = Result.from_record(assembly, record, outcome)
    files = [
        result.save_npz(out / "trace.npz"),
        result.save_csv(out / "trace.csv"),
        write(out / "scene.xml", assembly.scene.xml),
    ]
    if not args.no_plot and result.t.size:
        from sim.plot import plot_run

        stability = outcome["stability"]
        with_what = "no virtual coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
        growth = f"growth {stability['exact_growth_rate_per_s']:+.3f} 1/s at {stability['exact_frequency_hz']:.1f} Hz"
        if assembly.scenario.jitter and assembly.scenario.switches:
            growth = f"{outcome['jitter']['pattern']} delays, {stability['verdict']}"
        title = f"{outcome['scenario']}, case {args.case}, {with_what}: {growth}"
        apart = outcome["ideal_force"]["error_percent"]
        ideal = None if apart is None else (alike.ideal, apart)
        files.append(plot_run(result, out / "figure.png", title, stability["exact_frequency_hz"], ideal))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(p) for p in files]})
    return files


if __name__ == "__main__":
    execute(main)
