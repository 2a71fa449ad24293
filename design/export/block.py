"""What is exported: one state-space block, the order in which its sums are taken, and a test vector in that order.

A tick is y = C z + D u, z+ = A z + B u. Every entry of y and of z+ is one sum in double precision that starts at 0.0
and adds, one rounded product after another, the states z_0, z_1, .. and then the inputs u_0, u_1, ..: an order that
every language can keep, so that an exported block repeats its test vector to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from controller.coupling import compliance
from controller.environment import environment
from controller.lti import Array, Lti
from controller.process import force_map
from design.store import Loop, Stored

TICKS = 64  # of a test vector: longer than the delays and the fast modes of a loop


@dataclass(frozen=True)
class Signal:
    """One side of a block: m numbers of one kind."""

    letter: str
    what: str  # with its unit
    size: float  # of a test vector's numbers, in that unit


FORCE = Signal("f", "force [N]", 1.0)
DISPLACEMENT = Signal("x", "displacement [m]", 1e-3)
GIVEN_WAY = Signal("d", "displacement [m]", 1e-3)


@dataclass(frozen=True, eq=False)
class Block:
    """A square block that runs once per sampling period, from rest."""

    name: str  # "coupling" | "process"
    system: Lti  # at least one state
    input: Signal
    output: Signal
    about: tuple[str, ...]  # what it is, one line each


@dataclass(frozen=True, eq=False)
class Trial:
    """A test vector."""

    inputs: Array  # (TICKS, m)
    outputs: Array  # (TICKS, m)


class NothingToExport(ValueError):
    """The coupling has no block of the kind that was asked for."""


def coupling_block(stored: Stored) -> Block:
    """V(z), force to displacement. Raises NothingToExport where the coupling is no V in feedback."""
    V = compliance(stored.coupling.build(stored.loop.T), stored.loop.T)
    if V is None:
        raise NothingToExport("this coupling is no V in feedback around the environment; the whole process can be had")
    about = ("d = V f: what the coupling gives way by. In its loop the environment sees u = x - d, and f = Psi E u.",)
    return Block("coupling", with_a_state(V), FORCE, GIVEN_WAY, about)


def process_block(stored: Stored, with_theta: bool = True) -> Block:
    """F(z) (6), device displacements to forces; Theta is left out where the link to the devices is the delay."""
    loop = stored.loop
    theta = loop.theta if with_theta else (0,) * len(loop.theta)
    E = environment(loop.environment, loop.T)
    F = force_map(E, stored.coupling.build(loop.T), theta, loop.psi)
    about = (
        "f = F x: the whole discrete process; the devices get -f, held for T. Forces are not limited here.",
        _delays(loop, with_theta),
    )
    return Block("process", with_a_state(F), DISPLACEMENT, FORCE, about)


def with_a_state(system: Lti) -> Lti:
    """The same block, with a state that stays zero where it has none: C has no empty arrays."""
    if system.order:
        return system
    m = system.inputs
    return Lti(np.zeros((1, 1)), np.zeros((1, m)), np.zeros((system.outputs, 1)), system.D, system.T)


def trial(block: Block, seed: int = 0) -> Trial:
    """Normally distributed inputs and the outputs that `sequential` gives."""
    rng = np.random.default_rng(seed)
    inputs = block.input.size * rng.standard_normal((TICKS, block.system.inputs))
    return Trial(inputs, sequential(block.system, inputs))


def sequential(system: Lti, inputs: Array) -> Array:
    """Outputs (ticks, p) for inputs (ticks, m), from rest, every sum in the order that the module states."""
    rows = np.block([[system.C, system.D], [system.A, system.B]])
    z, outputs = np.zeros(system.order), []
    for u in inputs:
        sums = np.zeros(len(rows))
        for column, value in zip(rows.T, [*z, *u], strict=True):
            sums = sums + column * value
        outputs.append(sums[: system.outputs])
        z = sums[system.outputs :]
    return np.array(outputs)


def data(block: Block, test: Trial) -> dict[str, Any]:
    """The block as plain data, for JSON."""
    system = block.system
    return {
        "what": block.name,
        "about": list(block.about),
        "T_s": system.T,
        "input": block.input.what,
        "output": block.output.what,
        **{name: getattr(system, name).tolist() for name in "ABCD"},
        "test_input": test.inputs.tolist(),
        "test_output": test.outputs.tolist(),
    }


def _delays(loop: Loop, with_theta: bool) -> str:
    def shown(steps: Sequence[int]) -> str:
        return ", ".join(map(str, steps))

    theta = "included" if with_theta else "NOT included: the link to the devices must be that delay"
    return f"delays in samples: environment psi = {shown(loop.psi)}, transmission theta = {shown(loop.theta)} ({theta})"
