"""Who holds which device (Remark 1): weights that the closed-loop condition may use where humans are separate.

Each human is passive by himself, so the energy of each may be weighed by a positive d of his own, the same for all
devices that he holds:
    He[d F/(z-1)] > -d Delta_D/T,   d F(1) symmetric positive semidefinite.
That is the plain condition for the force map d F and the dampings d delta. Where F(1) joins two channels, symmetry
forces their weights to be equal. And where F is reciprocal, F = Theta S with S = S', no weights buy anything: with
U^2 = Theta, X = U* F U = U S U is symmetric, so for a real diagonal D the real part of D X D^-1 has the eigenvalues of
Re X, and the Hermitian part of a real matrix reaches at least as far as its real eigenvalues. A network of springs,
dampers and masses behind a diagonal coupling is reciprocal; a coupling that passes force one way only is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.optimize import minimize

from controller.coupling import Coupling
from controller.environment import Network
from controller.lti import Array, Lti
from design import exact
from design.certificate import certificate_part
from design.conditions import Requirement, closed_loop
from design.exact import Exact, Matrix, SingularMatrix, definiteness, find_storage, rational, too_large
from design.frequency import on_circle

RECIPROCAL = 1e-6  # relative difference of |F_ij| and |F_ji| that is taken for rounding
LARGEST_RATIO = 1e4  # between two weights


def weighted(F: Lti, d: Array) -> Lti:
    """d F."""
    return Lti.constant(np.diag(d), F.T) @ F


def shared_weights(F1: Array, holders: Sequence[int]) -> list[list[int]]:
    """Channels that must have one weight: held by one human, or joined by the static stiffness F(1)."""
    groups = [[i for i, h in enumerate(holders) if h == holder] for holder in dict.fromkeys(holders)]
    scale = max(float(np.abs(F1).max(initial=0.0)), 1e-300)
    for i, j in np.argwhere(np.abs(F1) > 1e-9 * scale):
        one, other = (next(g for g in groups if c in g) for c in (i, j))
        if one is not other:
            groups.remove(other)
            one.extend(other)
    return [sorted(group) for group in groups]


def reciprocal(F: Lti) -> bool:
    """Whether |F_ij| = |F_ji| over frequency, as in F = Theta S with S symmetric."""
    size = np.abs(F.at(on_circle(np.geomspace(1e-3, np.pi, 60))))
    difference = np.abs(size - np.swapaxes(size, 1, 2)).max(axis=(1, 2))
    return bool((difference <= RECIPROCAL * size.max(axis=(1, 2))).all())


def proved(F: Exact, delta: Sequence[float], d: Sequence[float], T: float) -> bool:
    """Whether the weighted condition is proved in exact arithmetic; F is the exact force map."""
    if too_large(F):
        return False
    try:
        static, R = (Exact.constant(Matrix.diag(d)) @ F).split_at_one()
    except SingularMatrix:
        return False
    if not static.equals(static.T) or not definiteness(static).semidefinite:
        return False
    damping = Matrix.diag(rational(w) * rational(b) / rational(T) for w, b in zip(d, delta, strict=True))
    return find_storage(Exact(R.A, R.B, R.C, damping - static.scaled(Fraction(1, 2))))[0] is not None


def separate_humans_part(
    F: Lti,
    delta: Sequence[float],
    holders: Sequence[int],
    coupling: Coupling,
    network: Network,
    delays: tuple[Sequence[int], Sequence[int]],
) -> dict[str, Any]:
    """The requirement for these holders as plain data, proved exactly where that is possible; delays (theta, psi)."""
    requirement, d = closed_loop_of_separate_humans(F, delta, holders)
    if requirement.certified:
        period = rational(F.T)
        whole = exact.force_map(exact.environment(network, period), coupling, *delays, period)
        if proved(whole, delta, d, F.T):
            requirement = replace(requirement, proof="rational")
    return certificate_part(requirement) | {"holders": list(holders), "weights": list(d)}


def closed_loop_of_separate_humans(
    F: Lti, delta: Sequence[float], holders: Sequence[int]
) -> tuple[Requirement, tuple[float, ...]]:
    """(the closed-loop requirement with the best weights found, the weights (m,)); `holders` names each device's human.

    A local search from equal weights over their logarithms: what it returns is a valid requirement, not proved least.
    """
    m = F.inputs
    plain, equal = closed_loop(F, delta), (1.0,) * m
    if not F.is_stable():
        return plain, equal
    groups = shared_weights(F.dc(), holders)
    if len(groups) == 1 or reciprocal(F):
        return plain, equal

    def weights(logarithms: Array) -> Array:
        d = np.ones(m)
        for group, value in zip(groups[1:], logarithms, strict=True):
            d[group] = np.exp(value)
        return d

    def ratio(logarithms: Array) -> float:
        d = weights(logarithms)
        return closed_loop(weighted(F, d), tuple(d * delta)).ratio

    bound = np.log(LARGEST_RATIO)
    start = np.zeros(len(groups) - 1)
    options = {"xatol": 1e-4, "fatol": 1e-7, "maxfev": 200 * start.size}
    found = minimize(ratio, start, method="Nelder-Mead", bounds=[(-bound, bound)] * start.size, options=options)
    if not found.fun < plain.ratio:
        return plain, equal
    d = np.round(weights(found.x), 6)
    best = closed_loop(weighted(F, d), tuple(d * delta))
    required = tuple(best.ratio * value for value in plain.available)
    return replace(best, required=required, available=plain.available), tuple(d.tolist())
