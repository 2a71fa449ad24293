"""The host limits forces, jumps and gains, refuses nan, and computes the time on the line."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptic_loop.hw.limits import (
    _RAMP_IN,
    _RAMP_OUT,
    DRIVING,
    ENDED,
    Heat,
    SafetyLimits,
    Stage,
    Units,
    _wire_time,
    largest_pulse,
    next_gain,
    probe_delay,
    watchdog_for,
)
from haptic_loop.hw.monitor import CommandMonitor
from haptic_loop.hw.protocol import MAX_RELEASE_NS, PROTOCOL, Config, Force, Info, Phase, SafetyStop, State, encode
from haptic_loop.hw.session import _check_state
from haptic_loop.sim.scenario import load
from tests.causes import expect_stop

LIMITS = SafetyLimits((12.0, 6.0))
T = 1.2e-3
numbers = st.floats(allow_nan=True, allow_infinity=True)
INFO = Info(PROTOCOL, "test", 7, 1_200_000, (1_370_000,) * 2, (10**6,) * 2, (400,) * 2, (30000,) * 2, (10**5,) * 2)


@given(st.tuples(numbers, numbers), st.tuples(numbers, numbers), st.floats(0, 1))
def test_forces_are_finite_and_within_the_cap(asked, previous, gain):
    """Python's max and min turn nan into the cap; `SafetyLimits.shape` never does."""
    before = tuple(
        max(-cap, min(cap, p)) if math.isfinite(p) else 0.0 for p, cap in zip(previous, LIMITS.cap, strict=True)
    )
    if not all(map(math.isfinite, asked)):
        with expect_stop("no force:"):
            LIMITS.shape(asked, before, gain, T)
        return
    shaped = LIMITS.shape(asked, before, gain, T)
    for force, last, cap in zip(shaped.force, before, LIMITS.cap, strict=True):
        assert abs(force) <= cap
        assert abs(force - last) <= LIMITS.slew * T * (1 + 1e-12)  # one rounding of last +- step


@given(st.tuples(*[numbers] * 5), st.tuples(*[st.floats(-4, 4)] * 5), st.floats(0, 1))
def test_vectors_keep_within_their_cap_and_slew(asked, previous, gain):
    """Channel 1 has a limit of its force; channels 2 and 3 form a vector with a limit of its length, as do 4 and 5."""
    limits = SafetyLimits((2.0, 6.0, 6.0, 3.0, 3.0), vectors=((1, 3), (3, 5)))
    if not all(map(math.isfinite, asked)):
        return
    before = [min(2.0, max(-2.0, previous[0]))]
    for (first, end), cap in zip(limits.vectors, (6.0, 3.0), strict=True):
        length = math.hypot(*previous[first:end])
        before += [p * min(1.0, cap / length) if length else p for p in previous[first:end]]
    force = limits.shape(asked, before, gain, T).force
    assert all(abs(now - last) <= limits.slew * T * (1 + 1e-12) for now, last in zip(force, before, strict=True))
    assert math.hypot(*force[1:3]) <= 6.0 * (1 + 1e-12)
    assert math.hypot(*force[3:5]) <= 3.0 * (1 + 1e-12)
    units = Units((1e-6,) * 5, (4e-4,) * 5, (10**5,) * 5)
    sent = units.forces(units.steps(force, (5000, 15000, 15000, 7500, 7500), limits.vectors))
    assert math.hypot(*sent[1:3]) <= 6.0 * (1 + 1e-12)
    assert math.hypot(*sent[3:5]) <= 3.0 * (1 + 1e-12)


def test_a_vector_keeps_its_direction_at_its_cap():
    limits = SafetyLimits((5.0,) * 3, vectors=((0, 3),))
    shaped = limits.shape((6.0, -12.0, 12.0), (0.0,) * 3, 1.0, 1.0)
    assert shaped.force == pytest.approx((5 / 3, -10 / 3, 10 / 3))
    assert (shaped.clipped, shaped.slowed) == (True, False)
    forces = np.array([[3.0, 4.0, 0.0], [3.0, 0.0, 3.9]])
    assert limits.capped(forces).tolist() == [[True] * 3, [False] * 3]


def test_forces_of_nan_are_refused_before_clipping():
    assert max(-12.0, min(12.0, math.nan)) == 12.0
    with expect_stop("no force: nan 0$"):
        LIMITS.shape((math.nan, 0.0), (0.0, 0.0), 0.0, T)


def test_a_force_within_the_limits_is_left_alone():
    shaped = LIMITS.shape((1.0, -2.0), (0.5, -1.0), 1.0, T)
    assert shaped.force == (1.0, -2.0)
    assert (shaped.clipped, shaped.slowed) == (False, False)


@pytest.mark.parametrize("gain", [math.nan, -0.01, 1.01])
def test_an_impossible_gain_is_a_fault(gain):
    with pytest.raises(SafetyStop, match="the gain is"):
        LIMITS.shape((1.0, 1.0), (0.0, 0.0), gain, T)


@pytest.mark.parametrize(
    ("field", "least", "most"),
    [
        ("slew", 1.0, 2000.0),
        ("jump", 1e-6, 3e-3),
        ("watchdog_us", 1000, 20_000),
        ("speed", 1e-3, 2.5),
        ("thermal", 0.1, 1000.0),
        ("cap", (1e-3,), (12.0,)),
        ("continuous", (1e-3,), (12.0,)),
    ],
)
def test_limits_stay_within_their_ranges(field, least, most):
    """Both ends of a limit's range are allowed, and nothing beyond."""

    def limits(value):
        return SafetyLimits(**{"cap": (6.0,)} | {field: value})

    def times(factor, value):
        return tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value

    assert (getattr(limits(least), field), getattr(limits(most), field)) == (least, most)
    for value in (times(0.99, least), times(1.01, most), times(math.nan, most)):
        with pytest.raises(ValueError, match=field):
            limits(value)


def test_configs_carry_the_limits_in_device_units():
    """CONFIG gives a ramp-in of 0.25 s and a slew rate of 2000 N/s in ticks of 1.2 ms and steps of 0.4 mN."""
    config = SafetyLimits((12.0, 3.0)).configuration(INFO, 2)
    assert (config.theta, config.hold, config.ramp, config.ramp_in) == (2, 4, 5, 209)
    assert (config.cap, config.slew) == ((30_000, 7500), (6000, 6000))
    slow = SafetyLimits((12.0, 3.0)).configuration(INFO._replace(period_ns=10_000_000), 0)
    assert (slow.hold, slow.ramp, slow.ramp_in) == (1, 1, 25)  # at most 20 ms from the last answer to zero


def test_caps_above_twelve_newtons_are_refused():
    with pytest.raises(ValueError, match=r"cap #2 is 13"):
        SafetyLimits((12.0, 13.0))


@pytest.mark.parametrize(("moved", "ticks", "fault"), [(2.9e-3, 1, False), (3.1e-3, 1, True), (5.9e-3, 2, False)])
def test_jumps_are_measured_per_tick(moved, ticks, fault):
    if fault:
        with expect_stop(r"jump: 2 3\.1 3 1$"):
            LIMITS.check_jump((0.0, moved), (0.0, 0.0), ticks)
    else:
        LIMITS.check_jump((0.0, moved), (0.0, 0.0), ticks)


@pytest.mark.parametrize("x", [math.nan, math.inf])
def test_a_displacement_that_is_no_number_never_passes(x):
    with pytest.raises(SafetyStop):
        LIMITS.check_jump((x,), (0.0,), 1)
    with pytest.raises(SafetyStop):
        LIMITS.check_speed((x,), (0.0,), 1)


def test_values_at_a_limit_are_allowed():
    LIMITS.check_speed((0.7e-3, 0.0), (0.0, 0.0), 1e-3)
    LIMITS.check_jump((3e-3, 0.0), (0.0, 0.0), 1)
    Units.of(INFO).check_range((10**5, -(10**5)))
    assert LIMITS.shape((12.0, 0.0), (12.0, 0.0), 1.0, T).clipped  # a coupling's limiter sends the cap itself


def test_the_gain_stays_between_zero_and_one():
    assert next_gain(0.5, 10.0) == next_gain(1.0, T) == 1.0
    assert next_gain(0.5, -10.0) == next_gain(0.0, -T) == 0.0


def test_the_gain_rises_and_falls_in_its_ramps():
    gain, ticks = 0.0, 0
    while gain < 1:
        gain, ticks = next_gain(gain, T), ticks + 1
    assert ticks == math.ceil(_RAMP_IN / T)
    while gain > 0:
        gain, ticks = next_gain(gain, -T), ticks - 1
    assert ticks == math.ceil(_RAMP_IN / T) - math.ceil(_RAMP_OUT / T)


def test_no_stage_is_both_an_end_and_driving():
    assert not ENDED & DRIVING
    assert Stage.DISARMED not in ENDED | DRIVING


@pytest.mark.parametrize(
    ("baud", "microseconds"), [(921_600, 520.8), (2_000_000, 240.0), (115_200, 4166.7)]
)  # docs/protocol.md has 521 us
def test_wire_time_is_that_of_the_frames(baud, microseconds):
    seconds, text = _wire_time(baud, 2)
    assert 1e6 * seconds == pytest.approx(microseconds, abs=0.1)
    state = State(0, 0, 0, 0, 0, 0, 0, (0, 0), (0, 0))
    bits = 10 * (len(encode(state)) + len(encode(Force(0, 0, 0, (0, 0)))))  # what really goes over the wire
    assert seconds == bits / baud
    assert f"{microseconds:.0f} us" in text


def test_115200_baud_is_refused_with_the_arithmetic():
    reasons = SafetyLimits((12.0, 12.0)).objections(INFO, load(), 115_200)
    assert reasons == [
        "one STATE and one FORCE take (32 + 16) bytes x 10 bits / 115200 baud = 4167 us, more than T = 1200 us "
        "(for a link without UART, give --baud none)"
    ]


def test_a_device_that_fits_meets_no_objection():
    assert SafetyLimits((12.0, 12.0)).objections(INFO, load(), 921_600) == []


def test_every_objection_is_named():
    poor = INFO._replace(period_ns=10**6, osp_damping=(1_370_000, 10**6), hard_limit=(15000, 30000))
    reasons = SafetyLimits((12.0, 12.0)).objections(poor, load(), 115_200)
    assert len(reasons) == 4
    for reason, word in zip(reasons, ("1000000 ns", "baud", "axis 1 can apply 6", "axis 2 guarantees 1"), strict=True):
        assert word in reason


@given(st.integers(100_000, 20_000_000))
def test_the_configuration_never_exceeds_the_protocol(period_ns):
    config = LIMITS.configuration(INFO._replace(period_ns=period_ns), 1)
    encode(config)  # raises where a field cannot travel
    assert config.cap == (30000, 15000)  # 12 N and 6 N in steps of 0.4 mN
    assert (config.hold + config.ramp) * period_ns <= MAX_RELEASE_NS


def test_devices_receive_the_negative_force_in_steps():
    """The device gets -f, in whole steps, and never more than the cap."""
    units = Units.of(INFO)
    assert units.steps((1.0, -2.0), (30000, 30000)) == (-2500, 5000)
    assert units.steps((100.0, -100.0), (30000, 15000)) == (-30000, 15000)
    assert units.forces((-2500, 5000)) == pytest.approx((1.0, -2.0))
    assert units.positions((1000, -1)) == pytest.approx((1e-3, -1e-6))


def test_the_probe_uses_the_longest_measurable_delay():
    assert probe_delay(1.2e-3) == 15
    assert probe_delay(5e-3) == 6
    assert probe_delay(0.03) == 1
    with pytest.raises(ValueError, match=r"T is 0\.05 s"):
        probe_delay(0.05)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"encoder_step": (0, 1_000_000)}, "impossible value, Info.encoder_step #1: 0; 1 to 4294967295"),
        ({"force_step": (400, 0)}, "Info.force_step #2: 0"),
        ({"hard_limit": (65535, 30000)}, "Info.hard_limit #1: 65535; 1 to 32767"),
        ({"range": (-100, 100_000)}, "Info.range #1: -100"),
        ({"force_step": (11_999_999, 400)}, "one force step of axis 1 is 12 N, at most 0.75 N is allowed"),
        (
            {"encoder_step": (1_000_000, 400_000_000)},
            "one encoder count of axis 2 is 0.4 mm, at most 0.3 mm",
        ),
    ],
)
def test_a_device_too_coarse_or_impossible_is_refused(change, reason):
    assert any(reason in one for one in SafetyLimits((12.0, 12.0)).objections(INFO._replace(**change), load(), None))


def test_force_steps_obey_the_slew_limit():
    """A step that exceeds the slew limit in a tick is refused: no change of force could be smaller."""
    slow = SafetyLimits((12.0, 12.0), slew=100.0)  # 0.12 N in a tick
    assert slow.objections(INFO._replace(force_step=(100_000, 100_000), hard_limit=(120, 120)), load(), None) == []
    (reason,) = slow.objections(INFO._replace(force_step=(130_000, 100_000), hard_limit=(120, 120)), load(), None)
    assert "0.13 N, at most 0.12 N" in reason


def test_counting_errors_are_no_motion():
    """A mass can start, stop or bounce within a tick, but not start and stop within two."""
    jump, most = 1.1e-3, (1e-3,)
    for path, gaps in (
        ((0, jump, 2 * jump, 3 * jump), (1, 1, 1)),
        ((0, jump, jump, jump), (1, 1, 1)),
        ((jump, 0, jump, 2 * jump), (1, 1, 1)),
        ((0, 0, 0.9e-3, 0.9e-3), (1, 1, 1)),
        ((0, jump, 3 * jump, 4 * jump), (1, 2, 1)),
        ((0, 0.9e-3, 0.9e-3, 0.9e-3), (2, 1, 1)),
    ):
        LIMITS.check_jolt([(x,) for x in path], gaps, most)
    for path, gaps in (
        ((0, 0, jump, jump), (1, 1, 1)),
        ((jump, 0, 0, -jump), (1, 1, 1)),
        ((0, jump, 0, jump), (1, 1, 1)),
        ((0, jump, 3 * jump, 4 * jump), (1, 1, 1)),
        ((0, 0, jump, jump), (1, 2, 1)),
        ((0, jump, 4 * jump, 5 * jump), (1, 2, 1)),
        ((0, 0, jump, jump), (3, 1, 2)),
    ):
        for sign in (1, -1):
            with expect_stop(r"jolt: 1 \S+ 1$" if gaps[1] == 1 else r"jolt: 1 \S+ 1 2$"):
                LIMITS.check_jolt([(sign * x,) for x in path], gaps, most)
    with expect_stop(r"jolt: 2 1\.1 "):
        LIMITS.check_jolt([(0.0, x) for x in (0, 0, jump, jump)], (1, 1, 1), most * 2)


@pytest.mark.parametrize("gaps", [(1, 1, 1), (1, 2, 1), (2, 1, 1), (1, 1, 3), (3, 2, 1), (5, 1, 4), (2, 5, 2)])
def test_pulses_of_real_motions_stay_below_limits(gaps):
    """Swings of any phase, and a force that reverses at any time, are sampled at four instants."""
    instants = T * np.array([0, gaps[0], gaps[0] + gaps[1], sum(gaps)])

    def largest(motions):
        (v1, v2, v3), q = np.diff(motions, axis=-1).T / np.reshape(gaps, (3, 1)), gaps[1]
        gained, lost = v2 - v1, v3 - v2
        return float((q * np.minimum(abs(gained), abs(lost)))[gained * lost < 0].max())

    speed, phases = 0.7, np.linspace(0, 2 * np.pi, 721)[:, None]
    for w in (300.0, 800.0, 1500.0):
        limit = largest_pulse(gaps, T, 0.0, w, speed)
        assert largest(speed / w * np.sin(w * instants + phases)) <= limit * (1 + 1e-9)
    assert largest_pulse((1, 1, 1), T, 0.0, 800.0, speed) == pytest.approx(
        4 * speed / 800 * math.sin(0.4 * T * 1e3) ** 3
    )
    push, times = 20 / 0.25, np.linspace(instants[0], instants[-1], 481)[:, None]  # [m/s^2]
    reversed_force = push * (instants**2 / 2 - np.maximum(instants - times, 0) ** 2)
    limit = largest_pulse(gaps, T, push * T**2, math.inf, speed)
    assert 0.3 * limit < largest(reversed_force) <= limit * (1 + 1e-9)


# every check, on every channel and for both signs


MIRRORED = [(channel, sign) for channel in (0, 1) for sign in (1, -1)]


def on(channel, value, rest=0.0):
    return tuple(value if i == channel else rest for i in (0, 1))


@pytest.mark.parametrize(("channel", "sign"), MIRRORED)
def test_motion_checks_cover_channels_and_signs(channel, sign):
    for cause, inside, outside, check in (
        (f"jump: {channel + 1} ", 2.9e-3, 3.1e-3, lambda x: LIMITS.check_jump(x, (0.0, 0.0), 1)),
        (f"range: {channel + 1} ", 10**5, 10**5 + 1, lambda n: Units.of(INFO).check_range(n)),
        (f"speed: {channel + 1} ", 6.9e-3, 7.1e-3, lambda x: LIMITS.check_speed(x, (0.0, 0.0), 0.01)),
        (f"speed: {channel + 1} ", 6.9e-3, 7.1e-3, lambda x: LIMITS.check_speed((0.0, 0.0), x, 0.01)),
    ):
        check(on(channel, sign * inside))
        with expect_stop(cause):
            check(on(channel, sign * outside))


@pytest.mark.parametrize(("channel", "sign"), MIRRORED)
def test_cap_and_slew_cover_channels_and_signs(channel, sign):
    cap, step = LIMITS.cap[channel], LIMITS.slew * T
    for asked, last, sent, clipped, slowed in (
        (cap - 0.1, cap - 0.2, cap - 0.1, False, False),
        (cap + 0.1, cap - 0.2, cap, True, False),
        (3.0, 0.0, step, False, True),
        (-3.0, 0.0, -step, False, True),
        (cap + 0.1, 0.0, step, True, True),
    ):
        shaped = LIMITS.shape(on(channel, sign * asked), on(channel, sign * last), 1.0, T)
        assert shaped.force == on(channel, sign * sent)
        assert (shaped.clipped, shaped.slowed) == (clipped, slowed)
    half = LIMITS.shape(on(channel, sign * 2.0), (0.0, 0.0), 0.5, T, on(channel, sign * 0.25))
    assert half.force == on(channel, sign * 1.25)  # the gain scales the controller's force, not the encoder test's


@pytest.mark.parametrize("channel", [0, 1])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_invalid_forces_are_found_on_both_channels(channel, value):
    with expect_stop("no force:"):
        LIMITS.shape(on(channel, value), (0.0, 0.0), 0.0, T)
    with expect_stop("no force:"):
        LIMITS.shape((0.0, 0.0), (0.0, 0.0), 0.0, T, on(channel, math.nan))


@pytest.mark.parametrize(("channel", "sign"), MIRRORED)
def test_motor_heat_grows_with_squared_force(channel, sign):
    """At twice its continuous force a motor is hot after tau ln(4/3), at 0.99 times its continuous force never.

    Missed ticks heat the motor, too.
    """
    limits = SafetyLimits((12.0, 12.0), continuous=(2.0, 2.0), thermal=5.0)
    heat, ticks = Heat(limits, T), 0
    for _ in range(20_000):
        heat.check(on(channel, sign * 1.98), 1)

    def push(heat):
        nonlocal ticks
        for _ in range(20_000):
            heat.check(on(channel, sign * 4.0), 1)
            ticks += 1

    with expect_stop(f"heat: {channel + 1} 2 2$"):
        push(Heat(limits, T))
    assert ticks * T == pytest.approx(5.0 * math.log(4 / 3), abs=2 * T)
    at_once = Heat(limits, T)
    at_once.check(on(channel, sign * 3.0), 500)  # 500 ticks at once
    one_by_one = Heat(limits, T)
    for _ in range(500):
        one_by_one.check(on(channel, sign * 3.0), 1)
    assert at_once._squares == pytest.approx(one_by_one._squares, rel=1e-9)


@pytest.mark.parametrize(("channel", "sign"), MIRRORED)
def test_device_reports_are_checked_on_all_channels(channel, sign):
    config = Config(1, 4, 5, 0, (20000, 15000), (600, 600))

    def said(tick, steps, phase=Phase.ARMED):
        return State(phase, tick, 0, 100, 0, 0, 0, (0, 0), on(channel, sign * steps, 0))

    cap = config.cap[channel]
    _check_state(said(0, cap), config, Stage.ARMED, 1.0)
    with expect_stop("force above the cap:"):
        _check_state(said(0, cap + 1), config, Stage.ARMED, 1.0)
    with expect_stop("force without arming:"):
        _check_state(said(0, 1, Phase.DISARMED), config, Stage.DISARMED, 0.0)
    for told, applied, wrong in ((500, 500, False), (500, 501, False), (500, 502, True), (500, 498, True)):
        monitor = CommandMonitor(config)
        monitor.unlike(said(0, 0), 1)
        monitor.tell(0, on(channel, sign * told, 0))
        assert monitor.unlike(said(1, applied), 1) == wrong
    holding = CommandMonitor(config)
    holding.unlike(said(0, 300), 1)
    assert holding.unlike(said(1, 299, Phase.HOLDING), 1)
    assert not holding.unlike(said(2, 299, Phase.HOLDING), 1)


@pytest.mark.parametrize(("T", "watchdog"), [(3e-4, 6000), (1.2e-3, 6000), (3e-3, 15_000), (4e-3, 20_000)])
def test_the_watchdog_lasts_five_ticks_or_6_ms(T, watchdog):
    assert watchdog_for(T) == watchdog


def test_too_long_watchdog_periods_are_refused():
    with pytest.raises(ValueError, match=r"at most 0\.004 s"):
        watchdog_for(4.1e-3)


def test_force_steps_are_judged_by_the_cap():
    """Eight bits of PWM for 12 N are fine for a cap of 2 N, too coarse for 0.5 N; twelve bits are fine for both."""
    eight = INFO._replace(force_step=(47_059,) * 2, hard_limit=(255,) * 2)
    twelve = INFO._replace(force_step=(2930,) * 2, hard_limit=(4095,) * 2)
    assert SafetyLimits((2.0, 2.0)).objections(eight, load(), None) == []
    coarse = SafetyLimits((0.5, 0.5)).objections(eight, load(), None)
    assert all(number in coarse[0] for number in ("axis 1", "0.047059 N", "0.03125 N"))
    assert SafetyLimits((0.5, 0.5)).objections(twelve, load(), None) == []
