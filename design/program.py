"""The convex program of the optimal coupling (design.optimal), whose force filter R gives F = Theta R Psi E.

R is a sum of basis functions with unknown coefficients. All constraints are affine in R, and R = kappa I satisfies each
of them for a small kappa, so that a feasible start always exists. Each constraint is a linear matrix inequality at
every frequency. design.barrier solves the program on a grid of frequencies, and a dense sweep adds the frequencies at
which the solution violates a constraint.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arguments import number, one_of
from haptic_loop.controller.arithmetic import spend
from haptic_loop.controller.coupling import ForceFilter, basis
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import DelayRange, Loop
from haptic_loop.controller.lti import Array, Complex, Lti, Sampled, as_like
from haptic_loop.design import budgets
from haptic_loop.design.barrier import (
    EntryInequality,
    MatrixInequality,
    Program,
    follow,
    joined,
    packed,
    solve_triangular,
    triangular_factor,
)
from haptic_loop.design.conditions import even_damping, this_environment_demand
from haptic_loop.design.environments import SWITCHING, LimitedForces, named_parts
from haptic_loop.design.facts import KnownMotor
from haptic_loop.design.frequency import frequencies, hermitian, on_circle, peaks
from haptic_loop.design.known_device import KnownDevice, period_cost
from haptic_loop.design.transparency import BAND_HZ, in_band

OBJECTIVES = ("rms", "sup")
MARGIN = 0.002  # unused share of the damping, which the exact proof needs for rounding
_BASES = ((4, 3), (8, 6), (14, 10), (22, 16), (26, 10), (32, 24), (48, 34))  # (taps, real poles) of the bases
_FASTEST, _SLOWEST = 0.5, 0.008  # largest and least distance of a real pole to 1
_SLOWEST_OF_LARGE = 0.0015  # least distance of a real pole to 1 in a basis with sections at the band's end
_FASTER = 0.25  # With many channels, only the filter of the sum of all forces has real modes of smaller radius.
_NEAR = 0.3  # A real pole is dropped if a real mode is nearer than this share of the pole's distance to 1.
_SLOWER = 0.999  # Modes of larger radius are left out of the basis.
_RICH = 8  # largest number of channels for which a basis has second-order sections at the band's end
_EDGED = {1: 20, 2: 20}  # number of channels -> least number of taps of a basis with sections at the band's end
_EDGED_OF_MANY = 6  # least number of taps of such a basis for more than two channels
_EDGES = (0.2, 0.07, 0.02)  # damping ratios of the sections; small, because the error may jump at the band's end
# Up to FULL channels R has a filter for each pair of channels. With further constraints, a latency or ranges the limit
# is FULL_BESIDE.
FULL, FULL_BESIDE = 8, 5
_STATIC, _STATIC_OF_MANY = 0.22, 0.35  # weights of g - 1 beside the mismatch, up to _RICH channels and above
HIGH_HZ = 100.0  # Above this frequency the objective (soft rows) or a constraint (`most_gain`) keeps the force low.
SOFT = 0.05, 0.3  # The weight of the soft rows is SOFT[0] min(mismatch of the best coupling so far, SOFT[1]).
_EVEN = 0.002  # weight of the error relative to each motion's own force (`_evened`)
_LEAST_FORCE = 0.01  # least force that `_evened` assumes for a motion, as a share of the norm of E
_SMALL = 1e-5  # weight of R's coefficients. Without it some would be arbitrary if the environment has no inverse.
_DECIMALS = 10  # decimal places of g and of R's coefficients
# Duality gaps before the first sweep and before each later sweep. They are relative to the objective, or, if this is
# less, to the difference between the objectives of zero force and of the solution.
_GAPS = (0.05, 0.01)
# Allowed violation of an inequality between the frequencies of its grid. The first number holds if the caller scales
# the forces down. The second holds for `_kept`, which worsens the objective 30 times as much.
_FORGIVEN, _FORGIVEN_OF_MORE = 5e-4, 1e-4
_STEEPER = 3.0  # factor between successive t of the barrier method
_POINT = 5e-6  # counted work for one constraint at one frequency
_SMALLEST = 1e-5  # least frequency of an inequality [rad/sample]; the matrices are constant below it


@dataclass(frozen=True)
class Options:
    """Options of the design of an optimal coupling. TypeErrors and ValueErrors name the wrong field."""

    objective: Literal["rms", "sup"] = "rms"  # norm of the mismatch relative to the environment, over the band
    band_hz: tuple[float, float] = BAND_HZ
    high_gain: float | None = None  # largest |F|/|E| above 100 Hz; None: only the soft rows keep the force low
    limiter: bool = False  # whether the coupling is also safe while forces are limited
    seconds: float | None = None  # time [s] after which no larger basis is tried; None: no time limit
    bases: tuple[tuple[int, int], ...] = _BASES  # (taps, real poles)

    def __post_init__(self) -> None:
        one_of("objective", self.objective, OBJECTIVES)
        if self.seconds is not None:
            number("seconds", self.seconds)
        if self.high_gain is not None and not 1 <= number("high_gain", self.high_gain) < np.inf:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not self.bases or any(taps < 1 or poles < 0 for taps, poles in self.bases):
            raise ValueError(f"bases is {self.bases}, expected pairs of taps (1 or more) and poles (0 or more)")


DEFAULT = Options()


@dataclass(frozen=True, eq=False)
class _Constraint:
    """The constraint He[block(G, x)] > 0 at every frequency, affine in G = R Psi E and in its own unknowns x."""

    name: str
    block: Callable[[Sampled, Array], Sampled]
    unit: Array  # (r,) scale of the block's rows and columns, which makes its entries dimensionless
    low: float = _SMALLEST  # [rad/sample] least frequency
    high: float = np.pi  # [rad/sample] largest frequency
    start: tuple[float, ...] = ()  # own unknowns, with which R = kappa I is strictly feasible for a small kappa
    cost: tuple[float, ...] = ()  # coefficients of the own unknowns in the objective
    through: bool = False  # whether the block is a constant plus L(z) G, with one row for each force

    def at(self, G: Sampled, own: Array) -> Complex:
        """Return the Hermitian part of the scaled block, (n, k, r, r)."""
        return hermitian(self.unit[:, None] * self.block(G, own).G * self.unit)


# constraints ----------------------------------------------------------------------------------------------------------


def this_environment(loop: Loop) -> _Constraint:
    """Return this-environment as a constraint, which leaves the share MARGIN of the damping unused."""

    def block(G: Sampled, own: Array) -> Sampled:
        demand = this_environment_demand(loop.late(G), loop)
        return demand.free + demand.gain * (1 - MARGIN)

    gain = this_environment_demand(Lti.constant(np.zeros((loop.channels, loop.channels)), loop.T), loop).gain
    return _Constraint("this-environment", block, 1 / np.sqrt(np.diag(gain.D)), through=loop.latency is None)


def switching(loop: Loop, span: DelayRange) -> _Constraint:
    """Return SWITCHING as a constraint for delays that switch within the span.

    Its own unknowns are the multipliers alpha of the devices whose delay varies. The unit of alpha is delta/T_max with
    the least delta of the device's axes.
    """
    scale = even_damping(loop) / loop.T
    switched = loop.switching(span)
    # Each channel with a varying delay has a further input, the w of design.facts.Switching.
    moves = np.flatnonzero(np.asarray(span.hi) - np.asarray(span.lo))
    (multiplier,) = SWITCHING.unknowns(switched)
    units = np.array(multiplier.units)  # (devices,), 0 where the delay is constant
    count = np.count_nonzero(units)

    def block(G: Sampled, own: Array) -> Sampled:
        alpha = np.zeros(units.size)
        alpha[units > 0] = own * units[units > 0]
        demand = SWITCHING.block(G, switched, alpha)
        return demand.free + demand.gain * (1 - MARGIN)

    unit = 1 / np.sqrt(np.concatenate([scale, scale[moves]]))
    return _Constraint("switching delays", block, unit, start=(0.5,) * count, cost=(0.0,) * count)


@dataclass(frozen=True)
class Slip:
    """Stiffness and multiplier of a limiter. If both are fixed, the limiter's block is affine in the forces."""

    beta: float  # The limiter's stiffness rho is beta/T times the least damping of the device (LimitedForces.rho).
    c: tuple[tuple[float, ...], ...]  # (devices, lags) multiplier

    @property
    def condition(self) -> LimitedForces:
        return LimitedForces(self.beta, len(self.c[0]))


def limiter(loop: Loop, slip: Slip) -> _Constraint:
    """Return LimitedForces as a constraint, which leaves the share MARGIN of the damping and 2 % of rho unused."""
    condition, c = slip.condition, [v for row in slip.c for v in row]

    def block(G: Sampled, own: Array) -> Sampled:
        demand = condition.block(G, loop, c)
        demanded = demand.free + demand.gain * (1 - MARGIN)
        return demanded if demand.spare is None else demanded - np.diag(demand.spare)

    return _Constraint("limiter", block, np.tile(1 / np.sqrt(even_damping(loop) / loop.T), 2))


def known_device(loop: Loop, condition: KnownDevice, beta: Array, multipliers: Sequence[float]) -> _Constraint:
    """Return known-device as a constraint for fixed beta (m,) [s] and multipliers of the facts.

    The constraint leaves the share MARGIN of the damping unused.
    """
    values = named_parts(condition.unknowns(loop), multipliers)
    hands = KnownMotor(period_cost(loop, 1 - MARGIN, beta), beta)

    def block(G: Sampled, own: Array) -> Sampled:
        demand = condition.form(G, loop, values, hands)
        return demand.free if demand.spare is None else demand.free - np.diag(demand.spare)

    none = Sampled(np.array([[1j]]), np.zeros((1, 1, loop.channels, loop.channels), dtype=complex), loop.T)
    size = np.diagonal(hermitian(block(none, np.zeros(0)).G)[0, 0].real)
    return _Constraint(condition.name, block, 1 / np.sqrt(size))


def most_gain(loop: Loop, cap: float) -> _Constraint:
    """Return the constraint |F| < cap |E| above 100 Hz."""
    E = loop.E()

    def block(G: Sampled, own: Array) -> Sampled:
        return _within(loop.late(G), E.at(G.z), cap)

    low = min(2 * np.pi * HIGH_HZ * loop.T, np.pi)
    return _Constraint("high-frequency gain", block, np.ones(2 * E.inputs), low=low)


def worst_mismatch(loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> _Constraint:
    """Return the constraint |F - Lambda E| < r |E| over the band; its own unknown r is added to the objective."""
    E = loop.E()

    def block(G: Sampled, own: Array) -> Sampled:
        return _within(loop.late(G) - as_like(G, delay(loop.lam, loop.T) @ E), E.at(G.z), own[0])

    low, high = in_band(band_hz, loop.T)
    return _Constraint("mismatch", block, np.ones(2 * E.inputs), low, high, start=(2.0,), cost=(1.0,))


def _within(M: Sampled, E: Complex, cap: float) -> Sampled:
    """Return a block whose Hermitian part is [[cap I, M/|E|], [(M/|E|)*, cap I]].

    This part is positive definite if and only if |M| < cap |E| in the spectral norm.
    """
    m = M.G.shape[-1]
    S = np.zeros((*M.G.shape[:-2], 2 * m, 2 * m), dtype=complex)
    S[..., np.arange(2 * m), np.arange(2 * m)] = cap
    S[..., :m, m:] = 2 * M.G / np.linalg.norm(E, 2, axis=(-2, -1))[..., None, None]
    return Sampled(M.z, S, M.T)


# the basis -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Span:
    """The basis functions b_j of R = sum_j b_j R_j, and the entries of R_1, R_2, .. that are unknowns.

    The first unknown is g. R_0 follows from R(1) = g I, because b_j(1) = 1.
    """

    poles: Array  # (n,) real poles; 0 for a tap
    pairs: Array  # (p, 2) coefficients a, b of z^2 + a z + b
    used: NDArray[np.bool_]  # (n + 2 p, m, m or m + 1) whether an entry is an unknown; all other entries are 0

    @property
    def unknowns(self) -> int:
        return 1 + int(self.used.sum())

    def responses(self, z: Complex) -> Complex:
        """Return b_j(z) - 1 for j >= 1, (k, n + 2 p): the factors of the R_j, since R_0 is g I - R_1 - R_2 - .."""
        return basis(self.poles, z, self.pairs)[:, 1:] - 1

    def sources(self) -> Array:
        """Return the filters' inputs as a map from the forces, (m or m + 1, m): each force, then perhaps their sum."""
        m, columns = self.used.shape[1:]
        return np.vstack([np.eye(m), np.ones((columns - m, m))])

    def matrices(self, x: Array) -> Array:
        """Return R_1, R_2, .. for the unknowns x, (n + 2 p, m, m or m + 1)."""
        R = np.zeros(self.used.shape)
        R[self.used] = x[1 : self.unknowns]
        return R

    def filter(self, x: Array, scale: float = 1.0) -> ForceFilter:
        """Return the force filter times `scale`, with coefficients in decimals. R_0 is such that R(1) = g I exactly."""
        unit = 10**_DECIMALS
        later = np.array([round(v * unit) for v in (scale * self.matrices(x)).ravel().tolist()], dtype=object)
        later = later.reshape(self.used.shape)
        m = self.used.shape[1]
        first = -later.sum(axis=0) if len(later) else np.zeros(self.used.shape[1:], dtype=object)
        first[np.arange(m), np.arange(m)] += round(max(scale * x[0], 0.0) * unit)
        R = np.concatenate([first[None], later])
        return ForceFilter(self.poles, self.pairs, np.array([int(v) / unit for v in R.flat]).reshape(R.shape))

    def chain(self, T: float) -> Lti:
        """Return a block with the poles of the basis; T in s."""
        one = np.append(np.zeros(len(self.used)), 1.0)[:, None, None]  # The last function has all poles.
        return ForceFilter(self.poles, self.pairs, one).filter(T)


def span_of(E: Lti, taps: int, poles: int, end_hz: float = BAND_HZ[1], full: int = FULL) -> Span:
    """Return a basis of taps, real poles, and the modes of E and of its inverse.

    The real poles are evenly spaced in the logarithm of their distance to 1. Real poles near a real mode are dropped.
    All poles are rounded to decimals. Large bases for at most _RICH channels also have slower poles, and sections at
    the band's end. With more than `full` channels every channel has a filter of its own force and a filter of the sum
    of all forces. Only the filter of the sum has the fast real modes.
    """
    m = E.inputs
    modes = np.concatenate([E.poles(), _zeros(E)])
    modes = modes[(np.abs(modes) < _SLOWER) & (np.abs(modes) > 0.02) & (modes.imag >= 0)]
    large = m <= _RICH and taps >= _EDGED.get(m, _EDGED_OF_MANY)
    slowest = _SLOWEST_OF_LARGE if large else _SLOWEST
    slow = np.round(1 - np.geomspace(_FASTEST, slowest, poles), 4) if poles else np.zeros(0)
    own_real = modes[np.abs(modes.imag) <= 1e-6].real
    fast, real, pairs = [], [a for a in slow.tolist() if not (np.abs(own_real - a) < _NEAR * (1 - a)).any()], []
    for mode in _separate(modes):
        if abs(mode.imag) > 1e-6:
            pairs.append((-2 * mode.real, abs(mode) ** 2))
        elif m > full and abs(mode) < _FASTER:
            fast.append(float(mode.real))
        elif not any(abs(mode.real - a) < 0.02 * (1 - abs(a)) for a in real):
            real.append(float(mode.real))
    if large:
        q = np.exp(2 * np.pi * end_hz * E.T * (1j - np.array(_EDGES)))
        pairs += [(-2 * mode.real, abs(mode) ** 2) for mode in q if mode.imag > 0]
    own = len(real) + taps - 1 + 2 * len(pairs)
    fast += [0.0] * (len(fast) % 2)
    # The fast real modes come last, because the filters of the channels' own forces end before them.
    pairs += [(-(a + b), a * b) for a, b in zip(fast[::2], fast[1::2], strict=True)]
    all_poles = np.concatenate([np.zeros(taps - 1), np.round(real, 4)])
    count = all_poles.size + 2 * len(pairs)
    used = np.ones((count, m, m), dtype=bool)
    if m > full:
        used = np.zeros((count, m, m + 1), dtype=bool)
        used[:own, np.arange(m), np.arange(m)] = True
        used[:, :, m] = True
    return Span(all_poles, np.round(np.array(pairs).reshape(-1, 2), 6), used)


def _zeros(E: Lti) -> Complex:
    """Return the poles of E^-1. A millionth of E's feedthrough is added to its diagonal, so that the inverse exists."""
    D = E.D + 1e-6 * max(float(np.trace(E.D)) / E.inputs, 1e-12) * np.eye(E.inputs)
    return np.linalg.eigvals(E.A - E.B @ np.linalg.solve(D, E.C)).astype(complex)


def _separate(modes: Complex) -> list[complex]:
    """Return the modes that are not too close to an earlier mode (5 % of that mode's distance to the unit circle)."""
    distinct: list[complex] = []
    for mode in modes:
        if all(abs(mode - other) >= 0.05 * (1 - abs(other)) for other in distinct):
            distinct.append(mode)
    return distinct


_Part = tuple["Case", _Constraint, slice]  # a constraint in a case, and the indices of its own unknowns
_Posed = tuple[Program, Array, Callable[[Array], Array]]  # a program in unknowns y, a feasible y, the map from y to x

# the problem -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """One environment with its constraints."""

    loop: Loop  # loop with this environment, without ranges
    E: Lti
    constraints: tuple[_Constraint, ...] = ()

    def delayed(self, z: Complex) -> Sampled:
        """Return Psi E at z (k,)."""
        return Sampled.of(delay(self.loop.psi, self.loop.T) @ self.E, z[None])


@dataclass(frozen=True, eq=False)
class Problem:
    """Objective and constraints in the unknowns x = [g, R_1, R_2, .., own unknowns of the constraints]."""

    span: Span
    cases: tuple[Case, ...]  # The objective is the mismatch in the first environment.
    options: Options
    soft: float  # weight of the force above 100 Hz
    heavier: float = 1.0  # factor on the weight of the static stiffness

    @cached_property
    def parts(self) -> list[_Part]:
        """Every constraint of every case."""
        parts, end = list[_Part](), self.span.unknowns
        for case in self.cases:
            for constraint in case.constraints:
                first, end = end, end + len(constraint.start)
                parts.append((case, constraint, slice(first, end)))
        return parts

    @property
    def unknowns(self) -> int:
        return self.span.unknowns + sum(len(constraint.start) for _, constraint, _ in self.parts)

    def start(self, kappa: float) -> Array:
        """Return the unknowns of R = kappa I, with the constraints' own unknowns at their start."""
        own = [value for _, constraint, _ in self.parts for value in constraint.start]
        return np.array([kappa, *np.zeros(self.span.unknowns - 1), *own])

    def objective(self) -> tuple[Array, Array, Array]:
        """Return A, b, c of |A x - b|^2 + c'x, a sum of mismatch, soft rows, lost static stiffness and size of R.

        The mismatch is the squared rms mismatch, or the unknown r of `worst_mismatch` for the objective "sup". Each
        channel's row of R is a separate least-squares problem, which is reduced to its triangular factor. The problems
        share only g, so that A has hardly more rows than unknowns.
        """
        parts = self._weighed()
        rows, right, row_of = [], [], np.argwhere(self.span.used)[:, 1]
        for i in range(self.cases[0].E.inputs):
            mine = np.concatenate([[0], 1 + np.flatnonzero(row_of == i)])
            small = _SMALL * np.eye(mine.size, mine.size + 1)[1:]
            stacked = np.vstack([*(self._force_rows(*part, i, mine) for part in parts), small])
            R = np.asarray(np.linalg.qr(stacked, mode="r"))
            slope = np.zeros((len(R), self.unknowns))
            slope[:, mine] = R[:, :-1]
            rows.append(slope)
            right.append(R[:, -1])
        held = self.heavier * static_weight(self.cases[0].loop)
        of_g = np.zeros((2, self.unknowns))
        of_g[:, 0] = held, _SMALL
        cost = np.zeros(self.unknowns)
        cost[self.span.unknowns :] = [value for _, constraint, _ in self.parts for value in constraint.cost]
        return np.vstack([*rows, of_g]), np.concatenate([*right, [held, 0.0]]), cost

    def _weighed(self) -> list[tuple[Array, Complex, Complex]]:
        """Return terms (w, L, target L) of the objective, the sum of |F L - target L|^2 over the frequencies w.

        L contains weight/|E|, and for the mismatch also `_evened`. The target of the mismatch is Lambda E, and that of
        soft rows is zero.
        """
        case, weights = self.cases[0], list[tuple[Array, Complex, Complex]]()

        def add(w: Array, weight: Array, ideal: bool) -> None:
            E, z = case.E.at(on_circle(w)), on_circle(w)
            size = np.linalg.norm(E, axis=(1, 2))
            L = (weight / size)[:, None, None] * (_evened(E, size) if ideal else np.eye(case.E.inputs))
            target = (z[:, None] ** -np.asarray(case.loop.lam))[..., None] * E if ideal else np.zeros_like(E)
            weights.append((w, L, target @ L))

        low, high = in_band(self.options.band_hz, case.loop.T)
        if self.options.objective == "rms":
            w = frequencies(case.E, low=low, high=high, points=80)
            logarithm = np.log(w)
            weight = np.gradient(logarithm) / (logarithm[-1] - logarithm[0])
            add(w, np.sqrt(weight), ideal=True)
        edge = 2 * np.pi * HIGH_HZ * case.loop.T
        if edge < np.pi and self.soft > 0:
            add(np.geomspace(edge, np.pi, 20), np.full(20, self.soft * np.sqrt(1 / 20)), ideal=False)
        return weights

    def _force_rows(self, w: Array, L: Complex, target: Complex, i: int, mine: NDArray[np.intp]) -> Array:
        """Return the derivatives of row i of F L by the unknowns `mine`, and row i of `target`, as real columns."""
        case, z = self.cases[0], on_circle(w)
        moved = case.delayed(z).G[0] @ L * (z ** -float(case.loop.theta[i]))[:, None, None]
        functions, signals = self.span.responses(z), self.span.sources() @ moved
        function, _, source = np.argwhere(self.span.used)[mine[1:] - 1].T
        through = functions[:, function, None] * signals[:, source]  # (k, unknowns, m)
        slope = np.concatenate([moved[:, i, None], through, target[:, i, None]], axis=1).swapaxes(1, 2)
        slope = slope.reshape(-1, slope.shape[2])
        return np.vstack([slope.real, slope.imag])

    def _slopes(self, case: Case, z: Complex) -> Sampled:
        """Return the derivatives of G = R Psi E with respect to g and the entries of R_1, .., (unknowns, k, m, m)."""
        delayed = case.delayed(z).G[0]
        signals = self.span.sources() @ delayed  # (k, sources, m)
        functions = self.span.responses(z)
        G = np.zeros((self.span.unknowns, *delayed.shape), dtype=complex)
        G[0] = delayed
        which = np.argwhere(self.span.used)  # (function, row, source) of unknown 1, 2, ..
        through = functions[:, which[:, 0], None] * signals[:, which[:, 2]]  # (k, unknowns - 1, m)
        G[np.arange(1, len(G)), :, which[:, 1]] = np.swapaxes(through, 0, 1)
        return Sampled(z[None], G, case.loop.T)

    def block(self, part: _Part, w: Array) -> MatrixInequality:
        """Return the inequality of a constraint at the frequencies w, from its values at the unit vectors of x."""
        case, constraint, own = part
        slopes = self._slopes(case, on_circle(w))
        nothing, units = Sampled(slopes.z, np.zeros_like(slopes.G[:1]), slopes.T), np.eye(own.stop - own.start)
        none = np.zeros(len(units))
        constant = constraint.at(nothing, none)
        moved = constraint.at(slopes, none) - constant
        slope = np.zeros((self.unknowns, *constant.shape[1:]), dtype=complex)
        slope[: len(moved)] = moved
        for a, unit in enumerate(units, start=own.start):
            slope[a] = (constraint.at(nothing, unit) - constant)[0]
        return MatrixInequality.of(constant[0], np.swapaxes(slope, 0, 1))

    def _positive(self, at: int) -> MatrixInequality:
        """Return the inequality g > 0, where g is the unknown with the index `at`."""
        slope = np.zeros((1, self.unknowns, 1, 1), dtype=complex)
        slope[0, at] = 1
        return MatrixInequality.of(np.zeros((1, 1, 1), dtype=complex), slope)

    def _dense(self, A: Array, b: Array, c: Array, imposed: list[Array], x: Array) -> _Posed:
        """Return the program in well-conditioned unknowns y, for any constraints."""
        parts = [self.block(part, w) for part, w in zip(self.parts, imposed, strict=True)]
        program, U = Program(A, b, c, joined([*parts, self._positive(0)])).conditioned(x)
        return program, U @ x, lambda y: solve_triangular(U, y)

    @property
    def _entries(self) -> bool:
        """Whether `_by_entries` is possible: m > 2, all entries of R are unknowns, and all blocks have `through`."""
        full = self.span.used.all() and self.span.used.shape[1] == self.span.used.shape[2] > 2
        return bool(full) and all(constraint.through for _, constraint, _ in self.parts)

    def _by_entries(self, A: Array, b: Array, c: Array, imposed: list[Array], x: Array) -> _Posed:
        """Return the program in unknowns y, which are sorted by entries of R, then g.

        The basis functions are orthogonalised, and the inequalities are EntryInequalities, which are faster for m > 2.
        """
        n, m, _ = self.span.used.shape
        z = on_circle(np.unique(np.concatenate(imposed)))
        functions = self.span.responses(z)
        rows = np.vstack([functions, functions / np.abs(z - 1)[:, None]])
        U = triangular_factor(np.vstack([rows.real, rows.imag]))
        turned = lambda X: solve_triangular(U, X, transposed=True)  # noqa: E731

        def there(x: Array) -> Array:
            return np.append((U @ x[1:].reshape(n, -1)).T.ravel(), x[0])

        def back(y: Array) -> Array:
            return np.append(y[-1], solve_triangular(U, y[:-1].reshape(-1, n).T).ravel())

        blocks: list[MatrixInequality | EntryInequality] = [self._positive(self.unknowns - 1)]
        for (case, constraint, _), w in zip(self.parts, imposed, strict=True):
            delayed = case.delayed(on_circle(w))
            one = Sampled(delayed.z, np.tile(np.eye(m, dtype=complex), (1, w.size, 1, 1)), delayed.T)
            none = np.zeros(0)
            constant = constraint.block(0 * delayed, none).G[0]
            left = constraint.unit[:, None] * (constraint.block(one, none).G[0] - constant)
            still = packed(constraint.at(0 * delayed, none)[0])
            g = packed(constraint.at(delayed, none)[0]) - still
            own = turned(self.span.responses(delayed.z[0]).T).T
            blocks.append(EntryInequality(still, own, left, delayed.G[0] * constraint.unit, g[..., None]))
        by_entry = turned(A[:, 1:].T.reshape(n, -1)).reshape(n, m * m, -1).transpose(2, 1, 0).reshape(len(A), -1)
        program = Program(np.column_stack([by_entry, A[:, 0]]), b, there(c), tuple(blocks))
        return program, there(x), back

    def least(self, part: _Part, x: Array, w: Array) -> Array:
        """Return the least eigenvalue of a constraint's block at x for each frequency w, (k,)."""
        case, constraint, own = part
        spend(_POINT * w.size)
        z = on_circle(w)
        R = self.span.matrices(x) @ self.span.sources()
        n, m, _ = R.shape
        filtered = x[0] * np.eye(m) + (self.span.responses(z) @ R.reshape(n, m * m)).reshape(1, -1, m, m)
        delayed = case.delayed(z)
        G = Sampled(delayed.z, filtered @ delayed.G, delayed.T)
        return np.linalg.eigvalsh(constraint.at(G, x[own])[0])[:, 0]

    def grid(self, part: _Part) -> Array:
        """Return the initial frequencies of a constraint [rad/sample]."""
        case, constraint, _ = part
        even = np.linspace(constraint.low, constraint.high, 50)
        rising = np.geomspace(max(constraint.low, _SMALLEST), constraint.high, 60)
        modes = np.concatenate([case.E.poles(), self.span.chain(case.E.T).poles()])
        modes = np.array(_separate(modes[modes.imag > 1e-6]), dtype=complex)
        around = (np.angle(modes)[:, None] + (1 - np.abs(modes))[:, None] * np.array([-1.0, 0.0, 1.0])).ravel()
        w = np.unique(np.concatenate([even, rising, around]))
        return w[(w >= max(constraint.low, _SMALLEST)) & (w <= constraint.high)]

    def room(self, x: Array, grids: Iterable[Array]) -> float:
        """Return the least eigenvalue of all constraints' blocks at x, each on its own grid of frequencies."""
        parts = zip(self.parts, grids, strict=True)
        return min(float(self.least(part, x, w).min(initial=np.inf)) for part, w in parts)

    def sweep(self, part: _Part) -> Array:
        """Return a dense grid over the frequencies of a constraint [rad/sample], which resolves every pole."""
        case, constraint, _ = part
        return frequencies(case.E, self.span.chain(case.E.T), low=max(constraint.low, _SMALLEST), high=constraint.high)

    def missed(self, x: Array) -> tuple[list[Array], float]:
        """Return (frequencies at which x violates each of the `parts`, largest violation)."""
        missing, worst = [], 0.0
        for part in self.parts:
            fails = lambda w, part=part: -self.least(part, x, w)  # noqa: E731
            missing.append(peaks(fails, self.sweep(part), above=0.0))
            worst = max(worst, float(fails(missing[-1]).max(initial=0.0)))
        return missing, worst

    def solve(self, start: Array) -> Array:
        """Return the optimal x, from a strictly feasible start.

        After PROGRAM_SWEEPS rounds x may still violate constraints. With several constraints in an environment, `_kept`
        removes the violations. Otherwise the caller scales the forces down.
        """
        imposed = [self.grid(part) for part in self.parts]
        A, b, c = self.objective()
        posed = self._by_entries if self._entries else self._dense
        nothing = float(b @ b) + float(c.any())  # objective of zero force, whose relative mismatch is 1
        demanding = any(len(case.constraints) > 1 for case in self.cases)
        path, gaps, inner, x = list[tuple[Array, float]](), list(_GAPS), start, start
        for _ in range(budgets.PROGRAM_SWEEPS):
            program, y, back = posed(A, b, c, imposed, x)
            path = path or [(start, program.degree / max(program.value(y), 1e-12))]

            def onward(y: Array, t: float, program: Program = program, gap: float = gaps[0]) -> float:
                value = program.value(y)
                return t if program.degree / t <= gap * max(min(value, nothing - value), 1e-9) else _STEEPER * t

            first = len(path)
            path += [(back(y), t) for y, t in follow(program, y, path[-1][1], onward)]
            (inner, _), (x, last) = path[first], path[-1]
            more, worst = self.missed(x)
            if worst < (_FORGIVEN_OF_MORE if demanding else _FORGIVEN) and len(gaps) == 1:
                break
            gaps = gaps[-1:]
            imposed = [np.union1d(w, extra) for w, extra in zip(imposed, more, strict=True)]
            most = 1.001 * (last / _STEEPER**4 if demanding else last)
            while len(path) > 1 and (path[-1][1] > most or self.room(path[-1][0], more) <= 0):
                path.pop()
            x = path[-1][0]
        return self._kept(inner, start, x) if demanding else x

    def _kept(self, inner: Array, start: Array, x: Array) -> Array:
        """Return a point on the line from x to an interior point that satisfies all constraints on the dense sweep.

        The least eigenvalue is concave along this line. So its values at both ends determine how far from x the point
        has to be. The interior point is `inner` if that is feasible, or `start`.
        """
        _, worst = self.missed(x)
        for base in (inner, start):
            if (room := self.room(base, [self.sweep(part) for part in self.parts])) > 0:
                return base + max(0.0, 1 - 1.01 * worst / (worst + room)) * (x - base)
        return start


def _evened(E: Complex, size: Array) -> Complex:
    """Return L (k, m, m), with which |M L|^2 is |M|^2 plus a weight of the errors in motions with small forces.

    Divided by |E|^2, this weight is _EVEN times the mean of |M v|^2/(|E v|^2 + _LEAST_FORCE^2 |E|^2) over the m right
    singular vectors v of E. Without it, couplings with nearly the same mismatch M may differ much in these motions.
    """
    unit, one = E / size[:, None, None], np.eye(E.shape[-1], dtype=np.complex128)
    faint = np.linalg.inv(np.conj(np.swapaxes(unit, 1, 2)) @ unit + _LEAST_FORCE**2 * one).astype(np.complex128)
    return np.linalg.cholesky(one + _EVEN / len(one) * hermitian(faint)).astype(np.complex128)


def static_weight(loop: Loop) -> float:
    """Return the weight of g - 1, the lost static stiffness, in the objective."""
    return _STATIC if loop.channels <= _RICH else _STATIC_OF_MANY
