"""python -m hw.bridge: drive a device over a serial port with a coupling that is certified for the delay measured.

port -> handshake -> delay -> coupling and certificate -> arm -> run -> ramp out -> trace and report
"""

from __future__ import annotations

import argparse
import sys
import termios
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from design.assess import CONDITIONS
from hw import session_report
from hw.dashboard import Dashboard
from hw.emulate import spawned
from hw.live import Live
from hw.plan import Ages, Rung, ladder, link_delay
from hw.port import Port
from hw.safety import Limits, Stage
from hw.session import Session, Settings
from hw.trace import Recorder
from sim.command import (
    DOES_NOT_HOLD,
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    add_output_options,
    console,
    execute,
    numbers,
    out_folder,
    scenario_from,
    seed_from,
)
from sim.couplings import NAMES
from sim.files import write_json
from sim.scenario import InputError, Scenario

LONGEST = 3600.0  # [s] of a session: the trace is kept in memory


def main(argv: list[str]) -> int:
    """One session. 0: it ended as planned, 1: refused, stopped, lost or e-stop, 130: interrupted, after a ramp."""
    args = _parser().parse_args(argv)
    scenario, seed = scenario_from(args), seed_from(args)
    settings, seconds = _settings(args), _number(args, "duration", 0.1, LONGEST, scenario.duration)
    _check(args)
    session = _session(args, scenario, settings)
    recorder = Recorder(scenario.channels)
    session.record = recorder
    out = out_folder(args, "bridge")

    with ExitStack() as stack:
        path = args.port or stack.enter_context(spawned(args, seed, seconds))
        port = stack.enter_context(Port(path, settings.baud or 115200))
        keyboard = stack.enter_context(_keys()) if sys.stdin.isatty() else None
        live = Live(
            session, port, _plan(args, scenario), args.arm or args.emulate, seconds, keyboard, _view(stack, args)
        )
        live.run()

    outcome = session_report.outcome(args.case, session, recorder, live.dropped)
    outcome["files"] = [str(p) for p in session_report.save(out, session, recorder, outcome, not args.no_plot)]
    session_report.print_session(outcome, console(args))
    if args.json:
        write_json(args.json, outcome)
    if live.signals:
        return INTERRUPTED
    return DONE if session.stage == Stage.FINISHED else DOES_NOT_HOLD


def _parser() -> Parser:
    parser = Parser(
        "hw.bridge",
        "Drive a device over a serial port with a coupling that is certified for the delay measured.",
        "python -m hw.bridge --emulate --case I --duration 2",
    )
    add_loop_options(parser)
    parser.add_argument("--port", metavar="PATH", help="serial port of the device, /dev/ttyACM0 or an emulator's")
    parser.add_argument("--emulate", action="store_true", help="start hw.emulator and drive that; it arms by itself")
    parser.add_argument("--fault", action="append", default=[], metavar="FAULT", help="for --emulate, see hw.emulator")
    parser.add_argument("--arm", action="store_true", help="arm without being asked; else press a")
    names = ", ".join(NAMES)
    parser.add_argument("--coupling", metavar="NAME|FILE", help=f"{names} or FILE.json (default spring-damper)")
    parser.add_argument("--condition", choices=CONDITIONS, help="the condition that the certificate is about")
    parser.add_argument("--duration", metavar="SECONDS", help="of forces at full gain (default: the scenario's)")
    parser.add_argument("--baud", default="921600", metavar="N", help="default 921600; checked against T")
    parser.add_argument("--quantile", default="0.99", metavar="Q", help="of the ages that theta covers (default 0.99)")
    parser.add_argument("--guard", default="1e-4", metavar="SECONDS", help="added to it (default 1e-4)")
    parser.add_argument("--measure", default="800", metavar="N", help="answers that are timed (default 800)")
    parser.add_argument("--no-plot", action="store_true", help="write no picture")
    add_output_options(parser)
    return parser


def _check(args: argparse.Namespace) -> None:
    if bool(args.port) == args.emulate:
        raise InputError("give either --port PATH or --emulate")
    if args.fault and not args.emulate:
        raise InputError("--fault is for --emulate; a device behind --port has its own")
    if args.port and not args.arm and not sys.stdin.isatty():
        raise InputError("no keyboard to arm with: give --arm, if nobody can get hurt")
    if args.case == "none":
        raise InputError("--case none has no coupling, so there is nothing that could be certified")
    _number(args, "quantile", 0.5, 1.0)
    _number(args, "guard", 0.0, 0.1)


def _number(args: argparse.Namespace, name: str, low: float, high: float, default: float | None = None) -> float:
    text = getattr(args, name)
    value = default if text is None and default is not None else numbers(f"--{name}", text, float, 1)[0]
    if not low <= value <= high:
        raise InputError(f"--{name} is {value:g}, allowed are {low:g} to {high:g}")
    return value


def _settings(args: argparse.Namespace) -> Settings:
    baud, measure = numbers("--baud", args.baud, int, 1)[0], numbers("--measure", args.measure, int, 1)[0]
    for name, value, low, high in (("baud", baud, 1200, 20_000_000), ("measure", measure, 50, 100_000)):
        if not low <= value <= high:
            raise InputError(f"--{name} is {value}, allowed are {low} to {high}")
    return Settings(baud=baud, measure=measure)


def _session(args: argparse.Namespace, scenario: Scenario, settings: Settings) -> Session:
    try:
        return Session(scenario, Limits(tuple(min(12.0, d.force_limit) for d in scenario.device)), settings)
    except ValueError as error:
        raise InputError(str(error)) from None


def _plan(args: argparse.Namespace, scenario: Scenario) -> Callable[[Ages], Sequence[Rung]]:
    """Theta for the ages that were measured, and the couplings for it; the certificate is printed before arming."""

    def plan(ages: Ages) -> Sequence[Rung]:
        link = link_delay(ages, 1e6 * scenario.T, float(args.quantile), 1e6 * float(args.guard))
        rungs = ladder(scenario, args.case, args.coupling, args.condition, link)
        session_report.print_certificate(ages, link, rungs, console(args))
        return rungs

    return plan


def _view(stack: ExitStack, args: argparse.Namespace) -> Callable[[Session], None]:
    """The dashboard, on a terminal."""
    if not sys.stderr.isatty():
        return lambda session: None
    dashboard = Dashboard()
    stack.callback(dashboard.close)
    return dashboard


@contextmanager
def _keys() -> Iterator[int]:
    """Standard input, key by key."""
    keyboard = sys.stdin.fileno()
    before: list[Any] = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard, termios.TCSANOW)
    try:
        yield keyboard
    finally:
        termios.tcsetattr(keyboard, termios.TCSANOW, before)


if __name__ == "__main__":
    execute(main)
