"""The trace of a run as files: npz for programs, CSV for spreadsheets."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self
from zipfile import BadZipFile

import numpy as np

from controller.lti import Array, frozen
from sim.files import write
from sim.loop import Record
from sim.scenario import InputError
from sim.simulate import Assembly


@dataclass(frozen=True, eq=False)
class Result:
    """What was measured at every tick, and under which settings. Arrays are read-only."""

    t: Array  # (N,) [s], sample k at k T
    x: Array  # (N, m) device displacements as the encoders gave them [m]
    f: Array  # (N, m) forces fed back, within the limits [N]; the device feels -f
    x_handle: Array  # (N, m) [m]
    v_handle: Array  # (N, m) [m/s]
    w: Array  # (N, outside) outside forces [N]
    meta: dict[str, Any]

    def __post_init__(self) -> None:
        for name, ndim in _ARRAYS.items():
            value = frozen(getattr(self, name), ndim, name)
            object.__setattr__(self, name, value)
            if value.shape[0] != self.t.shape[0]:
                raise ValueError(f"{name} has {value.shape[0]} samples, t has {self.t.shape[0]}")

    @classmethod
    def from_record(cls, assembly: Assembly, record: Record, meta: dict[str, Any]) -> Self:
        """The one simulation of a record, in the scenario's terms."""
        m, handles = assembly.process.channels, list(assembly.scene.handles)
        s = record.s[:, :, 0]
        n = s.shape[1] // 2
        t = np.arange(s.shape[0]) * assembly.scenario.T
        x = assembly.process.measured(s[:, :m])
        return cls(t, x, record.f[:, :, 0], s[:, handles], s[:, n:][:, handles], record.w[:, :, 0], meta)

    def save_npz(self, path: Path) -> Path:
        """Arrays and metadata (as JSON text), compressed, without pickle."""

        def content(file: BinaryIO) -> None:
            arrays = {name: getattr(self, name) for name in _ARRAYS}
            np.savez_compressed(file, allow_pickle=False, meta=np.array(json.dumps(self.meta)), **arrays)

        return write(path, content)

    @classmethod
    def load_npz(cls, path: Path) -> Self:
        """A trace written by `save_npz`. Raises InputError where it is none."""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                return cls(**{name: archive[name] for name in _ARRAYS}, meta=json.loads(str(archive["meta"])))
        except OSError as error:
            raise InputError(f"{path}: {error.strerror or error}") from None
        except DAMAGED as error:
            raise InputError(f"{path}: not a trace of this program ({error})") from None

    def save_csv(self, path: Path) -> Path:
        """Time, displacements and forces, one line per sample, SI units in the header."""
        channels = range(1, self.x.shape[1] + 1)
        names = ["t [s]", *(f"x{i} [m]" for i in channels), *(f"f{i} [N]" for i in channels)]
        table = np.column_stack([self.t, self.x, self.f])

        def content(file: BinaryIO) -> None:
            np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")

        return write(path, content)


#: what NumPy and zipfile raise of a file that is no npz, is damaged, or holds something else
DAMAGED = (KeyError, ValueError, TypeError, AttributeError, EOFError, RuntimeError, BadZipFile, zlib.error)
_ARRAYS = {"t": 1, "x": 2, "f": 2, "x_handle": 2, "v_handle": 2, "w": 2}
