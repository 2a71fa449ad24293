"""Spring-damper couplings (26): the best under either condition, the stiffest, and the moving average.

Gains are handled in units of the usable damping d = (1 - RESERVE) delta: k = KT/d, b = B/d (gain_set).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from controller.coupling import MovingAverage, SpringDamper
from controller.delay import delay
from controller.loop import Loop, force_map
from controller.lti import Array, Lti, Sampled
from design.conditions import any_environment, any_environment_delayed, even_damping, this_environment
from design.frequency import frequencies, hermitian, on_circle, peaks
from design.lmi import RESERVE, Complex, Shaping, affine_lmis, gain_lmi, least_phi, solve, solved, usable
from design.multipliers import (
    BETA,
    Lags,
    LimiterProof,
    half_widths,
    limiter_demand,
    limiter_lag,
    limiter_refusal,
    switching_block,
    switching_sweep,
)
from design.multipliers import limiter as limiter_proof
from design.result import Design, DesignFailed, Infeasible, Requirement
from design.transparency import BAND_HZ, transparency

if TYPE_CHECKING:  # slow to load
    import cvxpy as cp
    from scipy.optimize import OptimizeResult

# ----------------------------------------------------------------------------------------------------
# The exact convex set of spring-damper gains that satisfy Theorem 4, channel by channel.
#
# With D = (z-1)/(Tz), W = K/D + B and N = (1 - z^-n)/(2 delta), n = theta + 1, the transformed coupling (11) is V-hat
# = 1/W - N (a number per channel), and He V-hat >= Delta_V |V-hat|^2 times |W|^2 reads, in units k = KT/delta, b =
# B/delta and Sigma = delta/Delta_V,
#
#     k/2 + b >= |y|^2/4 + |1 - y/2|^2 / Sigma    on |z| = 1,    y = k (1 + ... + 1/z^theta) + b (1 - z^-n).
#
# y is a polynomial in 1/z, affine in (k, b), so this is one linear matrix inequality, without conservatism. psi = 0
# needs no excess of passivity in V-hat (Sigma = inf): the last term is absent.
#
# Its matrix has theta + 2 rows and its solution costs their fifth power, so beyond LARGEST_GRAM samples the
# inequality is imposed frequency by frequency - a second-order cone in the two unknowns - and where the solution
# fails in between, there too (`solve_within`). The cones contain the set and the rounds shrink them to it: both ways
# end at the same gains.


_LARGEST_GRAM = 12  # samples of delay
_PER_LOBE = 8  # frequencies per ripple of y at which the inequality is imposed first
_MISSED = 2e-6  # of the usable damping: what the inequality may miss in between, far less than the reserve of a design
_MOST_ROUNDS = 12


def gain_set(k: cp.Expression, b: cp.Expression, theta: int, sigma: float) -> list[cp.Constraint]:
    """Constraints on the scalars k and b (units above); sigma = inf where psi = 0.

    Gram form: a trigonometric polynomial r - |c(z)|^2 is non-negative iff c c' <= Q for some Q >= 0 whose
    diagonals sum to r on the main one and to zero on the others.
    """
    import cvxpy as cp

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
    largest_gram: int = _LARGEST_GRAM,
) -> cp.Problem:
    """The solved problem with every channel of gains = (k_1, ..., k_N, b_1, ..., b_N) in its set.

    Raises as `solve`, and DesignFailed where an inequality still fails after all rounds.
    """
    import cvxpy as cp

    N = len(theta)
    cones = {i: _first_frequencies(theta[i]) for i in range(N) if theta[i] > largest_gram}
    for _ in range(_MOST_ROUNDS):
        problem = cp.Problem(objective, [*_constraints(gains, theta, sigma, cones), *more])
        solve(problem, what)
        k, b = np.split(solved(gains), 2)
        missed = {i: _missed_frequencies(k[i], b[i], theta[i], float(sigma[i])) for i in cones}
        if not any(w.size for w in missed.values()):
            return problem
        cones = {i: np.union1d(w, missed[i]) for i, w in cones.items()}
    line = f"{what}: after {_MOST_ROUNDS} rounds Theorem 4 still fails between the frequencies"
    raise DesignFailed(None, (), line)


def _constraints(
    gains: cp.Expression, theta: Sequence[int], sigma: Array, cones: Mapping[int, Array]
) -> list[cp.Constraint]:
    N, constraints = len(theta), []
    for i in range(N):
        k, b = gains[i], gains[N + i]
        if i in cones:
            constraints += _gain_cones(k, b, theta[i], float(sigma[i]), cones[i])
        else:
            constraints += gain_set(k, b, theta[i], float(sigma[i]))
    return constraints


def _gain_cones(k: cp.Expression, b: cp.Expression, theta: int, sigma: float, w: Array) -> list[cp.Constraint]:
    """The inequality at the frequencies w [rad/sample]: |(2c, r - 1)| <= r + 1 says |c|^2 <= r."""
    import cvxpy as cp

    of_k, of_b = _polynomials(theta, w)
    rows = [part * k + other * b for part, other in zip(_parts(of_k), _parts(of_b), strict=True)]
    if np.isfinite(sigma):
        rows += [(2 * (i == 0) - row) / np.sqrt(sigma) for i, row in enumerate(rows)]
    room = (k / 2 + b) * np.ones(w.size)
    cones = cp.SOC(room + 1, cp.vstack([*rows, room - 1]), axis=0)
    return cast(list[cp.Constraint], [cones, k >= 0, b >= 0])


def _missed_frequencies(k: float, b: float, theta: int, sigma: float) -> Array:
    """Peaks [rad/sample] at which the gains miss the inequality by more than MISSED."""

    def excess(w: Array) -> Array:
        of_k, of_b = _polynomials(theta, w)
        y = k * of_k + b * of_b
        return np.abs(y) ** 2 / 4 + np.abs(1 - y / 2) ** 2 / sigma - (k / 2 + b)

    return peaks(excess, _first_frequencies(2 * theta + 1), _MISSED)


def _first_frequencies(theta: int) -> Array:
    """PER_LOBE to each ripple of y, from 0 to pi [rad/sample]."""
    return np.linspace(0, np.pi, _PER_LOBE * (theta + 1) + 1)


def _polynomials(theta: int, w: Array) -> tuple[Array, Array]:
    """1 + ... + z^-theta and 1 - z^-n at exp(jw), complex, (w,) each."""
    n = theta + 1
    turned = np.exp(-1j * w * n)
    still = np.abs(np.exp(-1j * w) - 1) < 1e-12
    window = np.where(still, n, (1 - turned) / np.where(still, 1, 1 - np.exp(-1j * w)))
    return window, 1 - turned


def _parts(values: Array) -> tuple[Array, Array]:
    return values.real, values.imag


# ----------------------------------------------------------------------------------------------------
# One step of the convex-concave sequence for ||W1 L W2||_inf (23) over spring-damper gains.
#
# With g = k + b (1 - 1/z) per channel the norm is below mu iff (W1 L g W2)* (W1 L g W2) <= mu^2 g* g on |z| = 1: L g
# is affine in the gains, and g* g is replaced by its tangent at the gains before, which lies below it. So every step
# keeps what the one before achieved, and mu^2 enters linearly: no bisection.


def step(shaping: Shaping, sigma: Array, at: Array, norm: float, w: Array) -> tuple[Array, float]:
    """(gains, bound on the norm at the frequencies w) of one convex-concave step from the gains `at`."""
    import cvxpy as cp

    loop = shaping.loop
    gains, t = cp.Variable(2 * loop.channels), cp.Variable()
    constant, slopes = _tangent(shaping, at, norm, w)
    cuts = affine_lmis(constant, slopes, cp.hstack([gains, t]))
    solve_within(cp.Minimize(t), gains, loop.theta, sigma, "a step of the convex sequence", cuts)
    return solved(gains), norm * float(np.sqrt(solved(t)))


def _tangent(shaping: Shaping, at: Array, norm: float, w: Array) -> tuple[Complex, Complex]:
    """[[g0* g + g* g0 - g0* g0, (W1 L g W2)*], [W1 L g W2, t norm^2]], scaled to order one; t is the last variable."""
    N = shaping.loop.channels
    left, right, late = shaping.parts(w)
    difference = 1 - np.exp(-1j * w)
    basis = np.eye(N)[:, None, :] * np.ones((w.size, 1))  # (N, k, N): e_i at every frequency
    g = np.concatenate([basis, basis * difference[:, None]])  # (2N, k, N): diagonals of g by variable
    g0 = np.tensordot(at, g, axes=1)  # (k, N)
    scale = 1 / np.abs(g0)  # columns are divided by |g0|, rows by the norm
    rows = (left * (shaping.loop.T / shaping.usable)) @ right * scale[:, None, :] / norm
    row_slopes = (late * g[:, :, None, :]) @ right * scale[:, None, :] / norm
    tangent = 2 * (np.conj(g0) * g).real * scale**2
    diagonal = np.eye(N)
    base = -np.broadcast_to(diagonal, (w.size, N, N)).astype(np.complex128)
    return gain_lmi(rows, row_slopes, base, tangent[..., None] * diagonal)


# ----------------------------------------------------------------------------------------------------
# Spring-damper gains under the this-environment condition, for one environment: a local search from several starts.
#
# The set is not convex in (K, B), so nothing here is proved best. The rms mismatch is minimised by sequential
# quadratic programming with the condition at sampled frequencies; where the refined sweep of design.conditions finds it
# violated in between, that frequency is added and the search resumed. What is returned passes that sweep.


#: The sampled condition keeps half as much again as the promised reserve, for what lies between the samples.
_SAMPLED_RESERVE = 1.5 * RESERVE
_SOFTEST, STIFFEST = 1.0, 1e6  # [N/m], bounds of the search
_CLOSEST_POLE = 1e-5  # from the unit circle
_MOST_WEIGHT = 5.0  # of the limiter's multiplier
_STUCK = 1e-3  # a search that leaves the sampled condition violated by this has no feasible point nearby
_MOST_ROUNDS_FROZEN_ENVIRONMENT = 8


_Responses = tuple[Complex, Complex, Complex]  # (z-1)/(Tz), Psi E and Theta at some frequencies
_DIFFERENCE = 1e-7


class _SampledLoop:
    """Mismatch and condition at fixed frequencies, as smooth functions of x = (log K, B/delta), shape (2N,)."""

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.loop, self.E = loop, loop.E()
        per_hz = 2 * np.pi * loop.T
        low, high = (per_hz * f for f in band_hz)
        self.band = frequencies(self.E, low=low, high=min(high, np.pi), points=80)
        self.conditions = frequencies(self.E, low=1e-3, points=80)
        self.loop_in_band, self.loop_at_conditions = self._responses(self.band), self._responses(self.conditions)
        E = self.E.at(on_circle(self.band))
        self.size2 = (np.abs(E) ** 2).sum(axis=(1, 2))
        self.target = delay(loop.lam, loop.T).at(on_circle(self.band)) @ E
        self.delta = even_damping(loop.delta, loop.T, loop.T_max)
        self.root = np.sqrt(loop.T / self.delta)
        self._last: tuple[_Responses, Array, Array, Complex] | None = None
        self._known: dict[int, tuple[_Responses, Array, tuple[Complex, Array, Complex, Complex]]] = {}

    def coupling(self, x: Array) -> SpringDamper:
        log_k, b = np.split(x, 2)
        return SpringDamper(np.exp(log_k), np.maximum(b, 0.0) * self.delta)

    def point(self, coupling: SpringDamper) -> Array:
        return np.concatenate([np.log(coupling.K), coupling.B / self.delta])

    def add(self, w: float) -> None:
        """Impose the condition at the frequency w [rad/sample] too."""
        self.conditions = np.append(self.conditions, w)
        self.loop_at_conditions = self._responses(self.conditions)

    def _responses(self, w: Array) -> _Responses:
        """(z-1)/(Tz), Psi E and Theta at exp(jw)."""
        loop, z = self.loop, on_circle(w)
        delayed = delay(loop.psi, loop.T).at(z) @ self.E.at(z)
        return (z - 1) / (loop.T * z), delayed, delay(loop.theta, loop.T).at(z)

    def force(self, x: Array, responses: _Responses) -> Complex:
        """F = Theta G (G + Psi E)^-1 Psi E with G = V^-1, (k, N, N)."""
        by, b, _, right = self._solved(x, responses)
        g = by[0] + by[1] * b
        return np.diagonal(responses[2], axis1=1, axis2=2)[:, :, None] * g[:, :, None] * right

    def _solved(self, x: Array, responses: _Responses) -> tuple[Complex, Array, Complex, Complex]:
        """(dG by log K and by B/delta, (2, k, N); B/delta; S = (G + Psi E)^-1; S Psi E) at x; the last is remembered.

        An unknown of channel i moves F by (Theta Psi E S)[:, i] (S Psi E)[i, :] times dG.
        """
        (D, E, _), N = responses, self.loop.channels
        known = self._known.get(D.size)
        if known is None or known[0] is not responses or not np.array_equal(known[1], x):
            log_k, b = np.split(x, 2)
            by = np.stack([np.broadcast_to(np.exp(log_k), (D.size, N)), D[:, None] * self.delta])
            S = np.linalg.inv((by[0] + by[1] * b)[:, :, None] * np.eye(N) + E)
            known = self._known[D.size] = (responses, x.copy(), (by, b, S, S @ E))
        return known[2]

    def square_mismatch(self, x: Array) -> float:
        """Logarithm of the mean over log frequency of ||M||_F^2 / ||E||_F^2."""
        M = self.force(x, self.loop_in_band) - self.target
        ratio = (np.abs(M) ** 2).sum(axis=(1, 2)) / self.size2
        log_w = np.log(self.band)
        return float(np.log(np.trapezoid(ratio, log_w) / (log_w[-1] - log_w[0])))

    def square_mismatch_slope(self, x: Array) -> Array:
        """Its gradient by x; the unknowns behind the gains do not move it."""
        gains, (_, E, theta) = x[: 2 * self.loop.channels], self.loop_in_band
        by, _, S, right = self._solved(gains, self.loop_in_band)
        M, log_w = self.force(x, self.loop_in_band) - self.target, np.log(self.band)
        back = right @ M.conj().swapaxes(1, 2) @ theta @ E
        moved = 2 * (np.einsum("kij,kji->ki", back, S) * by).real
        total = np.trapezoid((np.abs(M) ** 2).sum(axis=(1, 2)) / self.size2, log_w)
        slope = np.trapezoid(moved / self.size2[:, None], log_w, axis=1).ravel() / total
        return np.concatenate([slope, np.zeros(x.size - slope.size)])

    def room(self, x: Array) -> Array:
        """1 - SAMPLED_RESERVE less the damping ratio that each sampled frequency asks for; (k,), or (k + 1,).

        Delay in the environment can make the loop unstable where the sampled condition still holds, so there the
        distance of its poles from the circle is the last entry.
        """
        room = 1 - _SAMPLED_RESERVE + self._least(x)[0]
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def room_slope(self, x: Array) -> Array:
        """The gradient of `room`, (k, 2N) or (k + 1, 2N); poles are differenced."""
        _, E, theta = self.loop_at_conditions
        by, _, S, right = self._solved(x, self.loop_at_conditions)
        v = self._least(x)[1][:, :, None]
        into = (v.conj().swapaxes(1, 2) @ theta @ E @ S)[:, 0]
        turned = into * (right @ v)[:, :, 0] / (on_circle(self.conditions) - 1)[:, None]
        slope = np.concatenate([*(turned * by).real], axis=1)
        if not any(self.loop.psi):
            return slope
        return np.vstack([slope, self._stability_slope(x)])

    def _stability_slope(self, x: Array) -> Array:
        at, steps = self.stability(x), _DIFFERENCE * np.eye(x.size)
        return np.array([(self.stability(x + step) - at) / _DIFFERENCE for step in steps])

    def _least(self, x: Array) -> tuple[Array, Complex]:
        """Least eigenvalue (k,) of `_block` in units of Delta_D/T, and v whose v* block v it is; of the last x."""
        at = self.loop_at_conditions
        if self._last is None or self._last[0] is not at or not np.array_equal(self._last[1], x):
            block = self._block(x)
            root = np.tile(self.root, block.shape[1] // self.loop.channels)
            values, vectors = np.linalg.eigh(root[:, None] * block * root)
            self._last = (at, x.copy(), values[:, 0].astype(float), vectors[:, :, 0] * root)
        return self._last[2], self._last[3]

    def _block(self, x: Array) -> Complex:
        """What must be positive definite with the damping, at each sampled frequency, Hermitian."""
        return hermitian(self.force(x, self.loop_at_conditions) / (on_circle(self.conditions) - 1)[:, None, None])

    def stability(self, x: Array) -> float:
        """By how much more than CLOSEST_POLE the poles keep away from the circle."""
        F = force_map(self.E, self.coupling(x), self.loop.theta, self.loop.psi)
        return float(1 - _CLOSEST_POLE - np.abs(F.poles()).max(initial=0.0))

    def search(self, x: Array) -> OptimizeResult:
        return self.minimised(x, [], self.room_slope)

    def minimised(
        self, x: Array, more: list[tuple[float, float]], slope: Callable[[Array], Array] | None = None
    ) -> OptimizeResult:
        """The local optimum from x; `more` bounds what is behind the gains; without `slope` room is differenced."""
        N = self.loop.channels
        from scipy.optimize import minimize  # slow to load

        bounds = [(np.log(_SOFTEST), np.log(STIFFEST))] * N + [(0.0, 20.0)] * N + more
        condition = {"type": "ineq", "fun": self.room, "jac": slope}
        options = {"maxiter": 100, "ftol": 1e-7}
        problem = {"bounds": bounds, "constraints": condition, "options": options}
        return minimize(self.square_mismatch, x, jac=self.square_mismatch_slope, method="SLSQP", **problem)


_Optimum = Callable[[SpringDamper], tuple[SpringDamper | None, int]]  # start -> (gains or None, searches)


def _least_rms(
    loop: Loop,
    starts: Iterable[SpringDamper],
    optimum: _Optimum | None = None,
    band_hz: tuple[float, float] = BAND_HZ,
) -> tuple[SpringDamper | None, float, int]:
    """(gains, rms mismatch as a ratio, searches) of the best local optimum; gains None if none was found.

    `optimum` searches from one start; the default finds what this-environment certifies.
    """
    optimum = optimum or partial(_certified_optimum, loop, band_hz)
    E, best, least, searches = loop.E(), None, np.inf, 0
    for start in starts:
        coupling, runs = optimum(start)
        searches += runs
        if coupling is None:
            continue
        rms = transparency(loop.F(coupling), E, loop.lam, band_hz).rms_mismatch
        if rms < least:
            best, least = coupling, rms
    return best, least, searches


def _certified_optimum(
    loop: Loop, band_hz: tuple[float, float], start: SpringDamper
) -> tuple[SpringDamper | None, int]:
    """(a local optimum that passes the refined sweep or None, searches), adding the frequencies where one fails."""
    sampled = _SampledLoop(loop, band_hz)
    x = sampled.point(start)
    for searches in range(1, _MOST_ROUNDS_FROZEN_ENVIRONMENT + 1):
        x = sampled.search(x).x
        coupling = sampled.coupling(x)
        requirement = this_environment(loop.F(coupling), loop.delta, loop.T_max)
        if requirement.ratio <= 1 - RESERVE:
            return coupling, searches
        stuck = sampled.room(x).min() < -_STUCK
        if stuck or requirement.frequency_hz is None:  # None: unstable, so there is no frequency to add
            return None, searches
        binding = 2 * np.pi * loop.T * requirement.frequency_hz
        sampled.add(max(binding, 1e-6))
    return None, _MOST_ROUNDS_FROZEN_ENVIRONMENT


# ----------------------------------------------------------------------------------------------------
# Spring-damper gains that are safe under any switching of their delays: a local search like the one above.
#
# Its sampled condition is `switching_block`: the multiplier is searched together with the gains. What is returned
# passes the sweep of `switching_sweep`, which knows nothing of the multiplier found here.


_FIRST = 0.5  # the multiplier alpha T/delta that a search begins with where the start has none
_MULTIPLIERS = (1e-4, 10.0)  # ... and its bounds


class _SwitchingLoop(_SampledLoop):
    """As SampledLoop, with x = (log K, B/delta, log alpha T/delta of the channels whose delay varies)."""

    def __init__(self, loop: Loop, lo: Sequence[int], hi: Sequence[int]) -> None:
        self.range, self.h = (lo, hi), half_widths(lo, hi)
        self.active = np.flatnonzero(self.h)
        super().__init__(loop)

    def coupling(self, x: Array) -> SpringDamper:
        return super().coupling(self._gains(x))

    def point(self, coupling: SpringDamper) -> Array:
        """The gains with their best multiplier."""
        loop = self.loop
        found = switching_sweep(loop.sent(coupling), *self.range, loop.delta, T_max=loop.T_max)
        a = np.array(found.alpha)[self.active] * loop.T / self.delta[self.active]
        a = np.clip(np.where(np.isfinite(a), a, _FIRST), *_MULTIPLIERS)
        return np.concatenate([super().point(coupling), np.log(a)])

    def force(self, x: Array, responses: _Responses) -> Complex:
        return super().force(self._gains(x), responses)

    def room(self, x: Array) -> Array:
        """1 - SAMPLED_RESERVE less the damping ratio at each sampled frequency, with the multiplier in x."""
        loop, m, alpha = self.loop, self.loop.channels, np.zeros(self.loop.channels)
        alpha[self.active] = np.exp(x[2 * m :]) * (self.delta / loop.T)[self.active]
        D, E, _ = self.loop_at_conditions
        now = np.broadcast_to(np.eye(m, dtype=complex), E.shape)
        G = Sampled(on_circle(self.conditions)[None], self.force(x, (D, E, now))[None], loop.T)
        block = hermitian(switching_block(G, *self.range, loop.delta, alpha, loop.T_max)[0].G[0])
        error = block[:, m:, :m]
        schur = block[:, :m, :m] - np.conj(np.swapaxes(error, 1, 2)) @ (error / (2 * alpha[self.active])[:, None])
        room = (np.linalg.eigvalsh(self.root[:, None] * schur * self.root)[:, 0] - _SAMPLED_RESERVE).astype(float)
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def search(self, x: Array) -> OptimizeResult:
        return self.minimised(x, [(np.log(_MULTIPLIERS[0]), np.log(_MULTIPLIERS[1]))] * self.active.size)

    def _gains(self, x: Array) -> Array:
        return x[: 2 * self.loop.channels]


def _least_rms_switching(
    loop: Loop, lo: Sequence[int], hi: Sequence[int], starts: Iterable[SpringDamper]
) -> tuple[SpringDamper | None, float, int]:
    """(gains, rms mismatch as a ratio, searches) of the best local optimum that is safe under any switching."""
    return _least_rms(loop, starts, lambda start: _safe_optimum(_SwitchingLoop(loop, lo, hi), start))


def _safe_optimum(sampled: _SwitchingLoop, start: SpringDamper) -> tuple[SpringDamper | None, int]:
    """(a local optimum that passes the refined sweep or None, searches)."""
    loop, x = sampled.loop, sampled.point(start)
    for searches in range(1, _MOST_ROUNDS_FROZEN_ENVIRONMENT + 1):
        x = sampled.search(x).x
        coupling = sampled.coupling(x)
        requirement = switching_sweep(loop.sent(coupling), *sampled.range, loop.delta, T_max=loop.T_max).requirement
        if requirement.ratio <= 1 - RESERVE:
            return coupling, searches
        if sampled.room(x).min() < -_STUCK or requirement.frequency_hz is None:
            return None, searches
        sampled.add(max(2 * np.pi * loop.T * requirement.frequency_hz, 1e-6))
    return None, _MOST_ROUNDS_FROZEN_ENVIRONMENT


# ----------------------------------------------------------------------------------------------------
# Spring-damper gains that are safe also while forces are limited: the same search with the limiter's block
# (design.multipliers.limiter_demand) in the place of the linear one, and its multiplier among the unknowns.


class _LimiterLoop(_SampledLoop):
    """As Sampled, with x = (log K, B/delta, c) and one weight c per channel, of the lag 1."""

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.rho = limiter_lag(loop.delta, loop.T, BETA)
        self._undelayed: tuple[_Responses, _Responses] | None = None
        super().__init__(loop, band_hz)

    def coupling(self, x: Array) -> SpringDamper:
        return super().coupling(self._gains(x))

    def point(self, coupling: SpringDamper) -> Array:
        """The gains with their best multiplier."""
        found = self.proof(coupling)
        return np.concatenate([super().point(coupling), np.array(found.c)[:, 0]])

    def proof(self, coupling: SpringDamper, c: Lags | None = None) -> LimiterProof:
        """What the limiter asks at the multiplier `c` or the best one, by the refined sweep."""
        loop = self.loop
        return limiter_proof(loop.sent(coupling), loop.theta, loop.delta, self.rho, c, T_max=loop.T_max)

    def force(self, x: Array, responses: _Responses) -> Complex:
        return super().force(self._gains(x), responses)

    def room(self, x: Array) -> Array:
        """The least eigenvalue of the block, in units of Delta_D/T, at each sampled frequency."""
        room = self._least(x)[0]
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def room_slope(self, x: Array) -> Array:
        """Its gradient: the block's first columns hold G, and c_i takes itself from N_i."""
        loop, (_, E, theta), v = self.loop, self.loop_at_conditions, self._least(x)[1]
        (by, _, S, right), z = self._solved(self._gains(x), self._now()), on_circle(self.conditions)[:, None]
        first, second = np.split(v, 2, axis=1)
        N = -np.stack([_polynomials(n, self.conditions)[0] for n in loop.theta], axis=1) - self.weights(x).T
        late = np.diagonal(theta, axis1=1, axis2=2) / (z - 1)
        into = np.einsum("ki,kij->kj", first.conj() * late + second.conj() * N, E @ S)
        turned = into * np.einsum("kij,kj->ki", right, first)
        steps = np.einsum("kij,kj->ki", self.force(x, self._now()), first) - (1 - 1 / z) * np.array(self.rho) * second
        slope = np.concatenate([*(turned * by).real, -(second.conj() * steps).real], axis=1)
        return np.vstack([slope, self._stability_slope(x)]) if any(loop.psi) else slope

    def _now(self) -> _Responses:
        """Of the forces as they leave, before Theta."""
        D, E, _ = at = self.loop_at_conditions
        if self._undelayed is None or self._undelayed[0] is not at:
            now = np.broadcast_to(np.eye(self.loop.channels, dtype=complex), E.shape)
            self._undelayed = (at, (D, E, now))
        return self._undelayed[1]

    def _block(self, x: Array) -> Complex:
        loop = self.loop
        G = Sampled(on_circle(self.conditions)[None], self.force(x, self._now())[None], loop.T)
        demand = limiter_demand(G, loop.theta, loop.delta, self.rho, self.weights(x).tolist(), loop.T_max)
        return hermitian(demand.free.G[0] + (1 - _SAMPLED_RESERVE) * demand.gain.G[0])

    def search(self, x: Array) -> OptimizeResult:
        return self.minimised(x, [(0.0, _MOST_WEIGHT)] * self.loop.channels, self.room_slope)

    def weights(self, x: Array) -> Array:
        """c, a row of one lag per channel."""
        return np.maximum(x[2 * self.loop.channels :, None], 0.0)

    def _gains(self, x: Array) -> Array:
        return x[: 2 * self.loop.channels]


def _limited_optimum(loop: Loop, band_hz: tuple[float, float], start: SpringDamper) -> tuple[SpringDamper | None, int]:
    """(a local optimum that passes the limiter's refined sweep or None, searches)."""
    sampled = _LimiterLoop(loop, band_hz)
    x = sampled.point(start)
    for searches in range(1, _MOST_ROUNDS_FROZEN_ENVIRONMENT + 1):
        x = sampled.search(x).x
        coupling = sampled.coupling(x)
        requirement = sampled.proof(coupling, sampled.weights(x).tolist()).requirement
        if requirement.ratio <= 1 - RESERVE:
            return coupling, searches
        if sampled.room(x).min() < -_STUCK or requirement.frequency_hz is None:
            return None, searches
        sampled.add(max(2 * np.pi * loop.T * requirement.frequency_hz, 1e-6))
    return None, _MOST_ROUNDS_FROZEN_ENVIRONMENT


#: The sequence stops when a step improves the norm by less than this, relatively.
_SETTLED = 1e-6
_MOST_STEPS = 60
#: A damper of less than this share of the device's damping is none: solvers leave 1e-9 where the optimum has zero.
_NEGLIGIBLE = 1e-6


def design(
    loop: Loop,
    condition: str = "any-environment",
    starts: Sequence[SpringDamper] = (),
    switching: tuple[Sequence[int], Sequence[int]] | None = None,
    limiter: bool = False,
    band_hz: tuple[float, float] | None = None,
    W1: Lti | None = None,
    W2: Lti | None = None,
) -> Design:
    """The best spring-damper under `condition`; by default the starts are chosen, a start need not be feasible.

    any-environment: minimises ||W1 L W2||_inf (23) over the exact set; the result does not depend on the start.
    this-environment: minimises the rms mismatch in this environment from every start, local optima only; with
    `switching` = (lo, hi) [samples] also safe under any switching of the forces' delays within it, with `limiter` also
    while forces are limited (any-environment is anyway, at no cost).
    `band_hz` is where the mismatch counts.

    Raises Infeasible where Theorem 4 admits no gains, DesignFailed where the search finds none for this-environment.
    """
    if condition == "any-environment" and switching is None:
        return _for_any_environment(Shaping(loop, W1, W2), starts[0] if starts else None)
    if condition == "this-environment":
        if switching and limiter:
            raise ValueError("limiter and switching: limited forces are proved for constant delays, ask for one")
        return _for_this_environment(loop, starts, switching, limiter, band_hz)
    if switching:
        raise ValueError("delays that vary are designed for by the this-environment condition only")
    raise ValueError(f"condition is {condition!r}, expected 'any-environment' or 'this-environment'")


#: Devices whose search ends within half a minute: matrix inequalities cost their sixth power, eigenvalues their third.
_MOST_ANY, _MOST_LIMITED = 16, 12


def _require_few(loop: Loop, most: int, what: str) -> None:
    if loop.channels > most:
        raise DesignFailed(None, (), f"{loop.channels} devices, allowed are {most} for a spring-damper by {what}")


def design_with(loop: Loop, condition: str, limiter: bool | None = None, **options: Any) -> Design:
    """A spring-damper, with the limiter's block in the place of the linear one where that is asked for or usual.

    Raises DesignFailed at once for so many devices that the search would take minutes.
    """
    if condition == "any-environment":  # with rho = 0 it covers limited forces anyway
        _require_few(
            loop, _MOST_ANY, "any-environment: use a moving average, which needs no search, or this-environment"
        )
        return design(loop, condition, **options)
    if limiter:
        _require_few(loop, _MOST_LIMITED, "the limiter's block: leave the limiter out")
    if limiter is False or loop.channels > _MOST_LIMITED:
        return design(loop, condition, **options)
    refusal = limiter_refusal(loop)
    if limiter and refusal:
        raise ValueError(refusal)
    if refusal or options.get("switching"):
        return design(loop, condition, **options)
    try:
        return design(loop, condition, limiter=True, **options)
    except DesignFailed:
        if limiter:
            raise
        return design(loop, condition, **options)


def _for_any_environment(shaping: Shaping, start: SpringDamper | None) -> Design:
    started, loop = time.perf_counter(), shaping.loop
    phi = least_phi(loop)
    sigma = excess_limits(loop, phi)
    gains, sdps = _start(loop, sigma, start)
    norm, peak = shaping.norm(_coupling(loop, gains).compliance(loop.T))
    frequencies = [peak]
    for _ in range(_MOST_STEPS):
        gains, bound = step(shaping, sigma, gains, norm, np.array(frequencies))
        sdps += 1
        before, (norm, peak) = norm, shaping.norm(_coupling(loop, gains).compliance(loop.T))
        frequencies.append(peak)
        if abs(before - norm) < _SETTLED * norm and norm < (1 + _SETTLED) * bound:
            break
    coupling = _coupling(loop, gains)
    requirement = _verified(loop, coupling, phi)
    return Design(coupling, "any-environment", "loop-norm", norm, requirement, sdps, time.perf_counter() - started, phi)


def _for_this_environment(
    loop: Loop,
    starts: Sequence[SpringDamper],
    switching: tuple[Sequence[int], Sequence[int]] | None,
    limiter: bool,
    band_hz: tuple[float, float] | None,
) -> Design:
    started, starts = time.perf_counter(), starts or _default_starts(loop)
    band = band_hz or BAND_HZ
    if band_hz and switching:
        raise ValueError("band_hz: designs for delays that vary count 0.5 to 80 Hz, ask for one of them")
    search = partial(_least_rms, loop, band_hz=band)
    if switching:
        search = partial(_least_rms_switching, loop, *switching)
    coupling, rms, searches = search(starts)
    if limiter:  # a little softer than without limits: nearly always found from there
        search = partial(_least_rms, loop, optimum=partial(_limited_optimum, loop, band), band_hz=band)
        linear, before = coupling, searches
        coupling, rms, searches = search([linear] if linear else starts)
        if coupling is None and linear:
            coupling, rms, searches = search(starts)
        searches += before
    if coupling is None:
        certifies = "the this-environment condition certifies"
        if switching:
            certifies += f" under any switching from {tuple(switching[0])} to {tuple(switching[1])} samples"
        if limiter:
            certifies += " while forces are limited"
        line = (
            f"no spring-damper was found that {certifies} for theta = {loop.theta}, psi = {loop.psi}, "
            f"delta = {loop.delta}"
        )
        raise DesignFailed(None, (), line)
    coupling = SpringDamper(coupling.K, np.where(_NEGLIGIBLE * usable(loop) > coupling.B, 0.0, coupling.B))
    requirement = this_environment(loop.F(coupling), loop.delta, loop.T_max)
    return Design(coupling, "this-environment", "rms", rms, requirement, searches, time.perf_counter() - started)


def _default_starts(loop: Loop) -> list[SpringDamper]:
    """Around 2 d/(n T), the stiffness that no linear coupling exceeds for any passive environment.

    With delay in the environment a loop is stable if the coupling is the stiffer of the two at every frequency,
    which the last start takes from the environment's stiffness at half the sampling rate.
    """
    spend = usable(loop)
    K = spend / (loop.T * (np.asarray(loop.theta) + np.asarray(loop.psi) + 1))
    starts = [SpringDamper(factor * K, share * spend) for factor, share in ((0.3, 0.1), (1.0, 0.3), (8.0, 1.0))]
    if any(loop.psi):
        highest = np.linalg.norm(loop.E().at(-1.0), 2)
        starts.append(SpringDamper(K, np.full(loop.channels, loop.T * highest)))
    return starts


def stiffest(loop: Loop) -> Design:
    """The gains of largest total stiffness (each channel's own largest) that satisfy Theorem 4; objective in N/m."""
    started = time.perf_counter()
    phi = least_phi(loop)
    gains, sdps = _start(loop, excess_limits(loop, phi), None)
    coupling = _coupling(loop, gains)
    requirement = _verified(loop, coupling, phi)
    total = float(coupling.K.sum())
    return Design(
        coupling, "any-environment", "stiffness", total, requirement, sdps, time.perf_counter() - started, phi
    )


def moving_average(loop: Loop) -> Design:
    """The stiffest linear coupling that Theorem 4 admits; objective in N/m, of all channels together.

    V = T/(2 delta) (1 + ... + z^-theta) needs exactly delta at every frequency. With the constant e n^2 T/(2 delta)
    beside it, n = theta + 1, it needs delta/(1 + e) where the sum is largest, and less elsewhere.
    """
    started = time.perf_counter()
    phi = least_phi(loop)
    weight, terms = loop.T / (2 * even_damping(loop.delta, loop.T, loop.T_max)), np.array(loop.theta) + 1
    coupling = MovingAverage(weight, terms.tolist(), RESERVE / (1 - RESERVE) * terms**2 * weight)
    requirement = _verified(loop, coupling, phi)
    total = float(coupling.stiffness.sum())
    return Design(coupling, "any-environment", "stiffness", total, requirement, 0, time.perf_counter() - started, phi)


def _verified(loop: Loop, coupling: SpringDamper | MovingAverage, phi: Array | None) -> Requirement:
    """Theorem 4's requirement from the coupling alone; raises DesignFailed unless it is certified."""
    requirement = any_environment_with(loop, coupling.compliance(loop.T), phi)
    if not requirement.certified:
        why = requirement.reason or f"it requires {max(requirement.required):.6g} N s/m"
        raise DesignFailed(None, (), f"the designed coupling is not certified by any_environment: {why}")
    return requirement


def any_environment_with(loop: Loop, V: Lti, phi: Array | None) -> Requirement:
    """Theorem 4's requirement of V with the multiplier phi (m,) [N s/m], None without delay in the environment."""
    if phi is None:
        return any_environment(V, loop.theta, loop.delta, loop.T_max)
    return any_environment_delayed(V, loop.E(), loop.theta, loop.psi, loop.delta, phi, loop.T_max)


def excess_limits(loop: Loop, phi: Array | None) -> Array:
    """(N,) Sigma = Delta_V^-1 = Phi^-1 - Delta_D^-1 in units of the usable damping; inf without a multiplier."""
    if phi is None:
        return np.full(loop.channels, np.inf)
    with np.errstate(divide="ignore"):
        return usable(loop) / phi - 1


def _coupling(loop: Loop, gains: Array) -> SpringDamper:
    (k, b), spend = np.split(np.maximum(gains, 0.0), 2), usable(loop)
    return SpringDamper(k * spend / loop.T, np.where(b < _NEGLIGIBLE, 0.0, b) * spend)


def _start(loop: Loop, sigma: Array, start: SpringDamper | None) -> tuple[Array, int]:
    """The gains of the set nearest to `start`, or the stiffest of the set; and the number of SDPs, one."""
    import cvxpy as cp

    N = loop.channels
    gains = cp.Variable(2 * N)
    objective = cp.Maximize(cp.sum(gains[:N]))
    if start is not None:
        wanted = np.concatenate([start.K * loop.T, start.B]) / np.tile(usable(loop), 2)
        objective = cp.Minimize(cp.norm(gains - wanted))
    try:
        solve_within(objective, gains, loop.theta, sigma, "the set of gains")
    except Infeasible as error:
        line = f"Theorem 4 admits no spring-damper with theta = {loop.theta}, psi = {loop.psi}, delta = {loop.delta}"
        raise Infeasible(error.problem, error.results, line) from error
    return solved(gains), 1
