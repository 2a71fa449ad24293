"""Emulate a device: the scenario's plant under the firmware's own state machine, with faults on request.

A fault is written KIND[=VALUE][@START[+DURATION]]. The prefix `up:` (device to host) or `down:` selects one direction
of the line, and a prefix such as `axis2:` selects another axis than the first:

    drop=0.1          each frame is lost with probability 0.1
    up:flip=0.02@1+2  from 1 s after arming, for 2 s, a STATE has one wrong bit with probability 0.02
    stall=0.03@1      the device freezes for 30 ms, 1 s after arming
    unplug@1          the cable is pulled, 1 s after arming
    axis2:freeze@1    encoder 2 shows the same count from 1 s after arming on

Without @ a fault acts from the start. Only faults of the line take a DURATION. All random numbers are seeded.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Self

import numpy as np

from haptic_loop.controller.lti import Array
from haptic_loop.hw.device_state import RUNNING, Device
from haptic_loop.hw.limits import COARSEST, SafetyLimits
from haptic_loop.hw.protocol import PROTOCOL, Force, Info, Phase, distance
from haptic_loop.models.device import require
from haptic_loop.models.hold import hold
from haptic_loop.models.human import Human, Link
from haptic_loop.models.scene import build
from haptic_loop.sim.run import outside_forces
from haptic_loop.sim.scenario import InputError, Scenario

_FOREVER = 1e9  # [s]
_BLOCK = 1000  # ticks for which outside forces are computed at once
_FORCE_STEP = 400  # [uN]: 12 N are 30000 steps of an i16
_ENCODER_STEP = 1e-6  # [m] assumed if the scenario has ideal encoders
_REACH = 0.1  # [m] assumed half of the workspace
_SETTLED = 203  # ticks from the device's full cap to the start of the person's motion
_FARTHEST = 2**31 - 1  # [counts] largest count that STATE can carry


#: faults of the line: kind -> (meaning, minimum, maximum and default of VALUE)
_LINE = {
    "flip": ("probability per frame that one bit is wrong", 0.0, 1.0, 0.01),
    "drop": ("probability per frame that it is lost", 0.0, 1.0, 0.1),
    "truncate": ("probability per frame that its end is lost", 0.0, 1.0, 0.1),
    "garbage": ("mean number of random bytes before a frame", 0.0, 1000.0, 4.0),
    "duplicate": ("probability per frame that it comes twice", 0.0, 1.0, 0.1),
    "reorder": ("probability per frame that the next frame overtakes it", 0.0, 1.0, 0.1),
    "delay": ("seconds by which every frame is late", 0.0, 10.0, 1e-3),
    "jitter": ("mean of an exponential extra delay in seconds", 0.0, 10.0, 1e-4),
    "burst": ("seconds between two bursts; each burst delivers all waiting frames", 1e-6, 1.0, 1e-3),
}
#: faults of the device: kind -> (meaning, minimum, maximum and default of VALUE)
_DEVICE = {
    "stall": ("seconds for which the device freezes", 0.0, 10.0, 0.01),
    "unplug": ("no value: the cable is pulled", 0.0, 0.0, 0.0),
    "reset": ("no value: the device restarts", 0.0, 0.0, 0.0),
    "leap": ("ticks by which the device's tick number leaps", 1.0, 32000.0, 300.0),
    "stuck": ("no value: the device ignores its watchdog, its faults, IDLE and each STOP but ESTOP", 0.0, 0.0, 0.0),
    "period": ("length of a tick as a multiple of T", 0.5, 4.0, 2.0),
    "estop": ("no value: somebody presses the emergency stop at the device", 0.0, 0.0, 0.0),
    "trip": ("no value: the firmware finds a fault", 0.0, 0.0, 0.0),
    "swap": ("no value: the encoders of axes 1 and 2 are connected the wrong way round", 0.0, 0.0, 0.0),
    "exchange": ("no value: motors and encoders of axes 1 and 2 are connected the wrong way round", 0.0, 0.0, 0.0),
    "cross": ("share of motor 1's force that motor 2 adds to its own force", -1.0, 1.0, 1.0),
    "letgo": ("no value: nobody holds the deadman at the device any more", 0.0, 0.0, 0.0),
}
#: faults of one axis of the device: kind -> (meaning, minimum, maximum and default of VALUE, at the hand if rotary)
_AXIS = {
    "jump": ("millimetres by which its encoder jumps", -1000.0, 1000.0, 5.0),
    "freeze": ("no value: its encoder shows the same count for ever", 0.0, 0.0, 0.0),
    "toggle": ("no value: one channel of its encoder is dead, so that it toggles between two counts", 0.0, 0.0, 0.0),
    "saturate": ("millimetres at which its encoder saturates", -1000.0, 1000.0, 5.0),
    "shake": ("millimetres by which its encoder is wrong at every other tick", -1000.0, 1000.0, 2.0),
    "drift": ("metres per second by which its encoder drifts", -10.0, 10.0, 2.0),
    "late": ("ticks by which its encoder is read late", 1.0, 50.0, 2.0),
    "wrap": ("millimetres after which its encoder wraps", 0.001, 1000.0, 2.0),
    "bit": ("number of the bit of its count that is stuck at 0", 0.0, 30.0, 8.0),
    "reverse": ("no value: its encoder counts backwards", 0.0, 0.0, 0.0),
    "scale": ("counts that its encoder shows per true count", 0.01, 100.0, 3.0),
    "noise": ("counts of noise (root mean square) in its encoder", 0.0, 100.0, 0.5),
    "motor": ("share of a force that its motor makes: 0 if dead, -1 if reversed", -10.0, 10.0, 0.0),
    "limit": ("newtons at which its motor saturates", 0.0, 12.0, 0.6),
    "oneway": ("share of a negative force that its motor makes", -10.0, 10.0, 0.0),
    "zone": ("newtons below which its motor makes no force, and by which larger forces are smaller", 0.0, 12.0, 0.3),
    "lose": ("share of the counts in negative direction that its encoder shows", -10.0, 10.0, 0.5),
    "own": ("newtons that its motor makes while armed, whatever FORCE says", -12.0, 12.0, 2.0),
}
_MOTOR = ("motor", "oneway", "limit", "zone")  # the faults in _AXIS that change the force of a motor
KINDS = _LINE | _DEVICE | _AXIS
_FORM = re.compile(r"(?:(up|down|axis[1-8]):)?([a-z]+)(?:=([^@+]+))?(?:@([^+]+)(?:\+(.+))?)?")


@dataclass(frozen=True)
class FaultInjection:
    """One fault of the line or of a device."""

    kind: str
    value: float
    where: str = "both"  # up | down | both: direction of the line; axis1 ..: axis of the device
    start: float | None = None  # [s] after arming; None: always
    duration: float = _FOREVER  # [s]

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the fault that `text` describes. Raises InputError naming the part that is wrong."""
        match = _FORM.fullmatch(text)
        if not match or match[2] not in KINDS:
            names = ", ".join(KINDS)
            raise InputError(f"--fault is {text!r}, expected KIND[=VALUE][@START[+DURATION]], KIND one of {names}")
        where, kind, value, start, duration = match.groups()
        if where in ("up", "down") and kind not in _LINE:
            raise InputError(f"--fault {text}: {kind} happens to the device, not to one direction of the line")
        if where and where.startswith("axis") and kind not in _AXIS:
            raise InputError(f"--fault {text}: {kind} does not happen to one axis; {', '.join(_AXIS)} do")
        if duration and kind not in _LINE:
            raise InputError(f"--fault {text}: {kind} does not end, so it takes no DURATION; {', '.join(_LINE)} do")
        what, low, high, default = KINDS[kind]
        try:
            number = default if value is None else float(value)
            begins = None if start is None else float(start)
            lasts = _FOREVER if duration is None else float(duration)
            require(f"{kind} ({what})", number, low, high, "")
            require("START", begins or 0.0, 0.0, _FOREVER, "s")
            require("DURATION", lasts, 1e-6, _FOREVER, "s")
            if kind in ("leap", "late", "bit") and number != int(number):
                raise ValueError(f"VALUE is {number:g}, expected a whole number")
        except ValueError as error:
            raise InputError(f"--fault {text}: {str(error).strip()}") from None
        return cls(kind, number, where or ("axis1" if kind in _AXIS else "both"), begins, lasts)

    @property
    def axis(self) -> int:
        """The index of the axis concerned, from 0."""
        return int(self.where.removeprefix("axis")) - 1

    def active(self, since_armed: float | None) -> bool:
        """Return whether the fault is present, `since_armed` seconds after arming (None: not armed yet)."""
        if self.start is None:
            return True
        return since_armed is not None and self.start <= since_armed < self.start + self.duration


class Line:
    """One direction of the link. It delays frames and injects faults."""

    def __init__(self, direction: str, faults: tuple[FaultInjection, ...], seed: int, latency_us: float = 0.0) -> None:
        self._faults = [u for u in faults if u.kind in _LINE and u.where in (direction, "both")]
        self._rng = np.random.default_rng([seed, direction == "up"])
        self._latency = latency_us
        self._held: bytes | None = None  # a frame that the next frame overtakes

    def send(self, frame: bytes, now_us: float, since_armed: float | None) -> list[tuple[float, bytes]]:
        """Return (time of arrival [us], frame) of each frame that arrives in place of `frame`."""
        frames, due = [frame], now_us + self._latency
        for fault in self._faults:
            if fault.active(since_armed):
                if fault.kind == "delay":
                    due += 1e6 * fault.value
                elif fault.kind == "jitter":
                    due += 1e6 * float(self._rng.exponential(fault.value))
                elif fault.kind == "burst":
                    due = 1e6 * fault.value * math.ceil(due / (1e6 * fault.value))
                else:
                    frames = [out for one in frames for out in self._strike(fault, one)]
        return [(due, out) for out in frames]

    def _strike(self, fault: FaultInjection, frame: bytes) -> list[bytes]:
        rng = self._rng
        if fault.kind == "garbage":
            return [rng.bytes(int(rng.poisson(fault.value))) + frame]
        struck = rng.random() < fault.value
        if fault.kind == "reorder":
            held, self._held = self._held, None
            if held is None and struck:
                self._held = frame
                return []
            return [frame] if held is None else [frame, held]
        if not struck:
            return [frame]
        if fault.kind == "flip":
            i, bit = int(rng.integers(len(frame))), int(rng.integers(8))
            return [frame[:i] + bytes([frame[i] ^ (1 << bit)]) + frame[i + 1 :]]
        if fault.kind == "truncate":
            return [frame[: int(rng.integers(len(frame)))]]
        return [] if fault.kind == "drop" else [frame, frame]


class _EmulatedPlant:
    """Advance the devices and their passive humans between ticks by the matrix exponential.

    The person starts to move at the first tick after `begin`, and holds still while `still` is true: sessions are armed
    at rest.
    """

    def __init__(self, scenario: Scenario, encoder_step: Array) -> None:
        self.scenario, self.encoder_step = scenario, encoder_step
        self.scene = build(scenario.device, scenario.human, scenario.person)
        self._plant = self.scene.plant
        self._held = lru_cache(256)(self._hold)
        self.s = np.zeros(len(self._plant.A))
        self._w = np.zeros(self.scene.outside)
        limit = np.array([device.force_limit for device in scenario.axis_devices])
        self._limits = -limit, limit
        self.motors = slice(self.scene.model.nq, self.scene.model.nq + scenario.channels)  # speeds of motors in s
        self.still = False
        #: places in s of the speeds of motors and handles
        self._speeds = [self.scene.model.nq + i for i in {*range(scenario.channels), *self.scene.handles}]
        self.fastest = 0.0  # [m/s] highest speed of any motor or handle so far
        self._outside, self._first, self.tick = np.zeros((0, self.scene.outside)), 0, None

    def begin(self) -> None:
        """Let the scenario's outside forces (voluntary motion, tap) act from the next tick on."""
        self.tick = 0 if self.tick is None else self.tick

    def counts(self) -> tuple[int, ...]:
        """Return the counts of the encoders."""
        return tuple(map(int, (self.s[: self.scenario.channels] / self.encoder_step).round().tolist()))

    def advance(self, f: Array, share: float = 1.0, begins: bool = True) -> None:
        """Hold the forces f (m,) [N] for a share of a period; the device feels -f.

        If a tick `begins`, its outside forces are computed; otherwise the outside forces of the last call still act.
        """
        if begins and self.tick is not None:
            self._w = self._next_outside() * (not self.still)
        f = np.minimum(np.maximum(f, self._limits[0]), self._limits[1])
        self.s = self._held(share).dot(np.concatenate((self.s, self._w, f)))
        self.fastest = max(self.fastest, *map(abs, self.s[self._speeds].tolist()))

    def _hold(self, share: float) -> Array:
        held = hold(self._plant, share * self.scenario.T)
        return np.hstack([held.A, held.B])

    def _next_outside(self) -> Array:
        assert self.tick is not None
        row = self.tick - self._first
        if not row < len(self._outside):
            self._first, row = self.tick, 0
            self._outside = outside_forces(self.scenario, self.scene, self._first, _BLOCK)
        self.tick += 1
        return self._outside[row]


def nobody(scenario: Scenario, mass: float = 0.0) -> Scenario:
    """Return the scenario without hands, persons and tap. Each handle carries a `mass` [kg]; a large one clamps it."""
    return scenario.replace(human=(Human((Link(mass, 0.0, 0.0),)),) * len(scenario.device), person=(), tap=None)


def info_of(scenario: Scenario) -> Info:
    """Return the INFO of an emulated device: the scenario's damping, limits and steps, in the units of the wire."""
    r, limits = scenario.lever, [device.force_limit for device in scenario.axis_devices]
    coarsest, encoder = min(1e-12 * 0xFFFFFFFF, COARSEST * SafetyLimits.jump / r), []
    for i, device in enumerate(scenario.axis_devices, start=1):
        step = device.encoder_step or _ENCODER_STEP / r
        require(f"encoder_step of channel {i}", step, math.ceil(1e12 * _REACH / r / _FARTHEST) * 1e-12, coarsest, "m")
        encoder.append(round(1e12 * step))
    step = _FORCE_STEP if scenario.unit == "m" else max(1, math.ceil(1e6 * max(limits) / 30000))
    return Info(
        version=PROTOCOL,
        firmware="emulator",
        serial=1,
        period_ns=round(1e9 * scenario.T),
        osp_damping=tuple(round(1e6 * delta) for delta in scenario.delta),
        encoder_step=tuple(encoder),
        force_step=(step,) * scenario.channels,
        hard_limit=tuple(min(0x7FFF, round(1e6 * limit / step)) for limit in limits),
        range=tuple(round(1e12 * _REACH / r / each) for each in encoder),
    )


class Emulator:
    """An emulated device without a clock: its caller calls tick() and advance()."""

    def __init__(
        self,
        scenario: Scenario,
        faults: tuple[FaultInjection, ...] = (),
        info: Info | None = None,
    ) -> None:
        self.info = info or info_of(scenario)
        self.device = Device(self.info)
        self.device.deadman = True
        self.plant = _EmulatedPlant(scenario, 1e-12 * np.array(self.info.encoder_step, dtype=float))
        self.force_step = 1e-6 * np.array(self.info.force_step, dtype=float)
        self.armed_at: int | None = None  # [us] time of the first arming, from which faults are timed
        self.begun_at: int | None = None  # tick at which the person began to move
        self.unplugged = False
        self.stalled_until = 0  # [us]
        self.stretch = 1.0  # length of a tick as a multiple of T
        self.applied: Array = np.zeros(scenario.channels)  # [N] forces of the motors
        self._swapped, self._exchanged, self._crossed, self._lever = False, False, 0.0, scenario.lever
        # start of the tick [us], the remaining share of the tick, and whether the whole tick remains
        self._begun, self._rest, self._at_tick = 0, 0.0, False
        self._offset = [0] * scenario.channels  # [counts] by which each encoder has jumped
        #: by axis and kind of fault: from the commanded to the true force
        self._motors: dict[tuple[int, str], Callable[[float], float]] = {}
        self._encoders: dict[int, Callable[[int], int]] = {}  # by axis: from the true count to the count shown
        for fault in faults:
            if fault.kind in _AXIS and fault.axis >= scenario.channels:
                have = f"the scenario has {scenario.channels} channels"
                raise ValueError(f"--fault {fault.kind} is for {fault.where}, {have}")
            if fault.kind in ("swap", "exchange", "cross") and scenario.channels < 2:
                raise ValueError(f"--fault {fault.kind} is for two axes, the scenario has one channel")
        self._waiting = list(faults)
        self._ready = 0

    def since_armed(self, now: int) -> float | None:
        """Return the seconds since the first arming, or None before it."""
        return None if self.armed_at is None else 1e-6 * (now - self.armed_at)

    def receive(self, data: bytes, now: int) -> None:
        """Process bytes from the host. An unplugged or frozen device receives none."""
        if self.unplugged or now < self.stalled_until:
            return
        before = self.device.applied
        self.device.receive(data, now)
        if self._rest and self.device.applied != before:
            self._move(now)
            self.applied = self._motor_forces(self.device.applied)

    def _motor_forces(self, steps: tuple[int, ...]) -> Array:
        """Return the forces (m,) [N] that the motors make of latched forces, with the faults of the motors."""
        forces = np.array(steps) * self.force_step
        if self._exchanged:
            forces[:2] = forces[1::-1]
        for (axis, _), motor in self._motors.items():
            forces[axis] = motor(forces[axis])
        forces[1:2] += self._crossed * forces[0]
        return forces

    def _move(self, now: float) -> None:
        """Advance the plant to `now` [us] within the current tick."""
        period = 1e-3 * self.info.period_ns * self.stretch
        portion = min(1.0, (now - self._begun) / period)
        share = min(self._rest, max(0.0, portion - (1.0 - self._rest)))
        if share:
            self.plant.advance(-self.applied, share, self._at_tick)
            self._rest, self._at_tick = self._rest - share, False

    def tick(self, now: int) -> bytes:
        """Begin a period: sample, latch, answer. `now` is the device's clock [us]; advance() must follow every tick."""
        if self._rest:  # finish the last tick
            self.plant.advance(-self.applied, self._rest, self._at_tick)
            self._rest = 0.0
        self._misbehave(now)
        counts = tuple(
            max(-_FARTHEST, min(_FARTHEST, self._encoders.get(i, int)(n + o)))
            for i, (n, o) in enumerate(zip(self.plant.counts(), self._offset, strict=True))
        )
        if self._swapped:
            counts = (counts[1], counts[0], *counts[2:])
        self._begun = now
        steps, data = self.device.tick(now, counts)
        if self.device.phase in RUNNING and self.armed_at is None:
            self.armed_at = now
        self._wake_person()
        self.applied = self._motor_forces(steps)
        return b"" if self.unplugged else data

    def advance(self) -> None:
        """Advance the plant by a period; if forces act on arrival, leave this to receive() and tick()."""
        if self.device.config is not None and not self.device.config.theta:
            self._rest, self._at_tick = 1.0, True
        else:
            self.plant.advance(-self.applied)

    def _in_counts(self, fault: FaultInjection) -> int:
        return round(1e-3 * fault.value / self._lever / (1e-12 * self.info.encoder_step[fault.axis]))

    def _also(self, fault: FaultInjection, earlier: Callable[[int], int]) -> Callable[[int], int]:
        """Return how an encoder with `earlier` faults changes a count if it also breaks in the present tick."""
        broken = None

        def shown(n: int) -> int:
            nonlocal broken
            n = earlier(n)
            broken = broken or self._broken(fault, n)
            return broken(n)

        return shown

    def _broken(self, fault: FaultInjection, now: int) -> Callable[[Any], Any]:
        """Return how a motor or an encoder that breaks at the count `now` changes a force [N] or a count."""
        step, value, most = self.info.encoder_step[fault.axis], fault.value, self._in_counts(fault)
        newtons = self._lever * value
        match fault.kind:
            case "motor":
                return lambda force: value * force
            case "oneway":
                return lambda force: force if force > 0 else value * force
            case "limit":
                return lambda force: max(-newtons, min(newtons, force))
            case "zone":
                return lambda force: force - max(-newtons, min(newtons, force))
            case "freeze":
                return lambda n: now
            case "toggle":
                return lambda n: now + (n - now) % 2
            case "saturate":
                return lambda n: min(n, most) if most >= 0 else max(n, most)
            case "reverse":
                return lambda n: -n
            case "wrap":
                return lambda n: (n + most // 2) % most - most // 2
            case "bit":
                return lambda n: n & ~(1 << int(value))
            case "scale":
                return lambda n: round(value * n)
            case "lose":
                lost, before = 0.0, now

                def shown(n: int) -> int:
                    nonlocal lost, before
                    lost, before = lost + min(0, n - before) * (1 - value), n
                    return round(n - lost)

                return shown
            case "late":
                earlier = deque([now], maxlen=1 + int(value))
                return lambda n: (earlier.append(n), earlier[0])[1]
            case "noise":
                draw = np.random.default_rng(fault.axis)
                return lambda n: round(n + draw.normal(0.0, value))
            case "drift":
                each, begun = value / self._lever * 1e-9 * self.info.period_ns, self.device.k
                return lambda n: n + round(each / (1e-12 * step) * distance(self.device.k, begun))
        return lambda n: n + most * (self.device.k % 2)

    def _wake_person(self) -> None:
        config = self.device.config
        full = config is not None and self.device.run >= config.ramp_in
        self.plant.still = not full
        self._ready += full and self.armed_at is not None
        if self._ready >= _SETTLED and self.begun_at is None:
            self.begun_at = self.device.k
            self.plant.begin()

    def _misbehave(self, now: int) -> None:
        for fault in [u for u in self._waiting if u.active(self.since_armed(now))]:
            self._waiting.remove(fault)
            match fault.kind:
                case "stall":
                    self.stalled_until = now + round(1e6 * fault.value)
                case "unplug":
                    self.unplugged = True
                case "reset":
                    held, self.device = self.device.deadman, Device(self.info)
                    self.device.deadman = held
                case "jump":
                    self._offset[fault.axis] += self._in_counts(fault)
                case "swap" | "exchange":
                    self._swapped, self._exchanged = True, fault.kind == "exchange"
                case "cross":
                    self._crossed = fault.value
                case "leap":
                    self.device.k = (self.device.k + round(fault.value)) & 0xFFFF
                case "own":
                    steps = round(self._lever * fault.value / self.force_step[fault.axis])
                    self.device = _wilful(self.device, fault.axis, steps)
                case "stuck":
                    self.device.halt = lambda cause: None
                case "period":
                    self.stretch = fault.value
                case "estop":
                    self.device.estop()
                case "trip":
                    self.device.fault()
                case "letgo":
                    self.device.deadman = False
                case kind if kind in _MOTOR:  # A later fault of the same kind replaces the earlier one.
                    self._motors[fault.axis, kind] = self._broken(fault, 0)
                case kind if kind in _AXIS:  # all other faults of one axis break its encoder, one after the other
                    self._encoders[fault.axis] = self._also(fault, self._encoders.get(fault.axis, int))


def _wilful(device: Device, axis: int, force: int) -> Device:
    """Make one motor of `device` apply `force` [steps] while armed, whatever FORCE says, and return the device."""
    obeys = device.latch

    def latch(frame: Force | None) -> None:
        obeys(frame)
        if device.phase in (Phase.ARMED, Phase.HOLDING):
            device.applied = (*device.applied[:axis], force, *device.applied[axis + 1 :])

    device.latch = latch
    return device
