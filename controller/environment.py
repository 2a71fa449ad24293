"""Virtual environments: spring-damper-mass networks, discretised by backward Euler.

Nodes are contacts (whose displacements the devices impose), internal nodes (free) and the ground.
With Z(s) = M s^2 + D s + K the dynamic stiffness of the network, the map from contact displacements
to the forces that the devices feel (with a minus sign) is Z_cc - Z_ci Z_ii^-1 Z_ic, at s = (z-1)/(Tz).
"""

from __future__ import annotations

import enum
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from math import prod
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.coupling import Coupling
from controller.delay import delay
from controller.lti import Array, Complex, Lti, Number, Sampled, inverse, numbers, rational

# ----------------------------------------------------------------------------------------------------
# Environments that are not known exactly: ranges of a network's parameters, their vertices, and points inside.
#
# The vertices are the environments in which every uncertain parameter is at an end of its range, and every contact
# that may be absent is there or not. An absent spring stays in its network with neither stiffness nor damping.


_Range = tuple[float, float]

_MOST_VERTICES = 128  # each is a world of the design and a proof


class UncertainSpring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ranges of one spring's parameters; where no range is given the environment's own value holds."""

    between: tuple[str, str]
    stiffness: _Range | None = None  # [N/m]
    damping: _Range | None = None  # [N s/m]
    absent: bool = False  # the spring may also be missing altogether: a contact lost, or not made yet

    def __post_init__(self) -> None:
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_range(f"{name} between {' and '.join(self.between)}", getattr(self, name), unit)


class Ranges(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Ranges of a network's parameters, each independent of the others."""

    springs: tuple[UncertainSpring, ...] = ()
    masses: dict[str, _Range] = {}  # [kg], by node

    def __post_init__(self) -> None:
        for node, limits in self.masses.items():
            _check_range(f"mass of {node!r}", limits, "kg")


@dataclass(frozen=True)
class Member:
    """One environment within ranges."""

    name: str
    network: Any


@dataclass(frozen=True)
class _State:
    """One state of an uncertain part, present or absent: its ranges in that state, and the part at given values."""

    ranges: tuple[_Range, ...]  # those of some width
    value: Callable[[Sequence[float]], Spring | float]


@dataclass(frozen=True)
class _Part:
    """One uncertain part: its values at each of its vertices, and between them."""

    place: str  # a spring's ends, or a node
    corners: tuple[Spring | float, ...]
    own: Spring | float  # as it is in the environment
    draw: Callable[[np.random.Generator], Spring | float]
    states: tuple[_State, ...]  # there, or absent

    def label(self, value: Spring | float) -> str:
        if not isinstance(value, Spring):
            return f"{self.place} {value:.4g} kg"
        if not (value.stiffness or value.damping):
            return f"{self.place} absent"
        return f"{self.place} {value.stiffness:.4g} N/m, {value.damping:.4g} N s/m"


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the ranges in which only numbers vary: every contact is either present or absent."""

    low: Array  # (n,) the ends of the ranges
    high: Array  # (n,)
    at: Callable[[str, Array], Member]  # a name, and a point between low and high


def members(network: Network, ranges: Ranges) -> tuple[Member, ...]:
    """The environment itself, then the vertices of the ranges that differ from it.

    Raises ValueError naming the field where the ranges do not fit the network, or have more than 128 vertices.
    """
    nominal = Member("the nominal environment", network)
    parts = _parts(network, ranges)
    count = prod(len(part.corners) for part in parts)
    if count > _MOST_VERTICES:
        raise ValueError(
            f"ranges have {count} vertices, allowed are {_MOST_VERTICES}: leave out the ranges that matter least, "
            "each halves the number"
        )
    corners = (c for c in product(*(part.corners for part in parts)) if c != tuple(part.own for part in parts))
    vertices = (_member(f"vertex {i}", network, parts, corner) for i, corner in enumerate(corners, start=1))
    return (nominal, *vertices)


def regions(network: Network, ranges: Ranges) -> tuple[Region, ...]:
    """The ranges as one region for every way in which its contacts can be there or absent."""
    parts = _parts(network, ranges)
    return tuple(_region(network, parts, states) for states in product(*(part.states for part in parts)))


def inside(network: Network, ranges: Ranges, count: int, seed: int) -> tuple[Member, ...]:
    """`count` environments drawn from the ranges: every parameter evenly, a contact that may be absent as often as not.

    The first are the same whatever the count.
    """
    parts, rng = _parts(network, ranges), np.random.default_rng(seed)
    return tuple(_member(f"sample {i}", network, parts, [p.draw(rng) for p in parts]) for i in range(1, count + 1))


def _parts(network: Network, ranges: Ranges) -> list[_Part]:
    if not (ranges.springs or ranges.masses):
        raise ValueError("ranges are empty: give springs or masses whose parameters have ranges")
    named = [frozenset(one.between) for one in ranges.springs]
    for one, ends in zip(ranges.springs, named, strict=True):
        if named.count(ends) > 1:
            raise ValueError(f"ranges.springs names {' and '.join(one.between)} twice")
    return [
        *(_spring_part(network, one) for one in ranges.springs),
        *(_mass_part(network, *m) for m in ranges.masses.items()),
    ]


def _spring_part(network: Network, uncertain: UncertainSpring) -> _Part:
    a, b = uncertain.between
    field = f"ranges.springs between {a} and {b}"
    for node in (a, b):
        if node not in (*network.nodes(), "ground"):
            raise ValueError(f"{field}: there is no node {node!r}; nodes: {', '.join(network.nodes())}, ground")
    found = [spring for spring in network.springs if set(spring.between) == {a, b}]
    if len(found) > 1:
        raise ValueError(f"{field}: the environment has {len(found)} springs there, expected one")
    nothing = Spring((a, b), 0.0, 0.0)
    if found:
        own, present = found[0], found[0]
        _check_inside(field, uncertain, own)
    elif uncertain.absent and uncertain.stiffness:
        own, present = nothing, nothing
    else:
        raise ValueError(f"{field}: no spring is there; one that may come to be needs a stiffness and absent = true")
    stiffness = uncertain.stiffness or (present.stiffness, present.stiffness)
    damping = uncertain.damping or (present.damping, present.damping)
    if not uncertain.absent and stiffness[0] == stiffness[1] and damping[0] == damping[1]:
        raise ValueError(f"{field}: nothing is uncertain; give stiffness or damping a range, or absent = true")
    pairs = dict.fromkeys(product(stiffness, damping))
    corners = [Spring(own.between, k, d) for k, d in pairs]
    absent = Spring(own.between, 0.0, 0.0)
    if uncertain.absent and absent not in corners:
        corners.append(absent)

    def draw(rng: np.random.Generator) -> Spring:
        k, d, coin = rng.uniform(stiffness[0], stiffness[1]), rng.uniform(damping[0], damping[1]), rng.random()
        return absent if uncertain.absent and coin < 0.5 else Spring(own.between, k, d)

    states = [_spring_state(own.between, stiffness, damping)]
    if uncertain.absent:
        states.append(_State((), lambda _: absent))
    return _Part(f"{a}-{b}", tuple(corners), own, draw, tuple(states))


def _spring_state(between: tuple[str, str], stiffness: _Range, damping: _Range) -> _State:
    """A spring that is present; a range of no width is not a coordinate."""
    free = [low < high for low, high in (stiffness, damping)]

    def value(point: Sequence[float]) -> Spring:
        given = iter(point)
        k, d = (next(given) if f else limits[0] for f, limits in zip(free, (stiffness, damping), strict=True))
        return Spring(between, float(k), float(d))

    return _State(tuple(r for f, r in zip(free, (stiffness, damping), strict=True) if f), value)


def _mass_part(network: Network, node: str, limits: _Range) -> _Part:
    if node not in network.nodes():
        raise ValueError(f"ranges.masses names {node!r}, which no spring reaches; nodes: {', '.join(network.nodes())}")
    own = network.masses.get(node, 0.0)
    _require_inside(f"ranges.masses.{node}", limits, own, "kg")
    if limits[0] == limits[1]:
        raise ValueError(f"ranges.masses.{node} is {limits[0]:g} to {limits[1]:g} kg: nothing is uncertain")
    state = _State((limits,), lambda point: float(point[0]))
    return _Part(node, limits, own, lambda rng: rng.uniform(limits[0], limits[1]), (state,))


def _region(network: Network, parts: Sequence[_Part], states: Sequence[_State]) -> Region:
    low, high = np.array([r for state in states for r in state.ranges], dtype=float).reshape(-1, 2).T
    ends = np.cumsum([len(state.ranges) for state in states])[:-1]

    def at(name: str, point: Array) -> Member:
        values = [s.value(x.tolist()) for s, x in zip(states, np.split(point, ends), strict=True)]
        return _member(name, network, parts, values)

    return Region(low, high, at)


def _member(name: str, network: Network, parts: Sequence[_Part], values: Sequence[Spring | float]) -> Member:
    springs, masses = list(network.springs), dict(network.masses)
    for part, value in zip(parts, values, strict=True):
        if not isinstance(value, Spring):
            masses[part.place] = value
        elif part.own in springs:
            springs[springs.index(part.own)] = value
        else:
            springs.append(value)
    labels = "; ".join(part.label(value) for part, value in zip(parts, values, strict=True))
    return Member(f"{name} ({labels})", Network(network.contacts, tuple(springs), masses))


def _check_inside(field: str, uncertain: UncertainSpring, own: Spring) -> None:
    for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
        limits = getattr(uncertain, name)
        if limits:
            _require_inside(f"{field}: {name}", limits, getattr(own, name), unit)


def _require_inside(field: str, limits: _Range, own: float, unit: str) -> None:
    if not limits[0] <= own <= limits[1]:
        raise ValueError(
            f"{field} is {limits[0]:g} to {limits[1]:g} {unit}, which leaves out the environment's own {own:g}"
        )


def _check_range(field: str, limits: _Range | None, unit: str) -> None:
    if limits is not None and not 0 <= limits[0] <= limits[1] <= _MOST[unit]:
        expected = f"[least, most] in {unit}, 0 <= least <= most <= {_MOST[unit]:g}"
        raise ValueError(f"{field} is {list(limits)}, expected {expected}")


GROUND = "ground"


#: largest amounts, far from where arithmetic ends and beyond what anybody renders
_MOST = {"N/m": 1e12, "N s/m": 1e9, "kg": 1e6}
_MOST_NODES, _MOST_PARTS = 200, 2000  # a mass is two states, and a proof has at most a few hundred


def _check_amount(what: str, value: float, unit: str) -> None:
    if not 0 <= value <= _MOST[unit]:
        raise ValueError(f"{what} is {value}, allowed are 0 to {_MOST[unit]:g} {unit} (a passive network)")


class Spring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spring and a damper in parallel between two nodes."""

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m]

    def __post_init__(self) -> None:
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_amount(f"{name} between {' and '.join(self.between)}", getattr(self, name), unit)
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")

    def amounts(self, number: Callable[[float], Any]) -> tuple[Any, Any, Any]:
        """Mass [kg], damping [N s/m] and stiffness [N/m] between the ends: what another linear element overrides."""
        return number(0.0), number(self.damping), number(self.stiffness)


class Wall(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A one-sided spring-damper: it pushes the first node back once it is `gap` beyond the second; see walls.py."""

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m], only while in contact, and never pulling
    gap: float = 0.0  # [m] free way from rest; negative where it is compressed at rest

    def __post_init__(self) -> None:
        ends = " and ".join(self.between)
        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            _check_amount(f"{name} of the wall between {ends}", getattr(self, name), unit)
        if self.stiffness == 0:
            raise ValueError(f"stiffness of the wall between {ends} is 0, expected more (or no wall)")
        if not abs(self.gap) < np.inf:
            raise ValueError(f"gap of the wall between {ends} is {self.gap}, expected a finite length in m")
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")

    def slope(self, T: Number) -> Number:
        """K + 2 B/T [N/m], in the arithmetic of T: no motion that alternates between ticks is met more stiffly."""
        return numbers(self.stiffness, T) + 2 * numbers(self.damping, T) / T


class Environment:
    """What a loop asks of its environment. Your own class has `contacts` and `E(T)`."""

    __slots__ = ()
    contacts: Any  # tuple[str, ...], one a channel
    walls: tuple[Wall, ...] = ()
    here: Any = "this environment"  # str: how a guarantee names it

    def check(self, psi: Sequence[int], T: float) -> None:
        """Raises ValueError where no loop with this environment makes sense."""
        self.E(T)

    def E(self, T: Number) -> Lti:
        """E(z), contact displacements [m] to forces [N], every wall touching, in the arithmetic of T."""
        raise NotImplementedError

    def sent(self, coupling: Coupling, psi: Sequence[int], T: Number) -> Lti:
        """G = (I + Psi E V)^-1 Psi E: the forces that leave through the coupling. Raises SingularLoop."""
        return coupling.around(delay(psi, T) @ self.E(T))

    def sent_at(self, coupling: Coupling, psi: Sequence[int], z: Complex, T: float) -> Sampled:
        """The same at points z of the circle."""
        return coupling.around(Sampled.of(delay(psi, T) @ self.E(T), z))

    def frozen(self) -> Sequence[Environment]:
        """The linear environments that it is made of, by the walls that touch."""
        return (self,)


class RigidWall(Environment, enum.Enum):
    """E -> infinity: a wall that does not give, behind a coupling and never left. One channel."""

    RIGID_WALL = "rigid wall"  # as files have it

    @property
    def contacts(self) -> tuple[str, ...]:
        return ("tip",)

    @property
    def here(self) -> str:
        return "a rigid wall only"

    def check(self, psi: Sequence[int], T: float) -> None:
        if any(psi):
            shown = ", ".join(map(str, psi))
            raise ValueError(f"psi is {shown}: behind a rigid wall no loop with a delayed environment is stable")

    def E(self, T: Number) -> Lti:
        raise ValueError("a rigid wall has no E(z): its force is whatever the coupling in front of it makes")

    def sent(self, coupling: Coupling, psi: Sequence[int], T: Number) -> Lti:
        """V^-1. Raises ValueError for a coupling without a V, SingularLoop where V has no inverse."""
        V = coupling.compliance(T)
        if V is None:
            raise ValueError("a rigid wall needs a spring-damper or another V in front of it")
        return V.inverse()

    def sent_at(self, coupling: Coupling, psi: Sequence[int], z: Complex, T: float) -> Sampled:
        return Sampled.of(self.sent(coupling, psi, T), z)


RIGID_WALL = RigidWall.RIGID_WALL


class Network(msgspec.Struct, Environment, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A passive mechanical network seen at its contacts, in the order of the channels."""

    contacts: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    springs: tuple[Spring, ...] = ()
    masses: dict[str, float] = {}  # [kg], by node; nodes that are not named have none
    walls: Annotated[tuple[Wall, ...], msgspec.Meta(max_length=6)] = ()  # 2^6 contact states

    def __post_init__(self) -> None:
        if len(set(self.contacts)) < len(self.contacts) or GROUND in self.contacts:
            raise ValueError(f"contacts must be different names other than {GROUND!r}, got {list(self.contacts)}")
        nodes = self.nodes()
        for what, count, most in (("nodes", len(nodes), _MOST_NODES), ("springs", len(self.springs), _MOST_PARTS)):
            if count > most:
                raise ValueError(f"the network has {count} {what}, allowed are {most}")
        for name, mass in self.masses.items():
            _check_amount(f"mass of {name!r}", mass, "kg")
            if name not in nodes:
                raise ValueError(f"masses names {name!r}, which no spring reaches; nodes: {', '.join(nodes)}")
        held = {node for part in (*self.springs, *self.walls) for node in part.between} | set(self.masses)
        loose = [n for n in self.contacts if n not in held]
        if loose:
            raise ValueError(f"contact {loose[0]!r} has neither spring nor mass nor wall, so it can render no force")

    def check(self, psi: Sequence[int], T: float) -> None:
        environment(self, T)

    def E(self, T: Number) -> Lti:
        return environment(held(self), T)

    def frozen(self) -> Sequence[Network]:
        return tuple(frozen_states(self).values())

    def nodes(self) -> list[str]:
        """Contacts first, then internal nodes in the order of their first mention."""
        ends = (node for part in (*self.springs, *self.walls) for node in part.between if node != GROUND)
        return list(dict.fromkeys((*self.contacts, *ends)))

    def matrices(self, number: Callable[[float], Any] = float) -> tuple[Array, Array, Array]:
        """Mass [kg], damping [N s/m] and stiffness [N/m] over `nodes()`, each (nodes, nodes).

        `number` makes the entries: float, or an exact type such as Fraction.
        """
        index = {name: i for i, name in enumerate(self.nodes())}
        M = np.diag([number(self.masses.get(name, 0.0)) for name in index])
        D, K = np.zeros_like(M), np.zeros_like(M)
        for spring in self.springs:
            ends = [(index[node], sign) for node, sign in zip(spring.between, (1, -1), strict=True) if node != GROUND]
            for whole, amount in zip((M, D, K), spring.amounts(number), strict=True):
                for (i, one), (j, other) in itertools.product(ends, ends):
                    whole[i, j] += one * other * amount
        return M, D, K

    def across(self, parts: Sequence[Spring | Wall]) -> NDArray[np.int64]:
        """The displacement across each part, as rows over `nodes()`: +1 at its first end, -1 at its second."""
        index = {name: i for i, name in enumerate(self.nodes())}
        rows = np.zeros((len(parts), len(index)), dtype=int)
        for row, part in zip(rows, parts, strict=True):
            for node, sign in zip(part.between, (1, -1), strict=True):
                if node != GROUND:
                    row[index[node]] = sign
        return rows


#: Figure 4 as we read it: contact 1 -(K1, B1)- M -(K2, B2)- contact 2, the mass free.
FIGURE_4 = Network(
    contacts=("contact 1", "contact 2"),
    springs=(
        Spring(("contact 1", "mass"), stiffness=800.0, damping=1.0),
        Spring(("mass", "contact 2"), stiffness=700.0, damping=1.0),
    ),
    masses={"mass": 1.0},
)


def environment(network: Network, T: Number) -> Lti:
    """E(z), contact displacements [m] to forces [N], by backward Euler s -> (z-1)/(Tz); no wall touches.

    Internal nodes obey M (v - v-)/T + D v + K q + (coupling to the contacts) = 0 with q = q- + T v, solved
    for v at every tick. The states are q- and v- of the internal nodes, and what the contact dampers and
    masses need of the past; see `_adrift` for bodies without a place of rest. In the arithmetic of T. Raises ValueError
    if an internal node is held by nothing.
    """
    adrift = _adrift(network, network.springs)
    return Lti(*_realise(_solvable(network, T), len(network.contacts), T, adrift=adrift), T)


#: mass [kg], damping [N s/m] and stiffness [N/m], (..., nodes, nodes) each, as Network.matrices gives them
Matrices = tuple[Array, Array, Array]


def environment_of(matrices: Matrices, contacts: int, T: Number) -> Lti:
    """E(z) of the networks with these matrices, whose first nodes are the contacts: a stack where they have axes."""
    return Lti(*_realise(matrices, contacts, T), T)


def sampled_environment(matrices: Matrices, contacts: int, z: Complex, T: float) -> Sampled:
    """The same at z (n, k) from the dynamic stiffness itself, Z_cc - Z_ci Z_ii^-1 Z_ic at s = (z-1)/(Tz)."""
    M, D, K = (part[..., None, :, :] for part in matrices)
    s = ((z - 1) / (T * z))[..., None, None]
    Z = M * s**2 + D * s + K
    cc, ci, ic, ii = (Z[(..., *quarter)] for quarter in _quarters(contacts))
    inner = ic / ii if ii.shape[-1] == 1 else np.linalg.solve(ii, ic)
    return Sampled(z, cc - ci @ inner, T)


def walled_environment(network: Network, T: Number) -> Lti:
    """[x; p] -> [f; y]: as `environment`, wall forces p [N] put in and displacements y [m] across walls out."""
    across = network.across(network.walls)
    adrift = _adrift(network, (*network.springs, *network.walls))
    return Lti(*_realise(_solvable(network, T), len(network.contacts), T, across, adrift), T)


def _adrift(network: Network, springs: Sequence[Spring | Wall]) -> list[list[int]]:
    """The bodies that no spring joins to a contact or to the ground, as lists of their internal nodes' indices.

    Only dampers drag such a body, so it may come to rest anywhere, and no force tells where: the place of one of its
    nodes would be a state that integrates for ever and is never seen. The places of its nodes are kept relatively to
    the first one.
    """
    names = network.nodes()
    body = {name: name for name in (*names, GROUND)}  # each points to another node of its body, in the end to one

    def head(name: str) -> str:
        while body[name] != name:
            name = body[name]
        return name

    for spring in springs:
        if spring.stiffness > 0:
            body[head(spring.between[0])] = head(spring.between[1])
    held, inner = {head(name) for name in (*network.contacts, GROUND)}, names[len(network.contacts) :]
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(inner):
        if head(name) not in held:
            groups.setdefault(head(name), []).append(i)
    return list(groups.values())


def _solvable(network: Network, T: Number) -> Matrices:
    if isinstance(T, Fraction):
        return network.matrices(rational)
    M, D, K = network.matrices()
    free = network.nodes()[len(network.contacts) :]
    inner = slice(len(network.contacts), None)
    if free and np.linalg.cond((M / T + D + T * K)[inner, inner]) > 1e14:
        raise ValueError(f"an internal node among {', '.join(free)} has no mass and nothing that holds it")
    return M, D, K


def _realise(
    matrices: Matrices,
    c: int,
    T: Any,
    across: NDArray[np.int64] | None = None,
    adrift: Sequence[Sequence[int]] = (),
) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of the network (M, D, K) whose first `c` nodes are contacts; see `environment`.

    With `across` (w, nodes) there are w more inputs, forces that push the displacements `across q` back, and w more
    outputs, these displacements. The places of internal nodes in a group of `adrift` are kept relatively to its first.
    The arithmetic is that of the entries.
    """
    (Mcc, _, _, Mii), (Dcc, Dci, Dic, Dii), (Kcc, Kci, Kic, Kii) = (
        [part[(..., *quarter)] for quarter in _quarters(c)] for part in matrices
    )
    solve = inverse(Mii / T + Dii + T * Kii)

    # every signal is a row of coefficients over [x; p; q-; v-; x-; vx-]
    M = matrices[0]
    n, w = M.shape[-1] - c, 0 if across is None else len(across)
    signals = np.eye(3 * c + w + 2 * n, dtype=M.dtype)
    x, p, q_old, v_old, x_old, vx_old = np.split(signals, np.cumsum([c, w, n, n, c]))
    for group in adrift:
        q_old[group[0]] = 0
    vx = (x - x_old) / T
    push = Mii / T @ v_old - Kii @ q_old - Dic @ vx - Kic @ x
    if across is not None:
        push = push - across[:, c:].T @ p
    v = solve @ push
    q = q_old + T * v
    force = Mcc @ (vx - vx_old) / T + Dcc @ vx + Kcc @ x + Dci @ v + Kci @ q
    if across is not None:
        force = np.vstack([force + across[:, :c].T @ p, across[:, :c] @ x + across[:, c:] @ q])

    for group in adrift:
        q[list(group)] = q[list(group)] - q[group[0]]
    inputs = c + w
    after = np.concatenate([np.broadcast_to(part, (*M.shape[:-2], *part.shape[-2:])) for part in (q, v, x, vx)], -2)
    keep = _remembered(after, force, inputs)
    kept, rest = after[..., keep, :], force[..., inputs:]
    return kept[..., inputs:][..., keep], kept[..., :inputs], rest[..., keep], force[..., :inputs]


def _quarters(c: int) -> tuple[tuple[slice, slice], ...]:
    contact, inner = slice(None, c), slice(c, None)
    return (contact, contact), (contact, inner), (inner, contact), (inner, inner)


def _remembered(after: Array, force: Array, inputs: int) -> NDArray[np.intp]:
    """Indices of the states that reach the outputs, now or later; the others are dropped."""
    count = after.shape[-1]
    reads = (after.reshape(-1, count - inputs, count)[..., inputs:] != 0).any(axis=0)
    used = (force.reshape(-1, count)[:, inputs:] != 0).any(axis=0)
    for _ in range(used.size):
        used = used | reads[used].any(axis=0)
    return np.flatnonzero(used)


def frozen_states(network: Network) -> dict[tuple[bool, ...], Network]:
    """The linear environments that a walled one is made of, by the walls that touch; one state where there is none."""
    states = itertools.product((False, True), repeat=len(network.walls))
    return {touching: held(network, touching) for touching in states}


def held(network: Network, touching: Sequence[bool] | None = None) -> Network:
    """The network with the touching walls (default: all) as two-sided springs, without the others."""
    touching = [True] * len(network.walls) if touching is None else touching
    walls = zip(network.walls, touching, strict=True)
    springs = (Spring(w.between, on * w.stiffness, on * w.damping) for w, on in walls)
    return msgspec.structs.replace(network, springs=(*network.springs, *springs), walls=())


def walled_force_map(network: Network, coupling: Coupling, theta: Sequence[int], psi: Sequence[int], T: Number) -> Lti:
    """[x; p] to [f; y]: displacements and wall forces [N] to what the devices feel and the ways into the walls [m].

    Psi and Theta delay what the devices feel of the walls. Raises SingularLoop, and ValueError for a coupling that
    walls cannot stand behind.
    """
    w = len(network.walls)

    def late(steps: Sequence[int]) -> Lti:
        return Lti.diag(delay(steps, T), Lti.constant(np.eye(w), T))

    return late(theta) @ coupling.around(late(psi) @ walled_environment(network, T), further=w)
