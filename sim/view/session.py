"""The running loop of the window, without a display: keys, scripts, mouse and clock determine its frames.

When the coupling or a delay changes while the loop runs, the plant keeps its positions and velocities; in a world it
restarts from rest. The new controller starts in its steady state for these positions x, with no wall touched. Its delay
lines hold the static force, which is F(1) x if no limiter acts. So the force changes to that of the new coupling, and
the environment's masses lose their motion.

The mouse is a hand: a spring from the handle to the dragged point, and a damper from the handle to the ground. This
hand is part of the exact plant and passive, so a certificate for every passive human covers it. Only the end of the
spring moves with the mouse, as in a voluntary motion. A force that is computed once per picture would come too late to
be passive, and could destabilise a certified loop.
"""

from __future__ import annotations

import math
import re
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import MOST_SAMPLES
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import StepBuffer, at_limit
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.conditions import Condition
from haptic_loop.design.designs import KINDS, name_and_own
from haptic_loop.design.result import Chosen, DesignFailed
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.scene import Plant, Scene
from haptic_loop.sim.couplings import NAMES, assessed, choose
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.run import Simulation, assemble, outside_forces, run_block
from haptic_loop.sim.scenario import InputError, Scenario, is_world
from haptic_loop.sim.stability import Mode, worst_mode
from haptic_loop.sim.view.drawn_object import object_of
from haptic_loop.sim.world import START_J, InWorld, Late, WorldFigures, live

# ----------------------------------------------------------------------------------------------------
# Events of a running loop, by a key or by a script.


#: name of a coupling in scripts -> name of the coupling in sim.couplings
COUPLINGS = {"designed" if name == "spring-damper" else name: name for name in NAMES}
#: name of a coupling in sim.couplings -> its name in scripts; a script may use both names
LABELS = {kind: label for label, kind in COUPLINGS.items()}
GIVEN = "given"  # the coupling of --coupling FILE.json
_STRONGEST = 100.0  # [N] largest push


@dataclass(frozen=True)
class Couple:
    """A change to another coupling, which is chosen or designed for the present delays."""

    name: str  # one of COUPLINGS, or GIVEN


@dataclass(frozen=True)
class _Delay:
    """A change of the delay by a number of samples on every channel; the coupling stays the same."""

    which: str  # theta or psi
    samples: int


@dataclass(frozen=True)
class _Push:
    """A constant force on a handle, which lasts until the next push of its channel."""

    channel: int  # counted from 1
    force: float  # [N]


@dataclass(frozen=True)
class _Restart:
    """A restart of plant and process from rest."""


_Event = Couple | _Delay | _Push | _Restart

#: GLFW's code -> (name, event) of keys; 0 to 5 and the letters are left to MuJoCo's viewer
KEYS: dict[int, tuple[str, _Event]] = {
    ord("6"): ("6", Couple("none")),
    ord("7"): ("7", Couple("published")),
    ord("8"): ("8", Couple("designed")),
    ord("9"): ("9", Couple("optimal")),
    260: ("Insert", Couple(GIVEN)),
    265: ("Up", _Delay("theta", 1)),
    264: ("Down", _Delay("theta", -1)),
    268: ("Home", _Delay("psi", 1)),
    269: ("End", _Delay("psi", -1)),
    259: ("Backspace", _Restart()),
}


def keys_help(with_file: bool) -> list[tuple[str, str]]:
    """Return (key, action) for keys and mouse; `with_file` adds the key for the coupling from a file."""
    keys = [(name, words(event)) for name, event in KEYS.values() if with_file or event != Couple(GIVEN)]
    return [*keys, ("double click", "take a body"), ("Ctrl+right", "pull it")]


Script = tuple[tuple[float, _Event], ...]  # (time [s], event), in order of time


def parse_script(text: str, channels: int) -> Script:
    """Return the events of '0:none 5:designed 8:push1=3' in order of time. Raises InputError for other text."""
    script = []
    for entry in text.split():
        when, colon, what = entry.partition(":")
        time = _number(when)
        if not colon or not 0 <= time <= 3600:
            raise InputError(f"--script: {entry!r}, expected SECONDS:EVENT with 0 to 3600 s")
        script.append((time, _event(entry, what, channels)))
    if not script:
        raise InputError("--script is empty, expected entries like 0:none 5:designed")
    return tuple(sorted(script, key=lambda item: item[0]))


def words(event: _Event) -> str:
    """Return the event in the words of a script."""
    match event:
        case Couple(name):
            return name
        case _Delay(which, samples):
            return f"{which}{samples:+d}"
        case _Push(channel, force):
            return f"push{channel}={force:g}"
        case _Restart():
            return "restart"


def _event(entry: str, what: str, channels: int) -> _Event:
    if (label := LABELS.get(what, what)) in (*COUPLINGS, GIVEN):
        return Couple(label)
    if what == "restart":
        return _Restart()
    if delay := re.fullmatch(r"(theta|psi)([+-]\d{1,4})", what):
        return _Delay(delay[1], int(delay[2]))
    if push := re.fullmatch(r"push(\d{1,3})=([+-]?[\d.]+)", what):
        channel, force = int(push[1]), _number(push[2])
        if 1 <= channel <= channels and abs(force) <= _STRONGEST:
            return _Push(channel, force)
        raise InputError(f"--script: {entry!r}, allowed are push1 to push{channels} with up to {_STRONGEST:g} N")
    allowed = ", ".join((*COUPLINGS, GIVEN, "theta+1", "theta-1", "psi+1", "psi-1", "push1=3", "restart"))
    raise InputError(f"--script: {entry!r} is no event, allowed are {allowed}")


def _number(text: str) -> float:
    """Return the number in a text, or infinity for other text, which every caller refuses."""
    try:
        return float(text)
    except ValueError:
        return math.inf


# ----------------------------------------------------------------------------------------------------
# A loop that is prepared while another one runs, with its growth rate and assessment.


@dataclass(frozen=True)
class Menu:
    """The settings with which keys and scripts choose couplings."""

    case: str
    condition: str | Condition | None = None  # condition of designs; None for the kind's default
    given: str | None = None  # the file of --coupling
    limiter: bool | None = None  # False: forces are clipped


@dataclass(frozen=True, eq=False)
class PreparedLoop:
    """A loop that is ready to run, with its dominant mode and its assessment."""

    menu: Menu
    label: str  # name of the coupling in scripts
    chosen: Chosen
    simulation: Simulation
    mode: Mode | None  # dominant mode of the exact loop; with walls, of the worst set of touched walls; None in a world
    assessment: Assessment

    @property
    def scenario(self) -> Scenario:
        return self.simulation.scenario

    @property
    def coupling(self) -> Coupling:
        return self.chosen.coupling


def first_loop(menu: Menu, scenario: Scenario, label: str) -> PreparedLoop:
    """Return the loop that the session begins with. Raises InputError, DesignFailed or SingularLoop."""
    return _prepare(menu, scenario, label, _choose(menu, scenario, label))


def _changed(prepared: PreparedLoop, event: Couple | _Delay) -> PreparedLoop:
    """Return the loop after an event. Raises InputError, DesignFailed or SingularLoop; the old loop stays valid."""
    if isinstance(event, Couple):
        chosen = _choose(prepared.menu, prepared.scenario, event.name)
        return _prepare(prepared.menu, prepared.scenario, event.name, chosen)
    delays = tuple(n + event.samples for n in getattr(prepared.scenario, event.which))
    if not 0 <= min(delays) <= max(delays) <= MOST_SAMPLES:
        raise InputError(f"{event.which} would be {list(delays)}, allowed are 0 to {MOST_SAMPLES} samples")
    scenario = prepared.scenario.replace(None, **{event.which: delays})
    return _prepare(prepared.menu, scenario, prepared.label, prepared.chosen)


def _choose(menu: Menu, scenario: Scenario, label: str) -> Chosen:
    if label == GIVEN:
        if menu.given is None:
            raise InputError("there is no coupling from a file (start with --coupling FILE.json)")
        return choose(scenario, menu.case, menu.given, name_and_own(menu.condition)[1])
    name = COUPLINGS[label]
    condition = menu.condition if name in KINDS else name_and_own(menu.condition)[1]
    return choose(scenario, menu.case, name, condition, menu.limiter)


def _prepare(menu: Menu, scenario: Scenario, label: str, chosen: Chosen) -> PreparedLoop:
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario  # only the nominal environment runs
    if is_world(scenario):
        simulation = live(assemble(scenario, chosen.coupling))
        assessment = assessed(alone, menu.case, chosen, energy_budget=START_J, limiter=False)
        return PreparedLoop(menu, label, chosen, simulation, None, assessment)
    assessment = assessed(alone, menu.case, chosen, limiter=menu.limiter)
    simulation = assemble(scenario, chosen.coupling, assessment.force_limits.rho)
    return PreparedLoop(menu, label, chosen, simulation, worst_mode(simulation), assessment)


# ----------------------------------------------------------------------------------------------------
# The session.


HISTORY = 4.0  # [s] time span of the forces in a picture
_BLOCK = 64  # largest number of ticks in one block
LONGEST_LAG = 0.1  # [s] largest lag that a frame of a window catches up; if the lag is longer, the excess is lost
_STIFFNESS, _DAMPING = 200.0, 3.0  # [N/m], [N s/m] of the mouse's hand, as in the hands of the default scenario


@dataclass
class _Pace:
    """A counter of the ticks of T seconds that are due on a clock that began at 0."""

    T: float  # [s]
    patience: float = LONGEST_LAG  # [s] largest lag that is caught up
    done: int = 0  # number of ticks
    overruns: int = 0  # number of times that the loop fell behind by more than `patience`
    lost: float = 0.0  # [s] clock time without ticks

    def due(self, now: float) -> int:
        """Return the number of ticks due at the time `now` [s], and count them as done."""
        # Without the addend, rounding of the clock could hide a tick.
        ticks = max(0, int((now - self.lost) / self.T + 1e-6) - self.done)
        most = self.patience / self.T
        if ticks > most:
            most = int(most)
            self.overruns += 1
            self.lost += (ticks - most) * self.T
            ticks = most
        self.done += ticks
        return ticks

    def factor(self, now: float) -> float:
        """Return simulated time over clock time, which approaches 1 if no time was lost."""
        return self.done * self.T / now if now > self.T else 1.0


@dataclass(frozen=True)
class Grip:
    """The device that the mouse holds, and the point to which the mouse pulls the handle."""

    channel: int  # first channel of the device, counted from 0
    target: tuple[float, ...]  # [m] displacement of the handle on each axis of the device
    lever: float = 1.0  # of the scenario: the mouse's hand holds a rotary device at its radius

    @property
    def channels(self) -> range:
        return range(self.channel, self.channel + len(self.target))

    @property
    def pull(self) -> Array:
        """The hand's force [N] on each axis, for a handle that rests at 0."""
        return self.lever**2 * _STIFFNESS * np.array(self.target)

    def force(self, scene: Scene, s: Array) -> Array:
        """Return the hand's force [N] on each axis of the handle, in the plant state s."""
        joints, n = np.array(scene.handles)[list(self.channels)], scene.model.nq
        return self.pull - self.lever**2 * (_STIFFNESS * s[joints] + _DAMPING * s[n + joints])


def _gripped(scene: Scene, grip: Grip, T: float) -> HeldPlant:
    """Return the plant with the spring and damper of the mouse's hand on a handle. Their other ends are fixed."""
    free, n = scene.plant, scene.model.nq
    A = free.A.copy()
    for channel in grip.channels:
        joint, at_handle = scene.handles[channel], grip.lever**2 * free.B[:, scene.tapped[channel]]
        A[:, joint] -= _STIFFNESS * at_handle
        A[:, n + joint] -= _DAMPING * at_handle
    return hold(Plant(A, free.B, free.C), T)


@dataclass(frozen=True, eq=False)
class Frame:
    """The data of one picture."""

    t: float  # [s] simulated time
    q: Array  # (n,) positions of all joints [m], motors first
    mean: Array  # (m,) mean force fed back since the last frame [N]
    low: Array  # (m,) least force since the last frame [N]
    high: Array  # (m,) largest force since the last frame [N]
    at_limit: NDArray[np.bool_]  # (m,) whether its force or its device's vector reached a limit since the last frame
    push: Array  # (m,) sum of the mouse's and the script's forces on each handle [N]
    history: Array  # (ticks, m) force fed back over the last HISTORY seconds [N]
    clipped: int  # ticks in `history` in which some force is at its limit (controller.tick.at_limit)
    prepared: PreparedLoop
    note: str  # the last event, perhaps with a reason why it was refused, or a remark that the loop diverged
    overruns: int
    lost: float  # [s]
    factor: float  # simulated time over clock time
    nodes: Array | None = None  # (nodes,) displacements of the object's nodes [m]
    pose: Array | None = None  # (nq,) positions of a world's scene
    world: WorldFigures | None = None


class LiveLoop:
    """The closed loop, which `frame` advances to the time of the clock."""

    def __init__(
        self, prepared: PreparedLoop, executor: Executor, script: Script = (), patience: float = LONGEST_LAG
    ) -> None:
        """Start a session.

        Args:
            prepared: The first loop.
            executor: Prepares the loops that keys request while the present loop runs.
            script: Events at given times. This constructor prepares their loops.
            patience: Largest lag behind the clock [s] that is caught up; if the lag is longer, the excess is lost.

        Raises:
            InputError, DesignFailed, SingularLoop: An event of the script is impossible.
        """
        self.prepared = prepared
        self.pace = _Pace(prepared.scenario.T, patience)
        self.keys: SimpleQueue[_Event] = SimpleQueue()
        self.clipped = 0  # number of clipped ticks since the start
        self.log: list[tuple[float, str, PreparedLoop]] = [(0.0, "start", prepared)]  # (time [s], event, loop)
        self.script_ends = script[-1][0] if script else 0.0  # [s]
        self._executor, self._latest = executor, prepared
        self._wanted: list[tuple[_Event, Future[PreparedLoop | str]]] = []
        self._script = _rehearsed(prepared, script)
        self._tick = 0
        self._pushed = np.zeros(prepared.scenario.channels)  # [N] forces of the script on the handles
        self._history = np.zeros((max(1, round(HISTORY / prepared.scenario.T)), prepared.scenario.channels))
        self._grip: Grip | None = None
        self._note = ""
        self._enter(prepared, np.zeros(prepared.simulation.plant.A.shape[0]))

    @property
    def t(self) -> float:
        """Simulated time [s]."""
        return self._tick * self.pace.T

    @property
    def state(self) -> Array:
        """The plant state: positions [m], velocities [m/s], then states of the hands' impedances."""
        return self._buffer.s[0, :, 0].copy()

    def frame(self, now: float, grip: Grip | None = None) -> Frame:
        """Handle keys and prepared loops, advance to `now` [s] while the mouse holds `grip`, and return the frame."""
        self._take_keys()
        self._take_finished()
        grip = grip and replace(grip, lever=self.prepared.scenario.lever)
        self._hold(grip)
        first = self._tick
        self._run(self.pace.due(now))
        push = self._pushed.copy()
        if grip:
            push[list(grip.channels)] += grip.force(self.prepared.simulation.scene, self.state)
        recent = self._history[-max(1, min(self._tick - first, len(self._history))) :]
        shown = self._history[-max(1, min(self._tick, len(self._history))) :]
        n, process = self.prepared.simulation.scene.model.nq, self.prepared.simulation.process
        over, last = (at_limit(f[:, :, None], process.force_limit, process.balls)[:, :, 0] for f in (shown, recent))
        world = self.world
        return Frame(
            pose=world and world.ports[0].data.qpos.copy(),
            world=world and world.figures(),
            t=self.t,
            q=self.state[:n],
            nodes=self._nodes,
            mean=recent.mean(axis=0),
            low=recent.min(axis=0),
            high=recent.max(axis=0),
            push=push,
            history=shown.copy(),
            at_limit=np.any(last, axis=0),
            clipped=int(np.any(over, axis=1).sum()),
            prepared=self.prepared,
            note=self._note,
            overruns=self.pace.overruns,
            lost=self.pace.lost,
            factor=self.pace.factor(now),
        )

    def _take_keys(self) -> None:
        while True:
            try:
                event = self.keys.get_nowait()
            except Empty:
                return
            if isinstance(event, Couple | _Delay):
                self._note = f"{words(event)}: being prepared"
                self._wanted.append((event, self._executor.submit(self._make, event)))
            else:
                self._happen(event)

    def _make(self, event: Couple | _Delay) -> PreparedLoop | str:
        """Return the loop after an event, or why it is refused. `_latest` requires an executor with one worker."""
        try:
            self._latest = _changed(self._latest, event)
        except (InputError, DesignFailed, SingularLoop) as error:  # The old loop goes on.
            return " ".join(str(error).split())
        return self._latest

    def _take_finished(self) -> None:
        while self._wanted and self._wanted[0][1].done():
            event, future = self._wanted.pop(0)
            outcome = future.result()
            if isinstance(outcome, PreparedLoop):
                self._switch(event, outcome)
            else:
                self._note = f"{words(event)}: {outcome}"

    def _run(self, ticks: int) -> None:
        end = self._tick + ticks
        while self._tick < end:
            while self._script and self._script[0][0] <= self._tick:
                _, event, prepared = self._script.pop(0)
                if prepared is None:
                    self._happen(event)
                else:
                    self._latest = prepared
                    self._switch(event, prepared)
            until = min(end, self._script[0][0]) if self._script else end
            self._advance(min(_BLOCK, until - self._tick))

    def _advance(self, count: int) -> None:
        buffer, scene = self._buffer, self.prepared.simulation.scene
        w = outside_forces(self.prepared.scenario, scene, self._tick, count)
        for column, force in zip(scene.tapped, self._pushed, strict=True):
            w[:, column] += force
        if self._grip:
            w[:, [scene.tapped[channel] for channel in self._grip.channels]] += self._grip.pull
        buffer.w[:count] = w[:, :, None]
        with np.errstate(over="ignore", invalid="ignore"):  # Overflow is checked below.
            run_block(buffer, self._engine, count)
            if self._motion:
                self._nodes = self._motion.follow(buffer.process.measured(buffer.x[:count, :, 0]))
        self._tick += count
        if not (np.isfinite(buffer.s[: count + 1]).all() and np.isfinite(buffer.z[: count + 1]).all()):
            self._happen(_Restart())
            self._note = "the loop diverged until numbers overflowed, so it restarts from rest"
            return
        f = buffer.f[:count, :, 0]
        limits = buffer.process.force_limit, buffer.process.balls
        self.clipped += int(at_limit(buffer.f[:count], *limits).any(axis=(1, 2)).sum())
        self._history = np.concatenate([self._history[count:], f])[-len(self._history) :]
        buffer.rewind(count)

    def _happen(self, event: _Event) -> None:
        if isinstance(event, _Push):
            self._pushed[event.channel - 1] = event.force
        elif isinstance(event, _Restart):
            self._enter(self.prepared, np.zeros_like(self.state))
        self._note = words(event)

    def _switch(self, event: _Event, prepared: PreparedLoop) -> None:
        # A new scene starts in its initial pose, so the devices must start at rest, too.
        self._enter(prepared, np.zeros_like(self.state) if is_world(prepared.scenario) else self.state)
        self._note = words(event)
        self.log.append((self.t, words(event), prepared))

    def _enter(self, prepared: PreparedLoop, s: Array) -> None:
        """Continue with another process from the plant state s."""
        process = prepared.simulation.process
        outside = prepared.simulation.plant.B.shape[1] - process.channels
        buffer = StepBuffer(process, _BLOCK, s.size, outside)
        buffer.s[0, :, 0] = s
        buffer.z[0, :, 0] = process.ticked.at_rest(s[: process.channels])
        self.prepared, self._buffer = prepared, buffer
        self._motion, self._nodes = None, None
        if drawn := object_of(prepared.simulation):
            self._motion = drawn.motion(prepared.coupling, prepared.scenario.psi, prepared.scenario.T)
            self._nodes = self._motion.rest(s[: process.channels])
        self._start_engine()

    @property
    def world(self) -> InWorld | None:
        """The MuJoCo scene in the loop, or None."""
        net = self._buffer.net
        return net.world if isinstance(net, Late) else None

    def _hold(self, grip: Grip | None) -> None:
        """Take, move or let go of a handle."""
        before, self._grip = self._grip, grip
        if (before and before.channel) != (grip and grip.channel):
            self._start_engine()

    def _start_engine(self) -> None:
        """Start an engine on the present buffer, for the plant with the mouse's hand if there is one."""
        simulation, held = self.prepared.simulation, self._grip
        plant = _gripped(simulation.scene, held, simulation.scenario.T) if held else simulation.plant
        self._engine = ExactEngine(plant)
        self._engine.start(self._buffer)


def _rehearsed(prepared: PreparedLoop, script: Script) -> list[tuple[int, _Event, PreparedLoop | None]]:
    """Return (tick, event, loop after the event) for each event; the loop is None if the event does not change it."""
    events = []
    for time, event in script:
        into = None
        if isinstance(event, Couple | _Delay):
            into = prepared = _changed(prepared, event)
        events.append((round(time / prepared.scenario.T), event, into))
    return events
