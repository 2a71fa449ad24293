"""Virtual couplings: what stands between the devices and the environment. A new coupling is one class here.

V maps force to displacement (a compliance) and sits in negative feedback around Psi E, so that the environment sees
u = x - V f. A coupling is anything that turns Psi E into G = (I + Psi E V)^-1 Psi E, in the arithmetic of Psi E:
floats, a stack, Fractions, or sampled responses (controller.lti). Its form is what a file holds of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.lti import Array, Block, Complex, Lti, Number, Sampled, frozen, numbers

LARGEST_COEFFICIENT = 1e12  # of a stored coupling, SI units
Rows = tuple[tuple[float, ...], ...]


class Coupling(Protocol):
    """Anything that can be closed around the (delayed) environment."""

    def around(self, environment: Block, further: int = 0) -> Block:
        """(I + Psi E V)^-1 Psi E, given Psi E, whose last `further` ports lie behind no coupling."""
        ...

    def compliance(self, T: Number) -> Lti | None:
        """V(z) in the arithmetic of T, or None where the coupling is no V in feedback around any environment."""
        ...

    def form(self) -> Form:
        """What a file holds of it."""
        ...


@dataclass(frozen=True)
class NoCoupling:
    """V = 0: the devices touch the environment directly."""

    def around(self, environment: Block, further: int = 0) -> Block:
        return environment

    def compliance(self, T: Number) -> None:
        return None

    def form(self) -> NoForm:
        return NoForm()


@dataclass(frozen=True, eq=False)
class SpringDamper:
    """V = [K + B (z-1)/(Tz)]^-1, one spring and damper per channel (26); many of them at once with leading axes.

    The damper may act on a filtered velocity: backward Euler of B s / (tau s + 1), a damper in series with a spring of
    stiffness B / tau, so it stays passive: 1/V = K + B (1 - beta)/(1 - beta/z) (1 - 1/z)/T, beta = tau/(tau + T).
    """

    K: Array  # (..., m) [N/m]
    B: Array  # (..., m) [N s/m]
    cutoff: float | None = None  # [Hz] of the velocity filter, 1/(2 pi tau); None for none

    if TYPE_CHECKING:  # what __post_init__ accepts is more than what the fields then hold

        def __init__(self, K: ArrayLike, B: ArrayLike, cutoff: float | None = None) -> None: ...

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), max(1, np.ndim(getattr(self, name))), name))
        if self.K.shape != self.B.shape:
            raise ValueError(
                f"K has {self.K.shape[-1]} channels and B has {self.B.shape[-1]}; give one of each per device"
            )
        if not (np.isfinite(self.K).all() and (self.K > 0).all()):
            raise ValueError(f"K is {self.K.tolist()}, expected positive stiffnesses in N/m")
        if not (np.isfinite(self.B).all() and (self.B >= 0).all()):
            raise ValueError(f"B is {self.B.tolist()}, expected dampings >= 0 in N s/m")
        if self.cutoff is not None and not 0 < self.cutoff < np.inf:
            raise ValueError(f"cutoff is {self.cutoff}, expected a positive frequency in Hz")

    def channels(self, T: Number) -> list[Lti]:
        """V_i(z): a state only where there is a damper."""
        beta = self._beta(T)
        return [
            _spring_damper(k, b, beta, T)
            for k, b in zip(np.moveaxis(self.K, -1, 0), np.moveaxis(self.B, -1, 0), strict=True)
        ]

    def compliance(self, T: Number) -> Lti:
        """V(z), diagonal."""
        return Lti.diag(*self.channels(T))

    def sampled(self, z: Complex, T: float) -> Sampled:
        """V at z (n, k) or (1, k), for gains (n, m) or (m,)."""
        beta, points = self._beta(T), np.asarray(z)[..., None]
        rate = (1 - beta) / (1 - beta / points) * (1 - 1 / points) / T
        values = 1 / (self.K[..., None, :] + self.B[..., None, :] * rate)
        return Sampled(z, values[..., None] * np.eye(values.shape[-1]), T)

    def around(self, environment: Block, further: int = 0) -> Block:
        if isinstance(environment, Sampled):
            return environment.feedback(self.sampled(environment.z, environment.T))
        return _feedback(environment, self.compliance(environment.T), further)

    def form(self) -> SpringDamperForm:
        if self.cutoff is not None:
            raise ValueError("a spring-damper with a velocity filter cannot be stored")
        return SpringDamperForm(tuple(self.K.tolist()), tuple(self.B.tolist()))

    def _beta(self, T: Number) -> Any:
        return 0 if self.cutoff is None else 1 / (1 + 2 * np.pi * self.cutoff * T)


def _spring_damper(k: Array, b: Array, beta: Any, T: Number) -> Lti:
    """V = c b/(z - a) + d of one channel, a stack where k and b have axes."""
    stiffness, step = numbers(k, T), numbers(b, T) * (1 - beta) / T
    gain = 1 / (stiffness + step)
    if not np.any(b):
        return Lti.constant(_scalar(gain), T)
    memory = gain * (stiffness * beta + step)
    return Lti(_scalar(memory), _scalar(gain), _scalar(memory - beta), _scalar(gain), T)


def _scalar(value: Any) -> Any:
    """A number, or numbers with axes, as 1 x 1 matrices."""
    return np.asarray(value)[..., None, None]


@dataclass(frozen=True, eq=False)
class Compliance:
    """A general V(z), given as a state-space block."""

    V: Lti

    def compliance(self, T: Number) -> Lti:
        return Lti(self.V.A, self.V.B, self.V.C, self.V.D, T)

    def around(self, environment: Block, further: int = 0) -> Block:
        if isinstance(environment, Sampled):
            return environment.feedback(Sampled.of(self.V, environment.z))
        contacts = environment.inputs - further
        if self.V.inputs != environment.outputs - further or self.V.outputs != contacts:
            channels = f"{self.V.outputs} x {self.V.inputs}"
            raise ValueError(f"the coupling is {channels}, the environment has {contacts} contacts")
        return _feedback(environment, self.compliance(environment.T) if environment.is_exact else self.V, further)

    def form(self) -> ComplianceForm:
        return ComplianceForm(*(_rows(getattr(self.V, name)) for name in "ABCD"))


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

    def parameter(self, T: Number) -> Lti:
        """Q(z), one chain of sections per input."""
        poles, Q = numbers(self.poles, T) if self.poles.size else self.poles, numbers(self.Q, T)
        n, m = self.poles.size, self.Q.shape[1]
        signals = np.eye(n + 1, dtype=Q.dtype)
        through, after = signals[-1], []
        for a, state in zip(poles, signals, strict=False):
            after.append(a * state + through)
            through = (1 - a * a) * state - a * through
        sections = np.array(after, dtype=Q.dtype).reshape(n, n + 1)
        one = np.eye(m, dtype=Q.dtype)
        C = np.moveaxis(Q[1:] * (1 - poles)[:, None, None], 0, 2).reshape(m, m * n)
        return Lti(np.kron(one, sections[:, :n]), np.kron(one, sections[:, n:]), C, Q[0], T)

    def compliance(self, T: Number) -> None:
        return None

    def around(self, environment: Block, further: int = 0) -> Block:
        m = self.Q.shape[1]
        if isinstance(environment, Sampled):
            Q = Sampled(environment.z, np.tensordot(basis(self.poles, environment.z), self.Q, axes=1), environment.T)
            return environment - environment @ (Q @ environment)
        if further:
            raise ValueError("the coupling holds a linear model of the environment: walls behind it have none")
        if environment.inputs != m or environment.outputs != m:
            raise ValueError(f"the coupling is {m} x {m}, the environment has {environment.inputs} contacts")
        T = environment.T
        return environment @ (Lti.constant(np.eye(m), T) - self.parameter(T) @ environment)

    def form(self) -> InternalModelForm:
        return InternalModelForm(tuple(self.poles.tolist()), tuple(_rows(q) for q in self.Q))


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


def _feedback(environment: Lti, V: Lti, further: int) -> Lti:
    """V around all ports of the environment but the last `further`."""
    if further:
        V = Lti.diag(V, Lti.constant(np.zeros((further, further)), V.T))
    return environment.feedback(V)


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable, and refuses fields that it does not know."""


class NoForm(Strict, frozen=True, tag_field="kind", tag="none"):
    """V = 0."""

    @property
    def shape(self) -> None:
        """The field that says how many channels there are, and its size."""
        return None

    def build(self, T: float) -> NoCoupling:
        return NoCoupling()


class SpringDamperForm(Strict, frozen=True, tag_field="kind", tag="spring-damper"):
    """One spring and damper per channel (26)."""

    K: tuple[float, ...]  # (m,) [N/m]
    B: tuple[float, ...]  # (m,) [N s/m]

    def __post_init__(self) -> None:
        SpringDamper(self.K, self.B)

    @property
    def shape(self) -> tuple[str, int]:
        return "K", len(self.K)

    def build(self, T: float) -> SpringDamper:
        return SpringDamper(self.K, self.B)


class ComplianceForm(Strict, frozen=True, tag_field="kind", tag="compliance"):
    """A general V(z), as the rows of its state-space matrices."""

    A: Rows
    B: Rows
    C: Rows
    D: Rows

    def __post_init__(self) -> None:
        self.build(1.0)

    @property
    def shape(self) -> tuple[str, int, int]:
        return "D", len(self.D), len(self.D[0])

    def build(self, T: float) -> Compliance:
        D = _table("D", self.D, len(self.D), len(self.D[0]) if self.D else 0)
        n = len(self.A)
        tables = (_table("A", self.A, n, n), _table("B", self.B, n, D.shape[1]), _table("C", self.C, len(D), n))
        return Compliance(Lti(*tables, D, T))


class InternalModelForm(Strict, frozen=True, tag_field="kind", tag="internal-model"):
    """The parameter Q(z) of the pair with the environment: poles of its basis, and a coefficient per function."""

    poles: tuple[float, ...]  # (n,)
    Q: tuple[Rows, ...]  # (n + 1, m, m) [m/N]

    def __post_init__(self) -> None:
        if any(len(rows) != len(self.Q[0]) or any(len(row) != len(rows) for row in rows) for rows in self.Q):
            raise ValueError("Q has coefficients that are not square matrices of one size")
        for rows in self.Q:
            _require_sensible("Q", rows)
        self.build(1.0)

    @property
    def shape(self) -> tuple[str, int, int]:
        return "Q", len(self.Q[0]), len(self.Q[0])

    def build(self, T: float) -> InternalModel:
        return InternalModel(self.poles, self.Q)


Form = NoForm | SpringDamperForm | ComplianceForm | InternalModelForm


def require_channels(form: Form, m: int) -> None:
    """Raises ValueError where a form is of another number of channels."""
    shape = form.shape
    if shape is not None and any(size != m for size in shape[1:]):
        size = f"is {shape[1]} x {shape[2]}" if len(shape) > 2 else f"has {shape[1]} entries"
        raise ValueError(f"{shape[0]} {size}, the environment has {m} contacts")


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


def _rows(matrix: Array) -> Rows:
    return tuple(map(tuple, matrix.tolist()))
