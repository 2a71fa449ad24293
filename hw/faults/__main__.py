"""Every fault that we could think of, in virtual time, with what it ends in and how soon.

Each case is a whole session of bridge and emulated device. Time to zero force counts from the fault to the tick from
which on no motor does anything.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import msgspec
import numpy as np

from hw.emulator.core import Emulator, info_of
from hw.emulator.upset import Upset
from hw.faults.cases import CASES, WHEN, Case
from hw.plan import Ages, Rung, ladder, link_delay
from hw.rehearsal import Plan, Rehearsal
from hw.safety import ENDED, Limits, Stage
from hw.session import Session, Settings
from sim.scenario import Scenario, load

MEASURED = 100  # answers whose age is measured: enough for a line that does not vary


@dataclass(frozen=True)
class Outcome:
    """What a case came to."""

    case: Case
    rehearsal: Rehearsal
    to_zero: float | None  # [s]
    wrong: tuple[str, ...]  # empty where it went as it must


def lively(scenario: Scenario) -> Scenario:
    """People who move at full amplitude soon after arming, so that a fault finds a force to take away."""
    people = tuple(
        msgspec.structs.replace(h, voluntary=h.voluntary and msgspec.structs.replace(h.voluntary, ease=0.1, phase=0.8))
        for h in scenario.human
    )
    return scenario.replace(human=people)


def rehearse(case: Case, scenario: Scenario, made: tuple[Rung, ...]) -> Outcome:
    """One case. `made` is a ladder for a link of one tick."""
    info = info_of(scenario)
    session = Session(scenario, Limits(tuple(d.force_limit for d in scenario.device)), Settings(case.baud, MEASURED))
    upsets = tuple(Upset.parse(text) for text in case.upsets)
    emulator = Emulator(scenario, upsets, case.info(info) if case.info else info)
    emulator.device.k = case.first_tick
    rehearsal = Rehearsal(
        session,
        emulator,
        _plan(case, scenario, made),
        upsets,
        actions=[(WHEN, case.action)] if case.action else (),
        host_stalls=[(WHEN, case.host_stall)] if case.host_stall else (),
        clock=case.period,
    )
    rehearsal.run_until_armed(case.lasts)
    timed = case.within is not None and rehearsal.armed_us is not None
    to_zero = rehearsal.zero_after(WHEN) if timed else None
    return Outcome(case, rehearsal, to_zero, tuple(_wrong(case, rehearsal, to_zero)))


def _plan(case: Case, scenario: Scenario, made: tuple[Rung, ...]) -> Plan:
    def plan(ages: Ages) -> tuple[Rung, ...]:
        if not case.designed:
            return made[:1]
        link = link_delay(ages, 1e6 * scenario.T, 0.99, 100.0)
        return made if (link, case.coupling) == (1, None) else ladder(scenario, "I", case.coupling, None, link, spare=0)

    return plan


def _wrong(case: Case, rehearsal: Rehearsal, to_zero: float | None) -> list[str]:
    """What did not go as it must."""
    session, wrong = rehearsal.session, []
    if session.stage != case.stage:
        wrong.append(f"ended in {session.stage} ({session.cause}), expected {case.stage}")
    if not re.search(case.cause, session.cause):
        wrong.append(f"the cause is {session.cause!r}, expected {case.cause!r}")
    if case.within is not None and (to_zero is None or 1e3 * to_zero > case.within):
        wrong.append(f"zero force after {to_zero} s, allowed are {case.within:g} ms")
    for name in case.counted:
        if not counted(session, name):
            wrong.append(f"nothing counted as {name}")
    if session.stage != Stage.ARMED and np.any(rehearsal.moments[-1].applied):
        wrong.append("a motor still has a force")
    cap = max(session.limits.cap)
    if any(np.abs(m.applied).max() > cap for m in rehearsal.moments):
        wrong.append(f"a motor had more than {cap:g} N")
    if session.stage in ENDED:
        session.arm(session.now + 1)
        if session.stage not in ENDED:
            wrong.append("it could be armed again")
    return wrong


def counted(session: Session, name: str) -> int:
    """One of the counters of a session, or the frames that the host could not read."""
    return session.decoder.rejected if name == "host_errors" else getattr(session.counters, name)


def outcomes() -> list[Outcome]:
    """Every case, with a ladder that is made once."""
    scenario = lively(load())
    made = ladder(scenario, "I", None, None, 1, spare=1)
    return [rehearse(case, scenario, made) for case in CASES]
