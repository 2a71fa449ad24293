"""The report of the suite for a stranger: verdicts first, then every figure with the command that repeats it."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

_INTRODUCTION = """\
Several force-feedback devices share one simulated object; the loop of hands, devices, delays and computer must not
start to oscillate by itself, whoever holds the devices. A *coupling* is the filter between devices and object that
ensures this; it is *certified* when the devices have more damping than a proved condition requires. This report puts
every such verdict to the test. *Growth* is the rate at which the loop's strongest oscillation grows: below zero it
dies out. It is computed from the exact solution of the loop and, independently, from what MuJoCo simulates; both must
tell the same of every hand. The *adversary* searches for the worst passive hand instead of drawing hands at random.

"Holds" means: both engines agree about everyone, nobody destabilises a certified loop, and its energy balance is
never negative. An uncertified loop may be unstable; it holds as long as the engines agree.
"""


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
    lines += ["", "## Verdicts", "", *_verdict_table(outcome), "", _INTRODUCTION]
    for check in outcome["checks"]:
        lines += _section(check)
    lines += ["## Where this was run", "", ", ".join(f"{name} {value}" for name, value in machine.items()) + ".", ""]
    return "\n".join(lines)


def machine() -> dict[str, str]:
    """What figures of speed, and the last digits of all others, depend on."""
    packages = {name: version(name) for name in ("mujoco", "numpy", "scipy", "clarabel")}
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
    if check["printed"]:
        lines += ["```text", check["printed"].rstrip(), "```", ""]
    for part in check["parts"] if not check["printed"] else ():
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
