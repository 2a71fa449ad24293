"""What both conditions ask of a coupling in its loop, proved exactly wherever that is possible."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import scipy

from controller.coupling import (
    Coupling,
    ForceFilter,
    Form,
    InternalModel,
    MovingAverage,
    SpringDamper,
    Strict,
    require_channels,
)
from controller.delay import delay
from controller.environment import Member
from controller.loop import DelayRange, Loop
from controller.lti import Array, Lti, SingularLoop, rational
from design.conditions import (
    BETA,
    Condition,
    JitterProof,
    Lags,
    LimiterProof,
    Requirement,
    WallsProof,
    any_environment,
    any_environment_delayed,
    any_environment_demand,
    any_environment_per_channel,
    delayed_coupling_block,
    delayed_environment_block,
    encoder_friction,
    jitter_proof,
    jitter_refusal,
    limiter,
    limiter_demand,
    limiter_lag,
    refusal,
    switching_block,
    this_environment,
    this_environment_demand,
    walls_demand,
    walls_proof,
)
from design.exact import LARGEST, Matrix, definiteness, find_storage, refuted_rows, rows_of, too_large
from design.files import InputError, read, write
from design.frequency import frequencies, on_circle, rounding
from design.result import OLDER_NAMES

# ----------------------------------------------------------------------------------------------------
# The file in which a coupling is kept: the loop it was made for, its coefficients and its certificate, as JSON.
#
# Numbers are plain decimals, rationals are strings "p/q". Reading is strict: an unknown or ill-typed field is an
# error that names it.


Rows = tuple[tuple[float, ...], ...]
Rational = Annotated[str, msgspec.Meta(pattern=r"^-?[0-9]+(/[0-9]+)?$", max_length=1000)]


class SwitchingProof(Strict, frozen=True):
    """What proves that the delays may switch within the loop's range (design.jitter.proof)."""

    required: tuple[float, ...]  # (m,) [N s/m] with this multiplier, from a refined sweep
    margin: float  # available / required
    alpha: tuple[float, ...]  # (m,) multiplier [N/m], 0 where the delay does not vary
    P: tuple[tuple[Rational, ...], ...]  # rationals "p/q"


class LimiterCertificate(Strict, frozen=True):
    """What proves this-environment also while forces are limited, by the limiter of controller.process."""

    beta: float  # rho = beta delta/T, to six digits
    rho: tuple[float, ...]  # (m,) lag of the limiter [N/m]; the tick must use these
    c: tuple[tuple[float, ...], ...]  # (m, lags) multiplier
    required: tuple[float, ...]  # (m,) [N s/m] with this multiplier, from a refined sweep
    margin: float  # available / required
    P: tuple[tuple[Rational, ...], ...]  # rationals "p/q"


class Certificate(Strict, frozen=True):
    """What is claimed of a coupling in its loop, and what proves it."""

    condition: Condition
    required: tuple[float, ...]  # (m,) [N s/m], from a refined sweep
    available: tuple[float, ...]  # (m,) [N s/m], the damping for which it is proved
    margin: float  # available / required
    guarantee: Literal["any passive environment", "a set", "this environment"] = msgspec.field(name="promise")
    proof: Literal["sampled", "kyp", "rational"]
    matrices: dict[str, tuple[tuple[Rational, ...], ...]]  # rationals "p/q"
    scenario: str  # digest of the loop and the coupling
    versions: dict[str, str]
    seal: str = ""  # digest of all other fields
    switching: SwitchingProof | msgspec.UnsetType = msgspec.UNSET  # of a loop with jitter; left out of other files
    limiter: LimiterCertificate | msgspec.UnsetType = msgspec.UNSET  # where it was proved; left out of other files


class Stored(Strict, frozen=True):
    """A coupling with its loop and, once it is proved, its certificate."""

    loop: Loop
    coupling: Form
    certificate: Certificate | None = None
    version: Literal[1, 2] = 2  # 2: force filters

    def __post_init__(self) -> None:
        require_channels(self.coupling, self.loop.channels)

    @classmethod
    def of(cls, loop: Loop, coupling: Coupling, certificate: Certificate | None = None) -> Stored:
        """What a file keeps of a coupling in its loop."""
        return cls(loop, coupling.form(), certificate)

    def built(self) -> Coupling:
        """The coupling."""
        return self.coupling.build(self.loop.T)


def digest(*parts: msgspec.Struct) -> str:
    """sha256 over the canonical JSON (sorted keys, shortest decimals, 7 as 7.0 where it is a float) of the parts."""
    return _sha256([_plain(part) for part in parts])


def _plain(part: msgspec.Struct) -> Any:
    return msgspec.to_builtins(msgspec.json.decode(msgspec.json.encode(part), type=type(part)))


def _sha256(plain: list[Any]) -> str:
    return hashlib.sha256(msgspec.json.encode(plain, order="deterministic")).hexdigest()


def sealed(certificate: Certificate) -> Certificate:
    """The certificate with the digest of all its other fields, its condition by the name of the first files."""
    older = {name: before for before, name in OLDER_NAMES.items()}
    plain = _plain(msgspec.structs.replace(certificate, seal=""))
    seal = _sha256([plain | {"condition": older[certificate.condition]}])
    return msgspec.structs.replace(certificate, seal=seal)


def load(path: str | Path) -> Stored:
    """Read a stored coupling. Raises InputError, one line that names the field or the file."""
    content = read(path)
    if not content.strip():
        raise InputError(f"{path}: is empty, expected a coupling as python -m design stores it")
    try:
        stored = msgspec.json.decode(_renamed(content), type=Stored)
        json.loads(content, object_pairs_hook=_once)
        return stored
    except _Twice as error:
        raise InputError(f"{path}: names {str(error)!r} twice in one object") from None
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: is no stored coupling: {' '.join(str(error).split())}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{path}: {_place(content, str(error))}{' '.join(str(error).split())}") from None


def _renamed(content: bytes) -> bytes:
    """The content with the condition by its name of today; as it is where it has that, or is no certificate."""
    try:
        whole = msgspec.json.decode(content)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return content
    match whole:
        case {"certificate": {"condition": str(name)} as claim} if name in OLDER_NAMES:
            return msgspec.json.encode(whole | {"certificate": claim | {"condition": OLDER_NAMES[name]}})
    return content


class _Twice(Exception):
    """A name that an object of a file gives two values."""


def _once(pairs: list[tuple[str, Any]]) -> None:
    """Of the last value JSON readers speak, of the first one a person who reads the file."""
    names: set[str] = set()
    for name, _ in pairs:
        if name in names:
            raise _Twice(name)
        names.add(name)


def _place(content: bytes, message: str) -> str:
    """Number and beginning of the line that a message points to as "(byte N)", or nothing."""
    found = re.search(r"\(byte (\d+)\)", message)
    if not found:
        return ""
    above = content[: int(found[1])].count(b"\n")
    return f"line {above + 1}, {content.splitlines()[above].decode(errors='replace').strip()[:40]!r}: "


def save(stored: Stored, path: str | Path) -> None:
    """Write through a temporary file beside `path`, so that a reader never sees half of it. Raises InputError."""
    write(Path(path), msgspec.json.format(msgspec.json.encode(stored), indent=1) + b"\n")


# ----------------------------------------------------------------------------------------------------
# What may be said of a coupling: required against available damping, for which environments, and what is left out.


ANY, SET, HERE = "any passive environment", "a set", "this environment"
FROZEN = "each frozen contact state of this environment (contact that makes and breaks is not covered)"

MAKING = "this environment, with walls up to their stiffness that make and break contact"

#: What no certificate covers.
CAVEATS = (
    "The proofs are for the linear loop: they hold while forces stay below their limits (clipped ticks are counted) "
    "or leave through the limiter that a report names, "
    "not for walls with dampers that make and break contact (except under any-environment without delay in the "
    "environment), periods longer than the loop's T_max (T where it has none), encoder steps beyond what Coulomb "
    "friction pays for, velocity filters or friction compensation."
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


def switching_guarantee(span: DelayRange) -> str:
    """Which delays of the forces a coupling is certified for that bears switching, in the environment of its loop."""
    return f"delays switching within {span}"


def guarantee_of(requirements: Mapping[str, Requirement], loop: Loop, whole_set: bool = False) -> str | None:
    """For which environments a coupling is certified, by its requirements; None for none.

    The multiplier that any-environment takes for psi >= 1 is of one environment. `whole_set`: this-environment is
    proved at every vertex of the loop's box, and a search has found no violation between them.
    """
    if requirements["any-environment"].certified and not any(loop.psi):
        return ANY
    if whole_set:
        return SET
    if not any(requirement.certified for requirement in requirements.values()):
        return None
    if loop.environment.walls:
        return MAKING if making_covered(loop) else FROZEN
    return loop.environment.here


def encoder_part(
    loop: Loop, coupling: Coupling, steps: Sequence[float], friction: Sequence[float]
) -> dict[str, Any] | None:
    """Whether declared Coulomb friction (m,) [N] pays for encoder steps (m,) [m]; None where encoders are ideal."""
    if not any(steps):
        return None
    widths = ", ".join(f"{1e6 * q:.4g}" for q in steps)
    part: dict[str, Any] = {"encoder_step": list(steps), "friction": list(friction)}
    if loop.environment.walls:
        words = f"encoder steps of {widths} um: with walls nothing is proved of them"
        return part | {"friction_needed": None, "covered": False, "words": words}
    needed = encoder_friction(loop.F(coupling), steps)
    covered = bool((needed <= np.asarray(friction)).all())
    has = ", ".join(f"{f:.4g}" for f in friction)
    enough = (
        f"friction of {', '.join(f'{f:.4g}' for f in needed)} N is enough for {widths} um, the devices declare {has} N"
    )
    words = f"encoder steps {'are covered' if covered else 'are not covered'}: {enough}"
    return part | {"friction_needed": [finite(f) for f in needed], "covered": covered, "words": words}


# ----------------------------------------------------------------------------------------------------
# A coupling in every environment of a set: what the this-environment condition asks at each vertex of a box.


def making_covered(loop: Loop) -> bool:
    """Whether this-environment covers walls that make and break contact: those without dampers."""
    walls = loop.environment.walls
    return bool(walls) and not loop.box and not any(wall.damping for wall in walls)


def in_each(loop: Loop, coupling: Coupling, members: Sequence[Member]) -> list[Requirement]:
    """The this-environment condition of this coupling around each of the members, every one frozen."""
    return [_required(loop, coupling, member) for member in members]


def worst(requirements: Sequence[Requirement]) -> int:
    """Which of them asks the most."""
    return max(range(len(requirements)), key=lambda i: requirements[i].ratio)


def _required(loop: Loop, coupling: Coupling, member: Member) -> Requirement:
    try:
        F = loop.at(member.network).F(coupling)
    except SingularLoop as error:
        return refusal("this-environment", loop.delta, str(error))
    return this_environment(F, loop.delta, loop.T_max, loop.latency)


# ----------------------------------------------------------------------------------------------------
# An exact proof that no switching of the delays within a loop's range is dangerous: made, stored, proved again.
#
# With G the forces as they leave, F = Theta_nom G, F(z) = F(1) + (z - 1) R(z) and F(1) exactly symmetric and positive
# semidefinite, the block
#     [[R + Delta_D/T - diag(alpha)/2 - F(1)/2,  0], [2 h G,  2 diag(alpha)]]
# is strictly positive real (design.proof.positive_real): its Hermitian part on |z| = 1 is the matrix of condition.py.
# Channels whose delay does not vary have no row and column of the second kind, and alpha = 0.


CLAIM_TOLERANCE = 1e-6  # between the required damping on file and the one swept again, which repeats to 1e-9


def swept(loop: Loop, coupling: Coupling, alpha: Sequence[float] | None = None) -> JitterProof:
    """What switching within the loop's range asks, by a sweep; with the multiplier `alpha` [N/m] where it is given."""
    span = loop.delays
    try:
        G = loop.sent(coupling)
    except SingularLoop as error:
        return jitter_refusal(loop.delta, str(error))
    return jitter_proof(G, span.lo, span.hi, loop.delta, alpha, loop.T_max)


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
    except (SingularLoop, ValueError) as error:
        return str(error)
    P, reason = find_storage(condition)
    return str(reason) if P is None else P


def refuted(loop: Loop, coupling: Coupling, proof: SwitchingProof | msgspec.UnsetType) -> str | None:
    """Why what is on file does not prove that the delays may switch within the loop's range, or None if it does."""
    if loop.jitter is None:
        return None if proof is msgspec.UNSET else "a proof for switching delays, but the loop's delays are constant"
    reason = "no proof is on file" if proof is msgspec.UNSET else _refuted(loop, coupling, proof)
    return reason and f"{switching_guarantee(loop.jitter)}: {reason}"


def _refuted(loop: Loop, coupling: Coupling, proof: SwitchingProof) -> str | None:
    try:
        condition = condition_block(loop, coupling, proof.alpha)
    except (SingularLoop, ValueError) as error:
        return str(error)
    found = swept(loop, coupling, proof.alpha)
    required = found.requirement.required
    if len(proof.required) != len(required) or not np.allclose(proof.required, required, rtol=CLAIM_TOLERANCE):
        return f"required is {list(proof.required)}, the sweep finds {list(required)}"
    if not np.isclose(proof.margin, _margin(found), rtol=CLAIM_TOLERANCE):
        return f"margin is {proof.margin:.9g}, the sweep finds {_margin(found):.9g}"
    return refuted_rows("P", condition, proof.P)


def condition_block(loop: Loop, coupling: Coupling, alpha: Sequence[float]) -> Lti:
    """The exact block that must be strictly positive real.

    Raises ValueError where alpha [N/m] is no multiplier of this range, the model has too many states, or F(1) is not
    exactly as it must be; SingularLoop where the loop has a pole at z = 1.
    """
    span, m = loop.delays, loop.channels
    widths = [hi - lo for lo, hi in zip(span.lo, span.hi, strict=True)]
    if len(alpha) != m or any((a > 0) != (width > 0) or a < 0 for a, width in zip(alpha, widths, strict=True)):
        raise ValueError(f"alpha is {list(alpha)}, expected a positive number where the delay varies and 0 elsewhere")
    G = loop.sent(coupling, exact=True)
    if reason := too_large(G.order + sum(span.hi)):  # splitting it takes long too
        raise ValueError(reason)
    block, F1 = switching_block(G, span.lo, span.hi, loop.delta, alpha, loop.T_max)
    static = Matrix.of(F1)
    if not static.equals(static.T) or not definiteness(static).semidefinite:
        raise ValueError("G(1) is not exactly symmetric and positive semidefinite")
    return block


def _margin(found: JitterProof) -> float:
    return 1 / max(found.requirement.ratio, 1e-12)


# ----------------------------------------------------------------------------------------------------
# An exact proof that a coupling is safe in this environment also while its forces are limited: made, stored, proved
# again. F(1) is exactly symmetric and positive semidefinite, and design.conditions.limiter_demand is strictly
# positive real. any-environment without delay in the environment needs no proof of its own: with rho = 0 the limiter
# and the environment together are a passive environment.


def limiter_refusal(loop: Loop) -> str | None:
    """Why the limiter's own condition has nothing to say of a loop, or None."""
    if loop.jitter:
        return "limiter: forces that are limited are proved for constant delays, not for delays that switch"
    if loop.environment.walls:
        return "limiter: with walls only any-environment covers limited forces (no delay in the environment)"
    if loop.box:
        return "limiter: limited forces are proved for one environment, not for ranges"
    if loop.latency:
        return "limiter: limited forces are proved for forces that latch at ticks, not for a latency"
    return None


def limiter_requirement(loop: Loop, coupling: Coupling, beta: float = BETA, c: Lags | None = None) -> LimiterProof:
    """What this-environment asks with the limiter of rho = beta delta/T, at the multiplier `c` or the best one.

    `proof` of the requirement is "sampled"; `prove` gives the exact one.
    """
    rho = limiter_lag(loop.delta, loop.T, beta)
    reason = limiter_refusal(loop)
    try:
        if reason is None:
            return limiter(loop.sent(coupling), loop.theta, loop.delta, rho, c, T_max=loop.T_max)
    except SingularLoop as error:
        reason = str(error)
    return LimiterProof(refusal("limiter", loop.delta, reason), rho, ((),) * loop.channels, math.inf)


def lag(loop: Loop, certificate: Certificate | None) -> tuple[float, ...] | None:
    """rho (m,) [N/m] of the limiter that the certificate covers, or None where limited forces are not covered."""
    if certificate is None:
        return None
    if certificate.limiter is not msgspec.UNSET:
        return certificate.limiter.rho
    covered = certificate.condition == "any-environment" and not any(loop.psi) and loop.jitter is None
    return (0.0,) * loop.channels if covered else None


@dataclass(frozen=True)
class Limits:
    """Whether a guarantee holds while forces are at their limits, and the limiter that it is about."""

    rho: tuple[float, ...] | None  # (m,) [N/m] of the limiter; None: no guarantee, so the tick clips
    reason: str  # why it holds, or why it does not
    requirement: Requirement | None = None  # by the condition `limiter`, where it was asked
    c: tuple[tuple[float, ...], ...] = ()  # its multiplier
    certificate: LimiterCertificate | None = None  # its proof

    def words(self, force_limit: Sequence[float]) -> str:
        """In one line, for forces limited to so many N."""
        amounts = [f"{f:.4g}" for f in force_limit]
        limit = f"{', '.join(amounts if len(set(amounts)) > 1 else amounts[:1])} N"
        if self.rho is None:
            return f"clipped at {limit}: a guarantee holds while forces stay below ({self.reason})"
        if not self.proved:
            return f"certified, also while forces are limited to {limit} ({self.reason})"
        return f"proved, also while forces are limited to {limit}"

    @property
    def proved(self) -> bool:
        """In exact arithmetic."""
        return self.rho is not None and (self.requirement is None or self.requirement.proof == "rational")

    def part(self, force_limit: Sequence[float]) -> dict[str, Any]:
        """As plain data."""
        return {
            "rho": None if self.rho is None else list(self.rho),
            "force_limit": [finite(f) for f in force_limit],
            "reason": self.reason,
            "words": self.words(force_limit),
            "certificate": self.requirement and certificate_part(self.requirement),
            "c": self.c,
        }


def covered_limits(loop: Loop, coupling: Coupling, requirements: Mapping[str, Requirement]) -> Limits:
    """The limiter that a coupling may have: of no lag under any-environment, else that of its own condition."""
    if loop.jitter:
        return Limits(None, str(limiter_refusal(loop)))
    if requirements["any-environment"].certified and not any(loop.psi):
        return Limits((0.0,) * loop.channels, "any-environment covers limited forces")
    if not requirements["this-environment"].certified:
        return Limits(None, "no guarantee that it could extend")
    found = limiter_requirement(loop, coupling)
    requirement = found.requirement
    if not requirement.certified:
        needs = f"limiter: needs {', '.join(f'{d:.5g}' for d in requirement.required)} N s/m of damping"
        return Limits(None, requirement.reason or needs, requirement, found.c)
    try:
        proved = prove_limiter(loop, coupling, c=found.c)
    except NotProved as refused:
        return Limits(found.rho, f"swept, not proved: {refused}", requirement, found.c)
    return Limits(
        found.rho,
        "by a proof of its own, for this environment",
        replace(requirement, proof="rational"),
        found.c,
        proved,
    )


def prove_limiter(loop: Loop, coupling: Coupling, beta: float = BETA, c: Lags | None = None) -> LimiterCertificate:
    """An exact proof with the multiplier `c` or the best one. Raises NotProved with the reason."""
    found = limiter_requirement(loop, coupling, beta, c)
    requirement = found.requirement
    if not requirement.certified:
        needed, have = (", ".join(f"{d:.6g}" for d in side) for side in (requirement.required, requirement.available))
        reason = requirement.reason or f"limiter: needs {needed} N s/m of damping, has {have}"
        raise NotProved(reason, requirement)
    P, refused = find_storage(limiter_block(loop, coupling, found.rho, found.c))
    if P is None:
        raise NotProved(f"limiter: {refused}; the sweep asks {requirement.ratio:.9f} of the damping", requirement)
    return LimiterCertificate(beta, found.rho, found.c, requirement.required, _limiter_margin(found), rows_of(P))


def limiter_block(loop: Loop, coupling: Coupling, rho: Sequence[float], c: Lags) -> Lti:
    """The exact block that must be strictly positive real. Raises NotProved."""
    try:
        G = loop.sent(coupling, exact=True)
        _require_size(G.order + 2 * loop.channels + sum(max(n, len(row)) for n, row in zip(loop.theta, c, strict=True)))
        demand = limiter_demand(G, loop.theta, loop.delta, rho, c, loop.T_max)
    except (SingularLoop, ValueError) as error:
        raise NotProved(f"limiter: {error}") from None
    _require_static("F(1)", demand.static["F(1)"])
    return demand.gain + demand.free


def _refuted_limiter(loop: Loop, coupling: Coupling, certificate: Certificate) -> str | None:
    """Why what is on file does not prove the limited loop, or None if it does or claims nothing."""
    proof = certificate.limiter
    if proof is msgspec.UNSET:
        return None
    if certificate.condition != "this-environment":
        return "limiter: any-environment needs no proof of its own, and one is on file"
    if reason := limiter_refusal(loop):
        return reason
    if any(not (0 <= v < math.inf) for v in (*proof.rho, *(v for row in proof.c for v in row))):
        return "limiter: rho and c must be numbers >= 0"
    if proof.rho != limiter_lag(loop.delta, loop.T, proof.beta) or len(proof.c) != loop.channels:
        return f"limiter: rho is {list(proof.rho)}, expected beta delta/T with beta = {proof.beta:g}, one row of c each"
    found = limiter_requirement(loop, coupling, proof.beta, proof.c)
    required = found.requirement.required
    if len(proof.required) != len(required) or not np.allclose(proof.required, required, rtol=CLAIM_TOLERANCE):
        return f"limiter: required is {list(proof.required)}, the sweep finds {list(required)}"
    if not np.isclose(proof.margin, _limiter_margin(found), rtol=CLAIM_TOLERANCE):
        return f"limiter: margin is {proof.margin:.9g}, the sweep finds {_limiter_margin(found):.9g}"
    reason = refuted_rows("P", limiter_block(loop, coupling, proof.rho, proof.c), proof.P)
    return reason and f"limiter: {reason}"


def _limiter_margin(found: LimiterProof) -> float:
    return 1 / max(found.requirement.ratio, 1e-12)


# ----------------------------------------------------------------------------------------------------
# What a report says of delays that vary: the jitter-proof requirement beside that of the playout buffer.


NOT_COVERED = (
    "Covered: any ages of the forces within the range, at every tick and on every channel. Not covered: jitter on the "
    "measured positions, periods longer than T_max, or forces older than the range, which lost packets make."
)


def switching_requirement(loop: Loop, coupling: Coupling) -> JitterProof:
    """The damping that switching within loop.jitter asks; `proof` is "rational" where exact arithmetic confirms it."""
    found = swept(loop, coupling)
    if not found.requirement.certified or not isinstance(storage(loop, coupling, found.alpha), Matrix):
        return found
    return replace(found, requirement=replace(found.requirement, proof="rational"))


def switching_part(found: JitterProof, G: Lti, span: DelayRange, T_max: float | None = None) -> dict[str, Any]:
    """The requirement with its multiplier, and what a playout buffer to the constant delay hi would need.

    G is the force map without Theta.
    """
    buffered = this_environment(delay(span.hi, G.T) @ G, found.requirement.available, T_max)
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
# this-environment: F(1) is exactly symmetric and positive semidefinite, and with F(z) = F(1) + (z - 1) R(z) the block
#     R + Delta_D/T - F(1)/2
# is strictly positive real (design.proof.positive_real). On |z| = 1 the Hermitian part of F(1)/(z - 1) is -F(1)/2, so
# He[F/(z-1)] > -Delta_D/T there; the same certificate shows that F is stable.
#
# this-environment, forces that latch late, or walls without dampers: the blocks of latency_demand and walls_demand, the
# latter with the multipliers g of its walls, stored too.
#
# any-environment, psi = 0: with H = V - Theta-hat (11), (12), V-hat = (1 - 1/z) H/T, H(1) is exactly symmetric, and
# with H(z) = H(1) + (z - 1) R(z) the block
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
# any-environment, psi >= 1: a multiplier Phi, stored too, and two blocks (delayed_blocks); it is of this environment.


CLAIM_TOLERANCE_CERTIFICATE = (
    1e-6  # between the required damping on file and the one swept again, which repeats to 1e-9
)


class NotProved(ValueError):
    """No proof of the condition was found; carries the requirement that the sweep found, if there is one."""

    def __init__(self, reason: str, requirement: Requirement | None = None) -> None:
        super().__init__(reason)
        self.requirement = requirement


@dataclass(frozen=True)
class Verdict:
    """Whether a stored certificate is a proof, and if not, why."""

    proved: bool
    reason: str | None = None


def prove(
    loop: Loop,
    coupling: Coupling,
    condition: Condition,
    phi: Sequence[float] | None = None,
    limiter: LimiterCertificate | None = None,
    swept: Requirement | None = None,
) -> Certificate:
    """A certificate with an exact proof of the condition; `phi` [N s/m] is Theorem 4's multiplier where psi >= 1.

    With `limiter`, which `prove_limiter` gives of this loop, also of forces that are limited, under this-environment;
    under any-environment without delay in the environment rho is 0 and the certificate is the same. `swept` is what
    `required_damping` gives, of a caller who has just asked. Raises NotProved with the reason.
    """
    _require_limits(loop, coupling, condition)
    if condition == "this-environment" and loop.environment.walls:
        phi = walls_of(loop, coupling).g
    multiplier = None if phi is None else [rational(float(p)) for p in phi]
    requirement = swept or required_damping(loop, coupling, condition, multiplier)
    if not requirement.certified:
        needed = ", ".join(f"{d:.6g}" for d in requirement.required)
        have = ", ".join(f"{d:.6g}" for d in requirement.available)
        reason = requirement.reason or f"needs {needed} N s/m of damping, has {have}"
        place = f"P{worst(in_each(loop, coupling, loop.members()))}" if loop.box else "P"
        raise NotProved(f"{_place_certificate(loop, condition, place)}{reason}", requirement)
    if reason := _another_system(loop, coupling):
        raise NotProved(reason, requirement)
    proof: dict[str, Matrix] = {}
    for name, real in _blocks(loop, coupling, condition, multiplier).items():
        _require_size(real.order, requirement)
        P, reason = find_storage(real)
        if P is None:
            asked = f"the sweep asks {requirement.ratio:.9f} of the available damping"
            raise NotProved(f"{_place_certificate(loop, condition, name)}{reason}; {asked}", requirement)
        proof[name] = P
    if multiplier is not None:
        proof[_multiplier_name(loop, condition)] = Matrix.of([multiplier])
    return sealed(
        Certificate(
            condition=condition,
            required=requirement.required,
            available=loop.delta,
            margin=1 / max(requirement.ratio, 1e-12),
            guarantee=_guarantee(loop, condition),
            proof="rational",
            matrices={name: rows_of(M) for name, M in proof.items()},
            scenario=digest(loop, coupling.form()),
            versions={"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__},
            switching=_switching(loop, coupling, requirement),
            limiter=msgspec.UNSET if limiter is None or condition == "any-environment" else limiter,
        )
    )


#: More delays, states or digits than these are not looked at: a proof would take minutes.
MOST_BITS = 400  # of the denominator of a coefficient: a decimal of 120 places
MOST_COST = 8  # environments of a set, each as many as LARGEST states are


def _require_limits(loop: Loop, coupling: Coupling, condition: Condition) -> None:
    """Raises NotProved, in a moment, where a sweep or a proof would take minutes."""
    late = sum(loop.delays.hi) + sum(loop.psi)
    _require_size(late)
    for value in _coefficients(msgspec.to_builtins((loop, coupling.form()))):
        if rational(value).denominator.bit_length() > MOST_BITS:
            raise NotProved(f"the coefficient {value:g} has too many digits for exact arithmetic")
    try:
        states = loop.sent(coupling).order
    except SingularLoop:
        return  # the sweep says where
    states += sum(loop.theta) if condition == "this-environment" else 0
    _require_size(states)
    members = len(loop.members()) if condition == "this-environment" else 1
    if members * states**3 > MOST_COST * LARGEST**3:
        raise NotProved(f"a proof in {members} environments over {states} states each takes long")


def _coefficients(value: Any) -> Iterator[float]:
    """Every number in plain data."""
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _coefficients(part)


MOST_LOST = 1e-4  # of the largest force, or of Delta_D/T: a twentieth of what the designs of least margin leave unused


def _another_system(loop: Loop, coupling: Coupling) -> str | None:
    """Why the block that a tick runs in floating point is not the system that is proved over the rationals, or None.

    Their responses may differ, and rounding move them, by MOST_LOST on the whole circle: more where terms cancel that
    are far larger than the forces, and more yet where they cancel in decimals only.
    """
    try:
        running, exact = loop.sent(coupling), loop.sent(coupling, exact=True)
    except SingularLoop as error:
        return str(error)
    z = on_circle(frequencies(running))
    response = running.at(z)
    lost = rounding(running, z) + float(np.abs(response - exact.floats().at(z)).max())
    scale = max(float(np.abs(response).max()), min(loop.delta) / loop.T)
    if lost <= MOST_LOST * scale:
        return None
    return (
        f"in floating point the forces may be off by {lost / scale:.1e} of themselves, allowed is {MOST_LOST:g}: "
        "what runs would not be what is proved"
    )


def _switching(loop: Loop, coupling: Coupling, requirement: Requirement) -> SwitchingProof | msgspec.UnsetType:
    """The proof that the delays may switch, of a loop with a range of them. Raises NotProved."""
    if loop.jitter is None:
        return msgspec.UNSET
    proof = prove_switching(loop, coupling)
    if isinstance(proof, str):
        raise NotProved(f"{switching_guarantee(loop.jitter)}: {proof}", requirement)
    return proof


def verify(stored: Stored) -> Verdict:
    """Prove the stored certificate again: its bookkeeping, its figures, then its matrices in exact arithmetic."""
    certificate, loop = stored.certificate, stored.loop
    if certificate is None:
        return Verdict(False, "the file carries no certificate")
    if certificate.scenario != digest(loop, stored.coupling):
        return Verdict(False, "scenario digest differs: the loop or the coupling was changed after it was certified")
    if sealed(certificate).seal != certificate.seal:
        return Verdict(False, "seal differs: the certificate was changed after it was made")
    coupling = stored.built()
    try:
        reason = _refuted_claims(loop, coupling, certificate) or _refuted_proof(loop, coupling, certificate)
    except NotProved as refusal:
        reason = str(refusal)
    return Verdict(reason is None, reason)


def required_damping(
    loop: Loop, coupling: Coupling, condition: Condition, phi: Sequence[Fraction] | None = None
) -> Requirement:
    """The damping that the condition asks, from a refined sweep; this-environment: the most over all members.

    Raises NotProved where it is undefined: any-environment with psi >= 1 needs the multiplier phi.
    """
    if loop.environment.walls:
        if condition == "this-environment":
            return walls_of(loop, coupling, phi).requirement
        if any(loop.psi):
            raise NotProved(
                "with delay in the environment the multiplier of any-environment is of a linear one: no walls"
            )
    if condition == "this-environment":
        requirements = in_each(loop, coupling, loop.members())
        return requirements[worst(requirements)]
    if loop.latency:
        return refusal("any-environment", loop.delta, LATE)
    V = coupling.compliance(loop.T)
    if V is None:
        return refusal("any-environment", loop.delta, no_compliance(coupling))
    if not any(loop.psi):
        return any_environment(V, loop.theta, loop.delta, loop.T_max)
    if phi is None or len(phi) != len(loop.delta):
        raise NotProved("any-environment with psi >= 1 needs a multiplier Phi, one entry per channel")
    values = np.array([float(p) for p in phi])
    return any_environment_delayed(V, loop.E(), loop.theta, loop.psi, loop.delta, values, loop.T_max)


#: What a certificate calls the multipliers of walls that make and break contact, one each.
WALL_MULTIPLIER = "g"


def walls_of(loop: Loop, coupling: Coupling, g: Sequence[Fraction] | None = None) -> WallsProof:
    """What this-environment asks where walls make and break contact, with the multipliers g (w,) or the best found.

    Raises NotProved for walls that nothing is proved of.
    """
    walls = loop.environment.walls
    if any(wall.damping for wall in walls):
        raise NotProved(
            "of walls with dampers only each frozen contact state is judged, and any-environment proves all"
        )
    if loop.box:
        raise NotProved("walls and a box: walls are proved in one environment")
    try:
        G = loop.walled(coupling)
    except (SingularLoop, ValueError) as error:
        raise NotProved(str(error)) from None
    stiffness = [wall.stiffness for wall in walls]
    values = None if g is None else [float(value) for value in g]
    if values is not None and (len(values) != len(walls) or min(values) < 0):
        raise NotProved(f"{WALL_MULTIPLIER} is {values}, expected a number >= 0 for each of {len(walls)} walls")
    return walls_proof(G, loop.delta, stiffness, values, loop.T_max)


def _walls_block(loop: Loop, coupling: Coupling, g: Sequence[Fraction]) -> Lti:
    """The block of this-environment with walls, after the exact tests at z = 1. Raises NotProved."""
    try:
        G = loop.walled(coupling, exact=True)
        _require_size(G.order)
        stiffness = [wall.stiffness for wall in loop.environment.walls]
        demand = walls_demand(G, loop.delta, stiffness, g, None, loop.T_max)
    except SingularLoop as error:
        raise NotProved(f"a pole at z = 1 or an algebraic loop without solution: {error}") from None
    for name, value in demand.static.items():
        _require_symmetric(name, value)
        if name in demand.semidefinite:
            _require_static(name, value)
    return demand.gain + demand.free


#: Why any-environment says nothing of forces that latch between ticks.
LATE = "a latency of a fraction of a sample is derived for this environment only: count it as a whole sample of theta"


def no_compliance(coupling: Coupling) -> str:
    """Why Theorem 4 has nothing to say of a coupling that is no V of its own."""
    if isinstance(coupling, InternalModel | ForceFilter):
        return "the coupling contains a model of the environment: Theorem 4 is about one that knows none"
    return "without a coupling there is nothing that Theorem 4 could use"


def _guarantee(loop: Loop, condition: Condition) -> Literal["any passive environment", "a set", "this environment"]:
    if condition == "any-environment":
        return "this environment" if any(loop.psi) else "any passive environment"
    # proved at every vertex; whether it is kept between them is searched by design.box.check and design.check
    return "a set" if loop.box else "this environment"


def _place_certificate(loop: Loop, condition: Condition, matrix: str) -> str:
    """Which member of a set the matrix P, P1, P2, .. is about, as the beginning of a message."""
    if loop.box is None or condition == "any-environment":
        return ""
    return f"{loop.members()[int(matrix[1:] or 0)].name}: "


def _blocks(loop: Loop, coupling: Coupling, condition: Condition, phi: Sequence[Fraction] | None) -> dict[str, Lti]:
    """The exact blocks to be strictly positive real, by the name of the matrix that proves it. Raises NotProved."""
    if condition == "this-environment" and loop.environment.walls:
        assert phi is not None  # prove has found it, or the file holds it
        return {"P": _walls_block(loop, coupling, phi)}
    if condition == "this-environment":
        loops = [loop.at(member.network) for member in loop.members()]
        return {f"P{i or ''}": _this_environment(each, coupling) for i, each in enumerate(loops)}
    T = rational(loop.T)
    V = coupling.compliance(T)
    assert V is not None  # required_damping has refused the rest
    _require_size(V.order + sum(loop.theta))
    try:
        if not any(loop.psi):
            demand = any_environment_demand(V, loop.theta, loop.delta, loop.T_max)
            _require_symmetric("H(1)", demand.static["V(1)"])
            return {"P": demand.gain + demand.free}
        assert phi is not None
        E1, passive = delayed_environment_block(delay(loop.psi, T) @ loop.E(exact=True), phi)
        H1, excess = delayed_coupling_block(V, loop.theta, phi, [rational(d) for d in loop.delta], loop.T_max)
    except (SingularLoop, ValueError) as error:
        raise NotProved(str(error)) from None
    _require_static("E(1)", E1)
    _require_symmetric("H(1)", H1)
    return {"P": excess, "P_E": passive}


def _this_environment(loop: Loop, coupling: Coupling) -> Lti:
    """The block of this-environment, after the exact test at z = 1. Raises NotProved."""
    try:
        F = loop.F(coupling, exact=True)
        _require_size(F.order)
        demand = this_environment_demand(F, loop.delta, loop.T_max, loop.latency)
    except SingularLoop as error:
        raise NotProved(f"a pole at z = 1 or an algebraic loop without solution: {error}") from None
    _require_static("F(1)", demand.static["F(1)"])
    return demand.gain + demand.free


def _require_size(states: int, requirement: Requirement | None = None) -> None:
    if reason := too_large(states):
        raise NotProved(reason, requirement)


def _require_symmetric(name: str, value: Array) -> None:
    if not (value == value.T).all():
        raise NotProved(f"{name} is not exactly symmetric")


def _require_static(name: str, value: Array) -> None:
    _require_symmetric(name, value)
    outcome = definiteness(Matrix.of(value))
    if not outcome.semidefinite:
        raise NotProved(f"{name} is not positive semidefinite: {outcome}")


def _refuted_claims(loop: Loop, coupling: Coupling, certificate: Certificate) -> str | None:
    """Why the figures on file do not follow from the loop and the coupling, or None."""
    if certificate.proof != "rational":
        return f"the certificate is {certificate.proof}: it carries no exact proof"
    if certificate.guarantee != _guarantee(loop, certificate.condition):
        return f"{certificate.condition} does not guarantee {certificate.guarantee!r}"
    if certificate.available != loop.delta:
        return f"available is {list(certificate.available)}, the loop has delta = {list(loop.delta)}"
    _require_limits(loop, coupling, certificate.condition)
    requirement = required_damping(loop, coupling, certificate.condition, _multiplier(loop, certificate))
    if len(certificate.required) != len(loop.delta) or not np.allclose(
        certificate.required, requirement.required, rtol=CLAIM_TOLERANCE_CERTIFICATE
    ):
        return f"required is {list(certificate.required)}, the sweep finds {list(requirement.required)}"
    if not np.isclose(certificate.margin, 1 / max(requirement.ratio, 1e-12), rtol=CLAIM_TOLERANCE_CERTIFICATE):
        return f"margin is {certificate.margin:.9g}, the sweep finds {1 / max(requirement.ratio, 1e-12):.9g}"
    if not requirement.certified:
        return f"the sweep asks {requirement.ratio:.6g} times the available damping, whatever the matrices prove"
    return _another_system(loop, coupling)


def _refuted_proof(loop: Loop, coupling: Coupling, certificate: Certificate) -> str | None:
    """Why the matrices prove nothing, or None if they prove the condition."""
    phi, name = _multiplier(loop, certificate), _multiplier_name(loop, certificate.condition)
    if name == WALL_MULTIPLIER and phi is None:
        return f"no multiplier {name} of the walls is on file"
    blocks = _blocks(loop, coupling, certificate.condition, phi)
    expected = {*blocks, *([name] if "P_E" in blocks or name == WALL_MULTIPLIER else [])}
    if set(certificate.matrices) != expected:
        found = ", ".join(certificate.matrices) or "none"
        return f"matrices are {found}, expected {', '.join(sorted(expected))}"
    for name, real in blocks.items():
        if reason := refuted_rows(name, real, certificate.matrices[name]):
            return f"{_place_certificate(loop, certificate.condition, name)}{reason}"
    return refuted(loop, coupling, certificate.switching) or _refuted_limiter(loop, coupling, certificate)


def _multiplier_name(loop: Loop, condition: Condition) -> str:
    """What the matrices call it: Phi of any-environment with psi >= 1, or g of walls under this-environment."""
    return WALL_MULTIPLIER if condition == "this-environment" and loop.environment.walls else "Phi"


def _multiplier(loop: Loop, certificate: Certificate) -> list[Fraction] | None:
    """The stored multiplier, or None. Raises NotProved where it is no row of rationals."""
    name = _multiplier_name(loop, certificate.condition)
    rows = certificate.matrices.get(name)
    if rows is None:
        return None
    try:
        return [Fraction(value) for value in rows[0]]
    except (IndexError, ValueError, ZeroDivisionError):
        raise NotProved(f"{name} is no row of rational numbers") from None


CONDITIONS: tuple[Condition, ...] = ("any-environment", "this-environment")


def assess(
    loop: Loop, coupling: Coupling, phi: Array | None = None, known: Certificate | None = None
) -> dict[str, Requirement]:
    """Required damping by each condition; `phi` is the multiplier that the coupling was designed with, if any.

    this-environment is about the nominal environment alone (ranges.check asks for the rest of its ranges) and the
    constant theta (sim.switching.certified_part asks for the rest of its range); where there are walls it is about the
    frozen contact state that asks for most. What `known`, a certificate just made, proves is not proved again.
    """
    loop = loop.at(loop.environment).switching(None)
    here = this_environment_of(loop, coupling)
    proved = known and known.condition == "this-environment" and known.scenario == digest(loop, coupling.form())
    return {
        "any-environment": _proved(loop, coupling, any_environment_of(loop, coupling, phi), phi),
        "this-environment": replace(here, proof="rational") if proved else _proved(loop, coupling, here),
    }


def this_environment_of(loop: Loop, coupling: Coupling) -> Requirement:
    """What this-environment asks; with walls that have dampers, in their most demanding frozen contact state."""
    if making_covered(loop):
        try:
            return walls_of(loop, coupling).requirement
        except NotProved as error:
            return refusal("this-environment", loop.delta, str(error))
    maps = (state.F(coupling) for state in loop.frozen())
    requirements = [this_environment(F, loop.delta, loop.T_max, loop.latency) for F in maps]
    return max(requirements, key=lambda requirement: requirement.ratio)


def any_environment_of(loop: Loop, coupling: Coupling, phi: Array | None = None) -> Requirement:
    """What any-environment asks; walls are covered without delay in the environment, and refused with it."""
    if loop.latency:
        return refusal("any-environment", loop.delta, LATE)
    if loop.environment.walls and any(loop.psi):
        reason = "with delay in the environment its multiplier is of a linear one: no walls"
        return refusal("any-environment", loop.delta, reason)
    if isinstance(coupling, SpringDamper | MovingAverage) and not any(loop.psi):
        return any_environment_per_channel(coupling.channels(loop.T), loop.theta, loop.delta, loop.T_max)
    V = coupling.compliance(loop.T)
    if V is None:
        return refusal("any-environment", loop.delta, no_compliance(coupling))
    if not any(loop.psi):
        return any_environment(V, loop.theta, loop.delta, loop.T_max)
    if phi is None:
        from design.lmi import least_phi  # only an environment with delay inside needs the solver

        try:
            phi = least_phi(loop)
        except ValueError as error:
            return refusal("any-environment", loop.delta, str(error))
    assert phi is not None  # psi >= 1 has a multiplier or none is possible
    return any_environment_delayed(V, loop.E(), loop.theta, loop.psi, loop.delta, phi, loop.T_max)


def _proved(loop: Loop, coupling: Coupling, requirement: Requirement, phi: Array | None = None) -> Requirement:
    """The requirement with `proof` = 'rational' where an exact proof was found, as it is where not."""
    if not requirement.certified:
        return requirement
    try:
        prove(loop, coupling, requirement.condition, None if phi is None else phi.tolist())
    except NotProved:
        return requirement
    return replace(requirement, proof="rational")
