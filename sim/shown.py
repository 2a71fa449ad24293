"""The data that a picture of a run shows. sim.plots draws it, possibly in another process (cli.painter)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from haptic_loop.controller.lti import Array


class Signals(NamedTuple):
    """The part of a trace that a picture shows: N samples of m channels."""

    t: Array  # (N,) [s]
    x: Array  # (N, m) [m] displacements at the encoders
    f: Array  # (N, m) [N] forces fed back
    x_handle: Array  # (N, m) [m] displacements of the handles
    names: tuple[str, ...]  # (m,) names of the channels; () if they are only numbered


@dataclass(frozen=True, eq=False)
class Contacts:
    """The contacts in a picture: names, places of walls, and the ticks at which a wall is touched."""

    names: Sequence[str] = ()  # (m,) names of the channels; if empty, they are called "device 1", "device 2", ..
    walls: Sequence[tuple[int, float, str]] = ()  # channel (from 0), position [m] and name of each wall on ground
    touching: NDArray[Any] | None = None  # (N,) whether any wall is touched

    def name(self, i: int) -> str:
        return self.names[i] if self.names else f"device {i + 1}"


@dataclass(frozen=True)
class Onset:
    """The onset of an oscillation: its predicted growth, and the time up to which the run is credible."""

    growth: float | None  # [1/s] growth predicted by the eigenvalues; None if no mode grows
    steady: int  # number of ticks before the first clipped force
    until: float | None = None  # [s] time at which the motion leaves the devices' credible limits; None if never
