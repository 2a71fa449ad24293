"""Humans as passive ports at the handles: chains of masses, persons with several devices, and random humans.

Any object with the two methods of `Hand` can hold a device. Its `port()` describes the mechanics that the handle
feels: masses, spring-dampers, and optionally an impedance (A, B, C, D). The constructor of a `Port` checks passivity,
so every human in a simulation is passive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Protocol, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.lti import Lti
from haptic_loop.controller.passivity import hermitian_floor
from haptic_loop.models.device import AXES, require, symmetric

_Array = NDArray[np.floating[Any]]
_Range = tuple[float, float]
_Amount = float | tuple[float | tuple[float, ...], ...]

_ROUNDING = 1e-9  # negative Re Z that is attributed to rounding, relative to the mean of |Z|


@dataclass(frozen=True, eq=False)
class Impedance:
    """A passive impedance Z(s) = C (s I - A)^-1 B + D [N s/m], from the velocity of a handle to the force against it.

    All eigenvalues of A must have negative real parts. A spring (a pole at zero) and a mass belong to the Port. Arrays
    with leading axes hold many impedances of the same order.

    Raises:
        ValueError: A shape does not match, the impedance is not stable, or Re Z(jw) >= 0 fails or cannot be decided.
    """

    A: _Array  # (..., n, n)
    B: _Array  # (..., n, 1)
    C: _Array  # (..., 1, n)
    D: _Array  # (..., 1, 1)

    def __post_init__(self) -> None:
        for name in "ABCD":
            _freeze(self, name, getattr(self, name))
        *many, n, _ = self.A.shape if self.A.ndim > 1 else (0, 0)
        shapes = {"A": (n, n), "B": (n, 1), "C": (1, n), "D": (1, 1)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != (*many, *shape):
                raise ValueError(f"impedance: {name} has the shape {getattr(self, name).shape}, expected {shape}")
        for i in np.ndindex(*many):
            _check_positive_real(*(getattr(self, name)[i] for name in "ABCD"))

    def changed(self, change: Callable[[_Array], _Array]) -> Impedance:
        """Return a copy, without a new check. `change` indexes or repeats the leading axes of A, B, C and D."""
        changed = object.__new__(Impedance)
        for name in "ABCD":
            _freeze(changed, name, change(getattr(self, name)))
        return changed

    @property
    def order(self) -> int:
        return int(self.A.shape[-1])


def _check_positive_real(A: _Array, B: _Array, C: _Array, D: _Array) -> None:
    """Raise ValueError unless Z is stable and Re Z(jw) >= -_ROUNDING times the mean of |Z| at every frequency."""
    n = A.shape[0]
    if n and not np.linalg.eigvals(A).real.max() < 0:
        raise ValueError("impedance: A has an eigenvalue on or right of the imaginary axis, expected a stable A")
    import scipy.linalg  # slow to load

    scale = np.diag(scipy.linalg.matrix_balance(A, permute=False)[1]) if n else np.ones(0)  # powers of two
    A, B, C, one = A * scale / scale[:, None], B / scale[:, None], C * scale, np.eye(n)
    # With s = speed (z - 1)/(z + 1) the frequencies w = speed tan(t/2) become the unit circle, z = e^jt.
    speed = float(np.exp(np.log(np.abs(np.linalg.eigvals(A))).mean())) if n else 1.0
    into = np.linalg.inv(speed * one - A)
    G = Lti((speed * one + A) @ into, into @ B, C @ (into @ (2 * speed * one)), D + C @ into @ B, 1.0)
    size = float(np.abs(G.at(np.exp(1j * np.pi * (np.arange(64) + 0.5) / 64))).mean())
    rounding = 1 + float(np.linalg.norm(into) * np.linalg.norm(speed * one + A))  # grows with cond(speed I - A)
    floor, least, t = hermitian_floor(G, -_ROUNDING * size, -_ROUNDING * size, rounding)
    hertz = f"{speed * math.tan(t / 2) / (2 * np.pi):.6g} Hz"
    if not least >= -_ROUNDING * size:
        raise ValueError(f"impedance: not passive, Re Z is {least:g} N s/m at {hertz}")
    if not floor >= -_ROUNDING * size:
        raise ValueError(f"impedance: passivity cannot be decided, the margin is too small near {hertz}; add damping")


@dataclass(frozen=True, eq=False)
class Port:
    """The passive mechanics of a human at the handles: masses, spring-dampers, and optionally an impedance.

    The points are the handles (several if a person holds several devices), followed by the human's own masses. The
    base is ground, or a person's body if the port is an arm of this person. Row i of `across` holds the derivatives of
    the length of spring-damper i with respect to the positions of the points and the base: -1 and 1 between two points,
    other numbers for a lever. With several axes every point and the base have `axes` neighbouring columns of `across`.
    Arrays with a leading axis hold many humans of the same structure.

    Raises:
        ValueError: A shape does not match, a parameter is negative, a point other than a handle has no mass, `pull` is
            not the index of a spring-damper, or a port with several handles has an impedance.
    """

    mass: _Array  # (..., points) [kg]; 0 is allowed at the handles only
    across: _Array  # (springs, (points + 1) axes)
    damping: _Array  # (..., springs) [N s/m]
    stiffness: _Array  # (..., springs) [N/m]
    impedance: Impedance | None = None  # between the (only) handle and the base, on every axis
    handles: int = 1
    pull: int = -1  # index of the spring-damper (group of `axes` spring-dampers) that the voluntary force contracts
    axes: int = 1

    def __post_init__(self) -> None:
        for name in ("mass", "across", "damping", "stiffness"):
            _freeze(self, name, getattr(self, name))
        *many, points = self.mass.shape
        shapes = {"across": (len(self.across), (points + 1) * self.axes)}
        shapes |= {name: (*many, len(self.across)) for name in ("damping", "stiffness")}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"port: {name} has the shape {getattr(self, name).shape}, expected {shape}")
        for name in ("mass", "damping", "stiffness"):
            if not (getattr(self, name) >= 0).all() or not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"port: {name} has a negative or infinite entry, expected finite numbers >= 0")
        if not 1 <= self.handles <= points or not (self.mass[..., self.handles :] > 0).all():
            raise ValueError("port: expected one or more handles, and a positive mass at every other point")
        groups = len(self.across) // self.axes
        if not self.across[:, : -self.axes].any(axis=1).all() or not -groups <= self.pull < groups:
            raise ValueError("port: expected at least one point per spring-damper, and a spring-damper index as `pull`")
        if self.impedance and (self.handles > 1 or self.impedance.A.shape[:-2] != tuple(many)):
            raise ValueError("port: an impedance is for ports with one handle, and has the leading axes of `mass`")

    @classmethod
    def chain(cls, links: _Array, axes: int = 1) -> Self:
        """Return a chain from the handle to the base.

        A link of `links` (..., n, 1 + 2 axes^2) has a mass, then all dampings, then all stiffnesses along `directions`.
        The springs along the axes come last in a link, so that the voluntary force contracts those of the last link.
        """
        n, count = links.shape[-2], axes**2
        between = np.eye(n, n + 1, 1) - np.eye(n, n + 1)
        damping, stiffness = (links[..., 1 + k * count : 1 + (k + 1) * count] for k in range(2))
        flat = (*links.shape[:-2], n * count)
        across = np.kron(between, directions(axes)) if axes > 1 else between  # kron takes as long as the rest
        return cls(links[..., 0], across, damping.reshape(flat), stiffness.reshape(flat), axes=axes)

    def in_space(self, axes: int) -> Self:
        """Return the port on `axes` axes. A port with one axis acts in the same way on every axis.

        Raises ValueError if the port has several axes, but not `axes`.
        """
        if self.axes == axes:
            return self
        if self.axes > 1:
            raise ValueError(f"the human moves along {self.axes} axes, the device along {axes}")
        groups = len(self.across)
        pull = self.pull % groups
        return type(self)(
            self.mass,
            np.kron(self.across, np.eye(axes)),
            np.repeat(self.damping, axes, axis=-1),
            np.repeat(self.stiffness, axes, axis=-1),
            self.impedance,
            self.handles,
            pull,
            axes,
        )

    @classmethod
    def body(cls, hands: int, values: _Array) -> Self:
        """Return a body on ground, with a spring-damper from each hand to the next.

        `values` (..., 5) are mass, damping and stiffness of the body, then damping and stiffness between the hands.
        """
        mass, damping, stiffness, cross_damping, cross_stiffness = np.moveaxis(values, -1, 0)[..., None]
        across = np.eye(hands, hands + 2, 1) - np.eye(hands, hands + 2)
        across[-1] = 0.0
        across[-1, hands:] = -1.0, 1.0
        nothing = np.repeat(np.zeros_like(mass), hands, axis=-1)
        crossings = hands - 1
        return cls(
            np.concatenate([nothing, mass], axis=-1),
            across,
            np.concatenate([np.repeat(cross_damping, crossings, axis=-1), damping], axis=-1),
            np.concatenate([np.repeat(cross_stiffness, crossings, axis=-1), stiffness], axis=-1),
            handles=hands,
        )

    @classmethod
    def stack(cls, ports: Sequence[Self]) -> Self:
        """Stack humans of one structure along a new leading axis. Raises ValueError if their structures differ."""
        first = ports[0]
        if any(port.layout != first.layout for port in ports):
            raise ValueError("ports: expected humans with the same points and the same spring-dampers between them")
        mass, damping, stiffness = (np.stack([getattr(p, n) for p in ports]) for n in ("mass", "damping", "stiffness"))
        own = [port.impedance for port in ports if port.impedance]
        impedance = Impedance(*(np.stack([getattr(z, name) for z in own]) for name in "ABCD")) if own else None
        return cls(mass, first.across, damping, stiffness, impedance, first.handles, first.pull, first.axes)

    def of(self, i: int) -> Self:
        """Return port i of a stack."""
        impedance = self.impedance and self.impedance.changed(lambda part: part[i])
        one = self.mass[i], self.across, self.damping[i], self.stiffness[i]
        return type(self)(*one, impedance, self.handles, self.pull, self.axes)

    @property
    def layout(self) -> tuple[Any, ...]:
        """The structure of the port without its parameters. Humans of equal layout can be stacked."""
        order = self.impedance.order if self.impedance else None
        return self.across.shape, self.across.tobytes(), order, self.handles, self.pull, self.axes


def directions(axes: int) -> _Array:
    """Return directions (axes^2, axes) of springs: e_i + e_j and e_i - e_j for every two axes, then the axes.

    Springs along these directions can add up to any symmetric diagonally dominant stiffness matrix, and to no other.
    """
    unit = np.eye(axes)
    skew = [unit[i] + sign * unit[j] for i in range(axes) for j in range(i + 1, axes) for sign in (1, -1)]
    return np.array([*skew, *unit])


def _amounts_along(field: str, value: Any, axes: int) -> _Array:
    """Return amounts (axes^2,) of springs along `directions` whose sum is the given number, list or matrix.

    Raises ValueError if the matrix is not diagonally dominant.
    """
    matrix = symmetric(field, value, axes)
    pairs = [matrix[i, j] for i in range(axes) for j in range(i + 1, axes)]
    skew = [max(0.0, sign * each) for each in pairs for sign in (1, -1)]
    own = 2 * np.diag(matrix) - np.abs(matrix).sum(axis=1)
    if not (own >= -1e-12 * np.abs(matrix).max()).all():  # allows rounding in a matrix that was computed from amounts
        expected = "diagonal entries of at least the sum of the other magnitudes in their row"
        raise ValueError(f"{field} is {matrix.tolist()}, expected {expected}")
    return np.array([*skew, *np.maximum(own, 0.0)])


def state_space(A: Any, B: Any, C: Any, D: Any, mass: float = 0.0) -> Port:
    """Return the port of a hand of `mass` [kg] and impedance C (s I - A)^-1 B + D, from velocity [m/s] to force [N].

    A may have one eigenvalue at zero. This eigenvalue adds k/s to the impedance and becomes a spring of stiffness k.

    Raises:
        ValueError: The hand is not passive, or A has a double eigenvalue at zero.
    """
    A, B, C, D = (np.atleast_2d(np.asarray(part, dtype=float)) for part in (A, B, C, D))
    stiffness = 0.0
    U, sizes, Vh = np.linalg.svd(A)  # if A is singular, Vh[-1] spans its null space, and U[:, -1] that of A'
    if A.size and sizes[-1] <= 1e-12 * max(sizes[0], 1e-300):
        null, left = Vh[-1], U[:, -1]
        if abs(left @ null) <= 1e-9:
            raise ValueError("impedance: A has a double eigenvalue at zero, expected one spring at most")
        left = left / (left @ null)
        stiffness = float((C @ null).item() * (left @ B).item())
        # A maps the space orthogonal to `left` into itself, and has no eigenvalue at zero there.
        rest = np.linalg.svd(left[None])[2][1:].T
        B = B - np.outer(null, left @ B)
        A, B, C = rest.T @ A @ rest, rest.T @ B, C @ rest
    spring = np.array([[-1.0, 1.0]])
    return Port(np.array([mass]), spring, np.zeros(1), np.array([stiffness]), Impedance(A, B, C, D))


class Hand(Protocol):
    """A human who can hold a device: a passive port and a voluntary force."""

    def port(self) -> Port:
        """Return the mechanics that the handle feels."""
        ...

    def voluntary_force(self, t: _Array) -> _Array:
        """Return the force [N] at the times t [s] that contracts the spring-damper `pull` of the port.

        The force has the shape (N,) of t, or (N, axes) on a device with several axes. There a force of shape (N,) acts
        on the first free axis only.
        """
        ...


def _freeze(record: object, name: str, values: Any) -> None:
    """Set a field of a frozen record to a read-only array of floats."""
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    object.__setattr__(record, name, array)


class Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A mass and the spring-damper from it to the next mass, or to the moving equilibrium.

    On a device with several axes damping and stiffness are one number for all directions, one number per free axis, or
    symmetric matrices.
    """

    mass: float  # [kg]
    damping: _Amount  # [N s/m]
    stiffness: _Amount  # [N/m]

    def __post_init__(self) -> None:
        require("mass", self.mass, 0.0, 1e3, "kg")
        for name, most, unit in (("damping", 1e6, "N s/m"), ("stiffness", 1e9, "N/m")):
            value = getattr(self, name)
            if not isinstance(value, tuple):
                require(name, value, 0.0, most, unit)
                continue
            if not 1 < len(value) <= len(AXES):
                raise ValueError(
                    f"{name} has {len(value)} entries, expected one number, or one for each of 2 or 3 axes"
                )
            for amount in _amounts_along(name, value, len(value)):
                require(name, float(amount), 0.0, most, unit)

    @property
    def axes(self) -> int:
        """The device's number of axes for which the link is made; 1 if it is the same in every direction."""
        return max(len(value) if isinstance(value, tuple) else 1 for value in (self.damping, self.stiffness))


class Voluntary(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """The motion `amplitude` sin(2 pi `frequency` t + `phase`) of the equilibrium, which a raised cosine fades in."""

    amplitude: float  # [m]
    frequency: float  # [Hz]
    phase: float = 0.0  # [rad]
    ease: float = 1.0  # [s] duration of the fade
    along: tuple[float, ...] | msgspec.UnsetType = msgspec.UNSET  # the direction; by default the first axis

    def __post_init__(self) -> None:
        along = (1.0,) if self.along is msgspec.UNSET else self.along
        if not (any(abs(c) > 1e-9 for c in along) and all(abs(c) < 1e9 for c in along)):
            raise ValueError(f"along is {list(along)}, expected sizes below 1e9, at least one above 1e-9")
        require("amplitude", self.amplitude, 0.0, 100.0, "m")  # knobs turn often; a linear Scenario allows up to 1 m
        require("frequency", self.frequency, 0.0, 100.0, "Hz")
        require("phase", self.phase, -100.0, 100.0, "rad")
        require("ease", self.ease, 0.0, 1e4, "s")

    def force(self, t: _Array, stiffness: float, damping: float) -> _Array:
        """Return `stiffness` x + `damping` x' [N] at the times t [s], for the motion x of the equilibrium."""
        w, rate = 2 * np.pi * self.frequency, np.pi / self.ease if self.ease else 0.0
        pull, ahead = self.amplitude * math.hypot(stiffness, damping * w), math.atan2(damping * w, stiffness)
        force = pull * np.sin(w * t + (self.phase + ahead))
        if (rising := np.flatnonzero(t < self.ease)).size:
            early = t[rising]
            force[rising] *= (1 - np.cos(rate * early)) / 2
            force[rising] += damping * rate / 2 * np.sin(rate * early) * self.amplitude * np.sin(w * early + self.phase)
        return force


_MOST_LINKS = 500  # of one hand: the eigenvalues of 500 links take 5 s, and those of 1000 links take 30 s


class Human(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A chain of masses and spring-dampers, from the handle to the equilibrium."""

    links: Annotated[tuple[Link, ...], msgspec.Meta(min_length=1)]
    voluntary: Voluntary | None = None

    def __post_init__(self) -> None:
        if len(self.links) > _MOST_LINKS:
            raise ValueError(f"links has {len(self.links)} entries, allowed are 1 to {_MOST_LINKS}")
        for i, link in enumerate(self.links[1:], start=2):
            if link.mass == 0:
                raise ValueError(f"links #{i}.mass is 0: only the mass at the handle may be missing")
        if len(several := {link.axes for link in self.links} - {1}) > 1:
            raise ValueError(f"links have {' and '.join(map(str, sorted(several)))} axes, expected the same number")
        along = self.voluntary and self.voluntary.along
        if several and along and {len(along)} != several:
            raise ValueError(f"voluntary.along is {list(along)}, expected {max(several)} numbers as the links have")

    def vectors(self) -> list[tuple[str, tuple[Any, ...]]]:
        """Return the names and values of all fields that have an entry for each free axis of the device."""
        named = [
            (f"links #{i}.{name}", getattr(link, name))
            for i, link in enumerate(self.links, start=1)
            for name in ("damping", "stiffness")
        ]
        named.append(("voluntary.along", self.voluntary and self.voluntary.along))
        return [(field, value) for field, value in named if isinstance(value, tuple)]

    def port(self) -> Port:
        axes = max(link.axes for link in self.links)
        if axes == 1:
            return Port.chain(np.array([(link.mass, link.damping, link.stiffness) for link in self.links]))
        rows = [
            [
                link.mass,
                *_amounts_along("damping", link.damping, axes),
                *_amounts_along("stiffness", link.stiffness, axes),
            ]
            for link in self.links
        ]
        return Port.chain(np.array(rows), axes)

    def voluntary_force(self, t: _Array) -> _Array:
        """Return the force [N] of the equilibrium's motion on the last mass, (N,) or (N, axes), at times t (N,) [s]."""
        if self.voluntary is None:
            return np.zeros_like(t)
        last, along = self.links[-1], self.voluntary.along
        if not along and last.axes == 1:
            return self.voluntary.force(t, last.stiffness, last.damping)  # type: ignore[arg-type]
        axes = len(along) if along else last.axes
        way = np.array(along if along else np.eye(axes)[0], dtype=float)
        way /= np.linalg.norm(way)
        # The force of a spring-damper whose end moves along `way` is K way x + B way x'.
        K, B = (symmetric(name, getattr(last, name), axes) @ way for name in ("stiffness", "damping"))
        return np.stack([self.voluntary.force(t, k, b) for k, b in zip(K, B, strict=True)], axis=1)


class MeasuredHand(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A hand that is given as a transfer function from velocity [m/s] to force [N]: `mass` s + C (s I - A)^-1 B + D."""

    A: tuple[tuple[float, ...], ...]
    B: tuple[tuple[float, ...], ...]
    C: tuple[tuple[float, ...], ...]
    D: tuple[tuple[float, ...], ...]
    mass: float = 0.0  # [kg]

    def __post_init__(self) -> None:
        require("mass", self.mass, 0.0, 1e3, "kg")
        self.port()

    def port(self) -> Port:
        """Return the mechanics that the handle feels. Raises ValueError if the hand is not passive."""
        return state_space(self.A, self.B, self.C, self.D, self.mass)

    def voluntary_force(self, t: _Array) -> _Array:
        return np.zeros_like(t)


class Cross(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spring-damper between two hands of one person."""

    damping: float = 0.0  # [N s/m]
    stiffness: float = 0.0  # [N/m]

    def __post_init__(self) -> None:
        require("damping", self.damping, 0.0, 1e6, "N s/m")
        require("stiffness", self.stiffness, 0.0, 1e9, "N/m")


class Person(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A person who holds several devices: a passive mechanical multi-port.

    The arms that hold these devices end on the person's body instead of on ground. The body is a mass with a
    spring-damper to ground. The spring-damper `cross` joins each hand to the next, in the order of `holds`.
    """

    holds: tuple[int, ...]  # devices, counted from 1
    mass: float  # [kg] of the body
    damping: float  # [N s/m] between body and ground
    stiffness: float  # [N/m]
    cross: Cross = Cross()

    def __post_init__(self) -> None:
        if len(self.holds) < 2 or len(set(self.holds)) < len(self.holds) or min(self.holds) < 1:
            raise ValueError(f"holds is {list(self.holds)}, expected two or more different devices, counted from 1")
        require("mass", self.mass, 1e-6, 1e3, "kg")
        require("damping", self.damping, 0.0, 1e6, "N s/m")
        require("stiffness", self.stiffness, 0.0, 1e9, "N/m")

    def port(self) -> Port:
        """Return the body and the cross springs as the hands feel them. The arms end on the body, the last point."""
        cross = self.cross
        values = (self.mass, self.damping, self.stiffness, cross.damping, cross.stiffness)
        return Port.body(len(self.holds), np.array(values))


def check_holds(held_by: Sequence[tuple[int, ...]], channels: int) -> None:
    """Raise ValueError if a person holds a device that does not exist or that another person holds."""
    held: set[int] = set()
    for i, holds in enumerate(held_by, start=1):
        for channel in holds:
            if channel > channels:
                raise ValueError(f"person #{i}.holds has device {channel}, allowed are 1 to {channels}")
            if channel in held:
                raise ValueError(f"person #{i}.holds has device {channel}, which another person holds already")
        held.update(holds)


class Population(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Random humans: chains of `links` links with log-uniform parameters."""

    mass: _Range = (0.01, 3.0)  # [kg]
    damping: _Range = (0.1, 30.0)  # [N s/m]
    stiffness: _Range = (1.0, 2000.0)  # [N/m]
    links: int = 1

    def __post_init__(self) -> None:
        for name, unit in (("mass", "kg"), ("damping", "N s/m"), ("stiffness", "N/m")):
            low, high = getattr(self, name)
            require(f"{name} #1", low, 1e-9, 1e9, unit)
            require(f"{name} #2", high, low, 1e9, unit)
        require("links", self.links, 1, 8, "links")

    def draw(self, rng: np.random.Generator, n: int) -> list[Human]:
        """Draw n humans without voluntary motion."""
        ranges = np.log([self.mass, self.damping, self.stiffness])
        values = np.exp(rng.uniform(ranges[:, 0], ranges[:, 1], size=(n, self.links, 3)))
        return [Human(tuple(Link(*link) for link in human)) for human in values.tolist()]
