"""Spring-damper couplings (26): the best under either condition, and the stiffest under Theorem 4.

Gains are handled in units of the usable damping d = (1 - RESERVE) delta: k = KT/d, b = B/d (design.gains.gain_set).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

import cvxpy as cp
import numpy as np

from controller.coupling import SpringDamper
from controller.lti import Array
from controller.process import force_map
from design.condition.delayed import theorem4_delayed
from design.failure import DesignFailed, Infeasible
from design.gains.convex_concave import step
from design.gains.frozen_environment import least_rms
from design.gains.gain_set import solve_within
from design.gains.switching_search import least_rms_switching
from design.margin import Requirement, closed_loop, theorem4
from design.result import Design
from design.semidefinite.multiplier import shortage
from design.shaping import Shaping
from design.solve import solved
from design.specification import Specification

#: The sequence stops when a step improves the norm by less than this, relatively.
SETTLED = 1e-6
MOST_STEPS = 60
#: A damper of less than this share of the device's damping is none: solvers leave 1e-9 where the optimum has zero.
NEGLIGIBLE = 1e-6


def design(
    spec: Specification,
    condition: str = "theorem4",
    starts: Sequence[SpringDamper] = (),
    switching: tuple[Sequence[int], Sequence[int]] | None = None,
) -> Design:
    """The best spring-damper under `condition`; by default the starts are chosen, a start need not be feasible.

    theorem4: minimises ||W1 L W2||_inf (23) over the exact set; the result does not depend on the start (the first
    one is used). closed-loop: minimises the rms mismatch in this environment from every start, local optima only; with
    `switching` = (lo, hi) [samples] also safe under any switching of the forces' delays within it (design.jitter).
    Raises Infeasible where Theorem 4 admits no gains, DesignFailed where the search finds none for closed-loop.
    """
    if condition == "theorem4" and switching is None:
        return _for_any_environment(spec, starts[0] if starts else None)
    if condition == "closed-loop":
        return _for_this_environment(spec, starts, switching)
    if switching:
        raise ValueError("delays that vary are designed for by the closed-loop condition only")
    raise ValueError(f"condition is {condition!r}, expected 'theorem4' or 'closed-loop'")


def _for_any_environment(spec: Specification, start: SpringDamper | None) -> Design:
    started = time.perf_counter()
    phi = shortage(spec)
    sigma = excess_limits(spec, phi)
    shaping = Shaping(spec)
    gains, sdps = _start(spec, sigma, start)
    norm, peak = shaping.norm(_coupling(spec, gains).compliance(spec.T))
    frequencies = [peak]
    for _ in range(MOST_STEPS):
        gains, bound = step(spec, sigma, shaping, gains, norm, np.array(frequencies))
        sdps += 1
        before, (norm, peak) = norm, shaping.norm(_coupling(spec, gains).compliance(spec.T))
        frequencies.append(peak)
        if abs(before - norm) < SETTLED * norm and norm < (1 + SETTLED) * bound:
            break
    coupling = _coupling(spec, gains)
    requirement = verified(spec, coupling, phi)
    return Design(coupling, "theorem4", "loop-norm", norm, requirement, sdps, time.perf_counter() - started, phi)


def _for_this_environment(
    spec: Specification, starts: Sequence[SpringDamper], switching: tuple[Sequence[int], Sequence[int]] | None
) -> Design:
    started, starts = time.perf_counter(), starts or _default_starts(spec)
    search = partial(least_rms_switching, spec, *switching) if switching else partial(least_rms, spec)
    coupling, rms, searches = search(starts)
    if coupling is None:
        certifies = "the closed-loop condition certifies"
        if switching:
            certifies += f" under any switching from {tuple(switching[0])} to {tuple(switching[1])} samples"
        line = (
            f"no spring-damper was found that {certifies} for theta = {spec.theta}, psi = {spec.psi}, "
            f"delta = {spec.delta}: use more device damping, less delay, or other starts"
        )
        raise DesignFailed(None, (), line)
    coupling = SpringDamper(coupling.K, np.where(NEGLIGIBLE * spec.usable > coupling.B, 0.0, coupling.B))
    F = force_map(spec.environment, coupling, spec.theta, spec.psi)
    requirement = closed_loop(F, spec.delta)
    return Design(coupling, "closed-loop", "rms", rms, requirement, searches, time.perf_counter() - started)


def _default_starts(spec: Specification) -> list[SpringDamper]:
    """Around 2 d/(n T), the stiffness that no linear coupling exceeds for any passive environment.

    With delay in the environment a loop is stable if the coupling is the stiffer of the two at every frequency,
    which the last start takes from the environment's stiffness at half the sampling rate.
    """
    usable = spec.usable
    K = usable / (spec.T * (np.asarray(spec.theta) + np.asarray(spec.psi) + 1))
    starts = [SpringDamper(factor * K, share * usable) for factor, share in ((0.3, 0.1), (1.0, 0.3), (8.0, 1.0))]
    if any(spec.psi):
        highest = np.linalg.norm(spec.environment.at(-1.0), 2)
        starts.append(SpringDamper(K, np.full(spec.channels, spec.T * highest)))
    return starts


def stiffest(spec: Specification) -> Design:
    """The gains of largest total stiffness (each channel's own largest) that satisfy Theorem 4; objective in N/m."""
    started = time.perf_counter()
    phi = shortage(spec)
    gains, sdps = _start(spec, excess_limits(spec, phi), None)
    coupling = _coupling(spec, gains)
    requirement = verified(spec, coupling, phi)
    total = float(coupling.K.sum())
    return Design(coupling, "theorem4", "stiffness", total, requirement, sdps, time.perf_counter() - started, phi)


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


def excess_limits(spec: Specification, phi: Array | None) -> Array:
    """(N,) Sigma = Delta_V^-1 = Phi^-1 - Delta_D^-1 in units of the usable damping; inf without a multiplier."""
    if phi is None:
        return np.full(spec.channels, np.inf)
    with np.errstate(divide="ignore"):
        return spec.usable / phi - 1


def _coupling(spec: Specification, gains: Array) -> SpringDamper:
    k, b = np.split(np.maximum(gains, 0.0), 2)
    return SpringDamper(k * spec.usable / spec.T, np.where(b < NEGLIGIBLE, 0.0, b) * spec.usable)


def _start(spec: Specification, sigma: Array, start: SpringDamper | None) -> tuple[Array, int]:
    """The gains of the set nearest to `start`, or the stiffest of the set; and the number of SDPs, one."""
    N = spec.channels
    gains = cp.Variable(2 * N)
    objective = cp.Maximize(cp.sum(gains[:N]))
    if start is not None:
        wanted = np.concatenate([start.K * spec.T, start.B]) / np.tile(spec.usable, 2)
        objective = cp.Minimize(cp.norm(gains - wanted))
    try:
        solve_within(objective, gains, spec.theta, sigma, "the set of gains")
    except Infeasible as error:
        line = (
            f"Theorem 4 admits no spring-damper with theta = {spec.theta}, psi = {spec.psi}, delta = {spec.delta}: "
            "use less psi, a softer environment or more device damping"
        )
        raise Infeasible(error.problem, error.results, line) from error
    return solved(gains), 1
