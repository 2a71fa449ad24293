"""Every command's --help ends with two examples, whose arguments the command accepts."""

import importlib
import os
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from haptic_loop.cli.main import COMMANDS
from haptic_loop.cli.options import Parser

ROOT = Path(__file__).parents[2]
ENTRY = re.compile(r"    run_command\(\"(\w+)\"\)")  # the line with which a file starts a command of cli
LAUNCH = re.compile(r"    execute\((\w+)\)")  # the line with which a file starts a command that it defines


class Parsed(Exception):
    """Raised in place of the command's work once its arguments are understood."""


def modules():
    """Return the module names of all commands, such as sim.run."""
    files = [path for folder in ("design", "sim", "hw") for path in sorted((ROOT / folder).rglob("*.py"))]
    texts = {path: path.read_text() for path in files}
    entries = [path for path in files if ENTRY.search(texts[path]) or LAUNCH.search(texts[path])]
    parts = [path.relative_to(ROOT).with_suffix("").parts for path in entries]
    return [".".join(names).removesuffix(".__main__") for names in parts]


def main_of(module):
    path = ROOT / module.replace(".", "/")
    text = (path / "__main__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
    if match := ENTRY.search(text):
        assert COMMANDS[match.group(1)][0] == module
        return importlib.import_module(f"haptic_loop.cli.{match.group(1)}").main
    package = f"{module}.__main__" if path.is_dir() else module
    return getattr(importlib.import_module(package), LAUNCH.search(text).group(1))


def help_of(module, capsys):
    with pytest.raises(SystemExit) as end:
        main_of(module)(["--help"])
    assert end.value.code == 0
    return capsys.readouterr().out


def test_every_file_with_a_command_is_found():
    assert {"design", "design.audit", "sim.run", "sim.validate", "hw.bridge"} <= set(modules())


@pytest.mark.parametrize("module", modules())
def test_commands_accept_the_examples_of_their_help(module, capsys, monkeypatch):
    text = help_of(module, capsys)
    lines = text.partition("\nexamples:\n")[2].splitlines()
    assert len(lines) == 2
    parse = Parser.parse_args

    def understood(self, *args, **kwargs):
        raise Parsed(parse(self, *args, **kwargs))

    monkeypatch.setattr(Parser, "parse_args", understood)
    for line in lines:
        words = shlex.split(line, comments=True)
        assert words[:3] == ["python", "-m", module]
        with pytest.raises(Parsed):
            main_of(module)(words[3:])


@pytest.mark.parametrize("module", modules())
def test_help_describes_every_option(module, capsys, monkeypatch):
    parse = Parser.parse_args
    seen = []

    def noted(self, *args, **kwargs):
        seen.extend(self._actions)
        return parse(self, *args, **kwargs)

    monkeypatch.setattr(Parser, "parse_args", noted)
    help_of(module, capsys)
    silent = [action.option_strings or action.dest for action in seen if not action.help]
    assert seen
    assert not silent


COUNT = """
from threadpoolctl import threadpool_info
from haptic_loop import design_coupling, load
from haptic_loop.cli.execute import execute
from haptic_loop.design import api
def count(*_):
    import scipy.linalg
    print({lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"})
    return 0
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "call",
    ["execute(count)", "api.known = count; design_coupling(load('omega-pair').loop('I'))"],
    ids=("command", "function"),
)
def test_commands_and_functions_use_one_blas_thread(call):
    """The last digits depend on the number of threads, so a user's OPENBLAS_NUM_THREADS=2 must change nothing."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "2"}
    words = [sys.executable, "-c", COUNT + call]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["{1}"]


def test_the_console_script_lists_and_runs_commands():
    def script(*words):
        start = [sys.executable, "-c", "from haptic_loop.cli.main import main; main()", *words]
        return subprocess.run(start, cwd=ROOT, capture_output=True, text=True, check=False)

    listed = script().stdout
    assert all(f"({module})" in listed for module in modules())
    assert script("check", "--help").stdout.startswith("usage: python -m design.check")
    unknown = script("chekc")
    assert (unknown.returncode, unknown.stdout) == (2, "")
    assert unknown.stderr == "error: unknown command 'chekc', did you mean check?\n"
    assert script("--version").stdout == f"haptic-loop {version('haptic-loop')}\n"
