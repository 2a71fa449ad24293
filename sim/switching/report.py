"""What a run with varying delays says: the delays it met, whether it grew, and what certificates cover."""

from __future__ import annotations

from typing import Any

import numpy as np

from controller.delay import LOST, Ticks, ages
from controller.jitter import Jitter
from design.listed import listed
from design.promises import finite
from sim import report
from sim.batch_engine import ExactBatchEngine
from sim.couplings import Chosen
from sim.exact_engine import HeldPlant
from sim.loop import Record
from sim.simulate import Assembly
from sim.stability import clipped_ticks, close, dominant_mode
from sim.switching.coverage import certified_part
from sim.switching.switched import knocked, unlimited
from sim.switching.worst import Period

JUDGED = 4.0  # [s] at most of the linear loop from which a growth is read: later numbers may overflow


def part(
    assembly: Assembly, chosen: Chosen, period: Period | None, ticks: int, certified: bool
) -> dict[str, Any] | None:
    """All that a report says of delays that vary; None where the scenario has no jitter."""
    scenario = assembly.scenario
    if scenario.jitter is None:
        return None
    met = run_part(assembly, period, ticks) if scenario.switches else {}
    return range_part(scenario.jitter) | met | certified_part(scenario, chosen, certified)


def range_part(jitter: Jitter) -> dict[str, Any]:
    """The range of delays and how they vary within it."""
    return {
        "lo": list(jitter.lo),
        "hi": list(jitter.hi),
        "pattern": jitter.pattern,
        "loss": jitter.loss,
        "playout": jitter.playout,
        "constant": jitter.steady,
    }


def run_part(switched: Assembly, period: Period | None, ticks: int) -> dict[str, Any]:
    """The delays that a run met, and the growth of its linear loop under them."""
    delays = switched.process.delays
    assert delays is not None
    met = ages(delays[:ticks])[..., 0]
    used = met[(met >= 0).all(axis=1)]
    growth, window = _growth(switched, ticks)
    return {
        "age": _age(used),
        "lost_packets": (delays[:ticks] == LOST).sum(axis=(0, 2)).tolist(),
        "held_ticks": (np.diff(used, axis=0) == 1).sum(axis=0).tolist(),
        "growth_rate_per_s": finite(growth),
        "verdict": "unstable" if growth > 0 else "stable",
        "judged_s": window,
        "period": None
        if period is None
        else {
            "ticks": len(period.ages),
            "growth_rate_per_s": finite(period.growth),
            "spectral_radius": period.spectral_radius,
            "verdict": "unstable" if period.growth > 0 else "stable",
        },
    }


def _age(used: Ticks) -> dict[str, Any] | None:
    """Of the forces in use [samples], per channel, from the first arrival on; None where none arrives."""
    if not used.size:
        return None
    figures = {"least": used.min(axis=0), "largest": used.max(axis=0), "mean": used.mean(axis=0)}
    return {name: values.tolist() for name, values in figures.items()}


def _growth(switched: Assembly, ticks: int) -> tuple[float, float]:
    """(rate [1/s], window [s]) of the exact linear loop after a knock, under the run's first delays."""
    T, plant = switched.scenario.T, switched.plant
    judged = max(4, min(ticks, round(JUDGED / T)))
    one = HeldPlant(plant.A[None], plant.B[None], plant.C, T)
    process = unlimited(switched.process)
    engine = ExactBatchEngine(one, process.force_limit)
    return float(knocked(process, engine, switched.scene, plant.A.shape[0], judged, 1).rate[0]), judged * T


def stability_part(assembly: Assembly, record: Record, jitter: dict[str, Any]) -> dict[str, Any]:
    """As report.stability_part, for a loop that switches: it has no eigenvalue of its own but over a period."""
    worst = jitter["period"] or jitter
    constant = report.eigenvalue_part(dominant_mode(close(assembly.plant, assembly.F)))
    verdict = "unstable" if record.diverged or "unstable" in (worst["verdict"], jitter["verdict"]) else "stable"
    return {
        "verdict": verdict,
        "clipped_ticks": int(clipped_ticks(record, assembly.process.force_limit).sum()),
        "growth_rate_per_s": worst["growth_rate_per_s"],
        "frequency_hz": report.dominant_frequency(record, assembly.scenario.T),
        **constant,
        "reason": _how(jitter)
        + f"; the eigenvalues are those of the constant delay theta = {listed(assembly.scenario.theta)}",
    }


def _how(jitter: dict[str, Any]) -> str:
    if jitter["period"]:
        return f"growth by the eigenvalues of the product over the {jitter['period']['ticks']} ticks of a period"
    return f"growth of the linear loop after a knock, over {jitter['judged_s']:.3g} s under the run's delays"
