"""Check that link and device behave as the certificate assumes: delay, clocks, late answers and applied forces.

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

import numpy as np

from haptic_loop.hw.protocol import NO_MARGIN, Config, Phase, SafetyStop, State, distance

_LATE = 0.1  # largest share of late answers; above it the link is slower than the coupling is certified for
_MISSED = 0.2  # largest share of missing answers; loops with a larger share may lose mean-square stability
_STATES_PER_ANSWER = 8  # most STATEs per measured age: a STATE reports one margin for all FORCEs of a USB frame
_INFERRED = 0.005  # largest share of inferred ages: half of the 1 % of ages that the default quantile leaves out
_UNTOLD = 0.9  # largest share of STATEs without a margin; USB frames that carry several FORCEs cause some
_DRIFT = 0.01  # Over a block of ticks, a clock may be wrong by at most this share of the time.
_BLOCK = 200  # ticks over which the device's clock is compared, and late and missing answers are counted
_HOST_BLOCK = 2000  # ticks over which the host's clock is compared: a busy host may read its clock 20 ticks late
_CLOCK_US = 1.5  # [us] largest error of the difference of two time stamps of the device
_REMEMBERED = 64  # most forces or latches that are stored; at most the last theta still matter
_ROUNDING = 1  # [steps] largest difference that a firmware's rounding may cause
_PATIENCE = 5  # wrong ticks in a row at which a session stops
_FORGETTING = 8  # right ticks that cancel one wrong tick; a session also stops if wrong ticks stay more frequent


@dataclass(frozen=True)
class LinkSettings:
    """Settings of a session: its link, its conditions for arming, and its tests."""

    baud: int | None = None  # baud rate of a UART; None for a link without UART (USB, pseudo-terminal)
    measure: int = 800  # answers whose age is measured
    test_encoders: bool = True  # whether a small force tests the encoders at every arming
    #: whether the session identifies a device: forces to play begin after the test, which is not repeated at the end
    identifies: bool = False
    held: bool = True  # whether the scenario's hands hold the handles in that test (rehearsals), or nobody does
    energy_budget: tuple[float, float] | None = None  # W0 and cap [J]
    rereference: bool = True  # whether positions count from the handles' place at arming
    deadman: bool = False  # whether forces act only while the deadman at the device is held
    behind: tuple[int, ...] = ()  # (m,) with several boards, ticks added to the link's delay (hw/boards.py)
    check_axes: bool = False  # whether a person must move every axis in its + direction before the first arming
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
        longest = float(_entry(sorted(self.ticks), q))
        return longest if longest > T_us + _CLOCK_US else T_us

    def shortest_tick(self, T_us: float, q: float = 1.0) -> float:
        """Return the length [us] that a fraction q of ticks has at least, or T unless this is below T - _CLOCK_US."""
        shortest = float(_entry(sorted(self.ticks, reverse=True), q)) or T_us
        return shortest if shortest < T_us - _CLOCK_US else T_us

    def quantile(self, q: float) -> int:
        """Return the least age that a fraction q of forces does not exceed. Raises SafetyStop if fewer arrived."""
        age = _entry([*sorted(self.values), *[math.inf] * self.missing], q)
        if age == math.inf:
            part = 100 * self.missing / (len(self.values) + self.missing)
            raise SafetyStop(f"{part:.2g} % of the answers never arrived: no delay covers {100 * q:g} % (--quantile)")
        return int(age)

    def link_delay(self, T_us: float, q: float, guard_us: float) -> int:
        """Return the least delay [ticks, >= 1] that covers the ages of a fraction q of the answers plus a guard."""
        return max(1, int(-(-(self.quantile(q) + guard_us) // T_us)))

    @property
    def median(self) -> int:
        """The median age of the answers that arrived [us]."""
        return sorted(self.values)[len(self.values) // 2]


def _entry(ordered: Sequence[float], q: float) -> float:
    """Return the entry of an ordered sequence that a share q of the entries precedes; 0 if the sequence is empty."""
    return ordered[min(len(ordered) - 1, int(q * len(ordered)))] if ordered else 0.0


class AnswerAges:
    """The age of each answer, derived from STATEs and stored under the number of the answered tick.

    A STATE reports the margin of the last answer that came. Where a burst brings n answers between two STATEs, `echo`
    advances by n, and the other n-1 answers are up to (n-1) T older. They count with these larger ages, because the
    delay must cover these answers, too.
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

    A limit on the number of STATEs ends the measurement in any case. Where too many ages are inferred, a late answer
    may have come together with a younger answer, which hides it. Then a second round measures half as many ages
    exactly. The host still answers every STATE, so that the load of the link is the same, but it sends most answers for
    a wrong tick, so that the device ignores them. The distances of accepted answers are random, so that bursts meet
    each answer with the same probability. The least distance is the longest age, or theta if that is less; the largest
    distance is below twice the least.
    """

    def __init__(self, needed: int, theta: int, T: float) -> None:
        self._needed, self._theta, self._T_us = needed, theta, 1e6 * T
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
        else:
            if margin is not None and tick in self._sent:
                self._answers.by_tick[tick] = self._answers.age(margin)
            if not missed:  # An answer without an age has come, too: the STATE with its age was lost.
                latched = self._tick - self._theta
                self._sent -= {t for t in range(latched - passed + 1, latched + 1) if t not in self._answers.by_tick}
        ages, needed = self._answers.by_tick, self._needed if self._sent is None else -(-self._needed // 2)
        everything, counted = len(ages) + self._missing, counted // (2 * self._apart - 1)
        if everything < needed and counted < _STATES_PER_ANSWER * needed:
            return False
        part = 1 - len(ages) / max(1, everything if everything >= needed else counted)
        if part > _MISSED:
            raise SafetyStop(f"{100 * part:.0f} % of the answers never reached the device, {self._states} STATEs came")
        elapsed, ticks = (state.t_us - self._first.t_us) & 0xFFFFFFFF, distance(state.tick, self._first.tick)
        if ticks > 0 and abs(elapsed / (ticks * self._T_us) - 1) > _DRIFT:
            each = f"{elapsed / ticks:.1f} us by its time stamps, T is {self._T_us:g} us"
            raise SafetyStop(f"a tick of the device lasts {each}")
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
    limited: int = 0  # ticks in which the energy budget or a world's shell made forces smaller
    unlike: int = 0  # ticks at which the device applied a force that the host did not send


class LinkMonitor:
    """Check the order of STATEs, and count late answers, missed answers and ticks without STATE in a sliding window."""

    def __init__(self, counters: Counters) -> None:
        self.counters = counters
        self.needed = 0.0  # [us] least margin of an answer that is not late
        self.restart()

    def restart(self) -> None:
        """Clear the window after a new delay was configured."""
        self.last: State | None = None
        self.margin: int | None = None  # [us] margin in the last new STATE; None if that STATE has no margin
        self.missed = 0  # missed ticks that the last new STATE reports
        self._margins = deque[int | None](maxlen=_BLOCK)  # [us] margins of the last STATEs
        #: for each STATE: 1 if its answer was late, missed ticks, ticks without a STATE before it, 1 without a margin
        self._window = deque([(0, 0, 0, 0)] * _BLOCK)
        self._sums = [0, 0, 0, 0]  # sums over the window, updated tick by tick

    def take(self, state: State, ignored: Container[int] = ()) -> int:
        """Process a STATE and return the ticks since the previous one, or 0 for a repeated or older tick.

        A tick in `ignored` (modulo 2^16) is not missed, because the host sent its answer for a wrong tick on purpose.
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
        self._margins.append(self.margin)
        self.counters.states += 1
        self.counters.gaps += ahead - 1
        self.counters.misses += self.missed
        self.counters.late += late
        newest, oldest = (late, self.missed, ahead - 1, self.margin is None), self._window.popleft()
        self._window.append(newest)
        if newest != oldest:  # This saves 1 us in most ticks.
            self._sums = [total + new - old for total, new, old in zip(self._sums, newest, oldest, strict=True)]
        self.last = state
        return ahead

    @property
    def least_margin(self) -> int | None:
        """The least of the last margins [us]; None if no answer came."""
        return min((margin for margin in self._margins if margin is not None), default=None)

    def too_late(self) -> str | None:
        """Return a message if the link has become slower than the coupling was certified for, else None.

        Shares are relative to a full window, also before it is full. Raises SafetyStop where too few messages arrive.
        """
        late, missed, gaps, untold = (total / _BLOCK for total in self._sums)
        missed = min(1.0, missed)
        if missed > _MISSED + late:
            raise SafetyStop(f"{100 * missed:.0f} % of the last {_BLOCK} ticks had no answer in time")
        if gaps > _MISSED:
            raise SafetyStop(f"no STATE in {100 * gaps:.0f} % of {_BLOCK} ticks: the device's forces are unknown")
        if untold > _UNTOLD:
            most = f"more than {100 * _UNTOLD:g} % of the last {_BLOCK} STATEs"
            raise SafetyStop(f"{most} lack a margin: their lateness is unknown")
        return f"{100 * late:.0f} % of the last {_BLOCK} answers were late" if late > _LATE else None


# The clocks of device and host are both compared with the tick number. A device may compute its clock from its ticks;
# then only the host's clock reveals wrong ticks.


@dataclass
class _ClockDrift:
    """Compare a clock with ticks of `T_us` in blocks. Each block excludes its longest delay, which may be a freeze."""

    measure: str  # name of the clock in messages
    T_us: float
    block: int  # [ticks]
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
            if abs(drift) > _DRIFT * self.block * self.T_us:
                lasts = self.T_us + drift / self._ticks
                what = f"over {self._ticks} tick{'s' if self._ticks > 1 else ''}, T is {self.T_us:g} us"
                if lasts <= 0:
                    raise SafetyStop(f"the time by {self.measure} goes back {what}")
                raise SafetyStop(f"a tick of the device lasts {lasts:.4g} us by {self.measure} {what}")
            if self._ticks >= self.block:
                self._ticks, self._behind, self._freeze = 0, 0.0, 0.0
        self._last = at_us


class ClockMonitor:
    """Check both clocks and the tick number while forces act."""

    def __init__(self, watchdog_us: int, T: float) -> None:
        T_us = 1e6 * T
        self.most = max(1, int(watchdog_us / T_us))  # [ticks] largest advance from one STATE to the next
        self._device = _ClockDrift("its time stamps", T_us, _BLOCK, watchdog_us)
        self._host = _ClockDrift("the host's clock", T_us, _HOST_BLOCK, watchdog_us)

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
        """Return whether `state.applied` is possible after the force `last`, for a device that was `told` a force."""
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
