"""A MuJoCo scene as the environment of a scenario: the scene behind a coupling, its energy account and its guarantee.

    figures = simulate(scenario, design).meta["world"]

The scene is solved together with the coupling (models.world). The energy shell (controller.budget) limits the energy
that leaves the port to a budget W0 plus the energy that gravity and springs released, whatever the scene does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from haptic_loop.controller.budget import START_J, Shell, ShellFigures
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.environment import Block, Network, SceneFile
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Net, Process
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.files import InputError
from haptic_loop.design.result import listed
from haptic_loop.models.human import Human
from haptic_loop.models.scene import quiet_warnings
from haptic_loop.sim.passivity_layer import netted
from haptic_loop.sim.run import Simulation, assemble, outside_forces, run
from haptic_loop.sim.scenario import Scenario

if TYPE_CHECKING:  # loads MuJoCo, which other scenarios and --help do not need
    from haptic_loop.models.world import Contact, World, WorldPort

_ROUNDING = 1e-9  # entries of A below this relative size are rounding errors of finite differences over 1e-6 m
_APART = 1e-12  # entries of D_V, the direct part of a coupling, below this relative size are rounding errors


@dataclass(frozen=True, kw_only=True)
class WorldFigures(ShellFigures):
    """Energies and other figures at the port of a world."""

    given_J: float  # largest energy that hands and devices received, minus what the devices' damping dissipated
    port_least_J: float  # least energy that had entered the scene by any tick: sum of f'(u[k] - u[k-1]), contacts at u
    released_J: float  # largest energy that gravity and springs of the scene have released
    created_J: float  # bound on the energy that constraints created (the lemma on MuJoCo worlds in docs/theory.md)
    unsettled_steps: int  # number of steps whose limited forces did not settle in the allowed repetitions
    warnings: list[str]  # texts of MuJoCo's warnings


@dataclass(frozen=True)
class WorldRecord:
    """The entry `world` of a report; `WorldFigures` explains the figures."""

    ticks: int
    ticks_acted: int  # ticks in which the shell changed a force
    given_J: float
    port_least_J: float
    released_J: float
    created_J: float
    unsettled_steps: int
    warnings: list[str]

    @classmethod
    def of(cls, figures: WorldFigures) -> WorldRecord:
        shared = {name: getattr(figures, name) for name in cls.__dataclass_fields__ if name != "ticks_acted"}
        return cls(ticks_acted=figures.limited_ticks, **shared)

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo warned of a number in the scene that is huge or not finite."""
        return any("unstable" in text for text in self.warnings)


@dataclass(frozen=True)
class SceneRecord:
    """The entry `scene` of a report."""

    file: str
    settings: str  # options that this program sets in the scene
    parts: list[dict[str, object]]  # for each kind of part its number, and a bound on the energy that it generates
    active: list[str]  # actuators, plugins and callbacks, which the lemma in docs/theory.md does not cover

    @classmethod
    def of(cls, scene: World) -> SceneRecord:
        parts: list[dict[str, object]] = [
            {"part": p.what, "count": p.count, "at_the_port": p.at_the_port} for p in scene.parts()
        ]
        return cls(scene.path.name, scene.settings(), parts, scene.outside_the_lemma())


@dataclass(frozen=True)
class Claim:
    """The guarantee of a run in a world, or the reason why there is none."""

    guaranteed: bool
    words: str

    @classmethod
    def of(cls, assessment: Assessment, certified_for: Network | None = None, ran: WorldRecord | None = None) -> Claim:
        """Return the claim of the assessed run.

        Without a guarantee, the claim names the network `certified_for` for which the coupling is certified, if any.
        The record `ran` of a finished run adds the sum of W0 and the released energy. If its scene diverged, there is
        no guarantee.
        """
        guarantee = assessment.guarantee
        if ran and ran.diverged:
            return cls(False, "No guarantee: the scene diverged, so that the energy it released is no bound.")
        if guarantee is None or guarantee.energy_J is None:
            return cls(False, f"No guarantee: {assessment.reason}.{_elsewhere(assessment, certified_for)}")
        energy = f"W0 = {_energy(guarantee.energy_J)}"
        total = f", here at most {_energy(guarantee.energy_J + ran.released_J)} in all" if ran else ""
        swept = " A refined sweep shows this, without an exact proof." if guarantee.proof == "sampled" else ""
        return cls(
            True,
            f"Whatever this scene does, no passive hand is given more than {energy} beyond what gravity and springs "
            f"released{total}.{swept}",
        )


def _elsewhere(assessment: Assessment, network: Network | None) -> str:
    if network is None:
        return ""
    scene = getattr(assessment.environment, "world", None)
    stale = scene is None or network.scene_digest != scene.digest
    changed = ", and the scene is another one or has changed: call linearise again" if stale else ""
    return f" The coupling is certified for the linear network of {network.linear_model_of} only{changed}."


def _energy(joules: float) -> str:
    return f"{1e3 * joules:.4g} mJ" if joules < 1 else f"{joules:.4g} J"


def scene_of(scenario: Scenario, coupling: Coupling, gravity: bool = True) -> World:
    """Return the compiled scene with a spring G = D_V^-1 at each contact.

    D_V is the direct part of the coupling's compliance V. Raises InputError if there is no V, if D_V couples devices or
    is not symmetric and positive definite, or if the scene is invalid or has changed since the scenario was loaded.
    """
    world = scenario.environment.world
    assert world is not None
    V = coupling.compliance(scenario.T)
    if V is None or not V.D.any():
        raise InputError(f"environment.world needs a coupling: {_no_spring(coupling)}")
    from haptic_loop.models.world import World

    contacts = _contacts_of(scenario.environment)
    try:
        _check_unchanged(world)
        return World(world.file, contacts, _springs(V, contacts), scenario.T, world.every, gravity)
    except ValueError as error:
        raise InputError(f"environment: {error}") from None


def _check_unchanged(world: SceneFile) -> None:
    from haptic_loop.models.world import digest_of

    if digest_of(Path(world.file)) != world.digest:
        raise ValueError(f"world {world.file} has changed since the scenario was loaded; load it again")


def _no_spring(coupling: Coupling) -> str:
    """Return why a coupling gives no spring between scene and devices."""
    if coupling.holds_model:
        return (
            "an optimal coupling filters the forces of its linear model and has no V; take a spring-damper or another V"
        )
    return f"coupling {coupling.kind} has no compliance V with a direct part, so there is no spring to the devices"


def _contacts_of(environment: Network) -> list[Contact]:
    from haptic_loop.models.world import Contact

    world = environment.world
    assert world is not None
    return [Contact(body, along) for body, along in zip(environment.bodies, world.along, strict=True)]


def _springs(V: Lti, contacts: Sequence[Contact]) -> list[Array]:
    """Return G = D_V^-1 of each device. Raises ValueError if D_V is not positive definite or couples devices."""
    ends = np.cumsum([0, *(len(contact.along) for contact in contacts)])
    if V.D.shape != (ends[-1], ends[-1]):
        raise ValueError(f"the coupling has {len(V.D)} channels, the world has {ends[-1]}")
    within = [V.D[a:b, a:b] for a, b in pairwise(ends)]
    between = V.D.copy()
    for a, b in pairwise(ends):
        between[a:b, a:b] = 0.0
    if np.abs(between).max() > _APART * np.abs(V.D).max():
        raise ValueError("the coupling's direct part couples devices; a world needs one spring per device")
    for contact, D in zip(contacts, within, strict=True):
        asymmetric = np.abs(D - D.T).max() > _APART * np.abs(D).max()
        if asymmetric or not np.linalg.eigvalsh((D + D.T) / 2).min() > 0:
            label = f"the coupling's direct part {D.tolist()} at {contact.body!r}"
            raise ValueError(f"{label} is not symmetric and positive definite; a world needs a spring there")
    return [np.linalg.inv((D + D.T) / 2) for D in within]


# ---- the passivity layer of a run


@dataclass(frozen=True, eq=False)
class Touched:
    """Settings of a passivity layer (sim.passivity_layer): the scenario's world behind coupling and energy shell."""

    start: float = START_J  # W0 [J]

    def net(self, simulation: Simulation, process: Process, nsim: int) -> InWorld:
        """Return a new passivity layer for `nsim` runs. Raises InputError if the loop cannot contain a world."""
        scene = scene_of(simulation.scenario, simulation.coupling)
        if any(simulation.scenario.psi):
            raise InputError("psi: a world answers within the tick, so psi must be 0")
        V = simulation.coupling.compliance(simulation.loop.T)
        assert V is not None  # `scene_of` has checked it.
        try:
            shell = Shell(V, start=self.start, nsim=nsim)
        except ValueError as error:
            raise InputError(f"energy budget: {error}") from None
        damping = simulation.loop.Delta() / (simulation.loop.T_max or simulation.loop.T)
        return InWorld(shell, [scene.port(process.force_limit, process.balls) for _ in range(nsim)], damping)


def live(simulation: Simulation) -> Simulation:
    """Return the simulation with a passivity layer that contains its world and delays the forces by theta."""
    touched, process = Touched(START_J), simulation.process

    def late(nsim: int) -> Net:
        return Late(touched.net(simulation, process, nsim), simulation.scenario.theta)

    late(1)  # An impossible coupling raises InputError here, before the run.
    return replace(simulation, process=replace(process, net=late))


class Late:
    """A world whose forces reach the devices after constant delays."""

    def __init__(self, world: InWorld, theta: Sequence[int]) -> None:
        self.world = world
        self._lines: list[deque[Array | float]] = [deque([0.0] * n) for n in theta]

    def send(self, x: Array, force: Array, /) -> None:
        self.world.send(x, force)
        for line, f in zip(self._lines, force, strict=True):
            line.append(f.copy())
            f[:] = line.popleft()

    def apply(self, k: int, force: Array, /) -> None:
        self.world.apply(k, force)

    def figures(self) -> WorldFigures:
        return self.world.figures()


class InWorld:
    """The passivity layer of a world: the world behind its shell, and the energy that hands and devices received."""

    def __init__(self, shell: Shell, ports: list[WorldPort], damping: Array) -> None:
        """`damping` (m, m) [N/m] is Delta over the longest period; a tick dissipates dx' damping dx or more."""
        self.ports, self._shell, self._damping = ports, shell, damping
        m, nsim = len(damping), len(ports)
        self._x: Array | None = None
        self._acting = self._u = np.zeros((m, nsim))
        self._at_port, self._given = np.zeros(nsim), np.zeros(nsim)
        self._least, self._most = np.zeros(nsim), np.zeros(nsim)

    def send(self, x: Array, force: Array, /) -> None:
        if self._x is not None:
            dx = x - self._x
            self._given -= (dx * (self._acting + self._damping @ dx)).sum(axis=0)
            np.maximum(self._most, self._given, out=self._most)
        self._x = x.copy()
        free = self._shell.free(x)
        try:
            wanted = np.stack([port.step(u0) for port, u0 in zip(self.ports, free.T, strict=True)], axis=1)
        except ValueError as error:
            raise InputError(f"environment: {error}") from None
        self._shell.credit([port.released for port in self.ports])
        force[...], u = self._shell.limit(wanted)
        self._at_port += (force * (u - self._u)).sum(axis=0)
        self._u = u
        np.minimum(self._least, self._at_port, out=self._least)

    def apply(self, k: int, force: Array, /) -> None:
        self._acting = force.copy()

    def figures(self) -> WorldFigures:
        return WorldFigures(
            **vars(self._shell.figures(None)),
            given_J=float(self._most.max()),
            port_least_J=float(self._least.min()),
            released_J=max(port.released for port in self.ports),
            created_J=max(port.created for port in self.ports),
            unsettled_steps=max(port.unsettled for port in self.ports),
            warnings=list(dict.fromkeys(text for port in self.ports for text in port.warnings)),
        )


# ---- hands and adversaries

RANDOM, LOSSLESS = "random hands", "lossless hands"
_THROWN = 0.3  # [m/s] rms of the initial speeds of all bodies of devices and hands
_NEVER = 1e3  # [J] W0 so large that the shell never acts
_ADVERSARIES = 20  # number of sets of hands in `least_at_port`
_BRAKED = 10  # number of runs in `_hit_and_brake`
_STREAM = 11  # random stream of these draws, independent of the hands' stream with the same seed


@dataclass(frozen=True)
class HandsInWorld:
    """Energy figures of one set of hands in a world, after a start with random speeds."""

    kind: str  # RANDOM or LOSSLESS
    number: int  # index of the set, from 0
    figures: WorldFigures

    @property
    def excess_J(self) -> float:
        """The energy given beyond W0 and the released energy; under a guarantee it is at most 0."""
        return self.figures.given_J - self.figures.start_J - self.figures.released_J


def thrown(
    scenario: Scenario,
    coupling: Coupling,
    humans: int,
    seed: int,
    duration: float,
    start: float = START_J,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[HandsInWorld]:
    """Simulate sets of hands of the scenario's population for `duration` [s], and return their energies.

    All bodies of hands and devices begin with random speeds. In sets with odd numbers, chains have no dampers. `start`
    is W0 [J].
    """
    from haptic_loop.sim.crowds import Validation

    links = getattr(scenario.population, "links", 1)
    scenario = scenario.replace(duration=max(scenario.duration, duration))
    question = Validation(scenario, coupling, seed, humans, links, "exact", duration)
    nobody, runs = assemble(scenario, coupling), []
    for i in range(humans):
        crowd, rng = question.crowd(i), np.random.default_rng(np.random.SeedSequence((seed, _STREAM, i)))
        hands, kind = crowd.humans(0), LOSSLESS if i % 2 else RANDOM
        if i % 2:
            hands = tuple(_lossless(hand) for hand in hands)
        simulation = netted(nobody.held_by(hands, crowd.persons(0), sum(crowd.mechanics, ())), Touched(start))
        states, n = len(simulation.plant.A), simulation.scene.model.nq
        first = np.zeros((states, 1))
        first[n : 2 * n, 0] = _THROWN * rng.normal(size=n)
        quiet = partial(outside_forces, simulation.scenario, simulation.scene, voluntary=False)
        engine = "mujoco" if simulation.friction else "exact"
        trace = run(simulation, engine, quiet, round(duration / scenario.T), first)
        figures = trace.net.figures() if trace.net else None
        assert isinstance(figures, WorldFigures)
        runs.append(HandsInWorld(kind, i, figures))
        progress(i + 1, humans)
    return runs


def _lossless(hand: Any) -> Any:
    """Return a chain without dampers and voluntary motion, and any other hand unchanged."""
    if not isinstance(hand, Human):
        return hand
    links = tuple(msgspec.structs.replace(link, damping=0.0) for link in hand.links)
    return msgspec.structs.replace(hand, links=links, voluntary=None)


def _hit_and_brake(scenario: Scenario, coupling: Coupling, seed: int, done: Callable[[int], None]) -> float:
    """Return the least energy [J] that had entered the port at any tick of _BRAKED runs of 1 s.

    The devices move at random, stop and turn back. `done` is called with the number of finished runs.
    """
    scene, rng, least = scene_of(scenario, coupling), np.random.default_rng((seed, _STREAM)), 0.0
    with quiet_warnings():
        for finished in range(_BRAKED):
            done(finished)
            port, at_port = scene.port(), 0.0
            goal, speed, left, before = np.zeros(scene.channels), np.zeros(scene.channels), 0, port.u
            for _ in range(round(1.0 / scenario.T)):
                if left == 0:
                    left = int(rng.integers(2, 60))
                    speed = rng.normal(size=scene.channels) * rng.choice([0.0, 0.1, 0.5]) - goal / (100 * scenario.T)
                left, goal = left - 1, goal + scenario.T * speed
                force = port.step(goal)
                at_port, before = at_port + float(force @ (port.u - before)), port.u
                least = min(least, at_port)
    return least


def least_at_port(
    scenario: Scenario, coupling: Coupling, seed: int, progress: Callable[[int, int], None]
) -> dict[str, float]:
    """Return for each adversary the least energy [J] that had entered the port; below 0 the scene gave energy.

    The scene has no shell, or a shell that never acts. `progress` is called with the numbers of finished and of all
    runs.
    """
    total = _BRAKED + _ADVERSARIES
    least = {"hit and brake": _hit_and_brake(scenario, coupling, seed, lambda done: progress(done, total))}
    of_hands = thrown(
        scenario, coupling, _ADVERSARIES, seed, 1.0, _NEVER, lambda done, _: progress(_BRAKED + done, total)
    )
    for kind in (RANDOM, LOSSLESS):
        least[f"thrown {kind}"] = min(each.figures.port_least_J for each in of_hands if each.kind == kind)
    return least


def linearise(world: Scenario | str | Path, pose: Any = None, contacts: Sequence[str] = (), T: float = 1e-3) -> Network:
    """Return the linear network of a scene near a pose, for designs that need an environment.

    Contacts stay open or closed as in the pose, and rotations are small. A coupling that is designed for the network is
    certified for this network, not for the scene.

    Args:
        world: A scenario with a world, or an MJCF file.
        pose: Positions (nq,) of the scene, the name of a keyframe, or None for the initial pose.
        contacts: For an MJCF file: the bodies that devices touch. The contacts slide along x.
        T: For an MJCF file: the period [s].

    Returns:
        The network, whose `block` is the linear model.

    Raises:
        InputError: The scene or the pose is invalid, the scene has changed since the scenario was loaded, or the model
            is not a passive environment.
    """
    from haptic_loop.models.world import Contact, World, digest_of

    if isinstance(world, Scenario):
        file = world.environment.world
        if file is None:
            raise InputError("linearise: the scenario has no environment.world")
        path, touched, T = file.file, _contacts_of(world.environment), world.T
    else:
        path, touched = str(world), [Contact(name) for name in contacts]
    unit = [np.eye(len(contact.along)) for contact in touched]
    try:
        if isinstance(world, Scenario) and world.environment.world:
            _check_unchanged(world.environment.world)
        digest = digest_of(Path(path))
        E = _joined(Lti(*World(path, touched, unit, T).linear(pose), T)).inverse()
        model = f"{Path(path).name} near {_pose_words(pose)}"
        contacts = tuple(contact.body for contact in touched)
        return Network(contacts, block=Block.of(E), linear_model_of=model, scene_digest=digest)
    except ValueError as error:
        raise InputError(f"linearise: {error}") from None


def _pose_words(pose: Any) -> str:
    if pose is None:
        return "its initial pose"
    return f"its keyframe {pose!r}" if isinstance(pose, str) else f"the pose [{listed(pose, 5)}]"


def _joined(G: Lti) -> Lti:
    """Return the system without the states of bodies that no chain of parts connects to a contact."""
    size = np.abs(G.A).max(initial=1.0)
    linked = np.abs(G.A) > _ROUNDING * size
    driven, seen = (np.abs(G.B) > 0).any(axis=1), (np.abs(G.C) > 0).any(axis=0)
    for _ in range(G.order):
        driven, seen = driven | linked[:, driven].any(axis=1), seen | linked[seen].any(axis=0)
    keep = np.flatnonzero(driven & seen)
    return Lti(G.A[np.ix_(keep, keep)], G.B[keep], G.C[:, keep], G.D, G.T)
