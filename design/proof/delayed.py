"""What must be strictly positive real for Theorem 4 with delay inside the environment (psi >= 1), exactly.

Two blocks, for a diagonal multiplier 0 <= Phi < Delta_D:
  P_E   E-hat + Phi is passive. E-hat = T z/(z-1) Psi E = T E(1) z/(z-1) + T z R(z), and the Hermitian part of
        z/(z-1) on the circle is 1/2:  T (z R + E(1)/2) + Phi.
  P     V-hat is Delta_V-OSP with Delta_V^-1 = S < Phi^-1 - Delta_D^-1, which is (14). With H = H(1) + (z - 1) R,
        divided by |1 - 1/z|^2 it reads T He[H(1)/2 - R] > H* S^-1 H, by a Schur complement the Hermitian part of
        [[T (H(1)/2 - R), 0], [2 H, S]].
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

from design.proof.exact import Exact
from design.proof.rational import Matrix, block

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
