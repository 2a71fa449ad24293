"""Virtual environments: spring-damper-mass networks, discretised by backward Euler.

Nodes are contacts (whose displacements the devices impose), internal nodes (free) and the ground.
With Z(s) = M s^2 + D s + K the dynamic stiffness of the network, the map from contact displacements
to the forces that the devices feel (with a minus sign) is Z_cc - Z_ci Z_ii^-1 Z_ic, at s = (z-1)/(Tz).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.lti import Array, Lti

GROUND = "ground"


def _check_amount(what: str, value: float) -> None:
    if not 0 <= value < np.inf:
        raise ValueError(f"{what} is {value}, expected a finite number >= 0 (a passive network)")


class Spring(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spring and a damper in parallel between two nodes."""

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m]

    def __post_init__(self) -> None:
        for name in ("stiffness", "damping"):
            _check_amount(f"{name} between {' and '.join(self.between)}", getattr(self, name))
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")


class Wall(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A one-sided spring-damper: it pushes the first node back once it is `gap` beyond the second; see contact.py."""

    between: tuple[str, str]
    stiffness: float  # [N/m]
    damping: float = 0.0  # [N s/m], only while in contact, and never pulling
    gap: float = 0.0  # [m] free way from rest; negative where it is compressed at rest

    def __post_init__(self) -> None:
        ends = " and ".join(self.between)
        for name in ("stiffness", "damping"):
            _check_amount(f"{name} of the wall between {ends}", getattr(self, name))
        if self.stiffness == 0:
            raise ValueError(f"stiffness of the wall between {ends} is 0, expected more (or no wall)")
        if not abs(self.gap) < np.inf:
            raise ValueError(f"gap of the wall between {ends} is {self.gap}, expected a finite length in m")
        if self.between[0] == self.between[1]:
            raise ValueError(f"between joins {self.between[0]!r} to itself; name two different nodes")


class Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A passive mechanical network seen at its contacts, in the order of the channels."""

    contacts: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    springs: tuple[Spring, ...] = ()
    masses: dict[str, float] = {}  # [kg], by node; nodes that are not named have none
    walls: Annotated[tuple[Wall, ...], msgspec.Meta(max_length=6)] = ()  # 2^6 contact states

    def __post_init__(self) -> None:
        if len(set(self.contacts)) < len(self.contacts) or GROUND in self.contacts:
            raise ValueError(f"contacts must be different names other than {GROUND!r}, got {list(self.contacts)}")
        nodes = self.nodes()
        for name, mass in self.masses.items():
            _check_amount(f"mass of {name!r}", mass)
            if name not in nodes:
                raise ValueError(f"masses names {name!r}, which no spring reaches; nodes: {', '.join(nodes)}")
        held = {node for part in (*self.springs, *self.walls) for node in part.between} | set(self.masses)
        loose = [n for n in self.contacts if n not in held]
        if loose:
            raise ValueError(f"contact {loose[0]!r} has neither spring nor mass nor wall, so it can render no force")

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
        for spring, across in zip(self.springs, self.across(self.springs), strict=True):
            pattern = np.outer(across, across)
            D += number(spring.damping) * pattern
            K += number(spring.stiffness) * pattern
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


def environment(network: Network, T: float) -> Lti:
    """E(z), contact displacements [m] to forces [N], by backward Euler s -> (z-1)/(Tz); no wall touches.

    Internal nodes obey M (v - v-)/T + D v + K q + (coupling to the contacts) = 0 with q = q- + T v, solved
    for v at every tick. The states are q- and v- of the internal nodes, and what the contact dampers and
    masses need of the past. Raises ValueError if an internal node is held by nothing.
    """
    return Lti(*realise(_solvable(network, T), len(network.contacts), T, np.linalg.inv), T)


def walled_environment(network: Network, T: float) -> Lti:
    """[x; p] -> [f; y]: as `environment`, wall forces p [N] put in and displacements y [m] across walls out."""
    across = network.across(network.walls)
    return Lti(*realise(_solvable(network, T), len(network.contacts), T, np.linalg.inv, across), T)


def _solvable(network: Network, T: float) -> tuple[Array, Array, Array]:
    M, D, K = network.matrices()
    free = network.nodes()[len(network.contacts) :]
    inner = slice(len(network.contacts), None)
    if free and np.linalg.cond((M / T + D + T * K)[inner, inner]) > 1e14:
        raise ValueError(f"an internal node among {', '.join(free)} has no mass and nothing that holds it")
    return M, D, K


def realise(
    matrices: tuple[Array, Array, Array],
    c: int,
    T: Any,
    inverse: Callable[[Array], Array],
    across: NDArray[np.int64] | None = None,
) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of the network (M, D, K) whose first `c` nodes are contacts; see `environment`.

    With `across` (w, nodes) there are w more inputs, forces that push the displacements `across q` back, and w more
    outputs, these displacements. The arithmetic is that of the entries: floating point, or exact with object arrays
    and an exact inverse.
    """
    M, D, K = matrices
    cc, ci, ic, ii = _quarters(c)
    solve = inverse(M[ii] / T + D[ii] + T * K[ii])

    # every signal is a row of coefficients over [x; p; q-; v-; x-; vx-]
    n, w = M.shape[0] - c, 0 if across is None else len(across)
    signals = np.eye(3 * c + w + 2 * n, dtype=M.dtype)
    x, p, q_old, v_old, x_old, vx_old = np.split(signals, np.cumsum([c, w, n, n, c]))
    vx = (x - x_old) / T
    push = M[ii] / T @ v_old - K[ii] @ q_old - D[ic] @ vx - K[ic] @ x
    if across is not None:
        push = push - across[:, c:].T @ p
    v = solve @ push
    q = q_old + T * v
    force = M[cc] @ (vx - vx_old) / T + D[cc] @ vx + K[cc] @ x + D[ci] @ v + K[ci] @ q
    if across is not None:
        force = np.vstack([force + across[:, :c].T @ p, across[:, :c] @ x + across[:, c:] @ q])

    after, inputs = np.vstack([q, v, x, vx]), c + w
    keep = _remembered(after, force, inputs)
    kept = after[keep]
    return kept[:, inputs:][:, keep], kept[:, :inputs], force[:, inputs:][:, keep], force[:, :inputs]


def _quarters(c: int) -> tuple[tuple[slice, slice], ...]:
    contact, inner = slice(None, c), slice(c, None)
    return (contact, contact), (contact, inner), (inner, contact), (inner, inner)


def _remembered(after: Array, force: Array, inputs: int) -> NDArray[np.intp]:
    """Indices of the states that reach the outputs now or later: the others need not be stored."""
    reads = after[:, inputs:] != 0
    used = (force[:, inputs:] != 0).any(axis=0)
    for _ in range(used.size):
        used = used | reads[used].any(axis=0)
    return np.flatnonzero(used)
