"""Comparison of couplings over frequency: required damping, robustness and felt impedance of each, with curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design import compare
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.files import off_table
from haptic_loop.design.result import PLAIN_CONDITIONS, Chosen, Requirement
from haptic_loop.design.robustness import Robustness, robustness_nearby
from haptic_loop.sim.couplings import assessed
from haptic_loop.sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class ConditionCurve:
    """The damping that one condition requires of a coupling, over frequency."""

    requirement: Requirement = off_table("inlined")
    ratio: float = off_table()
    demand: Array | None = off_table()  # required over available damping at each frequency
    reason: str | None = off_table("if given")


@dataclass(frozen=True, eq=False)
class ComparedCoupling:
    """One coupling, with its curves for the pictures."""

    name: str
    kind: str
    states: int
    assessment: Assessment
    robustness: Robustness | None = off_table()
    curves: compare.Curves = off_table("inlined")
    conditions: dict[str, ConditionCurve] = off_table()

    @classmethod
    def of(
        cls, loop: Loop, name: str, chosen: Chosen, assessment: Assessment, judged: compare.Demands, hz: Array
    ) -> ComparedCoupling:
        """Draw the curves of one coupling in `loop` at the frequencies `hz` (k,)."""
        curves, conditions = compare.curves(loop, judged, hz), {}
        for key, requirement in judged.requirements.items():
            demand, reason = curves.demands[key], requirement.reason
            if demand is None:
                reason = reason or f"this coupling is no V in feedback around the environment: no curve for {key}"
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
    """Several couplings over frequency; SI units, null where a figure is infinite or does not exist."""

    case: str
    scenario: str
    seed: int
    T_s: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    lam: tuple[int, ...]
    available_damping: tuple[float, ...]
    frequency_hz: Array
    sigma_E: Array
    ideal: compare.Perceived
    couplings: list[ComparedCoupling]
    notes: list[str]

    @property
    def conditions(self) -> list[str]:
        """Names of the conditions by which every coupling is judged."""
        return [*self.couplings[0].conditions]

    @classmethod
    def of(
        cls, scenario: Scenario, case: str, chosen: Mapping[str, Chosen], failed: Sequence[str], seed: int
    ) -> Comparison:
        """Compare the couplings `chosen`, by name; `failed` has a sentence for each coupling that was not designed."""
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
        shown = short if len(set(short)) == len(short) else [*chosen]  # Two files of one name keep their paths.
        couplings = [
            ComparedCoupling.of(loop, label, c, assessments[name], judged[name], hz)
            for label, (name, c) in zip(shown, chosen.items(), strict=True)
        ]
        notes = [
            *(f"{name}: {note}" for name, c in chosen.items() for note in c.remarks(judged[name].requirements)),
            *failed,
        ]
        for c in couplings:
            reasons = {name: c.conditions[name].reason for name in (*PLAIN_CONDITIONS, *own)}
            notes += [f"{c.name}, {condition}: {reason}" for condition, reason in reasons.items() if reason]
        about = case, scenario.name, seed, loop.T, loop.theta, loop.psi, loop.lam, loop.delta
        return cls(*about, hz, *compare.ideal(loop, hz), couplings, notes)
