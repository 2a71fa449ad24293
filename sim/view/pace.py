"""Real time: how many ticks a clock has made due, and an honest count of what could not be made up."""

from __future__ import annotations

from dataclasses import dataclass

LONGEST_LAG = 0.1  # [s] what a window may make up in one go; more is dropped and counted


@dataclass
class Pace:
    """Ticks of T seconds against a clock that is read from outside and began at 0."""

    T: float  # [s]
    patience: float = LONGEST_LAG  # [s]
    done: int = 0  # ticks
    overruns: int = 0  # how often the loop fell behind by more than `patience`
    lost: float = 0.0  # [s] clock time that no tick was made for

    def due(self, now: float) -> int:
        """Ticks to be made now, so that the next one lies in the future; they count as done."""
        ticks = max(0, self._owed(now))
        most = self.patience / self.T
        if ticks > most:
            most = int(most)
            self.overruns += 1
            self.lost += (ticks - most) * self.T
            ticks = most
        self.done += ticks
        return ticks

    def factor(self, now: float) -> float:
        """Simulated over clock time: 1 where nothing was lost."""
        return self.done * self.T / now if now > self.T else 1.0

    def _owed(self, now: float) -> int:
        # a clock that is a rounding error short of a tick has reached it
        return int((now - self.lost) / self.T + 1e-6) - self.done
