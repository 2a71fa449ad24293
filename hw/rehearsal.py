"""A whole session in virtual time: the bridge's session and the emulated device, with a serial line between them.

Nothing waits and nothing is random but by seed, so a session of seconds runs in a fraction of one and always the same.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import NamedTuple

import numpy as np

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.lti import Array
from haptic_loop.design.api import COUPLING, bare
from haptic_loop.design.arguments import number, of_kind, whole
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.result import Design
from haptic_loop.hw.control import Armable, CertifiedCoupling, certified_coupling, certified_couplings, timed
from haptic_loop.hw.driver import Driver, Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection, Line
from haptic_loop.hw.haptic_device import PortLost, SerialDevice
from haptic_loop.hw.limits import ENDED, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import Phase
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import Said, Session, session_for
from haptic_loop.sim.scenario import InputError, Scenario, require_constant_delay, require_even_ticks, require_linear
from haptic_loop.sim.trace import Trace

_MEASURE = 200  # answers that are timed: virtual time does not scatter
_QUANTILE, _GUARD_US = 0.99, 100.0  # of the ages that the delay covers, and what is added [us]; as hw.bridge has it
_BEGIN_US = 500  # after the device's first tick
_GRACE_US = 20_000  # after the end
_LATENCY_US = 60  # one way, and as long for the host to answer: the measured median age of 130 us

Plan = Callable[[Ages], Sequence[Armable]]


class _Moment(NamedTuple):
    """One tick of the device."""

    t_us: int
    phase: Phase
    applied: Array  # (m,) [N]


@dataclass
class Rehearsal:
    """A session and its emulated device in virtual time: the session's port leads to the emulator.

    `actions` are what a person does: (seconds after arming, call).
    """

    session: Session
    emulator: Emulator
    plan: Plan
    faults: tuple[FaultInjection, ...] = ()
    seed: int = 0
    actions: Sequence[tuple[float, Callable[[Session, int], Said]]] = ()
    host_stalls: Sequence[tuple[float, float]] = ()  # (seconds after arming, seconds) in which the host is frozen
    arm: bool = True  # once; a softer coupling waits for a person
    operator: Operator | None = None  # in place of `arm`: the rule of a live session
    latency_us: float = _LATENCY_US
    clock: float = 1.0  # how long a tick of the device lasts, in T
    keep: bool = True  # every tick of the device in `moments`
    watch: Callable[[Session], None] = lambda session: None  # called at every turn
    moments: list[_Moment] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._up = Line("up", self.faults, self.seed, self.latency_us)
        self._down = Line("down", self.faults, self.seed, self.latency_us)
        self._queue: list[tuple[float, int, Callable[[], object]]] = []
        self._number = count()
        self._done: set[int] = set()
        self._now, self._read, self._gone = 0.0, b"", False  # [us]; what has come in
        self._ended = 0.0
        self._period = 1e6 * self.session.scenario.T * self.clock
        device = SerialDevice(self, lambda: 1e-6 * self._now)
        self._driver = Driver(self.session, device, self.plan, lambda: round(self._now))
        self._at(0, self._tick)

    def run(self, seconds: float) -> Session:
        """Until `seconds` of virtual time are over. Returns the session."""
        while self._now <= 1e6 * seconds:
            self._turn()
        return self.session

    def run_until_armed(self, seconds: float) -> Session:
        """Until `seconds` after arming, or a little longer than a session that is never armed."""
        while self.armed_us is None and not self._over:
            self._turn()
        return self.run(1e-6 * self.armed_us + seconds) if self.armed_us is not None else self.session

    def run_to_the_end(self, most: float) -> Session:
        """Until the session has ended and its device has come to rest, or for `most` seconds of virtual time."""
        while not self._over and self._now <= 1e6 * most:
            self._turn()
        return self.session

    @property
    def _over(self) -> bool:
        return self.session.stage in ENDED and self._now > self._ended + _GRACE_US

    def _turn(self) -> None:
        """One call of the device, then what a person does."""
        if not self.session.log:
            self._pass(_BEGIN_US)
            self.session.start(round(self._now))
        if self.session.stage == Stage.LOST and self._gone:
            self._pass(1000)
        else:
            self._driver.turn()
        session, now = self.session, round(self._now)
        since = self.emulator.since_armed(now)
        for i, (when, call) in enumerate(self.actions):
            if since is not None and since >= when and i not in self._done:
                self._done.add(i)
                self._driver.do(call(session, now))
        if self.operator:
            self._driver.do(self.operator.decide(session, now))
        elif session.stage == Stage.DISARMED and self.arm and session.program is session.programs[0]:
            self._driver.do(session.arm(now))
        self.watch(session)
        if session.stage not in ENDED:
            self._ended = self._now

    # the host's end of the line

    def wait(self, seconds: float) -> bool:
        """Time goes on until something has come in, or so many seconds are over, and as long as the host is frozen."""
        until = self._now + 1e6 * seconds
        while not self._read and not self._gone and self._queue[0][0] <= until:
            self._next()
        if not self._read and not self._gone:
            self._now = until
        if (frozen := self._frozen_for()) > 0:
            self._pass(frozen)
        return bool(self._read) or self._gone

    def read(self) -> bytes:
        """What has come in. Raises PortLost where the cable was pulled."""
        if self._gone:
            raise PortLost("the port is gone")
        data, self._read = self._read, b""
        return data

    def write(self, data: bytes) -> int:
        """Frames to the device, one by one: the line may lose them."""
        since = self.emulator.since_armed(round(self._now))
        for frame in filter(None, data.split(b"\0")):
            for when, part in self._down.send(frame + b"\0", self._now + self.latency_us / 6, since):
                self._at(when, partial(self._deliver, part))
        return len(data)

    def discard(self) -> None:
        self._read = b""

    def _frozen_for(self) -> float:
        """[us] for which the host does nothing."""
        since = self.emulator.since_armed(round(self._now))
        if since is None:
            return 0.0
        left = [start + lasts - since for start, lasts in self.host_stalls if start <= since < start + lasts]
        return 1e6 * max(left) + 1 if left else 0.0

    # what happens in time

    def _at(self, when: float, what: Callable[[], object]) -> None:
        heapq.heappush(self._queue, (when, next(self._number), what))

    def _pass(self, us: float) -> None:
        until = self._now + us
        while self._queue[0][0] <= until:
            self._next()
        self._now = until

    def _next(self) -> None:
        self._now, _, what = heapq.heappop(self._queue)
        what()

    def _tick(self) -> None:
        emulator, now, clock = self.emulator, self._now, round(self._now)
        if clock < emulator.stalled_until:  # late once, and then in step again: no catching up
            return self._at(emulator.stalled_until, self._tick)
        data = emulator.tick(clock)
        emulator.advance()
        if self.keep:
            self.moments.append(_Moment(clock, emulator.device.phase, emulator.applied))
        self._at(now + self._period * emulator.stretch, self._tick)
        if emulator.unplugged and not self._gone:
            self._at(now + self.latency_us, self._unplug)
        for when, part in self._up.send(data, now, emulator.since_armed(clock)) if data else []:
            self._at(when, partial(self._hear, part))
        return None

    def _hear(self, data: bytes) -> None:
        self._read += data

    def _unplug(self) -> None:
        self._gone = True

    def _deliver(self, data: bytes) -> None:
        self.emulator.receive(data, round(self._now))

    # what came of it

    @property
    def armed_us(self) -> int | None:
        return self.emulator.armed_at

    def zero_after(self, seconds: float) -> float | None:
        """Seconds from `seconds` after arming to the tick from which on no motor does anything; None: never."""
        assert self.armed_us is not None
        begin = self.armed_us + 1e6 * seconds
        driving = [m.t_us for m in self.moments if np.any(m.applied)]
        last = max(driving, default=0)
        if last < begin:
            return 0.0
        quiet = next((m.t_us for m in self.moments if m.t_us > last), None)
        return None if quiet is None else 1e-6 * (quiet - begin)


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """The result of a session.

    Attributes:
        stage: "finished" where all went well, otherwise "refused", "stopped", "lost" or "e-stop".
        cause: Why the session ended.
        delay: The median time from a sample to its force [s]; None where it was not measured.
        theta: (m,) delays for which the coupling is certified [samples]; None where there is none.
        latency: Least and most time by which forces latch after their tick [s]; None where they latch at ticks.
        coupling: The coupling with which the device was armed, or would have been.
        assessment: The assessment of that coupling in the loop with the measured delay.
        result: A Trace with t, x and f of every tick; handles are not measured.
        zero_after: The time from the wish to stop until no motor does anything [s]; None where it never ran.
    """

    stage: str
    cause: str
    delay: float | None
    theta: tuple[int, ...] | None
    latency: tuple[float, float] | None
    coupling: Coupling | None
    assessment: Assessment | None
    result: Trace | None
    zero_after: float | None

    def __repr__(self) -> str:
        delay = "" if self.delay is None else f", delay {1e6 * self.delay:.0f} us"
        return f"Rehearsed({self.stage}: {self.cause}{delay}, {self.coupling!r})"


def rehearse(
    scenario: Scenario,
    coupling: Coupling | Design | None = None,
    case: str = "I",
    seconds: float = 2.0,
    seed: int = 0,
    latch_on_arrival: bool = False,
) -> Rehearsed:
    """A session with the scenario's devices behind the real protocol, without a device, a port or waiting.

    Handshake, delay measured, coupling designed for it (or `coupling`, judged for it), certified, armed, run for
    `seconds`, ramped out. The scenario's theta is the least delay; a slower link makes it longer. With
    `latch_on_arrival` the device applies a force as soon as it comes, and the loop has the measured latency in place of
    a whole tick (`latency`), beside the scenario's theta, which may then be 0. A session that is
    refused, because nothing is certified for its delay, is a result too: see `stage` and `cause`.

    Raises InputError for a scenario that cannot stand behind a serial link, TypeError for an argument of another type.
    """
    of_kind("scenario", scenario, Scenario, 'a Scenario, as load("omega-pair") gives it')
    if coupling is not None:
        bare(coupling, f"{COUPLING}, or None to have one designed")
    if case not in ("I", "II"):
        raise InputError(f"case is {case!r}, allowed are I, II")
    seconds, seed = number("seconds", seconds, "a number of seconds"), whole("seed", seed, 0)
    if not 0.1 <= seconds <= 3600:
        raise InputError(f"seconds is {seconds:g}, allowed are 0.1 to 3600")
    require_linear(scenario, "rehearse", walls=True)
    require_constant_delay(scenario, "rehearse")
    require_even_ticks(scenario, "rehearse")
    if min(scenario.delta) <= 0:
        raise InputError(
            f"delta is {list(scenario.delta)}: a device without damping can guarantee nothing to any human"
        )
    session = session_for(scenario, LinkSettings(measure=_MEASURE))
    session.record = recorder = Recorder(scenario.channels)
    programs: list[CertifiedCoupling] = []
    delays: list[float] = []  # [s]

    def plan(ages: Ages) -> list[CertifiedCoupling]:
        delays.append(1e-6 * ages.median)
        met, link = timed(scenario, ages, _QUANTILE, _GUARD_US, latch_on_arrival)
        if coupling is None:
            programs.extend(certified_couplings(met, case, None, None, link))
        else:
            programs.append(certified_coupling(met, case, None, None, link, coupling))
        return programs

    stopped: list[float] = []  # [s] after arming

    def stop(session: Session, now: int) -> Said:
        stopped.append(seconds)
        return session.stop("asked to", now)

    try:
        emulator = Emulator(scenario)
    except ValueError as error:
        raise InputError(f"the scenario cannot stand behind a serial link: {error}") from None
    rehearsal = Rehearsal(session, emulator, plan, seed=seed, actions=[(seconds, stop)])
    rehearsal.run_until_armed(seconds + 0.5)
    return _outcome(rehearsal, recorder, programs, delays, stopped)


def _outcome(
    rehearsal: Rehearsal,
    recorder: Recorder,
    programs: list[CertifiedCoupling],
    delays: list[float],
    stopped: list[float],
) -> Rehearsed:
    session, first = rehearsal.session, programs[0] if programs else None
    scenario, ran = session.scenario, rehearsal.armed_us is not None
    meta = {"scenario": scenario.name, "scenario_digest": scenario.digest, "stage": str(session.stage)}
    return Rehearsed(
        stage=str(session.stage),
        cause=session.cause,
        delay=delays[0] if delays else None,
        theta=first and first.scenario.theta,
        latency=first.scenario.latency[0] if first and first.scenario.latency else None,
        coupling=first and first.chosen.coupling,
        assessment=first and first.assessment,
        result=recorder.trace(session.units, scenario.T, meta) if ran and len(recorder) else None,
        zero_after=rehearsal.zero_after(stopped[0]) if stopped and ran else None,
    )
