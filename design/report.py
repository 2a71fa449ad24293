"""What a design came to, as tables; python -m design prints them."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from design.box.check import set_rows
from design.gains.frozen_environment import STIFFEST
from design.listed import listed


def tables(outcome: dict[str, Any]) -> list[Table]:
    """The design itself, the price of a set where it has one, the methods where they were compared."""
    shown = [_table(outcome)]
    if outcome["price"]:
        shown.append(_costs(outcome["price"]))
    if "comparison" in outcome:
        shown.append(_comparison(outcome["comparison"]))
    return shown


def _table(outcome: dict[str, Any]) -> Table:
    coupling, certificate, transparent = outcome["coupling"], outcome["certificate"], outcome["transparency"]
    table = Table(title=f"{coupling['kind']}, case {outcome['case']}, {certificate['condition']}", show_header=False)
    if coupling["K"]:
        table.add_row("K [N/m]", listed(coupling["K"]))
        if max(coupling["K"]) > 0.999 * STIFFEST:
            table.add_row("", f"{STIFFEST:g} N/m is where the search ends, no optimum of its own")
        table.add_row("B [N s/m]", listed(coupling["B"]))
    for part in outcome["certificates"].values():
        word = "certified" if part["certified"] else "not certified"
        required = listed(part["required_damping"])
        available = listed(part["available_damping"])
        table.add_row(f"damping, {part['condition']}", f"needs {required} of {available} N s/m: {word}")
    if part := outcome["jitter_proof"]:
        word = "certified" if part["certified"] else "not certified"
        span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(part["lo"], part["hi"], strict=True))
        needs = f"needs {listed(part['required_damping'])}: {word} (proof: {part['proof']})"
        table.add_row("damping, any switching", f"{span} samples: {needs}")
    for row in set_rows(outcome["set"]) if outcome["set"] else []:
        table.add_row(*row)
    stored = outcome["stored"]
    table.add_row("promise", outcome["promise"] or "none")
    if stored["switching"] and stored["switching"]["proof"]:
        table.add_row("promise, delays", stored["switching"]["promise"])
    table.add_row(outcome["objective_name"], f"{outcome['objective']:.5g}")
    sup, rms = transparent["relative_mismatch_db"], transparent["rms_mismatch_db"]
    table.add_row("mismatch", "none" if sup is None or rms is None else f"{sup:.2f} dB (rms {rms:.2f} dB)")
    table.add_row("convex problems", f"{outcome['sdps']} in {outcome['wall_s']:.2f} s")
    table.add_row("stored", f"{stored['file']} (proof: {stored['proof'] or stored['reason']})")
    if stored["switching"] and not stored["switching"]["proof"]:
        table.add_row("", f"for constant delays only: {stored['switching']['reason']}")
    return table


def _comparison(rows: list[dict[str, Any]]) -> Table:
    table = Table("method", "||W1 L W2||", "SDPs", "seconds", title="one state per channel, diagonal")
    for row in rows:
        norm = "-" if row["norm"] is None else f"{row['norm']:.4g}"
        table.add_row(row["method"], norm, str(row["sdps"]), f"{row['wall_s']:.1f}")
    return table


def _costs(rows: list[dict[str, Any]]) -> Table:
    """Each figure in the nominal environment, and the worst of the set."""
    title = "in the nominal environment / at the worst vertex"
    table = Table(
        "coupling", "needs of its damping", "vertices violated", "rms mismatch", "relative mismatch", title=title
    )
    for row in rows:
        pairs = [row[name] for name in ("required_over_available", "rms_mismatch_db", "relative_mismatch_db")]
        needs, rms, sup = (
            ["-" if v is None else f"{v:.{4 - 2 * (n > 0)}f}" for v in p.values()] for n, p in enumerate(pairs)
        )
        table.add_row(
            row["coupling"], " / ".join(needs), str(row["violated"]), f"{' / '.join(rms)} dB", f"{' / '.join(sup)} dB"
        )
    return table
