"""Devices with several axes: matrix levels Delta_i in the loop, its conditions, proofs, designs and limiter."""

from fractions import Fraction

import msgspec
import numpy as np
import pytest

from haptic_loop.controller.environment import Network, Spring
from haptic_loop.controller.loop import DelayRange, Loop

LEVELS = ((1.5, 0.4), (0.4, 0.9)), ((1.2, -0.3), (-0.3, 2.0))
TIPS = ("a.x", "a.y", "b.x", "b.y")
PAIR = Loop(
    1e-3,
    theta=(1, 1, 2, 2),
    psi=(0,) * 4,
    lam=(0,) * 4,
    delta=(1.5, 0.9, 1.2, 2.0),
    environment=Network(TIPS, (Spring(("a.x", "b.x"), 300.0), Spring(("a.y", "b.y"), 200.0))),
    axes=(2, 2),
    levels=LEVELS,
)


def _with(**fields: object) -> Loop:
    return msgspec.structs.replace(PAIR, **fields)


def test_levels_stand_in_blocks_of_devices() -> None:
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2:, 2:] = LEVELS
    assert (PAIR.Delta() == expected).all()
    assert PAIR.Delta(exact=True)[0, 1] == Fraction(2, 5)
    assert PAIR.devices == (slice(0, 2), slice(2, 4))
    assert msgspec.json.decode(msgspec.json.encode(PAIR), type=Loop) == PAIR


def test_one_axis_each_is_the_default() -> None:
    single = _with(axes=(1, 1, 1, 1), levels=tuple(((d,),) for d in PAIR.delta))
    assert single.axes is None
    assert single.levels is None
    plain = _with(axes=None, levels=None)
    assert msgspec.json.encode(single) == msgspec.json.encode(plain)
    assert b"axes" not in msgspec.json.encode(plain)
    assert b"levels" not in msgspec.json.encode(plain)
    assert (plain.Delta() == np.diag(PAIR.delta)).all()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"axes": ()}, ["axes", "[]", "4"]),
        ({"axes": (2, 1)}, ["axes", "[2, 1]", "4"]),
        ({"axes": (4, 0)}, ["axes", "[4, 0]", ">= 1"]),
        ({"theta": (1, 2, 2, 2)}, ["theta", "[1, 2, 2, 2]", "all axes of a device"]),
        ({"psi": (0, 0, 0, 1)}, ["psi", "[0, 0, 0, 1]", "all axes of a device"]),
        ({"latency": ((0.0, 1e-4), (0.0, 2e-4)) * 2}, ["latency", "all axes of a device"]),
        ({"varying_delay": DelayRange((1, 0, 2, 2), (1, 1, 2, 2))}, ["varying_delay", "all axes of a device"]),
        ({"levels": LEVELS[:1]}, ["levels", "1 matrices", "2 devices"]),
        ({"levels": (((1.5,),), LEVELS[1])}, ["level #1", "[[1.5]]", "2 x 2"]),
        ({"levels": (LEVELS[0], ((1.2, -0.3), (0.3, 2.0)))}, ["level #2", "[0.3, 2.0]", "symmetric"]),
        ({"levels": (LEVELS[0], ((1.2, 2.0), (2.0, 2.0)))}, ["level #2", "[2.0, 2.0]", "positive definite"]),
        ({"delta": (1.0, 0.9, 1.2, 2.0)}, ["level #1", "delta = [1.0, 0.9]", "diagonal"]),
    ],
)
def test_impossible_axes_are_refused(fields: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ValueError, match=words[0]) as refused:
        _with(**fields)
    assert all(word in str(refused.value) for word in words)
    assert "\n" not in str(refused.value)
