"""Accuracy of runs: errors of engines and of felt forces, and the choice of an integrator and its substeps.

`measure` returns the cost and the errors of one setting (engine, integrator, substeps). `compare_engines` runs several
settings on a scene, and `pick` chooses the cheapest one within a given error.
"""

from __future__ import annotations

if __name__ == "__main__":  # This precedes the imports, because --help does not need them.
    from haptic_loop.cli.main import run_command

    run_command("accuracy")

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from haptic_loop.controller.delay import delay
from haptic_loop.controller.lti import Array, Lti
from haptic_loop.controller.tick import StepBuffer
from haptic_loop.design.files import off_table
from haptic_loop.models.hold import HeldPlant
from haptic_loop.models.scene import quiet_warnings
from haptic_loop.sim.engines import EXPONENTIAL, default_integrator, evaluations, least_substeps, pace
from haptic_loop.sim.run import AnyEngine, EngineSettings, Progress, Simulation, engine_name, make_engine, run
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.stability import close, disagree, dominant_mode, exact_growth, unstable, worst_mode
from haptic_loop.sim.trace import Trace

# ---- errors against the exact engine


@dataclass(frozen=True)
class PositionError:
    """Error of device positions against the exact engine. Figures are None if nothing moves or a `reason` is given."""

    position_relative_rms: float | None = None  # rms error over the rms of the exact positions
    position_max_m: float | None = None  # largest error of a channel at a tick
    reason: str | None = off_table("if given", None)


def position_error(
    trace: Trace, exact: Trace | None, simulation: Simulation, grows: bool | None = None
) -> PositionError:
    """Return the position error of a trace against the exact engine.

    `grows` says whether the loop is unstable; by default its eigenvalues decide. If an unstable trace has clipped
    forces, there are no figures, because growth multiplies any difference; `reason` has the error before the first
    clipped force.
    """
    if exact is None:
        return PositionError(reason="the loop has Coulomb friction, which the exact engine does not model")
    limits, m = (simulation.process.force_limit, simulation.process.balls), simulation.process.channels
    n = min(trace.t.size, exact.t.size)
    clipped = exact.clipped(*limits)[:n] | trace.clipped(*limits)[:n]
    if grows is None:
        grows = worst_mode(simulation).verdict == "unstable"
    linear = int(np.argmax(clipped)) if grows and clipped.any() else n
    own, true = trace.s[:linear, :m], exact.s[:linear, :m]
    size, relative, largest = _rms(true), None, None
    if size > 0:
        relative, largest = _rms(own - true) / size, float(np.abs(own - true).max())
    if linear == n:
        return PositionError(relative, largest)
    until = f"the unstable run clips from t = {linear * simulation.scenario.T:.3f} s on, and growth multiplies errors"
    before = f" (relative rms error until then: {relative:.1e})" if relative is not None else ""
    return PositionError(reason=until + before)


#: (engine, integrator, substeps) that are compared; the first is the reference
_SETTINGS = (
    ("exact", None, None),
    ("mujoco", EXPONENTIAL, 1),
    *(("mujoco", "RK4", n) for n in (1, 2, 3, 4, 8)),
    *(("mujoco", "Euler", n) for n in (1, 4, 12)),
    *(("mujoco", "implicitfast", n) for n in (1, 4, 12)),
    *(("mujoco", "discrete", n) for n in (4, 12)),
)
_REPEATS = 3  # number of runs; the shortest wall time is the cost
_TAIL = 4000  # number of ticks at the end of a run in which a limit cycle is measured


@dataclass(frozen=True)
class Row:
    """Cost and errors of one setting of an engine; a missing figure is None."""

    engine: str
    integrator: str | None
    substeps: int | None
    position_relative_rms: float | None  # rms error of positions over the rms of the exact positions
    growth_rate_error: float  # [1/s] error with or without the coupling, whichever is larger in size
    verdict_correct: bool  # whether the verdicts with and without the coupling are both right
    cycle_deviation_n: float | None  # largest standard deviation of a force in the limit cycle without coupling
    cycle_frequency_hz: float | None  # frequency of the same force
    cycle_deviation_error: float | None  # relative error of `cycle_deviation_n`
    cycle_frequency_error_hz: float | None
    wall_s_per_simulated_s: float
    pareto: bool = False  # whether the setting is on the Pareto front (`_with_front`)


@dataclass(frozen=True, eq=False)
class _Reference:
    """Results of the exact engine, with the coupling and without one."""

    coupled: Simulation
    uncoupled: Simulation
    trace: Trace
    cycle: tuple[int, float, float] | None  # channel, standard deviation [N], frequency [Hz]; None: not measured


def reference(coupled: Simulation, uncoupled: Simulation) -> _Reference:
    """Return the exact engine's run of the coupled loop, and the limit cycle of an unstable uncoupled loop."""
    cycle = None
    if unstable(exact_growth(uncoupled)):
        free = run(uncoupled, "exact")
        if free.t.size > _TAIL and not free.diverged:
            channel = int(np.argmax(free.f[-_TAIL:].std(axis=0)))
            cycle = (channel, *_limit_cycle(free, channel))
    return _Reference(coupled, uncoupled, run(coupled, "exact"), cycle)


def measure_all(
    coupled: Simulation, uncoupled: Simulation, default: int, progress: Callable[[int, int], None]
) -> tuple[list[Row], list[str], bool]:
    """Measure the settings of `_SETTINGS`, and RK4 with its default number of substeps `default`.

    Returns:
        Rows of the settings that are stable on this plant, the reasons why the others are left out, and whether Ctrl-C
        ended the measurement early.
    """
    rows: list[Row] = []
    skipped: list[str] = []
    settings = list(dict.fromkeys((*_SETTINGS, ("mujoco", "RK4", default))))
    try:
        truth = reference(coupled, uncoupled)
        for index, (engine, integrator, substeps) in enumerate(settings):
            progress(index, len(settings))
            try:
                if integrator and substeps and _step_radius(coupled, integrator, substeps) > 1 + _NEUTRAL:
                    raise InputError("outside the stable region")
                rows.append(measure(truth, engine, integrator, substeps))
            except ValueError as error:
                skipped.append(f"{integrator} x {substeps}: {error}")
    except KeyboardInterrupt:
        return _with_front(rows), skipped, True
    return _with_front(rows), skipped, False


def measure(truth: _Reference, engine: str, integrator: str | None, substeps: int | None) -> Row:
    """Run one setting, and return its cost and errors."""
    settings = (engine, integrator, substeps)
    trace, wall = _timed(truth.coupled, *settings)
    for _ in range(_REPEATS - 1):
        wall = min(wall, _timed(truth.coupled, *settings)[1])
    position = position_error(trace, truth.trace, truth.coupled).position_relative_rms
    share = wall / (trace.t.size * truth.coupled.scenario.T)
    return Row(*settings, position, *_growth(truth, *settings), *_cycle(truth, *settings), share)


def _with_front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with `pareto` set.

    A row is on the front if its verdicts are right, its figures are finite, and no row of the same engine is at least
    as good in all figures and better in one. Each engine has its own front: only linear plants suit the exact engine.
    """
    points, marked = np.array([_point(row) for row in rows]), []
    for i, row in enumerate(rows):
        rivals = points[[other.engine == row.engine for other in rows]]
        beaten = ((rivals <= points[i]).all(axis=1) & (rivals < points[i]).any(axis=1)).any()
        marked.append(replace(row, pareto=bool(np.isfinite(points[i]).all() and row.verdict_correct and not beaten)))
    return marked


def _limit_cycle(trace: Trace, channel: int) -> tuple[float, float]:
    """Return the standard deviation [N] and the interpolated frequency [Hz] of a force in the last _TAIL ticks."""
    force = trace.f[-_TAIL:, channel]
    level = np.log(np.abs(np.fft.rfft((force - force.mean()) * np.hanning(force.size))) + 1e-300)
    peak = int(np.clip(np.argmax(level[1:-1]) + 1, 1, level.size - 2))
    low, mid, high = level[peak - 1 : peak + 2]
    curvature = low - 2 * mid + high
    shift = 0.5 * (low - high) / curvature if curvature else 0.0
    return float(force.std()), float((peak + shift) / (force.size * (trace.t[1] - trace.t[0])))


def _timed(simulation: Simulation, engine: str, integrator: str | None, substeps: int | None) -> tuple[Trace, float]:
    begin = time.perf_counter()
    trace = run(simulation, make_engine(simulation, engine, integrator, substeps))
    return trace, time.perf_counter() - begin


def _growth(truth: _Reference, engine: str, integrator: str | None, substeps: int | None) -> tuple[float, bool]:
    """Return the larger error of the growth rates [1/s] with and without coupling, and if both verdicts are right."""
    errors, right = [], True
    for simulation in (truth.coupled, truth.uncoupled):
        held = _measured_hold(simulation, engine, integrator, substeps)
        own, exact = dominant_mode(close(held, simulation.F)).growth, exact_growth(simulation)
        errors.append(float(own - exact))
        right &= bool(unstable(own) == unstable(exact))
    return max(errors, key=abs), right


def _cycle(
    truth: _Reference, engine: str, integrator: str | None, substeps: int | None
) -> tuple[float, float, float, float] | tuple[None, None, None, None]:
    """Return standard deviation [N] and frequency [Hz] of the limit cycle's force, and their errors [-], [Hz].

    All four are None if the exact loop has no limit cycle, or if the run diverged.
    """
    if truth.cycle is None:
        return None, None, None, None
    channel, deviation, frequency = truth.cycle
    trace = run(truth.uncoupled, make_engine(truth.uncoupled, engine, integrator, substeps))
    if trace.diverged:
        return None, None, None, None
    own, turns = _limit_cycle(trace, channel)
    return own, turns, own / deviation - 1, turns - frequency


def _point(row: Row) -> Array:
    position = np.inf if row.position_relative_rms is None else row.position_relative_rms
    return np.array([row.wall_s_per_simulated_s, position, abs(row.growth_rate_error)])


# ---- limits of the model


@dataclass(frozen=True)
class Credible:
    """The time at which a run leaves the range of the devices' linear model, with peaks and the range's limits.

    Each list has one entry per channel, but for a run without ticks the lists of peaks are empty.
    """

    until_s: float | None  # first time at which a transmission force or a motor speed exceeds its limit; None: never
    transmission_force_n: list[float | None]  # peak force of the transmission; None for a rigid device
    motor_speed_m_per_s: list[float]  # peak speed of the motor
    credible_force_n: list[float | None]  # largest force for which the model is credible
    credible_speed_m_per_s: list[float]  # largest speed for which the model is credible
    reason: str | None = off_table("if given", None)


def credible(simulation: Simulation, trace: Trace) -> Credible:
    """Return when a run leaves the forces and speeds for which the devices' linear model is credible, and its peaks.

    The limits are `Device.most_credible_force` and `Device.credible_speed`.
    """
    n, devices = simulation.scene.model.nq, simulation.scenario.axis_devices
    forces: list[float | None] = []
    speeds, outside = [], np.zeros(trace.t.size, bool)
    for i, (device, handle) in enumerate(zip(devices, simulation.scene.handles, strict=True)):
        if not trace.s.size:  # The run stopped before its first tick.
            break
        motor, speed = trace.s[:, i], np.abs(trace.s[:, n + i])
        outside |= speed > device.credible_speed
        speeds.append(float(speed.max(initial=0.0)))
        if device.transmission is None:
            forces.append(None)
            continue
        stretched, stretching = motor - trace.s[:, handle], trace.s[:, n + i] - trace.s[:, n + handle]
        damping, stiffness = device.transmission
        force = np.abs(stiffness * stretched + damping * stretching)
        outside |= force > device.most_credible_force
        forces.append(float(force.max(initial=0.0)))
    most_forces = [device.most_credible_force for device in devices]
    most_speeds = [device.credible_speed for device in devices]
    until = float(trace.t[np.argmax(outside)]) if outside.any() else None
    credible_part = Credible(until, forces, speeds, most_forces, most_speeds)
    return credible_part if until is None else replace(credible_part, reason=_not_credible(credible_part, until))


def _not_credible(credible: Credible, until: float) -> str:
    pairs = zip(credible.transmission_force_n, credible.credible_force_n, strict=True)
    carried = max(((f, c) for f, c in pairs if f is not None and c), key=lambda pair: pair[0] / pair[1], default=None)
    speeds = zip(credible.motor_speed_m_per_s, credible.credible_speed_m_per_s, strict=True)
    speed, most = max(speeds, key=lambda pair: pair[0] / pair[1])
    excess = f"a motor moves at up to {speed:.2g} m/s (credible: {most:g})"
    if carried:
        excess = f"a transmission carries up to {carried[0]:.3g} N (credible: {carried[1]:g}) and {excess}"
    return f"from t = {until:.2f} s on, no real device would move like the linear model: {excess}"


# ---- errors against the ideal environment


@dataclass(frozen=True, eq=False)
class ForceError:
    """Forces of the coupled loop and of the ideal environment for the same displacements (`force_error`)."""

    asked: Array = off_table("left out")  # (N, m) forces of the coupled loop [N]
    ideal: Array = off_table("left out")  # (N, m) forces Lambda E x of the ideal environment [N]
    error_percent: float | None = off_table()  # 100 rms(asked - ideal)/rms(ideal), over all ticks and channels
    asked_rms_n: float | None = off_table()
    ideal_rms_n: float | None = off_table()
    reason: str | None = off_table("if given")  # reason why there is no comparison

    @classmethod
    def of(cls, asked: Array, ideal: Array, reason: str | None = None) -> ForceError:
        own, true, apart = _rms(asked), _rms(ideal), _rms(asked - ideal)
        if reason:
            return cls(asked, ideal, None, own, None, reason)
        if not np.isfinite([own, true, apart]).all():
            return cls(asked, ideal, None, None, None, "the numbers of the run overflowed")
        if true == 0:
            return cls(asked, ideal, None, own, true, "the ideal environment would have rendered no force")
        return cls(asked, ideal, 100 * apart / true, own, true, None)


def force_error(simulation: Simulation, trace: Trace, lam: Sequence[int]) -> ForceError:
    """Return the run's forces beside those of the ideal Lambda E for the measured displacements.

    Lambda delays by `lam` samples, and E is the environment. The run's forces are those before clipping. With switching
    delays, a limiter or a passivity layer they are those that the devices received.
    """
    process = simulation.process
    if process.walls:
        return ForceError.of(trace.f, trace.f, "walls have no linear ideal to compare with")
    F = process.F
    wanted_force = trace.f if process.delays is not None or process.law.bounds else trace.z @ F.C.T + trace.x @ F.D.T
    return ForceError.of(wanted_force, response(delay(lam, F.T) @ simulation.E, trace.x))


def response(G: Lti, x: Array) -> Array:
    """Return y = G x (N, outputs) from rest for x (N, inputs)."""
    rows = np.zeros((x.shape[0] + 1, G.order + x.shape[1]))  # a row per tick: [state, x]
    rows[:-1, G.order :] = x
    step = np.hstack([G.A, G.B]).dot
    with np.errstate(over="ignore", invalid="ignore"):  # An unstable run may overflow.
        for row, state in zip(rows, rows[1:, : G.order], strict=False):
            step(row, state)
        return rows[:-1] @ np.hstack([G.C, G.D]).T


def _rms(values: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


# ---- the cheapest engine and step for a given error
#
# The error is the relative rms error of the true positions at the encoders over the run. Without friction the reference
# is a run with the exact engine. With friction the reference is a run of RK4. Two runs, with n and with 2 n substeps,
# are compared, and n is doubled until their difference is small enough. If every doubling multiplies the difference by
# q, the error of the finest run is q/(1 - q) times the last difference; a method of first order has q = 1/2. Two runs
# may agree by chance. Therefore q is the larger of the last two ratios of successive differences, and at least _EVEN.

_CANDIDATES = ((EXPONENTIAL, 1), ("RK4", 1), ("RK4", 2), ("RK4", 4), ("RK4", 8), ("Euler", 1), ("Euler", 4))
_MOST_COMPARED = 256  # largest number of substeps of a refined reference
_MOST_EVALUATIONS = 6e7  # largest number of evaluations of the dynamics in a refinement; they take two minutes
_EVEN = 0.6  # least q, because friction makes these ratios jump
_CONTRACTS = 0.7  # largest q of differences that count as convergent
_FEW = 4.0  # error bound if the differences do not converge, in units of the largest of the last three differences


@dataclass(frozen=True)
class EngineChoice:
    """Cost and error of one setting of MuJoCo's integrators on a scene."""

    integrator: str
    substeps: int
    position_relative_rms: float  # error of positions plus the reference's error bound; inf if the run ended early
    verdict_correct: bool  # whether the simulated loop has the verdict of the exact loop
    cpu_s: float  # CPU time of the run, for the report only

    @property
    def name(self) -> str:
        return f"{self.integrator} x {self.substeps}"

    @property
    def cost(self) -> tuple[int, float]:
        """The key by which settings are sorted: evaluations of the dynamics per tick, then the error."""
        return self.substeps * evaluations(self.integrator), self.position_relative_rms


def compare_engines(
    simulation: Simulation, error: float, ticks: int | None = None, progress: Progress = lambda done, ticks: None
) -> tuple[EngineChoice, ...]:
    """Run each setting that is stable on the scene's plant for `ticks` ticks; return the settings, the cheapest first.

    Runs include the scenario's walls, limits, encoder steps, varying delays and passivity layer. Verdicts are for
    constant delays and periods, without latency and layer. Every run calls `progress`.

    Raises InputError if `error` is not positive or if nothing moves. With friction it is also raised if RK4 with 128
    substeps misses `error`, or if the runs would need more than 60 million evaluations of the dynamics.
    """
    if not error > 0:
        raise InputError(f"--error is {error:g}, expected a positive relative error")
    ticks = simulation.scenario.samples if ticks is None else ticks
    linear = simulation.smooth.even
    runs: dict[tuple[str, int], tuple[Array, float]] = {}
    if default_integrator(simulation.scene) == EXPONENTIAL:
        settings = list(dict.fromkeys((*_CANDIDATES, ("RK4", default_substeps(linear, "RK4")))))
        truth, missed = _positions(simulation, ticks, "exact", progress=progress)[0], 0.0
    else:
        truth, missed = _refined(simulation, error, ticks, runs, progress)
        # The exponential integrator cannot step a scene with both friction and an impedance.
        rest = ("RK4",) if simulation.scene.plant.felt is None else ("RK4", EXPONENTIAL)
        settings = [*runs, *(one for one in _CANDIDATES if one[0] not in rest)]
    _require_motion(truth)
    choices = []
    for name, n in settings:
        if name != EXPONENTIAL and _step_radius(linear, name, n) > 1 + _NEUTRAL:
            continue
        own, cost = runs.get((name, n)) or _positions(simulation, ticks, "mujoco", name, n, progress)
        right = not disagree(exact_growth(linear), simulated_growth(linear, name, n))
        choices.append(EngineChoice(name, n, _apart(own, truth) + missed, right, cost))
    return tuple(sorted(choices, key=lambda choice: choice.cost))


def pick(choices: Sequence[EngineChoice], error: float) -> EngineChoice:
    """Return the cheapest setting with the right verdict and an error up to `error`. Raises InputError if none has."""
    right = [choice for choice in choices if choice.verdict_correct and choice.position_relative_rms <= error]
    if right:
        return min(right, key=lambda choice: choice.cost)
    able = [choice for choice in choices if choice.verdict_correct]
    if not able:
        raise InputError(f"--error {error:g}: no setting has the right verdict")
    best = min(able, key=lambda choice: choice.position_relative_rms)
    nearest = (
        f"the most accurate setting with the right verdict, {best.name}, has error {best.position_relative_rms:.1g}"
    )
    raise InputError(f"--error {error:g}: {nearest}")


@dataclass(frozen=True)
class CrossCheck:
    """Difference between a run and the same run with another integrator."""

    integrator: str
    substeps: int
    position_relative_rms: float  # rms difference over the rms of the repeated run; null in JSON after an overflow
    growth_rate_per_s: (
        float  # growth that `simulated_growth` finds with this integrator, at constant periods and delays
    )
    growth_rate_difference_per_s: float  # the growth rate above minus that of the original run's engine
    agrees: bool  # whether the verdicts agree, and both runs diverged or neither did


def cross_check(simulation: Simulation, trace: Trace, settings: EngineSettings) -> CrossCheck:
    """Repeat the run with another integrator, and return the differences of the two runs.

    The other integrator is RK4, or the exponential one if the run used RK4. RK4 uses no matrix of the other engines,
    except for impedances of hands. `simulation` is the loop that ran, with its passivity layer. Positions are compared
    up to the end of the shorter run.
    """
    other = EXPONENTIAL if settings.integrator == "RK4" else "RK4"
    linear = simulation.smooth.even
    substeps = default_substeps(linear, other)
    beside = run(simulation, make_engine(simulation, "mujoco", other, substeps), ticks=trace.t.size)
    ticks, m = min(trace.t.size, beside.t.size), simulation.process.channels
    growth = simulated_growth(linear, other, substeps)
    own = exact_growth(linear)
    if settings.engine != "exact":
        own = simulated_growth(linear, settings.integrator, settings.substeps, settings.engine)
    apart = _apart(trace.s[:ticks, :m], beside.s[:ticks, :m])
    agrees = not disagree(own, growth) and trace.diverged == beside.diverged
    return CrossCheck(other, substeps, apart, growth, growth - own, agrees)


def _refined(
    simulation: Simulation,
    error: float,
    ticks: int,
    runs: dict[tuple[str, int], tuple[Array, float]],
    progress: Progress,
) -> tuple[Array, float]:
    """Return the positions of a refined run by RK4, and a bound of their error; store every run in `runs`.

    Raises InputError if nothing moves, or if `error` needs more substeps or evaluations than are allowed.
    """
    finest, best, gaps = 1, math.inf, list[float]()
    runs["RK4", 1] = _positions(simulation, ticks, "mujoco", "RK4", 1, progress)
    _require_motion(runs["RK4", 1][0])
    while finest < _MOST_COMPARED:
        coarse, finest = runs["RK4", finest][0], 2 * finest
        fine, _ = runs["RK4", finest] = _positions(simulation, ticks, "mujoco", "RK4", finest, progress)
        gaps.append(_apart(coarse, fine))
        missed = _missed(gaps)
        best = min(best, gaps[-1] + missed)
        if gaps[-1] + missed <= error:
            return fine, missed
        needed = min(max(2 * gaps[-1] / error, 1.0) * finest, _MOST_COMPARED)  # The error is of first order in a step.
        count = ticks * evaluations("RK4") * 2 * needed  # n + n/2 + ... substeps are 2 n
        if count > _MOST_EVALUATIONS:
            raise InputError(
                f"--error {error:g}: with friction this error requires RK4 with about {needed:.0f} substeps, "
                f"{1e-6 * count:.0f} million evaluations; allowed are {1e-6 * _MOST_EVALUATIONS:g} million: give a "
                "shorter --duration or a larger error"
            )
    within = f"has an error of {best:.1g}" if best < math.inf else "does not converge"
    raise InputError(f"--error {error:g}: RK4 {within} with up to {_MOST_COMPARED // 2} substeps")


def _missed(gaps: Sequence[float]) -> float:
    """Return a bound of the finest run's error from the differences of successive runs; inf for fewer than three."""
    *_, first, second, last = math.inf, math.inf, *gaps
    if not math.isfinite(first + second + last):
        return math.inf
    q = max(_EVEN, *(fine / coarse if coarse else 1.0 for coarse, fine in ((first, second), (second, last))))
    return last * q / (1 - q) if q <= _CONTRACTS else _FEW * max(first, second, last)


def _positions(
    simulation: Simulation,
    ticks: int,
    engine: str,
    integrator: str | None = None,
    substeps: int | None = None,
    progress: Progress = lambda done, ticks: None,
) -> tuple[Array, float]:
    """Return the devices' positions (N, m) [m] in a run from rest, and the run's CPU time [s]."""
    stepped = make_engine(simulation, engine, integrator, substeps)
    begin = time.process_time()
    trace = run(simulation, stepped, ticks=ticks, progress=progress)
    return trace.s[:, : simulation.process.channels], time.process_time() - begin


def _require_motion(positions: Array) -> None:
    if not positions.any():
        raise InputError("--error is relative to the motion, but nothing moves: add a tap or a voluntary motion")


def _apart(own: Array, truth: Array) -> float:
    """Return the rms difference relative to the rms of `truth`; inf for different lengths, 0 if `truth` is all 0."""
    if own.shape != truth.shape:
        return math.inf
    scale = float(np.mean(truth**2))
    return math.sqrt(float(np.mean((own - truth) ** 2)) / scale) if scale else 0.0


# ----------------------------------------------------------------------------------------------------
# The default integrator and number of substeps of a plant, and the map of an engine over one period.
#
# Without friction the exponential integrator is exact with one step. For MuJoCo's own integrators the eigenvalues of
# the continuous plant give the number of steps. A step of h [s] must resolve the fastest weakly damped mode of
# frequency w [rad/s] (w h <= 0.2), and follow the mode of the largest decay rate a [1/s] (a h < 1). The number of steps
# is at least 4. It is doubled until the simulated loop has the verdict of the exact loop.

MOST = 10_000  # largest number of substeps
_MODE_LOST = "it damps fast modes away"
_NEUTRAL = 1e-6  # allowed excess of a spectral radius over 1; rounding moves double eigenvalues at 1 by 1e-8
_UNIT = 1e-6  # size of basis states and inputs; the plant is linear, and no force limit is smaller


def settle(
    simulation: Simulation, engine: AnyEngine, integrator: str | None = None, substeps: int | None = None
) -> tuple[str | None, int | None, list[str]]:
    """Return (integrator, substeps, remarks) of a run, with defaults in place of None.

    Engines other than MuJoCo have neither integrator nor substeps. Raises InputError for impossible settings.
    """
    if engine != "mujoco":
        for name, value in (("integrator", integrator), ("substeps", substeps)):
            if value is not None:
                raise InputError(f"--{name} with --engine {engine_name(engine)}: only MuJoCo has it; leave it out")
        if engine == "exact" and simulation.friction:
            raise InputError("--engine exact is linear, but the devices have Coulomb friction; use --engine mujoco")
        return None, None, []
    integrator = integrator or default_integrator(simulation.scene)
    if substeps is None and integrator != EXPONENTIAL:
        return integrator, default_substeps(simulation, integrator), []
    substeps = default_substeps(simulation, integrator) if substeps is None else substeps
    return integrator, substeps, _check_substeps(simulation, integrator, substeps)


def default_substeps(simulation: Simulation, integrator: str = "RK4") -> int:
    """Return the default number of steps per period: 1 for the exponential integrator without friction.

    Otherwise the steps resolve the plant's motions and give the right verdict. Raises InputError if no number up
    to 10000 suffices, or for MuJoCo's integrator `discrete`.
    """
    if integrator == EXPONENTIAL and default_integrator(simulation.scene) == EXPONENTIAL:
        return least_substeps(EXPONENTIAL)
    if integrator == "discrete":  # This integrator has states that the map of `_agrees` lacks.
        raise InputError(f"--integrator discrete gives no reliable verdict: {_MODE_LOST}; use RK4 or give --substeps")
    simulation = simulation.smooth.even
    speed, T = pace(simulation.scene.plant.A), simulation.scenario.T
    count = needed = speed.substeps(T)
    while count <= MOST and not _agrees(simulation, integrator, count):
        count *= 2
    if needed > MOST:
        raise InputError(f"{speed.hardest(T / MOST)} even with {MOST} substeps: use --engine exact")
    if count > MOST:
        raise InputError(f"--integrator {integrator} gives a wrong verdict up to {MOST} substeps: use --integrator RK4")
    return count


def _check_substeps(simulation: Simulation, integrator: str, substeps: int) -> list[str]:
    """Return remarks on the user's number of substeps. Raises InputError if the integrator is unstable with it."""
    if integrator == EXPONENTIAL:
        nearer = "with friction its error is of first order; RK4 is more accurate at equal cost (see --cross-check)."
        rubs = default_integrator(simulation.scene) != EXPONENTIAL
        return [f"{integrator} x {substeps}: {nearer}"] if rubs else []
    simulation = simulation.smooth.even
    speed, h = pace(simulation.scene.plant.A), simulation.scenario.T / substeps
    radius = _step_radius(simulation, integrator, substeps)
    setting = f"{integrator} x {substeps}: {speed.hardest(h)}"
    if not radius <= 1 + _NEUTRAL:
        instead = _instead(simulation, integrator)
        raise InputError(f"--substeps {substeps}: {setting}, outside the stable region of {integrator}; {instead}")
    remarks = [] if speed.within(h) else [f"{setting}: stable but coarse; {_instead(simulation, integrator)}."]
    if integrator == "discrete":
        remarks.append(f"discrete gives no reliable verdict: {_MODE_LOST}.")
    elif not _agrees(simulation, integrator, substeps):
        simulated, exact = simulated_growth(simulation, integrator, substeps), exact_growth(simulation)
        growth = f"{simulated:+.3g} 1/s, the exact loop {exact:+.3g} 1/s"
        remarks.append(f"{integrator} x {substeps} gives a WRONG VERDICT: its loop grows by {growth}.")
    return remarks


def _step_radius(simulation: Simulation, integrator: str, substeps: int) -> float:
    """Return the spectral radius of one substep of the plant, which is passive: above 1 the integrator is unstable."""
    step = _measured_hold(simulation, "mujoco", integrator, 1, simulation.scenario.T / substeps)
    return float(np.abs(np.linalg.eigvals(step.A)).max()) if np.isfinite(step.A).all() else np.inf


def _agrees(simulation: Simulation, integrator: str, substeps: int) -> bool:
    if _step_radius(simulation, integrator, substeps) > 1 + _NEUTRAL:
        return False
    return not disagree(exact_growth(simulation), simulated_growth(simulation, integrator, substeps))


def _instead(simulation: Simulation, integrator: str) -> str:
    try:
        return f"use --substeps {default_substeps(simulation, integrator)} or leave it out"
    except InputError:
        return "use --engine exact"


def _measured_hold(
    simulation: Simulation,
    engine: AnyEngine = "mujoco",
    integrator: str | None = None,
    substeps: int | None = None,
    T: float | None = None,
) -> HeldPlant:
    """Return an engine's map s[k+1] = A s[k] + B [w; f][k] over T [s] (default: the scenario's period).

    The engine makes one step from each basis state and with each input alone.
    """
    period, simulation = simulation.scenario.T if T is None else T, simulation.even
    stepped = make_engine(simulation, engine, integrator, substeps, period)
    states, inputs = simulation.plant.B.shape
    buffer = StepBuffer(simulation.process, 1, states, inputs - simulation.process.channels)
    columns = []
    with quiet_warnings():
        for unit in _UNIT * np.eye(states + inputs):
            buffer.plant_row[0][:, 0] = unit
            stepped.start(buffer)
            stepped.advance(0)
            columns.append(buffer.plant_state[1][:, 0] / _UNIT)
    step = np.stack(columns, axis=1)
    return HeldPlant(step[:, :states], step[:, states:], simulation.plant.C, period)


def simulated_growth(
    simulation: Simulation, integrator: str | None, substeps: int | None, engine: AnyEngine = "mujoco"
) -> float:
    """Return the growth rate [1/s] of the loop with an engine's map; with walls, the largest for any touched walls.

    Raises InputError if a tick of the engine gives numbers that are not finite.
    """
    held = _measured_hold(simulation, engine, integrator, substeps)
    if not all(np.isfinite(part).all() for part in (held.A, held.B)):
        raise InputError(f"engine {engine_name(engine)}: a tick from rest gives numbers that are not finite")
    return max(float(dominant_mode(close(held, F)).growth) for F in simulation.process.law.frozen().values())
