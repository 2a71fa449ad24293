"""Evaluate couplings over frequency: singular values, required damping, and perceived stiffness and damping."""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("compare")

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.design.conditions import Condition
from haptic_loop.design.environments import ANY_ENVIRONMENT, SWITCHING, THIS_ENVIRONMENT
from haptic_loop.design.frequency import Response, frequencies, on_circle
from haptic_loop.design.result import Requirement

_LOWEST_HZ = 0.1  # lowest frequency of a picture
FEEL_HZ = (1.0, 10.0)  # frequencies of the table of perceived stiffness and damping


@dataclass(frozen=True, eq=False)
class Perceived:
    """The effective impedance of each channel with the other channels held still, as a spring and a damper."""

    stiffness: Array  # (k, m) Re G_ii [N/m]
    damping: Array  # (k, m) Im G_ii / omega [N s/m]; negative if the loop adds energy to the motion


@dataclass(frozen=True, eq=False)
class Demands:
    """The force map F of a coupling in its loop, with the requirement of each condition."""

    F: Lti
    requirements: dict[str, Requirement]
    demands: dict[str, Response | None]  # condition -> function of w: required over available damping; None: no curve


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves of one coupling at the frequencies of a picture."""

    sigma_F: Array  # (k, m) singular values of F [N/m], largest first
    sigma_M: Array  # (k, m) singular values of the mismatch F - Lambda E [N/m]
    perceived: Perceived
    demands: dict[str, Array | None] = field(metadata={"json": "left out"})  # (k,) required over available damping


def judge(
    loop: Loop, coupling: Coupling, own: Sequence[Condition] = (), known: Mapping[str, Requirement] | None = None
) -> Demands:
    """Return F with all walls touching, and the requirement and the required damping over frequency of each condition.

    The conditions are this-environment (for delays that switch: switching), any-environment and a user's `own`. `known`
    holds requirements from an assessment of this loop and coupling. Raises SingularLoop if the algebraic loop has no
    solution.
    """
    F, known = loop.F(coupling), known or {}
    here = loop.at(loop.environment)
    requirements: dict[str, Requirement] = {}
    demands: dict[str, Response | None] = {}
    for each in (SWITCHING if loop.varying_delay else THIS_ENVIRONMENT, ANY_ENVIRONMENT, *own):
        needs = requirements[each.name] = known.get(each.name) or each.judge(here, coupling)
        curve = each.over_frequency(here, coupling, needs.multiplier) if np.isfinite(needs.ratio) else None
        demands[each.name] = curve
    return Demands(F, requirements, demands)


def grid(loop: Loop, couplings: Sequence[Demands]) -> Array:
    """Return frequencies [Hz] up to 1/(2 T), dense around poles, and with FEEL_HZ and the binding frequencies."""
    per_hz = 2 * np.pi * loop.T
    systems = (loop.E(), *(judged.F for judged in couplings))
    even = frequencies(*systems, low=_LOWEST_HZ * per_hz, high=np.pi, points=200) / per_hz
    binding = [r.frequency_hz for judged in couplings for r in judged.requirements.values()]
    shown = (*FEEL_HZ, *(hz for hz in binding if hz is not None))
    return np.unique([*even, *(hz for hz in shown if _LOWEST_HZ <= hz <= even[-1])])


def curves(loop: Loop, judged: Demands, hz: Array) -> Curves:
    """Return the curves of one coupling at `hz` (k,)."""
    w = 2 * np.pi * hz * loop.T
    z = on_circle(w)
    E = loop.E()
    target = (delay(loop.lam, loop.T) @ E).at(z)
    F = judged.F.at(z)
    demands = {name: None if demand is None else demand(w) for name, demand in judged.demands.items()}
    return Curves(_singular_values(F), _singular_values(F - target), perceived(F, hz), demands)


def ideal(loop: Loop, hz: Array) -> tuple[Array, Perceived]:
    """Return the singular values (k, m) [N/m] and the effective impedance of E, the undelayed loop without coupling."""
    E = loop.E().at(on_circle(2 * np.pi * hz * loop.T))
    return _singular_values(E), perceived(E, hz)


def _singular_values(G: NDArray[np.complex128]) -> Array:
    return np.linalg.svd(G, compute_uv=False)


def perceived(G: NDArray[np.complex128], hz: Array) -> Perceived:
    """Return the diagonal entries of responses from displacements to forces (k, m, m) as stiffness and damping."""
    own = np.diagonal(G, axis1=1, axis2=2)
    return Perceived(own.real, own.imag / (2 * np.pi * hz)[:, None])
