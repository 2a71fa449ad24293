"""python -m design.plot: couplings side by side over frequency.

options -> couplings -> both conditions of each -> curves on one grid -> JSON, pictures, table
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    as_option,
    console,
    numbers,
    out_folder,
    progress_bar,
    scenario_from,
    seed_from,
)
from cli.run import coupling_part, transparency_part
from controller.environment import environment
from controller.loop import Loop
from controller.lti import Array
from design.certificate import CONDITIONS, certificate_part, finite
from design.compare import (
    AXES,
    LADDERS,
    Curves_report,
    Designer,
    Judged,
    Limit,
    Perceived,
    Setting,
    climb,
    curves,
    gains,
    grid,
    ideal,
    judge,
    optimum,
    print_curves,
    print_ladder,
    remembered,
    settings,
    spring_damper,
    tables,
)
from design.compare import Curves as Curves_curves
from design.optimal import FILTERS, OBJECTIVES, Wish
from design.result import DesignFailed
from design.transparency import transparency
from sim.couplings import NAMES, Chosen, choose
from sim.files import write_json
from sim.scenario import InputError, Scenario

# ----------------------------------------------------------------------------------------------------
# python -m design.limits: how good could a coupling be, with another device, delay, period or order?


BESIDE = {"none": (), "theorem4": ("theorem4",), "closed-loop": ("closed-loop",), "both": ("theorem4", "closed-loop")}
MOST_POINTS = 100
OF_THE_CURVE = ("over", "points", "keep", "beside", "no_plot")
OF_THE_CURVE += ("functions", "filter", "objective", "high_gain", "margin", "diagonal")


def main(argv: list[str]) -> int:
    """Draw the limit curve, or print the ladder. 0: done, 1: nothing could be designed, 130: interrupted."""
    parser = _parser()
    args = parser.parse_args(argv)
    scenario = scenario_from(args)
    if args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")
    seed, wish = seed_from(args), _wish(args)
    head = {"scenario": scenario.name, "seed": seed}
    if args.ladder:
        _only_the_ladder(args, parser)
        return _ladder(args, {case: scenario.loop(case) for case in ("I", "II")}, head)
    loop = scenario.loop(args.case)
    try:
        if min(loop.delta) <= 0:
            raise ValueError(f"delta is {list(loop.delta)}, expected positive dampings in N s/m")
    except ValueError as error:
        raise InputError(str(error)) from None
    plan = _plan(args, loop, wish)
    out = out_folder(args, "limits")
    beside = BESIDE[args.beside]
    designers = {"optimal": remembered(optimum, True)}
    designers |= {name: remembered(spring_damper(name), False) for name in beside}
    begin = time.perf_counter()
    curves, interrupted = _curves(plan, designers)
    head |= {"case": args.case, "objective": wish.objective, "delays_kept_in": args.keep, "wish": asdict(wish)}
    outcome = head | {
        "here": {"delta": list(loop.delta), "theta": list(loop.theta), "psi": list(loop.psi), "T_s": loop.T},
        "sweeps": {name: _sweep(name, plan[name], rows) for name, rows in curves.items()},
        "gains": gains(plan, curves, loop, wish),
        "wall_s": time.perf_counter() - begin,
        "interrupted": interrupted,
    }
    outcome["files"] = _save(args, out, outcome)
    print_curves(outcome, BESIDE[args.beside], console(args))
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    found = any(row["rms_mismatch_db"] is not None for s in outcome["sweeps"].values() for row in s["optimal"])
    return DONE if found else DOES_NOT_HOLD


def _parser() -> Parser:
    example = "python -m design.limits --over damping=0.7:10,delay --points 5"
    what = "The best mismatch that any linear coupling reaches, against damping, delay, period and order."
    parser = Parser("design.limits", what, example)
    add_loop_options(parser)
    curve = parser.add_argument_group("the curve")
    names = ",".join(AXES)
    curve.add_argument(
        "--over", default=names, metavar="NAME[=LOW:HIGH],..", help=f"what is varied, of {names} (default all)"
    )
    curve.add_argument("--points", default="6", metavar="N", help="designs of each sweep (default 6)")
    curve.add_argument("--keep", choices=("samples", "seconds"), default="samples", help="delays, as the period varies")
    curve.add_argument("--beside", choices=tuple(BESIDE), default="both", help="spring-dampers drawn (default both)")
    curve.add_argument("--no-plot", action="store_true", help="write no picture")
    ladder = parser.add_argument_group("instead of the curve")
    ladder.add_argument(
        "--ladder",
        nargs="?",
        const="short",
        choices=tuple(LADDERS),
        help="every design side by side, cases I and II (full: minutes)",
    )
    wish = parser.add_argument_group("the optimal coupling")
    wish.add_argument("--functions", metavar="N", default="10", help="basis functions of each entry of Q (default 10)")
    wish.add_argument("--filter", choices=FILTERS, default="mixed", help="poles of the basis (default mixed)")
    wish.add_argument("--objective", choices=OBJECTIVES, default="rms", help="the mismatch minimised and drawn")
    wish.add_argument("--high-gain", metavar="G", default="1.5", help="of |F|/|E| above 100 Hz, or none (default 1.5)")
    wish.add_argument("--margin", metavar="SHARE", default="0.005", help="of the damping that stays unused")
    wish.add_argument("--diagonal", action="store_true", help="Q of separate channels (default: full)")
    add_output_options(parser)
    return parser


def _wish(args: argparse.Namespace) -> Wish:
    high_gain = None if args.high_gain == "none" else numbers("--high-gain", args.high_gain, float, 1)[0]
    (functions,) = numbers("--functions", args.functions, int, 1)
    (margin,) = numbers("--margin", args.margin, float, 1)
    try:
        return Wish(functions, args.filter, args.diagonal, args.objective, high_gain, margin)
    except ValueError as error:
        raise InputError(as_option(error, args)) from None


def _only_the_ladder(args: argparse.Namespace, parser: Parser) -> None:
    """Raises InputError where an option is given that the ladder would have to ignore."""
    if args.case != parser.get_default("case"):
        raise InputError(f"--ladder shows both cases: leave out --case {args.case}")
    for name in OF_THE_CURVE:
        if getattr(args, name) != parser.get_default(name):
            raise InputError(f"--{name.replace('_', '-')} is for the curve, not for --ladder")


def _plan(args: argparse.Namespace, loop: Loop, wish: Wish) -> dict[str, list[Setting]]:
    """The settings of every sweep that is asked for. Raises InputError."""
    (points,) = numbers("--points", args.points, int, 1)
    if not 1 <= points <= MOST_POINTS:
        raise InputError(f"--points is {points}, allowed are 1 to {MOST_POINTS}")
    plan = {}
    for part in args.over.split(","):
        name, _, text = part.partition("=")
        if name not in AXES:
            raise InputError(f"--over has {name!r}, allowed are {', '.join(AXES)}")
        try:
            span = _span(name, text) if text else None
            plan[name] = settings(name, loop, wish, points, span, args.keep)
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"--over {part}: {error}") from None
    return plan


def _span(name: str, text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    if not colon:
        raise InputError(f"--over {name}={text}: expected LOW:HIGH in {AXES[name].unit}")
    return numbers(f"--over {name}", low, float, 1)[0], numbers(f"--over {name}", high, float, 1)[0]


def _curves(plan: dict[str, list[Setting]], designers: dict[str, Designer]) -> tuple[Curves_report, bool]:
    """Every design at every setting; what is done when the keyboard interrupts is kept."""
    curves: Curves_report = {}
    total = len(designers) * sum(map(len, plan.values()))
    bar, move = progress_bar("designing")
    with bar:
        done = 0
        try:
            for name, along in plan.items():
                curves[name] = {kind: [] for kind in designers}
                for setting in along:
                    for kind, designer in designers.items():
                        move(done, total)
                        curves[name][kind].append(designer(setting))
                        done += 1
        except KeyboardInterrupt:
            return curves, True
    return curves, False


def _sweep(name: str, along: Sequence[Setting], rows: dict[str, list[Limit]]) -> dict[str, Any]:
    axis = AXES[name]
    points = {kind: [asdict(limit) for limit in limits] for kind, limits in rows.items()}
    return {"label": axis.label, "unit": axis.unit, "values": [s.value for s in along]} | points


def _save(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[str]:
    files = [out / "report.json"]
    if not args.no_plot and any(sweep["optimal"] for sweep in outcome["sweeps"].values()):
        from sim.plots import plot_limits

        files.append(plot_limits(outcome, out / "limits.png"))
    write_json(files[0], outcome | {"files": [str(p) for p in files]})
    return [str(p) for p in files]


def _ladder(args: argparse.Namespace, loops: dict[str, Loop], head: dict[str, Any]) -> int:
    """Print and write the table of designs."""
    out, begin = out_folder(args, "ladder"), time.perf_counter()
    bar, move = progress_bar("designing")
    with bar:
        rows, interrupted = climb(loops, LADDERS[args.ladder], move)
    outcome = head | {"rows": [asdict(row) for row in rows], "wall_s": time.perf_counter() - begin}
    outcome |= {"interrupted": interrupted, "files": [str(out / "report.json")]}
    write_json(out / "report.json", outcome)
    print_ladder(outcome, tuple(loops), console(args))
    if args.json:
        write_json(args.json, outcome)
    return INTERRUPTED if interrupted else DONE


MOST = 6  # curves that can be told apart in one panel


def main_plot(argv: list[str]) -> int:
    """Draw couplings over frequency. 0: all of them, 1: some could not be designed."""
    args = _parser_plot().parse_args(argv)
    seed = seed_from(args)
    scenario = scenario_from(args)
    names = _names(args)
    out = out_folder(args, "plot")
    chosen, failed = _chosen(scenario, args, names)

    loop = scenario.loop(args.case)
    outcome = {"case": args.case, "scenario": scenario.name, "seed": seed} | _data(loop, chosen)
    outcome["notes"] = [*(f"{name}: {note}" for name, c in chosen.items() for note in c.notes), *failed]
    outcome["notes"] += _reasons(outcome["couplings"])
    outcome["files"] = [str(path) for path in _save_plot(args, out, outcome)]
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


def _parser_plot() -> Parser:
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


def _coupling_data(judged: Judged, lines: Curves_curves) -> dict[str, Any]:
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


def _save_plot(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[Path]:
    files = [out / "curves.json"]
    if not args.no_plot:
        from sim.plots import plot_perceived, plot_required_damping, plot_singular_values

        files.append(plot_singular_values(outcome, out / "singular-values.png"))
        files.append(plot_required_damping(outcome, out / "required-damping.png"))
        files.append(plot_perceived(outcome, out / "perceived.png"))
    write_json(files[0], outcome | {"files": [str(p) for p in files]})
    return files
