"""The device's side of the link: safety states, and forces latched at tick k + theta; no clock and no port of its own.

With theta = 0 a force is latched as soon as it comes, within the tick that it answers: the motors then carry `applied`.

The same machine as hw/firmware/haptic_link.h, integer for integer and byte for byte (tests/hw/test_firmware.py). Its
rules are in docs/protocol.md. Forces are in steps, per axis, as tuples.
"""

from hw.protocol import (
    DEADMAN,
    MAX_RELEASE_NS,
    MAX_THETA,
    NO_MARGIN,
    Ack,
    Cause,
    Command,
    Config,
    Decoder,
    Force,
    Hello,
    Info,
    Message,
    Phase,
    Reason,
    Refused,
    State,
    Stop,
    config_crc,
    distance,
    encode,
)

_SLOTS = 16  # forces that wait for their tick: a power of two above MAX_THETA
RUNNING = (Phase.ARMED, Phase.HOLDING, Phase.RAMP)  # the motors may carry a force


class Device:
    """One microcontroller. Call tick() once per period, receive() when bytes come, estop() and fault() at any time."""

    def __init__(self, info: Info) -> None:
        """Raises ValueError where `info` cannot travel."""
        self.info = info
        self.info_frame = encode(info)
        self.decoder = Decoder()
        self.unexpected = 0  # well-formed frames that this device has no use for
        self.deadman = False  # whether somebody holds it: yours to set, where the device has one
        self.phase, self.cause = Phase.SILENT, Cause.NONE
        self.config: Config | None = None
        self.k, self.now = 0, 0  # this tick, and the clock at it [us]
        self.zero = (0,) * info.axes
        self.asked, self.ack = False, b""  # what to say at the next tick
        self.clear()
        self.misses = 0

    def clear(self) -> None:
        """Forget every force."""
        self.slots: list[Force | None] = [None] * _SLOTS
        self.applied = self.ramp_from = self.zero
        self.held = self.ramp_left = self.run = 0
        self.echo, self.margin = 0, NO_MARGIN

    @property
    def _status(self) -> int:
        return self.phase | self.cause << 4 | DEADMAN * self.deadman

    def tick(self, now_us: int, counts: tuple[int, ...]) -> tuple[tuple[int, ...], bytes]:
        """A period begins: the forces that act from now on, and the bytes to send. `counts` was sampled just before."""
        self.k, self.now = (self.k + 1) & 0xFFFF, now_us & 0xFFFFFFFF
        at_once = self.config is not None and not self.config.theta
        slot = (self.k - at_once) % _SLOTS  # what came during the tick before has been latched, if anything came
        frame, self.slots[slot] = self.slots[slot], None
        if self.phase in (Phase.DISARMED, Phase.ARMED, Phase.HOLDING):
            self.misses += frame is None
            if not at_once or (frame is None and self.phase != Phase.DISARMED):
                self.take(frame)
        if self.phase == Phase.RAMP:
            self._ramp_down()
        return self.applied, self._speak(counts)

    def take(self, frame: Force | None) -> None:
        """The force for this tick, if there is one, may act from now on."""
        if self.phase in (Phase.ARMED, Phase.HOLDING):
            self.latch(frame)
        elif self.phase == Phase.DISARMED and frame is not None and frame.command == Command.ARM:
            self.phase = Phase.ARMED

    def latch(self, frame: Force | None) -> None:
        """The force for this tick, or without one the last one held, for `hold` ticks."""
        assert self.config is not None
        if frame is None:
            self.phase = Phase.HOLDING
            if self.held >= self.config.hold:
                self.halt(Cause.WATCHDOG)
            self.held += 1
        elif frame.command == Command.IDLE:
            self.halt(Cause.COMMAND)
        else:
            self.phase, self.held = Phase.ARMED, 0
            self.run = min(self.run + 1, self.config.ramp_in)
            caps = [cap_after(self.config, cap, self.run) for cap in self.config.cap]
            self.applied = tuple(map(limited, frame.force, self.applied, caps, self.config.slew))

    def _ramp_down(self) -> None:
        assert self.config is not None
        self.ramp_left -= 1
        self.applied = tuple(_scaled(f, self.ramp_left, self.config.ramp) for f in self.ramp_from)
        if self.ramp_left == 0:
            self.phase = Phase.STOPPED

    def halt(self, cause: Cause) -> None:
        """To zero force, for a named cause: by a ramp while armed, at once before. The first cause stays."""
        if self.phase in (Phase.ARMED, Phase.HOLDING):
            assert self.config is not None
            self.phase, self.cause = Phase.RAMP, cause
            self.ramp_from, self.ramp_left = self.applied, self.config.ramp
        elif self.phase == Phase.DISARMED:
            self.phase, self.cause = Phase.STOPPED, cause

    def fault(self) -> None:
        """The firmware found a fault of its own (an encoder, a driver)."""
        self.halt(Cause.DEVICE)

    def estop(self, cause: Cause = Cause.ESTOP_DEVICE) -> None:
        """Zero force at once, until the device is reset."""
        if self.phase != Phase.ESTOP:
            self.clear()
            self.phase, self.cause = Phase.ESTOP, cause

    def _speak(self, counts: tuple[int, ...]) -> bytes:
        """INFO where asked for and the motors rest, then ACK, then STATE once configured."""
        out, self.ack = self.ack, b""
        if self.asked and self.phase not in RUNNING:
            out, self.asked = self.info_frame + out, False
        if self.config is None:
            return out
        errors, misses = (self.decoder.rejected + self.unexpected) & 0xFF, self.misses & 0xFF
        state = State(self._status, self.k, self.echo, self.margin, errors, misses, self.now, counts, self.applied)
        self.margin = NO_MARGIN
        return out + encode(state)

    def receive(self, data: bytes, now_us: int) -> None:
        """Bytes that came at `now_us`, in any pieces."""
        for message in self.decoder.feed(data):
            self._understand(message, now_us)

    def _understand(self, message: Message, now_us: int) -> None:
        if isinstance(message, Force):
            self.accept(message, now_us)
        elif isinstance(message, Config):
            self.configure(message)
        elif isinstance(message, Hello):
            self.asked = True
        elif isinstance(message, Stop) and message.reason == Reason.ESTOP:
            self.estop(Cause.ESTOP_HOST)
        elif isinstance(message, Stop):
            self.halt(Cause.HOST)
        else:
            self.unexpected += 1

    def accept(self, frame: Force, now_us: int) -> None:
        """A force waits for its tick where that is ahead, answers the right tick, and is the first for it."""
        known = frame.command == Command.RUN or (frame.command in (Command.IDLE, Command.ARM) and not any(frame.force))
        if frame.axes != self.info.axes or not known:
            self.unexpected += 1
            return
        if self.config is None or distance(frame.apply_at, frame.source) != self.config.theta:
            return
        at_once = not self.config.theta
        ahead, slot = distance(frame.apply_at, self.k) + at_once, frame.apply_at % _SLOTS  # ticks until it is late
        if ahead > self.config.due or (ahead > 0 and self.slots[slot] is not None):
            return
        since = (now_us - self.now) & 0xFFFFFFFF
        margin = _scaled(ahead, self.info.period_ns, 1000) - since
        self.echo, self.margin = frame.source, max(-0x7FFF, min(0x7FFF, margin))
        if ahead > 0:
            self.slots[slot] = frame
            if at_once:
                self.take(frame)

    def configure(self, config: Config) -> None:
        refused = self._refuse(config)
        self.ack = encode(Ack(config_crc(config), refused))
        if not refused:
            self.clear()
            self.config, self.phase, self.cause = config, Phase.DISARMED, Cause.NONE

    def _refuse(self, config: Config) -> Refused:
        """Why this CONFIG cannot be taken, ACCEPTED where it can."""
        release = (config.hold + config.ramp) * self.info.period_ns
        reasons = (
            (self.phase == Phase.ESTOP, Refused.ESTOP),
            (self.phase in RUNNING, Refused.RUNNING),
            (config.axes != self.info.axes, Refused.AXES),
            (not 0 <= config.theta <= MAX_THETA, Refused.THETA),
            (config.ramp == 0 or release > MAX_RELEASE_NS, Refused.RELEASE),
            (any(not 1 <= c <= most for c, most in zip(config.cap, self.info.hard_limit, strict=False)), Refused.CAP),
            (0 in config.slew, Refused.SLEW),
        )
        return next((reason for wrong, reason in reasons if wrong), Refused.ACCEPTED)


def cap_after(config: Config, cap: int, run: int) -> int:
    """The cap after `run` forces since arming: it grows from zero."""
    return cap * min(run, config.ramp_in) // config.ramp_in if config.ramp_in else cap


def limited(force: int, last: int, cap: int, slew: int) -> int:
    """A force within the cap and within the slew rate of the last one."""
    force = max(-cap, min(cap, force))
    return last + max(-slew, min(slew, force - last))


def _scaled(value: int, by: int, over: int) -> int:
    """value * by / over, rounded towards zero as C does."""
    size = abs(value) * by // over
    return size if value >= 0 else -size
