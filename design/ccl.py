"""State-space couplings of fixed order under Theorem 4: the procedure of Remark 5, its replacement and its reference.

    complementarity   the cone-complementarity iteration as printed, with bisection on mu
    inner             inner convex approximation: feasible descent, no bisection (the default)
    fixed-poles       one state per channel, diagonal; global for given poles, the poles by a simplex search

All start from the structured spring-damper design and minimise ||W1 L W2||_inf (23). What is returned satisfies
Theorem 4 on a refined sweep, judged from the coupling alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

from controller.coupling import Compliance, SpringDamper
from controller.lti import Array, Lti
from design import spring_damper
from design.argument import of_kind, one_of, whole
from design.condition.delayed import theorem4_delayed
from design.designs import METHODS
from design.failure import DesignFailed
from design.fixed_order.cone_complementarity import bisect
from design.fixed_order.fixed_poles import FixedPoles
from design.fixed_order.inner_convex import descend
from design.fixed_order.realisation import FixedOrder
from design.margin import Requirement, theorem4
from design.result import Design, Row
from design.semidefinite.multiplier import shortage
from design.shaping import Shaping
from design.specification import Specification

#: The start is designed for this much less damping, so that it is strictly feasible.
START_ROOM = 1e-3
#: Descent ends when a step improves the norm by less than this, relatively.
SETTLED = 1e-4


def design(
    spec: Specification,
    order: int = 1,
    diagonal: bool = True,
    method: str = "inner",
    start: SpringDamper | None = None,
    most_sdps: int = 100,
) -> Design:
    """The coupling with `order` states per channel that `method` finds, from strictly feasible spring-damper gains.

    Raises Infeasible if Theorem 4 admits no spring-damper to start from, DesignFailed if no result is certified.
    """
    whole("order", order, 1)
    of_kind("diagonal", diagonal, bool, "True or False")
    one_of("method", method, METHODS)
    if method == "fixed-poles" and (order, diagonal) != (1, True):
        raise ValueError("method 'fixed-poles' is for one state per channel, diagonal")
    started = time.perf_counter()
    search = _Search(spec, order, diagonal, start)
    V = search.run(method, most_sdps)
    return Design(
        coupling=Compliance(V),
        condition="theorem4",
        figure="loop-norm",
        objective=search.shaping.norm(V)[0],
        requirement=search.requirement(V),
        sdps=search.sdps,
        wall_s=time.perf_counter() - started,
        phi=search.phi,
    )


def compare(spec: Specification, methods: Iterable[str] = METHODS, most_sdps: int = 100) -> tuple[Row, ...]:
    """Every method on the same specification, one state per channel, diagonal; the first row is their common start."""
    first = spring_damper.design(spec)
    rows = [Row("spring-damper", first.objective, first.sdps, first.wall_s)]
    for method in methods:
        started = time.perf_counter()
        try:
            found = design(spec, method=method, most_sdps=most_sdps)
            rows.append(Row(method, found.objective, found.sdps, found.wall_s))
        except DesignFailed as error:
            rows.append(Row(method, None, len(error.results), time.perf_counter() - started, str(error)))
    return tuple(rows)


class _Search:
    """One run: the family of couplings, the judge, and the count of problems solved."""

    def __init__(self, spec: Specification, order: int, diagonal: bool, start: SpringDamper | None) -> None:
        self.spec, self.shaping, self.sdps = spec, Shaping(spec), 0
        self.phi = shortage(spec)
        self.sigma = spring_damper.excess_limits(spec, self.phi)
        self.family = FixedOrder(spec, self.sigma, order, diagonal)
        self.gains = start or self._structured()

    def requirement(self, V: Lti) -> Requirement:
        spec = self.spec
        if self.phi is None:
            return theorem4(V, spec.theta, spec.delta)
        return theorem4_delayed(V, spec.environment, spec.theta, spec.psi, spec.delta, self.phi)

    def run(self, method: str, most_sdps: int) -> Lti:
        """The coupling found, certified."""
        if method == "fixed-poles":
            V = self._fixed_poles(most_sdps)
        else:
            p = self.family.start(self.gains)
            p = self._inner(p, most_sdps) if method == "inner" else self._complementarity(p, most_sdps)
            V = self.family.coupling(p)
        if not self.requirement(V).certified:
            raise DesignFailed(None, (), f"{method} gave no coupling that Theorem 4 certifies: try another start")
        return V

    def _structured(self) -> SpringDamper:
        reserved = replace(self.spec, delta=tuple((1 - START_ROOM) * d for d in self.spec.delta))
        found = spring_damper.design(reserved)
        self.sdps += found.sdps
        assert isinstance(found.coupling, SpringDamper)
        return found.coupling

    def _inner(self, p: Array, most_sdps: int) -> Array:
        norm = self.shaping.norm(self.family.coupling(p))[0]
        steps = descend(self.family, p, norm)
        for _ in range(most_sdps):
            try:
                trial = next(steps, None)
            except DesignFailed:
                break  # the solver's accuracy is exhausted: what the steps before reached stands
            if trial is None or not self._holds(trial, norm):
                break
            self.sdps += 1
            before, norm, p = norm, self.shaping.norm(self.family.coupling(trial))[0], trial
            if before - norm < SETTLED * norm:
                break
        return p

    def _complementarity(self, p: Array, most_sdps: int) -> Array:
        norm = self.shaping.norm(self.family.coupling(p))[0]
        p, spent = bisect(self.family, p, norm, self._holds, most_sdps)
        self.sdps += spent
        return p

    def _fixed_poles(self, most_sdps: int) -> Lti:
        problem = FixedPoles(self.spec, self.sigma)
        rate = self.gains.B / (self.gains.B + self.gains.K * self.spec.T)
        V, _ = problem.search(rate.tolist(), lambda V: self.requirement(V).certified, evaluations=most_sdps)
        self.sdps += problem.sdps
        return V

    def _holds(self, p: Array, mu: float) -> bool:
        """Whether the coupling p is certified and ||W1 L W2||_inf <= mu, from the coupling alone."""
        V = self.family.coupling(p)
        return V.is_stable() and self.requirement(V).certified and self.shaping.norm(V)[0] <= mu
