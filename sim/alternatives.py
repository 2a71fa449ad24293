"""Comparison of couplings with the same devices and hands, from no coupling to the optimal one.

The couplings are none, the paper's gains for the paper's loop, and the spring-dampers for any passive environment and
for this environment. The optimal coupling is included if it is quick to find. Each coupling is assessed with its proof
and drives the same hands in the exact engine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from haptic_loop.controller.lti import Array
from haptic_loop.design.certificate import named
from haptic_loop.design.conditions import Condition
from haptic_loop.design.files import off_table
from haptic_loop.design.result import Requirement, finite
from haptic_loop.design.transparency import decibels, transparency
from haptic_loop.sim.accuracy import credible, force_error
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, Scenario, load
from haptic_loop.sim.stability import exact_growth, unstable
from haptic_loop.sim.trace import Trace

#: (kind, condition) in the order of the table -> largest total delay [samples] for which a design is quick
_ROWS: dict[tuple[str, str | None], float] = {
    ("none", None): math.inf,
    ("published", None): math.inf,
    ("spring-damper", "any-environment"): 200,
    ("spring-damper", "this-environment"): math.inf,
    ("optimal", "this-environment"): math.inf,
}
_QUICK = 2  # largest number of channels with an optimal coupling


@dataclass(frozen=True, eq=False)
class Alternative:
    """One coupling in the loop, or the reason why there is none."""

    coupling: str  # kind
    condition: str | None
    guarantee: str | None = off_table(default=None)
    dc_ratio: float | None = None  # share of the static stiffness that is felt
    rms_mismatch_db: float | None = None
    growth_rate_per_s: float | None = None  # of the exact loop
    force_error_percent: float | None = None  # as in a run's report; None where the loop grows or has walls
    required_damping: dict[str, tuple[float, ...]] = field(default_factory=dict)  # [N s/m], by condition
    reason: str | None = off_table("if given", None)  # why there is no such coupling
    requirements: dict[str, Requirement] | None = off_table("left out", None)
    trace: Trace | None = off_table("left out", None)  # of the exact engine
    ideal: Array | None = off_table("left out", None)  # (N, m) forces [N] of the ideal environment for trace's motion
    until_s: float | None = off_table("left out", None)  # time from which the trace is not credible

    @property
    def name(self) -> str:
        """The name in tables and pictures: for a spring-damper its condition."""
        if self.coupling == "spring-damper":
            return self.condition or ""
        return self.coupling

    def needs(self, condition: str) -> float | None:
        """Return required over available damping of the worst device; None if no damping is enough."""
        requirement = (self.requirements or {}).get(condition)
        if requirement is None:
            return None
        pairs = zip(requirement.required, requirement.available, strict=True)
        return finite(max(float(n) / float(a) if a else math.inf for n, a in pairs))


def alternatives(
    scenario: Scenario,
    case: str,
    progress: Callable[[int, int], None] = lambda done, of: None,
    also: Condition | None = None,
) -> list[Alternative]:
    """Run the scenario with each coupling that is possible in its loop.

    Scenarios with ranges get couplings for any environment only. Scenarios with walls get no optimal coupling, because
    it contains a linear model. `also` is a user's own condition; if given, it judges every coupling, too.

    Raises:
        InputError: the delays switch.
    """
    if scenario.switches:
        raise InputError("varying_delay: the table of couplings is for constant delays; give --coupling NAME,..")
    case = "I" if case == "none" else case
    rows = [row for row in _ROWS if _possible(scenario, case, *row)]
    designs = []
    for i, row in enumerate(rows):
        progress(i, len(rows))
        designs.append(_alternative(scenario, case, *row, also))
    return designs


def _possible(scenario: Scenario, case: str, kind: str, condition: str | None) -> bool:
    loop = scenario.loop(case)
    if kind == "published":
        return loop == load().loop(case)
    if condition and loop.ranges and named(condition).members(loop):
        return False
    if sum(loop.theta) + sum(loop.psi) > _ROWS[kind, condition]:
        return False
    return kind != "optimal" or (scenario.channels <= _QUICK and not scenario.environment.walls)


def _alternative(
    scenario: Scenario,
    case: str,
    kind: str,
    condition: str | None,
    also: Condition | None = None,
) -> Alternative:
    loop = scenario.loop(case)
    try:
        chosen = choose(scenario, case, kind, condition)
    except ValueError as error:
        return Alternative(kind, condition, reason=str(error))
    alone = scenario.replace(ranges=None) if scenario.ranges else scenario
    assessment = assessed(alone, case, replace(chosen, own=also or chosen.own))
    requirements = assessment.requirements
    simulation = assemble(scenario, chosen.coupling, assessment.force_limits.rho)
    felt = transparency(simulation.felt, simulation.E, loop.lam)
    growth = exact_growth(simulation)
    row = Alternative(
        kind,
        condition,
        guarantee=assessment.guarantee.words if assessment.guarantee else None,
        dc_ratio=finite(felt.dc_ratio),
        rms_mismatch_db=decibels(felt.rms_mismatch),
        growth_rate_per_s=finite(growth),
        required_damping={name: tuple(needs.required) for name, needs in requirements.items()},
        requirements=dict(requirements),
    )
    if scenario.environment.walls or simulation.friction:
        return row
    trace = run(simulation, "exact")
    alike, until = force_error(simulation, trace, loop.lam), credible(simulation, trace).until_s
    error = None if unstable(growth) else alike.error_percent
    return replace(row, force_error_percent=error, trace=trace, ideal=alike.ideal, until_s=until)
