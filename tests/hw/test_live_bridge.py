"""The bridge drives an emulator in another process through pyserial and a pseudo-terminal, and refuses bad options.

On a busy machine the link may be too slow. So tests that need an armed session repeat it at ever slower paces, and
one attempt must be armed. Every session must end with a named cause, and no device may stay armed.
"""

import fcntl
import json
import os
import select
import signal
import subprocess
import sys
import termios
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from messages import says

from haptic_loop.cli import bridge, identify, replay
from haptic_loop.cli.options import Parser
from haptic_loop.cli.session_cli import add_link_options, check_link
from haptic_loop.controller.delay import VaryingDelay
from haptic_loop.design.files import one_command
from haptic_loop.hw.control import CouplingRequest, certified_coupling
from haptic_loop.hw.driver import Operator
from haptic_loop.hw.haptic_device import PortLost, SerialDevice
from haptic_loop.hw.limits import ENDED, SafetyLimits, Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.protocol import Phase
from haptic_loop.hw.recording import load as read
from haptic_loop.hw.session import Session
from haptic_loop.hw.session_report import IncidentLog
from haptic_loop.hw.transport import Live, SerialPort
from haptic_loop.sim.scenario import InputError
from tests.evaluate import decisive
from tests.pseudo_terminal import EmulatorProcess, emulated
from tests.sessions import rehearsal_of

pytest.importorskip("serial", reason="pyserial is not installed (extra hw)")
ROOT = Path(__file__).parent.parent.parent
PACE = 0.2  # session seconds per real second: the session's time-out of 1 s of silence takes 5 s
PACES = (
    0.3,
    0.2,
    0.1,
    0.1,
    0.05,
    0.02,
    0.01,
)  # paces of successive attempts; at the last, 6 ms without a STATE take 0.6 s
AT_REST = ("silent", "disarmed", "stopped", "estop", "ramp")


@pytest.fixture(scope="module")
def emulator():
    """Run one emulated device for several successive sessions."""
    emulator = EmulatorProcess(f"--pace={PACE}")
    yield emulator
    assert emulator.end()["phase"] in AT_REST


def run(emulator, scenario, plan, watch=lambda session: None, pace=PACE):
    settings = LinkSettings(measure=150, test_encoders=False)  # a short measurement, for busy machines
    session = Session(scenario, SafetyLimits((12.0, 12.0)), settings)
    with SerialPort(emulator.path, 921_600) as port:
        device = SerialDevice(port, lambda: pace * time.monotonic())
        live = Live(session, device, plan, Operator(True, 60.0), watch=watch, pace=pace)
        live.run()
    return session, live


def commanded(capsys, scenario):
    """Run short sessions of the command, slower and slower until one is armed, and return its report."""
    for pace in PACES:
        options = [
            "--arm",
            "--no-dead-man",
            "--no-axis-check",
            "--scenario",
            scenario,
            "--measure",
            "60",
            "--duration",
            "0.1",
        ]
        with emulated("--nobody", f"--pace={pace}", f"--scenario={scenario}") as path:
            live = ["--pace", str(pace), "--port", path, "--no-preflight", "--no-plot", "--json", "-"]
            code = bridge.main([*options, *live])
        report = json.loads(capsys.readouterr().out)
        stage = report["session"]["stage"]
        assert Stage(stage) in ENDED
        assert report["session"]["cause"]
        assert code == (0 if stage == "finished" else 1)
        if report["session"]["armed"]:
            return report
    pytest.fail(f"never armed, at last {stage}: {report['session']['cause']}")


def test_the_command_drives_the_emulator(tmp_path, capsys, monkeypatch):
    """A session over a serial line leaves a report and a trace that replays bit by bit."""
    monkeypatch.chdir(tmp_path)
    report = commanded(capsys, "omega-pair")
    assert decisive(report)["certified"]
    assert replay.main(["out/bridge-I/trace.npz"]) == 0


@pytest.mark.slow
def test_a_world_runs_over_the_serial_line(tmp_path, capsys, monkeypatch):
    """The scene runs in the session behind its energy shell, and the report has the shell's account."""
    monkeypatch.chdir(tmp_path)
    report = commanded(capsys, "world-ball")
    (world,) = report["world"]
    assert report["assessment"]["guarantee"]["energy_J"] == 2e-3
    assert world["ticks"] > 0
    assert world["unsettled_steps"] == 0
    assert world["step_us"]["p50"] > 0
    trace, link = read(next(file for file in report["files"] if file.endswith("trace.npz")))
    assert 0 < link["received"].sum() <= len(trace.x) == report["run"]["samples"]
    assert world["port_least_J"] >= -2e-3 - world["released_J"]
    assert world["given_J"] <= 2e-3 + world["released_J"]


@pytest.mark.validate
def test_interrupts_ramp_out_and_exit_130(tmp_path, capsys, monkeypatch):
    """After SIGINT the command lowers the gain to zero in 100 ms of session time and exits with 130."""
    monkeypatch.chdir(tmp_path)
    look = IncidentLog.update

    def update(incidents, session):
        look(incidents, session)
        if session.stage == Stage.ARMED and session.gain == 1.0 and not sent:
            sent.append(session.stage)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(IncidentLog, "update", update)
    for pace in PACES:
        sent = []
        options = [
            "--arm",
            "--no-dead-man",
            "--no-axis-check",
            "--case",
            "I",
            "--duration",
            "20",
            "--measure",
            "60",
            "--pace",
            str(pace),
        ]
        with emulated("--nobody", f"--pace={pace}") as path:
            code = bridge.main([*options, "--port", path, "--no-preflight", "--no-plot", "--json", "-"])
        report = json.loads(capsys.readouterr().out)
        if sent and report["session"]["stage"] == "finished":  # otherwise the machine was too busy
            break
    else:
        pytest.fail(f"never armed and interrupted, at last {report['session']}")
    assert code == 130
    assert report["session"]["cause"] == "SIGINT"
    gain = np.load("out/bridge-I/trace.npz")["link_gain"]
    falling = gain[int(np.flatnonzero(gain == 1.0)[-1]) :]
    falling = falling[falling > 0]  # ticks at gain 0, in which the motors are tested again, are not part of the ramp
    assert falling.size * 1.2e-3 == pytest.approx(0.1, abs=0.01)  # [s]
    assert (np.diff(falling) < 0).all()
    assert falling[-1] < 0.02


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("SIGINT", Stage.FINISHED),
        pytest.param("SIGTERM", Stage.FINISHED, marks=pytest.mark.slow),
        ("SIGUSR1", Stage.ESTOP),
    ],
)
def test_signals_end_sessions_while_forces_act(scenario, name, stage):
    """In virtual time SIGINT and SIGTERM end a session by a ramp longer than 90 ms, SIGUSR1 by a latched e-stop."""

    def watch(session):
        if session.stage == Stage.ARMED and not sent:
            sent.append(name)
            signal.raise_signal(getattr(signal, name))

    sent, plan = [], lambda ages: [certified_coupling(CouplingRequest(scenario), 2)]
    rehearsal = rehearsal_of(scenario, ())
    session = rehearsal.session
    live = Live(session, rehearsal._driver.device, plan, Operator(True, 20.0), watch=watch)
    live.clock = lambda: round(rehearsal.now)
    live.run()
    stages, ended = [event.stage for event in session.log], rehearsal.emulator.device.phase
    assert ended.name.lower() in AT_REST
    assert session.cause == name
    if stage == Stage.ESTOP:
        assert stages[-2:] == [Stage.ARMED, Stage.ESTOP]
        assert ended == Phase.ESTOP
        return
    assert stages[-3:] == [Stage.ARMED, Stage.DISARMING, Stage.FINISHED]
    at = {event.stage: event.t_us for event in session.log}
    assert 1e-6 * (at[Stage.FINISHED] - at[Stage.DISARMING]) > 0.09  # [s] on the session's clock


def test_a_second_signal_names_both(scenario):
    def watch(session):
        if session.stage == Stage.ARMED and not live.signals:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGHUP)

    plan = lambda ages: [certified_coupling(CouplingRequest(scenario), 2)]  # noqa: E731
    rehearsal = rehearsal_of(scenario, ())
    live = Live(rehearsal.session, rehearsal._driver.device, plan, Operator(True, 20.0), watch=watch)
    live.clock = lambda: round(rehearsal.now)
    session = live.run()
    assert (session.stage, session.cause) == (Stage.STOPPED, "SIGTERM, then SIGHUP")
    assert rehearsal.emulator.device.phase.name.lower() in AT_REST


def test_a_lost_port_is_named():
    master, slave = os.openpty()
    with SerialPort(path := os.ttyname(slave), None) as port:
        os.close(master)
        for call in (port.read, lambda: port.write(b"x")):
            with pytest.raises(PortLost, match=f"^port {path} cannot be "):
                call()
    os.close(slave)


@pytest.mark.parametrize("port", ["/nowhere", "force-dimension"])
def test_a_missing_port_leaves_no_files(port, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "forcedimension_core", None)
    with one_command(), pytest.raises(InputError, match=f"--port {port}"):
        bridge.main(["--port", port, "--arm", "--no-dead-man", "--out", str(tmp_path / "a/b")])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name", ["SIGINT", *(pytest.param(f"SIG{n}", marks=pytest.mark.slow) for n in ("TERM", "QUIT"))]
)
def test_a_signal_ends_a_session_at_zero_force(emulator, scenario, link_couplings, name):
    def watch(session):
        if session.stage == Stage.MEASURING and not sent:
            sent.append(name)
            signal.raise_signal(getattr(signal, name))

    sent = []
    session, live = run(emulator, scenario, lambda ages: link_couplings, watch=watch)
    assert (session.stage, session.cause) == (Stage.STOPPED, f"{name}, before any force acted")
    assert live.signals == [getattr(signal, name)]


class BridgeOnTerminal:
    """Run hw.bridge on its own terminal, with a measurement that outlasts the test: nothing is armed."""

    def __init__(self, out, port):
        self.master, self.slave = os.openpty()
        self.before = termios.tcgetattr(self.slave)
        options = [
            "--port",
            port,
            "--no-preflight",
            "--case=I",
            "--pace=0.05",
            "--measure=100000",
            "--no-plot",
            f"--out={out}",
        ]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "hw.bridge", *options],
            env=os.environ | {"PYTHONPATH": str(ROOT), "TERM": "xterm"},
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )

    @property
    def settings(self):
        return termios.tcgetattr(self.slave)

    def read_until(self, word, patience=120.0):
        """Return the output until it contains `word`, the process ends, or `patience` [s] have passed."""
        shown, end = b"", time.monotonic() + patience
        while word not in shown and time.monotonic() < end:
            if select.select([self.master], [], [], 0.05)[0]:
                shown += os.read(self.master, 65536)
            elif self.process.poll() is not None:
                break
        return shown

    def close(self):
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.mark.slow
def test_a_signal_leaves_the_terminal_as_it_was(tmp_path):
    """Bridges that read single keys restore the terminal after SIGQUIT (typed Ctrl-\\) and SIGHUP."""
    names = ("SIGQUIT", "SIGHUP")
    with ExitStack() as devices:
        ports = [devices.enter_context(emulated("--pace=0.05")) for _ in names]
        bridges = {name: BridgeOnTerminal(tmp_path / name, port) for name, port in zip(names, ports, strict=True)}
        for bridge_on in bridges.values():
            devices.callback(bridge_on.close)
        for bridge_on in bridges.values():
            assert b"measuring" in bridge_on.read_until(b"measuring")
            assert not bridge_on.settings[3] & (termios.ICANON | termios.ECHO)
        os.write(bridges["SIGQUIT"].master, b"\x1c")
        os.kill(bridges["SIGHUP"].process.pid, signal.SIGHUP)
        for name, bridge_on in bridges.items():
            shown = bridge_on.read_until(b"files: ")
            assert bridge_on.process.wait(60) == 130
            assert name.encode() in shown
            assert bridge_on.settings == bridge_on.before


@pytest.mark.parametrize(
    "paces",
    [pytest.param((0.5,), marks=pytest.mark.slow), pytest.param((1.0, *PACES), marks=pytest.mark.validate)],
    ids=["once", "all"],
)
def test_a_device_is_identified_over_the_line(tmp_path, paces):
    """Sweeps of 0.5 s give bounds up to the device's 1.37 N s/m, or the report names dry friction as the reason."""
    for pace in paces:
        options = ["--arm", "--no-dead-man", "--no-axis-check", "--seconds", "0.5", "--travel", "10", "--measure", "60"]
        options += ["--sittings", "1"]
        with emulated("--nobody", f"--pace={pace}") as path:
            identify.main([*options, "--port", path, "--pace", str(pace), "--out", str(tmp_path)])
        report = json.loads((tmp_path / "report.json").read_text())
        if report["session"]["log"][-1]["stage"] == "finished" and "without a STATE" not in report.get("reason", ""):
            break
    else:  # The machine is too busy: every session ended because a message was late.
        late = "no new STATE", "by the host's clock", "without a STATE", "cause watchdog", "never arrived"
        assert any(words in report["reason"] for words in late)
        assert len(paces) == 1
        pytest.skip("the machine is too busy for a session in real time")
    assert report["axes"] or "dry friction" in report["reason"]
    assert all(0 < axis["friction"]["delta"] <= 1.37 for axis in report["axes"])


class Designing:
    """A session that waits for a coupling, with no device."""

    stage, measurement = Stage.MEASURED, SimpleNamespace(result=None)

    def load(self, link_couplings, now):
        self.stage = Stage.DISARMED if self.stage == Stage.MEASURED else self.stage
        return ()

    def arm(self, now):
        raise AssertionError("a key that was typed during the design armed the device")

    def stop(self, cause, now):
        self.stage = Stage.FINISHED
        return ()


@pytest.mark.parametrize(("typed", "stage"), [(b"a", Stage.DISARMED), (b"aq", Stage.FINISHED)])
def test_keys_typed_during_design_do_not_arm(typed, stage):
    """Keys typed during the design are read before arming is possible: `a` has no effect, `q` ends the session."""
    keyboard, person = os.pipe()
    session = Designing()

    def plan(ages):
        os.write(person, typed)
        return []

    live = Live(session, None, plan, Operator(False, 1.0), keyboard)
    live.load()
    assert select.select([keyboard], [], [], 0)[0] == []
    assert session.stage == stage
    os.close(person)
    live._act_on_keys()  # the terminal is gone
    assert live.signals == [signal.SIGHUP]
    os.close(keyboard)


def test_ctrl_c_ends_a_running_design(emulator, scenario):
    def plan(ages):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            time.sleep(0.01)
        raise AssertionError("the design went on")

    session, live = run(emulator, scenario, plan)
    assert (session.stage, session.cause) == (Stage.REFUSED, "SIGINT during the design")
    assert live.signals == [signal.SIGINT]


def test_an_exception_in_the_design_is_raised_again(emulator, scenario):
    def plan(ages):
        raise ZeroDivisionError("a mistake of ours")

    with pytest.raises(ZeroDivisionError):
        run(emulator, scenario, plan)


def test_uncertified_couplings_are_not_armed(emulator, scenario):
    def plan(ages):
        return [certified_coupling(CouplingRequest(scenario, name="published"), 1)]

    session, _ = run(emulator, scenario, plan)
    assert session.stage == Stage.REFUSED
    assert "published" in session.cause


def test_a_refusal_is_the_first_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert bridge.main(["--rehearse", "--coupling", "none", "--no-plot", "--measure", "100"]) == 1
    assert capsys.readouterr().out.splitlines()[0].count("the session is refused, ") == 1


@pytest.mark.slow
def test_a_pulled_cable_ends_the_session(scenario, link_couplings):
    emulator = EmulatorProcess("--fault=unplug@0.05", f"--pace={PACE}")
    session, _ = run(emulator, scenario, lambda ages: link_couplings)
    assert session.stage in (Stage.LOST, Stage.STOPPED)
    assert session.cause
    assert emulator.end(patience=120.0)["phase"] in AT_REST


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "either --port PATH or --rehearse"),
        (["--rehearse", "--port", "x"], "either --port PATH or --rehearse"),
        (["--port", "/dev/null", "--fault", "drop"], "--fault is allowed only with --rehearse"),
        (["--port", "/nowhere", "--arm", "--no-dead-man"], "--port /nowhere"),
        (["--port", "/nowhere", "--arm"], "--deadman key needs a terminal"),
        (["--port", "/nowhere", "--arm", "--no-dead-man", "--deadman", "device"], "--no-dead-man contradicts"),
        (["--rehearse", "--case", "none"], "no coupling"),
        (["--rehearse", "--baud", "5"], "--baud is 5"),
        (["--rehearse", "--baud", "no"], "--baud is 'no'"),
        (["--rehearse", "--quantile", "2"], "--quantile is 2"),
        (["--rehearse", "--guard", "nan"], "--guard is nan"),
        (["--rehearse", "--measure", "1"], "--measure is 1"),
        (["--rehearse", "--duration", "0"], "--duration is 0"),
        (["--port", "x", "--pace", "2"], "--pace is 2 .. 0.01 to 1"),
        (["--rehearse", "--T", "0.05"], "T is 0.05 s"),
        (["--rehearse", "--T", "0.006"], "at most 0.004 s: the host's watchdog is five ticks"),
        (["--rehearse", "--fault", "nonsense"], "--fault is 'nonsense'"),
        (["--rehearse", "--fault", "late=1.5"], "--fault late=1.5: VALUE is 1.5"),
        (["--rehearse", "--continuous-force", "-1"], "--continuous-force is -1 .. 0.001 to 12"),
        (["--port", "/dev/a,", "--arm", "--no-dead-man"], "--port is '/dev/a,': path 2 of 2 is empty"),
        (["--rehearse", "--fault", "freeze@0.5+1"], "freeze does not end, so it takes no DURATION"),
    ],
)
def test_bad_input_is_named(options, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        bridge.main(options)
    assert says(error.value, words)


@pytest.mark.parametrize(
    ("options", "baud"),
    [
        (["--rehearse"], None),
        (["--rehearse", "--baud", "115200"], 115_200),
        (["--port", "/dev/ttyACM0", "--arm"], 921_600),  # may be an Uno, with a UART behind its USB chip
        (["--port", "/dev/ttyACM0", "--arm", "--baud", "none"], None),
        (["--port", "/dev/ttyUSB0", "--arm", "--baud", "2000000"], 2_000_000),
    ],
)
def test_only_a_uart_has_a_baud_rate(options, baud):
    parser = Parser("x", "", "")
    add_link_options(parser)
    assert check_link(parser.parse_args(options)).baud == baud


def test_a_pseudo_terminal_needs_no_baud_rate(tmp_path):
    """The port opens without a baud rate, by the terminal's name or by a link as socat makes it."""
    master, slave = os.openpty()
    link = tmp_path / "haptic"
    link.symlink_to(os.ttyname(slave))
    parser = Parser("x", "", "")
    add_link_options(parser)
    for path in (os.ttyname(slave), str(link)):
        settings = check_link(parser.parse_args(["--port", path, "--arm"]))
        assert settings.baud is None
        with SerialPort(path, settings.baud) as port:
            assert port.write(b"\x01") == 1
            assert os.read(master, 1) == b"\x01"
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(("first", "stages"), [([], []), (["--no-preflight"], ["measured", "refused"])])
def test_lost_lines_refuse_a_session(first, stages, tmp_path):
    """If the first lines, of the preflight or of the certificate, cannot be printed, no device is armed."""
    options = ["--arm", "--no-dead-man", "--no-axis-check", "--measure", "60", "--duration", "0.1", "--pace", "0.05"]
    with emulated("--nobody", "--pace=0.05") as path, open("/dev/full", "w") as full:
        words = [sys.executable, "-m", "hw.bridge", "--port", path, *options, *first, "--out", str(tmp_path)]
        ended = subprocess.run(words, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert ended.returncode == 2
    assert ended.stderr.splitlines()[-1] == "error: standard output: No space left on device"
    _, *entries = map(json.loads, (tmp_path / "incidents.jsonl").read_text().splitlines())
    assert [entry["stage"] for entry in entries][-2:] == stages


def test_too_long_sessions_of_scenarios_are_refused(tmp_path):
    path = tmp_path / "long.toml"
    scenario = (ROOT / "sim/scenarios/omega-pair.toml").read_text()
    path.write_text(scenario.replace("duration = 15.0", "duration = 4000"))
    with pytest.raises(InputError, match=r"^duration = 4000 s in scenario omega-pair; a session lasts 0\.1 to 3600 s"):
        bridge.main(["--rehearse", "--scenario", str(path), "--out", str(tmp_path / "out")])


@pytest.mark.parametrize("module", [bridge, identify])
def test_varying_delays_of_scenarios_are_refused(module, scenario, tmp_path, monkeypatch):
    """The link has its own delays, so a scenario's [varying_delay] is refused instead of ignored."""
    monkeypatch.setattr(
        module.options, "scenario_from", lambda args: scenario.replace(varying_delay=VaryingDelay((1, 1), (2, 2)))
    )
    with pytest.raises(InputError, match=r"varying_delay: hw\.\w+ does not simulate varying delays"):
        module.main(["--rehearse", "--out", str(tmp_path)])
