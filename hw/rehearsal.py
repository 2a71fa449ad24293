"""Run a whole session in virtual time: the bridge's session and emulated devices, with serial lines between them.

Nothing waits in real time, and all random numbers have a seed. A session of some seconds takes less than one second
in addition to the design of its couplings, and repeats exactly.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import NamedTuple

from haptic_loop.controller.arguments import number, of_kind, whole
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.lti import Array
from haptic_loop.design.api import COUPLING, bare
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.result import Design
from haptic_loop.hw.boards import Boards
from haptic_loop.hw.control import (
    Armable,
    CertifiedCoupling,
    CouplingRequest,
    certified_coupling,
    certified_couplings,
    timed,
)
from haptic_loop.hw.driver import Driver, Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection, Line
from haptic_loop.hw.haptic_device import HapticDevice, PortLost, SerialDevice
from haptic_loop.hw.limits import ENDED, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import Phase
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import Said, Session, session_for
from haptic_loop.hw.session_report import outcome
from haptic_loop.sim.scenario import InputError, Scenario, require_constant_delay, require_even_ticks, require_linear
from haptic_loop.sim.trace import Trace

_MEASURE = 200  # number of answers that are timed; it is low, because latencies are constant in virtual time
#: The delay is chosen as in hw.bridge: it covers this share of the ages of measured answers, plus a guard [us].
_QUANTILE, _GUARD_US = 0.99, 100.0
_BEGIN = 5e-4  # [s] time from the device's first tick to the start of the session
_GRACE_US = 50_000  # [us] time after the end of a session: a device must rest 30 ms after STOP (hw.session)
_LONGEST = 60.0  # [s] longest virtual time of a session in addition to its run, to connect, arm and end
_LATENCY_US = 60  # latency of one direction, which gives answers a median age of about 130 us

Plan = Callable[[Ages], Sequence[Armable]]


class _Moment(NamedTuple):
    """One tick of a device."""

    t_us: int
    phase: Phase
    applied: Array  # (m,) [N]


@dataclass
class _Cable:
    """The host's end of the line to one emulated device. Virtual time advances while the host waits."""

    rehearsal: Rehearsal
    emulator: Emulator
    up: Line
    down: Line
    period: float  # [us]
    data: bytes = b""  # bytes that have come
    gone: bool = False

    def wait(self, seconds: float) -> bool:
        """Advance time as `Rehearsal.wait` does, and return whether bytes have come or the cable was pulled."""
        return self.rehearsal.wait(seconds, (self,))

    def read(self) -> bytes:
        """Return the bytes that have come. Raises PortLost if the cable was pulled."""
        if self.gone:
            raise PortLost("the port is gone")
        data, self.data = self.data, b""
        return data

    def write(self, data: bytes) -> int:
        """Send frames to the device one by one, because the line may lose any of them."""
        rehearsal, now = self.rehearsal, self.rehearsal.now
        since = self.emulator.since_armed(round(now))
        for frame in filter(None, data.split(b"\0")):
            for when, part in self.down.send(frame + b"\0", now + rehearsal.latency_us / 6, since):
                rehearsal.at(when, lambda part=part: self.emulator.receive(part, round(rehearsal.now)))
        return len(data)

    def discard(self) -> None:
        self.data = b""

    def tick(self) -> None:
        """Advance the device by a tick."""
        rehearsal, emulator = self.rehearsal, self.emulator
        now, clock = rehearsal.now, round(rehearsal.now)
        if clock < emulator.stalled_until:  # the ticks of a stall are skipped
            return rehearsal.at(emulator.stalled_until, self.tick)
        data = emulator.tick(clock)
        emulator.advance()
        if rehearsal.keep:
            rehearsal.moments.append(_Moment(clock, emulator.device.phase, emulator.applied))
        rehearsal.at(now + self.period * emulator.stretch, self.tick)
        if emulator.unplugged and not self.gone:
            rehearsal.at(now + rehearsal.latency_us, partial(setattr, self, "gone", True))
        for when, part in self.up.send(data, now, emulator.since_armed(clock)) if data else []:
            rehearsal.at(when, partial(self._hear, part))
        return None

    def _hear(self, data: bytes) -> None:
        self.data += data


@dataclass
class Rehearsal:
    """A session and its emulated devices in virtual time: the session's ports lead to the emulators.

    `actions` of a person are pairs: (seconds after the first arming, call).
    """

    session: Session
    emulator: Emulator
    plan: Plan
    faults: tuple[FaultInjection, ...] = ()
    seed: int = 0
    actions: Sequence[tuple[float, Callable[[Session, int], Said]]] = ()
    operator: Operator | None = None  # as in a live session; None arms the first coupling, but no softer one
    latency_us: float = _LATENCY_US
    clock: float = 1.0  # length of the device's tick as a multiple of T
    keep: bool = True  # whether to record every tick of every device in `moments`
    watch: Callable[[Session], None] = lambda session: None  # called at every turn
    #: further boards: emulator, length of a tick as a multiple of T, faults of the line, time of the first tick [us]
    further: Sequence[tuple[Emulator, float, tuple[FaultInjection, ...], float]] = ()
    moments: list[_Moment] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._queue: list[tuple[float, int, Callable[[], object]]] = []
        self._number = count()
        self._done: set[int] = set()
        self.now = self._ended = 0.0  # [us]
        self._cables: list[_Cable] = []
        for emulator, clock, faults, begin_us in ((self.emulator, self.clock, self.faults, 0.0), *self.further):
            up, down = (Line(way, faults, self.seed, self.latency_us) for way in ("up", "down"))
            self._cables.append(_Cable(self, emulator, up, down, 1e6 * self.session.scenario.T * clock))
            self.at(begin_us, self._cables[-1].tick)
        clock, serial = lambda: round(self.now), partial(SerialDevice, clock=lambda: 1e-6 * self.now)
        device: HapticDevice = serial(self._cables[0])
        if self.further:
            boards = [serial(cable, patience=0.0) for cable in self._cables]
            axes = [cable.emulator.info.axes for cable in self._cables]
            device = Boards(boards, axes, self.session.settings.behind, clock, self.wait)
        self._driver = Driver(self.session, device, self.plan, clock)

    def run(self, seconds: float) -> Session:
        """Run until `seconds` of virtual time are over, and return the session."""
        return self._run(lambda: self.now > 1e6 * seconds)

    def run_until_armed(self, seconds: float) -> Session:
        """Run until `seconds` after arming, or until shortly after the end of the session if that is earlier."""
        return self._run(lambda: self._over or (self.armed_us is not None and self.now > self.armed_us + 1e6 * seconds))

    def run_to_the_end(self, most: float) -> Session:
        """Run until shortly after the end of the session, or for `most` seconds of virtual time."""
        return self._run(lambda: self._over or self.now > 1e6 * most)

    def _run(self, ready: Callable[[], bool]) -> Session:
        while not ready():
            self._turn()
        return self.session

    def freeze(self, seconds: float) -> None:
        """Let time pass without the host, as a busy or hung computer does."""
        until = self.now + 1e6 * seconds
        while self._queue[0][0] <= until:
            self._next()
        self.now = until

    @property
    def _over(self) -> bool:
        return self.session.stage in ENDED and self.now > self._ended + _GRACE_US

    def _turn(self) -> None:
        """Call the device once, then do the actions of the person."""
        if not self.session.log:
            self.freeze(_BEGIN)
            self.session.start(round(self.now))
        if self.session.stage in ENDED and any(cable.gone for cable in self._cables):
            self.freeze(1e-3)
        else:
            self._driver.turn()
        session, now = self.session, round(self.now)
        since = self.emulator.since_armed(now)
        for i, (when, call) in enumerate(self.actions):
            if since is not None and since >= when and i not in self._done:
                self._done.add(i)
                self._driver.do(call(session, now))
        if self.operator:
            self._driver.do(self.operator.decide(session, now))
        elif session.stage == Stage.DISARMED and session.program is session.programs[0]:
            if session.hindrance:
                return self.watch(session)
            self._driver.do(session.arm(now))
        self.watch(session)
        if session.stage not in ENDED:
            self._ended = self.now

    def wait(self, seconds: float, cables: Sequence[_Cable] = ()) -> bool:
        """Advance time by at most `seconds`, until bytes have come or a cable was pulled. Return whether they have."""
        until, cables = self.now + 1e6 * seconds, cables or self._cables
        while not (ready := any(cable.data or cable.gone for cable in cables)):
            if self._queue[0][0] > until:
                self.now = until
                break
            self._next()
        return ready

    # the queue of events

    def at(self, when: float, what: Callable[[], object]) -> None:
        heapq.heappush(self._queue, (when, next(self._number), what))

    def _next(self) -> None:
        self.now, _, what = heapq.heappop(self._queue)
        what()

    # results

    @property
    def armed_us(self) -> int | None:
        return self.emulator.armed_at

    def zero_after(self, seconds: float) -> float | None:
        """Return the time [s] from `seconds` after arming until all motors stay at zero, or None if they never do."""
        assert self.armed_us is not None
        begin = self.armed_us + 1e6 * seconds
        driving = [m.t_us for m in self.moments if m.applied.any()]
        last = max(driving, default=0)
        if last < begin:
            return 0.0
        quiet = next((m.t_us for m in self.moments if m.t_us > last), None)
        return None if quiet is None else 1e-6 * (quiet - begin)


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """The result of a rehearsed session.

    Attributes:
        stage: "finished" where all went well, otherwise "refused", "stopped", "lost" or "e-stop".
        cause: Why the session ended.
        delay: The median time from a sample to the arrival of its force [s]; None where it was not measured.
        theta: (m,) delays for which the coupling is certified [samples]; None where there is none.
        latency: Least and most time by which forces latch after their tick [s]; None where they latch at ticks.
        coupling: The first coupling certified for the measured delay; None where there is none.
        assessment: The assessment of that coupling in the loop with the measured delay.
        result: A Trace with t, x and f of every tick from arming on; handles are not measured. None if the session was
            never armed.
        zero_after: The time from the request to stop until all motors stay at zero [s], including the last test of
            the motors; None if the device was never armed, or forces do not stop.
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
    """Rehearse a session with the scenario's devices behind the real protocol, without device, port or waiting.

    The session connects, measures the delay, designs a coupling for it (or takes `coupling`), certifies the coupling,
    arms, runs for `seconds`, and ramps out. Delays are the scenario's theta; a slow link makes them longer. With
    `latch_on_arrival`, the device applies a force as soon as it comes. The loop then has the measured `latency` in
    addition to the scenario's theta, which may be 0. If no coupling is certified for the delay, the session is refused.
    A refusal is a result, not an error: see `stage` and `cause`.

    Raises InputError for a scenario that cannot run behind a serial link, or a case or time that is not allowed;
    TypeError for an argument of another type.
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

    def plan(ages: Ages) -> list[CertifiedCoupling]:
        met, link = timed(scenario, ages, _QUANTILE, _GUARD_US, latch_on_arrival)
        if coupling is None:
            programs.extend(certified_couplings(CouplingRequest(met, case), link))
        else:
            programs.append(certified_coupling(CouplingRequest(met, case, own=coupling), link))
        return programs

    stop = seconds, lambda session, now: session.stop("requested", now)
    try:
        emulator = Emulator(scenario)
    except ValueError as error:
        raise InputError(f"the scenario cannot run behind a serial link: {error}") from None
    rehearsal = Rehearsal(session, emulator, plan, seed=seed, actions=[stop])
    rehearsal.run_to_the_end(seconds + _LONGEST)
    outcome(case, session, recorder, 0)  # changes a finished session with doubtful forces to a stopped one
    first, meta = programs[0] if programs else None, {"scenario": scenario.name, "scenario_digest": scenario.digest}
    meta["stage"], ages = str(session.stage), session.measurement.result
    return Rehearsed(
        stage=str(session.stage),
        cause=session.cause,
        delay=1e-6 * ages.median if ages.values else None,
        theta=first and first.scenario.theta,
        latency=first.scenario.latency[0] if first and first.scenario.latency else None,
        coupling=first and first.chosen.coupling,
        assessment=first and first.assessment,
        result=recorder.trace(session.units, scenario.T, meta, scenario.channel_names) if len(recorder) else None,
        zero_after=None if rehearsal.armed_us is None else rehearsal.zero_after(seconds),
    )
