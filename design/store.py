"""The file in which a coupling is kept: the loop it was made for, its coefficients and its certificate, as JSON.

Numbers are plain decimals, rationals are strings "p/q". Reading is strict: an unknown or ill-typed field is an
error that names it.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from controller import coupling
from controller.box import Box, Member, members
from controller.environment import Network, environment
from controller.lti import Array, Lti

Rows = tuple[tuple[float, ...], ...]
LARGEST_COEFFICIENT = 1e12  # of a coupling, SI units
Condition = Literal["closed-loop", "theorem4"]
Steps = tuple[Annotated[int, msgspec.Meta(ge=0, le=100)], ...]
Rational = Annotated[str, msgspec.Meta(pattern=r"^-?[0-9]+(/[0-9]+)?$", max_length=4000)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class BadFile(ValueError):
    """A file that is no stored coupling; the message is one line that names the field."""


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable, and refuses fields that it does not know."""


class DelayRange(Strict, frozen=True):
    """Delays that may be any from lo to hi, on every channel and anew at every tick."""

    lo: Steps  # (m,) [samples]
    hi: Steps  # (m,) [samples]

    def __post_init__(self) -> None:
        if len(self.lo) != len(self.hi) or any(not 0 <= a <= b for a, b in zip(self.lo, self.hi, strict=True)):
            raise ValueError(f"delays from {list(self.lo)} to {list(self.hi)}, expected 0 <= lo <= hi on every channel")

    def __str__(self) -> str:
        """'[1, 2] samples', or '[1, 2], [0, 3] samples' where the channels differ."""
        spans = [f"[{a}, {b}]" for a, b in zip(self.lo, self.hi, strict=True)]
        return f"{', '.join(spans if len(set(spans)) > 1 else spans[:1])} samples"

    def contains(self, other: DelayRange) -> bool:
        """Whether every delay that `other` allows is allowed here; a constant theta is DelayRange(theta, theta)."""
        below, above = zip(self.lo, other.lo, strict=True), zip(self.hi, other.hi, strict=True)
        return all(a <= b for a, b in below) and all(a >= b for a, b in above)


class Loop(Strict, frozen=True, omit_defaults=True):  # so that a loop without box and jitter keeps the digest it had
    """All that enters a condition beside the coupling."""

    T: Positive  # [s]
    theta: Steps  # (m,) transmission delays [samples]
    psi: Steps  # (m,) environment delays [samples]
    lam: Steps  # (m,) delays of the reference [samples]; they matter to transparency only
    delta: tuple[Positive, ...]  # (m,) damping that the devices guarantee [N s/m]
    environment: Network
    box: Box | None = None  # what else the environment may be
    jitter: DelayRange | None = None  # what else the delays of the forces may be, switching at every tick

    def __post_init__(self) -> None:
        m = len(self.environment.contacts)
        for name in ("theta", "psi", "lam", "delta"):
            if len(getattr(self, name)) != m:
                raise ValueError(f"{name} has {len(getattr(self, name))} entries, the environment has {m} contacts")
        if any(n > t + p for n, t, p in zip(self.lam, self.theta, self.psi, strict=True)):
            raise ValueError(f"lam is {list(self.lam)}, expected at most theta + psi on every channel")
        for member in self.members():
            try:
                environment(member.network, self.T)  # raises ValueError if nothing holds an internal node
            except ValueError as error:
                raise ValueError(f"{member.name}: {error}" if self.box else str(error)) from None
        if self.jitter:
            self._check_jitter(self.jitter)

    def _check_jitter(self, jitter: DelayRange) -> None:
        if self.box or self.environment.walls:
            other = "box" if self.box else "environment.walls"
            raise ValueError(f"jitter and {other}: switching delays are judged in one linear environment")
        if len(jitter.lo) != len(self.theta):
            raise ValueError(f"jitter has {len(jitter.lo)} ranges for {len(self.theta)} channels")
        if not jitter.contains(DelayRange(self.theta, self.theta)):
            raise ValueError(f"theta is {list(self.theta)}, outside of its jitter, {jitter}")

    def members(self) -> tuple[Member, ...]:
        """The environment, and the vertices of its box where it has one."""
        return members(self.environment, self.box)

    def at(self, network: Network) -> Loop:
        """The loop around this environment, known exactly."""
        return msgspec.structs.replace(self, environment=network, box=None)

    def switching(self, jitter: DelayRange | None) -> Loop:
        """The loop whose delays may switch within this range, or are the constant theta."""
        return msgspec.structs.replace(self, jitter=jitter)


class NoCoupling(Strict, frozen=True, tag_field="kind", tag="none"):
    """V = 0."""

    def build(self, T: float) -> coupling.Coupling:
        return coupling.NoCoupling()


class SpringDamper(Strict, frozen=True, tag_field="kind", tag="spring-damper"):
    """One spring and damper per channel (26)."""

    K: tuple[float, ...]  # (m,) [N/m]
    B: tuple[float, ...]  # (m,) [N s/m]

    def __post_init__(self) -> None:
        coupling.SpringDamper(self.K, self.B)

    def build(self, T: float) -> coupling.Coupling:
        return coupling.SpringDamper(self.K, self.B)


class Compliance(Strict, frozen=True, tag_field="kind", tag="compliance"):
    """A general V(z), as the rows of its state-space matrices."""

    A: Rows
    B: Rows
    C: Rows
    D: Rows

    def __post_init__(self) -> None:
        self.build(1.0)

    def build(self, T: float) -> coupling.Coupling:
        D = _table("D", self.D, len(self.D), len(self.D[0]) if self.D else 0)
        n = len(self.A)
        tables = (_table("A", self.A, n, n), _table("B", self.B, n, D.shape[1]), _table("C", self.C, len(D), n))
        return coupling.Compliance(Lti(*tables, D, T))


class InternalModel(Strict, frozen=True, tag_field="kind", tag="internal-model"):
    """The parameter Q(z) of the pair with the environment: poles of its basis, and a coefficient per function."""

    poles: tuple[float, ...]  # (n,)
    Q: tuple[Rows, ...]  # (n + 1, m, m) [m/N]

    def __post_init__(self) -> None:
        if any(len(rows) != len(self.Q[0]) or any(len(row) != len(rows) for row in rows) for rows in self.Q):
            raise ValueError("Q has coefficients that are not square matrices of one size")
        for rows in self.Q:
            _require_sensible("Q", rows)
        self.build(1.0)

    def build(self, T: float) -> coupling.Coupling:
        return coupling.InternalModel(self.poles, self.Q)


def _require_sensible(name: str, rows: Rows) -> None:
    """Raise ValueError where a coefficient is so large that arithmetic would overflow before it could be judged."""
    for value in (value for row in rows for value in row):
        if not abs(value) <= LARGEST_COEFFICIENT:
            raise ValueError(f"{name} has an entry {value:g}, allowed are up to {LARGEST_COEFFICIENT:g}")


def _table(name: str, rows: Rows, height: int, width: int) -> Array:
    if len(rows) != height or any(len(row) != width for row in rows):
        raise ValueError(f"{name} has rows of {[len(row) for row in rows]} entries, expected {height} x {width}")
    _require_sensible(name, rows)
    return np.array(rows, dtype=float).reshape(height, width)


CouplingData = NoCoupling | SpringDamper | Compliance | InternalModel


class SwitchingProof(Strict, frozen=True):
    """What proves that the delays may switch within the loop's range (design.jitter.proof)."""

    required: tuple[float, ...]  # (m,) [N s/m] with this multiplier, from a refined sweep
    margin: float  # available / required
    alpha: tuple[float, ...]  # (m,) multiplier [N/m], 0 where the delay does not vary
    P: tuple[tuple[Rational, ...], ...]  # rationals "p/q"


class Certificate(Strict, frozen=True):
    """What is claimed of a coupling in its loop, and what proves it."""

    condition: Condition
    required: tuple[float, ...]  # (m,) [N s/m], from a refined sweep
    available: tuple[float, ...]  # (m,) [N s/m], the damping for which it is proved
    margin: float  # available / required
    promise: Literal["any passive environment", "a set", "this environment"]
    proof: Literal["sampled", "kyp", "rational"]
    matrices: dict[str, tuple[tuple[Rational, ...], ...]]  # rationals "p/q"
    scenario: str  # digest of the loop and the coupling
    versions: dict[str, str]
    seal: str = ""  # digest of all other fields
    switching: SwitchingProof | msgspec.UnsetType = msgspec.UNSET  # of a loop with jitter; left out of other files


class Stored(Strict, frozen=True):
    """A coupling with its loop and, once it is proved, its certificate."""

    loop: Loop
    coupling: CouplingData
    certificate: Certificate | None = None
    version: Literal[1] = 1

    def __post_init__(self) -> None:
        m = len(self.loop.delta)
        match self.coupling:
            case SpringDamper(K=K) if len(K) != m:
                raise ValueError(f"K has {len(K)} entries, the environment has {m} contacts")
            case Compliance(D=D) if len(D) != m or len(D[0]) != m:
                raise ValueError(f"D is {len(D)} x {len(D[0])}, the environment has {m} contacts")
            case InternalModel(Q=Q) if len(Q[0]) != m:
                raise ValueError(f"Q is {len(Q[0])} x {len(Q[0])}, the environment has {m} contacts")


KNOWN = (NoCoupling, SpringDamper, Compliance, InternalModel)


def data_of(built: coupling.Coupling) -> CouplingData:
    """What is stored of a coupling. Raises TypeError for a kind that no file can hold."""
    match built:
        case coupling.NoCoupling():
            return NoCoupling()
        case coupling.SpringDamper(K=K, B=B):
            return SpringDamper(tuple(K.tolist()), tuple(B.tolist()))
        case coupling.Compliance(V=V):
            return Compliance(*(tuple(map(tuple, getattr(V, name).tolist())) for name in "ABCD"))
        case coupling.InternalModel(poles=poles, Q=Q):
            return InternalModel(tuple(poles.tolist()), tuple(tuple(map(tuple, rows)) for rows in Q.tolist()))
    raise TypeError(f"a {type(built).__name__} cannot be stored; known: {', '.join(k.__name__ for k in KNOWN)}")


def digest(*parts: msgspec.Struct) -> str:
    """sha256 over the canonical JSON (sorted keys, shortest decimals, 7 as 7.0 where it is a float) of the parts."""
    read_back = [msgspec.json.decode(msgspec.json.encode(part), type=type(part)) for part in parts]
    return hashlib.sha256(msgspec.json.encode(read_back, order="deterministic")).hexdigest()


def sealed(certificate: Certificate) -> Certificate:
    """The certificate with the digest of all its other fields."""
    plain = msgspec.structs.replace(certificate, seal="")
    return msgspec.structs.replace(certificate, seal=digest(plain))


def load(path: str | Path) -> Stored:
    """Read a stored coupling. Raises BadFile with one line that names the field, OSError if there is no file."""
    content = Path(path).read_bytes()
    if not content.strip():
        raise BadFile(f"{path}: is empty, expected a coupling as python -m design stores it")
    try:
        return msgspec.json.decode(content, type=Stored)
    except msgspec.ValidationError as error:
        raise BadFile(f"{path}: is no stored coupling: {' '.join(str(error).split())}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BadFile(f"{path}: {_place(content, str(error))}{' '.join(str(error).split())}") from None


def _place(content: bytes, message: str) -> str:
    """Number and beginning of the line that a message points to as "(byte N)", or nothing."""
    found = re.search(r"\(byte (\d+)\)", message)
    if not found:
        return ""
    above = content[: int(found[1])].count(b"\n")
    return f"line {above + 1}, {content.splitlines()[above].decode(errors='replace').strip()[:40]!r}: "


def save(stored: Stored, path: str | Path) -> None:
    """Write through a temporary file beside `path`, so that a reader never sees half of it."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(stored), indent=1) + b"\n")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
