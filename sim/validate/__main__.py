"""python -m sim.validate: does the verdict hold for everyone? Random passive humans, both engines, an adversary."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from controller.box import Member
from design.assess import CONDITIONS, assess
from design.box.check import SetCheck, check_set, set_part
from design.margin import Requirement
from design.promises import ANY, certificate_part, promise_of
from design.summary import coupling_part
from sim.adversary import Worst, search
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    numbers,
    out_folder,
    progress_bar,
    require_linear,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES, Chosen, choose
from sim.files import write_json
from sim.human_file import save_humans
from sim.population import MIXED, crowd_of
from sim.scenario import InputError, Scenario
from sim.simulate import assemble
from sim.switching import report as jitter_report
from sim.switching.coverage import certified_part
from sim.switching.options import add_jitter_options, with_jitter
from sim.validate import report as verdict_report
from sim.validate.cluster import validate_on_cluster
from sim.validate.examine import ENGINES, Findings, Question
from sim.validate.shards import validate

ENVIRONMENTS = ("nominal", "box")
LINKS = {"1": 1, "2": 2, "mixed": MIXED}


def main(argv: list[str]) -> int:
    """Meet random humans. 0: the claims hold, 1: not, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = with_jitter(args, scenario_from(args))
    require_linear(scenario, "sim.validate")
    humans, shards = _whole(args, "humans", 1_000_000), _shards(args)
    seed, duration, generations = seed_from(args), _duration(args, scenario), _whole(args, "generations", 10_000)
    links = LINKS[args.links] if args.links else scenario.population.links
    out = out_folder(args, "validate")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    with (bar := progress_bar("searching the box"))[0]:
        whole = check_set(scenario.loop(args.case), chosen.coupling, seed, progress=bar[1])
    environments = _environments(args, whole)
    question = Question(
        scenario, chosen.coupling, seed, humans, links, args.engine, duration, environments=environments
    )
    requirements = assess(scenario.loop(args.case), chosen.coupling, chosen.phi)
    promised = promise_of(requirements, scenario.loop(args.case), bool(whole and whole.proved))
    certified = promised is not None and (not environments or promised == ANY or bool(whole and whole.proved))

    with (bar := progress_bar("validating"))[0]:
        begin = time.perf_counter()
        if args.dask is not None:
            findings = validate_on_cluster(question, args.dask, bar[1])
        else:
            findings = validate(question, shards, bar[1])
        wall = time.perf_counter() - begin
    outcome = _outcome(args, scenario, chosen, requirements, question, findings, certified, wall)
    outcome |= {"promise": promised, "set": whole and set_part(whole), "remarks": list(chosen.notes)}
    if scenario.jitter:
        outcome["switching"] = _switching(scenario, chosen, findings, certified)
        outcome["holds"] = outcome["holds"] and outcome["switching"]["holds"]
    attacked, ratio = scenario, requirements["closed-loop"].ratio
    if environments and whole:
        member, requirement = whole.worst_found
        attacked, ratio = scenario.replace(environment=member.network, box=None), requirement.ratio
    worst = (
        _attack(attacked, chosen, seed, generations, outcome) if args.adversary and not findings.interrupted else None
    )
    if worst:
        outcome["adversary"] = verdict_report.adversary_part(worst, ratio, certified)
        outcome["holds"] = outcome["holds"] and outcome["adversary"]["holds"]
    outcome["files"] = [str(path) for path in _save(args, out, question, findings, worst, outcome)]
    verdict_report.print_verdicts(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    if outcome["interrupted"]:
        return INTERRUPTED
    return DONE if outcome["holds"] else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser(
        "sim.validate",
        "Test a loop with random passive humans in both engines, and search for the worst one.",
        "python -m sim.validate --case I --humans 200 --adversary",
    )
    add_loop_options(parser)
    add_jitter_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--humans", default="1000", metavar="N", help="random humans per device (default 1000)")
    parser.add_argument("--links", choices=tuple(LINKS), help="of each human (default: the scenario's population)")
    parser.add_argument("--engine", choices=ENGINES, default="both", help="default both")
    parser.add_argument("--duration", metavar="SECONDS", help="of the traces (default 2; 0 for none)")
    parser.add_argument(
        "--shards", default="1", metavar="K", help="local processes (default 1); the result is the same"
    )
    parser.add_argument("--dask", metavar="HOST:PORT", help="work on an existing Dask cluster; the result is the same")
    parser.add_argument("--adversary", action="store_true", help="also search for the worst passive human")
    parser.add_argument("--generations", default="150", metavar="N", help="of the adversary's search (default 150)")
    spread = (
        "what the humans meet: the nominal environment, or in turn all vertices of the box and as many others of it"
    )
    parser.add_argument("--environments", choices=ENVIRONMENTS, default="nominal", help=f"{spread} (default nominal)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _whole(args: argparse.Namespace, name: str, most: int) -> int:
    (value,) = numbers(f"--{name}", getattr(args, name), int, 1)
    if not 1 <= value <= most:
        raise InputError(f"--{name} is {value}, allowed are 1 to {most}")
    return value


def _shards(args: argparse.Namespace) -> int:
    shards = _whole(args, "shards", 256)
    if args.dask is not None and shards > 1:
        raise InputError(f"--shards {shards} with --dask: the cluster decides who does what, give one of them")
    return shards


def _environments(args: argparse.Namespace, whole: SetCheck | None) -> tuple[Member, ...]:
    """Members of the set and as many others of it, the worst that was found first; none where all meet the nominal one.

    Raises InputError.
    """
    if args.environments == "nominal":
        return ()
    if whole is None:
        raise InputError("--environments box: the scenario has no box (docs/scenario.md says how to give one)")
    others = (whole.searched.worst[0].member, *whole.samples)
    return (*whole.members, *others[: len(whole.members)])


def _duration(args: argparse.Namespace, scenario: Scenario) -> float:
    (duration,) = numbers("--duration", args.duration or "2", float, 1)
    if not (duration == 0 or 4 * scenario.T <= duration <= 1e5):
        raise InputError(f"--duration is {duration:g}, allowed are 0 and {4 * scenario.T:g} to 100000 s")
    return duration


def _attack(scenario: Scenario, chosen: Chosen, seed: int, generations: int, outcome: dict[str, Any]) -> Worst | None:
    """The worst human, or None where the keyboard ends the search: what was found out before is kept."""
    try:
        with (bar := progress_bar("searching the worst human"))[0]:
            return search(scenario, assemble(scenario, chosen.coupling).F, seed, generations, progress=bar[1])
    except KeyboardInterrupt:
        outcome["interrupted"] = True
        return None


def _switching(scenario: Scenario, chosen: Chosen, findings: Findings, certified: bool) -> dict[str, Any]:
    """What delays that vary did to these humans, and whether that contradicts what is certified of them."""
    assert scenario.jitter is not None
    covered = certified_part(scenario, chosen, certified)
    return verdict_report.switching_part(findings, jitter_report.range_part(scenario.jitter) | covered)


def _outcome(
    args: argparse.Namespace,
    scenario: Scenario,
    chosen: Chosen,
    requirements: dict[str, Requirement],
    question: Question,
    findings: Findings,
    certified: bool,
    wall: float,
) -> dict[str, Any]:
    head = {
        "case": args.case,
        "scenario": scenario.name,
        "scenario_digest": scenario.digest,
        "coupling": coupling_part(chosen.kind, chosen.coupling, scenario.T),
        "certificates": {name: certificate_part(requirement) for name, requirement in requirements.items()},
    }
    return head | verdict_report.outcome(question, findings, certified, wall)


def _save(
    args: argparse.Namespace,
    out: Path,
    question: Question,
    findings: Findings,
    adversary: Worst | None,
    outcome: dict[str, Any],
) -> list[Path]:
    """Humans that can be replayed with `sim.run --human`, the picture, the report."""
    scenario, files = question.scenario, []
    named = {f"disagreement-{i}.toml": int(i) for i in findings.index[findings.disagreements]}
    if findings.index.size:
        named |= {"worst-human.toml": int(findings.index[np.argmax(findings.radius)])}
    for name, i in named.items():
        crowd = crowd_of(scenario, question.seed, i, question.links)
        remark = f"seed {question.seed}, index {i}"
        files.append(save_humans(out / name, crowd.humans(0), remark, crowd.persons(0)))
    if adversary:
        remark = f"found by the adversary, seed {question.seed}: growth {adversary.growth:+.6g} 1/s"
        files.append(save_humans(out / "adversary.toml", adversary.humans, remark, adversary.persons))
    if not args.no_plot and findings.index.size:
        from sim.plot import plot_population

        kind = "no coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
        title = f"{scenario.name}, case {args.case}, {kind}: {outcome['humans']} random humans"
        files.append(plot_population(findings.mass, findings.damping, findings.exact, out / "population.png", title))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(path) for path in files]})
    return files


if __name__ == "__main__":
    execute(main)
