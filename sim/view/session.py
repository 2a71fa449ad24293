"""The running loop behind the window: a clock, keys and pushes go in, frames come out. It knows no display.

When the coupling or a delay is changed while the loop runs, the plant goes on from where it is, position and velocity.
The new process begins at rest with the devices held where they are, z = A z + B x: its delay lines hold the
force F(1) x, and nothing starts with a step in x. The force changes to what the new coupling makes of that
position; what the environment's masses had of motion is lost.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from dataclasses import dataclass
from queue import Empty, SimpleQueue

import numpy as np

from controller.lti import Array, Lti
from controller.process import Tape
from sim.engines import ExactEngine, outside_forces
from sim.run import stretch
from sim.view.events import Couple, Delay, Event, Push, Restart, Script, words
from sim.view.grip import Grip, gripped
from sim.view.pace import LONGEST_LAG, Pace
from sim.view.setting import Setting, attempt, changed

HISTORY = 4.0  # [s] of forces that are kept for the picture
STRETCH = 64  # ticks between two looks at what is due


@dataclass(frozen=True, eq=False)
class Frame:
    """What there is to see and to say at one moment."""

    t: float  # [s] simulated
    q: Array  # (n,) positions of all joints [m], motors first
    mean: Array  # (m,) force fed back [N], over the ticks since the last frame
    low: Array  # (m,) its least value since then
    high: Array  # (m,) its largest
    push: Array  # (m,) force of the mouse or the script on each handle [N]
    history: Array  # (ticks, m) force fed back over the last HISTORY seconds [N]
    clipped: int  # ticks with a force at its limit, in `history`
    setting: Setting
    note: str  # what was last asked for and came or did not
    overruns: int
    lost: float  # [s]
    factor: float  # simulated over real time


class Session:
    """The closed loop, advanced to wherever the clock is."""

    def __init__(
        self, setting: Setting, executor: Executor, script: Script = (), patience: float = LONGEST_LAG
    ) -> None:
        """`executor` makes what keys ask for, while the loop goes on; a script's loops are made here, beforehand.

        The clock begins at 0; what it runs ahead by more than `patience` [s] is not made up.

        Raises what sim.view.setting.changed raises where an event of the script is impossible.
        """
        self.setting = setting
        self.pace = Pace(setting.scenario.T, patience)
        self.keys: SimpleQueue[Event] = SimpleQueue()
        self.clipped = 0  # ticks, since the start
        self.log: list[tuple[float, str, Setting]] = [(0.0, "start", setting)]  # time [s], what was asked for, the loop
        self.script_ends = script[-1][0] if script else 0.0  # [s]
        self._executor, self._latest = executor, setting
        self._wanted: list[tuple[Event, Future[Setting | str]]] = []
        self._script = _rehearsed(setting, script)
        self._tick = 0
        self._pushed = np.zeros(setting.scenario.channels)  # by the script
        self._history = np.zeros((max(1, round(HISTORY / setting.scenario.T)), setting.scenario.channels))
        self._grip: Grip | None = None
        self._note = ""
        self._enter(setting, np.zeros(setting.assembly.plant.A.shape[0]))

    @property
    def t(self) -> float:
        """Simulated time [s]."""
        return self._tick * self.pace.T

    @property
    def state(self) -> Array:
        """Positions, then velocities."""
        return self._tape.s[0, :, 0].copy()

    def frame(self, now: float, grip: Grip | None = None) -> Frame:
        """Take what has been asked for, then advance to `now` [s] with the mouse's hand where it is."""
        self._take_keys()
        self._take_finished()
        self._hold(grip)
        first = self._tick
        self._run(self.pace.due(now))
        push = self._pushed.copy()
        if grip:
            push[grip.channel] += grip.force(self.setting.assembly.scene, self.state)
        made = self._history[-min(self._tick - first, len(self._history)) :] if self._tick > first else None
        recent = self._history[-1:] if made is None else made
        shown = self._history[-max(1, min(self._tick, len(self._history))) :]
        n, limit = self.setting.assembly.scene.model.nq, self.setting.assembly.process.force_limit
        return Frame(
            t=self.t,
            q=self.state[:n],
            mean=recent.mean(axis=0),
            low=recent.min(axis=0),
            high=recent.max(axis=0),
            push=push,
            history=shown.copy(),
            clipped=int((np.abs(shown) >= limit).any(axis=1).sum()),
            setting=self.setting,
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
            if isinstance(event, Couple | Delay):
                self._note = f"{words(event)}: being made"
                self._wanted.append((event, self._executor.submit(self._make, event)))
            else:
                self._happen(event)

    def _make(self, event: Couple | Delay) -> Setting | str:
        """Runs in the executor, one after the other: each event changes what the one before has made."""
        outcome = attempt(self._latest, event)
        if isinstance(outcome, Setting):
            self._latest = outcome
        return outcome

    def _take_finished(self) -> None:
        while self._wanted and self._wanted[0][1].done():
            event, future = self._wanted.pop(0)
            outcome = future.result()
            if isinstance(outcome, Setting):
                self._switch(event, outcome)
            else:
                self._note = f"{words(event)}: {outcome}"

    def _run(self, ticks: int) -> None:
        end = self._tick + ticks
        while self._tick < end:
            while self._script and self._script[0][0] <= self._tick:
                _, event, setting = self._script.pop(0)
                if setting is None:
                    self._happen(event)
                else:
                    self._latest = setting
                    self._switch(event, setting)
            until = min(end, self._script[0][0]) if self._script else end
            self._advance(min(STRETCH, until - self._tick))

    def _advance(self, count: int) -> None:
        tape, scene = self._tape, self.setting.assembly.scene
        w = outside_forces(self.setting.scenario, scene, self._tick, count)
        for column, force in zip(scene.tapped, self._pushed, strict=True):
            w[:, column] += force
        if self._grip:
            w[:, scene.tapped[self._grip.channel]] += self._grip.pull
        tape.w[:count] = w[:, :, None]
        with np.errstate(over="ignore", invalid="ignore"):  # a process that runs away is noticed below
            stretch(tape, self._engine, count)
        self._tick += count
        if not (np.isfinite(tape.s[: count + 1]).all() and np.isfinite(tape.z[: count + 1]).all()):
            self._happen(Restart())
            self._note = "the process itself ran away, beyond all numbers: restarted from rest"
            return
        tape.saturate(count)
        f = tape.f[:count, :, 0]
        self.clipped += int((np.abs(f) >= tape.process.force_limit).any(axis=1).sum())
        self._history = np.concatenate([self._history[count:], f])[-len(self._history) :]
        tape.rewind(count)

    def _happen(self, event: Event) -> None:
        if isinstance(event, Push):
            self._pushed[event.channel - 1] = event.force
        elif isinstance(event, Restart):
            self._enter(self.setting, np.zeros_like(self.state))
        self._note = words(event)

    def _switch(self, event: Event, setting: Setting) -> None:
        self._enter(setting, self.state)
        self._note = words(event)
        self.log.append((self.t, words(event), setting))

    def _enter(self, setting: Setting, s: Array) -> None:
        """Go on with another process from the plant state s."""
        process = setting.assembly.process
        outside = setting.assembly.plant.B.shape[1] - process.channels
        tape = Tape(process, STRETCH, s.size, outside)
        tape.s[0, :, 0] = s
        tape.z[0, :, 0] = rest(process.F, s[: process.channels])
        self.setting, self._tape = setting, tape
        self._start_engine()

    def _hold(self, grip: Grip | None) -> None:
        """Take, move or let go of a handle."""
        before, self._grip = self._grip, grip
        if (before and before.channel) != (grip and grip.channel):
            self._start_engine()

    def _start_engine(self) -> None:
        """The plant, with the mouse's hand where there is one, on the present tape."""
        assembly, held = self.setting.assembly, self._grip
        plant = gripped(assembly.scene, held.channel, assembly.scenario.T) if held else assembly.plant
        self._engine = ExactEngine(plant, assembly.process.force_limit)
        self._engine.start(self._tape)


def rest(F: Lti, x: Array) -> Array:
    """The state z = A z + B x in which F rests with the displacements x held.

    Where F drifts (an environment with a free mass, whose place no x decides), the shortest such z.
    """
    return np.asarray(np.linalg.lstsq(np.eye(F.order) - F.A, F.B @ x, rcond=None)[0], dtype=np.float64)


def _rehearsed(setting: Setting, script: Script) -> list[tuple[int, Event, Setting | None]]:
    """The script with the tick of each event and the loop that it leads to."""
    made = []
    for time, event in script:
        into = None
        if isinstance(event, Couple | Delay):
            into = setting = changed(setting, event)
        made.append((round(time / setting.scenario.T), event, into))
    return made
