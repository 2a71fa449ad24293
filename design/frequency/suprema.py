"""sweep.supremum for many functions of frequency at once: one row each, refined between grid points together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from controller.lti import Array

PEAKS = 3  # highest local maxima of a row that are refined
POINTS, ROUNDS = 17, 8  # a round narrows a bracket by (POINTS - 1)/2, so eight locate a smooth peak to rounding

Responses = Callable[[Array], Array]  # w (n, k) [rad/sample] -> real values (n, k)


def suprema(responses: Responses, grid: Array) -> Array:
    """The largest value of each row over its frequencies, (n,); `grid` (n, k) is sorted along its last axis.

    A row with a value that is not finite gives infinity.
    """
    values = responses(grid)
    endless = ~np.isfinite(values).all(axis=1)
    values = np.where(np.isfinite(values), values, -np.inf)
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    local = np.where((values > padded[:, :-2]) & (values >= padded[:, 2:]), values, -np.inf)  # once per plateau
    peaks = np.argsort(local, axis=1)[:, -PEAKS:]
    left, right = _neighbours(grid, np.take_along_axis(grid, peaks, axis=1))
    top = values.max(axis=1)
    for _ in range(ROUNDS):
        trial = np.linspace(left, right, POINTS, axis=-1)  # (n, peaks, points)
        found = responses(trial.reshape(trial.shape[0], -1)).reshape(trial.shape)
        at = np.argmax(np.where(np.isfinite(found), found, -np.inf), axis=2)[..., None]
        top = np.maximum(top, np.take_along_axis(found, at, axis=2)[..., 0].max(axis=1))
        left = np.take_along_axis(trial, np.maximum(at - 1, 0), axis=2)[..., 0]
        right = np.take_along_axis(trial, np.minimum(at + 1, POINTS - 1), axis=2)[..., 0]
    return np.where(endless, np.inf, top)


def _neighbours(grid: Array, at: Array) -> tuple[Array, Array]:
    """The frequencies (n, peaks) of the grid below and above `at`; a grid may have some twice."""
    room = 1e-12 * grid[:, -1:]
    below = np.where(grid[:, None] < (at - room)[..., None], grid[:, None], grid[:, None, :1]).max(axis=2)
    above = np.where(grid[:, None] > (at + room)[..., None], grid[:, None], grid[:, None, -1:]).min(axis=2)
    return below, above
