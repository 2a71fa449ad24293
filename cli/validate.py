"""python -m sim.validate: does the verdict hold for everyone? Random passive humans, both engines, an adversary."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from cli import options, render
from cli.judged import Judged, judge
from controller.lti import Array
from controller.ranges import Member
from design.certificate import RangesCheck
from design.conditions import this_environment
from design.guarantees import ANY
from design.result import finite
from models.human import Human, Population
from sim import report
from sim.adversary import Worst, search, search_population
from sim.couplings import NAMES, Chosen, choose
from sim.crowds import ENGINES, MIXED, Findings, Validation
from sim.run import assemble
from sim.scenario import InputError, Scenario, require_linear, save_humans
from sim.shards import Table, validate, validate_on_cluster
from sim.stability import eigenvalue_part, unstable, worst_mode
from sim.switching import certified_part

_ENVIRONMENTS = ("nominal", "ranges", "box")  # the last is the older name of the second
_LINKS = {"1": 1, "2": 2, "mixed": MIXED}


def main(argv: list[str]) -> int:
    """Meet random humans. 0: the claims hold, 1: not, 3: workers were lost, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario, out = _scenario(args), options.out_folder(args, "validate")
    with render.designing(scenario.loop(args.case), args.coupling, args.condition) as heard:
        chosen = choose(scenario, args.case, args.coupling, args.condition, args.limiter, heard)
    judged = judge(args, scenario, chosen)
    question = _question(args, scenario, chosen, judged)
    findings, wall = _findings(args, question, Table(question, out, args.resume))
    searched = _Searched()
    if args.adversary and not (findings.interrupted or findings.lost):
        searched = _searched(args, question, chosen, judged)
    report = _reported(args, chosen, judged, question, findings, wall, searched)
    files = _save(args, out, question, findings, searched.worst, chosen.kind)
    title = f"{scenario.title(args.case)}: coupling {chosen.kind}"
    lines = [*([f"Delays that vary: {report.switching.met['covers']}."] if report.switching else []), *report.remarks]
    render.publish(args, report, [render.facts(title, render.rows_of(report), ("", ""))], lines, out, files)
    if report.interrupted:
        return options.INTERRUPTED
    if report.unfinished:
        return options.UNFINISHED
    return options.DONE if report.holds else options.DOES_NOT_HOLD


def _parser() -> options.Parser:
    parser = options.Parser(
        "sim.validate",
        "Test a loop with random passive humans in both engines, and search for the worst one.",
        "python -m sim.validate --case I --humans 200 --adversary",
    )
    options.add_loop_options(parser)
    options.add_varying_delay_options(parser)
    options.add_coupling_options(parser, ", ".join(NAMES))
    options.add_human_option(parser, " and `population`, whose draw(rng, n) gives n hands,")
    options.add_limiter_option(parser)
    humans, count = "random humans per device (default 1000)", options.whole(1, 1_000_000)
    parser.add_argument("--humans", type=count, default=1000, metavar="N", help=humans)
    parser.add_argument("--links", choices=tuple(_LINKS), help="of each human (default: the scenario's population)")
    parser.add_argument("--engine", choices=ENGINES, default="both", help="default both")
    seconds = "of the traces (default 2; 0 for none)"
    parser.add_argument("--duration", type=options.number(), default=2.0, metavar="SECONDS", help=seconds)
    shards = "local processes (default 1); the result is the same"
    parser.add_argument("--shards", type=options.whole(1, 256), default=1, metavar="K", help=shards)
    parser.add_argument("--dask", metavar="HOST:PORT", help="work on an existing Dask cluster; the result is the same")
    again = "go on with what a run of the same words left unfinished in the folder"
    parser.add_argument("--resume", action="store_true", help=again)
    parser.add_argument("--adversary", action="store_true", help="also search for the worst passive human")
    generations = "of the adversary's search (default 150)"
    parser.add_argument("--generations", type=options.whole(1, 10_000), metavar="N", help=generations)
    met = "nominal (default), or ranges: in turn all vertices of the scenario's ranges and as many others inside"
    parser.add_argument(
        "--environments", choices=_ENVIRONMENTS, default="nominal", metavar="{nominal,ranges}", help=met
    )
    options.add_output_options(parser, picture=True)
    return parser


def _scenario(args: argparse.Namespace) -> Scenario:
    """The scenario, which must be linear. Raises InputError."""
    scenario = options.with_humans(args, options.with_varying_delays(args, options.scenario_from(args)))
    require_linear(scenario, "sim.validate", walls=True)
    if args.dask is not None and args.shards > 1:
        raise InputError(f"--shards {args.shards} with --dask: the cluster decides who does what, give one of them")
    if args.generations is not None and not args.adversary:
        raise InputError("--generations without --adversary: it is how long that searches")
    if not (args.duration == 0 or 4 * scenario.T <= args.duration <= 1e5):
        allowed = f"allowed are 0 and {4 * scenario.T:g} to 100000 s"
        raise InputError(f"--duration is {args.duration:g}, {allowed}")
    return scenario


def _environments(args: argparse.Namespace, whole: RangesCheck | None) -> tuple[Member, ...]:
    """Vertices and as many others of the ranges, the worst that was found first; none where all meet the nominal one.

    Raises InputError.
    """
    if args.environments == "nominal":
        return ()
    if whole is None:
        raise InputError(f"--environments {args.environments}: the scenario has no ranges (docs/scenario.md, [ranges])")
    others = (whole.searched.worst[0].member, *whole.samples)
    return (*whole.members, *others[: len(whole.members)])


def _question(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, judged: Judged) -> Validation:
    """What is asked of whom. Raises InputError."""
    links = _LINKS[args.links] if args.links else getattr(scenario.population, "links", 1)  # a user's own has none
    work, met = (args.humans, links, args.engine, args.duration), _environments(args, judged.whole)
    return Validation(scenario, chosen.coupling, args.seed, *work, environments=met, lag=judged.limits.rho)


def _findings(args: argparse.Namespace, question: Validation, table: Table) -> tuple[Findings, float]:
    """The findings on all humans, and the seconds that they took."""
    begin = time.perf_counter()
    with render.progress("validating") as move:
        if args.dask is not None:
            findings = validate_on_cluster(question, args.dask, move, table)
        else:
            findings = validate(question, args.shards, move, table)
    return findings, time.perf_counter() - begin


@dataclass(frozen=True)
class _Searched:
    """What the adversary found; None where it was not asked, or the keyboard ended its search."""

    worst: Worst | None = None
    drawn: Worst | None = None  # the worst that the scenario's own population draws
    ratio: float = 0.0  # required over available damping of the loop that was attacked
    interrupted: bool = False


def _searched(args: argparse.Namespace, question: Validation, chosen: Chosen, judged: Judged) -> _Searched:
    """The worst humans, in the environment that asks most; what was found before Ctrl-C is kept."""
    scenario, ratio = question.scenario, judged.requirements["this-environment"].ratio
    if question.environments and judged.whole:
        member, requirement = judged.whole.worst_found
        scenario, ratio = scenario.replace(environment=member.network, ranges=None), requirement.ratio
    found: list[Worst] = []
    try:
        for seek in (search, search_population)[: 1 if isinstance(scenario.population, Population) else 2]:
            with render.progress("searching the worst human") as move:
                frozen = assemble(scenario, chosen.coupling).process.frozen().values()
                F = max(frozen, key=lambda F: this_environment(F, scenario.delta).ratio)  # the state that asks most
                found.append(seek(scenario, F, args.seed, args.generations or 150, progress=move))
    except KeyboardInterrupt:
        return _Searched(*found, ratio=ratio, interrupted=True)
    return _Searched(*found, ratio=ratio)


def _save(
    args: argparse.Namespace, out: Path, question: Validation, findings: Findings, worst: Worst | None, kind: str
) -> list[Path]:
    """Humans that can be replayed with `sim.run --human`, and the picture."""
    scenario, files = question.scenario, []
    named = {f"disagreement-{i}.toml": int(i) for i in findings.index[findings.disagreements]}
    if findings.index.size:
        named |= {"worst-human.toml": int(findings.index[np.argmax(findings.radius)])}
    for name, i in named.items():
        crowd = question.crowd(i)
        if not isinstance(crowd.humans(0)[0], Human):  # a user's own class, which draws this hand again
            continue
        remark = f"seed {question.seed}, index {i}"
        files.append(save_humans(out / name, crowd.humans(0), remark, crowd.persons(0)))
    if worst:
        remark = f"found by the adversary, seed {question.seed}: growth {worst.growth:+.6g} 1/s"
        files.append(save_humans(out / "adversary.toml", worst.humans, remark, worst.persons))
    if not args.no_plot and findings.index.size:
        from sim.plots import plot_population

        coupling = "no coupling" if args.case == "none" else f"{kind} coupling"
        what = scenario.title(args.case).removesuffix(", no coupling")
        title = f"{what}, {coupling}: {findings.index.size} random humans"
        files.append(plot_population(findings.mass, findings.damping, findings.exact, out / "population.png", title))
    return files


# ----------------------------------------------------------------------------------------------------
# The report and its parts. Each says itself what stands in its row of the table.


_SETTLING = 4  # decay times of the slowest mode in a trace whose hands must be slower in its last quarter than before
_ROUNDING = 1e-9  # W(N) may be this far below zero, beside the magnitudes that it adds up
_NOTHING = "no batch of humans was done"


@dataclass(frozen=True)
class _Unstable:
    """Hands that make the loop unstable, by engine; None for one that was not asked."""

    exact: int
    mujoco: int | None

    def __str__(self) -> str:
        return f"{self.exact} exact" + ("" if self.mujoco is None else f", {self.mujoco} MuJoCo")


@dataclass(frozen=True)
class _Environments:
    """Which environments the loops had, and in which of them a loop was unstable."""

    of: str
    count: int
    names: list[str] | None = render.unseen("given", None)
    unstable_in: list[str] | None = render.unseen("given", None)

    @classmethod
    def met(cls, question: Validation, findings: Findings) -> _Environments:
        members = question.environments
        if not members:
            return cls("the nominal environment", 1)
        where = sorted({int(i) % len(members) for i in findings.index[unstable(findings.exact)]})
        return cls("the ranges", len(members), [each.name for each in members], [members[i].name for i in where])

    def __str__(self) -> str:
        if self.unstable_in is None:
            return self.of
        return f"{self.count} of {self.of}, in turn; unstable in: {'; '.join(self.unstable_in) or 'none'}"


@dataclass(frozen=True)
class _Drawn:
    """A set of humans that the population drew, and the environment that it met."""

    seed: int
    index: int
    human: list[dict[str, Any]]
    person: list[dict[str, Any]]
    environment: str | None = render.unseen("given", None)
    network: dict[str, Any] | None = render.unseen("given", None)

    @classmethod
    def of(cls, question: Validation, index: int) -> _Drawn:
        crowd, member = question.crowd(index), question.environment(index)
        humans, persons = _humans(crowd.humans(0)), msgspec.to_builtins(crowd.persons(0))
        where, network = (member.name, msgspec.to_builtins(member.network)) if member else (None, None)
        return cls(question.seed, index, humans, persons, where, network)


@dataclass(frozen=True)
class _Slowest:
    """The humans of the largest spectral radius."""

    spectral_radius: float
    growth_rate_per_s: float
    frequency_hz: float
    who: _Drawn = render.unseen("beside")

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> _Slowest:
        k = int(np.argmax(findings.radius))
        radius, growth, frequency = (float(of[k]) for of in (findings.radius, findings.exact, findings.frequency))
        return cls(radius, growth, frequency, _Drawn.of(question, int(findings.index[k])))

    def __str__(self) -> str:
        growth = f"{self.growth_rate_per_s:+.4g} 1/s at {self.frequency_hz:.2f} Hz (index {self.who.index})"
        return growth + (f", at {self.who.environment}" if self.who.environment else "")


@dataclass(frozen=True)
class _Own:
    """What the exact loop does in the hands of the scenario, or of --human FILE."""

    from_: str
    mode: Mapping[str, Any] = render.unseen("beside")
    holds: bool = render.unseen()

    def rows(self) -> render.Rows:
        mode = self.mode
        growth = f"{mode['exact_growth_rate_per_s']:+.4g} 1/s at {mode['exact_frequency_hz']:.2f} Hz"
        yield f"hands of {self.from_}", f"{growth}: {mode['exact_verdict']}"


@dataclass(frozen=True)
class _Traces:
    """What the traces say, and whether they are long enough for hands to be slower at their end."""

    duration_s: float
    clipped_runs: int
    contacts: int
    measured: int
    largest_difference_per_s: float | None
    stable_and_settling: int
    stable: int
    slowest_settling: float | None
    slowest_decay_s: float | None
    settling_decides: bool
    reason: str | None = render.unseen("given", None)

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> _Traces:
        stable, duration = ~unstable(findings.exact), question.ticks * question.scenario.T
        decay = _largest(-1 / findings.exact[findings.exact < 0])
        decides = decay is None or duration >= _SETTLING * decay
        slow = f"the slowest mode decays in {decay:.3g} s: in {duration:g} s its hands need not be slower"
        return cls(
            duration_s=duration,
            clipped_runs=int((findings.clipped > 0).sum()),
            contacts=int(findings.contacts.sum()),
            measured=int(np.isfinite(findings.trace).sum()),
            largest_difference_per_s=_largest(np.abs(findings.trace - findings.exact)),
            stable_and_settling=int((stable & (findings.settling < 1)).sum()),
            stable=int(stable.sum()),
            slowest_settling=_largest(findings.settling[stable]),
            slowest_decay_s=decay,
            settling_decides=decides,
            reason=None if decides else slow,
        )

    def rows(self) -> render.Rows:
        yield "traces", f"{self.duration_s:g} s each, {self.clipped_runs} reached a force limit"
        yield "contacts made", f"{self.contacts} on these traces" if self.contacts else None

    def settled(self) -> str:
        undecided = "" if self.settling_decides else f"; no verdict: {self.reason}"
        return f"{self.stable_and_settling} of {self.stable} stable loops slower at the end{undecided}"


@dataclass(frozen=True)
class _Energy:
    """Traces on which W >= 0 was asked: forces that were clipped are covered by nothing, those of a limiter are."""

    audited: int
    clipped: int
    violated: int
    least_J: float | None
    holds: bool

    @classmethod
    def of(cls, question: Validation, findings: Findings) -> _Energy:
        asked = (findings.clipped == 0) | (question.lag is not None)
        violated = int((asked & ~(findings.energy >= -_ROUNDING * findings.audited)).sum())
        least = float(findings.energy[asked].min()) if asked.any() else None
        return cls(int(asked.sum()), int((~asked).sum()), violated, least, not violated)

    def __str__(self) -> str:
        left = f", {self.clipped} clipped left out" if self.clipped else ""
        return f"{self.audited - self.violated} of {self.audited}{left}"


@dataclass(frozen=True)
class _Growing:
    """How many humans grow while delays or ticks vary; it holds unless certificates cover these and one grows."""

    met: Mapping[str, Any] = render.unseen("beside")
    unstable: _Unstable = render.unseen()
    humans: int = render.unseen()
    mujoco_unclipped: int = render.unseen()
    largest_growth_per_s: float | None = render.unseen()
    worst_index: int | None = render.unseen()
    holds: bool = render.unseen()

    @classmethod
    def of(cls, findings: Findings, met: Mapping[str, Any]) -> _Growing:
        exact, mujoco = findings.switching, findings.switching_mujoco
        seen, mujoco = ~np.isnan(exact), mujoco[~np.isnan(mujoco)]
        grow = _Unstable(int((exact > 0).sum()), int((mujoco > 0).sum()) if mujoco.size else None)
        worst = int(np.nanargmax(exact)) if seen.any() else None
        figures = (None, None) if worst is None else (float(exact[worst]), int(findings.index[worst]))
        return cls(met, grow, int(seen.sum()), mujoco.size, *figures, not (met["covered"] and grow.exact))

    def row(self, what: str) -> tuple[str, str | None]:
        mujoco, growth = self.unstable.mujoco, self.largest_growth_per_s
        also = "" if mujoco is None else f", MuJoCo {mujoco} of {self.mujoco_unclipped} unclipped"
        worst = "" if growth is None else f"; worst {growth:+.4g} 1/s (index {self.worst_index})"
        grow = f"{self.unstable.exact} of {self.humans} exact{also}{worst}"
        return f"grow while {what} vary", grow if self.humans else None


@dataclass(frozen=True)
class _Adversary:
    """What a search found, and how far the loop is from its required damping."""

    found: bool
    spectral_radius: float
    growth_rate_per_s: float
    frequency_hz: float
    evaluated: int
    required_over_available_damping: float | None
    human: list[dict[str, Any]]
    person: list[dict[str, Any]]
    holds: bool

    @classmethod
    def of(cls, worst: Worst, ratio: float, certified: bool) -> _Adversary:
        humans, persons = _humans(worst.humans), msgspec.to_builtins(worst.persons)
        figures = worst.spectral_radius, worst.growth, worst.frequency_hz, worst.evaluated
        return cls(worst.destabilises, *figures, finite(ratio), humans, persons, not (certified and worst.destabilises))

    def __str__(self) -> str:
        grows = f"a human that grows at {self.growth_rate_per_s:+.4g} 1/s"
        ratio, found = self.required_over_available_damping, grows if self.found else "no destabilising human"
        close = "no damping is enough" if ratio is None else f"the loop needs {ratio:.4g} of the damping it has"
        return f"{found} among {self.evaluated}; {close}"


@dataclass(frozen=True, kw_only=True)
class _Report:
    """What a validation found; parts are null, or left out, where there is none of them."""

    case: str
    scenario: str
    scenario_digest: str
    links: int | str
    seed: int
    engine: str
    humans: int = render.figure("humans", "{} (links {r.links}, seed {r.seed})")
    environments: _Environments = render.figure("environments")
    unstable: _Unstable = render.figure("unstable")
    disagreements: int = render.figure("disagreements")
    disagreeing: list[_Drawn]
    worst: _Slowest | None = render.figure("worst human")
    own_humans: _Own = render.several(_Own.rows)
    largest_difference_per_s: float | None = render.figure(
        "MuJoCo's growth rates", "within {:.1e} 1/s of the exact ones"
    )
    traces: _Traces | None = render.several(_Traces.rows)
    judged: Judged = render.figure("force limits", "{.limiter[words]}", json="beside")
    settled: str | None = render.figure("handles come to rest", json="table")
    energy_audit: _Energy | None = render.figure("energy audit W >= 0", json="given")
    switching: _Growing | None = render.several(lambda g: [*render.delay_rows(g.met), g.row("delays")], "given")
    timing: _Growing | None = render.several(lambda g: [render.timing_row(g.met), g.row("ticks")], "given")
    adversary: _Adversary | None = render.figure("adversary", json="given")
    adversary_population: _Adversary | None = render.figure("adversary, own population", json="given")
    certified: bool = render.figure("certified", lambda yes: "yes" if yes else "no")
    holds: bool | None = render.figure("holds", lambda yes: "[green]yes[/]" if yes else "[red]no[/]", absent=_NOTHING)
    reason: str | None = render.unseen("given")
    interrupted: bool
    kept: str = render.unseen("table")
    ended: str | None = render.figure("interrupted", "{r.kept}", json="table")
    unfinished: str | None = render.figure("unfinished", "{}; {r.kept}")
    wall_s: float = render.figure("time", "{:.1f} s, {r.simulated_s_per_s:.0f} simulated seconds per second")
    simulated_s_per_s: float
    remarks: Sequence[str]


def _reported(
    args: argparse.Namespace,
    chosen: Chosen,
    judged: Judged,
    question: Validation,
    findings: Findings,
    wall: float,
    searched: _Searched,
) -> _Report:
    """Everything that was found, and whether all of it holds."""
    scenario, any_done = question.scenario, bool(findings.index.size)
    guarantee = judged.promise
    certified = guarantee is not None and (not question.environments or guarantee == ANY or judged.proved)
    mode = worst_mode(assemble(scenario, chosen.coupling))
    own = _Own(args.human or scenario.name, eigenvalue_part(mode), not (certified and unstable(mode.growth)))
    energy = _Energy.of(question, findings) if certified and question.ticks else None
    switching = timing = None
    if scenario.varying_delay:
        covered = report.delay_range_part(scenario.varying_delay) | certified_part(scenario, chosen, certified)
        switching = _Growing.of(findings, covered)
    if scenario.uneven:
        met = report.timing_part(scenario.timing(args.seed, max(1, question.ticks)), scenario) or {}
        timing = _Growing.of(findings, met | {"covered": certified})
    worst, drawn = (w and _Adversary.of(w, searched.ratio, certified) for w in (searched.worst, searched.drawn))
    also = all(part.holds for part in (own, energy, switching, timing, worst, drawn) if part)
    traces = _Traces.of(question, findings) if question.ticks and any_done else None
    both, bad, grows = question.engine != "exact", unstable(findings.exact), unstable(findings.mujoco)
    disagreements, wrong = int(findings.disagreements.sum()), bad | (both & grows & (findings.mujoco > 1e-3))
    interrupted = findings.interrupted or searched.interrupted
    kept = f"{findings.index.size} humans that were finished are kept, --resume does the others; searches are not kept"
    return _Report(
        case=args.case,
        scenario=scenario.name,
        scenario_digest=scenario.digest,
        links="mixed" if question.links == MIXED else question.links,
        seed=question.seed,
        engine=question.engine,
        humans=findings.index.size,
        environments=_Environments.met(question, findings),
        unstable=_Unstable(int(bad.sum()), int(grows.sum()) if both else None),
        disagreements=disagreements,
        disagreeing=[_Drawn.of(question, int(i)) for i in findings.index[findings.disagreements]],
        worst=_Slowest.of(question, findings) if any_done else None,
        own_humans=own,
        largest_difference_per_s=_largest(np.abs(findings.mujoco - findings.exact)),
        traces=traces,
        judged=judged,
        settled=traces and traces.settled(),
        energy_audit=energy,
        switching=switching,
        timing=timing,
        adversary=worst,
        adversary_population=drawn,
        certified=certified,
        holds=also and not disagreements and not (certified and wrong.any()) if any_done else None,
        reason=None if any_done else _NOTHING,
        interrupted=interrupted,
        kept=kept,
        ended=kept if interrupted else None,
        unfinished=findings.lost or None,
        wall_s=wall,
        simulated_s_per_s=findings.simulated / wall,
        remarks=chosen.notes,
    )


def _humans(humans: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Links of each channel's human; of a user's own class what the handle feels of it."""
    parts = ("mass", "across", "damping", "stiffness")
    return [
        {"links": msgspec.to_builtins(human.links)}
        if isinstance(human, Human)
        else {"class": type(human).__name__} | {name: getattr(human.port(), name) for name in parts}
        for human in humans
    ]


def _largest(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else None
