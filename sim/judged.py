"""A coupling in its loop before anything runs: what each condition asks, ranges, limits, and whom it is safe for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from controller.loop import Loop
from controller.older import CONDITIONS, with_older
from design.certificate import RangesCheck, assess, check_ranges
from design.coverage import Limits, RangesFigures
from design.files import unseen
from design.guarantees import guarantee_of
from design.result import Chosen, Requirement
from sim.couplings import limits_of
from sim.report import CouplingFigures
from sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Judged:
    """The parts that every report of a coupling begins with."""

    chosen: Chosen = unseen("no")
    whole: RangesCheck | None = unseen("no")
    coupling: CouplingFigures = unseen()
    certificates: dict[str, Requirement] = unseen()  # by condition, also under the names that they had before
    guarantee: str | None = unseen(older="promise")
    ranges: RangesFigures | None = unseen(older="set")
    limiter: Limits = unseen()

    @classmethod
    def of(
        cls,
        chosen: Chosen,
        loop: Loop,
        requirements: dict[str, Requirement],
        whole: RangesCheck | None,
        limits: Limits,
    ) -> Judged:
        """The verdicts on a coupling in a loop."""
        return cls(
            chosen,
            whole,
            CouplingFigures.of(chosen.kind, chosen.coupling, loop.T),
            with_older(requirements, CONDITIONS),
            guarantee_of(requirements, loop, bool(whole and whole.proved)),
            whole and RangesFigures.of(whole),
            limits,
        )

    @property
    def requirements(self) -> dict[str, Requirement]:
        """The certificates under today's names alone."""
        return {name: need for name, need in self.certificates.items() if name not in CONDITIONS}

    @property
    def proved(self) -> bool:
        """Whether the guarantee is proved for the ranges."""
        return bool(self.whole and self.whole.proved)


def judge(
    scenario: Scenario,
    case: str,
    chosen: Chosen,
    seed: int,
    limiter: bool | None,
    met: Scenario,
    progress: Callable[[int, int], None],
) -> Judged:
    """The coupling in the scenario's loop; conditions are asked of `met`, one environment of its ranges."""
    whole = check_ranges(scenario.loop(case), chosen.coupling, seed, progress=progress)
    requirements = assess(met.loop(case), chosen.coupling, chosen.phi, chosen.certificate, own=chosen.own)
    limits = limits_of(met, chosen, requirements, limiter)
    return Judged.of(chosen, met.loop(case), requirements, whole, limits)
