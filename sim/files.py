"""Writing files so that a reader never sees half of one.

One rule for all commands: a folder is made where the user names a folder (--out DIR) or names nothing (out/..); the
folder of a file that the user names (--json, --video, --out FILE) must exist, for a typing error must not make one.
"""

from __future__ import annotations

import errno
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO


class InputError(ValueError):
    """Something that the user gave and can put right: one line, naming the field."""


def check_file(option: str, path: Path, expected: str = "a file") -> Path:
    """Whether a file that the user named can be written, before any work is done. Raises InputError."""
    if path.is_dir():
        raise InputError(f"{option} {path}: is a folder, expected {expected}")
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: the folder {path.parent} does not exist")
    place = Path(os.path.realpath(path))
    try:
        if place.exists() and not place.is_file():
            if not os.access(place, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return path
        with tempfile.TemporaryFile(dir=place.parent):
            pass
    except OSError as error:
        raise InputError(f"{option} {path}: cannot write to {path.parent}: {error.strerror}") from None
    return path


def out_file(named: str | None, default: str, expected: str = "a file") -> Path:
    """The file of --out, by the rule above. Raises InputError."""
    if named is None:
        folder(Path(default).parent)
    return check_file("--out", Path(default if named is None else named), expected)


def folder(path: Path) -> Path:
    """Make a folder. Raises InputError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror}") from None
    return path


def write(path: Path, content: Callable[[BinaryIO], None] | bytes | str) -> Path:
    """Write a file under a temporary name and rename it into place; what is no file, a device or a pipe, as it is.

    A link stays a link: the file that it points to is written. Raises InputError where that cannot be.
    """
    place = Path(os.path.realpath(path))
    try:
        if place.exists() and not place.is_file():
            with place.open("wb") as device:
                _fill(device, content)
            return path
        handle, name = tempfile.mkstemp(dir=place.parent, prefix=f".{place.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                _fill(file, content)
            os.chmod(name, 0o644)
            os.replace(name, place)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
    return path


def _fill(file: BinaryIO, content: Callable[[BinaryIO], None] | bytes | str) -> None:
    if callable(content):
        content(file)
    else:
        file.write(content.encode() if isinstance(content, str) else content)


def write_json(destination: str | Path, data: dict[str, Any]) -> None:
    """JSON to a file, or to standard output for '-'. Not-a-number and infinity are refused by construction."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    if str(destination) == "-":
        try:
            sys.stdout.write(text)
            sys.stdout.flush()
        except BrokenPipeError:
            nobody_reads()
    else:
        write(Path(destination), text)


def nobody_reads() -> None:
    """What is still written to standard output goes nowhere: its reader has left."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
