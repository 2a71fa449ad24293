"""The best linear coupling under the closed-loop condition: one convex problem in Q, in one environment or in a set.

F = Theta (Psi E - Psi E Q Psi E) is affine in Q, so the mismatch and He[F/(z-1)] > -Delta_D/T are convex in its
coefficients, and cutting planes (design.parameter) find the global optimum over a basis. What is returned passes
the refined sweep of design.margin, whatever a solver said.

Q stays and E is the current environment, so F is affine in Q at every vertex of a box, too: the same problem, with each
vertex as a further world. The rms mismatch is then the mean square over the environment and the vertices (that of the
environment alone would gain it 0.2 dB and cost the worst vertex 0.3 to 0.5), the sup mismatch the worst of them.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from controller.box import Member
from controller.coupling import InternalModel
from controller.environment import environment
from controller.process import force_map
from design.box.worst_member import Found, search
from design.failure import DesignFailed, Infeasible
from design.jitter.multiplier import jitter_proof
from design.margin import closed_loop
from design.parameter.advice import Progress, advice
from design.parameter.cutting_planes import SLACK, cut
from design.parameter.pole_descent import descend
from design.parameter.wish import Wish
from design.parameter.worlds import environments, parameter, worlds
from design.result import Design
from design.specification import Specification
from design.transparency import transparency

USUAL = Wish()
ADDED, MOST_ADDITIONS = 3, 8  # points of a box that become environments at a time, and how often at most


def design(spec: Specification, wish: Wish = USUAL, progress: Progress = lambda what, done, total: None) -> Design:
    """The coupling of the least mismatch, verified by the refined sweep of the condition.

    `progress` hears of the search for a reason where there is none, which takes longer than most designs.
    Raises Infeasible where no Q of this kind meets the condition, DesignFailed where none could be verified.
    """
    started = time.perf_counter()
    try:
        coupling, spec, rounds = searched(spec, wish, progress)
    except Infeasible as error:
        raise Infeasible(error.problem, error.results, advice(spec, wish, progress)) from error
    maps = [force_map(E, coupling, spec.theta, spec.psi) for E in environments(spec)]
    requirement = max((closed_loop(F, spec.delta) for F in maps), key=lambda r: r.ratio)
    if wish.switching:
        free = [force_map(E, coupling, (0,) * spec.channels, spec.psi) for E in environments(spec)]
        requirement = max(
            (jitter_proof(G, *wish.switching, spec.delta).requirement for G in free), key=lambda r: r.ratio
        )
    if requirement.ratio > 1 - wish.margin + 2 * SLACK:
        raise DesignFailed(None, (), _missed(requirement.ratio, wish))
    figures = [transparency(F, E, spec.lam) for F, E in zip(maps, environments(spec), strict=True) if E.D.any()]
    squares = [f.rms_mismatch**2 for f in figures]
    value = np.sqrt(np.mean(squares)) if wish.objective == "rms" else max(f.relative_mismatch for f in figures)
    wall = time.perf_counter() - started
    return Design(coupling, "closed-loop", wish.objective, float(value), requirement, rounds, wall)


def _missed(ratio: float, wish: Wish) -> str:
    more = wish.margin + 2 * (ratio - (1 - wish.margin))
    advice = f"leave more of it unused: --margin {more:.2g}" if more < 1 else "ask for fewer functions"
    return f"the optimum needs {ratio:.6f} of the damping when it is swept again; {advice}"


def searched(
    spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None
) -> tuple[InternalModel, Specification, int]:
    """(coupling, the specification with the points of the box that had to be added, rounds).

    Between the vertices of a box nothing is convex: what a search finds to violate the condition there becomes further
    environments, until it finds nothing. Raises DesignFailed where it still does after MOST_ADDITIONS times.
    """
    total, added, Q = 0, 0, parameter(spec, wish)
    if wish.filter == "adapted":
        Q, total = descend(Q, wish, worlds(spec), np.asarray(spec.delta))
    while True:
        coupling, rounds = cut(Q, wish, worlds(spec), np.asarray(spec.delta))
        total += rounds
        worst = violators(spec, coupling, 1 - wish.margin / 2, progress)
        if not worst:
            return coupling, spec, total
        if added == MOST_ADDITIONS:
            raise DesignFailed(None, (), _still_violated(worst[0]))
        added += 1
        more = {found.member.name: environment(found.member.network, spec.T) for found in worst[:ADDED]}
        spec = replace(spec, others={**spec.others, **more})


def violators(
    spec: Specification, coupling: InternalModel, most: float, progress: Progress = lambda what, done, total: None
) -> list[Found]:
    """Where in the box more than this share of the damping is needed, the worst first; a search finds them."""

    def ratio(member: Member) -> float:
        F = force_map(environment(member.network, spec.T), coupling, spec.theta, spec.psi)
        return closed_loop(F, spec.delta).ratio

    found = search(spec.regions, ratio, lambda done, total: progress("searching the box", done, total))
    return [one for one in found.worst if one.ratio > most]


def _still_violated(found: Found) -> str:
    return (
        f"after {MOST_ADDITIONS} rounds of adding the worst environments of the box to the design it is still violated "
        f"between the vertices: {found.ratio:.4f} of the damping is needed at {found.member.name}; "
        "give narrower ranges, or ask for more functions"
    )
