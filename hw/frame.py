"""The bytes on the wire: payload + CRC-32, COBS-stuffed, ended by 0x00. docs/protocol.md draws every byte.

A payload is a type byte, fixed fields, then one group of fields per axis: the number of axes follows from the length.
All integers are little-endian; there is no float, so no NaN can travel. The longest frame has fewer than 254 bytes
before stuffing, so COBS costs exactly one byte and the size of a frame does not depend on its content.
"""

import operator
from itertools import chain
from struct import Struct, error
from typing import Any, NamedTuple
from zlib import crc32

from hw.message import MAX_AXES, MAX_THETA, Ack, Cause, Config, Force, Hello, Info, Message, Phase, State, Stop

__all__ = ["Ack", "Config", "Decoder", "Force", "Hello", "Info", "Message", "State", "Stop"]
__all__ += ["config_crc", "distance", "encode", "later", "wire_bytes"]

U8, U16, U32 = (0, 0xFF), (0, 0xFFFF), (0, 0xFFFFFFFF)
I16, I32 = (-0x8000, 0x7FFF), (-0x80000000, 0x7FFFFFFF)
TEXT = 16  # bytes of Info.firmware, ASCII, filled up with zeros


class Layout(NamedTuple):
    """One kind of payload: type byte, struct codes of its fixed fields and of one axis, what each field may hold."""

    code: int
    fixed: str
    axis: str
    limits: tuple[tuple[int, int], ...]


LAYOUTS: dict[type, Layout] = {
    Hello: Layout(1, "B", "", (U8,)),
    Info: Layout(
        2,
        f"B{TEXT}sII",
        "IIIHi",
        (U8, (0, TEXT), U32, (100_000, 100_000_000), U32, (1, U32[1]), (1, U32[1]), (1, I16[1]), (1, I32[1])),
    ),
    Config: Layout(3, "BBBH", "HH", ((1, MAX_THETA), U8, (1, 0xFF), U16, (1, I16[1]), (1, U16[1]))),
    Ack: Layout(4, "IB", "", (U32, U8)),
    State: Layout(5, "BHHhBBI", "ih", (U8, U16, U16, I16, U8, U8, U32, I32, I16)),
    Force: Layout(6, "BHH", "h", (U8, U16, U16, I16)),
    Stop: Layout(7, "B", "", (U8,)),
}


class Form(NamedTuple):
    """A layout for a given number of axes; `fixed` counts the values before the first axis, type byte included."""

    kind: type
    struct: Struct
    fixed: int
    columns: int


def form(kind: type, axes: int) -> Form:
    layout = LAYOUTS[kind]
    columns = len(layout.axis)
    return Form(kind, Struct("<B" + layout.fixed + layout.axis * axes), 1 + len(layout.limits) - columns, columns)


#: by kind and number of axes (0 where a message has none) to write, by type byte and length to read
FORMS = {(kind, n): form(kind, n) for kind in LAYOUTS for n in (range(1, MAX_AXES + 1) if LAYOUTS[kind].axis else (0,))}
READ = {(LAYOUTS[kind].code, f.struct.size): f for (kind, _), f in FORMS.items()}

OVERHEAD = 6  # CRC-32, the COBS byte, the delimiter
MAX_WIRE = max(f.struct.size for f in FORMS.values()) + OVERHEAD
RESIDUE = crc32(bytes(4) + crc32(bytes(4)).to_bytes(4, "little"))  # CRC-32 over anything followed by its own CRC-32
STATUSES = frozenset(phase | cause << 4 for phase in Phase for cause in Cause)
CHECKED = (Hello, Info, Config, Ack, Stop)  # seldom sent: every field looked at; State and Force leave it to struct


def wire_bytes(kind: type, axes: int) -> int:
    """Length of a frame, delimiter included: STATE 20 + 6N, FORCE 12 + 2N."""
    f = FORMS.get((kind, axes if LAYOUTS[kind].axis else 0))
    if f is None:
        raise ValueError(f"axes: {axes}; the protocol carries 1 to {MAX_AXES}")
    return f.struct.size + OVERHEAD


def encode(message: Message) -> bytes:
    """The frame of a message. Raises ValueError that names the field, what it held and what it may hold."""
    if type(message) in CHECKED:
        check(message)
    payload = pack(message)
    raw = payload + crc32(payload).to_bytes(4, "little")
    return b"".join([CODES[len(block)] + block for block in raw.split(b"\0")]) + b"\0"


#: a COBS block is its length plus one, then its bytes; the zero behind it goes without saying
CODES = [bytes((n + 1,)) for n in range(254)]


def pack(message: Message) -> bytes:
    """The payload of a message."""
    kind = type(message)
    layout = LAYOUTS[kind]
    values: Any = message
    if isinstance(message, Info):
        values = (message.version, message.firmware.encode("ascii"), *message[2:])
    try:
        if not layout.axis:
            return FORMS[kind, 0].struct.pack(layout.code, *values)
        columns: Any = message[-len(layout.axis) :]
        by_axis = columns[0] if len(columns) == 1 else chain.from_iterable(zip(*columns, strict=True))
        f = FORMS[kind, len(columns[0])]
        return f.struct.pack(layout.code, *values[: f.fixed - 1], *by_axis)
    except (error, KeyError, TypeError, ValueError):
        check(message)
        raise


def check(message: Message) -> None:
    """Raises ValueError for the first field that cannot travel."""
    layout, name = LAYOUTS[type(message)], type(message).__name__
    fixed = len(layout.limits) - len(layout.axis)
    axes, values = None, tuple[Any, ...](message)
    for index, (field, value, limits) in enumerate(zip(message._fields, values, layout.limits, strict=True)):
        if limits == (0, TEXT):
            if not (isinstance(value, str) and value.isascii() and value.isprintable() and len(value) <= TEXT):
                raise ValueError(f"{name}.{field}: {value!r}; at most {TEXT} printable ASCII characters")
        elif index < fixed:
            check_integer(f"{name}.{field}", value, limits)
        elif not isinstance(value, tuple):
            raise ValueError(f"{name}.{field}: {value!r}; a tuple with one integer per axis")
        else:
            axes = len(value) if axes is None else axes
            if len(value) != axes or not 1 <= axes <= MAX_AXES:
                raise ValueError(f"{name}.{field}: {len(value)} entries; 1 to {MAX_AXES} axes, every field the same")
            for axis, entry in enumerate(value):
                check_integer(f"{name}.{field}[{axis}]", entry, limits)


def check_integer(name: str, value: Any, limits: tuple[int, int]) -> None:
    """Raises ValueError naming the field unless the value is an integer from limits[0] to limits[1]."""
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name}: {value!r}; integers only") from None
    if not limits[0] <= number <= limits[1]:
        raise ValueError(f"{name}: {value}; {limits[0]} to {limits[1]}")


def unpack(payload: bytes) -> Message | None:
    """The message of a payload; None where type and length fit none, a status has no name or a text is not ASCII."""
    f = READ.get((payload[0], len(payload)))
    if f is None or (f.kind is State and payload[1] not in STATUSES):
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
    """CRC-32 of a CONFIG's payload: what the ACK for it carries."""
    return crc32(pack(config))


class Decoder:
    """Bytes in any pieces -> messages. Whatever cannot be read is counted and dropped up to the next delimiter."""

    def __init__(self) -> None:
        self.crc_errors = 0
        self.malformed = 0  # COBS does not come out, or no message has this type and length
        self.oversize = 0  # longer than any frame
        self.tail = b""  # never longer than MAX_WIRE
        self.skipping = False  # inside an oversize frame that is already counted

    @property
    def rejected(self) -> int:
        return self.crc_errors + self.malformed + self.oversize

    def feed(self, data: bytes) -> list[Message]:
        """The messages completed by these bytes, oldest first."""
        *frames, tail = (self.tail + data).split(b"\0")
        messages = []
        for frame in frames:
            if frame and (message := self.read(frame)) is not None:
                messages.append(message)
            self.skipping = False
        if len(tail) >= MAX_WIRE:
            self.oversize += not self.skipping
            self.skipping, tail = True, tail[:MAX_WIRE]
        self.tail = tail
        return messages

    def read(self, frame: bytes) -> Message | None:
        """One frame without its delimiter."""
        if len(frame) >= MAX_WIRE:
            self.oversize += not self.skipping
            return None
        raw, i, end = bytearray(frame), 0, len(frame)
        while i < end:
            code = raw[i]
            raw[i] = 0
            i += code
        if i != end or end < OVERHEAD:
            self.malformed += 1
            return None
        if crc32(raw[1:]) != RESIDUE:
            self.crc_errors += 1
            return None
        message = unpack(bytes(raw[1:-4]))
        self.malformed += message is None
        return message


def distance(a: int, b: int) -> int:
    """How many ticks a lies after b: -32768 to 32767, ticks counted modulo 2^16."""
    return ((a - b + 0x8000) & 0xFFFF) - 0x8000


def later(a: int, b: int) -> bool:
    """Whether tick a comes after tick b, the ticks less than 2^15 apart."""
    return distance(a, b) > 0
