"""What host and device say to each other, as tuples of integers. hw/frame.py turns them into bytes."""

from enum import IntEnum
from typing import NamedTuple

PROTOCOL = 1
MAX_AXES = 8
MAX_THETA = 15
MAX_RELEASE_NS = 20_000_000  # longest hold and ramp together: 12 N for 20 ms bring a free 0.25 kg to 1 m/s
NO_MARGIN = -32768  # in State.margin_us: no FORCE came since the STATE before


class Phase(IntEnum):
    """States of the device, the low four bits of a status."""

    SILENT = 0
    DISARMED = 1
    ARMED = 2
    HOLDING = 3
    RAMP = 4
    STOPPED = 5
    ESTOP = 6


class Cause(IntEnum):
    """Why the device is where it is, the high four bits of a status."""

    NONE = 0
    HOST = 1  # a STOP from the host
    WATCHDOG = 2  # more than `hold` ticks without a force
    COMMAND = 3  # a FORCE with a command that has no place while armed
    DEVICE = 4  # the firmware found a fault of its own
    ESTOP_DEVICE = 5  # the emergency stop at the device
    ESTOP_HOST = 6  # a STOP with reason ESTOP


class Command(IntEnum):
    """What a FORCE asks for; only RUN may carry a force other than zero."""

    IDLE = 0
    ARM = 1
    RUN = 2


class Refused(IntEnum):
    """Why a CONFIG was refused."""

    ACCEPTED = 0
    RUNNING = 1
    ESTOP = 2
    AXES = 3
    THETA = 4
    RELEASE = 5  # a ramp of no ticks, or hold and ramp longer than MAX_RELEASE_NS
    CAP = 6
    SLEW = 7


class Reason(IntEnum):
    """Why the host stops. The device stops on any; ESTOP latches."""

    DONE = 0
    OPERATOR = 1
    FAULT = 2
    ESTOP = 3


class Hello(NamedTuple):
    """Host to device: who are you?"""

    version: int = PROTOCOL


class Info(NamedTuple):
    """Device to host: what it is. Tuples have one entry per axis."""

    version: int
    firmware: str  # at most 16 ASCII characters
    serial: int
    period_ns: int
    osp_damping: tuple[int, ...]  # guaranteed damping [uN s/m]
    encoder_step: tuple[int, ...]  # [pm per count]
    force_step: tuple[int, ...]  # [uN per step]
    hard_limit: tuple[int, ...]  # largest force [steps]
    range: tuple[int, ...]  # the workspace is +-range [counts]

    @property
    def axes(self) -> int:
        return len(self.encoder_step)


class Config(NamedTuple):
    """Host to device: how to run. Tuples have one entry per axis."""

    theta: int  # a force answers tick k and is latched at tick k + theta
    hold: int  # ticks that the last force is held for when frames are missing
    ramp: int  # ticks from there to zero
    ramp_in: int  # ticks over which the cap grows from zero after arming; 0: at once
    cap: tuple[int, ...]  # [steps]
    slew: tuple[int, ...]  # [steps per tick]

    @property
    def axes(self) -> int:
        return len(self.cap)


class Ack(NamedTuple):
    """Device to host: the CRC-32 of the CONFIG payload it answers, and why that was refused (0: accepted)."""

    crc: int
    refused: int


class State(NamedTuple):
    """Device to host, every tick."""

    status: int  # phase and cause
    tick: int
    echo: int  # the source of the last FORCE that came
    margin_us: int  # how long before its latch it came, negative: too late; NO_MARGIN: none came since the last STATE
    crc_errors: int  # frames that the device rejected, modulo 256
    misses: int  # ticks for which no FORCE was there in time, modulo 256
    t_us: int  # the device's clock at this tick, modulo 2^32
    counts: tuple[int, ...]  # encoders, sampled at this tick
    applied: tuple[int, ...]  # the force from this tick on [steps]

    @property
    def axes(self) -> int:
        return len(self.counts)

    @property
    def phase(self) -> Phase:
        return Phase(self.status & 15)

    @property
    def cause(self) -> Cause:
        return Cause(self.status >> 4)


class Force(NamedTuple):
    """Host to device, one for each STATE: the force for tick `apply_at` = source + theta."""

    command: int
    apply_at: int
    source: int
    force: tuple[int, ...]  # [steps]

    @property
    def axes(self) -> int:
        return len(self.force)


class Stop(NamedTuple):
    """Host to device: to zero force, now."""

    reason: int


Message = Hello | Info | Config | Ack | State | Force | Stop
