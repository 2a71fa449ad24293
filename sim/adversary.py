"""Seeded searches for the passive humans whose loop grows fastest: lossless chains, or hands of the population.

A lossless chain of masses and springs dissipates no energy, and can present any reactance at the frequency where the
loop is weakest. The bounds on masses and stiffnesses keep the modes of a human below about 3 kHz. With faster modes,
errors of the matrix exponential would decide the verdict.

All conditions but the known-device ones assume that a device with unit damping dissipates |dx|^2 / T in a tick. In fact
it dissipates the integral of v^2. For a sinusoid of frequency f, |dx|^2 / T is (sin a / a)^2 times the integral, with
a = pi f T. At the frequency f where a condition binds, the share 1 - (sin a / a)^2 of the required damping is therefore
not needed: 4.7 % at 101 Hz and T = 1.2 ms. No search has found an unstable human for a loop that lacks at most this
share of the required damping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from haptic_loop.controller.lti import Array, Lti
from haptic_loop.models.device import Device, Mechanics
from haptic_loop.models.human import Hand, Person
from haptic_loop.models.scene import Crowd, HumanSets, variants
from haptic_loop.sim.run import Progress
from haptic_loop.sim.scenario import Scenario
from haptic_loop.sim.stability import ClosedLoop, dominant_mode, exact_loops

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

_MASS, _STIFFNESS = (1e-3, 3.0), (0.1, 1e5)  # ranges of searched masses [kg] and stiffnesses [N/m] at the hand
_WITHIN = 4  # number of parameters that place a device within its guaranteed bounds (models.device.Mechanics)
_DESTABILISED = 1e-6  # [1/s] least growth that counts as destabilising; rounding gives up to 1e-9


class _Pass(NamedTuple):
    """Settings of a search. Slow modes of lossless hands barely decay, and could hide faster ones that nearly grow."""

    links: int  # number of links of each arm; one mass with a spring presents every reactance at one frequency
    min_frequency_hz: float  # slower modes are ignored
    held: bool = False  # whether one person holds all devices; body and cross spring present every reactance matrix


_PASSES = (_Pass(1, 2.0), _Pass(2, 2.0), _Pass(1, 0.0), _Pass(1, 2.0, held=True))
_CANDIDATES = 120  # number of sets of humans in a generation


@dataclass(frozen=True)
class Worst:
    """The worst humans of a search."""

    humans: tuple[Hand, ...]
    persons: tuple[Person, ...]  # persons who hold several devices
    spectral_radius: float
    growth: float  # [1/s]
    frequency_hz: float
    evaluated: int  # number of sets of humans that were tried
    mechanics: Sequence[Mechanics] = ()  # mechanics of the devices, if all have bounds; () from search_population

    @property
    def destabilises(self) -> bool:
        return self.growth > _DESTABILISED


def search(
    scenario: Scenario,
    F: Lti,
    seed: int = 0,
    generations: int = 150,
    first: bool = False,
    progress: Progress = lambda done, total: None,
) -> Worst:
    """Search for the lossless humans with the largest growth, and return them.

    F maps positions to forces; in a loop with walls the caller chooses the set of touched walls. With `first`, the
    search ends once humans destabilise the loop. `progress` is called after every generation.
    """
    from scipy.optimize import differential_evolution  # slow to load

    m, done = len(scenario.device), 0
    passes = [p for p in _PASSES if m > 1 or not p.held]

    def stop(intermediate_result: OptimizeResult) -> bool:
        nonlocal done
        done += 1
        progress(done, len(passes) * generations)
        return first and bool(-intermediate_result.fun > 10 * _DESTABILISED)

    best, evaluated, scale = None, 0, scenario.lever**2
    mass, stiffness = ([scale * end for end in ends] for ends in (_MASS, _STIFFNESS))
    for trial, kind in enumerate(passes):
        logarithms = [mass, stiffness] * (m * kind.links) + [mass, stiffness, stiffness] * kind.held
        known = all(device.guaranteed for device in scenario.device)
        ranges = [*np.log(logarithms), *[(-1.0, 1.0)] * (_WITHIN * m * known)]
        optimum = differential_evolution(
            partial(_losses, scenario=scenario, F=F, kind=kind),
            ranges,
            rng=np.random.default_rng(np.random.SeedSequence((seed, trial))),
            popsize=_CANDIDATES // len(ranges),
            maxiter=generations,
            tol=0,
            polish=False,
            vectorized=True,
            updating="deferred",
            callback=stop,
        )
        done = (trial + 1) * generations
        evaluated += (optimum.nit + 1) * (_CANDIDATES // len(ranges)) * len(ranges)
        worst = _worst(scenario, F, _lossless_humans(optimum.x[:, None], scenario.device, kind), evaluated)
        best = worst if best is None or worst.growth > best.growth else best
        if first and best.destabilises:
            break
    assert best is not None
    return replace(best, evaluated=evaluated)


_ELITE = 12  # number of the worst sets of hands, from which the next generation is combined


def search_population(
    scenario: Scenario,
    F: Lti,
    seed: int = 0,
    generations: int = 150,
    progress: Progress = lambda done, total: None,
) -> Worst:
    """Search for the worst set of hands that the scenario's population can draw, and return it.

    In the first generation all sets are new draws. In later generations half of the sets are new draws; the other sets
    take each device's hand from one of the worst sets so far, or from a new draw.
    """
    rng, m = np.random.default_rng(np.random.SeedSequence((seed, len(_PASSES)))), len(scenario.device)
    elite: list[tuple[float, tuple[Hand, ...]]] = []
    for generation in range(generations):
        sets: list[tuple[Hand, ...]] = [tuple(scenario.population.draw(rng, m)) for _ in range(_CANDIDATES)]
        for i in range(_CANDIDATES // 2 if elite else 0):
            parents = [elite[int(k)][1] for k in rng.integers(len(elite), size=m)]
            fresh = rng.random(m) < 1 / (m + 1)
            sets[i] = tuple(sets[i][c] if fresh[c] else parents[c][c] for c in range(m))
        elite = sorted([*elite, *_ranked(scenario, F, sets)], key=lambda one: -one[0])[:_ELITE]
        progress(generation + 1, generations)
    return _worst(scenario, F, HumanSets((elite[0][1],), scenario.person), generations * _CANDIDATES)


def _ranked(scenario: Scenario, F: Lti, sets: Sequence[tuple[Hand, ...]]) -> list[tuple[float, tuple[Hand, ...]]]:
    """Return (growth [1/s], set) for each set. If no mode grows, only modes from 2 Hz up count for the growth."""
    layouts: dict[object, list[tuple[Hand, ...]]] = {}
    for hands in sets:
        layouts.setdefault(tuple(hand.port().layout for hand in hands), []).append(hands)
    ranked: list[tuple[float, tuple[Hand, ...]]] = []
    for alike in layouts.values():
        loops = _loops(scenario, F, HumanSets(tuple(alike), scenario.person))
        fast, growth = loops.growths(_PASSES[0].min_frequency_hz, 0.0)
        ranked += zip(np.where(growth > _DESTABILISED, growth, fast).tolist(), alike, strict=True)
    return ranked


def _lossless_humans(x: Array, devices: Sequence[Device], kind: _Pass) -> Crowd:
    """Return lossless humans for logarithms of their masses and stiffnesses, (2 * devices * links, nsim).

    If one person holds all devices, three more rows are the body's mass and stiffness and the cross stiffness. If all
    devices have guaranteed bounds, the last rows, _WITHIN per device, are the arguments u of `Mechanics.within`.
    """
    arms = 2 * len(devices) * kind.links
    x, within = np.split(x, [arms + 3 * kind.held])
    values = np.exp(x[:arms].T).reshape(-1, len(devices), kind.links, 2)
    links = np.stack([values[..., 0], np.zeros_like(values[..., 0]), values[..., 1]], axis=-1)
    places = within.T.reshape(len(links), -1, _WITHIN)
    mechanics = tuple(tuple(map(Mechanics.within, devices, row)) for row in places) if len(within) else ()
    if not kind.held:
        return Crowd(links, mechanics=mechanics)
    mass, stiffness, cross = np.exp(x[arms:])
    bodies = np.stack([mass, 0 * mass, stiffness, 0 * mass, cross], axis=-1)[:, None]
    return Crowd(links, (tuple(range(1, len(devices) + 1)),), bodies, mechanics=mechanics)


def _loops(scenario: Scenario, F: Lti, crowd: Crowd | HumanSets) -> ClosedLoop:
    """Return the loops of a crowd with the longest period and with forces that latch as late as possible."""
    late = None if scenario.latency is None else [most for _, most in scenario.latency]
    return exact_loops(variants(scenario.device, crowd), F, scenario.longest_period, late)


def _losses(x: Array, scenario: Scenario, F: Lti, kind: _Pass) -> Array:
    """Return minus the largest growth [1/s] among the modes of the pass, for every column of x."""
    loops = _loops(scenario, F, _lossless_humans(x.reshape(x.shape[0], -1), scenario.device, kind))
    (growth,) = loops.growths(kind.min_frequency_hz)
    return -growth


def _worst(scenario: Scenario, F: Lti, crowd: Crowd | HumanSets, evaluated: int) -> Worst:
    mode = dominant_mode(_loops(scenario, F, crowd))
    radius, growth, frequency = (float(a[0]) for a in (mode.spectral_radius, mode.growth, mode.frequency_hz))
    mechanics = crowd.mechanics[0] if crowd.mechanics else ()
    return Worst(crowd.humans(0), crowd.persons(0), radius, growth, frequency, evaluated, mechanics)
