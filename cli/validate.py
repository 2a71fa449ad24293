"""python -m sim.validate: does the verdict hold for everyone? Random passive humans, both engines, an adversary."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from cli import options, render
from cli.judged import judge
from controller.ranges import Member
from design.certificate import RangesCheck
from design.conditions import this_environment
from design.guarantees import ANY
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
    environments, guarantee = _environments(args, judged.whole), judged.promise
    certified = guarantee is not None and (not environments or guarantee == ANY or judged.proved)

    question = _question(args, scenario, chosen, environments, judged.limits.rho)
    findings, wall = _findings(args, question, Table(question, out, args.resume))
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "scenario_digest": scenario.digest,
        **report.validation_part(question, findings, certified, wall),
        **render.plain(judged),
        "remarks": list(chosen.notes),
    }
    _add(outcome, "own_humans", _own_humans(args, scenario, chosen, certified))
    if scenario.varying_delay:
        covered = report.delay_range_part(scenario.varying_delay) | certified_part(scenario, chosen, certified)
        _add(outcome, "switching", report.varying_delays_part(findings, covered))
    if scenario.uneven:
        met = report.timing_part(scenario.timing(args.seed, max(1, question.ticks)), scenario) or {}
        _add(outcome, "timing", report.varying_delays_part(findings, met | {"covered": certified}))
    worst = None
    if args.adversary and not (findings.interrupted or findings.lost):
        attacked, ratio = scenario, judged.requirements["this-environment"].ratio
        if environments and judged.whole:
            member, requirement = judged.whole.worst_found
            attacked, ratio = scenario.replace(environment=member.network, ranges=None), requirement.ratio
        worst = _attack(args, attacked, chosen, outcome)
        if worst:
            _add(outcome, "adversary", report.adversary_part(worst, ratio, certified))
        own_draws = worst is not None and not isinstance(scenario.population, Population)
        if own_draws and (own := _attack(args, attacked, chosen, outcome, True)):
            _add(outcome, "adversary_population", report.adversary_part(own, ratio, certified))
    files = _save(args, out, question, findings, worst, outcome)
    title = f"{scenario.title(args.case)}: coupling {chosen.kind}"
    render.publish(args, outcome, [render.facts(title, _rows(outcome), ("", ""))], _lines(outcome), out, files)
    if outcome["interrupted"]:
        return options.INTERRUPTED
    if outcome["unfinished"]:
        return options.UNFINISHED
    return options.DONE if outcome["holds"] else options.DOES_NOT_HOLD


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


def _question(
    args: argparse.Namespace,
    scenario: Scenario,
    chosen: Chosen,
    environments: tuple[Member, ...],
    lag: tuple[float, ...] | None,
) -> Validation:
    links = _LINKS[args.links] if args.links else getattr(scenario.population, "links", 1)  # a user's own has none
    work = args.humans, links, args.engine, args.duration
    return Validation(scenario, chosen.coupling, args.seed, *work, environments=environments, lag=lag)


def _findings(args: argparse.Namespace, question: Validation, table: Table) -> tuple[Findings, float]:
    """The findings on all humans, and the seconds that they took."""
    begin = time.perf_counter()
    with render.progress("validating") as move:
        if args.dask is not None:
            findings = validate_on_cluster(question, args.dask, move, table)
        else:
            findings = validate(question, args.shards, move, table)
    return findings, time.perf_counter() - begin


def _add(outcome: dict[str, Any], name: str, part: dict[str, Any]) -> None:
    """A further check: the whole holds only if it holds."""
    outcome[name] = part
    outcome["holds"] = outcome["holds"] and part["holds"]


def _own_humans(args: argparse.Namespace, scenario: Scenario, chosen: Chosen, certified: bool) -> dict[str, Any]:
    """What the exact loop does in the hands of the scenario, or of --human FILE."""
    mode = worst_mode(assemble(scenario, chosen.coupling))
    return {
        "from": args.human or scenario.name,
        **eigenvalue_part(mode),
        "holds": not (certified and unstable(mode.growth)),
    }


def _attack(
    args: argparse.Namespace, scenario: Scenario, chosen: Chosen, outcome: dict[str, Any], drawn: bool = False
) -> Worst | None:
    """The worst human, or None where Ctrl-C ends the search; what was found before is kept.

    With `drawn` among the hands that the population draws.
    """
    seek = search_population if drawn else search
    try:
        with render.progress("searching the worst human") as move:
            frozen = assemble(scenario, chosen.coupling).process.frozen().values()
            F = max(frozen, key=lambda F: this_environment(F, scenario.delta).ratio)  # the contact state that asks most
            return seek(scenario, F, args.seed, args.generations or 150, progress=move)
    except KeyboardInterrupt:
        outcome["interrupted"] = True
        return None


def _save(
    args: argparse.Namespace,
    out: Path,
    question: Validation,
    findings: Findings,
    adversary: Worst | None,
    outcome: dict[str, Any],
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
    if adversary:
        remark = f"found by the adversary, seed {question.seed}: growth {adversary.growth:+.6g} 1/s"
        files.append(save_humans(out / "adversary.toml", adversary.humans, remark, adversary.persons))
    if not args.no_plot and findings.index.size:
        from sim.plots import plot_population

        kind = "no coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
        what = scenario.title(args.case).removesuffix(", no coupling")
        title = f"{what}, {kind}: {outcome['humans']} random humans"
        files.append(plot_population(findings.mass, findings.damping, findings.exact, out / "population.png", title))
    return files


# ----------------------------------------------------------------------------------------------------
# The report as a table.


def _rows(outcome: dict[str, Any]) -> list[tuple[str, str | None]]:
    bad, worst, traces, own = (outcome[name] for name in ("unstable", "worst", "traces", "own_humans"))
    audit, adversary, switching = (outcome.get(name) for name in ("energy_audit", "adversary", "switching"))
    timing, drawn = outcome.get("timing"), outcome.get("adversary_population")
    mujoco = "" if bad["mujoco"] is None else f", {bad['mujoco']} MuJoCo"
    verdict = {True: "[green]yes[/]", False: "[red]no[/]"}.get(outcome["holds"]) or str(outcome["reason"])
    kept = f"{outcome['humans']} humans that were finished are kept, --resume does the others; searches are not kept"
    return [
        ("humans", f"{outcome['humans']} (links {outcome['links']}, seed {outcome['seed']})"),
        ("environments", _met(outcome["environments"])),
        ("unstable", f"{bad['exact']} exact{mujoco}"),
        ("disagreements", str(outcome["disagreements"])),
        ("worst human", worst and _worst(worst)),
        (
            f"hands of {own['from']}",
            f"{own['exact_growth_rate_per_s']:+.4g} 1/s at {own['exact_frequency_hz']:.2f} Hz: {own['exact_verdict']}",
        ),
        (
            "MuJoCo's growth rates",
            render.optional(outcome["largest_difference_per_s"], "within {:.1e} 1/s of the exact ones", "") or None,
        ),
        ("traces", traces and f"{traces['duration_s']:g} s each, {traces['clipped_runs']} reached a force limit"),
        ("contacts made", f"{traces['contacts']} on these traces" if traces and traces["contacts"] else None),
        ("force limits", outcome["limiter"]["words"]),
        ("handles come to rest", traces and _settled(traces)),
        ("energy audit W >= 0", audit and _audited(audit)),
        *([*render.delay_rows(switching), _growing("delays", switching)] if switching else []),
        *([render.timing_row(timing), _growing("ticks", timing)] if timing else []),
        ("adversary", adversary and _adversary(adversary)),
        ("adversary, own population", drawn and _adversary(drawn)),
        ("certified", "yes" if outcome["certified"] else "no"),
        ("holds", verdict),
        ("interrupted", kept if outcome["interrupted"] else None),
        ("unfinished", f"{outcome['unfinished']}; {kept}" if outcome["unfinished"] else None),
        ("time", f"{outcome['wall_s']:.1f} s, {outcome['simulated_s_per_s']:.0f} simulated seconds per second"),
    ]


def _lines(outcome: dict[str, Any]) -> list[str]:
    switching = outcome.get("switching")
    return [*([f"Delays that vary: {switching['covers']}."] if switching else []), *outcome["remarks"]]


def _met(environments: dict[str, Any]) -> str:
    if "names" not in environments:
        return environments["of"]
    found = "; ".join(environments["unstable_in"]) or "none"
    return f"{environments['count']} of {environments['of']}, in turn; unstable in: {found}"


def _worst(worst: dict[str, Any]) -> str:
    growth = f"{worst['growth_rate_per_s']:+.4g} 1/s at {worst['frequency_hz']:.2f} Hz (index {worst['index']})"
    return growth + (f", at {worst['environment']}" if "environment" in worst else "")


def _settled(traces: dict[str, Any]) -> str:
    undecided = "" if traces["settling_decides"] else f"; no verdict: {traces['reason']}"
    return f"{traces['stable_and_settling']} of {traces['stable']} stable loops slower at the end{undecided}"


def _audited(audit: dict[str, Any]) -> str:
    left = f", {audit['clipped']} clipped left out" if audit["clipped"] else ""
    return f"{audit['audited'] - audit['violated']} of {audit['audited']}{left}"


def _growing(what: str, switching: dict[str, Any]) -> tuple[str, str | None]:
    mujoco, growth = switching["unstable"]["mujoco"], switching["largest_growth_per_s"]
    also = "" if mujoco is None else f", MuJoCo {mujoco} of {switching['mujoco_unclipped']} unclipped"
    worst = "" if growth is None else f"; worst {growth:+.4g} 1/s (index {switching['worst_index']})"
    grow = f"{switching['unstable']['exact']} of {switching['humans']} exact{also}{worst}"
    return f"grow while {what} vary", grow if switching["humans"] else None


def _adversary(part: dict[str, Any]) -> str:
    found = f"a human that grows at {part['growth_rate_per_s']:+.4g} 1/s" if part["found"] else "no destabilising human"
    ratio = part["required_over_available_damping"]
    close = "no damping is enough" if ratio is None else f"the loop needs {ratio:.4g} of the damping it has"
    return f"{found} among {part['evaluated']}; {close}"
