"""python -m hw.emulator: the scenario's devices behind a pseudo-terminal, with the firmware's own state machine.

Its timer keeps real time and never catches up: where this process was held up, the missed time is taken out of the
device's clock, since catching up would look to the host like answers that came too late.
"""

from __future__ import annotations

import argparse
import gc
import heapq
import json
import os
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from typing import Any

from cli.options import (
    DONE,
    INTERRUPTED,
    Parser,
    add_loop_options,
    execute,
    numbers,
    scenario_from,
    seed_from,
)
from hw.emulator.child import pace_from
from hw.emulator.core import Emulator
from hw.emulator.plant import nobody
from hw.emulator.upset import DEVICE, LINE, Line, Upset
from sim.scenario import InputError, require_constant_delay, require_linear

LINGER_US = 50_000  # after the cable was pulled: the device comes to rest by itself


class Terminal:
    """A pseudo-terminal whose far end a host can open by its path."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        self.path = os.ttyname(self._slave)
        tty.setraw(self._slave, termios.TCSANOW)
        os.set_blocking(self.master, False)

    def read(self) -> bytes:
        try:
            return os.read(self.master, 4096)
        except OSError:  # nothing there, or nobody
            return b""

    def write(self, data: bytes) -> None:
        with suppress(OSError):  # nobody reads: a cable keeps nothing either
            os.write(self.master, data)

    def unplug(self) -> None:
        """Close both ends: whoever has the path open sees the device disappear."""
        for end in (self.master, self._slave):
            os.close(end)


class Clockwork:
    """The emulator in real time."""

    def __init__(self, emulator: Emulator, terminal: Terminal, up: Line, down: Line, T: float, pace: float) -> None:
        self.emulator, self.terminal = emulator, terminal
        self._up, self._down = up, down
        self._period, self._pace = 1e6 * T, pace
        self._start = time.monotonic_ns()
        self._lost = 0.0  # [us] that this process was held up
        self.late = 0  # ticks that began more than half a period late
        self._queue: list[tuple[float, int, Callable[[bytes], None], bytes]] = []
        self._number = count()
        self._partial = b""

    def now(self) -> float:
        """The device's clock [us]."""
        return (time.monotonic_ns() - self._start) * self._pace / 1000 - self._lost

    def run(self, seconds: float, asked_to_stop: Callable[[], bool]) -> None:
        """Tick until the time is over, the cable is pulled or somebody stops it."""
        due, unplugged_at = self._period, None
        while not asked_to_stop() and self.now() < 1e6 * seconds:
            self._wait(due)
            now = self.now()
            if now < due:
                continue
            if not self.emulator.unplugged:
                self._hear(self.terminal.read(), due)  # what came while this process was held up is not late
            if now - due > self._period / 2:  # held up: the device's timer was not
                self.late += 1
                self._lost += now - due
            self._send(self.emulator.tick(round(due)), due)
            self.emulator.advance()
            due = max(due + self._period * self.emulator.stretch, self.emulator.stalled_until)
            if self.emulator.unplugged and unplugged_at is None:
                unplugged_at = due
                self.terminal.unplug()
            if unplugged_at is not None and due > unplugged_at + LINGER_US:
                return

    def _wait(self, due: float) -> None:
        """Until the next tick is due or bytes come or go, and see to those first."""
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
        for frame in frames:
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


def main(argv: list[str]) -> int:
    """Emulate until told to stop. 0: the time was over or the cable was pulled, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario, seed = scenario_from(args), seed_from(args)
    require_linear(scenario, "hw.emulator")
    require_constant_delay(scenario, "hw.emulator")
    upsets = tuple(Upset.parse(text) for text in args.fault)
    seconds = numbers("--duration", args.duration, float, 1)[0]
    if not 0 < seconds <= 1e6:
        raise InputError(f"--duration is {seconds:g}, allowed are numbers above 0 up to 1000000 s")
    coulomb = numbers("--coulomb", args.coulomb, float, 1)[0]
    if not 0 <= coulomb <= 10:
        raise InputError(f"--coulomb is {coulomb:g}, allowed are 0 to 10 N")
    pace, parent = pace_from(args), numbers("--parent", args.parent, int, 1)[0]
    if parent not in (0, os.getppid()):
        raise InputError(f"--parent is {parent}, but this process is a child of {os.getppid()}")
    try:
        emulator = Emulator(nobody(scenario) if args.nobody else scenario, upsets, coulomb=coulomb)
    except ValueError as error:
        raise InputError(f"the scenario cannot stand behind a serial link: {error}") from None
    terminal, stops = Terminal(), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: stops.append(received))
    print(terminal.path, flush=True)
    up, down = (Line(direction, upsets, seed) for direction in ("up", "down"))
    clockwork = Clockwork(emulator, terminal, up, down, scenario.T, pace)
    gc.collect()
    gc.freeze()
    gc.disable()
    clockwork.run(seconds, lambda: bool(stops) or parent not in (0, os.getppid()))
    print(json.dumps(_summary(clockwork)), file=sys.stderr)
    return INTERRUPTED if signal.SIGINT in stops else DONE


def _summary(clockwork: Clockwork) -> dict[str, Any]:
    device = clockwork.emulator.device
    return {
        "ticks_held_up": clockwork.late,
        "phase": device.phase.name.lower(),
        "cause": device.cause.name.lower(),
        "misses": device.misses,
        "frames_rejected": device.decoder.rejected,
    }


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        "hw.emulator",
        "The scenario's devices behind a pseudo-terminal; prints its path, which hw.bridge --port takes.",
        "python -m hw.emulator --fault up:drop=0.05 --fault unplug@3",
    )
    add_loop_options(parser)
    kinds = ", ".join((*LINE, *DEVICE))
    what = "KIND[=VALUE][@START[+DURATION]], times in seconds after arming; up: or down: in front for one direction"
    parser.add_argument("--fault", action="append", default=[], metavar="FAULT", help=f"{what}; KIND is {kinds}")
    parser.add_argument("--duration", default="1000000", metavar="SECONDS", help="default: until interrupted")
    parser.add_argument("--nobody", action="store_true", help="no person at the handles")
    parser.add_argument("--coulomb", default="0", metavar="NEWTON", help="dry friction at every motor (default 0)")
    parser.add_argument("--pace", default="1", metavar="P", help="slow motion for busy machines (default 1; host too)")
    parser.add_argument("--parent", default="0", metavar="PID", help="end with this process, which must be the parent")
    parser.add_argument("--seed", metavar="N", default="0", help="for the faults (default 0)")
    return parser


if __name__ == "__main__":
    execute(main)
