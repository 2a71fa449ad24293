"""The C state machine of hw/firmware with the interface of hw.device_state.Device, and frames without checks."""

import ctypes
import shutil
import struct
import subprocess
from pathlib import Path
from zlib import crc32

import pytest

from haptic_loop.hw.protocol import Cause, Info, Phase, pack

ROOT = Path(__file__).parent.parent
HEADER, HARNESS = ROOT / "hw/firmware", ROOT / "tests/firmware"
STRICT = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]
GCC = shutil.which("gcc")
needs_gcc = pytest.mark.skipif(GCC is None, reason="gcc is not installed: haptic_link.h is not compiled here")

MAX_OUT = 1024


def build(*arguments: str | Path) -> None:
    done = subprocess.run([str(a) for a in arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def compiled(folder: Path) -> ctypes.CDLL:
    """Compile haptic_link.h with its harness."""
    path = folder / "harness.so"
    build(GCC, "-std=c99", "-O2", *STRICT, "-fPIC", "-shared", f"-I{HEADER}", HARNESS / "harness.c", "-o", path)
    lib = ctypes.CDLL(str(path))
    lib.harness_size.restype = lib.harness_tick.restype = ctypes.c_size_t
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    lib.harness_receive.argtypes = [pointer, ctypes.c_char_p, size, ctypes.c_uint32, pointer]
    return lib


class Firmware:
    """The C firmware with the interface of hw.device_state.Device.

    `applied` are the forces of the motors, which a board sets at ticks and when hl_receive returns true.
    """

    def __init__(self, library, about: Info) -> None:
        self.lib = library
        self.memory = ctypes.create_string_buffer(library.harness_size())
        self.counts, self.force = (ctypes.c_int32 * about.axes)(), (ctypes.c_int16 * about.axes)()
        self.out = ctypes.create_string_buffer(MAX_OUT)
        columns = zip(
            about.osp_damping, about.encoder_step, about.force_step, about.hard_limit, about.range, strict=True
        )
        values = (ctypes.c_uint32 * (5 * about.axes))(*[v for axis in columns for v in axis])
        name = about.firmware.encode()
        self.good = library.harness_init(self.memory, name, about.serial, about.period_ns, about.axes, values)

    def tick(self, now, counts):
        self.counts[:] = counts
        n = self.lib.harness_tick(self.memory, now, self.counts, self.force, self.out)
        return tuple(self.force), self.out.raw[:n]

    def receive(self, data, now):
        """Return how often the board had to set its motors."""
        return self.lib.harness_receive(self.memory, data, len(data), now, self.force)

    def estop(self):
        self.lib.harness_estop(self.memory)

    def fault(self):
        self.lib.harness_fault(self.memory)

    def set_deadman(self, held):
        self.lib.harness_deadman(self.memory, held)

    def set_tick(self, number):
        self.lib.harness_number(self.memory, number)

    def _look(self, index: int) -> int:
        """Return phase, cause, tick or misses."""
        return self.lib.harness_look(self.memory, index)

    deadman, k = property(fset=set_deadman), property(lambda self: self._look(2), set_tick)
    phase, cause = property(lambda self: Phase(self._look(0))), property(lambda self: Cause(self._look(1)))
    misses, applied = property(lambda self: self._look(3)), property(lambda self: tuple(self.force))


def framed(message) -> bytes:
    """Encode a message without the checks of encode()."""
    return enclosed(pack(message))


def enclosed(payload: bytes) -> bytes:
    """Return a frame around any payload."""
    blocks = (payload + struct.pack("<I", crc32(payload))).split(b"\0")
    return b"".join(bytes([len(block) + 1]) + block for block in blocks) + b"\0"
