"""One-sided walls in the loop: the forces by which they push, and the states in which they touch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.complementarity import Complementarity
from controller.coupling import Coupling
from controller.environment import Network, Wall, walled_force_map
from controller.lti import Array, Lti

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


State = tuple[bool, ...]  # which walls touch


@dataclass(frozen=True, eq=False)
class Contact:
    """The linear block [x; p] -> [f; y] of a loop, and the walls that turn y into p.

    Its state is that of the block, then h [m], how deep each wall was pressed at the tick before.
    Raises SingularLoop where the walls' forces are not determined.
    """

    block: Lti  # m + w inputs and outputs
    walls: tuple[Wall, ...]

    def __post_init__(self) -> None:
        if not len(self.walls) <= min(self.block.inputs, self.block.outputs):
            raise ValueError(f"a block of {self.block.inputs} inputs cannot serve {len(self.walls)} walls")
        _ = self.problem

    @property
    def channels(self) -> int:
        return self.block.inputs - len(self.walls)

    @property
    def steepness(self) -> Array:
        """a = K + B/T of each wall, (w,) [N/m]."""
        return np.array([w.stiffness + w.damping / self.block.T for w in self.walls])

    @cached_property
    def problem(self) -> Complementarity:
        """What a tick solves for the wall forces."""
        m = self.channels
        return Complementarity(np.diag(1 / self.steepness) - self.block.D[m:, m:])

    @property
    def open(self) -> Lti:
        """F while no wall touches, with the state of the whole: h does not reach the force."""
        G, m, w = self.block, self.channels, len(self.walls)
        A, B = np.pad(G.A, ((0, w), (0, w))), np.pad(G.B[:, :m], ((0, w), (0, 0)))
        return Lti(A, B, np.pad(G.C[:m], ((0, 0), (0, w))), G.D[:m, :m], G.T)

    def frozen(self) -> dict[State, Lti]:
        """F of every contact state, without the gaps' constant forces; none touches in the first, all in the last."""
        m, T, walls = self.channels, self.block.T, range(len(self.walls))
        zero, one = np.zeros((1, 1)), np.ones((1, 1))
        stiff = [Lti(zero, one, w.damping / T * one, -(w.stiffness + w.damping / T) * one, T) for w in self.walls]
        none, maps = Lti.constant([[0.0]], T), {}
        for touching in itertools.product((False, True), repeat=len(self.walls)):
            back = Lti.diag(*[none] * m, *(stiff[i] if touching[i] else none for i in walls))
            G = self.block.feedback(back)
            maps[touching] = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], T)
        return maps

    def transition(self) -> Callable[[Array, Array], None]:
        """One tick for any number of simulations: see Process.transition."""
        G, m, w, F = self.block, self.channels, len(self.walls), self.open
        gap = np.array([wall.gap for wall in self.walls])[:, None]
        memory = (np.array([wall.damping for wall in self.walls]) / G.T / self.steepness)[:, None]
        linear = np.block([[F.C, F.D], [F.A, F.B]]).dot
        reach = np.block([G.C[m:], np.zeros((w, w)), G.D[m:, :m]]).dot
        kick, give = np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, w))]).dot, G.D[m:, m:].dot
        solve, depth = self.problem.solve, slice(G.order, G.order + w)

        def tick(before: Array, after: Array) -> None:
            way = reach(before) - gap  # into the walls, if these did not push
            force = solve(way - memory * before[depth])
            linear(before, after)
            after += kick(force)
            np.maximum(way + give(force), 0.0, out=after[-w:])

        return tick

    def depths(self, z: Array) -> Array:
        """h [m] at each tick but the last, (ticks - 1, w, ..), from the states at all of them, (ticks, order, ..)."""
        return z[1:, -len(self.walls) :]


def contact(network: Network, coupling: Coupling, theta: Sequence[int], psi: Sequence[int], T: float) -> Contact:
    """F of (6) with the walls of the network as further ports. Psi and Theta delay what the devices feel of them."""
    return Contact(walled_force_map(network, coupling, theta, psi, T), network.walls)
