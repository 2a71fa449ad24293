"""What a condition asks of the devices at each frequency; its supremum is the required damping (design.margin).

Both functions return w [rad/sample] -> s(w): the multiple of Delta_D that the condition needs at that frequency,
regular at w = 0, where G/(z-1) is split into G(1)/(z-1), whose Hermitian part on the circle is -G(1)/2, and the
quotient (G(z) - G(1))/(z - 1). Below zero where the loop itself dissipates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti
from design.frequency.sweep import Response, hermitian, on_circle


def closed_loop_demand(F: Lti, delta: Sequence[float]) -> Response:
    """The least s with He[F/(z-1)] >= -s Delta_D/T; F stable with F(1) symmetric, delta (m,) > 0 [N s/m]."""
    F1, regular = F.dc(), F.quotient_at_one()
    weight = np.sqrt(F.T / np.asarray(delta))

    def demand(w: Array) -> Array:
        H = F1 / 2 - hermitian(regular.at(on_circle(w)))
        return np.linalg.eigvalsh(weight[:, None] * H * weight)[:, -1]

    return demand


def theorem4_demand(V: Lti, theta: Sequence[int], delta: Sequence[float]) -> Response:
    """The least s with (V(1)/2 - He[(V - V(1))/(z - 1)]) / T >= diag(|vt_i|^2 / (4 s delta_i)); inf where none is.

    vt_i = 1 + 1/z + ... + z^-theta_i, V stable with V(1) symmetric, psi = 0, delta (m,) > 0 [N s/m].
    """
    V1, regular = V.dc(), V.quotient_at_one()

    def passivity(w: Array) -> NDArray[np.complex128]:
        return (V1 / 2 - hermitian(regular.at(on_circle(w)))) / V.T

    def window(w: Array) -> Array:
        """|vt_i|^2 / (4 delta_i), shape (k, m)."""
        vt = [np.exp(-1j * np.outer(w, np.arange(n + 1))).sum(axis=1) for n in theta]
        return np.abs(np.stack(vt, axis=1)) ** 2 / (4 * np.asarray(delta))

    def demand(w: Array) -> Array:
        eigenvalues, basis = np.linalg.eigh(passivity(w))
        floor = np.maximum(1e-13 * np.abs(eigenvalues).max(axis=1, keepdims=True), np.finfo(float).tiny)
        whitened = np.conj(np.swapaxes(basis, 1, 2)) / np.sqrt(np.maximum(eigenvalues, floor))[:, :, None]
        H = whitened @ (window(w)[:, :, None] * np.conj(np.swapaxes(whitened, 1, 2)))
        return np.where(eigenvalues[:, 0] > floor[:, 0], np.linalg.eigvalsh(H)[:, -1], np.inf)

    return demand
