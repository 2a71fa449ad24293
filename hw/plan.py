"""From a measured delay to a coupling that is certified for it, and to softer ones for when the link gets worse.

The link takes `link` ticks from a sample to the latch of its force, for every axis. Channels whose delay theta_i
in the scenario is longer wait for the rest, theta_i - link, on the host: the loop has the scenario's delays as long
as the link is no slower, and longer ones where it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from controller.environment import environment
from controller.loop import force_map
from controller.lti import Lti
from design.certificate import assess, certificate_part, promise_of
from design.conditions import Requirement
from design.result import DesignFailed
from hw.law import Controller, Law
from hw.message import MAX_THETA
from hw.safety import Fault
from sim.couplings import Chosen, choose
from sim.report import coupling_part
from sim.scenario import InputError, Scenario

FALLBACK = ("spring-damper", "theorem4")  # what softer couplings are where the one asked for cannot be had


@dataclass(frozen=True)
class Ages:
    """How old a force is when it reaches the device, counted from its sample [us], and how many never do."""

    values: tuple[int, ...]
    missing: int = 0

    def quantile(self, q: float) -> int:
        """The least age that a fraction q of all forces does not exceed. Raises Fault where so many never arrive."""
        ordered, everything = sorted(self.values), len(self.values) + self.missing
        place = min(everything - 1, int(q * everything))
        if place >= len(ordered):
            part = 100 * self.missing / everything
            raise Fault(f"{part:.2g} % of the answers never arrived: no delay keeps {100 * q:g} % (--quantile)")
        return ordered[place]

    @property
    def median(self) -> int:
        """Of those that arrived [us]."""
        return sorted(self.values)[len(self.values) // 2]


def link_delay(ages: Ages, T_us: float, quantile: float, guard_us: float) -> int:
    """Ticks from a sample to its latch: what a fraction of the answers keeps, with a guard, and at least one."""
    needed = ages.quantile(quantile) + guard_us
    return max(1, int(-(-needed // T_us)))


class Program(Protocol):
    """What a session can be armed with."""

    @property
    def link(self) -> int:
        """Ticks from a sample to the latch of its force."""
        ...

    @property
    def certified(self) -> bool:
        """Whether every passive human is safe with it."""
        ...

    @property
    def name(self) -> str:
        """For the log."""
        ...

    def controller(self) -> Controller:
        """A fresh one, at rest."""
        ...


@dataclass(frozen=True, eq=False)
class Rung:
    """A coupling with the delay that it is certified for."""

    link: int  # [ticks]
    scenario: Scenario  # with the delays of this loop
    case: str
    chosen: Chosen
    requirements: dict[str, Requirement]

    @property
    def certified(self) -> bool:
        return any(requirement.certified for requirement in self.requirements.values())

    @property
    def name(self) -> str:
        return f"{self.chosen.kind} for theta = {list(self.scenario.theta)}"

    @property
    def held(self) -> int:
        """Missed answers in a row through which the device may hold a force: so much the coupling's file proves."""
        span = self.chosen.switching
        return min(hi - n for hi, n in zip(span.hi, self.scenario.theta, strict=True)) if span else 0

    def controller(self) -> Controller:
        return Law(self.law())

    def law(self) -> Lti:
        """F as the host runs it: the link adds the remaining delay."""
        scenario = self.scenario
        E = environment(scenario.environment, scenario.T)
        return force_map(E, self.chosen.coupling, [n - self.link for n in scenario.theta], scenario.psi)

    def part(self) -> dict[str, Any]:
        """As plain data: coupling, certificates, promise."""
        return {
            "link_delay": self.link,
            "theta": list(self.scenario.theta),
            "coupling": coupling_part(self.chosen.kind, self.chosen.coupling, self.scenario.T),
            "certificate": certificate_part(self.requirements[self.chosen.condition]),
            "certificates": {name: certificate_part(r) for name, r in self.requirements.items()},
            "promise": promise_of(self.requirements, self.scenario.loop(self.case)),
            "remarks": self.remarks(),
        }

    def remarks(self) -> list[str]:
        """What a reader should know of the coupling's file."""
        if self.held < 1:
            return list(self.chosen.notes)
        answers = "1 missed answer" if self.held == 1 else f"{self.held} missed answers in a row"
        return [*self.chosen.notes, f"a force that is held through {answers} is covered by the file's proof"]


def rung(scenario: Scenario, case: str, name: str | None, condition: str | None, link: int) -> Rung:
    """The coupling `name` for a link of `link` ticks, with its certificates.

    Raises Fault where no coupling is certified for it, InputError where the request contradicts itself.
    """
    if link > MAX_THETA:
        raise Fault(f"the link takes {link} ticks, the protocol carries at most theta = {MAX_THETA}")
    slower = scenario.replace(theta=tuple(max(n, link) for n in scenario.theta))
    least = min(slower.theta)
    try:
        chosen = choose(slower, case, name, condition)
    except DesignFailed as error:
        raise Fault(f"no coupling for a link of {link} ticks: {error}") from None
    made = Rung(least, slower, case, chosen, assess(slower.loop(case), chosen.coupling, chosen.phi))
    if not made.certified:
        raise Fault(f"{_named(chosen)} is not certified for theta = {list(slower.theta)}: {_shortfall(made)}")
    return made


def ladder(
    scenario: Scenario, case: str, name: str | None, condition: str | None, link: int, spare: int = 2
) -> tuple[Rung, ...]:
    """The coupling for the measured delay and up to `spare` softer ones, each for one tick more.

    A softer one is of the same kind or from the same file; where that is not certified for the longer delay, it is
    the spring-damper by Theorem 4, which promises the most. Raises Fault where the first coupling is not certified;
    where no softer one is, the ladder ends.
    """
    rungs, wanted = [rung(scenario, case, name, condition, link)], [(name, condition), FALLBACK]
    while len(rungs) <= spare and wanted:
        kind, by = wanted[0]
        try:
            rungs.append(rung(scenario, case, kind, by, rungs[-1].link + 1))
        except (Fault, InputError):
            wanted.pop(0)
    return tuple(rungs)


def _named(chosen: Chosen) -> str:
    return "the loop without coupling" if chosen.kind == "none" else f"the coupling {chosen.kind}"


def _shortfall(made: Rung) -> str:
    needs = []
    for name, requirement in made.requirements.items():
        figures = ", ".join(f"{b:.4g}" for b in requirement.required)
        needs.append(requirement.reason or f"{name} needs {figures} of {requirement.available[0]:g} N s/m")
    return "; ".join(needs)
