"""python -m hw.emulator: the scenario's devices behind a pseudo-terminal, with the firmware's own state machine."""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import sys
from typing import Any

from haptic_loop.cli import options
from haptic_loop.cli.session_cli import add_pace_option, steady_scenario
from haptic_loop.hw.emulator import KINDS, Emulator, FaultInjection, Line, RealTimeEmulator, Terminal, nobody
from haptic_loop.sim.scenario import InputError


def main(argv: list[str]) -> int:
    """Emulate until a signal comes. 0: the time was over or the cable was pulled, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario = steady_scenario(args, "hw.emulator")
    faults = tuple(FaultInjection.parse(text) for text in args.fault)
    if args.duration <= 0:
        raise InputError(f"--duration is {args.duration:g}, allowed are numbers above 0 up to 1000000 s")
    if args.parent not in (0, os.getppid()):
        raise InputError(f"--parent is {args.parent}, but this process is a child of {os.getppid()}")
    with options.refused("the scenario cannot stand behind a serial link: "):
        emulator = Emulator(nobody(scenario) if args.nobody else scenario, faults, coulomb=args.coulomb)
    terminal, stops = Terminal(), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: stops.append(received))
    print(terminal.path, flush=True)
    up, down = (Line(direction, faults, args.seed) for direction in ("up", "down"))
    running = RealTimeEmulator(emulator, terminal, up, down, scenario.T, args.pace)
    gc.collect()
    gc.freeze()
    gc.disable()
    running.run(args.duration, lambda: bool(stops) or args.parent not in (0, os.getppid()))
    print(json.dumps(_summary(running)), file=sys.stderr)
    return options.INTERRUPTED if signal.SIGINT in stops else options.DONE


def _summary(running: RealTimeEmulator) -> dict[str, Any]:
    device = running.emulator.device
    return {
        "ticks_held_up": running.late,
        "phase": device.phase.name.lower(),
        "cause": device.cause.name.lower(),
        "misses": device.misses,
        "frames_rejected": device.decoder.rejected,
    }


def _parser() -> argparse.ArgumentParser:
    parser = options.Parser(
        "hw.emulator",
        "The scenario's devices behind a pseudo-terminal; prints its path, which hw.bridge --port takes.",
        "python -m hw.emulator --fault up:drop=0.05 --fault unplug@3",
    )
    add, number = parser.add_argument, options.number
    parser.add_loop()
    what = "KIND[=VALUE][@START[+DURATION]], times in seconds after arming; in front up: or down: for one direction, "
    what += f"axis2: for an axis; KIND is {', '.join(KINDS)}"
    add("--fault", action="append", default=[], metavar="FAULT", help=what)
    end = "length of the emulation (default: until interrupted)"
    add("--duration", type=number(0, 1e6, "s"), default=1e6, metavar="SECONDS", help=end)
    add("--nobody", action="store_true", help="no person at the handles")
    rub = "dry friction at every motor (default 0)"
    add("--coulomb", type=number(0, 10, "N"), default=0.0, metavar="NEWTON", help=rub)
    add_pace_option(parser, "slow motion for busy machines, as the host's (default 1)")
    parent = "end with this process, which must be the parent"
    add("--parent", type=options.whole(), default=0, metavar="PID", help=parent)
    add("--seed", type=options.whole(0), metavar="N", default=0, help="for the faults (default 0)")
    return parser
