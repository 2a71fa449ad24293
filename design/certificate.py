"""Judge a coupling by conditions (`requirements_of`), prove a condition exactly (`prove`), check a proof (`verify`)."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from haptic_loop.controller.arguments import of_kind
from haptic_loop.controller.arithmetic import SingularLoop, TooLong, rational, within
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.loop import Loop, forget_exact
from haptic_loop.controller.lti import Lti
from haptic_loop.design import budgets
from haptic_loop.design.conditions import Condition, Demand
from haptic_loop.design.coupling_file import (
    Certificate,
    Rows,
    Stored,
    digest,
    filed,
    own_fields,
    sealed,
)
from haptic_loop.design.environments import (
    ANY_ENVIRONMENT,
    LIMITER,
    THIS_ENVIRONMENT,
    LimitedForces,
    SwitchingDelays,
    worst,
)
from haptic_loop.design.exact import (
    Violated,
    find_storage,
    negative_minor,
    refuted_rows,
    rows_of,
)
from haptic_loop.design.forked import Forked
from haptic_loop.design.frequency import frequencies, on_circle, rounding
from haptic_loop.design.known_device import KNOWN_DEVICE, KNOWN_DEVICE_ANY, LimitedKnownDevice, described
from haptic_loop.design.result import NotProved, Requirement, refusal, switching_guarantee

#: Allowed error of stored figures, relative to the largest available damping or the margin. Sweeps repeat to 1e-9.
_CLAIM_TOLERANCE = 1e-6


@contextmanager
def _in_time() -> Iterator[None]:
    """Raise NotProved if exact arithmetic exceeds its budget of counted work."""
    forget_exact()
    try:
        with within(budgets.EXACT):
            yield
    except TooLong as error:
        raise NotProved(str(error)) from None


# ----------------------------------------------------------------------------------------------------
# A proof shows that the static matrices of a demand are symmetric, and positive semidefinite where required. It also
# shows that each block of the condition at the available damping is strictly positive real (design.exact). This implies
# that the force map F (6), or V-hat (11), is stable. For any-environment with psi = 0, Phi = 0 satisfies Lemma 4,
# because the environment is passive. With ranges, a condition that uses the environment is proved for the nominal
# environment (matrix P) and for at most 128 vertices (P1, P2, ..). Environments between the vertices have no proof.


@dataclass(frozen=True)
class Verdict:
    """Whether a stored certificate is a proof, and if not, why."""

    proved: bool
    reason: str | None = None


@_in_time()
def prove(
    loop: Loop,
    coupling: Coupling,
    condition: str | Condition,
    multiplier: Sequence[float] | None = None,
    swept: Requirement | None = None,
) -> Certificate:
    """Prove a condition in exact arithmetic and return the certificate.

    Args:
        loop: The loop. Its facts, such as walls or delays that switch, are part of the condition.
        condition: A name or a condition. LimitedForces (design.environments) covers limited forces, too. With psi = 0,
            any-environment covers them without a further proof, by a limiter with rho = 0.
        multiplier: The multipliers in one sequence (Phi in N s/m for Theorem 4 with psi >= 1); None to search for them.
        swept: The result of `required_damping` for these arguments, if the caller has it.

    Raises:
        NotProved: No proof was found; the message gives the reason.
        ValueError: The condition or a multiplier is not allowed.
    """
    import scipy

    resolved, coupling = named(condition), filed(loop, coupling)
    requirement, proof = _proof(resolved, loop, coupling, multiplier, swept)
    certificate = sealed(
        Certificate(
            condition=resolved.base,
            facts=resolved.fact_names(loop),
            required=requirement.required,
            available=loop.delta,
            margin=_margin(requirement),
            guarantee=resolved.guarantee(loop),
            proof="rational",
            multipliers=resolved.parameters(loop) | resolved.by_name(loop, requirement.multiplier or ()),
            matrices=proof,
            scenario=digest(loop, coupling.form()),
            versions={"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__},
        )
    )
    if is_ours(resolved):
        _made.add(certificate.seal)
    return certificate


_FORKED = 40  # The proof of a block with more states takes longer than the start of a second process.
_made: set[str] = set()  # seals of certificates that this process has proved or verified for the package's conditions


def _proof(
    condition: Condition,
    loop: Loop,
    coupling: Coupling,
    multiplier: Sequence[Any] | None = None,
    swept: Requirement | None = None,
) -> tuple[Requirement, dict[str, Rows]]:
    """Return the requirement of a condition and the matrices that prove it. Raises NotProved."""
    _require_limits(loop, coupling, condition)
    numbers = sum(condition.multiplier_sizes(loop).values())
    complete = swept is not None and len(swept.multiplier or ()) == numbers  # A quick sweep may omit multipliers.
    requirement = swept if swept and complete else required_damping(loop, coupling, condition, multiplier)
    if not requirement.certified:
        members = condition.members(loop)
        each = [required_damping(loop.at(m.network), coupling, condition) for m in members if len(members) > 1]
        place = condition.place(loop, f"P{worst(each) if each else ''}")
        raise NotProved(_placed(place, requirement.shortfall), requirement)
    blocks = _blocks(loop, coupling, condition, requirement.multiplier)
    large = any(block.order > _FORKED for block in blocks.values())
    system = Forked(_another_system, loop, coupling) if large else None
    if not system and (reason := _another_system(loop, coupling)):
        raise NotProved(reason, requirement)
    try:
        return requirement, _matrices(condition, loop, requirement, blocks)
    finally:  # If rounding changes the system, this is the reason to report, whatever else fails.
        if system and (reason := system.result()):
            raise NotProved(reason, requirement)


def _matrices(condition: Condition, loop: Loop, requirement: Requirement, blocks: Mapping[str, Lti]) -> dict[str, Rows]:
    """Return the matrices that prove the blocks. Raises NotProved."""
    proof: dict[str, Rows] = {}
    for name, real in blocks.items():
        P, reason = find_storage(real)
        if P is None:
            share = f"the sweep requires {requirement.ratio:.9f} of the available damping"
            refuted = isinstance(reason, Violated)
            raise NotProved(f"{condition.place(loop, name)}{reason}; {share}", requirement, refuted)
        proof[name] = rows_of(P)
    return proof


def _placed(place: str, reason: str) -> str:
    """Return the reason with the place in front of it, unless it begins with the place."""
    return f"{place}{reason.removeprefix(place)}"


def judged(loop: Loop, coupling: Coupling, condition: Condition) -> Requirement:
    """Return the requirement of a condition; its `proof` is "rational" if it is proved exactly."""
    coupling = filed(loop, coupling)
    return _with_proof(loop, coupling, condition, condition.judge(loop, coupling))


def _with_proof(loop: Loop, coupling: Coupling, condition: Condition, needs: Requirement) -> Requirement:
    """Return the requirement, with `proof` = "rational" if it is proved exactly, or infinite if it is refuted."""
    if not needs.certified:
        return needs
    try:
        with _in_time():
            _proof(condition, loop, coupling, swept=needs)
    except NotProved as error:
        if not error.refuted:
            return needs
        return replace(refusal(needs.condition, needs.available, str(error)), guarantee=needs.guarantee)
    return replace(needs, proof="rational")


# Problems beyond these limits are refused at once, because a proof would take minutes.
_MOST_BITS = 400  # largest number of bits of a coefficient's denominator; a decimal of 120 places has 399
_MOST_COST = 2  # largest total cost of the proofs for all members, in units of one proof over PROOF_STATES states


def _require_limits(loop: Loop, coupling: Coupling, condition: Condition) -> None:
    """Raise NotProved if the condition does not cover the loop, and NotProved or TooLong if a proof takes minutes."""
    if reason := condition.beyond(loop):
        raise NotProved(reason)
    late = sum(loop.delays.hi) + sum(loop.psi)
    budgets.require_size(late)
    for value in _coefficients(msgspec.to_builtins((loop, coupling.form()), enc_hook=own_fields)):
        if rational(value).denominator.bit_length() > _MOST_BITS:
            raise NotProved(f"the coefficient {value:g} has too many digits for exact arithmetic")
    try:
        states = loop.sent(coupling).order
    except SingularLoop:
        return  # The sweep reports the singular loop.
    members = len(condition.members(loop))
    # Conditions for any environment have no members and check the size of their blocks themselves.
    states += sum(loop.theta) if members else 0
    budgets.require_size(states)
    if members * states**3 > _MOST_COST * budgets.PROOF_STATES**3:
        raise NotProved(f"a proof in {members} environments over {states} states each takes long")


def _coefficients(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _coefficients(part)


_MOST_LOST = 1e-4  # largest change of the response by rounding, relative to the scale in `_another_system`


def _another_system(loop: Loop, coupling: Coupling) -> str | None:
    """Return the reason why the floating-point block of a tick differs from the proved system, or None.

    At the frequencies of a sweep, the rounding of a tick and of its coefficients must not change the response by more
    than _MOST_LOST times the larger of two numbers: the largest response and, except in a world, the least delta/T.
    Terms that are far larger than the forces and cancel increase this change (design.frequency.rounding).
    """
    try:
        if loop.environment.world:  # A tick computes V alone; MuJoCo solves the scene with the feedthrough of V.
            running, exact = coupling.compliance(loop.T), coupling.compliance(loop.period(exact=True))
        else:
            running, exact = loop.sent(coupling), loop.sent(coupling, exact=True)
    except SingularLoop as error:
        return str(error)
    if running is None or exact is None:
        return "a world needs a coupling with a compliance V"
    z, rounded = on_circle(frequencies(running)), exact.floats()
    response = running.at(z)
    if running.A.shape == rounded.A.shape:
        lost = rounding(running, z, rounded)
    else:  # Rounding has kept a state that cancels in exact arithmetic.
        lost = rounding(running, z) + float(np.abs(response - rounded.at(z)).max())
    scale = max(float(np.abs(response).max()), 0.0 if loop.environment.world else min(loop.delta) / loop.T)
    if lost <= _MOST_LOST * scale:
        return None
    return (
        f"rounding may change the forces by {lost / scale:.1e} (relative), allowed is {_MOST_LOST:g}: "
        "the running loop would differ from the proved loop"
    )


def limiter_rho(loop: Loop, certificate: Certificate | None) -> tuple[float, ...] | None:
    """Return rho (m,) [N/m] of the limiter that the certificate covers, or None."""
    if certificate is None:
        return None
    if certificate.limiter:
        return loop.per_channel(certificate.multipliers["rho"])
    known = _NAMED.get(certificate.condition)
    return known.limiter_rho(loop) if known else None


def covered(loop: Loop, claim: Certificate) -> Iterator[str]:
    """Yield what a certificate covers in words: switching delays, periods, latencies, and devices within bounds."""
    known = "q_below" in claim.multipliers  # true for KnownDevice and for a user's subclasses of it
    if loop.varying_delay:
        yield switching_guarantee(loop.varying_delay)
    if loop.T_max or (known and loop.T_min):
        least = f"from {1e3 * (loop.T_min or loop.T):.6g} " if known else "up "
        yield f"periods {least}to {1e3 * (loop.T_max or loop.T):.6g} ms"
    for least, most in dict.fromkeys(loop.latency or ()):
        yield f"forces that latch {1e3 * least:.6g} to {1e3 * most:.6g} ms after their tick"
    if known:
        yield described(loop)


def proves(loop: Loop, coupling: Coupling, certificate: Certificate, condition: Condition | None = None) -> bool:
    """Return whether the certificate belongs to exactly this loop and coupling and holds.

    The certificate is verified unless this process has proved or verified it before. `condition` is needed for a user's
    own condition.
    """
    if not certificate.is_for(loop, coupling):
        return False
    if certificate.seal in _made and sealed(certificate).seal == certificate.seal:
        return True
    return verify(Stored(loop, coupling.form(), certificate), condition).proved


def condition_of(certificate: Certificate, condition: Condition | None = None) -> Condition:
    """Return the condition that a certificate proves. Raises ValueError if the name or the limiter is wrong.

    For a certificate of a user's own condition, `condition` must be that condition.
    """
    base = named(condition or certificate.condition)
    if not certificate.limiter:
        return base
    own = base.limiter if isinstance(base, LimitedKnownDevice) else base if isinstance(base, LimitedForces) else None
    if not (own or base.extensible or base is KNOWN_DEVICE):
        raise ValueError(f"facts: the file lists the limiter, but {certificate.condition} covers no limited forces")
    rho, c = (certificate.multipliers.get(name, ()) for name in ("rho", "c"))
    if not rho or len(rho) > len(certificate.available) or len(c) % len(rho):
        raise ValueError(
            f"multipliers: rho has {len(rho)} numbers and c has {len(c)}, "
            f"expected 1 to {len(certificate.available)} in rho and a multiple of that in c"
        )
    limiter = replace(own or LIMITER, lags=len(c) // len(rho), held=rho)
    if isinstance(base, LimitedKnownDevice):
        return base.behind(limiter)
    return LimitedKnownDevice(limiter) if base is KNOWN_DEVICE else limiter


def verify(stored: Stored, condition: Condition | None = None) -> Verdict:
    """Return whether the stored certificate's digest, seal and figures are right and its matrices are an exact proof.

    For a certificate of a user's own condition, `condition` must be that condition. The block is proved again. That the
    block keeps the loop safe is the claim of the condition's author.
    """
    certificate, loop = stored.certificate, stored.loop
    if certificate is None:
        return Verdict(False, "the file carries no certificate")
    if certificate.scenario != digest(loop, stored.coupling):
        return Verdict(False, "scenario digest differs: the loop or the coupling was changed after it was certified")
    if sealed(certificate).seal != certificate.seal:
        return Verdict(False, "seal differs: the certificate was changed after it was made")
    if condition and condition.name != certificate.condition:
        return Verdict(False, f"the certificate is of {certificate.condition!r}, not of {condition.name!r}")
    coupling = stored.built()
    try:
        resolved = condition_of(certificate, condition)
        with _in_time():
            _check(loop, coupling, resolved, certificate)
    except ValueError as refused:  # NotProved, or an error of `condition_of` or of a user's own condition
        return Verdict(False, str(refused))
    if is_ours(resolved):
        _made.add(certificate.seal)
    return Verdict(True)


def _check(loop: Loop, coupling: Coupling, condition: Condition, certificate: Certificate) -> None:
    """Raise NotProved unless the certificate proves all its claims."""
    if certificate.proof != "rational":
        raise NotProved(f"the certificate's proof is {certificate.proof}: it carries no exact proof")
    if certificate.guarantee != condition.guarantee(loop):
        raise NotProved(f"{certificate.condition} does not guarantee {certificate.guarantee!r}")
    if certificate.available != loop.delta:
        raise NotProved(f"available is {list(certificate.available)}, the loop has delta = {list(loop.delta)}")
    if certificate.facts != (names := condition.fact_names(loop)):
        raise NotProved(f"facts are {list(certificate.facts)}, expected {list(names)}")
    _check_part(loop, coupling, condition, certificate, certificate.matrices)


@_in_time()
def recheck(loop: Loop, coupling: Coupling, certificate: Certificate, known: Certificate | None = None) -> Requirement:
    """Return the requirement of a certificate's condition and multipliers in this loop, proved with its matrices.

    `known` is a certificate that this process has proved or verified. If `known` is `certificate` and belongs to this
    loop and coupling, the exact proof is not repeated. Raises NotProved if the certificate does not hold in the loop,
    or if the proof would take minutes.
    """
    is_proved = known is certificate and certificate.is_for(loop, coupling)
    try:
        condition = condition_of(certificate)
    except ValueError as error:
        raise NotProved(str(error)) from None
    return _check_part(loop, coupling, condition, certificate, None if is_proved else certificate.matrices)


def _check_part(
    loop: Loop,
    coupling: Coupling,
    condition: Condition,
    claim: Certificate,
    matrices: Mapping[str, Rows] | None,
) -> Requirement:
    """Return the requirement with the multipliers of `claim`, and prove it with `matrices` unless they are None.

    Raises NotProved if the figures differ from those of `claim`, or the matrices are no proof.
    """
    _require_limits(loop, coupling, condition)
    multiplier = on_file(condition, loop, claim.multipliers)
    requirement, place = required_damping(loop, coupling, condition, multiplier), condition.place(loop)
    reason = requirement.reason or _other_figures(claim, requirement)
    if not (reason or requirement.certified):
        reason = f"the sweep requires {requirement.ratio:.6g} times the available damping, whatever the matrices prove"
    if reason := reason or _another_system(loop, coupling):
        raise NotProved(_placed(place, reason))
    if matrices is None:
        return replace(requirement, proof="rational")
    blocks = _blocks(loop, coupling, condition, multiplier)
    if set(matrices) != set(blocks):
        raise NotProved(f"matrices are {', '.join(matrices) or 'none'}, expected {', '.join(sorted(blocks))}")
    for name, real in blocks.items():
        if reason := refuted_rows(name, real, matrices[name]):
            raise NotProved(f"{condition.place(loop, name)}{reason}")
    return replace(requirement, proof="rational")


def _other_figures(claim: Certificate, needed: Requirement) -> str | None:
    """Return a message if the damping or margin in `claim` differs from that of the sweep, or None."""
    required, allowed = needed.required, _CLAIM_TOLERANCE * max(needed.available)
    if len(claim.required) != len(required) or not np.allclose(claim.required, required, rtol=0, atol=allowed):
        return f"required is {list(claim.required)}, the sweep finds {list(required)}"
    if not np.isclose(claim.margin, _margin(needed), rtol=_CLAIM_TOLERANCE, atol=0):
        return f"margin is {claim.margin:.9g}, the sweep finds {_margin(needed):.9g}"
    return None


def _margin(requirement: Requirement) -> float:
    """Return available over required damping, but at most 1e12."""
    return 1 / max(requirement.ratio, 1e-12)


def on_file(condition: Condition, loop: Loop, stored: Mapping[str, Sequence[float]]) -> Sequence[float] | None:
    """Return the `stored` multipliers without the condition's parameters, or None if the condition has no multipliers.

    Raises NotProved unless names and lengths are those of the condition.
    """
    sizes = condition.multiplier_sizes(loop)
    expected = sizes | {name: len(values) for name, values in condition.parameters(loop).items()}
    if {name: len(values) for name, values in stored.items()} != expected:
        there = ", ".join(f"{name} ({len(values)})" for name, values in stored.items()) or "none"
        needed = ", ".join(f"{name} ({count})" for name, count in expected.items()) or "none"
        raise NotProved(f"multipliers are {there}, expected {needed}")
    return tuple(v for name in sizes for v in stored[name]) if sizes else None


# The package's conditions, by their names in result.CONDITIONS and in the same order.
_NAMED: dict[str, Condition] = {
    each.name: each for each in (ANY_ENVIRONMENT, THIS_ENVIRONMENT, KNOWN_DEVICE, KNOWN_DEVICE_ANY)
}
_PARTS = SwitchingDelays, LimitedForces, LimitedKnownDevice  # stored as facts of a base condition


def is_ours(condition: Condition) -> bool:
    """Return whether the package, not the user, defines the condition."""
    return condition in _NAMED.values() or type(condition) in _PARTS


def named(condition: str | Condition) -> Condition:
    """Return the named condition, or the condition itself. Raises ValueError for an unknown or reserved name."""
    if not isinstance(condition, str):
        of_kind("condition", condition, Condition, f"{', '.join(_NAMED)} or your own Condition")
        name, reserved = getattr(condition, "name", None), {*_NAMED, *(each.name for each in _PARTS)}
        free = isinstance(name, str) and name.strip() and name not in reserved
        if not (free or is_ours(condition)):
            own = f"condition {type(condition).__name__}: its name is {name!r}"
            raise ValueError(f"{own}, expected a name other than {', '.join(sorted(reserved))}")
        return condition
    if condition not in _NAMED:
        raise ValueError(
            f"condition is {condition!r}, allowed are {', '.join(_NAMED)}, or FILE.py:NAME for your own condition"
        )
    return _NAMED[condition]


def required_damping(
    loop: Loop, coupling: Coupling, condition: str | Condition, multiplier: Sequence[Any] | None = None
) -> Requirement:
    """Return the requirement of a condition, by a refined sweep.

    If `multiplier` is None, the condition chooses the multiplier. With ranges, a condition that uses the environment
    returns the largest requirement of all members. The requirement of a singular loop is infinite.
    """
    return named(condition).judge(loop, coupling, multiplier)


def _blocks(loop: Loop, coupling: Coupling, condition: Condition, multiplier: Any) -> dict[str, Lti]:
    """Return the exact blocks that must be strictly positive real, by the names of their matrices. Raises NotProved."""
    try:
        demands = condition.exact_demands(loop, coupling, multiplier)
        return {name: _block(demand) for name, demand in demands.items()}
    except SingularLoop as error:
        reason = f"the block has a pole at z = 1 or an algebraic loop without solution: {error}"
    except ValueError as error:
        reason = str(error)
    raise NotProved(_placed(condition.place(loop), reason))


def _block(demand: Demand[Lti]) -> Lti:
    """Return the block of a demand at the available damping.

    Raises NotProved if a static matrix fails its test, and TooLong for a block that is too large to be proved.
    """
    block = demand.gain + demand.free
    budgets.require_size(block.order)
    for name, value in demand.static.items():
        if not (value == value.T).all():
            raise NotProved(f"{name} is not exactly symmetric")
        if name in demand.semidefinite and (minor := negative_minor(value)):
            raise NotProved(f"{name} is not positive semidefinite: {minor}")
    return block


def conditions_of(loop: Loop) -> tuple[Condition, ...]:
    """Return the conditions of the package that `requirements_of` judges."""
    known_only = () if loop.known_devices else (KNOWN_DEVICE, KNOWN_DEVICE_ANY)
    return tuple(each for each in _NAMED.values() if each not in known_only)


def requirements_of(
    loop: Loop,
    coupling: Coupling,
    known: Certificate | None = None,
    own: Condition | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Requirement]:
    """Return the requirement of each condition of the package, and of the user's `own` condition if there is one.

    Each condition is proved exactly if possible. `known` is a certificate that holds; its proof is not repeated. A loop
    without bounds of its devices gets no known-device conditions. The environment is nominal and the delays theta are
    constant; design.assessment adds ranges and switching. `progress` is called with the number of finished proofs and
    the number of conditions.
    """
    loop = loop.at(loop.environment).switching(None)
    conditions = (*conditions_of(loop), *([named(own)] if own else []))
    proved = known.condition if known and known.is_for(loop, coupling) else None

    requirements = {each.name: each.judge(loop, coupling) for each in conditions}
    with within(budgets.EXACT):  # one budget for all proofs
        for i, each in enumerate(conditions):
            progress(i, len(conditions))
            needs = requirements[each.name]
            if each.name == proved:
                requirements[each.name] = replace(needs, proof="rational")
            else:
                requirements[each.name] = _with_proof(loop, filed(loop, coupling), each, needs)
    return requirements
