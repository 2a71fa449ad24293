"""JSON files of couplings: the loop, the coefficients and the certificate.

Numbers are plain decimals, rationals are strings "p/q". Reading is strict: an unknown or ill-typed field raises an
error with its name.
"""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from haptic_loop.controller.coupling import Coupling, Form, Strict, require_channels
from haptic_loop.controller.environment import Network, RigidWall
from haptic_loop.controller.loop import Loop
from haptic_loop.design.files import InputError, counted, read, write
from haptic_loop.design.frequency import frequencies, on_circle, rounding
from haptic_loop.design.result import Environments

_Rational = Annotated[str, msgspec.Meta(pattern=r"^-?[0-9]+(/[0-9]+)?$", max_length=1000)]
Rows = tuple[tuple[_Rational, ...], ...]  # rows of a matrix, rationals "p/q"

_Part = TypeVar("_Part", bound=msgspec.Struct)


class Certificate(Strict, frozen=True):
    """The claim about a coupling in its loop and its proof: base condition, facts, multipliers, matrices."""

    condition: str  # base condition: a name of design.result.CONDITIONS, or the name of a user's own condition
    facts: tuple[str, ...]  # properties covered beyond one linear network with constant delays (conditions.FACTS)
    required: tuple[float, ...]  # (m,) [N s/m] required damping, from a refined sweep with `multipliers`
    available: tuple[float, ...]  # (m,) [N s/m] damping for which the condition is proved
    margin: float  # available / required
    guarantee: Environments
    proof: Literal["sampled", "kyp", "rational"]
    multipliers: dict[str, tuple[float, ...]]  # by name, exact decimals; "rho" is the limiter's stiffness [N/m]
    matrices: dict[str, Rows]  # of KYP inequalities: P; P1, P2, .. for vertices; P_E for a delayed environment's block
    scenario: str  # digest of the loop and the coupling
    versions: dict[str, str]
    seal: str = ""  # digest of all other fields

    @property
    def limiter(self) -> Certificate | None:
        """The certificate itself if limited forces are among its facts, else None."""
        return self if "limiter" in self.facts else None

    def is_for(self, loop: Loop, coupling: Coupling) -> bool:
        """Return whether the certificate was made for exactly this loop and coupling."""
        return self.scenario == digest(loop, coupling.form())


class Stored(Strict, frozen=True):
    """A coupling with its loop and, once it is proved, its certificate."""

    loop: Loop
    coupling: Form
    certificate: Certificate | None = None
    version: Literal[3] = 3

    def __post_init__(self) -> None:
        require_channels(self.coupling, self.loop.channels)

    @classmethod
    def of(cls, loop: Loop, coupling: Coupling, certificate: Certificate | None = None) -> Stored:
        """Return the record to store. Raises ValueError for a wrong number of channels or a form of another system."""
        stored = cls(loop, coupling.form(), certificate)
        filed(loop, coupling)
        return stored

    def built(self) -> Coupling:
        return self.coupling.build(self.loop.T)


_SAME = 1e-9  # allowed difference between the responses of a coupling and its form, relative to the largest response


def filed(loop: Loop, coupling: Coupling) -> Coupling:
    """Return the coupling as a file restores it. A coupling of a user's own class is rebuilt from its form.

    Raises InputError if the rebuilt coupling has another response in the loop, or another compliance.
    """
    built = coupling.form().build(loop.T)
    if type(built) is type(coupling):
        return coupling
    through = loop.walled_before_delay
    V, rebuilt = coupling.compliance(loop.T), built.compliance(loop.T)
    for method, own, other in (("around", through(coupling), through(built)), ("compliance", V, rebuilt)):
        if own is None:
            continue
        name = f"coupling {type(coupling).__name__}: form(), which files store, is another system than {method}()"
        if other is None:
            raise InputError(f"{name}: the form is a {built.kind} without a compliance")
        z = on_circle(frequencies(own))
        response = own.at(z)
        scale, apart = np.abs(response).max(), np.abs(response - other.at(z)).max()
        if not apart <= _SAME * scale + rounding(own, z):  # true for nan, too
            raise InputError(f"{name}: responses differ by {apart / scale:.1e} of the largest")
    return built


def digest(*parts: msgspec.Struct) -> str:
    """Return the SHA-256 of the parts' canonical JSON: sorted keys, shortest decimals, floats with a point.

    The matrices of E(z) are included for an environment of a user's own class, whose fields need not determine E.
    """
    loops = [part for part in parts if isinstance(part, Loop)]
    own = [loop.E() for loop in loops if not isinstance(loop.environment, Network | RigidWall)]
    encoded = [*(_canonical(_read_back(part)) for part in parts), *(_canonical([E.A, E.B, E.C, E.D]) for E in own)]
    return hashlib.sha256(msgspec.json.encode([msgspec.json.decode(each) for each in encoded])).hexdigest()


def _read_back(part: _Part) -> _Part:
    """Return the part after writing and reading it, or the part itself if this fails (a user's own class)."""
    try:
        return msgspec.json.decode(msgspec.json.encode(part), type=type(part))
    except (TypeError, msgspec.ValidationError):
        return part


def _canonical(part: Any) -> bytes:
    return msgspec.json.encode(part, order="deterministic", enc_hook=own_fields)


def own_fields(part: Any) -> Any:
    """Return an array as lists, and a user's own environment as a dictionary of its class and fields."""
    return part.tolist() if isinstance(part, np.ndarray) else {"class": type(part).__qualname__} | vars(part)


def sealed(certificate: Certificate) -> Certificate:
    """Return the certificate with the digest of its other fields as its seal."""
    unsealed = _read_back(msgspec.structs.replace(certificate, seal=""))
    return msgspec.structs.replace(certificate, seal=hashlib.sha256(_canonical([unsealed])).hexdigest())


def load(path: str | Path) -> Stored:
    """Read a stored coupling. Raises InputError, which names the file and a field that is wrong."""
    content = read(path)
    if not content.strip():
        raise InputError(f"{path}: is empty, expected a coupling as python -m design stores it")
    try:
        stored = msgspec.json.decode(content, type=Stored)
        json.loads(content, object_pairs_hook=_once)
        return stored
    except _Twice as error:
        raise InputError(f"{path}: names {str(error)!r} twice in one object") from None
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: is no stored coupling: {counted(' '.join(str(error).split()))}") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: {_place(content, str(error))}{' '.join(str(error).split())}") from None


class _Twice(Exception):
    """A JSON object in a file has two values for one name."""


def _once(pairs: list[tuple[str, Any]]) -> None:
    """Raise _Twice for a repeated name: JSON readers take its last value, but people may read its first."""
    names: set[str] = set()
    for name, _ in pairs:
        if name in names:
            raise _Twice(name)
        names.add(name)


def _place(content: bytes, message: str) -> str:
    """Return the number and beginning of the line that a message names as "(byte N)", or ""."""
    match = re.search(r"\(byte (\d+)\)", message)
    if not match:
        return ""
    above = content[: int(match[1])].count(b"\n")
    return f"line {above + 1}, {content.splitlines()[above].decode(errors='replace').strip()[:40]!r}: "


def save(stored: Stored, path: str | Path) -> None:
    """Write the stored coupling through a temporary file, so that `path` is always complete. Raises InputError."""
    try:
        content = msgspec.json.encode(stored)
        msgspec.json.decode(content, type=Stored)
    except (TypeError, msgspec.ValidationError) as error:
        known = *getattr(stored.loop.environment, "springs", ()), stored.loop.environment
        own = [type(part).__name__ for part in known if type(part).__module__ != Network.__module__]
        reason = f"it has a class of your own ({own[0]})" if own else " ".join(str(error).split())
        raise InputError(f"{path}: the loop cannot be stored: {reason}") from None
    write(Path(path), msgspec.json.format(content, indent=1) + b"\n")
