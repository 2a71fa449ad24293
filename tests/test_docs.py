"""What README and docs say can be done is done: every command is run, every file that is named exists."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "NOTATION.md", *sorted((ROOT / "docs").glob("*.md"))]
LINES = [
    (page.name, line.removeprefix("$ "))
    for page in PAGES
    for block in re.findall(r"```(?:sh|console)\n(.*?)```", page.read_text(), flags=re.DOTALL)
    for line in block.splitlines()
]
COMMANDS = [(page, line) for page, line in LINES if line.startswith("python -m")]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """One folder for all commands, since some use what others have written."""
    return tmp_path_factory.mktemp("docs")


@pytest.mark.parametrize(("page", "command"), list(dict.fromkeys(COMMANDS)), ids=lambda part: part)
def test_every_command_runs(page, command, place):
    """0 or 1 (done, and it holds or does not): never bad input, never a traceback."""
    words = shlex.split(command, comments=True)
    assert words[0] == "python"
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, *words[1:]], cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), f"{page}: {done.stderr}"
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_and_pictures_exist(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        assert (page.parent / target).exists(), f"{page.name} names {target}"


def test_make_targets_exist():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    named = [line.split()[1] for _, line in LINES if line.startswith("make ")]
    named += re.findall(r"`make ([a-z]+)`", "".join(page.read_text() for page in PAGES))
    assert named
    assert set(named) <= set(targets)


def test_there_are_commands_to_run():
    assert len(COMMANDS) >= 5
