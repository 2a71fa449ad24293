"""A coupling over frequency: singular values, the demand for damping, and what a hand perceives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller.coupling import Coupling, compliance
from controller.delay import delay
from controller.environment import environment
from controller.lti import Array, Lti
from controller.process import force_map
from design.assess import theorem4_requirement
from design.condition.delayed import delayed_demand
from design.condition.demand import closed_loop_demand, theorem4_demand
from design.frequency.sweep import Response, frequencies, on_circle
from design.margin import Requirement, closed_loop
from design.store import Loop

LOWEST_HZ = 0.1
FEEL_HZ = (1.0, 10.0)  # where perceived stiffness and damping are quoted


@dataclass(frozen=True, eq=False)
class Perceived:
    """The effective impedance of one channel with the others held still: x -> f read as a spring and a damper."""

    stiffness: Array  # (k, m) Re G_ii [N/m]
    damping: Array  # (k, m) Im G_ii / omega [N s/m]; below zero where motion is fed


@dataclass(frozen=True, eq=False)
class Judged:
    """A coupling in its loop, with what both conditions ask of the devices."""

    F: Lti
    requirements: dict[str, Requirement]
    demands: dict[str, Response | None]  # w -> required over available damping; None where no damping helps


@dataclass(frozen=True, eq=False)
class Curves:
    """One coupling at the frequencies `hz` of its picture."""

    sigma_F: Array  # (k, m) singular values of F [N/m], largest first
    sigma_M: Array  # (k, m) of the mismatch F - Lambda E [N/m]
    perceived: Perceived
    demands: dict[str, Array | None]  # (k,) required over available damping


def judge(loop: Loop, coupling: Coupling, phi: Array | None = None) -> Judged:
    """Both conditions of a coupling, as figures and over frequency. Raises SingularLoop."""
    E = environment(loop.environment, loop.T)
    F = force_map(E, coupling, loop.theta, loop.psi)
    phi = _multiplier(loop, E, coupling) if phi is None and any(loop.psi) else phi
    requirements = {
        "closed-loop": closed_loop(F, loop.delta),
        "theorem4": theorem4_requirement(coupling, E, loop.theta, loop.psi, loop.delta, phi),
    }
    demands: dict[str, Response | None] = dict.fromkeys(requirements)
    if np.isfinite(requirements["closed-loop"].ratio):
        demands["closed-loop"] = closed_loop_demand(F, loop.delta)
    V = compliance(coupling, loop.T)
    if V is not None and np.isfinite(requirements["theorem4"].ratio):
        if any(loop.psi):
            assert phi is not None  # a finite figure had a multiplier
            demands["theorem4"] = delayed_demand(V, loop.theta, np.asarray(loop.delta), phi)
        else:
            demands["theorem4"] = theorem4_demand(V, loop.theta, loop.delta)
    return Judged(F, requirements, demands)


def grid(loop: Loop, couplings: Sequence[Judged], low_hz: float = LOWEST_HZ) -> Array:
    """Frequencies [Hz] up to Nyquist's, dense around every pole, with FEEL_HZ and where conditions bind."""
    per_hz = 2 * np.pi * loop.T
    systems = (environment(loop.environment, loop.T), *(judged.F for judged in couplings))
    even = frequencies(*systems, low=low_hz * per_hz, high=np.pi, points=200) / per_hz
    binding = [r.frequency_hz for judged in couplings for r in judged.requirements.values()]
    wanted = (*FEEL_HZ, *(hz for hz in binding if hz is not None))
    return np.unique([*even, *(hz for hz in wanted if low_hz <= hz <= even[-1])])


def curves(loop: Loop, judged: Judged, hz: Array) -> Curves:
    """The curves of one coupling at `hz` (k,)."""
    w = 2 * np.pi * hz * loop.T
    z = on_circle(w)
    E = environment(loop.environment, loop.T)
    target = (delay(loop.lam, loop.T) @ E).at(z)
    F = judged.F.at(z)
    demands = {name: None if demand is None else demand(w) for name, demand in judged.demands.items()}
    return Curves(singular_values(F), singular_values(F - target), perceived(F, hz), demands)


def ideal(loop: Loop, hz: Array) -> tuple[Array, Perceived]:
    """Singular values of E (k, m) [N/m] and its effective impedance: what an undelayed loop without coupling gives."""
    E = environment(loop.environment, loop.T).at(on_circle(2 * np.pi * hz * loop.T))
    return singular_values(E), perceived(E, hz)


def singular_values(G: NDArray[np.complex128]) -> Array:
    """(k, m, m) -> (k, m), largest first."""
    return np.linalg.svd(G, compute_uv=False)


def perceived(G: NDArray[np.complex128], hz: Array) -> Perceived:
    """The diagonal of displacement-to-force responses (k, m, m) at `hz` (k,) > 0 as stiffness and damping."""
    own = np.diagonal(G, axis1=1, axis2=2)
    return Perceived(own.real, own.imag / (2 * np.pi * hz)[:, None])


def _multiplier(loop: Loop, E: Lti, coupling: Coupling) -> Array | None:
    """The least multiplier of Theorem 4 for an environment with delay inside, None where there is none."""
    if compliance(coupling, loop.T) is None:
        return None
    from design.semidefinite.multiplier import shortage  # takes the solver
    from design.specification import Specification

    try:
        return shortage(Specification(E, loop.theta, loop.psi, loop.lam, loop.delta))
    except ValueError:
        return None  # theorem4_requirement says why
