"""A user's own classes, named as `package.module:Name` on the command line and in scenarios."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from importlib import import_module
from typing import Any, TypeVar

from design.files import InputError

_Made = TypeVar("_Made")
_FILES: set[str] = set()  # that hold such code


def named(option: str, text: str) -> Any:
    """What `text` names, in a module of the working directory or an installed one. Raises InputError."""
    module, _, name = text.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise InputError(f"{option} is {text!r}, expected package.module:Name")
    if (place := os.getcwd()) not in sys.path:
        sys.path.insert(0, place)  # as `python -m` does, and a console script does not
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and imports what is not
        absent = f"there is no module {error.name!r} in {place}, nor an installed one"
        raise InputError(f"{option} is {text!r}: {absent}") from None
    except SyntaxError as error:
        raise InputError(f"{option} is {text!r}: {error.filename}, line {error.lineno}: {error.msg}") from None
    finally:
        family = module.partition(".")[0]
        kin = (m for n, m in list(sys.modules.items()) if n.partition(".")[0] == family)
        _FILES.update(file for m in kin if (file := getattr(m, "__file__", None)))
    if not hasattr(found, name):
        there = ", ".join(n for n, value in vars(found).items() if getattr(value, "__module__", "") == module)
        raise InputError(f"{option} is {text!r}: {module} has no {name}, but {there or 'no class and no function'}")
    return getattr(found, name)


def called(what: str, make: Callable[..., _Made], *given: Any, **named: Any) -> _Made:
    """What a user's own class or function makes of these arguments. Raises InputError where it cannot take them."""
    try:
        return make(*given, **named)
    except Exception as error:
        if isinstance(error, InputError) or place_of(error):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise InputError(f"{what}: {kind}{error}") from error


def holds_own_code(path: str) -> None:
    """Errors in this file are the user's."""
    _FILES.add(path)


def place_of(error: BaseException) -> str | None:
    """The innermost place in a user's own code that an error came through, `FILE, line N`; None where there is none."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename in _FILES]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else None
