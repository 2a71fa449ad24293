"""What a K-B map asks of the loop it is about, whatever K and B are gains of."""

from __future__ import annotations

from typing import Protocol

from controller.environment import Network
from controller.gains import Gains, Stack
from controller.lti import Array
from controller.process import Process
from design.margin import Requirement
from models.device import Device
from models.human import Population


class MapLoop(Protocol):
    """ground.Ground: K and B of the coupling; surroundings.Surroundings: K and B of the environment."""

    @property
    def devices(self) -> tuple[Device, ...]: ...
    @property
    def population(self) -> Population: ...
    @property
    def network(self) -> Network | None: ...  # None is a rigid wall behind the coupling
    @property
    def walled(self) -> Network | None: ...  # the network whose contact is made and broken, if there is one
    @property
    def T(self) -> float: ...  # [s]
    @property
    def theta(self) -> tuple[int, ...]: ...  # (m,) [samples]
    @property
    def psi(self) -> tuple[int, ...]: ...  # (m,) [samples]
    @property
    def cutoff(self) -> float | None: ...  # [Hz] of the velocity filter
    @property
    def channels(self) -> int: ...
    @property
    def delta(self) -> tuple[float, ...]: ...  # (m,) [N s/m]
    @property
    def usual_scale(self) -> str: ...  # linear | log
    @property
    def stiffness_scale(self) -> float: ...  # [N/m] that the axis is chosen around
    @property
    def conditions(self) -> tuple[str, ...]: ...  # what is asked of every cell
    @property
    def refusals(self) -> dict[str, str]: ...  # conditions that say nothing of any cell, and why

    def gains(self, K: Array, B: Array) -> Gains:
        """n points of the map, (n,) each."""
        ...

    def force_maps(self, gains: Gains) -> tuple[Stack, ...]:
        """F at every point, for each frozen contact state."""
        ...

    def process(self, gains: Gains, i: int, devices: tuple[Device, ...]) -> Process:
        """What the computer does every T at point i."""
        ...

    def ratios(self, condition: str, gains: Gains) -> Array:
        """Required over available damping, (n,); inf where no damping is enough."""
        ...

    def requirement(self, condition: str, K: float, B: float) -> Requirement:
        """The same at one point, by design.margin."""
        ...
