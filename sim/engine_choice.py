"""Speed against error for one's own scene: which engine and step keep an error that is asked for, at which cost.

The error is the relative rms of the encoders' positions over the run: against the exact loop on a smooth scene. Where
something rubs there is no exact loop; Runge-Kutta with n steps is compared with 2 n there, until they are near enough.
The method is of first order at least, so what n steps miss is at most twice the difference, and 2 n steps at most once.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.lti import Array
from sim.engines import EXPONENTIAL, default_integrator
from sim.run import Simulation, make_engine, run
from sim.scenario import InputError
from sim.stability import disagree, exact_growth
from sim.stepping import NEUTRAL, default_substeps, simulated_growth, step_radius
from sim.trace import Trace

_CANDIDATES = ((EXPONENTIAL, 1), ("RK4", 1), ("RK4", 2), ("RK4", 4), ("RK4", 8), ("Euler", 1), ("Euler", 4))
_MOST_COMPARED = 256  # substeps, where a refined run is the reference


@dataclass(frozen=True)
class EngineChoice:
    """One setting of MuJoCo's engines on a scene."""

    integrator: str
    substeps: int
    error: float  # relative rms of the encoders' positions over the run, at most
    right: bool  # whether the loop that it simulates has the exact loop's verdict
    cpu_s: float  # of that run

    @property
    def name(self) -> str:
        return f"{self.integrator} x {self.substeps}"

    def part(self) -> dict[str, Any]:
        """As plain data."""
        return {
            "integrator": self.integrator,
            "substeps": self.substeps,
            "position_relative_rms": self.error if math.isfinite(self.error) else None,
            "verdict_correct": self.right,
            "cpu_s": self.cpu_s,
        }


def compare_engines(simulation: Simulation, error: float, ticks: int | None = None) -> tuple[EngineChoice, ...]:
    """Every setting that is stable on the scene's plant, the cheapest first, over `ticks` of the scenario (all).

    Where something rubs the reference is refined until RK4 keeps `error`. Raises InputError where it cannot.
    """
    if not error > 0:
        raise InputError(f"--error is {error:g}, expected a positive relative error")
    ticks = simulation.scenario.samples if ticks is None else ticks
    runs: dict[tuple[str, int], tuple[Array, float]] = {}
    if default_integrator(simulation.scene) == EXPONENTIAL:
        settings = list(dict.fromkeys((*_CANDIDATES, ("RK4", default_substeps(simulation, "RK4")))))
        truth, missed = _timed(simulation, ticks, "exact")[0], 0.0
    else:
        truth, missed = _refined(simulation, error, ticks, runs)
        settings = [*runs, *((name, n) for name, n in _CANDIDATES if name != "RK4")]
    choices = []
    for name, n in settings:
        if name != EXPONENTIAL and step_radius(simulation.smooth.even, name, n) > 1 + NEUTRAL:
            continue
        own, cost = runs.get((name, n)) or _timed(simulation, ticks, "mujoco", name, n)
        choices.append(EngineChoice(name, n, _apart(own, truth) + missed, _right(simulation, name, n), cost))
    return tuple(sorted(choices, key=lambda choice: choice.cpu_s))


def pick(choices: Sequence[EngineChoice], error: float) -> EngineChoice:
    """The cheapest that keeps the error and the verdict. Raises InputError where none does."""
    kept = [choice for choice in choices if choice.right and choice.error <= error]
    if kept:
        return min(kept, key=lambda choice: choice.cpu_s)
    best = min(choices, key=lambda choice: choice.error)
    raise InputError(f"--error {error:g}: the nearest, {best.name}, is within {best.error:.1g}")


def cross_check(
    simulation: Simulation, trace: Trace, integrator: str | None, own_substeps: int | None
) -> dict[str, Any]:
    """The run again by RK4, which shares no matrix with the exponential and the exact engine; by it, if RK4 ran.

    `simulation` is what ran, with its net; integrator and substeps are None for the exact engine. Positions are
    compared as far as neither ended before its time.
    """
    other = EXPONENTIAL if integrator == "RK4" else "RK4"
    linear = simulation.smooth.even
    substeps = default_substeps(linear, other)
    beside = run(simulation, make_engine(simulation, "mujoco", other, substeps), ticks=trace.t.size)
    ticks, m = min(trace.t.size, beside.t.size), simulation.process.channels
    growth = simulated_growth(linear, other, substeps)
    own = simulated_growth(linear, integrator, own_substeps) if integrator and own_substeps else exact_growth(linear)
    apart = _apart(trace.s[:ticks, :m], beside.s[:ticks, :m])
    return {
        "integrator": other,
        "substeps": substeps,
        "position_relative_rms": apart if math.isfinite(apart) else None,
        "growth_rate_per_s": growth,
        "growth_rate_difference_per_s": growth - own,
        "agrees": not disagree(own, growth) and trace.diverged == beside.diverged,
    }


def _refined(
    simulation: Simulation, error: float, ticks: int, runs: dict[tuple[str, int], tuple[Array, float]]
) -> tuple[Array, float]:
    """(positions of a run by RK4, the most that it misses), fine enough to judge the error; all runs are kept."""
    substeps, best = 1, math.inf
    runs["RK4", 1] = _timed(simulation, ticks, "mujoco", "RK4", 1)
    while 2 * substeps <= _MOST_COMPARED:
        runs["RK4", 2 * substeps] = _timed(simulation, ticks, "mujoco", "RK4", 2 * substeps)
        missed = _apart(runs["RK4", substeps][0], runs["RK4", 2 * substeps][0])
        substeps, best = 2 * substeps, min(best, 2 * missed)
        if 2 * missed <= error:
            return runs["RK4", substeps][0], missed
    raise InputError(f"--error {error:g}: RK4 comes within {best:.1g} with up to {_MOST_COMPARED // 2} substeps")


def _right(simulation: Simulation, integrator: str, substeps: int) -> bool:
    linear = simulation.smooth.even
    return not disagree(exact_growth(linear), simulated_growth(linear, integrator, substeps))


def _timed(
    simulation: Simulation, ticks: int, engine: str, integrator: str | None = None, substeps: int | None = None
) -> tuple[Array, float]:
    """Positions (N, m) of a run from rest, with its CPU seconds."""
    stepped = make_engine(simulation, engine, integrator, substeps)
    begin = time.process_time()
    trace = run(simulation, stepped, ticks=ticks)
    if trace.interrupted:  # a part of a run is no measurement
        raise KeyboardInterrupt
    return trace.s[:, : simulation.process.channels], time.process_time() - begin


def _apart(own: Array, truth: Array) -> float:
    """Relative rms difference; infinite where one of them ended before its time."""
    if own.shape != truth.shape:
        return math.inf
    scale = float(np.mean(truth**2))
    return math.sqrt(float(np.mean((own - truth) ** 2)) / scale) if scale else 0.0
