"""A K-B map: both certificates and the population over the whole grid, MuJoCo at a sparse part of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.gains import Stack
from controller.lti import Array
from controller.process import Process
from design.assess import CONDITIONS
from models.device import Device
from sim.cells import in_slices
from sim.gain_grid import Grid
from sim.gain_ground import Ground
from sim.gain_points import Trial, simulate_trials
from sim.gain_population import Holders
from sim.oscillation import slowest_seen
from sim.stability import MARGINAL

UNLIMITED = 1e6  # [N] force limit of a motor that does not saturate: the largest that a device may have
SLICE, SAMPLE = 60, 25  # cells in one pass of a condition; cells that tell which humans are the leading ones
BATCH = 20  # simulations in one MuJoCo batch
DECIDED = 0.2  # [1/s] growth nearer to zero than this does not show within a trace

Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True)
class Effects:
    """What the simulated points have beside the linear loop. None leaves what the devices of the scenario have."""

    quantisation: float | None = None  # [m] encoder step
    friction: float | None = None  # [N] Coulomb friction at each motor
    saturation: bool = False  # whether motors have their force limits

    def on(self, devices: Sequence[Device]) -> tuple[Device, ...]:
        changes: dict[str, float] = {} if self.saturation else {"force_limit": UNLIMITED}
        if self.quantisation is not None:
            changes["encoder_step"] = self.quantisation
        if self.friction is not None:
            changes["friction"] = self.friction
        return tuple(msgspec.structs.replace(device, **changes) for device in devices)

    def any(self, devices: Sequence[Device]) -> bool:
        """Whether the simulated loop is not linear."""
        return self.saturation or any(device.encoder_step or device.friction for device in self.on(devices))


@dataclass(frozen=True)
class Plan:
    """How points are simulated."""

    effects: Effects
    points: int  # rows and columns of the grid that are simulated; 0 for none
    trials: int  # humans at each point
    press: float  # [N]
    duration: float  # [s]
    threshold: float  # [m] amplitude above which a handle oscillates


@dataclass(frozen=True, eq=False)
class Points:
    """The simulated points, (k,) each."""

    cell: NDArray[np.intp]  # flat index in the grid
    oscillates: NDArray[np.bool_]  # whether with any of the humans that were tried
    amplitude: Array  # [m] the largest among them that decided; inf: diverged
    frequency_hz: Array  # [Hz] of it; nan: diverged
    growth: Array  # [1/s] of the exact linear loop's dominant audible mode, with the worst of these humans


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


def draw_map(ground: Ground, grid: Grid, holders: Holders, plan: Plan, progress: Progress) -> Map:
    """All stages; Ctrl-C keeps what is done."""
    gains = ground.gains(*grid.flat)
    seconds, n = {}, len(gains)
    ratio = {name: np.full(n, np.nan) for name in CONDITIONS}
    growth, unstable = np.full((2, n), np.nan)
    points, stopped = _no_points(), False

    def ratios(part: slice) -> tuple[Array, ...]:
        return tuple(ground.ratios(name, gains.take(part)) for name in CONDITIONS)

    def population(part: slice) -> tuple[float, int]:
        return _population(holders, stack, leading, part.start)

    begin = time.perf_counter()
    _ = ground.multiplier  # once, before threads ask for it
    done, stopped = in_slices(ratios, n, SLICE, lambda k, of: progress("certificates", k, of))
    for part, values in done:
        for name, value in zip(CONDITIONS, values, strict=True):
            ratio[name][part] = value
    seconds["certificates"] = time.perf_counter() - begin
    if not stopped:
        begin = time.perf_counter()
        stack = ground.force_maps(gains)
        sample = np.unique(np.linspace(0, n - 1, min(SAMPLE, n)).astype(int))
        leading = holders.leading([stack[i] for i in sample])
        done, stopped = in_slices(population, n, 1, lambda k, of: progress("population", k, of))
        for part, values in done:
            growth[part], unstable[part] = values
        seconds["population"] = time.perf_counter() - begin
    if not stopped and plan.points:
        begin = time.perf_counter()
        cells = grid.subset(plan.points)
        points, stopped = _simulated(ground, stack, holders, plan, cells, lambda k, of: progress("MuJoCo", k, of))
        seconds["simulation"] = time.perf_counter() - begin
    return Map(grid, ratio, growth, unstable, points, seconds, stopped)


def _population(holders: Holders, stack: Stack, leading: NDArray[np.bool_], cell: int) -> tuple[float, int]:
    """Worst growth and number of unstable humans among the leading ones, or, if none of these, among all."""
    F = stack[cell]
    growth, _ = holders.growth(F, leading)
    if not (growth > MARGINAL).any() and not leading.all():
        growth = np.maximum(growth, holders.growth(F, ~leading)[0])
    return float(growth.max()), int((growth > MARGINAL).sum())


def _simulated(
    ground: Ground, stack: Stack, holders: Holders, plan: Plan, cells: NDArray[np.intp], progress: Callable[[int, int], None]
) -> tuple[Points, bool]:
    """Trials, grouped by the humans' number of links, in batches that hold whole points."""
    devices = plan.effects.on(ground.devices)
    step, limit = (np.array([getattr(d, name) for d in devices]) for name in ("encoder_step", "force_limit"))
    parts: list[Points] = []
    size, audible = max(1, BATCH // plan.trials), slowest_seen(plan.duration)
    ticks = round(plan.duration / ground.T)
    try:
        for first in range(0, cells.size, size):
            some, trials, growth = cells[first : first + size], [], []
            for cell in some.tolist():
                audibly = holders.growth(stack[cell], audible=audible)[1]
                worst = np.argsort(-audibly, kind="stable")[: plan.trials]
                process = Process(stack[cell], limit, step)
                trials += [Trial(process, holders.links(human)) for human in worst.tolist()]
                growth.append(audibly[worst[0]])
            seen = 0

            def ticked(count: int, first: int = first) -> None:
                nonlocal seen
                seen += count
                progress(first * ticks + seen * min(size, cells.size - first), cells.size * ticks)

            parts.append(_points(some, np.array(growth), trials, devices, plan, ticked))
    except KeyboardInterrupt:
        return _joined(parts), True
    return _joined(parts), False


def _points(
    cells: NDArray[np.intp], growth: Array, trials: list[Trial], devices: Sequence[Device], plan: Plan, ticked: Callable[[int], None]
) -> Points:
    """Simulate the trials of these cells, plan.trials of each in succession."""
    lasting, amplitude, frequency = np.zeros(len(trials), dtype=bool), np.zeros(len(trials)), np.zeros(len(trials))
    links = np.array([trial.links.shape[1] for trial in trials])
    for count in np.unique(links):
        which = np.flatnonzero(links == count)
        found = simulate_trials([trials[i] for i in which], devices, plan.press, plan.duration, plan.threshold, ticked)
        lasting[which], amplitude[which], frequency[which] = found.sustained, found.amplitude, found.frequency_hz
    shape = (cells.size, -1)
    shown = np.where(lasting, amplitude + 1e9, amplitude).reshape(shape).argmax(axis=1)[:, None]
    pick = lambda values: np.take_along_axis(values.reshape(shape), shown, axis=1)[:, 0]  # noqa: E731
    return Points(cells, lasting.reshape(shape).any(axis=1), pick(amplitude), pick(frequency), growth)


def _joined(parts: Sequence[Points]) -> Points:
    if not parts:
        return _no_points()
    names = Points.__dataclass_fields__
    return Points(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def _no_points() -> Points:
    return Points(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), *np.zeros((3, 0)))
