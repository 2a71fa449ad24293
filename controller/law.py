"""The law of a tick from positions to forces: a linear block, walls that push, and limited forces."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, cast

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.complementarity import BallProblem, BoxProblem, Complementarity, magnitudes
from haptic_loop.controller.delay import delay
from haptic_loop.controller.environment import Wall
from haptic_loop.controller.lti import Array, Lti, ReadOnly, frozen, taps

# ----------------------------------------------------------------------------------------------------
# Walls are springs that push and never pull, so that contacts begin and end (docs/theory.md).
#
# Let y be the displacement across a wall of stiffness K and damping B, and d = y - gap the depth. The wall's force is
#
#         p[k] = max(0, K h[k] + B (h[k] - h[k-1])/T),    h = max(0, d),
#
# which is a ramp, p = a max(0, d - c) with a = K + B/T and c = B h[k-1] / (T a).
#
# The wall forces p are further inputs of the linear block, and the displacements y are further outputs. Environment and
# coupling respond within the tick: y = y_free - D p, where y_free is y for p = 0, and -D is the feedthrough. The forces
# solve the linear complementarity problem
#
#         p >= 0,   s = (1/a + D) p - (y_free - gap - c) >= 0,   p' s = 0,
#
# which has exactly one solution, since D is positive semidefinite for a passive environment and coupling.


Transition = Callable[[Array, Array], object]  # [z; x] (order + m, nsim) -> writes [f; z+] (m + order, nsim)
State = tuple[bool, ...]  # for each wall, whether it touches


@dataclass(frozen=True, eq=False)
class Law(ReadOnly):
    """The map of a tick from positions to forces: the linear block of a loop, and walls that push.

    `sent` is the block from [x; p] to [f_e; y], with the forces f_e before Theta. The walls compute p from y. The state
    consists of the state of the block with its delays, and of h [m], the depth in each wall at the previous tick.
    Raises SingularLoop if the walls' forces are not unique, and ValueError if `sent` does not have m + w
    inputs and outputs.
    """

    sent: Lti  # m + w inputs and outputs, for w walls
    theta: tuple[int, ...] = ()  # (m,) delays of the forces [samples]; () means no delay
    walls: tuple[Wall, ...] = ()

    def __post_init__(self) -> None:
        G, w = self.sent, len(self.walls)
        object.__setattr__(self, "theta", tuple(self.theta) or (0,) * (G.inputs - w))
        if not G.inputs == G.outputs == self.channels + w > w:
            shape = f"{G.outputs} x {G.inputs}"
            raise ValueError(f"a block of {shape} cannot serve {self.channels} channels and {w} walls")
        if w:
            _ = self._problem

    @property
    def channels(self) -> int:
        return len(self.theta)

    @property
    def unsolved(self) -> int:
        """The number of times that limited forces were set to 0 because no solution was found."""
        return 0

    @property
    def without_theta(self) -> Self:
        return replace(self, theta=(0,) * self.channels)

    @property
    def unlimited(self) -> Self:
        """The law without force limits."""
        return self

    @property
    def bounds(self) -> list[tuple[int, float]]:
        """The pair (row of [f; z+], bound [N]) of each limited force. Within these bounds no force is changed."""
        return []

    def limited(self, z: Array, force: Array, most: Array) -> NDArray[np.bool_]:
        """Return whether each force (ticks, m, ..) reached the actuators' limits `most` (m, ..) [N]."""
        return np.abs(force) >= most

    @property
    def steepness(self) -> Array:
        """a = K + B/T of each wall, (w,) [N/m]."""
        return np.array([w.stiffness + w.damping / self.sent.T for w in self.walls])

    @cached_property
    def problem(self) -> BoxProblem | BallProblem:
        """The problem of a tick with the wall forces p as unknowns. Its rows are scaled to N."""
        w = len(self.walls)
        return BoxProblem(self.steepness[:, None] * self._problem.M, np.full(w, -np.inf), np.zeros(w))

    @cached_property
    def _problem(self) -> Complementarity:
        m = self.channels
        return Complementarity(np.diag(1 / self.steepness) - self.sent.D[m:, m:])

    def _delayed(self, block: Lti) -> Lti:
        T = block.T
        return Lti.diag(delay(self.theta, T), Lti.constant(np.eye(len(self.walls)), T)) @ block

    @cached_property
    def _block(self) -> Lti:
        """The block [x; p] -> [f; y]. The inputs p are the unknowns of a tick."""
        return self._delayed(self.sent)

    @cached_property
    def open(self) -> Lti:
        """F while no wall touches, with the state of the law including h."""
        G, m, w = self._block, self.channels, len(self.walls)
        A, B = np.pad(G.A, ((0, w), (0, w))), np.pad(G.B[:, :m], ((0, w), (0, 0)))
        return Lti(A, B, np.pad(G.C[:m], ((0, 0), (0, w))), G.D[:m, :m], G.T)

    @cached_property
    def uncut(self) -> tuple[Lti, Array]:
        """A tick before its inequalities, for code that solves them by itself: a block and a matrix.

        The block is `open`, but the last w rows of A and B give the displacements y across the walls. The matrix
        (m + order, n) maps the n unknowns of the tick to [f; z+], where y takes the place of h.
        """
        G, m, w, F = self._block, self.channels, len(self.walls), self.open
        A = np.vstack([F.A[: G.order], np.pad(G.C[m:], ((0, 0), (0, w)))])
        block = Lti(A, np.vstack([F.B[: G.order], G.D[m:, :m]]), F.C, F.D, F.T)
        return block, np.vstack([G.D[:m, m:], G.B[:, m:], G.D[m:, m:]])

    @property
    def linear(self) -> Array:
        """The matrix (m + order, order + m) from [z; x] to [f; z+], while no wall touches and no force is limited."""
        F = self.open
        return np.block([[F.C, F.D], [F.A, F.B]])

    def at_rest(self, x: Array) -> Array:
        """Return the steady state for held displacements x (m,) [m], with no wall touching."""
        return self.open.at_rest(x)

    def frozen(self) -> dict[State, Lti]:
        """Return F for every set of touching walls, from none to all, without the constant offsets that gaps cause."""
        block, m, T, walls = self._delayed(self.sent), self.channels, self.sent.T, range(len(self.walls))
        if not self.walls:
            return {(): block}
        zero, one = np.zeros((1, 1)), np.ones((1, 1))
        stiff = [Lti(zero, one, w.damping / T * one, -(w.stiffness + w.damping / T) * one, T) for w in self.walls]
        none, maps = Lti.constant([[0.0]], T), {}
        for touching in itertools.product((False, True), repeat=len(self.walls)):
            back = Lti.diag(*[none] * m, *(stiff[i] if touching[i] else none for i in walls))
            G = block.feedback(back)
            maps[touching] = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], T)
        return maps

    def transition(self) -> Transition:
        """Return the function that computes one tick of any number of simulations."""
        if not self.walls:
            return self.linear.dot
        G, m, w, F = self._block, self.channels, len(self.walls), self.open
        gap = np.array([wall.gap for wall in self.walls])[:, None]
        memory = (np.array([wall.damping for wall in self.walls]) / G.T / self.steepness)[:, None]
        linear = self.linear.dot
        reach = np.block([G.C[m:], np.zeros((w, w)), G.D[m:, :m]]).dot
        kick, give = np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, w))]).dot, G.D[m:, m:].dot
        solve, depth = self._problem.solve, slice(G.order, F.order)

        def tick(before: Array, after: Array) -> None:
            d = reach(before) - gap  # depth without the walls' forces
            force = solve(d - memory * before[depth])
            linear(before, after)
            after += kick(force)
            np.maximum(d + give(force), 0.0, out=after[-w:])

        return tick

    def together(self, laws: Sequence[Law]) -> Transition:
        """Return the function of one tick for several laws of this kind and size, with one simulation for each."""
        if not self.walls:
            return _side_by_side(laws)
        return _one_by_one(laws) if len(self.walls) > 1 else _one_wall(laws)

    def depths(self, z: Array) -> Array:
        """Return h [m] at each tick but the last, (ticks - 1, w, ..), from the states (ticks, order, ..)."""
        return z[1:, z.shape[1] - len(self.walls) :]


def _side_by_side(laws: Sequence[Law]) -> Transition:
    """Return the function of one tick for several linear laws."""
    blocks = _last_axis([law.linear for law in laws])
    return lambda before, after: np.einsum("oin,in->on", blocks, before, out=after)


def _one_by_one(laws: Sequence[Law]) -> Transition:
    """Return the function of one tick for several laws of any kind, which are computed one after the other."""
    transitions = [law.transition() for law in laws]

    def together(before: Array, after: Array) -> None:
        column = np.empty((after.shape[0], 1))
        for i, transition in enumerate(transitions):
            transition(np.ascontiguousarray(before[:, i : i + 1]), column)
            after[:, i : i + 1] = column

    return together


def _one_wall(laws: Sequence[Law]) -> Transition:
    """Return the function of one tick for several laws with one wall each, which have scalar equations."""
    m, blocks = laws[0].channels, [law._block for law in laws]
    linear, order = _side_by_side(laws), blocks[0].order
    reach = _last_axis([np.concatenate([G.C[m], [0.0], G.D[m, :m]]) for G in blocks])
    kick = _last_axis([np.concatenate([G.D[:m, m], G.B[:, m], [0.0]]) for G in blocks])
    give, M = np.array([G.D[m, m] for G in blocks]), np.array([law._problem.M[0, 0] for law in laws])
    gap, damping = (np.array([getattr(law.walls[0], name) for law in laws]) for name in ("gap", "damping"))
    memory = damping / laws[0].sent.T / np.array([law.steepness[0] for law in laws])

    def together(before: Array, after: Array) -> None:
        d = np.einsum("in,in->n", reach, before) - gap
        force = np.maximum(d - memory * before[order], 0.0) / M
        linear(before, after)
        after += kick * force
        after[-1] = np.maximum(d + give * force, 0.0)

    return together


def _last_axis(parts: Sequence[Array]) -> Array:
    return np.ascontiguousarray(np.moveaxis(np.array(parts), 0, -1))


# ----------------------------------------------------------------------------------------------------
# The limiter subtracts a slip e (e_- at the previous tick) from x. The map G from x gives the forces f_e before Theta
# (docs/theory.md, (h)). A stiffness rho >= 0 resists changes of e. With the limits L_i
#
#         f_e = G (x - e) - rho (e - e_-),      |f_e,i| <= L_i,      e_i f_e,i = L_i |e_i|.
#
# While no force reaches its limit, e = 0. Let f_free be f_e for e = 0 at this tick (earlier slips included), and D_G
# the feedthrough of G. The limiter solves f_e = f_free - (D_G + rho) e, where e is in the normal cone of the box at
# f_e. The walls are solved at the same time: their forces p are in the normal cone of (-inf, 0] at a (d - c) - p. Slips
# and wall forces together solve one box problem (controller.complementarity).


@dataclass(frozen=True, eq=False, kw_only=True)
class Limiter(Law):
    """A law whose forces f_e are limited by a slip e before Theta.

    The state consists of the state of `sent`, e [m] at the previous tick, the delay lines of Theta, and h [m] of the
    walls. Raises SingularLoop if the limited forces are not unique.
    """

    limit: Array  # (m,) [N], inf without a limit; the same for all channels of a ball
    rho: Array  # (m,) [N/m] 0 for any-environment with psi = 0, else beta/T times the device's least damping
    balls: tuple[slice, ...] = ()  # groups of neighbouring channels whose force is limited as a vector

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("limit", "rho"):
            value = frozen(getattr(self, name), 1, name)
            object.__setattr__(self, name, value)
            if value.shape != (self.channels,):
                raise ValueError(f"{name} has {value.size} entries for {self.channels} channels")
        if not (self.limit > 0).all():
            raise ValueError(f"limit is {self.limit.tolist()}, expected positive forces in N")
        if not ((self.rho >= 0) & (self.rho < np.inf)).all():
            raise ValueError(f"rho is {self.rho.tolist()}, expected stiffnesses >= 0 in N/m")
        if self.balls and self.walls:
            raise ValueError("walls cannot be combined with forces that are limited as vectors: give limits per axis")
        _ = self.problem

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """The number of channels of each limited force: those of a vector, or 1; () if `balls` is empty."""
        sizes, at = [], 0
        while self.balls and at < self.channels:
            end = next((ball.stop for ball in self.balls if ball.start == at), at + 1)
            sizes.append(end - at)
            at = end
        return tuple(sizes)

    @property
    def unsolved(self) -> int:
        return self.problem.unsolved[0] if isinstance(self.problem, BallProblem) else 0

    @property
    def unlimited(self) -> Self:
        return replace(self, limit=np.full(self.channels, np.inf))

    @property
    def bounds(self) -> list[tuple[int, float]]:
        # No vector within this box is longer than its limit.
        box = self.limit / np.sqrt(np.repeat(self.sizes, self.sizes)) if self.sizes else self.limit
        return list(zip(self.sent_rows.tolist(), box.tolist(), strict=True))

    def limited(self, z: Array, force: Array, most: Array) -> NDArray[np.bool_]:
        """Return whether the limiter slipped at each tick but the last; the limited force acts theta ticks later."""
        return self.slips(z) != 0

    @cached_property
    def _step(self) -> Lti:
        """The block from [x; e; p] to [f_e; y], with the states of `sent` and e_-."""
        m, w, T = self.channels, len(self.walls), self.sent.T
        one, zero = np.eye(m + w), np.zeros((w, m))
        lag = Lti.diag(*(taps([-r, r], T) for r in self.rho))
        ports = np.hstack([one[:, :m], -one[:, :m], one[:, m:]])
        into = np.hstack([np.zeros((m, m)), np.eye(m), zero.T])
        return self.sent @ ports + np.vstack([np.eye(m), zero]) @ lag @ into

    @cached_property
    def _block(self) -> Lti:
        """The block from [x; e; p] to [f; y], with the states of `sent`, e_- and Theta."""
        return self._delayed(self._step)

    @cached_property
    def problem(self) -> BoxProblem | BallProblem:
        """The problem of a tick with the unknowns [e; p]. The walls' rows are scaled to N."""
        m, w = self.channels, len(self.walls)
        if self.balls:
            return BallProblem(-self._step.D[:, m:], self.limit, self.sizes)
        scale = np.concatenate([np.ones(m), self.steepness])[:, None]
        M = -scale * self._step.D[:, m:] + np.diag(np.concatenate([np.zeros(m), np.ones(w)]))
        lower = np.concatenate([-self.limit, np.full(w, -np.inf)])
        return BoxProblem(M, lower, np.concatenate([self.limit, np.zeros(w)]))

    @cached_property
    def kick(self) -> Array:
        """The matrix (m + order, m + w) from [e; p] to [f; z+]."""
        G, m, w = self._block, self.channels, len(self.walls)
        return np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, m + w))])

    @cached_property
    def sent_rows(self) -> NDArray[np.intp]:
        """The rows (m,) of f_e in [f; z+]: the output, or the first state of the output's delay line."""
        m = self.channels
        lines = m + self._step.order + np.concatenate([[0], np.cumsum(self.theta)[:-1]]).astype(int)
        return np.where(np.array(self.theta) == 0, np.arange(m), lines)

    def transition(self) -> Transition:
        m, w, F, step, block = self.channels, len(self.walls), self.open, self._step, self._block
        linear, kick, sent = self.linear.dot, self.kick, self.sent_rows
        limit, solve, balls = self.limit[:, None], self.problem.solve, self.sizes
        if not w:

            def tick(before: Array, after: Array) -> None:
                linear(before, after)
                free = after.take(sent, axis=0)
                touched = magnitudes(free, balls) > limit
                if b"\1" not in touched.tobytes():  # several times as fast as touched.any() for few channels
                    return
                at = slice(None) if touched.shape[1] == 1 else np.flatnonzero(touched.any(axis=0))
                e, f = solve(free[:, at])
                bent = after[:, at] + kick @ e
                bent[sent] = f
                after[:, at] = bent

            return tick

        gap = np.array([wall.gap for wall in self.walls])[:, None]
        steep = self.steepness[:, None]
        memory = np.array([wall.damping / F.T for wall in self.walls])[:, None]
        d_of = np.hstack([step.C[m:], np.zeros((w, block.order - step.order + w)), step.D[m:, :m]]).dot
        give, depth = step.D[m:, m:], slice(block.order, block.order + w)
        assert isinstance(self.problem, BoxProblem)
        upper, lower = self.problem.upper[:, None], self.problem.lower[:, None]

        def walled_tick(before: Array, after: Array) -> None:
            d = d_of(before) - gap  # depth without wall forces and slip
            linear(before, after)
            right = np.vstack([after.take(sent, axis=0), steep * d - memory * before[depth]])
            touched = ((right > upper) | (right[: m + w] < lower)).any(axis=0)
            at = np.flatnonzero(touched)
            if at.size:
                v, f = solve(right[:, at])
                bent = after[:, at] + kick @ v
                bent[sent] = f[:m]
                after[:, at] = bent
                d[:, at] += give @ v
            np.maximum(d, 0.0, out=after[-w:])

        return walled_tick

    def together(self, laws: Sequence[Law]) -> Transition:
        """Return the function of one tick in which only laws with a force beyond its limit solve their problem."""
        if self.walls:
            return _one_by_one(laws)
        limiters = cast("Sequence[Limiter]", laws)
        linear, sent, limit = _side_by_side(laws), self.sent_rows, _last_axis([each.limit for each in limiters])

        def together(before: Array, after: Array) -> None:
            linear(before, after)
            free = after[sent]
            for i in np.flatnonzero((magnitudes(free, self.sizes) > limit).any(axis=0)).tolist():
                slip, force = limiters[i].problem.solve(free[:, i : i + 1])
                after[:, i : i + 1] += limiters[i].kick @ slip
                after[sent, i] = force[:, 0]

        return together

    def at_rest(self, x: Array) -> Array:
        """Return the steady state for held displacements x (m,) [m], with no wall touching.

        The slip e keeps the static force F(1) (x - e), which the delay lines hold, within the limits.
        """
        m, G = self.channels, self.sent
        free = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], G.T)
        stiffness = np.stack([free.C @ free.at_rest(unit) for unit in np.eye(m)], axis=1) + free.D
        problem = (
            BallProblem(stiffness, self.limit, self.sizes)
            if self.balls
            else BoxProblem(stiffness, -self.limit, self.limit)
        )
        (e,), (f,) = (side.T for side in problem.solve(stiffness @ x[:, None]))
        lines = np.repeat(f, self.theta)
        return np.concatenate([free.at_rest(x - e), e, lines, np.zeros(len(self.walls))])

    def slips(self, z: Array) -> Array:
        """Return the slips e (ticks - 1, m, ..) [m] at each tick but the last; zero if the force was not limited."""
        return z[1:, self.sent.order : self.sent.order + self.channels]
