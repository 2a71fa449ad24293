"""Single points of a K-B map, looked at closely: the couplings that were asked about, and how true the map is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from design.audit.figures import edge
from design.margin import Requirement
from sim.stability import MARGINAL
from sim.zwidth.loop import MapLoop
from sim.zwidth.map import Map
from sim.zwidth.population import Holders

COLUMNS = 4  # of the map, at which its edge is compared with a bisection on design.margin
STEPS = 48  # stiffnesses tried between the softest of the map and the stiffest, to find where safety ends
HALVINGS = 20  # an edge of the population is found to a relative 1e-6


@dataclass(frozen=True)
class Mark:
    """One coupling, and the stiffest at the same B; None where none is safe, inf where all that were tried are."""

    K: float
    B: float
    requirement: dict[str, Requirement]
    growth: float  # [1/s] worst over the population
    unstable: int  # humans
    stiffest: dict[str, float | None]  # by condition, and "population"


@dataclass(frozen=True)
class Truth:
    """How far the map is from design.margin, over the columns that were compared."""

    ratio: float  # largest relative error of the figure beside the edge
    edge: float  # largest relative error in K of the edge, interpolated between two rows
    columns: int


def look(ground: MapLoop, holders: Holders, K: float, B: float, grid_K: Array) -> Mark:
    """The coupling (K, B) on every channel."""
    gains = ground.gains(np.array([K]), np.array([B]))
    growth = _growth(ground, holders, K, B)
    tried = np.geomspace(min(grid_K[0], K), max(grid_K[-1], K), STEPS)
    row = ground.gains(tried, np.full(STEPS, gains.B[0]))
    stiffest: dict[str, float | None] = {}
    for name in ground.conditions:
        safe = ground.ratios(name, row) < 1
        stiffest[name] = _last(tried, safe, lambda low, high, name=name: _edge(ground, name, low, high, B))
    calm = np.array([(_growth(ground, holders, k, B) <= MARGINAL).all() for k in tried])
    stiffest["population"] = _last(tried, calm, lambda low, high: _bisected(ground, holders, low, high, B))
    requirement = {name: ground.requirement(name, K, B) for name in ground.conditions}
    return Mark(K, B, requirement, float(growth.max()), int((growth > MARGINAL).sum()), stiffest)


def truth(ground: MapLoop, drawn: Map, condition: str) -> Truth | None:
    """Columns of the map that cross the edge, evenly chosen; None where there is none."""
    grid, ratio = drawn.grid, drawn.ratio[condition].reshape(drawn.grid.shape)
    inside = ratio < 1
    crossing = inside[:-1] & ~inside[1:] & np.isfinite(ratio[1:])
    columns = np.flatnonzero(crossing.any(axis=0))
    if not columns.size:
        return None
    chosen = np.unique(columns[np.round(np.linspace(0, columns.size - 1, COLUMNS)).astype(int)])
    ratio_errors, edge_errors = [], []
    for column in chosen:
        B, k = float(grid.B[column]), int(np.flatnonzero(crossing[:, column])[-1])
        for row in (k, k + 1):
            true = ground.requirement(condition, float(grid.K[row]), B).ratio
            ratio_errors.append(abs(ratio[row, column] / true - 1))
        true_edge = _edge(ground, condition, float(grid.K[k]), float(grid.K[k + 1]), B)
        edge_errors.append(abs(_interpolated(grid.K, ratio[:, column], k, grid.scale) / true_edge - 1))
    return Truth(max(ratio_errors), max(edge_errors), chosen.size)


def _interpolated(K: Array, ratio: Array, k: int, scale: str) -> float:
    share = (1 - ratio[k]) / (ratio[k + 1] - ratio[k])
    if scale == "log":
        return float(K[k] * (K[k + 1] / K[k]) ** share)
    return float(K[k] + share * (K[k + 1] - K[k]))


def _edge(ground: MapLoop, condition: str, low: float, high: float, B: float) -> float:
    return edge(lambda K: ground.requirement(condition, K, B).ratio, low, high)


def _growth(ground: MapLoop, holders: Holders, K: float, B: float) -> Array:
    """Of every human, in the worst contact state."""
    states = ground.force_maps(ground.gains(np.array([K]), np.array([B])))
    return np.max([holders.growth(stack[0])[0] for stack in states], axis=0)


def _bisected(ground: MapLoop, holders: Holders, low: float, high: float, B: float) -> float:
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if (_growth(ground, holders, middle, B) <= MARGINAL).all():
            low = middle
        else:
            high = middle
    return low


def _last(tried: Array, safe: NDArray[np.bool_], between: Callable[[float, float], float]) -> float | None:
    """Where safety ends for the last time; inf where it does not, None where nothing is safe."""
    if not safe.any():
        return None
    last = int(np.flatnonzero(safe)[-1])
    return np.inf if last == tried.size - 1 else between(float(tried[last]), float(tried[last + 1]))
