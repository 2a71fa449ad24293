"""Does a trace go on oscillating? For loops that are not linear, where "unstable" may be a limit cycle.

The hands rest, or press with a constant force. The second half of a trace is cut in two windows. In each, the motion of
each motor and handle without its slow part (a cubic fitted to the window) is split into octaves, from PERIODS in a
window to half the sampling rate.
The trace oscillates if in some octave the amplitude in the last window

    exceeds a threshold [m], and is at least SUSTAINED of that in the window before:

a decaying oscillation is not one however large it still is, and one below the threshold is not one however long it
lasts. Octaves are looked at apart, so that a slow mode that decays does not hide a fast one that grows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array

PERIODS = 4  # in a window, of the slowest oscillation that is seen: of fewer the window function mixes octaves
SUSTAINED = 0.95
TREND = 3  # degree of the polynomial that is the slow part
RUNAWAY = 1e3  # [m] no handle moves that far: the trace has diverged


@dataclass(frozen=True, eq=False)
class Oscillation:
    """One entry per simulation."""

    sustained: NDArray[np.bool_]  # (nsim,) the verdict
    amplitude: Array  # (nsim,) [m] of the strongest octave that is sustained, else of the strongest one; inf: diverged
    frequency_hz: Array  # (nsim,) [Hz] the strongest line in that octave; nan: diverged


def slowest_seen(duration: float) -> float:
    """[Hz] the lowest frequency that the verdict on a trace of that many seconds hears."""
    return 4 * PERIODS / duration


def oscillation(x: Array, T: float, threshold: float) -> Oscillation:
    """Of positions x (ticks, m, nsim) [m] in the second half of traces, sampled every T seconds."""
    half = x.shape[0] // 2
    diverged = ~(np.abs(x) < RUNAWAY).all(axis=(0, 1))
    calm = np.where(diverged, 0.0, x)
    before, _, _ = octaves(calm[:half], T)
    after, line, _ = octaves(calm[half : 2 * half], T)  # (octaves, m, nsim)
    lasting = (after > threshold) & (after >= SUSTAINED * before)
    shown = np.where(lasting | ~lasting.any(axis=(0, 1)), after, 0.0).reshape(-1, x.shape[2])
    at = np.argmax(shown, axis=0)[None]
    amplitude = np.take_along_axis(shown, at, axis=0)[0]
    frequency = np.take_along_axis(line.reshape(-1, x.shape[2]), at, axis=0)[0]
    return Oscillation(
        np.any(lasting, axis=(0, 1)) | diverged,
        np.where(diverged, np.inf, amplitude),
        np.where(diverged, np.nan, frequency),
    )


def octaves(x: Array, T: float, trend: int = TREND) -> tuple[Array, Array, Array]:
    """Of x (ticks, m, nsim) without a polynomial of degree `trend`: amplitude of each octave (that of a sinusoid of its
    power) and frequency [Hz] of its strongest line, both (octaves, m, nsim), and its part of all lines, (octaves,).
    """
    ticks = x.shape[0]
    window = np.hanning(ticks)
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, ticks), trend + 1))
    flat = x.reshape(ticks, -1)
    fast = flat - basis @ (basis.T @ flat)
    # a sinusoid of amplitude a has power a^2/2; a window w keeps sum w^2 of ticks
    power = 4 * np.abs(np.fft.rfft(window[:, None] * fast, axis=0)) ** 2 / (ticks * (window**2).sum())
    frequency = np.fft.rfftfreq(ticks, T)
    lowest = PERIODS / (ticks * T) * (1 - 1e-9)
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
