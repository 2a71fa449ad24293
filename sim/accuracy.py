"""What one setting of an engine costs, and how wrong it is: measured in the same run, against the exact engine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.lti import Array
from sim.engines import LEAPFROG
from sim.report import error_part
from sim.run import Assembly, Record, simulate
from sim.stability import MARGINAL, close, dominant_mode, exact_growth, measured_hold

#: (engine, integrator, substeps) that are compared; the first is the reference
SETTINGS = (
    ("exact", None, None),
    *(("mujoco", "RK4", n) for n in (1, 2, 3, 4, 8)),
    *(("mujoco", LEAPFROG, n) for n in (1, 2, 4, 8)),
    *(("mujoco", "Euler", n) for n in (1, 4, 12)),
    *(("mujoco", "implicitfast", n) for n in (1, 4, 12)),
    *(("mujoco", "discrete", n) for n in (4, 12)),
)
REPEATS = 3  # the least of their times is the cost
TAIL = 4000  # ticks in which a limit cycle is measured
Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Reference:
    """The exact engine's answers: with the coupling that was asked for, and without any."""

    coupled: Assembly
    uncoupled: Assembly
    trace: Record
    cycle: tuple[int, float, float] | None  # channel, amplitude [N], frequency [Hz]; None where none is sustained


def reference(coupled: Assembly, uncoupled: Assembly) -> Reference:
    """Run the exact engine on both loops."""
    cycle = None
    if exact_growth(uncoupled) > MARGINAL:
        free = simulate(uncoupled, "exact")
        if free.s.shape[0] > TAIL and not free.diverged:
            channel = int(np.argmax(free.f[-TAIL:, :, 0].std(axis=0)))
            cycle = (channel, *limit_cycle(free, channel, uncoupled.scenario.T))
    return Reference(coupled, uncoupled, simulate(coupled, "exact"), cycle)


def measure(truth: Reference, engine: str, integrator: str | None, substeps: int | None) -> Row:
    """One row: errors of position [-], growth [1/s] and limit cycle [-], [Hz], and the cost of that very run."""
    row: Row = {"engine": engine, "integrator": integrator, "substeps": substeps}
    settings = (engine, integrator or "RK4", substeps or 1)
    record, wall = _timed(truth.coupled, *settings)
    for _ in range(REPEATS - 1):
        wall = min(wall, _timed(truth.coupled, *settings)[1])
    error = error_part(record, truth.trace, truth.coupled)
    row["position_relative_rms"] = error["position_relative_rms"]
    row |= _growth(truth, *settings) | _cycle(truth, *settings)
    row["wall_s_per_simulated_s"] = wall / (record.s.shape[0] * truth.coupled.scenario.T)
    return row


def _timed(assembly: Assembly, engine: str, integrator: str, substeps: int) -> tuple[Record, float]:
    begin = time.perf_counter()
    record = simulate(assembly, engine, integrator, substeps)
    if record.interrupted:  # a part of a run is no measurement
        raise KeyboardInterrupt
    return record, time.perf_counter() - begin


def limit_cycle(record: Record, channel: int, T: float) -> tuple[float, float]:
    """Standard deviation [N] and frequency [Hz] of a force's tail; the spectral peak is refined by a parabola."""
    force = record.f[-TAIL:, channel, 0]
    level = np.log(np.abs(np.fft.rfft((force - force.mean()) * np.hanning(force.size))) + 1e-300)
    peak = int(np.clip(np.argmax(level[1:-1]) + 1, 1, level.size - 2))
    low, mid, high = level[peak - 1 : peak + 2]
    curvature = low - 2 * mid + high
    shift = 0.5 * (low - high) / curvature if curvature else 0.0
    return float(force.std()), float((peak + shift) / (force.size * T))


def mark_front(rows: list[Row]) -> None:
    """Set `pareto`: no other row of that kind of engine is at least as good in cost and both errors, and better in one.

    The exact engine is on it by itself: only a linear plant has one.
    """
    points = np.array([_point(row) for row in rows])
    for i, row in enumerate(rows):
        rivals = points[[other["engine"] == row["engine"] for other in rows]]
        beaten = ((rivals <= points[i]).all(axis=1) & (rivals < points[i]).any(axis=1)).any()
        row["pareto"] = bool(np.isfinite(points[i]).all() and row["verdict_correct"] and not beaten)


def _growth(truth: Reference, engine: str, integrator: str, substeps: int) -> Row:
    """The larger growth-rate error of the two loops, and whether both verdicts are right."""
    errors, right = [], True
    for assembly in (truth.coupled, truth.uncoupled):
        own = dominant_mode(close(measured_hold(assembly, engine, integrator, substeps), assembly.F)).growth
        exact = exact_growth(assembly)
        errors.append(own - exact)
        right &= (own > MARGINAL) == (exact > MARGINAL)
    return {"growth_rate_error": float(max(errors, key=abs)), "verdict_correct": bool(right)}


def _cycle(truth: Reference, engine: str, integrator: str, substeps: int) -> Row:
    names = ("cycle_amplitude_n", "cycle_frequency_hz", "cycle_amplitude_error", "cycle_frequency_error_hz")
    if truth.cycle is None:
        return dict.fromkeys(names)
    channel, amplitude, frequency = truth.cycle
    record = simulate(truth.uncoupled, engine, integrator, substeps)
    if record.diverged:
        return dict.fromkeys(names)
    own, turns = limit_cycle(record, channel, truth.uncoupled.scenario.T)
    return dict(zip(names, (own, turns, own / amplitude - 1, turns - frequency), strict=True))


def _point(row: Row) -> Array:
    position = np.inf if row["position_relative_rms"] is None else row["position_relative_rms"]
    return np.array([row["wall_s_per_simulated_s"], position, abs(row["growth_rate_error"])])


if __name__ == "__main__":
    from cli.main import door

    door("accuracy")
