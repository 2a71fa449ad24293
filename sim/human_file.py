"""Humans as a TOML file, one [[human]] per channel: how a human that was found is kept and replayed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from models.human import Human, Person, check_holds
from sim.files import write
from sim.scenario import InputError


class HumanFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    human: tuple[Human, ...]
    person: tuple[Person, ...] = ()


def load_humans(path: str | Path, channels: int) -> HumanFile:
    """The humans of a file, one per channel, and who holds several devices.

    Raises InputError with one line that names the file and the field.
    """
    try:
        people = msgspec.convert(tomllib.loads(Path(path).read_text(encoding="utf-8")), HumanFile)
    except OSError as error:
        raise InputError(f"--human {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"--human {path}: not a text file in UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"--human {path}: not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise InputError(f"--human {path}: {error}") from None
    if len(people.human) != channels:
        raise InputError(
            f"--human {path} has {len(people.human)} [[human]] tables, expected {channels} (one per channel)"
        )
    try:
        check_holds(people.person, channels)
    except ValueError as error:
        raise InputError(f"--human {path}: {error}") from None
    return people


def save_humans(path: Path, humans: tuple[Human, ...], remark: str, persons: tuple[Person, ...] = ()) -> Path:
    """Write humans and persons without voluntary motion so that reading gives the same numbers.

    `remark` becomes a comment.
    """
    lines = [f"# {line}" for line in remark.splitlines()]
    for human in humans:
        rows = (
            f"    {{ mass = {x.mass!r}, damping = {x.damping!r}, stiffness = {x.stiffness!r} }}," for x in human.links
        )
        lines += ["", "[[human]]", "links = [", *rows, "]"]
    for person in persons:
        body = [f"{name} = {getattr(person, name)!r}" for name in ("mass", "damping", "stiffness")]
        cross = f"cross = {{ damping = {person.cross.damping!r}, stiffness = {person.cross.stiffness!r} }}"
        lines += ["", "[[person]]", f"holds = {list(person.holds)}", *body, cross]
    return write(path, "\n".join(lines) + "\n")
