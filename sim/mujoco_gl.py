"""What MUJOCO_GL asks for, set aside until something is drawn.

MuJoCo looks at it when it is imported, and cannot be imported where what it names is not there; few commands draw.
"""

from __future__ import annotations

import os
import sys

_OURS = "HAPTIC_LOOP_GL"  # the same, for us and the processes that we start


def set_aside() -> None:
    """In a command of ours, before MuJoCo is imported; a script's own MuJoCo keeps what it was given."""
    if _command_starts() and "MUJOCO_GL" in os.environ:
        os.environ[_OURS] = os.environ.pop("MUJOCO_GL")


def asked() -> str:
    """The user's MUJOCO_GL in lower case; empty where it is not set."""
    return (os.environ.get(_OURS) or os.environ.get("MUJOCO_GL") or "").lower().strip()


def _command_starts() -> bool:
    """Whether this process is one of our commands that Python is still looking for."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1] if "-m" in words[:-1] else ""
    if sys.argv[:1] == ["-m"]:
        return module.split(".")[0] in ("design", "sim", "hw", "cli")
    started = sys.argv[0] if sys.argv else ""
    return os.path.basename(started) == "haptic-loop" or started.endswith(os.path.join("cli", "__main__.py"))
