"""Compare hw/firmware with hw/device_state.py byte for byte, and run the example sketch on a stub board."""

import ctypes
import os
import random
import re
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

from haptic_loop.hw.device_state import Device
from haptic_loop.hw.protocol import (
    _LAYOUTS,
    _READ,
    Ack,
    Cause,
    Command,
    Config,
    Decoder,
    Force,
    Hello,
    Info,
    Phase,
    Reason,
    Refused,
    State,
    Stop,
    encode,
)
from tests.compiled_device import GCC, HARNESS, HEADER, STRICT, Firmware, build, enclosed, framed, needs_gcc

GXX = shutil.which("g++")
needs_gxx = pytest.mark.skipif(GXX is None, reason="g++ is not installed: example.ino is not compiled here")

SERIAL = 77


def info(axes: int, period_ns: int = 1_200_000) -> Info:
    limits = tuple(24000 - 1000 * a for a in range(axes))
    return Info(
        2,
        "harness",
        SERIAL,
        period_ns,
        (1_370_000,) * axes,
        (10_000_000,) * axes,
        (500,) * axes,
        limits,
        (8000,) * axes,
    )


class Traffic:
    """Draw the random events between ticks: a host's right and wrong messages, faults of the line, emergency stops."""

    def __init__(self, seed: int, device: Device) -> None:
        self.rng, self.hand, self.device = random.Random(seed), random.Random(~seed), device
        self.theta = self.rng.choice((0, 1, 1, 2, 3, 15))
        self.loss, self.trouble = self.rng.choice((0.0, 0.05, 0.5)), self.rng.choice((0.0, 0.02, 0.2))
        self.recent: list[bytes] = []

    def config(self) -> Config:
        axes, rng = self.device.info.axes, self.rng
        cap = tuple(rng.randint(1, limit) for limit in self.device.info.hard_limit)
        slew = tuple(rng.choice((1, 500, 4800, 65535)) for _ in range(axes))
        return Config(self.theta, rng.randint(0, 4), rng.randint(1, 6), rng.choice((0, 0, 3, 100)), cap, slew)

    def force(self) -> Force:
        """Return a valid FORCE in time: mostly RUN with a random force, but IDLE or ARM with zero force if DISARMED."""
        d, rng = self.device, self.rng
        source = d.k
        command, force = rng.choice((Command.IDLE, Command.ARM)), (0,) * d.info.axes
        if d.phase != Phase.DISARMED and rng.random() < 0.95:
            command, force = Command.RUN, struct.unpack(f"<{d.info.axes}h", rng.randbytes(2 * d.info.axes))
        return Force(command, shifted(source, d.config.theta if d.config else self.theta), source, force)

    def oddity(self) -> bytes:
        """Return a well-formed message that may be wrong at this moment, or a wrong frame."""
        rng, d, good = self.rng, self.device, self.force()
        axes, (code, size) = rng.randint(1, 8), rng.choice(list(_READ))
        late = rng.choice((-1, -2, 1, 2, 300, 0x8000, rng.randint(0, 0xFFFF)))
        choices = [
            lambda: encode(self.config()),
            lambda: framed(self.config()._replace(theta=rng.choice((16, 31, 255)))),
            lambda: framed(self.config()._replace(ramp=rng.choice((0, 200)))),
            lambda: framed(self.config()._replace(cap=(rng.choice((0, 65535)),) * d.info.axes)),
            lambda: encode(self.config()._replace(cap=tuple(c + rng.randint(0, 1) for c in d.info.hard_limit))),
            lambda: framed(self.config()._replace(slew=(0,) * d.info.axes)),
            lambda: encode(Config(1, 4, 4, 0, (100,) * axes, (100,) * axes)),
            lambda: encode(Hello(rng.randint(0, 255))),
            lambda: encode(good._replace(apply_at=shifted(good.apply_at, late), source=shifted(good.source, late))),
            lambda: encode(good._replace(apply_at=shifted(good.apply_at, late))),
            lambda: encode(
                good._replace(command=rng.choice((0, 1, 2, 3, 255)), force=(rng.randint(-9, 9),) * d.info.axes)
            ),
            lambda: encode(good._replace(force=(0,) * axes)),
            lambda: encode(good) + encode(good._replace(force=(0,) * d.info.axes)),
            lambda: encode(State(rng.choice((1, 0x22, 0x77)), 1, 1, 1, 1, 1, 1, (1,) * axes, (1,) * axes)),
            lambda: encode(Ack(rng.getrandbits(32), 0)),
            lambda: d.info_frame,
            lambda: enclosed(bytes([code]) + rng.randbytes(size - rng.choice((0, 1, 1, 1, 2)))),
            lambda: enclosed(bytes([_LAYOUTS[Config].code]) + rng.randbytes(5 + 4 * rng.randint(8, 10))),
            lambda: rng.randbytes(rng.randint(1, 400)),
            lambda: rng.randbytes(rng.choice((174, 175, 176, 177, 600))).replace(b"\0", b"\1"),
            lambda: bytes(rng.randint(0, 3)),
            lambda: mutated(rng, encode(good)),
            lambda: mutated(rng, encode(self.config())),
        ]
        return rng.choice(choices)()

    def between_ticks(self, now: int) -> list[tuple]:
        """Return operations: receive ("R", now, bytes), e-stop ("E",), fault ("F",), deadman ("D", held)."""
        rng, d, ops, data = self.rng, self.device, [], b""
        if d.phase in (Phase.SILENT, Phase.STOPPED, Phase.ESTOP) and rng.random() < 0.3:
            data += encode(self.config())
        if rng.random() >= self.loss:
            data += encode(self.force())
        if rng.random() < self.trouble:
            data += self.oddity() if rng.random() < 0.9 else encode(Stop(rng.choice((0, 1, 2, 77))))
        if rng.random() < (0.2 if d.phase == Phase.ESTOP else self.trouble / 10):
            ops.append(rng.choice([("E",), ("F",), ("F",), ("F",), ("R", now, encode(Stop(Reason.ESTOP)))]))
        if self.hand.random() < 0.05:
            ops.append(("D", self.hand.random() < 0.5))
        cut = rng.randint(0, len(data))
        return [("R", now + rng.randint(0, 300), data[:cut]), *ops, ("R", now + rng.randint(300, 3000), data[cut:])]


def shifted(tick: int, by: int) -> int:
    return (tick + by) & 0xFFFF


def mutated(rng: random.Random, frame: bytes) -> bytes:
    data = bytearray(frame)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(data) or 1)
        match rng.randrange(4):
            case 0 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                del data[at : at + rng.randint(1, 3)]
            case 2:
                data[at:at] = rng.randbytes(rng.randint(1, 3))
            case _:
                data = data[: at + 1]
    return bytes(data)


def episode(seed: int, ticks: int, first: int = 0) -> tuple[Info, list[tuple], list[tuple], set]:
    """Play traffic to the Python device. Return info, operations, answers to the ticks, and the phases and causes seen.

    The operations are those of `between_ticks`, the ticks themselves, ("T", now, counts), and ("K", number), which
    sets the number of the last tick to `first`.
    """
    rng = random.Random(seed)
    about = info(rng.randint(1, 8), rng.choice((100_000, 333_333, 1_200_000, 1_200_000, 2_000_001)))
    device, now, period = Device(about), rng.choice((0, 2**32 - 50_000)), about.period_ns // 1000
    traffic, script, answers, seen, latched = Traffic(seed, device), [("K", first)], [], set(), 0
    play(device, script[0])
    for _ in range(ticks):
        ops = traffic.between_ticks(now)
        now = (now + period) & 0xFFFFFFFF
        counts = struct.unpack(f"<{about.axes}i", rng.randbytes(4 * about.axes))
        for op in ops:
            play(device, op)
        answers.append(device.tick(now, counts))
        script += [*ops, ("T", now, counts)]
        seen.add((device.phase, device.cause))
        latched += device.phase == Phase.ESTOP
        if latched > 50:  # nothing can happen any more
            break
    return about, script, answers, seen


def play(device, op: tuple):
    match op:
        case ("R", now, data):
            device.receive(data, now & 0xFFFFFFFF)
        case ("T", now, counts):
            return device.tick(now, counts)
        case ("E",):
            device.estop()
        case ("F",):
            device.fault()
        case ("D", held):
            device.deadman = held
        case ("K", number):
            device.k = number
    return None


def described(answer) -> str:
    return f"{answer[0]} {Decoder().feed(answer[1])} {answer[1].hex(' ')}"


EPISODES = [(seed, 400, 0) for seed in range(int(os.environ.get("HAPTIC_FUZZ_EPISODES", "50")))]
EPISODES.append((1_000_000, 1500, 64_800))  # this episode crosses tick 65535


@pytest.fixture(scope="module")
def episodes():
    return [episode(*e) for e in EPISODES]


def test_the_traffic_visits_every_state_cause_and_refusal(episodes):
    """The comparison of C and Python below covers only what this traffic visits."""
    phases, causes = zip(*set().union(*(seen for *_, seen in episodes)), strict=True)
    assert set(phases) == set(Phase)
    assert set(causes) == set(Cause)
    answers = [a for _, _, answered, _ in episodes for a in answered]
    messages = [m for _, sent in answers for m in Decoder().feed(sent)]
    assert {m.refused for m in messages if isinstance(m, Ack)} == set(Refused)
    states = [m for m in messages if isinstance(m, State)]
    assert any(m.margin_us > 0 for m in states)
    assert {m.deadman for m in states if m.phase == Phase.ARMED} == {True, False}
    assert any(-0x7FFF < m.margin_us < 0 for m in states)
    last = [m for _, sent in episodes[-1][2] for m in Decoder().feed(sent) if isinstance(m, State)]
    ticks = [m.tick for m in last if m.phase == Phase.ARMED]
    assert max(ticks) == 0xFFFF
    assert min(ticks) < 10
    assert max(m.crc_errors for m in states) > 20
    assert any(isinstance(m, Info) for m in messages)
    assert sum(any(forces) for forces, _ in answers) > 2000


@needs_gcc
def test_c_and_python_agree_byte_for_byte(library, episodes):
    answered = 0
    for (seed, *_), (about, script, answers, _) in zip(EPISODES, episodes, strict=True):
        firmware, expected = Firmware(library, about), enumerate(answers)
        for op in script:
            answer = play(firmware, op)
            if op[0] == "T":
                tick, want = next(expected)
                both = f"C sent {described(answer)}, Python sent {described(want)}"
                assert answer == want, f"seed {seed}, tick {tick}: {both}"
                answered += len(want[1]) > 0
    assert answered > 12_000


def sanitized(folder: Path, *flags: str):
    """Compile with AddressSanitizer and UBSan. Return a function that plays a script and compares the answers."""
    program = folder / "harness"
    sanitize = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DHARNESS_MAIN"]
    try:
        build(GCC, "-std=c99", *STRICT, *sanitize, *flags, f"-I{HEADER}", HARNESS / "harness.c", "-o", program)
    except AssertionError as failed:
        if "cannot find" in str(failed):
            pytest.skip("this gcc comes without libasan or libubsan")
        raise

    def check(about: Info, script: list[tuple], answers: list[tuple]) -> None:
        done = subprocess.run([program], input=written(about, script), capture_output=True)
        assert done.returncode == 0, done.stderr.decode()
        force = struct.Struct(f"<{about.axes}h")
        assert done.stdout == b"".join(struct.pack("<H", len(out)) + out + force.pack(*f) for f, out in answers)

    return check


@pytest.mark.slow
@needs_gcc
def test_no_sanitizer_complains(tmp_path, episodes):
    """The sanitized program gives the same answers to the same traffic, and refuses nine axes."""
    check = sanitized(tmp_path)
    for about, script, answers, _ in [*episodes[::3], episodes[-1]]:
        check(about, script, answers)
    check(info(9), [], [])


@pytest.mark.slow
@needs_gcc
def test_small_devices_refuse_configs_of_more_axes(tmp_path):
    script = [("R", 0, encode(Config(1, 4, 4, 0, (100,) * 8, (100,) * 8))), ("T", 0, (0, 0))]
    device = Device(info(2))
    play(device, script[0])
    answer = device.tick(0, (0, 0))
    assert Decoder().feed(answer[1])[0].refused == Refused.AXES
    sanitized(tmp_path, "-DHL_MAX_AXES=2")(info(2), script, [answer])


def written(about: Info, script: list[tuple]) -> bytes:
    """Return a script as the harness reads it from standard input."""
    columns = zip(about.osp_damping, about.encoder_step, about.force_step, about.hard_limit, about.range, strict=True)
    out = [struct.pack("<III", about.serial, about.period_ns, about.axes)]
    out += [struct.pack("<5I", *axis) for axis in columns]
    for op in script:
        out.append(struct.pack("<I", ord(op[0])))
        if op[0] == "R":
            out.append(struct.pack("<II", op[1] & 0xFFFFFFFF, len(op[2])) + op[2])
        elif op[0] in "DK":
            out.append(struct.pack("<I", op[1]))
        elif op[0] == "T":
            out.append(struct.pack(f"<I{about.axes}i", op[1], *op[2]))
    return b"".join(out)


@needs_gcc
@pytest.mark.parametrize(
    "wrong",
    [
        {"period_ns": 99_999},
        {"period_ns": 100_000_001},
        {"encoder_step": (0, 1)},
        {"force_step": (1, 0)},
        {"hard_limit": (0, 1)},
        {"hard_limit": (32768, 1)},
        {"range": (1, 0)},
    ],
    ids=str,
)
def test_a_firmware_with_impossible_numbers_never_runs(library, wrong):
    with pytest.raises(ValueError, match="Info"):
        Device(info(2)._replace(**wrong))
    firmware = Firmware(library, info(2)._replace(**wrong))
    assert not firmware.good
    firmware.receive(encode(Config(1, 4, 4, 0, (100, 100), (100, 100))), 0)
    forces, sent = firmware.tick(0, (0, 0))
    (ack,) = Decoder().feed(sent)
    assert isinstance(ack, Ack)
    assert ack.refused == Refused.ESTOP
    assert forces == (0, 0)


@needs_gcc
@pytest.mark.parametrize("axes", [0, 9])
def test_a_firmware_without_possible_axes_never_runs(library, axes):
    with pytest.raises(ValueError, match="1 to 8"):
        Device(info(axes))
    firmware = Firmware(library, info(axes))
    assert not firmware.good
    firmware.force[:] = [7] * axes
    assert firmware.tick(0, (0,) * axes) == ((7,) * axes, b"")  # it has no axis whose force it could set


@needs_gcc
@pytest.mark.parametrize(
    "edge", [{"period_ns": 100_000}, {"period_ns": 100_000_000}, {"hard_limit": (32767, 1)}], ids=str
)
def test_the_edges_of_every_range_are_possible(library, edge):
    about = info(2)._replace(**edge)
    assert Device(about).info == about
    assert Firmware(library, about).good


@needs_gcc
@pytest.mark.parametrize(
    ("theta", "messages", "writes", "motors"),
    [
        (0, [Force(2, 3, 3, (30, -30))], 1, (30, -30)),
        (0, [Force(2, 3, 3, (30, -30)), Force(2, 3, 3, (40, -40))], 1, (30, -30)),
        (0, [Force(2, 2, 2, (30, -30)), Force(2, 4, 4, (30, -30))], 0, (20, -20)),
        (1, [Force(2, 4, 3, (30, -30)), Stop(0), Hello()], 0, (20, -20)),
        (0, [Stop(Reason.ESTOP), Stop(Reason.ESTOP), Hello()], 1, (0, 0)),
        (1, [Stop(Reason.ESTOP), Stop(Reason.ESTOP), Hello()], 1, (0, 0)),
    ],
)
def test_only_changed_forces_reach_motors_at_once(library, theta, messages, writes, motors):
    """The motors get forces with theta = 0 and emergency stops before the next tick, and no needless write."""
    device = Firmware(library, info(2))
    early, config = Force(Command.ARM, 0, 0, (0, 0)), Config(theta, 4, 4, 0, (100, 100), (100, 100))
    assert device.receive(framed(early) + framed(config), 0) == 0
    for command, force in [(Command.IDLE, (0, 0)), (Command.ARM, (0, 0)), (Command.RUN, (20, -20))]:
        device.receive(framed(Force(command, device.k + theta, device.k, force)), 0)
        device.tick(0, (0, 0))
    assert device.applied == (20, -20)
    assert device.receive(b"".join(map(framed, messages)), 0) == writes
    assert device.applied == motors


@needs_gcc
def test_headers_need_only_standard_c_without_heap(tmp_path):
    """Apart from haptic_frame.h, the headers include only headers of standard C99, and they use no floating point.

    The compiled harness calls memcpy, memset and strncpy only.
    """
    text = (HEADER / "haptic_frame.h").read_text() + (HEADER / "haptic_link.h").read_text()
    assert sorted(line for line in text.splitlines() if line.startswith("#include")) == [
        '#include "haptic_frame.h"',
        "#include <stdbool.h>",
        "#include <stddef.h>",
        "#include <stdint.h>",
        "#include <string.h>",
    ]
    flags = ["-std=c99", "-O0", "-fno-stack-protector", "-fno-pie", f"-I{HEADER}"]
    build(GCC, *flags, "-c", HARNESS / "harness.c", "-o", tmp_path / "harness.o")
    symbols = subprocess.run(["nm", "-u", tmp_path / "harness.o"], capture_output=True, text=True, check=True).stdout
    needed = {line.split()[-1].removeprefix("_") for line in symbols.splitlines()}
    assert needed == {"memcpy", "memset", "strncpy"}  # only the harness calls strncpy
    assert not re.search(r"\b(float|double)\b", text.split("#include", 1)[1])


SKETCH_PINS = {
    "encoder A": 2,
    "encoder B": 3,
    "pwm": (9, 10),
    "direction": (7, 8),
    "enable": 6,
    "stop": 11,
    "deadman": 12,
}


class Sketch:
    """example.ino on the stub board; its loop runs every 50 us."""

    def __init__(self, path: Path) -> None:
        self.lib = ctypes.CDLL(str(path))
        self.lib.stub_sent.restype = ctypes.c_size_t
        self.now, self.decoder = 0, Decoder()
        self.lib.stub_setup()

    def feed(self, message) -> None:
        data = encode(message)
        self.lib.stub_feed(data, ctypes.c_size_t(len(data)))

    def run(self, us: int) -> list:
        """Run for `us` microseconds and return the messages."""
        for _ in range(us // 50):
            self.now += 50
            self.lib.stub_loop(ctypes.c_ulong(self.now))
        out = ctypes.create_string_buffer(65536)
        n = self.lib.stub_sent(out, ctypes.c_size_t(65536))
        return self.decoder.feed(out.raw[:n])

    def pin(self, pin: int) -> int:
        return self.lib.stub_pin(pin)


@pytest.fixture(scope="module")
def compiled_sketch(tmp_path_factory):
    path = tmp_path_factory.mktemp("sketch") / "sketch.so"
    sources = [HEADER / "example.ino", HARNESS / "stub.cpp"]
    build(
        GXX, "-std=c++11", *STRICT, "-fPIC", "-shared", f"-I{HARNESS}", f"-I{HEADER}", "-x", "c++", *sources, "-o", path
    )
    return path


@pytest.fixture
def sketch(compiled_sketch, tmp_path):
    """Return a board that was just switched on. Each copy of the library has separate static variables."""
    return Sketch(Path(shutil.copy(compiled_sketch, tmp_path)))


@pytest.mark.slow
@needs_gxx
def test_the_example_sketch_arms_follows_and_stops(sketch):
    assert sketch.run(12_000) == []  # no message before HELLO or CONFIG
    sketch.feed(Hello())
    (about,) = sketch.run(1200)
    assert (about.axes, about.period_ns, about.firmware) == (2, 1_200_000, "example 1")
    assert sketch.lib.stub_resolution() == 12  # a step of force is a step of the PWM
    assert about.hard_limit == (4095, 4095)
    strongest = [n * step / 1e6 for n, step in zip(about.hard_limit, about.force_step, strict=True)]
    assert strongest == pytest.approx([12.0] * 2, rel=1e-3)  # the host accepts a shortfall of 0.1 %
    sketch.feed(Config(1, 4, 4, 0, (4095, 4095), (4095, 4095)))
    ack, state = sketch.run(1200)
    assert ack.refused == Refused.ACCEPTED
    for command, force in [(Command.ARM, (0, 0)), *[(Command.RUN, (2048, -4095))] * 3]:
        sketch.feed(Force(command, (state.tick + 1) & 0xFFFF, state.tick, force))
        (state,) = sketch.run(1200)
    assert (state.phase, state.applied, state.deadman) == (Phase.ARMED, (2048, -4095), True)
    assert [sketch.pin(p) for p in SKETCH_PINS["pwm"]] == [2048, 4095]
    assert [sketch.pin(p) for p in SKETCH_PINS["direction"]] == [0, 1]
    assert sketch.pin(SKETCH_PINS["enable"]) == 1
    *_, state = sketch.run(12_000)  # without a host, the watchdog acts
    assert (state.phase, state.cause, state.applied) == (Phase.STOPPED, Cause.WATCHDOG, (0, 0))
    assert sketch.pin(SKETCH_PINS["enable"]) == 0


@needs_gxx
def test_the_sketch_counts_edges_and_obeys_its_button(sketch):
    sketch.feed(Config(1, 4, 4, 0, (4095, 4095), (4095, 4095)))
    sketch.run(1200)
    for level_b, level_a in [(0, 1), (1, 0), (0, 1), (1, 0), (1, 1)]:  # five edges of A; the last one counts back
        sketch.lib.stub_set_pin(SKETCH_PINS["encoder B"], level_b)
        sketch.lib.stub_set_pin(SKETCH_PINS["encoder A"], level_a)
    (state,) = sketch.run(1200)
    assert state.counts == (-3, 0)
    sketch.lib.stub_set_pin(SKETCH_PINS["stop"], 1)
    (state,) = sketch.run(1200)
    assert (state.phase, state.cause) == (Phase.ESTOP, Cause.ESTOP_DEVICE)
    sketch.lib.stub_set_pin(SKETCH_PINS["stop"], 0)
    (state,) = sketch.run(1200)
    assert (state.phase, state.deadman) == (Phase.ESTOP, True)
    sketch.lib.stub_set_pin(SKETCH_PINS["deadman"], 1)  # the deadman is released, or its wire is broken
    (state,) = sketch.run(1200)
    assert not state.deadman


@needs_gxx
def test_the_sketch_never_waits_for_the_host(sketch):
    sketch.feed(Config(1, 4, 4, 0, (4095, 4095), (4095, 4095)))
    sketch.run(1200)
    sketch.lib.stub_room(0)
    assert sketch.run(12_000) == []
    sketch.lib.stub_room(1000)
    assert [state.tick for state in sketch.run(1200)] == [11, 12]  # the newest STATE that waited, and the next one
    sketch.now += 100_000  # the board was held up for 83 periods
    (state,) = sketch.run(1200)
    assert (state.tick, state.phase, state.cause) == (13, Phase.STOPPED, Cause.DEVICE)


@needs_gxx
@pytest.mark.parametrize("room", [1, 31, 63])
def test_small_write_buffers_send_whole_frames(sketch, room):
    """The loop runs every 50 us, 24 times in a period. A frame that has no time to leave is dropped whole."""
    sketch.lib.stub_room(room)
    sketch.feed(Hello(7))
    (about,) = [m for m in sketch.run(10_000) if isinstance(m, Info)]
    assert about.axes == 2
    sketch.feed(Config(1, 4, 4, 0, (4095, 4095), (4095, 4095)))
    sketch.run(4_000)
    ticks = [m.tick for m in sketch.run(12_000)]
    assert len(ticks) == 10 if room > 1 else 4 <= len(ticks) < 10
    assert ticks == sorted(set(ticks))


@needs_gxx
def test_only_ticks_feed_the_boards_watchdog(sketch):
    """In a running sketch the watchdog does not expire.

    The source calls watchdogFeed() exactly once: in loop(), after the check that a tick is due and after the forces are
    written.
    """
    sketch.run(100_000)
    assert not sketch.lib.stub_bites()
    text = (HEADER / "example.ino").read_text()
    loop = text[text.index("void loop()") :]
    assert text.count("watchdogFeed();") == loop.count("watchdogFeed();") == 1
    assert loop.index("not due yet") < loop.index("watchdogFeed();") > loop.index("writeForces(force);")


# The tests below play short sequences of messages and ticks to both implementations and check rules of
# docs/protocol.md.


@pytest.fixture
def device(machine):
    """Return the Python or the C device with two axes, whose ticks the test calls one by one."""
    return Hand(machine(info(2)))


class Hand:
    """A device and its host; a test calls each tick."""

    def __init__(self, device) -> None:
        self.device, self.now, self.k = device, 0, 0

    def tell(self, *messages, after=100) -> None:
        self.device.receive(b"".join(framed(m) for m in messages), self.now + after)

    def tick(self, ticks=1) -> list:
        said = []
        for _ in range(ticks):
            self.now, self.k = self.now + 1200, self.k + 1
            self.force, out = self.device.tick(self.now, (0, 0))
            said = Decoder().feed(out)
        return said

    def state(self, ticks=1):
        return next(m for m in self.tick(ticks) if isinstance(m, State))

    def armed(self, theta=2, hold=4, ramp=5, force=(1000, -1000)):
        self.tell(Config(theta, hold, ramp, 0, (20000, 20000), (20000, 20000)))
        self.tick()
        for command, steps in [(Command.ARM, (0, 0))] + [(Command.RUN, force)] * (theta + 2):
            self.answer(command, steps, theta)
            self.tick()
        return self

    def answer(self, command, steps, theta):
        self.tell(Force(command, shifted(self.k, theta), self.k, steps))


@pytest.mark.parametrize(("theta", "hold", "ramp"), [(0, 4, 5), (1, 4, 5), (2, 4, 5), (3, 0, 1), (15, 2, 8)])
def test_host_death_ends_in_zero_force(device, theta, hold, ramp):
    device.armed(theta, hold, ramp)
    device.answer(Command.RUN, (1000, -1000), theta)  # the last answer
    forces = []
    due = max(1, theta)  # with theta = 0, too, the device misses an answer only when the next tick begins
    for _ in range(due + hold + ramp + 1):
        device.tick()
        forces.append(device.force)
    assert forces[-3 if ramp > 1 else -4] != (0, 0)
    assert forces.index((0, 0)) == due + hold + ramp - 1  # (due + hold + ramp) T after the last answered STATE
    assert forces[due + hold - 1] == (1000, -1000)


def test_a_ramp_is_the_same_at_zero_force(device):
    """A RAMP at zero force lasts as long as any other RAMP, and refuses a CONFIG, too."""
    device.armed(theta=1, ramp=5, force=(0, 0))
    device.tell(Stop(0))
    phases = []
    for _ in range(5):
        device.tell(Config(1, 4, 5, 0, (1, 1), (1, 1)))
        said = device.tick()
        phases.append(next(m.phase for m in said if isinstance(m, State)))
        assert device.force == (0, 0)
    assert phases == [Phase.RAMP] * 4 + [Phase.STOPPED]


def test_emergency_stops_replace_earlier_causes(device):
    device.armed()
    device.tell(Stop(0))
    device.device.fault()
    assert device.state().cause == Cause.HOST  # the first cause stays
    device.tell(Stop(Reason.ESTOP))
    state = device.state()
    assert (state.phase, state.cause) == (Phase.ESTOP, Cause.ESTOP_HOST)
    device.device.estop()
    assert device.state().cause == Cause.ESTOP_HOST  # the first emergency stop stays


def test_late_double_or_mistimed_forces_never_act(device):
    """A late FORCE sets only echo and a negative margin.

    A second FORCE for the same tick sets nothing, nor does one with a wrong theta. None of them counts as a CRC error.
    """
    device.armed(theta=2)
    before = device.state()
    k = device.k
    device.tell(Force(2, shifted(k, -1), shifted(k, -3), (7, 7)))
    state = device.state()
    assert (state.echo, state.applied) == (shifted(k, -3), before.applied)
    assert state.margin_us < 0
    device.armed(theta=2)
    k = device.k
    device.tell(Force(2, shifted(k, 2), k, (500, 0)))
    device.tell(Force(2, shifted(k, 2), k, (600, 0)), after=200)
    device.tell(Force(2, shifted(k, 1), k, (700, 0)), after=300)
    state = device.state()
    assert (state.echo, state.margin_us) == (k, 2300)  # echo and margin of the first FORCE
    assert device.state().applied == (500, 0)
    assert state.crc_errors == before.crc_errors


def test_a_force_before_config_is_dropped_silently(device):
    device.tell(Force(2, 3, 2, (5, 5)))
    assert device.tick() == []
    device.tell(Config(1, 4, 5, 0, (9, 9), (9, 9)))
    state = device.state()
    assert (state.crc_errors, state.margin_us, state.phase) == (0, -32768, Phase.DISARMED)


def test_a_hello_of_another_version_is_answered(device):
    """The host refuses the version; the answer lets it say why."""
    device.tell(Hello(9))
    (about,) = device.tick()
    assert (type(about), about.version) == (Info, 2)


def test_armed_devices_report_the_deadman(device):
    device.armed()
    assert not device.state().deadman
    for held in (True, False, True):
        device.device.deadman = held
        device.answer(Command.RUN, (1000, -1000), 2)
        state = device.state()
        assert (state.deadman, state.phase in (Phase.ARMED, Phase.HOLDING), state.applied) == (
            held,
            True,
            (1000, -1000),
        )


def test_configs_keep_counters_and_forget_forces(device):
    device.armed(theta=2)
    device.device.receive(b"\x05nonsense\0", device.now)
    device.tell(Force(2, shifted(device.k, 2), device.k, (500, 0)), Stop(0))
    before = device.state(8)
    assert before.misses > 0
    assert before.crc_errors == 1
    device.tell(Config(3, 4, 5, 0, (9, 9), (9, 9)))
    state = device.state()
    assert (state.crc_errors, state.tick) == (1, before.tick + 1)
    assert state.misses == before.misses + 1  # this tick had no FORCE
    assert (state.echo, state.margin_us, state.applied) == (0, -32768, (0, 0))


def test_text_costs_one_frame_at_most(device):
    """Boot messages, or noise of another baud rate, spoil frames only up to the next delimiter."""
    device.device.receive(b"Booting v1.2 ...\r\n", 0)
    device.tell(Hello())
    assert device.tick() == []
    device.tell(Hello())
    assert [type(m) for m in device.tick()] == [Info]
