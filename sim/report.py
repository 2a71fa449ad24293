"""What a run was worth: one dictionary for machines, and the same as tables for people."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from controller.lti import Array
from design.box.check import set_rows
from design.listed import listed
from design.promises import ANY, CAVEATS, finite
from sim.loop import Record
from sim.one_period import frozen_modes, worst_mode
from sim.simulate import Assembly
from sim.stability import Mode, clipped_ticks, close, dominant_mode, measured_growth, verdict


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
