"""The limit curve and the ladder as tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from design.limits.curve import AXES, Limit, Setting
from design.parameter.wish import Wish
from design.store import Loop

Curves = dict[str, dict[str, list[Limit]]]  # sweep -> design -> its points
EXACT_DB = -60.0  # below it the difference to the environment is the solver's


def gains(plan: dict[str, list[Setting]], curves: Curves, loop: Loop, wish: Wish) -> list[str]:
    """What there is to gain, in a line per sweep."""
    lines = []
    for name, rows in curves.items():
        found = [(limit, _figure(limit, wish.objective)) for limit in rows["optimal"]]
        known = [(limit, figure) for limit, figure in found if figure is not None]
        if len(known) < 2:
            continue
        here = next((s.value for s in plan[name] if s.loop == loop and s.wish == wish), None)
        words = [
            f"{_decibels(figure)} at {limit.value:.4g}" + (" (here)" if limit.value == here else "")
            for limit, figure in known
            if limit in (known[0][0], known[-1][0]) or limit.value == here
        ]
        lines.append(f"{name} in {AXES[name].unit}: {', '.join(words)}")
    bare = next((limit for rows in curves.values() for limit in rows["optimal"] if _is(limit, loop)), None)
    needs = [b for b in bare.bare_damping if b is not None] if bare else []
    if len(needs) == len(loop.delta):
        need = ", ".join(f"{b:.4g}" for b in needs)
        share = max(b / d for b, d in zip(needs, loop.delta, strict=True))
        lines.append(f"without any coupling: needs {need} N s/m, {share:.3g} times what the devices have")
    return lines


def _is(limit: Limit, loop: Loop) -> bool:
    return (limit.delta, limit.theta, limit.T_s) == (loop.delta, loop.theta, loop.T)


def _figure(limit: Limit, objective: str) -> float | None:
    return limit.rms_mismatch_db if objective == "rms" else limit.relative_mismatch_db


def _decibels(value: float) -> str:
    """In case I a loop that needs no coupling reaches minus infinity, of which a solver finds some -60 to -120 dB."""
    return f"below {EXACT_DB:g} dB" if value < EXACT_DB else f"{value:.2f} dB"


def print_curves(outcome: dict[str, Any], beside: Sequence[str], screen: Console) -> None:
    """A table per sweep; reasons, gains and files below."""
    reasons: list[str] = []
    for name, sweep in outcome["sweeps"].items():
        table = Table(
            title=f"{outcome['objective']} mismatch over {name} · {outcome['scenario']}, case {outcome['case']}"
        )
        table.add_column(sweep["unit"], justify="right")
        table.add_column("theta")
        for column in ("optimal", *beside, "proof", "seconds"):
            table.add_column(column, justify="right", no_wrap=True)
        for i, row in enumerate(sweep["optimal"]):
            others = [sweep[kind][i] if i < len(sweep[kind]) else None for kind in beside]
            shown = [_shown(limit, outcome["objective"]) for limit in (row, *others)]
            proof = _proofs(dict(zip(("optimal", *beside), (row, *others), strict=True)))
            place = f"{row['value']:.4g}", ",".join(map(str, row["theta"]))
            table.add_row(*place, *shown, proof, f"{row['wall_s']:.1f}")
            reasons += [f"{name} {row['value']:.4g}: {row['reason']}"] if row["reason"] else []
        screen.print(table)
    if beside:
        reasons = [f"beside the optimum: the designed spring-damper by {' and by '.join(beside)}", *reasons]
    for line in (*reasons, *outcome["gains"]):
        screen.print(f"[dim]·[/] {line}")
    screen.print(f"{outcome['wall_s']:.1f} s; files: {', '.join(outcome['files'])}", soft_wrap=True)


def _proofs(limits: dict[str, dict[str, Any] | None]) -> str:
    """Rational where every design of a row is proved exactly, else which are only sampled."""
    found = {name: limit["proof"] for name, limit in limits.items() if limit and limit["proof"]}
    sampled = [name for name, proof in found.items() if proof != "rational"]
    if not found:
        return "-"
    return f"sampled: {', '.join(sampled)}" if sampled else "rational"


def _shown(limit: dict[str, Any] | None, objective: str) -> str:
    if limit is None:
        return ""
    value = limit["rms_mismatch_db" if objective == "rms" else "relative_mismatch_db"]
    return "infeasible" if value is None else _decibels(value)


def print_ladder(outcome: dict[str, Any], cases: Sequence[str], screen: Console) -> None:
    """A table per case, reasons and files below."""
    for case in cases:
        screen.print(_rungs(case, [row for row in outcome["rows"] if row["case"] == case], outcome["scenario"]))
    for row in outcome["rows"]:
        if row["reason"]:
            screen.print(f"[dim]·[/] {row['design']}, case {row['case']}: {row['reason']}")
    screen.print("[dim]·[/] no HF limit: without |F| <= 1.5 |E| above 100 Hz, which the default design keeps.")
    screen.print(f"{outcome['wall_s']:.1f} s; files: {', '.join(outcome['files'])}", soft_wrap=True)


def _rungs(case: str, rows: Sequence[dict[str, Any]], scenario: str) -> Table:
    table = Table(title=f"the ladder · {scenario}, case {case}")
    for i, column in enumerate(("design", "needs N s/m", "sup dB", "rms dB", "proof", "s")):
        table.add_column(column, justify="left" if i in (0, 4) else "right", no_wrap=i > 0)
    for row in rows:
        need = "inf" if row["required_damping"] is None else f"{max(row['required_damping']):.4f}"
        need += "" if row["certified"] else " (no)"
        figures = ["exact" if v is None else f"{v:.2f}" for v in (row["relative_mismatch_db"], row["rms_mismatch_db"])]
        if row["reason"] and row["required_damping"] is None:
            need, figures = "-", ["-", "-"]
        table.add_row(row["design"], need, *figures, row["proof"] or "-", f"{row['wall_s']:.2f}")
    return table
