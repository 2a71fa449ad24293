"""Where the search for a transmission begins: the modes and splits of the mass that fit the spectrum.

A search in time stops at any mode but the right one, and two per cent from it is already another one: a mode is but a
few tenths of a hertz wide. The spectrum is that of the steps x[k+1] - x[k], which begin and end at rest, over that of
the forces, where the force had something to say.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.optimize import least_squares

from controller.lti import Array
from hw.identify.axis_model import COULOMB, Model

MODES_HZ = np.geomspace(25.0, 300.0, 60)  # where a mode is looked for first
PARTS = (0.15, 0.25, 0.35, 0.5, 0.65)  # of the mass, that the motor may have
STARTS = 2  # of the search in time
SPECTRUM = 250  # frequencies that are compared first
FLOOR = 1e-12  # of a ratio whose logarithm is taken
OUTLIER = 0.1  # of a logarithm, from which it counts less: friction spoils the low frequencies, a resonance is narrow


class Spectrum:
    """The measured ratio of steps to forces, and how far a model is from it."""

    def __init__(self, model: Model) -> None:
        force, moved = np.fft.rfft(model.force), np.fft.rfft(np.diff(model.x, append=model.x[-1]))
        loud = np.flatnonzero(np.abs(force) > 0.2 * np.abs(force).max())
        self.model, self.z = model, np.exp(2j * np.pi * loud / len(model.force))
        self.measured = np.log(np.abs(moved[loud] / force[loud]) + FLOOR)

    def apart(self, point: Array, every: int = 1) -> Array:
        """Logarithms of the model's ratio less the measured one's, at every so many frequencies."""
        A, B = self.model.matrices(point, self.model.T)
        z = self.z[::every]
        G = np.linalg.solve(z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B[:, None], (z.size, len(A), 1)))
        return np.log(np.abs((z - 1) * G[:, 0, 0]) + FLOOR) - self.measured[::every]

    def refined(self, point: Array) -> tuple[float, Array]:
        """The nearest point by all frequencies, and how far it is; Coulomb friction stays."""

        def apart(p: Array) -> Array:
            return self.apart(np.insert(p, COULOMB, point[COULOMB]))

        fit = least_squares(apart, np.delete(point, COULOMB), loss="soft_l1", f_scale=OUTLIER, max_nfev=40)
        return float(fit.cost), np.insert(fit.x, COULOMB, point[COULOMB])


def spectral_starts(model: Model, stiff: Array) -> list[Array]:
    """Parameters to begin with, best first, from those of a stiff device: [log m, log b, c]."""
    spectrum = Spectrum(model)
    every = max(1, spectrum.z.size // SPECTRUM)
    points, mass = [], float(np.exp(stiff[0]))
    for hz, part in product(MODES_HZ, PARTS):
        m1, m2 = part * mass, (1 - part) * mass
        k = (2 * np.pi * hz) ** 2 * m1 * m2 / mass
        point = np.array([np.log(m1), max(stiff[1], -2.0), stiff[COULOMB], np.log(m2), np.log(k)])
        # absolute: a few bins of a resonance may lie far apart
        points.append((float(np.abs(spectrum.apart(point, every)).mean()), point))
    best: dict[float, Array] = {}
    for _, point in sorted(points, key=lambda entry: entry[0]):
        best.setdefault(round(float(point[0]), 6), point)  # the best mode of every split
    refined = [spectrum.refined(point) for point in list(best.values())[:STARTS]]
    return [point for _, point in sorted(refined, key=lambda entry: entry[0])]
