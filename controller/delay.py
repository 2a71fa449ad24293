"""Delays: constant ones as linear blocks, Theta (4), Psi (5) and Lambda (7); varying ones as a line that holds.

        tick k     packet k leaves with the force g[k]; it takes delays[k] ticks, or is LOST
                   the device applies the newest packet that is there: f[k] = g[j], j = max{j : j + delays[j] <= k}
                   where nothing new is there it holds: f[k] = f[k-1], and 0 before the first arrival

The age k - j of the force in use lies between the least and the largest delay while no packet is lost, whatever
the order of arrival; it grows by at most one per tick.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.lti import Array, Lti

Ticks = NDArray[np.int64]

LOST = -1  # as a delay: the packet never arrives


def delay(steps: Sequence[int], T: float) -> Lti:
    """blockdiag(z^-n_1, ..., z^-n_m): a chain of n_i unit delays per channel."""
    return Lti.diag(*(_chain(n, T) for n in steps))


def _chain(n: int, T: float) -> Lti:
    if n != int(n) or n < 0:
        raise ValueError(f"a delay is a whole number of samples, zero or more, got {n}")
    if n == 0:
        return Lti.constant([[1.0]], T)
    first, last = np.zeros((n, 1)), np.zeros((1, n))
    first[0, 0] = last[0, -1] = 1.0
    return Lti(np.eye(n, k=-1), first, last, [[0.0]], T)


def packet_delays(values: ArrayLike) -> Ticks:
    """A read-only (ticks, m, nsim) array of delays [samples], LOST among them. Raises ValueError for other numbers."""
    delays = np.array(values, dtype=np.int64)
    if delays.ndim != 3:
        raise ValueError(f"delays have the shape {delays.shape}, expected (ticks, channels, simulations)")
    if (delays < LOST).any():
        raise ValueError(f"delays go down to {delays.min()}, expected samples >= 0, or {LOST} for a lost packet")
    delays.setflags(write=False)
    return delays


def newest(delays: Ticks) -> Ticks:
    """The packet in use at every tick, (ticks, m, nsim); -1 before the first arrival."""
    ticks = delays.shape[0]
    sent = np.arange(ticks)[:, None, None]
    there = np.full(delays.shape, -1)
    for n in np.unique(delays[delays != LOST]):
        arrived = np.where(delays == n, sent, -1)[: max(ticks - n, 0)]
        np.maximum(there[n:], arrived, out=there[n:])
    return np.maximum.accumulate(there, axis=0)


def ages(delays: Ticks) -> Ticks:
    """k - j of the force in use at every tick, (ticks, m, nsim); -1 before the first arrival."""
    packet = newest(delays)
    return np.where(packet >= 0, np.arange(delays.shape[0])[:, None, None] - packet, -1)


def realising(wanted: Ticks) -> Ticks:
    """Packet delays (ticks, ..) under which the device uses forces of the `wanted` ages (ticks, ..).

    Ages may grow by one per tick at most. A packet that is never used arrives together with the next newer one, so no
    delay exceeds the largest wanted age.
    """
    ticks = wanted.shape[0]
    packet = np.arange(ticks).reshape(-1, *(1,) * (wanted.ndim - 1)) - wanted
    if (np.diff(packet, axis=0) < 0).any():
        raise ValueError("ages grow by more than one in a tick: a device does not return to an older force")
    delays = np.empty_like(wanted)
    for column in np.ndindex(*wanted.shape[1:]):
        used = packet[(slice(None), *column)]
        # packet j shows at the first tick whose packet is j or newer
        delays[(slice(None), *column)] = np.searchsorted(used, np.arange(ticks)) - np.arange(ticks)
    late = np.arange(ticks).reshape(packet.shape[0], *(1,) * (wanted.ndim - 1)) + delays >= ticks
    return np.where(late, wanted.max(axis=0), delays)


class HeldLine:
    """Forces on their way to the devices, for any number of simulations; see the head of this file."""

    def __init__(self, delays: Ticks, nsim: int) -> None:
        """`delays` of one simulation serve all. Raises ValueError where their number is another."""
        if delays.shape[2] not in (1, nsim):
            raise ValueError(f"delays are those of {delays.shape[2]} simulations, expected 1 or {nsim}")
        ticks, m, _ = delays.shape
        packet = np.broadcast_to(newest(delays), (ticks, m, nsim))
        before = np.concatenate([np.full((1, m, nsim), -1), packet[:-1]])
        self._fresh = packet != before
        depth = int(delays.max(initial=0)) + 1
        self._sent = np.zeros((depth, m, nsim))
        self._place = (packet % depth) * (m * nsim) + np.arange(m * nsim).reshape(m, nsim)
        self._held = np.zeros((m, nsim))

    def carry(self, k: int, force: Array) -> None:
        """Take the force (m, nsim) sent at tick k, in place leave the one that the devices apply at tick k."""
        if k >= self._fresh.shape[0]:
            raise ValueError(f"delays are given for {self._fresh.shape[0]} ticks, tick {k} needs one more")
        self._sent[k % self._sent.shape[0]] = force
        np.copyto(self._held, self._sent.take(self._place[k]), where=self._fresh[k])
        force[...] = self._held
