"""One axis as fit.py looks at it: the displacement that a record of forces gives, for any mass, friction, transmission.

The model is the device's: motor (m1) with viscous friction b and Coulomb friction c, transmission spring k, handle
(m2); the rigid one has the motor alone. Between ticks it is exact for a held force (expm); Coulomb friction is
c tanh(v/v0), held for an eighth of a tick.
"""

from __future__ import annotations

from math import tanh

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from controller.lti import Array
from hw.identify.standstill import worth

Flags = NDArray[np.bool_]

COULOMB = 2  # where Coulomb friction is among the parameters
SHIFT = 1e-5  # of log parameters, and of Coulomb friction in newtons, for derivatives
UNEXPLAINED = 0.7, 1.5e-3  # encoder steps rms (rounding alone leaves 0.29), or this part of the motion's rms
SLIP = 0.002  # [m/s] speed at which Coulomb friction is at 3/4
COARSE, FINE = 3, 8  # substeps of a tick for which it is held: in a search, and at its end


class Model:
    """p = [log m1, log b, c, log m2, log k] -> simulated displacement."""

    def __init__(
        self, x: Array, force: Array, used: Flags, T: float, step: float, rigid: bool, substeps: int = COARSE
    ) -> None:
        self.x, self.force, self.used, self.T, self.step, self.rigid = x, force, used, T, step, rigid
        self.substeps = substeps
        self.weight = worth(np.round(x[used] / step))

    def finer(self) -> Model:
        """The same record, friction integrated more finely."""
        return Model(self.x, self.force, self.used, self.T, self.step, self.rigid, FINE)

    def matrices(self, p: Array, T: float) -> tuple[Array, Array]:
        """The plant held for T: s+ = A s + B u with s = [positions; velocities]."""
        m1, b = np.exp(p[0]), np.exp(p[1])
        if self.rigid:
            a = np.array([[0.0, 1.0, 0.0], [0.0, -b / m1, 1 / m1], [0.0, 0.0, 0.0]])
        else:
            m2, k = np.exp(p[3]), np.exp(p[4])
            a = np.zeros((5, 5))
            a[0, 2] = a[1, 3] = 1.0
            a[2] = [-k / m1, k / m1, -b / m1, 0.0, 1 / m1]
            a[3, :2] = [k / m2, -k / m2]
        step = np.asarray(expm(a * T), dtype=np.float64)
        return step[:-1, :-1], step[:-1, -1]

    def simulate(self, p: Array) -> Array:
        """Displacement (N,) [m] from rest."""
        substeps = self.substeps if p[COULOMB] else 1
        A, B = self.matrices(p, self.T / substeps)
        play = _play_rigid if self.rigid else _play_compliant
        return np.array(play(A.tolist(), B.tolist(), float(p[COULOMB]), self.force.tolist(), substeps))

    def allowed(self) -> float:
        """What a fit may leave unexplained [m] rms."""
        return max(UNEXPLAINED[0] * self.step, UNEXPLAINED[1] * float(np.std(self.x[self.used])))

    def error(self, p: Array) -> Array:
        """Measured less simulated (used,) [m]; where the origin lies is not known."""
        error = (self.x - self.simulate(p))[self.used]
        error -= np.average(error, weights=self.weight)
        return np.nan_to_num(error, nan=1e3, posinf=1e3, neginf=-1e3)

    def residual(self, p: Array) -> Array:
        """What a fit makes small: the error (used,) [m], times the root of what a sample is worth."""
        return np.sqrt(self.weight) * self.error(p)

    def jacobian(self, p: Array) -> Array:
        """Derivatives of the displacement (used, p) by central differences."""
        shifts = SHIFT * np.eye(p.size)
        columns = [(self.simulate(p + s) - self.simulate(p - s))[self.used] for s in shifts]
        return np.stack(columns, axis=1) / (2 * SHIFT)

    def slopes(self, p: Array) -> Array:
        """Derivatives of what is subtracted in residual() (used, p)."""
        J = self.jacobian(p)
        return np.sqrt(self.weight)[:, None] * (J - np.average(J, axis=0, weights=self.weight))

    def rms(self, residual: Array) -> float:
        """[m] of the error behind a residual."""
        return float(np.sqrt(residual @ residual / self.weight.sum()))


def _play_rigid(A: list[list[float]], B: list[float], c: float, force: list[float], substeps: int) -> list[float]:
    """Displacements of one mass; plain floats, since a product of so few numbers is nothing but overhead to NumPy."""
    (_, xv), (_, vv) = A
    bx, bv = B
    x, v, out = 0.0, 0.0, []
    for f in force:
        out.append(x)
        for _ in range(substeps):
            u = f - c * tanh(v / SLIP)
            x, v = x + xv * v + bx * u, vv * v + bv * u
    return out


def _play_compliant(A: list[list[float]], B: list[float], c: float, force: list[float], substeps: int) -> list[float]:
    """Displacements of the motor of two masses."""
    (a00, a01, a02, a03), (a10, a11, a12, a13), (a20, a21, a22, a23), (a30, a31, a32, a33) = A
    b0, b1, b2, b3 = B
    x, y, v, w, out = 0.0, 0.0, 0.0, 0.0, []
    for f in force:
        out.append(x)
        for _ in range(substeps):
            u = f - c * tanh(v / SLIP)
            x, y, v, w = (
                a00 * x + a01 * y + a02 * v + a03 * w + b0 * u,
                a10 * x + a11 * y + a12 * v + a13 * w + b1 * u,
                a20 * x + a21 * y + a22 * v + a23 * w + b2 * u,
                a30 * x + a31 * y + a32 * v + a33 * w + b3 * u,
            )
    return out
