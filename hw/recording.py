"""The record of a session: its trace, its report, and the replay of the trace through the controller, bit by bit.

A trace is the npz of sim.run, with what the link saw beside it, so that it can be replayed; the recipe for that (the
limits, coupling and scenario of every arming) travels in its metadata.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from struct import Struct
from typing import Annotated, Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.coupling import Form
from controller.lti import Array
from controller.older import named_today
from design.files import counted, plain, read_arrays, unseen, write, write_json
from hw.control import (
    Armable,
    BudgetPlan,
    CertifiedCoupling,
    Controller,
    ProgramFigures,
    SentBudget,
    TraceRow,
    host_controller,
)
from hw.limits import SafetyLimits, SafetyStop, Units, shape
from hw.protocol import NO_MARGIN, Config
from hw.session import Session
from models.device import require
from sim.scenario import InputError, Scenario
from sim.trace import Growth, Trace, growths

#: what the link adds, one entry per tick: name -> axes of the array
_LINK = {"tick": 1, "arming": 1, "received": 1, "asked": 2, "gain": 1, "sent": 2, "margin_us": 1, "status": 1}
_LATER = {"test": 2}  # that older traces lack
_FLOATS, _WHOLE = ("asked", "gain", "test"), ("tick", "arming", "sent", "margin_us", "status")
#: link array -> least and most that a session writes
_RANGES = {"gain": (0.0, 1.0), "tick": (0, 0xFFFF), "sent": (-0x7FFF, 0x7FFF), "margin_us": (-0x8000, 0x7FFF)}
_ONCE = ("tick", "arming", "margin_us", "status")  # whole numbers of which a row of the record has one
_PERCENTILES = (50, 90, 99, 100)


class Recorder:
    """Collects rows as bytes: about 100 a tick."""

    def __init__(self, channels: int) -> None:
        m = self.channels = channels
        floats = [("x", "<f8", m), ("asked", "<f8", m), ("test", "<f8", m), ("gain", "<f8")]
        whole = [("sent", "<i4", m), ("applied", "<i4", m), *((name, "<i4") for name in _ONCE), ("received", "?")]
        self._row, self._form = np.dtype([*floats, *whole]), Struct(f"<{3 * m + 1}d{2 * m + len(_ONCE)}i?")
        self._rows, self._zero = bytearray(), (0,) * m

    def __call__(self, row: TraceRow) -> None:
        """Take in one tick."""
        state, zero = row.state, self._zero
        if state is None:
            sent, applied, margin, status = zero, zero, NO_MARGIN, 0
        else:
            sent, applied, margin, status = row.sent, state.applied, state.margin_us, state.status
        once = row.tick, row.arming, margin, status, state is not None
        self._rows += self._form.pack(*row.x, *row.asked, *(row.test or zero), row.gain, *sent, *applied, *once)

    def __len__(self) -> int:
        return len(self._rows) // self._form.size

    def link(self) -> dict[str, NDArray[Any]]:
        """Arrays by the names of _LINK, with `x` (N, m) [m] and `applied` (N, m) [steps] beside them."""
        rows = np.frombuffer(bytes(self._rows), self._row)
        return {name: rows[name] for name in rows.dtype.names or ()}


def steady_ticks(recorder: Recorder, force_step: Sequence[float], cap: Sequence[float]) -> list[list[int]]:
    """[first, stop) of each arming in which the loop was one linear loop: full gain, until a cap or the slew rate cuts.

    Missed ticks are not left out. `force_step` and `cap` (m,) [N].
    """
    link = recorder.link()
    asked = -np.round(link["asked"] / np.array(force_step))
    cut = link["received"] & np.any((link["sent"] != asked) | (np.abs(link["asked"]) >= cap), axis=1)
    stretches = []
    for arming in np.unique(link["arming"]):
        full = np.flatnonzero((link["arming"] == arming) & (link["gain"] == 1.0))
        if full.size:
            count = int(np.argmax(cut[full])) if cut[full].any() else full.size
            stretches.append([int(full[0]), int(full[0]) + count])
    return stretches


def result_of(recorder: Recorder, units: Units, T: float, meta: dict[str, Any]) -> Trace:
    """The trace in the terms of sim.run. Handles and outside forces are not measured: nan, and no column."""
    link = recorder.link()
    n, m = len(recorder), recorder.channels
    last = np.maximum.accumulate(np.where(link["received"], np.arange(n), 0))  # a force is held until the next is known
    f = -link["applied"][last] * np.array(units.force_step)
    unknown = np.full((n, m), np.nan)
    t = np.arange(n, dtype=float) * T
    return Trace(t, link["x"], f, unknown, unknown, np.zeros((n, 0)), meta)


def save_npz(path: Path, result: Trace, recorder: Recorder) -> Path:
    """An npz that sim.trace reads, with the arrays of _LINK beside its own."""
    recorded = recorder.link()
    link = {f"link_{name}": recorded[name] for name in _LINK | _LATER}
    own = {name: getattr(result, name) for name in ("t", "x", "f", "x_handle", "v_handle", "w")}
    arrays: dict[str, Any] = {**own, **link, "meta": np.array(json.dumps(result.meta))}

    def content(file: BinaryIO) -> None:
        np.savez_compressed(file, allow_pickle=False, digest=np.array(digest(arrays)), **arrays)

    return write(path, content)


def digest(arrays: Mapping[str, Array]) -> str:
    """SHA-256 of everything in a trace: it tells a record from one that was changed, cut or put together."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        whole.update(f"{name} {arrays[name].dtype.str} {arrays[name].shape} ".encode() + arrays[name].tobytes())
    return whole.hexdigest()


def load(path: Path) -> tuple[Trace, dict[str, Array]]:
    """A trace with its link arrays. Raises InputError where the file holds no session of a bridge."""
    arrays = read_arrays(path, "a trace of this program")
    result = Trace.of_arrays(path, arrays)
    try:
        link = {name: arrays[f"link_{name}"] for name in _LINK}
        link |= {name: arrays.get(f"link_{name}", np.zeros(arrays["x"].shape)) for name in _LATER}
    except KeyError:
        raise InputError(f"{path}: a trace, but not of a bridge's session; hw.bridge writes one") from None
    n, m = result.x.shape
    for name, axes in (_LINK | _LATER).items():
        if link[name].shape != ((n, m) if axes == 2 else (n,)):
            raise InputError(
                f"{path}: link_{name} has the shape {link[name].shape}, the trace {n} ticks of {m} channels"
            )
    if wrong := _complaint(result, link):
        raise InputError(f"{path}: no session of hw.bridge: {wrong}")
    if str(arrays.pop("digest", "")) != digest(arrays):
        raise InputError(f"{path}: was changed after hw.bridge wrote it: its digest is another")
    return result, link


def _complaint(result: Trace, link: dict[str, Array]) -> str | None:
    """What is wrong with a trace whose shapes are right; None where nothing is."""
    if not isinstance(result.meta, dict):
        return f"its metadata is a {type(result.meta).__name__}, expected an object"
    if result.t.size == 0:
        return "it has no ticks"
    for name, values in {"x": result.x, "t": result.t}.items():
        if not np.isfinite(values).all():
            return f"{name} is not finite at tick {_first(~np.isfinite(values))}"
    wanted: dict[str, Any] = dict.fromkeys(_FLOATS, np.float64) | {"received": np.bool_}
    for name, values in link.items():
        kind = values.dtype
        if name in _WHOLE and kind.kind != "i":
            return f"link_{name} is of type {kind}, expected whole numbers"
        if name in wanted and kind != wanted[name]:
            return f"link_{name} is of type {kind}, expected {np.dtype(wanted[name])}"
        if name in _FLOATS and not np.isfinite(values).all():
            return f"link_{name} is not finite at tick {_first(~np.isfinite(values))}"
        low, high = _RANGES.get(name, (-np.inf, np.inf))
        outside = (values < low) | (values > high) if name in _RANGES else np.zeros(1, bool)
        if outside.any():
            return f"link_{name} is outside of {low:g} to {high:g} at tick {_first(outside)}"
    arming = link["arming"]
    if arming[0] != 0 or not np.isin(np.diff(arming), (0, 1)).all():
        return "link_arming does not count armings from 0 up"
    return None


def _first(wrong: Array) -> int:
    """The first row of `wrong` (N,) or (N, m) with a True."""
    return int(np.argmax(wrong.reshape(len(wrong), -1).any(axis=1)))


class IncidentLog:
    """A log that is complete up to the last second however the process ends: it is appended to, not kept in memory.

    One JSON object a line: every change of the stage at once, and every second where things stand. What was written
    survives SIGKILL, though not a power failure.
    """

    def __init__(self, path: Path) -> None:
        """Raises InputError where the file cannot be written."""
        self.path = path
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
        self._told = 0  # [us]

    def attach(self, session: Session) -> None:
        """Record from now on."""
        self._write({"at": time.strftime("%Y-%m-%dT%H:%M:%S%z"), "scenario": session.scenario.name, "pid": os.getpid()})
        session.listen = lambda event: self._write({"t_us": event.t_us, "stage": event.stage, "cause": event.cause})

    def glance(self, session: Session) -> None:
        """Write the session's state, once a second."""
        if session.now - self._told < 1_000_000:
            return
        self._told, drive = session.now, session.drive
        force, x = (list(drive.force), list(drive.x or ())) if drive else ([], [])
        standing = {"t_us": session.now, "stage": session.stage, "gain": session.gain, "x_m": x, "f_n": force}
        self._write(standing | {"counters": asdict(session.counters)})

    def _write(self, line: dict[str, Any]) -> None:
        with suppress(OSError):  # a full disk is no reason to drop the forces
            os.write(self._file, (json.dumps(line) + "\n").encode())

    def close(self) -> None:
        os.close(self._file)


# the report, and the files


@dataclass(frozen=True)
class _Event:
    """A change of the stage, and why."""

    t_s: float  # since the session began
    stage: str
    cause: str


@dataclass(frozen=True)
class _Ended:
    """How far the session came."""

    stage: str
    cause: str
    armed: bool
    log: list[_Event]


@dataclass(frozen=True)
class _Link:
    """What the link did: when it was measured, and while forces acted (None where they never did)."""

    measured_age_us: dict[str, float] | None
    measured_missing: int
    measured_tick_us: dict[str, float] | None
    counters: dict[str, int]
    age_us: dict[str, float] | None = None
    rate_hz: float | None = None
    missed_percent: float | None = None

    @classmethod
    def of(cls, session: Session, recorder: Recorder, dropped: int) -> _Link:
        measured, T = session.measurement, session.scenario.T
        counters = asdict(session.counters) | {"host_dropped_bytes": dropped}
        ages, ticks = (_percentiles(np.array(times)) for times in (measured.ages, measured.result.ticks))
        found = cls(ages, measured.missing, ticks, counters)
        if not (len(recorder) and session.config):
            return found
        arrays = recorder.link()
        received = arrays["received"]
        margins, answered = arrays["margin_us"][received & (arrays["margin_us"] != NO_MARGIN)], received.sum()
        return replace(
            found,
            age_us=_percentiles(session.config.due * 1e6 * T - margins),
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
    pace: float  # below 1: slow motion, in which a link looks faster than it is
    encoder_step_m: list[float] | None
    steady_ticks: list[list[int]]


@dataclass(frozen=True)
class SessionReport:
    """What a session came to, without a verdict: the coupling with its certificates, the log, the link."""

    case: str
    scenario: str
    program: ProgramFigures = unseen("beside")
    session: _Ended = unseen()
    link: _Link = unseen()
    run: _Ran = unseen()
    growth: list[Growth] = unseen()
    energy_budget: list[dict[str, Any]] | None = unseen()  # arming by arming


def outcome(case: str, session: Session, recorder: Recorder, dropped: int, pace: float = 1.0) -> SessionReport:
    """The report of a session that has ended."""
    begin = session.log[0].t_us if session.log else 0
    log = [_Event(1e-6 * (e.t_us - begin), str(e.stage), e.cause) for e in session.log]
    program = ProgramFigures()
    steady, ticks, T = list[list[int]](), len(recorder), session.scenario.T
    if coupled := isinstance(session.program, CertifiedCoupling):
        program = session.program.figures(session.limits.cap)
        steady = steady_ticks(recorder, session.units.force_step, session.limits.cap) if ticks else []
    step = list(session.units.encoder_step) if ticks else None
    ran = _Ran(ticks, ticks * T, T, session.scenario.digest, pace, step, steady)
    trace = result_of(recorder, session.units, T, {"run": asdict(ran)}) if coupled and ticks else None
    return SessionReport(
        case,
        session.scenario.name,
        program,
        _Ended(str(session.stage), session.cause, ticks > 0, log),
        _Link.of(session, recorder, dropped),
        ran,
        growths(trace) if trace else [],
        [budget.part() for budget in session.budgets] or None,
    )


def _percentiles(values: np.ndarray) -> dict[str, float] | None:
    return {f"p{q}": float(np.percentile(values, q)) for q in _PERCENTILES} if values.size else None


def save(out: Path, session: Session, recorder: Recorder, report: SessionReport, plot: bool) -> list[Path]:
    """The trace (where forces acted), its picture, and the report."""
    files = []
    if len(recorder):
        plans = [asdict(budget.plan) for budget in session.budgets] or [None] * len(session.armings)
        armings = zip(session.armings, plans, strict=True)
        replay = [_recipe_of(session, *arming) | {"energy_budget": plan} for arming, plan in armings]
        result = result_of(recorder, session.units, session.scenario.T, plain(report) | {"replay": replay})
        files += [save_npz(out / "trace.npz", result, recorder), result.save_csv(out / "trace.csv")]
        if plot:
            from sim.plots import plot_run

            title = f"{report.scenario}, case {report.case}: a session that ended {session.stage}"
            files.append(plot_run(result, out / "figure.png", title, 10.0))
    files.append(out / "report.json")
    write_json(files[-1], plain(report) | {"files": [str(p) for p in files]})
    return files


def _recipe_of(session: Session, program: Armable, config: Config) -> dict[str, Any]:
    """What hw.replay needs to repeat one arming."""
    assert isinstance(program, CertifiedCoupling)
    return {
        "scenario": json.loads(msgspec.json.encode(program.scenario)),
        "coupling": json.loads(msgspec.json.encode(program.chosen.coupling.form())),
        "link_delay": program.link,
        "limits": asdict(session.limits),
        "force_step": list(session.units.force_step),
        "cap": list(config.cap),
        "lag": None if program.limits.rho is None else list(program.limits.rho),
    }


# the replay


class _Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a trace says of the controller that made it."""

    scenario: Scenario
    coupling: Form
    link_delay: int
    limits: SafetyLimits
    force_step: tuple[float, ...]
    cap: tuple[int, ...]
    energy_budget: BudgetPlan | None = None
    lag: tuple[float, ...] | None = None  # (m,) [N/m] rho of the limiter, where there was one

    def __post_init__(self) -> None:
        """Raises ValueError naming a value that no session can have written."""
        m, least = self.scenario.channels, min(self.scenario.theta)
        for name, given in (("limits.cap", self.limits.cap), ("force_step", self.force_step), ("cap", self.cap)):
            if len(given) != m:
                raise ValueError(f"{name} has {len(given)} entries, the scenario {m} channels")
        for i in range(m):
            require(f"force_step #{i + 1}", self.force_step[i], 1e-9, 1.0, "N")
            require(f"cap #{i + 1}", self.cap[i], 1, 0x7FFF, "steps")
        soonest = 0 if self.scenario.latency else 1
        if not soonest <= self.link_delay <= least:
            allowed = f"{soonest} to {least}, the scenario's least theta"
            raise ValueError(f"link_delay is {self.link_delay}, allowed are {allowed}")

    def controller(self) -> Controller:
        """F as the host ran it. Raises InputError where the recipe is impossible."""
        try:
            coupling = self.coupling.build(self.scenario.T)
            return host_controller(self.scenario.loop("I"), coupling, self.link_delay, self.limits.cap, self.lag)
        except ValueError as error:
            raise InputError(f"the trace cannot be replayed: {error}") from None

    def budget(self) -> SentBudget | None:
        """The energy budget at its start, where there was one. Raises InputError where it is impossible."""
        if self.energy_budget is None:
            return None
        try:
            if len(self.energy_budget.delta) != self.scenario.channels:
                raise ValueError(f"the budget is for {len(self.energy_budget.delta)} channels")
            return SentBudget(self.energy_budget)
        except ValueError as error:
            raise InputError(f"the trace cannot be replayed: {error}") from None


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Where the replay differs from the record."""

    asked: NDArray[np.bool_]  # (N,) the controller's forces, as 64-bit floats
    sent: NDArray[np.bool_]  # (N,) what was put on the wire, as integers
    largest: float  # [N] between the controller's forces

    @property
    def identical(self) -> bool:
        return not (self.asked.any() or self.sent.any())


def _recipes_of(result: Trace) -> list[_Recipe]:
    """The recipes in a trace, one for each arming. Raises InputError where there is none."""
    try:
        raw = result.meta.get("replay")
        _require_limits(raw)
        for recipe in raw if isinstance(raw, list) else []:
            if isinstance(recipe, dict) and isinstance(scenario := recipe.get("scenario"), dict):
                recipe["scenario"] = named_today(scenario)
        return msgspec.convert(raw, Annotated[list[_Recipe], msgspec.Meta(min_length=1)])
    except (msgspec.ValidationError, ValueError) as error:
        raise InputError(f"the trace cannot be replayed: {counted(str(error))}") from None


def _require_limits(raw: object) -> None:
    """Raise ValueError where a recipe has other limits than SafetyLimits: msgspec passes over those of a dataclass."""
    names = {field.name for field in fields(SafetyLimits)}
    needed = names - {"speed", "continuous", "thermal"}  # which older traces lack
    for recipe in raw if isinstance(raw, list) else []:
        limits = recipe.get("limits") if isinstance(recipe, dict) else None
        if isinstance(limits, dict) and not needed <= set(limits) <= names:
            wrong = ", ".join(sorted((needed - set(limits)) | (set(limits) - names)))
            raise ValueError(f"limits are {', '.join(sorted(names))}; missing or unknown: {wrong}")


def replay(result: Trace, link: dict[str, Array]) -> _Comparison:
    """Feed the recorded displacements through controller, gain, limits and rounding, every arming from rest."""
    recipes, arming = _recipes_of(result), link["arming"]
    channels = result.x.shape[1]
    if int(arming[-1]) + 1 != len(recipes) or any(recipe.scenario.channels != channels for recipe in recipes):
        told = f"{len(recipes)} recipes for {int(arming[-1]) + 1} armings of {channels} channels"
        raise InputError(f"the trace cannot be replayed: it has {told}")
    asked, sent = np.zeros_like(link["asked"]), np.zeros_like(link["sent"])
    for i, recipe in enumerate(recipes):
        _again(recipe, np.flatnonzero(arming == i), result, link, (asked, sent))
    different = asked.view(np.int64) != link["asked"].view(np.int64)
    largest = float(np.abs(asked - link["asked"]).max(initial=0.0))
    return _Comparison(different.any(axis=1), (sent != link["sent"]).any(axis=1), largest)


def _again(
    recipe: _Recipe, ticks: NDArray[np.intp], result: Trace, link: dict[str, Array], into: tuple[Array, Array]
) -> None:
    """The `ticks` of one arming: forces asked for and steps sent, written to `into`."""
    controller, units = (
        recipe.controller(),
        Units((1.0,) * len(recipe.cap), recipe.force_step, (1,) * len(recipe.cap)),
    )
    force: Sequence[float] = (0.0,) * len(recipe.cap)
    asked, sent = into
    budget, missed = recipe.budget(), 0
    for k in ticks:
        asked[k] = controller.step(result.x[k].tolist())
        if not link["received"][k]:
            missed += 1
            continue
        try:
            gain = float(link["gain"][k])
            test = link["test"][k].tolist()
            force = shape(asked[k].tolist(), force, gain, recipe.limits, recipe.scenario.T, test).force
        except SafetyStop as fault:
            raise InputError(f"the trace cannot be replayed: tick {k}: {fault}") from None
        steps = units.steps(force, recipe.cap)
        if budget:
            whole = budget.limit(steps, result.x[k].tolist(), result.f[k], missed)
            if whole != steps:
                force, steps = units.forces(whole), whole
            missed = 0
        sent[k] = steps
