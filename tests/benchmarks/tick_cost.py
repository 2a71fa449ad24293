"""PYTHONPATH=. python tests/benchmarks/tick_cost.py [TICKS]: measure the CPU time of a tick of the host.

A whole tick is one pass of the armed bridge's loop over a pseudo-terminal. It begins when the device's STATE frame can
be read, and ends at the next wait, after writing the FORCE frame. A bare tick decodes a STATE, steps the controller,
and encodes a FORCE. Blocks of 200 ticks alternate: in one the whole tick is timed, in the next an added bare tick and
the writing of FORCE. Times are CPU times of this thread. The emulated device runs in this thread while the host waits.
"""

from __future__ import annotations

import gc
import os
import select
import statistics
import sys
import time
from collections import defaultdict

from haptic_loop.hw.control import CouplingRequest, certified_couplings
from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import Emulator
from haptic_loop.hw.haptic_device import SerialDevice
from haptic_loop.hw.limits import ENDED, Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.protocol import Command, Decoder, Force, State, encode
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import session_for
from haptic_loop.hw.transport import Live, SerialPort
from haptic_loop.sim.scenario import load
from tests.checks.faults import _lively
from tests.pseudo_terminal import Terminal

BLOCK = 200
PATIENCE = 5.0  # [s] longest wait for bytes to pass the pseudo-terminal


class _Bench(SerialPort):
    """A port whose device ticks whenever the host waits."""

    def __init__(self) -> None:
        self.scenario = _lively(load())
        self.far, self._emulator = Terminal(), Emulator(self.scenario)
        super().__init__(self.far.path, None)
        self.made = certified_couplings(CouplingRequest(self.scenario), 1, spare=0)
        self.session = session_for(self.scenario, LinkSettings(measure=60))
        self.session.record = Recorder(self.scenario.channels)
        self.law, self._decoder = self.made[0].controller(self.session.limits.cap), Decoder()
        self.clock, self._period = 0, round(1e6 * self.scenario.T)  # [us]
        self._begun, self._told, self._number = 0, False, 0
        self.times = defaultdict[str, list[float]](list)  # [us]

    def wait(self, seconds: float) -> bool:
        spent = time.thread_time_ns() - self._begun
        armed, whole = self.session.stage == Stage.ARMED, self._number % (2 * BLOCK) < BLOCK
        if armed and self._told and whole:
            self.times["whole"].append(1e-3 * spent)
        if self._told:
            select.select([self.far.master], [], [], PATIENCE)
        self._emulator.receive(self.far.read(), self.clock + 200)
        self.clock += self._period
        self._number += 1
        data = self._emulator.tick(self.clock)
        self._emulator.advance()
        if data:
            self.far.write(data)
            select.select([self._fd], [], [], PATIENCE)
        if armed and not whole:
            begun = time.thread_time_ns()
            (state,) = self._decoder.feed(data)
            assert isinstance(state, State)
            units, cap = self.session.units, (1,) * state.axes
            steps = units.steps(self.law.step(units.positions(state.counts)), cap)
            encode(Force(Command.RUN, (state.tick + 1) & 0xFFFF, state.tick, steps))
            self.times["bare"].append(1e-3 * (time.thread_time_ns() - begun))
        self._begun = time.thread_time_ns()
        self._told = super().wait(0.0)
        return self._told

    def write(self, data: bytes) -> int:
        if self._number % (2 * BLOCK) < BLOCK:
            return super().write(data)
        begun = time.thread_time_ns()
        sent = super().write(data)
        self.times["write"].append(1e-3 * (time.thread_time_ns() - begun))
        return sent


def tick_cost(ticks: int) -> dict[str, list[float]]:
    """Return times [us] of about `ticks` whole ticks at full gain, `ticks` bare ones, and of writing a FORCE."""
    with _Bench() as port:
        session = port.session
        live = Live(session, SerialDevice(port), lambda ages: port.made, Operator(True, 3600.0))
        live.clock = lambda: port.clock  # the emulated device's clock, because ticks take longer here than T
        session.start(0)
        gc.collect()
        gc.freeze()
        gc.disable()
        while len(port.times["bare"]) < ticks:
            live.turn()
            if session.stage in ENDED:
                raise RuntimeError(f"the session ended: {session.cause}")
    port.far.unplug()
    return port.times


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    times = tick_cost(int(sys.argv[1]) if sys.argv[1:] else 4000)
    for name in ("bare", "whole", "write"):
        late = sorted(times[name])[len(times[name]) * 99 // 100]
        print(f"{name}: median {statistics.median(times[name]):.1f} us, 99th percentile {late:.0f} us")
    bare, whole, write = (statistics.median(times[name]) for name in ("bare", "whole", "write"))
    print(f"whole over bare: {whole / bare:.2f}; whole without the write: {whole - write:.1f} us")
