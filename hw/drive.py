"""From a STATE to the force that answers it, while forces act: law, gain, limits, steps, record."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from controller.lti import Array
from hw.clock import Clock
from hw.conduct import Told
from hw.frame import Config, State
from hw.handshake import Units
from hw.law import Controller, fill
from hw.safety import Gain, Limits, check_jolt, check_jump, check_range, shape
from hw.watch import Counters


class Row(NamedTuple):
    """One tick of a trace. Where `state` is None no STATE came: x is filled in and nothing was sent."""

    tick: int  # modulo 2^16
    x: tuple[float, ...]  # (m,) [m]
    asked: Array  # (m,) [N] by the controller
    gain: float
    sent: tuple[int, ...]  # [steps]
    state: State | None
    arming: int = 0  # which arming of the session this belongs to


class Drive:
    """The coupling at work, from one arming to the next end."""

    def __init__(
        self,
        law: Controller,
        units: Units,
        config: Config,
        limits: Limits,
        counters: Counters,
        record: Callable[[Row], None],
        arming: int = 0,
    ) -> None:
        self.law, self.units, self.config, self.limits = law, units, config, limits
        self.T = law.T
        self.gain = Gain(limits, law.T)
        self.force = (0.0,) * config.axes  # [N] the last one sent
        self.x: tuple[float, ...] | None = None  # [m] of the last STATE
        self._before: tuple[float, ...] | None = None  # [m] of the STATE before that, where none is missing
        self._counters, self._record, self._arming = counters, record, arming
        self._told, self._clock = Told(config), Clock(limits, law.T)

    def step(self, state: State, ticks: int, direction: int, now: int) -> tuple[int, ...]:
        """The force [steps] that answers `state`, which came at `now` [us], `ticks` after the one before.

        The gain rises (direction 1), falls (-1) or stays (0). Raises Fault where the device, an encoder or the
        controller is out of bounds.
        """
        if self.x is None:
            ticks = 1  # what went before does not count
        self._clock.check(state, ticks, now)
        x = self.units.positions(state.counts)
        check_range(x, self.units.reach)
        if self.x is None:
            positions = [x]
        else:
            check_jump(x, self.x, ticks, self.limits)
            if ticks == 1 and self._before is not None:
                check_jolt(x, self.x, self._before, self.limits)
            positions = fill(self.x, x, ticks)
        self._counters.unlike += self._told.unlike(state, ticks)
        self._miss(state, positions[:-1])
        asked = self.law.step(x)
        if direction:
            (self.gain.rise if direction > 0 else self.gain.fall)(ticks)
        shaped = shape(asked.tolist(), self.force, self.gain.value, self.limits, self.T)
        self._before, self.x, self.force = self.x if ticks == 1 else None, x, shaped.force
        self._counters.clipped += shaped.clipped
        self._counters.slowed += shaped.slowed
        steps = self.units.steps(shaped.force, self.config.cap)
        self._told.tell(state.tick, steps)
        self._record(Row(state.tick, x, asked, self.gain.value, steps, state, self._arming))
        return steps

    def _miss(self, state: State, positions: list[tuple[float, ...]]) -> None:
        """The law moves on through ticks of which no STATE came."""
        for back, x in zip(range(len(positions), 0, -1), positions, strict=True):
            tick, asked = (state.tick - back) & 0xFFFF, self.law.step(x)
            self._record(Row(tick, x, asked, self.gain.value, (), None, self._arming))
