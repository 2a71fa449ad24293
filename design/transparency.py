"""Transparency: the mismatch (8) between what the devices feel and the environment, and its figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arguments import number, of_kind
from haptic_loop.controller.delay import delay
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import frequencies, integral, on_circle, supremum

BAND_HZ = (0.5, 80.0)  # [Hz] default band of the mismatch
_LATEST = 0.45  # [1/T] A band that begins above this is too narrow for the grids of sweeps and of design.bound.
_ROUNDING = 1e-10  # F and Lambda E count as equal if they differ by less than this share of the environment E.


def in_band(band_hz: Sequence[float], T: float) -> tuple[float, float]:
    """Return the ends of a band [Hz] in rad/sample, at most pi. Raises TypeError or InputError for another value."""
    expected = f"two rising frequencies in Hz, the first above 0 and below {_LATEST / T:.6g}"
    of_kind("band_hz", band_hz, Sequence, expected)
    band = [2 * np.pi * T * number("band_hz", frequency, expected) for frequency in band_hz]
    if len(band) != 2 or not 0 < band[0] < min(band[1], 2 * np.pi * _LATEST):
        raise InputError(f"band_hz is {list(band_hz)}, expected {expected}")
    return band[0], min(band[1], np.pi)


@dataclass(frozen=True)
class Transparency:
    """Figures of the mismatch M = F - Lambda E, as ratios. Without any force (F = 0) the mismatch is 1 (0 dB).

    Attributes:
        tau: Ratio (25): sup sigma_max(M) / inf sigma_min(E) up to band_hz[1].
        relative_mismatch: Ratio: sup over the band of sigma_max(M) / sigma_max(E).
        rms_mismatch: Ratio: rms over log frequency in the band of ||M||_F / ||E||_F.
        dc_ratio: sigma_max F(1) / sigma_max E(1), the share of the static stiffness that is felt; nan if E(1) = 0.
        high_frequency_gain: Ratio: sup above 100 Hz of sigma_max(F) / sigma_max(E); nan if 1/(2 T) <= 100 Hz.
        band_hz: The band [Hz], lowest and highest frequency.
    """

    tau: float
    relative_mismatch: float
    rms_mismatch: float
    dc_ratio: float
    high_frequency_gain: float
    band_hz: tuple[float, float]

    def __repr__(self) -> str:
        mismatch = f"mismatch {self.rms_mismatch_db:z.2f} dB rms, {self.mismatch_db:z.2f} dB at most"
        static = f"{100 * self.dc_ratio:.3g} % of the" if math.isfinite(self.dc_ratio) else "no static"
        return f"Transparency({mismatch}, {static} stiffness)"

    @property
    def mismatch_db(self) -> float:
        return decibels(self.relative_mismatch)

    @property
    def rms_mismatch_db(self) -> float:
        return decibels(self.rms_mismatch)

    @property
    def reason(self) -> str | None:
        """The reason why a figure is infinite in decibels, or None."""
        if self.relative_mismatch == 0:
            return "the devices feel the reference exactly: the mismatch is zero, minus infinity in dB"
        if math.isinf(self.tau):
            return "some motion of the object meets no static force, so that tau (25) divides by zero"
        return None

    def part(self) -> dict[str, Any]:
        """Return the figures for JSON: the mismatch in decibels, and `reason` if there is one."""
        part = {
            "tau_db": decibels(self.tau),
            "relative_mismatch_db": self.mismatch_db,
            "rms_mismatch_db": self.rms_mismatch_db,
            "dc_ratio": self.dc_ratio,
            "high_frequency_gain": self.high_frequency_gain,
            "band_hz": self.band_hz,
        }
        return part | ({"reason": self.reason} if self.reason else {})


NO_FORCE = "environment: it has no force at any frequency, so that no mismatch can be computed: add a spring or a mass"


def silent(E: Lti) -> bool:
    """Return whether an environment never exerts a force."""
    return not E.D.any() and not E.C.any()


def _reference(environment: Lti, lam: Sequence[int], band_hz: tuple[float, float]) -> tuple[Lti, float, float]:
    """Return Lambda E and the ends of the band [rad/sample]. Raises ValueError if E is zero."""
    if silent(environment):
        raise ValueError(NO_FORCE)
    return delay(lam, environment.T) @ environment, *in_band(band_hz, environment.T)


def transparency(F: Lti, environment: Lti, lam: Sequence[int], band_hz: tuple[float, float] = BAND_HZ) -> Transparency:
    """Return the figures of the force map F against Lambda E. Raises ValueError if E is zero."""
    target, low, high = _reference(environment, lam, band_hz)

    def mismatch(w: Array) -> NDArray[np.complex128]:
        z = on_circle(w)
        return F.at(z) - target.at(z)

    def sizes(w: Array) -> tuple[Array, Array, Array]:
        """Return sigma_max(M), sigma_max(E) and sigma_min(E), (k,) each. The values at the grid are stored."""
        if w is grid and known:
            return known[0]
        E = np.linalg.svd(environment.at(on_circle(w)), compute_uv=False)
        rows = np.linalg.norm(mismatch(w), 2, axis=(1, 2)), E[:, 0], E[:, -1]
        if w is grid:
            known.append(rows)
        return rows

    def relative(w: Array) -> Array:
        M, E, _ = sizes(w)
        return np.where(w >= low, M / E, 0.0)

    known: list[tuple[Array, Array, Array]] = []
    grid = np.append(frequencies(F, environment, low=low * 1e-3, high=high), low)
    grid.sort()
    peak, _ = supremum(lambda w: sizes(w)[0], grid)
    least, _ = supremum(lambda w: -sizes(w)[2], grid)
    static = np.linalg.svd(environment.dc(), compute_uv=False)
    rounding = 1e-9 * float(np.abs(environment.D).max())  # rounding error of a static stiffness that should be zero
    least = 0.0 if static[-1] < 1e-9 * static[0] else min(-least, float(static[-1]))
    worst = supremum(relative, grid)[0]
    if worst < _ROUNDING:
        worst = peak = 0.0
    rms = rms_mismatch(F, environment, lam, band_hz) if worst > 0 else 0.0
    return Transparency(
        tau=_ratio(peak, least),
        relative_mismatch=worst,
        rms_mismatch=rms,
        dc_ratio=_ratio(float(np.linalg.norm(F.dc(), 2)), float(static[0])) if static[0] > rounding else np.nan,
        high_frequency_gain=_high_frequency_gain(F, environment, 2 * np.pi * F.T * 100.0),
        band_hz=band_hz,
    )


def decibels(ratio: float) -> float:
    """Return 20 log10(ratio); -inf for 0."""
    return float(20 * np.log10(ratio)) if ratio > 0 else -np.inf


def _ratio(numerator: float, denominator: float) -> float:
    if denominator > 0:
        return numerator / denominator
    return np.inf if numerator > 0 else np.nan


def rms_mismatch(F: Lti, environment: Lti, lam: Sequence[int], band_hz: tuple[float, float] = BAND_HZ) -> float:
    """Return the rms mismatch over log frequency, a ratio; equal maps give about 0. Raises ValueError if E is zero."""
    target, low, high = _reference(environment, lam, band_hz)

    def square(logarithm: Array) -> Array:
        z = on_circle(np.exp(logarithm))
        E, M = environment.at(z), F.at(z) - target.at(z)
        return (np.abs(M) ** 2).sum(axis=(1, 2)) / (np.abs(E) ** 2).sum(axis=(1, 2))

    # The grid is dense where the ratio may have narrow peaks.
    logarithm = np.log(frequencies(F, environment, low=low, high=high, points=60))
    return float(np.sqrt(integral(square, logarithm) / (logarithm[-1] - logarithm[0])))


def _high_frequency_gain(F: Lti, environment: Lti, above: float) -> float:
    if above >= np.pi:
        return np.nan

    def gain(w: Array) -> Array:
        z = on_circle(w)
        return np.linalg.norm(F.at(z), 2, axis=(1, 2)) / np.linalg.norm(environment.at(z), 2, axis=(1, 2))

    return supremum(gain, frequencies(F, environment, low=above))[0]
