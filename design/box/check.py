"""Whether a coupling keeps its promise for a set of environments: proved at the vertices of a box, searched between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from controller.box import Member, inside, regions
from controller.coupling import Coupling
from design.box.members import in_each, worst
from design.box.worst_member import SEARCH, Progress, Searched, search
from design.certificate import NotProved, prove
from design.margin import Requirement
from design.promises import finite
from design.store import Certificate, Loop, data_of

SAMPLES = 64  # environments drawn evenly from inside the box, beside what the search looks at

WHAT_IS_PROVED = (
    f"proved at the vertices; between them searched, not proved ({SEARCH}); every environment is frozen: nothing is "
    "proved of one that changes while it is touched"
)


@dataclass(frozen=True, eq=False)
class SetCheck:
    """The closed-loop condition over a box. `members` and `at_members` are the environment and the vertices."""

    members: tuple[Member, ...]
    at_members: tuple[Requirement, ...]
    samples: tuple[Member, ...]
    at_samples: tuple[Requirement, ...]
    searched: Searched
    at_found: Requirement  # at the worst environment that the search has found
    seed: int
    certificate: Certificate | None  # of the whole set, with the promise "a set"
    reason: str | None  # why the set is not promised

    @property
    def proved(self) -> bool:
        """At the environment and every vertex, in exact arithmetic, and no violation was found between them."""
        return self.certificate is not None and self.worst_found[1].certified

    @property
    def worst(self) -> tuple[Member, Requirement]:
        """Where among the members the most damping is asked."""
        i = worst(self.at_members)
        return self.members[i], self.at_members[i]

    @property
    def worst_found(self) -> tuple[Member, Requirement]:
        """Where of all that was looked at, members, search and samples, the most damping is asked."""
        places = (*self.members, self.searched.worst[0].member, *self.samples)
        requirements = (*self.at_members, self.at_found, *self.at_samples)
        i = worst(requirements)
        return places[i], requirements[i]


def check_set(
    loop: Loop, coupling: Coupling, seed: int = 0, samples: int = SAMPLES, progress: Progress = lambda done, total: None
) -> SetCheck | None:
    """The coupling over the box of its loop, None where it has none.

    The search is the same every time; `samples` more points are drawn from inside, from the seed.
    """
    if loop.box is None:
        return None
    searched = search_box(loop, coupling, progress)
    members, drawn = loop.members(), inside(loop.environment, loop.box, samples, seed)
    try:
        certificate, reason = prove(loop, data_of(coupling), "closed-loop"), None
    except NotProved as error:
        certificate, reason = None, str(error)
    at_members, at_samples = in_each(loop, coupling, members), in_each(loop, coupling, drawn)
    (at_found,) = in_each(loop, coupling, [searched.worst[0].member])
    check = SetCheck(
        members, tuple(at_members), drawn, tuple(at_samples), searched, at_found, seed, certificate, reason
    )
    if certificate and not check.proved:
        place, requirement = check.worst_found
        check = replace(check, reason=violated_between(place, requirement.ratio))
    return check


def search_box(loop: Loop, coupling: Coupling, progress: Progress = lambda done, total: None) -> Searched:
    """The worst environments of the loop's box that the search of design.box.worst_member finds."""
    assert loop.box
    parts = regions(loop.environment, loop.box)
    return search(parts, lambda member: in_each(loop, coupling, [member])[0].ratio, progress)


def violated_between(place: Member, ratio: float) -> str:
    """Why a coupling that is proved at every vertex is promised no set."""
    needs = f"{ratio:.4f} of the damping is needed" if np.isfinite(ratio) else "no damping is enough"
    return f"proved at the vertices, but violated between them: {needs} at {place.name}"


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
        "search": search_part(check.searched),
        "inside": _inside_part(check),
        "what": WHAT_IS_PROVED,
    }
    return part | ({"reason": check.reason} if check.reason else {})


def search_part(searched: Searched) -> dict[str, Any]:
    """What the search between the vertices has found: evidence, no proof."""
    worst = searched.worst[0]
    return {
        "how": SEARCH,
        "environments": searched.tried,
        "worst_ratio": finite(worst.ratio),
        "worst": worst.member.name,
        "violated": not worst.ratio < 1,
    }


def search_words(part: dict[str, Any]) -> str:
    """What was found between the vertices, in a line."""
    found = "[red]violated[/]" if part["violated"] else "no violation found"
    ratio = "no damping is enough" if part["worst_ratio"] is None else f"worst ratio {part['worst_ratio']:.4f}"
    return f"searched, not proved: {found}, {ratio} in {part['environments']} points, at {part['worst']}"


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
    exact = part["proof"] == "rational"
    proof = "[green]proved exactly[/] at all" if exact else f"[red]not proved[/]: {part['reason']}"
    found, count = part["inside"], part["vertices"]
    rows = [
        ("set, vertices", f"{part['vertices_certified']} of {count} certified, {proof}"),
        ("set, worst vertex", f"{most}, at {part['worst']}"),
        ("set, between", search_words(part["search"])),
    ]
    if found["samples"]:
        ratio = "no damping is enough" if found["worst_ratio"] is None else f"at most {found['worst_ratio']:.4f}"
        inside = f"{found['certified']} of {found['samples']} random samples certified, {ratio} of the damping"
        rows.append(("set, inside", inside))
    if exact and not part["certified"]:
        rows.append(("set", f"[red]not promised[/]: {part['reason']}"))
    return rows
