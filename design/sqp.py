"""Sequential quadratic programming: a smooth function under smooth inequalities, from one start to a local optimum.

Each step solves a quadratic program with the linearised inequalities and a damped BFGS matrix, then searches along its
direction with an exact penalty (D. Kraft, DFVLR-FB 88-28, 1988; M. J. D. Powell, 1978). SciPy has the same method as
SLSQP, but loading scipy.optimize takes longer than a whole design.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from haptic_loop.controller.lti import Array

_ROUNDING = 1e-12  # relative size of a step, a slack or a direction that counts as zero
_DESCENT = 0.1  # share of the predicted descent that a step must reach, and least factor by which a step is cut
_DAMPED = 0.2  # least curvature that an update may leave, relative to that of the BFGS matrix
_CUTS, _RESETS = 10, 5  # step lengths tried in one direction, and restarts of the BFGS matrix
_ELASTIC = 1e4  # weight of the share of violated inequalities that a step leaves, where it cannot satisfy them


@dataclass(frozen=True, eq=False)
class Optimum:
    """The last point (n,), and the BFGS matrix (n, n) with which another search may go on from there."""

    x: Array
    curvature: Array
    steps: int


def minimise(
    objective: Callable[[Array], float],
    slope: Callable[[Array], Array],
    room: Callable[[Array], Array],
    room_slope: Callable[[Array], Array],
    start: Array,
    bounds: tuple[Array, Array],
    most: int,
    tolerance: float,
    curvature: Array | None = None,
) -> Optimum:
    """Minimise `objective` where `room` (k,) >= 0 and bounds[0] <= x <= bounds[1] (n,).

    Args:
        objective: The function of x (n,).
        slope: Its gradient (n,).
        room: The inequalities (k,).
        room_slope: Their gradients (k, n).
        start: The first point, which may violate the inequalities.
        bounds: The least and the largest x.
        most: Largest number of steps.
        tolerance: Change of the objective, and violation, at which the search ends.
        curvature: The BFGS matrix of an earlier search; None for the identity.

    Returns:
        The last point. It may violate the inequalities where the search ended early.
    """
    low, high = bounds
    x = np.clip(start, low, high)
    one = np.eye(x.size)
    H = one if curvature is None else curvature
    f, g, c, J = objective(x), slope(x), room(x), room_slope(x)
    penalty, resets, active, steps = np.zeros(c.size), 0, [], 0
    while steps < most:
        steps += 1
        rows, least = np.vstack([J, one, -one]), -np.concatenate([c, x - low, high - x])
        d, multipliers, active = quadratic(H, g, rows, least, active) or _elastic(H, g, rows, least)
        u, violated = multipliers[: c.size], np.maximum(-c, 0.0)
        if abs(g @ d) + u @ np.abs(c) < tolerance and violated.sum() < tolerance:
            break
        penalty = np.maximum(u, (penalty + u) / 2)
        descent = g @ d - penalty @ violated
        if descent >= 0 or not d.any():
            if resets == _RESETS:
                break
            H, resets, active = one, resets + 1, []
            continue
        merit, share, moved, f_new, c_new = f + penalty @ violated, 1.0, x, f, c
        for _ in range(_CUTS):
            moved = np.clip(x + share * d, low, high)
            f_new, c_new = objective(moved), room(moved)
            change = f_new + penalty @ np.maximum(-c_new, 0.0) - merit
            if change <= _DESCENT * share * descent:
                break
            expected = share * descent
            share *= max(expected / (2 * (expected - change)), _DESCENT) if np.isfinite(change) else _DESCENT
        before, lagrange = f, g - u @ J
        s, x, f, c = moved - x, moved, f_new, c_new
        if (abs(f - before) < tolerance or np.linalg.norm(s) < tolerance) and np.maximum(-c, 0).sum() < tolerance:
            break
        g, J = slope(x), room_slope(x)
        H = _updated(H, s, g - u @ J - lagrange)
    return Optimum(x, H, steps)


def _updated(H: Array, s: Array, y: Array) -> Array:
    """Return the BFGS matrix after a step s with the change y of the Lagrangian's gradient, damped to stay positive."""
    Hs = H @ s
    own, seen = s @ Hs, s @ y
    if own <= 0:
        return np.eye(s.size)
    if seen < _DAMPED * own:
        share = (1 - _DAMPED) * own / (own - seen)
        y, seen = share * y + (1 - share) * Hs, _DAMPED * own
    H = H + np.outer(y, y) / seen - np.outer(Hs, Hs) / own
    values = np.linalg.eigvalsh(H)
    return H if values[0] > _ROUNDING * values[-1] else np.eye(s.size)


def _elastic(H: Array, g: Array, rows: Array, least: Array) -> tuple[Array, Array, list[int]]:
    """Return the step that leaves as small a share of the violated inequalities as possible, or no step."""
    n = g.size
    wide = np.zeros((n + 1, n + 1))
    wide[:n, :n], wide[n, n] = H, _ELASTIC * max(np.abs(H).max(), 1.0)
    left = np.hstack([rows, np.maximum(least, 0.0)[:, None]])
    ends = np.eye(2, n + 1, k=n) - np.eye(2, n + 1, k=n - 1)  # the share from 0 to 1
    solution = quadratic(wide, np.append(g, 0.0), np.vstack([left, ends]), np.append(least, [0.0, -1.0]), [])
    if solution is None:  # rounding
        return np.zeros(n), np.zeros(least.size), []
    return solution[0][:n], solution[1][: least.size], []


def quadratic(
    H: Array, g: Array, rows: Array, least: Array, active: list[int]
) -> tuple[Array, Array, list[int]] | None:
    """Minimise g'd + d'Hd/2 where rows d >= least, by the dual method of Goldfarb and Idnani (1983).

    Args:
        H: A positive definite matrix (n, n).
        g: The gradient (n,).
        rows: The inequalities' coefficients (k, n).
        least: Their right-hand side (k,).
        active: The inequalities that were active in a similar problem; the method starts there if it may.

    Returns:
        d (n,), the multipliers (k,) and the active inequalities; None where the inequalities have no common point.
    """
    into = np.linalg.inv(np.linalg.cholesky(H)).T  # H^-1 = into into'
    free, turned = -into.T @ g, rows @ into  # in coordinates in which H is the identity
    size = np.sqrt((turned**2).sum(axis=1))
    small = _ROUNDING * (np.abs(least) + size + 1)
    active, d, u = _warm(free, turned, least, active)
    for _ in range(10 * (len(least) + g.size)):
        slack = turned @ d - least
        slack[active] = 0.0
        worst = int(np.argmin(slack / (size + 1e-300)))
        if slack[worst] >= -small[worst]:
            multipliers = np.zeros(len(least))
            multipliers[active] = u
            return into @ d, multipliers, active
        own = 0.0
        while True:
            N = turned[active]
            if active:
                Q, R = np.linalg.qr(N.T)
                along = np.linalg.solve(R, Q.T @ turned[worst])
                z = turned[worst] - Q @ (Q.T @ turned[worst])
            else:
                along, z = np.zeros(0), turned[worst]
            falls = np.flatnonzero(along > 0)
            ratios = u[falls] / along[falls]
            first = falls[np.argmin(ratios)] if falls.size else -1
            dual = ratios.min() if falls.size else np.inf
            moves = len(active) < g.size and z @ z > (_ROUNDING * size[worst]) ** 2
            primal = (least[worst] - turned[worst] @ d) / (z @ z) if moves else np.inf
            t = min(dual, primal)
            if not np.isfinite(t):
                return None
            u, own = u - t * along, own + t
            if moves:
                d = d + t * z
            if primal <= dual:
                active, u = [*active, worst], np.append(u, own)
                break
            active, u = active[:first] + active[first + 1 :], np.delete(u, first)
    return None  # rounding keeps the same inequalities coming and going


def _warm(free: Array, turned: Array, least: Array, active: list[int]) -> tuple[list[int], Array, Array]:
    """Return a start of the dual method: the optimum on the active inequalities that keep a positive multiplier."""
    while active:
        N = turned[active]
        try:
            u = np.linalg.solve(N @ N.T, least[active] - N @ free)
        except np.linalg.LinAlgError:
            break
        if (u >= 0).all():
            return active, free + N.T @ u, u
        active = [i for i, value in zip(active, u, strict=True) if value > 0]
    return [], free, np.zeros(0)
