"""A tape whose simulations have a process each: points of a map, stepped in one batch of an engine."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from controller.lti import Array
from controller.process import Process, Tape

Transition = Callable[[Array, Array], object]  # [z; x] (order + m, nsim) -> writes [f; z+] (m + order, nsim)


class ManyProcesses(Tape):
    """All processes have the same order, number of walls, force limits and encoder steps."""

    def __init__(self, processes: Sequence[Process], ticks: int, plant_states: int, outside: int) -> None:
        super().__init__(processes[0], ticks, plant_states, outside, len(processes))
        walls = len(processes[0].contact.walls) if processes[0].contact else 0
        self._together = _linear(processes) if walls == 0 else _one_wall(processes) if walls == 1 else _each(processes)

    def tick(self, k: int) -> None:
        self._together(self.seen(k), self._output[k])


def _linear(processes: Sequence[Process]) -> Transition:
    blocks = _last_axis([np.block([[p.F.C, p.F.D], [p.F.A, p.F.B]]) for p in processes])
    return lambda before, after: np.einsum("oin,in->on", blocks, before, out=after)


def _one_wall(processes: Sequence[Process]) -> Transition:
    """Contact.transition for one wall each, whose complementarity problem is p = max(0, q)/M."""
    contacts = [p.contact for p in processes if p.contact]
    m, order = contacts[0].channels, contacts[0].block.order
    linear = _linear(processes)
    reach = _last_axis([np.concatenate([c.block.C[m], [0.0], c.block.D[m, :m]]) for c in contacts])
    kick = _last_axis([np.concatenate([c.block.D[:m, m], c.block.B[:, m], [0.0]]) for c in contacts])
    give, M = np.array([c.block.D[m, m] for c in contacts]), np.array([c.problem.M[0, 0] for c in contacts])
    gap, damping = (np.array([getattr(c.walls[0], name) for c in contacts]) for name in ("gap", "damping"))
    memory = damping / contacts[0].block.T / np.array([c.steepness[0] for c in contacts])

    def together(before: Array, after: Array) -> None:
        way = np.einsum("in,in->n", reach, before) - gap
        force = np.maximum(way - memory * before[order], 0.0) / M
        linear(before, after)
        after += kick * force
        after[-1] = np.maximum(way + give * force, 0.0)

    return together


def _each(processes: Sequence[Process]) -> Transition:
    transitions = [process.transition() for process in processes]

    def together(before: Array, after: Array) -> None:
        column = np.empty((after.shape[0], 1))
        for i, transition in enumerate(transitions):
            transition(np.ascontiguousarray(before[:, i : i + 1]), column)
            after[:, i : i + 1] = column

    return together


def _last_axis(parts: Sequence[Array]) -> Array:
    return np.ascontiguousarray(np.moveaxis(np.array(parts), 0, -1))
