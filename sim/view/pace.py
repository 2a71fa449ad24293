"""Real time: how many ticks a clock has made due, and an honest count of what could not be made up."""

from __future__ import annotations

from dataclasses import dataclass

LONGEST_LAG = 0.1  # [s] what may be made up in one go; more is dropped and counted


@dataclass
class Pace:
    """Ticks of T seconds against a clock that is read from outside."""

    T: float  # [s]
    started: float  # [s] the clock when tick 0 was due
    done: int = 0  # ticks
    overruns: int = 0  # how often the loop fell behind by more than LONGEST_LAG
    lost: float = 0.0  # [s] clock time that no tick was made for

    def due(self, now: float) -> int:
        """Ticks to be made now, so that the next one lies in the future; they count as done."""
        ticks = max(0, self._owed(now))
        most = round(LONGEST_LAG / self.T)
        if ticks > most:
            self.overruns += 1
            self.lost += (ticks - most) * self.T
            ticks = most
        self.done += ticks
        return ticks

    def factor(self, now: float) -> float:
        """Simulated over clock time: 1 where nothing was lost."""
        elapsed = now - self.started
        return self.done * self.T / elapsed if elapsed > self.T else 1.0

    def _owed(self, now: float) -> int:
        # a clock that is a rounding error short of a tick has reached it
        return int((now - self.started - self.lost) / self.T + 1e-6) - self.done
