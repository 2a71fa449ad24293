"""Run a controller tick by tick on the host, and certify its coupling for the measured delay of the link.

The link takes `link` ticks from a sample to the latch of its force, for every axis; several boards add `behind` ticks.
Where a channel's delay theta_i in the scenario is longer, the host delays its force by the remaining ticks. The loop
therefore has the scenario's delays unless the link is slower; then some delays are longer. Where the device latches a
force on arrival, `link` is 0, and the measured latency replaces the scenario's.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from operator import sub
from typing import NamedTuple, Protocol

import numpy as np

from haptic_loop.controller.budget import BudgetFigures, EnergyBudget, Packets, Shell
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.law import Law
from haptic_loop.controller.loop import DelayRange
from haptic_loop.controller.lti import Array
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import limiter_rho, required_damping
from haptic_loop.design.conditions import Condition
from haptic_loop.design.result import Chosen, Design, DesignFailed
from haptic_loop.hw import monitor
from haptic_loop.hw.encoders import CheckedAxes, EncoderMonitor, EncoderTest, Expected
from haptic_loop.hw.limits import Heat, Units, largest_pulse, next_gain
from haptic_loop.hw.protocol import MAX_THETA, Config, SafetyStop, State
from haptic_loop.models.scene import quiet_warnings
from haptic_loop.sim.couplings import assessed, choose, given
from haptic_loop.sim.scenario import InputError, Scenario, is_world
from haptic_loop.sim.world import START_J, scene_of

#: relative clock difference of boards with ceramic resonators, which a certificate covers by a longer T_max
CLOCK_TOLERANCE = 5e-3
_SPEED_SECONDS = 0.01  # [s] window of a speed estimate; one count of the coarsest encoder per window is 0.03 m/s
_JOLT = 20.0  # [N] motor and hand together never apply this force for one tick and its opposite for the next
_FALLBACK = ("spring-damper", "any-environment")  # kind and condition of a reserve if the requested kind gives none


class Controller(Protocol):
    """A controller that computes a force for a displacement at every tick."""

    T: float  # [s]

    def step(self, x: Sequence[float]) -> Sequence[float]: ...  # (m,) [m] to forces fed back (m,) [N]


class _HostController:
    """A control law that starts at rest and advances one tick per call."""

    def __init__(self, law: Law) -> None:
        F = law.open
        n, m = F.order, F.inputs
        before, after = np.zeros((n + m, 1)), np.zeros((n + m, 1))
        self.F, self.T = F, F.T
        self._state, self._x, self._f, self._next = before[:n], before[n:, 0], after[:m, 0], after[m:]
        self._tick = partial(law.transition(), before, after)

    def step(self, x: Sequence[float]) -> list[float]:
        """Return forces (m,) [N] for displacements x (m,) [m] and advance the state by one tick."""
        self._x[:] = x
        self._tick()
        self._state[:] = self._next
        return self._f.tolist()


def host_controller(
    scenario: Scenario,
    coupling: Coupling,
    link: int,
    cap: Sequence[float],
    lag: Sequence[float] | None = None,
    behind: Sequence[int] = (),
) -> Controller:
    """Return a controller for the scenario's loop, at rest and without the delay that the link adds.

    The link adds `link` ticks; several boards add `behind` (m,) more. With `lag`, the rho (m,) [N/m] of a limiter,
    forces are limited to `cap` (m,) [N], or as vectors where the scenario limits vectors.
    Raises ValueError where the link is slower than a delay of the loop.
    """
    loop, theta = scenario.loop("I"), scenario.theta  # The case changes no force.
    waits = tuple(n - link - more for n, more in zip(theta, behind or (0,) * len(theta), strict=True))
    return _HostController(loop.delayed(waits).law(coupling, cap, lag, scenario.limiter_limits[1]))


def _fill(previous: tuple[float, ...], x: tuple[float, ...], ticks: int) -> list[tuple[float, ...]]:
    """Interpolate linearly from `previous` to x (m,) [m] over `ticks` ticks, of which only the last was received.

    Without interpolation, a damper B would answer a displacement dx with a force of B dx/T.
    """
    line = [tuple(a + (b - a) * (i / ticks) for a, b in zip(previous, x, strict=True)) for i in range(1, ticks)]
    return [*line, x]


@dataclass(frozen=True)
class BudgetPlan:
    """The parameters of an energy budget for one arming, as plain data that a replay can read."""

    start: float  # W0 [J]
    cap: float | None  # [J] largest budget, None for no limit
    delta: tuple[float, ...]  # (m,) [N s/m] guaranteed damping
    encoder_step: tuple[float, ...]  # (m,) [m]
    force_step: tuple[float, ...]  # (m,) [N]
    theta: int  # [ticks]
    longer: int  # ticks beyond theta for which an older force may act
    T: float  # [s]

    @classmethod
    def of(cls, start: float, cap: float, delta: Sequence[float], units: Units, config: Config, T: float) -> BudgetPlan:
        """Return the plan for a device of this configuration.

        The device holds a force for `hold` missed ticks, then ramps it to zero. Because of its slew rate, an older
        force still acts in up to ceil(config.cap / config.slew) later ticks with an answer. Up to `hold` missed ticks
        precede each of these ticks. Afterwards, the applied force lies between forces that were sent later.
        """
        slews = max(math.ceil(cap / slew) for cap, slew in zip(config.cap, config.slew, strict=True))
        longer = slews * (config.hold + 1) + config.ramp
        most = None if math.isinf(cap) else cap
        return cls(start, most, tuple(delta), units.encoder_step, units.force_step, config.theta, longer, T)


class SentBudget:
    """The energy budget that limits forces after gain, caps and slew rate. It truncates them to whole steps."""

    def __init__(self, plan: BudgetPlan) -> None:
        m, cap = len(plan.delta), math.inf if plan.cap is None else plan.cap
        packets, step = Packets(np.full(m, plan.theta), hold=plan.longer), plan.encoder_step
        self.plan = plan
        self._budget = EnergyBudget(plan.delta, plan.T, packets, encoder_step=step, start=plan.start, cap=cap)
        self._unit = -np.array(plan.force_step)  # the wire carries -f
        self._before = self._applied = np.zeros(m)
        self._nothing = np.zeros((m, 1))

    def limit(self, steps: Sequence[int], x: Sequence[float], applied: Array, missed: int) -> tuple[int, ...]:
        """Return the steps to send in place of `steps` at x (m,) [m]; f = `applied` (m,) [N] acts from this tick on.

        In the `missed` ticks before this one nothing was received or sent. Their motion is unknown, so each of these
        ticks is booked with the largest energy that it may have cost.
        """
        now, wanted = np.array(x), (np.array(steps) * self._unit)[:, None]
        for _ in range(missed):
            self._budget.limit(self._nothing, self._nothing)
        moved = (now - self._before)[:, None]
        sent = self._budget.limit(wanted, moved, None if missed else self._applied[:, None])[:, 0]
        self._before, self._applied = now, applied
        rounded = np.where(sent == wanted[:, 0], steps, np.trunc(sent / self._unit))
        return tuple(int(n) for n in rounded)

    @property
    def spent(self) -> float:
        """Upper bound [J] of the energy that the forces sent so far take from W0; at least 0."""
        return max(0.0, self.plan.start - float((self._budget.energy - self._budget.reserved)[0]))

    def figures(self, assessment: Assessment | None) -> BudgetFigures:
        """Return the figures of the budget since arming, with the guarantee of the assessment that includes it."""
        stated = assessment and assessment.guarantee
        if stated is None or stated.energy_J != self.plan.start:
            return self._budget.figures("no guarantee: the coupling was assessed without this energy budget")
        # A longer tick dissipates less than the budget credits, so that its energy has no bound.
        ticks = f"in an arming in which no tick lasts longer than {1e3 * self.plan.T:.4g} ms"
        return self._budget.figures(f"{stated.words}, {ticks}")


class WorldController:
    """A MuJoCo scene behind a coupling, with an energy shell that accounts for the forces that are sent.

    Each tick calls `step`, then `limit` with the forces after gain, caps and rounding to whole steps. The shell treats
    gain, caps and rounding as a part of the environment. For a tick without an answer, the shell books the force that
    the device holds.

    A force that tests a motor bypasses the coupling, so an energy budget measures its energy at the device. That
    budget starts with the energy of the shell, and its spent energy is charged to the shell afterwards. So shell and
    budget together give at most W0 beyond what the scene released.
    """

    def __init__(
        self, scenario: Scenario, coupling: Coupling, start: float, cap: Sequence[float], waits: Sequence[int]
    ) -> None:
        """Take W0 = `start` [J] and `waits` (m,), the ticks by which the host delays its forces. Raises InputError."""
        V = coupling.compliance(scenario.T)
        scene = scene_of(scenario, coupling)  # raises InputError for a coupling without V
        assert V is not None
        self.T, self.port, self.shell = scenario.T, scene.port(cap, scenario.balls), Shell(V, start=start)
        self.least = 0.0  # [J] least value so far of the sum of f'(u[k] - u[k-1]), with positions u of the contacts
        self.seconds: list[float] = []  # CPU time of each step of the scene
        self._start, self._sent = start, np.zeros((len(waits), 1))
        self._open = False  # whether the shell has not yet booked the force of the current tick
        self._lines = [deque([0] * n) for n in waits]
        self._test: SentBudget | None = None
        self._tested = 0.0  # [J] energy charged for motor tests

    def step(self, x: Sequence[float]) -> list[float]:
        """Return the scene's forces (m,) [N] for displacements x (m,) [m]."""
        if self._open:
            self.shell.book(self._sent)
        free = self.shell.free(np.array(x)[:, None])
        began = time.thread_time()
        with quiet_warnings():
            wanted = self.port.step(free[:, 0])
        self.seconds.append(time.thread_time() - began)
        self.shell.credit([self.port.released])
        self._open = True
        return wanted.tolist()

    def limit(self, steps: Sequence[int], unit: Sequence[float]) -> tuple[int, ...]:
        """Reduce `steps` to whole steps that the shell allows; one step is -`unit` (m,) [N]."""
        each = -np.array(unit)[:, None]
        wanted = np.array(steps)[:, None] * each
        self._sent, _ = self.shell.limit(wanted, lambda f: np.where(f == wanted, f, np.trunc(f / each) * each))
        self._open = False
        self.least = min(self.least, float(self.shell.energy[0]) + self._tested - self._start - self.port.released)
        return tuple(int(n) for n in np.round(self._sent / each)[:, 0])

    def limit_test(
        self, plan: BudgetPlan, steps: Sequence[int], x: Sequence[float], applied: Array, missed: int
    ) -> tuple[int, ...]:
        """Return the steps of a test force that the energy of the shell allows, in place of `steps`.

        The handles are at x (m,) [m], f = `applied` (m,) [N] acts from this tick on, and the `missed` ticks before it
        had no STATE. `plan` has the parameters of the energy budget.
        """
        if self._test is None:
            start, missed = float(self.shell.energy[0]), 0
            self._test = SentBudget(replace(plan, start=start, cap=max(start, self._start)))
        return self._test.limit(steps, x, applied, missed)

    def end_test(self) -> None:
        """Charge the shell with the energy of the motor test that has ended, if any."""
        if self._test is not None:
            self.shell.charge(self._test.spent)
            self._tested, self._test = self._tested + self._test.spent, None

    def later(self, steps: Sequence[int], ticks: int) -> tuple[int, ...]:
        """Put `steps`, computed `ticks` ticks after the last call, into the delay lines. Return the steps to send."""
        sent = []
        for line, step in zip(self._lines, steps, strict=True):
            line.extend([line[-1] if line else step] * (ticks - 1) + [step])
            sent.append([line.popleft() for _ in range(ticks)][-1])
        return tuple(sent)


class TraceRow(NamedTuple):
    """One tick of a trace. If `state` is None, no STATE came: x is interpolated and nothing was sent."""

    tick: int  # modulo 2^16
    x: tuple[float, ...]  # (m,) [m]
    asked: Sequence[float]  # (m,) [N] force that the controller computed
    gain: float
    sent: tuple[int, ...]  # [steps]
    state: State | None
    arming: int = 0  # number of the arming in the session
    test: tuple[float, ...] | None = None  # (m,) [N] force of the encoder test, which the gain does not scale
    limited: bool = False  # whether an energy account made the force smaller


@dataclass(frozen=True, eq=False)
class Arming:
    """The program, configuration and energy budget of one arming."""

    number: int  # counts the armings of a session from 0
    program: Armable
    config: Config  # configuration of the device
    budget: SentBudget | None = None
    test_plan: BudgetPlan | None = None  # plan for motor tests in a world with theta > 0; otherwise None


class Drive:
    """The controller, limits and monitors that compute forces during one arming."""

    def __init__(
        self,
        arming: Arming,
        axes: CheckedAxes,
        expected: Expected,
        settings: monitor.LinkSettings,
        counters: monitor.Counters,
        record: Callable[[TraceRow], None],
    ) -> None:
        """Take `expected`, which predicts the motions of `axes` in their tests."""
        (limits, units, T, still), config = axes, arming.config
        self.limits, self.units, self.T, self.config = limits, units, T, config
        self.controller = arming.program.controller(limits.cap)
        self.gain = 0.0  # factor of the controller's forces
        self.ended = False  # whether the gain has fallen to 0 and the last motor test, if any, is passed
        self.force = (0.0,) * config.axes  # [N] last force sent
        self.x: tuple[float, ...] | None = None  # [m] displacements of the last STATE
        self.reference: tuple[int, ...] | None = None  # [counts] origin of the displacements
        self._rereference = settings.rereference
        first = EncoderTest(axes, expected, config.theta == 0)
        last = EncoderTest(axes, expected, config.theta == 0, first.sizes)
        self._test = first if settings.test_encoders else None
        self._last_test = last if settings.test_encoders and not settings.identifies else None
        self.remarks = first.remarks  # what the test at arming could not judge
        self.encoders = EncoderMonitor(axes)
        self._heat = Heat(limits, T)
        self._window = max(2, round(_SPEED_SECONDS / T))  # [ticks] window of a speed estimate
        self._recent = deque[tuple[float, ...]](maxlen=self._window + 1)  # [m] displacements tick by tick
        self._path = deque[tuple[float, ...]](maxlen=4)  # [m] displacements of the last STATEs
        self._gaps = deque[tuple[int, float]](maxlen=3)  # ticks between them, and how far their time [s] is from T each
        late = settings.behind or (0,) * config.axes
        noise = np.multiply(still, units.encoder_step).tolist()
        #: (m,) mass [kg], mode of the transmission [rad/s], noise of a position [m], and whether samples may repeat
        self._axes = [*zip(expected.mass, expected.mode, noise, (behind > 0 for behind in late), strict=True)]
        self._identifies = settings.identifies
        self._weighs = settings.test_encoders and not settings.identifies  # whether the mass is known
        self._clock_us = 0  # the device's clock at the last STATE
        self.world = self.controller if isinstance(self.controller, WorldController) else None
        self._counters, self._record, self._arming = counters, record, arming
        # With several boards, each board has its own monitor (hw/boards.py).
        self._commands = None if settings.behind else monitor.CommandMonitor(config)
        self._clock = monitor.ClockMonitor(limits.watchdog_us, T)

    @property
    def request(self) -> str | None:
        """Return what the person at the device must do before the motor test at the end can go on, or None."""
        return self._last_test.request if self._last_test else None

    def step(self, state: State, ticks: int, direction: int, now: int, closing: bool = False) -> tuple[int, ...]:
        """Return the force [steps] for `state`, which came at `now` [us], `ticks` ticks after the previous STATE.

        The gain rises (direction 1), falls (-1) or stays (0); it rises only after every encoder has passed its test.
        With `closing`, the motors are tested once more after the gain has fallen to 0.
        Raises SafetyStop where the device, an encoder or the controller is out of bounds.
        """
        if self.x is None:
            ticks = 1  # ticks before the arming are no gap
        self._clock.check(state, ticks, now)
        self.units.check_range(state.counts)
        if self.reference is None:
            self.reference = state.counts if self._rereference else (0,) * state.axes
        x = self.units.positions(map(sub, state.counts, self.reference))
        lasted, self._clock_us = (state.t_us - self._clock_us) % 2**32, state.t_us
        positions = _fill(self.x or x, x, ticks)  # one for each of the last `ticks` ticks
        self._check_motion(positions, 1e-6 * lasted)
        if self._commands:
            self._counters.unlike += self._commands.unlike(state, ticks)
        # Before the gain rises only test forces act. A chirp also moves a handle by less than a count.
        if self.gain > 0 and not self._identifies:
            self.encoders.check(state.counts, state.applied, ticks)
        if self.limits.continuous:
            self._heat.check(self.units.forces(state.applied), ticks)
        for k, between in enumerate(positions[:-1], start=1 - ticks):  # ticks without a STATE
            tick, wanted = (state.tick + k) & 0xFFFF, self._wanted(between)
            self._record(TraceRow(tick, between, wanted, self.gain, (), None, self._arming.number))
        wanted = self._wanted(x)
        test = None
        if direction > 0:
            test = self._test.force(state, ticks) if self._test else None
            if test is None:
                self._test = None
                self.gain = next_gain(self.gain, ticks * self.T)
        elif direction < 0:
            self.gain = next_gain(self.gain, -ticks * self.T)
            if closing and self._last_test and self.gain == 0:
                test = self._last_test.force(state, ticks)
            self.ended = self.gain == 0 and test is None
        shaped = self.limits.shape(wanted, self.force, self.gain, self.T, test)
        steps = self.units.steps(shaped.force, self.config.cap, self.limits.vectors)
        allowed = sent = steps
        if self._arming.budget or self.world:
            allowed, sent = self._within_energy(steps, test, state, x, ticks)
        limited = allowed != steps
        self.x, self.force = x, self.units.forces(allowed) if limited else shaped.force
        self._counters.clipped += shaped.clipped
        self._counters.slowed += shaped.slowed
        self._counters.limited += limited
        if self._commands:
            self._commands.tell(state.tick, sent)
        self._record(TraceRow(state.tick, x, wanted, self.gain, sent, state, self._arming.number, test, limited))
        return sent

    def _wanted(self, x: Sequence[float]) -> Sequence[float]:
        """Return the controller's force (m,) [N]. A force that identifies a device begins after the test."""
        return (0.0,) * len(x) if self._identifies and self._test else self.controller.step(x)

    def _within_energy(
        self,
        steps: tuple[int, ...],
        test: tuple[float, ...] | None,
        state: State,
        x: tuple[float, ...],
        ticks: int,
    ) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the steps that the energy accounts allow, and those to send now, as a world may delay its forces.

        In a world, a `test` force replaces the scene's force.
        """
        tick = x, np.array(self.units.forces(state.applied)), ticks - 1
        if self._arming.budget:
            steps = self._arming.budget.limit(steps, *tick)
        if self.world is None:
            return steps, steps
        nothing, plan = (0,) * len(steps), self._arming.test_plan
        pushes = plan is not None and test is not None and any(test)
        allowed = self.world.limit(nothing if pushes else steps, self.units.force_step)
        sent = self.world.later(allowed, ticks)
        if plan is None or test is None:
            self.world.end_test()
            return allowed, sent
        tested = self.world.limit_test(plan, steps if pushes else nothing, *tick)
        if not pushes:
            return allowed, sent
        return tested, tuple(max(-c, min(c, a + b)) for a, b, c in zip(sent, tested, self.config.cap, strict=True))

    def _check_motion(self, positions: Sequence[tuple[float, ...]], seconds: float) -> None:
        """Raise SafetyStop where handles jumped, or moved faster than the speed limit.

        `positions` (m,) [m] are those of the ticks since the last STATE, which lasted `seconds`.
        """
        x, ticks = positions[-1], len(positions)
        if self.x is not None:
            self.limits.check_jump(x, self.x, ticks)
        self._path.append(x)
        self._gaps.append((ticks, abs(seconds - ticks * self.T)))
        if len(self._path) == 4:
            gaps, uneven = zip(*self._gaps, strict=True)
            self.limits.check_jolt(self._path, gaps, self._largest_jumps(gaps, max(uneven)))
        self._recent.extend(positions)
        if (since := len(self._recent) - 1) >= self._window // 2:
            self.limits.check_speed(x, self._recent[0], since * self.T)

    def _largest_jumps(self, gaps: tuple[int, int, int], uneven: float) -> list[float]:
        """Return the largest jump (m,) [m] of each axis over `gaps` [ticks] that is not an error of its encoder.

        It is the largest pulse of a motion, or any jump up to the limit of `jump` if the mass is unknown. The noise of
        positions, ticks that are longer or shorter by `uneven` [s], and a repeated sample add to it.
        """
        limits, T, (p, q, r) = self.limits, self.T, gaps
        both = 1 + q / min(p, r)  # An error of one position changes the speeds on both of its sides.
        if not self._weighs:
            return [limits.jump * q] * len(self._axes)
        return [
            largest_pulse(gaps, T, _JOLT * limits.lever * T**2 / mass, mode, limits.speed)
            + both * (noise + limits.speed * uneven)
            + limits.speed * T * repeats
            for mass, mode, noise, repeats in self._axes
        ]


# couplings that are certified for a link


def timed(
    scenario: Scenario, ages: monitor.Ages, quantile: float, guard_us: float, at_once: bool = False
) -> tuple[Scenario, int]:
    """Return the scenario with the measured T_max, T_min and latency, and the ticks that the link takes.

    T_max becomes the length that a fraction `quantile` of the device's ticks does not exceed, where that is longer than
    the scenario's T_max or T. With known devices T_min becomes the length that this fraction of ticks has at least,
    where that is shorter than the scenario's T_min or T. With `at_once`, forces latch on arrival and the link takes 0
    ticks. The latency then ranges from the least age to the quantile of the ages, widened by `guard_us` [us] on both
    sides. Raises SafetyStop where too few answers arrived, or the latency reaches a period.
    """
    T_us = 1e6 * scenario.T
    longest, known = ages.longest_tick(T_us, quantile), scenario.T_max or scenario.T
    if longest > 1e6 * known:
        scenario = scenario.replace(T_max=1e-6 * longest)
    shortest = ages.shortest_tick(T_us, quantile)
    if scenario.known_devices and shortest < 1e6 * (scenario.T_min or scenario.T):
        scenario = scenario.replace(T_min=1e-6 * shortest)
    if not at_once:
        return scenario, ages.link_delay(T_us, quantile, guard_us)
    least, most = max(0.0, min(ages.values) - guard_us), ages.quantile(quantile) + guard_us
    if most >= (least_tick := min((T_us, *ages.ticks))):
        instead = "use a longer T, or a microcontroller with --latch tick"
        raise SafetyStop(
            f"answers come up to {most:.0f} us after their tick, guard included; "
            f"the shortest tick is {least_tick:.0f} us, which must be longer: {instead}"
        )
    return scenario.replace(latency=((1e-6 * least, 1e-6 * most),) * scenario.channels), 0


class Armable(Protocol):
    """A program that a session can be armed with."""

    @property
    def link(self) -> int: ...  # ticks from a sample to the latch of its force
    @property
    def certified(self) -> bool: ...  # whether the program is certified for every passive human
    @property
    def name(self) -> str: ...  # name in the log
    @property
    def margin_us(self) -> float: ...  # [us] least State.margin_us of an answer that is not late
    def controller(self, cap: Sequence[float]) -> Controller: ...  # return a new controller for `cap` (m,) [N]


@dataclass(frozen=True, eq=False)
class CertifiedCoupling:
    """A coupling with the delay that it is certified for."""

    link: int  # [ticks]
    scenario: Scenario  # the session's scenario with the delays of the certified loop
    case: str
    chosen: Chosen
    assessment: Assessment  # holds for the loop with these delays
    behind: tuple[int, ...] = ()  # (m,) [ticks] that boards add to the link

    @property
    def certified(self) -> bool:
        """True if this loop has a guarantee and the user's own condition, if any, holds."""
        return self.assessment.guarantee is not None and not self.chosen.fails(self.assessment.requirements)

    @property
    def name(self) -> str:
        latency = self.scenario.latency
        late = f" and {1e6 * latency[0][0]:.0f} to {1e6 * latency[0][1]:.0f} us" if latency else ""
        return f"{self.chosen.kind} for theta = {list(self.scenario.theta)}{late}"

    @property
    def margin_us(self) -> float:
        latency = self.scenario.latency
        return 1e6 * (self.scenario.T - max(most for _, most in latency)) if latency else 0.0

    @property
    def held(self) -> int:
        """The number of missed answers in a row for which the coupling's file proves that a force may be held."""
        span, theta = self.chosen.switching, self.scenario.theta
        if span is None or is_world(self.scenario) or not span.contains(DelayRange(theta, theta)):
            return 0  # In a world, the energy shell is proved for constant delays only.
        return min(hi - n for hi, n in zip(span.hi, theta, strict=True))

    def controller(self, cap: Sequence[float]) -> Controller:
        lag, start = self.assessment.force_limits.rho, self.assessment.force_limits.energy_budget
        if is_world(self.scenario):
            waits = [n - self.link for n in self.scenario.theta]
            return WorldController(self.scenario, self.chosen.coupling, start or 0.0, cap, waits)
        return host_controller(self.scenario, self.chosen.coupling, self.link, cap, lag, self.behind)

    def capped(self, cap: Sequence[float]) -> Assessment:
        """Return the assessment with the force cap (m,) [N] of a session; no proof depends on this cap."""
        return self.assessment.within(cap)

    def remarks(self) -> list[str]:
        """Return remarks on the file, the user's conditions, held torques, walls, latency and missed answers."""
        said = [*self.chosen.remarks(self.assessment.requirements)]
        if torques := self.assessment.held_torques:
            said.append(f"held torques: {torques}")
        if self.scenario.balls and self.scenario.environment.walls:
            said.append(
                "in front of walls, forces are limited axis by axis, to the box inside the limit of each force vector"
            )
        if self.scenario.latency:
            least, most = (1e6 * t for t in self.scenario.latency[0])
            facts = f"periods up to {1e6 * (self.scenario.T_max or self.scenario.T):.0f} us"
            facts += f" and forces that act {least:.0f} to {most:.0f} us after their sample"
            return [*said, f"forces act as they come: certified for {facts}, as measured"]
        budgeted = self.assessment.force_limits.energy_budget is not None  # The budget counts held forces itself.
        if self.held < 1 or budgeted:
            return said
        answers = "1 missed answer" if self.held == 1 else f"{self.held} missed answers in a row"
        rho = limiter_rho(self.scenario.loop(self.case), self.chosen.certificate)  # that of the file's proof
        below = "" if rho and rho == self.assessment.force_limits.rho else " while forces stay below their limits"
        return [*said, f"a force that is held through {answers} is covered by the file's proof{below}"]


@dataclass(frozen=True, eq=False)
class CouplingRequest:
    """The coupling that a session asks for. The delay of the link is a separate argument."""

    scenario: Scenario
    case: str = "I"
    name: str | None = None  # kind or file of the coupling; None: the default kind
    condition: str | Condition | None = None
    own: Coupling | Design | None = None  # the user's coupling, used instead of `name`
    limiter: bool | None = None  # False: the coupling's limiter does not limit the forces
    behind: tuple[int, ...] = ()  # (m,) ticks that several boards, each with its own clock, add to the link
    start: float = START_J  # W0 [J] of the energy shell, which limits the forces of a MuJoCo world
    energy_budget: float | None = None  # W0 [J] of a budget for the forces outside of worlds


def certified_coupling(request: CouplingRequest, link: int) -> CertifiedCoupling:
    """Return the requested coupling, certified for a link of `link` ticks (0: forces act on arrival).

    A coupling must be certified without its energy budget, but its guarantee is then that of the budget. With several
    boards, the longest period that the certificate covers is longer by the share CLOCK_TOLERANCE.

    Raises SafetyStop where the coupling is not certified, InputError where the request contradicts itself.
    """
    scenario, case, behind, limiter = request.scenario, request.case, request.behind, request.limiter
    if link > MAX_THETA:
        raise SafetyStop(f"the link takes {link} ticks, the protocol carries at most theta = {MAX_THETA}")
    later = behind or (0,) * scenario.channels
    delays = tuple(max(n, link + more) for n, more in zip(scenario.theta, later, strict=True))
    slower = scenario.replace(theta=delays, latency=None if link else scenario.latency)
    if behind:
        # No shortest period is known, because the clocks drift.
        slower = slower.replace(T_max=(scenario.T_max or scenario.T) * (1 + CLOCK_TOLERANCE), T_min=None)
    try:
        if request.own is None:
            chosen = choose(slower, case, request.name, request.condition, limiter)
        else:
            chosen = given(request.own)
    except DesignFailed as error:
        raise SafetyStop(f"no coupling for a link of {link} tick{'s' * (link != 1)}: {error}") from None
    alone = slower.replace(ranges=None) if slower.ranges else slower  # only the nominal environment is rendered
    if is_world(alone):
        assessment = assessed(alone, case, chosen, energy_budget=request.start, limiter=False)
    else:
        assessment = assessed(alone, case, chosen, limiter=limiter)
    spare = (n - more for n, more in zip(slower.theta, later, strict=True))
    waits = min(MAX_THETA, *spare) if link else 0  # ticks that the device waits; the host adds the rest of theta
    certified = CertifiedCoupling(waits, slower, case, chosen, assessment, behind)
    if not certified.certified:
        named = "the loop without coupling" if chosen.kind == "none" else f"the coupling {chosen.kind}"
        raise SafetyStop(f"{named} is not certified for theta = {list(slower.theta)}: {_shortfall(certified)}")
    if request.energy_budget is None or is_world(alone):
        return certified
    assessment = assessed(alone, case, chosen, energy_budget=request.energy_budget, limiter=limiter)
    if assessment.guarantee is None:
        raise SafetyStop(f"with an energy budget the coupling is not certified: {assessment.reason}")
    return replace(certified, assessment=assessment)


def certified_couplings(request: CouplingRequest, link: int, spare: int = 2) -> tuple[CertifiedCoupling, ...]:
    """Return the coupling for the measured delay, and up to `spare` reserves, each for a link slower by one tick.

    Where forces act on arrival, there is one reserve, for latencies up to almost a tick.
    A reserve is softer at rest than the previous coupling on every channel whose delay is longer, and stiffer on no
    channel. It needs less damping than the previous coupling would need with the delays of the reserve. A reserve has
    the kind of the first coupling, or comes from the same file. Where such a reserve is not certified or not softer, a
    spring-damper is designed by Theorem 4, which has the strongest guarantee, or by the user's own condition. If this
    fails, too, the list ends. Raises SafetyStop where the first coupling is not certified.
    """
    candidates = [certified_coupling(request, link)]
    kind, condition = _FALLBACK
    if candidates[0].chosen.own is not None:
        condition = request.condition
    wanted = [request, replace(request, name=kind, condition=condition)]
    while len(candidates) <= spare and wanted:
        reserve = None
        with suppress(SafetyStop, InputError):
            reserve = _slower(wanted[0], candidates[-1])
        if reserve and _softer(reserve, candidates[-1]):
            candidates.append(reserve)
        else:
            wanted.pop(0)
    return tuple(candidates)


_LATEST = 0.95  # A reserve is designed for latencies of up to this share of the shortest period.


def _slower(request: CouplingRequest, than: CertifiedCoupling) -> CertifiedCoupling:
    """Return the requested coupling for a link slower than that of `than`. Raises SafetyStop or InputError."""
    scenario = than.scenario
    if scenario.latency is None:
        return certified_coupling(request, than.link + 1)
    latest = _LATEST * (scenario.T_min or scenario.T)
    if max(most for _, most in scenario.latency) >= latest:
        raise SafetyStop("forces that act on arrival must arrive within their tick")
    spans = tuple((least, latest) for least, _ in scenario.latency)
    return certified_coupling(replace(request, scenario=request.scenario.replace(latency=spans)), than.link)


_EQUAL = 1e-6  # relative difference up to which static stiffnesses count as equal: a design's search has this tolerance


def _softer(reserve: CertifiedCoupling, than: CertifiedCoupling) -> bool:
    """Return whether `reserve` needs less damping than `than`, is softer where its delay is longer, nowhere stiffer.

    Both dampings are those required in the loop with the delays of `reserve`. The stiffness is K, or, if one of the
    couplings has no K, the static stiffness that the devices feel.
    """
    own, other = (each.assessment.gains for each in (reserve, than))
    K, before = (np.array(gains.get("K", np.nan)) for gains in (own, other))
    if np.isnan(K).any() or np.isnan(before).any():
        K, before = (np.diag(_felt_at_rest(each)) for each in (reserve, than))
    later = np.greater(reserve.scenario.theta, than.scenario.theta)
    if (before * (1 + _EQUAL) < K).any() or (later & (before * (1 - _EQUAL) <= K)).any():
        return False
    loop, condition = reserve.scenario.loop(reserve.case), than.chosen.required_condition
    needs = [required_damping(loop, each.chosen.coupling, condition).ratio for each in (reserve, than)]
    return needs[0] < needs[1]


def _felt_at_rest(certified: CertifiedCoupling) -> Array:
    """Return the static stiffness (m, m) [N/m] that the devices feel; in a world, the coupling's own stiffness."""
    loop = certified.scenario.loop(certified.case)
    V = certified.chosen.coupling.compliance(loop.T) if is_world(certified.scenario) else None
    return loop.F(certified.chosen.coupling).dc() if V is None else np.linalg.inv(V.dc())


def _shortfall(certified: CertifiedCoupling) -> str:
    needs = []
    for name, requirement in certified.assessment.requirements.items():
        figures = ", ".join(f"{b:.4g}" for b in requirement.required)
        needs.append(requirement.reason or f"{name} needs {figures} of {requirement.available[0]:g} N s/m")
    return "; ".join(needs)
