"""Delays that vary: the condition under which no switching of the forces' delays within [lo, hi] is dangerous.

Let G = (I + Psi E V)^-1 Psi E be the forces as they leave, g = G x, and let the device hold of channel i the force
g_i[k - n] with an age n in [lo_i, hi_i] that may change at every tick. Beside the nominal
Theta_nom = (z^-lo + z^-hi)/2 the error w[k] = g[k-n] - (g[k-lo] + g[k-hi])/2 is half of a sum of hi - lo steps
g[j] - g[j-1], each with a sign, so by Cauchy's inequality, for every number of ticks,
    sum |w_i|^2 <= h_i^2 sum |g_i[k] - g_i[k-1]|^2,   h_i = (hi_i - lo_i)/2.
The steps of g are G dx, one tick later. With -w_i dx_i <= alpha_i |dx_i|^2 / 2 + |w_i|^2 / (2 alpha_i) the energy
argument of the closed-loop condition (design.margin) goes through if on |z| = 1, for one alpha > 0,
    [ He(Theta_nom G/(z-1)) + Delta_D/T - diag(alpha)/2    (h G)*        ]
    [ h G                                                   2 diag(alpha) ]  >  0,
G stable, G(1) symmetric positive semidefinite. It is jointly affine in (G, alpha), and alpha may not depend on the
frequency, since w is not a filtered g. For hi - lo = 1 nothing is lost in w: |w| = h |step| exactly.

What it shows holds for any motion x and any ages, hence for constant ones: the closed-loop condition is satisfied with
the same damping for every constant theta in the range.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.delay import delay
from controller.lti import Array, Lti
from design.frequency.sweep import hermitian

Complex = NDArray[np.complex128]


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def nominal(lo: Sequence[int], hi: Sequence[int], T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    half = Lti.constant(np.eye(len(lo)) / 2, T)
    return half @ (delay(lo, T) + delay(hi, T))


def nominal_over_step(z: Complex, lo: Sequence[int], hi: Sequence[int]) -> Complex:
    """The diagonal of Theta_nom/(z - 1), shape (k, m)."""
    z = np.asarray(z)[:, None]
    return (z ** -np.asarray(lo, dtype=float) + z ** -np.asarray(hi, dtype=float)) / 2 / (z - 1)


def blocks(
    z: Complex, G: Complex, alpha: Array, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float] | Array, T: float
) -> Complex:
    """The condition's matrix at each z (not 1), to be positive: (k, 2m, 2m) from z (k,), G(z) (k, m, m), alpha (m,).

    Affine in (G, alpha) together: for fixed z the upper left block is He(c G) + diag(delta/T - alpha/2) with
    c = diag(`nominal_over_step`), the lower left h G, the lower right 2 diag(alpha).
    """
    m, step = G.shape[-1], nominal_over_step(z, lo, hi)
    error = half_widths(lo, hi)[:, None] * G
    rows = np.zeros((len(z), 2 * m, 2 * m), dtype=np.complex128)
    rows[:, :m, :m] = hermitian(step[:, :, None] * G) + np.diag(np.asarray(delta) / T - alpha / 2)
    rows[:, m:, :m], rows[:, :m, m:] = error, np.conj(np.swapaxes(error, 1, 2))
    rows[:, m:, m:] = np.diag(2 * alpha)
    return rows
