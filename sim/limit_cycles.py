"""Search for limit cycles of devices in human hands: eigenvalues for every human, MuJoCo for the worst human.

A cell of a Z-width map has linear maps F from positions to forces, one for each set of touched walls, and a process of
the controller. A human is here a set of hands, one for each device. `HeldDevices` closes the loop of F and the devices
in the hands of every human. `simulate_cells` runs cells in MuJoCo, with encoder steps, friction and walls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.delay import Timing
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.models.device import Device
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.human import Population
from haptic_loop.models.scene import Crowd, Scene, crowds, quiet_warnings, variants
from haptic_loop.sim.engines import MujocoBatchEngine, pace, profiler_off
from haptic_loop.sim.run import Progress, run_block
from haptic_loop.sim.stability import close
from haptic_loop.sim.trace import RUNAWAY, Oscillation, oscillation, slowest_seen

Cells = NDArray[np.intp]

_MIN_FREQUENCY_HZ = 2.0  # least frequency of a fast mode; slower modes barely decay, and would hide a faster one
_LEADING = 0.1  # share of the humans that `leading` selects


@dataclass(frozen=True, eq=False)
class HeldDevices:
    """The sampled devices in the hands of every human. A group has the humans with the same number of links."""

    devices: tuple[Device, ...]  # (m,)
    T: float  # [s]
    #: (indices of the humans, humans, their plants, indices of motors and handles in a plant state)
    groups: tuple[tuple[Cells, Crowd, HeldPlant, tuple[int, ...]], ...]
    late: tuple[float, ...] | None = None  # (m,) [s] time from a tick to the latch of its force; None: at ticks

    @classmethod
    def drawn(
        cls,
        devices: tuple[Device, ...],
        population: Population,
        T: float,
        seed: int,
        humans: int,
        links: int | None = None,
        latency: Sequence[tuple[float, float]] | None = None,
    ) -> HeldDevices:
        """Return the devices in the hands of random humans.

        `links` is the number of links of each hand; None means that of the population. `latency` has the least and the
        largest latency [s] of each channel's forces; forces latch after the largest.
        """
        late = None if latency is None else tuple(most for _, most in latency)
        groups = []
        for index, crowd in crowds(
            population, len(devices), seed, range(humans), population.links if links is None else links
        ):
            held_by = variants(devices, crowd)
            groups.append((index, crowd, hold(held_by.plants(), T, late), _motors_and_handles(held_by.scene)))
        return cls(devices, T, tuple(groups), late)

    def __len__(self) -> int:
        return sum(index.size for index, *_ in self.groups)

    def links(self, human: int) -> Array:
        """Return the links (m, links, 3) of a human, as in `Crowd`."""
        (_, crowd, *_), i = self._place(human)
        return crowd.links[i]

    def growth(
        self, F: Lti, humans: NDArray[np.bool_] | None = None, min_frequency_hz: float = _MIN_FREQUENCY_HZ
    ) -> tuple[Array, Array]:
        """Return the growth rates (n,) [1/s] of the dominant mode and of the dominant fast mode, with every human.

        A fast mode has at least `min_frequency_hz`. Where the mask `humans` (n,) is False, the growth is -inf.
        """
        n = len(self)
        everything, turning = np.full((2, n), -np.inf)
        for index, _, plants, _ in self.groups:
            chosen = np.ones(index.size, dtype=bool) if humans is None else humans[index]
            if not chosen.any():
                continue
            some = HeldPlant(plants.A[chosen], plants.B[chosen], plants.C, plants.T)
            at = index[chosen]
            everything[at], turning[at] = close(some, F).growths(0.0, min_frequency_hz)
        return everything, turning

    def mode(self, F: Lti, human: int, min_frequency_hz: float) -> Array:
        """Return the dominant mode at or above a frequency, as a state [s; z] of plant and process.

        The mode is scaled so that the motor or handle with the largest motion moves by 1 m.
        """
        (_, _, plants, seen), i = self._place(human)
        values, vectors = np.linalg.eig(close(HeldPlant(plants.A[i], plants.B[i], plants.C, plants.T), F).A)
        fast = np.abs(np.angle(values)) >= 2 * np.pi * min_frequency_hz * plants.T
        vector = vectors[:, np.argmax(np.where(fast, np.abs(values), 0.0))]
        positions = vector[list(seen)]
        return (vector / positions[np.argmax(np.abs(positions))]).real

    def leading(self, some: Sequence[Lti]) -> NDArray[np.bool_]:
        """Return a mask (n,) of a tenth of the humans, at least 8 if there are so many.

        The mask selects first the humans who are unstable with most of the force maps `some`, then those whose loops
        grow fastest.
        """
        growths = np.array([self.growth(F)[1] for F in some])
        score = (growths > 0).sum(axis=0) + np.clip(growths, -100, 100).mean(axis=0) / 1000
        first = np.zeros(len(self), dtype=bool)
        first[np.argsort(-score, kind="stable")[: max(8, round(_LEADING * len(self)))]] = True
        return first

    def _place(self, human: int) -> tuple[tuple[Cells, Crowd, HeldPlant, tuple[int, ...]], int]:
        """Return the group of a human, and the human's position in it."""
        for group in self.groups:
            at = np.flatnonzero(group[0] == human)
            if at.size:
                return group, int(at[0])
        raise IndexError(f"human {human} of {len(self)}")


def _motors_and_handles(scene: Scene) -> tuple[int, ...]:
    """Return the indices of motors and handles in a plant state; in a rigid device both have one index."""
    return tuple(dict.fromkeys((*range(scene.channels), *scene.handles)))


# ----------------------------------------------------------------------------------------------------
# Cells in MuJoCo. The human with whom the exact linear loop grows fastest holds the devices. Only modes that a trace
# can show count: they oscillate fast enough, or run away. The plant starts in this mode, scaled so that the motor or
# handle that moves most is displaced by `Plan.start`; so does a process without walls and limiter. Each hand presses
# with a force that starts smoothly and then stays constant. The second half of the trace gives the verdict.


_UNLIMITED = 1e6  # [N] the largest allowed force limit of a device, which no force here reaches
_BATCH = 20  # simulations in one MuJoCo batch
_EASE = 0.5  # [s] time in which the hand's force grows to its constant value
_BLOCK = 64  # ticks between two calls of `progress`
_DECIDED = 0.2  # [1/s] A trace is too short to show the sign of a smaller growth rate.
UNDECIDED = "too slow to say"  # verdict if the trace oscillates and the linear loop's rate is at most _DECIDED


def unlimited(devices: Sequence[Device]) -> tuple[Device, ...]:
    """Return the devices with motors that never clip."""
    return tuple(msgspec.structs.replace(device, force_limit=_UNLIMITED) for device in devices)


@dataclass(frozen=True)
class Plan:
    """Settings for the simulation of cells."""

    points: int  # largest number of rows, and of columns, of the map with simulated cells; 0: no cell is simulated
    press: float  # [N] steady force of every hand
    duration: float  # [s]
    threshold: float  # [m] amplitude above which a motor or handle oscillates
    start: float = 1e-3  # [m] initial displacement of the motor or handle that moves most

    @property
    def runaway_growth(self) -> float:
        """The growth [1/s] above which a mode has diverged by the end of the trace."""
        return 1.2 * np.log(RUNAWAY / self.start) / self.duration


@dataclass(frozen=True, eq=False)
class Points:
    """The simulated cells, (k,) each."""

    cell: Cells  # flat index in the grid
    oscillates: NDArray[np.bool_]  # whether the trace oscillates to its end, or diverged
    amplitude: Array  # [m] amplitude of the oscillation; inf if the trace diverged
    frequency_hz: Array  # [Hz] frequency of the oscillation; nan if the trace diverged
    growth: Array  # [1/s] exact growth of the dominant mode that a trace can show, with all walls touched

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        if not parts:
            return cls(np.zeros(0, dtype=int), np.zeros(0, dtype=bool), *np.zeros((3, 0)))
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    @property
    def near(self) -> NDArray[np.bool_]:
        """(k,) whether the linear loop grows or decays so slowly that its motion looks like a limit cycle."""
        return np.abs(self.growth) <= _DECIDED

    @property
    def differ(self) -> NDArray[np.bool_]:
        """(k,) whether MuJoCo contradicts a linear loop that clearly grows or decays."""
        return ~self.near & ((self.growth > 0) != self.oscillates)

    @property
    def verdicts(self) -> list[str]:
        """Each cell's verdict: "rests", "oscillates" or UNDECIDED."""
        words = np.where(self.oscillates, np.where(self.near, UNDECIDED, "oscillates"), "rests")
        return [str(word) for word in words]


#: flat indices of cells -> stack of their linear force maps, and the controller's process of each cell
_Loops = Callable[[Cells], tuple[Lti, Sequence[Process]]]


def simulate_cells(
    cells: Cells, loops: _Loops, held: HeldDevices, plan: Plan, press: Array, progress: Progress
) -> tuple[Points, bool]:
    """Simulate cells, and return the points and whether the keyboard interrupted; hands press with `press` (m,) [N]."""
    parts: list[Points] = []
    ticks = round(plan.duration / held.T)
    try:
        for first in range(0, cells.size, _BATCH):
            some, seen = cells[first : first + _BATCH], 0
            trials, growth = _trials(*loops(some), held, plan)

            def ticked(count: int, first: int = first) -> None:
                nonlocal seen
                seen += count
                progress(first * ticks + min(seen, ticks) * min(_BATCH, cells.size - first), cells.size * ticks)

            parts.append(_points(some, growth, trials, held, plan, press, ticked))
    except KeyboardInterrupt:
        return Points.joined(parts), True
    return Points.joined(parts), False


@dataclass(frozen=True, eq=False)
class _Trial:
    """One simulation."""

    process: Process
    links: Array  # (m, links, 3) links of each hand, as in Crowd
    start: Array  # (states + order,) plant state, then the state of the linear process


def _trials(F: Lti, processes: Sequence[Process], held: HeldDevices, plan: Plan) -> tuple[list[_Trial], Array]:
    """Return for each cell a trial, and the growth [1/s] of the exact loop with the trial's human."""
    slowest, trials, growth = slowest_seen(plan.duration), [], []
    for i, process in enumerate(processes):
        fastest, swinging = held.growth(F[i], min_frequency_hz=slowest)
        runs_away = fastest > plan.runaway_growth  # A mode that runs away need not oscillate.
        shown = np.where(runs_away, fastest, swinging)
        human = int(np.argmax(shown))
        mode = held.mode(F[i], human, 0.0 if runs_away[human] else slowest)
        trials.append(_Trial(process, held.links(human), plan.start * mode))
        growth.append(shown[human])
    return trials, np.array(growth)


def _points(
    cells: Cells,
    growth: Array,
    trials: list[_Trial],
    held: HeldDevices,
    plan: Plan,
    press: Array,
    ticked: Callable[[int], None],
) -> Points:
    lasting, amplitude, frequency = np.zeros(len(trials), dtype=bool), np.zeros(len(trials)), np.zeros(len(trials))
    links = np.array([trial.links.shape[1] for trial in trials])
    for count in np.unique(links):
        which = np.flatnonzero(links == count)
        oscillations = _simulate([trials[i] for i in which], held, press, plan, ticked)
        lasting[which], amplitude[which], frequency[which] = (
            oscillations.sustained,
            oscillations.amplitude,
            oscillations.frequency_hz,
        )
    return Points(cells, lasting, amplitude, frequency, growth)


def _simulate(
    trials: Sequence[_Trial], held: HeldDevices, press: Array, plan: Plan, ticked: Callable[[int], None]
) -> Oscillation:
    """Simulate all trials together, and return their oscillations; humans must have the same number of links."""
    T = trials[0].process.F.T
    held_by = variants(unlimited(held.devices), Crowd(np.stack([trial.links for trial in trials])))
    scene, ticks = held_by.scene, round(plan.duration / T)
    substeps = pace(held_by.plants().A).substeps(T)
    timing = Timing(np.array([T]), np.array([held.late])) if held.late else None
    n, processes = held_by.states + len(held.late or ()), [trial.process for trial in trials]
    law, starts = processes[0].law, np.stack([trial.start for trial in trials], axis=1)
    together = law.together([process.law for process in processes])
    buffer = StepBuffer(processes[0], min(_BLOCK, ticks), n, scene.outside, len(trials), together)
    buffer.s[0] = starts[:n]
    if not (law.walls or law.bounds):  # A process with walls or a limiter has other states and begins at rest.
        buffer.z[0] = starts[n:]
    seen, displacements, first = list(_motors_and_handles(scene)), [], 0
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine = MujocoBatchEngine(held_by, T, substeps=substeps, timing=timing)
        engine.start(buffer)
        while first < ticks:
            count = min(buffer.ticks, ticks - first)
            buffer.w[:count] = _press_forces(scene, T, press, first, count)[:, :, None]
            run_block(buffer, engine, count)
            displacements.append(buffer.s[:count, seen].copy())
            buffer.rewind(count)
            first += count
            ticked(count)
    return oscillation(np.concatenate(displacements)[ticks // 2 :], T, plan.threshold)


def _press_forces(scene: Scene, T: float, press: Array, first: int, ticks: int) -> Array:
    """Return the external forces (ticks, outside) [N]: `press` on the ends of the humans, with a smooth start."""
    t = (first + np.arange(ticks)) * T
    eased = np.where(t < _EASE, (1 - np.cos(np.pi * t / _EASE)) / 2, 1.0)
    w = np.zeros((ticks, scene.outside))
    for force, column in zip(press, scene.pushed, strict=True):
        w[:, column] += force * eased
    return w
