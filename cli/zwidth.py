"""python -m sim.zwidth: map which K and B are certified, stable with random humans, and stable in MuJoCo (Z-width).

Flow of data: options -> CouplingSweep or EnvironmentSweep -> Grid -> Map -> files
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import msgspec
import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli.painter import skip_docstrings
from haptic_loop.cli.verdict import assessment_of, chosen_by
from haptic_loop.controller.lti import Array
from haptic_loop.design.designs import name_and_own
from haptic_loop.design.result import MAKING, Chosen, Requirement
from haptic_loop.sim import zwidth
from haptic_loop.sim.couplings import NAMES
from haptic_loop.sim.limit_cycles import UNDECIDED, HeldDevices, Plan
from haptic_loop.sim.scenario import (
    InputError,
    Scenario,
    require_constant_delay,
    require_no_world,
    require_scaled_hands,
)
from haptic_loop.sim.zwidth_report import FixedCoupling, MapReport, Shown, save_csv

_EXAMPLES = (
    "python -m sim.zwidth --rigid --T 1e-3 --theta 0 --mark 5000,0",
    "python -m sim.zwidth --coupling optimal --grid 10",
)
_FINEST = 1e-5  # [m] least amplitude of an oscillation at the hand: the resolution of a desk device's encoders
_PRESS = 3.0  # [N] steady force of a hand; 0 in maps of environments, because a soft environment would yield


def main(argv: list[str]) -> int:
    """Draw a map. Return 0 if nothing contradicts it and every mark is certified, else 1; 130 if interrupted."""
    args = _parser().parse_args(argv)
    of_coupling = args.coupling is None
    scenario = options.scenario_from(args)
    require_no_world(scenario, "sim.zwidth")
    require_constant_delay(scenario, "sim.zwidth")
    require_scaled_hands(scenario)
    if scenario.period is not None:
        raise InputError("period: a map simulates constant periods; give T_max alone, up to which certificates hold")
    if args.case == "none":
        instead = "use --case I, or --coupling none for a map over environments"
        raise InputError(f"--case none is the loop without coupling, so there is nothing to map: {instead}")
    if args.case == "II" and of_coupling:
        raise InputError(
            "--case II is allowed only with --coupling: a map of spring-dampers is compared with no reference"
        )
    chosen = chosen_by(args, scenario) if args.coupling else None
    sweep, fixed = _sweep(args, scenario, chosen), None
    if chosen:
        assessment = assessment_of(args, scenario, chosen)
        needs = assessment.requirements
        notes = chosen.remarks(needs) if chosen.fails(needs) else chosen.notes
        fixed = FixedCoupling.of(chosen, assessment, scenario.loop(args.case).network, notes)
    marks = tuple(args.mark)
    args.grid = args.grid or (60 if of_coupling and not sweep.walls else 24)
    grid = zwidth.make_grid(sweep, args.grid, args.K_range, args.B_range, marks)
    plan, out = _plan(args, sweep, of_coupling, scenario.lever), options.out_folder(args, "zwidth")

    crowd = HeldDevices.drawn(
        sweep.devices, sweep.population, sweep.loop.T, args.seed, args.humans, latency=sweep.loop.latency
    )
    with render.progress("certificates") as move:
        drawn = zwidth.draw_map(sweep, grid, crowd, plan, lambda stage, k, of: move(k, of, stage))
    points = [] if drawn.interrupted else [zwidth.evaluate_point(sweep, crowd, K, B, grid.K) for K, B in marks]
    report = MapReport.of(scenario, sweep, drawn, plan, fixed, points, args.humans, args.seed)
    render.remove_earlier(out, "map.csv", "zwidth.png")
    files = [save_csv(drawn, out / "map.csv")]
    if not args.no_plot:
        skip_docstrings()
        from haptic_loop.sim.map_plot import plot_zwidth

        files.append(plot_zwidth(drawn, report, out / "zwidth.png"))
    title = f"{_span(grid.K)} N/m, B {_span(grid.B)} N s/m, {report.cells} cells"
    from haptic_loop.sim.report import friction_left_out

    unseen = friction_left_out(sweep.devices) if report.simulation.points else ()
    table = render.facts(f"K {title}", _rows(report), left=True)
    lines = [*_marked(report), *_remarks(report), *unseen]
    render.publish(args, report, [table], lines, out, files, _verdict(report))
    return options.exit_code(report.holds, drawn.interrupted)


def _parser() -> options.Parser:
    what = "Draw the Z-width map: which K and B are certified, and which are stable with random humans and in MuJoCo."
    parser = options.Parser("sim.zwidth", what, *_EXAMPLES, first="scenario rigid coupling mark grid out")
    parser.add_loop()
    parser.add_rigid()
    of_map = parser.add_argument_group("the map (K and B are the same on all channels)")
    fixed = "keep this coupling and vary K and B of the environment's contact springs"
    names = f"{', '.join(NAMES)} or FILE.json (default: map K and B of a spring-damper)"
    of_map.add_argument("--coupling", metavar="NAME|FILE", help=f"{fixed}: {names}")
    parser.add_condition(
        "condition to design for, with --coupling (default: the coupling's); one of your own is drawn in every map",
        to=of_map,
    )
    rows = "rows and columns (default 60; 24 with --coupling or walls)"
    of_map.add_argument("--grid", type=options.whole(4, 400), metavar="N", help=rows)
    K, B = "K [N/m] (default from delta, theta and T, or from the contact springs)", "B [N s/m] (default from delta)"
    of_map.add_argument("--K-range", type=options.pair, metavar="LOW,HIGH", help=K)
    of_map.add_argument("--B-range", type=options.pair, metavar="LOW,HIGH", help=B)
    mark = "also judge and mark this point (repeatable)"
    of_map.add_argument("--mark", type=_mark, action="append", default=[], metavar="K,B", help=mark)
    humans = "random humans per device (default 200)"
    of_map.add_argument("--humans", type=options.whole(1, 100_000), default=200, metavar="N", help=humans)
    points = parser.add_argument_group("the points simulated in MuJoCo")
    rows = "rows and columns of simulated points (default 10; 0: none)"
    points.add_argument("--points", type=options.whole(0, 400), metavar="N", default=10, help=rows)
    points.add_argument(
        "--duration", type=options.number(), metavar="SECONDS", default=3.0, help="length of each run (default 3)"
    )
    parser.add_output(picture=True)
    parser.set_defaults(limiter=None)  # There is no --no-limiter, because the simulated motors never clip.
    parser.only("with simulated points: --points 0 has none", lambda args: args.points, "duration")
    designed = "with --coupling, or for a condition of your own"
    parser.only(designed, lambda args: args.coupling or name_and_own(args.condition)[1], "condition")
    gains = "for a map of spring-dampers: with --coupling the map varies the environment"
    parser.only(gains, lambda args: args.coupling is None, "rigid")
    compared = "with --coupling: a map of spring-dampers is compared with no reference"
    parser.only(compared, lambda args: args.coupling, "lam", "reference")
    return parser


def _mark(text: str) -> tuple[float, float]:
    K, B = options.pair(text)
    if not (1e-3 <= K <= 1e9 and 0 <= B <= 1e6):
        raise argparse.ArgumentTypeError(f"is {K:g},{B:g}, allowed are K 1e-3 to 1e9 N/m, B 0 to 1e6 N s/m")
    return K, B


def _sweep(args: argparse.Namespace, scenario: Scenario, chosen: Chosen | None) -> zwidth.Sweep:
    """Return a sweep over couplings of a loop, or over environments of one coupling. Raises InputError."""
    devices, loop = scenario.axis_devices, scenario.loop("I")
    if loop.axes:
        raise InputError(
            f"device #1.axes: sim.zwidth maps devices of one axis, these have {loop.axes[0]}; clamp the others"
        )
    if args.rigid:
        devices, loop = devices[:1], options.rigid_loop(args, scenario)
    loop = msgspec.structs.replace(loop, ranges=None, varying_delay=None)
    with options.refused():
        if chosen:
            return zwidth.EnvironmentSweep(devices, scenario.population, loop, chosen.coupling, own=chosen.own)
        return zwidth.CouplingSweep(devices, scenario.population, loop, own=name_and_own(args.condition)[1])


def _plan(args: argparse.Namespace, sweep: zwidth.Sweep, of_coupling: bool, lever: float) -> Plan:
    coarsest = max(float(np.max(device.encoder_step)) for device in sweep.devices)
    threshold = max(2 * coarsest, _FINEST / lever)
    shortest = max(1.5, 1024 * sweep.loop.T)
    if not shortest <= args.duration <= 1e4:
        raise InputError(f"--duration is {args.duration:g}, allowed are {shortest:g} to 10000 s")
    return Plan(args.points, lever * _PRESS * of_coupling, args.duration, threshold, Plan.start / lever)


# ---- the map in a few lines on the terminal


def _verdict(report: MapReport) -> str:
    """State the share of the map that each condition certifies, and the share that is stable with random hands."""
    shares = ", ".join(f"{_share(report.ratios[name].certified_cells, report)} ({name})" for name in report.conditions)
    crowd = report.population
    return (
        f"Certified: {shares}. Stable with all of {crowd.humans} random humans: {_share(crowd.stable_cells, report)}."
    )


def _rows(report: MapReport) -> render.Rows:
    crowd, simulation = report.population, report.simulation
    if report.fixed:
        yield from _designed_rows(report.fixed)
    for name in report.conditions:
        error = (report.error or {}).get(name)
        near = (
            f"; separate sweeps move its edge by at most {100 * error.edge_relative_in_K:.2g} % in K" if error else ""
        )
        yield f"certified, {name}", f"{_share(report.ratios[name].certified_cells, report)}{near}"
    stable = f"{_share(crowd.stable_cells, report)} ({crowd.decided_cells} cells decided)"
    yield f"stable with all of {crowd.humans} random humans", stable
    if simulation.points:
        beside = f"{simulation.undecided} {UNDECIDED}, {simulation.differ_from_linear} unlike the linear loop"
        ends = f"{simulation.oscillate} of {len(simulation.points)} oscillate, {beside}"
        yield f"simulated{_effects(simulation.effects)}", ends
    yield "seconds", ", ".join(f"{stage} {wall:.1f}" for stage, wall in report.wall_s.items()) or "-"


def _share(count: int, report: MapReport) -> str:
    return f"{100 * count / report.cells:.1f} % of the map"


def _designed_rows(fixed: FixedCoupling) -> render.Rows:
    """Yield the rows of a fixed coupling in the scenario's environment."""
    requirements, guarantee = fixed.assessment.requirements, fixed.assessment.guarantee_words
    needs = "; ".join(
        f"{name} needs {100 / need.margin:.4g} % of the damping ({need.proof})"
        for name, need in requirements.items()
        if need.margin
    )
    yield "coupling", f"{fixed.kind}, fixed"
    yield (
        "scenario's springs",
        ", ".join(f"{' - '.join(s.between)} {s.K:g} N/m, {s.B:g} N s/m" for s in fixed.contact_springs),
    )
    yield (
        "in the scenario's environment",
        f"guarantee: {guarantee or 'none'}; {needs or 'no damping is enough'}",
    )


def _effects(effects: Shown) -> str:
    on = {
        "encoder steps": any(effects.encoder_step_m),
        "friction": any(effects.friction_n),
        "walls": effects.walls,
    }
    names = [name for name, present in on.items() if present]
    return f" with {', '.join(names)}" if names else ", linear loop"


def _marked(report: MapReport) -> Iterator[str]:
    for mark in report.marks or ():
        stiffest = mark.stiffest_K_at_this_B
        ends = ", ".join(f"{name} {_limit(K)}" for name, K in stiffest.items())
        needs = ", ".join(f"{name} {_needs(mark.requirements[name])}" for name in stiffest if name != "population")
        met = f"{mark.unstable_humans} of {report.population.humans} humans make it unstable"
        yield f"K {mark.K:g}, B {mark.B:g}: {needs}; {met}; stiffest at this B: {ends}"


def _limit(K: float | str | None) -> str:
    return "none" if K is None else K if isinstance(K, str) else f"{K:.5g} N/m"


def _needs(need: Requirement) -> str:
    worst, least = max(need.required), min(need.available)
    return f"needs {worst:.6g} of {least:.6g} N s/m ({render.certified(need, proof=False)})"


def _remarks(report: MapReport) -> Iterator[str]:
    simulation = report.simulation
    if report.fixed:
        yield from report.fixed.remarks
        yield "K and B belong to every contact spring; a sweep certifies each cell for its environment alone."
    if report.claim:
        yield f"{report.claim}."
    for name in report.conditions:
        ratio = report.ratios[name]
        if ratio.reason:
            yield f"{name}: {ratio.reason}."
        if ratio.contradicted_cells:
            yield f"[red]CONTRADICTION[/]: {ratio.contradicted_cells} certified cells are unstable."
    if any(simulation.effects.encoder_step_m):
        yield "Guarantees are for exact positions: sim.run judges the encoder steps."
    if simulation.contradicts:
        yield f"[red]DISAGREEMENT[/]: MuJoCo and the linear loop at {simulation.differ_from_linear} points."
    if report.walls:
        yield (
            f"Walls: this-environment covers {MAKING}. The growth with random humans is computed for each "
            "fixed set of touching walls; in the simulations contact makes and breaks."
        )
    if report.interrupted:
        yield "Interrupted: the map shows the finished parts."


def _span(axis: Array) -> str:
    return f"{axis[0]:.4g} to {axis[-1]:.4g}"
