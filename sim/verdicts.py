"""Parts of the report of a validation: their figures, and the texts of their rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from haptic_loop.controller.environment import Network
from haptic_loop.controller.lti import Array
from haptic_loop.design.files import off_table
from haptic_loop.design.result import finite
from haptic_loop.models.device import Mechanics
from haptic_loop.models.human import Hand, Human, Person
from haptic_loop.sim.adversary import Worst
from haptic_loop.sim.crowds import Findings, Validation
from haptic_loop.sim.run import engine_name
from haptic_loop.sim.stability import disagree, unstable

_SETTLING = 4  # duration of a trace, in decay times of the slowest mode, from which its handles must slow down
_ROUNDING = 1e-9  # size of an energy W(N) < 0 (sim.crowds) that is rounding, relative to the sizes of its terms


@dataclass(frozen=True)
class Unstable:
    """Numbers of hands that make the loop unstable, by engine; None for an engine that did not run."""

    exact: int
    mujoco: int | None
    own: int | None = off_table("if given", None)  # number by a user's own engine
    others: str = off_table("left out", "")  # number by the second engine, with its name, as "3 MuJoCo"

    @classmethod
    def of(cls, question: Validation, exact: int, other: int | None) -> Unstable:
        """Return the record of two counts: of the exact engine, and of the second engine (`other`)."""
        if other is None or question.engine == "exact":
            return cls(exact, None)
        if isinstance(question.engine, str):
            return cls(exact, other, others=f"{other} MuJoCo")
        return cls(exact, None, other, f"{other} {engine_name(question.engine)}")

    def __str__(self) -> str:
        return ", ".join(filter(None, (f"{self.exact} exact", self.others)))


@dataclass(frozen=True)
class EnvironmentsMet:
    """The environments of the loops, and those in which a loop was unstable."""

    of: str  # "the nominal environment" or "the ranges"
    count: int  # number of environments
    names: list[str] | None = off_table("if given", None)  # names of the environments of the ranges
    unstable_in: list[str] | None = off_table("if given", None)  # names of those in which some humans are unstable

    @classmethod
    def met(cls, question: Validation, findings: Findings) -> EnvironmentsMet:
        members = question.environments
        if not members:
            return cls("the nominal environment", 1)
        where = sorted({int(i) % len(members) for i in findings.index[unstable(findings.exact)]})
        return cls("the ranges", len(members), [each.name for each in members], [members[i].name for i in where])

    def __str__(self) -> str:
        if self.unstable_in is None:
            return self.of
        return f"{self.count} of {self.of}, in turn; unstable in: {'; '.join(self.unstable_in) or 'none'}"


def disagreement_words(question: Validation, findings: Findings) -> str:
    """Return the number of disagreements in words; three of them with both engines' rates and a command to repeat."""
    engine = "MuJoCo" if isinstance(question.engine, str) else engine_name(question.engine)
    places = np.flatnonzero(findings.disagreements)
    words = [str(places.size)]
    for k in places[:3]:
        rates = f"exact {findings.exact[k]:+.3g} 1/s, {engine} {findings.mujoco[k]:+.3g} on its map"
        if findings.trace_decides[k]:
            rates += f" and {findings.trace[k]:+.3g} ± {findings.trace_error[k]:.2g} on its trace"
        switching, own = findings.switching[k], findings.switching_mujoco[k]
        if disagree(switching, own):
            rates += f"; exact {switching:+.3g}, {engine} {own:+.3g} while delays or ticks vary"
        index = int(findings.index[k])
        replay = (
            f"; repeat: sim.run --human disagreement-{index}.toml --error 1e-6" if question.can_store(index) else ""
        )
        words.append(f"index {index}: {rates}{replay}")
    return "; ".join(words)


def _held(human: Hand) -> dict[str, Any]:
    """Return the links of a Human, or the class and the port of a hand of another class."""
    if isinstance(human, Human):
        return {"links": human.links}
    port = {name: getattr(human.port(), name) for name in ("mass", "across", "damping", "stiffness")}
    return {"class": type(human).__name__} | port


@dataclass(frozen=True)
class DrawnHumans:
    """A set of humans that the population drew, with their environment."""

    seed: int
    index: int
    human: list[dict[str, Any]]
    person: tuple[Person, ...]
    environment: str | None = off_table("if given", None)  # name of an environment of the ranges
    network: Network | None = off_table("if given", None)  # this environment
    device: Sequence[Mechanics] | None = off_table("if given", None)  # mechanics drawn within the guaranteed bounds

    @classmethod
    def of(cls, question: Validation, index: int) -> DrawnHumans:
        crowd, member = question.crowd(index), question.environment(index)
        where = (member.name, member.network) if member else (None, None)
        drawn = crowd.mechanics[0] if crowd.mechanics else None
        humans = list(map(_held, crowd.humans(0)))
        return cls(question.seed, index, humans, crowd.persons(0), *where, drawn)


@dataclass(frozen=True)
class WorstDrawn:
    """The drawn humans with whom the loop has the largest spectral radius."""

    spectral_radius: float
    growth_rate_per_s: float
    frequency_hz: float
    who: DrawnHumans = off_table("inlined")

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> WorstDrawn:
        k = int(np.argmax(findings.radius))
        radius, growth, frequency = (float(of[k]) for of in (findings.radius, findings.exact, findings.frequency))
        return cls(radius, growth, frequency, DrawnHumans.of(question, int(findings.index[k])))

    def __str__(self) -> str:
        growth = f"{self.growth_rate_per_s:+.4g} 1/s at {self.frequency_hz:.2f} Hz (index {self.who.index})"
        return growth + (f", at {self.who.environment}" if self.who.environment else "")


@dataclass(frozen=True)
class Traces:
    """Figures of the traces, and whether they are long enough for handles to slow down."""

    duration_s: float
    humans: int
    clipped_runs: int  # number of traces in which a force reached its limit
    contacts: int  # number of times that a wall was touched
    measured: int  # number of traces with a growth rate
    witnessed: int  # number of traces that MuJoCo, or a user's own engine, also made
    undecided: int  # number of traces too short for the sign of their rate; eigenvalues decide there
    largest_difference_per_s: float | None  # largest difference of growth rates between a trace and its exact loop
    stable_and_settling: int  # number of stable loops with slower handles in the last quarter than in the second one
    stable: int  # number of stable loops
    slowest_settling: float | None  # largest ratio of late to early speeds of the handles of a stable loop
    slowest_decay_s: float | None  # decay time of the slowest mode that decays
    settling_decides: bool  # whether the traces are long enough for handles to slow down
    reason: str | None = off_table("if given", None)

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> Traces:
        stable, duration = ~unstable(findings.exact), question.ticks * question.scenario.T
        decay = largest(-1 / findings.exact[findings.exact < 0])
        decides = decay is None or duration >= _SETTLING * decay
        slow = f"the slowest mode decays in {decay or 0:.3g} s, so handles may not have slowed after {duration:g} s"
        return cls(
            duration_s=duration,
            humans=findings.index.size,
            clipped_runs=int((findings.clipped > 0).sum()),
            contacts=int(findings.contacts.sum()),
            measured=int(np.isfinite(findings.trace).sum()),
            witnessed=int(findings.witnessed.sum()),
            undecided=int((np.isfinite(findings.trace) & ~findings.trace_decides).sum()),
            largest_difference_per_s=largest(np.abs(findings.trace - findings.exact)),
            stable_and_settling=int((stable & (findings.settling < 1)).sum()),
            stable=int(stable.sum()),
            slowest_settling=largest(findings.settling[stable]),
            slowest_decay_s=decay,
            settling_decides=decides,
            reason=None if decides else slow,
        )

    def rows(self) -> Iterator[tuple[str, str | None]]:
        yield "traces", f"{self.duration_s:g} s each, {self.clipped_runs} reached a force limit"
        some = f"{self.witnessed} of {self.humans}: random ones, the nearest to the limit, all lossless ones"
        yield "traces by both engines", some if 0 < self.witnessed < self.humans else None
        undecided = f"undecided in {self.duration_s:g} s: {self.undecided} of {self.measured}; their eigenvalues decide"
        yield "growth on traces", undecided if self.undecided else None
        yield "contacts made", f"{self.contacts} on these traces" if self.contacts else None

    def settled(self) -> str:
        undecided = "" if self.settling_decides else f"; no verdict: {self.reason}"
        return f"{self.stable_and_settling} of {self.stable} stable loops have slower handles at the end{undecided}"


@dataclass(frozen=True)
class EnergyAudit:
    """The test of W(N) >= 0 (sim.crowds), on the traces without clipped forces, and on all traces with a limiter."""

    audited: int  # number of tested traces
    clipped: int  # number of traces that are left out
    violated: int  # number of tested traces with W(N) < 0
    least_J: float | None  # least W(N) of the tested traces
    holds: bool

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> EnergyAudit:
        unclipped = (findings.clipped == 0) | (question.lag is not None)
        violated = int((unclipped & ~(findings.energy >= -_ROUNDING * findings.audited)).sum())
        least = float(findings.energy[unclipped].min()) if unclipped.any() else None
        return cls(int(unclipped.sum()), int((~unclipped).sum()), violated, least, not violated)

    def __str__(self) -> str:
        left = f", {self.clipped} clipped traces left out" if self.clipped else ""
        return f"{self.audited - self.violated} of {self.audited}{left}"


_Met = TypeVar("_Met")  # delays or ticks


@dataclass(frozen=True)
class Growing(Generic[_Met]):
    """The number of sets of humans with whom the loop grows while delays or ticks vary; if `covered`, it must be 0."""

    met: _Met = off_table("inlined")
    covered: bool = off_table()  # whether certificates cover the variation
    unstable: Unstable = off_table()
    humans: int = off_table()  # number of sets of humans whose growth was computed
    mujoco_unclipped: int = off_table()  # number of the second engine's traces in which no force was clipped
    largest_growth_per_s: float | None = off_table()
    worst_index: int | None = off_table()
    holds: bool = off_table()

    @classmethod
    def of(cls, question: Validation, findings: Findings, met: _Met, covered: bool) -> Growing[_Met]:
        exact, mujoco = findings.switching, findings.switching_mujoco
        seen, mujoco = ~np.isnan(exact), mujoco[~np.isnan(mujoco)]
        grow = Unstable.of(question, int((exact > 0).sum()), int((mujoco > 0).sum()) if mujoco.size else None)
        worst = int(np.nanargmax(exact)) if seen.any() else None
        figures = (None, None) if worst is None else (float(exact[worst]), int(findings.index[worst]))
        return cls(met, covered, grow, int(seen.sum()), mujoco.size, *figures, not (covered and grow.exact))

    def row(self, what: str) -> tuple[str, str | None]:
        others, growth = self.unstable.others, self.largest_growth_per_s
        also = f", {others} of {self.mujoco_unclipped} unclipped" if others else ""
        worst = "" if growth is None else f"; worst {growth:+.4g} 1/s (index {self.worst_index})"
        grow = f"{self.unstable.exact} of {self.humans} exact{also}{worst}"
        return f"grow while {what} vary", grow if self.humans else None


@dataclass(frozen=True)
class Attacked:
    """The result of the search for the worst human, and the loop's required over available damping."""

    found: bool  # whether the worst human destabilises the loop
    spectral_radius: float
    growth_rate_per_s: float
    frequency_hz: float
    evaluated: int  # number of sets of humans that were tried
    required_over_available_damping: float | None  # None if no damping is enough
    human: list[dict[str, Any]]
    person: tuple[Person, ...]
    holds: bool
    device: Sequence[Mechanics] | None = off_table("if given", None)  # worst mechanics within the guaranteed bounds

    @classmethod
    def of(cls, worst: Worst, ratio: float, certified: bool) -> Attacked:
        figures = worst.spectral_radius, worst.growth, worst.frequency_hz, worst.evaluated
        held = list(map(_held, worst.humans)), worst.persons
        holds = not (certified and worst.destabilises)
        return cls(worst.destabilises, *figures, finite(ratio), *held, holds, worst.mechanics or None)

    def __str__(self) -> str:
        grows = f"a human with whom the loop grows by {self.growth_rate_per_s:+.4g} 1/s"
        ratio, verdict = self.required_over_available_damping, grows if self.found else "no destabilising human"
        close = "no damping is enough" if ratio is None else f"the loop needs {ratio:.4g} times its damping"
        return f"{verdict} among {self.evaluated} sets; {close}"


def largest(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else None
