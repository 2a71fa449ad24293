"""python -m design.compare: couplings over frequency, every design as a ladder, and the limits of any coupling.

Without --over and --ladder the couplings of --coupling are drawn: singular values, required damping, perceived
stiffness and damping. --ladder designs what the project can design, for cases I and II. --over designs the optimal
coupling along an axis of the loop, which shows how good any coupling could be with another device, delay or period.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from cli import options, render
from cli.design import add_optimal_options, optimal_options
from controller import older
from controller.loop import Loop
from controller.lti import Array
from design import compare
from design.compare import AXES, FEEL_HZ, LADDERS, Demands, LadderRow, Limit, Perceived, Point, optimum, points_along
from design.program import Options
from design.result import CONDITIONS, DesignFailed, certificate_part, finite
from design.robustness import robustness_part
from design.transparency import transparency
from sim import baselines, report
from sim.couplings import NAMES, Chosen, choose
from sim.scenario import InputError, Scenario, require_even_ticks

_MOST = 6  # curves that can be told apart in one panel


def main(argv: list[str]) -> int:
    """Compare. 0: done, 1: something could not be designed, 130: interrupted, with what was done until then."""
    parser = _parser()
    args = parser.parse_args(argv)
    scenario = options.scenario_from(args)
    _check_mode(args, parser)
    if args.baselines:
        return _baselines(args, scenario)
    if args.ladder:
        return _ladder(args, scenario)
    return _limits(args, scenario) if args.over else _couplings(args, scenario)


def _parser() -> options.Parser:
    example = """python -m design.compare --coupling published,spring-damper:any-environment,optimal
  python -m design.compare --ladder
  python -m design.compare --baselines
  python -m design.compare --over damping=0.7:10,delay --points 5"""
    what = "Compare couplings over frequency, all designs as a ladder, or the best coupling along an axis of the loop."
    parser = options.Parser("design.compare", what, example)
    options.add_loop_options(parser)
    given = f"{', '.join(NAMES)} or FILE.json, separated by commas; NAME:CONDITION asks for a condition"
    parser.add_argument("--coupling", metavar="NAME,FILE,..", help=f"{given} (default none,spring-damper)")
    options.add_condition_option(parser, "of designs that name none")
    short = "every design side by side, cases I and II (full: minutes)"
    parser.add_argument("--ladder", nargs="?", const="short", choices=tuple(LADDERS), help=short)
    classics = "on the same runs: no coupling, the classics (PO/PC, energy bounding), the energy budget, our designs"
    parser.add_argument("--baselines", action="store_true", help=classics)
    axes, names = ",".join(AXES), "damping, delay, period, order"
    options.add_limiter_option(parser, "with --baselines clip the forces of our designs")
    over = f"the best coupling along these axes: {names} (default: all of them)"
    parser.add_argument("--over", nargs="?", const=axes, metavar="NAME[=LOW:HIGH],..", help=over)
    curve = parser.add_argument_group("with --over")
    curve.add_argument(
        "--points", type=options.whole(1, 100), default=6, metavar="N", help="designs of each (default 6)"
    )
    curve.add_argument("--keep", choices=("samples", "seconds"), default="samples", help="delays, as the period varies")
    beside = "spring-dampers drawn: none, any-environment, this-environment or both (default both)"
    curve.add_argument("--beside", type=_beside, default=tuple(CONDITIONS), metavar="NAME", help=beside)
    optimal = parser.add_argument_group("the optimal coupling of --over")
    add_optimal_options(optimal)
    options.add_output_options(parser, picture=True)
    return parser


def _beside(text: str) -> tuple[str, ...]:
    return {"none": (), "both": tuple(CONDITIONS)}[text] if text in ("none", "both") else (options.condition(text),)


#: options -> the modes that take them
_MODES = {
    "coupling": ("",),
    "condition": ("",),
    "no_plot": ("", "--over", "--baselines"),
    "limiter": ("--baselines",),
    **dict.fromkeys(("points", "keep", "beside", "objective", "band_hz", "high_gain", "seconds"), ("--over",)),
}


def _check_mode(args: argparse.Namespace, parser: options.Parser) -> None:
    """Raises InputError where an option is given that this comparison would have to ignore."""
    asked = [f"--{name}" for name in ("over", "ladder", "baselines") if getattr(args, name)]
    if len(asked) > 1:
        raise InputError(f"{' with '.join(asked)}: give one of them")
    mode = "".join(asked)
    if args.ladder and args.case != parser.get_default("case"):
        raise InputError(f"--ladder shows both cases: leave out --case {args.case}")
    if mode and args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")
    for name, modes in _MODES.items():
        if mode not in modes and getattr(args, name) != parser.get_default(name):
            where = [f"for {modes[0]}"] * bool(modes[0]) + [f"not for {mode}"] * bool(mode)
            option = {"limiter": "no-limiter"}.get(name, name.removesuffix("_hz").replace("_", "-"))
            raise InputError(f"--{option} is {', '.join(where)}")


# ----------------------------------------------------------------------------------------------------
# Couplings over frequency.


@dataclass(frozen=True, eq=False)
class _Shown:
    """One coupling, with all that the pictures show of it."""

    name: str
    states: int
    transparency: dict[str, Any]
    robustness: dict[str, Any] | None
    sigma_F: Array
    sigma_M: Array
    perceived: Perceived
    coupling: dict[str, Any] = render.unseen("beside")
    conditions: dict[str, dict[str, Any]] = render.unseen("beside")


@dataclass(frozen=True, eq=False)
class _Couplings:
    """Couplings over frequency; SI units, null where a figure is infinite or does not exist."""

    case: str
    scenario: str
    seed: int
    T_s: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    lam: tuple[int, ...]
    available_damping: tuple[float, ...]
    frequency_hz: Array
    sigma_E: Array
    ideal: Perceived
    couplings: list[_Shown]
    notes: list[str]


def _couplings(args: argparse.Namespace, scenario: Scenario) -> int:
    names, out = _names(args), options.out_folder(args, "compare")
    chosen, failed = _chosen(scenario, args, names)
    loop = scenario.loop(args.case)
    judged = {name: compare.judge(loop, c.coupling, c.phi) for name, c in chosen.items()}
    hz = compare.grid(loop, list(judged.values()))
    sigma_E, undelayed = compare.ideal(loop, hz)
    shown = [_shown(loop, name, c, judged[name], hz) for name, c in chosen.items()]
    notes = [*(f"{name}: {note}" for name, c in chosen.items() for note in c.notes), *failed, *_missing_curves(shown)]
    about = args.case, scenario.name, args.seed, loop.T, loop.theta, loop.psi, loop.lam, loop.delta
    report = _Couplings(*about, hz, sigma_E, undelayed, shown, notes)
    files = _pictures(args, out, render.plain(report))
    render.publish(args, report, [_guarantees(report), _feel(report)], notes, out, files)
    return options.DOES_NOT_HOLD if failed else options.DONE


def _names(args: argparse.Namespace) -> list[str]:
    """The couplings that were asked for. Raises InputError."""
    usual = "none" if args.case == "none" else "none,spring-damper"
    asked: str = usual if args.coupling is None else args.coupling
    names = asked.split(",")
    if "" in names:
        raise InputError(f"--coupling is {args.coupling!r}, expected names separated by commas")
    if len(set(names)) < len(names):
        raise InputError(f"--coupling is {args.coupling!r}: a name stands there twice")
    if len(names) > _MOST:
        raise InputError(f"--coupling has {len(names)} entries, allowed are 1 to {_MOST}")
    return names


def _chosen(scenario: Scenario, args: argparse.Namespace, names: list[str]) -> tuple[dict[str, Chosen], list[str]]:
    """The couplings by name, and why designs failed. Raises DesignFailed where all of them did."""
    chosen: dict[str, Chosen] = {}
    failures: dict[str, DesignFailed] = {}
    for name in names:
        kind, condition = _named(name)
        try:
            with render.designing() as heard:
                chosen[name] = choose(scenario, args.case, kind, condition or args.condition, progress=heard)
        except DesignFailed as error:
            failures[name] = error
    if not chosen:
        raise next(iter(failures.values()))
    return chosen, [f"{name}: not possible: {' '.join(str(error).split())}" for name, error in failures.items()]


def _named(name: str) -> tuple[str, str | None]:
    """NAME:CONDITION as both, the condition None where none is named. Raises InputError."""
    plain, _, words = name.rpartition(":")
    try:
        return (plain, options.condition(words)) if plain else (name, None)
    except argparse.ArgumentTypeError as error:
        if plain in NAMES:
            raise InputError(f"--coupling {name}: the condition {error}") from None
        return name, None  # a file may have a colon in its name


def _shown(loop: Loop, name: str, chosen: Chosen, judged: Demands, hz: Array) -> _Shown:
    lines, conditions = compare.curves(loop, judged, hz), {}
    for key, requirement in judged.requirements.items():
        demand = lines.demands[key]
        part = certificate_part(requirement) | {"ratio": finite(requirement.ratio), "demand": demand}
        if demand is None and not requirement.reason:
            part["reason"] = f"this coupling is no V in feedback around the environment: no curve for {key}"
        conditions[key] = part
    return _Shown(
        Path(name).name,
        judged.F.order,
        report.transparency_part(transparency(judged.F, loop.E(), loop.lam)),
        robustness_part(loop, chosen.coupling),
        lines.sigma_F,
        lines.sigma_M,
        lines.perceived,
        report.coupling_part(chosen.kind, chosen.coupling, loop.T),
        older.with_older(conditions, older.CONDITIONS),
    )


def _missing_curves(couplings: list[_Shown]) -> list[str]:
    parts = [(c.name, condition, c.conditions[condition]) for c in couplings for condition in CONDITIONS]
    return [f"{name}, {condition}: {part['reason']}" for name, condition, part in parts if "reason" in part]


def _pictures(args: argparse.Namespace, out: Path, outcome: dict[str, Any]) -> list[Path]:
    if args.no_plot:
        return []
    from sim.plots import plot_perceived, plot_required_damping, plot_singular_values

    return [
        plot_singular_values(outcome, out / "singular-values.png"),
        plot_required_damping(outcome, out / "required-damping.png"),
        plot_perceived(outcome, out / "perceived.png"),
    ]


def _guarantees(report: _Couplings) -> Table:
    """Required damping [N s/m] where all devices have the same, else as a multiple of what each has."""
    available = report.available_damping
    alike = len(set(available)) == 1
    damping = "required damping" if alike else "required share of the damping"
    title = f"{damping} of {_list(available)} N s/m · {report.scenario}, case {report.case}"
    heads = ("coupling", "this-env.", "at Hz", "at 10 %", "any-env.", "at Hz", "sup dB", "rms dB")  # as CONDITIONS
    rows = []
    for coupling in report.couplings:
        parts = [coupling.conditions[condition] for condition in CONDITIONS]
        needs = [(_needs(p, available[0] if alike else 1.0), p["binding_frequency_hz"]) for p in parts]
        asked = [cell for need, hz in needs for cell in (need, render.optional(hz, "{:.4g}"))]
        asked.insert(2, _robust(coupling.robustness, available[0] if alike else 1.0))
        errors = [coupling.transparency[f"{which}_mismatch_db"] for which in ("relative", "rms")]
        rows.append([coupling.name, *asked, *(render.optional(e, "{:.2f}", "-inf") for e in errors)])
    return render.grid(title, heads, rows)


def _needs(part: dict[str, Any], scale: float) -> str:
    """The worst device's figure, green where it is certified."""
    if part["ratio"] is None:
        return "[red]infinite[/]"
    return f"[{'green' if part['certified'] else 'red'}]{scale * part['ratio']:.5g}[/]"


def _robust(part: dict[str, Any] | None, scale: float = 1.0) -> str:
    """The need at the worst stiffness or mass within ten percent."""
    if part is None:
        return "-"
    need = part["required_over_available"]
    return "infinite" if need is None else f"{scale * need:.4g}"


def _feel(report: _Couplings) -> Table:
    columns = [(what, unit, hz) for what, unit in (("stiffness", "N/m"), ("damping", "N s/m")) for hz in FEEL_HZ]
    heads = ["coupling", *(f"{what}\n{unit}, {hz:g} Hz" for what, unit, hz in columns)]
    named = {"ideal (E)": report.ideal, **{c.name: c.perceived for c in report.couplings}}

    def at(hz: float, curves: Array) -> list[float]:
        """Each channel's curve at `hz`, which is in the grid; nan above Nyquist's frequency."""
        return [float(np.interp(hz, report.frequency_hz, column, right=np.nan)) for column in curves.T]

    rows = [[name, *(_list(at(hz, getattr(felt, what))) for what, _, hz in columns)] for name, felt in named.items()]
    return render.grid("perceived by each device's user, the other devices held still", heads, rows)


def _list(values: Iterable[float]) -> str:
    """'1, 2', or '1' where all are equal."""
    shown = [format(v, ".0f" if abs(v) >= 1000 else ".3g") for v in values]
    return shown[0] if len(set(shown)) == 1 else ", ".join(shown)


# ----------------------------------------------------------------------------------------------------
# Every design as a ladder.


@dataclass(frozen=True)
class _Ladder:
    """Every design side by side, for both cases."""

    scenario: str
    seed: int
    rows: Sequence[LadderRow]
    wall_s: float
    interrupted: bool


def _ladder(args: argparse.Namespace, scenario: Scenario) -> int:
    out, begin = options.out_folder(args, "compare"), time.perf_counter()
    loops = {case: scenario.loop(case) for case in ("I", "II")}
    with render.progress("designing") as move:
        rows, interrupted = compare.compare_designs(loops, LADDERS[args.ladder], move)
    report = _Ladder(scenario.name, args.seed, rows, time.perf_counter() - begin, interrupted)
    heads = ("design", "needs N s/m", "x, 10 %", "sup dB", "rms dB", "proof", "s")
    shown = []
    for case in loops:
        cells = [_rung(row) for row in rows if row.case == case]
        shown.append(render.grid(f"the ladder · {scenario.name}, case {case}", heads, cells, left=(0, 5)))
    lines = [f"{row.design}, case {row.case}: {row.reason}" for row in rows if row.reason]
    render.publish(args, report, shown, [*lines, f"{report.wall_s:.1f} s"], out)
    return options.INTERRUPTED if interrupted else options.DONE


def _rung(row: LadderRow) -> tuple[str, ...]:
    need = "inf" if row.required_damping is None else f"{max(row.required_damping):.4f}"
    need += "" if row.certified else " (no)"
    errors = [render.optional(getattr(row, f"{which}_mismatch_db"), "{:.2f}", "exact") for which in ("relative", "rms")]
    if row.required_damping is None:
        need, errors = ("-", ["-", "-"]) if row.reason else ("-", ["-", errors[1]])
    return row.design, need, _robust(row.robustness), *errors, row.proof or "-", f"{row.wall_s:.2f}"


# ----------------------------------------------------------------------------------------------------
# The classics beside ours.


@dataclass(frozen=True)
class _Baselines:
    """The classics and our couplings on the same runs."""

    scenario: str
    case: str
    seed: int
    rows: Sequence[baselines.Rival]
    wall_s: float
    interrupted: bool
    hands: int = baselines.PAIRS
    hands_s: float = baselines.SECONDS
    start_m_s: float = baselines.SLOW


def _baselines(args: argparse.Namespace, scenario: Scenario) -> int:
    require_even_ticks(scenario, "--baselines")
    if scenario.ranges or scenario.switches:
        given = "[ranges]" if scenario.ranges else "[varying_delay]"
        raise InputError(f"--baselines compares in one environment with constant delays: leave out {given}")
    if any(device.friction for device in scenario.device):
        raise InputError("--baselines runs in the exact plant, which has no Coulomb friction; the devices have")
    out, rows, interrupted = options.out_folder(args, "compare"), [], False
    begin = time.perf_counter()
    with render.progress("comparing") as move:
        try:
            rows.extend(baselines.rivals(scenario, args.case, move, args.limiter))
        except KeyboardInterrupt:
            interrupted = True
    report = _Baselines(scenario.name, args.case, args.seed, rows, time.perf_counter() - begin, interrupted)
    files = []
    if rows and not args.no_plot:
        from sim.plots import plot_baselines

        files.append(plot_baselines(render.plain(report), out / "baselines.png"))
    heads = ("", "error %", "> 40 Hz N", "peak N", "acted %", "hands", "m/s", "guarantee")
    cells = [_rival(row) for row in rows]
    shown = [render.grid(f"on the same runs · {scenario.title(args.case)}", heads, cells, left=(0, 7))]
    lines = [f"* baseline {row.name}: {row.source}." for row in rows if row.source]
    began = f"{baselines.SLOW:g} m/s they began with"
    lines.append(f"hands: of {baselines.PAIRS} lossless pairs, faster after {baselines.SECONDS:g} s than the {began}.")
    lines += sorted({f"error: {row.reason}." for row in rows if row.reason})
    render.publish(args, report, shown, [*lines, f"{report.wall_s:.1f} s"], out, files)
    return options.INTERRUPTED if interrupted else options.DONE


def _rival(row: baselines.Rival) -> tuple[str, ...]:
    error = render.optional(row.error_percent, "{:.2f}")
    figures = f"{row.fast_n:.3f}", f"{row.peak_n:.1f}", f"{row.acted_percent:.0f}", str(row.moving)
    short = "energy" if row.name == "energy budget" else row.guarantee or "none"
    return f"{row.name}{' *' if row.baseline else ''}", error, *figures, f"{row.fastest_m_s:.3f}", short


# ----------------------------------------------------------------------------------------------------
# The limits of any coupling along an axis.


@dataclass(frozen=True)
class _Sweep:
    """The designs along one axis of the loop."""

    label: str
    unit: str
    values: list[float]
    curves: dict[str, list[Limit]] = render.unseen("beside")

    @classmethod
    def of(cls, name: str, along: Sequence[Point], curves: dict[str, list[Limit]]) -> _Sweep:
        return cls(AXES[name].label, AXES[name].unit, [point.value for point in along], curves)


@dataclass(frozen=True)
class _Limits:
    """How good a coupling can be."""

    scenario: str
    seed: int
    case: str
    objective: str
    delays_kept_in: str
    wish: Options
    here: dict[str, Any]
    sweeps: dict[str, _Sweep]
    gains: list[str]
    wall_s: float
    interrupted: bool


def _limits(args: argparse.Namespace, scenario: Scenario) -> int:
    wish, loop = _wish(args), scenario.loop(args.case)
    if min(loop.delta) <= 0:
        raise InputError(f"delta is {list(loop.delta)}, expected positive dampings in N s/m")
    plan, out = _plan(args, loop, wish), options.out_folder(args, "compare")
    designers = {"optimal": compare.remembered(optimum, True)}
    designers |= {name: compare.remembered(compare.spring_damper(name), False) for name in args.beside}
    begin = time.perf_counter()
    curves, interrupted = _designed(plan, designers)
    report = _Limits(
        scenario.name,
        args.seed,
        args.case,
        wish.objective,
        args.keep,
        wish,
        {"delta": loop.delta, "theta": loop.theta, "psi": loop.psi, "T_s": loop.T},
        {
            name: _Sweep(AXES[name].label, AXES[name].unit, [at.value for at in plan[name]], rows)
            for name, rows in curves.items()
        },
        compare.gains(plan, curves, loop, wish),
        time.perf_counter() - begin,
        interrupted,
    )
    points = [(name, row) for name, sweep in report.sweeps.items() for row in sweep.curves["optimal"]]
    files = []
    if not args.no_plot and points:
        from sim.plots import plot_limits

        files.append(plot_limits(render.plain(report), out / "limits.png"))
    names = " and by ".join(args.beside)
    lines = [f"beside the optimum: the designed spring-damper by {names}"] if names else []
    lines += [f"{name} {row.value:.4g}: {row.reason}" for name, row in points if row.reason]
    tables = [_limit_table(report, name, args.beside) for name in report.sweeps]
    lines += [*report.gains, f"{report.wall_s:.1f} s"]
    render.publish(args, report, tables, lines, out, files)
    if interrupted:
        return options.INTERRUPTED
    found = any(row.rms_mismatch_db is not None for _, row in points)
    return options.DONE if found else options.DOES_NOT_HOLD


def _wish(args: argparse.Namespace) -> Options:
    try:
        return Options(**optimal_options(args))
    except ValueError as error:
        raise InputError(options.as_option(error, args)) from None


def _plan(args: argparse.Namespace, loop: Loop, wish: Options) -> dict[str, list[Point]]:
    """The points of every sweep that is asked for. Raises InputError."""
    plan = {}
    for part in args.over.split(","):
        name, _, text = part.partition("=")
        if name not in AXES:
            raise InputError(f"--over has {name!r}, allowed are {', '.join(AXES)}")
        try:
            plan[name] = points_along(name, loop, wish, args.points, _span(name, text) if text else None, args.keep)
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"--over {part}: {error}") from None
    return plan


def _span(name: str, text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    if not colon:
        raise InputError(f"--over {name}={text}: expected LOW:HIGH in {AXES[name].unit}")
    return options.numbers(f"--over {name}", low, float, 1)[0], options.numbers(f"--over {name}", high, float, 1)[0]


def _designed(
    plan: dict[str, list[Point]], designers: dict[str, compare.Designer]
) -> tuple[dict[str, dict[str, list[Limit]]], bool]:
    """Every design at every point; what is done when the keyboard interrupts is kept."""
    curves: dict[str, dict[str, list[Limit]]] = {name: {kind: [] for kind in designers} for name in plan}
    jobs = [(name, point, kind) for name, along in plan.items() for point in along for kind in designers]
    with render.progress("designing") as move:
        try:
            for done, (name, point, kind) in enumerate(jobs):
                move(done, len(jobs))
                curves[name][kind].append(designers[kind](point))
        except KeyboardInterrupt:
            return {name: rows for name, rows in curves.items() if any(rows.values())}, True
    return curves, False


def _limit_table(report: _Limits, name: str, beside: Sequence[str]) -> Table:
    sweep, designs = report.sweeps[name], ("optimal", *beside)
    rows = []
    for i, row in enumerate(sweep.curves["optimal"]):
        limits = {design: sweep.curves[design][i] if i < len(sweep.curves[design]) else None for design in designs}
        errors = [_error(limit, report.objective) for limit in limits.values()]
        theta = ",".join(map(str, row.theta))
        rows.append((f"{row.value:.4g}", theta, *errors, _proofs(limits), f"{row.wall_s:.1f}"))
    title = f"{report.objective} transparency error over {name} · {report.scenario}, case {report.case}"
    heads = (sweep.unit, "theta", "optimal", *beside, "proof", "seconds")
    return render.grid(title, heads, rows, left=(1,))


def _error(limit: Limit | None, objective: str) -> str:
    if limit is None:
        return ""
    value = limit.rms_mismatch_db if objective == "rms" else limit.relative_mismatch_db
    if value is None:
        return "exact" if limit.proof else "infeasible"
    return compare.printed_decibels(value)


def _proofs(limits: dict[str, Limit | None]) -> str:
    """Rational where every design of a row is proved exactly, else which are only sampled."""
    found = {name: limit.proof for name, limit in limits.items() if limit and limit.proof}
    sampled = [name for name, proof in found.items() if proof != "rational"]
    if not found:
        return "-"
    return f"sampled: {', '.join(sampled)}" if sampled else "rational"
