"""Compute a lower bound on the transparency error of all linear couplings that this-environment certifies.

python -m design prints the bound for an optimal coupling. The bound holds for couplings of any order. docs/theory.md
has the derivation ("Every linear coupling is a filter"): every feasible point of the dual problem gives a lower bound.

For a certified F let P(z) = Delta + T F(z)/(z-1). S = He P is a positive measure sum_k s_k z^-k on the circle, and
s_0 = Delta. Because of the delays some combinations of the first s_k are zero: for 1 <= k <= theta_i no force has
arrived at device i yet, so that row i of s_k is zero. Let <X, Y> be the mean of Re tr X*Y over the circle. With
M = F - Lambda E and a weight rho(w), J = <M, rho M> is the mean square of the relative mismatch over the band. Let H(z)
vanish outside the band, and let the C_k multiply only the zero combinations, such that
    D = He[ (4/T) ((1/z - 1) H_+ + H_0) + sum_{k>=1} C_k z^-k ] + C_0  >=  0,     H_+ = sum_{k>=0} H_k z^-k.
Then <D, S> >= 0 means that J >= -tr C_0 Delta - 2 <H, Lambda E> - <H, H/rho>. With H = rho |E| h this bound is
    1 - tr C_0 Delta - mean |h + Lambda E/|E||^2,
where the mean is over log frequency in the band. H is piecewise linear, so that H_+ has a closed form, and D is bounded
from below between any two frequencies (`dual_matrix`). If this lower bound of D is negative, C_0 is increased until
D >= 0, which lowers the bound on J. The bound on J is then proved.

In two cases the result is only an estimate, for which D is positive at the frequencies of a sweep. In the first case
the proved bound is zero, but the estimate is not. In the second case the psi of the channels differ, so that the zero
combinations are known only up to rounding. The integrals over the band are computed by Gauss's rule. A bound of the
rule's error (`_Dual.objective_again`) is subtracted from the proved bound, and _QUADRATURE from both results.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Complex, Lti
from haptic_loop.controller.passivity import sizes_around
from haptic_loop.design import budgets
from haptic_loop.design.barrier import EntryInequality, Program, follow, packed, solve_triangular
from haptic_loop.design.conditions import even_level
from haptic_loop.design.dual_matrix import DualMatrix, dilogarithm
from haptic_loop.design.files import off_table
from haptic_loop.design.forked import Forked
from haptic_loop.design.frequency import frequencies, hermitian, on_circle
from haptic_loop.design.program import Options
from haptic_loop.design.result import Design
from haptic_loop.design.transparency import BAND_HZ, decibels, in_band

_GRID = 250  # The grid has this number of points with equal steps, and as many with equal ratios.
_KNOTS = {1: 60, 2: 40, 3: 24, 4: 20, 5: 16}  # channels -> number of knots of h, even in log frequency
MOST = max(_KNOTS)  # largest number of channels for which there is a bound
_NO_BOUND = f"no bound for more than {MOST} channels: it would take half a minute and be 1 dB off"
_NEAR_END = (0.22, 0.5)  # distances of further knots from the band's ends, where h is zero, in steps of even knots
_NEAR_MODE = 1.0  # distance of further knots from a mode, in widths of the mode
_CLOSEST = 0.1  # least distance of two knots, in steps of even knots
_MOST_ADDED = 96  # largest number of frequencies that one check of D adds
_AWAY = np.exp(np.geomspace(0.002, 0.5, 18))  # ratios of further frequencies to the band's ends, where D bends
_AROUND = np.array(
    [-8, -5, -3, -2, -1.4, -1, -0.7, -0.4, -0.2, 0, 0.2, 0.4, 0.7, 1, 1.4, 2, 3, 5, 8]
)  # distances of further frequencies from a mode, in widths of the mode
_DEGREE = 3  # degree of the splines of h
_FIRST, _STEEPER = 5.0, 6.0  # the barrier's first t, in units of degree/objective, and the factor by which t grows
_GAP = 0.004  # The barrier method ends at this gap to the optimum, relative to the bound on J.
_LEAST = 1e-9  # A smaller bound on J is useless.
_WANTED = 1e-3  # wanted error of the lower bounds of D between frequencies, relative to the bound on J
_QUADRATURE = 1e-8  # subtracted from every bound and estimate of J, because the estimate's rule has no error bound
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(12)  # Gauss's rule in each interval, for the proved bound
_DISK = 4.0  # radius of the disk in which the integrand is bounded, in half-widths of an interval
_UNIT = 2.0**-53  # unit roundoff of double precision
_LARGEST_CHARGE = 0.005  # The search ends if the bound on J is below the barrier's value by less than this share.


@dataclass(frozen=True)
class Bound:
    """A lower bound of the rms mismatch of all couplings that this-environment certifies, or an estimate of it."""

    rms: float  # relative to the environment
    proved: bool  # whether D >= 0 is proved on the whole circle; True for a bound of 0, which needs no proof
    sampled_rms: float  # estimate for which D is positive at the frequencies of a sweep

    @property
    def rms_db(self) -> float:
        return decibels(self.rms)


def bound(loop: Loop, band_hz: tuple[float, float] = BAND_HZ, knots: int | None = None) -> Bound:
    """Return a lower bound, or its estimate, of the rms mismatch of all couplings that this-environment certifies.

    The loop has at most MOST channels. `knots` is the number of knots of h; None is that of _KNOTS. Varying periods up
    to T_max are replaced by the period T with less damping. With a latency of at least t1 the damping is
    Delta T/(T_max - t1) (docs/theory.md).
    """
    level = even_level(loop)
    if loop.latency:
        longest, first = loop.T_max or loop.T, np.array([least for least, _ in loop.latency])
        level = level * (longest / (longest - first))[:, None]
    delta = tuple(np.diag(level).tolist())
    levels = loop.levels and tuple(tuple(map(tuple, level[own, own].tolist())) for own in loop.devices)
    loop = msgspec.structs.replace(loop, delta=delta, levels=levels, T_max=None)
    dual = _Dual.of(loop, band_hz, knots or _KNOTS[loop.channels])
    sampled, charged = (float(np.sqrt(max(square - _QUADRATURE, 0.0))) for square in dual.best())
    proved = charged > 0 or sampled == 0  # A bound of zero needs no proof.
    return Bound(charged if proved else sampled, proved, sampled)


@dataclass(frozen=True, eq=False)
class _Dual:
    """The dual problem. Its unknowns x are h (for each entry its real and then its imaginary parts), C_0 and the C_k.

    D is in units of 1/delta. H is linear between the points of `grid`, so that H_+ has a closed form (`_causal`).
    """

    loop: Loop
    grid: Array  # (k,) [rad/sample]
    heights: Array  # (k, inner) basis functions of H on the grid; those of h are orthonormal on the band
    target: Array  # (2 inner, m^2) coefficients of -Lambda E/|E| in the functions of h, real and then imaginary parts
    knots: Array  # [rad/sample] knots of the splines h
    forbidden: tuple[tuple[int, Array], ...]  # sums that are zero for every F: (row of the s_k, weights (k, m))
    exact: bool  # whether these sums are exactly zero, not only up to rounding
    band: tuple[float, float]  # [rad/sample]

    @classmethod
    def of(cls, loop: Loop, band_hz: tuple[float, float], count: int) -> _Dual:
        E = loop.E()
        low, high = in_band(band_hz, loop.T)
        span, end = np.log(high / low), min(high, 0.999 * np.pi)  # H is zero above `end`.
        knots = _knots(E, low, end, count)
        grid = np.union1d(knots, frequencies(E, low=low, high=end, points=_GRID))
        hats = _splines(np.log(grid), np.log(knots), _DEGREE)
        unit = np.pi / (span * grid * np.linalg.norm(E.at(on_circle(grid)), axis=(1, 2)))
        heights = unit[:, None] * hats[:, 1:-1]  # h is zero at both ends of the band, where H_+ would be unbounded.

        # The objective, mean |h + Lambda E/|E||^2, by Gauss's rule between the points of the grid.
        w, weight, part = _gauss(grid)
        weight = weight / (w * span)
        H = np.concatenate([(1 - f) * heights[:-1] + f * heights[1:] for f in part])
        z = on_circle(w)
        response = E.at(z)
        size = np.linalg.norm(response, axis=(1, 2))
        target = (z[:, None] ** -np.asarray(loop.lam))[:, :, None] * response / size[:, None, None]
        target = np.sqrt(weight)[:, None] * target.reshape(w.size, -1)
        Q, R = np.linalg.qr((np.sqrt(weight) * span * w * size / np.pi)[:, None] * H)
        target = -np.vstack([Q.T @ target.real, Q.T @ target.imag])
        heights = solve_triangular(R, heights.T, transposed=True).T
        forbidden, exact = _forbidden(loop, E)
        return cls(loop, grid, heights, target, knots, forbidden, exact, (low, high))

    @property
    def start(self) -> Array:
        """The point h = 0 and C_0 = I, where D = I, in units of 1/delta."""
        return self._weights(np.eye(self.loop.channels))

    @property
    def cost(self) -> Array:
        """The vector c with c'x = tr C_0 Delta_D."""
        root = np.sqrt(self.loop.delta)
        return self._weights(self.loop.Delta() / np.outer(root, root))

    def _weights(self, M: Array) -> Array:
        """Return the vector c with c'x = tr C_0 M for a symmetric M (m, m)."""
        m = self.loop.channels
        each = [M[i, j] * (1 if i == j else 2) for i, j in _triangle(m)]
        return np.concatenate([np.zeros(m * m * len(self.target)), each, np.zeros(len(self.forbidden))])

    def objective(self) -> tuple[Array, Array, Array]:
        """Return A, b, c such that |b|^2 - |A x - b|^2 - c'x is the bound on J; c is `cost`."""
        return np.eye(self.target.size, self.start.size), self.target.T.ravel(), self.cost

    def imposed(self) -> Array:
        """Return the frequencies [rad/sample] at which D > 0 is imposed first.

        They are dense at the band's ends and at the modes of E. `turns` are the zeros of 1 + .. + z^-theta_i.
        """
        low, high = self.grid[0], self.grid[-1]
        steps = np.arange(4 * self.knots.size - 3) / 4
        within = np.exp(np.interp(steps, np.arange(self.knots.size), np.log(self.knots)))
        beside = np.concatenate([_AWAY, 1 / _AWAY])
        modes, width = _modes(self.loop.E())
        near = modes * np.exp(np.outer(_AROUND, width))
        turns = np.array([2 * np.pi * k / (n + 1) for n in set(self.loop.theta) for k in range(1, n // 2 + 1)])
        rest = [low * np.geomspace(1e-3, 0.5, 8), np.geomspace(1.6 * high, np.pi, 12), np.linspace(high, np.pi, 60)]
        some = [low * beside, high * beside, near.ravel(), turns, 0.99 * turns, 1.01 * turns, *rest]
        w = np.unique(np.concatenate([[0.0], within, *some]))
        return w[w <= np.pi]

    def swept(self) -> Array:
        """Return the frequencies [rad/sample] at which D > 0 is checked after each round."""
        low, high = self.grid[0], self.grid[-1]
        beside = np.concatenate([low * np.geomspace(1e-3, 1, 60), np.geomspace(high, np.pi, 200)])
        swept = np.unique(np.concatenate([[0.0], self.grid, beside, np.linspace(high, np.pi, 400)]))
        return np.union1d(swept, (swept[1:] + swept[:-1]) / 2)

    def further(self, w: Array) -> Complex:
        """Return matrices (k, unknowns, m, m) whose Hermitian parts are the derivatives of D by C_0 and the C_k."""
        m, z = self.loop.channels, on_circle(w)
        triangle = _triangle(m)
        slope = np.zeros((w.size, len(triangle) + len(self.forbidden), m, m), dtype=np.complex128)
        for at, (i, j) in enumerate(triangle):
            slope[:, at, i, j] = 1.0 if i == j else 2.0
        for at, (i, weights) in enumerate(self.forbidden, start=len(triangle)):
            steps = np.flatnonzero(weights.any(axis=1))
            slope[:, at, i] = z[:, None] ** -steps.astype(float) @ weights[steps]
        return slope

    def block(self, w: Array) -> EntryInequality:
        """Return the inequality D > 0 at the frequencies w, scaled by root(delta) from both sides."""
        further = np.swapaxes(packed(hermitian(self.further(w))), 1, 2)
        functions = 4 / self.loop.T * _causal(self.grid, self.heights, w)
        root = np.tile(np.diag(np.sqrt(self.loop.delta)).astype(complex), (w.size, 1, 1))
        return EntryInequality(np.zeros(further.shape[:2]), functions, root, root, np.ascontiguousarray(further))

    def matrix(self, x: Array) -> DualMatrix:
        """Return D at the point x as a DualMatrix, which has bounds between frequencies."""
        m, root = self.loop.channels, np.sqrt(np.asarray(self.loop.delta))
        own, triangle = x[m * m * len(self.target) :], _triangle(m)
        sums = np.zeros((1 + max((len(weights) for _, weights in self.forbidden), default=0), m, m))
        for value, (i, j) in zip(own, triangle, strict=False):
            sums[0, i, j] = value if i == j else 2 * value
        for value, (i, weights) in zip(own[len(triangle) :], self.forbidden, strict=True):
            sums[: len(weights), i] += value * weights
        return DualMatrix.of(self.grid, self.H(x), 4 / self.loop.T * np.outer(root, root), sums)

    def H(self, x: Array) -> Complex:
        """Return H at the dual point x, on the grid (k, m, m)."""
        m, inner = self.loop.channels, self.heights.shape[1]
        parts = x[: 2 * m * m * inner].reshape(m * m, 2 * inner)
        return (self.heights @ (parts[:, :inner] + 1j * parts[:, inner:]).T).reshape(-1, m, m)

    @cached_property
    def _nodes(self) -> tuple[Array, Array, Complex, Array]:
        """The intervals of Gauss's rule: (middles (k,), half-widths (k,), Lambda E (k, points, m, m), bounds (2, k)).

        The first row of the bounds is for |Lambda E| in the disk of _DISK half-widths around the middle, and the second
        for the rounding errors of Lambda E.
        """
        E, half = self.loop.E(), np.diff(self.grid) / 2
        middle, nodes = self.grid[:-1] + half, []
        while middle.size:
            bounds = np.stack(sizes_around(E, middle, _DISK * half))
            settled = np.isfinite(bounds[0]) | (
                sum(part[0].size for part in nodes) + 2 * middle.size > budgets.BOUND_INTERVALS
            )
            nodes.append((middle[settled], half[settled], bounds[:, settled]))
            half = np.repeat(half[~settled] / 2, 2)
            middle = np.repeat(middle[~settled], 2) + half * np.tile([-1.0, 1.0], half.size // 2)
        middle, half, bounds = (np.concatenate([part[i] for part in nodes], axis=-1) for i in range(3))
        longest, m = max(self.loop.lam), self.loop.channels
        w = (middle[:, None] + half[:, None] * _POINTS).ravel()
        late = on_circle(w)[:, None] ** -np.asarray(self.loop.lam)
        response = (late[:, :, None] * E.at(on_circle(w))).reshape(middle.size, -1, m, m)
        bounds[1] += 7 * (longest + 2) * _UNIT * bounds[0]
        bounds[0] *= np.exp(longest * _DISK * half)
        return middle, half, response, bounds

    def objective_again(self, x: Array) -> tuple[float, float]:
        """Return the bound on J from the point x by Gauss's rule, and its largest error.

        In an interval the integrand g = (2/pi) Re tr H* Lambda E + (span/pi^2) w |H|^2 |E|^2 is analytic, because H is
        linear there. Here span is log(high/low) of the band. Gauss's rule of N points is exact for polynomials up to
        the degree 2N - 1, and its weights are positive. So its error is at most twice the length of the interval times
        the distance of g from such a polynomial. The distance from the Taylor polynomial around the middle is at most
        q^2N/(1 - q) times the maximum of |g| on the disk of radius half-width/q.
        """
        middle, half, response, (size, error) = self._nodes
        low, high = self.band
        span, H = np.log(high / low), self.H(x).reshape(self.grid.size, -1)
        at = lambda w: np.stack([np.interp(w, self.grid, column) for column in H.T], axis=-1)  # noqa: E731
        w, weight = middle[:, None] + half[:, None] * _POINTS, half[:, None] * _WEIGHTS
        inside, G = at(w), response.reshape(*w.shape, -1)
        h, g = np.linalg.norm(inside, axis=2), np.linalg.norm(G, axis=2)
        squares = span / np.pi**2 * w * h**2
        value = float((weight * (2 / np.pi * (np.conj(inside) * G).real.sum(axis=2) + squares * g**2)).sum())

        rise = _DISK * np.linalg.norm(at(middle + half) - at(middle - half), axis=1) / 2
        highest = np.linalg.norm(at(middle), axis=1) + rise
        most = 2 / np.pi * highest * size + span / np.pi**2 * (middle + _DISK * half) * (highest * size) ** 2
        missed = 4 * half * most * _DISK ** (-2.0 * _POINTS.size) / (1 - 1 / _DISK)
        of_sum = (w.size + 40) * _UNIT * (weight * (2 / np.pi * h * g + squares * g**2))
        of_values = weight * (2 / np.pi * h + squares * (2 * g + error[:, None])) * error[:, None]
        return -value - float(self.cost @ x), float(missed.sum() + (of_sum + of_values).sum())

    def charged(self, x: Array, value: float, swept: Array) -> tuple[float, Array, Array]:
        """Return the proved bound on J from x after an increase of C_0, and the least eigenvalues of D.

        The results are (bound, frequencies at which D was evaluated, its least eigenvalues there). `value` is the bound
        without the increase. The proved bound is 0 if the forbidden sums are zero only up to rounding.
        """
        if not self.exact:
            return 0.0, swept, np.zeros(swept.size)
        m, (again, error) = self.loop.channels, self.objective_again(x)
        lower, where, least = self.matrix(x).lower(swept, _WANTED * max(value, _LEAST) / m)
        return again - error + m * min(lower, 0.0), where, least

    def best(self) -> tuple[float, float]:
        """Return two bounds on J: an estimate with D >= 0 at samples, and a bound with D >= 0 on the whole circle.

        Both come from points of the barrier's path. After each round, frequencies are added at which D is negative.
        """
        imposed, swept = self.imposed(), self.swept()
        looked = self.block(swept)
        A, b, c = self.objective()
        nothing, sampled, remains = float(b @ b), 0.0, 0.0
        path = list[tuple[Array, float]]()
        for _ in range(budgets.BOUND_SWEEPS):
            program = Program(A, b, c, (self.block(imposed),))
            path = path or [(self.start, _FIRST * program.degree / nothing)]

            def onward(x: Array, t: float, program: Program = program) -> float:
                last = program.degree / (_GAP * max(nothing - program.value(x), _LEAST))
                return min(_STEEPER * t, last)

            first = len(path)
            path += list(follow(program, *path[-1], onward))
            points = [x for x, _ in path[first:]]
            value = nothing - program.value(points[-1])
            rooms = [np.linalg.eigvalsh(looked.at(x))[:, 0] for x in points]
            inside = [_between(inner, room, points[-1], rooms[-1]) for inner, room in zip(points, rooms, strict=True)]
            inside.append(_between(self.start, np.ones(swept.size), points[-1], rooms[-1]))
            some = [(nothing - program.value(x), x) for x in inside if x is not None]
            missing = _worst(-rooms[-1], swept)
            if some:
                best, point = max(some, key=lambda pair: pair[0])
                charged, where, least = self.charged(point, best, swept)
                sampled, remains = max(sampled, best), max(remains, charged)
                missing = np.union1d(missing, _worst(-least, where))
            if (remains if self.exact else sampled) >= (1 - _LARGEST_CHARGE) * value:
                break
            imposed = np.union1d(imposed, missing)
            added = Program(A, b, c, (self.block(missing),))
            while len(path) > 1 and not added.feasible(path[-1][0]):
                path.pop()
        return sampled, remains


def _splines(x: Array, knots: Array, degree: int) -> Array:
    """Return the B-splines over the knots at x, (k, knots + degree - 1). SciPy's splines would be slow to import."""
    place = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, knots.size - 2) + degree
    t = np.concatenate([[knots[0]] * degree, knots, [knots[-1]] * degree])
    x, splines = np.clip(x, knots[0], knots[-1])[:, None], np.eye(t.size - 1)[place]
    for d in range(1, degree + 1):
        width = t[d:] - t[:-d]
        rise = (x - t[:-d]) / np.where(width > 0, width, 1.0)
        splines = splines[:, :-1] * rise[:, :-1] + splines[:, 1:] * (1 - rise[:, 1:])
    return splines


def _gauss(grid: Array) -> tuple[Array, Array, Array]:
    """Return Gauss's rule of three points in each interval: points, weights, and positions in the interval (3,)."""
    part, weight = np.polynomial.legendre.leggauss(3)
    part, width = (1 + part) / 2, np.diff(grid)
    return (grid[:-1] + part[:, None] * width).ravel(), (weight[:, None] / 2 * width).ravel(), part


def _between(inner: Array, room: Array, x: Array, lacking: Array) -> Array | None:
    """Return a point on the line from x to `inner` at which no least eigenvalue is negative, or None.

    `room` and `lacking` (k,) are the least eigenvalues at `inner` and at x, for each frequency. They are concave on the
    line, so that linear interpolation bounds them from below. By these bounds the point is as near to x as possible.
    """
    if room.min() <= 0:
        return None if lacking.min() < 0 else x
    fails = lacking < 0
    share = (-lacking[fails] / (room[fails] - lacking[fails])).max(initial=0.0)
    return x + share * (inner - x)


def _knots(E: Lti, low: float, high: float, count: int) -> Array:
    """Return the knots of h, even in log frequency, and denser at the band's ends and at modes of E."""
    even = np.geomspace(low, high, count)
    step = np.log(even[1] / even[0])
    ends = np.exp(step * np.array(_NEAR_END))
    modes, width = _modes(E)
    near = modes * np.exp(_NEAR_MODE * np.outer([-1.0, 0.0, 1.0], np.minimum(width, step)))
    knots = np.sort(np.concatenate([even, low * ends, high / ends, near.ravel()]))
    knots = knots[(knots >= low) & (knots <= high)]
    return knots[np.concatenate([[True], np.diff(np.log(knots)) > _CLOSEST * step])]


def _modes(E: Lti) -> tuple[Array, Array]:
    """Return the modes of E [rad/sample] and their relative widths."""
    poles = E.poles()
    poles = poles[(np.abs(poles) > 0.01) & (poles.imag > 0)]
    return np.angle(poles), -np.log(np.abs(poles)) / np.angle(poles)


def _triangle(m: int) -> list[tuple[int, int]]:
    """Return the indices of the upper triangle, row by row."""
    return [(i, j) for i in range(m) for j in range(i, m)]


def _forbidden(loop: Loop, E: Lti) -> tuple[tuple[tuple[int, Array], ...], bool]:
    """Return sums over the s_k that are zero because of delays, and whether they are exactly zero.

    A sum is (row i, weights v (k, m)) with sum_k v_k' s_k[i] = 0 for every F = Theta R Psi E with a causal R. Row i of
    s_k is zero for 1 <= k <= theta_i. Later coefficients of F are sums of products of coefficients of R and of Psi E.
    If the channels' psi differ, the possible values of the first later coefficients form a subspace. The vectors v that
    are orthogonal to it are computed as a null space, up to rounding. Any subset of the sums gives a bound, so that
    only the first steps of long delays are used.
    """
    import scipy

    m, span = E.inputs, min(max(loop.psi), budgets.BOUND_SUMS // E.inputs)
    rows: list[tuple[int, Array]] = []
    for i, theta in enumerate(loop.theta):
        for k in range(1, theta + 1):
            for unit in np.eye(m):
                weights = np.zeros((theta + span + 1, m))
                weights[k] = unit
                rows.append((i, weights))
    exact = True
    if span:
        G = delay(loop.psi, loop.T) @ E
        impulse = [G.D, *(G.C @ np.linalg.matrix_power(G.A, k) @ G.B for k in range(span - 1))]
        reach = np.zeros((span * m, span * m))  # map from the coefficients of R's row to the steps of F's row
        for step in range(span):
            for k in range(step, span):
                reach[step * m : (step + 1) * m, k * m : (k + 1) * m] = impulse[k - step]
        exact = not reach.any()
        for v in scipy.linalg.null_space(reach, rcond=1e-9).T:
            for i, theta in enumerate(loop.theta):
                weights = np.zeros((theta + span + 1, m))
                for k, row in enumerate(v.reshape(span, m)):  # F_k = 2 (s_{k+1} - s_k)/T, and s_k is zero up to theta
                    weights[theta + k + 1] += row
                    if k:
                        weights[theta + k] -= row
                rows.append((i, weights))
    rows.sort(key=lambda one: int(np.flatnonzero(one[1].any(axis=1))[0]))
    return tuple(rows[: budgets.BOUND_SUMS]), exact


def _causal(grid: Array, heights: Array, w: Array) -> Complex:
    """Return (1/z - 1) H_+ + H_0 at z = e^jw for H = a and then for H = j a, (k, 2 functions).

    Each function a of the frequency has its `heights` on the grid, is linear between the grid's points, and is zero
    outside. Its first and last heights are zero. H(conj z) is conj H(z). If sigma_i is the change of a's slope at x_i,
    H_k = -sum sigma_i cos(k x_i)/(pi k^2) for H = a. So H_+ consists of dilogarithms
    Li2(e^jx) = pi^2/6 - |x| (2 pi - |x|)/4 + j Cl2(x).
    """
    slopes = np.diff(heights, axis=0) / np.diff(grid)[:, None]
    bends = np.diff(slopes, axis=0, prepend=0, append=0) / (2 * np.pi)
    mean = (np.diff(grid) @ (heights[1:] + heights[:-1])) / (2 * np.pi)
    below, above = dilogarithm(grid - w[:, None]), dilogarithm(grid + w[:, None])
    back = np.exp(-1j * w)[:, None]
    cosine, sine = -((below + np.conj(above)) @ bends), -1j * ((below - np.conj(above)) @ bends)
    return np.hstack([(back - 1) * cosine + back * mean, (back - 1) * sine])


def _worst(lacking: Array, w: Array) -> Array:
    """Return the frequencies of the highest local maxima above zero, at most _MOST_ADDED."""
    padded = np.concatenate([[-np.inf], lacking, [-np.inf]])
    local = np.flatnonzero((lacking >= padded[:-2]) & (lacking >= padded[2:]) & (lacking > 0))
    return w[local[np.argsort(lacking[local])[-_MOST_ADDED:]]]


@dataclass(frozen=True)
class BoundBeside:
    """A bound on the couplings that this-environment certifies, and the gap from it to a design.

    `reason` is the reason why there is no bound, or None. The gap is None if the design has further requirements, which
    the bound neglects, or if it minimises the supremum.
    """

    rms_mismatch_db: float | None = None
    gap_db: float | None = off_table("if given", None)
    reason: str | None = off_table("if given", None)
    even_without: tuple[str, ...] = ()  # further requirements of the design, which the bound neglects
    relative_mismatch_db: float | None = off_table("if given", None)  # bound on the supremum, if this was minimised
    proved: bool = False  # False: an estimate, whose dual matrix was checked at samples only

    @classmethod
    def of(
        cls,
        loop: Loop,
        best: Design,
        reached_db: float,
        band_hz: tuple[float, float],
        options: Options,
        begun: Forked[Bound] | None = None,
    ) -> BoundBeside:
        """Return the bound for the loop of a design with the rms mismatch `reached_db`; `begun` runs `bound`."""
        if loop.channels > MOST:
            return cls(reason=_NO_BOUND)
        if best.condition == "known-device":
            return cls(reason="no bound is known for couplings of known devices")
        if best.objective == 0:
            return cls(reason="the mismatch is zero: there is nothing to bound")
        least = begun.result() if begun else bound(loop, band_hz)
        if not least.rms:
            return cls(reason="the bound is zero, so it does not limit the design")
        more = {
            "latency": any(map(any, loop.latency or ())),
            "switching delays": loop.varying_delay is not None,
            "ranges": loop.ranges is not None,
            "the limiter": options.limiter,
            "the cap above 100 Hz": options.high_gain is not None,
        }
        without = tuple(name for name, present in more.items() if present)
        if options.objective == "sup":  # |M|_F <= sqrt(m) |M|, and |E|_F >= |E|
            return cls(
                least.rms_db,
                even_without=without,
                relative_mismatch_db=least.rms_db - decibels(loop.channels) / 2,
                proved=least.proved,
            )
        gap = None if without else reached_db - least.rms_db
        return cls(least.rms_db, gap, even_without=without, proved=least.proved)

    @property
    def words(self) -> str:
        """The bound and the gap, or the reason, in one line for a report."""
        if self.reason or self.rms_mismatch_db is None:
            return self.reason or ""
        sup = (
            f", nor than {self.relative_mismatch_db:z.2f} dB in the supremum"
            if self.relative_mismatch_db is not None
            else ""
        )
        without = f", even without {' and '.join(self.even_without)}" if self.even_without else ""
        left = f": {self.gap_db:z.2f} dB below this design" if self.gap_db is not None else ""
        rest = f"{self.rms_mismatch_db:z.2f} dB rms{sup}{without}{left}"
        certified = "that this-environment certifies"  # known-device may certify better couplings
        if self.proved:
            return f"no linear coupling {certified} can be better than {rest}"
        rest = rest.replace(", nor than", " and", 1)
        return f"estimate, checked at sampled frequencies: the limit of linear couplings {certified} is {rest}"
