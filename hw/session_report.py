"""What a session came to: one dictionary for machines, tables for people, and the files of sim.run."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from design.certificate import CAVEATS
from hw.frame import Config
from hw.message import NO_MARGIN
from hw.plan import Ages, Program, Rung
from hw.safety import Stage
from hw.session import Session
from hw.trace import Recorder, result_of, save_npz, steady_ticks
from sim.files import write_json
from sim.trace import growths, told

PERCENTILES = (50, 90, 99, 100)


def outcome(case: str, session: Session, recorder: Recorder, dropped: int, pace: float = 1.0) -> dict[str, Any]:
    """Stage, cause and log; the coupling with its certificates; what the link did, as a report without a verdict."""
    begin = session.log[0].t_us if session.log else 0
    log = [{"t_s": 1e-6 * (e.t_us - begin), "stage": str(e.stage), "cause": e.cause} for e in session.log]
    parts = session.rung.part() if isinstance(session.rung, Rung) else {}
    empty = {"coupling": None, "certificate": None, "certificates": None, "promise": None, "theta": None}
    loop = isinstance(session.rung, Rung) and len(recorder) > 0
    report = {
        "case": case,
        "scenario": session.scenario.name,
        **(empty | parts),
        "session": {"stage": str(session.stage), "cause": session.cause, "armed": len(recorder) > 0, "log": log},
        "link": _link(session, recorder, dropped),
        "run": {
            "samples": len(recorder),
            "duration_s": len(recorder) * session.scenario.T,
            "T_s": session.scenario.T,
            "scenario_digest": session.scenario.digest,
            "pace": pace,  # below 1: slow motion, in which a link looks faster than it is
            "encoder_step_m": list(session.units.encoder_step) if len(recorder) else None,
            "steady_ticks": steady_ticks(recorder, session.units.force_step) if loop else [],
        },
    }
    trace = result_of(recorder, session.units, session.scenario.T, report) if loop else None
    return report | {"growth": [one.part() for one in growths(trace)] if trace else []}


def _link(session: Session, recorder: Recorder, dropped: int) -> dict[str, Any]:
    measured = session.measurement
    counters = asdict(session.counters) | {"host_errors": session.decoder.rejected, "host_dropped_bytes": dropped}
    part: dict[str, Any] = {
        "measured_age_us": _percentiles(np.array(measured.ages)),
        "measured_missing": measured.missing,
        "age_us": None,
        "rate_hz": None,
        "missed_percent": None,
        "counters": counters,
    }
    if len(recorder) and session.config:
        arrays = recorder.link()
        margins = arrays["margin_us"][arrays["received"] & (arrays["margin_us"] != NO_MARGIN)]
        part["age_us"] = _percentiles(session.config.theta * 1e6 * session.scenario.T - margins)
        part["rate_hz"] = float(arrays["received"].mean() / session.scenario.T)
        answered = arrays["received"].sum()
        part["missed_percent"] = 100 * session.stream.missed_while_driving / answered if answered else None
    return part


def _percentiles(values: np.ndarray) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in PERCENTILES} if values.size else None


def print_certificate(ages: Ages, link: int, rungs: Sequence[Rung], console: Console) -> None:
    """What was measured, and what is certified for it: printed before anything is armed."""
    at = {p: int(np.percentile(ages.values, p)) for p in (50, 99)}
    console.print(
        f"answers are {at[50]} us old, {at[99]} us at the 99th percentile, {ages.missing} of "
        f"{len(ages.values) + ages.missing} never arrived: a link of {link} tick{'s' if link > 1 else ''}"
    )
    table = Table(title="certified for the delay measured, and softer in reserve")
    table.add_column("coupling", min_width=13)
    for column in ("K [N/m]", "B [N s/m]", "needs", "of [N s/m]", "promise"):
        table.add_column(column)
    for rung in rungs:
        part = rung.part()
        certificate = next(c for c in (part["certificate"], *part["certificates"].values()) if c["certified"])
        coupling = part["coupling"]
        table.add_row(
            f"{coupling['kind']}, theta = {', '.join(map(str, part['theta']))}",
            *(_list(coupling[name]) for name in "KB"),
            f"{_list(certificate['required_damping'])} ({certificate['condition']}, {certificate['proof']})",
            _list(certificate["available_damping"]),
            part["promise"],
        )
    console.print(table)
    for rung in rungs:
        for remark in rung.remarks():
            console.print(f"[dim]·[/] theta = {list(rung.scenario.theta)}: {remark}", highlight=False)
    if len(rungs) == 1:
        console.print("no reserve: nothing softer is certified, so late answers end the session")


def print_session(report: dict[str, Any], console: Console) -> None:
    """The log, then what the link did."""
    table = Table(title=f"case {report['case']} · {report['scenario']}")
    for column in ("after", "stage", "cause"):
        table.add_column(column, justify="right" if column == "after" else "left")
    for event in report["session"]["log"]:
        table.add_row(f"{event['t_s']:.3f} s", _colour(event["stage"]), event["cause"])
    console.print(table)
    link = report["link"]
    if link["age_us"]:
        ages = ", ".join(f"{name} {us / 1000:.2f} ms" for name, us in link["age_us"].items())
        console.print(
            f"link: {link['rate_hz']:.0f} answers a second, {link['missed_percent']:.2f} % missed; age {ages}"
        )
    for i, part in enumerate(report["growth"], start=1):
        console.print(f"growth at full gain, arming {i}, {told(part, report['run']['T_s'])}")
    counted = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in link["counters"].items() if n)
    console.print(f"counted: {counted or 'nothing'}")
    console.print(f"[dim]·[/] {CAVEATS}")


def save(out: Path, session: Session, recorder: Recorder, report: dict[str, Any], plot: bool) -> list[Path]:
    """The trace (where forces acted), its picture, and the report."""
    files = []
    if len(recorder):
        replay = [_recipe(session, program, config) for program, config in session.armings]
        result = result_of(recorder, session.units, session.scenario.T, report | {"replay": replay})
        files += [save_npz(out / "trace.npz", result, recorder), result.save_csv(out / "trace.csv")]
        if plot:
            from sim.plots import plot_run

            title = f"{report['scenario']}, case {report['case']}: a session that ended {session.stage}"
            files.append(plot_run(result, out / "figure.png", title, 10.0))
    files.append(out / "report.json")
    write_json(files[-1], report | {"files": [str(p) for p in files]})
    return files


def _recipe(session: Session, program: Program, config: Config) -> dict[str, Any]:
    """All that hw.replay needs of one arming."""
    assert isinstance(program, Rung)
    return {
        "scenario": json.loads(msgspec.json.encode(program.scenario)),
        "coupling": json.loads(msgspec.json.encode(program.chosen.coupling.form())),
        "link_delay": program.link,
        "limits": asdict(session.limits),
        "force_step": list(session.units.force_step),
        "cap": list(config.cap),
    }


def _list(values: Sequence[float | None] | None) -> str:
    return "-" if values is None else ", ".join("inf" if v is None else f"{v:.5g}" for v in values)


def _colour(stage: str) -> str:
    colours = {Stage.FINISHED: "green", Stage.REFUSED: "yellow", Stage.STOPPED: "red", Stage.LOST: "red"}
    colour = (colours | {Stage.ESTOP: "red"}).get(Stage(stage))
    return f"[{colour}]{stage}[/]" if colour else stage
