"""Both conditions for many spring-dampers at once: required over available damping, as a map over K and B.

The figures are those of design.margin, without a state-space block per point. K and B are the same on every channel,
so V = v(z) I and the map needs the environment's response once per frequency:

    closed-loop   F = Theta (I + v X)^-1 X, X = Psi E; the least s with He[F/(z-1)] >= -s Delta_D/T
    theorem4      per channel D = phi + |y/2 - phi|^2 / (Re W - phi),  y = (1 - z^-(theta+1)) W,  W = T z/((z-1) V):
                  DESIGN's |y|^2 <= 4 delta (K T/2 + B) for psi = 0 (phi = 0), where Re W = K T/2 + B without filter

(with R = V/T and P = Re[1/W]/|1 - 1/z|^2 the condition of design.condition.delayed is linear in the damping D once
multiplied by D - phi, since P = |R|^2 Re W and vt = y R; solved for D it is the line above).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from controller.delay import delay
from controller.gains import Complex, Gains, force_maps
from controller.lti import Array, Lti
from design.frequency.suprema import suprema
from design.frequency.sweep import on_circle

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
