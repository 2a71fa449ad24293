"""Designs kept on disk, since a run asks for the same couplings again and again and a design is a pure function.

In $XDG_CACHE_HOME/haptic-loop (~/.cache/haptic-loop), a stored coupling file for each question. An entry is proved
again whenever it is read; what is not proved is designed anew. What a busy machine had no time to finish is not kept.
HAPTIC_LOOP_CACHE=off keeps nothing.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import controller
import design
from controller.loop import Loop
from design.certificate import prove, verify
from design.files import one_command
from design.result import Design
from design.stored import Stored, digest, load, save

_MOST = 200  # entries; the oldest go


def find(loop: Loop, *question: Any) -> Stored | None:
    """What `keep` kept of the same loop, question and code, with its certificate, which has just been proved again."""
    path = _place(loop, question)
    if path is None:
        return None
    with one_command(), suppress(OSError, ValueError, ArithmeticError):
        stored = load(path)
        if stored.loop == loop and verify(stored).proved:
            os.utime(path)
            return stored
    return None


def keep(made: Design, loop: Loop, *question: Any) -> None:
    """Keep a design that can be proved from its coupling alone, if there is a place for it."""
    path = _place(loop, question)
    if path is None or made.phi is not None or made.hurried:
        return
    with one_command(), suppress(OSError, ValueError, ArithmeticError):  # no place, or no proof
        certificate = made.certificate or prove(loop, made.coupling, made.condition)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(Stored.of(loop, made.coupling, certificate), path)
        for old in sorted(path.parent.glob("*.json"), key=os.path.getmtime)[:-_MOST]:
            old.unlink()


def _place(loop: Loop, question: tuple[Any, ...]) -> Path | None:
    if os.environ.get("HAPTIC_LOOP_CACHE", "").lower() == "off":
        return None
    asked = os.environ.get("XDG_CACHE_HOME", "")
    home = Path(asked if os.path.isabs(asked) else os.path.expanduser("~/.cache"))
    if not home.is_absolute():  # a user without a home
        return None
    named = hashlib.sha256(repr((digest(loop), question, _code())).encode()).hexdigest()
    return Path(home, "haptic-loop", f"{named}.json")


@cache
def _code() -> str:
    """A digest of what designs: other code may design another coupling."""
    found = hashlib.sha256()
    for package in (controller, design):
        for file in sorted(Path(str(package.__file__)).parent.glob("*.py")):
            found.update(file.read_bytes())
    return found.hexdigest()
