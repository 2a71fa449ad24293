"""Check that link and device behave as the certificate assumes: measured delay, clock, lateness, applied forces.

The certificate is for a period T and for delays up to theta, and every ramp and limit counts ticks. So the clocks of
device and host are compared with the tick number, and late and missing answers are counted. The force that the device
reports is compared with the force that the host sent. docs/protocol.md determines the applied force: in ARMED the
device moves from its last force towards the force for this tick, within slew rate and growing cap; in HOLDING it keeps
its last force; in DISARMED it applies no force.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from haptic_loop.controller.lti import Array
from haptic_loop.hw.limits import SafetyLimits, Units
from haptic_loop.hw.protocol import NO_MARGIN, Config, Phase, SafetyStop, State, distance
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import build
from haptic_loop.sim.scenario import Scenario

_STATES_PER_ANSWER = 8  # most STATEs per measured age: of several FORCEs in a USB frame, only one margin is reported
_INFERRED = 0.005  # largest share of inferred ages: half of the 1 % that the default quantile leaves out
_MEASURED_TOLERANCE = 0.01  # largest relative difference between the device's mean tick and T
_UNTOLD = 0.9  # largest share of STATEs without a margin; USB frames that carry several FORCEs cause some
_DEVICE_TOLERANCE, _HOST_TOLERANCE = 0.01, 0.1  # largest relative drift in a block; a busy host reads its clock late
_BLOCK = 200  # ticks over which a clock is compared
_CLOCK_US = 1.5  # [us] largest error of the difference of two time stamps of the device
_REMEMBERED = 64  # most forces or latches that are stored; at most the last theta still matter
_ROUNDING = 1  # [steps] largest difference that a firmware's rounding may cause
_PATIENCE = 5  # wrong ticks in a row at which a session stops
_CHANGE = 1.0  # [1 N, or half of a weak motor's cap] change of force that moves any handle not at an end stop
_IMPULSE = 0.1  # [s] largest time integral of such changes without a motion, in the unit of _CHANGE: 1 N for 100 ms
_HEAVIEST = 2.5  # [kg] largest mass of hand and handle
_TEST_FORCE, _TEST_HALF, _BLOCKS = 1.3, 0.03, 4  # force in the last block [N], half a period [s], number of blocks
_PULSE = 2 / 3  # share of half a period in which the test force acts; without pauses, both directions always mix
_TEST_SPEED = 0.1  # [m/s] speed in the test at the end, even if it needs over _TEST_FORCE; 0.4 if one direction is dead
_TEST_BEFORE = 0.012  # [s] time at zero force before the test of an axis
_TEST_RATIO = 2.0  # largest ratio of a motion to the expected motion, or of the expected motion to it
_DEGREE = 5  # degree of the polynomials that remove a hand's own motion; they leave 1 % of a motion at 2 Hz
_FIT = 0.8  # least share of power with the expected shape: loosely moved handles have 0.93, held handles at most 0.5
_LATE = 0.75  # [ticks] largest hidden delay: amplifiers have a short delay, but no certificate covers a whole tick
_CROSS = 0.25  # largest motion of another axis, as a share of the expected motion; a common table transmits less
_ALIVE = 0.06  # least share of the expected swing: firm hands (0.5 kg, 20 N s/m, 1500 N/m) leave 0.09, dead motors 0.03
_PUSHED = 0.5  # share of the strongest test force below which the energy budget is blamed for a missing answer
_UNEVEN = 0.2  # largest difference of the two directions of motor or encoder, as a share of their sum: a factor of 1.5
_ZONE = 0.8  # least ratio of a motion's relative size to that under twice the force; 1 without a dead zone
_CLEAN, _RUBBED = 0.15, 0.25  # for _ZONE: largest one-sided share, largest friction as a share of the force
_BETTER = 8.0  # least ratio of squares that a one-sided fault explains to the rest; friction and weight reach 6
_WEAKENED = 0.7  # least motion at the end of a session, as a share of the motion at arming
_LETTING_GO = 5.0  # [s] time at the end of a session in which a person can let go of a handle
_REST = 0.1  # [s] window in which the noise of an encoder at rest is measured
_PRESSING, _PRESSED = 0.3, 0.5  # force, in the unit of _CHANGE; longest time [s] of rest under this force
_TREMOR = 3e-5  # [m] least motion of a calm hand within _PRESSED; on coarser counts the encoder looks dead
_FORGETTING = 8  # right ticks that cancel one wrong tick; a session also stops if wrong ticks stay more frequent


@dataclass(frozen=True)
class LinkSettings:
    """Settings by which a session judges its link and arms."""

    baud: int | None = None  # baud rate of a UART; None for a link without UART (USB, pseudo-terminal)
    measure: int = 800  # answers whose age is measured
    window: int = 200  # ticks over which misses are judged
    late: float = 0.1  # largest share of late answers; above it the link is slower than the coupling is certified for
    missed: float = 0.2  # largest share of missing answers; beyond it loops lose mean-square stability
    test_encoders: bool = True  # whether a small force tests the encoders at every arming
    held: bool = True  # whether the scenario's hands hold the handles in that test (rehearsals), or nobody does
    energy_budget: tuple[float, float] | None = None  # W0 and cap [J]
    rereference: bool = True  # whether positions count from the handles' place at arming
    deadman: bool = False  # whether forces act only while the deadman at the device is held
    behind: tuple[int, ...] = ()  # (m,) with several boards, ticks added to the link's delay (hw/boards.py)
    elsewhere: tuple[int, ...] | None = None  # [counts] places that every handle must have left before arming


# Measurement of the delay at zero force


@dataclass(frozen=True)
class Ages:
    """Ages [us] of forces when they reach the device, counted from their sample, and the number of lost forces."""

    values: tuple[int, ...]
    missing: int = 0
    ticks: tuple[int, ...] = ()  # [us] lengths of the device's ticks by its own clock

    def longest_tick(self, T_us: float, q: float = 1.0) -> float:
        """Return the quantile q of the tick lengths [us], or T unless it exceeds T by more than the clock's error."""
        ordered = sorted(self.ticks)
        longest = ordered[min(len(ordered) - 1, int(q * len(ordered)))] if ordered else T_us
        return float(longest) if longest > T_us + _CLOCK_US else T_us

    def shortest_tick(self, T_us: float, q: float = 1.0) -> float:
        """Return the length [us] that a fraction q of ticks has at least, or T unless this is below T - _CLOCK_US."""
        ordered = sorted(self.ticks, reverse=True)
        shortest = ordered[min(len(ordered) - 1, int(q * len(ordered)))] if ordered else T_us
        return float(shortest) if shortest < T_us - _CLOCK_US else T_us

    def quantile(self, q: float) -> int:
        """Return the least age that a fraction q of forces does not exceed. Raises SafetyStop if fewer arrived."""
        ordered, everything = sorted(self.values), len(self.values) + self.missing
        place = min(everything - 1, int(q * everything))
        if place >= len(ordered):
            part = 100 * self.missing / everything
            raise SafetyStop(f"{part:.2g} % of the answers never arrived: no delay covers {100 * q:g} % (--quantile)")
        return ordered[place]

    def link_delay(self, T_us: float, q: float, guard_us: float) -> int:
        """Return the least delay [ticks, >= 1] that covers the ages of a fraction q of the answers plus a guard."""
        return max(1, int(-(-(self.quantile(q) + guard_us) // T_us)))

    @property
    def median(self) -> int:
        """The median age of the answers that arrived [us]."""
        return sorted(self.values)[len(self.values) // 2]


class AnswerAges:
    """The age of each answer, derived from STATEs and stored under the number of the answered tick.

    A STATE reports the margin of the last answer that came. Where a burst brings n answers between two STATEs, `echo`
    advances by n, and the n-1 skipped answers are up to (n-1) T older. The skipped answers count with these ages,
    because the delay must cover them too.
    """

    def __init__(self, due: int, T_us: float) -> None:
        """Take `due`, the number of ticks from a sample to the latch of its answer."""
        self._due, self._T_us = due, T_us
        self.by_tick: dict[int, int] = {}  # [us]
        self.inferred: set[int] = set()  # ticks whose answer was skipped, so that its age is inferred
        self._unanswered: set[int] = set()  # ticks whose answer had not come at its latch
        self._youngest: int | None = None  # tick of the youngest answer that came

    def age(self, margin: int) -> int:
        """Return the age [us] of an answer with this margin."""
        return round(self._due * self._T_us) - margin

    def note_unanswered(self, ticks: range) -> None:
        """Remove the ages of answers to `ticks`, which had not come at their latch because they are late or lost."""
        self._unanswered.update(ticks)
        for tick in ticks:
            self.by_tick.pop(tick, None)
            self.inferred.discard(tick)

    def note(self, tick: int, margin: int) -> None:
        """Record the age of the answer to `tick`, and of the answers skipped before it."""
        age = self.age(margin)
        after = tick - 1 if self._youngest is None else self._youngest
        for skipped in range(max(after + 1, tick - 2 * self._due), tick):  # older answers were missed long ago
            if skipped not in self._unanswered:
                self.by_tick[skipped] = age + round((tick - skipped) * self._T_us)
                self.inferred.add(skipped)
        self.by_tick[tick] = age
        self.inferred.discard(tick)
        self._youngest = tick if self._youngest is None else max(self._youngest, tick)


class Measurement:
    """Measure the ages of answers at zero force, until `needed` answers have arrived or are missing.

    A limit on the number of STATEs ends the measurement in any case. Where too many ages are inferred, answers may
    have overtaken each other: a late answer that comes together with a younger one leaves no trace. Then a second
    round measures half as many ages exactly. The host still answers every STATE, so that the load of the link is the
    same, but it sends most answers for a wrong tick, so that the device ignores them. The distances of accepted answers
    are random and at least the longest age (at most theta), so that bursts meet each answer with the same probability.
    """

    def __init__(self, needed: int, theta: int, T: float, most_missing: float) -> None:
        self._needed, self._theta, self._T_us, self._most_missing = needed, theta, 1e6 * T, most_missing
        self._first: State | None = None
        self._last: State | None = None
        self._tick = 0  # number of the last STATE, without wrap-around
        self._ticks: list[int] = []  # [us] lengths of ticks
        self._apart = 1  # [ticks] least distance of accepted answers; above 1 in the second round
        self._begin()

    def _begin(self) -> None:
        """Begin a round."""
        self._answers = AnswerAges(self._theta, self._T_us)
        self._missed = self._states = 0
        self._sent: set[int] | None = None if self._apart == 1 else set()  # ticks whose answer is accepted
        self._next, self._distances = self._tick + 2 * self._theta, np.random.default_rng(0)
        self.ignored: deque[int] = deque(maxlen=_REMEMBERED)  # latches whose answer the device ignores, modulo 2^16

    def delay(self) -> int:
        """Return the delay [ticks] to send with the next answer: theta, or theta + 1 so that the device ignores it."""
        if self._sent is None or self._last is None:
            return self._theta
        meant = False
        while self._next <= self._tick:  # a chosen tick without a STATE counts as a missing answer
            meant = self._next == self._tick
            self._sent.add(self._next)
            self._next += int(self._distances.integers(self._apart, 2 * self._apart))
        if meant:
            return self._theta
        self.ignored.append((self._last.tick + self._theta) & 0xFFFF)
        return self._theta + 1

    def note(self, state: State, margin: int | None, missed: int) -> bool:
        """Process a STATE and return whether the measurement is complete. Raises SafetyStop for an unusable link."""
        self._first = self._first or state
        passed = distance(state.tick, self._last.tick) if self._last else 0
        if self._last and passed == 1:
            self._ticks.append((state.t_us - self._last.t_us) & 0xFFFFFFFF)
        self._last, self._tick = state, self._tick + passed
        self._states += 1
        counted = self._states - 2 * self._theta  # the device has no answers to ticks before the first STATE
        if counted <= 0:
            return False
        tick = self._tick + distance(state.echo, state.tick)
        if self._sent is None:
            self._note_all(tick, margin, missed, passed)
        elif margin is not None and tick in self._sent:
            self._answers.by_tick[tick] = self._answers.age(margin)
        ages, needed = self._answers.by_tick, self._needed if self._sent is None else -(-self._needed // 2)
        everything, counted = len(ages) + self._missing, counted // (2 * self._apart - 1)
        if everything < needed and counted < _STATES_PER_ANSWER * needed:
            return False
        part = 1 - len(ages) / max(1, everything if everything >= needed else counted)
        if part > self._most_missing:
            raise SafetyStop(f"{100 * part:.0f} % of the answers never reached the device, {self._states} STATEs came")
        self._check_clock(state)
        if self._sent is None and len(self._answers.inferred) > _INFERRED * len(ages):
            self._apart = max(2, min(self._theta, math.ceil(max(ages.values()) / self._T_us)))
            self._begin()
            return False
        return True

    def _note_all(self, tick: int, margin: int | None, missed: int, passed: int) -> None:
        """Record an answer in the first round, and count `missed` latches of the last `passed` ticks."""
        self._missed += missed
        if missed == passed:
            self._answers.note_unanswered(range(self._tick - self._theta - missed + 1, self._tick - self._theta + 1))
        if margin is not None:
            self._answers.note(tick, margin)
            self._missed -= margin < 0  # a missed answer that comes late is not missing

    @property
    def _missing(self) -> int:
        """Number of answers that never came."""
        if self._sent is None:
            return max(0, self._missed)
        decided = self._tick - 2 * self._theta
        return sum(tick < decided and tick not in self._answers.by_tick for tick in self._sent)

    @property
    def result(self) -> Ages:
        return Ages(tuple(self._answers.by_tick.values()), self._missing, tuple(self._ticks))

    def _check_clock(self, state: State) -> None:
        assert self._first is not None
        elapsed = (state.t_us - self._first.t_us) & 0xFFFFFFFF
        ticks = distance(state.tick, self._first.tick)
        if ticks > 0 and abs(elapsed / (ticks * self._T_us) - 1) > _MEASURED_TOLERANCE:
            each = elapsed / ticks
            raise SafetyStop(f"a tick of the device lasts {each:.1f} us by its own clock, T is {self._T_us:g} us")


# Lateness of answers


@dataclass
class Counters:
    """Counts since the session began. The device's own counts are sums of differences modulo 256."""

    states: int = 0  # STATEs that were acted upon
    gaps: int = 0  # ticks without a STATE
    duplicates: int = 0  # STATEs of the same tick as the last STATE
    stale: int = 0  # STATEs of an older tick than the last STATE: late or reordered
    unexpected: int = 0  # STATEs with a wrong number of axes
    late: int = 0  # answers after their latch, or with theta = 0 after the certified latency
    misses: int = 0  # ticks without an answer in time, by the device's count
    device_errors: int = 0  # frames that the device rejected
    host_errors: int = 0  # frames of the device that could not be read
    clipped: int = 0  # ticks with a force at its cap, by the limiter or by clipping
    slowed: int = 0  # ticks with a force at the slew rate limit
    limited: int = 0  # ticks in which the energy budget made forces smaller
    unlike: int = 0  # ticks at which the device applied a force that the host did not send


class LinkMonitor:
    """Check the order of STATEs, and count late answers, missed answers and ticks without STATE in a sliding window."""

    def __init__(self, settings: LinkSettings, counters: Counters) -> None:
        self.settings, self.counters = settings, counters
        self.needed = 0.0  # [us] least margin of an answer that is not late
        self.restart()

    def restart(self) -> None:
        """Clear the window after a new delay was configured."""
        self.last: State | None = None
        self.margin: int | None = None  # [us] margin in the last new STATE; None if that STATE has no margin
        self.missed = 0  # missed ticks that the last new STATE reports
        self._window: deque[_Tick] = deque()
        self._late = self._missed = self._untold = self._gaps = 0  # sums over the window, updated tick by tick

    def take(self, state: State, ignored: Container[int] = ()) -> int:
        """Process a STATE and return the ticks since the previous one, or 0 for a repeated or older tick.

        A latch in `ignored` (modulo 2^16) is no miss, because the host sent its answer for a wrong tick on purpose.
        """
        ahead = 1 if self.last is None else distance(state.tick, self.last.tick)
        if ahead <= 0:
            self.counters.duplicates += ahead == 0
            self.counters.stale += ahead < 0
            return 0
        self.missed = 0
        if self.last is not None:
            self.missed = (state.misses - self.last.misses) & 0xFF
            if self.missed and ignored:
                meant = sum((state.tick - back) & 0xFFFF in ignored for back in range(min(ahead, _REMEMBERED)))
                self.missed = max(0, self.missed - meant)
            self.counters.device_errors += (state.crc_errors - self.last.crc_errors) & 0xFF
        self.margin = None if state.margin_us == NO_MARGIN else state.margin_us
        late = self.margin is not None and self.margin < self.needed
        odd = late or self.margin is None or self.missed > 0 or ahead > 1
        tick, counters = _Tick(self.margin, self.missed, ahead - 1, late, odd), self.counters
        counters.states += 1
        self._window.append(tick)
        if odd:
            counters.gaps += tick.gap
            counters.misses += tick.missed
            counters.late += tick.late
            self._add(tick, 1)
        if len(self._window) > self.settings.window and (oldest := self._window.popleft()).odd:
            self._add(oldest, -1)
        self.last = state
        return ahead

    def _add(self, tick: _Tick, sign: int) -> None:
        self._late += sign * tick.late
        self._missed += sign * tick.missed
        self._gaps += sign * tick.gap
        self._untold += sign * (tick.margin is None)

    @property
    def least_margin(self) -> int | None:
        """The least margin [us] in the window; None if no answer came."""
        return min((tick.margin for tick in self._window if tick.margin is not None), default=None)

    def too_late(self) -> str | None:
        """Return a message if the link has become slower than the coupling was certified for, else None.

        Shares are relative to a full window, also before it is full. Raises SafetyStop where too few messages arrive.
        """
        window, most = self.settings.window, self.settings.missed
        late, missed = self._late / window, min(1.0, self._missed / window)
        if missed > most + late:
            raise SafetyStop(f"{100 * missed:.0f} % of the last {window} ticks had no answer in time")
        if self._gaps / window > most:
            part = f"{100 * self._gaps / window:.0f} % of {window} ticks"
            raise SafetyStop(f"no STATE in {part}: the device's forces are unknown")
        if self._untold / window > _UNTOLD:
            raise SafetyStop(
                f"more than {100 * _UNTOLD:g} % of the last {window} STATEs lack a margin: their lateness is unknown"
            )
        if late > self.settings.late:
            return f"{100 * late:.0f} % of the last {window} answers were late"
        return None


class _Tick(NamedTuple):
    """The facts about the link that one new STATE reports."""

    margin: int | None  # [us]
    missed: int
    gap: int  # ticks without a STATE before this one
    late: bool
    odd: bool  # whether this tick counts in any sum of the window


# The clocks of device and host are both compared with the tick number. Only the host's clock reveals a device that
# computes its clock from its ticks.


@dataclass
class _ClockDrift:
    """Compare a clock with ticks of `T_us` in blocks. Each block excludes its longest delay: a freeze is no drift."""

    whose: str
    T_us: float
    tolerance: float  # largest drift, as a part of a block
    forgiven_us: float  # [us] most that a block excludes of its longest delay
    _last: int | None = None
    _ticks: int = 0
    _behind: float = 0.0  # [us] time of the clock minus ticks * T
    _freeze: float = 0.0  # [us] longest delay of one reading in the block, at most forgiven_us

    def note(self, at_us: int, ticks: int) -> None:
        """Process a reading of the clock (modulo 2^32), `ticks` ticks after the last. Raises SafetyStop on drift."""
        if self._last is not None:
            elapsed = (at_us - self._last + 2**31) % 2**32 - 2**31
            late = elapsed - ticks * self.T_us
            drift = self._behind = self._behind + late
            if late > self._freeze:
                self._freeze = min(self.forgiven_us, late)
            self._ticks += ticks
            if drift > 0:
                drift -= min(self._freeze, drift)
            if abs(drift) > self.tolerance * _BLOCK * self.T_us:
                lasts = self.T_us + drift / self._ticks
                what = f"over {self._ticks} tick{'s' if self._ticks > 1 else ''}, T is {self.T_us:g} us"
                raise SafetyStop(f"a tick of the device lasts {lasts:.4g} us by {self.whose} clock {what}")
            if self._ticks >= _BLOCK:
                self._ticks, self._behind, self._freeze = 0, 0.0, 0.0
        self._last = at_us


class ClockMonitor:
    """Check both clocks and the tick number while forces act."""

    def __init__(self, watchdog_us: int, T: float) -> None:
        T_us = 1e6 * T
        self.most = max(1, int(watchdog_us / T_us))  # [ticks] largest advance from one STATE to the next
        self._device = _ClockDrift("its own", T_us, _DEVICE_TOLERANCE, watchdog_us)
        self._host = _ClockDrift("the host's", T_us, _HOST_TOLERANCE, watchdog_us)

    def check(self, state: State, ticks: int, now: int) -> None:
        """Raise SafetyStop where the STATE that came at `now` [us] cannot be `ticks` ticks after the previous one."""
        if ticks > self.most:
            raise SafetyStop(f"the tick number leapt by {ticks}, the watchdog allows {self.most}")
        self._device.note(state.t_us, ticks)
        self._host.note(now, ticks)


# Check of the force that the device reports


class CommandMonitor:
    """Store the forces that the host sends, and check that the device applies them."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._forces: dict[int, tuple[int, ...]] = {}  # [steps] forces by the tick of the STATE that shows them
        self._last: State | None = None
        self._ready = False  # whether the last STATE was not DISARMED
        self._run = (0, 0)  # least and largest possible number of forces latched since arming
        self._unlike = self._holding = 0

    def tell(self, tick: int, steps: tuple[int, ...]) -> None:
        """Record that `steps` were sent as the answer to `tick`."""
        self._forces[(tick + self._config.due) & 0xFFFF] = steps
        if len(self._forces) > _REMEMBERED:
            self._forces.pop(next(iter(self._forces)))

    def unlike(self, state: State, ticks: int) -> bool:
        """Return whether the device applies a force that the host did not send. A STATE after a gap is not judged.

        Raises SafetyStop if the device continues to do so, or holds a force for longer than agreed.
        """
        phase = state.phase
        self._holding = self._holding + 1 if phase == Phase.HOLDING else 0
        if self._holding > self._config.hold:
            raise SafetyStop(f"the device holds a force for {self._holding} ticks, {self._config.hold} are agreed")
        told, last, ready = self._forces.pop(state.tick, None), self._last, self._ready
        self._last, self._ready = state, phase != Phase.DISARMED
        if last is None or not self._ready:
            return False
        if ready:
            fewest, most = self._run
            self._run = (fewest + (phase == Phase.ARMED), most + ticks)
        if ticks > 1:
            return False
        wrong = not self._could(state, last.applied, told)
        self._unlike = max(0, self._unlike + (_FORGETTING if wrong else -1))
        if self._unlike > _FORGETTING * (_PATIENCE - 1):
            what = f"told {told}" if phase == Phase.ARMED else f"to hold {last.applied}"
            raise SafetyStop(
                f"the device applies {state.applied} steps, it was {what}; {_PATIENCE} ticks or more were wrong"
            )
        return wrong

    def _could(self, state: State, last: tuple[int, ...], told: tuple[int, ...] | None) -> bool:
        if state.phase == Phase.HOLDING:
            return state.applied == last
        if told is None:
            return False
        fewest, most = self._run
        right = self._config.limited(most, last, told)
        if state.applied == right:
            return True
        other = self._config.limited(fewest, last, told)
        return all(
            min(one, two) - _ROUNDING <= force <= max(one, two) + _ROUNDING
            for force, one, two in zip(state.applied, right, other, strict=True)
        )


# Checks of the encoders. A dead encoder looks like a handle at rest, but no hand holds a handle perfectly still while
# the force changes.


class EncoderNoise:
    """The noise of every encoder at rest, while no force acts.

    It is the least range of counts over windows of 100 ms. So a person may move the handle if it rests for one window.
    """

    def __init__(self, axes: int, T: float) -> None:
        self._recent = [deque[int](maxlen=max(8, round(_REST / T))) for _ in range(axes)]
        self.range: list[int | None] = [None] * axes  # [counts] least range of a full window; None before the first

    def note(self, counts: Sequence[int]) -> None:
        """Process the counts (m,) of a tick."""
        for i, (recent, n) in enumerate(zip(self._recent, counts, strict=True)):
            recent.append(n)
            if len(recent) == recent.maxlen:
                own, least = max(recent) - min(recent), self.range[i]
                self.range[i] = own if least is None else min(own, least)

    @property
    def still(self) -> tuple[int, ...]:
        """Return the range (m,) [counts] in which an encoder rests: twice its noise, but 1 for a noise of up to 1.

        Broken channels toggle by 1. Over a longer time, noise exceeds this range with a probability below 1e-6.
        """
        return tuple(2 * least if least and least > 1 else 1 for least in self.range)


class Expected:
    """Predict how the encoders move under a force while the handles are free, or held by the scenario's hands.

    For free handles, also predict their motion in hands that weigh as much as the devices.
    """

    def __init__(self, scenario: Scenario, held: bool) -> None:
        """Build the plants; the handles are free unless they are `held`."""
        self.held, devices = held, scenario.device
        if held:
            scenes = [build(devices, scenario.human, scenario.person)]
        else:
            weights = [Link(sum(device.bodies.values()), 0.0, 0.0) for device in devices]
            hands = [Human((Link(0.0, 0.0, 0.0),))] * len(devices), [Human((weight,)) for weight in weights]
            scenes = [build(devices, each) for each in hands]
        plants = [hold(scene.plant, scenario.T) for scene in scenes]
        #: A and B of each plant, with B for the motors' force -f
        self._plants = [(p.A, -p.B[:, scene.outside :]) for p, scene in zip(plants, scenes, strict=True)]
        stiffness = [(device.transmission or (0.0, math.inf))[1] for device in scenario.axis_devices]
        bodies = [device.bodies.values() for device in scenario.axis_devices]
        self.mass = [sum(own) for own in bodies]  # (m,) [kg]
        #: (m,) [rad/s] at which a motor swings against its handle; infinite for rigid devices
        self.mode = [math.sqrt(k * sum(1 / m for m in own)) for k, own in zip(stiffness, bodies, strict=True)]
        self.rest()

    def rest(self) -> None:
        """Set all plants to rest."""
        self._states = [np.zeros(len(self._plants[which][0])) for which in (0, -1, 0)]

    def advance(self, axis: int, force: float) -> tuple[float, float, float]:
        """Apply the force [N] of the motor of `axis` for a tick, and return three positions [m] of this axis.

        They are the expected position, that in a heavy hand, and that under the absolute value of all forces so far.
        """
        plants, forces = (self._plants[which] for which in (0, -1, 0)), (force, force, abs(force))
        moved = zip(plants, self._states, forces, strict=True)
        self._states = [A @ state + B[:, axis] * each for (A, B), state, each in moved]
        own, heavy, even = (float(state[axis]) for state in self._states)
        return own, heavy, even


class EncoderTest:
    """Test whether encoders answer a small force that acts on one axis after the other.

    Every 30 ms a pulse of 20 ms acts in the other direction, in blocks of 120 ms; each block is twice as strong as the
    last. After a block, a polynomial of degree 5 is subtracted from every position. It contains the intended motion of
    a hand in this time, such as 50 mm at 2 Hz, and little of the answer. The remainder must match the expected motion
    in shape (`_FIT` of its sum of squares), in sign, and in size within a factor of 2. A reversed motor or encoder
    gives the wrong sign, a wrong scale the wrong size, and a dead encoder or a held or moved handle another shape. A
    motion that comes later than expected shows a hidden delay, because friction and hands advance its phase. Dry
    friction makes weak motions small, so only with the strongest force is a small motion wrong. Coarse counts leave the
    delay uncertain, so a stronger force follows until its error is below the limit, or the delay is not tested
    (`remarks`). A fit of dry friction (`_Shares`) finds a motor that is weak, or an encoder that loses counts, in one
    direction, because friction under a weight gives the motion other shapes. A dead zone of a motor makes the relative
    size of a motion smaller than that under twice the force; low friction does not.

    The test at the end of a session has the largest force that the session allows, and finds a motor that saturates: a
    motion may be 30 % smaller than at arming (`before`), whatever the mass. Unknown hands may hold the handles, except
    in rehearsals (`held`). A verdict then needs two blocks in a row that agree, and blocks are repeated until the
    person lets go, at most for 5 s. A small or late motion counts as wrong only where it has the shape of a free handle
    and not that of a handle in a hand as heavy as the device. The mode of a transmission makes these shapes differ; a
    rigid device has equal shapes. If an axis never moves as a free handle does, the session does not finish. Where it
    swings at the frequency of the force, at any phase, the message names a hand, too, because an axis with a dead motor
    does not swing.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        T: float,
        units: Units,
        still: Sequence[int],
        expected: Expected,
        at_once: bool = False,
        before: Sequence[tuple[float, float]] | None = None,
    ) -> None:
        """Test within the caps of `limits`; a motion within `still` (m,) [counts] is noise.

        A STATE reports the force that acts after it, or with `at_once` (theta = 0) the force that acted before it.
        `before` has the sizes and one-sided shares of motions at arming, which the test at arming stores in `sizes`.
        """
        self._at_once, self._closing, self._before = at_once, before is not None, before
        self.sizes: list[tuple[float, float]] = []
        push = 2 * _TEST_SPEED / (limits.lever * _PULSE * _TEST_HALF) * self._closing
        most = [max(_TEST_FORCE * limits.lever, push * mass) for mass in expected.mass]
        self._strongest = list(map(min, limits.cap, most))
        self._T, self._units, self._still, self._expected = T, units, still, expected
        self._axis, self._last = -1, None
        self.remarks: list[str] = []  # what the test could not judge
        self._unknown_hands = self._closing and not expected.held
        self._blocks = _BLOCKS + self._closing + round(_LETTING_GO / (4 * _TEST_HALF)) * self._unknown_hands
        self._next_axis()

    def _next_axis(self) -> None:
        self._axis, self._ticks, self._block = self._axis + 1, 0, _BLOCKS - 1 if self._closing else 0
        self._expected.rest()
        self._rows: list[tuple[float, ...]] = []  # tick, three expected positions [m] and counts (m,) in this block
        self._pushed = 0.0  # [N] largest force on the axis in this block
        self._finding: str | None = None  # the fault that the last block found, "" for none; None without an answer
        self._swings = False  # whether the axis swung at the frequency of the force in a block
        self._weaker = math.nan  # relative size of the last block's motion less its friction; nan if this is not clear

    def force(self, state: State, ticks: int) -> tuple[float, ...] | None:
        """Return the forces fed back (m,) [N], `ticks` ticks after the last call; None once all encoders have answered.

        Raises SafetyStop, naming the axis, where an encoder answers wrongly, or not even to the strongest test force.
        """
        acted: State | None = state if self._at_once else self._last
        pushed = acted.applied[self._axis] * self._units.force_step[self._axis] if acted else 0.0
        position = [self._expected.advance(self._axis, pushed) for _ in range(ticks)][-1]
        self._last, self._ticks, self._pushed = state, self._ticks + ticks, max(self._pushed, abs(pushed))
        self._rows.append((self._ticks, *position, *state.counts))
        before, half = max(1, round(_TEST_BEFORE / self._T)), max(2, round(_TEST_HALF / self._T))
        if self._ticks > before + 4 * half:
            if self._passed():
                self._next_axis()
                if self._axis == len(self._still):
                    return None
            elif self._block == self._blocks - 1:
                raise SafetyStop(self._unanswered())
            else:
                self._ticks, self._block, self._rows = before, self._block + 1, [(before, *position, *state.counts)]
                self._pushed = 0.0
        since = self._ticks - before
        if since <= 0:
            return (0.0,) * len(self._still)
        size = self._strongest[self._axis] * 2.0 ** min(0, self._block + 1 - _BLOCKS)
        number, place = divmod(since - 0.5 + half / 2, half)
        sign = (1 - 2 * (number % 2)) * (abs(place - half / 2) < half * _PULSE / 2)
        return tuple(sign * size if i == self._axis else 0.0 for i in range(len(self._still)))

    @property
    def request(self) -> str | None:
        """Return what the person must do so that the axis can pass its test, or None."""
        return f"let go of the handle of axis {self._axis + 1}" if self._block > _BLOCKS else None

    def _compare(self) -> tuple[Array, Array, float, float, float, _Shares, _Shares, bool]:
        """Compare all motions with the expected motion.

        Returns the relative size and the fit (m,) of all motions. For the tested axis, also returns the size at any
        phase of the force, the delay and its error [ticks], the fits with a motor that is weak, and with an encoder
        that loses counts, in one direction, and whether the shape is that of the expected handle but not that of a
        handle in a heavy hand.

        The delay is -a/s if s x + a x' + e y fits the tested motion, where x is the expected motion and y the motion
        under the absolute value of the force. The row p of the pseudoinverse that yields a turns rounding errors
        q/sqrt(12) of counts q into a standard error |p| q/sqrt(12)/|s|. The returned error |p| q/|s| is 3.5 standard
        errors; 1 % of 4000 simulated blocks exceed 3.1. Noise adds to the rounding errors.
        """
        t, expected, loaded, even, *counts = np.array(self._rows).T
        smooth = np.linalg.qr(np.vander((t - t.mean()) / len(t), _DEGREE + 1))[0]
        parts = expected, np.cumsum(expected), np.gradient(expected, t), loaded, even
        wanted, shifted, rate, heavy, even = (a - smooth @ (smooth.T @ a) for a in parts)
        moved = np.array(counts).T * self._units.encoder_step
        slow = smooth @ (smooth.T @ moved)
        moved -= slow
        power = wanted @ wanted or 1.0
        size = wanted @ moved / power
        # standard deviation [m] of rounding, or of noise if that is larger: the range `still` / 2 spans four of them
        scatter = np.array(self._units.encoder_step) * np.maximum(12**-0.5, np.array(self._still) / 8)
        own = np.maximum((moved**2).sum(axis=0) - len(t) * scatter**2, len(t) * scatter**2)
        fit = size**2 * power / own
        both = np.linalg.qr(np.stack([wanted, shifted], axis=1))[0]
        shapes, tested, noise = np.stack([wanted, rate, even], axis=1), moved[:, self._axis], scatter[self._axis]
        inverse = np.linalg.pinv(shapes)
        share = inverse @ tested
        same, doubts = float(share[0]) or 1.0, 12**0.5 * noise * np.linalg.norm(inverse, axis=1)
        late, doubt = -float(share[1]) / same, float(doubts[1]) / abs(same)  # [ticks]
        alike = (heavy @ tested) ** 2 / ((heavy @ heavy or 1.0) * own[self._axis])
        swing = float(np.linalg.norm(both.T @ tested) / math.sqrt(power))
        free = bool(fit[self._axis] > _FIT > alike)
        slip, fitted = 0.1 * np.abs(np.gradient(expected, t)).max() or 1.0, shapes @ share
        fits: list[_Shares] = []
        for _ in range(2):  # the second round has friction and path of the motion that the first round fits
            speed = np.gradient(fitted + slow[:, self._axis], t)
            rub = np.tanh(speed / slip).cumsum().cumsum() * -(self._T**2) / self._expected.mass[self._axis]
            rub, path = (a - smooth @ (smooth.T @ a) for a in (rub, np.abs(speed).cumsum()))
            fits = [_Shares.of([wanted, rub, rate, extra], tested, noise) for extra in (even, path)]
            fitted = min(fits, key=lambda one: one.rest).fitted
        return size, fit, swing, late, doubt, fits[0], fits[1], free

    def _counted(self, i: int) -> float:
        """Return the range of encoder i in this block [counts]."""
        return float(np.ptp([row[4 + i] for row in self._rows]))

    def _passed(self) -> bool:
        """Return whether the axis has passed its test. Raises SafetyStop where it answered wrongly.

        An unknown hand may look like a right or wrong answer in one block, so two blocks in a row must agree.
        """
        before = self._finding
        try:
            self._finding = "" if self._answered() else None
        except SafetyStop as fault:
            self._finding = str(fault)
        if self._finding is None or (self._unknown_hands and (before is None or bool(before) != bool(self._finding))):
            return False
        if self._finding:
            raise SafetyStop(self._finding)
        return True

    def _answered(self) -> bool:
        """Return whether the axis has answered well in this block. Raises SafetyStop where it answered wrongly."""
        retried = self._closing and not self._unknown_hands
        weak, most = self._block < _BLOCKS - 1 + retried, _LATE + self._at_once
        axis, name = self._axis, f"axis {self._axis + 1}"
        size, fit, swing, late, doubt, motor, encoder, free = self._compare()
        fits, wholes = (motor, encoder), (abs(float(motor.shares[0])) or 1.0, 1.0)
        # differences of the motions in the two directions, and the errors of these differences
        uneven = [(abs(one.shares[3]) / whole, one.doubts[3] / whole) for one, whole in zip(fits, wholes, strict=True)]
        blamed = int(encoder.explains and 2 * encoder.rest < motor.rest)
        best, (sided, unsure) = fits[blamed], uneven[blamed]
        (own, friction, _, fault), doubts = best.shares, best.doubts
        clear = fit[axis] > _FIT and max(abs(fault), doubts[0]) < _CLEAN
        weaker, self._weaker = self._weaker, float(own + doubts[0]) if clear else math.nan
        moves = [self._counted(i) > still for i, still in enumerate(self._still)]
        # A block lasts about as long as the window in which the noise was measured, so one count more is a motion.
        near = [self._counted(i) > max(1, still // 2 + 1) for i, still in enumerate(self._still)]
        near[axis] = near[axis] and swing > _ALIVE
        follows = [bool(one and good > _FIT) for one, good in zip(near, fit, strict=True)]
        others = [i + 1 for i, one in enumerate(follows) if one and i != axis and abs(size[i]) > _CROSS]
        held = self._unknown_hands and not free  # whether a hand can explain a smaller motion
        farthest, sided_before = self._before[axis] if self._before else (0.0, 0.0)
        least, most_uneven = _WEAKENED * farthest, _UNEVEN + sided_before
        self._swings = self._swings or (moves[axis] and swing > _ALIVE)
        if not follows[axis]:
            if others and not moves[axis]:
                raise SafetyStop(f"a force on {name} moves encoder {others[0]}: axes are swapped")
            return False
        if not weak and best.explains and sided - unsure > most_uneven:
            what = "its encoder loses counts in one direction" if blamed else "its motor is weak in one direction"
            raise SafetyStop(f"{name} moves much farther in one direction than in the other: {what}")
        if held and (abs(size[axis]) < max(least, 1 / _TEST_RATIO) or (doubt < _LATE and late > most)):
            return False
        if size[axis] < 0:
            wrong = "a positive force moves it to negative counts"
            raise SafetyStop(f"{name} has the wrong sign: {wrong}. Reverse its motor or encoder")
        small = size[axis] < 1 / _TEST_RATIO
        unclear = max(map(sum, uneven)) > most_uneven or (self._block and math.isnan(weaker))
        if weak and (small or sided - unsure > most_uneven or (unclear and not self._closing)):
            return False  # dry friction hides much of a weak motion; a stronger force overcomes it
        if not 1 / _TEST_RATIO <= size[axis] <= _TEST_RATIO:
            than = f"{size[axis]:.2g} times as far as expected of {self._expected.mass[axis]:.3g} kg"
            brake = ", or dry friction brakes it" if small else ""
            raise SafetyStop(f"{name} moves {than}: its encoder step, force step or mass is wrong{brake}")
        if size[axis] < least:
            share = f"{size[axis] / farthest:.2g} times as far as at arming"
            raise SafetyStop(f"{name} moves {share}: its motor has become weak, or saturates at this force")
        if others:
            raise SafetyStop(f"a force on {name} moves encoder {others[0]}, too: two axes are connected to each other")
        if weak and (doubt >= _LATE or abs(late - most) < doubt):
            return False  # a larger motion shows the delay better
        if doubt >= _LATE:
            coarse = f"counts of {1e3 * self._units.encoder_step[axis]:.3g} mm show it to {doubt:.1f} ticks only"
            self.remarks.append(f"a hidden delay of {name} is not tested: {coarse}")
        elif late > most:
            raise SafetyStop(
                f"{name} answers {late:.1f} ticks later than agreed: an encoder or motor has a hidden delay"
            )
        if weaker < _ZONE * own and abs(friction) + doubts[1] < _RUBBED * self._pushed and not self._closing:
            small = f"{weaker / own:.2g} times as far as expected of its motion under twice the force"
            raise SafetyStop(f"{name} moves {small}, and not because of dry friction: its motor has a dead zone")
        self.sizes.append((float(size[axis]), sided))
        return True

    def _unanswered(self) -> str:
        """Return a message about an axis whose encoder has not answered."""
        axis, most = self._axis + 1, self._strongest[self._axis]
        at = f"a test force of up to {most:g} N"
        if self._pushed < _PUSHED * most:
            tested = f"motor and encoder of axis {axis} are not tested"
            return f"the energy left allows {self._pushed:.2g} of {most:g} N: {tested}. Raise --energy-budget"
        count, expected = self._units.encoder_step[self._axis], np.ptp([row[1] for row in self._rows])
        if expected < 2 * count:  # rounding alone can hide such a motion
            faint = f"{at} moves axis {axis} by {1e3 * expected:.2g} mm, less than 2 counts of {1e3 * count:.3g} mm"
            return f"{faint}: its encoder is not tested. Raise --force-cap"
        if self._unknown_hands and self._swings:
            free = f"axis {axis} did not move as a free handle does at the end of the session"
            return f"{free}: a hand held it, or its motor or encoder is wrong"
        if self._closing:
            return f"motor or encoder of axis {axis} did not answer {at} at the end of the session"
        if (moved := self._counted(self._axis)) > self._still[self._axis]:
            return f"axis {axis} does not follow {at} as a free handle does: let go of it while arming"
        return f"encoder of axis {axis} does not follow: it moved by {moved:.0f} counts at {at}. Is its motor on?"


class _Shares(NamedTuple):
    """The least squares fit of four shapes to a motion: expected motion, motion under a friction of 1 N, speed, fault.

    A motor that is weak in one direction adds the motion under the absolute value of the force. An encoder that loses
    counts in one direction adds the length of the path.
    """

    shares: Array  # (4,) coefficients of the shapes
    doubts: Array  # (4,) errors of the coefficients
    explains: bool  # whether the last shape explains most of what the others leave
    rest: float  # [m^2] sum of squares that remains
    fitted: Array  # (n,) [m]

    @classmethod
    def of(cls, shapes: Sequence[Array], motion: Array, noise: float) -> _Shares:
        """Fit shapes (n,) to a `motion` (n,) [m] with a standard deviation of `noise` [m]."""
        columns = np.stack(shapes, axis=1)
        inverse = np.linalg.pinv(columns)
        shares, lengths, fitted = inverse @ motion, np.linalg.norm(inverse, axis=1), columns @ (inverse @ motion)
        rest = float(((motion - fitted) ** 2).sum())
        most = _BETTER * max(0.0, rest - len(motion) * noise**2) * lengths[-1] ** 2
        return cls(shares, 12**0.5 * noise * lengths, bool(shares[-1] ** 2 > most), rest, fitted)


class EncoderMonitor:
    """Check that encoders follow the force while it acts.

    No living hand holds a handle within one count under a changing force; an encoder with one broken channel still
    toggles between two counts. The force that the device reports is compared with the force at the last motion. Changes
    of more than 1 N, or of half of a weak motor's cap, are integrated over time. A mass M whose motion a change F
    reverses stays within two counts of q for 4 sqrt(q M / F), so a coarse encoder gets twice this time. Under a force
    of more than 0.3 N (0.15 of a weak motor's cap), no hand holds still for half a second, because it has a tremor. The
    tremor shows where noise and counts hide less than 30 um. Handles with dry friction F_c may look dead, because
    friction holds them while the force changes by 2 F_c (so 1 N allows F_c = 0.5 N), and hides a tremor below F_c.
    """

    def __init__(self, limits: SafetyLimits, T: float, units: Units, still: Sequence[int]) -> None:
        """Take `still` (m,) [counts], the ranges in which the encoders rest."""
        self._lever, self._T, self._units, self._still, m = limits.lever, T, units, still, len(still)
        #: (m,) [N] unit of force changes: 1 N, or half of the cap of a weak motor
        self._newton = [min(limits.lever, cap / 2) for cap in limits.cap]
        self._band: list[list[int]] | None = None
        tremor = _TREMOR / limits.lever
        self._shown = [(n + 1) * q <= tremor for n, q in zip(still, units.encoder_step, strict=True)]
        self._quiet = [0.0] * m  # [s] time under a force without a motion that shows a tremor
        self._reference = [0.0] * m  # [N] force at the last motion
        self._impulse = [0.0] * m  # [N s] changes of force over time since the last motion

    def check(self, counts: Sequence[int], applied: Sequence[int], ticks: int) -> None:
        """Raise SafetyStop where an encoder is dead. `applied` (m,) [steps] acts from these `counts` (m,) on."""
        if self._band is None:
            self._band = [[n, n] for n in counts]
        for i, (n, steps) in enumerate(zip(counts, applied, strict=True)):
            force, band, still = steps * self._units.force_step[i], self._band[i], self._still[i]
            if n > band[0] + still or n < band[1] - still:
                band[:] = n, n
                self._reference[i], self._impulse[i], self._quiet[i] = force, 0.0, 0.0
                continue
            if n > band[1]:
                band[1] = n
            elif n < band[0]:
                band[0] = n
            change = abs(force - self._reference[i])
            newton = self._newton[i]
            if change > _CHANGE * newton:  # a smaller change neither adds to the impulse nor tightens its limit
                self._impulse[i] += change * ticks * self._T
                q = self._units.encoder_step[i] * still
                if self._impulse[i] > max(_IMPULSE * newton, 8.0 * (q * _HEAVIEST * self._lever**2 * change) ** 0.5):
                    doing = f"it stands still while the force changes by {change:.3g} N"
                    raise SafetyStop(f"encoder of axis {i + 1} does not follow: {doing}")
            pressed = self._shown[i] and abs(force) > _PRESSING * newton
            self._quiet[i] = self._quiet[i] + ticks * self._T if pressed else 0.0

    @property
    def dead(self) -> str | None:
        """Return a message about an encoder that stands still under a long force, or None."""
        for i, seconds in enumerate(self._quiet):
            if seconds > _PRESSED:
                return f"encoder or motor of axis {i + 1} is dead: nothing moves for {_PRESSED:g} s under a force"
        return None
