"""One session with a device: bytes and the time go in, bytes come out. No port, no clock, no thread.

    connecting -> configuring -> measuring -> measured -> configuring -> disarmed
                     (load: a certified coupling)     (arm: a person)  -> arming -> armed -> disarming -> finished

Every other end is a named stage with its cause in the log: refused, stopped, lost, e-stop. A session that has ended
answers nothing but repeats its STOP to a device that still drives; it never arms again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from hw.conduct import check_state
from hw.dialogue import Dialogue, Unanswered
from hw.drive import Drive, Row
from hw.ending import STOPPING_US, Ending, drives
from hw.frame import Ack, Config, Decoder, Info, Message, State, Stop, encode
from hw.handshake import Units, probe_delay
from hw.message import Command, Phase, Reason
from hw.plan import Program
from hw.safety import DRIVING, ENDED, Fault, Limits, Stage
from hw.stream import USUAL, Settings, Stream, answer
from sim.scenario import Scenario

ARMING_US = 500_000  # in which a device must follow ARM


class Event(NamedTuple):
    """One line of the log."""

    t_us: int
    stage: Stage
    cause: str


class Session:
    """The host's side of the link."""

    def __init__(self, scenario: Scenario, limits: Limits, settings: Settings = USUAL) -> None:
        if len(limits.cap) != scenario.channels:
            raise ValueError(f"cap has {len(limits.cap)} entries for {scenario.channels} channels")
        self.scenario, self.limits, self.settings = scenario, limits, settings
        self.probe = probe_delay(scenario.T)
        self.decoder = Decoder()
        self.dialogue = Dialogue(scenario, limits, settings.baud)
        self.stream = Stream(limits, settings, self.probe, scenario.T)
        self.counters, self.watch, self.measurement = self.stream.counters, self.stream.watch, self.stream.measurement
        self.stage, self.cause = Stage.CONNECTING, ""
        self.log: list[Event] = []
        self.rungs: tuple[Program, ...] = ()
        self.rung: Program | None = None
        self.armings: list[tuple[Program, Config]] = []  # what forces came from, arming by arming
        self.record: Callable[[Row], None] = lambda row: None
        self.now = self.entered = 0
        self._ending: Ending | None = None
        self._after: Stage | None = Stage.FINISHED  # what a ramp-out ends in; None: with a softer coupling, disarmed

    @property
    def gain(self) -> float:
        """The factor in front of every force; 0 unless forces act."""
        return self.drive.gain.value if self.drive else 0.0

    @property
    def drive(self) -> Drive | None:
        """The coupling at work; None unless forces act."""
        return self.stream.drive

    @property
    def info(self) -> Info | None:
        """What the device is; None before it said so."""
        return self.dialogue.info

    @property
    def config(self) -> Config | None:
        """How the device was asked to run, last."""
        return self.dialogue.config

    @property
    def units(self) -> Units:
        """The device's units, once it is known."""
        assert self.dialogue.units
        return self.dialogue.units

    # what a person or the driver does

    def start(self, now: int) -> bytes:
        """Ask the device who it is."""
        self.now = now
        self._enter(Stage.CONNECTING, "HELLO")
        return self.dialogue.hello(now)

    def load(self, rungs: Sequence[Program], now: int) -> bytes:
        """Take the couplings for the measured delay, the fastest first; the device is told its theta."""
        self.now = now
        if self.stage != Stage.MEASURED:
            return b""
        if not rungs or not all(rung.certified for rung in rungs):
            return self.refuse("the coupling is not certified", now)
        self.rungs = tuple(rungs)
        return self._take(0, "certified")

    def refuse(self, cause: str, now: int) -> bytes:
        """End the session before it has moved anything."""
        self.now = now
        return b"" if self.stage in ENDED else self._end(Stage.REFUSED, cause)

    def arm(self, now: int) -> bytes:
        """A person's wish to feel forces; does nothing unless the session is disarmed."""
        self.now = now
        if self.stage == Stage.DISARMED:
            assert self.rung
            assert self.config
            self.stream.arm(self.rung.controller(), self.units, self.config, self.record, len(self.armings))
            self.armings.append((self.rung, self.config))
            self._enter(Stage.ARMING, "asked to")
        return b""

    def stop(self, cause: str, now: int) -> bytes:
        """The planned end: by a ramp where forces act, at once where none do."""
        self.now = now
        if self.stage in ENDED:
            return b""
        if self.stage == Stage.DISARMING:
            self._after = self._after or Stage.FINISHED
            return b""
        if self.stage == Stage.ARMED or (self.stage == Stage.ARMING and self.gain > 0):
            self._ramp_out(Stage.FINISHED, cause)
            return b""
        return self._end(Stage.FINISHED, cause, Reason.DONE)

    def fail(self, cause: str, now: int) -> bytes:
        """A fault found outside of the session: zero force at once."""
        self.now = now
        return b"" if self.stage in ENDED else self._end(Stage.STOPPED, cause)

    def estop(self, cause: str, now: int) -> bytes:
        """Zero force at once, latched on both sides. Also from a session that has ended."""
        self.now = now
        if self.stage == Stage.ESTOP:
            return b""
        return self._end(Stage.ESTOP, cause, Reason.ESTOP)

    def lost(self, cause: str, now: int) -> bytes:
        """The port is gone."""
        self.now = now
        return b"" if self.stage in ENDED else self._end(Stage.LOST, cause)

    # what the link does

    def receive(self, data: bytes, now: int) -> bytes:
        """Bytes from the device; time-outs are looked at however many of them there are."""
        out = b""
        for message in self.decoder.feed(data):
            try:
                self.now = now
                out += self._understand(message)
            except Fault as fault:
                out += self.fail(str(fault), now)
            except Exception as error:  # whatever it is: first the force to zero, then the explanation
                out += self.fail(f"{type(error).__name__} in the bridge: {error}", now)
        return out + self.poll(now)

    def poll(self, now: int) -> bytes:
        """Look at the time."""
        self.now = now
        if self.stage in ENDED:
            return self._ending.again(now) if self._ending else b""
        if self.stage in (Stage.CONNECTING, Stage.CONFIGURING):
            try:
                return self.dialogue.again(now)
            except Unanswered as given_up:
                return self._end(Stage.LOST, str(given_up))
        if self.stage == Stage.ARMING and self.gain == 0 and now - self.entered > ARMING_US:
            return self._end(Stage.STOPPED, f"the device did not arm within {ARMING_US // 1000} ms")
        silence = self.stream.silence(now, self.stage in DRIVING)
        return self._end(Stage.LOST, silence) if silence and self.stage != Stage.MEASURED else b""

    def _understand(self, message: Message) -> bytes:
        match message:
            case State():
                return self._on_state(message)
            case Info() if self.stage == Stage.CONNECTING:
                return self._on_info(message)
            case Ack() if self.stage == Stage.CONFIGURING:
                return self._on_ack(message)
            case Info() | Ack():
                return b""  # the answer to a question that was asked twice
        self.counters.unexpected += 1
        return b""

    def _on_info(self, info: Info) -> bytes:
        try:
            self.dialogue.meet(info)
        except Fault as fault:
            return self._end(Stage.REFUSED, str(fault))
        name = "".join(c if c.isprintable() else "?" for c in info.firmware) or "device"
        return self._configure(self.probe, f"{name} {info.serial}, to be measured")

    def _configure(self, theta: int, cause: str) -> bytes:
        self._enter(Stage.CONFIGURING, cause)
        return self.dialogue.configure(theta, self.now)

    def _on_ack(self, ack: Ack) -> bytes:
        if not self.dialogue.concerns(ack):
            self.counters.unexpected += 1
            return b""
        try:
            if not self.dialogue.agreed(ack):
                return b""
        except Fault as fault:
            return self._end(Stage.REFUSED, str(fault))
        assert self.config
        self.stream.restart(self.now)
        self._enter(Stage.DISARMED if self.rung else Stage.MEASURING, f"theta = {self.config.theta}")
        return b""

    def _take(self, index: int, cause: str) -> bytes:
        self.rung = self.rungs[index]
        return self._configure(self.rung.link, f"{self.rung.name}: {cause}")

    # the stream

    def _on_state(self, state: State) -> bytes:
        if self.stage == Stage.CONNECTING:  # another session's device: to zero force first
            return encode(Stop(Reason.FAULT)) if drives(state) else b""
        if self.info is None or state.axes != self.info.axes:
            self.counters.unexpected += 1
            return b""
        if self.stage in ENDED:
            return self._on_state_after_the_end(state)
        if self.stage == Stage.CONFIGURING:
            if not drives(state):
                return b""
            if self.now - self.entered > STOPPING_US:
                raise Fault("the device drives, and nobody asked it to")
            return encode(Stop(Reason.DONE))
        ticks = self.stream.news(state, self.now)
        if not ticks:
            return b""
        if state.phase == Phase.ESTOP:
            return self.estop(f"pressed, {state.cause.name.lower()}", self.now)
        assert self.config is not None
        check_state(state, self.config, self.stage, self.gain)
        if self.stage in DRIVING:
            return self._on_driving(state, ticks)
        if self.stage == Stage.MEASURING:
            return self._measure(state)
        return answer(self.config, state, Command.IDLE)

    def _on_state_after_the_end(self, state: State) -> bytes:
        assert self._ending
        if cause := self._ending.disobeyed(state, self.now):
            if self.stage == Stage.FINISHED:
                self._enter(Stage.STOPPED, cause)  # whatever it was to end in, it has not finished
            else:
                self._log(cause)
        return self._ending.heard(state)

    def _on_driving(self, state: State, ticks: int) -> bytes:
        assert self.config
        ready = state.phase != Phase.DISARMED
        direction = (-1 if self.stage == Stage.DISARMING else 1) if ready else 0
        steps = self.stream.step(state, ticks, direction, self.now)
        if self.stage != Stage.DISARMING and (late := self.stream.too_late()):
            self._soften(late)
        if self.stage == Stage.ARMING and self.gain == 1.0:
            self._enter(Stage.ARMED, "full gain")
        if self.stage == Stage.DISARMING and self.gain == 0.0:
            return self._ramped_out()
        return answer(self.config, state, Command.RUN if ready else Command.ARM, steps)

    def _measure(self, state: State) -> bytes:
        assert self.config
        try:
            if not self.stream.measured(state):
                return answer(self.config, state, Command.IDLE)
        except Fault as fault:
            return self._end(Stage.REFUSED, str(fault))
        ages = self.measurement.result
        self._enter(Stage.MEASURED, f"{len(ages.values)} answers, median age {ages.median} us")
        return b""

    def _soften(self, late: str) -> None:
        """To zero force by a ramp, and to the next coupling where there is one."""
        assert self.rung is not None
        softer = self.rungs.index(self.rung) + 1 < len(self.rungs)
        self._ramp_out(None if softer else Stage.STOPPED, late + ("" if softer else ", and nothing softer is left"))

    def _ramp_out(self, after: Stage | None, cause: str) -> None:
        self._after = after
        self._enter(Stage.DISARMING, cause)

    def _ramped_out(self) -> bytes:
        if self._after:
            return self._end(self._after, self.cause, Reason.DONE)
        assert self.rung is not None
        return encode(Stop(Reason.DONE)) + self._take(self.rungs.index(self.rung) + 1, f"softer, since {self.cause}")

    # stages

    def _enter(self, stage: Stage, cause: str) -> None:
        self.stage, self.cause, self.entered = stage, cause, self.now
        self._log(cause)

    def _log(self, cause: str) -> None:
        self.log.append(Event(self.now, self.stage, cause))

    def _end(self, stage: Stage, cause: str, reason: Reason = Reason.FAULT) -> bytes:
        self.stream.drive = None
        self._ending = Ending(reason, bool(self.armings), self.now, self.scenario.T)
        self._enter(stage, cause)
        return encode(Stop(reason))
