"""Bound the least eigenvalue of He G = (G + G*)/2 from below on the unit circle; bound |G| near given frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Array, Lti

_FIRST = 64  # number of intervals of [0, pi] at the start
#: largest number of evaluations for up to 8 states, which take half a second; a system with more states gets fewer
_EVALUATIONS = 1 << 15
_REACH = 0.5  # a bound is computed for half-widths up to _REACH/|(zI - A)^-1|
_UNIT = 2.0**-53  # largest relative error of one rounding
_NOISE = 1e-4  # variance of the noise added to each state, relative to |B|^2; the noise at the inputs adds B B'
_INFLATED = 1.001  # factor on norms against rounding
_TOGETHER = 2**18  # largest number of entries of resolvents in memory


def hermitian_floor(G: Lti, enough: float, unwanted: float, rounding: float = 1.0) -> tuple[float, float, float]:
    """Bound the least eigenvalue of He G(e^jw) from below over all w, by intervals that are halved where necessary.

    Let G(w) be short for G(e^jw). R = (zI - A)^-1 at the middle of an interval bounds |G'| and |G''| on the interval.
    Near a narrow resonance |R| is large and the intervals become short, so that no resonance is missed. On an interval
    of half-width h around w0, He G(w0 + t) >= He [G(w0) + t G'(w0)] - h^2 M/2 with M >= |G''|. The least eigenvalue of
    the right side is concave in t, so it is evaluated at both ends only. A bound on the rounding errors is subtracted.

    Args:
        G: A stable block of floats. It is real, so that the interval [0, pi] is enough.
        enough: An interval with at least this lower bound is not halved any more.
        unwanted: The search ends at a frequency whose least eigenvalue is below this number.
        rounding: A factor on the bound of the rounding errors, above 1 if A and B were computed with a larger error.

    Returns:
        (the lower bound, the least eigenvalue that was evaluated, its frequency [rad/sample]).
    """
    G, lost = _without_idle_directions(_balanced(G))
    norms = _norms(G)
    left = np.linspace(0, np.pi, _FIRST + 1)[:-1]
    half = np.full(_FIRST, np.pi / _FIRST / 2)
    middle = left + half
    floor, least, where = np.inf, np.inf, 0.0
    budget = int(_EVALUATIONS / max(1.0, G.order / 8) ** 1.5)
    while middle.size:
        lower, here = _bounded(G, norms, lost, middle, half, rounding)
        worst = int(np.argmin(here))
        if here[worst] < least:
            least, where = float(here[worst]), float(middle[worst])
        budget -= 2 * middle.size
        settled = lower >= enough
        if least < unwanted or budget < 2 * (~settled).sum():
            settled[:] = True
        floor = min(floor, float(lower[settled].min(initial=np.inf)))
        half = np.repeat(half[~settled] / 2, 2)
        middle = np.repeat(middle[~settled], 2) + half * np.tile([-1.0, 1.0], half.size // 2)
    return floor, least, where


def _balanced(G: Lti) -> Lti:
    """Return the same block with states scaled by powers of two, which is exact."""
    if not G.order:
        return G
    import scipy.linalg  # slow to load

    large = np.abs(G.A) > 16 * _UNIT * np.abs(G.A).max()  # Rounding errors of zeros must not decide the scales.
    with np.errstate(invalid="ignore"):  # SciPy casts unused entries if A is nilpotent
        _, scale = scipy.linalg.matrix_balance(np.where(large, G.A, 0.0), permute=False)
    size = np.diag(scale)
    return Lti(G.A * size / size[:, None], G.B / size[:, None], G.C * size, G.D, G.T)


_IDLE = 1e-13  # singular values below this share of the largest one belong to directions in which G is zero
_Lost = tuple[float, float, float]


def _without_idle_directions(G: Lti) -> tuple[Lti, _Lost | None]:
    """Return Q'GQ, where an orthonormal Q omits the directions in which G is zero at every frequency.

    An example is the difference of two contacts with the same motion. He G is zero in these directions, and no finite
    number of intervals could decide the sign of zero. The second result contains the norms of the omitted parts of B, C
    and D, or is None if G is returned unchanged.
    """
    rows = [part / max(float(np.linalg.norm(part)), 1e-300) for part in (G.B, G.C.T, G.D, G.D.T)]
    _, sizes, V = np.linalg.svd(np.vstack(rows))
    count = int((sizes > _IDLE * sizes[0]).sum())
    if count in (0, G.inputs):
        return G, None
    Q = V[:count].T
    project = Q @ Q.T
    parts = (G.B - G.B @ project, G.C - project @ G.C, G.D - project @ G.D @ project)
    lost = [float(np.linalg.norm(part)) for part in parts]
    return Lti(G.A, G.B @ Q, Q.T @ G.C, Q.T @ G.D @ Q, G.T), (lost[0], lost[1], lost[2])


def _norms(G: Lti) -> list[tuple[Array, Array]]:
    """Return pairs L, L^-1 (n, n). The resolvent's norm is computed in the coordinates L^-1 x of the states x.

    Every L gives a valid bound, and the best bound is used. The first L is I. The second L is a square root of the
    states' covariance under noise; in its coordinates the norm is often smaller.
    """
    import scipy.linalg  # slow to load

    one = np.eye(G.order)
    if not G.order:
        return [(one, one)]
    noise = G.B @ G.B.T + _NOISE * np.linalg.norm(G.B) ** 2 * one
    try:
        L = np.linalg.cholesky(scipy.linalg.solve_discrete_lyapunov(G.A, noise))
        return [(one, one), (L, np.linalg.inv(L))]
    except np.linalg.LinAlgError:
        return [(one, one)]


def _bounded(
    G: Lti, norms: list[tuple[Array, Array]], lost: _Lost | None, w: Array, half: Array, rounding: float
) -> tuple[Array, Array]:
    """Return lower bounds (k,) of the least eigenvalue of He G on w - half to w + half, and its values (k,) at w."""
    A, B, C, D = G.A, G.B, G.C, G.D
    n, m = B.shape
    if not n:
        here = np.full(w.shape, np.linalg.eigvalsh((D + D.T) / 2)[0])
        lower = here - 8 * m * _UNIT * np.linalg.norm(D)
        return (np.minimum(lower, 0) - lost[2] if lost else lower), here
    z = np.exp(1j * w)[:, None, None]
    R = np.linalg.inv(z * np.eye(n) - A)
    CR, RB = C @ R, R @ B
    value, slope = CR @ B + D, -1j * z * (CR @ RB)
    tilt = half[:, None, None] * _hermitian(slope)
    here = np.linalg.eigvalsh(_hermitian(value))[:, 0]
    ends = np.minimum(*(np.linalg.eigvalsh(_hermitian(value) + sign * tilt)[:, 0] for sign in (-1, 1)))
    error = (1 + np.linalg.norm(A)) * _size(CR) * _size(RB) * (1 + half * _size(R)) + _size(value)
    lower = np.full(w.shape, -np.inf)
    for L, back in norms:
        reach, left, right = (_INFLATED * _size(part) for part in (back @ R @ L, CR @ L, back @ RB))
        growth = 1 / np.maximum(1 - half * reach, 1 - _REACH)
        curvature = growth**2 * left * right * (1 + 2 * growth * reach)
        lower = np.maximum(lower, np.where(half * reach <= _REACH, ends - half**2 * curvature / 2, -np.inf))
    lower -= rounding * 16 * (n + m) * _UNIT * error
    if lost:  # |R| grows at most twofold on an interval
        lower = np.minimum(lower, 0) - 2 * (_size(CR) * lost[0] + _size(RB) * lost[1]) - lost[2]
    return lower, here


def sizes_around(G: Lti, w: Array, radius: Array) -> tuple[Array, Array]:
    """Bound |G(e^jv)| for all complex v with |v - w| <= radius, and the rounding error of G(e^jv) for real v.

    With R = (zI - A)^-1, R0 = R(z0) at z0 = e^jw and |z - z0| <= e^radius - 1 = d, R = (I + (z - z0) R0)^-1 R0
    satisfies |R| <= |R0|/(1 - d |R0|).

    Args:
        G: A stable block of floats.
        w: (k,) middles [rad/sample].
        radius: (k,) radii [rad/sample].

    Returns:
        (the bounds, the rounding errors), (k,) each, as Frobenius norms; inf near a pole, if d > 1/(2 |R0|).
    """
    G = _balanced(G)
    n, m = G.B.shape
    if not n:
        size = np.full(w.shape, np.linalg.norm(G.D))
        return size, 8 * m * _UNIT * size
    norms, parts = _norms(G), max(1, _TOGETHER // n**2)
    sizes = np.full((2, w.size), np.inf)
    for first in range(0, w.size, parts):
        here = slice(first, first + parts)
        R = np.linalg.inv(np.exp(1j * w[here])[:, None, None] * np.eye(n) - G.A)
        CR, RB, away = G.C @ R, R @ G.B, np.expm1(radius[here])
        size = _size(CR @ G.B + G.D)
        for L, back in norms:
            left, right = _INFLATED * _size(CR @ L), _INFLATED * _size(back @ RB)
            near = _INFLATED * away * _size(back @ R @ L) <= _REACH
            bound = _INFLATED * size + away * left * right / (1 - _REACH)
            sizes[0, here] = np.minimum(sizes[0, here], np.where(near, bound, np.inf))
            error = (
                16 * (n + m) * _UNIT * ((1 + np.linalg.norm(G.A)) * _size(CR) * _size(RB) / (1 - _REACH) ** 2 + size)
            )
            sizes[1, here] = np.minimum(sizes[1, here], np.where(near, error, np.inf))
    return sizes[0], sizes[1]


def _size(M: NDArray[np.inexact[Any]]) -> Array:
    return np.linalg.norm(M, axis=(1, 2))


def _hermitian(M: Any) -> Any:
    return (M + M.conj().swapaxes(1, 2)) / 2
