"""A coupling in its loop before anything runs, as commands ask for it and show it."""

from __future__ import annotations

import argparse

from cli import render
from design.result import Chosen
from sim import judged
from sim.judged import Judged
from sim.scenario import Scenario


def judge(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, met: Scenario | None = None) -> Judged:
    """The coupling in the scenario's loop; conditions are asked of `met`, one environment of its ranges."""
    ranges = scenario.loop(args.case).ranges
    with render.progress("searching the ranges" if ranges else "judging the coupling") as move:
        return judged.judge(scenario, args.case, chosen, args.seed, args.limiter, met or scenario, move)


def rows(part: Judged) -> render.Rows:
    """What a table says first."""
    yield from render.certificate_rows(part.requirements, 5)
    yield from part.ranges.rows() if part.ranges else ()
    yield "guarantee", f"holds for {part.guarantee}" if part.guarantee else "none"
