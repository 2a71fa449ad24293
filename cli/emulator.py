"""python -m hw.emulator: the scenario's devices behind a pseudo-terminal, with the firmware's own state machine."""

from __future__ import annotations

import argparse
import gc
import json
import os
import signal
import sys
from typing import Any

from cli.options import DONE, INTERRUPTED, Parser, add_loop_options, numbers, scenario_from, seed_from
from cli.session_cli import pace_from
from hw.emulator import AXIS, DEVICE, LINE, Emulator, FaultInjection, Line, RealTimeEmulator, Terminal, nobody
from sim.scenario import InputError, require_constant_delay, require_even_ticks, require_linear


def main(argv: list[str]) -> int:
    """Emulate until told to stop. 0: the time was over or the cable was pulled, 130: interrupted."""
    args = _parser().parse_args(argv)
    scenario, seed = scenario_from(args), seed_from(args)
    require_linear(scenario, "hw.emulator")
    require_constant_delay(scenario, "hw.emulator")
    require_even_ticks(scenario, "hw.emulator")
    faults = tuple(FaultInjection.parse(text) for text in args.fault)
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
        emulator = Emulator(nobody(scenario) if args.nobody else scenario, faults, coulomb=coulomb)
    except ValueError as error:
        raise InputError(f"the scenario cannot stand behind a serial link: {error}") from None
    terminal, stops = Terminal(), []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, frame: stops.append(received))
    print(terminal.path, flush=True)
    up, down = (Line(direction, faults, seed) for direction in ("up", "down"))
    running = RealTimeEmulator(emulator, terminal, up, down, scenario.T, pace)
    gc.collect()
    gc.freeze()
    gc.disable()
    running.run(seconds, lambda: bool(stops) or parent not in (0, os.getppid()))
    print(json.dumps(_summary(running)), file=sys.stderr)
    return INTERRUPTED if signal.SIGINT in stops else DONE


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
    parser = Parser(
        "hw.emulator",
        "The scenario's devices behind a pseudo-terminal; prints its path, which hw.bridge --port takes.",
        "python -m hw.emulator --fault up:drop=0.05 --fault unplug@3",
    )
    add_loop_options(parser)
    kinds = ", ".join((*LINE, *DEVICE, *AXIS))
    what = "KIND[=VALUE][@START[+DURATION]], times in seconds after arming; in front up: or down: for one direction, "
    what += "axis2: for an axis"
    parser.add_argument("--fault", action="append", default=[], metavar="FAULT", help=f"{what}; KIND is {kinds}")
    parser.add_argument("--duration", default="1000000", metavar="SECONDS", help="default: until interrupted")
    parser.add_argument("--nobody", action="store_true", help="no person at the handles")
    parser.add_argument("--coulomb", default="0", metavar="NEWTON", help="dry friction at every motor (default 0)")
    parser.add_argument("--pace", default="1", metavar="P", help="slow motion for busy machines (default 1; host too)")
    parser.add_argument("--parent", default="0", metavar="PID", help="end with this process, which must be the parent")
    parser.add_argument("--seed", metavar="N", default="0", help="for the faults (default 0)")
    return parser
