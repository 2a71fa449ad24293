"""How delays vary on the way to the devices: ranges, switching patterns, lost packets, the playout buffer."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.delay import LOST, Ticks

Pattern = Literal["constant", "random", "bursty", "adversarial", "recorded"]

LONGEST = 1000  # [samples]


class Jitter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Delays of the forces, lo to hi [samples] per channel, drawn anew for every packet."""

    lo: tuple[int, ...]  # (m,) [samples]
    hi: tuple[int, ...]  # (m,) [samples]
    pattern: Pattern = "random"
    loss: float = 0.0  # probability that a packet is lost, each by itself
    playout: bool = False  # the device applies every packet at age hi, so that what arrives is delayed constantly
    calm: float = 20.0  # bursty: mean length of a stretch at lo [packets]
    burst: float = 5.0  # bursty: mean length of a stretch at more than lo [packets]
    recorded: tuple[tuple[int, ...], ...] = ()  # delays of packets 0, 1, .. [samples] by channel, repeated; -1 is lost

    def __post_init__(self) -> None:
        if len(self.lo) != len(self.hi):
            raise ValueError(f"jitter.lo has {len(self.lo)} entries and jitter.hi {len(self.hi)}: one each per channel")
        for i, (lo, hi) in enumerate(zip(self.lo, self.hi, strict=True)):
            if not 0 <= lo <= hi <= LONGEST:
                raise ValueError(
                    f"jitter on channel {i + 1} is {lo} to {hi}, expected 0 <= lo <= hi <= {LONGEST} samples"
                )
        if not 0 <= self.loss <= 1:
            raise ValueError(f"jitter.loss is {self.loss:g}, allowed are probabilities 0 to 1")
        for name in ("calm", "burst"):
            if not 1 <= getattr(self, name) <= 1e6:
                raise ValueError(f"jitter.{name} is {getattr(self, name):g}, allowed are mean lengths 1 to 1e6 packets")
        if (self.pattern == "recorded") != bool(self.recorded):
            raise ValueError("jitter.recorded and jitter.pattern = 'recorded' go together: give both or neither")
        for k, row in enumerate(self.recorded):
            self._check_packet(k, row)

    def _check_packet(self, k: int, row: tuple[int, ...]) -> None:
        if len(row) != len(self.lo):
            raise ValueError(f"jitter.recorded, packet {k}: {len(row)} delays for {len(self.lo)} channels")
        for i, n in enumerate(row):
            if n != LOST and not self.lo[i] <= n <= self.hi[i]:
                allowed = f"{self.lo[i]} to {self.hi[i]} samples, or {LOST} for a lost packet"
                raise ValueError(f"jitter.recorded, packet {k}, channel {i + 1}: delay {n}, allowed are {allowed}")

    @property
    def channels(self) -> int:
        return len(self.lo)

    @property
    def steady(self) -> bool:
        """Whether every force is delayed by a constant theta after all: then Theta is linear, and certificates hold."""
        return self.loss == 0 and (self.playout or self.pattern == "constant" or self.lo == self.hi) and not self._gaps

    @property
    def _gaps(self) -> bool:
        return any(LOST in row for row in self.recorded)

    def draw(self, rng: np.random.Generator, ticks: int, given: ArrayLike | None = None) -> Ticks:
        """Delays of the packets of one run, (ticks, m), LOST among them.

        `given` are the rows (period, m), repeated, of the patterns that depend on the loop: theta for constant, what
        a search has found worst for adversarial. Raises ValueError where they are missing.
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
                    raise ValueError(f"the {self.pattern} pattern depends on the loop: give its delays")
                return np.resize(np.asarray(given, dtype=np.int64), (ticks, lo.size))

    def _bursts(self, rng: np.random.Generator, ticks: int) -> NDArray[np.bool_]:
        """(ticks, m) whether a packet is in a burst: two states per channel with geometric stretches, calm first."""
        count = 1 + int(2 * ticks / (self.calm + self.burst)) + 8 * int(np.sqrt(ticks) + 1)
        columns = []
        for _ in self.lo:
            lengths = np.column_stack([rng.geometric(1 / self.calm, count), rng.geometric(1 / self.burst, count)])
            state = np.repeat(np.tile([False, True], count), lengths.ravel())
            columns.append(np.resize(state, ticks))
        return np.column_stack(columns)
