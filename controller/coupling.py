"""Virtual couplings: what stands between the devices and the environment. A new coupling is one class here.

V maps force to displacement (a compliance) and sits in negative feedback around Psi E, so that the environment sees
u = x - V f. A coupling is anything that turns Psi E into G = (I + Psi E V)^-1 Psi E, in the arithmetic of Psi E:
floats, a stack, Fractions, or sampled responses (controller.lti). Its form is what a file holds of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec
import numpy as np
from haptic_loop.controller.arithmetic import Number, numbers
from haptic_loop.controller.lti import Array, Block, Complex, Lti, ReadOnly, Sampled, as_like, frozen, taps
from numpy.typing import ArrayLike, NDArray

_LARGEST_COEFFICIENT = 1e12  # of a stored coupling, SI units
_MOST_TERMS = 2000  # of a moving average; every one is a state
_LARGEST_WEIGHT = 1e9  # of a force filter: beyond it arithmetic would overflow before the filter could be judged
_Rows = tuple[tuple[float, ...], ...]


class Coupling:
    """Anything that can be closed around the (delayed) environment.

    A new one is derived from it and has `compliance` and `form`; its own `around` where it is no V in feedback.
    """

    kind: ClassVar[str] = "own"  # how reports name it
    holds_model: ClassVar[bool] = False  # a linear model of the environment: it cannot face walls
    one_period: ClassVar[bool] = False  # its coefficients are for the T that it was designed for

    def around(self, environment: Block, further: int = 0) -> Block:
        """(I + Psi E V)^-1 Psi E, given Psi E, whose last `further` ports lie behind no coupling: walls have them.

        Raises ValueError for another number of contacts, and where there is no V.
        """
        V = self.compliance(environment.T)
        if V is None:
            raise ValueError(f"a coupling of class {type(self).__name__} has no compliance(T): define it")
        if isinstance(environment, Lti):
            contacts = environment.inputs - further
            if (V.outputs, V.inputs) != (contacts, environment.outputs - further):
                raise ValueError(f"the coupling is {V.outputs} x {V.inputs}, the environment has {contacts} contacts")
        if further:
            V = Lti.diag(V, Lti.constant(np.zeros((further, further)), V.T))
        return environment.feedback(as_like(environment, V))

    def compliance(self, T: Number) -> Lti | None:
        """V(z) in the arithmetic of T; None where the coupling is not a V in feedback around any environment."""
        return Lti.diag(*channels) if (channels := self.channels(T)) else None

    def channels(self, T: Number) -> list[Lti] | None:
        """V_i(z) of each channel, where V is diagonal by construction."""
        return None

    def sampled(self, z: Complex, T: float) -> Sampled:
        """V at z (n, k) or (1, k), of a coupling that has one."""
        V = self.compliance(T)
        assert V is not None
        return Sampled.of(V, z)

    def with_model(self, model: Lti) -> Compliance | None:
        """The V that results where its model of the environment stays `model`; None for a coupling without a model."""
        return None

    def at_period(self, T: float) -> Coupling:
        """The same gains, or coefficients, with another period T [s]."""
        return self

    def scaled(self, stiffness: float = 1.0, damping: float = 1.0) -> Coupling:
        """The same with all K and all B, where it has such gains, times as much."""
        return self

    def in_series(self, T: Number) -> Lti | None:
        """A block with the poles that it adds to those of the environment, where it feeds nothing back."""
        return None

    def figures(self, T: float) -> dict[str, Any]:
        """Figures for a report: the order of V, Q or R, and the gains where it has gains."""
        V = self.compliance(T)
        return {"order": V.order if V else 0}

    def form(self) -> Form:
        """Its form in a file."""
        raise ValueError(f"a coupling of class {type(self).__name__} has no form in a file")


@dataclass(frozen=True)
class NoCoupling(Coupling):
    """V = 0: the devices touch the environment directly."""

    kind = "none"

    def around(self, environment: Block, further: int = 0) -> Block:
        return environment

    def form(self) -> _NoForm:
        return _NoForm()


@dataclass(frozen=True, eq=False)
class SpringDamper(ReadOnly, Coupling):
    """V = [K + B (z-1)/(Tz)]^-1, one spring and damper per channel (26); many of them at once with leading axes.

    The damper may act on a filtered velocity: backward Euler of B s / (tau s + 1), a damper in series with a spring of
    stiffness B / tau, so it stays passive: 1/V = K + B (1 - beta)/(1 - beta/z) (1 - 1/z)/T, beta = tau/(tau + T).
    """

    K: Array  # (..., m) [N/m]
    B: Array  # (..., m) [N s/m]
    cutoff: float | None = None  # [Hz] of the velocity filter, 1/(2 pi tau); None for none

    kind = "spring-damper"

    if TYPE_CHECKING:  # what __post_init__ accepts is more than what the fields then hold

        def __init__(self, K: ArrayLike, B: ArrayLike, cutoff: float | None = None) -> None: ...

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), max(1, np.ndim(getattr(self, name))), name))
        if self.K.shape != self.B.shape:
            raise ValueError(
                f"K has {self.K.shape[-1]} channels and B has {self.B.shape[-1]}; give one of each per device"
            )
        if not self.K.shape[-1]:
            raise ValueError("K has no channels, expected one stiffness per device")
        if not ((self.K > 0) & (self.K <= _LARGEST_COEFFICIENT)).all():
            raise ValueError(
                f"K is {self.K.tolist()}, expected positive stiffnesses up to {_LARGEST_COEFFICIENT:g} N/m"
            )
        if not ((self.B >= 0) & (self.B <= _LARGEST_COEFFICIENT)).all():
            raise ValueError(f"B is {self.B.tolist()}, expected dampings >= 0 up to {_LARGEST_COEFFICIENT:g} N s/m")
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

    def figures(self, T: float) -> dict[str, Any]:
        return {"K": self.K.tolist(), "B": self.B.tolist()} | super().figures(T)

    def scaled(self, stiffness: float = 1.0, damping: float = 1.0) -> SpringDamper:
        return replace(self, K=stiffness * self.K, B=damping * self.B)

    def sampled(self, z: Complex, T: float) -> Sampled:
        """V at z (n, k) or (1, k), for gains (n, m) or (m,)."""
        beta, points = self._beta(T), np.asarray(z)[..., None]
        rate = (1 - beta) / (1 - beta / points) * (1 - 1 / points) / T
        values = 1 / (self.K[..., None, :] + self.B[..., None, :] * rate)
        return Sampled(z, values[..., None] * np.eye(values.shape[-1]), T)

    def around(self, environment: Block, further: int = 0) -> Block:
        if isinstance(environment, Sampled):
            return environment.feedback(self.sampled(environment.z, environment.T))
        return super().around(environment, further)

    def form(self) -> _SpringDamperForm:
        if self.cutoff is not None:
            raise ValueError("a spring-damper with a velocity filter cannot be stored")
        return _SpringDamperForm(tuple(self.K.tolist()), tuple(self.B.tolist()))

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


#: The gains that the paper prints, by case: (27) for Lambda = Theta Psi and (28) for Lambda = I. Neither satisfies the
#: paper's own condition.
PUBLISHED = {
    "I": SpringDamper(K=[2870.0, 2320.0], B=[5.47, 5.55]),
    "II": SpringDamper(K=[1810.0, 120.0], B=[5.78, 3.81]),
}


@dataclass(frozen=True, eq=False)
class MovingAverage(ReadOnly, Coupling):
    """V_i = weight_i (1 + 1/z + ... + z^-(terms_i - 1)) + constant_i: the sum of the last forces, and a plain spring.

    With weight T/(2 delta), as many terms as a force takes ticks to act and a constant however small it is the
    stiffest coupling that any-environment admits (docs/theory.md).
    """

    weight: Array  # (m,) [m/N]
    terms: tuple[int, ...]  # (m,)
    constant: Array  # (m,) [m/N]

    kind, one_period = "moving-average", True

    if TYPE_CHECKING:

        def __init__(self, weight: ArrayLike, terms: Sequence[int], constant: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        for name in ("weight", "constant"):
            values = frozen(getattr(self, name), 1, name)
            object.__setattr__(self, name, values)
            if not ((values >= 0).all() and (values <= _LARGEST_COEFFICIENT).all()):
                raise ValueError(f"{name} is {values.tolist()}, allowed are 0 to {_LARGEST_COEFFICIENT:g} m/N")
        object.__setattr__(self, "terms", tuple(int(n) for n in self.terms))
        if not len(self.weight) == len(self.constant) == len(self.terms):
            sizes = f"{len(self.weight)}, {len(self.terms)} and {len(self.constant)}"
            raise ValueError(f"weight, terms and constant have {sizes} entries; give one of each per device")
        if not all(1 <= n <= _MOST_TERMS for n in self.terms):
            raise ValueError(f"terms are {list(self.terms)}, allowed are 1 to {_MOST_TERMS}")

    @property
    def stiffness(self) -> Array:
        """1/V(1) [N/m], (m,)."""
        return 1 / (self.weight * self.terms + self.constant)

    def channels(self, T: Number) -> list[Lti]:
        """V_i(z)."""
        rows = zip(numbers(self.weight, T), self.terms, numbers(self.constant, T), strict=True)
        return [taps([w + e, *[w] * (n - 1)], T) for w, n, e in rows]

    def figures(self, T: float) -> dict[str, Any]:
        return {"stiffness": self.stiffness.tolist()} | super().figures(T)

    def form(self) -> _MovingAverageForm:
        return _MovingAverageForm(tuple(self.weight.tolist()), self.terms, tuple(self.constant.tolist()))


@dataclass(frozen=True, eq=False)
class Compliance(Coupling):
    """A general V(z), given as a state-space block."""

    V: Lti

    kind, one_period = "compliance", True

    def compliance(self, T: Number) -> Lti:
        return self.V if isinstance(T, float) and T == self.V.T else Lti(self.V.A, self.V.B, self.V.C, self.V.D, T)

    def at_period(self, T: float) -> Compliance:
        return Compliance(replace(self.V, T=T))

    def form(self) -> _ComplianceForm:
        return _ComplianceForm(*(_rows(getattr(self.V, name)) for name in "ABCD"))


@dataclass(frozen=True, eq=False)
class InternalModel(ReadOnly, Coupling):
    """The pair of a parameter Q(z) and the environment itself: u = x - Q y, where y = Psi E x is the model's answer.

    G = Psi E - Psi E Q Psi E: the same as V = Q (I - Psi E Q)^-1 in feedback, but affine in Q, and stable whenever Q
    and the environment are. Q(z) = sum_k Q_k b_k(z) over the functions of `basis`, all of which are 1 at z = 1, so
    the static Q(1) is the plain sum of the coefficients.
    """

    poles: Array  # (n,) in (-1, 1); all zero: an FIR filter of n + 1 taps
    Q: Array  # (n + 1, m, m) [m/N]

    kind, holds_model, one_period = "internal-model", True, True

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
        return _realised(self.poles, NO_PAIRS, self.Q, T)

    def with_model(self, model: Lti) -> Compliance:
        return Compliance(self.parameter(model.T).feedback(-model))

    def figures(self, T: float) -> dict[str, Any]:
        return {"order": self.parameter(T).order}

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

    def form(self) -> _InternalModelForm:
        return _InternalModelForm(tuple(self.poles.tolist()), tuple(_rows(q) for q in self.Q))


@dataclass(frozen=True, eq=False)
class ForceFilter(ReadOnly, Coupling):
    """R in F = Theta R Psi E: one copy of the environment, moved by the devices, then a filter R(z) of its forces.

    Nothing is fed back, so R and the environment are stable or not by themselves, and F is affine in R. R = I - Psi E Q
    makes it the pair of `InternalModel`. R(z) = sum_k R_k b_k(z) over the functions of `basis`, all of them 1 at z = 1,
    and R(1) = g I exactly so in the decimals of the coefficients: F(1) = g E(1) is symmetric whatever the springs are.
    R_k has a column per channel's force and, where it has m + 1 of them, one for the sum of all forces.

    Raises ValueError for poles that are not stable and for coefficients whose sum is not g I with g >= 0.
    """

    poles: Array  # (n,) in (-1, 1); at zero they make delays
    pairs: Array  # (p, 2): b1, b2 of z^2 + b1 z + b2
    R: Array  # (1 + n + 2 p, m, m) or (1 + n + 2 p, m, m + 1), without unit

    kind, holds_model, one_period = "force-filter", True, True

    if TYPE_CHECKING:

        def __init__(self, poles: ArrayLike, pairs: ArrayLike, R: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        object.__setattr__(self, "poles", frozen(self.poles, 1, "poles"))
        object.__setattr__(self, "pairs", frozen(self.pairs if np.size(self.pairs) else NO_PAIRS, 2, "pairs"))
        object.__setattr__(self, "R", frozen(self.R, 3, "R"))
        if self.pairs.shape[1] != 2:
            raise ValueError(f"pairs have {self.pairs.shape[1]} entries, expected two: b1, b2 of z^2 + b1 z + b2")
        if not (np.abs(self.poles) < 1).all():
            raise ValueError(f"poles are {self.poles.tolist()}, expected numbers between -1 and 1")
        for b1, b2 in self.pairs:
            if not (abs(b2) < 1 and abs(b1) < 1 + b2):
                raise ValueError(
                    f"pairs has [{b1:g}, {b2:g}]: z^2 + b1 z + b2 has a root on or outside the unit circle"
                )
        functions, rows, columns = self.R.shape
        expected = 1 + self.poles.size + 2 * len(self.pairs)
        if functions != expected or columns not in (rows, rows + 1) or not rows:
            shapes = f"({expected}, channels, channels) or ({expected}, channels, channels + 1)"
            raise ValueError(f"R has shape {self.R.shape}, expected {shapes}")
        if not (np.isfinite(self.R).all() and np.abs(self.R).max() <= _LARGEST_WEIGHT):
            raise ValueError(
                f"R has an entry of {np.abs(self.R).max():g}, allowed are numbers up to {_LARGEST_WEIGHT:g}"
            )
        static = self._static()
        if (static - static[0, 0] * np.eye(rows, dtype=object)).any() or static[0, 0] < 0:
            shown = static.astype(float).tolist()
            raise ValueError(f"the coefficients of R sum to {shown}, expected g times the identity with g >= 0")

    @property
    def g(self) -> float:
        """The rendered share of the static stiffness: F(1) = g E(1)."""
        return float(self._static()[0, 0])

    def _static(self) -> Array:
        """R(1), exactly."""
        return _own_columns(numbers(self.R, Fraction(1)).sum(axis=0))

    def filter(self, T: Number) -> Lti:
        """R(z), in the arithmetic of T."""
        return _realised(self.poles, self.pairs, self.R, T)

    def in_series(self, T: Number) -> Lti:
        return ForceFilter(self.poles, self.pairs, np.append(np.zeros(len(self.R) - 1), 1.0)[:, None, None]).filter(T)

    def figures(self, T: float) -> dict[str, Any]:
        return {"order": self.filter(T).order}

    def around(self, environment: Block, further: int = 0) -> Block:
        """R Psi E, given Psi E."""
        m = self.R.shape[1]
        if isinstance(environment, Sampled):
            values = basis(self.poles, environment.z, self.pairs)
            return (
                Sampled(environment.z, np.tensordot(values, _own_columns(self.R), axes=1), environment.T) @ environment
            )
        if further:
            raise ValueError("the coupling holds a linear model of the environment: walls behind it have none")
        if environment.inputs != m or environment.outputs != m:
            raise ValueError(f"the coupling is {m} x {m}, the environment has {environment.inputs} contacts")
        return self.filter(environment.T) @ environment

    def form(self) -> _ForceFilterForm:
        poles, pairs = tuple(self.poles.tolist()), tuple((b1, b2) for b1, b2 in self.pairs.tolist())
        return _ForceFilterForm(poles, pairs, tuple(_rows(R) for R in self.R))


NO_PAIRS = np.zeros((0, 2))


def basis(poles: Array, z: NDArray[np.complex128], pairs: Array = NO_PAIRS) -> NDArray[np.complex128]:
    """b_k(z) of a filter, k = 0..n + 2 p; shape z.shape + (1 + n + 2 p,). All of them are 1 at z = 1.

    b_0 = 1; a real pole a adds (1 - a)/(z - a), a pair the two functions (1 + b1 + b2) {z, 1}/(z^2 + b1 z + b2), each
    behind the all-pass sections of those before it: Takenaka-Malmquist functions up to their lengths. Poles at zero
    make 1, 1/z, 1/z^2, ..
    """
    values, through = [np.ones_like(z)], np.ones_like(z)
    for a in poles:
        values.append(through * (1 - a) / (z - a))
        through = through * (1 - a * z) / (z - a)
    for b1, b2 in pairs:
        section = through / (z * z + b1 * z + b2)
        values += [(1 + b1 + b2) * section * z, (1 + b1 + b2) * section]
        through = section * (b2 * z * z + b1 * z + 1)
    return np.stack(values, axis=-1)


def _own_columns(R: Array) -> Array:
    """Coefficients (.., m, m) from those of the forces and, in one more column, of their sum."""
    m = R.shape[-2]
    return R[..., :m] + R[..., m:].sum(axis=-1)[..., None] if R.shape[-1] > m else R


def _realised(poles: Array, pairs: Array, R: Array, T: Number) -> Lti:
    """sum_k R_k b_k(z), one chain of sections per input, in the arithmetic of T.

    A chain ends with the last function that has a coefficient. What the sum of all inputs drives is the sum of the
    chains, and has states of its own only beyond the shortest of them.
    """
    rows, columns = R.shape[1:]
    n, reals = R.shape[0] - 1, poles.size
    poles, pairs, R = (numbers(part, T) if part.size else part for part in (poles, pairs, R))
    signals = numbers(np.eye(n + 1), T)
    one = signals[0, 0]
    through, after, read = signals[-1], [], [one] * (n + 1)
    for a in poles:
        state = signals[len(after)]
        read[len(after) + 1] = 1 - a
        after.append(a * state + through)
        through = (1 - a * a) * state - a * through
    for b1, b2 in pairs:
        first, second = signals[len(after)], signals[len(after) + 1]  # z/den and 1/den behind what comes through
        read[len(after) + 1] = read[len(after) + 2] = 1 + b1 + b2
        after += [through - b1 * first - b2 * second, first]
        through = b2 * through + b1 * (1 - b2) * first + (1 - b2 * b2) * second
    sections = np.array(after, dtype=R.dtype).reshape(n, n + 1)

    reached = [_reached(R[1:, :, j], reals) for j in range(columns)]
    shared = min(reached[:rows])  # the states of the sum's chain up to here are the sums of the others'
    own = sum(reached[:rows])
    total = own + sum(max(length - shared, 0) for length in reached[rows:])
    A, B, C = (np.full(shape, one - one) for shape in ((total, total), (total, rows), (rows, total)))
    starts = np.cumsum([0, *reached[: rows - 1]])
    for j, (at, length) in enumerate(zip(starts, reached[:rows], strict=True)):
        part = slice(at, at + length)
        A[part, part] = sections[:length, :length]
        B[part, j] = sections[:length, -1]
        for k in range(length):
            C[:, at + k] = R[k + 1, :, j] * read[k + 1]
    for length in reached[rows:]:
        for k in range(min(length, shared)):
            C[:, starts + k] += (R[k + 1, :, rows] * read[k + 1])[:, None]
        for k in range(shared, length):
            for q in range(shared):
                A[own + k - shared, starts + q] = sections[k, q]
            A[own + k - shared, own:] = sections[k, shared:length]
            B[own + k - shared] = sections[k, -1]
            C[:, own + k - shared] = R[k + 1, :, rows] * read[k + 1]
    return Lti(A, B, C, _own_columns(R[0]), T)


def _reached(R: Array, reals: int) -> int:
    """The states of a chain, given the coefficients of its functions: up to the last that is used, a pair whole."""
    used = np.flatnonzero((R != 0).any(axis=1))
    if not used.size:
        return 0
    length = int(used[-1]) + 1
    return length + (length - reals) % 2 if length > reals else length


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable, and refuses fields that it does not know."""


class _NoForm(Strict, frozen=True, tag_field="kind", tag="none"):
    """V = 0."""

    @property
    def shape(self) -> None:
        """The field that says how many channels there are, and its size."""
        return None

    def build(self, T: float) -> NoCoupling:
        return NoCoupling()


class _SpringDamperForm(Strict, frozen=True, tag_field="kind", tag="spring-damper"):
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


class _MovingAverageForm(Strict, frozen=True, tag_field="kind", tag="moving-average"):
    """A weighted sum of the last forces and a plain spring per channel."""

    weight: tuple[float, ...]  # (m,) [m/N]
    terms: tuple[int, ...]  # (m,)
    constant: tuple[float, ...]  # (m,) [m/N]

    def __post_init__(self) -> None:
        self.build(1.0)

    @property
    def shape(self) -> tuple[str, int]:
        return "weight", len(self.weight)

    def build(self, T: float) -> MovingAverage:
        return MovingAverage(self.weight, self.terms, self.constant)


class _ComplianceForm(Strict, frozen=True, tag_field="kind", tag="compliance"):
    """A general V(z), as the rows of its state-space matrices."""

    A: _Rows
    B: _Rows
    C: _Rows
    D: _Rows

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


class _InternalModelForm(Strict, frozen=True, tag_field="kind", tag="internal-model"):
    """The parameter Q(z) of the pair with the environment: poles of its basis, and a coefficient per function."""

    poles: tuple[float, ...]  # (n,)
    Q: tuple[_Rows, ...]  # (n + 1, m, m) [m/N]

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


class _ForceFilterForm(Strict, frozen=True, tag_field="kind", tag="force-filter"):
    """The filter R(z) of the environment's forces: poles of its basis, and a coefficient per function."""

    poles: tuple[float, ...]  # (n,)
    pairs: tuple[tuple[float, float], ...]  # (p, 2)
    R: tuple[_Rows, ...]  # (1 + n + 2 p, m, m or m + 1)

    def __post_init__(self) -> None:
        if any([len(row) for row in rows] != [len(self.R[0][0])] * len(self.R[0]) for rows in self.R):
            raise ValueError("R has coefficients that are not matrices of one size")
        self.build(1.0)

    @property
    def shape(self) -> tuple[str, int, int]:
        return "R", len(self.R[0]), len(self.R[0])

    def build(self, T: float) -> ForceFilter:
        return ForceFilter(self.poles, self.pairs, self.R)


Form = _NoForm | _SpringDamperForm | _MovingAverageForm | _ComplianceForm | _InternalModelForm | _ForceFilterForm


def require_channels(form: Form, m: int) -> None:
    """Raises ValueError where a form is of another number of channels."""
    shape = form.shape
    if shape is not None and any(size != m for size in shape[1:]):
        size = f"is {shape[1]} x {shape[2]}" if len(shape) > 2 else f"has {shape[1]} entries"
        raise ValueError(f"{shape[0]} {size}, the environment has {m} contacts")


def _require_sensible(name: str, rows: _Rows) -> None:
    """Raise ValueError where a coefficient is so large that arithmetic would overflow before it could be judged."""
    for value in (value for row in rows for value in row):
        if not abs(value) <= _LARGEST_COEFFICIENT:
            raise ValueError(f"{name} has an entry {value:g}, allowed are up to {_LARGEST_COEFFICIENT:g}")


def _table(name: str, rows: _Rows, height: int, width: int) -> Array:
    if len(rows) != height or any(len(row) != width for row in rows):
        raise ValueError(f"{name} has rows of {[len(row) for row in rows]} entries, expected {height} x {width}")
    _require_sensible(name, rows)
    return np.array(rows, dtype=float).reshape(height, width)


def _rows(matrix: Array) -> _Rows:
    return tuple(map(tuple, matrix.tolist()))
