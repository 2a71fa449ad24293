"""The four calls to a device that a session needs. `Driver` in hw/driver.py makes them.

There are three implementations: a device at a serial port (docs/protocol.md), several of them (hw/boards.py), and
devices that the host clocks (hw/force_dimension.py); users write others (docs/extending.md). A call waits for at most
0.5 ms, or to the end of the tick if the host is the clock, because keys, signals and time-outs are handled between two
calls.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from haptic_loop.hw import protocol as wire

_RESEND = 0.1  # [s] time after which an unanswered question is sent again
_STOPPING = 0.05  # [s] longest time after the first CONFIG for which the device may drive
LONGEST_WAIT = 5e-4  # [s] longest wait of one call


class PortLost(OSError):
    """The port or the device no longer answers."""


class HapticDevice(Protocol):
    """A device that can be driven. Positions are in counts and forces in steps, whose units INFO states."""

    @property
    def errors(self) -> int:
        """Number of frames that could not be read."""
        ...

    def info(self) -> wire.Info | None:
        """Return the device's INFO, or None until it has come."""
        ...

    def configure(self, config: wire.Config) -> int | None:
        """Send a configuration. Return Refused.ACCEPTED or the reason for a refusal.

        Return None until an answer comes, and while the device ramps its force to zero (Refused.RUNNING).
        """
        ...

    def exchange(self, force: wire.Force | None) -> wire.State | None:
        """Send the force that answers the last STATE, if any, and return the next STATE, if one comes."""
        ...

    def stop(self, reason: wire.Reason) -> None:
        """Bring the device to zero force: by its ramp, or at once for an emergency stop."""
        ...


class _BytePort(Protocol):
    """A port for bytes. If the port is gone, `read` raises PortLost; `write` and `discard` may raise it, too."""

    def wait(self, seconds: float) -> bool:
        """Wait for bytes for at most `seconds`, and return whether there are any."""
        ...

    def read(self) -> bytes: ...
    def write(self, data: bytes) -> int:
        """Send bytes, and return how many were sent."""
        ...

    def discard(self) -> None:
        """Discard the bytes that have come."""
        ...


class SerialDevice:
    """A device at a serial port. The device has the clock, not the host."""

    def __init__(
        self, port: _BytePort, clock: Callable[[], float] = time.monotonic, patience: float = LONGEST_WAIT
    ) -> None:
        """Take `clock` and `patience`, the longest wait of a call, both in seconds."""
        self._port, self._clock, self._patience = port, clock, patience
        self._decoder, self._waiting = wire.Decoder(), list[wire.Message]()
        self._question: wire.Hello | wire.Config | None = None
        self._begun = self._asked = 0.0  # [s] times at which the question was sent first, and last
        self.dropped = 0  # bytes that the port did not accept

    @property
    def errors(self) -> int:
        return self._decoder.rejected

    def info(self) -> wire.Info | None:
        answer = self._answer(wire.Hello())
        return answer if isinstance(answer, wire.Info) else None

    def configure(self, config: wire.Config) -> int | None:
        """Send CONFIG every 0.1 s until the device accepts it, or refuses it for another reason than RUNNING.

        Raises SafetyStop if the device still drives 50 ms after the first CONFIG.
        """
        answer, crc = self._answer(config), wire.config_crc(config)
        if isinstance(answer, wire.Ack) and answer.crc == crc and answer.refused != wire.Refused.RUNNING:
            self._question = None
            return answer.refused
        return None

    def exchange(self, force: wire.Force | None) -> wire.State | None:
        if force is not None:
            self.send(force)
        message = self._next()  # one message per call, so that a flood of other frames delays no time-out
        return message if isinstance(message, wire.State) else None

    def send(self, force: wire.Force) -> None:
        """Send a force without waiting."""
        self._write(wire.encode(force))

    def stop(self, reason: wire.Reason) -> None:
        self._write(wire.encode(wire.Stop(reason)))

    def _answer(self, question: wire.Hello | wire.Config) -> wire.Message | None:
        """Repeat a question and return the next message, if any. Send STOP to a device that drives meanwhile."""
        now = self._clock()
        if question != self._question:  # earlier bytes cannot answer this question
            self._port.discard()
            self._waiting.clear()
            self._question, self._begun, self._asked = question, now, now - _RESEND
        if now - self._asked >= _RESEND:
            self._asked = now
            self._write(b"\0" + wire.encode(question))  # the zero ends an incomplete frame on the line
        message = self._next()
        if isinstance(message, wire.State) and message.drives:
            self.stop(wire.Reason.FAULT)
            if isinstance(question, wire.Config) and now - self._begun > _STOPPING:
                raise wire.SafetyStop("the device drives without a command")
        return message

    def _next(self) -> wire.Message | None:
        if not self._waiting and self._port.wait(self._patience):
            self._waiting += self._decoder.feed(self._port.read())
        return self._waiting.pop(0) if self._waiting else None

    def _write(self, data: bytes) -> None:
        self.dropped += len(data) - self._port.write(data)
