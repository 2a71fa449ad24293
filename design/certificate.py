"""Certificates of couplings: proved once, stored, and proved again from the file alone without a solver.

closed-loop: F(1) is exactly symmetric and positive semidefinite, and with F(z) = F(1) + (z - 1) R(z) the block
    R + Delta_D/T - F(1)/2
is strictly positive real (design.proof.positive_real). On |z| = 1 the Hermitian part of F(1)/(z - 1) is -F(1)/2, so
He[F/(z-1)] > -Delta_D/T there; the same certificate shows that F is stable.

theorem4, psi = 0: with H = V - Theta-hat (11), (12), V-hat = (1 - 1/z) H/T, H(1) is exactly symmetric, and with
H(z) = H(1) + (z - 1) R(z) the block
    H(1)/2 - R
is strictly positive real. Then He V-hat = |1 - 1/z|^2 He[H(1)/2 - R]/T >= Delta_V V-hat* V-hat for a small
Delta_V > 0, as V-hat carries the same factor: V-hat is stable and output strictly passive. The environment is
passive because every parameter of the network is non-negative (the Network type refuses others), so
Phi = 0 satisfies Lemma 4, whatever the environment.

With a box around the environment the same is proved for the environment (P) and for every vertex (P1, P2, ..); nothing
is proved of the environments in between, or of one that changes.

A loop whose delays may switch within a range carries a second proof, of any switching (design.jitter.proof).

theorem4, psi >= 1: a multiplier Phi, stored too, and two blocks (design.proof.delayed); it is of this environment.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import msgspec
import numpy as np
import scipy

from controller import coupling as controller_coupling
from controller.environment import environment
from design import margin
from design.box.members import in_each, worst
from design.condition.delayed import theorem4_delayed
from design.jitter.proof import prove_switching, refuted
from design.promises import switching_promise
from design.proof import exact
from design.proof.delayed import coupling_block, environment_block
from design.proof.exact import Exact
from design.proof.positive_real import find_storage, too_large
from design.proof.rational import Matrix, SingularMatrix, definiteness, rational
from design.proof.stored_matrix import refuted_rows, rows_of
from design.store import Certificate, Condition, CouplingData, Loop, Stored, SwitchingProof, digest, sealed

CLAIM_TOLERANCE = 1e-6  # between the required damping on file and the one swept again, which repeats to 1e-9


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
        raise NotProved(f"{_place(loop, condition, place)}{reason}", requirement)
    proof: dict[str, Matrix] = {}
    for name, block in _blocks(loop, coupling, condition, multiplier).items():
        _require_size(block, requirement)
        P, reason = find_storage(block)
        if P is None:
            asked = f"the sweep asks {requirement.ratio:.9f} of the available damping"
            raise NotProved(f"{_place(loop, condition, name)}{reason}; {asked}", requirement)
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


def _place(loop: Loop, condition: Condition, matrix: str) -> str:
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
        certificate.required, requirement.required, rtol=CLAIM_TOLERANCE
    ):
        return f"required is {list(certificate.required)}, the sweep finds {list(requirement.required)}"
    if not np.isclose(certificate.margin, 1 / max(requirement.ratio, 1e-12), rtol=CLAIM_TOLERANCE):
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
    for name, block in blocks.items():
        if reason := refuted_rows(name, block, certificate.matrices[name]):
            return f"{_place(loop, certificate.condition, name)}{reason}"
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
