"""Ctrl-C before a command has begun: one line and exit code 130, as later, not the traceback of an import.

`python -m sim.run` imports the package `sim` first, then numpy and the rest: a second in which there is nothing to
keep. The packages that have commands call `while_starting` as their first act; sim.command.execute calls `begun`.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130  # 128 + SIGINT, as a shell has it

PACKAGES = ("design", "sim", "hw")


def while_starting() -> None:
    """From now on SIGINT ends the process, if it is one of our commands: those of others keep what they have."""
    if (
        starting() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):  # not where a parent has it ignored
        signal.signal(signal.SIGINT, _leave)


def starting() -> bool:
    """Whether this process is one of our commands that Python is still looking for."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1] if "-m" in words[:-1] else ""
    return sys.argv[:1] == ["-m"] and module.split(".")[0] in PACKAGES


def begun() -> None:
    """From now on SIGINT is a KeyboardInterrupt again: a command keeps what is done."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, b"interrupted\n")
    for child in _children():  # glfw, which mujoco imports, asks its library's version in one; it would complain
        os.kill(child, signal.SIGKILL)
    os._exit(INTERRUPTED)


def _children() -> list[int]:
    """The processes that the imports have started; none where the system does not tell (it is Linux that does)."""
    try:
        with open(f"/proc/self/task/{os.getpid()}/children") as file:
            return [int(number) for number in file.read().split()]
    except OSError:
        return []
