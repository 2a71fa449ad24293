"""One session with a device: bytes and the time go in, bytes come out. No port, no clock, no thread.

    connecting -> configuring -> measuring -> measured -> configuring -> disarmed
                     (load: a certified coupling)     (arm: a person)  -> arming -> armed -> disarming -> finished

Every other end is a named stage with its cause in the log: refused, stopped, lost, e-stop. A session that has ended
answers nothing but repeats its STOP to a device that still drives; it never arms again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hw.conduct import check_state
from hw.drive import Drive, Row
from hw.frame import Ack, Config, Decoder, Force, Hello, Info, Message, State, Stop, config_crc, encode
from hw.handshake import Units, configuration, objections, probe_delay
from hw.measurement import Measurement
from hw.message import Command, Phase, Reason, Refused
from hw.plan import Program
from hw.safety import DRIVING, ENDED, Fault, Limits, Stage
from hw.watch import FRESH, Counters, LinkWatch
from sim.scenario import Scenario

RESEND_US, PATIENCE_US = 100_000, 2_000_000  # a question is asked again, and then given up
QUIET_US = 1_000_000  # longest silence of a device that has no force to take away
ARMING_US = 500_000  # in which a device must follow ARM


@dataclass(frozen=True)
class Settings:
    """How a session judges its link."""

    baud: int | None = None  # of a UART; None for a link without one (USB, pseudo-terminal)
    measure: int = 800  # answers whose age is measured
    window: int = 200  # ticks over which misses are judged
    late: float = 0.1  # part of late answers above which the coupling is too fast for the link
    missed: float = 0.2  # part of missing answers above which nothing is certified: mean-square stability ends there


class Event(NamedTuple):
    """One line of the log."""

    t_us: int
    stage: Stage
    cause: str


class Session:
    """The host's side of the link."""

    def __init__(self, scenario: Scenario, limits: Limits, settings: Settings = Settings()) -> None:
        if len(limits.cap) != scenario.channels:
            raise ValueError(f"cap has {len(limits.cap)} entries for {scenario.channels} channels")
        self.scenario, self.limits, self.settings = scenario, limits, settings
        self.probe = probe_delay(scenario.T)
        self.decoder = Decoder()
        self.counters = Counters()
        self.watch = LinkWatch(settings.window, self.counters)
        self.stage, self.cause = Stage.CONNECTING, ""
        self.log: list[Event] = []
        self.measurement = Measurement(settings.measure, self.probe, scenario.T, settings.missed)
        self.rungs: tuple[Program, ...] = ()
        self.rung: Program | None = None
        self.armings: list[tuple[Program, Config]] = []  # what forces came from, arming by arming
        self.info: Info | None = None
        self.config: Config | None = None
        self.record: Callable[[Row], None] = lambda row: None
        self.now = self.asked_at = self.entered = self.heard = 0
        self.drive: Drive | None = None
        self.missed_while_driving = 0
        self._reason = Reason.DONE
        self._after: Stage | None = Stage.FINISHED  # what a ramp-out ends in; None: with a softer coupling, disarmed

    @property
    def gain(self) -> float:
        """The factor in front of every force; 0 unless forces act."""
        return self.drive.gain.value if self.drive else 0.0

    # what a person or the driver does

    def start(self, now: int) -> bytes:
        """Ask the device who it is."""
        self.now = self.asked_at = self.entered = now
        self._log("HELLO")
        return encode(Hello())

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
            law = self.rung.controller()
            record, arming = self.record, len(self.armings)
            self.drive = Drive(law, self.units, self.config, self.limits, self.counters, record, arming)
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
            return b""
        if self.stage in (Stage.CONNECTING, Stage.CONFIGURING):
            return self._ask_again()
        if self.stage == Stage.ARMING and self.gain == 0 and now - self.entered > ARMING_US:
            return self._end(Stage.STOPPED, f"the device did not arm within {ARMING_US // 1000} ms")
        silence, allowed = now - self.heard, self.limits.watchdog_us if self.stage in DRIVING else QUIET_US
        if silence > allowed and self.stage != Stage.MEASURED:
            return self._end(Stage.LOST, f"no new STATE for {silence / 1000:.1f} ms")
        return b""

    def _ask_again(self) -> bytes:
        waited = self.now - self.entered
        if waited > PATIENCE_US:
            what = "HELLO" if self.stage == Stage.CONNECTING else "CONFIG"
            return self._end(Stage.LOST, f"no answer to {what} within {waited / 1e6:.1f} s")
        if self.now - self.asked_at < RESEND_US:
            return b""
        self.asked_at = self.now
        return encode(self.config if self.stage == Stage.CONFIGURING and self.config else Hello())

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
        reasons = objections(info, self.scenario, self.limits, self.settings.baud)
        if reasons:
            return self._end(Stage.REFUSED, "; ".join(reasons))
        self.info, self.units = info, Units.of(info)
        return self._configure(self.probe, f"{info.firmware or 'device'} {info.serial}, to be measured")

    def _configure(self, theta: int, cause: str) -> bytes:
        assert self.info is not None
        self.config = configuration(self.info, self.limits, theta)
        self.asked_at = self.now
        self._enter(Stage.CONFIGURING, cause)
        return encode(self.config)

    def _on_ack(self, ack: Ack) -> bytes:
        assert self.config is not None
        if ack.crc != config_crc(self.config):
            self.counters.unexpected += 1
            return b""
        if ack.refused == Refused.RUNNING:
            return b""  # it is still on its way to zero force, and will be asked again
        if ack.refused:
            known = [r.name.lower() for r in Refused if r == ack.refused]
            return self._end(Stage.REFUSED, f"the device refuses the configuration: {(known or [ack.refused])[0]}")
        self.watch.restart()
        self.heard = self.now
        self._enter(Stage.DISARMED if self.rung else Stage.MEASURING, f"theta = {self.config.theta}")
        return b""

    def _take(self, index: int, cause: str) -> bytes:
        self.rung = self.rungs[index]
        return self._configure(self.rung.link, f"{self.rung.name}: {cause}")

    # the stream

    def _on_state(self, state: State) -> bytes:
        if self.info is None or state.axes != self.info.axes:
            self.counters.unexpected += 1
            return b""
        if self.stage in ENDED:
            drives = state.phase in (Phase.ARMED, Phase.HOLDING)
            return encode(Stop(self._reason)) if drives else b""
        if self.stage in (Stage.CONNECTING, Stage.CONFIGURING):
            return b""
        verdict, ticks = self.watch.order(state)
        if verdict != FRESH:
            return b""
        self.heard = self.now
        self.watch.note(state)
        if state.phase == Phase.ESTOP:
            return self.estop(f"pressed, {state.cause.name.lower()}", self.now)
        assert self.config is not None
        check_state(state, self.config, self.stage, self.gain)
        if self.stage in DRIVING:
            return self._on_driving(state, ticks)
        if self.stage == Stage.MEASURING:
            return self._measure(state)
        return self._answer(state, Command.IDLE)

    def _on_driving(self, state: State, ticks: int) -> bytes:
        assert self.drive is not None
        self.missed_while_driving += self.watch.missed[-1]
        ready = state.phase != Phase.DISARMED
        direction = (-1 if self.stage == Stage.DISARMING else 1) if ready else 0
        steps = self.drive.step(state, ticks, direction, self.now)
        if self.stage != Stage.DISARMING:
            self._judge()
        if self.stage == Stage.ARMING and self.gain == 1.0:
            self._enter(Stage.ARMED, "full gain")
        if self.stage == Stage.DISARMING and self.gain == 0.0:
            return self._ramped_out()
        return self._answer(state, Command.RUN if ready else Command.ARM, steps)

    def _measure(self, state: State) -> bytes:
        try:
            done = self.measurement.note(state, self.watch.margins[-1], self.watch.missed[-1])
        except Fault as fault:
            return self._end(Stage.REFUSED, str(fault))
        if not done:
            return self._answer(state, Command.IDLE)
        ages = self.measurement.result
        self._enter(Stage.MEASURED, f"{len(ages.values)} answers, median age {ages.median} us")
        return b""

    def _answer(self, state: State, command: Command, steps: tuple[int, ...] | None = None) -> bytes:
        assert self.config is not None
        apply_at = (state.tick + self.config.theta) & 0xFFFF
        return encode(Force(command, apply_at, state.tick, steps or (0,) * state.axes))

    def _judge(self) -> None:
        """Whether the link still is what the coupling was certified for."""
        assert self.rung is not None
        late, missed = self.watch.late_part, self.watch.missed_part
        if missed > self.settings.missed + late:
            raise Fault(f"{100 * missed:.0f} % of the last {self.settings.window} ticks had no answer in time")
        if late > self.settings.late:
            word = f"{100 * late:.0f} % of the last {self.settings.window} answers were late"
            softer = self.rungs.index(self.rung) + 1 < len(self.rungs)
            self._ramp_out(None if softer else Stage.STOPPED, word + ("" if softer else ", and nothing softer is left"))

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
        self._reason, self.drive = reason, None
        self._enter(stage, cause)
        return encode(Stop(reason))
