"""One step of the convex-concave sequence for ||W1 L W2||_inf (23) over spring-damper gains.

With g = k + b (1 - 1/z) per channel the norm is below mu iff (W1 L g W2)* (W1 L g W2) <= mu^2 g* g on |z| = 1:
L g is affine in the gains, and g* g is replaced by its tangent at the gains before, which lies below it. So every
step keeps what the one before achieved, and mu^2 enters linearly: no bisection.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.gains.gain_set import solve_within
from design.semidefinite.sampled import Complex, affine_lmis, gain_lmi
from design.shaping import Shaping
from design.solve import solved
from design.specification import Specification


def step(spec: Specification, sigma: Array, shaping: Shaping, at: Array, norm: float, w: Array) -> tuple[Array, float]:
    """(gains, bound on the norm at the frequencies w) of one convex-concave step from the gains `at`."""
    N = spec.channels
    gains, t = cp.Variable(2 * N), cp.Variable()
    constant, slopes = _tangent(spec, shaping, at, norm, w)
    cuts = affine_lmis(constant, slopes, cp.hstack([gains, t]))
    solve_within(cp.Minimize(t), gains, spec.theta, sigma, "a step of the convex sequence", cuts)
    return solved(gains), norm * float(np.sqrt(solved(t)))


def _tangent(spec: Specification, shaping: Shaping, at: Array, norm: float, w: Array) -> tuple[Complex, Complex]:
    """[[g0* g + g* g0 - g0* g0, (W1 L g W2)*], [W1 L g W2, t norm^2]], scaled to order one; t is the last variable."""
    N = spec.channels
    left, right, late = shaping.parts(w)
    difference = 1 - np.exp(-1j * w)
    basis = np.eye(N)[:, None, :] * np.ones((w.size, 1))  # (N, k, N): e_i at every frequency
    g = np.concatenate([basis, basis * difference[:, None]])  # (2N, k, N): diagonals of g by variable
    g0 = np.tensordot(at, g, axes=1)  # (k, N)
    scale = 1 / np.abs(g0)  # columns are divided by |g0|, rows by the norm
    rows = (left * (spec.T / spec.usable)) @ right * scale[:, None, :] / norm
    row_slopes = (late * g[:, :, None, :]) @ right * scale[:, None, :] / norm
    tangent = 2 * (np.conj(g0) * g).real * scale**2
    diagonal = np.eye(N)
    base = -np.broadcast_to(diagonal, (w.size, N, N)).astype(np.complex128)
    return gain_lmi(rows, row_slopes, base, tangent[..., None] * diagonal)
