"""Conditions for devices with a known motor mass and a known lossy transmission (Theorem B).

this-environment assumes that a hand of any stiffness holds the motor's shaft. The devices here have a transmission
between motor and hand: a spring k and a damper b in parallel. So no hand feels stiffer to the motor than the
transmission does, and the motor's mass keeps its speed continuous. The known bounds are the motor's least mass m and
least damping delta, P = k_max^2/b_min, and b_max. Let beta > 0 [s] be any number, and let the force f be held in each
period. Then the motor, its transmission and every passive hand behind the transmission satisfy

    sum f'(dx + beta dv) + sum L(dx, v, v+) <= const,     L = least integral of c0 v^2 + c2 a^2 over the period,

with c0 = delta - beta^2 P/4 and c2 = beta m - beta^2 b_max/4. Here dx is the motor's displacement in a period, v and v+
are its speeds at the beginning and the end, dv = v+ - v, and a is its acceleration. L is the least integral over all
motions with these dx, v and v+. docs/theory.md has the proof. The blocks below are positive if the environment's side
returns less energy than L.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import Number, eye, inverse, numbers, rational, times
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import DeviceBounds, Loop, Rows
from haptic_loop.controller.lti import Array, Complex, Lti, Sampled
from haptic_loop.controller.ranges import Member
from haptic_loop.design import budgets
from haptic_loop.design.conditions import BEYOND, Condition, Demand, unsound
from haptic_loop.design.cone import INTERIOR, SETTINGS, ConeProgram, Inequality
from haptic_loop.design.environments import (
    ANY_ENVIRONMENT,
    LIMITER,
    THIS_ENVIRONMENT,
    LimitedForces,
    Multiplied,
    named_parts,
)
from haptic_loop.design.facts import Fact, KnownMotor, Limited, PeriodCost, Unknowns, Values, compose, compose_any
from haptic_loop.design.frequency import Response, frequencies, hermitian, largest_eigenvalue, on_circle, supremum
from haptic_loop.design.result import (
    ANY,
    HERE,
    MAKING,
    DesignFailed,
    Environments,
    NotProved,
    Requirement,
    from_ratio,
    refusal,
    suffices,
)


def shortest_period(loop: Loop) -> float | None:
    """Return the shortest period [s] of the loop. It is None if periods vary up to T_max and no T_min is declared."""
    return loop.T if loop.T_min is None and loop.T_max is None else loop.T_min


class _Known(NamedTuple):
    """The bounds of the devices, (m,) each, all as floats or all as Fractions."""

    P: Any  # [N/(m s)] largest k^2/b of the transmission
    damping: Any  # [N s/m] largest damping of the transmission
    mass: Any  # [kg] least mass of the motor


def _known(loop: Loop, T: Number) -> _Known:
    return _in_arithmetic(loop.known_devices or (), T)


@lru_cache(maxsize=64, typed=True)  # typed, because the type of T decides the arithmetic
def _in_arithmetic(devices: tuple[DeviceBounds, ...], T: Number) -> _Known:
    stiffness, least = (
        numbers([getattr(device, f"transmission_{name}") for device in devices], T)
        for name in ("stiffness_max", "damping_min")
    )
    damping = numbers([device.transmission_damping_max for device in devices], T)
    return _Known(stiffness**2 / least, damping, numbers([device.motor_mass_min for device in devices], T))


def _rates(known: _Known, delta: Any, beta: Any) -> tuple[Any, Any]:
    """Return c0 [N s/m] and c2 [N s^3/m], (..., m) each."""
    return delta - beta**2 * known.P / 4, beta * known.mass - beta**2 * known.damping / 4


def largest_beta(loop: Loop, share: float = 1.0) -> Array:
    """Return the least beta (m,) [s] at which c0 or c2 is 0. The damping of the devices is `share` times Delta."""
    known = _known(loop, loop.T)
    return np.minimum(2 * np.sqrt(share * np.array(loop.delta) / known.P), 4 * known.mass / known.damping)


def _shortfall(y: Array) -> Array:
    """Return 1 - tanh(y)/y, (m,), in full relative precision even for small y."""
    small = np.minimum(y, _SERIES) ** 2
    series = small * (1 / 3 - small * (2 / 15 - small * (17 / 315 - small * 62 / 2835)))
    return np.where(y < _SERIES, series, 1 - np.tanh(y) / np.maximum(y, _SERIES))


_SERIES = 0.03  # At this y the truncated series has a relative error of 2e-14, and the other formula one of 4e-13.


def period_cost(loop: Loop, share: Any, beta: Array) -> PeriodCost:
    """Return a lower bound of the cost L of a period for devices with the damping `share` Delta, (..., m), as floats.

    For periods in [T1, T2], L is at least c0 (dx, vb) [[T2, 1], [1, 1/q(T1)]]^-1 (dx, vb)' + c2 dv^2/q(T2), with the
    mean speed vb = (v + v+)/2 and q as in `_q_bounds`. Entries are nan or negative for too large a beta.
    """
    longest, shortest = loop.T_max or loop.T, shortest_period(loop) or loop.T
    c0, c2 = _rates(_known(loop, loop.T), np.asarray(share)[..., None] * np.array(loop.delta), beta)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.sqrt(c0 / c2)
        short, long = (_shortfall(rate * T / 2) for T in (shortest, longest))
        q, q_long = shortest * (1 - short), longest * (1 - long)
        move = c0 / (longest - shortest + shortest * short)
        return PeriodCost(move, move * q, move * q * longest, c2 / q_long)


# ----------------------------------------------------------------------------------------------------
# Matrix levels. The bounds of mass and transmission are scalars, so that a rotation of a device's coordinates does not
# change them. Theorem B holds in coordinates with a diagonal Delta, with one beta for all axes of a device.

_SKEW_BITS = 32  # fractional bits of the skew matrix S; off the diagonal Q' Delta Q is about 1e-9 of the damping
_JACOBI_SWEEPS = 12  # Sweeps converge quadratically: 6 axes need about five.
_BELOW = 1e-11  # d is smaller than its exact bound by this share, which covers rounding


def _straightened(loop: Loop) -> Loop:
    """Return the loop with the diagonal levels d of `_principal_axes`; the loop itself if it has no matrix levels."""
    if loop.levels is None:
        return loop
    parts = [_principal_axes(level) for level in loop.levels]
    return msgspec.structs.replace(loop, delta=tuple(v for _, d in parts for v in d), levels=None)


def _turned(G: Lti, loop: Loop) -> Lti:
    """Return the map G in the coordinates of `_straightened`. Inputs and outputs of walls do not change."""
    if loop.levels is None:
        return G
    Q = np.eye(G.inputs, dtype=int).astype(object)
    for own, level in zip(loop.devices, loop.levels, strict=True):
        Q[own, own] = _principal_axes(level)[0]
    Q = numbers(Q, G.T)
    return Q.T @ G @ Q


@lru_cache(maxsize=64)
def _principal_axes(level: Rows) -> tuple[Any, tuple[float, ...]]:
    """Return a rational orthogonal Q (n, n) and decimals d (n,) with Delta >= Q diag(d) Q' over the rationals.

    Q is the Cayley transform of a rational skew matrix S and therefore exactly orthogonal. The eigenvectors come from
    Jacobi's rotations, whose sums, products and roots are rounded alike on every machine. So every machine can check a
    proof. d is the diagonal of Q' Delta Q minus the Gershgorin radii. Raises NotProved if an entry of d is not
    positive.
    """
    n = len(level)
    A, V = np.array(level, dtype=float), np.eye(n)
    for p, q in [*itertools.combinations(range(n), 2)] * _JACOBI_SWEEPS:
        if abs(A[p, q]) > 1e-40 * abs(A).max():  # otherwise tau could overflow
            tau = (A[q, q] - A[p, p]) / (2 * A[p, q])
            t = np.copysign(1.0, tau) / (abs(tau) + np.sqrt(1 + tau * tau))
            c = 1 / np.sqrt(1 + t * t)
            for M in (A, V, A.T):
                M[:, p], M[:, q] = c * (M[:, p] - t * M[:, q]), c * (t * M[:, p] + M[:, q])
    one: Any = eye(n, Fraction(1))
    axes: Any = numbers(V, Fraction(1))
    S = times(one - axes, inverse(one + axes))
    S = np.frompyfunc(lambda v: Fraction(round(v * 2**_SKEW_BITS), 2**_SKEW_BITS), 1, 1)((S - S.T) / 2)
    Q = times(one - S, inverse(one + S))
    D = times(times(Q.T, numbers(level, Fraction(1))), Q)
    radii = np.abs(D - np.diag(np.diag(D))).sum(axis=1)
    d = tuple((1 - _BELOW) * float(v) for v in np.diag(D) - radii)
    if not all(0 < rational(v) < w for v, w in zip(d, np.diag(D) - radii, strict=True)):
        raise NotProved(f"levels: the principal axes of {[list(row) for row in level]} N s/m could not be enclosed")
    return Q, d


_BITS = 320  # precision of the balls (intervals) that enclose q
_MOST_ULPS = 8  # largest distance between q and its bounds, in units in the last place; one is usually enough


def _q_bounds(loop: Loop, beta: Sequence[Fraction]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return decimals [s] below q(shortest period) and decimals above q(longest period), (m,) each.

    q(T) = T tanh(y)/y with y^2 = c0 T^2/(4 c2), for the loop's damping. Raises NotProved if beta is not allowed.
    """
    import flint

    below, above = [], []
    with flint.ctx.workprec(_BITS):
        for short, long in _enclosed(loop, beta):
            below.append(_beside(short, -np.inf, lambda value, ball: value < ball))
            above.append(_beside(long, np.inf, lambda value, ball: value > ball))
    return tuple(below), tuple(above)


def _beside(ball: Any, towards: float, beyond: Callable[[Any, Any], bool]) -> float:
    """Return the double nearest to the ball's midpoint in the direction `towards` that is `beyond` the ball."""
    import flint

    value = float(ball.mid())
    for _ in range(_MOST_ULPS):
        if beyond(flint.arb(_fmpq(rational(value))), ball):
            return value
        value = float(np.nextafter(value, towards))
    raise NotProved("q of the known device could not be enclosed")


def _check_q(loop: Loop, beta: Sequence[Fraction], below: Sequence[Fraction], above: Sequence[Fraction]) -> None:
    """Raise NotProved unless interval arithmetic shows below < q(shortest period) and q(longest period) < above."""
    import flint

    m = loop.channels
    if not len(beta) == len(below) == len(above) == m:
        raise NotProved(f"q has {len(below)} and {len(above)} bounds, expected {m} each")
    with flint.ctx.workprec(_BITS):
        for i, (short, long) in enumerate(_enclosed(loop, beta)):
            least, most = (flint.arb(_fmpq(value[i])) for value in (below, above))
            if not (below[i] > 0 and least < short and long < most):
                between = f"{float(below[i])!r} to {float(above[i])!r}"
                raise NotProved(f"q of channel {i + 1} is not proved to lie within the file's bounds, {between} s")


def _enclosed(loop: Loop, beta: Sequence[Fraction]) -> list[tuple[Any, Any]]:
    """Return (q(shortest period), q(longest period)) as balls for each channel. Raises NotProved for a wrong beta."""
    import flint

    exact = loop.period(True)
    short, long = (rational(T) for T in (shortest_period(loop) or exact, loop.T_max or exact))

    def q(T: Fraction, ratio: Fraction) -> Any:
        y = flint.arb(_fmpq(ratio * T * T / 4)).sqrt()
        return flint.arb(_fmpq(T)) * y.tanh() / y

    c0, c2 = _checked_rates(loop, beta)
    return [(q(short, spread / inertia), q(long, spread / inertia)) for spread, inertia in zip(c0, c2, strict=True)]


def _checked_rates(loop: Loop, beta: Sequence[Fraction]) -> tuple[Any, Any]:
    """Return c0 and c2 over Fractions. Raises NotProved unless they and beta are positive, with one beta per device."""
    exact = loop.period(True)
    c0, c2 = _rates(_known(loop, exact), numbers(loop.delta, exact), _row(beta))
    if any(len(set(beta[own])) > 1 for own in loop.devices):
        raise NotProved(f"beta is {[float(b) for b in beta]}, expected one value for all axes of a device")
    if not ((c0 > 0).all() and (c2 > 0).all() and all(b > 0 for b in beta)):
        raise NotProved(f"beta is {[float(b) for b in beta]}, not positive or too large for the devices' bounds")
    return c0, c2


def _row(values: Sequence[Fraction]) -> Any:
    return np.array(list(values), dtype=object)


def _fmpq(value: Fraction) -> Any:
    import flint

    return flint.fmpq(value.numerator, value.denominator)


def _exact_cost(
    loop: Loop, beta: Sequence[Fraction], below: Sequence[Fraction], above: Sequence[Fraction]
) -> PeriodCost:
    """Return a rational lower bound of the cost at the loop's damping, from bounds of q that `_check_q` accepts."""
    exact = loop.period(True)
    c0, c2 = _checked_rates(loop, beta)
    longest = rational(loop.T_max) if loop.T_max else exact
    q = _row(below)
    move = c0 / (longest - q)
    return PeriodCost(move, move * q, move * q * longest, c2 / _row(above))


# ----------------------------------------------------------------------------------------------------
# The required damping is s Delta. Here s is the least share of the damping for which some beta and multipliers make the
# block positive. The bounds of mass and transmission do not scale with s. L is concave in (s, beta). The other entries
# are affine in beta and in the multipliers, except for switching delays. The entries of switching delays are concave in
# beta and 1/alpha after the rows of their inputs w (facts.Switching) are divided by alpha. A tangent of a concave block
# bounds the block from above. The tangents at the binding frequencies form a linear matrix inequality. The least s that
# satisfies it is a lower bound of the required s.

_LARGEST_ETA = 0.9999  # largest tried ratio of beta to `largest_beta`, at which c0 or c2 is 0
_LEAST_ETA = 1e-5  # least tried ratio; its requirement is about 0.1 % below the limit of the requirement for beta -> 0
_BISECTIONS = 40  # bisections of an interval of shares, down to 1e-12 of its length
_TOGETHER = 100  # A stack of this many matrices takes hardly longer than one matrix. So a step tries up to 31 shares.
_WORST, _IN_A_CUT = 6, 28  # numbers of worst frequencies at which `_Search.least` bisects at once, and of bisections
_VIOLATED = 3  # largest number of local minima at which `_Search.cut` adds tangents
_DIFFERENCE = 1e-5  # relative step of the central differences of a tangent
_GAP = 3e-6  # relative gap between the best share and the bound at which the search ends
_WEIGHTS = 1e4  # 1/alpha is searched from 1/_WEIGHTS to _WEIGHTS of its unit
_DIGITS = 7  # digits of beta and multipliers; the exact proof uses these rounded values


class _Best(NamedTuple):
    """The least share of the damping that a search found, with its beta and multipliers."""

    share: float  # inf if no beta that was tried needs less than the allowed share
    w: float  # binding frequency [rad/sample]
    beta: tuple[float, ...]  # (m,) [s]
    values: tuple[float, ...] = ()  # the multipliers of the facts
    bound: float = 0.0  # lower bound of the share at the frequencies of the search, after `spare` is subtracted


class Sweep:
    """The block of Theorem B in the environments of `loop`, for sweeps over frequency.

    The block without L does not depend on the share of the damping. L is added for each share that is tried.

    Args:
        maps: One map for each environment, as `form` takes them.
        form: (map, multipliers by name, hands' side) -> the demand.
        unknowns: The multipliers of the facts.
        limited: Whether a limiter is among the facts. Then dx is the sum of two inputs.
    """

    def __init__(
        self,
        loop: Loop,
        maps: Sequence[Lti],
        form: Callable[[Any, Values, KnownMotor], Demand[Any]],
        unknowns: Sequence[Unknowns] = (),
        limited: bool = False,
    ) -> None:
        self.loop, self.maps, self.form, self.unknowns = loop, maps, form, unknowns
        known, m = _known(loop, loop.T), loop.channels
        self.P, self.highest = known.P, 4 * known.mass / known.damping  # `highest` is the beta [s] with c2 = 0
        self.usual = tuple(v for each in unknowns for v in (each.units if each.start is None else each.start))
        self.grids = [np.concatenate([[0.0], frequencies(self.idle(i, np.zeros(m)).free)]) for i in range(len(maps))]
        # Index arrays (m,) of the inputs whose sum is dx.
        self.moves = [np.arange(m), 2 * m + np.arange(m)] if limited else [np.arange(m)]

    def idle(self, environment: int, beta: Any, values: Sequence[float] | None = None) -> Demand[Lti]:
        """Return the demand without L, at beta (m,) [s] and the multipliers `values`."""
        named = named_parts(self.unknowns, self.usual if values is None else values)
        return self.form(self.maps[environment], named, KnownMotor(PeriodCost(*np.zeros((4, len(beta)))), beta))

    def floor(self, beta: Array) -> float:
        """Return the least share at which beta is at most _LARGEST_ETA times `largest_beta`, or inf if none is."""
        if not ((beta > 0) & (beta <= _LARGEST_ETA * self.highest)).all():
            return np.inf
        return float((beta**2 * self.P / (4 * np.array(self.loop.delta))).max()) / _LARGEST_ETA**2

    def holds(self, idle: Complex, z: Complex, share: Any, beta: Array) -> NDArray[np.bool_]:
        """Return whether the block, with L for this share of the damping, is positive at each frequency, (k,)."""
        return positive(_with_cost(idle, z, period_cost(self.loop, np.broadcast_to(share, z.shape), beta), self.moves))

    def shares(self, idle: Complex, z: Complex, beta: Array, high: float, steps: int = _BISECTIONS) -> Array:
        """Return the least share (k,) that passes `holds` at each frequency; inf where that exceeds `high`."""
        k, low = z.size, self.floor(beta)
        if not low < high:
            return np.full(k, np.inf)
        least, most = np.full(k, low), np.full(k, high)
        enough, plenty = (self.holds(idle, z, share, beta) for share in (least, most))
        bits = int(np.clip(np.log2(_TOGETHER / k + 1), 1, 5))
        inner = np.arange(1, 2**bits) / 2**bits
        many, points = np.repeat(idle, inner.size, axis=0), np.repeat(z, inner.size)
        for _ in range(-(-steps // bits)):
            tried = least[:, None] + (most - least)[:, None] * inner
            served = self.holds(many, points, tried.ravel(), beta).reshape(tried.shape)
            first = np.where(served.any(axis=1), served.argmax(axis=1), inner.size)
            ends = np.column_stack([least, tried, most])
            least, most = ends[np.arange(k), first], ends[np.arange(k), first + 1]
        return np.where(enough, low, np.where(plenty, most, np.inf))

    def response(self, environment: int, beta: Array, values: Sequence[float] | None, high: float) -> Response:
        """Return the function w (k,) [rad/sample] -> least share (k,)."""
        free = self.idle(environment, beta, values).free

        def shares(w: Array) -> Array:
            z = on_circle(w)
            return self.shares(hermitian(free.at(z)), z, beta, high)

        return shares

    def required(self, beta: Array, high: float, values: Sequence[float] | None = None) -> tuple[float, float]:
        """Return the least share up to `high`, or inf, by a refined sweep, and the binding frequency [rad/sample]."""
        if not self.floor(beta) < high:
            return np.inf, 0.0
        return max(supremum(self.response(i, beta, values, high), grid) for i, grid in enumerate(self.grids))

    def best(self, high: float) -> _Best:
        """Return the least share below `high` over all beta and multipliers."""
        return _Search(self, high).run()


class _Search:
    """The search for the beta and multipliers that require the least share of the damping.

    The unknowns are x = (beta [s] per device, multipliers in their units, share of the damping). The multiplier alpha
    of switching delays is replaced by 1/alpha. All axes of a device have one beta, as matrix levels require.
    """

    def __init__(self, sweep: Sweep, high: float) -> None:
        self.sweep, self.high, self.m = sweep, high, len(sweep.loop.devices)
        self.device = np.array(sweep.loop.per_channel(range(self.m)))  # (channels,)
        each = [(each, unit) for each in sweep.unknowns for unit in each.units]
        self.units = np.array([unit for _, unit in each])
        self.searched = np.flatnonzero(self.units)
        self.inverse = np.array([each[i][0].name == "alpha" for i in self.searched], dtype=bool)
        self.inverse &= bool(sweep.loop.varying_delay)  # A user's own multiplier may have the same name.
        bounds = np.array([(each[i][0].least, each[i][0].most) for i in self.searched]).reshape(-1, 2)
        bounds[self.inverse] = 1 / _WEIGHTS, _WEIGHTS
        self.low, self.top = bounds.T
        self.sampled = [self.parts(i, grid) for i, grid in enumerate(sweep.grids)]
        self.tangents: list[tuple[Complex, Complex]] = []

    def beta(self, x: Array) -> Array:
        """Return beta [s] of every channel."""
        return x[: self.m][self.device]

    def parts(self, environment: int, w: Array) -> tuple[Complex, Complex]:
        """Return z (k,), and the block without L as an affine function of beta and the multipliers, (.., k, n, n).

        The first entry is the block at zero beta and zero multipliers, minus the margin `spare` of the demand. The
        others are the slopes in each unknown.
        """
        m, z = self.m, on_circle(w)
        none, no_beta = 0 * self.units, np.zeros(self.device.size)
        each = [(no_beta, none), *((beta, none) for beta in np.eye(m)[:, self.device])]
        each += [(no_beta, none + self.units * (np.arange(self.units.size) == i)) for i in self.searched]
        demands = [self.sweep.idle(environment, beta, tuple(values)) for beta, values in each]
        blocks = np.array([hermitian(demand.free.at(z)) for demand in demands])
        blocks[1:] -= blocks[0]
        if (spare := demands[0].spare) is not None:
            blocks[0] -= np.diag(spare)
        return z, blocks

    def largest(self, share: float) -> Array:
        """Return the largest beta (devices,) [s] for this share of the damping."""
        return self.sweep.loop.per_device(largest_beta(self.sweep.loop, share))

    def weights(self, x: Array) -> Array:
        """Return the multipliers of x as multiples of their units."""
        inner = x[self.m : -1]
        return np.where(self.inverse, 1 / np.where(self.inverse, inner, 1.0), inner)

    def values(self, x: Array) -> tuple[float, ...]:
        """Return the multipliers of x in SI units."""
        values = np.zeros(self.units.size)
        values[self.searched] = self.weights(x) * self.units[self.searched]
        return tuple(values.tolist())

    def idle(self, z: Complex, parts: Complex, x: Array) -> Complex:
        """Return the block (k, n, n) without L at x. For switching delays it is not affine in (alpha, beta)."""
        m, beta, weights = self.device.size, self.beta(x), self.weights(x)
        block = parts[0] + np.tensordot(np.concatenate([x[: self.m], weights]), parts[1:], axes=1)
        alpha, loop = named_parts(self.sweep.unknowns, self.values(x)).get("alpha"), self.sweep.loop
        alpha = alpha if loop.varying_delay else None
        even = loop.per_channel([np.mean(loop.delta[own]) for own in loop.devices])
        for i, each in enumerate(loop.per_channel(alpha) if alpha else ()):
            weight, speed, v = each * (loop.delta[i] / even[i]), beta[i] * (z - 1), m + i
            for part in self.sweep.moves:
                block[:, part[i], v] -= weight / 2 * speed
                block[:, v, part[i]] -= weight / 2 * np.conj(speed)
            block[:, v, v] -= weight / 2 * np.abs(speed) ** 2
        return block

    def concave(self, z: Complex, parts: Complex, x: Array, at: Array) -> Complex:
        """Return the block (k, n, n) with L. Inputs of switching delays are scaled by x/at, which makes it concave."""
        cost = period_cost(self.sweep.loop, np.full(z.size, x[-1]), self.beta(x))
        block, ratio = _with_cost(self.idle(z, parts, x), z, cost, self.sweep.moves), np.ones(parts.shape[-1])
        for a in np.flatnonzero(self.inverse) + self.m:  # 1/alpha
            own = np.real(np.diagonal(parts[1 + a], axis1=1, axis2=2)).min(axis=0) > 0
            ratio[own] = x[a] / at[a]
        return ratio[:, None] * block * ratio

    def tangent(self, z: Complex, parts: Complex, at: Array) -> tuple[Complex, Complex]:
        """Return constant and slopes of the tangent at x = `at`, scaled to entries of about one."""
        value, slopes = self.concave(z, parts, at, at), np.concatenate([parts[1:], 0 * parts[:1]])
        inverse = np.concatenate([np.zeros(self.m, dtype=bool), self.inverse, [False]])
        curved = np.where(np.append(False, inverse[:-1])[:, None, None, None], parts, 0.0)  # terms that are not affine
        for a in np.flatnonzero(inverse | (np.arange(at.size) < self.m) | (np.arange(at.size) == at.size - 1)):
            step, of = _DIFFERENCE * at[a] * (np.arange(at.size) == a), parts if inverse[a] else curved
            after, before = (self.concave(z, of, at + sign * step, at) for sign in (1, -1))
            change = (after - before) / (2 * step[a])
            slopes[a] = change if inverse[a] else slopes[a] + change
        constant = value - np.tensordot(at, slopes, axes=1)
        size = np.abs(np.diagonal(np.concatenate([value[None], at[:, None, None, None] * slopes]), axis1=2, axis2=3))
        root = 1 / np.sqrt(size.max(axis=0))
        root = root[:, :, None] * root[:, None, :]
        return root * constant, root * slopes

    def least(self, x: Array, most: float) -> tuple[float, tuple[int, int] | None]:
        """Return the least share below `most` at x, or inf, and (environment, index of the binding frequency).

        The second result is None if the share is inf or `Sweep.floor`.
        """
        beta, share, binding = self.beta(x), self.sweep.floor(self.beta(x)), None
        for e, (z, parts) in enumerate(self.sampled):
            idle = self.idle(z, parts, x)
            for _ in range(budgets.BETA_CUTS):
                if not share < most:
                    return np.inf, None
                low = np.flatnonzero(~self.sweep.holds(idle, z, share, beta))
                if not low.size:
                    break
                room = self.room(z[low], parts[:, low], idle[low], np.append(x[:-1], share))
                low = low[np.argsort(room)[:_WORST]]
                each = self.sweep.shares(idle[low], z[low], beta, most, _IN_A_CUT)
                if each.max() > share:
                    share, binding = float(each.max()), (e, int(low[np.argmax(each)]))
        return share, binding

    def room(self, z: Complex, parts: Complex, idle: Complex, x: Array) -> Array:
        """Return the least eigenvalue (k,) of each block with L, after scaling its diagonal to about one."""
        cost = period_cost(self.sweep.loop, np.full(z.size, x[-1]), self.beta(x))
        block = _with_cost(idle, z, cost, self.sweep.moves)
        terms = np.abs(np.diagonal(parts, axis1=2, axis2=3)) * np.abs(np.concatenate([[1.0], x[:-1]]))[:, None, None]
        size = terms.max(axis=(0, 1)) + np.abs(np.diagonal(block - idle, axis1=1, axis2=2)).max(axis=0)
        root = 1 / np.sqrt(size)
        return -largest_eigenvalue(-(root[:, None] * block * root))

    def run(self) -> _Best:
        """Return the best result of a refined sweep, after tangents bring the bound within _GAP of the least share."""
        start = [self.sweep.usual[i] / self.units[i] for i in self.searched]
        at_once = [np.concatenate([eta * self.largest(self.high), start, [self.high]]) for eta in _ETAS]
        for x in at_once:
            self.cut(x)
        x, best, bound = at_once[1], _Best(self.high, 0.0, (), self.sweep.usual), 0.0
        least, candidate = self.high, None
        for _ in range(budgets.BETA_ROUNDS):
            share, binding = self.least(x, least)
            if share < least:
                candidate, least = x, share
            if least - bound <= _GAP * least:
                if candidate is None:
                    break
                best = min(best, refined := self.swept(candidate))
                if refined.share <= least * (1 + _BETWEEN):
                    candidate = None
                    break
                self.add(refined.w)
                candidate, least = None, best.share
                continue
            self.cut(x)
            if binding:
                self.cut(np.append(x[:-1], share), binding)
            try:
                x = self.solved(least)
            except DesignFailed:
                break
            bound = max(bound, float(x[-1]))
            x[-1] = max(x[-1], self.sweep.floor(self.beta(x)))
        if candidate is not None:
            best = min(best, self.swept(candidate))
        return best._replace(bound=min(bound, best.share)) if best.beta else best._replace(share=np.inf)

    def swept(self, x: Array) -> _Best:
        """Return the share for the rounded beta and multipliers of x, by a refined sweep."""
        beta = tuple(float(f"{b:.{_DIGITS}g}") for b in self.beta(x))
        values = tuple(float(f"{v:.{_DIGITS}g}") for v in self.values(x))
        return _Best(*self.sweep.required(np.array(beta), self.high, values), beta, values)

    def add(self, w: float) -> None:
        """Sample all blocks at a further frequency [rad/sample]."""
        for i, (z, parts) in enumerate(self.sampled):
            more_z, more = self.parts(i, np.array([w]))
            self.sampled[i] = np.append(z, more_z), np.concatenate([parts, more], axis=1)

    def cut(self, x: Array, binding: tuple[int, int] | None = None) -> None:
        """Add the tangent at x for `binding`, (environment, index of a frequency); None stands for all of `lowest`."""
        places = [binding] if binding else self.lowest(x)
        for e, at in places:
            z, parts = self.sampled[e]
            self.tangents.append(self.tangent(z[at : at + 1], parts[:, at : at + 1], x))

    def lowest(self, x: Array) -> list[tuple[int, int]]:
        """Return (environment, index of the frequency) of up to _VIOLATED local minima of `room`, the least ones."""
        minima = []
        for e, (z, parts) in enumerate(self.sampled):
            room = self.room(z, parts, self.idle(z, parts, x), x)
            beside = np.concatenate([[np.inf], room, [np.inf]])
            minima += [(room[at], e, at) for at in np.flatnonzero((room <= beside[:-2]) & (room < beside[2:]))]
        return [(e, int(at)) for _, e, at in sorted(minima)[:_VIOLATED]]

    def solved(self, least: float) -> Array:
        """Return the x of least share that satisfies all tangents. Raises DesignFailed if the solver finds none."""
        sweep = self.sweep
        weights = np.where(self.inverse, 1 / least, 1.0)
        unit = np.concatenate([self.largest(least), weights, [least]])
        last = unit.size - 1
        constant, slopes = (np.concatenate(part, axis=-3) for part in zip(*self.tangents, strict=True))
        blocks = [Inequality(constant, slopes * unit[:, None, None, None], range(unit.size))]
        lowest, highest = _LEAST_ETA * self.largest(self.high), sweep.loop.per_device(sweep.highest)
        low, top = np.append(lowest, self.low), np.append(_LARGEST_ETA * highest, self.top)
        for sign, ends in ((1, low / unit[:last]), (-1, -top / unit[:last])):
            rows = sign * np.eye(last, unit.size)[:, :, None, None].swapaxes(0, 1)
            blocks.append(Inequality(-ends[:, None, None], rows, range(unit.size)))
        # s >= `Sweep.floor`, with s in units of `least` and beta in units of the largest beta for that share.
        floors = self.beta(unit) ** 2 * sweep.P / (4 * least * np.array(sweep.loop.delta))
        for i, floor in enumerate(-sweep.loop.per_device(-floors)):
            root = np.array([[0.0, 1.0], [1.0, 0.0]]) * np.sqrt(floor) / _LARGEST_ETA
            blocks.append(Inequality.of(lambda y, root=root: np.diag([y[1], 1.0]) + y[0] * root, [i, last]))
        program = ConeProgram(np.eye(unit.size)[-1], blocks)
        # The minimum cannot exceed `least`, because the point with that share satisfies all tangents.
        first, *others = SETTINGS
        settings = (first, INTERIOR, *others)
        x = program.solve("beta of the known devices", lambda x: x[-1] <= 1 + _GAP, settings)
        slack = np.linalg.eigvalsh(blocks[0].at(x))[:, 0]
        self.tangents = [one for one, left in zip(self.tangents, slack, strict=True) if left < _SLACK]
        return unit * x


_ETAS = (0.03, 0.3, 0.1, 0.9)  # shares of the largest beta for the first tangents; the search begins at the second
_SLACK = 0.002  # A tangent with a larger least eigenvalue (its entries are about one) is dropped.
_BETWEEN = 1e-4  # If a refined sweep finds a share that is larger by more than this, its frequency is sampled, too.


def device_rows(z: Complex, cost: PeriodCost) -> tuple[Array, Complex, Array]:
    """Return the entry 11, twice the entry 21, and the entry 22 of L as a Hermitian matrix on (dx, v), at z (k,)."""
    turn, cosine = 1 + 1 / z[:, None], z.real[:, None]
    return cost.move, -cost.cross * turn, cost.mean * (1 + cosine) / 2 + 2 * cost.step * (1 - cosine)


def _with_cost(idle: Complex, z: Complex, cost: PeriodCost, moves: Sequence[NDArray[np.intp]]) -> Complex:
    """Return the matrices `idle` (k, n, n) with L added. Entries of `cost` are (k, m); `moves` is `Sweep.moves`."""
    own, cross, speed = device_rows(z, cost)
    block, m = idle.copy(), own.shape[1]
    for i, part in itertools.product(range(m), moves):
        block[:, m + i, part[i]] += cross[:, i] / 2
        block[:, part[i], m + i] += np.conj(cross[:, i]) / 2
        for other in moves:
            block[:, part[i], other[i]] += own[:, i]
    for i in range(m):
        block[:, m + i, m + i] += speed[:, i]
    return block


def positive(H: Complex) -> NDArray[np.bool_]:
    """Return whether Hermitian matrices (..., n, n) are positive definite, from the signs of their pivots."""
    H, holds = H.copy(), np.ones(H.shape[:-2], dtype=bool)
    for i in range(H.shape[-1]):
        pivot = H[..., i, i].real
        holds &= pivot > 0
        column = H[..., i + 1 :, i]
        # A matrix that has failed stays False. Its elimination continues with pivot 1, so its entries may overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            H[..., i + 1 :, i + 1 :] -= (
                column[..., :, None] * np.conj(column[..., None, :]) / np.where(holds, pivot, 1.0)[..., None, None]
            )
    return holds


_NONE = "the devices have no guaranteed bounds: declare [device.guaranteed] of every device, or give --known-device"
_NO_SHORTEST = "T_min: a known device with periods up to T_max needs a shortest period; add T_min to the scenario"
_LATE = "latency: Theorem B is for forces that are held for the whole period, not for forces that latch inside it"
_MOST_SHARE = 1e3  # largest share of the damping that `required` tries


class KnownDevice(Condition):
    """Stability in the environment of the loop for every passive hand, on devices within their guaranteed bounds.

    The multiplier consists of beta, lower bounds of q and upper bounds of q, with one number of each per channel, and
    of the facts' multipliers. The condition `plain` ignores the bounds of the devices. If it requires less damping,
    beta and the bounds of q are 0. The bounds of q are also 0 if the damping does not suffice, because no proof needs
    them.
    """

    name, source = "known-device", "Theorem B, docs/theory.md"
    covers = ("psi", "T_max", "varying_delay", "walls", "ranges")
    plain: Multiplied = THIS_ENVIRONMENT  # the limit of the condition for beta -> 0, with the same facts

    def beyond(self, loop: Loop) -> str | None:
        if loop.latency:  # This reason comes first, because declaring bounds does not remove it.
            return _LATE
        if not loop.known_devices:
            return _NONE
        return _NO_SHORTEST if shortest_period(loop) is None else super().beyond(loop)

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return self.plain.facts(loop)

    @property
    def at_zero(self) -> Multiplied:
        """The limit of the condition for beta -> 0: `plain`, but with the facts of a user's subclass."""
        if type(self).facts is KnownDevice.facts:
            return self.plain
        base, own, extended = type(self.plain), copy(self.plain), {"name": self.name, "covers": BEYOND}
        extended["facts"] = lambda _, loop: self.facts(loop)
        object.__setattr__(own, "__class__", type(base.__name__, (base,), extended))
        return own

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        return tuple(each for fact in self.facts(loop) for each in fact.unknowns(loop))

    def without(self, coupling: Coupling) -> str | None:
        """Return the reason why the condition does not apply to this coupling, or None."""
        return None

    def form(self, G: Any, loop: Loop, values: Values, hands: KnownMotor) -> Demand[Any]:
        """Return the demand for the map G (`map`), in any arithmetic."""
        return compose(G, _straightened(loop), self.facts(loop), values, hands=hands)

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        """Return the map of `plain` in principal axes of the levels."""
        return _turned(self.plain.map(loop, coupling, exact), loop)

    def sweep(self, loop: Loop, coupling: Coupling) -> Sweep:
        """Return the sweep of all environments of the loop. Raises SingularLoop."""
        maps = [self.map(each, coupling) for each in self._loops(loop)]
        one, limited = loop.at(loop.environment), any(isinstance(fact, Limited) for fact in self.facts(loop))

        def form(G: Any, values: Values, hands: KnownMotor) -> Demand[Any]:
            return self.form(G, one, values, hands)

        return Sweep(_straightened(one), maps, form, self.unknowns(loop), limited)

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        """Return the demand at the loop's damping. If beta > 0, `gain` is 0, as L is not proportional to damping."""
        if multiplier is None:
            multiplier = self.required(loop, coupling).multiplier or (0.0,) * 3 * loop.channels
        m, straight = loop.channels, _straightened(loop)
        beta, below, above = (multiplier[i : i + m] for i in (0, m, 2 * m))
        own, unknowns = tuple(multiplier[3 * m :]), self.unknowns(loop)
        if not any(beta):
            plain = self.at_zero
            return plain.demand(loop, coupling, exact, own) if own else plain.demand(loop, coupling, exact)
        values = named_parts(unknowns, own)
        for each in unknowns:
            each.check(values[each.name])
        if exact:
            rationals = [[rational(v) for v in part] for part in (beta, below, above)]
            _check_q(straight, *rationals)
            hands = KnownMotor(_exact_cost(straight, *rationals), rationals[0])
        else:
            hands = KnownMotor(period_cost(straight, 1.0, np.array(beta, dtype=float)), beta)
        G = self.map(loop, coupling, exact)
        if exact:
            budgets.require_size(G.order + sum(loop.delays.hi) + 2 * m)
        return self.form(G, loop, values, hands)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the requirement with `multiplier`; None means the best one that serves all environments in ranges."""
        if reason := self.beyond(loop) or self.without(coupling):
            return refusal(self.name, loop.delta, reason, applies=False)
        m, expected = loop.channels, sum(self.multiplier_sizes(loop).values())
        if multiplier is not None and len(multiplier) != expected:
            reason = f"the multiplier has {len(multiplier)} numbers, expected {expected}: beta, bounds of q, facts"
            return refusal(self.name, loop.delta, reason)
        if multiplier is not None and any(multiplier[:m]):
            return self._at(loop, coupling, tuple(float(v) for v in multiplier))
        plain = self.at_zero.required(loop, coupling, tuple(multiplier or ())[3 * m :] or None)
        plain = replace(plain, condition=self.name, multiplier=(*(0.0,) * 3 * m, *(plain.multiplier or ())))
        if plain.reason or multiplier is not None:
            return plain
        best = self.sweep(loop, coupling).best(min(plain.ratio, _MOST_SHARE))
        if not best.share < plain.ratio:
            return plain
        bounds = (0.0,) * 2 * m
        if suffices(best.share):
            below, above = _q_bounds(_straightened(loop), [rational(b) for b in best.beta])
            bounds = below + above
        requirement = from_ratio(self.name, best.share, loop.delta, best.w / (2 * np.pi * loop.T))
        return replace(requirement, multiplier=(*best.beta, *bounds, *best.values))

    def _at(self, loop: Loop, coupling: Coupling, multiplier: tuple[float, ...]) -> Requirement:
        """Return the requirement with the beta and multipliers in `multiplier`."""
        m = loop.channels
        beta, own, sweep = np.array(multiplier[:m]), multiplier[3 * m :], self.sweep(loop, coupling)
        if (loop.per_device(beta) < -loop.per_device(-beta)).any():
            reason = f"beta is {beta.tolist()} s, expected one value for all axes of a device"
            return replace(refusal(self.name, loop.delta, reason), multiplier=multiplier)
        for i, each in enumerate(self._loops(loop)):
            demand = sweep.idle(i, beta, own)
            if reason := unsound(demand.free, loop.delta) or self.plain.unsound_static(sweep.maps[i], each, demand):
                return replace(refusal(self.name, loop.delta, reason), multiplier=multiplier)
        share, w = sweep.required(beta, _MOST_SHARE, own)
        if not np.isfinite(share):
            reason = f"beta = {beta.tolist()} s proves nothing for these devices, even with 1000 times the damping"
            return replace(refusal(self.name, loop.delta, reason), multiplier=multiplier)
        requirement = from_ratio(self.name, share, loop.delta, w / (2 * np.pi * loop.T))
        return replace(requirement, multiplier=multiplier)

    def least_multiplier(self, loop: Loop) -> tuple[Array | None, str | None]:
        if self.unknowns(loop):
            return None, "every coupling would need a search for its own beta and multipliers of walls or delays"
        return super().least_multiplier(loop)

    def words(self, loop: Loop) -> str:
        return MAKING if loop.environment.walls and self.guarantee(loop) == HERE else super().words(loop)

    def over_frequency(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Response | None:
        if multiplier is None:
            multiplier = self.required(loop, coupling).multiplier
        m, values = loop.channels, multiplier or ()
        if not any(values[:m]):
            return self.at_zero.over_frequency(loop, coupling, tuple(values[3 * m :]) or None)
        beta, sweep = np.array(values[:m], dtype=float), self.sweep(loop, coupling)
        return sweep.response(0, beta, tuple(values[3 * m :]), max(_MOST_SHARE, 2 * sweep.floor(beta)))

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        """Return the required share of the damping (n,) for a stack of couplings, to 3 %, on a grid of frequencies.

        The tried shares lie between _LEAST_DRAWN and the smaller of _MOST_DRAWN and the share of `plain`. The tried
        beta are _DRAWN times the largest beta of each channel. Returns None for matrix levels, for a user's subclass,
        or if `plain` returns None. Returns inf if the condition does not cover the loop or has multipliers.
        """
        ours = type(self) in (KnownDevice, _KnownDeviceAny)  # The block of a user's fact may not be affine in beta.
        plain = self.plain.ratios(loop, coupling) if ours and not loop.levels else None
        if plain is None or self.unknowns(loop) or self.beyond(loop):
            return plain if plain is None else np.full(plain.size, np.inf)
        holds = self._drawn(loop, coupling, plain.size)
        low, high = np.full(plain.size, _LEAST_DRAWN), np.minimum(plain, _MOST_DRAWN)
        enough = holds(high) & (high > low) & np.isfinite(plain)
        for _ in range(_DRAWN_STEPS):
            middle = np.sqrt(low * np.where(enough, high, low))
            held = holds(middle)
            low, high = np.where(held, low, middle), np.where(held & enough, middle, high)
        return np.minimum(np.where(enough, high, plain), plain)

    def _drawn(self, loop: Loop, coupling: Coupling, n: int) -> Callable[[Array], NDArray[np.bool_]]:
        """Return the function: shares (n,) -> whether some beta of _DRAWN makes each coupling's block positive (n,)."""
        half, m = _DRAWN_POINTS // 2, loop.channels
        w = np.sort(np.concatenate([np.geomspace(1e-3, np.pi, half), np.linspace(0.011, np.pi, half)]))
        z, none = on_circle(w), PeriodCost(*np.zeros((4, m)))
        G = self.sampled(loop, coupling, np.broadcast_to(z, (n, w.size)))
        each = [self.form(G, loop, {}, KnownMotor(none, beta)).free.G for beta in (np.zeros(m), *np.eye(m))]
        shape = n, w.size, *each[0].shape[-2:]
        idle, *by = (hermitian(np.broadcast_to(part, shape)) for part in each)
        last = np.zeros(n, dtype=int)  # The beta that last satisfied a coupling's block is tried first.
        known, delta = _known(loop, loop.T), np.array(loop.delta)

        def holds(share: Array) -> NDArray[np.bool_]:
            served = np.zeros(n, dtype=bool)
            most = np.minimum(2 * np.sqrt(share[:, None] * delta / known.P), 4 * known.mass / known.damping)
            for turn in range(_DRAWN.size):
                left = np.flatnonzero(~served)
                if not left.size:
                    break
                which = (last[left] + turn) % _DRAWN.size
                beta = _DRAWN[which, None] * most[left]
                block = idle[left] + sum(
                    beta[:, i, None, None, None] * (part[left] - idle[left]) for i, part in enumerate(by)
                )
                cost = period_cost(loop, np.repeat(share[left], w.size), np.repeat(beta, w.size, axis=0))
                flat = block.reshape(-1, *block.shape[2:])
                right = positive(_with_cost(flat, np.tile(z, left.size), cost, [np.arange(m)]))
                served[left] = right.reshape(left.size, -1).all(axis=1)
                last[left[served[left]]] = which[served[left]]
            return served

        return holds

    def sampled(self, loop: Loop, coupling: Coupling, z: Complex) -> Sampled:
        """Return the maps of a stack of couplings at z (n, k)."""
        return loop.sent_at(coupling, z)

    def not_varied(self, loop: Loop) -> str | None:
        return "every variation would need its own beta, which is not searched"

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        own = dict.fromkeys(("beta", "q_below", "q_above"), loop.channels)
        return own | {each.name: len(each.units) for each in self.unknowns(loop)}


class LimitedKnownDevice(KnownDevice):
    """The condition known-device for forces that a limiter limits (design.environments.LimitedForces)."""

    name, covers = "limiter", KnownDevice.covers

    def __init__(self, limiter: LimitedForces = LIMITER) -> None:
        self.plain = self.limiter = limiter

    def behind(self, limiter: LimitedForces) -> LimitedKnownDevice:
        """Return this condition with another limiter. An instance of a user's subclass keeps its class."""
        other = copy(self)
        other.plain = other.limiter = limiter
        return other

    @property
    def base(self) -> str:
        return KnownDevice.name if self.name == LimitedKnownDevice.name else self.name

    def limiter_rho(self, loop: Loop) -> tuple[float, ...] | None:
        return self.limiter.limiter_rho(loop)

    def parameters(self, loop: Loop) -> dict[str, tuple[float, ...]]:
        return self.limiter.parameters(loop)


class _KnownDeviceAny(KnownDevice):
    """Stability in every passive environment for every passive hand, on devices within their guaranteed bounds."""

    name, covers = "known-device-any", ("T_max", "varying_delay", "walls", "ranges")
    plain: Multiplied = ANY_ENVIRONMENT

    def without(self, coupling: Coupling) -> str | None:
        if coupling.compliance(1.0) is None:
            return "the coupling has no compliance V(z) that is independent of the environment"
        return None

    def form(self, G: Any, loop: Loop, values: Values, hands: KnownMotor) -> Demand[Any]:
        return compose_any(G, _straightened(loop), self.facts(loop), values, hands=hands)

    def sampled(self, loop: Loop, coupling: Coupling, z: Complex) -> Sampled:
        return coupling.sampled(z, loop.T)

    def members(self, loop: Loop) -> tuple[Member, ...]:
        return ()

    def limiter_rho(self, loop: Loop) -> tuple[float, ...] | None:
        return (0.0,) * loop.channels if type(self) is _KnownDeviceAny else None

    def guarantee(self, loop: Loop) -> Environments:
        return ANY


_LEAST_DRAWN, _MOST_DRAWN = 0.02, 10.0  # range of the shares of the damping that `ratios` tries
_DRAWN_STEPS = 10  # halvings of the logarithm of this range, to 0.6 %
#: tried betas, relative to the largest beta of each channel
_DRAWN = np.concatenate([np.geomspace(0.003, 0.5, 18), [0.62, 0.74, 0.85, 0.93, 0.98, 0.9995]])
_DRAWN_POINTS = 240  # number of frequencies, half of them evenly and half logarithmically spaced


def described(loop: Loop) -> str:
    """Return the devices in words: 'devices with at least 60 g behind transmissions of at most 9 N/m and 0.5 N s/m'."""
    words = []
    for device in dict.fromkeys(loop.known_devices or ()):
        mass, k = f"{1e3 * device.motor_mass_min:.4g} g", f"{device.transmission_stiffness_max:.6g} N/m"
        least, most = device.transmission_damping_min, device.transmission_damping_max
        losses = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
        words.append(f"at least {mass} behind transmissions of at most {k} and {losses} N s/m")
    return f"devices with {' or '.join(words)}"


KNOWN_DEVICE, KNOWN_DEVICE_ANY = KnownDevice(), _KnownDeviceAny()
