"""The messages between host and device, as named tuples, and the frames that carry them.

A frame on the wire is payload + CRC-32, COBS-stuffed, ended by 0x00; docs/protocol.md lists every byte. A payload is a
type byte, fixed fields, then one group of fields per axis: the number of axes follows from the length. All integers are
little-endian; there is no float, so no NaN can travel. The longest frame has fewer than 254 bytes before stuffing, so
COBS costs exactly one byte and the size of a frame does not depend on its content.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from enum import IntEnum
from itertools import chain
from struct import Struct, error
from typing import Any, NamedTuple
from zlib import crc32

PROTOCOL = 2
_MAX_AXES = 8
MAX_THETA = 15
MAX_RELEASE_NS = 20_000_000  # longest sum of hold and ramp: in 20 ms, 12 N bring a free mass of 0.25 kg to 1 m/s
NO_MARGIN = -32768  # in State.margin_us: no usable FORCE came since the last STATE
DEADMAN = 0x80  # in State.status: the deadman at the device is held


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
    """Why the device is in its state, bits 4 to 6 of a status."""

    NONE = 0
    HOST = 1  # a STOP from the host
    WATCHDOG = 2  # more than `hold` ticks in a row without a FORCE
    COMMAND = 3  # a FORCE with IDLE while armed
    DEVICE = 4  # the firmware called hl_fault
    ESTOP_DEVICE = 5  # the emergency stop at the device
    ESTOP_HOST = 6  # a STOP with reason ESTOP


#: members by value; a look-up in the enumeration takes ten times as long as in a dict, and a tick needs ten look-ups
_PHASES, _CAUSES = {int(phase): phase for phase in Phase}, {int(cause): cause for cause in Cause}


class Command(IntEnum):
    """Command in a FORCE; only RUN may carry a force other than zero."""

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
    RELEASE = 5  # a ramp of zero ticks, or hold + ramp longer than MAX_RELEASE_NS
    CAP = 6
    SLEW = 7


class Reason(IntEnum):
    """Why the host sends STOP. Every reason stops the device; after ESTOP it stays stopped until its reset."""

    DONE = 0
    FAULT = 2
    ESTOP = 3


class SafetyStop(Exception):
    """Raised to stop a session. The message is the cause that the log shows."""


class Hello(NamedTuple):
    """Host to device: request INFO."""

    version: int = PROTOCOL


class Info(NamedTuple):
    """Device to host: the properties of the device. Tuples have one entry per axis."""

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
    """Host to device: the parameters of a run. Tuples have one entry per axis."""

    theta: int  # a force answers tick k and is latched at tick k + theta; 0: as soon as it comes, within tick k
    hold: int  # ticks for which the last force is held when frames are missing
    ramp: int  # ticks of the ramp from the held force to zero
    ramp_in: int  # FORCEs over which the cap grows from zero after arming; 0: at once
    cap: tuple[int, ...]  # [steps]
    slew: tuple[int, ...]  # [steps per tick]

    @property
    def axes(self) -> int:
        return len(self.cap)

    @property
    def due(self) -> int:
        """Ticks from a sample to the STATE that shows its force. The force must come before that STATE."""
        return max(1, self.theta)

    def limited(self, run: int, last: Sequence[int], asked: Sequence[int]) -> tuple[int, ...]:
        """Return the forces [steps] that the device applies for the `run`-th FORCE since arming.

        The forces `asked` are clipped to the cap, which grows from zero after arming. Then each change from the `last`
        applied force is clipped to the slew rate.
        """
        caps: Sequence[int] = self.cap
        if run < self.ramp_in:
            caps = [cap * run // self.ramp_in for cap in caps]
        forces = []
        for force, before, cap, slew in zip(asked, last, caps, self.slew, strict=True):
            capped = max(-cap, min(cap, force))
            forces.append(before + max(-slew, min(slew, capped - before)))
        return tuple(forces)


class Ack(NamedTuple):
    """Device to host: the CRC-32 of a CONFIG payload, and why that CONFIG was refused (0: accepted)."""

    crc: int
    refused: int


class State(NamedTuple):
    """Device to host, every tick after an accepted CONFIG: state, encoder counts and applied forces."""

    status: int  # phase, cause and deadman
    tick: int
    echo: int  # the source of the last usable FORCE
    margin_us: int  # from the last usable FORCE to its latch (theta = 0: end of its tick); negative: late; or NO_MARGIN
    crc_errors: int  # frames that the device rejected, modulo 256
    misses: int  # ticks without a FORCE in time, modulo 256
    t_us: int  # the device's clock at this tick, modulo 2^32
    counts: tuple[int, ...]  # encoders, sampled at this tick
    applied: tuple[int, ...]  # forces that act from this tick to the next latch [steps]

    @property
    def axes(self) -> int:
        return len(self.counts)

    @property
    def phase(self) -> Phase:
        return _PHASES[self.status & 15]

    @property
    def cause(self) -> Cause:
        return _CAUSES[self.status >> 4 & 7]

    @property
    def drives(self) -> bool:
        """True if the device is armed, or applies a force other than that of a ramp to zero."""
        return self.phase in (Phase.ARMED, Phase.HOLDING) or (self.phase != Phase.RAMP and any(self.applied))

    @property
    def deadman(self) -> bool:
        """Whether the deadman at the device is held."""
        return self.status >= DEADMAN


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
    """Host to device: ramp forces to zero, or drop them at once if the reason is ESTOP."""

    reason: int


Message = Hello | Info | Config | Ack | State | Force | Stop


_U8, _U16, _U32 = (0, 0xFF), (0, 0xFFFF), (0, 0xFFFFFFFF)
_I16, _I32 = (-0x8000, 0x7FFF), (-0x80000000, 0x7FFFFFFF)
_TEXT = 16  # bytes of Info.firmware, which is ASCII, padded with zeros


class _Layout(NamedTuple):
    """One kind of payload: type byte, struct codes of its fixed fields and of one axis, limits of each field."""

    code: int
    fixed: str
    axis: str
    limits: tuple[tuple[int, int], ...]


_LAYOUTS: dict[type, _Layout] = {
    Hello: _Layout(1, "B", "", (_U8,)),
    Info: _Layout(
        2,
        f"B{_TEXT}sII",
        "IIIHi",
        (_U8, (0, _TEXT), _U32, (100_000, 100_000_000), _U32, (1, _U32[1]), (1, _U32[1]), (1, _I16[1]), (1, _I32[1])),
    ),
    Config: _Layout(3, "BBBH", "HH", ((0, MAX_THETA), _U8, (1, 0xFF), _U16, (1, _I16[1]), (1, _U16[1]))),
    Ack: _Layout(4, "IB", "", (_U32, _U8)),
    State: _Layout(5, "BHHhBBI", "ih", (_U8, _U16, _U16, _I16, _U8, _U8, _U32, _I32, _I16)),
    Force: _Layout(6, "BHH", "h", (_U8, _U16, _U16, _I16)),
    Stop: _Layout(7, "B", "", (_U8,)),
}


class _Form(NamedTuple):
    """A layout for a given number of axes; `fixed` counts the values before the first axis, type byte included."""

    kind: type
    struct: Struct
    fixed: int
    columns: int


def _form(kind: type, axes: int) -> _Form:
    layout = _LAYOUTS[kind]
    columns = len(layout.axis)
    return _Form(kind, Struct("<B" + layout.fixed + layout.axis * axes), 1 + len(layout.limits) - columns, columns)


#: forms for writing, by kind and number of axes (0 where a message has none); for reading, by type byte and length
_FORMS = {
    (kind, n): _form(kind, n) for kind in _LAYOUTS for n in (range(1, _MAX_AXES + 1) if _LAYOUTS[kind].axis else (0,))
}
_READ = {(_LAYOUTS[kind].code, f.struct.size): f for (kind, _), f in _FORMS.items()}

_OVERHEAD = 6  # CRC-32, the COBS byte, the delimiter
_MAX_WIRE = max(f.struct.size for f in _FORMS.values()) + _OVERHEAD
_RESIDUE = crc32(bytes(4) + crc32(bytes(4)).to_bytes(4, "little"))  # CRC-32 of any bytes followed by their CRC-32
_STATUSES = frozenset(phase | cause << 4 | held for phase in Phase for cause in Cause for held in (0, DEADMAN))
_CHECKED = (Hello, Info, Config, Ack, Stop)  # seldom sent, so every field is checked; struct checks State and Force


def wire_bytes(kind: type, axes: int) -> int:
    """Return the length of a frame with its delimiter; for N axes, STATE has 20 + 6N bytes and FORCE 12 + 2N."""
    f = _FORMS.get((kind, axes if _LAYOUTS[kind].axis else 0))
    if f is None:
        raise ValueError(f"axes: {axes}; the protocol carries 1 to {_MAX_AXES}")
    return f.struct.size + _OVERHEAD


def encode(message: Message) -> bytes:
    """Return the frame of a message. Raises ValueError naming field, value and allowed values."""
    if type(message) in _CHECKED:
        _check(message)
    payload = pack(message)
    raw = payload + crc32(payload).to_bytes(4, "little")
    return b"".join([_CODES[len(block)] + block for block in raw.split(b"\0")]) + b"\0"


#: first byte of a COBS block of each length: the length plus one; the zero after the block is not sent
_CODES = [bytes((n + 1,)) for n in range(254)]


def pack(message: Message) -> bytes:
    """Return the payload of a message."""
    kind = type(message)
    layout = _LAYOUTS[kind]
    values: Any = message
    if isinstance(message, Info):
        values = (message.version, message.firmware.encode("ascii"), *message[2:])
    try:
        if not layout.axis:
            return _FORMS[kind, 0].struct.pack(layout.code, *values)
        columns: Any = message[-len(layout.axis) :]
        by_axis = columns[0] if len(columns) == 1 else chain.from_iterable(zip(*columns, strict=True))
        f = _FORMS[kind, len(columns[0])]
        return f.struct.pack(layout.code, *values[: f.fixed - 1], *by_axis)
    except (error, KeyError, TypeError, ValueError):
        _check(message)
        raise


def _check(message: Message) -> None:
    """Raise ValueError for the first field that does not fit into its frame."""
    layout, name = _LAYOUTS[type(message)], type(message).__name__
    fixed = len(layout.limits) - len(layout.axis)
    axes, values = None, tuple[Any, ...](message)
    for index, (field, value, limits) in enumerate(zip(message._fields, values, layout.limits, strict=True)):
        if limits == (0, _TEXT):
            if not (isinstance(value, str) and value.isascii() and value.isprintable() and len(value) <= _TEXT):
                raise ValueError(f"{name}.{field}: {value!r}; at most {_TEXT} printable ASCII characters")
        elif index < fixed:
            _check_integer(f"{name}.{field}", value, limits)
        elif not isinstance(value, tuple):
            raise ValueError(f"{name}.{field}: {value!r}; a tuple with one integer per axis")
        else:
            axes = len(value) if axes is None else axes
            if len(value) != axes or not 1 <= axes <= _MAX_AXES:
                raise ValueError(f"{name}.{field}: {len(value)} entries; 1 to {_MAX_AXES}, as many in every axis field")
            for axis, entry in enumerate(value, start=1):
                _check_integer(f"{name}.{field} #{axis}", entry, limits)


def _check_integer(name: str, value: Any, limits: tuple[int, int]) -> None:
    """Raise ValueError naming the field unless the value is an integer from limits[0] to limits[1]."""
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name}: {value!r}; integers only") from None
    if not limits[0] <= number <= limits[1]:
        raise ValueError(f"{name}: {value}; {limits[0]} to {limits[1]}")


def _unpack(payload: bytes) -> Message | None:
    """Return the message of a payload, or None for an unknown type, length or status, or a text that is not ASCII."""
    f = _READ.get((payload[0], len(payload)))
    if f is None or (f.kind is State and payload[1] not in _STATUSES):
        return None
    values = f.struct.unpack(payload)
    if f.columns:
        message = f.kind(*values[1 : f.fixed], *[values[i :: f.columns] for i in range(f.fixed, f.fixed + f.columns)])
        if f.kind is Info:
            text = values[2].rstrip(b"\0")
            return message._replace(firmware=text.decode("ascii")) if text.isascii() else None
        return message
    return f.kind(*values[1:])


def config_crc(config: Config) -> int:
    """Return the CRC-32 of a CONFIG's payload, which its ACK carries."""
    return crc32(pack(config))


class Decoder:
    """Decode messages from bytes, in pieces of any length. Unreadable frames are counted and dropped."""

    def __init__(self) -> None:
        self.crc_errors = 0
        self.malformed = 0  # frames with inconsistent COBS codes, or a type, length, status or text of no message
        self.oversize = 0  # frames that are longer than any message's
        self.tail = b""  # bytes of the frame whose end has not come yet, at most _MAX_WIRE
        self.skipping = False  # inside an oversize frame that is already counted

    @property
    def rejected(self) -> int:
        return self.crc_errors + self.malformed + self.oversize

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages completed by these bytes, oldest first."""
        *frames, tail = (self.tail + data).split(b"\0")
        messages = []
        for frame in frames:
            if frame and (message := self.read(frame)) is not None:
                messages.append(message)
            self.skipping = False
        if len(tail) >= _MAX_WIRE:
            self.oversize += not self.skipping
            self.skipping, tail = True, tail[:_MAX_WIRE]
        self.tail = tail
        return messages

    def read(self, frame: bytes) -> Message | None:
        """Return the message of one frame without its delimiter, or None for an unreadable frame, which is counted."""
        if len(frame) >= _MAX_WIRE:
            self.oversize += not self.skipping
            return None
        raw, i, end = bytearray(frame), 0, len(frame)
        while i < end:
            code = raw[i]
            raw[i] = 0
            i += code
        if i != end or end < _OVERHEAD:
            self.malformed += 1
            return None
        if crc32(raw[1:]) != _RESIDUE:
            self.crc_errors += 1
            return None
        message = _unpack(bytes(raw[1:-4]))
        self.malformed += message is None
        return message


def distance(a: int, b: int) -> int:
    """Return the difference a - b of two ticks counted modulo 2^16, from -32768 to 32767."""
    return ((a - b + 0x8000) & 0xFFFF) - 0x8000
