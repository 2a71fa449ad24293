"""Test the deadman, limits, the incident log after a kill, the pre-flight of the machine, and rehearsals."""

import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from causes import cause_of
from messages import says
from msgspec.structs import replace
from sessions import RubbingEmulator, rehearsal_of
from shared import FakePort

from haptic_loop.cli import bridge, replay
from haptic_loop.cli.bridge import _parser
from haptic_loop.cli.session_cli import limits_from, touched, with_person
from haptic_loop.hw import transport
from haptic_loop.hw.control import CouplingRequest, TraceRow, certified_couplings
from haptic_loop.hw.driver import Driver, Operator
from haptic_loop.hw.emulator import Emulator, FaultInjection, info_of, nobody
from haptic_loop.hw.haptic_device import SerialDevice
from haptic_loop.hw.limits import SafetyLimits, Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.recording import Recorder
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session, session_for
from haptic_loop.hw.session_report import IncidentLog, _doubt, outcome
from haptic_loop.sim.scenario import InputError, load, parse
from haptic_loop.sim.trace import Growth

ROOT = Path(__file__).parent.parent.parent


# the deadman


@pytest.mark.parametrize("until", [0.0, 0.4, pytest.param(0.9, marks=pytest.mark.slow)])
def test_releasing_the_deadman_ramps_out(scenario, link_couplings, until):
    """The session ramps out in 100 ms, one second after the last sign of a person."""
    shown = []

    def there():
        since = rehearsal.emulator.since_armed(rehearsal.session.now)
        if since is not None and since < until:
            shown.append(rehearsal.session.now)
            return True
        return since is None

    rehearsal = rehearsal_of(scenario, link_couplings, operator=Operator(True, 10.0, there))
    session = rehearsal.run_until_armed(3.0)
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "deadman: 1")
    at = {event.stage: event.t_us for event in session.log}
    last = shown[-1] if shown else at[Stage.ARMING]
    assert 1e-6 * (at[Stage.DISARMING] - last) == pytest.approx(1.0, abs=0.01)
    assert 1e-6 * (at[Stage.STOPPED] - at[Stage.DISARMING]) == pytest.approx(0.1, abs=0.005)


@pytest.mark.slow
def test_holding_the_deadman_continues_the_session(scenario, link_couplings):
    session = rehearsal_of(scenario, link_couplings, operator=Operator(True, 1.5, lambda: True)).run_until_armed(3.0)
    assert (session.stage, cause_of(session.cause)) == (Stage.FINISHED, "time:")


def test_a_release_ends_the_last_motor_test(scenario, link_couplings):
    """A person gives no sign after full gain. 1 s later, during the last motor test, the session stops."""
    operator = Operator(True, 0.8, lambda: session.stage not in (Stage.ARMED, Stage.DISARMING))
    rehearsal = rehearsal_of(scenario, link_couplings, operator=operator)
    session = rehearsal.session
    rehearsal.run_until_armed(4.0)
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "deadman: 1")
    at = {event.stage: event.t_us for event in session.log}
    assert 1e-6 * (at[Stage.STOPPED] - at[Stage.ARMED]) == pytest.approx(1.0, abs=0.01)


def test_force_caps_are_explained():
    """A force F moves a free handle at F/b; a torque r F moves the rim of a wheel at r^2 F/b, with b in N m s/rad."""
    three, wheel = load("three-rigid"), load("omega-pair").replace(unit="rad", radius=0.2)
    assert "at most 1.3, 0.8, 1.3 newtons (default: " in bridge._cap_words(three, [1.3, 0.8, 1.3], None)
    assert "up to 1.62 metres per second, and with --force-cap 0.8 " in bridge._cap_words(three, [1.3] * 3, 1.3)
    assert bridge._cap_words(three, [0.8] * 3, 0.8) == "forces at the hand are at most 0.8 newtons (--force-cap)"
    assert bridge._cap_words(wheel, [0.2 * 1.3] * 2, 1.3).endswith(" at most 1.3, 1.3 newtons (--force-cap)")
    assert "--force-cap 34.2" in bridge._cap_words(wheel, [0.2 * 35, 0.2 * 30], 35.0)


def test_the_devices_deadman_allows_and_ends_forces(scenario, link_couplings):
    """The session arms only while the switch is held, and ramps out at the first STATE that reports it released."""
    faults = (FaultInjection.parse("letgo@0.7"),)
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=60, deadman=True))
    rehearsal = Rehearsal(
        session, Emulator(scenario, faults), lambda ages: link_couplings, faults, operator=Operator(True, 9.0)
    )
    rehearsal.emulator.device.deadman = False
    rehearsal.run(0.3)
    assert session.stage == Stage.DISARMED
    assert session.arm(session.now) == ()
    assert session.log[-1][1:] == (Stage.DISARMED, "the deadman at the device is not held")
    assert not any(np.any(m.applied) for m in rehearsal.moments)
    rehearsal.emulator.device.deadman = True
    rehearsal.run_until_armed(2.0)
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "device deadman:")
    assert rehearsal.zero_after(0.7) < 0.110
    assert [event.stage for event in session.log[-3:]] == [Stage.ARMED, Stage.DISARMING, Stage.STOPPED]


def test_a_release_before_full_gain_ends_the_session(scenario, link_couplings):
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=60, deadman=True))
    faults = (FaultInjection.parse("letgo@0"),)
    rehearsal = Rehearsal(session, Emulator(scenario, faults), lambda ages: link_couplings, faults)
    rehearsal.run_until_armed(0.5)
    assert (session.stage, cause_of(session.cause)) == (Stage.STOPPED, "device deadman:")
    assert Stage.ARMED not in [event.stage for event in session.log]


@pytest.mark.slow
def test_any_key_shows_that_somebody_is_there(scenario, link_couplings):
    operator = Operator(True, 10.0, lambda: False)
    rehearsal = rehearsal_of(scenario, link_couplings, operator=operator)
    for _ in range(5):
        session = rehearsal.run_until_armed(0.0) if rehearsal.armed_us is None else rehearsal.session
        rehearsal.run(1e-6 * session.now + 0.7)
        assert operator.press("x", session, session.now) == ()
    assert session.stage == Stage.ARMED


def test_a_touched_file_counts_once_per_touch(tmp_path):
    path = tmp_path / "here"
    look = touched(str(path))
    assert not look()
    path.touch()
    assert look()
    assert not look()
    os.utime(path, ns=(1, 1))
    assert look()
    path.unlink()
    assert not look()


# options


def test_sessions_have_low_default_limits(scenario):
    args = _parser().parse_args(["--rehearse"])
    limits = session_for(scenario, LinkSettings(), **limits_from(args, scenario)).limits
    assert limits.cap == (1.3, 1.3)
    assert limits.speed == 0.7
    args = _parser().parse_args(["--rehearse", "--force-cap", "12", "--max-speed", "0.5", "--continuous-force", "3"])
    limits = session_for(scenario, LinkSettings(), **limits_from(args, scenario)).limits
    assert (limits.cap, limits.speed, limits.continuous) == ((12.0, 12.0), 0.5, (3.0, 3.0))
    args = _parser().parse_args(["--rehearse", "--continuous-force", "5"])  # the motors' rating is above the cap
    limits = session_for(scenario, LinkSettings(), **limits_from(args, scenario)).limits
    assert (limits.cap, limits.continuous) == ((1.3, 1.3), (5.0, 5.0))
    wheel = scenario.replace(unit="rad", radius=0.2)  # At a radius of 0.2 m, a force of 5 N is a torque of 1 N m.
    assert session_for(wheel, LinkSettings(), **limits_from(args, wheel)).limits.continuous == (1.0, 1.0)


def light_device(damping):
    """Return a scenario with one rigid device. It has 0.1 kg and this `damping` [N s/m]."""
    return parse(
        f"""
name = "light"
T = 1e-3
theta = [1]
device = [{{ kind = "rigid", mass = 0.1, damping = {damping} }}]
[environment]
contacts = ["handle"]
springs = [{{ between = ["handle", "ground"], stiffness = 9.0, damping = 1e-6 }}]
"""
    )


@pytest.mark.parametrize("friction", [0.22, 0.8])
@pytest.mark.parametrize("cap", [None, 0.3])
def test_small_default_caps_name_dry_friction(cap, friction):
    """Friction brakes or holds a handle at the default cap of 0.3 N; a cap that the user chose needs no advice."""
    scenario = light_device(0.3)
    session = session_for(scenario, LinkSettings(measure=60, held=False), cap)
    emulator = RubbingEmulator(nobody(scenario), coulomb=friction)
    couplings = certified_couplings(CouplingRequest(scenario), 1, spare=0)
    Rehearsal(session, emulator, lambda ages: couplings).run_until_armed(1.0)
    assert (session.stage, session.limits.cap) == (Stage.STOPPED, (0.3,))
    assert all((words in session.cause) == (cap is None) for words in ("dry friction", "raise --force-cap"))


def test_coarse_force_steps_name_a_small_default_cap():
    scenario = light_device(0.3)
    coarse = info_of(scenario)._replace(force_step=(23_500,), hard_limit=(127,))
    (reason,) = session_for(scenario, LinkSettings(), None).limits.objections(coarse, scenario, None)
    assert reason.endswith("at most 0.01875 N is allowed at this small force cap: raise --force-cap")
    (reason,) = session_for(scenario, LinkSettings(), 0.3).limits.objections(coarse, scenario, None)
    assert reason.endswith("at most 0.01875 N is allowed")


def test_damping_too_small_for_a_cap_is_named():
    with pytest.raises(InputError, match=r"damping of a device is 0\.0008 N s/m .*: give --force-cap"):
        session_for(light_device(8e-4), LinkSettings(), None)
    assert session_for(light_device(8e-4), LinkSettings(), 0.05).limits.cap == (0.05,)


@pytest.mark.parametrize(
    ("device", "hand", "caps"),
    [
        ("damping = 2.0", "", [1.3]),
        ("damping = 0.5", "", [0.5]),
        ("damping = 2.0, delta = 0.25", "", [0.25]),
        ("damping = 0.01, credible_speed = 10.0, force_limit = 9.0", 'unit = "rad"\nradius = 0.15', [0.01 / 0.15]),
        ("axes = 2, damping = [[1.0, 0.4], [0.4, 1.0]]", "", [0.6] * 2),
        ("axes = 2, damping = [[1.0, 0.4], [0.4, 1.0]], force_limit = [9.0, 9.0]", "", [0.6 / 2**0.5] * 2),
    ],
)
def test_default_caps_keep_free_handles_slow(device, hand, caps):
    """The speed Delta^-1 f of a free handle is at most 1 m/s at the hand; the directions of f include the fastest."""
    scenario = parse(
        f"""
name = "light"
T = 1e-3
theta = [1]
{hand}
device = [{{ kind = "rigid", mass = 0.1, {device} }}]
[environment]
contacts = ["handle"]
springs = [{{ between = ["handle", "ground"], stiffness = 9.0, damping = 0.1 }}]
"""
    )
    cap = session_for(scenario, LinkSettings(), cap=None).limits.cap
    assert cap == pytest.approx(caps)
    directions = [[1.0]] if len(cap) == 1 else [[1.0, -1.0], [1.0, 1.0], [1.0, 0.0]]
    length = cap[0] if scenario.balls else np.linalg.norm(cap)
    Delta = scenario.device[0].matrix("delta")
    speeds = [np.linalg.norm(np.linalg.solve(Delta, d)) / np.linalg.norm(d) * length for d in directions]
    assert scenario.lever * max(speeds) <= 1 + 1e-12


def test_the_identified_speed_limits_sessions(scenario):
    """A speed from hw.identify below 0.7 m/s is the default limit of a session, and --max-speed cannot raise it."""
    slow = scenario.replace(device=tuple(replace(d, credible_speed=0.5) for d in scenario.device))
    assert limits_from(_parser().parse_args(["--rehearse"]), slow)["speed"] == 0.5
    assert limits_from(_parser().parse_args(["--rehearse", "--max-speed", "0.4"]), slow)["speed"] == 0.4
    with pytest.raises(InputError, match=r"--max-speed is 0\.6, the devices' least credible_speed is 0\.5 metres/s"):
        limits_from(_parser().parse_args(["--rehearse", "--max-speed", "0.6"]), slow)


def test_live_sessions_use_a_deadman_unless_refused(monkeypatch):
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    for options, asked in (([], "key"), (["--deadman", "device"], "device"), (["--no-dead-man"], None)):
        args = _parser().parse_args(["--port", "x", *options])
        assert with_person(args, LinkSettings()).deadman == (asked == "device")
        assert args.deadman == asked


def test_live_sessions_check_axes_unless_refused(monkeypatch):
    asked = []

    def seen(scenario, settings, **limits):
        asked.append(settings.check_axes)
        raise InputError("seen")

    monkeypatch.setattr(bridge, "session_for", seen)
    live = ["--port", "x", "--arm", "--no-dead-man"]
    for options in (live, [*live, "--no-axis-check"], ["--rehearse"]):
        with pytest.raises(InputError, match="seen"):
            bridge.main(options)
    assert asked == [True, False, False]


def test_a_reset_device_keeps_the_deadman_held(scenario):
    emulator = Emulator(scenario, (FaultInjection.parse("reset"),))
    before = emulator.device
    emulator.tick(0)
    assert emulator.device is not before
    assert emulator.device.deadman


def rehearsal_until_finished(scenario, link_couplings):
    """Return a session that was armed and has finished."""
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=60))
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: link_couplings)
    rehearsal.run_until_armed(0.3)
    session.stop("enough", session.now)
    rehearsal.run(1e-6 * session.now + 0.5)
    return session


@pytest.mark.parametrize(("rate", "grew"), [(0.03, False), (0.12, True)])
def test_a_tremor_may_grow_by_half(scenario, link_couplings, rate, grew):
    """Over 4.8 s a rate of 0.03 1/s is a factor of 1.15, and 0.12 1/s one of 1.8."""
    session = rehearsal_until_finished(scenario, link_couplings)
    growth = Growth(0, 4000, rate, 0.001, 9.0, 1e-4, 5.0, "grows")
    doubt = _doubt(session, [growth], Recorder(2))
    assert doubt == ("an oscillation grew in arming 1" if grew else None)


@pytest.mark.parametrize(("by_cap", "advice"), [(True, "raise --force-cap"), (False, "Raise --energy-budget")])
def test_forces_cut_over_half_a_second_stop_sessions(scenario, link_couplings, by_cap, advice):
    """A session ends as stopped if cap or budget reduced the forces in over half of the 833 ticks of any second."""
    session = rehearsal_until_finished(scenario, link_couplings)
    for cut, stage in ((400, "finished"), (450, "stopped")):
        recorder, state = Recorder(2), session.link.last
        for k in range(4000):
            within = 2000 <= k < 2000 + cut
            asked = (12.0, 0.0) if within and by_cap else (0.1, 0.0)
            row = TraceRow(k, (1e-5 * (k % 7), 0.0), asked, 1.0, (0, 0), state, limited=within and not by_cap)
            recorder(row)
        assert outcome("I", session, recorder, 0).session.stage == stage
    assert Stage.FINISHED not in [event.stage for event in session.log]
    assert advice in session.cause


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--force-cap", "13"], "--force-cap is 13 .. 0.05 to 12"),
        (["--max-speed", "0"], "--max-speed is 0 .. 0.001 to 2.5"),
        (["--continuous-force", "1,2,3"], "--continuous-force has 3 entries"),
        (["--continuous-force", "13"], "--continuous-force is 13"),
        (["--thermal-time", "nan"], "--thermal-time is nan"),
        (["--port", "/nowhere", "--deadman", "key"], "--deadman key needs a terminal"),
    ],
)
def test_impossible_limits_are_refused(scenario, options, words):
    def limited():
        args = _parser().parse_args([*options, *["--rehearse"] * ("--port" not in options)])
        session_for(scenario, with_person(args, LinkSettings()), **limits_from(args, scenario))

    with pytest.raises(InputError) as error:
        limited()
    assert says(error.value, words)


# the incident log


@pytest.mark.slow
def test_the_incident_log_survives_sigkill(tmp_path):
    """A child process with a session is killed: every stage up to then is on the disk."""
    code = (
        "import time; from pathlib import Path\n"
        "from haptic_loop.hw.session_report import IncidentLog\n"
        "from haptic_loop.hw.limits import SafetyLimits; from haptic_loop.hw.session import Session\n"
        "from haptic_loop.sim.scenario import load\n"
        f"session, log = Session(load(), SafetyLimits((2.0, 2.0))), IncidentLog(Path({str(tmp_path / 'log')!r}))\n"
        "log.attach(session); session.start(0); session.now = 1_500_000; log.update(session)\n"
        "print('written', flush=True); time.sleep(600)"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "written\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert lines[0]["scenario"] == "omega-pair"
    assert lines[1] == {"t_us": 0, "stage": "connecting", "cause": "HELLO"}
    assert lines[2]["t_us"] == 1_500_000
    assert lines[2]["counters"]["states"] == 0


@pytest.mark.slow
def test_the_incident_log_grows_every_second(scenario, link_couplings, tmp_path):
    log = IncidentLog(tmp_path / "log")
    rehearsal = rehearsal_of(scenario, link_couplings, operator=Operator(True, 2.0))
    log.attach(rehearsal.session)
    steer = rehearsal.operator.decide
    rehearsal.operator.decide = lambda session, now: (log.update(session), steer(session, now))[1]
    session = rehearsal.run_until_armed(3.0)
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert [line["stage"] for line in lines if "cause" in line] == [str(event.stage) for event in session.log]
    standing = [line for line in lines if "gain" in line]
    assert len(standing) >= 2
    assert 2 in [len(line["x_m"]) for line in standing]
    again = IncidentLog(tmp_path / "log")  # A second log appends to the file.
    again.attach(Session(scenario, SafetyLimits((2.0, 2.0))))
    assert len((tmp_path / "log").read_text().splitlines()) == len(lines) + 1
    with pytest.raises(InputError, match="cannot write"):
        IncidentLog(tmp_path)


@pytest.mark.slow
def test_report_and_incident_log_name_one_cause(tmp_path, capsys):
    """A cap of 0.05 N cuts most forces, so that the session ends as stopped."""
    words = "--rehearse --force-cap 0.05 --duration 1.5 --measure 60 --out"
    assert bridge.main([*words.split(), str(tmp_path)]) == 1
    report = json.loads((tmp_path / "report.json").read_text())["session"]
    last = json.loads((tmp_path / "incidents.jsonl").read_text().splitlines()[-1])
    assert (last["stage"], last["cause"]) == (report["stage"], report["cause"])
    assert re.match(r"cut forces: \d+", cause_of(last["cause"]))


# the machine


def test_the_preflight_says_what_the_machine_can_do():
    """A child process makes the checks, because a process keeps its real-time scheduling and locked memory."""
    code = "from haptic_loop.hw.transport import preflight; print(preflight(['/dev/null']))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    begun = time.monotonic()
    line = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True).stdout
    assert time.monotonic() - begun > 2.0
    for words in ("pre-flight: ", "real-time scheduling", "memory ", "latency timer", "worst stall in 2 s"):
        assert words in line
    assert line.count("\n") == 1


def test_long_stalls_advise_to_close_busy_programs(monkeypatch):
    for stall, told in ((5e-4, False), (5e-3, True)):
        ticks = itertools.count()  # Each sleep of a millisecond lasts longer by `stall`.
        clock = SimpleNamespace(monotonic=lambda ticks=ticks, stall=stall: next(ticks) * (1e-3 + stall), sleep=id)
        monkeypatch.setattr(transport, "time", clock)
        assert ("close busy programs" in transport._stalls()) == told
        assert f"2 s {1e3 * stall:.1f} ms" in transport._stalls()


# the whole command in virtual time


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory):
    """Return report, trace and folder of two rehearsals with an energy budget, with and without a picture."""
    rehearsals = []
    for name, picture in (("one", []), ("two", ["--no-plot"])):
        out = tmp_path_factory.mktemp(name)
        options = ["--rehearse", "--duration", "0.5", "--energy-budget", "0.01", "--out", str(out)]
        assert bridge.main([*options, *picture, "--json", str(out / "r.json")]) == 0
        rehearsals.append((json.loads((out / "r.json").read_text()), (out / "trace.csv").read_text(), out))
    return rehearsals


@pytest.mark.slow
def test_rehearsals_have_a_sessions_stages_and_files(rehearsed):
    report, _, out = rehearsed[0]
    stages = ["connecting", "configuring", "measuring", "measured", "configuring", "disarmed", "arming", "armed"]
    assert [event["stage"] for event in report["session"]["log"]] == [*stages, "disarming", "finished"]
    assert {path.name for path in out.iterdir()} >= {
        "trace.npz",
        "trace.csv",
        "figure.png",
        "report.json",
        "incidents.jsonl",
    }
    assert report["link"]["missed_percent"] == 0
    (budget,) = report["energy_budget"]  # it limits nothing while the coupling is certified
    assert (budget["start_J"], budget["limited_ticks"], budget["ticks"]) == (0.01, 0, report["run"]["samples"])
    stated = report["assessment"]["guarantee"]  # The budget may scale forces, which no condition covers.
    assert (stated["condition"], stated["energy_J"]) == ("energy-budget", 0.01)
    assert budget["guarantee"].startswith(stated["words"])
    assert "no tick lasts longer than 1.2" in budget["guarantee"]
    assert replay.main([str(out / "trace.npz")]) == 0


@pytest.mark.slow
def test_a_rehearsal_is_the_same_every_time(rehearsed):
    (first, trace, _), (second, again, _) = rehearsed
    assert trace == again
    assert {k: v for k, v in first.items() if k != "files"} == {k: v for k, v in second.items() if k != "files"}


@pytest.mark.slow
def test_a_rehearsal_shows_the_injected_fault(tmp_path, capsys):
    options = ["--rehearse", "--no-plot", "--duration", "1", "--fault", "axis2:jump=-5@0.5", "--out", str(tmp_path)]
    assert bridge.main(options) == 1
    cause = json.loads((tmp_path / "report.json").read_text())["session"]["cause"]
    assert cause_of(cause).startswith(("jump: 2 ", "jolt: 2 "))
    assert cause in capsys.readouterr().out


def test_unreadable_frames_ask_about_the_baud_rate(scenario):
    session, port = Session(scenario, SafetyLimits((2.0, 2.0))), FakePort()
    driver = Driver(session, SerialDevice(port, lambda: 1e-6 * port.now), lambda ages: (), lambda: port.now)
    session.start(0)
    for _ in range(401):
        driver.turn()
        port.now, port.coming = port.now + 5000, b"\x81\x92noise\x00"
    while session.stage == Stage.CONNECTING:
        driver.turn()
    assert cause_of(session.cause) == "no answer: 2.0 400"
