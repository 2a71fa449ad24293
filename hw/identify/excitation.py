"""A force that does not depend on the motion: a chirp, then silence. What a device is identified with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.lti import Array, frozen
from hw.law import Controller

LEAD = 0.3  # [s] of zero force, in which the gain comes up


@dataclass(frozen=True, eq=False)
class Excitation:
    """Forces fed back over time, as a program for a session. Open loop: it can make no passive person unstable."""

    signal: Array  # (ticks, m) [N]
    T: float  # [s]
    link: int  # [ticks]

    def __post_init__(self) -> None:
        object.__setattr__(self, "signal", frozen(self.signal, 2))

    @property
    def certified(self) -> bool:
        """A force that the motion does not change closes no loop."""
        return True

    @property
    def name(self) -> str:
        return f"open-loop force of at most {np.abs(self.signal).max():g} N"

    @property
    def seconds(self) -> float:
        return len(self.signal) * self.T

    def controller(self) -> Controller:
        return _Player(self)


class _Player:
    """Plays an excitation tick by tick, then zero."""

    def __init__(self, excitation: Excitation) -> None:
        self.T = excitation.T
        self._signal, self._k = excitation.signal, 0

    def step(self, x: Sequence[float]) -> Array:
        k, self._k = self._k, self._k + 1
        return self._signal[k] if k < len(self._signal) else np.zeros(len(x))


def chirp(
    channels: int, T: float, link: int, amplitude: float, band: tuple[float, float], seconds: float
) -> Excitation:
    """A cosine [N] whose frequency rises exponentially through `band` [Hz], then half as long without force.

    It begins with a cosine so that a free mass does not drift away.
    """
    t = np.arange(round(seconds / T)) * T
    low, high = band
    rate = np.log(high / low) / seconds
    wave = amplitude * np.cos(2 * np.pi * low * np.expm1(rate * t) / rate)
    lead, tail = np.zeros(round(LEAD / T)), np.zeros(round(seconds / 2 / T))
    return Excitation(np.tile(np.concatenate([lead, wave, tail])[:, None], channels), T, link)
