"""The commands lead from a scenario with two unlike devices to C code without a refusal."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from haptic_loop.cli.main import COMMANDS, _command
from haptic_loop.cli.options import DOES_NOT_HOLD, DONE
from tests.evaluate import decisive

LAB = str(Path(__file__).parents[2] / "examples/lab.toml")
DESIGNS = [
    ("anywhere", ["--condition", "any-environment"]),
    ("here", []),
]


def go(command: str, *words: str, holds: bool = True) -> None:
    assert command in COMMANDS
    code = _command(command).main([*words])
    assert code == DONE if holds else code in (DONE, DOES_NOT_HOLD)


@pytest.mark.slow
def test_commands_lead_from_a_scenario_to_c(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("haptic_loop.design.budgets.GROWTH", 0.0)  # the smallest basis suffices here
    lab = ("--scenario", LAB)
    go("run", *lab, "--duration", "1", "--no-plot", "--out", "run")
    report = json.loads(Path("run/report.json").read_text())
    assert decisive(report)["certified"]
    assert report["stability"]["verdict"] == "stable"
    go("compare", *lab, "--no-plot", "--out", "compare")
    others = json.loads(Path("compare/report.json").read_text())["alternatives"]
    assert [other["coupling"] for other in others] == ["none", "spring-damper", "spring-damper", "optimal"]
    assert not any("reason" in other for other in others)
    for name, options in DESIGNS:
        go("design", *lab, *options, "--out", f"{name}.json")
        go("check", f"{name}.json")
        go("export", f"{name}.json", "--process", "--out", f"{name}.c")
    go("audit", *lab, "--coupling", "here.json", "--out", "audit")
    go("validate", *lab, "--coupling", "here.json", "--humans", "5", "--duration", "0", "--no-plot", "--out", "v")
    errors = capsys.readouterr().err
    assert "error" not in errors
    assert "not possible" not in errors
    if shutil.which("cc"):  # the exported tick passes its own test
        subprocess.run(["cc", "-std=c99", "-DHAPTIC_LOOP_TEST", "here.c", "-lm", "-o", "here"], check=True)
        subprocess.run(["./here"], check=True)
