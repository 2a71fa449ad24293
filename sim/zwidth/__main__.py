"""python -m sim.zwidth: the K-B map that haptics people draw - certified, exact for random humans, simulated.

options -> the loop (Ground: K and B are the coupling's; Surroundings: the environment's) -> Grid -> Map -> files
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from design.assess import CONDITIONS, assess
from design.box.check import check_set, set_part
from design.condition.environment_map import contact_springs
from design.promises import certificate_part, promise_of
from design.summary import coupling_part
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    add_rigid_option,
    console,
    execute,
    numbers,
    out_folder,
    progress_bar,
    require_constant_delay,
    rigid_loop,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES, Chosen, choose
from sim.files import write_json
from sim.scenario import InputError, Scenario
from sim.zwidth import report as zwidth_report
from sim.zwidth.grid import Grid, Range, make_grid
from sim.zwidth.ground import Ground, one_sided
from sim.zwidth.loop import MapLoop
from sim.zwidth.map import Map, draw_map
from sim.zwidth.marks import look, truth
from sim.zwidth.population import holders
from sim.zwidth.simulation import Effects, Plan
from sim.zwidth.surroundings import Surroundings
from sim.zwidth.text import print_map

EXAMPLE = """python -m sim.zwidth --theta 1 --grid 30
  python -m sim.zwidth --rigid --T 1e-3 --theta 0 --mark 5000,0
  python -m sim.zwidth --rigid --theta 1 --quantisation 1e-5 --saturation --friction 0.2 --wall"""
FINEST = 1e-5  # [m] least default threshold: what a desk device's encoders resolve


def main(argv: list[str]) -> int:
    """Draw a map. 0: nothing contradicts it and every mark is certified, 1: else, 130: interrupted."""
    args = _parser().parse_args(argv)
    of_coupling = args.coupling is None
    args.grid, args.press = args.grid or ("60" if of_coupling else "24"), args.press or ("3" if of_coupling else "0")
    scenario = scenario_from(args)
    require_constant_delay(scenario, "sim.zwidth")
    _check_case(args)
    seed, humans = seed_from(args), _whole(args, "humans", 1, 100_000)
    marks = tuple(_pair("--mark", mark) for mark in args.mark or ())
    chosen = _chosen(args, scenario)
    ground: MapLoop = _surroundings(scenario, chosen) if chosen else _ground(args, scenario)
    grid = _grid(args, ground, marks)
    plan = _plan(args, ground)
    out = out_folder(args, "zwidth")

    crowd = holders(ground.devices, ground.population, seed, humans, ground.population.links, ground.T)
    bar, moved = progress_bar("certificates")
    with bar:
        drawn = draw_map(
            ground,
            grid,
            crowd,
            plan,
            lambda stage, k, of: moved(k, of) or bar.update(bar.task_ids[0], description=stage),
        )
    outcome = zwidth_report.outcome(ground, drawn, plan, {"humans": humans, "seed": seed})
    outcome |= {"scenario": None if args.rigid else scenario.name, "scenario_digest": scenario.digest}
    outcome |= _coupling(args, scenario, chosen, seed) if chosen else {"axes": "coupling", "coupling": None}
    if not drawn.interrupted:
        zwidth_report.add_truth(outcome, {name: truth(ground, drawn, name) for name in drawn.ratio})
        zwidth_report.add_marks(outcome, [look(ground, crowd, *mark, grid.K) for mark in marks])
    _save(args, ground, drawn, outcome, out)
    print_map(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    if drawn.interrupted:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser("sim.zwidth", "Draw the K-B map: which spring-dampers are safe, for whom, by which test.", EXAMPLE)
    add_loop_options(parser)
    add_rigid_option(parser)
    of_map = parser.add_argument_group("the map (K and B are the same on all channels)")
    names = ", ".join(NAMES)
    fixed = f"this coupling, fixed, and K and B of the environment's contact springs on the axes: {names} or FILE.json"
    of_map.add_argument("--coupling", metavar="NAME|FILE", help=f"{fixed} (default: K and B of the coupling)")
    of_map.add_argument("--condition", choices=CONDITIONS, help="that such a coupling is designed for")
    of_map.add_argument("--grid", metavar="N", help="rows and columns (default 60; 24 with --coupling)")
    of_map.add_argument("--K-range", metavar="LOW,HIGH", help="[N/m]; default from delta, theta and T")
    of_map.add_argument("--B-range", metavar="LOW,HIGH", help="[N s/m]; default from delta")
    of_map.add_argument("--scale", choices=("linear", "log"), help="default linear with --rigid, else log")
    of_map.add_argument("--mark", action="append", metavar="K,B", help="where does this coupling lie? (repeatable)")
    of_map.add_argument("--humans", default="200", metavar="N", help="random humans per device (default 200)")
    of_map.add_argument("--no-plot", action="store_true", help="write no picture")
    points = parser.add_argument_group("the points simulated in MuJoCo, and what they have beside the linear loop")
    points.add_argument("--points", default="10", metavar="N", help="rows and columns of them (default 10, 0 for none)")
    points.add_argument("--trials", default="1", metavar="N", help="humans at each, the most critical (default 1)")
    points.add_argument("--duration", default="3", metavar="SECONDS", help="of each (default 3)")
    points.add_argument(
        "--start", default="1e-3", metavar="METRES", help="first swing of motor or handle (default 1e-3)"
    )
    pressing = "steady force of every hand (default 3; 0 with --coupling, whose soft environments give way to it)"
    points.add_argument("--press", metavar="NEWTONS", help=pressing)
    points.add_argument("--threshold", metavar="METRES", help="amplitude of an oscillation (default 2 steps or 1e-5)")
    points.add_argument("--quantisation", metavar="METRES", help="encoder step of every device")
    points.add_argument("--saturation", action="store_true", help="motors have their force limits")
    points.add_argument("--friction", metavar="NEWTONS", help="Coulomb friction of every device")
    points.add_argument("--wall", action="store_true", help="contacts push and never pull")
    points.add_argument(
        "--velocity-filter", metavar="HERTZ", help="first-order cut-off of the damped velocity; in all maps"
    )
    add_output_options(parser)
    return parser


def _check_case(args: argparse.Namespace) -> None:
    """Whether the options ask for a map of one kind. Raises InputError."""
    if args.case == "none":
        instead = "use --case I, or --coupling none for a map over environments"
        raise InputError(f"--case none is the loop without coupling, and the map is of couplings: {instead}")
    if args.coupling is None and args.condition:
        raise InputError(f"--condition {args.condition}: without --coupling nothing is designed, and both are drawn")
    for name in ("rigid", "wall", "velocity_filter"):
        if args.coupling is not None and getattr(args, name):
            what = "is about a map of spring-dampers; with --coupling the axes are the environment's"
            raise InputError(f"--{name.replace('_', '-')} with --coupling {args.coupling}: it {what}")


def _chosen(args: argparse.Namespace, scenario: Scenario) -> Chosen | None:
    """The coupling that stays as it is over the whole map, or None where the axes are the coupling's own gains."""
    if args.coupling is None:
        return None
    if args.coupling == "optimal" and scenario.environment.walls:
        raise InputError("environment.walls: an optimal coupling holds a linear model, so it cannot face walls")
    return choose(scenario, args.case, args.coupling, args.condition)


def _surroundings(scenario: Scenario, chosen: Chosen) -> Surroundings:
    """The loop with that coupling. Raises InputError."""
    who = scenario.device, scenario.population
    try:
        return Surroundings(*who, scenario.environment, scenario.T, scenario.theta, scenario.psi, chosen.coupling)
    except ValueError as error:
        raise InputError(str(error)) from None


def _coupling(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, seed: int) -> dict[str, Any]:
    """The fixed coupling and what is promised of it where it was designed, in the scenario's own environment."""
    loop = scenario.loop(args.case)
    with (bar := progress_bar("searching the box"))[0]:
        whole = check_set(loop, chosen.coupling, seed, progress=bar[1])
    requirements = assess(loop, chosen.coupling, chosen.phi)
    springs = contact_springs(loop.environment)
    return {
        "axes": "environment",
        "coupling": coupling_part(chosen.kind, chosen.coupling, scenario.T),
        "designed_for": {
            "contact_springs": [{"between": s.between, "K": s.stiffness, "B": s.damping} for s in springs],
            "certificates": {name: certificate_part(r) for name, r in requirements.items()},
            "promise": promise_of(requirements, loop, bool(whole and whole.proved)),
            "set": whole and set_part(whole),
        },
        "remarks": list(chosen.notes),
    }


def _ground(args: argparse.Namespace, scenario: Scenario) -> Ground:
    """The loop without its coupling. Raises InputError."""
    cutoff = None
    if args.velocity_filter is not None:
        cutoff = _number(args, "velocity_filter", 1e-3, 1e6, "Hz")
    loop: dict[str, Any] = {"network": scenario.environment, "theta": scenario.theta, "psi": scenario.psi}
    devices = scenario.device
    try:
        if args.rigid:
            loop, devices = {"network": None, **rigid_loop(args, scenario)}, devices[:1]
        elif args.wall:
            loop["network"] = one_sided(scenario.environment)
        return Ground(
            devices, scenario.population, T=scenario.T, cutoff=cutoff, one_sided=args.rigid and args.wall, **loop
        )
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(str(error)) from None


def _grid(args: argparse.Namespace, ground: MapLoop, marks: tuple[Range, ...]) -> Grid:
    K, B = (
        None if getattr(args, f"{name}_range") is None else _pair(f"--{name}-range", getattr(args, f"{name}_range"))
        for name in "KB"
    )
    for stiffness, damping in marks:
        if not (1e-3 <= stiffness <= 1e9 and 0 <= damping <= 1e6):
            raise InputError(f"--mark is {stiffness:g},{damping:g}, allowed are K 1e-3 to 1e9 N/m, B 0 to 1e6 N s/m")
    return make_grid(ground, _whole(args, "grid", 4, 400), K, B, args.scale, marks)


def _plan(args: argparse.Namespace, ground: MapLoop) -> Plan:
    step = None if args.quantisation is None else _number(args, "quantisation", 0, 1e-2, "m")
    friction = None if args.friction is None else _number(args, "friction", 0, 1e3, "N")
    effects = Effects(step, friction, args.saturation)
    coarsest = max(device.encoder_step for device in effects.on(ground.devices))
    threshold = max(2 * coarsest, FINEST) if args.threshold is None else _number(args, "threshold", 1e-9, 1, "m")
    duration = _number(args, "duration", max(1.5, 1024 * ground.T), 1e4, "s")
    trials, points = _whole(args, "trials", 1, 100), _whole(args, "points", 0, 400)
    start, press = _number(args, "start", 1e-9, 1, "m"), _number(args, "press", 0, 1e3, "N")
    return Plan(effects, points, trials, start, press, duration, threshold)


def _save(args: argparse.Namespace, ground: MapLoop, drawn: Map, outcome: dict[str, Any], out: Path) -> None:
    """The picture, the table and the report; `outcome` learns where they are."""
    files = [zwidth_report.save_csv(drawn, out / "map.csv")]
    if not args.no_plot:
        from sim.plot_zwidth import plot_zwidth

        files.append(plot_zwidth(drawn, outcome, out / "zwidth.png"))
    outcome["files"] = [str(path) for path in (*files, out / "report.json")]
    write_json(out / "report.json", outcome)


def _whole(args: argparse.Namespace, name: str, least: int, most: int) -> int:
    (value,) = numbers(f"--{name}", getattr(args, name), int, 1)
    if not least <= value <= most:
        raise InputError(f"--{name} is {value}, allowed are {least} to {most}")
    return value


def _number(args: argparse.Namespace, name: str, least: float, most: float, unit: str) -> float:
    option = f"--{name.replace('_', '-')}"
    (value,) = numbers(option, getattr(args, name), float, 1)
    if not least <= value <= most:
        raise InputError(f"{option} is {value:g}, allowed are {least:g} to {most:g} {unit}")
    return value


def _pair(option: str, text: str) -> Range:
    if text.count(",") != 1:
        raise InputError(f"{option} is {text!r}, expected two numbers separated by a comma")
    first, second = numbers(option, text, float, 2)
    return first, second


if __name__ == "__main__":
    execute(main)
