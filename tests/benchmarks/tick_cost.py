"""PYTHONPATH=. python tests/benchmarks/tick_cost.py [TICKS]: what a tick costs the host, beside the bare loop.

Blocks of 200 ticks by turns. Bare: a STATE is decoded, one matrix product, a FORCE encoded. Whole: the bridge's own
loop over a pseudo-terminal, from the STATE that waits there to the FORCE that was written, with every check and record.
Times are those of the processor, without what others have of it.
The device at the other end is the emulated one, ticked between two measurements.
"""

from __future__ import annotations

import gc
import os
import statistics
import sys
import time

import numpy as np

from hw.control import certified_couplings
from hw.emulator import Emulator, Terminal
from hw.faults import lively
from hw.limits import ENDED, Stage
from hw.monitor import LinkSettings
from hw.protocol import Command, Decoder, Force, State, encode
from hw.recording import Recorder
from hw.seam import SerialDevice
from hw.session import session_for
from hw.transport import Live, SerialPort
from sim.scenario import load

BLOCK = 200


def tick_cost(ticks: int) -> tuple[list[float], list[float]]:
    """Times [us] of bare and of whole ticks at full gain."""
    scenario = lively(load())
    made = certified_couplings(scenario, "I", None, None, 1, spare=0)
    session, terminal, emulator = session_for(scenario, LinkSettings(measure=60)), Terminal(), Emulator(scenario)
    session.record = Recorder(scenario.channels)
    port = SerialPort(terminal.path, None)
    live = Live(session, SerialDevice(port), lambda ages: made, True, 3600.0)
    clock = [0]
    live.clock = lambda: clock[0]  # the clock of the ticks: what is measured here takes longer than they do
    controller, decoder = made[0].controller(session.limits.cap), Decoder()
    bare, whole = [], []
    wait = port.wait
    patience = [1e-3]
    port.wait = lambda seconds: wait(patience[0])
    session.start(0)
    live.turn()
    gc.collect()
    gc.freeze()
    gc.disable()
    period = round(1e6 * scenario.T)
    number = 0
    while len(whole) < ticks:
        clock[0] += period
        emulator.receive(terminal.read(), clock[0] - 1000)
        data = emulator.tick(clock[0] - 1000)
        emulator.advance()
        if number % (2 * BLOCK) >= BLOCK and session.stage == Stage.ARMED:
            begun = time.thread_time_ns()
            (state,) = decoder.feed(data)
            assert isinstance(state, State)
            force = np.clip(-controller.step(session.units.positions(state.counts)) / 4e-4, -1, 1).astype(int).tolist()
            encode(Force(Command.RUN, (state.tick + 1) & 0xFFFF, state.tick, tuple(force)))
            bare.append(1e-3 * (time.thread_time_ns() - begun))
        if data:
            terminal.write(data)
        begun = time.thread_time_ns()
        live.turn()  # takes the STATE
        patience[0] = 0.0
        live.turn()  # gives the FORCE, and finds no other
        patience[0] = 1e-3
        if session.stage in ENDED:
            raise RuntimeError(f"the session ended: {session.cause}")
        if session.stage == Stage.ARMED and number % (2 * BLOCK) < BLOCK:
            whole.append(1e-3 * (time.thread_time_ns() - begun))
        number += 1
    port.__exit__()
    terminal.unplug()
    return bare, whole


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for name, times in zip(("bare", "whole"), tick_cost(int(sys.argv[1]) if sys.argv[1:] else 4000), strict=True):
        late = sorted(times)[len(times) * 99 // 100]
        print(f"{name}: median {statistics.median(times):.1f} us, 99th percentile {late:.0f} us")
