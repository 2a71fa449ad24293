"""Spring-damper couplings (26): the best under either condition, the stiffest, and the moving average.

any-environment has a convex set of gains, described here; for one environment design.gain_search looks for them.

Gains are handled in units of the usable damping d = (1 - RESERVE) delta: k = KT/d, b = B/d (gain_set).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from haptic_loop.controller.coupling import Compliance, Coupling, MovingAverage, SpringDamper
from haptic_loop.controller.delay import moving_sum
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti, hstack, taps, vstack
from haptic_loop.design import budgets
from haptic_loop.design.certificate import named
from haptic_loop.design.conditions import even_damping, even_level, theta_hat, this_environment
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.environments import LIMITER
from haptic_loop.design.facts import Latency
from haptic_loop.design.frequency import on_circle, peaks, too_long
from haptic_loop.design.gain_search import (
    FEW,
    KnownDeviceLoop,
    LimiterLoop,
    SampledLoop,
    SwitchingLoop,
    damper_rate,
    least_rms,
    likeliest_first,
)
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, chi, largest_beta, period_cost
from haptic_loop.design.lmi import (
    ANY_ENVIRONMENT,
    RESERVE,
    Ports,
    Shaping,
    gain_block,
    least_phi,
    lemma1,
    packed,
    symmetric_from,
    usable,
)
from haptic_loop.design.result import Design, DesignFailed, Infeasible
from haptic_loop.design.transparency import BAND_HZ, decibels, transparency

# ----------------------------------------------------------------------------------------------------
# The convex set of spring-damper gains that satisfy Theorem 4, channel by channel.
#
# A channel has V = 1/W with W = k + b (1 - 1/z). Multiplied by W and its conjugate, what V brings to the block of
# `any_environment_demand` is k/2 + b, what the damping takes is |Theta-hat W|^2, and the row of a multiplier is
# 2 (1 - Theta-hat W): in Schur's form all is affine in (k, b), without conservatism. A test compares it to that block.
#
# `lemma1` makes it one matrix inequality, with half as many unknowns as entries; beyond _MOST_STORED of these it is
# imposed frequency by frequency, in the two unknowns alone, and where the solution fails in between, there too. These
# sets contain the exact one and the rounds shrink them to it: both ways end at the same gains.


_MOST_STORED = 180  # unknowns besides the gains, of all channels
_PER_LOBE = 8  # frequencies per ripple of a delay at which the inequality is imposed first
_MISSED = 2e-6  # of the usable damping: what the inequality may miss in between, far less than the reserve of a design


@dataclass(frozen=True)
class _Channel:
    """The gains (k, b) of one device, in units of its usable damping."""

    theta: int
    shortage: float  # phi of its multiplier, 0 where psi is

    def rows(self, gains: Array) -> Lti:
        """c with k/2 + b >= |c|^2 on |z| = 1; its C and D are affine in the gains, its A and B are fixed."""
        k, b = gains
        late = theta_hat((self.theta,), np.ones(1), 1.0)  # a delay line: D and C are its coefficients
        taken = taps(np.convolve(np.append(late.D, late.C), [k + b, -b]).tolist(), 1.0)
        if not self.shortage:
            return taken
        return vstack(taken, (np.eye(1) - taken) * (1 / np.sqrt(1 / self.shortage - 1)))

    def exactly(self, unknowns: Sequence[int]) -> Inequality:
        """At all frequencies; the unknowns behind the gains are a storage."""

        def matrix(x: Array) -> Array:
            c = self.rows(x[:2])
            corner = Lti.constant(np.eye(1 + c.outputs)[:, 1:], 1.0)
            block = hstack(vstack(Lti.constant([[x[0] / 2 + x[1]]], 1.0), 2 * c), corner)
            zero = np.zeros_like(block.D)
            return lemma1(Ports.same(block), symmetric_from(x[2:], block.order), zero, zero)

        return Inequality.of(matrix, unknowns)

    def sampled(self, unknowns: Sequence[int], w: Array) -> Inequality:
        """At the frequencies w [rad/sample], as [[k/2 + b, c'], [c, I]] >= 0."""
        z = on_circle(w)

        def arrows(x: Array) -> Array:
            c = self.rows(x).at(z)[:, :, 0]
            c = np.concatenate([c.real, c.imag], axis=1)
            M = np.eye(1 + c.shape[1]) * np.ones((w.size, 1, 1))
            M[:, 0, 0], M[:, 0, 1:], M[:, 1:, 0] = x[0] / 2 + x[1], c, c
            return M

        return Inequality.of(arrows, unknowns)

    def missed(self, gains: Array) -> Array:
        """Peaks [rad/sample] at which the gains miss the inequality by more than _MISSED."""
        c, room = self.rows(gains), gains[0] / 2 + gains[1]
        excess = lambda w: (np.abs(c.at(on_circle(w))) ** 2).sum(axis=(1, 2)) - room  # noqa: E731
        return peaks(excess, self.grid(2), _MISSED)

    def grid(self, finer: int = 1) -> Array:
        """_PER_LOBE to each ripple, from 0 to pi [rad/sample]."""
        return np.linspace(0, np.pi, finer * _PER_LOBE * (self.theta + 1) + 1)


class GainSet:
    """The gains of any-environment in units of the usable damping, with phi (m,) [N s/m] where psi >= 1."""

    def __init__(self, loop: Loop, phi: Array | None = None, most_stored: int = _MOST_STORED) -> None:
        shortage = np.zeros(loop.channels) if phi is None else phi / usable(loop)
        self.channels = [_Channel(n, float(p)) for n, p in zip(loop.theta, shortage, strict=True)]
        stored = np.array([packed(n + 1) for n in loop.theta])
        self._stored = stored if stored.sum() <= most_stored else None

    def solve(self, cost: Array, what: str, more: Sequence[Inequality] = ()) -> Array:
        """The unknowns of least cost: gains (k_1, ..., k_N, b_1, ..., b_N), each channel's in its set, then others.

        `more` inequalities bound these, too. Raises as ConeProgram.solve, and DesignFailed where one still fails after
        all rounds.
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
# One step of the convex-concave sequence for ||W1 L W2||_inf (23) over spring-damper gains.
#
# With g = k + b (1 - 1/z) per channel the norm is below mu iff (W1 L g W2)* (W1 L g W2) <= mu^2 g* g on |z| = 1: L g
# is affine in the gains, and g* g is replaced by its tangent at the gains before, which lies below it. So every step
# keeps what the one before achieved, and mu^2 enters linearly: no bisection.


def step(shaping: Shaping, gains: GainSet, at: Array, norm: float, w: Array) -> tuple[Array, float]:
    """(gains, bound on the norm at the frequencies w) of one convex-concave step from the gains `at`."""
    cost = np.append(np.zeros(at.size), 1.0)
    cuts = _tangent(shaping, at, norm, w)
    x = gains.solve(cost, "a step of the convex sequence", [cuts])
    return x[:-1], norm * float(np.sqrt(x[-1]))


def _tangent(shaping: Shaping, at: Array, norm: float, w: Array) -> Inequality:
    """[[g0* g + g* g0 - g0* g0, (W1 L g W2)*], [W1 L g W2, t norm^2]], scaled to order one; t is the last variable."""
    N = shaping.loop.channels
    left, right, late = shaping.parts(w)
    basis = np.eye(N)[:, None, :] * np.ones((w.size, 1))  # (N, k, N): e_i at every frequency
    g = np.concatenate([basis, basis * damper_rate(on_circle(w), 1.0)[:, None]])  # (2N, k, N): its slopes, diagonals
    g0 = np.tensordot(at, g, axes=1)  # (k, N)
    scale = 1 / np.abs(g0)  # columns are divided by |g0|, rows by the norm
    rows = (left * (shaping.loop.T / shaping.usable)) @ right * scale[:, None, :] / norm
    row_slopes = (late * g[:, :, None, :]) @ right * scale[:, None, :] / norm
    tangent = 2 * (np.conj(g0) * g).real * scale**2
    diagonal = np.eye(N)
    base = -np.broadcast_to(diagonal, (w.size, N, N)).astype(np.complex128)
    return gain_block(range(2 * N + 1), rows, row_slopes, base, tangent[..., None] * diagonal)


#: The sequence stops when a step improves the norm by less than this, relatively.
_SETTLED = 1e-6
#: A damper of less than this share of the device's damping is none: solvers leave 1e-9 where the optimum has zero.
_NEGLIGIBLE = 1e-6


def design(
    loop: Loop,
    condition: str = "any-environment",
    starts: Sequence[SpringDamper] = (),
    switching: tuple[Sequence[int], Sequence[int]] | None = None,
    limiter: bool = False,
    band_hz: tuple[float, float] | None = None,
    W1: Lti | None = None,
    W2: Lti | None = None,
) -> Design:
    """The best spring-damper under `condition`; by default the starts are chosen, a start need not be feasible.

    any-environment: minimises ||W1 L W2||_inf (23) over the exact set; the result does not depend on the start.
    this-environment: minimises the rms mismatch in this environment from every start, local optima only; with
    `switching` = (lo, hi) [samples] also safe under any switching of the forces' delays within it, with `limiter` also
    while forces are limited (any-environment is anyway, at no cost).
    `band_hz` is where the mismatch counts.

    Raises Infeasible where Theorem 4 admits no gains, DesignFailed where the search finds none for this-environment.
    """
    if named(condition) in (KNOWN_DEVICE, KNOWN_DEVICE_ANY):
        if switching or limiter:
            raise ValueError(f"{condition}: neither limited forces nor delays that vary are covered")
        return _for_known_devices(loop, starts, band_hz) if condition == KNOWN_DEVICE.name else _stiffest_known(loop)
    if named(condition).extensible:
        if switching and limiter:
            raise ValueError("limiter and switching: limited forces are proved for constant delays, ask for one")
        return _for_this_environment(loop, starts, switching, limiter, band_hz)
    if switching:
        raise ValueError("delays that vary are designed for by the this-environment condition only")
    return _for_any_environment(Shaping(loop, W1, W2), starts[0] if starts else None)


#: Digits that gains keep in a loop of many devices, finer than RESERVE: with all of them exact proofs take minutes.
_DIGITS = 5
_SWEEPS = 150  # take as long as a search for gains in this environment
#: Devices whose search ends within half a minute.
_MOST_ANY, _MOST_LIMITED = 48, 32


def _require_few(loop: Loop, most: int, what: str) -> None:
    if loop.channels > most:
        raise DesignFailed(None, (), f"{loop.channels} devices, allowed are {most} for a spring-damper by {what}")


def design_with(loop: Loop, condition: str, limiter: bool | None = None, **options: Any) -> Design:
    """A spring-damper, with the limiter's block in the place of the linear one where that is asked for or usual.

    Raises DesignFailed at once for so many devices that the search would take minutes.
    """
    if not named(condition).extensible:  # with rho = 0 it covers limited forces anyway
        if limiter and named(condition) is KNOWN_DEVICE:
            raise ValueError("limiter: forces that are limited are not covered by known-device, ask this-environment")
        _require_few(
            loop, _MOST_ANY, "any-environment: use a moving average, which needs no search, or this-environment"
        )
        return design(loop, condition, **options)
    if limiter:
        _require_few(loop, _MOST_LIMITED, "the limiter's block: leave the limiter out")
    if limiter is False or loop.channels > _MOST_LIMITED:
        return design(loop, condition, **options)
    refusal = LIMITER.not_designed(loop)
    if limiter and refusal:
        raise ValueError(refusal)
    if refusal or options.get("switching"):
        return design(loop, condition, **options)
    try:
        return design(loop, condition, limiter=True, **options)
    except DesignFailed:
        if limiter:
            raise
        return design(loop, condition, **options)


def _for_any_environment(shaping: Shaping, start: SpringDamper | None) -> Design:
    started, loop = time.perf_counter(), shaping.loop
    phi = least_phi(loop)
    certified = GainSet(loop, phi)
    gains, sdps = _start(loop, certified, start), 1
    norm, peak = shaping.norm(_coupling(loop, gains).compliance(loop.T))
    frequencies = [peak]
    for _ in range(budgets.SEQUENCE_STEPS):
        gains, bound = step(shaping, certified, gains, norm, np.array(frequencies))
        sdps += 1
        before, (norm, peak) = norm, shaping.norm(_coupling(loop, gains).compliance(loop.T))
        frequencies.append(peak)
        if abs(before - norm) < _SETTLED * norm and norm < (1 + _SETTLED) * bound:
            break
    coupling = _short(_coupling(loop, gains))
    if loop.channels > FEW:
        norm, _ = shaping.norm(coupling.compliance(loop.T))
    return _verified(loop, coupling, phi, "loop-norm", norm, sdps, started)


def _short(coupling: SpringDamper) -> SpringDamper:
    """The gains of many devices, in so few digits that a proof stays short."""
    if coupling.K.size <= FEW:
        return coupling
    K, B = ([float(f"{v:.{_DIGITS}g}") for v in gains] for gains in (coupling.K, coupling.B))
    return SpringDamper(K, B)


def _for_this_environment(
    loop: Loop,
    starts: Sequence[SpringDamper],
    switching: tuple[Sequence[int], Sequence[int]] | None,
    limiter: bool,
    band_hz: tuple[float, float] | None,
) -> Design:
    each = np.full(loop.channels, 1000.0)  # gains do not matter to how long it takes
    if reason := too_long(loop.F(SpringDamper(each, each / 1000)), _SWEEPS):
        raise DesignFailed(None, (), reason)
    started, starts = time.perf_counter(), starts or _default_starts(loop)
    band = band_hz or BAND_HZ
    if band_hz and switching:
        raise ValueError("band_hz: designs for delays that vary count 0.5 to 80 Hz, ask for one of them")
    sampled = partial(SwitchingLoop, loop, *switching) if switching else partial(SampledLoop, loop, band)
    many = loop.channels > FEW
    if many:
        starts = likeliest_first(sampled(), starts)
    coupling, rms, searches, c = (None, np.inf, 0, None) if many and limiter else least_rms(sampled, starts, band)
    if limiter:  # a little softer than without limits: nearly always found from there
        limited = partial(LimiterLoop, loop, band)
        linear, before = coupling, searches
        coupling, rms, searches, c = least_rms(limited, [linear] if linear else starts, band)
        if coupling is None and linear:
            coupling, rms, searches, c = least_rms(limited, starts, band)
        searches += before
    if coupling is None:
        certifies = "the this-environment condition certifies"
        if switching:
            certifies += f" under any switching from {tuple(switching[0])} to {tuple(switching[1])} samples"
        if limiter:
            certifies += " while forces are limited"
        line = (
            f"no spring-damper was found that {certifies} for theta = {loop.theta}, psi = {loop.psi}, "
            f"delta = {loop.delta}"
        )
        raise DesignFailed(None, (), line)
    coupling = _short(SpringDamper(coupling.K, np.where(_NEGLIGIBLE * usable(loop) > coupling.B, 0.0, coupling.B)))
    if many:
        rms = transparency(loop.F(coupling), loop.E(), loop.lam, band).rms_mismatch
    requirement = this_environment(loop.F(coupling), loop)
    wall_s = time.perf_counter() - started
    return Design(coupling, "this-environment", "rms", rms, requirement, searches, wall_s, c=c if many else None)


def _for_known_devices(loop: Loop, starts: Sequence[SpringDamper], band_hz: tuple[float, float] | None) -> Design:
    """The spring-damper of least rms mismatch under known-device; that of this-environment where it is no worse.

    Raises DesignFailed where neither certifies one, or the condition says nothing of the loop.
    """
    if reason := KNOWN_DEVICE.beyond(loop):
        raise DesignFailed(None, (), f"{KNOWN_DEVICE.name}: {reason}")
    if loop.environment.walls:
        line = f"{KNOWN_DEVICE.name}: designs are made without walls; design for this-environment, and audit the result"
        raise DesignFailed(None, (), line)
    started, band = time.perf_counter(), band_hz or BAND_HZ
    plain = least_rms(partial(SampledLoop, loop, band), starts or _default_starts(loop), band)
    first = [plain[0]] if plain[0] else []
    coupling, rms, searches, _ = least_rms(
        partial(KnownDeviceLoop, loop, band), [*first, *(starts or _default_starts(loop))], band
    )
    searches += plain[2]
    if plain[0] and not rms < plain[1]:
        coupling, rms = plain[0], plain[1]
    if coupling is None:
        line = f"no spring-damper was found that {KNOWN_DEVICE.name} certifies for theta = {loop.theta}"
        raise DesignFailed(None, (), f"{line}, psi = {loop.psi}, delta = {loop.delta}")
    coupling = _short(SpringDamper(coupling.K, np.where(_NEGLIGIBLE * usable(loop) > coupling.B, 0.0, coupling.B)))
    requirement, wall_s = KNOWN_DEVICE.judge(loop, coupling), time.perf_counter() - started
    beside = f"{decibels(plain[1]):.2f} dB rms" if plain[0] else "no spring-damper"
    note = f"known-device, {decibels(rms):.2f} dB rms; this-environment, for devices of which less is known: {beside}"
    return Design(coupling, KNOWN_DEVICE.name, "rms", rms, requirement, searches, wall_s, notes=(note,))


_ETAS = np.concatenate([np.geomspace(0.05, 0.6, 16), 1 - np.geomspace(0.3, 1e-4, 12)])  # shares of the largest beta
_ON_CIRCLE = 721  # frequencies at which the set of gains is imposed, from 0 to pi


def _stiffest_known(loop: Loop) -> Design:
    """The stiffest spring-damper that known-device-any certifies, channel by channel; objective in N/m, all together.

    He[V/(1-z)] > chi is Re W > chi |W|^2 |1 - 1/z|^2/T with W = K/D + B and Re W = K T/2 + B: a convex set of (K, B)
    for each beta, on which the largest K for a given B is the least root of a quadratic over frequency. B and beta are
    searched.
    """
    if reason := KNOWN_DEVICE_ANY.beyond(loop):
        raise DesignFailed(None, (), f"{KNOWN_DEVICE_ANY.name}: {reason}")
    started, gains = time.perf_counter(), []
    for i in range(loop.channels):
        gains.append(_stiffest_channel(loop.channel(i)))
    K, B = zip(*gains, strict=True)
    coupling = SpringDamper(K, B)
    requirement = KNOWN_DEVICE_ANY.judge(loop, coupling)
    if not requirement.certified:
        why = requirement.shortfall
        raise DesignFailed(None, (), f"the designed coupling is not certified by {KNOWN_DEVICE_ANY.name}: {why}")
    wall_s = time.perf_counter() - started
    return Design(coupling, KNOWN_DEVICE_ANY.name, "stiffness", float(sum(K)), requirement, 0, wall_s)


def _stiffest_channel(loop: Loop) -> tuple[float, float]:
    """K [N/m] and B [N s/m] of the stiffest spring-damper before any environment, with the reserve of a design."""
    from scipy.optimize import minimize_scalar  # slow to load

    z = on_circle(np.linspace(1e-6, np.pi, _ON_CIRCLE))
    steps = np.abs(1 - 1 / z) ** 2 / loop.T

    def stiffest(B: float, limits: Array) -> float:
        """The largest K with K T/2 + B >= limits steps |K/D + B|^2 at all frequencies, 0 where there is none.

        |1/D|^2 steps = T, and the real part of 1/D is T/2.
        """
        a, b = limits * loop.T, (limits * steps * B - 0.5) * loop.T
        c = limits * steps * B**2 - B
        room = b**2 - 4 * a * c
        if (room < 0).any():
            return 0.0
        root = np.sqrt(room)
        high, low = ((-b + sign * root) / (2 * a) for sign in (1, -1))
        return float(high.min()) if low.max() <= high.min() else 0.0

    def at(eta: float) -> tuple[float, float]:
        """(-K, B) of the best B for this share of the largest beta."""
        beta = eta * largest_beta(loop, 1 - _STIFF_RESERVE)
        cost = period_cost(loop, np.full(z.size, 1 - _STIFF_RESERVE), beta)
        limits = chi(z, loop.theta, cost, beta)[:, 0]
        most = 1 / (limits * steps).max()
        found = minimize_scalar(lambda B: -stiffest(B, limits), bounds=(0.0, most), method="bounded")
        return float(found.fun), float(found.x)

    tried = [at(eta) for eta in _ETAS]
    best = int(np.argmin([value for value, _ in tried]))
    ends = _ETAS[max(best - 1, 0)], _ETAS[min(best + 1, _ETAS.size - 1)]
    found: Any = minimize_scalar(lambda eta: at(eta)[0], bounds=ends, method="bounded", options={"xatol": 1e-6})
    K, B = min(at(float(found.x)), tried[best])
    return float(f"{-K:.{_STIFF_DIGITS}g}"), float(f"{B:.{_STIFF_DIGITS}g}")


_TAPS = 4096  # frequencies from which the Fourier coefficients of chi are taken
_SLACK = 2e-4  # of the largest chi: what a coupling has above it, half of which may be lost to the truncation


def _stiffest_linear(loop: Loop) -> Design:
    """The stiffest linear coupling that known-device-any certifies, channel by channel; objective in N/m, all together.

    V = V(1) - 2 (z-1) sum_{k>=1} chi_k z^-k has He[V/(1-z)] = chi, with the Fourier coefficients chi_k of chi and
    V(1) = 2 chi_0; no linear coupling is stiffer, since V(1)/2 is the mean of He[V/(1-z)]. The series ends where what
    is left is below half of the constant that is added.
    """
    from scipy.optimize import minimize_scalar  # slow to load

    if reason := KNOWN_DEVICE_ANY.beyond(loop):
        raise DesignFailed(None, (), f"{KNOWN_DEVICE_ANY.name}: {reason}")
    started, channels = time.perf_counter(), []
    z = on_circle(np.linspace(0, 2 * np.pi, _TAPS, endpoint=False))
    for i in range(loop.channels):
        one = loop.channel(i)

        def needed(eta: float, one: Loop = one) -> Array:
            beta = eta * largest_beta(one, 1 - RESERVE)
            return chi(z, one.theta, period_cost(one, np.full(z.size, 1 - RESERVE), beta), beta)[:, 0]

        best = int(np.argmin([needed(eta).mean() for eta in _ETAS]))
        ends = _ETAS[max(best - 1, 0)], _ETAS[min(best + 1, _ETAS.size - 1)]
        found: Any = minimize_scalar(lambda eta: needed(eta).mean(), bounds=ends, method="bounded")
        eta = float(found.x)
        limits = needed(eta)
        series = np.fft.rfft(limits).real / _TAPS
        left = 2 * np.cumsum(np.abs(series[::-1]))[::-1]  # of the terms from each on
        count = int(np.argmax(left < _SLACK / 2 * limits.max()))
        kept = series[1:count]
        weights = -2 * np.diff(np.append(kept, 0.0), prepend=0.0)
        weights[0] += 2 * series[0] + 2 * _SLACK * limits.max()
        channels.append(taps([float(f"{v:.{_TAP_DIGITS}g}") for v in weights], loop.T))
    V = Lti.diag(*channels)
    coupling = Compliance(V)
    requirement = KNOWN_DEVICE_ANY.judge(loop, coupling)
    if not requirement.certified:
        why = requirement.shortfall
        raise DesignFailed(None, (), f"the designed coupling is not certified by {KNOWN_DEVICE_ANY.name}: {why}")
    stiffness, wall_s = float((1 / np.diag(V.dc())).sum()), time.perf_counter() - started
    return Design(coupling, KNOWN_DEVICE_ANY.name, "stiffness", stiffness, requirement, 0, wall_s)


_TAP_DIGITS = 12  # of a coefficient: the error is far below the slack, and the exact proof stays short
_STIFF_RESERVE = 1e-3  # of the damping: gains are rounded to six digits, and frequencies lie between those imposed
_STIFF_DIGITS = 6


def _default_starts(loop: Loop) -> list[SpringDamper]:
    """Around 2 d/(n T), the stiffness that no linear coupling exceeds for any passive environment.

    With delay in the environment a loop is stable if the coupling is the stiffer of the two at every frequency,
    which the last start takes from the environment's stiffness at half the sampling rate.
    """
    spend = usable(loop)
    K = spend / (loop.T * (np.asarray(loop.theta) + np.asarray(loop.psi) + 1))
    starts = [SpringDamper(factor * K, share * spend) for factor, share in ((0.3, 0.1), (1.0, 0.3), (8.0, 1.0))]
    if any(loop.psi):
        highest = np.linalg.norm(loop.E().at(-1.0), 2)
        starts.append(SpringDamper(K, np.full(loop.channels, loop.T * highest)))
    return starts


def moving_average(loop: Loop, condition: str = "any-environment") -> Design:
    """The stiffest linear coupling that Theorem 4 admits; objective in N/m, of all channels together.

    With the condition known-device-any the stiffest that it admits, `_stiffest_linear`.

    V = T/(2 delta) (1 + ... + z^-theta) needs exactly delta at every frequency. With the constant e n^2 T/(2 delta)
    beside it, n = theta + 1, it needs delta/(1 + e) where the sum is largest, and less elsewhere.
    """
    if condition == KNOWN_DEVICE_ANY.name:
        return _stiffest_linear(loop)
    if (loop.latency or loop.varying_delay) and not ANY_ENVIRONMENT.beyond(loop):
        return _stiffest_in_frame(loop)
    started = time.perf_counter()
    phi = least_phi(loop)
    if loop.levels:
        return _moving_average_of_levels(loop, started)
    weight, terms = loop.T / (2 * even_damping(loop)), np.array(loop.theta) + 1
    coupling = MovingAverage(weight, terms.tolist(), RESERVE / (1 - RESERVE) * terms**2 * weight)
    return _verified(loop, coupling, phi, "stiffness", float(coupling.stiffness.sum()), 0, started)


def _stiffest_in_frame(loop: Loop) -> Design:
    """The stiffest linear coupling for any environment where forces latch late or delays switch; N/m, all together.

    He[V/(1-z)] = chi is attained by V = V(1) - 2 (z-1) sum_{k>=1} chi_k z^-k, whose series is finite, and V(1)/2 is the
    mean of chi (docs/theory.md). The multiplier of least mean is found by a convex program, or in closed form.
    """
    if loop.latency and loop.varying_delay:
        line = (
            "moving-average: no series is known for a latency and delays that switch together, ask for a spring-damper"
        )
        raise DesignFailed(None, (), line)
    started, channels = time.perf_counter(), []
    chi = _late_chi if loop.latency else _switched_chi
    for i in range(loop.channels):
        terms = chi(loop, i)
        weights = 2 * -np.diff(np.append(terms, 0.0))
        weights[0] += 2 * RESERVE * terms[0]
        channels.append(taps([float(f"{v:.{_TAP_DIGITS}g}") for v in weights], loop.T))
    V = Lti.diag(*channels)
    return _verified(loop, Compliance(V), None, "stiffness", float((1 / np.diag(V.dc())).sum()), 0, started)


def _late_chi(loop: Loop, i: int) -> Array:
    """chi_0, chi_1, .. of l (Q delta)^-1 l*/4 with l = [1 + .. + z^-(theta+1), 1 + .. + z^-theta], with the best Q."""
    (first, last), theta = (loop.latency or ())[i], loop.theta[i]
    inverse = np.diag([last, (loop.T_max or loop.T) - first])
    if first < last:
        inverse = np.linalg.inv(_best_charge(loop, i, theta))
    windows = np.array([np.ones(theta + 2), [*np.ones(theta + 1), 0.0]])
    pairs = [(a, b) for a in (0, 1) for b in (0, 1)]
    terms = [inverse[a, b] * np.correlate(windows[a], windows[b], "full")[theta + 1 :] for a, b in pairs]
    return np.sum(terms, axis=0) / (4 * (1 - RESERVE) * loop.delta[i])


def _switched_chi(loop: Loop, i: int) -> Array:
    """chi_0, .. of |vt|^2/(4 (delta/T - alpha/2)) + h^2/(2 alpha), vt the mean window, at the alpha of least chi_0."""
    lo, hi = loop.delays.lo[i], loop.delays.hi[i]
    damping, half = (1 - RESERVE) * loop.delta[i] / (loop.T_max or loop.T), (hi - lo) / 2
    window = np.where(np.arange(hi + 1) > lo, 0.5, 1.0)
    square = np.correlate(window, window, "full")[hi:]
    if not half:
        return square / (4 * damping)
    alpha = 2 * half * damping / (np.sqrt(square[0]) + half)
    terms = square / (4 * (damping - alpha / 2))
    terms[0] += half**2 / (2 * alpha)
    return terms


def _best_charge(loop: Loop, i: int, theta: int) -> Array:
    """Q (2, 2) [1/s] of least trace of Q^-1 M, M the inner products of the windows of theta + 2 and theta + 1 terms."""
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
    x = ConeProgram(objective, blocks).solve("the charge of a latency")
    found = hands.allowed(one, {name: (scale * v,) for name, v in zip(_Q, x[:3], strict=True)})
    return symmetric_from(np.array([found[name][0] for name in _Q]), 2)


_Q = "q11", "q12", "q22"


def _moving_average_of_levels(loop: Loop, started: float) -> Design:
    """The stiffest linear coupling of matrix levels: V = T/2 Delta^-1 (1 + .. + z^-theta), and a little more.

    It attains V(1) = T/2 blockdiag(n_i Delta_i^-1), the least of all by a matrix inequality.
    """
    inverses = np.linalg.inv(even_level(loop)) * loop.T / 2
    weight = np.array([[float(f"{v:.{_TAP_DIGITS}g}") for v in row] for row in (inverses + inverses.T) / 2])
    terms = np.array(loop.theta) + 1
    late = moving_sum(loop.theta, loop.T)
    constant = RESERVE / (1 - RESERVE) * terms**2 * weight
    V = Lti(late.A, late.B, weight @ late.C, weight @ late.D + (constant + constant.T) / 2, loop.T)
    stiffness = float(np.trace(np.linalg.inv(V.dc())))
    return _verified(loop, Compliance(V), least_phi(loop), "stiffness", stiffness, 0, started)


def _verified(
    loop: Loop, coupling: Coupling, phi: Array | None, figure: str, objective: float, sdps: int, started: float
) -> Design:
    """The design, with Theorem 4's requirement from the coupling alone; raises DesignFailed unless it is certified."""
    requirement = ANY_ENVIRONMENT.required(loop, coupling, phi)
    if not requirement.certified:
        why = requirement.reason or f"it requires {max(requirement.required):.6g} N s/m"
        raise DesignFailed(None, (), f"the designed coupling is not certified by any_environment: {why}")
    wall_s = time.perf_counter() - started
    return Design(coupling, "any-environment", figure, objective, requirement, sdps, wall_s, phi=phi)


def _coupling(loop: Loop, gains: Array) -> SpringDamper:
    (k, b), spend = np.split(np.maximum(gains, 0.0), 2), usable(loop)
    return SpringDamper(k * spend / loop.T, np.where(b < _NEGLIGIBLE, 0.0, b) * spend)


def _start(loop: Loop, certified: GainSet, start: SpringDamper | None) -> Array:
    """The gains of the set nearest to `start`, or the stiffest of the set."""
    N, more = loop.channels, []
    cost = np.repeat([-1.0, 0.0], N)
    if start is not None:  # of least t with |gains - wanted| <= t
        wanted = np.concatenate([start.K * loop.T, start.B]) / np.tile(usable(loop), 2)
        cost = np.append(np.zeros(2 * N), 1.0)

        def near(x: Array) -> Array:
            away = (x[:-1] - wanted)[:, None]
            return np.block([[x[-1] * np.eye(2 * N), away], [away.T, x[-1:, None]]])

        more = [Inequality.of(near, range(2 * N + 1))]
    try:
        x = certified.solve(cost, "the set of gains", more)
    except Infeasible as error:
        line = f"Theorem 4 admits no spring-damper with theta = {loop.theta}, psi = {loop.psi}, delta = {loop.delta}"
        raise Infeasible(error.problem, error.results, line) from error
    return x[: 2 * N]
