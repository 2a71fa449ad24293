"""Whether a device that drives still ticks every T: the certificate is for T, and every ramp and limit counts ticks.

Two clocks are compared with the number of ticks: the device's own, to 1 %, and the host's, to 10 %, which a busy host
and its buffers blur; a device that computes its clock from its ticks is found by the second one only.
"""

from __future__ import annotations

from dataclasses import dataclass

from hw.frame import State
from hw.safety import Fault, Limits

DEVICE_TOLERANCE, HOST_TOLERANCE = 0.01, 0.1
BLOCK = 200  # ticks over which a clock is compared


@dataclass
class Pace:
    """One clock against ticks of `T_us`, in blocks, each without its longest delay: a freeze is no drift."""

    whose: str
    T_us: float
    tolerance: float  # part of a block
    forgiven_us: float  # longest freeze that is left out
    _last: int | None = None
    _ticks: int = 0
    _behind: float = 0.0  # [us] of the clock beyond ticks * T
    _freeze: float = 0.0  # [us] the longest single part of it

    def note(self, at_us: int, ticks: int) -> None:
        """The clock shows `at_us` (modulo 2^32), `ticks` after the call before. Raises Fault where it drifts."""
        if self._last is not None:
            elapsed = (at_us - self._last + 2**31) % 2**32 - 2**31
            late = elapsed - ticks * self.T_us
            self._behind += late
            self._freeze = min(self.forgiven_us, max(self._freeze, late))
            self._ticks += ticks
            drift = self._behind - max(0.0, min(self._freeze, self._behind))
            if abs(drift) > self.tolerance * BLOCK * self.T_us:
                lasts = self.T_us + drift / self._ticks
                what = f"over {self._ticks} tick{'s' if self._ticks > 1 else ''}, T is {self.T_us:g} us"
                raise Fault(f"a tick of the device lasts {lasts:.4g} us by {self.whose} clock {what}")
            if self._ticks >= BLOCK:
                self._ticks, self._behind, self._freeze = 0, 0.0, 0.0
        self._last = at_us


class Clock:
    """Both clocks, and the number of the tick, while forces act."""

    def __init__(self, limits: Limits, T: float) -> None:
        T_us = 1e6 * T
        self.most = max(1, int(limits.watchdog_us / T_us))  # [ticks] that may be missing at once
        self._device = Pace("its own", T_us, DEVICE_TOLERANCE, limits.watchdog_us)
        self._host = Pace("the host's", T_us, HOST_TOLERANCE, limits.watchdog_us)

    def check(self, state: State, ticks: int, now: int) -> None:
        """Raise Fault where the STATE that came at `now` [us] cannot be `ticks` after the one before."""
        if ticks > self.most:
            raise Fault(f"the tick number leapt by {ticks}, the watchdog allows {self.most}")
        self._device.note(state.t_us, ticks)
        self._host.note(now, ticks)
