"""What a loop must satisfy so that no passive human can make it oscillate. Each condition states its block once.

A condition is a block that must be strictly positive real: He[block] > 0 on |z| = 1. `Demand` holds it as
free + s gain, where s multiplies the damping Delta_D that the devices guarantee. Poles at z = 1 are split off,
G/(z - 1) into G(1)/(z - 1), whose Hermitian part on the circle is -G(1)/2, and the quotient (G - G(1))/(z - 1). The
same expression is evaluated in floating point (a sweep: the required damping), over Fractions (an exact proof), over
stacks and over sampled responses (maps and designs). docs/theory.md derives them.

this-environment   He[F/(z-1)] > -Delta_D/T,  F stable,  F(1) symmetric positive semidefinite
any-environment    Lemma 4 of the paper for Psi = I and any passive environment under backward Euler:
                   He[(z-1) V/(Tz)] >= diag((1 - cos n_i w) / (2 delta_i)),   n_i = theta_i + 1
switching          this-environment for delays of the forces that vary within lo..hi at every tick
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from controller.delay import delay, moving_sum
from controller.lti import (
    Array,
    Block,
    Complex,
    Lti,
    Number,
    SingularLoop,
    as_like,
    constant_like,
    hstack,
    numbers,
    taps,
    vstack,
)
from design.frequency import Response, frequencies, hermitian, on_circle, rounding, supremum

#: as files and options of today name them: theorem4 is any-environment, closed-loop is this-environment
Condition = Literal["closed-loop", "theorem4"]

C = TypeVar("C", bound=str)  # a Condition, or "jitter-proof"


@dataclass(frozen=True, eq=False)
class Demand(Generic[Block]):
    """free + s gain must be strictly positive real, with s = 1 for the damping that there is.

    `static` are matrices that must be symmetric, by name; those in `semidefinite` also positive semidefinite.
    """

    free: Block
    gain: Block
    static: Mapping[str, Array] = field(default_factory=dict)
    semidefinite: tuple[str, ...] = ()


def this_environment_demand(F: Block, delta: Sequence[Any]) -> Demand[Block]:
    """He[F/(z-1)] > -s Delta_D/T. F displaces devices to forces (6), in any arithmetic; delta (m,) [N s/m].

    The energy that a device with a passive human can give back in a tick is at most the damping's, Delta_D dx^2/T, and
    what the force map gives is -F dx; with F(z) = F(1) + (z-1) R the block is R - F(1)/2 + s Delta_D/T.
    """
    F1, R = F.split_at_one()
    damping = np.diag(numbers(delta, F.T) / F.T)
    return Demand(R - F1 / 2, constant_like(F, damping), {"F(1)": F1}, ("F(1)",))


def any_environment_demand(V: Block, theta: Sequence[int], delta: Sequence[Any]) -> Demand[Block]:
    """He[(1 - 1/z) V/T] >= diag(|1 - z^-n_i|^2 / (4 s delta_i)), n = theta + 1, divided by |1 - 1/z|^2 and times s.

    With Theta-hat = diag(T/(2 delta_i) (1 + 1/z + ... + z^-theta_i)) (12) and H = V - Theta-hat/s, which (11) makes
    V-hat of, the block is H(1)/2 - (H - H(1))/(z - 1) for either part.
    """
    window = np.diag(V.T / (2 * numbers(delta, V.T))) @ as_like(V, moving_sum(theta, V.T))
    (V1, R), (W1, S) = V.split_at_one(), window.split_at_one()
    return Demand(S - W1 / 2, V1 / 2 - R, {"V(1)": V1})


def switching_block(
    G: Block, lo: Sequence[int], hi: Sequence[int], delta: Sequence[Any], alpha: Sequence[Any]
) -> tuple[Block, Array]:
    """[[F/(z-1) + Delta_D/T - diag(alpha)/2, 0], [2 h G, 2 diag(alpha)]], which must be positive real; and F(1).

    F = Theta_nom G with Theta_nom = (z^-lo + z^-hi)/2 and 2 h = hi - lo; G are the forces as they leave,
    alpha (m,) [N/m] is a multiplier, positive where the delay varies. Channels whose delay does not vary have no row
    and column of the second kind.

    A force that is late by n in [lo, hi] differs from the nominal one by at most h times the sum of the steps in
    between; the multiplier weighs that error against the displacement (an S-procedure, channel by channel).
    """
    T, widths = G.T, [b - a for a, b in zip(lo, hi, strict=True)]
    varying = [i for i, width in enumerate(widths) if width]
    a = numbers(alpha, T)
    half = Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))
    spread = Lti.constant(
        np.array([[widths[i] * (i == j) for j in range(len(lo))] for i in varying]).reshape(-1, len(lo)), T
    )
    both: Any = as_like(G, vstack(half, spread)) @ G
    m = len(lo)
    F1, R = both.rows(slice(None, m)).split_at_one()
    upper = R - F1 / 2 + np.diag(numbers(delta, T) / T - a / 2)
    if not varying:
        return upper, F1
    lower = np.zeros((m + len(varying), len(varying)), dtype=object)
    lower[m:] = np.diag(2 * a[varying])
    return hstack(vstack(upper, both.rows(slice(m, None))), constant_like(G, numbers(lower, T))), F1


def _halves(lo: int, hi: int) -> list[Number]:
    return [Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)]


def delayed_environment_block(delayed: Lti, phi: Sequence[Any]) -> tuple[Array, Lti]:
    """E(1), and E-hat + Phi without its pole, which must be positive real; `delayed` is Psi E.

    E-hat = T z/(z-1) Psi E = T E(1) z/(z-1) + T z R(z), and the Hermitian part of z/(z-1) on the circle is 1/2:
    T (z R + E(1)/2) + Phi. Delay makes the environment lose passivity; Phi (14) covers the loss.
    """
    E1, R = delayed.split_at_one()
    T, passive = delayed.T, Lti(R.A, R.B, R.C @ R.A, R.C @ R.B + E1 / 2, delayed.T)
    return E1, T * passive + np.diag(numbers(phi, T))


#: Delta_V^-1 stays this much, relatively, below the limit of (14), which is strict.
STRICT = Fraction(1, 10**9)
#: Delta_V^-1 in units of 1/delta where Phi is 0 and (14) asks only Delta_V > 0.
UNLIMITED = 10**6


def delayed_coupling_block(V: Lti, theta: Sequence[int], phi: Sequence[Any], delta: Sequence[Any]) -> tuple[Array, Lti]:
    """H(1), which must be symmetric, and the block that carries the excess of V-hat, exactly, for the multiplier phi.

    V-hat must be Delta_V-OSP with Delta_V^-1 = S < Phi^-1 - Delta_D^-1 (14). With H = V - Theta-hat = H(1) + (z-1) R,
    divided by |1 - 1/z|^2: T He[H(1)/2 - R] > H* S^-1 H, by a Schur complement the Hermitian part of
    [[T (H(1)/2 - R), 0], [2 H, S]]. Raises ValueError for a multiplier that is none.
    """
    if len(phi) != len(delta) or not all(0 <= p < d for p, d in zip(phi, delta, strict=True)):
        raise ValueError("the multiplier Phi is not between 0 and the device damping on every channel")
    T = V.T
    H = V - np.diag(T / (2 * numbers(delta, T))) @ moving_sum(theta, T)
    H1, R = H.split_at_one()
    excess = [(1 / p - 1 / d) * (1 - STRICT) if p else UNLIMITED / d for p, d in zip(phi, delta, strict=True)]
    m = len(delta)
    right = np.vstack([np.zeros((m, m), dtype=object), np.diag(numbers(excess, T))])
    return H1, hstack(vstack(T * (H1 / 2 - R), 2 * H), Lti.constant(right, T))


# How much damping a condition asks: sweeps, without a solver.


@dataclass(frozen=True)
class Requirement(Generic[C]):
    """The damping that a condition asks of the devices, against what they have."""

    condition: C
    required: tuple[float, ...]  # (m,) [N s/m]; inf when no damping helps
    available: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: float | None  # where it binds
    reason: str | None = None  # why the figure is infinite
    proof: str = "sampled"

    @property
    def ratio(self) -> float:
        """s: required / available on the worst channel."""
        pairs = zip(self.required, self.available, strict=True)
        return max(need / have if have > 0 else np.inf for need, have in pairs)

    @property
    def certified(self) -> bool:
        return self.ratio < 1


def least_scale(demand: Demand[Any], w: Array) -> Array:
    """The least s with He[free + s gain] >= 0 at each frequency w (k,) [rad/sample]; inf where there is none."""
    z = on_circle(w)
    free, gain = hermitian(demand.free.at(z)), hermitian(demand.gain.at(z))
    return least_multiple(free, gain)


def least_multiple(free: Complex, gain: Complex) -> Array:
    """The least s with free + s gain >= 0, (...,), of Hermitian (..., p, p); inf where gain is not positive."""
    own = np.diagonal(gain, axis1=-2, axis2=-1).real
    if (own > 0).all() and not (gain * (1 - np.eye(gain.shape[-1]))).any():
        weight = 1 / np.sqrt(own)
        return np.linalg.eigvalsh(-weight[..., :, None] * free * weight[..., None, :])[..., -1]
    eigenvalues, basis = np.linalg.eigh(gain)
    floor = np.maximum(1e-13 * np.abs(eigenvalues).max(axis=-1, keepdims=True), np.finfo(float).tiny)
    whitened = np.conj(np.swapaxes(basis, -1, -2)) / np.sqrt(np.maximum(eigenvalues, floor))[..., :, None]
    H = -whitened @ (free @ np.conj(np.swapaxes(whitened, -1, -2)))
    return np.where(eigenvalues[..., 0] > floor[..., 0], np.linalg.eigvalsh(H)[..., -1], np.inf)


def this_environment(F: Lti, delta: Sequence[float]) -> Requirement:
    """The damping that this-environment asks for the force map F, with device dampings `delta` [N s/m]."""
    available = dampings(delta, F.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("closed-loop", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    try:
        demand = this_environment_demand(F, available)
    except SingularLoop as error:  # a radius that rounding has kept below one
        return refused(f"the force map is singular in floating point: {error}")
    F1 = demand.static["F(1)"]
    # rounding in F(1) is relative to what F is elsewhere: a free mass has F(1) = 0 out of large numbers
    scale = max(float(np.abs(F1).max()), float(np.abs(F.D).max()), float(np.abs(F.at(-1.0)).max()), 1e-12)
    skew, least, slack = np.abs(F1 - F1.T).max(), np.linalg.eigvalsh((F1 + F1.T) / 2).min(), 1e-9 * scale
    if max(skew, -least) > slack:  # of a map that is nothing but rounding
        slack = max(slack, min(rounding(F, on_circle(frequencies(F))), 1e-9 * min(available) / F.T))
    if skew > slack:
        return refused("the static stiffness F(1) is not symmetric: a slow closed path could extract energy")
    if least < -slack:
        return refused("the static stiffness F(1) has a negative direction: it pushes outwards")
    ratio, w = supremum(lambda w: least_scale(demand, w), np.concatenate([[0.0], frequencies(F)]))
    return from_ratio("closed-loop", max(ratio, 0.0), available, w / (2 * np.pi * F.T))


def any_environment(V: Lti, theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """The damping that any-environment asks for psi = 0 and V, whatever passive environment is behind it."""
    available = dampings(delta, V.inputs)
    if len(theta) != V.inputs:
        raise ValueError(f"theta has {len(theta)} entries for {V.inputs} channels")

    def refused(reason: str) -> Requirement:
        return refusal("theorem4", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    demand = any_environment_demand(V, theta, available)
    V1 = demand.static["V(1)"]
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    ratio, w = supremum(lambda w: least_scale(demand, w), np.concatenate([[0.0], frequencies(V)]))
    if np.isinf(ratio):
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz: its damping vanishes there")
    return from_ratio("theorem4", ratio, available, w / (2 * np.pi * V.T))


def any_environment_per_channel(V: Sequence[Lti], theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """any-environment for a diagonal coupling, given its channels: each device's own figure."""
    each = [any_environment(v, [n], [d]) for v, n, d in zip(V, theta, delta, strict=True)]
    worst = max(each, key=lambda r: r.ratio)
    required = tuple(r.required[0] for r in each)
    available = tuple(r.available[0] for r in each)
    return Requirement("theorem4", required, available, worst.frequency_hz, worst.reason)


def from_ratio(condition: C, ratio: float, available: tuple[float, ...], frequency_hz: float) -> Requirement[C]:
    """The requirement of `ratio` times what is available, on every channel."""
    return Requirement(condition, tuple(ratio * delta for delta in available), available, frequency_hz)


def refusal(condition: C, available: tuple[float, ...], reason: str) -> Requirement[C]:
    """The requirement that no damping satisfies."""
    return Requirement(condition, (np.inf,) * len(available), available, None, reason)


def dampings(delta: Sequence[float], channels: int) -> tuple[float, ...]:
    """`delta` as floats, one positive damping per channel [N s/m]."""
    values = tuple(float(d) for d in delta)
    if len(values) != channels:
        raise ValueError(f"delta has {len(values)} entries for {channels} channels")
    if not all(0 <= d < np.inf for d in values):
        raise ValueError(f"delta is {list(values)}, expected dampings >= 0 in N s/m")
    return values


# any-environment with delay inside the environment (psi >= 1), for a given multiplier Phi


#: What a sweep may find uncovered, relatively to the damping: rounding.
ROUNDING = 1e-6


def any_environment_delayed(
    V: Lti, environment: Lti, theta: Sequence[int], psi: Sequence[int], delta: Sequence[float], phi: Array
) -> Requirement:
    """Theorem 4 for the coupling V with the diagonal multiplier phi (N,) [N s/m]; phi = 0 is `any_environment`.

    The ratio s is the least for which s Delta_D satisfies, at every frequency and divided by |1 - 1/z|^2,
    He[H/(1-z)] >= H* Delta_V H with H = V - Theta-hat/s and Delta_V = Phi + Phi (s Delta_D - Phi)^-1 Phi. It is
    found by bisection at each frequency: no solver.
    """
    available = dampings(delta, V.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("theorem4", available, reason)

    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    V1 = V.dc()
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    if uncovered(environment, psi, np.diag(phi)) > ROUNDING * max(available):
        return refused("E-hat + Phi is not passive for this multiplier")
    needed = delayed_demand(V, theta, np.asarray(available), np.asarray(phi))
    ratio, w = supremum(needed, np.concatenate([[0.0], frequencies(V)]))
    if np.isinf(ratio):
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz for this multiplier")
    return from_ratio("theorem4", ratio, available, w / (2 * np.pi * V.T))


def uncovered(environment: Lti, psi: Sequence[int], Phi: Array) -> float:
    """sup over frequency of the largest eigenvalue of -He E-hat - Phi [N s/m]; > 0 where Phi is too small."""
    delayed = delay(psi, environment.T) @ environment
    regular = regular_part(delayed)

    def short(w: Array) -> Array:
        return -np.linalg.eigvalsh(environment.T * hermitian(regular.at(on_circle(w))) + Phi)[:, 0]

    return supremum(short, np.concatenate([[0.0], frequencies(delayed)]))[0]


def delayed_demand(V: Lti, theta: Sequence[int], delta: Array, phi: Array) -> Response:
    """w (k,) -> the least s of `any_environment_delayed` at each frequency, up to 1000; inf beyond."""
    V1, quotient, T = V.dc(), V.quotient_at_one(), V.T
    floor = float((phi / delta).max())

    def needed(w: Array) -> Array:
        z = on_circle(w)
        passivity = (V1 / 2 - hermitian(quotient.at(z))) / T
        response = V.at(z) / T
        vt = np.stack([np.exp(-1j * np.outer(w, np.arange(n + 1))).sum(axis=1) for n in theta], axis=1)

        def short(s: Array) -> NDArray[np.bool_]:
            damping = s[:, None] * delta
            cover = phi + phi**2 / (damping - phi)
            H = response - (vt / (2 * damping))[:, :, None] * np.eye(delta.size)
            cost = np.conj(np.swapaxes(H, 1, 2)) @ (cover[:, :, None] * H)
            window = (np.abs(vt) ** 2 / (4 * damping))[:, :, None] * np.eye(delta.size)
            return np.linalg.eigvalsh(passivity - window - cost)[:, 0] < 0

        low, high = np.full(w.size, floor * (1 + 1e-12) + 1e-12), np.full(w.size, 1e3)
        hopeless = short(high)
        for _ in range(60):
            middle = np.sqrt(low * high)
            bad = short(middle)
            low, high = np.where(bad, middle, low), np.where(bad, high, middle)
        return np.where(hopeless, np.inf, high)

    return needed


# delays that switch within [lo, hi]: the best multiplier
#
# With a = alpha T/delta the least factor s on delta is the supremum over frequency of an eigenvalue that is convex in
# a: at every frequency and direction u it is at least u*(..)u, a sum n + p.a + q.(1/a), and that bounds s from below
# for all a. The worst of these bounds are collected until their least a attains them. No convex solver is needed.

SETTLED = 1e-7  # relative gap between the sweep of a multiplier and the bound that no multiplier beats
MOST_ROUNDS = 60
FIRST = 0.1  # the a that a search begins with
SMALLEST, LARGEST = 1e-8, 1e6  # .. and what it may become
NEAR, MOST_PEAKS = 0.3, 8  # of the peaks within 30 % of the highest, so many give a bound


@dataclass(frozen=True)
class JitterProof:
    """What switching within a range asks of the devices."""

    requirement: Requirement  # condition "jitter-proof"
    alpha: tuple[float, ...]  # (m,) [N/m] the multiplier that shows it, at the available damping; 0 where lo = hi
    bound: float  # no multiplier shows less than this times the available damping (on the frequencies looked at)


def jitter_proof(
    G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float], alpha: Sequence[float] | None = None
) -> JitterProof:
    """The least common factor on `delta` [N s/m] with which some multiplier satisfies the condition, and which does.

    G is the force map without Theta. The factor is that of the refined sweep (design.frequency.sweep) at the multiplier
    found, or at `alpha` (m,) [N/m] where it is given, positive where lo < hi; `bound` is then that factor.
    """
    available, h = dampings(delta, G.inputs), half_widths(lo, hi)
    if len(h) != G.inputs:
        raise ValueError(f"delays are given for {len(h)} channels, expected {G.inputs}")
    constant = this_environment(nominal(lo, hi, G.T) @ G, delta)
    if not np.isfinite(constant.ratio):
        return jitter_refusal(available, constant.reason or "no constant delay is safe")
    search, unit = _Search(G, lo, hi, np.asarray(available)), np.asarray(available) / G.T
    given = None if alpha is None else (np.asarray(alpha) / unit)[search.active]
    a, ratio, w, bound = search.least() if given is None else search.only(given)
    multiplier = np.zeros(h.size)
    multiplier[search.active] = a
    requirement = from_ratio("jitter-proof", max(ratio, 0.0), available, w / (2 * np.pi * G.T))
    return JitterProof(requirement, tuple((multiplier * unit).tolist()), bound)


def jitter_refusal(available: tuple[float, ...], reason: str) -> JitterProof:
    """That no damping is enough, and why."""
    return JitterProof(refusal("jitter-proof", available, reason), (np.inf,) * len(available), np.inf)


Found = tuple[Array, float, float, float]  # a, s(a), where it binds [rad/sample], a lower bound on s over all a


class _Search:
    """s(a) = sup over w of the largest eigenvalue of N + diag(a)/2 + Y* diag(1/2a) Y, over the channels that vary.

    A Schur complement of `switching_block`, scaled by W = diag(sqrt(T/delta)): N = -W He[F/(z-1)] W,
    F = Theta_nom G, Y = h W G W.
    """

    def __init__(self, G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Array) -> None:
        F = nominal(lo, hi, G.T) @ G
        self._G, self._demand = G, this_environment_demand(F, delta.tolist())
        self._weight, self._h = np.sqrt(G.T / delta), half_widths(lo, hi)
        self.active = np.flatnonzero(self._h)
        self._grid = np.concatenate([[0.0], frequencies(G)])
        none = np.zeros((0, self.active.size))
        self._n, self._p, self._q = np.zeros(0), none, none  # the bounds collected

    def only(self, a: Array) -> Found:
        """s at this a."""
        ratio, w = self._swept(a)
        return a, ratio, w, ratio

    def least(self) -> Found:
        """The least s over all a."""
        a, bound = np.full(self.active.size, FIRST), -np.inf
        if not a.size:
            return self.only(a)
        N, Y = self._parts(self._grid)
        best: tuple[Array, float, float] = (a, np.inf, 0.0)
        for _ in range(MOST_ROUNDS):
            if self._cut(a, N, Y) <= bound + SETTLED * abs(bound):  # settled on the samples: look between them
                ratio, w = self._swept(a)
                best = min(best, (a, ratio, w), key=lambda found: found[1])
                if best[1] <= bound + 10 * SETTLED * abs(bound):
                    return *best, bound
                between = self._parts(np.array([w]))
                N, Y = np.concatenate([N, between[0]]), np.concatenate([Y, between[1]])
                self._cut(a, *between)
            a, bound = self._bound(a)
        return *min(best, (a, *self._swept(a)), key=lambda found: found[1]), bound

    def _swept(self, a: Array) -> tuple[float, float]:
        """(s(a), w) by a sweep that is refined between its samples."""
        return supremum(lambda w: self._largest(a, *self._parts(w)), self._grid)

    def _parts(self, w: Array) -> tuple[Complex, Complex]:
        """N (k, m, m) and the rows of Y with h > 0, at the frequencies w (k,) [rad/sample]."""
        z, W = on_circle(w), self._weight
        N = -W[:, None] * hermitian(self._demand.free.at(z)) * W
        Y = (self._h * W)[:, None] * self._G.at(z) * W
        return N, Y[:, self.active]

    def _matrices(self, a: Array, N: Complex, Y: Complex) -> Complex:
        """N + diag(a)/2 + Y* diag(1/2a) Y, (k, m, m)."""
        diagonal = np.zeros(self._h.size)
        diagonal[self.active] = a / 2
        return N + np.diag(diagonal) + np.conj(np.swapaxes(Y, 1, 2)) @ (Y / (2 * a[:, None]))

    def _largest(self, a: Array, N: Complex, Y: Complex) -> Array:
        return np.linalg.eigvalsh(self._matrices(a, N, Y))[:, -1].astype(float)

    def _cut(self, a: Array, N: Complex, Y: Complex) -> float:
        """Collect the bounds at the local peaks near the worst sampled frequency; the worst value."""
        values = self._largest(a, N, Y)
        top, padded = float(values.max()), np.concatenate([[-np.inf], values, [-np.inf]])
        peaks = np.flatnonzero((values >= padded[:-2]) & (values >= padded[2:]) & (values >= top - NEAR * abs(top)))
        peaks = peaks[np.argsort(values[peaks])[-MOST_PEAKS:]]
        u = np.linalg.eigh(self._matrices(a, N[peaks], Y[peaks]))[1][:, :, -1]
        self._n = np.append(self._n, np.einsum("ki,kij,kj->k", u.conj(), N[peaks], u).real)
        self._p = np.concatenate([self._p, np.abs(u[:, self.active]) ** 2 / 2])
        self._q = np.concatenate([self._q, np.abs(np.einsum("kij,kj->ki", Y[peaks], u)) ** 2 / 2])
        return top

    def _bound(self, a: Array) -> tuple[Array, float]:
        """(a, value): the least maximum over a of the bounds n + p.a + q.(1/a), convex in log a."""

        def below(x: Array) -> Array:
            return x[0] - self._n - self._p @ np.exp(x[1:]) - self._q @ np.exp(-x[1:])

        def slope(x: Array) -> Array:
            return np.column_stack([np.ones(self._n.size), -self._p * np.exp(x[1:]) + self._q * np.exp(-x[1:])])

        start = np.concatenate([[0.0], np.log(a)])
        start[0] = -below(start).min()
        limits = [(None, None)] + [(np.log(SMALLEST), np.log(LARGEST))] * a.size
        gradient = np.eye(1 + a.size)[0]
        found = minimize(
            lambda x: x[0],
            start,
            jac=lambda x: gradient,
            bounds=limits,
            method="SLSQP",
            constraints={"type": "ineq", "fun": below, "jac": slope},
            options={"maxiter": 200, "ftol": 1e-12},
        )
        return np.exp(found.x[1:]), float(found.x[0])


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def nominal(lo: Sequence[int], hi: Sequence[int], T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    return Lti.diag(*(taps(_halves(p, q), T) for p, q in zip(lo, hi, strict=True)))


def regular_part(E: Lti) -> Lti:
    """R + E(1)/2, where E z/(z-1) = E(1) z/(z-1) + R: stable where E is.

    The Hermitian part of z/(z-1) on the circle is 1/2, so this has the Hermitian part of E z/(z-1) there.
    """
    E1, quotient = E.split_at_one()
    return Lti(E.A, E.B, quotient.C @ E.A, quotient.C @ E.B + E1 / 2, E.T)
