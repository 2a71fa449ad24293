"""Check by an LMI whether a coupling satisfies Theorem 4, (c) in docs/theory.md. (n) is an equation of the paper."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import cvxpy as cp
import numpy as np
import scipy

from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Block
from haptic_loop.controller.lti import Array, Lti, taps
from haptic_loop.design.conditions import _regular_part
from haptic_loop.design.lmi import Ports, unit_environment


def balanced(G: Lti) -> Lti:
    """Return the realisation of a stable G whose Gramians are equal and diagonal, by the square-root method.

    States with a Hankel value below 1e-11 times the largest are dropped, which changes the response by rounding only.
    """
    if G.order == 0:
        return G
    reach, show = _root(G.A, G.B), _root(G.A.T, G.C.T)
    U, hankel, Vt = scipy.linalg.svd(show.T @ reach)
    keep = hankel > 1e-11 * max(hankel[0], 1e-300)
    scale = 1 / np.sqrt(hankel[keep])
    left = (show @ U[:, keep] * scale).T
    right = reach @ Vt[keep].T * scale
    return Lti(left @ G.A @ right, left @ G.B, G.C @ right, G.D, G.T)


def _root(A: Array, B: Array) -> Array:
    """Return R with R R' = the Gramian of (A, B), also for singular Gramians."""
    W = scipy.linalg.solve_discrete_lyapunov(A, B @ B.T)
    values, basis = np.linalg.eigh((W + W.T) / 2)
    return basis * np.sqrt(np.maximum(values, 0.0))


def unit_coupling(V: Lti, delta: Sequence[float]) -> Lti:
    """Return V in units in which T = 1 and Delta_D = I: Delta_D^1/2 V Delta_D^1/2 / T."""
    root = np.sqrt(np.asarray(delta))
    return Lti(V.A, V.B * root, root[:, None] / V.T * V.C, root[:, None] / V.T * V.D * root, 1.0)


def e_hat_regular(E: Lti, psi: Sequence[int]) -> Lti:
    """Return E-hat without its pole at z = 1, plus E(1)/2; E(1) must be symmetric and >= 0."""
    return _regular_part(delay(psi, E.T) @ E)


def theta_hat(theta: Sequence[int]) -> Lti:
    """Return Theta-hat (12) in units T = 1, Delta_D = I."""
    return Lti.diag(*(taps([0.5] * (n + 1), 1.0) for n in theta))


def v_hat_ports(V: Lti, theta: Sequence[int]) -> Ports:
    """Return V-hat without its zero at z = 1, with the paper's two outputs; V(1) must be symmetric.

    With H = V - Theta-hat the outputs are y1 = H u and y2 = H(1)/2 u - (H - H(1))/(z - 1) u. V-hat is output strictly
    passive with level Delta iff He G2 >= G1* Delta G1 for the transfer matrices G1, G2 from u to y1, y2. The result has
    m fewer states than (16).
    """
    H = V - theta_hat(theta)
    R = H.C @ np.linalg.inv(np.eye(H.order) - H.A)  # (H(1) - H)/(z - 1) is R (z - A)^-1 B
    return Ports(H.A, H.B, R, H.dc() / 2, H.C, H.D)


def symmetric(rows: list[list[cp.Expression]]) -> cp.Expression:
    """Return the block matrix of all blocks that are not empty, made exactly symmetric."""
    blocks = [[block for block in row if 0 not in block.shape] for row in rows]
    M = cp.bmat([row for row in blocks if row])
    return (M + M.T) / 2


def dissipated(G: Ports, P: cp.Expression, Delta: cp.Expression, Phi: cp.Expression) -> cp.Expression:
    """Return the matrix of x'Px - x+'Px+ + y2'u - y1'Delta y1 - u'Phi u in (x, u), for expressions."""
    A, B, C2, D2, C1, D1 = G
    corner = C2.T / 2 - A.T @ P @ B - C1.T @ Delta @ D1
    state, port = P - A.T @ P @ A - C1.T @ Delta @ C1, (D2 + D2.T) / 2 - B.T @ P @ B - D1.T @ Delta @ D1 - Phi
    return symmetric([[state, corner], [corner.T, port]])


def lemma4(Delta_V: cp.Variable, Phi: cp.Variable) -> cp.Expression:
    """Return the matrix of (14). If positive, the excess of devices (I) and V-hat covers the shortage Phi of E-hat."""
    return symmetric([[np.eye(Phi.shape[0]) - Phi, -Phi], [-Phi, Delta_V - Phi]])


@dataclass(frozen=True, eq=False)
class Analysis:
    """The result of `analysis`, in units T = 1, Delta_D = I; matrices are None if V was refused without an LMI."""

    margin: (
        float  # > 0: Theorem 4 holds with this margin in (14), Delta_V and V-hat; < 0: it does not; -inf: V was refused
    )
    Phi: Array | None = None  # (m, m) shortage of passivity of E-hat
    Delta_V: Array | None = None  # (m, m) excess of passivity of V-hat
    P_E: Array | None = None  # storage of E-hat's regular part, in balanced coordinates
    P_V: Array | None = None  # storage of V-hat, in balanced coordinates
    reason: str | None = None

    @property
    def feasible(self) -> bool:
        return self.margin > 0


def analysis(V: Lti, environment: Lti, theta: Sequence[int], psi: Sequence[int], delta: Sequence[float]) -> Analysis:
    """Check whether V satisfies Theorem 4 with this environment. Raises ValueError if the environment is not passive.

    The problem minimises s subject to E-hat + Phi passive, V-hat + s passive with excess Delta_V, (14) + s I >= 0 and
    Delta_V + s >= 0; the margin is -s.
    """
    Block.of(environment)
    if not V.is_stable():
        return Analysis(-np.inf, reason="the coupling V has a pole on or outside the unit circle")
    V1 = V.dc()
    if np.abs(V1 - V1.T).max() > 1e-9 * max(float(np.abs(V1).max()), 1e-300):
        return Analysis(-np.inf, reason="the static compliance V(1) is not symmetric")
    shortage = balanced(e_hat_regular(unit_environment(environment, delta), psi))
    excess = balanced_ports(unit_coupling(V, delta), theta)
    return _solve(shortage, excess)


def balanced_ports(V: Lti, theta: Sequence[int]) -> Ports:
    """Return `v_hat_ports` of V (in units T = 1, Delta_D = I), with both outputs balanced together."""
    G, m = v_hat_ports(V, theta), V.outputs
    both = balanced(Lti(G.A, G.B, np.vstack([G.C2, G.C1]), np.vstack([G.D2, G.D1]), V.T))
    return Ports(both.A, both.B, both.C[:m], both.D[:m], both.C[m:], both.D[m:])


def _solve(shortage: Lti, excess: Ports) -> Analysis:
    m = shortage.inputs
    s = cp.Variable()
    Phi, Delta_V = (cp.Variable((m, m), symmetric=True) for _ in range(2))
    P_E, P_V = _storage(shortage.A), _storage(excess.A)
    zero = np.zeros((m, m))
    constraints = [
        dissipated(Ports.same(shortage), P_E, zero, -Phi) >> 0,
        dissipated(excess, P_V, Delta_V, -s * np.eye(m)) >> 0,
        lemma4(Delta_V, Phi) + s * np.eye(2 * m) >> 0,
        Delta_V + s * np.eye(m) >> 0,
        *(P >> 0 for P in (P_E, P_V) if isinstance(P, cp.Variable)),
    ]
    solve(cp.Problem(cp.Minimize(s), constraints))
    E_storage, V_storage = (P.value if isinstance(P, cp.Variable) else P for P in (P_E, P_V))
    return Analysis(-float(s.value), Phi.value, Delta_V.value, E_storage, V_storage)


def solve(problem: cp.Problem, solver: str = "CLARABEL") -> float:
    """Solve the problem, which sets its variables, and return the optimal value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(solver=solver)
    assert problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE), problem.status
    return float(problem.value)


def _storage(A: Array) -> cp.Variable | Array:
    n = A.shape[0]
    return cp.Variable((n, n), symmetric=True) if n else np.zeros((0, 0))
