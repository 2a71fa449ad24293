"""What is asked of Q at every frequency of the circle, in one environment: inequalities between Hermitian matrices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from controller.lti import Array, Lti
from design.frequency.sweep import frequencies, hermitian, on_circle, peaks
from design.jitter.condition import blocks
from design.parameter.cone_program import Block, Complex
from design.parameter.free_parameter import GivenParameter, Response, affine, bordered, loop_force

CLOSED_LOOP, SWITCHING = "the closed-loop condition", "the condition for switching delays"


class Parameter(Protocol):
    """Q with or without unknowns."""

    @property
    def size(self) -> int:
        """The number of unknowns."""
        ...

    def at(self, z: Complex) -> Response:
        """Q(z): what it is and how it changes with the unknowns."""
        ...


@dataclass(frozen=True, eq=False)
class Inequality:
    """block(w, Q) + sum_e y_e shared[e] >= 0 for every w in [grid[0], grid[-1]]; it is imposed at some of them first.

    `shared` names the further unknowns y that enter it, each with a matrix that is the same at all frequencies.
    """

    name: str
    block: Callable[[Array, Parameter], Block]
    imposed: Array  # (k,) [rad/sample]
    grid: Array  # where it is swept [rad/sample]
    shared: Mapping[str, Array] = field(default_factory=dict)  # name -> (r, r)

    def unknowns(self, w: Array, Q: Parameter, names: Sequence[str]) -> Block:
        """The inequality at w in the unknowns of Q followed by the shared ones of these names."""
        block = self.block(w, Q)
        more = [self.shared.get(name, np.zeros(block.constant.shape[1:])) for name in names]
        columns = [np.broadcast_to(matrix.astype(complex), block.constant.shape)[:, None] for matrix in more]
        return Block(block.constant, np.concatenate([block.slope, *columns], axis=1))

    def missed(self, given: GivenParameter, shared: Mapping[str, float], slack: float) -> Array:
        """Where it fails by more than `slack` for a given Q and given shared unknowns [rad/sample]."""
        offset = sum((shared[name] * matrix for name, matrix in self.shared.items()), np.zeros(()))

        def shortage(w: Array) -> Array:
            return -np.linalg.eigvalsh(self.block(w, given).constant + offset)[:, 0]

        return peaks(shortage, self.grid, slack)


@dataclass(frozen=True, eq=False)
class World:
    """One environment with the delays around it."""

    environment: Lti  # E
    theta: tuple[int, ...]  # (m,) [samples]
    psi: tuple[int, ...]  # (m,) [samples]
    lam: tuple[int, ...]  # (m,) [samples]

    @property
    def T(self) -> float:
        return self.environment.T

    def delayed(self, z: Complex) -> Complex:
        """Psi E."""
        return late(self.psi, z) * self.environment.at(z)

    def force(self, z: Complex, Q: Parameter) -> Response:
        """F = Theta (Psi E - Psi E Q Psi E)."""
        constant, slope = loop_force(self.delayed(z), Q.at(z))
        theta = late(self.theta, z)
        return theta * constant, theta[:, None] * slope

    def mismatch(self, z: Complex, Q: Parameter) -> Response:
        """M = F - Lambda E (8)."""
        constant, slope = self.force(z, Q)
        return constant - late(self.lam, z) * self.environment.at(z), slope

    def size(self, z: Complex) -> Array:
        """sigma_max(E), (k,)."""
        return np.linalg.norm(self.environment.at(z), 2, axis=(1, 2))


def late(steps: Sequence[int], z: Complex) -> Complex:
    """z^-n of each channel, as factors of the rows of a matrix, shape (k, m, 1)."""
    return z[:, None, None] ** -np.array(steps)[:, None]


def passivity(world: World, delta: Array) -> Inequality:
    """I + root He[F/(z-1)] root >= 0 with root = (T/delta)^(1/2): the closed-loop condition for dampings `delta`."""
    root = np.sqrt(world.T / delta)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        over = root / (z - 1)[:, None, None]
        return affine(world.force(z, Q), np.eye(delta.size), lambda F: root[:, None] * F * over)

    return Inequality(CLOSED_LOOP, block, _imposed(world, 40), _swept(world))


def stable_compliance(world: World, least: float) -> Inequality:
    """He[I - Psi E Q] >= least, so that (I - Psi E Q)^-1, and with it V, is stable."""

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        E = world.delayed(z)
        constant, slope = Q.at(z)
        eye = (1 - least) * np.eye(E.shape[-1])
        return Block(eye - hermitian(E @ constant), -hermitian(E[:, None] @ slope))

    return Inequality("a stable V", block, _imposed(world, 10), _swept(world))


def high_frequency_limit(world: World, gain: float, above_hz: float) -> Inequality:
    """sigma_max(F) <= gain sigma_max(E) above a frequency [Hz]."""
    low = min(2 * np.pi * above_hz * world.T, np.pi)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        return _bordered(np.eye(world.environment.inputs), world.force(z, Q), gain * world.size(z))

    imposed = np.linspace(low, np.pi, 12)
    return Inequality(f"the limit above {above_hz:g} Hz", block, imposed, _swept(world, low=low))


def switching(world: World, delta: Array, lo: Sequence[int], hi: Sequence[int]) -> Inequality:
    """The condition of design.jitter for forces whose ages switch within [lo, hi] [samples], scaled to Delta_D/T = I.

    Its multiplier, one number per channel for all frequencies, is a shared unknown.
    """
    m, root = delta.size, np.sqrt(world.T / delta)
    none = np.zeros(m)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        constant, slope = loop_force(world.delayed(z), Q.at(z))
        constant, slope = root[:, None] * constant * root, root[:, None] * slope * root
        own = blocks(z, constant, none, lo, hi, np.ones(m), 1.0)
        each = [blocks(z, slope[:, j], none, lo, hi, none, 1.0) for j in range(slope.shape[1])]
        return Block(own, np.stack(each, axis=1) if each else np.zeros((z.size, 0, 2 * m, 2 * m), dtype=complex))

    def multiplier(unit: Array) -> Array:
        return blocks(np.array([-1.0 + 0j]), np.zeros((1, m, m), dtype=complex), unit, lo, hi, none, 1.0)[0].real

    shared = {f"alpha {i + 1}": multiplier(unit) for i, unit in enumerate(np.eye(m))}
    return Inequality(SWITCHING, block, _imposed(world, 40), _swept(world), shared)


BOUND = "bound"  # the shared unknown that a sup objective minimises


def bounded_mismatch(world: World, band: Array) -> Inequality:
    """sigma_max(M) <= bound sigma_max(E) over the band."""
    m = world.environment.inputs

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        return _bordered(np.zeros((m, m)), world.mismatch(z, Q), world.size(z))

    return Inequality("the mismatch", block, band[::4], band, {BOUND: np.eye(2 * m)})


def _bordered(diagonal: Array, response: Response, scale: Array) -> Block:
    """[[diagonal, R/scale], [(R/scale)*, diagonal]] >= 0: for diagonal = I, sigma_max(R) <= scale (k,)."""
    value, slope = response
    by = 1 / scale[:, None, None]
    return Block(bordered(diagonal, value * by), bordered(np.zeros_like(diagonal), slope * by[:, None]))


def static_stiffness(world: World, Q: Parameter) -> Block | None:
    """F(1) >= 0 on the directions that cost static force; None where no direction does."""
    E1 = world.environment.dc()
    values, vectors = np.linalg.eigh((E1 + E1.T) / 2)
    kept = values > 1e-9 * max(float(values.max()), float(np.abs(world.environment.D).max()))
    if not kept.any():
        return None
    root = vectors[:, kept] * np.sqrt(values[kept])
    constant, slope = Q.at(np.ones(1, dtype=complex))
    eye = np.eye(root.shape[1])
    return Block(eye - hermitian(root.T @ constant @ root), -hermitian(root.T @ slope @ root))


def _imposed(world: World, points: int) -> Array:
    return frequencies(world.environment, low=1e-3, points=points)


def _swept(world: World, low: float = 1e-6) -> Array:
    return frequencies(world.environment, low=low, points=2000)
