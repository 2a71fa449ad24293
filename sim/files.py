"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from sim.scenario import InputError


def folder(path: Path) -> Path:
    """Make a folder. Raises InputError where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {path}: {error.strerror}") from None
    return path


def write(path: Path, content: Callable[[BinaryIO], None] | bytes | str) -> Path:
    """Write a file under a temporary name and rename it into place."""
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
        os.chmod(name, 0o644)
        try:
            os.replace(name, path)
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror}") from None
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return path


def write_json(destination: str | Path, data: dict[str, Any]) -> None:
    """JSON to a file, or to standard output for '-'. Not-a-number and infinity are refused by construction."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    if str(destination) == "-":
        sys.stdout.write(text)
    else:
        write(Path(destination), text)
