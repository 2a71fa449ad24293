"""Suprema over frequency, found on a grid that knows the poles and refined between its points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti

Response = Callable[[Array], Array]  # w (k,) [rad/sample] -> real values (k,)


def frequencies(*systems: Lti, low: float = 1e-5, high: float = np.pi, points: int = 600) -> Array:
    """Sorted frequencies [rad/sample] in [low, high]: even in w and in log w, dense around each pole.

    A pole r exp(j phi) bends the response over a width of about 1 - r around phi, however sharp it is. One that
    repeats counts once: of points that rounding alone holds apart the wrong one may be the higher, and hide the peak
    beside the other.
    """
    even = np.linspace(low, high, points)
    logarithmic = np.geomspace(low, high, points)
    poles = _distinct(np.concatenate([g.poles() for g in systems])) if systems else np.zeros(0)
    width = np.maximum(1 - np.abs(poles), 1e-9)
    offsets = np.concatenate([[0.0], np.geomspace(0.05, 20, 12)])
    offsets = np.concatenate([-offsets, offsets])
    around = (np.abs(np.angle(poles))[:, None] + width[:, None] * offsets).ravel()
    grid = np.unique(np.concatenate([even, logarithmic, around]))
    return grid[(grid >= low) & (grid <= high)]


def _distinct(poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """One of each group of poles that lie within a hundredth of their distance to the circle."""
    kept = np.zeros(0, dtype=np.complex128)
    for pole in poles[poles.imag >= 0]:
        if not (np.abs(kept - pole) < 0.01 * max(1 - abs(pole), 1e-9)).any():
            kept = np.append(kept, pole)
    return kept


def supremum(response: Response, grid: Array) -> tuple[float, float]:
    """(value, w): the largest `response` over [grid[0], grid[-1]], refined between grid points.

    The highest local maxima of the grid (32 at most, within 20 % of the largest) are bracketed by their
    neighbours, and the brackets narrowed by a factor of 8, ten times or until two rounds gain nothing: a smooth peak is
    located to rounding.
    """
    values = response(grid)
    if not np.isfinite(values).all():
        worst = int(np.flatnonzero(~np.isfinite(values))[0])
        return np.inf, float(grid[worst])
    best = int(np.argmax(values))
    top, where = float(values[best]), float(grid[best])
    bracket = _brackets(values, grid, top - 0.2 * abs(top))
    settled = 0
    for _ in range(10):
        value, w, bracket = _narrowed(response, *bracket)
        settled = settled + 1 if value.max() <= top + 1e-13 * abs(top) else 0
        if value.max() > top:
            top, where = float(value.max()), float(w[np.argmax(value)])
        if settled == 2:
            break
    return top, where


def peaks(response: Response, grid: Array, above: float) -> Array:
    """Where the 32 highest local maxima of `response` over [grid[0], grid[-1]] exceed `above`; (peaks,)."""
    _, _, bracket = _narrowed(response, *_brackets(response(grid), grid, -np.inf))
    value, w, _ = _narrowed(response, *bracket)
    return w[value > above]


def _brackets(values: Array, grid: Array, above: float) -> tuple[Array, Array]:
    """The neighbours of the 32 highest local maxima of at least `above`."""
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    local = (values >= padded[:-2]) & (values >= padded[2:])
    at = np.flatnonzero(local & (values >= above))
    at = at[np.argsort(values[at])[-32:]]
    return grid[np.maximum(at - 1, 0)], grid[np.minimum(at + 1, grid.size - 1)]


def _narrowed(response: Response, left: Array, right: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """The best of 17 points in each bracket, where it is, and the bracket of its neighbours."""
    trial = np.linspace(left, right, 17)
    found = response(trial.ravel()).reshape(trial.shape)
    at, column = np.argmax(found, axis=0), np.arange(left.size)
    closer = trial[np.maximum(at - 1, 0), column], trial[np.minimum(at + 1, 16), column]
    return found[at, column], trial[at, column], closer


def on_circle(w: Array) -> NDArray[np.complex128]:
    """z = exp(j w)."""
    return np.exp(1j * w)


def hermitian(G: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """He G = (G + G*)/2 over the last two axes."""
    return (G + np.conj(np.swapaxes(G, -1, -2))) / 2
