"""With varying delays the device applies the newest packet, and patterns draw delays within their ranges."""

import numpy as np
import pytest
from shared import FIGURE_4, force_map

from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.controller.delay import LOST, HeldLine, VaryingDelay, _newest, ages, realising
from haptic_loop.controller.environment import environment
from haptic_loop.controller.law import Law
from haptic_loop.controller.tick import Process, StepBuffer

T = 1.2e-3
COUPLING = SpringDamper([7806, 3137], [0.105, 1.68])
IDEAL = np.zeros(2)
NO_LIMIT = np.full(2, np.inf)


def column(*delays):
    return np.array(delays)[:, None, None]


def carried(delays, forces):
    """Return the forces that the device applies, for one channel and one simulation."""
    line, applied = HeldLine(delays, 1), []
    for k, g in enumerate(forces):
        force = np.array([[float(g)]])
        line.carry(k, force)
        applied.append(force[0, 0])
    return applied


def test_devices_hold_the_newest_packet_that_arrived():
    """The device applies the newest packet that has arrived.

    k          0    1    2    3    4     5    6
    force      10   11   12   13   14    15   16
    delay      1    3    1    2    lost  1    0
    arrives    1    4    3    5    -     6    6
    in use     -    0    0    2    2     3    6     (packet 1 comes after packet 2 and is never used)
    age        -    1    2    1    2     2    0
    """
    delays = column(1, 3, 1, 2, LOST, 1, 0)
    assert _newest(delays).ravel().tolist() == [-1, 0, 0, 2, 2, 3, 6]
    assert ages(delays).ravel().tolist() == [-1, 1, 2, 1, 2, 2, 0]
    assert carried(delays, range(10, 17)) == [0, 10, 10, 12, 12, 13, 16]


def test_when_every_packet_is_lost_the_force_stays():
    delays = column(0, 0, *[LOST] * 8)
    assert carried(delays, range(5, 15)) == [5, 6, *[6] * 8]
    assert carried(column(*[LOST] * 4), range(1, 5)) == [0, 0, 0, 0]


def test_a_constant_delay_equals_the_linear_block():
    """A delay line behind G equals Theta G with delays (1, 2), up to rounding of sums in another order."""
    E, x = environment(FIGURE_4, T), np.random.default_rng(1).normal(size=(200, 2, 1))
    G, F = (force_map(E, COUPLING, theta, (0, 0)) for theta in ((0, 0), (1, 2)))
    constant = np.tile(np.array([1, 2])[None, :, None], (200, 1, 1))
    forces = []
    for process in (Process(Law(G), NO_LIMIT, IDEAL, delays=constant), Process(Law(F), NO_LIMIT, IDEAL)):
        buffer = StepBuffer(process, 50, 2)
        for first in range(0, 200, 50):  # the line continues in the next block
            for k in range(50):
                buffer.x[k] = x[first + k]
                buffer.tick(k)
            forces.append(buffer.f[:50].copy())
            buffer.rewind(50)
    np.testing.assert_allclose(np.concatenate(forces[:4]), np.concatenate(forces[4:]), rtol=1e-12, atol=1e-12)


def test_ages_stay_in_range_and_grow_by_one():
    varying_delay = VaryingDelay((1, 0), (4, 3))
    delays = varying_delay.draw(np.random.default_rng(2), 5000)
    age = ages(delays[:, :, None])[10:, :, 0]
    assert age.min(axis=0).tolist() == [1, 0]
    assert age.max(axis=0).tolist() == [4, 3]
    assert np.diff(age, axis=0).max() == 1


def test_every_allowed_age_sequence_has_delays():
    rng = np.random.default_rng(3)
    wanted = np.full((400, 2), 3)
    for k in range(1, 400):
        wanted[k] = rng.integers(1, np.minimum(wanted[k - 1] + 1, 4), endpoint=True)
    delays = realising(wanted)
    assert delays.min() >= 1
    assert delays.max() <= 4
    np.testing.assert_array_equal(ages(delays[:, :, None])[4:, :, 0], wanted[4:])
    with pytest.raises(ValueError, match="does not return to an older force"):
        realising(np.array([[1], [3]]))


def test_each_pattern_draws_the_delays_it_names():
    rng, ticks = np.random.default_rng(4), 40_000
    assert (VaryingDelay((1,), (3,), "constant").draw(rng, 9, [[2]]) == 2).all()
    counts = np.bincount(VaryingDelay((1,), (3,)).draw(rng, ticks).ravel())
    # four standard deviations of a binomial count
    np.testing.assert_allclose(counts[1:], ticks / 3, rtol=0, atol=4 * np.sqrt(ticks * 2 / 9))
    bursty = VaryingDelay((1,), (2,), "bursty", calm=20, burst=5).draw(rng, ticks).ravel()
    starts = int((np.diff(bursty) == 1).sum())
    # Four standard deviations of the number of bursts are 8 % of it; those of the share of ticks in bursts are 11 %.
    assert starts == pytest.approx(ticks / 25, rel=0.1)
    assert (bursty == 2).mean() == pytest.approx(0.2, rel=0.15)
    recorded = VaryingDelay((0,), (2,), "recorded", recorded=((0,), (2,), (LOST,)))
    assert recorded.draw(rng, 5).ravel().tolist() == [0, 2, LOST, 0, 2]


def test_playout_delays_all_packets_to_the_largest():
    varying_delay = VaryingDelay((1,), (3,), loss=0.25, playout=True)
    delays = varying_delay.draw(np.random.default_rng(5), 10_000)
    assert set(np.unique(delays)) == {LOST, 3}
    assert (delays == LOST).mean() == pytest.approx(0.25, abs=4 * np.sqrt(0.25 * 0.75 / 10_000))  # 4 deviations
    assert not varying_delay.steady
    assert VaryingDelay((1,), (3,), playout=True).steady
    assert (VaryingDelay((1,), (2,), loss=1.0).draw(np.random.default_rng(5), 50) == LOST).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"lo": (1,), "hi": (2, 2)}, "one each per channel"),
        ({"lo": (3,), "hi": (2,)}, "channel 1 is 3 to 2"),
        ({"lo": (1.2,), "hi": (2.9,)}, "channel 1 is 1.2 to 2.9, expected whole numbers"),
        ({"lo": (1,), "hi": (2,), "loss": 1.5}, "varying_delay.loss is 1.5"),
        ({"lo": (1,), "hi": (2,), "burst": 0}, "varying_delay.burst is 0"),
        ({"lo": (1,), "hi": (2,), "pattern": "recorded"}, "go together"),
        ({"lo": (1,), "hi": (2,), "pattern": "recorded", "recorded": ((3,),)}, "packet 0, channel 1: delay 3"),
        ({"lo": (1,), "hi": (2,), "pattern": "recorded", "recorded": ((1.7,),)}, "channel 1: delay 1.7, allowed"),
        ({"lo": (1,), "hi": (2,), "pattern": "recorded", "recorded": ((1, 1),)}, "2 delays for 1 channels"),
    ],
)
def test_impossible_ranges_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        VaryingDelay(**fields)


@pytest.mark.parametrize("pattern", ["constant", "adversarial"])
def test_patterns_of_the_loop_need_its_delays(pattern):
    with pytest.raises(ValueError, match="pass them as `given`"):
        VaryingDelay((1,), (2,), pattern).draw(np.random.default_rng(0), 10)
