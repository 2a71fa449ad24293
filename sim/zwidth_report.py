"""The report of a Z-width map, and its CSV file with one line per cell."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haptic_loop.controller.environment import RIGID_WALL, Network
from haptic_loop.controller.lti import Array
from haptic_loop.controller.units import in_unit
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.files import off_table, write
from haptic_loop.design.result import CAVEATS, Chosen, Requirement, suffices
from haptic_loop.sim.limit_cycles import UNDECIDED, Plan
from haptic_loop.sim.scenario import Scenario
from haptic_loop.sim.stability import MARGINAL
from haptic_loop.sim.trace import slowest_seen
from haptic_loop.sim.zwidth import Grid, Map, MapError, Mark, Sweep, contact_springs, map_error

_NOT_REACHED = "not reached before the interruption"


@dataclass(frozen=True, eq=False)
class _Ratio:
    """The figures of one condition over the cells."""

    required_over_available: Array  # (rows, columns) required over available damping
    certified_cells: int
    contradicted_cells: int  # number of certified cells that are unstable with some human
    reason: str | None = off_table("if given")  # why some cells have no figure


@dataclass(frozen=True, eq=False)
class _Population:
    """The figures of the random humans."""

    humans: int
    seed: int
    growth_rate_per_s: Array  # (rows, columns) largest over the humans tried in a cell
    unstable_humans_at_least: Array  # (rows, columns) number of unstable ones among the humans tried in a cell
    stable_cells: int  # number of cells in which no human is unstable
    decided_cells: int  # number of cells with figures; after an interruption fewer than all
    reason: str | None = off_table("if given")


@dataclass(frozen=True)
class Shown:
    """The nonlinear effects in the simulation of cells."""

    encoder_step_m: list[float]  # of each device, the largest of its axes
    friction_n: list[float]  # of each device, the largest of its axes
    walls: bool


@dataclass(frozen=True)
class _Point:
    """One simulated cell."""

    K: float  # [N/m]
    B: float  # [N s/m]
    verdict: str
    amplitude_m: float
    frequency_hz: float
    linear_growth_rate_per_s: float  # exact growth of the simulated mode, with all walls touched
    differs_from_linear: bool


@dataclass(frozen=True)
class _Marked:
    """The report of a point of --mark."""

    K: float  # [N/m]
    B: float  # [N s/m]
    requirements: dict[str, Requirement] = off_table("inlined")
    growth_rate_per_s: float = off_table()  # largest over the humans
    unstable_humans: int = off_table()
    stiffest_K_at_this_B: dict[str, float | str | None] = off_table()  # condition or "population" -> K [N/m] or words

    @classmethod
    def of(cls, mark: Mark) -> _Marked:
        stiffest: dict[str, float | str | None] = {
            name: "beyond the map" if K is not None and np.isinf(K) else K for name, K in mark.stiffest.items()
        }
        return cls(mark.K, mark.B, dict(mark.requirement), mark.growth, mark.unstable, stiffest)


@dataclass(frozen=True)
class _ContactSpring:
    """One spring at a contact."""

    between: tuple[str, str]
    K: float  # [N/m]
    B: float  # [N s/m]


@dataclass(frozen=True, eq=False)
class FixedCoupling:
    """The coupling of a map over environments."""

    kind: str
    contact_springs: list[_ContactSpring]  # springs of the scenario's environment
    assessment: Assessment  # in the scenario's environment
    remarks: tuple[str, ...]

    @classmethod
    def of(cls, chosen: Chosen, assessment: Assessment, network: Network, remarks: tuple[str, ...]) -> FixedCoupling:
        springs = [_ContactSpring(s.between, s.stiffness, s.damping) for s in contact_springs(network)]
        return cls(chosen.kind, springs, assessment, remarks)


@dataclass(frozen=True, eq=False)
class _Simulated:
    """The figures of MuJoCo at some of the cells."""

    effects: Shown
    nonlinear: bool
    duration_s: float
    press_n: float
    threshold_m: float
    from_hz: float  # lowest frequency of an oscillation that is seen
    points: list[_Point]
    oscillate: int  # number of points that oscillate
    undecided: int  # number of points with the verdict UNDECIDED
    differ_from_linear: int

    @classmethod
    def of(cls, sweep: Sweep, drawn: Map, plan: Plan) -> _Simulated:
        points, (K, B) = drawn.points, (axis[drawn.points.cell] for axis in drawn.grid.flat)
        figures = (K, B, points.verdicts, points.amplitude, points.frequency_hz, points.growth, points.differ)
        steps = [float(np.max(device.encoder_step)) for device in sweep.devices]
        friction = [float(np.max(device.friction)) for device in sweep.devices]
        return cls(
            Shown(steps, friction, sweep.walls),
            sweep.walls or any(steps) or any(friction),
            plan.duration,
            plan.press,
            plan.threshold,
            slowest_seen(plan.duration),
            [_Point(*row) for row in zip(*figures, strict=True)],
            points.verdicts.count("oscillates"),
            points.verdicts.count(UNDECIDED),
            int(points.differ.sum()),
        )

    @property
    def contradicts(self) -> bool:
        """Whether MuJoCo contradicts the eigenvalues of a loop without nonlinear effects."""
        return bool(self.differ_from_linear) and not self.nonlinear


@dataclass(frozen=True, eq=False)
class MapReport:
    """The report of a map. An array's rows are stiffnesses. Null means infinite, not applicable, or not computed."""

    rigid: bool  # True for a map of one device, the first, at a rigid wall
    scenario: str | None
    scenario_digest: str
    T: float
    theta: tuple[int, ...]
    psi: tuple[int, ...]
    delta: tuple[float, ...]
    walls: bool
    conditions: list[str]
    grid: Grid
    population: _Population
    simulation: _Simulated
    holds: bool  # every mark is certified, and no result contradicts another
    interrupted: bool
    wall_s: dict[str, float]
    axes: str  # whether K and B belong to the "coupling" or the "environment"
    ratios: dict[str, _Ratio] = off_table("inlined")
    fixed: FixedCoupling | None = off_table("inlined")  # the coupling of a map over environments
    error: dict[str, MapError | None] | None = off_table("if given")
    marks: list[_Marked] | None = off_table("if given")
    claim: str | None = off_table("if given")  # the claim of a user's own condition, if it certifies a cell
    not_covered: str = CAVEATS

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        sweep: Sweep,
        drawn: Map,
        plan: Plan,
        fixed: FixedCoupling | None,
        marks: Sequence[Mark],
        humans: int,
        seed: int,
    ) -> MapReport:
        loop, complete, rigid = sweep.loop, not drawn.interrupted, sweep.loop.environment is RIGID_WALL
        ratios = {name: _ratio(sweep, drawn, name) for name in drawn.ratio}
        simulation = _Simulated.of(sweep, drawn, plan)
        certified = all(mark.requirement[sweep.decisive].certified for mark in marks)
        contradicted = simulation.contradicts or any(ratio.contradicted_cells for ratio in ratios.values())
        return cls(
            rigid,
            None if rigid else scenario.name,
            scenario.digest,
            loop.T,
            loop.theta,
            loop.psi,
            loop.delta,
            sweep.walls,
            list(drawn.ratio),
            drawn.grid,
            _population(drawn, humans, seed),
            simulation,
            certified and not contradicted,
            drawn.interrupted,
            drawn.seconds,
            "environment" if fixed else "coupling",
            ratios,
            fixed,
            {name: map_error(sweep, drawn, name) for name in drawn.ratio} if complete else None,
            [_Marked.of(mark) for mark in marks] if complete else None,
            sweep.own.claim if sweep.own and ratios[sweep.own.name].certified_cells else None,
        )

    @property
    def cells(self) -> int:
        return len(self.grid.K) * len(self.grid.B)


def _ratio(sweep: Sweep, drawn: Map, name: str) -> _Ratio:
    ratio = drawn.ratio[name]
    contradicted = int((suffices(ratio) & (drawn.growth > MARGINAL)).sum())
    return _Ratio(ratio.reshape(drawn.grid.shape), int(suffices(ratio).sum()), contradicted, _nulls(sweep, drawn, name))


def _nulls(sweep: Sweep, drawn: Map, name: str) -> str | None:
    """Return why some cells have no figure, with one of them as an example; None if all have one."""
    if name in sweep.refusals:
        return sweep.refusals[name]
    ratio, (K, B) = drawn.ratio[name], drawn.grid.flat
    unreached, infinite = np.isnan(ratio), np.flatnonzero(np.isposinf(ratio))
    parts = [f"no figure at {unreached.sum()} cells: {_NOT_REACHED}"] if unreached.any() else []
    if infinite.size:
        first = infinite[0]
        why = sweep.requirement(name, float(K[first]), float(B[first])).reason or "the required damping is infinite"
        at = f"at K {K[first]:.4g}, B {B[first]:.4g}, {why}"
        parts.append(f"no figure at {infinite.size} cells: no damping is enough; {at}")
    return "; ".join(parts) or None


def _population(drawn: Map, humans: int, seed: int) -> _Population:
    known, shape = np.isfinite(drawn.growth), drawn.grid.shape
    return _Population(
        humans,
        seed,
        drawn.growth.reshape(shape),
        drawn.unstable.reshape(shape),
        int((known & (drawn.growth <= MARGINAL)).sum()),
        int(known.sum()),
        f"null in some cells: {_NOT_REACHED}" if np.isnan(drawn.growth).any() else None,
    )


def save_csv(drawn: Map, path: Path) -> Path:
    """Write one line per cell, with SI units in the header, and return the path. nan becomes an empty field."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    figures = [f"{name} required/available" for name in drawn.ratio]
    table.writerow(["K [N/m]", "B [N s/m]", *figures, "growth [1/s]", "unstable humans", "simulated", "amplitude [m]"])
    point = {int(cell): i for i, cell in enumerate(drawn.points.cell)}
    for cell, (K, B) in enumerate(zip(*drawn.grid.flat, strict=True)):
        values = [K, B, *(ratio[cell] for ratio in drawn.ratio.values()), drawn.growth[cell], drawn.unstable[cell]]
        row = ["" if np.isnan(value) else f"{value:.9g}" for value in values]
        i = point.get(cell)
        row += ["", ""] if i is None else [drawn.points.verdicts[i], f"{drawn.points.amplitude[i]:.4g}"]
        table.writerow(row)
    return write(path, in_unit(text.getvalue()))
