"""A coupling in its loop before anything runs: what each condition asks, ranges, limits, and whom it is safe for."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from typing import Any

from cli import render
from controller.coupling import Coupling
from controller.loop import Loop
from design.certificate import RangesCheck, assess, check_ranges
from design.coverage import Limits, ranges_part, ranges_rows
from design.guarantees import guarantee_of
from design.result import Requirement
from sim import report
from sim.couplings import Chosen, limits_of
from sim.scenario import Scenario


@dataclass(frozen=True, eq=False)
class Judged:
    """The parts that every report of a coupling begins with."""

    whole: RangesCheck | None = render.unseen("no")
    requirements: dict[str, Requirement] = render.unseen("no")
    limits: Limits = render.unseen("no")
    coupling: dict[str, Any] = render.unseen()
    certificates: dict[str, Any] = render.unseen()
    promise: str | None = render.unseen()  # the guarantee, by its older name
    ranges: dict[str, Any] | None = render.unseen()
    limiter: dict[str, Any] = render.unseen()

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
            coupling=report.coupling_part(kind, coupling, loop.T),
            certificates=report.certificates_part(requirements),
            promise=guarantee_of(requirements, loop, bool(whole and whole.proved)),
            ranges=whole and ranges_part(whole),
            limiter=limits.part([device.force_limit for device in scenario.device]),
        )

    @property
    def proved(self) -> bool:
        """For the whole ranges."""
        return bool(self.whole and self.whole.proved)

    def rows(self) -> render.Rows:
        """What a table says first."""
        yield from render.certificate_rows(self.certificates, 5)
        yield from ranges_rows(self.ranges) if self.ranges else ()
        yield "guarantee", f"holds for {self.promise}" if self.promise else "none"


def judge(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, met: Scenario | None = None) -> Judged:
    """The coupling in the scenario's loop; conditions are asked of `met`, one environment of its ranges."""
    met, loop = met or scenario, scenario.loop(args.case)
    with render.progress("searching the ranges" if loop.ranges else "judging the coupling") as move:
        whole = check_ranges(loop, chosen.coupling, args.seed, progress=move)
        requirements = assess(met.loop(args.case), chosen.coupling, chosen.phi, chosen.known)
        limits = limits_of(met, chosen, requirements, args.limiter)
    return Judged.of(chosen.kind, chosen.coupling, met.loop(args.case), requirements, whole, limits, met)
