"""python -m hw.bridge: drive a device over a serial port with a coupling that is certified for the delay measured.

port -> handshake -> delay -> coupling and certificate -> arm -> run -> ramp out -> trace and report
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Sequence

from cli.options import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    execute,
    out_folder,
    scenario_from,
    seed_from,
)
from cli.render import console
from design.certificate import CONDITIONS
from hw import session_report
from hw.desk import add_link_options, check_link, hold_session, measured_link, number, session_for
from hw.plan import Ages, Rung, ladder
from hw.safety import Stage
from hw.trace import Recorder
from sim.couplings import NAMES
from sim.files import write_json
from sim.scenario import InputError, require_constant_delay, require_linear

LONGEST = 3600.0  # [s] of a session: the trace is kept in memory


def main(argv: list[str]) -> int:
    """One session. 0: it ended as planned, 1: refused, stopped, lost or e-stop, 130: interrupted, after a ramp."""
    args = _parser().parse_args(argv)
    scenario, seed, settings = scenario_from(args), seed_from(args), check_link(args)
    require_linear(scenario, "hw.bridge")
    require_constant_delay(scenario, "hw.bridge")
    seconds = number(args, "duration", 0.1, LONGEST, scenario.duration)
    if args.case == "none":
        raise InputError("--case none has no coupling, so there is nothing that could be certified")
    session = session_for(scenario, settings)
    session.record = recorder = Recorder(scenario.channels)
    out = out_folder(args, "bridge")

    def plan(ages: Ages) -> Sequence[Rung]:
        link = measured_link(args, ages, scenario.T)
        rungs = ladder(scenario, args.case, args.coupling, args.condition, link)
        session_report.print_certificate(ages, link, rungs, console(args))
        return rungs

    live = hold_session(args, session, plan, seconds, seed)
    outcome = session_report.outcome(args.case, session, recorder, live.dropped, float(args.pace))
    try:  # first, for a disk may be full
        session_report.print_session(outcome, console(args))
    except OSError:
        if signal.SIGHUP not in live.signals:
            raise
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - the terminal is gone, and with it whoever would read this
    outcome["files"] = [str(p) for p in session_report.save(out, session, recorder, outcome, not args.no_plot)]
    console(args).print("files: " + ", ".join(outcome["files"]), soft_wrap=True)
    if args.json:
        write_json(args.json, outcome)
    if live.signals:
        return INTERRUPTED
    return DONE if session.stage == Stage.FINISHED else DOES_NOT_HOLD


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "hw.bridge",
        "Drive a device over a serial port with a coupling that is certified for the delay measured.",
        "python -m hw.bridge --emulate --case I --duration 2",
    )
    add_loop_options(parser)
    add_link_options(parser)
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--duration", metavar="SECONDS", help="of forces at full gain (default: the scenario's)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


if __name__ == "__main__":
    execute(main)
