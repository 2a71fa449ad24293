"""From a scenario and a coupling to a trace: the joint where the two worlds meet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from controller.contact import contact, held
from controller.coupling import Compliance, Coupling, NoCoupling, SpringDamper
from controller.environment import environment
from controller.lti import Array, Lti
from controller.process import Process, force_map
from models.device import Device
from models.scene import Scene, build, plant
from sim.engine import Engine, outside_forces
from sim.exact_engine import ExactEngine, HeldPlant, hold
from sim.loop import Progress, Record, run
from sim.mujoco_engine import LEAPFROG, LeapfrogEngine, MujocoEngine, profiler_off, quiet_warnings
from sim.scenario import InputError, Scenario

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
        return replace(self, scenario=scenario, scene=build(devices, scenario.human))

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
