"""The commands sim.run, sim.validate, design and design.audit for scenarios with a MuJoCo world."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli.painter import Painter
from haptic_loop.design.api import store
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.environments import ANY_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.result import Chosen, Design, listed
from haptic_loop.sim.api import run_scenario
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import EngineSettings
from haptic_loop.sim.scenario import InputError, Scenario
from haptic_loop.sim.shown import Contacts
from haptic_loop.sim.world import (
    LOSSLESS,
    RANDOM,
    START_J,
    Claim,
    HandsInWorld,
    SceneRecord,
    Touched,
    WorldFigures,
    WorldRecord,
    least_at_port,
    scene_of,
    thrown,
)

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class _Report:
    """The report of every command on a world, in SI units."""

    scenario: str
    scenario_digest: str
    kind: str  # kind of the coupling
    coupling: dict[str, object]  # figures of the coupling
    assessment: Assessment
    guaranteed: bool
    guarantee: str
    scene: SceneRecord
    world: WorldRecord | None = None
    least_at_port_J: dict[str, float] = field(default_factory=dict)
    peak_force_N: list[float] | None = None
    hands: int = 0
    worst_excess_J: float | None = None
    interrupted: bool | None = off_table("if given", None)  # whether Ctrl-C ended a run
    wall_s: float = 0.0


def _reported(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, start: float) -> _Report:
    """Return the report without figures of a run."""
    with render.progress("proving the condition"):
        assessment = assessed(
            scenario, args.case, chosen, energy_budget=start, limiter=False, seed=getattr(args, "seed", 0)
        )
    claim, scene = Claim.of(assessment, chosen.certified_for), scene_of(scenario, chosen.coupling)
    return _Report(
        scenario=scenario.name,
        scenario_digest=scenario.digest,
        kind=chosen.kind,
        coupling=chosen.coupling.figures(scenario.T),
        assessment=assessment,
        guaranteed=claim.guaranteed,
        guarantee=claim.words,
        scene=SceneRecord.of(scene),
    )


def _chosen(args: argparse.Namespace, scenario: Scenario) -> Chosen:
    with render.progress("designing"):
        return choose(scenario, args.case, args.coupling, args.condition)


def world_start(args: argparse.Namespace) -> float:
    """Return W0 [J] of a world's energy account: that of --energy-budget, or START_J. Raises InputError."""
    if not args.energy_budget:
        return START_J
    start, *cap = args.energy_budget
    if cap and np.isfinite(cap[0]):
        raise InputError("--energy-budget: the energy account of a world has no cap, give W0 alone")
    return float(start)


_OPTIONS = {"limiter": "no-limiter", "band_hz": "band"}  # options whose name differs from their argument's


def _refuse(args: argparse.Namespace, why: str, **defaults: object) -> None:
    """Raise InputError if an argument differs from its default, because it has no effect in a world."""
    for name, default in defaults.items():
        if (value := getattr(args, name)) != default:
            option = "limiter" if value is True and name == "limiter" else _OPTIONS.get(name, name.replace("_", "-"))
            raise InputError(f"--{option}: with environment.world {why}; leave it out")


def _common_rows(report: _Report) -> Iterator[tuple[str, str | None]]:
    needs = report.assessment.requirements[ANY_ENVIRONMENT.name]
    for name, unit in (("K", "N/m"), ("B", "N s/m"), ("stiffness", "N/m")):
        values = report.coupling.get(name)
        if isinstance(values, list) and values:
            yield f"coupling, {name}", f"{listed(values, 5)} {unit}"
    yield "damping, any-environment", f"{needs.words()}: {render.certified(needs)}"
    yield "held torques", report.assessment.held_torques


def _publish(
    args: argparse.Namespace,
    report: _Report,
    verdict: str,
    rows: Iterable[tuple[str, str | None]],
    out: Path | None = None,
    files: Iterable[Path] = (),
    tables: Iterable[Table] = (),
) -> None:
    facts = render.facts(f"{report.scenario}: coupling {report.kind}", rows)
    render.publish(args, report, [facts, *tables], (), out, files, verdict=verdict)


def _energy(joules: float) -> str:
    return f"{1e3 * joules:.3g} mJ"


# ---- sim.run

_SHELL = "the energy account bounds the forces, and no limiter runs"
_WHOLE = "the report has no further lines"
_WRITTEN = ("scene.xml", "world.xml")  # the model of the devices, and that of the scene with its springs


def run(args: argparse.Namespace, scenario: Scenario, out: Path, painter: Painter) -> int:
    """Run a scenario with a world and report it. Return 0 if the run was completed, 130 if interrupted."""
    for name in ("paper", "cross_check", "error", "vertex"):
        if getattr(args, name, None):
            shown = name.replace("_", "-")
            raise InputError(f"--{shown}: with environment.world there is no linear loop to compare with; leave it out")
    _refuse(args, "no transparency error is computed", band_hz=None)
    _refuse(args, _SHELL, limiter=None)
    _refuse(args, _WHOLE, details=False)
    from haptic_loop.models.world import files_of  # loads MuJoCo
    from haptic_loop.sim.view.drawn_object import scene_xml

    assert scenario.environment.world is not None
    scene = {file.resolve() for file in files_of(Path(scenario.environment.world.file))}
    for name in _WRITTEN:
        if (out / name).resolve() in scene:
            raise InputError(f"--out {out}: {name} is a file of the scene, which the run would overwrite")
    start, chosen = world_start(args), _chosen(args, scenario)
    report = _reported(args, scenario, chosen, start)
    settings = EngineSettings(args.engine, args.integrator, args.substeps)
    began = time.perf_counter()
    with render.progress("simulating") as move:
        finished = run_scenario(scenario, chosen.coupling, None, settings, args.seed, Touched(start), move)
    trace = finished.trace
    figures = trace.net.figures() if trace.net else None
    assert isinstance(figures, WorldFigures)
    claim = Claim.of(report.assessment, chosen.certified_for, record := WorldRecord.of(figures))
    report = replace(
        report,
        guaranteed=claim.guaranteed,
        guarantee=claim.words,
        world=record,
        peak_force_N=np.abs(trace.f).max(axis=0, initial=0.0).tolist(),
        interrupted=trace.interrupted,
        wall_s=time.perf_counter() - began,
    )
    models = scene_xml(finished.simulation), scene_of(scenario, chosen.coupling).xml
    files = render.save_run(out, trace, report, dict(zip(_WRITTEN, models, strict=True)))
    if trace.t.size > 1 and not args.no_plot:
        title, around = f"{scenario.name}: a MuJoCo world", Contacts(scenario.environment.contacts)
        shown = trace.signals, title, 1.0, None, None, around
        painter.ask("draw_run", *shown)
        files.append(painter.save(out / "figure.png"))
    title = f"{report.guarantee} The shell acted on {figures.limited_ticks} of {figures.ticks} ticks."
    _publish(args, report, title, _run_rows(report, figures, scenario), out, files)
    return options.exit_code(True, trace.interrupted)


def _run_rows(report: _Report, figures: WorldFigures, scenario: Scenario) -> Iterator[tuple[str, str | None]]:
    yield "contacts", ", ".join(scenario.environment.contacts)
    yield from _common_rows(report)
    ended = f"in tick {figures.ticks}; the trace has the ticks up to the last multiple of 2048"
    yield "interrupted", ended if report.interrupted else None
    yield "given to hands and devices", f"{_energy(figures.given_J)} beyond what the devices dissipate"
    yield "released", f"{_energy(figures.released_J)} by gravity and springs of the scene"
    yield "least energy at the port", _energy(figures.port_least_J)
    yield "created by contacts", _energy(figures.created_J)
    yield "peak force", f"{listed(report.peak_force_N or (), 3)} N"
    unsettled = figures.unsettled_steps
    yield "limited forces", f"did not settle in {unsettled} steps of the scene" if unsettled else None
    yield "MuJoCo warns", " ".join(figures.warnings) or None
    yield "active parts", ", ".join(report.scene.active) or None
    yield "scene", report.scene.settings


# ---- sim.validate


def validate(args: argparse.Namespace, scenario: Scenario, out: Path) -> int:
    """Run a world with random and lossless hands. Return 0 if the energy account holds for all, 1 if not."""
    if args.adversary:
        raise InputError("--adversary: for a world, `design.audit` reports the energy that adversaries gained")
    if args.duration == 0:
        raise InputError("--duration 0: a world has no eigenvalues, give the length of the traces [s]")
    _refuse(
        args, "the engine of the scene simulates all hands in one process", engine="both", traces="sampled", shards=1
    )
    _refuse(args, "the scenario's population sets the number of masses", links=None)
    _refuse(args, "there are no ranges", environments="nominal")
    _refuse(args, _SHELL, limiter=None)
    began, chosen = time.perf_counter(), _chosen(args, scenario)
    report = _reported(args, scenario, chosen, START_J)
    with render.progress("validating") as move:
        hands = thrown(scenario, chosen.coupling, args.humans, args.seed, args.duration, START_J, move)
    worst = max(hands, key=lambda each: each.excess_J)
    holds = worst.excess_J <= 0
    most = max((WorldRecord.of(each.figures) for each in hands), key=lambda each: (each.diverged, each.released_J))
    claim = Claim.of(report.assessment, chosen.certified_for, most)
    report = replace(
        report,
        guaranteed=claim.guaranteed,
        guarantee=claim.words,
        world=WorldRecord.of(max(hands, key=lambda each: each.figures.limited_ticks).figures),
        hands=len(hands),
        worst_excess_J=worst.excess_J,
        wall_s=time.perf_counter() - began,
    )
    whom = f"none of {len(hands)} sets of hands" if holds else f"set {worst.number} ({worst.kind})"
    title = f"{report.guarantee} Measured: {whom} was given more than W0 and the released energy."
    _publish(args, report, title, _hands_rows(report, hands), out)
    return options.exit_code(holds)


def _hands_rows(report: _Report, hands: list[HandsInWorld]) -> Iterator[tuple[str, str | None]]:
    yield from _common_rows(report)
    for kind in (RANDOM, LOSSLESS):
        some = [each.figures for each in hands if each.kind == kind]
        if some:
            acted, ticks = sum(f.limited_ticks for f in some), sum(f.ticks for f in some)
            most = max(f.given_J for f in some)
            yield f"{len(some)} {kind}", f"shell acted on {acted} of {ticks} ticks; given at most {_energy(most)}"
    yield "released", f"at most {_energy(max(each.figures.released_J for each in hands))}"
    yield "created by contacts", f"at most {_energy(max(each.figures.created_J for each in hands))}"


# ---- design and design.audit


def check_design(args: argparse.Namespace) -> None:
    """Raise InputError for options of design that have no effect in a world."""
    _refuse(args, "there is no network whose parameters could vary", ranges=None)
    _refuse(args, "delays are constant", varying_delay=None)
    _refuse(args, _SHELL, limiter=None)


def design(args: argparse.Namespace, scenario: Scenario, out: Path, designed: Design) -> int:
    """Store a design for a world and report it. Return 0 if runs with it have a guarantee, 1 if not."""
    filed = store(scenario.loop(args.case), designed, out)
    report = _reported(args, scenario, replace(designed, kind=args.coupling), START_J)
    rows = [*_common_rows(report), ("stored", f"{out} (proof: {filed.proof or 'none'})")]
    _publish(args, report, report.guarantee, rows)
    return options.exit_code(report.guaranteed)


def check_audit(args: argparse.Namespace) -> None:
    """Raise InputError for options of design.audit that have no effect in a world."""
    _refuse(args, f"the audit judges {ANY_ENVIRONMENT.name}, and no other condition", condition=None)
    _refuse(args, "the audit judges constant delays only", varying_delay=None)
    _refuse(args, _WHOLE, details=False)


def audit(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, out: Path) -> int:
    """Report a scene's parts and the energy that adversaries gained. Return 0 if runs have a guarantee, 1 if not."""
    began = time.perf_counter()
    report = _reported(args, scenario, chosen, START_J)
    with render.progress("simulating hands that try to draw energy") as move:
        least = least_at_port(scenario, chosen.coupling, args.seed, move)
    report = replace(report, least_at_port_J=least, wall_s=time.perf_counter() - began)
    rows = [*_common_rows(report), *((f"least energy, {name}", _energy(value)) for name, value in least.items())]
    rows.append(("active parts", ", ".join(report.scene.active) or None))
    parts = [(str(part["part"]), str(part["count"]), str(part["at_the_port"])) for part in report.scene.parts]
    heads = ("part", "count", "energy at the port, or its bound")
    table = render.grid(f"{report.scene.file}: {report.scene.settings}", heads, parts, (0, 2))
    _publish(args, report, report.guarantee, rows, out, tables=[table])
    return options.exit_code(report.guaranteed)
