"""From a scenario and a coupling to a trace: the joint where the two worlds meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from controller.coupling import Compliance, Coupling, NoCoupling, SpringDamper
from controller.environment import environment, held
from controller.loop import force_map
from controller.lti import Array, Lti
from controller.process import Process, Tape, contact
from models.device import Device
from models.scene import Scene, build, plant
from sim.engines import (
    LEAPFROG,
    Engine,
    ExactEngine,
    HeldPlant,
    LeapfrogEngine,
    MujocoEngine,
    hold,
    outside_forces,
    profiler_off,
    quiet_warnings,
)
from sim.scenario import InputError, Scenario

# ----------------------------------------------------------------------------------------------------
# The closed loop: a process and a plant, tick by tick.


STRETCH = 1024  # ticks between two looks at the clock, the keyboard and the numbers

Outside = Callable[[int, int], Array]  # (first tick, ticks) -> forces (ticks, outside)
Progress = Callable[[int, int], None]  # (ticks done, ticks in all)


@dataclass(frozen=True, eq=False)
class Record:
    """What every tick saw. Axes: tick, entry, simulation."""

    z: Array  # (N, order, nsim) process state
    s: Array  # (N, 2n, nsim) plant state: positions [m], velocities [m/s]
    w: Array  # (N, outside, nsim) outside forces [N]
    f: Array  # (N, m, nsim) forces fed back [N], within the limits
    diverged: bool  # the engine gave up, or a number stopped being finite, within the last stretch
    interrupted: bool  # stopped from the keyboard


def run(
    process: Process,
    engine: Engine,
    outside: Outside,
    ticks: int,
    start: Array,
    progress: Progress = lambda done, ticks: None,
) -> Record:
    """Close the loop for `ticks` periods from the plant state `start`, shape (2n, nsim)."""
    width = outside(0, 0).shape[1]
    tape = Tape(process, min(STRETCH, ticks), start.shape[0], width, start.shape[1])
    tape.s[0] = start
    engine.start(tape)
    parts: list[tuple[Array, ...]] = []
    done, diverged, interrupted = 0, False, False
    try:
        while done < ticks and not diverged:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = outside(done, count)[:, :, None]
            with np.errstate(over="ignore", invalid="ignore"):  # a diverging run is reported, not warned about
                stretch(tape, engine, count)
            finite = np.isfinite(tape.s[:count]).all(axis=(1, 2)) & np.isfinite(tape.f[:count]).all(axis=(1, 2))
            diverged = engine.troubled() or not finite.all()
            count = count if finite.all() else int(np.argmin(finite))
            tape.saturate(count)
            parts.append(tuple(part[:count].copy() for part in (tape.z, tape.s, tape.w, tape.f)))
            tape.rewind(count)
            done += count
            progress(done, ticks)
    except KeyboardInterrupt:  # what was finished is kept
        interrupted = True
    z, s, w, f = (np.concatenate(column) for column in zip(*parts, strict=True)) if parts else _nothing(tape)
    return Record(z, s, w, f, diverged, interrupted)


def stretch(tape: Tape, engine: Engine, ticks: int) -> None:
    """Close the loop for the first `ticks` rows of the tape."""
    tick, advance = tape.tick, engine.advance
    for k in range(ticks):
        tick(k)
        advance(k)


def _nothing(tape: Tape) -> tuple[Array, ...]:
    return tuple(part[:0] for part in (tape.z, tape.s, tape.w, tape.f))


ENGINES = ("mujoco", "exact")


@dataclass(frozen=True, eq=False)
class Assembly:
    """A scenario with its coupling, ready to run."""

    scenario: Scenario
    E: Lti  # what is to be felt: the environment, with every wall touching
    F: Lti  # what the devices feel while no wall touches
    process: Process
    scene: Scene
    plant: HeldPlant

    @property
    def friction(self) -> bool:
        """Whether a device has Coulomb friction: the scene has it then, `plant` has not."""
        return any(device.friction for device in self.scenario.device)

    @property
    def smooth(self) -> Assembly:
        """The same without Coulomb friction in the scene, which is what linear verdicts are about."""
        if not self.friction:
            return self
        devices = tuple(msgspec.structs.replace(device, friction=0.0) for device in self.scenario.device)
        scenario = self.scenario.replace(device=devices)
        return replace(self, scenario=scenario, scene=build(devices, scenario.human, scenario.person))

    @property
    def felt(self) -> Lti:
        """What the devices feel of E: F with every wall touching."""
        return list(self.process.frozen().values())[-1] if self.process.contact else self.F


def assemble(scenario: Scenario, coupling: Coupling) -> Assembly:
    """Build both worlds. Raises SingularLoop where the algebraic loop has no solution, InputError for walls that no
    V stands before.
    """
    if scenario.environment.walls and not isinstance(coupling, NoCoupling | SpringDamper | Compliance):
        raise InputError(f"environment.walls: {type(coupling).__name__} holds a linear model, so it cannot face walls")
    network, delays = scenario.environment, (scenario.theta, scenario.psi)
    E = environment(held(network), scenario.T)
    walled = contact(network, coupling, *delays, scenario.T) if network.walls else None
    F = walled.open if walled else force_map(E, coupling, *delays)
    process = Process(F, _each(scenario.device, "force_limit"), _each(scenario.device, "encoder_step"), walled)
    scene = build(scenario.device, scenario.human, scenario.person)
    return Assembly(scenario, E, F, process, scene, hold(plant(scene.model), scenario.T))


def simulate(
    assembly: Assembly,
    engine: str = "mujoco",
    integrator: str = "RK4",
    substeps: int = 4,
    voluntary: bool = True,
    samples: int | None = None,
    progress: Progress = lambda done, ticks: None,
) -> Record:
    """The scenario's run, from rest; `samples` ticks of it where that is given."""
    scenario, scene = assembly.scenario, assembly.scene

    def outside(first: int, ticks: int) -> Array:
        return outside_forces(scenario, scene, first, ticks, voluntary)

    rest = np.zeros((assembly.plant.A.shape[0], 1))
    with profiler_off(), quiet_warnings():
        plant_engine = make_engine(assembly, engine, integrator, substeps)
        return run(
            assembly.process, plant_engine, outside, scenario.samples if samples is None else samples, rest, progress
        )


def make_engine(
    assembly: Assembly, engine: str, integrator: str = "RK4", substeps: int = 4, T: float | None = None
) -> Engine:
    """The engine of that name for one simulation, which MuJoCo advances by T seconds (default: the scenario's).

    Raises ValueError for a name that is none.
    """
    if engine == "exact":
        if assembly.friction:
            raise ValueError("the devices have Coulomb friction, which the exact engine, being linear, does not model")
        return ExactEngine(assembly.plant, assembly.process.force_limit)
    if engine == "mujoco":
        kind = LeapfrogEngine if integrator == LEAPFROG else MujocoEngine
        return kind(assembly.scene, assembly.scenario.T if T is None else T, integrator, substeps)
    raise ValueError(f"engine is {engine!r}, allowed are {', '.join(ENGINES)}")


def _each(devices: tuple[Device, ...], name: str) -> Array:
    return np.array([getattr(device, name) for device in devices])


if __name__ == "__main__":
    from cli.main import door

    door("run")
