"""Spring-damper gains for one environment: a local search from several starts, under a condition that is sampled.

The set is not convex in (K, B), so nothing here is proved best. The rms mismatch is minimised by sequential quadratic
programming with the condition at sampled frequencies; where the refined sweep of the condition finds it violated in
between, that frequency is added and the search resumed. What is returned passes that sweep.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from controller.coupling import SpringDamper
from controller.delay import delay
from controller.loop import DelayRange, Loop
from controller.lti import Array, Sampled
from design.conditions import even_damping, this_environment, this_environment_demand
from design.environments import LIMITER, SWITCHING
from design.frequency import frequencies, hermitian, on_circle
from design.lmi import RESERVE, Complex
from design.result import Requirement
from design.transparency import BAND_HZ, transparency

if TYPE_CHECKING:  # slow to load
    from scipy.optimize import OptimizeResult

#: The sampled condition keeps half as much again as the promised reserve, for what lies between the samples.
_SAMPLED_RESERVE = 1.5 * RESERVE
_SOFTEST, STIFFEST = 1.0, 1e6  # [N/m], bounds of the search
_CLOSEST_POLE = 1e-5  # from the unit circle
_FIRST_WEIGHT, _MOST_WEIGHT = 0.5, 5.0  # of the limiter's multiplier
_STUCK = 1e-3  # a search that leaves the sampled condition violated by this has no feasible point nearby
_MOST_ROUNDS = 8
#: Devices up to which steps are cheap; steps from every start beyond, from the likeliest one, and from each of these.
FEW, _MOST_STEPS = 12, (15, 60, 100)
_ROUGH = 0.01  # a violation that further steps will mend


_Responses = tuple[Complex, Complex, Complex]  # (z-1)/(Tz), Psi E and Theta at some frequencies
_DIFFERENCE = 1e-7


def damper_rate(z: Complex, T: float) -> Complex:
    """(z-1)/(Tz) [1/s], what a damper of 1 N s/m adds to the stiffness of a spring-damper; the shape of z."""
    return SpringDamper([1.0], [1.0]).sampled(z, T).inverse().G[..., 0, 0] - 1


def polynomials(theta: int, w: Array) -> tuple[Array, Array]:
    """1 + ... + z^-theta and 1 - z^-n at exp(jw), complex, (w,) each."""
    n = theta + 1
    turned = np.exp(-1j * w * n)
    still = np.abs(np.exp(-1j * w) - 1) < 1e-12
    window = np.where(still, n, (1 - turned) / np.where(still, 1, 1 - np.exp(-1j * w)))
    return window, 1 - turned


class SampledLoop:
    """Mismatch and condition at fixed frequencies, as smooth functions of x = (log K, B/delta, ..).

    The gains are the first 2N entries; behind them are the unknowns of a condition's multiplier, where it has some.
    """

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.loop, self.E = loop, loop.E()
        per_hz = 2 * np.pi * loop.T
        low, high = (per_hz * f for f in band_hz)
        self.band = frequencies(self.E, low=low, high=min(high, np.pi), points=80)
        self.conditions = frequencies(self.E, low=1e-3, points=80)
        self.loop_in_band = self._responses(self.band)
        self.loop_at_conditions, self.of_one = self._responses(self.conditions), self._of_one()
        E = self.E.at(on_circle(self.band))
        self.size2 = (np.abs(E) ** 2).sum(axis=(1, 2))
        self.target = delay(loop.lam, loop.T).at(on_circle(self.band)) @ E
        self.delta = even_damping(loop)
        self.root = np.sqrt(loop.T / self.delta)
        self._last: tuple[_Responses, Array, Array, Complex] | None = None
        self._known: dict[int, tuple[_Responses, Array, tuple[Complex, Array, Complex, Complex]]] = {}

    def coupling(self, x: Array) -> SpringDamper:
        log_k, b = np.split(self._gains(x), 2)
        return SpringDamper(np.exp(log_k), np.maximum(b, 0.0) * self.delta)

    def _gains(self, x: Array) -> Array:
        return x[: 2 * self.loop.channels]

    def point(self, coupling: SpringDamper) -> Array:
        return np.concatenate([np.log(coupling.K), coupling.B / self.delta])

    def judged(self, x: Array) -> Requirement:
        """What the refined sweep of its condition says of the gains at x."""
        return this_environment(self.loop.F(self.coupling(x)), self.loop)

    def add(self, w: float) -> None:
        """Impose the condition at the frequency w [rad/sample] too."""
        self.conditions = np.append(self.conditions, w)
        self.loop_at_conditions, self.of_one = self._responses(self.conditions), self._of_one()

    def multiplier(self, x: Array) -> Sequence[Sequence[float]] | None:
        """The limiter's multiplier c in x, where the condition has one."""
        return None

    def _of_one(self) -> Complex:
        """The block of this-environment without its damping where F is 1, (k,): it is proportional to F."""
        F = Sampled(
            on_circle(self.conditions)[None], np.ones((1, self.conditions.size, 1, 1), dtype=np.complex128), self.loop.T
        )
        return this_environment_demand(F, self.loop.channel(0)).free.G[0, :, 0, 0]

    def _responses(self, w: Array) -> _Responses:
        """(z-1)/(Tz), Psi E and Theta at exp(jw)."""
        loop, z = self.loop, on_circle(w)
        delayed = delay(loop.psi, loop.T).at(z) @ self.E.at(z)
        return (z - 1) / (loop.T * z), delayed, delay(loop.theta, loop.T).at(z)

    def force(self, x: Array, responses: _Responses) -> Complex:
        """F = Theta G (G + Psi E)^-1 Psi E with G = V^-1, (k, N, N)."""
        by, b, _, right = self._solved(self._gains(x), responses)
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
        _, E, theta = self.loop_in_band
        by, _, S, right = self._solved(self._gains(x), self.loop_in_band)
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
        turned = into * (right @ v)[:, :, 0] * self.of_one[:, None]
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
            self._last = (at, x.copy(), *self._least_of(self._block(x)))
        return self._last[2], self._last[3]

    def _least_of(self, block: Complex) -> tuple[Array, Complex]:
        values, vectors = np.linalg.eigh(self.root[:, None] * block * self.root)
        return values[:, 0].astype(float), vectors[:, :, 0] * self.root

    def _block(self, x: Array) -> Complex:
        """What must be positive definite with the damping, at each sampled frequency, Hermitian."""
        return hermitian(self.force(x, self.loop_at_conditions) * self.of_one[:, None, None])

    def stability(self, x: Array) -> float:
        """By how much more than CLOSEST_POLE the poles keep away from the circle."""
        poles = self.loop.F(self.coupling(x)).poles()
        return float(1 - _CLOSEST_POLE - np.abs(poles).max(initial=0.0))

    def search(self, x: Array, most: int) -> OptimizeResult:
        """The local optimum from x, by so many steps."""
        return self.minimised(x, most, [], self.room_slope)

    def minimised(
        self, x: Array, most: int, more: list[tuple[float, float]], slope: Callable[[Array], Array] | None = None
    ) -> OptimizeResult:
        """The local optimum from x; `more` bounds what is behind the gains; without `slope` room is differenced."""
        N = self.loop.channels
        from scipy.optimize import minimize  # slow to load

        bounds = [(np.log(_SOFTEST), np.log(STIFFEST))] * N + [(0.0, 20.0)] * N + more
        condition = {"type": "ineq", "fun": self.room, "jac": slope}
        options = {"maxiter": most, "ftol": 1e-7}
        problem = {"bounds": bounds, "constraints": condition, "options": options}
        return minimize(self.square_mismatch, x, jac=self.square_mismatch_slope, method="SLSQP", **problem)


# ----------------------------------------------------------------------------------------------------
# Spring-damper gains that are safe under any switching of their delays: a local search like the one above.
#
# Its sampled condition is that of `SWITCHING`: the multiplier is searched together with the gains. What is returned
# passes the sweep of `SWITCHING`, which knows nothing of the multiplier found here.


_FIRST = 0.5  # the multiplier alpha T/delta that a search begins with where the start has none
_MULTIPLIERS = (1e-4, 10.0)  # ... and its bounds


class SwitchingLoop(SampledLoop):
    """As SampledLoop, with x = (log K, B/delta, log alpha T/delta of the channels whose delay varies)."""

    def __init__(self, loop: Loop, lo: Sequence[int], hi: Sequence[int]) -> None:
        self.active = np.flatnonzero(np.subtract(hi, lo))
        super().__init__(loop.switching(DelayRange(tuple(lo), tuple(hi))))

    def point(self, coupling: SpringDamper) -> Array:
        """The gains with their best multiplier."""
        loop = self.loop
        found = SWITCHING.required(loop, coupling)
        a = np.array(found.multiplier or self.delta * _FIRST / loop.T)[self.active] * loop.T / self.delta[self.active]
        a = np.clip(a, *_MULTIPLIERS)
        return np.concatenate([super().point(coupling), np.log(a)])

    def judged(self, x: Array) -> Requirement:
        return SWITCHING.required(self.loop, self.coupling(x))

    def room(self, x: Array) -> Array:
        """1 - SAMPLED_RESERVE less the damping ratio at each sampled frequency, with the multiplier in x."""
        loop, m, alpha = self.loop, self.loop.channels, np.zeros(self.loop.channels)
        alpha[self.active] = np.exp(x[2 * m :]) * (self.delta / loop.T)[self.active]
        D, E, _ = self.loop_at_conditions
        now = np.broadcast_to(np.eye(m, dtype=complex), E.shape)
        G = Sampled(on_circle(self.conditions)[None], self.force(x, (D, E, now))[None], loop.T)
        demand = SWITCHING.block(G, loop, alpha)
        block = hermitian((demand.free + demand.gain).G[0])
        error = block[:, m:, :m]
        schur = block[:, :m, :m] - np.conj(np.swapaxes(error, 1, 2)) @ (error / (2 * alpha[self.active])[:, None])
        room = (np.linalg.eigvalsh(self.root[:, None] * schur * self.root)[:, 0] - _SAMPLED_RESERVE).astype(float)
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def search(self, x: Array, most: int) -> OptimizeResult:
        return self.minimised(x, most, [(np.log(_MULTIPLIERS[0]), np.log(_MULTIPLIERS[1]))] * self.active.size)


# ----------------------------------------------------------------------------------------------------
# Spring-damper gains that are safe also while forces are limited: the same search with the limiter's block
# (design.environments.Limiter) in the place of the linear one, and its multiplier among the unknowns.


class LimiterLoop(SampledLoop):
    """As Sampled, with x = (log K, B/delta, c) and one weight c per channel, of the lag 1."""

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.rho = LIMITER.rho(loop)
        self._undelayed: tuple[_Responses, _Responses] | None = None
        super().__init__(loop, band_hz)

    def point(self, coupling: SpringDamper) -> Array:
        """The gains with a usual multiplier."""
        return np.append(super().point(coupling), np.full(self.loop.channels, _FIRST_WEIGHT))

    def judged(self, x: Array) -> Requirement:
        return LIMITER.required(self.loop, self.coupling(x), self._weights(x).ravel())

    def room(self, x: Array) -> Array:
        """The least eigenvalue of the block, in units of Delta_D/T, at each sampled frequency."""
        room = self._least(x)[0]
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def room_slope(self, x: Array) -> Array:
        """Its gradient: the block's first columns hold G, and c_i takes itself from N_i."""
        loop, (_, E, theta), v = self.loop, self.loop_at_conditions, self._least(x)[1]
        (by, _, S, right), z = self._solved(self._gains(x), self._now()), on_circle(self.conditions)[:, None]
        first, second = np.split(v, 2, axis=1)
        N, late = self._lines(x), np.diagonal(theta, axis1=1, axis2=2) * self.of_one[:, None]
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

    def _lines(self, x: Array) -> Array:
        """N of the block of `LIMITER`, (k, m)."""
        windows = [polynomials(n, self.conditions)[0] for n in self.loop.theta]
        return -np.stack(windows, axis=1) - self._weights(x).T

    def _least(self, x: Array) -> tuple[Array, Complex]:
        """Of the Schur complement of the slip's own corner, which is diagonal and positive for any c >= 0."""
        at = self.loop_at_conditions
        if self._last is None or self._last[0] is not at or not np.array_equal(self._last[1], x):
            first, cross, corner = self.parts(x)
            follows = -cross / corner[:, :, None]
            least, v = self._least_of(first + np.conj(np.swapaxes(cross, 1, 2)) @ follows)
            self._last = (at, x.copy(), least, np.concatenate([v, (follows @ v[:, :, None])[:, :, 0]], axis=1))
        return self._last[2], self._last[3]

    def parts(self, x: Array) -> tuple[Complex, Complex, Array]:
        """The Hermitian part of the block of `LIMITER` with what the reserve leaves of the damping.

        Its first block (k, m, m), the one below that, and the diagonal (k, m) of its last one, which is diagonal: to
        make it whole, as that function does of any G, takes four times as long.
        """
        z, theta = on_circle(self.conditions)[:, None], np.diagonal(self.loop_at_conditions[2], axis1=1, axis2=2)
        G, N, one = self.force(x, self._now()), self._lines(x), np.eye(self.loop.channels)
        damping, rho = (1 - _SAMPLED_RESERVE) * self.delta / self.loop.T, np.array(self.rho)
        first = hermitian((theta * self.of_one[:, None])[:, :, None] * G) + damping * one
        across = damping - np.conj(rho * theta / z) / 2
        return first, N[:, :, None] * G / 2 + across[:, :, None] * one, damping - (N * (1 - 1 / z)).real * rho

    def search(self, x: Array, most: int) -> OptimizeResult:
        return self.minimised(x, most, [(0.0, _MOST_WEIGHT)] * self.loop.channels, self.room_slope)

    def multiplier(self, x: Array) -> Sequence[Sequence[float]]:
        return np.round(self._weights(x), 6).tolist()

    def _weights(self, x: Array) -> Array:
        """c, a row of one lag per channel."""
        return np.maximum(x[2 * self.loop.channels :, None], 0.0)


# ----------------------------------------------------------------------------------------------------
# The search: frequencies are added where a refined sweep finds the condition violated between those sampled.


def _optimum(sampled: SampledLoop, start: SpringDamper) -> tuple[Array | None, int]:
    """(x of a local optimum that passes the refined sweep of its condition or None, searches)."""
    x = sampled.point(start)
    for searches in range(1, _MOST_ROUNDS + 1):
        x = sampled.search(x, _MOST_STEPS[1 + (sampled.loop.channels <= FEW)]).x
        requirement = sampled.judged(x)
        if requirement.ratio <= 1 - RESERVE:
            return x, searches
        stuck = sampled.room(x).min() < -_STUCK
        if stuck or requirement.frequency_hz is None:  # None: unstable, so there is no frequency to add
            return None, searches
        sampled.add(max(2 * np.pi * sampled.loop.T * requirement.frequency_hz, 1e-6))
    return None, _MOST_ROUNDS


def least_rms(
    sampled: Callable[[], SampledLoop], starts: Iterable[SpringDamper], band_hz: tuple[float, float] = BAND_HZ
) -> tuple[SpringDamper | None, float, int, Sequence[Sequence[float]] | None]:
    """(gains, rms mismatch as a ratio, searches, multiplier) of the best local optimum; gains None if none was found.

    `sampled` makes the condition, fresh for every start. Of more than FEW devices, where starts hardly matter and
    steps are expensive, the first optimum is taken (`likeliest_first`).
    """
    best, least, searches, multiplier = None, np.inf, 0, None
    for start in starts:
        loop = (condition := sampled()).loop
        x, runs = _optimum(condition, start)
        searches += runs
        if x is None:
            continue
        coupling = condition.coupling(x)
        rms = transparency(loop.F(coupling), loop.E(), loop.lam, band_hz).rms_mismatch
        if rms < least:
            best, least, multiplier = coupling, rms, condition.multiplier(x)
        if loop.channels > FEW:
            break
    return best, least, searches, multiplier


def likeliest_first(sampled: SampledLoop, starts: Sequence[SpringDamper]) -> list[SpringDamper]:
    """Where a few steps lead from each start, the least mismatch first; last what then still violates the condition."""
    points = [sampled.search(sampled.point(start), _MOST_STEPS[0]).x for start in starts]
    points.sort(key=lambda x: (sampled.room(x).min() < -_ROUGH, sampled.square_mismatch(x)))
    return [sampled.coupling(x) for x in points]
