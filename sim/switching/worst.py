"""The worst delays for a loop: greedy switching, and the periodic switching in it that grows fastest, exactly.

Greedy: the loop starts from a knock on every handle. At every tick and on every channel the device is handed, of
the forces that a delay in [lo, hi] allows, the one that brakes it least or pushes it most: the largest -f v. Ages
grow by one per tick at most, as they do where packets are held. Periodic: of all windows of that sequence that may
be repeated, the one whose product of mode matrices has the largest spectral radius per tick: a proof of instability
where it exceeds 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from controller.delay import Ticks, realising
from controller.jitter import Jitter
from controller.lti import Array, Lti
from controller.process import Process, Tape
from models.scene import Scene
from sim.batch_engine import ExactBatchEngine
from sim.exact_engine import HeldPlant
from sim.knock import knock_forces
from sim.switching.switched import mode_matrix

LONGEST_PERIOD = 250  # [ticks]
STARTS = 6  # windows begin at so many ticks of the greedy sequence
MOST_ENDS = 256  # constant delays, each at an end of its range, that are compared


def greedy_ages(process: Process, plants: HeldPlant, scene: Scene, jitter: Jitter, ticks: int) -> Ticks:
    """Ages (ticks, m, nsim) that feed the linear loop of every plant; `process` is that without Theta."""
    nsim, states, nv = plants.A.shape[0], plants.A.shape[1], scene.model.nv
    m, free = process.channels, np.full(process.channels, np.inf)
    lo, hi = (np.array(side)[:, None] for side in (jitter.lo, jitter.hi))
    depth = int(hi.max()) + 1
    tape = Tape(replace(process, force_limit=free, delays=None), 1, states, scene.outside, nsim)
    engine = ExactBatchEngine(plants, free)
    engine.start(tape)
    pushed = knock_forces(scene, process.F.T, 0, ticks)
    sent, age = np.zeros((depth, m, nsim)), np.broadcast_to(hi, (m, nsim))
    candidate = np.arange(depth)[:, None, None]
    ages = np.empty((ticks, m, nsim), dtype=np.int64)
    for k in range(ticks):
        tape.w[0] = pushed[k][:, None]
        tape.tick(0)
        sent = np.concatenate([tape.f[0][None], sent[:-1]])  # sent[n] left n ticks ago
        allowed = (candidate >= lo) & (candidate <= np.minimum(hi, age + 1))
        age = np.argmin(np.where(allowed, sent * tape.s[0][nv : nv + m], np.inf), axis=0)
        tape.f[0] = np.take_along_axis(sent, age[None], axis=0)[0]
        engine.advance(0)
        tape.rewind(1)
        ages[k] = age
        if k % 32 == 31 and not pushed[k:].any():  # the choice does not depend on the scale
            size = np.maximum(np.abs(tape.s[0]).max(axis=0), 1e-200)
            tape.s[0] /= size
            tape.z[0] /= size
            sent /= size
    return ages


@dataclass(frozen=True, eq=False)
class Period:
    """Switching that repeats, with the exact growth of the loop under it."""

    ages: Ticks  # (period, m)
    delays: Ticks  # (period, m) of the packets that make these ages
    growth: float  # [1/s]
    spectral_radius: float  # of the product over one period


def worst_period(ages: Ticks, plant: HeldPlant, G: Lti, jitter: Jitter) -> Period:
    """The fastest growing repetition of a window of `ages` (ticks, m), or of one delay at an end of its range."""
    ticks = ages.shape[0]
    cache: dict[tuple[int, ...], Array] = {}

    def matrix(row: Array) -> Array:
        key = tuple(int(n) for n in row)
        if key not in cache:
            cache[key] = mode_matrix(plant, G, jitter.hi, key)
        return cache[key]

    best, chosen = -np.inf, ages[:1]
    starts = np.linspace(ticks // 3, max(ticks - LONGEST_PERIOD, ticks // 3), STARTS, dtype=int)
    ends = [np.array([row]) for row in product(*zip(jitter.lo, jitter.hi, strict=True))][:MOST_ENDS]
    for window in [*(ages[start : start + LONGEST_PERIOD] for start in starts), *ends]:
        products, scale = _running_products([matrix(row) for row in window])
        radius = np.abs(np.linalg.eigvals(products)).max(axis=1)
        periods = np.arange(1, len(window) + 1)
        growth = (np.log(np.maximum(radius, 1e-300)) + scale) / (periods * G.T)
        growth[(window[0] > window + 1).any(axis=1)] = -np.inf  # a device does not return to an older force
        at = int(np.argmax(growth))
        if growth[at] > best:
            best, chosen = float(growth[at]), window[: at + 1]
    period = len(chosen)
    delays = realising(np.tile(chosen, (2 + -(-2 * max(jitter.hi) // period), 1)))
    return Period(chosen, delays[:period], best, float(np.exp(best * period * G.T)))


def _running_products(matrices: list[Array]) -> tuple[Array, Array]:
    """A_p .. A_2 A_1 for every p, each divided by exp(scale_p)."""
    power, scale = np.eye(matrices[0].shape[0]), 0.0
    products, scales = [], []
    for A in matrices:
        power = A @ power
        size = max(float(np.abs(power).max()), 1e-300)
        power, scale = power / size, scale + np.log(size)
        products.append(power)
        scales.append(scale)
    return np.stack(products), np.array(scales)
