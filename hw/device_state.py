"""The device's side of the link, without clock or port: its safety states, and the latch of its forces.

A force that answers the sample of tick k is latched at tick k + theta. With theta = 0 it is latched as soon as it
comes, within tick k, and the caller must then set the motors to `applied` at once.

This state machine equals hw/firmware/haptic_link.h, integer for integer and byte for byte (tests/hw/test_firmware.py).
There are two implementations because each tests the other, and because rehearsals and Force Dimension devices run this
file without a compiler. docs/protocol.md states the rules. Forces are tuples of steps, one entry per axis.
"""

import operator

from haptic_loop.hw import protocol as wire

_SLOTS = 16  # places for forces that wait for their tick: a power of two above MAX_THETA
RUNNING = (wire.Phase.ARMED, wire.Phase.HOLDING, wire.Phase.RAMP)  # phases in which motors may carry a force


class Device:
    """The state machine of one device.

    Call tick() once per period, receive() when bytes come, estop() and fault() at any time.
    """

    def __init__(self, info: wire.Info) -> None:
        """Begin in the state SILENT. Raises ValueError if a field of `info` does not fit into its frame."""
        self.info = info
        self.info_frame = wire.encode(info)
        self.decoder = wire.Decoder()
        self.unexpected = 0  # well-formed frames of a wrong type, number of axes or command; they count as errors
        self.deadman = False  # whether a hand holds the deadman; set by the caller if the device has one
        self.phase, self.cause = wire.Phase.SILENT, wire.Cause.NONE
        self.config: wire.Config | None = None
        self.k, self.now = 0, 0  # number of the current tick, and the clock [us] at its start
        self.zero = (0,) * info.axes
        self.asked, self.ack = False, b""  # for the next tick: whether to send INFO, and the ACK to send
        self.clear()
        self.misses = 0

    def clear(self) -> None:
        """Apply zero force, and forget all forces that wait."""
        self.slots: list[wire.Force | None] = [None] * _SLOTS
        self.applied = self.ramp_from = self.zero
        self.held = self.ramp_left = self.run = 0
        # source tick of the last FORCE that was used or too late, and how long [us] before its latch (theta = 0: before
        # the end of its tick) it came
        self.echo, self.margin = 0, wire.NO_MARGIN

    def tick(self, now_us: int, counts: tuple[int, ...]) -> tuple[tuple[int, ...], bytes]:
        """Begin a period: return the forces that act from now on, and the bytes to send. `counts` was just sampled."""
        self.k, self.now = (self.k + 1) & 0xFFFF, now_us & 0xFFFFFFFF
        at_once = self.config is not None and not self.config.theta
        # With theta = 0, an empty slot of the last tick means that its force did not come.
        slot = (self.k - at_once) % _SLOTS
        frame, self.slots[slot] = self.slots[slot], None
        if self.phase in (wire.Phase.DISARMED, wire.Phase.ARMED, wire.Phase.HOLDING):
            self.misses += frame is None
            if not at_once or (frame is None and self.phase != wire.Phase.DISARMED):
                self.take(frame)
        if self.phase == wire.Phase.RAMP:
            assert self.config is not None
            self.ramp_left -= 1
            self.applied = tuple(_scaled(f, self.ramp_left, self.config.ramp) for f in self.ramp_from)
            if self.ramp_left == 0:
                self.phase = wire.Phase.STOPPED
        return self.applied, self._speak(counts)

    def take(self, frame: wire.Force | None) -> None:
        """Apply the force for this tick while armed, or arm if the command is ARM."""
        if self.phase in (wire.Phase.ARMED, wire.Phase.HOLDING):
            self.latch(frame)
        elif self.phase == wire.Phase.DISARMED and frame is not None and frame.command == wire.Command.ARM:
            self.phase = wire.Phase.ARMED

    def latch(self, frame: wire.Force | None) -> None:
        """Apply this tick's force; halt on IDLE. Without a FORCE, hold the last force for `hold` ticks, then halt."""
        assert self.config is not None
        if frame is None:
            self.phase = wire.Phase.HOLDING
            if self.held >= self.config.hold:
                self.halt(wire.Cause.WATCHDOG)
            self.held += 1
        elif frame.command == wire.Command.IDLE:
            self.halt(wire.Cause.COMMAND)
        else:
            self.phase, self.held = wire.Phase.ARMED, 0
            self.run = min(self.run + 1, self.config.ramp_in)
            self.applied = self.config.limited(self.run, self.applied, frame.force)

    def halt(self, cause: wire.Cause) -> None:
        """If the device is armed or holding, begin the ramp to zero force. If it is disarmed, go to STOPPED.

        In any other phase change nothing, so that the first cause stays.
        """
        if self.phase in (wire.Phase.ARMED, wire.Phase.HOLDING):
            assert self.config is not None
            self.phase, self.cause = wire.Phase.RAMP, cause
            self.ramp_from, self.ramp_left = self.applied, self.config.ramp
        elif self.phase == wire.Phase.DISARMED:
            self.phase, self.cause = wire.Phase.STOPPED, cause

    def fault(self) -> None:
        """Stop because the firmware itself found a fault (an encoder, a driver)."""
        self.halt(wire.Cause.DEVICE)

    def estop(self, cause: wire.Cause = wire.Cause.ESTOP_DEVICE) -> None:
        """Go to zero force at once, until the device is reset."""
        if self.phase != wire.Phase.ESTOP:
            self.clear()
            self.phase, self.cause = wire.Phase.ESTOP, cause

    def _speak(self, counts: tuple[int, ...]) -> bytes:
        """Return INFO if requested and the motors rest, then ACK, then STATE once configured."""
        out, self.ack = self.ack, b""
        if self.asked and self.phase not in RUNNING:
            out, self.asked = self.info_frame + out, False
        if self.config is None:
            return out
        errors, misses = (self.decoder.rejected + self.unexpected) & 0xFF, self.misses & 0xFF
        status = self.phase | self.cause << 4 | wire.DEADMAN * self.deadman
        state = wire.State(status, self.k, self.echo, self.margin, errors, misses, self.now, counts, self.applied)
        self.margin = wire.NO_MARGIN
        return out + wire.encode(state)

    def receive(self, data: bytes, now_us: int) -> None:
        """Process bytes that came at `now_us`, in pieces of any length."""
        for message in self.decoder.feed(data):
            if isinstance(message, wire.Force):
                self.accept(message, now_us)
            elif isinstance(message, wire.Config):
                self.configure(message)
            elif isinstance(message, wire.Hello):
                self.asked = True
            elif isinstance(message, wire.Stop) and message.reason == wire.Reason.ESTOP:
                self.estop(wire.Cause.ESTOP_HOST)
            elif isinstance(message, wire.Stop):
                self.halt(wire.Cause.HOST)
            else:
                self.unexpected += 1

    def accept(self, frame: wire.Force, now_us: int) -> None:
        """Store the first force for tick source + theta if it is in time; apply it at once if theta = 0.

        A force that is too late still sets `echo` and `margin`.
        """
        known = frame.command == wire.Command.RUN or (
            frame.command in (wire.Command.IDLE, wire.Command.ARM) and not any(frame.force)
        )
        if frame.axes != self.info.axes or not known:
            self.unexpected += 1
            return
        if self.config is None or wire.distance(frame.apply_at, frame.source) != self.config.theta:
            return
        at_once = not self.config.theta
        # `ahead`: ticks until the force is late
        ahead, slot = wire.distance(frame.apply_at, self.k) + at_once, frame.apply_at % _SLOTS
        if ahead > self.config.due or (ahead > 0 and self.slots[slot] is not None):
            return
        since = (now_us - self.now) & 0xFFFFFFFF
        margin = _scaled(ahead, self.info.period_ns, 1000) - since
        self.echo, self.margin = frame.source, max(-0x7FFF, min(0x7FFF, margin))
        if ahead > 0:
            self.slots[slot] = frame
            if at_once:
                self.take(frame)

    def configure(self, config: wire.Config) -> None:
        """Accept or refuse a CONFIG, and store its ACK for the next tick."""
        refused = self._refuse(config)
        self.ack = wire.encode(wire.Ack(wire.config_crc(config), refused))
        if not refused:
            self.clear()
            self.config, self.phase, self.cause = config, wire.Phase.DISARMED, wire.Cause.NONE

    def _refuse(self, config: wire.Config) -> wire.Refused:
        """Return the reason for refusing this CONFIG, or ACCEPTED."""
        release = (config.hold + config.ramp) * self.info.period_ns
        reasons = (
            (self.phase == wire.Phase.ESTOP, wire.Refused.ESTOP),
            (self.phase in RUNNING, wire.Refused.RUNNING),
            (config.axes != self.info.axes, wire.Refused.AXES),
            (not 0 <= config.theta <= wire.MAX_THETA, wire.Refused.THETA),
            (config.ramp == 0 or release > wire.MAX_RELEASE_NS, wire.Refused.RELEASE),
            (min(config.cap) < 1 or any(map(operator.gt, config.cap, self.info.hard_limit)), wire.Refused.CAP),
            (0 in config.slew, wire.Refused.SLEW),
        )
        return next((reason for wrong, reason in reasons if wrong), wire.Refused.ACCEPTED)


def _scaled(value: int, by: int, over: int) -> int:
    """Return value * by / over, rounded towards zero as in C."""
    size = abs(value) * by // over
    return size if value >= 0 else -size
