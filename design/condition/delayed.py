"""Theorem 4 with delay inside the environment (psi >= 1), for a given multiplier Phi.

Delay makes the environment lose passivity. Phi covers the loss: E-hat + Phi is passive; devices and coupling pay
for it, V-hat must be Delta_V-OSP with Delta_V = (Phi^-1 - Delta_D^-1)^-1, by (14).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from controller.delay import delay
from controller.lti import Array, Lti
from design.frequency.sweep import Response, frequencies, hermitian, on_circle, supremum
from design.margin import Requirement, dampings, from_ratio, refusal
from design.specification import regular_part

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
