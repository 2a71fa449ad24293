"""Measure the cost of a frame of the serial protocol and of a device's tick, and check their results.

make bench    (or: python -m pytest tests/benchmarks/test_frame_cost.py --benchmark-only -s)
"""

import random
import time

import pytest

from haptic_loop.hw.device_state import Device
from haptic_loop.hw.protocol import Config, Decoder, Force, Info, State, encode

pytestmark = pytest.mark.benchmark(group="frame", timer=time.process_time)  # CPU time: others may use the machine

COUNT = 2000


def random_states(axes: int) -> list[State]:
    rng = random.Random(1)

    def vector(size: int) -> tuple[int, ...]:
        return tuple(rng.randint(-size, size) for _ in range(axes))

    return [
        State(2, k, k - 1, rng.randint(-300, 1200), 0, 0, rng.getrandbits(32), vector(8000), vector(24_000))
        for k in range(1, COUNT + 1)
    ]


def random_forces(axes: int) -> list[Force]:
    return [Force(2, s.tick, s.echo, s.applied) for s in random_states(axes)]


def report(benchmark, what: str, fact: str) -> None:
    if benchmark.stats:
        cost = benchmark.stats.stats.median / COUNT * 1e6
        print(f"\n{what}: {cost:.1f} us of CPU (median of {COUNT} at a time); {fact}")


@pytest.mark.parametrize("axes", [2, 8])
@pytest.mark.parametrize("sample", [random_states, random_forces], ids=["STATE", "FORCE"])
def test_encode(benchmark, sample, axes):
    messages = sample(axes)
    frames = benchmark(lambda: [encode(m) for m in messages])
    assert Decoder().feed(b"".join(frames)) == messages
    report(benchmark, f"encode {type(messages[0]).__name__}, {axes} axes", f"{COUNT} of {COUNT} come back equal")


@pytest.mark.parametrize("axes", [2, 8])
@pytest.mark.parametrize("sample", [random_states, random_forces], ids=["STATE", "FORCE"])
def test_decode_one_frame_a_call(benchmark, sample, axes):
    messages = sample(axes)
    frames = [encode(m) for m in messages]

    def decode():
        decoder = Decoder()
        return [m for frame in frames for m in decoder.feed(frame)]

    assert benchmark(decode) == messages
    report(benchmark, f"decode {type(messages[0]).__name__}, {axes} axes", f"{COUNT} of {COUNT} equal what was sent")


def test_device_tick(benchmark):
    """Measure the emulator's cost per period: an armed device receives a FORCE, ticks and sends a STATE."""
    info = Info(1, "bench", 1, 1_200_000, (1,) * 2, (1,) * 2, (1,) * 2, (24_000,) * 2, (8000,) * 2)
    device = Device(info)
    device.receive(encode(Config(1, 4, 4, 0, (24_000,) * 2, (48_000,) * 2)), 0)
    device.tick(0, (0, 0))
    device.receive(encode(Force(1, 2, 1, (0, 0))), 0)
    device.tick(0, (0, 0))

    def period():
        frames = [encode(Force(2, (device.k + 1 + i) & 0xFFFF, (device.k + i) & 0xFFFF, (i, -i))) for i in range(COUNT)]
        applied = []
        for frame in frames:
            device.receive(frame, 0)
            applied.append(device.tick(0, (1, -1))[0])
        return applied

    assert benchmark(period) == [(i, -i) for i in range(COUNT)]
    report(benchmark, "device: receive FORCE, tick, STATE (with the host's encode)", "every force at its own tick")
