"""What an ideal environment would have done: the force of Lambda E for the displacements that a run measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.delay import delay
from controller.lti import Array, Lti
from sim.loop import Record
from sim.simulate import Assembly


@dataclass(frozen=True, eq=False)
class Likeness:
    """Two answers to the same displacements, from rest at t = 0 and over the whole run, before any force limit."""

    asked: Array  # (N, m) what the coupled loop asks of the motors, F x [N]
    ideal: Array  # (N, m) what the delay-matched environment itself would ask, Lambda E x [N]
    reason: str | None = None  # why the two cannot be compared

    def part(self) -> dict[str, Any]:
        """rms(asked - ideal)/rms(ideal) in percent, over all ticks and channels; None with a reason where undefined."""
        asked, ideal, apart = _rms(self.asked), _rms(self.ideal), _rms(self.asked - self.ideal)
        part: dict[str, Any] = {"error_percent": None, "asked_rms_n": asked, "ideal_rms_n": ideal}
        if self.reason:
            return part | {"ideal_rms_n": None, "reason": self.reason}
        if not np.isfinite([asked, ideal, apart]).all():
            return part | {"asked_rms_n": None, "ideal_rms_n": None, "reason": "the run left the range of numbers"}
        if ideal == 0:
            return part | {"reason": "the ideal environment would have rendered no force"}
        return part | {"error_percent": 100 * apart / ideal}


def likeness(assembly: Assembly, record: Record, lam: Sequence[int]) -> Likeness:
    """The run's forces before their limits, and those of Lambda E, for the displacements that the encoders gave.

    Where delays switch, the forces are those that arrived, within their limits. Of walls there is no linear ideal.
    """
    process = assembly.process
    x = process.measured(record.s[:, : process.channels, 0])
    if process.contact:
        return Likeness(record.f[:, :, 0], record.f[:, :, 0], "walls have no linear ideal to compare with")
    F = process.F
    asked = record.f[:, :, 0] if process.delays is not None else record.z[:, :, 0] @ F.C.T + x @ F.D.T
    return Likeness(asked, response(delay(lam, F.T) @ assembly.E, x))


def response(G: Lti, x: Array) -> Array:
    """y = G x from rest; x (N, inputs), y (N, outputs)."""
    states = np.zeros((x.shape[0] + 1, G.order))
    driven = x @ G.B.T
    with np.errstate(over="ignore", invalid="ignore"):  # an unstable run may leave the range of numbers
        for k in range(x.shape[0]):
            states[k + 1] = G.A @ states[k] + driven[k]
        return states[:-1] @ G.C.T + x @ G.D.T


def _rms(f: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(f**2))) if f.size else 0.0
