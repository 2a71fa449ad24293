"""Test info, configure, exchange and stop of a device on a stand-in for Force Dimension's SDK and on a serial link."""

import sys
from contextlib import ExitStack, nullcontext
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from causes import cause_of
from scipy.linalg import expm
from shared import FakePort

from haptic_loop.cli import bridge, replay, session_cli
from haptic_loop.cli.session_cli import check_link
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.hw.control import CouplingRequest, certified_coupling, certified_couplings, timed
from haptic_loop.hw.device_state import Device
from haptic_loop.hw.driver import Operator
from haptic_loop.hw.emulator import info_of
from haptic_loop.hw.force_dimension import ForceDimension, library
from haptic_loop.hw.haptic_device import PortLost, SerialDevice
from haptic_loop.hw.limits import SafetyLimits, Stage
from haptic_loop.hw.monitor import Ages, LinkSettings
from haptic_loop.hw.protocol import Command, Config, Decoder, Force, Hello, Phase, Reason, Refused, State, encode
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.session import Session
from haptic_loop.hw.session_report import save
from haptic_loop.hw.transport import Live
from haptic_loop.models.scene import build, plant
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.scenario import load as scenario_of

T = 1.2e-3


@pytest.fixture(scope="module")
def scenario():
    return scenario_of()


class StandIn:
    """The calls of forcedimension_core.dhd over the scenario's devices and hands, with a virtual clock.

    The plant is integrated exactly between any two calls, so that a force acts from the instant it is written.
    """

    def __init__(self, scenario, read_us=40, write_us=50):
        self.read, self.write = 1e-6 * read_us, 1e-6 * write_us
        scene = build(scenario.device, scenario.human, scenario.person)
        self.plant, self.channels, self.pushing = plant(scene.model), scenario.channels, scene.outside
        self.s = np.zeros(self.plant.A.shape[0])
        self.force, self.now, self.done = np.zeros(self.channels), 0.0, 0.0
        self.enabled, self.open, self.log, self.watchdogs = {}, [], [], []
        self.broken, self.saturated, self.push = False, False, lambda t: 0.0
        self.steps = {}
        self.status, self.buttons, self.serials = {}, [1, 1], [4711, 4712]

    # the clock

    def clock(self):
        self.now += 1e-6  # reading the clock takes time, so that a busy wait ends
        return self.now

    def sleep(self, seconds):
        self.now += max(seconds, 0.0)

    def _advance(self):
        if (dt := round(self.now - self.done, 9)) > 0:
            if dt not in self.steps:
                A, B = self.plant.A, self.plant.B
                n, m = A.shape[0], B.shape[1]
                whole = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * dt)
                self.steps[dt] = whole[:n, :n], whole[:n, n:]
            a, b = self.steps[dt]
            outside = np.full(self.pushing, self.push(self.now))
            self.s = a @ self.s + b @ np.concatenate(
                [outside, -self.force * [self.enabled.get(i, False) for i in (0, 1)]]
            )
            self.done = self.now

    # the library

    def openID(self, index):
        if index >= self.channels or self.broken:
            return -1
        self.open.append(index)
        return index

    def close(self, ID):
        self.open.remove(ID)
        return 0

    def enableExpertMode(self):
        return 0

    def setMaxForce(self, limit, ID):
        self.limits = {**getattr(self, "limits", {}), ID: limit}
        return 0

    def getStatus(self, out, ID):
        vars(out).update(self.status)
        return 0

    def getButton(self, index, ID):
        return self.buttons[ID]

    @staticmethod
    def Status():
        return SimpleNamespace(power=1, connected=1, reset=0, error=0, force=1, forceoffcause=0)

    def getSystemName(self, ID):
        return "omega.3"

    def getSerialNumber(self, ID):
        return self.serials[ID]

    def getPosition(self, out, ID):
        self.now += self.read / self.channels
        self._advance()
        out[:] = [float(self.s[ID]), 0.0, 0.0]
        return -1 if self.broken else 0

    def setForce(self, f, ID):
        self.now += self.write / self.channels
        self._advance()
        self.force[ID] = f[0]
        self.log.append((self.now, ID, f[0]))
        return -1 if self.broken else 2 if self.saturated else 0

    def enableForce(self, enable, ID):
        self._advance()
        self.enabled[ID] = enable
        return 0

    def setWatchdog(self, duration, ID):
        self.watchdogs.append(duration)
        return 0

    def errorGetLastStr(self):
        return "no device found"


#: a coupling that is certified for latencies up to 0.3 ms
SOFT = SpringDamper([400.0, 400.0], [0.2, 0.2])


def held_session(scenario, sdk, seconds=0.5, cap=12.0, watch=lambda session: None, own=None, spare=0, **settings):
    """Run a session of Live with the stand-in to its end; return it, its recorder and its couplings.

    The coupling is `own`, or designed for the measured latency.
    """
    session = Session(scenario, SafetyLimits((cap,) * 2), LinkSettings(measure=150, **settings))
    session.record = recorder = Recorder(2)
    with ForceDimension(scenario, None, sdk, sdk.clock, sdk.sleep, session.settings.deadman) as device:
        couplings = []

        def plan(ages):
            judged, link = timed(scenario, ages, 0.99, 50.0, at_once=True)
            couplings.extend(certified_couplings(CouplingRequest(judged, own=own), link, spare=spare))
            return couplings

        live = Live(session, device, plan, Operator(not spare, seconds), watch=watch)
        live.clock = lambda: round(1e6 * sdk.now)
        live.run()
    return session, recorder, couplings


@pytest.mark.slow
def test_a_session_may_be_clocked_by_the_host(scenario, tmp_path):
    """The session has handshake, delay, certificate, forces, ramp and replay, as over the serial link."""
    sdk = StandIn(scenario)
    sdk.push = lambda t: 3.0 * np.sin(2 * np.pi * 1.5 * (t - 0.7)) * (t > 0.7)  # no push during arming
    session, recorder, (coupling,) = held_session(scenario, sdk, own=SOFT)
    assert (session.stage, cause_of(session.cause)) == (Stage.FINISHED, "time:")
    assert session.info.firmware == "omega.3"
    assert session.info.serial == 4711
    # forces acted, over 98 % of them within the certified latency
    (t1, t2), _ = coupling.scenario.latency
    assert 0 < t1 < 93e-6 < t2 < 300e-6  # 40 us to read, 50 to write, 3 to look at the clock
    assert T <= (coupling.scenario.T_max or T) < 1.2 * T
    link = recorder.link()
    assert np.abs(link["applied"]).max() > 1000
    age = 1e6 * T - link["margin_us"][link["received"]]
    assert np.mean(age <= 1e6 * t2) > 0.98
    # every force of the record was written to the device
    sent = {round(force / 4e-4) for _, ID, force in sdk.log if ID == 0}
    assert set(link["sent"][:, 0].tolist()) <= sent | {0}
    # at the end forces are zero, motors are off and every device is closed
    assert sdk.force.tolist() == [0.0, 0.0]
    assert sdk.enabled == {0: False, 1: False}
    assert sdk.open == []
    assert sdk.watchdogs == [160, 160]
    report = {"scenario": "s", "case": "I"}
    save(tmp_path, session, recorder, report, plot=False)
    assert replay.main([str(tmp_path / "trace.npz")]) == 0


@pytest.mark.slow
def test_certificates_of_host_clocks_name_period_and_latency(scenario):
    """Certificates name T_max and a latency below one sample; no whole tick is charged for the link."""
    _, _, (coupling,) = held_session(scenario, StandIn(scenario), seconds=0.1, own=SOFT)
    assert coupling.assessment.loop.theta == scenario.theta  # no tick is added for the link
    assert coupling.link == 0
    assert coupling.assessment.decisive.certified
    (said,) = [remark for remark in coupling.remarks() if "act as they come" in remark]
    T_max, (t1, t2) = coupling.scenario.T_max or coupling.scenario.T, coupling.scenario.latency[0]
    kept = (
        f"periods up to {1e6 * T_max:.0f} us and forces that act {1e6 * t1:.0f} to {1e6 * t2:.0f} us after their sample"
    )
    assert said == f"forces act as they come: certified for {kept}, as measured"


@pytest.mark.slow
def test_host_clocks_charge_microseconds_not_ticks(scenario):
    """A coupling needs less damping if its forces act 0.13 ms after a sample than if they act a tick after it."""
    judged, link = timed(scenario.replace(theta=(0, 1)), Ages((50,) * 50 + (130,) * 50), 1.0, 0.0, at_once=True)
    assert judged.latency[1] == pytest.approx((50e-6, 130e-6))
    assert link == 0
    judged = judged.replace(latency=((0.0, 130e-6),) * 2)
    given = SpringDamper([879.0, 552.0], [0.39, 0.52])
    host = certified_coupling(CouplingRequest(judged, own=given), 0)
    link = certified_coupling(CouplingRequest(scenario.replace(theta=(1, 2)), own=given), 1)
    constant = certified_coupling(CouplingRequest(judged.replace(latency=((130e-6, 130e-6),) * 2), own=given), 0)
    latest, ranged = (
        max(one.assessment.requirements["this-environment"].required) for one in (constant, host)
    )  # the range needs at least as much as its largest latency, and less than 0.13 ms in periods of 1.33 ms
    assert latest - 1e-6 <= ranged < 0.637433
    assert max(link.assessment.requirements["this-environment"].required) == pytest.approx(0.714344, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("read", "write", "holds"), [(40, 50, True), (500, 500, False)])
def test_sessions_with_too_late_forces_are_refused(scenario, read, write, holds):
    session, *_ = held_session(scenario, StandIn(scenario, read, write), seconds=0.05, own=SOFT)
    if holds:
        assert session.stage == Stage.FINISHED
    else:
        assert session.stage == Stage.REFUSED
        assert cause_of(session.cause).startswith("answers beyond a tick:")


@pytest.mark.slow
def test_forces_later_than_certified_end_in_a_ramp(scenario):
    """Forces after 0.4 ms in place of 0.1 ms are within the tick, but later than certified."""
    sdk = StandIn(scenario)

    def watch(session):
        if session.stage == Stage.ARMED:
            sdk.write = 0.4e-3

    session, *_ = held_session(scenario, sdk, seconds=3.0, watch=watch, own=SOFT)
    assert session.stage == Stage.STOPPED
    assert cause_of(session.cause).startswith("late answers:")
    assert session.counters.late > 20
    assert sdk.force.tolist() == [0.0, 0.0]


@pytest.mark.slow
def test_later_forces_continue_with_a_softer_coupling(scenario):
    """The reserve's certificate covers the later forces, which still act on arrival."""
    sdk = StandIn(scenario)

    def watch(session):
        if session.stage == Stage.DISARMED:  # a person presses the key
            session.arm(session.now)
        if session.stage == Stage.ARMED:
            sdk.write = 0.4e-3

    session, _, couplings = held_session(scenario, sdk, seconds=1.0, watch=watch, spare=2)
    assert (session.stage, cause_of(session.cause)) == (Stage.FINISHED, "time:")
    first, softer = couplings
    assert [arming.program for arming in session.armings] == [first, softer]
    assert max(first.chosen.coupling.K) > 2 * max(softer.chosen.coupling.K)
    assert first.link == softer.link == 0
    assert softer.scenario.latency[0] == pytest.approx((first.scenario.latency[0][0], 0.95 * T))


@pytest.mark.slow
def test_a_host_that_cannot_keep_the_period_stops(scenario):
    sdk = StandIn(scenario)

    def watch(session):
        if session.stage == Stage.ARMED:
            sdk.read = 1.6e-3

    session, *_ = held_session(scenario, sdk, seconds=3.0, watch=watch, own=SOFT)
    assert session.stage == Stage.STOPPED
    assert cause_of(session.cause).startswith(("missed answers:", "device clock:"))
    assert sdk.force.tolist() == [0.0, 0.0]


def test_a_device_that_is_unplugged_is_lost(scenario):
    sdk = StandIn(scenario)

    def watch(session):
        sdk.broken |= session.stage == Stage.ARMED

    session, *_ = held_session(scenario, sdk, watch=watch, own=SOFT)
    assert (session.stage, session.cause) == (Stage.LOST, "a call to the device failed: no device found")
    assert sdk.force.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("place", [np.nan, np.inf, 1e300])
def test_impossible_positions_stop_the_session(scenario, monkeypatch, place):
    sdk, lost = StandIn(scenario), []
    known = sdk.getPosition

    def position(out, ID):
        known(out, ID)
        if lost and ID == 1:
            out[0] = place
        return 0

    monkeypatch.setattr(sdk, "getPosition", position)

    def watch(session):
        lost[:] = [session.stage] * (session.stage == Stage.ARMED) or lost

    session, *_ = held_session(scenario, sdk, watch=watch, own=SOFT)
    assert (session.stage, session.cause) == (Stage.STOPPED, f"device 1 reports the position x = {place:g} m")
    assert sdk.force.tolist() == [0.0, 0.0]


def test_a_button_of_every_device_is_the_deadman(scenario):
    sdk, disarmed = StandIn(scenario), set()
    sdk.buttons = [0, 1]

    def watch(session):
        if session.stage == Stage.DISARMED:
            disarmed.add(session.request)
            sdk.buttons = [1, 1] if session.now > 1_000_000 else [0, 1]
        if session.stage == Stage.ARMED:
            sdk.buttons = [1, 0]

    session, *_ = held_session(scenario, sdk, watch=watch, own=SOFT, deadman=True)
    assert disarmed == {"the deadman at the device is not held"}
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "device deadman:")
    assert len(session.armings) == 1


def test_buttons_that_cannot_be_read_are_refused(scenario):
    sdk = StandIn(scenario)
    sdk.buttons = [1, -1]
    with pytest.raises(InputError, match=r"--deadman device: .* device 1 .*; give --deadman key"):
        ForceDimension(scenario, None, sdk, sdk.clock, sdk.sleep, deadman=True)
    assert sdk.open == []


def test_reset_mode_is_named_before_arming(scenario):
    sdk = StandIn(scenario)
    sdk.status["reset"] = 1
    session, *_ = held_session(scenario, sdk, own=SOFT)
    assert (session.stage, session.cause) == (Stage.STOPPED, "device 0 is in reset mode: calibrate it")
    assert session.armings == []


def test_saturated_motors_are_device_faults(scenario):
    """The force of a saturated motor is not the certified one."""
    sdk = StandIn(scenario)

    def watch(session):
        sdk.saturated |= session.stage == Stage.ARMED

    session, *_ = held_session(scenario, sdk, watch=watch, own=SOFT)
    assert session.stage == Stage.STOPPED
    assert cause_of(session.cause) == "device fault:"


def test_emergency_stops_zero_forces_at_once(scenario):
    sdk = StandIn(scenario)
    sdk.push = lambda t: 3.0 * np.sin(2 * np.pi * 1.5 * (t - 0.7)) * (t > 0.7)  # no push during arming
    held = []

    def watch(session):
        if session.stage == Stage.ARMED and np.abs(sdk.force).max() > 0.2:
            held.append(np.abs(sdk.force).max())
            live.do(session.estop("asked to", session.now))
            assert sdk.force.tolist() == [0.0, 0.0]

    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=150))
    with ForceDimension(scenario, "1x,0x", sdk, sdk.clock, sdk.sleep) as device:

        def plan(ages):
            return [certified_coupling(CouplingRequest(timed(scenario, ages, 0.99, 50.0, True)[0], own=SOFT), 0)]

        live = Live(session, device, plan, Operator(True, 3.0), watch=watch)
        live.clock = lambda: round(1e6 * sdk.now)
        live.run()
    assert (session.stage, session.cause) == (Stage.ESTOP, "asked to")
    assert held


# without the maker's library, and bad input


def test_a_missing_library_gives_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "forcedimension_core", None)
    with pytest.raises(InputError) as error:
        bridge.main(["--port", "force-dimension", "--arm", "--no-preflight", "--no-dead-man"])
    assert str(error.value).startswith(
        "--port force-dimension needs the Python package forcedimension_core and Force Dimension's SDK"
    )
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("written", ["", "Could not find libdrd. Is it installed?\n"])
def test_the_package_without_the_makers_library_is_explained(monkeypatch, capsys, written):
    """The package is installed, writes a line and raises, as it does without libdrd."""

    class Finder:
        @staticmethod
        def find_spec(name, path=None, target=None):
            if name == "forcedimension_core.dhd":
                sys.stderr.write(written)
                raise ImportError("There were problems loading libdrd.")

    package = ModuleType("forcedimension_core")
    package.__path__ = []
    monkeypatch.setitem(sys.modules, "forcedimension_core", package)
    monkeypatch.setattr(sys, "meta_path", [Finder, *sys.meta_path])
    with pytest.raises(InputError, match=rf"SDK .*: {written.strip() or 'There were problems loading libdrd'}"):
        library()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ("0x", "each of 2 channels"),
        ("0x,0x", "same axis"),
        ("0w,1x", "as in force-dimension:0x,1x"),
        ("0x,7x", "device 7"),
    ],
)
def test_wrong_axes_of_a_port_are_refused(scenario, axes, words):
    sdk = StandIn(scenario)
    with pytest.raises(InputError) as error:
        ForceDimension(scenario, axes, sdk)
    assert words in str(error.value)
    assert sdk.open == []


@pytest.mark.parametrize("call", ["getSystemName", "getSerialNumber", "enableExpertMode", "setWatchdog", "Status"])
def test_exceptions_while_opening_close_every_device(scenario, monkeypatch, call):
    def fail(*args, **more):
        raise OSError(call)

    monkeypatch.setattr(sdk := StandIn(scenario), call, fail)
    with pytest.raises(OSError, match=call):
        ForceDimension(scenario, "0x,1x", sdk, sdk.clock, sdk.sleep)
    assert sdk.open == []
    assert sdk.enabled == {0: False, 1: False}


def test_two_names_of_a_device_are_refused(scenario):
    sdk = StandIn(scenario)
    sdk.serials = [4711, 4711]
    with pytest.raises(InputError, match="0 and 1 are the same device, serial number 4711"):
        ForceDimension(scenario, "0x,1x", sdk, sdk.clock, sdk.sleep)
    assert sdk.open == []
    sdk.serials = [-1, -1]  # these devices report no serial number
    with ForceDimension(scenario, "0x,1x", sdk, sdk.clock, sdk.sleep):
        assert sdk.open == [0, 1]


def test_one_device_may_serve_two_channels(scenario):
    sdk = StandIn(scenario)
    with ForceDimension(scenario, "0x,0y", sdk, sdk.clock, sdk.sleep) as device:
        assert sdk.open == [0]
        assert device.unused_axes == ["z of device 0"]


@pytest.mark.parametrize(
    ("terminal", "answer", "passes"), [(False, "y", False), (True, "n", False), (True, "", False), (True, "Y", True)]
)
def test_unused_axes_need_a_mechanical_clamp(scenario, monkeypatch, terminal, answer, passes):
    sdk = StandIn(scenario)
    monkeypatch.setattr(
        session_cli, "ForceDimension", lambda *args, **more: ForceDimension(*args, sdk, sdk.clock, sdk.sleep)
    )
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: terminal))
    monkeypatch.setattr("builtins.input", lambda question: answer)
    args = bridge._parser().parse_args(["--port", "force-dimension:0x,1x", "--arm"])
    session = SimpleNamespace(scenario=scenario, settings=LinkSettings())
    with ExitStack() as stack, nullcontext() if passes else pytest.raises(InputError, match="y and z of device 0"):
        session_cli._device(args, session, stack)
    args.clamped = True
    with ExitStack() as stack:
        session_cli._device(args, session, stack)


def test_a_host_clock_has_no_baud_rate(scenario):
    args = bridge._parser().parse_args(["--port", "force-dimension:0x,1y", "--arm"])
    assert check_link(args).baud is None


# the same four calls over the serial link


class Line:
    """An emulated device at the end of a line. It ticks at every read."""

    def __init__(self, device):
        self.device, self.now, self.out, self.gone = device, 0, b"", False

    def wait(self, seconds):
        return True

    def write(self, data):
        self.device.receive(data, self.now + 200)
        return len(data)

    def read(self):
        if self.gone:
            raise PortLost("the port cannot be read: it was hung up")
        self.now += 1200
        return self.device.tick(self.now, (7, -7))[1]

    def discard(self):
        pass


def test_the_serial_link_has_the_same_four_calls():
    about = info_of(scenario_of())
    line = Line(Device(about))
    device = SerialDevice(line, lambda: 1e-6 * line.now)
    assert device.info() == about
    assert device.configure(Config(1, 4, 4, 0, (32767, 1), (1, 1))) == Refused.CAP
    config = Config(1, 4, 4, 0, (9000, 9000), (9000, 9000))
    assert device.configure(config) == Refused.ACCEPTED
    state = device.exchange(None)
    for command, force in [(Command.ARM, (0, 0)), (Command.RUN, (50, -60)), (Command.RUN, (70, -80))]:
        state = device.exchange(Force(command, (state.tick + 1) & 0xFFFF, state.tick, force))
        assert isinstance(state, State)
        assert state.counts == (7, -7)
    assert (state.phase, state.applied) == (Phase.ARMED, (70, -80))
    device.stop(Reason.DONE)
    assert device.exchange(None).phase == Phase.RAMP
    answers = [device.configure(config) for _ in range(200)]  # None until the ramp is over; CONFIG repeats each 0.1 s
    assert set(answers[: answers.index(Refused.ACCEPTED)]) == {None}
    line.gone = True
    with pytest.raises(PortLost, match="hung up"):
        [device.exchange(None) for _ in range(300)]  # earlier messages come first


def test_silent_lines_are_asked_again():
    port = FakePort()
    device = SerialDevice(port, lambda: 1e-6 * port.now)
    assert [device.info() for _ in range(700)] == [None] * 700
    assert port.now == 350_000
    assert [type(m) for m in Decoder().feed(port.sent)] == [Hello] * 4


def test_floods_of_frames_do_not_stop_time_outs():
    """With endless INFO every call still returns, so that the session's time-outs can end it."""
    flood = FakePort()
    flood.wait, flood.read = lambda seconds: True, lambda: encode(info_of(scenario_of())) * 50
    device = SerialDevice(flood)
    assert [device.exchange(None) for _ in range(100)] == [None] * 100
