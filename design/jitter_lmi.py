"""The condition for delays that vary as cvxpy blocks: affine in the force map G and the multiplier alpha together."""

from __future__ import annotations

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from design.jitter import half_widths, nominal_over_step


def block(
    z: complex,
    G: cp.Expression,
    alpha: cp.Expression,
    lo: Sequence[int],
    hi: Sequence[int],
    damping: cp.Expression,
    T: float,
) -> cp.Expression:
    """The Hermitian matrix (2m, 2m) that must be positive at this z (not 1); G(z) is (m, m), alpha and damping (m,).

    G may be any affine expression, such as Psi E - Psi E Q Psi E in the parameters of Q; one variable alpha >= 0
    serves all frequencies; `damping` [N s/m] is delta, or s delta with a variable s to find the required damping.
    Impose `block(..) >> 0` at every frequency sampled, and add those that design.jitter.jitter_proof finds violated.
    With G, alpha and damping all divided by some c the block is divided by c: use that to scale the problem.
    """
    c, h = nominal_over_step(np.array([z]), lo, hi)[0], half_widths(lo, hi)
    passing = cp.diag(cp.Constant(c)) @ G
    error = cp.diag(cp.Constant(h)) @ G
    upper = (passing + cp.conj(passing).T) / 2 + cp.diag(damping / T - alpha / 2)
    return cp.bmat([[upper, cp.conj(error).T], [error, cp.diag(2 * alpha)]])
