"""What a comparison of couplings over frequency says: for each what it asks, costs and lets be felt, and its curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from controller.loop import Loop
from controller.lti import Array
from controller.older import CONDITIONS as OLDER
from controller.older import with_older
from design import compare
from design.result import CONDITIONS, Chosen, certificate_part
from design.robustness import robustness_part
from design.transparency import transparency
from sim import report
from sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class ComparedCoupling:
    """One coupling, with all that the pictures show of it."""

    name: str
    states: int
    transparency: dict[str, Any]
    robustness: dict[str, Any] | None
    curves: compare.Curves = field(metadata={"json": "beside"})
    coupling: dict[str, Any] = field(metadata={"json": "beside"})
    conditions: dict[str, dict[str, Any]] = field(metadata={"json": "beside"})

    @classmethod
    def of(cls, loop: Loop, name: str, chosen: Chosen, judged: compare.Demands, hz: Array) -> ComparedCoupling:
        curves, conditions = compare.curves(loop, judged, hz), {}
        for key, requirement in judged.requirements.items():
            demand = curves.demands[key]
            part = certificate_part(requirement) | {"ratio": requirement.ratio, "demand": demand}
            if demand is None and not requirement.reason:
                part["reason"] = f"this coupling is no V in feedback around the environment: no curve for {key}"
            conditions[key] = part
        return cls(
            Path(name).name,
            judged.F.order,
            report.transparency_part(transparency(judged.F, loop.E(), loop.lam)),
            robustness_part(loop, chosen.coupling),
            curves,
            report.coupling_part(chosen.kind, chosen.coupling, loop.T),
            with_older(conditions, OLDER),
        )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Couplings over frequency; SI units, null where a figure is infinite or does not exist."""

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

    @classmethod
    def of(
        cls, scenario: Scenario, case: str, chosen: Mapping[str, Chosen], failed: Sequence[str], seed: int
    ) -> Comparison:
        """Of the couplings chosen, by name; `failed` says what could not be designed."""
        loop = scenario.loop(case)
        judged = {name: compare.judge(loop, c.coupling, c.phi) for name, c in chosen.items()}
        hz = compare.grid(loop, list(judged.values()))
        couplings = [ComparedCoupling.of(loop, name, c, judged[name], hz) for name, c in chosen.items()]
        notes = [*(f"{name}: {note}" for name, c in chosen.items() for note in c.notes), *failed]
        for c in couplings:
            parts = ((condition, c.conditions[condition]) for condition in CONDITIONS)
            notes += [f"{c.name}, {condition}: {part['reason']}" for condition, part in parts if "reason" in part]
        about = case, scenario.name, seed, loop.T, loop.theta, loop.psi, loop.lam, loop.delta
        return cls(*about, hz, *compare.ideal(loop, hz), couplings, notes)
