"""python -m sim.validate: does the verdict hold for everyone? Random passive humans, both engines, an adversary."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from cli import run as jitter_report
from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_jitter_options,
    add_loop_options,
    add_output_options,
    console,
    numbers,
    out_folder,
    progress_bar,
    require_linear,
    scenario_from,
    seed_from,
    with_jitter,
)
from cli.run import coupling_part, varying
from controller.environment import Member
from controller.lti import Array
from design.certificate import ANY, CONDITIONS, assess, certificate_part, finite, promise_of
from design.conditions import Requirement
from design.ranges import SetCheck, check_set, set_part
from models.human import Human, Person
from sim.adversary import Worst, search
from sim.couplings import NAMES, Chosen, choose
from sim.crowds import ENGINES, MIXED, Findings, Question, crowd_of, validate, validate_on_cluster
from sim.files import write_json
from sim.run import assemble
from sim.scenario import InputError, Scenario, save_humans
from sim.stability import unstable
from sim.switching import certified_part

# ----------------------------------------------------------------------------------------------------
# What a validation found: one dictionary for machines, and the same as a table for people.


SETTLING = 4  # decay times of the slowest mode in a trace whose hands must be slower in its last quarter than before
ROUNDING = 1e-9  # W(N) may be this far below zero, beside the magnitudes that it adds up


def outcome(question: Question, findings: Findings, certified: bool, wall: float) -> dict[str, Any]:
    """The contract of `sim.validate --json`."""
    bad, mujoco = unstable(findings.exact), question.engine != "exact"
    disagreements = int(findings.disagreements.sum())
    wrong = int((bad | (mujoco & unstable(findings.mujoco) & (findings.mujoco > 1e-3))).sum())
    part: dict[str, Any] = {
        "humans": int(findings.index.size),
        "links": "mixed" if question.links == MIXED else question.links,
        "seed": question.seed,
        "engine": question.engine,
        "unstable": {
            "exact": int(bad.sum()),
            "mujoco": int(unstable(findings.mujoco).sum()) if mujoco else None,
        },
        "disagreements": disagreements,
        "disagreeing": [_identified(question, int(i)) for i in findings.index[findings.disagreements]],
        "worst": _worst(question, findings),
        "largest_difference_per_s": _largest(np.abs(findings.mujoco - findings.exact)),
        "traces": _traces(question, findings),
        "environments": _environments(question, findings, bad),
        "certified": certified,
        "holds": disagreements == 0 and not (certified and wrong),
        "interrupted": findings.interrupted,
        "wall_s": wall,
        "simulated_s_per_s": findings.simulated / wall,
    }
    if certified and question.ticks:
        part["energy_audit"] = _energy(findings)
        part["holds"] = part["holds"] and part["energy_audit"]["holds"]
    if not findings.index.size:
        part |= {"holds": None, "reason": "interrupted before the first batch of humans was done"}
    return part


def switching_part(findings: Findings, covered: dict[str, Any]) -> dict[str, Any]:
    """How many humans grow under delays that vary; it holds unless certificates cover these delays and one grows."""
    exact, mujoco = findings.switching, findings.switching_mujoco
    seen = ~np.isnan(exact)
    unstable, also = int((exact > 0).sum()), mujoco[~np.isnan(mujoco)]
    worst = int(np.nanargmax(exact)) if seen.any() else None
    return covered | {
        "unstable": {"exact": unstable, "mujoco": int((also > 0).sum()) if also.size else None},
        "humans": int(seen.sum()),
        "mujoco_unclipped": int(also.size),
        "largest_growth_per_s": None if worst is None else finite(float(exact[worst])),
        "worst_index": None if worst is None else int(findings.index[worst]),
        "holds": not (covered["covered"] and unstable),
    }


def adversary_part(worst: Worst, ratio: float, certified: bool) -> dict[str, Any]:
    """What the search found, and how far the loop is from its required damping."""
    return {
        "found": worst.destabilises,
        "spectral_radius": worst.spectral_radius,
        "growth_rate_per_s": finite(worst.growth),
        "frequency_hz": worst.frequency_hz,
        "evaluated": worst.evaluated,
        "required_over_available_damping": finite(ratio),
        "human": human_part(worst.humans),
        "person": person_part(worst.persons),
        "holds": not (certified and worst.destabilises),
    }


def human_part(humans: tuple[Human, ...]) -> list[dict[str, Any]]:
    """Links of each channel's human."""
    names = ("mass", "damping", "stiffness")
    return [{"links": [{name: getattr(link, name) for name in names} for link in human.links]} for human in humans]


def person_part(persons: tuple[Person, ...]) -> list[dict[str, Any]]:
    """Those who hold several devices."""
    return [msgspec.to_builtins(person) for person in persons]


def _identified(question: Question, index: int) -> dict[str, Any]:
    crowd = crowd_of(question.scenario, question.seed, index, question.links)
    who = {"human": human_part(crowd.humans(0)), "person": person_part(crowd.persons(0))}
    member = question.environment(index)
    where = {"environment": member.name, "network": msgspec.to_builtins(member.network)} if member else {}
    return {"seed": question.seed, "index": index} | who | where


def _environments(question: Question, findings: Findings, bad: NDArray[np.bool_]) -> dict[str, Any]:
    """Which environments the loops had, and in which of them a loop was unstable."""
    if not question.environments:
        return {"of": "the nominal environment", "count": 1}
    unstable_in = sorted({int(i) % len(question.environments) for i in findings.index[bad]})
    return {
        "of": "the box",
        "count": len(question.environments),
        "names": [member.name for member in question.environments],
        "unstable_in": [question.environments[i].name for i in unstable_in],
    }


def _worst(question: Question, findings: Findings) -> dict[str, Any] | None:
    if not findings.index.size:
        return None
    k = int(np.argmax(findings.radius))
    figures = {
        "spectral_radius": float(findings.radius[k]),
        "growth_rate_per_s": finite(float(findings.exact[k])),
        "frequency_hz": float(findings.frequency[k]),
    }
    return figures | _identified(question, int(findings.index[k]))


def _traces(question: Question, findings: Findings) -> dict[str, Any] | None:
    if not question.ticks or not findings.index.size:
        return None
    measured, stable = np.isfinite(findings.trace), ~unstable(findings.exact)
    duration = question.ticks * question.scenario.T
    decay = _largest(-1 / findings.exact[findings.exact < 0])
    decides = decay is None or duration >= SETTLING * decay
    part = {
        "duration_s": duration,
        "clipped_runs": int((findings.clipped > 0).sum()),
        "measured": int(measured.sum()),
        "largest_difference_per_s": _largest(np.abs(findings.trace - findings.exact)),
        "stable_and_settling": int((stable & (findings.settling < 1)).sum()),
        "stable": int(stable.sum()),
        "slowest_settling": _largest(findings.settling[stable]),
        "slowest_decay_s": decay,
        "settling_decides": decides,
    }
    if not decides:
        part["reason"] = f"the slowest mode decays in {decay:.3g} s: in {duration:g} s its hands need not be slower"
    return part


def _energy(findings: Findings) -> dict[str, Any]:
    unclipped = findings.clipped == 0
    violated = unclipped & ~(findings.energy >= -ROUNDING * findings.audited)
    return {
        "audited": int(unclipped.sum()),
        "clipped": int((~unclipped).sum()),
        "violated": int(violated.sum()),
        "least_J": float(findings.energy[unclipped].min()) if unclipped.any() else None,
        "holds": not violated.any(),
    }


def _largest(values: Array) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.max()) if values.size else None


def print_verdicts(report: dict[str, Any], console: Console) -> None:
    """The outcome as a table."""
    table = Table(title=f"case {report['case']} · {report['scenario']} · coupling {report['coupling']['kind']}")
    table.add_column("")
    table.add_column("")
    for name, value in _rows(report):
        table.add_row(name, value)
    console.print(table)
    if switching := report.get("switching"):
        console.print(f"[dim]·[/] Delays that vary: {switching['covers']}.")
    for remark in report["remarks"]:
        console.print(f"[dim]·[/] {remark}")


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    bad, worst, traces = report["unstable"], report["worst"], report["traces"]
    engines = f"{bad['exact']} exact" + (f", {bad['mujoco']} MuJoCo" if bad["mujoco"] is not None else "")
    rows = [
        ("humans", f"{report['humans']} (links {report['links']}, seed {report['seed']})"),
        ("environments", _met(report["environments"])),
        ("unstable", engines),
        ("disagreements", str(report["disagreements"])),
    ]
    if worst:
        rows.append(
            (
                "worst human",
                f"{worst['growth_rate_per_s']:+.4g} 1/s at {worst['frequency_hz']:.2f} Hz (index {worst['index']})"
                + (f", at {worst['environment']}" if "environment" in worst else ""),
            )
        )
    if report["largest_difference_per_s"] is not None:
        rows.append(("MuJoCo's growth rates", f"within {report['largest_difference_per_s']:.1e} 1/s of the exact ones"))
    if traces:
        rows.append(("traces", f"{traces['duration_s']:g} s each, {traces['clipped_runs']} clipped"))
        settled = f"{traces['stable_and_settling']} of {traces['stable']} stable loops slower at the end"
        if not traces["settling_decides"]:
            settled += f"; no verdict: {traces['reason']}"
        rows.append(("handles come to rest", settled))
    if audit := report.get("energy_audit"):
        rows.append(
            (
                "energy audit W >= 0",
                f"{audit['audited'] - audit['violated']} of {audit['audited']}, {audit['clipped']} clipped left out",
            )
        )
    if switching := report.get("switching"):
        rows += _switching_rows(switching)
    if adversary := report.get("adversary"):
        found = (
            f"a human that grows at {adversary['growth_rate_per_s']:+.4g} 1/s"
            if adversary["found"]
            else "no destabilising human"
        )
        ratio = adversary["required_over_available_damping"]
        close = "no damping is enough" if ratio is None else f"the loop needs {ratio:.4g} of the damping it has"
        rows.append(("adversary", f"{found} among {adversary['evaluated']}; {close}"))
    rows.append(("certified", "yes" if report["certified"] else "no"))
    verdict = {True: "[green]yes[/]", False: "[red]no[/]"}.get(report["holds"])
    rows.append(("holds", verdict or str(report["reason"])))
    if report["interrupted"]:
        kept = f"{report['humans']} humans that were finished are kept; running batches and searches are not"
        rows.append(("interrupted", kept))
    rows.append(("time", f"{report['wall_s']:.1f} s, {report['simulated_s_per_s']:.0f} simulated seconds per second"))
    return rows


def _switching_rows(switching: dict[str, Any]) -> list[tuple[str, str]]:
    rows = varying(switching)
    if switching["humans"]:
        mujoco = switching["unstable"]["mujoco"]
        also = "" if mujoco is None else f", MuJoCo {mujoco} of {switching['mujoco_unclipped']} unclipped"
        growth = switching["largest_growth_per_s"]
        worst = "" if growth is None else f"; worst {growth:+.4g} 1/s (index {switching['worst_index']})"
        grow = f"{switching['unstable']['exact']} of {switching['humans']} exact{also}{worst}"
        rows.append(("grow while delays vary", grow))
    return rows


def _met(environments: dict[str, Any]) -> str:
    if "names" not in environments:
        return environments["of"]
    found = "; ".join(environments["unstable_in"]) or "none"
    return f"{environments['count']} of {environments['of']}, in turn; unstable in: {found}"


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
    environments = _environments_validate(args, whole)
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
        outcome["adversary"] = adversary_part(worst, ratio, certified)
        outcome["holds"] = outcome["holds"] and outcome["adversary"]["holds"]
    outcome["files"] = [str(path) for path in _save(args, out, question, findings, worst, outcome)]
    print_verdicts(outcome, console(args))
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


def _environments_validate(args: argparse.Namespace, whole: SetCheck | None) -> tuple[Member, ...]:
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
    return switching_part(findings, jitter_report.range_part(scenario.jitter) | covered)


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
    return head | outcome(question, findings, certified, wall)


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
        from sim.plots import plot_population

        kind = "no coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
        title = f"{scenario.name}, case {args.case}, {kind}: {outcome['humans']} random humans"
        files.append(plot_population(findings.mass, findings.damping, findings.exact, out / "population.png", title))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(path) for path in files]})
    return files
