"""python -m sim.run: close the loop once and say what happened, with figures and a picture.

scenario -> environment -> coupling -> certificates -> loop -> result -> report
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from design.assess import CONDITIONS, assess
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
from sim.scenario import InputError
from sim.simulate import ENGINES, Assembly, assemble, simulate
from sim.substeps import LEAST, MOST, check_substeps, default_substeps


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = scenario_from(args)
    if args.duration is not None:
        scenario = scenario.replace(duration=numbers("--duration", args.duration, float, 1)[0])
    if args.human is not None:
        scenario = scenario.replace(human=load_humans(args.human, scenario.channels))
    asked, seed, out = _substeps(args), seed_from(args), out_folder(args, "run")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    assembly = assemble(scenario, chosen.coupling)
    substeps, warnings = _settled(args, assembly, asked)

    with (bar := progress_bar("simulating"))[0]:
        begin = time.perf_counter()
        record = simulate(assembly, args.engine, args.integrator, substeps or LEAST, progress=bar[1])
        wall = time.perf_counter() - begin
    exact = record if args.engine == "exact" else simulate(assembly, "exact", samples=record.s.shape[0])

    alike = likeness(assembly, record, scenario.loop(args.case).lam)
    outcome = _outcome(args, chosen, assembly, record, exact, wall)
    outcome["ideal_force"] = alike.part()
    outcome["run"] |= {"substeps": substeps, "seed": seed}
    outcome["remarks"] = [*warnings, *outcome["remarks"]]
    outcome["files"] = [str(p) for p in _save(args, out, assembly, record, alike, outcome)]
    report.print_report(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    return INTERRUPTED if record.interrupted else DONE


def _parser() -> Parser:
    parser = Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    add_loop_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--engine", choices=ENGINES, default="mujoco")
    parser.add_argument("--integrator", choices=(*INTEGRATORS, LEAPFROG), default="RK4", help="of MuJoCo (default RK4)")
    parser.add_argument("--substeps", metavar="N", help="MuJoCo steps per period (default 4, more where needed)")
    parser.add_argument("--duration", metavar="SECONDS", help="default: the scenario's")
    parser.add_argument("--human", metavar="FILE.toml", help="other humans: one [[human]] table per channel")
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
    args: argparse.Namespace, chosen: Chosen, assembly: Assembly, record: Record, exact: Record, wall: float
) -> dict[str, Any]:
    scenario, samples = assembly.scenario, record.s.shape[0]
    loop = scenario.loop(args.case)
    requirements = assess(loop, chosen.coupling, chosen.phi)
    certificates = {name: certificate_part(requirement) for name, requirement in requirements.items()}
    simulated = samples * scenario.T
    mujoco = args.engine == "mujoco"
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": coupling_part(chosen.kind, chosen.coupling, scenario.T),
        "certificate": certificates[chosen.condition],
        "certificates": certificates,
        "promise": promise_of(requirements, scenario.psi),
        "transparency": transparency_part(transparency(assembly.F, assembly.E, loop.lam)),
        "stability": report.stability_part(assembly, record),
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
        },
        "error": report.error_part(record, exact, assembly),
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
        title = f"{outcome['scenario']}, case {args.case}, {with_what}: {growth}"
        ideal = (alike.ideal, outcome["ideal_force"]["error_percent"])
        files.append(plot_run(result, out / "figure.png", title, stability["exact_frequency_hz"], ideal))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(p) for p in files]})
    return files


if __name__ == "__main__":
    execute(main)
