"""Bound a motor's mass and its transmission from records with the handle free and with the handle clamped.

The known-device conditions need these bounds: the least mass at the motor, the largest stiffness k of the transmission,
and the least and the largest value of its damping b. With a clamped handle, motor and transmission are a mass on a
spring and a damper. With a free handle, the motor's own damping slows all motion, and b damps only the mode between
motor and handle. One model is fitted to the spectra of all records together, with clamped records at two levels of
force.

Each bound is the estimate, moved by two standard errors (95 %) and by 0.5 % for the scale of the encoder. The standard
errors come from fits that omit a part of one record's frequencies, so they include the errors of the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array
from haptic_loop.hw.friction import Friction, at_radius, dry_friction
from haptic_loop.hw.viscosity import Spectra, fitted, starts

_BAND_HZ = (6.0, 250.0)  # below, cables and dry friction act; above, 1 N causes less motion than a count of 5 um
_ALLOWED = 0.01  # allowed error of the model, as a share of the motion; the encoder's noise is allowed in addition
#: largest rms error, in units of the allowed error: play or presliding friction give 3 to 6, dry friction up to 2.1
_UNEXPLAINED = 2.5
_GROUPS = 5  # groups of a record's frequencies that are left out in turn
_SIGMAS, _SCALE = 2.0, 0.005  # standard errors, and relative error of the encoder, by which bounds are moved
_WITHIN = (2.0, 0.85)  # multiples of the lowest and of the highest frequency that must enclose the clamped mode
_STEPS = 60  # most evaluations in a fit
_LATE = 0.05  # [T] largest sum of lag and delay of a force, such as a current loop's; no proof covers a larger one
_FIXED = np.array([-20.0] * 4 + [0.0, 0.0])  # lower bounds of log m1, log m2, log k, log b, delta and lag


@dataclass(frozen=True)
class TransmissionBounds:
    """Bounds of one axis with 95 % confidence, and the estimates."""

    motor_mass_min: float  # [kg]
    transmission_stiffness_max: float  # [N/m]
    transmission_damping_min: float  # [N s/m]
    transmission_damping_max: float  # [N s/m]
    motor_mass: float  # [kg] estimate
    handle_mass: float  # [kg] estimate
    transmission_stiffness: float  # [N/m] estimate
    transmission_damping: float  # [N s/m] estimate
    late: float  # [s] upper bound of lag plus delay of the forces


class _Joint:
    """The records of one axis with one model of them all: p = [log m1, log m2, log k, log b, delta, lag, delay].

    m1 and m2 [kg] are the masses of motor and handle, k [N/m] and b [N s/m] belong to the transmission, delta [N s/m]
    is the motor's damping, and the forces have a lag and a delay [s]. Spectra.model writes d for b, and b for delta.
    """

    def __init__(self, records: Sequence[Spectra], step: float) -> None:
        self.records = records
        self._scale = [np.hypot(step * np.sqrt(r.ticks / 12), _ALLOWED * np.abs(r.motion)) for r in records]

    def errors(self, p: Array) -> list[NDArray[np.complex128]]:
        """Return the difference of motion and model for every record, in units of the allowed error."""
        return [(r.motion - r.model(p)) / scale for r, scale in zip(self.records, self._scale, strict=True)]

    def _derivatives(self, p: Array) -> list[NDArray[np.complex128]]:
        """Return the derivatives (frequencies, 7) of `errors` with respect to p."""
        return [-r.derivatives(p) / s[:, None] for r, s in zip(self.records, self._scale, strict=True)]

    def fitted(self, start: Array, keep: Sequence[NDArray[np.bool_]]) -> Array:
        """Return p, fitted from `start` to the frequencies `keep` of each record."""

        def real(values: list[NDArray[np.complex128]]) -> Array:
            kept = np.concatenate([each[some] for each, some in zip(values, keep, strict=True)])
            return np.concatenate([kept.real, kept.imag])

        T = self.records[0].T
        limits = np.append(_FIXED, -0.2 * T), np.array([25.0] * 4 + [np.inf, 2 * T, 2 * T])
        functions = (lambda p: real(self.errors(p))), (lambda p: real(self._derivatives(p)))
        return fitted(*functions, start, limits, _STEPS, loss="soft_l1").x


def transmission_bounds(
    free: tuple[Array, Array],
    clamped: Sequence[tuple[Array, Array]],
    T: float,
    step: float,
    friction: Friction,
    lever: float = 1.0,
) -> TransmissionBounds:
    """Return the bounds of one axis from its records: displacements [m] and forces [N], one of each per period T [s].

    `step` [m] is the encoder step, `friction` was estimated from the free record. For a rotary axis with the hand at
    the radius `lever` [m], arguments and results are in radians and N m; the fit is made in metres and N at the hand.

    Raises:
        ValueError: Two masses with a spring and a damper in parallel do not explain the records, the clamped mode is
            too near an end of the band, forces are too late, or a bound is not above 0.
    """
    records, friction = [], at_radius(friction, 1 / lever)
    for (x, force), held in ((free, False), *((record, True) for record in clamped)):
        dry = dry_friction(lever * x, T, friction)
        records.append(Spectra(lever * x, force / lever - dry, T, held, _BAND_HZ))
    joint, everything = _Joint(records, lever * step), [np.ones(r.hz.size, dtype=bool) for r in records]
    p = joint.fitted(starts(records, friction, clamped=True)[0][:7], everything)
    for r, error in zip(records, joint.errors(p), strict=True):
        if (rms := float(np.sqrt(np.mean(np.abs(error) ** 2)))) > _UNEXPLAINED:
            which = "clamped" if r.held else "free"
            raise ValueError(
                f"a spring and a damper in parallel leave {rms:.1f} times the expected error in a record with a "
                f"{which} handle, allowed is {_UNEXPLAINED:g}: play, presliding friction, or the handle was not {which}"
            )
    mode = np.sqrt(np.exp(p[2] - p[0])) / (2 * np.pi)
    lowest, highest = _WITHIN[0] * records[-1].hz.min(), _WITHIN[1] * records[-1].hz.max()
    if not lowest < mode < highest:
        allowed = f"{lowest:.0f} to {highest:.0f} Hz"
        raise ValueError(f"the clamped mode is at {mode:.0f} Hz, allowed are {allowed}: change --band")
    others = []
    for i, r in enumerate(records):
        group = np.arange(r.hz.size) * _GROUPS // r.hz.size
        for g in range(_GROUPS):
            others.append(_figures(joint.fitted(p, [*everything[:i], group != g, *everything[i + 1 :]])))
    spread = np.array(others) - np.mean(others, axis=0)
    m1, k, b, late = _figures(p)
    margin = _SIGMAS * np.sqrt((1 - 1 / len(others)) * (spread**2).sum(axis=0)) + _SCALE * np.array([m1, k, b, 0.0])
    least, most = np.array([m1, k, b, late]) - margin, np.array([m1, k, b, late]) + margin
    if most[3] > _LATE * T:
        raise ValueError(f"forces are up to {1e6 * most[3]:.0f} us late, at most {1e6 * _LATE * T:.0f} us are allowed")
    if not (least[0] > 0 and least[2] > 0):
        shown = lever**2 * np.array([m1, least[0], b, least[2]])
        mass = f"motor mass {shown[0]:.3g} kg has the lower bound {shown[1]:.2g}"
        damping = f"transmission damping {shown[2]:.3g} N s/m has the lower bound {shown[3]:.2g}"
        raise ValueError(f"{mass if least[0] <= 0 else damping}, which is not above 0")
    figures = least[0], most[1], least[2], most[2], m1, float(np.exp(p[1])), k, b, max(most[3], 0.0)
    return at_radius(TransmissionBounds(*figures), lever)


def _figures(p: Array) -> tuple[float, float, float, float]:
    """Return motor mass [kg], stiffness [N/m] and damping [N s/m] of the transmission, and lag with delay [s]."""
    m1, _, k, b = np.exp(p[:4]).tolist()
    return m1, k, b, float(p[5] + p[6])
