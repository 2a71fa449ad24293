"""A device that is not there: the scenario's plant under the firmware's own state machine, with faults to order."""

from __future__ import annotations

import numpy as np

from controller.lti import Array
from hw.device import RUNNING, Device
from hw.emulator.plant import EmulatedPlant
from hw.emulator.upset import Upset
from hw.frame import Force, Info
from hw.message import PROTOCOL, Phase
from sim.scenario import Scenario

FORCE_STEP = 400  # [uN]: 12 N are 30000 steps of an i16
ENCODER_STEP = 1e-6  # [m] where the scenario has ideal encoders
REACH = 0.1  # [m] assumed: the workspace is +-10 cm
SETTLED = 50  # ticks at full cap after which the person starts to move
FARTHEST = 2**31 - 1  # [counts]


def info_of(scenario: Scenario) -> Info:
    """What the emulated device says of itself: the scenario's devices, in the units of the wire."""
    encoder = [round(1e12 * (device.encoder_step or ENCODER_STEP)) for device in scenario.device]
    return Info(
        version=PROTOCOL,
        firmware="emulator",
        serial=1,
        period_ns=round(1e9 * scenario.T),
        osp_damping=tuple(round(1e6 * delta) for delta in scenario.delta),
        encoder_step=tuple(encoder),
        force_step=(FORCE_STEP,) * scenario.channels,
        hard_limit=tuple(min(0x7FFF, round(1e6 * d.force_limit / FORCE_STEP)) for d in scenario.device),
        range=tuple(round(1e12 * REACH / step) for step in encoder),
    )


class Emulator:
    """Ticks when it is told to. Knows no clock of its own."""

    def __init__(
        self, scenario: Scenario, upsets: tuple[Upset, ...] = (), info: Info | None = None, coulomb: float = 0.0
    ) -> None:
        self.info = info or info_of(scenario)
        self.device = Device(self.info)
        self.plant = EmulatedPlant(scenario, 1e-12 * np.array(self.info.encoder_step, dtype=float), coulomb)
        self.force_step = 1e-6 * np.array(self.info.force_step, dtype=float)
        self.armed_at: int | None = None  # [us] of the first arming: faults are timed from here
        self.begun_at: int | None = None  # tick at which the person began to move
        self.unplugged = False
        self.stalled_until = 0  # [us]
        self.stretch = 1.0  # length of a tick in T
        self.applied: Array = np.zeros(scenario.channels)  # [N] by the motors
        self._offset = [0] * scenario.channels  # [counts] of an encoder that jumped
        self._waiting = list(upsets)
        self._ready = 0

    def since_armed(self, now: int) -> float | None:
        """Seconds since the first arming."""
        return None if self.armed_at is None else 1e-6 * (now - self.armed_at)

    def receive(self, data: bytes, now: int) -> None:
        """Bytes from the host; a device without a cable, or frozen, hears nothing."""
        if not self.unplugged and now >= self.stalled_until:
            self.device.receive(data, now)

    def tick(self, now: int) -> bytes:
        """A period begins: sample, latch, answer. `now` is the device's clock [us]; advance() goes with every tick."""
        self._misbehave(now)
        counts = tuple(
            max(-FARTHEST, min(FARTHEST, n + o)) for n, o in zip(self.plant.counts(), self._offset, strict=True)
        )
        steps, data = self.device.tick(now, counts)
        if self.device.phase in RUNNING and self.armed_at is None:
            self.armed_at = now
        self._wake_person()
        self.applied = np.array(steps) * self.force_step
        return b"" if self.unplugged else data

    def advance(self) -> None:
        """The plant moves on by a period, while the answer is on its way."""
        self.plant.advance(-self.applied)

    def _wake_person(self) -> None:
        config = self.device.config
        self._ready += config is not None and self.armed_at is not None and self.device.run >= config.ramp_in
        if self._ready >= SETTLED and self.begun_at is None:
            self.begun_at = self.device.k
            self.plant.begin()

    def _misbehave(self, now: int) -> None:
        for upset in [u for u in self._waiting if u.active(self.since_armed(now))]:
            self._waiting.remove(upset)
            match upset.kind:
                case "stall":
                    self.stalled_until = now + round(1e6 * upset.value)
                case "unplug":
                    self.unplugged = True
                case "reset":
                    self.device = Device(self.info)
                case "jump":
                    self._offset[0] += round(1e-3 * upset.value / (1e-12 * self.info.encoder_step[0]))
                case "leap":
                    self.device.k = (self.device.k + round(upset.value)) & 0xFFFF
                case "own":
                    self.device = wilful(self.device, round(upset.value / self.force_step[0]))
                case "stuck":
                    self.device.halt = lambda cause: None
                case "period":
                    self.stretch = upset.value
                case "estop":
                    self.device.estop()
                case "trip":
                    self.device.fault()


def wilful(device: Device, force: int) -> Device:
    """The same device with motors that have `force` [steps] while it is armed, whatever it is told."""
    obeys = device.latch

    def latch(frame: Force | None) -> None:
        obeys(frame)
        if device.phase in (Phase.ARMED, Phase.HOLDING):
            device.applied = (force,) * device.info.axes

    device.latch = latch
    return device
