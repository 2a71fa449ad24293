"""The report of a session (its end, its link, the growth of oscillations), and a log that survives a crash."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from haptic_loop.controller.budget import BudgetFigures
from haptic_loop.controller.units import keys_in_unit
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.files import off_table, plain, remove, write_json
from haptic_loop.hw.control import CertifiedCoupling
from haptic_loop.hw.limits import Stage
from haptic_loop.hw.monitor import AnswerAges
from haptic_loop.hw.protocol import NO_MARGIN, Phase
from haptic_loop.hw.recording import Recipe, Recorder
from haptic_loop.hw.session import Session
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.trace import Growth, Trace, growths
from haptic_loop.sim.world import SceneRecord, WorldRecord

_AT_CAP = 1 - 1e-6  # share of the cap from which a force counts as cut
_GROWN = 0.4  # growth rate times seconds from which an oscillation counts as grown: a tremor may grow by 1.5, too
_PERCENTILES = (50, 90, 99, 100)
_PIECE = 100_000  # ticks whose ages are computed at a time, to save memory


class IncidentLog:
    """A log file that is complete up to the last second, however the process ends.

    Each line is a JSON object. Every entry of the session's log is written at once, the session's state every second.
    The lines survive SIGKILL, but not always a power failure.
    """

    def __init__(self, path: Path) -> None:
        """Append to the file. Raises InputError where it cannot be written."""
        self.path = path
        try:
            path.open("ab").close()
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._written = 0  # [us]

    def attach(self, session: Session) -> None:
        """Write a header, and from now on every entry of the session's log."""
        self._write({"at": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "scenario": session.scenario.name, "pid": os.getpid()})
        session.listen = lambda event: self._write(event._asdict())

    def update(self, session: Session) -> None:
        """Write the session's state, once a second."""
        if session.now - self._written < 1_000_000:
            return
        self._written, drive = session.now, session.drive
        force, x = (list(drive.force), list(drive.x or ())) if drive else ([], [])
        standing = {"t_us": session.now, "stage": session.stage, "gain": session.gain, "x_m": x, "f_n": force}
        self._write(standing | {"counters": asdict(session.counters)})

    def _write(self, line: dict[str, Any]) -> None:
        with suppress(OSError), self.path.open("ab") as file:  # a full disk must not stop the session
            file.write((json.dumps(keys_in_unit(line)) + "\n").encode())


@dataclass(frozen=True)
class _Event:
    """An entry of the session's log: a stage, and why it began or what happened in it."""

    t_s: float  # [s] time since the session began
    stage: str
    cause: str


@dataclass(frozen=True)
class _Ended:
    """The last stage of the session and its cause."""

    stage: str
    cause: str
    armed: bool
    log: list[_Event]


@dataclass(frozen=True)
class _Link:
    """Counters of the session, and figures of the link while it was measured and while forces acted, if any did."""

    measured_age_us: dict[str, float] | None
    measured_missing: int
    measured_tick_us: dict[str, float] | None
    counters: dict[str, int]
    age_us: dict[str, float] | None = None
    rate_hz: float | None = None
    missed_percent: float | None = None

    @classmethod
    def of(cls, session: Session, recorder: Recorder, dropped: int) -> _Link:
        measured, T = session.measurement.result, session.scenario.T
        counters = asdict(session.counters) | {"host_dropped_bytes": dropped}
        ages, ticks = (_percentiles(np.array(times)) for times in (measured.values, measured.ticks))
        figures = cls(ages, measured.missing, ticks, counters)
        if not (len(recorder) and session.config):
            return figures
        arrays = recorder.link()
        received, dues = arrays["received"], [arming.config.due for arming in session.armings]
        answered = received.sum()
        return replace(
            figures,
            age_us=_percentiles(_ages(arrays, dues, 1e6 * T)),
            rate_hz=float(received.mean() / T),
            missed_percent=float(100 * session.missed_while_driving / answered) if answered else None,
        )


@dataclass(frozen=True)
class _Ran:
    """The ticks in which forces acted."""

    samples: int
    duration_s: float
    T_s: float
    scenario_digest: str
    pace: float  # speed relative to real time; below 1, the link looks faster than it is
    encoder_step_m: list[float] | None
    steady_ticks: list[list[int]]


@dataclass(frozen=True)
class _WorldSession(WorldRecord):
    """The figures of a world in one arming: its energy, its contacts and the time of its steps."""

    step_us: dict[str, float] | None  # percentiles of the CPU time of a step of the scene

    @classmethod
    def all_of(cls, session: Session, trace: Trace, arming: np.ndarray) -> list[_WorldSession]:
        """Return the figures of each arming. `trace` is the session's; `arming` (N,) numbers its ticks by arming."""
        sessions, delta, T = [], np.array(session.scenario.delta), session.scenario.T_max or session.scenario.T
        for i, world in enumerate(session.worlds):
            x, f = trace.x[arming == i], trace.f[arming == i]
            dx = np.diff(x, axis=0)
            energy = -(f[:-1] * dx + delta / T * dx**2).sum(axis=1)
            sessions.append(
                cls(
                    ticks=world.shell.ticks,
                    ticks_acted=int(world.shell.limited[0]),
                    given_J=float(np.cumsum(energy).max(initial=0.0)),
                    port_least_J=world.least,
                    released_J=world.port.released,
                    created_J=world.port.created,
                    unsettled_steps=world.port.unsettled,
                    warnings=world.port.warnings,
                    step_us=_percentiles(1e6 * np.array(world.seconds)),
                )
            )
        return sessions


@dataclass(frozen=True)
class SessionReport:
    """The report of a session: its coupling with certificates, its log and its link."""

    case: str
    scenario: str
    kind: str | None  # kind of the coupling; null, like the next three, in a session without a coupling
    assessment: Assessment | None
    link_delay: int | None = off_table()
    remarks: list[str] | None = off_table()
    session: _Ended = off_table()
    link: _Link = off_table()
    run: _Ran = off_table()
    growth: list[Growth] = off_table()
    energy_budget: list[BudgetFigures] | None = off_table()  # one per arming
    world: list[_WorldSession] | None = off_table()  # one per arming
    scene: SceneRecord | None = off_table()


def outcome(case: str, session: Session, recorder: Recorder, dropped: int, pace: float = 1.0) -> SessionReport:
    """Return the report of an ended session, whose end becomes stopped instead of finished if `_doubt` has a reason."""
    ticks, T = len(recorder), session.scenario.T
    coupled = session.program if isinstance(session.program, CertifiedCoupling) else None
    steady = recorder.steady_ticks(session.units.force_step, session.limits) if coupled and ticks else []
    step = list(session.units.encoder_step) if ticks else None
    ran = _Ran(ticks, ticks * T, T, session.scenario.digest, pace, step, steady)
    trace = recorder.trace(session.units, T, {"run": asdict(ran)}) if coupled and ticks else None
    worlds = _WorldSession.all_of(session, trace, recorder.link()["arming"]) if trace and session.worlds else None
    grown = growths(trace) if trace and not worlds else []  # the motion of a scene is no oscillation of the loop
    if session.stage == Stage.FINISHED and (doubt := _doubt(session, grown, recorder)):
        session.retract(doubt)
    begin = session.log[0].t_us if session.log else 0
    log = [_Event(1e-6 * (e.t_us - begin), str(e.stage), e.cause) for e in session.log]
    return SessionReport(
        case,
        session.scenario.name,
        coupled and coupled.chosen.kind,
        coupled and coupled.capped(session.limits.cap),
        coupled and coupled.link,
        coupled and coupled.remarks(),
        _Ended(str(session.stage), session.cause, ticks > 0, log),
        _Link.of(session, recorder, dropped),
        ran,
        grown,
        [arming.budget.figures(coupled and coupled.assessment) for arming in session.armings if arming.budget] or None,
        worlds,
        SceneRecord.of(session.worlds[0].port.world) if session.worlds else None,
    )


def _doubt(session: Session, growths: list[Growth], recorder: Recorder) -> str | None:
    """Return why a session that ended as planned does not count as finished, or None if forces acted as requested."""
    ticks, link = len(recorder), recorder.link()
    if 2 * session.counters.slowed > ticks > 0:
        return f"{100 * session.counters.slowed / ticks:.0f} % of the forces were cut by the slew rate"
    second = min(ticks, round(1 / session.scenario.T))
    capped = session.limits.capped(link["gain"][:, None] * link["asked"], _AT_CAP).any(axis=1)
    request = "raise --force-cap, request smaller forces, or look for a reversed sign"
    energy = "the energy account allowed no more. Raise --energy-budget, or look for a part that gives energy"
    for cut, advice in ((capped, request), (link["limited"], energy)):
        share = np.convolve(cut, np.ones(second) / second, "valid").max() if ticks else 0.0
        if share > 0.5:
            return f"{100 * share:.0f} % of the forces were cut in a second: {advice}"
    for i, growth in enumerate(growths, start=1):
        seconds = (growth.stop - growth.first) * session.scenario.T
        if growth.trend == "grows" and (growth.growth_rate_per_s or 0.0) * seconds > _GROWN:
            return f"an oscillation grew in arming {i}"
    return None


def _ages(link: Mapping[str, np.ndarray], dues: Sequence[int], T_us: float) -> np.ndarray:
    """Return the ages [us] of all answers, as `AnswerAges` infers them; `dues` has a delay [ticks] per arming."""
    ages: list[int] = []
    for i, due in enumerate(dues):
        rows = link["arming"] == i
        tick, received = np.unwrap(link["tick"][rows], period=65536), link["received"][rows]
        source = tick + (link["echo"][rows] - tick + 32768) % 65536 - 32768
        late = received & (link["status"][rows] & 0xF == Phase.HOLDING)  # the answer for this tick had not come
        columns = tick, source, np.where(received, link["margin_us"][rows], NO_MARGIN), received, late
        for begin in range(0, len(tick), _PIECE):
            answers = AnswerAges(due, T_us)
            for k, of, margin, answered, missed in zip(
                *(c[begin : begin + _PIECE].tolist() for c in columns), strict=True
            ):
                if missed or not answered:
                    answers.note_unanswered(range(k - due * answered, k - due * answered + 1))
                if margin != NO_MARGIN:
                    answers.note(of, margin)
            ages.extend(answers.by_tick.values())
    return np.array(ages)


def _percentiles(values: np.ndarray) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in _PERCENTILES} if values.size else None


def save(out: Path, session: Session, recorder: Recorder, report: SessionReport, plot: bool) -> list[Path]:
    """Write the trace (if forces acted), its picture and the report, and return their paths.

    The files of an earlier session are removed first, the report before all others: an interrupt leaves no report.
    """
    files = []
    remove(*(out / name for name in ("report.json", "trace.npz", "trace.csv", "figure.png")))
    if len(recorder):
        replay = [Recipe.of(arming, session.limits, session.units) for arming in session.armings]
        names = session.scenario.channel_names
        result = recorder.trace(session.units, session.scenario.T, plain(report) | {"replay": replay}, names)
        files += [recorder.save(out / "trace.npz", result), result.save_csv(out / "trace.csv")]
        if plot:
            from haptic_loop.sim.plots import draw_run, save

            title = f"{report.scenario}, case {report.case}: a session that ended as {session.stage}"
            files.append(save(draw_run(result.signals, title, 10.0), out / "figure.png"))
    files.append(out / "report.json")
    write_json(files[-1], plain(report) | {"files": [str(p) for p in files]})
    return files
