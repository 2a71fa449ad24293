"""python -m design.compare: couplings over frequency, every design as a ladder, and the limits of any coupling.

Without --over and --ladder the couplings of --coupling are drawn: singular values, required damping, perceived
stiffness and damping. --ladder designs what the project can design, for cases I and II. --over designs the optimal
coupling along an axis of the loop, which shows how good any coupling could be with another device, delay or period.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from haptic_loop.cli import options, render
from haptic_loop.cli.design import add_optimal_options, asked_of
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design import compare
from haptic_loop.design.compare import AXES, FEEL_HZ, LADDERS, LadderRow, Limit, Point, points_along
from haptic_loop.design.conditions import Condition
from haptic_loop.design.program import Options
from haptic_loop.design.result import CONDITIONS, Chosen, DesignFailed, finite
from haptic_loop.design.robustness import Nearby, Robustness
from haptic_loop.sim import baselines
from haptic_loop.sim.compare_report import ComparedCoupling, Comparison, ConditionCurve, Here, LimitCurves, nearby
from haptic_loop.sim.couplings import NAMES, choose
from haptic_loop.sim.scenario import InputError, Scenario
from rich.table import Table

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
    parser.add_loop()
    given = f"{', '.join(NAMES)} or FILE.json, separated by commas; NAME:CONDITION asks for a condition"
    parser.add_argument("--coupling", type=_names, metavar="NAME,FILE,..", help=f"{given} (default none,spring-damper)")
    parser.add_condition("of designs that name none")
    short = "every design side by side, cases I and II (full: minutes)"
    parser.add_argument("--ladder", nargs="?", const="short", choices=tuple(LADDERS), help=short)
    classics = "on the same runs: no coupling, the classics (PO/PC, energy bounding), the energy budget, our designs"
    parser.add_argument("--baselines", action="store_true", help=classics)
    axes, names = ",".join(AXES), "damping, delay, period, order"
    parser.add_limiter("with --baselines clip the forces of our designs")
    over = f"the best coupling along these axes: {names} (default: all of them)"
    parser.add_argument("--over", nargs="?", const=axes, metavar="NAME[=LOW:HIGH],..", help=over)
    curve = parser.add_argument_group("with --over")
    curve.add_argument(
        "--points", type=options.whole(1, 100), default=6, metavar="N", help="designs of each (default 6)"
    )
    curve.add_argument("--keep", choices=("samples", "seconds"), default="samples", help="delays, as the period varies")
    beside = "spring-dampers drawn: none, any-environment, this-environment or both (default both)"
    curve.add_argument("--beside", type=_beside, default=tuple(CONDITIONS), metavar="NAME", help=beside)
    add_optimal_options(parser, "the optimal coupling of --over")
    parser.add_output(picture=True)
    plain = "without --over, --ladder and --baselines"
    parser.only(plain, lambda args: not (args.over or args.ladder or args.baselines), "coupling", "condition")
    parser.only("without --ladder, which has no picture", lambda args: not args.ladder, "no_plot")
    parser.only("with --baselines", lambda args: args.baselines, "limiter")
    optimal = ("objective", "band_hz", "high_gain", "seconds")
    parser.only("with --over", lambda args: args.over, "points", "keep", "beside", *optimal)
    return parser


def _beside(text: str) -> tuple[str, ...]:
    return {"none": (), "both": tuple(CONDITIONS)}[text] if text in ("none", "both") else (options.condition(text),)


def _check_mode(args: argparse.Namespace, parser: options.Parser) -> None:
    """Raises InputError where two comparisons are asked for, or a case that this one does not have."""
    asked = [f"--{name}" for name in ("over", "ladder", "baselines") if getattr(args, name)]
    if len(asked) > 1:
        raise InputError(f"{' with '.join(asked)}: give one of them")
    if args.ladder and args.case != parser.get_default("case"):
        raise InputError(f"--ladder shows both cases: leave out --case {args.case}")
    if asked and args.case == "none":
        raise InputError("--case none has no coupling to design: give I or II")


# ----------------------------------------------------------------------------------------------------
# Couplings over frequency.


def _couplings(args: argparse.Namespace, scenario: Scenario) -> int:
    names = args.coupling or (("none",) if args.case == "none" else ("none", "spring-damper"))
    out = options.out_folder(args, "compare")
    chosen, failed = _chosen(scenario, args, names)
    report = Comparison.of(scenario, args.case, chosen, failed, args.seed)
    files = render.pictures(args, report, out, _PICTURES)
    prices = [line for c in report.couplings for line in _price(c.name, c.nearby)]
    render.publish(args, report, [_guarantees(report), _feel(report)], [*report.notes, *prices], out, files)
    return options.exit_code(not failed)


_PICTURES = {
    "singular-values.png": "plot_singular_values",
    "required-damping.png": "plot_required_damping",
    "perceived.png": "plot_perceived",
}


def _names(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    if "" in names:
        raise argparse.ArgumentTypeError(f"is {text!r}, expected names separated by commas" if text else "is empty")
    if len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"is {text!r}: a name stands there twice")
    if len(names) > _MOST:
        raise argparse.ArgumentTypeError(f"has {len(names)} entries, allowed are 1 to {_MOST}")
    return names


def _chosen(scenario: Scenario, args: argparse.Namespace, names: Sequence[str]) -> tuple[dict[str, Chosen], list[str]]:
    """The couplings by name, and why designs failed. Raises DesignFailed where all of them did."""
    chosen: dict[str, Chosen] = {}
    failures: dict[str, DesignFailed] = {}
    for name in names:
        kind, condition = _named(name)
        try:
            with render.designing() as progress:
                chosen[name] = choose(scenario, args.case, kind, condition or args.condition, progress=progress)
        except DesignFailed as error:
            failures[name] = error
    if not chosen:
        raise next(iter(failures.values()))
    return chosen, [f"{name}: not possible: {' '.join(str(error).split())}" for name, error in failures.items()]


def _named(name: str) -> tuple[str, str | Condition | None]:
    """NAME:CONDITION as both, the condition None where none is named. Raises InputError."""
    kind, _, words = name.partition(":")
    plain, words = (kind, words) if kind in NAMES else name.rpartition(":")[::2]
    try:
        if not plain or plain == name:
            return name, None
        return plain, options.own_condition(words) if ":" in words else options.condition(words)
    except argparse.ArgumentTypeError as error:
        if plain in NAMES:
            raise InputError(f"--coupling {name}: the condition {error}") from None
        return name, None  # a file may have a colon in its name


def _guarantees(report: Comparison) -> Table:
    """Required damping [N s/m] where all devices have the same, else as a multiple of what each has."""
    available = report.available_damping
    alike = len(set(available)) == 1
    damping = "required damping" if alike else "required share of the damping"
    title = f"{damping} of {_list(available)} N s/m · {report.scenario}, case {report.case}"
    scale = available[0] if alike else 1.0
    cells: dict[str, Callable[[ComparedCoupling], str]] = {"coupling": lambda c: c.name}
    for i, condition in enumerate(report.conditions):
        cells |= {
            render.short(condition): lambda c, of=condition: _needs(c.conditions[of], scale),
            "at Hz" + " " * i: lambda c, of=condition: _binds(c.conditions[of]),
        }
        if i == 0:
            cells["at 10 %"] = lambda c: _robust(c.nearby.robustness, scale)
    cells |= {
        "sup dB": lambda c: render.optional(finite(c.transparency.mismatch_db), "{:.2f}", "-inf"),
        "rms dB": lambda c: render.optional(finite(c.transparency.rms_mismatch_db), "{:.2f}", "-inf"),
    }
    return render.columns(title, cells, report.couplings)


def _binds(part: ConditionCurve) -> str:
    return render.optional(part.requirement.frequency_hz, "{:.4g}")


def _needs(part: ConditionCurve, scale: float) -> str:
    """The worst device's figure, green where it is certified."""
    need = "infinite" if np.isinf(part.ratio) else f"{scale * part.ratio:.5g}"
    return f"[{'green' if part.requirement.certified else 'red'}]{need}[/]"


def _robust(part: Robustness | None, scale: float = 1.0) -> str:
    """The damping that is needed at the worst stiffness or mass within ten percent."""
    if part is None:
        return "-"
    return f"{scale * part.required_over_available:.4g}"


def _price(name: str, part: Nearby) -> Iterable[str]:
    """What a design for the environments within ten percent reaches, in a line, where that is known."""
    if price := part.designed_for_it:
        yield f"{name}, designed for 10 % more or less of every spring and mass: {render.price_words(price)}"


def _feel(report: Comparison) -> Table:
    columns = [(what, unit, hz) for what, unit in (("stiffness", "N/m"), ("damping", "N s/m")) for hz in FEEL_HZ]
    heads = ["coupling", *(f"{what}\n{unit}, {hz:g} Hz" for what, unit, hz in columns)]
    named = {"ideal (E)": report.ideal, **{c.name: c.curves.perceived for c in report.couplings}}

    def at(hz: float, curves: Array) -> list[float]:
        """Each channel's curve at `hz`, which is in the grid; nan above Nyquist's frequency."""
        return [float(np.interp(hz, report.frequency_hz, column, right=np.nan)) for column in curves.T]

    rows = [[name, *(_list(at(hz, getattr(felt, what))) for what, _, hz in columns)] for name, felt in named.items()]
    return render.grid("perceived by each device's user, the other devices held still", heads, rows)


def _list(values: Iterable[float]) -> str:
    """The values with commas between them; a single one where all are equal."""
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
    called = {case: f"case {case}" for case in ("I", "II")}
    if scenario.lam is not None:  # both cases are the same loop then
        called = {"I": f"lam {', '.join(map(str, scenario.lam))}"}
    loops = {case: scenario.loop(case) for case in called}
    with render.progress("designing") as move:
        rows, interrupted = options.until_interrupted(
            compare.compare_designs(loops, LADDERS[args.ladder], move, nearby)
        )
    report = _Ladder(scenario.name, args.seed, rows, time.perf_counter() - begin, interrupted)
    shown = []
    for case in loops:
        some = [row for row in rows if row.case == case]
        shown.append(render.columns(f"the ladder · {scenario.name}, {called[case]}", _LADDER, some, left=(0, 5)))
    lines = [f"{row.design}, {called[row.case]}: {row.reason}" for row in rows if row.reason]
    lines += [line for row in rows for line in _price(f"{row.design}, {called[row.case]}", row.nearby)]
    render.publish(args, report, shown, [*lines, f"{report.wall_s:.1f} s"], out)
    return options.exit_code(True, interrupted)


#: what stands in a column, given a row; a bound has no damping and only an rms error, a failed design neither
_LADDER: dict[str, str | Callable[[LadderRow], str]] = {
    "design": "{r.design}",
    "needs N s/m": lambda r: (
        "-" if r.required_damping is None else f"{max(r.required_damping):.4f}" + ("" if r.certified else " (no)")
    ),
    "x, 10 %": lambda r: _robust(r.nearby.robustness),
    "sup dB": lambda r: (
        "-" if r.required_damping is None else render.optional(r.relative_mismatch_db, "{:.2f}", "exact")
    ),
    "rms dB": lambda r: (
        "-" if r.required_damping is None and r.reason else render.optional(r.rms_mismatch_db, "{:.2f}", "exact")
    ),
    "proof": lambda r: r.proof or "-",
    "s": "{r.wall_s:.2f}",
}


# ----------------------------------------------------------------------------------------------------
# The classics beside ours.


def _baselines(args: argparse.Namespace, scenario: Scenario) -> int:
    with render.progress("comparing") as move:
        all_of_them = baselines.rivals(scenario, args.case, move, args.limiter)
        out, begin = options.out_folder(args, "compare"), time.perf_counter()
        rows, interrupted = options.until_interrupted(all_of_them)
    report = baselines.Baselines(scenario.name, args.case, args.seed, rows, time.perf_counter() - begin, interrupted)
    files = render.pictures(args, report, out, {"baselines.png": "plot_baselines"} if rows else {})
    shown = [render.columns(f"on the same runs · {scenario.title(args.case)}", _RIVALS, rows, left=(0, 7))]
    lines = [f"* baseline {row.name}: {row.source}." for row in rows if row.source]
    began = f"{baselines.SLOW:g} m/s they began with"
    lines.append(f"hands: of {baselines.PAIRS} lossless pairs, faster after {baselines.SECONDS:g} s than the {began}.")
    lines += sorted({f"error: {row.reason}." for row in rows if row.reason})
    render.publish(args, report, shown, [*lines, f"{report.wall_s:.1f} s"], out, files)
    return options.exit_code(True, interrupted)


_RIVALS: dict[str, str | Callable[[baselines.Rival], str]] = {
    "": lambda r: f"{r.name}{' *' if r.baseline else ''}",
    "error %": lambda r: render.optional(r.error_percent, "{:.2f}"),
    "> 40 Hz N": "{r.fast_n:.3f}",
    "peak N": "{r.peak_n:.1f}",
    "acted %": "{r.acted_percent:.0f}",
    "hands": "{r.moving}",
    "m/s": "{r.fastest_m_s:.3f}",
    "guarantee": lambda r: "energy" if r.name == "energy budget" else r.guarantee or "none",
}


# ----------------------------------------------------------------------------------------------------
# The limits of any coupling along an axis.


def _limits(args: argparse.Namespace, scenario: Scenario) -> int:
    loop = scenario.loop(args.case)
    if min(loop.delta) <= 0:
        raise InputError(f"delta is {list(loop.delta)}, expected positive dampings in N s/m")
    with options.refused(args=args):
        asked = Options(**asked_of(args, "optimal"))
    plan, out = _plan(args, loop, asked), options.out_folder(args, "compare")
    begin = time.perf_counter()
    with render.progress("designing") as move:
        sweeps, interrupted = compare.limits(plan, args.beside, move)
    here = Here(loop.delta, loop.theta, loop.psi, loop.T)
    about = scenario.name, args.seed, args.case, asked.objective, args.keep, asked, here
    wall, gains = time.perf_counter() - begin, compare.gains(plan, sweeps, loop, asked)
    report = LimitCurves(*about, sweeps, gains, wall, interrupted)
    points = [(name, row) for name, sweep in sweeps.items() for row in sweep.curves["optimal"]]
    files = render.pictures(args, report, out, {"limits.png": "plot_limits"} if points else {})
    names = " and by ".join(args.beside)
    lines = [f"beside the optimum: the designed spring-damper by {names}"] if names else []
    lines += [f"{name} {row.value:.4g}: {row.reason}" for name, row in points if row.reason]
    tables = [_limit_table(report, name, args.beside) for name in sweeps]
    render.publish(args, report, tables, [*lines, *gains, f"{wall:.1f} s"], out, files)
    return options.exit_code(any(row.rms_mismatch_db is not None for _, row in points), interrupted)


def _plan(args: argparse.Namespace, loop: Loop, asked: Options) -> dict[str, list[Point]]:
    """The points of every sweep that is asked for. Raises InputError."""
    plan = {}
    for part in args.over.split(","):
        name, given, text = part.partition("=")
        if name not in AXES:
            raise InputError(f"--over has {name!r}, allowed are {', '.join(AXES)}")
        low, colon, high = text.partition(":")
        if given and not colon:
            raise InputError(f"--over {part}: expected LOW:HIGH in {AXES[name].unit}")
        ends = (options.numbers(f"--over {name}", end, float, 1)[0] for end in (low, high))
        span = (next(ends), next(ends)) if given else None
        with options.refused(f"--over {part}: "):
            plan[name] = points_along(name, loop, asked, args.points, span, args.keep)
    return plan


def _limit_table(report: LimitCurves, name: str, beside: Sequence[str]) -> Table:
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
    """'rational' where every design of a row is proved exactly, else the names of those that are only sampled."""
    found = {name: limit.proof for name, limit in limits.items() if limit and limit.proof}
    sampled = [name for name, proof in found.items() if proof != "rational"]
    if not found:
        return "-"
    return f"sampled: {', '.join(sampled)}" if sampled else "rational"
