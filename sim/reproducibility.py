"""What the paper prints beside what comes out here, for its own scenario."""

from __future__ import annotations

from typing import Any

from design.assess import assess
from design.listed import listed
from design.published import PRINTED_TAU_DB, PUBLISHED
from sim.scenario import Scenario, load

Row = dict[str, str]


def table(scenario: Scenario, case: str, outcome: dict[str, Any]) -> list[Row]:
    """Rows of {what, paper, here, why}; empty where the loop is not the paper's."""
    if scenario.jitter or scenario.loop(case) != load().loop(case):
        return []
    figure = _figure(case, outcome["stability"])
    return [figure] if case == "none" else [*_gains(scenario, case, outcome), _tau(case), figure]


def _gains(scenario: Scenario, case: str, outcome: dict[str, Any]) -> list[Row]:
    printed, got = PUBLISHED[case], outcome["coupling"]
    need = assess(scenario.loop(case), printed)
    theorem4, closed_loop = (need[name].required for name in ("theorem4", "closed-loop"))
    here = "none" if got["K"] is None else f"K = {listed(got['K'], 5)}, B = {listed(got['B'], 5)}"
    return [
        {
            "what": "gains [N/m], [N s/m]",
            "paper": f"K = {listed(printed.K, 5)}, B = {listed(printed.B, 5)}",
            "here": here,
            "why": "the printed gains are no solution of the paper's own problem (next row)",
        },
        {
            "what": "damping that the printed gains need [N s/m]",
            "paper": f"at most {listed(scenario.delta, 5)}",
            "here": f"{listed(theorem4, 5)} by Theorem 4; {listed(closed_loop, 5)} in this environment",
            "why": "Theorem 4 as printed is strictly infeasible (E-hat has a pole at z = 1); mended, it refuses them",
        },
    ]


def _tau(case: str) -> Row:
    return {
        "what": "transparency index tau (25)",
        "paper": f"{PRINTED_TAU_DB[case]} dB",
        "here": "infinite",
        "why": "inf sigma_min(E) = 0: moving both contacts together costs no static force",
    }


def _figure(case: str, stability: dict[str, Any]) -> Row:
    growth = f"{stability['exact_growth_rate_per_s']:+.2f} 1/s at {stability['exact_frequency_hz']:.1f} Hz"
    return {
        "what": "Figure 5: no coupling" if case == "none" else "Figure 6: with a coupling",
        "paper": "self-sustained oscillation" if case == "none" else "no oscillation",
        "here": f"{stability['exact_verdict']}: {growth}",
        "why": "agrees; masses and stiffness of the devices are assumed",
    }
