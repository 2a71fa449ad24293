"""The conditions this-environment and any-environment, and the search for the multipliers of their facts.

A **fact** is a property of the loop beyond a linear network with constant delays: walls, a limiter of the forces, or
delays that switch (design.facts). A **multiplier** consists of numbers that a proof may choose freely within bounds.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from haptic_loop.controller.arithmetic import SingularLoop, positive_definite
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Block, Lti
from haptic_loop.controller.ranges import Member
from haptic_loop.design import budgets
from haptic_loop.design.conditions import (
    BEYOND,
    Condition,
    any_environment,
    any_environment_demand,
    any_environment_per_channel,
    asymmetric,
    covers,
    delayed_environment_demand,
    least_scale,
    ratio_in,
    stacked_scales,
    this_environment,
    this_environment_demand,
    this_environment_ratios,
    uncovered,
    unsound,
    unsound_static,
)
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.coupling_file import Certificate
from haptic_loop.design.facts import (
    Demand,
    Fact,
    Limited,
    Switching,
    Unknowns,
    Walls,
    compose,
    compose_any,
    even_damping,
    even_level,
    hands_side,
)
from haptic_loop.design.files import InputError
from haptic_loop.design.frequency import (
    Response,
    frequencies,
    hermitian,
    largest_eigenvalue,
    on_circle,
    peaks,
    supremum,
)
from haptic_loop.design.lmi import RESERVE, unit_environment
from haptic_loop.design.result import (
    ANY,
    HERE,
    MAKING,
    DesignFailed,
    Environments,
    Infeasible,
    NotProved,
    Requirement,
    from_ratio,
    refusal,
    switching_guarantee,
)

# ----------------------------------------------------------------------------------------------------
# The search for the best multiplier. Let s be the required over the available damping. `Multiplied.block` is affine in
# s and in the multipliers. A semidefinite program (design.cone) imposes the block at finitely many frequencies and
# gives the least s over all multipliers within their bounds (`Unknowns`). This s is a lower bound of the required s. A
# sweep then finds frequencies at which the program's multiplier needs a larger s. These frequencies are added to the
# program until the sweep attains the lower bound, or a budget is spent.


class Multiplied(Condition):
    """A condition whose block is affine in multipliers, and which searches them. A subclass adds `map` and `block`."""

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        """Return the multipliers in the order in which `block` takes their numbers, or () for a block without any."""
        return tuple(each for part in (hands_side(loop), *self.facts(loop)) for each in part.unknowns(loop))

    @abstractmethod
    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        """Return the map G that `block` takes. Raises SingularLoop, and TooLong if `exact` and G is too large."""

    @abstractmethod
    def block(self, G: Block, loop: Loop, multiplier: Any = None, scaled: bool = False) -> Demand[Block]:
        """Return the block of a map G, in any arithmetic.

        If `scaled`, `multiplier` holds s times the multipliers of the hands' side, so that the block is affine in s and
        in all numbers of `multiplier`.
        """

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        """Return the facts that the block of this loop contains."""
        return ()

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        return self.block(self.map(loop, coupling, exact), loop, multiplier)

    def usual(self, G: Lti | None, loop: Loop) -> Sequence[float]:
        """Return the first multiplier of a search. A block that is too large for a search uses this multiplier."""
        return tuple(v for each in self.unknowns(loop) for v in (each.units if each.start is None else each.start))

    def named(self, loop: Loop, multiplier: Sequence[Any]) -> dict[str, Sequence[Any]]:
        """Return the values of each multiplier by name. Raises ValueError for a wrong number of values."""
        return named_parts(self.unknowns(loop), multiplier)

    def check(self, loop: Loop, multiplier: Sequence[Any]) -> None:
        """Raise ValueError unless the numbers are allowed as multipliers."""
        values = self.named(loop, multiplier)
        for each in self.unknowns(loop):
            each.check(values[each.name])
        if reason := hands_side(loop).excess(loop, values):
            raise ValueError(reason)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the requirement with this multiplier.

        If `multiplier` is None, the best multiplier is searched, and the result has the search's lower bound `bound`.
        """
        if reason := self.beyond(loop):
            return refusal(self.name, loop.delta, reason)
        if not self.unknowns(loop):
            return super().required(loop, coupling)
        try:
            with budgets.sweeping():
                return self.required_of(self.map(loop, coupling), loop, multiplier)
        except InputError:
            raise
        except ValueError as error:  # SingularLoop, TooLong, or a wrong multiplier
            return refusal(self.name, loop.delta, str(error))

    def required_of(self, G: Lti, loop: Loop, multiplier: Any = None) -> Requirement:
        """Return the requirement for the map G with this multiplier; None means the best one that a search finds."""
        unknowns, delta = self.unknowns(loop), loop.delta
        values = tuple(float(v) for v in (self.usual(G, loop) if multiplier is None else multiplier))
        self.check(loop, values)
        demand = self.is_demand(self.block(G, loop, values))
        if reason := unsound(demand.free, delta) or self.unsound_static(G, loop, demand):
            return replace(refusal(self.name, delta, reason), multiplier=values)
        search, bound = _Search(self, G, loop, demand), None
        if multiplier is None and search.pays:
            bound, values = search.best(values)
        ratio, w = search.swept(values)
        if np.isinf(ratio):
            names = ", ".join(each.name for each in unknowns)
            reason = f"no proof was found, for any damping and any multiplier {names}"
            return replace(refusal(self.name, delta, reason), multiplier=values)
        needed = from_ratio(self.name, max(ratio, 0.0), tuple(delta), w / (2 * np.pi * loop.T))
        return replace(needed, multiplier=values, bound=bound and min(bound, ratio))

    def unsound_static(self, G: Lti, loop: Loop, demand: Demand[Lti]) -> str | None:
        """Return the reason why a static matrix of the block is asymmetric or negative beyond rounding, or None."""
        return unsound_static(demand.free, demand, loop.delta)

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        if self.unknowns(loop):
            self.check(loop, multiplier or ())
        return super().exact_demands(loop, coupling, multiplier)

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        return {each.name: len(each.units) for each in self.unknowns(loop)}


def named_parts(unknowns: Sequence[Unknowns], values: Sequence[Any]) -> dict[str, Sequence[Any]]:
    """Return the values of each multiplier by name. Raises ValueError for a wrong number of values or equal names."""
    names = [each.name for each in unknowns]
    if len(set(names)) < len(names):
        raise ValueError(f"two multipliers have one name: {', '.join(names)}")
    ends = np.cumsum([0, *(len(each.units) for each in unknowns)]).tolist()
    if ends[-1] != len(values):
        expected = "; ".join(f"{each.name}: {each.expected}" for each in unknowns)
        raise ValueError(f"the multipliers have {len(values)} numbers, expected {ends[-1]} ({expected})")
    return {name: values[a:b] for name, (a, b) in zip(names, pairwise(ends), strict=True)}


_MOST_PEAKS = 3  # largest number of local maxima (`peaks`) whose frequencies are added in a round
_NEAR = 0.1  # A peak that is lower than the highest peak by more than this share is not added.
# A search ends when a refined sweep exceeds the bound by less than twice _SETTLED, relative to max(bound, 1).
_SETTLED = 5e-7
_DIGITS = 8  # significant digits of a multiplier
_NOTHING = 1e-6  # A number of a multiplier below this many units becomes 0 if its least allowed value is 0.


class _Search:
    """Search for the multiplier with the least required damping, by cutting planes."""

    def __init__(self, condition: Multiplied, G: Lti, loop: Loop, demand: Demand[Lti]) -> None:
        system, self._block, unknowns = demand.free, partial(condition.block, G, loop), condition.unknowns(loop)
        self._named, self._hands, self._loop = partial(condition.named, loop), hands_side(loop), loop
        self._names = ", ".join(each.name for each in unknowns)
        self._units = np.array([unit for each in unknowns for unit in each.units])
        self._searched = np.flatnonzero(self._units)  # The other numbers are always 0.
        bounds = [(each.least, each.most) for each in unknowns for _ in each.units]
        self._least, self._most = np.array(bounds).reshape(-1, 2)[self._searched].T
        self._last: tuple[Sequence[float], tuple[float, float]] | None = None  # last arguments and result of `swept`
        self._grid = np.concatenate([[0.0], frequencies(system)])
        self._spare = np.diag(np.zeros(system.outputs) if demand.spare is None else demand.spare)
        self._plain: list[Demand[Lti]] = []  # the block with all unknowns 0, then with each unknown alone at its unit
        self._root = np.ones(system.outputs)  # scales the rows of an inequality to about one
        self.pays = system.outputs <= budgets.MULTIPLIER_ROWS and self._searched.size > 0  # whether to search at all

    def swept(self, values: Sequence[float]) -> tuple[float, float]:
        """Return required over available damping with these values, and the binding frequency [rad/sample]."""
        if self._last is None or self._last[0] != values:
            demand = self._block(values)
            self._last = values, supremum(lambda w: least_scale(demand, w), self._grid)
        return self._last[1]

    def best(self, values: Sequence[float]) -> tuple[float, tuple[float, ...]]:
        """Return a lower bound of the ratio for all allowed multipliers, and the best multiplier of the search.

        The ratio is required over available damping. The search begins at `values`.
        """
        count, bound = self._searched.size, 0.0
        units = np.eye(self._units.size)[self._searched] * self._units
        self._plain = [self._block(tuple(x), scaled=True) for x in (0 * self._units, *units)]
        constant, by = (
            np.abs(np.diagonal(part, axis1=-2, axis2=-1)).max(axis=-2) for part in self._parts(self._grid[[0, -1]])
        )
        sizes = [by[-1], by.max(axis=0), constant, np.ones_like(constant)]  # The first nonzero size scales a row.
        self._root = 1 / np.sqrt(np.select([size > 0 for size in sizes], sizes))
        low = [Inequality.least([i], float(v)) for i, v in enumerate(self._least)]
        high = [Inequality.most([i], float(v)) for i, v in enumerate(self._most)]
        blocks = [*low, Inequality.least([count], 0.0), *high, *self._rooms(count)]
        top, w = self._worst(values, bound)
        best, least, stalled = values, top, 0
        for _ in range(budgets.MULTIPLIER_ROUNDS):
            if not w.size or stalled == budgets.MULTIPLIER_STALLED:
                break
            blocks.append(self._inequality(w))
            try:
                solution = ConeProgram(np.eye(count + 1)[-1], blocks).solve(f"the multiplier {self._names}")
            except DesignFailed:  # No multiplier within the bounds makes the block positive.
                break
            stalled = 0 if solution[-1] > bound + _SETTLED * max(bound, 1.0) else stalled + 1
            bound, values = max(bound, float(solution[-1])), self._values(solution)
            top, w = self._worst(values, bound)
            best, least = min((best, least), (values, top), key=lambda one: one[1])
        return bound, tuple(best)

    def _rooms(self, count: int) -> list[Inequality]:
        """Return the inequalities that the multipliers of the hands' side must satisfy (`HandsSide.room`)."""
        hands, values = self._hands, np.zeros(self._units.size)

        def room(j: int, x: Array) -> Array:
            values[self._searched] = x[:-1] * self._units[self._searched]
            return hands.room(self._loop, self._named(tuple(values)), x[-1])[j]

        rooms = len(hands.room(self._loop, self._named(tuple(values)), 1.0))
        return [Inequality.of(partial(room, j), range(count + 1)) for j in range(rooms)]

    def _values(self, x: Array) -> tuple[float, ...]:
        """Return the multiplier for the unknowns x, of which the last is s.

        The values are rounded to _DIGITS digits. Those of the hands' side are divided by s and scaled by `allowed`.
        """
        values, x, s = np.zeros(self._units.size), x[:-1], float(x[-1])
        x = np.where((self._least == 0) & (x < _NOTHING), 0.0, np.clip(x, self._least, self._most))
        values[self._searched] = [float(f"{v:.{_DIGITS}g}") for v in x * self._units[self._searched]]
        parts = self._named(values.tolist())
        for each in self._hands.unknowns(self._loop):
            parts[each.name] = [v / max(s, _NOTHING) for v in parts[each.name]]
        return tuple(v for part in self._hands.allowed(self._loop, parts).values() for v in part)

    def _worst(self, values: Sequence[float], bound: float) -> tuple[float, Array]:
        """Return the largest ratio with these values, and the frequencies [rad/sample] to add to the program.

        If the ratio is at the bound, no frequencies are returned. The margin `Demand.spare`, which allows the
        multiplier to be rounded, is subtracted from the block first.
        """
        demand = self._block(values)
        demand = replace(demand, free=demand.free - self._spare) if self._spare.any() else demand

        def needed(w: Array) -> Array:
            return least_scale(demand, w)

        w = peaks(needed, self._grid, -np.inf, near=_NEAR)
        at = needed(w)
        if (top := float(at.max(initial=-np.inf))) > bound + _SETTLED * max(bound, 1.0):
            return top, w[np.argsort(-at)[:_MOST_PEAKS]]
        most, between = peak = supremum(needed, self._grid)
        if not self._spare.any():
            self._last = tuple(values), peak
        return most, np.array([between] if most > bound + 2 * _SETTLED * max(bound, 1.0) else [])

    def _parts(self, w: Array) -> tuple[Any, Any]:
        """Return the constant of the block's Hermitian part at w (k,), and its coefficients of the unknowns and s."""
        z = on_circle(w)
        free = [hermitian(each.free.at(z)) for each in self._plain]
        return free[0] - self._spare, np.array([*(f - free[0] for f in free[1:]), hermitian(self._plain[0].gain.at(z))])

    def _inequality(self, w: Array) -> Inequality:
        constant, by = (self._root[:, None] * part * self._root for part in self._parts(w))
        return Inequality(constant, by, range(len(by)))


class ThisEnvironment(Multiplied):
    """Stability for every passive hand in the loop's own environment, which may have walls and delays that switch."""

    name, covers = "this-environment", BEYOND

    @property
    def extensible(self) -> bool:
        """Whether this is ThisEnvironment itself; `LimitedForces` and fast sweeps leave out the facts of a subclass."""
        return type(self) is ThisEnvironment

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        walls = (Walls(),) if loop.environment.walls else ()
        return (*walls, Switching()) if loop.varying_delay else walls

    def usual(self, G: Lti | None, loop: Loop) -> Sequence[float]:
        """Return the first values of each multiplier in a search.

        For the multiplier alpha of `Switching`, let a be half the width of a device's range of delays times the largest
        gain of the map G from its displacement to its force. With up to MULTIPLIER_ROWS/2 channels alpha is a. With
        more channels, alpha is the best of the products of a with each number of _SHARES.
        """
        usual = super().usual(G, loop)
        if not loop.varying_delay or G is None:
            return usual
        w, m = frequencies(G, points=60), loop.channels
        most = _half_widths(loop) * np.abs(np.diagonal(G.at(on_circle(w))[:, :m, :m], axis1=1, axis2=2)).max(axis=0)
        values, tried = self.named(loop, usual), []
        least = 1e-8 * np.array(values["alpha"])
        for share in _SHARES if 2 * m > budgets.MULTIPLIER_ROWS else (1.0,):
            values["alpha"] = np.maximum(share * -loop.per_device(-most), least).tolist()
            tried.append([v for part in values.values() for v in part])
        return min(tried, key=lambda values: float(least_scale(self.block(G, loop, values), w).max()))

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        G = loop.walled_before_delay(coupling, exact)
        if exact:
            budgets.require_size(G.order + sum(loop.delays.hi))
        return G

    def block(self, G: Block, loop: Loop, multiplier: Any = None, scaled: bool = False) -> Demand[Block]:
        values = self.named(loop, () if multiplier is None else multiplier)
        return compose(G, loop, self.facts(loop), values, scaled=scaled)

    def demand(self, loop: Loop, coupling: Coupling, exact: bool = False, multiplier: Any = None) -> Demand[Lti]:
        """Return the block. Without a multiplier, it has all walls in contact and constant delays."""
        if multiplier is not None or not self.extensible:
            return super().demand(loop, coupling, exact, multiplier)
        F = loop.F(coupling, exact)
        if exact:
            budgets.require_size(F.order)
        return this_environment_demand(F, loop)

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the largest requirement of all environments in ranges, with one multiplier for all of them."""
        if loop.ranges and self.unknowns(loop) and not self.beyond(loop):
            return self._of_members(loop, coupling, multiplier)
        if not self.extensible or self.unknowns(loop) or self.beyond(loop):
            return super().required(loop, coupling, multiplier)
        if loop.ranges is None:
            return this_environment(loop.F(coupling), loop)
        requirements = in_each(loop, coupling, loop.members())
        return requirements[worst(requirements)]

    def _of_members(self, loop: Loop, coupling: Coupling, multiplier: Any) -> Requirement:
        """Return the largest requirement of all environments in ranges with `multiplier`.

        If `multiplier` is None, two multipliers are tried, and the smaller result is returned. One is `usual`. The
        other is the best multiplier for the environment that requires the most damping with `usual`.
        """
        loops = [loop.at(member.network) for member in loop.members()]

        def most(values: Any) -> tuple[Requirement, Loop]:
            each = [super(ThisEnvironment, self).required(one, coupling, values) for one in loops]
            i = worst(each)
            return each[i], loops[i]

        if multiplier is not None:
            return most(multiplier)[0]
        usual, hardest = most(self.usual(None, loop))
        best, _ = most(super().required(hardest, coupling).multiplier)
        return min(usual, best, key=lambda requirement: requirement.ratio)

    def unsound_static(self, G: Lti, loop: Loop, demand: Demand[Lti]) -> str | None:
        """Return the reason why a static map is asymmetric or negative, or None.

        The inputs of channels and of walls have different units. So the asymmetry of an entry is compared with the
        sizes of its row and of its column. A negative eigenvalue of a diagonal block is compared with the largest size
        in this block.
        """
        if not loop.environment.walls:
            return super().unsound_static(G, loop, demand)
        m, S1 = loop.channels, G.dc()
        own = np.abs([np.diag(part) for part in (S1, G.D, G.at(-1.0))]).max(axis=0)
        if (np.abs(S1 - S1.T) > _ROUNDING * np.sqrt(np.outer(own, own))).any():
            return "the static map of devices and walls is not symmetric: a slow closed path could extract energy"
        for name, part, size in (("F(1)", S1[:m, :m], own[:m]), ("-Y(1)", -S1[m:, m:], own[m:])):
            if np.linalg.eigvalsh((part + part.T) / 2).min() < -_ROUNDING * size.max():
                return f"{name} has a negative direction: it pushes outwards"
        return None

    def ratio(self, loop: Loop, coupling: Coupling) -> float:
        quick = self.extensible and not loop.varying_delay  # `ratio_in` ignores delays that switch.
        return ratio_in(loop, coupling) if quick else super().ratio(loop, coupling)

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        """Return required over available damping (n,) for constant delays and touching walls; None for a subclass."""
        if not self.extensible:
            return None
        poles = loop.F(coupling).poles()
        return this_environment_ratios(lambda z: loop.late(loop.sent_at(coupling, z)), poles, loop)

    def place(self, loop: Loop, matrix: str = "P") -> str:
        member = super().place(loop, matrix)
        return f"{switching_guarantee(loop.delays)}: {member}" if loop.varying_delay else member

    def words(self, loop: Loop) -> str:
        return MAKING if loop.environment.walls and not loop.ranges else super().words(loop)


THIS_ENVIRONMENT = ThisEnvironment()
_ROUNDING = 1e-9  # allowed relative asymmetry and negativity of a static map with walls


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """Return the requirement of this-environment for each member of ranges, for constant delays and touching walls."""
    requirements = []
    for member in members:
        try:
            requirements.append(this_environment(loop.at(member.network).F(coupling), loop))
        except SingularLoop as error:
            requirements.append(refusal("this-environment", loop.delta, str(error)))
    return requirements


def worst(requirements: Sequence[Requirement]) -> int:
    """Return the index of the requirement with the largest ratio."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


class SwitchingDelays(ThisEnvironment):
    """The condition this-environment for delays that switch. Reports list it as "switching"."""

    name, covers = "switching", BEYOND

    @property
    def base(self) -> str:
        return ThisEnvironment.name if self.name == SwitchingDelays.name else self.name

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return (*super().facts(loop.switching(None)), Switching())


SWITCHING = SwitchingDelays()
_SHARES = tuple(2.0 ** (-k / 2) for k in range(10))  # factors of alpha that `ThisEnvironment.usual` tries


def _half_widths(loop: Loop) -> Array:
    """Return half the width (hi - lo)/2 of each channel's range of delays, (m,) [samples]."""
    return (np.array(loop.delays.hi) - np.array(loop.delays.lo)) / 2


# ----------------------------------------------------------------------------------------------------
# The condition "limiter": forces pass through the limiter of controller.law. If psi = 0, any-environment covers limited
# forces without this condition. The limiter then has rho = 0 (docs/theory.md).

BETA = 0.01  # default of beta: rho of a limiter, relative to the least eigenvalue of the device's damping over T


@dataclass(frozen=True)
class LimitedForces(ThisEnvironment):
    """The condition this-environment for forces that a limiter limits.

    The limiter of device i has the stiffness rho_i = beta lambda_min(Delta_i)/T [N/m], with the least eigenvalue
    lambda_min of the device's damping Delta_i.
    """

    beta: float = BETA
    lags: int = 1  # number of weights c_ij per device
    held: tuple[float, ...] | None = None  # rho [N/m] per device that a certificate states; None computes it from beta
    name, covers = "limiter", BEYOND

    def __post_init__(self) -> None:
        if not 0 <= self.beta < np.inf:
            raise ValueError(f"limiter: beta is {self.beta}, expected a number >= 0")
        if self.held is not None and not all(0 < r < np.inf for r in self.held):
            raise ValueError(f"limiter: rho is {list(self.held)}, expected positive numbers in N/m")

    def rho(self, loop: Loop) -> tuple[float, ...]:
        """Return rho [N/m] per device: `held`, or the rho of beta, rounded to six digits."""
        return self.held or tuple(float(f"{self.beta * d / loop.T:.6g}") for d in loop.least_damping)

    @property
    def base(self) -> str:
        return ThisEnvironment.name if self.name == LimitedForces.name else self.name

    def limiter_rho(self, loop: Loop) -> tuple[float, ...] | None:
        return loop.per_channel(self.rho(loop))

    def parameters(self, loop: Loop) -> dict[str, tuple[float, ...]]:
        return {"rho": self.rho(loop)}

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return (*super().facts(loop), Limited(self.rho(loop), self.lags))

    def rows(self, loop: Loop, multiplier: Sequence[Any]) -> tuple[tuple[Any, ...], ...]:
        """Return the limiter's weights c (devices, lags), the last numbers of `multiplier`."""
        devices = len(loop.devices)
        c = tuple(multiplier)[len(multiplier) - devices * self.lags :] if multiplier else ()
        return tuple(c[i * self.lags : (i + 1) * self.lags] for i in range(devices))

    def not_designed(self, loop: Loop) -> str | None:
        """Return the reason why this loop has no design for limited forces, or None."""
        if loop.varying_delay:
            return "limiter: designs for limited forces are made for constant delays, not for delays that switch"
        if loop.environment.walls or loop.latency:
            obstacle = "walls" if loop.environment.walls else "a latency"
            return f"limiter: designs for limited forces are made in linear environments without {obstacle}"
        if loop.ranges:
            return "limiter: designs for limited forces are made for one environment, not for ranges"
        return self.beyond(loop)

    def place(self, loop: Loop, matrix: str = "P") -> str:
        return f"limiter: {switching_guarantee(loop.delays)}: " if loop.varying_delay else "limiter: "


LIMITER = LimitedForces()


def beta_of(loop: Loop, certificate: Certificate) -> float:
    """Return beta of the limiter that a certificate covers; BETA if it covers no limiter or if beta is above 1."""
    rho, share = certificate.multipliers.get("rho", ()), loop.least_damping[0] / loop.delta[0]
    beta = float(f"{rho[0] * loop.T / (certificate.available[0] * share):.6g}") if rho else BETA
    return beta if 0 < beta <= 1 else BETA


# ----------------------------------------------------------------------------------------------------
# The condition any-environment (Theorem 4). An environment with a delay psi >= 1 is not passive. The diagonal
# multiplier Phi [N s/m] is the damping that makes it passive: E-hat + Phi is passive (17).


_ROOM = 1e-6  # increase of Phi, relative to the damping, that covers the solver's tolerance


def least_phi(loop: Loop) -> Array | None:
    """Return a small Phi (m,) [N s/m] that is verified, or None for psi = 0, which needs no Phi.

    E-hat + Phi is passive at all frequencies, and Phi is below Delta_D. Raises Infeasible or DesignFailed if no such
    Phi is found.
    """
    if not any(loop.psi):
        return None
    phi = least_multiplier(loop) + _ROOM * even_damping(loop)
    if not positive_definite(even_level(loop) - np.diag(phi)):
        why = f"the multiplier Phi = {phi.tolist()} is not below the damping: with psi = {loop.psi} no damping is left"
        raise DesignFailed(None, (), f"{why} for a coupling")
    if not covers(loop, phi):
        raise DesignFailed(None, (), f"E-hat + Phi may not be passive at some frequency for Phi = {phi.tolist()}")
    return phi


def least_multiplier(loop: Loop) -> Array:
    """Return a diagonal Phi (m,) [N s/m] with E-hat + Phi passive and Phi < Delta_D, within the solver's tolerance.

    Delta_D and delta are multiplied by T/T_max. Phi stays below a level that leaves damping for the coupling. Among
    all such Phi, it has the least sum of Phi_i/delta_i.

    Raises:
        Infeasible: No such Phi exists. If no full matrix Phi exists either, the message states the damping needed.
        DesignFailed: No diagonal Phi was found.
    """
    delta = even_damping(loop)
    unit = unit_environment(loop.E(), delta)
    none, level = np.zeros(loop.channels), even_level(loop) / np.sqrt(np.outer(delta, delta))  # level_ii = 1
    root = np.linalg.inv(np.linalg.cholesky(level))
    least, _ = uncovered(root @ unit @ root.T, loop.psi, none)  # the least multiple of `level` that suffices
    if least >= 1:
        raise Infeasible(None, (), _needs(loop.psi, delta, least))
    regular = delayed_environment_demand(delay(loop.psi, 1.0) @ unit, none).free
    # Without an upper limit, the Phi of least trace may reach Delta_D and leave no damping for the coupling. So Phi
    # stays below a level halfway between the least multiple of Delta_D that suffices and Delta_D.
    return _of_least_trace(regular, (1 + least) / 2 * level) * delta


_PROBLEM = "the multiplier Phi of the environment"


def _of_least_trace(regular: Lti, most: Array) -> Array:
    """Return the entries (m,) >= 0 of a diagonal Phi <= most (m, m) with small trace, by cutting planes over frequency.

    A sweep shows that `regular` + Phi is passive. Phi exceeds `most` by at most _ROOM. Raises Infeasible or
    DesignFailed.
    """
    m, grid = regular.inputs, np.concatenate([[0.0], frequencies(regular)])
    blocks = [Inequality.least(range(m), 0.0), Inequality.of(lambda x: most - np.diag(x), range(m))]
    w = grid[[0, -1]]
    for _ in range(budgets.MULTIPLIER_ROUNDS):
        response = hermitian(regular.at(on_circle(w)))
        entries = (np.eye(m)[:, None, :, None] * np.eye(m)).astype(complex)
        blocks.append(Inequality(response, np.repeat(entries, w.size, axis=1), range(m)))
        phi = ConeProgram(np.ones(m), blocks).solve(_PROBLEM)

        def short(w: Array, phi: Array = phi) -> Array:
            return largest_eigenvalue(-hermitian(regular.at(on_circle(w))) - np.diag(phi))

        shortage, worst = supremum(short, grid)
        if shortage <= _ROOM:
            return np.maximum(phi, 0.0) + max(shortage, 0.0)
        w = np.append(peaks(short, grid, -np.inf, near=_NEAR)[-_MOST_PEAKS:], worst)
    raise DesignFailed(None, (), f"{_PROBLEM} was not found within {budgets.MULTIPLIER_ROUNDS} rounds")


def _needs(psi: Sequence[int], delta: Array, least: float) -> str:
    required = ", ".join(f"{least * d:.4g}" for d in delta)
    return (
        f"Theorem 4 admits no coupling: with psi = {psi} the environment alone uses up {required} N s/m of device "
        f"damping, and delta (times T/T_max if periods vary) is {tuple(delta.tolist())}"
    )


class _AnyEnvironment(Multiplied):
    """The condition of the paper's Theorem 4 for stability with every passive hand.

    For psi = 0 it holds in every passive environment, and it covers walls, a latency and switching delays. For psi >= 1
    it holds in the loop's environment only and has the multiplier Phi (m,) [N s/m].
    """

    name, source = "any-environment", "the paper's Theorem 4"
    covers = BEYOND

    @property
    def _extended(self) -> bool:
        """Whether this is a user's subclass. Only the block of `compose_any` contains its facts."""
        return type(self) is not _AnyEnvironment

    def _in_frame(self, loop: Loop) -> bool:
        """Return whether `compose_any` builds the block. It does so for a latency, switching delays, a user's class."""
        return bool(self._extended or loop.latency or loop.varying_delay)

    def separable(self, loop: Loop) -> bool:
        # Matrix levels couple the axes of a device, and so do multipliers of a latency or of delays that switch.
        return not self._extended and not loop.levels and not (loop.axes and self.unknowns(loop))

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        return (Switching(),) if loop.varying_delay else ()

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        V = coupling.compliance(loop.period(exact))
        assert V is not None  # `required` refuses a coupling without V.
        if exact:
            budgets.require_size(V.order + sum(loop.delays.hi))
        return V

    def block(self, G: Block, loop: Loop, multiplier: Any = None, scaled: bool = False) -> Demand[Block]:
        if not self._in_frame(loop):
            return any_environment_demand(G, loop, multiplier)
        values = self.named(loop, () if multiplier is None else multiplier)
        return compose_any(G, loop, self.facts(loop), values, scaled)

    def least_multiplier(self, loop: Loop) -> tuple[Array | None, str | None]:
        if (reason := self.beyond(loop)) or not any(loop.psi):
            return None, reason
        try:
            return least_phi(loop), None
        except ValueError as error:
            return None, " ".join(str(error).split())

    def beyond(self, loop: Loop) -> str | None:
        if loop.environment.walls and any(loop.psi):
            return "with delay in the environment the condition covers no walls"
        if self._in_frame(loop) and any(loop.psi):
            obstacle = (
                "latency" if loop.latency else "delays that switch" if loop.varying_delay else "facts of your own"
            )
            return f"with delay in the environment the condition covers no {obstacle}"
        return None if any(loop.psi) else super().beyond(loop)

    def not_varied(self, loop: Loop) -> str | None:
        many = "with psi >= 1 each K, T and delay needs its own multiplier, which is not searched here"
        return many if any(loop.psi) else None

    def over_frequency(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Response | None:
        V = coupling.compliance(loop.T)
        if V is None or (multiplier is None and any(loop.psi)):
            return None
        return partial(least_scale, self.block(V, loop, self.usual(None, loop) if multiplier is None else multiplier))

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        """Return required over available damping (n,); None as the multiplier means the first one of a search."""
        count = len(coupling.sampled(np.array([[1j]]), loop.T).G)
        values = self.usual(None, loop) if multiplier is None else multiplier
        poles = np.zeros((count, 0), dtype=np.complex128)  # The grid resolves no poles of V.
        return stacked_scales(
            lambda z: self.block(coupling.sampled(z, loop.T), loop, values), poles, max(loop.delays.hi)
        )

    def _without(self, coupling: Coupling) -> str:
        if coupling.holds_model:
            return "the coupling contains a model of the environment; Theorem 4 covers only couplings without one"
        return "Theorem 4 needs a coupling with a compliance V(z), and the loop has none"

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the requirement with this multiplier.

        If `multiplier` is None, it is `least_phi` for psi >= 1, and the best multiplier that a search finds for psi =
        0.
        """
        reason, V = self.beyond(loop), coupling.compliance(loop.T)
        if reason or V is None:
            return refusal(self.name, loop.delta, reason or self._without(coupling), applies=False)
        if self._in_frame(loop):
            return self._composed_requirement(V, loop, multiplier)
        if not any(loop.psi):
            channels = coupling.channels(loop.T) if self.separable(loop) else None
            if channels:
                return any_environment_per_channel(channels, loop)
            return any_environment(V, loop)
        if multiplier is None:
            multiplier, reason = self.least_multiplier(loop)
        if multiplier is None:
            return refusal(self.name, loop.delta, str(reason))
        if len(multiplier) != loop.channels:
            raise NotProved("any-environment with psi >= 1 needs a multiplier Phi, one entry per channel")
        requirement = any_environment(V, loop, np.array([float(p) for p in multiplier]))
        return replace(requirement, multiplier=tuple(multiplier))

    def _composed_requirement(self, V: Lti, loop: Loop, multiplier: Any) -> Requirement:
        needs = self.required_of(V, loop, multiplier)
        if multiplier or loop.latency or needs.certified or self._extended:
            return needs
        spans = [(loop.delays.lo[own.start], loop.delays.hi[own.start]) for own in loop.devices]
        mean = [float(np.mean(even_damping(loop)[own])) * (1 - RESERVE) / loop.T for own in loop.devices]
        alpha = [float(f"{stiffest_alpha(*span, d):.10g}") for span, d in zip(spans, mean, strict=True)]
        closed = self.required_of(V, loop, alpha)  # The search may miss this alpha near the stiffest coupling.
        return min(needs, replace(closed, bound=needs.bound), key=lambda requirement: requirement.ratio)

    def unsound_static(self, G: Lti, loop: Loop, demand: Demand[Lti]) -> str | None:
        return asymmetric(demand.static["V(1)"])

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        if not any(loop.psi):
            return super().exact_demands(loop, coupling, multiplier)
        T = loop.period(exact=True)
        V = coupling.compliance(T)
        assert V is not None
        budgets.require_size(V.order + sum(loop.theta))
        delayed = delay(loop.psi, T) @ loop.E(exact=True)
        return {
            "P": self.block(V, loop, multiplier),
            "P_E": delayed_environment_demand(delayed, multiplier),
        }

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        return {"Phi": loop.channels} if any(loop.psi) else super().multiplier_sizes(loop)

    def members(self, loop: Loop) -> tuple[Member, ...]:
        return ()

    def limiter_rho(self, loop: Loop) -> tuple[float, ...] | None:
        return None if any(loop.psi) or self._extended else (0.0,) * loop.channels

    def guarantee(self, loop: Loop) -> Environments:
        return HERE if any(loop.psi) else ANY


ANY_ENVIRONMENT = _AnyEnvironment()


def stiffest_alpha(lo: int, hi: int, damping: float) -> float:
    """Return the multiplier alpha [N/m] of `Switching` that admits the stiffest coupling for any environment.

    The delay switches between lo and hi [samples], and `damping` is delta/T [N/m]. This alpha minimises the mean over
    frequency of |vt|^2/(4 (damping - alpha/2)) + h^2/(2 alpha) with h = (hi - lo)/2. Here vt is the mean of the windows
    1 + 1/z + .. + z^-n for n = lo and n = hi (docs/theory.md, "Facts that hold together").
    """
    half = (hi - lo) / 2
    return 2 * half * damping / (np.sqrt(lo + 1 + half / 2) + half)
