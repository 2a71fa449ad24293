"""What follows the STOP that ends a session: is it heard, and is it obeyed?"""

from __future__ import annotations

from hw.frame import State, Stop, encode
from hw.message import Phase, Reason

STOPPING_US = 50_000  # in which a device that was stopped must say so
OBEYING_US = 30_000  # in which one that was told to stop must rest: the longest hold and ramp, and half as long again


def drives(state: State) -> bool:
    """Whether it moves its motors as nobody may who was told to stop; a ramp is on its way to zero."""
    return state.phase in (Phase.ARMED, Phase.HOLDING) or (state.phase != Phase.RAMP and any(state.applied))


class Ending:
    """STOP, told until the device says that it rests; an emergency stop, until it says that it has latched it."""

    def __init__(self, reason: Reason, acted: bool, now: int, T: float) -> None:
        """`acted`: forces have acted, so that a device which says nothing is told again, every T seconds."""
        self._stop, self._latch = encode(Stop(reason)), reason == Reason.ESTOP
        self._repeat, self._every = acted or self._latch, 1e6 * T
        self._began = self._told = now
        self._rests, self._obeys = False, True

    def heard(self, state: State) -> bytes:
        """The answer to a STATE that came after the end."""
        self._rests = not drives(state) and (not self._latch or state.phase == Phase.ESTOP)
        return b"" if self._rests else self._stop

    def again(self, now: int) -> bytes:
        """STOP, where no STATE has said for a tick that it was heard: the one before may be lost, and STATEs too."""
        due = now - self._told >= self._every and now - self._began < STOPPING_US
        if self._rests or not due or not self._repeat:
            return b""
        self._told = now
        return self._stop

    def disobeyed(self, state: State, now: int) -> str | None:
        """Said once, of a device that goes on driving."""
        if not self._obeys or now - self._began <= OBEYING_US or not drives(state):
            return None
        self._obeys = False
        return f"told to stop, the device still drives after {OBEYING_US // 1000} ms: cut its power"
