"""When ticks begin and when forces latch, where neither is at k T: periods that vary, forces that come late.

A tick k takes x[k] at its beginning and lasts T_k. The force f_i[k] that is computed from it acts from tau_i[k] after
that beginning on; until then f_i[k-1] does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, frozen

_PERIODS, _LATENCIES = 9, 3  # evenly spaced values that are drawn of each range, its ends among them: maps are kept


class Periods(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lengths of the periods: between two of them, drawn anew at every tick, or a recorded list, repeated."""

    min: float | None = None  # [s]
    max: float | None = None  # [s]
    recorded: tuple[float, ...] = ()  # [s]

    def __post_init__(self) -> None:
        if bool(self.recorded) == (self.min is not None or self.max is not None):
            raise ValueError("period is either min and max or recorded: give one of them")
        if self.recorded:
            wrong = [T for T in self.recorded if not 1e-6 <= T <= 0.1]
            if wrong:
                raise ValueError(f"period.recorded has {wrong[0]:g} s, allowed are 1e-06 to 0.1 s")
        elif self.min is None or self.max is None or not 1e-6 <= self.min <= self.max <= 0.1:
            came = ", ".join("none" if T is None else f"{T:g} s" for T in (self.min, self.max))
            raise ValueError(f"period.min, period.max are {came}, expected 1e-06 <= min <= max <= 0.1 s")

    @property
    def shortest(self) -> float:
        return min(self.recorded) if self.min is None else self.min

    @property
    def longest(self) -> float:
        return max(self.recorded) if self.max is None else self.max

    @property
    def mean(self) -> float:
        return sum(self.recorded) / len(self.recorded) if self.recorded else (self.shortest + self.longest) / 2

    def draw(self, rng: np.random.Generator, ticks: int) -> Array:
        """(ticks,) [s]"""
        if self.recorded:
            return np.resize(np.array(self.recorded), ticks)
        return rng.choice(np.linspace(self.shortest, self.longest, _PERIODS), ticks)


@dataclass(frozen=True, eq=False)
class Timing:
    """Length and latch times of every tick; a longer run begins anew."""

    period: Array  # (ticks,) [s]
    late: Array | None  # (ticks, m) [s] after the tick's beginning, below its period; None where forces latch at ticks

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", frozen(self.period, 1, "period"))
        if self.late is None:
            return
        late = frozen(self.late, 2, "late")
        object.__setattr__(self, "late", late)
        if len(late) != len(self.period) or not ((late >= 0) & (late < self.period[:, None])).all():
            raise ValueError("late: forces must latch within the period of their tick")

    @cached_property
    def _table(self) -> tuple[Array, NDArray[np.intp]]:
        rows = self.period[:, None] if self.late is None else np.column_stack([self.period, self.late])
        kinds, which = np.unique(rows, axis=0, return_inverse=True)
        return kinds, which.reshape(-1)

    @property
    def kinds(self) -> list[tuple[float, tuple[float, ...] | None]]:
        """The ticks that differ: (period, latch time of each channel) [s]."""
        return [(float(row[0]), None if self.late is None else tuple(row[1:].tolist())) for row in self._table[0]]

    @property
    def which(self) -> list[int]:
        """(ticks,) the place of every tick among `kinds`."""
        return self._table[1].tolist()

    @property
    def steady(self) -> bool:
        """Whether every tick is like the first one: then the loop has eigenvalues."""
        return len(self._table[0]) == 1

    def times(self, first: int, ticks: int) -> Array:
        """[s] when ticks first .. first + ticks - 1 begin, (ticks,)."""
        ends = np.cumsum(self.period)
        k = np.arange(first, first + ticks)
        begins = np.concatenate([[0.0], ends[:-1]])
        return k // len(ends) * ends[-1] + begins[k % len(ends)]


def drawn(
    T: float,
    periods: Periods | None,
    latency: Sequence[tuple[float, float]] | None,
    ticks: int,
    rng: np.random.Generator,
) -> Timing | None:
    """A timing of `ticks` ticks; None where all are even and forces latch at their beginning.

    A latency is drawn for each tick and channel from the ends and the middle of its range.
    """
    if periods is None and latency is None:
        return None
    period = periods.draw(rng, ticks) if periods else np.full(ticks, T)
    late = None
    if latency is not None:
        late = np.column_stack([rng.choice(np.linspace(*span, _LATENCIES), ticks) for span in latency])
    return Timing(period, late)
