"""A user's own classes, named as `package.module:Name` on the command line and in scenarios."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from haptic_loop.design.files import InputError

_Made = TypeVar("_Made")
_HOME, _WORLDS = Path(__file__).parents[1], ("haptic_loop", "models", "controller", "design", "sim", "hw", "cli")
_OURS = tuple(f"{_HOME / world}{os.sep}" for world in _WORLDS)
_OTHERS = ("<", f"{sys.prefix}{os.sep}", f"{sys.base_prefix}{os.sep}", *_OURS)


def named(option: str, text: str) -> Any:
    """What `text` names, in a module of the working directory or an installed one. Raises InputError."""
    module, _, name = text.rpartition(":")
    file = Path(module).resolve() if module.endswith(".py") else None
    if file:
        module = file.stem
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError(f"{option} is {text!r}, expected package.module:Name or FILE.py:Name")
    place = reach_working_directory(str(file.parent) if file else None)
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and imports what is not
        absent = f"there is no module {error.name!r} in {place}, nor an installed one"
        raise InputError(f"{option} is {text!r}: {absent}") from None
    except SyntaxError as error:
        raise InputError(f"{option} is {text!r}: {error.filename}, line {error.lineno}: {error.msg}") from None
    if file and Path(str(found.__file__)).resolve() != file:
        raise InputError(f"{option} is {text!r}: another module of the name {module} is loaded, rename the file")
    if not hasattr(found, name):
        there = ", ".join(n for n, value in vars(found).items() if getattr(value, "__module__", "") == module)
        raise InputError(f"{option} is {text!r}: {module} has no {name}, but {there or 'no class and no function'}")
    return getattr(found, name)


def reach_working_directory(instead: str | None = None) -> str:
    """Let modules be found in it, or in another folder, as under `python -m`, and as a console script does not."""
    if (place := instead or os.getcwd()) not in sys.path:
        sys.path.insert(0, place)
    return place


def called(what: str, make: Callable[..., _Made], *given: Any, **named: Any) -> _Made:
    """What a user's own class or function makes of these arguments. Raises InputError where it cannot take them."""
    try:
        return make(*given, **named)
    except Exception as error:
        if isinstance(error, InputError) or place_of(error):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise InputError(f"{what}: {kind}{error}") from error


def is_refusal(error: BaseException) -> bool:
    """Whether a statement of ours refused what a user's own code gave it: then its traceback says nothing more."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return last.filename.startswith(_OURS) and (last.line or "").startswith("raise ")


def place_of(error: BaseException) -> str | None:
    """The innermost place in a user's own code that an error came through, `FILE, line N`; None where there is none.

    That is every file but ours and what is installed.
    """
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(_OTHERS)]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else None
