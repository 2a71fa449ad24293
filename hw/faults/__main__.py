"""python -m hw.faults: every fault that we could think of, in virtual time, with what it ends in and how soon.

Each case is a whole session of bridge and emulated device. Time to zero force counts from the fault to the tick from
which on no motor does anything.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from rich.table import Table

from cli.options import DOES_NOT_HOLD, DONE, Parser, check_json, console, execute
from hw.emulator.core import Emulator, info_of
from hw.emulator.upset import Upset
from hw.faults.cases import CASES, WHEN, Case
from hw.plan import Ages, Rung, ladder, link_delay
from hw.rehearsal import Plan, Rehearsal
from hw.safety import ENDED, Limits, Stage
from hw.session import Session, Settings
from sim.files import write_json
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


def main(argv: list[str]) -> int:
    """Rehearse every fault. 0: each ended as it must, 1: not."""
    parser = Parser("hw.faults", "Rehearse every fault of a link in virtual time.", "python -m hw.faults")
    parser.add_argument("--json", metavar="FILE|-", help="machine-readable result; - is standard output")
    args = parser.parse_args(argv)
    check_json(args)
    scenario = lively(load())
    made = ladder(scenario, "I", None, None, 1, spare=1)
    outcomes = [rehearse(case, scenario, made) for case in CASES]
    report(outcomes, args)
    return DONE if not any(outcome.wrong for outcome in outcomes) else DOES_NOT_HOLD


def report(outcomes: list[Outcome], args: argparse.Namespace) -> None:
    """The table of faults, and the same as JSON."""
    table = Table(title="faults, in virtual time")
    for column in ("fault", "ends in", "cause", "zero force after", "allowed"):
        table.add_column(column, justify="right" if column in ("zero force after", "allowed") else "left")
    for outcome in outcomes:
        part = _part(outcome)
        zero = "-" if part["zero_force_ms"] is None else f"{part['zero_force_ms']:.1f} ms"
        allowed = "-" if part["allowed_ms"] is None else f"{part['allowed_ms']:.1f} ms"
        ends = part["stage"] if part["holds"] else f"[red]{part['stage']}[/]"
        table.add_row(part["fault"], ends, "; ".join(part["wrong"]) or part["cause"], zero, allowed)
    console(args).print(table)
    if args.json:
        write_json(args.json, {"cases": [_part(o) for o in outcomes], "holds": not any(o.wrong for o in outcomes)})


def _part(outcome: Outcome) -> dict[str, Any]:
    session, case = outcome.rehearsal.session, outcome.case
    return {
        "fault": case.name,
        "stage": str(session.stage),
        "cause": session.cause,
        "zero_force_ms": None if outcome.to_zero is None else 1e3 * outcome.to_zero,
        "allowed_ms": case.within,
        "holds": not outcome.wrong,
        "wrong": list(outcome.wrong),
    }


if __name__ == "__main__":
    execute(main)
