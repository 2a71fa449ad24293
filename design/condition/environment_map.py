"""The closed-loop condition for one coupling in many environments at once: a map over the springs at the contacts.

The figures are those of design.margin, without a state-space block per frequency. The dynamic stiffness of a network is
affine in the K and B of its contact springs, Z(s) = M s^2 + (D + B P) s + S + K P, and E is its Schur complement over
the contacts, at s = (z-1)/(Tz).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from controller.coupling import Compliance, Coupling, InternalModel, NoCoupling, SpringDamper, basis
from controller.environment import Network, Spring, environment
from controller.gains import Complex
from controller.lti import Array, Lti
from design.frequency.suprema import suprema
from design.frequency.sweep import on_circle
from design.gains.gain_map import around, common_frequencies, largest_eigenvalue

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
    return lambda z, E: _closed(E, V.at(z))


def _closed(E: Complex, V: Complex) -> Complex:
    return np.linalg.solve(np.eye(E.shape[-1]) + E @ V, E).astype(np.complex128, copy=False)
