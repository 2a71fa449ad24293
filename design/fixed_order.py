"""State-space couplings of fixed order under Theorem 4: the procedure of Remark 5, its replacement and its reference.

    complementarity   the cone-complementarity iteration as printed, with bisection on mu
    inner             inner convex approximation: feasible descent, no bisection (the default)
    fixed-poles       one state per channel, diagonal; global for given poles, the poles by a simplex search

All start from the structured spring-damper design and minimise ||W1 L W2||_inf (23). What is returned satisfies
Theorem 4 on a refined sweep, judged from the coupling alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import msgspec
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize

from controller.coupling import Compliance, SpringDamper
from controller.loop import Loop
from controller.lti import Array, Lti
from design import lmi, spring_damper
from design.arguments import of_kind, one_of, whole
from design.cone import ConeProgram, Inequality
from design.frequency import on_circle
from design.result import Design, DesignFailed, Requirement

# ----------------------------------------------------------------------------------------------------
# State-space couplings of fixed order, in a realisation where both conditions are affine.
#
# V = V1 + (F - F z)(zI - A)^-1 B: the output is V1 u + F x - F x+. Its static compliance is V1, and what
# the remedied (2) needs, v_hat(V), is F x + V1/2 u (design.conditions). With F held fixed, V, y2 and the loop (22)
# are all affine in (A, B, V1). That loses nothing where F has full row rank: any such F is reached by a change of
# state.


#: How such a coupling may be sought.
_METHODS = ("complementarity", "inner", "fixed-poles")

#: Poles given to states beyond the first of a channel, which a spring-damper does not have.
_MOST_STATES = 10  # per channel: each adds a row and a column to every cone
_SPARE_POLE = 0.5


class FixedOrder:
    """The couplings with `order` states per channel; unknowns are the free entries p of A, B and V1.

    Everything is in units T = 1 and usable damping = I. `sigma` (N,) is Delta_V^-1 there, inf where psi = 0.
    """

    def __init__(self, shaping: lmi.Shaping, sigma: Array, order: int = 1, diagonal: bool = True) -> None:
        if order < 1:
            raise ValueError(f"order is {order}, expected one state per channel or more")
        self.loop, self.usable, self.sigma, self.order = shaping.loop, shaping.usable, sigma, order
        N = self.loop.channels
        self.states = N * order
        one, row = np.eye(N), np.eye(order)[:1]
        self.F = np.kron(one, row)  # reads the first state of every channel
        masks = [np.kron(one, np.ones((order, order))), np.kron(one, np.ones((order, 1))), one]
        masks = masks if diagonal else [np.ones_like(mask) for mask in masks]
        self._free = [np.nonzero(mask) for mask in (*masks[:2], np.triu(masks[2]))]
        self.plant = _plant(shaping)

    @property
    def unknowns(self) -> int:
        return sum(rows.size for rows, _ in self._free)

    def matrices(self, p: Array) -> tuple[Array, Array, Array]:
        """A, B and V1 from their free entries."""
        N = self.loop.channels
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
        V, root, T = self.unit_coupling(p), 1 / np.sqrt(self.usable), self.loop.T
        return Lti(V.A, V.B * root, T * root[:, None] * V.C, T * root[:, None] * V.D * root, T)

    def start(self, gains: SpringDamper) -> Array:
        """p of a spring-damper; further states are driven by nothing yet, but are seen."""
        k, b = gains.K * self.loop.T / self.usable, gains.B / self.usable
        pole = b / (k + b)
        A = np.kron(np.diag(pole), np.diag(np.eye(self.order)[0]))
        spare = np.diag(np.r_[0.0, _SPARE_POLE ** np.arange(1, self.order)]) + np.eye(self.order, k=1)
        A = A + np.kron(np.eye(pole.size), spare)
        # 1/(k + b - b/z) = 1/k - (z - 1) (pole/k) / (z - pole)
        B = np.kron(np.diag(pole / k), np.eye(self.order)[:, :1])
        parts = (A, B, np.diag(1 / k))
        return np.concatenate([M[free] for M, free in zip(parts, self._free, strict=True)])

    def ports(self, p: Array) -> lmi.Ports:
        """The remedied V-hat: supply y2'u - y1'y1, y1 = Sigma^-1/2 H u, with no y1 rows where Sigma is infinite."""
        A, B, V1 = self.matrices(p)
        G = lmi.v_hat_ports(self.unit_coupling(p), self.loop.theta, Lti(A, B, self.F, V1 / 2, 1.0))
        paid = np.isfinite(self.sigma)
        weight = 1 / np.sqrt(self.sigma[paid])[:, None]
        return G._replace(C1=G.C1[paid] * weight, D1=G.D1[paid] * weight)

    def weighted_loop(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of W1 L W2: the plant with V closed between its output u and its input v."""
        V, (G, r) = self.unit_coupling(p), (self.plant, self.loop.channels)
        Br, Bv = G.B[:, :r], G.B[:, r:]
        y = G.outputs - V.inputs
        Cy, Cu = G.C[:y], G.C[y:]
        Dyr, Dyv, Dur = G.D[:y, :r], G.D[:y, r:], G.D[y:, :r]
        A = np.block([[G.A + Bv @ V.D @ Cu, Bv @ V.C], [V.B @ Cu, V.A]])
        B = np.vstack([Br + Bv @ V.D @ Dur, V.B @ Dur])
        return A, B, np.hstack([Cy + Dyv @ V.D @ Cu, Dyv @ V.C]), Dyr + Dyv @ V.D @ Dur


def _plant(shaping: lmi.Shaping) -> Lti:
    """[y; u] from [r; v]: y = W1 ((I - Psi Lambda^-1 Theta) W2 r + Psi E v), u = W2 r, with v and u in unit scale."""
    N, T = shaping.loop.channels, shaping.loop.T
    root, one, zero = 1 / np.sqrt(shaping.usable), np.eye(N), np.zeros((N, N))

    def constant(D: Array) -> Lti:
        return Lti.constant(D, T)

    weighted = Lti.diag(shaping.W2, constant(one))  # [W2 r; v]
    copy = constant(np.block([[one, zero], [zero, one], [one, zero]]))
    blocks = Lti.diag(shaping.late, shaping.environment @ constant(np.diag(T * root)), constant(np.diag(root)))
    add = constant(np.block([[one, one, zero], [zero, zero, one]]))
    return Lti.diag(shaping.W1, constant(one)) @ add @ blocks @ copy @ weighted


# ----------------------------------------------------------------------------------------------------
# Storage matrices of a given coupling: what makes the inequalities of a fixed-order design hold at a start.


def _passivity_storage(family: FixedOrder, p: Array) -> Array:
    """P > 0 of the remedied (2) for the coupling p, with the most room; the coupling must satisfy it strictly."""
    G = family.ports(p)
    m, paid = G.D2.shape[0], G.D1.shape[0]
    return _roomiest(lambda P: lmi.lemma1(G, P, np.eye(paid), np.zeros((m, m))), G.A.shape[0], "the storage of V-hat")


def _gain_storage(family: FixedOrder, p: Array, mu: float) -> Array:
    """U = X^-1 > 0 of Lemma 3, ||W1 L W2||_inf < mu, with the most room in coordinates of unit reachability."""
    A, B, C, D = family.weighted_loop(p)
    S = lmi.reachability_scaled(Lti(A, B, C, D, 1.0))
    A, B, C, D = np.linalg.solve(S, A @ S), np.linalg.solve(S, B), C @ S / mu, D / mu
    m = B.shape[1]
    bounded = lmi.Ports(A, B, np.zeros((m, A.shape[0])), np.eye(m), C, D)
    zero = np.zeros((m, m))
    X = _roomiest(lambda X: lmi.lemma1(bounded, X, np.eye(C.shape[0]), zero), A.shape[0], "the storage of L")
    return S @ np.linalg.inv(X) @ S.T


def _roomiest(inequality: Callable[[Array], Array], n: int, what: str) -> Array:
    """The P that maximises s <= 1 with inequality(P) >= s I and P >= s I."""
    size = inequality(np.zeros((n, n))).shape[0]
    every = range(lmi.packed(n) + 1)  # P and s

    def storage(x: Array) -> Array:
        return lmi.symmetric_from(x[:-1], n)

    def most(x: Array) -> Array:
        return 1 - x[-1:, None]

    def roomy(x: Array) -> Array:
        return inequality(storage(x)) - x[-1] * np.eye(size)

    def positive(x: Array) -> Array:
        return storage(x) - x[-1] * np.eye(n)

    cost = np.append(np.zeros(lmi.packed(n)), -1.0)
    return storage(
        ConeProgram(cost, [Inequality.of(function, every) for function in (roomy, positive, most)]).solve(what)
    )


# ----------------------------------------------------------------------------------------------------
# Fixed-order couplings by inner convex approximation: descent on ||W1 L W2||_inf in which every step is feasible.
#
# Lemmas 2 and 3 are affine in the coupling except for the inversions Y = Q^-1, X = U^-1 (20), (24b). The inverse of a
# positive matrix is convex: Q^-1 >= 2 Q0^-1 - Q0^-1 Q Q0^-1, with equality at Q0. With that tangent for Y the set
# shrinks to a convex part of itself that still holds the current coupling, so each SDP improves on the last, mu^2
# enters linearly, and there is no bisection. In state coordinates where Q0 = I the tangent is 2I - Q.


#: Room above the start's norm for its first certificate, relatively.
_FIRST_ROOM = 0.05
#: Bounds on Q and U in coordinates where they were I: a state that little reaches leaves them free to degenerate.
_LEAST, _MOST = 0.1, 1.99


def descend(family: FixedOrder, p: Array, norm: float) -> Iterator[Array]:
    """The couplings p of successive steps from one that is strictly feasible and has the given norm.

    Ends where a certificate is singular to rounding: the coupling then stands on the boundary.
    """
    Q = np.linalg.inv(_passivity_storage(family, p))
    U = _gain_storage(family, p, norm * (1 + _FIRST_ROOM))
    while min(np.linalg.eigvalsh(Q)[0], np.linalg.eigvalsh(U)[0]) > 0:
        p, Q, U = _step(family, p, Q, U, norm)
        yield p


def _step(family: FixedOrder, at: Array, Q0: Array, U0: Array, norm: float) -> tuple[Array, Array, Array]:
    """One SDP in x = (p - at, Q, U, mu^2/norm^2), Q and U in coordinates where Q0 = U0 = I."""
    LQ, LU = np.linalg.cholesky(Q0), np.linalg.cholesky(U0)
    nq, nu = Q0.shape[0], U0.shape[0]
    ends = np.cumsum([family.unknowns, lmi.packed(nq), lmi.packed(nu)])
    every = range(ends[-1] + 1)

    def split(v: Array) -> tuple[Array, Array, Array, float]:
        p, q, u, t = np.split(v, ends)
        return at + p, lmi.symmetric_from(q, nq), lmi.symmetric_from(u, nu), t[0]

    def passivity(v: Array) -> Array:
        p, Q, _, _ = split(v)
        G = _in_coordinates(family.ports(p), LQ)
        sigma = np.eye(G.C1.shape[0]) if G.C1.size else None
        return lmi.lemma2(G, Q, 2 * np.eye(nq) - Q, sigma, np.zeros_like(G.D2))

    def gain(v: Array) -> Array:
        p, _, U, t = split(v)
        A, B, C, D = family.weighted_loop(p)
        A, B, C = np.linalg.solve(LU, A @ LU), np.linalg.solve(LU, B), C @ LU / norm
        return lmi.lemma3(A, B, C, D / norm, 2 * np.eye(nu) - U, U, t)

    storages: list[Callable[[Array], Array]] = [
        lambda v: split(v)[1] - _LEAST * np.eye(nq),
        lambda v: split(v)[2] - _LEAST * np.eye(nu),
        lambda v: _MOST * np.eye(nq) - split(v)[1],
        lambda v: _MOST * np.eye(nu) - split(v)[2],
    ]
    blocks = [Inequality.of(function, every) for function in (passivity, gain, *storages)]
    problem = ConeProgram(np.append(np.zeros(ends[-1]), 1.0), blocks)
    p, Q, U, _ = split(problem.solve("a step of the inner convex approximation"))
    return p, LQ @ Q @ LQ.T, LU @ U @ LU.T


def _in_coordinates(G: lmi.Ports, L: Array) -> lmi.Ports:
    """G with the states L^-1 x."""
    return lmi.Ports(np.linalg.solve(L, G.A @ L), np.linalg.solve(L, G.B), G.C2 @ L, G.D2, G.C1 @ L, G.D1)


# ----------------------------------------------------------------------------------------------------
# Fixed-order couplings by cone complementarity, as Remark 5 of the paper prints it (with the remedied inequalities).
#
# For a given mu the inversions Y = Q^-1 and X = U^-1 are relaxed to [[Y, I], [I, Q]] >= 0 and [[X, I], [I, U]] >= 0,
# and tr(QY) + tr(UX), which reaches its least value only where they hold, is linearised and minimised again and
# again; mu is found by bisection. The sequence stalls far from the optimum, which is why `inner_convex` exists.


#: Linearised problems per value of mu, and the relative width at which bisection ends.
_PATIENCE = 20
_WIDTH = 5e-3


def _bisect(
    family: FixedOrder, p: Array, norm: float, holds: Callable[[Array, float], bool], budget: int
) -> tuple[Array, int]:
    """(the best coupling, SDPs spent). `holds(p, mu)` judges a coupling from itself alone; p holds for its norm."""
    relaxed = _Relaxed(family, p, norm)
    low, high, best, sdps = 0.5 * norm, norm, p, 0
    while high - low > _WIDTH * high and sdps < budget:
        mu = (low + high) / 2
        found, spent = relaxed.search(mu, holds, min(_PATIENCE, budget - sdps))
        sdps += spent
        if found is None:
            low = mu
        else:
            best, high = found, mu
    return best, sdps


class _Relaxed:
    """The relaxed problem in coordinates where the start's Q and U are the identity."""

    def __init__(self, family: FixedOrder, p: Array, norm: float) -> None:
        self.family, self.at, self.norm = family, p, norm
        self.LQ = np.linalg.cholesky(np.linalg.inv(_passivity_storage(family, p)))
        self.LU = np.linalg.cholesky(_gain_storage(family, p, norm * (1 + _FIRST_ROOM)))
        self.sizes = (self.LQ.shape[0],) * 2 + (self.LU.shape[0],) * 2
        self.ends = np.cumsum([family.unknowns, *map(lmi.packed, self.sizes)])[:-1]

    def split(self, v: Array) -> tuple[Array, list[Array]]:
        """p and [Q, Y, U, X] from the vector of unknowns."""
        p, *vectors = np.split(v, self.ends)
        return self.at + p, [lmi.symmetric_from(u, n) for u, n in zip(vectors, self.sizes, strict=True)]

    def search(self, mu: float, holds: Callable[[Array, float], bool], patience: int) -> tuple[Array | None, int]:
        """(a coupling that holds for mu or None, SDPs spent)."""
        blocks = self._blocks(mu)
        matrices = [np.eye(n) for n in self.sizes]
        for spent in range(1, patience + 1):
            try:
                x = ConeProgram(self._inner(matrices), blocks).solve("a step of cone complementarity")
            except DesignFailed:
                return None, spent
            p, matrices = self.split(x)
            if holds(p, mu):
                return p, spent
        return None, patience

    def _inner(self, at: Sequence[Array]) -> Array:
        """The slopes of tr(Y0 Q) + tr(Q0 Y) + tr(X0 U) + tr(U0 X)."""
        Q0, Y0, U0, X0 = at
        both = [2 * M - np.diag(np.diag(M)) for M in (Y0, Q0, X0, U0)]
        return np.concatenate([np.zeros(self.family.unknowns), *(M[np.triu_indices(len(M))] for M in both)])

    def _blocks(self, mu: float) -> list[Inequality]:
        def passivity(v: Array) -> Array:
            p, (Q, Y, _, _) = self.split(v)
            G = _in_coordinates(self.family.ports(p), self.LQ)
            sigma = np.eye(G.C1.shape[0]) if G.C1.size else None
            return lmi.lemma2(G, Q, Y, sigma, np.zeros_like(G.D2))

        def gain(v: Array) -> Array:
            p, (_, _, U, X) = self.split(v)
            A, B, C, D = self.family.weighted_loop(p)
            A, B, C = np.linalg.solve(self.LU, A @ self.LU), np.linalg.solve(self.LU, B), C @ self.LU / self.norm
            return lmi.lemma3(A, B, C, D / self.norm, X, U, (mu / self.norm) ** 2)

        def pair(first: int) -> Callable[[Array], Array]:
            one = np.eye(self.sizes[first])
            return lambda v: lmi.symmetric([[self.split(v)[1][first + 1], one], [one, self.split(v)[1][first]]])

        every = range(self.family.unknowns + sum(map(lmi.packed, self.sizes)))
        return [Inequality.of(f, every) for f in (passivity, gain, pair(0), pair(2))]


# ----------------------------------------------------------------------------------------------------
# Diagonal couplings with given poles: one convex problem, globally optimal for those poles.
#
# V_i = v_i + sum_j f_ij (1 - z)/(z - a_ij). With the poles fixed, the remedied (2) is linear in the storage P and in
# (v, f), and W1 L W2 is affine in (v, f): its norm is bounded at sampled frequencies, with cutting planes.


#: Relative gap between the norm on a refined sweep and the bound at the sampled frequencies.
_GAP = 1e-5
_MOST_CUTS = 20


class FixedPoles:
    """The problem for one loop; frequencies that were binding are kept from one set of poles to the next."""

    def __init__(self, shaping: lmi.Shaping, sigma: Array) -> None:
        self.loop, self.sigma, self.shaping = shaping.loop, sigma, shaping
        self.frequencies = [0.0]
        self.sdps = 0

    def best(self, poles: Sequence[Sequence[float]]) -> tuple[Lti, float]:
        """(V in SI units, ||W1 L W2||_inf) for `poles`, one real sequence per channel, each in (-1, 1)."""
        cuts = 0
        while True:
            V, bound = self._solve(poles)
            norm, peak = self.shaping.norm(V)
            if norm <= bound * (1 + _GAP):
                return V, norm
            self.frequencies.append(peak)
            cuts += 1
            if cuts == _MOST_CUTS:
                return V, norm

    def search(self, start: Sequence[float], holds: Callable[[Lti], bool], evaluations: int = 60) -> tuple[Lti, float]:
        """`best` over one pole per channel, by a simplex search from `start`; only poles whose V `holds` count.

        The search would otherwise be drawn to poles at which a solver's tolerance passes for passivity.
        """

        def norm(x: Array) -> float:
            try:
                V, value = self.best([[a] for a in np.tanh(x)])
            except DesignFailed:
                return np.inf
            return value if holds(V) else np.inf

        options = {"maxfev": evaluations, "xatol": 1e-3, "fatol": 1e-4}
        found = minimize(norm, np.arctanh(start), method="Nelder-Mead", options=options)
        return self.best([[a] for a in np.tanh(found.x)])

    def _solve(self, poles: Sequence[Sequence[float]]) -> tuple[Lti, float]:
        N = self.loop.channels
        states = sum(map(len, poles)) + sum(self.loop.theta)
        gains, entries = N + sum(map(len, poles)), lmi.packed(states)

        def storage(x: Array) -> Array:
            return lmi.symmetric_from(x[gains:], states)

        every = range(gains + entries)
        passive = Inequality.of(lambda x: self._passivity(poles, x[:gains], storage(x)), every)
        cost = np.append(np.zeros(len(every)), 1.0)  # t is the last
        cuts = self._cuts(poles, [*range(gains), len(every)])
        x = ConeProgram(cost, [passive, Inequality.of(storage, every), cuts]).solve("the coupling with fixed poles")
        self.sdps += 1
        return self._coupling(poles, x[:gains]), float(np.sqrt(x[-1]))

    def _unit(self, poles: Sequence[Sequence[float]], gains: Array) -> Lti:
        """V in units T = 1 and usable damping = I."""
        N = len(poles)
        V1, f = np.diag(gains[:N]), np.split(gains[N:], np.cumsum([len(a) for a in poles])[:-1])
        A = np.diag(np.concatenate(poles))
        B = np.asarray(block_diag(*(np.sqrt(1 - np.square(a))[:, None] for a in poles)))
        F = np.asarray(block_diag(*(row[None, :] for row in f)))
        return Lti(A, B, F - F @ A, V1 - F @ B, 1.0)

    def _coupling(self, poles: Sequence[Sequence[float]], gains: Array) -> Lti:
        V, root, T = self._unit(poles, gains), 1 / np.sqrt(self.shaping.usable), self.loop.T
        return Lti(V.A, V.B * root, T * root[:, None] * V.C, T * root[:, None] * V.D * root, T)

    def _passivity(self, poles: Sequence[Sequence[float]], gains: Array, P: Array) -> Array:
        """The remedied (2) with the excess term by a Schur complement, so that it is linear in (gains, P)."""
        G = lmi.v_hat_ports(self._unit(poles, gains), self.loop.theta)
        zero = np.zeros_like(G.D1)
        plain = lmi.lemma1(G, P, zero, zero)
        paid = np.isfinite(self.sigma)
        excess = np.hstack([G.C1, G.D1])[paid] / np.sqrt(self.sigma[paid])[:, None]
        return lmi.symmetric([[plain, excess.T], [excess, np.eye(excess.shape[0])]])

    def _cuts(self, poles: Sequence[Sequence[float]], unknowns: Sequence[int]) -> Inequality:
        """[[I, L*], [L, t I]] >= 0 for W1 L W2 at the binding frequencies."""
        w = np.array(self.frequencies)
        left, right, late = self.shaping.parts(w)
        units = np.eye(len(unknowns) - 1)
        slopes = np.stack([left @ self._coupling(poles, e).at(on_circle(w)) @ right for e in units])
        m = right.shape[-1]
        base = np.broadcast_to(np.eye(m), (w.size, m, m)).astype(np.complex128)
        return lmi.gain_block(unknowns, late @ right, slopes, base, np.zeros((len(units), w.size, m, m)))


#: The start is designed for this much less damping, so that it is strictly feasible.
_START_ROOM = 1e-3
#: Descent ends when a step improves the norm by less than this, relatively.
_SETTLED = 1e-4


def design(
    loop: Loop,
    order: int = 1,
    diagonal: bool = True,
    method: str = "inner",
    start: SpringDamper | None = None,
    most_sdps: int = 100,
) -> Design:
    """The coupling with `order` states per channel that `method` finds, from strictly feasible spring-damper gains.

    Raises Infeasible if Theorem 4 admits no spring-damper to start from, DesignFailed if no result is certified.
    """
    whole("order", order, 1, _MOST_STATES)
    of_kind("diagonal", diagonal, bool, "True or False")
    one_of("method", method, _METHODS)
    if method == "fixed-poles" and (order, diagonal) != (1, True):
        raise ValueError("method 'fixed-poles' is for one state per channel, diagonal")
    started = time.perf_counter()
    search = _Search(loop, order, diagonal, start)
    V = search.run(method, most_sdps)
    return Design(
        coupling=Compliance(V),
        condition="any-environment",
        figure="loop-norm",
        objective=search.shaping.norm(V)[0],
        requirement=search.requirement(V),
        sdps=search.sdps,
        wall_s=time.perf_counter() - started,
        phi=search.phi,
    )


class _Search:
    """One run: the family of couplings, the judge, and the count of problems solved."""

    def __init__(self, loop: Loop, order: int, diagonal: bool, start: SpringDamper | None) -> None:
        self.loop, self.shaping, self.sdps = loop, lmi.Shaping(loop), 0
        self.phi = lmi.least_phi(loop)
        self.sigma = spring_damper.excess_limits(loop, self.phi)
        self.family = FixedOrder(self.shaping, self.sigma, order, diagonal)
        self.gains = start or self._structured()

    def requirement(self, V: Lti) -> Requirement:
        return lmi.ANY_ENVIRONMENT.required(self.loop, Compliance(V), self.phi)

    def run(self, method: str, most_sdps: int) -> Lti:
        """The coupling found, certified."""
        if method == "fixed-poles":
            V = self._fixed_poles(most_sdps)
        else:
            p = self.family.start(self.gains)
            p = self._inner(p, most_sdps) if method == "inner" else self._complementarity(p, most_sdps)
            V = self.family.coupling(p)
        if not self.requirement(V).certified:
            raise DesignFailed(None, (), f"{method} gave no coupling that Theorem 4 certifies")
        return V

    def _structured(self) -> SpringDamper:
        reserved = msgspec.structs.replace(self.loop, delta=tuple((1 - _START_ROOM) * d for d in self.loop.delta))
        found = spring_damper.design(reserved)
        self.sdps += found.sdps
        assert isinstance(found.coupling, SpringDamper)
        return found.coupling

    def _inner(self, p: Array, most_sdps: int) -> Array:
        norm = self.shaping.norm(self.family.coupling(p))[0]
        steps = descend(self.family, p, norm)
        for _ in range(most_sdps):
            try:
                trial = next(steps, None)
            except DesignFailed:
                break  # the solver's accuracy is exhausted: what the steps before reached stands
            if trial is None or not self._holds(trial, norm):
                break
            self.sdps += 1
            before, norm, p = norm, self.shaping.norm(self.family.coupling(trial))[0], trial
            if before - norm < _SETTLED * norm:
                break
        return p

    def _complementarity(self, p: Array, most_sdps: int) -> Array:
        norm = self.shaping.norm(self.family.coupling(p))[0]
        p, spent = _bisect(self.family, p, norm, self._holds, most_sdps)
        self.sdps += spent
        return p

    def _fixed_poles(self, most_sdps: int) -> Lti:
        problem = FixedPoles(self.shaping, self.sigma)
        rate = self.gains.B / (self.gains.B + self.gains.K * self.loop.T)
        V, _ = problem.search(rate.tolist(), lambda V: self.requirement(V).certified, evaluations=most_sdps)
        self.sdps += problem.sdps
        return V

    def _holds(self, p: Array, mu: float) -> bool:
        """Whether the coupling p is certified and ||W1 L W2||_inf <= mu, from the coupling alone."""
        V = self.family.coupling(p)
        return V.is_stable() and self.requirement(V).certified and self.shaping.norm(V)[0] <= mu
