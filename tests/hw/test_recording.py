"""The trace of a session replays bit by bit, and other or changed traces are refused."""

import json
import re
from contextlib import suppress

import numpy as np
import pytest
from rich.console import Console
from sessions import FAST, rehearsal_of

from haptic_loop.cli import bridge
from haptic_loop.cli import replay as replay_command
from haptic_loop.cli import trace as trace_command
from haptic_loop.design.files import plain
from haptic_loop.hw.control import CertifiedCoupling, CouplingRequest, _fill, certified_coupling
from haptic_loop.hw.emulator import Emulator
from haptic_loop.hw.limits import SafetyLimits, Units
from haptic_loop.hw.monitor import LinkSettings
from haptic_loop.hw.recording import Recorder, _digest, load, replay
from haptic_loop.hw.rehearsal import Rehearsal
from haptic_loop.hw.session import Session, session_for
from haptic_loop.hw.session_report import outcome, save
from haptic_loop.sim.couplings import assessed, choose
from haptic_loop.sim.run import assemble, run
from haptic_loop.sim.scenario import InputError, parse
from haptic_loop.sim.scenario import load as scenario_of
from haptic_loop.sim.stability import close, dominant_mode
from haptic_loop.sim.trace import Trace
from tests.evaluate import decisive


def test_missing_samples_are_filled_by_a_straight_line():
    assert _fill((0.0, 3.0), (3.0, 0.0), 3) == [(1.0, 2.0), (2.0, 1.0), (3.0, 0.0)]
    assert _fill((0.0,), (1.0,), 1) == [(1.0,)]


@pytest.fixture(scope="module")
def trace(scenario, link_couplings, tmp_path_factory):
    """Return the files and the recorder of a session over a line that loses STATEs."""
    recorder = Recorder(2)
    rehearsal = rehearsal_of(scenario, link_couplings, "up:drop=0.05@0.3", recorder=recorder)
    session = rehearsal.run_until_armed(1.0)
    session.stop("enough", session.now)
    rehearsal.run_to_the_end(2.5)
    report = outcome("I", session, recorder, 0)
    out = tmp_path_factory.mktemp("trace")
    return save(out, session, recorder, report, plot=False), recorder


@pytest.mark.slow
def test_a_sessions_trace_loads_as_a_simulations(trace):
    files, recorder = trace
    result = Trace.load_npz(files[0])
    assert result.t.size == len(recorder)
    np.testing.assert_array_equal(np.diff(recorder.link()["tick"]) & 0xFFFF, 1)  # a row for every tick
    assert np.isfinite(result.f).all()
    assert {path.name for path in files} == {"trace.npz", "trace.csv", "report.json"}


@pytest.mark.slow
def test_a_replay_is_identical_bit_by_bit(trace):
    result, link = load(trace[0][0])
    assert 10 < (~link["received"]).sum() < 200
    compared = replay(result, link)
    assert compared.identical
    assert np.abs(link["sent"]).max() > 1000


def test_a_replay_finds_one_changed_bit(trace):
    result, link = load(trace[0][0])
    changed = link["asked"].copy()
    changed.view(np.int64)[100, 1] ^= 1
    compared = replay(result, link | {"asked": changed})
    assert np.flatnonzero(compared.asked).tolist() == [100]
    assert not compared.sent.any()
    x = result.x.copy()
    x[200, 0] += 1e-6
    moved = Trace(result.t, x, result.f, result.x_handle, result.v_handle, result.w, result.meta)
    assert np.flatnonzero(replay(moved, link).asked)[0] == 200


def test_the_replay_command_reports_identical_forces(trace, capsys):
    path = trace[0][0]
    assert replay_command.main([str(path), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["identical"] is True
    with pytest.raises(InputError, match="No such file"):
        replay_command.main(["nowhere.npz"])


def test_a_trace_of_sim_run_is_no_session(scenario, link_couplings, tmp_path):
    simulation = assemble(scenario, link_couplings[0].chosen.coupling)
    path = run(simulation, "exact", ticks=10).save_npz(tmp_path / "trace.npz")
    with pytest.raises(InputError, match="a trace without data of a link"):
        load(path)


def test_broken_recipes_are_bad_input(trace, tmp_path):
    result, _ = load(trace[0][0])
    broken = Trace(
        result.t, result.x, result.f, result.x_handle, result.v_handle, result.w, result.meta | {"replay": {}}
    )
    path = trace[1].save(tmp_path / "trace.npz", broken)
    with pytest.raises(InputError, match="cannot be replayed"):
        replay(*load(path))


def _spoil(path, to, **changes):
    """Write a trace with changed arrays and the digest of these arrays to `to`."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    changed = arrays | {name: change(arrays) for name, change in changes.items()}
    changed.pop("digest")
    np.savez_compressed(to, digest=np.array(_digest(changed)), **changed)
    return to


def _meta(**changes):
    def change(arrays):
        meta = json.loads(str(arrays["meta"]))
        (recipe,) = meta["replay"]
        return np.array(json.dumps(meta | {"replay": [recipe | changes]}))

    return change


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"link_gain": lambda a: a["link_gain"] * 5}, "the gain is 1"),
        ({"link_asked": lambda a: a["link_asked"] * 0, "x": lambda a: a["x"] * np.nan}, "nan, nan N, which is no"),
        ({"meta": lambda a: np.array("[1]")}, "cannot be replayed: list indices"),
        ({"link_arming": lambda a: (a["link_tick"] == a["link_tick"][-1]).astype(int)}, "1 recipes for 2 armings"),
        ({"meta": _meta(force_step=[4e-4])}, "cannot be replayed: "),
        ({"meta": _meta(limits="none")}, "Expected `object`, got `str`"),
        ({"meta": _meta(scenario=None)}, "cannot be replayed: "),
        ({"meta": _meta(link_delay=9)}, "cannot be replayed: "),
    ],
)
def test_spoiled_traces_are_refused_in_one_line(trace, tmp_path, changes, words):
    path = _spoil(trace[0][0], tmp_path / "trace.npz", **changes)
    with pytest.raises(InputError, match=words) as error:
        replay_command.main([str(path)])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name", ["t", "f", "link_tick", "link_margin_us", "link_status", "link_sent", "meta", "digest"]
)
def test_a_trace_changed_by_hand_is_refused(trace, tmp_path, name):
    """A change is refused even where no replayed force would show it, and so is a trace that is cut off."""
    with np.load(trace[0][0]) as archive:
        arrays = {key: archive[key] for key in archive.files}
    other = {"meta": np.array(str(arrays["meta"]).replace("true", "false", 1)), "digest": np.array("")}
    changed = arrays | {name: other[name] if name in other else arrays[name][::-1]}
    cut = {key: values[:-5] if values.ndim else values for key, values in arrays.items()}
    for spoiled in (changed, cut):
        np.savez_compressed(tmp_path / "trace.npz", **spoiled)
        with pytest.raises(InputError, match="was changed after"):
            replay_command.main([str(tmp_path / "trace.npz")])


def test_damaged_traces_raise_only_input_errors(trace, tmp_path):
    with np.load(trace[0][0]) as archive:
        empty = {name: archive[name][:0] if archive[name].ndim else archive[name] for name in archive.files}
    np.savez_compressed(tmp_path / "empty.npz", **empty)
    with pytest.raises(InputError, match="was changed after"):
        replay_command.main([str(tmp_path / "empty.npz")])
    whole = bytearray(trace[0][0].read_bytes())
    for place in range(200, len(whole), len(whole) // 40):
        damaged = whole.copy()
        damaged[place] ^= 0x55
        (tmp_path / "damaged.npz").write_bytes(damaged)
        with suppress(InputError):  # a byte of the archive's padding or of a name may not matter
            replay_command.main([str(tmp_path / "damaged.npz")])


@pytest.mark.parametrize(("cap", "slew"), [(0.3, 2000.0), (12.0, 10.0)])
def test_steady_ticks_end_where_a_force_is_cut(scenario, link_couplings, cap, slew):
    """Steady ticks end 0 to 2 ticks after the session first counts a cut by cap or by slew rate.

    Trace and counters may differ, since a force that is cut by less than a step is sent unchanged.
    """
    recorder = Recorder(2)
    session = Session(scenario, SafetyLimits((cap, cap), slew), FAST)
    cuts = []

    def record(row):
        recorder(row)
        cuts.append(session.counters.clipped + session.counters.slowed)

    session.record = record
    Rehearsal(session, Emulator(scenario), lambda ages: link_couplings).run_until_armed(0.9)
    ((first, stop),) = recorder.steady_ticks(session.units.force_step, session.limits)
    assert (recorder.link()["gain"][first:] == 1.0).all()
    full = np.diff(cuts, prepend=0)[first:]
    assert 0 <= stop - first - int(np.argmax(full > 0)) <= 2
    assert stop - first > 2  # the person begins to move soon after full gain


class FalselyCertified(CertifiedCoupling):
    """A coupling that claims to be certified, so that a session can show growth without a certificate."""

    certified = True


@pytest.mark.slow
@pytest.mark.parametrize(("name", "settles"), [("none", False), (None, True)])
def test_a_trace_tells_the_growth_of_the_loop(scenario, tmp_path, capsys, name, settles):
    """Without coupling the file gives the exact engine's growth rate, to 2e-3 1/s since forces are rounded.

    With the certified coupling nothing grows. Only ticks at full gain before the first cut force count.
    """
    scenario = scenario_of()  # Here people begin slowly, unlike in the fixture's scenario.
    made = certified_coupling(CouplingRequest(scenario), 1) if settles else None
    if made is None:
        chosen = choose(scenario, "I", name, None)
        made = FalselyCertified(1, scenario, "I", chosen, assessed(scenario, "I", chosen))
    recorder = Recorder(2)
    rehearsal = rehearsal_of(scenario, [made], recorder=recorder)
    session = rehearsal.run_until_armed(2.2 if settles else 7.2)
    session.stop("enough", session.now)
    rehearsal.run(1e-6 * session.now + 0.5)
    report = outcome("I", session, recorder, 0)
    assert report.session.stage == ("finished" if settles else "stopped")
    ((first, stop),) = report.run.steady_ticks
    gain = recorder.link()["gain"]
    assert (gain[first:stop] == 1.0).all()
    assert gain[first - 1] < 1.0
    path = save(tmp_path, session, recorder, report, False)[0]
    assert trace_command.main([str(path), "--json", "-"]) == 0
    (part,) = json.loads(capsys.readouterr().out)["growth"]
    assert [part] == plain(report)["growth"]
    if settles:
        assert part["trend"] != "grows"
        return
    simulation = assemble(scenario, made.chosen.coupling)
    exact = dominant_mode(close(simulation.plant, simulation.F))
    assert part["growth_rate_per_s"] == pytest.approx(exact.growth, abs=2e-3)
    assert part["frequency_hz"] == pytest.approx(exact.frequency_hz, abs=1.0)
    assert part["trend"] == "grows"
    bridge._print_session(report, Console(width=200), details=False)
    assert re.search(r"growth at full gain, arming 1, ticks \d+ to \d+ .*: \+1.48", capsys.readouterr().out)


PLANAR = """
name = "planar"
T = 1e-3
theta = [1, 2]
device = [{ kind = "rigid", axes = 2 }, { kind = "rigid", axes = 2 }]
[environment]
contacts = ["left", "right"]
springs = [{ between = ["left", "right"], stiffness = 800.0, damping = 1.0 },
           { between = ["left", "ground"], stiffness = [100.0, 300.0], damping = 0.5 }]
"""


@pytest.mark.slow
def test_sessions_limit_force_vectors(tmp_path):
    """The proof's limiter acts on force vectors, channels keep their names, and a replay computes the same forces."""
    scenario = parse(PLANAR)
    settings = LinkSettings(measure=60, test_encoders=False)
    session, recorder = session_for(scenario, settings, 0.3), Recorder(4)
    session.record = recorder
    made = certified_coupling(CouplingRequest(scenario, condition="any-environment"), 1)
    rehearsal = Rehearsal(session, Emulator(scenario), lambda ages: [made])
    rehearsal.run_until_armed(1.0)
    rehearsal.run(1e-6 * session.now + 0.5)
    asked = np.linalg.norm(recorder.link()["asked"].reshape(-1, 2, 2), axis=2)
    assert 0.3 * (1 - 1e-12) < asked.max() <= 0.3 * (1 + 1e-12)
    result = recorder.trace(session.units, scenario.T, {}, scenario.channel_names)
    lengths = np.linalg.norm(result.f.reshape(-1, 2, 2), axis=2)
    assert 0.299 < lengths.max() <= 0.3 * (1 + 1e-12)
    report = outcome("I", session, recorder, 0)
    path = save(tmp_path, session, recorder, report, False)[0]
    again, link = load(path)
    assert again.names == ("left.x", "left.y", "right.x", "right.y")
    assert (tmp_path / "trace.csv").read_text().startswith("t [s],x left.x [m],x left.y [m]")
    assert replay(again, link).identical


def test_the_report_is_json_and_names_its_end(trace):
    report = json.loads(trace[0][-1].read_text())
    assert report["session"]["stage"] == "finished"
    assert [e["stage"] for e in report["session"]["log"]][-2:] == ["disarming", "finished"]
    assert report["link"]["counters"]["gaps"] > 10
    assert report["link"]["age_us"]["p50"] == pytest.approx(130, abs=1)  # the rehearsal's line takes 130 us
    assert decisive(report)["certified"]


def test_a_session_without_forces_keeps_no_older_files(scenario, link_couplings, tmp_path):
    recorder, old = Recorder(2), [tmp_path / name for name in ("trace.npz", "trace.csv", "figure.png")]
    for file in old:
        file.touch()
    session = rehearsal_of(scenario, link_couplings, recorder=recorder).session
    session.stop("enough", session.now)
    files = save(tmp_path, session, recorder, outcome("I", session, recorder, 0), plot=True)
    assert files == [*tmp_path.iterdir()] == [tmp_path / "report.json"]


def test_an_empty_recording_has_no_ticks():
    recorder = Recorder(2)
    assert recorder.link()["x"].shape == (0, 2)


def test_traces_hold_the_last_known_force(trace):
    """Where no STATE came, the trace shows the last known force."""
    _, recorder = trace
    link = recorder.link()
    result = recorder.trace(Units((1e-6,) * 2, (4e-4,) * 2, (10**5,) * 2), 1.2e-3, {})
    k = int(np.flatnonzero(~link["received"])[0])
    np.testing.assert_array_equal(result.f[k], result.f[k - 1])


def test_sessions_state_damping_axis_by_axis():
    full = PLANAR.replace("axes = 2 }", "axes = 2, damping = [[1.5, 0.4], [0.4, 0.9]] MORE }", 1)
    delta = session_for(parse(full.replace("MORE", "")), LinkSettings()).scenario.delta[:2]
    share = 1 - 0.4 / np.sqrt(1.5 * 0.9)  # the least eigenvalue of [[1, r], [r, 1]]
    np.testing.assert_allclose(delta, [1.5 * share, 0.9 * share], rtol=0, atol=1e-6)  # INFO has whole uN s/m
    assert np.linalg.eigvalsh(np.array([[1.5, 0.4], [0.4, 0.9]]) - np.diag(delta))[0] >= 0
    assert session_for(parse(full.replace("MORE", ", delta = 0.7")), LinkSettings()).scenario.delta[:2] == (0.7, 0.7)
