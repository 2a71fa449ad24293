"""Design the optimal coupling: the force filter R of least mismatch whose loop satisfies a condition, with a proof.

The search tries larger and larger bases of R. For each basis it solves a convex program (design.program), rounds the
coefficients of R to decimals, and scales the forces down until a refined sweep certifies the coupling. It returns the
best coupling that exact arithmetic proves, if there is one. Since R(1) = g I, the static stiffness is F(1) = g E(1).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from haptic_loop.controller.arithmetic import TooLong, spent, units_since, within
from haptic_loop.controller.coupling import NO_PAIRS, Coupling, ForceFilter, NoCoupling
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design import budgets, program
from haptic_loop.design.certificate import prove, required_damping
from haptic_loop.design.conditions import Condition, ratio_in
from haptic_loop.design.conditions import this_environment as requirement_of
from haptic_loop.design.environments import BETA, LIMITER, THIS_ENVIRONMENT, LimitedForces, beta_of, in_each, worst
from haptic_loop.design.known_device import KNOWN_DEVICE, KnownDevice, LimitedKnownDevice, largest_beta
from haptic_loop.design.result import Design, DesignFailed, NotProved
from haptic_loop.design.spring_damper import design as design_spring_damper
from haptic_loop.design.transparency import Transparency, decibels, transparency
from haptic_loop.design.worst_member import search_ranges

#: The search ends after a basis of at least _FEWEST_TAPS taps that gains less than this [dB]. The number depends on
#: whether this-environment is the only constraint (`_Search.simply`).
_SETTLED_DB, _FEWEST_TAPS = 0.05, {True: 22, False: 14}
_SETTLED = f"it gains less than {_SETTLED_DB:g} dB"
#: The search ends before a basis of more than 26 taps if the last basis was certified and gained less than 0.1 dB.
_LARGE, _PROMISING_DB = 26, 0.1
_KEPT_STIFFNESS = 0.5  # A coupling is rejected if it has less than this share of the best coupling's static stiffness.
_FELT_STIFFNESS = 0.02  # A static stiffness below this share of the environment's is not felt, so it may be lost.
_LAGS = ((BETA, 0.05), (0.1, 0.5), (0.5, 2.0))  # tried (beta, c) of a limiter; if psi = 0, the first alone
_HOPELESS = 0.9  # Above this mismatch (`_Search.mismatch`) the coupling is compared with simpler ones.
_RESERVES = (0.95, 2.5, 50.0)  # unused damping in units of MARGIN; after a failed proof the next value is tried
#: An environment in which the coupling requires more than 1 + _TOLERATED times the damping is added to the program. For
#: smaller excesses the forces are scaled down.
_TOLERATED = 0.02
_SEARCHED = 0.2  # least share of --seconds for the search between the vertices of ranges


@dataclass(frozen=True)
class _BasisResult:
    taps: int
    poles: int
    states: int  # order of the loop
    mismatch_db: float  # [dB] objective
    g: float  # share of the environment's static stiffness
    # Reason why the coupling is not certified, or None. With a limiter or known devices, certified means proved.
    reason: str | None
    seconds: float  # time since the design began
    rejected: str | None = None  # reason why the coupling is rejected although it is certified, or None

    @property
    def certified(self) -> bool:
        return self.reason is None

    @property
    def taken(self) -> bool:
        return self.certified and self.rejected is None


@dataclass(frozen=True, eq=False)
class Optimal(Design):
    """The best coupling, with its certificate if it is proved, and the results of all bases that were tried."""

    figures: Transparency = field(kw_only=True)
    g: float = field(kw_only=True)  # F(1) = g E(1); for couplings other than force filters, norm(F(1))/norm(E(1))
    states: int = field(kw_only=True)  # order of the loop
    bases: tuple[_BasisResult, ...] = field(kw_only=True, default=())
    reason: str | None = field(kw_only=True, default=None)  # reason why there is no proof, or None

    @property
    def proved(self) -> bool:
        return self.certificate is not None


_Progress = Callable[[str, int, int], None] | None  # called with (task, number of finished bases, number of bases)


def design_with(
    loop: Loop, condition: str = THIS_ENVIRONMENT.name, progress: _Progress = None, **options: Any
) -> Optimal:
    """Return the optimal coupling under `condition` for Options(**options). `progress` is called before each task."""
    made = _for_known_devices if condition == KNOWN_DEVICE.name else design
    return made(loop, program.Options(**options), progress)


def design(loop: Loop, options: program.Options = program.DEFAULT, progress: _Progress = None) -> Optimal:
    """Return the coupling of least mismatch in the loop's environment, with its certificate if it is proved.

    With ranges around the environment, a proved coupling satisfies this-environment at every vertex (at 128 vertices
    if there are more) and at every point that the search between the vertices visits. With a range of delays, any
    switching within the range is safe. If no optimal coupling can be proved or its mismatch is large, it is compared
    with two simpler couplings: the environment scaled down (R = kappa I) and the best spring-damper.

    Raises ValueError for a delta that is not positive, for walls, for switching delays with a latency, for a limiter
    that has no design in this loop, and for a loop that no damping makes safe without a coupling.
    """
    if min(loop.delta) <= 0:
        raise ValueError(f"delta, the damping of devices, is {list(loop.delta)}, expected positive numbers [N s/m]")
    search = _Search.of(loop, options, progress)
    if exactly := search.nothing():
        return exactly
    improving, hurried = _over_bases(search)
    best = improving[-1] if improving else None
    # With a limiter each basis uses the multipliers of an earlier proof, so that no proof is left for later.
    unproved = [] if options.limiter else improving[::-1][: budgets.RANGED_BASES if loop.ranges else None]
    for candidate in unproved:
        search.say("searching the ranges" if loop.ranges else "proving the coupling")
        best = search.between(candidate) if loop.ranges else search.proved_or_smaller(candidate)
        hurried |= best.searched is not None and best.searched.ended == "clock"
        if best.proved:
            break
    if best is None or not best.proved or search.mismatch(best) > _HOPELESS:
        search.say("designing simpler couplings to compare")
        rivals = [one for one in (best, search.scaled(), search.spring_damper()) if one is not None]
        best = min(rivals, key=lambda one: (not one.proved, search.merit(one)))
    return search.finished(best, hurried)


def _over_bases(search: _Search) -> tuple[list[Optimal], bool]:
    """Return the couplings that were accepted, from worst to best, and whether --seconds ended the search."""
    improving, results = list[Optimal](), search.results
    floor, gained = _felt(min(search.simple, 1.0)), np.inf
    for taps, poles in search.options.bases:
        if taps > _LARGE and gained < _PROMISING_DB:
            break
        if results and not search.room(taps, poles, max((r.states for r in results if r.reason is None), default=0)):
            continue
        best = improving[-1] if improving else None
        search.say(f"optimising a filter of {taps} taps and {poles} poles")
        try:
            left = max(budgets.GROWTH - units_since(search.spent), 0.0)
            with within(left if results else np.inf, "a larger basis", clock=search.over if results else None):
                least = _SETTLED_DB if taps > _LARGE else -np.inf
                candidate, result = search.over_basis(taps, poles, best, floor, least)
        except TooLong:
            return improving, search.over()
        gained = np.inf if result.reason else search.gained(best, candidate)
        if best and candidate.g < floor and result.certified:
            result = replace(
                result, rejected=f"it renders {candidate.g:.3f} of the stiffness, less than half of another coupling's"
            )
        elif gained <= 0 or result.reason == _SETTLED:
            result = replace(result, rejected=f"{_SETTLED}, with lost stiffness counted")
        results.append(result)
        if result.taken:
            floor = max(floor if best else 0.0, _felt(_KEPT_STIFFNESS * candidate.g))
            improving.append(candidate)
        if result.reason == _SETTLED or (gained < _SETTLED_DB and taps >= _FEWEST_TAPS[search.simply]):
            break
        if search.over():
            return improving, True
        last = results[-budgets.UNPROVED_BASES :]
        hopeless = len(last) == budgets.UNPROVED_BASES and not any(each.certified for each in last)
        if hopeless and not search.loop.ranges:
            break
    return improving, False


#: tried shares of the largest beta. All channels have the same share, because different shares gain hardly anything.
_ETAS = 0.15, 0.3, 0.5
_SCALINGS = 6  # largest number of scalings of the forces; each reduces them by at least the share MARGIN


def _for_known_devices(loop: Loop, options: program.Options, progress: _Progress) -> Optimal:
    """Return the best coupling under known-device, or the best under this-environment if its mismatch is less.

    For fixed beta and fixed multipliers of the facts (design.facts) the block is affine in the forces. The filter over
    the smallest basis is designed for three values of beta. The parabola in log beta through their three merits has its
    least value at the beta that is used for larger bases. These use the multipliers of the last accepted filter.

    Raises ValueError for a loop that `design` refuses or known-device does not cover.
    """
    if reason := KNOWN_DEVICE.beyond(loop):
        raise ValueError(f"{KNOWN_DEVICE.name}: {reason}")
    search = replace(_Search.of(loop, options, progress), condition=KNOWN_DEVICE)
    if exactly := search.nothing():
        return exactly
    plain = design(loop, options, progress)
    search.results.extend(plain.bases)
    again = search.proved(plain.coupling)
    best = again if again.proved else plain
    eta, multipliers = None, search.multipliers(plain.coupling)
    for taps, poles in options.bases:
        if not search.room(taps, poles, 0):
            break
        search.say(f"optimising a filter of {taps} taps and {poles} poles for known devices")
        tried = [
            search.over_known(each, multipliers, search.mismatch(best), taps, poles)
            for each in ([eta] if eta else _ETAS)
        ]
        if not eta:
            middle, curved = (
                np.polynomial.Polynomial.fit(np.log(_ETAS), list(map(search.merit, tried)), 2).convert().coef[1:]
            )
            eta = float(np.clip(np.exp(-middle / (2 * curved)), _ETAS[0], _ETAS[-1])) if curved > 0 else _ETAS[1]
        candidate = search.scaled_and_proved(min(tried, key=search.merit))
        result = search.result(taps, poles, candidate)
        gained = search.gained(best, candidate)
        if candidate.proved and gained <= 0:
            result = replace(result, rejected=f"{_SETTLED}, with lost stiffness counted")
        search.results.append(result)
        if result.taken:
            best, multipliers = candidate, search.multipliers(candidate.coupling)
        if gained < _SETTLED_DB or search.over():
            break
    if loop.ranges and best.condition == KNOWN_DEVICE.name:
        between = search.between(best)
        best = between if between.proved and search.gained(plain, between) > 0 else plain
    figures = f"{best.condition}, {search.decibels(best):.2f} dB"
    note = f"{figures}; this-environment, for devices of which less is known: {search.decibels(plain):.2f} dB"
    return replace(search.finished(best, search.over()), notes=(note,))


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for one loop: its options, and the environments with their constraints."""

    loop: Loop
    options: program.Options
    cases: tuple[program.Case, ...]  # the loop's nominal environment, then the vertices of its ranges
    bare: float  # required over available damping without a coupling, in the worst environment
    started: float  # clock time [s] at the start, for the report and for --seconds
    spent: int  # work that had been counted at the start
    progress: _Progress
    condition: Condition = THIS_ENVIRONMENT  # the condition that judges and proves couplings
    results: list[_BasisResult] = field(default_factory=list)  # results of the finished bases, which the search adds

    @classmethod
    def of(cls, loop: Loop, options: program.Options, progress: _Progress) -> _Search:
        started = time.perf_counter()
        if loop.environment.walls:
            raise ValueError("an optimal coupling holds a linear model of the environment: walls have none")
        if loop.varying_delay and loop.latency:
            raise ValueError("an optimal coupling is designed for switching delays or a latency, not both: remove one")
        cases: list[program.Case] = []
        for member in loop.members():
            there = loop.at(member.network).switching(None)
            constraints = [
                program.this_environment(there),
                *([program.switching(there, loop.varying_delay)] if loop.varying_delay else []),
            ]
            if options.high_gain is not None and 2 * program.HIGH_HZ * loop.T < 1 and there.E().D.any():
                constraints.append(program.most_gain(there, options.high_gain))
            if options.objective == "sup" and not cases:
                constraints.append(program.worst_mismatch(there, options.band_hz))
            cases.append(program.Case(there, there.E(), tuple(constraints)))
        if options.limiter and (reason := LIMITER.not_designed(loop)):
            raise ValueError(reason)
        needs = in_each(loop, NoCoupling(), loop.members())
        if not np.isfinite(bare := max(each.ratio for each in needs)):
            raise ValueError(f"the loop without a coupling: {next(each.reason for each in needs if each.reason)}")
        return cls(loop, options, tuple(cases), bare, started, spent(), progress)

    def say(self, task: str) -> None:
        """Report the progress before a task."""
        last = f" (last filter: {self.results[-1].mismatch_db:z.2f} dB)" if self.results else ""
        if self.progress:
            self.progress(f"{task}{last}", len(self.results), len(self.options.bases))

    def result(self, taps: int, poles: int, candidate: Optimal) -> _BasisResult:
        """Return the result of the basis with this best coupling."""
        error = self.decibels(candidate)
        return _BasisResult(taps, poles, candidate.states, error, candidate.g, candidate.reason, self.elapsed)

    def finished(self, best: Optimal, hurried: bool) -> Optimal:
        """Return `best` with the results of all bases."""
        return replace(best, bases=tuple(self.results), sdps=len(self.results), hurried=hurried)

    @property
    def elapsed(self) -> float:
        return time.perf_counter() - self.started

    def over(self, share: float = 1.0) -> bool:
        return self.options.seconds is not None and self.elapsed > share * self.options.seconds

    @property
    def constrained(self) -> bool:
        """Whether the design has constraints besides this-environment."""
        return self.options.limiter or any(len(case.constraints) > 1 for case in self.cases)

    @property
    def simply(self) -> bool:
        """Whether this-environment is the only constraint, and the loop has neither ranges nor a latency."""
        return not (self.constrained or self.loop.latency or self.loop.ranges)

    def slips(self, before: Optimal | None) -> tuple[program.Slip | None, ...]:
        """Return the limiters to try: that of the coupling `before`, or those of _LAGS, or (None,) for no limiter."""
        if not self.options.limiter:
            return (None,)
        if before and before.certificate:
            beta, c = beta_of(self.loop, before.certificate), before.certificate.multipliers["c"]
            condition = LimitedForces(beta, len(c) // len(self.loop.devices))
            return (program.Slip(beta, condition.rows(self.loop, c)),)
        tried = _LAGS if any(self.loop.psi) else _LAGS[:1]
        return tuple(program.Slip(beta, ((c,),) * len(self.loop.devices)) for beta, c in tried)

    def cases_with(self, slip: program.Slip | None) -> tuple[program.Case, ...]:
        """Return the environments with their constraints, including the limiter's block for `slip`."""
        if slip is None:
            return self.cases
        here = program.limiter(self.loop, slip)
        return tuple(replace(case, constraints=(*case.constraints, here)) for case in self.cases)

    def mismatch(self, candidate: Optimal) -> float:
        """Return the objective: the rms or largest mismatch relative to the environment, as a ratio."""
        figures = candidate.figures
        return figures.rms_mismatch if self.options.objective == "rms" else figures.relative_mismatch

    def decibels(self, candidate: Optimal) -> float:
        return decibels(self.mismatch(candidate))

    def merit(self, candidate: Optimal) -> float:
        """Return the figure that ranks couplings, less is better: mismatch combined with lost static stiffness."""
        static = program.static_weight(self.loop) * (candidate.g - 1) if np.isfinite(candidate.g) else 0.0
        return float(np.hypot(self.mismatch(candidate), static))

    def gained(self, before: Optimal | None, candidate: Optimal) -> float:
        """Return by how many dB the merit of `candidate` is below that of `before`; infinity if `before` is None."""
        return np.inf if before is None else decibels(self.merit(before)) - decibels(self.merit(candidate))

    @property
    def simple(self) -> float:
        """The largest kappa for which R = kappa I meets this-environment with MARGIN unused; 1 if every kappa does."""
        return (1 - program.MARGIN) / self.bare if self.bare > 0 else 1.0

    def nothing(self) -> Optimal | None:
        """Return the loop without a coupling as a design, if nothing can be better, or None.

        The result is None if this loop has a mismatch or is not safe, if there are further constraints, or if a limiter
        is requested and has no proof.
        """
        loop = self.loop
        exact_delay = all(n == t + p for n, t, p in zip(loop.lam, loop.theta, loop.psi, strict=True))
        more = any(len(case.constraints) > 1 for case in self.cases)
        if more or not exact_delay:
            return None
        candidate = self._assessed(NoCoupling())
        if candidate.requirement.ratio > 1 - program.MARGIN:
            return None
        candidate = self._proved(candidate, self.slips(None)[0])
        return candidate if candidate.proved or not self.options.limiter else None

    def span(self, taps: int, poles: int) -> program.Span:
        full = program.FULL if self.simply else program.FULL_BESIDE
        return program.span_of(self.cases[0].E, taps, poles, self.options.band_hz[1], full)

    def room(self, taps: int, poles: int, before: int) -> bool:
        """Return whether a basis is small enough to be tried, and gives a loop with more than `before` states."""
        span, loop = self.span(taps, poles), self.loop
        m = loop.channels
        own, full = int((span.used.sum(axis=1) > 0)[:, :m].sum()), span.used.shape[2] == m
        states = own + (0 if full else len(span.used) - own // m)
        states += self.cases[0].E.order + sum(loop.theta) + sum(loop.psi)
        proofs = len(self.cases) * states**2.7  # cost of the proofs, in the unit of budgets.BASIS_PROOFS
        beside = taps <= _LARGE and m * span.unknowns <= budgets.BASIS_BESIDE
        solved = span.unknowns <= budgets.BASIS_UNKNOWNS if full and self.simply else beside
        return before < states <= budgets.BASIS_STATES and solved and proofs <= budgets.BASIS_PROOFS

    def over_basis(
        self, taps: int, poles: int, before: Optimal | None, floor: float, least: float
    ) -> tuple[Optimal, _BasisResult]:
        """Return the best coupling over a basis, scaled so that every sweep passes, and the basis's result.

        If the coupling has less than the share `floor` of the environment's static stiffness, the program is solved
        again with a larger weight of the stiffness. `before` and `least` are those of `solved`.
        """
        for heavier in (1.0, 2.5, 6.0):
            tried = [self.solved(taps, poles, before, slip, heavier, least) for slip in self.slips(before)]
            candidate = min(tried, key=lambda one: (one.reason is not None, self.merit(one)))
            if candidate.g >= floor or candidate.reason:
                break
        return candidate, self.result(taps, poles, candidate)

    def solved(
        self,
        taps: int,
        poles: int,
        before: Optimal | None,
        slip: program.Slip | None,
        heavier: float,
        least: float,
    ) -> Optimal:
        """Return the best coupling over a basis, scaled so that every sweep passes.

        Args:
            before: The best coupling of smaller bases, or None.
            slip: The limiter, or None. With a limiter the coupling is also proved, if possible.
            heavier: The factor on the weight of the static stiffness.
            least: The least gain over `before` [dB] for which a proof is tried.
        """
        error = self.mismatch(before) if before else 1.0
        soft = program.SOFT[0] * min(error, program.SOFT[1])
        problem = program.Problem(self.span(taps, poles), self.cases_with(slip), self.options, soft, heavier=heavier)
        coupling, needs = self.kept_in_all(problem)
        if slip:
            needs.append(min(required_damping(self.loop, coupling, LimitedForces(slip.beta)).ratio, 1 + _TOLERATED))
        tried = list[Optimal]()
        for share in _RESERVES:
            limit = 1 - share * program.MARGIN
            scale = min(1.0, (1 - program.MARGIN) / max(needs)) if max(needs) > limit else 1.0
            candidate = self._assessed(_scaled(coupling, min(scale, limit / max(needs))))
            if self.gained(before, candidate) < least:
                return replace(candidate, reason=_SETTLED)
            if not self.options.limiter:
                return candidate
            tried.append(self._proved(candidate, slip))
            if tried[-1].proved:
                break
        return tried[-1]

    def proved_or_smaller(self, candidate: Optimal) -> Optimal:
        """Return the coupling with its proof, after scaling the forces down if necessary, or without a proof."""
        coupling, needs = candidate.coupling, max(candidate.requirement.ratio, 1 - program.MARGIN)
        assert isinstance(coupling, ForceFilter)
        smaller = (_scaled(coupling, (1 - share * program.MARGIN) / needs) for share in _RESERVES[1:])
        return self.first_proved(chain([candidate], map(self._assessed, smaller)))

    def kept_in_all(
        self, problem: program.Problem, need: Callable[[Loop, Coupling], float] = ratio_in
    ) -> tuple[ForceFilter, list[float]]:
        """Return (solution of the program, its required over available damping in each environment).

        `need` computes this ratio. The program is first solved for the nominal environment. While the coupling requires
        more than 1 + _TOLERATED times the damping in another environment, the two worst environments are added, and the
        program is solved again.
        """
        active = [0]
        while True:
            some = replace(problem, cases=tuple(problem.cases[i] for i in active))
            coupling = problem.span.filter(some.solve(self._start(some)))
            needs = [need(case.loop, coupling) for case in self.cases]
            missed = [int(i) for i in np.argsort(needs)[::-1] if needs[i] > 1 + _TOLERATED and i not in active]
            if not missed:
                return coupling, needs
            active = active + missed[:2]

    def between(self, candidate: Optimal) -> Optimal:
        """Return the coupling with a proof at each vertex of the ranges, after a search between the vertices.

        If the coupling leaves less than MARGIN/2 of the damping unused in the worst environment of the search, the
        forces are scaled down. If the proof still fails after a second scaling, the coupling is returned without it.
        """
        unscaled = candidate.coupling
        assert isinstance(unscaled, ForceFilter)
        begun = self.elapsed / self.options.seconds if self.options.seconds else 0.0
        over = partial(self.over, max(1.0, begun + _SEARCHED))
        if self.condition is KNOWN_DEVICE or self.loop.varying_delay:
            return self._between_with_multipliers(candidate, unscaled, over)
        searched = search_ranges(self.loop, unscaled, over=over)
        ratio, last = searched.worst[0].ratio, candidate
        for limit in (1 - program.MARGIN / 2, 1 - 2.5 * program.MARGIN):
            share = min(1.0, limit / ratio)
            coupling = _scaled(unscaled, share)
            # The required damping is proportional to the forces.
            lower = tuple(replace(one, ratio=one.ratio * share) for one in searched.worst)
            last = replace(self.proved(coupling), searched=replace(searched, worst=lower))
            if last.proved:
                break
        return last

    def _between_with_multipliers(self, candidate: Optimal, coupling: ForceFilter, over: Callable[[], bool]) -> Optimal:
        """Return the coupling with a proof by one set of multipliers for all environments of the ranges, or without.

        The forces are scaled down until the proof succeeds, at most _SCALINGS times. `over` ends the search.
        """
        last = candidate
        for _ in range(_SCALINGS):
            needs = required_damping(self.loop, coupling, self.condition)
            if needs.certified:
                last = self.proved(coupling)
                values = needs.multiplier

                def ratio(there: Loop, coupling: Coupling = coupling, values: Any = values) -> float:
                    return required_damping(there, coupling, self.condition, values).ratio

                searched = search_ranges(self.loop, coupling, over=over, ratio=ratio)
                last = replace(last, searched=searched)
                needs = replace(needs, required=tuple(searched.worst[0].ratio * d for d in needs.available))
                if last.proved and needs.certified:
                    return last
            coupling = _scaled(coupling, (1 - program.MARGIN) * min(1.0, 1 / needs.ratio))
        return replace(last, certificate=None, reason=last.reason or "no scaling of its forces is proved in the ranges")

    def scaled(self) -> Optimal:
        """Return the coupling R = kappa I. If its proof fails, smaller kappa are tried, down to half of the first."""
        span = program.Span(np.zeros(0), NO_PAIRS, np.zeros((0, self.loop.channels, self.loop.channels), dtype=bool))
        (slip, *_) = self.slips(None)
        problem = program.Problem(span, self.cases_with(slip), self.options, 0.0)
        kappa = self._start(problem)[0] if self.constrained else min(1.0, self.simple)
        shares = (np.floor(share * kappa * 1e6) / 1e6 for share in (1.0, 0.97, 0.9, 0.7, 0.5))
        return self.first_proved((self._assessed(span.filter(np.array([share]))) for share in shares), slip)

    def first_proved(self, candidates: Iterable[Optimal], slip: program.Slip | None = None) -> Optimal:
        """Return the first candidate that is proved, or the last one with the reason why its proof failed."""
        tried = list[Optimal]()
        for candidate in candidates:
            tried.append(self._proved(candidate, slip))
            if tried[-1].proved:
                break
        return tried[-1]

    def spring_damper(self) -> Optimal | None:
        """Return the best spring-damper. With ranges, a latency or further constraints the result is None."""
        if len(self.cases) > 1 or self.constrained or self.loop.latency:
            return None
        try:
            return self.proved(design_spring_damper(self.loop, "this-environment", limiter=False).coupling)
        except (DesignFailed, ValueError):
            return None

    @property
    def known(self) -> KnownDevice:
        """The condition known-device, with limited forces if the options contain the limiter."""
        return LimitedKnownDevice() if self.options.limiter else KNOWN_DEVICE

    def multipliers(self, coupling: Coupling) -> tuple[float, ...]:
        """Return the facts' multipliers with which known-device requires the least damping.

        If no multipliers are found, the result is their start values.
        """
        best = self.known.required(self.loop, coupling).multiplier
        usual = [value for each in self.known.unknowns(self.loop) for value in each.start or each.units]
        return tuple(best[3 * self.loop.channels :] if best else usual)

    def over_known(self, eta: float, multipliers: Sequence[float], error: float, taps: int, poles: int) -> Optimal:
        """Return the best coupling over a basis for fixed beta and multipliers of the facts.

        beta is `eta` times the largest beta, and `error` is the mismatch of the best coupling so far.
        """
        loop = self.loop
        largest = loop.per_device(largest_beta(loop, 1 - program.MARGIN))  # All axes of a device share beta.
        beta = np.array(loop.per_channel((eta * largest).tolist()))
        own = multipliers[: sum(len(each.units) for each in KNOWN_DEVICE.unknowns(loop))]
        whole = (*beta.tolist(), *(0.0,) * 2 * beta.size, *own)

        def constrained(case: program.Case) -> program.Case:
            beside = [each for each in case.constraints if each.name in ("high-frequency gain", "mismatch")]
            there = case.loop.switching(loop.varying_delay)  # The loop of a case has constant delays.
            return replace(case, constraints=(program.known_device(there, self.known, beta, multipliers), *beside))

        def need(there: Loop, coupling: Coupling) -> float:
            there = there.switching(loop.varying_delay)
            return KNOWN_DEVICE.judge(there, coupling, whole).ratio if loop.ranges else 0.0

        soft = program.SOFT[0] * min(error, program.SOFT[1])
        problem = program.Problem(self.span(taps, poles), tuple(map(constrained, self.cases)), self.options, soft)
        coupling, _ = self.kept_in_all(problem, need)
        return self._assessed(coupling, whole)

    def scaled_and_proved(self, candidate: Optimal) -> Optimal:
        """Return the coupling with a proof of known-device for the best beta, or without.

        The forces are scaled down until the proof succeeds, at most _SCALINGS times.
        """
        coupling = candidate.coupling
        assert isinstance(coupling, ForceFilter)
        for _ in range(_SCALINGS):
            candidate = self.proved(coupling)
            if candidate.proved:
                break
            coupling = _scaled(coupling, (1 - program.MARGIN) * min(1.0, 1 / candidate.requirement.ratio))
        return candidate

    def _start(self, problem: program.Problem) -> Array:
        """Return the unknowns of a coupling R = kappa I that satisfies every constraint strictly.

        Some kappa > 0 does, because F = 0 satisfies every constraint strictly. For LimitedForces with F = 0 the Schur
        complement is rho (Re M/z - beta/4). Its multiplier M has Re M/z = 1 + sum c_j (j - cos w - .. - cos jw) >= 1.
        """
        kappa = 0.5 / max(self.bare, 0.5)
        grids = [problem.grid(part) for part in problem.parts]
        while problem.room(start := problem.start(kappa), grids) <= 0:
            kappa /= 2
        return start

    def _assessed(self, coupling: Coupling, multiplier: Sequence[float] | None = None) -> Optimal:
        """Return the coupling with its figures and its required damping from a sweep, without a proof.

        For known-device, `multiplier` contains beta, zeros in place of the bounds of q (`known_device._q_bounds`), and
        the facts' multipliers. If `multiplier` is None, beta and the facts' multipliers are searched.
        """
        loop, members = self.loop, self.loop.members()
        F = loop.F(coupling)
        if self.condition is KNOWN_DEVICE:
            requirements = [KNOWN_DEVICE.judge(loop, coupling, multiplier)]
        else:
            requirements = [requirement_of(F, loop), *in_each(loop, coupling, members[1:])]
        requirement = requirements[worst(requirements)]
        figures = transparency(F, self.cases[0].E, loop.lam, self.options.band_hz)
        objective = self.options.objective
        return Optimal(
            coupling,
            self.condition.name,
            objective,
            figures.rms_mismatch if objective == "rms" else figures.relative_mismatch,
            requirement,
            figures=figures,
            g=1.0 if isinstance(coupling, NoCoupling) else getattr(coupling, "g", figures.dc_ratio),
            states=F.order,
            reason=None if requirement.certified else requirement.reason or "the sweep does not certify it",
        )

    def proved(self, coupling: Coupling, slip: program.Slip | None = None) -> Optimal:
        """Return the coupling with its certificate, or with the reason why the proof failed."""
        return self._proved(self._assessed(coupling), slip)

    def _proved(self, candidate: Optimal, slip: program.Slip | None) -> Optimal:
        """Return `candidate` with its certificate, or with the reason why the proof failed."""
        loop, coupling = self.loop, candidate.coupling
        try:
            if self.condition is KNOWN_DEVICE:
                swept = None if self.options.limiter else candidate.requirement
                certificate = prove(loop, coupling, self.known, swept=swept)
            elif slip:
                certificate = prove(loop, coupling, LimitedForces(slip.beta))
            else:
                certificate = prove(
                    loop, coupling, THIS_ENVIRONMENT, swept=None if loop.varying_delay else candidate.requirement
                )
        except NotProved as error:
            return replace(candidate, reason=str(error))
        needs = certificate.required if loop.varying_delay else candidate.requirement.required
        requirement = replace(candidate.requirement, required=needs, proof="rational")
        return replace(candidate, requirement=requirement, certificate=certificate, reason=None)


def _felt(g: float) -> float:
    """Return g, or 0 if nobody would feel a stiffness of the share g of the environment's."""
    return g if g >= _FELT_STIFFNESS else 0.0


def _scaled(coupling: ForceFilter, scale: float) -> ForceFilter:
    """Return the filter times `scale`, with coefficients in decimals, such that R(1) = g I holds exactly."""
    every = np.ones((len(coupling.R) - 1, *coupling.R.shape[1:]), dtype=bool)
    return program.Span(coupling.poles, coupling.pairs, every).filter(
        np.append(coupling.g, coupling.R[1:].ravel()), scale
    )
