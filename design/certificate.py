"""What both conditions ask of a coupling in its loop, proved exactly wherever that is possible."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import scipy

from controller import coupling
from controller import coupling as controller_coupling
from controller.coupling import Compliance as Compliance_coupling
from controller.coupling import Coupling
from controller.coupling import SpringDamper as SpringDamper_coupling
from controller.delay import delay
from controller.environment import Box, Member, Network, environment, members, regions, shrunk
from controller.lti import Array, Lti, SingularLoop
from controller.process import force_map, frozen_states, held
from design import conditions as margin
from design import exact
from design.conditions import (
    JitterProof,
    Requirement,
    Specification,
    closed_loop,
    jitter_proof,
    jitter_refusal,
    refusal,
    theorem4,
    theorem4_delayed,
    theorem4_per_channel,
)
from design.exact import (
    Exact,
    Matrix,
    SingularMatrix,
    block,
    definiteness,
    find_storage,
    rational,
    refuted_rows,
    rows_of,
    too_large,
)

# ----------------------------------------------------------------------------------------------------
# The file in which a coupling is kept: the loop it was made for, its coefficients and its certificate, as JSON.
#
# Numbers are plain decimals, rationals are strings "p/q". Reading is strict: an unknown or ill-typed field is an
# error that names it.


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


# ----------------------------------------------------------------------------------------------------
# What may be said of a coupling: required against available damping, for which environments, and what is left out.


ANY, SET, HERE, WALL = "any passive environment", "a set", "this environment", "a rigid wall only"
FROZEN = "each frozen contact state of this environment (contact that makes and breaks is not covered)"

#: What no certificate covers.
CAVEATS = (
    "The proofs are for the linear loop: they hold while forces stay below their limits (clipped ticks are counted), "
    "not for contacts that make and break (except walls under theorem4, without delay in the environment), "
    "jitter of T, quantisation, velocity filters or friction compensation."
)


def finite(value: float) -> float | None:
    """JSON knows neither infinity nor not-a-number."""
    return float(value) if math.isfinite(value) else None


def certificate_part(requirement: Requirement) -> dict[str, Any]:
    """Required against available damping."""
    part = {
        "condition": requirement.condition,
        "required_damping": [finite(b) for b in requirement.required],
        "available_damping": list(requirement.available),
        "margin": finite(1 / requirement.ratio) if requirement.ratio > 0 else None,
        "binding_frequency_hz": requirement.frequency_hz,
        "certified": requirement.certified,
        "proof": requirement.proof,
    }
    return part | ({"reason": requirement.reason} if requirement.reason else {})


def promise(
    theorem4: bool, closed_loop: bool, *, rigid: bool = False, walls: bool = False, whole_set: bool = False
) -> str | None:
    """For which environments a coupling is certified, given which conditions hold.

    `rigid` if E is a rigid wall that is never left, `walls` if contact is made and broken, `whole_set` if closed-loop
    is proved at every vertex of a box around E and a search has found no violation between them.
    """
    if theorem4:
        return ANY
    if whole_set:
        return SET
    return (WALL if rigid else FROZEN if walls else HERE) if closed_loop else None


def switching_promise(span: DelayRange) -> str:
    """Which delays of the forces a coupling is certified for that bears switching, in the environment of its loop."""
    return f"delays switching within {span}"


def promise_of(requirements: Mapping[str, Requirement], loop: Loop, whole_set: bool = False) -> str | None:
    """The promise of a coupling by its requirements; the multiplier that psi >= 1 takes is of one environment."""
    held = {name: requirement.certified for name, requirement in requirements.items()}
    walls = bool(loop.environment.walls)
    return promise(held["theorem4"] and not any(loop.psi), any(held.values()), walls=walls, whole_set=whole_set)


# ----------------------------------------------------------------------------------------------------
# A coupling in every environment of a set: what the closed-loop condition asks at each vertex of a box.


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """The closed-loop condition of this coupling around each of the members, every one frozen."""
    return [_required(loop, coupling, member) for member in members]


def worst(requirements: Sequence[Requirement]) -> int:
    """Which of them asks the most."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


def _required(loop: Loop, coupling: Coupling, member: Member) -> Requirement:
    try:
        F = force_map(environment(member.network, loop.T), coupling, loop.theta, loop.psi)
    except SingularLoop as error:
        return refusal("closed-loop", loop.delta, str(error))
    return closed_loop(F, loop.delta)


# ----------------------------------------------------------------------------------------------------
# What must be strictly positive real for Theorem 4 with delay inside the environment (psi >= 1), exactly.
#
# Two blocks, for a diagonal multiplier 0 <= Phi < Delta_D:
#   P_E   E-hat + Phi is passive. E-hat = T z/(z-1) Psi E = T E(1) z/(z-1) + T z R(z), and the Hermitian part of
#         z/(z-1) on the circle is 1/2:  T (z R + E(1)/2) + Phi.
#   P     V-hat is Delta_V-OSP with Delta_V^-1 = S < Phi^-1 - Delta_D^-1, which is (14). With H = H(1) + (z - 1) R,
#         divided by |1 - 1/z|^2 it reads T He[H(1)/2 - R] > H* S^-1 H, by a Schur complement the Hermitian part of
#         [[T (H(1)/2 - R), 0], [2 H, S]].


#: Delta_V^-1 stays this much, relatively, below the limit of (14), which is strict.
STRICT = Fraction(1, 10**9)
#: Delta_V^-1 in units of 1/delta where Phi is 0 and (14) asks only Delta_V > 0.
UNLIMITED = 10**6


def environment_block(delayed: Exact, phi: Sequence[Fraction], T: Fraction) -> tuple[Matrix, Exact]:
    """E(1), which must be symmetric and >= 0, and E-hat + Phi without its pole; `delayed` is Psi E."""
    static, R = delayed.split_at_one()
    D = (R.C @ R.B + static.scaled(Fraction(1, 2))).scaled(T) + Matrix.diag(phi)
    return static, Exact(R.A, R.B, (R.C @ R.A).scaled(T), D)


def coupling_block(H: Exact, phi: Sequence[Fraction], delta: Sequence[Fraction], T: Fraction) -> tuple[Matrix, Exact]:
    """H(1), which must be symmetric, and the block that carries the excess of V-hat; raises ValueError for bad Phi."""
    if len(phi) != len(delta) or not all(0 <= p < d for p, d in zip(phi, delta, strict=True)):
        raise ValueError("the multiplier Phi is not between 0 and the device damping on every channel")
    static, R = H.split_at_one()
    n, m = H.order, len(delta)
    S = Matrix.diag(_excess(p, d) for p, d in zip(phi, delta, strict=True))
    B = block([[R.B, Matrix.zeros(n, m)]])
    C = block([[-R.C.scaled(T)], [H.C.scaled(Fraction(2))]])
    D = block([[static.scaled(T / 2), Matrix.zeros(m, m)], [H.D.scaled(Fraction(2)), S]])
    return static, Exact(R.A, B, C, D)


def _excess(phi: Fraction, delta: Fraction) -> Fraction:
    return (1 / phi - 1 / delta) * (1 - STRICT) if phi else UNLIMITED / delta


# ----------------------------------------------------------------------------------------------------
# An exact proof that no switching of the delays within a loop's range is dangerous: made, stored, proved again.
#
# With G the forces as they leave, F = Theta_nom G, F(z) = F(1) + (z - 1) R(z) and F(1) exactly symmetric and positive
# semidefinite, the block
#     [[R + Delta_D/T - diag(alpha)/2 - F(1)/2,  0], [2 h G,  2 diag(alpha)]]
# is strictly positive real (design.proof.positive_real): its Hermitian part on |z| = 1 is the matrix of condition.py.
# Channels whose delay does not vary have no row and column of the second kind, and alpha = 0.


CLAIM_TOLERANCE = 1e-6  # between the required damping on file and the one swept again, which repeats to 1e-9


def sent(loop: Loop, coupling: Coupling) -> Lti:
    """G = (I + Psi E V)^-1 Psi E: the forces as they leave for the devices. Raises SingularLoop."""
    return force_map(environment(loop.environment, loop.T), coupling, (0,) * len(loop.theta), loop.psi)


def swept(loop: Loop, coupling: Coupling, alpha: Sequence[float] | None = None) -> JitterProof:
    """What switching within the loop's range asks, by a sweep; with the multiplier `alpha` [N/m] where it is given."""
    span = range_of(loop)
    try:
        G = sent(loop, coupling)
    except SingularLoop as error:
        return jitter_refusal(loop.delta, str(error))
    return jitter_proof(G, span.lo, span.hi, loop.delta, alpha)


def prove_switching(loop: Loop, coupling: Coupling) -> SwitchingProof | str:
    """An exact proof of any switching within the loop's range, or why there is none."""
    found = swept(loop, coupling)
    requirement = found.requirement
    if not requirement.certified:
        needed, have = (", ".join(f"{d:.6g}" for d in side) for side in (requirement.required, requirement.available))
        return requirement.reason or f"needs {needed} N s/m of damping, has {have}"
    P = storage(loop, coupling, found.alpha)
    if isinstance(P, str):
        return P
    return SwitchingProof(requirement.required, _margin(found), found.alpha, rows_of(P))


def storage(loop: Loop, coupling: Coupling, alpha: Sequence[float]) -> Matrix | str:
    """The matrix that proves the condition for these alpha [N/m] at the loop's damping, or why there is none."""
    try:
        condition = condition_block(loop, coupling, alpha)
    except (SingularMatrix, ValueError) as error:
        return str(error)
    P, reason = find_storage(condition)
    return str(reason) if P is None else P


def refuted(loop: Loop, coupling: Coupling, proof: SwitchingProof | msgspec.UnsetType) -> str | None:
    """Why what is on file does not prove that the delays may switch within the loop's range, or None if it does."""
    if loop.jitter is None:
        return None if proof is msgspec.UNSET else "a proof for switching delays, but the loop's delays are constant"
    reason = "no proof is on file" if proof is msgspec.UNSET else _refuted(loop, coupling, proof)
    return reason and f"{switching_promise(loop.jitter)}: {reason}"


def _refuted(loop: Loop, coupling: Coupling, proof: SwitchingProof) -> str | None:
    try:
        condition = condition_block(loop, coupling, proof.alpha)
    except (SingularMatrix, ValueError) as error:
        return str(error)
    found = swept(loop, coupling, proof.alpha)
    required = found.requirement.required
    if len(proof.required) != len(required) or not np.allclose(proof.required, required, rtol=CLAIM_TOLERANCE):
        return f"required is {list(proof.required)}, the sweep finds {list(required)}"
    if not np.isclose(proof.margin, _margin(found), rtol=CLAIM_TOLERANCE):
        return f"margin is {proof.margin:.9g}, the sweep finds {_margin(found):.9g}"
    return refuted_rows("P", condition, proof.P)


def condition_block(loop: Loop, coupling: Coupling, alpha: Sequence[float]) -> Exact:
    """The block that must be strictly positive real.

    Raises ValueError where alpha [N/m] is no multiplier of this range, the model has too many states, or F(1) is not
    exactly as it must be; SingularMatrix where the loop has a pole at z = 1.
    """
    m, T, span = len(loop.delta), rational(loop.T), range_of(loop)
    widths = [hi - lo for lo, hi in zip(span.lo, span.hi, strict=True)]  # 2 h
    varying = [i for i, width in enumerate(widths) if width]
    if len(alpha) != m or any((a > 0) != (width > 0) or a < 0 for a, width in zip(alpha, widths, strict=True)):
        raise ValueError(f"alpha is {list(alpha)}, expected a positive number where the delay varies and 0 elsewhere")
    multiplier = [rational(float(a)) for a in alpha]
    G = exact.force_map(exact.environment(loop.environment, T), coupling, (0,) * m, loop.psi, T)
    F = nominal(span) @ G
    if reason := too_large(F):  # splitting it takes long too
        raise ValueError(reason)
    F1, R = F.split_at_one()
    if not F1.equals(F1.T) or not definiteness(F1).semidefinite:
        raise ValueError("G(1) is not exactly symmetric and positive semidefinite")
    damping = Matrix.diag(rational(d) / T - a / 2 for d, a in zip(loop.delta, multiplier, strict=True))
    upper = damping - F1.scaled(Fraction(1, 2))
    if not varying:
        return Exact(R.A, R.B, R.C, upper)
    spread = Matrix.of([[widths[i] * (i == j) for j in range(m)] for i in varying])
    error = block([[spread @ G.C, Matrix.zeros(len(varying), F.order - G.order)]])
    lower = Matrix.diag(2 * multiplier[i] for i in varying)
    direct = block([[upper, Matrix.zeros(m, len(varying))], [spread @ G.D, lower]])
    return Exact(R.A, block([[R.B, Matrix.zeros(R.order, len(varying))]]), block([[R.C], [error]]), direct)


def nominal(span: DelayRange) -> Exact:
    """Theta_nom = (z^-lo + z^-hi)/2, diagonal: a chain of hi unit delays per channel, tapped at lo and at its end."""
    return Exact.diag(*(_tapped(lo, hi) for lo, hi in zip(span.lo, span.hi, strict=True)))


def _tapped(lo: int, hi: int) -> Exact:
    if hi == 0:
        return Exact.constant(Matrix.eye(1))
    weights = [Fraction((i == lo) + (i == hi), 2) for i in range(hi + 1)]
    first = Matrix.of([[int(i == 0)] for i in range(hi)])
    return Exact(Matrix(np.eye(hi, k=-1, dtype=object)), first, Matrix.of([weights[1:]]), Matrix.of([weights[:1]]))


def range_of(loop: Loop) -> DelayRange:
    """The range of the loop's delays, of no width where they are constant."""
    return loop.jitter or DelayRange(loop.theta, loop.theta)


def _margin(found: JitterProof) -> float:
    return 1 / max(found.requirement.ratio, 1e-12)


# ----------------------------------------------------------------------------------------------------
# What a report says of delays that vary: the jitter-proof requirement beside that of the playout buffer.


NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: jitter on the "
    "measured positions, jitter of T, or forces older than the range, which lost packets make."
)


def switching_requirement(loop: Loop, coupling: Coupling) -> JitterProof:
    """The damping that switching within loop.jitter asks; `proof` is "rational" where exact arithmetic confirms it."""
    found = swept(loop, coupling)
    if not found.requirement.certified or not isinstance(storage(loop, coupling, found.alpha), Matrix):
        return found
    return replace(found, requirement=replace(found.requirement, proof="rational"))


def switching_part(found: JitterProof, G: Lti, span: DelayRange) -> dict[str, Any]:
    """The requirement with its multiplier, and what a playout buffer to the constant delay hi would need.

    G is the force map without Theta.
    """
    buffered = closed_loop(delay(span.hi, G.T) @ G, found.requirement.available)
    return certificate_part(found.requirement) | {
        "lo": list(span.lo),
        "hi": list(span.hi),
        "alpha": [finite(a) for a in found.alpha],
        "playout": {
            "theta": list(span.hi),
            "required_damping": [finite(d) for d in buffered.required],
            "certified": buffered.certified,
        },
        "not_covered": NOT_COVERED,
    }


# ----------------------------------------------------------------------------------------------------
# Certificates of couplings: proved once, stored, and proved again from the file alone without a solver.
#
# closed-loop: F(1) is exactly symmetric and positive semidefinite, and with F(z) = F(1) + (z - 1) R(z) the block
#     R + Delta_D/T - F(1)/2
# is strictly positive real (design.proof.positive_real). On |z| = 1 the Hermitian part of F(1)/(z - 1) is -F(1)/2, so
# He[F/(z-1)] > -Delta_D/T there; the same certificate shows that F is stable.
#
# theorem4, psi = 0: with H = V - Theta-hat (11), (12), V-hat = (1 - 1/z) H/T, H(1) is exactly symmetric, and with
# H(z) = H(1) + (z - 1) R(z) the block
#     H(1)/2 - R
# is strictly positive real. Then He V-hat = |1 - 1/z|^2 He[H(1)/2 - R]/T >= Delta_V V-hat* V-hat for a small
# Delta_V > 0, as V-hat carries the same factor: V-hat is stable and output strictly passive. The environment is
# passive because every parameter of the network is non-negative (the Network type refuses others), so
# Phi = 0 satisfies Lemma 4, whatever the environment.
#
# With a box around the environment the same is proved for the environment (P) and for every vertex (P1, P2, ..);
# nothing is proved of the environments in between, or of one that changes.
#
# A loop whose delays may switch within a range carries a second proof, of any switching (design.jitter.proof).
#
# theorem4, psi >= 1: a multiplier Phi, stored too, and two blocks (design.proof.delayed); it is of this environment.


CLAIM_TOLERANCE_CERTIFICATE = (
    1e-6  # between the required damping on file and the one swept again, which repeats to 1e-9
)


class NotProved(ValueError):
    """No proof of the condition was found; carries the requirement that the sweep found, if there is one."""

    def __init__(self, reason: str, requirement: margin.Requirement | None = None) -> None:
        super().__init__(reason)
        self.requirement = requirement


@dataclass(frozen=True)
class Verdict:
    """Whether a stored certificate is a proof, and if not, why."""

    proved: bool
    reason: str | None = None


def prove(loop: Loop, coupling: CouplingData, condition: Condition, phi: Sequence[float] | None = None) -> Certificate:
    """A certificate with an exact proof of the condition; `phi` [N s/m] is Theorem 4's multiplier where psi >= 1.

    Raises NotProved with the reason.
    """
    multiplier = None if phi is None else [rational(float(p)) for p in phi]
    requirement = required_damping(loop, coupling, condition, multiplier)
    if not requirement.certified:
        needed = ", ".join(f"{d:.6g}" for d in requirement.required)
        have = ", ".join(f"{d:.6g}" for d in requirement.available)
        reason = requirement.reason or f"needs {needed} N s/m of damping, has {have}"
        place = f"P{worst(in_each(loop, coupling.build(loop.T), loop.members()))}" if loop.box else "P"
        raise NotProved(f"{_place_certificate(loop, condition, place)}{reason}", requirement)
    proof: dict[str, Matrix] = {}
    for name, real in _blocks(loop, coupling, condition, multiplier).items():
        _require_size(real, requirement)
        P, reason = find_storage(real)
        if P is None:
            asked = f"the sweep asks {requirement.ratio:.9f} of the available damping"
            raise NotProved(f"{_place_certificate(loop, condition, name)}{reason}; {asked}", requirement)
        proof[name] = P
    if multiplier is not None:
        proof["Phi"] = Matrix.of([multiplier])
    return sealed(
        Certificate(
            condition=condition,
            required=requirement.required,
            available=loop.delta,
            margin=1 / max(requirement.ratio, 1e-12),
            promise=_promise(loop, condition),
            proof="rational",
            matrices={name: rows_of(M) for name, M in proof.items()},
            scenario=digest(loop, coupling),
            versions={"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__},
            switching=_switching(loop, coupling, requirement),
        )
    )


def _switching(
    loop: Loop, coupling: CouplingData, requirement: margin.Requirement
) -> SwitchingProof | msgspec.UnsetType:
    """The proof that the delays may switch, of a loop with a range of them. Raises NotProved."""
    if loop.jitter is None:
        return msgspec.UNSET
    proof = prove_switching(loop, coupling.build(loop.T))
    if isinstance(proof, str):
        raise NotProved(f"{switching_promise(loop.jitter)}: {proof}", requirement)
    return proof


def verify(stored: Stored) -> Verdict:
    """Prove the stored certificate again: its bookkeeping, its figures, then its matrices in exact arithmetic."""
    certificate = stored.certificate
    if certificate is None:
        return Verdict(False, "the file carries no certificate")
    if certificate.scenario != digest(stored.loop, stored.coupling):
        return Verdict(False, "scenario digest differs: the loop or the coupling was changed after it was certified")
    if sealed(certificate).seal != certificate.seal:
        return Verdict(False, "seal differs: the certificate was changed after it was made")
    try:
        reason = _refuted_claims(stored.loop, stored.coupling, certificate) or _refuted_proof(
            stored.loop, stored.coupling, certificate
        )
    except NotProved as refusal:
        reason = str(refusal)
    return Verdict(reason is None, reason)


def required_damping(
    loop: Loop, coupling: CouplingData, condition: Condition, phi: Sequence[Fraction] | None = None
) -> margin.Requirement:
    """The damping that the condition asks, from a refined sweep: closed-loop, the most over all members of the set.

    Raises NotProved where it is undefined: theorem4 with psi >= 1 needs the multiplier phi.
    """
    built = coupling.build(loop.T)
    if loop.environment.walls and (condition == "closed-loop" or any(loop.psi)):
        raise NotProved("of walls only theorem4 without delay in the environment is proved; the rest is for linear E")
    if condition == "closed-loop":
        requirements = in_each(loop, built, loop.members())
        return requirements[worst(requirements)]
    match built:
        case controller_coupling.SpringDamper():
            V = built.compliance(loop.T)
        case controller_coupling.Compliance(V=V):
            pass
        case _:
            V = None
    if V is not None and not any(loop.psi):
        return margin.theorem4(V, loop.theta, loop.delta)
    if V is not None:
        if phi is None or len(phi) != len(loop.delta):
            raise NotProved("theorem4 with psi >= 1 needs a multiplier Phi, one entry per channel")
        E = environment(loop.environment, loop.T)
        values = np.array([float(p) for p in phi])
        return theorem4_delayed(V, E, loop.theta, loop.psi, loop.delta, values)
    return margin.refusal("theorem4", loop.delta, no_compliance(built))


def no_compliance(coupling: controller_coupling.Coupling) -> str:
    """Why Theorem 4 has nothing to say of a coupling that is no V of its own."""
    if isinstance(coupling, controller_coupling.InternalModel):
        return "the coupling contains a model of the environment: Theorem 4 is about one that knows none"
    return "without a coupling there is nothing that Theorem 4 could use"


def _promise(loop: Loop, condition: Condition) -> Literal["any passive environment", "a set", "this environment"]:
    if condition == "theorem4":
        return "this environment" if any(loop.psi) else "any passive environment"
    # proved at every vertex; whether it is kept between them is searched by design.box.check and design.check
    return "a set" if loop.box else "this environment"


def _place_certificate(loop: Loop, condition: Condition, matrix: str) -> str:
    """Which member of a set the matrix P, P1, P2, .. is about, as the beginning of a message."""
    if loop.box is None or condition == "theorem4":
        return ""
    return f"{loop.members()[int(matrix[1:] or 0)].name}: "


def _blocks(
    loop: Loop, coupling: CouplingData, condition: Condition, phi: Sequence[Fraction] | None
) -> dict[str, Exact]:
    """The blocks that must be strictly positive real, by the name of the matrix that proves it. Raises NotProved."""
    if condition == "closed-loop":
        names = [f"P{i or ''}" for i in range(len(loop.members()))]
        loops = [loop.at(member.network) for member in loop.members()]
        return {name: _block(each, coupling, condition) for name, each in zip(names, loops, strict=True)}
    if not any(loop.psi):
        return {"P": _block(loop, coupling, condition)}
    assert phi is not None  # required_damping has refused the rest
    T, delta = rational(loop.T), [rational(d) for d in loop.delta]
    try:
        E = exact.delay(loop.psi) @ exact.environment(loop.environment, T)
        E1, passive = environment_block(E, phi, T)
        H = exact.shifted_compliance(exact.compliance(coupling.build(loop.T), len(delta), T), loop.theta, delta, T)
        H1, excess = coupling_block(H, phi, delta, T)
    except (SingularMatrix, ValueError) as error:
        raise NotProved(str(error)) from None
    _require_static("E(1)", E1)
    _require_symmetric("H(1)", H1)
    return {"P": excess, "P_E": passive}


def _block(loop: Loop, coupling: CouplingData, condition: Condition) -> Exact:
    """The block that must be strictly positive real, after the exact test at z = 1. Raises NotProved."""
    T, delta = rational(loop.T), [rational(d) for d in loop.delta]
    built = coupling.build(loop.T)
    try:
        if condition == "closed-loop":
            F = exact.force_map(exact.environment(loop.environment, T), built, loop.theta, loop.psi, T)
            _require_size(F)
            F1, R = F.split_at_one()
            _require_static("F(1)", F1)
            return Exact(R.A, R.B, R.C, Matrix.diag(d / T for d in delta) - F1.scaled(Fraction(1, 2)))
        V = exact.compliance(built, len(delta), T)
        H = exact.shifted_compliance(V, loop.theta, delta, T)
        _require_size(H)
        H1, R = H.split_at_one()
    except SingularMatrix as error:
        raise NotProved(f"a pole at z = 1 or an algebraic loop without solution: {error}") from None
    _require_symmetric("H(1)", H1)
    return Exact(R.A, R.B, -R.C, H1.scaled(Fraction(1, 2)))


def _require_size(block: Exact, requirement: margin.Requirement | None = None) -> None:
    if reason := too_large(block):
        raise NotProved(reason, requirement)


def _require_symmetric(name: str, value: Matrix) -> None:
    if not value.equals(value.T):
        raise NotProved(f"{name} is not exactly symmetric")


def _require_static(name: str, value: Matrix) -> None:
    _require_symmetric(name, value)
    outcome = definiteness(value)
    if not outcome.semidefinite:
        raise NotProved(f"{name} is not positive semidefinite: {outcome}")


def _refuted_claims(loop: Loop, coupling: CouplingData, certificate: Certificate) -> str | None:
    """Why the figures on file do not follow from the loop and the coupling, or None."""
    if certificate.proof != "rational":
        return f"the certificate is {certificate.proof}: it carries no exact proof"
    if certificate.promise != _promise(loop, certificate.condition):
        return f"{certificate.condition} does not promise {certificate.promise!r}"
    if certificate.available != loop.delta:
        return f"available is {list(certificate.available)}, the loop has delta = {list(loop.delta)}"
    requirement = required_damping(loop, coupling, certificate.condition, _multiplier(certificate))
    if len(certificate.required) != len(loop.delta) or not np.allclose(
        certificate.required, requirement.required, rtol=CLAIM_TOLERANCE_CERTIFICATE
    ):
        return f"required is {list(certificate.required)}, the sweep finds {list(requirement.required)}"
    if not np.isclose(certificate.margin, 1 / max(requirement.ratio, 1e-12), rtol=CLAIM_TOLERANCE_CERTIFICATE):
        return f"margin is {certificate.margin:.9g}, the sweep finds {1 / max(requirement.ratio, 1e-12):.9g}"
    return None


def _refuted_proof(loop: Loop, coupling: CouplingData, certificate: Certificate) -> str | None:
    """Why the matrices prove nothing, or None if they prove the condition."""
    phi = _multiplier(certificate)
    blocks = _blocks(loop, coupling, certificate.condition, phi)
    expected = {*blocks, *(["Phi"] if "P_E" in blocks else [])}
    if set(certificate.matrices) != expected:
        found = ", ".join(certificate.matrices) or "none"
        return f"matrices are {found}, expected {', '.join(sorted(expected))}"
    for name, real in blocks.items():
        if reason := refuted_rows(name, real, certificate.matrices[name]):
            return f"{_place_certificate(loop, certificate.condition, name)}{reason}"
    return refuted(loop, coupling.build(loop.T), certificate.switching)


def _multiplier(certificate: Certificate) -> list[Fraction] | None:
    """The stored Phi, or None. Raises NotProved where it is no row of rationals."""
    rows = certificate.matrices.get("Phi")
    if rows is None:
        return None
    try:
        return [Fraction(value) for value in rows[0]]
    except (IndexError, ValueError, ZeroDivisionError):
        raise NotProved("Phi is no row of rational numbers") from None


CONDITIONS: tuple[Condition, ...] = ("theorem4", "closed-loop")


def specification(loop: Loop) -> Specification:
    """The loop as a request for a design, every wall touching. Raises ValueError naming the field that is wrong."""
    E = environment(held(loop.environment), loop.T)
    if loop.box is None:
        return Specification(E, loop.theta, loop.psi, loop.lam, loop.delta)
    box = loop.box

    def others(factor: float = 1.0) -> dict[str, Lti]:
        _, *vertices = members(loop.environment, box if factor == 1 else shrunk(loop.environment, box, factor))
        return {vertex.name: environment(vertex.network, loop.T) for vertex in vertices}

    delays, parts = (loop.theta, loop.psi, loop.lam), regions(loop.environment, box)
    return Specification(E, *delays, loop.delta, others=others(), regions=parts, shrunk=others)


def assess(loop: Loop, coupling: Coupling, phi: Array | None = None) -> dict[str, Requirement]:
    """Required damping by each condition; `phi` is the multiplier that the coupling was designed with, if any.

    closed-loop is about the nominal environment alone (design.box.check asks for the rest of its box) and the constant
    theta (design.jitter.part asks for the rest of its range); where there are walls it is about the frozen contact
    state that asks for most.
    """
    loop = loop.at(loop.environment).switching(None)
    any_environment = theorem4_of(loop.environment, loop.T, coupling, loop.theta, loop.psi, loop.delta, phi)
    this_environment = closed_loop_of(loop.environment, loop.T, coupling, loop.theta, loop.psi, loop.delta)
    return {
        "theorem4": _proved(loop, coupling, any_environment, phi),
        "closed-loop": _proved(loop, coupling, this_environment),
    }


def closed_loop_of(
    network: Network,
    T: float,
    coupling: Coupling,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
) -> Requirement:
    """The closed-loop requirement; of an environment with walls, that of its most demanding contact state."""
    states = (environment(state, T) for state in frozen_states(network).values())
    requirements = [closed_loop(force_map(E, coupling, theta, psi), delta) for E in states]
    return max(requirements, key=lambda requirement: requirement.ratio)


def theorem4_of(
    network: Network,
    T: float,
    coupling: Coupling,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
    phi: Array | None = None,
) -> Requirement:
    """Theorem 4's requirement; walls are covered without delay in the environment, and refused with it."""
    if network.walls and any(psi):
        return refusal("theorem4", delta, "with delay in the environment its multiplier is of a linear one: no walls")
    return theorem4_requirement(coupling, environment(held(network), T), theta, psi, delta, phi)


def theorem4_requirement(
    coupling: Coupling,
    E: Lti,
    theta: tuple[int, ...],
    psi: tuple[int, ...],
    delta: tuple[float, ...],
    phi: Array | None = None,
) -> Requirement:
    """Theorem 4 for any coupling; E matters only with delay inside it, which takes a multiplier phi."""
    match coupling:
        case SpringDamper_coupling() if not any(psi):
            return theorem4_per_channel(coupling.channels(E.T), theta, delta)
        case SpringDamper_coupling():
            V = coupling.compliance(E.T)
        case Compliance_coupling(V=V):
            pass
        case _:
            return refusal("theorem4", delta, no_compliance(coupling))
    if not any(psi):
        return theorem4(V, theta, delta)
    if phi is None:
        from design.lmi import shortage  # only an environment with delay inside needs the solver

        try:
            phi = shortage(Specification(E, theta, psi, theta, delta))
        except ValueError as error:
            return refusal("theorem4", delta, str(error))
    assert phi is not None  # psi >= 1 has a multiplier or none is possible
    return theorem4_delayed(V, E, theta, psi, delta, phi)


def _proved(loop: Loop, coupling: Coupling, requirement: Requirement, phi: Array | None = None) -> Requirement:
    """The requirement with `proof` = 'rational' where an exact proof was found, as it is where not."""
    if not requirement.certified:
        return requirement
    try:
        prove(loop, data_of(coupling), requirement.condition, None if phi is None else phi.tolist())
    except NotProved:
        return requirement
    return replace(requirement, proof="rational")
