"""The trace of a session: the npz of sim.run, with what the link saw beside it, so that it can be replayed."""

from __future__ import annotations

import hashlib
import json
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array
from hw.drive import Row
from hw.handshake import Units
from hw.message import NO_MARGIN
from hw.trace_check import complaint
from sim.files import write
from sim.scenario import InputError
from sim.trace import DAMAGED, Trace

#: what the link adds, one entry per tick: name -> axes of the array
LINK = {"tick": 1, "arming": 1, "received": 1, "asked": 2, "gain": 1, "sent": 2, "margin_us": 1, "status": 1}


class Recorder:
    """Collects rows in compact arrays: about 100 bytes a tick."""

    def __init__(self, channels: int) -> None:
        self.channels = channels
        self._floats = array("d")  # x, asked, gain
        self._whole = array("i")  # tick, arming, received, sent, applied, margin, status

    def __call__(self, row: Row) -> None:
        """Take in one tick."""
        m, state = self.channels, row.state
        self._floats.extend((*row.x, *row.asked, row.gain))
        if state is None:
            self._whole.extend((row.tick, row.arming, 0, *(0,) * (2 * m), NO_MARGIN, 0))
        else:
            self._whole.extend((row.tick, row.arming, 1, *row.sent, *state.applied, state.margin_us, state.status))

    def __len__(self) -> int:
        return len(self._floats) // (2 * self.channels + 1)

    def link(self) -> dict[str, NDArray[Any]]:
        """Arrays by the names of LINK, with `x` (N, m) [m] and `applied` (N, m) [steps] beside them."""
        m, n = self.channels, len(self)
        floats = np.array(self._floats).reshape(n, 2 * m + 1)
        whole = np.array(self._whole).reshape(n, 2 * m + 5)
        tick, arming, received, sent, applied, rest = np.split(whole, [1, 2, 3, 3 + m, 3 + 2 * m], axis=1)
        return {
            "x": floats[:, :m],
            "asked": floats[:, m : 2 * m],
            "gain": floats[:, -1],
            "tick": tick[:, 0],
            "arming": arming[:, 0],
            "received": received[:, 0].astype(bool),
            "sent": sent,
            "applied": applied,
            "margin_us": rest[:, 0],
            "status": rest[:, 1],
        }


def steady_ticks(recorder: Recorder, force_step: Sequence[float]) -> list[list[int]]:
    """[first, stop) of each arming in which the loop was one linear loop: full gain, until a cap or the slew rate cuts.

    Missed ticks are not left out. `force_step` (m,) [N].
    """
    link = recorder.link()
    asked = -np.round(link["asked"] / np.array(force_step))
    cut = link["received"] & np.any(link["sent"] != asked, axis=1)
    stretches = []
    for arming in np.unique(link["arming"]):
        full = np.flatnonzero((link["arming"] == arming) & (link["gain"] == 1.0))
        if full.size:
            count = int(np.argmax(cut[full])) if cut[full].any() else full.size
            stretches.append([int(full[0]), int(full[0]) + count])
    return stretches


def result_of(recorder: Recorder, units: Units, T: float, meta: dict[str, Any]) -> Trace:
    """The trace in the terms of sim.run. Handles and outside forces are not measured: nan, and no column."""
    link = recorder.link()
    n, m = len(recorder), recorder.channels
    last = np.maximum.accumulate(np.where(link["received"], np.arange(n), 0))  # a force is held until the next is known
    f = -link["applied"][last] * np.array(units.force_step)
    unknown = np.full((n, m), np.nan)
    t = np.arange(n, dtype=float) * T
    return Trace(t, link["x"], f, unknown, unknown, np.zeros((n, 0)), meta)


def save_npz(path: Path, result: Trace, recorder: Recorder) -> Path:
    """An npz that sim.result reads, with the arrays of LINK beside its own."""
    link = {f"link_{name}": recorder.link()[name] for name in LINK}
    own = {name: getattr(result, name) for name in ("t", "x", "f", "x_handle", "v_handle", "w")}
    arrays: dict[str, Any] = {**own, **link, "meta": np.array(json.dumps(result.meta))}

    def content(file: BinaryIO) -> None:
        np.savez_compressed(file, allow_pickle=False, digest=np.array(digest(arrays)), **arrays)

    return write(path, content)


def digest(arrays: Mapping[str, Array]) -> str:
    """SHA-256 of everything in a trace: it tells a record from one that was changed, cut or put together."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        whole.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape} ".encode() + arrays[name].tobytes())
    return whole.hexdigest()


def load(path: Path) -> tuple[Trace, dict[str, Array]]:
    """A trace with its link arrays. Raises InputError where the file holds no session of a bridge."""
    result = Trace.load_npz(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
            link = {name: arrays[f"link_{name}"] for name in LINK}
    except (OSError, *DAMAGED):
        raise InputError(f"{path}: a trace, but not of a bridge's session; hw.bridge writes one") from None
    n, m = result.x.shape
    for name, axes in LINK.items():
        if link[name].shape != ((n, m) if axes == 2 else (n,)):
            raise InputError(
                f"{path}: link_{name} has the shape {link[name].shape}, the trace {n} ticks of {m} channels"
            )
    if wrong := complaint(result, link):
        raise InputError(f"{path}: no session of hw.bridge: {wrong}")
    if str(arrays.pop("digest", "")) != digest(arrays):
        raise InputError(f"{path}: was changed after hw.bridge wrote it: its digest is another")
    return result, link
