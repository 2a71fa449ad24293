"""The device follows docs/protocol.md: when forces act, what stops them, and what cannot start them again.

The tests run on hw/device_state.py and on the compiled haptic_link.h.
"""

from collections.abc import Callable
from typing import Any

import pytest

from haptic_loop.hw.protocol import (
    NO_MARGIN,
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
    config_crc,
    pack,
)
from tests.compiled_device import enclosed, framed

T = 1200  # [us]
INFO = Info(2, "test", 7, 1_200_000, (1_370_000,) * 2, (10_000_000,) * 2, (500,) * 2, (24_000, 20_000), (8_000,) * 2)
CONFIG = Config(1, 4, 4, 0, (24_000, 20_000), (48_000,) * 2)


@pytest.fixture(autouse=True)
def _both_machines(machine, monkeypatch):
    monkeypatch.setattr(Rig, "machine", staticmethod(machine), raising=False)


class Rig:
    """A device in Python or C, and a host that sends only what a test tells it to send."""

    machine: Callable[[Info], Any]

    def __init__(self, config: Config | None = CONFIG, first_tick: int = 0, info: Info = INFO, now: int = 0) -> None:
        self.device, self.decoder, self.now = self.machine(info), Decoder(), now
        self.device.k = first_tick
        if config:
            self.say(config)
            assert [type(m) for m in self.tick()] == [Ack, State]
        self.config = config

    def say(self, *messages, after: int = 300) -> None:
        for message in messages:
            self.device.receive(framed(message), self.now + after)

    def answer(self, force=(0, 0), command=Command.RUN, back: int = 0, after: int = 300) -> None:
        """Send the FORCE that answers the STATE of `back` ticks ago."""
        source = (self.device.k - back) & 0xFFFF
        self.say(Force(command, (source + self.config.theta) & 0xFFFF, source, force), after=after)

    def tick(self, counts=(70_005, -6)) -> list:
        self.now += T
        self.forces, sent = self.device.tick(self.now, counts)
        self.said = self.decoder.feed(sent)
        if self.said and isinstance(self.said[-1], State):
            self.state = self.said[-1]
            assert self.state.applied == self.forces
            assert (self.state.phase, self.state.cause) == self.at
        return self.said

    def arm(self) -> None:
        for _ in range(self.config.due):
            self.answer(command=Command.ARM)
            self.tick()
        assert self.device.phase == Phase.ARMED

    @property
    def at(self) -> tuple[Phase, Cause]:
        return self.device.phase, self.device.cause


def armed(**changes) -> Rig:
    rig = Rig(CONFIG._replace(**changes))
    rig.arm()
    return rig


# ---- before it runs --------------------------------------------------------------------------------------------------


def test_unconfigured_devices_answer_hello_and_config_only():
    rig = Rig(config=None)
    assert [rig.tick() for _ in range(5)] == [[]] * 5
    rig.say(Hello())
    assert rig.tick() == [INFO]
    assert rig.tick() == []
    rig.say(CONFIG)
    ack, state = rig.tick()
    assert ack == Ack(config_crc(CONFIG), Refused.ACCEPTED)
    assert (state.phase, state.tick, state.t_us, state.counts) == (Phase.DISARMED, 8, 8 * T, (70_005, -6))


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        (Config(1, 4, 4, 0, (1,), (1,)), Refused.AXES),
        (Config(1, 4, 4, 0, (1, 1, 1), (1, 1, 1)), Refused.AXES),
        (CONFIG._replace(theta=16), Refused.THETA),
        (CONFIG._replace(ramp=0), Refused.RELEASE),
        (CONFIG._replace(hold=4, ramp=13), Refused.RELEASE),  # 17 ticks of 1.2 ms are 20.4 ms, above 20 ms
        (CONFIG._replace(cap=(24_001, 1)), Refused.CAP),
        (CONFIG._replace(cap=(1, 20_001)), Refused.CAP),
        (CONFIG._replace(cap=(1, 0)), Refused.CAP),
        (CONFIG._replace(cap=(1, 0), slew=(0, 1)), Refused.CAP),  # CAP, which is 6, comes before SLEW
        (CONFIG._replace(slew=(1, 0)), Refused.SLEW),
    ],
)
def test_unsuitable_configs_are_refused(config, reason):
    rig = Rig(config=None)
    rig.say(config)
    assert rig.tick() == [Ack(config_crc(config), reason)]
    assert rig.device.phase == Phase.SILENT
    rig.say(Config(15, 4, 12, 0, (24_000, 20_000), (1, 65_535)))
    assert rig.tick()[0].refused == Refused.ACCEPTED


@pytest.mark.parametrize(
    ("period_ns", "hold", "ramp", "refused"),
    [
        (2_000_000, 4, 6, Refused.ACCEPTED),
        (2_000_000, 4, 7, Refused.RELEASE),
        (10_000_000, 215, 215, Refused.RELEASE),  # 4.3 s, or 5 ms modulo 2^32 ns
        (10_000_000, 255, 255, Refused.RELEASE),
    ],
)
def test_release_takes_at_most_20_ms(period_ns, hold, ramp, refused):
    rig = Rig(config=None, info=INFO._replace(period_ns=period_ns))
    rig.say(CONFIG._replace(hold=hold, ramp=ramp))
    assert rig.tick()[0].refused == refused


@pytest.mark.parametrize("name", ["", "sixteen letters!"])
def test_info_has_all_letters_of_the_name(name):
    rig = Rig(config=None, info=INFO._replace(firmware=name))
    rig.say(Hello())
    assert rig.tick() == [INFO._replace(firmware=name)]


def test_configs_are_refused_while_forces_act():
    rig = armed()
    other = CONFIG._replace(theta=3, hold=9, ramp=1)
    for phase in (Phase.ARMED, Phase.HOLDING, Phase.HOLDING, Phase.HOLDING, Phase.HOLDING, Phase.RAMP, Phase.RAMP):
        assert rig.device.phase == phase
        rig.say(other)
        ack, _ = rig.tick()
        assert ack == Ack(config_crc(other), Refused.RUNNING)


def test_info_waits_until_the_motors_rest():
    rig = armed()
    rig.say(Hello())
    heard = [type(m) for _ in range(12) for m in rig.tick() if rig.device.phase != Phase.STOPPED]
    assert set(heard) == {State}
    assert rig.device.phase == Phase.STOPPED
    rig = armed()
    rig.say(Hello(), Stop(Reason.DONE))
    heard = [[type(m) for m in rig.tick()] for _ in range(5)]
    assert heard == [[State]] * 3 + [[Info, State], [State]]


def test_forces_act_only_after_arming():
    rig = Rig()
    for _ in range(10):
        rig.answer((9000, 9000))
        rig.tick()
        assert rig.forces == (0, 0)
    assert rig.at == (Phase.DISARMED, Cause.NONE)
    rig.answer((1, 0), command=Command.ARM)  # ARM carries no force
    rig.tick()
    assert (rig.device.phase, rig.state.crc_errors) == (Phase.DISARMED, 1)
    rig.arm()


def test_configs_forget_the_forces_that_wait():
    rig = Rig(CONFIG._replace(theta=3))
    rig.answer(command=Command.ARM)
    rig.say(rig.config)
    for _ in range(4):
        rig.tick()
        assert rig.at == (Phase.DISARMED, Cause.NONE)


# ---- the latch -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theta", [1, 2, 3, 15])
@pytest.mark.parametrize("first_tick", [0, 65_500])
def test_forces_act_at_k_plus_theta(theta, first_tick):
    """The force 10 k answers tick k (counted from arming), so the device applies 10 (k - theta) at tick k."""
    rig = Rig(CONFIG._replace(theta=theta), first_tick)
    rig.arm()
    for k in range(60):
        rig.answer((10 * k, -10 * k))
        rig.tick()
        due = max(0, 10 * (k + 1 - theta))
        assert rig.forces == (due, -due)
        assert rig.at == (Phase.ARMED, Cause.NONE)


def test_reordered_and_doubled_frames_act_in_order():
    rig = armed(theta=3)
    for k in range(30):
        if k % 2:  # the answers to two ticks, the later one first
            rig.answer((10 * k, 0))
            rig.answer((10 * (k - 1), 0), back=1)
            rig.answer((7, 7), back=1)
        rig.tick()
        if k >= 4:
            assert rig.forces == (10 * (k - 2), 0)


def test_late_early_and_misaddressed_frames_are_not_used():
    rig = armed()
    k = rig.device.k
    rig.answer((100, 100))
    rig.tick()
    wrong = [(k, k - 1), (k + 1, k), (k + 3, k + 2), (k + 2, k), (k + 2, k + 2), (k + 0x8002, k + 0x8001)]
    rig.say(*[Force(Command.RUN, a, s, (900, 900)) for a, s in wrong])
    rig.tick()
    assert (rig.forces, rig.device.phase) == ((100, 100), Phase.HOLDING)
    assert rig.state.misses == (rig.device.misses) & 0xFF == 2  # this tick and that of the CONFIG had no answer


@pytest.mark.parametrize("theta", [0, 1, 3])
def test_forces_for_later_samples_are_not_used(theta):
    rig = armed(theta=theta)
    rig.answer((900, 900), back=-1)
    for _ in range(theta + 2):
        rig.tick()
        assert (rig.forces, rig.state.margin_us) == ((0, 0), NO_MARGIN)


def test_a_late_force_keeps_the_force_that_waits():
    """The places for forces repeat after 16 ticks. A late FORCE sets echo and margin although its place is taken."""
    rig = armed(theta=15)
    k = rig.device.k
    rig.answer((100, -100))
    rig.answer((900, 900), back=16)
    for _ in range(15):
        rig.tick()
        if rig.device.k == k + 1:
            assert (rig.state.echo, rig.state.margin_us) == ((k - 16) & 0xFFFF, -T - 300)
        rig.answer()
    assert (rig.at, rig.forces) == ((Phase.ARMED, Cause.NONE), (100, -100))


def test_theta_zero_forces_act_on_arrival():
    """An answer is latched as soon as it comes within its tick; the margin is the rest of the tick."""
    rig = Rig(CONFIG._replace(theta=0))
    rig.answer(command=Command.ARM, after=200)
    assert (rig.device.phase, rig.device.applied) == (Phase.ARMED, (0, 0))
    rig.tick()
    for k in range(1, 40):
        after = 25 * k
        carried = rig.device.applied
        rig.answer((10 * k, -10 * k), after=after - 1)
        rig.answer((7, 7), after=after)  # the first FORCE counts
        assert carried == (10 * (k - 1), -10 * (k - 1))
        assert rig.device.applied == (10 * k, -10 * k)  # before the next tick
        rig.tick()
        assert rig.forces == (10 * k, -10 * k)
        assert (rig.state.echo, rig.state.margin_us) == ((rig.device.k - 1) & 0xFFFF, T - after + 1)
        assert rig.at == (Phase.ARMED, Cause.NONE)
    assert rig.device.misses == 1  # only the tick of the CONFIG had no answer


def test_with_theta_zero_a_force_is_latched_once():
    """A force that was latched within its tick is not latched again at the next one, so it slews once."""
    rig = Rig(CONFIG._replace(theta=0, slew=(3, 3)))
    rig.answer(command=Command.ARM)
    for k in range(1, 5):
        rig.tick()
        rig.answer((100, -100))
        assert rig.device.applied == (3 * k, -3 * k)


def test_with_theta_zero_late_answers_hold_the_force():
    rig = Rig(CONFIG._replace(theta=0, hold=2, ramp=2))
    rig.answer(command=Command.ARM)
    rig.tick()
    rig.answer((100, 100))
    rig.tick()
    rig.tick()  # nobody answered the tick before this one
    assert rig.at == (Phase.HOLDING, Cause.NONE)
    rig.answer((900, 900), back=1, after=50)
    assert rig.device.applied == (100, 100)
    rig.answer((200, 200))
    assert (rig.device.phase, rig.device.applied) == (Phase.ARMED, (200, 200))
    seen = []
    for _ in range(6):
        rig.tick()
        seen.append(rig.forces[0])
    assert seen == [200, 200, 200, 100, 0, 0]  # answered, held for two ticks, ramped down in two
    assert rig.at == (Phase.STOPPED, Cause.WATCHDOG)


def test_with_theta_zero_idle_ramps_at_once():
    rig = Rig(CONFIG._replace(theta=0, ramp=2))
    rig.answer(command=Command.ARM)
    rig.tick()
    rig.answer((100, 100))
    rig.tick()
    rig.answer(command=Command.IDLE)
    assert (rig.at, rig.device.applied) == ((Phase.RAMP, Cause.COMMAND), (100, 100))
    rig.tick()
    assert rig.forces == (50, 50)
    rig.tick()
    rig.answer(command=Command.ARM)  # arms only after a new CONFIG
    assert rig.at == (Phase.STOPPED, Cause.COMMAND)


def test_the_margin_is_time_before_the_latch():
    late = [(1, 1200, 0), (1, 60_000, -32_767), (1, 2**31, -32_767)]
    for theta, after, margin in [(1, 300, 900), (2, 300, 2100), (15, 0, 18_000), *late]:
        rig = Rig(CONFIG._replace(theta=theta))
        k = rig.device.k
        rig.answer(command=Command.IDLE, after=after)
        rig.tick()
        assert (rig.state.echo, rig.state.margin_us) == (k, margin)
        rig.tick()
        assert (rig.state.echo, rig.state.margin_us) == (k, NO_MARGIN)
    slow = Rig(CONFIG._replace(theta=15, hold=2), info=INFO._replace(period_ns=3_000_000))
    slow.answer(command=Command.IDLE, after=0)
    slow.tick()
    assert slow.state.margin_us == 32_767  # the margin is 45,000 us, but the wire carries at most 32,767
    uneven = Rig(CONFIG._replace(theta=15), info=INFO._replace(period_ns=333_333))
    uneven.answer(command=Command.IDLE, after=300)
    uneven.tick()
    assert uneven.state.margin_us == 4999 - 300
    wrapped = Rig(now=2**32 - T - 200)
    wrapped.answer(command=Command.IDLE, after=300)  # the clock wraps 200 us after the tick
    wrapped.tick()
    assert (wrapped.state.margin_us, wrapped.state.t_us) == (900, T - 200)
    rig = Rig()
    rig.tick()
    rig.answer(command=Command.IDLE, back=1, after=100)  # the tick of this FORCE began 100 us ago
    rig.tick()
    assert rig.state.margin_us == -100
    assert rig.state.misses == 3


# ---- the ways to rest ------------------------------------------------------------------------------------------------


def test_the_watchdog_holds_then_ramps_out():
    """With ramp = 4, the force falls by a quarter per tick, to zero in 4.8 ms at T = 1.2 ms."""
    rig = armed()
    rig.answer((1001, -999))
    rig.tick()
    seen = []
    for _ in range(10):
        rig.tick()
        seen.append((rig.device.phase, rig.forces))
    assert seen[:4] == [(Phase.HOLDING, (1001, -999))] * 4
    assert seen[4:7] == [(Phase.RAMP, (750, -749)), (Phase.RAMP, (500, -499)), (Phase.RAMP, (250, -249))]
    assert seen[7:] == [(Phase.STOPPED, (0, 0))] * 3
    assert rig.at == (Phase.STOPPED, Cause.WATCHDOG)


def test_holding_lasts_equally_long_after_each_arming():
    rig = armed()
    seen = [rig.tick() and rig.at for _ in range(9)]
    assert [phase for phase, _ in seen] == [Phase.HOLDING] * 4 + [Phase.RAMP] * 3 + [Phase.STOPPED] * 2
    rig.say(CONFIG)
    rig.tick()
    rig.arm()
    assert [rig.tick() and rig.device.phase for _ in range(5)] == [Phase.HOLDING] * 4 + [Phase.RAMP]


def test_holding_keeps_the_present_force():
    """Without a new frame the force stays, even if the slew rate kept it below the request."""
    rig = armed(slew=(100, 100))
    rig.answer((1000, -1000))
    rig.tick()
    for _ in range(4):
        rig.tick()
        assert rig.forces == (100, -100)


def test_a_frame_in_time_ends_the_holding():
    rig = armed()
    for _ in range(20):
        rig.answer((500, 500))
        rig.tick()
        for _ in range(4):
            rig.tick()
            assert (rig.device.phase, rig.forces) == (Phase.HOLDING, (500, 500))
    rig.answer((400, 400))
    rig.tick()
    assert (rig.device.phase, rig.forces) == (Phase.ARMED, (400, 400))


ENDINGS = {
    Cause.HOST: lambda rig: rig.say(Stop(Reason.DONE)),
    Cause.DEVICE: lambda rig: rig.device.fault(),
    Cause.COMMAND: lambda rig: rig.answer(command=Command.IDLE),
}


@pytest.mark.parametrize("cause", ENDINGS)
def test_stops_ramp_down_and_keep_their_cause(cause):
    rig = armed()
    rig.answer((4000, 0))
    rig.tick()
    ENDINGS[cause](rig)
    ramp = []
    for _ in range(4):
        rig.tick()
        ramp.append(rig.forces[0])
        rig.answer((9000, 9000))
        rig.device.fault()
        rig.say(Stop(Reason.FAULT))
    assert ramp == [3000, 2000, 1000, 0]
    for command in [Command.RUN] * 5 + [Command.ARM] * 5:
        rig.answer((9000, 0) if command == Command.RUN else (0, 0), command=command)
        rig.tick()
        assert (rig.at, rig.forces) == ((Phase.STOPPED, cause), (0, 0))
    rig.say(CONFIG)  # two deliberate steps: a new CONFIG, then ARM
    rig.tick()
    assert rig.at == (Phase.DISARMED, Cause.NONE)
    rig.arm()


def test_a_stop_before_arming_needs_no_ramp():
    rig = Rig()
    rig.say(Stop(200))  # an unknown reason stops the device, too
    rig.tick()
    assert rig.at == (Phase.STOPPED, Cause.HOST)
    rig = Rig(config=None)
    rig.say(Stop(Reason.FAULT))
    assert rig.tick() == []
    assert rig.device.phase == Phase.SILENT


@pytest.mark.parametrize(("press", "cause"), [("device", Cause.ESTOP_DEVICE), ("host", Cause.ESTOP_HOST)])
def test_emergency_stops_zero_forces_at_once(press, cause):
    rig = armed()
    rig.answer((4000, 0))
    rig.tick()
    rig.answer((4000, 0))
    if press == "device":
        rig.device.estop()
    else:
        rig.say(Stop(Reason.ESTOP))
    for command in (Command.RUN, Command.ARM, Command.IDLE):
        rig.tick()
        assert (rig.at, rig.forces) == ((Phase.ESTOP, cause), (0, 0))
        rig.say(CONFIG, Stop(Reason.DONE), Stop(Reason.ESTOP), Hello())
        rig.device.fault()
        rig.device.estop()
        rig.answer(command=command)
    info, ack, _ = rig.tick()
    assert (info, ack.refused) == (INFO, Refused.ESTOP)
    assert rig.at == (Phase.ESTOP, cause)


def test_emergency_stops_forbid_configuration():
    rig = Rig(config=None)
    rig.device.estop()
    rig.say(CONFIG)
    assert rig.tick() == [Ack(config_crc(CONFIG), Refused.ESTOP)]


# ---- limits ----------------------------------------------------------------------------------------------------------


def test_cap_and_slew_hold_per_axis():
    rig = armed(cap=(3000, 2000), slew=(700, 2500))
    seen = []
    for force in [(32_767, -32_768)] * 6 + [(-32_768, 32_767)] * 6:
        rig.answer(force)
        rig.tick()
        seen.append(rig.forces)
    assert [f for f, _ in seen] == [700, 1400, 2100, 2800, 3000, 3000, 2300, 1600, 900, 200, -500, -1200]
    assert [f for _, f in seen] == [-2000] * 6 + [500] + [2000] * 5


def test_the_cap_grows_from_zero_after_each_arming():
    rig = armed(ramp_in=5, cap=(1000, 500))
    for _ in range(2):
        seen = []
        for _ in range(7):
            rig.answer((20_000, -20_000))
            rig.tick()
            seen.append(rig.forces)
        assert seen == [(200, -100), (400, -200), (600, -300), (800, -400), (1000, -500), (1000, -500), (1000, -500)]
        rig.say(Stop(Reason.DONE))
        assert [rig.tick() and rig.device.phase for _ in range(4)][-1] == Phase.STOPPED
        rig.say(rig.config)
        rig.tick()
        rig.arm()


def test_the_growing_cap_is_rounded_down():
    rig = armed(ramp_in=300, cap=(1000, 500))
    for k in range(1, 310):
        rig.answer((20_000, -20_000))
        rig.tick()
        run = min(k, 300)
        assert rig.forces == (1000 * run // 300, -(500 * run // 300))


def test_counters_wrap():
    rig = Rig()
    for _ in range(300):
        rig.device.receive(b"\x09nonsense\0", rig.now)
        rig.tick()
    assert (rig.state.crc_errors, rig.state.misses) == (300 % 256, 301 % 256)


def test_frames_of_wrong_kinds_are_not_obeyed():
    rig = armed()
    k = rig.device.k
    wrong = [
        (Command.RUN, (900,)),
        (Command.RUN, (900, 900, 900)),
        (9, (0, 0)),
        (Command.IDLE, (1, 0)),
        (Command.ARM, (0, 1)),
    ]
    rig.say(*[Force(command, k + 1, k, force) for command, force in wrong], Ack(1, 0), INFO, rig.state)
    rig.tick()
    assert (rig.state.crc_errors, rig.forces, rig.device.phase) == (8, (0, 0), Phase.HOLDING)


@pytest.mark.parametrize(
    "payload",
    [
        pack(Hello()) + b"\0",
        pack(CONFIG)[:6],
        pack(CONFIG) + b"\0",
        pack(Force(Command.ARM, 2, 1, (0, 0))) + b"\0",
        pack(Stop(Reason.DONE)) + b"\0",
        pack(Stop(Reason.DONE))[:1],
    ],
    ids=bytes.hex,
)
def test_messages_of_wrong_lengths_only_count(payload):
    rig = Rig()
    rig.device.receive(enclosed(payload), rig.now)
    (state,) = rig.tick()
    assert (rig.at, state.crc_errors) == ((Phase.DISARMED, Cause.NONE), 1)
