"""Hermitian matrix inequalities at sampled frequencies, affine in real variables, with cutting planes.

A problem in frequency has infinitely many constraints of which few bind. It is solved with some of them, the
result is checked on a refined sweep by code that knows no solver, and the worst frequency is added.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray

from controller.lti import Array

Complex = NDArray[np.complex128]


def real_form(H: Complex) -> Array:
    """[[X, -Y], [Y, X]] of H = X + jY, (..., n, n) -> (..., 2n, 2n): Hermitian >= 0 iff symmetric >= 0."""
    return np.concatenate(
        [
            np.concatenate([H.real, -H.imag], axis=-1),
            np.concatenate([H.imag, H.real], axis=-1),
        ],
        axis=-2,
    )


def affine_lmis(constant: Complex, slopes: Complex, x: cp.Expression) -> list[cp.Constraint]:
    """constant[k] + sum_i slopes[i, k] x_i >= 0 for every frequency k.

    constant (k, n, n) and slopes (p, k, n, n) are Hermitian in their last two axes, x is (p,). One product
    with a constant matrix each: cvxpy compiles this much faster than block matrices of complex expressions.
    """
    fixed, by_x = real_form(constant), real_form(slopes)
    size = fixed.shape[-1]
    return [
        cp.reshape(by_x[:, k].reshape(len(by_x), -1).T @ x + fixed[k].ravel(), (size, size), order="C") >> 0
        for k in range(len(fixed))
    ]


def gain_lmi(
    rows: Complex, row_slopes: Complex, base: Complex, base_slopes: Complex | Array
) -> tuple[Complex, Complex]:
    """Constant and slopes of [[base, rows*], [rows, t I]], whose last variable is t.

    rows (k, p, m) with slopes (q, k, p, m); base (k, m, m) with slopes (q, k, m, m). Where base >= 0 it says
    rows* rows <= t base.
    """
    q, k, p, m = row_slopes.shape
    constant = np.zeros((k, m + p, m + p), dtype=np.complex128)
    slopes = np.zeros((q + 1, k, m + p, m + p), dtype=np.complex128)
    for target, top, low in ((constant, base, rows), (slopes[:q], base_slopes, row_slopes)):
        target[..., :m, :m] = top
        target[..., m:, :m] = low
        target[..., :m, m:] = np.conj(np.swapaxes(low, -1, -2))
    slopes[q, :, m:, m:] = np.eye(p)
    return constant, slopes
