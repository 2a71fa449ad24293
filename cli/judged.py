"""The coupling that a command is asked for, and what is said of it before anything runs."""

from __future__ import annotations

import argparse

from haptic_loop.cli import render
from haptic_loop.design.result import Chosen
from haptic_loop.sim import couplings
from haptic_loop.sim.couplings import Judged, choose
from haptic_loop.sim.scenario import Scenario


def chosen_by(args: argparse.Namespace, scenario: Scenario) -> Chosen:
    """The coupling of --coupling for --condition and --no-limiter, designed where it is asked for by name."""
    with render.designing(scenario.loop(args.case), args.coupling, args.condition) as progress:
        return choose(scenario, args.case, args.coupling, args.condition, args.limiter, progress)


def judge(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, met: Scenario | None = None) -> Judged:
    """The coupling in the scenario's loop; conditions are asked of `met`, one environment of its ranges."""
    ranges = scenario.loop(args.case).ranges
    with render.progress("searching the ranges" if ranges else "judging the coupling") as move:
        return couplings.judge(scenario, args.case, chosen, args.seed, args.limiter, met or scenario, move)


def rows(part: Judged) -> render.Rows:
    """What a table says first."""
    yield from render.certificate_rows(part.certificates, 5)
    yield from part.ranges.rows() if part.ranges else ()
    yield "guarantee", f"holds for {part.guarantee}" if part.guarantee else "none"
