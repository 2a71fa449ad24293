"""What drives a session besides its link: arming, the planned end, a person's keys. No port, no clock, no terminal."""

from __future__ import annotations

from dataclasses import dataclass

from hw.safety import Stage
from hw.session import Session

KEYS = {"a": "arm", "s": "stop", "q": "stop", " ": "estop"}


@dataclass
class Steering:
    """One session's arming rule: by itself at most once, ever; everything after that is a person's."""

    auto_arm: bool
    seconds: float  # of forces at full gain, from each arming on
    _asked: bool = False  # auto_arm has been used up
    _armed_at: int | None = None  # [us]

    def look(self, session: Session, now: int) -> bytes:
        """What is to be said at `now` [us] because of where the session stands."""
        if session.stage == Stage.DISARMED:
            self._armed_at = None
            if self.auto_arm:
                return self._arm_once(session, now)
        if session.stage == Stage.ARMED and self._armed_at is None:
            self._armed_at = now
        if self._armed_at is not None and now - self._armed_at > 1e6 * self.seconds:
            return session.stop("the time is over", now)
        return b""

    def press(self, key: str, session: Session, now: int) -> bytes:
        """A key of a person. `a` means something to a disarmed session only."""
        match KEYS.get(key):
            case "arm" if session.stage == Stage.DISARMED:
                self._asked = True
                return session.arm(now)
            case "stop":
                return session.stop(f"key {key}", now)
            case "estop":
                return session.estop("space bar", now)
        return b""

    def _arm_once(self, session: Session, now: int) -> bytes:
        if self._asked:  # a softer coupling is ready, and nobody is there to arm it
            softer = session.rung.name if session.rung else "none"
            return session.refuse(f"nobody to arm the softer coupling, {softer}", now)
        self._asked = True
        return session.arm(now)
