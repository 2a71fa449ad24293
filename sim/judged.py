"""A coupling in its loop before anything runs: what each condition asks, ranges, limits, and whom it is safe for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from controller.coupling import Coupling
from controller.loop import Loop
from design.certificate import RangesCheck, assess, check_ranges
from design.coverage import Limits, ranges_part
from design.files import unseen
from design.guarantees import guarantee_of
from design.result import Chosen, Requirement
from sim.couplings import limits_of
from sim.report import certificates_part, coupling_part
from sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Judged:
    """The parts that every report of a coupling begins with."""

    whole: RangesCheck | None = unseen("no")
    requirements: dict[str, Requirement] = unseen("no")
    limits: Limits = unseen("no")
    coupling: dict[str, Any] = unseen()
    certificates: dict[str, Any] = unseen()
    promise: str | None = unseen()  # the guarantee, by its older name
    ranges: dict[str, Any] | None = unseen()
    limiter: dict[str, Any] = unseen()

    @classmethod
    def of(
        cls,
        kind: str,
        coupling: Coupling,
        loop: Loop,
        requirements: dict[str, Requirement],
        whole: RangesCheck | None,
        limits: Limits,
        scenario: Scenario,
    ) -> Judged:
        """With the parts as plain data; forces are limited as the scenario's devices limit them."""
        return cls(
            whole=whole,
            requirements=requirements,
            limits=limits,
            coupling=coupling_part(kind, coupling, loop.T),
            certificates=certificates_part(requirements),
            promise=guarantee_of(requirements, loop, bool(whole and whole.proved)),
            ranges=whole and ranges_part(whole),
            limiter=limits.part([device.force_limit for device in scenario.device]),
        )

    @property
    def proved(self) -> bool:
        """For the whole ranges."""
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
    requirements = assess(met.loop(case), chosen.coupling, chosen.phi, chosen.certificate)
    limits = limits_of(met, chosen, requirements, limiter)
    return Judged.of(chosen.kind, chosen.coupling, met.loop(case), requirements, whole, limits, met)
