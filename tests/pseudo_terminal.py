"""An emulated device behind a pseudo-terminal, in real time and in a separate process."""

from __future__ import annotations

import argparse
import gc
import heapq
import json
import os
import select
import signal
import sys
import tempfile
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from forked import begin

from haptic_loop.hw.emulator import Emulator, FaultInjection, Line, nobody
from haptic_loop.sim.scenario import load

_PATIENCE = 60.0  # [s] longest wait for the emulator to begin, and to end
_LINGER_US = 50_000  # [us] time that the emulator runs on after the cable was pulled, so that the device comes to rest


class Terminal:
    """A pseudo-terminal that a host can open by its path."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        self.path = os.ttyname(self._slave)
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self.master, False)

    def read(self) -> bytes:
        try:
            return os.read(self.master, 4096)
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        with suppress(OSError):  # Without a reader the data are lost, as on a cable.
            os.write(self.master, data)

    def unplug(self) -> None:
        """Close both ends, so that the host sees the device disappear."""
        for end in (self.master, self._slave):
            os.close(end)


class RealTimeEmulator:
    """The emulator in real time. If this process is delayed, the lost time is subtracted from the device's clock."""

    def __init__(self, emulator: Emulator, terminal: Terminal, up: Line, down: Line, T: float, pace: float) -> None:
        self.emulator, self.terminal = emulator, terminal
        self._up, self._down = up, down
        self._period, self._pace = 1e6 * T, pace
        self._start = time.monotonic_ns()
        self._lost = 0.0  # [us] by which this process was delayed
        self.late = 0  # number of ticks that began more than half a period late
        self._queue: list[tuple[float, int, Callable[[bytes], None], bytes]] = []
        self._number = count()
        self._partial = b""

    def now(self) -> float:
        return (time.monotonic_ns() - self._start) * self._pace / 1000 - self._lost

    def run(self, seconds: float, must_stop: Callable[[], bool]) -> None:
        due, unplugged_at = self._period, None
        while not must_stop() and self.now() < 1e6 * seconds:
            self._wait(due)
            now = self.now()
            if now < due:
                continue
            if not self.emulator.unplugged:
                self._hear(self.terminal.read(), due)  # Bytes that arrived before this line count as on time.
            if now - due > self._period / 2:  # This process was delayed.
                self.late += 1
                self._lost += now - due
            self._send(self.emulator.tick(round(due)), due)
            self.emulator.advance()
            due = max(due + self._period * self.emulator.stretch, self.emulator.stalled_until)
            if self.emulator.unplugged and unplugged_at is None:
                unplugged_at = due
                self.terminal.unplug()
            if unplugged_at is not None and due > unplugged_at + _LINGER_US:
                return

    def _wait(self, due: float) -> None:
        """Wait until the next tick is due, or bytes arrive or are due, and handle these bytes."""
        first = min(due, self._queue[0][0]) if self._queue else due
        timeout = max(0.0, 1e-6 * (first - self.now()) / self._pace)
        if self.emulator.unplugged:
            time.sleep(timeout)
            return
        if select.select([self.terminal.master], [], [], timeout)[0]:
            self._hear(self.terminal.read(), min(self.now(), due))
        while self._queue and self._queue[0][0] <= self.now():
            _, _, deliver, data = heapq.heappop(self._queue)
            deliver(data)

    def _hear(self, data: bytes, now: float) -> None:
        *frames, self._partial = (self._partial + data).split(b"\0")
        if len(self._partial) > 4096:
            self._partial = b""
        for frame in filter(None, frames):
            for when, part in self._down.send(frame + b"\0", now, self.emulator.since_armed(round(now))):
                if when <= now:
                    self.emulator.receive(part, round(now))
                else:
                    self._later(when, lambda part: self.emulator.receive(part, round(self.now())), part)

    def _send(self, data: bytes, now: float) -> None:
        for when, part in self._up.send(data, now, self.emulator.since_armed(round(now))) if data else []:
            if when <= now:
                self.terminal.write(part)
            else:
                self._later(when, self.terminal.write, part)

    def _later(self, when: float, deliver: Callable[[bytes], None], data: bytes) -> None:
        heapq.heappush(self._queue, (when, next(self._number), deliver, data))


class EmulatorProcess:
    """An emulator in a separate process, started with `options`; `path` is its terminal."""

    def __init__(self, *options: str) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._errors = Path(self._folder.name, "err")
        path = Path(self._folder.name, "out")
        self._number = begin("tests.pseudo_terminal", *options, out=path, err=self._errors)
        assert _within(_PATIENCE, lambda: path.exists() and path.read_text().endswith("\n")), "no emulator started"
        self.path = path.read_text().strip()

    def end(self, patience: float = 0.0) -> dict[str, str]:
        """Return the final report on the device; end the process if it still runs after `patience` [s]."""

        def ended() -> bool:
            return self._errors.read_text().endswith("}\n")

        if not _within(patience, ended):
            os.kill(self._number, signal.SIGTERM)
            assert _within(_PATIENCE, ended), self._errors.read_text()
        report = json.loads(self._errors.read_text().splitlines()[-1])
        self._folder.cleanup()
        return report


def _within(seconds: float, true: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while not (done := true()) and time.monotonic() < end:
        time.sleep(0.005)
    return done


@contextmanager
def emulated(*options: str) -> Iterator[str]:
    """Yield the path of an emulator in a separate process."""
    emulator = EmulatorProcess(*options)
    try:
        yield emulator.path
    finally:
        emulator.end()


def main() -> None:
    """Print the path and emulate until a signal comes, the time is over or the cable is pulled."""
    parser = argparse.ArgumentParser(description="The devices of a scenario behind a pseudo-terminal.")
    parser.add_argument("--scenario", default="omega-pair")
    parser.add_argument("--fault", action="append", default=[])
    parser.add_argument("--duration", type=float, default=660.0)
    parser.add_argument("--pace", type=float, default=1.0)
    parser.add_argument("--parent", type=int, default=0)
    parser.add_argument("--nobody", action="store_true")
    args = parser.parse_args()
    scenario, faults = load(args.scenario), tuple(FaultInjection.parse(text) for text in args.fault)
    emulator, terminal, signals = Emulator(nobody(scenario) if args.nobody else scenario, faults), Terminal(), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: signals.append(received))
    print(terminal.path, flush=True)
    up, down = (Line(direction, faults, 0) for direction in ("up", "down"))
    running = RealTimeEmulator(emulator, terminal, up, down, scenario.T, args.pace)
    gc.collect()
    gc.freeze()
    gc.disable()
    running.run(args.duration, lambda: bool(signals) or args.parent not in (0, os.getppid()))
    print(json.dumps({"phase": emulator.device.phase.name.lower()}), file=sys.stderr)


if __name__ == "__main__":
    main()
