"""Whether a coupling keeps its promise for a set of environments: proved at the vertices of a box, sampled inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from controller.box import Member, inside
from controller.coupling import Coupling
from design.certificate import NotProved, prove
from design.margin import Requirement
from design.members import in_each, worst
from design.promises import finite
from design.store import Certificate, Loop, data_of

SAMPLES = 64  # environments drawn from inside the box

WHAT_IS_PROVED = (
    "proved at the vertices, sampled inside; every environment is frozen: nothing is proved of one that changes while "
    "it is touched"
)


@dataclass(frozen=True, eq=False)
class SetCheck:
    """The closed-loop condition over a box. `members` and `at_members` are the environment and the vertices."""

    members: tuple[Member, ...]
    at_members: tuple[Requirement, ...]
    samples: tuple[Member, ...]
    at_samples: tuple[Requirement, ...]
    seed: int
    certificate: Certificate | None  # of the whole set, with the promise "a set"
    reason: str | None  # why the set is not promised

    @property
    def proved(self) -> bool:
        """At the environment and every vertex, in exact arithmetic, and nothing found inside speaks against it."""
        return self.certificate is not None and all(r.certified for r in self.at_samples)

    @property
    def worst(self) -> tuple[Member, Requirement]:
        """Where among the members the most damping is asked."""
        i = worst(self.at_members)
        return self.members[i], self.at_members[i]


def check_set(loop: Loop, coupling: Coupling, seed: int = 0, samples: int = SAMPLES) -> SetCheck | None:
    """The coupling over the box of its loop, None where it has none. Samples are drawn from the seed."""
    if loop.box is None:
        return None
    members, drawn = loop.members(), inside(loop.environment, loop.box, samples, seed)
    try:
        certificate, reason = prove(loop, data_of(coupling), "closed-loop"), None
    except NotProved as error:
        certificate, reason = None, str(error)
    at_members, at_samples = in_each(loop, coupling, members), in_each(loop, coupling, drawn)
    if certificate and not all(r.certified for r in at_samples):
        reason = f"proved at the vertices, but violated inside, at {drawn[worst(at_samples)].name}"
    return SetCheck(members, tuple(at_members), drawn, tuple(at_samples), seed, certificate, reason)


def set_part(check: SetCheck) -> dict[str, Any]:
    """The check as plain data; SI units, null where no damping is enough."""
    member, requirement = check.worst
    part: dict[str, Any] = {
        "vertices": len(check.members) - 1,
        "vertices_certified": sum(r.certified for r in check.at_members[1:]),
        "required_damping": [finite(d) for d in requirement.required],
        "available_damping": list(requirement.available),
        "worst": member.name,
        "proof": "rational" if check.certificate else "sampled",
        "certified": check.proved,
        "inside": _inside_part(check),
        "what": WHAT_IS_PROVED,
    }
    return part | ({"reason": check.reason} if check.reason else {})


def _inside_part(check: SetCheck) -> dict[str, Any]:
    """What was found in the environments drawn from inside: evidence, no proof."""
    if not check.samples:
        return {"samples": 0, "certified": 0, "seed": check.seed, "worst_ratio": None, "worst": None}
    i = worst(check.at_samples)
    return {
        "samples": len(check.samples),
        "certified": sum(r.certified for r in check.at_samples),
        "seed": check.seed,
        "worst_ratio": finite(check.at_samples[i].ratio),
        "worst": check.samples[i].name,
    }


def set_rows(part: dict[str, Any]) -> list[tuple[str, str]]:
    """The part of a report as rows of a table."""
    ratios = [d / a for d, a in zip(part["required_damping"], part["available_damping"], strict=True) if d is not None]
    most = f"{max(ratios):.4f} of the damping" if ratios else "no damping is enough"
    proof = "[green]proved exactly[/] at all" if part["certified"] else f"[red]not proved[/]: {part['reason']}"
    found, count = part["inside"], part["vertices"]
    rows = [
        ("set, vertices", f"{part['vertices_certified']} of {count} certified, {proof}"),
        ("set, worst", f"{most}, at {part['worst']}"),
    ]
    if found["samples"]:
        ratio = "no damping is enough" if found["worst_ratio"] is None else f"at most {found['worst_ratio']:.4f}"
        inside = f"{found['certified']} of {found['samples']} samples certified, {ratio} of the damping (no proof)"
        rows.append(("set, inside", inside))
    return rows
