"""An exact proof that no switching of the delays within a loop's range is dangerous: made, stored, proved again.

With G the forces as they leave, F = Theta_nom G, F(z) = F(1) + (z - 1) R(z) and F(1) exactly symmetric and positive
semidefinite, the block
    [[R + Delta_D/T - diag(alpha)/2 - F(1)/2,  0], [2 h G,  2 diag(alpha)]]
is strictly positive real (design.proof.positive_real): its Hermitian part on |z| = 1 is the matrix of condition.py.
Channels whose delay does not vary have no row and column of the second kind, and alpha = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import msgspec
import numpy as np

from controller.coupling import Coupling
from controller.environment import environment
from controller.lti import Lti, SingularLoop
from controller.process import force_map
from design.jitter.multiplier import JitterProof, jitter_proof, jitter_refusal
from design.promises import switching_promise
from design.proof import exact
from design.proof.exact import Exact
from design.proof.positive_real import find_storage, too_large
from design.proof.rational import Matrix, SingularMatrix, block, definiteness, rational
from design.proof.stored_matrix import refuted_rows, rows_of
from design.store import DelayRange, Loop, SwitchingProof

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
