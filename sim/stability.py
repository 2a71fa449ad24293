"""Stable or not, for many sets of humans at once: from the exact closed loop, and from MuJoCo's own period map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig

from controller.lti import Array, Lti
from controller.process import Process, State, Tape
from models.scene import Scene, Variants, plant
from sim.engines import Engine, HeldPlant, MujocoBatchEngine, hold, profiler_off, quiet_warnings
from sim.run import Assembly, Record, make_engine, stretch
from sim.scenario import InputError

# ----------------------------------------------------------------------------------------------------
# Does a trace go on oscillating? For loops that are not linear, where "unstable" may be a limit cycle.
#
# The hands rest, or press with a constant force. The second half of a trace is cut in two windows. In each, the
# motion of each motor and handle without its slow part (a cubic fitted to the window) is split into octaves, from
# PERIODS in a window to half the sampling rate. The trace oscillates if in some octave the amplitude in the last
# window
#
#     exceeds a threshold [m], and is at least SUSTAINED of that in the window before:
#
# a decaying oscillation is not one however large it still is, and one below the threshold is not one however long it
# lasts. Octaves are looked at apart, so that a slow mode that decays does not hide a fast one that grows.


PERIODS = 4  # in a window, of the slowest oscillation that is seen: of fewer the window function mixes octaves
SUSTAINED = 0.95
TREND = 3  # degree of the polynomial that is the slow part
RUNAWAY = 1e3  # [m] no handle moves that far: the trace has diverged


@dataclass(frozen=True, eq=False)
class Oscillation:
    """One entry per simulation."""

    sustained: NDArray[np.bool_]  # (nsim,) the verdict
    amplitude: Array  # (nsim,) [m] of the strongest octave that is sustained, else of the strongest one; inf: diverged
    frequency_hz: Array  # (nsim,) [Hz] the strongest line in that octave; nan: diverged


def slowest_seen(duration: float) -> float:
    """[Hz] the lowest frequency that the verdict on a trace of that many seconds hears."""
    return 4 * PERIODS / duration


def oscillation(x: Array, T: float, threshold: float) -> Oscillation:
    """Of positions x (ticks, m, nsim) [m] in the second half of traces, sampled every T seconds."""
    half = x.shape[0] // 2
    diverged = ~(np.abs(x) < RUNAWAY).all(axis=(0, 1))
    calm = np.where(diverged, 0.0, x)
    before, _, _ = octaves(calm[:half], T)
    after, line, _ = octaves(calm[half : 2 * half], T)  # (octaves, m, nsim)
    lasting = (after > threshold) & (after >= SUSTAINED * before)
    shown = np.where(lasting | ~lasting.any(axis=(0, 1)), after, 0.0).reshape(-1, x.shape[2])
    at = np.argmax(shown, axis=0)[None]
    amplitude = np.take_along_axis(shown, at, axis=0)[0]
    frequency = np.take_along_axis(line.reshape(-1, x.shape[2]), at, axis=0)[0]
    return Oscillation(
        np.any(lasting, axis=(0, 1)) | diverged,
        np.where(diverged, np.inf, amplitude),
        np.where(diverged, np.nan, frequency),
    )


def octaves(x: Array, T: float, trend: int = TREND) -> tuple[Array, Array, Array]:
    """Of x (ticks, m, nsim) without a polynomial of degree `trend`: amplitude of each octave (that of a sinusoid of its
    power) and frequency [Hz] of its strongest line, both (octaves, m, nsim), and its part of all lines, (octaves,).
    """
    ticks = x.shape[0]
    window = np.hanning(ticks)
    basis, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, ticks), trend + 1))
    flat = x.reshape(ticks, -1)
    fast = flat - basis @ (basis.T @ flat)
    # a sinusoid of amplitude a has power a^2/2; a window w keeps sum w^2 of ticks
    power = 4 * np.abs(np.fft.rfft(window[:, None] * fast, axis=0)) ** 2 / (ticks * (window**2).sum())
    frequency = np.fft.rfftfreq(ticks, T)
    lowest = PERIODS / (ticks * T) * (1 - 1e-9)
    octave = np.floor(np.log2(np.maximum(frequency, lowest / 2) / lowest)).astype(int)
    amplitudes, lines, parts = [], [], []
    for k in range(octave.max() + 1):
        rows = np.flatnonzero(octave == k)
        if rows.size:
            amplitudes.append(np.sqrt(power[rows].sum(axis=0)))
            lines.append(frequency[rows][np.argmax(power[rows], axis=0)])
            parts.append(rows.size / octave.size)
    shape = (len(amplitudes), *x.shape[1:])
    return np.array(amplitudes).reshape(shape), np.array(lines).reshape(shape), np.array(parts)


# ----------------------------------------------------------------------------------------------------
# Is the loop stable? From the eigenvalues of the exact linear loop, and from a simulated trace.


Complex = NDArray[np.complex128]

#: growth rates up to this [1/s] count as stable: eigenvalues at 1 (a free loop that drifts) come out at 1e-12
MARGINAL = 1e-9
SHORTEST_TRACE = 200  # ticks below which a growth rate is not read from a trace


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """xi+ = A xi + B w with xi = [plant state s; process state z] and w the outside forces.

    Many loops at once have a leading axis in A and B.
    """

    A: Array  # (..., n, n)
    B: Array  # (..., n, outside)
    T: float


@dataclass(frozen=True, eq=False)
class Mode:
    """One eigenvalue of a closed loop, with its left eigenvector."""

    eigenvalue: complex
    left: NDArray[np.complex128]  # (n,), left* A = eigenvalue left*
    T: float

    @property
    def spectral_radius(self) -> float:
        return abs(self.eigenvalue)

    @property
    def growth(self) -> float:
        """[1/s]"""
        return growth_rate(self.eigenvalue, self.T)

    @property
    def frequency_hz(self) -> float:
        return abs(float(np.angle(self.eigenvalue))) / (2 * np.pi * self.T)

    @property
    def verdict(self) -> str:
        return verdict(self.growth)


def close(plant: HeldPlant, F: Lti) -> ClosedLoop:
    """The plant's held input f and the force map F joined: f = C z + D x, z+ = A z + B x, x = C s."""
    *many, states, inputs = plant.B.shape
    outside, n = inputs - F.outputs, states + F.order
    force = plant.B[..., outside:]
    A, B = np.zeros((*many, n, n)), np.zeros((*many, n, outside))
    A[..., :states, :states], A[..., :states, states:] = plant.A + force @ F.D @ plant.C, force @ F.C
    A[..., states:, :states], A[..., states:, states:] = F.B @ plant.C, F.A
    B[..., :states, :] = plant.B[..., :outside]
    return ClosedLoop(A, B, plant.T)


def dominant_mode(loop: ClosedLoop) -> Mode:
    """The mode of the largest modulus: its growth decides."""
    values, left = cast("tuple[Complex, Complex]", eig(loop.A, left=True)[:2])  # how many it returns is an option of it
    k = int(np.argmax(np.abs(values)))
    return Mode(complex(values[k]), left[:, k], loop.T)


def measured_growth(
    loop: ClosedLoop, mode: Mode, record: Record, force_limit: Array
) -> tuple[float | None, str | None]:
    """The growth rate [1/s] of `mode` in a trace, or None with the reason.

    The trace is projected on the left eigenvector, y = left* xi, which no other mode of the exact loop touches.
    With the known outside force subtracted, y[k+1] - left* B w[k] = lambda y[k]; lambda is the least-squares
    fit over the ticks before the first clipped one.
    """
    clipped = clipped_ticks(record, force_limit)
    usable = int(np.argmax(clipped)) if clipped.any() else clipped.size - 1
    if usable < SHORTEST_TRACE:
        which = "ticks before the first clipped one" if clipped.any() else "ticks"
        return None, f"only {max(usable, 0)} {which}; a growth rate needs {SHORTEST_TRACE}"
    xi = np.concatenate([record.s[: usable + 1, :, 0], record.z[: usable + 1, :, 0]], axis=1)
    y = xi @ mode.left.conj()
    pushed = record.w[:usable, :, 0] @ (loop.B.T @ mode.left.conj())
    weight = float(np.vdot(y[:-1], y[:-1]).real)
    if weight == 0:
        return None, "nothing excites the mode"
    return growth_rate(complex(np.vdot(y[:-1], y[1:] - pushed)) / weight, loop.T), None


def clipped_ticks(record: Record, force_limit: Array) -> NDArray[np.bool_]:
    """(N,) whether any force was at its limit at a tick."""
    return np.any(np.abs(record.f) >= force_limit[:, None], axis=(1, 2))


def before_clipping(record: Record, force_limit: Array) -> int:
    """Ticks before the first clipped one; all of them where there is none."""
    clipped = clipped_ticks(record, force_limit)
    return int(np.argmax(clipped)) if clipped.any() else clipped.size


def growth_rate(eigenvalue: complex, T: float) -> float:
    """log|lambda| / T [1/s]."""
    modulus = abs(eigenvalue)
    return float(np.log(modulus) / T) if modulus > 0 else -np.inf


def verdict(growth: float) -> str:
    return "stable" if growth <= MARGINAL else "unstable"


# ----------------------------------------------------------------------------------------------------
# What an engine itself does in one period, as matrices: its own discretisation of the plant.


#: basis states and inputs are this long: the plant is linear, and no actuator limit is so small
UNIT = 1e-6


def measured_hold(
    assembly: Assembly, engine: str = "mujoco", integrator: str = "RK4", substeps: int = 4, T: float | None = None
) -> HeldPlant:
    """The map s[k+1] = A s[k] + B [w; f][k] of an engine, from stepping every basis state and input once.

    Closed with the force map it gives the growth rate that this engine simulates, without a trace. `T` [s] is
    the scenario's period where it is not given.
    """
    period = assembly.scenario.T if T is None else T
    stepped = make_engine(assembly, engine, integrator, substeps, period)
    states, inputs = assembly.plant.B.shape
    tape = Tape(assembly.process, 1, states, inputs - assembly.process.channels)
    columns = []
    with quiet_warnings():
        for unit in UNIT * np.eye(states + inputs):
            tape.plant_row[0][:, 0] = unit
            stepped.start(tape)
            stepped.advance(0)
            columns.append(tape.plant_state[1][:, 0] / UNIT)
    step = np.stack(columns, axis=1)
    return HeldPlant(step[:, :states], step[:, states:], assembly.plant.C, period)


def simulated_growth(assembly: Assembly, integrator: str, substeps: int) -> float:
    """The growth rate [1/s] of the loop that MuJoCo simulates with these settings; of walls, in the worst state."""
    held = measured_hold(assembly, "mujoco", integrator, substeps)
    return max(dominant_mode(close(held, F)).growth for F in assembly.process.frozen().values())


def exact_growth(assembly: Assembly) -> float:
    """The growth rate [1/s] of the exact loop; where there are walls, in the worst frozen contact state."""
    return worst_mode(assembly).growth


def worst_mode(assembly: Assembly) -> Mode:
    """The dominant mode of the exact loop; where there are walls, of the worst frozen contact state."""
    return max(frozen_modes(assembly).values(), key=lambda mode: mode.spectral_radius)


def frozen_modes(assembly: Assembly) -> dict[State, Mode]:
    """The dominant mode of the exact loop for every set of walls that touch."""
    return {walls: dominant_mode(close(assembly.plant, F)) for walls, F in assembly.process.frozen().items()}


# ----------------------------------------------------------------------------------------------------
# What short traces say of many humans at once: growth, clipping, the energy audit, and whether handles come to rest.
#
# From rest at x = 0, without voluntary motion, every handle is knocked once and then left alone. The measures are
# summed up while the simulation runs, so that no trace is kept.


KNOCK = 10e-3  # [s]
STRETCH = 32  # ticks between two looks at a tape: few, so that it stays in the processor's cache
HEARD = 1e-8  # a mode weaker than this beside the whole state is noise of the engine


@dataclass(frozen=True, eq=False)
class Trace:
    """One entry per simulation."""

    growth: Array  # (nsim,) [1/s] of the exact loop's dominant mode, up to the first clipped tick; nan where unheard
    clipped: NDArray[np.int64]  # (nsim,) ticks with a force at its limit
    least_energy: Array  # (nsim,) [J] least W(N) up to the first clipped tick
    audited: Array  # (nsim,) [J] sum of the magnitudes of what W adds up: the scale of its rounding
    settling: Array  # (nsim,) rms of the handles' speeds in the last quarter over that in the second
    simulated: float  # [s] of all simulations together


def knock(
    process: Process,
    engine: Engine,
    scene: Scene,
    loops: ClosedLoop,
    delta: Array,
    ticks: int,
    tick_done: Callable[[int], None] = lambda ticks: None,
) -> Trace:
    """Simulate `ticks` periods with every set of humans and measure them. `loops` are the exact ones."""
    nsim, states = loops.A.shape[0], loops.A.shape[1] - process.F.order
    tape = Tape(process, min(STRETCH, ticks), states, scene.outside, nsim)
    audit = _Audit(process, scene, loops, delta, ticks)
    with profiler_off(), quiet_warnings(), np.errstate(over="ignore", invalid="ignore"):
        engine.start(tape)
        done = 0
        while done < ticks:
            count = min(tape.ticks, ticks - done)
            tape.w[:count] = knock_forces(scene, loops.T, done, count)[:, :, None]
            stretch(tape, engine, count)
            audit.see(tape, done, count)
            tape.rewind(count)
            done += count
            tick_done(count)
    return audit.trace(ticks * loops.T * nsim)


def knock_forces(scene: Scene, T: float, first: int, ticks: int) -> Array:
    """Forces [N] of the knock, (ticks, outside): 1 N on handle 1, -1/2 N on handle 2, 1/3 N on handle 3, ..."""
    w = np.zeros((ticks, scene.outside))
    until = max(1, round(KNOCK / T)) - first
    for i, column in enumerate(scene.tapped):
        w[: max(until, 0), column] = (-1) ** i / (i + 1)
    return w


class _Audit:
    """Sums over the ticks seen so far."""

    def __init__(self, process: Process, scene: Scene, loops: ClosedLoop, delta: Array, ticks: int) -> None:
        nsim = loops.A.shape[0]
        self._limit = process.force_limit[:, None]
        self._B, self._T, self._damping = loops.B, loops.T, delta[:, None] / loops.T
        self._left = _left_eigenvectors(loops)  # (nsim, n)
        self._speeds = [scene.model.nv + handle for handle in scene.handles]
        self._second, self._last = (ticks // 4, ticks // 2), (ticks - ticks // 4, ticks)
        self._linear = np.ones(nsim, dtype=bool)
        self._usable, self._clipped = np.zeros(nsim, dtype=int), np.zeros(nsim, dtype=int)
        self._energy, self._least, self._size = np.zeros(nsim), np.zeros(nsim), np.zeros(nsim)
        self._across, self._weight, self._whole = np.zeros(nsim, dtype=complex), np.zeros(nsim), np.zeros(nsim)
        self._early, self._late = np.zeros(nsim), np.zeros(nsim)

    def see(self, tape: Tape, first: int, ticks: int) -> None:
        """Take in the first `ticks` rows of the tape; row 0 is tick `first`."""
        z, s, w, f = (part[: ticks + 1] for part in (tape.z, tape.s, tape.w, tape.f))
        clipped = (np.abs(f[:ticks]) >= self._limit).any(axis=1)  # (ticks, nsim)
        linear = self._linear & ~np.logical_or.accumulate(clipped, axis=0)
        self._clipped += clipped.sum(axis=0)
        self._usable += linear.sum(axis=0)
        self._linear = linear[-1]

        moved = np.diff(tape.x[: ticks + 1], axis=0)
        work = np.where(linear[:, None], f[:ticks] * moved, 0.0).sum(axis=1)
        spent = np.where(linear[:, None], self._damping * moved**2, 0.0).sum(axis=1)
        energy = self._energy + np.cumsum(work + spent, axis=0)
        self._least = np.minimum(self._least, energy.min(axis=0))
        self._energy = energy[-1]
        self._size += (np.abs(work) + spent).sum(axis=0)

        xi = np.concatenate([s, z], axis=1)
        y = np.einsum("ns,ksn->kn", self._left.conj(), xi)
        pushed = np.einsum("ns,nsw,kwn->kn", self._left.conj(), self._B, w[:ticks], optimize=True)
        y, after = np.where(linear, y[:-1], 0), y[1:] - pushed
        self._across += (y.conj() * after).sum(axis=0)
        self._weight += (np.abs(y) ** 2).sum(axis=0)
        self._whole += np.where(linear[:, None], xi[:-1] ** 2, 0.0).sum(axis=(0, 1))

        speed = (s[:ticks, self._speeds] ** 2).sum(axis=1)
        k = np.arange(first, first + ticks)
        self._early += speed[(k >= self._second[0]) & (k < self._second[1])].sum(axis=0)
        self._late += speed[(k >= self._last[0]) & (k < self._last[1])].sum(axis=0)

    def trace(self, simulated: float) -> Trace:
        heard = (self._usable >= SHORTEST_TRACE) & (self._weight > HEARD**2 * self._whole)
        with np.errstate(divide="ignore", invalid="ignore"):
            growth = np.log(np.abs(self._across / self._weight)) / self._T
            settling = np.sqrt(self._late / self._early)
        growth = np.where(heard, growth, np.nan)
        return Trace(growth, self._clipped, self._least, self._size, settling, simulated)


def _left_eigenvectors(loops: ClosedLoop) -> NDArray[np.complex128]:
    """Of the dominant mode of each loop, (nsim, n), of unit length: left* A = lambda left*."""
    values, vectors = np.linalg.eig(np.swapaxes(loops.A, 1, 2))
    largest = np.argmax(np.abs(values), axis=1)
    return vectors[np.arange(values.shape[0]), :, largest].conj()


# ----------------------------------------------------------------------------------------------------
# How many substeps a plant asks of an integrator, and which numbers of them are refused.
#
# Two speeds decide, both from the eigenvalues of the continuous plant: the fastest weakly damped mode, which must be
# resolved (mode h <= 0.2), and the strongest damping, which must be followed (rate h < 1). What the rule picks is
# then checked: the loop that the engine simulates must have the exact loop's verdict, else the number is doubled.


RESOLVED, FOLLOWED = 0.2, 1.0  # what a step may advance the fastest mode [rad] and the strongest damping
LEAST, MOST = 4, 10_000  # substeps
DECIDED = 1e-3  # [1/s] exact growth rates nearer to zero than this are no verdict to get wrong
NEUTRAL = 1e-6  # a passive plant's free motion has eigenvalues at 1, which rounding splits by about 1e-8

_MODE_LOST = "it damps fast modes away"


@dataclass(frozen=True)
class Pace:
    """How fast a plant moves."""

    mode: float  # [rad/s] its fastest weakly damped mode, 0 where there is none
    rate: float  # [1/s] its strongest damping

    def within(self, h: float) -> bool:
        """Whether a step of h seconds follows it."""
        return self.mode * h <= RESOLVED and self.rate * h < FOLLOWED

    def substeps(self, T: float) -> int:
        """The least number of steps in T seconds that follows it, LEAST at least."""
        return max(LEAST, math.ceil(self.mode * T / RESOLVED), math.floor(self.rate * T / FOLLOWED) + 1)

    def hardest(self, h: float) -> str:
        """What a step of h seconds has most trouble with, in words."""
        if self.mode / RESOLVED >= self.rate / FOLLOWED:
            return f"the mode at {self.mode / (2 * math.pi):.4g} Hz advances {self.mode * h:.3g} rad in a step"
        return f"the damping of {self.rate:.4g} 1/s times the step is {self.rate * h:.3g}"


def pace(A: Array) -> Pace:
    """The pace of x' = A x, or the fastest of many. Weakly damped is what turns faster than it decays."""
    values = np.linalg.eigvals(A)
    weak = np.abs(values.imag) > np.abs(values.real)
    return Pace(float(np.abs(values[weak]).max(initial=0.0)), float(-values.real.min(initial=0.0)))


def default_substeps(assembly: Assembly, integrator: str = "RK4") -> int:
    """At least 4, more where the rule or the verdict asks. Raises InputError where no number up to 10000 does."""
    if integrator == "discrete":  # it remembers more than position and velocity, so no map of those can vouch for it
        raise InputError(f"--integrator discrete gives no verdict to rely on: {_MODE_LOST}; use RK4 or give --substeps")
    assembly = assembly.smooth
    speed, T = pace(plant(assembly.scene.model).A), assembly.scenario.T
    count = needed = speed.substeps(T)
    while count <= MOST and not _agrees(assembly, integrator, count):
        count *= 2
    if needed > MOST:
        raise InputError(f"{speed.hardest(T / MOST)} even with {MOST} substeps: use --engine exact")
    if count > MOST:
        raise InputError(f"--integrator {integrator} gives a wrong verdict up to {MOST} substeps: use --integrator RK4")
    return count


def check_substeps(assembly: Assembly, integrator: str, substeps: int) -> list[str]:
    """Remarks on a number of substeps that was asked for. Raises InputError outside the stable region."""
    assembly = assembly.smooth
    speed, h = pace(plant(assembly.scene.model).A), assembly.scenario.T / substeps
    radius = step_radius(assembly, integrator, substeps)
    what = f"{integrator} x {substeps}: {speed.hardest(h)}"
    if not radius <= 1 + NEUTRAL:
        instead = _instead(assembly, integrator)
        raise InputError(f"--substeps {substeps}: {what}, outside the stable region of {integrator}; {instead}")
    remarks = [] if speed.within(h) else [f"{what}: stable but coarse; {_instead(assembly, integrator)}."]
    if integrator == "discrete":
        remarks.append(f"discrete gives no verdict to rely on: {_MODE_LOST}.")
    elif not _agrees(assembly, integrator, substeps):
        simulated, exact = simulated_growth(assembly, integrator, substeps), exact_growth(assembly)
        growth = f"{simulated:+.3g} 1/s, the exact loop {exact:+.3g} 1/s"
        remarks.append(f"{integrator} x {substeps} gives a WRONG VERDICT: its loop grows by {growth}.")
    return remarks


def step_radius(assembly: Assembly, integrator: str, substeps: int) -> float:
    """Spectral radius of one substep on the plant alone, which is passive: above 1 the integrator is unstable."""
    step = measured_hold(assembly, "mujoco", integrator, 1, assembly.scenario.T / substeps)
    return float(np.abs(np.linalg.eigvals(step.A)).max()) if np.isfinite(step.A).all() else np.inf


def _agrees(assembly: Assembly, integrator: str, substeps: int) -> bool:
    if step_radius(assembly, integrator, substeps) > 1 + NEUTRAL:
        return False
    exact = exact_growth(assembly)
    return abs(exact) <= DECIDED or (simulated_growth(assembly, integrator, substeps) > 0) == (exact > 0)


def _instead(assembly: Assembly, integrator: str) -> str:
    try:
        return f"use --substeps {default_substeps(assembly, integrator)} or leave it out"
    except InputError:
        return "use --engine exact"


DECIDED_VERDICTS = 1e-3  # growth rates below this [1/s] are too close to zero for engines to disagree about


@dataclass(frozen=True, eq=False)
class Modes:
    """The dominant eigenvalue of each loop."""

    eigenvalue: NDArray[np.complex128]  # (nsim,)
    T: float  # [s]

    @property
    def spectral_radius(self) -> Array:
        return np.abs(self.eigenvalue)

    @property
    def growth(self) -> Array:
        """log|lambda| / T [1/s]"""
        with np.errstate(divide="ignore"):
            return np.log(self.spectral_radius) / self.T

    @property
    def frequency_hz(self) -> Array:
        return np.abs(np.angle(self.eigenvalue)) / (2 * np.pi * self.T)


def dominant_modes(loops: ClosedLoop) -> Modes:
    """The eigenvalue of the largest modulus of every loop; stability.dominant_mode for a stack."""
    values = np.linalg.eigvals(loops.A)
    largest = np.argmax(np.abs(values), axis=1)
    return Modes(values[np.arange(values.shape[0]), largest].astype(complex), loops.T)


def exact_loops(variants: Variants, F: Lti) -> ClosedLoop:
    """The exact closed loop with every set of humans, stacked."""
    return close(hold(variants.plants(), F.T), F)


def mujoco_loops(
    variants: Variants, process: Process, integrator: str = "RK4", substeps: int = 4, nthread: int = 0
) -> ClosedLoop:
    """The closed loops that MuJoCo itself simulates: its map over one period, joined with the process block.

    The plant is linear, so its map is known from one period from each basis state and with each force alone:
    2n + m simulations for every set of humans, stepped in one batch.
    """
    model = variants.scene.model
    n, m, nsim = 2 * model.nv, process.channels, len(variants)
    # within the actuators' limits, so that these do not clip
    unit = np.concatenate([np.ones(n), np.minimum(1.0, process.force_limit / 2)])
    tape = Tape(process, 1, n, variants.scene.outside, nsim * (n + m))
    basis = np.tile(np.diag(unit), (1, nsim))
    tape.s[0], tape.f[0] = basis[:n], basis[n:]
    with profiler_off(), quiet_warnings():
        fields = variants.repeated(n + m)
        engine = MujocoBatchEngine(variants.scene, process.F.T, integrator, substeps, nsim * (n + m), nthread, fields)
        engine.start(tape)
        engine.advance(0)
    columns = tape.s[1].reshape(n, nsim, n + m).transpose(1, 0, 2) / unit
    held = HeldPlant(columns[:, :, :n], columns[:, :, n:], np.eye(m, n), process.F.T)
    return close(held, process.F)


def unstable(growth: Array) -> NDArray[np.bool_]:
    """Whether each growth rate [1/s] counts as unstable: stability.verdict for an array."""
    return ~(growth <= MARGINAL)


def disagree(exact: Array, other: Array) -> NDArray[np.bool_]:
    """Where two growth rates [1/s] have opposite signs though the exact one is clearly not zero."""
    return (unstable(exact) != unstable(other)) & (np.abs(exact) > DECIDED_VERDICTS) & np.isfinite(other)
