"""Mass, friction and transmission of one axis from a record of forces and displacements.

Output error: the parameters of axis_model.py whose simulated displacement is nearest to the encoder's, in the
least-squares sense, where a standstill counts as few samples (standstill.py). How far the estimate scatters: spread.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from controller.lti import Array
from hw.identify.axis_model import COULOMB, Flags, Model
from hw.identify.spectrum import spectral_starts
from hw.identify.spread import spread

EVALUATIONS = 60, 30  # of a search without Coulomb friction and with it, less those for derivatives
POLISH = 15  # steps at the end, with friction integrated more finely
ENOUGH = 1e-6  # part of the sum of squares, from which on a step is the last one
ONE_SIDED_95 = 1.6449  # normal quantile
VAGUE = 0.1  # standard error of b, as a part of b, above which nothing is said of it
FRICTIONS = (1e-5, 0.01, 0.05)  # Coulomb friction that a search begins with, of the force's span
REACH = 3.0  # of a search, in logarithms


@dataclass(frozen=True, eq=False)
class Estimate:
    """One axis, with standard errors."""

    mass: float  # [kg] in all
    motor_mass: float  # [kg]
    viscous: float  # b [N s/m]
    coulomb: float  # c [N]
    stiffness: float | None  # k [N/m] of the transmission, None for a rigid device
    mode_hz: float | None  # the transmission mode, free at both ends
    errors: dict[str, float]  # standard errors of mass, viscous, coulomb
    delta: float  # [N s/m] 95 % lower confidence bound of b
    rms: float  # [m] of the residual
    steps: float  # the same in encoder steps


def identify(x: Array, force: Array, used: Flags, T: float, step: float, rigid: bool, mass: float = 0.25) -> Estimate:
    """Fit one axis: displacements x (N,) [m], what the motor did (N,) [N], which samples count (N,), encoder step [m].

    `mass` is where the search begins. Raises ValueError where the device did not move or no model fits.
    """
    if np.ptp(x[used]) < 20 * step:
        raise ValueError(f"the axis moved by {np.ptp(x[used]) / step:.0f} encoder steps, at least 20 are needed")
    whole = Model(x, force, used, T, step, rigid=True)
    stiff = _with_coulomb(whole, _without_coulomb(whole, np.array([np.log(mass), 0.0])).x)
    if rigid:
        fine = whole.finer()
        return _settled(fine, _polished(fine, stiff.x))
    model = Model(x, force, used, T, step, rigid=False)
    fine, ends = model.finer(), []
    for start in spectral_starts(model, stiff.x):
        p = _polished(fine, _search(model, start).x)
        ends.append((fine.rms(fine.residual(p)), p))
        if ends[-1][0] <= fine.allowed():
            break
    return _settled(fine, min(ends, key=lambda end: end[0])[1])


def _without_coulomb(model: Model, start: Array) -> OptimizeResult:
    """The nearest parameters within a factor of twenty of the start, which lacks c as the result does.

    Coulomb friction bends the sum of squares so sharply that a search from afar with it does not arrive.
    """

    def residual(p: Array) -> Array:
        return model.residual(np.insert(p, COULOMB, 0.0))

    bounds = (start - REACH, start + REACH)
    return least_squares(residual, start, x_scale="jac", bounds=bounds, max_nfev=EVALUATIONS[0])


def _with_coulomb(model: Model, near: Array) -> OptimizeResult:
    """All parameters, from a start that lacks c: hardly any at first, then more as long as much is unexplained."""
    fits = []
    for part in FRICTIONS:
        fits.append(_search(model, np.insert(near, COULOMB, part * np.ptp(model.force))))
        if model.rms(fits[-1].fun) <= model.allowed():
            break
    return min(fits, key=lambda fit: fit.cost)


def _search(model: Model, start: Array) -> OptimizeResult:
    strongest = np.ptp(model.force)
    start = start.copy()
    start[COULOMB] = np.clip(start[COULOMB], FRICTIONS[0] * strongest, strongest / 2)
    free = np.arange(start.size) != COULOMB
    bounds = (np.where(free, start - REACH, 0.0), np.where(free, start + REACH, strongest))
    # the tolerance is of a sum of squares with a kink; what is left unexplained is looked at afterwards
    options: dict[str, Any] = {"x_scale": "jac", "max_nfev": EVALUATIONS[1], "ftol": 1e-4}
    slopes: Any = lambda p: -model.slopes(p)  # noqa: E731 - SciPy's stub takes names only
    return least_squares(model.residual, start, slopes, bounds=bounds, **options)


def _polished(model: Model, p: Array) -> Array:
    """The nearest parameters from close by: Gauss-Newton steps as long as they help, halved where they do not.

    A search that stops where its sum of squares hardly changes may be several standard errors away.
    """
    residual = model.residual(p)
    for _ in range(POLISH):
        change = np.linalg.lstsq(model.slopes(p), residual, rcond=None)[0]
        for part in (1.0, 0.5, 0.1):
            other = p + part * change
            other[COULOMB] = max(0.0, other[COULOMB])
            left = model.residual(other)
            if left @ left < residual @ residual:
                break
        else:
            break
        gain = 1 - (left @ left) / (residual @ residual)
        p, residual = other, left
        if gain < ENOUGH:
            break
    return p


def _settled(model: Model, p: Array) -> Estimate:
    step, rms, allowed = model.step, model.rms(model.residual(p)), model.allowed()
    if rms > allowed:
        raise ValueError(
            f"the model leaves {rms / step:.2g} encoder steps rms unexplained, at most {allowed / step:.2g} may be "
            "(friction of another kind, a hand at the handle, gravity, or a slipping drive?)"
        )
    estimate = _estimate(model, p, rms)
    vague = estimate.errors["viscous"] / estimate.viscous
    if vague > VAGUE:
        raise ValueError(
            f"the record does not tell viscous from dry friction: {estimate.viscous:.3g} N s/m, standard error "
            f"{100 * vague:.0f} %, at most {100 * VAGUE:.0f} % may be; take one with more force or a longer one"
        )
    return estimate


def _estimate(model: Model, p: Array, rms: float) -> Estimate:
    scatter = spread(model, p)
    covariance = scatter.covariance
    m1, b = np.exp(p[0]), np.exp(p[1])
    gradient = np.zeros(p.size)
    gradient[0], mass, k, mode = m1, m1, None, None
    if not model.rigid:
        m2, k = np.exp(p[3]), float(np.exp(p[4]))
        mass, gradient[3] = m1 + m2, m2
        mode = float(np.sqrt(k * mass / (m1 * m2)) / (2 * np.pi))
    errors = {
        "mass": float(np.sqrt(gradient @ covariance @ gradient)),
        "viscous": float(b * np.sqrt(covariance[1, 1])),
        "coulomb": float(np.sqrt(covariance[2, 2])),
    }
    above = max(0.0, float(b * scatter.bias[1]))  # on average; a bias to the safe side is left where it is
    delta = max(0.0, float(b) - above - ONE_SIDED_95 * errors["viscous"])
    return Estimate(float(mass), float(m1), float(b), float(p[2]), k, mode, errors, delta, rms, rms / model.step)
