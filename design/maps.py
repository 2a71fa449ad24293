"""Conditions over many couplings or environments at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import Network, Spring, environment
from controller.gains import Gains, force_maps
from controller.lti import Array, Complex, Lti, Sampled
from design.conditions import half_widths
from design.frequency import hermitian, on_circle, suprema

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
    """How a coupling turns Psi E into G; a model of the environment that it holds is that Psi E."""
    return lambda z, E: coupling.around(Sampled(z, E, T)).G


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
