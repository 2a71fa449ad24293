"""python -m sim.run: close the loop once and say what happened, with figures and a picture.

scenario -> environment -> coupling -> certificates -> loop -> result -> report
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from cli.options import (
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
    scenario_from,
    seed_from,
    with_jitter,
)
from controller.coupling import Compliance, Coupling, InternalModel, SpringDamper
from controller.delay import LOST, Jitter, Ticks, ages
from controller.lti import Array
from design.certificate import ANY, CAVEATS, CONDITIONS, assess, certificate_part, finite, promise_of
from design.ranges import SetCheck, check_set, set_part, set_rows
from design.result import PRINTED_TAU_DB, PUBLISHED, listed
from design.transparency import Transparency, decibels, transparency
from sim.couplings import NAMES, Chosen, choose
from sim.engines import INTEGRATORS, LEAPFROG, ExactBatchEngine, HeldPlant
from sim.files import write, write_json
from sim.run import ENGINES, Assembly, Record, assemble, simulate
from sim.scenario import InputError, Scenario, load, load_humans
from sim.stability import (
    LEAST,
    MOST,
    Mode,
    before_clipping,
    check_substeps,
    clipped_ticks,
    close,
    default_substeps,
    dominant_mode,
    frozen_modes,
    measured_growth,
    verdict,
    worst_mode,
)
from sim.switching import Period, certified_part, knocked, switching, unlimited
from sim.trace import Likeness, Result, likeness

# ----------------------------------------------------------------------------------------------------
# Couplings and transparency as plain data: what the commands print and write as JSON.


def coupling_part(kind: str, coupling: Coupling, T: float) -> dict[str, Any]:
    """Kind, gains (None where it has none) and order of V, or of Q."""
    part: dict[str, Any] = {"kind": kind, "K": None, "B": None, "order": 0}
    match coupling:
        case SpringDamper(K=K, B=B):
            part |= {"K": K.tolist(), "B": B.tolist(), "order": coupling.compliance(T).order}
        case Compliance(V=V):
            part["order"] = V.order
        case InternalModel():
            part["order"] = coupling.parameter(T).order
    return part


def transparency_part(figures: Transparency) -> dict[str, Any]:
    """The figures of the mismatch, in decibels, with a reason where one is infinite."""
    part: dict[str, Any] = {
        "tau_db": finite(decibels(figures.tau)),
        "relative_mismatch_db": finite(decibels(figures.relative_mismatch)),
        "rms_mismatch_db": finite(decibels(figures.rms_mismatch)),
        "dc_ratio": finite(figures.dc_ratio),
        "high_frequency_gain": finite(figures.high_frequency_gain),
        "band_hz": list(figures.band_hz),
    }
    if figures.relative_mismatch == 0:
        part["reason"] = "the devices see the reference exactly: the mismatch is zero, minus infinity in dB"
    elif math.isinf(figures.tau):
        part["reason"] = "tau (25) divides by inf sigma_min(E), which is 0: some motion costs no static force"
    return part


# ----------------------------------------------------------------------------------------------------
# What a run was worth: one dictionary for machines, and the same as tables for people.


def stability_part(assembly: Assembly, record: Record) -> dict[str, Any]:
    """Measured on the trace, and from the eigenvalues of the exact loop; of walls, in the worst contact state."""
    mode = worst_mode(assembly)
    limit = assembly.process.force_limit
    contact = contact_part(assembly, record) if assembly.process.contact else {}
    if contact.get("ticks"):
        growth, reason = None, f"contact was made {contact['made']} times, and a growth rate is of one linear loop"
    elif assembly.friction:
        growth, reason = None, "with Coulomb friction there is no growth rate; the eigenvalues are those without it"
    else:
        loop = close(assembly.plant, assembly.F)
        growth, reason = measured_growth(loop, dominant_mode(loop), record, limit)
    if record.diverged:
        reason = "the simulation left the range of finite numbers: reported as unstable"
    part: dict[str, Any] = {
        "verdict": "unstable" if record.diverged else None if growth is None else verdict(growth),
        "clipped_ticks": int(clipped_ticks(record, limit).sum()),
        "growth_rate_per_s": growth,
        "frequency_hz": dominant_frequency(record, assembly.scenario.T),
        **eigenvalue_part(mode),
    }
    part |= {"contact": contact} if contact else {}
    return part | ({"reason": reason} if reason else {})


def eigenvalue_part(mode: Mode) -> dict[str, Any]:
    """What the eigenvalues of the exact loop say."""
    return {
        "exact_verdict": mode.verdict,
        "exact_growth_rate_per_s": finite(mode.growth),
        "exact_frequency_hz": mode.frequency_hz,
        "spectral_radius": mode.spectral_radius,
    }


def contact_part(assembly: Assembly, record: Record) -> dict[str, Any]:
    """How often the walls were touched in a run, and the linear loops that they switch between."""
    walls = assembly.process.contact
    assert walls is not None
    touching = walls.depths(record.z[:, :, 0]) > 0
    states = [
        {
            "touching": [i + 1 for i, on in enumerate(state) if on],
            "exact_growth_rate_per_s": finite(mode.growth),
            "exact_frequency_hz": mode.frequency_hz,
            "exact_verdict": mode.verdict,
        }
        for state, mode in frozen_modes(assembly).items()
    ]
    return {
        "made": int((touching[1:] & ~touching[:-1]).sum() + touching[:1].sum()),
        "ticks": int(touching.any(axis=1).sum()),
        "frozen": states,
    }


def error_part(
    record: Record, exact: Record | None, assembly: Assembly, unstable: bool | None = None
) -> dict[str, Any]:
    """Device positions against the exact engine's closed loop, where there is one.

    `unstable` where its eigenvalues do not say it.
    """
    if exact is None:
        reason = "the exact engine is linear and has no Coulomb friction to compare with"
        return {"position_relative_rms": None, "position_max_m": None, "reason": reason}
    limit, m = assembly.process.force_limit, assembly.process.channels
    n = min(record.s.shape[0], exact.s.shape[0])
    clipped = clipped_ticks(exact, limit)[:n] | clipped_ticks(record, limit)[:n]
    if unstable is None:
        unstable = worst_mode(assembly).verdict == "unstable"
    linear = int(np.argmax(clipped)) if unstable and clipped.any() else n
    relative, largest = _distance(record.s[:linear, :m], exact.s[:linear, :m])
    if linear == n:
        return {"position_relative_rms": relative, "position_max_m": largest}
    until = f"the unstable run first clips at t = {linear * assembly.scenario.T:.3f} s"
    reason = f"{until}; up to there the relative rms is {relative:.1e}, and its growth multiplies any difference"
    return {"position_relative_rms": None, "position_max_m": None, "reason": reason}


def remarks(outcome: dict[str, Any]) -> list[str]:
    """What a reader must know to read the figures rightly."""
    lines = []
    for part in (outcome["certificates"]["theorem4"], outcome["certificates"]["closed-loop"]):
        if part["certified"] or "reason" in part:
            continue
        worst = max(n / a for n, a in zip(part["required_damping"], part["available_damping"], strict=True))
        name = (
            "the paper's own condition (Theorem 4)" if part["condition"] == "theorem4" else "the closed-loop condition"
        )
        lines.append(f"These gains fail {name}: they need {worst:.3g} times the damping that the devices guarantee.")
    if "contact" in outcome["stability"]:
        covered = "theorem4 covers" if outcome["promise"] == ANY else "no certificate covers"
        lines.append(f"Contact that makes and breaks: {covered} it in this loop; closed-loop is about frozen states.")
    for name in ("stability", "error", "transparency"):
        if "reason" in outcome[name]:
            lines.append(f"{name}: {outcome[name]['reason']}.")
    for part in outcome["certificates"].values():
        if "reason" in part:
            lines.append(f"{part['condition']}: {part['reason']}.")
    if outcome.get("jitter"):
        lines.append(f"Delays that vary: {outcome['jitter']['covers']}.")
    return [*lines, CAVEATS]


def _distance(a: Array, b: Array) -> tuple[float | None, float | None]:
    size = float(np.sqrt(np.mean(b**2))) if b.size else 0.0
    if size == 0:
        return None, None
    return float(np.sqrt(np.mean((a - b) ** 2))) / size, float(np.abs(a - b).max())


def dominant_frequency(record: Record, T: float) -> float | None:
    """The strongest line above 10 Hz in the last quarter of the forces: what one hears and feels."""
    tail = record.f[-(record.f.shape[0] // 4) :, :, 0]
    if tail.shape[0] < 64:
        return None
    window = np.hanning(tail.shape[0])[:, None]
    spectrum = np.abs(np.fft.rfft((tail - tail.mean(axis=0)) * window, axis=0)).sum(axis=1)
    frequency = np.fft.rfftfreq(tail.shape[0], T)
    spectrum[frequency < 10.0] = 0.0
    return float(frequency[np.argmax(spectrum)]) if spectrum.any() else None


def print_report(report: dict[str, Any], console: Console) -> None:
    """The report as tables."""
    table = Table(title=f"case {report['case']} · {report['scenario']} · coupling {report['coupling']['kind']}")
    table.add_column("")
    table.add_column("")
    for name, value in _rows(report):
        table.add_row(name, value)
    console.print(table)
    if report["reproducibility"]:
        console.print(_beside_the_paper(report["reproducibility"]))
    for remark in report["remarks"]:
        console.print(f"[dim]·[/] {remark}")
    console.print("files: " + ", ".join(report["files"]), soft_wrap=True)


def _beside_the_paper(rows: list[dict[str, str]]) -> Table:
    table = Table(title="beside the paper")
    for column in ("what", "paper", "here", "why"):
        table.add_column("" if column == "what" else column)
    for row in rows:
        table.add_row(*(row[column] for column in ("what", "paper", "here", "why")))
    return table


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    coupling, stability, transparent = report["coupling"], report["stability"], report["transparency"]
    rows = []
    if coupling["K"]:
        rows.append(("coupling K / B", f"{listed(coupling['K'], 5)} N/m / {listed(coupling['B'], 5)} N s/m"))
    for part in report["certificates"].values():
        proof = ", proved exactly" if part["proof"] == "rational" else ""
        word = f"[green]certified[/]{proof}" if part["certified"] else "[red]not certified[/]"
        need = listed(part["required_damping"], 5)
        rows.append(
            (f"damping, {part['condition']}", f"needs {need} of {listed(part['available_damping'], 5)} N s/m: {word}")
        )
    rows += set_rows(report["set"]) if report["set"] else []
    rows.append(("promise", f"holds for {report['promise']}" if report["promise"] else "none"))
    rows.append(
        ("relative mismatch", f"{_db(transparent['relative_mismatch_db'])} (rms {_db(transparent['rms_mismatch_db'])})")
    )
    rows.append(("force error", _force_error(report["ideal_force"])))
    rows.append(("static stiffness felt", f"{100 * transparent['dc_ratio']:.1f} %" if transparent["dc_ratio"] else "-"))
    rows.append(("growth, eigenvalues", _growth(stability)))
    growth = stability["growth_rate_per_s"]
    measured = "-" if growth is None else f"{growth:+.4f} 1/s"
    how = "growth, switching" if (report.get("jitter") or {}).get("verdict") else "growth, simulated trace"
    rows.append((how, f"{measured}: {_verdict(stability['verdict'])}"))
    if jitter := report.get("jitter"):
        rows += varying(jitter)
    run = report["run"]
    if "contact" in stability:
        contact = stability["contact"]
        rows.append(("contact", f"made {contact['made']} times, lasting {contact['ticks']} of {run['samples']} ticks"))
        rows += [(f"growth, {_walls(state['touching'])}", _growth(state)) for state in contact["frozen"]]
    if report["set"]:
        rows.append(("simulated in", run["environment"]))
    rows.append(("clipped ticks", f"{stability['clipped_ticks']} of {run['samples']}"))
    engine = run["engine"] + (f" {run['integrator']} x {run['substeps']}" if run["integrator"] else "")
    rows.append(
        (
            "speed",
            f"{run['wall_s']:.2f} s for {run['duration_s']:g} s: {run['real_time_factor']:.2g} x real time ({engine})",
        )
    )
    rms = report["error"]["position_relative_rms"]
    rows.append(
        (
            "position error",
            "-" if rms is None else f"{rms:.1e} relative rms, {report['error']['position_max_m']:.1e} m at most",
        )
    )
    return rows


def _growth(part: dict[str, Any]) -> str:
    exact = f"{part['exact_growth_rate_per_s']:+.4f} 1/s at {part['exact_frequency_hz']:.2f} Hz"
    return f"{exact}: {_verdict(part['exact_verdict'])}"


def _walls(touching: list[int]) -> str:
    if not touching:
        return "no wall touching"
    return f"wall{'s' if len(touching) > 1 else ''} {', '.join(map(str, touching))} touching"


def varying(jitter: dict[str, Any]) -> list[tuple[str, str]]:
    """Rows about delays that vary, of a run or of a validation."""
    spans = ", ".join(f"{lo} to {hi}" for lo, hi in zip(jitter["lo"], jitter["hi"], strict=True))
    how = jitter["pattern"] + (", played out at the largest" if jitter["playout"] else "")
    rows = [("delays", f"{spans} samples, {how}" + (f", {100 * jitter['loss']:g} % lost" if jitter["loss"] else ""))]
    if age := jitter.get("age"):
        met = zip(age["least"], age["largest"], age["mean"], strict=True)
        rows.append(("age of the forces", "; ".join(f"{a} to {b}, mean {c:.2f}" for a, b, c in met) + " samples"))
    if period := jitter.get("period"):
        growth = f"{period['growth_rate_per_s']:+.4f} 1/s"
        rows.append(
            (
                "worst switching found",
                f"{growth} with a period of {period['ticks']} ticks: {_verdict(period['verdict'])}",
            )
        )
    if proof := jitter.get("jitter_proof"):
        exact = ", proved exactly" if proof["proof"] == "rational" else ""
        word = f"[green]certified[/]{exact}" if proof["certified"] else "[red]not certified[/]"
        needs = f"needs {listed(proof['required_damping'], 5)} of {listed(proof['available_damping'], 5)} N s/m: {word}"
        rows.append(("damping, any switching", needs))
    return [*rows, ("these delays covered", "[green]yes[/]" if jitter["covered"] else "[yellow]no[/]")]


def _force_error(part: dict[str, Any]) -> str:
    if part["error_percent"] is None:
        return f"- ({part['reason']})"
    return f"{part['error_percent']:.3g} % rms of Lambda E's, before the force limits"


def _verdict(word: str | None) -> str:
    return {"stable": "[green]stable[/]", "unstable": "[red]unstable[/]"}.get(word or "", "not decided")


def _db(value: float | None) -> str:
    return "zero" if value is None else f"{value:.2f} dB"


# ----------------------------------------------------------------------------------------------------
# What the paper prints beside what comes out here, for its own scenario.


Row = dict[str, str]


def table(scenario: Scenario, case: str, outcome: dict[str, Any]) -> list[Row]:
    """Rows of {what, paper, here, why}; empty where the loop is not the paper's."""
    if scenario.jitter or scenario.loop(case) != load().loop(case):
        return []
    figure = _figure(case, outcome["stability"])
    return [figure] if case == "none" else [*_gains(scenario, case, outcome), _tau(case), figure]


def _gains(scenario: Scenario, case: str, outcome: dict[str, Any]) -> list[Row]:
    printed, got = PUBLISHED[case], outcome["coupling"]
    need = assess(scenario.loop(case), printed)
    theorem4, closed_loop = (need[name].required for name in ("theorem4", "closed-loop"))
    here = "none" if got["K"] is None else f"K = {listed(got['K'], 5)}, B = {listed(got['B'], 5)}"
    return [
        {
            "what": "gains [N/m], [N s/m]",
            "paper": f"K = {listed(printed.K, 5)}, B = {listed(printed.B, 5)}",
            "here": here,
            "why": "the printed gains are no solution of the paper's own problem (next row)",
        },
        {
            "what": "damping that the printed gains need [N s/m]",
            "paper": f"at most {listed(scenario.delta, 5)}",
            "here": f"{listed(theorem4, 5)} by Theorem 4; {listed(closed_loop, 5)} in this environment",
            "why": "Theorem 4 as printed is strictly infeasible (E-hat has a pole at z = 1); mended, it refuses them",
        },
    ]


def _tau(case: str) -> Row:
    return {
        "what": "transparency index tau (25)",
        "paper": f"{PRINTED_TAU_DB[case]} dB",
        "here": "infinite",
        "why": "inf sigma_min(E) = 0: moving both contacts together costs no static force",
    }


def _figure(case: str, stability: dict[str, Any]) -> Row:
    growth = f"{stability['exact_growth_rate_per_s']:+.2f} 1/s at {stability['exact_frequency_hz']:.1f} Hz"
    return {
        "what": "Figure 5: no coupling" if case == "none" else "Figure 6: with a coupling",
        "paper": "self-sustained oscillation" if case == "none" else "no oscillation",
        "here": f"{stability['exact_verdict']}: {growth}",
        "why": "agrees; masses and stiffness of the devices are assumed",
    }


# ----------------------------------------------------------------------------------------------------
# What a run with varying delays says: the delays it met, whether it grew, and what certificates cover.


JUDGED = 4.0  # [s] at most of the linear loop from which a growth is read: later numbers may overflow


def part(
    assembly: Assembly, chosen: Chosen, period: Period | None, ticks: int, certified: bool
) -> dict[str, Any] | None:
    """All that a report says of delays that vary; None where the scenario has no jitter."""
    scenario = assembly.scenario
    if scenario.jitter is None:
        return None
    met = run_part(assembly, period, ticks) if scenario.switches else {}
    return range_part(scenario.jitter) | met | certified_part(scenario, chosen, certified)


def range_part(jitter: Jitter) -> dict[str, Any]:
    """The range of delays and how they vary within it."""
    return {
        "lo": list(jitter.lo),
        "hi": list(jitter.hi),
        "pattern": jitter.pattern,
        "loss": jitter.loss,
        "playout": jitter.playout,
        "constant": jitter.steady,
    }


def run_part(switched: Assembly, period: Period | None, ticks: int) -> dict[str, Any]:
    """The delays that a run met, and the growth of its linear loop under them."""
    delays = switched.process.delays
    assert delays is not None
    met = ages(delays[:ticks])[..., 0]
    used = met[(met >= 0).all(axis=1)]
    growth, window = _growth_report(switched, ticks)
    return {
        "age": _age(used),
        "lost_packets": (delays[:ticks] == LOST).sum(axis=(0, 2)).tolist(),
        "held_ticks": (np.diff(used, axis=0) == 1).sum(axis=0).tolist(),
        "growth_rate_per_s": finite(growth),
        "verdict": "unstable" if growth > 0 else "stable",
        "judged_s": window,
        "period": None
        if period is None
        else {
            "ticks": len(period.ages),
            "growth_rate_per_s": finite(period.growth),
            "spectral_radius": period.spectral_radius,
            "verdict": "unstable" if period.growth > 0 else "stable",
        },
    }


def _age(used: Ticks) -> dict[str, Any] | None:
    """Of the forces in use [samples], per channel, from the first arrival on; None where none arrives."""
    if not used.size:
        return None
    figures = {"least": used.min(axis=0), "largest": used.max(axis=0), "mean": used.mean(axis=0)}
    return {name: values.tolist() for name, values in figures.items()}


def _growth_report(switched: Assembly, ticks: int) -> tuple[float, float]:
    """(rate [1/s], window [s]) of the exact linear loop after a knock, under the run's first delays."""
    T, plant = switched.scenario.T, switched.plant
    judged = max(4, min(ticks, round(JUDGED / T)))
    one = HeldPlant(plant.A[None], plant.B[None], plant.C, T)
    process = unlimited(switched.process)
    engine = ExactBatchEngine(one, process.force_limit)
    return float(knocked(process, engine, switched.scene, plant.A.shape[0], judged, 1).rate[0]), judged * T


def stability_part_report(assembly: Assembly, record: Record, jitter: dict[str, Any]) -> dict[str, Any]:
    """As report.stability_part, for a loop that switches: it has no eigenvalue of its own but over a period."""
    worst = jitter["period"] or jitter
    constant = eigenvalue_part(dominant_mode(close(assembly.plant, assembly.F)))
    verdict = "unstable" if record.diverged or "unstable" in (worst["verdict"], jitter["verdict"]) else "stable"
    return {
        "verdict": verdict,
        "clipped_ticks": int(clipped_ticks(record, assembly.process.force_limit).sum()),
        "growth_rate_per_s": worst["growth_rate_per_s"],
        "frequency_hz": dominant_frequency(record, assembly.scenario.T),
        **constant,
        "reason": _how(jitter)
        + f"; the eigenvalues are those of the constant delay theta = {listed(assembly.scenario.theta)}",
    }


def _how(jitter: dict[str, Any]) -> str:
    if jitter["period"]:
        return f"growth by the eigenvalues of the product over the {jitter['period']['ticks']} ticks of a period"
    return f"growth of the linear loop after a knock, over {jitter['judged_s']:.3g} s under the run's delays"


def main(argv: list[str]) -> int:
    """Simulate and report. 0: the run was completed, stable or not; 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = with_jitter(args, scenario_from(args))
    if args.duration is not None:
        scenario = scenario.replace(duration=numbers("--duration", args.duration, float, 1)[0])
    if args.human is not None:
        people = load_humans(args.human, scenario.channels)
        scenario = scenario.replace(human=people.human, person=people.person)
    asked, seed, out = _substeps(args), seed_from(args), out_folder(args, "run")
    chosen = choose(scenario, args.case, args.coupling, args.condition)
    where, simulated = _environment(args, scenario)
    assembly, period = assemble(simulated, chosen.coupling), None
    if args.engine == "exact" and assembly.friction:
        raise InputError("--engine exact is linear and has no Coulomb friction, the devices have; use --engine mujoco")
    if scenario.switches:
        assembly, period = switching(assembly, chosen.coupling, seed, scenario.samples)
    with (bar := progress_bar("searching the box"))[0]:
        whole = check_set(scenario.loop(args.case), chosen.coupling, seed, progress=bar[1])
    substeps, warnings = _settled(args, assembly, asked)

    with (bar := progress_bar("simulating"))[0]:
        begin = time.perf_counter()
        record = simulate(assembly, args.engine, args.integrator, substeps or LEAST, progress=bar[1])
        wall = time.perf_counter() - begin
    exact = record if args.engine == "exact" else _exact(assembly, record)

    alike = likeness(assembly, record, scenario.loop(args.case).lam)
    outcome = _outcome(args, chosen, assembly, period, record, exact, wall, whole)
    outcome["ideal_force"] = alike.part()
    outcome["run"] |= {"substeps": substeps, "seed": seed, "environment": where}
    outcome["remarks"] = [*warnings, *outcome["remarks"]]
    outcome["files"] = [str(p) for p in _save(args, out, assembly, record, alike, outcome)]
    print_report(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    return INTERRUPTED if record.interrupted else DONE


def _exact(assembly: Assembly, record: Record) -> Record | None:
    """The exact engine's run; None where friction makes the loop another one than the linear."""
    return None if assembly.friction else simulate(assembly, "exact", samples=record.s.shape[0])


def _parser() -> Parser:
    parser = Parser(
        "sim.run", "Close the loop once and report stability, transparency and error.", "python -m sim.run --case none"
    )
    add_loop_options(parser)
    add_jitter_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--engine", choices=ENGINES, default="mujoco", help="MuJoCo, or the exact solution")
    parser.add_argument("--integrator", choices=(*INTEGRATORS, LEAPFROG), default="RK4", help="of MuJoCo (default RK4)")
    parser.add_argument("--substeps", metavar="N", help="MuJoCo steps per period (default 4, more where needed)")
    parser.add_argument("--duration", metavar="SECONDS", help="default: the scenario's")
    parser.add_argument(
        "--human", metavar="FILE", help="other humans: [[human]] per channel in a .toml, or `humans` in a .py"
    )
    parser.add_argument(
        "--vertex", metavar="N", help="simulate at this vertex of the scenario's box (default 0: nominal)"
    )
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _substeps(args: argparse.Namespace) -> int | None:
    """The number that was asked for, or None. Raises InputError."""
    if args.substeps is None:
        return None
    (substeps,) = numbers("--substeps", args.substeps, int, 1)
    if not 1 <= substeps <= MOST:
        raise InputError(f"--substeps is {substeps}, allowed are 1 to {MOST}")
    return substeps


def _environment(args: argparse.Namespace, scenario: Scenario) -> tuple[str, Scenario]:
    """Which environment is simulated, and the scenario with that one, known exactly. Raises InputError."""
    members = scenario.loop(args.case).members()
    (vertex,) = numbers("--vertex", args.vertex or "0", int, 1)
    if not 0 <= vertex < len(members):
        why = f"allowed are 0 to {len(members) - 1}" if scenario.box else "but the scenario has no box"
        raise InputError(f"--vertex is {vertex}, {why}")
    return members[vertex].name, scenario.replace(environment=members[vertex].network, box=None)


def _settled(args: argparse.Namespace, assembly: Assembly, asked: int | None) -> tuple[int | None, list[str]]:
    """Substeps of this run (None for the exact engine), with remarks on a number that was asked for."""
    if args.engine == "exact":
        return None, []
    try:
        if asked is None:
            return default_substeps(assembly, args.integrator), []
        return asked, check_substeps(assembly, args.integrator, asked)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"--integrator {args.integrator}: {error}") from None


def _outcome(
    args: argparse.Namespace,
    chosen: Chosen,
    assembly: Assembly,
    period: Period | None,
    record: Record,
    exact: Record | None,
    wall: float,
    whole: SetCheck | None,
) -> dict[str, Any]:
    scenario, samples = assembly.scenario, record.s.shape[0]
    loop = scenario.loop(args.case)
    requirements = assess(loop, chosen.coupling, chosen.phi)
    certificates = {name: certificate_part(requirement) for name, requirement in requirements.items()}
    simulated = samples * scenario.T
    certified = any(requirement.certified for requirement in requirements.values())
    jitter, stability, unstable = part(assembly, chosen, period, samples, certified), None, None
    if jitter and scenario.switches:
        stability = stability_part_report(assembly, record, jitter)
        unstable = stability["verdict"] == "unstable"
    mujoco = args.engine == "mujoco"
    outcome = {
        "case": args.case,
        "scenario": scenario.name,
        "coupling": coupling_part(chosen.kind, chosen.coupling, scenario.T),
        "certificate": certificates[chosen.condition],
        "certificates": certificates,
        "promise": promise_of(requirements, loop, bool(whole and whole.proved)),
        "set": whole and set_part(whole),
        "transparency": transparency_part(transparency(assembly.felt, assembly.E, loop.lam)),
        "stability": stability or stability_part(assembly, record),
        "jitter": jitter,
        "run": {
            "engine": args.engine,
            "integrator": args.integrator if mujoco else None,
            "duration_s": simulated,
            "samples": samples,
            "wall_s": wall,
            "real_time_factor": simulated / wall,
            "theta": list(scenario.theta),
            "psi": list(scenario.psi),
            "lam": list(loop.lam),
            "T_s": scenario.T,
            "interrupted": record.interrupted,
            "scenario_digest": scenario.digest,
            "encoder_step_m": assembly.process.encoder_step.tolist(),
            "steady_ticks": [[0, before_clipping(record, assembly.process.force_limit)]],
        },
        "error": error_part(record, exact, assembly, unstable),
    }
    outcome["reproducibility"] = table(scenario, args.case, outcome)
    return outcome | {"remarks": [*chosen.notes, *remarks(outcome)]}


def _save(
    args: argparse.Namespace,
    out: Path,
    assembly: Assembly,
    record: Record,
    alike: Likeness,
    outcome: dict[str, Any],
) -> list[Path]:
    result = Result.from_record(assembly, record, outcome)
    files = [
        result.save_npz(out / "trace.npz"),
        result.save_csv(out / "trace.csv"),
        write(out / "scene.xml", assembly.scene.xml),
    ]
    if not args.no_plot and result.t.size:
        from sim.plots import plot_run

        stability = outcome["stability"]
        with_what = "no virtual coupling" if args.case == "none" else f"{outcome['coupling']['kind']} coupling"
        growth = f"growth {stability['exact_growth_rate_per_s']:+.3f} 1/s at {stability['exact_frequency_hz']:.1f} Hz"
        if assembly.scenario.jitter and assembly.scenario.switches:
            growth = f"{outcome['jitter']['pattern']} delays, {stability['verdict']}"
        title = f"{outcome['scenario']}, case {args.case}, {with_what}: {growth}"
        apart = outcome["ideal_force"]["error_percent"]
        ideal = None if apart is None else (alike.ideal, apart)
        files.append(plot_run(result, out / "figure.png", title, stability["exact_frequency_hz"], ideal))
    files.append(out / "report.json")
    write_json(files[-1], outcome | {"files": [str(p) for p in files]})
    return files
