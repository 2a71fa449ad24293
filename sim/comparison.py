"""Comparison of couplings: with the same devices and hands (`alternatives`), and over frequency (`Comparison`).

The alternatives are: no coupling, the paper's gains (in the paper's loop only), the spring-dampers for any passive
environment and for this environment, and the optimal coupling if it is quick to find. In loops without walls and
friction, the exact engine also runs each alternative with the same hands. `Comparison` compares couplings of the user's
choice over frequency by required damping, robustness and felt impedance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design import compare
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import named
from haptic_loop.design.conditions import Condition
from haptic_loop.design.coverage import Robustness, robustness_nearby
from haptic_loop.design.files import off_table
from haptic_loop.design.result import Chosen, Requirement, finite
from haptic_loop.design.transparency import decibels, transparency
from haptic_loop.sim.accuracy import credible, force_error
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, Scenario, load
from haptic_loop.sim.stability import exact_growth, unstable
from haptic_loop.sim.trace import Trace

#: rows (kind, condition) of the table -> largest total delay [samples] for which the design is quick
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
    """One coupling in the loop, or the reason why there is none.

    With walls, ratio and mismatch are for all walls touched, and growth is the largest for any set of touched walls.
    """

    coupling: str  # kind of the coupling
    condition: str | None  # the condition of the design; None for no coupling and for the paper's gains
    guarantee: str | None = off_table(default=None)
    dc_ratio: float | None = None  # share of the static stiffness that is felt
    rms_mismatch_db: float | None = None
    growth_rate_per_s: float | None = None  # growth of the exact loop
    force_error_percent: float | None = None  # None if the loop is unstable, or has walls or friction
    required_damping: dict[str, tuple[float, ...]] = field(default_factory=dict)  # [N s/m], by condition
    reason: str | None = off_table("if given", None)  # why there is no such coupling
    requirements: dict[str, Requirement] | None = off_table("left out", None)
    trace: Trace | None = off_table("left out", None)  # the exact engine's run
    ideal: Array | None = off_table("left out", None)  # (N, m) ideal forces [N] for the motion of `trace`
    until_s: float | None = off_table("left out", None)  # time from which the devices' linear model is not credible

    @property
    def name(self) -> str:
        """The name in tables and pictures: the condition of a spring-damper, or the kind of another coupling."""
        if self.coupling == "spring-damper":
            return self.condition or ""
        return self.coupling

    def needs(self, condition: str) -> float | None:
        """Return required over available damping of the worst channel; None if it is infinite or was not computed."""
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
    """Return the assessments of the couplings of `_ROWS` that are possible in the loop.

    Without walls and friction, the couplings also run. Scenarios with walls get no optimal coupling, because it
    contains a linear model. If `also`, a user's own condition, is given, it is evaluated for every coupling.

    Raises:
        InputError: The delays switch.
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
    figures = transparency(simulation.felt, simulation.E, loop.lam)
    growth = exact_growth(simulation)
    row = Alternative(
        kind,
        condition,
        guarantee=assessment.guarantee_words,
        dc_ratio=finite(figures.dc_ratio),
        rms_mismatch_db=decibels(figures.rms_mismatch),
        growth_rate_per_s=finite(growth),
        required_damping={name: tuple(needs.required) for name, needs in requirements.items()},
        requirements=dict(requirements),
    )
    if scenario.environment.walls or simulation.friction:
        return row
    trace = run(simulation, "exact")
    forces, until = force_error(simulation, trace, loop.lam), credible(simulation, trace).until_s
    error = None if unstable(growth) else forces.error_percent
    return replace(row, force_error_percent=error, trace=trace, ideal=forces.ideal, until_s=until)


# ---- couplings over frequency


@dataclass(frozen=True, eq=False)
class ConditionCurve:
    """The damping that one condition requires of a coupling, over frequency."""

    requirement: Requirement = off_table("inlined")
    ratio: float = off_table()  # largest required over available damping
    demand: Array | None = off_table()  # required over available damping at each frequency
    reason: str | None = off_table("if given")


@dataclass(frozen=True, eq=False)
class ComparedCoupling:
    """One coupling, with its curves for the pictures."""

    name: str
    kind: str
    states: int  # order of F
    assessment: Assessment
    robustness: Robustness | None = off_table()
    curves: compare.Curves = off_table("inlined")
    conditions: dict[str, ConditionCurve] = off_table()

    @classmethod
    def of(
        cls, loop: Loop, name: str, chosen: Chosen, assessment: Assessment, judged: compare.Demands, hz: Array
    ) -> ComparedCoupling:
        """Return one coupling with its curves at the frequencies `hz` (k,) [Hz]."""
        curves, conditions = compare.curves(loop, judged, hz), {}
        for key, requirement in judged.requirements.items():
            demand, reason = curves.demands[key], requirement.reason
            if demand is None:
                reason = reason or f"this coupling has no compliance V, so there is no curve for {key}"
            conditions[key] = ConditionCurve(requirement, requirement.ratio, demand, reason)
        return cls(
            name,
            chosen.kind,
            judged.F.order,
            assessment,
            robustness_nearby(loop, chosen.coupling),
            curves,
            conditions,
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several couplings over frequency, in SI units. A figure that is infinite or does not exist is null in JSON."""

    case: str
    scenario: str
    T_s: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    lam: tuple[int, ...]
    available_damping: tuple[float, ...]  # (m,) [N s/m]
    frequency_hz: Array  # (k,)
    sigma_E: Array  # (k, m) singular values of E [N/m]
    ideal: compare.Perceived  # what users would feel of E itself
    couplings: list[ComparedCoupling]
    notes: list[str]
    names: tuple[str, ...] = off_table("left out", ())  # (m,) names of channels if devices have several axes; else ()

    @property
    def conditions(self) -> list[str]:
        """Names of the conditions for which every coupling's required damping is computed."""
        return [*self.couplings[0].conditions]

    @classmethod
    def of(cls, scenario: Scenario, case: str, chosen: Mapping[str, Chosen], failed: Sequence[str]) -> Comparison:
        """Return the comparison of the couplings `chosen`, by name; `failed` has a sentence for each failed design."""
        loop = scenario.loop(case)
        own = {c.condition: c.own for c in chosen.values() if c.own}
        alone = scenario.replace(ranges=None) if scenario.ranges else scenario  # curves show the nominal environment
        assessments = {name: assessed(alone, case, c) for name, c in chosen.items()}
        judged = {
            name: compare.judge(loop, c.coupling, [*own.values()], assessments[name].requirements)
            for name, c in chosen.items()
        }
        hz = compare.grid(loop, list(judged.values()))
        short = [Path(name).name for name in chosen]
        shown = short if len(set(short)) == len(short) else [*chosen]  # Equal file names get their paths.
        couplings = [
            ComparedCoupling.of(loop, label, c, assessments[name], judged[name], hz)
            for label, (name, c) in zip(shown, chosen.items(), strict=True)
        ]
        notes = [
            *(f"{name}: {note}" for name, c in chosen.items() for note in c.remarks(judged[name].requirements)),
            *failed,
        ]
        for c in couplings:
            notes += [f"{c.name}, {name}: {each.reason}" for name, each in c.conditions.items() if each.reason]
        about = case, scenario.name, loop.T, loop.theta, loop.psi, loop.lam, loop.delta
        return cls(*about, hz, *compare.ideal(loop, hz), couplings, notes, scenario.channel_names)
