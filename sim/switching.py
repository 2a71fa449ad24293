"""Varying delays: the loop as a switched system, its worst switching, and the certificates that cover it.

The age of a force is the number of ticks since the controller sent it. For given ages of the forces that the devices
apply, a tick of the loop is a linear map, its mode matrix. The state is
xi = [s; z; g_1[k-1] .. g_1[k-d_1]; g_2[k-1] ..]: the plant, the controller's block G (without the delays Theta), and
the forces g_i that G sent in the last d_i ticks, where d_i is the largest delay on channel i.

The search for the worst delays is greedy. The loop starts from an impulse on every handle. At every tick the delays in
[lo, hi] allow several forces; each device receives that force which gives it the most power -f'v. An age grows by
at most one per tick, because a device holds its newest force. Candidates for the worst period are windows of this
sequence that may be repeated, and constant delays at the ends of their ranges. The worst candidate is the one whose
product of mode matrices grows fastest per tick. A spectral radius of this product above 1 proves instability.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice, product

import numpy as np
from numpy.typing import NDArray

from haptic_loop.controller.delay import Ticks, Timing, VaryingDelay, realising
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Process, StepBuffer
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.coverage import SwitchingFigures
from haptic_loop.design.environments import SWITCHING
from haptic_loop.design.files import off_table
from haptic_loop.design.result import switching_guarantee
from haptic_loop.models.hold import HeldPlant, hold
from haptic_loop.models.scene import Scene, Variants
from haptic_loop.sim.engines import Engine, ExactEngine, ExactTimedEngine
from haptic_loop.sim.run import Simulation
from haptic_loop.sim.scenario import Scenario
from haptic_loop.sim.stability import SETTLED, impulse_forces, impulse_growth, unstable

_SEARCHED = 1600  # number of ticks of greedy switching, in which the worst period is searched
_LONGEST_PERIOD = 250  # [ticks] largest length of a searched window
_STARTS = 6  # number of windows of the greedy sequence
_MOST_ENDS = 256  # largest number of combinations of constant delays at the ends of their ranges
_SHORTEST = 4  # least number of ticks, as a growth rate compares quarters of the trace
_STREAM = 5  # random stream of the delays, independent of the humans' stream with the same seed and index


@dataclass(frozen=True, eq=False)
class Period:
    """Periodic switching with the exact growth of the loop."""

    ages: Ticks  # (period, m) ages [samples] of the forces that the devices apply
    delays: Ticks  # (period, m) delays [samples] of packets that produce these ages
    growth: float  # [1/s] growth over one period
    spectral_radius: float  # spectral radius of the product of mode matrices over one period


# ---- one run


def switching(simulation: Simulation, seed: int, ticks: int) -> tuple[Simulation, Period | None]:
    """Return the loop under the scenario's varying delays, and their period if the pattern is adversarial."""
    varying = simulation.scenario.varying_delay
    assert varying is not None
    period = _worst_switching(simulation, varying) if varying.pattern == "adversarial" else None
    recorded = period.delays if period else None
    delays = _draw_delays(simulation.scenario, seed, 0, max(ticks, _SHORTEST), recorded)
    return replace(simulation, process=replace(simulation.process, delays=delays[:, :, None])), period


def _worst_switching(simulation: Simulation, varying: VaryingDelay) -> Period:
    plant, process = simulation.plant, simulation.process
    one = HeldPlant(plant.A[None], plant.B[None], plant.C, plant.T)
    ages = _greedy_ages(process, one, simulation.scene, varying, _SEARCHED)
    return _worst_period(ages[:, :, 0], plant, process.law.sent, varying, simulation.scenario.lead)


def _draw_delays(scenario: Scenario, seed: int, index: int, ticks: int, recorded: Ticks | None = None) -> Ticks:
    """Return the delays (ticks, m) of run `index` by the scenario's pattern; `recorded` has the adversarial delays."""
    assert scenario.varying_delay is not None
    rows = np.array([scenario.theta]) if scenario.varying_delay.pattern == "constant" else recorded
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, _STREAM)))
    delays = scenario.varying_delay.draw(rng, ticks, rows)
    return delays if scenario.axis_devices is scenario.device else delays[:, scenario.lead]


# ---- the worst delays


def _mode_matrix(plant: HeldPlant, G: Lti, depth: Sequence[int], ages: Sequence[int]) -> Array:
    """Return A of xi[k+1] = A xi[k] while the forces have these ages [samples]; `depth` has the largest ages."""
    states, m = plant.A.shape[0], G.outputs
    n, first = states + G.order + sum(depth), states + G.order
    sent = np.zeros((m, n))
    sent[:, :states], sent[:, states:first] = G.D @ plant.C, G.C
    A, applied = np.zeros((n, n)), np.zeros((m, n))
    A[states:first, :states], A[states:first, states:first] = G.B @ plant.C, G.A
    row = first
    for i, (d, age) in enumerate(zip(depth, ages, strict=True)):
        if d:
            A[row] = sent[i]
            A[row + 1 : row + d, row : row + d - 1] = np.eye(d - 1)
        if age:
            applied[i, row + age - 1] = 1.0
        else:
            applied[i] = sent[i]
        row += d
    A[:states] = plant.B[:, -m:] @ applied
    A[:states, :states] += plant.A
    return A


def _greedy_ages(process: Process, plants: HeldPlant, scene: Scene, varying: VaryingDelay, ticks: int) -> Ticks:
    """Return ages (ticks, m, nsim) that feed energy into the linear loop of every plant; a device's axes share them."""
    nsim, states, nv = plants.A.shape[0], plants.A.shape[1], scene.model.nv
    m, law = process.channels, process.law.without_theta
    free = replace(process, law=law, force_limit=np.full(m, np.inf), delays=None)
    lo, hi = (np.array(side)[:, None] for side in (varying.lo, varying.hi))
    depth = int(hi.max()) + 1
    buffer = StepBuffer(free, 1, states, scene.outside, nsim)
    engine = ExactEngine(plants)
    engine.start(buffer)
    pushed = impulse_forces(scene, process.F.T, 0, ticks)
    sent, age = np.zeros((depth, m, nsim)), np.broadcast_to(hi, (m, nsim))
    candidate, row, column = np.arange(depth)[:, None, None], np.arange(m)[:, None], np.arange(nsim)
    first, device = np.unique(scene.devices, return_index=True)[1], list(scene.devices)
    ages = np.empty((ticks, m, nsim), dtype=np.int64)
    for k in range(ticks):
        buffer.w[0] = pushed[k][:, None]
        buffer.tick(0)
        sent = np.concatenate([buffer.f[0][None], sent[:-1]])  # sent[n] left n ticks ago
        allowed = (candidate >= lo) & (candidate <= np.minimum(hi, age + 1))
        taken = np.add.reduceat(sent * buffer.s[0][nv : nv + m], first, axis=1)[:, device]
        age = np.argmin(np.where(allowed, taken, np.inf), axis=0)
        buffer.f[0] = sent[age, row, column]
        engine.advance(0)
        buffer.rewind(1)
        ages[k] = age
        if k % 32 == 31 and not pushed[k:].any():  # Rescaling avoids overflow, and does not change the ages.
            size = np.maximum(np.abs(buffer.s[0]).max(axis=0), 1e-200)
            buffer.s[0] /= size
            buffer.z[0] /= size
            sent /= size
    return ages


def _worst_period(ages: Ticks, plant: HeldPlant, G: Lti, varying: VaryingDelay, lead: Sequence[int]) -> Period:
    """Return the period that grows fastest if it repeats: part of `ages` (ticks, m), or constant delays lo or hi.

    `lead` has for each channel the first channel of its device, whose delay all axes of the device share.
    """
    ticks = ages.shape[0]
    matrix = cache(lambda *now: _mode_matrix(plant, G, varying.hi, now))
    best, chosen = -np.inf, ages[:1]
    starts = np.linspace(ticks // 3, max(ticks - _LONGEST_PERIOD, ticks // 3), _STARTS, dtype=int)
    sides = [{lo, hi} if i == lead[i] else {lo} for i, (lo, hi) in enumerate(zip(varying.lo, varying.hi, strict=True))]
    ends = [np.array([row])[:, lead] for row in islice(product(*map(sorted, sides)), _MOST_ENDS)]
    for window in [*(ages[start : start + _LONGEST_PERIOD] for start in starts), *ends]:
        products, scale = _running_products([matrix(*row) for row in window.tolist()])
        radius = np.abs(np.linalg.eigvals(products)).max(axis=1)
        periods = np.arange(1, len(window) + 1)
        growth = (np.log(np.maximum(radius, 1e-300)) + scale) / (periods * G.T)
        growth[(window[0] > window + 1).any(axis=1)] = -np.inf  # An age grows by at most one per tick.
        at = int(np.argmax(growth))
        if growth[at] > best:
            best, chosen = float(growth[at]), window[: at + 1]
    period = len(chosen)
    delays = realising(np.tile(chosen, (2 + -(-2 * max(varying.hi) // period), 1)))
    return Period(chosen, delays[:period], best, float(np.exp(best * period * G.T)))


def _running_products(matrices: list[Array]) -> tuple[Array, Array]:
    """Return, for every p, A_p .. A_2 A_1 divided by exp(scale_p), and scale_p."""
    power, scale = np.eye(matrices[0].shape[0]), 0.0
    products, scales = [], []
    for A in matrices:
        power = A @ power
        size = max(float(np.abs(power).max()), 1e-300)
        power, scale = power / size, scale + np.log(size)
        products.append(power)
        scales.append(scale)
    return np.stack(products), np.array(scales)


# ---- many humans in one batch, each under different varying delays

_SHORTEST_CROWD = 2.0  # [s] least duration of a trace; in less time the spreading impulse hides a growth of 1 1/s
_LONGER = 5  # duration of the second trace of slow hands, relative to the first


@dataclass(frozen=True, eq=False)
class Switched:
    """The growth [1/s] of the handles' speeds after an impulse, (nsim,) each."""

    exact: Array  # growth of the linear loop
    mujoco: Array  # growth on the second engine's trace; nan without that engine, or if a force reached its limit


def switched_crowd(
    simulation: Simulation,
    held_by: Variants,
    index: NDArray[np.intp],
    seed: int,
    duration: float,
    other: Callable[[NDArray[np.intp], str, Timing | None], Engine] | None,
) -> Switched:
    """Return the growth after an impulse for every set of humans, each under the delays of its index.

    The delays of a set depend on (seed, index) and the loop only. Varying periods and latencies depend on the seed, and
    are the same for all sets. `other(sets, integrator, timing)` makes the second engine. A set whose rate is too slow
    for the duration runs longer. If the sign of the rate then changes, the longer traces of both engines count.
    """
    scenario, scene = simulation.scenario, held_by.scene

    def judged(ticks: int, sets: NDArray[np.intp], both: bool) -> Switched:
        process, timing, some = simulation.process, scenario.timing(seed, ticks), held_by.taken(sets)
        plants = hold(some.plants(), scenario.T, scenario.usual_latency)
        states, nsim = plants.A.shape[1], len(sets)
        if scenario.switches:
            process = replace(process, delays=_crowd_delays(scenario, process, scene, plants, index[sets], seed, ticks))
        if timing:
            moved: Engine = ExactTimedEngine(some.plants(), timing)
        else:
            moved = ExactEngine(plants)
        exact, _ = impulse_growth(process.unlimited, moved, scene, states, ticks, nsim)
        if not (other and both):
            return Switched(exact, np.full(nsim, np.nan))
        own, clipped = impulse_growth(process, other(sets, "RK4", timing), scene, states, ticks, nsim)
        return Switched(exact, np.where(clipped, np.nan, own))

    ticks = round(max(duration, _SHORTEST_CROWD) / scenario.T)
    growth = judged(ticks, np.arange(len(held_by)), True)
    slow = np.flatnonzero(np.abs(growth.exact) * ticks * scenario.T < SETTLED)
    if slow.size:
        longer = judged(_LONGER * ticks, slow, False).exact
        changed = slow[unstable(longer) != unstable(growth.exact[slow])]
        if changed.size:
            again = judged(_LONGER * ticks, changed, True)
            growth.exact[changed], growth.mujoco[changed] = again.exact, again.mujoco
    return growth


def _crowd_delays(
    scenario: Scenario,
    process: Process,
    scene: Scene,
    plants: HeldPlant,
    index: NDArray[np.intp],
    seed: int,
    ticks: int,
) -> Ticks:
    assert scenario.varying_delay is not None
    recorded: list[Ticks | None] = [None] * len(index)
    if scenario.varying_delay.pattern == "adversarial":
        worst = realising(_greedy_ages(process, plants, scene, scenario.varying_delay, ticks))
        recorded = [worst[:, :, j] for j in range(len(index))]
    numbered = zip(index.tolist(), recorded, strict=True)
    return np.stack([_draw_delays(scenario, seed, i, ticks, own) for i, own in numbered], axis=2)


# ---- certificates for varying delays


@dataclass(frozen=True)
class DelaysCovered:
    """Whether a certificate covers the delays of a scenario, and the damping that switching requires."""

    covered: bool
    covers: str  # which delays are covered, and by which proof, in words
    switching: SwitchingFigures | None = off_table(default=None)
    on_file: DelayRange | None = None  # range that the coupling's file proves, if it contains the scenario's

    @classmethod
    def of(cls, scenario: Scenario, assessment: Assessment, on_file: DelayRange | None = None) -> DelaysCovered:
        """Return which delays the coupling covers; for those in `on_file`, its file proves any switching."""
        constant_delays = (need for name, need in assessment.requirements.items() if name != SWITCHING.name)
        certified = any(need.certified for need in constant_delays)
        varying, span = scenario.varying_delay, scenario.delay_range
        assert varying is not None
        constants = "certificates are for constant delays"
        if not certified:
            constants = "nothing is certified, even for constant delays"
        if not scenario.switches:
            text = "the delay stays constant at theta, and the certificates cover it"
            return cls(certified, text if certified else constants)
        loop = scenario.loop("I").switching(span)  # the case does not matter to stability
        on_file = on_file if on_file and on_file.contains(span) else None
        figures = SwitchingFigures.of(loop, assessment.coupling, assessment.requirements.get(SWITCHING.name))
        lossy, stated = scenario.loses_packets, assessment.guarantee
        if stated and stated.proof == "account":
            return cls(True, "the energy account covers them", figures, on_file)
        if proof := _how_proved(figures, on_file):
            cover = "any switching of the delays within their range"
            words = f"certified for switching delays in this environment ({proof}): {cover} is covered"
            if stated is None:
                words = f"not covered: {assessment.reason}; otherwise {cover} would be covered ({proof})"
            return cls(stated is not None, words, figures, on_file)
        buffered = figures.playout is not None and figures.playout.certified
        verdict = "for which the coupling is certified" if buffered else "which no certificate covers either"
        of = " of received packets" if lossy else ""
        advice = f"a playout buffer (--playout) makes the delay{of} the constant {list(varying.hi)}, {verdict}"
        words = f"{constants}; switching is not covered, as this coupling is not certified for it; {advice}"
        return cls(False, words, figures, on_file)


def _how_proved(figures: SwitchingFigures, on_file: DelayRange | None) -> str:
    """Return the evidence that any switching within the range is safe, in words; "" if there is none."""
    if on_file:
        return f"proved in the coupling's file for {switching_guarantee(on_file)}"
    if not figures.requirement.certified:
        return ""
    return "proved exactly" if figures.requirement.proof == "rational" else "by a refined sweep, without an exact proof"
