"""The optimal coupling: the force filter R of least mismatch whose loop keeps a condition, with an exact proof.

In F = Theta R Psi E everything is affine in R, and R = kappa I keeps every condition for a small kappa: there is always
an answer. With R(1) = g I the static stiffness F(1) = g E(1) is symmetric whatever the environment's springs are.
The basis of R grows rung by rung; each rung is solved by a barrier, scaled until a refined sweep passes, rounded to
decimals and proved in exact arithmetic before the next is tried. The best one that is proved is returned.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np
import scipy  # its parts load when they are used
from numpy.typing import NDArray

from controller.coupling import NO_PAIRS, Coupling, ForceFilter, NoCoupling, basis
from controller.delay import delay
from controller.environment import Network, Ranges, UncertainSpring
from controller.loop import DelayRange, Loop
from controller.lti import Array, Complex, Lti, Sampled, as_like
from design.barrier import Block, Program, centre, towards
from design.certificate import prove, prove_limiter
from design.conditions import Demand, even_damping, least_multiple, this_environment_demand
from design.conditions import this_environment as requirement_of
from design.environments import Searched, in_each, search_ranges, worst
from design.frequency import frequencies, hermitian, on_circle, peaks, supremum
from design.multipliers import (
    BETA,
    SPARE,
    limiter_demand,
    limiter_lag,
    limiter_refusal,
    limiter_requirement,
    switching_block,
)
from design.result import Design, DesignFailed, NotProved, number, one_of
from design.stored import Certificate, LimiterCertificate
from design.transparency import BAND_HZ, Transparency, decibels, transparency

OBJECTIVES = ("rms", "sup")
_MARGIN = 0.002  # share of the damping that stays unused: what an exact proof always finds room in
LADDER = ((4, 3), (8, 6), (14, 10), (22, 16))  # taps and real poles of the rungs
_SETTLED_DB = 0.05  # a rung that gains less ends the climb
_FEWEST_RUNGS = 3
_FASTEST, _SLOWEST = 0.5, 0.008  # distance to 1 of the real poles' ends
_FASTER = 0.25  # modes of smaller radius are left to the filter of the sum of all forces
_SLOWER = 0.999  # modes of larger radius get no section
_RICH, _RIPPLED = 2, 14  # channels up to which, and taps from which on, there are sections within the band
_RIPPLES, _RIPPLE_DAMPING = (
    (0.1, 0.215, 0.464, 1.0),
    0.1,
)  # their frequencies beside the band's end, their damping ratio
_FULL = 4  # channels up to which every force has a filter to every device
_STATIC, _STATIC_OF_MANY = 0.2, 0.35  # weight of g - 1 beside the relative mismatch; for more than RICH channels
_HIGH_HZ = 100.0  # above it the force is kept low by a soft row, or capped
_SOFT = 0.05, 0.3  # the soft row's weight: the first number times the mismatch so far, which counts up to the second
_LAGS = ((BETA, 0.05), (0.1, 0.5), (0.5, 2.0))  # (beta, c) of a limiter to begin with: without psi the first alone
_HOPELESS = 0.9  # relative mismatch from which on the climb is compared with other couplings
_TOLERATED = 0.02  # by which a further environment may be short before it enters the design: scaling does the rest
_MOST_STATES = 200  # of the loop, up to which a rung is tried: half a minute with five devices
_MOST_WORK = 7e6  # (channels x unknowns)^2 up to which a rung is tried
_SMALL = 1e-5  # weight of the coefficients themselves: some have no effect where the environment has no inverse
_DECIMALS = 10
_GAPS = (0.05, 0.01)  # of the objective, or of what it gains over no force: gaps at which the inequalities are swept
_FORGIVEN = 5e-4  # by which an inequality may fail between its frequencies: scaling makes up for it
_MOST_SWEEPS = 6
_STEEPER = 3.0  # factor between one centre of the barrier and the next
_SMALLEST = 1e-4  # least frequency of an inequality [rad/sample]: below it nothing changes


@dataclass(frozen=True, eq=False)
class _Constraint:
    """A linear matrix inequality that the forces G = R Psi E as they leave are to keep at every frequency.

    `block` is a condition's own statement, He[block(G, x)] > 0, affine in G and in own unknowns x together.
    """

    name: str
    block: Callable[[Sampled, Array], Sampled]
    unit: Array  # (r,) rows and columns of the block are scaled by it, so that its eigenvalues count in one measure
    low: float = _SMALLEST  # [rad/sample]
    high: float = np.pi
    start: tuple[float, ...] = ()  # own unknowns for which R = kappa I is strictly feasible for a small kappa
    cost: tuple[float, ...] = ()  # of the own unknowns in the objective

    def at(self, G: Sampled, own: Array) -> Complex:
        """The scaled matrices, (n, k, r, r)."""
        return hermitian(self.unit[:, None] * self.block(G, own).G * self.unit)


@dataclass(frozen=True)
class Options:
    """What is asked of an optimal coupling beside its loop. Raises ValueError naming the field that is wrong."""

    objective: Literal["rms", "sup"] = "rms"  # of the mismatch relative to the environment, over the band
    band_hz: tuple[float, float] = BAND_HZ
    high_gain: float | None = None  # largest |F|/|E| above 100 Hz; None: kept low by a soft row
    limiter: bool = False  # covered also while forces are limited
    seconds: float = 60.0  # no rung is begun later than this; the sizes of rungs end most climbs far earlier
    margin: float = _MARGIN  # share of the damping that stays unused
    ladder: tuple[tuple[int, int], ...] = LADDER  # (taps, real poles)

    def __post_init__(self) -> None:
        one_of("objective", self.objective, OBJECTIVES)
        number("seconds", self.seconds)
        if self.high_gain is not None and not 1 <= number("high_gain", self.high_gain) < np.inf:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not 0 < self.margin < 1:
            raise ValueError(f"margin is {self.margin}, allowed are shares of the damping above 0 and below 1")
        if not 0 < self.band_hz[0] < self.band_hz[1]:
            raise ValueError(f"band_hz is {self.band_hz}, expected two rising frequencies in Hz")
        if not self.ladder or any(taps < 1 or poles < 0 for taps, poles in self.ladder):
            raise ValueError(f"ladder is {self.ladder}, expected pairs of taps (1 or more) and poles (0 or more)")


@dataclass(frozen=True)
class _Rung:
    """One step of the climb."""

    taps: int
    poles: int
    states: int  # of the loop
    mismatch_db: float  # what was minimised
    g: float  # rendered share of the static stiffness
    reason: str | None  # why it is not certified and proved
    seconds: float  # since the design began

    @property
    def proved(self) -> bool:
        return self.reason is None


@dataclass(frozen=True, eq=False)
class Optimal(Design):
    """The best coupling that is proved, with the climb that led to it."""

    figures: Transparency = field(kw_only=True)
    g: float = field(kw_only=True)  # F(1) = g E(1); of another kind than a force filter the ratio of their norms
    states: int = field(kw_only=True)  # of the loop
    certificate: Certificate | None = field(kw_only=True)  # of the loop with its ranges and its switching delays
    ladder: tuple[_Rung, ...] = field(kw_only=True, default=())
    reason: str | None = field(kw_only=True, default=None)  # why nothing is proved, where nothing is
    searched: Searched | None = field(kw_only=True, default=None)  # between the vertices of ranges

    @property
    def proved(self) -> bool:
        return self.certificate is not None


_Progress = Callable[[_Rung], None]
_ForEach = Callable[[Loop], _Constraint]  # a constraint in one environment


# what is asked --------------------------------------------------------------------------------------------------------


def this_environment(loop: Loop, margin: float = _MARGIN) -> _Constraint:
    """design.conditions.this_environment_demand with this share of the damping unused, in units of Delta/T."""

    def block(G: Sampled, own: Array) -> Sampled:
        demand = _demand(loop, _late(loop, G))
        return demand.free + demand.gain * (1 - margin)

    gain = _demand(loop, Lti.constant(np.zeros((loop.channels, loop.channels)), loop.T)).gain
    return _Constraint("this-environment", block, 1 / np.sqrt(np.diag(gain.D)))


def _demand(loop: Loop, F: Any) -> Demand[Any]:
    return this_environment_demand(F, loop.delta, loop.T_max, loop.latency)


def switching(loop: Loop, span: DelayRange, margin: float = _MARGIN) -> _Constraint:
    """design.multipliers.switching_block for delays that switch within the span; alpha T/Delta are its unknowns."""
    scale = even_damping(loop.delta, loop.T, loop.T_max) / loop.T
    moves = np.flatnonzero(np.asarray(span.hi) - np.asarray(span.lo))

    def block(G: Sampled, own: Array) -> Sampled:
        alpha = np.zeros(scale.size)
        alpha[moves] = own * scale[moves]
        usable = [(1 - margin) * d for d in loop.delta]
        return switching_block(G, span.lo, span.hi, usable, alpha.tolist(), loop.T_max)[0]

    unit = 1 / np.sqrt(np.concatenate([scale, scale[moves]]))
    return _Constraint("switching delays", block, unit, start=(0.5,) * moves.size, cost=(0.0,) * moves.size)


@dataclass(frozen=True)
class _Slip:
    """The limiter's lag and multiplier: its block is affine in the forces for given ones."""

    beta: float  # rho = beta delta/T
    c: tuple[tuple[float, ...], ...]  # (m, lags)

    @classmethod
    def even(cls, loop: Loop, beta: float, c: float) -> _Slip:
        return cls(beta, ((c,),) * loop.channels)


def limiter(loop: Loop, slip: _Slip, margin: float = _MARGIN) -> _Constraint:
    """design.multipliers.limiter_demand: forces that are limited. A little of rho stays unused, as of the damping."""
    rho = limiter_lag(loop.delta, loop.T, slip.beta)
    spare = np.diag([*rho, *rho]) * SPARE

    def block(G: Sampled, own: Array) -> Sampled:
        demand = limiter_demand(G, loop.theta, loop.delta, rho, slip.c, loop.T_max)
        return demand.free + demand.gain * (1 - margin) - spare

    return _Constraint("limiter", block, np.tile(1 / np.sqrt(even_damping(loop.delta, loop.T, loop.T_max) / loop.T), 2))


def _most_gain(loop: Loop, cap: float) -> _Constraint:
    """|F| < cap |E| above 100 Hz."""
    E = loop.E()

    def block(G: Sampled, own: Array) -> Sampled:
        return _within(_late(loop, G), E.at(G.z), cap)

    low = min(2 * np.pi * _HIGH_HZ * loop.T, np.pi)
    return _Constraint("high-frequency gain", block, np.ones(2 * E.inputs), low=low)


def _worst_mismatch(loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> _Constraint:
    """|F - Lambda E| < tau |E| over the band, with tau its own unknown and its cost."""
    E = loop.E()

    def block(G: Sampled, own: Array) -> Sampled:
        return _within(_late(loop, G) - as_like(G, delay(loop.lam, loop.T) @ E), E.at(G.z), own[0])

    low, high = _band(loop, band_hz)
    return _Constraint("mismatch", block, np.ones(2 * E.inputs), low, high, start=(2.0,), cost=(1.0,))


def _late(loop: Loop, G: Sampled) -> Sampled:
    """F = Theta G."""
    return as_like(G, delay(loop.theta, loop.T)) @ G


def _within(M: Sampled, E: Complex, cap: float) -> Sampled:
    """A block whose Hermitian part is [[cap I, M/|E|], [., cap I]]: |M| < cap |E| in the largest singular value."""
    m = M.G.shape[-1]
    S = np.zeros((*M.G.shape[:-2], 2 * m, 2 * m), dtype=complex)
    S[..., np.arange(2 * m), np.arange(2 * m)] = cap
    S[..., :m, m:] = 2 * M.G / np.linalg.norm(E, 2, axis=(-2, -1))[..., None, None]
    return Sampled(M.z, S, M.T)


# the basis -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Span:
    """The functions of R, and which of them have a coefficient where: unknowns are g and R_1, R_2, .. there."""

    poles: Array  # (n,)
    pairs: Array  # (p, 2)
    used: NDArray[np.bool_]  # (n + 2 p, m, m or m + 1)

    @property
    def unknowns(self) -> int:
        return 1 + int(self.used.sum())

    def responses(self, z: Complex) -> Complex:
        """b_k(z) - 1 for k >= 1, shape (k, n + 2 p): what stays when R_0 = g I less the others."""
        return basis(self.poles, z, self.pairs)[:, 1:] - 1

    def sources(self) -> Array:
        """The filtered signals as rows over the forces, (m or m + 1, m)."""
        m, columns = self.used.shape[1:]
        return np.vstack([np.eye(m), np.ones((columns - m, m))])

    def matrices(self, x: Array) -> Array:
        """R_1, R_2, .. of the unknowns, (n + 2 p, m, m or m + 1)."""
        R = np.zeros(self.used.shape)
        R[self.used] = x[1 : self.unknowns]
        return R

    def filter(self, x: Array, scale: float = 1.0) -> ForceFilter:
        """The force filter in decimals: R_0 is what is missing to exactly g I."""
        unit = 10**_DECIMALS
        later = np.array([round(v * unit) for v in (scale * self.matrices(x)).ravel().tolist()], dtype=object)
        later = later.reshape(self.used.shape)
        m = self.used.shape[1]
        first = -later.sum(axis=0) if len(later) else np.zeros(self.used.shape[1:], dtype=object)
        first[np.arange(m), np.arange(m)] += round(max(scale * x[0], 0.0) * unit)
        R = np.concatenate([first[None], later])
        return ForceFilter(self.poles, self.pairs, np.array([int(v) / unit for v in R.flat]).reshape(R.shape))

    def chain(self, T: float) -> Lti:
        """A block with the poles of the basis."""
        one = np.append(np.zeros(len(self.used)), 1.0)[:, None, None]  # the last function has every section
        return ForceFilter(self.poles, self.pairs, one).filter(T)


def span_of(E: Lti, taps: int, poles: int) -> Span:
    """Taps, real poles even in the logarithm of the time constant, and the modes of E and of its inverse.

    Poles are decimals from the start. With more than FULL channels every device has a filter of its own force and one
    of the sum of all, and fast modes are left to the latter.
    """
    m = E.inputs
    modes = np.concatenate([E.poles(), _zeros(E)])
    modes = modes[(np.abs(modes) < _SLOWER) & (np.abs(modes) > 0.02) & (modes.imag >= 0)]
    slow = np.round(1 - np.geomspace(_FASTEST, _SLOWEST, poles), 4) if poles else np.zeros(0)
    fast, real, pairs = [], slow.tolist(), []
    for mode in _distinct(modes):
        if abs(mode.imag) > 1e-6:
            pairs.append((-2 * mode.real, abs(mode) ** 2))
        elif m > _FULL and abs(mode) < _FASTER:
            fast.append(float(mode.real))
        elif not any(abs(mode.real - a) < 0.02 * (1 - abs(a)) for a in real):
            real.append(float(mode.real))
    if m <= _RICH and taps >= _RIPPLED:
        q = np.exp(np.array(_RIPPLES) * 2 * np.pi * BAND_HZ[1] * E.T * (1j - _RIPPLE_DAMPING))
        pairs += [(-2 * mode.real, abs(mode) ** 2) for mode in q if mode.imag > 0]
    own = len(real) + taps - 1 + 2 * len(pairs)
    fast += [0.0] * (len(fast) % 2)
    pairs += [(-(a + b), a * b) for a, b in zip(fast[::2], fast[1::2], strict=True)]  # last: own chains end before
    all_poles = np.concatenate([np.zeros(taps - 1), np.round(real, 4)])
    count = all_poles.size + 2 * len(pairs)
    used = np.ones((count, m, m), dtype=bool)
    if m > _FULL:
        used = np.zeros((count, m, m + 1), dtype=bool)
        used[:own, np.arange(m), np.arange(m)] = True
        used[:, :, m] = True
    return Span(all_poles, np.round(np.array(pairs).reshape(-1, 2), 6), used)


def _zeros(E: Lti) -> Complex:
    """The poles of E^-1; contacts are grounded by a millionth, so that there is one."""
    D = E.D + 1e-6 * max(float(np.trace(E.D)) / E.inputs, 1e-12) * np.eye(E.inputs)
    return np.linalg.eigvals(E.A - E.B @ np.linalg.solve(D, E.C)).astype(complex)


def _distinct(modes: Complex) -> list[complex]:
    kept: list[complex] = []
    for mode in modes:
        if all(abs(mode - other) >= 0.05 * (1 - abs(other)) for other in kept):
            kept.append(mode)
    return kept


# the problem -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """One environment in which the constraints are to hold, and how much its mismatch counts."""

    loop: Loop  # around this environment alone
    E: Lti
    constraints: tuple[_Constraint, ...] = ()
    weight: float = 1.0

    def delayed(self, z: Complex) -> Sampled:
        """Psi E at z (k,)."""
        return Sampled.of(delay(self.loop.psi, self.loop.T) @ self.E, z[None])

    def need(self, coupling: ForceFilter) -> float:
        """The damping that this-environment asks, on a refined sweep, in units of what there is.

        The responses of environment and filter are multiplied: their series has defective poles, which cost digits.
        """

        def needed(w: Array) -> Array:
            F = _late(self.loop, coupling.around(self.delayed(on_circle(w))))
            demand = _demand(self.loop, F)
            return least_multiple(hermitian(demand.free.G[0]), hermitian(demand.gain.G[0]))

        chain = Span(coupling.poles, coupling.pairs, np.ones((len(coupling.R) - 1, 1, 1), dtype=bool)).chain(self.E.T)
        return supremum(needed, frequencies(self.E, chain, low=_SMALLEST / 10))[0]


@dataclass(frozen=True, eq=False)
class Problem:
    """The unknowns [g, R_1, R_2, .., own unknowns of the demands] with objective and inequalities."""

    span: Span
    cases: tuple[Case, ...]
    options: Options
    soft: float  # weight of the force above 100 Hz

    @property
    def own(self) -> list[tuple[int, int]]:
        """Where the own unknowns of each demand begin and end, case by case."""
        ends = [self.span.unknowns]
        for case in self.cases:
            ends += [ends[-1] + len(constraint.start) for constraint in case.constraints]
        return list(pairwise(ends))

    @property
    def unknowns(self) -> int:
        return self.span.unknowns + sum(len(c.start) for case in self.cases for c in case.constraints)

    def start(self, kappa: float) -> Array:
        """R = kappa I."""
        x = np.zeros(self.unknowns)
        x[0] = kappa
        own = [value for case in self.cases for constraint in case.constraints for value in constraint.start]
        x[self.span.unknowns :] = own
        return x

    def objective(self) -> tuple[Array, Array, Array]:
        """A, b, c of |A x - b|^2 + c'x: squared relative mismatch, soft rows, and the share of static stiffness."""
        rows, right = [], []
        for case in self.cases:
            if not case.weight:
                continue
            loop = case.loop
            low, high = _band(loop, self.options.band_hz)
            if self.options.objective == "rms":
                w = frequencies(case.E, low=low, high=high, points=80)
                logarithm = np.log(w)
                weight = np.gradient(logarithm) / (logarithm[-1] - logarithm[0])
                self._force_rows(case, w, np.sqrt(case.weight * weight), loop.lam, rows, right)
            edge = 2 * np.pi * _HIGH_HZ * loop.T
            if edge < np.pi and self.soft > 0:
                w = np.geomspace(edge, np.pi, 20)
                self._force_rows(case, w, np.full(20, self.soft * np.sqrt(case.weight / 20)), None, rows, right)
        static = np.zeros((1, self.unknowns))
        static[0, 0] = held = _static(self.cases[0].loop)
        cost = np.zeros(self.unknowns)
        cost[self.span.unknowns :] = [v for case in self.cases for c in case.constraints for v in c.cost]
        small = _SMALL * np.eye(self.span.unknowns, self.unknowns)
        return np.vstack([*rows, static, small]), np.concatenate([*right, [held], np.zeros(len(small))]), cost

    def _force_rows(
        self, case: Case, w: Array, weight: Array, lam: Sequence[int] | None, rows: list[Array], right: list[Array]
    ) -> None:
        """Rows of weight |F - Lambda E|/|E|, without Lambda E where lam is None."""
        z = on_circle(w)
        E = case.E.at(z)
        weight = weight / np.linalg.norm(E, axis=(1, 2))
        turn = z[:, None] ** -np.asarray(case.loop.theta)
        slope: Complex = np.zeros((self.unknowns, E.size), dtype=complex)
        slope[: self.span.unknowns] = (self._slopes(case, z).G * (weight[:, None] * turn)[..., None]).reshape(
            -1, E.size
        )
        target = np.zeros_like(E) if lam is None else (weight[:, None] * z[:, None] ** -np.asarray(lam))[..., None] * E
        rows.extend([np.ascontiguousarray(part(slope).T) for part in (np.real, np.imag)])
        right.extend([part(target).ravel() for part in (np.real, np.imag)])

    def _slopes(self, case: Case, z: Complex) -> Sampled:
        """What each of g, R_1, R_2, .. adds to the forces G as they leave, (unknowns, k, m, m)."""
        delayed = case.delayed(z).G[0]
        signals = self.span.sources() @ delayed  # (k, sources, m)
        functions = self.span.responses(z)
        G = np.zeros((self.span.unknowns, *delayed.shape), dtype=complex)
        G[0] = delayed
        which = np.argwhere(self.span.used)  # (function, row, source) of unknown 1, 2, ..
        through = functions[:, which[:, 0], None] * signals[:, which[:, 2]]  # (k, unknowns - 1, m)
        G[np.arange(1, len(G)), :, which[:, 1]] = np.swapaxes(through, 0, 1)
        return Sampled(z[None], G, case.loop.T)

    def block(self, case: Case, constraint: _Constraint, own: tuple[int, int], w: Array) -> Block:
        """The inequality of a constraint at these frequencies: an affine map, by what it makes of each unknown."""
        slopes = self._slopes(case, on_circle(w))
        nothing, units = Sampled(slopes.z, np.zeros_like(slopes.G[:1]), slopes.T), np.eye(own[1] - own[0])
        none = np.zeros(len(units))
        constant = constraint.at(nothing, none)
        moved = constraint.at(slopes, none) - constant
        slope = np.zeros((self.unknowns, *constant.shape[1:]), dtype=complex)
        slope[: len(moved)] = moved
        for a, unit in enumerate(units, start=own[0]):
            slope[a] = (constraint.at(nothing, unit) - constant)[0]
        return Block(constant[0], np.swapaxes(slope, 0, 1))

    def positive(self) -> Block:
        """g > 0."""
        slope = np.zeros((1, self.unknowns, 1, 1), dtype=complex)
        slope[0, 0] = 1
        return Block(np.zeros((1, 1, 1), dtype=complex), slope)

    def least(self, case: Case, constraint: _Constraint, own: tuple[int, int], x: Array, w: Array) -> Array:
        """The least eigenvalue of a constraint at x, (k,)."""
        z = on_circle(w)
        R = self.span.matrices(x) @ self.span.sources()
        n, m, _ = R.shape
        filtered = x[0] * np.eye(m) + (self.span.responses(z) @ R.reshape(n, m * m)).reshape(1, -1, m, m)
        delayed = case.delayed(z)
        G = Sampled(delayed.z, filtered @ delayed.G, delayed.T)
        return np.linalg.eigvalsh(constraint.at(G, x[own[0] : own[1]])[0])[:, 0]

    def grid(self, case: Case, constraint: _Constraint) -> Array:
        """The frequencies at which a constraint is imposed first."""
        even = np.linspace(constraint.low, constraint.high, 50)
        rising = np.geomspace(max(constraint.low, _SMALLEST), constraint.high, 60)
        modes = np.concatenate([case.E.poles(), self.span.chain(case.E.T).poles()])
        modes = np.array(_distinct(modes[modes.imag > 1e-6]), dtype=complex)
        around = (np.angle(modes)[:, None] + (1 - np.abs(modes))[:, None] * np.array([-1.0, 0.0, 1.0])).ravel()
        w = np.unique(np.concatenate([even, rising, around]))
        return w[(w >= max(constraint.low, _SMALLEST)) & (w <= constraint.high)]

    def room(self, x: Array, dense: bool = False) -> float:
        """The least eigenvalue of any constraint at x, where each is imposed first or over the whole sweep."""
        rooms, own = [], iter(self.own)
        for case in self.cases:
            for constraint in case.constraints:
                w = self._sweep(case, constraint) if dense else self.grid(case, constraint)
                rooms.append(self.least(case, constraint, next(own), x, w).min())
        return float(min(rooms))

    def _sweep(self, case: Case, constraint: _Constraint) -> Array:
        """A grid that knows every pole, over the band of a constraint."""
        return frequencies(case.E, self.span.chain(case.E.T), low=max(constraint.low, _SMALLEST), high=constraint.high)

    def missed(self, x: Array) -> tuple[list[Array], float]:
        """(where each constraint fails, case by case and constraint by constraint; by how much the worst does)."""
        found, own, worst = [], iter(self.own), 0.0
        for case in self.cases:
            for constraint in case.constraints:
                mine = next(own)
                w = self._sweep(case, constraint)
                fails = lambda w, case=case, constraint=constraint, mine=mine: -self.least(case, constraint, mine, x, w)  # noqa: E731
                found.append(peaks(fails, w, above=0.0))
                worst = max(worst, float(fails(found[-1]).max(initial=0.0)))
        return found, worst

    def solve(self, start: Array) -> Array:
        """The optimum, from a strictly feasible start: on a dense sweep it fails by no more than FORGIVEN."""
        asked = [(case, constraint) for case in self.cases for constraint in case.constraints]
        imposed = [self.grid(case, constraint) for case, constraint in asked]
        A, b, c = self.objective()
        _, R = np.linalg.qr(np.column_stack([A, b]))
        A, b = R[:, :-1], R[:, -1]
        x, t, gaps = start, None, list(_GAPS)
        inner = start
        nothing = float(b @ b) + float(c.any())  # without any force; a supremum is 1 then
        demanding = any(len(case.constraints) > 1 for case in self.cases)  # else scaling, which is exact, does the rest
        back = _STEEPER**4 if demanding else _STEEPER
        for _ in range(_MOST_SWEEPS):
            parts = [self.block(*one, own, w) for one, own, w in zip(asked, self.own, imposed, strict=True)]
            program = Program(A, b, c, (*parts, self.positive()))
            x = towards(start, x, program)
            program, U = program.conditioned(x)
            y = U @ x
            t = program.degree / max(program.value(y), 1e-12) if t is None else t / back
            y = centre(program, y, t)
            inner = scipy.linalg.solve_triangular(U, y)
            while True:
                value = program.value(y)
                if program.degree / t <= gaps[0] * max(min(value, nothing - value), 1e-9):
                    break
                t *= _STEEPER
                y = centre(program, y, t)
            x = scipy.linalg.solve_triangular(U, y)
            more, worst = self.missed(x)
            if worst < _FORGIVEN and len(gaps) == 1:
                break
            gaps = gaps[-1:]
            imposed = [np.union1d(w, extra) for w, extra in zip(imposed, more, strict=True)]
        return self._kept(inner, start, x) if demanding else x

    def _kept(self, inner: Array, start: Array, x: Array) -> Array:
        """The point from x towards one inside where no constraint fails by the sweep: least eigenvalues are concave."""
        _, worst = self.missed(x)
        for base in (inner, start):
            if (room := self.room(base, dense=True)) > 0:
                return base + max(0.0, 1 - 1.01 * worst / (worst + room)) * (x - base)
        return start


def _static(loop: Loop) -> float:
    return _STATIC if loop.channels <= _RICH else _STATIC_OF_MANY


def _band(loop: Loop, band_hz: tuple[float, float]) -> tuple[float, float]:
    """The band in rad/sample."""
    return 2 * np.pi * band_hz[0] * loop.T, min(2 * np.pi * band_hz[1] * loop.T, np.pi)


# the climb -------------------------------------------------------------------------------------------------------


def design_with(
    loop: Loop,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
    switching: tuple[Sequence[int], Sequence[int]] | None = None,
    **options: Any,
) -> Optimal:
    """The optimal coupling for Options(**options), also safe while delays vary within `switching`, (lo, hi) [samples].

    The rungs of its ladder are the steps that `progress` hears of.
    """
    asked, done = Options(**options), 0

    def heard(rung: _Rung) -> None:
        nonlocal done
        done += 1
        progress(f"{rung.mismatch_db:.2f} dB after {rung.seconds:.1f} s", done, len(asked.ladder))

    span = None if switching is None else DelayRange(*(tuple(map(int, end)) for end in switching))
    return design(loop.switching(span), asked, progress=heard)


def design(
    loop: Loop,
    options: Options = Options(),
    further: Sequence[_ForEach] = (),
    progress: _Progress = lambda rung: None,
) -> Optimal:
    """The coupling of the least mismatch in the loop's environment, certified and proved.

    With ranges around the environment this-environment is kept at every vertex and wherever the search between them
    looks; with a range of delays any switching within it is safe; `further` constraints hold in every environment.
    Where nothing that was designed can be proved the environment scaled down is returned, or the best spring-damper
    where that is better.

    Raises ValueError for a loop with walls or an environment that is not stable, DesignFailed where not even a
    millionth of the environment keeps what is asked.
    """
    if min(loop.delta) <= 0:
        raise ValueError(f"delta is {list(loop.delta)}, expected positive dampings in N s/m")
    climb = _Climb.of(loop, options, further)
    if exactly := climb.nothing():
        return exactly
    best: Optimal | None = None
    rungs: list[_Rung] = []
    for taps, poles in options.ladder:
        if rungs and not climb.room(taps, poles):
            break
        found, rung = climb.rung(taps, poles, best)
        rungs.append(rung)
        progress(rung)
        gained = np.inf if rung.reason else 0.0
        if rung.reason is None and (best is None or climb.merit(found) < climb.merit(best)):
            gained = np.inf if best is None else decibels(climb.merit(best)) - decibels(climb.merit(found))
            best = found
        if (gained < _SETTLED_DB and len(rungs) >= _FEWEST_RUNGS) or climb.elapsed > options.seconds:
            break
    if best and loop.ranges:
        best = climb.between(best)
    if best is None or climb.mismatch(best) > _HOPELESS:
        rivals = [one for one in (best, climb.scaled(), climb.spring_damper()) if one is not None]
        best = min(rivals, key=lambda one: (not one.proved, climb.merit(one)))
    return replace(best, ladder=tuple(rungs), sdps=len(rungs), wall_s=climb.elapsed)


@dataclass(frozen=True, eq=False)
class _Climb:
    """The loop and what is asked of it, with the clock."""

    loop: Loop
    options: Options
    cases: tuple[Case, ...]  # the loop's own environment first, then the vertices of its ranges
    bare: float  # damping that the environments themselves need, the most
    started: float

    @classmethod
    def of(cls, loop: Loop, options: Options, further: Sequence[_ForEach]) -> _Climb:
        started = time.perf_counter()
        if loop.environment.walls:
            raise ValueError("an optimal coupling holds a linear model of the environment: walls have none")
        if loop.varying_delay:
            further = (*further, lambda there, span=loop.varying_delay: switching(there, span, options.margin))
        cases: list[Case] = []
        for member in loop.members():
            there = _at(loop, member.network)
            asked = [this_environment(there, options.margin), *(constraint(there) for constraint in further)]
            if options.high_gain is not None and 2 * _HIGH_HZ * loop.T < 1 and there.E().D.any():
                asked.append(_most_gain(there, options.high_gain))
            if options.objective == "sup" and not cases:
                asked.append(_worst_mismatch(there, options.band_hz))
            cases.append(Case(there, there.E(), tuple(asked), weight=0.0 if cases else 1.0))
        if options.limiter and (reason := limiter_refusal(loop)):
            raise ValueError(reason)
        needs = in_each(loop, NoCoupling(), loop.members())
        if not np.isfinite(bare := max(need.ratio for need in needs)):
            raise ValueError(f"no coupling is safe here: {next(n.reason for n in needs if n.reason)}")
        return cls(loop, options, tuple(cases), bare, started)

    @property
    def elapsed(self) -> float:
        return time.perf_counter() - self.started

    @property
    def constrained(self) -> bool:
        """Whether anything but this-environment is asked."""
        return self.options.limiter or any(len(case.constraints) > 1 for case in self.cases)

    def slips(self, before: Optimal | None) -> tuple[_Slip | None, ...]:
        """The limiters that a rung is solved for: that of the rung before, with the best multiplier that it has."""
        if not self.options.limiter:
            return (None,)
        if before and before.certificate:
            proof = before.certificate.limiter
            assert isinstance(proof, LimiterCertificate)
            return (_Slip(proof.beta, proof.c),)
        return tuple(_Slip.even(self.loop, *some) for some in (_LAGS if any(self.loop.psi) else _LAGS[:1]))

    def asked(self, slip: _Slip | None) -> tuple[Case, ...]:
        """The environments with all that holds in each."""
        if slip is None:
            return self.cases
        here = limiter(self.loop, slip, self.options.margin)
        return tuple(replace(case, constraints=(*case.constraints, here)) for case in self.cases)

    def mismatch(self, found: Optimal) -> float:
        """What is minimised, relative to the environment."""
        figures = found.figures
        return figures.rms_mismatch if self.options.objective == "rms" else figures.relative_mismatch

    def decibels(self, found: Optimal) -> float:
        return decibels(self.mismatch(found))

    def merit(self, found: Optimal) -> float:
        """The objective of the climb: mismatch and lost static stiffness, as a ratio."""
        static = _static(self.loop) * (found.g - 1) if np.isfinite(found.g) else 0.0
        return float(np.hypot(self.mismatch(found), static))

    def nothing(self) -> Optimal | None:
        """No coupling, where that is exact and safe."""
        loop = self.loop
        exact_delay = all(n == t + p for n, t, p in zip(loop.lam, loop.theta, loop.psi, strict=True))
        more = any(len(case.constraints) > 1 for case in self.cases)
        if more or not exact_delay or self.bare > 1 - self.options.margin:
            return None
        found = self._proved(self._assessed(NoCoupling(), 1.0), self.slips(None)[0])
        return found if found.proved or not self.options.limiter else None

    def room(self, taps: int, poles: int) -> bool:
        """Whether a rung is tried: by its size, which is the same on a busy machine."""
        span, loop = span_of(self.cases[0].E, taps, poles), self.loop
        m = loop.channels
        own = int((span.used.sum(axis=1) > 0)[:, :m].sum())
        states = own + (len(span.used) - own // m if m > _FULL else 0)
        states += self.cases[0].E.order + sum(loop.theta) + sum(loop.psi)
        return states <= _MOST_STATES and (m * span.unknowns) ** 2 <= _MOST_WORK

    def rung(self, taps: int, poles: int, before: Optimal | None) -> tuple[Optimal, _Rung]:
        """The optimum over a basis, scaled until every sweep passes, and proved where there are no ranges."""
        tried = [self._solved(taps, poles, before, slip) for slip in self.slips(before)]
        found = min(tried, key=lambda one: (one.reason is not None, self.merit(one)))
        return found, _Rung(taps, poles, found.states, self.decibels(found), found.g, found.reason, self.elapsed)

    def _solved(self, taps: int, poles: int, before: Optimal | None, slip: _Slip | None) -> Optimal:
        share = self.mismatch(before) if before else 1.0
        span, cases = span_of(self.cases[0].E, taps, poles), self.asked(slip)
        active = [0]
        while True:
            chosen = tuple(cases[i] for i in active)
            problem = Problem(span, chosen, self.options, _SOFT[0] * min(share, _SOFT[1]))
            coupling = span.filter(problem.solve(self._start(problem)))
            needs = [case.need(coupling) for case in cases]
            missed = [int(i) for i in np.argsort(needs)[::-1] if needs[i] > 1 + _TOLERATED and i not in active]
            if not missed:
                break
            active += missed[:2]
        if slip:
            needs.append(min(limiter_requirement(self.loop, coupling, slip.beta).requirement.ratio, 1 + _TOLERATED))
        for limit in (1 - 0.95 * self.options.margin, 1 - 2.5 * self.options.margin):
            scale = min(1.0, (1 - self.options.margin) / max(needs)) if max(needs) > limit else 1.0
            scaled = _scaled(coupling, min(scale, limit / max(needs)))
            found = self._assessed(scaled, scaled.g)
            if self.loop.ranges or (found := self._proved(found, slip)).proved:
                break
        return found

    def between(self, found: Optimal) -> Optimal:
        """The coupling for ranges after the search between the vertices, and proved at each of them.

        Where the worst environment that was found asks for more damping than there is, the forces are scaled down.
        """
        whole = found.coupling
        assert isinstance(whole, ForceFilter)
        searched = search_ranges(self.loop, whole)
        ratio, last = searched.worst[0].ratio, found
        for limit in (1 - self.options.margin / 2, 1 - 2.5 * self.options.margin):
            share = min(1.0, limit / ratio)
            coupling = _scaled(whole, share)
            lower = tuple(replace(one, ratio=one.ratio * share) for one in searched.worst)  # each need scales
            last = self._proved(self._assessed(coupling, coupling.g), None)
            last = replace(last, searched=replace(searched, worst=lower))
            if last.proved:
                break
        return last

    def scaled(self) -> Optimal:
        """The environment itself, scaled down until it is safe."""
        span = Span(np.zeros(0), NO_PAIRS, np.zeros((0, self.loop.channels, self.loop.channels), dtype=bool))
        simple = (1 - self.options.margin) / self.bare if self.bare > 0 else 1.0
        (slip, *_) = self.slips(None)
        problem = Problem(span, self.asked(slip), self.options, 0.0)
        kappa = self._start(problem)[0] if self.constrained else min(1.0, simple)
        kappa = np.floor(kappa * 1e6) / 1e6
        return self._proved(self._assessed(span.filter(np.array([kappa])), kappa), slip)

    def spring_damper(self) -> Optimal | None:
        """The best spring-damper of this-environment, where nothing else is asked and one is found."""
        if len(self.cases) > 1 or self.constrained or self.loop.latency:
            return None
        from design import spring_damper  # its solvers load slowly, and most designs end before

        try:
            gains = spring_damper.design(self.loop, "this-environment").coupling
            return self._proved(self._assessed(gains, np.nan), None)
        except (DesignFailed, ValueError):
            return None

    def _start(self, problem: Problem) -> Array:
        """R = kappa I that keeps every constraint with room to spare. Raises DesignFailed."""
        kappa = 0.5 / max(self.bare, 0.5)
        for _ in range(20):
            start = problem.start(kappa)
            if problem.room(start) > 0:
                return start
            kappa /= 2
        names = ", ".join(dict.fromkeys(one.name for case in problem.cases for one in case.constraints))
        raise DesignFailed(problem, (), f"not even a millionth of the environment keeps what is asked: {names}")

    def _assessed(self, coupling: Coupling, g: float) -> Optimal:
        """The coupling with its figures, and what a sweep of it alone asks for."""
        loop, members = self.loop, self.loop.members()
        F = loop.F(coupling)
        requirements = [requirement_of(F, loop.delta, loop.T_max, loop.latency), *in_each(loop, coupling, members[1:])]
        requirement = requirements[worst(requirements)]
        figures = transparency(F, self.cases[0].E, loop.lam, self.options.band_hz)
        objective = self.options.objective
        return Optimal(
            coupling,
            "this-environment",
            objective,
            figures.rms_mismatch if objective == "rms" else figures.relative_mismatch,
            requirement,
            sdps=0,
            wall_s=self.elapsed,
            figures=figures,
            g=figures.dc_ratio if np.isnan(g) else g,
            states=F.order,
            certificate=None,
            reason=None if requirement.certified else requirement.reason or "the sweep does not certify it",
        )

    def _proved(self, found: Optimal, slip: _Slip | None) -> Optimal:
        """The same with its certificate, or why it has none."""
        loop, coupling = self.loop, found.coupling
        try:
            limited = prove_limiter(loop, coupling, slip.beta) if slip else None
            certificate = prove(loop, coupling, "this-environment", limiter=limited, swept=found.requirement)
        except NotProved as error:
            return replace(found, wall_s=self.elapsed, reason=str(error))
        requirement = replace(found.requirement, proof="rational")
        return replace(found, requirement=requirement, certificate=certificate, wall_s=self.elapsed, reason=None)


def _at(loop: Loop, network: Network) -> Loop:
    """The loop around this environment, its delays constant."""
    return loop.at(network).switching(None)


def _scaled(coupling: ForceFilter, scale: float) -> ForceFilter:
    """The filter times a number, in decimals for which R(1) = g I holds exactly."""
    every = np.ones((len(coupling.R) - 1, *coupling.R.shape[1:]), dtype=bool)
    return Span(coupling.poles, coupling.pairs, every).filter(np.append(coupling.g, coupling.R[1:].ravel()), scale)


# robustness ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Robustness:
    """What a coupling needs where the environment is not quite the one that it was designed for."""

    percent: float
    worst: float  # times the damping that there is
    where: str  # which parameter, and which way
    kept: bool  # whether it is certified there


def vertices(network: Network, percent: float = 10.0) -> dict[str, Network]:
    """Every spring, all springs at once, and every mass, this much more or less; by name."""
    found = {}
    stiff = [i for i, spring in enumerate(network.springs) if spring.stiffness > 0]
    for sign, factor in (("+", 1 + percent / 100), ("-", 1 - percent / 100)):

        def stiffer(which: Sequence[int], factor: float = factor) -> Network:
            springs = [
                msgspec.structs.replace(spring, stiffness=spring.stiffness * factor) if i in which else spring
                for i, spring in enumerate(network.springs)
            ]
            return msgspec.structs.replace(network, springs=tuple(springs))

        for i in stiff:
            found[f"{sign}{percent:g} % stiffness between {' and '.join(network.springs[i].between)}"] = stiffer([i])
        if len(stiff) > 1:
            found[f"{sign}{percent:g} % stiffness of all springs"] = stiffer(stiff)
        for node, mass in network.masses.items():
            if mass > 0:
                masses = {**network.masses, node: mass * factor}
                found[f"{sign}{percent:g} % mass of {node}"] = msgspec.structs.replace(network, masses=masses)
    return found


def robustness(loop: Loop, coupling: Coupling, percent: float = 10.0) -> _Robustness:
    """The worst need of a coupling over `vertices`, by the refined sweep."""
    worst, where = 0.0, "nominal"
    for name, network in {"nominal": loop.environment, **vertices(loop.network, percent)}.items():
        there = _at(loop, network)
        if isinstance(coupling, ForceFilter):
            ratio = Case(there, there.E()).need(coupling)
        else:
            ratio = requirement_of(there.F(coupling), loop.delta, loop.T_max, loop.latency).ratio
        if ratio > worst:
            worst, where = ratio, name
    return _Robustness(percent, worst, where, worst < 1)


@dataclass(frozen=True)
class _Spread:
    """What it costs to keep the condition over `vertices`, too: two designs over one small basis."""

    mismatch_db: float  # of the design for the vertices, in the nominal environment
    price_db: float  # beside the design for the nominal environment alone
    g: float
    worst: float  # times the damping that there is, over the vertices


def spread(loop: Loop, options: Options = Options(), percent: float = 10.0) -> _Spread | None:
    """The design for `vertices` beside the nominal one, by sweeps: a price, not a coupling to run. None without one."""
    taps, poles = options.ladder[: 2 if loop.channels <= _RICH else 1][-1]
    climb = _Climb.of(loop.at(loop.environment), options, ())
    around = [_at(loop, network) for network in vertices(loop.network, percent).values()]
    more = tuple(Case(there, there.E(), (this_environment(there, options.margin),), 0.0) for there in around)
    try:
        alone, wide = (each.rung(taps, poles, None)[0] for each in (climb, replace(climb, cases=climb.cases + more)))
    except DesignFailed:
        return None
    mismatch = climb.decibels(wide)
    worst = robustness(loop, wide.coupling, percent).worst
    return _Spread(mismatch, mismatch - climb.decibels(alone), wide.g, worst)


def ranges_around(network: Network, percent: float) -> Ranges:
    """Every stiffness and every mass this much more or less, each independent of the others."""

    def near(value: float) -> tuple[float, float]:
        return tuple(float(f"{value * (1 + sign * percent / 100):.12g}") for sign in (-1, 1))  # type: ignore[return-value]

    springs = tuple(UncertainSpring(s.between, near(s.stiffness)) for s in network.springs if s.stiffness > 0)
    return Ranges(springs, {node: near(mass) for node, mass in network.masses.items() if mass > 0})
