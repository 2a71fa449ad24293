"""The exact convex set of spring-damper gains that satisfy Theorem 4, channel by channel.

With D = (z-1)/(Tz), W = K/D + B and N = (1 - z^-n)/(2 delta), n = theta + 1, the transformed coupling (11) is
V-hat = 1/W - N (a number per channel), and He V-hat >= Delta_V |V-hat|^2 times |W|^2 reads, in units
k = KT/delta, b = B/delta and Sigma = delta/Delta_V,

    k/2 + b >= |y|^2/4 + |1 - y/2|^2 / Sigma    on |z| = 1,    y = k (1 + ... + 1/z^theta) + b (1 - z^-n).

y is a polynomial in 1/z, affine in (k, b), so this is one linear matrix inequality, without conservatism.
psi = 0 needs no excess of passivity in V-hat (Sigma = inf): the last term is absent.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import cvxpy as cp
import numpy as np

from controller.lti import Array


def gain_set(k: cp.Expression, b: cp.Expression, theta: int, sigma: float) -> list[cp.Constraint]:
    """Constraints on the scalars k and b (units above); sigma = inf where psi = 0.

    Gram form: a trigonometric polynomial r - |c(z)|^2 is non-negative iff c c' <= Q for some Q >= 0 whose
    diagonals sum to r on the main one and to zero on the others.
    """
    n = theta + 1
    y = cp.hstack([k + b, *[k] * (n - 1), -b])  # coefficients of 1, 1/z, ..., z^-n
    columns = [y / 2]
    if np.isfinite(sigma):
        one = np.eye(n + 1)[0]
        columns.append((one - y / 2) / np.sqrt(sigma))
    c = cp.vstack(columns).T
    Q = cp.Variable((n + 1, n + 1), symmetric=True)
    sums = [cp.trace(Q) == k / 2 + b]
    sums += [cp.sum(cp.diag(Q, d)) == 0 for d in range(1, n + 1)]
    constraints = [cp.bmat([[Q, c], [c.T, np.eye(len(columns))]]) >> 0, *sums, k >= 0, b >= 0]
    return cast(list[cp.Constraint], constraints)  # cvxpy gives the type of == as bool


def gain_sets(gains: cp.Expression, theta: Sequence[int], sigma: Array) -> list[cp.Constraint]:
    """`gain_set` for every channel of gains = (k_1, ..., k_N, b_1, ..., b_N)."""
    N = len(theta)
    return [c for i in range(N) for c in gain_set(gains[i], gains[N + i], theta[i], float(sigma[i]))]
