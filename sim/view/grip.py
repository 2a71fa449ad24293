"""The mouse as a hand: a spring and a damper between the handle and the point that the mouse drags.

It is part of the plant, so it is held exactly and is as passive as any other human: a certificate that covers every
passive human covers this one. Only its end moves with the mouse, as in a voluntary motion. A force computed from one
picture to the next would be no such hand: it comes too late, and sets a certified loop in motion by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

from controller.lti import Array
from models.scene import Plant, Scene, plant
from sim.engines import HeldPlant, hold

STIFFNESS, DAMPING = 200.0, 3.0  # [N/m], [N s/m]: as firm as the hands of the default scenario


@dataclass(frozen=True)
class Grip:
    """Which handle is held, and where it is drawn to."""

    channel: int  # counted from 0
    target: float  # [m] displacement of the handle

    @property
    def pull(self) -> float:
        """Force [N] of the hand on a handle that rests at 0."""
        return STIFFNESS * self.target

    def force(self, scene: Scene, s: Array) -> float:
        """Force [N] of the hand on the handle in the plant state s, positions and velocities."""
        joint, n = scene.handles[self.channel], scene.model.nq
        return self.pull - STIFFNESS * float(s[joint]) - DAMPING * float(s[n + joint])


def gripped(scene: Scene, channel: int, T: float) -> HeldPlant:
    """The plant with the hand's spring and damper on a handle, its end at rest."""
    free, joint, n = plant(scene.model), scene.handles[channel], scene.model.nq
    A, at_handle = free.A.copy(), free.B[:, scene.tapped[channel]]
    A[:, joint] -= STIFFNESS * at_handle
    A[:, n + joint] -= DAMPING * at_handle
    return hold(Plant(A, free.B, free.C), T)
