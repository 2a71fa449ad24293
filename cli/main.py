"""Run the commands: as haptic-loop COMMAND, and as python -m sim.run and other modules, which call `run_command`.

This module imports nothing that takes time, so that Ctrl-C is handled and the process that draws the picture
(cli.painter) starts at once.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from importlib import import_module

TYPE_CHECKING = False  # Importing it from typing takes time.
if TYPE_CHECKING:
    from types import ModuleType
    from typing import Any, NoReturn

#: command -> (module of python -m, purpose); the file of the same name in this folder has the code
COMMANDS = {
    "audit": ("design.audit", "judge whether gains are safe, and with what margin"),
    "design": ("design", "design a coupling, prove its certificate and store both"),
    "run": ("sim.run", "close the loop once: stability, transparency and error"),
    "validate": ("sim.validate", "test with random passive humans in both engines; search for the worst human"),
    "bridge": ("hw.bridge", "drive a device with a certified coupling"),
    "zwidth": ("sim.zwidth", "draw the Z-width map: which springs and dampers are safe"),
    "view": ("sim.view", "show the loop in a window, or film it"),
    "trace": ("sim.trace", "measure how oscillations grow in a stored trace"),
    "accuracy": ("sim.accuracy", "compare speed and error of the engines"),
    "check": ("design.check", "prove a stored coupling again, from its file alone"),
    "compare": ("design.compare", "compare couplings with the same devices and hands"),
    "export": ("design.export", "write a stored coupling as C99"),
    "identify": ("hw.identify", "measure mass, damping and transmission of a device"),
    "replay": ("hw.replay", "feed a recorded session through the controller again"),
}


_LEADING = 5  # number of commands that --help shows first


def run_command(command: str) -> NoReturn:
    """Run a command with the arguments of the command line."""
    _run(command, sys.argv[1:])


def main() -> NoReturn:
    """Run the console script."""
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        lines = [f"  {name:{width}}  {what} ({module})" for name, (module, what) in COMMANDS.items()]
        print("usage: haptic-loop COMMAND [options], or python -m MODULE [options]; --help after either\n")
        print("\n".join([*lines[:_LEADING], "\nfurther commands:", *lines[_LEADING:]]))
        sys.exit(0)
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"haptic-loop {version('haptic-loop')}")
        sys.exit(0)
    _run(words[0], words[1:])


def _leave(number: int, frame: Any) -> NoReturn:
    """Leave at Ctrl-C before the command begins, when there is nothing to clean up."""
    try:
        os.write(2, b"interrupted\n")
    finally:
        os._exit(130)


def _run(command: str, words: list[str]) -> NoReturn:
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # False after nohup
    if interruptible:
        signal.signal(signal.SIGINT, _leave)
    # Commands do not use the OpenGL backend that MUJOCO_GL names; sim.view opens a context itself. Importing the
    # backend takes longer than the rest of MuJoCo, and fails if it is not installed.
    os.environ["MUJOCO_GL"] = "disable"
    from haptic_loop.cli import painter

    if command == "run" and not {"--no-plot", "-h", "--help"} & {*words}:
        painter.begin()
    atexit.register(gc.freeze)  # This prevents a last search for garbage, which takes 0.1 s.
    from haptic_loop.cli.execute import execute  # This import loads NumPy.
    from haptic_loop.design import forked

    forked.allowed = True
    execute(lambda argv: _command(command).main(argv), words, interruptible)


def _command(name: str) -> ModuleType:
    if name not in COMMANDS:
        from haptic_loop.cli.options import did_you_mean
        from haptic_loop.sim.scenario import InputError

        raise InputError(f"unknown command {name!r}{did_you_mean(name, COMMANDS) or ', --help lists them'}")
    return import_module(f"haptic_loop.cli.{name}")
