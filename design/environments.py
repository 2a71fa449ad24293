"""What this-environment asks of a coupling: around walls, over ranges, under delays that switch, with limited forces.

Walls, delays that switch and limited forces weigh an error with a multiplier, in which the block is affine:
`Multiplied` finds the best one. Ranges are environments that are proved one by one.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from haptic_loop.controller.arithmetic import Number, SingularLoop, numbers
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Block, Lti, as_like, constant_like, hstack, taps, vstack
from haptic_loop.controller.ranges import Member
from haptic_loop.design.conditions import (
    BEYOND,
    Condition,
    Demand,
    even_damping,
    least_scale,
    ratio_in,
    this_environment,
    this_environment_demand,
    this_environment_ratios,
    unsound,
    unsound_static,
)
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.exact import require_size
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import frequencies, hermitian, on_circle, peaks, supremum, sweeping
from haptic_loop.design.result import MAKING, DesignFailed, Requirement, from_ratio, refusal, switching_guarantee

# ----------------------------------------------------------------------------------------------------
# The best multiplier. The block is affine in (s, multiplier), so the least s over all multipliers at some frequencies
# is a matrix inequality (design.cone). It bounds s from below; where a sweep of the multiplier found needs more, these
# frequencies join, until it attains the bound.


@dataclass(frozen=True)
class Unknowns:
    """The numbers of a multiplier, and where a search looks for them: in [least, most] units each."""

    name: str  # what a file calls them
    units: tuple[float, ...]  # (n,); 0 for a number that is 0
    expected: str  # what they must be, for messages; positive where `least` is
    least: float
    most: float
    spare: tuple[float, ...] | float = 0.0  # (p,) that the block's diagonal keeps, however large the damping

    def check(self, values: Sequence[Any]) -> None:
        """Raises ValueError for what is no multiplier."""
        right = len(values) == len(self.units) and all(
            (v > 0 or v == self.least if unit else v == 0) and v < np.inf
            for v, unit in zip(values, self.units, strict=True)
        )
        if not right:
            raise ValueError(f"{self.name} is {[float(v) for v in values]}, expected {self.expected}")


class Multiplied(Condition):
    """A condition whose block is affine in a multiplier. One of your own has `unknowns`, `map` and `block`."""

    @abstractmethod
    def unknowns(self, loop: Loop) -> Unknowns | None:
        """What the multiplier consists of; None where the block needs none."""

    @abstractmethod
    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        """The map that the block is about. Raises SingularLoop, and NotProved for one too large to be proved."""

    @abstractmethod
    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        """The block of such a map, in any arithmetic."""

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        return self.block(self.map(loop, coupling, exact), loop, multiplier)

    def usual(self, G: Lti, loop: Loop) -> Sequence[float]:
        """The multiplier that a search begins with; the one of a block of many rows, whose search would take long."""
        unknowns = self.unknowns(loop)
        return unknowns.units if unknowns else ()

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """At this multiplier, or at the best one: `multiplier` and `bound` of the requirement say which."""
        unknowns, reason = self.unknowns(loop), self.beyond(loop)
        if reason:
            return refusal(self.name, loop.delta, reason)
        if unknowns is None:
            return super().required(loop, coupling)
        try:
            with sweeping():
                return self.required_of(self.map(loop, coupling), loop, multiplier)
        except InputError:
            raise
        except ValueError as error:  # SingularLoop, TooLong, or a multiplier that is none
            return refusal(self.name, loop.delta, str(error))

    def required_of(self, G: Lti, loop: Loop, multiplier: Any = None) -> Requirement:
        """The same of a map."""
        unknowns, delta = self.unknowns(loop), loop.delta
        assert unknowns
        values = tuple(float(v) for v in (self.usual(G, loop) if multiplier is None else multiplier))
        unknowns.check(values)
        asked = self.is_demand(self.block(G, loop, values))
        if reason := unsound(asked.free, delta) or self.unsound_static(G, loop, asked):
            return replace(refusal(self.name, delta, reason), multiplier=values)
        search, bound = _Search(lambda x: self.block(G, loop, x), unknowns, asked.free), None
        if multiplier is None and search.pays:
            bound, values = search.best(values)
        ratio, w = search.swept(values)
        if np.isinf(ratio):
            reason = f"no multiplier {unknowns.name} that was found proves it, whatever the damping"
            return replace(refusal(self.name, delta, reason), multiplier=values)
        found = from_ratio(self.name, max(ratio, 0.0), tuple(delta), w / (2 * np.pi * loop.T))
        return replace(found, multiplier=values, bound=bound and min(bound, ratio))

    def unsound_static(self, G: Lti, loop: Loop, asked: Demand[Lti]) -> str | None:
        """Why what the block says of z = 1 does not hold, beyond rounding."""
        return unsound_static(asked.free, asked, loop.delta)

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        if unknowns := self.unknowns(loop):
            unknowns.check(multiplier)
        return super().exact_demands(loop, coupling, multiplier)

    def multiplier_name(self, loop: Loop) -> str | None:
        unknowns = self.unknowns(loop)
        return unknowns and unknowns.name


_MOST_ROWS = 24  # of a block whose multiplier is searched: twelve devices with limited forces
_MOST_ROUNDS, _MOST_STALLED = 40, 3  # rounds; those in which the bound does not rise
_MOST_PEAKS = 3  # frequencies that join at once
_NEAR = 0.1  # of the highest peak, relatively: lower ones do not join
_SETTLED = 5e-7  # relative gap between what the multiplier asks and the bound
_DIGITS, _NOTHING = 8, 1e-6  # of a number of the multiplier; what counts as 0, in units


class _Search:
    """The multiplier at which a block asks least, by cutting planes."""

    def __init__(self, block: Callable[[Sequence[float]], Demand[Lti]], unknowns: Unknowns, system: Lti) -> None:
        self._block, self._unknowns, self._units = block, unknowns, np.array(unknowns.units)
        self._searched = np.flatnonzero(self._units)
        self._last: tuple[Sequence[float], tuple[float, float]] | None = None  # what was swept last
        self._grid = np.concatenate([[0.0], frequencies(system)])
        self._spare = np.diag(np.broadcast_to(unknowns.spare, system.outputs))
        self._plain: list[Demand[Lti]] = []  # the blocks of no multiplier, and of each unknown alone
        self._root = np.ones(system.outputs)  # what makes the rows of an inequality about one
        self.pays = system.outputs <= _MOST_ROWS and self._searched.size > 0

    def swept(self, values: Sequence[float]) -> tuple[float, float]:
        """(the ratio that the block asks at these values, where [rad/sample]), by a refined sweep."""
        if self._last is None or self._last[0] != values:
            asked = self._block(values)
            self._last = values, supremum(lambda w: least_scale(asked, w), self._grid)
        return self._last[1]

    def best(self, values: Sequence[float]) -> tuple[float, tuple[float, ...]]:
        """(a ratio that no multiplier is below, the best one), beginning with these values."""
        unknowns, count, bound = self._unknowns, self._searched.size, 0.0
        units = np.eye(self._units.size)[self._searched] * self._units
        self._plain = [self._block(tuple(x)) for x in (0 * self._units, *units)]
        by = np.abs(np.diagonal(self._parts(self._grid[[0, -1]])[1], axis1=2, axis2=3)).max(axis=1)
        self._root = 1 / np.sqrt(np.where(by[-1] > 0, by[-1], np.maximum(by.max(axis=0), 1e-300)))
        low = Inequality.least(range(count), unknowns.least), Inequality.least([count], 0.0)
        blocks = [*low, Inequality.most(range(count), unknowns.most)]
        top, w = self._worst(values, bound)
        best, least, stalled = values, top, 0
        for _ in range(_MOST_ROUNDS):
            if not w.size or stalled == _MOST_STALLED:
                break
            blocks.append(self._inequality(w))
            try:
                found = ConeProgram(np.eye(count + 1)[-1], blocks).solve(f"the multiplier {unknowns.name}")
            except DesignFailed:  # none within the bounds makes the block positive, however large the damping
                break
            stalled = 0 if found[-1] > bound + _SETTLED * max(bound, 1.0) else stalled + 1
            bound, values = max(bound, float(found[-1])), self._values(found[:-1])
            top, w = self._worst(values, bound)
            best, least = min((best, least), (values, top), key=lambda one: one[1])
        return bound, tuple(best)

    def _values(self, x: Array) -> tuple[float, ...]:
        """The multiplier of x, in units, in few digits."""
        values, least, most = np.zeros(self._units.size), self._unknowns.least, self._unknowns.most
        x = np.where(x < _NOTHING, 0.0, np.minimum(x, most)) if least == 0 else np.clip(x, least, most)
        values[self._searched] = [float(f"{v:.{_DIGITS}g}") for v in x * self._units[self._searched]]
        return tuple(values.tolist())

    def _worst(self, values: Sequence[float], bound: float) -> tuple[float, Array]:
        """(the most that these values ask, with something to spare, the worst few frequencies): none at the bound."""
        asked = self._block(values)
        asked = replace(asked, free=asked.free - self._spare) if self._spare.any() else asked

        def needed(w: Array) -> Array:
            return least_scale(asked, w)

        w = peaks(needed, self._grid, -np.inf, near=_NEAR)
        at = needed(w)
        if (top := float(at.max(initial=-np.inf))) > bound + _SETTLED * max(bound, 1.0):
            return top, w[np.argsort(-at)[:_MOST_PEAKS]]
        most, between = found = supremum(needed, self._grid)
        if not self._spare.any():
            self._last = tuple(values), found
        return most, np.array([between] if most > bound + 2 * _SETTLED * max(bound, 1.0) else [])

    def _parts(self, w: Array) -> tuple[Any, Any]:
        """The Hermitian parts of the constant, and of what each unknown and s multiply, at w (k,)."""
        z = on_circle(w)
        free = [hermitian(each.free.at(z)) for each in self._plain]
        return free[0] - self._spare, np.array([*(f - free[0] for f in free[1:]), hermitian(self._plain[0].gain.at(z))])

    def _inequality(self, w: Array) -> Inequality:
        constant, by = (self._root[:, None] * part * self._root for part in self._parts(w))
        return Inequality(constant, by, range(len(by)))


# ----------------------------------------------------------------------------------------------------
# In the environment of the loop, around walls that make and break contact, and at all members of ranges.


class ThisEnvironment(Multiplied):
    """Safe in the environment of the loop: around its walls, whether they touch or not, and at all of its members."""

    name, covers, extensible = "this-environment", BEYOND, True

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        G = loop.walled(coupling, exact)
        if exact:
            require_size(G.order)
        return G

    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        """this-environment for walls of any stiffness and damping with k + 2 b/T up to that of the loop's, and any gap.

        G takes [x; p] to [f; y], displacements (m,) and wall forces to the forces of the devices and the ways into the
        walls, [[F, J], [H, Y]]. With the multiplier g (w,) and M = g (z-1) - 1 the block is, on (dx, dp),
            [[F, J], [-M H, -M Y]]/(z-1) + diag(s Delta_D/T, g/slopes),
        whose static part must be symmetric, J(1) = H(1)' and Y(1) = Y(1)', with F(1) >= 0 >= Y(1). docs/theory.md has a
        weight of each wall beside g; it is 1 here.
        """
        T, m, w = G.T, loop.channels, len(loop.environment.walls)
        none, g = numbers([0] * m, T), numbers(multiplier, T)
        slopes: Any = [wall.slope(T) for wall in loop.environment.walls]
        S1, regular = G.over_z_minus_one()
        steep = np.diag(np.concatenate([none, g]))
        limits = np.concatenate([none, g / numbers(slopes, T)])
        free = np.hstack([numbers(np.eye(m + w), T), -steep]) @ vstack(regular, G) + np.diag(limits)
        damping = np.concatenate([even_damping(loop, T) / T, numbers([0] * w, T)])
        F1, Y1 = S1[..., :m, :m], S1[..., m:, m:]
        static = {"F(1)": F1, "-Y(1)": -Y1, "the static map of devices and walls": S1}
        return Demand(free, constant_like(G, np.diag(damping)), static, ("F(1)", "-Y(1)"))

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        """With the multiplier of its walls; without one as if they all touched, where it has some."""
        if multiplier is not None:
            return super().demand(loop, coupling, exact, multiplier)
        F = loop.F(coupling, exact)
        if exact:
            require_size(F.order)
        return this_environment_demand(F, loop)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """The most that any member asks."""
        if loop.environment.walls:
            return super().required(loop, coupling, multiplier)
        if loop.ranges is None:
            return this_environment(loop.F(coupling), loop)
        requirements = in_each(loop, coupling, loop.members())
        return requirements[worst(requirements)]

    def beyond(self, loop: Loop) -> str | None:
        if loop.environment.walls and loop.ranges:
            return "walls and ranges: walls are proved in one environment"
        return super().beyond(loop)

    def unknowns(self, loop: Loop) -> Unknowns | None:
        walls = len(loop.environment.walls)
        return Unknowns("g", (1.0,) * walls, f"a number > 0 for each of {walls} walls", 1e-3, 1e3) if walls else None

    def unsound_static(self, G: Lti, loop: Loop, asked: Demand[Lti]) -> str | None:
        """Rounding is relative to what each channel and wall is elsewhere: forces and ways have units of their own."""
        m, S1 = loop.channels, G.dc()
        own = np.abs([np.diag(part) for part in (S1, G.D, G.at(-1.0))]).max(axis=0)
        if (np.abs(S1 - S1.T) > _ROUNDING * np.sqrt(np.outer(own, own))).any():
            return "the static map of devices and walls is not symmetric: a slow closed path could extract energy"
        for name, part, size in (("F(1)", S1[:m, :m], own[:m]), ("-Y(1)", -S1[m:, m:], own[m:])):
            if np.linalg.eigvalsh((part + part.T) / 2).min() < -_ROUNDING * size.max():
                return f"{name} has a negative direction: it pushes outwards"
        return None

    def ratio(self, loop: Loop, coupling: Coupling, thin: int = 1) -> float:
        return ratio_in(loop, coupling, thin)

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        poles = loop.F(coupling).poles()
        return this_environment_ratios(lambda z: loop.late(loop.sent_at(coupling, z)), poles, loop)

    def words(self, loop: Loop) -> str:
        return MAKING if loop.environment.walls else super().words(loop)


THIS_ENVIRONMENT = ThisEnvironment()
_ROUNDING = 1e-9  # that a static map may miss of symmetry and of its signs


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """The this-environment condition of this coupling around each of the members, every one frozen."""
    return [_in_one(loop, coupling, member) for member in members]


def _in_one(loop: Loop, coupling: Coupling, member: Member) -> Requirement:
    try:
        F = loop.at(member.network).F(coupling)
    except SingularLoop as error:
        return refusal("this-environment", loop.delta, str(error))
    return this_environment(F, loop)


def worst(requirements: Sequence[Requirement]) -> int:
    """The member that requires the most damping."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


# ----------------------------------------------------------------------------------------------------
# Delays that switch within [lo, hi] at every tick and on every channel.


class SwitchingDelays(Multiplied):
    """Safe in the environment of the loop whatever its delays do within loop.delays."""

    name, covers = "switching", ("psi", "T_max", "varying_delay")

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        G = loop.sent(coupling, exact)
        if exact:
            require_size(G.order + sum(loop.delays.hi))
        return G

    def unknowns(self, loop: Loop) -> Unknowns:
        units = tuple((even_damping(loop) / loop.T * (_half_widths(loop) > 0)).tolist())
        return Unknowns("alpha", units, "a positive number where the delay varies and 0 elsewhere", 1e-8, 1e6)

    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        """[[this-environment - diag(alpha)/2, 0], [2 h G, 2 diag(alpha)]] for delays that switch within loop.delays.

        F = Theta_nom G with Theta_nom = (z^-lo + z^-hi)/2 and 2 h = hi - lo; G are the forces as they leave,
        alpha (m,) [N/m] is the multiplier, positive where the delay varies. Channels whose delay does not vary have no
        row and column of the second kind.

        A force that is late by n in [lo, hi] differs from the nominal one by at most h times the sum of the steps in
        between; the multiplier weighs that error against the displacement (an S-procedure, channel by channel).
        """
        T, m, lo, hi = G.T, loop.channels, loop.delays.lo, loop.delays.hi
        varying = [i for i in range(m) if lo[i] < hi[i]]
        a, one = numbers(multiplier, T), np.eye(m, dtype=int)
        half = Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))
        spread = Lti.constant(np.diag([q - p for p, q in zip(lo, hi, strict=True)])[varying], T)
        both: Any = as_like(G, vstack(half, spread)) @ G
        linear = this_environment_demand(both.rows(slice(None, m)), loop)
        if not varying:
            return linear
        upper = vstack(linear.free - np.diag(a / 2), both.rows(slice(m, None)))
        corner = np.vstack([0 * one[:, varying], np.diag(2 * a[varying])])
        free = hstack(upper, constant_like(G, corner))
        wide = np.eye(m, m + len(varying), dtype=int)
        return replace(linear, free=free, gain=np.transpose(wide) @ linear.gain @ wide)

    def usual(self, G: Lti, loop: Loop) -> Sequence[float]:
        """h times the largest own force of each device per displacement, best for springs; of many a share of it."""
        w, least = frequencies(G, points=60), 1e-8 * np.array(self.unknowns(loop).units)
        most = _half_widths(loop) * np.abs(np.diagonal(G.at(on_circle(w)), axis1=1, axis2=2)).max(axis=0)
        shares = _SHARES if 2 * loop.channels > _MOST_ROWS else (1.0,)
        tried = [np.maximum(share * most, least).tolist() for share in shares]
        return min(tried, key=lambda alpha: float(least_scale(self.block(G, loop, alpha), w).max()))

    def place(self, loop: Loop, matrix: str = "P") -> str:
        return f"{switching_guarantee(loop.delays)}: "


SWITCHING = SwitchingDelays()
_SHARES = tuple(2.0 ** (-k / 2) for k in range(10))  # the best one is taken


def _halves(lo: int, hi: int) -> list[Number]:
    return [Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)]


def _half_widths(loop: Loop) -> Array:
    """h = (hi - lo)/2, (m,)."""
    return (np.array(loop.delays.hi) - np.array(loop.delays.lo)) / 2


# ----------------------------------------------------------------------------------------------------
# Forces that leave through the limiter of controller.law. any-environment without delay in the environment needs no
# proof of its own: with rho = 0 the limiter and the environment together are a passive environment.

BETA = 0.01  # of a limiter's lag under this-environment unless another is asked for
_SPARE = 0.02  # of rho: what the block keeps, however large the damping, so that c may be rounded and the proof exact


@dataclass(frozen=True)
class LimitedForces(Multiplied):
    """this-environment also while forces are limited, by a limiter of lag rho = beta delta/T."""

    beta: float = BETA
    lags: int = 1  # weights c_ij per channel
    name, covers = "limiter", ("psi", "T_max")

    def __post_init__(self) -> None:
        if not 0 <= self.beta < np.inf:
            raise ValueError(f"limiter: beta is {self.beta}, expected a number >= 0")

    def rho(self, loop: Loop) -> tuple[float, ...]:
        """(m,) [N/m], to six digits, which the damping in a sweep does not scale."""
        return tuple(float(f"{self.beta * d / loop.T:.6g}") for d in loop.delta)

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        G = loop.sent(coupling, exact)
        if exact:
            require_size(G.order + 2 * loop.channels + sum(max(n, self.lags) for n in loop.theta))
        return G

    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        """The limiter's block on (dx - de, de), the steps of what the environment follows and of the slip.

        G are the forces as they leave without the limiter, rho its lag, which the damping does not scale, and c the
        multiplier. With df_e = G (dx - de) - rho (1 - 1/z) de, the steps of the limited forces, the block is
        [Theta/(z-1); N] df_e + s Delta_D/T [1, 0; 2, 1], where
        N_i = -(1 + .. + z^-theta_i) - sum_j c_ij (j + (j-1)/z + .. + z^-(j-1)).
        """
        theta, c, m, T = loop.theta, self.rows(loop, multiplier), loop.channels, G.T
        damping = np.diag(even_damping(loop, T) / T)
        lines = Lti.diag(*(_delay_and_weights(n, row, T) for n, row in zip(theta, c, strict=True)))
        lines = lines.rows([*range(0, 2 * m, 2), *range(1, 2 * m, 2)])
        difference = Lti.diag(*(taps([1, -1], T) for _ in theta))
        steps: Any = hstack(G, as_like(G, difference @ np.diag(-numbers(self.rho(loop), T))))
        both = as_like(G, lines) @ steps
        static, regular = both.rows(slice(None, m)).over_z_minus_one()  # [F(1), 0]: the slip's steps have no mean
        zero = np.zeros((m, m), dtype=int)
        free = vstack(regular, both.rows(slice(m, None)))
        gain = np.block([[damping, zero], [2 * damping, damping]])
        return Demand(free, constant_like(G, gain), {"F(1)": static[..., :m]}, ("F(1)",))

    def rows(self, loop: Loop, multiplier: Sequence[Any]) -> tuple[tuple[Any, ...], ...]:
        """c as a row per channel, of one entry per lag."""
        return tuple(tuple(multiplier[i * self.lags : (i + 1) * self.lags]) for i in range(loop.channels))

    def unknowns(self, loop: Loop) -> Unknowns:
        spare = tuple(_SPARE * r for r in self.rho(loop) * 2)
        units = (1.0,) * loop.channels * self.lags
        return Unknowns("c", units, "numbers >= 0, as many for each channel", 0.0, 10.0, spare)

    def usual(self, G: Lti, loop: Loop) -> Sequence[float]:
        return (0.0,) * loop.channels * self.lags

    def beyond(self, loop: Loop) -> str | None:
        if loop.varying_delay:
            return "limiter: forces that are limited are proved for constant delays, not for delays that switch"
        if loop.environment.walls:
            return "limiter: with walls only any-environment covers limited forces (no delay in the environment)"
        if loop.ranges:
            return "limiter: limited forces are proved for one environment, not for ranges"
        if loop.latency:
            return "limiter: limited forces are proved for forces that latch at ticks, not for a latency"
        return None

    def place(self, loop: Loop, matrix: str = "P") -> str:
        return "limiter: "


LIMITER = LimitedForces()


def _delay_and_weights(theta: int, c: Sequence[Any], T: Number) -> Lti:
    """[z^-theta; N] of one channel, over one line of delays."""
    lags = range(1, len(c) + 1)
    size = max(theta + 1, len(c))
    late = [int(k == theta) for k in range(size)]
    weights = [-sum([numbers(c[j - 1], T) * (j - k) for j in lags if j > k], int(k <= theta)) for k in range(size)]
    first, second = taps(late, T), taps(weights, T)
    return Lti(first.A, first.B, np.vstack([first.C, second.C]), np.vstack([first.D, second.D]), T)
