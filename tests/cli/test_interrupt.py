"""After Ctrl-C, or if a reader closes the pipe, a command has the right exit code and no traceback."""

import json
import os
import re
import signal
import subprocess
import sys
from importlib import import_module
from itertools import count
from pathlib import Path

import pytest

from haptic_loop.cli.execute import execute
from haptic_loop.controller.coupling import SpringDamper
from haptic_loop.design.coupling_file import Stored, save
from haptic_loop.design.files import check_file, one_command, out_file
from haptic_loop.sim import run as loop
from haptic_loop.sim.scenario import InputError, load

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}


def started(*words, **options):
    return subprocess.Popen(
        [sys.executable, *words], env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
    )


def interrupted_after(module, command, cwd):
    """Send SIGINT when Python reports that `module` is imported, and return the exit code and the lines of errors."""
    process = started("-X", "importtime", "-m", *command, cwd=cwd)
    for line in process.stderr:
        if line.rpartition("|")[2].strip() == module:
            break
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate()
    lines = [line for line in rest.splitlines() if not line.startswith("import time:")]
    return process.returncode, lines


def test_ctrl_c_during_solver_import_exits_with_130(tmp_path):
    """A design imports the solver while the command is at work."""
    assert interrupted_after("clarabel", ["design", "--coupling", "ccl"], tmp_path) == (130, ["interrupted"])


def test_an_interrupted_comparison_reports_nothing(tmp_path):
    """Ctrl-C comes when the runs import MuJoCo; by then some couplings are designed."""
    assert interrupted_after("mujoco", ["design.compare", "--json", "r.json"], tmp_path) == (130, ["interrupted"])
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def interrupt(monkeypatch, simulation, blocks=1):
    """Let Ctrl-C come in the command's simulation number `simulation`, after its first `blocks` blocks."""
    run_blocks, numbers = loop.run_blocks, count(1)

    def interrupted(process, engine, outside, ticks, start, keep, block):
        if next(numbers) != simulation:
            return run_blocks(process, engine, outside, ticks, start, keep, block)
        if blocks:
            run_blocks(process, engine, outside, blocks * block, start, keep, block)
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "run_blocks", interrupted)


RUN = ["sim.run", "--coupling", "published", "--duration", "3"]


@pytest.mark.parametrize(
    ("command", "simulation"),
    [([*RUN, "--cross-check"], 2), ([*RUN, "--cross-check"], 3), (["design.compare"], 1), (["design.compare"], 2)],
)
def test_interrupted_secondary_runs_give_no_report(command, simulation, tmp_path, monkeypatch):
    """Ctrl-C interrupts a simulation other than the reported run.

    sim.run also simulates the exact loop and the cross-check, and design.compare every coupling.
    """
    interrupt(monkeypatch, simulation)
    with pytest.raises(KeyboardInterrupt):
        finish(command, tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("simulation", [1, 2])
def test_an_interrupted_reference_run_leaves_no_measurements(simulation, tmp_path, monkeypatch):
    """The exact engine runs the loop without the coupling, and the loop with it, before any engine is measured."""
    interrupt(monkeypatch, simulation)
    assert finish(["sim.accuracy", *RUN[1:]], tmp_path) == 130
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["interrupted"]
    assert not report["rows"]


@pytest.mark.parametrize("scenario", [["--case", "none"], ["--scenario", "world-cube"]])
def test_runs_without_a_finished_tick_leave_no_folder(scenario, tmp_path, monkeypatch):
    interrupt(monkeypatch, 1, blocks=0)
    with pytest.raises(KeyboardInterrupt), one_command():
        finish(["sim.run", *scenario], tmp_path / "new/folder")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_interrupted_runs_in_worlds_report_the_interruption(tmp_path, monkeypatch, capsys):
    interrupt(monkeypatch, 1)
    assert finish(["sim.run", "--scenario", "world-cube", "--duration", "3"], tmp_path) == 130
    assert json.loads((tmp_path / "report.json").read_text())["interrupted"]
    assert "interrupted" in capsys.readouterr().out


TRACES = ["trace.csv", "scene.xml", "figure.png"]


@pytest.mark.parametrize(
    ("command", "writer", "files"),
    [
        ([*RUN[:-1], "0.3"], "haptic_loop.sim.trace.Trace.save_csv", TRACES),
        (
            ["sim.run", "--scenario", "world-cube", "--duration", "0.1"],
            "haptic_loop.sim.trace.Trace.save_csv",
            [*TRACES, "world.xml"],
        ),
        (
            ["sim.validate", "--coupling", "published", "--humans", "2", "--duration", "0"],
            "haptic_loop.cli.validate.save_humans",
            ["population.png", "worst-human.toml", "adversary.toml", "disagreement-7.toml"],
        ),
        (
            ["hw.bridge", "--rehearse", "--duration", "0.1", "--coupling", "moving-average"],
            "haptic_loop.sim.trace.Trace.save_csv",
            ["trace.csv", "figure.png"],
        ),
        pytest.param(
            ["hw.identify", "--rehearse", "--seconds", "0.5", "--sittings", "1"],
            "haptic_loop.sim.trace.Trace.save_npz",
            ["devices.toml", "trace-1.npz", "trace-2.npz"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_ctrl_c_while_storing_mixes_no_runs(command, writer, files, tmp_path, monkeypatch):
    """The folder holds the files of an earlier run, and Ctrl-C comes when the command calls `writer`."""

    def interrupted(*content):
        raise KeyboardInterrupt

    for name in ("report.json", "trace.npz", *files):
        (tmp_path / name).write_text("earlier")
    monkeypatch.setattr(writer, interrupted)
    with pytest.raises(KeyboardInterrupt):
        finish(command, tmp_path)
    assert not [name for name in ("report.json", *files) if (tmp_path / name).exists()]


def finish(command, folder):
    """Run a command in this process, without pictures, and return its exit code."""
    main = import_module(f"haptic_loop.cli.{command[0].rpartition('.')[2]}").main
    undrawn = [] if command[0] == "hw.identify" else ["--no-plot"]
    return main([*command[1:], *undrawn, "--out", str(folder)])


def test_an_ignored_ctrl_c_stays_ignored(tmp_path):
    """nohup, and `command &` in a script, start a command with SIGINT ignored."""
    words = ["-c", "import os, signal, sys; signal.signal(2, signal.SIG_IGN); os.execv(sys.executable, sys.argv[1:])"]
    process = started(*words, sys.executable, "-X", "importtime", "-m", "sim.run", "--help", cwd=tmp_path)
    for line in process.stderr:
        if line.rpartition("|")[2].strip() == "numpy":
            break
    process.send_signal(signal.SIGINT)
    assert "usage: python -m sim.run" in process.communicate()[0]
    assert process.returncode == 0


AUDIT = ["design.audit", "--K", "2870,2320", "--B", "5.47,5.55"]  # not certified: exit code 1


@pytest.mark.parametrize(
    ("command", "code"),
    [
        pytest.param(["sim.run", "--coupling", "none", "--duration", "0.1", "--no-plot"], 0, marks=pytest.mark.slow),
        (["sim.run", "--help"], 0),
        ([*AUDIT, "--json", "-"], 1),
    ],
)
def test_a_closed_pipe_keeps_the_exit_code(command, code, tmp_path):
    """The reader closes the pipe before the first line, so that every write fails."""
    with started("-m", *command, cwd=tmp_path) as process:
        process.stdout.close()
        errors = process.stderr.read()
    assert process.returncode == code
    assert "Broken" not in errors
    assert "Traceback" not in errors
    if "--help" not in command:
        assert list(tmp_path.glob("out/*/report.json"))  # the command does its work nevertheless


def test_the_folder_of_an_output_must_exist(tmp_path):
    with pytest.raises(InputError, match=r"--json .*nix/a.json: .*folder .*nix"):
        check_file("--json", tmp_path / "nix/a.json")
    with pytest.raises(InputError, match=r"--out .*nix/a.json: .*folder .*nix"):
        out_file(str(tmp_path / "nix/a.json"), "out/a.json")
    with pytest.raises(InputError, match="is a folder, expected the file of the coupling"):
        out_file(str(tmp_path), "out/a.json", "the file of the coupling")
    assert not (tmp_path / "nix").exists()
    default = tmp_path / "out/deep/a.json"
    assert out_file(None, str(default)) == default
    assert default.parent.is_dir()
    assert not default.exists()


@pytest.mark.parametrize("command", [["design"], ["design.export", "coupling.json"]])
def test_design_and_export_make_no_folder(command, tmp_path, monkeypatch, capsys):
    from haptic_loop.cli.design import main as design
    from haptic_loop.cli.export import main as export

    monkeypatch.chdir(tmp_path)
    save(Stored.of(load().loop("I"), SpringDamper((878.7, 551.8), (0.3864, 0.5219))), "coupling.json")
    monkeypatch.setattr(sys, "argv", ["x", *command[1:], "--out", "nix/a.c"])
    with pytest.raises(SystemExit) as end:
        execute(design if command == ["design"] else export)
    assert end.value.code == 2
    assert re.fullmatch(r"error: --out nix/a\.c: .*\bnix\b.*\n", capsys.readouterr().err)
    assert not Path("nix").exists()


@pytest.mark.parametrize("backend", [pytest.param("osmesa", marks=pytest.mark.validate), "bogus"])
@pytest.mark.parametrize(
    ("command", "picture"),
    [
        ("sim.run --case none --duration 0.05 --no-plot --out out", None),
        pytest.param("sim.run --case none --duration 0.05 --out out", "out/figure.png", marks=pytest.mark.slow),
        pytest.param("sim.view --coupling none --duration 0.1 --video film.gif", "film.gif", marks=pytest.mark.slow),
    ],
)
def test_commands_ignore_mujoco_gl(command, picture, backend, tmp_path):
    """`import mujoco` alone fails with the backend "bogus", and with "osmesa" if that is not installed."""
    environment = ENVIRONMENT | {"MUJOCO_GL": backend}
    words = [sys.executable, "-m", *command.split()]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, "GL" in done.stderr) == (0, False)
    assert picture is None or (tmp_path / picture).stat().st_size


INTERRUPT = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\nfor _ in range(1000): pass\nraise SystemExit(5)\n"
IN_EXEC = "exec('raise KeyboardInterrupt')\n"  # dataclass runs code in this way
IN_C = "try:\n raise KeyboardInterrupt\nexcept BaseException as error:\n raise ImportError('failed') from error\n"


@pytest.mark.parametrize("command", ["hw.bridge", "hw.identify", "hw.replay", "sim.view", "design", "sim.run"])
def test_ctrl_c_during_command_imports_exits_with_130(command, tmp_path):
    assert interrupted_at(command, "numpy", INTERRUPT, tmp_path) == (130, "interrupted\n")


@pytest.mark.parametrize(
    "code", [pytest.param(IN_EXEC, id="exec", marks=pytest.mark.slow), pytest.param(IN_C, id="compiled")]
)
def test_ctrl_c_during_mujoco_import_exits_with_130(code, tmp_path):
    # Case none has no coupling to design, so that MuJoCo is imported soon.
    command = "sim.run --case none --duration 0.05 --no-plot"
    assert interrupted_at(command, "mujoco", code, tmp_path) == (130, "interrupted\n")


def interrupted_at(command, module, code, folder):
    """Run a command that imports `code` in place of the module, and return its exit code and error lines."""
    (folder / f"{module}.py").write_text(code)
    environment = ENVIRONMENT | {"PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    words = [sys.executable, "-m", *command.split()]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, said(done)


def said(done):
    """Return standard error without the lines that say, on a slow machine, what a command waits for."""
    return "".join(line for line in done.stderr.splitlines(keepends=True) if not line.endswith(" ..\n"))


LOST = """
import os, signal, sys, time
from haptic_loop.cli.execute import execute

class Cleaned:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000): pass

def main(argv):
    Cleaned()
    time.sleep(60)
    return 0

execute(main, [])
"""


def test_ctrl_c_inside_a_destructor_ends_the_command():
    """Python ignores a KeyboardInterrupt that __del__ raises. The command ends nevertheless, while it sleeps."""
    done = subprocess.run(
        [sys.executable, "-c", LOST], env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=50
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
