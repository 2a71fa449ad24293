"""Test this-environment in `make validate` under uneven ticks, which are drawn or chosen by an adversary.

Each loop has one or two devices, a random spring-damper and a random network. The damping is a multiple of that which
this-environment requires for periods up to T_max, for forces that latch late, or for both. Lossless hands start with
random speeds, all else at rest. The adversary chooses the tick that leaves hands and devices most mechanical energy.

With ENOUGH damping this energy may never exceed that at the start. Nor may the work of the forces plus the least
dissipation delta a^2/tau_max + delta b^2/(T_max - tau_min) be negative. Here a and b are the motions before and after
the latch of each tick, and latencies are between tau_min and tau_max.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from haptic_loop.controller.arithmetic import SingularLoop
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design.environments import THIS_ENVIRONMENT
from haptic_loop.models.hold import at_the_latch, hold
from haptic_loop.models.scene import Plant
from haptic_loop.sim.stability import close

T, _LONG = 1e-3, 1.6e-3  # [s]
HANDS, _TICKS = 40, 4000
ENOUGH, _SHORT = 1.02, 0.5  # damping over the required damping
_GROWN = 100.0  # ratio of the energy to that at the start above which a set of hands counts as unstable


@dataclass(frozen=True)
class _UnevenTicks:
    """The result of one loop under one kind of uneven ticks."""

    loop: str
    ticks: str
    drawn: bool  # otherwise the adversary chooses each tick
    required: float  # [N s/m] of the first device
    energy: float  # largest mechanical energy over that at the start, with ENOUGH
    balance: float  # least sum f'dx + dissipation over the sum of its magnitudes, with ENOUGH
    grow: int  # number of unstable sets of hands, with _SHORT
    hands: int

    @property
    def holds(self) -> bool:
        return self.energy <= 1 + 1e-9 and self.balance >= -1e-9


def uneven_ticks(seed: int, loops: int = 8, ticks: int = _TICKS) -> Iterator[_UnevenTicks]:
    """Yield the results of random loops under periods up to T_max, latencies, and both."""
    for index in range(loops):
        rng = np.random.default_rng(np.random.SeedSequence((seed, index)))
        kind = ("periods", "latency", "periods and latency")[index % 3]
        loop, coupling = _draw(rng, kind)
        required = np.array(THIS_ENVIRONMENT.required(loop, coupling).required)
        m = loop.channels
        hands = 10 ** rng.uniform(-3, 0, (HANDS, m)), 10 ** rng.uniform(0, 4, (HANDS, m))
        for drawn in (True, False):
            runs = [_run(loop, coupling, share * required, hands, drawn, ticks, rng) for share in (ENOUGH, _SHORT)]
            name = f"{index}: {m} channel{'s'[: m - 1]}, theta = {list(loop.theta)}"
            (energy, _, balance), (_, end, _) = runs
            grown = int((end > _GROWN).sum())
            yield _UnevenTicks(
                name, kind, drawn, float(required[0]), float(energy.max()), float(balance.min()), grown, HANDS
            )


def _draw(rng: np.random.Generator, kind: str) -> tuple[Loop, SpringDamper]:
    """Return a random loop whose required damping is 0.01 to 20 N s/m, and its coupling."""
    while True:
        m = int(rng.integers(1, 3))
        names = tuple(f"contact {i + 1}" for i in range(m))
        springs = [Spring((name, "mass"), 10 ** rng.uniform(2, 4), 10 ** rng.uniform(-2, 0)) for name in names]
        springs.append(Spring(("mass", GROUND), 10 ** rng.uniform(1, 3), 10 ** rng.uniform(-2, 0)))
        network = Network(names, tuple(springs), {"mass": 10 ** rng.uniform(-2, 0)})
        theta = tuple(rng.integers(0, 3, m).tolist())
        coupling = SpringDamper(10 ** rng.uniform(2.5, 4, m), 10 ** rng.uniform(-2, 0.5, m))
        latest = rng.uniform(0.1, 0.4) * T
        latency = ((rng.uniform(0, latest), latest),) * m if kind != "periods" else None
        longest = _LONG if kind != "latency" else None
        loop = Loop(T, theta, (0,) * m, theta, (1.0,) * m, network, T_max=longest, latency=latency)
        try:
            if 0.01 < THIS_ENVIRONMENT.required(loop, coupling).ratio < 20:
                return loop, coupling
        except SingularLoop:
            continue


def _run(
    loop: Loop,
    coupling: SpringDamper,
    damping: Array,
    hands: tuple[Array, Array],
    drawn: bool,
    ticks: int,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array]:
    """Return for each set of `hands` the largest and the last energy over the initial energy, and the least balance.

    `hands` are masses, devices included, and stiffnesses, (hands, m) each.
    """
    mass, stiff = hands
    n, m = mass.shape
    A, B = np.zeros((n, 2 * m, 2 * m)), np.zeros((n, 2 * m, m))
    i = np.arange(m)
    A[:, i, m + i], A[:, m + i, i], A[:, m + i, m + i], B[:, m + i, i] = 1, -stiff / mass, -damping / mass, -1 / mass
    plants, F, longest = Plant(A, B, np.eye(m, 2 * m)), loop.F(coupling), loop.T_max or loop.T
    spans = loop.latency or ((0.0, 0.0),) * m
    periods = np.linspace(0.3 * _LONG, _LONG, 3) if loop.T_max else (T,)
    kinds = [(period, late) for period in periods for late in product(*(dict.fromkeys(span) for span in spans))]
    steps = np.stack([close(hold(plants, period, late), F).A for period, late in kinds])  # (kinds, n, order, order)
    seen = np.stack([at_the_latch(plants, late) for _, late in kinds])  # (kinds, n, m, 4 m)
    output = np.hstack([F.D @ np.eye(m, 2 * m), np.zeros((m, m)), F.C])
    xi = np.zeros((n, steps.shape[-1]))
    xi[:, m : 2 * m] = rng.standard_normal((n, m))
    weight = np.concatenate([stiff, mass], axis=1)
    before = (weight * xi[:, : 2 * m] ** 2).sum(axis=1)
    largest, log, balance, size, least = np.ones(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    first = damping / np.array([most or np.inf for _, most in spans])
    last = damping / (longest - np.array([soonest for soonest, _ in spans]))
    everyone, which = np.arange(n), np.zeros(n, dtype=int)
    for k in range(ticks):
        if drawn:
            which[:] = rng.integers(len(kinds))
            after = np.einsum("nij,nj->ni", steps[which[0]], xi)
        else:
            each = np.einsum("knij,nj->kni", steps, xi)
            which = (weight * each[:, :, : 2 * m] ** 2).sum(axis=2).argmax(axis=0)
            after = each[which, everyone]
        x, held, force = xi[:, :m], xi[:, 2 * m : 3 * m], xi @ output.T
        middle = np.einsum("nij,nj->ni", seen[which, everyone], np.hstack([xi[:, : 3 * m], force]))
        a, b = middle - x, after[:, :m] - middle
        work, spent = (held * a + force * b).sum(axis=1), (first * a**2 + last * b**2).sum(axis=1)
        unit = np.exp(np.minimum(log, 600)) if k > 15 else 1 / before  # makes multiples of the initial energy
        balance, size = balance + unit * (work + spent), size + unit * (np.abs(work) + spent)
        least = np.minimum(least, balance / np.maximum(size, 1e-300))
        xi = after
        if k % 16 == 15:
            energy = (weight * xi[:, : 2 * m] ** 2).sum(axis=1)
            scale = np.sqrt(np.maximum(energy, 1e-290))
            xi = xi / scale[:, None]
            log += np.log(np.maximum(energy, 1e-290) / (before if k == 15 else 1.0))
            largest = np.maximum(largest, np.exp(np.minimum(log, 700)))
    return largest, np.exp(np.minimum(log, 700)), least
