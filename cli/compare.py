"""python -m design.compare: run the same devices and hands with every coupling, or compare couplings over frequency.

Without --coupling, the table has one row for each coupling of sim.comparison that suits the loop. The row of a failed
design gives the reason. In loops without walls and friction each coupling also runs with the scenario's hands;
couplings.png shows the forces of all couplings but the paper's gains. With --coupling, the named couplings are drawn
over frequency.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli.painter import skip_docstrings
from haptic_loop.controller.lti import Array
from haptic_loop.design.compare import FEEL_HZ
from haptic_loop.design.conditions import Condition
from haptic_loop.design.result import PLAIN_CONDITIONS, Chosen, DesignFailed, finite, held_torques
from haptic_loop.sim.comparison import Alternative, ComparedCoupling, Comparison, ConditionCurve, alternatives
from haptic_loop.sim.couplings import NAMES, choose
from haptic_loop.sim.scenario import InputError, Scenario, require_no_world
from haptic_loop.sim.stability import MARGINAL

_MOST = 6  # largest number of curves that can be distinguished in one panel


def main(argv: list[str]) -> int:
    """Compare couplings. Return 0, or 1 if a coupling of --coupling could not be designed.

    Ctrl-C ends the command without a report, because an incomplete table may lack the best coupling.
    """
    args = _parser().parse_args(argv)
    scenario = options.scenario_from(args)
    require_no_world(scenario, "design.compare")
    return _couplings(args, scenario) if args.coupling else _alternatives(args, scenario)


def _parser() -> options.Parser:
    two = "python -m design.compare --coupling published,spring-damper:any-environment,optimal"
    what = "Run the same devices and hands with every coupling, or compare the couplings of --coupling over frequency."
    parser = options.Parser(
        "design.compare", what, "python -m design.compare", two, first="scenario coupling condition reference out json"
    )
    parser.add_loop()
    names = f"{', '.join(NAMES)} or FILE.json, separated by commas; NAME:CONDITION designs for a condition"
    parser.add_argument("--coupling", type=_names, metavar="NAME,FILE,..", help=f"compare over frequency: {names}")
    parser.add_condition(
        "condition for names without :CONDITION (default: depends on the coupling); "
        "a condition of your own is evaluated for every coupling"
    )
    parser.add_output(picture=True, seed=False)
    return parser


# ---- every coupling with the same devices and hands


@dataclass(frozen=True)
class _Alternatives:
    """Figures of every coupling with the same devices and hands."""

    scenario: str
    case: str
    alternatives: list[Alternative]


def _alternatives(args: argparse.Namespace, scenario: Scenario) -> int:
    if isinstance(args.condition, str):
        raise InputError("--condition is for the designs of --coupling; give --coupling or leave out --condition")
    out = options.out_folder(args, "compare")
    with render.progress("running every coupling") as move:
        rows = alternatives(scenario, args.case, move, args.condition)
    files = []
    render.remove_earlier(out, "couplings.png")
    if any(each.trace is not None for each in rows) and not args.no_plot:
        files.append(_side_by_side(rows, out / "couplings.png", scenario.environment.contacts))
    report = _Alternatives(scenario.name, args.case, rows)
    tables = [_beside(rows, args.condition)]
    render.publish(args, report, tables, _held(scenario, args.case), out, files, _nearest(rows))
    return options.exit_code(True)


def _nearest(couplings: Sequence[Alternative]) -> str:
    """Return a sentence that names the guaranteed coupling of least force error, and its static stiffness.

    Among couplings of equal error it names the coupling whose share of the static stiffness is nearest to 1.
    """
    guaranteed = [each for each in couplings if each.guarantee]
    if not guaranteed:
        return "No coupling of the table has a guarantee."

    def distance(each: Alternative) -> tuple[float, float]:
        static = 0.0 if each.dc_ratio is None else abs(1 - each.dc_ratio)
        return math.inf if each.force_error_percent is None else each.force_error_percent, static

    best = min(guaranteed, key=distance)
    if best.force_error_percent is None and best.dc_ratio is None:
        return "No force error was measured, and the object has no static stiffness: the nearest coupling is not known."
    error = render.optional(best.force_error_percent, "{:.3g} % force error", "no force error was measured")
    static = "no static stiffness" if best.dc_ratio is None else f"{_share(best.dc_ratio, '-')} of the stiffness"
    return (
        f"Of the couplings with a guarantee, {best.name} ({best.guarantee}) is nearest to the object: "
        f"{static}, {error}."
    )


def _beside(couplings: Sequence[Alternative], own: Condition | None) -> render.Table:
    names, cells = [*PLAIN_CONDITIONS, *([own.name] if own else [])], []
    for each in couplings:
        if each.reason:
            cells.append((each.name, *[""] * len(names), f"not possible: {each.reason}", "", ""))
            continue
        needs = (_share(each.needs(condition), "never") for condition in names)
        grows = each.growth_rate_per_s is None or each.growth_rate_per_s > MARGINAL
        error = "grows" if grows else render.optional(each.force_error_percent, "{:.3g} %")
        cells.append((each.name, *needs, each.guarantee or "none", _share(each.dc_ratio, "-"), error))
    heads = ("coupling", *map(render.short, names), "guarantee", "stiffness", "error")
    title = "required damping in % of the devices' damping, guarantee,\nrendered stiffness and force error"
    return render.grid(title, heads, cells, left=(0, heads.index("guarantee")))


def _side_by_side(couplings: Sequence[Alternative], path: Path, names: tuple[str, ...]) -> Path:
    skip_docstrings()
    from haptic_loop.sim.plots import Panel, plot_side_by_side

    panels = [
        Panel(_panel_title(each), each.trace.signals, each.ideal, each.until_s)
        for each in couplings
        if each.trace is not None and each.ideal is not None and each.coupling != "published"
    ]
    return plot_side_by_side(panels, path, names)


def _panel_title(each: Alternative) -> str:
    kind = ", spring-damper" if each.coupling == "spring-damper" else ""
    guarantee = f"guarantee: {each.guarantee}" if each.guarantee else "no guarantee"
    felt = f"grows: {render.optional(each.growth_rate_per_s, '{:+.2f} 1/s')}"
    if each.force_error_percent is not None:
        felt = f"force error {each.force_error_percent:.2g} %"
    return f"{'no coupling' if each.coupling == 'none' else each.name + kind}\n{felt}; {guarantee}"


def _share(value: float | None, absent: str) -> str:
    return absent if value is None else f"{100 * value:.3g} %" if value < 10 else f"{100 * value:.0f} %"


def _held(scenario: Scenario, case: str) -> list[str]:
    torques = held_torques(scenario.loop(case))
    return [f"Held torques: {torques}."] if torques else []


# ---- couplings over frequency


def _couplings(args: argparse.Namespace, scenario: Scenario) -> int:
    out = options.out_folder(args, "compare")
    chosen, failed = _chosen(scenario, args, args.coupling)
    report = Comparison.of(scenario, args.case, chosen, failed)
    files = render.pictures(args, report, out, _PICTURES)
    lines = [*report.notes, *_held(scenario, args.case)]
    tables = [_guarantees(report), _feel(report)]
    render.publish(args, report, tables, lines, out, files, _guaranteed(report))
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
        raise argparse.ArgumentTypeError(f"is {text!r}: a name is repeated")
    if len(names) > _MOST:
        raise argparse.ArgumentTypeError(f"has {len(names)} entries, allowed are 1 to {_MOST}")
    return names


def _chosen(scenario: Scenario, args: argparse.Namespace, names: Sequence[str]) -> tuple[dict[str, Chosen], list[str]]:
    """Return the couplings by name, and one line for each failed design. Raises DesignFailed if all failed."""
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
    """Split NAME:CONDITION; the condition is None if it is missing. Raises InputError for a wrong condition."""
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


def _guarantees(report: Comparison) -> render.Table:
    """Return the table of required damping [N s/m], or of required over available if the devices' dampings differ."""
    available = report.available_damping
    alike = len(set(available)) == 1
    damping = "required damping" if alike else "required share of the damping"
    title = (
        f"{damping} (available: {_list(available)} N s/m; at 10 %: the largest requirement after a "
        f"change by +10 % or -10 % of a stiffness, of all stiffnesses or of a mass) · {report.scenario}, "
        f"case {report.case}"
    )
    scale = available[0] if alike else 1.0
    cells: dict[str, Callable[[ComparedCoupling], str]] = {"coupling": lambda c: c.name}
    for i, condition in enumerate(report.conditions):
        cells |= {
            render.short(condition): lambda c, of=condition: _needs(c.conditions[of], scale),
            "at Hz" + " " * i: lambda c, of=condition: _binds(c.conditions[of]),
        }
        if i == 0:
            cells["at 10 %"] = lambda c: render.optional(
                c.robustness and scale * c.robustness.required_over_available, "{:.4g}"
            )
    cells |= {
        "sup dB": lambda c: _mismatch(c, "mismatch_db"),
        "rms dB": lambda c: _mismatch(c, "rms_mismatch_db"),
    }
    return render.columns(title, cells, report.couplings)


def _guaranteed(report: Comparison) -> str:
    words = [f"{coupling.name} ({coupling.assessment.guarantee_words or 'none'})" for coupling in report.couplings]
    return f"Guarantee: {', '.join(words)}."


def _mismatch(coupling: ComparedCoupling, of: str) -> str:
    figures = coupling.assessment.transparency
    return "-" if figures is None else render.optional(finite(getattr(figures, of)), "{:.2f}", "-inf")


def _binds(part: ConditionCurve) -> str:
    hz = part.requirement.frequency_hz
    # A sweep may find a maximum at w = 0 at up to 1e-5 rad/sample (1.6 mHz at T = 1 ms): finer digits mean nothing.
    return render.optional(hz and round(hz, 3), "{:.4g}")


def _needs(part: ConditionCurve, scale: float) -> str:
    """Return `scale` times the worst device's required over available damping; green if certified."""
    need = "infinite" if np.isinf(part.ratio) else f"{scale * part.ratio:.5g}"
    return f"[{'green' if part.requirement.certified else 'red'}]{need}[/]"


def _feel(report: Comparison) -> render.Table:
    columns = [(what, unit, hz) for what, unit in (("stiffness", "N/m"), ("damping", "N s/m")) for hz in FEEL_HZ]
    heads = ["coupling", *(f"{what}\n{unit}, {hz:g} Hz" for what, unit, hz in columns)]
    named = {"ideal (E)": report.ideal, **{c.name: c.curves.perceived for c in report.couplings}}

    def at(hz: float, curves: Array) -> list[float]:
        """Return the value of each channel's curve at `hz`; nan above Nyquist's frequency."""
        return [float(np.interp(hz, report.frequency_hz, column, right=np.nan)) for column in curves.T]

    rows = [[name, *(_list(at(hz, getattr(felt, what))) for what, _, hz in columns)] for name, felt in named.items()]
    return render.grid("perceived on each channel, the other channels held still", heads, rows)


def _list(values: Iterable[float]) -> str:
    """Return the values separated by commas, or one value if all are equal."""
    shown = [format(v, ".0f" if abs(v) >= 1000 else ".3g") for v in values]
    return shown[0] if len(set(shown)) == 1 else ", ".join(shown)
