"""A K-B map: both certificates and the population over the whole grid, MuJoCo at a sparse part of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti
from sim.stability import MARGINAL
from sim.zwidth.cells import in_slices
from sim.zwidth.grid import Grid
from sim.zwidth.loop import MapLoop
from sim.zwidth.population import Holders
from sim.zwidth.simulation import Plan, Points, no_points, simulated

SLICE, SAMPLE = 60, 25  # cells in one pass of a condition; cells that tell which humans are the leading ones

Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True, eq=False)
class Map:
    """Over the grid, (cells,) each, B running fastest; nan where the keyboard came first."""

    grid: Grid
    ratio: dict[str, Array]  # condition -> required over available damping
    growth: Array  # [1/s] worst over the humans that were tried: all of them where none is unstable
    unstable: Array  # humans that make the cell unstable, at least
    points: Points
    seconds: dict[str, float]  # of each stage
    interrupted: bool


def draw_map(ground: MapLoop, grid: Grid, holders: Holders, plan: Plan, progress: Progress) -> Map:
    """All stages; Ctrl-C keeps what is done."""
    gains = ground.gains(*grid.flat)
    seconds, n = {}, len(gains)
    ratio: dict[str, Array] = {name: np.full(n, np.nan) for name in ground.conditions}
    growth, unstable = np.full((2, n), np.nan)
    points, stopped = no_points(), False

    def ratios(part: slice) -> tuple[Array, ...]:
        return tuple(ground.ratios(name, gains.take(part)) for name in ground.conditions)

    def population(part: slice) -> tuple[float, int]:
        return _population(holders, [stack[part.start] for stack in stacks], leading)

    begin = time.perf_counter()
    _ = ground.refusals  # once, before threads ask for it
    done, stopped = in_slices(ratios, n, SLICE, lambda k, of: progress("certificates", k, of))
    for part, values in done:
        for name, value in zip(ground.conditions, values, strict=True):
            ratio[name][part] = value
    seconds["certificates"] = time.perf_counter() - begin
    if not stopped:
        begin = time.perf_counter()
        stacks = ground.force_maps(gains)
        sample = np.unique(np.linspace(0, n - 1, min(SAMPLE, n)).astype(int))
        leading = holders.leading([stacks[0][i] for i in sample])
        done, stopped = in_slices(population, n, 1, lambda k, of: progress("population", k, of))
        for part, values in done:
            growth[part], unstable[part] = values
        seconds["population"] = time.perf_counter() - begin
    if not stopped and plan.points:
        begin = time.perf_counter()
        cells = grid.subset(plan.points)
        points, stopped = simulated(ground, grid, holders, plan, cells, lambda k, of: progress("MuJoCo", k, of))
        seconds["simulation"] = time.perf_counter() - begin
    return Map(grid, ratio, growth, unstable, points, seconds, stopped)


def _population(holders: Holders, states: Sequence[Lti], leading: NDArray[np.bool_]) -> tuple[float, int]:
    """Worst growth and number of unstable humans among the leading ones, or, if none of these, among all.

    `states` are the force maps of one cell; a human is unstable if it is with any of them.
    """
    growth = np.max([holders.growth(F, leading)[0] for F in states], axis=0)
    if not (growth > MARGINAL).any() and not leading.all():
        rest = np.max([holders.growth(F, ~leading)[0] for F in states], axis=0)
        growth = np.maximum(growth, rest)
    return float(growth.max()), int((growth > MARGINAL).sum())
