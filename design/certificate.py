"""Certificates of couplings: proved once, stored, and proved again from the file alone without a solver.

closed-loop: F(1) is exactly symmetric and positive semidefinite, and with F(z) = F(1) + (z - 1) R(z) the block
    R + Delta_D/T - F(1)/2
is strictly positive real (design.positive_real). On |z| = 1 the Hermitian part of F(1)/(z - 1) is -F(1)/2, so
He[F/(z-1)] > -Delta_D/T there; the same certificate shows that F is stable.

theorem4, psi = 0: with H = V - Theta-hat (11), (12), V-hat = (1 - 1/z) H/T, H(1) is exactly symmetric, and with
H(z) = H(1) + (z - 1) R(z) the block
    H(1)/2 - R
is strictly positive real. Then He V-hat = |1 - 1/z|^2 He[H(1)/2 - R]/T >= Delta_V V-hat* V-hat for a small
Delta_V > 0, as V-hat carries the same factor: V-hat is stable and output strictly passive. The environment is
passive because every parameter of the network is non-negative (the Network type refuses others), so
Phi = 0 satisfies Lemma 4, whatever the environment.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import scipy

from controller import coupling as controller_coupling
from controller.environment import environment
from controller.lti import SingularLoop
from controller.process import force_map
from design import exact, margin
from design.exact import Exact
from design.positive_real import find_storage, prove_positive_real
from design.rational import Matrix, SingularMatrix, definiteness, rational
from design.store import Certificate, Condition, CouplingData, Loop, Stored, digest, sealed

PROMISE = {"closed-loop": "this environment", "theorem4": "any passive environment"}
LARGEST = 60  # states of a model that a proof is tried for: seconds; it grows with the fourth power
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


def prove(loop: Loop, coupling: CouplingData, condition: Condition) -> Certificate:
    """A certificate with an exact proof of the condition. Raises NotProved with the reason."""
    requirement = required_damping(loop, coupling, condition)
    if not requirement.certified:
        needed = ", ".join(f"{d:.6g}" for d in requirement.required)
        have = ", ".join(f"{d:.6g}" for d in requirement.available)
        raise NotProved(requirement.reason or f"needs {needed} N s/m of damping, has {have}", requirement)
    block = _block(loop, coupling, condition)
    if block.order > LARGEST:
        reason = f"a proof over {block.order} states takes minutes: up to {LARGEST} are tried"
        raise NotProved(reason, requirement)
    P, reason = find_storage(block)
    if P is None:
        raise NotProved(f"{reason}; the sweep asks {requirement.ratio:.9f} of the available damping", requirement)
    return sealed(
        Certificate(
            condition=condition,
            required=requirement.required,
            available=loop.delta,
            margin=1 / max(requirement.ratio, 1e-12),
            promise=PROMISE[condition],
            proof="rational",
            matrices={"P": tuple(tuple(str(v) for v in row) for row in P.fractions())},
            scenario=digest(loop, coupling),
            versions={"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__},
        )
    )


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


def required_damping(loop: Loop, coupling: CouplingData, condition: Condition) -> margin.Requirement:
    """The damping that the condition asks, from a refined sweep. Raises NotProved where it is undefined.

    theorem4 with psi >= 1 needs a multiplier, and closed-loop an algebraic loop that has a solution.
    """
    built = coupling.build(loop.T)
    if condition == "closed-loop":
        try:
            F = force_map(environment(loop.environment, loop.T), built, loop.theta, loop.psi)
        except SingularLoop as error:
            raise NotProved(str(error)) from None
        return margin.closed_loop(F, loop.delta)
    if any(loop.psi):
        raise NotProved("theorem4 with psi >= 1 needs a multiplier Phi, which these certificates do not carry")
    match built:
        case controller_coupling.SpringDamper():
            return margin.theorem4(built.compliance(loop.T), loop.theta, loop.delta)
        case controller_coupling.Compliance(V=V):
            return margin.theorem4(V, loop.theta, loop.delta)
    return margin.refusal("theorem4", loop.delta, "theorem4 needs a coupling: V = 0 dissipates nothing")


def _block(loop: Loop, coupling: CouplingData, condition: Condition) -> Exact:
    """The block that must be strictly positive real, after the exact test at z = 1. Raises NotProved."""
    T, delta = rational(loop.T), [rational(d) for d in loop.delta]
    V = exact.compliance(coupling.build(loop.T), len(delta), T)
    try:
        if condition == "closed-loop":
            F = exact.force_map(exact.environment(loop.environment, T), V, loop.theta, loop.psi)
            F1, R = F.split_at_one()
            _require_static("F(1)", F1)
            return Exact(R.A, R.B, R.C, Matrix.diag(d / T for d in delta) - F1.scaled(Fraction(1, 2)))
        H1, R = exact.shifted_compliance(V, loop.theta, delta, T).split_at_one()
    except SingularMatrix as error:
        raise NotProved(f"a pole at z = 1 or an algebraic loop without solution: {error}") from None
    _require_symmetric("H(1)", H1)
    return Exact(R.A, R.B, -R.C, H1.scaled(Fraction(1, 2)))


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
    if certificate.promise != PROMISE[certificate.condition]:
        return f"{certificate.condition} does not promise {certificate.promise!r}"
    if certificate.available != loop.delta:
        return f"available is {list(certificate.available)}, the loop has delta = {list(loop.delta)}"
    requirement = required_damping(loop, coupling, certificate.condition)
    if len(certificate.required) != len(loop.delta) or not np.allclose(
        certificate.required, requirement.required, rtol=CLAIM_TOLERANCE
    ):
        return f"required is {list(certificate.required)}, the sweep finds {list(requirement.required)}"
    if not np.isclose(certificate.margin, 1 / max(requirement.ratio, 1e-12), rtol=CLAIM_TOLERANCE):
        return f"margin is {certificate.margin:.9g}, the sweep finds {1 / max(requirement.ratio, 1e-12):.9g}"
    return None


def _refuted_proof(loop: Loop, coupling: CouplingData, certificate: Certificate) -> str | None:
    """Why the matrices prove nothing, or None if they prove the condition."""
    block = _block(loop, coupling, certificate.condition)
    rows = certificate.matrices.get("P")
    if rows is None or len(certificate.matrices) != 1:
        return f"matrices are {', '.join(certificate.matrices) or 'none'}, expected P"
    if len(rows) != block.order or any(len(row) != block.order for row in rows):
        return f"P has {len(rows)} rows, the model has {block.order} states"
    try:
        P = Matrix.of(rows, (block.order, block.order))
    except (ValueError, ZeroDivisionError) as error:
        return f"P has an entry that is not a rational number: {error}"
    return prove_positive_real(block, P)
