"""The force limiter: no force leaves that a device cannot give, and the guarantee stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.complementarity import BoxProblem
from controller.environment import Wall
from controller.law import Law, Transition, last_axis, one_by_one, side_by_side
from controller.lti import Array, Lti, frozen, taps

# ----------------------------------------------------------------------------------------------------
# The limiter: forces leave as f_e with |f_e,i| <= L_i always, because the contact slips by e.
#
#         f_e = G (x - e) - rho (e - e_-),      e_i f_e,i = L_i |e_i|     (e is in the normal cone of the box at f_e)
#
# It stands before Theta: delays carry limited forces. While no force reaches its limit, e = 0 and nothing changes.
# With the forces that the tick would send without slip, f_free, and the feedthrough D_G it solves
#
#         f_e = f_free - (D_G + rho) e,         f_e in the box, e in its normal cone there,
#
# together with the walls, whose forces are the same kind of unknown over the box (-inf, 0]: a box problem.


@dataclass(frozen=True, eq=False, kw_only=True)
class Limiter(Law):
    """The forces of a loop before Theta, [x; p] -> [f_e; y], limited by a slip e; walls turn y into p.

    Its state is [that of `sent`, e [m] at the tick before, the lines of Theta, h [m] of the walls].
    Raises SingularLoop where the limited forces are not determined.
    """

    limit: Array  # (m,) [N], inf where there is none
    rho: Array  # (m,) [N/m] the slip's lag: 0 under any-environment, beta delta/T under this-environment

    if TYPE_CHECKING:  # what __post_init__ accepts is more than what the fields then hold

        def __init__(
            self,
            sent: Lti,
            theta: Sequence[int] = (),
            walls: tuple[Wall, ...] = (),
            *,
            limit: ArrayLike,
            rho: ArrayLike,
        ) -> None: ...

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
        _ = self.problem

    @property
    def unlimited(self) -> Self:
        return replace(self, limit=np.full(self.channels, np.inf))

    @property
    def bounds(self) -> list[tuple[int, float]]:
        return list(zip(self.sent_rows.tolist(), self.limit.tolist(), strict=True))

    def limited(self, z: Array, force: Array, most: Array) -> NDArray[np.bool_]:
        """Where the contact slipped, which is before the force arrives."""
        return self.slips(z) != 0

    @cached_property
    def _step(self) -> Lti:
        """[x; e; p] -> [f_e; y], states [sent, e_-]."""
        m, w, T = self.channels, len(self.walls), self.sent.T
        one, zero = np.eye(m + w), np.zeros((w, m))
        lag = Lti.diag(*(taps([-r, r], T) for r in self.rho))
        ports = np.hstack([one[:, :m], -one[:, :m], one[:, m:]])
        into = np.hstack([np.zeros((m, m)), np.eye(m), zero.T])
        return self.sent @ ports + np.vstack([np.eye(m), zero]) @ lag @ into

    @cached_property
    def _block(self) -> Lti:
        """[x; e; p] -> [f; y], states [sent, e_-, Theta]."""
        return self._delayed(self._step)

    @cached_property
    def problem(self) -> BoxProblem:
        """What a tick solves for [e; p]; all its limits are in N."""
        m, w = self.channels, len(self.walls)
        scale = np.concatenate([np.ones(m), self.steepness])[:, None]
        M = -scale * self._step.D[:, m:] + np.diag(np.concatenate([np.zeros(m), np.ones(w)]))
        lower = np.concatenate([-self.limit, np.full(w, -np.inf)])
        return BoxProblem(M, lower, np.concatenate([self.limit, np.zeros(w)]))

    @cached_property
    def kick(self) -> Array:
        """What [e; p] adds to [f; z+], (m + order, m + w)."""
        G, m, w = self._block, self.channels, len(self.walls)
        return np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, m + w))])

    @cached_property
    def sent_rows(self) -> NDArray[np.intp]:
        """Where [f; z+] holds f_e, (m,): the output itself, or the first place of its line."""
        m = self.channels
        lines = m + self._step.order + np.concatenate([[0], np.cumsum(self.theta)[:-1]]).astype(int)
        return np.where(np.array(self.theta) == 0, np.arange(m), lines)

    def transition(self) -> Transition:
        m, w, F, step, whole = self.channels, len(self.walls), self.open, self._step, self._block
        linear, kick, sent = self.linear.dot, self.kick, self.sent_rows
        limit, solve = self.limit[:, None], self.problem.solve
        if not w:

            def tick(before: Array, after: Array) -> None:
                linear(before, after)
                free = after.take(sent, axis=0)
                touched = np.abs(free) > limit
                if b"\1" not in touched.tobytes():  # a sixth of the time that any() takes, of a few channels
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
        way_of = np.hstack([step.C[m:], np.zeros((w, whole.order - step.order + w)), step.D[m:, :m]]).dot
        give, depth = step.D[m:, m:], slice(whole.order, whole.order + w)
        upper = self.problem.upper[:, None]

        def walled_tick(before: Array, after: Array) -> None:
            way = way_of(before) - gap  # into the walls, if these did not push and nothing slipped
            linear(before, after)
            asked = np.vstack([after.take(sent, axis=0), steep * way - memory * before[depth]])
            touched = ((asked > upper) | (asked[: m + w] < self.problem.lower[:, None])).any(axis=0)
            at = np.flatnonzero(touched)
            if at.size:
                v, f = solve(asked[:, at])
                bent = after[:, at] + kick @ v
                bent[sent] = f[:m]
                after[:, at] = bent
                way[:, at] += give @ v
            np.maximum(way, 0.0, out=after[-w:])

        return walled_tick

    def together(self, laws: Sequence[Law]) -> Transition:
        """Only those with a force beyond its limit solve their problem."""
        if self.walls:
            return one_by_one(laws)
        limiters = cast("Sequence[Limiter]", laws)
        linear, sent, limit = side_by_side(laws), self.sent_rows, last_axis([each.limit for each in limiters])

        def together(before: Array, after: Array) -> None:
            linear(before, after)
            free = after[sent]
            for i in np.flatnonzero((np.abs(free) > limit).any(axis=0)).tolist():
                slip, force = limiters[i].problem.solve(free[:, i : i + 1])
                after[:, i : i + 1] += limiters[i].kick @ slip
                after[sent, i] = force[:, 0]

        return together

    def at_rest(self, x: Array) -> Array:
        """The state that displacements x (m,) [m] lead to where they are held, no wall touching: see resting.

        The slip is the one that a force of F(1) x needs, so that the lines hold forces within the limits.
        """
        m, G = self.channels, self.sent
        free = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], G.T)
        stiffness = np.stack([free.C @ free.at_rest(unit) for unit in np.eye(m)], axis=1) + free.D
        (e,), (f,) = (side.T for side in BoxProblem(stiffness, -self.limit, self.limit).solve(stiffness @ x[:, None]))
        lines = np.repeat(f, self.theta)
        return np.concatenate([free.at_rest(x - e), e, lines, np.zeros(len(self.walls))])

    def slips(self, z: Array) -> Array:
        """e [m] at each tick but the last, (ticks - 1, m, ..), not zero where a force was limited."""
        return z[1:, self.sent.order : self.sent.order + self.channels]
