"""How much device damping a coupling needs, by both conditions, without a solver.

closed-loop: with F what the devices see and every human passive, the loop is stable if
    He[F(z)/(z-1)] > -Delta_D / T   on |z| = 1,   F stable, F(1) symmetric positive semidefinite.
theorem4: Lemma 4 of the paper for Psi = I and any passive environment under backward Euler:
    He[(z-1) V/(Tz)] >= diag((1 - cos n_i w) / (2 delta_i)),   n_i = theta_i + 1.

The required damping is s Delta_D with the least s for which s Delta_D satisfies the condition: the supremum
of design.condition.demand over frequency.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from controller.coupling import Compliance, Coupling, InternalModel, NoCoupling, SpringDamper, basis
from controller.delay import delay
from controller.environment import Network, Region, Spring, environment
from controller.gains import Gains, force_maps
from controller.lti import Array, Lti
from design.frequency import Response, frequencies, hermitian, on_circle, suprema, supremum

# ----------------------------------------------------------------------------------------------------
# What a condition asks of the devices at each frequency; its supremum is the required damping (design.margin).
#
# Both functions return w [rad/sample] -> s(w): the multiple of Delta_D that the condition needs at that frequency,
# regular at w = 0, where G/(z-1) is split into G(1)/(z-1), whose Hermitian part on the circle is -G(1)/2, and the
# quotient (G(z) - G(1))/(z - 1). Below zero where the loop itself dissipates.


def closed_loop_demand(F: Lti, delta: Sequence[float]) -> Response:
    """The least s with He[F/(z-1)] >= -s Delta_D/T; F stable with F(1) symmetric, delta (m,) > 0 [N s/m]."""
    F1, regular = F.dc(), F.quotient_at_one()
    weight = np.sqrt(F.T / np.asarray(delta))

    def demand(w: Array) -> Array:
        H = F1 / 2 - hermitian(regular.at(on_circle(w)))
        return np.linalg.eigvalsh(weight[:, None] * H * weight)[:, -1]

    return demand


def theorem4_demand(V: Lti, theta: Sequence[int], delta: Sequence[float]) -> Response:
    """The least s with (V(1)/2 - He[(V - V(1))/(z - 1)]) / T >= diag(|vt_i|^2 / (4 s delta_i)); inf where none is.

    vt_i = 1 + 1/z + ... + z^-theta_i, V stable with V(1) symmetric, psi = 0, delta (m,) > 0 [N s/m].
    """
    V1, regular = V.dc(), V.quotient_at_one()

    def passivity(w: Array) -> NDArray[np.complex128]:
        return (V1 / 2 - hermitian(regular.at(on_circle(w)))) / V.T

    def window(w: Array) -> Array:
        """|vt_i|^2 / (4 delta_i), shape (k, m)."""
        vt = [np.exp(-1j * np.outer(w, np.arange(n + 1))).sum(axis=1) for n in theta]
        return np.abs(np.stack(vt, axis=1)) ** 2 / (4 * np.asarray(delta))

    def demand(w: Array) -> Array:
        eigenvalues, basis = np.linalg.eigh(passivity(w))
        floor = np.maximum(1e-13 * np.abs(eigenvalues).max(axis=1, keepdims=True), np.finfo(float).tiny)
        whitened = np.conj(np.swapaxes(basis, 1, 2)) / np.sqrt(np.maximum(eigenvalues, floor))[:, :, None]
        H = whitened @ (window(w)[:, :, None] * np.conj(np.swapaxes(whitened, 1, 2)))
        return np.where(eigenvalues[:, 0] > floor[:, 0], np.linalg.eigvalsh(H)[:, -1], np.inf)

    return demand


# ----------------------------------------------------------------------------------------------------
# What a design is asked for: the environment, the delays, the devices, and how mismatch is weighed.


#: Designs ask for (1 - RESERVE) of the damping that there is, so that they are certified as stored.
RESERVE = 1e-4


@dataclass(frozen=True, eq=False)
class Specification:
    """N channels in, N channels out. Raises ValueError naming the field that is wrong."""

    environment: Lti  # E(z), N x N, passive
    theta: tuple[int, ...]  # (N,) transmission delays [samples]
    psi: tuple[int, ...]  # (N,) environment delays [samples]
    lam: tuple[int, ...]  # (N,) delays of the reference Lambda (7) [samples], 0 <= lam <= theta + psi
    delta: tuple[float, ...]  # (N,) device dampings [N s/m]
    W1: Lti | None = None  # weight on the left of (22); the identity if None
    W2: Lti | None = None  # diagonal weight on its right; low_pass if None
    others: Mapping[str, Lti] = field(default_factory=dict)  # by name: what else the environment may be, for `optimal`
    regions: tuple[Region, ...] = ()  # the box of the others, in which the design is searched for violations
    shrunk: Callable[[float], Mapping[str, Lti]] | None = None  # the others of a box with ranges so many times as wide

    def __post_init__(self) -> None:
        E = self.environment
        if E.inputs != E.outputs:
            raise ValueError(f"environment is {E.outputs} x {E.inputs}, expected one force per contact")
        for name in ("theta", "psi", "lam"):
            object.__setattr__(self, name, _delays(name, getattr(self, name), E.inputs))
        object.__setattr__(self, "delta", dampings(self.delta, E.inputs))
        if min(self.delta) == 0:
            raise ValueError(f"delta is {list(self.delta)}, expected positive dampings in N s/m")
        ahead = [i for i, spare in enumerate(self.advance) if spare < 0]
        if ahead:
            i = ahead[0]
            limit = self.theta[i] + self.psi[i]
            raise ValueError(f"lam[{i}] is {self.lam[i]}, expected at most theta + psi = {limit} samples (7)")
        W1 = self.W1 or Lti.constant(np.eye(E.inputs), E.T)
        W2 = self.W2 or low_pass(E.inputs, E.T)
        object.__setattr__(self, "W1", W1)
        object.__setattr__(self, "W2", W2)
        _check_weights(W1, W2, E)
        check_passive(E)

    @property
    def channels(self) -> int:
        return self.environment.inputs

    @property
    def T(self) -> float:
        return self.environment.T

    @property
    def advance(self) -> tuple[int, ...]:
        """(N,) samples by which the round trip is later than the reference: the exponent of Psi Lambda^-1 Theta."""
        return tuple(t + p - n for t, p, n in zip(self.theta, self.psi, self.lam, strict=True))

    @property
    def delayed_environment(self) -> Lti:
        """Psi E."""
        return delay(self.psi, self.T) @ self.environment

    @property
    def usable(self) -> Array:
        """(N,) the damping that a design may spend [N s/m]."""
        return (1 - RESERVE) * np.asarray(self.delta)


def low_pass(channels: int, T: float, f0: float = 80.0) -> Lti:
    """w(z) I, the backward Euler discretisation of 1/(1 + s/(2 pi f0)), f0 in Hz (section 6 of the paper)."""
    a = 2 * np.pi * f0 * T
    gain, pole = a / (1 + a), 1 / (1 + a)
    one = np.eye(channels)
    return Lti(pole * one, one, gain * pole * one, gain * one, T)


def check_passive(E: Lti, tolerance: float = 1e-9) -> None:
    """Raise ValueError unless E z/(z-1), from displacement, is positive real and E(1) symmetric and >= 0."""
    if not E.is_stable():
        raise ValueError("environment is not passive: it has a pole on or outside the unit circle")
    static = E.dc()
    scale = np.abs(static).max() + np.abs(E.D).max()
    if np.abs(static - static.T).max() > tolerance * scale:
        raise ValueError("environment is not passive: its static stiffness E(1) is not symmetric")
    if np.linalg.eigvalsh((static + static.T) / 2)[0] < -tolerance * scale:
        raise ValueError("environment is not passive: its static stiffness E(1) has a negative direction")
    regular = regular_part(E)

    def active(w: Array) -> Array:
        return -np.linalg.eigvalsh(hermitian(regular.at(on_circle(w))))[:, 0]

    worst, w = supremum(active, np.concatenate([[0.0], frequencies(E)]))
    if worst > tolerance * scale:
        raise ValueError(f"environment is not passive: it produces energy at {w / (2 * np.pi * E.T):.4g} Hz")


def regular_part(E: Lti) -> Lti:
    """R + E(1)/2, where E z/(z-1) = E(1) z/(z-1) + R: stable where E is.

    The Hermitian part of z/(z-1) on the circle is 1/2, so this has the Hermitian part of E z/(z-1) there.
    """
    quotient = E.quotient_at_one()
    return Lti(E.A, E.B, quotient.C @ E.A, quotient.C @ E.B + E.dc() / 2, E.T)


def _delays(name: str, steps: Sequence[int], channels: int) -> tuple[int, ...]:
    if len(steps) != channels:
        raise ValueError(f"{name} has {len(steps)} entries for {channels} channels")
    if any(n != int(n) or n < 0 for n in steps):
        raise ValueError(f"{name} is {list(steps)}, expected whole numbers of samples, zero or more")
    return tuple(int(n) for n in steps)


def _check_weights(W1: Lti, W2: Lti, E: Lti) -> None:
    if W1.inputs != E.outputs or (W2.inputs, W2.outputs) != (E.inputs, E.inputs):
        raise ValueError(f"W1 and W2 must fit the {E.inputs} channels on the inside, W2 also on the outside")
    for name, W in (("W1", W1), ("W2", W2)):
        if not W.is_stable():
            raise ValueError(f"{name} has a pole on or outside the unit circle, so no norm is finite")
    z = on_circle(np.array([0.1, 1.0, 3.0]))
    response = W2.at(z)
    if np.abs(response - response * np.eye(E.inputs)).max() > 1e-9 * np.abs(response).max():
        raise ValueError("W2 must be diagonal: the convex-concave step divides by it channel by channel")


# ----------------------------------------------------------------------------------------------------
# Theorem 4 with delay inside the environment (psi >= 1), for a given multiplier Phi.
#
# Delay makes the environment lose passivity. Phi covers the loss: E-hat + Phi is passive; devices and coupling pay
# for it, V-hat must be Delta_V-OSP with Delta_V = (Phi^-1 - Delta_D^-1)^-1, by (14).


#: What a sweep may find uncovered, relatively to the damping: rounding.
ROUNDING = 1e-6


def theorem4_delayed(
    V: Lti, environment: Lti, theta: Sequence[int], psi: Sequence[int], delta: Sequence[float], phi: Array
) -> Requirement:
    """Theorem 4 for the coupling V with the diagonal multiplier phi (N,) [N s/m]; phi = 0 is `margin.theorem4`.

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
    """w (k,) -> the least s of `theorem4_delayed` at each frequency, up to 1000; inf beyond."""
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


# ----------------------------------------------------------------------------------------------------
# Delays that vary: the condition under which no switching of the forces' delays within [lo, hi] is dangerous.
#
# Let G = (I + Psi E V)^-1 Psi E be the forces as they leave, g = G x, and let the device hold of channel i the force
# g_i[k - n] with an age n in [lo_i, hi_i] that may change at every tick. Beside the nominal
# Theta_nom = (z^-lo + z^-hi)/2 the error w[k] = g[k-n] - (g[k-lo] + g[k-hi])/2 is half of a sum of hi - lo steps
# g[j] - g[j-1], each with a sign, so by Cauchy's inequality, for every number of ticks,
#     sum |w_i|^2 <= h_i^2 sum |g_i[k] - g_i[k-1]|^2,   h_i = (hi_i - lo_i)/2.
# The steps of g are G dx, one tick later. With -w_i dx_i <= alpha_i |dx_i|^2 / 2 + |w_i|^2 / (2 alpha_i) the energy
# argument of the closed-loop condition (design.margin) goes through if on |z| = 1, for one alpha > 0,
#     [ He(Theta_nom G/(z-1)) + Delta_D/T - diag(alpha)/2    (h G)*        ]
#     [ h G                                                   2 diag(alpha) ]  >  0,
# G stable, G(1) symmetric positive semidefinite. It is jointly affine in (G, alpha), and alpha may not depend on the
# frequency, since w is not a filtered g. For hi - lo = 1 nothing is lost in w: |w| = h |step| exactly.
#
# What it shows holds for any motion x and any ages, hence for constant ones: the closed-loop condition is satisfied
# with the same damping for every constant theta in the range.


Complex = NDArray[np.complex128]


def half_widths(lo: Sequence[int], hi: Sequence[int]) -> Array:
    """h = (hi - lo)/2, (m,). Raises ValueError unless 0 <= lo <= hi."""
    if len(lo) != len(hi) or any(not 0 <= a <= b for a, b in zip(lo, hi, strict=False)):
        raise ValueError(f"delays from {list(lo)} to {list(hi)}, expected 0 <= lo <= hi on every channel")
    return (np.asarray(hi) - np.asarray(lo)) / 2


def nominal(lo: Sequence[int], hi: Sequence[int], T: float) -> Lti:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal."""
    half = Lti.constant(np.eye(len(lo)) / 2, T)
    return half @ (delay(lo, T) + delay(hi, T))


def nominal_over_step(z: Complex, lo: Sequence[int], hi: Sequence[int]) -> Complex:
    """The diagonal of Theta_nom/(z - 1), shape (k, m)."""
    z = np.asarray(z)[:, None]
    return (z ** -np.asarray(lo, dtype=float) + z ** -np.asarray(hi, dtype=float)) / 2 / (z - 1)


def blocks(
    z: Complex, G: Complex, alpha: Array, lo: Sequence[int], hi: Sequence[int], delta: Sequence[float] | Array, T: float
) -> Complex:
    """The condition's matrix at each z (not 1), to be positive: (k, 2m, 2m) from z (k,), G(z) (k, m, m), alpha (m,).

    Affine in (G, alpha) together: for fixed z the upper left block is He(c G) + diag(delta/T - alpha/2) with
    c = diag(`nominal_over_step`), the lower left h G, the lower right 2 diag(alpha).
    """
    m, step = G.shape[-1], nominal_over_step(z, lo, hi)
    error = half_widths(lo, hi)[:, None] * G
    rows = np.zeros((len(z), 2 * m, 2 * m), dtype=np.complex128)
    rows[:, :m, :m] = hermitian(step[:, :, None] * G) + np.diag(np.asarray(delta) / T - alpha / 2)
    rows[:, m:, :m], rows[:, :m, m:] = error, np.conj(np.swapaxes(error, 1, 2))
    rows[:, m:, m:] = np.diag(2 * alpha)
    return rows


# ----------------------------------------------------------------------------------------------------
# The damping that delays switching within [lo, hi] ask: the condition of design.jitter.condition with the best alpha.
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
    constant = closed_loop(nominal(lo, hi, G.T) @ G, delta)
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

    N = W (F(1)/2 - He[(F - F(1))/(z-1)]) W with F = Theta_nom G, Y = h W G W, W = diag(sqrt(T/delta)).
    """

    def __init__(self, G: Lti, lo: Sequence[int], hi: Sequence[int], delta: Array) -> None:
        F = nominal(lo, hi, G.T) @ G
        self._G, self._F1, self._regular = G, F.dc(), F.quotient_at_one()
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
        N = W[:, None] * (self._F1 / 2 - hermitian(self._regular.at(z))) * W
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


# ----------------------------------------------------------------------------------------------------
# Both conditions for many spring-dampers at once: required over available damping, as a map over K and B.
#
# The figures are those of design.margin, without a state-space block per point. K and B are the same on every
# channel, so V = v(z) I and the map needs the environment's response once per frequency:
#
#     closed-loop   F = Theta (I + v X)^-1 X, X = Psi E; the least s with He[F/(z-1)] >= -s Delta_D/T
#     theorem4      per channel D = phi + |y/2 - phi|^2 / (Re W - phi),  y = (1 - z^-(theta+1)) W,  W = T z/((z-1) V):
#                   DESIGN's |y|^2 <= 4 delta (K T/2 + B) for psi = 0 (phi = 0), where Re W = K T/2 + B without filter
#
# (with R = V/T and P = Re[1/W]/|1 - 1/z|^2 the condition of design.condition.delayed is linear in the damping D once
# multiplied by D - phi, since P = |R|^2 Re W and vt = y R; solved for D it is the line above).


LOWEST = 1e-4  # [rad/sample] stands for the limit at 0: the figure is even there, so it is 1e-8 off, as is rounding
POINTS = 192  # even frequencies, as many again evenly in their logarithm; more where delays make lobes
PER_LOBE = 24
OFFSETS = np.concatenate([-np.geomspace(0.05, 20, 10)[::-1], [0.0], np.geomspace(0.05, 20, 10)])


def closed_loop_ratios(
    gains: Gains, environment: Lti | None, theta: Sequence[int], psi: Sequence[int], delta: Sequence[float]
) -> Array:
    """Required over available damping by closed-loop, (n,); inf where F is unstable. No environment is a rigid wall.

    F(1) = (I + E(1)/K)^-1 E(1) is symmetric positive semidefinite for every passive network, so that part of the
    condition holds by itself.
    """
    X = None if environment is None else delay(psi, gains.T) @ environment
    poles = np.linalg.eigvals(force_maps(gains, environment, theta, psi).A).astype(np.complex128)

    def needed(w: Array) -> Array:
        return _needed(gains, X, on_circle(w), theta, delta)

    ratios = np.maximum(suprema(needed, around(poles, common_frequencies(theta, psi))), 0.0)
    return np.where(np.abs(poles).max(axis=1, initial=0.0) < 1, ratios, np.inf)


def theorem4_ratios(
    gains: Gains, theta: Sequence[int], delta: Sequence[float], phi: Sequence[float] | Array | None = None
) -> Array:
    """Required over available damping by theorem4 on the worst channel, (n,); `phi` [N s/m] is needed for psi >= 1."""
    worst = np.zeros(len(gains))
    for n, d, p in set(zip(theta, delta, [0.0] * len(theta) if phi is None else phi, strict=True)):
        worst = np.maximum(worst, _theorem4_dampings(gains, n, p) / d)
    return worst


def _theorem4_dampings(gains: Gains, theta: int, phi: float) -> Array:
    """The damping [N s/m] that one channel needs, (n,)."""

    def needed(w: Array) -> Array:
        z = on_circle(w)
        window = sum((z**-k for k in range(1, theta + 1)), np.ones_like(z))  # vt
        damper = gains.damper(z)
        y = gains.K[:, None] * gains.T * window + damper * (1 - z ** -(theta + 1))
        spare = gains.K[:, None] * gains.T / 2 + damper.real - phi
        return phi + np.abs(y / 2 - phi) ** 2 / np.where(spare > 0, spare, np.nan)

    grid = common_frequencies((theta,), (0,))
    return suprema(needed, np.broadcast_to(grid, (len(gains), grid.size)))


def _needed(gains: Gains, X: Lti | None, z: Complex, theta: Sequence[int], delta: Sequence[float]) -> Array:
    """The largest eigenvalue of -T He[F/(z-1)] relatively to Delta_D, shape of z (n, k)."""
    stiffness = gains.stiffness(z)
    G = stiffness[..., None, None] if X is None else _closed(X.at(z), 1 / stiffness)
    F = z[..., None, None] ** -np.asarray(theta)[:, None] * G / (z - 1)[..., None, None]
    weight = np.sqrt(gains.T / np.asarray(delta))
    return largest_eigenvalue(-(weight[:, None] * weight) * (F + np.conj(np.swapaxes(F, -1, -2))) / 2)


def _closed(X: Complex, v: Complex) -> Complex:
    """(I + v X)^-1 X; for two channels X^2 = tr(X) X - det(X) I turns it into (X + v det(X) I)/det(I + v X)."""
    m = X.shape[-1]
    if m == 1:
        return X / (1 + v[..., None, None] * X)
    if m == 2:
        det = X[..., 0, 0] * X[..., 1, 1] - X[..., 0, 1] * X[..., 1, 0]
        whole = 1 + v * (X[..., 0, 0] + X[..., 1, 1]) + v**2 * det
        return (X + (v * det)[..., None, None] * np.eye(2)) / whole[..., None, None]
    return np.linalg.solve(np.eye(m) + v[..., None, None] * X, X).astype(np.complex128, copy=False)


def largest_eigenvalue(H: Complex) -> Array:
    """Of Hermitian matrices over the last two axes."""
    m = H.shape[-1]
    if m == 1:
        return H[..., 0, 0].real
    if m == 2:
        a, d, b = H[..., 0, 0].real, H[..., 1, 1].real, np.abs(H[..., 0, 1])
        return (a + d) / 2 + np.hypot((a - d) / 2, b)
    return np.linalg.eigvalsh(H)[..., -1]


def common_frequencies(theta: Sequence[int], psi: Sequence[int]) -> Array:
    """Sorted frequencies for every coupling."""
    lobes = max(t + p for t, p in zip(theta, psi, strict=True)) + 1
    even = np.linspace(LOWEST, np.pi, max(POINTS, PER_LOBE * lobes))
    return np.unique(np.concatenate([even, np.geomspace(LOWEST, np.pi, POINTS)]))


def around(poles: Complex, common: Array) -> Array:
    """The common frequencies and, per coupling, those around its poles as in sweep.frequencies: (n, k), sorted."""
    width = np.maximum(1 - np.abs(poles), 1e-9)
    near = (np.abs(np.angle(poles))[..., None] + width[..., None] * OFFSETS).reshape(poles.shape[0], -1)
    everywhere = np.broadcast_to(common, (poles.shape[0], common.size))
    return np.sort(np.clip(np.concatenate([everywhere, near], axis=1), LOWEST, np.pi), axis=1)


# ----------------------------------------------------------------------------------------------------
# The closed-loop condition for one coupling in many environments at once: a map over the springs at the contacts.
#
# The figures are those of design.margin, without a state-space block per frequency. The dynamic stiffness of a
# network is affine in the K and B of its contact springs, Z(s) = M s^2 + (D + B P) s + S + K P, and E is its Schur
# complement over the contacts, at s = (z-1)/(Tz).


STILL = 1e-7  # [rad/sample] stands for F(1), whose real part is even: a network may be 0/0 there
#: [rad/sample] a coupling whose model is wrong may bend the figure as near to 0 as its slow poles lie to 1
SLOWEST = np.geomspace(1e-5, 0.9e-4, 8)
STATIC = 1e-9  # what F(1) may miss of symmetry and of positive semidefiniteness, relatively, as in design.margin

#: z (n, k) and Psi E there (n, k, m, m) -> the forces as they leave for the devices, (n, k, m, m)
Respond = Callable[[Complex, Complex], Complex]


@dataclass(frozen=True, eq=False)
class Environments:
    """n networks that differ in the springs at their contacts."""

    network: Network
    K: Array  # (n,) [N/m] of every contact spring
    B: Array  # (n,) [N s/m]
    T: float  # [s]

    def __len__(self) -> int:
        return self.K.size

    def __getitem__(self, i: int) -> Lti:
        """E of one of them, as a block."""
        K, B = float(self.K[i]), float(self.B[i])
        varied = contact_springs(self.network)
        springs = tuple(
            msgspec.structs.replace(s, stiffness=K, damping=B) if s in varied else s for s in self.network.springs
        )
        return environment(msgspec.structs.replace(self.network, springs=springs), self.T)

    def at(self, z: Complex) -> Complex:
        """E(z), (n, k, m, m) for z of shape (n, k)."""
        M, D, S, P = self._matrices
        m, s = len(self.network.contacts), ((z - 1) / (self.T * z))[..., None, None]
        Z = M * s**2 + D * s + S + (self.K[:, None, None, None] + self.B[:, None, None, None] * s) * P
        cc, ci, ic, ii = Z[..., :m, :m], Z[..., :m, m:], Z[..., m:, :m], Z[..., m:, m:]
        if ii.shape[-1] == 1:
            return cc - ci @ (ic / ii)
        return cc - ci @ np.linalg.solve(ii, ic)

    @cached_property
    def _matrices(self) -> tuple[Array, Array, Array, Array]:
        """M, and D and S without the springs that vary, and the pattern P of these, (nodes, nodes) each."""
        varied = contact_springs(self.network)
        M, D, S = self.network.matrices()
        P = np.zeros_like(M)
        for spring, across in zip(varied, self.network.across(varied), strict=True):
            pattern = np.outer(across, across)
            P, D, S = P + pattern, D - spring.damping * pattern, S - spring.stiffness * pattern
        return M, D, S, P


def contact_springs(network: Network) -> tuple[Spring, ...]:
    """Those that end at a contact."""
    return tuple(s for s in network.springs if set(s.between) & set(network.contacts))


def closed_loop_in_each(
    environments: Environments,
    respond: Respond,
    poles: Complex,
    theta: Sequence[int],
    psi: Sequence[int],
    delta: Sequence[float],
) -> Array:
    """Required over available damping, (n,); inf where no damping is enough. `poles` (n, p) are of the force map."""
    late, out = np.asarray(psi)[:, None], np.asarray(theta)[:, None]
    weight = np.sqrt(environments.T / np.asarray(delta))

    def force(z: Complex) -> Complex:
        delayed = z[..., None, None] ** -late * environments.at(z)
        return z[..., None, None] ** -out * respond(z, delayed)

    def needed(w: Array) -> Array:
        z = on_circle(w)
        F = force(z) / (z - 1)[..., None, None]
        return largest_eigenvalue(-(weight[:, None] * weight) * (F + np.conj(np.swapaxes(F, -1, -2))) / 2)

    low, high = on_circle(np.multiply.outer([STILL, np.pi], np.ones((len(environments), 1))))
    static, edge = force(low)[:, 0].real, force(high)[:, 0].real
    scale = np.maximum(np.abs(static).max(axis=(1, 2)), np.abs(edge).max(axis=(1, 2)))
    skew = np.abs(static - np.swapaxes(static, 1, 2)).max(axis=(1, 2))
    least = np.linalg.eigvalsh((static + np.swapaxes(static, 1, 2)) / 2)[:, 0]
    sound = (np.abs(poles).max(axis=1, initial=0.0) < 1) & (skew <= STATIC * scale) & (least >= -STATIC * scale)
    grid = around(poles, common_frequencies(theta, psi))
    slow = np.broadcast_to(SLOWEST, (len(environments), SLOWEST.size))
    ratios = suprema(needed, np.concatenate([slow, grid], axis=1))
    return np.where(sound, np.maximum(ratios, 0.0), np.inf)


def response(coupling: Coupling, T: float) -> Respond:
    """How a coupling turns Psi E into G = (I + Psi E V)^-1 Psi E; the model of an InternalModel is that Psi E."""
    match coupling:
        case NoCoupling():
            return lambda z, E: E
        case InternalModel(poles=poles, Q=Q):
            return lambda z, E: E - E @ (np.tensordot(basis(poles, z), Q, axes=1) @ E)
        case SpringDamper():
            V = coupling.compliance(T)
        case Compliance(V=V):
            pass
        case _:
            raise ValueError(f"{type(coupling).__name__} has no response that a map knows")
    return lambda z, E: _closed_environment_map(E, V.at(z))


def _closed_environment_map(E: Complex, V: Complex) -> Complex:
    return np.linalg.solve(np.eye(E.shape[-1]) + E @ V, E).astype(np.complex128, copy=False)


C = TypeVar("C", bound=str)  # the name of a condition: design.store.Condition, or that of design.jitter.condition


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


def closed_loop(F: Lti, delta: Sequence[float]) -> Requirement:
    """The closed-loop condition for the force map F and device dampings `delta` [N s/m]."""
    available = dampings(delta, F.inputs)

    def refused(reason: str) -> Requirement:
        return refusal("closed-loop", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    radius = float(np.abs(F.poles()).max(initial=0.0))
    if radius >= 1:
        return refused(f"the force map has a pole at radius {radius:.6f}, on or outside the unit circle")
    F1 = F.dc()
    # rounding in F(1) is relative to what F is elsewhere: a free mass has F(1) = 0 out of large numbers
    scale = max(float(np.abs(F1).max()), float(np.abs(F.D).max()), float(np.abs(F.at(-1.0)).max()), 1e-12)
    if np.abs(F1 - F1.T).max() > 1e-9 * scale:
        return refused("the static stiffness F(1) is not symmetric: a slow closed path could extract energy")
    if np.linalg.eigvalsh((F1 + F1.T) / 2).min() < -1e-9 * scale:
        return refused("the static stiffness F(1) has a negative direction: it pushes outwards")

    grid = np.concatenate([[0.0], frequencies(F)])
    ratio, w = supremum(closed_loop_demand(F, available), grid)
    return from_ratio("closed-loop", max(ratio, 0.0), available, w / (2 * np.pi * F.T))


def theorem4(V: Lti, theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """Theorem 4 for psi = 0 and the coupling V, whatever passive environment stands behind it.

    Divided by |1 - 1/z|^2 it is regular, and s is a generalised eigenvalue per frequency.
    """
    available = dampings(delta, V.inputs)
    if len(theta) != V.inputs:
        raise ValueError(f"theta has {len(theta)} entries for {V.inputs} channels")

    def refused(reason: str) -> Requirement:
        return refusal("theorem4", available, reason)

    if min(available) == 0:
        return refused("a device guarantees no damping, so no coupling is safe for every passive human")
    if not V.is_stable():
        return refused("the coupling V has a pole on or outside the unit circle")
    V1 = V.dc()
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return refused("the static compliance V(1) is not symmetric")
    demand = theorem4_demand(V, theta, available)
    ratio, w = supremum(demand, np.concatenate([[0.0], frequencies(V)]))
    if np.isinf(ratio):
        return refused(f"V is not passive enough at {w / (2 * np.pi * V.T):.4g} Hz: its damping vanishes there")
    return from_ratio("theorem4", ratio, available, w / (2 * np.pi * V.T))


def theorem4_per_channel(V: Sequence[Lti], theta: Sequence[int], delta: Sequence[float]) -> Requirement:
    """Theorem 4 for a diagonal coupling, given its channels: each device's own figure."""
    each = [theorem4(v, [n], [d]) for v, n, d in zip(V, theta, delta, strict=True)]
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
