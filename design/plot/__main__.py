"""python -m design.plot: couplings side by side over frequency.

options -> couplings -> both conditions of each -> curves on one grid -> JSON, pictures, table
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from controller.environment import environment
from controller.lti import Array
from design.assess import CONDITIONS
from design.failure import DesignFailed
from design.plot.curves import Curves, Judged, Perceived, curves, grid, ideal, judge
from design.plot.table import tables
from design.promises import certificate_part, finite
from design.store import Loop
from design.summary import coupling_part, transparency_part
from design.transparency import transparency
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    out_folder,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES, Chosen, choose
from sim.files import write_json
from sim.scenario import InputError, Scenario

MOST = 6  # curves that can be told apart in one panel


def main(argv: list[str]) -> int:
    """Draw couplings over frequency. 0: all of them, 1: some could not be designed."""
    args = _parser().parse_args(argv)
    seed = seed_from(args)
    scenario = scenario_from(args)
    names = _names(args)
    out = out_folder(args, "plot")
    chosen, failed = _chosen(scenario, args, names)

    loop = scenario.loop(args.case)
    outcome = {"case": args.case, "scenario": scenario.name, "seed": seed} | _data(loop, chosen)
    outcome["notes"] = [*(f"{name}: {note}" for name, c in chosen.items() for note in c.notes), *failed]
    outcome["notes"] += _reasons(outcome["couplings"])
    outcome["files"] = [str(path) for path in _save(args, out, outcome)]
    screen = console(args)
    for table in tables(outcome):
        screen.print(table)
    for note in outcome["notes"]:
        screen.print(f"[dim]·[/] {note}")
    for file in outcome["files"]:
        screen.print(f"[dim]·[/] {file}", soft_wrap=True)
    if args.json:
        write_json(args.json, outcome)
    return DOES_NOT_HOLD if failed else DONE


def _parser() -> Parser:
    parser = Parser(
        "design.plot",
        "Draw couplings over frequency: singular values, required damping, perceived stiffness and damping.",
        "python -m design.plot --coupling published,spring-damper:theorem4,spring-damper:closed-loop",
    )
    add_loop_options(parser)
    what = f"{', '.join(NAMES)} or FILE.json, separated by commas; NAME:CONDITION asks for a condition"
    parser.add_argument("--coupling", metavar="NAME,FILE,..", help=f"{what} (default none,spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition of designs that name none")
    parser.add_argument("--no-plot", action="store_true", help="write no pictures")
    add_output_options(parser)
    return parser


def _names(args: argparse.Namespace) -> list[str]:
    """The couplings that were asked for. Raises InputError."""
    usual = "none" if args.case == "none" else "none,spring-damper"
    asked: str = usual if args.coupling is None else args.coupling
    names = asked.split(",")
    if "" in names:
        raise InputError(f"--coupling is {args.coupling!r}, expected names separated by commas")
    if len(set(names)) < len(names):
        raise InputError(f"--coupling is {args.coupling!r}: a name stands there twice")
    if len(names) > MOST:
        raise InputError(f"--coupling has {len(names)} entries, allowed are 1 to {MOST}")
    return names


def _chosen(scenario: Scenario, args: argparse.Namespace, names: list[str]) -> tuple[dict[str, Chosen], list[str]]:
    """The couplings by name, and why designs failed. Raises DesignFailed where all of them did."""
    chosen: dict[str, Chosen] = {}
    failures: dict[str, DesignFailed] = {}
    for name in names:
        plain, _, condition = name.rpartition(":")
        known = plain and condition in CONDITIONS
        if plain in NAMES and not known:
            raise InputError(f"--coupling {name}: the condition is {condition!r}, allowed are {', '.join(CONDITIONS)}")
        try:
            chosen[name] = choose(scenario, args.case, plain if known else name, condition if known else args.condition)
        except DesignFailed as error:
            failures[name] = error
    if not chosen:
        raise next(iter(failures.values()))
    return chosen, [f"{name}: not possible: {' '.join(str(error).split())}" for name, error in failures.items()]


def _data(loop: Loop, chosen: dict[str, Chosen]) -> dict[str, Any]:
    """Everything that the pictures show; SI units, null where a figure is infinite or does not exist."""
    judged = {name: judge(loop, c.coupling, c.phi) for name, c in chosen.items()}
    hz = grid(loop, list(judged.values()))
    sigma_E, undelayed = ideal(loop, hz)
    parts = []
    for name, c in chosen.items():
        at = judged[name]
        figures = transparency(at.F, environment(loop.environment, loop.T), loop.lam)
        shown = {"name": Path(name).name, **coupling_part(c.kind, c.coupling, loop.T), "states": at.F.order}
        parts.append(shown | {"transparency": transparency_part(figures)} | _coupling_data(at, curves(loop, at, hz)))
    return {
        "T_s": loop.T,
        "theta": list(loop.theta),
        "psi": list(loop.psi),
        "lam": list(loop.lam),
        "available_damping": list(loop.delta),
        "frequency_hz": hz.tolist(),
        "sigma_E": sigma_E.tolist(),
        "ideal": _perceived(undelayed),
        "couplings": parts,
    }


def _coupling_data(judged: Judged, lines: Curves) -> dict[str, Any]:
    data: dict[str, Any] = {"sigma_F": lines.sigma_F.tolist(), "sigma_M": lines.sigma_M.tolist()}
    data["perceived"] = _perceived(lines.perceived)
    for name, requirement in judged.requirements.items():
        demand = lines.demands[name]
        data[name] = certificate_part(requirement) | {"ratio": finite(requirement.ratio), "demand": _row(demand)}
        if demand is None and not requirement.reason:
            data[name]["reason"] = "this coupling is no V in feedback around the environment: no curve for theorem4"
    return data


def _reasons(couplings: list[dict[str, Any]]) -> list[str]:
    """Why a curve is missing."""
    parts = [(c["name"], condition, c[condition]) for c in couplings for condition in CONDITIONS]
    return [f"{name}, {condition}: {part['reason']}" for name, condition, part in parts if "reason" in part]


def _perceived(values: Perceived) -> dict[str, Any]:
    return {"stiffness": values.stiffness.tolist(), "damping": values.damping.tolist()}


def _row(values: Array | None) -> list[float | None] | None:
    return None if values is None else [finite(v) for v in values]


def _save(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[Path]:
    files = [out / "curves.json"]
    if not args.no_plot:
        from sim.plot_frequency import plot_perceived, plot_required_damping, plot_singular_values

        files.append(plot_singular_values(outcome, out / "singular-values.png"))
        files.append(plot_required_damping(outcome, out / "required-damping.png"))
        files.append(plot_perceived(outcome, out / "perceived.png"))
    write_json(files[0], outcome | {"files": [str(p) for p in files]})
    return files


if __name__ == "__main__":
    execute(main)
