"""Test whether the damping of an axis is the same at every speed and at every frequency of a record.

The bound of hw/friction.py assumes that one number b describes the damping. Friction that thins with speed (grease), or
that has a memory (a dashpot behind a spring, a belt, a rubber mount), has no such number. At the speeds and frequencies
of a session it damps less than in slow motion. A record that shows either kind of friction is refused.

Speed: a stroke goes from one turning point to the next. Its kinetic energy begins and ends at zero, so the work of the
motor is W = b S2 + g S1 + q S3 + f0 dx + k d(x^2)/2 + l int f' v dt. Here S_n = int |v|^n dt, g is dry friction, f0 a
constant force, k a spring's stiffness and l the lag of an amplifier. For viscous and dry friction q = 0 at every
amplitude. Where friction thins, q < 0, and the damping at the speed v is b + q v.

Frequency: a model is fitted to the motion under the motor's force minus dry friction, drag, spring and drift. It has b,
a transmission, an amplifier's lag and one Maxwell element (c, tau). Several tau are tried in turn. The element's
damping c/(1 + (w tau)^2) acts in the record's slow strokes and vanishes at high frequency, where only b is left. A
certificate uses the damping at every frequency, so only b counts. The bound is the least lower confidence limit of b
over all tau. A memory that the record cannot exclude, for example because of a coarse encoder, therefore lowers the
bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array
from haptic_loop.hw.friction import SCALE, Friction, nonviscous

_FAST = 0.25  # a stroke counts if it reaches this share of the highest speed; dry friction then saturates
_FEW = 8  # least number of strokes
_SIGMAS = 2.0  # a thinning of at most this many standard errors counts as none
#: [s] time constants of a memory; a memory of 1 ms counts as damping; a 5 um encoder does not show it at 0.25 kg
_TAUS = (2e-3, 3e-3, 4e-3, 8e-3, 16e-3, 32e-3, 64e-3)
_BAND_HZ = (6.0, 130.0)  # below, cables and drift act; above, 1 N causes less motion than an encoder of 5 um resolves
_LOUD = 0.05  # least force at a frequency, as a share of the largest force at a frequency of the band
_POINTS = 200  # frequencies of a first, rough fit
_ALIASES = (-1, 0, 1)  # sampling adds the responses at w + 2 pi n/T for these n; those of other n are below 1e-3
_MODES_HZ = np.geomspace(20.0, 300.0, 40)  # initial frequencies of a transmission's mode
_PARTS = (0.15, 0.3, 0.5, 0.65)  # initial shares of the motor in the mass
_STEPS = 30  # largest number of evaluations in a fit
_VAGUE = 3.0  # prior standard deviation of log m1, log m2, log k and log d
_B, _C = 4, 7  # places of b and c among the parameters
_MUCH = 0.15  # largest share of a memory in the damping for which the linear fit suffices
_QUANTILE = 2.0  # one-sided 97.7 % quantile of the normal distribution
_SURE = 100.0  # log likelihood ratio above which a memory is proved; chance and poor friction models stay below


@dataclass(frozen=True)
class Viscosity:
    """The loss of damping with speed and with frequency that a record shows."""

    speed: float  # [m/s] highest speed of the record
    thinning: float  # [N s/m] damping lost between slow motion and that speed; 0 if none, or with few strokes
    thinning_error: float  # [N s/m] standard error of `thinning`
    lasting: float  # [N s/m] lower bound (97.7 %) of the damping that is left at high frequency
    memory: float  # [s] time constant of the memory that this bound assumes
    remembers: bool  # whether the record shows a memory; False if it merely cannot exclude one


def viscosity(x: Array, force: Array, T: float, step: float, friction: Friction) -> Viscosity:
    """Examine displacements x (N,) [m] under forces (N,) [N] held for T [s], of an axis with this `friction`.

    `step` [m] is the encoder step.
    """
    driving = force - nonviscous(x, T, step, friction)
    return Viscosity(*_thinning(x, force, T), *_lasting(x, driving, T, friction))


def doubt(found: Viscosity, friction: Friction) -> str | None:
    """Return why one number does not describe the damping within the error of its bound, or None if it does."""
    error = friction.viscous - friction.delta
    if found.thinning > _SIGMAS * found.thinning_error + error:
        return (
            "the energy of a stroke does not grow with the square of its speed: the damping falls by "
            f"{found.thinning:.2g} N s/m up to {found.speed:.2g} m/s, the bound's error is {error:.2g}"
        )
    if found.remembers and found.lasting < friction.delta:
        return (
            f"the damping falls with frequency, from {friction.viscous:.3g} N s/m to perhaps {found.lasting:.3g} "
            f"beyond {1 / (2 * np.pi * found.memory):.2g} Hz: friction with a memory has no viscous bound"
        )
    return None


# speed


def _thinning(x: Array, force: Array, T: float) -> tuple[float, float, float]:
    """Return the speed [m/s] that 99.5 % of samples do not exceed, the damping [N s/m] lost up to it, and its error.

    The standard error is infinite where fewer than _FEW strokes count.
    """
    import scipy

    n = max(3, round(6e-3 / T) | 1)  # At 3 Hz, cubics over 7 to 8 ms fit to far below an encoder count.
    smooth = scipy.signal.savgol_filter(x, n + 2, 3)
    v = scipy.signal.savgol_filter(x, n + 2, 3, deriv=1, delta=T)
    top = float(np.percentile(np.abs(v), 99.5))
    turns = np.flatnonzero(np.signbit(v[1:]) != np.signbit(v[:-1])) + 1
    rows = []
    for begin, end in pairwise(turns):
        part = slice(begin, end + 1)
        if np.abs(v[part]).max() < _FAST * top or end - begin < 2 * n:
            continue
        moments = [np.trapezoid(np.abs(v[part]) ** k, dx=T) for k in (1, 2, 3)]
        steps, rise = np.diff(smooth[begin : end + 1]), (force[begin:end] - force[begin - 1 : end - 1]) / T
        work, lag, ends = float(force[begin:end] @ steps), float(rise @ steps), (smooth[begin], smooth[end])
        rows.append((work, *moments, ends[1] - ends[0], (ends[1] ** 2 - ends[0] ** 2) / 2, lag))
    if len(rows) < _FEW:
        return top, 0.0, np.inf
    work, *columns = np.array(rows).T
    A = np.stack(columns, axis=1)
    scale = np.linalg.norm(A, axis=0)
    weight = 1 / np.sqrt(columns[1])  # the error of a stroke's work grows with the stroke

    def cubic(keep: NDArray[np.bool_]) -> float:
        """Return the coefficient q of S3, fitted to the strokes `keep`."""
        w = weight[keep]
        return float(np.linalg.lstsq(A[keep] / scale * w[:, None], work[keep] * w, rcond=None)[0][2] / scale[2])

    everything = np.ones(len(work), dtype=bool)
    group = np.arange(len(work)) % min(10, len(work) // 2)
    others = np.array([cubic(group != g) for g in range(group.max() + 1)])
    error = np.sqrt((len(others) - 1) / len(others) * np.sum((others - others.mean()) ** 2))
    return top, max(0.0, -cubic(everything) * top), float(error * top)


# frequency


class Spectra:
    """The spectrum of a motion, and that of a model's response to the force."""

    def __init__(
        self,
        x: Array,
        force: Array,
        T: float,
        held: bool = False,
        band: tuple[float, float] = _BAND_HZ,
        points: int = _POINTS,
    ) -> None:
        """Take both spectra at about `points` frequencies within `band` [Hz]; `held` if the handle is clamped."""
        self.T, self.ticks, self.held = T, len(x), held
        F, hz = np.fft.rfft(force), np.fft.rfftfreq(len(x), T)
        steps = np.fft.rfft(np.diff(x, append=x[-1]))
        heard = (hz > band[0]) & (hz < min(band[1], 0.35 / T))
        heard &= np.abs(F) > _LOUD * np.abs(F[heard]).max()
        chosen = np.flatnonzero(heard)
        chosen = chosen[:: max(1, len(chosen) // points)]
        self.hz = hz[chosen]
        w = 2 * np.pi * self.hz
        self.force, self.motion = F[chosen], steps[chosen] / (np.exp(1j * w * T) - 1)
        self._s = 1j * (w + 2 * np.pi / T * np.array(_ALIASES)[:, None])
        self._hold = -np.expm1(-self._s * T) / (self._s * T)

    def model(self, p: Array, tau: float = 1.0) -> NDArray[np.complex128]:
        """Return the motion for p = [log m1, log m2, log k, log d, b, lag, delay, c, end] and a memory of `tau` [s].

        m1 and m2 [kg] are motor and handle, k [N/m] and d [N s/m] the transmission between them. The model assumes
        that, after the record, a force `end` [N] of one tick stops the remaining motion. A shorter p is filled up with
        zeros.
        """
        (m1, m2, k, d), (b, lag, late, c, end), s = *_parameters(p), self._s
        link = k + d * s
        handle = link / s if self.held else m2 * s * link / (m2 * s * s + link)
        impedance = m1 * s + b + c / (1 + tau * s) + handle
        return (self._hold * np.exp(-s * late) / (1 + lag * s) / (s * impedance)).sum(axis=0) * (self.force + end)

    def derivatives(self, p: Array, tau: float = 1.0) -> NDArray[np.complex128]:
        """Return the exact derivatives (frequencies, len(p)) of `model` with respect to p."""
        (m1, m2, k, d), (b, lag, late, c, end), s = *_parameters(p), self._s
        link, memory = k + d * s, 1 / (1 + tau * s)
        still = np.zeros_like(s) if self.held else link / (m2 * s * s + link)  # the handle's motion over the motor's
        moving = 1 - still
        impedance = m1 * s + b + c * memory + moving * link / s
        response = self._hold * np.exp(-s * late) / (1 + lag * s) / (s * impedance)
        bent = -response / impedance  # the derivative with respect to the impedance
        per_link = bent * moving**2 / s
        columns = [bent * m1 * s, bent * m2 * s * still**2, per_link * k, per_link * d * s]
        columns += [bent, -response * s / (1 + lag * s), -response * s, bent * memory]
        sums = np.stack(columns).sum(axis=1) * (self.force + end)
        return np.vstack([sums, response.sum(axis=0)]).T[:, : len(p)]

    def error(self, p: Array, tau: float = 1.0) -> Array:
        """Return the real and imaginary parts of motion minus model, over the largest motion."""
        return self._real(self.motion - self.model(p, tau))

    def jacobian(self, p: Array, tau: float = 1.0) -> Array:
        """Return the derivatives of `error` with respect to p, (2 frequencies, len(p))."""
        return self._real(-self.derivatives(p, tau))

    def _real(self, values: NDArray[np.complex128]) -> Array:
        return np.concatenate([values.real, values.imag]) / np.abs(self.motion).max()


def _parameters(p: Array) -> tuple[Array, Array]:
    """Return [m1, m2, k, d] and [b, lag, delay, c, end] of `Spectra.model`."""
    return np.exp(p[:4]), np.append(p[4:], np.zeros(9 - len(p)))


def fitted(error: Any, jacobian: Any, start: Array, bounds: tuple[Array, Array], steps: int, **more: Any) -> Any:
    """Fit p by least squares from `start`, clipped to 1e-13 inside the `bounds`; `more` is for scipy."""
    import scipy

    begin = np.clip(start, bounds[0] + 1e-13, bounds[1] - 1e-13)
    how = {"bounds": bounds, "x_scale": "jac", "max_nfev": steps} | more
    return scipy.optimize.least_squares(error, begin, jacobian, **how)


def starts(spectra: Sequence[Spectra], friction: Friction, clamped: bool = False) -> list[Array]:
    """Return two initial parameter vectors: the mass splits and modes that explain the spectra's magnitudes best.

    The modes are those of a free handle, or of a `clamped` one.
    """
    tried = []
    for hz, part in product(_MODES_HZ, _PARTS):
        m1, m2 = part * friction.mass, (1 - part) * friction.mass
        k = (2 * np.pi * hz) ** 2 * m1 * (1.0 if clamped else m2 / friction.mass)
        p = np.array([*np.log([m1, m2, k, 0.03 * np.sqrt(k * m1)]), max(friction.viscous, 1e-3), 1e-5, 1e-5, 0.0, 0.0])
        sizes = (np.log(np.abs(each.model(p) / each.motion) + 1e-15) for each in spectra)
        tried.append((float(sum(np.abs(size).mean() for size in sizes)), len(tried), p))
    return [p for *_, p in sorted(tried)[:2]]


def _lasting(x: Array, force: Array, T: float, friction: Friction) -> tuple[float, float, bool]:
    """Return the least lower bound of b [N s/m] over all tau, its tau [s], and whether the record shows a memory.

    `force` is the force of the motor less `nonviscous`. The model without memory is fitted to all frequencies. A small
    Maxwell element changes the motion less than the mass does, so its effect is linear in c, and each tau takes one
    linear fit. But the lag and the transmission of the model without memory may imitate a large element. So all
    parameters are also fitted from starts with most of the damping in the element. Such a fit counts if it explains
    the record about as well as the model without memory.
    """
    import scipy

    few, every = Spectra(x, force, T), Spectra(x, force, T, points=len(x))
    low = np.array([-20.0] * 4 + [0.0, 0.0, -T, 0.0, -np.inf])  # delay >= -T: an encoder may be read after forces latch
    high = np.array([25.0] * 4 + [np.inf, 2 * T, 2 * T, np.inf, np.inf])

    def fit_of(spectra: Spectra, start: Array, tau: float | None = None) -> Any:
        """Return the fit that begins at `start`; without tau, c stays near 0."""
        top = np.where(np.arange(9) == _C, 1e-12, high) if tau is None else high
        error, jacobian = (partial(of, tau=tau or 1.0) for of in (spectra.error, spectra.jacobian))
        return fitted(error, jacobian, start, (low, top), _STEPS)

    begins = starts([few], friction)
    rough = min((fit_of(few, start) for start in begins), key=lambda fit: fit.cost)
    plain = fit_of(every, rough.x)
    left, points = plain.fun, len(every.force)
    noise = np.sqrt(float(left @ left) / len(left))
    # weak priors, because a rigid device does not determine a transmission, and a delay acts like a lag
    vague = noise * np.diag([1 / _VAGUE] * 4 + [0.0] + [1 / T] * 2 + [0.0] * 2)

    def linear(jacobian: Array, errors: Array) -> tuple[Array, Array, float]:
        """Return the best change of p (9,), its standard errors (9,) and the remaining sum of squares."""
        columns = np.vstack([jacobian, vague])
        size = np.linalg.norm(columns, axis=0) + 1e-300
        q, r = np.linalg.qr(columns / size)
        known = np.append(errors, np.zeros(len(vague)))
        rest = known - q @ (q.T @ known)
        inverse = scipy.linalg.solve_triangular(r, np.eye(len(r)))
        spread = np.linalg.norm(inverse, axis=1) * np.linalg.norm(rest) / np.sqrt(len(errors) - len(r))
        return -(inverse @ (q.T @ known)) / size, spread / size, float(rest @ rest)

    least, memory, best, part = np.inf, 0.0, float(left @ left), 0.0
    for tau in _TAUS:
        change, spread, squares = linear(every.jacobian(plain.x, tau), left)
        b, c = float(plain.x[_B] + min(change[_B], 0.0)), float(change[_C])
        tried = [_split(start, friction.viscous) for start in (plain.x, begins[0])]
        if unsure := abs(c) + _QUANTILE * spread[_C] > _MUCH * plain.x[_B]:
            tried.append(plain.x + change)
        near = min((fit_of(few, start, tau) for start in tried), key=lambda fit: fit.cost)
        if unsure or near.x[_C] > _MUCH * (near.x[_B] + near.x[_C]):
            fit = fit_of(every, near.x, tau)
            if points * np.log(2 * fit.cost / float(left @ left)) < _SURE:
                _, spread, _ = linear(fit.jac, fit.fun)
                squares = 2 * float(fit.cost)
                b, c = min(b, float(fit.x[_B])), float(fit.x[_C])
        if b - _QUANTILE * spread[_B] < least:
            least, memory = float(b - _QUANTILE * spread[_B]), tau
        if squares < best:
            best, part = squares, c / max(b + c, 1e-9)
    remembers = part > _MUCH and points * np.log(float(left @ left) / best) > _SURE
    return max(0.0, (1 - SCALE) * least), memory, bool(remembers)


def _split(p: Array, viscous: float) -> Array:
    """Return the parameters with most of the damping [N s/m] in the memory."""
    p = p.copy()
    p[[_B, _C]] = 0.3 * viscous, 0.7 * viscous
    return p
