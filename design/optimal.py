"""The best linear coupling under the closed-loop condition: one convex problem in Q, in one environment or in a set.

F = Theta (Psi E - Psi E Q Psi E) is affine in Q, so the mismatch and He[F/(z-1)] > -Delta_D/T are convex in its
coefficients, and cutting planes (design.parameter) find the global optimum over a basis. What is returned passes
the refined sweep of design.margin, whatever a solver said.

Q stays and E is the current environment, so F is affine in Q at every vertex of a box, too: the same problem, with each
vertex as a further world. The rms mismatch is then the mean square over the environment and the vertices (that of the
environment alone would gain it 0.2 dB and cost the worst vertex 0.3 to 0.5), the sup mismatch the worst of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import clarabel
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag
from scipy.optimize import minimize

from controller.coupling import InternalModel, basis
from controller.environment import Member, environment
from controller.loop import force_map
from controller.lti import Array, Lti, Sampled
from design.conditions import jitter_proof, switching_block, this_environment
from design.frequency import frequencies, hermitian, on_circle, peaks
from design.lmi import Specification
from design.ranges import Found, search
from design.result import Attempt, Design, DesignFailed, Infeasible, number, of_kind, one_of, whole
from design.transparency import BAND_HZ, transparency

# ----------------------------------------------------------------------------------------------------
# Quadratic programs over Hermitian inequalities: minimise |A x - b|^2/2 + c'x with H_0 + sum_j x_j H_j >= 0.
#
# An inequality at k frequencies is one `Block`. A Hermitian matrix of size one is a half-line, of size two a second-
# order cone (a + b >= |(a - b, 2 Re c, 2 Im c)|), of size r the real symmetric matrix [[Re, -Im], [Im, Re]] of size
# 2r.


Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Block:
    """constant + sum_j x_j slope_j >= 0, at k frequencies."""

    constant: Complex  # (k, r, r), Hermitian
    slope: Complex  # (k, n, r, r), Hermitian

    @property
    def size(self) -> int:
        return self.constant.shape[-1]

    def at(self, x: Array) -> Complex:
        """The matrices at x, shape (k, r, r)."""
        return self.constant + np.einsum("j,kjab->kab", x, self.slope)

    def least(self, x: Array) -> Array:
        """Their least eigenvalues, shape (k,)."""
        return np.linalg.eigvalsh(self.at(x))[:, 0]

    def padded(self, more: int) -> Block:
        """The same inequalities with `more` unknowns at the end, which do not enter."""
        k, _, r, _ = self.slope.shape
        return Block(self.constant, np.concatenate([self.slope, np.zeros((k, more, r, r), dtype=complex)], axis=1))

    def changed(self, basis: Array) -> Block:
        """The same inequalities in y, where x = basis y."""
        return Block(self.constant, np.einsum("kjab,jl->klab", self.slope, basis))

    def rows(self) -> tuple[Array, Array]:
        """(s_0, S) with s_0 + S x in the cone, shapes (k, d) and (k, d, n), d entries per frequency."""
        return vectors(self.constant), np.moveaxis(vectors(self.slope), 1, 2)


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """minimise |A x - b|^2/2 + c'x subject to every block, and equalities E x = e."""

    A: Array  # (rows, n)
    b: Array  # (rows,)
    c: Array  # (n,)
    blocks: tuple[Block, ...]
    E: Array  # (equalities, n)
    e: Array  # (equalities,)

    def objective(self, x: Array) -> float:
        residual = self.A @ x - self.b
        return float(residual @ residual / 2 + self.c @ x)

    def violation(self, x: Array) -> float:
        """By how much the worst inequality or equality fails."""
        worst = max((-float(block.least(x).min(initial=0.0)) for block in self.blocks), default=0.0)
        return max(worst, float(np.abs(self.E @ x - self.e).max(initial=0.0)))


def vectors(H: Complex) -> Array:
    """The Hermitian matrices H, shape (.., r, r), as vectors of their cone, shape (.., d)."""
    r = H.shape[-1]
    if r == 1:
        return H[..., 0, 0].real[..., None]
    if r == 2:
        a, b, c = H[..., 0, 0].real, H[..., 1, 1].real, H[..., 0, 1]
        return np.stack([a + b, a - b, 2 * c.real, 2 * c.imag], axis=-1)
    real = np.block([[H.real, -H.imag], [H.imag, H.real]])
    column, row = np.tril_indices(2 * r)  # the upper triangle, column by column
    return real[..., row, column] * np.where(row == column, 1.0, np.sqrt(2.0))


# ----------------------------------------------------------------------------------------------------
# Cone programs handed to Clarabel as matrices: modelling hundreds of inequalities takes longer than solving them.
#
# As in design.solve, a status is a claim: the answer is used only if it is finite and every inequality holds when it
# is evaluated again; otherwise the next settings are tried.


#: Largest violation taken for rounding; programs are posed in units where 1 is large.
TOLERANCE = 1e-6

LADDER: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "as given": {"equilibrate_enable": False},
    "loose": {"tol_gap_abs": 1e-6, "tol_gap_rel": 1e-6, "tol_feas": 1e-7, "static_regularization_constant": 1e-7},
}
SOLVED = ("Solved", "AlmostSolved", "InsufficientProgress")
NO_SOLUTION = ("PrimalInfeasible", "AlmostPrimalInfeasible")


def solve_cones(program: ConeProgram, what: str) -> tuple[Array, Array]:
    """(a verified minimiser x, the multipliers). `what` names the program in the message of an error.

    The multipliers are those of the equalities, then of the rows of each block, frequency by frequency: what x gains
    when these move, so they only matter to someone who wants to move them, and are not verified.

    Raises Infeasible when the solver proves that there is none, DesignFailed otherwise.
    """
    P, q, A, b, cones = _standard_form(program)
    attempts: list[Attempt] = []
    for name, options in LADDER.items():
        started = time.perf_counter()
        solution: Any = clarabel.DefaultSolver(P, q, A, b, cones, _settings(options)).solve()
        status, x = str(solution.status), np.array(solution.x)
        reason = _doubt(program, status, x)
        value = None if reason else program.objective(x)
        attempts.append(Attempt(name, status, value, time.perf_counter() - started, reason))
        if reason is None:
            return x, np.array(solution.z)
        if status in NO_SOLUTION:
            raise Infeasible(program, attempts, f"{what} has no solution ({name}: {status})")
    statuses = ", ".join(f"{a.settings}: {a.status}" for a in attempts)
    fewer = f"ask for fewer functions or a diagonal Q: {program.A.shape[1]} unknowns"
    raise DesignFailed(program, attempts, f"{what} could not be solved ({statuses}); {fewer} are too many here")


def _doubt(program: ConeProgram, status: str, x: Array) -> str | None:
    if status not in SOLVED:
        return f"the solver reports {status}"
    if not np.isfinite(x).all():
        return "a variable has no finite value"
    worst = program.violation(x)
    return None if worst <= TOLERANCE else f"a constraint is violated by {worst:.1e}"


def _settings(options: Mapping[str, Any]) -> clarabel.DefaultSettings:
    settings = clarabel.DefaultSettings()
    for name, value in {"verbose": False, **options}.items():
        setattr(settings, name, value)
    return settings


def _standard_form(program: ConeProgram) -> tuple[sparse.csc_matrix, Array, sparse.csc_matrix, Array, list]:
    """P, q, A, b and cones of: minimise x'Px/2 + q'x with b - A x in the cones."""
    rows, offsets, cones = [program.E], [program.e], []
    if program.e.size:
        cones.append(clarabel.ZeroConeT(program.e.size))
    for block in program.blocks:
        constant, slope = block.rows()
        k, d, n = slope.shape
        rows.append(-slope.reshape(k * d, n))
        offsets.append(constant.ravel())
        cones.extend(_cones(block, k, d))
    P = sparse.csc_matrix(np.triu(program.A.T @ program.A))
    return P, program.c - program.A.T @ program.b, sparse.csc_matrix(np.vstack(rows)), np.concatenate(offsets), cones


def _cones(block: Block, k: int, d: int) -> Sequence[Any]:
    if block.size == 1:
        return [clarabel.NonnegativeConeT(k)]
    if block.size == 2:
        return [clarabel.SecondOrderConeT(d)] * k
    return [clarabel.PSDTriangleConeT(2 * block.size)] * k


# ----------------------------------------------------------------------------------------------------
# The coefficients of Q as unknowns, and what the loop is at each frequency as an affine function of them.
#
# G(z) = Psi E - Psi E Q Psi E with Q = sum_k Q_k b_k(z). A response is a pair (constant, slope) of shapes (k, m, m)
# and (k, n, m, m): its value at the unknowns x is constant + sum_j x_j slope_j. A given Q is the case n = 0.


Response = tuple[Complex, Complex]

#: Coefficients are sought in this unit, which makes them numbers near one [m/N].
UNIT = 1e-3
#: ... and kept to this many digits after the point in m/N, so that their sum is symmetric to the last digit.
DIGITS = 15


@dataclass(frozen=True, eq=False)
class FreeParameter:
    """Q with every entry free, or every diagonal one; in UNIT, function by function."""

    poles: Array  # (functions - 1,)
    channels: int
    diagonal: bool

    @cached_property
    def entries(self) -> tuple[tuple[int, int, int], ...]:
        """(function, row, column) of each unknown."""
        m = self.channels
        pairs = [(i, j) for i in range(m) for j in range(m) if i == j or not self.diagonal]
        return tuple((k, i, j) for k in range(self.poles.size + 1) for i, j in pairs)

    @property
    def size(self) -> int:
        return len(self.entries)

    def at(self, z: Complex) -> Response:
        """Q(z) [m/N]."""
        b, m = basis(self.poles, z), self.channels
        slope = np.zeros((z.size, self.size, m, m), dtype=complex)
        for j, (function, row, column) in enumerate(self.entries):
            slope[:, j, row, column] = UNIT * b[:, function]
        return np.zeros((z.size, m, m), dtype=complex), slope

    def asymmetry(self) -> Array:
        """One row per pair of channels, zero on x where Q(1) is symmetric; (pairs, n)."""
        m = self.channels
        pairs = [] if self.diagonal else [(i, j) for i in range(m) for j in range(i)]
        rows = np.zeros((len(pairs), self.size))
        for row, (i, j) in zip(rows, pairs, strict=True):
            row[:] = [float((a, b) == (i, j)) - float((a, b) == (j, i)) for _, a, b in self.entries]
        return rows

    def coupling(self, x: Array) -> InternalModel:
        """The coupling with these coefficients, rounded to DIGITS; Q(1) is exactly symmetric in the decimals."""
        shape = (self.poles.size + 1, self.channels, self.channels)
        whole = np.zeros(shape, dtype=object)
        for value, entry in zip(x, self.entries, strict=True):
            whole[entry] = round(float(value) * UNIT * 10**DIGITS)
        static = whole.sum(axis=0)
        whole[0] -= np.tril(static - static.T, -1)
        return InternalModel(self.poles, np.array([float(f"{v}e-{DIGITS}") for v in whole.ravel()]).reshape(shape))


@dataclass(frozen=True, eq=False)
class GivenParameter:
    """The Q of a coupling, without unknowns."""

    given: InternalModel

    @property
    def size(self) -> int:
        return 0

    def at(self, z: Complex) -> Response:
        """Q(z) [m/N]."""
        Q = np.einsum("zk,kij->zij", basis(self.given.poles, z), self.given.Q)
        return Q, np.zeros((z.size, 0, *Q.shape[1:]), dtype=complex)


def loop_force(E: Complex, Q: Response) -> Response:
    """G = E - E Q E at each frequency, E standing for Psi E (k, m, m)."""
    constant, slope = Q
    return E - E @ constant @ E, -E[:, None] @ slope @ E[:, None]


def affine(response: Response, constant: Array | Complex, linear: Callable[[Complex], Complex]) -> Block:
    """constant + He[linear(response)] >= 0, for a linear map that accepts further leading axes."""
    value, slope = response
    return Block(constant + hermitian(linear(value)), np.moveaxis(hermitian(linear(np.moveaxis(slope, 1, 0))), 0, 1))


def bordered(diagonal: Array, corner: Complex) -> Complex:
    """[[diagonal, corner], [corner*, diagonal]]."""
    whole = np.broadcast_to(diagonal, corner.shape).astype(complex)
    return np.block([[whole, corner], [np.conj(np.swapaxes(corner, -1, -2)), whole]])


# ----------------------------------------------------------------------------------------------------
# What is asked of the parameter Q of an optimal coupling, beside the specification of the loop.


#: where the poles of the basis may lie, and which mismatch is minimised
FILTERS = ("auto", "fir", "slow", "mixed", "repeated", "adapted")
OBJECTIVES = ("rms", "sup")

MARGIN = 0.005  # share of the damping that stays unused
HIGH_GAIN = 1.5  # times the environment that the devices may feel at high frequency
FASTEST, SLOWEST = 0.5, 0.992  # poles of a slow basis
GRADED = 0.8, 0.998  # slow poles of a repeated basis
PLACE = 0.42  # where most poles of a long repeated basis are: the place that the descent finds in case II
SHORT = 16  # functions up to which auto takes taps for the rms mismatch; half as many for its supremum


@dataclass(frozen=True)
class Wish:
    """What is asked of Q. Raises ValueError naming the field that is wrong."""

    functions: int = 8  # basis functions per entry of Q: taps, where the filter is FIR
    filter: str = "auto"  # where the poles of the basis are, see `poles`
    diagonal: bool = True
    objective: str = "rms"  # "rms" or "sup" of the mismatch over the band, relative to the environment
    high_gain: float | None = HIGH_GAIN
    margin: float = MARGIN
    switching: tuple[Sequence[int], Sequence[int]] | None = None  # (lo, hi) [samples]: ages of forces that may switch

    def __post_init__(self) -> None:
        whole("functions", self.functions, 1, 200)
        one_of("filter", self.filter, FILTERS)
        one_of("objective", self.objective, OBJECTIVES)
        of_kind("diagonal", self.diagonal, bool, "True or False")
        if self.high_gain is not None and not number("high_gain", self.high_gain, "a factor, or None") >= 1:
            raise ValueError(f"high_gain is {self.high_gain}, expected a factor of at least 1")
        if not 0 < number("margin", self.margin) < 1:
            raise ValueError(f"margin is {self.margin}, allowed are shares of the damping above 0 and below 1")

    def poles(self, spec: Specification) -> Array:
        """Poles of the basis, (functions - 1,); those that an adapted basis starts from.

        fir: all at zero. slow: from 0.5 to 0.992, even in the logarithm of the time constant. mixed: a third at zero,
        the rest slow. repeated: most at one place, like Laguerre functions, and two of nine between 0.8 and 0.998
        (half of them where the request is hard). What auto means is in `kind`.
        """
        n, kind = self.functions - 1, self.kind(spec)
        if kind == "repeated":
            graded = n // 2 if _hard(spec, self) else round(2 * n / 9)
            place = round(min(PLACE, (n + 6) / 100), 2)
            return np.concatenate([np.full(n - graded, place), _graded(*GRADED, graded)])
        zero = {"fir": n, "slow": 0, "mixed": n // 3}[kind]
        return np.concatenate([np.zeros(zero), _graded(FASTEST, SLOWEST, n - zero)])

    def kind(self, spec: Specification) -> str:
        """The filter that auto, or the start of adapted, stands for.

        Hard is theta >= 3 or psi >= 1, which no short FIR filter can wait for, a set of environments, or delays that
        switch, which ask for more room: mixed. Otherwise fir, the best of these for few functions. repeated, which
        reaches both far in time and low in frequency, where there are more than a few.
        """
        if self.filter not in ("auto", "adapted"):
            return self.filter
        if self.functions > (SHORT if self.objective == "rms" or _hard(spec, self) else SHORT // 2):
            return "repeated"
        return "mixed" if _hard(spec, self) else "fir"


def _hard(spec: Specification, wish: Wish) -> bool:
    return max(spec.theta) >= 3 or any(spec.psi) or bool(spec.others) or bool(wish.switching)


def _graded(fastest: float, slowest: float, n: int) -> Array:
    """n poles, even in the logarithm of the time constant."""
    return np.round(1 - np.geomspace(1 - fastest, 1 - slowest, n), 6)


# ----------------------------------------------------------------------------------------------------
# What is asked of Q at every frequency of the circle, in one environment: inequalities between Hermitian matrices.


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
    """`switching_block` for forces whose ages switch within [lo, hi] [samples], scaled to Delta_D/T = I.

    Its multiplier, one number per channel for all frequencies, is a shared unknown.
    """
    m, root = delta.size, np.sqrt(world.T / delta)
    none = np.zeros(m)

    def condition(z: Complex, G: Complex, alpha: Array, damping: Array) -> Complex:
        """(n, k, r, r) from z (k,) and G (n, k, m, m)."""
        return hermitian(switching_block(Sampled(z[None], G, 1.0), lo, hi, damping, alpha)[0].G)

    def block(w: Array, Q: Parameter) -> Block:
        z = on_circle(w)
        constant, slope = loop_force(world.delayed(z), Q.at(z))
        constant, slope = root[:, None] * constant * root, root[:, None] * slope * root
        (own,) = condition(z, constant[None], none, np.ones(m))
        return Block(own, np.moveaxis(condition(z, np.moveaxis(slope, 1, 0), none, none), 0, 1))

    def multiplier(unit: Array) -> Array:
        return condition(np.array([-1.0 + 0j]), np.zeros((1, 1, m, m), dtype=complex), unit, none)[0, 0].real

    varying = [i for i in range(m) if lo[i] < hi[i]]
    shared = {f"alpha {i + 1}": multiplier(np.eye(m)[i]) for i in varying}
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


# ----------------------------------------------------------------------------------------------------
# The unknown Q and the environments that it is to be safe in, of a specification.


def parameter(spec: Specification, wish: Wish) -> FreeParameter:
    """The unknown Q."""
    return FreeParameter(wish.poles(spec), spec.channels, wish.diagonal)


def environments(spec: Specification) -> list[Lti]:
    """The environment, and what else it may be."""
    return [spec.environment, *spec.others.values()]


def worlds(spec: Specification) -> list[World]:
    """The environments with the delays around them; one that no device feels asks nothing and is left out."""
    return [world(spec, E) for E in environments(spec) if E.D.any()]


def world(spec: Specification, E: Lti | None = None) -> World:
    """An environment, by default the specified one, with the delays around it."""
    return World(E or spec.environment, spec.theta, spec.psi, spec.lam)


# ----------------------------------------------------------------------------------------------------
# A convex problem with inequalities at every frequency, solved by imposing them at a few and adding those that fail.
#
# Each round minimises the mismatch with the inequalities where they are imposed so far, sweeps the solution densely,
# and adds the peaks where one fails.


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


# ----------------------------------------------------------------------------------------------------
# The poles of a basis moved to where they help: descent on the optimum of the convex problem.
#
# The optimum over a basis is a function of its poles. Its gradient costs no further problem: with x and the
# multipliers y of the solution held, it is that of the Lagrangian, objective - <y, inequalities> (the envelope
# theorem). Poles at one place have the same gradient, so they stay together: what moves are places, each with its
# number of poles.
#
# In the poles nothing is convex. The descent ends in a local optimum near its start, where each set of poles is still
# solved globally; a result that is not better than the start is not used.


DESCENTS = 2  # with the frequencies imposed that the one before has shown to matter
MOST_TRIALS = 12  # convex problems of a descent
STEP = 1e-5  # of the central differences
FARTHEST = 0.9985  # from zero that a place may go
DIGITS_POLE_DESCENT = 4  # of a pole after the point: short rationals make short proofs
HOPELESS = 10.0  # logarithm of the mismatch where the problem has no solution


@dataclass(frozen=True)
class Places:
    """Poles by where they are."""

    at: Array  # (places,)
    number: tuple[int, ...]  # poles at each

    @classmethod
    def of(cls, poles: Array) -> Places:
        at, number = np.unique(poles, return_counts=True)
        return cls(at, tuple(number.tolist()))

    def poles(self) -> Array:
        return np.repeat(self.at, self.number)


def descend(
    Q: FreeParameter, wish: Wish, worlds: Sequence[World], delta: Array, descents: int = DESCENTS
) -> tuple[FreeParameter, int]:
    """(Q with its poles moved, convex problems solved), from the poles of Q.

    Raises Infeasible and DesignFailed as design.parameter.cutting_planes.cut does for the poles of Q.
    """
    problem = Problem.of(Q, wish, worlds, delta)
    optimum, solved = cut_problem(problem)
    best = problem, log_mismatch(problem, optimum)
    for _ in range(descents if Q.poles.size else 0):
        poles, trials = moved(problem, optimum)
        problem = replace(problem, Q=replace(Q, poles=poles))
        solved += trials
        try:
            optimum, rounds = cut_problem(problem, optimum.imposed)
        except DesignFailed:
            break
        solved += rounds
        if log_mismatch(problem, optimum) < best[1]:
            best = problem, log_mismatch(problem, optimum)
    return best[0].Q, solved


def moved(problem: Problem, optimum: Optimum) -> tuple[Array, int]:
    """(better poles, trials) with the inequalities where the optimum has them imposed."""
    places, trials = Places.of(problem.Q.poles), 0

    def trial(u: Array) -> tuple[float, Array]:
        nonlocal trials
        trials += 1
        now = replace(places, at=np.tanh(u))
        here = replace(problem, Q=replace(problem.Q, poles=now.poles()))
        try:
            found = here.optimum(optimum.imposed)
        except DesignFailed:
            return HOPELESS, np.zeros(u.size)
        return log_mismatch(here, found), gradient(here, found, now) / np.cosh(u) ** 2

    bound = np.arctanh(FARTHEST)
    start = np.arctanh(np.clip(places.at, -FARTHEST, FARTHEST))
    options = {"maxfun": MOST_TRIALS}
    result = minimize(trial, start, jac=True, method="L-BFGS-B", bounds=[(-bound, bound)] * start.size, options=options)
    return np.round(replace(places, at=np.tanh(result.x)).poles(), DIGITS_POLE_DESCENT), trials


def gradient(problem: Problem, optimum: Optimum, places: Places) -> Array:
    """d log_mismatch / d place, (places,), by central differences of the Lagrangian; `places` are the problem's."""
    slopes = []
    for unit in np.eye(places.at.size):
        ahead, behind = (
            lagrangian(problem, optimum, replace(places, at=places.at + side * STEP * unit).poles()) for side in (1, -1)
        )
        slopes.append((ahead - behind) / (2 * STEP))
    value = np.exp(log_mismatch(problem, optimum))
    return np.array(slopes) / (value**2 if problem.squares else value)


def log_mismatch(problem: Problem, optimum: Optimum) -> float:
    """Logarithm of what is minimised, as a ratio to the environment."""
    if not problem.squares:
        return float(np.log(optimum.shared[BOUND]))
    A, b = mean_square_mismatch(problem.worlds, problem.Q)
    return float(np.log(np.linalg.norm(A @ optimum.x - b)))


def lagrangian(problem: Problem, optimum: Optimum, poles: Array) -> float:
    """Objective - <multipliers, inequalities> for the optimum's coefficients over other poles.

    What does not move with the poles is left out: the bound of a sup objective, and all that is asked at z = 1.
    """
    given = _given(problem.Q, poles, optimum.x)
    names, values = problem.shared, np.array(list(optimum.shared.values()))
    total = 0.0
    if problem.squares:
        _, b = mean_square_mismatch(problem.worlds, given)
        total += float(b @ b) / 2
    for one, w, multipliers in zip(problem.inequalities, optimum.imposed, optimum.multipliers, strict=True):
        total -= float(multipliers @ vectors(one.unknowns(w, given, names).at(values)).ravel())
    return total


def _given(Q: FreeParameter, poles: Array, x: Array) -> GivenParameter:
    """The coefficients x, not rounded, over other poles."""
    coefficients = np.zeros((poles.size + 1, Q.channels, Q.channels))
    coefficients[tuple(np.array(Q.entries).T)] = UNIT * x
    return GivenParameter(InternalModel(poles, coefficients))


# ----------------------------------------------------------------------------------------------------
# Why no single Q serves a whole set of environments, and what to change.


Question = Callable[[Specification, Wish], bool]
Progress = Callable[[str, int, int], None]  # what is being done, steps done, of how many

SMALLER = (0.75, 0.5, 0.25, 0.1)  # times the width of a box's ranges that are tried


def set_advice(
    spec: Specification,
    wish: Wish,
    changes: Mapping[str, Wish],
    feasible: Question,
    solvable: Question,
    binding: Callable[[Specification, Wish], str],
    progress: Progress,
) -> str:
    """Which vertices leave no solution though the environment alone has one, and what would.

    `changes` are tried one at a time. feasible: by a quick look, which may err on the hopeful side; solvable: by the
    whole search at the vertices.
    """
    others = spec.others.items()
    total, done = len(others) + len(changes) + 1 + len(SMALLER), 0

    def step() -> bool:
        nonlocal done
        progress("no coupling: looking for the reason", done, total)
        done += 1
        return True

    hopeless = [
        name for name, E in others if step() and not feasible(replace(spec, others={name: E}, shrunk=None), wish)
    ]
    kind = "diagonal" if wish.diagonal else "full"
    request = f"no {kind} Q of {wish.functions} functions is certified for the whole box"
    if hopeless:
        more = f", nor with {len(hopeless) - 1} more of the {len(others)} vertices" if len(hopeless) > 1 else ""
        why = f"beside the nominal environment there is none with {hopeless[0]}{more}"
    else:
        why = "each vertex has one beside the nominal environment, but not all of them together with the points between"
    helpful = [w for w, other in changes.items() if step() and feasible(spec, other) and solvable(spec, other)]
    assert spec.shrunk  # a box came with it
    smaller = ((f, replace(spec, others=spec.shrunk(f), regions=())) for f in SMALLER)
    share = next((f for f, less in smaller if step() and solvable(less, wish)), None)
    step()
    limit = binding(spec, wish)
    remedies = [
        f"there is one for ranges of {share:.0%} of their width around the nominal values" if share else "",
        f"there is one for the whole box with {', or with '.join(helpful)}" if helpful else "",
    ]
    remedy = "; ".join(filter(None, remedies)) or f"nothing helped of narrower ranges, {', '.join(changes)}"
    return f"{request}: {why}; {limit}; {remedy}"


# ----------------------------------------------------------------------------------------------------
# Why there is no optimal coupling of the kind that was asked for, and what would have to be another.


MOST = 24  # functions that are tried to say whether more of them would help
EASIER = (1.5, 2, 3, 5, 10, 20, 50)  # times the damping, tried to say how far a request is from having a solution


def advice(spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None) -> str:
    """Why nothing was found, and which change of the request, one at a time, leaves a solution."""
    alone = replace(spec, others={}, shrunk=None)
    if spec.others and feasible(alone, wish):
        return set_advice(spec, wish, changes(spec, wish), feasible, solvable, binding, progress)
    spec = alone
    helpful = _helpful(spec, changes(spec, wish), progress) or _helpful(spec, last_resorts(wish), progress)[:1]
    kind = "diagonal" if wish.diagonal else "full"
    delays = f"theta = {list(spec.theta)}, psi = {list(spec.psi)}"
    if wish.switching:
        lo, hi = wish.switching
        delays += f", delays switching from {list(lo)} to {list(hi)}"
    request = f"no {kind} Q of {wish.functions} functions is certified with {delays}, delta = {list(spec.delta)}"
    request += f": {binding(spec, wish)}"
    if helpful:
        return f"{request} in this basis; there is one with {', or with '.join(helpful)}"
    damped = ((f, replace(spec, delta=tuple(f * d for d in spec.delta))) for f in EASIER)
    factor = next((f for f, easier in damped if feasible(easier, wish) and solvable(easier, wish)), None)
    would_do = [f"{factor:g} times the damping"] if factor else []
    if any((*spec.theta, *spec.psi)):
        none = (0,) * spec.channels
        at_once = replace(spec, theta=none, psi=none, lam=none)
        would_do += ["no delay at all"] if solvable(at_once, replace(wish, switching=None)) else []
    if would_do:
        return f"{request}; {' or '.join(would_do)} would do"
    return f"{request}; not even {EASIER[-1]} times the damping would do"


def binding(spec: Specification, wish: Wish) -> str:
    """Which inequality is in the way: one without which the others have a solution.

    The condition for switching delays contains the closed-loop one, so it is left out with it.
    """
    names = list(dict.fromkeys(one.name for one in asked(wish, world(spec), np.asarray(spec.delta))))
    sets = {name: (name,) for name in names}
    if wish.switching:
        sets = {name: (name,) if name != SWITCHING else (name, CLOSED_LOOP) for name in names if name != CLOSED_LOOP}
    free = [name for name, left_out in sets.items() if feasible(spec, wish, left_out)]
    if not free:
        return "more than one condition binds: none of them alone is in the way"
    return f"{free[0]} binds" if len(free) == 1 else f"{' and '.join(free)} contradict each other"


def changes(spec: Specification, wish: Wish) -> dict[str, Wish]:
    """What else could be asked, in options of python -m design."""
    more = min(max(2 * wish.functions, 16), MOST)
    other = {
        f"--functions {more}": replace(wish, functions=more),
        "--filter mixed": replace(wish, filter="mixed"),
        "--full": replace(wish, diagonal=False),
        f"--full --functions {more} --filter mixed": replace(wish, functions=more, diagonal=False, filter="mixed"),
        "--high-gain none": replace(wish, high_gain=None),
        f"--margin {MARGIN:g}": replace(wish, margin=min(wish.margin, MARGIN)),
    }
    known, distinct = {_meaning(spec, wish)}, {}
    for words, changed in other.items():
        if (meaning := _meaning(spec, changed)) not in known:
            known.add(meaning)
            distinct[words] = changed
    return distinct


def _meaning(spec: Specification, wish: Wish) -> tuple:
    """The same for two wishes that ask the same, such as a filter by its name and by auto."""
    return (*wish.poles(spec), wish.diagonal, wish.high_gain, wish.margin)


def last_resorts(wish: Wish) -> dict[str, Wish]:
    """What could be asked where none of `changes` helps."""
    richest, words = (
        replace(wish, functions=MOST, diagonal=False, filter="mixed"),
        f"--full --functions {MOST} --filter mixed",
    )
    return {words: richest, f"{words} --high-gain none": replace(richest, high_gain=None)}


def _helpful(spec: Specification, others: Mapping[str, Wish], progress: Progress) -> list[str]:
    found = []
    for k, (words, other) in enumerate(others.items()):
        progress("no coupling: looking for the reason", k, len(others))
        found += [words] if feasible(spec, other) and solvable(spec, other) else []
    return found


def solvable(spec: Specification, wish: Wish) -> bool:
    """Whether there is a Q: the whole search."""
    try:
        cut(parameter(spec, wish), wish, worlds(spec), np.asarray(spec.delta))
    except DesignFailed:
        return False
    return True


def feasible(spec: Specification, wish: Wish, without: Sequence[str] = ()) -> bool:
    """Whether some Q meets what is asked at the frequencies where it is imposed first: a necessary condition.

    `without` names inequalities that are not asked.
    """
    try:
        sketch(parameter(spec, wish), wish, worlds(spec), np.asarray(spec.delta), without)
    except DesignFailed:
        return False
    return True


USUAL = Wish()
ADDED, MOST_ADDITIONS = 3, 8  # points of a box that become environments at a time, and how often at most


def design(spec: Specification, wish: Wish = USUAL, progress: Progress = lambda what, done, total: None) -> Design:
    """The coupling of the least mismatch, verified by the refined sweep of the condition.

    `progress` hears of the search for a reason where there is none, which takes longer than most designs.
    Raises Infeasible where no Q of this kind meets the condition, DesignFailed where none could be verified.
    """
    started = time.perf_counter()
    try:
        coupling, spec, rounds = searched(spec, wish, progress)
    except Infeasible as error:
        raise Infeasible(error.problem, error.results, advice(spec, wish, progress)) from error
    maps = [force_map(E, coupling, spec.theta, spec.psi) for E in environments(spec)]
    requirement = max((this_environment(F, spec.delta) for F in maps), key=lambda r: r.ratio)
    if wish.switching:
        free = [force_map(E, coupling, (0,) * spec.channels, spec.psi) for E in environments(spec)]
        requirement = max(
            (jitter_proof(G, *wish.switching, spec.delta).requirement for G in free), key=lambda r: r.ratio
        )
    if requirement.ratio > 1 - wish.margin + 2 * SLACK:
        raise DesignFailed(None, (), _missed(requirement.ratio, wish))
    figures = [transparency(F, E, spec.lam) for F, E in zip(maps, environments(spec), strict=True) if E.D.any()]
    squares = [f.rms_mismatch**2 for f in figures]
    value = np.sqrt(np.mean(squares)) if wish.objective == "rms" else max(f.relative_mismatch for f in figures)
    wall = time.perf_counter() - started
    return Design(coupling, "closed-loop", wish.objective, float(value), requirement, rounds, wall)


def _missed(ratio: float, wish: Wish) -> str:
    more = wish.margin + 2 * (ratio - (1 - wish.margin))
    advice = f"leave more of it unused: --margin {more:.2g}" if more < 1 else "ask for fewer functions"
    return f"the optimum needs {ratio:.6f} of the damping when it is swept again; {advice}"


def searched(
    spec: Specification, wish: Wish, progress: Progress = lambda what, done, total: None
) -> tuple[InternalModel, Specification, int]:
    """(coupling, the specification with the points of the box that had to be added, rounds).

    Between the vertices of a box nothing is convex: what a search finds to violate the condition there becomes further
    environments, until it finds nothing. Raises DesignFailed where it still does after MOST_ADDITIONS times.
    """
    total, added, Q = 0, 0, parameter(spec, wish)
    if wish.filter == "adapted":
        Q, total = descend(Q, wish, worlds(spec), np.asarray(spec.delta))
    while True:
        coupling, rounds = cut(Q, wish, worlds(spec), np.asarray(spec.delta))
        total += rounds
        worst = violators(spec, coupling, 1 - wish.margin / 2, progress)
        if not worst:
            return coupling, spec, total
        if added == MOST_ADDITIONS:
            raise DesignFailed(None, (), _still_violated(worst[0]))
        added += 1
        more = {found.member.name: environment(found.member.network, spec.T) for found in worst[:ADDED]}
        spec = replace(spec, others={**spec.others, **more})


def violators(
    spec: Specification, coupling: InternalModel, most: float, progress: Progress = lambda what, done, total: None
) -> list[Found]:
    """Where in the box more than this share of the damping is needed, the worst first; a search finds them."""

    def ratio(member: Member) -> float:
        F = force_map(environment(member.network, spec.T), coupling, spec.theta, spec.psi)
        return this_environment(F, spec.delta).ratio

    found = search(spec.regions, ratio, lambda done, total: progress("searching the box", done, total))
    return [one for one in found.worst if one.ratio > most]


def _still_violated(found: Found) -> str:
    return (
        f"after {MOST_ADDITIONS} rounds of adding the worst environments of the box to the design it is still violated "
        f"between the vertices: {found.ratio:.4f} of the damping is needed at {found.member.name}; "
        "give narrower ranges, or ask for more functions"
    )
