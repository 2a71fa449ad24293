"""What an ideal environment would have done: the force of Lambda E for the displacements that a run measured."""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from controller.delay import delay
from controller.lti import Array, Lti, frozen
from sim.files import write
from sim.run import Assembly, Record
from sim.scenario import InputError
from sim.stability import PERIODS, octaves

# ----------------------------------------------------------------------------------------------------
# The trace of a run as files: npz for programs, CSV for spreadsheets.


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
        if self.f.shape != self.x.shape:
            raise ValueError(f"f has {self.f.shape[1]} channels, x has {self.x.shape[1]}")

    @classmethod
    def from_record(cls, assembly: Assembly, record: Record, meta: dict[str, Any]) -> Self:
        """The one simulation of a record, in the scenario's terms."""
        m, handles = assembly.process.channels, list(assembly.scene.handles)
        s = record.s[:, :, 0]
        n = assembly.scene.model.nq
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


# ----------------------------------------------------------------------------------------------------
# Does an oscillation grow? From displacements alone, where nobody knows the states: a bridge's trace, any stored one.
#
# sim.stability projects a run on a mode of the loop whose humans are known. Of a real device there are displacements
# only, and the person moves as they like. So the second half of a stretch of ticks is cut into overlapping windows,
# the slow part of each is taken out, and the rest is split into octaves (sim.oscillation). An oscillation that grows
# like exp(g t) is exp(g hop) times larger in each window than in the one before: g is the slope of a line through
# logarithms.
#
# It is a figure about motion, not a verdict about a loop: a person who shakes the handle harder and harder grows too.


WINDOW = 1.0  # [s] at most
TREND = 7  # degree of the polynomial that is the slow part: of 15 mm at 0.6 Hz it leaves less than a micrometre
WINDOWS = 7  # in the second half of a stretch, each half over the next, at least
NEEDED = 4  # of them, one after the other, that an oscillation is seen in
SHORTEST = 200  # ticks
FLOOR = 3.0  # times what the encoders' rounding puts into an octave: less is not an oscillation
CLEAR = 4.0  # standard errors, of a line through as few as four points
FINEST = 1e-9  # [m] step taken for an ideal encoder: floating-point noise is no oscillation


@dataclass(frozen=True)
class Growth:
    """The strongest oscillation in a stretch of a trace, or why there is none to tell of."""

    first: int  # ticks [first, stop) that were looked at
    stop: int
    growth_rate_per_s: float | None
    error_per_s: float | None  # standard error of the line
    frequency_hz: float | None
    amplitude_m: float | None  # of its octave, where it was seen last
    slowest_hz: float | None  # slower oscillations are not seen
    trend: str | None  # grows | decays | neither: by more than CLEAR standard errors
    reason: str | None = None

    def part(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)


def growth(x: Array, T: float, encoder_step: Array, first: int = 0) -> Growth:
    """Of displacements x (N, m) [m] sampled every T [s] by encoders of steps (m,) [m]; tick 0 of x is called `first`.

    Looks at the second half of x; where nothing is seen there for long enough, as of a mode that grows fast, at the
    last quarter, and so on. Where octaves grow, the strongest of these is reported, else the strongest of all: a mode
    that decays does not hide one that grows.
    """
    n, stop = len(x), first + len(x)
    if n < SHORTEST:
        return Growth(
            first, stop, None, None, None, None, None, None, f"only {n} ticks; a growth rate needs {SHORTEST}"
        )
    begin = n // 2
    while not (lines := _lines(x[begin:], T, encoder_step)).found and n - begin >= 2 * SHORTEST:
        begin = (begin + n) // 2
    if not lines.found:
        begin = begin if lines.brief else n // 2
        lines = lines if lines.brief else _lines(x[begin:], T, encoder_step)
        what = "something oscillates, too briefly for a rate," if lines.brief else "nothing oscillates"
        reason = f"{what} above {1e6 * lines.floor:.2g} um"
        return Growth(first + begin, stop, None, None, None, None, lines.slowest, None, reason)
    growing = [one for one in lines.found if one[0] > CLEAR * one[1]]
    rate, error, frequency, size = max(growing or lines.found, key=lambda one: one[3])
    trend = "grows" if growing else "decays" if rate < -CLEAR * error else "neither"
    return Growth(first + begin, stop, rate, error, frequency, size, lines.slowest, trend)


class _Lines(NamedTuple):
    """What oscillates in a stretch."""

    found: list[tuple[float, float, float, float]]  # rate and its error [1/s], frequency [Hz], amplitude [m], by octave
    brief: bool  # something does, in too few windows
    floor: float  # [m]
    slowest: float  # [Hz]


def _lines(x: Array, T: float, encoder_step: Array) -> _Lines:
    hop = min(round(WINDOW / T), 2 * len(x) // (WINDOWS + 1)) // 2
    windows = [x[start : start + 2 * hop] for start in range(0, len(x) - 2 * hop + 1, hop)]
    amplitude, line, part = map(np.array, zip(*(octaves(w[:, :, None], T, TREND) for w in windows), strict=True))
    seen = np.sqrt(np.square(amplitude[..., 0]).sum(axis=2))  # (windows, octaves): a mode moves all channels
    # rounding is white with a variance of step^2/12, and a sinusoid's amplitude is the root of twice its power
    floor = FLOOR * np.sqrt(2 * part[0] * np.square(encoder_step).sum() / 12)
    found = []
    for k in range(seen.shape[1]):
        at = _longest(seen[:, k] > floor[k])
        if len(at) >= NEEDED:
            rate, error = _slope(np.log(seen[at, k]), hop * T)
            strongest = np.argmax(amplitude[at[-1], k, :, 0])
            found.append((rate, error, float(line[at[-1], k, strongest, 0]), float(seen[at[-1], k])))
    return _Lines(found, bool((seen > floor).any()), float(floor.max()), PERIODS / (2 * hop * T))


def _longest(on: NDArray[np.bool_]) -> NDArray[np.intp]:
    """The places of the longest run of True; the last of several."""
    runs = np.split(np.arange(len(on)), np.flatnonzero(np.diff(on)) + 1)
    return max((run for run in reversed(runs) if on[run[0]]), key=len, default=np.zeros(0, np.intp))


def _slope(values: Array, spacing: float) -> tuple[float, float]:
    """Of the line through values `spacing` seconds apart, with its standard error [1/s]."""
    n = len(values)
    t = spacing * (np.arange(n) - (n - 1) / 2)
    slope = float(t @ values / (t @ t))
    rest = values - values.mean() - slope * t
    return slope, float(np.sqrt(rest @ rest / (n - 2) / (t @ t)))


def growths(result: Result) -> list[Growth]:
    """One entry per stretch of a trace in which the loop was one linear loop: `run.steady_ticks` of its metadata.

    Where a trace does not name any, all of it is one. Raises InputError where what it names is none of it.
    """
    n, m = result.x.shape
    run = result.meta.get("run") if isinstance(result.meta, dict) else None
    run = run if isinstance(run, dict) else {}
    stretches, step = run.get("steady_ticks", [[0, n]]), run.get("encoder_step_m", [0.0] * m)
    try:
        ends = np.array([(int(first), int(stop)) for first, stop in stretches], dtype=int).reshape(-1, 2)
        steps = np.maximum(np.array(step, dtype=float).reshape(m), FINEST)
    except (TypeError, ValueError):
        raise InputError("the trace's run.steady_ticks or run.encoder_step_m are no numbers for its channels") from None
    if np.any(ends[:, 0] < 0) or np.any(ends[:, 1] > n) or np.any(ends[:, 0] > ends[:, 1]):
        raise InputError(f"the trace's run.steady_ticks are {ends.tolist()}, it has {n} ticks")
    if not np.isfinite(result.x).all() or not np.isfinite(steps).all():
        raise InputError("the trace has displacements or encoder steps that are not finite")
    T = float(result.t[1] - result.t[0]) if n > 1 else 0.0
    if n > 1 and not 0 < T < np.inf:
        raise InputError(f"the trace's samples are {T:g} s apart")
    return [growth(result.x[first:stop], T, steps, first) for first, stop in ends.tolist()]


def told(part: dict[str, Any], T: float) -> str:
    """One stretch in words, from its plain data."""
    where = f"ticks {part['first']} to {part['stop']} ({(part['stop'] - part['first']) * T:.2f} s)"
    above = "" if part["slowest_hz"] is None else f" (from {part['slowest_hz']:.3g} Hz up)"
    if part["reason"]:
        return f"{where}: {part['reason']}{above}"
    rate = f"{part['growth_rate_per_s']:+.4g} ± {part['error_per_s']:.2g} 1/s at {part['frequency_hz']:.4g} Hz"
    return f"{where}: {rate}{above}, {1e3 * part['amplitude_m']:.2g} mm at last: {part['trend']}"


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


if __name__ == "__main__":
    from cli.main import door

    door("trace")
