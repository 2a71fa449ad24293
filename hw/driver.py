"""An operator decides when a session is armed and stopped. A driver calls the device for the session."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from haptic_loop.hw import protocol as wire
from haptic_loop.hw.control import Armable
from haptic_loop.hw.haptic_device import HapticDevice, PortLost
from haptic_loop.hw.limits import DRIVING, Stage
from haptic_loop.hw.monitor import Ages
from haptic_loop.hw.session import Said, Session

_DEADMAN_US = 1_000_000  # longest time without a sign of the user
_LET_GO_US = 5_000_000  # time to let go of a handle before the session arms by itself
_KEYS = {"a": "arm", "s": "stop", "q": "stop", " ": "estop"}


@dataclass
class Operator:
    """Decide in place of a person when to arm and end a session, and act on keys. Arm without a key at most once.

    With a `deadman`, forces act only while the user gives a sign every second: a key, or `deadman` returns True.
    """

    auto_arm: bool
    seconds: float  # time of forces at full gain in each arming
    deadman: Callable[[], bool] | None = None  # whether the user gave a sign since the last call
    _armed_at: int | None = None  # [us]
    _seen_at: int | None = None  # [us] time of the user's last sign
    _free_at: int = 0  # [us] earliest time of arming without a key

    def decide(self, session: Session, now: int) -> Said:
        """Arm or stop the session if that is due at `now` [us], and return its messages."""
        if session.stage == Stage.DISARMED:
            self._armed_at = None
            if self.auto_arm and session.hindrance:
                self._free_at = now + _LET_GO_US * (session.settings.check_axes or bool(session.settings.elsewhere))
            elif self.auto_arm and now >= self._free_at:
                return self._arm_once(session, now)
            elif self.auto_arm:
                session.request = f"let go of every handle: forces act in {_LET_GO_US / 1e6:g} s"
        if session.stage == Stage.ARMED and self._armed_at is None:
            self._armed_at = now
        if self.deadman:
            if self.deadman() or session.stage not in DRIVING or self._seen_at is None:
                self._seen_at = now
            if now - self._seen_at > _DEADMAN_US:
                return session.stop(f"the deadman was let go for {_DEADMAN_US / 1e6:g} s", now, let_go=True)
        if self._armed_at is not None and now - self._armed_at > 1e6 * self.seconds:
            return session.stop("the time is over", now)
        return ()

    def press(self, key: str, session: Session, now: int) -> Said:
        """Act on a key, which also counts as a sign of the user. The key `a` arms only a disarmed session."""
        self._seen_at = now
        match _KEYS.get(key):
            case "arm" if session.stage == Stage.DISARMED:
                return session.arm(now)
            case "stop":
                return session.stop(f"key {key}", now)
            case "estop":
                return session.estop("space bar", now)
        return ()

    def _arm_once(self, session: Session, now: int) -> Said:
        if session.armings:  # An earlier arming has ended; the session waits for a person to arm a softer coupling.
            softer = session.program.name if session.program else "none"
            return session.end(Stage.REFUSED, f"nobody is there to arm the softer coupling, {softer}", now)
        return session.arm(now)


class Driver:
    """Call the device for a session, once per turn."""

    def __init__(
        self,
        session: Session,
        device: HapticDevice,
        plan: Callable[[Ages], Sequence[Armable]],
        clock: Callable[[], int],
    ) -> None:
        """Take `plan`, which returns couplings for the measured delay, and `clock`, which returns the time [us]."""
        self.session, self.device, self.plan, self.clock = session, device, plan, clock
        self._force: wire.Force | None = None

    def do(self, said: Said) -> None:
        """Stop the device, or store a force for the next call, as the session's messages say."""
        for message in said:
            if isinstance(message, wire.Force):
                self._force = message
            else:
                self._force = None
                self.device.stop(wire.Reason(message.reason))

    def turn(self) -> None:
        """Call the device once and let the session answer."""
        session = self.session
        try:
            self._call(session)
            session.counters.host_errors = self.device.errors
            if said := session.poll(self.clock()):
                self.do(said)
            if session.stage == Stage.MEASURED:
                self.load()
        except PortLost as lost:
            session.end(Stage.LOST, str(lost), self.clock())

    def _call(self, session: Session) -> None:
        try:
            if (answer := self._answer(session)) is not None:
                self.do(session.take(answer, self.clock()))
        except wire.SafetyStop as fault:
            if session.stage == Stage.FINISHED:
                session.retract(str(fault))
            self.do(session.end(Stage.STOPPED, str(fault), self.clock()))

    def _answer(self, session: Session) -> wire.Info | wire.State | int | None:
        """Return the device's answer. Raises PortLost for an OSError, SafetyStop for an answer of another type."""
        answer: object
        try:
            if session.stage == Stage.CONNECTING:
                call, expected, answer = "info", wire.Info, self.device.info()
            elif session.stage == Stage.CONFIGURING:
                assert session.config
                call, expected, answer = "configure", int, self.device.configure(session.config)
            else:
                force, self._force = self._force, None
                call, expected, answer = "exchange", wire.State, self.device.exchange(force)
        except PortLost:
            raise
        except OSError as error:  # of a user's own device
            raise PortLost(f"{type(error).__name__}: {error}") from error
        if answer is None or isinstance(answer, expected):
            return answer
        raise wire.SafetyStop(f"{call}() of the device returned {answer!r}, expected {expected.__name__} or None")

    def load(self) -> None:
        """Load couplings for the measured delay while the device rests at zero force."""
        session = self.session
        try:
            programs = self.plan(session.measurement.result)
        except wire.SafetyStop as fault:
            return self.do(session.end(Stage.REFUSED, str(fault), self.clock()))
        return self.do(session.load(programs, self.clock()))
