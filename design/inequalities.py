"""What is asked of Q at every frequency of the circle, in one environment: inequalities between Hermitian matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from controller.delay import delay
from controller.lti import Array, Lti
from design.cone_program import Block, Complex
from design.free_parameter import GivenParameter, Response, affine, bounded, loop_force
from design.sweep import frequencies, hermitian, on_circle, peaks


class Parameter(Protocol):
    """Q with or without unknowns."""

    def at(self, z: Complex) -> Response:
        """Q(z): what it is and how it changes with the unknowns."""
        ...


@dataclass(frozen=True, eq=False)
class Inequality:
    """block(w, Q) >= 0 for every w in [grid[0], grid[-1]]; it is imposed at some of them first."""

    name: str
    block: Callable[[Array, Parameter], Block]
    imposed: Array  # (k,) [rad/sample]
    grid: Array  # where it is swept [rad/sample]

    def missed(self, given: GivenParameter, slack: float) -> Array:
        """Where it fails by more than `slack` for a given Q [rad/sample]."""

        def shortage(w: Array) -> Array:
            return -np.linalg.eigvalsh(self.block(w, given).constant)[:, 0]

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
        return delay(self.psi, self.T).at(z) @ self.environment.at(z)

    def force(self, z: Complex, Q: Parameter) -> Response:
        """F = Theta (Psi E - Psi E Q Psi E)."""
        constant, slope = loop_force(self.delayed(z), Q.at(z))
        theta = delay(self.theta, self.T).at(z)
        return theta @ constant, theta[:, None] @ slope

    def mismatch(self, z: Complex, Q: Parameter) -> Response:
        """M = F - Lambda E (8)."""
        constant, slope = self.force(z, Q)
        return constant - delay(self.lam, self.T).at(z) @ self.environment.at(z), slope

    def size(self, z: Complex) -> Array:
        """sigma_max(E), (k,)."""
        return np.linalg.norm(self.environment.at(z), 2, axis=(1, 2))


def passivity(world: World, delta: Array) -> Inequality:
    """I + root He[F/(z-1)] root >= 0 with root = (T/delta)^(1/2): the closed-loop condition for dampings `delta`."""
    root = np.sqrt(world.T / delta)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        over = root / (z - 1)[:, None, None]
        return affine(world.force(z, Q), np.eye(delta.size), lambda F: root[:, None] * F * over)

    return Inequality("the closed-loop condition", block, _imposed(world, 80), _swept(world))


def stable_compliance(world: World, least: float) -> Inequality:
    """He[I - Psi E Q] >= least, so that (I - Psi E Q)^-1, and with it V, is stable."""

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        E = world.delayed(z)
        constant, slope = Q.at(z)
        eye = (1 - least) * np.eye(E.shape[-1])
        return Block(eye - hermitian(E @ constant), -hermitian(E[:, None] @ slope))

    return Inequality("a stable V", block, _imposed(world, 40), _swept(world))


def high_frequency_limit(world: World, gain: float, above_hz: float) -> Inequality:
    """sigma_max(F) <= gain sigma_max(E) above a frequency [Hz]."""
    low = min(2 * np.pi * above_hz * world.T, np.pi)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        return bounded(world.force(z, Q), gain * world.size(z))

    imposed = np.linspace(low, np.pi, 24)
    return Inequality(f"the limit above {above_hz:g} Hz", block, imposed, _swept(world, low=low))


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


def _swept(world: World, low: float = 1e-5) -> Array:
    return frequencies(world.environment, low=low, points=2000)
