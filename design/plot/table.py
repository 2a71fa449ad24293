"""The main numbers of couplings over frequency, as two tables with one row per coupling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table

from design.plot.curves import FEEL_HZ


def tables(outcome: dict[str, Any]) -> tuple[Table, Table]:
    """What `python -m design.plot` prints, from its JSON."""
    return _promises(outcome), _feel(outcome)


def _promises(outcome: dict[str, Any]) -> Table:
    """Required damping [N s/m] where all devices have the same, else as a multiple of what each has."""
    available = outcome["available_damping"]
    alike = len(set(available)) == 1
    damping = "required damping" if alike else "required share of the damping"
    where = f"{outcome['scenario']}, case {outcome['case']}"
    table = Table(title=f"{damping} of {_list(available)} N s/m · {where}")
    table.add_column("coupling", overflow="fold")
    for name in ("closed-loop", "at Hz", "theorem4", "at Hz", "M sup dB", "M rms dB"):
        table.add_column(name, justify="right")
    for coupling in outcome["couplings"]:
        parts = [coupling[condition] for condition in ("closed-loop", "theorem4")]
        scale = available[0] if alike else 1.0
        asked = [cell for part in parts for cell in (_needs(part, scale), _hertz(part["binding_frequency_hz"]))]
        errors = [_decibels(coupling["transparency"][f"{which}_mismatch_db"]) for which in ("relative", "rms")]
        table.add_row(coupling["name"], *asked, *errors)
    return table


def _feel(outcome: dict[str, Any]) -> Table:
    table = Table(title="perceived by each device's user, the other devices held still")
    table.add_column("coupling", overflow="fold")
    columns = [(what, unit, hz) for what, unit in (("stiffness", "N/m"), ("damping", "N s/m")) for hz in FEEL_HZ]
    for what, unit, hz in columns:
        table.add_column(f"{what}\n{unit}, {hz:g} Hz", justify="right")
    named = {"ideal (E)": outcome["ideal"], **{c["name"]: c["perceived"] for c in outcome["couplings"]}}
    for name, perceived in named.items():
        table.add_row(name, *(_list(_at(hz, outcome["frequency_hz"], perceived[what])) for what, _, hz in columns))
    return table


def _needs(part: dict[str, Any], scale: float) -> str:
    """The worst device's figure, green where it is certified."""
    if part["ratio"] is None:
        return "[red]infinite[/]"
    return f"[{'green' if part['certified'] else 'red'}]{scale * part['ratio']:.5g}[/]"


def _hertz(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _decibels(value: float | None) -> str:
    return "-inf" if value is None else f"{value:.2f}"


def _at(hz: float, grid: Sequence[float], values: Sequence[Sequence[float]]) -> list[float]:
    """Each channel's curve at `hz`, which is in the grid; nan above Nyquist's frequency."""
    return [float(np.interp(hz, grid, column, right=np.nan)) for column in np.transpose(values)]


def _list(values: Sequence[float]) -> str:
    """'1, 2', or '1' where all would read the same."""
    shown = [format(v, ".0f" if abs(v) >= 1000 else ".3g") for v in values]
    return shown[0] if len(set(shown)) == 1 else ", ".join(shown)
