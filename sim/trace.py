"""The trace of a run, its files, and oscillations in its displacements.

Oscillations are judged by displacements alone, because a session on a device and a stored trace contain no states, and
a nonlinear loop has no eigenvalues. The slow motion is subtracted, and the rest is split into octaves.

oscillation   Does an oscillation last in the second half of a trace? The half is cut into two windows. The oscillation
              lasts if in some octave the amplitude in the last window exceeds a threshold and is at least 95 % of
              the amplitude in the first window. Octaves are judged separately, so that a slow mode that decays does
              not hide a fast mode that grows.
growth        How fast does an oscillation grow? If it grows like exp(g t), the logarithm of the amplitude over the
              windows is a line of slope g. The slope describes a motion and is no verdict on a loop: the motion of a
              person who shakes the handle harder and harder grows, too.
"""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("trace")

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array, ReadOnly, frozen
from haptic_loop.controller.tick import Net, at_limit
from haptic_loop.controller.units import in_unit, with_unit
from haptic_loop.design.files import InputError, read_arrays, write
from haptic_loop.sim.shown import Signals

_MEASURED = {"t": 1, "x": 2, "f": 2, "x_handle": 2, "v_handle": 2, "w": 2}  # array in a file -> number of dimensions
_STATES = {"z": 2, "s": 2}
_UNITS = {"x": "m", "f": "N", "x_handle": "m", "v_handle": "m/s"}


def _real(name: str, values: NDArray[Any]) -> Array:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{name} is of type {values.dtype}, expected real numbers")
    return values


def _is_frozen(value: Any, ndim: int) -> bool:
    """Return whether a value is a read-only float array of `ndim` dimensions, which needs no copy."""
    own = isinstance(value, np.ndarray) and value.dtype == np.float64 and value.ndim == ndim
    return own and not value.flags.writeable and not (isinstance(value.base, np.ndarray) and value.base.flags.writeable)


@dataclass(frozen=True, eq=False)
class Trace(ReadOnly):
    """The signals of a run, N samples of m channels, with its settings. Arrays are read-only.

    The states z and s have no columns in a trace that was read from a file or recorded on a real device.

    Attributes:
        t: (N,) times [s] at which the ticks begin; k T if all periods are T.
        x: (N, m) displacements of the devices as the encoders gave them [m].
        f: (N, m) forces that are fed back within the limits [N]; the devices feel -f.
        x_handle: (N, m) displacements of the handles [m].
        v_handle: (N, m) velocities of the handles [m/s].
        w: (N, outside) external forces [N]: voluntary forces and those of a tap.
        meta: Settings and verdicts of the run, as in its JSON.
        z: (N, order) states of the controller.
        s: (N, states) states of the plant: positions [m], velocities [m/s], states of the hands' impedances, and with
            latencies the held forces [N].
        diverged: Whether the tick after the last one has numbers that are not finite, or the engine reported trouble.
        interrupted: Whether the run was stopped from the keyboard.
        net: The passivity layer between controller and devices, in its final state; None without one.
        names: (m,) names of the channels if devices have several axes; empty if channels are numbered.
    """

    t: Array
    x: Array
    f: Array
    x_handle: Array
    v_handle: Array
    w: Array
    meta: dict[str, Any] = field(default_factory=dict)
    z: Array = field(default_factory=lambda: np.empty((0, 0)))
    s: Array = field(default_factory=lambda: np.empty((0, 0)))
    diverged: bool = False
    interrupted: bool = False
    net: Net | None = None
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, ndim in (_MEASURED | _STATES).items():
            value = getattr(self, name)
            value = value if name in _MEASURED or np.size(value) else np.empty((len(self.t), 0))
            if not _is_frozen(value, ndim):
                object.__setattr__(self, name, frozen(value, ndim, name))
            if len(value) != self.t.shape[0]:
                raise ValueError(f"{name} has {len(value)} samples, t has {self.t.shape[0]}")
        if self.f.shape != self.x.shape:
            raise ValueError(f"f has {self.f.shape[1]} channels, x has {self.x.shape[1]}")
        if len(self.names) not in (0, self.x.shape[1]):
            raise ValueError(f"names has {len(self.names)} entries, x has {self.x.shape[1]} channels")

    def __repr__(self) -> str:
        n, m = self.x.shape
        largest = [np.abs(values).max(initial=0.0) for values in (self.x, self.f)]
        sizes = ", |x| <= {:.3g} m, |f| <= {:.3g} N".format(*largest)
        stability = self.meta.get("stability") if isinstance(self.meta, dict) else None
        verdict = f", {stability['verdict']}" if isinstance(stability, dict) and stability.get("verdict") else ""
        return f"Trace({n} samples of {m} channels{f', {self.t[-1]:.4g} s' if n else ''}{sizes}{verdict})"

    def clipped(self, force_limit: Array, balls: Sequence[slice] = ()) -> NDArray[np.bool_]:
        """Return (N,) whether a force, or the force vector of one of `balls`, reached its limit (m,) [N]."""
        return np.any(at_limit(self.f[:, :, None], force_limit, balls)[:, :, 0], axis=1)

    def ticks_before_clipping(self, force_limit: Array, balls: Sequence[slice] = ()) -> int:
        """Return the number of ticks before the first clipped force; without a clipped force, that of all ticks."""
        clipped = self.clipped(force_limit, balls)
        return int(np.argmax(clipped)) if clipped.any() else clipped.size

    def dominant_frequency_hz(self) -> float | None:
        """Return the strongest frequency [Hz] from 10 Hz in the forces' last quarter; None if that is short or calm."""
        tail = self.f[-(self.f.shape[0] // 4) :]
        if tail.shape[0] < 64:
            return None
        window = np.hanning(tail.shape[0])[:, None]
        spectrum = np.abs(np.fft.rfft((tail - tail.mean(axis=0)) * window, axis=0)).sum(axis=1)
        frequency = np.fft.rfftfreq(tail.shape[0], float(self.t[1] - self.t[0]))
        spectrum[frequency < 10.0] = 0.0
        return float(frequency[np.argmax(spectrum)]) if spectrum.any() else None

    @property
    def signals(self) -> Signals:
        """The part of the trace that a picture shows."""
        return Signals(self.t, self.x, self.f, self.x_handle, self.names)

    def to_frame(self) -> Any:
        """Return a pandas data frame with the index "t [s]" and columns such as "x1 [m]" or "f left.y [N]".

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise ImportError("Trace.to_frame needs pandas, which is not installed: pip install pandas") from None
        return pandas.DataFrame(self._columns(*_UNITS), index=pandas.Index(self.t, name="t [s]"))

    def plot(self, path: str | Path | None = None, title: str = "") -> Any:
        """Draw displacements and forces over time, and return the matplotlib figure.

        Args:
            path: The file of the picture, ending in .png, .pdf or .svg, or None to write none.
            title: The title; default: the name of the scenario with the verdict.

        Raises:
            InputError: The path has another suffix, or the file cannot be written.
        """
        from haptic_loop.sim.plots import draw_run, relabel, save

        figure = draw_run(self.signals, title or self._title(), self.dominant_frequency_hz() or 10.0)
        relabel(figure, self.meta.get("unit"))
        if path is not None:
            save(figure, Path(path))
        return figure

    def _title(self) -> str:
        stability = self.meta.get("stability") or {}
        words = (self.meta.get("scenario"), stability.get("verdict"))
        return ": ".join(word for word in words if word) or "run"

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the trace's file: signals, the metadata as JSON text, and names of channels, if any."""
        signals = {name: getattr(self, name) for name in _MEASURED}
        names = {"names": np.array(self.names)} if self.names else {}
        return signals | {"meta": np.array(json.dumps(with_unit(self.meta)))} | names

    def save_npz(self, path: Path) -> Path:
        """Write `arrays` to an .npz file without pickle, and return its path. Compression would save only a tenth."""

        def content(file: BinaryIO) -> None:
            np.savez(file, allow_pickle=False, **self.arrays)

        return write(path, content)

    @classmethod
    def load_npz(cls, path: Path) -> Self:
        """Return a trace that `save_npz` wrote. Raises InputError for any other file."""
        return cls.of_arrays(path, read_arrays(path, "a trace of this program"))

    @classmethod
    def of_arrays(cls, path: Path, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Return the trace that these arrays of a file describe. Raises InputError if they describe none."""
        try:
            measured: dict[str, Any] = {name: _real(name, arrays[name]) for name in _MEASURED}
            names = tuple(str(name) for name in arrays.get("names", np.zeros(0)))
            return cls(**measured, meta=json.loads(str(arrays["meta"])), names=names)
        except (KeyError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"{path}: not a trace of this program ({error})") from None

    def _columns(self, *signals: str) -> dict[str, Array]:
        """Return the columns of signals by their headers, such as "x1 [m]", or "x left.y [m]" for a named channel."""
        channels = [f" {name}" for name in self.names] or range(1, self.x.shape[1] + 1)
        return {
            in_unit(f"{signal}{i} [{_UNITS[signal]}]", self.meta.get("unit")): column
            for signal in signals
            for i, column in zip(channels, getattr(self, signal).T, strict=True)
        }

    def save_csv(self, path: Path) -> Path:
        """Write time, displacements and forces, one line per sample, with units in the header, and return the path."""
        columns = {"t [s]": self.t} | self._columns("x", "f")
        line, rows = ",".join(["%.9g"] * len(columns)), np.column_stack([*columns.values()]).tolist()
        return write(path, "\n".join([",".join(columns), *(line % (*row,) for row in rows), ""]))


# ---- octaves, and lasting oscillations

_PERIODS = 4  # least number of periods in a window; with fewer periods the window mixes neighbouring octaves
_TREND = 7  # degree of the polynomial of the slow motion; in 1 s it leaves 1 um of a motion of 15 mm at 0.6 Hz
_SUSTAINED = 0.95  # least ratio of amplitudes, last window over first window, of an oscillation that lasts
RUNAWAY = 1e3  # [m] no handle moves that far: the trace has diverged


@dataclass(frozen=True, eq=False)
class Oscillation:
    """The strongest oscillation of positions, with one entry per simulation."""

    sustained: NDArray[np.bool_]  # (nsim,) whether the oscillation lasts
    amplitude: Array  # (nsim,) [m] of the strongest octave; only lasting ones count if there are any; inf: diverged
    frequency_hz: Array  # (nsim,) [Hz] of the strongest line in the octave of `amplitude`; nan: diverged


def slowest_seen(duration: float) -> float:
    """Return the lowest frequency [Hz] that `oscillation` sees in the second half of a trace of `duration` seconds."""
    return 4 * _PERIODS / duration


def oscillation(x: Array, T: float, threshold: float) -> Oscillation:
    """Return the strongest oscillation of positions x (ticks, m, nsim) [m]; lasting ones exceed `threshold` [m]."""
    half = x.shape[0] // 2
    diverged = ~(np.abs(x) < RUNAWAY).all(axis=(0, 1))
    calm = np.where(diverged, 0.0, x)
    before, _, _ = _octaves(calm[:half], T)
    after, line, _ = _octaves(calm[half : 2 * half], T)  # (octaves, m, nsim)
    lasting = (after > threshold) & (after >= _SUSTAINED * before)
    shown = np.where(lasting | ~lasting.any(axis=(0, 1)), after, 0.0).reshape(-1, x.shape[2])
    at = np.argmax(shown, axis=0)[None]
    amplitude = np.take_along_axis(shown, at, axis=0)[0]
    frequency = np.take_along_axis(line.reshape(-1, x.shape[2]), at, axis=0)[0]
    return Oscillation(
        np.any(lasting, axis=(0, 1)) | diverged,
        np.where(diverged, np.inf, amplitude),
        np.where(diverged, np.nan, frequency),
    )


def _octaves(x: Array, T: float) -> tuple[Array, Array, Array]:
    """Split positions x (ticks, m, nsim) into octaves, after subtracting the slow motion.

    Returns:
        The amplitude of each octave, (octaves, m, nsim), which is that of a sinusoid of equal power; the frequency [Hz]
        of its strongest line, (octaves, m, nsim); and its share of all lines of the spectrum, (octaves,).
    """
    ticks = x.shape[0]
    window = np.hanning(ticks)
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, ticks), _TREND + 1))
    flat = x.reshape(ticks, -1)
    fast = flat - basis @ (basis.T @ flat)
    # A sinusoid of amplitude a has the power a^2/2; a window w reduces it by the factor sum w^2 / ticks.
    power = 4 * np.abs(np.fft.rfft(window[:, None] * fast, axis=0)) ** 2 / (ticks * (window**2).sum())
    frequency = np.fft.rfftfreq(ticks, T)
    lowest = _PERIODS / (ticks * T) * (1 - 1e-9)
    octave = np.floor(np.log2(np.maximum(frequency, lowest / 2) / lowest)).astype(int)
    amplitudes, lines, parts = [], [], []
    for k in range(octave.max() + 1):
        rows = np.flatnonzero(octave == k)
        if rows.size:
            amplitudes.append(np.sqrt(power[rows].sum(axis=0)))
            lines.append(frequency[rows][np.argmax(power[rows], axis=0)])
            parts.append(rows.size / octave.size)
    shape = (len(amplitudes), *x.shape[1:])
    return np.array(amplitudes).reshape(shape), np.array(lines).reshape(shape), np.array(parts)


# ---- how fast an oscillation grows

_WINDOW = 1.0  # [s] longest window
_LEAST_SAMPLES = 10  # least number of samples in a window
_WINDOWS = 7  # least number of windows, each of which overlaps the next by half
_NEEDED = 4  # consecutive windows in which an oscillation must be seen
_SHORTEST = 200  # ticks that a growth rate needs
_FLOOR = 3.0  # an oscillation must exceed this multiple of the encoders' rounding in its octave
_CLEAR = 4.0  # number of standard errors by which a clear slope differs from 0; a line may have only four points
_FARTHEST = 1e100  # [m] the square of a larger number may overflow
_EVEN = 1e-3  # largest relative difference between periods of a trace
_FINEST = 1e-9  # [m] step that is assumed for an ideal encoder


@dataclass(frozen=True)
class Growth:
    """The growth of an oscillation in a part of a trace (see `growth`)."""

    first: int  # the part has the ticks [first, stop)
    stop: int
    growth_rate_per_s: float | None = None
    error_per_s: float | None = None  # standard error of the rate
    frequency_hz: float | None = None  # strongest frequency in the last window that shows the oscillation
    amplitude_m: float | None = None  # amplitude in that window: root of the sum of squares over the channels
    slowest_hz: float | None = None  # frequency below which oscillations are not seen
    trend: str | None = None  # "grows" or "decays" if the rate exceeds _CLEAR standard errors, otherwise "neither"
    reason: str | None = None  # why there is no rate

    def words(self, T: float) -> str:
        """Return the growth in one line of words, for ticks of T [s]."""
        where = f"ticks {self.first} to {self.stop} ({(self.stop - self.first) * T:.7g} s)"
        above = "" if self.slowest_hz is None else f" (from {self.slowest_hz:.3g} Hz up)"
        if self.reason or self.amplitude_m is None:
            return f"{where}: {self.reason}{above}"
        rate = f"{self.growth_rate_per_s:+.4g} ± {self.error_per_s:.2g} 1/s at {self.frequency_hz:.4g} Hz"
        return f"{where}: {rate}{above}, {1e3 * self.amplitude_m:.2g} mm when last seen: {self.trend}"


def growth(x: Array, T: float, encoder_step: Array, first: int = 0) -> Growth:
    """Return how fast displacements x (N, m) [m] grow, sampled every T [s] by encoders of steps (m,) [m].

    The second half of x is examined first. A mode that grows fast may appear late. Therefore, if no oscillation is seen
    in this half for long enough, the last quarter is examined, and so on. The result is that of the strongest octave
    that grows, or of the strongest octave if none grows. `first` is the number of the first tick.
    """
    n, stop = len(x), first + len(x)
    if n < _SHORTEST:
        return Growth(first, stop, reason=f"only {n} ticks; a growth rate needs {_SHORTEST}")
    if T > _WINDOW / _LEAST_SAMPLES:
        return Growth(
            first, stop, reason=f"ticks of {T:g} s; a growth rate needs {_WINDOW / _LEAST_SAMPLES:g} s or less"
        )
    begin = n // 2
    while not (lines := _lines(x[begin:], T, encoder_step)).octaves and n - begin >= 2 * _SHORTEST:
        begin = (begin + n) // 2
    if not lines.octaves:
        begin = begin if lines.brief else n // 2
        lines = lines if lines.brief else _lines(x[begin:], T, encoder_step)
        floor = f"above {1e6 * lines.floor:.2g} um"
        gone = "and was gone at the end" if lines.gone else "and was still there at the end"
        brief = f"an oscillation {floor} was seen too briefly for a rate, {gone}"
        reason = brief if lines.brief else f"nothing oscillates {floor}"
        return Growth(first + begin, stop, slowest_hz=lines.slowest, reason=reason)
    growing = [one for one in lines.octaves if one[0] > _CLEAR * one[1]]
    rate, error, frequency, size = max(growing or lines.octaves, key=lambda one: one[3])
    trend = "grows" if growing else "decays" if rate < -_CLEAR * error else "neither"
    return Growth(first + begin, stop, rate, error, frequency, size, lines.slowest, trend)


class _Lines(NamedTuple):
    """The oscillations in a part of a trace."""

    octaves: list[tuple[float, float, float, float]]  # rate [1/s], its error [1/s], frequency [Hz] and amplitude [m]
    brief: bool  # an oscillation is seen in some window; if `octaves` is empty, in too few windows for a rate
    gone: bool  # no oscillation is seen in the last window
    floor: float  # [m] least amplitude that is above the encoders' rounding in every octave
    slowest: float  # [Hz] frequency below which oscillations are not seen


def _lines(x: Array, T: float, encoder_step: Array) -> _Lines:
    hop = min(round(_WINDOW / T), 2 * len(x) // (_WINDOWS + 1)) // 2
    windows = [x[start : start + 2 * hop] for start in range(0, len(x) - 2 * hop + 1, hop)]
    amplitude, line, part = map(np.array, zip(*(_octaves(w[:, :, None], T) for w in windows), strict=True))
    seen = np.sqrt(np.square(amplitude[..., 0]).sum(axis=2))  # (windows, octaves), over all channels
    # Rounding is white noise of variance step^2/12, and a sinusoid's amplitude is the root of twice its power.
    floor = _FLOOR * np.sqrt(2 * part[0] * np.square(encoder_step).sum() / 12)
    lines = []
    for k in range(seen.shape[1]):
        at = _longest(seen[:, k] > floor[k])
        if len(at) >= _NEEDED:
            rate, error = _slope(np.log(seen[at, k]), hop * T)
            strongest = np.argmax(amplitude[at[-1], k, :, 0])
            lines.append((rate, error, float(line[at[-1], k, strongest, 0]), float(seen[at[-1], k])))
    on = (seen > floor.max()).any(axis=1)  # (windows,)
    return _Lines(lines, bool(on.any()), not on[-1], float(floor.max()), _PERIODS / (2 * hop * T))


def _longest(on: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the indices of the longest run of True, the last one of equally long runs."""
    runs = np.split(np.arange(len(on)), np.flatnonzero(np.diff(on)) + 1)
    return max((run for run in reversed(runs) if on[run[0]]), key=len, default=np.zeros(0, np.intp))


def _slope(values: Array, spacing: float) -> tuple[float, float]:
    """Return the slope [1/s] of a line through values that are `spacing` seconds apart, and its standard error."""
    n = len(values)
    t = spacing * (np.arange(n) - (n - 1) / 2)
    slope = float(t @ values / (t @ t))
    rest = values - values.mean() - slope * t
    return slope, float(np.sqrt(rest @ rest / (n - 2) / (t @ t)))


def growths(trace: Trace) -> list[Growth]:
    """Return the growth in each part of a trace in which the loop was linear.

    The entry `run.steady_ticks` of the metadata has these parts; without it the whole trace is one part. Raises
    InputError for wrong parts, and for samples that are not finite or not evenly spaced.
    """
    n, m = trace.x.shape
    run = trace.meta.get("run") if isinstance(trace.meta, dict) else None
    run = run if isinstance(run, dict) else {}
    stretches, step = run.get("steady_ticks", [[0, n]]), run.get("encoder_step_m", [0.0] * m)
    try:
        ends = np.array([(int(first), int(stop)) for first, stop in stretches], dtype=int).reshape(-1, 2)
        steps = np.maximum(np.array(step, dtype=float).reshape(m), _FINEST)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            "the trace's run.steady_ticks are no pairs of ticks, or run.encoder_step_m has no number per channel"
        ) from None
    if np.any(ends[:, 0] < 0) or np.any(ends[:, 1] > n) or np.any(ends[:, 0] > ends[:, 1]):
        raise InputError(f"the trace's run.steady_ticks are {ends.tolist()}, but the trace has {n} ticks")
    if not all(np.isfinite(values).all() for values in (trace.t, trace.x, steps)):
        raise InputError("the trace has times, displacements or encoder steps that are not finite")
    if not m or np.abs(trace.x).max(initial=0.0) > _FARTHEST:
        raise InputError(
            f"the trace has {m} channels" if not m else f"the trace has displacements above {_FARTHEST:g} m"
        )
    T = float(trace.t[1] - trace.t[0]) if n > 1 else 0.0
    if n > 1 and not 0 < T < np.inf:
        raise InputError(f"the trace's samples are {T:g} s apart")
    if not np.abs(np.diff(trace.t) - T).max(initial=0.0) <= _EVEN * T:
        raise InputError(
            f"the trace's samples are not evenly spaced: the first step of t is {T:g} s, a later one differs"
        )
    return [growth(trace.x[first:stop], T, steps, first) for first, stop in ends.tolist()]
