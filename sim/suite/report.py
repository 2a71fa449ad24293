"""The suite's report: verdicts first, then the figures of each check under the command that reproduces them."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from sim.tightness import by_whom

INTRODUCTION = """\
Several force-feedback devices share one simulated object; the loop of hands, devices, delays and computer must not
start to oscillate by itself, whoever holds the devices. A *coupling* is the filter between devices and object that
ensures this; it is *certified* when the devices have more damping than a proved condition requires. This report puts
every such verdict to the test. *Growth* is the rate at which the loop's strongest oscillation grows: below zero it
dies out. It is computed from the exact solution of the loop and, independently, from what MuJoCo simulates; both must
tell the same of every hand. The *adversary* searches for the worst passive hand instead of drawing hands at random.

"Holds" means: both engines agree about everyone, nobody destabilises a certified loop, and its energy balance is
never negative. An uncertified loop may be unstable; it holds as long as the engines agree.
"""


@dataclass(frozen=True)
class Part:
    """A table of a check; `answer` is its gist, shown in the table of verdicts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    answer: str = ""


def verdicts(report: dict[str, Any]) -> list[Part]:
    """Of sim.validate."""
    bad, worst, energy = report["unstable"], report["worst"], report.get("energy_audit")
    humans, adversary, traces = report["humans"], report.get("adversary"), report["traces"]
    rows = [
        ("certified", "yes" if report["certified"] else "no"),
        *_damping(report["certificates"]),
        ("random hands", f"{humans}, half of them with an arm"),
        ("unstable with", f"{bad['exact']} (exact), {'-' if bad['mujoco'] is None else bad['mujoco']} (MuJoCo)"),
        ("the engines disagree about", str(report["disagreements"])),
    ]
    if report["largest_difference_per_s"] is not None:
        rows.append(("largest difference in growth", f"{report['largest_difference_per_s']:.1e} 1/s"))
    if worst:
        rows.append(("worst random hand", _growing(worst)))
    if adversary:
        found = _growing(adversary) if adversary["found"] else "nobody makes the loop grow"
        rows.append(("the adversary's worst", f"{found}, of {adversary['evaluated']} tried"))
    if traces:
        settled = f"{traces['stable_and_settling']} of {traces['stable']} stable loops"
        rows.append((f"slower at the end of {traces['duration_s']:g} s than before", settled))
        rows.append(("runs that reached a force limit", str(traces["clipped_runs"])))
    if energy:
        rows.append(
            ("energy balance never negative", f"{energy['audited'] - energy['violated']} of {energy['audited']}")
        )
    gist = f"{'certified' if report['certified'] else 'not certified'}; {bad['exact']} of {humans} hands unstable"
    if adversary:
        gist += f", adversary {'succeeds' if adversary['found'] else 'fails'}"
    gist += f", {report['disagreements']} disagreements"
    return [Part("", ("figure", "value"), tuple(rows), gist)]


def tightness(report: dict[str, Any]) -> list[Part]:
    """Of sim.tightness."""
    rates = report["rates"]
    rows = tuple((f"{r['short']:.1%}", str(r["attempts"]), f"{r['rate']:.0%}") for r in rates)
    first = next((r["short"] for r in rates if r["rate"] == 1), None)
    gist = "no shortage tried lets somebody destabilise every loop"
    if first is not None:
        gist = f"somebody destabilises every loop whose devices lack {first:.1%} of the damping required"
    single = tuple(
        (r["loop"], f"{r['short']:.1%}", by_whom(r), f"{r['growth_rate_per_s']:+.3g}" if r["found"] else "-")
        for r in report["rows"]
    )
    return [
        Part("Success rate of the adversary", ("damping missing", "loops", "destabilised"), rows, gist),
        Part("Each loop", ("loop", "damping missing", "destabilised by", "growth [1/s], first found"), single),
    ]


def accuracy(report: dict[str, Any]) -> list[Part]:
    """Of sim.accuracy."""
    default = report["default_substeps"]
    rows = []
    for row in report["rows"]:
        name = f"{row['integrator']} x {row['substeps']}" if row["integrator"] else "exact"
        mark = " (default)" if (row["integrator"], row["substeps"]) == ("RK4", default) else ""
        growth, speed = f"{row['growth_rate_error']:+.1e}", f"{1 / row['wall_s_per_simulated_s']:.0f}"
        position = row["position_relative_rms"]
        right = "right" if row["verdict_correct"] else "wrong"
        rows.append((name + mark, "-" if position is None else f"{position:.1e}", growth, right, speed))
    ours = next((r for r in report["rows"] if (r["integrator"], r["substeps"]) == ("RK4", default)), None)
    gist = f"default RK4 x {default}: growth off by {ours['growth_rate_error']:+.0e} 1/s" if ours else ""
    columns = ("setting", "position error, relative rms", "growth error [1/s]", "verdict", "times real time")
    return [Part("", columns, tuple(rows), gist)]


def gain_map(report: dict[str, Any]) -> list[Part]:
    """Of sim.zwidth."""
    cells = len(report["grid"]["K"]) * len(report["grid"]["B"])
    population, simulation = report["population"], report["simulation"]
    rows = [
        (
            f"certified by {name}",
            f"{report[name]['certified_cells']} of {cells} cells, {report[name]['contradicted_cells']} contradicted",
        )
        for name in ("theorem4", "closed-loop")
    ]
    stable = f"{population['stable_cells']} of {population['decided_cells']} cells"
    rows.append((f"stable with all of {population['humans']} random hands", stable))
    odd = f"{simulation['oscillate']} oscillate, {simulation['differ_from_linear']} unlike the linear loop"
    rows.append((f"{len(simulation['points'])} points simulated in MuJoCo", odd))
    edge = max(report["error"][name]["edge_relative_in_K"] for name in ("theorem4", "closed-loop"))
    rows.append(("edge of the map, error in K", f"{edge:.0e}"))
    contradicted = sum(report[name]["contradicted_cells"] for name in ("theorem4", "closed-loop"))
    return [Part("", ("figure", "value"), tuple(rows), f"{contradicted} certified cells that any hand upsets")]


def hard(report: dict[str, Any]) -> list[Part]:
    """Of sim.hard."""
    rows = tuple(
        (
            row["name"],
            f"{row['exact']:+.4f}",
            f"{' x '.join(map(str, row['fails']))}: {row['fault']}" if row["fails"] else "none tried",
            f"RK4 x {row['substeps']}",
            f"{row['error']:+.1e}",
        )
        for row in report["rows"]
    )
    good = sum(row["holds"] for row in report["rows"])
    columns = ("loop", "exact growth [1/s]", "fails", "holds", "growth error [1/s]")
    return [Part("", columns, rows, f"{good} of {len(rows)} verdicts right under the substep rule")]


def headline(outcome: dict[str, Any]) -> str:
    """One sentence."""
    checks = outcome["checks"]
    good = sum(check["holds"] for check in checks)
    if outcome["holds"]:
        text = f"All {good} checks hold."
    else:
        failed = ", ".join(check["name"] for check in checks if not check["holds"])
        text = f"{good} of {len(checks) + len(outcome['left_out'])} checks hold"
        text += f"; not: {failed}." if failed else "."
    return text + (" Interrupted." if outcome["interrupted"] else "")


def markdown(outcome: dict[str, Any]) -> str:
    """The whole report."""
    machine = outcome["machine"]
    lines = ["# Validation report", "", f"**{headline(outcome)}** {outcome['wall_s']:.0f} s, seed {outcome['seed']}."]
    lines += ["", "## Verdicts", "", *_verdict_table(outcome), "", INTRODUCTION]
    for check in outcome["checks"]:
        lines += _section(check)
    lines += ["## Where this was run", "", ", ".join(f"{name} {value}" for name, value in machine.items()) + ".", ""]
    return "\n".join(lines)


def machine() -> dict[str, str]:
    """What figures of speed, and the last digits of all others, depend on."""
    packages = {name: version(name) for name in ("mujoco", "numpy", "scipy", "cvxpy", "clarabel")}
    return {
        "Python": platform.python_version(),
        **packages,
        "on": f"{platform.platform()}, {os.cpu_count()} processors",
    }


def _verdict_table(outcome: dict[str, Any]) -> list[str]:
    rows = [
        (
            "holds" if check["holds"] else "**does not hold**",
            f"[{check['asks']}](#{_anchor(check['asks'])})",
            check["trouble"] or next((part["answer"] for part in check["parts"]), ""),
            f"`{check['command']}`",
        )
        for check in outcome["checks"]
    ]
    rows += [("not run", name, "", "") for name in outcome["left_out"]]
    return _table(("verdict", "check", "answer", "reproduce with"), rows)


def _section(check: dict[str, Any]) -> list[str]:
    lines = [f"## {check['asks']}", "", "```sh", check["command"], "```", ""]
    verdict = "Holds" if check["holds"] else "Does not hold"
    lines += [
        f"{verdict} (exit code {check['exit_code']}, {check['wall_s']:.1f} s). {check['trouble'] or ''}".rstrip(),
        "",
    ]
    for part in check["parts"]:
        lines += [f"### {part['title']}", ""] if part["title"] else []
        lines += [*_table(part["columns"], part["rows"]), ""]
    for picture in check["pictures"]:
        lines += [f"![{check['asks']}]({picture})", ""]
    return lines


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = "|" + "---|" * len(columns)
    return [f"| {' | '.join(columns)} |", rule, *(f"| {' | '.join(cells)} |" for cells in rows)]


def _anchor(title: str) -> str:
    """As GitHub makes it from a heading."""
    return "".join(c for c in title.lower() if c.isalnum() or c in " -").replace(" ", "-")


def _damping(certificates: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    for name, part in certificates.items():
        needed = [f"{value:.4g}" if value is not None else "infinite" for value in part["required_damping"]]
        available = [f"{value:.4g}" for value in part["available_damping"]]
        rows.append((f"damping needed, {name}", f"{', '.join(needed)} of {', '.join(available)} N s/m"))
    return rows


def _growing(part: dict[str, Any]) -> str:
    growth = part["growth_rate_per_s"]
    return "none" if growth is None else f"{growth:+.4g} 1/s at {part['frequency_hz']:.1f} Hz"
