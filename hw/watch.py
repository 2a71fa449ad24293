"""What the host counts while a device streams: frames that are no use, ages of answers, and whether the link holds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from hw.frame import State, distance
from hw.message import NO_MARGIN

FRESH, DUPLICATE, STALE = "fresh", "duplicate", "stale"


@dataclass
class Counters:
    """Since the session began; the device's own counts are differences modulo 256, summed."""

    states: int = 0  # STATEs that were acted upon
    gaps: int = 0  # ticks of which no STATE came
    duplicates: int = 0  # the same tick again
    stale: int = 0  # an older tick than the last: late or reordered
    unexpected: int = 0  # messages that have no place here
    late: int = 0  # answers that reached the device after their latch
    misses: int = 0  # ticks without an answer in time, by the device's count
    device_errors: int = 0  # frames that the device rejected
    clipped: int = 0  # forces at the cap
    slowed: int = 0  # forces at the slew limit
    unlike: int = 0  # ticks at which the device applied another force than it was sent in time


@dataclass
class LinkWatch:
    """Order of STATEs, and the margins of the answers over a sliding window."""

    window: int  # [ticks]
    counters: Counters
    last: State | None = None
    margins: deque[int | None] = field(default_factory=deque)  # per fresh tick; None: no answer came
    missed: deque[int] = field(default_factory=deque)
    gaps: deque[int] = field(default_factory=deque)  # ticks before a fresh one of which no STATE came
    _late: int = 0  # in the window, kept as sums: adding up the window would take longer than all the rest of a tick
    _missed: int = 0
    _untold: int = 0
    _gaps: int = 0

    def order(self, state: State) -> tuple[str, int]:
        """FRESH, DUPLICATE or STALE, and by how many ticks a fresh one is ahead."""
        if self.last is None:
            return FRESH, 1
        ahead = distance(state.tick, self.last.tick)
        if ahead > 0:
            self.counters.gaps += ahead - 1
            return FRESH, ahead
        if ahead == 0:
            self.counters.duplicates += 1
            return DUPLICATE, 0
        self.counters.stale += 1
        return STALE, 0

    def note(self, state: State) -> None:
        """Take in a fresh STATE."""
        missed = gap = 0
        if self.last is not None:
            gap = distance(state.tick, self.last.tick) - 1
            missed = (state.misses - self.last.misses) & 0xFF
            self.counters.device_errors += (state.crc_errors - self.last.crc_errors) & 0xFF
        margin = None if state.margin_us == NO_MARGIN else state.margin_us
        self.counters.states += 1
        self.counters.misses += missed
        late = _is_late(margin)
        self.counters.late += late
        self.margins.append(margin)
        self.missed.append(missed)
        self.gaps.append(gap)
        self._late += late
        self._missed += missed
        self._gaps += gap
        self._untold += margin is None
        if len(self.margins) > self.window:
            oldest = self.margins.popleft()
            self._late -= _is_late(oldest)
            self._untold -= oldest is None
            self._missed -= self.missed.popleft()
            self._gaps -= self.gaps.popleft()
        self.last = state

    def restart(self) -> None:
        """Forget the window: the delay has been configured anew."""
        self.last = None
        self.margins.clear()
        self.missed.clear()
        self.gaps.clear()
        self._late = self._missed = self._untold = self._gaps = 0

    @property
    def late_part(self) -> float:
        """The late answers as a part of a whole window: they are that many, however few ticks there were yet."""
        return self._late / self.window

    @property
    def missed_part(self) -> float:
        """The part of a whole window without an answer in time, late or lost."""
        return min(1.0, self._missed / self.window)

    @property
    def gap_part(self) -> float:
        """The part of a whole window, or more, of which no STATE came."""
        return self._gaps / self.window

    @property
    def untold_part(self) -> float:
        """The part of a whole window that told no margin: no FORCE came, or the device does not say."""
        return self._untold / self.window


def _is_late(margin: int | None) -> bool:
    return margin is not None and margin < 0
