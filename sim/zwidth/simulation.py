"""Points of a K-B map in MuJoCo, each with the humans whose linear loop is the worst: do they go on oscillating?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.gains import Gains
from controller.lti import Array
from models.device import Device
from sim.oscillation import RUNAWAY, slowest_seen
from sim.zwidth.grid import Grid
from sim.zwidth.ground import press_directions
from sim.zwidth.loop import MapLoop
from sim.zwidth.points import Trial, simulate_trials
from sim.zwidth.population import Holders

UNLIMITED = 1e6  # [N] force limit of a motor that does not saturate: the largest that a device may have
BATCH = 20  # simulations in one MuJoCo batch
DECIDED = 0.2  # [1/s] linear growth nearer to zero than this does not show within a trace
UNDECIDED = "too slow to say"  # verdict where the trace goes on oscillating as the linear loop would, decaying or not


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

    def nonlinear(self, devices: Sequence[Device]) -> bool:
        """Whether the devices make the simulated loop another one than the linear one."""
        return self.saturation or any(device.encoder_step or device.friction for device in self.on(devices))


@dataclass(frozen=True)
class Plan:
    """How points are simulated."""

    effects: Effects
    points: int  # rows and columns of the grid that are simulated; 0 for none
    trials: int  # humans at each point
    start: float  # [m] displacement of the motor or handle that moves most, at the start
    press: float  # [N]
    duration: float  # [s]
    threshold: float  # [m] amplitude above which a handle oscillates

    @property
    def runaway_growth(self) -> float:
        """[1/s] A mode that grows faster has diverged by the end of the trace, whether it swings or not."""
        return 1.2 * np.log(RUNAWAY / self.start) / self.duration


@dataclass(frozen=True, eq=False)
class Points:
    """The simulated points, (k,) each."""

    cell: NDArray[np.intp]  # flat index in the grid
    oscillates: NDArray[np.bool_]  # to the end of the trace, with any of the humans that were tried
    amplitude: Array  # [m] the largest among them that decided; inf: diverged
    frequency_hz: Array  # [Hz] of it; nan: diverged
    growth: Array  # [1/s] of the exact loop's dominant mode, audible or running away, with the worst of these humans

    @property
    def near(self) -> NDArray[np.bool_]:
        """Whether the linear loop neither grows nor decays enough to be told from a limit cycle."""
        return np.abs(self.growth) <= DECIDED

    @property
    def differ(self) -> NDArray[np.bool_]:
        """Whether MuJoCo does what the linear loop clearly does not."""
        return ~self.near & ((self.growth > 0) != self.oscillates)

    @property
    def verdicts(self) -> list[str]:
        """Each one "rests", "oscillates" or UNDECIDED."""
        words = np.where(self.oscillates, np.where(self.near, UNDECIDED, "oscillates"), "rests")
        return [str(word) for word in words]


def simulated(
    ground: MapLoop,
    grid: Grid,
    holders: Holders,
    plan: Plan,
    cells: NDArray[np.intp],
    progress: Callable[[int, int], None],
) -> tuple[Points, bool]:
    """The points of these cells, simulated in batches of whole points, and whether the keyboard ended it."""
    parts: list[Points] = []
    size, ticks = max(1, BATCH // plan.trials), round(plan.duration / ground.T)
    try:
        for first in range(0, cells.size, size):
            some = cells[first : first + size]
            trials, growth = _trials(ground, ground.gains(*(axis[some] for axis in grid.flat)), holders, plan)
            seen = 0

            def ticked(count: int, first: int = first) -> None:
                nonlocal seen
                seen += count
                progress(first * ticks + min(seen, ticks) * min(size, cells.size - first), cells.size * ticks)

            parts.append(_points(some, growth, trials, ground, plan, ticked))
    except KeyboardInterrupt:
        return _joined(parts), True
    return _joined(parts), False


def _trials(ground: MapLoop, gains: Gains, holders: Holders, plan: Plan) -> tuple[list[Trial], Array]:
    """The trials of these gains, plan.trials of each in succession, and the growth of the worst of each."""
    audible, stack = slowest_seen(plan.duration), ground.force_maps(gains)[0]
    devices = plan.effects.on(ground.devices)
    trials, growth = [], []
    for i in range(len(gains)):
        whole, audibly = holders.growth(stack[i], audible=audible)
        runs_away = whole > plan.runaway_growth  # without a sound: what pushes outwards at rest
        shown = np.where(runs_away, whole, audibly)
        worst = np.argsort(-shown, kind="stable")[: plan.trials]
        process = ground.process(gains, i, devices)
        for human in worst.tolist():
            mode = holders.mode(stack[i], human, 0.0 if runs_away[human] else audible)
            trials.append(Trial(process, holders.links(human), plan.start * mode))
        growth.append(shown[worst[0]])
    return trials, np.array(growth)


def _points(
    cells: NDArray[np.intp],
    growth: Array,
    trials: list[Trial],
    ground: MapLoop,
    plan: Plan,
    ticked: Callable[[int], None],
) -> Points:
    """Simulate the trials of these cells, plan.trials of each in succession."""
    devices = plan.effects.on(ground.devices)
    press = plan.press * press_directions(ground.walled, ground.channels)
    lasting, amplitude, frequency = np.zeros(len(trials), dtype=bool), np.zeros(len(trials)), np.zeros(len(trials))
    links = np.array([trial.links.shape[1] for trial in trials])
    for count in np.unique(links):
        which = np.flatnonzero(links == count)
        found = simulate_trials([trials[i] for i in which], devices, press, plan.duration, plan.threshold, ticked)
        lasting[which], amplitude[which], frequency[which] = found.sustained, found.amplitude, found.frequency_hz
    shape = (cells.size, -1)
    shown = np.where(lasting, amplitude + 1e9, amplitude).reshape(shape).argmax(axis=1)[:, None]
    pick = lambda values: np.take_along_axis(values.reshape(shape), shown, axis=1)[:, 0]  # noqa: E731
    return Points(cells, np.any(lasting.reshape(shape), axis=1), pick(amplitude), pick(frequency), growth)


def _joined(parts: Sequence[Points]) -> Points:
    if not parts:
        return no_points()
    names = Points.__dataclass_fields__
    return Points(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def no_points() -> Points:
    """Where none is simulated."""
    return Points(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), *np.zeros((3, 0)))
