"""The tick: the steps of the computer every T seconds, and their order.

        tick k, at time kT
          1  x = encoder positions, sampled                (the plant's state just before kT)
          2  u = x - V f_e ;  f_e = Psi E u                (the algebraic loop was solved at construction)
          3  f = Theta f_e
          4  f = clip(f, +-force_limit); hold -f on the actuators, advance the plant to its state just before (k+1)T
          5  z = z+, the controller's states for the next tick

With theta = 0 the force computed from x[k] acts during [kT, (k+1)T); with theta = 1, one period later. Steps 2, 3 and 5
together are one linear state-space block, so that a tick is one matrix product [f; z+] = [C D; A B] [z; x] for any
number of simulations. Touching walls and limited forces (controller.law) add a small complementarity problem. With
varying delays Theta is not part of the block; the forces then pass through a delay line (controller.delay).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.budget import NetFigures
from haptic_loop.controller.delay import HeldLine, Ticks
from haptic_loop.controller.environment import Wall
from haptic_loop.controller.law import Law, Transition
from haptic_loop.controller.lti import Array, Lti, ReadOnly, frozen

RunBlock = Callable[[int], None]  # runs a number of ticks from row 0 of a `StepBuffer`

_PART = 128  # number of ticks whose rows fit into the cache
_ROUNDED = 1e-14  # relative rounding error of a force vector that was scaled to its limit
_CALM = 1 - 1e-9  # a force above this multiple of its limit may need the limiter


class Net(Protocol):
    """A passivity layer: a nonlinear step with memory between the law's forces and the devices.

    Every `StepBuffer` has its own net. At every tick `send` changes forces (m, nsim) [N] in place before the delays,
    and `apply` after them.
    """

    def send(self, x: Array, force: Array, /) -> None:
        """Change the forces before the delays; `x` (m, nsim) [m] are the measured positions."""
        ...

    def apply(self, k: int, force: Array, /) -> None:
        """Change the forces after the delays, at tick k."""
        ...

    def figures(self) -> NetFigures:
        """Return figures of the layer's action so far."""
        ...


@dataclass(frozen=True, eq=False)
class Process(ReadOnly):
    """A law with force limits, encoder steps, varying delays and a passivity layer."""

    law: Law  # with the constant delays of the loop
    force_limit: Array  # (m,) [N], inf without a limit
    encoder_step: Array  # (m,) [m], 0 for an ideal encoder
    delays: Ticks | None = None  # (ticks, m, nsim or 1) packet delays [samples] in place of Theta; None: constant
    net: Callable[[int], Net] | None = None  # makes a passivity layer for a number of simulations
    balls: tuple[slice, ...] = ()  # neighbouring channels with one limit for the length of their force vector

    def __post_init__(self) -> None:
        for name in ("force_limit", "encoder_step"):
            object.__setattr__(self, name, frozen(getattr(self, name), 1, name))
        if self.delays is not None:
            delays = np.array(self.delays, dtype=np.int64)
            delays.setflags(write=False)
            object.__setattr__(self, "delays", delays)

    @cached_property
    def ticked(self) -> Law:
        """The law of a tick, without Theta if forces are sent as packets."""
        return self.law if self.delays is None else self.law.without_theta

    @property
    def F(self) -> Lti:
        """The linear block of a tick in which no wall touches."""
        return self.ticked.open

    @property
    def linear(self) -> Array:
        """The matrix (m + order, order + m) from [z; x] to [f; z+], while no wall touches and no force is limited."""
        return self.ticked.linear

    @cached_property
    def channels(self) -> int:
        return self.law.channels

    @property
    def walls(self) -> tuple[Wall, ...]:
        return self.law.walls

    @property
    def unlimited(self) -> Process:
        """The process without limiter, force limits and encoder steps."""
        endless, ideal = np.full(self.channels, np.inf), np.zeros(self.channels)
        return replace(self, law=self.law.unlimited, force_limit=endless, encoder_step=ideal)

    def measured(self, x: Array) -> Array:
        """Return positions (.., m) rounded to whole encoder steps, or x itself if all encoders are ideal."""
        coarse = self.encoder_step > 0
        if not coarse.any():
            return x
        step = np.where(coarse, self.encoder_step, 1.0)
        return np.where(coarse, np.round(x / step) * step, x)

    def applied(self, force: Array, out: Array | None = None) -> Array:
        """Return forces (.., m, nsim) [N] clipped to limits of actuators and balls, in place if `out` is `force`."""
        high = self.force_limit[:, None]
        for ball in self.balls:  # A clipped vector keeps its direction.
            force = force if out is not None else force.copy()
            vector = force[..., ball, :]
            length = np.linalg.norm(vector, axis=-2, keepdims=True)
            limit = high[ball.start]
            np.multiply(vector, np.divide(limit, length, out=np.ones_like(length), where=length > limit), out=vector)
        return np.maximum(np.minimum(force, high, out=out), -high, out=out)


def at_limit(force: Array, force_limit: Array, balls: Sequence[slice] = ()) -> NDArray[np.bool_]:
    """Return whether each force (ticks, m, nsim) is at the limit (m,) [N] of its actuator or of its ball."""
    clipped = np.abs(force) >= force_limit[:, None]
    for ball in balls:
        length = np.linalg.norm(force[:, ball], axis=1, keepdims=True)
        clipped[:, ball] = length >= force_limit[ball.start] * (1 - _ROUNDED)
    return clipped


class StepBuffer:
    """The record of a block of ticks, in a layout that the loop writes without copying.

    A row holds [z, s, w, f] of one tick for all simulations: the states of process and plant, the external forces, and
    the forces fed back. The first `channels` entries of s are the positions x. The next row begins with z+. So the
    tick's input [z, x], its output [f, z+] and the plant's input [w, f] are contiguous in memory.
    """

    def __init__(
        self,
        process: Process,
        ticks: int,
        plant_states: int,
        outside: int = 0,
        nsim: int = 1,
        transition: Transition | None = None,  # None: that of the process's law
    ) -> None:
        nz, m = process.F.order, process.channels
        self.ticks = ticks
        self.process = process
        width = nz + plant_states + outside + m
        memory = np.zeros(((ticks + 1) * width, nsim))
        #: (ticks + 1, entries, nsim); the last row holds only the states after the last tick
        self.rows = rows = memory.reshape(ticks + 1, width, nsim)
        self.z, self.s, self.w, self.f = np.split(rows, np.cumsum([nz, plant_states, outside]), axis=1)
        self.x = self.s[:, :m]
        shifted = memory[width - m :][: ticks * width].reshape(ticks, width, nsim)
        #: (ticks, m + order, nsim): [f; z+] of each tick
        self.after = shifted[:, : m + nz]
        self._given = transition
        self._quantised = bool((process.encoder_step > 0).any())
        self._line = None if process.delays is None else HeldLine(process.delays, nsim)
        self.net = process.net(nsim) if process.net else None
        self.first = 0  # the tick of row 0
        self._straight = nsim == 1 and not (self._quantised or process.walls or self._line or self.net)
        #: Whether the next block first runs without limits (`linear_until` then checks its forces). This requires a
        #: single simulation without encoder steps, walls, packets and net. After a block that exceeded a limit the flag
        #: is False, until `rewind` finds all forces of a block below their limits.
        self.calm = self._straight
        bounds, most = process.ticked.bounds, process.force_limit.copy()
        for ball in process.balls:  # No vector within this box is longer than the limit.
            most[ball] /= (ball.stop - ball.start) ** 0.5
        most = most.tolist()
        within = bool(bounds) and self.net is None
        within &= all(limit <= largest for (_, limit), largest in zip(bounds, most, strict=False))
        #: whether a force may exceed the actuators' limits
        self.clips = not within and bool((process.force_limit < np.inf).any())
        if self.clips:
            bounds += enumerate(most)
        self._bounds = bounds if self._straight else []
        self._bounded = [(self.after[:, row, 0], limit) for row, limit in self._bounds]

    @cached_property
    def _transition(self) -> Transition:
        return self._given or self.process.ticked.transition()

    # Views are made once, and only if they are used, because making one takes as long as a small product.

    @cached_property
    def plant_state(self) -> list[Array]:
        """s of each row."""
        return list(self.s)

    @cached_property
    def force(self) -> list[Array]:
        """f of each row."""
        return list(self.f)

    @cached_property
    def plant_row(self) -> list[Array]:
        """[s; w; f] of each row."""
        return list(self.rows[:, self.z.shape[1] :])

    @cached_property
    def law_input(self) -> list[Array]:
        """[z; x] of each row."""
        return list(self.rows[:, : self.z.shape[1] + self.process.channels])

    @cached_property
    def law_output(self) -> list[Array]:
        """[f; z+] of each tick."""
        return list(self.after)

    def linear_until(self, ticks: int, most: float = 1.0) -> int:
        """Return the first of `ticks` ticks in which a force is nan or above `most` times its limit, else `ticks`."""
        for forces, limit in self._bounded:
            sent, limit = forces[:ticks], most * limit
            if not (sent.max() <= limit and sent.min() >= -limit):
                within = [np.abs(forces[:ticks]) <= most * limit for forces, limit in self._bounded]
                return int(np.all(within, axis=0).argmin())
        return ticks

    def tick(self, k: int) -> None:
        """Write f[k] and z[k + 1] from the plant state of row k: all steps of a tick but the plant's."""
        seen = self.seen(k)
        self._transition(seen, self.law_output[k])
        if self.net is not None:
            self.net.send(seen[-self.process.channels :], self.force[k])
        if self._line is not None:
            self._line.carry(self.first + k, self.force[k])
        if self.net is not None:
            self.net.apply(self.first + k, self.force[k])
        if self.clips:
            self.process.applied(self.force[k], self.force[k])

    def seen(self, k: int) -> Array:
        """Return [z; x] (order + m, nsim) of row k with measured x; the plant's own positions do not change."""
        row = self.law_input[k]
        if not self._quantised:
            return row
        m = self.process.channels
        return np.concatenate([row[:-m], self.process.measured(row[-m:].T).T])

    def rewind(self, ticks: int) -> None:
        """Start a new block from the states after the first `ticks` ticks of this one."""
        self.calm = self.calm or (self._straight and self.linear_until(ticks, _CALM) == ticks)
        self.z[0] = self.z[ticks]
        self.s[0] = self.s[ticks]
        self.first += ticks


class FusedTicks:
    """Compute the plant's step and the law of the next tick as one matrix product with the result [f; z+; s].

    A row of the memory contains [w, f, z+, s, a] of one tick. The engine (sim.engines) sets the accelerations a, and
    the next s is A s + B [w; f] + G a. Without B the product uses only [z+, s, a].
    """

    def __init__(self, buffer: StepBuffer, A: Array, B: Array | None = None, G: Array | None = None) -> None:
        law, outside, states = buffer.process.linear, buffer.w.shape[1], len(A)
        m, nz = buffer.process.channels, buffer.process.F.order
        B, G = (np.empty((states, 0)) if part is None else part for part in (B, G))
        step = np.hstack([B, np.zeros((states, nz)), A, G])
        seen = np.vstack([np.eye(nz, step.shape[1], B.shape[1]), step[:m]])  # [z+; x] of the next tick
        self.product = np.vstack([law @ seen, step]).dot
        to_z, to_s, to_a = np.cumsum([outside + m, nz, states]).tolist()
        memory = np.zeros((min(_PART, buffer.ticks) + 1, to_a + G.shape[1]))
        self.before, self.next = list(memory[:, to_z - B.shape[1] :]), list(memory[1:, outside:to_a])
        self._numbers, self._row, self._ends = memory.ravel().data, memory.shape[1], (to_z, to_s, to_a)
        self._w, self._after, self._s = memory[:, :outside], memory[:, outside:to_s], memory[:, to_s:to_a]
        self._buffer, self._law = buffer, partial(law.dot, buffer.rows[0, : nz + m], buffer.after[0])

    def copied(self, n: int) -> tuple[list[memoryview], ...]:
        """Return memory views of [w, f] and a in each row, and of n positions and n velocities in the next row."""
        numbers, row, (to_z, to_s, to_a) = self._numbers, self._row, self._ends
        q = row + to_s
        ranges = (0, to_z), (to_a, row), (q, q + n), (q + n, q + 2 * n)
        return tuple([numbers[i + a : i + b] for i in range(0, len(numbers) - row, row)] for a, b in ranges)

    def parts(self, ticks: int) -> Iterator[int]:
        """Yield numbers of ticks to run from row 0 of the memory, until `ticks` rows of the buffer are written."""
        buffer, after, s = self._buffer, self._after, self._s
        self._law()
        after[0], s[0] = buffer.after[0, :, 0], buffer.s[0, :, 0]
        for first in range(0, ticks, _PART):
            count = min(_PART, ticks - first)
            self._w[:count] = buffer.w[first : first + count, :, 0]
            yield count
            buffer.after[first : first + count, :, 0] = after[:count]
            buffer.s[first + 1 : first + count + 1, :, 0] = s[1 : count + 1]
            after[0], s[0] = after[count], s[count]
