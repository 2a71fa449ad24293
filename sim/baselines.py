"""The classics, the energy budget and our couplings on the same runs: `python -m design.compare --baselines`.

Each row is the scenario's own motion in the exact plant, with its force limits and encoders, and then 100 random pairs
of lossless hands that are started at 0.1 m/s and left alone for ten seconds: a ladder of one or two masses and springs
at every handle, the same for all rows. A hand that hangs softly behind a spring moves on by itself for long, also with
certified couplings; what counts is whether something is faster at the end than at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from haptic_loop.controller.coupling import NoCoupling
from haptic_loop.controller.lti import Array
from haptic_loop.controller.tick import StepBuffer
from haptic_loop.design.result import CONDITIONS, Chosen, DesignFailed
from haptic_loop.models.hold import hold
from haptic_loop.models.scene import Crowd, variants
from haptic_loop.sim.accuracy import ForceError, force_error
from haptic_loop.sim.couplings import choose, limits_of
from haptic_loop.sim.engines import ExactEngine
from haptic_loop.sim.passivity_layer import BASELINES, Classic, EnergyNet, netted
from haptic_loop.sim.run import Simulation, assemble, run, run_blocks
from haptic_loop.sim.scenario import InputError, Scenario, require_even_ticks

PAIRS, SECONDS, SLOW = 100, 10.0, 0.1  # of lossless hands, their time [s], their speed at the start [m/s]
_AUDIBLE = 40.0  # [Hz] above which a force is felt as buzzing
_SEED = 1

_DESIGNS = (
    ("spring-damper", "any-environment"),
    ("spring-damper", "this-environment"),
    ("optimal", "this-environment"),
)


@dataclass(frozen=True)
class Rival:
    """One row of the comparison."""

    name: str
    baseline: bool  # published by others
    guarantee: str | None  # None where there is none in this loop
    source: str | None  # the paper of a baseline
    error_percent: float | None  # rms of the applied force less Lambda E's, over the latter
    fast_n: float  # rms of the applied force above AUDIBLE [N]
    peak_n: float
    acted_percent: float  # of the ticks, while the users move
    moving: int  # of PAIRS: faster in the last second than at the start
    fastest_m_s: float  # in the last second
    reason: str | None = None  # why a figure does not exist


@dataclass(frozen=True)
class Baselines:
    """The classics and our couplings on the same runs."""

    scenario: str
    case: str
    seed: int
    rows: Sequence[Rival]
    wall_s: float
    interrupted: bool
    hands: int = PAIRS
    hands_s: float = SECONDS
    start_m_s: float = SLOW


def rivals(
    scenario: Scenario,
    case: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
    limiter: bool | None = None,
) -> Iterator[Rival]:
    """No coupling but its limits, every baseline, the budget, and our designs where there are such.

    With `limiter` False forces of the designs are clipped, too, and they are designed for that.

    Raises InputError for what this comparison cannot show.
    """
    require_even_ticks(scenario, "--baselines")
    if scenario.ranges or scenario.switches:
        given = "[ranges]" if scenario.ranges else "[varying_delay]"
        raise InputError(f"--baselines compares in one environment with constant delays: leave out {given}")
    if any(device.friction for device in scenario.device):
        raise InputError("--baselines runs in the exact plant, which has no Coulomb friction; the devices have")
    return _rivals(scenario, case, progress, limiter)


def _rivals(
    scenario: Scenario, case: str, progress: Callable[[int, int], None], limiter: bool | None
) -> Iterator[Rival]:
    nets = [None, *map(Classic, BASELINES), EnergyNet(0.0)]
    total = len(nets) + len(_DESIGNS)
    for done, net in enumerate(nets):
        progress(done, total)
        yield _judged(scenario, case, None, net)
    for done, (kind, condition) in enumerate(_DESIGNS, start=len(nets)):
        progress(done, total)
        try:
            chosen = choose(scenario, case, kind, condition, limiter)
        except DesignFailed:
            continue
        yield _judged(scenario, case, chosen, None, limiter)


def _judged(
    scenario: Scenario,
    case: str,
    design: Chosen | None,
    net: Classic | EnergyNet | None,
    limiter: bool | None = None,
) -> Rival:
    coupling = design.coupling if design else NoCoupling()
    simulation = assemble(scenario, coupling, limits_of(scenario, design, limiter=limiter).rho if design else None)
    most = max(scenario.samples, round(SECONDS / scenario.T))
    with_net = netted(simulation, net, most) if net else simulation
    trace = run(with_net, "exact")
    # of the force within its limits: what acted, whatever computed it
    asked = force_error(with_net, trace, scenario.loop(case).lam)
    applied = ForceError.of(trace.f, asked.ideal, asked.reason if with_net.process.walls else None)
    acted = trace.net.figures().limited_ticks if trace.net else 0
    moving, fastest = _left_alone(with_net)
    name, guarantee, source = (net.name, net.guarantee, net.source) if net else ("none, clipped", None, None)
    if design:
        guarantee = CONDITIONS[design.condition]
        name = f"{design.kind}, {guarantee}"
    return Rival(
        name,
        source is not None,
        guarantee,
        source,
        applied.error_percent,
        _fast(trace.f, scenario.T),
        float(np.abs(trace.f).max(initial=0.0)),
        100 * acted / max(1, len(trace.t)),
        moving,
        fastest,
        applied.reason,
    )


def _fast(f: Array, T: float) -> float:
    """rms of what is above AUDIBLE [N]."""
    spectrum = np.fft.rfft(f, axis=0)
    spectrum[np.fft.rfftfreq(len(f), T) < _AUDIBLE] = 0
    return float(np.sqrt(np.mean(np.fft.irfft(spectrum, len(f), axis=0) ** 2)))


def _left_alone(simulation: Simulation) -> tuple[int, float]:
    """How many pairs of lossless hands are faster in the last second than at the start, and the largest speed then."""
    scenario, process = simulation.scenario, simulation.process
    rng, m = np.random.default_rng(_SEED), scenario.channels
    mass, stiffness = (
        np.exp(rng.uniform(np.log(r[0]), np.log(r[1]), (PAIRS, m, 2))) for r in ((0.01, 3.0), (1.0, 1e4))
    )
    crowd = variants(scenario.device, Crowd(np.stack([mass, np.zeros_like(mass), stiffness], axis=-1)))
    plants = hold(crowd.plants(), scenario.T)
    states = plants.A.shape[-1]
    start = np.zeros((states, PAIRS))
    start[states // 2 :] = SLOW * rng.choice([-1.0, 1.0], (1, PAIRS))
    ticks = round(SECONDS / scenario.T)
    last, fastest = ticks - round(1 / scenario.T), np.zeros(PAIRS)

    def each_block(buffer: StepBuffer, first: int, count: int) -> bool:
        if first >= last:
            speed = np.abs(buffer.s[:count, states // 2 :]).max(axis=(0, 1))
            np.maximum(fastest, np.where(np.isfinite(speed), speed, np.inf), out=fastest)
        return False

    outside = plants.B.shape[-1] - m
    engine = ExactEngine(plants)
    run_blocks(process, engine, lambda first, count: np.zeros((count, outside)), ticks, start, each_block)
    return int((fastest > SLOW).sum()), float(fastest.max())
