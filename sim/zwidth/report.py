"""A K-B map as JSON and CSV; sim.zwidth.text prints it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from controller.lti import Array
from design.assess import CONDITIONS
from design.promises import CAVEATS, certificate_part, finite
from sim.files import write
from sim.oscillation import slowest_seen
from sim.stability import MARGINAL
from sim.zwidth.loop import MapLoop
from sim.zwidth.map import Map
from sim.zwidth.marks import Mark, Truth
from sim.zwidth.simulation import UNDECIDED, Plan

NOT_REACHED = "not reached before the interruption"


def outcome(ground: MapLoop, drawn: Map, plan: Plan, population: dict[str, Any]) -> dict[str, Any]:
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
        "conditions": list(drawn.ratio),
        "grid": {"K": drawn.grid.K.tolist(), "B": drawn.grid.B.tolist(), "scale": drawn.grid.scale},
    }
    for name, ratio in drawn.ratio.items():
        reason = _nulls(ground, drawn, name)
        part[name] = ({"reason": reason} if reason else {}) | {
            "required_over_available": _rows(drawn, ratio),
            "certified_cells": int((ratio < 1).sum()),
        }
        if name in CONDITIONS:  # the population meets the loop that they are about
            part[name]["contradicted_cells"] = int(((ratio < 1) & unsafe).sum())
    part["population"] = {
        **population,
        "growth_rate_per_s": _rows(drawn, drawn.growth),
        "unstable_humans_at_least": _rows(drawn, drawn.unstable),
        "stable_cells": int((known & ~unsafe).sum()),
        "decided_cells": int(known.sum()),
    } | ({"reason": f"null: {NOT_REACHED}"} if np.isnan(drawn.growth).any() else {})
    part["simulation"] = _simulation(ground, drawn, plan)
    contradicted = sum(part[name]["contradicted_cells"] for name in CONDITIONS)
    disagree = 0 if part["simulation"]["nonlinear"] else part["simulation"]["differ_from_linear"]
    part["holds"] = contradicted == 0 and disagree == 0
    part["interrupted"] = drawn.interrupted
    part["wall_s"] = drawn.seconds
    part["not_covered"] = CAVEATS
    return part


def _nulls(ground: MapLoop, drawn: Map, name: str) -> str | None:
    """Why a condition has cells without a figure, in words of one such cell; None where it has none."""
    if name in ground.refusals:
        return ground.refusals[name]
    ratio, (K, B) = drawn.ratio[name], drawn.grid.flat
    unreached, infinite = np.isnan(ratio), np.flatnonzero(np.isposinf(ratio))
    parts = [f"null at {unreached.sum()} cells: {NOT_REACHED}"] if unreached.any() else []
    if infinite.size:
        first = infinite[0]
        why = ground.requirement(name, float(K[first]), float(B[first])).reason or "the figure grows without end"
        at = f"at K {K[first]:.4g}, B {B[first]:.4g}, {why}"
        parts.append(f"null at {infinite.size} cells: no damping is enough; {at}")
    return "; ".join(parts) or None


def _simulation(ground: MapLoop, drawn: Map, plan: Plan) -> dict[str, Any]:
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


def _beyond(K: float | None) -> float | str | None:
    return "beyond the map" if K is not None and np.isinf(K) else K


def _rows(drawn: Map, values: Array) -> list[list[float | None]]:
    return [[finite(value) for value in row] for row in values.reshape(drawn.grid.shape).tolist()]
