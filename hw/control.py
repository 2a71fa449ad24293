"""From a displacement to the force that answers it: the controller, its certificate for the measured delay, its tick.

The link takes `link` ticks from a sample to the latch of its force, for every axis. Channels whose delay theta_i
in the scenario is longer wait for the rest, theta_i - link, on the host: the loop has the scenario's delays as long
as the link is no slower, and longer ones where it is. Where the device latches a force as soon as it comes, link is 0
and the scenario's latency is what was measured.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import sub
from typing import NamedTuple, Protocol

import numpy as np

from haptic_loop.controller.budget import BudgetFigures, EnergyBudget, Packets, Shell
from haptic_loop.controller.coupling import Coupling
from haptic_loop.controller.law import Law
from haptic_loop.controller.loop import Loop
from haptic_loop.controller.lti import Array
from haptic_loop.design.assessment import Assessment
from haptic_loop.design.certificate import required_damping
from haptic_loop.design.conditions import Condition
from haptic_loop.design.result import Chosen, Design, DesignFailed
from haptic_loop.hw import monitor
from haptic_loop.hw.limits import Gain, Heat, SafetyLimits, Units
from haptic_loop.hw.protocol import MAX_THETA, Config, SafetyStop, State
from haptic_loop.sim.couplings import assessed, choose, given
from haptic_loop.sim.scenario import InputError, Scenario, is_world
from haptic_loop.sim.world import START_J, scene_of

_SPEED_SECONDS = 0.01  # over which a speed is taken: one count of the coarsest encoder is 0.03 m/s
_FALLBACK = ("spring-damper", "any-environment")  # what softer couplings are where the one asked for cannot be had


class Controller(Protocol):
    """Answers a displacement with a force, tick by tick."""

    T: float  # [s]

    def step(self, x: Sequence[float]) -> Sequence[float]: ...  # (m,) [N] fed back for the displacements x (m,) [m]


class _HostController:
    """A law at work, tick by tick and from rest."""

    def __init__(self, law: Law) -> None:
        F = law.open
        n, m = F.order, F.inputs
        before, after = np.zeros((n + m, 1)), np.zeros((n + m, 1))
        self.F, self.T = F, F.T
        self._state, self._x, self._f, self._next = before[:n], before[n:, 0], after[:m, 0], after[m:]
        self._tick = partial(law.transition(), before, after)

    def step(self, x: Sequence[float]) -> list[float]:
        """Forces (m,) [N] for the displacements x (m,) [m]; the state moves on by one tick."""
        self._x[:] = x
        self._tick()
        self._state[:] = self._next
        return self._f.tolist()


def host_controller(
    loop: Loop, coupling: Coupling, link: int, cap: Sequence[float], lag: Sequence[float] | None = None
) -> Controller:
    """The loop as the host runs it, at rest: the link adds the remaining delay. Raises ValueError where it is too long.

    With `lag`, rho (m,) [N/m], forces leave through a limiter of `cap` (m,) [N].
    """
    return _HostController(loop.delayed(tuple(n - link for n in loop.theta)).law(coupling, cap, lag))


def _fill(previous: Sequence[float], x: Sequence[float], ticks: int) -> list[tuple[float, ...]]:
    """Displacements for `ticks` ticks of which only the last was received: a straight line from `previous` to x.

    A step would look to a damper like a blow of (dx/T) times its B.
    """
    line = [tuple(a + (b - a) * (i / ticks) for a, b in zip(previous, x, strict=True)) for i in range(1, ticks)]
    return [*line, tuple(x)]


@dataclass(frozen=True)
class BudgetPlan:
    """An energy budget for one arming, as plain data: what a replay needs to know."""

    start: float  # W0 [J]
    cap: float | None  # [J], None where there is none
    delta: tuple[float, ...]  # (m,) [N s/m]
    encoder_step: tuple[float, ...]  # (m,) [m]
    force_step: tuple[float, ...]  # (m,) [N]
    theta: int  # [ticks]
    longer: int  # ticks for which an older force may act beyond theta
    T: float  # [s]

    @classmethod
    def of(cls, start: float, cap: float, delta: Sequence[float], units: Units, config: Config, T: float) -> BudgetPlan:
        """For a device of this configuration.

        It holds a force for `hold` missed ticks and lets go of it in a ramp. Limited by its slew rate, a force is
        for so many ticks that are not missed as large as older ones, and then within what was sent since.
        """
        slews = max(math.ceil(cap / slew) for cap, slew in zip(config.cap, config.slew, strict=True))
        longer = slews * (config.hold + 1) + config.ramp
        most = None if math.isinf(cap) else cap
        return cls(start, most, tuple(delta), units.encoder_step, units.force_step, config.theta, longer, T)


class SentBudget:
    """The energy budget between the shaped forces and the line. Forces are whole steps, so it rounds towards zero."""

    def __init__(self, plan: BudgetPlan) -> None:
        m, cap = len(plan.delta), math.inf if plan.cap is None else plan.cap
        packets, step = Packets(np.full(m, plan.theta), hold=plan.longer), plan.encoder_step
        self.plan = plan
        self._budget = EnergyBudget(plan.delta, plan.T, packets, encoder_step=step, start=plan.start, cap=cap)
        self._unit = -np.array(plan.force_step)  # the wire carries -f
        self._before = self._applied = np.zeros(m)
        self._nothing = np.zeros((m, 1))

    def limit(self, steps: Sequence[int], x: Sequence[float], applied: Array, missed: int) -> tuple[int, ...]:
        """What to send instead of `steps`, at x (m,) [m]; f = `applied` (m,) [N] acts from this tick on.

        Of `missed` ticks before this one nothing was received, and nothing was sent in them: what moved in them is
        not known, so that they are booked as the most that they may have lost.
        """
        now, wanted = np.array(x), (np.array(steps) * self._unit)[:, None]
        for _ in range(missed):
            self._budget.limit(self._nothing, self._nothing)
        moved = (now - self._before)[:, None]
        sent = self._budget.limit(wanted, moved, None if missed else self._applied[:, None])[:, 0]
        self._before, self._applied = now, applied
        whole = np.where(sent == wanted[:, 0], steps, np.trunc(sent / self._unit))
        return tuple(int(n) for n in whole)

    def figures(self) -> BudgetFigures:
        """What it has done since arming."""
        given = f"more than {self.plan.start:g} J" if self.plan.start else "any energy"
        dissipated = "in an arming beyond what the devices dissipate, whatever computes the forces"
        return self._budget.figures(f"no passive hand is given {given} {dissipated}")


class WorldController:
    """A MuJoCo scene behind a coupling, and the energy shell that counts the forces as they are sent.

    Every tick is `step`, then `limit` for what the session makes of the forces: gain, caps and whole steps are for the
    shell a part of the environment. Of a tick without an answer it counts the force that the device holds.
    """

    def __init__(
        self, scenario: Scenario, coupling: Coupling, start: float, cap: Sequence[float], waits: Sequence[int]
    ) -> None:
        """`start` is W0 [J], `waits` (m,) the ticks by which the host delays what it sends. Raises InputError."""
        V = coupling.compliance(scenario.T)
        scene = scene_of(scenario, coupling)  # raises InputError for a coupling without V
        assert V is not None
        self.T, self.port, self.shell = scenario.T, scene.port(cap), Shell(V, start=start)
        self.least = 0.0  # [J] of the sum of f'(u - u_-) so far
        self.seconds: list[float] = []  # of the processor, for each step of the scene
        self._start, self._sent = start, np.zeros((len(waits), 1))
        self._open = False  # whether a tick was begun whose force is not counted yet
        self._lines = [deque([0] * n) for n in waits]

    def step(self, x: Sequence[float]) -> list[float]:
        """Forces (m,) [N] of the scene for the displacements x (m,) [m]."""
        if self._open:
            self.shell.book(self._sent)
        free = self.shell.free(np.array(x)[:, None])
        began = time.thread_time()
        wanted = self.port.step(free[:, 0])
        self.seconds.append(time.thread_time() - began)
        self.shell.credit([self.port.released])
        self._open = True
        return wanted.tolist()

    def limit(self, steps: Sequence[int], unit: Sequence[float]) -> tuple[int, ...]:
        """What the shell lets through of `steps`, which are -`unit` (m,) [N] each: whole steps again."""
        each = -np.array(unit)[:, None]
        wanted = np.array(steps)[:, None] * each
        self._sent, _ = self.shell.limit(wanted, lambda f: np.where(f == wanted, f, np.trunc(f / each) * each))
        self._open = False
        self.least = min(self.least, float(self.shell.energy[0]) - self._start - self.port.released)
        return tuple(int(n) for n in np.round(self._sent / each)[:, 0])

    def later(self, steps: Sequence[int], ticks: int) -> tuple[int, ...]:
        """What is to be sent now where `steps` are new, `ticks` after those before."""
        sent = []
        for line, step in zip(self._lines, steps, strict=True):
            line.extend([line[-1] if line else step] * (ticks - 1) + [step])
            sent.append([line.popleft() for _ in range(ticks)][-1])
        return tuple(sent)


class TraceRow(NamedTuple):
    """One tick of a trace. Where `state` is None no STATE came: x is filled in and nothing was sent."""

    tick: int  # modulo 2^16
    x: tuple[float, ...]  # (m,) [m]
    asked: Sequence[float]  # (m,) [N] by the controller
    gain: float
    sent: tuple[int, ...]  # [steps]
    state: State | None
    arming: int = 0  # which arming of the session this belongs to
    test: tuple[float, ...] | None = None  # (m,) [N] that encoders are tested with, behind the gain


@dataclass(frozen=True, eq=False)
class Arming:
    """What forces come from, from one arming to the next end."""

    number: int  # of the session, from 0
    program: Armable
    config: Config  # of the device
    budget: SentBudget | None = None


class Drive:
    """The coupling at work, from one arming to the next end."""

    def __init__(
        self,
        arming: Arming,
        units: Units,
        limits: SafetyLimits,
        settings: monitor.LinkSettings,
        counters: monitor.Counters,
        record: Callable[[TraceRow], None],
        still: Sequence[int] | None = None,
        expected: Sequence[monitor.Expected] | None = None,
    ) -> None:
        """`still` (m,) [counts] are within an encoder's noise, `expected` (m,) is what the test at arming compares."""
        self.controller, config = arming.program.controller(limits.cap), arming.config
        self.units, self.config, self.limits = units, config, limits
        self.T = T = self.controller.T
        self.gain = Gain(limits, T)
        self.force = (0.0,) * config.axes  # [N] the last one sent
        self.x: tuple[float, ...] | None = None  # [m] of the last STATE
        self.reference: tuple[int, ...] | None = None  # [counts] that positions are counted from
        self._rereference = settings.rereference
        test = monitor.EncoderTest(limits.cap, T, units, still, expected, settings.held)
        self._test = test if settings.test_encoders else None
        self._encoders = monitor.EncoderMonitor(units.encoder_step, units.force_step, T, still)
        self._heat = Heat(limits, T)
        self._window = max(2, round(_SPEED_SECONDS / T))  # [ticks] over which a speed is taken
        self._recent = deque[tuple[float, ...]](maxlen=self._window + 1)  # [m] tick by tick
        self._before: tuple[float, ...] | None = None  # [m] of the STATE before that, where none is missing
        self.world = self.controller if isinstance(self.controller, WorldController) else None
        self._counters, self._record, self._arming, self._budget = counters, record, arming.number, arming.budget
        self._commands, self._clock = monitor.CommandMonitor(config), monitor.ClockMonitor(limits.watchdog_us, T)

    @property
    def dead(self) -> str | None:
        """What to say of an axis that does not move although a force acts on it for long; None: there is none."""
        return self._encoders.dead

    def step(self, state: State, ticks: int, direction: int, now: int) -> tuple[int, ...]:
        """The force [steps] that answers `state`, which came at `now` [us], `ticks` after the one before.

        The gain rises (direction 1), falls (-1) or stays (0); it rises once every encoder has answered its test.
        Raises SafetyStop where the device, an encoder or the controller is out of bounds.
        """
        if self.x is None:
            ticks = 1  # what went before does not count
        self._clock.check(state, ticks, now)
        self.units.check_range(state.counts)
        if self.reference is None:
            self.reference = state.counts if self._rereference else (0,) * state.axes
        x = self.units.positions(map(sub, state.counts, self.reference))
        self._check_motion(x, ticks)
        self._counters.unlike += self._commands.unlike(state, ticks)
        self._encoders.check(state.counts, state.applied, ticks)
        if self.limits.continuous:
            self._heat.check(self.units.forces(state.applied), ticks)
        if ticks > 1 and self.x is not None:
            self._miss(state, _fill(self.x, x, ticks)[:-1])
        asked = self.controller.step(x)
        test = self._test.force(state, ticks) if self._test and direction > 0 else None
        if direction > 0 and test is None:
            self._test = None
            self.gain.rise(ticks)
        elif direction < 0:
            self.gain.fall(ticks)
        shaped = self.limits.shape(asked, self.force, self.gain.value, self.T, test)
        force, steps = shaped.force, self.units.steps(shaped.force, self.config.cap)
        if self._budget:
            whole = self._budget.limit(steps, x, np.array(self.units.forces(state.applied)), ticks - 1)
            if whole != steps:
                force, steps = self.units.forces(whole), whole
                self._counters.limited += 1
        if self.world:
            whole = self.world.limit(steps, self.units.force_step)
            if whole != steps:
                force, steps = self.units.forces(whole), whole
            steps = self.world.later(steps, ticks)
        self._before, self.x, self.force = self.x if ticks == 1 else None, x, force
        self._counters.clipped += shaped.clipped
        self._counters.slowed += shaped.slowed
        self._commands.tell(state.tick, steps)
        self._record(TraceRow(state.tick, x, asked, self.gain.value, steps, state, self._arming, test))
        return steps

    def _check_motion(self, x: tuple[float, ...], ticks: int) -> None:
        """Raise SafetyStop where no hand moves to x (m,) [m] within so many ticks."""
        if self.x is not None:
            self.limits.check_jump(x, self.x, ticks)
            if ticks == 1 and self._before is not None:
                self.limits.check_jolt(x, self.x, self._before)
        recent = self._recent
        if ticks == 1 or self.x is None:
            recent.append(x)
        else:
            recent.extend(_fill(self.x, x, ticks))
        if (since := len(recent) - 1) >= self._window // 2:
            self.limits.check_speed(x, recent[0], since * self.T)

    def _miss(self, state: State, positions: list[tuple[float, ...]]) -> None:
        """The controller moves on through ticks of which no STATE came."""
        for back, x in zip(range(len(positions), 0, -1), positions, strict=True):
            tick, asked = (state.tick - back) & 0xFFFF, self.controller.step(x)
            self._record(TraceRow(tick, x, asked, self.gain.value, (), None, self._arming))


# couplings that are certified for a link


def timed(
    scenario: Scenario, ages: monitor.Ages, quantile: float, guard_us: float, at_once: bool = False
) -> tuple[Scenario, int]:
    """The scenario with what was measured of its ticks, and the ticks that the link takes.

    T_max is the length that a fraction `quantile` of the device's ticks keeps, where it exceeds T. `at_once`: forces
    latch as they come, link 0, between the least age and the one that a fraction keeps, both with the guard. Raises
    SafetyStop where those are a period or longer.
    """
    T_us = 1e6 * scenario.T
    longest, known = ages.longest_tick(T_us, quantile), scenario.T_max or scenario.T
    if longest > 1e6 * known:
        scenario = scenario.replace(T_max=1e-6 * longest)
    if not at_once:
        return scenario, ages.link_delay(T_us, quantile, guard_us)
    least, most = max(0.0, min(ages.values) - guard_us), ages.quantile(quantile) + guard_us
    if most >= min((T_us, *ages.ticks)):
        raise SafetyStop(f"answers come up to {most:.0f} us after their tick, T is {T_us:g} us: latch at ticks")
    return scenario.replace(latency=((1e-6 * least, 1e-6 * most),) * scenario.channels), 0


class Armable(Protocol):
    """What a session can be armed with."""

    @property
    def link(self) -> int: ...  # ticks from a sample to the latch of its force
    @property
    def certified(self) -> bool: ...  # for every passive human
    @property
    def name(self) -> str: ...  # for the log
    @property
    def margin_us(self) -> float: ...  # [us] before its latch, or the end of its tick, by which a force must come
    def controller(self, cap: Sequence[float]) -> Controller: ...  # a fresh one, for forces up to `cap` (m,) [N]


@dataclass(frozen=True, eq=False)
class CertifiedCoupling:
    """A coupling with the delay that it is certified for."""

    link: int  # [ticks]
    scenario: Scenario  # with the delays of this loop
    case: str
    chosen: Chosen
    assessment: Assessment  # in the loop with these delays

    @property
    def certified(self) -> bool:
        """Whether there is a guarantee for this loop, and the user's own condition holds where there is one."""
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
        """Missed answers in a row through which the device may hold a force, as far as the coupling's file proves."""
        span = self.chosen.switching
        return min(hi - n for hi, n in zip(span.hi, self.scenario.theta, strict=True)) if span else 0

    def controller(self, cap: Sequence[float]) -> Controller:
        lag, start = self.assessment.force_limits.rho, self.assessment.force_limits.energy_budget
        if is_world(self.scenario):
            waits = [n - self.link for n in self.scenario.theta]
            return WorldController(self.scenario, self.chosen.coupling, start or 0.0, cap, waits)
        return host_controller(self.scenario.loop(self.case), self.chosen.coupling, self.link, cap, lag)

    def capped(self, cap: Sequence[float]) -> Assessment:
        """Return the assessment with the force cap (m,) [N] of a session in its report; no proof depends on it."""
        return replace(self.assessment, force_limits=self.assessment.force_limits.within(cap))

    def remarks(self) -> list[str]:
        """What a reader should know of the coupling's file, of a condition of the user's own, and of the clock."""
        said = [*self.chosen.remarks(self.assessment.requirements)]
        if self.scenario.latency:
            least, most = (1e6 * t for t in self.scenario.latency[0])
            kept = f"periods up to {1e6 * (self.scenario.T_max or self.scenario.T):.0f} us"
            kept += f" and forces that act {least:.0f} to {most:.0f} us after their sample"
            return [*said, f"forces act as they come: certified for {kept}, as measured"]
        if self.held < 1:
            return said
        answers = "1 missed answer" if self.held == 1 else f"{self.held} missed answers in a row"
        return [*said, f"a force that is held through {answers} is covered by the file's proof"]


def certified_coupling(
    scenario: Scenario,
    case: str,
    name: str | None,
    condition: str | Condition | None,
    link: int,
    own: Coupling | Design | None = None,
    limiter: bool | None = None,
    start: float = START_J,
) -> CertifiedCoupling:
    """The coupling `name`, or one's `own`, for a link of `link` ticks (0: the host is the clock).

    Forces leave through the limiter that these cover, unless `limiter` is False. In a MuJoCo world they leave through
    the energy shell, with W0 = `start` [J].

    Raises SafetyStop where no coupling is certified for it, InputError where the request contradicts itself.
    """
    if link > MAX_THETA:
        raise SafetyStop(f"the link takes {link} ticks, the protocol carries at most theta = {MAX_THETA}")
    delays = tuple(max(n, link) for n in scenario.theta)
    slower = scenario.replace(theta=delays, latency=None if link else scenario.latency)
    try:
        chosen = choose(slower, case, name, condition, limiter) if own is None else given(own)
    except DesignFailed as error:
        raise SafetyStop(f"no coupling for a link of {link} tick{'s' if link > 1 else ''}: {error}") from None
    alone = slower.replace(ranges=None) if slower.ranges else slower  # only the nominal environment is rendered
    if is_world(alone):
        assessment = assessed(alone, case, chosen, energy_budget=start, limiter=False)
    else:
        assessment = assessed(alone, case, chosen, limiter=limiter)
    waits = min(MAX_THETA, *slower.theta) if link else 0  # what is longer, the host waits for
    made = CertifiedCoupling(waits, slower, case, chosen, assessment)
    if not made.certified:
        named = "the loop without coupling" if chosen.kind == "none" else f"the coupling {chosen.kind}"
        raise SafetyStop(f"{named} is not certified for theta = {list(slower.theta)}: {_shortfall(made)}")
    return made


def certified_couplings(
    scenario: Scenario,
    case: str,
    name: str | None,
    condition: str | Condition | None,
    link: int,
    spare: int = 2,
    limiter: bool | None = None,
    start: float = START_J,
) -> tuple[CertifiedCoupling, ...]:
    """The coupling for the measured delay and up to `spare` in reserve, each certified for one tick more.

    A reserve is softer than the coupling before it on every channel whose delay is longer, stiffer on none, and needs
    less damping than that coupling would with these delays. It is of the same kind or from the same file, or else the
    spring-damper by Theorem 4, which guarantees the most. Where neither is certified, there is no further one.
    Raises SafetyStop where the first coupling is not certified.
    """
    found = [certified_coupling(scenario, case, name, condition, link, limiter=limiter, start=start)]
    wanted: list[tuple[str | None, str | Condition | None]] = [(name, condition), _FALLBACK]
    while len(found) <= spare and wanted:
        kind, by = wanted[0]
        try:
            reserve = certified_coupling(scenario, case, kind, by, found[-1].link + 1, limiter=limiter, start=start)
        except (SafetyStop, InputError):
            wanted.pop(0)
            continue
        if _softer(reserve, found[-1]):
            found.append(reserve)
        else:
            wanted.pop(0)
    return tuple(found)


_EQUAL = 1e-9  # relative difference of static stiffnesses that is rounding


def _softer(reserve: CertifiedCoupling, than: CertifiedCoupling) -> bool:
    """Whether it is softer where its delay is longer, stiffer nowhere, and asks less of the devices with its delays.

    A stiffness is the coupling's own K, or else the static one that is felt.
    """
    own, other = (made.assessment.gains for made in (reserve, than))
    K, before = (np.array(gains.get("K", np.nan)) for gains in (own, other))
    if np.isnan(K).any() or np.isnan(before).any():
        K, before = (np.diag(_felt_at_rest(made)) for made in (reserve, than))
    later = np.greater(reserve.scenario.theta, than.scenario.theta)
    if (before * (1 + _EQUAL) < K).any() or (later & (before * (1 - _EQUAL) <= K)).any():
        return False
    loop = reserve.scenario.loop(reserve.case)
    needs = [required_damping(loop, made.chosen.coupling, than.chosen.asked).ratio for made in (reserve, than)]
    return needs[0] < needs[1]


def _felt_at_rest(made: CertifiedCoupling) -> Array:
    """Static stiffness (m, m) [N/m] that the devices feel; of a world, where nothing in it gives way."""
    loop = made.scenario.loop(made.case)
    V = made.chosen.coupling.compliance(loop.T) if is_world(made.scenario) else None
    return loop.F(made.chosen.coupling).dc() if V is None else np.linalg.inv(V.dc())


def _shortfall(made: CertifiedCoupling) -> str:
    needs = []
    for name, requirement in made.assessment.requirements.items():
        figures = ", ".join(f"{b:.4g}" for b in requirement.required)
        needs.append(requirement.reason or f"{name} needs {figures} of {requirement.available[0]:g} N s/m")
    return "; ".join(needs)
