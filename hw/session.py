"""One session with a device. It computes forces and stop messages from messages and times, without port or clock.

    connecting -> configuring -> measuring -> measured -> configuring -> disarmed
                     (load: a certified coupling)     (arm: a person)  -> arming -> armed -> disarming -> finished

Every other end has its own stage (refused, stopped, lost, e-stop) and a cause in the log. A session that has ended
never arms again. It only repeats its STOP until the device rests, or for 50 ms to a silent device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from haptic_loop.hw import protocol as wire
from haptic_loop.hw.control import Armable, Arming, BudgetPlan, Drive, SentBudget, TraceRow, WorldController
from haptic_loop.hw.encoders import ELSEWHERE, AxisCheck, CheckedAxes, EncoderNoise, Expected
from haptic_loop.hw.limits import DRIVING, ENDED, SafetyLimits, Stage, Units, probe_delay, watchdog_for
from haptic_loop.hw.monitor import Counters, LinkMonitor, LinkSettings, Measurement
from haptic_loop.models.device import symmetric
from haptic_loop.sim.scenario import InputError, Scenario, is_world

_PATIENCE_US = 2_000_000  # longest wait for the answer to HELLO or CONFIG
_ARMING_US = 600_000  # time per axis in which the device must arm and its encoders must pass their test
_QUIET_US = 1_000_000  # longest silence of a device while no force acts; unlimited during the design
_STOPPING_US = 50_000  # time for which STOP is repeated to a silent device
_OBEYING_US = 30_000  # time after STOP in which a device must rest: 1.5 times the longest sum of hold and ramp
STRONGEST = 12.0  # [N] largest force of a device at the hand, whatever a scenario allows
#: [N] default force cap at the hand; less for a device whose free handle would exceed FREE_SPEED [m/s] under it
USUAL_CAP, FREE_SPEED = 1.3, 1.0

Said = tuple[wire.Force | wire.Stop, ...]  # messages to the device


class _Event(NamedTuple):
    """One line of the log."""

    t_us: int
    stage: Stage
    cause: str


class Session:
    """Run the host's side of the link."""

    def __init__(self, scenario: Scenario, limits: SafetyLimits, settings: LinkSettings | None = None) -> None:
        if len(limits.cap) != scenario.channels:
            raise ValueError(f"cap has {len(limits.cap)} entries for {scenario.channels} channels")
        self.scenario, self.limits, self.settings = scenario, limits, settings or LinkSettings()
        self.probe = probe_delay(scenario.T)
        self.counters = Counters()
        self.link = LinkMonitor(self.counters)
        self.measurement = Measurement(self.settings.measure, self.probe, scenario.T)
        self.stage, self.cause = Stage.CONNECTING, ""
        self.log: list[_Event] = []
        self.info: wire.Info | None = None  # the device's INFO; None before it came
        self.config: wire.Config | None = None  # the last configuration for the device
        self.programs: tuple[Armable, ...] = ()
        self.program: Armable | None = None
        self.drive: Drive | None = None  # controller of the last arming; None before the first arming and after the end
        self.armings: list[Arming] = []
        self.worlds: list[WorldController] = []  # one per arming in a world
        self.record: Callable[[TraceRow], None] = lambda row: None
        self.listen: Callable[[_Event], None] = lambda event: None
        self._expected = Expected(scenario, self.settings.held, self.settings.identifies)
        self.missed_while_driving = 0  # ticks without an answer in time while the session drove
        self.request: str | None = None  # what the person at the device must do now
        self.now = self.entered = self.heard = 0  # [us] times of the last call, stage change, and new STATE or ACK
        self._units: Units | None = None
        self._noise: EncoderNoise | None = None
        self._axes: AxisCheck | None = None
        self._shutdown: _Shutdown | None = None
        #: stage after a ramp-out: FINISHED without a fault, None if a softer coupling is to be armed
        self._after: Stage | None = Stage.FINISHED

    @property
    def gain(self) -> float:
        """The factor, from 0 to 1, of the controller's forces; 0 while the session does not drive."""
        return self.drive.gain if self.drive else 0.0

    @property
    def held(self) -> bool:
        """Whether the deadman at the device allows forces."""
        return not self.settings.deadman or (self.link.last is not None and self.link.last.deadman)

    @property
    def hindrance(self) -> str | None:
        """The reason why the session cannot be armed at the moment, or None."""
        if not self.held:
            return "the deadman at the device is not held"
        if self._axes and self._axes.request:
            return self._axes.request
        last, before = self.link.last, self.settings.elsewhere
        if before is None:
            return None
        if last is None:
            return "no STATE has come yet"
        far = ELSEWHERE / self.limits.lever
        moved = np.abs(np.subtract(last.counts, before)) * self.units.encoder_step
        near = ", ".join(str(i + 1) for i in np.flatnonzero(moved < far))
        where = f"within {1e3 * far:.3g} mm of its place in the previous sitting"
        return f"handle {near} is {where}: move it farther and let go" if near else None

    @property
    def units(self) -> Units:
        """The units of the device, which must have sent its INFO."""
        assert self._units
        return self._units

    # Calls by a person and by the driver

    def start(self, now: int) -> None:
        """Start the session, which then waits for the device's INFO."""
        self.now = now
        self._enter(Stage.CONNECTING, "HELLO")

    def load(self, programs: Sequence[Armable], now: int) -> Said:
        """Take couplings for the measured delay, sorted by delay, and configure the device for the first coupling."""
        self.now = now
        if self.stage != Stage.MEASURED:
            return ()
        if not programs or not all(program.certified for program in programs):
            return self.end(Stage.REFUSED, "the coupling is not certified", now)
        self.programs = tuple(programs)
        return self._take(0, "certified")

    def arm(self, now: int) -> Said:
        """Arm the session because a person asks for it. A session that is not disarmed ignores the request.

        If there is a `hindrance`, only log it. If an encoder is too noisy, end the session.
        """
        self.now = now
        if self.stage == Stage.DISARMED and (hindrance := self.hindrance):
            self._log(hindrance)
        elif self.stage == Stage.DISARMED:
            assert self.program
            assert self.config
            assert self._noise
            if noisy := self._noise.above(self.limits.widest, self.units):
                return self._end(Stage.REFUSED, noisy)
            arming = Arming(len(self.armings), self.program, self.config, *self._accounts(self.config))
            self.armings.append(arming)
            axes = CheckedAxes(self.limits, self.units, self.scenario.T, self._noise.still)
            self.drive = Drive(arming, axes, self._expected, self.settings, self.counters, self.record)
            if self.drive.world:
                self.worlds.append(self.drive.world)
            self._after = Stage.FINISHED
            self._enter(Stage.ARMING, "requested")
        return ()

    def _accounts(self, config: wire.Config) -> tuple[SentBudget | None, BudgetPlan | None]:
        """Return the energy budget of an arming, and the plan of a budget for motor tests in a world."""
        scenario, budget = self.scenario, self.settings.energy_budget
        tests = is_world(scenario) and config.theta > 0  # a SentBudget counts whole ticks only
        if budget is None and not tests:
            return None, None
        longest = max(scenario.T_max or 0.0, 1e-6 * self.measurement.result.longest_tick(1e6 * scenario.T))
        plan = BudgetPlan.of(*(budget or (0.0, 0.0)), scenario.delta, self.units, config, longest)
        return (SentBudget(plan) if budget else None), (plan if tests else None)

    def stop(self, cause: str, now: int, let_go: bool = False) -> Said:
        """End the session as planned: by a ramp if the gain is above 0, otherwise at once.

        After the ramp the motors are tested once more, if the settings request encoder tests. The session ends as
        stopped if the user `let_go` of the deadman, if the session was never armed, or if no force acts at the moment,
        so that this test is impossible.
        """
        self.now, after = now, Stage.STOPPED if let_go else Stage.FINISHED
        if self.stage in ENDED:
            return ()
        if self.stage == Stage.DISARMING:
            if let_go and self._after == Stage.FINISHED:
                self._ramp_out(after, cause)
            self._after = self._after or after
            return ()
        if self.stage == Stage.ARMED or (self.stage == Stage.ARMING and self.gain > 0):
            self._ramp_out(after, cause)
            return ()
        if not self.armings:
            after, cause = Stage.STOPPED, f"{cause}, before any force acted"
        elif self.settings.test_encoders and not let_go:
            at = "" if self.settings.identifies else " at its end"
            after, cause = Stage.STOPPED, f"{cause}, before the motors of the last arming were tested{at}"
        return self._end(after, cause, wire.Reason.DONE)

    def end(self, stage: Stage, cause: str, now: int) -> Said:
        """End the session in this stage at once, without a ramp by the host, unless it has ended."""
        self.now = now
        return () if self.stage in ENDED else self._end(stage, cause)

    def retract(self, doubt: str) -> None:
        """Change the end of a session from finished to stopped, also in its log, and add `doubt` to the cause."""
        self.log = [event for event in self.log if event.stage != Stage.FINISHED]
        self._enter(Stage.STOPPED, f"{self.cause}, but {doubt}")

    def estop(self, cause: str, now: int) -> Said:
        """Latch zero force in host and device at once, also after the session has ended."""
        self.now = now
        if self.stage == Stage.ESTOP:
            return ()
        return self._end(Stage.ESTOP, cause, wire.Reason.ESTOP)

    # Calls with the device's answers

    def take(self, answer: wire.Info | wire.State | int, now: int) -> Said:
        """Process the device's INFO, its STATE, or the result in its ACK. End the session if that raises an error."""
        self.now = now
        try:
            if isinstance(answer, wire.Info):
                return self._on_info(answer)
            return self._on_state(answer) if isinstance(answer, wire.State) else self._on_ack(answer)
        except wire.SafetyStop as fault:
            return self.end(Stage.STOPPED, str(fault), now)
        except Exception as error:  # any error stops the device
            return self.end(Stage.STOPPED, f"{type(error).__name__} in the host program: {error}", now)

    def poll(self, now: int) -> Said:
        """Act on time-outs and on a STOP that must be repeated."""
        self.now = now
        if self.stage in ENDED:
            return self._shutdown.again(now) if self._shutdown else ()
        waited, silence, most = now - self.entered, now - self.heard, _ARMING_US * self.scenario.channels
        if self.stage in (Stage.CONNECTING, Stage.CONFIGURING):
            if waited <= _PATIENCE_US:
                return ()
            question, n = "HELLO" if self.stage == Stage.CONNECTING else "CONFIG", self.counters.host_errors
            noise = f"; {n} unreadable frame{'s' if n > 1 else ''}: wrong baud rate?" if n else ""
            return self._end(Stage.LOST, f"no answer to {question} within {1e-6 * waited:.1f} s{noise}")
        if self.stage == Stage.ARMING and self.gain == 0 and waited > most:
            return self._end(Stage.STOPPED, f"the device did not arm and pass its test within {most // 1000} ms")
        if silence > (self.limits.watchdog_us if self.stage in DRIVING else _QUIET_US) and self.stage != Stage.MEASURED:
            cause = f"no new STATE for {silence / 1000:.1f} ms: the device hangs, or a brown-out reset it"
            return self._end(Stage.LOST, cause)
        return ()

    def _on_info(self, info: wire.Info) -> Said:
        if reasons := self.limits.objections(info, self.scenario, self.settings.baud):
            return self._end(Stage.REFUSED, "; ".join(reasons))
        self.info, self._units = info, Units.of(info)
        self._noise = EncoderNoise(info.axes, self.scenario.T)
        if self.settings.check_axes:
            self._axes = AxisCheck(self.units, self.scenario.T, self.limits.lever)
        name = "".join(c if c.isprintable() else "?" for c in info.firmware) or "device"
        return self._configure(self.probe, f"{name} {info.serial}, to be measured")

    def _on_ack(self, refused: int) -> Said:
        assert self.config
        if refused != wire.Refused.ACCEPTED:
            known = [r.name.lower() for r in wire.Refused if r == refused]
            return self._end(Stage.REFUSED, f"the device refuses the configuration: {(known or [refused])[0]}")
        self.link.restart()
        self.heard = self.now
        self._enter(Stage.DISARMED if self.program else Stage.MEASURING, f"theta = {self.config.theta}")
        return ()

    def _configure(self, theta: int, cause: str) -> Said:
        assert self.info
        self._enter(Stage.CONFIGURING, cause)
        self.config = self.limits.configuration(self.info, theta)
        return ()

    def _take(self, index: int, cause: str) -> Said:
        self.program = self.programs[index]
        self.link.needed = self.program.margin_us
        return self._configure(self.program.link, f"{self.program.name}: {cause}")

    # Answers to STATEs

    def _on_state(self, state: wire.State) -> Said:
        if self.info is None or state.axes != self.info.axes:
            self.counters.unexpected += 1
            return ()
        if self.stage in ENDED:
            return self._on_state_after_the_end(state)
        ticks = self.link.take(state, () if self.programs else self.measurement.ignored)
        if not ticks:
            return ()
        self.heard = self.now
        if state.phase == wire.Phase.ESTOP:
            return self.estop(f"pressed, {state.cause.name.lower()}", self.now)
        assert self.config is not None
        _check_state(state, self.config, self.stage, self.gain)
        if self.stage in DRIVING:
            ended = () if self.held else self.stop("the deadman at the device was let go", self.now, let_go=True)
            return ended or self._on_driving(state, ticks)
        assert self._noise
        self._noise.note(state.counts)
        if self.stage == Stage.MEASURING:
            return self._measure(state)
        if self.stage == Stage.DISARMED:
            if self._axes and (wrong := self._axes.note(state.counts)):
                return self._end(Stage.REFUSED, wrong)
            self.request = self.hindrance
        return self._answer(state, wire.Command.IDLE)

    def _on_state_after_the_end(self, state: wire.State) -> Said:
        assert self._shutdown
        if cause := self._shutdown.disobeyed(state, self.now):
            if self.stage == Stage.FINISHED:
                self._enter(Stage.STOPPED, cause)  # a device that still drives contradicts "finished"
            else:
                self._log(cause)
        return self._shutdown.answer(state)

    def _on_driving(self, state: wire.State, ticks: int) -> Said:
        assert self.drive
        ready = state.phase != wire.Phase.DISARMED
        direction = (-1 if self.stage == Stage.DISARMING else 1) if ready else 0
        self.missed_while_driving += self.link.missed
        first = self.drive.reference is None
        steps = self.drive.step(state, ticks, direction, self.now, self._after == Stage.FINISHED)
        if first and any(self.drive.reference or ()):
            places = ", ".join(f"{1e3 * x:+.4g}" for x in self.units.positions(self.drive.reference or ()))
            self._log(f"positions count from where the handles are: {places} mm")
        if self._after == Stage.FINISHED and (late := self.link.too_late()):
            self._soften(late)
        if self._after == Stage.FINISHED and (dead := self.drive.encoders.dead):
            self._ramp_out(Stage.STOPPED, dead)
        if self.stage == Stage.ARMING and self.gain == 1.0:
            self._enter(Stage.ARMED, "full gain")
            for remark in self.drive.remarks:
                self._log(remark)
        if self.stage == Stage.DISARMING and self.drive.ended:
            return self._ramped_out()
        if (request := self.drive.request) and request != self.request:
            self._log(request)
        self.request = request
        return self._answer(state, wire.Command.RUN if ready else wire.Command.ARM, steps)

    def _answer(
        self, state: wire.State, command: wire.Command, steps: tuple[int, ...] = (), theta: int | None = None
    ) -> Said:
        """Return the FORCE that answers a STATE. By default the force is zero, with the configured delay."""
        assert self.config
        apply_at = (state.tick + (self.config.theta if theta is None else theta)) & 0xFFFF
        return (wire.Force(command, apply_at, state.tick, steps or (0,) * state.axes),)

    def _measure(self, state: wire.State) -> Said:
        try:
            if not self.measurement.note(state, self.link.margin, self.link.missed):
                return self._answer(state, wire.Command.IDLE, theta=self.measurement.delay())
        except wire.SafetyStop as fault:
            return self._end(Stage.REFUSED, str(fault))
        ages = self.measurement.result
        self._enter(Stage.MEASURED, f"{len(ages.values)} answers, median age {ages.median} us")
        return ()

    # Ramps and the end

    def _soften(self, late: str) -> None:
        """Ramp out, and continue with the next coupling if there is one and the session is not about to end."""
        assert self.program is not None
        ending, softer = self.stage == Stage.DISARMING, self.programs.index(self.program) + 1 < len(self.programs)
        left = "" if ending or softer else ", and nothing softer is left"
        self._ramp_out(None if softer and not ending else Stage.STOPPED, late + left)

    def _ramp_out(self, after: Stage | None, cause: str) -> None:
        self._after = after
        self._enter(Stage.DISARMING, cause)

    def _ramped_out(self) -> Said:
        if self._after:
            return self._end(self._after, self.cause, wire.Reason.DONE)
        assert self.program is not None
        softer = self.programs.index(self.program) + 1
        return (wire.Stop(wire.Reason.DONE), *self._take(softer, f"softer, since {self.cause}"))

    def _enter(self, stage: Stage, cause: str) -> None:
        self.stage, self.cause, self.entered = stage, cause, self.now
        self._log(cause)

    def _log(self, cause: str) -> None:
        self.log.append(_Event(self.now, self.stage, cause))
        self.listen(self.log[-1])

    def _end(self, stage: Stage, cause: str, reason: wire.Reason = wire.Reason.FAULT) -> Said:
        self.drive = self.request = None
        self._shutdown = _Shutdown(reason, bool(self.armings), self.now, self.scenario.T)
        self._enter(stage, cause)
        return (wire.Stop(reason),)


def _check_state(state: wire.State, config: wire.Config, stage: Stage, gain: float) -> None:
    """Raise SafetyStop where the device is in a wrong phase, or applies a force above its cap or while disarmed."""
    for force, cap in zip(state.applied, config.cap, strict=True):
        if not -cap <= force <= cap:
            raise wire.SafetyStop(f"the device applies {state.applied} steps, the cap is {config.cap}")
    phase = state.phase
    if phase in (wire.Phase.STOPPED, wire.Phase.RAMP, wire.Phase.SILENT):
        raise wire.SafetyStop(f"the device is in {phase.name.lower()}, cause {state.cause.name.lower()}")
    armed = phase in (wire.Phase.ARMED, wire.Phase.HOLDING)
    if armed and stage not in DRIVING:
        raise wire.SafetyStop("the device is armed without a command")
    if not armed and (stage in (Stage.ARMED, Stage.DISARMING) or gain > 0):
        raise wire.SafetyStop("the device has disarmed itself")
    if not armed and any(state.applied):
        raise wire.SafetyStop(f"the device is disarmed and applies {state.applied} steps")


def axis_by_axis(scenario: Scenario) -> Scenario:
    """Replace each full damping matrix Delta by a smaller diagonal matrix, because INFO has one number per axis.

    The diagonal matrix is d D <= Delta with D = diag(Delta) and the least eigenvalue d of D^-1/2 Delta D^-1/2.
    """
    devices = []
    for device in scenario.device:
        Delta = symmetric("delta", device.passivity_level, device.axes)
        own = np.diag(Delta)
        if (Delta != np.diag(own)).any():
            share = np.linalg.eigvalsh(Delta / np.sqrt(np.outer(own, own)))[0]
            level = np.floor(1e6 * share * own) / 1e6  # INFO has whole uN s/m
            device = msgspec.structs.replace(device, delta=tuple(level.tolist()))
        devices.append(device)
    return scenario.replace(device=tuple(devices)) if devices != [*scenario.device] else scenario


def _default_caps(scenario: Scenario) -> list[float]:
    """Return the default force cap [N] of every device at the hand.

    A constant force F moves a free handle with the damping b no faster than F/b. So F is the smaller of USUAL_CAP and
    FREE_SPEED times the least eigenvalue of the guaranteed damping [N s/m] at the hand.
    """
    least = [np.linalg.eigvalsh(device.matrix("delta"))[0] / scenario.lever**2 for device in scenario.device]
    return [min(USUAL_CAP, float(damping) * FREE_SPEED) for damping in least]


def session_for(scenario: Scenario, settings: LinkSettings, cap: float | None = STRONGEST, **more: Any) -> Session:
    """Return a session in which no device's force at the hand exceeds `cap` [N], or its default cap for None.

    Where the axes of a device are limited one by one, each of its n axes gets 1 / sqrt(n) of the cap. `more` are other
    fields of SafetyLimits.

    Raises:
        InputError: A limit or T is impossible, or a rotary scenario has no radius.
    """
    each = _default_caps(scenario) if cap is None else [cap] * len(scenario.device)
    scenario = axis_by_axis(scenario)
    if scenario.unit == "rad" and scenario.radius is None:
        raise InputError("radius is missing: give the distance in metres from axis to hand, which scales the limits")
    limits, balls = scenario.limiter_limits
    r, vectors = scenario.lever, tuple((ball.start, ball.stop) for ball in balls)
    scaled: dict[str, Any] = {"slew": 2000.0 * r, "jump": 3e-3 / r, "speed": SafetyLimits.speed / r, "lever": r} | more
    counts = [len(device.free) for device in scenario.device]
    axes = np.repeat(counts, counts)  # (m,) number of axes of the channel's device; 1 if its vector is limited
    for first, end in vectors:
        axes[first:end] = 1
    own = np.repeat(each, counts) * r / np.sqrt(axes)  # (m,) [N or N m]
    caps = tuple(map(min, own.tolist(), limits))
    if cap is None:
        if min(own) < 1e-3 * r:
            least = f"the damping of a device is {min(each) / FREE_SPEED:g} N s/m at the hand"
            raise InputError(f"{least}, too small for a default force cap of 0.001 N or more: give --force-cap")
        small = np.repeat(each, counts) < USUAL_CAP
        scaled["raisable"] = tuple((small & (own < limits)).tolist())
    try:
        safety = SafetyLimits(
            caps, vectors=vectors, motors=tuple(limits), watchdog_us=watchdog_for(scenario.T), **scaled
        )
        return Session(scenario, safety, settings)
    except ValueError as error:
        raise InputError(str(error)) from None


class _Shutdown:
    """Repeat STOP until the device rests, or an emergency stop until the device has latched it."""

    def __init__(self, reason: wire.Reason, acted: bool, now: int, T: float) -> None:
        """Repeat STOP to a silent device every T [s] if the session was armed (`acted`) or stops in an emergency."""
        self._stop, self._latch = (wire.Stop(reason),), reason == wire.Reason.ESTOP
        self._repeat, self._every = acted or self._latch, 1e6 * T
        self._began = self._sent = now
        self._rests, self._obeys = False, True

    def answer(self, state: wire.State) -> Said:
        """Return the answer to a STATE that came after the end."""
        self._rests = not state.drives and (not self._latch or state.phase == wire.Phase.ESTOP)
        return () if self._rests else self._stop

    def again(self, now: int) -> Said:
        """Return STOP again if no STATE has confirmed it for a tick, because messages may be lost."""
        due = now - self._sent >= self._every and now - self._began < _STOPPING_US
        if self._rests or not due or not self._repeat:
            return ()
        self._sent = now
        return self._stop

    def disobeyed(self, state: wire.State, now: int) -> str | None:
        """Return a message, once, if the device still drives long after STOP, else None."""
        if not self._obeys or now - self._began <= _OBEYING_US or not state.drives:
            return None
        self._obeys = False
        return f"the device still drives {_OBEYING_US // 1000} ms after STOP: cut its power"
