"""Write a stored coupling, or its discrete process, as C99 with a test."""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("export")

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.complementarity import GROUNDED, PIVOT_ROUNDING, BallProblem, BoxProblem, magnitudes
from haptic_loop.controller.law import Law, Limiter
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.ranges import where_proved
from haptic_loop.design.certificate import Verdict, covered, limiter_rho
from haptic_loop.design.coupling_file import Stored
from haptic_loop.design.result import ANY, HERE, MAKING, RANGES, listed

# ----------------------------------------------------------------------------------------------------
# An export is one state-space block with a fixed order of its sums, and a test vector in that order.
#
# A tick is y = C z + D u, z+ = A z + B u. Every entry of y and of z+ is one sum in double precision. The sum starts at
# 0.0 and adds one rounded product after another: first those of the states z_0, z_1, .., then those of the inputs
# u_0, u_1, .. Every language can keep this order, so that an exported block repeats its test vector to the last bit. In
# single precision, coefficients, inputs and every operation are rounded to 24 bits.
#
# If a force exceeds its limit, the tick solves the box problem f = q - M e of controller.complementarity, where q are
# the unlimited forces, f the limited forces and e the slips. At first the limits that q exceeds are active. The tick
# makes the first wrong limit active or inactive until none is wrong. This takes finitely many switches
# (docs/theory.md). The elimination keeps the order of the channels and needs no pivoting, because all principal minors
# are positive. The tick then adds KICK e to [y; z+], with
# the matrix of controller.law.Law.uncut, and sets the sent forces to f.
#
# Every wall adds a row to this problem, with q = a (d - c) of controller.law, the upper limit 0, and the wall's force
# in e. These rows come first, because a slip may change a force only through a wall, so that its own pivot is 0 until
# the wall is eliminated. The last states are the depths h in the walls. Their rows in A, B and KICK give the
# displacements y across the walls, and then h = max(0, y - gap).
#
# If the force of a device is limited as a vector, the tick solves controller.complementarity.BallProblem instead. It
# takes Newton steps in u = f + tau e. A step that does not halve the residual is replaced by a step of the
# Douglas-Rachford iteration, which converges. Forces that miss their tolerance after _MOST_STEPS steps are set to 0;
# `unsolved` counts these ticks.


_MOST_INTEGER = 9e18  # C compares integers of 64 bits
_TICKS = 64  # length of a test vector, longer than the fast modes and the usual delays of a loop
_MOST_TURNS = 100_000  # largest number of switches in a tick's box problem; a handful is usual
_SINGLE_ROUNDING = 1e-5  # PIVOT_ROUNDING in single precision: 84 units in the last place
_RESIDUAL = 1e-12  # allowed residual of a force vector relative to its limit, unless its rounding error is larger
_BALL_ROUNDING = 16  # allowed rounding of a block's residual, in epsilons times the largest row sum of absolute terms
_MOST_STEPS = 1000  # largest number of steps for force vectors; 5 are usual, random well-conditioned M took up to 93
_COMPARED = 4096  # ticks over which single and double precision are compared


@dataclass(frozen=True)
class _Signal:
    """The input or the output of a block: m values of one quantity."""

    letter: str
    what: str  # quantity with its unit
    size: float  # typical number in a test vector, in that unit


_FORCE = _Signal("f", "force [N]", 1.0)
_DISPLACEMENT = _Signal("x", "displacement [m]", 1e-3)
_DEFLECTION = _Signal("d", "displacement [m]", 1e-3)


@dataclass(frozen=True, eq=False)
class ExportedBlock:
    """A square block that runs once per sampling period, from rest."""

    name: str  # "coupling" | "process"
    system: Lti  # at least one state
    input: _Signal
    output: _Signal
    about: tuple[str, ...]  # comment lines of the file
    law: Law | None = (
        None  # None if linear; otherwise `system` is the block while no force is limited and no wall touches
    )
    theta: tuple[int, ...] = ()  # delays of the forces [samples], which the certificate covers
    delayed: bool = True  # whether the block contains these delays
    single: tuple[float, float] | None = None  # (largest error, largest output) of single precision; None for double
    rotary: bool = False  # whether positions are in rad, and forces in N m
    certified: bool = False  # whether the proof in the coupling's file holds for this block

    @property
    def dtype(self) -> type[np.floating]:
        return np.float32 if self.single else np.float64

    @property
    def limiter(self) -> Limiter | None:
        return self.law if isinstance(self.law, Limiter) else None


@dataclass(frozen=True, eq=False)
class _Trial:
    """A test vector: the inputs of a block from rest, and the outputs that the exported file must repeat."""

    inputs: Array  # (_TICKS, m)
    outputs: Array  # (_TICKS, m)


def coupling_block(stored: Stored) -> ExportedBlock:
    """Return the block V(z) from forces to displacements. Raises ValueError for a coupling without a V(z)."""
    V = stored.built().compliance(stored.loop.T)
    if V is None:
        reason = "this coupling has no V(z) in feedback around the environment; export its process with --process"
        raise ValueError(reason)
    about = ("d = V f: the deflection of the coupling. In its loop the environment sees u = x - d, and f = Psi E u.",)
    return ExportedBlock("coupling", _with_a_state(V), _FORCE, _DEFLECTION, about)


def process_block(
    stored: Stored,
    with_theta: bool = True,
    force_limit: Sequence[float] | None = None,
    balls: Sequence[slice] = (),
) -> ExportedBlock:
    """Return the block F(z) of (6) from displacements to forces.

    Args:
        stored: The coupling with its loop.
        with_theta: Whether the block contains the delays Theta; False if the link to the devices has them.
        force_limit: (m,) [N] limits of the certificate's limiter; None for a block without a limiter.
        balls: Groups of channels; the limiter limits the forces of each group as one vector.

    Raises:
        ValueError: The environment is a MuJoCo world, or the certificate covers no limiter.
    """
    loop, delays = stored.loop, _delays(stored.loop, with_theta)
    if not with_theta:
        loop = loop.delayed((0,) * loop.channels)
    if getattr(loop.environment, "world", None):
        raise ValueError("a MuJoCo world is no linear block: export the coupling alone, without --process")
    walls, about = len(loop.environment.walls), "f = F x: the whole discrete process; the devices get -f, held for T. "
    if force_limit is not None:
        law = _limiter(stored, loop, force_limit, balls)
        limited = "Lengths of a device's force vector" if balls else "Forces"
        about = (
            f"f: the whole discrete process with its limiter; the devices get -f, held for T. {limited} never exceed "
            f"{', '.join(f'{f:g}' for f in force_limit)} N while positions and states are "
            "finite: the virtual contact slips instead. NaN and infinity stay in the state until the reset."
        )
    else:
        law, about = loop.law(stored.built()) if walls else None, about + "Forces are not limited here."
    push = f"{walls} wall{'s' * (walls > 1)} can push, but not pull: contacts begin and end."
    lines = (about, *[push] * bool(walls), delays)
    system = law.uncut[0] if law else _with_a_state(loop.F(stored.built()))
    rotary = loop.unit == "rad"
    return ExportedBlock(
        "process", system, _DISPLACEMENT, _FORCE, lines, law, stored.loop.theta, with_theta, rotary=rotary
    )


def _limiter(stored: Stored, loop: Loop, force_limit: Sequence[float], balls: Sequence[slice]) -> Law:
    rho = limiter_rho(stored.loop, stored.certificate)
    if rho is None:
        raise ValueError("the certificate covers no limited forces: design the coupling anew, or omit --force-limit")
    return loop.law(stored.built(), force_limit, rho, balls)


def _with_a_state(system: Lti) -> Lti:
    """Return the same block with at least one state, because C has no empty arrays; an added state stays zero."""
    if system.order:
        return system
    m = system.inputs
    return Lti(np.zeros((1, 1)), np.zeros((1, m)), np.zeros((system.outputs, 1)), system.D, system.T)


def trial(block: ExportedBlock) -> _Trial:
    """Return normally distributed random inputs and their outputs.

    For a limiter, inputs are scaled so that unlimited forces would exceed a limit on a third of the ticks. With walls,
    inputs reach every wall (`_inputs`), and a limiter scales only their second half, so that unlimited forces would
    exceed a limit on a sixth of the ticks.
    """
    inputs, law, limiter = _inputs(block, _TICKS), block.law, block.limiter
    if limiter:
        walls = len(limiter.walls)
        free = _sequential(block.system, inputs, limiter.unlimited if walls else None)
        share = (magnitudes(free.T, limiter.sizes).T / limiter.limit).max(axis=1)
        often = np.quantile(share, 5 / 6 if walls else 2 / 3)
        inputs[_TICKS // 2 if walls else 0 :] /= often or 1.0
    inputs = inputs.astype(block.dtype)
    return _Trial(inputs, _sequential(block.system, inputs, law, block.dtype))


def in_single_precision(block: ExportedBlock) -> ExportedBlock:
    """Return the block in single precision, with its largest difference from double precision over _COMPARED ticks."""
    inputs = _inputs(block, _COMPARED)
    double, single = (_sequential(block.system, inputs, block.law, kind) for kind in (np.float64, np.float32))
    error, largest = float(np.abs(double - single).max()), float(np.abs(double).max())
    line = f"Single precision: {_COMPARED} ticks differ from double precision by at most {error:.2g} where the largest "
    line += f"{block.output.what} is {largest:.3g}. No proof covers this rounding."
    return replace(block, single=(error, largest), about=(*block.about, line))


def _inputs(block: ExportedBlock, ticks: int) -> Array:
    """Return random inputs (ticks, m). Where no wall touches, they reach each wall's gap on a third of the ticks."""
    G, walls = block.system, block.law.walls if block.law else ()
    inputs, w = block.input.size * np.random.default_rng(0).standard_normal((ticks, G.inputs)), len(walls)
    if walls:
        across = _sequential(Lti(G.A, G.B, G.A[-w:], G.B[-w:], G.T), inputs[:_TICKS])
        often = np.quantile(np.abs(across), 1 / 3, axis=0)
        reached = often > 1e-6 * block.input.size  # No device moves the other walls.
        inputs *= max([1.0, *np.abs([wall.gap for wall in walls])[reached] / often[reached]])
    return inputs


def _limits(limiter: Limiter, dtype: type[np.floating]) -> Array:
    """Return the force limits (m,) [N], rounded towards zero."""
    limits = limiter.limit.astype(dtype)
    return np.where(limits > limiter.limit, np.nextafter(limits, dtype(0)), limits)


def _sequential(system: Lti, inputs: Array, law: Law | None = None, dtype: type[np.floating] = np.float64) -> Array:
    """Return outputs (ticks, p) for inputs (ticks, m) from rest, with the order of sums in the exported file."""
    rows = np.block([[system.C, system.D], [system.A, system.B]]).astype(dtype)
    z, outputs, start = np.zeros(system.order, dtype), [], np.zeros(len(rows), dtype)
    tick = _Tick.of(law, dtype) if law else None
    for u in inputs.astype(dtype):
        sums = _in_order([start, *(rows * np.concatenate([z, u])).T])
        if tick:
            sums = tick.bent(sums, z)
        outputs.append(sums[: system.outputs])
        z = sums[system.outputs :]
    return np.array(outputs)


class _Tick(NamedTuple):
    """What follows a tick's linear block: n unknowns e are solved from q (n,), and `kick` e is added to [f; z+]."""

    sent: NDArray[np.intp]  # rows of the limited forces in [f; z+], the last entries of q
    kick: Array  # (m + order, n)
    problem: _Box | _Balls
    gap: Array  # (w,) [m] of the walls, whose q are the first entries
    steep: Array  # (w,) [N/m] a = K + B/T
    memory: Array  # (w,) [N/m] B/T

    @classmethod
    def of(cls, law: Law, dtype: type[np.floating]) -> _Tick:
        limiter, walls, T = law if isinstance(law, Limiter) else None, law.walls, law.sent.T
        sent = limiter.sent_rows if limiter else np.empty(0, np.intp)
        problem = _Balls.of(limiter, dtype) if limiter and limiter.balls else _Box.of(law, dtype)
        rows = [wall.gap for wall in walls], law.steepness, [wall.damping / T for wall in walls]
        kick = np.roll(law.uncut[1], len(walls), axis=1).astype(dtype)
        return cls(sent, kick, problem, *(np.array(row, dtype) for row in rows))

    def bent(self, sums: Array, z: Array) -> Array:
        """Return [f; z+] from `sums`, the outputs of the linear block, by the operations of the C file."""
        w = len(self.gap)
        depth, box = slice(len(sums) - w, None), self.problem
        sums[depth] -= self.gap
        q = np.concatenate([self.steep * sums[depth] - self.memory * z[len(z) - w :], sums[self.sent]])
        if isinstance(box, _Balls) or ((q > box.upper) | (q < box.lower)).any():
            e, f = _balled(box, q) if isinstance(box, _Balls) else _boxed(box, q)
            sums = _in_order([sums, *(self.kick * e).T])
            sums[self.sent] = f[w:]
        sums[depth] = np.where(sums[depth] < 0, 0, sums[depth])
        return sums


class _Box(NamedTuple):
    """The problem f = q - M e for forces within their limits and for walls, whose q is at most 0 without contact."""

    M: Array  # (n, n)
    lower: Array  # (n,) [N]
    upper: Array  # (n,) [N]
    weight: Array  # (n,) factors of e, which make it comparable with forces (BoxProblem.weight)

    @classmethod
    def of(cls, law: Law, dtype: type[np.floating]) -> _Box:
        problem, w = law.problem, len(law.walls)
        assert isinstance(problem, BoxProblem)
        limits = _limits(law, dtype) if isinstance(law, Limiter) else np.empty(0, dtype)
        share = _SINGLE_ROUNDING if dtype is np.float32 else GROUNDED
        lower, upper = np.append(np.full(w, -np.finfo(dtype).max), -limits), np.append(np.zeros(w, dtype), limits)
        M, weight = np.roll(problem.grounded(share), (w, w), (0, 1)), np.roll(problem.weight, w)
        return cls(M.astype(dtype), lower, upper, weight.astype(dtype))


def _turns(n: int) -> int:
    """Return the largest number of switches in a box problem: 3^n, which always suffices, but at most _MOST_TURNS."""
    return min(3**n, _MOST_TURNS)


def _rounding(dtype: type[np.floating]) -> float:
    """Return the largest rounding error of a residual, relative to the sum of the sizes of its terms."""
    return float(np.float32(_SINGLE_ROUNDING)) if dtype is np.float32 else PIVOT_ROUNDING


def _in_order(terms: Any) -> Any:
    """Return the sum of the terms, which are added one after another as in the C file."""
    return np.add.accumulate(terms)[-1]


def _solved(rows: Array, pivoting: bool) -> Array:
    """Solve A x = b (n,) for the rows [A b] (n, n + 1) by the operations of the C file; `rows` are overwritten."""
    n, x = len(rows), rows[:, -1].copy()
    for k in range(n):
        if pivoting:
            pivot = k + np.argmax(np.abs(rows[k:, k]))
            rows[[k, pivot]] = rows[[pivot, k]]
        ratio = rows[k + 1 :, k] / rows[k, k]
        rows[k + 1 :, k + 1 :] -= np.outer(ratio, rows[k, k + 1 :])
    for i in reversed(range(n)):
        x[i] = _in_order([rows[i, n], *-(rows[i, i + 1 : n] * x[i + 1 :])]) / rows[i, i]
    return x


def _boxed(box: _Box, q: Array) -> tuple[Array, Array]:
    """Solve f = q - M e (n,) for (e, f) by the operations of the C file, in their order and in the precision of q."""
    (M, lower, upper, weight), n, real = box, len(q), q.dtype.type
    zero, rounding = real(0), real(_rounding(real))
    sign = (q > upper).astype(real) - (q < lower)
    e = f = q
    for _ in range(_turns(n)):
        active, at = sign != 0, np.where(sign < 0, lower, upper)
        A = np.where(np.outer(active, active), M, np.eye(n, dtype=real))
        v = _solved(np.column_stack([A, np.where(active, q - at, zero)]), pivoting=False)
        products = (M * v).T
        force = _in_order([q, *-products])
        tiny = _in_order([np.abs(q), *np.abs(products)]) * rounding
        e = np.where(sign * v > 0, v, zero)
        f = np.where(active, at, np.clip(force, lower, upper))
        wrong = np.where(active, sign * v * weight < -tiny, (force > upper + tiny) | (force < lower - tiny))
        if not wrong.any():
            break
        first = np.argmax(wrong)
        sign[first] = zero if active[first] else (1 if force[first] > upper[first] else -1)
    return e, f


class _Balls(NamedTuple):
    """The problem f = q - M e for limited force vectors, with the channels in the order in which blocks are solved."""

    at: NDArray[np.intp]  # (m,) channel of each entry
    first: NDArray[np.intp]  # (m,) first entry of the vector to which each entry belongs
    last: NDArray[np.intp]  # (m,) end of the vector to which each entry belongs
    end: NDArray[np.intp]  # end of each block, whose vectors are solved together
    M: Array  # (m, m)
    resolvent: Array  # (m, m), (I + M/tau)^-1 of each block
    tau: Array  # (m,)
    limit: Array  # (m,) [N]

    @classmethod
    def of(cls, limiter: Limiter, dtype: type[np.floating]) -> _Balls:
        problem = limiter.problem
        assert isinstance(problem, BallProblem)
        blocks = problem.blocks
        at, tau = (np.concatenate(parts) for parts in zip(*((b.at, b.tau[:, 0]) for b in blocks), strict=True))
        end, sizes = np.cumsum([block.at.size for block in blocks]), [n for block in blocks for n in block.balls]
        last = np.repeat(np.cumsum(sizes), sizes)
        M, resolvent = problem.M[np.ix_(at, at)], np.eye(at.size)
        for block, stop in zip(blocks, end, strict=True):
            own = slice(stop - block.at.size, stop)
            M[own, own], resolvent[own, own] = block.M, np.linalg.inv(resolvent[own, own] + block.M / tau[own])
        M, resolvent, tau = (part.astype(dtype) for part in (M, resolvent, tau))
        return cls(at, last - np.repeat(sizes, sizes), last, end, M, resolvent, tau, _limits(limiter, dtype)[at])


def _balled(problem: _Balls, q: Array) -> tuple[Array, Array]:
    """Solve f = q - M e (m,) for (e, f) like the C function in _BALLS_DEFINED, in the precision of q."""
    at, first, last, ends, M, resolvent, tau, limit = problem
    e, f, v, begin = np.empty_like(q), np.empty_like(q), np.empty_like(q), 0
    for end in ends:
        own = slice(begin, end)
        q_own = _in_order([q[at[own]], *-(M[own, :begin] * v[:begin]).T])
        spans = dict.fromkeys(zip(first[own] - begin, last[own] - begin, strict=True))
        vectors = [slice(*span) for span in spans]
        v[own], f[at[own]] = _block_of_balls(M[own, own], resolvent[own, own], tau[own], limit[own], vectors, q_own)
        begin = end
    e[at] = v
    return e, f


def _block_of_balls(
    M: Array, resolvent: Array, tau: Array, limit: Array, vectors: Sequence[slice], q: Array
) -> tuple[Array, Array]:
    """Solve f = q - M e (n,) for (e, f) in a block of limited `vectors`; f is 0 if no solution is found."""
    n, real = len(q), q.dtype.type
    residual, rounding, eye = real(_RESIDUAL), real(_ball_rounding(real)), np.eye(n, dtype=real)
    u = back = q
    length, tried, best = np.empty_like(q), False, real(0)  # `tried`: u is a Newton step; `best`: the residual before
    for _ in range(_MOST_STEPS):
        for own in vectors:
            length[own] = np.sqrt(_in_order(u[own] * u[own]))
        over = length > limit
        share = np.divide(limit, length, out=np.ones_like(u), where=over)
        normal = np.divide(u, length, out=np.zeros_like(u), where=over)
        f = share * u
        e = (u - f) / tau
        products = (M * e).T
        r = _in_order([f - q, *products])
        size = _in_order([np.abs(f) + np.abs(q), *np.abs(products)]).max()
        worst = (np.abs(r) / np.maximum(residual * limit, rounding * size)).max()
        if worst <= 1:
            return e, f
        if tried and 2 * worst > best:
            u, tried = back, False
            continue
        if tried or best == 0:
            best = worst
        x = _in_order([q, *(M * ((2 * f - u) / tau)).T])
        back = _in_order([u - f, *(resolvent * x).T])  # the step of Douglas and Rachford
        slope = np.where(share < 1, share * (eye - np.outer(normal, normal)), eye)  # slope of f over u
        rows = np.zeros((n, n + 1), real)  # the equations of Newton's step
        for own in vectors:
            for k in range(own.start, own.stop):
                rows[k, own] += slope[k, own]
                rows[:, own] += np.outer(M[:, k] / tau[k], eye[k, own] - slope[k, own])
        rows[:, n] = r
        u, tried = u - _solved(rows, pivoting=True), True
    return _solved(np.column_stack([M, q]), pivoting=True), np.zeros_like(q)


def _ball_rounding(dtype: type[np.floating]) -> float:
    """Return the allowed rounding error of a block's residual, relative to the largest row sum of absolute terms."""
    return _BALL_ROUNDING * float(np.finfo(dtype).eps)


def _delays(loop: Loop, with_theta: bool) -> str:
    def shown(steps: Sequence[int]) -> str:
        return ", ".join(map(str, steps))

    theta = "included" if with_theta else "NOT included: the link to the devices must have this delay"
    return f"delays in samples: environment psi = {shown(loop.psi)}, transmission theta = {shown(loop.theta)} ({theta})"


_SOURCE_C = Template("""\
/*
$about
 *
 * One tick$unless:  $y = C z + D $u,  z+ = A z + B $u.  Every entry is one sum that
 * starts at 0.0 and adds the states z[0], z[1], .. and then the inputs, product by product. Compiled with IEEE ${real}s
 * (FLT_EVAL_METHOD 0), without contraction of a*b + c and without -ffast-math, the code repeats Python's test vector to
 * the last bit:
 *
 *     cc -std=c99 -O2 -ffp-contract=off -DHAPTIC_LOOP_TEST $file -o test$libm && ./test
 *
 * To include only the declarations: #define HAPTIC_LOOP_DECLARATIONS_ONLY, then #include "$file".
 */
#ifndef HAPTIC_LOOP_$NAME
#define HAPTIC_LOOP_$NAME

enum { ${NAME}_CHANNELS = $m, ${NAME}_STATES = $n };

#define ${NAME}_PERIOD $T /* [s] */
$macros
typedef struct {
    ${real} z[${NAME}_STATES];
$more_state} ${name}_state;

/* Sets the state to rest. */
void ${name}_reset(${name}_state *state);

/* One tick: $input in, $output out. */
void ${name}_step(${name}_state *state, const ${real} $u[${NAME}_CHANNELS], ${real} $y[${NAME}_CHANNELS]);
$more_declared
#ifndef HAPTIC_LOOP_DECLARATIONS_ONLY

$include$tables

void ${name}_reset(${name}_state *state)
{
    int i;
    for (i = 0; i < ${NAME}_STATES; i++)
        state->z[i] = 0.0${f};
$more_reset}

$limit_defined
void ${name}_step(${name}_state *state, const ${real} $u[${NAME}_CHANNELS], ${real} $y[${NAME}_CHANNELS])
{
    ${real} next[${NAME}_STATES], out[${NAME}_CHANNELS];
    int i, j;
    for (i = 0; i < ${NAME}_CHANNELS; i++) {
        ${real} sum = 0.0${f};
        for (j = 0; j < ${NAME}_STATES; j++)
            sum += ${name}_C[i][j] * state->z[j];
        for (j = 0; j < ${NAME}_CHANNELS; j++)
            sum += ${name}_D[i][j] * $u[j];
        out[i] = sum;
    }
    for (i = 0; i < ${NAME}_STATES; i++) {
        ${real} sum = 0.0${f};
        for (j = 0; j < ${NAME}_STATES; j++)
            sum += ${name}_A[i][j] * state->z[j];
        for (j = 0; j < ${NAME}_CHANNELS; j++)
            sum += ${name}_B[i][j] * $u[j];
        next[i] = sum;
    }
$limited    for (i = 0; i < ${NAME}_STATES; i++)
        state->z[i] = next[i];
    for (i = 0; i < ${NAME}_CHANNELS; i++)
        $y[i] = out[i];
}
$more_defined
#ifdef HAPTIC_LOOP_TEST
#include <stdio.h>
#include <string.h>

$tests

int main(void)
{
    ${name}_state state;
    ${real} out[${NAME}_CHANNELS];
    int run, k, i, wrong = 0;
    for (run = 0; run < 2; run++) { /* The second run tests the reset. */
        ${name}_reset(&state);
        for (k = 0; k < $ticks; k++) {
            ${name}_step(&state, test_input[k], out);
            for (i = 0; i < ${NAME}_CHANNELS; i++)
                if (memcmp(&out[i], &test_output[k][i], sizeof out[i]) != 0 && wrong++ == 0)
                    fprintf(stderr, "$name: tick %d: %a, expected %a\\n", k, out[i], test_output[k][i]);
        }
    }
    if (wrong)
        return 1;
    printf("$name: $ticks ticks repeat to the last bit\\n");
    return 0;
}
#endif /* HAPTIC_LOOP_TEST */

#endif /* HAPTIC_LOOP_DECLARATIONS_ONLY */
#endif /* HAPTIC_LOOP_$NAME */
""")

#: The user closes the feedback loop around an exported coupling and needs D and the free output to solve the loop.
_FREE_DECLARED = """
/* $y = free + D $u. The free part does not depend on this tick's $u. Use it with D to solve u = x - $y, $u = E(u). */
void ${name}_free(const ${name}_state *state, ${real} $y[${NAME}_CHANNELS]);
extern const ${real} ${name}_D[${NAME}_CHANNELS][${NAME}_CHANNELS];
"""
_FREE_DEFINED = """
void ${name}_free(const ${name}_state *state, ${real} $y[${NAME}_CHANNELS])
{
    int i, j;
    for (i = 0; i < ${NAME}_CHANNELS; i++) {
        $y[i] = 0.0${f};
        for (j = 0; j < ${NAME}_STATES; j++)
            $y[i] += ${name}_C[i][j] * state->z[j];
    }
}
"""


_SIZE_DEFINED = """
static ${real} ${name}_size(${real} a)
{
    return a < 0.0${f} ? -a : a;
}
"""
#: C code of the box problem, for ticks in which a force would exceed its limit or a wall touches
_LIMIT_DEFINED = """
/* Solves f = q - M e with f within the limits; e is 0 or has the sign of the reached limit. Every turn switches the
 * first wrong limit, and eliminates among the forces at their limits. At first every q beyond a limit is at it. */
static void ${name}_limit(const ${real} q[$unknowns], ${real} e[$unknowns], ${real} f[$unknowns])
{
    ${real} a[$unknowns][$unknowns], v[$unknowns];
    signed char sign[$unknowns];
    long turn;
    int wrong, i, j, k;
    for (i = 0; i < $unknowns; i++)
        sign[i] = (signed char)((q[i] > ${name}_BOUND[1][i]) - (q[i] < ${name}_BOUND[0][i]));
    for (turn = 0; turn < $turns; turn++) {
        for (i = 0; i < $unknowns; i++) {
            for (j = 0; j < $unknowns; j++)
                a[i][j] = ${name}_M[i][j];
            v[i] = sign[i] ? q[i] - ${name}_BOUND[sign[i] > 0][i] : 0.0${f};
        }
        for (k = 0; k < $unknowns; k++)
            for (i = k + 1; i < $unknowns; i++)
                if (sign[k] && sign[i]) {
                    ${real} ratio = a[i][k] / a[k][k];
                    for (j = k + 1; j < $unknowns; j++)
                        a[i][j] -= ratio * a[k][j];
                    v[i] -= ratio * v[k];
                }
        for (i = $unknowns - 1; i >= 0; i--) {
            if (!sign[i])
                continue;
            for (j = i + 1; j < $unknowns; j++)
                if (sign[j])
                    v[i] -= a[i][j] * v[j];
            v[i] /= a[i][i];
        }
        wrong = 0;
        for (i = 0; i < $unknowns; i++) {
            ${real} lower = ${name}_BOUND[0][i], upper = ${name}_BOUND[1][i];
            ${real} sum = q[i], size = ${name}_size(q[i]), along = sign[i] < 0 ? -v[i] : v[i], tiny;
            for (j = 0; j < $unknowns; j++)
                if (!sign[i] && sign[j])
                    sum -= ${name}_M[i][j] * v[j];
            e[i] = along > 0.0${f} ? v[i] : 0.0${f};
            f[i] = sign[i] ? ${name}_BOUND[sign[i] > 0][i] : sum > upper ? upper : sum < lower ? lower : sum;
            if (wrong || (sign[i] ? along >= 0.0${f} : sum <= upper && sum >= lower))
                continue;
            for (j = 0; j < $unknowns; j++)
                if (sign[j])
                    size += ${name}_size(${name}_M[i][j] * v[j]);
            tiny = size * $rounding;
            wrong = 1;
            if (!sign[i] && sum > upper + tiny)
                sign[i] = 1;
            else if (!sign[i] && sum < lower - tiny)
                sign[i] = -1;
            else if (sign[i] && along * ${name}_BOUND[2][i] < -tiny)
                sign[i] = 0;
            else
                wrong = 0;
        }
        if (!wrong)
            return;
    }
}
"""
#: C code for device forces that are limited as vectors
_BALLS_DEFINED = """
/* Solves A x = b for the rows from begin to end; b is in column end. */
static void ${name}_eliminate(${real} a[${NAME}_CHANNELS][${NAME}_CHANNELS + 1], int begin, int end, ${real} *x)
{
    int i, j, k, pivot;
    for (k = begin; k < end; k++) {
        pivot = k;
        for (i = k + 1; i < end; i++)
            if (${name}_size(a[i][k]) > ${name}_size(a[pivot][k]))
                pivot = i;
        for (j = begin; j <= end; j++) {
            ${real} other = a[k][j];
            a[k][j] = a[pivot][j];
            a[pivot][j] = other;
        }
        for (i = k + 1; i < end; i++) {
            ${real} ratio = a[i][k] / a[k][k];
            for (j = k + 1; j <= end; j++)
                a[i][j] -= ratio * a[k][j];
        }
    }
    for (i = end - 1; i >= begin; i--) {
        x[i] = a[i][end];
        for (j = i + 1; j < end; j++)
            x[i] -= a[i][j] * x[j];
        x[i] /= a[i][i];
    }
}

/* Solves f = q - M e with every device's vector f within its limit; e is 0, or parallel to f at the limit. A step of
 * Newton in u = f + tau e that does not halve the residual is replaced by one of Douglas and Rachford. If the steps do
 * not converge, f is 0. */
static int ${name}_limit(const ${real} q[${NAME}_CHANNELS], ${real} e[${NAME}_CHANNELS], ${real} f[${NAME}_CHANNELS])
{
    ${real} u[${NAME}_CHANNELS], g[${NAME}_CHANNELS], v[${NAME}_CHANNELS], r[${NAME}_CHANNELS], x[${NAME}_CHANNELS];
    ${real} rhs[${NAME}_CHANNELS], back[${NAME}_CHANNELS], normal[${NAME}_CHANNELS], share[${NAME}_CHANNELS];
    ${real} a[${NAME}_CHANNELS][${NAME}_CHANNELS + 1];
    int block, turn, i, j, k, begin = 0, converged = 1;
    for (block = 0; block < $blocks; block++) {
        ${real} best = 0.0${f};
        int end = ${name}_END[block], solved = 0, tried = 0;
        for (i = begin; i < end; i++) {
            rhs[i] = q[${name}_AT[i]];
            for (j = 0; j < begin; j++)
                rhs[i] -= ${name}_M[i][j] * v[j];
            u[i] = rhs[i];
        }
        for (turn = 0; turn < $turns; turn++) {
            ${real} size = 0.0${f}, worst = 0.0${f};
            for (i = begin; i < end; i++) {
                ${real} square = 0.0${f}, length;
                for (k = ${name}_FIRST[i]; k < ${name}_LAST[i]; k++)
                    square += u[k] * u[k];
                length = sqrt${f}(square);
                share[i] = 1.0${f};
                normal[i] = 0.0${f};
                g[i] = u[i];
                if (length > ${name}_LIMIT[0][i]) {
                    share[i] = ${name}_LIMIT[0][i] / length;
                    normal[i] = u[i] / length;
                    g[i] = share[i] * u[i];
                }
                v[i] = (u[i] - g[i]) / ${name}_TAU[0][i];
            }
            for (i = begin; i < end; i++) {
                ${real} terms = ${name}_size(g[i]) + ${name}_size(rhs[i]);
                r[i] = g[i] - rhs[i];
                for (j = begin; j < end; j++) {
                    r[i] += ${name}_M[i][j] * v[j];
                    terms += ${name}_size(${name}_M[i][j] * v[j]);
                }
                size = terms > size ? terms : size;
            }
            for (i = begin; i < end; i++) {
                ${real} allowed = $residual * ${name}_LIMIT[0][i], part;
                allowed = $rounding * size > allowed ? $rounding * size : allowed;
                part = ${name}_size(r[i]) / allowed;
                worst = part > worst ? part : worst;
            }
            if (worst <= 1.0${f}) {
                solved = 1;
                break;
            }
            if (tried && 2.0${f} * worst > best) {
                for (i = begin; i < end; i++)
                    u[i] = back[i];
                tried = 0;
                continue;
            }
            if (tried || best == 0.0${f})
                best = worst;
            for (i = begin; i < end; i++) {
                x[i] = rhs[i];
                for (j = begin; j < end; j++)
                    x[i] += ${name}_M[i][j] * ((2.0${f} * g[j] - u[j]) / ${name}_TAU[0][j]);
            }
            for (i = begin; i < end; i++) {
                back[i] = u[i] - g[i];
                for (j = begin; j < end; j++)
                    back[i] += ${name}_R[i][j] * x[j];
                for (j = begin; j < end; j++) {
                    a[i][j] = 0.0${f};
                    for (k = ${name}_FIRST[j]; k < ${name}_LAST[j]; k++) {
                        ${real} same = k == j ? 1.0${f} : 0.0${f}, slope = same;
                        if (share[j] < 1.0${f})
                            slope = share[j] * (same - normal[k] * normal[j]);
                        if (k == i)
                            a[i][j] += slope;
                        a[i][j] += ${name}_M[i][k] / ${name}_TAU[0][k] * (same - slope);
                    }
                }
                a[i][end] = r[i];
            }
            ${name}_eliminate(a, begin, end, x);
            for (i = begin; i < end; i++)
                u[i] -= x[i];
            tried = 1;
        }
        if (!solved) {
            for (i = begin; i < end; i++) {
                for (j = begin; j < end; j++)
                    a[i][j] = ${name}_M[i][j];
                a[i][end] = rhs[i];
                g[i] = 0.0${f};
            }
            ${name}_eliminate(a, begin, end, v);
            converged = 0;
        }
        begin = end;
    }
    for (i = 0; i < ${NAME}_CHANNELS; i++) {
        e[${name}_AT[i]] = v[i];
        f[${name}_AT[i]] = g[i];
    }
    return converged;
}
"""
_LIMITED = """    {
        ${real} q[$unknowns], e[$unknowns], f[$unknowns];
        int more = $always;
$asked$pushed$reached        if (more) {
            $limit;
            for (j = 0; j < $unknowns; j++) {
                if (e[j] == 0.0${f})
                    continue;
                for (i = 0; i < ${NAME}_CHANNELS; i++)
                    out[i] += ${name}_KICK[i][j] * e[j];
                for (i = 0; i < ${NAME}_STATES; i++)
                    next[i] += ${name}_KICK[${NAME}_CHANNELS + i][j] * e[j];
            }
$sent        }
$apart    }
"""
#: C code of force limits
_ASKED = """        for (i = 0; i < ${NAME}_CHANNELS; i++)
            q[$walls + i] = ${name}_SENT[i] < ${NAME}_CHANNELS ? out[${name}_SENT[i]]
                                                             : next[${name}_SENT[i] - ${NAME}_CHANNELS];
"""
_SENT = """            for (i = 0; i < ${NAME}_CHANNELS; i++)
                if (${name}_SENT[i] < ${NAME}_CHANNELS)
                    out[${name}_SENT[i]] = f[$walls + i];
                else
                    next[${name}_SENT[i] - ${NAME}_CHANNELS] = f[$walls + i];
"""
#: C code of walls: the last states are the depths in them, which are computed from the displacements across them
_PUSHED = """        for (i = 0; i < $walls; i++) {
            j = ${NAME}_STATES - $walls + i;
            next[j] -= ${name}_WALL[0][i];
            q[i] = ${name}_WALL[1][i] * next[j] - ${name}_WALL[2][i] * state->z[j];
        }
"""
_APART = """        for (i = ${NAME}_STATES - $walls; i < ${NAME}_STATES; i++)
            next[i] = next[i] < 0.0${f} ? 0.0${f} : next[i];
"""
_REACHED = """        for (i = 0; i < $unknowns; i++)
            more |= q[i] < ${name}_BOUND[0][i] || q[i] > ${name}_BOUND[1][i];
"""


def c_source(block: ExportedBlock, test: _Trial, file: str) -> str:
    """Return the text of the C file. The numbers of its tables are hexadecimal, so that compilers round no decimals."""
    system, name, dtype = block.system, block.name, block.dtype
    words = {
        "name": name,
        "NAME": name.upper(),
        "file": file,
        "about": "\n".join(_comment_c(block.about)),
        "u": block.input.letter,
        "y": block.output.letter,
        "input": block.input.what,
        "output": block.output.what,
        "m": system.inputs,
        "unless": (" without contact" if block.law and block.law.walls else "") + ", if no force is limited",
        "n": system.order,
        "T": repr(system.T),
        "real": "float" if block.single else "double",
        "f": "f" if block.single else "",
        "ticks": _TICKS,
        "tables": "\n\n".join(
            _table(
                f"{'' if name == 'coupling' and letter == 'D' else 'static '}const", f"{name}_{letter}", matrix, dtype
            )
            for letter, matrix in (("A", system.A), ("B", system.B), ("C", system.C), ("D", system.D))
        ),
        "tests": "\n\n".join(
            _table("static const", f"test_{side}", values, dtype)
            for side, values in (("input", test.inputs), ("output", test.outputs))
        ),
    }
    most = max(block.limiter.limit) if block.limiter else 0.0
    macros = {
        "PERIOD_NS": round(min(1e9 * system.T, _MOST_INTEGER)),
        "THETA_LEAST": min(block.theta, default=0),
        "THETA_MOST": max(block.theta, default=0),
        "THETA_INCLUDED": int(block.delayed),
        "CERTIFIED": int(block.certified),
        "ROTARY": int(block.rotary),
        "FORCE_LIMIT_MN": math.ceil(min(round(1e3 * most, 6), _MOST_INTEGER)),
    }
    lines = [f"#define {words['NAME']}_{macro} {value}\n" for macro, value in macros.items()]
    shown = "/* for checks: period [ns], delays theta [samples], certified, in rad, largest limited force [mN] */\n"
    words["macros"] = shown + "".join(lines) if name == "process" else ""
    for word in ("limit_defined", "limited", "libm", "include", "more_state", "more_reset"):
        words[word] = ""
    if block.law:
        _add_inequalities(words, block, block.law)
    for word, text in (("more_declared", _FREE_DECLARED), ("more_defined", _FREE_DEFINED)):
        words[word] = Template(text).substitute(words) if name == "coupling" else ""
    return _SOURCE_C.substitute(words)


def _add_inequalities(words: dict[str, Any], block: ExportedBlock, law: Law) -> None:
    """Add the C code of limiter and walls and their tables to `words`."""
    name, tick, w = block.name, _Tick.of(law, block.dtype), len(law.walls)
    integers, tables, defined = {}, {}, _LIMIT_DEFINED
    words |= {"walls": w, "unknowns": tick.kick.shape[1]}
    if isinstance(tick.problem, _Balls):
        balls, defined = tick.problem, _BALLS_DEFINED
        tables |= {"LIMIT": [balls.limit], "M": balls.M, "R": balls.resolvent, "TAU": [balls.tau]}
        integers |= {"AT": balls.at, "FIRST": balls.first, "LAST": balls.last, "END": balls.end}
        words |= {"turns": str(_MOST_STEPS), "blocks": str(len(balls.end)), "libm": " -lm", "always": "1"}
        words |= {"residual": _RESIDUAL.hex() + words["f"], "rounding": _ball_rounding(block.dtype).hex() + words["f"]}
        words |= {"include": "#include <math.h>\n\n", "more_reset": "    state->unsolved = 0;\n"}
        words["more_state"] = "    unsigned long unsolved; /* ticks in which a force was set to 0 */\n"
        words["limit"] = f"state->unsolved += !{name}_limit(q, e, f)"
    else:
        tables |= {"BOUND": tick.problem[1:], "M": tick.problem.M}
        words |= {"turns": str(_turns(words["unknowns"])), "rounding": _rounding(block.dtype).hex() + words["f"]}
        words |= {"always": "0", "limit": f"{name}_limit(q, e, f)"}
    if block.limiter:
        integers["SENT"] = tick.sent
    if w:
        tables["WALL"] = [tick.gap, tick.steep, tick.memory]
    for of, rows in {**tables, "KICK": tick.kick}.items():
        words["tables"] += "\n\n" + _table("static const", f"{name}_{of}", np.asarray(rows), block.dtype)
    for of, values in integers.items():
        row = ", ".join(map(str, values))
        words["tables"] += f"\n\nstatic const int {name}_{of}[{len(values)}] = {{{row}}};"
    parts = {"asked": (_ASKED, block.limiter), "sent": (_SENT, block.limiter), "pushed": (_PUSHED, w)}
    parts |= {"apart": (_APART, w), "reached": (_REACHED, isinstance(tick.problem, _Box))}
    for part, (text, present) in parts.items():
        words[part] = Template(text).substitute(words) if present else ""
    words["limit_defined"] = Template(_SIZE_DEFINED + defined).substitute(words)
    words["limited"] = Template(_LIMITED).substitute(words)


def _comment_c(lines: Iterable[str]) -> Iterable[str]:
    for line in lines:
        harmless = " ".join(line.split()).replace("*/", "* /").replace("/*", "/ *")
        yield from textwrap.wrap(harmless, 108, initial_indent=" * ", subsequent_indent=" *     ")


def _table(storage: str, name: str, values: Array, dtype: type[np.floating]) -> str:
    real, suffix = ("float", "f") if dtype is np.float32 else ("double", "")
    rows = ",\n".join(_row(row, suffix) for row in np.asarray(values).astype(dtype))
    return f"{storage} {real} {name}[{len(values)}][{values.shape[1]}] = {{\n{rows}\n}};"


def _row(values: Array, suffix: str) -> str:
    text = ", ".join(float(v).hex() + suffix for v in values)
    return "\n".join(textwrap.wrap(f"{{{text}}}", 112, initial_indent="    ", subsequent_indent="     "))


def with_origin(
    block: ExportedBlock, file: str, stored: Stored, verdict: Verdict, claim: str | None = None
) -> ExportedBlock:
    """Add comment lines on the coupling's `file` and on its proof; `claim` is a further line."""
    written = f"Written by python -m design.export from {file}: {_gains(stored)}"
    proved = _guarantee(stored, verdict, block.limiter)
    certified = stored.certificate is not None and verdict.proved
    return replace(block, about=(written, *block.about, proved, *([claim] if claim else [])), certified=certified)


def _gains(stored: Stored) -> str:
    coupling = stored.built()
    if "K" in (gains := coupling.figures(stored.loop.T)):
        return f"{coupling.kind}, K = {listed(gains['K'])} N/m, B = {listed(gains['B'])} N s/m"
    return f"coupling of kind {stored.coupling.__struct_config__.tag}"


def _guarantee(stored: Stored, verdict: Verdict, limiter: Limiter | None) -> str:
    claim = stored.certificate
    if claim is None or not verdict.proved:
        return f"NOT CERTIFIED: {verdict.reason}"
    needs = f"needs {listed(claim.required)} of {listed(claim.available)} N s/m of device damping"
    how = f"{claim.condition}, proof: {claim.proof}"
    if claim.guarantee == RANGES and stored.loop.ranges:
        where = where_proved(stored.loop.network, stored.loop.ranges)
        how += f"; proved at {where} only: design.check searches between them"
    forces = "only while forces stay below their limits"
    if limiter:
        forces = f"also while forces are limited to {listed(limiter.limit.tolist())} N"
    only = "; ".join((*covered(stored.loop, claim), forces, "encoder steps are not covered"))
    where = claim.guarantee
    if stored.loop.environment.walls and where in (ANY, HERE):
        where = f"{ANY}, with or without walls" if where == ANY else MAKING
    theta = ", ".join(map(str, stored.loop.theta))
    return f"Certified for theta = {theta} and {where} ({how}): {needs}; {only}."
