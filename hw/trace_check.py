"""Whether what a trace file holds can be a session's: types, ranges, finite numbers. Asked before any of it is used."""

from __future__ import annotations

from typing import Any

import numpy as np

from controller.lti import Array
from sim.trace import Trace

FLOATS, WHOLE = ("asked", "gain"), ("tick", "arming", "sent", "margin_us", "status")
#: link array -> least and most that a session writes
RANGES = {"gain": (0.0, 1.0), "tick": (0, 0xFFFF), "sent": (-0x7FFF, 0x7FFF), "margin_us": (-0x8000, 0x7FFF)}


def complaint(result: Trace, link: dict[str, Array]) -> str | None:
    """What is wrong with a trace whose shapes are right; None where nothing is."""
    if not isinstance(result.meta, dict):
        return f"its metadata is a {type(result.meta).__name__}, expected an object"
    if result.t.size == 0:
        return "it has no ticks"
    for name, values in {"x": result.x, "t": result.t}.items():
        if not np.isfinite(values).all():
            return f"{name} is not finite at tick {_first(~np.isfinite(values))}"
    wanted: dict[str, Any] = dict.fromkeys(FLOATS, np.float64) | {"received": np.bool_}
    for name, values in link.items():
        kind = values.dtype
        if name in WHOLE and kind.kind != "i":
            return f"link_{name} is of type {kind}, expected whole numbers"
        if name in wanted and kind != wanted[name]:
            return f"link_{name} is of type {kind}, expected {np.dtype(wanted[name])}"
        if name in FLOATS and not np.isfinite(values).all():
            return f"link_{name} is not finite at tick {_first(~np.isfinite(values))}"
        low, high = RANGES.get(name, (-np.inf, np.inf))
        outside = (values < low) | (values > high) if name in RANGES else np.zeros(1, bool)
        if outside.any():
            return f"link_{name} is outside of {low:g} to {high:g} at tick {_first(outside)}"
    arming = link["arming"]
    if arming[0] != 0 or not np.isin(np.diff(arming), (0, 1)).all():
        return "link_arming does not count armings from 0 up"
    return None


def _first(wrong: Array) -> int:
    """The first row of `wrong` (N,) or (N, m) with a True."""
    return int(np.argmax(wrong.reshape(len(wrong), -1).any(axis=1)))
