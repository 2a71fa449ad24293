"""What the commands at a port share: their options, the keyboard, and the session from HELLO to the end."""

from __future__ import annotations

import argparse
import os
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cli.dashboard import Dashboard
from cli.options import numbers, scenario_from
from cli.render import console, progress
from hw.control import Program, link_delay
from hw.emulator import Emulator, FaultInjection, spawned
from hw.emulator import nobody as without_hands
from hw.force_dimension import FORCE_DIMENSION, ForceDimension
from hw.monitor import Ages, LinkSettings
from hw.recording import IncidentLog
from hw.rehearsal import Rehearsal
from hw.seam import HapticDevice, SerialDevice
from hw.session import Operator, Session
from hw.transport import Live, SerialPort, preflight
from sim.scenario import InputError, Scenario

_USUAL_BAUD = 921_600
_SPARE = 600.0  # [s] beside the run, after which an orphan of --emulate would end by itself
_SHOWN_US = 100_000  # of a rehearsal, between two looks
_PASSED_ON = ("case", "scenario", "theta", "psi", "lam", "delta", "T")


def add_link_options(parser: argparse.ArgumentParser) -> None:
    """Which device, over which line, and how its delay is judged."""
    link = parser.add_argument_group("the link")
    port = f"serial port of the device, /dev/ttyACM0 or an emulator's; or {FORCE_DIMENSION}[:0x,1x], devices and axes"
    link.add_argument("--port", metavar="PATH", help=port)
    link.add_argument("--emulate", action="store_true", help="start hw.emulator and drive that; it arms by itself")
    rehearse = (
        "the whole session in virtual time with an emulated device: no port, no waiting, the same on every machine"
    )
    link.add_argument("--rehearse", action="store_true", help=rehearse)
    fault = "for --emulate and --rehearse, see hw.emulator"
    link.add_argument("--fault", action="append", default=[], metavar="FAULT", help=fault)
    link.add_argument(
        "--pace", default="1", metavar="P", help="slow motion of an emulator, for busy machines (default 1)"
    )
    link.add_argument("--arm", action="store_true", help="arm without being asked; else press a")
    baud = "of a UART, checked against T; none: USB without one (default 921600; none for a pseudo-terminal)"
    link.add_argument("--baud", metavar="N|none", help=baud)
    link.add_argument("--quantile", default="0.99", metavar="Q", help="of the ages that theta covers (default 0.99)")
    link.add_argument("--guard", default="1e-4", metavar="SECONDS", help="added to it (default 1e-4)")
    link.add_argument("--measure", default="800", metavar="N", help="answers that are timed (default 800)")


def add_safety_options(parser: argparse.ArgumentParser) -> None:
    """What the bridge never does, and who has to be there."""
    safety = parser.add_argument_group("safety")
    safety.add_argument(
        "--force-cap", default="2", metavar="NEWTON", help="largest force (default 2, for first sessions)"
    )
    safety.add_argument("--max-speed", default="1", metavar="M/S", help="of a handle while forces act (default 1)")
    heat = "force that each motor stands for ever, one is for all; above it, I2t (default: not looked at)"
    safety.add_argument("--continuous-force", metavar="N,N,..", help=heat)
    safety.add_argument("--thermal-time", default="10", metavar="SECONDS", help="of the motors' heating (default 10)")
    absolute = "count positions from the encoders' zero, not from where the handles are at arming"
    safety.add_argument("--no-rereference", action="store_true", help=absolute)
    who = "forces act only while a key is pressed, or FILE is touched, once a second, or the device's own one is held"
    safety.add_argument("--deadman", metavar="key|device|FILE", help=who)
    safety.add_argument("--no-preflight", action="store_true", help="do not look at this machine for two seconds first")


def limits_from(args: argparse.Namespace, scenario: Scenario) -> dict[str, Any]:
    """The limits of the safety options, with `cap`. Raises InputError."""
    cap = number(args, "force-cap", 0.05, 12.0)
    more: dict[str, Any] = {"cap": cap, "speed": number(args, "max-speed", 1e-3, 2.5)}
    more["thermal"] = number(args, "thermal-time", 0.1, 1000.0)
    if args.continuous_force is not None:
        more["continuous"] = numbers("--continuous-force", args.continuous_force, float, scenario.channels)
    if args.deadman == "key" and not sys.stdin.isatty():
        raise InputError("--deadman key needs a terminal; without one give it a file to be touched")
    return more


def touched(path: str) -> Callable[[], bool]:
    """Whether a file was touched since the call before; one that is not there is nobody's."""
    last = [_mtime(path)]

    def look() -> bool:
        now, before = _mtime(path), last[0]
        last[0] = now
        return now is not None and now != before

    return look


def _mtime(path: str) -> int | None:
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return None


def check_link(args: argparse.Namespace) -> LinkSettings:
    """The settings of a session. Raises InputError where the options contradict each other."""
    if bool(args.port) + args.emulate + args.rehearse != 1:
        raise InputError("give either --port PATH or --emulate or --rehearse")
    if args.fault and args.port:
        raise InputError("--fault is for --emulate and --rehearse; a device behind --port has its own")
    pace_from(args)
    if args.port and not args.arm and not sys.stdin.isatty():
        raise InputError("no keyboard to arm with: give --arm, if nobody can get hurt")
    number(args, "quantile", 0.5, 1.0)
    number(args, "guard", 0.0, 0.1)
    measure = numbers("--measure", args.measure, int, 1)[0]
    if not 50 <= measure <= 100_000:
        raise InputError(f"--measure is {measure}, allowed are 50 to 100000")
    return LinkSettings(baud=_baud(args), measure=measure)


def _baud(args: argparse.Namespace) -> int | None:
    """Of the UART in the line, None where there is none. Raises InputError.

    A pseudo-terminal has none. Of /dev/ttyACM0 nobody can tell: native USB, or a chip with a UART behind it.
    """
    if args.baud is None:
        pseudo = not args.port or host_clocked(args) or os.path.realpath(args.port).startswith("/dev/pts/")
        return None if pseudo else _USUAL_BAUD
    if args.baud == "none":
        return None
    (baud,) = numbers("--baud", args.baud, int, 1)
    if not 1200 <= baud <= 20_000_000:
        raise InputError(f"--baud is {baud}, allowed are 1200 to 20000000, or none for a link without UART")
    return baud


def host_clocked(args: argparse.Namespace) -> bool:
    """Whether the device has no clock, so that the host is it."""
    return (args.port or "").split(":")[0] == FORCE_DIMENSION


def number(args: argparse.Namespace, name: str, low: float, high: float, default: float | None = None) -> float:
    """One option as a number within its range. Raises InputError."""
    text = getattr(args, name.replace("-", "_"))
    value = default if text is None else numbers(f"--{name}", text, float, 1)[0]
    assert value is not None
    if not low <= value <= high:
        raise InputError(f"--{name} is {value:g}, allowed are {low:g} to {high:g}")
    return value


def pace_from(args: argparse.Namespace) -> float:
    """Seconds of the device's clock per second. Raises InputError."""
    pace = numbers("--pace", args.pace, float, 1)[0]
    if not 0.01 <= pace <= 1:
        raise InputError(f"--pace is {pace:g}, allowed are 0.01 to 1")
    return pace


def measured_link(args: argparse.Namespace, ages: Ages, T: float) -> int:
    """Ticks of delay for the ages that were measured, by --quantile and --guard."""
    return link_delay(ages, 1e6 * T, float(args.quantile), 1e6 * float(args.guard))


@dataclass(frozen=True)
class _Held:
    """What came to pass beside the session: signals, and bytes that the port would not take at once."""

    signals: Sequence[int] = ()
    dropped: int = 0


def hold_session(
    args: argparse.Namespace,
    session: Session,
    plan: Callable[[Ages], Sequence[Program]],
    seconds: float,
    seed: int,
    out: Path,
    nobody: bool = False,
    coulomb: float = 0.0,
) -> _Held:
    """From opening the port, or starting an emulator, to the end of the session.

    An emulated device has `nobody` at its handles where that is asked for, and dry friction `coulomb` [N].
    """
    with ExitStack() as stack:
        incidents = IncidentLog(out / "incidents.jsonl")
        stack.callback(incidents.close)
        incidents.attach(session)
        if args.rehearse:
            return _rehearsed(args, session, plan, seconds, seed, incidents, nobody, coulomb)
        device: HapticDevice
        serial: SerialDevice | None = None
        if host_clocked(args):
            axes = args.port.partition(":")[2] or None
            device = adapter = stack.enter_context(ForceDimension(session.scenario, axes))
            if not adapter.guarded:
                console(args).print(
                    "the device has no watchdog of its own: were this program killed, its force would stay"
                )
        else:
            options = [*_emulator_options(args, seed, seconds), *["--nobody"][:nobody], f"--coulomb={coulomb}"]
            with progress("starting the emulator" if args.emulate else "opening the port"):
                path = args.port or stack.enter_context(spawned(options))
            port, pace = stack.enter_context(SerialPort(path, session.settings.baud)), float(args.pace)
            device = serial = SerialDevice(port, lambda: pace * time.monotonic())
        if args.port and not getattr(args, "no_preflight", True):
            with progress("looking at this machine"):
                found = preflight(args.port)
            console(args).print(found.line(), soft_wrap=True, highlight=False)
        keyboard = stack.enter_context(_keys()) if sys.stdin.isatty() else None
        show = _view(stack)

        def glance(session: Session) -> None:
            incidents.glance(session)
            show(session)

        named = getattr(args, "deadman", None)
        deadman = None if named in (None, "device") else touched(named) if named != "key" else lambda: False
        auto_arm = args.arm or args.emulate
        live = Live(
            session,
            device,
            plan,
            auto_arm,
            seconds,
            keyboard,
            glance,
            float(args.pace),
            deadman,
        )
        live.run()
    return _Held(live.signals, serial.dropped if serial else 0)


def _rehearsed(
    args: argparse.Namespace,
    session: Session,
    plan: Callable[[Ages], Sequence[Program]],
    seconds: float,
    seed: int,
    incidents: IncidentLog,
    nobody: bool,
    coulomb: float,
) -> _Held:
    """The session in virtual time; whoever would be there arms once, and holds the deadman."""
    faults = tuple(FaultInjection.parse(text) for text in args.fault)
    try:
        scenario = without_hands(scenario_from(args)) if nobody else scenario_from(args)
        emulator = Emulator(scenario, faults, coulomb=coulomb)
    except ValueError as error:
        raise InputError(f"the scenario cannot stand behind a serial link: {error}") from None
    with progress("rehearsing") as move:

        def planned(ages: Ages) -> Sequence[Program]:
            move(0, 1, "designing the coupling")
            return plan(ages)

        def glance(session: Session) -> None:
            incidents.glance(session)
            if session.now % _SHOWN_US < 1000:
                move(session.now, round(1e6 * (1 + seconds)), f"rehearsing: {session.stage}")

        operator = Operator(True, seconds)
        Rehearsal(
            session, emulator, planned, faults, seed, operator=operator, keep=False, glance=glance
        ).run_to_the_end(seconds + _SPARE)
    return _Held()


def _emulator_options(args: argparse.Namespace, seed: int, seconds: float) -> list[str]:
    """The same loop, the faults of --fault, and an end."""
    options = [f"--{name}={getattr(args, name)}" for name in _PASSED_ON if getattr(args, name) is not None]
    options += [f"--fault={fault}" for fault in args.fault]
    return [*options, f"--seed={seed}", f"--pace={args.pace}", f"--duration={seconds + _SPARE:g}"]


def _view(stack: ExitStack) -> Callable[[Session], None]:
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
        with suppress(termios.error):  # it may have been closed
            termios.tcsetattr(keyboard, termios.TCSANOW, before)
