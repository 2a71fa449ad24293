"""Search spring-damper gains for one environment, from several starts (called by design.spring_damper).

The set of certified gains is not convex in (K, B), so the result may be a local optimum. Sequential quadratic
programming (SLSQP) minimises the rms mismatch with the condition at sampled frequencies. The frequency at which a
refined sweep finds the worst violation is added, until the gains pass the sweep or a budget is spent.

The block of a condition is affine in G = (I + Psi E V)^-1 Psi E and, for fixed G, in the multiplier. So its
responses at G = 0 and G = I, each with the multipliers 0 and 1, determine all its values and slopes. Only the block of
known devices is not affine in its multiplier; `KnownDeviceLoop` computes it anew at every step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.arithmetic import compiled
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Complex, Lti, Sampled
from haptic_loop.design import budgets
from haptic_loop.design.conditions import Demand, even_damping, this_environment, this_environment_demand
from haptic_loop.design.environments import LIMITER, SWITCHING
from haptic_loop.design.frequency import frequencies, hermitian, least_eigenpair, on_circle
from haptic_loop.design.known_device import KNOWN_DEVICE, device_rows, largest_beta, period_cost
from haptic_loop.design.lmi import RESERVE
from haptic_loop.design.result import Requirement
from haptic_loop.design.transparency import BAND_HZ, in_band, rms_mismatch

#: unused share of the damping at sampled frequencies, because the gains may need more damping between them
_SAMPLED_RESERVE = 1.5 * RESERVE
STIFFEST = 1e6  # [N/m] largest K in the search
_CLOSEST_POLE = 1e-5  # least distance of the loop's poles from the unit circle
_STUCK = 1e-3  # A search whose result violates the condition by more than this is given up.
FEW = 12  # Up to this number of channels a step of the search is cheap, so that all starts are tried.
_ROUGH = 0.01  # A start whose gains violate the condition by more than this is tried last.
_DIFFERENCE = 1e-7  # step of finite differences in x


def softest(loop: Loop) -> float:
    """Return the least K in the search: 1 N/m, or for rotary devices the share 1e-4 of 2 delta/T [N m/rad]."""
    return 1.0 if loop.unit == "m" else 2e-4 * min(loop.delta) / loop.T


def damper_rate(z: Complex, T: float) -> Complex:
    """Return (z-1)/(Tz) [1/s], the dynamic stiffness of a damper of 1 N s/m, in the shape of z."""
    return SpringDamper([1.0], [1.0]).sampled(z, T).inverse().G[..., 0, 0] - 1


class _Responses:
    """Responses of a loop at fixed frequencies for its spring-damper gains (log K, B/delta), cached for the last gains.

    Args:
        delayed: Psi E.
        w: (k,) frequencies [rad/sample].
        delta: (m,) unit of B [N s/m].
    """

    def __init__(self, delayed: Lti, w: Array, delta: Array) -> None:
        self.z = on_circle(w)
        self._delayed = Sampled.of(delayed, self.z[None])
        self._rate = damper_rate(self.z, delayed.T)[:, None] * delta  # derivative of 1/V with respect to B/delta
        self._last: tuple[Array, Complex, Array | Complex] | None = None

    def around(self, gains: Array) -> tuple[Complex, Array | Complex]:
        """Return G = (I + Psi E V)^-1 Psi E (k, m, m) at k frequencies, and factors `by` (2, k, m) of its derivatives.

        At frequency k, dG/d(log K_i) is by[0, k, i] times column i of G times row i of G. The derivative by B_i/delta_i
        has the factor by[1, k, i].
        """
        if self._last is None or not np.array_equal(self._last[0], gains):
            log_k, b = np.split(gains, 2)
            K = np.exp(log_k)
            compliance = 1 / (K + np.maximum(b, 0.0) * self._rate)
            V = Sampled(self._delayed.z, compliance[None, :, :, None] * np.eye(K.size), self._delayed.T)
            by = compliance**2 * np.stack([np.broadcast_to(K, self._rate.shape), self._rate])
            self._last = gains.copy(), self._delayed.feedback(V).G[0], by
        return self._last[1:]


def _theta(loop: Loop, z: Complex) -> Complex:
    """Return the diagonal of Theta, the forces' delays, at z (k,), as (k, m, 1)."""
    one = Sampled(z[None], np.tile(np.eye(loop.channels, dtype=complex), (1, z.size, 1, 1)), loop.T)
    return np.diagonal(loop.late(one).G[0], axis1=1, axis2=2)[:, :, None]


class SampledLoop:
    """Mismatch and condition at fixed frequencies, as smooth functions of x = (log K, B/delta, ..).

    delta (m,) is that of `even_damping`. In x the unknowns of the condition's multiplier follow the 2m gains. The
    condition of this class is this-environment, which has no multiplier.
    """

    #: indices of the channels with a multiplier, each of which adds a row to the block; in KnownDeviceLoop, devices
    active: NDArray[np.intp] = np.zeros(0, dtype=int)
    #: bounds of the entries of x for the multiplier
    bounds = (0.0, 0.0)

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.loop, E = loop, loop.E()
        low, high = in_band(band_hz, loop.T)
        self.delta = even_damping(loop)
        self.root = np.sqrt(loop.T / self.delta)
        self.delayed = delay(loop.psi, loop.T) @ E
        self.band = frequencies(E, low=low, high=high, points=80)
        self._in_band = _Responses(self.delayed, self.band, self.delta)
        z = self._in_band.z
        self.late, there = _theta(loop, z), E.at(z)
        self.size2 = (np.abs(there) ** 2).sum(axis=(1, 2))
        self.target = delay(loop.lam, loop.T).at(z) @ there
        self._impose(frequencies(E, low=1e-3, points=80))

    def coupling(self, x: Array) -> SpringDamper:
        log_k, b = np.split(self._gains(x), 2)
        return SpringDamper(np.exp(log_k), np.maximum(b, 0.0) * self.delta)

    def _gains(self, x: Array) -> Array:
        return x[: 2 * self.loop.channels]

    def point(self, coupling: SpringDamper) -> Array:
        """Return the x at which a search starts with these gains."""
        return np.concatenate([np.log(coupling.K), coupling.B / self.delta])

    def judged(self, x: Array) -> Requirement:
        """Return the required damping of the gains at x, from a refined sweep of the condition."""
        return this_environment(self.loop.F(self.coupling(x)), self.loop)

    def demand(self, G: Sampled, mu: Array) -> Demand[Sampled]:
        """Return the condition's block for G and the multiplier mu (active,), as a Demand."""
        return this_environment_demand(self.loop.late(G), self.loop)

    def mu(self, x: Array) -> tuple[Array, Array]:
        """Return the multiplier mu (active,) at x, and its derivative (active, active) by its unknowns in x."""
        return np.zeros(0), np.zeros((0, 0))

    def multiplier(self, x: Array) -> Sequence[Sequence[float]] | None:
        """Return the limiter's multiplier c at x, or None for conditions without a limiter."""
        return None

    def add(self, w: float) -> None:
        """Add w [rad/sample] to the frequencies at which the condition is imposed."""
        self._impose(np.append(self.conditions, w))

    def _impose(self, w: Array) -> None:
        """Sample the loop at w (k,), and the block's entries at G = mu = 0 with their slopes in G, mu and G mu."""
        self.conditions, m = w, self.loop.channels
        self._imposed = _Responses(self.delayed, w, self.delta)
        self._last: tuple[Array, Array, Complex] | None = None
        both = np.stack([0 * np.eye(m), np.eye(m)]).astype(np.complex128)  # G = 0 and G = I
        response = Sampled(on_circle(w)[None], np.broadcast_to(both[:, None], (2, w.size, m, m)), self.loop.T)
        first, second = np.arange(m), np.arange(m, m + self.active.size)
        rows = np.concatenate([first, second, self.active, second])
        columns = np.concatenate([first, self.active, second, second])

        def entries(mu: float) -> Complex:
            demand = self.demand(response, np.full(self.active.size, mu))
            H = (demand.free + demand.gain * (1 - _SAMPLED_RESERVE)).G
            return np.broadcast_to(H, (2, *H.shape[1:]))[:, :, rows, columns]

        none, of_G = entries(0)
        of_mu, of_both = entries(1) if self.active.size else (none, of_G)
        self._affine = none, of_G - none, of_mu - none, of_both - of_G - of_mu + none

    def square_mismatch(self, x: Array) -> float:
        """Return the logarithm of the mean square mismatch ||M||_F^2/||E||_F^2 over log frequency."""
        log_w = np.log(self.band)
        return float(np.log(self._mean(x) / (log_w[-1] - log_w[0])))

    def _mean(self, x: Array) -> float:
        M = self.late * self._in_band.around(self._gains(x))[0] - self.target
        return float(np.trapezoid((np.abs(M) ** 2).sum(axis=(1, 2)) / self.size2, np.log(self.band)))

    def square_mismatch_slope(self, x: Array) -> Array:
        """Return the gradient of `square_mismatch`; its entries after those of the gains are 0."""
        G, by = self._in_band.around(self._gains(x))
        F = self.late * G
        back = np.einsum("kij,kji->ki", G @ (F - self.target).conj().swapaxes(1, 2), F)
        moved = 2 * (back * by).real / self.size2[:, None]
        slope = np.trapezoid(moved, np.log(self.band), axis=1).ravel() / self._mean(x)
        return np.concatenate([slope, np.zeros(x.size - slope.size)])

    def room(self, x: Array) -> Array:
        """Return the margin of the condition at each sampled frequency, (k,).

        If psi >= 1, `stability` is appended, because an unstable loop may satisfy the condition at all frequencies.
        """
        room = self._margins(x)
        return np.append(room, self.stability(x)) if any(self.loop.psi) else room

    def room_slope(self, x: Array) -> Array:
        """Return the gradient of `room`, (k or k + 1, entries of x), with finite differences for `stability`."""
        slope = self._margin_slopes(x)
        if not any(self.loop.psi):
            return slope
        at, steps = self.stability(x), _DIFFERENCE * np.eye(x.size)
        return np.vstack([slope, [(self.stability(x + step) - at) / _DIFFERENCE for step in steps]])

    def _margins(self, x: Array) -> Array:
        """Return the least eigenvalue (k,) of the condition's block, in units of delta/T."""
        return self._least(x)[0]

    def _margin_slopes(self, x: Array) -> Array:
        """Return the gradient of `_margins`, (k, entries of x)."""
        (G, by), (_, v), (mu, moves) = self._imposed.around(self._gains(x)), self._least(x), self.mu(x)
        m, active = self.loop.channels, self.active
        Gv = np.einsum("kij,kj->ki", G, v[:, :m])
        _, of_G, of_mu, of_both = self._affine
        of_G = of_G + of_both * self._spread(mu)
        left = v[:, :m].conj() * of_G[:, :m]
        left[:, active] += v[:, m:].conj() * of_G[:, m : m + active.size]
        turned = np.einsum("ki,kij->kj", left, G) * Gv
        slope = [*(turned * by).real]
        if active.size:
            rows = np.concatenate([v[:, :m], v[:, m:], v[:, active], v[:, m:]], axis=1).conj()
            here = np.concatenate([v[:, :m], v[:, active], v[:, m:], v[:, m:]], axis=1)
            sent = np.concatenate([Gv, Gv[:, active], 0 * v[:, m:], 0 * v[:, m:]], axis=1)
            each = (rows * (of_mu * here + of_both * sent)).real
            by_mu = each[:, active] + sum(np.split(each[:, m:], 3, axis=1))
            slope.append(by_mu @ moves)
        return np.concatenate(slope, axis=1)

    def _spread(self, mu: Array) -> Array:
        """Return the factor mu of each stored entry of the block, (m + 3 active,)."""
        first = np.zeros(self.loop.channels)
        first[self.active] = mu
        return np.concatenate([first, mu, mu, mu])

    def parts(self, x: Array) -> tuple[Complex, Complex, Array]:
        """Return parts of He[block]: upper left (k, m, m), lower left (k, active, m), diagonal of lower right."""
        G, mu = self._imposed.around(self._gains(x))[0], self._spread(self.mu(x)[0])
        m, p = self.loop.channels, self.active.size
        none, of_G, of_mu, of_both = self._affine
        fixed, of_G = none + of_mu * mu, of_G + of_both * mu
        first, below = of_G[:, :m, None] * G, of_G[:, m : m + p, None] * G[:, self.active] / 2
        first[:, range(m), range(m)] += fixed[:, :m]
        below[:, range(p), self.active] += (fixed[:, m : m + p] + fixed[:, m + p : m + 2 * p].conj()) / 2
        return hermitian(first), below, fixed[:, m + 2 * p :].real

    def _least(self, x: Array) -> tuple[Array, Complex]:
        """Return the least eigenvalue (k,) of the block's Schur complement, and v (k, m + active); cached for one x.

        The lower right part of the block is diagonal and positive, and the Schur complement eliminates its rows. The
        eigenvalue is in units of delta/T. The first m entries of v are the eigenvector, and the others minimise
        v* block v.
        """
        if self._last is None or not np.array_equal(self._last[0], x):
            first, below, corner = self.parts(x)
            follows = -below / corner[:, :, None]
            schur = first + np.conj(np.swapaxes(below, 1, 2)) @ follows
            values, v = least_eigenpair(self.root[:, None] * schur * self.root)
            v = v * self.root
            vectors = np.concatenate([v, np.einsum("kij,kj->ki", follows, v)], axis=1)
            self._last = x.copy(), values, vectors
        return self._last[1], self._last[2]

    def stability(self, x: Array) -> float:
        """Return the least distance of the loop's poles from the unit circle, minus _CLOSEST_POLE."""
        poles = self.loop.F(self.coupling(x)).poles()
        return float(1 - _CLOSEST_POLE - np.abs(poles).max(initial=0.0))

    def search(self, x: Array, most: int) -> Array:
        """Return x after at most `most` steps of SLSQP towards a local optimum."""
        m = self.loop.channels
        springs = np.log(softest(self.loop)), np.log(STIFFEST)
        bounds = [springs] * m + [(0.0, 20.0)] * m + [self.bounds] * self.active.size
        return _slsqp(self.square_mismatch, self.square_mismatch_slope, self.room, self.room_slope, x, bounds, most)


_Function = Callable[[Array], Any]
_SETTLED = 1e-7  # absolute change of the objective at which SLSQP ends


def _slsqp(
    f: _Function, slope: _Function, room: _Function, room_slope: _Function, x: ArrayLike, bounds: Any, most: int
) -> Array:
    """Minimise f subject to room(x) (m,) >= 0 by at most `most` steps of SLSQP; return x (n,).

    With SciPy 1.17 the compiled routine is called in a loop like that of `scipy.optimize.minimize`, because the import
    of scipy.optimize takes 0.2 s. The routine's state and workspace differ between releases, so that `minimize` itself
    is called with any other release.
    """
    import scipy  # slow to load

    if not scipy.__version__.startswith("1.17."):
        condition, options = {"type": "ineq", "fun": room, "jac": room_slope}, {"maxiter": most, "ftol": _SETTLED}
        optimum = scipy.optimize.minimize(
            f, x, jac=slope, bounds=bounds, constraints=condition, method="SLSQP", options=options
        )
        return optimum.x
    step = compiled("scipy.optimize._slsqplib").slsqp
    low, high = (np.array(each, dtype=float) for each in zip(*bounds, strict=True))
    x = np.clip(np.asarray(x, dtype=float), low, high)
    value, gradient, rooms = f(x), slope(x), np.array(room(x), dtype=float)
    normals = np.array(room_slope(x), dtype=float, order="F")
    m, n = normals.shape
    state = dict.fromkeys(("alpha", "f0", "gs", "h1", "h2", "h3", "h4", "t", "t0"), 0.0)
    state |= dict.fromkeys(("exact", "inconsistent", "reset", "iter", "line", "meq", "mode"), 0)
    state |= {"acc": _SETTLED, "tol": 10 * _SETTLED, "itermax": most, "m": m, "n": n}
    multipliers, indices = np.zeros(m + 2 * n + 2), np.zeros(m + 2 * n + 2, dtype=np.int32)
    # The workspace is twice as large as that of `minimize`.
    buffer = np.zeros(2 * (n * (n + 1) // 2 + 3 * m * n + 9 * m + 8 * n * n + 35 * n + 28))
    while True:
        step(state, value, gradient, normals, rooms, x, multipliers, low, high, buffer, indices)
        if state["mode"] == 1:
            value, rooms[:] = f(x), room(x)
        elif state["mode"] == -1:
            gradient, normals[:] = slope(x), room_slope(x)
        else:
            return x


def _shared(loop: Loop) -> tuple[list[int], Array]:
    """Return each device's first channel, and the matrix (m, m) that replaces values by their mean over a device."""
    of = np.array(loop.per_channel(range(len(loop.devices))))
    return [own.start for own in loop.devices], (of[:, None] == of) / np.bincount(of)[of]


class SwitchingLoop(SampledLoop):
    """The loop under any switching of delays: x = (log K, B/delta, log(alpha T/delta) of `active`).

    alpha [N/m] is the multiplier of `SWITCHING`. `judged` ignores the alpha in x and searches the best one.
    """

    bounds = (np.log(1e-4), np.log(10.0))

    def __init__(self, loop: Loop) -> None:
        self.active = np.flatnonzero(np.subtract(loop.delays.hi, loop.delays.lo))
        self.lead, self.shared = _shared(loop)
        self.unit = np.array(loop.per_channel(loop.per_device(even_damping(loop)).tolist())) / loop.T
        super().__init__(loop)

    def point(self, coupling: SpringDamper) -> Array:
        """Return x of the gains and of their best multiplier, or alpha T/delta = 0.5 if no multiplier is found."""
        multiplier = SWITCHING.required(self.loop, coupling).multiplier
        alpha = np.array(self.loop.per_channel(multiplier)) if multiplier else 0.5 * self.unit
        a = (alpha / self.unit)[self.active]
        return np.concatenate([super().point(coupling), np.clip(np.log(np.maximum(a, 1e-300)), *self.bounds)])

    def judged(self, x: Array) -> Requirement:
        return SWITCHING.required(self.loop, self.coupling(x))

    def demand(self, G: Sampled, mu: Array) -> Demand[Sampled]:
        alpha = np.zeros(self.loop.channels)
        alpha[self.active] = mu
        return SWITCHING.block(G, self.loop, alpha[self.lead])

    def mu(self, x: Array) -> tuple[Array, Array]:
        logs, unit = x[2 * self.loop.channels :], self.unit[self.active]
        shared = self.shared[np.ix_(self.active, self.active)]
        alpha = np.exp(shared @ logs) * unit
        return alpha, alpha[:, None] * shared


class LimiterLoop(SampledLoop):
    """The loop with limited forces: x = (log K, B/delta, c), where c (m,) is the multiplier of `LIMITER`."""

    bounds = (0.0, 5.0)

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.active = np.arange(loop.channels)
        self.lead, self.shared = _shared(loop)
        super().__init__(loop, band_hz)

    def point(self, coupling: SpringDamper) -> Array:
        return np.append(super().point(coupling), np.full(self.loop.channels, 0.5))

    def judged(self, x: Array) -> Requirement:
        return LIMITER.required(self.loop, self.coupling(x), self.mu(x)[0][self.lead])

    def demand(self, G: Sampled, mu: Array) -> Demand[Sampled]:
        return LIMITER.block(G, self.loop, mu[self.lead])

    def mu(self, x: Array) -> tuple[Array, Array]:
        c = np.maximum(x[2 * self.loop.channels :], 0.0)
        return self.shared @ c, self.shared

    def multiplier(self, x: Array) -> Sequence[Sequence[float]]:
        return np.round(self.mu(x)[0][self.lead, None], 6).tolist()


class KnownDeviceLoop(SampledLoop):
    """The loop on known devices: x = (log K, B/delta, log(beta/largest beta) of each device).

    The condition is He[F/(z-1)] + l11 - M* M/(4 l22) > 0 with M = -beta F/z + l21 (not the mismatch). `device_rows`
    returns the entries l11 and l22 of the cost's matrix, and l21, which is twice its entry 21. The left side is the
    Schur complement of the block of known-device, without the rows of speeds.
    """

    bounds = (np.log(1e-3), np.log(0.999))

    def __init__(self, loop: Loop, band_hz: tuple[float, float] = BAND_HZ) -> None:
        self.active, self.share = np.arange(len(loop.devices)), 1 - _SAMPLED_RESERVE
        self.device = np.array(loop.per_channel(range(len(loop.devices))))
        self.largest = loop.per_device(largest_beta(loop, self.share))
        super().__init__(loop, band_hz)

    def point(self, coupling: SpringDamper) -> Array:
        # The least mismatch hardly depends on the start, beta = 0.35 (largest beta).
        return np.append(super().point(coupling), np.full(self.active.size, np.log(0.35)))

    def beta(self, x: Array) -> Array:
        """Return beta (m,) [s] at x."""
        return (np.exp(x[2 * self.loop.channels :]) * self.largest)[self.device]

    def judged(self, x: Array) -> Requirement:
        bounds = (0.0,) * (2 * self.loop.channels)
        return KNOWN_DEVICE.required(self.loop, self.coupling(x), (*self.beta(x).tolist(), *bounds))

    def _impose(self, w: Array) -> None:
        self.conditions = w
        self._imposed = _Responses(self.delayed, w, self.delta)
        self._lines = _theta(self.loop, self._imposed.z)

    def _complement(self, x: Array) -> tuple[Array, Complex, Complex]:
        """Return the least eigenvalue (k,) in units of delta/T, its eigenvector v (k, m), and M v/(4 l22) (k, m)."""
        beta, z = self.beta(x), self._imposed.z
        F = self._lines * self._imposed.around(self._gains(x))[0]
        cost = period_cost(self.loop, np.full(z.size, self.share), beta)
        own, cross, speed = device_rows(z, cost)
        one = np.eye(beta.size)
        M = -beta[:, None] * F / z[:, None, None] + cross[..., None] * one
        schur = hermitian(F / (z - 1)[:, None, None]) + own[..., None] * one
        schur = schur - np.conj(np.swapaxes(M, 1, 2)) @ (M / (4 * speed[..., None]))
        values, v = least_eigenpair(self.root[:, None] * schur * self.root)
        v = v * self.root
        return values, v, np.einsum("kij,kj->ki", M, v) / (4 * speed)

    def _margins(self, x: Array) -> Array:
        return self._complement(x)[0]

    def _margin_slopes(self, x: Array) -> Array:
        """Return the gradient of `_margins`, with finite differences for beta."""
        room, v, below = self._complement(x)
        (G, by), z, m = self._imposed.around(self._gains(x)), self._imposed.z, self.loop.channels
        left = v.conj() / (z - 1)[:, None] + 2 * below.conj() * self.beta(x) / z[:, None]
        sent = np.einsum("kij,kj->ki", G, v)
        turned = np.einsum("ki,kij->kj", left * self._lines[:, :, 0], G) * sent
        slope = [*(turned * by).real]
        for i in range(self.active.size):
            step = x.copy()
            step[2 * m + i] += _DIFFERENCE
            slope.append(((self._complement(step)[0] - room) / _DIFFERENCE)[:, None])
        return np.concatenate(slope, axis=1)


_SAME = 1e-3  # Two results of a search are one local optimum if no entry of x differs by more.


def _optimum(sampled: SampledLoop, start: SpringDamper, known: Sequence[Array]) -> tuple[Array | None, int]:
    """Return (x, number of searches), where x is a new local optimum that passes the refined sweep, or None."""
    x = sampled.point(start)
    for searches in range(1, budgets.GAIN_ROUNDS + 1):
        x = sampled.search(x, budgets.GAIN_STEPS[1 + (sampled.loop.channels <= FEW)])
        if any(np.abs(x - other).max() < _SAME for other in known):
            return None, searches
        requirement = sampled.judged(x)
        if requirement.ratio <= 1 - RESERVE:
            return x, searches
        stuck = sampled.room(x).min() < -_STUCK
        if stuck or requirement.frequency_hz is None:  # The sweep of an unstable loop returns no frequency.
            return None, searches
        sampled.add(max(2 * np.pi * sampled.loop.T * requirement.frequency_hz, 1e-6))
    return None, budgets.GAIN_ROUNDS


class Optimum(NamedTuple):
    """Best local optimum of several searches, or None for `gains` if the searches found none."""

    gains: SpringDamper | None = None
    rms: float = np.inf  # rms mismatch, relative to the environment
    searches: int = 0  # number of searches
    multiplier: Sequence[Sequence[float]] | None = None  # c of the limiter, one row per device


def least_rms(sampled: SampledLoop, starts: Iterable[SpringDamper], band_hz: tuple[float, float] = BAND_HZ) -> Optimum:
    """Return the best local optimum that is reached from the starts.

    Every search adds frequencies to `sampled`, which later searches use, too. For more than FEW channels the first
    optimum is returned, because steps are expensive and the start hardly matters.
    """
    best, loop, known = Optimum(), sampled.loop, list[Array]()
    for start in starts:
        x, runs = _optimum(sampled, start, known)
        best = best._replace(searches=best.searches + runs)
        if x is None:
            continue
        known.append(x)
        coupling = sampled.coupling(x)
        rms = rms_mismatch(loop.F(coupling), loop.E(), loop.lam, band_hz)
        if rms < best.rms:
            best = Optimum(coupling, rms, best.searches, sampled.multiplier(x))
        if loop.channels > FEW:
            break
    return best


def likeliest_first(sampled: SampledLoop, starts: Sequence[SpringDamper]) -> list[SpringDamper]:
    """Return the gains after GAIN_STEPS[0] steps from each start, sorted by mismatch, with infeasible gains last."""
    points = [sampled.search(sampled.point(start), budgets.GAIN_STEPS[0]) for start in starts]
    points.sort(key=lambda x: (sampled.room(x).min() < -_ROUGH, sampled.square_mismatch(x)))
    return [sampled.coupling(x) for x in points]
