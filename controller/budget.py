"""Energy budgets: forces are scaled so that a passive hand receives at most a chosen energy, for any controller.

    EnergyBudget        scales forces before the delays, at the port of the devices
    Shell               scales forces at the port of the environment, behind a coupling certified for any environment

*The budget.* a[k] is the force that acts in [kT, (k+1)T), the device feels -a[k], and dx[k] = x[k+1] - x[k]. The budget
leaves a share eps (`EPS`) of the guaranteed damping Delta unused. Let Delta be diagonal (a matrix is first turned to
its principal axes), and Delta' = (1 - eps) Delta = diag(delta'). On vectors, ' is the transpose. The budget computes

    W[k+1] = min(cap, W[k] + a[k]'dx[k] + dx[k]' Delta' dx[k]/T).

A tick with force a lowers W by at most its loss r(a) = sum_i T a_i^2/(4 delta'_i). Let R be the sum of the losses of
all forces that were sent and have not acted yet. A packet is sent as s times the wanted force, with the largest s in
[0, 1] for which R <= W. Then W >= 0 always, and beyond the energy that the devices dissipate, devices and hands receive
at most W0. docs/energy-budget.md has the proofs, the terms for encoder steps, and the cases in which no budget acts.

*Delays.* Tick t may use any packet of age lo to hi, or up to `hold` ticks older if packets are lost. After that the
device must set its force to zero. Unless the budget knows which force acted (constant delays, or a report from the
device), the tick counts with the largest loss of these packets, channel by channel.

The guarantee does not cover devices whose damping is less than delta, nor hands that are not passive. It covers periods
that vary if T is the largest period. The arrays are (m, nsim): channels and simulations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.lti import Array, Lti

START_J = 2e-3  # [J] W0 of a MuJoCo world, unless a run says otherwise
EPS = 0.05  # share of the damping that a budget does not use
_UNTOLD = 4096  # A tick whose report is missing for longer than this number of ticks keeps its largest loss.
_HUGE = 1e12  # [N] A force of this size or more counts as an error and is sent as 0.
_SHAVE = 1 - 1e-12  # factor on a scaled force against rounding


def check_start(name: str, start: float) -> float:
    """Return W0 [J]. Raises ValueError, which begins with `name`, unless W0 is finite and >= 0."""
    if not 0 <= start < np.inf:
        raise ValueError(f"{name} is {start:g} J, expected a finite energy >= 0")
    return start


@dataclass(frozen=True, kw_only=True)
class NetFigures:
    """Counts of the ticks of a run, and of those in which a passivity layer changed the force."""

    guarantee: str | None  # the guarantee in one line
    ticks: int  # of the run
    limited_ticks: int  # ticks in which the layer changed the force


@dataclass(frozen=True, kw_only=True)
class ShellFigures(NetFigures):
    """Figures of a passivity layer that limits forces by an energy W."""

    start_J: float  # W0
    cap_J: float | None  # the largest W; None if there is no cap
    smallest_scale: float  # the smallest factor on a force so far
    energy_J: float  # the present W


@dataclass(frozen=True, kw_only=True)
class BudgetFigures(ShellFigures):
    """Figures of an energy budget, in addition to those of ShellFigures."""

    eps: float = EPS
    reserved_J: float  # the largest loss of the packets on their way
    dropped_ticks: int = 0  # ticks in which a device dropped a force that was too old
    surprises: int  # ticks with a reported force larger than any that could have been in use
    idle: str | None = None  # reason why the budget never acts, if that is proved


class _Net:
    """Common part of `EnergyBudget` and `Shell`: W of every simulation, its cap, and counts of limited forces."""

    def __init__(self, start: float, cap: float, nsim: int) -> None:
        check_start("W0", start)
        if not start <= cap:
            raise ValueError(f"the budget's cap is {cap:g} J, expected at least its start, {start:g} J")
        self.ticks = 0
        self.limited = np.zeros(nsim, dtype=np.int64)  # (nsim,) ticks in which the wanted force was changed
        self.energy = np.full(nsim, float(start))  # (nsim,) W [J]
        self.least = np.ones(nsim)  # (nsim,) the smallest scale so far
        self._start, self._cap = float(start), float(cap)

    def _earn(self, increment: Array) -> None:
        np.minimum(self.energy + increment, self._cap, out=self.energy)

    def _count(self, scale: Array, spoilt: NDArray[np.bool_]) -> None:
        scale = np.where(spoilt, 0.0, scale)
        self.ticks += 1
        self.limited += scale < 1
        np.minimum(self.least, scale, out=self.least)

    def figures(self, guarantee: str | None = None) -> ShellFigures:
        """Return the present W, the least scale so far, and the limited ticks, each the worst of all simulations."""
        return ShellFigures(
            guarantee=guarantee,
            ticks=self.ticks,
            limited_ticks=int(self.limited.max()),
            start_J=self._start,
            cap_J=self._cap if np.isfinite(self._cap) else None,
            smallest_scale=float(self.least.min()),
            energy_J=float(self.energy.min()),
        )


@dataclass(frozen=True)
class Packets:
    """Range of the ages of the forces that a tick uses, (m,) each [samples]."""

    lo: ArrayLike
    hi: ArrayLike | None = None  # None: hi = lo
    hold: int = 0  # further ticks for which a device holds a force whose successors are lost


def _principal(level: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (m,) and eigenvectors (m, m) of a block diagonal matrix, block by block."""
    m, starts = len(level), [k for k in range(len(level)) if not level[:k, k:].any()]
    values, axes = np.zeros(m), np.zeros((m, m))
    for a, b in pairwise([*starts, m]):
        values[a:b], axes[a:b, a:b] = np.linalg.eigh(level[a:b, a:b])
    return values, axes


class EnergyBudget(_Net):
    """Scales the forces that are sent to the devices; the module's docstring states the guarantee.

    A tick is one call of `limit`, which returns the force to send. With varying delays or lost packets the devices
    report which forces acted: at once (`acted`) or later (`tell`). Without a report the budget is conservative.
    """

    def __init__(
        self,
        delta: ArrayLike,
        T: float,
        packets: Packets,
        *,
        encoder_step: ArrayLike = 0.0,
        start: float = 0.0,
        cap: float = np.inf,
        nsim: int = 1,
    ) -> None:
        """Start a budget for `nsim` simulations.

        Args:
            delta: Damping (m,), or the matrix Delta_D (m, m), that the devices guarantee [N s/m]. A matrix is
                diagonalised device by device. Then r(f) = T f' Delta'^-1 f/4, and encoder errors are bounded in the
                principal axes.
            T: The largest period [s].
            packets: The ages of the forces that a tick uses.
            encoder_step: Steps (m,), or one for all, to which positions are rounded [m].
            start: W0 [J].
            cap: The largest W [J].
            nsim: The number of simulations.

        Raises:
            ValueError: W0, the cap, T or a damping is out of range.
        """
        super().__init__(start, cap, nsim)
        delta = np.array(delta, dtype=float)
        self._axes: Array | None = None  # (m, m) orthogonal: its columns are the principal axes
        if delta.ndim == 2:
            delta, self._axes = _principal(delta)
            encoder_step = np.abs(self._axes.T) @ np.broadcast_to(np.array(encoder_step, dtype=float), delta.shape)
        lo, hold = np.array(packets.lo, dtype=np.int64), packets.hold
        oldest = (lo if packets.hi is None else np.array(packets.hi, dtype=np.int64)) + hold
        if not ((delta > 0) & (delta < np.inf)).all() or not 0 < T < np.inf:
            raise ValueError(f"delta is {delta.tolist()} and T is {T:g}, expected positive numbers")
        steps = np.broadcast_to(np.array(encoder_step, dtype=float), delta.shape)
        damping = (1 - EPS) * delta[:, None]
        self._step, self._coarse = steps[:, None], bool(steps.any())
        self._damping, self._square = damping / T, T / (4 * damping)  # coefficients of dx^2 and of a^2
        #: (depth, m, nsim) largest loss [J] of this tick and of each later tick, for the packets sent so far
        self._reserve = np.zeros((int(oldest.max()) + 1, delta.size, nsim))
        ahead = np.arange(len(self._reserve))[:, None]  # ticks from now
        self._reached = (lo <= ahead) & (ahead <= oldest)  # (depth, m) whether a packet sent now can act then
        self._channel = np.nonzero(self._reached)[1]
        self._delay = lo if (lo == oldest).all() else None
        self._sent = np.zeros_like(self._reserve)  # Row k % depth is the force sent at tick k, in principal axes.
        self._untold: dict[int, tuple[Array, Array]] = {}  # tick -> its dx and its largest loss
        self._last = (-1, np.zeros((delta.size, nsim)))  # the newest tick whose force is known, and that force
        self.surprises = 0  # as in BudgetFigures

    @property
    def reserved(self) -> Array:
        """The largest loss (nsim,) [J] of the packets on their way; at most `energy`."""
        return self._reserve.sum(axis=(0, 1))

    def figures(self, guarantee: str | None = None) -> BudgetFigures:
        reserved = float(self.reserved.max())
        return BudgetFigures(**vars(super().figures(guarantee)), reserved_J=reserved, surprises=self.surprises)

    def limit(self, wanted: ArrayLike, dx: ArrayLike, acted: ArrayLike | None = None) -> Array:
        """Return the force to send now (m, nsim) [N]: s times `wanted`, with one s in [0, 1] for all channels.

        `dx` [m] is the displacement since the last call, and `acted` [N] the force that acted in that time. Without
        `acted` that force is the one sent `lo` ticks earlier, if hi = lo and `hold` is 0; otherwise it is unknown. The
        first call ignores `dx` and `acted`. `wanted` must be clipped to forces that the device can apply. An entry that
        is nan, or has a size of 1e12 N or more, is sent as zero.
        """
        if self.ticks:
            self._book(self._turned(dx), None if acted is None else self._turned(acted))
        wanted, spoilt = _finite(wanted)
        wanted = self._turned(wanted)
        scale = self._scale(wanted)
        sent = scale * wanted
        np.maximum(self._reserve, self._loss(sent), out=self._reserve, where=self._reached[:, :, None])
        self._sent[self.ticks % len(self._sent)] = sent
        self._count(scale, spoilt)
        return sent if self._axes is None else self._axes @ sent

    def _turned(self, values: ArrayLike) -> Array:
        """Return values (m, nsim) in the principal axes."""
        values = np.asarray(values, dtype=float)
        return values if self._axes is None else self._axes.T @ values

    def tell(self, tick: int, acted: ArrayLike) -> None:
        """Report the forces (m, nsim) [N] of a tick, counted from 0. Raises ValueError if it waits for no report."""
        if tick not in self._untold:
            raise ValueError(f"tick {tick} does not wait for a report")
        self._settle(tick, self._turned(acted), *self._untold.pop(tick))

    def _book(self, dx: Array, acted: Array | None) -> None:
        """Update W after the tick that has just ended."""
        tick, most = self.ticks - 1, self._reserve[0].copy()
        self._reserve[:-1] = self._reserve[1:]
        self._reserve[-1] = 0.0
        if acted is None and self._delay is not None:
            acted = self._sent[(tick - self._delay) % len(self._sent), np.arange(self._delay.size)]
        self._earn(-most.sum(axis=0))
        if acted is not None:
            self._settle(tick, acted, dx, most)
            return
        self._untold.pop(tick - _UNTOLD, None)
        self._untold[tick] = dx.copy(), most

    def _settle(self, tick: int, acted: Array, dx: Array, most: Array) -> None:
        """Replace the tick's largest loss, already subtracted from W, by its actual increment of W."""
        self.surprises += int((self._loss(acted) > most * (1 + 1e-9)).any())
        if not self._coarse:
            self._earn((acted * dx + self._damping * dx**2 + most).sum(axis=0))
            return
        sure = np.maximum(np.abs(dx) - self._step, 0.0)
        # If the previous force is unknown, assume -acted, which costs most.
        before = self._last[1] if self._last[0] == tick - 1 else -acted
        change = np.abs(acted - before) + np.abs(acted) - np.abs(before)
        self._earn((acted * dx + self._damping * sure**2 - self._step / 2 * change + most).sum(axis=0))
        if tick > self._last[0]:
            self._last = (tick, acted.copy())

    def _loss(self, force: Array) -> Array:
        """Return the largest loss [J] of a force that is held for a tick, per channel."""
        square = self._square * force**2
        return square + 2 * self._step * np.abs(force) if self._coarse else square

    def _scale(self, wanted: Array) -> Array:
        """Return the largest s (nsim,) for which W is at least the reserve including the packet s f, f = `wanted`.

        Each pair (tick, channel) that the packet reaches then reserves max(M, s^2 r + s b). M is the pair's present
        reserve, r = T f^2/(4 delta'), and b = 2 q |f| with the encoder step q. Let room be the part of W that is not
        reserved yet. The reserves are within W if and only if every set of pairs has sum (s^2 r + s b) <= room + sum M,
        both sums over the set. It is enough to check the first n pairs, for every n, in the order of the s at which
        s^2 r + s b exceeds M.
        """
        room = np.maximum(self.energy - self.reserved, 0.0)
        scale, now = np.ones_like(room), self._reserve[self._reached]  # (pairs that the packet reaches, nsim)
        square, linear = (self._square * wanted**2)[self._channel], (2 * self._step * np.abs(wanted))[self._channel]
        short = np.maximum(square + linear - now, 0.0).sum(axis=0) > room
        if short.any():
            parts = [part[:, short] for part in (square, linear, now)]
            order = np.argsort(_root(*parts), axis=0)
            square, linear, now = (np.take_along_axis(part, order, axis=0).cumsum(axis=0) for part in parts)
            most = _root(square, linear, room[short] + now).min(axis=0)
            scale[short] = np.minimum(most, 1.0) * _SHAVE
        return scale


class Shell(_Net):
    """Makes any computed force of the environment passive, behind a coupling V with u = x - V f.

    W[k+1] = W[k] + f'(u - u_-), where u_- is u of the previous tick, and f = s f_wanted with the largest s in [0, 1]
    for which W[k+1] >= 0. V responds within the tick by its direct part D_V: u = u0 - D_V f, where u0 is u for f = 0.
    Then sum f'(u - u_-) >= -W0 at every tick. If the coupling is certified for any environment with psi = 0,
    passive hands therefore receive at most W0. A tick is a call of `free`, then of `limit`.
    """

    def __init__(self, V: Lti, *, start: float = 0.0, nsim: int = 1) -> None:
        """Raise ValueError if V is not square, D_V is not passive, or W0 = `start` [J] is negative or infinite."""
        super().__init__(start, np.inf, nsim)
        if V.inputs != V.outputs:
            raise ValueError(f"the coupling has {V.inputs} inputs and {V.outputs} outputs, expected equal numbers")
        if np.linalg.eigvalsh((V.D + V.D.T) / 2).min() < -1e-12 * max(1e-300, float(np.abs(V.D).max())):
            raise ValueError(f"the coupling's direct part {V.D.tolist()} is not passive")
        self._V = V
        self._state = np.zeros((V.order, nsim))
        self._before = self._free = np.zeros((V.outputs, nsim))
        self._released = np.zeros(nsim)  # [J] credited energy

    def free(self, x: ArrayLike) -> Array:
        """Return u0 (m, nsim) [m], the port's displacement at device positions x (m, nsim) for f = 0 in this tick."""
        self._free = np.asarray(x, dtype=float) - self._V.C @ self._state
        return self._free.copy()

    def credit(self, released: ArrayLike) -> None:
        """Credit the energy that gravity and springs have released so far, (nsim,) [J]; only increases count.

        Then sum f'(u - u_-) >= -(W0 + released) at every tick, with the largest `released` up to that tick.
        """
        rise = np.maximum(np.asarray(released, dtype=float) - self._released, 0.0)
        self._released = self._released + rise
        self._earn(rise)

    def charge(self, energy: float) -> None:
        """Subtract from W an energy [J] >= 0 that reached the devices other than through the port."""
        self._earn(np.full_like(self.energy, -energy))

    def limit(self, wanted: ArrayLike, rounded: Callable[[Array], Array] = lambda f: f) -> tuple[Array, Array]:
        """Return f = s f_wanted [N] and the port's displacement u [m], (m, nsim) each, and end the tick.

        `rounded` maps s f_wanted to a force that can be sent. If the rounded force would make W negative, f is 0.
        """
        wanted, spoilt = _finite(wanted)
        linear = (wanted * (self._free - self._before)).sum(axis=0)
        square = np.maximum((wanted * (self._V.D @ wanted)).sum(axis=0), 0.0)
        scale = self._scale(linear, square)
        force = rounded(scale * wanted)
        earned = (force * (self._free - self._V.D @ force - self._before)).sum(axis=0)
        if (dear := (self.energy + earned < 0) & (force != scale * wanted).any(axis=0)).any():
            force, scale = np.where(dear, 0.0, force), np.where(dear, 0.0, scale)
        self._count(scale, spoilt)
        return force, self.book(force)

    def book(self, force: Array) -> Array:
        """Update W for the force (m, nsim) [N] that acts in this tick, without limiting it. Return u [m]."""
        u = self._free - self._V.D @ force
        self._earn((force * (u - self._before)).sum(axis=0))
        self._state = self._V.A @ self._state + self._V.B @ force
        self._before = u
        return u.copy()

    def _scale(self, linear: Array, square: Array) -> Array:
        """Return the largest s (nsim,) in [0, 1] with W + linear s - square s^2 >= 0."""
        W = np.maximum(self.energy, 0.0)
        scale = np.ones_like(W)
        short = W + linear - square < 0
        if not short.any():  # on nearly every tick
            return scale
        W, b, c = W[short], linear[short], square[short]
        root = np.sqrt(b**2 + 4 * c * W)
        gains = b > 0  # `gains` selects the form of the upper root without cancellation; here b > 0 implies c > b
        upper = np.divide(np.where(gains, b + root, 2 * W), np.where(gains, 2 * c, root - b), out=0 * W, where=root > 0)
        scale[short] = np.minimum(upper, 1.0) * _SHAVE
        return scale


def _root(square: Array, linear: Array, most: Array) -> Array:
    """Return the largest s >= 0 with square s^2 + linear s <= most, all >= 0; inf if every s is allowed."""
    slope = linear + np.sqrt(linear**2 + 4 * square * most)
    return np.divide(2 * most, slope, out=np.where(square + linear > 0, 0.0, np.inf), where=slope > 0)


def _finite(wanted: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Return the force with 0 for entries that are nan or too large, and the simulations (nsim,) with such entries."""
    wanted = np.asarray(wanted, dtype=float)
    good = np.abs(wanted) < _HUGE
    return np.where(good, wanted, 0.0), np.asarray(~good.all(axis=0))
