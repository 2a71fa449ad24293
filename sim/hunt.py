"""A search for hands that switching contact keeps in motion, though every frozen contact state is certified.

It is for walls with dampers: of walls without, docs/theory.md proves that making and breaking contact is covered. Every
draw is a loop of one channel: a light rigid device, a random delay, an environment of a spring, a mass and one or two
walls at random places, a random spring-damper coupling. The device gets just the damping that this-environment asks in
the worst frozen contact state, so all of them are certified; draws that any-environment certifies as well are left out,
because there the answer is known. Lossless hands are let go from random states: half of them of random
mass and stiffness, half those of many whose modes above 5 Hz decay most slowly in a frozen state. No force limit, no
outside force.

The criterion, fixed before the first search: a counterexample is a hand and a start from which contact goes on in every
quarter of a run and the rms speed in the last quarter is at least that in the second, in a run of the asked length and
again in two runs from the same start, four and sixteen times as long. A speed below 1e-6 of the first quarter's is
rounding, not motion; a force of 1e6 N is growth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from controller.coupling import SpringDamper
from controller.environment import GROUND, Network, Spring, Wall
from controller.loop import Loop
from controller.lti import Array
from controller.process import Process, StepBuffer
from design.certificate import any_environment_of, this_environment_of
from models.device import RigidDevice
from models.human import Human, Link
from models.scene import Crowd, variants
from sim.engines import Engine, ExactBatchEngine, hold
from sim.run import assemble, run_blocks
from sim.scenario import Scenario
from sim.stability import close

LENGTHS = (1, 4, 16)  # of the runs that a counterexample must survive, in terms of the asked length
_POOL, _MIN_FREQUENCY_HZ = 20, 5.0  # hands looked at for one that is let go; of the modes looked at
_LIMIT = 1e6  # [N], so that growth ends before numbers do
_ROUNDING = 1e-6  # of the first quarter's speed
_SPARE = 1e-4  # share of the damping beyond what the frozen states require
_BLOCK = 64  # ticks between two looks at a buffer

# ---- many loops left alone from given states: how often their walls are hit, and whether the motion dies out


@dataclass(frozen=True, eq=False)
class _Bounces:
    """One row per window of equal length, one column per simulation."""

    made: Array  # (windows, nsim) contacts made, all walls together
    speed: Array  # (windows, nsim) [m/s] rms over all of the plant's coordinates
    clipped: Array  # (windows, nsim) ticks with a force at its limit


def bounce(process: Process, engine: Engine, start: Array, ticks: int, windows: int = 4, outside: int = 0) -> _Bounces:
    """Simulate from the plant states `start`, (2n, nsim), with `outside` outside forces, all zero.

    `ticks` is rounded down to whole windows of whole blocks. Raises ValueError where there is no wall, or no tick.
    """
    walls = process.contact
    if walls is None:
        raise ValueError("process has no walls, so nothing can bounce")
    blocks = ticks // (windows * _BLOCK)
    if blocks < 1:
        raise ValueError(f"ticks is {ticks}, expected at least {windows * _BLOCK}: {windows} windows of {_BLOCK}")
    n, nsim = start.shape
    limit = process.force_limit[:, None]
    made, square, clipped = (np.zeros((windows, nsim)) for _ in range(3))
    before = np.zeros((1, len(walls.walls), nsim), dtype=bool)

    def look(buffer: StepBuffer, first: int, count: int) -> None:
        nonlocal before
        i = first // (blocks * _BLOCK)
        touching = walls.depths(buffer.z) > 0
        made[i] += (touching & ~np.concatenate([before, touching[:-1]])).sum(axis=(0, 1))
        square[i] += (buffer.s[:count, n // 2 :] ** 2).mean(axis=1).sum(axis=0)
        clipped[i] += (np.abs(buffer.f[:count]) >= limit).any(axis=1).sum(axis=0)
        before = touching[-1:]

    def at_rest(first: int, count: int) -> Array:
        return np.zeros((count, outside))

    run_blocks(process, engine, at_rest, windows * blocks * _BLOCK, start, look, _BLOCK)
    return _Bounces(made, np.sqrt(square / (blocks * _BLOCK)), clipped)


# ---- the search


@dataclass(frozen=True, eq=False)
class Case:
    """A loop whose frozen contact states are all certified, and any-environment not."""

    scenario: Scenario
    coupling: SpringDamper
    any_environment: float  # damping that any-environment requires over what there is


@dataclass(frozen=True, eq=False)
class Found:
    """The hand and the start that kept moving most in the longest run, and the strongest of every run before."""

    index: int
    case: Case
    hand: Array  # mass [kg], stiffness [N/m]
    start: Array  # plant state
    ratio: tuple[float, ...]  # rms speed, last quarter over second, per run
    made: tuple[int, ...]  # contacts in the last quarter, per run

    @property
    def counterexample(self) -> bool:
        return len(self.ratio) == len(LENGTHS) and self.ratio[-1] >= 1 and self.made[-1] > 0


def draw(seed: int, index: int, dampers: bool = True) -> Case | None:
    """Loop `index` of a seed; None where any-environment certifies it too, or no damping does.

    Without `dampers` the device gets what is proved for walls that make and break contact.
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, index)))

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    T, theta = 1e-3, int(rng.integers(0, 4))
    spring = Spring(("tip", "mass"), between(100, 2e4), between(1e-3, 1))
    mass, K, B = between(1e-3, 1), between(500, 5e4), between(1e-3, 10)
    ends = [("mass", GROUND), ("tip", GROUND), (GROUND, "mass"), ("tip", "mass")]
    walls = []
    for i in rng.permutation(4)[: rng.integers(1, 3)]:
        gap = between(1e-4, 1e-2) if rng.random() < 0.5 else 0.0
        walls.append(Wall(ends[i], between(100, 1e5), between(0.01, 10) if dampers else 0.0, gap))
    network = Network(("tip",), (spring,), {"mass": mass}, tuple(walls))
    coupling = SpringDamper(np.array([K]), np.array([B]))
    loop = Loop(T, (theta,), (0,), (theta,), (1.0,), network)
    frozen, whatever = (
        this_environment_of(loop, coupling).ratio * (1 + _SPARE),
        any_environment_of(loop, coupling).ratio,
    )
    if not 0.01 < frozen < min(whatever, 20.0):
        return None
    device = RigidDevice(mass=between(0.01, 0.25), damping=frozen, force_limit=_LIMIT)
    scenario = Scenario(f"draw {index}", T, (theta,), (0,), (device,), (Human((Link(0.1, 0.0, 100.0),)),), network)
    return Case(scenario, coupling, whatever / frozen)


def attack(case: Case, index: int, seed: int, hands: int, seconds: float) -> Found:
    """Let lossless hands go, and follow those that keep moving for longer."""
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, 1)))
    links = np.zeros((_POOL * hands, 1, 1, 3))
    for column, (low, high) in ((0, (1e-3, 3.0)), (2, (1.0, 1e5))):
        links[:, 0, 0, column] = np.exp(rng.uniform(np.log(low), np.log(high), len(links)))
    shaky = np.argsort(_decay(case, links[hands:]))[: hands // 2] + hands
    links = np.concatenate([links[: hands - hands // 2], links[shaky]])
    start = np.stack([rng.uniform(-5e-3, 5e-3, hands), rng.uniform(-0.3, 0.3, hands)])
    found = Found(index, case, np.empty(0), np.empty(0), (), ())
    for length in LENGTHS:
        ratio, made = _let_go(case, links, start, length * seconds)
        on = np.where((made > 0).all(axis=0), ratio, -1.0)
        best = int(on.argmax())
        kept = (*found.ratio, float(on[best])), (*found.made, int(made[-1, best]))
        found = replace(found, hand=links[best, 0, 0, [0, 2]], start=start[:, best], ratio=kept[0], made=kept[1])
        if not on[best] >= 1:
            break
        links, start = links[on >= 1], start[:, on >= 1]
    return found


def _decay(case: Case, links: Array) -> Array:
    """Of each hand: the slowest decay [1/s] among the modes above 5 Hz, over all frozen states, (nsim,)."""
    loop, T = assemble(case.scenario, case.coupling), case.scenario.T
    plants = hold(variants(case.scenario.device, Crowd(links)).plants(), T)
    slowest = np.full(len(links), np.inf)
    for F in loop.process.frozen().values():
        values = np.linalg.eigvals(close(plants, F).A)
        fast = np.abs(np.angle(values)) / (2 * np.pi * T) >= _MIN_FREQUENCY_HZ
        slowest = np.minimum(slowest, -np.log(np.where(fast, np.abs(values), 1e-300).max(axis=1)) / T)
    return slowest


def _let_go(case: Case, links: Array, start: Array, seconds: float) -> tuple[Array, Array]:
    """Speed of the last over that of the second quarter, (nsim,), and contacts made, (4, nsim)."""
    loop, sets = assemble(case.scenario, case.coupling), variants(case.scenario.device, Crowd(links))
    engine = ExactBatchEngine(hold(sets.plants(), case.scenario.T), loop.process.force_limit)
    seen = bounce(loop.process, engine, start, round(seconds / case.scenario.T), outside=sets.scene.outside)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.nan_to_num(seen.speed[-1] / seen.speed[1], nan=np.inf)
        moving = ~(seen.speed[-1] <= _ROUNDING * seen.speed[0])
    grown = seen.clipped.sum(axis=0) > 0  # to a force of 1e6 N, from a start of 0.3 m/s
    return np.where(grown, np.inf, np.where(moving, ratio, 0.0)), seen.made + grown


if __name__ == "__main__":
    from cli.main import door

    door("hunt")
