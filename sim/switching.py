"""What is certified of a coupling where delays vary: by its file, or judged anew, and what that covers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from controller.coupling import Coupling
from controller.delay import LOST, Jitter, Ticks, realising
from controller.loop import DelayRange, force_map
from controller.lti import Array, Lti
from controller.process import Process, Tape
from design.certificate import switching_part, switching_promise, switching_requirement
from design.conditions import Requirement
from models.scene import Scene, Variants
from sim.couplings import Chosen
from sim.engines import Engine, ExactBatchEngine, HeldPlant, MujocoBatchEngine, hold, profiler_off, quiet_warnings
from sim.run import Assembly, stretch
from sim.scenario import Scenario
from sim.stability import knock_forces

# ----------------------------------------------------------------------------------------------------
# The loop with delays that vary: a linear system that switches, one matrix per set of ages of the forces in use.
#
# State xi = [s; z; g_1[k-1] .. g_1[k-d_1]; g_2[k-1] ..]: plant, process block G (without Theta), forces on their way.


STRETCH = 32  # ticks of a tape: few, so that it stays in the processor's cache


def without_theta(assembly: Assembly, coupling: Coupling) -> Lti:
    """G = (I + Psi E V)^-1 Psi E: the forces as they leave for the devices."""
    return force_map(assembly.E, coupling, (0,) * assembly.process.channels, assembly.scenario.psi)


def with_delays(assembly: Assembly, coupling: Coupling, delays: Ticks) -> Assembly:
    """The same loop with packets that take `delays` (ticks, m, nsim or 1) in place of the constant theta.

    `assembly.F` stays that of the constant theta: certificates and transparency are about it.
    """
    return replace(assembly, process=replace(assembly.process, F=without_theta(assembly, coupling), delays=delays))


def mode_matrix(plant: HeldPlant, G: Lti, depth: Sequence[int], ages: Sequence[int]) -> Array:
    """A of xi[k+1] = A xi[k] while the forces in use have these ages [samples], age_i <= depth_i."""
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


@dataclass(frozen=True, eq=False)
class Growth:
    """What a knock becomes under given delays; one entry per simulation."""

    # (nsim,) [1/s] of the handles' speeds, last quarter over second; inf where numbers overflow, -inf at exact rest
    rate: Array
    clipped: NDArray[np.bool_]  # (nsim,) whether any force reached its limit


def knocked(process: Process, engine: Engine, scene: Scene, states: int, ticks: int, nsim: int) -> Growth:
    """Knock every handle, leave them alone, and compare their speeds early and late.

    With force limits of infinity this is the linear loop, whose growth does not depend on the size of the knock.
    """
    T, speeds = process.F.T, [scene.model.nv + handle for handle in scene.handles]
    limit = process.force_limit[:, None]
    tape = Tape(process, min(STRETCH, ticks), states, scene.outside, nsim)
    quarter, early, late, clipped = ticks // 4, np.zeros(nsim), np.zeros(nsim), np.zeros(nsim, dtype=bool)
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        engine.start(tape)
        for first in range(0, ticks, tape.ticks):
            count = min(tape.ticks, ticks - first)
            tape.w[:count] = knock_forces(scene, T, first, count)[:, :, None]
            stretch(tape, engine, count)
            clipped |= (np.abs(tape.f[:count]) >= limit).any(axis=(0, 1))
            square, k = (tape.s[:count, speeds] ** 2).sum(axis=1), np.arange(first, first + count)
            early += square[(k >= quarter) & (k < 2 * quarter)].sum(axis=0)
            late += square[k >= ticks - quarter].sum(axis=0)
            tape.rewind(count)
        rate = np.log(late / early) / 2 / ((ticks - 2 * quarter) * T)
    rate = np.where(late == 0, -np.inf, np.where(np.isnan(rate), np.inf, rate))
    return Growth(rate, clipped)


def unlimited(process: Process) -> Process:
    """The linear process: no force limits, no encoder steps."""
    return replace(process, force_limit=np.full(process.channels, np.inf), encoder_step=np.zeros(process.channels))


# ----------------------------------------------------------------------------------------------------
# The worst delays for a loop: greedy switching, and the periodic switching in it that grows fastest, exactly.
#
# Greedy: the loop starts from a knock on every handle. At every tick and on every channel the device is handed, of
# the forces that a delay in [lo, hi] allows, the one that brakes it least or pushes it most: the largest -f v. Ages
# grow by one per tick at most, as they do where packets are held. Periodic: of all windows of that sequence that may
# be repeated, the one whose product of mode matrices has the largest spectral radius per tick: a proof of instability
# where it exceeds 1.


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


# ----------------------------------------------------------------------------------------------------
# The delays of a run: drawn from a scenario's jitter and a seed, or found worst for its loop.


SEARCHED = 1600  # ticks of greedy switching in which the worst period is sought
SHORTEST = 4  # ticks that are drawn at least: a growth compares quarters
STREAM = 5  # keeps these draws apart from those of the humans with the same seed and index


def draw_delays(scenario: Scenario, seed: int, index: int, ticks: int, given: Ticks | None = None) -> Ticks:
    """Delays (ticks, m) of run number `index`; they depend on (seed, index) and the scenario only."""
    assert scenario.jitter is not None
    rows = np.array([scenario.theta]) if scenario.jitter.pattern == "constant" else given
    rng = np.random.default_rng(np.random.SeedSequence((seed, index, STREAM)))
    return scenario.jitter.draw(rng, ticks, rows)


def switching(
    assembly: Assembly, coupling: Coupling, seed: int, ticks: int, index: int = 0
) -> tuple[Assembly, Period | None]:
    """The loop with the scenario's varying delays, and their period where they are adversarial."""
    jitter = assembly.scenario.jitter
    assert jitter is not None
    period = adversary(assembly, coupling, jitter) if jitter.pattern == "adversarial" else None
    delays = draw_delays(assembly.scenario, seed, index, max(ticks, SHORTEST), period.delays if period else None)
    return with_delays(assembly, coupling, delays[:, :, None]), period


def adversary(assembly: Assembly, coupling: Coupling, jitter: Jitter) -> Period:
    """The periodic switching within the range that was found to grow fastest in this loop."""
    G = without_theta(assembly, coupling)
    process, plant = replace(assembly.process, F=G), assembly.plant
    one = HeldPlant(plant.A[None], plant.B[None], plant.C, plant.T)
    ages = greedy_ages(process, one, assembly.scene, jitter, SEARCHED)
    return worst_period(ages[:, :, 0], plant, G, jitter)


# ----------------------------------------------------------------------------------------------------
# Many humans under delays that vary: each meets delays of its own, drawn or found worst, in one batch.


SHORTEST_CROWD = 2.0  # [s] of every trace: a growth of 1 1/s stands out from how a knock spreads
DOUBTFUL = 1.0  # [1/s]: a slower growth may be two modes that beat, and is judged again ..
LONGER = 5  # .. on traces so many times as long


@dataclass(frozen=True, eq=False)
class Switched:
    """Growth [1/s] of the handles' speeds after a knock, (nsim,) each."""

    exact: Array  # of the linear loop
    mujoco: Array  # of MuJoCo's; nan where it was not asked for, or a force reached its limit


def switched_crowd(
    assembly: Assembly,
    coupling: Coupling,
    held_by: Variants,
    index: NDArray[np.intp],
    seed: int,
    duration: float,
    mujoco: bool,
    threads: int = 0,
) -> Switched:
    """Knock every set of humans under the delays of its index, which depend on (seed, index) and the loop only."""
    ticks = round(max(duration, SHORTEST_CROWD) / assembly.scenario.T)
    found = _knocked(assembly, coupling, held_by, index, seed, ticks, mujoco, threads)
    doubtful = (found.exact > 0) & (found.exact < DOUBTFUL)
    if not doubtful.any():
        return found
    longer = _knocked(assembly, coupling, held_by, index, seed, LONGER * ticks, mujoco, threads)
    return Switched(np.where(doubtful, longer.exact, found.exact), np.where(doubtful, longer.mujoco, found.mujoco))


def _knocked(
    assembly: Assembly,
    coupling: Coupling,
    held_by: Variants,
    index: NDArray[np.intp],
    seed: int,
    ticks: int,
    mujoco: bool,
    threads: int,
) -> Switched:
    T, nsim, scene = assembly.scenario.T, len(held_by), held_by.scene
    plants = hold(held_by.plants(), T)
    process = replace(assembly.process, F=without_theta(assembly, coupling))
    process = replace(process, delays=_delays(assembly, process, held_by, plants, index, seed, ticks))
    linear, states = unlimited(process), plants.A.shape[1]
    exact = knocked(linear, ExactBatchEngine(plants, linear.force_limit), scene, states, ticks, nsim).rate
    if not mujoco:
        return Switched(exact, np.full(nsim, np.nan))
    engine = MujocoBatchEngine(scene, T, nsim=nsim, nthread=threads, fields=held_by.fields)
    seen = knocked(process, engine, scene, states, ticks, nsim)
    return Switched(exact, np.where(seen.clipped, np.nan, seen.rate))


def _delays(
    assembly: Assembly,
    process: Process,
    held_by: Variants,
    plants: HeldPlant,
    index: NDArray[np.intp],
    seed: int,
    ticks: int,
) -> Ticks:
    jitter = assembly.scenario.jitter
    assert jitter is not None
    given = [None] * len(index)
    if jitter.pattern == "adversarial":
        worst = realising(greedy_ages(process, plants, held_by.scene, jitter, ticks))
        given = [worst[:, :, j] for j in range(len(index))]
    rows = [
        draw_delays(assembly.scenario, seed, int(i), ticks, own) for i, own in zip(index.tolist(), given, strict=True)
    ]
    return np.stack(rows, axis=2)


def certified_part(scenario: Scenario, chosen: Chosen, certified: bool) -> dict[str, Any]:
    """The jitter-proof requirement, and what the certificates cover; `certified` is about the constant theta."""
    assert scenario.jitter is not None
    if not scenario.switches:
        return {"jitter_proof": None, "on_file": None} | coverage(scenario.jitter, certified, None)
    span = scenario.delay_range
    loop = scenario.loop("I").switching(span)  # the case does not matter to stability
    found = switching_requirement(loop, chosen.coupling)
    on_file = chosen.switching if chosen.switching and chosen.switching.contains(span) else None
    figures = switching_part(found, loop.sent(chosen.coupling), span)
    proof = _how_proved(found.requirement, on_file)
    parts = {"jitter_proof": figures, "on_file": on_file and msgspec.to_builtins(on_file)}
    return parts | coverage(scenario.jitter, certified, proof, figures["playout"]["certified"])


def _how_proved(requirement: Requirement, on_file: DelayRange | None) -> str:
    """What shows that any switching within the range is safe, "" where nothing does."""
    if on_file:
        return f"proved in the coupling's file for {switching_promise(on_file)}"
    if not requirement.certified:
        return ""
    return "proved exactly" if requirement.proof == "rational" else "by a refined sweep, without an exact proof"


def coverage(jitter: Jitter, certified: bool, proof: str | None, buffered: bool = False) -> dict[str, Any]:
    """Whether what is certified covers these delays: {"covered", "covers"}.

    `certified` is about the constant theta, `proof` says what shows that every switching within the range is safe
    ("" if nothing does, None where the delay is constant), `buffered` is about the constant delay hi.
    """
    constants = (
        "certificates are about constant delays" if certified else "nothing is certified, even for constant delays"
    )
    if proof is None:
        text = "the delay is constant after all (theta): the certificates cover it" if certified else constants
        return {"covered": certified, "covers": text}
    lossy = jitter.loss > 0 or any(LOST in row for row in jitter.recorded)
    if proof:
        what = "any switching of the delays within their range is covered"
        within = f"jitter-proof in this environment ({proof}): {what}"
        losses = ", but a lost packet makes a force older than hi, which is not"
        return {"covered": not lossy, "covers": within + (losses if lossy else "")}
    verdict = "for which it is certified" if buffered else "for which it is not certified either"
    constant = f"the constant {list(jitter.hi)}" + (" but for lost packets" if lossy else "")
    advice = f"a playout buffer (--playout) makes the delay {constant}, {verdict}"
    return {
        "covered": False,
        "covers": f"{constants}; this coupling is not jitter-proof, so switching is not covered; {advice}",
    }
