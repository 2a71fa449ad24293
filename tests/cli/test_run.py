"""sim.run reports the expected figures, writes its files, and answers bad input with one line and exit code 2.

Expected figures are rounded. A tolerance without a comment allows for the rounding.
"""

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import forked
import msgspec
import numpy as np
import pytest
from evaluate import reported
from messages import says

from haptic_loop.cli.options import name_of, place
from haptic_loop.cli.run import _crossed, _parser, main
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.certificate import prove
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.design.designs import design_by_kind, usual_condition
from haptic_loop.design.files import one_command, read, remove
from haptic_loop.design.result import ANY, HERE
from haptic_loop.sim import couplings
from haptic_loop.sim import run as loop
from haptic_loop.sim.accuracy import CrossCheck
from haptic_loop.sim.scenario import SCENARIOS, InputError, load
from haptic_loop.sim.trace import Trace
from tests.evaluate import decisive, needs, safe_with

ROOT = Path(__file__).parents[2]
SECTIONS = {"case", "scenario", "assessment", "stability", "run", "error", "files"}


def run(tmp_path, *options):
    return reported(main, tmp_path, *options, "--out", str(tmp_path / "out"))


def test_case_none_reproduces_figure_5(tmp_path):
    code, report = run(tmp_path, "--case", "none", "--no-plot")
    stability = report["stability"]
    assert code == 0
    assert decisive(report)["required_damping"] == pytest.approx([1.7229] * 2, rel=1e-4)
    assert not decisive(report)["certified"]
    assert report["assessment"]["guarantee"] is None
    assert stability["verdict"] == stability["exact_verdict"] == "unstable"
    assert stability["exact_growth_rate_per_s"] == pytest.approx(1.481, abs=1e-3)
    assert stability["growth_rate_per_s"] == pytest.approx(1.481, abs=1e-3)
    assert stability["frequency_hz"] == pytest.approx(83.9, abs=0.2)
    assert stability["clipped_ticks"] > 1000
    assert report["error"]["position_relative_rms"] is None
    assert "clips from" in report["error"]["reason"]
    trace = Trace.load_npz(tmp_path / "out" / "trace.npz")
    assert np.abs(trace.f).max() == 12.0


def test_rows_name_clipping_only_where_forces_clip(tmp_path, capsys):
    for options, clips in ((("--case", "none"), True), (("--duration", "1"), False)):
        run(tmp_path, *options, "--no-plot")
        assert ("ideal force, before" in capsys.readouterr().out) is clips


def test_tables_come_before_the_picture(tmp_path, monkeypatch, capsys):
    def interrupted(*picture):
        raise KeyboardInterrupt

    monkeypatch.setattr("haptic_loop.sim.plots.save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        main(["--coupling", "published", "--duration", "0.1", "--out", str(tmp_path)])
    assert "growth, eigenvalues" in capsys.readouterr().out
    assert not (tmp_path / "report.json").exists()


def test_the_default_is_the_design_for_this_environment(tmp_path):
    """A design for this environment is more exact: one for any environment renders only half of its stiffness."""
    code, report = run(tmp_path, "--case", "I", "--duration", "10", "--no-plot")
    assert code == 0
    assert report["assessment"]["condition"] == "this-environment"
    assert decisive(report)["proof"] == "rational"
    assert safe_with(report) == HERE
    assert report["ideal_force"]["error_percent"] == pytest.approx(15.06, abs=0.1)
    assert report["credible"]["until_s"] is None


def test_several_environments_default_to_any_environment(tmp_path):
    """Loops with walls or ranges default to any-environment, which covers more environments."""
    assert all(usual_condition(load(name).loop("I")) == "any-environment" for name in ("one-wall", "omega-pair-ranges"))
    _, report = run(tmp_path, "--scenario", "one-wall", "--no-plot", "--duration", "0.5")
    assert report["assessment"]["condition"] == "any-environment"


def test_case_i_is_designed_certified_and_proved(tmp_path):
    code, report = run(tmp_path, "--case", "I", "--condition", "any-environment", "--paper")
    assert code == 0
    assert set(report) >= SECTIONS
    assert report["kind"] == "spring-damper"
    assert report["assessment"]["coupling"]["K"] == pytest.approx([878.77, 551.88], rel=1e-4)
    assert report["assessment"]["condition"] == "any-environment"
    assert decisive(report)["certified"]
    assert decisive(report)["proof"] == "rational"
    assert safe_with(report) == ANY
    assert report["stability"]["verdict"] == "stable"
    assert report["stability"]["clipped_ticks"] == 0
    assert report["error"]["position_relative_rms"] < 1e-7
    assert all(Path(name).is_file() for name in report["files"])
    assert report["paper"][-1]["what"].startswith("Figure 6")
    assert report["paper"][-1]["why"].startswith("agrees")


def test_published_gains_are_refused_by_their_own_condition(tmp_path):
    _, report = run(tmp_path, "--coupling", "published", "--no-plot", "--engine", "exact")
    assert decisive(report)["required_damping"] == pytest.approx([7.63, 7.84], abs=0.005)
    assert needs(report, "this-environment")["required_damping"] == pytest.approx([1.3987] * 2, rel=1e-4)
    assert report["stability"]["exact_growth_rate_per_s"] == pytest.approx(-0.939, abs=1e-3)
    assert report["stability"]["exact_frequency_hz"] == pytest.approx(83.8, abs=0.1)
    assert any("5.72 times the damping" in line for line in report["remarks"])


@pytest.mark.parametrize(
    ("command", "words"),
    [("run", "--engine exact --integrator RK4"), ("run", "--engine exact --substeps 4"),
     ("validate", "--environments ranges")],
)  # fmt: skip
def test_impossible_settings_are_refused_before_designs(command, words, monkeypatch):
    """Settings are checked before the design, which may take minutes."""
    module = import_module(f"haptic_loop.cli.{command}")
    monkeypatch.setattr(module, "chosen_by", lambda *arguments: pytest.fail("a coupling was designed"))
    with pytest.raises(InputError, match=words.split()[-2]):
        module.main(words.split())


@pytest.mark.slow
def test_three_own_devices_are_certified(tmp_path):
    code, report = run(tmp_path, "--scenario", "three-rigid", "--no-plot", "--duration", "2")
    assert code == 0
    assert len(report["assessment"]["coupling"]["K"]) == 3
    assert decisive(report)["certified"]


def test_a_zero_damping_device_is_reported_not_certified(tmp_path):
    _, report = run(tmp_path, "--coupling", "published", "--delta", "0", "--no-plot", "--duration", "1")
    assert decisive(report)["required_damping"] == [None, None]
    assert "no damping" in decisive(report)["reason"]


def test_a_second_run_writes_the_same_files(tmp_path):
    """Only the times that the run took may differ, in the report and in the trace's record."""
    first, second = {}, {}
    for files in (first, second):
        _, report = run(tmp_path, "--duration", "0.5", "--coupling", "published")
        files |= {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
        ran = report["run"]
        assert ran.pop("real_time_factor") == pytest.approx(ran["duration_s"] / ran.pop("wall_s"))
        forces = Trace.load_npz(tmp_path / "out" / "trace.npz").f.tobytes()
        files |= {"report.json": report, "trace.npz": forces}
    assert sorted(first) == ["figure.png", "report.json", "scene.xml", "trace.csv", "trace.npz"]
    assert first == second
    table = np.genfromtxt(tmp_path / "out" / "trace.csv", delimiter=",", names=True)
    trace = Trace.load_npz(tmp_path / "out" / "trace.npz")
    np.testing.assert_allclose(table["x1_m"], trace.x[:, 0], rtol=1e-8)
    assert trace.meta["case"] == "I"


@pytest.mark.slow
def test_a_tampered_coupling_is_named(tmp_path):
    """A coupling with one gain changed by 1 % is judged anew; the report says that its file's certificate fails."""
    scenario = load()
    data = SpringDamper((400.0, 300.0), (0.1, 0.1))
    stored = Stored.of(scenario.loop("I"), data, prove(scenario.loop("I"), data, "any-environment"))
    save(stored, tmp_path / "good.json")
    changed = SpringDamper((404.0, 300.0), (0.1, 0.1))
    save(msgspec.structs.replace(stored, coupling=changed.form()), tmp_path / "bad.json")
    short = ("--no-plot", "--duration", "0.5")
    for name, doubted in (("good.json", False), ("bad.json", True)):
        _, report = run(tmp_path, "--coupling", str(tmp_path / name), *short)
        assert any("certificate in the coupling's file does not hold" in r for r in report["remarks"]) == doubted
    _, report = run(tmp_path, "--coupling", str(tmp_path / "good.json"), "--theta", "2", *short)
    assert any("stored for another loop (different theta)" in r for r in report["remarks"])


BAD = [
    (["--case", "III"], "--case is 'III' .. none, I, II"),
    (["--bogus"], "unknown option --bogus"),
    (["--theta", "1,x"], "--theta is '1,x'"),
    (["--theta", "1,2,3"], "--theta has 3 entries, expected 2"),
    (["--theta=-1"], "theta #1 is -1"),
    (["--lam", "5"], "lam #1 is 5 .. 0 to theta + psi = 1"),
    (["--T", "1.2"], "T is 1.2 .. 1e-06 to 0.1 s"),
    (["--T", "nan"], "T is nan"),
    (["--delta", "-1"], "--delta is -1 .. 0 to 10000 N s/m"),
    (["--scenario", "nix.toml"], "scenario nix.toml: No such file"),
    (["--substeps", "0"], "--substeps is 0 .. 1 to 10000"),
    (["--duration", "inf"], "duration is inf"),
    (["--seed", "-1"], "--seed is -1"),
    (["--engine", "drake"], "--engine is 'drake' .. mujoco, exact"),
    (["--integrator", "RK5"], "--integrator is 'RK5'"),
    (["--case", "none", "--coupling", "published"], "--coupling published with --case none"),
    (["--coupling", "magic"], "--coupling is 'magic' .. none, published, spring-damper"),
    (["--coupling", "nix.json"], "nix.json: No such file"),
    (["--scenario", "three-rigid", "--coupling", "published"], "gains for 2 channels, not 3"),
    (["--json", "."], "--json .: is a folder, expected a file or -"),
    (["--json", "/nowhere/r.json"], "--json /nowhere/r.json: .. folder /nowhere"),
]


@pytest.mark.parametrize(("options", "message"), BAD, ids=[" ".join(o) for o, _ in BAD])
def test_bad_options_leave_no_files(options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        main(options)
    assert says(caught.value, message)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def command(*options, **kwargs):
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    return subprocess.Popen(
        [sys.executable, "-m", "sim.run", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **kwargs,
    )


def test_bad_input_gets_one_line_and_exit_2(tmp_path):
    process = command("--T", "7", cwd=tmp_path)
    out, err = process.communicate()
    assert process.returncode == 2
    assert out == ""
    assert err == "error: T is 7, allowed are 1e-06 to 0.1 s\n"


@pytest.mark.slow
def test_impossible_designs_exit_with_1(tmp_path):
    one_device = str(ROOT / "benchmarks/loops/n3-free1.toml")
    words = ["--scenario", one_device, "--psi", "1", "--delta", "0.1", "--condition", "any-environment"]
    done = forked.run(["python", "-m", "sim.run", *words], tmp_path)
    *waiting, refusal = done.stderr.splitlines()
    assert done.returncode == 1
    assert refusal.startswith("not possible: Theorem 4 admits no coupling")
    assert "use " not in refusal  # only designs that were tried are proposed
    assert all(line.endswith(" ..") for line in waiting)  # progress lines, on a slow machine


def test_json_on_standard_output_is_only_json(tmp_path):
    done = forked.run("python -m sim.run --coupling published --duration 1 --no-plot --json -", tmp_path)
    assert done.returncode == 0
    assert json.loads(done.stdout)["case"] == "I"
    assert "growth" in done.stderr


def test_terminals_show_each_stage_of_the_work(tmp_path, monkeypatch, capsys):
    """Standard error names each stage and the error of the last filter; standard output has neither."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(couplings, "design_by_kind", design_by_kind)  # without the tests' cache
    monkeypatch.setattr("haptic_loop.design.budgets.GROWTH", 0.0)  # stop after the first basis, which reports its error
    one_device = "--scenario", str(ROOT / "benchmarks/loops/o13-no-mass.toml")  # designed in a second
    code, _ = run(tmp_path, *one_device, "--coupling", "optimal", "--duration", "0.1", "--no-plot")
    shown, err = capsys.readouterr()
    assert code == 0
    stages = ["designing the coupling", " dB)", "proving the conditions", "simulating"]
    places = [err.index(stage) for stage in stages]
    assert places == sorted(places)
    assert not any(stage in shown for stage in stages)


@pytest.mark.slow
def test_interrupted_runs_keep_the_simulated_blocks(tmp_path, monkeypatch):
    """After Ctrl-C in the third block the first two are written, and the exit code is 130."""
    block, calls = loop.run_block, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 3:
            raise KeyboardInterrupt
        block(*args)

    monkeypatch.setattr(loop, "run_block", interrupted)
    code, report = run(tmp_path, "--coupling", "published")
    trace = Trace.load_npz(tmp_path / "out" / "trace.npz")
    assert code == 130
    assert report["run"]["interrupted"]
    assert trace.t.size == report["run"]["samples"] == 2 * loop._BLOCK
    assert report["error"]["position_relative_rms"] < 1e-6


@pytest.mark.parametrize(
    ("content", "message"), [(b"", "not a trace"), (b"PK\x03\x04rubbish", "not a trace"), (None, "No such file")]
)
def test_files_that_are_no_trace_are_refused(tmp_path, content, message):
    path = tmp_path / "trace.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        Trace.load_npz(path)


def test_a_requested_error_chooses_the_engine(tmp_path, capsys):
    file = tmp_path / "r.json"
    options = ["--case", "I", "--duration", "0.4", "--no-plot", "--out", str(tmp_path)]
    assert main([*options, "--error", "1e-9", "--cross-check", "--json", str(file)]) == 0
    ran = json.loads(file.read_text())["run"]
    assert (ran["integrator"], ran["substeps"]) == ("exponential", 1)
    errors = {(row["integrator"], row["substeps"]): row["position_relative_rms"] for row in ran["engines"]}
    assert errors["exponential", 1] < 1e-11
    assert errors["RK4", 8] < errors["RK4", 4] < errors["Euler", 4]
    evaluations = [row["substeps"] * (4 if row["integrator"] == "RK4" else 1) for row in ran["engines"]]
    assert evaluations == sorted(evaluations)
    check = ran["cross_check"]
    assert (check["integrator"], check["substeps"], check["agrees"]) == ("RK4", 4, True)
    assert 0 < check["position_relative_rms"] < 1e-6
    assert "RK4 x 4" in capsys.readouterr().out
    with pytest.raises(InputError, match="--error chooses MuJoCo's integrator and substeps"):
        main([*options, "--error", "1e-9", "--engine", "exact"])


def test_two_couplings_do_not_share_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stiffness = {"soft": 100.0, "stiff": 700.0}
    for name, K in stiffness.items():
        Path(name).mkdir()
        imported = "from haptic_loop.controller.coupling import SpringDamper"
        text = f"{imported}\ndef {name}(loop): return SpringDamper([{K}] * 2, [1.0] * 2)\n"
        Path(f"{name}/mine.py").write_text(text)
        Path(f"{name}/loop.toml").write_text((SCENARIOS / "omega-pair.toml").read_text())
        sys.modules.pop("mine", None)  # as in a new process
        coupling = ["--coupling", f"{name}/mine.py:{name}", "--scenario", f"{name}/loop.toml"]
        assert main([*coupling, "--duration", "0.01", "--no-plot"]) == 0
    sys.modules.pop("mine", None)
    reports = [json.loads(file.read_text())["assessment"]["coupling"] for file in Path("out").glob("*/report.json")]
    assert sorted(coupling["K"] for coupling in reports) == [[K, K] for K in stiffness.values()]


def test_files_elsewhere_are_named_with_their_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [name_of(file) for file in ("stiff.json", "a/stiff.json", "b/stiff.json", "c/../a/stiff.json")]
    assert names[0] == name_of("./stiff.json") == name_of(str(tmp_path / "stiff.json")) == "stiff"
    assert names[1] == names[3]
    assert len({*names}) == 3


@pytest.mark.parametrize(
    ("options", "folder"),
    [
        ([], "I"),
        (["--case", "none"], "none"),
        (["--coupling", "none"], "I-none"),
        (["--coupling", "b.json"], "I-b"),
        (["--case", "II", "--coupling", "x y.py:Soft_1"], "II-x-y-Soft_1"),
        (["--condition", "any-environment"], "I-any-environment"),
        (["--scenario", "three-rigid", "--coupling", "optimal"], "three-rigid-optimal"),
    ],
)
def test_the_folder_names_loop_coupling_and_condition(options, folder):
    assert place(_parser().parse_args(options)) == folder


def test_long_names_of_couplings_stay_apart():
    first, second = (place(_parser().parse_args(["--coupling", "x" * 240 + end])) for end in "ab")
    assert first != second
    assert len(first) < 100


def test_no_plot_removes_the_old_picture(tmp_path):
    picture = tmp_path / "out" / "figure.png"
    picture.parent.mkdir()
    picture.touch()
    _, report = run(tmp_path, "--coupling", "none", "--duration", "0.01", "--no-plot")
    assert not picture.exists()
    assert str(picture) not in report["files"]


def test_commands_remove_no_file_that_they_read(tmp_path):
    with one_command():
        path, other = tmp_path / "figure.png", tmp_path / "report.json"
        path.write_text("a scenario of this name")
        other.write_text("the report of an earlier run")
        read(path)
        with pytest.raises(InputError, match=r"cannot write .*figure\.png: it was read"):
            remove(other, path)
    assert path.exists()
    assert other.exists()


def test_cross_checks_say_whether_verdicts_agree():
    same, other = (_crossed(CrossCheck("RK4", 4, 1e-7, -1.0, 2e-5, agrees)) for agrees in (True, False))
    assert "same verdict" in same
    assert "ANOTHER VERDICT" in other
    assert "differs by +2.0e-05 1/s" in same


@pytest.mark.slow
def test_the_papers_table_refuses_other_loops(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "haptic_loop.cli.run.chosen_by", lambda *_: pytest.fail("the loop was designed before the refusal")
    )
    with pytest.raises(InputError, match="of its own loop only"):
        main(["--paper", "--theta", "3,3", "--out", str(tmp_path)])


def test_the_papers_table_says_where_runs_differ(tmp_path):
    """Case I without its coupling oscillates, and Figure 6 does not."""
    _, report = run(tmp_path, "--coupling", "none", "--paper", "--no-plot", "--duration", "0.5")
    assert report["paper"][-1]["why"].startswith("does not agree")
