"""Design state-space couplings of a given order that satisfy Theorem 4 (`--coupling ccl`, Remark 5 of the paper).

A descent reduces ||L W2||_inf (23). It starts at a spring-damper design. Each step solves a convex problem whose
solutions all satisfy Theorem 4, and a refined sweep then checks Theorem 4 for the new coupling. The cone
complementarity algorithm of Remark 5 is not used, because its bisection on mu stalls near its start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

import msgspec
import numpy as np

from haptic_loop.controller.arguments import whole
from haptic_loop.controller.coupling import Compliance, SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design import budgets, lmi, spring_damper
from haptic_loop.design.conditions import any_environment_demand
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.environments import ANY_ENVIRONMENT, least_phi
from haptic_loop.design.result import Design, DesignFailed, Requirement

_MOST_STATES = 10  # largest order per channel; each state adds a row and a column to every cone
_SPARE_POLE = 0.5  # At the start the second and later states of a channel have powers of this number as poles.


class _Units:
    """A loop in units T = 1 and usable damping (lmi.usable) = I, where matrix inequalities are well scaled."""

    def __init__(self, shaping: lmi.Shaping, phi: Array | None) -> None:
        loop, self.usable, self.T = shaping.loop, shaping.usable, shaping.loop.T
        names, none = loop.environment.contacts, (0,) * loop.channels
        # Theorem 4 does not depend on the environment, so this one is arbitrary.
        anything = Network(names, tuple(Spring((name, GROUND), 1.0) for name in names))
        self.loop = Loop(1.0, loop.theta, none, none, (1.0,) * loop.channels, anything)
        self.phi = None if phi is None else phi / self.usable

    def si(self, V: Lti) -> Lti:
        """Return V in SI units [m/N]."""
        root = 1 / np.sqrt(self.usable)
        return Lti(V.A, V.B * root, self.T * root[:, None] * V.C, self.T * root[:, None] * V.D * root, self.T)

    def block(self, V: Lti) -> Lti:
        """Return the block of Theorem 4, which is affine in V. Its rows for phi are scaled to a unit diagonal."""
        demand = any_environment_demand(V, self.loop, self.phi)
        block, one = demand.gain + demand.free, np.ones(V.inputs)
        scale = np.diag(np.append(one, 1 / np.sqrt(np.diag(block.D)[V.inputs :])))
        return scale @ block @ scale


# ----------------------------------------------------------------------------------------------------
# State-space couplings of fixed order, in a realisation whose unknowns enter Theorem 4 and L (22) affinely.
#
# V = V1 + (F - F z)(zI - A)^-1 B (`Lti.with_rest`) has the static compliance V1, and Theorem 4 uses the quotient
# (V - V1)/(z - 1) = -F (zI - A)^-1 B. Here F is a matrix, not the map (6). If F is fixed, the state matrices of V, of
# this quotient and of L are affine in (A, B, V1). Any F of full row rank gives the same set of V, because a change of
# state maps one such F to another.


class _FixedOrder:
    """The couplings with `order` states per channel. The vector p of unknowns holds the free entries of A, B and V1.

    V has no entries between different channels. phi (m,) [N s/m] is the multiplier for psi >= 1, or None for psi = 0.
    """

    def __init__(self, shaping: lmi.Shaping, phi: Array | None = None, order: int = 1) -> None:
        self.shaping, self.order, self.units = shaping, order, _Units(shaping, phi)
        one, row = np.eye(shaping.loop.channels), np.eye(order)[:1]
        self.F = np.kron(one, row)  # F reads the first state of every channel.
        masks = [np.kron(one, np.ones((order, order))), np.kron(one, np.ones((order, 1))), one]
        self._shapes = [mask.shape for mask in masks]
        self._free = [np.nonzero(mask) for mask in masks]

    @property
    def unknowns(self) -> int:
        return sum(rows.size for rows, _ in self._free)

    def unit_coupling(self, p: Array) -> Lti:
        """Return V in units T = 1 and usable damping = I."""
        parts = [np.zeros(shape) for shape in self._shapes]
        ends = np.cumsum([rows.size for rows, _ in self._free])[:-1]
        for matrix, free, values in zip(parts, self._free, np.split(p, ends), strict=True):
            matrix[free] = values
        A, B, V1 = parts
        return Lti.with_rest(A, B, self.F, V1, 1.0)

    def coupling(self, p: Array) -> Lti:
        return self.units.si(self.unit_coupling(p))

    def start(self, gains: SpringDamper) -> Array:
        """Return p of a spring-damper. Each further state has the state before it as input, and affects no output.

        All states are then reachable if there are dampers. A state without input would make the storage of L W2
        singular.
        """
        k, b = gains.K * self.units.T / self.units.usable, gains.B / self.units.usable
        pole = b / (k + b)
        A = np.kron(np.diag(pole), np.diag(np.eye(self.order)[0]))
        spare = np.diag(np.r_[0.0, _SPARE_POLE ** np.arange(1, self.order)]) + np.eye(self.order, k=-1)
        A = A + np.kron(np.eye(pole.size), spare)
        # 1/(k + b - b/z) = 1/k - (z - 1) (pole/k) / (z - pole)
        B = np.kron(np.diag(pole / k), np.eye(self.order)[:, :1])
        parts = (A, B, np.diag(1 / k))
        return np.concatenate([M[free] for M, free in zip(parts, self._free, strict=True)])

    def block(self, p: Array) -> Lti:
        """Return the block of Theorem 4, affine in p."""
        return self.units.block(self.unit_coupling(p))

    def weighted_loop(self, p: Array) -> Lti:
        """Return L W2, affine in p."""
        shaping = self.shaping
        return (shaping.late + shaping.environment @ self.coupling(p)) @ shaping.W2


# ----------------------------------------------------------------------------------------------------
# Storage matrices of the first coupling, with which it satisfies the inequalities of the first step.


def _passivity_storage(family: _FixedOrder, p: Array) -> Array:
    """Return the P > 0 of (2) with the largest margin for the coupling p, which must be strictly feasible."""
    G = family.block(p)
    zero = np.zeros_like(G.D)
    return _roomiest(lambda P: lmi.lemma1(lmi.Ports.same(G), P, zero, zero), G.order, "the storage of V-hat")


def _gain_storage(family: _FixedOrder, p: Array, mu: float) -> Array:
    """Return the U = X^-1 > 0 of Lemma 3 that proves ||L W2||_inf < mu with the largest margin."""
    G = family.weighted_loop(p) * (1 / mu)
    S = lmi.reachability_scaled(G)
    n, m = S.shape[0], G.inputs
    bounded = lmi.Ports(np.linalg.solve(S, G.A @ S), np.linalg.solve(S, G.B), np.zeros((m, n)), np.eye(m), G.C @ S, G.D)
    one, zero = np.eye(G.outputs), np.zeros((m, m))
    X = _roomiest(lambda X: lmi.lemma1(bounded, X, one, zero), n, "the storage of L")
    return S @ np.linalg.inv(X) @ S.T


def _roomiest(inequality: Callable[[Array], Array], n: int, what: str) -> Array:
    """Return the symmetric P (n, n) with the largest s <= 1 such that inequality(P) >= s I and P >= s I.

    `what` names the problem in error messages.
    """
    every = range(lmi.packed(n) + 1)  # indices of the unknowns: the entries of P, then s

    def roomy(of: Callable[[Array], Array]) -> Inequality:
        def room(x: Array) -> Array:
            matrix = of(lmi.symmetric_from(x[:-1], n))
            return matrix - x[-1] * np.eye(len(matrix))

        return Inequality.of(room, every)

    cost = -np.eye(len(every))[-1]
    blocks = [roomy(inequality), roomy(lambda P: P), Inequality.most(every[-1:], 1.0)]
    return lmi.symmetric_from(ConeProgram(cost, blocks).solve(what)[:-1], n)


_System = tuple[Array, Array, Array, Array]  # A, B, C, D


def _affine(system: Callable[[Array], Lti], at: Array, L: Array) -> Callable[[Array], _System]:
    """Return the function that maps p - at to A, B, C, D of a system that is affine in p, with the states L^-1 x."""
    n = L.shape[0]

    def stacked(p: Array) -> Array:
        G = system(at + p)
        return np.block([[np.linalg.solve(L, G.A @ L), np.linalg.solve(L, G.B)], [G.C @ L, G.D]])

    constant, *values = (stacked(p) for p in np.eye(at.size + 1, at.size, k=-1))
    slopes = np.stack(values) - constant

    def matrices(p: Array) -> _System:
        M = constant + np.tensordot(p, slopes, axes=1)
        return M[:n, :n], M[:n, n:], M[n:, :n], M[n:, n:]

    return matrices


# ----------------------------------------------------------------------------------------------------
# Fixed-order couplings by inner convex approximation: descent on ||L W2||_inf in which every step is feasible.
#
# Lemmas 2 and 3 are affine in the coupling except for the inverses Y = Q^-1 and X = U^-1 (20), (24b). The inverse of a
# positive matrix is convex: Q^-1 >= 2 Q0^-1 - Q0^-1 Q Q0^-1, with equality at Q0. If this tangent replaces Y, and the
# tangent at U0 replaces X, the feasible set becomes a convex subset that still contains the present coupling. So each
# semidefinite program (SDP) reduces the norm. It needs no bisection, because mu^2 enters linearly. In state coordinates
# with Q0 = I the tangent is 2I - Q.


_SETTLED = 1e-4  # The descent ends after a step that reduces the norm by less than this share.
_FIRST_ROOM = 0.05  # The first storage U proves a bound that exceeds the norm of the first coupling by this share.
_LEAST, _MOST = 0.1, 1.99  # bounds of the eigenvalues of Q and U in a step; 2I - Q and 2I - U stay positive


def _descend(family: _FixedOrder, p: Array, norm: float) -> Iterator[Array]:
    """Yield the unknowns of successive couplings, from the strictly feasible p of a coupling with the norm `norm`.

    The descent ends when Q or U is singular, or when the solver fails because a step is as small as its rounding.
    """
    try:
        Q = np.linalg.inv(_passivity_storage(family, p))
        U = _gain_storage(family, p, norm * (1 + _FIRST_ROOM))
        while min(np.linalg.eigvalsh(Q)[0], np.linalg.eigvalsh(U)[0]) > 0:
            p, Q, U = _step(family, p, Q, U, norm)
            yield p
    except DesignFailed:
        return


def _step(family: _FixedOrder, at: Array, Q: Array, U: Array, norm: float) -> tuple[Array, Array, Array]:
    """Return p, Q and U with the least mu, by one SDP with Lemmas 2 and 3 near the coupling with the unknowns `at`.

    The SDP's unknowns are p - at, Q, U and mu^2/norm^2, in coordinates with Q = U = I at this coupling.
    """
    LQ, LU = np.linalg.cholesky(Q), np.linalg.cholesky(U)
    block = _affine(family.block, at, LQ)
    loop = _affine(lambda p: family.weighted_loop(p) * (1 / norm), at, LU)
    nq, nu = len(Q), len(U)
    ends = np.cumsum([at.size, lmi.packed(nq), lmi.packed(nu)])
    every = range(ends[-1] + 1)

    def parts(v: Array) -> tuple[Array, Array, Array, float]:
        p, q, u, mu2 = np.split(v, ends)
        return p, lmi.symmetric_from(q, nq), lmi.symmetric_from(u, nu), mu2[0]

    def passivity(v: Array) -> Array:
        p, Q, _, _ = parts(v)
        A, B, C, D = block(p)
        return lmi.lemma2(lmi.Ports(A, B, C, D, C, D), Q, 2 * np.eye(nq) - Q, None, np.zeros_like(D))

    def gain(v: Array) -> Array:
        p, _, U, mu2 = parts(v)
        return lmi.lemma3(*loop(p), 2 * np.eye(nu) - U, U, mu2)

    def bound(sign: int, value: float, first: int, n: int) -> Inequality:
        """Return sign (M - value I) >= 0 for the symmetric matrix M (n, n) whose first unknown is `first`."""
        own = range(first, first + lmi.packed(n))
        return Inequality.of(lambda v: sign * (lmi.symmetric_from(v, n) - value * np.eye(n)), own)

    states = [(ends[0], nq), (ends[1], nu)]
    bounds = [bound(sign, value, *each) for sign, value in ((1, _LEAST), (-1, _MOST)) for each in states]
    blocks = [Inequality.of(passivity, every), Inequality.of(gain, every), *bounds]
    problem = ConeProgram(np.append(np.zeros(ends[-1]), 1.0), blocks)
    p, Q, U, _ = parts(problem.solve("a step of the inner convex approximation"))
    return at + p, LQ @ Q @ LQ.T, LU @ U @ LU.T


_START_ROOM = 1e-3  # unused share of the damping of the first coupling, so that it is strictly feasible


def design(loop: Loop, order: int = 1, most_sdps: int = budgets.FIXED_ORDER_PROBLEMS) -> Design:
    """Design a coupling with `order` states per channel.

    The search starts at a spring-damper and solves at most `most_sdps` convex problems. Raises
    Infeasible if Theorem 4 admits no coupling, and DesignFailed if no coupling is certified.
    """
    whole("order", order, 1, _MOST_STATES)
    shaping, phi = lmi.Shaping(loop), least_phi(loop)
    reserved = msgspec.structs.replace(loop, delta=tuple((1 - _START_ROOM) * d for d in loop.delta))
    first = spring_damper.design(reserved)
    gains = first.coupling
    assert isinstance(gains, SpringDamper)

    def judged(V: Lti) -> Requirement:
        return ANY_ENVIRONMENT.required(loop, Compliance(V), phi)

    family = _FixedOrder(shaping, phi, order)
    start, sdps = family.start(gains), first.sdps
    V = family.coupling(start)
    norm = shaping.norm(V)[0]
    for trial in islice(_descend(family, start, norm), most_sdps):
        better = family.coupling(trial)
        before, reached = norm, shaping.norm(better)[0]
        if not (better.is_stable() and judged(better).certified and reached <= norm):
            break
        V, norm, sdps = better, reached, sdps + 1
        if before - norm < _SETTLED * norm:
            break
    requirement = judged(V)
    if not requirement.certified:
        raise DesignFailed(None, (), "the descent gave no coupling that Theorem 4 certifies")
    return Design(Compliance(V), "any-environment", "loop-norm", norm, requirement, sdps, phi=phi)
