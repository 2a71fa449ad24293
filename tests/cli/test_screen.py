"""Tables keep every digit of their numbers on narrow terminals, and names are printed as they are."""

import ast
import io
import re
import threading
import time
from pathlib import Path

import pytest
from rich.table import Table

from haptic_loop.cli import render
from haptic_loop.cli.screen import Screen

ROOT = Path(__file__).parents[2]
NUMBERS = ["7.8429", "18.895", "-11.19", "0.71449", "1.3699"]


def printed(table: Table, width: int) -> str:
    text = io.StringIO()
    screen = Screen(file=text, width=width)
    screen.print(table)
    screen.print("x" * 10)
    assert screen.width == width
    return text.getvalue()


@pytest.mark.parametrize("width", [10, 30, 45, 60, 100])
@pytest.mark.parametrize("fold", [True, False])
def test_narrow_tables_keep_every_digit(width, fold):
    table = Table("a name of a few words", *(f"heading {n}" for n in "abcde"), title="what it is")
    table.columns[0].overflow = "fold" if fold else "ellipsis"
    table.add_row("spring-damper:this-environment", *NUMBERS)
    lines = printed(table, width).splitlines()
    assert re.findall(r"-?\d+\.\d+", " ".join(lines)) == NUMBERS
    assert "…" not in "".join(lines)


def test_text_wraps_at_the_terminals_width():
    table = Table("a", "b")
    table.add_row("1.5", "some words that wrap where the terminal ends")
    assert max(map(len, printed(table, 40).splitlines())) == 40


def test_every_report_is_printed_on_a_screen():
    """A bare rich Console cuts numbers: only the progress bar may use one."""
    bare = set()
    for path in (file for folder in ("design", "sim", "hw", "cli") for file in (ROOT / folder).rglob("*.py")):
        if "Console" not in (text := path.read_text()):
            continue
        calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
        if any(isinstance(call.func, ast.Name) and call.func.id == "Console" for call in calls):
            bare.add(path.name)
    assert bare == {"render.py"}


@pytest.mark.parametrize("name", ["[/]", "[/red]", "[b]out[/b]", "a[0", "[red", ":x:", "[K]", "[m/s]"])
def test_a_name_is_no_markup(name):
    """Names of files, scenarios and devices are printed as they are, even if they look like markup."""
    table = Table("what", title=name)
    table.add_row(f"cell {name} end")
    lines = printed(table, 60).splitlines()
    assert lines[0].strip() == name
    assert f"cell {name} end" in "".join(lines)
    text = io.StringIO()
    Screen(file=text, width=60).print(f"files: {name}", soft_wrap=True)
    assert text.getvalue() == f"files: {name}\n"


def test_our_own_tags_are_colours():
    text = io.StringIO()
    Screen(file=text, width=60, force_terminal=True, color_system="standard", highlight=False).print(
        "[red]not guaranteed[/]: [m]"
    )
    assert text.getvalue() == "\x1b[31mnot guaranteed\x1b[0m: [m]\n"


def test_pipes_are_told_what_a_command_awaits(capsys, monkeypatch):
    monkeypatch.setattr(render, "_SILENCE", 0.0)
    with render.progress("designing the coupling"):
        for _ in range(2000):
            time.sleep(0.005)
            if said := capsys.readouterr().err:
                break
    assert said == "designing the coupling ..\n"
    monkeypatch.setattr(render, "_SILENCE", 1e3)
    with render.progress("designing the coupling"):
        pass
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    assert all(timer.finished.is_set() for timer in timers)
