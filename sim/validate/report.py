"""What a validation found: one dictionary for machines, and the same as a table for people."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from controller.lti import Array
from design.promises import finite
from models.human import Human, Person
from sim.adversary import Worst
from sim.population import MIXED, crowd_of
from sim.report import varying
from sim.validate.examine import Findings, Question
from sim.verdicts import unstable

SETTLING = 4  # decay times of the slowest mode in a trace whose hands must be slower in its last quarter than before
ROUNDING = 1e-9  # W(N) may be this far below zero, beside the magnitudes that it adds up


def outcome(question: Question, findings: Findings, certified: bool, wall: float) -> dict[str, Any]:
    """The contract of `sim.validate --json`."""
    bad, mujoco = unstable(findings.exact), question.engine != "exact"
    disagreements = int(findings.disagreements.sum())
    wrong = int((bad | (mujoco & unstable(findings.mujoco) & (findings.mujoco > 1e-3))).sum())
    part: dict[str, Any] = {
        "humans": int(findings.index.size),
        "links": "mixed" if question.links == MIXED else question.links,
        "seed": question.seed,
        "engine": question.engine,
        "unstable": {
            "exact": int(bad.sum()),
            "mujoco": int(unstable(findings.mujoco).sum()) if mujoco else None,
        },
        "disagreements": disagreements,
        "disagreeing": [_identified(question, int(i)) for i in findings.index[findings.disagreements]],
        "worst": _worst(question, findings),
        "largest_difference_per_s": _largest(np.abs(findings.mujoco - findings.exact)),
        "traces": _traces(question, findings),
        "environments": _environments(question, findings, bad),
        "certified": certified,
        "holds": disagreements == 0 and not (certified and wrong),
        "interrupted": findings.interrupted,
        "wall_s": wall,
        "simulated_s_per_s": findings.simulated / wall,
    }
    if certified and question.ticks:
        part["energy_audit"] = _energy(findings)
        part["holds"] = part["holds"] and part["energy_audit"]["holds"]
    if not findings.index.size:
        part |= {"holds": None, "reason": "interrupted before the first batch of humans was done"}
    return part


def switching_part(findings: Findings, covered: dict[str, Any]) -> dict[str, Any]:
    """How many humans grow under delays that vary; it holds unless certificates cover these delays and one grows."""
    exact, mujoco = findings.switching, findings.switching_mujoco
    seen = ~np.isnan(exact)
    unstable, also = int((exact > 0).sum()), mujoco[~np.isnan(mujoco)]
    worst = int(np.nanargmax(exact)) if seen.any() else None
    return covered | {
        "unstable": {"exact": unstable, "mujoco": int((also > 0).sum()) if also.size else None},
        "humans": int(seen.sum()),
        "mujoco_unclipped": int(also.size),
        "largest_growth_per_s": None if worst is None else finite(float(exact[worst])),
        "worst_index": None if worst is None else int(findings.index[worst]),
        "holds": not (covered["covered"] and unstable),
    }


def adversary_part(worst: Worst, ratio: float, certified: bool) -> dict[str, Any]:
    """What the search found, and how far the loop is from its required damping."""
    return {
        "found": worst.destabilises,
        "spectral_radius": worst.spectral_radius,
        "growth_rate_per_s": finite(worst.growth),
        "frequency_hz": worst.frequency_hz,
        "evaluated": worst.evaluated,
        "required_over_available_damping": finite(ratio),
        "human": human_part(worst.humans),
        "person": person_part(worst.persons),
        "holds": not (certified and worst.destabilises),
    }


def human_part(humans: tuple[Human, ...]) -> list[dict[str, Any]]:
    """Links of each channel's human."""
    names = ("mass", "damping", "stiffness")
    return [{"links": [{name: getattr(link, name) for name in names} for link in human.links]} for human in humans]


def person_part(persons: tuple[Person, ...]) -> list[dict[str, Any]]:
    """Those who hold several devices."""
    return [msgspec.to_builtins(person) for person in persons]


def _identified(question: Question, index: int) -> dict[str, Any]:
    crowd = crowd_of(question.scenario, question.seed, index, question.links)
    who = {"human": human_part(crowd.humans(0)), "person": person_part(crowd.persons(0))}
    member = question.environment(index)
    where = {"environment": member.name, "network": msgspec.to_builtins(member.network)} if member else {}
    return {"seed": question.seed, "index": index} | who | where


def _environments(question: Question, findings: Findings, bad: NDArray[np.bool_]) -> dict[str, Any]:
    """Which environments the loops had, and in which of them a loop was unstable."""
    if not question.environments:
        return {"of": "the nominal environment", "count": 1}
    unstable_in = sorted({int(i) % len(question.environments) for i in findings.index[bad]})
    return {
        "of": "the box",
        "count": len(question.environments),
        "names": [member.name for member in question.environments],
        "unstable_in": [question.environments[i].name for i in unstable_in],
    }


def _worst(question: Question, findings: Findings) -> dict[str, Any] | None:
    if not findings.index.size:
        return None
    k = int(np.argmax(findings.radius))
    figures = {
        "spectral_radius": float(findings.radius[k]),
        "growth_rate_per_s": finite(float(findings.exact[k])),
        "frequency_hz": float(findings.frequency[k]),
    }
    return figures | _identified(question, int(findings.index[k]))


def _traces(question: Question, findings: Findings) -> dict[str, Any] | None:
    if not question.ticks or not findings.index.size:
        return None
    measured, stable = np.isfinite(findings.trace), ~unstable(findings.exact)
    duration = question.ticks * question.scenario.T
    decay = _largest(-1 / findings.exact[findings.exact < 0])
    decides = decay is None or duration >= SETTLING * decay
    part = {
        "duration_s": duration,
        "clipped_runs": int((findings.clipped > 0).sum()),
        "measured": int(measured.sum()),
        "largest_difference_per_s": _largest(np.abs(findings.trace - findings.exact)),
        "stable_and_settling": int((stable & (findings.settling < 1)).sum()),
        "stable": int(stable.sum()),
        "slowest_settling": _largest(findings.settling[stable]),
        "slowest_decay_s": decay,
        "settling_decides": decides,
    }
    if not decides:
        part["reason"] = f"the slowest mode decays in {decay:.3g} s: in {duration:g} s its hands need not be slower"
    return part


def _energy(findings: Findings) -> dict[str, Any]:
    unclipped = findings.clipped == 0
    violated = unclipped & ~(findings.energy >= -ROUNDING * findings.audited)
    return {
        "audited": int(unclipped.sum()),
        "clipped": int((~unclipped).sum()),
        "violated": int(violated.sum()),
        "least_J": float(findings.energy[unclipped].min()) if unclipped.any() else None,
        "holds": not violated.any(),
    }


def _largest(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else None


def print_verdicts(report: dict[str, Any], console: Console) -> None:
    """The outcome as a table."""
    table = Table(title=f"case {report['case']} · {report['scenario']} · coupling {report['coupling']['kind']}")
    table.add_column("")
    table.add_column("")
    for name, value in _rows(report):
        table.add_row(name, value)
    console.print(table)
    if switching := report.get("switching"):
        console.print(f"[dim]·[/] Delays that vary: {switching['covers']}.")
    for remark in report["remarks"]:
        console.print(f"[dim]·[/] {remark}")


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    bad, worst, traces = report["unstable"], report["worst"], report["traces"]
    engines = f"{bad['exact']} exact" + (f", {bad['mujoco']} MuJoCo" if bad["mujoco"] is not None else "")
    rows = [
        ("humans", f"{report['humans']} (links {report['links']}, seed {report['seed']})"),
        ("environments", _met(report["environments"])),
        ("unstable", engines),
        ("disagreements", str(report["disagreements"])),
    ]
    if worst:
        rows.append(
            (
                "worst human",
                f"{worst['growth_rate_per_s']:+.4g} 1/s at {worst['frequency_hz']:.2f} Hz (index {worst['index']})"
                + (f", at {worst['environment']}" if "environment" in worst else ""),
            )
        )
    if report["largest_difference_per_s"] is not None:
        rows.append(("MuJoCo's growth rates", f"within {report['largest_difference_per_s']:.1e} 1/s of the exact ones"))
    if traces:
        rows.append(("traces", f"{traces['duration_s']:g} s each, {traces['clipped_runs']} clipped"))
        settled = f"{traces['stable_and_settling']} of {traces['stable']} stable loops slower at the end"
        if not traces["settling_decides"]:
            settled += f"; no verdict: {traces['reason']}"
        rows.append(("handles come to rest", settled))
    if audit := report.get("energy_audit"):
        rows.append(
            (
                "energy audit W >= 0",
                f"{audit['audited'] - audit['violated']} of {audit['audited']}, {audit['clipped']} clipped left out",
            )
        )
    if switching := report.get("switching"):
        rows += _switching_rows(switching)
    if adversary := report.get("adversary"):
        found = (
            f"a human that grows at {adversary['growth_rate_per_s']:+.4g} 1/s"
            if adversary["found"]
            else "no destabilising human"
        )
        ratio = adversary["required_over_available_damping"]
        close = "no damping is enough" if ratio is None else f"the loop needs {ratio:.4g} of the damping it has"
        rows.append(("adversary", f"{found} among {adversary['evaluated']}; {close}"))
    rows.append(("certified", "yes" if report["certified"] else "no"))
    verdict = {True: "[green]yes[/]", False: "[red]no[/]"}.get(report["holds"])
    rows.append(("holds", verdict or str(report["reason"])))
    if report["interrupted"]:
        kept = f"{report['humans']} humans that were finished are kept; running batches and searches are not"
        rows.append(("interrupted", kept))
    rows.append(("time", f"{report['wall_s']:.1f} s, {report['simulated_s_per_s']:.0f} simulated seconds per second"))
    return rows


def _switching_rows(switching: dict[str, Any]) -> list[tuple[str, str]]:
    rows = varying(switching)
    if switching["humans"]:
        mujoco = switching["unstable"]["mujoco"]
        also = "" if mujoco is None else f", MuJoCo {mujoco} of {switching['mujoco_unclipped']} unclipped"
        growth = switching["largest_growth_per_s"]
        worst = "" if growth is None else f"; worst {growth:+.4g} 1/s (index {switching['worst_index']})"
        grow = f"{switching['unstable']['exact']} of {switching['humans']} exact{also}{worst}"
        rows.append(("grow while delays vary", grow))
    return rows


def _met(environments: dict[str, Any]) -> str:
    if "names" not in environments:
        return environments["of"]
    found = "; ".join(environments["unstable_in"]) or "none"
    return f"{environments['count']} of {environments['of']}, in turn; unstable in: {found}"
