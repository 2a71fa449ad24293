"""What is asked of the parameter Q of an optimal coupling, beside the specification of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.lti import Array
from design.argument import number, of_kind, one_of, whole
from design.specification import Specification

#: where the poles of the basis may lie, and which mismatch is minimised
FILTERS = ("auto", "fir", "slow", "mixed", "repeated", "adapted")
OBJECTIVES = ("rms", "sup")

MARGIN = 0.005  # share of the damping that stays unused
HIGH_GAIN = 1.5  # times the environment that the devices may feel at high frequency
FASTEST, SLOWEST = 0.5, 0.992  # poles of a slow basis
GRADED = 0.8, 0.998  # slow poles of a repeated basis
PLACE = 0.42  # where most poles of a long repeated basis are: the place that the descent finds in case II
SHORT = 16  # functions up to which auto takes taps for the rms mismatch; half as many for its supremum


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
        whole("functions", self.functions, 1, 200)
        one_of("filter", self.filter, FILTERS)
        one_of("objective", self.objective, OBJECTIVES)
        of_kind("diagonal", self.diagonal, bool, "True or False")
        if self.high_gain is not None and not number("high_gain", self.high_gain, "a factor, or None") >= 1:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not 0 < number("margin", self.margin) < 1:
            raise ValueError(f"margin is {self.margin}, allowed are shares of the damping above 0 and below 1")

    def poles(self, spec: Specification) -> Array:
        """Poles of the basis, (functions - 1,); those that an adapted basis starts from.

        fir: all at zero. slow: from 0.5 to 0.992, even in the logarithm of the time constant. mixed: a third at zero,
        the rest slow. repeated: most at one place, like Laguerre functions, and two of nine between 0.8 and 0.998
        (half of them where the request is hard). What auto means is in `kind`.
        """
        n, kind = self.functions - 1, self.kind(spec)
        if kind == "repeated":
            graded = n // 2 if _hard(spec, self) else round(2 * n / 9)
            place = round(min(PLACE, (n + 6) / 100), 2)
            return np.concatenate([np.full(n - graded, place), _graded(*GRADED, graded)])
        zero = {"fir": n, "slow": 0, "mixed": n // 3}[kind]
        return np.concatenate([np.zeros(zero), _graded(FASTEST, SLOWEST, n - zero)])

    def kind(self, spec: Specification) -> str:
        """The filter that auto, or the start of adapted, stands for.

        Hard is theta >= 3 or psi >= 1, which no short FIR filter can wait for, a set of environments, or delays that
        switch, which ask for more room: mixed. Otherwise fir, the best of these for few functions. repeated, which
        reaches both far in time and low in frequency, where there are more than a few.
        """
        if self.filter not in ("auto", "adapted"):
            return self.filter
        if self.functions > (SHORT if self.objective == "rms" or _hard(spec, self) else SHORT // 2):
            return "repeated"
        return "mixed" if _hard(spec, self) else "fir"


def _hard(spec: Specification, wish: Wish) -> bool:
    return max(spec.theta) >= 3 or any(spec.psi) or bool(spec.others) or bool(wish.switching)


def _graded(fastest: float, slowest: float, n: int) -> Array:
    """n poles, even in the logarithm of the time constant."""
    return np.round(1 - np.geomspace(1 - fastest, 1 - slowest, n), 6)
