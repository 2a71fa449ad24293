"""The serial port, by pyserial: the only file that knows it. Nothing here waits."""

from __future__ import annotations

from contextlib import suppress
from typing import Self

from sim.scenario import InputError

CHUNK = 4096  # bytes read at once; a tick brings a few dozen
UNUSED = 9600  # baud that a port without UART is told: it does nothing, but 1200 resets many boards


class PortLost(OSError):
    """The device at the other end of the port is gone."""


class Port:
    """A port in raw mode: whole bytes in, whole bytes out, no echo, no flow control."""

    def __init__(self, path: str, baud: int | None) -> None:
        """Open `path` for ourselves alone, at `baud` where it has a UART. Raises InputError where that cannot be."""
        try:
            import serial
        except ImportError:
            raise InputError("--port needs pyserial: pip install 'haptic-loop[hw]'") from None
        self._error = serial.SerialException
        try:
            self._serial = serial.Serial(path, baud or UNUSED, timeout=0, write_timeout=0, exclusive=True)
        except (serial.SerialException, ValueError, OSError) as error:
            raise InputError(f"--port {path}: {error}") from None
        with suppress(Exception):  # where the driver knows it: the latency timer of FTDI chips goes from 16 ms to 1 ms
            self._serial.set_low_latency_mode(True)

    def fileno(self) -> int:
        """For select."""
        return self._serial.fileno()

    def read(self) -> bytes:
        """What is there. Raises PortLost."""
        try:
            return self._serial.read(CHUNK)
        except (self._error, OSError, TypeError) as error:  # TypeError: pyserial's own, on a port closed meanwhile
            raise PortLost(f"the port cannot be read: {error}") from None

    def write(self, data: bytes) -> int:
        """How many of these bytes could be sent without waiting. Raises PortLost."""
        try:
            return self._serial.write(data) or 0
        except (self._error, OSError, TypeError) as error:
            raise PortLost(f"the port cannot be written: {error}") from None

    def discard(self) -> None:
        """Forget what has come in. Raises PortLost."""
        try:
            self._serial.reset_input_buffer()
        except (self._error, OSError, TypeError) as error:
            raise PortLost(f"the port is gone: {error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(Exception):
            self._serial.close()
