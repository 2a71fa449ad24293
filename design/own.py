"""Load and call classes and functions that a user wrote. The command line names them as FILE.py:NAME."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from haptic_loop.design import forked
from haptic_loop.design.files import InputError

_Made = TypeVar("_Made")
_HOME, _FOLDERS = Path(__file__).parents[1], ("haptic_loop", "models", "controller", "design", "sim", "hw", "cli")
_OURS = tuple(f"{_HOME / folder}{os.sep}" for folder in _FOLDERS)
#: beginnings of the names of files that are not a user's own, such as "<string>"
_OTHERS = ("<", f"{sys.prefix}{os.sep}", f"{sys.base_prefix}{os.sep}", *_OURS)


def named(option: str, text: str) -> Any:
    """Return the object that FILE.py:NAME names. No other function loads a user's own code.

    What the file prints goes to standard error, because a report may go to standard output. The file's folder is added
    to sys.path, so that the file and worker processes can import modules from it.

    Raises:
        InputError: The text is not FILE.py:NAME with identifiers of Python for FILE and NAME; the file or the object
            does not exist; the file is not valid Python or exits; or another loaded module has the file's name.
    """
    place, _, name = text.rpartition(":")
    file = Path(place)
    if file.suffix != ".py" or not (file.stem.isidentifier() and name.isidentifier()):
        raise InputError(f"{option} is {text!r}, expected FILE.py:NAME with identifiers of Python")
    if not file.is_file():
        raise InputError(f"{option} is {text!r}: there is no file {place}")
    with redirect_stdout(sys.stderr):
        module = _loaded(option, text, file.resolve())
    if not hasattr(module, name):
        own = [n for n, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        there = ", ".join(own) or "no class and no function"
        raise InputError(f"{option} is {text!r}: {place} has no {name}; it defines {there}")
    return getattr(module, name)


_LOADED: dict[Path, ModuleType] = {}


def _loaded(option: str, text: str, file: Path) -> ModuleType:
    """Return the module of the file. It is imported once, under the file's name, so that workers find its classes."""
    forked.allowed = False
    if file in _LOADED:
        return _LOADED[file]
    other = sys.modules.get(file.stem)
    if other is not None and Path(getattr(other, "__file__", None) or ".").resolve() == file:
        return other
    if other is not None and other not in _LOADED.values():
        raise InputError(f"{option} is {text!r}: another module with the name {file.stem} is loaded; rename the file")
    if (folder := str(file.parent)) not in sys.path:
        sys.path.insert(0, folder)
    spec = spec_from_file_location(file.stem, file)
    assert spec
    assert spec.loader
    sys.modules[file.stem] = module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[file.stem]
        if isinstance(error, SyntaxError):
            raise InputError(f"{option} is {text!r}: {error.filename}, line {error.lineno}: {error.msg}") from None
        if isinstance(error, SystemExit | UnicodeDecodeError):
            raise InputError(f"{option} is {text!r}: {type(error).__name__}: {error}") from None
        raise
    _LOADED[file] = module
    return module


def called(what: str, make: Callable[..., _Made], *args: Any, **options: Any) -> _Made:
    """Call a user's own class or function, and return its result.

    An InputError passes unchanged, and so does an error whose traceback has a line of the user's code. Any other error,
    such as that of wrong arguments, becomes an InputError that begins with `what`. So does sys.exit().
    """
    try:
        return make(*args, **options)
    except SystemExit as error:
        raise InputError(f"{what}: it ends the program by sys.exit({error.code!r})") from None
    except Exception as error:
        if isinstance(error, InputError) or place_of(error):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        raise InputError(f"{what}: {kind}{error}") from error


def is_refusal(error: BaseException) -> bool:
    """Return whether a `raise` statement of this package raised the error, which then needs no traceback."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return last.filename.startswith(_OURS) and (last.line or "").startswith("raise ")


def place_of(error: BaseException) -> str | None:
    """Return the innermost line of the user's own code in the traceback, as `FILE, line N`, or None."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(_OTHERS)]
    return f"{frames[-1].filename}, line {frames[-1].lineno}" if frames else None
