"""Read files of limited size, write files atomically, write reports as JSON, and prepare text for messages.

Folders that the user names (--out DIR) and default folders (out/..) are created. The folder of a file that the user
names (--json, --video, --out FILE) must exist, so that a typing error creates no folder. Within `one_command` a file
may be either read or written, and written for one option only; any other use is refused.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Literal
from zipfile import ZipFile, ZipInfo

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from haptic_loop.controller.units import keys_in_unit

# Largest sizes in bytes, and for _MOST_WORDS in characters.
_MOST_TEXT = 2_000_000  # of a scenario, a human or recorded delays
_MOST_STORED = 50_000_000  # of a stored coupling; a proof over 200 states takes a tenth of it
_MOST_UNPACKED = 4_000_000_000  # of an unpacked trace; ten hours of two channels take 3e9
_MOST_WORDS = 1000  # of one message

_DEEPEST_KEY = 20  # most names joined by dots in a key; tomllib's time and memory grow with the square of their number
_KEY_PART = r"""(?:(?<![\w-])[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?:{_KEY_PART}[ \t]*+\.[ \t]*+){{{_DEEPEST_KEY}}}")


class InputError(ValueError):
    """A mistake in the user's input. The message is one line that names the field."""


def printable(text: str) -> str:
    """Return the text with unprintable characters escaped, except line ends and tabs."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


_QUOTED = re.compile(r"(?<!\w)'[^']*'|(?<!\S)[^\s/']{81,}(?!\S*/)")  # a text in quotes, or a long word without /


def _cut(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:38]}[..]{text[-38:]}"


def one_line(text: object) -> str:
    """Return a message in one line of at most _MOST_WORDS characters; quoted texts and long words are cut to 80."""
    words = _QUOTED.sub(lambda match: _cut(match[0]), printable(" ".join(str(text).split())))
    half = _MOST_WORDS // 2 - 3
    return words if len(words) <= _MOST_WORDS else f"{words[:half]} [..] {words[-half:]}"


def counted(path: str) -> str:
    """Return the dotted name of a field with list entries counted from 1: human[0].mass becomes human #1.mass."""
    return re.sub(r"\[(\d+)\]", lambda match: f" #{int(match[1]) + 1}", path)


@dataclass
class _Ledger:
    """Files that a command reads and writes. A file's places are its path without links, and its device and inode."""

    read: dict[Any, str] = field(default_factory=dict)  # place -> name of the file in messages
    named: dict[Any, str] = field(default_factory=dict)  # place -> option that names the file as output
    written: set[Any] = field(default_factory=set)  # places of the files that the command has written
    folders: list[Path] = field(default_factory=list)  # folders that the command has created, the deepest first


_ledger: ContextVar[_Ledger | None] = ContextVar("ledger", default=None)


@contextmanager
def one_command() -> Iterator[None]:
    """Begin a new record of the files that a command reads and writes. After the command, remove new empty folders."""
    token = _ledger.set(ledger := _Ledger())
    try:
        yield
    finally:
        _ledger.reset(token)
        for path in ledger.folders:
            with suppress(OSError):  # The folder is not empty.
                path.rmdir()


def _places(path: Path) -> set[Any]:
    """Return the places of a file (`_Ledger`); none for a terminal, a pipe or a device, which keeps no content."""
    place = _target(path)
    if not place.exists():
        return {place}
    status = place.stat()
    return {place, (status.st_dev, status.st_ino)} if place.is_file() else set()


def _target(path: Path) -> Path:
    """Return the path with all links resolved. Raises OSError for circular links and null bytes."""
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "a file name may contain no null byte")
    place = Path(os.path.realpath(path))
    if place.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
    return place


@contextmanager
def _refusing(what: str, hint: str = "") -> Iterator[None]:
    """Turn an OSError in the block into an InputError. Its message begins with `what`."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{what}: {error.strerror or error}{hint}") from None


def _met(places: set[Any], known: dict[Any, str]) -> str | None:
    """Return the name of the file in `known` that is at one of the places, or None."""
    return next((known[place] for place in places if place in known), None)


def read(path: str | Path, named: str | None = None, most: int = _MOST_STORED, hint: str = "") -> bytes:
    """Return the bytes of a regular file of at most `most` bytes. Raises InputError.

    Messages call the file `named`, and end with `hint` if the file cannot be read.
    """
    named = str(path) if named is None else named
    with _opened(path, named, hint) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise InputError(f"{named}: is larger than {most / 1e6:g} MB, the largest allowed size")
    return content


@contextmanager
def _opened(path: str | Path, named: str, hint: str = "") -> Iterator[BinaryIO]:
    """Open a regular file that no option names as output. Raises InputError, also if a later read fails."""
    path = Path(path)
    with _refusing(named, hint):
        if _target(path).exists() and not path.is_file():
            kind = "a folder" if path.is_dir() else "not a regular file"
            raise InputError(f"{named}: is {kind}, expected a file")
        if ledger := _ledger.get():
            places = _places(path)
            if option := _met(places, ledger.named):
                raise InputError(f"{named}: is also the file of {option}; give that option another file")
            ledger.read |= dict.fromkeys(places, named)
        with open(path, "rb") as file:
            yield file


def read_text(path: str | Path, named: str | None = None, hint: str = "") -> str:
    """Return the text of a file in UTF-8. Raises InputError."""
    try:
        return read(path, named, _MOST_TEXT, hint).decode()
    except UnicodeDecodeError:
        raise InputError(f"{path if named is None else named}: not a text file in UTF-8") from None


def toml(text: str, named: str) -> dict[str, Any]:
    """Return the content of TOML text. Raises InputError."""
    if match := _DEEP_KEY.search(text):
        line = text.count("\n", 0, match.start()) + 1
        raise InputError(f"{named}: line {line}: a key has more than {_DEEPEST_KEY} names joined by dots")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{named}: not valid TOML: nested too deeply") from None
    except ValueError as error:  # tomllib also raises ValueError for an integer of thousands of digits.
        raise InputError(f"{named}: not valid TOML: {error}") from None


def read_arrays(path: str | Path, expected: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an npz file without unpickling objects. Raises InputError."""
    try:
        with _opened(path, str(path)) as file, ZipFile(file) as archive:
            entries = archive.infolist()
            size = sum(entry.file_size for entry in entries)  # zipfile never unpacks more than this size.
            if size > _MOST_UNPACKED:
                raise ValueError(f"unpacks to {size / 1e9:.3g} GB, allowed are {_MOST_UNPACKED / 1e9:g} GB")
            return {entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in entries}
    except (MemoryError, InputError):
        raise
    except Exception as error:  # A damaged archive makes zipfile, zlib and NumPy raise many kinds of errors.
        raise InputError(f"{path}: not {expected} ({error})") from None


def _array(archive: ZipFile, entry: ZipInfo) -> NDArray[Any]:
    """Return one array. Raises ValueError for objects, or if its declared size is not the size of its data."""
    with archive.open(entry) as member:
        version = npy.read_magic(member)
        header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, fortran, dtype = header(member)
        there = entry.file_size - member.tell()
        if dtype.hasobject or min(shape, default=0) < 0 or prod(shape) * dtype.itemsize != there:
            raise ValueError(f"{entry.filename} declares {shape} of {dtype}, but contains {there} bytes")
        return np.frombuffer(member.read(), dtype).reshape(shape, order="F" if fortran else "C")


def check_file(option: str, path: Path, expected: str = "a file") -> Path:
    """Return `path`, the file of an option. Raises InputError if it cannot be written or has another use."""
    with _refusing(f"{option} {path}: cannot write to {path.parent}"):
        if path.is_dir():
            raise InputError(f"{option} {path}: is a folder, expected {expected}")
        if not path.parent.is_dir():
            raise InputError(f"{option} {path}: the folder {path.parent} does not exist")
        place = _target(path)
        if place.exists() and not place.is_file():
            if not os.access(place, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return path
        _try(place.parent, place.name)
    if ledger := _ledger.get():
        places = _places(path)
        if known := _met(places, ledger.read):
            raise InputError(f"{option} {path}: is also read, as {known}; name another file")
        other = _met(places, ledger.named)
        if other not in (None, option):
            raise InputError(f"{option} {path}: is also the file of {other}; name another file")
        ledger.named |= dict.fromkeys(places, option)
    return path


def out_file(named: str | None, default: str, expected: str = "a file") -> Path:
    """Return the file of --out, or the default file after creating its folder. Raises InputError."""
    if named is None:
        folder(Path(default).parent)
    return check_file("--out", Path(default if named is None else named), expected)


def folder(path: Path) -> Path:
    """Create a folder if it does not exist. Raises InputError if files cannot be written to it."""
    with _refusing(f"--out {path}"):
        place = _target(path)
        absent = [each for each in (path, *path.parents) if not each.exists()]
        path.mkdir(parents=True, exist_ok=True)
        if ledger := _ledger.get():
            ledger.folders[:0] = absent
        _try(place)
    return path


def _try(place: Path, name: str = "") -> None:
    """Create and delete a file in a folder, with a name as long as that of the temporary file in `write`."""
    handle, temporary = tempfile.mkstemp(dir=place, prefix=f".{name}.")
    os.close(handle)
    os.unlink(temporary)


def write(path: Path, content: Callable[[BinaryIO], None] | bytes | str) -> Path:
    """Write a file under a temporary name and rename it; a device or a pipe is written directly.

    For a link, the file that it points to is written. Raises InputError if the file cannot be written, or if the
    command has read it, or has already written it and an option names it.
    """
    with _refusing(f"cannot write {path}"):
        place = _target(path)
        if place.exists() and not place.is_file():
            with place.open("wb") as device:
                _fill(device, content)
            return path
        _require_unused(path)
        if ledger := _ledger.get():
            ledger.written |= _places(path)
        handle, name = tempfile.mkstemp(dir=place.parent, prefix=f".{place.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                _fill(file, content)
            os.chmod(name, 0o644)
            os.replace(name, place)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    return path


def remove(*paths: Path) -> None:
    """Remove files that an earlier run wrote, if they are there. For a link, the file that it points to is removed.

    Raises InputError if a file cannot be removed. If the command has read one of the files, or has written it and an
    option names it, InputError is raised before any file is removed.
    """
    for unlink in (False, True):
        for path in paths:
            with _refusing(f"cannot remove {path}"):
                if (place := _target(path)).is_file():
                    place.unlink() if unlink else _require_unused(path)


def _require_unused(path: Path) -> None:
    """Raise InputError if the command has read the file, or has written it and an option names it."""
    if ledger := _ledger.get():
        places = _places(path)
        if known := _met(places, ledger.read):
            raise InputError(f"cannot write or remove {path}: it was read, as {known}")
        if not places.isdisjoint(ledger.written) and (option := _met(places, ledger.named)):
            raise InputError(f"cannot write {path} twice: it is the file of {option} and another output of the command")


def _fill(file: BinaryIO, content: Callable[[BinaryIO], None] | bytes | str) -> None:
    if callable(content):
        content(file)
    else:
        file.write(content.encode(errors="backslashreplace") if isinstance(content, str) else content)


InJson = Literal["always", "if given", "inlined", "left out"]


def off_table(json: InJson = "always", default: Any = MISSING) -> Any:
    """Return a dataclass field of a report that no table shows.

    `json` says when the report's JSON has the field: `always`, `if given` (the value is not None), or never (`left
    out`). With `inlined` the keys of a nested report become keys of the outer report.
    """
    return field(default=default, metadata={"json": json})


def plain(report: Any) -> Any:
    """Return a report as plain data: dataclasses become dicts (by `part()` if defined), inf and nan become None."""
    if is_dataclass(report) and not isinstance(report, type):
        own = getattr(report, "part", None)
        return plain(own()) if own else _part(report)
    if isinstance(report, msgspec.Struct):
        return plain(msgspec.to_builtins(report))
    if isinstance(report, Mapping):
        return {name: plain(value) for name, value in report.items()}
    if isinstance(report, np.ndarray | np.generic):
        return plain(report.tolist())
    if isinstance(report, list | tuple):
        return [plain(value) for value in report]
    if isinstance(report, float):
        return report if math.isfinite(report) else None
    return str(report) if isinstance(report, Path) else report


def _part(report: Any) -> dict[str, Any]:
    part: dict[str, Any] = {}
    for one in fields(report):
        value, how = getattr(report, one.name), one.metadata.get("json", "always")
        if how == "inlined":
            part |= plain(value) or {}
        elif how == "always" or (how == "if given" and value is not None):
            part[one.name.removesuffix("_")] = plain(value)  # The field from_ gives the key `from`.
    return part


def write_json(destination: str | Path, report: Any) -> None:
    """Write a report as JSON to a file, or to standard output for '-'."""
    text = json.dumps(keys_in_unit(plain(report)), indent=2, allow_nan=False) + "\n"
    if str(destination) == "-":
        try:
            sys.stdout.write(text)
            sys.stdout.flush()
        except BrokenPipeError:
            discard_output()
    else:
        write(Path(destination), text)


lost_output: list[OSError] = []  # errors of writing standard output, which `cli.execute` reports at the end


def discard_output() -> None:
    """Discard further standard output, which cannot be written."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
