"""What is asked of the parameter Q of an optimal coupling, beside the specification of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from design.designs import FILTERS, OBJECTIVES
from design.specification import Specification

MARGIN = 0.005  # share of the damping that stays unused
HIGH_GAIN = 1.5  # times the environment that the devices may feel at high frequency
FASTEST, SLOWEST = 0.5, 0.992  # poles of a slow basis


@dataclass(frozen=True)
class Wish:
    """What is asked of Q. Raises ValueError naming the field that is wrong."""

    functions: int = 8  # basis functions per entry of Q: taps, where the filter is FIR
    filter: str = "auto"  # where the poles of the basis are, see `poles`
    diagonal: bool = True
    objective: str = "rms"  # "rms" or "sup" of the mismatch over the band, relative to the environment
    high_gain: float | None = HIGH_GAIN
    margin: float = MARGIN
    switching: tuple[Sequence[int], Sequence[int]] | None = None  # (lo, hi) [samples]: ages of forces that may switch

    def __post_init__(self) -> None:
        if not 1 <= self.functions <= 200:
            raise ValueError(f"functions is {self.functions}, allowed are 1 to 200")
        if self.filter not in FILTERS:
            raise ValueError(f"filter is {self.filter!r}, allowed are {', '.join(FILTERS)}")
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective is {self.objective!r}, allowed are {', '.join(OBJECTIVES)}")
        if self.high_gain is not None and not self.high_gain >= 1:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not 0 < self.margin < 1:
            raise ValueError(f"margin is {self.margin}, allowed are shares of the damping above 0 and below 1")

    def poles(self, spec: Specification) -> Array:
        """Poles of the basis, (functions - 1,).

        fir: all at zero. slow: from 0.5 to 0.992, even in the logarithm of the time constant. mixed: a third at
        zero, the rest slow. auto: mixed where theta >= 3 or psi >= 1, which no short FIR filter can wait for, and for a
        set of environments or delays that switch, which ask for more room; else fir.
        """
        n = self.functions - 1
        hard = max(spec.theta) >= 3 or any(spec.psi) or bool(spec.others) or bool(self.switching)
        kind = ("mixed" if hard else "fir") if self.filter == "auto" else self.filter
        zero = {"fir": n, "slow": 0, "mixed": n // 3}[kind]
        slow = np.round(1 - np.geomspace(1 - FASTEST, 1 - SLOWEST, n - zero), 6)
        return np.concatenate([np.zeros(zero), slow])
