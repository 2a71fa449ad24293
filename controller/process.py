"""What the computer does every T seconds, and when.

        tick k, at time kT
          1  x = encoder positions, sampled                (the plant's state just before kT)
          2  u = x - V f_e ;  f_e = Psi E u                (the algebraic loop was solved at construction)
          3  f = Theta f_e
          4  hold -clip(f, +-force_limit) on the actuators, advance the plant by T
          5  commit the discrete states                    (the plant's state just after kT)

With theta = 0 the force computed from x[k] acts during [kT, (k+1)T); with theta = 1, one period later.
Steps 2, 3 and 5 are linear: they are ONE state-space block, and a tick is one matrix product
[f; z+] = [C D; A B] [z; x] for any number of simulations at once. Saturation is what the actuators do.
Where delays vary, Theta is not in the block: its forces pass through a line that holds (controller.delay).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from controller.coupling import Coupling
from controller.delay import HeldLine, Ticks, delay, packet_delays
from controller.environment import Network, Wall, walled_environment
from controller.lti import Array, Lti, SingularLoop, frozen

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
    w = len(network.walls)

    def late(steps: Sequence[int]) -> Lti:
        return Lti.diag(delay(steps, T), Lti.constant(np.eye(w), T))

    coupled = coupling.around(late(psi) @ walled_environment(network, T), further=w)
    return Contact(late(theta) @ coupled, network.walls)


@dataclass(frozen=True, eq=False)
class Complementarity:
    """p >= 0, M p - q >= 0, p'(M p - q) = 0: one solution for every q if M has positive principal minors.

    Raises SingularLoop where it has not.
    """

    M: Array  # (w, w)

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        _ = self._candidates

    def solve(self, q: Array) -> Array:
        """p for every column of q, (w, nsim)."""
        diagonal = self._diagonal
        if self._separate:
            return np.maximum(q, 0.0) / diagonal
        forces = (self._candidates @ q).reshape(-1, *q.shape)
        # rounding leaves the right set some 1e-16 short of either sign, every other set more
        short = np.minimum(forces * diagonal, np.matmul(self.M, forces) - q).min(axis=1)
        best = np.take_along_axis(forces, short.argmax(axis=0)[None, None, :], axis=0)[0]
        return np.maximum(best, 0.0)

    @cached_property
    def _diagonal(self) -> Array:
        return np.diag(self.M)[:, None].copy()

    @cached_property
    def _separate(self) -> bool:
        """Whether no wall's force moves another wall within the tick."""
        return np.count_nonzero(self.M - np.diag(np.diag(self.M))) == 0

    @cached_property
    def _candidates(self) -> Array:
        """q to p, if exactly the walls of a set push: for every set, stacked, (2^w w, w)."""
        w, maps = len(self.M), []
        for pushing in itertools.product((False, True), repeat=w):
            chosen = np.ix_(pushing, pushing)
            part, inverse = self.M[chosen], np.zeros((w, w))
            if not np.linalg.det(part / np.abs(self.M).max(initial=1e-300)) > 0:
                which = [i + 1 for i, on in enumerate(pushing) if on]
                raise SingularLoop(f"the forces of walls {which} are not determined: {part.tolist()}")
            inverse[chosen] = np.linalg.inv(part)
            maps.append(inverse)
        return np.concatenate(maps)


@dataclass(frozen=True, eq=False)
class Process:
    """The linear block F with what wraps around it: force limits, encoder steps, and delays that vary."""

    F: Lti
    force_limit: Array  # (m,) [N], inf where there is none
    encoder_step: Array  # (m,) [m], 0 for an ideal encoder
    contact: Contact | None = None  # walls that F, which knows them open, is joined with
    delays: Ticks | None = None  # (ticks, m, nsim or 1) of every packet behind F [samples]; None where none varies

    def __post_init__(self) -> None:
        for name in ("force_limit", "encoder_step"):
            value = frozen(getattr(self, name), 1, name)
            object.__setattr__(self, name, value)
            if value.shape != (self.F.inputs,):
                raise ValueError(f"{name} has {value.size} entries for {self.F.inputs} channels")
        if not (self.force_limit > 0).all():
            raise ValueError(f"force_limit is {self.force_limit.tolist()}, expected positive forces in N")
        if not ((self.encoder_step >= 0) & (self.encoder_step < np.inf)).all():
            raise ValueError(f"encoder_step is {self.encoder_step.tolist()}, expected steps >= 0 in m")
        if self.delays is not None:
            object.__setattr__(self, "delays", packet_delays(self.delays))
            if self.delays.shape[1] != self.F.outputs:
                raise ValueError(f"delays have {self.delays.shape[1]} channels, expected {self.F.outputs}")

    @property
    def channels(self) -> int:
        return self.F.inputs

    def measured(self, x: Array) -> Array:
        """Positions (.., m) as the encoders give them: rounded to whole steps, or x itself where none is coarse."""
        coarse = self.encoder_step > 0
        if not coarse.any():
            return x
        step = np.where(coarse, self.encoder_step, 1.0)
        return np.where(coarse, np.round(x / step) * step, x)

    def frozen(self) -> dict[State, Lti]:
        """The linear force maps that the process switches between, by the walls that touch: F alone without walls."""
        return self.contact.frozen() if self.contact else {(): self.F}

    def transition(self) -> Callable[[Array, Array], object]:
        """Writes [f; z+] of a tick, (m + order, nsim), given its [z; x], (order + m, nsim)."""
        if self.contact:
            return self.contact.transition()
        return np.block([[self.F.C, self.F.D], [self.F.A, self.F.B]]).dot


class StepBuffer:
    """The record of a stretch of ticks, laid out so that the loop writes it without copying.

    A row holds [z, s, w, f] of one tick for all simulations: process state, plant state (whose first
    `channels` entries are the measured positions x), outside forces, and forces fed back; the next row
    begins with z+. So [z, x] is the tick's input, [f, z+] its output and [w, f] the plant's input, each one
    contiguous slab of memory.
    """

    def __init__(self, process: Process, ticks: int, plant_states: int, outside: int = 0, nsim: int = 1) -> None:
        nz, m = process.F.order, process.channels
        if plant_states < m:
            raise ValueError(f"plant_states is {plant_states}, but the first {m} entries must be the positions")
        self.ticks = ticks
        self.process = process
        width = nz + plant_states + outside + m
        self._memory = np.zeros(((ticks + 1) * width, nsim))
        rows = self._memory.reshape(ticks + 1, width, nsim)
        #: (ticks + 1, entries, nsim): the last row holds only what the last tick left behind
        self.z, self.s, self.w, self.f = np.split(rows, np.cumsum([nz, plant_states, outside]), axis=1)
        self.x = self.s[:, :m]

        # views are made once: making one costs as much as a small product
        def slabs(first: int, size: int) -> list[Array]:
            starts = range(first, first + ticks * width, width)
            return [self._memory[start : start + size] for start in starts]

        self.plant_state = [*slabs(nz, plant_states), self._memory[ticks * width + nz :][:plant_states]]
        self.plant_input = slabs(nz + plant_states, outside + m)
        self.force = slabs(width - m, m)
        self.plant_row = slabs(nz, plant_states + outside + m)
        self._input = slabs(0, nz + m)
        self._output = slabs(width - m, m + nz)
        self._transition = process.transition()
        self._quantised = bool((process.encoder_step > 0).any())
        self._line = None if process.delays is None else HeldLine(process.delays, nsim)
        self._rewound = 0  # ticks before row 0

    def tick(self, k: int) -> None:
        """Steps 1, 2, 3 and 5 for row k, whose plant state has been written: f[k] and z[k + 1]."""
        self._transition(self.seen(k), self._output[k])
        if self._line is not None:
            self._line.carry(self._rewound + k, self.force[k])

    def seen(self, k: int) -> Array:
        """[z; x] of row k with x as the encoders give it, (order + m, nsim); the plant's own positions stay."""
        row = self._input[k]
        if not self._quantised:
            return row
        m = self.process.channels
        return np.concatenate([row[:-m], self.process.measured(row[-m:].T).T])

    def saturate(self, ticks: int) -> None:
        """Turn the forces of the first `ticks` rows from asked for into applied, as the actuators did."""
        limit = self.process.force_limit[:, None]
        np.clip(self.f[:ticks], -limit, limit, out=self.f[:ticks])

    def rewind(self, ticks: int) -> None:
        """Start a new stretch where this one stood after `ticks` ticks."""
        self.z[0] = self.z[ticks]
        self.s[0] = self.s[ticks]
        self._rewound += ticks
