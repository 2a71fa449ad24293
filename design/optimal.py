"""The best linear coupling under the closed-loop condition: one convex problem in Q.

F = Theta (Psi E - Psi E Q Psi E) is affine in Q, so the mismatch and He[F/(z-1)] > -Delta_D/T are convex in its
coefficients. The inequalities hold at every frequency of the circle: they are imposed at a few, the solution is swept
densely, and the frequencies where it fails are added until it does not (cutting planes). What is returned passes
the refined sweep of design.margin, whatever a solver said.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from controller.coupling import InternalModel
from controller.lti import Array
from controller.process import force_map
from design.cone_program import Block, ConeProgram, vectors
from design.cone_solver import solve_cones
from design.failure import DesignFailed, Infeasible
from design.free_parameter import FreeParameter, GivenParameter, Response, bordered
from design.inequalities import (
    Inequality,
    World,
    high_frequency_limit,
    passivity,
    stable_compliance,
    static_stiffness,
)
from design.margin import closed_loop
from design.result import Design
from design.specification import Specification
from design.sweep import frequencies, on_circle
from design.transparency import BAND_HZ, transparency

OBJECTIVES = ("rms", "sup")
FILTERS = ("auto", "fir", "slow")
MARGIN = 0.005  # share of the damping that stays unused
SLACK = 0.1 * MARGIN  # what an inequality may miss between the frequencies where it is imposed
PASSIVE_SHARE = 0.02  # He[I - Psi E Q] keeps this much
HIGH_HZ, HIGH_GAIN = 100.0, 1.5  # above this frequency the devices feel at most so many times the environment
MOST_ROUNDS = 15
FLAT = 1e-8  # directions of Q that change the loop by less than this, relatively, are left at zero
SLOWEST, FASTEST = 0.992, 0.5  # poles of a slow basis


@dataclass(frozen=True)
class Wish:
    """What is asked of Q. Raises ValueError naming the field that is wrong."""

    functions: int = 8  # basis functions per entry of Q: taps, where the filter is FIR
    filter: str = "auto"  # "fir", "slow": poles from 0.5 to 0.992; "auto": slow with theta >= 4 or psi >= 1
    diagonal: bool = True
    objective: str = "rms"  # "rms" or "sup" of the mismatch over the band, relative to the environment
    high_gain: float | None = HIGH_GAIN
    margin: float = MARGIN

    def __post_init__(self) -> None:
        if not 1 <= self.functions <= 200:
            raise ValueError(f"functions is {self.functions}, allowed are 1 to 200")
        if self.filter not in FILTERS:
            raise ValueError(f"filter is {self.filter!r}, allowed are {', '.join(FILTERS)}")
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective is {self.objective!r}, allowed are {', '.join(OBJECTIVES)}")
        if self.high_gain is not None and not self.high_gain >= 1:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not 0 < self.margin < 1:
            raise ValueError(f"margin is {self.margin}, expected a share of the damping between 0 and 1")

    def poles(self, spec: Specification) -> Array:
        """Poles of the basis, (functions - 1,)."""
        slow = self.filter == "slow" or (self.filter == "auto" and (max(spec.theta) >= 4 or any(spec.psi)))
        n = self.functions - 1
        return np.round(1 - np.geomspace(1 - FASTEST, 1 - SLOWEST, n), 6) if slow else np.zeros(n)


def design(spec: Specification, wish: Wish = Wish()) -> Design:
    """The coupling of the least mismatch, verified by the refined sweep of the condition.

    Raises Infeasible where no Q of this kind meets the condition, DesignFailed where none could be verified.
    """
    started = time.perf_counter()
    world = World(spec.environment, spec.theta, spec.psi, spec.lam)
    Q = FreeParameter(wish.poles(spec), spec.channels, wish.diagonal)
    coupling, rounds = cut(Q, wish, [world], np.asarray(spec.delta))
    F = force_map(spec.environment, coupling, spec.theta, spec.psi)
    requirement = closed_loop(F, spec.delta)
    if requirement.ratio > 1 - wish.margin + 2 * SLACK:
        raise DesignFailed(None, (), f"the optimum needs {requirement.ratio:.6f} of the damping when it is swept again")
    figures = transparency(F, spec.environment, spec.lam)
    value = figures.rms_mismatch if wish.objective == "rms" else figures.relative_mismatch
    wall = time.perf_counter() - started
    return Design(coupling, "closed-loop", wish.objective, value, requirement, rounds, wall)


def cut(Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array) -> tuple[InternalModel, int]:
    """(the optimum over all worlds, rounds of cutting planes): `worlds[0]` is where the mismatch is minimised."""
    inequalities = [passivity(world, delta * (1 - wish.margin)) for world in worlds]
    inequalities += [stable_compliance(world, PASSIVE_SHARE) for world in worlds]
    if wish.high_gain is not None:
        inequalities += [high_frequency_limit(world, wish.high_gain, HIGH_HZ) for world in worlds]
    statics = [block for block in (static_stiffness(world, Q) for world in worlds) if block is not None]
    imposed = [inequality.imposed for inequality in inequalities]
    for rounds in range(1, MOST_ROUNDS + 1):
        blocks = [i.block(w, Q) for i, w in zip(inequalities, imposed, strict=True)]
        coupling = Q.coupling(_optimum(Q, wish, worlds[0], [*blocks, *statics]))
        given = GivenParameter(coupling)
        missed = [inequality.missed(given, SLACK) for inequality in inequalities]
        if not any(w.size for w in missed):
            return coupling, rounds
        imposed = [np.union1d(w, more) for w, more in zip(imposed, missed, strict=True)]
    names = ", ".join(i.name for i, w in zip(inequalities, missed, strict=True) if w.size)
    raise DesignFailed(None, (), f"after {MOST_ROUNDS} rounds of cutting planes {names} still fails between frequencies")


def _optimum(Q: FreeParameter, wish: Wish, world: World, blocks: list[Block]) -> Array:
    """The coefficients x of least mismatch under the blocks, in coordinates where every direction counts alike."""
    w = band(world)
    mismatch, size = world.mismatch(on_circle(w), Q), world.size(on_circle(w))
    sup = wish.objective == "sup"
    A, b = _square(mismatch, np.linalg.norm(world.environment.at(on_circle(w)), axis=(1, 2)), w)
    basis = _coordinates([A, *(vectors(block.slope).swapaxes(1, 2).reshape(-1, Q.size) for block in blocks)])
    blocks = [block.changed(basis) for block in blocks]
    E = Q.asymmetry() @ basis
    n = basis.shape[1]
    if not sup:
        program = ConeProgram(A @ basis, b, np.zeros(n), tuple(blocks), E, np.zeros(E.shape[0]))
        return basis @ solve_cones(program, "the optimal coupling")
    bound = _within(mismatch, size, basis)
    last = np.eye(n + 1)[-1]
    program = ConeProgram(
        np.zeros((0, n + 1)),
        np.zeros(0),
        last,
        (*(_padded(block) for block in blocks), bound),
        np.hstack([E, np.zeros((E.shape[0], 1))]),
        np.zeros(E.shape[0]),
    )
    return basis @ solve_cones(program, "the optimal coupling")[:-1]


def band(world: World) -> Array:
    """Frequencies of the mismatch [rad/sample], dense around the environment's poles."""
    low, high = (2 * np.pi * world.T * f for f in BAND_HZ)
    return frequencies(world.environment, low=low, high=min(high, np.pi), points=80)


def _square(mismatch: Response, size: Array, w: Array) -> tuple[Array, Array]:
    """A and b with |A x - b|^2 the mean over log frequency of |M|_F^2/|E|_F^2."""
    log_w = np.log(w)
    share = np.zeros(w.size)
    share[1:] += np.diff(log_w) / 2
    share[:-1] += np.diff(log_w) / 2
    weight = np.sqrt(share / share.sum()) / size
    constant, slope = mismatch
    constant = (constant * weight[:, None, None]).ravel()
    slope = np.moveaxis(slope * weight[:, None, None, None], 1, -1).reshape(constant.size, -1)
    return np.vstack([slope.real, slope.imag]), -np.concatenate([constant.real, constant.imag])


def _coordinates(rows: list[Array]) -> Array:
    """(n, k): x = basis y makes the stacked rows orthonormal; flat directions are left out."""
    _, s, Vt = np.linalg.svd(np.linalg.qr(np.vstack(rows), mode="r"))
    kept = s > FLAT * s.max()
    return Vt[kept].T / s[kept]


def _padded(block: Block) -> Block:
    """The same inequality with one more unknown, the bound, which it does not know."""
    more = np.zeros_like(block.slope[:, :1]) if block.slope.shape[1] else np.zeros((block.constant.shape[0], 1, *block.constant.shape[1:]))
    return Block(block.constant, np.concatenate([block.slope, more], axis=1))


def _within(mismatch: Response, size: Array, basis: Array) -> Block:
    """sigma_max(M) <= t sigma_max(E), t the last unknown."""
    constant, slope = mismatch
    scale, m = 1 / size[:, None, None], constant.shape[-1]
    inner = np.einsum("kjab,jl->klab", slope * scale[:, None], basis)
    zero, one = np.zeros((m, m)), np.broadcast_to(np.eye(2 * m), (size.size, 1, 2 * m, 2 * m))
    return Block(bordered(zero, constant * scale), np.concatenate([bordered(zero, inner), one], axis=1))
