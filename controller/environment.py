"""Virtual environments: networks of springs, dampers, masses and walls, rigid walls, blocks E(z), and MuJoCo scenes.

A network is discretised by backward Euler. Its nodes are contacts (whose displacements the devices impose), internal
nodes (free) and the ground. The dynamic stiffness of the network is Z(s) = M s^2 + D s + K, at s = (z-1)/(Tz). With the
blocks of contacts (c) and internal nodes (i), the map from contact displacements to forces is
E = Z_cc - Z_ci Z_ii^-1 Z_ic. The devices feel these forces with a minus sign.
"""

from __future__ import annotations

import enum
import functools
import itertools
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import Number, SingularLoop, eye, inverse, numbers, rational, solve, times
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.delay import delay
from haptic_loop.controller.lti import Array, Complex, Lti, Sampled, as_like
from haptic_loop.controller.passivity import hermitian_floor

GROUND = "ground"
_NO_MODEL = "a MuJoCo world has no linear model E(z): take moving-average, or the network of linearise(world, pose)"


#: Largest amounts: far above those of any rendered object, and far below the largest float.
MOST_AMOUNT = {"N/m": 1e12, "N s/m": 1e9, "kg": 1e6}
#: Smallest amount other than 0: a person cannot feel it, and its square is far above the smallest float.
_LEAST_AMOUNT = 1e-12
_MOST_WALLS = 6
_MOST_TICKS = 100  # largest number of ticks between two steps of a world
_MOST_NODES, _MOST_PARTS = 200, 2000  # nodes and springs; a mass has two states; proofs handle a few hundred states


def _check_amount(what: str, value: float, unit: str) -> None:
    if value != 0 and not _LEAST_AMOUNT <= value <= MOST_AMOUNT[unit]:
        raise ValueError(
            f"{what} is {value}, allowed in a passive network are 0 and 1e-12 to {MOST_AMOUNT[unit]:g} {unit}"
        )


_SAME_LENGTH = 1e-15  # tolerance of a length of 1, so that normalising twice changes nothing


def _unit(field: str, direction: tuple[float, ...]) -> tuple[float, ...]:
    """Scale a direction to length 1. Raises ValueError unless its largest entry is between 1e-9 and 1e9 in size."""
    if not (any(abs(c) > 1e-9 for c in direction) and all(abs(c) < 1e9 for c in direction)):
        raise ValueError(f"{field} is {list(direction)}, expected components below 1e9 in size, one of them above 1e-9")
    length = float(np.linalg.norm(direction))
    return direction if abs(length - 1) <= _SAME_LENGTH else tuple(c / length for c in direction)


class Spring(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A spring beside a damper. Both connect two nodes.

    If the nodes are points with several coordinates, spring and damper act on every coordinate, or in the direction
    `along` only.
    """

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m]
    inertance: float | msgspec.UnsetType = msgspec.UNSET  # [kg] of an inerter in parallel
    along: tuple[float, ...] | msgspec.UnsetType = msgspec.UNSET  # the direction, which is normalised to length 1

    def __post_init__(self) -> None:
        if self.along is not msgspec.UNSET:
            unit = _unit(f"along between {' and '.join(self.between)}", self.along)
            msgspec.structs.force_setattr(self, "along", unit)
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m"), ("inertance", "kg")):
            _check_amount(f"{name} between {' and '.join(self.between)}", getattr(self, name) or 0.0, unit)
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")

    def amounts(self, number: Callable[[float], Any]) -> tuple[Any, Any, Any]:
        """Return inertance [kg], damping [N s/m] and stiffness [N/m] between the ends."""
        return number(self.inertance or 0.0), number(self.damping), number(self.stiffness)


class Wall(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A one-sided spring-damper that pushes only while its first node is more than `gap` beyond the second.

    Between points with several coordinates the distance counts along `normal`, the direction into the wall.
    """

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m], acts only in contact; the wall never pulls
    gap: float = 0.0  # [m] distance from rest to contact; negative if the wall is compressed at rest
    normal: tuple[float, ...] | msgspec.UnsetType = msgspec.UNSET  # normalised to length 1

    def __post_init__(self) -> None:
        ends = " and ".join(self.between)
        if self.normal is not msgspec.UNSET:
            msgspec.structs.force_setattr(self, "normal", _unit(f"normal of the wall between {ends}", self.normal))
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_amount(f"{name} of the wall between {ends}", getattr(self, name), unit)
        if self.stiffness == 0:
            raise ValueError(f"stiffness of the wall between {ends} is 0, expected above 0; or leave out the wall")
        if not abs(self.gap) < np.inf:
            raise ValueError(f"gap of the wall between {ends} is {self.gap}, expected a finite length in m")
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")

    def slope(self, T: Number) -> Number:
        """Return K + 2 B/T [N/m], the wall's stiffness at z = -1, where it is largest, in the arithmetic of T."""
        return numbers(self.stiffness, T) + 2 * numbers(self.damping, T) / T


def _parts_of(element: Any) -> list[Spring | Wall]:
    """Return the springs and walls of a user's own element. Raises ValueError for an object without such parts."""
    listed = element.parts() if callable(getattr(element, "parts", None)) else None
    parts = list(listed) if isinstance(listed, list | tuple) else []
    if not parts or not all(type(part) in (Spring, Wall) for part in parts):
        what = f"parts() is {listed!r}" if listed is not None else f"it is {element!r}"
        raise ValueError(
            f"element {type(element).__name__}: {what}, expected a class whose parts() is a list of Spring and Wall"
        )
    return parts


class Block(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """E(z) = C (z I - A)^-1 B + D from contact displacements [m] to forces [N], as numbers for one period T.

    A block must be stable, and passive at every frequency, not only on a grid: He [(1 - z) E(z)] >= 0, with E(1)
    symmetric and positive semidefinite. Here He M = (M + M*)/2. If passivity holds within rounding only, `at` makes
    E(1) symmetric and adds a spring of at most 1e-6 of the block's mean gain to D. Raises ValueError for other blocks,
    or if passivity cannot be decided.
    """

    A: tuple[tuple[float, ...], ...]
    B: tuple[tuple[float, ...], ...]
    C: tuple[tuple[float, ...], ...]
    D: tuple[tuple[float, ...], ...]
    T: float  # [s]

    @classmethod
    def of(cls, E: Lti) -> Block:
        """Return the block of an E(z) over floats."""
        A, B, C, D = (tuple(map(tuple, part.tolist())) for part in (E.A, E.B, E.C, E.D))
        return cls(A, B, C, D, E.T)

    def __post_init__(self) -> None:
        n, m = len(self.A), len(self.D)
        for name, (rows, columns) in {"A": (n, n), "B": (n, m), "C": (m, n), "D": (m, m)}.items():
            part = getattr(self, name)
            if not m or (columns and len(part) != rows) or any(len(row) != columns for row in part):
                raise ValueError(f"block: {name} is {list(map(list, part))}, expected {rows} rows of {columns} numbers")
        poles = np.linalg.eigvals(np.array(self.A)) if n else np.zeros(0)
        if not np.abs(poles).max(initial=0.0) < 1:
            raise ValueError("block: not stable, A has an eigenvalue on or outside the unit circle")
        _correction(self)

    def at(self, T: Number) -> Lti:
        """Return the provably passive E(z) in the arithmetic of T. Raises ValueError for another period."""
        if float(T) != self.T:
            raise ValueError(f"block: its numbers are for T = {self.T:g} s, the loop has {float(T):g} s")
        A, B, C, D = (numbers(part, T) for part in self._arrays())
        return Lti(A, B, C, D + numbers(_correction(self), T), T)

    def _arrays(self) -> tuple[Array, Array, Array, Array]:
        n, m = len(self.A), len(self.D)
        shapes = {"A": (n, n), "B": (n, m), "C": (m, n), "D": (m, m)}
        A, B, C, D = (np.array(getattr(self, name), dtype=float).reshape(shape) for name, shape in shapes.items())
        return A, B, C, D


_ROUNDING = 1e-9  # allowed asymmetry and negative eigenvalues of E(1), relative to the mean gain
#: Stiffnesses of a correcting spring, relative to the mean gain. `_correction` stops its search once a spring of the
#: first stiffness is enough, and refuses blocks that need more than the second.
_ENOUGH, _MOST_LIFT = 1e-8, 1e-6


@functools.lru_cache(maxsize=64)
def _correction(block: Block) -> Any:
    """Return the correction of D (m, m), Fractions, that makes the block provably passive.

    Raises ValueError for a block that is not passive, or whose passivity cannot be decided.

    The block absorbs the power f'(x - x_-)/T, where x_- is the displacement x of the previous tick. So E is passive if
    E(1) is symmetric and positive semidefinite and He [(1 - z) E] = |1 - z|^2 He [E z/(z-1)] >= 0. Without the pole at
    z = 1 the condition is He H >= 0 on the whole circle for
    H = E(1)/2 - C (I-A)^-1 B - C (I-A)^-1 A (zI-A)^-1 B. A spring of l N/m beside the block adds l/2 to H.
    Objects at the edge of passivity, such as a free mass, get a spring that covers the error bound of this check.
    """
    T = rational(block.T)
    A, B, C, D = (numbers(part, T) for part in block._arrays())
    E = Lti(A, B, C, D, T)
    m = E.inputs
    settled = solve((eye(E.order, T) - E.A).T, E.C.T).T if E.order else E.C  # C (I - A)^-1
    gain = times(settled, E.B)
    static = E.D + gain
    even = (static + static.T) / 2
    H = Lti(E.A, E.B, -times(settled, E.A), even / 2 - gain, T).floats()

    plain = E.floats()
    responses = np.linalg.norm(plain.at(np.exp(1j * np.linspace(0.01, np.pi, 64))), axis=(1, 2))
    scale = float(np.mean(responses))
    values, skew = even.astype(float), (static - even).astype(float)
    negative = np.linalg.eigvalsh(values)[0]
    rounding = max(_ROUNDING * scale, 1e-14 * float(np.abs(plain.D).max()))
    if np.abs(skew).max() > rounding or negative < -rounding:
        shown = [[float(f"{value:.6g}") for value in row] for row in static.astype(float)]
        raise ValueError(f"block: not passive, its static stiffness E(1) is {shown}, expected symmetric and >= 0")

    most = _MOST_LIFT * scale
    floor, least, w = hermitian_floor(H, -_ENOUGH * scale / 2, -most / 2)
    if not 2 * floor >= -most:
        hertz = f"{w / (2 * np.pi * block.T):.6g} Hz"
        if 2 * least < -most:
            raise ValueError(f"block: not passive, it generates energy at {hertz}")
        raise ValueError(f"block: its passivity cannot be decided, the margin is too small near {hertz}; add damping")
    lift = max(-2 * floor, 1e-14 * np.abs(values).max() - negative, 0.0)
    return even - static + rational(float(lift)) * np.eye(m, dtype=int)


class Environment:
    """Base class of environments. A user's own class defines `contacts` and `E(T)`."""

    __slots__ = ()
    contacts: Any  # tuple[str, ...], one per channel
    walls: tuple[Wall, ...] = ()
    here: Any = "this environment"  # str: the environment's name in guarantees
    world: Any = None  # a MuJoCo scene, of which only the file is known
    one_period = False  # whether E(z) is known for one T only

    def check(self, psi: Sequence[int], T: float) -> None:
        """Raise ValueError if the environment cannot be part of a loop with these delays and this period."""
        self.E(T)

    def active(self, T: float) -> str | None:
        """Return the reason why E(z) may generate energy at some frequency, or None if E is passive."""
        name = type(self).__name__
        try:
            lift = _correction(Block.of(self.E(T)))
        except ValueError as error:
            return f"environment {name}: {str(error).removeprefix('block: ')}"
        if lift.any():
            return f"environment {name}: passive within rounding only; Network(contacts, block=Block.of(E)) corrects it"
        return None

    def as_network(self) -> Network:
        """Return the environment if it is a network. Raises ValueError otherwise."""
        raise ValueError(f"{self.here} is no network of springs, dampers and masses")

    def E(self, T: Number) -> Lti:
        """Return E(z) from contact displacements [m] to forces [N], with every wall touching, in T's arithmetic.

        Raises TypeError if a class does not define this method.
        """
        raise TypeError(f"{type(self).__name__} has no E(T): define this method")

    def sent(self, coupling: Coupling, psi: Sequence[int], T: Number) -> Lti:
        """Return G from displacements to the forces before Theta, (I + Psi E V)^-1 Psi E. Raises SingularLoop."""
        return coupling.around(delay(psi, T) @ self.E(T))

    def sent_at(self, coupling: Coupling, psi: Sequence[int], z: Complex, T: float) -> Sampled:
        """Return the G of `sent` at points z of the circle."""
        return coupling.around(Sampled.of(delay(psi, T) @ self.E(T), z))

    def frozen(self) -> Sequence[Environment]:
        """Return the linear environments for every set of touching walls."""
        return (self,)


class RigidWall(Environment, enum.Enum):
    """A rigid wall (E -> infinity) that the coupling in front of it always touches. It has one channel."""

    RIGID_WALL = "rigid wall"  # its name in files

    @property
    def contacts(self) -> tuple[str, ...]:
        return ("tip",)

    @property
    def here(self) -> str:
        return "a rigid wall only"

    def check(self, psi: Sequence[int], T: float) -> None:
        if any(psi):
            shown = ", ".join(map(str, psi))
            raise ValueError(
                f"psi is {shown}, expected 0: at a rigid wall no loop with a delayed environment is stable"
            )

    def active(self, T: float) -> None:
        return None

    def E(self, T: Number) -> Lti:
        raise ValueError("a rigid wall has no E(z): its force is that of the coupling in front of it")

    def sent(self, coupling: Coupling, psi: Sequence[int], T: Number) -> Lti:
        """Return V^-1. Raises ValueError for a coupling without a V, SingularLoop if V has no inverse."""
        V = coupling.compliance(T)
        if V is None:
            raise ValueError("a rigid wall needs a spring-damper or another V in front of it")
        return V.inverse()

    def sent_at(self, coupling: Coupling, psi: Sequence[int], z: Complex, T: float) -> Sampled:
        return Sampled.of(self.sent(coupling, psi, T), z)


RIGID_WALL = RigidWall.RIGID_WALL


class _NoModel(SingularLoop):
    """The environment has no known E(z), so that the condition this-environment does not apply."""

    def __init__(self) -> None:
        super().__init__(_NO_MODEL)


class SceneFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, repr_omit_defaults=True):
    """A MuJoCo scene instead of a network. The conditions this-environment and known-device do not apply to it."""

    file: str  # MJCF
    digest: str  # SHA-256 over the names and contents of the scene's files
    along: tuple[tuple[tuple[float, float, float], ...], ...]  # (bodies, axes, 3) directions of the contacts
    every: int = 1  # number of ticks for one step of the scene

    def __post_init__(self) -> None:
        if not 1 <= self.every <= _MOST_TICKS:
            raise ValueError(f"every is {self.every}, allowed are 1 to {_MOST_TICKS} ticks")


class Network(
    msgspec.Struct, Environment, frozen=True, forbid_unknown_fields=True, omit_defaults=True, repr_omit_defaults=True
):
    """A passive mechanical network, or a MuJoCo `world`. Devices touch its contacts, in the order of the channels."""

    contacts: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    springs: tuple[Spring, ...] = ()
    masses: dict[str, float] = {}  # [kg], by node or point; other nodes have no mass
    walls: Annotated[tuple[Wall, ...], msgspec.Meta(max_length=_MOST_WALLS)] = ()  # n walls have 2^n contact states
    block: Block | None = None  # an E(z) that is added to the network
    elements: tuple[Any, ...] = ()  # objects of a user's own classes; their parts become springs and walls
    world: SceneFile | None = None  # a MuJoCo scene in place of springs, masses, walls and block
    points: dict[str, tuple[str, ...]] = {}  # the nodes of each point's coordinates; ground for a fixed coordinate
    linear_model_of: str = ""  # the scene and the pose of which `block` is the linear model
    scene_digest: str = ""  # SceneFile.digest of that scene

    def __post_init__(self) -> None:
        if self.world:
            self._check_world(self.world)
            return
        for part in [part for element in self.elements for part in _parts_of(element)]:
            name = "springs" if isinstance(part, Spring) else "walls"
            msgspec.structs.force_setattr(self, name, (*getattr(self, name), part))
        msgspec.structs.force_setattr(self, "elements", ())
        if len(self.walls) > _MOST_WALLS:
            raise ValueError(f"the network has {len(self.walls)} walls, allowed are {_MOST_WALLS}")
        if self.block and len(self.block.D) != len(self.contacts):
            raise ValueError(f"block has {len(self.block.D)} channels, expected {len(self.contacts)}, one per contact")
        if len(set(self.contacts)) < len(self.contacts) or GROUND in self.contacts:
            raise ValueError(f"contacts must be different names other than {GROUND!r}, got {list(self.contacts)}")
        for part in (*self.springs, *self.walls):
            self._check_axes(part)
        nodes = self.nodes()
        for what, count, most in (("nodes", len(nodes), _MOST_NODES), ("springs", len(self.springs), _MOST_PARTS)):
            if count > most:
                raise ValueError(f"the network has {count} {what}, allowed are {most}")
        for name, mass in self.masses.items():
            _check_amount(f"mass of {name!r}", mass, "kg")
            if name == GROUND or not set(self.coordinates(name)) <= {*nodes, GROUND}:
                raise ValueError(f"masses lists {name!r}, which no spring or wall reaches; nodes: {', '.join(nodes)}")
        ends = [node for part in (*self.springs, *self.walls) for node in part.between]
        held = {node for end in (*ends, *self.masses) for node in self.coordinates(end)}
        loose = [n for n in self.contacts if n not in held and not self.block]
        if loose:
            raise ValueError(f"contact {loose[0]!r} has neither spring nor mass nor wall, so it can render no force")

    def _check_world(self, world: SceneFile) -> None:
        beside = [name for name in ("springs", "masses", "walls", "block", "elements") if getattr(self, name)]
        if beside:
            raise ValueError(f"world and {beside[0]}: a world is the whole environment, give one of them")
        if sum(map(len, world.along)) != len(self.contacts) or len(world.along) != len(self.bodies):
            count = sum(map(len, world.along))
            raise ValueError(
                f"along has {count} directions for {len(self.contacts)} contacts, expected one each, grouped by body"
            )
        if len(set(self.contacts)) < len(self.contacts):
            raise ValueError(f"contacts must have different names, got {list(self.contacts)}")

    @property
    def bodies(self) -> tuple[str, ...]:
        """The bodies of a world that the devices touch, in the order of the contacts."""
        point = {node: name for name, nodes in self.points.items() for node in nodes if node != GROUND}
        return tuple(dict.fromkeys(point.get(name, name) for name in self.contacts))

    @property
    def here(self) -> str:
        return "this world" if self.world else "this environment"

    def as_network(self) -> Network:
        if self.world:
            raise _NoModel
        return self

    def check(self, psi: Sequence[int], T: float) -> None:
        if not self.world:
            environment(self, T)
        elif any(psi):
            raise ValueError(f"psi is {list(psi)}: a world answers within the tick, so psi must be 0")

    def active(self, T: float) -> None:
        return None

    @property
    def one_period(self) -> bool:
        return self.block is not None

    def E(self, T: Number) -> Lti:
        if self.world:
            raise _NoModel
        return environment(with_frozen_walls(self), T)

    def frozen(self) -> Sequence[Network]:
        walls = itertools.product((False, True), repeat=len(self.walls))
        return tuple(with_frozen_walls(self, touching) for touching in walls)

    def coordinates(self, end: str) -> tuple[str, ...]:
        """Return the nodes of a point's coordinates, or the node of this name."""
        return self.points.get(end, (end,))

    def _check_axes(self, part: Spring | Wall) -> None:
        """Raise ValueError if ends and direction of a part differ in their numbers of axes, or a normal is missing."""
        ends = [(end, len(self.coordinates(end))) for end in part.between if end != GROUND]
        counts = {n for _, n in ends}
        what = f"between {' and '.join(part.between)}"
        if len(counts) > 1:
            shown = ", ".join(f"{end} has {n}" for end, n in ends)
            raise ValueError(f"the part {what} joins points with different numbers of axes: {shown}")
        name = "along" if isinstance(part, Spring) else "normal"
        axes, direction = max(counts, default=1), getattr(part, name)
        if direction and len(direction) != axes:
            raise ValueError(f"{name} {what} is {list(direction)}, expected {axes} numbers, one for each axis")
        if isinstance(part, Wall) and axes > 1 and not direction:
            raise ValueError(f"the wall {what} has no normal, expected {axes} numbers: the direction into the wall")

    def nodes(self) -> list[str]:
        """Return the contacts, then the internal nodes in the order of their first mention."""
        ends = (end for part in (*self.springs, *self.walls) for end in part.between)
        inner = (node for end in ends for node in self.coordinates(end) if node != GROUND)
        return list(dict.fromkeys((*self.contacts, *inner)))

    def matrices(self, number: Callable[[float], Any] = float) -> tuple[Array, Array, Array]:
        """Return mass, damping and stiffness matrices over `nodes()` without walls and block, (nodes, nodes), SI units.

        `number` makes the entries: float, or an exact type such as Fraction.
        """
        index = {name: i for i, name in enumerate(self.nodes())}
        mass = {node: amount for end, amount in self.masses.items() for node in self.coordinates(end)}
        M = np.diag([number(mass.get(name, 0.0)) for name in index])
        D, K = np.zeros_like(M), np.zeros_like(M)
        for spring in self.springs:
            amounts = spring.amounts(number)
            for ends in self._lengths(spring):
                places = [(index[node], int(sign) if sign in (1, -1) else number(sign)) for node, sign in ends]
                for matrix, amount in zip((M, D, K), amounts, strict=True):
                    for (i, one), (j, other) in itertools.product(places, places):
                        matrix[i, j] += one * other * amount
        return M, D, K

    def _lengths(self, part: Spring | Wall) -> list[list[tuple[str, float]]]:
        """Return the elongation that a part resists, or one per coordinate, each as (node, coefficient) pairs."""
        direction = part.along if isinstance(part, Spring) else part.normal
        ends = [(self.coordinates(end), sign) for end, sign in zip(part.between, (1, -1), strict=True) if end != GROUND]
        count = len(ends[0][0]) if ends else 0
        if not direction:
            return [[(nodes[i], sign) for nodes, sign in ends if nodes[i] != GROUND] for i in range(count)]
        signed = [(node, sign * c) for nodes, sign in ends for node, c in zip(nodes, direction, strict=True)]
        return [[(node, c) for node, c in signed if c and node != GROUND]]

    def across(self, parts: Sequence[Spring | Wall]) -> Array:
        """Return the displacement across each part as rows over `nodes()`: +1 at its first end, -1 at its second.

        Between points with several coordinates the entries of the part's direction replace 1; without a direction the
        first coordinate alone counts.
        """
        index = {name: i for i, name in enumerate(self.nodes())}
        lengths = [self._lengths(part) for part in parts]
        unweighted = all(sign in (1, -1) for ends in lengths for _, sign in ends[0])
        rows = np.zeros((len(parts), len(index)), dtype=int if unweighted else float)
        for row, ends in zip(rows, lengths, strict=True):
            for node, sign in ends[0]:
                row[index[node]] = sign
        return rows


#: Mass [kg], damping [N s/m] and stiffness [N/m] as from Network.matrices, (..., nodes, nodes) each.
_Matrices = tuple[Array, Array, Array]


class Networks(Environment):
    """Networks with the same nodes, given by matrices (.., nodes, nodes); the contacts are the first nodes."""

    def __init__(self, contacts: tuple[str, ...], matrices: _Matrices) -> None:
        self.contacts, self.matrices = contacts, matrices

    def active(self, T: float) -> None:
        return None

    def E(self, T: Number) -> Lti:
        return Lti(*_realise(self.matrices, len(self.contacts), T), T)

    def sampled(self, z: Complex, T: float) -> Sampled:
        """Return E at z (n, k) from the dynamic stiffness, Z_cc - Z_ci Z_ii^-1 Z_ic at s = (z-1)/(Tz)."""
        M, D, K = (part[..., None, :, :] for part in self.matrices)
        s = ((z - 1) / (T * z))[..., None, None]
        Z = M * s**2 + D * s + K
        cc, ci, ic, ii = (Z[(..., *quarter)] for quarter in _quarters(len(self.contacts)))
        inner = ic / ii if ii.shape[-1] == 1 else np.linalg.solve(ii, ic)
        return Sampled(z, cc - ci @ inner, T)

    def sent_at(self, coupling: Coupling, psi: Sequence[int], z: Complex, T: float) -> Sampled:
        E = self.sampled(z, T)
        return coupling.around(as_like(E, delay(psi, T)) @ E)


def environment(network: Network, T: Number) -> Lti:
    """Return E(z) from contact displacements [m] to forces [N], without walls, by backward Euler s -> (z-1)/(Tz).

    The positions q and velocities v of the internal nodes obey
    M (v - v-)/T + D v + K q + (terms of the contacts) = 0 with q = q- + T v, where q- and v- are those of the
    previous tick. The states are q- and v-, the previous displacements of contacts with dampers or masses, and the
    previous velocities of contacts with masses. The network's block is added to E(z). The arithmetic is that of T.
    Raises ValueError if nothing holds an internal node without mass, or if only rounding of directions holds a node.
    """
    parts = network.contacts, network.springs, network.walls, *network.masses.items(), *network.points.items()
    key = parts, type(T), T  # the type of T decides the arithmetic
    E = _computed.get(key)
    if E is None:
        free = _free_directions(network, network.springs, T)
        E = Lti(*_realise(_solvable(network, T), len(network.contacts), T, free=free), T)
        if len(_computed) == _MOST_COMPUTED:
            _computed.pop(next(iter(_computed)))
        _computed[key] = E
    return E + network.block.at(T) if network.block else E


#: E(z), without blocks, of the last networks. A design needs the same E(z) about twenty times.
_computed: dict[Any, Lti] = {}
_MOST_COMPUTED = 32


def walled_environment(network: Network, T: Number, places: bool = False) -> Lti:
    """Return the environment with ports for walls, from [x; p] to [f; y].

    p are the forces [N] of the walls, and y the displacements [m] across them. With `places` every node also has a
    port, whose input is a force against the node's displacement and whose output is this displacement. These ports come
    before those of the walls.
    """
    across = network.across(network.walls)
    across = across if across.dtype == int else numbers(across, T)
    free = () if places else _free_directions(network, (*network.springs, *network.walls), T)
    if places:
        across = np.vstack([np.eye(across.shape[1], dtype=across.dtype), across])
    E = Lti(*_realise(_solvable(network, T), len(network.contacts), T, across, free), T)
    if not network.block:
        return E
    w = len(across)
    return E + Lti.diag(network.block.at(T), Lti.constant(np.zeros((w, w)), T))


_Sum = dict[int, Fraction]  # a sum over displacements of internal nodes: index -> factor


def _free_directions(network: Network, parts: Sequence[Spring | Wall], T: Number) -> list[tuple[int, Array]]:
    """Return the directions in which no stiffness resists the internal nodes, each as (node, displacements (n,)).

    The position in such a direction affects no force and would be an unobservable integrator. Each direction has a node
    that moves by 1 in this direction and not at all in the other ones. `_realise` stores positions relative to this
    node. The elimination is exact, and the result has the arithmetic of T.
    """
    inner = {name: i for i, name in enumerate(network.nodes()[len(network.contacts) :])}
    lengths = [ends for part in parts if part.stiffness > 0 for ends in network._lengths(part)]
    tied: dict[int, _Sum] = {}  # node -> its displacement as a sum over nodes before it
    for ends in lengths:
        row: _Sum = {inner[node]: rational(sign) for node, sign in ends if node in inner}
        while row:
            last = max(row)
            own = row.pop(last)
            if last not in tied:
                tied[last] = {i: -v / own for i, v in row.items()}
                break
            row = _plus(row, own, tied[last])
    moves: list[_Sum] = []  # by node: its displacement as a sum over the free nodes
    for i in range(len(inner)):
        displacement: _Sum = {} if i in tied else {i: Fraction(1)}
        for j, factor in tied.get(i, {}).items():
            displacement = _plus(displacement, factor, moves[j])
        moves.append(displacement)
    free = [i for i in range(len(inner)) if i not in tied]
    if any(sign not in (1, -1) for ends in lengths for _, sign in ends):
        _check_directions(lengths, inner, len(free))
    zero = Fraction(0)
    return [(i, numbers(np.array([displacement.get(i, zero) for displacement in moves]), T)) for i in free]


def _plus(one: _Sum, factor: Fraction, other: _Sum) -> _Sum:
    """Return one + factor * other, without zeros."""
    total = {i: one.get(i, 0) + factor * other.get(i, 0) for i in {**one, **other}}
    return {i: Fraction(v) for i, v in total.items() if v}


_SLACK = 1e-9  # smaller eigenvalues, relative to the largest one, come from the rounding of directions


def _check_directions(lengths: Sequence[Sequence[tuple[str, float]]], inner: dict[str, int], free: int) -> None:
    """Raise ValueError if more directions are free within rounding than the `free` ones of exact arithmetic."""
    rows = np.zeros((len(lengths), len(inner)))
    for row, ends in zip(rows, lengths, strict=True):
        for node, sign in ends:
            if node in inner:
                row[inner[node]] += sign
    values, vectors = np.linalg.eigh(rows.T @ rows)
    loose = np.flatnonzero(values <= _SLACK * values.max(initial=0.0))
    if loose.size > free:
        moving = np.abs(vectors[:, loose]).max(axis=1) > 1e-3
        shown = ", ".join(name for name, i in inner.items() if moving[i])
        raise ValueError(
            f"springs and walls at {shown} have almost equal directions, so that only rounding holds these nodes: "
            "make the directions equal, or add a spring `along` each free direction"
        )


def _solvable(network: Network, T: Number) -> _Matrices:
    if isinstance(T, Fraction):
        return network.matrices(rational)
    M, D, K = network.matrices()
    free = network.nodes()[len(network.contacts) :]
    inner = slice(len(network.contacts), None)
    if free and np.linalg.cond((M / T + D + T * K)[inner, inner]) > 1e14:
        raise ValueError(f"an internal node among {', '.join(free)} has (almost) no mass and nothing that holds it")
    return M, D, K


def _realise(
    matrices: _Matrices,
    c: int,
    T: Any,
    across: Array | None = None,
    free: Sequence[tuple[int, Array]] = (),
) -> tuple[Array, Array, Array, Array]:
    """Return A, B, C, D of E(z) for the network (M, D, K) whose first `c` nodes are contacts.

    With `across` (w, nodes) E has w more inputs, the forces against the displacements `across q`, and w more outputs,
    these displacements. In each direction of `free` (node, displacements) positions are relative to this node.
    The arithmetic is that of the entries.
    """
    (Mcc, Mci, Mic, Mii), (Dcc, Dci, Dic, Dii), (Kcc, Kci, Kic, Kii) = (
        [part[(..., *quarter)] for quarter in _quarters(c)] for part in matrices
    )
    solve = inverse(Mii / T + Dii + T * Kii)

    # Every signal is a row of coefficients over [x; p; q-; v-; x-; vx-], with the contacts' velocities vx.
    M = matrices[0]
    n, w = M.shape[-1] - c, 0 if across is None else len(across)
    signals = np.eye(3 * c + w + 2 * n, dtype=M.dtype)
    x, p, q_old, v_old, x_old, vx_old = np.split(signals, np.cumsum([c, w, n, n, c]))
    for node, _ in free:
        q_old[node] = 0
    vx = (x - x_old) / T
    push = times(Mii / T, v_old) - times(Kii, q_old) - times(Dic, vx) - times(Kic, x)
    if joined := (Mci != 0).any():
        push = push - times(Mic, vx - vx_old) / T
    if across is not None:
        push = push - across[:, c:].T @ p
    v = times(solve, push)
    q = q_old + T * v
    force = times(Mcc, vx - vx_old) / T + times(Dcc, vx) + times(Kcc, x) + times(Dci, v) + times(Kci, q)
    if joined:
        force = force + times(Mci, v - v_old) / T
    if across is not None:
        force = np.vstack([force + across[:, :c].T @ p, across[:, :c] @ x + across[:, c:] @ q])

    for node, displacements in free:
        moving = np.flatnonzero(displacements)
        q[moving] = q[moving] - displacements[moving, None] * q[node]
    inputs = c + w
    after = np.concatenate([np.broadcast_to(part, (*M.shape[:-2], *part.shape[-2:])) for part in (q, v, x, vx)], -2)
    keep = _remembered(after, force, inputs)
    states, rest = after[..., keep, :], force[..., inputs:]
    return states[..., inputs:][..., keep], states[..., :inputs], rest[..., keep], force[..., :inputs]


def _quarters(c: int) -> tuple[tuple[slice, slice], ...]:
    contact, inner = slice(None, c), slice(c, None)
    return (contact, contact), (contact, inner), (inner, contact), (inner, inner)


def _remembered(after: Array, force: Array, inputs: int) -> NDArray[np.intp]:
    """Return the indices of the states that affect an output at this tick or a later one."""
    count = after.shape[-1]
    reads = (after.reshape(-1, count - inputs, count)[..., inputs:] != 0).any(axis=0)
    used = (force.reshape(-1, count)[:, inputs:] != 0).any(axis=0)
    for _ in range(used.size):
        used = used | reads[used].any(axis=0)
    return np.flatnonzero(used)


def with_frozen_walls(network: Network, touching: Sequence[bool] | None = None) -> Network:
    """Return the network with a spring-damper for each wall, zero if the wall does not touch; by default all touch."""
    if not network.walls:
        return network
    touching = [True] * len(network.walls) if touching is None else touching
    walls = zip(network.walls, touching, strict=True)
    springs = (Spring(w.between, on * w.stiffness, on * w.damping, along=w.normal) for w, on in walls)
    return msgspec.structs.replace(network, springs=(*network.springs, *springs), walls=())
