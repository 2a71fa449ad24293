"""Conditions with a multiplier that is searched: walls that make and break contact, delays that switch, limited forces.

Each states its block once, and what it asks at the best multiplier is found by cutting planes: a sweep judges.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from controller.arithmetic import Number, SingularLoop, TooLong, numbers
from controller.coupling import Coupling
from controller.delay import delay
from controller.loop import DelayRange, Loop
from controller.lti import Array, Block, Complex, Lti, as_like, constant_like, hstack, taps, vstack
from design import conditions, cone
from design.frequency import frequencies, hermitian, on_circle, peaks, supremum, sweeping
from design.result import DesignFailed, Requirement, from_ratio, refusal

#: c_ij >= 0 of the limiter's multiplier: for every channel i a weight per lag j = 1, 2, ..; none is zero
Lags = Sequence[Sequence[Any]]


def switching_block(G: Block, loop: Loop, alpha: Any) -> tuple[Block, Array]:
    """[[this-environment - diag(alpha)/2, 0], [2 h G, 2 diag(alpha)]], which must be positive real; and F(1).

    F = Theta_nom G with Theta_nom = (z^-lo + z^-hi)/2 and 2 h = hi - lo; G are the forces as they leave,
    alpha (m,) [N/m] is a multiplier, positive where the delay varies. Channels whose delay does not vary have no row
    and column of the second kind.

    A force that is late by n in [lo, hi] differs from the nominal one by at most h times the sum of the steps in
    between; the multiplier weighs that error against the displacement (an S-procedure, channel by channel).
    """
    T, lo, hi = G.T, loop.delays.lo, loop.delays.hi
    widths = [b - a for a, b in zip(lo, hi, strict=True)]
    varying = [i for i, width in enumerate(widths) if width]
    a = numbers(alpha, T)
    half = Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))
    spread = Lti.constant(
        np.array([[widths[i] * (i == j) for j in range(len(lo))] for i in varying]).reshape(-1, len(lo)), T
    )
    both: Any = as_like(G, vstack(half, spread)) @ G
    m = len(lo)
    linear = conditions.this_environment_demand(both.rows(slice(None, m)), loop)
    F1 = linear.static["F(1)"]
    upper = linear.free + np.diag(conditions.even_damping(loop, T) / T - a / 2)
    if not varying:
        return upper, F1
    lower = np.zeros((m + len(varying), len(varying)), dtype=object)
    lower[m:] = np.diag(2 * a[varying])
    return hstack(vstack(upper, both.rows(slice(m, None))), constant_like(G, numbers(lower, T))), F1


def _halves(lo: int, hi: int) -> list[Number]:
    return [Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)]


def limiter_demand(G: Block, loop: Loop, rho: Sequence[Any], c: Lags) -> conditions.Demand[Block]:
    """The limiter's block on (dx - de, de), the steps of what the environment follows and of the slip.

    G are the forces as they leave without the limiter, rho (m,) [N/m] its lag, fixed numbers that the damping does
    not scale, and c the multiplier. With df_e = G (dx - de) - rho (1 - 1/z) de, the steps of the limited forces, the
    block is [Theta/(z-1); N] df_e + s Delta_D/T [1, 0; 2, 1], where
    N_i = -(1 + .. + z^-theta_i) - sum_j c_ij (j + (j-1)/z + .. + z^-(j-1)).
    """
    theta, m, T = loop.theta, loop.channels, G.T
    damping = np.diag(conditions.even_damping(loop, T) / T)
    lines = Lti.diag(*(_delay_and_weights(n, row, T) for n, row in zip(theta, c, strict=True)))
    lines = lines.rows([*range(0, 2 * m, 2), *range(1, 2 * m, 2)])
    difference = Lti.diag(*(taps([1, -1], T) for _ in theta))
    steps: Any = hstack(G, as_like(G, difference @ np.diag(-numbers(rho, T))))
    both = as_like(G, lines) @ steps
    static, ramp = both.rows(slice(None, m)).split_at_one()  # [F(1), 0]: the slip's steps have no mean
    zero = np.zeros((m, m), dtype=int)
    free = vstack(ramp - static / 2, both.rows(slice(m, None)))
    gain = np.block([[damping, zero], [2 * damping, damping]])
    return conditions.Demand(free, constant_like(G, gain), {"F(1)": static[..., :m]}, ("F(1)",))


def _delay_and_weights(theta: int, c: Sequence[Any], T: Number) -> Lti:
    """[z^-theta; N] of one channel, over one line of delays."""
    lags = range(1, len(c) + 1)
    size = max(theta + 1, len(c))
    late = [int(k == theta) for k in range(size)]
    weights = [-sum([numbers(c[j - 1], T) * (j - k) for j in lags if j > k], int(k <= theta)) for k in range(size)]
    first, second = taps(late, T), taps(weights, T)
    return Lti(first.A, first.B, np.vstack([first.C, second.C]), np.vstack([first.D, second.D]), T)


# delays that switch within [lo, hi]: the best multiplier
#
# With a = alpha T/delta the least factor s on delta is the supremum over frequency of an eigenvalue that is convex in
# a: at every frequency and direction u it is at least u*(..)u, a sum n + p.a + q.(1/a), and that bounds s from below
# for all a. The worst of these bounds are collected until their least a attains them. No convex solver is needed.

_SETTLED = 1e-7  # relative gap between the sweep of a multiplier and the bound that no multiplier beats


_MOST_ROUNDS = 60


_FIRST = 0.1  # the a that a search begins with


_SMALLEST, LARGEST = 1e-8, 1e6  # .. and what it may become


_NEAR, _MOST_PEAKS = 0.3, 8  # of the peaks within 30 % of the highest, so many give a bound


@dataclass(frozen=True)
class SwitchingSweep:
    """What switching within a range asks of the devices."""

    requirement: Requirement  # condition "switching"
    alpha: tuple[float, ...]  # (m,) [N/m] the multiplier that shows it, at the available damping; 0 where lo = hi
    bound: float  # no multiplier shows less than this times the available damping (on the frequencies looked at)


def switching_sweep(G: Lti, loop: Loop, alpha: Sequence[float] | None = None) -> SwitchingSweep:
    """The least common factor on `delta` [N s/m] with which some multiplier satisfies the condition, and which does.

    G is the force map without Theta. The factor is that of the refined sweep (design.frequency.sweep) at the multiplier
    found, or at `alpha` (m,) [N/m] where it is given, positive where lo < hi; `bound` is then that factor.
    """
    available, span = conditions.dampings(loop.delta, G.inputs), loop.delays
    h = half_widths(span.lo, span.hi)
    constant = conditions.this_environment(_nominal(span, G.T) @ G, loop)
    if not np.isfinite(constant.ratio):
        return _refused(available, constant.reason or "no constant delay is safe")
    search, unit = _Search(G, loop), conditions.even_damping(loop) / G.T
    given = None if alpha is None else (np.asarray(alpha) / unit)[search.active]
    a, ratio, w, bound = search.least() if given is None else search.only(given)
    multiplier = np.zeros(h.size)
    multiplier[search.active] = a
    requirement = from_ratio("switching", max(ratio, 0.0), available, w / (2 * np.pi * G.T))
    return SwitchingSweep(requirement, tuple((multiplier * unit).tolist()), bound)


def _refused(available: tuple[float, ...], reason: str) -> SwitchingSweep:
    """The requirement that no damping satisfies, with its reason."""
    return SwitchingSweep(refusal("switching", available, reason), (np.inf,) * len(available), np.inf)


_Found = tuple[Array, float, float, float]  # a, s(a), where it binds [rad/sample], a lower bound on s over all a


class _Search:
    """s(a) = sup over w of the largest eigenvalue of N + diag(a)/2 + Y* diag(1/2a) Y, over the channels that vary.

    A Schur complement of `switching_block`, scaled by W = diag(sqrt(T/delta)): N = -W He[free] W with
    this-environment's block of F = Theta_nom G, Y = h W G W.
    """

    def __init__(self, G: Lti, loop: Loop) -> None:
        span = loop.delays
        self._G, self._demand = G, conditions.this_environment_demand(_nominal(span, G.T) @ G, loop)
        self._weight, self._h = np.sqrt(G.T / conditions.even_damping(loop)), half_widths(span.lo, span.hi)
        self.active = np.flatnonzero(self._h)
        self._grid = np.concatenate([[0.0], frequencies(G)])
        none = np.zeros((0, self.active.size))
        self._n, self._p, self._q = np.zeros(0), none, none  # the bounds collected

    def only(self, a: Array) -> _Found:
        """s for this a alone."""
        ratio, w = self._swept(a)
        return a, ratio, w, ratio

    def least(self) -> _Found:
        """The least s over all a."""
        a, bound = np.full(self.active.size, _FIRST), -np.inf
        if not a.size:
            return self.only(a)
        N, Y = self._parts(self._grid)
        best: tuple[Array, float, float] = (a, np.inf, 0.0)
        for _ in range(_MOST_ROUNDS):
            if self._cut(a, N, Y) <= bound + _SETTLED * abs(bound):  # settled on the samples: look between them
                ratio, w = self._swept(a)
                best = min(best, (a, ratio, w), key=lambda found: found[1])
                if best[1] <= bound + 10 * _SETTLED * abs(bound):
                    return *best, bound
                between = self._parts(np.array([w]))
                N, Y = np.concatenate([N, between[0]]), np.concatenate([Y, between[1]])
                self._cut(a, *between)
            a, bound = self._bound(a)
        return *min(best, (a, *self._swept(a)), key=lambda found: found[1]), bound

    def _swept(self, a: Array) -> tuple[float, float]:
        """(s(a), w) by a sweep that is refined between its samples."""
        return supremum(lambda w: self._largest(a, *self._parts(w)), self._grid)

    def _parts(self, w: Array) -> tuple[Complex, Complex]:
        """N (k, m, m) and the rows of Y with h > 0, at the frequencies w (k,) [rad/sample]."""
        z, W = on_circle(w), self._weight
        N = -W[:, None] * hermitian(self._demand.free.at(z)) * W
        Y = (self._h * W)[:, None] * self._G.at(z) * W
        return N, Y[:, self.active]

    def _matrices(self, a: Array, N: Complex, Y: Complex) -> Complex:
        """N + diag(a)/2 + Y* diag(1/2a) Y, (k, m, m)."""
        diagonal = np.zeros(self._h.size)
        diagonal[self.active] = a / 2
        return N + np.diag(diagonal) + np.conj(np.swapaxes(Y, 1, 2)) @ (Y / (2 * a[:, None]))

    def _largest(self, a: Array, N: Complex, Y: Complex) -> Array:
        return np.linalg.eigvalsh(self._matrices(a, N, Y))[:, -1].astype(float)

    def _cut(self, a: Array, N: Complex, Y: Complex) -> float:
        """Collect the bounds at the local peaks near the worst sampled frequency; the worst value."""
        values = self._largest(a, N, Y)
        top, padded = float(values.max()), np.concatenate([[-np.inf], values, [-np.inf]])
        local = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= top - _NEAR * abs(top)))
        local = local[np.argsort(values[local])[-_MOST_PEAKS:]]
        u = np.linalg.eigh(self._matrices(a, N[local], Y[local]))[1][:, :, -1]
        self._n = np.append(self._n, np.einsum("ki,kij,kj->k", u.conj(), N[local], u).real)
        self._p = np.concatenate([self._p, np.abs(u[:, self.active]) ** 2 / 2])
        self._q = np.concatenate([self._q, np.abs(np.einsum("kij,kj->ki", Y[local], u)) ** 2 / 2])
        return top

    def _bound(self, a: Array) -> tuple[Array, float]:
        """(a, value): the least maximum over a of the bounds n + p.a + q.(1/a), convex in log a."""
        from scipy.optimize import minimize  # slow to load, and seldom needed

        def below(x: Array) -> Array:
            return x[0] - self._n - self._p @ np.exp(x[1:]) - self._q @ np.exp(-x[1:])

        def slope(x: Array) -> Array:
            return np.column_stack([np.ones(self._n.size), -self._p * np.exp(x[1:]) + self._q * np.exp(-x[1:])])

        start = np.concatenate([[0.0], np.log(a)])
        start[0] = -below(start).min()
        limits = [(None, None)] + [(np.log(_SMALLEST), np.log(LARGEST))] * a.size
        gradient = np.eye(1 + a.size)[0]
        found = minimize(
            lambda x: x[0],
            start,
            jac=lambda x: gradient,
            bounds=limits,
            method="SLSQP",
            constraints={"type": "ineq", "fun": below, "jac": slope},
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.exp(found.x[1:]), float(found.x[0])


# the limiter: the best multiplier
#
# The block is affine in (s, c), so the least s over all c at some frequencies is a matrix inequality (design.cone). It
# bounds s(c) from below; where the sweep of the c found needs more, these frequencies join, until it attains the bound.

BETA = 0.01  # of a limiter's lag under this-environment unless another is asked for


_LARGEST_WEIGHT = 10.0  # that a search gives a c_ij


SPARE = 0.02  # of rho: what the block keeps, however large the damping, so that c may be rounded and the proof exact


_LIMITER_SETTLED = 1e-5  # gap between the sweep at the best c and the bound that no c beats
_FIRST_FREQUENCIES = 12  # that the bound begins with


@dataclass(frozen=True)
class _LimiterProof:
    """What the limiter asks of the devices."""

    requirement: Requirement  # condition "limiter"
    rho: tuple[float, ...]  # (m,) [N/m] the lag of the limiter that is asked about
    c: tuple[tuple[float, ...], ...]  # (m, lags) the multiplier that shows it
    bound: float  # what the search proved of all c that keep SPARE of rho; the ratio itself where c was given


def limiter_lag(delta: Sequence[float], T: float, beta: float) -> tuple[float, ...]:
    """rho = beta delta/T [N/m] of a limiter under this-environment, to six digits."""
    return tuple(float(f"{beta * d / T:.6g}") for d in delta)


def limiter(G: Lti, loop: Loop, rho: Sequence[float], c: Lags | None = None, lags: int = 1) -> _LimiterProof:
    """The least common factor on `delta` [N s/m] with which the limiter's block is positive real, at the best c.

    G is the force map without Theta, rho (m,) [N/m] the limiter's lag. With `c` given its figure is that of the
    refined sweep at this multiplier; otherwise the best with so many lags per channel is searched.
    """
    available, m = conditions.dampings(loop.delta, G.inputs), G.inputs
    if len(rho) != m or (c is not None and len(c) != m):
        raise ValueError(f"rho and c need one entry for each of {m} channels")
    if not all(0 <= r < np.inf for r in rho) or any(not 0 <= v < np.inf for row in c or () for v in row):
        raise ValueError(f"rho is {list(rho)} and c is {c}, expected numbers >= 0")
    none = tuple((0.0,) * lags for _ in rho) if c is None else tuple(tuple(float(v) for v in row) for row in c)
    # the slip at rest: its rows are among the block's
    linear = conditions.this_environment(delay(loop.theta, G.T) @ G, loop)
    if not np.isfinite(linear.ratio):
        reason = linear.reason or "the loop without limiter is not covered"
        return _LimiterProof(refusal("limiter", available, reason), tuple(rho), none, np.inf)
    search = _LimiterSearch(G, loop, rho, lags)
    if c is not None:
        ratio, w = search.swept(none)
        return _LimiterProof(search.requirement(ratio, w), tuple(rho), none, ratio)
    best, ratio, w, bound = search.least()
    return _LimiterProof(search.requirement(ratio, w), tuple(rho), best, bound)


class _LimiterSearch:
    """s(c) by the refined sweep, and its least over c >= 0."""

    def __init__(self, G: Lti, loop: Loop, rho: Sequence[float], lags: int) -> None:
        self._G, self._loop, self._rho, self._shape = G, loop, rho, (loop.channels, lags)
        self._grid, self._lag = np.concatenate([[0.0], frequencies(G)]), np.diag([*rho, *rho])

    def requirement(self, ratio: float, w: float) -> Requirement:
        T, delta = self._loop.T, self._loop.delta
        if np.isinf(ratio):
            reason = "no limiter is proved for this coupling"
            return refusal("limiter", delta, reason)
        return from_ratio("limiter", max(ratio, 0.0), delta, w / (2 * np.pi * T))

    def demand(self, c: Lags) -> conditions.Demand[Lti]:
        return limiter_demand(self._G, self._loop, self._rho, c)

    def swept(self, c: Lags, spare: float = 0.0) -> tuple[float, float]:
        """(s(c), w [rad/sample]) by a sweep that is refined between its samples, with a reserve of rho."""
        return supremum(self._needed(c, spare), self._grid)

    def _needed(self, c: Lags, spare: float) -> Callable[[Array], Array]:
        """The s that each frequency asks for, with a reserve of rho."""
        demand = self.demand(c)
        demand = replace(demand, free=demand.free - spare * self._lag)
        return lambda w: conditions.least_scale(demand, w)

    def least(self) -> tuple[tuple[tuple[float, ...], ...], float, float, float]:
        """(c, s(c), where it binds, a lower bound on s over all c that have something to spare)."""
        unknowns = range(int(np.prod(self._shape)) + 1)  # c and s
        limits = cone.Inequality.least(unknowns, 0.0), cone.Inequality.most(unknowns[:-1], _LARGEST_WEIGHT)
        first = self._grid[np.linspace(0, self._grid.size - 1, _FIRST_FREQUENCIES).astype(int)]
        c, bound, blocks = np.zeros(len(unknowns) - 1), np.inf, [*limits, self._block(first, unknowns)]
        for _ in range(_MOST_ROUNDS):
            try:
                x = cone.ConeProgram(np.eye(len(unknowns))[-1], blocks).solve("the multiplier of the limiter")
            except DesignFailed:  # no c within the bounds makes the block positive, however large the damping
                return self._rows(c), np.inf, self.swept(self._rows(c), SPARE)[1], np.inf
            c, bound = np.maximum(x[:-1], 0.0), float(x[-1])
            needed = self._needed(self._rows(c), SPARE)
            missed = peaks(needed, self._grid, bound + _LIMITER_SETTLED * max(bound, 1.0))
            if not missed.size:
                break
            blocks.append(self._block(missed[np.argsort(-needed(missed))[:_MOST_PEAKS]], unknowns))
        c = np.round(c, 6)
        return self._rows(c), *self.swept(self._rows(c)), bound

    def _rows(self, c: Array) -> tuple[tuple[float, ...], ...]:
        """c (m lags,) as a row per channel."""
        return tuple(tuple(row) for row in c.reshape(self._shape).tolist())

    def _block(self, w: Array, unknowns: Sequence[int]) -> cone.Inequality:
        """free(c) + s gain at w (k,) with something to spare, in units of Delta_D/T."""
        z, root = on_circle(w), np.tile(np.sqrt(self._loop.T / np.array(self._loop.delta)), 2)
        none = self.demand(self._rows(np.zeros(len(unknowns) - 1)))
        free, gain = hermitian(none.free.at(z)), hermitian(none.gain.at(z))
        slopes = [hermitian(self.demand(self._rows(unit)).free.at(z)) - free for unit in np.eye(len(unknowns) - 1)]
        constant, by = (root[:, None] * part * root for part in (free - SPARE * self._lag, np.array([*slopes, gain])))
        return cone.Inequality(constant, by, unknowns)


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def _nominal(span: DelayRange, T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    return Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(span.lo, span.hi, strict=True)))


def swept(loop: Loop, coupling: Coupling, alpha: Sequence[float] | None = None) -> SwitchingSweep:
    """What switching within the loop's range asks, by a sweep; with the multiplier `alpha` [N/m] where it is given."""
    try:
        with sweeping():
            return switching_sweep(loop.sent(coupling), loop, alpha)
    except (SingularLoop, TooLong) as error:
        return _refused(loop.delta, str(error))


# ----------------------------------------------------------------------------------------------------
# An exact proof that a coupling is safe in this environment also while its forces are limited: made, stored, proved
# again. F(1) is exactly symmetric and positive semidefinite, and design.multipliers.limiter_demand is strictly
# positive real. any-environment without delay in the environment needs no proof of its own: with rho = 0 the limiter
# and the environment together are a passive environment.


def limiter_refusal(loop: Loop) -> str | None:
    """Why the limiter's own condition does not apply to a loop, or None."""
    if loop.varying_delay:
        return "limiter: forces that are limited are proved for constant delays, not for delays that switch"
    if loop.environment.walls:
        return "limiter: with walls only any-environment covers limited forces (no delay in the environment)"
    if loop.ranges:
        return "limiter: limited forces are proved for one environment, not for ranges"
    if loop.latency:
        return "limiter: limited forces are proved for forces that latch at ticks, not for a latency"
    return None


_MOST_SEARCHED = 12  # devices


def limiter_requirement(loop: Loop, coupling: Coupling, beta: float = BETA, c: Lags | None = None) -> _LimiterProof:
    """What this-environment asks with the limiter of rho = beta delta/T, at the multiplier `c` or the best one.

    For many devices it takes long to find (22 s for 32): there it is that at c = 0, unless a design brings its own.
    `proof` of the requirement is "sampled"; `prove` gives the exact one.
    """
    rho = limiter_lag(loop.delta, loop.T, beta)
    reason = limiter_refusal(loop)
    if loop.channels > _MOST_SEARCHED and c is None:
        c = ((0.0,),) * loop.channels
    try:
        if reason is None:
            with sweeping():
                return limiter(loop.sent(coupling), loop, rho, c)
    except (SingularLoop, TooLong) as error:
        reason = str(error)
    return _LimiterProof(refusal("limiter", loop.delta, reason), rho, ((),) * loop.channels, math.inf)
