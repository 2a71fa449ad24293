"""Designs kept on disk, since a run asks for the same couplings again and again and a design is a pure function.

In $XDG_CACHE_HOME/haptic-loop (~/.cache/haptic-loop), a stored coupling file for each question; those of the paper's
two cases come with the package (sim/designs, which docs/regenerate.py writes). An entry is proved again whenever it is
read; what is not proved is designed anew. What a busy machine had no time to finish is not kept.
HAPTIC_LOOP_CACHE=off keeps nothing and reads nothing.
"""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from haptic_loop.controller.loop import Loop
from haptic_loop.design.certificate import named, prove, prove_limiter, verify
from haptic_loop.design.coupling_file import Certificate, Stored, digest, load, save, sealed
from haptic_loop.design.files import one_command
from haptic_loop.design.result import Design, NotProved

from haptic_loop import controller, design

_SHIPPED = Path(__file__).with_name("designs")
_MOST = 200  # entries; the oldest go


def find(loop: Loop, kind: str, condition: Any, *options: Any) -> Stored | None:
    """What is kept of the same loop, question and code, or came with the package; it has just been proved again."""
    if _off():
        return None
    question = kind, condition, *options
    kept = _place(loop, question)
    for path in (kept, shipped(loop, *question)):
        with one_command(), suppress(OSError, ValueError, ArithmeticError):
            if path is None or (stored := load(path)).loop != loop:
                continue
            if stored.certificate is None:  # a coupling alone, whose storage function is found again
                certificate = prove(loop, stored.built(), condition)
                return msgspec.structs.replace(stored, certificate=certificate)
            if verify(stored).proved:
                if path == kept:
                    os.utime(path)
                return stored
    return None


def keep(made: Design, loop: Loop, *question: Any) -> Certificate | None:
    """Prove a design from its coupling alone and keep it, if there is a place for it; the proof, if there is one."""
    path, certificate = _place(loop, question), made.certificate
    if _off() or path is None or made.phi is not None or made.hurried:
        return certificate
    with one_command(), suppress(OSError, ValueError, ArithmeticError):  # no place, or no proof
        certificate = certificate or proved(made, loop)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(Stored.of(loop, made.coupling, certificate), path)
        for old in sorted(path.parent.glob("*.json"), key=os.path.getmtime)[:-_MOST]:
            old.unlink()
    return certificate


def proved(made: Design, loop: Loop) -> Certificate:
    """The proof of a design, also while forces are limited where that can be had. Raises NotProved."""
    certificate = prove(loop, made.coupling, made.asked)
    if named(made.asked).extensible:
        with suppress(NotProved):
            limiter = prove_limiter(loop, made.coupling, c=made.c)
            certificate = sealed(msgspec.structs.replace(certificate, limiter=limiter))
    return certificate


def shipped(loop: Loop, kind: str, condition: str, *options: Any) -> Path:
    """The file of the design that comes with the package, if there is one for this question."""
    named = hashlib.sha256(repr((digest(loop), options)).encode()).hexdigest()
    return _SHIPPED / f"{kind}-{condition}-{named[:12]}.json"


def _off() -> bool:
    return os.environ.get("HAPTIC_LOOP_CACHE", "").lower() == "off"


def _place(loop: Loop, question: tuple[Any, ...]) -> Path | None:
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
