"""Humans as a TOML file, one [[human]] per channel: how a human that was found is kept and replayed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from models.human import Human
from sim.files import write
from sim.scenario import InputError


class HumanFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    human: tuple[Human, ...]


def load_humans(path: str | Path, channels: int) -> tuple[Human, ...]:
    """The humans of a file, one per channel. Raises InputError with one line that names the file and the field."""
    try:
        humans = msgspec.convert(tomllib.loads(Path(path).read_text(encoding="utf-8")), HumanFile).human
    except OSError as error:
        raise InputError(f"--human {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"--human {path}: not a text file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"--human {path}: not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise InputError(f"--human {path}: {error}") from None
    if len(humans) != channels:
        raise InputError(f"--human {path} has {len(humans)} [[human]] tables, expected {channels} (one per channel)")
    return humans


def save_humans(path: Path, humans: tuple[Human, ...], remark: str) -> Path:
    """Write humans without voluntary motion so that reading gives the same numbers; `remark` becomes a comment."""
    lines = [f"# {line}" for line in remark.splitlines()]
    for human in humans:
        rows = (
            f"    {{ mass = {x.mass!r}, damping = {x.damping!r}, stiffness = {x.stiffness!r} }}," for x in human.links
        )
        lines += ["", "[[human]]", "links = [", *rows, "]"]
    return write(path, "\n".join(lines) + "\n")
