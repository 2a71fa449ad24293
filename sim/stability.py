"""Stability by eigenvalues of the exact linear loop, by MuJoCo's map over a period, and by simulated traces.

A closed loop or a mode may be a stack with an entry for each set of humans. Arrays of a stack have a leading axis. A
frozen loop is the linear loop in which a certain set of walls is touched, so that contact is neither made nor broken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haptic_loop.controller.delay import Timing
from haptic_loop.controller.law import State
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import Process, StepBuffer, at_limit
from haptic_loop.design.files import off_table
from haptic_loop.models.hold import HeldPlant, at_the_latch, hold
from haptic_loop.models.scene import Scene, Variants, quiet_warnings
from haptic_loop.sim.engines import Engine, MujocoBatchEngine, least_substeps, profiler_off
from haptic_loop.sim.run import Simulation, beginnings, make_engine, run_blocks
from haptic_loop.sim.trace import Trace

#: Growth rates up to this [1/s] count as stable. Rounding moves an eigenvalue at 1 (a drifting loop) by 1e-12.
MARGINAL = 1e-9
_CLEAR = 1e-3  # [1/s] errors of engines may change the sign of a smaller growth rate
_JUDGED = 4.0, 20.0, 100.0  # [s] durations that are tried until the sign of a growth rate is certain (linear_growth)
_SHIFT, _INVERSE_STEPS = 1e-11, 4  # distance from the eigenvalue and number of steps of inverse iteration
_NO_MODE = 1e-300  # modulus that stands for "no mode is fast enough"
_SHORTEST_TRACE = 200  # ticks that a growth rate needs
SETTLED = 10.0  # duration, in time constants of the rate, from which the sign of a rate is certain (linear_growth)
_DECAY_TIMES = 4.0  # least duration of a trace, in time constants, for the sign of its rate to count


def unstable(growth: ArrayLike) -> NDArray[np.bool_]:
    """Return whether each growth rate [1/s] counts as unstable; nan counts as unstable."""
    return ~(np.asarray(growth) <= MARGINAL)


def verdict(growth: float) -> str:
    """Return "stable" or "unstable" for a growth rate [1/s]."""
    return "unstable" if unstable(growth) else "stable"


def disagree(exact: ArrayLike, other: ArrayLike) -> NDArray[np.bool_]:
    """Return where `other` is finite and contradicts the sign of a growth rate `exact` [1/s] that is clearly not 0."""
    return (unstable(exact) != unstable(other)) & (np.abs(exact) > _CLEAR) & np.isfinite(other)


# ---- the closed loop as a matrix


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """xi+ = A xi + B w with xi = [plant state s; process state z] and external forces w."""

    A: Array  # (..., n, n)
    B: Array  # (..., n, outside)
    T: float  # [s]

    @cached_property
    def eigenvalues(self) -> NDArray[np.complex128]:  # (..., n)
        return np.linalg.eigvals(self.A).astype(complex)

    def growths(self, *min_frequency_hz: float) -> list[Array]:
        """Return a growth [1/s] for each frequency [Hz]: that of the dominant mode at or above this frequency."""
        values = self.eigenvalues
        size, hz = np.abs(values), np.abs(np.angle(values)) / (2 * np.pi * self.T)
        return [np.log(np.where(hz >= least, size, _NO_MODE).max(axis=-1)) / self.T for least in min_frequency_hz]


@dataclass(frozen=True, eq=False)
class Mode:
    """The eigenvalue of largest modulus of a closed loop, or of each loop of a stack."""

    eigenvalue: NDArray[np.complex128]  # (...,)
    T: float  # [s]

    @classmethod
    def worst(cls, modes: Sequence[Mode]) -> Mode:
        """Return, for each loop of a stack, the mode of largest modulus among `modes`."""
        values = np.stack([mode.eigenvalue for mode in modes])
        largest = np.argmax(np.abs(values), axis=0)[None]
        return cls(np.take_along_axis(values, largest, axis=0)[0], modes[0].T)

    @property
    def spectral_radius(self) -> Array:
        return np.abs(self.eigenvalue)

    @property
    def growth(self) -> Array:
        """The growth rate log|lambda| / T [1/s]."""
        with np.errstate(divide="ignore"):
            return np.log(self.spectral_radius) / self.T

    @property
    def frequency_hz(self) -> Array:
        return np.abs(np.angle(self.eigenvalue)) / (2 * np.pi * self.T)

    @property
    def verdict(self) -> str:
        """The verdict on a single loop (not on a stack)."""
        return verdict(float(self.growth))


def close(plant: HeldPlant, F: Lti) -> ClosedLoop:
    """Return the loop of the held plant with positions x = C s and the force map F: z+ = A z + B x, f = C z + D x."""
    *many, states, inputs = plant.B.shape
    outside, n = inputs - F.outputs, states + F.order
    force = plant.B[..., outside:]
    A, B = np.zeros((*many, n, n)), np.zeros((*many, n, outside))
    A[..., :states, :states], A[..., :states, states:] = plant.A + force @ F.D @ plant.C, force @ F.C
    A[..., states:, :states], A[..., states:, states:] = F.B @ plant.C, F.A
    B[..., :states, :] = plant.B[..., :outside]
    return ClosedLoop(A, B, plant.T)


def dominant_mode(loop: ClosedLoop) -> Mode:
    """Return the mode of largest modulus."""
    largest = np.argmax(np.abs(loop.eigenvalues), axis=-1)[..., None]
    return Mode(np.take_along_axis(loop.eigenvalues, largest, axis=-1)[..., 0], loop.T)


def _left_eigenvector(loop: ClosedLoop) -> NDArray[np.complex128]:
    """Return the dominant mode's unit left eigenvector (..., n). The product left* xi contains that mode alone.

    A step of inverse iteration multiplies the share of each other mode by _SHIFT over the distance of both eigenvalues.
    """
    n, mode = loop.A.shape[-1], dominant_mode(loop)
    shift = (mode.eigenvalue + _SHIFT)[..., None, None] * np.eye(n)
    inverse = np.linalg.inv(np.swapaxes(loop.A, -1, -2) - shift)
    left = np.sin(1.0 + np.arange(n))[:, None].astype(complex)  # irregular, so orthogonal to no eigenvector
    for _ in range(_INVERSE_STEPS):
        left = inverse @ left
        left = left / np.linalg.norm(left, axis=-2, keepdims=True)
    return left[..., 0].conj()


def exact_loops(variants: Variants, F: Lti, T: float | None = None, late: Sequence[float] | None = None) -> ClosedLoop:
    """Return the exact closed loop of each set of humans; forces latch `late` (m,) [s] after ticks (None: at ticks)."""
    return close(hold(variants.plants(), F.T if T is None else T, late), F)


def mujoco_plants(
    variants: Variants,
    process: Process,
    integrator: str = "RK4",
    substeps: int | None = None,
    nthread: int = 0,
    late: Sequence[float] | None = None,
) -> HeldPlant:
    """Return MuJoCo's map of the plants over one period.

    The plants are linear, so steps from each basis state and with each force alone give the map. If forces latch `late`
    (m,) [s] after ticks, the state ends with the forces that are held. Without `late` the map of one substep is
    measured, and its power is returned.
    """
    m, nsim, T = process.channels, len(variants), process.F.T
    substeps = least_substeps(integrator) if substeps is None else substeps
    n = variants.states + (m if late else 0)
    timing = Timing(np.array([T]), np.array([late])) if late else None
    once, powers = (substeps, 1) if late else (1, substeps)
    # Forces must stay within the actuators' limits.
    unit = np.concatenate([np.ones(n), np.minimum(1.0, process.force_limit / 2)])
    unit[n - m : n] = unit[n:] if late else 1.0
    buffer = StepBuffer(process, 1, n, variants.scene.outside, nsim)
    step = np.zeros((nsim, n + m, n + m))
    step[:, n:, n:] = np.eye(m)
    with profiler_off(), quiet_warnings():
        engine = MujocoBatchEngine(variants, T / powers, integrator, once, nthread, timing)
        for j, size in enumerate(unit):
            buffer.s[0], buffer.f[0] = 0.0, 0.0
            (buffer.s[0, j] if j < n else buffer.f[0, j - n])[:] = size
            engine.start(buffer)
            engine.advance(0)
            step[:, :n, j] = buffer.s[1].T / size
    period = np.linalg.matrix_power(step, powers)
    return HeldPlant(period[:, :n, :n], period[:, :n, n:], np.eye(m, n), T)


# ---- one simulation: verdicts of its eigenvalues and of its trace


def _frozen_modes(simulation: Simulation) -> dict[State, Mode]:
    """Return the dominant mode for every set of touching walls."""
    return {walls: dominant_mode(close(simulation.plant, F)) for walls, F in simulation.process.law.frozen().items()}


def worst_mode(simulation: Simulation) -> Mode:
    """Return the dominant mode of the exact loop; with walls, that of the worst frozen loop."""
    return max(_frozen_modes(simulation).values(), key=lambda mode: float(mode.spectral_radius))


@dataclass(frozen=True)
class Ringing:
    """How the exact loop with the scenario's hands decays after an impulse, at constant delays and without friction.

    A mode is s = ln(eigenvalue) / T with the damping ratio -Re s / |s|, which is 1 for a decay without oscillation.
    Free drifts (|s| up to 0.001 1/s) do not count.

    Attributes:
        decay_per_s: Decay rate of the slowest mode [1/s]; negative if it grows.
        frequency_hz: Frequency of the slowest mode [Hz].
        damping_ratio: Damping ratio of the slowest mode.
        least_damping_ratio: Least damping ratio of all modes.
        least_frequency_hz: Frequency of the mode with the least damping ratio [Hz].
    """

    decay_per_s: float
    frequency_hz: float
    damping_ratio: float
    least_damping_ratio: float
    least_frequency_hz: float

    @property
    def words(self) -> str:
        """The figures in words."""
        speed = f"{'grows' if self.decay_per_s < 0 else 'decays'} {abs(self.decay_per_s):.4g} 1/s"
        slowest = f"{speed} at {self.frequency_hz:.2f} Hz, damping ratio {self.damping_ratio:.4f}"
        if self.least_damping_ratio == self.damping_ratio:
            return slowest
        return f"{slowest}; least ratio {self.least_damping_ratio:.4f} at {self.least_frequency_hz:.2f} Hz"


_FADED = 1e-6  # Rounding moves a delay line's poles at zero to eigenvalues up to this modulus.


def ringing(simulation: Simulation) -> Ringing | None:
    """Return how the loop decays after an impulse; with walls, the modes of all frozen loops count.

    Return None in a world, which has no eigenvalues, and for a loop whose modes are all free drifts.
    """
    if simulation.scenario.environment.world:
        return None
    loops = [close(simulation.plant, F) for F in simulation.process.law.frozen().values()]
    values = np.concatenate([np.linalg.eigvals(loop.A) for loop in loops]).astype(complex)
    modes = np.log(values[np.abs(values) > _FADED]) / simulation.plant.T
    modes = modes[np.abs(modes) > _CLEAR]  # A free drift neither rings nor decays.
    if not modes.size:
        return None
    ratios, hz = -modes.real / np.abs(modes), np.abs(modes.imag) / (2 * np.pi)
    slowest, least = int(np.argmax(modes.real)), int(np.argmin(ratios))
    if np.isclose(ratios[slowest], ratios[least], rtol=1e-9, atol=0):  # Both belong to one conjugate pair.
        least = slowest
    shown = (-modes.real[slowest], hz[slowest], ratios[slowest], ratios[least], hz[least])
    return Ringing(*map(float, shown))


def exact_growth(simulation: Simulation) -> float:
    """Return the growth rate [1/s] of `worst_mode`."""
    return float(worst_mode(simulation).growth)


_NOT_EXCITED = "not excited: the motion does not follow the dominant mode; the verdict is that of the eigenvalues"
_VECTOR_ROUNDING = 1e-12  # error of an eigenvector's entries, relative to the largest entry
_UNLIKE = 0.05  # largest relative rms residual of the fit to a trace that follows the dominant mode
_AT_ONCE = 1 << 16  # ticks that are projected together, to save memory


def _measured_growth(
    loop: ClosedLoop, trace: Trace, force_limit: Array, ahead: int = 0, balls: Sequence[slice] = ()
) -> tuple[float | None, str | None]:
    """Return the growth rate [1/s] of the loop's dominant mode in a trace, or None and the reason.

    The projection y = left* xi contains the dominant mode alone, so that y[k+1] - left* B w[k] = lambda y[k] for the
    external forces w. A least-squares fit gives lambda. A limiter acts up to `ahead` ticks before its force arrives at
    the device, so the fit ends `ahead` ticks before the first clipped tick.
    """
    clipped = trace.clipped(force_limit, balls)
    usable = max(int(np.argmax(clipped)) - ahead, 0) if clipped.any() else clipped.size - 1 - ahead
    if usable < _SHORTEST_TRACE:
        which = "ticks before the first clipped one" if clipped.any() else "ticks"
        return None, f"only {max(usable, 0)} {which}; a growth rate needs {_SHORTEST_TRACE}"
    left = _left_eigenvector(loop).conj()
    pushed = trace.w[:usable] @ (loop.B.T @ left)
    # The terms of y may cancel, so its error is the rounding of these terms and the error of the eigenvector.
    sizes = np.abs(left) + _VECTOR_ROUNDING / _NOISE_FLOOR * np.abs(left).max()
    y, squares = np.empty(usable + 1, dtype=np.complex128), 0.0
    for begin in range(0, usable + 1, _AT_ONCE):
        part = slice(begin, min(begin + _AT_ONCE, usable + 1))
        states = np.concatenate([trace.s[part], trace.z[part]], axis=1)
        y[part] = states @ left
        squares += float(np.sum((np.abs(states[: usable - begin]) @ sizes) ** 2))
    weight = float(np.vdot(y[:-1], y[:-1]).real)
    eigenvalue = np.array(np.vdot(y[:-1], y[1:] - pushed) / weight if weight else 0.0, dtype=np.complex128)
    rest = y[1:] - pushed - eigenvalue * y[:-1]
    if weight <= _NOISE_FLOOR**2 * squares or float(np.vdot(rest, rest).real) > _UNLIKE**2 * weight:
        return None, _NOT_EXCITED
    return float(Mode(eigenvalue, loop.T).growth), None


@dataclass(frozen=True, kw_only=True)
class ExactVerdict:
    """The verdict of the exact loop."""

    exact_verdict: str
    exact_growth_rate_per_s: float
    exact_frequency_hz: float


@dataclass(frozen=True, kw_only=True)
class Eigenvalues(ExactVerdict):
    spectral_radius: float


@dataclass(frozen=True, kw_only=True)
class _Frozen(ExactVerdict):
    """The verdict of the frozen loop in which exactly the walls `touching` are touched."""

    touching: list[int]  # counted from 1


@dataclass(frozen=True)
class _Contact:
    """Contacts with walls in a run, and the verdicts on the frozen loops."""

    made: int  # number of times that a wall was touched
    ticks: int  # number of ticks in which some wall was touched
    slopes_n_per_m: list[float]  # largest stiffness of each wall (controller.environment.Wall.slope)
    frozen: list[_Frozen]  # an entry for every set of touched walls


@dataclass(frozen=True, kw_only=True)
class Stability(Eigenvalues):
    """The verdicts of the trace and of the exact loop's eigenvalues; with walls, of the worst frozen loop."""

    verdict: str | None  # verdict on the run; None if nothing decides it
    clipped_ticks: int  # number of ticks in which a force is at its limit
    growth_rate_per_s: float | None  # of the trace; of the linear loop if delays or ticks vary; `reason` explains None
    frequency_hz: float | None  # strongest frequency of the forces' last quarter, from 10 Hz; None: short or calm
    contact: _Contact | None = off_table("if given", None)
    reason: str | None = off_table("if given", None)


def eigenvalues(mode: Mode) -> Eigenvalues:
    return Eigenvalues(**_exact(mode), spectral_radius=float(mode.spectral_radius))


def _exact(mode: Mode) -> dict[str, Any]:
    figures = mode.verdict, float(mode.growth), float(mode.frequency_hz)
    return dict(zip(("exact_verdict", "exact_growth_rate_per_s", "exact_frequency_hz"), figures, strict=True))


def stability_of(simulation: Simulation, trace: Trace) -> Stability:
    """Return the verdict on a run by its trace and by eigenvalues."""
    contact = _contact(simulation, trace) if simulation.process.walls else None
    decided: str | None = None
    if contact and contact.ticks:
        growth, reason = None, f"contact was made {contact.made} times; a growth rate needs a single linear loop"
    elif simulation.friction:
        growth, reason = None, "with Coulomb friction there is no growth rate; the eigenvalues leave friction out"
    elif trace.net:
        growth, reason = None, "a passivity layer changes the forces; the eigenvalues are those of the loop without it"
    elif simulation.timing and not simulation.timing.steady:
        growth, window = linear_growth(simulation)
        decided = verdict_within(growth, window)
        how = f"growth of the linear loop after an impulse, over {window:.3g} s of periods and latencies as in the run"
        reason = f"{how}; the eigenvalues are those of constant periods and the middle of the latency"
        reason += "" if decided else f"; {UNDECIDED}"
    else:
        loop = close(simulation.plant, simulation.F)
        ahead = max(simulation.scenario.theta) if simulation.process.law.bounds else 0
        growth, reason = _measured_growth(loop, trace, simulation.process.force_limit, ahead, simulation.process.balls)
        decided = None if growth is None else verdict(growth)
    if trace.diverged:
        reason = "the simulation left the range of finite numbers, so it is reported as unstable"
    exact = eigenvalues(worst_mode(simulation))
    decision = "unstable" if trace.diverged else decided
    seconds = len(trace.f) * simulation.scenario.T
    slow = reason is None and growth is not None and abs(growth) * seconds < _DECAY_TIMES
    if slow and growth is not None and disagree(exact.exact_growth_rate_per_s, growth):
        decision, reason = exact.exact_verdict, _not_decidable(growth, exact.exact_growth_rate_per_s, seconds)
    return Stability(
        **vars(exact),
        verdict=exact.exact_verdict if reason == _NOT_EXCITED else decision,
        clipped_ticks=int(trace.clipped(simulation.process.force_limit, simulation.process.balls).sum()),
        growth_rate_per_s=growth,
        frequency_hz=trace.dominant_frequency_hz(),
        contact=contact,
        reason=reason or None,
    )


def _not_decidable(growth: float, exact: float, seconds: float) -> str:
    longer = _DECAY_TIMES / abs(exact)
    return (
        f"not decidable in {seconds:g} s: the trace's fit is {growth:+.3g} 1/s, the eigenvalue's {exact:+.3g} 1/s; "
        f"the verdict is that of the eigenvalues; a trace of {longer:.3g} s would decide"
    )


def _contact(simulation: Simulation, trace: Trace) -> _Contact:
    walls = simulation.process.ticked
    touching = walls.depths(trace.z) > 0
    return _Contact(
        made=int((touching[1:] & ~touching[:-1]).sum() + touching[:1].sum()),
        ticks=int(touching.any(axis=1).sum()),
        slopes_n_per_m=[float(wall.slope(simulation.scenario.T)) for wall in walls.walls],
        frozen=[
            _Frozen(**_exact(mode), touching=[i for i, on in enumerate(state, start=1) if on])
            for state, mode in _frozen_modes(simulation).items()
        ],
    )


# ---- the impulse test: short traces of many humans at once
#
# Every axis of every handle is pushed once, from rest at x = 0. No trace is stored, only sums.

_IMPULSE = 10e-3  # [s] duration of the push
_TO_THE_WALL = 20.0  # [N] force on handle 1 in loops with walls, which swings a hand of 0.3 kg by a few centimetres
_NOISE_FLOOR = 1e-8  # A mode with a smaller share of the state is noise of the engine.


@dataclass(frozen=True, eq=False)
class ImpulseTest:
    """The results of an impulse test."""

    growth: Array  # (nsim,) [1/s] fitted growth of the dominant mode before a force clips; nan: no fit, or walls
    error: Array  # (nsim,) [1/s] estimated error of `growth`; if it exceeds the rate, the rate's sign is uncertain
    clipped: NDArray[np.int64]  # (nsim,) number of ticks in which a force is at its limit or a limiter acts
    least_energy: Array  # (nsim,) [J] least energy W(N) (sim.crowds); without a limiter, before the first clipped tick
    audited: Array  # (nsim,) [J] sum of the magnitudes of the terms of W(N), to which rounding is relative
    settling: Array  # (nsim,) rms speed of the handles in the last quarter over that in the second quarter
    contacts: NDArray[np.int64]  # (nsim,) number of contacts with walls
    simulated: float  # [s] simulated time of all simulations together


@dataclass(frozen=True, eq=False)
class Balance:
    """The energies of a tick at whose beginning forces latch: the work of the forces and the least dissipation."""

    damping: Array  # (m, 1) [N/m] delta/T
    Delta: Array | None  # (m, m) [N s/m] with the diagonal delta; None if no device has a damping matrix

    @staticmethod
    def of(variants: Variants, loop: Loop, late: Sequence[float] | None) -> Balance:
        """Return the balance of held devices. Forces latch `late` (m,) [s] after ticks, or at ticks if it is None."""
        delta, Delta = np.array(loop.delta)[:, None], loop.Delta() if loop.levels else None
        if late is None:
            return Balance(delta / loop.T, Delta)
        first = np.array(late)[:, None]
        before = np.divide(delta, first, out=np.zeros_like(delta), where=first > 0)
        return _LateBalance(delta / (loop.T - first), Delta, before, at_the_latch(variants.plants(), late))

    def terms(self, buffer: StepBuffer, count: int) -> tuple[Array, Array]:
        """Return the work of the forces and the least dissipation, for each tick and channel, (count, m, nsim)."""
        moved = np.diff(buffer.x[: count + 1], axis=0)
        return buffer.f[:count] * moved, self._spent(self.damping, moved)

    def _spent(self, damping: Array, moved: Array) -> Array:
        """Return the least dissipation in steps `moved` (count, m, nsim). `damping` is diag(Delta) over their time."""
        if self.Delta is None:
            return damping * moved**2
        return damping * moved * np.einsum("ij,kjn->kin", self.Delta / np.diag(self.Delta)[:, None], moved)


@dataclass(frozen=True, eq=False)
class _LateBalance(Balance):
    """The energies of a tick with a later latch; `damping` is delta/(T - latency), for the part after the latch."""

    before: Array  # (m, 1) [N/m] delta/latency for the part before the latch; 0 if a force latches at the tick
    seen: Array  # (nsim, m, entries) maps to the positions at the latch (models.hold.at_the_latch)

    def terms(self, buffer: StepBuffer, count: int) -> tuple[Array, Array]:
        x, s, f = buffer.x[: count + 1], buffer.s[:count], buffer.f[:count]
        middle = np.einsum("nme,ken->kmn", self.seen, np.concatenate([s, buffer.w[:count], f], axis=1), optimize=True)
        first, then = middle - x[:-1], x[1:] - middle
        spent = self._spent(self.before, first) + self._spent(self.damping, then)
        return s[:, s.shape[1] - f.shape[1] :] * first + f * then, spent


def impulse_forces(scene: Scene, T: float, first: int, ticks: int, size: float = 1.0) -> Array:
    """Return the external forces (ticks, outside) [N] of an impulse at tick 0, in the ticks from `first` on.

    For 10 ms, or for one longer tick, `size` pushes channel 1, -size/2 channel 2, size/3 channel 3, and so on.
    """
    w = np.zeros((ticks, scene.outside))
    until = max(1, round(_IMPULSE / T)) - first
    for i, column in enumerate(scene.tapped):
        w[: max(until, 0), column] = size * (-1) ** i / (i + 1)
    return w


def impulse_test(
    process: Process,
    engine: Engine,
    scene: Scene,
    loops: ClosedLoop,
    balance: Balance,
    ticks: int,
    lever: float,
    tick_done: Callable[[int], None] = lambda ticks: None,
) -> ImpulseTest:
    """Simulate `ticks` periods with every set of humans after an impulse, and return the sums of the traces.

    `loops` are the exact closed loops; the impulse is proportional to the `lever` of the scenario. With walls it is
    larger, so that hands reach the walls, and growth is not measured.
    """
    nsim, states = loops.A.shape[0], loops.A.shape[1] - process.F.order
    audit = _Audit(process, scene, loops, balance, ticks)
    push = partial(impulse_forces, scene, loops.T, size=lever * (_TO_THE_WALL if process.walls else 1.0))

    def each_block(buffer: StepBuffer, first: int, count: int) -> None:
        audit.see(buffer, first, count)
        tick_done(count)

    run_blocks(process, engine, push, ticks, np.zeros((states, nsim)), each_block)
    return audit.result(ticks * loops.T * nsim)


def impulse_growth(
    process: Process, engine: Engine, scene: Scene, states: int, ticks: int, nsim: int = 1
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the growth [1/s] after an impulse on every handle, and whether a force was clipped, (nsim,) each.

    `states` is the order of the plant. The growth compares the handles' speeds in the last quarter of the ticks with
    those in the second quarter. It is inf where numbers overflow, and -inf for handles at exact rest.
    """
    T, quarter = process.F.T, ticks // 4
    speeds, clipped = _Speeds(scene, nsim, (quarter, 2 * quarter), (ticks - quarter, ticks)), np.zeros(nsim, dtype=bool)

    def each_block(buffer: StepBuffer, first: int, count: int) -> None:
        clipped[...] |= at_limit(buffer.f[:count], process.force_limit, process.balls).any(axis=(0, 1))
        speeds.see(buffer, first, count)

    run_blocks(process, engine, partial(impulse_forces, scene, T), ticks, np.zeros((states, nsim)), each_block)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        rate = np.log(speeds.late / speeds.early) / 2 / ((ticks - 2 * quarter) * T)
    return np.where(speeds.late == 0, -np.inf, np.where(np.isnan(rate), np.inf, rate)), clipped


UNDECIDED = "not decidable: the rate is too small for its sign to count in this time"


def verdict_within(growth: float, seconds: float) -> str | None:
    """Return the verdict of a growth rate [1/s] that a trace of `seconds` shows; None if the rate is too small."""
    return verdict(growth) if abs(growth) * seconds >= _DECAY_TIMES else None


def linear_growth(simulation: Simulation, most: int | None = None) -> tuple[float, float]:
    """Return the growth rate [1/s] of the exact linear loop after an impulse, and the duration [s] of its trace.

    Modes that beat or decay can hide a slow growth. Therefore the trace is extended until its duration is SETTLED time
    constants of the rate, to at most 100 s or `most` ticks.
    """
    free = replace(simulation.smooth, process=simulation.process.unlimited)
    T, states = simulation.scenario.T, simulation.plant.A.shape[0]
    rate, window = 0.0, 0.0
    for seconds in _JUDGED:
        ticks = max(4, min(round(seconds / T), most or round(seconds / T)))
        rates, _ = impulse_growth(free.process, make_engine(free, "exact"), free.scene, states, ticks)
        window = float(beginnings(T, simulation.timing, ticks, 1)[0])
        rate = float(rates[0]) * ticks * T / window
        if ticks == most or abs(rate) * window >= SETTLED:
            break
    return rate, window


def _parts(weights: NDArray[np.complex128]) -> Array:
    """Return real and imaginary parts of weights (nsim, entries) as an array (2, entries, nsim) for `_projected`."""
    return np.ascontiguousarray([weights.real.T, weights.imag.T])


def _projected(parts: Array, rows: Array) -> NDArray[np.complex128]:
    """Return the weighted sum (ticks, nsim) of the entries of each row, (ticks, entries, nsim)."""
    real, imaginary = np.einsum("cen,ken->ckn", parts, rows)
    return real + 1j * imaginary


class _Speeds:
    """Sums of the handles' squared speeds over two windows of ticks, (nsim,) each."""

    def __init__(self, scene: Scene, nsim: int, early: tuple[int, int], late: tuple[int, int]) -> None:
        self._entries = [scene.model.nv + handle for handle in scene.handles]
        self._windows = early, late
        self.early, self.late = np.zeros(nsim), np.zeros(nsim)

    def see(self, buffer: StepBuffer, first: int, count: int) -> None:
        square, k = (buffer.s[:count, self._entries] ** 2).sum(axis=1), np.arange(first, first + count)
        for total, (begin, end) in zip((self.early, self.late), self._windows, strict=True):
            total += square[(k >= begin) & (k < end)].sum(axis=0)


class _Audit:
    """The running sums of an impulse test."""

    def __init__(self, process: Process, scene: Scene, loops: ClosedLoop, balance: Balance, ticks: int) -> None:
        nsim, self._balance = loops.A.shape[0], balance
        self._process, self._law = process, process.ticked
        self._made, self._touching = np.zeros(nsim, dtype=int), np.zeros((len(process.walls), nsim), dtype=bool)
        self._T = loops.T
        if not process.walls:
            left = _left_eigenvector(loops).conj()
            self._left, self._pushed = _parts(left), _parts(np.einsum("ns,nsw->nw", left, loops.B))
        self._speeds = _Speeds(scene, nsim, (ticks // 4, ticks // 2), (ticks - ticks // 4, ticks))
        self._linear = np.ones(nsim, dtype=bool)
        self._usable, self._clipped = np.zeros(nsim, dtype=int), np.zeros(nsim, dtype=int)
        self._energy, self._least, self._size = np.zeros(nsim), np.zeros(nsim), np.zeros(nsim)
        self._across, self._weight, self._squares = np.zeros(nsim, dtype=complex), np.zeros(nsim), np.zeros(nsim)
        self._half, self._first = ticks // 2, (self._across, self._weight)  # _first: sums over the trace's first half

    def see(self, buffer: StepBuffer, first: int, count: int) -> None:
        """Add the first `count` rows of the buffer to the sums; row 0 is tick `first`."""
        z, s, w, f = (rows[: count + 1] for rows in (buffer.z, buffer.s, buffer.w, buffer.f))
        law = self._law
        limit, balls = self._process.force_limit, self._process.balls
        slipped = law.bounds or not balls
        where = law.limited(z, f[:count], limit[:, None]) if slipped else at_limit(f[:count], limit, balls)
        clipped = where.any(axis=1)  # (ticks, nsim)
        if law.walls:
            touching = np.concatenate([self._touching[None], law.depths(z) > 0])
            self._made += (touching[1:] & ~touching[:-1]).sum(axis=(0, 1))
            self._touching = touching[-1]
        linear = self._linear & ~np.logical_or.accumulate(clipped, axis=0)
        self._clipped += clipped.sum(axis=0)
        self._usable += linear.sum(axis=0)
        self._linear = linear[-1]

        work, spent = self._balance.terms(buffer, count)
        whole = linear.all()
        if not (whole or law.bounds):
            work, spent = (np.where(linear[:, None], part, 0.0) for part in (work, spent))
        work, spent = work.sum(axis=1), spent.sum(axis=1)
        energy = self._energy + np.cumsum(work + spent, axis=0)
        self._least = np.minimum(self._least, energy.min(axis=0))
        self._energy = energy[-1]
        self._size += (np.abs(work) + spent).sum(axis=0)

        self._speeds.see(buffer, first, count)
        if law.walls:
            return
        xi = np.concatenate([s, z], axis=1)
        y = _projected(self._left, xi)
        y, after, xi = y[:-1], y[1:] - _projected(self._pushed, w[:count]), xi[:-1]
        if not whole:
            y, xi = np.where(linear, y, 0), np.where(linear[:, None], xi, 0.0)
        across, weight = y.conj() * after, np.abs(y) ** 2
        if first < self._half <= first + count:
            until = self._half - first
            self._first = self._across + across[:until].sum(axis=0), self._weight + weight[:until].sum(axis=0)
        self._across = self._across + across.sum(axis=0)
        self._weight = self._weight + weight.sum(axis=0)
        self._squares += np.einsum("ksn,ksn->n", xi, xi)

    def result(self, simulated: float) -> ImpulseTest:
        above_noise = (self._usable >= _SHORTEST_TRACE) & (self._weight > _NOISE_FLOOR**2 * self._squares)
        with np.errstate(divide="ignore", invalid="ignore"):
            growth = np.where(above_noise, np.log(np.abs(self._across / self._weight)) / self._T, np.nan)
            settling = np.sqrt(self._speeds.late / self._speeds.early)
            across, weight = self._first
            halves = np.abs(np.array([across / weight, (self._across - across) / (self._weight - weight)]))
            apart = np.abs(np.log(halves[1] / halves[0])) / self._T
            error = np.maximum(_DECAY_TIMES / (self._usable * self._T), np.where(np.isfinite(apart), apart, np.inf))
        return ImpulseTest(growth, error, self._clipped, self._least, self._size, settling, self._made, simulated)
