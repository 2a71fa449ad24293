"""The law that a tick computes, from positions to forces: linear, but for one-sided walls that push."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from controller.complementarity import Complementarity
from controller.delay import delay
from controller.environment import Wall
from controller.lti import Array, Lti, ReadOnly

# ----------------------------------------------------------------------------------------------------
# Walls: springs that push and never pull, so that contact is made and broken.
#
# Across a wall of stiffness K and damping B the way into it is d = y - gap, and it pushes with
#
#         p[k] = max(0, K h[k] + B (h[k] - h[k-1])/T),    h = max(0, d),
#
# which is a ramp, p = a max(0, d - c) with a = K + B/T and c = B h[k-1] / (T a): continuous and monotone in d. It
# dissipates: p[k] (d[k] - d[k-1]) >= K h[k]^2/2 - K h[k-1]^2/2 for every d, whatever B. While a wall touches, it is
# the spring-damper between the same nodes, but for the constant force of its gap.
#
# The wall forces enter the linear block as further inputs and the ways are further outputs, y = y_free - D p: the
# environment and the coupling give way at once. So the algebraic loop of a tick is the linear complementarity problem
#
#         p >= 0,   s = (1/a + D) p - (y_free - gap - c) >= 0,   p's = 0,
#
# whose matrix has positive principal minors, since D is positive semidefinite for a passive environment and coupling:
# there is exactly one solution, and it is found by trying every set of touching walls.


Transition = Callable[[Array, Array], object]  # [z; x] (order + m, nsim) -> writes [f; z+] (m + order, nsim)
State = tuple[bool, ...]  # which walls touch


@dataclass(frozen=True, eq=False)
class Law(ReadOnly):
    """From positions to the forces that answer them, tick by tick: the linear block of a loop, and walls that push.

    `sent` is the block [x; p] -> [f_e; y] before Theta, and the walls turn y into p. The state is that of the block
    with its delays, then h [m], how deep each wall was pressed at the tick before.
    Raises SingularLoop where the walls' forces are not determined.
    """

    sent: Lti  # m + w inputs and outputs
    theta: tuple[int, ...] = ()  # (m,) delays of the forces behind it [samples]; none unless given
    walls: tuple[Wall, ...] = ()

    def __post_init__(self) -> None:
        G, w = self.sent, len(self.walls)
        object.__setattr__(self, "theta", tuple(self.theta) or (0,) * (G.inputs - w))
        if not G.inputs == G.outputs == self.channels + w > w:
            shape = f"{G.outputs} x {G.inputs}"
            raise ValueError(f"a block of {shape} cannot serve {self.channels} channels and {w} walls")
        if w:
            _ = self._problem

    @property
    def channels(self) -> int:
        return len(self.theta)

    @property
    def without_theta(self) -> Self:
        """The same with forces that are not delayed."""
        return replace(self, theta=(0,) * self.channels)

    @property
    def unlimited(self) -> Self:
        """The same for forces of any size."""
        return self

    @property
    def bounds(self) -> list[tuple[int, float]]:
        """Where [f; z+] holds a force that is limited before it is sent, and its limit [N], channel by channel."""
        return []

    def limited(self, z: Array, force: Array, most: Array) -> NDArray[np.bool_]:
        """Where forces (ticks, m, ..) were limited: here by the actuators, which have `most`, (m, ..) [N]."""
        return np.abs(force) >= most

    @property
    def steepness(self) -> Array:
        """a = K + B/T of each wall, (w,) [N/m]."""
        return np.array([w.stiffness + w.damping / self.sent.T for w in self.walls])

    @cached_property
    def _problem(self) -> Complementarity:
        """What a tick solves for the wall forces."""
        m = self.channels
        return Complementarity(np.diag(1 / self.steepness) - self.sent.D[m:, m:])

    def _delayed(self, block: Lti) -> Lti:
        T = block.T
        return Lti.diag(delay(self.theta, T), Lti.constant(np.eye(len(self.walls)), T)) @ block

    @cached_property
    def _block(self) -> Lti:
        """What a tick solves for put in, too: [x; p] -> [f; y]."""
        return self._delayed(self.sent)

    @cached_property
    def open(self) -> Lti:
        """F while no wall touches, with the state of the whole: h does not reach the force."""
        G, m, w = self._block, self.channels, len(self.walls)
        A, B = np.pad(G.A, ((0, w), (0, w))), np.pad(G.B[:, :m], ((0, w), (0, 0)))
        return Lti(A, B, np.pad(G.C[:m], ((0, 0), (0, w))), G.D[:m, :m], G.T)

    @property
    def linear(self) -> Array:
        """[f; z+] of a tick by its [z; x], (m + order, order + m), while no wall touches and no force is limited."""
        F = self.open
        return np.block([[F.C, F.D], [F.A, F.B]])

    def at_rest(self, x: Array) -> Array:
        """The state in which it rests with the displacements x (m,) [m] held, no wall touching."""
        return self.open.at_rest(x)

    def frozen(self) -> dict[State, Lti]:
        """F of every contact state, without the gaps' constant forces; none touches in the first, all in the last."""
        block, m, T, walls = self._delayed(self.sent), self.channels, self.sent.T, range(len(self.walls))
        if not self.walls:
            return {(): block}
        zero, one = np.zeros((1, 1)), np.ones((1, 1))
        stiff = [Lti(zero, one, w.damping / T * one, -(w.stiffness + w.damping / T) * one, T) for w in self.walls]
        none, maps = Lti.constant([[0.0]], T), {}
        for touching in itertools.product((False, True), repeat=len(self.walls)):
            back = Lti.diag(*[none] * m, *(stiff[i] if touching[i] else none for i in walls))
            G = block.feedback(back)
            maps[touching] = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], T)
        return maps

    def transition(self) -> Transition:
        """One tick for any number of simulations."""
        if not self.walls:
            return self.linear.dot
        G, m, w, F = self._block, self.channels, len(self.walls), self.open
        gap = np.array([wall.gap for wall in self.walls])[:, None]
        memory = (np.array([wall.damping for wall in self.walls]) / G.T / self.steepness)[:, None]
        linear = self.linear.dot
        reach = np.block([G.C[m:], np.zeros((w, w)), G.D[m:, :m]]).dot
        kick, give = np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, w))]).dot, G.D[m:, m:].dot
        solve, depth = self._problem.solve, slice(G.order, F.order)

        def tick(before: Array, after: Array) -> None:
            way = reach(before) - gap  # into the walls, if these did not push
            force = solve(way - memory * before[depth])
            linear(before, after)
            after += kick(force)
            np.maximum(way + give(force), 0.0, out=after[-w:])

        return tick

    def together(self, laws: Sequence[Law]) -> Transition:
        """One tick of one simulation each, of laws of this kind with as many states and walls."""
        if not self.walls:
            return side_by_side(laws)
        return one_by_one(laws) if len(self.walls) > 1 else _one_wall(laws)

    def depths(self, z: Array) -> Array:
        """h [m] at each tick but the last, (ticks - 1, w, ..), from the states at all of them, (ticks, order, ..)."""
        return z[1:, z.shape[1] - len(self.walls) :]


def side_by_side(laws: Sequence[Law]) -> Transition:
    """While all of them are linear."""
    blocks = last_axis([law.linear for law in laws])
    return lambda before, after: np.einsum("oin,in->on", blocks, before, out=after)


def one_by_one(laws: Sequence[Law]) -> Transition:
    """Whatever they are, in turn."""
    transitions = [law.transition() for law in laws]

    def together(before: Array, after: Array) -> None:
        column = np.empty((after.shape[0], 1))
        for i, transition in enumerate(transitions):
            transition(np.ascontiguousarray(before[:, i : i + 1]), column)
            after[:, i : i + 1] = column

    return together


def _one_wall(laws: Sequence[Law]) -> Transition:
    """The complementarity problem of one wall is p = max(0, q)/M."""
    m, blocks = laws[0].channels, [law._block for law in laws]
    linear, order = side_by_side(laws), blocks[0].order
    reach = last_axis([np.concatenate([G.C[m], [0.0], G.D[m, :m]]) for G in blocks])
    kick = last_axis([np.concatenate([G.D[:m, m], G.B[:, m], [0.0]]) for G in blocks])
    give, M = np.array([G.D[m, m] for G in blocks]), np.array([law._problem.M[0, 0] for law in laws])
    gap, damping = (np.array([getattr(law.walls[0], name) for law in laws]) for name in ("gap", "damping"))
    memory = damping / laws[0].sent.T / np.array([law.steepness[0] for law in laws])

    def together(before: Array, after: Array) -> None:
        way = np.einsum("in,in->n", reach, before) - gap
        force = np.maximum(way - memory * before[order], 0.0) / M
        linear(before, after)
        after += kick * force
        after[-1] = np.maximum(way + give * force, 0.0)

    return together


def last_axis(parts: Sequence[Array]) -> Array:
    """Arrays of one shape as one, along a last axis."""
    return np.ascontiguousarray(np.moveaxis(np.array(parts), 0, -1))
