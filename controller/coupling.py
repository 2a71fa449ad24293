"""Virtual couplings: what stands between the devices and the environment.

V maps force to displacement (a compliance) and sits in negative feedback around Psi E, so that the
environment sees u = x - V f. A coupling is anything that turns Psi E into G = (I + Psi E V)^-1 Psi E.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.lti import Array, Lti, frozen


class Coupling(Protocol):
    """Anything that can be closed around the (delayed) environment."""

    def around(self, environment: Lti, further: int = 0) -> Lti:
        """(I + Psi E V)^-1 Psi E, given Psi E, whose last `further` ports lie behind no coupling."""
        ...


@dataclass(frozen=True)
class NoCoupling:
    """V = 0: the devices touch the environment directly."""

    def around(self, environment: Lti, further: int = 0) -> Lti:
        return environment


@dataclass(frozen=True, eq=False)
class SpringDamper:
    """V = [K + B (z-1)/(Tz)]^-1, one spring and damper per channel (26)."""

    K: Array  # (m,) [N/m]
    B: Array  # (m,) [N s/m]

    if TYPE_CHECKING:  # what __post_init__ accepts is more than what the fields then hold

        def __init__(self, K: ArrayLike, B: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), 1, name))
        if self.K.shape != self.B.shape:
            raise ValueError(f"K has {self.K.size} channels and B has {self.B.size}; give one of each per device")
        if not (np.isfinite(self.K).all() and (self.K > 0).all()):
            raise ValueError(f"K is {self.K.tolist()}, expected positive stiffnesses in N/m")
        if not (np.isfinite(self.B).all() and (self.B >= 0).all()):
            raise ValueError(f"B is {self.B.tolist()}, expected dampings >= 0 in N s/m")

    def channels(self, T: float) -> list[Lti]:
        """V_i(z): y = (f + (B/T) y-) / (K + B/T), with a state only where there is a damper."""
        return [_spring_damper(k, b, T) for k, b in zip(self.K, self.B, strict=True)]

    def compliance(self, T: float) -> Lti:
        """V(z), diagonal."""
        return Lti.diag(*self.channels(T))

    def around(self, environment: Lti, further: int = 0) -> Lti:
        return Compliance(self.compliance(environment.T)).around(environment, further)


@dataclass(frozen=True, eq=False)
class Compliance:
    """A general V(z), given as a state-space block."""

    V: Lti

    def around(self, environment: Lti, further: int = 0) -> Lti:
        contacts = environment.inputs - further
        if self.V.inputs != environment.outputs - further or self.V.outputs != contacts:
            channels = f"{self.V.outputs} x {self.V.inputs}"
            raise ValueError(f"the coupling is {channels}, the environment has {contacts} contacts")
        V = Lti.diag(self.V, Lti.constant(np.zeros((further, further)), self.V.T)) if further else self.V
        return environment.feedback(V)


@dataclass(frozen=True, eq=False)
class InternalModel:
    """The pair of a parameter Q(z) and the environment itself: u = x - Q y, where y = Psi E x is the model's answer.

    G = Psi E - Psi E Q Psi E: the same as V = Q (I - Psi E Q)^-1 in feedback, but affine in Q, and stable whenever Q
    and the environment are. Q(z) = sum_k Q_k b_k(z) over the functions of `basis`, all of which are 1 at z = 1, so
    the static Q(1) is the plain sum of the coefficients.
    """

    poles: Array  # (n,) in (-1, 1); all zero: an FIR filter of n + 1 taps
    Q: Array  # (n + 1, m, m) [m/N]

    if TYPE_CHECKING:

        def __init__(self, poles: ArrayLike, Q: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "poles", frozen(self.poles, 1, "poles"))
        object.__setattr__(self, "Q", frozen(self.Q, 3, "Q"))
        functions, rows, columns = self.Q.shape
        if functions != self.poles.size + 1 or rows != columns:
            raise ValueError(f"Q has shape {self.Q.shape}, expected ({self.poles.size + 1}, channels, channels)")
        if not (np.abs(self.poles) < 1).all():
            raise ValueError(f"poles are {self.poles.tolist()}, expected numbers between -1 and 1")
        if not np.isfinite(self.Q).all():
            raise ValueError("Q has entries that are not finite")

    def parameter(self, T: float) -> Lti:
        """Q(z)."""
        return Lti(*parameter(self.poles, self.Q), T)

    def around(self, environment: Lti, further: int = 0) -> Lti:
        m = self.Q.shape[1]
        if further:
            raise ValueError("the coupling holds a linear model of the environment: walls behind it have none")
        if environment.inputs != m or environment.outputs != m:
            raise ValueError(f"the coupling is {m} x {m}, the environment has {environment.inputs} contacts")
        T = environment.T
        return environment @ (Lti.constant(np.eye(m), T) - self.parameter(T) @ environment)


def basis(poles: Array, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """b_0 = 1 and b_k = (1 - a_k)/(z - a_k) prod_{j<k} (1 - a_j z)/(z - a_j), k = 1..n; shape z.shape + (n + 1,).

    Takenaka-Malmquist functions up to their lengths: all-pass sections in a row, each with a tap. Poles at zero make
    them 1, 1/z, 1/z^2, ..
    """
    values, through = [np.ones_like(z)], np.ones_like(z)
    for a in poles:
        values.append(through * (1 - a) / (z - a))
        through = through * (1 - a * z) / (z - a)
    return np.stack(values, axis=-1)


def parameter(poles: Array, Q: Array) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of sum_k Q_k b_k(z), one chain of sections per input, in the arithmetic of the entries."""
    n, m = poles.size, Q.shape[1]
    signals = np.eye(n + 1, dtype=Q.dtype)
    through, after = signals[-1], []
    for a, state in zip(poles, signals, strict=False):
        after.append(a * state + through)
        through = (1 - a * a) * state - a * through
    sections = np.array(after, dtype=Q.dtype).reshape(n, n + 1)
    one = np.eye(m, dtype=Q.dtype)
    C = np.moveaxis(Q[1:] * (1 - poles)[:, None, None], 0, 2).reshape(m, m * n)
    return np.kron(one, sections[:, :n]), np.kron(one, sections[:, n:]), C, Q[0]


def _spring_damper(k: float, b: float, T: float) -> Lti:
    gain = 1.0 / (k + b / T)
    if b == 0:
        return Lti.constant([[gain]], T)
    memory = gain * b / T
    return Lti([[memory]], [[gain]], [[memory]], [[gain]], T)


def compliance(coupling: Coupling, T: float) -> Lti | None:
    """V(z), where the coupling is one in feedback around the environment."""
    match coupling:
        case SpringDamper():
            return coupling.compliance(T)
        case Compliance(V=V):
            return V
    return None
