"""Design spring-dampers (26) of least mismatch or of largest stiffness, and moving averages.

`_GainSet` is the convex set of gains that any-environment certifies, in units of the usable damping
d = (1 - RESERVE) delta T/T_max [N s/m]: k = K T/d, b = B/d. For this-environment and known-device, `design` uses the
search of design.gain_search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from haptic_loop.controller.coupling import Compliance, Coupling, MovingAverage, SpringDamper
from haptic_loop.controller.delay import moving_sum
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Complex, Lti, hstack, taps, vstack
from haptic_loop.design import budgets
from haptic_loop.design.certificate import named
from haptic_loop.design.conditions import even_damping, even_level, theta_hat, this_environment
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.environments import ANY_ENVIRONMENT, LIMITER, least_phi, stiffest_alpha
from haptic_loop.design.facts import Latency, PeriodCost
from haptic_loop.design.frequency import on_circle, peaks
from haptic_loop.design.gain_search import (
    FEW,
    KnownDeviceLoop,
    LimiterLoop,
    Optimum,
    SampledLoop,
    SwitchingLoop,
    damper_rate,
    least_rms,
    likeliest_first,
)
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, device_rows, largest_beta, period_cost
from haptic_loop.design.lmi import (
    RESERVE,
    Ports,
    Shaping,
    lemma1,
    packed,
    symmetric_from,
    usable,
)
from haptic_loop.design.result import Design, DesignFailed, Infeasible, Requirement
from haptic_loop.design.transparency import BAND_HZ, decibels, rms_mismatch

# ----------------------------------------------------------------------------------------------------
# The convex set of spring-damper gains that satisfy Theorem 4, channel by channel (docs/theory.md).
#
# A channel has V = 1/g with g = k + b (1 - 1/z). The condition, multiplied by g and its conjugate, is
# k/2 + b >= |c|^2 on |z| = 1. The vector c is that of `_Channel.rows` and is affine in k and b. `lemma1` turns the
# condition into one matrix inequality with a storage matrix for each channel. If these have more than _MOST_STORED
# entries, the condition is imposed at sampled frequencies instead, and frequencies at which the solution violates it
# are added. Both methods give the same gains.


_MOST_STORED = 180  # largest number of entries of all channels' storage matrices
_PER_RIPPLE = 8  # number of initial frequencies for each ripple of |c|^2; a delay of n samples causes n + 1 ripples
_MISSED = 2e-6  # allowed violation between frequencies, relative to the usable damping; far below RESERVE


@dataclass(frozen=True)
class _Channel:
    """The set of gains (k, b) of one channel, in units of its usable damping."""

    theta: int  # delay [samples]
    shortage: float  # phi of the channel (design.environments.least_phi) over its usable damping; 0 if psi = 0

    def rows(self, gains: Array) -> Lti:
        """Return c(z) of the condition k/2 + b >= |c|^2 on |z| = 1; only its matrices C and D depend on the gains."""
        k, b = gains
        late = theta_hat((self.theta,), np.ones(1), 1.0)  # a delay line, whose coefficients are in D and C
        window = taps(np.convolve(np.append(late.D, late.C), [k + b, -b]).tolist(), 1.0)
        if not self.shortage:
            return window
        return vstack(window, (np.eye(1) - window) * (1 / np.sqrt(1 / self.shortage - 1)))

    def exactly(self, unknowns: Sequence[int]) -> Inequality:
        """Return the inequality for all frequencies. The unknowns are k, b and the entries of a storage matrix."""

        def matrix(x: Array) -> Array:
            c = self.rows(x[:2])
            corner = Lti.constant(np.eye(1 + c.outputs)[:, 1:], 1.0)
            block = hstack(vstack(Lti.constant([[x[0] / 2 + x[1]]], 1.0), 2 * c), corner)
            zero = np.zeros_like(block.D)
            return lemma1(Ports.same(block), symmetric_from(x[2:], block.order), zero, zero)

        return Inequality.of(matrix, unknowns)

    def sampled(self, unknowns: Sequence[int], w: Array) -> Inequality:
        """Return the inequality [[k/2 + b, c'], [c, I]] >= 0 at the frequencies w [rad/sample]."""
        z = on_circle(w)

        def arrows(x: Array) -> Array:
            c = self.rows(x).at(z)[:, :, 0]
            c = np.concatenate([c.real, c.imag], axis=1)
            M = np.eye(1 + c.shape[1]) * np.ones((w.size, 1, 1))
            M[:, 0, 0], M[:, 0, 1:], M[:, 1:, 0] = x[0] / 2 + x[1], c, c
            return M

        return Inequality.of(arrows, unknowns)

    def missed(self, gains: Array) -> Array:
        """Return peaks [rad/sample] at which the gains violate the inequality by more than _MISSED."""
        c, room = self.rows(gains), gains[0] / 2 + gains[1]
        excess = lambda w: (np.abs(c.at(on_circle(w))) ** 2).sum(axis=(1, 2)) - room  # noqa: E731
        return peaks(excess, self.grid(2), _MISSED)

    def grid(self, finer: int = 1) -> Array:
        """Return frequencies from 0 to pi [rad/sample], `finer` times _PER_RIPPLE for each ripple."""
        return np.linspace(0, np.pi, finer * _PER_RIPPLE * (self.theta + 1) + 1)


class _GainSet:
    """The gains that any-environment certifies, in units of the usable damping.

    phi (m,) [N s/m] is the multiplier for psi >= 1, or None for psi = 0.
    """

    def __init__(self, loop: Loop, phi: Array | None = None, most_stored: int = _MOST_STORED) -> None:
        shortage = np.zeros(loop.channels) if phi is None else phi / usable(loop)
        self.channels = [_Channel(n, float(p)) for n, p in zip(loop.theta, shortage, strict=True)]
        stored = np.array([packed(n + 1) for n in loop.theta])
        self._stored = stored if stored.sum() <= most_stored else None

    def solve(self, cost: Array, what: str, more: Sequence[Inequality] = ()) -> Array:
        """Return the unknowns x with the least cost'x; `what` names the problem in error messages.

        The first unknowns are the gains (k_1, ..., k_N, b_1, ..., b_N) of N channels, which any-environment certifies.
        All unknowns satisfy the inequalities `more`. Raises the errors of ConeProgram.solve, and DesignFailed if the
        gains still violate an inequality after THEOREM_4_ROUNDS rounds.
        """
        N, own = len(self.channels), len(cost)
        blocks = [*more, Inequality.least(range(2 * N), 0.0)]
        each = [(channel, (i, N + i)) for i, channel in enumerate(self.channels)]
        if self._stored is not None:
            ends = own + np.cumsum([0, *self._stored])
            for i, (channel, gains) in enumerate(each):
                blocks.append(channel.exactly([*gains, *range(ends[i], ends[i + 1])]))
            return ConeProgram(np.append(cost, np.zeros(self._stored.sum())), blocks).solve(what)[:own]
        w = [channel.grid() for channel in self.channels]
        for _ in range(budgets.THEOREM_4_ROUNDS):
            sets = [channel.sampled(gains, w[i]) for i, (channel, gains) in enumerate(each)]
            x = ConeProgram(cost, [*blocks, *sets]).solve(what)
            missed = [channel.missed(x[list(gains)]) for channel, gains in each]
            if not any(further.size for further in missed):
                return x
            w = [np.union1d(known, further) for known, further in zip(w, missed, strict=True)]
        line = f"{what}: after {budgets.THEOREM_4_ROUNDS} rounds Theorem 4 still fails between the frequencies"
        raise DesignFailed(None, (), line)


# ----------------------------------------------------------------------------------------------------
# One step of the convex-concave sequence for ||L W2||_inf (23) over spring-damper gains (docs/theory.md). Let
# g = diag(k + b (1 - 1/z)). The norm is at most mu if and only if (L g W2)* (L g W2) <= mu^2 g* g on |z| = 1. A step
# replaces g* g by its tangent at the previous gains. The tangent lies below g* g, so that no step increases the norm.


def _step(shaping: Shaping, gains: _GainSet, at: Array, norm: float, w: Array) -> tuple[Array, float]:
    """Return (gains, bound on the norm at the frequencies w) after one convex-concave step from the gains `at`."""
    cost = np.append(np.zeros(at.size), 1.0)
    x = gains.solve(cost, "a step of the convex sequence", [_tangent(shaping, at, norm, w)])
    return x[:-1], norm * float(np.sqrt(x[-1]))


def _tangent(shaping: Shaping, at: Array, norm: float, w: Array) -> Inequality:
    """Return [[g0* g + g* g0 - g0* g0, (L g W2)*], [L g W2, t norm^2 I]] >= 0 at the frequencies w, scaled.

    g0 is g at the gains `at`. The unknowns are the gains and t = mu^2/norm^2.
    """
    N = shaping.loop.channels
    environment, weight, late = shaping.parts(w)
    basis = np.eye(N)[:, None, :] * np.ones((w.size, 1))  # (N, k, N): e_i at every frequency
    g = np.concatenate([basis, basis * damper_rate(on_circle(w), 1.0)[:, None]])  # slopes of g: diagonals (2N, k, N)
    g0 = np.tensordot(at, g, axes=1)  # (k, N)
    # Each column is divided by its |g0|. The blocks with L g W2 are also divided by the norm.
    scale = 1 / np.abs(g0)
    rows = (environment * (shaping.loop.T / shaping.usable)) @ weight * scale[:, None, :] / norm
    row_slopes = (late * g[:, :, None, :]) @ weight * scale[:, None, :] / norm
    base_slopes = (2 * (np.conj(g0) * g).real * scale**2)[..., None] * np.eye(N)
    constant = np.zeros((w.size, 2 * N, 2 * N), dtype=np.complex128)
    slopes = np.zeros((2 * N + 1, *constant.shape), dtype=np.complex128)
    for target, top, low in ((constant, -np.eye(N), rows), (slopes[:-1], base_slopes, row_slopes)):
        target[..., :N, :N] = top
        target[..., N:, :N] = low
        target[..., :N, N:] = np.conj(np.swapaxes(low, -1, -2))
    slopes[-1, :, N:, N:] = np.eye(N)
    return Inequality(constant, slopes, range(2 * N + 1))


#: The sequence ends if a step changes the norm by a smaller share, and the norm is as close to the step's bound.
_SETTLED = 1e-6
_NEGLIGIBLE = 1e-6  # Dampers below this share of the usable damping become 0, because solvers return 1e-9 for 0.


def design(
    loop: Loop,
    condition: str = "any-environment",
    limiter: bool | None = None,
    band_hz: tuple[float, float] | None = None,
) -> Design:
    """Return the spring-damper of least objective that `condition` certifies.

    For any-environment the objective is ||L W2||_inf (23), over the exact set of gains, or for psi >= 1 over the set
    for one multiplier Phi. For this-environment and known-device the objective is the rms mismatch, and the result is
    the lowest of the local minima that are reached from several starts, or with more than FEW channels the first
    minimum. For known-device-any the objective is the negative sum of K.

    Args:
        loop: The devices, their delays and the environment. Only this-environment allows delays that switch.
        condition: The name of a condition.
        limiter: Whether the coupling must be safe while forces are limited, too. With None the search for such gains
            may fail; the coupling is then safe below the limits only. For psi = 0 any-environment always covers limits.
        band_hz: The band of the rms mismatch [Hz], or None for BAND_HZ.

    Raises:
        Infeasible: Theorem 4 admits no gains.
        DesignFailed: No gains were found, the condition does not certify them, or the loop has so many channels that
            the search would take minutes.
        ValueError: The condition has no designs for limited forces or for this band.
    """
    chosen = named(condition)
    if chosen.extensible:
        if limiter:
            _require_few(loop, _MOST_LIMITED, "the limiter's block: leave the limiter out")
            if refusal := LIMITER.not_designed(loop):
                raise ValueError(refusal)
        elif loop.channels > _MOST_LIMITED or LIMITER.not_designed(loop):
            limiter = False
        return _for_this_environment(loop, limiter, band_hz)
    if limiter and chosen is KNOWN_DEVICE:
        raise ValueError("limiter: known-device spring-dampers are not for limited forces; use this-environment")
    _require_few(
        loop, _MOST_ANY, "Theorem 4 or Theorem B: use a moving average, which needs no search, or this-environment"
    )
    if chosen in (KNOWN_DEVICE, KNOWN_DEVICE_ANY) and (reason := chosen.beyond(loop)):
        raise DesignFailed(None, (), f"{condition}: {reason}")
    if chosen is KNOWN_DEVICE:
        return _for_known_devices(loop, band_hz)
    return _stiffest_known(loop) if chosen is KNOWN_DEVICE_ANY else _for_any_environment(loop)


#: Number of significant digits of the gains in loops of more than FEW channels. With all digits exact proofs would take
#: minutes. Rounding changes the required damping by less than RESERVE.
_DIGITS = 5
_SWEEPS = 150  # A search for this-environment takes about as long as this number of frequency sweeps.
_MOST_ANY, _MOST_LIMITED = 48, 32  # largest numbers of channels for which a search ends within half a minute


def _require_few(loop: Loop, most: int, what: str) -> None:
    if loop.channels > most:
        raise DesignFailed(None, (), f"{loop.channels} channels, allowed are {most} for a spring-damper by {what}")


def _for_any_environment(loop: Loop) -> Design:
    shaping, phi = Shaping(loop), least_phi(loop)
    certified = _GainSet(loop, phi)
    try:
        gains = certified.solve(np.repeat([-1.0, 0.0], loop.channels), "the set of gains")
    except Infeasible as error:
        line = f"Theorem 4 admits no spring-damper with theta = {loop.theta}, psi = {loop.psi}, delta = {loop.delta}"
        raise Infeasible(error.problem, error.results, line) from error
    sdps = 1
    norm, peak = shaping.norm(_coupling(loop, gains).compliance(loop.T))
    frequencies = [peak]
    for _ in range(budgets.SEQUENCE_STEPS):
        gains, bound = _step(shaping, certified, gains, norm, np.array(frequencies))
        sdps += 1
        before, (norm, peak) = norm, shaping.norm(_coupling(loop, gains).compliance(loop.T))
        frequencies.append(peak)
        if abs(before - norm) < _SETTLED * norm and norm < (1 + _SETTLED) * bound:
            break
    coupling = _short(_coupling(loop, gains))
    if loop.channels > FEW:
        norm, _ = shaping.norm(coupling.compliance(loop.T))
    return _verified(ANY_ENVIRONMENT.required(loop, coupling, phi), coupling, "loop-norm", norm, sdps, phi)


def _short(coupling: SpringDamper) -> SpringDamper:
    """Return the coupling, with gains rounded to _DIGITS digits if it has more than FEW channels (faster proofs)."""
    if coupling.K.size <= FEW:
        return coupling
    return SpringDamper(_rounded(coupling.K, _DIGITS), _rounded(coupling.B, _DIGITS))


def _rounded(values: Iterable[float], digits: int) -> list[float]:
    return [float(f"{value:.{digits}g}") for value in values]


def _without_negligible(loop: Loop, coupling: SpringDamper) -> SpringDamper:
    """Return the coupling without negligible dampers, rounded by `_short`."""
    return _short(SpringDamper(coupling.K, np.where(_NEGLIGIBLE * usable(loop) > coupling.B, 0.0, coupling.B)))


def _for_this_environment(loop: Loop, limiter: bool | None, band_hz: tuple[float, float] | None) -> Design:
    """Return the spring-damper of least rms mismatch that this-environment certifies (see `design` for `limiter`)."""
    each = np.full(loop.channels, 1000.0)  # The time of a sweep does not depend on the gains.
    if reason := budgets.too_long(loop.F(SpringDamper(each, each / 1000)), _SWEEPS):
        raise DesignFailed(None, (), reason)
    starts, band, span = _starts(loop), band_hz or BAND_HZ, loop.varying_delay
    if band_hz and span:
        raise ValueError("band_hz: designs for delays that vary use 0.5 to 80 Hz; leave out band_hz")
    sampled = SwitchingLoop(loop) if span else SampledLoop(loop, band)
    many = loop.channels > FEW
    if many:
        starts = likeliest_first(sampled, starts)
    linear = best = Optimum()
    if limiter is False or not many:
        linear = best = least_rms(sampled, starts, band)
    if limiter is not False and (many or linear.gains):
        limited = LimiterLoop(loop, band)
        # Limits soften the gains only a little, so the search begins with the gains without limits, if there are any.
        best = least_rms(limited, [linear.gains] if linear.gains else starts, band)
        if linear.gains and not best.gains:
            best = least_rms(limited, starts, band)
        best = best._replace(searches=linear.searches + best.searches)
    if limiter is None and not best.gains:
        best = least_rms(sampled, starts, band) if many else linear
    if best.gains is None:
        certifies = "the this-environment condition certifies"
        if span:
            certifies += f" under any switching from {span.lo} to {span.hi} samples"
        if limiter and (many or linear.gains):
            certifies += " while forces are limited"
        raise _no_gains(loop, certifies)
    coupling, rms = _without_negligible(loop, best.gains), best.rms
    F = loop.F(coupling)
    if many:
        rms = rms_mismatch(F, loop.E(), loop.lam, band)
    requirement = this_environment(F, loop)
    return Design(coupling, "this-environment", "rms", rms, requirement, best.searches, c=best.multiplier)


def _no_gains(loop: Loop, certifies: str) -> DesignFailed:
    """Return the error of a search that found no gains. `certifies` is the condition with a verb, for the message."""
    which = f"theta = {loop.theta}, psi = {loop.psi}, delta = {loop.delta}"
    return DesignFailed(None, (), f"no spring-damper was found that {certifies} for {which}")


def _for_known_devices(loop: Loop, band_hz: tuple[float, float] | None) -> Design:
    """Return the spring-damper of least rms mismatch that known-device certifies.

    The search also starts from the result for this-environment, which is returned unless a better one is found. Raises
    DesignFailed if neither search finds a coupling.
    """
    starts, band = _starts(loop), band_hz or BAND_HZ
    plain = least_rms(SampledLoop(loop, band), starts, band)
    first = [plain.gains] if plain.gains else []
    best = least_rms(KnownDeviceLoop(loop, band), [*first, *starts], band)
    searches = best.searches + plain.searches
    if plain.gains and not best.rms < plain.rms:
        best = plain
    if best.gains is None:
        raise _no_gains(loop, f"{KNOWN_DEVICE.name} certifies")
    coupling = _without_negligible(loop, best.gains)
    beside = f"{decibels(plain.rms):z.2f} dB rms" if plain.gains else "no spring-damper"
    here = f"known-device, {decibels(best.rms):z.2f} dB rms"
    note = f"{here}; this-environment, for devices of which less is known: {beside}"
    requirement = KNOWN_DEVICE.judge(loop, coupling)
    return Design(coupling, KNOWN_DEVICE.name, "rms", best.rms, requirement, searches, notes=(note,))


_ETAS = np.concatenate([np.geomspace(0.05, 0.6, 16), 1 - np.geomspace(0.3, 1e-4, 12)])  # tried beta/(largest beta)
_ON_CIRCLE = 721  # number of frequencies from 0 to pi at which known-device-any is imposed


def _chi(z: Complex, theta: Sequence[int], cost: PeriodCost, beta: Array) -> Array:
    """Return chi (k, m) [m/N], which He[V/(1-z)] must exceed for each frequency and channel.

    chi is l Lam^-1 l*/4 with l = [(z^n - 1)/(z - 1), beta z^n] and n = theta + 1. Lam is the 2 x 2 matrix of the cost L
    (design.facts.PeriodCost).
    """
    own, cross, speed = device_rows(z, cost)
    n = np.array(theta) + 1
    window = np.stack([sum(z**i for i in range(each)) for each in n], axis=1)
    last, cross = beta * z[:, None] ** n, cross / 2
    both = speed * np.abs(window) ** 2 + own * beta**2 - 2 * (last * cross * np.conj(window)).real
    return both / (4 * (own * speed - np.abs(cross) ** 2))


def _stiffest_known(loop: Loop) -> Design:
    """Return the stiffest spring-damper that known-device-any certifies; the objective is the sum of K [N/m].

    Let D = (1 - 1/z)/T and W = K/D + B, so that V = 1/(D W) and Re W = K T/2 + B. Then He[V/(1-z)] > chi is
    Re W > chi |W|^2 |1 - 1/z|^2/T. The gains (K, B) that satisfy this form a convex set for each beta. At each
    frequency the allowed K lie between the two roots of a quadratic, so that the largest K is the least of the upper
    roots. B and beta are searched.
    """
    K, B = zip(*(gains for own in loop.devices for gains in _stiffest_device(_axes(loop, own))), strict=True)
    coupling = SpringDamper(_rounded(K, _STIFF_DIGITS), _rounded(B, _STIFF_DIGITS))
    return _verified(KNOWN_DEVICE_ANY.judge(loop, coupling), coupling, "stiffness", float(sum(coupling.K)))


def _axes(loop: Loop, own: slice) -> list[Loop]:
    """Return the loop of each axis of the device with the channels `own`."""
    return [loop.channel(i) for i in range(own.start, own.stop)]


def _best_eta(cost: Callable[[float], float], tolerance: float) -> float:
    """Return the share beta/(largest beta) of least cost: the best of _ETAS, or a better one near it."""
    from scipy.optimize import minimize_scalar  # slow to load

    best = int(np.argmin([cost(eta) for eta in _ETAS]))
    ends = _ETAS[max(best - 1, 0)], _ETAS[min(best + 1, _ETAS.size - 1)]
    optimum: Any = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": tolerance})
    return min(float(optimum.x), float(_ETAS[best]), key=cost)


def _stiffest_device(axes: Sequence[Loop]) -> list[tuple[float, float]]:
    """Return the gains (K [N/m], B [N s/m]) with the largest sum of K, for each axis of a device."""
    from scipy.optimize import minimize_scalar  # slow to load

    z = on_circle(np.linspace(1e-6, np.pi, _ON_CIRCLE))
    T = axes[0].T
    steps = np.abs(1 - 1 / z) ** 2 / T

    def stiffest(B: float, limits: Array) -> float:
        """Return the largest K with K T/2 + B >= chi |K/D + B|^2 |1 - 1/z|^2/T at all frequencies, or 0.

        `limits` is chi, and `steps` is |1 - 1/z|^2/T. With D = (1 - 1/z)/T, steps/|D|^2 is T, and Re 1/D is T/2.
        """
        a, b = limits * T, (limits * steps * B - 0.5) * T
        c = limits * steps * B**2 - B
        room = b**2 - 4 * a * c
        if (room < 0).any():
            return 0.0
        root = np.sqrt(room)
        high, low = ((-b + sign * root) / (2 * a) for sign in (1, -1))
        return float(high.min()) if low.max() <= high.min() else 0.0

    def at(eta: float) -> tuple[float, list[tuple[float, float]]]:
        """Return (-sum of K, gains of every axis) for this share of the largest beta, with the best B of every axis."""
        gains = []
        for limits in _limits(axes, eta, z, _STIFF_RESERVE):
            most = 1 / (limits * steps).max()
            best: Any = minimize_scalar(
                lambda B, limits=limits: -stiffest(B, limits), bounds=(0.0, most), method="bounded"
            )
            gains.append((-float(best.fun), float(best.x)))
        return -sum(K for K, _ in gains), gains

    return at(_best_eta(lambda eta: at(eta)[0], 1e-6))[1]


def _limits(axes: Sequence[Loop], eta: float, z: Complex, reserve: float) -> list[Array]:
    """Return chi (k,) of each axis of a device. beta is `eta` times the largest beta that all axes allow."""
    beta = eta * np.min([largest_beta(one, 1 - reserve) for one in axes], axis=0)
    share = np.full(z.size, 1 - reserve)
    return [_chi(z, one.theta, period_cost(one, share, beta), beta)[:, 0] for one in axes]


_TAPS = 4096  # number of frequencies for the Fourier coefficients of chi
_SLACK = 2e-4  # constant that is added to chi, relative to the largest chi; the truncated terms may use half of it


def _stiffest_linear(loop: Loop) -> Design:
    """Return the stiffest linear coupling that known-device-any certifies; the objective is the sum of 1/V_i(1) [N/m].

    `_from_chi` computes the coupling from the Fourier coefficients of chi. A small constant is added to chi, and the
    series is cut off where the omitted terms sum to less than half of this constant.
    """
    if reason := KNOWN_DEVICE_ANY.beyond(loop):
        raise DesignFailed(None, (), f"{KNOWN_DEVICE_ANY.name}: {reason}")
    channels, each = [], list[Array]()
    z = on_circle(np.linspace(0, 2 * np.pi, _TAPS, endpoint=False))
    for own in loop.devices:
        axes = _axes(loop, own)

        def needed(eta: float, axes: Sequence[Loop] = axes) -> float:
            return sum(limits.mean() for limits in _limits(axes, eta, z, RESERVE))

        each += _limits(axes, _best_eta(needed, 1e-5), z, RESERVE)
    for limits in each:
        series = np.fft.rfft(limits).real / _TAPS
        left = 2 * np.cumsum(np.abs(series[::-1]))[::-1]  # largest sum of each term and all later terms
        count = int(np.argmax(left < _SLACK / 2 * limits.max()))
        channels.append(_from_chi(series[:count], 2 * _SLACK * limits.max(), loop.T))
    coupling = Compliance(Lti.diag(*channels))
    return _verified(KNOWN_DEVICE_ANY.judge(loop, coupling), coupling, "stiffness", _stiffness(coupling))


def _from_chi(chi: Array, extra: float, T: float) -> Lti:
    """Return V such that He[V/(1-z)] is chi + extra/2, with coefficients that are rounded to decimals.

    With the Fourier coefficients chi_k of chi, V = V(1) - 2 (z-1) sum_{k>=1} chi_k z^-k, and V(1) = 2 chi_0 + extra.
    """
    weights = -2 * np.diff(np.append(chi, 0.0))
    weights[0] += extra
    return taps(_rounded(weights, _TAP_DIGITS), T)


def _stiffness(coupling: Compliance) -> float:
    """Return the sum of the channels' static stiffnesses [N/m]."""
    return float(np.trace(np.linalg.inv(coupling.V.dc())))


_TAP_DIGITS = 12  # digits of a coefficient; the rounding error is far below _SLACK
_STIFF_RESERVE = 1e-3  # unused share of the damping, for rounded gains and frequencies between the imposed ones
_STIFF_DIGITS = 6  # digits of a gain


def _starts(loop: Loop) -> list[SpringDamper]:
    """Return couplings at which a search starts. Three have 0.3, 1 and 8 times the stiffness d/((theta + psi + 1) T).

    d is the usable damping [N s/m]. With delay in the environment there is a further start, whose coupling is stiffer
    than the environment at half the sampling rate: the loop is stable if the coupling is stiffer at all frequencies.
    """
    spend = usable(loop)
    K = spend / (loop.T * (np.asarray(loop.theta) + np.asarray(loop.psi) + 1))
    starts = [SpringDamper(factor * K, share * spend) for factor, share in ((0.3, 0.1), (1.0, 0.3), (8.0, 1.0))]
    if any(loop.psi):
        highest = np.linalg.norm(loop.E().at(-1.0), 2)
        starts.append(SpringDamper(K, np.full(loop.channels, loop.T * highest)))
    return starts


# With this e of `moving_average`, a ringing force decays by the factor 0.5 (theta = 1) or 0.55 (theta = 2) per tick.
_SPARE_OF_SLOW_WORLDS = 0.25


def _spare(loop: Loop) -> float:
    """Return e of `moving_average`: a reserve for rounding, or more for a world that does not step at every tick."""
    world = loop.environment.world
    return _SPARE_OF_SLOW_WORLDS if world and world.every > 1 else RESERVE / (1 - RESERVE)


def moving_average(loop: Loop, condition: str = "any-environment") -> Design:
    """Return the stiffest linear coupling that Theorem 4 or known-device-any admits; the objective is in N/m.

    For Theorem 4 with constant delays and without a latency, V = T/(2 delta) (1 + ... + z^-theta) requires the damping
    delta at every frequency. If periods vary, T is T_max here. Let n = theta + 1. If the constant e n^2 T/(2 delta) is
    added to V, the required damping is delta/(1 + e) where the sum is largest, and less elsewhere. The zeros of the sum
    lie on the unit circle, so that without e the force against an object at rest would ring without decay. A world that
    does not step at every tick is at rest between its steps, so that e is larger for such a world.
    """
    if condition == KNOWN_DEVICE_ANY.name:
        return _stiffest_linear(loop)
    if (loop.latency or loop.varying_delay) and not ANY_ENVIRONMENT.beyond(loop):
        return _stiffest_in_frame(loop)
    phi, terms = least_phi(loop), np.array(loop.theta) + 1
    if loop.levels:  # V = T/2 Delta^-1 (1 + .. + z^-theta)
        weight = _rounded_inverse(2 * even_level(loop) / loop.T)
        late, constant = moving_sum(loop.theta, loop.T), _spare(loop) * terms**2 * weight
        coupling = Compliance(
            Lti(late.A, late.B, weight @ late.C, weight @ late.D + (constant + constant.T) / 2, loop.T)
        )
        stiffness = _stiffness(coupling)
    else:
        weight = loop.T / (2 * even_damping(loop))
        coupling = MovingAverage(weight, terms.tolist(), _spare(loop) * terms**2 * weight)
        stiffness = float(coupling.stiffness.sum())
    return _verified(ANY_ENVIRONMENT.required(loop, coupling, phi), coupling, "stiffness", stiffness, phi=phi)


def _stiffest_in_frame(loop: Loop) -> Design:
    """Return the stiffest linear coupling of a loop with a latency or switching delays, for any environment.

    `_from_chi` computes the coupling from chi, the least admissible He[V/(1-z)] (docs/theory.md). chi has finitely many
    coefficients. Its mean is V(1)/2, and the condition's multiplier minimises this mean.
    """
    if loop.latency and loop.varying_delay:
        line = "moving-average: no series is known for a latency together with switching delays; use a spring-damper"
        raise DesignFailed(None, (), line)
    chi = _late_chi if loop.latency else _switched_chi
    each = [chi(loop, i, delta) for i, delta in enumerate((1.0,) * loop.channels if loop.levels else loop.delta)]
    V = Lti.diag(*(_from_chi(terms, 2 * RESERVE * terms[0], loop.T) for terms in each))
    if loop.levels:  # The chi of a device with the damping Delta_i is chi for 1 N s/m times Delta_i^-1.
        V = _rounded_inverse(loop.Delta()) @ V
    coupling = Compliance(V)
    return _verified(ANY_ENVIRONMENT.required(loop, coupling), coupling, "stiffness", _stiffness(coupling))


def _rounded_inverse(level: Array) -> Array:
    """Return the symmetric inverse with entries rounded to _TAP_DIGITS digits."""
    inverse = np.linalg.inv(level)
    return np.array([_rounded(row, _TAP_DIGITS) for row in (inverse + inverse.T) / 2])


def _late_chi(loop: Loop, i: int, delta: float) -> Array:
    """Return the coefficients chi_k of chi = l (Q d)^-1 l*/4 for a loop with a latency, with the best Q.

    Q is the multiplier of design.facts.Latency, d is (1 - RESERVE) delta, and
    l = [1 + .. + z^-(theta+1), 1 + .. + z^-theta].
    """
    (first, last), theta = (loop.latency or ())[i], loop.theta[i]
    inverse = np.diag([last, (loop.T_max or loop.T) - first])
    if first < last:
        inverse = np.linalg.inv(_best_latency_multiplier(loop, i, theta))
    windows = np.array([np.ones(theta + 2), [*np.ones(theta + 1), 0.0]])
    pairs = [(a, b) for a in (0, 1) for b in (0, 1)]
    terms = [inverse[a, b] * np.correlate(windows[a], windows[b], "full")[theta + 1 :] for a, b in pairs]
    return np.sum(terms, axis=0) / (4 * (1 - RESERVE) * delta)


def _switched_chi(loop: Loop, i: int, delta: float) -> Array:
    """Return the coefficients chi_k of chi = |v|^2/(4 (d - alpha/2)) + h^2/(2 alpha) for switching delays.

    The delay switches between lo and hi, and h = (hi - lo)/2. v is the mean of the two windows 1 + .. + z^-n with
    n = lo and n = hi, d is (1 - RESERVE) delta/T_max, and alpha is the multiplier that minimises the mean of chi. For a
    constant delay chi is |v|^2/(4 d).
    """
    lo, hi = loop.delays.lo[i], loop.delays.hi[i]
    damping, half = (1 - RESERVE) * delta / (loop.T_max or loop.T), (hi - lo) / 2
    window = np.where(np.arange(hi + 1) > lo, 0.5, 1.0)
    square = np.correlate(window, window, "full")[hi:]
    if not half:
        return square / (4 * damping)
    alpha = stiffest_alpha(lo, hi, damping)
    terms = square / (4 * (damping - alpha / 2))
    terms[0] += half**2 / (2 * alpha)
    return terms


def _best_latency_multiplier(loop: Loop, i: int, theta: int) -> Array:
    """Return the Q (2, 2) [1/s] of `_late_chi` that minimises trace(Q^-1 M), which is proportional to the mean of chi.

    M (2, 2) contains the inner products of the two entries of l.
    """
    hands, scale = Latency(), 1 / loop.T
    root = np.linalg.cholesky(np.array([[theta + 2.0, theta + 1.0], [theta + 1.0, theta + 1.0]]))
    one = loop.channel(i)

    def allowed(x: Array) -> Array:
        (room,) = hands.room(one, {name: (scale * v,) for name, v in zip(_Q, x[:3], strict=True)}, 1.0)
        return room

    def cost(x: Array) -> Array:
        Q, X = symmetric_from(x[:3], 2), symmetric_from(x[3:], 2)
        return np.block([[X, root.T], [root, Q]])

    objective = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    blocks = [Inequality.of(allowed, range(6)), Inequality.of(cost, range(6))]
    x = ConeProgram(objective, blocks).solve("the multiplier Q of a latency")
    admissible = hands.allowed(one, {name: (scale * v,) for name, v in zip(_Q, x[:3], strict=True)})
    return symmetric_from(np.array([admissible[name][0] for name in _Q]), 2)


_Q = "q11", "q12", "q22"


def _verified(
    requirement: Requirement, coupling: Coupling, figure: str, objective: float, sdps: int = 0, phi: Array | None = None
) -> Design:
    """Return the design for the condition of the requirement. Raises DesignFailed unless it is certified."""
    name = requirement.condition
    if not requirement.certified:
        line = f"the designed coupling is not certified by {name}: {requirement.shortfall}"
        raise DesignFailed(None, (), line)
    return Design(coupling, name, figure, objective, requirement, sdps, phi=phi)


def _coupling(loop: Loop, gains: Array) -> SpringDamper:
    (k, b), spend = np.split(np.maximum(gains, 0.0), 2), usable(loop)
    return SpringDamper(k * spend / loop.T, np.where(b < _NEGLIGIBLE, 0.0, b) * spend)
