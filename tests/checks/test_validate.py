"""Run every check of verdicts at full length (`make validate`, about ten minutes). `-s` shows the rows."""

import shlex
from importlib import import_module

import pytest

from tests.checks.challenges import challenges
from tests.checks.endurance import endurance
from tests.checks.hard import hard_loops
from tests.checks.random_loops import proofs, slow, traces
from tests.checks.tightness import delayed, known, usual
from tests.checks.uneven import uneven_ticks

pytestmark = pytest.mark.validate

_HANDS = "--humans 300 --links mixed --duration 1 --adversary --generations 60"
_KNOWN = "--scenario omega-pair-known --humans 10000 --links mixed --engine exact --duration 0 --adversary"
COMMANDS = {
    "no coupling": f"sim.validate --case none {_HANDS}",
    "any environment, case I": f"sim.validate --case I --condition any-environment {_HANDS}",
    "any environment, case II": f"sim.validate --case II --condition any-environment {_HANDS}",
    "this environment": f"sim.validate --case I {_HANDS}",
    "optimal": f"sim.validate --case I --coupling optimal {_HANDS}",
    "published gains": f"sim.validate --case I --coupling published {_HANDS}",
    "three rigid devices": f"sim.validate --scenario three-rigid --case I {_HANDS}",
    "known devices, no coupling": f"sim.validate --case none {_KNOWN}",
    "known devices, published gains": f"sim.validate --case I --coupling published {_KNOWN}",
    "known devices, designed": f"sim.validate --case I --condition known-device {_KNOWN}",
    "known devices, any environment": f"sim.validate --case I --condition known-device-any {_KNOWN}",
    "Z-width map": "sim.zwidth --rigid --T 1e-3 --theta 0 --grid 30 --points 8",
    "engines": "sim.accuracy --duration 6",
}
MEASURED = {
    "tightness": usual,
    "tightness with long delays": delayed,
    "tightness on known devices": known,
    "numerically hard loops": hard_loops,
    "random networks": proofs,
    "traces and eigenvalues": traces,
    "traces of slow loops": slow,
    "uneven ticks": uneven_ticks,
    "guarantees at their edge": challenges,
    "memory of long work": endurance,
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=list(COMMANDS))
def test_every_command_returns_zero(command, tmp_path):
    module, *words = shlex.split(command)
    name = module.removeprefix("sim.")
    assert import_module(f"haptic_loop.cli.{name}").main([*words, "--out", str(tmp_path)]) == 0


@pytest.mark.parametrize("measure", MEASURED.values(), ids=list(MEASURED))
def test_every_row_holds(measure):
    rows = list(measure(0))
    print(*rows, sep="\n")
    holds = [row["holds"] if isinstance(row, dict) else row.holds for row in rows]
    assert holds
    assert all(holds), [row for row, good in zip(rows, holds, strict=True) if not good]
