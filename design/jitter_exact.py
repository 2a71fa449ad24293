"""An exact proof that no switching of the delays within a range is dangerous.

With F = Theta_nom G, F(z) = F(1) + (z - 1) R(z) and F(1) exactly symmetric and positive semidefinite, the block
    [[R + Delta_D/T - diag(alpha)/2 - F(1)/2,  0], [2 h G,  2 diag(alpha)]]
is strictly positive real (design.positive_real): its Hermitian part on |z| = 1 is the matrix of design.jitter.
Channels whose delay does not vary have no row and column of the second kind, and alpha = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from controller.coupling import Coupling
from controller.environment import Network
from design import exact
from design.exact import Exact
from design.positive_real import find_storage, too_large
from design.rational import Matrix, SingularMatrix, block, definiteness, rational


def prove(
    coupling: Coupling,
    network: Network,
    T: float,
    psi: Sequence[int],
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Sequence[float],
    alpha: Sequence[float],
) -> str | None:
    """None if the condition is proved for these alpha [N s/m] at the damping `delta`, otherwise why not."""
    try:
        condition = condition_block(coupling, network, T, psi, lo, hi, delta, alpha)
    except (SingularMatrix, ValueError) as error:
        return str(error)
    return too_large(condition) or find_storage(condition)[1]


def condition_block(
    coupling: Coupling,
    network: Network,
    T: float,
    psi: Sequence[int],
    lo: Sequence[int],
    hi: Sequence[int],
    delta: Sequence[float],
    alpha: Sequence[float],
) -> Exact:
    """The block that must be strictly positive real. Raises ValueError where F(1) is not exactly as it must be."""
    m, period = len(delta), rational(T)
    G = exact.force_map(exact.environment(network, period), coupling, (0,) * m, psi, period)
    half = [Fraction(1, 2)] * m
    # exact.delay's gain is that of its channels; a difference of opposite signs is the sum
    nominal = exact.delay(lo, half) - exact.delay(hi, [-g for g in half])
    F = nominal @ G
    F1, R = F.split_at_one()
    if not F1.equals(F1.T) or not definiteness(F1).semidefinite:
        raise ValueError("G(1) is not exactly symmetric and positive semidefinite")
    varying = [i for i in range(m) if lo[i] < hi[i]]
    damping = [rational(d) / period - rational(float(a)) / 2 for d, a in zip(delta, alpha, strict=True)]
    upper = Matrix.diag(damping) - F1.scaled(Fraction(1, 2))
    if not varying:
        return Exact(R.A, R.B, R.C, upper)
    spread = _rows([hi[i] - lo[i] for i in varying], varying, m)  # 2 h
    error = block([[spread @ G.C, Matrix.zeros(len(varying), F.order - G.order)]])
    lower = Matrix.diag(2 * rational(float(alpha[i])) for i in varying)
    direct = block([[upper, Matrix.zeros(m, len(varying))], [spread @ G.D, lower]])
    return Exact(R.A, block([[R.B, Matrix.zeros(R.order, len(varying))]]), block([[R.C], [error]]), direct)


def _rows(values: Sequence[int], columns: Sequence[int], width: int) -> Matrix:
    """One row per value, which stands in its column."""
    table = np.zeros((len(values), width), dtype=int)
    table[np.arange(len(values)), columns] = values
    return Matrix.of(table.tolist())
