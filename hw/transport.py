"""Run a session in real time, in one thread that waits only for the device, and open serial ports (pyserial).

A full garbage collection takes 30 ms with MuJoCo and SciPy loaded. So gc.freeze() excludes the loaded objects from
collections, and the collector is off during the session.
"""

from __future__ import annotations

import ctypes
import gc
import os
import select
import signal
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Self

from haptic_loop.hw.control import Armable
from haptic_loop.hw.driver import Driver, Operator
from haptic_loop.hw.haptic_device import HapticDevice, PortLost
from haptic_loop.hw.limits import ENDED, Stage
from haptic_loop.hw.monitor import Ages
from haptic_loop.hw.protocol import SafetyStop
from haptic_loop.hw.session import Session
from haptic_loop.sim.scenario import InputError

_CHUNK = 4096  # most bytes read at once; a tick brings a few dozen bytes
_UNUSED = 9600  # baud rate for a port without UART, where it has no effect; but 1200 resets many boards
_STALL_SECONDS, _STALL_MS = 2.0, 2.0  # duration of the measurement of stalls; the least stall that gives a warning
_GRACE_US = 50_000  # time after the end in which a lost STOP is repeated


class SerialPort:
    """A serial port in raw mode: eight-bit bytes, no echo, no flow control."""

    def __init__(self, path: str, baud: int | None) -> None:
        """Open `path` exclusively, at `baud` if it has a UART. Raises InputError if it cannot be opened."""
        try:
            import serial
        except ImportError:
            raise InputError("--port needs pyserial: pip install 'haptic-loop[hw]'") from None
        try:
            self._serial = serial.Serial(path, baud or _UNUSED, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            raise InputError(f"--port {path}: {error}") from None
        with suppress(Exception):  # some drivers lack it; on FTDI chips it sets the latency timer from 16 to 1 ms
            self._serial.set_low_latency_mode(True)
        self._path, self._fd = path, self._serial.fileno()

    def fileno(self) -> int:
        return self._fd

    def wait(self, seconds: float) -> bool:
        """Wait for bytes for at most `seconds`, and return whether there are any."""
        return bool(select.select([self._fd], [], [], seconds)[0])

    def read(self) -> bytes:
        """Return the bytes that have come, after wait() returned True. Raises PortLost.

        read() and write() use the file descriptor: pyserial's own calls take 31 us of every tick.
        """
        try:
            data = os.read(self._fd, _CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise PortLost(f"port {self._path} cannot be read: {error}") from None
        if not data:
            raise PortLost(f"port {self._path} cannot be read: it was hung up")
        return data

    def write(self, data: bytes) -> int:
        """Send bytes without waiting, and return how many were sent. Raises PortLost."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise PortLost(f"port {self._path} cannot be written: {error}") from None

    def discard(self) -> None:
        """Discard the bytes that have come. Raises PortLost."""
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)
        except termios.error as error:
            raise PortLost(f"port {self._path} is gone: {error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):
            self._serial.close()


def preflight(paths: Sequence[str]) -> str:
    """Return one line on how well this machine keeps time, with advice where it does not.

    The function requests real-time scheduling and locked memory, and measures for two seconds how late sleeps end.
    """
    checks = _scheduling(), _locked_memory(), *map(_latency_timer, paths), _stalls()
    return "pre-flight: " + "; ".join(checks)


def _stalls() -> str:
    """Measure the largest delay of a sleep of a millisecond."""
    worst, begun = 0.0, time.monotonic()
    last = begun
    while last < begun + _STALL_SECONDS:
        time.sleep(1e-3)
        now = time.monotonic()
        worst, last = max(worst, 1e3 * (now - last) - 1), now
    busy = " (close busy programs; use a real machine, not a virtual one)" if worst > _STALL_MS else ""
    return f"worst stall in {_STALL_SECONDS:g} s {worst:.1f} ms{busy}"


def _scheduling() -> str:
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(10))
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
    if policy in (os.SCHED_FIFO, os.SCHED_RR):
        return f"real-time scheduling, priority {os.sched_getparam(0).sched_priority}"
    return "no real-time scheduling (allow it: `rtprio 20` in /etc/security/limits.conf, or start with chrt -f 10)"


def _locked_memory() -> str:
    current, future = 1, 2
    if ctypes.CDLL(None).mlockall(current | future) == 0:
        return "memory locked"
    return "memory not locked (allow it: `memlock unlimited` in /etc/security/limits.conf)"


def _latency_timer(path: str) -> str:
    name = os.path.basename(os.path.realpath(path))
    try:
        with open(f"/sys/bus/usb-serial/devices/{name}/latency_timer") as file:
            ms = int(file.read())
    except (OSError, ValueError):
        return "no latency timer"
    return f"latency timer {ms} ms" + (f" (setserial {path} low_latency)" if ms > 1 else "")


class Live(Driver):
    """Run a session with a device until it ends, with a person at the keyboard."""

    def __init__(
        self,
        session: Session,
        device: HapticDevice,
        plan: Callable[[Ages], Sequence[Armable]],
        operator: Operator,
        keyboard: int | None = None,  # file descriptor of a terminal that delivers single keys
        watch: Callable[[Session], None] = lambda session: None,  # called ten times a second
        pace: float = 1.0,  # seconds of the session per second; 1 with any real device
    ) -> None:
        super().__init__(session, device, self._designed, lambda: int(time.monotonic_ns() * pace) // 1000)
        self._design, self._operator = plan, operator
        self._keyboard, self._watch = keyboard, watch
        self.signals: list[int] = []  # signals that came, to be handled between two exchanges
        self._watched = 0

    def run(self) -> Session:
        """Run the session from HELLO to its end. Stop the device before an exception is raised again."""
        session = self.session
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1)
        with _handled(numbers, lambda number, _: self.signals.append(number)), _no_collections():
            try:
                session.start(self.clock())
                while session.stage not in ENDED:
                    self.turn()
                ended = self.clock()
                while session.stage != Stage.LOST and self.clock() - ended < _GRACE_US:
                    super().turn()
            except BaseException as error:
                with suppress(PortLost):
                    cause = f"{type(error).__name__} in the host program: {error}"
                    self.do(session.end(Stage.STOPPED, cause, self.clock()))
                raise
        return session

    def turn(self) -> None:
        """Exchange messages with the device once, then handle keys, arming, the planned end and signals."""
        super().turn()
        try:
            self._steer(self.clock())
        except PortLost as lost:
            self.session.end(Stage.LOST, str(lost), self.clock())

    def _steer(self, now: int) -> None:
        session = self.session
        self._act_on_keys()
        if said := self._operator.decide(session, now):
            self.do(said)
        if self.signals and signal.SIGUSR1 in self.signals:
            self.do(session.estop("SIGUSR1", now))
        elif self.signals:
            first, *more = (signal.Signals(number).name for number in self.signals)
            cause = f"{first}, then {more[0]}" if more else first
            self.do(session.end(Stage.STOPPED, cause, now) if more else session.stop(cause, now))
        if now - self._watched > 100_000:
            self._watched = now
            self._watch(session)

    def _designed(self, ages: Ages) -> Sequence[Armable]:
        """Return the designed couplings, and act on keys typed meanwhile. Raises SafetyStop if SIGINT came."""
        self._watch(self.session)  # show the stage now, because the design takes a while
        try:
            with _handled([signal.SIGINT], signal.default_int_handler):  # No force acts during the design.
                programs = self._design(ages)
        except KeyboardInterrupt:
            self.signals.append(signal.SIGINT)
            raise SafetyStop("SIGINT during the design") from None
        self._act_on_keys()
        gc.collect()  # freeze the solver that the design has loaded
        gc.freeze()
        return programs

    def _act_on_keys(self) -> None:
        """Act on keys typed since the last call. A lost terminal counts as SIGHUP, because the person is gone."""
        if self._keyboard is None or not select.select([self._keyboard], [], [], 0)[0]:
            return
        keys = b""
        with suppress(OSError):
            keys = os.read(self._keyboard, 64)
        if not keys:
            self._keyboard = None
            self.signals.append(signal.SIGHUP)
        for key in keys.decode(errors="replace"):
            self.do(self._operator.press(key, self.session, self.clock()))


@contextmanager
def _handled(numbers: Sequence[int], handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Handle the signals `numbers` in this context by `handler`."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextmanager
def _no_collections() -> Iterator[None]:
    """Freeze all objects, and switch the garbage collector off in this context."""
    gc.collect()
    gc.freeze()
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if was_on:
            gc.enable()
