"""A second process draws the same picture, and this process draws if there is no second one."""

import io
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from haptic_loop.cli import painter as painter_module
from haptic_loop.cli.painter import Painter, begin
from haptic_loop.controller.units import current_unit, set_unit
from haptic_loop.sim import plots
from haptic_loop.sim.shown import Signals

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
T = np.arange(300) * 1e-3
WAVE = np.sin(30 * T)[:, None]
SHOWN = Signals(T, 1e-3 * WAVE, WAVE, 1e-3 * WAVE, ("knob",)), "a turn", 5.0


@pytest.fixture
def in_radians():
    before = current_unit()
    set_unit("rad")
    yield
    set_unit(before)


PROGRAM = """
import pickle, sys
from pathlib import Path
from haptic_loop.controller.units import set_unit
from haptic_loop.cli.painter import Painter

set_unit("rad")
painter = Painter()
painter.ask("draw_run", *pickle.load(sys.stdin.buffer))
painter.save(Path(sys.argv[1]))
assert "matplotlib" not in sys.modules
"""


@pytest.fixture(scope="module")
def drawn():
    """Return the picture of a process whose unit is the metre."""
    return plots.png(plots.draw_run(*SHOWN))


@pytest.mark.usefixtures("in_radians")
def test_the_second_process_draws_the_same(tmp_path, drawn):
    path = tmp_path / "a.png"
    subprocess.run([sys.executable, "-c", PROGRAM, path], input=pickle.dumps(SHOWN), check=True, timeout=120)
    assert path.read_bytes() == plots.png(plots.draw_run(*SHOWN))
    assert path.read_bytes() != drawn


@pytest.mark.parametrize("program", ["/bin/false", "/nowhere/python", ""])
def test_without_a_second_process_this_one_draws(program, monkeypatch, tmp_path, drawn):
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "matplotlib")
        patch.setattr(sys, "executable", program)
        painter = Painter()
    painter.ask("draw_run", *SHOWN)
    assert painter.save(tmp_path / "a.png").read_bytes() == drawn


def test_an_unwanted_painter_starts_no_process(monkeypatch):
    monkeypatch.delitem(sys.modules, "matplotlib")
    started = []
    monkeypatch.setattr(subprocess, "Popen", lambda *command, **options: started.append(command))
    Painter(wanted=False)
    assert not started


def test_a_painter_without_picture_ends_its_process(monkeypatch):
    """A failing command leaves no process behind; Popen would warn of one."""
    monkeypatch.delitem(sys.modules, "matplotlib")
    started, start = [], subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *command, **more: started.append(start(*command, **more)) or started[0]
    )
    painter = Painter()
    assert started[0].poll() is None
    del painter
    assert started[0].returncode < 0


class Answers:
    """A second process that answers every request with the same bytes."""

    returncode = None

    def __init__(self):
        self.stdin = io.BytesIO()

    def communicate(self):
        self.returncode = 0
        return b"its picture", None


def test_a_begun_process_draws_for_the_next_painter(monkeypatch, tmp_path, drawn):
    monkeypatch.setattr(painter_module, "_started", Answers)
    begin()
    first, second = Painter(wanted=False), Painter(wanted=False)
    for painter in (first, second):
        painter.ask("draw_run", *SHOWN)
    assert first.save(tmp_path / "a.png").read_bytes() == b"its picture"
    assert second.save(tmp_path / "b.png").read_bytes() == drawn


LEFT = """
import os
from haptic_loop.cli import painter
painter.begin()
print(painter._begun.pid, flush=True)
{end}
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="this system shows no processes in /proc")
@pytest.mark.parametrize("end", ["os._exit(1)", "raise SystemExit(2)", "os.kill(os.getpid(), 9)"])
def test_no_second_process_outlives_the_first(end):
    program = [sys.executable, "-c", LEFT.format(end=end)]
    done = subprocess.run(program, capture_output=True, text=True, check=False, env=ENVIRONMENT)
    assert not done.stderr
    patience = time.monotonic() + 60
    while running(int(done.stdout)) and time.monotonic() < patience:
        time.sleep(0.02)
    assert not running(int(done.stdout))


def running(process: int) -> bool:
    """Return whether this process runs; one that has ended may wait for its parent as a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0] != "Z"
    except FileNotFoundError:
        return False
