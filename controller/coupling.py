"""Virtual couplings, the controllers between the devices and the environment.

A coupling has a compliance V(z) from force to displacement. In negative feedback around the delayed environment Psi E,
the displacements x of the devices become u = x - V f, and f = Psi E u. `around` returns this loop,
G = (I + Psi E V)^-1 Psi E, in the arithmetic of Psi E: floats, a stack of systems, Fractions, or sampled responses
(controller.lti). A `ForceFilter` filters forces instead. A coupling is stored in a file as a `Form`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.arithmetic import Number, inverse, numbers, positive_definite, times
from haptic_loop.controller.lti import Array, Block, Complex, Lti, ReadOnly, Sampled, as_like, frozen, taps

_LARGEST_COEFFICIENT = 1e12  # largest gain or coefficient, SI units; larger ones would overflow in a sweep
_MOST_TERMS = 2000  # most terms of a moving average; each term after the first has a state
_ROUNDING = 1e-12  # a damping matrix may have eigenvalues down to -1e-12 of its largest entry
_LARGEST_WEIGHT = 1e9  # largest entry of a force filter's coefficients; larger ones would overflow in a sweep
_Rows = tuple[tuple[float, ...], ...]


class Coupling:
    """Base class of couplings, which close a loop around the delayed environment.

    A subclass defines `compliance`, or `channels` if V is diagonal, and `form` if it can be stored. A coupling without
    a V overrides `around` instead.
    """

    kind: ClassVar[str] = "own"  # name of the class in reports
    holds_model: ClassVar[bool] = False  # whether the coupling filters the forces of a linear model of the environment
    one_period: ClassVar[bool] = False  # whether coefficients are valid only for the T of the design

    def around(self, environment: Block, further: int = 0) -> Block:
        """Return (I + Psi E V)^-1 Psi E for `environment` = Psi E. The last `further` ports (walls) have no coupling.

        Raises:
            ValueError: The environment has another number of contacts, or the class defines no compliance.
        """
        V = self.compliance(environment.T)
        if V is None:
            raise ValueError(f"a coupling of class {type(self).__name__} has no compliance(T): define this method")
        if isinstance(environment, Lti):
            contacts = environment.inputs - further
            if (V.outputs, V.inputs) != (contacts, environment.outputs - further):
                raise ValueError(f"the coupling is {V.outputs} x {V.inputs}, the environment has {contacts} contacts")
        if further:
            V = Lti.diag(V, Lti.constant(np.zeros((further, further)), V.T))
        return environment.feedback(as_like(environment, V))

    def compliance(self, T: Number) -> Lti | None:
        """Return V(z) in the arithmetic of T, or None if the class defines no V (`NoCoupling`, force filters)."""
        return Lti.diag(*channels) if (channels := self.channels(T)) else None

    def channels(self, T: Number) -> list[Lti] | None:
        """Return V_i(z) of each channel if V is diagonal by construction, otherwise None."""
        return None

    def sampled(self, z: Complex, T: float) -> Sampled:
        """Return V at z (n, k) or (1, k). The coupling must have a compliance."""
        V = self.compliance(T)
        assert V is not None
        return Sampled.of(V, z)

    def at_period(self, T: float) -> Coupling:
        """Return the coupling with the same gains or coefficients and the period T [s]."""
        return self

    def scaled(self, stiffness: float = 1.0, damping: float = 1.0) -> Coupling:
        """Return the coupling with all K times `stiffness` and all B times `damping`; other couplings are unchanged."""
        return self

    def turned(self, Q: Array) -> Coupling:
        """Return the coupling Q V Q' in other coordinates of the channels, for an orthogonal Q (m, m).

        Raises ValueError for a class of couplings that cannot be turned.
        """
        raise ValueError(f"a coupling of class {type(self).__name__} cannot be turned to other axes")

    def in_series(self, T: Number) -> Lti | None:
        """Return a block with the poles that a coupling in series adds to the loop; None for a coupling in feedback."""
        return None

    def figures(self, T: float) -> dict[str, Any]:
        """Return the entries of a report: the order of V, or of R (filter), and gains if any."""
        V = self.compliance(T)
        return {"order": V.order if V else 0}

    def form(self) -> Form:
        """Return the content of the coupling in a file. Raises ValueError if it cannot be stored."""
        raise ValueError(f"a coupling of class {type(self).__name__} cannot be stored in a file")

    def __repr__(self) -> str:
        try:
            return f"{type(self).__name__}(order {self.figures(1.0)['order']})"
        except (ValueError, TypeError):  # a user's own class may have no compliance
            return f"{type(self).__name__}()"


@dataclass(frozen=True, repr=False)
class NoCoupling(Coupling):
    """V = 0: the devices touch the environment directly."""

    kind = "none"

    def around(self, environment: Block, further: int = 0) -> Block:
        return environment

    def turned(self, Q: Array) -> NoCoupling:
        return self

    def form(self) -> _NoForm:
        return _NoForm()


@dataclass(frozen=True, eq=False, repr=False)
class SpringDamper(ReadOnly, Coupling):
    """One spring and damper per channel: V = [K + B (z-1)/(Tz)]^-1, (26) of the paper.

    K and B are (m,), or (..., m) for many couplings at once.
    """

    K: Array  # (..., m) [N/m]
    B: Array  # (..., m) [N s/m]

    kind = "spring-damper"

    if TYPE_CHECKING:  # __post_init__ accepts more types than the fields have afterwards

        def __init__(self, K: ArrayLike, B: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), max(1, np.ndim(getattr(self, name))), name))
        if self.K.shape != self.B.shape:
            raise ValueError(f"K has the shape {self.K.shape} and B has {self.B.shape}; give one of each per channel")
        if not self.K.shape[-1]:
            raise ValueError("K has no channels, expected one stiffness per channel")
        if not ((self.K > 0) & (self.K <= _LARGEST_COEFFICIENT)).all():
            raise ValueError(
                f"K is {self.K.tolist()}, expected positive stiffnesses up to {_LARGEST_COEFFICIENT:g} N/m"
            )
        if not ((self.B >= 0) & (self.B <= _LARGEST_COEFFICIENT)).all():
            raise ValueError(f"B is {self.B.tolist()}, expected dampings >= 0 up to {_LARGEST_COEFFICIENT:g} N s/m")

    def channels(self, T: Number) -> list[Lti]:
        """Return V_i(z) of each channel. A channel without damper has no state."""
        gains = zip(np.moveaxis(self.K, -1, 0), np.moveaxis(self.B, -1, 0), strict=True)
        return [_spring_damper(k, b, T) for k, b in gains]

    def compliance(self, T: Number) -> Lti:
        """Return the diagonal V(z)."""
        return Lti.diag(*self.channels(T))

    def __repr__(self) -> str:
        rows = [gains.tolist() if gains.ndim == 1 else None for gains in (self.K, self.B)]
        shown = [f"[{', '.join(f'{value:.6g}' for value in row)}]" if row else f"{self.K.shape}" for row in rows]
        return f"SpringDamper(K={shown[0]}, B={shown[1]})"

    def figures(self, T: float) -> dict[str, Any]:
        return {"K": self.K.tolist(), "B": self.B.tolist()} | super().figures(T)

    def scaled(self, stiffness: float = 1.0, damping: float = 1.0) -> SpringDamper:
        return replace(self, K=stiffness * self.K, B=damping * self.B)

    def turned(self, Q: Array) -> _MatrixSpringDamper:
        K, B = (Q * gains @ Q.T for gains in (self.K, self.B))
        return _MatrixSpringDamper((K + K.T) / 2, (B + B.T) / 2)

    def sampled(self, z: Complex, T: float) -> Sampled:
        """Return V at z (n, k) or (1, k), for gains (n, m) or (m,)."""
        rate = (1 - 1 / np.asarray(z)[..., None]) / T
        values = 1 / (self.K[..., None, :] + self.B[..., None, :] * rate)
        return Sampled(z, values[..., None] * np.eye(values.shape[-1]), T)

    def around(self, environment: Block, further: int = 0) -> Block:
        if isinstance(environment, Sampled):
            return environment.feedback(self.sampled(environment.z, environment.T))
        return super().around(environment, further)

    def form(self) -> _SpringDamperForm:
        return _SpringDamperForm(tuple(self.K.tolist()), tuple(self.B.tolist()))


@dataclass(frozen=True, eq=False)
class _MatrixSpringDamper(ReadOnly, Coupling):
    """Springs and dampers between the axes of devices: V = [K + B (z-1)/(Tz)]^-1 (26) with symmetric K and B.

    Raises:
        ValueError: K is not symmetric and positive definite, or B is not symmetric and positive semidefinite.
    """

    K: Array  # (m, m) [N/m]
    B: Array  # (m, m) [N s/m]

    kind = "matrix-spring-damper"

    def __post_init__(self) -> None:
        for name in "KB":
            object.__setattr__(self, name, frozen(getattr(self, name), 2, name))
            values = getattr(self, name)
            _require_sensible(name, values)
            if values.shape != (len(self.K),) * 2 or not values.size or (values != values.T).any():
                raise ValueError(f"{name} is {values.tolist()}, expected a symmetric matrix with a row per channel")
        if not positive_definite(numbers(self.K, Fraction(1))):
            raise ValueError(f"K is {self.K.tolist()}, expected a positive definite matrix in N/m")
        if np.linalg.eigvalsh(self.B)[0] < -_ROUNDING * np.abs(self.B).max():
            raise ValueError(f"B is {self.B.tolist()}, expected a positive semidefinite matrix in N s/m")

    def compliance(self, T: Number) -> Lti:
        """Return V(z), with one state for each axis that has a damper."""
        step, at = numbers(self.B, T) / T, np.flatnonzero(self.B.any(axis=0))
        gain = inverse(numbers(self.K, T) + step)
        memory = times(gain, step[:, at])
        return Lti(memory[at], gain[at], memory, gain, T)

    def figures(self, T: float) -> dict[str, Any]:
        return {"stiffness": np.diag(self.K).tolist()} | super().figures(T)

    def scaled(self, stiffness: float = 1.0, damping: float = 1.0) -> _MatrixSpringDamper:
        return _MatrixSpringDamper(stiffness * self.K, damping * self.B)

    def form(self) -> _MatrixSpringDamperForm:
        return _MatrixSpringDamperForm(_rows(self.K), _rows(self.B))


def _spring_damper(k: Array, b: Array, T: Number) -> Lti:
    """Return V(z) of one channel, or a stack of systems if k and b are arrays."""
    step = numbers(b, T) / T
    gain = 1 / (numbers(k, T) + step)
    if not np.any(b):
        return Lti.constant(_scalar(gain), T)
    memory = gain * step
    return Lti(_scalar(memory), _scalar(gain), _scalar(memory), _scalar(gain), T)


def _scalar(value: Any) -> Any:
    """Return a number, or an array of numbers, as 1 x 1 matrices."""
    return np.asarray(value)[..., None, None]


#: The gains that the paper prints: (27) for case I, Lambda = Theta Psi, and (28) for case II, Lambda = I. Neither
#: satisfies the condition of the paper's Theorem 4.
PUBLISHED = {
    "I": SpringDamper(K=[2870.0, 2320.0], B=[5.47, 5.55]),
    "II": SpringDamper(K=[1810.0, 120.0], B=[5.78, 3.81]),
}


@dataclass(frozen=True, eq=False, repr=False)
class MovingAverage(ReadOnly, Coupling):
    """V_i = weight_i (1 + 1/z + ... + z^-(terms_i - 1)) + constant_i: a moving sum of the forces and a plain spring.

    With weight T/(2 delta), theta + 1 terms and a small constant it is almost the stiffest linear coupling that
    any-environment admits (docs/theory.md).
    """

    weight: Array  # (m,) [m/N]
    terms: tuple[int, ...]  # (m,)
    constant: Array  # (m,) [m/N]

    kind, one_period = "moving-average", True

    def __post_init__(self) -> None:
        for name in ("weight", "constant"):
            values = frozen(getattr(self, name), 1, name)
            object.__setattr__(self, name, values)
            if not ((values >= 0).all() and (values <= _LARGEST_COEFFICIENT).all()):
                raise ValueError(f"{name} is {values.tolist()}, allowed are 0 to {_LARGEST_COEFFICIENT:g} m/N")
        object.__setattr__(self, "terms", tuple(int(n) for n in self.terms))
        if not len(self.weight) == len(self.constant) == len(self.terms):
            sizes = f"{len(self.weight)}, {len(self.terms)} and {len(self.constant)}"
            raise ValueError(f"weight, terms and constant have {sizes} entries; give one of each per channel")
        if not all(1 <= n <= _MOST_TERMS for n in self.terms):
            raise ValueError(f"terms are {list(self.terms)}, allowed are 1 to {_MOST_TERMS}")

    @property
    def stiffness(self) -> Array:
        """The static stiffness 1/V(1) [N/m], (m,)."""
        return 1 / (self.weight * self.terms + self.constant)

    def channels(self, T: Number) -> list[Lti]:
        """Return V_i(z) of each channel."""
        rows = zip(numbers(self.weight, T), self.terms, numbers(self.constant, T), strict=True)
        return [taps([w + e, *[w] * (n - 1)], T) for w, n, e in rows]

    def figures(self, T: float) -> dict[str, Any]:
        return {"stiffness": self.stiffness.tolist()} | super().figures(T)

    def form(self) -> _MovingAverageForm:
        return _MovingAverageForm(tuple(self.weight.tolist()), self.terms, tuple(self.constant.tolist()))


@dataclass(frozen=True, eq=False, repr=False)
class Compliance(Coupling):
    """A general V(z), as a state-space block."""

    V: Lti

    kind, one_period = "compliance", True

    def compliance(self, T: Number) -> Lti:
        return self.V if isinstance(T, float) and T == self.V.T else Lti(self.V.A, self.V.B, self.V.C, self.V.D, T)

    def at_period(self, T: float) -> Compliance:
        return Compliance(replace(self.V, T=T))

    def turned(self, Q: Array) -> Compliance:
        """Return Q V Q', rounded to decimals such that V(1) is exactly symmetric."""
        static, R = self.V._rest
        A, B, R, static = (
            numbers(_decimals(part, digits), Fraction(1))
            for part, digits in ((self.V.A, 7), (self.V.B @ Q.T, 6), (Q @ R, 7), (Q @ static @ Q.T, 13))
        )
        V = Lti.with_rest(A, B, R, (static + static.T) / 2, Fraction(1))
        A, B, C, D = (getattr(V, name).astype(float) for name in "ABCD")
        return Compliance(Lti(A, B, C, D, self.V.T))

    def form(self) -> _ComplianceForm:
        return _ComplianceForm(*(_rows(getattr(self.V, name)) for name in "ABCD"))


def _decimals(M: Array, digits: int) -> Array:
    """Round all entries of M to the decimal place that leaves `digits` digits of the largest entry."""
    return np.round(M, digits - 1 - int(np.floor(np.log10(np.abs(M).max(initial=1e-300)))))


@dataclass(frozen=True, eq=False, repr=False)
class ForceFilter(ReadOnly, Coupling):
    """A filter R(z) of the environment's forces: F = Theta R Psi E.

    There is no feedback, so F is stable if R and the environment are stable, and F is affine in R. R(z) is the sum of
    R_k b_k(z) with the functions b_k of `basis`, which are 1 at z = 1. The coefficients, taken as decimals, sum to
    R(1) = g I exactly, so that F(1) = g E(1) is symmetric if E(1) is symmetric. R_k has one column for the force of
    each channel, and optionally one more for the sum of all forces.

    Raises:
        ValueError: A pole is not stable, a shape does not match, an entry of R exceeds 1e9, or the coefficients do not
            sum to g I with g >= 0.
    """

    poles: Array  # (n,) in (-1, 1); poles at zero are delays
    pairs: Array  # (p, 2): b1, b2 of the pole pairs z^2 + b1 z + b2
    R: Array  # (1 + n + 2 p, m, m) or (1 + n + 2 p, m, m + 1), dimensionless

    kind, holds_model, one_period = "force-filter", True, True

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
        """Return R(1) in exact arithmetic."""
        return _own_columns(numbers(self.R, Fraction(1)).sum(axis=0))

    def filter(self, T: Number) -> Lti:
        """Return R(z) in the arithmetic of T."""
        return _realised(self.poles, self.pairs, self.R, T)

    def in_series(self, T: Number) -> Lti:
        return ForceFilter(self.poles, self.pairs, np.append(np.zeros(len(self.R) - 1), 1.0)[:, None, None]).filter(T)

    def figures(self, T: float) -> dict[str, Any]:
        return {"order": self.filter(T).order}

    def turned(self, Q: Array) -> ForceFilter:
        """Return Q R Q', rounded to decimals, with R_0 chosen so that R(1) = g I holds exactly."""
        later = np.round(Q @ _own_columns(self.R[1:]) @ Q.T, 10)
        first = self._static() - numbers(later, Fraction(1)).sum(axis=0)
        return ForceFilter(self.poles, self.pairs, np.concatenate([first.astype(float)[None], later]))

    def around(self, environment: Block, further: int = 0) -> Block:
        """Return R Psi E for `environment` = Psi E. Raises ValueError for walls, or another number of contacts."""
        m = self.R.shape[1]
        if isinstance(environment, Sampled):
            values = basis(self.poles, environment.z, self.pairs)
            return (
                Sampled(environment.z, np.tensordot(values, _own_columns(self.R), axes=1), environment.T) @ environment
            )
        if further:
            raise ValueError("a force filter needs a linear environment: for walls take a coupling with a V")
        if environment.inputs != m or environment.outputs != m:
            raise ValueError(f"the coupling is {m} x {m}, the environment has {environment.inputs} contacts")
        F = self.filter(environment.T) @ environment
        if F.is_exact:
            return F
        return F.with_response(lambda z: self.around(Sampled.of(environment, z[None])).G[0])

    def form(self) -> _ForceFilterForm:
        poles, pairs = tuple(self.poles.tolist()), tuple((b1, b2) for b1, b2 in self.pairs.tolist())
        return _ForceFilterForm(poles, pairs, tuple(_rows(R) for R in self.R))


NO_PAIRS = np.zeros((0, 2))


def basis(poles: Array, z: NDArray[np.complex128], pairs: Array) -> NDArray[np.complex128]:
    """Return the basis functions b_k(z) for n poles and p pairs, shape z.shape + (1 + n + 2 p,). All are 1 at z = 1.

    b_0 = 1. A real pole a adds (1 - a)/(z - a). A pair adds the two functions (1 + b1 + b2) z/d and (1 + b1 + b2)/d
    with d = z^2 + b1 z + b2. Each function is multiplied by the all-pass sections of the poles before it. For real
    poles this makes it a Takenaka-Malmquist function up to scale; the two functions of a pair span the same space as
    two such functions. Poles at zero give 1, 1/z, 1/z^2 and so on.
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
    """Return coefficients (.., m, m), with the optional column for the sum of all forces added to each column."""
    m = R.shape[-2]
    return R[..., :m] + R[..., m:].sum(axis=-1)[..., None] if R.shape[-1] > m else R


def _realised(poles: Array, pairs: Array, R: Array, T: Number) -> Lti:
    """Realise sum_k R_k b_k(z) in the arithmetic of T, with one chain of sections per input.

    Each pole or pair adds a section to a chain, up to the last function whose coefficient is not zero. The chain for
    the sum of all inputs needs few new states: its first states, as many as the shortest chain of an input has, are
    sums of states of these chains. Only its further states become new states of the block.
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
        first, second = signals[len(after)], signals[len(after) + 1]  # section outputs with the numerators z and 1
        read[len(after) + 1] = read[len(after) + 2] = 1 + b1 + b2
        after += [through - b1 * first - b2 * second, first]
        through = b2 * through + b1 * (1 - b2) * first + (1 - b2 * b2) * second
    sections = np.array(after, dtype=R.dtype).reshape(n, n + 1)

    reached = [_reached(R[1:, :, j], reals) for j in range(columns)]
    shared = min(reached[:rows])  # up to here, the states of the sum's chain are sums of the other chains' states
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
    """Return the number of states of a chain: up to its last nonzero coefficient, without splitting a pair."""
    used = np.flatnonzero((R != 0).any(axis=1))
    if not used.size:
        return 0
    length = int(used[-1]) + 1
    return length + (length - reals) % 2 if length > reals else length


class Strict(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An immutable record that refuses unknown fields."""


class _Form(Strict, frozen=True, tag_field="kind"):
    """The fields of a coupling in a file. Raises ValueError if no coupling can be built from them."""

    def __post_init__(self) -> None:
        self.build(1.0)

    @property
    def shape(self) -> tuple[Any, ...]:
        """The field that determines the number of channels, and its size; empty if any number is allowed."""
        return ()

    def build(self, T: float) -> Coupling:
        """Return the coupling for the period T [s]."""
        return NoCoupling()


class _NoForm(_Form, frozen=True, tag="none"):
    """A file with NoCoupling has no further fields."""


class _SpringDamperForm(_Form, frozen=True, tag="spring-damper"):
    K: tuple[float, ...]  # (m,) [N/m]
    B: tuple[float, ...]  # (m,) [N s/m]

    @property
    def shape(self) -> tuple[str, int]:
        return "K", len(self.K)

    def build(self, T: float) -> SpringDamper:
        return SpringDamper(self.K, self.B)


class _MatrixSpringDamperForm(_Form, frozen=True, tag="matrix-spring-damper"):
    K: _Rows  # (m, m) [N/m]
    B: _Rows  # (m, m) [N s/m]

    @property
    def shape(self) -> tuple[str, int, int]:
        return "K", len(self.K), len(self.K)

    def build(self, T: float) -> _MatrixSpringDamper:
        return _MatrixSpringDamper(*(_table(name, getattr(self, name), *(len(self.K),) * 2) for name in "KB"))


class _MovingAverageForm(_Form, frozen=True, tag="moving-average"):
    weight: tuple[float, ...]  # (m,) [m/N]
    terms: tuple[int, ...]  # (m,)
    constant: tuple[float, ...]  # (m,) [m/N]

    @property
    def shape(self) -> tuple[str, int]:
        return "weight", len(self.weight)

    def build(self, T: float) -> MovingAverage:
        return MovingAverage(np.array(self.weight), self.terms, np.array(self.constant))


class _ComplianceForm(_Form, frozen=True, tag="compliance"):
    A: _Rows
    B: _Rows
    C: _Rows
    D: _Rows

    @property
    def shape(self) -> tuple[str, int, int]:
        return "D", len(self.D), len(self.D[0])

    def build(self, T: float) -> Compliance:
        D = _table("D", self.D, len(self.D), len(self.D[0]) if self.D else 0)
        n = len(self.A)
        tables = (_table("A", self.A, n, n), _table("B", self.B, n, D.shape[1]), _table("C", self.C, len(D), n))
        return Compliance(Lti(*tables, D, T))


class _ForceFilterForm(_Form, frozen=True, tag="force-filter"):
    poles: tuple[float, ...]  # (n,)
    pairs: tuple[tuple[float, float], ...]  # (p, 2)
    R: tuple[_Rows, ...]  # (1 + n + 2 p, m, m or m + 1)

    def __post_init__(self) -> None:
        if any([len(row) for row in rows] != [len(self.R[0][0])] * len(self.R[0]) for rows in self.R):
            raise ValueError("R has coefficients that are not matrices of one size")
        super().__post_init__()

    @property
    def shape(self) -> tuple[str, int, int]:
        return "R", len(self.R[0]), len(self.R[0])

    def build(self, T: float) -> ForceFilter:
        return ForceFilter(np.array(self.poles), np.array(self.pairs), np.array(self.R))


Form = _NoForm | _SpringDamperForm | _MatrixSpringDamperForm | _MovingAverageForm | _ComplianceForm | _ForceFilterForm


def require_channels(form: Form, m: int) -> None:
    """Raise ValueError if the form does not have m channels."""
    name, *sizes = form.shape or ("",)
    if any(size != m for size in sizes):
        size = f"is {sizes[0]} x {sizes[1]}" if len(sizes) > 1 else f"has {sizes[0]} entries"
        raise ValueError(f"{name} {size}, the environment has {m} contacts")


def _require_sensible(name: str, rows: _Rows | Array) -> None:
    """Raise ValueError if a coefficient is so large that a sweep would overflow."""
    for value in (value for row in rows for value in row):
        if not abs(value) <= _LARGEST_COEFFICIENT:
            raise ValueError(f"{name} has an entry {value:g}, allowed are sizes up to {_LARGEST_COEFFICIENT:g}")


def _table(name: str, rows: _Rows, height: int, width: int) -> Array:
    if len(rows) != height or any(len(row) != width for row in rows):
        raise ValueError(f"{name} has rows of {[len(row) for row in rows]} entries, expected {height} x {width}")
    _require_sensible(name, rows)
    return np.array(rows, dtype=float).reshape(height, width)


def _rows(matrix: Array) -> _Rows:
    return tuple(map(tuple, matrix.tolist()))
