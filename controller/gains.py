"""Many spring-damper couplings at once, each the same on every channel: the points of a K-B map.

The damping may act on a filtered velocity: backward Euler of B s / (tau s + 1), which is a damper in series with a
spring of stiffness B / tau, so it stays passive. In terms of z,

    1 / V = K + B (1 - beta)/(1 - beta/z) (1 - 1/z)/T,    beta = tau/(tau + T),    tau = 1/(2 pi cutoff),

and V has one state with or without the filter. beta = 0 is the spring-damper (26).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.coupling import Compliance
from controller.delay import delay
from controller.lti import Array, Lti, frozen

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Gains:
    """n spring-dampers. Raises ValueError naming what is not allowed."""

    K: Array  # (n,) [N/m]
    B: Array  # (n,) [N s/m]
    T: float  # [s]
    cutoff: float | None = None  # [Hz] of the velocity filter; None for none

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), 1, name))
        if self.K.shape != self.B.shape:
            raise ValueError(f"K has {self.K.size} entries and B has {self.B.size}")
        if not ((self.K > 0) & (np.inf > self.K)).all():
            raise ValueError("K has an entry that is not positive and finite")
        if not ((self.B >= 0) & (np.inf > self.B)).all():
            raise ValueError("B has an entry that is negative or not finite")
        if self.cutoff is not None and not 0 < self.cutoff < np.inf:
            raise ValueError(f"cutoff is {self.cutoff}, expected a positive frequency in Hz")

    def __len__(self) -> int:
        return self.K.size

    @property
    def beta(self) -> float:
        """The pole of the velocity filter."""
        return 0.0 if self.cutoff is None else 1 / (1 + 2 * np.pi * self.cutoff * self.T)

    def take(self, which: slice | Sequence[int] | NDArray[np.intp]) -> Gains:
        return Gains(self.K[which], self.B[which], self.T, self.cutoff)

    def damper(self, z: Complex) -> Complex:
        """B (1 - beta)/(1 - beta/z) [N s/m], shape (n, k) for z of shape (n, k) or (1, k)."""
        return self.B[:, None] * ((1 - self.beta) / (1 - self.beta / z))

    def stiffness(self, z: Complex) -> Complex:
        """1/V(z) [N/m], shape (n, k)."""
        return self.K[:, None] + self.damper(z) * (1 - 1 / z) / self.T

    def blocks(self) -> tuple[Array, Array, Array, Array]:
        """a, b, c, d of V(z) = c b/(z - a) + d, each (n,)."""
        step = self.B * (1 - self.beta) / self.T
        d = 1 / (self.K + step)
        a = d * (self.K * self.beta + step)
        return a, d, a - self.beta, d

    def compliance(self, i: int, channels: int) -> Compliance:
        """Coupling i on that many channels, as a block of its own."""
        a, b, c, d = (part[i] * np.eye(channels) for part in self.blocks())
        return Compliance(Lti(a, b, c, d, self.T))


@dataclass(frozen=True, eq=False)
class Stack:
    """n blocks of the same order, as in Lti with a leading axis."""

    A: Array  # (n, s, s)
    B: Array  # (n, s, m)
    C: Array  # (n, m, s)
    D: Array  # (n, m, m)
    T: float

    def __len__(self) -> int:
        return self.A.shape[0]

    def __getitem__(self, i: int) -> Lti:
        return Lti(self.A[i], self.B[i], self.C[i], self.D[i], self.T)


def force_maps(gains: Gains, environment: Lti | None, theta: Sequence[int], psi: Sequence[int]) -> Stack:
    """F = Theta (I + Psi E V)^-1 Psi E (6) for every coupling; without environment a rigid wall, F = Theta / V."""
    stack = _around(gains, delay(psi, gains.T) @ environment) if environment else _stiffnesses(gains)
    return _delayed(stack, delay(theta, gains.T))


def _around(gains: Gains, E: Lti) -> Stack:
    """Lti.feedback of E with every V; with v a multiple of the identity, I + D_E D_V is regular for passive E."""
    n, m, one = len(gains), E.inputs, np.eye(E.inputs)
    a, b, c, d = (part[:, None, None] for part in gains.blocks())
    S = np.linalg.inv(one + d * E.D)
    y_x, y_u = np.concatenate([S @ E.C, -c * (S @ E.D)], axis=2), S @ E.D
    u_x = np.concatenate([np.zeros((n, m, E.order)), -c * one], axis=2) - d * y_x
    open_loop = np.zeros((n, E.order + m, E.order + m))
    open_loop[:, : E.order, : E.order], open_loop[:, E.order :, E.order :] = E.A, a * one
    A = open_loop + np.concatenate([E.B @ u_x, b * y_x], axis=1)
    return Stack(A, np.concatenate([E.B @ (one - d * y_u), b * y_u], axis=1), y_x, y_u, gains.T)


def _stiffnesses(gains: Gains) -> Stack:
    """1/V of one channel."""
    a, b, c, d = (part[:, None, None] for part in gains.blocks())
    return Stack(a - b * c / d, b / d, -c / d, 1 / d, gains.T)


def _delayed(G: Stack, chain: Lti) -> Stack:
    """The series of every block with the delays behind it."""
    n, states, order = len(G), G.A.shape[1], chain.order
    A = np.zeros((n, states + order, states + order))
    A[:, :states, :states], A[:, states:, :states], A[:, states:, states:] = G.A, chain.B @ G.C, chain.A
    C = np.concatenate([chain.D @ G.C, np.broadcast_to(chain.C, (n, *chain.C.shape))], axis=2)
    return Stack(A, np.concatenate([G.B, chain.B @ G.D], axis=1), C, chain.D @ G.D, G.T)
