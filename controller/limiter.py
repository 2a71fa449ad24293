"""The force limiter: no force leaves that a device cannot give, and the guarantee stays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.complementarity import BoxProblem
from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import Network, Wall, walled_environment
from controller.lti import Array, Lti, ReadOnly, frozen, taps
from controller.walls import Contact, State

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


@dataclass(frozen=True, eq=False)
class Limiter(ReadOnly):
    """The forces of a loop before Theta, [x; p] -> [f_e; y], limited by a slip e; walls turn y into p.

    Its state is [that of `sent`, e [m] at the tick before, the lines of Theta, h [m] of the walls as in Contact].
    Raises SingularLoop where the limited forces are not determined.
    """

    sent: Lti  # m + w inputs and outputs
    theta: tuple[int, ...]  # (m,) delays of the limited forces [samples]
    limit: Array  # (m,) [N], inf where there is none
    rho: Array  # (m,) [N/m] the slip's lag: 0 under any-environment, beta delta/T under this-environment
    walls: tuple[Wall, ...] = ()

    def __post_init__(self) -> None:
        m = len(self.theta)
        for name in ("limit", "rho"):
            value = frozen(getattr(self, name), 1, name)
            object.__setattr__(self, name, value)
            if value.shape != (m,):
                raise ValueError(f"{name} has {value.size} entries for {m} channels")
        if not (self.limit > 0).all():
            raise ValueError(f"limit is {self.limit.tolist()}, expected positive forces in N")
        if not ((self.rho >= 0) & (self.rho < np.inf)).all():
            raise ValueError(f"rho is {self.rho.tolist()}, expected stiffnesses >= 0 in N/m")
        if self.sent.inputs != m + len(self.walls) or self.sent.outputs != self.sent.inputs:
            shape = f"{self.sent.outputs} x {self.sent.inputs}"
            raise ValueError(f"a block of {shape} cannot serve {m} channels and {len(self.walls)} walls")
        _ = self.problem

    @property
    def channels(self) -> int:
        return len(self.theta)

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
    def _whole(self) -> Lti:
        """[x; e; p] -> [f; y], states [sent, e_-, Theta]."""
        w, T = len(self.walls), self.sent.T
        return Lti.diag(delay(self.theta, T), Lti.constant(np.eye(w), T)) @ self._step

    @property
    def _steepness(self) -> Array:
        return np.array([w.stiffness + w.damping / self.sent.T for w in self.walls])

    @cached_property
    def problem(self) -> BoxProblem:
        """What a tick solves for [e; p]; all its limits are in N."""
        m, w = self.channels, len(self.walls)
        scale = np.concatenate([np.ones(m), self._steepness])[:, None]
        M = -scale * self._step.D[:, m:] + np.diag(np.concatenate([np.zeros(m), np.ones(w)]))
        lower = np.concatenate([-self.limit, np.full(w, -np.inf)])
        return BoxProblem(M, lower, np.concatenate([self.limit, np.zeros(w)]))

    @cached_property
    def kick(self) -> Array:
        """What [e; p] adds to [f; z+], (m + order, m + w)."""
        G, m, w = self._whole, self.channels, len(self.walls)
        return np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, m + w))])

    @cached_property
    def sent_rows(self) -> NDArray[np.intp]:
        """Where [f; z+] holds f_e, (m,): the output itself, or the first place of its line."""
        m = self.channels
        lines = m + self._step.order + np.concatenate([[0], np.cumsum(self.theta)[:-1]]).astype(int)
        return np.where(np.array(self.theta) == 0, np.arange(m), lines)

    @property
    def open(self) -> Lti:
        """F while no force is limited and no wall touches, with the state of the whole."""
        G, m, w = self._whole, self.channels, len(self.walls)
        A, B = np.pad(G.A, ((0, w), (0, w))), np.pad(G.B[:, :m], ((0, w), (0, 0)))
        return Lti(A, B, np.pad(G.C[:m], ((0, 0), (0, w))), G.D[:m, :m], G.T)

    def frozen(self) -> dict[State, Lti]:
        """F of every contact state while no force is limited, see Contact.frozen."""
        T = self.sent.T
        late = Lti.diag(delay(self.theta, T), Lti.constant(np.eye(len(self.walls)), T)) @ self.sent
        return Contact(late, self.walls).frozen() if self.walls else {(): late}

    def transition(self) -> Callable[[Array, Array], None]:
        """One tick for any number of simulations: see Process.transition."""
        m, w, F, step, whole = self.channels, len(self.walls), self.open, self._step, self._whole
        linear, kick, sent = np.block([[F.C, F.D], [F.A, F.B]]).dot, self.kick, self.sent_rows
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
        steep = self._steepness[:, None]
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

    def depths(self, z: Array) -> Array:
        """h [m] at each tick but the last, (ticks - 1, w, ..), from the states at all of them, (ticks, order, ..)."""
        return z[1:, z.shape[1] - len(self.walls) :]

    def slips(self, z: Array) -> Array:
        """e [m] at each tick but the last, (ticks - 1, m, ..), not zero where a force was limited."""
        return z[1:, self.sent.order : self.sent.order + self.channels]


def limited(
    network: Network,
    coupling: Coupling,
    theta: Sequence[int],
    psi: Sequence[int],
    T: float,
    limit: ArrayLike,
    rho: ArrayLike,
) -> Limiter:
    """The loop of (6) with limited forces and the walls of the network."""
    w = len(network.walls)
    late = Lti.diag(delay(psi, T), Lti.constant(np.eye(w), T))
    sent = coupling.around(late @ walled_environment(network, T), further=w)
    return Limiter(sent, tuple(theta), np.asarray(limit), np.asarray(rho), network.walls)
