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

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from controller.contact import Contact, State
from controller.coupling import Coupling
from controller.delay import HeldLine, Ticks, delay, packet_delays
from controller.lti import Array, Lti, frozen


def force_map(environment: Lti, coupling: Coupling, theta: Sequence[int], psi: Sequence[int]) -> Lti:
    """F = Theta (I + Psi E V)^-1 Psi E (6): displacements to forces, as the devices see them."""
    delayed = delay(psi, environment.T) @ environment
    return delay(theta, environment.T) @ coupling.around(delayed)


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


class Tape:
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
