"""The nonlinear equations of a tick (controller.law): complementarity problems of walls and of force limits."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.lti import Array, ReadOnly, frozen

_LEAST_MINOR = 1e-12  # a principal minor of at most this size, of a matrix with unit diagonal, counts as zero
_MOST_CANDIDATES = 27  # largest number of active sets to enumerate (three channels, or two with a wall)
GROUNDED = 1e-10  # regularisation of a singular matrix, and of a block of force vectors, relative to its diagonal
PIVOT_ROUNDING = 1e-12  # rounding error of a residual, relative to the sum of its terms' sizes


@dataclass(frozen=True, eq=False)
class _Problem(ReadOnly):
    """A problem of a tick. M maps wall forces to displacements, or slips at force limits to changes of the forces."""

    M: Array  # (n, n)

    @cached_property
    def _diagonal(self) -> Array:
        return np.diag(self.M)[:, None].copy()

    @cached_property
    def _separate(self) -> bool:
        """Whether M is diagonal, so that each equation contains one unknown only."""
        return np.count_nonzero(self.M - np.diag(np.diag(self.M))) == 0


@dataclass(frozen=True, eq=False)
class Complementarity(_Problem):
    """Wall forces p: p >= 0, M p - q >= 0, p'(M p - q) = 0. Raises SingularLoop unless M is a P-matrix."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        _ = self._candidates

    def solve(self, q: Array) -> Array:
        """Return p (w, nsim) for q (w, nsim), with w walls in nsim simulations."""
        diagonal = self._diagonal
        if self._separate:
            return np.maximum(q, 0.0) / diagonal
        forces = (self._candidates @ q).reshape(-1, *q.shape)
        # The solution violates its inequalities by rounding only; every other active set violates them by more.
        short = np.minimum(forces * diagonal, np.matmul(self.M, forces) - q).min(axis=1)
        best = np.take_along_axis(forces, short.argmax(axis=0)[None, None, :], axis=0)[0]
        return np.maximum(best, 0.0)

    @cached_property
    def _candidates(self) -> Array:
        """The stacked maps (2^w w, w) from q to p, one for every set of walls in contact."""
        w, maps = len(self.M), []
        for pushing in itertools.product((False, True), repeat=w):
            chosen = np.ix_(pushing, pushing)
            part, inverse = self.M[chosen], np.zeros((w, w))
            if not np.linalg.det(part / np.abs(self.M).max(initial=1e-300)) > 0:
                which = [i + 1 for i, on in enumerate(pushing) if on]
                raise SingularLoop(f"the forces of walls {which} are not determined by their matrix {part.tolist()}")
            inverse[chosen] = np.linalg.inv(part)
            maps.append(inverse)
        return np.concatenate(maps)


@dataclass(frozen=True, eq=False)
class BoxProblem(_Problem):
    """Limited forces f and slips v: f = q - M v, lower <= f <= upper; v >= 0 at upper, <= 0 at lower, otherwise 0.

    If M is a P-matrix, there is exactly one solution for every q. If M is symmetric and only positive semidefinite, as
    for an environment without a connection to ground, f is still unique. The enumeration skips singular active sets,
    and pivoting regularises M (`grounded`).

    Raises:
        SingularLoop: A principal minor of M is negative. With more than ten unknowns only the diagonal is checked.
    """

    lower: Array  # (n,) -inf without a limit
    upper: Array  # (n,) > lower

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        for name in ("lower", "upper"):
            object.__setattr__(self, name, frozen(getattr(self, name), 1, name))
        _ = self.regular

    def solve(self, q: Array) -> tuple[Array, Array]:
        """Return (v, f), both (n, nsim), for every column of q. Forces at a limit equal it exactly."""
        lower, upper = self.lower[:, None], self.upper[:, None]
        if self._separate:
            f = np.minimum(np.maximum(q, lower), upper)
            return np.divide(q - f, self._diagonal, out=np.zeros_like(q), where=q != f), f
        if self._candidates:
            return self._listed(q)
        v = self._pivoted(q)
        f = np.where(v > 0, upper, np.where(v < 0, lower, q - self.M @ v))
        return v, np.minimum(np.maximum(f, lower), upper)

    @cached_property
    def _unit(self) -> Array:
        """M with rows and columns scaled so that its diagonal consists of ones and zeros."""
        size = np.abs(np.diag(self.M))
        scale = np.sqrt(np.where(size > 0, size, 1.0))
        return self.M / scale / scale[:, None]

    @cached_property
    def weight(self) -> Array:
        """(n,) factors that make the v of each force comparable with forces.

        They are the diagonal of M, or the largest entry of the column where the diagonal is zero, as for a force that
        only a wall in contact changes.
        """
        diagonal, most = np.diag(self.M), np.abs(self.M).max(axis=0)
        return np.where(diagonal > GROUNDED * most, diagonal, most)

    def grounded(self, share: float = GROUNDED) -> Array:
        """Return M. If it is singular, this share of `weight` is added for limited forces, but not for walls."""
        if self.regular:
            return self.M
        return self.M + share * np.diag(np.where(np.isfinite(self.lower), self.weight, 0.0))

    @cached_property
    def regular(self) -> bool:
        """Whether all checked principal minors are positive. Raises SingularLoop if one is negative."""
        n = len(self.M)
        unit, regular = self._unit, True
        for size in range(1, n + 1) if n <= 10 else (1,):
            for chosen in itertools.combinations(range(n), size):
                minor = np.linalg.det(unit[np.ix_(chosen, chosen)])
                if minor < -_LEAST_MINOR:
                    which = [i + 1 for i in chosen]
                    raise SingularLoop(f"limited forces {which} are not determined by the matrix {self.M.tolist()}")
                regular &= bool(minor > _LEAST_MINOR)
        return regular

    @cached_property
    def _candidates(self) -> tuple[Array, ...]:
        """The signs of c active sets, and the affine maps from q to (v, f) and from q to the slack of each set.

        The shapes are (c, n, 1), (c, 2n, n), (c, 2n, 1), (c 2n, n), (c 2n, 1). The tuple is empty if there are more
        than _MOST_CANDIDATES sets. The slack is nonnegative if v has the sign of its limit and every free force is
        within both limits.
        """
        n, weight, one = len(self.M), self.weight, np.eye(len(self.M))
        kinds = [
            [0.0, *[1.0] * bool(np.isfinite(b)), *[-1.0] * bool(np.isfinite(a))]
            for a, b in zip(self.lower, self.upper, strict=True)
        ]
        if np.prod([len(kind) for kind in kinds]) > _MOST_CANDIDATES:
            return ()
        sets = []
        for signs in map(np.array, itertools.product(*kinds)):
            active = np.flatnonzero(signs)
            chosen = np.ix_(active, active)
            if np.linalg.det(self._unit[chosen]) > _LEAST_MINOR:
                v, free = np.zeros((n, n)), signs == 0
                v[chosen] = np.linalg.inv(self.M[chosen])
                bounds = np.where(signs > 0, self.upper, np.where(signs < 0, self.lower, 0.0))
                f = np.where(free[:, None], one - self.M @ v, 0.0)  # q - M v if free, and exactly the limit if active
                v_one, f_one = -v @ bounds, np.where(free, self.M @ v @ bounds, bounds)
                pushed, pushed_one = (signs * weight)[:, None] * v, signs * weight * v_one
                below, above = np.where(free[:, None], -f, pushed), np.where(free[:, None], f, pushed)
                room_below = np.where(free, self.upper - f_one, pushed_one)
                room_above = np.where(free, f_one - self.lower, pushed_one)
                solved = np.vstack([v, f]), np.append(v_one, f_one)[:, None]
                room = np.vstack([below, above]), np.append(room_below, room_above)[:, None]
                sets.append((signs[:, None], *solved, *room))
        signs, by_q, by_one, room, room_one = map(np.stack, zip(*sets, strict=True))
        return signs, by_q, by_one, room.reshape(-1, n), room_one.reshape(-1, 1)

    def _listed(self, q: Array) -> tuple[Array, Array]:
        """Return (v, f) of the active set whose least slack is largest. Only the solution's slack is nonnegative."""
        signs, by_q, by_one, room, room_one = self._candidates
        n, k = q.shape
        best = (room @ q + room_one).reshape(len(signs), 2 * n, k).min(axis=1).argmax(axis=0)
        both = (np.matmul(by_q[best], q.T[:, :, None]) + by_one[best])[:, :, 0].T
        v, f = both[:n], both[n:]
        v[v * signs[best, :, 0].T <= 0] = 0.0
        return v, np.minimum(np.maximum(f, self.lower[:, None]), self.upper[:, None])

    def _pivoted(self, q: Array) -> Array:
        """Return v by principal pivoting. All wrong signs change at once, and after 4 n rounds only the first one.

        The sign of a force is 1 at its upper limit, -1 at its lower limit, and 0 between them. Changing only the first
        wrong sign terminates for every P-matrix M: index n changes only when all others are right for its present
        sign, so that, by uniqueness, it has each of its three signs at most once. Between two of its changes the same
        holds for index n - 1, and so on.
        """
        n, k = q.shape
        M = self.grounded()
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
            wrong = high | low | (s * now * self.weight[:, None] < -tiny)
            if turn >= 4 * n:
                wrong &= np.cumsum(wrong, axis=0) == 1
            signs[:, left] = np.where(wrong, np.where(high, 1.0, np.where(low, -1.0, 0.0)), s)
            left = left[wrong.any(axis=0)]
            if not left.size:
                return np.where(signs * v > 0, v, 0.0)
        raise SingularLoop(f"limited forces are not determined by the matrix {self.M.tolist()}")


# ----------------------------------------------------------------------------------------------------
# Forces that are limited as vectors: the limits of a device with several axes are a Euclidean ball.


def magnitudes(force: Array, balls: Sequence[int]) -> Array:
    """Return the length of the vector to which each entry of forces (.., m, nsim) belongs.

    `balls` are the numbers of entries of the vectors; without them every entry is a vector.
    """
    if not balls:
        return np.abs(force)
    starts = np.concatenate([[0], np.cumsum(balls)[:-1]]).astype(int)
    return np.repeat(np.sqrt(np.add.reduceat(force**2, starts, axis=-2)), balls, axis=-2)


def _within_balls(force: Array, limit: Array, balls: Sequence[int]) -> Array:
    """Return forces (.., m, nsim) with every vector scaled to its limit (m, 1) where it is longer."""
    size = magnitudes(force, balls)
    over = size > limit
    return force * np.divide(limit, size, out=np.ones_like(size), where=over) if over.any() else force


@dataclass(frozen=True, eq=False)
class BallProblem(_Problem):
    """Forces f = q - M v that are limited as vectors: each vector of f is in its ball.

    v is 0 for a vector inside its ball, and an outward normal for a vector on the sphere.

    The solution is unique if M is block triangular over the vectors, in some order, and the symmetric parts of its
    diagonal blocks are positive definite. The blocks are solved one after the other by a semismooth Newton iteration in
    u = f + tau v, where tau is the mean of a vector's diagonal entries in M. The iteration starts from u = q, for which
    f is q scaled to the balls. If it fails, a block of one vector is solved by bisection, and a block of several
    vectors by the Douglas-Rachford iteration. If the residual is still too large, f is set to 0, and the failure is
    counted.

    Raises:
        SingularLoop: A block's symmetric part has a negative eigenvalue.
    """

    limit: Array  # (n,) the same for all entries of a vector; inf without a limit
    balls: tuple[int, ...]  # sizes of the vectors
    unsolved: list[int] = field(default_factory=lambda: [0])  # number of failures

    def __post_init__(self) -> None:
        object.__setattr__(self, "M", frozen(self.M, 2))
        object.__setattr__(self, "limit", frozen(self.limit, 1))
        _ = self.blocks

    @cached_property
    def blocks(self) -> list[_BallBlock]:
        """The blocks of M in the order of their solution: each comes after the blocks that act on it."""
        owner = np.repeat(np.arange(len(self.balls)), self.balls)
        joined = np.zeros((len(self.balls),) * 2, dtype=bool)
        np.logical_or.at(joined, (owner[:, None], owner[None]), self.M != 0)
        reach = joined | np.eye(len(joined), dtype=bool)
        for k in range(len(reach)):
            reach |= reach[:, k : k + 1] & reach[k]
        strong = reach & reach.T
        first = sorted({int(np.argmax(row)) for row in strong}, key=lambda i: int(reach[i].sum()))
        blocks = []
        for i in first:
            members = np.flatnonzero(strong[i])
            at = np.flatnonzero(np.isin(owner, members))
            blocks.append(_BallBlock(at, self.M, self.limit[at, None], tuple(self.balls[j] for j in members)))
        return blocks

    def solve(self, q: Array) -> tuple[Array, Array]:
        """Return (v, f), both (n, nsim), for every column of q."""
        v, f = np.zeros_like(q), q.copy()
        for block in self.blocks:
            right = q[block.at] - self.M[block.at] @ v
            v[block.at], f[block.at], missed = block.solve(right)
            self.unsolved[0] += missed
        return v, f


_RESIDUAL = 1e-12  # allowed residual, relative to the limit
_NEWTON, _SPLIT, _HALVINGS = 40, 4000, 80  # largest numbers of Newton, Douglas-Rachford and bisection steps
_FULL = 10  # number of full Newton steps before shorter ones are tried
_SHARES = (1.0, 0.7, 0.5, 0.3, 0.1, 0.03, 0.01)  # lengths of later Newton steps, of which the best one is taken
_ROUNDED = 16 * np.finfo(float).eps  # rounding of f + M v - q, relative to its terms


class _BallBlock:
    """One force vector, or several that M couples, so that their equations are solved jointly."""

    def __init__(self, at: NDArray[np.intp], M: Array, limit: Array, balls: tuple[int, ...]) -> None:
        self.at, self.limit, self.balls = at, limit, balls
        own = M[np.ix_(at, at)]
        mean = np.concatenate([[part.mean()] * len(part) for part in np.split(np.diag(own), np.cumsum(balls)[:-1])])
        tau = np.where(mean > 0, mean, 1.0)
        unit = own / np.sqrt(tau[:, None] * tau)
        least = float(np.linalg.eigvalsh((unit + unit.T) / 2)[0])
        if least < -GROUNDED:
            rows = (at + 1).tolist()
            raise SingularLoop(f"forces {rows}, limited as vectors, are not determined by the matrix {own.tolist()}")
        self.M = own + max(0.0, GROUNDED - least) * np.diag(tau)  # makes v unique, too
        self._radial = len(balls) == 1 and not (self.M - np.diag(tau)).any()
        self._by_tau, self.tau = self.M / tau, tau[:, None]
        self._inverse = np.linalg.inv(self.M)

    def _missing(self, v: Array, f: Array, q: Array) -> Any:
        """Return for each column (nsim,) whether f + M v - q exceeds its tolerance."""
        terms = np.abs(f) + np.abs(self.M) @ np.abs(v) + np.abs(q)
        finite = np.where(np.isfinite(self.limit), self.limit, np.abs(q))
        allowed = np.maximum(_RESIDUAL * finite, _ROUNDED * terms.max(axis=0))
        return ~(np.abs(f + self.M @ v - q) <= allowed).all(axis=0)

    def _of(self, u: Array) -> tuple[Array, Array]:
        """Return (v, f) for u = f + tau v."""
        f = _within_balls(u, self.limit, self.balls)
        return (u - f) / self.tau, f

    def solve(self, q: Array) -> tuple[Array, Array, int]:
        """Return (v, f) for every column of q, and the number of columns without a solution."""
        if self._radial:
            return *self._of(q), 0
        u = self._newton(q.copy(), q)
        v, f = self._of(u)
        left = np.flatnonzero(self._missing(v, f, q))
        if not left.size:
            return v, f, 0
        fallback = self._bisected if len(self.balls) == 1 else self._split
        v[:, left], f[:, left] = fallback(q[:, left])
        lost = np.flatnonzero(self._missing(v, f, q))
        v[:, lost], f[:, lost] = self._inverse @ q[:, lost], 0.0
        return v, f, lost.size

    def _newton(self, u: Array, q: Array) -> Array:
        """Return u with P(u) + M (u - P(u))/tau = q, by Newton steps from the given u; P projects onto the balls."""
        one, starts = np.eye(len(q)), np.cumsum((0, *self.balls))
        for turn in range(_NEWTON):
            v, f = self._of(u)
            left = np.flatnonzero(self._missing(v, f, q))
            if not left.size:
                break
            at = u[:, left]
            size = magnitudes(at, self.balls)
            P = np.zeros((left.size, len(q), len(q)))
            for a, b in pairwise(starts.tolist()):
                over = (size[a] > self.limit[a])[:, None, None]
                share = np.where(over[:, 0, 0], self.limit[a] / np.maximum(size[a], 1e-300), 1.0)[:, None, None]
                n = (at[a:b] / np.maximum(size[a], 1e-300)).T
                P[:, a:b, a:b] = np.where(over, share * (one[a:b, a:b] - n[:, :, None] * n[:, None]), one[a:b, a:b])
            slope = P + self._by_tau @ (one - P)
            missing = (f + self.M @ v - q)[:, left].T[..., None]
            step = np.linalg.solve(slope, missing)[..., 0].T
            if turn < _FULL:
                u[:, left] = at - step
                continue
            tried = [at - share * step for share in _SHARES]  # full steps may cycle
            errors = [np.abs(f + self.M @ v - q[:, left]).max(axis=0) for v, f in map(self._of, tried)]
            u[:, left] = np.take_along_axis(np.array(tried), np.argmin(errors, axis=0)[None, None], axis=0)[0]
        return u

    def _bisected(self, q: Array) -> tuple[Array, Array]:
        """Return (v, f) of one vector by bisection: |f| = limit, f = (I + lam M)^-1 q, shorter for larger lam."""
        one, limit = np.eye(len(q)), self.limit[0]
        excess = np.linalg.norm(q, axis=0) / limit - 1
        low, high = excess / np.linalg.norm(self.M, 2), excess / np.linalg.eigvalsh((self.M + self.M.T) / 2)[0]

        def force(lam: Array) -> Array:
            return np.linalg.solve(one + lam[:, None, None] * self.M, q.T[..., None])[..., 0].T

        for _ in range(_HALVINGS):
            between = np.sqrt(low * high)
            longer = np.linalg.norm(force(between), axis=0) > limit
            low, high = np.where(longer, between, low), np.where(longer, high, between)
        f = _within_balls(force(high), self.limit, self.balls)
        return high * f, f

    def _split(self, q: Array) -> tuple[Array, Array]:
        """Return (v, f) by the Douglas-Rachford iteration, which converges for monotone M, and by Newton steps."""
        v, f = self._of(q)
        u, resolvent = q.copy(), np.linalg.inv(self._by_tau + np.eye(len(q)))
        for turn in range(_SPLIT):
            f = _within_balls(u, self.limit, self.balls)
            u = u + resolvent @ (self._by_tau @ (2 * f - u) + q) - f
            if turn % 500 == 499:
                v, f = self._of(self._newton(u.copy(), q))
                if not self._missing(v, f, q).any():
                    break
        return v, f
