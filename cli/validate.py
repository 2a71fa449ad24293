"""python -m sim.validate: test a loop with random passive humans in both engines, and search for the worst human."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from haptic_loop.cli import options, render
from haptic_loop.cli import verdict as verdicts_of
from haptic_loop.cli.painter import Painter
from haptic_loop.cli.verdict import assessment_of, chosen_by
from haptic_loop.controller.ranges import Member
from haptic_loop.design.conditions import this_environment
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.design.files import off_table
from haptic_loop.design.known_device import KNOWN_DEVICE
from haptic_loop.design.result import ANY, KNOWN_CONDITIONS, PLAIN_CONDITIONS, RANGES, Chosen
from haptic_loop.models.human import Population
from haptic_loop.models.scene import MIXED
from haptic_loop.sim import verdicts
from haptic_loop.sim.couplings import NAMES
from haptic_loop.sim.crowds import ENGINES, Findings, Validation, validate
from haptic_loop.sim.report import DelaySpan, UnevenTicks, VaryingDelays, friction_left_out
from haptic_loop.sim.run import assemble, engine_name
from haptic_loop.sim.scenario import InputError, Scenario, is_world, require_linear, save_humans
from haptic_loop.sim.stability import Eigenvalues, eigenvalues, unstable, worst_mode

if TYPE_CHECKING:
    from haptic_loop.design.assessment import Assessment, RangesResult
    from haptic_loop.sim.adversary import Worst

_HUMANS, _IN_A_WORLD = 1000, 100  # default of --humans
_ENVIRONMENTS = ("nominal", "ranges")
#: rows that are left out of long tables, the least important first
_LESS = (
    "time",
    "damping, any switching",
    "age of the forces",
    "difference of growth rates",
    "ticks",
    "environments",
    "worst switching found",
    "traces",
)
_LINKS = {"1": 1, "2": 2, "mixed": MIXED}


def main(argv: list[str]) -> int:
    """Test humans. Return 0 if all claims hold, 1 if not, 3 if a worker died or memory ran out, 130 if interrupted."""
    args = _parser().parse_args(argv)
    scenario, out = _scenario(args), options.out_folder(args, "validate")
    args.humans = args.humans or (_IN_A_WORLD if is_world(scenario) else _HUMANS)
    if is_world(scenario):
        from haptic_loop.cli import world

        return world.validate(args, scenario, out)
    painter = Painter(not args.no_plot)
    chosen = chosen_by(args, scenario)
    assessment = assessment_of(args, scenario, chosen)
    question = _question(args, scenario, chosen, assessment)
    begin = time.perf_counter()
    with render.progress("validating") as move:
        findings = validate(question, args.shards, move)
    wall = time.perf_counter() - begin
    searched = _Searched()
    if args.adversary and not (findings.interrupted or findings.lost):
        searched = _searched(args, question, chosen, assessment)
    report = _reported(args, chosen, assessment, question, findings, wall, searched)
    files = _save(args, out, question, findings, searched.worst, chosen.kind, painter)
    title = f"{scenario.title(args.case)}: coupling {chosen.kind}"
    rows, left_out = render.shortened(render.rows_of(report), _LESS)
    lines = [
        *left_out,
        *([f"Delays that vary: {report.switching.met.certified.covers}."] if report.switching else []),
        *report.remarks,
        *friction_left_out(scenario.device),
    ]
    shown = [render.facts(title, rows)]
    render.publish(args, report, shown, lines, out, files, verdicts_of.verdict(assessment))
    if report.unfinished and not report.interrupted:
        return options.UNFINISHED
    return options.exit_code(bool(report.holds), report.interrupted)


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.validate",
        "Test a loop with random passive humans in both engines, and search for the worst human.",
        "python -m sim.validate --humans 200 --adversary",
        "python -m sim.validate --coupling none --humans 200 --duration 0",
        first="scenario coupling condition humans adversary json",
    )
    add, whole_number = parser.add_argument, options.whole
    parser.add_loop()
    parser.add_varying_delays()
    parser.add_coupling(", ".join(NAMES))
    parser.add_human(", or a population with draw(rng, n), in a .py")
    parser.add_limiter()
    many = f"random humans per device (default {_HUMANS}, in a world {_IN_A_WORLD})"
    add("--humans", type=whole_number(1, 1_000_000), metavar="N", help=many)
    add("--links", choices=tuple(_LINKS), help="masses in each human (default: as in the scenario); mixed: 1 or 2")
    add("--engine", choices=ENGINES, default="both", help="engines that judge hands; mujoco means both (default both)")
    seconds = "length of the traces [s] (default 2; 0: no traces)"
    add("--duration", type=options.number(), default=2.0, metavar="SECONDS", help=seconds)
    traced = "hands that MuJoCo also simulates: all, or sampled (default): nearest to instability, lossless, 64 random"
    add("--traces", choices=("sampled", "all"), default="sampled", help=traced)
    add(
        "--shards",
        type=whole_number(1, 256),
        default=1,
        metavar="K",
        help="number of processes, on which the result does not depend (default 1)",
    )
    add("--adversary", action="store_true", help="also search for the worst passive human")
    add("--generations", type=whole_number(1, 10_000), metavar="N", help="generations of --adversary (default 150)")
    met = "environments: the nominal one (default), or in turn the nominal one, the ranges' vertices, and points inside"
    add("--environments", choices=_ENVIRONMENTS, default="nominal", metavar="{nominal,ranges}", help=met)
    parser.add_output(picture=True)
    parser.only("with --adversary", lambda args: args.adversary, "generations")
    traced = "with traces of MuJoCo: --engine exact and --duration 0 have none"
    parser.only(traced, lambda args: args.engine != "exact" and args.duration != 0, "traces")
    return parser


def _scenario(args: argparse.Namespace) -> Scenario:
    """Return the scenario of the options. Raises InputError."""
    scenario = options.with_humans(args, options.with_varying_delays(args, options.scenario_from(args)))
    require_linear(scenario, "sim.validate", walls=True)
    if args.environments == "ranges" and scenario.ranges is None:
        raise InputError("--environments ranges: the scenario has no ranges (docs/scenario.md, [ranges])")
    if not (args.duration == 0 or 4 * scenario.T <= args.duration <= 1e5):
        allowed = f"allowed are 0 and {4 * scenario.T:g} to 100000 s"
        raise InputError(f"--duration is {args.duration:g}, {allowed}")
    return scenario


def _environments(args: argparse.Namespace, ranges: RangesResult | None) -> tuple[Member, ...]:
    """Return the nominal environment, vertices, worst and random points of ranges; () for --environments nominal."""
    if args.environments == "nominal":
        return ()
    assert ranges is not None
    others = (ranges.searched.worst[0].member, *ranges.samples)
    return (*ranges.members, *others[: len(ranges.members)])


def _question(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, assessment: Assessment) -> Validation:
    if args.links and not isinstance(scenario.population, Population):
        raise InputError(
            f"--links {args.links} with --human {args.human}: a population of your own draws its own masses"
        )
    links = _LINKS[args.links] if args.links else getattr(scenario.population, "links", 1)
    work, met = (args.humans, links, args.engine, args.duration), _environments(args, assessment.ranges)
    rho, every = assessment.force_limits.rho, args.traces == "all"
    return Validation(scenario, chosen.coupling, args.seed, *work, environments=met, lag=rho, all_traces=every)


@dataclass(frozen=True)
class _Searched:
    """Results of --adversary; None if a search did not run, or did not end."""

    worst: Worst | None = None  # the worst lossless human
    drawn: Worst | None = None  # the worst human of a user's own population
    ratio: float = 0.0  # required over available damping of the attacked loop
    interrupted: bool = False


def _searched(args: argparse.Namespace, question: Validation, chosen: Chosen, assessment: Assessment) -> _Searched:
    """Return the worst humans that are found, with --environments ranges in the worst environment that is known.

    Ctrl-C ends the search.
    """
    from haptic_loop.sim.adversary import search, search_population

    here = THIS_ENVIRONMENT.name, KNOWN_DEVICE.name
    judged = [need for need in assessment.requirements.values() if need.condition in here]
    scenario, ratio = question.scenario, min(need.ratio for need in judged)
    if question.environments and assessment.ranges:
        member, requirement = assessment.ranges.worst_found
        scenario, ratio = scenario.replace(environment=member.network, ranges=None), requirement.ratio
    worst: list[Worst] = []
    try:
        for seek in (search, search_population)[: 1 if isinstance(scenario.population, Population) else 2]:
            with render.progress("searching for the worst human") as move:
                frozen = assemble(scenario, chosen.coupling).process.law.frozen().values()
                loop = scenario.loop(args.case)
                # Among all sets of touched walls take the one that requires most damping.
                F = max(frozen, key=lambda F: this_environment(F, loop).ratio)
                worst.append(seek(scenario, F, args.seed, args.generations or 150, progress=move))
    except KeyboardInterrupt:
        return _Searched(*worst, ratio=ratio, interrupted=True)
    return _Searched(*worst, ratio=ratio)


def _save(
    args: argparse.Namespace,
    out: Path,
    question: Validation,
    findings: Findings,
    worst: Worst | None,
    kind: str,
    painter: Painter,
) -> list[Path]:
    """Save the worst and the disagreeing humans for `sim.run --human`, and the picture. Return the files."""
    scenario, files = question.scenario, []
    humans = "worst-human.toml", "adversary.toml", *(each.name for each in out.glob("disagreement-[0-9]*.toml"))
    render.remove_earlier(out, "population.png", *humans)
    named = {f"disagreement-{i}.toml": int(i) for i in findings.index[findings.disagreements]}
    if findings.index.size:
        named |= {"worst-human.toml": int(findings.index[np.argmax(findings.radius)])}
    for name, i in named.items():
        if not question.can_store(i):
            continue
        crowd = question.crowd(i)
        remark = f"seed {question.seed}, index {i}"
        mechanics = crowd.mechanics[0] if crowd.mechanics else ()
        files.append(save_humans(out / name, crowd.humans(0), remark, crowd.persons(0), mechanics))
    if worst:
        remark = f"found by the adversary, seed {question.seed}: growth {worst.growth:+.6g} 1/s"
        files.append(save_humans(out / "adversary.toml", worst.humans, remark, worst.persons, worst.mechanics))
    if findings.index.size and not args.no_plot:
        coupling = "no coupling" if args.case == "none" else f"{kind} coupling"
        what = scenario.title(args.case).removesuffix(", no coupling")
        title = f"{what}, {coupling}: {findings.index.size} random humans"
        shown = findings.mass, findings.damping, findings.exact, title
        painter.ask("draw_population", *shown)
        files.append(painter.save(out / "population.png"))
    return files


# ---- the report and its parts


_NOTHING = "no batch of humans was finished"


@dataclass(frozen=True)
class _Own:
    """Growth of the exact loop with the hands of the scenario, or of --human FILE."""

    from_: str
    exact: Eigenvalues = off_table("inlined")
    holds: bool = off_table()

    def rows(self) -> render.Rows:
        growth = f"{self.exact.exact_growth_rate_per_s:+.4g} 1/s at {self.exact.exact_frequency_hz:.2f} Hz"
        yield f"hands of {self.from_}", f"{growth}: {self.exact.exact_verdict}"


def _assessment_rows(assessment: Assessment) -> render.Rows:
    if assessment.condition not in PLAIN_CONDITIONS:
        yield from render.certificate_rows({assessment.condition: assessment.decisive}, 5)
    yield "force limits", assessment.force_limits.words
    yield "held torques", assessment.held_torques


@dataclass(frozen=True, kw_only=True)
class _Report:
    """Results of a validation; a missing part is null or left out."""

    case: str
    scenario: str
    scenario_digest: str
    links: int | str
    seed: int
    engine: str
    humans: int = render.figure("humans", "{} (links {r.links}, seed {r.seed})")
    devices: str | None = render.figure("devices", json="if given")
    environments: verdicts.EnvironmentsMet = render.figure("environments")
    unstable: verdicts.Unstable = render.figure("unstable")
    disagreements: int = render.figure("disagreements", "{r.disagreement_words}")
    disagreement_words: str = off_table("left out")
    disagreeing: list[verdicts.DrawnHumans]
    worst: verdicts.WorstDrawn | None = render.figure("worst human")
    own_humans: _Own = render.several(_Own.rows)
    largest_difference_per_s: float | None = render.figure("difference of growth rates", "{:.1e} 1/s at most")
    traces: verdicts.Traces | None = render.several(verdicts.Traces.rows)
    assessment: Assessment = render.several(_assessment_rows)
    settled: str | None = render.figure("handles come to rest", json="left out")
    energy_audit: verdicts.EnergyAudit | None = render.figure("energy audit W >= 0", json="if given")
    switching: verdicts.Growing[VaryingDelays] | None = render.several(
        lambda grow: [*render.delay_rows(grow.met), grow.row("delays")], "if given"
    )
    timing: verdicts.Growing[UnevenTicks] | None = render.several(
        lambda grow: [render.timing_row(grow.met), grow.row("ticks")], "if given"
    )
    adversary: verdicts.Attacked | None = render.figure("adversary", json="if given")
    adversary_population: verdicts.Attacked | None = render.figure("adversary, own population", json="if given")
    certified: bool = render.figure("certified", "{r.certified_words}")
    holds: bool | None = render.figure("holds", "{r.holds_words}", absent=_NOTHING)
    reason: str | None = off_table("if given")
    interrupted: bool
    ended: bool | None = render.figure("interrupted", "{r.finished}", json="left out")  # None if not interrupted
    unfinished: str | None = render.figure("unfinished", "{}; {r.finished}")
    wall_s: float = render.figure("time", "{:.1f} s, {r.simulated_s_per_s:.0f} simulated seconds per second")
    simulated_s_per_s: float
    remarks: Sequence[str]

    @property
    def finished(self) -> str:
        """The number of finished humans, for a validation that ended early."""
        return f"{self.humans} humans were finished by then"

    @property
    def certified_words(self) -> str:
        """Whether a guarantee covers the simulated loops, in words."""
        stated = self.assessment.guarantee_words
        return "yes" if self.certified else f"no: the guarantee is for {stated}" if stated else "no"

    @property
    def holds_words(self) -> str:
        """Whether all tests hold, in words."""
        if not self.holds:
            return "[red]no[/]"
        return "[green]yes[/]" if self.certified else "nothing is certified that the tests could contradict"


def _varying(
    question: Validation, chosen: Chosen, assessment: Assessment, findings: Findings, certified: bool
) -> tuple[verdicts.Growing[VaryingDelays] | None, verdicts.Growing[UnevenTicks] | None]:
    """Return how many hands make the loop grow while delays vary, and while ticks vary; None without variation."""
    from haptic_loop.sim.switching import DelaysCovered

    scenario, switching, timing = question.scenario, None, None
    if scenario.varying_delay:
        covered = DelaysCovered.of(scenario, assessment, chosen.switching)
        met = VaryingDelays(DelaySpan.of(scenario.varying_delay), None, covered)
        switching = verdicts.Growing.of(question, findings, met, covered.covered)
    if scenario.uneven and (ticks := scenario.timing(question.seed, max(1, question.ticks))):
        timing = verdicts.Growing.of(question, findings, UnevenTicks.of(ticks, scenario), certified)
    return switching, timing


def _tested(
    args: argparse.Namespace,
    chosen: Chosen,
    assessment: Assessment,
    question: Validation,
    findings: Findings,
    searched: _Searched,
    certified: bool,
) -> dict[str, Any]:
    """Return all tests of the claims but the one with random humans, by the names of the report's fields."""
    mode = worst_mode(assemble(question.scenario, chosen.coupling))
    own = _Own(args.human or question.scenario.name, eigenvalues(mode), not (certified and unstable(mode.growth)))
    plain = any(each.certified for name, each in assessment.requirements.items() if name not in KNOWN_CONDITIONS)
    # The audit's energy W counts delta dx^2/T, which a proof for known devices does not bound.
    energy = verdicts.EnergyAudit.of(question, findings) if certified and plain and question.ticks else None
    switching, timing = _varying(question, chosen, assessment, findings, certified)
    worst, drawn = (w and verdicts.Attacked.of(w, searched.ratio, certified) for w in (searched.worst, searched.drawn))
    return {
        "own_humans": own,
        "energy_audit": energy,
        "switching": switching,
        "timing": timing,
        "adversary": worst,
        "adversary_population": drawn,
    }


def _reported(
    args: argparse.Namespace,
    chosen: Chosen,
    assessment: Assessment,
    question: Validation,
    findings: Findings,
    wall: float,
    searched: _Searched,
) -> _Report:
    scenario, any_done = question.scenario, bool(findings.index.size)
    guarantee = assessment.guarantee
    certified = guarantee is not None
    if question.environments:  # The humans meet environments of the ranges.
        certified = guarantee is not None and guarantee.environments in (ANY, RANGES)
    tests = _tested(args, chosen, assessment, question, findings, searched, certified)
    also = all(test.holds for test in tests.values() if test) and not chosen.fails(assessment.requirements)
    traces = verdicts.Traces.of(question, findings) if question.ticks and any_done else None
    both, bad, grows = question.engine != "exact", unstable(findings.exact), unstable(findings.mujoco)
    disagreements, wrong = int(findings.disagreements.sum()), bad | (both & grows & (findings.mujoco > 1e-3))
    interrupted = findings.interrupted or searched.interrupted
    return _Report(
        case=args.case,
        scenario=scenario.name,
        scenario_digest=scenario.digest,
        links="mixed" if question.links == MIXED else question.links,
        seed=question.seed,
        engine=engine_name(question.engine),
        humans=findings.index.size,
        devices="drawn within their guaranteed bounds, for every set of hands" if scenario.known_devices else None,
        environments=verdicts.EnvironmentsMet.met(question, findings),
        unstable=verdicts.Unstable.of(question, int(bad.sum()), int(grows.sum())),
        disagreements=disagreements,
        disagreement_words=verdicts.disagreement_words(question, findings),
        disagreeing=[verdicts.DrawnHumans.of(question, int(i)) for i in findings.index[findings.disagreements]],
        worst=verdicts.WorstDrawn.of(question, findings) if any_done else None,
        **tests,
        largest_difference_per_s=verdicts.largest(np.abs(findings.mujoco - findings.exact)),
        traces=traces,
        assessment=assessment,
        settled=traces and traces.settled(),
        certified=certified,
        holds=also and not disagreements and not (certified and wrong.any()) if any_done else None,
        reason=None if any_done else _NOTHING,
        interrupted=interrupted,
        ended=interrupted or None,
        unfinished=findings.lost or None,
        wall_s=wall,
        simulated_s_per_s=findings.simulated / wall,
        remarks=chosen.remarks(assessment.requirements),
    )
