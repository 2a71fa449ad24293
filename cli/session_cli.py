"""Parts of hw.bridge and hw.identify: options, the keyboard, and a session from opening the port to its end."""

from __future__ import annotations

import argparse
import os
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from haptic_loop.cli import options
from haptic_loop.cli.render import console, progress
from haptic_loop.controller.units import in_unit
from haptic_loop.design.files import lost_output
from haptic_loop.design.own import called, named
from haptic_loop.hw.boards import Boards, ticks_behind
from haptic_loop.hw.control import Armable
from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import KINDS, Emulator, FaultInjection
from haptic_loop.hw.force_dimension import FORCE_DIMENSION, ForceDimension
from haptic_loop.hw.haptic_device import HapticDevice, SerialDevice
from haptic_loop.hw.limits import SafetyLimits, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import SafetyStop
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session, axis_by_axis
from haptic_loop.hw.session_report import IncidentLog
from haptic_loop.hw.transport import Live, SerialPort, preflight
from haptic_loop.sim.scenario import InputError, Scenario, require_constant_delay, require_even_ticks, require_linear

_USUAL_BAUD = 921_600
_SPARE = 600.0  # [s] virtual time that a rehearsal may take beyond the requested seconds
_SHOWN_US = 100_000  # [us] virtual time between two updates of a rehearsal's progress bar
#: counters in the status line, unless they are 0
_SHOWN = ("gaps", "misses", "late", "clipped", "device_errors", "duplicates", "stale", "host_errors")


def add_link_options(parser: options.Parser) -> None:
    """Add the options of the link between host and device."""
    link = parser.add_argument_group("the link")
    add, number = link.add_argument, options.number
    port = "serial port of the device, such as /dev/ttyACM0; A,B: ports of several boards, one board per device; "
    port += f"{FORCE_DIMENSION}[:0x,sn4711x]: index or serial number of a device and letter of its axis, for each "
    port += "channel; or FILE.py:NAME of your own device"
    add("--port", metavar="PATH", help=port)
    virtual = "run the whole session in virtual time with an emulated device: no port, no waiting, repeatable"
    add("--rehearse", action="store_true", help=virtual)
    fault = (
        "KIND[=VALUE][@START[+DURATION]], times in seconds after arming, for --rehearse; the prefix up: or down: means "
    )
    fault += f"one direction, the prefix axis2: one axis; KIND is {', '.join(KINDS)}"
    add("--fault", action="append", default=[], metavar="FAULT", help=fault)
    clamp = f"with --port {FORCE_DIMENSION}: a mechanical clamp holds the axes that no channel drives (default: ask)"
    add("--clamped", action="store_true", help=clamp)
    # With --pace, tests drive an emulator behind a pseudo-terminal in slow motion.
    add("--pace", type=number(0.01, 1), default=1.0, help=argparse.SUPPRESS)
    add("--arm", action="store_true", help="arm without being asked (default: when the key a is pressed)")
    baud = "baud rate of a UART, checked against T, or none (default 921600; none for a pseudo-terminal or --rehearse)"
    add("--baud", type=_baud_or_none, metavar="N|none", help=baud)
    count = "number of answers that are timed (default 800)"
    add("--measure", type=options.whole(50, 100_000), default=800, metavar="N", help=count)
    share = "share of the measured answers whose age must be within theta or the latency (default 0.99)"
    add("--quantile", type=number(0.5, 1.0), default=0.99, metavar="Q", help=share)
    guard = "spare time added to the measured age (default 1e-4)"
    add("--guard", type=number(0.0, 0.1), default=1e-4, metavar="SECONDS", help=guard)
    parser.only("with --rehearse: faults act on an emulated device", lambda args: args.rehearse, "fault")
    parser.only("with --port: a rehearsal arms by itself", lambda args: args.port, "arm")
    parser.only(f"with --port {FORCE_DIMENSION}", host_clocked, "clamped")
    uart = f"with a serial port or --rehearse: {FORCE_DIMENSION} and your own device have no UART"
    parser.only(uart, lambda args: not host_clocked(args) and not _own(args), "baud")
    parser.only("without --rehearse, whose time is virtual", lambda args: not args.rehearse, "pace")


def add_output_options(parser: options.Parser, picture: bool = False) -> None:
    parser.add_output(picture=picture)
    parser.only("with --rehearse: a session with a device uses no random numbers", lambda args: args.rehearse, "seed")


def add_safety_options(parser: options.Parser) -> None:
    """Add the options that limit forces and motions."""
    add, number = parser.add_argument_group("safety").add_argument, options.number
    cap = "largest force of a device at the hand (default 1.3, or less so that no constant force moves a free handle "
    cap += "faster than 1 m/s)"
    add("--force-cap", type=number(0.05, 12.0), metavar="NEWTON", help=cap)
    speed = "fastest motion of a hand while forces act (default 0.7, at most the devices' least credible_speed)"
    add("--max-speed", type=number(1e-3, 2.5), metavar="M/S", help=speed)
    heat = "force at the hand that each motor can hold for ever, or one number for all; larger forces are limited in "
    heat += "time by I2t (default: not watched)"
    add("--continuous-force", type=options.several(float, 1e-3, 12.0), metavar="N,N,..", help=heat)
    warm = "time constant of the motors' heating (default 10)"
    add("--thermal-time", type=number(0.1, 1000), default=10.0, metavar="SECONDS", help=warm)
    absolute = "count positions from the encoders' zero, not from where the handles are at arming"
    add("--no-rereference", action="store_true", help=absolute)
    add("--no-preflight", action="store_true", help="skip the two-second check of this machine")
    parser.only("with --port", lambda args: args.port, "no_preflight")
    parser.only("with --continuous-force", lambda args: args.continuous_force, "thermal_time")


def add_person_options(parser: options.Parser) -> None:
    """Add the options for what a person at the device must do: hold a dead-man switch, and move every axis."""
    add = parser.add_argument_group("the person at the device").add_argument
    who = "forces act only while the user presses a key or touches FILE once a second, or holds the device's own switch"
    add("--deadman", metavar="key|device|FILE", help=f"{who} (default with --port: key)")
    add("--no-dead-man", action="store_true", help="let forces act without a dead-man switch")
    unchecked = "arm without asking the user to move every axis in its + direction by hand"
    add("--no-axis-check", action="store_true", help=unchecked)
    parser.only("with --port", lambda args: args.port, "no_dead_man", "no_axis_check")
    held = "with --port: in a rehearsal only --deadman device acts"
    parser.only(held, lambda args: args.port or args.deadman == "device", "deadman")


def steady_scenario(args: argparse.Namespace, command: str) -> Scenario:
    """Return the scenario. Raises InputError for Coulomb friction, `period`, `latency` or varying delays."""
    scenario = options.scenario_from(args)
    require_linear(scenario, command, walls=True)
    for require in (require_constant_delay, require_even_ticks):
        require(scenario, command)
    return scenario


def limits_from(args: argparse.Namespace, scenario: Scenario) -> dict[str, Any]:
    """Return the safety limits for `session_for`. Raises InputError."""
    more: dict[str, Any] = {"cap": args.force_cap, "speed": _speed(args, scenario), "thermal": args.thermal_time}
    if args.continuous_force is not None:
        forces = options.per_channel("--continuous-force", args.continuous_force, scenario.channels)
        more["continuous"] = tuple(scenario.lever * force for force in forces)
    return more


def with_person(args: argparse.Namespace, settings: LinkSettings) -> LinkSettings:
    """Return the settings with the checks of `add_person_options`, and set args.deadman. Raises InputError.

    In a rehearsal nobody can move the axes for a check.
    """
    if args.port and not args.deadman and not args.no_dead_man:
        args.deadman = "key"
    if args.deadman and args.no_dead_man:
        raise InputError("--no-dead-man contradicts --deadman: give one of them")
    if args.deadman == "key" and not sys.stdin.isatty():
        raise InputError("--deadman key needs a terminal: give --deadman FILE, --deadman device or --no-dead-man")
    checked = not (args.rehearse or args.no_axis_check)
    return replace(settings, deadman=args.deadman == "device", check_axes=checked)


def _speed(args: argparse.Namespace, scenario: Scenario) -> float:
    """Return the speed [m/s or rad/s] at which a session stops. Raises InputError if the damping is unknown there."""
    known = scenario.lever * min(device.credible_speed for device in scenario.axis_devices)
    if args.max_speed is None:
        return min(SafetyLimits.speed, known) / scenario.lever
    if args.max_speed > known:
        raise InputError(
            f"--max-speed is {args.max_speed:g}, the devices' least credible_speed is {known:g} metres/s at the hand: "
            "their damping is not known beyond it (hw.identify --speed)"
        )
    return args.max_speed / scenario.lever


def touched(path: str) -> Callable[[], bool]:
    """Return a function that says whether a file exists and was touched since the last call."""
    last = _mtime(path)

    def touched_again() -> bool:
        nonlocal last
        before, last = last, _mtime(path)
        return last is not None and last != before

    return touched_again


def _deadman(named: str | None) -> Callable[[], bool] | None:
    """Return `touched(FILE)`; for `key` a function that returns False; None without a switch on this machine."""
    if named in (None, "device"):
        return None
    return touched(named) if named != "key" else lambda: False  # The driver reads the keys.


def _mtime(path: str) -> int | None:
    try:
        return os.stat(path).st_mtime_ns
    except OSError:
        return None


def check_link(args: argparse.Namespace) -> LinkSettings:
    """Return the settings of a session. Raises InputError if the options contradict each other."""
    if bool(args.port) == args.rehearse:
        raise InputError("give either --port PATH or --rehearse")
    if args.port and not args.arm and not sys.stdin.isatty():
        raise InputError("no keyboard to arm with: give --arm, if nobody can get hurt")
    return LinkSettings(baud=_baud(args), measure=args.measure)


def _baud(args: argparse.Namespace) -> int | None:
    """Return the baud rate of the UART in the link, or None without a UART.

    A pseudo-terminal has no UART. /dev/ttyACM0 may have one, so a UART is assumed.
    """
    if args.baud is None:
        pseudo = not args.port or all(os.path.realpath(path).startswith("/dev/pts/") for path in _ports(args))
        return None if pseudo else _USUAL_BAUD
    return args.baud or None


def _baud_or_none(text: str) -> int:
    return 0 if text == "none" else options.whole(1200, 20_000_000, ", or none for a link without UART")(text)


def boards_behind(args: argparse.Namespace, scenario: Scenario) -> tuple[int, ...]:
    """Return the ticks (m,) by which forces act later than the link's delay; () for one port. Raises InputError."""
    count, devices = len(_ports(args)), len(scenario.device)
    if count < 2:
        return ()
    if count != devices:
        raise InputError(f"--port has {count} ports, the scenario {devices} devices: give one for each, or one for all")
    if scenario.T_min:
        raise InputError(
            "T_min cannot be guaranteed with several ports, because the clocks of the boards drift: remove it"
        )
    return ticks_behind(scenario.theta, [len(device.free) for device in scenario.device])


def _ports(args: argparse.Namespace) -> list[str]:
    """Return the paths of the serial ports in --port, if there are any. Raises InputError for an empty path."""
    port: str = args.port or ""
    paths = [] if host_clocked(args) or _own(args) else port.split(",")
    if port and "" in paths:
        raise InputError(f"--port is {port!r}: path {paths.index('') + 1} of {len(paths)} is empty")
    return paths


def host_clocked(args: argparse.Namespace) -> bool:
    """Return whether --port names a device without a clock, so that the host times its ticks."""
    return (args.port or "").split(":")[0] == FORCE_DIMENSION


def _own(args: argparse.Namespace) -> bool:
    """Return whether --port names a user's own device, FILE.py:NAME."""
    return Path((args.port or "").split(":")[0]).suffix == ".py"


@dataclass(frozen=True)
class _Held:
    """The signals that arrived during a session, and the number of bytes that the ports did not accept."""

    signals: Sequence[int] = ()
    dropped: int = 0


def hold_session(
    args: argparse.Namespace,
    session: Session,
    plan: Callable[[Ages], Sequence[Armable]],
    seconds: float,
    out: Path,
    emulated: Scenario | None = None,
) -> _Held:
    """Run a session from opening the port to its end, or in virtual time; return its signals and lost bytes.

    `emulated` is the scenario of the emulated device; None for that of the options. A device is not armed if the lines
    before arming cannot be printed. Raises OSError if those before the first message to the device cannot be printed.
    """
    with ExitStack() as stack:
        if args.rehearse:
            return _rehearsed(args, session, plan, seconds, out, emulated)
        device = _device(args, session, stack)
        incidents = _logged(session, out)
        if args.port and not args.no_preflight:
            with progress("looking at this machine"):
                problems = preflight(_ports(args))
            console(args).print(problems, soft_wrap=True, highlight=False)
        keyboard = stack.enter_context(_keys()) if sys.stdin.isatty() else None
        on_terminal = sys.stderr.isatty()
        if on_terminal and keyboard is not None:
            console(args).print("keys: a arm · s stop · space e-stop · q quit")

        requested: set[str] = set()

        def watch(session: Session) -> None:
            incidents.update(session)
            if session.request and session.request not in requested:
                requested.add(session.request)
                _clear()
                console(args).print(session.request)
            if on_terminal:
                _show(session)

        def planned(ages: Ages) -> Sequence[Armable]:
            _clear()
            for path, own in zip(_ports(args), device.ages if isinstance(device, Boards) else (), strict=False):
                at = {p: round(float(np.percentile(own, p))) for p in (50, 99)}
                console(args).print(f"{path}: answers are {at[50]} us old, {at[99]} us at the 99th percentile")
            programs = plan(ages)
            if lost_output:
                raise SafetyStop("standard output cannot be written")
            return programs

        if lost_output:
            raise lost_output.pop()
        operator = Operator(args.arm, seconds, _deadman(args.deadman))
        live = Live(session, device, planned, operator, keyboard, watch, args.pace)
        stack.callback(_clear)
        live.run()
    return _Held(live.signals, device.dropped if isinstance(device, SerialDevice | Boards) else 0)


def _logged(session: Session, out: Path) -> IncidentLog:
    """Begin the incident log of a session whose port is open, and return it. A missing port leaves no log."""
    incidents = IncidentLog(out / "incidents.jsonl")
    incidents.attach(session)
    return incidents


def _device(args: argparse.Namespace, session: Session, stack: ExitStack) -> HapticDevice:
    scenario = axis_by_axis(options.scenario_from(args))  # The session of hw.identify assumes almost no damping.
    if host_clocked(args):
        axes = args.port.partition(":")[2] or None
        adapter = stack.enter_context(ForceDimension(scenario, axes, deadman=session.settings.deadman))
        if not adapter.guarded:
            console(args).print("the device has no watchdog: if this program is killed, the last force stays on")
        if adapter.unused_axes and not args.clamped:
            _ask_for_clamp("; ".join(adapter.unused_axes))
        return adapter
    if _own(args):
        return _own_device(args.port, scenario, stack)
    with progress("opening the port"):
        ports = [stack.enter_context(SerialPort(path, session.settings.baud)) for path in _ports(args)]
    serial = partial(SerialDevice, clock=lambda: args.pace * time.monotonic())
    if len(ports) == 1:
        return serial(ports[0])
    axes = [len(device.free) for device in session.scenario.device]
    devices = [serial(port, patience=0.0) for port in ports]
    now = lambda: int(args.pace * time.monotonic_ns()) // 1000  # noqa: E731
    return Boards(devices, axes, session.settings.behind, now, lambda seconds: _wait_for_any(ports, seconds))


def _own_device(text: str, scenario: Scenario, stack: ExitStack) -> HapticDevice:
    """Return the device that NAME of FILE.py makes for the scenario. Raises InputError if it lacks a call."""
    make = named("--port", text)
    if not callable(make):
        raise InputError(f"--port {text} is {make!r}, expected a class or function that takes a scenario")
    device: Any = called(f"--port {text}", make, scenario)
    if hasattr(device, "__enter__") and hasattr(device, "__exit__"):
        device = stack.enter_context(device)
    lacking = [name for name in ("info", "configure", "exchange", "stop", "errors") if not hasattr(device, name)]
    if lacking:
        raise InputError(f"--port {text} makes {device!r} without {', '.join(lacking)}: see hw/haptic_device.py")
    return device


def _wait_for_any(ports: Sequence[SerialPort], seconds: float) -> None:
    select.select(ports, [], [], seconds)


def _ask_for_clamp(axes: str) -> None:
    """Ask whether a mechanical clamp holds these axes. Raises InputError for "no", and without a terminal."""
    library = "the library's regulation (drd) locks x, y and z of a device only together"
    if sys.stdin.isatty():
        answer = input(f"No channel drives {axes}; {library}. Does a mechanical clamp hold the undriven axes? [y/n] ")
        if answer.strip().lower() in ("y", "yes"):
            return
    ways = "clamp them mechanically and give --clamped, or hold them by springs, as --scenario omega-held does"
    raise InputError(f"--port: no channel drives {axes}; {library}: {ways}")


def _rehearsed(
    args: argparse.Namespace,
    session: Session,
    plan: Callable[[Ages], Sequence[Armable]],
    seconds: float,
    out: Path,
    emulated: Scenario | None,
) -> _Held:
    """Run the session in virtual time; the emulated person arms once and holds the dead-man switch."""
    faults = tuple(FaultInjection.parse(text) for text in args.fault)
    with options.refused("the scenario cannot run behind a serial link: "):
        emulator = Emulator(axis_by_axis(emulated or options.scenario_from(args)), faults)
    incidents = _logged(session, out)
    with progress("rehearsing") as move:

        def planned(ages: Ages) -> Sequence[Armable]:
            move(0, 1, "designing the coupling")
            return plan(ages)

        def watch(session: Session) -> None:
            incidents.update(session)
            if session.now % _SHOWN_US < 1000:
                move(session.now, round(1e6 * (1 + seconds)), f"rehearsing: {session.stage}")

        operator = Operator(True, seconds)
        Rehearsal(
            session, emulator, planned, faults, args.seed, operator=operator, keep=False, watch=watch
        ).run_to_the_end(seconds + _SPARE)
    return _Held()


def _show(session: Session) -> None:
    """Overwrite the status line, unless the terminal would block."""
    words, drive, counters = [str(session.stage)], session.drive, session.counters
    request = [session.request] if session.request else []
    if session.stage == Stage.MEASURING:
        words.append(f"{len(session.measurement.result.values)} of {session.settings.measure} answers")
    elif session.stage == Stage.MEASURED:
        words.append("designing the coupling")
    elif drive and drive.x:
        words += request + [f"{1e3 * x:+.3f} mm {f:+.3f} N" for x, f in zip(drive.x, drive.force, strict=True)]
        words.append(f"gain {session.gain:.2f}")
    elif session.info and session.link.last:
        words += [f"{1e3 * x:+.3f} mm" for x in session.units.positions(session.link.last.counts)] + request
    words += [f"margin {margin} us"] if (margin := session.link.least_margin) is not None else []
    words += [f"{name} {n}" for name in _SHOWN if (n := getattr(counters, name))]
    line = in_unit(" · ".join(words))[: shutil.get_terminal_size().columns - 1]
    if select.select([], [sys.stderr], [], 0)[1]:
        os.write(sys.stderr.fileno(), f"\r\x1b[K{line}".encode())


def _clear() -> None:
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


@contextmanager
def _keys() -> Iterator[int]:
    """Switch the terminal to single keys, and yield the file descriptor of standard input."""
    keyboard = sys.stdin.fileno()
    before: list[Any] = termios.tcgetattr(keyboard)
    tty.setcbreak(keyboard, termios.TCSANOW)
    try:
        yield keyboard
    finally:
        with suppress(termios.error):  # The terminal may be closed.
            termios.tcsetattr(keyboard, termios.TCSANOW, before)
