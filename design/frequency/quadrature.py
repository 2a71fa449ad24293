"""Integrals over frequency, by Gauss's rule on intervals that are halved until it no longer matters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from controller.lti import Array

ERROR = 1e-6  # relative, of the sum
ROUNDING = 1e-20  # of the mean: what is left of two responses that agree to ten digits, squared
MOST_ROUNDS, MOST_INTERVALS = 20, 1000  # of halving; in one round
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)


def integral(response: Callable[[Array], Array], grid: Array, error: float = ERROR) -> float:
    """The integral of `response`, (k,) -> (k,) and not negative, from grid[0] to grid[-1].

    Three points of Gauss in each interval of the grid, against the same in its halves: an interval whose two figures
    differ by more than its share of `error`, relative to the whole, gives way to its halves. What differs by rounding
    alone would do so without end: hence the least mean that counts, and the worst intervals only where there are many.
    """
    left, right = grid[:-1], grid[1:]
    length = grid[-1] - grid[0]
    coarse, done = _gauss(response, left, right), 0.0
    for _ in range(MOST_ROUNDS):
        middle = (left + right) / 2
        first, second = np.split(_gauss(response, np.append(left, middle), np.append(middle, right)), 2)
        fine = first + second
        share = max(error * (done + fine.sum()) / length, ROUNDING) * (right - left)
        excess = np.abs(fine - coarse) - share
        rough = excess > 0
        if rough.sum() > MOST_INTERVALS:
            rough &= excess > np.sort(excess)[-MOST_INTERVALS - 1]
        done += fine[~rough].sum()
        left, right = np.append(left[rough], middle[rough]), np.append(middle[rough], right[rough])
        coarse = np.append(first[rough], second[rough])
        if not left.size:
            break
    return float(done + coarse.sum())


def _gauss(response: Callable[[Array], Array], left: Array, right: Array) -> Array:
    """(k,): Gauss's rule in each interval."""
    half = (right - left) / 2
    points = (left + right) / 2 + half * _NODES[:, None]
    return half * (_WEIGHTS @ response(points.ravel()).reshape(points.shape))
