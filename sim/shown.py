"""The data that a picture of a run shows. sim.plots draws it, possibly in another process (cli.painter)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from haptic_loop.controller.lti import Array


class Run(Protocol):
    """The part of a sim.trace.Trace that a picture shows; N samples, m channels."""

    @property
    def t(self) -> Array: ...  # (N,) [s]
    @property
    def x(self) -> Array: ...  # (N, m) [m]
    @property
    def f(self) -> Array: ...  # (N, m) [N]
    @property
    def x_handle(self) -> Array: ...  # (N, m) [m]
    @property
    def names(self) -> tuple[str, ...]: ...  # (m,) names of the channels; () if they are only numbered


class Signals(NamedTuple):
    """The signals of a Run alone, which are sent to another process."""

    t: Array
    x: Array
    f: Array
    x_handle: Array
    names: tuple[str, ...]

    @classmethod
    def of(cls, run: Run) -> Self:
        return cls(run.t, run.x, run.f, run.x_handle, run.names)


@dataclass(frozen=True, eq=False)
class Contacts:
    """The contacts in a picture: names, places of walls, and the ticks at which a wall is touched."""

    names: Sequence[str] = ()  # (m,) names of the channels; empty for "device 1", ..
    walls: Sequence[tuple[int, float, str]] = ()  # channel (from 0), position [m] and name of each wall on ground
    touching: NDArray[Any] | None = None  # (N,) whether any wall is touched

    def name(self, i: int) -> str:
        return self.names[i] if self.names else f"device {i + 1}"


@dataclass(frozen=True)
class Onset:
    """The onset of an oscillation: its predicted growth, and the time up to which the run is credible."""

    growth: float | None  # [1/s] growth predicted by the eigenvalues; None where nothing grows
    steady: int  # number of ticks before the first clipped one
    until: float | None = None  # [s] time at which the motion leaves the devices' credible limits; None if never
