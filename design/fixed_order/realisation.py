"""State-space couplings of fixed order, in a realisation where both conditions are affine.

V = V1 + (F - F z)(zI - A)^-1 B: the output is V1 u + F x - F x+. Its static compliance is V1, and the quotient that
the remedied (2) needs is y2 = F x + V1/2 u (design.lmi.v_hat_regular). With F held fixed, V, y2 and the loop (22) are
all affine in (A, B, V1). That loses nothing where F has full row rank: any such F is reached by a change of state.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from controller.coupling import SpringDamper
from controller.lti import Array, Lti
from design.lmi import Ports, theta_hat
from design.shaping import Shaping
from design.specification import Specification

#: Poles given to states beyond the first of a channel, which a spring-damper does not have.
SPARE_POLE = 0.5


class FixedOrder:
    """The couplings with `order` states per channel; unknowns are the free entries p of A, B and V1.

    Everything is in units T = 1 and usable damping = I. `sigma` (N,) is Delta_V^-1 there, inf where psi = 0.
    """

    def __init__(self, spec: Specification, sigma: Array, order: int = 1, diagonal: bool = True) -> None:
        if order < 1:
            raise ValueError(f"order is {order}, expected one state per channel or more")
        self.spec, self.sigma, self.order, self.diagonal = spec, sigma, order, diagonal
        N = spec.channels
        self.states = N * order
        one, row = np.eye(N), np.eye(order)[:1]
        self.F = np.kron(one, row)  # reads the first state of every channel
        masks = [np.kron(one, np.ones((order, order))), np.kron(one, np.ones((order, 1))), one]
        masks = masks if diagonal else [np.ones_like(mask) for mask in masks]
        self._free = [np.nonzero(mask) for mask in (*masks[:2], np.triu(masks[2]))]
        self.plant = _plant(spec)
        self.window = theta_hat(spec.theta)

    @property
    def unknowns(self) -> int:
        return sum(rows.size for rows, _ in self._free)

    def matrices(self, p: Array) -> tuple[Array, Array, Array]:
        """A, B and V1 from their free entries."""
        N = self.spec.channels
        found = [np.zeros(shape) for shape in ((self.states, self.states), (self.states, N), (N, N))]
        ends = np.cumsum([rows.size for rows, _ in self._free])[:-1]
        for matrix, free, values in zip(found, self._free, np.split(p, ends), strict=True):
            matrix[free] = values
        A, B, V1 = found
        return A, B, V1 + np.triu(V1, 1).T

    def unit_coupling(self, p: Array) -> Lti:
        """V in the units of this class."""
        A, B, V1 = self.matrices(p)
        return Lti(A, B, self.F - self.F @ A, V1 - self.F @ B, 1.0)

    def coupling(self, p: Array) -> Lti:
        """V in SI units [m/N]."""
        V, root, T = self.unit_coupling(p), 1 / np.sqrt(self.spec.usable), self.spec.T
        return Lti(V.A, V.B * root, T * root[:, None] * V.C, T * root[:, None] * V.D * root, T)

    def start(self, gains: SpringDamper) -> Array:
        """p of a spring-damper; further states are driven by nothing yet, but are seen."""
        usable = self.spec.usable
        k, b = gains.K * self.spec.T / usable, gains.B / usable
        pole = b / (k + b)
        A = np.kron(np.diag(pole), np.diag(np.eye(self.order)[0]))
        spare = np.diag(np.r_[0.0, SPARE_POLE ** np.arange(1, self.order)]) + np.eye(self.order, k=1)
        A = A + np.kron(np.eye(pole.size), spare)
        # 1/(k + b - b/z) = 1/k - (z - 1) (pole/k) / (z - pole)
        B = np.kron(np.diag(pole / k), np.eye(self.order)[:, :1])
        parts = (A, B, np.diag(1 / k))
        return np.concatenate([M[free] for M, free in zip(parts, self._free, strict=True)])

    def ports(self, p: Array) -> Ports:
        """The remedied V-hat: supply y2'u - y1'y1, y1 = Sigma^-1/2 H u, with no y1 rows where Sigma is infinite."""
        A, B, V1 = self.matrices(p)
        V, G = self.unit_coupling(p), self.window
        quotient = -G.quotient_at_one().C
        paid = np.isfinite(self.sigma)
        weight = 1 / np.sqrt(self.sigma[paid])[:, None]
        C1, D1 = np.hstack([V.C, -G.C])[paid] * weight, (V.D - G.D)[paid] * weight
        C2, D2 = np.hstack([self.F, -quotient]), (V1 - G.dc()) / 2
        return Ports(block_diag(A, G.A), np.vstack([B, G.B]), C2, D2, C1, D1)

    def loop(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of W1 L W2: the plant with V closed between its output u and its input v."""
        V, (G, r) = self.unit_coupling(p), (self.plant, self.spec.channels)
        Br, Bv = G.B[:, :r], G.B[:, r:]
        y = G.outputs - V.inputs
        Cy, Cu = G.C[:y], G.C[y:]
        Dyr, Dyv, Dur = G.D[:y, :r], G.D[:y, r:], G.D[y:, :r]
        A = np.block([[G.A + Bv @ V.D @ Cu, Bv @ V.C], [V.B @ Cu, V.A]])
        B = np.vstack([Br + Bv @ V.D @ Dur, V.B @ Dur])
        return A, B, np.hstack([Cy + Dyv @ V.D @ Cu, Dyv @ V.C]), Dyr + Dyv @ V.D @ Dur


def _plant(spec: Specification) -> Lti:
    """[y; u] from [r; v]: y = W1 ((I - Psi Lambda^-1 Theta) W2 r + Psi E v), u = W2 r, with v and u in unit scale."""
    N, T, shaping = spec.channels, spec.T, Shaping(spec)
    root, one, zero = 1 / np.sqrt(spec.usable), np.eye(N), np.zeros((N, N))

    def constant(D: Array) -> Lti:
        return Lti.constant(D, T)

    weighted = Lti.diag(shaping.W2, constant(one))  # [W2 r; v]
    copy = constant(np.block([[one, zero], [zero, one], [one, zero]]))
    blocks = Lti.diag(shaping.late, shaping.environment @ constant(np.diag(T * root)), constant(np.diag(root)))
    add = constant(np.block([[one, one, zero], [zero, zero, one]]))
    return Lti.diag(shaping.W1, constant(one)) @ add @ blocks @ copy @ weighted
