"""The delay of a link, timed at zero force: how old answers are, how many never arrive, and how long a tick is."""

from __future__ import annotations

from hw.frame import State, distance
from hw.plan import Ages
from hw.safety import Fault

LONGEST = 8  # STATEs per answer needed: a USB frame of 1 ms may bring several FORCEs, of which one margin is told
TOLERANCE = 0.01  # of the device's clock against T, over the measurement


class Measurement:
    """Counts answers until there are `needed`, arrived or missing. Its end is certain: it counts STATEs too."""

    def __init__(self, needed: int, theta: int, T: float, most_missing: float) -> None:
        self.ages: list[int] = []
        self._missed = 0
        self._needed, self._theta, self._T_us, self._most_missing = needed, theta, 1e6 * T, most_missing
        self._first: State | None = None
        self._states = 0

    def note(self, state: State, margin: int | None, missed: int) -> bool:
        """Take in a STATE; whether that was the last one. Raises Fault where the link cannot be used."""
        self._first = self._first or state
        self._states += 1
        counted = self._states - 2 * self._theta  # before, the device misses answers to ticks that nobody saw
        if counted <= 0:
            return False
        self._missed += missed
        if margin is not None:
            self.ages.append(round(self._theta * self._T_us) - margin)
            self._missed -= margin < 0  # it was missed, but came after all
        everything = len(self.ages) + self.missing
        if everything < self._needed and counted < LONGEST * self._needed:
            return False
        part = 1 - len(self.ages) / (everything if everything >= self._needed else counted)
        if part > self._most_missing:
            raise Fault(f"{100 * part:.0f} % of the answers never reached the device, {self._states} STATEs came")
        self._check_clock(state)
        return True

    @property
    def missing(self) -> int:
        """Answers that did not come, not even late."""
        return max(0, self._missed)

    @property
    def result(self) -> Ages:
        return Ages(tuple(self.ages), self.missing)

    def _check_clock(self, state: State) -> None:
        assert self._first is not None
        elapsed = (state.t_us - self._first.t_us) & 0xFFFFFFFF
        ticks = distance(state.tick, self._first.tick)
        if ticks > 0 and abs(elapsed / (ticks * self._T_us) - 1) > TOLERANCE:
            each = elapsed / ticks
            raise Fault(f"a tick of the device lasts {each:.1f} us by its own clock, T is {self._T_us:g} us")
