"""What is not linear in a tick: one-sided walls and the force limiter, complementarity problems with one solution."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.coupling import Coupling
from controller.delay import delay
from controller.environment import Network, Wall, walled_environment, walled_force_map
from controller.lti import Array, Lti, ReadOnly, SingularLoop, frozen, taps

# ----------------------------------------------------------------------------------------------------
# Walls: springs that push and never pull, so that contact is made and broken.
#
# Across a wall of stiffness K and damping B the way into it is d = y - gap, and it pushes with
#
#         p[k] = max(0, K h[k] + B (h[k] - h[k-1])/T),    h = max(0, d),
#
# which is a ramp, p = a max(0, d - c) with a = K + B/T and c = B h[k-1] / (T a): continuous and monotone in d. It
# dissipates: p[k] (d[k] - d[k-1]) >= K h[k]^2/2 - K h[k-1]^2/2 for every d, whatever B. While a wall touches, it is
# the spring-damper between the same nodes, but for the constant force of its gap.
#
# The wall forces enter the linear block as further inputs and the ways are further outputs, y = y_free - D p: the
# environment and the coupling give way at once. So the algebraic loop of a tick is the linear complementarity problem
#
#         p >= 0,   s = (1/a + D) p - (y_free - gap - c) >= 0,   p's = 0,
#
# whose matrix has positive principal minors, since D is positive semidefinite for a passive environment and coupling:
# there is exactly one solution, and it is found by trying every set of touching walls.


State = tuple[bool, ...]  # which walls touch


@dataclass(frozen=True, eq=False)
class Contact:
    """The linear block [x; p] -> [f; y] of a loop, and the walls that turn y into p.

    Its state is that of the block, then h [m], how deep each wall was pressed at the tick before.
    Raises SingularLoop where the walls' forces are not determined.
    """

    block: Lti  # m + w inputs and outputs
    walls: tuple[Wall, ...]

    def __post_init__(self) -> None:
        if not len(self.walls) <= min(self.block.inputs, self.block.outputs):
            raise ValueError(f"a block of {self.block.inputs} inputs cannot serve {len(self.walls)} walls")
        _ = self.problem

    @property
    def channels(self) -> int:
        return self.block.inputs - len(self.walls)

    @property
    def steepness(self) -> Array:
        """a = K + B/T of each wall, (w,) [N/m]."""
        return np.array([w.stiffness + w.damping / self.block.T for w in self.walls])

    @cached_property
    def problem(self) -> Complementarity:
        """What a tick solves for the wall forces."""
        m = self.channels
        return Complementarity(np.diag(1 / self.steepness) - self.block.D[m:, m:])

    @property
    def open(self) -> Lti:
        """F while no wall touches, with the state of the whole: h does not reach the force."""
        G, m, w = self.block, self.channels, len(self.walls)
        A, B = np.pad(G.A, ((0, w), (0, w))), np.pad(G.B[:, :m], ((0, w), (0, 0)))
        return Lti(A, B, np.pad(G.C[:m], ((0, 0), (0, w))), G.D[:m, :m], G.T)

    def frozen(self) -> dict[State, Lti]:
        """F of every contact state, without the gaps' constant forces; none touches in the first, all in the last."""
        m, T, walls = self.channels, self.block.T, range(len(self.walls))
        zero, one = np.zeros((1, 1)), np.ones((1, 1))
        stiff = [Lti(zero, one, w.damping / T * one, -(w.stiffness + w.damping / T) * one, T) for w in self.walls]
        none, maps = Lti.constant([[0.0]], T), {}
        for touching in itertools.product((False, True), repeat=len(self.walls)):
            back = Lti.diag(*[none] * m, *(stiff[i] if touching[i] else none for i in walls))
            G = self.block.feedback(back)
            maps[touching] = Lti(G.A, G.B[:, :m], G.C[:m], G.D[:m, :m], T)
        return maps

    def transition(self) -> Callable[[Array, Array], None]:
        """One tick for any number of simulations: see Process.transition."""
        G, m, w, F = self.block, self.channels, len(self.walls), self.open
        gap = np.array([wall.gap for wall in self.walls])[:, None]
        memory = (np.array([wall.damping for wall in self.walls]) / G.T / self.steepness)[:, None]
        linear = np.block([[F.C, F.D], [F.A, F.B]]).dot
        reach = np.block([G.C[m:], np.zeros((w, w)), G.D[m:, :m]]).dot
        kick, give = np.vstack([G.D[:m, m:], G.B[:, m:], np.zeros((w, w))]).dot, G.D[m:, m:].dot
        solve, depth = self.problem.solve, slice(G.order, G.order + w)

        def tick(before: Array, after: Array) -> None:
            way = reach(before) - gap  # into the walls, if these did not push
            force = solve(way - memory * before[depth])
            linear(before, after)
            after += kick(force)
            np.maximum(way + give(force), 0.0, out=after[-w:])

        return tick

    def depths(self, z: Array) -> Array:
        """h [m] at each tick but the last, (ticks - 1, w, ..), from the states at all of them, (ticks, order, ..)."""
        return z[1:, -len(self.walls) :]


def contact(network: Network, coupling: Coupling, theta: Sequence[int], psi: Sequence[int], T: float) -> Contact:
    """F of (6) with the walls of the network as further ports. Psi and Theta delay what the devices feel of them."""
    return Contact(walled_force_map(network, coupling, theta, psi, T), network.walls)


@dataclass(frozen=True, eq=False)
class _Problem(ReadOnly):
    """Complementarity in the forces of a tick; M says what each does to the ways along which all of them push."""

    M: Array  # (n, n)

    @cached_property
    def _diagonal(self) -> Array:
        return np.diag(self.M)[:, None].copy()

    @cached_property
    def _separate(self) -> bool:
        """Whether no force moves another one's way within the tick."""
        return np.count_nonzero(self.M - np.diag(np.diag(self.M))) == 0


@dataclass(frozen=True, eq=False)
class Complementarity(_Problem):
    """p >= 0, M p - q >= 0, p'(M p - q) = 0: one solution for every q if M has positive principal minors.

    Raises SingularLoop where it has not.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        _ = self._candidates

    def solve(self, q: Array) -> Array:
        """p for every column of q, (w, nsim)."""
        diagonal = self._diagonal
        if self._separate:
            return np.maximum(q, 0.0) / diagonal
        forces = (self._candidates @ q).reshape(-1, *q.shape)
        # rounding leaves the right set some 1e-16 short of either sign, every other set more
        short = np.minimum(forces * diagonal, np.matmul(self.M, forces) - q).min(axis=1)
        best = np.take_along_axis(forces, short.argmax(axis=0)[None, None, :], axis=0)[0]
        return np.maximum(best, 0.0)

    @cached_property
    def _candidates(self) -> Array:
        """q to p, if exactly the walls of a set push: for every set, stacked, (2^w w, w)."""
        w, maps = len(self.M), []
        for pushing in itertools.product((False, True), repeat=w):
            chosen = np.ix_(pushing, pushing)
            part, inverse = self.M[chosen], np.zeros((w, w))
            if not np.linalg.det(part / np.abs(self.M).max(initial=1e-300)) > 0:
                which = [i + 1 for i, on in enumerate(pushing) if on]
                raise SingularLoop(f"the forces of walls {which} are not determined: {part.tolist()}")
            inverse[chosen] = np.linalg.inv(part)
            maps.append(inverse)
        return np.concatenate(maps)


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

_LEAST_MINOR = 1e-12  # of a matrix whose diagonal is one: what is smaller counts as singular
_MOST_CANDIDATES = 27  # three channels, or two with a wall: beyond, the sets are not listed but pivoted through
GROUNDED = 1e-10  # of the largest diagonal entry: what makes a singular matrix regular for pivoting
PIVOT_ROUNDING = 1e-12  # of the numbers that are subtracted


@dataclass(frozen=True, eq=False)
class BoxProblem(_Problem):
    """f = q - M v with lower <= f <= upper, v >= 0 where f is at its upper limit, <= 0 at its lower, 0 in between.

    There is exactly one solution for every q where M has positive principal minors. Sets on which M is singular, as of
    an environment that nothing holds, are passed over: f is unique all the same. Raises SingularLoop where a minor is
    negative.
    """

    lower: Array  # (n,) -inf where there is no limit
    upper: Array  # (n,) > lower

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        for name in ("lower", "upper"):
            object.__setattr__(self, name, frozen(getattr(self, name), 1, name))
        if not (self.lower < self.upper).all():
            raise ValueError(f"limits are {self.lower.tolist()} to {self.upper.tolist()}, expected lower < upper")
        _ = self.regular

    def solve(self, q: Array) -> tuple[Array, Array]:
        """(v, f) for every column of q, both (n, nsim); what is at a limit is exactly there."""
        lower, upper = self.lower[:, None], self.upper[:, None]
        if self._separate:
            f = np.minimum(np.maximum(q, lower), upper)
            return np.divide(q - f, self._diagonal, out=np.zeros_like(q), where=q != f), f
        v = self._listed(q) if self._candidates else self._pivoted(q)
        f = np.where(v > 0, upper, np.where(v < 0, lower, q - self.M @ v))
        return v, np.minimum(np.maximum(f, lower), upper)

    @cached_property
    def regular(self) -> bool:
        """Whether all principal minors are positive; of more than ten unknowns, those of order one."""
        n = len(self.M)
        scale = np.sqrt(np.maximum(np.abs(np.diag(self.M)), 1e-300))
        unit, regular = self.M / scale / scale[:, None], True
        for size in range(1, n + 1) if n <= 10 else (1,):
            for chosen in itertools.combinations(range(n), size):
                minor = np.linalg.det(unit[np.ix_(chosen, chosen)])
                if minor < -_LEAST_MINOR:
                    which = [i + 1 for i in chosen]
                    raise SingularLoop(f"limited forces {which} are not determined: {self.M.tolist()}")
                regular &= bool(minor > _LEAST_MINOR)
        return regular

    @cached_property
    def _candidates(self) -> list[tuple[Array, Array, Array]]:
        """(signs, bounds, q - bounds to v) of every set of active limits; none where there are too many."""
        n = len(self.M)
        kinds = [
            [0.0, *[1.0] * bool(np.isfinite(b)), *[-1.0] * bool(np.isfinite(a))]
            for a, b in zip(self.lower, self.upper, strict=True)
        ]
        if np.prod([len(kind) for kind in kinds]) > _MOST_CANDIDATES:
            return []
        scale, found = np.sqrt(np.maximum(np.abs(np.diag(self.M)), 1e-300)), []
        for signs in map(np.array, itertools.product(*kinds)):
            active = np.flatnonzero(signs)
            chosen = np.ix_(active, active)
            if np.linalg.det((self.M / scale / scale[:, None])[chosen]) > _LEAST_MINOR:
                inverse = np.zeros((n, n))
                inverse[chosen] = np.linalg.inv(self.M[chosen])
                bounds = np.where(signs > 0, self.upper, np.where(signs < 0, self.lower, 0.0))
                found.append((signs[:, None], bounds[:, None], inverse))
        return found

    def _listed(self, q: Array) -> Array:
        """v of the set that is least violated: rounding leaves the right one some 1e-16 short, every other more."""
        lower, upper = self.lower[:, None], self.upper[:, None]
        best, least = np.zeros_like(q), np.full(q.shape[1], -np.inf)
        for signs, bounds, inverse in self._candidates:
            v = inverse @ (q - bounds)
            f = q - self.M @ v
            room = np.where(signs == 0, np.minimum(upper - f, f - lower), signs * v * self._diagonal).min(axis=0)
            better = room > least
            best = np.where(better, np.where(signs * v > 0, v, 0.0), best)
            least = np.where(better, room, least)
        return best

    def _pivoted(self, q: Array) -> Array:
        """v by switching limits on and off, all that are wrong at once and, should that go round, the first only.

        Switching the first alone ends for every M with positive principal minors. Index n is switched only when the
        others are right for it; then uniqueness shows on which side of its limit the solution lies, so n takes each
        of its three states at most once. The same holds of n - 1 in between, and so on.
        """
        n, k = q.shape
        M = self.M if self.regular else self.M + GROUNDED * self._diagonal.max() * np.eye(n)
        lower, upper, one = self.lower[:, None], self.upper[:, None], np.eye(n)
        signs, v, left = np.zeros((n, k)), np.zeros((n, k)), np.arange(k)
        for turn in range(4 * n + 3**n):
            s, at = signs[:, left], q[:, left]
            active = (s != 0).T
            matrix = np.where(active[:, :, None], np.where(active[:, None, :], M, 0.0), one)
            missing = np.where(s > 0, at - upper, np.where(s < 0, at - lower, 0.0))
            v[:, left] = now = np.linalg.solve(matrix, missing.T[..., None])[..., 0].T
            f = at - M @ now
            tiny = PIVOT_ROUNDING * (np.abs(at) + np.abs(M) @ np.abs(now))
            high, low = (s == 0) & (f > upper + tiny), (s == 0) & (f < lower - tiny)
            wrong = high | low | (s * now * self._diagonal < -tiny)
            if turn >= 4 * n:
                wrong &= np.cumsum(wrong, axis=0) == 1
            signs[:, left] = np.where(wrong, np.where(high, 1.0, np.where(low, -1.0, 0.0)), s)
            left = left[wrong.any(axis=0)]
            if not left.size:
                return np.where(signs * v > 0, v, 0.0)
        raise SingularLoop(f"limited forces are not determined: {self.M.tolist()}")


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
                at = np.flatnonzero(touched.any(axis=0))
                e, f = solve(free[:, at])
                after[:, at] += kick @ e
                after[np.ix_(sent, at)] = f

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
                after[:, at] += kick @ v
                after[np.ix_(sent, at)] = f[:m]
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
