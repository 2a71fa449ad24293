"""Spring-damper couplings (26) under Theorem 4: the exact convex set of gains, and the objective (23) over it.

Gains are handled in units of the usable damping d = (1 - RESERVE) delta: k = KT/d, b = B/d (design.gain_set).
"""

from __future__ import annotations

import time

import cvxpy as cp
import numpy as np

from controller.coupling import SpringDamper
from controller.lti import Array
from design.delayed import theorem4_delayed
from design.gain_set import gain_set, gain_sets
from design.margin import Requirement, theorem4
from design.multiplier import shortage
from design.result import Design
from design.sampled import Complex, affine_lmis, gain_lmi
from design.shaping import Shaping
from design.solve import DesignFailed, Infeasible, solve
from design.specification import RESERVE, Specification

#: The sequence stops when a step improves the norm by less than this, relatively.
SETTLED = 1e-6
MOST_STEPS = 60


def design(spec: Specification, start: SpringDamper | None = None) -> Design:
    """The spring-damper that minimises ||W1 L W2||_inf (23) among those that satisfy Theorem 4.

    A convex-concave sequence from `start` (by default the stiffest gains): with g = k + b (1 - 1/z) the norm is
    below mu iff (L g W2)* (L g W2) <= mu^2 g* g, and g* g is replaced by its tangent at the gains before, which
    lies below. A few SDPs; the result does not depend on the start. Raises Infeasible if Theorem 4 admits no gains.
    """
    started = time.perf_counter()
    phi = shortage(spec)
    sigma = _sigma(spec, phi)
    shaping = Shaping(spec)
    gains, sdps = _start(spec, sigma, start)
    norm, peak = shaping.norm(_coupling(spec, gains).compliance(spec.T))
    frequencies = [peak]
    for _ in range(MOST_STEPS):
        gains, bound = _step(spec, sigma, shaping, gains, norm, np.array(frequencies))
        sdps += 1
        before, (norm, peak) = norm, shaping.norm(_coupling(spec, gains).compliance(spec.T))
        frequencies.append(peak)
        if abs(before - norm) < SETTLED * norm and norm < (1 + SETTLED) * bound:
            break
    coupling = _coupling(spec, gains)
    return Design(
        coupling, "theorem4", "loop-norm", norm, verified(spec, coupling, phi), sdps, time.perf_counter() - started, phi
    )


def stiffest(spec: Specification) -> Design:
    """The gains of largest total stiffness (each channel's own largest) that satisfy Theorem 4; objective in N/m."""
    started = time.perf_counter()
    phi = shortage(spec)
    gains, sdps = _start(spec, _sigma(spec, phi), None)
    coupling = _coupling(spec, gains)
    requirement = verified(spec, coupling, phi)
    total = float(coupling.K.sum())
    return Design(coupling, "theorem4", "stiffness", total, requirement, sdps, time.perf_counter() - started, phi)


def stiffest_at(B: float, theta: int, delta: float, T: float) -> float:
    """The largest stiffness [N/m] that Theorem 4 certifies beside the damping B [N s/m], psi = 0, one channel.

    Raises Infeasible where B alone asks for more damping than delta.
    """
    usable = (1 - RESERVE) * delta
    k = cp.Variable(nonneg=True)
    problem = cp.Problem(cp.Maximize(k), gain_set(k, cp.Constant(B / usable), theta, np.inf))
    try:
        solve(problem, f"the largest stiffness beside B = {B:g} N s/m")
    except Infeasible as error:
        line = f"B = {B:g} N s/m leaves no stiffness with delta = {delta:g} N s/m and theta = {theta}: use less B"
        raise Infeasible(problem, error.results, line) from error
    K = float(k.value) * usable / T
    requirement = theorem4(SpringDamper([K], [B]).compliance(T), [theta], [delta])
    if not requirement.certified:
        raise DesignFailed(problem, (), f"K = {K:g} N/m beside B = {B:g} needs {requirement.required[0]:g} N s/m")
    return K


def verified(spec: Specification, coupling: SpringDamper, phi: Array | None) -> Requirement:
    """Theorem 4's requirement from the coupling alone; raises DesignFailed unless it is certified."""
    V = coupling.compliance(spec.T)
    requirement = (
        theorem4(V, spec.theta, spec.delta)
        if phi is None
        else theorem4_delayed(V, spec.environment, spec.theta, spec.psi, spec.delta, phi)
    )
    if not requirement.certified:
        why = requirement.reason or f"it requires {max(requirement.required):.6g} N s/m"
        raise DesignFailed(None, (), f"the designed coupling is not certified by theorem4: {why}; try another start")
    return requirement


def _sigma(spec: Specification, phi: Array | None) -> Array:
    """(N,) Sigma = Delta_V^-1 = Phi^-1 - Delta_D^-1 in units of the usable damping; inf without a multiplier."""
    if phi is None:
        return np.full(spec.channels, np.inf)
    with np.errstate(divide="ignore"):
        return spec.usable / phi - 1


def _coupling(spec: Specification, gains: Array) -> SpringDamper:
    k, b = np.split(np.maximum(gains, 0.0), 2)
    return SpringDamper(k * spec.usable / spec.T, b * spec.usable)


def _start(spec: Specification, sigma: Array, start: SpringDamper | None) -> tuple[Array, int]:
    """The gains of the set nearest to `start`, or the stiffest of the set; and the number of SDPs, one."""
    N = spec.channels
    gains = cp.Variable(2 * N)
    objective = cp.Maximize(cp.sum(gains[:N]))
    if start is not None:
        wanted = np.concatenate([start.K * spec.T, start.B]) / np.tile(spec.usable, 2)
        objective = cp.Minimize(cp.norm(gains - wanted))
    problem = cp.Problem(objective, gain_sets(gains, spec.theta, sigma))
    try:
        solve(problem, "the set of gains")
    except Infeasible as error:
        line = (
            f"Theorem 4 admits no spring-damper with theta = {spec.theta}, psi = {spec.psi}, delta = {spec.delta}: "
            "use less psi, a softer environment or more device damping"
        )
        raise Infeasible(problem, error.results, line) from error
    return np.asarray(gains.value), 1


def _step(spec: Specification, sigma: Array, shaping: Shaping, at: Array, norm: float, w: Array) -> tuple[Array, float]:
    """(gains, bound on the norm at the frequencies w) of one convex-concave step from the gains `at`."""
    N = spec.channels
    gains, t = cp.Variable(2 * N), cp.Variable()
    constant, slopes = _tangent(spec, shaping, at, norm, w)
    cuts = affine_lmis(constant, slopes, cp.hstack([gains, t]))
    solve(cp.Problem(cp.Minimize(t), [*gain_sets(gains, spec.theta, sigma), *cuts]), "a step of the convex sequence")
    return np.asarray(gains.value), norm * float(np.sqrt(t.value))


def _tangent(spec: Specification, shaping: Shaping, at: Array, norm: float, w: Array) -> tuple[Complex, Complex]:
    """[[g0* g + g* g0 - g0* g0, (W1 L g W2)*], [W1 L g W2, t norm^2]], scaled to order one; t is the last variable."""
    N = spec.channels
    left, right, late = shaping.parts(w)
    difference = 1 - np.exp(-1j * w)
    basis = np.eye(N)[:, None, :] * np.ones((w.size, 1))  # (N, k, N): e_i at every frequency
    g = np.concatenate([basis, basis * difference[:, None]])  # (2N, k, N): diagonals of g by variable
    g0 = np.tensordot(at, g, axes=1)  # (k, N)
    scale = 1 / np.abs(g0)  # columns are divided by |g0|, rows by the norm
    rows = (left * (spec.T / spec.usable)) @ right * scale[:, None, :] / norm
    row_slopes = (late * g[:, :, None, :]) @ right * scale[:, None, :] / norm
    tangent = 2 * (np.conj(g0) * g).real * scale**2
    diagonal = np.eye(N)
    base = -np.broadcast_to(diagonal, (w.size, N, N)).astype(np.complex128)
    return gain_lmi(rows, row_slopes, base, tangent[..., None] * diagonal)
