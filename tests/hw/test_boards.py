"""Sketches without a host run an exported tick on a simulated ATmega328P and Cortex-M7 (`make firmware`)."""

import re
import runpy
import subprocess
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.cli import design, export
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.assessment import assess
from haptic_loop.design.coupling_file import Stored, load, save
from haptic_loop.design.export import _sequential, process_block
from haptic_loop.sim.scenario import load as load_scenario
from tests.hw.test_alone import write_export

pytestmark = pytest.mark.firmware

ROOT = Path(__file__).parents[2]
FIRMWARE, BOARDS = ROOT / "hw/firmware", ROOT / "tests/firmware"
CORE = Path("/usr/share/arduino/hardware/arduino/avr")
AVR = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR", "-DDECIMAL_DIG=17", "-Os"]
AVR += ["-ffp-contract=off", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "-I."]
AVR += [f"-I{CORE / 'cores/arduino'}", f"-I{CORE / 'variants/standard'}", f"-I{FIRMWARE}"]
VECTOR = """
#define main test_main
#include "coupling-process.c"
#undef main
#include <avr/interrupt.h>
#include <avr/sleep.h>
int main(void) { GPIOR0 = (unsigned char)(10 + test_main()); cli(); sleep_mode(); for (;;) {} }
"""
M7 = ["-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-O2", "-ffp-contract=off", "-fno-exceptions"]
M7 += ["-fno-rtti", "-Wall", "-Wextra", "-Werror", "-I.", f"-I{FIRMWARE}", f"-I{BOARDS}", "-T", str(BOARDS / "m7.ld")]
M7 += ["--specs=rdimon.specs"]
QEMU = ["qemu-system-arm", "-M", "mps2-an500", "-nographic", "-monitor", "none", "-serial", "none"]
QEMU += ["-semihosting-config", "enable=on,target=native", "-kernel"]


def build(folder, *command):
    subprocess.run([*map(str, command)], check=True, cwd=folder)


def exported(folder, limit, *scenario, single=False):
    """Design, prove and export the process of a scenario by the commands, and return its block.

    Without a scenario, the coupling is already in the folder.
    """
    if scenario:
        assert design.main([*scenario, "--out", str(folder / "coupling.json")]) == 0
    words = ["--process", "--without-theta", "--force-limit", str(limit), *["--float"] * single]
    assert export.main([str(folder / "coupling.json"), *words, "--out", str(folder / "coupling-process.c")]) == 0
    stored = load(folder / "coupling.json")
    return process_block(stored, with_theta=False, force_limit=(limit,) * stored.loop.channels)


class Board:
    """A simulated board. Each tick sends it one line and reads its line of answer."""

    def __init__(self, *command, said=subprocess.DEVNULL):
        pipe = subprocess.PIPE
        self.process = subprocess.Popen([*map(str, command)], stdin=pipe, stdout=pipe, stderr=said, text=True)

    def tick(self, *order):
        self.process.stdin.write(" ".join(map(str, order)) + "\n")
        self.process.stdin.flush()
        while (words := self.process.stdout.readline().split())[:1] == ["Loaded"]:
            pass  # simavr prints this line on standard output
        return words

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait(timeout=60)
        self.process.stdout.close()


class Handle:
    """A mass with damping, moved by a force that is held for T: v approaches f/b."""

    def __init__(self, mass, damping, T):
        self.b, self.x, self.v = damping, 0.0, 0.0
        self.decay = np.exp(-damping / mass * T)
        self.lag, self.T = (1 - self.decay) * mass / damping, T

    def push(self, force):
        end = force / self.b
        self.x += end * self.T + (self.v - end) * self.lag
        self.v = end + (self.v - end) * self.decay


# the Hapkit: single precision on eight bits


@pytest.fixture(scope="module")
def hapkit(tmp_path_factory):
    """Return the folder of the sketch, the test vector and the board, and the exported block of springs and a mass."""
    return hapkit_in(tmp_path_factory.mktemp("hapkit"), "--scenario", str(ROOT / "examples/hapkit.toml"))


@pytest.fixture(scope="module")
def walled(tmp_path_factory):
    """Return the same for the safe wall of examples/hapkit_wall.py."""
    folder = tmp_path_factory.mktemp("walled")
    runpy.run_path(str(ROOT / "examples/hapkit_wall.py"))["main"](folder)
    (folder / "wall.json").rename(folder / "coupling.json")
    return hapkit_in(folder)


def hapkit_in(folder, *scenario):
    block = exported(folder, 4.8, *scenario, single=True)
    core = CORE / "cores/arduino"
    plain, plus = [*core.glob("*.c")], [*core.glob("*.cpp")]
    build(folder, "avr-gcc", *AVR, "-w", "-std=gnu11", "-c", *plain)
    build(folder, "avr-gcc", *AVR, "-w", "-x", "assembler-with-cpp", "-c", *core.glob("*.S"))
    build(folder, "avr-g++", *AVR, "-w", "-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-c", *plus)
    parts = [*folder.glob("*.o")]
    cxx = ["avr-g++", *AVR, "-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-Wall", "-Wextra"]
    build(folder, *cxx, "-DMARK(what)=(GPIOR0=(what))", "-x", "c++", "-c", FIRMWARE / "hapkit.ino", "-o", "sketch.o")
    build(folder, "avr-gcc", *AVR, "sketch.o", *parts, "-lm", "-o", "hapkit.elf")
    (folder / "vector.c").write_text(VECTOR)
    build(folder, "avr-gcc", *AVR, "-std=gnu99", "-w", "-DHAPTIC_LOOP_TEST", "vector.c", "-lm", "-o", "vector.elf")
    build(folder, "gcc", "-Wall", "-Wextra", "-Werror", BOARDS / "avr_board.c", "-o", "board", "-lsimavr", "-lm")
    return folder, block


f32 = np.float32
PER_RADIAN = f32(0.09) * f32(0.005) / f32(0.073)
PER_COUNT = PER_RADIAN * f32(3.14159265) / f32(1024)
HOME, DUTY = f32(-0.045), f32(255) * PER_RADIAN / f32(0.03)


def paddle(folder, ticks, hand, motor=1.0, sensor=1.0, held=lambda k: True):
    """Run a session under hand(k) [N].

    `motor` and `sensor` scale the force and the measured motion; held(k) is the state of the switch. Return the counts,
    [cycles of the process, cycles of the tick, PWM, sign] of each tick, and the last (phase, cause) or None.
    """
    handle, counts, told = Handle(0.07, 0.5, 1.25e-3), [], []
    with (folder / "said.txt").open("w") as said, Board(folder / "board", folder / "hapkit.elf", 1, said=said) as board:
        for k in range(ticks):
            seen = 0.045 + sensor * (handle.x - 0.045) if k > 225 else handle.x
            counts.append(300 + round(seen / float(PER_COUNT)))
            millivolts = int((counts[-1] % 1024 + 0.5) * 5000 / 1023)  # the converter rounds down
            key = "h" if k == 5 else "a" if k == 230 else "."
            told.append([int(word) for word in board.tick(millivolts, key, int(held(k)))])
            *_, pwm, negative = told[-1]
            if 5 < k < 220:  # the hand moves the paddle from the stop to the middle
                handle.x = 0.045 * min(1, k / 200)
            handle.push(motor * (-1) ** negative * pwm / 255 * 0.03 / float(PER_RADIAN) + hand(k))
    causes = re.findall(r"^(\d)(\d) ", (folder / "said.txt").read_text(), re.MULTILINE)
    return np.array(counts), np.array(told), causes[-1] if causes else None


def swing(k):
    """Return the hand's force: from tick 700 on a sine of 3 N. In 30 of 250 ticks 2.2 N more make it exceed 4.8 N."""
    return 3 * np.sin(2 * np.pi * 1e-3 * (k - 700)) + 2.2 * (k % 250 < 30) if k > 700 else 0.0


@pytest.mark.parametrize("export", ["hapkit", "walled"])
def test_the_hapkit_repeats_the_test_vector(export, request):
    """The exit code is 10 plus the number of wrong ticks."""
    folder, _ = request.getfixturevalue(export)
    assert subprocess.run([folder / "board", folder / "vector.elf"], check=False).returncode == 10


def test_the_hapkits_forces_are_those_of_python(hapkit, capsys):
    """The steps of the PWM equal those of Python's tick, even while the limiter acts."""
    folder, block = hapkit
    counts, told, state = paddle(folder, 1900, swing)
    start = int(np.argmax(told[:, 0] > 10_000))  # the coupling's first tick takes longer than those of the motor test
    x = PER_COUNT * (counts - counts[5]).astype(f32) + HOME
    f = _sequential(block.system, (x[start:] - x[start])[:, None], block.law, f32)[:, 0]
    gain = np.minimum(np.cumsum(np.full(len(f), f32(1.25e-3) / f32(0.25)), dtype=f32), f32(1))
    force = np.clip(-gain * f, f32(-4.8), f32(4.8))
    duty = np.minimum(np.abs(force) * DUTY + f32(0.5), f32(255)).astype(int)
    assert told[-1, 0] > 10_000, state  # the coupling still runs
    assert duty.max() > 240
    np.testing.assert_array_equal(told[start + 1 :, 2:].T, [duty[:-1], force[:-1] < 0])
    limited = np.abs(f) >= f32(4.79999)
    show(capsys, block, {"linear": told[start:][~limited], "limited": told[start:][limited]})


def show(capsys, block, ticks):
    """Print the cycles of several kinds of ticks, which must fit into T = 1.25 ms."""
    with capsys.disabled():
        print(f"\nATmega328P, 16 MHz, {block.system.order} states in single precision, cycles at most:")
        for name, cycles in ticks.items():
            process, whole = cycles[:, 0].max(), cycles[:, 1].max()
            fits = "fits" if whole < 16_000 else "does not fit, it needs T = 1.25 ms"
            print(f"  {name} tick {process}, with sensor and motor {whole}: 1 ms has 16000, {fits}")
            assert whole < 20_000


def press(k):
    """Return the hand's force: slowly up to 4.9 N, beyond the limit of 4.8 N, and back; then a sine around 0.15 N."""
    if k > 1300:
        return 0.15 + 0.4 * np.sin(2 * np.pi * (k - 1300) / 160)
    return np.interp(k, [700, 1000, 1010, 1300], [0.3, 4.9, 4.9, 0.3]) if k > 700 else 0.0


def test_the_hapkit_touches_a_wall_like_python(walled, capsys):
    """The steps of the PWM equal those of Python's tick, while contacts begin and end and the limiter acts."""
    folder, block = walled
    counts, told, state = paddle(folder, 1900, press)
    steps, matches = told[:, 2] * (1 - 2 * told[:, 3]), []
    free = np.median(told[650:690, 0])
    first = 690 - int(np.argmax(np.abs(told[690:0:-1, 0] - free) > 400))  # the last tick of another kind before 690
    for start in (first, first + 1):
        x = PER_COUNT * (counts[start:] - counts[5]).astype(f32) + HOME
        f = _sequential(block.system, (x - x[0])[:, None], block.law, f32)[690 - start :, 0]
        duty = np.minimum(np.abs(f) * DUTY + f32(0.5), f32(255)).astype(int)
        matches.append((np.abs(steps[691:] + (np.sign(f) * duty)[:-1]).max(), f))
    wrong, f = min(matches, key=lambda match: match[0])
    assert wrong == 0, state
    assert np.sum((f[1:] > 0) & (f[:-1] == 0)) >= 3
    limited = f >= f32(4.79999)
    assert limited.sum() > 10
    kinds = {"free": f == 0, "touching": (f > 0) & ~limited, "touching, limited": limited}
    show(capsys, block, {name: told[690:][which] for name, which in kinds.items()})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, None),
        ({"limit": 4.81}, "clips forces above CAP_MN"),
        ({"theta": (1, 1), "limit": 4.8}, "The Hapkit has one axis"),
        ({"period": 1.2501e-3}, "Timer 1 cannot count this T"),
        ({"period": 0.033}, "a T of at most 4 ms"),
    ],
    ids=str,
)
def test_the_hapkit_sketch_refuses_exports_that_differ(options, words, tmp_path):
    write_export(tmp_path / "coupling-process.c", **{"theta": (1,), "limit": 4.8, "single": True} | options)
    command = ["avr-g++", *AVR, "-std=gnu++11", "-fsyntax-only", "-x", "c++", FIRMWARE / "hapkit.ino"]
    done = subprocess.run([*map(str, command)], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == (words is None), done.stderr
    assert words is None or words in done.stderr


@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ({"motor": -1.0}, "6"),
        ({"sensor": -1.0}, "6"),
        ({"sensor": 0.0}, "7"),
        ({"motor": 0.0}, "7"),
        ({"held": lambda k: k < 1000}, "2"),
        ({"hand": lambda k: 9.0 if 900 < k < 940 else 0.0}, "5"),
    ],
    ids=["reversed-motor", "reversed-sensor", "dead-sensor", "dead-motor", "switch-released", "thrown"],
)
def test_the_hapkit_removes_its_force_at_faults(hapkit, fault, cause):
    _, told, state = paddle(hapkit[0], 1400, **{"hand": swing if "held" in fault else lambda k: 0.0} | fault)
    assert state == ("1", cause)
    assert (told[-190:, 2] == 0).all()


def test_the_example_compiles_for_boards_of_eight_bits(tmp_path):
    """Arduino's core for AVR does not have analogWriteResolution."""
    options = ["-std=gnu++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-x", "c++"]
    build(tmp_path, "avr-g++", *AVR, *options, FIRMWARE / "example.ino")


# the Teensy's processor: double precision


@pytest.fixture(scope="module")
def teensy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("teensy")
    block = exported(folder, 8.0, "--scenario", "omega-pair", "--theta", "1,1")
    board = BOARDS / "m7_board.cpp"
    build(folder, "arm-none-eabi-gcc", *M7, "-DVECTOR", board, "-o", "vector.elf")
    sketch = ["-DSTUB_PERIOD_US=1200", "-x", "c++", board, FIRMWARE / "teensy.ino"]
    build(folder, "arm-none-eabi-gcc", *M7, *sketch, "-o", "teensy.elf")
    return folder, block


def test_the_cortex_m7_repeats_the_test_vector(teensy):
    done = subprocess.run([*QEMU, teensy[0] / "vector.elf"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout
    assert "64 ticks" in done.stdout


def test_the_cortex_m7_limits_vectors(tmp_path):
    """For two devices of three axes, the vector limiter repeats the ticks of Python to the last bit."""
    loop = load_scenario("omega-space").loop("I")
    stiffness, damping = [16000.0] * 3 + [6000.0] * 3, [0.2] * 3 + [2.3] * 3  # gains of a design, rounded
    coupling = SpringDamper(stiffness, damping)
    save(Stored.of(loop, coupling, assess(loop, coupling).force_limits.certificate), tmp_path / "coupling.json")
    process = ["--process", "--force-limit", "3", "--out", str(tmp_path / "coupling-process.c")]
    assert export.main([str(tmp_path / "coupling.json"), *process]) == 0
    text = (tmp_path / "coupling-process.c").read_text()
    assert "vector" in text
    build(tmp_path, "arm-none-eabi-gcc", *M7, "-DVECTOR", BOARDS / "m7_board.cpp", "-lm", "-o", "vector.elf")
    done = subprocess.run([*QEMU, tmp_path / "vector.elf"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout
    assert "64 ticks" in done.stdout


def test_the_teensys_forces_are_those_of_python(teensy):
    folder, block = teensy
    handles = [Handle(0.25, 1.37, 1.2e-3) for _ in range(2)]
    counts, told = [], []
    with Board(*QEMU, folder / "teensy.elf") as board:
        for k in range(1200):
            counts.append([round(handle.x / 10e-6) for handle in handles])
            told.append(board.tick(*counts[-1], "h" if k == 3 else "a" if k == 6 else ".", 1))
            pins = np.array(told[-1][:4], int).reshape(2, 2)
            for handle, (pwm, negative), side in zip(handles, pins, (1, -1), strict=True):
                hand = side * (5 * np.sin(7 * 1.2e-3 * (k - 500)) + 4.0 * (k % 250 < 25)) if k > 500 else 0.0
                handle.push((-1) ** negative * pwm / 4095 * 12 + hand)
    pins = np.array([line[:4] for line in told], int).reshape(-1, 2, 2)
    first = np.flatnonzero(pins[:, 1, 0])[0]  # axis 2 is tested last
    assert told[-1][4:] == ["1", "30"]
    start = next(k for k in range(first, 500) if not pins[k + 1].any() and not pins[k].any()) - 1
    x = 10e-6 * (np.array(counts) - counts[3])
    candidates = []
    for begin in range(start - 2, start + 3):  # the board does not report the coupling's first tick: try five
        f = _sequential(block.system, x[begin:] - x[begin], block.law)
        gain = np.minimum(np.cumsum(np.full(len(f), 1.2e-3 / np.float32(0.25))), 1.0)[:, None]
        steps = np.round(np.clip(-gain * f, -8, 8) / 12 * 4095).astype(int)
        candidates.append(np.abs(pins[begin + 1 :, :, 0] * (1 - 2 * pins[begin + 1 :, :, 1]) - steps[:-1]).max())
    assert min(candidates) == 0
    assert np.abs(pins[:, :, 0]).max() == round(8 / 12 * 4095)
