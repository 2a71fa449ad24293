"""python -m sim.hard: numerically hard loops, each with the setting that fails and the one that the rule picks."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from controller.coupling import Coupling, SpringDamper
from design.published import CASE_I
from models.device import CompliantDevice
from models.human import Human, Link
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    check_json,
    console,
    execute,
    progress_bar,
)
from sim.files import folder, write_json
from sim.one_period import exact_growth, simulated_growth
from sim.scenario import InputError, Scenario, load
from sim.simulate import assemble
from sim.substeps import check_substeps, default_substeps

CLOSE = 1e-2  # [1/s] what the rule's growth rate may be off


@dataclass(frozen=True)
class Hard:
    """A loop that asks much of an integrator."""

    name: str
    scenario: Scenario
    coupling: Coupling = CASE_I
    fails: int | None = None  # RK4 substeps that must be refused, None where 1 is stable


@dataclass(frozen=True)
class Row:
    """What the rule makes of it: RK4 with `substeps`."""

    name: str
    exact: float  # [1/s] growth of the exact loop
    fails: int | None  # substeps that are refused
    refused: bool  # whether they were
    substeps: int
    simulated: float  # [1/s] growth of the loop that MuJoCo simulates

    @property
    def holds(self) -> bool:
        right = (self.simulated > 0) == (self.exact > 0) and abs(self.simulated - self.exact) <= CLOSE
        return right and (self.refused or self.fails is None)

    def cells(self) -> tuple[str, ...]:
        """The columns of a table."""
        error = f"{self.simulated - self.exact:+.1e}"
        return self.name, f"{self.exact:+.4f}", str(self.fails or "-"), str(self.substeps), error

    def markdown(self) -> str:
        return f"| {' | '.join(self.cells())} |"


@cache
def nominal() -> Scenario:
    """The default scenario for a second: where every hard loop starts from."""
    return load().replace(duration=1.0)


def devices(**changes: float) -> Scenario:
    """The nominal loop with other devices."""
    return nominal().replace(device=(CompliantDevice(**changes),) * 2)


def hands(mass: float, damping: float, stiffness: float) -> Scenario:
    """The nominal loop in other hands."""
    return nominal().replace(human=(Human((Link(mass, damping, stiffness),)),) * 2)


def light(damping: float) -> Scenario:
    """A handle of 1 g that nobody's mass is added to."""
    return devices(handle_mass=1e-3).replace(human=(Human((Link(0.0, damping, 200.0),)),) * 2)


def cases() -> tuple[Hard, ...]:
    """All hard loops."""
    return (
        Hard("human stiffness 1e5 N/m", hands(0.3, 3.0, 1e5)),
        Hard("handle of 1 g, human damping 3 N s/m", light(3.0), fails=1),
        Hard("handle of 1 g, no human damping", light(0.0), fails=1),
        Hard("motor 1 g", devices(motor_mass=1e-3), fails=1),
        Hard("motor 100 kg", devices(motor_mass=100.0)),
        Hard("human damping 1000 N s/m", hands(0.3, 1000.0, 200.0)),
        Hard("transmission 1e6 N/m", devices(transmission_stiffness=1e6), fails=1),
        Hard("T = 4 ms", nominal().replace(T=4e-3)),
        Hard("T = 10 us", nominal().replace(T=1e-5, duration=0.1)),
        Hard("50-sample delays", nominal().replace(theta=(50, 50))),
        Hard("zero damping", nominal().replace(delta=(0.0, 0.0))),
        Hard("coupling 1e5 N/m", nominal(), SpringDamper(np.full(2, 1e5), np.zeros(2))),
    )


def measure(hard: Hard) -> Row:
    """The rule's setting against the exact loop. Raises InputError where the rule finds none."""
    loop = assemble(hard.scenario, hard.coupling)
    substeps, refused = default_substeps(loop), False
    if hard.fails:
        try:
            check_substeps(loop, "RK4", hard.fails)
        except InputError:
            refused = True
    return Row(hard.name, exact_growth(loop), hard.fails, refused, substeps, simulated_growth(loop, "RK4", substeps))


def main(argv: list[str]) -> int:
    """Measure every hard loop. 0: the rule is right everywhere, 1: not, 130: interrupted."""
    args = _parser().parse_args(argv)
    check_json(args)
    out = folder(Path(args.out or "out/hard"))
    with (bar := progress_bar("hard loops"))[0]:
        rows, interrupted = _rows(bar[1])
    named = [asdict(row) | {"holds": row.holds} for row in rows]
    outcome: dict[str, Any] = {"rows": named, "holds": all(row.holds for row in rows), "interrupted": interrupted}
    outcome["files"] = [str(out / "report.json")]
    write_json(out / "report.json", outcome)
    _print(rows, args)
    if args.json:
        write_json(args.json, outcome)
    if interrupted:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def _rows(progress: Callable[[int, int], None]) -> tuple[list[Row], bool]:
    rows: list[Row] = []
    try:
        for hard in (asked := cases()):
            rows.append(measure(hard))
            progress(len(rows), len(asked))
    except KeyboardInterrupt:
        return rows, True
    return rows, False


def _parser() -> Parser:
    parser = Parser("sim.hard", "Numerically hard loops under the substep rule.", "python -m sim.hard --json -")
    parser.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    parser.add_argument("--out", metavar="DIR", help="folder for the report (default out/hard)")
    return parser


def _print(rows: list[Row], args: argparse.Namespace) -> None:
    table = Table(title="hard loops: exact growth, RK4 substeps that are refused and that the rule picks, their error")
    for name in ("loop", "exact [1/s]", "refused", "rule", "error [1/s]"):
        table.add_column(name, justify="left" if name == "loop" else "right")
    for row in rows:
        table.add_row(*row.cells(), style=None if row.holds else "red")
    console(args).print(table)


if __name__ == "__main__":
    execute(main)
