"""The loop's linear blocks in exact rational arithmetic, built from the stored coefficients.

The floating-point state space will not do: rounding makes its F(1) asymmetric at 1e-13, and then the
closed-loop condition fails, formally, as the frequency goes to zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from controller.coupling import Compliance, Coupling, InternalModel, NoCoupling, SpringDamper, parameter
from controller.environment import Network, realise
from design.proof.rational import Matrix, block, block_diag, rational


@dataclass(frozen=True, eq=False)
class Exact:
    """x+ = A x + B u, y = C x + D u over the rationals. `G @ H` is the series G(z) H(z)."""

    A: Matrix  # (n, n)
    B: Matrix  # (n, m)
    C: Matrix  # (p, n)
    D: Matrix  # (p, m)

    @classmethod
    def constant(cls, D: Matrix) -> Exact:
        p, m = D.shape
        return cls(Matrix.zeros(0, 0), Matrix.zeros(0, m), Matrix.zeros(p, 0), D)

    @classmethod
    def diag(cls, *blocks: Exact) -> Exact:
        return cls(*(block_diag(*(getattr(g, name) for g in blocks)) for name in "ABCD"))

    @property
    def order(self) -> int:
        return self.A.shape[0]

    def __matmul__(self, other: Exact) -> Exact:
        A = block([[other.A, Matrix.zeros(other.order, self.order)], [self.B @ other.C, self.A]])
        B = block([[other.B], [self.B @ other.D]])
        return Exact(A, B, block([[self.D @ other.C, self.C]]), self.D @ other.D)

    def __sub__(self, other: Exact) -> Exact:
        B = block([[self.B], [other.B]])
        return Exact(block_diag(self.A, other.A), B, block([[self.C, -other.C]]), self.D - other.D)

    def feedback(self, other: Exact) -> Exact:
        """(I + G H)^-1 G. Raises SingularMatrix where I + D_G D_H has no inverse."""
        S = (Matrix.eye(self.D.shape[0]) + self.D @ other.D).inverse()
        y_x, y_u = block([[S @ self.C, -(S @ self.D @ other.C)]]), S @ self.D
        u_x = block([[Matrix.zeros(self.D.shape[1], self.order), -other.C]]) - other.D @ y_x
        u_u = Matrix.eye(self.D.shape[1]) - other.D @ y_u
        A = block_diag(self.A, other.A) + block([[self.B @ u_x], [other.B @ y_x]])
        return Exact(A, block([[self.B @ u_u], [other.B @ y_u]]), y_x, y_u)

    def split_at_one(self) -> tuple[Matrix, Exact]:
        """G(1), and (G(z) - G(1))/(z - 1) = -C (I - A)^-1 (zI - A)^-1 B, which is regular at z = 1.

        Raises SingularMatrix if A has the eigenvalue one.
        """
        C = -(Matrix.eye(self.order) - self.A).T.solve(self.C.T).T
        p, m = self.D.shape
        return self.D - C @ self.B, Exact(self.A, self.B, C, Matrix.zeros(p, m))


def delay(steps: Sequence[int], gain: Sequence[Fraction] | None = None, moving_sum: bool = False) -> Exact:
    """diag(g_i z^-n_i), or with `moving_sum` diag(g_i (1 + 1/z + ... + z^-n_i))."""
    gains = gain or [Fraction(1)] * len(steps)
    return Exact.diag(*(_chain(n, g, moving_sum) for n, g in zip(steps, gains, strict=True)))


def _chain(n: int, gain: Fraction, moving_sum: bool) -> Exact:
    if n == 0:
        return Exact.constant(Matrix.of([[gain]]))
    taps = [gain if moving_sum or i == n - 1 else Fraction(0) for i in range(n)]
    first = [[int(i == 0)] for i in range(n)]
    return Exact(
        Matrix(np.eye(n, k=-1, dtype=object)),
        Matrix.of(first),
        Matrix.of([taps]),
        Matrix.of([[gain if moving_sum else 0]]),
    )


def environment(network: Network, T: Fraction) -> Exact:
    """E(z) by backward Euler, exactly. Raises SingularMatrix if nothing holds an internal node."""
    inverse: Callable = lambda values: Matrix.of(values, values.shape).inverse().fractions()  # noqa: E731
    blocks = realise(network.matrices(rational), len(network.contacts), T, inverse)
    return Exact(*(Matrix.of(values, values.shape) for values in blocks))


def compliance(coupling: Coupling, channels: int, T: Fraction) -> Exact:
    """V(z) of a coupling; zero where there is none. Raises TypeError for a kind that has no V."""
    match coupling:
        case NoCoupling():
            return Exact.constant(Matrix.zeros(channels, channels))
        case SpringDamper():
            return Exact.diag(*(_spring_damper(rational(float(k)), rational(float(b)), T)
                                for k, b in zip(coupling.K, coupling.B, strict=True)))  # fmt: skip
        case Compliance():
            parts = (getattr(coupling.V, name) for name in "ABCD")
            return Exact(*(Matrix.of(values.tolist(), values.shape) for values in parts))
    raise TypeError(f"no exact model of a {type(coupling).__name__}")


def _spring_damper(k: Fraction, b: Fraction, T: Fraction) -> Exact:
    """V = [k + b (z-1)/(Tz)]^-1 (26)."""
    gain = 1 / (k + b / T)
    if b == 0:
        return Exact.constant(Matrix.of([[gain]]))
    memory = gain * b / T
    return Exact(*(Matrix.of([[value]]) for value in (memory, gain, memory, gain)))


def force_map(E: Exact, coupling: Coupling, theta: Sequence[int], psi: Sequence[int], T: Fraction) -> Exact:
    """F = Theta (I + Psi E V)^-1 Psi E (6), or Theta (Psi E - Psi E Q Psi E)."""
    delayed = delay(psi) @ E
    m = len(theta)
    if not isinstance(coupling, InternalModel):
        return delay(theta) @ delayed.feedback(compliance(coupling, m, T))
    return delay(theta) @ delayed @ (Exact.constant(Matrix.eye(m)) - _parameter(coupling) @ delayed)


def _parameter(coupling: InternalModel) -> Exact:
    """Q(z): the poles and coefficients as decimals, the rest follows exactly."""
    exactly = np.vectorize(lambda value: rational(float(value)), otypes=[object])
    poles = exactly(coupling.poles) if coupling.poles.size else np.zeros(0, dtype=object)
    blocks = parameter(poles, exactly(coupling.Q))
    return Exact(*(Matrix.of(values.tolist(), values.shape) for values in blocks))


def shifted_compliance(V: Exact, theta: Sequence[int], delta: Sequence[Fraction], T: Fraction) -> Exact:
    """H = V - Theta-hat, Theta-hat = diag(T/(2 delta_i) (1 + 1/z + ... + z^-theta_i)) (12)."""
    return V - delay(theta, [T / (2 * d) for d in delta], moving_sum=True)
