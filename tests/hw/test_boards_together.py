"""One session runs two boards with two clocks: the paper's pair of devices with delays of 1 and 2 samples."""

import json
import os
import re
import select
from types import SimpleNamespace

import numpy as np
import pytest
from sessions import in_fork, inject_faults
from shared import checkered

from haptic_loop.cli import bridge, identify, session_cli
from haptic_loop.hw import boards, transport
from haptic_loop.hw.boards import ticks_behind
from haptic_loop.hw.control import CLOCK_TOLERANCE, CouplingRequest, certified_coupling
from haptic_loop.hw.emulator import Emulator, FaultInjection, info_of, nobody
from haptic_loop.hw.limits import ENDED, SafetyLimits, Stage
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.recording import Recorder, load, replay
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session
from haptic_loop.hw.session_report import outcome, save
from haptic_loop.sim.scenario import InputError
from haptic_loop.sim.scenario import load as load_scenario
from tests.pseudo_terminal import Terminal

BEHIND = (0, 1)  # ticks by which forces of each channel act later than the link's delay
SLIP_SOON = 1020.0  # [us] first tick of the second board; its clock, 100 ppm off, slips a tick soon after full gain


@pytest.fixture(scope="module")
def alone(scenario):
    """Return a scenario of one device for each emulator."""
    one = load_scenario("one-wall").replace(T=scenario.T)
    each = zip(scenario.device, scenario.human, scenario.delta, strict=True)
    return [one.replace(device=(device,), human=(human,), delta=(delta,)) for device, human, delta in each]


@pytest.fixture(scope="module")
def couplings(scenario):
    return (certified_coupling(CouplingRequest(scenario, behind=BEHIND), 1),)


def rehearsal_of(scenario, alone, couplings, clock=1.0, faults=((), ()), begin_us=300.0, infos=(None, None), **options):
    parsed = [tuple(map(FaultInjection.parse, texts)) for texts in faults]
    session = Session(scenario, SafetyLimits((12.0, 12.0)), LinkSettings(measure=450, behind=BEHIND))
    first, second = (Emulator(*each) for each in zip(alone, parsed, infos, strict=True))
    further = [(second, clock, parsed[1], begin_us)]
    return Rehearsal(session, first, lambda ages: couplings, parsed[0], further=further, **options)


def watched(emulator):
    """Return {tick number of the board: (count, force in steps)}, which fills at every tick of the emulated board."""
    ticks, tick = {}, emulator.device.tick

    def noted(now, counts):
        steps, data = tick(now, counts)
        ticks[emulator.device.k] = counts[0], steps[0]
        return steps, data

    emulator.device.tick = noted
    return ticks


@pytest.mark.slow
@pytest.mark.parametrize("deaf", [pytest.param(0, marks=pytest.mark.validate), 1])
def test_one_deaf_board_keeps_a_session_from_finishing(scenario, alone, couplings, deaf):
    """A deaf board ignores messages and keeps its force; the other one rests, which must not hide this force."""
    faults = [(), ()]
    faults[deaf] = ("stuck@0.1",)
    stop = (0.4, lambda session, now: session.stop("asked to", now))
    rehearsal = rehearsal_of(scenario, alone, couplings, faults=faults, actions=[stop])
    assert rehearsal.run_until_armed(1.2).stage == Stage.STOPPED


@pytest.mark.slow
def test_two_clocks_keep_the_energy_account(scenario, alone, couplings, tmp_path):
    """Across a slip of the clocks forces stay 1 and 2 ticks old, and the host's energies equal those at the devices."""
    rehearsal = rehearsal_of(scenario, alone, couplings, 1.0001, begin_us=SLIP_SOON)
    session, rows = rehearsal.session, []
    session.record = lambda row: (rows.append(row), recorder(row))
    recorder = Recorder(2)
    ticks = [watched(rehearsal.emulator), watched(rehearsal.further[0][0])]
    rehearsal.run_until_armed(1.2)
    assert session.stage == Stage.ARMED
    (coupling,) = couplings
    assert (coupling.scenario.theta, coupling.link) == ((1, 2), 1)
    assert coupling.scenario.T_max == 1.2e-3 * (1 + CLOCK_TOLERANCE)
    assert session.counters.late == session.counters.gaps == 0
    assert session.missed_while_driving <= 1  # only the first tick after CONFIG may be missed
    steps = [row.tick for row in rows]
    assert np.diff(steps).tolist() == [1] * (len(rows) - 1)
    for axis, theta, slips in ((0, 1, 0), (1, 2, 1)):  # slips: session ticks without a tick of this board
        counts, sent = ([row.state.counts[axis] for row in rows], [row.sent[axis] for row in rows])
        begun = next(k for k in range(len(rows)) if sent[k]) + theta
        host = sum(sent[k - theta] * (counts[k + 1] - counts[k]) for k in range(begun, len(rows) - 1))
        own = ticks[axis]
        first = next(tick for tick in sorted(own) if own[tick][1])
        last = first + len(rows) - 1 - begun - slips
        assert own[last][0] == counts[-1]
        assert sum(own[k][1] * (own[k + 1][0] - own[k][0]) for k in range(first, last)) == host != 0
    session.stop("asked to", session.now)
    rehearsal.run(1e-6 * rehearsal.now + 0.5)
    assert session.stage == Stage.FINISHED
    save(tmp_path, session, recorder, outcome("I", session, recorder, 0), plot=False)
    assert replay(*load(tmp_path / "trace.npz")).identical


ENDING = ["unplug", "up:drop=1", "down:drop=1", "stall=0.03", "trip", "estop", "jump=5"]


@pytest.fixture(scope="module")
def armed(scenario, alone, couplings):
    """Return a rehearsal 0.59 s after arming."""
    rehearsal = rehearsal_of(scenario, alone, couplings)
    rehearsal.run_until_armed(0.59)
    return rehearsal


@pytest.mark.slow
@pytest.mark.parametrize(("board", "fault"), checkered([0, 1], ENDING))
def test_a_fault_of_one_board_stops_both(armed, board, fault):
    """A fault of either board or link ends the session, and both motors are at zero within 50 ms."""

    def run():
        inject_faults(armed, f"{fault}@0.6", board=board)
        armed.run_until_armed(0.7)
        assert armed.session.stage in ENDED - {Stage.FINISHED}
        assert max(armed.zero_after(0.6), 0) < 0.05
        for emulator in (armed.emulator, armed.further[0][0]):
            assert not emulator.applied.any()

    in_fork(run)


@pytest.mark.parametrize(
    ("clock", "begin_us", "cause"),
    [
        (0.9995, 300.0, "board 2: its clock is 500 ppm faster .*exchange the ports"),
        (1.01, 300.0, "board 2: its clock is 0.99 % slower"),
    ],
)
def test_clocks_that_are_not_covered_prevent_forces(scenario, alone, couplings, clock, begin_us, cause):
    rehearsal = rehearsal_of(scenario, alone, couplings, clock, begin_us=begin_us)
    rehearsal.run_until_armed(0.1)
    assert rehearsal.session.stage == Stage.STOPPED
    assert not any(moment.applied.any() for moment in rehearsal.moments)
    assert re.match(cause, rehearsal.session.cause)


@pytest.mark.slow
def test_a_faster_clock_stops_forces(scenario, alone, couplings, monkeypatch):
    """Without the comparison of clocks, the session stops before an answer is late."""
    monkeypatch.setattr(boards, "_COMPARED", 10**6)
    rehearsal = rehearsal_of(scenario, alone, couplings, 0.998, begin_us=300.0)
    rehearsal.run_until_armed(1.5)
    assert rehearsal.session.cause.startswith("board 2: its clock is faster than that of the board that leads")
    assert rehearsal.session.counters.late == 0
    assert not any(emulator.applied.any() for emulator in (rehearsal.emulator, rehearsal.further[0][0]))


def test_each_link_is_timed_by_itself(scenario, alone, couplings):
    """Waiting for the other board's sample does not add to the age of an answer."""
    rehearsal = rehearsal_of(scenario, alone, couplings, faults=((), ("up:delay=0.0003",)))
    rehearsal.run_until_armed(0.0)
    first, second = rehearsal._driver.device.ages
    assert (set(first), set(second)) <= ({129, 130, 131}, {429, 430, 431})
    assert rehearsal.session.measurement.result.median in (429, 430, 431)


def test_boards_that_differ_are_refused(scenario, alone, couplings):
    info = info_of(alone[1])._replace(period_ns=1_000_000)
    rehearsal = rehearsal_of(scenario, alone, couplings, infos=(None, info))
    rehearsal.run(0.1)
    assert rehearsal.session.cause.startswith("board 2 has version 2, 1000000 ns, axes: 1; expected version 2, 1200000")


def test_the_board_with_the_least_delay_leads():
    assert ticks_behind((1, 2), (1, 1)) == (0, 1)
    assert ticks_behind((2, 2, 1), (2, 1)) == (1, 1, 0)


class _Terminals:
    """Connect two real pseudo-terminals to two emulated boards in virtual time."""

    def __init__(self, rehearsal, monkeypatch):
        self.rehearsal, self.ends = rehearsal, [Terminal(), Terminal()]
        self.sent = [0, 0]  # bytes on their way to each board
        write = transport.SerialPort.write

        def counted(port, data):
            self.sent[self.ports.index(port._serial.port)] += len(data)
            return write(port, data)

        virtual = SimpleNamespace(monotonic=lambda: 1e-6 * rehearsal.now, monotonic_ns=lambda: int(1e3 * rehearsal.now))
        monkeypatch.setattr(transport.SerialPort, "write", counted)
        monkeypatch.setattr(transport, "time", virtual)
        monkeypatch.setattr(session_cli, "time", virtual)
        monkeypatch.setattr(session_cli, "_wait_for_any", self.wait)
        self.ports = [end.path for end in self.ends]

    def wait(self, ports, seconds):
        cables = self.rehearsal._cables
        for i, (end, cable) in enumerate(zip(self.ends, cables, strict=True)):
            data = b""
            while len(data) < self.sent[i]:
                select.select([end.master], [], [], 1.0)
                data += end.read()
            self.sent[i] = 0
            cable.write(data)
        self.rehearsal.wait(seconds)
        for end, cable in zip(self.ends, cables, strict=True):
            if data := cable.read():
                os.write(end.master, data)
                select.select([end._slave], [], [], 1.0)


@pytest.mark.slow
def test_the_command_runs_over_two_serial_ports(scenario, alone, couplings, monkeypatch, capsys, tmp_path):
    """In virtual time, the command runs over pyserial, two pseudo-terminals and clocks that differ by 100 ppm."""
    pytest.importorskip("serial", reason="pyserial is not installed (extra hw)")
    rehearsal = rehearsal_of(scenario, [nobody(one) for one in alone], (), 1.0001, begin_us=SLIP_SOON)
    ports = _Terminals(rehearsal, monkeypatch).ports

    def certified(request, link):
        assert (link, request.behind) == (1, BEHIND)
        return couplings

    monkeypatch.setattr(bridge, "certified_couplings", certified)
    options = ["--arm", "--no-dead-man", "--no-axis-check", "--no-preflight", "--no-plot", "--case=I", "--measure=450"]
    code = bridge.main([*options, f"--port={','.join(ports)}", "--duration=0.3", f"--out={tmp_path}", "--json=-"])
    told = capsys.readouterr()
    report = json.loads(told.out)
    assert (code, report["session"]["stage"]) == (0, "finished"), report["session"]
    assert report["assessment"]["guarantee"]
    for path in ports:
        assert re.search(f"{path}: answers are (129|130) us old", told.err)
    assert rehearsal.emulator.device.run == rehearsal.further[0][0].device.run > 0


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--port=/dev/a,/dev/b,/dev/c"], "3 ports, the scenario 2 devices"),
        (["--port=/dev/a,/dev/b", "--latch=arrival"], "--latch arrival needs one clock for all devices"),
        (["--port=/dev/a,/dev/b", "--energy-budget=0.1"], "--energy-budget needs one clock for all devices"),
    ],
)
def test_what_two_clocks_do_not_cover_is_refused(options, word):
    with pytest.raises(InputError, match=re.escape(word)):
        bridge.main(["--arm", "--no-dead-man", *options])


def test_boards_are_identified_one_at_a_time():
    with pytest.raises(InputError, match="one board at a time"):
        identify.main(["--arm", "--port=/dev/a,/dev/b"])
