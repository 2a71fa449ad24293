"""Mass, friction and transmission of one axis from a record of forces and displacements.

The model is the device's: motor (m1) with viscous friction b and Coulomb friction c, transmission spring k, handle
(m2); the rigid one has the motor alone. Between ticks it is exact for a held force (expm); Coulomb friction is
c tanh(v/v0), held too. Output error: the parameters whose simulated displacement is nearest to the encoder's, in the
least-squares sense. Residuals are correlated (rounding, friction that the model has not), so the covariance is the
sandwich (J'J)^-1 J' R J (J'J)^-1 with Bartlett weights (Newey and West 1987).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import expm
from scipy.optimize import OptimizeResult, least_squares

from controller.lti import Array

SLIP = 0.01  # [m/s] speed at which Coulomb friction is at 3/4
BANDWIDTH = 60  # [ticks] over which residuals may be correlated
EVALUATIONS = 100  # of a search, without those for derivatives
ONE_SIDED_95 = 1.6449  # normal quantile
MODES_HZ = np.geomspace(25.0, 300.0, 60)  # where a transmission mode is looked for first
PARTS = (0.15, 0.25, 0.35, 0.5, 0.65)  # of the mass, that the motor may have
SPECTRUM = 250  # frequencies that are compared


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


def identify(x: Array, force: Array, used: Array, T: float, step: float, rigid: bool, mass: float = 0.25) -> Estimate:
    """Fit one axis: displacements x (N,) [m], what the motor did (N,) [N], which samples count (N,), encoder step [m].

    `mass` is where the search begins. Raises ValueError where the device did not move or no model fits.
    """
    if np.ptp(x[used]) < 20 * step:
        raise ValueError(f"the axis moved by {np.ptp(x[used]) / step:.0f} encoder steps, at least 20 are needed")
    whole = _Model(x, force, used, T, rigid=True)
    fit = _search(whole, np.array([np.log(mass), 0.0, 0.0]))
    if rigid:
        return _settled(whole, fit, step)
    model = _Model(x, force, used, T, rigid=False)
    return _settled(model, _search(model, _start(model, fit.x)), step)


def _search(model: _Model, start: Array) -> OptimizeResult:
    """The nearest parameters within a factor of twenty of the start."""
    reach = np.where(np.arange(start.size) == 2, 10.0, 3.0)  # Coulomb friction is in newtons, the rest are logarithms
    bounds = (start - reach, start + reach)
    return least_squares(model.residual, start, x_scale="jac", bounds=bounds, max_nfev=EVALUATIONS)


def _settled(model: _Model, fit: OptimizeResult, step: float) -> Estimate:
    if not fit.success:
        raise ValueError(f"the fit did not converge: {fit.message}")
    return _estimate(model, fit.x, fit.fun, fit.jac, step)


def _start(model: _Model, whole: Array) -> Array:
    """Where to begin with a transmission: the mode and the split of the mass that fit the spectrum best.

    A search in time alone stops at any mode but the right one. The spectrum is that of the steps x[k+1] - x[k], which
    begin and end at rest, over that of the forces; it is compared in decibels, where the force had something to say.
    """
    n = len(model.force)
    force, moved = np.fft.rfft(model.force), np.fft.rfft(np.diff(model.x, append=model.x[-1]))
    z = np.exp(2j * np.pi * np.arange(force.size) / n)
    loud = np.flatnonzero(np.abs(force) > 0.2 * np.abs(force).max())
    loud = loud[:: max(1, loud.size // SPECTRUM)]
    measured, z = np.log(np.abs(moved[loud] / force[loud]) + 1e-12), z[loud]
    points, mass = [], float(np.exp(whole[0]))
    for hz, part in product(MODES_HZ, PARTS):
        m1, m2 = part * mass, (1 - part) * mass
        k = (2 * np.pi * hz) ** 2 * m1 * m2 / mass
        point = np.array([np.log(m1), max(whole[1], -2.0), 0.0, np.log(m2), np.log(k)])
        A, B = model.matrices(point)
        G = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B[:, None], (z.size, len(A), 1)))
        apart = np.log(np.abs((z - 1) * G[:, 0, 0]) + 1e-12) - measured
        points.append((float(np.abs(apart).mean()), point))  # absolute: a few bins of a resonance may lie far apart
    return min(points, key=lambda entry: entry[0])[1]


class _Model:
    """p = [log m1, log b, c, log m2, log k] -> simulated displacement."""

    def __init__(self, x: Array, force: Array, used: Array, T: float, rigid: bool) -> None:
        self.x, self.force, self.used, self.T, self.rigid = x, force, used, T, rigid

    def matrices(self, p: Array) -> tuple[Array, Array]:
        """The held plant: s+ = A s + B u with s = [positions; velocities]."""
        m1, b = np.exp(p[0]), np.exp(p[1])
        if self.rigid:
            a = np.array([[0.0, 1.0, 0.0], [0.0, -b / m1, 1 / m1], [0.0, 0.0, 0.0]])
        else:
            m2, k = np.exp(p[3]), np.exp(p[4])
            a = np.zeros((5, 5))
            a[0, 2] = a[1, 3] = 1.0
            a[2] = [-k / m1, k / m1, -b / m1, 0.0, 1 / m1]
            a[3, :2] = [k / m2, -k / m2]
        step = expm(a * self.T)
        return step[:-1, :-1], step[:-1, -1]

    def simulate(self, p: Array) -> Array:
        """Displacement (N,) [m] from rest."""
        A, B = self.matrices(p)
        n, c, velocity = len(A), float(p[2]), len(A) // 2
        s, x = np.zeros(n), np.empty(len(self.force))
        for k, u in enumerate(self.force.tolist()):
            x[k] = s[0]
            s = A.dot(s) + B * (u - c * np.tanh(s[velocity] / SLIP))
        return x

    def residual(self, p: Array) -> Array:
        """Measured less simulated (used,) [m]; where the origin lies is not known."""
        error = (self.x - self.simulate(p))[self.used]
        return np.nan_to_num(error - error.mean(), nan=1e3, posinf=1e3, neginf=-1e3)


def _estimate(model: _Model, p: Array, residual: Array, jacobian: Array, step: float) -> Estimate:
    covariance = _sandwich(jacobian, residual)
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
    rms = float(np.sqrt(np.mean(residual**2)))
    delta = max(0.0, float(b) - ONE_SIDED_95 * errors["viscous"])
    return Estimate(float(mass), float(m1), float(b), float(p[2]), k, mode, errors, delta, rms, rms / step)


def _sandwich(J: Array, residual: Array) -> Array:
    scores = J * residual[:, None]
    middle = scores.T @ scores
    for lag in range(1, min(BANDWIDTH, len(scores) - 1)):
        shared = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / BANDWIDTH) * (shared + shared.T)
    bread = np.linalg.pinv(J.T @ J)
    return bread @ middle @ bread
