"""The exact convex set of spring-damper gains that satisfy Theorem 4, channel by channel.

With D = (z-1)/(Tz), W = K/D + B and N = (1 - z^-n)/(2 delta), n = theta + 1, the transformed coupling (11) is
V-hat = 1/W - N (a number per channel), and He V-hat >= Delta_V |V-hat|^2 times |W|^2 reads, in units
k = KT/delta, b = B/delta and Sigma = delta/Delta_V,

    k/2 + b >= |y|^2/4 + |1 - y/2|^2 / Sigma    on |z| = 1,    y = k (1 + ... + 1/z^theta) + b (1 - z^-n).

y is a polynomial in 1/z, affine in (k, b), so this is one linear matrix inequality, without conservatism.
psi = 0 needs no excess of passivity in V-hat (Sigma = inf): the last term is absent.

Its matrix has theta + 2 rows and its solution costs their fifth power, so beyond LARGEST_GRAM samples the inequality
is imposed frequency by frequency - a second-order cone in the two unknowns - and where the solution fails in between,
there too (`solve_within`). The cones contain the set and the rounds shrink them to it: both ways end at the same gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import cvxpy as cp
import numpy as np

from controller.lti import Array
from design.failure import DesignFailed
from design.frequency.sweep import peaks
from design.solve import solve, solved

LARGEST_GRAM = 12  # samples of delay
PER_LOBE = 8  # frequencies per ripple of y at which the inequality is imposed first
MISSED = 2e-6  # of the usable damping: what the inequality may miss in between, far less than the reserve of a design
MOST_ROUNDS = 12


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


def solve_within(
    objective: cp.Minimize | cp.Maximize,
    gains: cp.Expression,
    theta: Sequence[int],
    sigma: Array,
    what: str,
    more: Sequence[cp.Constraint] = (),
    largest_gram: int = LARGEST_GRAM,
) -> cp.Problem:
    """The solved problem with every channel of gains = (k_1, ..., k_N, b_1, ..., b_N) in its set.

    Raises as `solve`, and DesignFailed where an inequality still fails after all rounds.
    """
    N = len(theta)
    cones = {i: first_frequencies(theta[i]) for i in range(N) if theta[i] > largest_gram}
    for _ in range(MOST_ROUNDS):
        problem = cp.Problem(objective, [*_constraints(gains, theta, sigma, cones), *more])
        solve(problem, what)
        k, b = np.split(solved(gains), 2)
        missed = {i: missed_frequencies(k[i], b[i], theta[i], float(sigma[i])) for i in cones}
        if not any(w.size for w in missed.values()):
            return problem
        cones = {i: np.union1d(w, missed[i]) for i, w in cones.items()}
    line = f"{what}: after {MOST_ROUNDS} rounds Theorem 4 still fails between the frequencies"
    raise DesignFailed(None, (), line)


def _constraints(
    gains: cp.Expression, theta: Sequence[int], sigma: Array, cones: Mapping[int, Array]
) -> list[cp.Constraint]:
    N, constraints = len(theta), []
    for i in range(N):
        k, b = gains[i], gains[N + i]
        if i in cones:
            constraints += gain_cones(k, b, theta[i], float(sigma[i]), cones[i])
        else:
            constraints += gain_set(k, b, theta[i], float(sigma[i]))
    return constraints


def gain_cones(k: cp.Expression, b: cp.Expression, theta: int, sigma: float, w: Array) -> list[cp.Constraint]:
    """The inequality at the frequencies w [rad/sample]: |(2c, r - 1)| <= r + 1 says |c|^2 <= r."""
    of_k, of_b = _polynomials(theta, w)
    rows = [part * k + other * b for part, other in zip(_parts(of_k), _parts(of_b), strict=True)]
    if np.isfinite(sigma):
        rows += [(2 * (i == 0) - row) / np.sqrt(sigma) for i, row in enumerate(rows)]
    room = (k / 2 + b) * np.ones(w.size)
    cones = cp.SOC(room + 1, cp.vstack([*rows, room - 1]), axis=0)
    return cast(list[cp.Constraint], [cones, k >= 0, b >= 0])


def missed_frequencies(k: float, b: float, theta: int, sigma: float) -> Array:
    """Peaks [rad/sample] at which the gains miss the inequality by more than MISSED."""

    def excess(w: Array) -> Array:
        of_k, of_b = _polynomials(theta, w)
        y = k * of_k + b * of_b
        return np.abs(y) ** 2 / 4 + np.abs(1 - y / 2) ** 2 / sigma - (k / 2 + b)

    return peaks(excess, first_frequencies(2 * theta + 1), MISSED)


def first_frequencies(theta: int) -> Array:
    """PER_LOBE to each ripple of y, from 0 to pi [rad/sample]."""
    return np.linspace(0, np.pi, PER_LOBE * (theta + 1) + 1)


def _polynomials(theta: int, w: Array) -> tuple[Array, Array]:
    """1 + ... + z^-theta and 1 - z^-n at exp(jw), complex, (w,) each."""
    n = theta + 1
    turned = np.exp(-1j * w * n)
    still = np.abs(np.exp(-1j * w) - 1) < 1e-12
    window = np.where(still, n, (1 - turned) / np.where(still, 1, 1 - np.exp(-1j * w)))
    return window, 1 - turned


def _parts(values: Array) -> tuple[Array, Array]:
    return values.real, values.imag
