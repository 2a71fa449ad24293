"""Count what is known of a device: the mass of its motor, and a transmission that loses energy. Theorem B.

this-environment charges the virtual damping against a hand of any stiffness at the motor's shaft. Behind a transmission
(a spring of at most k and a damper of at least b, in parallel) no hand is stiffer than the transmission, and the mass
of the motor keeps its speed from changing at once. With P = k^2/b and any beta > 0 [s] the motor, its transmission and
every passive hand behind it satisfy, over each period in which the force f is held,

    sum f'(dx + beta dv) + sum L(dx, v, v+) <= const,     L = min of the integral of c0 v^2 + c2 v'^2,

with c0 = delta - beta^2 P/4, c2 = beta m - beta^2 b/4, the displacement dx and the speeds v, v+ at both ends.
docs/theory.md has the proof. The blocks below say that the environment's side gives back less than L.

`Theorem A` at the end is exact for a linear motor, swept and not proved: it shows how much the proof gives away.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import Number, SingularLoop, numbers, rational
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import DeviceBounds, Loop
from haptic_loop.controller.lti import Array, Block, Complex, Lti, constant_like
from haptic_loop.controller.ranges import Member
from haptic_loop.design import budgets
from haptic_loop.design.conditions import BEYOND, FULL_LEVELS, Condition, Demand, even_damping, v_hat
from haptic_loop.design.environments import LIMITER, THIS_ENVIRONMENT, LimitedForces, Multiplied, named_parts
from haptic_loop.design.exact import require_size
from haptic_loop.design.facts import (
    Fact,
    KnownMotor,
    Limiter,
    PeriodCost,
    Unknowns,
    Values,
    Walls,
    compose,
    compose_any,
)
from haptic_loop.design.frame import signals_of
from haptic_loop.design.frequency import Response, frequencies, hermitian, largest_eigenvalue, on_circle, supremum
from haptic_loop.design.lmi import ANY_ENVIRONMENT
from haptic_loop.design.result import MAKING, Environments, NotProved, Requirement, from_ratio, refusal, suffices

# ----------------------------------------------------------------------------------------------------
# The least cost of a period.


def shortest_period(loop: Loop) -> float | None:
    """The shortest period [s] of the loop; None where periods vary and no shortest one is declared."""
    if loop.T_min is not None:
        return loop.T_min
    return loop.T if loop.T_max in (None, loop.T) else None


class _Known(NamedTuple):
    """What is known of the devices, (m,) each, in one arithmetic."""

    P: Any  # [N/(m s)] largest k^2/b of the transmission
    damping: Any  # [N s/m] its largest damping
    mass: Any  # [kg] least mass of the motor


def _known(loop: Loop, T: Number) -> _Known:
    return _in_arithmetic(loop.known_devices or (), T)


@lru_cache(maxsize=64, typed=True)  # typed: the period's type decides the arithmetic
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
    """The beta (m,) [s] at which c0 or c2 vanishes for devices of damping `share` Delta."""
    known = _known(loop, loop.T)
    return np.minimum(2 * np.sqrt(share * np.array(loop.delta) / known.P), 4 * known.mass / known.damping)


def _shortfall(y: Array) -> Array:
    """1 - tanh(y)/y, (m,), to full relative precision also for small y."""
    small = np.minimum(y, _SERIES) ** 2
    series = small * (1 / 3 - small * (2 / 15 - small * (17 / 315 - small * 62 / 2835)))
    return np.where(y < _SERIES, series, 1 - np.tanh(y) / np.maximum(y, _SERIES))


_SERIES = 0.03  # below it the next term of the series is 2e-14 of the value, above it cancellation costs 4e-13


def period_cost(loop: Loop, share: Any, beta: Array) -> PeriodCost:
    """The least cost of a period for devices of damping `share` Delta, (..., m) in floating point.

    Where periods lie in [T1, T2], L is at least c0 (dx, vb) [[T2, 1], [1, 1/q(T1)]]^-1 (dx, vb)' + c2 dv^2/q(T2).
    Entries are NaN where beta is too large for this damping.
    """
    longest, shortest = loop.T_max or loop.T, shortest_period(loop) or loop.T
    c0, c2 = _rates(_known(loop, loop.T), np.asarray(share)[..., None] * np.array(loop.delta), beta)
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = np.sqrt(c0 / c2)
        short, long = (_shortfall(rate * T / 2) for T in (shortest, longest))
        q, q_long = shortest * (1 - short), longest * (1 - long)
        move = c0 / (longest - shortest + shortest * short)
        return PeriodCost(move, move * q, move * q * longest, c2 / q_long)


_BITS = 320  # of the balls in which q is enclosed
_MOST_ULPS = 8  # between q and its bounds: the midpoint of a ball is rounded once


def q_bounds(loop: Loop, beta: Sequence[Fraction]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Decimals [s] below q of the shortest and above q of the longest period, channel by channel.

    q = T tanh(y)/y with y^2 = c0 T^2/(4 c2) at the damping of the loop. Raises NotProved for a beta that is too large.
    """
    import flint

    below, above = [], []
    with flint.ctx.workprec(_BITS):
        for short, long in _enclosed(loop, beta):
            below.append(_beside(short, -np.inf, lambda value, ball: value < ball))
            above.append(_beside(long, np.inf, lambda value, ball: value > ball))
    return tuple(below), tuple(above)


def _beside(ball: Any, towards: float, beyond: Callable[[Any, Any], bool]) -> float:
    """The nearest double whose shortest decimal lies beyond the ball."""
    import flint

    value = float(ball.mid())
    for _ in range(_MOST_ULPS):
        if beyond(flint.arb(_fmpq(rational(value))), ball):
            return value
        value = float(np.nextafter(value, towards))
    raise NotProved("q of the known device could not be enclosed")


def check_q(loop: Loop, beta: Sequence[Fraction], below: Sequence[Fraction], above: Sequence[Fraction]) -> None:
    """Raise NotProved unless below < q(T1) and q(T2) < above on every channel, by balls that contain q."""
    import flint

    m = loop.channels
    if not len(beta) == len(below) == len(above) == m:
        raise NotProved(f"q has {len(below)} and {len(above)} bounds, expected {m} each")
    with flint.ctx.workprec(_BITS):
        for i, (short, long) in enumerate(_enclosed(loop, beta)):
            least, most = (flint.arb(_fmpq(value[i])) for value in (below, above))
            if not (below[i] > 0 and least < short and long < most):
                between = f"{float(below[i])!r} to {float(above[i])!r}"
                raise NotProved(f"q #{i + 1} lies outside of its bounds on file, {between} s")


def _enclosed(loop: Loop, beta: Sequence[Fraction]) -> list[tuple[Any, Any]]:
    """q of the shortest and of the longest period as balls, channel by channel. Raises NotProved."""
    import flint

    exact = loop.period(True)
    short, long = (rational(T) for T in (shortest_period(loop) or exact, loop.T_max or exact))

    def q(T: Fraction, ratio: Fraction) -> Any:
        y = flint.arb(_fmpq(ratio * T * T / 4)).sqrt()
        return flint.arb(_fmpq(T)) * y.tanh() / y

    c0, c2 = _checked_rates(loop, beta)
    return [(q(short, spread / inertia), q(long, spread / inertia)) for spread, inertia in zip(c0, c2, strict=True)]


def _checked_rates(loop: Loop, beta: Sequence[Fraction]) -> tuple[Any, Any]:
    """c0 and c2 over Fractions, positive. Raises NotProved."""
    exact = loop.period(True)
    c0, c2 = _rates(_known(loop, exact), numbers(loop.delta, exact), _row(beta))
    if not ((c0 > 0).all() and (c2 > 0).all() and all(b > 0 for b in beta)):
        raise NotProved(f"beta is {[float(b) for b in beta]}, too large for the bounds of the devices")
    return c0, c2


def _row(values: Sequence[Fraction]) -> Any:
    return np.array(list(values), dtype=object)


def _fmpq(value: Fraction) -> Any:
    import flint

    return flint.fmpq(value.numerator, value.denominator)


def exact_cost(
    loop: Loop, beta: Sequence[Fraction], below: Sequence[Fraction], above: Sequence[Fraction]
) -> PeriodCost:
    """A rational bound below the cost at the loop's damping, from bounds of q that `check_q` has checked."""
    exact = loop.period(True)
    c0, c2 = _checked_rates(loop, beta)
    longest = rational(loop.T_max) if loop.T_max else exact
    q = _row(below)
    move = c0 / (longest - q)
    return PeriodCost(move, move * q, move * q * longest, c2 / _row(above))


# ----------------------------------------------------------------------------------------------------
# The required damping s Delta: the least s for which some beta satisfies the condition with the same other bounds.
#
# For a fixed beta each frequency has a least s, because L grows with the damping; s(beta) is the largest of them. A
# search on a grid is refined by golden section. The result is what a refined sweep says of the beta found.

_LARGEST_ETA = 0.9999  # of the largest beta, at which c0 or c2 would be zero
_SCANNED = np.concatenate([np.geomspace(1e-4, 0.6, 36), 1 - np.geomspace(0.35, 1e-4, 14)])  # shares of the largest beta
_BISECTIONS = 52  # of an interval of shares: to 2e-16 of its length
_TOGETHER = 100  # matrices that take hardly longer together than one alone: few frequencies get several halvings
_THIN = 5  # every so many frequencies of the grid are looked at while the best beta is located
_WORST = 6  # frequencies of least room at which the least share is found at once
_IN_A_CUT = 28  # bisections of a cut, whose result is from above
_GOLDEN = (5**0.5 - 1) / 2
_STEPS = 0.2, 0.05, 0.0125, 0.003  # of log beta, channel by channel
_DIGITS = 7  # of beta, which the exact proof takes as it is printed


class Best(NamedTuple):
    """The least share of the damping that a form of Theorem B needs."""

    share: float  # inf where no beta was found that needs less than the share allowed
    w: float  # where it binds [rad/sample]
    beta: tuple[float, ...]  # (m,) [s]


class _Sampled(NamedTuple):
    """The environment's side at frequencies on the circle."""

    z: Complex  # (k,)
    own: Complex  # (k, m, m) Hermitian part of F/(z-1), or of V/(1-z)
    forces: Complex  # (k, m, m) F, or V


class Sweep(ABC):
    """The least share of the damping for which Theorem B holds, with its best beta; one subclass per form."""

    scanned, sections = (
        _SCANNED,
        30,
    )  # shares of the largest beta; thirty sections locate log beta to 1e-6 of the bracket

    def __init__(self, loop: Loop, *systems: Lti) -> None:
        self.loop, known = loop, _known(loop, loop.T)
        self._P, self._highest = known.P, 4 * known.mass / known.damping  # [s] where c2 = 0
        self._root = 1 / np.sqrt(even_damping(loop))
        self.grid = np.concatenate([[0.0], frequencies(*systems)])
        self._all = self.sampled(self.grid)
        self._few = _Sampled(*(part[::_THIN] for part in self._all))

    @abstractmethod
    def sampled(self, w: Array) -> _Sampled:
        """Return the environment's side at w (k,) [rad/sample]."""

    @abstractmethod
    def room(self, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        """Return Hermitian matrices (k, m, m) that must be positive; entries of the cost are (k, m)."""

    def shares(self, here: _Sampled, beta: Array, low: float, high: float, steps: int = _BISECTIONS) -> Array:
        """Return the least share (k,) in [low, high] at each frequency, inf where `high` is too little."""
        k = here.z.size
        least, most = np.full(k, low), np.full(k, high)
        enough, plenty = (self._least_room(here, share, beta) > 0 for share in (least, most))
        bits = int(np.clip(np.log2(_TOGETHER / k + 1), 1, 5))
        inner = np.arange(1, 2**bits) / 2**bits
        many = _Sampled(*(np.repeat(part, inner.size, axis=0) for part in here))
        for _ in range(-(-steps // bits)):
            tried = least[:, None] + (most - least)[:, None] * inner
            holds = self._least_room(many, tried.ravel(), beta).reshape(tried.shape) > 0
            first = np.where(holds.any(axis=1), holds.argmax(axis=1), inner.size)
            ends = np.column_stack([least, tried, most])
            least, most = ends[np.arange(k), first], ends[np.arange(k), first + 1]
        return np.where(enough, low, np.where(plenty, most, np.inf))

    def _least_room(self, here: _Sampled, share: Any, beta: Array) -> Array:
        """Return the least eigenvalue (k,) of `room`."""
        cost = period_cost(self.loop, np.broadcast_to(share, here.z.shape), beta)
        return -largest_eigenvalue(-(self._root[:, None] * self.room(here, cost, beta) * self._root))

    def floor(self, beta: Array) -> float:
        """Return the share at which beta is the largest that is tried; inf where no damping allows it."""
        if not ((beta > 0) & (beta <= _LARGEST_ETA * self._highest)).all():
            return np.inf
        return float((beta**2 * self._P / (4 * np.array(self.loop.delta))).max()) / _LARGEST_ETA**2

    def least(self, beta: Array, high: float, thin: bool = False) -> float:
        """Return the least share on the grid for this beta, from below by cuts; inf where it is not below `high`."""
        share, here = self.floor(beta), self._few if thin else self._all
        for _ in range(budgets.BETA_CUTS):
            if not share < high:
                return np.inf
            room = self._least_room(here, share, beta)
            worst = np.argsort(room)[:_WORST]
            worst = worst[room[worst] <= 0]
            if not worst.size:
                return share
            at = _Sampled(*(part[worst] for part in here))
            if (self._least_room(at, high, beta) <= 0).any():
                return np.inf
            share = float(self.shares(at, beta, share, high, _IN_A_CUT).max())
        return share

    def required(self, beta: Array, high: float) -> tuple[float, float]:
        """Return the least share below `high` (inf if there is none) by a refined sweep, and where it binds."""
        low = self.floor(beta)
        if not low < high:
            return np.inf, 0.0
        return supremum(lambda w: self.shares(self.sampled(w), beta, low, high), self.grid)

    def best(self, high: float) -> Best:
        """Return the least share below `high` over all beta that were tried."""
        scale = largest_beta(self.loop, high)

        def along(logarithm: float) -> float:
            return self.least(np.exp(logarithm) * scale, high)

        etas = _LARGEST_ETA * self.scanned
        logs = np.log(etas)
        at, least = 0, high
        for i, eta in enumerate(etas):
            if (share := self.least(eta * scale, least, thin=True)) < least:
                at, least = i, share
        if not least < high:
            return Best(np.inf, 0.0, ())
        beta = np.exp(_golden(along, logs[max(at - 1, 0)], logs[min(at + 1, logs.size - 1)], self.sections)) * scale
        if self.loop.channels > 1:
            beta = self._each_channel(beta, high)
        beta = np.array([float(f"{b:.{_DIGITS}g}") for b in beta])
        share, w = self.required(beta, high)
        return Best(share, w, tuple(beta.tolist()))

    def _each_channel(self, beta: Array, high: float) -> Array:
        """Return a better beta where the channels' own differ, by a pattern search in log beta."""
        best = min(self.least(beta, high), high)
        for step in _STEPS:
            for i in range(beta.size):
                for factor in (np.exp(step), np.exp(-step)):
                    for _ in range(budgets.BETA_MOVES):
                        trial = beta.copy()
                        trial[i] *= factor
                        share = self.least(trial, best * (1 - _SAME))
                        if not np.isfinite(share):
                            break
                        best, beta = share, trial
        return beta


_SAME = 1e-9  # a smaller relative gain is rounding


def _golden(value: Callable[[float], float], left: float, right: float, sections: int) -> float:
    """Return where `value` is least in [left, right], if it has one valley there."""
    inner = [right - _GOLDEN * (right - left), left + _GOLDEN * (right - left)]
    found = [value(x) for x in inner]
    for _ in range(sections):
        if found[0] < found[1]:
            right, inner, found = inner[1], [0.0, inner[0]], [0.0, found[0]]
            inner[0] = right - _GOLDEN * (right - left)
            found[0] = value(inner[0])
        else:
            left, inner, found = inner[0], [inner[1], 0.0], [found[1], 0.0]
            inner[1] = left + _GOLDEN * (right - left)
            found[1] = value(inner[1])
    return inner[int(np.argmin(found))]


def device_rows(z: Complex, cost: PeriodCost) -> tuple[Array, Complex, Array]:
    """Return the entries 11, 21 (twice the Hermitian one) and 22 of L on (dx, v) at z (k,), shapes (k, m)."""
    turn, cosine = 1 + 1 / z[:, None], z.real[:, None]
    return cost.move, -cost.cross * turn, cost.mean * (1 + cosine) / 2 + 2 * cost.step * (1 - cosine)


class ThisEnvironmentSweep(Sweep):
    """Theorem B around the force map F of one environment."""

    def __init__(self, F: Lti, loop: Loop) -> None:
        self._F, (_, self._regular) = F, F.over_z_minus_one()
        super().__init__(loop, F)

    def sampled(self, w: Array) -> _Sampled:
        z = on_circle(w)
        return _Sampled(z, hermitian(self._regular.at(z)), self._F.at(z))

    def room(self, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        return self.room_of(here, cost, beta)

    @staticmethod
    def room_of(here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        """He[F/(z-1)] + l11 - M*M/(4 l22) with M = -beta F/z + l21: the Schur complement of the row of v."""
        own, cross, speed = device_rows(here.z, cost)
        one = np.eye(beta.shape[-1])
        M = -beta[..., None] * here.forces / here.z[:, None, None] + cross[..., None] * one
        scaled = M / (4 * speed[..., None])
        rows = zip(np.conj(M).swapaxes(0, 1), scaled.swapaxes(0, 1), strict=True)
        # M* scaled, row by row: `@` takes five times as long for stacks of 2 by 2
        return here.own + own[..., None] * one - sum(left[..., None] * right[:, None] for left, right in rows)


class AnyEnvironmentSweep(Sweep):
    """Theorem B around every passive environment behind the coupling V, without delay in the environment."""

    def __init__(self, V: Lti, loop: Loop) -> None:
        self._V, (_, self._own) = V, v_hat(V)
        super().__init__(loop, V)

    def sampled(self, w: Array) -> _Sampled:
        z = on_circle(w)
        return _Sampled(z, hermitian(self._own.at(z)), self._V.at(z))

    def room(self, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        return self.room_of(self.loop.theta, here, cost, beta)

    @staticmethod
    def room_of(theta: Sequence[int], here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        """He[V/(1-z)] - diag chi."""
        return here.own - chi(here.z, theta, cost, beta)[..., None] * np.eye(beta.shape[-1])


class FactsSweep(Sweep):
    """Theorem B with facts of the environment's side (walls, the limiter), at given multipliers."""

    scanned, sections = _SCANNED[::2], 8  # beta and the multipliers are searched in turn, several times

    def __init__(self, G: Lti, loop: Loop, facts: Sequence[Fact], values: Values) -> None:
        """Take G from [x; p] to [f_e; y]; the block is affine in beta and in L."""
        m = loop.channels
        none = PeriodCost(*np.zeros((4, m)))
        each = [compose(G, loop, facts, values, hands=KnownMotor(none, b)).free for b in (np.zeros(m), *np.eye(m))]
        self._idle, self._by_beta, self._moves = each[0], each[1:], _moves(m, facts)
        super().__init__(loop, each[0])
        size = np.abs(np.diagonal(self._all.own, axis1=1, axis2=2)).max(axis=0)
        cost = period_cost(loop, np.ones(1), largest_beta(loop) / 2)
        for parts in self._moves:
            size[parts] += cost.move[0]
        size[m : 2 * m] += cost.step[0]
        self._root = 1 / np.sqrt(size)

    def sampled(self, w: Array) -> _Sampled:
        z = on_circle(w)
        idle = hermitian(self._idle.at(z))
        return _Sampled(z, idle, np.stack([hermitian(block.at(z)) - idle for block in self._by_beta], axis=1))

    def room(self, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        own, cross, speed = device_rows(here.z, cost)
        room, m = here.own + np.tensordot(here.forces, beta, axes=(1, 0)), beta.size
        for i, part in itertools.product(range(m), self._moves):
            room[:, m + i, part[i]] += cross[:, i] / 2
            room[:, part[i], m + i] += np.conj(cross[:, i]) / 2
            for other in self._moves:
                room[:, part[i], other[i]] += own[:, i]
        for i in range(m):
            room[:, m + i, m + i] += speed[:, i]
        return room


def _moves(m: int, facts: Sequence[Fact]) -> list[NDArray[np.intp]]:
    """Return the inputs that add up to dx, (m,) each: dx, or dx less the limiter's slip and the slip."""
    dx = np.arange(m)
    return [dx, 2 * m + dx] if any(isinstance(fact, Limiter) for fact in facts) else [dx]


class _AtBeta(Multiplied):
    """The best multipliers of walls for one beta and one share of the damping: those that leave most of L unused."""

    name, covers = "known-device", BEYOND

    def __init__(self, cost: PeriodCost, beta: Array, facts: Sequence[Fact]) -> None:
        self.cost, self.beta, self.facts = cost, beta, facts

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        return tuple(each for fact in self.facts for each in fact.unknowns(loop))

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        return loop.walled_before_delay(coupling, exact)

    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        """The block less the diagonal of L, which s multiplies: it holds where s < 1 is enough."""
        made = compose(G, loop, self.facts, self.named(loop, multiplier), hands=KnownMotor(self.cost, self.beta))
        diagonal, m = np.zeros(signals_of(made.free)), len(self.beta)
        diagonal[m : 2 * m] = self.cost.mean / 2 + 2 * self.cost.step
        for parts in _moves(m, self.facts):
            diagonal[parts] = self.cost.move
        gain = np.diag(_SPARED * diagonal)
        return Demand(made.free - gain, constant_like(G, gain), made.static, made.semidefinite, made.spare)

    def unsound_static(self, G: Lti, loop: Loop, asked: Demand[Lti]) -> str | None:
        return None  # this-environment has looked at it


def chi(z: Complex, theta: Sequence[int], cost: PeriodCost, beta: Array) -> Array:
    """l Lam^-1 l*/4 with l = [(z^n - 1)/(z - 1), beta z^n], n = theta + 1: what V must exceed, (k, m) [m/N]."""
    own, cross, speed = device_rows(z, cost)
    n = np.array(theta) + 1
    window = np.stack([sum(z**i for i in range(each)) for each in n], axis=1)
    last, cross = beta * z[:, None] ** n, cross / 2
    both = speed * np.abs(window) ** 2 + own * beta**2 - 2 * (last * cross * np.conj(window)).real
    return both / (4 * (own * speed - np.abs(cross) ** 2))


# ----------------------------------------------------------------------------------------------------
# The conditions.

_SPARED = 0.1  # of the diagonal of L: what multipliers are searched to leave unused
_GAIN = 1e-3  # the least gain of the share, from beta and multipliers in turn, that goes on
_NONE = "the devices have no guaranteed bounds: declare [device.guaranteed] of every device, or give --known-device"
_NO_SHORTEST = "periods up to T_max need a shortest one, T_min, for a known device"
_MOST_SHARE = 1e3  # of the damping, up to which a beta on file is swept


class KnownDevice(Condition):
    """Safe in the environment of the loop for every passive hand, on devices within their guaranteed bounds.

    The multiplier holds beta, and bounds of q below and above, one number each per channel; all are 0 where the
    condition that knows nothing of the device asks less.
    """

    name, source, covers = "known-device", "Theorem B, docs/theory.md", ("psi", "T_max", "walls", "ranges")
    plain: Condition = THIS_ENVIRONMENT  # as beta -> 0

    def beyond(self, loop: Loop) -> str | None:
        if not loop.known_devices:
            return _NONE
        if loop.levels:
            return f"levels: {self.name} {FULL_LEVELS}"
        return _NO_SHORTEST if shortest_period(loop) is None else super().beyond(loop)

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        """Return the facts of the environment's side that need multipliers."""
        return (Walls(),) if loop.environment.walls else ()

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        return tuple(each for fact in self.facts(loop) for each in fact.unknowns(loop))

    def without(self, coupling: Coupling) -> str | None:
        """Return why the condition says nothing of this coupling, or None."""
        return None

    def sweep(self, loop: Loop, coupling: Coupling) -> Sweep:
        """Return the sweep in a loop without ranges. Raises SingularLoop."""
        return ThisEnvironmentSweep(loop.F(coupling), loop)

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        """Return the block at the loop's own damping, which does not scale it."""
        if multiplier is None:
            multiplier = self.required(loop, coupling).multiplier or (0.0,) * 3 * loop.channels
        m = loop.channels
        beta, below, above = (multiplier[i : i + m] for i in (0, m, 2 * m))
        own, unknowns = tuple(multiplier[3 * m :]), self.unknowns(loop)
        if not any(beta):
            return self.plain.demand(loop, coupling, exact, own) if own else self.plain.demand(loop, coupling, exact)
        values = named_parts(unknowns, own)
        for each in unknowns:
            each.check(values[each.name])
        if not exact:
            hands = KnownMotor(period_cost(loop, 1.0, np.array(beta, dtype=float)), beta)
            return self._block(loop, coupling, hands, values, exact)
        rationals = [[rational(v) for v in part] for part in (beta, below, above)]
        check_q(loop, *rationals)
        return self._block(loop, coupling, KnownMotor(exact_cost(loop, *rationals), rationals[0]), values, exact)

    def _block(self, loop: Loop, coupling: Coupling, hands: KnownMotor, values: Values, exact: bool) -> Demand[Lti]:
        facts = self.facts(loop)
        G = THIS_ENVIRONMENT.map(loop, coupling, exact) if facts else loop.F(coupling, exact)
        if exact:
            require_size(G.order + loop.channels + (sum(loop.theta) if facts else 0))
        return compose(G, loop, facts, values, late=bool(facts), hands=hands)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the least damping over beta, or that of the beta given, the most of all members of the ranges.

        Of several members one beta serves all: the best in the environment in which the plain condition asks most.
        """
        if reason := self.without(coupling):
            return refusal(self.name, loop.delta, reason)
        if self.facts(loop):
            return self._with_facts(loop, coupling, multiplier)
        loops, m = self._loops(loop), loop.channels
        if multiplier is not None and len(multiplier) != 3 * m:
            reason = f"the multiplier has {len(multiplier)} numbers, expected beta and two bounds of q for {m} channels"
            return refusal(self.name, loop.delta, reason)
        plain = [self.plain.required(each, coupling) for each in loops]
        hardest = max(range(len(loops)), key=lambda i: plain[i].ratio)
        most = plain[hardest]
        if most.reason and not self._may_help(most):
            return refusal(self.name, loop.delta, most.reason)
        high = min(most.ratio, _MOST_SHARE)
        if multiplier is not None:
            beta, high = tuple(float(b) for b in multiplier[:m]), _MOST_SHARE
        else:
            beta = self.sweep(loops[hardest], coupling).best(high).beta
        if not any(beta):
            return replace(most, condition=self.name, multiplier=(0.0,) * 3 * m)
        found = [self.sweep(each, coupling).required(np.array(beta), high) for each in loops]
        share, w = max(found)
        if not np.isfinite(share) and multiplier is None:
            return replace(most, condition=self.name, multiplier=(0.0,) * 3 * m)
        if not np.isfinite(share):
            reason = f"beta = {list(beta)} s proves nothing for these devices, whatever the damping"
            return replace(refusal(self.name, loop.delta, reason), multiplier=(*beta, *(0.0,) * 2 * m))
        bounds = (0.0,) * 2 * m
        if multiplier is not None:
            bounds = tuple(multiplier[m:])
        elif suffices(share):
            below, above = q_bounds(loop, [rational(b) for b in beta])
            bounds = below + above
        requirement = from_ratio(self.name, share, loop.delta, w / (2 * np.pi * loop.T))
        return replace(requirement, multiplier=(*beta, *bounds))

    def _with_facts(self, loop: Loop, coupling: Coupling, multiplier: Any) -> Requirement:
        """Before walls or with a limiter: search beta and the facts' multipliers in turn, or take those given."""
        if reason := self.beyond(loop):
            return refusal(self.name, loop.delta, reason)
        m, expected = loop.channels, sum(self.multiplier_sizes(loop).values())
        if multiplier is not None and len(multiplier) != expected:
            reason = f"the multiplier has {len(multiplier)} numbers, expected {expected}"
            return refusal(self.name, loop.delta, reason)
        numbers_on_file = tuple(float(v) for v in multiplier or ())
        beta, bounds, own = (numbers_on_file[part] for part in (slice(m), slice(m, 3 * m), slice(3 * m, None)))
        plain = self.plain.required(loop, coupling, own if own and not any(beta) else None)
        if plain.reason or (own and not any(beta)):
            return replace(plain, condition=self.name, multiplier=(*(0.0,) * 3 * m, *(plain.multiplier or ())))
        G, unknowns, facts = THIS_ENVIRONMENT.map(loop, coupling), self.unknowns(loop), self.facts(loop)
        if own:
            sweep = FactsSweep(G, loop, facts, named_parts(unknowns, own))
            share, w = sweep.required(np.array(beta), _MOST_SHARE)
            if not np.isfinite(share):
                reason = f"beta = {list(beta)} s proves nothing for these devices, whatever the damping"
                return replace(refusal(self.name, loop.delta, reason), multiplier=numbers_on_file)
            found = from_ratio(self.name, share, loop.delta, w / (2 * np.pi * loop.T))
            return replace(found, multiplier=(*beta, *bounds, *own))
        best, own = Best(min(plain.ratio, _MOST_SHARE), 0.0, ()), plain.multiplier or ()
        values, high = own, best.share
        for _ in range(budgets.BETA_TURNS):
            found = FactsSweep(G, loop, facts, named_parts(unknowns, values)).best(high)
            if not found.share < best.share:
                break
            enough = found.share < best.share * (1 - _GAIN)
            best, own, high = found, values, found.share * (1 + _GAIN)
            if not enough:
                break
            at = np.array(found.beta)
            cost = PeriodCost(*(part[0] for part in period_cost(loop, np.array([found.share]), at)))
            values = _AtBeta(cost, at, facts).required_of(G, loop).multiplier or values
        if not best.beta:
            return replace(plain, condition=self.name, multiplier=(*(0.0,) * 3 * m, *own))
        bounds = (0.0,) * 2 * m
        if best.share < 1:
            below, above = q_bounds(loop, [rational(b) for b in best.beta])
            bounds = below + above
        requirement = from_ratio(self.name, best.share, loop.delta, best.w / (2 * np.pi * loop.T))
        return replace(requirement, multiplier=(*best.beta, *bounds, *own))

    def least_multiplier(self, loop: Loop) -> tuple[Array | None, str | None]:
        if self.facts(loop):
            return None, "before walls every coupling would need a search for its own beta and multipliers"
        return super().least_multiplier(loop)

    def words(self, loop: Loop) -> str:
        return MAKING if loop.environment.walls and self.facts(loop) else super().words(loop)

    def _may_help(self, plain: Requirement) -> bool:
        """Whether the condition may hold where the plain one is refused."""
        return False

    def over_frequency(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Response | None:
        if multiplier is None:
            multiplier = self.required(loop, coupling).multiplier
        beta = np.array((multiplier or (0.0,))[: loop.channels], dtype=float)
        if self.facts(loop):
            return None
        if not beta.any():
            return self.plain.over_frequency(loop, coupling)
        sweep = self.sweep(loop, coupling)
        low = sweep.floor(beta)
        return lambda w: sweep.shares(sweep.sampled(w), beta, low, max(_MOST_SHARE, 2 * low))

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        """Return the required share of the damping for a stack of couplings, (n,), to three hundredths, on a grid.

        Between _LEAST_DRAWN and what the plain condition asks each share is tried with _DRAWN values of beta, the same
        part of the largest one on every channel: a map asks for thousands of couplings.
        """
        plain = self.plain.ratios(loop, coupling)
        if plain is None or self.beyond(loop):
            return plain if plain is None else np.full(plain.size, np.inf)
        w = np.broadcast_to(_drawn_frequencies(loop), (plain.size, _DRAWN_POINTS))
        here = self.drawn(loop, coupling, w)
        low, high = np.full(plain.size, _LEAST_DRAWN), np.minimum(plain, _MOST_DRAWN)
        open_ = (high > low) & np.isfinite(plain)
        last = np.zeros(plain.size, dtype=int)  # which beta has served a cell before: it is tried first
        enough = _shares_hold(self, loop, here, high, last)
        high = np.where(enough, high, np.inf)
        for _ in range(_DRAWN_STEPS):
            middle = np.sqrt(low * np.where(open_ & enough, high, low))
            holds = _shares_hold(self, loop, here, middle, last)
            low, high = np.where(holds, low, middle), np.where(holds & enough, middle, high)
        return np.minimum(np.where(open_ & enough, high, plain), plain)

    def drawn(self, loop: Loop, coupling: Coupling, w: Array) -> _Sampled:
        """Return the environment's side of a stack of couplings at w (n, k), one after the other."""
        m, z = loop.channels, on_circle(w)
        F = np.broadcast_to(loop.late(loop.sent_at(coupling, z)).G, (*w.shape, m, m)).reshape(-1, m, m)
        step = -0.5 - 0.5j / np.tan(w.ravel() / 2)  # 1/(z - 1)
        return _Sampled(z.ravel(), hermitian(F * step[:, None, None]), F)

    def room(self, loop: Loop, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        """Return the Hermitian matrices that must be positive."""
        return ThisEnvironmentSweep.room_of(here, cost, beta)

    def not_varied(self, loop: Loop) -> str | None:
        return "every variation would need a search for its own beta: not searched"

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        own = dict.fromkeys(("beta", "q_below", "q_above"), loop.channels)
        return own | {each.name: len(each.units) for each in self.unknowns(loop)}


class LimitedKnownDevice(KnownDevice):
    """known-device also while forces are limited, by the limiter of `limiter` (design.environments.LimitedForces)."""

    name, covers = "limiter", ("psi", "T_max", "walls")

    def __init__(self, limiter: LimitedForces = LIMITER) -> None:
        self.plain = self.limiter = limiter

    @property
    def base(self) -> str:
        return KnownDevice.name

    def beyond(self, loop: Loop) -> str | None:
        return self.limiter.beyond(loop) or super().beyond(loop)

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return (*super().facts(loop), Limiter(self.limiter.rho(loop), self.limiter.lags))

    def parameters(self, loop: Loop) -> dict[str, tuple[float, ...]]:
        return self.limiter.parameters(loop)


class KnownDeviceAny(KnownDevice):
    """Safe around every passive environment for every passive hand, on devices within their guaranteed bounds."""

    name, covers = "known-device-any", ("T_max", "walls", "ranges")
    plain: Condition = ANY_ENVIRONMENT

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return ()  # only passivity of the environment is used

    def without(self, coupling: Coupling) -> str | None:
        if coupling.compliance(1.0) is None:
            return "the coupling has no compliance V(z) that knows nothing of the environment"
        return None

    def sweep(self, loop: Loop, coupling: Coupling) -> Sweep:
        V = coupling.compliance(loop.T)
        assert V is not None  # `without` refuses
        return AnyEnvironmentSweep(V, loop)

    def _block(self, loop: Loop, coupling: Coupling, hands: KnownMotor, values: Values, exact: bool) -> Demand[Lti]:
        V = coupling.compliance(loop.period(exact))
        assert V is not None
        if exact:
            require_size(V.order + sum(loop.theta) + 2 * loop.channels)
        return compose_any(V, loop, hands=hands)

    def drawn(self, loop: Loop, coupling: Coupling, w: Array) -> _Sampled:
        m, z = loop.channels, on_circle(w)
        V = np.broadcast_to(coupling.sampled(z, loop.T).G, (*w.shape, m, m)).reshape(-1, m, m)
        step = 0.5 + 0.5j / np.tan(w.ravel() / 2)  # 1/(1 - z)
        return _Sampled(z.ravel(), hermitian(V * step[:, None, None]), V)

    def room(self, loop: Loop, here: _Sampled, cost: PeriodCost, beta: Array) -> Complex:
        return AnyEnvironmentSweep.room_of(loop.theta, here, cost, beta)

    def members(self, loop: Loop) -> tuple[Member, ...]:
        return ()

    def lag(self, loop: Loop) -> tuple[float, ...] | None:
        return (0.0,) * loop.channels

    def guarantee(self, loop: Loop) -> Environments:
        return "any passive environment"


_LEAST_DRAWN, _MOST_DRAWN = 0.02, 10.0  # shares of the damping between which a map tells them apart
_DRAWN_STEPS = 10  # of halving their logarithm: to 0.6 %
_DRAWN = np.concatenate([np.geomspace(0.003, 0.5, 18), [0.62, 0.74, 0.85, 0.93, 0.98, 0.9995]])
_DRAWN_POINTS = 240


def _drawn_frequencies(loop: Loop) -> Array:
    """Frequencies of a map [rad/sample], even and in their logarithm."""
    half = _DRAWN_POINTS // 2
    return np.sort(np.concatenate([np.geomspace(1e-3, np.pi, half), np.linspace(0.011, np.pi, half)]))


def _shares_hold(
    condition: KnownDevice, loop: Loop, here: _Sampled, share: Array, last: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Whether some beta serves each cell at its share, (n,); `last` is updated with the one that does."""
    n, known = share.size, _known(loop, loop.T)
    points, holds = here.z.size // n, np.zeros(n, dtype=bool)
    parts = [part.reshape(n, points, *part.shape[1:]) for part in here]
    largest = np.minimum(2 * np.sqrt(share[:, None] * np.array(loop.delta) / known.P), 4 * known.mass / known.damping)
    root = 1 / np.sqrt(even_damping(loop))
    for turn in range(_DRAWN.size):
        left = np.flatnonzero(~holds)
        if not left.size:
            break
        which = (last[left] + turn) % _DRAWN.size
        some = _Sampled(*(part[left].reshape(-1, *part.shape[2:]) for part in parts))
        beta = np.repeat(_DRAWN[which, None] * largest[left], points, axis=0)
        cost = period_cost(loop, np.repeat(share[left], points), beta)
        matrix = root[:, None] * condition.room(loop, some, cost, beta) * root
        served = (largest_eigenvalue(-matrix).reshape(-1, points) < 0).all(axis=1)
        holds[left], last[left[served]] = served, which[served]
    return holds


def described(loop: Loop) -> str:
    """The devices of a loop in words: 'devices with at least 60 g behind at most 14500 N/m and 0.5 N s/m'."""
    said = []
    for device in dict.fromkeys(loop.known_devices or ()):
        mass, k = f"{1e3 * device.motor_mass_min:.4g} g", f"{device.transmission_stiffness_max:.6g} N/m"
        least, most = device.transmission_damping_min, device.transmission_damping_max
        losses = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
        said.append(f"at least {mass} behind at most {k} and {losses} N s/m")
    return f"devices with {' or '.join(said)}"


KNOWN_DEVICE, KNOWN_DEVICE_ANY = KnownDevice(), KnownDeviceAny()


# ----------------------------------------------------------------------------------------------------
# Theorem A: what no condition for these devices can undercut.
#
# For one linear motor (mass m, damping delta) behind a spring k and a damper b the sampled response to a held force
# fills a disk as the passive hand varies: at each alias w_n = (w + 2 pi n)/T the hand may answer as it likes. The loop
# is stable for every passive hand if no response in the disk closes it and it is stable with the far end of the
# transmission held. With one channel, or channels with equal devices, some lossless hand attains every point of the
# disk. The member of the class is the one with the least mass and damping, the stiffest spring and the least damper.
# Compare Fardad and Bamieh, IEEE Transactions on Automatic Control 54 (2009), for one channel.


def alias_sums(w: Array, T: float, mass: float, damping: Array, k: float, b: float) -> tuple[Array, Complex]:
    """Return sig0 and sig2 (k,) [m/(N s)] at w (k,) [rad/sample] for motors of `damping` (k,) [N s/m], in closed form.

    sig_i = |z - 1|^2 S_i/T^2 with S0 = sum 1/(w_n^2 c_n), S2 = sum g_n conj(a_n)/(w_n^2 c_n), a_n = delta + j m w_n,
    g_n = b w_n^2/(k^2 + b^2 w_n^2) and c_n = delta + g_n |a_n|^2. Both are rational in W = w_n^2 with the denominator
    b m^2 W^2 + (delta b^2 + b delta^2) W + delta k^2, and sums of partial fractions are cotangents.
    """
    high, middle, low = b * mass**2, damping * b * (b + damping), damping * k**2
    root: Complex = np.sqrt((middle**2 - 4 * high * low).astype(np.complex128))
    W1, W2 = (-middle - root) / (2 * high), (-middle + root) / (2 * high)
    W2 = np.where(np.abs(W2) < np.abs(W1), low / (high * W1), W2)  # without cancellation

    def sums(W: Any) -> tuple[Any, Any]:
        """Return the sums of 1/(w_n^2 - W) and of w_n/(w_n^2 - W)."""
        y = np.sqrt(W) * T
        less, more = 1 / np.tan((w - y) / 2), 1 / np.tan((w + y) / 2)
        return T**2 / (4 * y) * (less - more), T / 4 * (less + more)

    (even1, odd1), (even2, odd2) = sums(W1), sums(W2)
    apart = high * (W1 - W2)
    numerator = [(k**2 + b**2 * W) / W for W in (W1, W2)]
    S0 = k**2 / low * T**2 / (4 * np.sin(w / 2) ** 2) + (numerator[0] * even1 - numerator[1] * even2) / apart
    S2 = b / apart * (damping * (even1 - even2) - 1j * mass * (odd1 - odd2))
    turn = 4 * np.sin(w / 2) ** 2 / T**2
    return turn * S0.real, turn * S2


class Necessary(NamedTuple):
    """The least share of the damping for which Theorem A holds."""

    share: float
    w: float  # where it binds [rad/sample]
    held: bool  # whether the loop is stable at this share with the far ends of the transmissions held


_LOWEST = 1e-4  # [rad/sample]: at z = 1 the disk touches the point that it must not contain
_SMALL, _LARGE = 1e-6, 1e3  # shares of the damping between which the least one is searched


def necessary_share(F: Lti, loop: Loop) -> Necessary:
    """Return the least share of the damping at which no passive hand destabilises linear motors, by a refined sweep.

    It is a lower bound for every condition of this class of devices where the loop has one channel or equal devices;
    otherwise it is sufficient, and close.
    """
    assert loop.known_devices
    known, T, m = loop.known_devices, loop.T, loop.channels

    def holds(w: Array, response: Complex, share: Array) -> Any:
        sums = [
            alias_sums(w, T, d.motor_mass_min, share * delta, d.transmission_stiffness_max, d.transmission_damping_min)
            for d, delta in zip(known, loop.delta, strict=True)
        ]
        radius = np.stack([np.maximum(sig0, 1e-300) / 2 for sig0, _ in sums], axis=1)
        centre = radius + np.stack([sig2 for _, sig2 in sums], axis=1)
        root = np.sqrt(radius)
        z = on_circle(w)
        closed = (z - 1)[:, None, None] * np.eye(m) + T * centre[..., None] * response
        left, right = closed / root[..., None], T * root[..., None] * response
        adjoint = [np.conj(np.swapaxes(part, 1, 2)) for part in (left, right)]
        return -largest_eigenvalue(adjoint[1] @ right - adjoint[0] @ left) > 0

    def shares(w: Array) -> Array:
        response = F.at(on_circle(w))
        least, most = np.full(w.size, _SMALL), np.full(w.size, _LARGE)
        plenty = holds(w, response, most)
        for _ in range(_BISECTIONS):
            middle = (least + most) / 2
            enough = holds(w, response, middle)
            least, most = np.where(enough, least, middle), np.where(enough, middle, most)
        return np.where(plenty, most, np.inf)

    share, w = supremum(shares, frequencies(F, low=_LOWEST))
    return Necessary(share, w, bool(np.isfinite(share)) and _stable_with_held_ends(F, loop, share * (1 + 1e-6)))


@dataclass(frozen=True)
class LeftOver:
    """What Theorem A asks of linear motors beside what is proved: how much a better proof could still gain."""

    required_damping: tuple[
        float, ...
    ]  # (m,) [N s/m], by a sweep; no condition for these devices asks less if `attained`
    frequency_hz: float
    attained: bool  # one channel, or equal devices: some lossless hand destabilises the loop at any smaller damping
    proved_damping: tuple[float, ...] | None  # (m,) [N s/m] by known-device; None where it certifies nothing

    @property
    def words(self) -> str:
        """The comparison as a sentence without its full stop."""
        need = ", ".join(f"{d:.5g}" for d in self.required_damping)
        exact = "no proof for every passive hand can ask less" if self.attained else "that is enough, by a sweep"
        if self.proved_damping is None:
            return f"known devices with linear motors need {need} N s/m (Theorem A): {exact}"
        given = ", ".join(f"{d:.3g}" for d in np.subtract(self.proved_damping, self.required_damping))
        said = f"known devices with linear motors need {need} N s/m (Theorem A): {exact}"
        return f"{said}; the proof gives away {given} N s/m"


def left_over(loop: Loop, coupling: Coupling, proved: Requirement | None = None) -> LeftOver | None:
    """Return what Theorem A asks of this loop; None where it says nothing of it or finds no damping that is enough.

    `proved` is what known-device asks, if it has been asked already.
    """
    if KNOWN_DEVICE.beyond(loop) or loop.ranges or loop.T_max not in (None, loop.T):
        return None
    equal, walls = len(set(zip(loop.known_devices or (), loop.delta, strict=True))) == 1, bool(loop.environment.walls)
    if walls and not equal:
        return None  # touched walls give a lower bound, unlike devices a sufficient figure: together neither
    try:
        maps = loop.law(coupling).frozen().values() if walls else [loop.F(coupling)]
    except SingularLoop:
        return None
    if not all(F.is_stable() for F in maps):
        return None
    each, proved = [necessary_share(F, loop) for F in maps], proved or KNOWN_DEVICE.judge(loop, coupling)
    found = max(each, key=lambda one: one.share)
    if not (all(one.held for one in each) and np.isfinite(found.share)):
        return None
    needed = tuple(found.share * d for d in loop.delta)
    asked = proved.required if np.isfinite(proved.ratio) else None
    return LeftOver(needed, found.w / (2 * np.pi * loop.T), equal, asked)


def _stable_with_held_ends(F: Lti, loop: Loop, share: float) -> bool:
    """Whether the loop is stable at `share` of the damping with the far end of every transmission held."""
    import scipy

    m, known = loop.channels, loop.known_devices or ()
    generator = np.zeros((3 * m, 3 * m))
    for i, (device, delta) in enumerate(zip(known, loop.delta, strict=True)):
        mass, k, b = device.motor_mass_min, device.transmission_stiffness_max, device.transmission_damping_min
        generator[i, m + i] = 1
        generator[m + i, [i, m + i, 2 * m + i]] = -k / mass, -(share * delta + b) / mass, -1 / mass
    step = scipy.linalg.expm(generator * loop.T)[: 2 * m]
    A, B = step[:, : 2 * m], step[:, 2 * m :]
    C = np.eye(m, 2 * m)
    closed = np.block([[A + B @ F.D @ C, B @ F.C], [F.B @ C, F.A]])
    return bool(np.abs(np.linalg.eigvals(closed)).max() < 1)
