"""Compare frames with a textbook COBS, a bitwise CRC and the example of docs/protocol.md, and fuzz the decoder."""

import os
import random
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptic_loop.hw.device_state import Device
from haptic_loop.hw.protocol import (
    Ack,
    Cause,
    Command,
    Config,
    Decoder,
    Force,
    Hello,
    Info,
    Phase,
    State,
    Stop,
    config_crc,
    distance,
    encode,
    wire_bytes,
)

DOC = Path(__file__).parent.parent.parent / "docs/protocol.md"

INFO = Info(1, "haptic 1", 7, 1_200_000, (1_370_000,) * 2, (10_000_000,) * 2, (500,) * 2, (24_000,) * 2, (8_000,) * 2)
CONFIG = Config(1, 4, 4, 0, (24_000,) * 2, (4_800,) * 2)
STATE = State(2, 1000, 999, -200, 0, 3, 1_234_567, (1500, -3000), (120, -4000))
FORCE = Force(2, 1001, 1000, (120, -4000))
EVERY = [Hello(), INFO, CONFIG, Ack(0x01020304, 0), STATE, FORCE, Stop(1)]
names = [type(m).__name__ for m in EVERY]


def crc_bitwise(data: bytes) -> int:
    """Return CRC-32 by its definition: reflected polynomial 0xEDB88320, initial value all ones, inverted at the end."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


def cobs_textbook(data: bytes) -> bytes:
    """Encode byte by byte after Cheshire and Baker, in blocks of up to 254 bytes."""
    out, block = bytearray(), bytearray()
    for byte in [*data, 0]:
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out)


def integers(bits: int, signed: bool = False):
    return st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else st.integers(0, 2**bits - 1)


def states(axes: int):
    u8, u16, i16, u32 = integers(8), integers(16), integers(16, True), integers(32)
    status = st.builds(
        lambda p, c, held: p | c << 4 | held << 7, st.sampled_from(Phase), st.sampled_from(Cause), st.booleans()
    )
    return st.builds(
        State, status, u16, u16, i16, u8, u8, u32, st.tuples(*[integers(32, True)] * axes), st.tuples(*[i16] * axes)
    )


def forces(axes: int):
    return st.builds(Force, integers(8), integers(16), integers(16), st.tuples(*[integers(16, True)] * axes))


def configs(axes: int):
    per_axis = st.tuples(*[st.integers(1, 0x7FFF)] * axes)
    return st.builds(Config, st.integers(1, 15), integers(8), st.integers(1, 255), integers(16), per_axis, per_axis)


def infos(axes: int):
    text = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=16)
    u32 = st.tuples(*[st.integers(1, 2**32 - 1)] * axes)
    limit, reach = st.tuples(*[st.integers(1, 0x7FFF)] * axes), st.tuples(*[st.integers(1, 2**31 - 1)] * axes)
    return st.builds(Info, integers(8), text, integers(32), st.integers(10**5, 10**8), u32, u32, u32, limit, reach)


small = st.one_of(
    st.builds(Hello, integers(8)), st.builds(Ack, integers(32), integers(8)), st.builds(Stop, integers(8))
)
axes = st.integers(1, 8)
messages = st.one_of(small, *[axes.flatmap(kind) for kind in (states, forces, configs, infos)])


@pytest.mark.slow
@given(messages)
def test_decoded_frames_equal_sent_messages(message):
    frame, decoder = encode(message), Decoder()
    assert decoder.feed(frame) == [message]
    assert decoder.rejected == 0
    n = getattr(message, "axes", 1)
    assert len(frame) == wire_bytes(type(message), n)
    assert frame.index(0) == len(frame) - 1  # the delimiter, and no other zero


@pytest.mark.parametrize("n", range(1, 9))
def test_frame_sizes_follow_the_formulas(n):
    assert wire_bytes(State, n) == 20 + 6 * n
    assert wire_bytes(Force, n) == 12 + 2 * n
    assert wire_bytes(Stop, n) == 8


def test_only_one_to_eight_axes_are_accepted():
    for n in (0, 9, -1):
        with pytest.raises(ValueError, match=rf"axes: {n}; the protocol carries 1 to 8"):
            wire_bytes(State, n)


def test_two_axes_need_921600_baud_at_1200_us():
    """At ten bits a byte, 115200 baud cannot carry both frames in 1.2 ms; 921600 baud and 2 Mbaud can."""
    both = wire_bytes(State, 2) + wire_bytes(Force, 2)
    assert [round(both * 10 / baud * 1e6) for baud in (115_200, 921_600, 2_000_000)] == [4167, 521, 240]


@given(st.binary(max_size=250))
def test_stuffing_and_crc_equal_their_definitions(data):
    """Any payload framed by the test is a message, malformed or too long, but never a CRC error."""
    raw = data + crc_bitwise(data).to_bytes(4, "little")
    decoder = Decoder()
    got = decoder.feed(cobs_textbook(raw) + b"\0")
    assert len(got) + decoder.malformed + decoder.oversize == 1
    assert decoder.oversize == (len(cobs_textbook(raw)) > 175)


@pytest.mark.parametrize("message", EVERY, ids=names)
def test_frames_equal_the_textbook(message):
    from haptic_loop.hw.protocol import pack

    payload = pack(message)
    assert encode(message) == cobs_textbook(payload + crc_bitwise(payload).to_bytes(4, "little")) + b"\0"
    assert crc_bitwise(b"123456789") == 0xCBF43926  # the check value that the CRC catalogue gives for CRC-32


def test_encode_gives_the_worked_example_of_the_documentation():
    """docs/protocol.md, "A worked example": each hex line is a frame, the line above it the message."""
    text = DOC.read_text().split("## A worked example", 1)[1]
    pairs = re.findall(r"^# (\w+\(.*\))\n((?:[0-9a-f]{2} ?)+)$", text, re.M)
    assert [called.split("(")[0] for called, _ in pairs] == ["Hello", "Info", "Config", "Ack", "State", "Force", "Stop"]
    for called, line in pairs:
        message = eval(called)  # the page is ours and has constructors only
        assert encode(message).hex(" ") == line
        assert Decoder().feed(bytes.fromhex(line)) == [message]
    assert f"{config_crc(eval(pairs[2][0])):#010x}" in pairs[3][0]


BAD = [
    (STATE._replace(tick=70_000), "State.tick: 70000; 0 to 65535"),
    (STATE._replace(counts=(1, 2**31)), "State.counts #2: 2147483648; -2147483648 to 2147483647"),
    (STATE._replace(counts=(1,)), "State.applied: 2 entries; 1 to 8, as many in every axis field"),
    (FORCE._replace(force=(1, float("nan"))), "Force.force #2: nan; integers only"),
    (FORCE._replace(force=(1.5, 0)), "Force.force #1: 1.5; integers only"),
    (FORCE._replace(force=(0, 40_000)), "Force.force #2: 40000; -32768 to 32767"),
    (FORCE._replace(force=()), "Force.force: 0 entries; 1 to 8, as many in every axis field"),
    (FORCE._replace(force=(0,) * 9), "Force.force: 9 entries; 1 to 8, as many in every axis field"),
    (FORCE._replace(force=3), "Force.force: 3; a tuple with one integer per axis"),
    (FORCE._replace(command=None), "Force.command: None; integers only"),
    (CONFIG._replace(theta=16), "Config.theta: 16; 0 to 15"),
    (CONFIG._replace(ramp=0), "Config.ramp: 0; 1 to 255"),
    (CONFIG._replace(slew=(0, 1)), "Config.slew #1: 0; 1 to 65535"),
    (INFO._replace(firmware="x" * 17), f"Info.firmware: {'x' * 17!r}; at most 16 printable ASCII characters"),
    (INFO._replace(firmware="é"), "Info.firmware: 'é'; at most 16 printable ASCII characters"),
    (INFO._replace(period_ns=50_000), "Info.period_ns: 50000; 100000 to 100000000"),
    (INFO._replace(hard_limit=(24_000, 0)), "Info.hard_limit #2: 0; 1 to 32767"),
    (Hello(-1), "Hello.version: -1; 0 to 255"),
    (Stop("x"), "Stop.reason: 'x'; integers only"),
]


@pytest.mark.parametrize(("message", "text"), BAD, ids=[text.split(";")[0] for _, text in BAD])
def test_fields_out_of_range_are_named(message, text):
    with pytest.raises(ValueError, match=rf"^{re.escape(text)}$"):
        encode(message)


@pytest.mark.slow
@given(st.lists(messages, max_size=6), st.randoms(use_true_random=False))
def test_the_decoder_takes_pieces_of_any_size(sent, rng):
    stream, decoder, got = b"".join(map(encode, sent)), Decoder(), []
    while stream:
        n = rng.randint(1, 40)
        got += decoder.feed(stream[:n])
        stream = stream[n:]
    assert got == sent
    assert decoder.rejected == 0


def test_one_and_two_bit_errors_are_detected():
    """None of the 248 single and 30628 double bit flips of a STATE frame gives a message.

    This needs a test since COBS can spread a flipped bit over more bytes.
    """
    frame = encode(STATE)
    bits = range(8 * (len(frame) - 1))
    whole = int.from_bytes(frame[:-1], "little")
    for i in bits:
        for j in bits[i:]:
            damaged = whole ^ (1 << i) ^ (1 << j if j != i else 0)
            assert Decoder().feed(damaged.to_bytes(len(frame) - 1, "little") + b"\0") == []


def test_the_decoder_recovers_after_garbage():
    good = encode(FORCE)
    for garbage, counted in [
        (b"\x05garbage\0", {"malformed": 1}),
        (good[:-1] + good[:5] + b"\0", {"malformed": 1}),
        (good[:9] + b"\0" + good[9:], {"malformed": 2}),
        (bytes([good[0], good[1] ^ 1]) + good[2:], {"crc_errors": 1}),
        (b"\x01" * 500 + b"\0", {"oversize": 1}),
        (b"\0\0\0", {}),
    ]:
        decoder = Decoder()
        assert decoder.feed(garbage + good) == [FORCE]
        tally = {name: getattr(decoder, name) for name in ("crc_errors", "malformed", "oversize")}
        assert tally == {"crc_errors": 0, "malformed": 0, "oversize": 0} | counted, garbage


def test_endless_lines_fill_no_memory():
    decoder = Decoder()
    for _ in range(1000):
        assert decoder.feed(b"\xaa" * 997) == []
        assert len(decoder.tail) <= 176
    assert decoder.rejected == decoder.oversize == 1
    assert decoder.feed(b"\0" + encode(STATE)) == [STATE]
    assert decoder.rejected == 1


@pytest.mark.parametrize(
    "payload", [b"\x00", b"\x09\x01", b"\x05", b"\x01\x01\x01", b"\x06" + bytes(6), b"\x05" + bytes(14)]
)
def test_unknown_types_and_lengths_are_malformed(payload):
    decoder = Decoder()
    assert decoder.feed(cobs_textbook(payload + crc_bitwise(payload).to_bytes(4, "little")) + b"\0") == []
    assert (decoder.malformed, decoder.crc_errors) == (1, 0)


def test_a_status_without_a_name_is_malformed():
    """The phase and the cause of every decoded STATE have a name, so State.phase and State.cause never fail."""
    for status in range(256):
        got = Decoder().feed(encode(STATE._replace(status=status)))
        if got:
            assert got[0].phase | got[0].cause << 4 | got[0].deadman << 7 == status
        else:
            assert status & 15 not in set(Phase) or status >> 4 & 7 not in set(Cause)


def test_ticks_are_counted_modulo_65536():
    assert distance(2, 65_535) == 3
    assert distance(65_535, 2) == -3
    assert distance(0x8000, 0) == -0x8000


# ---- fuzz: nothing crashes, no motor moves --------------------------------------------------------------------------


def disarmed() -> Device:
    device = Device(INFO)
    device.receive(encode(CONFIG), 0)
    device.tick(0, (0, 0))
    assert device.phase == Phase.DISARMED
    return device


def assert_no_force_after(device: Device, data: bytes, now: int, k: int) -> None:
    """Feed a piece of data and tick; the motors must carry no force."""
    device.receive(data, now)
    forces, sent = device.tick(now, (k, -k))
    assert forces == (0, 0)
    assert 0 < len(sent) < 260


def test_a_million_random_bytes_move_no_motor():
    rng, host = random.Random(1), Decoder()
    silent, device = Device(INFO), disarmed()
    rounds = int(os.environ.get("HAPTIC_FUZZ_ROUNDS", "1"))  # 100 rounds take some minutes
    for _ in range(rounds):
        noise = rng.randbytes(1_000_000)
        assert host.feed(noise) == []
        for k in range(0, len(noise), 500):
            assert_no_force_after(device, noise[k : k + 500], k, k)
            silent.receive(noise[k : k + 500], k)
            assert silent.tick(k, (0, 0)) == ((0, 0), b"")
    assert host.rejected > 3000 * rounds
    assert device.decoder.rejected == silent.decoder.rejected >= host.rejected
    assert device.phase == Phase.DISARMED


def mutations(rng: random.Random, frame: bytes):
    """Yield damaged copies of a frame, each with a delimiter at the end; the argument `frame` has none.

    Copies have wrong bits or bytes, holes, insertions, cuts or swapped halves.
    """
    while True:
        data = bytearray(frame)
        for _ in range(rng.choice((1, 1, 2, 5))):
            at = rng.randrange(len(data) + 1)
            kind = rng.randrange(6)
            if kind == 0 and at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            elif kind == 1 and at < len(data):
                data[at] = rng.randrange(256)
            elif kind == 2:
                del data[at : at + rng.randint(1, 4)]
            elif kind == 3:
                data[at:at] = rng.randbytes(rng.randint(1, 4))
            elif kind == 4:
                del data[at:]
            else:
                data = data[at:] + data[:at]
        if bytes(data).strip(b"\0") != frame:
            yield bytes(data) + b"\0"


@pytest.mark.slow
def test_mutated_commands_arm_nothing_and_move_nothing():
    """No damaged ARM or RUN frame for the next tick has an effect; an intact ARM frame then arms the device."""
    device, rng = disarmed(), random.Random(2)
    for n in range(20_000):
        good = Force(
            Command.ARM if n % 2 else Command.RUN, (device.k + 1) & 0xFFFF, device.k, (0, 0) if n % 2 else (9000, 9000)
        )
        assert_no_force_after(device, next(mutations(rng, encode(good)[:-1])), n, n)
    assert device.phase == Phase.DISARMED
    device.receive(encode(Force(Command.ARM, (device.k + 1) & 0xFFFF, device.k, (0, 0))), 0)
    device.tick(0, (0, 0))
    assert device.phase == Phase.ARMED


def test_mutated_frames_only_bring_devices_to_rest():
    """Damaged frames count as missed: the last force is held, ramped down, and stays at zero."""
    rng = random.Random(3)
    for _ in range(300):
        device = disarmed()
        for command, force in [(Command.ARM, (0, 0)), (Command.RUN, (3000, -2000))]:
            device.receive(encode(Force(command, device.k + 1, device.k, force)), 0)
            device.tick(0, (0, 0))
        for expected in [1.0] * 4 + [0.75, 0.5, 0.25, 0.0, 0.0]:
            good = Force(Command.RUN, device.k + 1, device.k, (24_000, 24_000))
            device.receive(next(mutations(rng, encode(good)[:-1])), 0)
            assert device.tick(0, (0, 0))[0] == (3000 * expected, -2000 * expected)
        assert (device.phase, device.cause) == (Phase.STOPPED, Cause.WATCHDOG)
