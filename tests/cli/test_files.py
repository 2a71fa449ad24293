"""Regular files are written completely or not at all, pipes are written directly, and a full disk gives one line."""

import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from haptic_loop.design.files import check_file, write
from haptic_loop.sim.scenario import InputError


def test_a_link_stays_a_link(tmp_path):
    target, link = tmp_path / "real" / "data.json", tmp_path / "link.json"
    target.parent.mkdir()
    target.write_text("old")
    link.symlink_to(target)
    check_file("--json", link)
    assert write(link, "new") == link
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_pipes_and_devices_are_not_replaced(tmp_path):
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()))
    reader.start()
    write(pipe, "through")
    reader.join(timeout=30)
    assert got == ["through"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert sorted(tmp_path.iterdir()) == [pipe]
    check_file("--json", Path("/dev/null"))


def test_a_full_disk_keeps_the_old_file(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")

    def content(file):
        file.write(b"half of")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(InputError, match=r"cannot write .*report\.json: No space left on device"):
        write(path, content)
    assert path.read_text() == "old"
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("command", "files"),
    [
        ("sim.run --duration 0.1", {"figure.png", "scene.xml"}),
        ("hw.bridge --rehearse --duration 0.1 --measure 60 --no-plot", {"incidents.jsonl"}),
    ],
)
def test_files_are_complete_without_standard_output(command, files, tmp_path):
    words = ["-m", *command.split(), "--out", str(tmp_path)]
    with open("/dev/full", "w") as full:
        ended = subprocess.run([sys.executable, *words], stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert ended.returncode == 2
    assert ended.stderr.endswith("error: standard output: No space left on device\n")
    assert {path.name for path in tmp_path.iterdir()} == files | {"report.json", "trace.csv", "trace.npz"}
