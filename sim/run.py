"""Run the loop of a scenario's controller and plant, tick by tick.

    trace = run(assemble(scenario, coupling), "mujoco")

A tick samples the positions, computes, limits and holds the forces, and advances the plant by one period. The module
controller.tick explains the order of these steps. Engines (sim.engines) advance the plant.
"""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("run")

import shutil
import tempfile
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import Timing
from haptic_loop.controller.law import Law
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Net, Process, StepBuffer
from haptic_loop.design.own import called
from haptic_loop.models.device import Mechanics
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.human import Hand, Person
from haptic_loop.models.scene import Scene, build, quiet_warnings
from haptic_loop.sim.engines import (
    Engine,
    ExactEngine,
    ExactTimedEngine,
    MujocoEngine,
    RunsBlocks,
    default_integrator,
    least_substeps,
    profiler_off,
)
from haptic_loop.sim.scenario import InputError, Scenario
from haptic_loop.sim.trace import Trace

ENGINES = ("mujoco", "exact")
AnyEngine = str | Engine | Callable[["Simulation"], Engine]  # a name, an engine, or a class or function that makes one

_Outside = Callable[[int, int], Array]  # (first tick, ticks) -> external forces (ticks, external inputs) [N]
_AfterBlock = Callable[[StepBuffer, int, int], object]  # (buffer, its first tick, number of its ticks) -> True to stop
Progress = Callable[[int, int], None]  # (ticks done, number of ticks)

_COPIES = 4  # largest number of copies of a trace that a run and its report keep in memory
_SMALL = 1e8  # [bytes] size of a trace below which the free memory is not checked
_COLUMNS = 50  # numbers per tick that a report keeps in memory if the trace is on disk
_BLOCK = 2048  # ticks between two calls of `progress`; the run also checks its numbers and the engine there
_AHEAD = 8  # number of blocks for which external forces are sampled together


@dataclass(frozen=True)
class EngineSettings:
    """Engine, integrator and steps of a run. If `integrator` or `substeps` is None, the plant's default is used."""

    engine: AnyEngine = "mujoco"
    integrator: str | None = None  # name in sim.engines.INTEGRATORS
    substeps: int | None = None  # integrator steps per period
    error: float | None = None  # allowed relative rms error of positions; if given, it chooses integrator and substeps


@dataclass(frozen=True, eq=False)
class Simulation:
    """The controller (`process`) and the plant of a scenario with its coupling, ready to run."""

    scenario: Scenario
    coupling: Coupling
    process: Process
    scene: Scene
    plant: HeldPlant  # the plant over a period T; forces latch in the middle of their range of latencies
    timing: Timing | None = None  # times of ticks and latches; None without `period` and `latency` in the scenario

    @cached_property
    def loop(self) -> Loop:
        """The loop of case I for linear analyses, which do not use its reference delays."""
        return self.scenario.loop("I")

    @cached_property
    def E(self) -> Lti:
        """The environment as a linear system in which every wall is touched."""
        return self.loop.E()

    @property
    def F(self) -> Lti:
        """The linear map from positions to forces at constant delays while no wall is touched; 0 in a world."""
        return self.process.law.open

    @property
    def friction(self) -> bool:
        """Whether a device has Coulomb friction. `scene` includes this friction, but the linear `plant` does not."""
        return any(np.any(device.friction) for device in self.scenario.device)

    @property
    def smooth(self) -> Simulation:
        """The simulation without Coulomb friction in the scene, for linear verdicts."""
        if not self.friction:
            return self
        devices = tuple(msgspec.structs.replace(device, friction=0.0) for device in self.scenario.device)
        scenario = self.scenario.replace(device=devices)
        return replace(self, scenario=scenario, scene=build(devices, scenario.human, scenario.person))

    def held_by(
        self, humans: tuple[Hand, ...], persons: tuple[Person, ...], mechanics: Sequence[Mechanics] = ()
    ) -> Simulation:
        """Return the simulation with other hands; `mechanics`, if not empty, replaces the devices' mechanics."""
        devices = self.scenario.device
        if mechanics:
            devices = tuple(map(Mechanics.of, mechanics, devices))
        scene = build(devices, humans, persons)
        scenario = msgspec.structs.replace(self.scenario, device=devices, human=humans, person=persons)
        return replace(
            self, scenario=scenario, scene=scene, plant=hold(scene.plant, scenario.T, scenario.usual_latency)
        )

    @property
    def even(self) -> Simulation:
        """The simulation with constant periods T and forces that latch at ticks, for comparing integrators."""
        if self.timing is None:
            return self
        return replace(self, plant=hold(self.scene.plant, self.scenario.T), timing=None)

    @property
    def felt(self) -> Lti:
        """The map from positions to forces at constant delays while every wall is touched."""
        return list(self.process.law.frozen().values())[-1]


def assemble(scenario: Scenario, coupling: Coupling, lag: Sequence[float] | None = None, seed: int = 0) -> Simulation:
    """Return the scenario's controller and plant, ready to run.

    `lag` is `rho` (m,) [N/m] of controller.law.Limiter; if it is None, forces are clipped. `seed` is for varying
    periods and latencies. Raises SingularLoop if the algebraic loop of environment and coupling has no solution, and
    InputError if the loop has walls and the coupling holds a linear model.
    """
    if scenario.environment.walls and coupling.holds_model:
        raise InputError(f"environment.walls: {type(coupling).__name__} holds a linear model, so it cannot face walls")
    axes = scenario.axis_devices
    limits, steps = (np.array([getattr(axis, of) for axis in axes]) for of in ("force_limit", "encoder_step"))
    if scenario.environment.world:  # This law returns zero forces, because sim.world computes those of a scene.
        law = Law(Lti.constant(np.zeros((scenario.channels,) * 2), scenario.T), scenario.theta)
    else:
        most, balls = scenario.limiter_limits
        law = scenario.loop("I").law(coupling, most, lag, balls)
    process = Process(law, limits, steps, balls=scenario.balls)
    scene = build(scenario.device, scenario.human, scenario.person)
    plant = hold(scene.plant, scenario.T, scenario.usual_latency)
    return Simulation(scenario, coupling, process, scene, plant, scenario.timing(seed, scenario.samples))


def run(
    simulation: Simulation,
    engine: AnyEngine = "mujoco",
    outside: _Outside | None = None,
    ticks: int | None = None,
    start: Array | None = None,
    progress: Progress = lambda done, ticks: None,
    may_end_early: bool = False,
) -> Trace:
    """Run the loop and return the trace.

    Args:
        simulation: The loop.
        engine: An engine, a class or function that makes one, or a name, which selects the engine's default step.
        outside: External forces on hands and handles; default: `outside_forces`.
        ticks: Number of ticks; default: the scenario's.
        start: Initial plant state (states, 1); default: rest.
        progress: Called with (ticks done, number of ticks).
        may_end_early: Whether Ctrl-C only ends the trace early. The trace then has `interrupted` = True.

    Returns:
        The trace. It ends early when a number stops being finite or the engine reports trouble.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed, and `may_end_early` is False or fewer than 2048 ticks are done.
        ValueError: `engine` is no engine for this loop (`make_engine`), or the trace is too large (InputError).
    """
    process, scenario = simulation.process, simulation.scenario
    engine = make_engine(simulation, engine)
    outside = outside or partial(outside_forces, scenario, simulation.scene, timing=simulation.timing)
    ticks = scenario.samples if ticks is None else ticks
    start = np.zeros((simulation.plant.A.shape[0], 1)) if start is None else start
    widths = (process.F.order, len(start), simulation.scene.outside, process.channels)
    record, done = _room(sum(widths), ticks, scenario.T), 0
    net: Net | None = None
    diverged = interrupted = False

    def keep(buffer: StepBuffer, first: int, count: int) -> bool:
        nonlocal diverged, net, done
        finite = _finite_ticks(buffer, count)
        record[first : first + finite] = buffer.rows[:finite, :, 0]
        net, diverged, done = buffer.net, engine.troubled() or finite < count, first + finite
        progress(done, ticks)
        return diverged

    try:
        run_blocks(process, engine, outside, ticks, start, keep, _BLOCK)
    except KeyboardInterrupt:
        if not (may_end_early and done):
            raise
        interrupted = True
    record.setflags(write=False)
    n, m, handles = simulation.scene.model.nq, process.channels, simulation.scene.handles
    z, s, w, f = np.split(record[:done], np.cumsum(widths)[:3], axis=1)
    return Trace(
        t=beginnings(scenario.T, simulation.timing, 0, done),
        x=process.measured(s[:, :m]),
        f=f,
        x_handle=_columns(s, handles),
        v_handle=_columns(s[:, n:], handles),
        w=w,
        z=z,
        s=s,
        diverged=diverged,
        interrupted=interrupted,
        net=net,
        names=scenario.channel_names,
    )


def _finite_ticks(buffer: StepBuffer, count: int) -> int:
    """Return how many of the first `count` ticks precede the first state or force that is not finite."""
    if np.isfinite(buffer.rows[:count].sum()):
        return count
    finite = np.isfinite(buffer.s[:count]).all(axis=(1, 2)) & np.isfinite(buffer.f[:count]).all(axis=(1, 2))
    return count if finite.all() else int(np.argmin(finite))


def _columns(rows: Array, which: tuple[int, ...]) -> Array:
    together = slice(which[0], which[-1] + 1)
    return rows[:, together] if which == tuple(range(which[0], which[-1] + 1)) else rows[:, list(which)]


def _room(width: int, ticks: int, T: float) -> Array:
    """Return an array (ticks, width) in memory, or in a temporary file if the memory is too small.

    Raises InputError if the trace's report does not fit into memory, or if the disk cannot hold the trace twice.
    """
    shape, each = (ticks, width), 8 * width
    free = _free_memory() if each * ticks > _SMALL else np.inf
    if _COPIES * each * ticks <= free:
        return np.empty(shape)
    disk = shutil.disk_usage(tempfile.gettempdir()).free
    for needed, there, what in ((8 * _COLUMNS, free, "memory"), (2 * each, disk, tempfile.gettempdir())):
        if needed * ticks > there:
            needs = f"{ticks * T:g} s need {ticks * needed / 2**30:.3g} GiB of {what}, {there / 2**30:.3g} are free"
            raise InputError(f"duration: {needs}: allowed are {there / needed * T:.3g} s; sim.validate stores no trace")
    with tempfile.TemporaryFile() as file:
        return np.memmap(file, np.float64, "w+", shape=shape).view(np.ndarray)


def _free_memory() -> float:
    """Return the free memory [bytes]; infinite if the system does not say."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return np.inf


def run_blocks(
    process: Process,
    engine: Engine,
    outside: _Outside,
    ticks: int,
    start: Array,
    each_block: _AfterBlock,
    block: int = 32,
) -> None:
    """Close the loop for `ticks` periods from the plant states `start`, (states, nsim), block by block.

    `each_block` is called after each block, and returns True to stop. In this call row 0 of the buffer is the block's
    first tick. A block of 32 ticks fits into the processor's cache. Raises InputError for an engine without `advance`.
    """
    ahead = outside(0, min(_AHEAD * block, ticks))
    buffer = StepBuffer(process, min(block, ticks), start.shape[0], ahead.shape[1], start.shape[1])
    buffer.s[0] = start
    # Warnings of overflow are suppressed, because the trace reports that a run diverges.
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine.start(buffer)
        if not callable(getattr(engine, "advance", None)):
            raise InputError(f"engine {engine_name(engine)} has no advance(k), which moves the plant by one period")
        for first in range(0, ticks, block):
            count = min(block, ticks - first)
            if not len(ahead):
                ahead = outside(first, min(_AHEAD * block, ticks - first))
            buffer.w[:count], ahead = ahead[:count, :, None], ahead[block:]
            run_block(buffer, engine, count)
            if each_block(buffer, first, count):
                return
            buffer.rewind(count)


def run_block(buffer: StepBuffer, engine: Engine, ticks: int) -> None:
    """Close the loop for the first `ticks` rows of the buffer."""
    first = 0
    if buffer.calm and isinstance(engine, RunsBlocks) and engine.run_block:
        engine.run_block(ticks)  # This ignores force limits.
        first = buffer.linear_until(ticks)  # the first tick whose forces exceed a limit
        if first == ticks:
            return
        engine.back(first)
        buffer.calm = False
    tick, advance = buffer.tick, engine.advance
    for k in range(first, ticks):
        tick(k)  # sample x, compute f and the next z, limit f
        advance(k)  # hold -f on the actuators for T, move the plant


def beginnings(T: float, timing: Timing | None, first: int, ticks: int) -> Array:
    """Return the times [s] at which ticks first .. first + ticks - 1 begin, (ticks,)."""
    return timing.times(first, ticks) if timing else np.arange(first, first + ticks) * T


def outside_forces(
    scenario: Scenario, scene: Scene, first: int, ticks: int, voluntary: bool = True, timing: Timing | None = None
) -> Array:
    """Return the external forces [N] at the beginnings of ticks first .. first + ticks - 1, (ticks, external inputs).

    Voluntary forces act on the ends of the humans, and the tap on one handle. `voluntary` = False leaves out voluntary
    forces. Raises InputError for a voluntary force that has a wrong shape or is not finite.
    """
    t = beginnings(scenario.T, timing, first, ticks)
    w = np.zeros((ticks, scene.outside))
    if voluntary:
        for i, (human, device) in enumerate(zip(scenario.human, scenario.device, strict=True), start=1):
            force = np.asarray(human.voluntary_force(t))
            columns = [column for column, of in zip(scene.pushed, scene.devices, strict=True) if of == i - 1]
            rows = force[:, None] if force.ndim == 1 else force
            if rows.shape == (t.size, device.axes):
                rows = rows[:, list(device.free)]
            if len(rows) != t.size or rows.ndim != 2 or rows.shape[1] not in (1, len(columns)):
                raise InputError(
                    f"human #{i}.voluntary_force(t) has the shape {force.shape} for {t.size} times, expected one force "
                    "per time, or one per time and axis"
                )
            if not (finite := np.isfinite(rows).all(axis=1)).all():
                k = int(np.argmin(finite))
                raise InputError(
                    f"human #{i}.voluntary_force(t) is {force[k]} at {t[k]:g} s, expected a finite force in N"
                )
            w[:, columns[: rows.shape[1]]] += rows
    if tap := scenario.tap:
        places = np.round(t / scenario.T, 9) if timing else range(first, first + ticks)
        ends = [bisect_left(places, round(time / scenario.T, 9)) for time in (tap.start, tap.start + tap.duration)]
        w[slice(*ends), scene.tapped[tap.channel - 1]] += tap.force
    return w


def make_engine(
    simulation: Simulation,
    engine: AnyEngine,
    integrator: str | None = None,
    substeps: int | None = None,
    T: float | None = None,
) -> Engine:
    """Return an engine for one simulation: a named one, a user's engine, or the result of a class or function.

    `integrator` and `substeps` are MuJoCo's (default: `default_integrator`, `least_substeps`). A tick of MuJoCo lasts T
    [s] (default: as in the scenario). Raises ValueError for an unknown name, an object that is no engine, the exact
    engine with Coulomb friction, or a user's own engine with `period` or `latency`.
    """
    if not isinstance(engine, str):
        return _own_engine(simulation, engine)
    if engine not in ENGINES:
        raise ValueError(f"engine is {engine!r}, allowed are {', '.join(ENGINES)}")
    if engine == "exact":
        if simulation.friction:
            raise ValueError("the devices have Coulomb friction, which the exact engine, being linear, does not model")
        if simulation.timing and T is None:
            return ExactTimedEngine(simulation.scene.plant, simulation.timing)
        return ExactEngine(simulation.plant)
    integrator = integrator or default_integrator(simulation.scene)
    count = least_substeps(integrator) if substeps is None else substeps
    if T is not None:
        return MujocoEngine(simulation.scene, T, integrator, count)
    return MujocoEngine(simulation.scene, simulation.scenario.T, integrator, count, simulation.timing)


def engine_name(engine: AnyEngine) -> str:
    if isinstance(engine, str):
        return engine
    kind: Any = engine if hasattr(engine, "__qualname__") else type(engine)
    return f"{kind.__module__}:{kind.__qualname__}"


def _own_engine(simulation: Simulation, engine: Engine | Callable[[Simulation], Engine]) -> Engine:
    name, is_engine = f"engine {engine_name(engine)}", hasattr(engine, "start") and not isinstance(engine, type)
    own_engine: Any = engine if is_engine or not callable(engine) else called(name, engine, simulation)
    if lacking := [part for part in ("start", "troubled") if not callable(getattr(own_engine, part, None))]:
        expected = "expected an object with start(buffer), advance(k) and troubled() (sim.engines.Engine)"
        raise InputError(f"{name} has no {' and no '.join(lacking)}: {expected}")
    if simulation.timing and not type(own_engine).__module__.startswith("haptic_loop."):
        raise InputError(f"{name}: only these engines simulate period and latency: {' and '.join(ENGINES)}")
    return own_engine
