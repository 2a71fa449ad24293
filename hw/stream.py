"""A device that streams: which STATEs are news, the force that answers each, and whether the link holds. No stages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hw.drive import Drive, Row
from hw.frame import Config, Force, State, encode
from hw.handshake import Units
from hw.law import Controller
from hw.measurement import Measurement
from hw.message import Command
from hw.safety import Fault, Limits
from hw.watch import FRESH, Counters, LinkWatch

QUIET_US = 1_000_000  # longest silence of a device that has no force to take away

UNTOLD = 0.9  # part of STATEs without a margin above which nobody can judge the link; a USB frame may carry several


@dataclass(frozen=True)
class Settings:
    """How a session judges its link."""

    baud: int | None = None  # of a UART; None for a link without one (USB, pseudo-terminal)
    measure: int = 800  # answers whose age is measured
    window: int = 200  # ticks over which misses are judged
    late: float = 0.1  # part of late answers above which the coupling is too fast for the link
    missed: float = 0.2  # part of missing answers above which nothing is certified: mean-square stability ends there


USUAL = Settings()


class Stream:
    """What a session knows of the ticks."""

    def __init__(self, limits: Limits, settings: Settings, probe: int, T: float) -> None:
        self._limits, self._settings = limits, settings
        self.counters = Counters()
        self.watch = LinkWatch(settings.window, self.counters)
        self.measurement = Measurement(settings.measure, probe, T, settings.missed)
        self.drive: Drive | None = None  # from one arming to the next end
        self.missed_while_driving = 0
        self.heard = 0  # [us]

    def restart(self, now: int) -> None:
        """The device streams anew, with another delay."""
        self.watch.restart()
        self.heard = now

    def arm(self, law: Controller, units: Units, config: Config, record: Callable[[Row], None], arming: int) -> None:
        """From the next STATE on the answers come from `law`."""
        self.drive = Drive(law, units, config, self._limits, self.counters, record, arming)

    def silence(self, now: int, driving: bool) -> str | None:
        """How long there was no news, where that is too long."""
        lasts = now - self.heard
        allowed = self._limits.watchdog_us if driving else QUIET_US
        return f"no new STATE for {lasts / 1000:.1f} ms" if lasts > allowed else None

    def news(self, state: State, now: int) -> int:
        """Ticks since the STATE before; 0 where this one is no news."""
        verdict, ticks = self.watch.order(state)
        if verdict != FRESH:
            return 0
        self.heard = now
        self.watch.note(state)
        return ticks

    def measured(self, state: State) -> bool:
        """Whether the delay has been measured, with this one. Raises Fault where the link cannot be used."""
        return self.measurement.note(state, self.watch.margins[-1], self.watch.missed[-1])

    def step(self, state: State, ticks: int, direction: int, now: int) -> tuple[int, ...]:
        """The force [steps] that answers `state`; the gain rises, falls or stays. Raises Fault."""
        assert self.drive is not None
        self.missed_while_driving += self.watch.missed[-1]
        return self.drive.step(state, ticks, direction, now)

    def too_late(self) -> str | None:
        """Whether the link has become slower than the coupling was certified for, in words.

        Raises Fault where too little of it arrives at all.
        """
        late, missed = self.watch.late_part, self.watch.missed_part
        if missed > self._settings.missed + late:
            raise Fault(f"{100 * missed:.0f} % of the last {self._settings.window} ticks had no answer in time")
        if self.watch.gap_part > self._settings.missed:
            part = f"{100 * self.watch.gap_part:.0f} % of {self._settings.window} ticks"
            raise Fault(f"no STATE came of {part}: nobody can say what the device did")
        if self.watch.untold_part > UNTOLD:
            most = f"{100 * UNTOLD:g} % of the last {self._settings.window} STATEs"
            raise Fault(f"{most} told no margin: nobody can say how late answers are")
        if late > self._settings.late:
            return f"{100 * late:.0f} % of the last {self._settings.window} answers were late"
        return None


def answer(config: Config, state: State, command: Command, steps: tuple[int, ...] | None = None) -> bytes:
    """The FORCE for a STATE: zero where no `steps` are given."""
    apply_at = (state.tick + config.theta) & 0xFFFF
    return encode(Force(command, apply_at, state.tick, steps or (0,) * state.axes))
