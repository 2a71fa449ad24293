"""What an audit says: one dictionary for machines, and the same as a table for people."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, get_args

from rich.console import Console
from rich.table import Table

from controller.coupling import Compliance, InternalModel, NoCoupling, SpringDamper
from controller.lti import SingularLoop
from design.audit.figures import Stiffest, Tolerance, stiffest, tolerance
from design.audit.remedies import remedies
from design.audit.subject import Subject
from design.box.check import SetCheck, set_part, set_rows
from design.condition.human_structure import separate_humans_part
from design.jitter.part import switching_part
from design.listed import listed
from design.margin import Requirement
from design.promises import ANY, CAVEATS, certificate_part, promise
from design.store import Condition, DelayRange

KINDS = {
    NoCoupling: "none",
    SpringDamper: "spring-damper",
    Compliance: "compliance",
    InternalModel: "internal-model",
}


def report(
    subject: Subject,
    switching: DelayRange | None = None,
    whole: SetCheck | None = None,
    holders: Sequence[int] | None = None,
) -> dict[str, Any]:
    """Both conditions with what surrounds them; SI units, null with a "reason" where a figure does not exist.

    With a range of delays also the damping that any switching within it asks; `whole` is the same coupling over the
    box around the environment, if there is one, `holders` who holds each device.
    """
    requirements = {condition: subject.requirement(condition) for condition in reversed(get_args(Condition))}
    closed_loop, theorem4 = requirements["closed-loop"].certified, requirements["theorem4"].certified
    proved = bool(whole and whole.proved)
    rigid = subject.network is None
    promised = promise(closed_loop and theorem4, closed_loop, rigid=rigid, walls=subject.walls, whole_set=proved)
    gains = subject.coupling if isinstance(subject.coupling, SpringDamper) else None
    return {
        "coupling": {
            "kind": KINDS[type(subject.coupling)],
            "K": gains.K.tolist() if gains else None,
            "B": gains.B.tolist() if gains else None,
        },
        "loop": {
            "T_s": subject.T,
            "theta": list(subject.theta),
            "psi": list(subject.psi),
            "delta": list(subject.delta),
            "rigid": subject.network is None,
        },
        **{condition: _condition_part(subject, requirement) for condition, requirement in requirements.items()},
        "jitter-proof": _switching_part(subject, switching) if switching else None,
        "separate-humans": _separate_part(subject, holders) if holders else None,
        "set": whole and set_part(whole),
        "certified": closed_loop and (whole is None or proved or promised == ANY),
        "promise": promised,
        "helps": _helps(subject, requirements["theorem4" if closed_loop else "closed-loop"]),
        "not_covered": CAVEATS,
    }


def _condition_part(subject: Subject, requirement: Requirement) -> dict[str, Any]:
    return certificate_part(requirement) | {
        "stiffest": _stiffest_part(stiffest(subject, requirement.condition)),
        "sensitivity": _sensitivity_part(subject, requirement, tolerance(subject, requirement)),
    }


def _separate_part(subject: Subject, holders: Sequence[int]) -> dict[str, Any] | None:
    """What the closed-loop condition asks if these humans are separate; None where there is no single loop."""
    if subject.network is None or subject.network.walls:
        return None
    try:
        F = subject.F
    except SingularLoop:
        return None
    delays = (subject.theta, subject.psi)
    return separate_humans_part(F, subject.delta, holders, subject.coupling, subject.network, delays)


def _switching_part(subject: Subject, span: DelayRange) -> dict[str, Any]:
    found = subject.switching(span)
    if found.requirement.reason:
        return certificate_part(found.requirement) | {"lo": list(span.lo), "hi": list(span.hi)}
    return switching_part(found, subject.G, span)


def _stiffest_part(found: Stiffest) -> dict[str, Any]:
    return {"K": list(found.K)} | _because(found.reason)


def _sensitivity_part(subject: Subject, requirement: Requirement, found: Tolerance) -> dict[str, Any]:
    """Errors are relative: delta may be 1 - delta_error times and T 1 + T_error times what was given."""
    return {
        "least_delta": None if found.least_delta is None else list(found.least_delta),
        "delta_error": None if found.least_delta is None else 1 - requirement.ratio,
        "largest_T_s": found.largest_T,
        "T_error": None if found.largest_T is None else found.largest_T / subject.T - 1,
        "extra_samples": found.extra_samples,
    } | _because(found.reason)


def _because(reason: str | None) -> dict[str, str]:
    return {"reason": reason} if reason else {}


def _helps(subject: Subject, requirement: Requirement) -> list[dict[str, Any]]:
    """Changes that help the condition that fails first: closed-loop, else theorem4."""
    return [
        {
            "change": remedy.change,
            "condition": requirement.condition,
            "required_damping": list(remedy.requirement.required),
            "certified": remedy.requirement.certified,
        }
        for remedy in remedies(subject, requirement)
    ]


def print_report(report: dict[str, Any], console: Console) -> None:
    """The report as a table, and what it does not cover."""
    table = Table(title=_verdict(report), title_justify="left")
    table.add_column("")
    parts = [report[condition] for condition in ("closed-loop", "theorem4")]
    for part in parts:
        table.add_column(part["condition"])
    for name, cell in ROWS.items():
        table.add_row(name, *(cell(part) for part in parts))
    console.print(table)
    if report["set"]:
        over = Table(title="the box around the environment", title_justify="left", show_header=False)
        for row in set_rows(report["set"]):
            over.add_row(*row)
        console.print(over)
    for line in _remarks(report):
        console.print(f"[dim]·[/] {line}")


def _verdict(report: dict[str, Any]) -> str:
    coupling = report["coupling"]
    gains = f" K {listed(coupling['K'])} N/m, B {listed(coupling['B'])} N s/m" if coupling["K"] else ""
    outcome = f"[green]certified[/] for {report['promise']}" if report["certified"] else "[red]not certified[/]"
    if report["promise"] and not report["certified"]:
        outcome += f" for the set, only for {report['promise']}"
    return f"{coupling['kind']}{gains}: {outcome}"


def _needs(part: dict[str, Any]) -> str:
    word = "[green]certified[/]" if part["certified"] else "[red]not certified[/]"
    return f"{listed(part['required_damping'])} of {listed(part['available_damping'])} N s/m: {word}"


def _error(key: str, sign: str) -> Callable[[dict[str, Any]], str]:
    """A relative error in percent, rounded down so that what is printed is tolerated."""

    def cell(part: dict[str, Any]) -> str:
        error = part["sensitivity"][key]
        return "-" if error is None else f"{sign}{math.floor(1e4 * error) / 100:.2f} %"

    return cell


def _optional(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.5g}{unit}"


#: name of a row -> what stands in it, given the part of a condition
ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "needs damping": _needs,
    "margin": lambda part: _optional(part["margin"]),
    "binds at": lambda part: _optional(part["binding_frequency_hz"], " Hz"),
    "stiffest K here": lambda part: _gains(part["stiffest"]["K"]),
    "delta error": _error("delta_error", "-"),
    "T error": _error("T_error", "+"),
    "spare samples": lambda part: _optional(part["sensitivity"]["extra_samples"]),
}


def _gains(K: Sequence[float | None]) -> str:
    return "-" if None in K else ", ".join(_down(k) for k in K) + " N/m"


def _down(K: float | None) -> str:
    """A stiffness to five digits, rounded down so that what is printed is certified."""
    if K is None:
        return "-"
    unit = 10.0 ** (math.floor(math.log10(K)) - 4)
    return f"{math.floor(K / unit) * unit:.5g}"


def _remarks(report: dict[str, Any]) -> list[str]:
    lines = [f"{note}." for note in report["notes"]]
    for condition in ("closed-loop", "theorem4"):
        part = report[condition]
        for name, reason in (
            ("", part.get("reason")),
            (", stiffest K", part["stiffest"].get("reason")),
            (", sensitivity", part["sensitivity"].get("reason") if part["certified"] else None),
        ):
            if reason:
                lines.append(f"{condition}{name}: {reason}.")
    for helping in report["helps"]:
        enough = "enough" if helping["certified"] else "not enough alone"
        need = f"{helping['condition']} then needs {listed(helping['required_damping'])} N s/m, {enough}"
        lines.append(f"What helps: {helping['change']} ({need}).")
    if (part := report["jitter-proof"]) is not None:
        lines += _switching_remarks(part)
    if (part := report["separate-humans"]) is not None and len(set(part["weights"])) > 1:
        proof = ", proved exactly" if part["proof"] == "rational" else ""
        weights = f"weights {listed(part['weights'])}"
        lines.append(f"As each human holds devices of his own ({weights}) it needs {_needs(part)}{proof}.")
    return [*lines, report["not_covered"]]


def _switching_remarks(part: dict[str, Any]) -> list[str]:
    span = ", ".join(f"{lo} to {hi}" for lo, hi in zip(part["lo"], part["hi"], strict=True))
    proof = ", proved exactly" if part["proof"] == "rational" else ""
    lines = [f"Any switching of the delays ({span} samples) needs {_needs(part)}{proof}."]
    if "playout" not in part:
        return [*lines, f"jitter-proof: {part['reason']}."]
    buffered = part["playout"]
    enough = "certified" if buffered["certified"] else "not certified"
    needs = f"{listed(buffered['required_damping'])} N s/m: {enough}"
    return [
        *lines,
        f"A playout buffer to the constant {listed(part['hi'])} needs {needs}.",
        part["not_covered"],
    ]
