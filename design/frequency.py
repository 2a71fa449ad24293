"""Suprema, peaks and integrals over frequency, for the sweeps of all conditions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import spend
from haptic_loop.controller.lti import Array, Lti

_ERROR = 1e-6  # allowed relative error of an integral
_HALVINGS = 20  # largest number of rounds of halving; the designs of cases I and II take 3
_HALVED = 1000  # largest number of intervals that are halved in one round
_ROUNDING = 1e-20  # A smaller mean counts as 0: rounding of squared differences of nearly equal responses causes it.
_NODES, _WEIGHTS = np.sqrt(0.6) * np.array([-1.0, 0.0, 1.0]), np.array([5.0, 8.0, 5.0]) / 9


def integral(response: Callable[[Array], Array], grid: Array) -> float:
    """Integrate a nonnegative `response`, (k,) -> (k,), from grid[0] to grid[-1].

    Gauss's rule with three points is applied to each interval of the grid and to its halves. Let an interval be the
    share s of the range. It is halved if the two results differ by more than s _ERROR times the integral, unless the
    mean of their difference is below _ROUNDING. If too many intervals qualify, only the worst are halved.
    """
    left, right = grid[:-1], grid[1:]
    length = grid[-1] - grid[0]
    coarse, settled = _gauss(response, left, right), 0.0
    for _ in range(_HALVINGS):
        middle = (left + right) / 2
        first, second = np.split(_gauss(response, np.append(left, middle), np.append(middle, right)), 2)
        fine = first + second
        share = max(_ERROR * (settled + fine.sum()) / length, _ROUNDING) * (right - left)
        excess = np.abs(fine - coarse) - share
        rough = excess > 0
        if rough.sum() > _HALVED:
            rough &= excess > np.sort(excess)[-_HALVED - 1]
        settled += fine[~rough].sum()
        left, right = np.append(left[rough], middle[rough]), np.append(middle[rough], right[rough])
        coarse = np.append(first[rough], second[rough])
        if not left.size:
            break
    return float(settled + coarse.sum())


def _gauss(response: Callable[[Array], Array], left: Array, right: Array) -> Array:
    """Return the integral over each interval, (k,), by Gauss's rule."""
    half = (right - left) / 2
    points = (left + right) / 2 + half * _NODES[:, None]
    return half * (_WEIGHTS @ response(points.ravel()).reshape(points.shape))


# ----------------------------------------------------------------------------------------------------
# The suprema of many functions of frequency at once, with one row for each function.


_PEAKS = 3  # number of highest local maxima of each function that are refined
_POINTS, _ROUNDS = 17, 8  # A round divides a bracket by (_POINTS - 1)/2; eight rounds find a smooth peak to rounding.

_Responses = Callable[[Array], Array]  # w (n, k) or (1, k) [rad/sample] -> real values (n, k)


def suprema(responses: _Responses, common: Array, own: Array) -> Array:
    """Return the suprema (n,) of n functions of frequency.

    The grid of a function consists of the frequencies `common` (k,) and of its row of `own` (n, p) [rad/sample]. The
    highest peaks are refined between grid points. A function with a value that is not finite gives inf.
    """
    n = own.shape[0]
    parts = [np.broadcast_to(w, (n, w.shape[-1])) for w in (common[None], own)]
    pieces = [responses(common[None]), responses(own)] if own.size else [responses(common[None])]
    order = np.argsort(np.concatenate(parts, axis=1), axis=1, kind="stable")
    grid = np.take_along_axis(np.concatenate(parts, axis=1), order, axis=1)
    values = np.take_along_axis(
        np.concatenate([np.broadcast_to(v, (n, v.shape[-1])) for v in pieces], axis=1), order, 1
    )
    endless = ~np.isfinite(values).all(axis=1)
    values = np.where(np.isfinite(values), values, -np.inf)
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=-np.inf)
    local = np.where((values > padded[:, :-2]) & (values >= padded[:, 2:]), values, -np.inf)  # A plateau counts once.
    peaks = np.argsort(local, axis=1)[:, -_PEAKS:]
    left, right = _neighbours(grid, np.take_along_axis(grid, peaks, axis=1))
    top = values.max(axis=1)
    for _ in range(_ROUNDS):
        trial = np.linspace(left, right, _POINTS, axis=-1)  # (n, peaks, points)
        pieces = responses(trial.reshape(trial.shape[0], -1)).reshape(trial.shape)
        at = np.argmax(np.where(np.isfinite(pieces), pieces, -np.inf), axis=2)[..., None]
        top = np.maximum(top, np.take_along_axis(pieces, at, axis=2)[..., 0].max(axis=1))
        left = np.take_along_axis(trial, np.maximum(at - 1, 0), axis=2)[..., 0]
        right = np.take_along_axis(trial, np.minimum(at + 1, _POINTS - 1), axis=2)[..., 0]
    return np.where(endless, np.inf, top)


def _neighbours(grid: Array, at: Array) -> tuple[Array, Array]:
    """Return the grid's frequencies (n, peaks) next below and next above `at`. A grid may contain a frequency twice."""
    room = 1e-12 * grid[:, -1:]
    below = np.where(grid[:, None] < (at - room)[..., None], grid[:, None], grid[:, None, :1]).max(axis=2)
    above = np.where(grid[:, None] > (at + room)[..., None], grid[:, None], grid[:, None, -1:]).min(axis=2)
    return below, above


#: [rad/sample] _LOWEST stands for 0; the error is about 1e-8, because responses are even in w. _BELOW resolves slow
#: poles.
_LOWEST, _BELOW = 1e-4, np.geomspace(1e-6, 0.9e-4, 8)
_EVEN = 192  # least number of evenly spaced frequencies, and number of logarithmically spaced frequencies
_PER_LOBE = 24  # evenly spaced frequencies for each lobe that a delay causes in the response
#: distances of frequencies from that of a pole, in widths of the pole
_NEAR_POLE = np.concatenate([-np.geomspace(0.05, 20, 10)[::-1], [0.0], np.geomspace(0.05, 20, 10)])


def frequencies_of_many(poles: NDArray[np.complex128], delay: int) -> tuple[Array, Array]:
    """Return frequencies (k,) common to n systems, and frequencies (n, j) around the poles (n, p) of each system.

    `delay` [samples] is the longest delay of the loop; a delay of n samples causes n lobes in the response.
    """
    even = np.linspace(_LOWEST, np.pi, max(_EVEN, _PER_LOBE * (delay + 1)))
    common = np.unique(np.concatenate([_BELOW, even, np.geomspace(_LOWEST, np.pi, _EVEN)]))
    width = np.maximum(1 - np.abs(poles), 1e-9)
    near = (np.abs(np.angle(poles))[..., None] + width[..., None] * _NEAR_POLE).reshape(poles.shape[0], -1)
    return common, np.clip(near, _LOWEST, np.pi)


_POINT = 1.5e-6  # [s] measured time of the eigenvalues at a point of a sweep

Response = Callable[[Array], Array]  # w (k,) [rad/sample] -> real values (k,)


def frequencies(*systems: Lti, low: float = 1e-5, high: float = np.pi, points: int = 600) -> Array:
    """Return sorted frequencies [rad/sample] in [low, high]: evenly spaced in w and in log w, and dense around poles.

    A pole r exp(j phi) bends the response over a width of about 1 - r around phi. A repeated pole counts once.
    Otherwise two points that differ by rounding only would make the bracket of a peak too narrow.
    """
    poles = _distinct(np.concatenate([g.poles() for g in systems])) if systems else np.zeros(0)
    width = np.maximum(1 - np.abs(poles), 1e-9)
    around = (np.abs(np.angle(poles))[:, None] + width[:, None] * _OFFSETS).ravel()
    # np.unique would import numpy.ma, which takes 6 ms.
    grid = np.sort(np.concatenate([np.linspace(low, high, points), np.geomspace(low, high, points), around]))
    return grid[(grid >= low) & (grid <= high) & np.append(True, grid[1:] != grid[:-1])]


_OFFSETS = np.concatenate([[0.0], np.geomspace(0.05, 20, 12)])
_OFFSETS = np.concatenate([-_OFFSETS, _OFFSETS])  # distances of frequencies from that of a pole, in widths of the pole


def rounding(G: Lti, z: NDArray[np.complex128], meant: Lti | None = None) -> float:
    """Return a bound of the rounding error in the response of y = C x + D u, x+ = A x + B u, at all z (k,).

    A tick in double precision is an exact tick of a system whose coefficients have relative errors of at most (2n + 8)
    2^-53, for n states and up to n + 8 inputs. If G approximates a system `meant` with the same states, the differences
    of their coefficients are added to these errors. With R = (zI - A)^-1 the errors dA, dB, dC, dD change the response
    by at most |C R| (|dA| |R B| + |dB|) + |dC| |R B| + |dD|. The difference of the two responses is no substitute for
    this bound, because it is large as soon as a sharp peak moves by its own width.
    """
    part = (2 * G.order + 8) * 2.0**-53
    dA, dB, dC, dD = (
        part * np.abs(own) + (0.0 if meant is None else np.abs(own - getattr(meant, name)))
        for name, own in (("A", G.A), ("B", G.B), ("C", G.C), ("D", G.D))
    )
    one, zero = np.eye(G.order), np.zeros
    states = np.abs(Lti(G.A, G.B, one, zero(G.B.shape), G.T).at(z))
    outputs = np.abs(Lti(G.A.T, G.C.T, one, zero(G.C.T.shape), G.T).at(z)).swapaxes(1, 2)
    return float((outputs @ (dA @ states + dB) + dC @ states + dD).max(initial=0.0))


def _distinct(poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return poles with imag >= 0, without a pole that is near an earlier one (1 % of its distance to the circle)."""
    distinct = np.zeros(0, dtype=np.complex128)
    for pole in poles[poles.imag >= 0]:
        if not (np.abs(distinct - pole) < 0.01 * max(1 - abs(pole), 1e-9)).any():
            distinct = np.append(distinct, pole)
    return distinct


def supremum(response: Response, grid: Array) -> tuple[float, float]:
    """Return the largest `response` over [grid[0], grid[-1]], refined between grid points, and its frequency.

    Local maxima of the grid (32 at most, within 20 % of the largest) are bracketed by their neighbours. The brackets
    are narrowed up to ten times. The search ends earlier if two rounds in a row gain nothing, or if no bracket can
    gain 1e-13 of the largest value. A value that is not finite gives inf.
    """
    spend(_POINT * grid.size)
    values = response(grid)
    if not np.isfinite(values).all():
        worst = int(np.flatnonzero(~np.isfinite(values))[0])
        return np.inf, float(grid[worst])
    best = int(np.argmax(values))
    top, where = float(values[best]), float(grid[best])
    bracket = _brackets(values, grid, top - 0.2 * abs(top))
    settled = 0
    for _ in range(10):
        bracket = _narrowed(response, bracket)
        w, value = bracket[:, 1]
        settled = settled + 1 if value.max() <= top + _GAIN * abs(top) else 0
        if value.max() > top:
            top, where = float(value.max()), float(w[np.argmax(value)])
        bracket = bracket[:, :, _reach(bracket) > top + _GAIN * abs(top)]
        if settled == 2 or not bracket.size:
            break
    return top, where


_GAIN = 1e-13  # relative gain of a peak that a search neglects


def peaks(response: Response, grid: Array, above: float, near: float = np.inf) -> Array:
    """Return frequencies (peaks,) of at most 32 local maxima of `response` above `above`, refined between grid points.

    A maximum that is lower than the highest one by more than the share `near` is left out. The maxima are sorted by
    their `_reach` on the grid, so that the last one stands out most.
    """
    spend(_POINT * grid.size)
    values = response(grid)
    top = float(values.max())
    least = top - near * abs(top) if np.isfinite(top) and near < np.inf else -np.inf
    bracket = _narrowed(response, _narrowed(response, _brackets(values, grid, least)))
    w, value = bracket[:, 1]
    return w[value > above]


def _brackets(values: Array, grid: Array, above: float) -> Array:
    """Return brackets of local maxima of at least `above`, at most 32, chosen by `_reach`.

    They are not chosen by value, because rounding gives a flat response many maxima. Such a maximum may be higher than
    the grid points of a true peak. A bracket has three points. Axis 0 is (frequency, value), axis 1 is
    (left, peak, right), and axis 2 is the bracket.
    """
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    local = (values >= padded[:-2]) & (values >= padded[2:])
    at = np.flatnonzero(local & (values >= above))
    three = np.stack([np.maximum(at - 1, 0), at, np.minimum(at + 1, grid.size - 1)])
    bracket = np.stack([grid[three], values[three]])
    return bracket[:, :, np.argsort(_reach(bracket))[-32:]]


#: Distances of trial points from the parabola's peak, in widths of the bracket. Near a smooth peak the distance of the
#: true peak from the parabola's peak falls with the square of the width. Trial points at eighths of the bracket find a
#: kink.
_NEAR = np.array([[2.0**-k] for k in (4, 7, 10, 13)])
_EIGHTHS = np.arange(1, 8)[:, None] / 8


def _narrowed(response: Response, bracket: Array) -> Array:
    """Return new brackets. Each is the best of three old and 16 trial points, with the two points beside it."""
    (left, middle, right), (low, high, last) = bracket
    width = right - left
    with np.errstate(divide="ignore", invalid="ignore"):  # Equal points or values give the middle.
        rise, fall = (high - low) / (middle - left), (last - high) / (right - middle)
        shift = 0.5 * (rise * (right - middle) + fall * (middle - left)) / (rise - fall)
    peak = np.clip(middle + np.where(np.isfinite(shift), shift, 0.0), left, right)
    near = width * _NEAR
    trial = np.clip(np.concatenate([left + width * _EIGHTHS, peak - near, peak[None], peak + near]), left, right)
    spend(_POINT * trial.size)
    w = np.concatenate([bracket[0], trial])
    values = np.concatenate([bracket[1], response(trial.ravel()).reshape(trial.shape)])
    order, each = np.argsort(w, axis=0, kind="stable"), np.arange(w.shape[1])
    w, values = w[order, each], values[order, each]
    at = np.argmax(values, axis=0)
    best = w[at, each]  # Some points may coincide.
    three = np.stack([np.maximum((w < best).sum(axis=0) - 1, 0), at, np.minimum((w <= best).sum(axis=0), len(w) - 1)])
    return np.stack([w[three, each], values[three, each]])


def _reach(bracket: Array) -> Array:
    """Return the largest expected peak of each bracket: its value plus the drop to the lower neighbour.

    A parabola through three evenly spaced points rises above the highest one by at most an eighth of this drop.
    """
    low, best, last = bracket[1]
    lower = np.minimum(low, last)
    # The condition `where` avoids inf - inf.
    return best + np.subtract(best, lower, out=np.zeros_like(best), where=lower < best)


def on_circle(w: Array) -> NDArray[np.complex128]:
    """Return z = exp(j w)."""
    return np.exp(1j * w)


def hermitian(G: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return He G = (G + G*)/2 over the last two axes."""
    return (G + np.conj(np.swapaxes(G, -1, -2))) / 2


def largest_eigenvalue(H: NDArray[np.complex128]) -> Array:
    """Return the largest eigenvalue of Hermitian matrices (last two axes), in closed form up to two rows."""
    m = H.shape[-1]
    if m == 1:
        return H[..., 0, 0].real
    if m == 2:
        a, d, b = H[..., 0, 0].real, H[..., 1, 1].real, np.abs(H[..., 0, 1])
        return (a + d) / 2 + np.hypot((a - d) / 2, b)
    return np.linalg.eigvalsh(H)[..., -1].astype(np.float64)


def least_eigenpair(H: NDArray[np.complex128]) -> tuple[Array, NDArray[np.complex128]]:
    """Return the least eigenvalues (k,) of Hermitian matrices (k, m, m) and their unit eigenvectors (k, m).

    For many rows one step of inverse iteration is 1.4 times as fast as the computation of all eigenvectors. Its shift
    differs from the eigenvalue by 1e-13 of the largest entry. The step multiplies the share of any other eigenvector by
    at most this difference over the distance of the two eigenvalues.
    """
    m = H.shape[-1]
    if m == 2:
        return _least_of_two(H[:, 0, 0].real, H[:, 1, 1].real, H[:, 0, 1])
    if m <= _ROWS_AT_ONCE:
        values, vectors = np.linalg.eigh(H)
        return values[:, 0].astype(np.float64), vectors[:, :, 0]
    least = np.linalg.eigvalsh(H)[:, 0].astype(np.float64)
    shift = least - 1e-13 * np.abs(H).max(axis=(1, 2), initial=1e-300)
    start = np.sin(1.0 + np.arange(m)).astype(np.complex128)  # irregular, so not orthogonal to an eigenvector
    v = np.linalg.solve(H - shift[:, None, None] * np.eye(m), start[:, None])[..., 0]
    return least, v / np.linalg.norm(v, axis=1, keepdims=True)


def _least_of_two(a: Array, d: Array, b: NDArray[np.complex128]) -> tuple[Array, NDArray[np.complex128]]:
    """Return the least eigenvalues (k,) of [[a, b], [b*, d]], with a, b and d (k,), and unit eigenvectors (k, 2).

    Each eigenvector solves the row of (H - lambda I) v = 0 with the larger diagonal entry, which cancels no digits.
    """
    half = (a - d) / 2
    radius = np.hypot(half, np.abs(b))
    first, long = half <= 0, radius + np.abs(half)
    v: NDArray[np.complex128] = np.stack([np.where(first, long, -b), np.where(first, -b.conj(), long)], axis=1)
    size = np.hypot(long, np.abs(b))
    v[size == 0] = 1.0, 0.0  # a multiple of the identity
    return (a + d) / 2 - radius, v / np.where(size == 0, 1.0, size)[:, None]


_ROWS_AT_ONCE = 12  # largest number of rows for which it is faster to compute all eigenvectors
