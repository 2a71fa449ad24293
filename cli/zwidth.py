"""python -m sim.zwidth: the Z-width map (K-B plane): certified, exact for random humans, simulated.

options -> CouplingSweep or EnvironmentSweep: whose K and B -> Grid -> Map -> files
"""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from cli import options, render
from cli.judged import judge
from controller.environment import RIGID_WALL
from controller.loop import Loop
from design.files import write
from design.guarantees import CAVEATS
from design.result import CONDITIONS, certificate_part
from sim import zwidth
from sim.couplings import NAMES, Chosen, choose
from sim.limit_cycles import DECIDED, UNDECIDED, Effects, HeldDevices, Plan
from sim.scenario import InputError, Scenario, require_constant_delay
from sim.stability import MARGINAL
from sim.trace import SUSTAINED, slowest_seen

# ----------------------------------------------------------------------------------------------------
# What a Z-width map says, in a few lines on the terminal.


def _table(report: _Report) -> Table:
    K, B = report.grid["K"], report.grid["B"]
    title = f"K {K[0]:.4g} to {K[-1]:.4g} N/m, B {B[0]:.4g} to {B[-1]:.4g} N s/m, {report.cells} couplings"
    return render.facts(title, report.rows(), left=True)


def _designed_rows(fixed: dict[str, Any], limited: list[float] | None) -> render.Rows:
    """The fixed coupling in the environment that it was designed for."""
    designed = fixed["designed_for"]
    each = (f"{' - '.join(s['between'])} {s['K']:g} N/m, {s['B']:g} N s/m" for s in designed["contact_springs"])
    needs = "; ".join(
        f"{name} needs {100 / designed['certificates'][name]['margin']:.4g} % of the damping "
        f"({designed['certificates'][name]['proof']})"
        for name in CONDITIONS
        if designed["certificates"][name]["margin"]
    )
    yield "coupling", f"{fixed['coupling']['kind']}, fixed"
    yield "designed for", ", ".join(each)
    yield "there", f"guarantee: {designed['promise'] or 'none'}; {needs or 'no damping is enough'}"
    yield "force limits there", fixed["limiter"]["words"] if limited else None


def _about(conditions: Sequence[str]) -> str:
    """What the axes are, and what a certified cell guarantees."""
    line = "K and B are those of every spring at a contact; each is certified for its environment alone, by a sweep"
    if zwidth.MODEL_KEPT not in conditions:
        return f"{line}."
    return (
        f"{line}: this-environment, the population and MuJoCo with the coupling's model set to the cell's environment, "
        f"{zwidth.MODEL_KEPT} with the model left at what the coupling was designed for."
    )


def _mark_line(mark: dict[str, Any], humans: int) -> str:
    ends = ", ".join(f"{name} {_stiffest(K)}" for name, K in mark["stiffest_K_at_this_B"].items())
    needs = ", ".join(
        f"{name} needs {max(mark[name]['required_damping'], key=lambda d: d or np.inf) or np.inf:.6g} of "
        f"{min(mark[name]['available_damping']):.6g} N s/m "
        f"({'[green]certified[/]' if mark[name]['certified'] else '[red]not certified[/]'})"
        for name in mark["stiffest_K_at_this_B"]
        if name != "population"
    )
    met = f"{mark['unstable_humans']} of {humans} humans make it unstable"
    return f"K {mark['K']:g}, B {mark['B']:g}: {needs}; {met}; stiffest at this B: {ends}"


def _stiffest(K: float | str | None) -> str:
    return "none" if K is None else K if isinstance(K, str) else f"{K:.5g} N/m"


def _effects(simulation: dict[str, Any]) -> str:
    effects = simulation["effects"]
    on = {
        "quantisation": any(effects["encoder_step_m"]),
        "friction": any(effects["friction_n"]),
        "saturation": effects["force_limit_n"] is not None,
        "one-sided contact": effects["one_sided"],
    }
    names = [name for name, present in on.items() if present]
    return f" with {', '.join(names)}" if names else ", linear loop"


def _remarks(report: _Report) -> list[str]:
    lines = []
    simulation = report.simulation
    if report.fixed["axes"] == "environment":
        lines += [*report.fixed["remarks"], _about(report.conditions)]
    for name in report.conditions:
        if report.ratios[name].get("reason"):
            lines.append(f"{name}: {report.ratios[name]['reason']}.")
        if report.ratios[name].get("contradicted_cells"):
            lines.append(
                f"[red]CONTRADICTION[/]: {report.ratios[name]['contradicted_cells']} certified cells are unstable."
            )
    if not simulation["nonlinear"] and simulation["differ_from_linear"]:
        lines.append(f"[red]DISAGREEMENT[/]: MuJoCo and the linear loop at {simulation['differ_from_linear']} points.")
    if report.velocity_filter_hz:
        lines.append("The velocity filter is in all maps: it is linear, and part of the coupling.")
    if report.one_sided:
        lines.append(
            "One-sided contact: this-environment and the population are about each frozen contact state, "
            "any-environment (psi = 0) and the simulated points about contact made and broken."
        )
    if simulation["points"]:
        lines.append(
            f"A simulated point oscillates if, at the end of {simulation['duration_s']:g} s, an octave above "
            f"{simulation['from_hz']:.3g} Hz keeps {100 * SUSTAINED:g} % of its amplitude, over "
            f"{simulation['threshold_m']:g} m; {UNDECIDED} where the linear loop is within {DECIDED:g} 1/s of the edge."
        )
    if report.interrupted:
        lines.append("Interrupted: the map has what was finished.")
    return lines


def _share(count: int, cells: int) -> str:
    return f"{100 * count / cells:.1f} % of the map"


# ----------------------------------------------------------------------------------------------------
# A Z-width map as JSON and CSV.


_NOT_REACHED = "not reached before the interruption"


@dataclass(frozen=True, eq=False)
class _Report:
    """The whole map. Rows are stiffnesses; null is infinite, or not reached before an interruption."""

    rigid: bool
    scenario: str | None
    scenario_digest: str
    T: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    delta: tuple[float, ...]
    velocity_filter_hz: float | None
    one_sided: bool
    conditions: list[str]
    grid: dict[str, Any]
    population: dict[str, Any]
    simulation: dict[str, Any]
    holds: bool
    interrupted: bool
    wall_s: dict[str, float]
    ratios: dict[str, dict[str, Any]] = render.unseen("beside")
    fixed: dict[str, Any] = render.unseen("beside")  # of a map over environments: the coupling
    error: dict[str, Any] | None = render.unseen("given")
    marks: list[dict[str, Any]] | None = render.unseen("given")
    not_covered: str = CAVEATS

    @property
    def cells(self) -> int:
        return len(self.grid["K"]) * len(self.grid["B"])

    def rows(self) -> render.Rows:
        """Of its table."""
        crowd, simulation = self.population, self.simulation
        if self.fixed["axes"] == "environment":
            yield from _designed_rows(self.fixed, simulation["effects"]["force_limit_n"])
        for name in self.conditions:
            error = (self.error or {}).get(name)
            near = f"; edge within {100 * error.edge_relative_in_K:.2g} % of the condition's own sweep" if error else ""
            yield f"certified, {name}", f"{_share(self.ratios[name]['certified_cells'], self.cells)}{near}"
        stable = f"{_share(crowd['stable_cells'], self.cells)} ({crowd['decided_cells']} decided)"
        yield f"stable with all of {crowd['humans']} random humans", stable
        if simulation["points"]:
            beside = f"{simulation['undecided']} {UNDECIDED}, {simulation['differ_from_linear']} unlike the linear loop"
            ends = f"{simulation['oscillate']} of {len(simulation['points'])} oscillate, {beside}"
            yield f"simulated{_effects(simulation)}", ends
        yield "seconds", ", ".join(f"{stage} {wall:.1f}" for stage, wall in self.wall_s.items()) or "-"


def _reported(
    args: argparse.Namespace,
    scenario: Scenario,
    sweep: zwidth.Sweep,
    drawn: zwidth.Map,
    plan: Plan,
    fixed: dict[str, Any],
    marks: Sequence[zwidth.Mark],
) -> _Report:
    known, loop, whole = np.isfinite(drawn.growth), sweep.loop, not drawn.interrupted
    unsafe = known & (drawn.growth > MARGINAL)
    ratios = {name: _ratio(sweep, drawn, name, unsafe) for name in drawn.ratio}
    population = {
        "humans": args.humans,
        "seed": args.seed,
        "growth_rate_per_s": drawn.growth.reshape(drawn.grid.shape),
        "unstable_humans_at_least": drawn.unstable.reshape(drawn.grid.shape),
        "stable_cells": int((known & ~unsafe).sum()),
        "decided_cells": int(known.sum()),
    } | ({"reason": f"null: {_NOT_REACHED}"} if np.isnan(drawn.growth).any() else {})
    simulation = _simulation(sweep, drawn, plan)
    differ = 0 if simulation["nonlinear"] else simulation["differ_from_linear"]
    certified = all(mark.requirement["this-environment"].certified for mark in marks)
    return _Report(
        loop.environment is RIGID_WALL,
        None if args.rigid else scenario.name,
        scenario.digest,
        loop.T,
        loop.theta,
        loop.psi,
        loop.delta,
        sweep.cutoff,
        sweep.walled is not None,
        list(drawn.ratio),
        {"K": drawn.grid.K, "B": drawn.grid.B, "scale": drawn.grid.scale},
        population,
        simulation,
        certified and differ == 0 and not any(ratios[name]["contradicted_cells"] for name in CONDITIONS),
        drawn.interrupted,
        drawn.seconds,
        ratios,
        fixed,
        {name: zwidth.map_error(sweep, drawn, name) for name in drawn.ratio} if whole else None,
        [_mark(mark) for mark in marks] if whole else None,
    )


def _ratio(sweep: zwidth.Sweep, drawn: zwidth.Map, name: str, unsafe: NDArray[np.bool_]) -> dict[str, Any]:
    ratio, reason = drawn.ratio[name], _nulls(sweep, drawn, name)
    part = {"required_over_available": ratio.reshape(drawn.grid.shape), "certified_cells": int((ratio < 1).sum())}
    if name in CONDITIONS:  # the population meets the loop that they are about
        part["contradicted_cells"] = int(((ratio < 1) & unsafe).sum())
    return part | ({"reason": reason} if reason else {})


def _mark(mark: zwidth.Mark) -> dict[str, Any]:
    """The question about one coupling."""
    return {
        "K": mark.K,
        "B": mark.B,
        **{name: certificate_part(requirement) for name, requirement in mark.requirement.items()},
        "growth_rate_per_s": mark.growth,
        "unstable_humans": mark.unstable,
        "stiffest_K_at_this_B": {
            name: "beyond the map" if K is not None and np.isinf(K) else K for name, K in mark.stiffest.items()
        },
    }


def _nulls(sweep: zwidth.Sweep, drawn: zwidth.Map, name: str) -> str | None:
    """Why a condition has cells without a figure, in words of one such cell; None where it has none."""
    if name in sweep.refusals:
        return sweep.refusals[name]
    ratio, (K, B) = drawn.ratio[name], drawn.grid.flat
    unreached, infinite = np.isnan(ratio), np.flatnonzero(np.isposinf(ratio))
    parts = [f"null at {unreached.sum()} cells: {_NOT_REACHED}"] if unreached.any() else []
    if infinite.size:
        first = infinite[0]
        why = sweep.requirement(name, float(K[first]), float(B[first])).reason or "the figure grows without end"
        at = f"at K {K[first]:.4g}, B {B[first]:.4g}, {why}"
        parts.append(f"null at {infinite.size} cells: no damping is enough; {at}")
    return "; ".join(parts) or None


def _simulation(sweep: zwidth.Sweep, drawn: zwidth.Map, plan: Plan) -> dict[str, Any]:
    points, (K, B) = drawn.points, (axis[drawn.points.cell] for axis in drawn.grid.flat)
    figures = (K, B, points.verdicts, points.amplitude, points.frequency_hz, points.growth, points.differ)
    names = ("K", "B", "verdict", "amplitude_m", "frequency_hz", "linear_growth_rate_per_s", "differs_from_linear")
    rows = [dict(zip(names, row, strict=True)) for row in zip(*figures, strict=True)]
    devices = plan.effects.on(sweep.devices)
    return {
        "effects": {
            "encoder_step_m": [device.encoder_step for device in devices],
            "friction_n": [device.friction for device in devices],
            "force_limit_n": [d.force_limit for d in devices] if plan.effects.saturation else None,
            "one_sided": sweep.walled is not None,
        },
        "nonlinear": plan.effects.nonlinear(sweep.devices) or sweep.walled is not None,
        "trials": plan.trials,
        "duration_s": plan.duration,
        "start_m": plan.start,
        "press_n": plan.press,
        "threshold_m": plan.threshold,
        "from_hz": slowest_seen(plan.duration),
        "points": rows,
        "oscillate": points.verdicts.count("oscillates"),
        "undecided": points.verdicts.count(UNDECIDED),
        "differ_from_linear": int(points.differ.sum()),
    }


def _save_csv(drawn: zwidth.Map, path: Path) -> Path:
    """One line per cell, SI units in the header; empty where nothing is known."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    figures = [f"{name} required/available" for name in drawn.ratio]
    table.writerow(["K [N/m]", "B [N s/m]", *figures, "growth [1/s]", "unstable humans", "simulated", "amplitude [m]"])
    point = {int(cell): i for i, cell in enumerate(drawn.points.cell)}
    for cell, (K, B) in enumerate(zip(*drawn.grid.flat, strict=True)):
        values = [K, B, *(ratio[cell] for ratio in drawn.ratio.values()), drawn.growth[cell], drawn.unstable[cell]]
        row = ["" if np.isnan(value) else f"{value:.9g}" for value in values]
        i = point.get(cell)
        row += ["", ""] if i is None else [drawn.points.verdicts[i], f"{drawn.points.amplitude[i]:.4g}"]
        table.writerow(row)
    return write(path, text.getvalue())


_EXAMPLE = """python -m sim.zwidth --theta 1 --grid 30
  python -m sim.zwidth --rigid --T 1e-3 --theta 0 --mark 5000,0
  python -m sim.zwidth --rigid --theta 1 --quantisation 1e-5 --saturation --friction 0.2 --wall"""
_FINEST = 1e-5  # [m] least default threshold: what a desk device's encoders resolve


def main(argv: list[str]) -> int:
    """Draw a map. 0: nothing contradicts it and every mark is certified, 1: else, 130: interrupted."""
    args = _parser().parse_args(argv)
    of_coupling = args.coupling is None
    args.grid = args.grid or (60 if of_coupling else 24)
    args.press = (3.0 if of_coupling else 0.0) if args.press is None else args.press
    scenario = options.scenario_from(args)
    require_constant_delay(scenario, "sim.zwidth")
    if scenario.period is not None:
        raise InputError("period: a map simulates even periods; give T_max alone, which its certificates are for")
    _check_case(args)
    chosen = _chosen(args, scenario)
    designed: dict[str, Any] = {"axes": "coupling", "coupling": None}
    if chosen:
        fixed = _environment_sweep(scenario, chosen)
        designed = _coupling(args, scenario, chosen)
        sweep: zwidth.Sweep = replace(fixed, lag=designed["limiter"]["rho"])
    else:
        sweep = _coupling_sweep(args, scenario)
    marks = _marks(args)
    grid, plan, out = _grid(args, sweep, marks), _plan(args, sweep), options.out_folder(args, "zwidth")

    crowd = HeldDevices.drawn(
        sweep.devices, sweep.population, sweep.loop.T, args.seed, args.humans, latency=sweep.loop.latency
    )
    with render.progress("certificates") as move:
        drawn = zwidth.draw_map(sweep, grid, crowd, plan, lambda stage, k, of: move(k, of, stage))
    found = [] if drawn.interrupted else [zwidth.evaluate_point(sweep, crowd, *mark, grid.K) for mark in marks]
    report = _reported(args, scenario, sweep, drawn, plan, designed, found)
    lines = [_mark_line(mark, args.humans) for mark in report.marks or ()]
    files = _save(args, drawn, render.plain(report), out)
    render.publish(args, report, [_table(report)], [*lines, *_remarks(report)], out, files)
    if drawn.interrupted:
        return options.INTERRUPTED
    return options.DONE if report.holds else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    what = "Draw the Z-width map: which spring-dampers are safe, for whom, by which test."
    parser = options.Parser("sim.zwidth", what, _EXAMPLE)
    options.add_loop_options(parser)
    options.add_rigid_option(parser)
    of_map = parser.add_argument_group("the map (K and B are the same on all channels)")
    fixed = "this coupling, fixed, and K and B of the environment's contact springs on the axes"
    names = f"{', '.join(NAMES)} or FILE.json (default: K and B of the coupling)"
    of_map.add_argument("--coupling", metavar="NAME|FILE", help=f"{fixed}: {names}")
    options.add_condition_option(of_map, "that such a coupling is designed for")
    rows = "rows and columns (default 60; 24 with --coupling)"
    of_map.add_argument("--grid", type=options.whole(4, 400), metavar="N", help=rows)
    K, B = "[N/m]; default from delta, theta and T", "[N s/m]; default from delta"
    of_map.add_argument("--K-range", type=options.pair, metavar="LOW,HIGH", help=K)
    of_map.add_argument("--B-range", type=options.pair, metavar="LOW,HIGH", help=B)
    mark = "where does this coupling lie? (repeatable)"
    of_map.add_argument("--mark", type=options.pair, action="append", metavar="K,B", help=mark)
    humans = "random humans per device (default 200)"
    of_map.add_argument("--humans", type=options.whole(1, 100_000), default=200, metavar="N", help=humans)
    _add_points(parser.add_argument_group("the points simulated in MuJoCo, and what they have beside the linear loop"))
    options.add_output_options(parser, picture=True)
    return parser


def _add_points(points: argparse._ActionsContainer) -> None:
    def add(name: str, kind: Callable[[str], float], metavar: str, what: str, default: float | None = None) -> None:
        points.add_argument(f"--{name}", type=kind, metavar=metavar, default=default, help=what)

    add("points", options.whole(0, 400), "N", "rows and columns of them (default 10, 0 for none)", 10)
    add("trials", options.whole(1, 100), "N", "humans at each, the most critical (default 1)", 1)
    add("duration", options.number(), "SECONDS", "of each (default 3)", 3.0)
    add("start", options.number(1e-9, 1, "m"), "METRES", "first swing of motor or handle (default 1e-3)", 1e-3)
    pressing = "steady force of every hand (default 3; 0 with --coupling, whose soft environments give way to it)"
    add("press", options.number(0, 1e3, "N"), "NEWTONS", pressing)
    swing = "amplitude of an oscillation (default 2 steps or 1e-5)"
    add("threshold", options.number(1e-9, 1, "m"), "METRES", swing)
    add("quantisation", options.number(0, 1e-2, "m"), "METRES", "encoder step of every device")
    points.add_argument("--saturation", action="store_true", help="motors have their force limits")
    options.add_limiter_option(points, "with --saturation clip forces at these limits")
    add("friction", options.number(0, 1e3, "N"), "NEWTONS", "Coulomb friction of every device")
    points.add_argument("--wall", action="store_true", help="contacts push and never pull")
    cutoff = "first-order cut-off of the damped velocity; in all maps"
    add("velocity-filter", options.number(1e-3, 1e6, "Hz"), "HERTZ", cutoff)


def _check_case(args: argparse.Namespace) -> None:
    """Whether the options ask for a map of one kind. Raises InputError."""
    if args.limiter is False and not args.saturation:
        raise InputError("--no-limiter without --saturation: motors without limits clip nothing")
    if args.case == "none":
        instead = "use --case I, or --coupling none for a map over environments"
        raise InputError(f"--case none is the loop without coupling, and the map is of couplings: {instead}")
    if args.coupling is None and args.condition:
        why = "without --coupling nothing is designed, and both are drawn"
        raise InputError(f"--condition {args.condition}: {why}")
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
    with render.designing() as heard:
        return choose(scenario, args.case, args.coupling, args.condition, args.limiter, heard)


def _environment_sweep(scenario: Scenario, chosen: Chosen) -> zwidth.EnvironmentSweep:
    """The loop with that coupling. Raises InputError."""
    try:
        return zwidth.EnvironmentSweep(
            scenario.device, scenario.population, _nominal(scenario.loop("I")), chosen.coupling
        )
    except ValueError as error:
        raise InputError(str(error)) from None


def _coupling(args: argparse.Namespace, scenario: Scenario, chosen: Chosen) -> dict[str, Any]:
    """The fixed coupling and what is guaranteed of it where it was designed, in the scenario's own environment."""
    judged, springs = judge(args, scenario, chosen), zwidth.contact_springs(scenario.loop(args.case).network)
    return {
        "axes": "environment",
        "coupling": judged.coupling,
        "designed_for": {
            "contact_springs": [{"between": s.between, "K": s.stiffness, "B": s.damping} for s in springs],
            "certificates": judged.certificates,
            "promise": judged.promise,
            "ranges": judged.ranges,
            "set": judged.ranges,
        },
        "limiter": judged.limiter,
        "remarks": list(chosen.notes),
    }


def _coupling_sweep(args: argparse.Namespace, scenario: Scenario) -> zwidth.CouplingSweep:
    """The loop without its coupling. Raises InputError."""
    devices, loop = scenario.device, _nominal(scenario.loop("I"))
    try:
        if args.rigid:
            loop, devices = _nominal(options.rigid_loop(args, scenario)), devices[:1]
        elif args.wall:
            loop = loop.at(zwidth.one_sided(scenario.environment))
        wall, clip = args.rigid and args.wall, args.limiter is False
        return zwidth.CouplingSweep(devices, scenario.population, loop, args.velocity_filter, wall, clip)
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(str(error)) from None


def _nominal(loop: Loop) -> Loop:
    """With the environment itself and constant delays: what a map is about."""
    return msgspec.structs.replace(loop, ranges=None, varying_delay=None)


def _marks(args: argparse.Namespace) -> tuple[zwidth.Range, ...]:
    """The couplings that are asked about. Raises InputError."""
    for K, B in args.mark or ():
        if not (1e-3 <= K <= 1e9 and 0 <= B <= 1e6):
            raise InputError(f"--mark is {K:g},{B:g}, allowed are K 1e-3 to 1e9 N/m, B 0 to 1e6 N s/m")
    return tuple(args.mark or ())


def _grid(args: argparse.Namespace, sweep: zwidth.Sweep, marks: tuple[zwidth.Range, ...]) -> zwidth.Grid:
    return zwidth.make_grid(sweep, args.grid, args.K_range, args.B_range, marks)


def _plan(args: argparse.Namespace, sweep: zwidth.Sweep) -> Plan:
    effects = Effects(args.quantisation, args.friction, args.saturation)
    coarsest = max(device.encoder_step for device in effects.on(sweep.devices))
    threshold = max(2 * coarsest, _FINEST) if args.threshold is None else args.threshold
    shortest = max(1.5, 1024 * sweep.loop.T)
    if not shortest <= args.duration <= 1e4:
        raise InputError(f"--duration is {args.duration:g}, allowed are {shortest:g} to 10000 s")
    return Plan(effects, args.points, args.trials, args.start, args.press, args.duration, threshold)


def _save(args: argparse.Namespace, drawn: zwidth.Map, outcome: dict[str, Any], out: Path) -> list[Path]:
    """The table and the picture."""
    files = [_save_csv(drawn, out / "map.csv")]
    if not args.no_plot:
        from sim.map_plot import plot_zwidth

        files.append(plot_zwidth(drawn, outcome, out / "zwidth.png"))
    return files
