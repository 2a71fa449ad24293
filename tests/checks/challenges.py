"""Attack guarantees for limited forces, budgets, walls and encoder steps, as a part of `make validate`.

The devices of a random loop get a little more or much less damping (or friction) than a guarantee requires. Then two
adversaries try to take energy out of the loop. One moves the devices from rest, by waves, by noise, and at every tick
by the step that takes the most energy. The other draws lossless hands with initial speeds, selects those whose motion
grows most, and varies them. A guarantee says that the energy balance

        sum f'dx + dx' Delta dx/T + w'|dx|  >=  -given

holds at every tick, where w is the declared Coulomb friction, if any, and `given` the energy that a budget may give.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.environment import GROUND, Network, Spring, Wall
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.design.conditions import any_environment, encoder_friction, this_environment
from haptic_loop.design.environments import LIMITER, THIS_ENVIRONMENT
from haptic_loop.models.device import RigidDevice
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.passivity_layer import EnergyNet, netted
from haptic_loop.sim.run import assemble, run_blocks
from haptic_loop.sim.scenario import Scenario

ENOUGH = 1.02  # damping (or friction) over that which a guarantee requires
_GIVEN = 0.005  # [J] energy that a budget may give
_PUSHED = 24  # number of motions that are simulated together
_GROWN = 1.5  # a motion counts as growing if its rms speed in the last quarter exceeds that in the first by this factor
_ROUNDING = 1e-10  # rounding error of a balance, over the energy that flows


@dataclass(frozen=True)
class _Challenge:
    """The findings of the adversaries in one loop."""

    guarantee: str
    loop: int  # the number of the draw
    factor: float  # the loop's damping (or friction) over that which the guarantee requires
    motions: int  # number of motions that were tried
    took: int  # number of motions that took more energy than the guarantee allows
    least_J: float  # the lowest energy balance plus `given` of all motions and hands, at most 0
    hands: int  # number of hands that were tried in each generation
    grew: int  # number of hands whose motion grew, or that took more energy than the guarantee allows
    limited: float  # share of ticks with limited forces or contact, largest over the three values of greed (`_moved`)
    holds: bool  # no adversary succeeded, or nothing is guaranteed (factor < 1)


@dataclass(frozen=True, eq=False)
class _Case:
    """A loop, and devices with a multiple of the damping or friction that its guarantee requires."""

    process: Callable[[int, int], Process]  # (simulations, ticks) -> process without actuator limits
    delta: Array  # (m,) [N s/m] of the devices
    T: float
    size: float  # [m] usual step of the motions
    friction: Array | float = 0.0  # (m,) [N] Coulomb friction of the devices
    given: float = 0.0  # [J] energy that the budget may give
    start: float = 0.0  # [m] position at which motions begin
    push: float = 1.0  # factor on the initial speeds of hands

    def limited(self, buffer: StepBuffer, ticks: int) -> float:
        """Return the share of the ticks in which forces were limited, or a wall was touched."""
        if buffer.net:
            done = buffer.net.figures()
            return done.limited_ticks / done.ticks
        law, z = buffer.process.law, buffer.z
        hit = law.limited(z, buffer.f[:-1], np.array(np.inf)) if law.bounds else law.depths(z) > 0
        return float(hit[:ticks].any(axis=1).mean())


def challenges(
    seed: int,
    loops: int = 3,
    hands: int = 60,
    seconds: float = 6.0,
    ticks: int = 700,
    names: Sequence[str] | None = None,
) -> Iterator[_Challenge]:
    """Yield the findings on `loops` random loops for each guarantee, with ENOUGH damping (or friction) and too little.

    Motions last `ticks`, and hands move for `seconds`.
    """
    for name, (make, too_little) in GUARANTEES.items():
        if names is not None and name not in names:
            continue
        for number in range(loops):
            for factor in (ENOUGH, too_little):
                yield _challenge(name, make, seed, number, factor, hands, seconds, ticks)


def _challenge(
    name: str, make: Callable[..., _Case], seed: int, number: int, factor: float, hands: int, seconds: float, ticks: int
) -> _Challenge:
    case = make(np.random.default_rng((seed, number)), factor)
    rng = np.random.default_rng((seed, number, 1))
    balances, share = [], 0.0
    for greed in (0.0, 0.5, 1.0):
        balance, limited_share = _moved(case, _pushes(rng, len(case.delta), case.size, greed, ticks), greed)
        balances.append(balance)
        share = max(share, limited_share)
    least = np.concatenate(balances)
    took = int((least < 0).sum())
    grew, lowest = _held(case, rng, hands, seconds)
    holds = factor < 1 or (took == 0 and grew == 0)
    lowest = min(float(least.min()), lowest)
    return _Challenge(name, number, factor, 3 * _PUSHED, took, lowest, hands, grew, share, holds)


# ---- the adversaries


def _pushes(rng: np.random.Generator, m: int, size: float, greed: float, ticks: int) -> Array:
    """Return steps [m] (ticks, m, _PUSHED) of waves and noise in three sizes; with greed they end after 150 ticks."""
    w, phase = np.exp(rng.uniform(-5, 1.1, (1, 1, _PUSHED))), rng.uniform(0, 6, (1, m, _PUSHED))
    wave = np.sin(w * np.arange(ticks)[:, None, None] + phase) + 0.3 * rng.normal(size=(ticks, m, _PUSHED))
    until = ticks if greed == 0 else 150
    sizes = size * np.repeat([0.1, 1.0, 5.0], _PUSHED // 3)
    return sizes * wave * (np.arange(ticks) < until)[:, None, None]


def _moved(case: _Case, pushed: Array, greed: float) -> tuple[Array, float]:
    """Return the lowest balance of each motion plus `given`, at most 0, and the share of limited ticks.

    Each step is `pushed` plus `greed` times the step that takes the most energy in this tick, -f/(2 D), D = delta/T.
    """
    ticks, _, nsim = pushed.shape
    process, D = case.process(nsim, ticks + 1), case.delta[:, None] / case.T
    buffer = StepBuffer(process, ticks + 1, len(case.delta), nsim=nsim)
    friction = np.broadcast_to(case.friction, case.delta.shape)[:, None]
    balance, flow, least = np.zeros(nsim), np.zeros(nsim), np.zeros(nsim)
    buffer.x[0] = case.start
    for k in range(ticks):
        buffer.tick(k)
        f = buffer.f[k]
        dx = pushed[k] - greed * f / (2 * D)
        buffer.x[k + 1] = buffer.x[k] + dx
        work, spent = (f * dx).sum(axis=0), (D * dx**2 + friction * np.abs(dx)).sum(axis=0)
        balance, flow = balance + work + spent, flow + np.abs(work) + spent
        least = np.minimum(least, balance + case.given + _ROUNDING * flow)
    return least, case.limited(buffer, ticks)


def _held(case: _Case, rng: np.random.Generator, hands: int, seconds: float) -> tuple[int, float]:
    """Return (hands counted as `grew`, the lowest balance plus `given`) over three generations of lossless hands."""
    m, grew, lowest = len(case.delta), 0, 0.0
    mass = np.exp(rng.uniform(np.log(0.02), np.log(2.0), (hands, m, 2)))
    stiff = np.exp(rng.uniform(np.log(30.0), np.log(1e4), (hands, m, 2)))
    speed = case.push * rng.choice([0.03, 0.3, 1.0], hands) * rng.choice([-1.0, 1.0], (m, hands))
    for _ in range(3):
        ratio, least = _let_go(case, mass, stiff, speed, seconds)
        # with a budget motions may decay slowly, so only the energy that was taken counts
        bad = (least < 0) | (ratio > (np.inf if case.given else _GROWN))
        grew, lowest = grew + int(bad.sum()), min(lowest, float(least.min()))
        order = np.argsort(-np.where(least < 0, np.inf, ratio))[: max(1, hands // 6)]
        parents = np.resize(order, hands)
        mass, stiff = (v[parents] * np.exp(rng.normal(0, 0.2, v.shape)) for v in (mass, stiff))
        speed = speed[:, parents] * np.exp(rng.normal(0, 0.3, speed.shape))
    return grew, lowest


def _let_go(case: _Case, mass: Array, stiff: Array, speed: Array, seconds: float) -> tuple[Array, Array]:
    """Return each hand's ratio of rms speeds in the last and first quarter, and its lowest balance plus `given`."""
    hands, ticks = len(mass), round(seconds / case.T)
    links = np.stack([mass, np.zeros_like(mass), stiff], axis=-1)
    devices = tuple(RigidDevice(mass=0.1, damping=float(d)) for d in case.delta)
    crowd = variants(devices, Crowd(links))
    process, rubs = case.process(hands, ticks), np.any(case.friction)
    plants = hold(crowd.plants(), case.T / _PARTS if rubs else case.T)
    states, m = plants.A.shape[-1], len(case.delta)
    friction = np.broadcast_to(case.friction, (m,))[:, None]
    start = np.zeros((states, hands))
    start[states // 2 : states // 2 + m] = speed
    D, (first, last) = case.delta[:, None] / case.T, np.zeros((2, hands))
    balance, flow, least = np.zeros(hands), np.zeros(hands), np.zeros(hands)

    def each_block(buffer: StepBuffer, begin: int, count: int) -> None:
        nonlocal balance, flow, least
        dx, f = np.diff(buffer.x[: count + 1], axis=0), buffer.f[:count]
        work, spent = (f * dx).sum(axis=1), (D * dx**2 + friction * np.abs(dx)).sum(axis=1)
        run = balance + np.cumsum(work + spent, axis=0)
        flow = flow + (np.abs(work) + spent).sum(axis=0)
        least = np.minimum(least, run.min(axis=0) + case.given + _ROUNDING * flow)
        balance, square = run[-1], (buffer.s[:count, states // 2 :] ** 2).mean(axis=1)
        quarter = (begin + np.arange(count)) * 4 // ticks
        first[...] += square[quarter == 0].sum(axis=0)
        last[...] += square[quarter == 3].sum(axis=0)

    engine = _Rubbing(plants, friction) if rubs else ExactEngine(plants)
    outside = plants.B.shape[-1] - m
    run_blocks(process, engine, lambda begin, count: np.zeros((count, outside)), ticks, start, each_block)
    with np.errstate(invalid="ignore", over="ignore"):
        return np.nan_to_num(np.sqrt(last / first), nan=np.inf), np.nan_to_num(least, nan=-np.inf)


_PARTS = 6  # parts of a tick; friction acts anew in each


class _Rubbing:
    """An engine with Coulomb friction. In each part of a tick the friction stops a device or, if too weak, slows it."""

    def __init__(self, plants: HeldPlant, friction: Array) -> None:
        self._A, self._B, self._most = plants.A, plants.B[..., -len(friction) :], friction.T[..., None]
        states, m = plants.A.shape[-1], len(friction)
        self._speeds = slice(states // 2, states // 2 + m)  # the devices' speeds; a force accelerates only one device
        self._gain = np.diagonal(self._B[:, self._speeds], axis1=1, axis2=2)[..., None]

    def start(self, buffer: StepBuffer) -> None:
        self._states, self._forces = buffer.plant_state, buffer.force

    def advance(self, k: int, /) -> None:
        s, pushed = self._states[k].T[..., None], self._B @ self._forces[k].T[..., None]
        for _ in range(_PARTS):
            free = self._A @ s + pushed
            s = free + self._B @ np.clip(-free[:, self._speeds] / self._gain, -self._most, self._most)
        self._states[k + 1][...] = s[..., 0].T

    def troubled(self) -> bool:
        return False


# ---- the guarantees


def _pair(rng: np.random.Generator, stiffest: float = 9000.0) -> tuple[Loop, SpringDamper]:
    """Return a loop of two devices, a mass and delays of up to three samples, and a coupling; delta is arbitrary."""
    K, B = np.exp(rng.uniform(np.log(500), np.log(stiffest), 2)), rng.uniform(0, 2, 2)
    one, two, ground = rng.uniform(100, 1500, 3).tolist()
    springs = Spring(("a", "m"), one, 0.5), Spring(("m", "b"), two, 0.5), Spring(("m", GROUND), ground / 2, 0.1)
    network, theta = Network(("a", "b"), springs, {"m": 0.2}), tuple(int(n) for n in rng.integers(0, 4, 2))
    return Loop(1.2e-3, theta, (0, 0), theta, (1.0, 1.0), network), SpringDamper(K, B)


_FREE = np.full(2, np.inf), np.zeros(2)  # actuator limits and encoder steps without effect


def _limits(rng: np.random.Generator, factor: float) -> _Case:
    """Return a case of limited forces in this environment."""
    loop, coupling = _pair(rng)
    needed = LIMITER.required(loop, coupling).required
    process = Process(loop.law(coupling, (2.0, 1.0), LIMITER.rho(loop)), *_FREE)
    return _Case(lambda nsim, ticks: process, factor * np.array(needed), loop.T, 1e-3)


def _anywhere(rng: np.random.Generator, factor: float) -> _Case:
    """Return a case of any-environment's damping: a limiter with rho = 0, and damped walls that make and break contact.

    The loop is the one of eight random loops in which this-environment requires the largest share of this damping.
    """

    def asked(pair: tuple[Loop, SpringDamper]) -> Array:
        loop, coupling = pair
        return np.array(any_environment(coupling.compliance(loop.T), loop).required)

    def share(pair: tuple[Loop, SpringDamper]) -> float:
        return float((this_environment(pair[0].F(pair[1]), pair[0]).required / asked(pair)).min())

    loop, coupling = worst = max((_pair(rng) for _ in range(8)), key=share)
    needed = asked(worst)
    walls = Wall(("a", GROUND), 3000.0, 2.0, 1e-3), Wall(("m", "b"), 2000.0, 1.0, 0.0)
    network = Network(loop.network.contacts, loop.network.springs, loop.network.masses, walls)
    process = Process(loop.at(network).law(coupling, (2.0, 1.0), (0.0, 0.0)), *_FREE)
    return _Case(lambda nsim, ticks: process, factor * needed, loop.T, 1e-3)


def _budget(rng: np.random.Generator, factor: float) -> _Case:
    """Return a case of the energy budget: without it the loop needs two to four times the available damping."""
    loop, coupling = _pair(rng)
    delta = np.array(this_environment(loop.F(coupling), loop).required) / rng.uniform(2, 4)
    simulation = assemble(_scenario(loop, delta), coupling)

    def process(nsim: int, ticks: int) -> Process:
        made = netted(simulation, EnergyNet(_GIVEN), ticks).process
        return replace(made, force_limit=np.full(2, np.inf))

    return _Case(process, factor * delta, loop.T, 1e-3, given=_GIVEN)


def _walls(rng: np.random.Generator, factor: float) -> _Case:
    """Return a case of two walls, one at the tip and one at a mass behind it."""
    K, B, mass = (float(np.exp(rng.uniform(np.log(a), np.log(b)))) for a, b in ((800, 3000), (0.3, 1), (0.02, 0.1)))
    springs = (Spring(("tip", "mass"), 800.0, 0.3), Spring(("mass", GROUND), 20.0, 0.3))
    damping = rng.choice([0.0, 0.3, 3.0], 2).tolist()
    walls = Wall(("tip", GROUND), 3000.0, damping[0], 1e-3), Wall((GROUND, "mass"), 2000.0, damping[1], 2e-3)
    network, theta = Network(("tip",), springs, {"mass": mass}, walls), (int(rng.integers(0, 3)),)
    loop, coupling = Loop(1e-3, theta, (0,), theta, (1.0,), network), SpringDamper([K], [B])
    needed = np.array(THIS_ENVIRONMENT.required(loop, coupling).required)
    made = assemble(_scenario(loop, needed), coupling).process
    process = replace(made, force_limit=np.full(1, np.inf))
    return _Case(lambda nsim, ticks: process, factor * needed, loop.T, 1e-3)


def _friction(rng: np.random.Generator, factor: float) -> _Case:
    """Return a case of encoder steps of 10 um. The factor applies to friction; damping is as for ideal encoders."""
    loop, coupling = _pair(rng)
    F, step = loop.F(coupling), 1e-5
    needed = np.array(this_environment(F, loop).required)
    process = Process(loop.law(coupling), np.full(2, np.inf), np.full(2, step))
    pays = factor * encoder_friction(F, [step] * 2)
    damping = needed * (1 + 1e-9)
    # Encoder steps matter at speeds of a millimetre a second or less.
    return _Case(lambda nsim, ticks: process, damping, loop.T, step / 4, pays, start=step / 2, push=0.001)


def _scenario(loop: Loop, delta: Array) -> Scenario:
    """Return the loop as a scenario with rigid devices of this damping and a hand at each."""
    devices = tuple(RigidDevice(mass=0.1, damping=float(d)) for d in delta)
    people = tuple(Human((Link(0.5, 1.0, 100.0),)) for _ in devices)
    loop_of = {"T": loop.T, "theta": loop.theta, "psi": loop.psi, "environment": loop.network}
    return Scenario(name="drawn", device=devices, human=people, **loop_of)


#: guarantee -> function that makes a case, and the share of its requirement that is far too little
GUARANTEES: dict[str, tuple[Callable[[np.random.Generator, float], _Case], float]] = {
    "limited, any environment": (_anywhere, 0.25),
    "limited forces": (_limits, 0.5),
    "energy budget": (_budget, 0.5),
    "walls": (_walls, 0.6),
    "encoder steps": (_friction, 0.02),
}
