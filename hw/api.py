"""`from hw import rehearse`: what hw.bridge --emulate does, in virtual time, for scripts. SI units."""

from __future__ import annotations

from dataclasses import dataclass

from controller.coupling import Coupling
from design.certificate import assess, promise_of
from design.conditions import Requirement
from design.result import COUPLING, Design, bare, number, of_kind, whole
from hw.desk import session_for
from hw.emulator.core import Emulator
from hw.plan import Ages, Rung, ladder, link_delay
from hw.rehearsal import Rehearsal
from hw.safety import Fault
from hw.session import Session, Settings
from hw.trace import Recorder, result_of
from sim.couplings import Chosen
from sim.scenario import InputError, Scenario, require_constant_delay, require_linear
from sim.trace import Result

MEASURE = 200  # answers that are timed: virtual time does not scatter
QUANTILE, GUARD_US = 0.99, 100.0  # of the ages that the delay covers, and what is added [us]; as hw.bridge has it


@dataclass(frozen=True, eq=False)
class Rehearsed:
    """What a session came to."""

    stage: str  # "finished" where all went well; else "refused", "stopped", "lost", "e-stop"
    cause: str  # of the end
    delay: float | None  # median from a sample to its force [s]; None where it was not measured
    theta: tuple[int, ...] | None  # delays that the coupling is certified for [samples]; None where there is none
    coupling: Coupling | None  # that the device was armed with, or would have been
    requirements: dict[str, Requirement]  # of that coupling by both conditions, as `certify` gives them
    promise: str | None  # for which environments they hold
    result: Result | None  # t, x and f of every tick, as `simulate` gives them; handles are not measured
    zero_after: float | None  # from the wish to stop until no motor does anything [s]; None where it never ran


def rehearse(
    scenario: Scenario,
    coupling: Coupling | Design | None = None,
    case: str = "I",
    seconds: float = 2.0,
    seed: int = 0,
) -> Rehearsed:
    """A session with the scenario's devices behind the real protocol, without a device, a port or waiting.

    Handshake, delay measured, coupling designed for it (or `coupling`, judged for it), certified, armed, run for
    `seconds`, ramped out. The scenario's theta is the least delay; a slower link makes it longer. A session that is
    refused, because nothing is certified for its delay, is a result too: see `stage` and `cause`.

    Raises InputError for a scenario that cannot stand behind a serial link, TypeError for an argument of another type.
    """
    of_kind("scenario", scenario, Scenario, 'a Scenario, as load("omega-pair") gives it')
    alone = None if coupling is None else bare(coupling, f"{COUPLING}, or None to have one designed")
    if case not in ("I", "II"):
        raise InputError(f"case is {case!r}, allowed are I, II")
    seconds, seed = number("seconds", seconds, "a number of seconds"), whole("seed", seed, 0)
    if not 0.1 <= seconds <= 3600:
        raise InputError(f"seconds is {seconds:g}, allowed are 0.1 to 3600")
    require_linear(scenario, "rehearse")
    require_constant_delay(scenario, "rehearse")
    if min(scenario.delta) <= 0:
        raise InputError(f"delta is {list(scenario.delta)}: a device without damping can promise no human anything")
    session = session_for(scenario, Settings(measure=MEASURE))
    session.record = recorder = Recorder(scenario.channels)
    rungs: list[Rung] = []
    delays: list[float] = []  # [s]

    def plan(ages: Ages) -> list[Rung]:
        delays.append(1e-6 * ages.median)
        link = link_delay(ages, 1e6 * scenario.T, QUANTILE, GUARD_US)
        found = ladder(scenario, case, None, None, link) if alone is None else [_given(scenario, case, alone, link)]
        rungs.extend(found)
        return rungs

    stopped: list[float] = []  # [s] after arming

    def stop(session: Session, now: int) -> bytes:
        stopped.append(seconds)
        return session.stop("asked to", now)

    try:
        emulator = Emulator(scenario)
    except ValueError as error:
        raise InputError(f"the scenario cannot stand behind a serial link: {error}") from None
    rehearsal = Rehearsal(session, emulator, plan, seed=seed, actions=[(seconds, stop)])
    rehearsal.run_until_armed(seconds + 0.5)
    return _outcome(rehearsal, recorder, rungs, delays, stopped)


def _given(scenario: Scenario, case: str, coupling: Coupling, link: int) -> Rung:
    """A coupling of one's own for a link of `link` ticks. Raises Fault where it is not certified."""
    slower = scenario.replace(theta=tuple(max(n, link) for n in scenario.theta))
    made = Rung(
        min(slower.theta),
        slower,
        case,
        Chosen("given", coupling, "closed-loop"),
        assess(slower.loop(case), coupling),
    )
    if not made.certified:
        needs = max(made.requirements["closed-loop"].required)
        raise Fault(f"the coupling is not certified for theta = {list(slower.theta)}: it needs {needs:.4g} N s/m")
    return made


def _outcome(
    rehearsal: Rehearsal, recorder: Recorder, rungs: list[Rung], delays: list[float], stopped: list[float]
) -> Rehearsed:
    session, first = rehearsal.session, rungs[0] if rungs else None
    scenario, ran = session.scenario, rehearsal.armed_us is not None
    meta = {"scenario": scenario.name, "scenario_digest": scenario.digest, "stage": str(session.stage)}
    return Rehearsed(
        stage=str(session.stage),
        cause=session.cause,
        delay=delays[0] if delays else None,
        theta=first and first.scenario.theta,
        coupling=first and first.chosen.coupling,
        requirements=first.requirements if first else {},
        promise=promise_of(first.requirements, first.scenario.loop(first.case)) if first else None,
        result=result_of(recorder, session.units, scenario.T, meta) if ran and len(recorder) else None,
        zero_after=rehearsal.zero_after(stopped[0]) if stopped and ran else None,
    )
