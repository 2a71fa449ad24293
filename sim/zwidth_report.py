"""A K-B map as JSON, CSV and a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from controller.lti import Array
from design.promises import CAVEATS, certificate_part, finite
from sim.files import write
from sim.gain_ground import Ground
from sim.gain_map import DECIDED, UNDECIDED, Map, Plan
from sim.gain_marks import Mark, Truth
from sim.oscillation import SUSTAINED, slowest_seen
from sim.stability import MARGINAL


def outcome(ground: Ground, drawn: Map, plan: Plan, population: dict[str, Any]) -> dict[str, Any]:
    """The whole map. Rows are stiffnesses; null is infinite, or not reached before an interruption."""
    known = np.isfinite(drawn.growth)
    unsafe = known & (drawn.growth > MARGINAL)
    part: dict[str, Any] = {
        "rigid": ground.network is None,
        "T": ground.T,
        "theta": list(ground.theta),
        "psi": list(ground.psi),
        "delta": list(ground.delta),
        "velocity_filter_hz": ground.cutoff,
        "one_sided": ground.walled is not None,
        "grid": {"K": drawn.grid.K.tolist(), "B": drawn.grid.B.tolist(), "scale": drawn.grid.scale},
    }
    for name, ratio in drawn.ratio.items():
        part[name] = {
            "required_over_available": _rows(drawn, ratio),
            "certified_cells": int((ratio < 1).sum()),
            "contradicted_cells": int(((ratio < 1) & unsafe).sum()),
        }
    if ground.multiplier[1]:
        part["theorem4"]["reason"] = ground.multiplier[1]
    part["population"] = {
        **population,
        "growth_rate_per_s": _rows(drawn, drawn.growth),
        "unstable_humans_at_least": _rows(drawn, drawn.unstable),
        "stable_cells": int((known & ~unsafe).sum()),
        "decided_cells": int(known.sum()),
    }
    part["simulation"] = _simulation(ground, drawn, plan)
    contradicted = sum(part[name]["contradicted_cells"] for name in drawn.ratio)
    disagree = 0 if part["simulation"]["nonlinear"] else part["simulation"]["differ_from_linear"]
    part["holds"] = contradicted == 0 and disagree == 0
    part["interrupted"] = drawn.interrupted
    part["wall_s"] = drawn.seconds
    part["not_covered"] = CAVEATS
    return part


def _simulation(ground: Ground, drawn: Map, plan: Plan) -> dict[str, Any]:
    points, (K, B) = drawn.points, drawn.grid.flat
    rows = [
        {
            "K": float(K[cell]),
            "B": float(B[cell]),
            "verdict": points.verdicts[i],
            "amplitude_m": finite(points.amplitude[i]),
            "frequency_hz": finite(points.frequency_hz[i]),
            "linear_growth_rate_per_s": finite(points.growth[i]),
            "differs_from_linear": bool(points.differ[i]),
        }
        for i, cell in enumerate(points.cell.tolist())
    ]
    devices = plan.effects.on(ground.devices)
    return {
        "effects": {
            "encoder_step_m": [device.encoder_step for device in devices],
            "friction_n": [device.friction for device in devices],
            "force_limit_n": [d.force_limit for d in devices] if plan.effects.saturation else None,
            "one_sided": ground.walled is not None,
        },
        "nonlinear": plan.effects.nonlinear(ground.devices) or ground.walled is not None,
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


def add_truth(outcome: dict[str, Any], found: dict[str, Truth | None]) -> None:
    """How far the map is from design.margin."""
    outcome["error"] = {
        name: truth
        and {"figure_relative": truth.ratio, "edge_relative_in_K": truth.edge, "columns_compared": truth.columns}
        for name, truth in found.items()
    }


def add_marks(outcome: dict[str, Any], marks: Sequence[Mark]) -> None:
    """What is asked about single couplings; the whole holds only if closed-loop certifies them all."""
    outcome["marks"] = [
        {
            "K": mark.K,
            "B": mark.B,
            **{name: certificate_part(requirement) for name, requirement in mark.requirement.items()},
            "growth_rate_per_s": finite(mark.growth),
            "unstable_humans": mark.unstable,
            "stiffest_K_at_this_B": {name: _beyond(K) for name, K in mark.stiffest.items()},
        }
        for mark in marks
    ]
    certified = all(mark.requirement["closed-loop"].certified for mark in marks)
    outcome["holds"] = outcome["holds"] and certified


def save_csv(drawn: Map, path: Path) -> Path:
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
        row += ["", ""] if i is None else _simulated(drawn, i)
        table.writerow(row)
    return write(path, text.getvalue())


def _simulated(drawn: Map, i: int) -> list[str]:
    points = drawn.points
    return [points.verdicts[i], f"{points.amplitude[i]:.4g}"]


def print_map(outcome: dict[str, Any], console: Console) -> None:
    """What the map says in a few lines."""
    cells = len(outcome["grid"]["K"]) * len(outcome["grid"]["B"])
    K, B = outcome["grid"]["K"], outcome["grid"]["B"]
    title = f"K {K[0]:.4g} to {K[-1]:.4g} N/m, B {B[0]:.4g} to {B[-1]:.4g} N s/m, {cells} couplings"
    table = Table(title=title, title_justify="left", show_header=False)
    errors = outcome.get("error", {})
    for name in ("theorem4", "closed-loop"):
        error = errors.get(name)
        near = f"; edge within {100 * error['edge_relative_in_K']:.2g} % of design.margin" if error else ""
        table.add_row(f"certified, {name}", f"{_share(outcome[name]['certified_cells'], cells)}{near}")
    crowd = outcome["population"]
    who = f"stable with all of {crowd['humans']} random humans"
    table.add_row(who, f"{_share(crowd['stable_cells'], cells)} ({crowd['decided_cells']} decided)")
    simulation = outcome["simulation"]
    if simulation["points"]:
        beside = f"{simulation['undecided']} {UNDECIDED}, {simulation['differ_from_linear']} unlike the linear loop"
        ends = f"{simulation['oscillate']} of {len(simulation['points'])} oscillate, {beside}"
        table.add_row(f"simulated{_effects(simulation)}", ends)
    table.add_row("seconds", ", ".join(f"{stage} {wall:.1f}" for stage, wall in outcome["wall_s"].items()) or "-")
    console.print(table)
    for mark in outcome.get("marks", ()):
        console.print(_mark_line(mark, crowd["humans"]))
    for line in _remarks(outcome):
        console.print(f"[dim]·[/] {line}")


def _mark_line(mark: dict[str, Any], humans: int) -> str:
    ends = ", ".join(f"{name} {_stiffest(K)}" for name, K in mark["stiffest_K_at_this_B"].items())
    needs = ", ".join(
        f"{name} needs {max(mark[name]['required_damping'], key=lambda d: d or np.inf) or np.inf:.6g} of "
        f"{min(mark[name]['available_damping']):.6g} N s/m "
        f"({'[green]certified[/]' if mark[name]['certified'] else '[red]not certified[/]'})"
        for name in ("theorem4", "closed-loop")
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


def _remarks(outcome: dict[str, Any]) -> list[str]:
    lines = []
    simulation = outcome["simulation"]
    for name in ("theorem4", "closed-loop"):
        if outcome[name].get("reason"):
            lines.append(f"{name}: {outcome[name]['reason']}.")
        if outcome[name]["contradicted_cells"]:
            lines.append(f"[red]CONTRADICTION[/]: {outcome[name]['contradicted_cells']} certified cells are unstable.")
    if not simulation["nonlinear"] and simulation["differ_from_linear"]:
        lines.append(f"[red]DISAGREEMENT[/]: MuJoCo and the linear loop at {simulation['differ_from_linear']} points.")
    if outcome["velocity_filter_hz"]:
        lines.append("The velocity filter is in all maps: it is linear, and part of the coupling.")
    if outcome["one_sided"]:
        lines.append(
            "One-sided contact: closed-loop and the population are about each frozen contact state, theorem4 (psi = 0) "
            "and the simulated points about contact made and broken."
        )
    if simulation["points"]:
        lines.append(
            f"A simulated point oscillates if, at the end of {simulation['duration_s']:g} s, an octave above "
            f"{simulation['from_hz']:.3g} Hz keeps {100 * SUSTAINED:g} % of its amplitude, over "
            f"{simulation['threshold_m']:g} m; {UNDECIDED} where the linear loop is within {DECIDED:g} 1/s of the edge."
        )
    if outcome["interrupted"]:
        lines.append("Interrupted: the map has what was finished.")
    return [*lines, *outcome["files"]]


def _share(count: int, cells: int) -> str:
    return f"{100 * count / cells:.1f} % of the map"


def _beyond(K: float | None) -> float | str | None:
    return "beyond the map" if K is not None and np.isinf(K) else K


def _rows(drawn: Map, values: Array) -> list[list[float | None]]:
    return [[finite(value) for value in row] for row in values.reshape(drawn.grid.shape).tolist()]
