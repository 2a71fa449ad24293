"""haptic-loop COMMAND: every command under one name; python -m sim.run and its like are doors to the same."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import NoReturn

from cli.options import execute
from sim.scenario import InputError

#: command -> what python -m calls it, and what it is for; it lives in the file of its name in this folder
COMMANDS = {
    "run": ("sim.run", "close the loop once: stability, transparency and error"),
    "validate": ("sim.validate", "random passive humans in both engines, and a search for the worst"),
    "zwidth": ("sim.zwidth", "the Z-width map: which springs and dampers are safe"),
    "view": ("sim.view", "feel the loop in a window, or film it"),
    "trace": ("sim.trace", "what grows in a stored trace"),
    "accuracy": ("sim.accuracy", "speed against error, engine by engine"),
    "suite": ("sim.suite", "every check that a verdict rests on, in one report"),
    "design": ("design", "design a coupling, prove its certificate and store both"),
    "audit": ("design.audit", "are these gains safe, and how far"),
    "check": ("design.check", "prove a stored coupling again, from its file alone"),
    "compare": ("design.compare", "couplings side by side, the ladder, the limits of any coupling"),
    "export": ("design.export", "a stored coupling as C99, plain data or a python-control block"),
    "bridge": ("hw.bridge", "drive a device over a serial port"),
    "emulator": ("hw.emulator", "an emulated device behind a pseudo-terminal"),
    "identify": ("hw.identify", "mass, damping and transmission of a device from a measurement"),
    "replay": ("hw.replay", "a recorded session through the controller again"),
}


def door(command: str) -> NoReturn:
    """Run the command of this name with the words of the command line."""
    execute(lambda argv: import_module(f"cli.{command}").main(argv))


def main() -> NoReturn:
    """The console script."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print("usage: haptic-loop COMMAND [options], or python -m MODULE [options]; --help after either\n")
        print("\n".join(f"  {name:{width}}  {what} ({module})" for name, (module, what) in COMMANDS.items()))
        sys.exit(0)
    execute(lambda argv: _command(argv[0]).main(argv[1:]))


def _command(name: str) -> ModuleType:
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r}, allowed are {', '.join(COMMANDS)}")
    return import_module(f"cli.{name}")
