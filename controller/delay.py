"""The times at which forces act: delays, constant or varying, lost packets, varying periods, and late forces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.arithmetic import Number
from haptic_loop.controller.lti import Array, Lti, frozen, taps

# ----------------------------------------------------------------------------------------------------
# Constant delays are linear blocks, Theta, Psi and Lambda, equations (4), (5) and (7) of the paper. Varying delays are
# simulated by `HeldLine`:
#
#         tick k     packet k is sent with the force g[k]; it arrives after delays[k] ticks, or is LOST
#                    the device applies the newest packet that has arrived: f[k] = g[j], j = max{j : j + delays[j] <= k}
#                    without a newer packet it holds f[k] = f[k-1]; before the first arrival f[k] = 0
#
# If no packet is lost, the age k - j of the force in use lies between the least and the largest delay, for any order of
# arrival. The age grows by at most one per tick.


Ticks = NDArray[np.int64]

MOST_SAMPLES = 1000  # [samples] longest delay of a channel; every sample adds a state
LOST = -1  # the delay of a packet that never arrives


def delay(steps: Sequence[int], T: Number) -> Lti:
    """Return blockdiag(z^-n_1, ..., z^-n_m) in the arithmetic of T."""
    return _chains(tuple((0,) * int(n) + (1,) for n in steps), T)


def moving_sum(steps: Sequence[int], T: Number) -> Lti:
    """Return diag(1 + 1/z + ... + z^-n_i) in the arithmetic of T."""
    return _chains(tuple((1,) * (n + 1) for n in steps), T)


@lru_cache(maxsize=256, typed=True)  # typed, because the type of the period decides the arithmetic
def _chains(weights: tuple[tuple[int, ...], ...], T: Number) -> Lti:
    """Return the taps of each channel from a cache, because loops are often evaluated with the same delays."""
    return Lti.diag(*(taps(each, T) for each in weights))


def _newest(delays: Ticks) -> Ticks:
    """Return the number of the packet in use at every tick (ticks, m, nsim); -1 before the first arrival."""
    ticks = delays.shape[0]
    sent = np.arange(ticks)[:, None, None]
    there = np.full(delays.shape, -1)
    for n in np.unique(delays[delays != LOST]):
        arrived = np.where(delays == n, sent, -1)[: max(ticks - n, 0)]
        np.maximum(there[n:], arrived, out=there[n:])
    return np.maximum.accumulate(there, axis=0)


def ages(delays: Ticks) -> Ticks:
    """Return the age k - j of the force in use at every tick (ticks, m, nsim); -1 before the first arrival."""
    packet = _newest(delays)
    return np.where(packet >= 0, np.arange(delays.shape[0])[:, None, None] - packet, -1)


def realising(wanted: Ticks) -> Ticks:
    """Return packet delays (ticks, ..) with which the device uses forces of the `wanted` ages (ticks, ..).

    A packet that the device never uses arrives together with the next used packet, or after the last tick. No delay
    exceeds the largest wanted age. Raises ValueError if an age grows by more than one in a tick.
    """
    ticks = wanted.shape[0]
    packet = np.arange(ticks).reshape(-1, *(1,) * (wanted.ndim - 1)) - wanted
    if (np.diff(packet, axis=0) < 0).any():
        raise ValueError("ages grow by more than one in a tick: a device does not return to an older force")
    delays = np.empty_like(wanted)
    for column in np.ndindex(*wanted.shape[1:]):
        used = packet[(slice(None), *column)]
        # Packet j arrives at the first tick that uses packet j or a newer one.
        delays[(slice(None), *column)] = np.searchsorted(used, np.arange(ticks)) - np.arange(ticks)
    late = np.arange(ticks).reshape(packet.shape[0], *(1,) * (wanted.ndim - 1)) + delays >= ticks
    return np.where(late, wanted.max(axis=0), delays)


class HeldLine:
    """A delay line with a hold for the forces to the devices, in any number of simulations."""

    def __init__(self, delays: Ticks, nsim: int) -> None:
        """Start a line with `delays` (ticks, m, nsim or 1) [samples]."""
        ticks, m, _ = delays.shape
        packet = np.broadcast_to(_newest(delays), (ticks, m, nsim))
        before = np.concatenate([np.full((1, m, nsim), -1), packet[:-1]])
        self._fresh = packet != before
        depth = int(delays.max(initial=0)) + 1
        self._sent = np.zeros((depth, m, nsim))
        self._place = (packet % depth) * (m * nsim) + np.arange(m * nsim).reshape(m, nsim)
        self._held = np.zeros((m, nsim))

    def carry(self, k: int, force: Array) -> None:
        """Replace `force` (m, nsim) of tick k by the force that acts."""
        self._sent[k % self._sent.shape[0]] = force
        np.copyto(self._held, self._sent.take(self._place[k]), where=self._fresh[k])
        force[...] = self._held


_Pattern = Literal["constant", "random", "bursty", "adversarial", "recorded"]


class VaryingDelay(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Delays of the forces, between lo and hi [samples], for every packet and channel."""

    lo: tuple[int, ...]  # (m,) [samples]
    hi: tuple[int, ...]  # (m,) [samples]
    pattern: _Pattern = "random"
    loss: float = 0.0  # probability that a packet is lost, independent of the others
    playout: bool = False  # whether a buffer in the device applies every packet at age hi
    calm: float = 20.0  # bursty: mean number of successive packets with the delay lo
    burst: float = 5.0  # bursty: mean number of successive packets with longer delays
    recorded: tuple[tuple[int, ...], ...] = ()  # [samples] a row of delays (m,) per packet, repeated; -1: lost

    def __post_init__(self) -> None:
        if len(self.lo) != len(self.hi):
            lengths = f"varying_delay.lo has {len(self.lo)} entries and varying_delay.hi {len(self.hi)}"
            raise ValueError(f"{lengths}: give one each per channel")
        for i, (lo, hi) in enumerate(zip(self.lo, self.hi, strict=True)):
            if not 0 <= lo <= hi <= MOST_SAMPLES or lo % 1 or hi % 1:
                expected = f"expected whole numbers of samples, 0 <= lo <= hi <= {MOST_SAMPLES}"
                raise ValueError(f"varying_delay on channel {i + 1} is {lo} to {hi}, {expected}")
        if not 0 <= self.loss <= 1:
            raise ValueError(f"varying_delay.loss is {self.loss:g}, allowed are probabilities 0 to 1")
        for name in ("calm", "burst"):
            if not 1 <= getattr(self, name) <= 1e6:
                value = f"{getattr(self, name):g}"
                raise ValueError(f"varying_delay.{name} is {value}, allowed are mean lengths 1 to 1e6 packets")
        if (self.pattern == "recorded") != bool(self.recorded):
            raise ValueError("varying_delay: recorded and pattern = 'recorded' go together: give both or neither")
        for k, row in enumerate(self.recorded):
            self._check_packet(k, row)

    def _check_packet(self, k: int, row: tuple[int, ...]) -> None:
        if len(row) != len(self.lo):
            raise ValueError(f"varying_delay.recorded, packet {k}: {len(row)} delays for {len(self.lo)} channels")
        for i, n in enumerate(row):
            if n != LOST and (n % 1 or not self.lo[i] <= n <= self.hi[i]):
                allowed = f"{self.lo[i]} to {self.hi[i]} samples, or {LOST} for a lost packet"
                raise ValueError(f"varying_delay.recorded, packet {k}, channel {i + 1}: delay {n}, allowed {allowed}")

    @property
    def channels(self) -> int:
        return len(self.lo)

    @property
    def steady(self) -> bool:
        """Whether the delay of each channel is constant, so that certificates for constant delays hold."""
        lossless = self.loss == 0 and not any(LOST in row for row in self.recorded)
        return lossless and (self.playout or self.pattern == "constant" or self.lo == self.hi)

    def draw(self, rng: np.random.Generator, ticks: int, given: ArrayLike | None = None) -> Ticks:
        """Draw the delays (ticks, m) of the packets of one run, in samples or LOST.

        The patterns "constant" and "adversarial" depend on the loop and repeat the delays `given` (rows, m): theta for
        "constant", and the worst sequence of a search for "adversarial". Raises ValueError if `given` is missing.
        """
        delays = self._delays(rng, ticks, given)
        lost = (delays == LOST) | (rng.random(delays.shape) < self.loss)
        return np.where(lost, LOST, np.array(self.hi) if self.playout else delays)

    def _delays(self, rng: np.random.Generator, ticks: int, given: ArrayLike | None) -> Ticks:
        lo, hi = np.array(self.lo), np.array(self.hi)
        match self.pattern:
            case "random":
                return rng.integers(lo, hi, size=(ticks, lo.size), endpoint=True)
            case "bursty":
                late = rng.integers(np.minimum(lo + 1, hi), hi, size=(ticks, lo.size), endpoint=True)
                return np.where(self._bursts(rng, ticks), late, lo)
            case "recorded":
                return np.resize(np.array(self.recorded, dtype=np.int64), (ticks, lo.size))
            case "constant" | "adversarial":
                if given is None:
                    raise ValueError(f"the {self.pattern} pattern needs the delays of the loop: pass them as `given`")
                return np.resize(np.asarray(given, dtype=np.int64), (ticks, lo.size))

    def _bursts(self, rng: np.random.Generator, ticks: int) -> NDArray[np.bool_]:
        """Return whether each packet (ticks, m) is in a burst. Calms and bursts alternate, with geometric lengths."""
        count = 1 + int(2 * ticks / (self.calm + self.burst)) + 8 * int(np.sqrt(ticks) + 1)
        columns = []
        for _ in self.lo:
            lengths = np.column_stack([rng.geometric(1 / self.calm, count), rng.geometric(1 / self.burst, count)])
            state = np.repeat(np.tile([False, True], count), lengths.ravel())
            columns.append(np.resize(state, ticks))
        return np.column_stack(columns)


# ----------------------------------------------------------------------------------------------------
# Periods may vary, and forces may latch late. Tick k measures x[k] at its beginning and lasts T_k. The force f_i[k]
# acts from the latch time late[k, i] after this beginning. Until then f_i[k-1] acts.

_PERIODS, _LATENCIES = 9, 3  # numbers of values drawn from a range, small so that matrix exponentials can be cached


class Periods(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Lengths of the periods: drawn for every tick between `min` and `max`, or a recorded list that is repeated."""

    min: float | None = None  # [s]
    max: float | None = None  # [s]
    recorded: tuple[float, ...] = ()  # [s]

    def __post_init__(self) -> None:
        if bool(self.recorded) == (self.min is not None or self.max is not None):
            raise ValueError("give either min and max, or recorded")
        if self.recorded:
            wrong = [T for T in self.recorded if not 1e-6 <= T <= 0.1]
            if wrong:
                raise ValueError(f"period.recorded has {wrong[0]:g} s, allowed are 1e-06 to 0.1 s")
        elif self.min is None or self.max is None or not 1e-6 <= self.min <= self.max <= 0.1:
            values = ", ".join("none" if T is None else f"{T:g} s" for T in (self.min, self.max))
            raise ValueError(f"period.min, period.max are {values}, expected 1e-06 <= min <= max <= 0.1 s")

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
        """Draw the periods (ticks,) [s]."""
        if self.recorded:
            return np.resize(np.array(self.recorded), ticks)
        return rng.choice(np.linspace(self.shortest, self.longest, _PERIODS), ticks)


@dataclass(frozen=True, eq=False)
class Timing:
    """The length and the latch times of every tick; a longer run repeats them."""

    period: Array  # (ticks,) [s]
    late: Array | None  # (ticks, m) latch times [s] from the tick's beginning, below its period; None: all are 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", frozen(self.period, 1, "period"))
        if self.late is not None:
            object.__setattr__(self, "late", frozen(self.late, 2, "late"))

    @cached_property
    def _table(self) -> tuple[Array, NDArray[np.intp]]:
        rows = self.period[:, None] if self.late is None else np.column_stack([self.period, self.late])
        kinds, which = np.unique(rows, axis=0, return_inverse=True)
        return kinds, which.reshape(-1)

    @property
    def kinds(self) -> list[tuple[float, tuple[float, ...] | None]]:
        """The different kinds of ticks, as (period, latch time of each channel) [s]."""
        return [(float(row[0]), None if self.late is None else tuple(row[1:].tolist())) for row in self._table[0]]

    @property
    def which(self) -> list[int]:
        """The index (ticks,) in `kinds` of every tick."""
        return self._table[1].tolist()

    @property
    def steady(self) -> bool:
        """Whether all ticks are of one kind, so that the loop has eigenvalues."""
        return len(self._table[0]) == 1

    def times(self, first: int, ticks: int) -> Array:
        """Return the times (ticks,) [s] at which ticks first .. first + ticks - 1 begin."""
        ends = np.cumsum(self.period)
        k = np.arange(first, first + ticks)
        begins = np.concatenate([[0.0], ends[:-1]])
        return k // len(ends) * ends[-1] + begins[k % len(ends)]


def draw_timing(
    T: float,
    periods: Periods | None,
    latency: Sequence[tuple[float, float]] | None,
    ticks: int,
    rng: np.random.Generator,
) -> Timing | None:
    """Draw a timing of `ticks` ticks; return None if neither `periods` nor `latency` is given.

    A latency is drawn for each tick and channel from the ends and the middle of its range.
    """
    if periods is None and latency is None:
        return None
    period = periods.draw(rng, ticks) if periods else np.full(ticks, T)
    late = None
    if latency is not None:
        late = np.column_stack([rng.choice(np.linspace(*span, _LATENCIES), ticks) for span in latency])
    return Timing(period, late)
