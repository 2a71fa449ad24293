"""A convex problem with inequalities at every frequency, solved by imposing them at a few and adding those that fail.

Each round minimises the mismatch with the inequalities where they are imposed so far, sweeps the solution densely,
and adds the peaks where one fails.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from controller.coupling import InternalModel
from controller.lti import Array
from design.failure import DesignFailed
from design.frequency.sweep import frequencies, on_circle
from design.parameter.cone_program import Block, ConeProgram, vectors
from design.parameter.cone_solver import solve_cones
from design.parameter.free_parameter import FreeParameter, GivenParameter
from design.parameter.inequalities import (
    BOUND,
    Inequality,
    Parameter,
    World,
    bounded_mismatch,
    high_frequency_limit,
    passivity,
    stable_compliance,
    static_stiffness,
    switching,
)
from design.parameter.wish import Wish
from design.transparency import BAND_HZ

SLACK = 5e-4  # what an inequality may miss between the frequencies where it is imposed
PASSIVE_SHARE = 0.02  # He[I - Psi E Q] keeps this much
HIGH_HZ = 100.0  # above it the devices feel at most Wish.high_gain times the environment
MOST_ROUNDS = 15
SPARSER = 6  # further worlds start with every sixth of the frequencies: most never bind
FLAT = 1e-8  # directions of Q that change the loop by less than this, relatively, are left at zero


def cut(Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array) -> tuple[InternalModel, int]:
    """(the optimum, rounds): what is asked holds in all worlds, the mismatch counts in all; `delta` (m,) in N s/m.

    The rms objective is the mean square over the worlds, the sup objective the worst of them.

    Raises Infeasible where the inequalities contradict each other, DesignFailed where they still fail after all rounds.
    """
    problem = Problem.of(Q, wish, worlds, delta)
    optimum, rounds = cut_problem(problem)
    return problem.Q.coupling(optimum.x), rounds


def cut_problem(problem: Problem, imposed: Sequence[Array] | None = None) -> tuple[Optimum, int]:
    """(the optimum with all the frequencies that had to be imposed, rounds), from these or the usual ones. As `cut`."""
    imposed, missed = imposed or [one.imposed for one in problem.inequalities], []
    for rounds in range(1, MOST_ROUNDS + 1):
        optimum = problem.optimum(imposed)
        given = GivenParameter(problem.Q.coupling(optimum.x))
        missed = [one.missed(given, optimum.shared, SLACK) for one in problem.inequalities]
        if not any(w.size for w in missed):
            return optimum, rounds
        imposed = [np.union1d(w, more) for w, more in zip(imposed, missed, strict=True)]
    names = ", ".join(one.name for one, w in zip(problem.inequalities, missed, strict=True) if w.size)
    raise DesignFailed(None, (), f"after {MOST_ROUNDS} rounds of cutting planes {names} still fails in between")


def sketch(
    Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array, without: Sequence[str] = ()
) -> InternalModel:
    """The optimum of the first round, which bounds the final one from below. Raises as `cut`.

    `without` names inequalities that are left out in all worlds, to learn whether they are in the way.
    """
    problem = Problem.of(Q, wish, worlds, delta)
    problem = replace(problem, inequalities=[one for one in problem.inequalities if one.name not in without])
    return Q.coupling(problem.optimum([one.imposed for one in problem.inequalities]).x)


@dataclass(frozen=True, eq=False)
class Optimum:
    """The solution with the inequalities at some frequencies."""

    x: Array  # (n,) coefficients of Q
    shared: dict[str, float]
    imposed: Sequence[Array]  # where, one array for each inequality [rad/sample]
    multipliers: Sequence[Array]  # (k * d,), of the rows of each inequality


@dataclass(frozen=True, eq=False)
class Problem:
    """The least mismatch over all worlds, under inequalities in all of them."""

    Q: FreeParameter
    worlds: Sequence[World]
    squares: bool  # whether the rms mismatch is minimised, or its supremum
    inequalities: Sequence[Inequality]
    statics: Sequence[Block]

    @classmethod
    def of(cls, Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array) -> Problem:
        squares = wish.objective == "rms"
        inequalities = [one for world in worlds for one in asked(wish, world, delta)]
        if not squares:
            inequalities += [bounded_mismatch(world, band(world)) for world in worlds]
        each = len(inequalities) // len(worlds)
        inequalities[each:] = [replace(one, imposed=one.imposed[::SPARSER]) for one in inequalities[each:]]
        statics = [block for block in (static_stiffness(world, Q) for world in worlds) if block is not None]
        return cls(Q, worlds, squares, inequalities, statics)

    @property
    def shared(self) -> list[str]:
        """The names of the unknowns beside Q."""
        return list(dict.fromkeys(name for one in self.inequalities for name in one.shared))

    def optimum(self, imposed: Sequence[Array]) -> Optimum:
        """The solution with the inequalities at the frequencies `imposed`, one array for each.

        It is sought in coordinates where every direction of Q changes the loop alike.
        """
        names = self.shared
        blocks = [one.unknowns(w, self.Q, names) for one, w in zip(self.inequalities, imposed, strict=True)]
        blocks += [block.padded(len(names)) for block in self.statics]
        A, b = mean_square_mismatch(self.worlds, self.Q)
        size, shared = self.Q.size, len(names)
        basis = _coordinates([A, *(block.rows()[1].reshape(-1, size + shared)[:, :size] for block in blocks)])
        change: Array = np.asarray(block_diag(basis, np.eye(shared)), dtype=float)
        A = np.hstack([A, np.zeros((A.shape[0], shared))]) @ change
        E = np.hstack([self.Q.asymmetry(), np.zeros((self.Q.asymmetry().shape[0], shared))]) @ change
        program = ConeProgram(
            A=A if self.squares else A[:0],
            b=b if self.squares else b[:0],
            c=np.array([0.0] * basis.shape[1] + [float(name == BOUND) for name in names]),
            blocks=tuple(block.changed(change) for block in blocks),
            E=E,
            e=np.zeros(E.shape[0]),
        )
        y, multipliers = solve_cones(program, "the optimal coupling")
        x = change @ y
        ends = np.cumsum([E.shape[0], *(vectors(block.constant).size for block in blocks)])
        each = np.split(multipliers, ends)[1 : len(imposed) + 1]
        return Optimum(x[:size], dict(zip(names, x[size:].tolist(), strict=True)), imposed, each)


def asked(wish: Wish, world: World, delta: Array) -> list[Inequality]:
    """What Q must satisfy in one environment, whatever is minimised."""
    inequalities = [passivity(world, delta * (1 - wish.margin)), stable_compliance(world, PASSIVE_SHARE)]
    if wish.switching:
        inequalities.append(switching(world, delta * (1 - wish.margin), *wish.switching))
    if wish.high_gain is not None:
        inequalities.append(high_frequency_limit(world, wish.high_gain, HIGH_HZ))
    return inequalities


def band(world: World) -> Array:
    """Frequencies of the mismatch [rad/sample], dense around the environment's poles."""
    low, high = (2 * np.pi * world.T * f for f in BAND_HZ)
    return frequencies(world.environment, low=low, high=min(high, np.pi), points=80)


def mean_square_mismatch(worlds: Sequence[World], Q: Parameter) -> tuple[Array, Array]:
    """A and b with |A x - b|^2 the mean of `square_mismatch` over the worlds."""
    parts = [square_mismatch(world, Q) for world in worlds]
    root = np.sqrt(len(worlds))
    return np.vstack([A for A, _ in parts]) / root, np.concatenate([b for _, b in parts]) / root


def square_mismatch(world: World, Q: Parameter) -> tuple[Array, Array]:
    """A and b with |A x - b|^2 the mean over log frequency of |M|_F^2/|E|_F^2 in the band.

    The square of what design.transparency reports, on a grid that no Q changes: within 1e-3 of it at the optimum.
    """
    w = band(world)
    z = on_circle(w)
    step = np.diff(np.log(w))
    share = (np.append(step, 0.0) + np.append(0.0, step)) / (2 * step.sum())  # the trapezoidal rule
    weight = np.sqrt(share) / np.linalg.norm(world.environment.at(z), axis=(1, 2))
    constant, slope = world.mismatch(z, Q)
    b = -(constant * weight[:, None, None]).ravel()
    A = np.moveaxis(slope * weight[:, None, None, None], 1, -1).reshape(b.size, Q.size)
    return np.vstack([A.real, A.imag]), np.concatenate([b.real, b.imag])


def _coordinates(rows: list[Array]) -> Array:
    """(n, k): x = basis y makes the stacked rows orthonormal; flat directions are left out."""
    _, s, Vt = np.linalg.svd(np.linalg.qr(np.vstack(rows), mode="r"))
    kept = s > FLAT * s.max()
    return Vt[kept].T / s[kept]
