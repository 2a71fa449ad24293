"""The gains that a K-B map is drawn at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from sim.scenario import InputError
from sim.zwidth.loop import MapLoop

#: what gains may be, as in design.audit: within these, all arithmetic is far from overflow
STIFFNESSES, DAMPINGS = (1e-3, 1e9), (0.0, 1e6)
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Grid:
    """Every K with every B."""

    K: Array  # (n,) [N/m]
    B: Array  # (n,) [N s/m]
    scale: str  # linear | log

    @property
    def shape(self) -> tuple[int, int]:
        return self.K.size, self.B.size

    @property
    def flat(self) -> tuple[Array, Array]:
        """K and B of every point, (n n,): B runs fastest."""
        K, B = np.meshgrid(self.K, self.B, indexing="ij")
        return K.ravel(), B.ravel()

    def subset(self, count: int) -> NDArray[np.intp]:
        """(k,) flat indices of `count` rows and columns at most, evenly spread, with the corners."""
        rows, columns = (np.unique(np.round(np.linspace(0, n - 1, min(count, n))).astype(int)) for n in self.shape)
        return (rows[:, None] * self.shape[1] + columns).ravel()


def make_grid(
    ground: MapLoop, n: int, K: Range | None, B: Range | None, scale: str | None, marks: tuple[Range, ...] = ()
) -> Grid:
    """n x n gains. Ranges that are not given come from the loop, and make room for the marks.

    K is about the loop's stiffness_scale, B about delta, the most that a linear law may damp. A linear map goes up to
    2.5 times these, a logarithmic one from far below to far above. Raises InputError.
    """
    scale = scale or ground.usual_scale
    stiff, most = ground.stiffness_scale, max(ground.delta)
    if scale == "linear":
        wide = (2.5 * stiff / n, 2.5 * stiff), (0.0, 2.5 * most)
    else:
        wide = (stiff / 30, stiff * 30), (most / 100, most * 10)
    of_marks = tuple(zip(*marks, strict=True)) if marks else ((), ())
    ends = []
    for name, given, usual, allowed, marked in zip("KB", (K, B), wide, (STIFFNESSES, DAMPINGS), of_marks, strict=True):
        low, high = given or _with_room(usual, marked)
        _check(name, low, high, allowed, scale)
        for mark in marked:
            if given and not low <= mark <= high:
                raise InputError(f"--mark has {name} = {mark:g}, outside --{name}-range {low:g},{high:g}")
        ends.append((low, high))
    spread = np.linspace if scale == "linear" else np.geomspace
    along_K, along_B = (spread(low, high, n) for low, high in ends)
    return Grid(along_K, along_B, scale)


def _with_room(usual: Range, marked: Sequence[float]) -> Range:
    """The range, widened so that marks lie well inside; a mark at 0 stays on the edge of a logarithmic map."""
    low, high = usual
    return min([low, *(mark / 1.1 for mark in marked if mark > 0)]), max([high, *(1.1 * mark for mark in marked)])


def _check(name: str, low: float, high: float, allowed: Range, scale: str) -> None:
    option, unit = f"--{name}-range", "N/m" if name == "K" else "N s/m"
    if not (allowed[0] <= low and high <= allowed[1]):
        raise InputError(f"{option} is {low:g},{high:g}, allowed are {allowed[0]:g} to {allowed[1]:g} {unit}")
    if not low < high:
        raise InputError(f"{option} is {low:g},{high:g}, expected the lower end first")
    if scale == "log" and low == 0:
        raise InputError(f"{option} begins at 0, which a logarithmic map cannot show; use --scale linear")
