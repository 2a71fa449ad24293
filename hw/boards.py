"""Drive several boards, each with its own clock, as one device (docs/hardware.md, "Two boards, two clocks").

In a step, the host takes one sample of every board and computes one force for each. Steps are numbered by the ticks of
the leading board. Each other board contributes its next sample, or repeats its last sample where its clock has fallen
behind by a period. A repeated sample is a tick of length zero, in which no force exchanges energy. So every board sees
forces that are a whole number of steps old, and ticks of at most its own period. A certificate for T_max
covers these delays and ticks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from statistics import median
from typing import Any

from haptic_loop.hw import protocol as wire
from haptic_loop.hw.control import CLOCK_TOLERANCE
from haptic_loop.hw.haptic_device import LONGEST_WAIT, PortLost, SerialDevice
from haptic_loop.hw.monitor import CommandMonitor

_CLEARLY_FASTER = 1e-4  # relative difference of two clocks that stands out from jitter after _COMPARED ticks
# The lead of a sample is the time by which it comes before the leading board's sample of the same step.
_EARLY = 1 / 16  # [periods] least lead; with a smaller lead, steps may have to wait for the sample
_TOO_EARLY = 1.5  # [periods] largest lead; with a larger lead, the board's force may come too late
_SMOOTHED = 31  # number of leads whose median is used; a host that freezes for a few ticks does not change the median
_KEPT = 8  # latest samples of a board that are stored
_COMPARED = 400  # ticks over which clocks are compared before forces act
_EXCHANGE = "exchange the ports, or the delays (--theta)"
#: phases of a board that the STATE of all boards shows before ARMED and HOLDING, the worst first
_FAULTS = (wire.Phase.ESTOP, wire.Phase.RAMP, wire.Phase.STOPPED, wire.Phase.SILENT, wire.Phase.DISARMED)


def ticks_behind(theta: Sequence[int], axes: Sequence[int]) -> tuple[int, ...]:
    """Return the ticks (m,) by which forces of each channel act later than the link's delay.

    The first board with the least delay leads. Its channels act 0 ticks later, those of the other boards 1 tick.
    `theta` (m,) are the delays of the channels [samples], `axes` the numbers of channels of the boards.
    """
    owner = [i for i, n in enumerate(axes) for _ in range(n)]
    lead = min(range(len(axes)), key=lambda i: min(n for n, own in zip(theta, owner, strict=True) if own == i))
    return tuple(int(own != lead) for own in owner)


class _Board:
    """One board, its last samples, and how its ticks are paired with the steps of the host."""

    def __init__(self, device: SerialDevice, axes: slice, behind: int) -> None:
        self.device, self.axes, self.behind = device, axes, behind
        self.info: wire.Info | None = None
        self.period = 0.0  # [us] length of a tick, from INFO
        self.ages: list[int] = []  # [us] ages of its answers, without the time that they waited for other boards
        self.has_deadman = False
        self.last: wire.State | None = None  # newest STATE that came after the last CONFIG; None before
        self.misses = 0  # State.misses in the sample of the last step
        self._start: tuple[int, float, int] | None = None  # step, lead [us] and offset from which clocks are compared
        self._steps = 0  # steps since the first pairing
        self._shifted = 0  # value of `_steps` when `offset` was last lowered

    def configure(self, config: wire.Config) -> None:
        """Forget all samples and store the board's part of a configuration."""
        theta = min(wire.MAX_THETA, config.theta + self.behind)
        self.config = config._replace(theta=theta, cap=config.cap[self.axes], slew=config.slew[self.axes])
        self.told = CommandMonitor(self.config)
        self.answer: int | None = None  # result in the board's ACK to the configuration
        self.last = None
        self.states: dict[int, tuple[wire.State, int]] = {}  # by tick: a sample and its time of arrival [us]
        self.waited: dict[int, int] = {}  # [us] by source: time from the arrival of a sample to its answer
        self.offset: int | None = None  # the board's tick number minus the step's
        self._shift_at: int | None = None  # step from which on the offset is smaller by one
        self._leads: deque[int] = deque(maxlen=_SMOOTHED)  # [us] leads of its last samples

    def hear(self, state: wire.State, now: int, driving: bool) -> None:
        """Receive a STATE. Raises SafetyStop if the board keeps applying wrong forces, or holds a force too long."""
        ticks = wire.distance(state.tick, self.last.tick) if self.last else 1
        if ticks <= 0:
            return
        if state.phase not in _FAULTS:
            self.told.unlike(state, ticks)
        if not driving and state.margin_us != wire.NO_MARGIN and state.echo in self.waited:
            self.ages.append(round(self.config.theta * self.period) - state.margin_us - self.waited[state.echo])
        self.last, self.has_deadman = state, self.has_deadman or state.deadman
        self.states[state.tick] = state, now
        _forget(self.states, _KEPT)

    def tick_of(self, step: int) -> int:
        """Return the tick number of this board's sample in a step."""
        assert self.offset is not None
        shifted = self._shift_at is not None and wire.distance(step, self._shift_at) >= 0
        return (step + self.offset - shifted) & 0xFFFF

    def sample(self, step: int, at: int) -> wire.State | None:
        """Return the sample for a step that began at `at` [us], or None if that sample has not come."""
        if self.offset is None:  # pair the step with the newest sample that is early enough
            early = [tick for tick, (_, came) in self.states.items() if at - came >= _EARLY * self.period]
            if self.behind and not early:
                return None
            self.offset, self._shift_at = wire.distance(early[-1], step) if self.behind else 0, None
            self._leads.clear()
        came = self.states.get(self.tick_of(step))
        return came[0] if came else None

    def follow(self, step: int, at: int, driving: bool) -> None:
        """Change the pairing of steps and samples if the median lead is outside of its limits.

        Raises SafetyStop if this clock is clearly faster than the leading clock, or slower beyond CLOCK_TOLERANCE.
        """
        assert self.offset is not None
        if self._shift_at is not None and wire.distance(step, self._shift_at) >= 0:
            self.offset, self._shift_at = self.offset - 1, None
            self._leads.clear()
        self._leads.append(at - self.states[self.tick_of(step)][1])
        self._steps += 1
        if len(self._leads) < _SMOOTHED or self._steps % (_SMOOTHED // 2):
            return
        lead = median(self._leads)
        if not driving:
            self._compare(step, lead)
            if not _EARLY <= lead / self.period <= 1 + 2 * _EARLY:
                self.offset = None
        elif lead > _TOO_EARLY * self.period:
            raise wire.SafetyStop(f"its clock is faster than that of the board that leads: {_EXCHANGE}")
        elif lead < _EARLY * self.period and self._shift_at is None:
            if self._shifted and self._steps - self._shifted < 1 / CLOCK_TOLERANCE - _SMOOTHED:
                raise wire.SafetyStop(
                    f"its clock is more than {100 * CLOCK_TOLERANCE:g} % slower than the leading clock"
                )
            self._shifted, self._shift_at = self._steps, (step + self.config.theta + 1) & 0xFFFF

    def _compare(self, step: int, lead: float) -> None:
        """Raise SafetyStop if this clock is clearly faster than the leading clock, or slower beyond CLOCK_TOLERANCE."""
        assert self.offset is not None
        if self._start is None or (elapsed := wire.distance(step, self._start[0])) < 0:
            self._start = step, lead, self.offset
        elif elapsed >= _COMPARED:
            drift = lead - self._start[1] + wire.distance(self.offset, self._start[2]) * self.period
            faster = drift / (elapsed * self.period)
            if faster > _CLEARLY_FASTER:
                ppm = f"{1e6 * faster:.0f} ppm faster than that of the board that leads"
                raise wire.SafetyStop(f"its clock is {ppm}: {_EXCHANGE}")
            if -faster > CLOCK_TOLERANCE:
                raise wire.SafetyStop(f"its clock is {-100 * faster:.2g} % slower than the leading clock")

    def due(self, step: int) -> int | None:
        """Return the tick at which the force of a step acts, or None if that tick has no length."""
        later = (step + self.config.theta) & 0xFFFF
        tick = self.tick_of(later)
        return None if tick == self.tick_of((later + 1) & 0xFFFF) else tick

    def send(self, force: wire.Force, now: int) -> None:
        """Send this board's part of the force that answers step `force.source`, computed at `now` [us].

        Nothing is sent where the tick of that force has no length.
        """
        if self.offset is None or (apply_at := self.due(force.source)) is None:
            return
        source, steps = (apply_at - self.config.theta) & 0xFFFF, force.force[self.axes]
        if sample := self.states.get(self.tick_of(force.source)):
            self.waited[source] = now - sample[1]
            _forget(self.waited, 4 * wire.MAX_THETA)
        self.told.tell(source, steps)
        self.device.send(wire.Force(force.command, apply_at, source, steps))


def _forget(entries: dict[int, Any], count: int) -> None:
    """Drop the oldest entries, and keep the newest `count`."""
    while len(entries) > count:
        entries.pop(next(iter(entries)))


class Boards:
    """Drive several boards at serial ports as one device with all their axes."""

    def __init__(
        self,
        devices: Sequence[SerialDevice],
        axes: Sequence[int],
        behind: Sequence[int],
        clock: Callable[[], int],
        wait: Callable[[float], object],
    ) -> None:
        """Take the boards, their numbers of axes, `behind` (m,) as `ticks_behind` returns it, and the `clock` [us].

        `wait(seconds)` returns when a board has sent something, and after `seconds` at the latest.
        """
        ends = [sum(axes[: i + 1]) for i in range(len(axes))]
        self._boards = [
            _Board(device, slice(end - n, end), behind[end - 1])
            for device, n, end in zip(devices, axes, ends, strict=True)
        ]
        self._lead = next(board for board in self._boards if not board.behind)
        self._clock, self._wait = clock, wait
        self._asked: wire.Config | None = None  # configuration that not all boards have acknowledged yet
        self._step: int | None = None  # number of the last step
        self._configured, self._driving, self._misses = False, False, 0

    @property
    def errors(self) -> int:
        """Number of frames that could not be read."""
        return sum(board.device.errors for board in self._boards)

    @property
    def dropped(self) -> int:
        """Number of bytes that the ports did not accept at once."""
        return sum(board.device.dropped for board in self._boards)

    @property
    def ages(self) -> list[list[int]]:
        """Ages of the answers of every board [us], without the time that they waited for other boards."""
        return [board.ages for board in self._boards]

    def info(self) -> wire.Info | None:
        """Return one INFO for all axes, or None until every board has sent its INFO.

        Raises SafetyStop if the boards do not fit together.
        """
        with self._together():
            for board in self._boards:
                board.info = board.info or board.device.info()
            known = [board.info for board in self._boards if board.info]
            if len(known) < len(self._boards):
                self._wait(LONGEST_WAIT)
                return None
        first = known[0]
        for i, (info, board) in enumerate(zip(known, self._boards, strict=True), start=1):
            expected = board.axes.stop - board.axes.start
            if (info.version, info.period_ns, info.axes) != (first.version, first.period_ns, expected):
                told = f"version {info.version}, {info.period_ns} ns, axes: {info.axes}"
                wanted = f"version {first.version}, {first.period_ns} ns, axes: {expected}"
                raise wire.SafetyStop(f"board {i} has {told}; expected {wanted}")
            board.period = 1e-3 * info.period_ns
        columns = {name: sum((getattr(info, name) for info in known), ()) for name in first._fields[4:]}
        return first._replace(firmware=" + ".join(dict.fromkeys(info.firmware for info in known))[:16], **columns)

    def configure(self, config: wire.Config) -> int | None:
        """Send each board its part of `config` with its extra delay.

        Return the highest result, or None until all boards have answered.
        """
        if config != self._asked:
            self._asked, self._step, self._driving = config, None, False
            for board in self._boards:
                board.configure(config)
        with self._together():
            for i, board in enumerate(self._boards, start=1):
                with _named(i):
                    if board.answer is None:
                        board.answer = board.device.configure(board.config)
                    else:
                        board.device.exchange(None)  # discard the STATEs that a configured board already sends
        answers = [board.answer for board in self._boards if board.answer is not None]
        if len(answers) < len(self._boards):
            self._wait(LONGEST_WAIT)
            return None
        self._asked, self._configured = None, True
        return max(answers)

    def exchange(self, force: wire.Force | None) -> wire.State | None:
        """Send every board its part of a force, and return the STATE of the next step, or None until it is complete."""
        if not self._configured:
            self._wait(LONGEST_WAIT)
            return None
        heard = False
        with self._together():
            if force is not None:  # the leading board first: its delay is the shortest
                for board in sorted(self._boards, key=lambda board: board.behind):
                    board.send(force, self._clock())
            for i, board in enumerate(self._boards, start=1):
                if (state := board.device.exchange(None)) is not None:
                    heard = True
                    with _named(i):
                        board.hear(state, self._clock(), self._driving)
            if not heard:
                self._wait(LONGEST_WAIT)
        return self._next()

    def stop(self, reason: wire.Reason) -> None:
        """Send STOP to every board, also if one of them no longer answers."""
        for board in self._boards:
            with suppress(PortLost):
                board.device.stop(reason)

    def _next(self) -> wire.State | None:
        """Return the STATE of the newest step if it is complete and was not returned before, else None."""
        if (last := self._lead.last) is None or last.tick == self._step:
            return None
        step, (_, at) = last.tick, self._lead.states[last.tick]
        samples = [sample for board in self._boards if (sample := board.sample(step, at)) is not None]
        if len(samples) < len(self._boards):
            return None
        self._step = step
        state = self._merged(step, samples)
        for i, board in enumerate(self._boards, start=1):
            if board.behind:
                with _named(i):
                    board.follow(step, at, self._driving)
        return state

    def _merged(self, step: int, samples: Sequence[wire.State]) -> wire.State:
        """Return one STATE with the worst phase and margin, the sum of errors, and the axes of all boards in order.

        In each step the misses grow by the misses of the board that missed most. The phases come from the last STATE of
        every board, not from the samples of the step, so a fault shows at once.
        """
        last = [board.last for board in self._boards if board.last]
        worst = min(last, key=lambda state: _FAULTS.index(state.phase) if state.phase in _FAULTS else len(_FAULTS))
        phase = worst.phase if worst.phase in _FAULTS else max(state.phase for state in last)
        held = [state.deadman for board, state in zip(self._boards, last, strict=True) if board.has_deadman]
        self._driving = phase in (wire.Phase.ARMED, wire.Phase.HOLDING)
        missed = []
        for board, state in zip(self._boards, samples, strict=True):
            missed.append((state.misses - board.misses) & 0xFF)
            board.misses = state.misses
        self._misses += max(missed)
        return self._lead.states[step][0]._replace(
            status=phase | worst.cause << 4 | wire.DEADMAN * (bool(held) and all(held)),
            margin_us=self._margin(samples),
            crc_errors=sum(state.crc_errors for state in samples) & 0xFF,
            misses=self._misses & 0xFF,
            counts=sum((state.counts for state in samples), ()),
            applied=sum((state.applied for state in samples), ()),
        )

    def _margin(self, samples: Sequence[wire.State]) -> int:
        """Return the least margin of the boards' answers [us], or NO_MARGIN if a board reports no margin.

        Until forces act, the margin excludes the wait for other boards.
        """
        margins = []
        for board, state in zip(self._boards, samples, strict=True):
            if state.margin_us == wire.NO_MARGIN:
                return wire.NO_MARGIN
            margins.append(state.margin_us + (0 if self._driving else board.waited.get(state.echo, 0)))
        return min(*margins, 0x7FFF)

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Send STOP to all boards if the port of one of them is lost."""
        try:
            yield
        except PortLost:
            self.stop(wire.Reason.FAULT)
            raise


@contextmanager
def _named(board: int) -> Iterator[None]:
    """Put the number of the board in front of a fault's message."""
    try:
        yield
    except wire.SafetyStop as fault:
        raise wire.SafetyStop(f"board {board}: {fault}") from None
