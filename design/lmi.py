"""The paper's matrix inequalities, one function per equation, with remedies for two that no matrix can satisfy.

Units: T = 1 and Delta_D = I (the scaling at the end of this file). Every function returns a symmetric matrix that must
be positive (semi)definite; its arguments are numbers or cvxpy expressions.

Two transfer matrices of the paper can never satisfy the strict inequalities printed for them:
  E-hat = z/(z-1) Psi E has a pole at z = 1 if E has static stiffness, and A'PA - P < 0 excludes such a pole (15), (17).
      Remedy: the Hermitian part of E(1) z/(z-1) on |z| = 1 is the constant E(1)/2, so E-hat without its pole plus
      E(1)/2 satisfies the same condition and is stable (`design.conditions.delayed_environment_demand`).
  V-hat = (1 - 1/z)(V - Theta-hat) vanishes at z = 1, where (2) would be 0 > 0.
      Remedy: divide by |1 - 1/z|^2 (`design.conditions._v_hat`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Block, Lti, Sampled
from haptic_loop.controller.ranges import Member
from haptic_loop.design import conditions
from haptic_loop.design.conditions import (
    Demand,
    asymmetric,
    covers,
    delayed_environment_demand,
    even_damping,
    even_level,
    uncovered,
    unsound,
)
from haptic_loop.design.cone import ConeProgram, Inequality
from haptic_loop.design.environments import Multiplied
from haptic_loop.design.exact import require_size
from haptic_loop.design.facts import Fact, HandsSide, Switching, Unknowns, compose_any, hands_side
from haptic_loop.design.frequency import Response, frequencies, on_circle, supremum
from haptic_loop.design.result import (
    DesignFailed,
    Environments,
    Infeasible,
    NotProved,
    Requirement,
    from_ratio,
    refusal,
)

RESERVE = 1e-4  # share of the damping that designs do not use, so that the rounded coupling is certified


def usable(loop: Loop) -> Array:
    """Return the damping (m,) [N s/m] that a design may use, in even periods. Raises ValueError if it is 0."""
    if min(loop.delta) <= 0:
        raise ValueError(f"delta is {list(loop.delta)}, expected positive dampings in N s/m")
    return (1 - RESERVE) * even_damping(loop)


def _low_pass(channels: int, T: float, f0: float = 80.0) -> Lti:
    """Return w(z) I, the backward Euler discretisation of 1/(1 + s/(2 pi f0)), f0 in Hz (section 6 of the paper)."""
    a = 2 * np.pi * f0 * T
    gain, pole = a / (1 + a), 1 / (1 + a)
    one = np.eye(channels)
    return Lti(pole * one, one, gain * pole * one, gain * one, T)


def _check_weights(W1: Lti, W2: Lti, channels: int) -> None:
    if W1.inputs != channels or (W2.inputs, W2.outputs) != (channels, channels):
        raise ValueError(f"W1 and W2 must fit the {channels} channels on the inside, W2 also on the outside")
    for name, W in (("W1", W1), ("W2", W2)):
        if not W.is_stable():
            raise ValueError(f"{name} has a pole on or outside the unit circle, so no norm is finite")
    z = on_circle(np.array([0.1, 1.0, 3.0]))
    response = W2.at(z)
    if np.abs(response - response * np.eye(channels)).max() > 1e-9 * np.abs(response).max():
        raise ValueError("W2 must be diagonal: the convex-concave step divides by it channel by channel")


# ----------------------------------------------------------------------------------------------------
# The loop-shaping objective of section 5 of the paper: ||W1 L W2||_inf with L = I + Psi E V - Psi Lambda^-1 Theta.


Complex = NDArray[np.complex128]


class Shaping:
    """L (22) of a loop, evaluated fast for many couplings.

    L is multiplied by W1 from the left and by the diagonal W2 from the right. The defaults are the identity and
    `_low_pass`. Raises ValueError for weights that do not fit, and for an active environment.
    """

    def __init__(self, loop: Loop, W1: Lti | None = None, W2: Lti | None = None) -> None:
        N, T, E = loop.channels, loop.T, loop.E()
        one = Lti.constant(np.eye(N), T)
        self.loop, self.usable = loop, usable(loop)
        self.W1, self.W2 = W1 or one, W2 or _low_pass(N, T)
        _check_weights(self.W1, self.W2, N)
        if reason := loop.environment.active(T):
            raise ValueError(reason)
        advance = [t + p - n for t, p, n in zip(loop.theta, loop.psi, loop.lam, strict=True)]
        self.late = one - delay(advance, T)  # I - Psi Lambda^-1 Theta
        self.environment = delay(loop.psi, T) @ E  # Psi E

    def parts(self, w: Array) -> tuple[Complex, Complex, Complex]:
        """Return W1 Psi E, W2 and W1 (I - Psi Lambda^-1 Theta) at exp(jw), each (k, ., .)."""
        z = on_circle(w)
        W1 = self.W1.at(z)
        return W1 @ self.environment.at(z), self.W2.at(z), W1 @ self.late.at(z)

    def grid(self, *systems: Lti) -> Array:
        """Return frequencies [rad/sample] from 0 to pi that resolve every pole of E, the weights and `systems`."""
        known = (self.environment, self.W1, self.W2, *systems)
        return np.concatenate([[0.0], frequencies(*known)])

    def gain(self, V: Lti, w: Array) -> Array:
        """Return sigma_max of W1 L W2 at exp(jw), shape (k,)."""
        left, right, late = self.parts(w)
        return np.linalg.norm((left @ V.at(on_circle(w)) + late) @ right, 2, axis=(1, 2))

    def norm(self, V: Lti) -> tuple[float, float]:
        """Return (||W1 L W2||_inf, its frequency [rad/sample])."""
        return supremum(lambda w: self.gain(V, w), self.grid(V))


# ----------------------------------------------------------------------------------------------------
# Symmetric matrices of unknowns, as vectors.


def packed(n: int) -> int:
    """Return the number of free entries of a symmetric matrix (n, n)."""
    return n * (n + 1) // 2


def symmetric_from(vector: Array, n: int) -> Array:
    """Return the symmetric (n, n) matrix whose upper triangle, row by row, is `vector`."""
    M = np.zeros((n, n))
    M[np.triu_indices(n)] = vector
    return M + np.triu(M, 1).T


# ----------------------------------------------------------------------------------------------------
# State coordinates and units in which matrix inequalities are well scaled.


def _unit_environment(E: Lti, delta: Sequence[float] | Array) -> Lti:
    """Return E in units where T = 1 and Delta_D = I: T Delta_D^-1/2 E Delta_D^-1/2."""
    root = 1 / np.sqrt(np.asarray(delta))
    return Lti(E.A, E.B * root, E.T * root[:, None] * E.C, E.T * root[:, None] * E.D * root, 1.0)


def _balanced(G: Lti, negligible: float = 1e-11) -> Lti:
    """Return a stable G with equal diagonal Gramians, by the square-root method.

    States with a Hankel value below `negligible` times the largest are dropped. They are unreachable or unobservable to
    rounding, so the response does not change.
    """
    import scipy

    if G.order == 0:
        return G
    reach, show = _root(G.A, G.B), _root(G.A.T, G.C.T)
    U, hankel, Vt = scipy.linalg.svd(show.T @ reach)
    keep = hankel > negligible * max(hankel[0], 1e-300)
    scale = 1 / np.sqrt(hankel[keep])
    left = (show @ U[:, keep] * scale).T
    right = reach @ Vt[keep].T * scale
    return Lti(left @ G.A @ right, left @ G.B, G.C @ right, G.D, G.T)


def reachability_scaled(G: Lti) -> Array:
    """Return S (n, n) such that the states S^-1 x of G have the identity as reachability Gramian (regularised)."""
    import scipy

    A, W = G.A, G.B @ G.B.T
    with warnings.catch_warnings():
        warnings.simplefilter("error", scipy.linalg.LinAlgWarning)
        try:
            W = scipy.linalg.solve_discrete_lyapunov(A, W)
        except scipy.linalg.LinAlgWarning:  # Stiff blocks: sum A^k B B' A'^k; each step doubles the number of terms.
            while np.abs(step := A @ W @ A.T).max(initial=0.0) > 1e-16 * np.abs(W).max(initial=0.0):
                W, A = W + step, A @ A
    size = max(np.trace(W) / max(G.order, 1), 1e-300)
    return scipy.linalg.cholesky((W + W.T) / 2 + 1e-9 * size * np.eye(G.order), lower=True)


def _root(A: Array, B: Array) -> Array:
    """Return R with R R' = the Gramian of (A, B), also for singular Gramians."""
    import scipy

    W = scipy.linalg.solve_discrete_lyapunov(A, B @ B.T)
    values, basis = np.linalg.eigh((W + W.T) / 2)
    return basis * np.sqrt(np.maximum(values, 0.0))


# ----------------------------------------------------------------------------------------------------
# A bound on a gain that is affine in real variables, at sampled frequencies, with cutting planes.
#
# A problem over all frequencies has infinitely many constraints, of which few bind. The problem is solved at some
# frequencies, a refined sweep checks the result, and the worst frequency is added.


def gain_block(
    unknowns: Sequence[int], rows: Complex, row_slopes: Complex, base: Complex, base_slopes: Complex | Array
) -> Inequality:
    """Return the inequality [[base, rows*], [rows, t I]] >= 0, where t is the last of the unknowns.

    rows (k, p, m) with slopes (q, k, p, m); base (k, m, m) with slopes (q, k, m, m). For base >= 0 it means
    rows* rows <= t base.
    """
    q, k, p, m = row_slopes.shape
    constant = np.zeros((k, m + p, m + p), dtype=np.complex128)
    slopes = np.zeros((q + 1, k, m + p, m + p), dtype=np.complex128)
    for target, top, low in ((constant, base, rows), (slopes[:q], base_slopes, row_slopes)):
        target[..., :m, :m] = top
        target[..., m:, :m] = low
        target[..., :m, m:] = np.conj(np.swapaxes(low, -1, -2))
    slopes[q, :, m:, m:] = np.eye(p)
    return Inequality(constant, slopes, unknowns)


# ----------------------------------------------------------------------------------------------------
# Theorem 4, and the least multiplier Phi of an environment with delay inside (psi >= 1), by (17).


#: relative increase of Phi that covers the solver's tolerance
_ROOM = 1e-6


def least_phi(loop: Loop) -> Array | None:
    """Return Phi (N,) of `least_multiplier`, verified at every frequency, or None for psi = 0, which needs no Phi."""
    if not any(loop.psi):
        return None
    phi = least_multiplier(loop) + _ROOM * even_damping(loop)
    if not covers(loop, phi):
        raise DesignFailed(None, (), f"the multiplier Phi = {phi.tolist()} may leave some frequency uncovered")
    return phi


_MOST_STATES = 30  # The least trace is computed up to so many states of E-hat: 42 take ten seconds, 400 take 20 GB.


def least_multiplier(loop: Loop) -> Array:
    """Return a diagonal Phi < Delta_D (N,) [N s/m] with E-hat + Phi passive; with few states, that of least trace.

    Raises Infeasible, with the damping that would be needed, if even a full Phi is not below Delta_D.
    """
    delta = even_damping(loop)
    unit = _unit_environment(loop.E(), delta)
    none, level = np.zeros(loop.channels), even_level(loop) / np.sqrt(np.outer(delta, delta))  # level_ii = 1
    least, _ = uncovered(unit, loop.psi, none)  # bound for a full Phi and for each channel
    each, root = least, np.linalg.inv(np.linalg.cholesky(level))
    if loop.levels:
        least, _ = uncovered(root @ unit @ root.T, loop.psi, none)
    if least >= 1:
        raise Infeasible(None, (), _needs(loop.psi, delta, least))
    regular = delayed_environment_demand(delay(loop.psi, 1.0) @ unit, none).free
    if regular.order > _MOST_STATES:
        return max(each, 0.0) * delta
    # The matrix of least trace may reach Delta_D, which leaves no damping for the coupling. So Phi stays below a level
    # halfway between its least possible value and Delta_D.
    return np.maximum(_of_least_trace(_balanced(regular), (1 + least) / 2 * level), 0.0) * delta


def _of_least_trace(regular: Lti, most: Array) -> Array:
    """Return the entries of the diagonal Phi <= most (m, m) with least trace that makes `regular` passive."""
    m, n = regular.inputs, regular.order
    ports, zero = Ports.same(regular), np.zeros((regular.inputs,) * 2)

    def passive(x: Array) -> Array:
        return lemma1(ports, symmetric_from(x[m:], n), zero, -np.diag(x[:m]))

    size = range(m + packed(n))
    storage, room = Inequality.of(lambda x: symmetric_from(x[m:], n), size), lambda x: most - np.diag(x[:m])
    problem = ConeProgram(
        np.repeat([1.0, 0.0], [m, packed(n)]), [Inequality.of(passive, size), storage, Inequality.of(room, size)]
    )
    return problem.solve("the multiplier Phi of the environment")[:m]


def _needs(psi: Sequence[int], delta: Array, least: float) -> str:
    required = ", ".join(f"{least * d:.4g}" for d in delta)
    return (
        f"Theorem 4 admits no coupling: with psi = {psi} the environment alone uses up {required} N s/m of device "
        f"damping and delta is {tuple(delta.tolist())}"
    )


class _AnyEnvironment(Multiplied):
    """Theorem 4 of the paper: stability in every passive environment, or for psi >= 1 in the loop's environment only.

    For psi >= 1 the multiplier is Phi (m,) [N s/m]. Walls, a latency and switching delays are covered for psi = 0 only.
    A latency and switching delays use the block of design.facts.compose_any.
    """

    name, source, separable = "any-environment", "the paper's Theorem 4", True
    covers = conditions.BEYOND

    def facts(self, loop: Loop) -> tuple[Fact, ...]:
        """Return the facts of the environment's side that the block needs."""
        return (Switching(),) if loop.varying_delay else ()

    def unknowns(self, loop: Loop) -> tuple[Unknowns, ...]:
        return tuple(each for part in (hands_side(loop), *self.facts(loop)) for each in part.unknowns(loop))

    def hands(self, loop: Loop) -> HandsSide | None:
        hands = hands_side(loop)
        return hands if hands.unknowns(loop) else None

    def map(self, loop: Loop, coupling: Coupling, exact: bool = False) -> Lti:
        V = coupling.compliance(loop.period(exact))
        assert V is not None  # `required` refuses None
        if exact:
            require_size(V.order + sum(loop.delays.hi))
        return V

    def block(self, G: Block, loop: Loop, multiplier: Any = None) -> Demand[Block]:
        return self._composed(G, loop, multiplier)

    def scaled(self, G: Lti, loop: Loop, multiplier: Sequence[Any]) -> Demand[Lti]:
        return self._composed(G, loop, multiplier, scaled=True)

    def _composed(self, V: Block, loop: Loop, multiplier: Any, scaled: bool = False) -> Demand[Block]:
        if not _in_frame(loop):
            return conditions.any_environment_demand(V, loop)
        values = self.named(loop, () if multiplier is None else multiplier)
        return compose_any(V, loop, self.facts(loop), values, scaled)

    def least_multiplier(self, loop: Loop) -> tuple[Array | None, str | None]:
        """Return (the least Phi or None if none is needed, the reason why the loop is not covered)."""
        if (reason := self.beyond(loop)) or not any(loop.psi):
            return None, reason
        try:
            return least_phi(loop), None
        except ValueError as error:
            return None, " ".join(str(error).split())

    def beyond(self, loop: Loop) -> str | None:
        if loop.environment.walls and any(loop.psi):
            return "with delay in the environment its multiplier is of a linear one: no walls"
        if _in_frame(loop) and any(loop.psi):
            obstacle = "a latency" if loop.latency else "delays that switch"
            return f"with delay in the environment its multiplier is of whole, constant samples: no {obstacle}"
        return None if any(loop.psi) else loop.environment.active(loop.T)

    def not_varied(self, loop: Loop) -> str | None:
        return (
            "with psi >= 1 every K, T and delay needs a multiplier of its own: not searched" if any(loop.psi) else None
        )

    def over_frequency(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Response | None:
        V = coupling.compliance(loop.T)
        if V is not None and _in_frame(loop):
            return partial(conditions.least_scale, self.block(V, loop, multiplier or self.usual(None, loop)))
        phi = multiplier if any(loop.psi) else None
        if V is None or (phi is None and any(loop.psi)):
            return None
        return partial(conditions.least_scale, conditions.any_environment_demand(V, loop, phi))

    def ratios(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Array | None:
        count = len(coupling.sampled(np.array([[1j]]), loop.T).G)

        def demand(V: Sampled) -> Demand[Sampled]:
            """Return the block, with default multipliers for a latency that varies and for switching delays."""
            if _in_frame(loop):
                return self.block(V, loop, self.usual(None, loop))
            return conditions.any_environment_demand(V, loop, multiplier)

        return conditions.any_environment_ratios(lambda z: coupling.sampled(z, loop.T), count, loop, demand)

    def _without(self, coupling: Coupling) -> str:
        """Return the reason why a coupling without V(z) is refused."""
        if coupling.holds_model:
            return "the coupling contains a model of the environment: Theorem 4 is about one that knows none"
        return "without a coupling there is nothing that Theorem 4 could use"

    def required(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> Requirement:
        """Return the requirement with `multiplier`, or with the least multiplier if one is needed."""
        reason, V = self.beyond(loop), coupling.compliance(loop.T)
        if reason or V is None:
            return refusal(self.name, loop.delta, reason or self._without(coupling))
        if _in_frame(loop):
            return self._in_frame(V, loop, multiplier)
        if not any(loop.psi):
            channels = None if loop.levels else coupling.channels(loop.T)
            if channels:
                return conditions.any_environment_per_channel(channels, loop)
            return conditions.any_environment(V, loop)
        if multiplier is None:
            multiplier, reason = self.least_multiplier(loop)
        if multiplier is None:
            return refusal(self.name, loop.delta, str(reason))
        if len(multiplier) != loop.channels:
            raise NotProved("any-environment with psi >= 1 needs a multiplier Phi, one entry per channel")
        requirement = conditions.any_environment(V, loop, np.array([float(p) for p in multiplier]))
        return replace(requirement, multiplier=tuple(multiplier))

    def _in_frame(self, V: Lti, loop: Loop, multiplier: Any) -> Requirement:
        if self.unknowns(loop):
            needs = self.required_of(V, loop, multiplier)
            if multiplier or loop.latency or needs.certified:
                return needs
            spans = [(loop.delays.lo[own.start], loop.delays.hi[own.start]) for own in loop.devices]
            mean = [float(np.mean(even_damping(loop)[own])) * (1 - RESERVE) / loop.T for own in loop.devices]
            alpha = [float(f"{stiffest_alpha(*span, d):.10g}") for span, d in zip(spans, mean, strict=True)]
            closed = self.required_of(V, loop, alpha)  # The search may miss this alpha near the stiffest coupling.
            return min(needs, replace(closed, bound=needs.bound), key=lambda requirement: requirement.ratio)
        demand = self.block(V, loop)
        if not V.is_stable():
            return refusal(self.name, loop.delta, "the coupling V has a pole on or outside the unit circle")
        if reason := unsound(demand.free, loop.delta) or self.unsound_static(V, loop, demand):
            return refusal(self.name, loop.delta, reason)
        ratio, w = supremum(partial(conditions.least_scale, demand), np.concatenate([[0.0], frequencies(V)]))
        return from_ratio(self.name, ratio, loop.delta, w / (2 * np.pi * loop.T))

    def unsound_static(self, G: Lti, loop: Loop, demand: Demand[Lti]) -> str | None:
        return asymmetric(demand.static["V(1)"])

    def exact_demands(self, loop: Loop, coupling: Coupling, multiplier: Any = None) -> dict[str, Demand[Lti]]:
        if not any(loop.psi):
            return super().exact_demands(loop, coupling, multiplier)
        T = loop.period(exact=True)
        V = coupling.compliance(T)
        assert V is not None
        require_size(V.order + sum(loop.theta))
        delayed = delay(loop.psi, T) @ loop.E(exact=True)
        return {
            "P": conditions.any_environment_demand(V, loop, multiplier),
            "P_E": conditions.delayed_environment_demand(delayed, multiplier),
        }

    def multiplier_sizes(self, loop: Loop) -> dict[str, int]:
        return {"Phi": loop.channels} if any(loop.psi) else super().multiplier_sizes(loop)

    def members(self, loop: Loop) -> tuple[Member, ...]:
        return ()

    def lag(self, loop: Loop) -> tuple[float, ...] | None:
        return None if any(loop.psi) else (0.0,) * loop.channels

    def guarantee(self, loop: Loop) -> Environments:
        return "this environment" if any(loop.psi) else "any passive environment"


ANY_ENVIRONMENT = _AnyEnvironment()


def stiffest_alpha(lo: int, hi: int, damping: float) -> float:
    """Return the alpha [N/m] for `damping` [N s/m^2] that admits the stiffest coupling for any environment.

    This alpha minimises the mean over frequency of |vt|^2/(4 (damping - alpha/2)) + h^2/(2 alpha), where vt is the mean
    window and h = (hi - lo)/2 (docs/theory.md).
    """
    half = (hi - lo) / 2
    return 2 * half * damping / (np.sqrt(lo + 1 + half / 2) + half)


def _in_frame(loop: Loop) -> bool:
    """Return whether the block comes from design.frame, because of a latency or switching delays."""
    return bool(loop.latency or loop.varying_delay)


# ----------------------------------------------------------------------------------------------------
# The paper's lemmas.


_Matrix = Any  # Array or cvxpy expression, (rows, columns)


class Ports(NamedTuple):
    """x+ = A x + B u with a port output y2 = C2 x + D2 u and a dissipated output y1 = C1 x + D1 u.

    The supply is y2'u - y1' Delta y1 - u' Phi u. Plain passivity has y1 = y2.
    """

    A: _Matrix
    B: _Matrix
    C2: _Matrix
    D2: _Matrix
    C1: _Matrix
    D1: _Matrix

    @classmethod
    def same(cls, G: Lti) -> Ports:
        return cls(G.A, G.B, G.C, G.D, G.C, G.D)


def lemma1(G: Ports, P: _Matrix, Delta: _Matrix, Phi: _Matrix) -> _Matrix:
    """Return the matrix of x'Px - x+'Px+ + supply in (x, u), the negative of (2); this matrix and P must be > 0."""
    A, B, C2, D2, C1, D1 = G
    corner = C2.T / 2 - A.T @ P @ B - C1.T @ Delta @ D1
    state = P - A.T @ P @ A - C1.T @ Delta @ C1
    port = (D2 + D2.T) / 2 - B.T @ P @ B - D1.T @ Delta @ D1 - Phi
    return symmetric([[state, corner], [corner.T, port]])


def lemma2(G: Ports, Q: _Matrix, Y: _Matrix, Sigma: _Matrix | None, Phi: _Matrix) -> _Matrix:
    """Return [[Y, R'], [R, S]] of (3), which is affine in A, B, C, D, so that these may be unknowns.

    With Q > 0, Y = Q^-1 and Sigma = Delta^-1 the inequality is equivalent to Lemma 1. Sigma = None means Delta = 0.
    """
    A, B, C2, D2, C1, D1 = G
    n = Q.shape[0]
    rows = [
        [Y, C2.T / 2, A.T],
        [C2 / 2, (D2 + D2.T) / 2 - Phi, B.T],
        [A, B, Q],
    ]
    if Sigma is not None:
        for row, block in zip(rows, (C1.T, D1.T, np.zeros((n, C1.shape[0]))), strict=True):
            row.append(block)
        rows.append([C1, D1, np.zeros((C1.shape[0], n)), Sigma])
    return symmetric(rows)


def lemma3(A: _Matrix, B: _Matrix, C: _Matrix, D: _Matrix, X: _Matrix, U: _Matrix, mu2: _Matrix) -> _Matrix:
    """Return the matrix of Lemma 3 and (24). With X = U^-1 the matrix is positive iff ||G||_inf < mu; mu2 = mu^2."""
    n, m, p = A.shape[0], B.shape[1], C.shape[0]
    rows = [
        [X, np.zeros((n, m)), A.T, C.T],
        [np.zeros((m, n)), mu2 * np.eye(m), B.T, D.T],
        [A, B, U, np.zeros((n, p))],
        [C, D, np.zeros((p, n)), np.eye(p)],
    ]
    return symmetric(rows)


def symmetric(rows: list[list[_Matrix]]) -> _Matrix:
    """Return the block matrix without empty blocks, exactly symmetric; an array if every block is an array."""
    blocks = [[block for block in row if 0 not in block.shape] for row in rows]
    blocks = [row for row in blocks if row]
    numbers = all(isinstance(block, np.ndarray) for row in blocks for block in row)
    if numbers:
        M = np.block(blocks)
    else:
        import cvxpy as cp  # loaded only for expressions

        M = cp.bmat(blocks)
    return (M + M.T) / 2
