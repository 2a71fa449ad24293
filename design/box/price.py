"""What a promise for a set of environments costs: the robust coupling beside the one made for the nominal one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from controller.box import Member
from controller.coupling import Coupling
from controller.environment import environment
from controller.process import force_map
from design.margin import closed_loop
from design.promises import finite
from design.store import Loop
from design.transparency import decibels, transparency


@dataclass(frozen=True)
class Cost:
    """One coupling over the members of a set, in which it runs on the current environment."""

    name: str
    ratio: tuple[float, float]  # required over available damping: in the nominal environment, and the most
    violated: int  # members at which the closed-loop condition fails
    rms_db: tuple[float, float]  # mismatch: in the nominal environment, and at its worst vertex
    sup_db: tuple[float, float]
    worst: str  # the vertex with the largest rms mismatch


def cost(name: str, loop: Loop, coupling: Coupling, members: Sequence[Member]) -> Cost:
    """Required damping and mismatch at every member; those that no device feels have no mismatch."""
    ratios, figures = [], {}
    for member in members:
        E = environment(member.network, loop.T)
        F = force_map(E, coupling, loop.theta, loop.psi)
        ratios.append(closed_loop(F, loop.delta).ratio)
        if E.D.any():
            figures[member.name] = transparency(F, E, loop.lam)
    nominal = figures[members[0].name]
    worst = max(figures, key=lambda member: figures[member].rms_mismatch)
    return Cost(
        name,
        (ratios[0], max(ratios)),
        sum(ratio >= 1 for ratio in ratios),
        (decibels(nominal.rms_mismatch), decibels(figures[worst].rms_mismatch)),
        (decibels(nominal.relative_mismatch), decibels(max(f.relative_mismatch for f in figures.values()))),
        worst,
    )


def price(loop: Loop, couplings: Mapping[str, Coupling]) -> tuple[Cost, ...]:
    """The cost of each coupling over the box of the loop."""
    members = loop.members()
    return tuple(cost(name, loop, coupling, members) for name, coupling in couplings.items())


def cost_part(row: Cost) -> dict[str, Any]:
    """The row as plain data; null for a mismatch of zero, or where no damping is enough."""
    pairs = {"required_over_available": row.ratio, "rms_mismatch_db": row.rms_db, "relative_mismatch_db": row.sup_db}
    figures = {name: dict(zip(("nominal", "worst"), map(finite, pair), strict=True)) for name, pair in pairs.items()}
    return {"coupling": row.name, "violated": row.violated, **figures, "worst": row.worst}
